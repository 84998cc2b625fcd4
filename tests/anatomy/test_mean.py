"""The mean of jaws whose mean and modes are known, and the laws of what it is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import morphops
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import subspace_angles
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from cuspid.anatomy.shape.correspondence import Target, Template, fit, warp
from cuspid.anatomy.shape.mean import MeanShapeOptions, mean_shape, principal_modes, vertex_areas
from cuspid.anatomy.shape.procrustes import superpose
from cuspid.model.jaw import GUM, Jaw, Landmark
from cuspid.model.mesh import Mesh
from cuspid.model.shape_model import ShapeModel
from cuspid.report.figures.shape import save_modes_picture, save_variance_picture
from cuspid.runtime.errors import InputError
from cuspid.storage import read_shape_model, write_shape_model

SCORES = np.array([[1.2, -0.4, 0.9], [-0.9, 1.1, 0.4], [0.3, -1.3, -0.2], [-0.6, 0.6, -1.1]])
"""Weights of three known modes in each sample; they sum to zero."""
AMPLITUDES_MM = (0.7, 0.4, 0.15)


def with_landmarks(jaw: Jaw) -> Jaw:
    """Five points of each tooth: the centre of its top, and where it ends along the arch and across it."""
    landmarks = {}
    for fdi in jaw.teeth:
        own = jaw.mesh.submesh(jaw.tooth_faces(fdi)).vertices
        middle = own.mean(axis=0)
        across = middle * [1, 1, 0] / np.linalg.norm(middle[:2])
        along = np.array([-across[1], across[0], 0])
        for name, way in {"top": [0, 0, 1], "a": along, "b": -along, "c": across, "d": -across}.items():
            landmarks[f"{fdi}.{name}"] = Landmark(own[np.argmax((own - middle) @ np.asarray(way))])
    return replace(jaw, landmarks=landmarks)


def remeshed(jaw: Jaw, rng: np.random.Generator) -> Jaw:
    """The same surface with other vertices: some faces split at a point inside, all vertices in another order."""
    split = rng.random(len(jaw.mesh.faces)) < rng.uniform(0.1, 0.5)
    corners = jaw.mesh.faces[split]
    weights = rng.dirichlet([4, 4, 4], split.sum())
    inside = np.einsum("fk,fkd->fd", weights, jaw.mesh.vertices[corners])
    new = len(jaw.mesh.vertices) + np.arange(len(inside))
    parts = [np.column_stack([corners[:, k], corners[:, (k + 1) % 3], new]) for k in range(3)]
    faces = np.concatenate([jaw.mesh.faces[~split], *parts])
    assert jaw.face_labels is not None
    labels = np.concatenate([jaw.face_labels[~split], *[jaw.face_labels[split]] * 3])
    order = rng.permutation(len(jaw.mesh.vertices) + len(inside))
    place = np.argsort(order)
    vertices = np.concatenate([jaw.mesh.vertices, inside])[order]
    return replace(jaw, mesh=Mesh(vertices, place[faces]), face_labels=labels)


@dataclass(frozen=True)
class Modes:
    """Three displacement fields without a rigid part at the landmarks; the last is a ripple between them."""

    landmarks: np.ndarray

    def raw(self, points: np.ndarray) -> np.ndarray:
        x, y, z = points.T / 25.0
        wide = np.stack([x, 0.3 * x**2, 0.4 * np.cos(2 * x)], axis=1)
        long = np.stack([0.5 * np.sin(3 * y), -y * np.abs(y), 0.5 * np.sin(2 * y + z)], axis=1)
        ripple = np.stack([0 * x, 0.5 * np.sin(40 * z), np.sin(30 * x) * np.cos(30 * y)], axis=1)
        return np.stack([wide, long, ripple])

    def __call__(self, points: np.ndarray) -> np.ndarray:
        def rigid(places: np.ndarray) -> np.ndarray:
            turns = [np.cross(axis, places) for axis in np.eye(3)]
            moves = [np.broadcast_to(axis, places.shape) for axis in np.eye(3)]
            return np.stack([*turns, *moves]).reshape(6, -1).T

        fields = self.raw(self.landmarks).reshape(len(AMPLITUDES_MM), -1).T
        part = np.linalg.lstsq(rigid(self.landmarks), fields, rcond=None)[0]
        free = self.raw(points).reshape(len(AMPLITUDES_MM), -1).T - rigid(points) @ part
        return np.array(AMPLITUDES_MM)[:, None, None] * free.T.reshape(len(AMPLITUDES_MM), -1, 3)


@dataclass(frozen=True)
class Population:
    base: Jaw
    modes: Modes
    jaws: Mapping[str, Jaw]


@pytest.fixture(scope="module")
def base(coarse_phantom: Jaw) -> Jaw:
    """The front of a jaw, open where it is cut off."""
    assert coarse_phantom.face_labels is not None
    front = np.isin(coarse_phantom.face_labels, [35, 34, 33, 32, 31, 41, 42, 43, 44, 45])
    front |= (coarse_phantom.face_labels == GUM) & (coarse_phantom.mesh.face_centres[:, 1] > 4)
    front &= coarse_phantom.mesh.face_centres[:, 2] > -11
    mesh = coarse_phantom.mesh.submesh(front)
    return with_landmarks(Jaw(mesh=mesh, face_labels=coarse_phantom.face_labels[front], arch="lower"))


@pytest.fixture(scope="module")
def population(base: Jaw) -> Population:
    modes = Modes(np.stack([point.position for point in base.landmarks.values()]))

    def deformed(scores: np.ndarray, seed: int) -> Jaw:
        def move(points: np.ndarray) -> np.ndarray:
            return points + np.einsum("k,kpd->pd", scores, modes(points))

        other = remeshed(base, np.random.default_rng(seed))
        landmarks = {label: Landmark(move(point.position[None])[0]) for label, point in base.landmarks.items()}
        return replace(other, mesh=Mesh(move(other.mesh.vertices), other.mesh.faces), landmarks=landmarks)

    jaws = {f"jaw{k}": deformed(scores, k) for k, scores in enumerate(SCORES)}
    return Population(base=base, modes=modes, jaws=jaws)


@pytest.fixture(scope="module")
def model(population: Population) -> ShapeModel:
    return mean_shape(population.jaws)


@pytest.fixture(scope="module")
def other_model(population: Population) -> ShapeModel:
    return mean_shape(population.jaws, MeanShapeOptions(first="jaw2"))


# The mean


def test_the_known_mean_comes_back(population: Population, model: ShapeModel) -> None:
    away_um = 1e3 * population.base.mesh.closest(model.mean.mesh.vertices)[0]
    back_um = 1e3 * model.mean.mesh.closest(population.base.mesh.vertices)[0]
    for distance in (away_um, back_um):
        assert 0 < np.median(distance) < 10
        assert np.percentile(distance, 95) < 50


@pytest.mark.long
def test_the_mean_does_not_depend_on_the_first_sample(model: ShapeModel, other_model: ShapeModel) -> None:
    assert len(model.mean.mesh.vertices) != len(other_model.mean.mesh.vertices)
    for label, point in model.mean.landmarks.items():
        assert np.allclose(point.position, other_model.mean.landmarks[label].position, atol=1e-9)
    apart_um = 1e3 * model.mean.mesh.closest(other_model.mean.mesh.vertices)[0]
    assert 0 < np.median(apart_um) < 10
    assert np.percentile(apart_um, 95) < 50


def test_the_first_guess_is_another_surface_than_the_mean(population: Population, model: ShapeModel) -> None:
    assert model.log[0].surface_change_um > 3 * model.log[-1].surface_change_um
    assert model.converged
    assert model.log[-1].surface_change_um < MeanShapeOptions().tolerance_um
    assert all(95 < step.covered_pct <= 100 for step in model.log)


def test_the_mean_has_faces_and_labels_of_the_first_sample(population: Population, other_model: ShapeModel) -> None:
    first = population.jaws["jaw2"]
    assert np.array_equal(other_model.mean.mesh.faces, first.mesh.faces)
    assert np.array_equal(other_model.mean.face_labels, first.face_labels)
    assert other_model.mean.teeth == first.teeth
    assert other_model.mean.arch == "lower"


def test_each_tooth_of_the_mean_lies_where_it_should(population: Population, model: ShapeModel) -> None:
    for fdi in model.mean.teeth:
        own = population.base.mesh.submesh(population.base.tooth_faces(fdi))
        mean = model.mean.mesh.submesh(model.mean.tooth_faces(fdi))
        assert 1e3 * np.percentile(own.closest(mean.vertices)[0], 95) < 60


# The modes


def along_normals(mesh: Mesh, fields: np.ndarray) -> np.ndarray:
    """What of displacement fields changes the surface, weighted by area; sliding within it cannot be seen."""
    weights = np.sqrt(vertex_areas(mesh) / mesh.face_areas.sum())
    return np.asarray(np.einsum("kvd,vd,v->vk", fields, mesh.vertex_normals, weights))


def test_the_known_modes_come_back(population: Population, model: ShapeModel) -> None:
    mesh = model.mean.mesh
    known = along_normals(mesh, population.modes(mesh.vertices))
    found = along_normals(mesh, model.modes)
    angles = np.rad2deg(subspace_angles(known, found))
    # The last is the ripple of 0.15 mm, which is as short as a tooth is wide.
    assert np.all((angles > 0) & (angles < [15, 5, 1]))
    variances = np.linalg.eigvals(np.cov(SCORES.T) @ known.T @ known).real
    scaled = found * model.standard_deviations_mm
    assert np.linalg.eigvalsh(scaled.T @ scaled) == pytest.approx(np.sort(variances), rel=0.08)
    assert model.variance_shares.sum() == pytest.approx(1)


def test_the_scores_are_those_of_the_samples(population: Population, model: ShapeModel) -> None:
    mesh = model.mean.mesh
    offsets = np.einsum("nk,kvd->nvd", SCORES, population.modes(mesh.vertices))
    known, _, deviations, _ = principal_modes(offsets, vertex_areas(mesh) / mesh.face_areas.sum(), 3)
    assert np.abs(known[:, 0] @ model.scores[:, 0]) / 3 == pytest.approx(1, abs=2e-3)
    assert model.standard_deviations_mm[0] == pytest.approx(deviations[0], rel=0.02)
    assert model.scores.std(axis=0, ddof=1) == pytest.approx(np.ones(3))


def test_the_model_gives_its_samples_back(population: Population, model: ShapeModel) -> None:
    for name, scores in zip(model.names, model.scores, strict=True):
        jaw, again = population.jaws[name], model.sample(scores)
        labels = sorted(jaw.landmarks)
        true, made = (np.stack([one.landmarks[label].position for label in labels]) for one in (jaw, again))
        assert np.abs(pdist(true) - pdist(made)).max() < 1e-6
    assert np.array_equal(model.sample([]).mesh.vertices, model.mean.mesh.vertices)
    with pytest.raises(InputError, match="4 weights for 3 modes"):
        model.sample([0.0] * 4)


def test_modes_are_orthonormal_and_scores_uncorrelated() -> None:
    rng = np.random.default_rng(1)
    offsets = rng.standard_normal((6, 50, 3))
    offsets -= offsets.mean(axis=0)
    weights = rng.dirichlet(np.ones(50))
    scores, modes, deviations, shares = principal_modes(offsets, weights, 10)
    assert np.allclose(np.einsum("avd,v,bvd->ab", modes, weights, modes), np.eye(5), atol=1e-9)
    assert np.allclose(scores.T @ scores / 5, np.eye(5), atol=1e-9)
    assert np.allclose(np.einsum("nk,k,kvd->nvd", scores, deviations, modes), offsets, atol=1e-9)
    assert shares.sum() == pytest.approx(1)


# Size, teeth and refusals


def test_size_is_shape_unless_scaled(base: Jaw) -> None:
    def sized(factor: float) -> Jaw:
        landmarks = {label: Landmark(factor * point.position) for label, point in base.landmarks.items()}
        return replace(base, mesh=Mesh(factor * base.mesh.vertices, base.mesh.faces), landmarks=landmarks)

    jaws = {f"{factor:g}": sized(factor) for factor in (0.95, 1.0, 1.05)}
    kept = mean_shape(jaws, MeanShapeOptions(max_rounds=1))
    scaled = mean_shape(jaws, MeanShapeOptions(max_rounds=1, scale=True))
    assert kept.standard_deviations_mm[0] == pytest.approx(0.05 * _rms_radius(base), rel=0.02)
    assert scaled.standard_deviations_mm.max(initial=0) < 1e-3
    assert scaled.scales * [0.95, 1.0, 1.05] == pytest.approx([1.0] * 3)
    assert (scaled.scaled, kept.scaled) == (True, False)
    assert np.array_equal(kept.scales, np.ones(3))


def _rms_radius(jaw: Jaw) -> float:
    centre = np.mean([point.position for point in jaw.landmarks.values()], axis=0)
    areas = vertex_areas(jaw.mesh)
    return float(np.sqrt(areas @ ((jaw.mesh.vertices - centre) ** 2).sum(axis=1) / areas.sum()))


def test_landmarks_alone_keep_the_detail_of_the_first_sample(population: Population) -> None:
    model = mean_shape(population.jaws, MeanShapeOptions(correspondence="landmarks", max_rounds=2))
    assert model.log[0].change_um < 1e-6
    assert model.correspondence == "landmarks"


def test_a_tooth_that_a_jaw_lacks_is_named(population: Population) -> None:
    whole, part = population.jaws["jaw0"], population.jaws["jaw1"]
    assert part.face_labels is not None
    labels = np.where(part.face_labels == 35, GUM, part.face_labels)
    landmarks = {label: point for label, point in part.landmarks.items() if not label.startswith("35.")}
    part = replace(part, face_labels=labels, landmarks=landmarks)
    model = mean_shape({"whole": whole, "part": part}, MeanShapeOptions(first="whole", max_rounds=1))
    assert any("part has no tooth 35" in note for note in model.notes)
    assert any("35.a" in note for note in model.notes)
    assert 35 in model.mean.teeth
    assert not any(label.startswith("35.") for label in model.mean.landmarks)


def _pair(base: Jaw, **changes: object) -> dict[str, Jaw]:
    return {"one": base, "two": replace(base, **changes)}  # type: ignore[arg-type]


def test_what_cannot_be_averaged_is_refused(base: Jaw) -> None:
    few = dict(list(base.landmarks.items())[:2])
    with pytest.raises(InputError, match=r"2 landmarks in common.*two lacks .* more"):
        mean_shape(_pair(base, landmarks=few))
    line = {label: Landmark(np.array([k, 0.0, 0.0])) for k, label in enumerate(base.landmarks)}
    with pytest.raises(InputError, match="collinear in two"):
        mean_shape(_pair(base, landmarks=line))
    with pytest.raises(InputError, match="one is a lower jaw and two an upper one"):
        mean_shape(_pair(base, arch="upper"))
    with pytest.raises(InputError, match="at least two"):
        mean_shape({"one": base})
    with pytest.raises(InputError, match="one, two are all the same jaw"):
        mean_shape(_pair(base))
    with pytest.raises(InputError, match="first sample 'three'"):
        mean_shape(_pair(base), MeanShapeOptions(first="three"))
    with pytest.raises(InputError, match="no jaw has any"):
        mean_shape({name: replace(base, landmarks={}) for name in "ab"})


# Procrustes


def configurations(seed: int, count: int = 5, size: int = 12, spread_mm: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    shape = rng.normal(size=(size, 3)) * [20, 15, 4]
    return shape + rng.normal(scale=spread_mm, size=(count, size, 3)) + rng.normal(scale=5.0, size=(count, 1, 3))


def gauge_free(points: np.ndarray) -> np.ndarray:
    """All distances between points, in units of their centroid size."""
    return pdist(points) / np.linalg.norm(points - points.mean(axis=0))


def misfit(aligned: np.ndarray) -> float:
    """Sum of the squared distances to the mean, in units of all squared sizes."""
    return float(((aligned - aligned.mean(axis=0)) ** 2).sum() / (aligned**2).sum())


@pytest.mark.parametrize("scale", [False, True])
def test_procrustes_agrees_with_morphops(scale: bool) -> None:
    samples = configurations(3, spread_mm=0.5)
    samples -= samples.mean(axis=1, keepdims=True)
    # Without scaling morphops brings every configuration to unit size; of equal sizes it does what we do.
    samples /= np.linalg.norm(samples, axis=(1, 2), keepdims=True)
    theirs = morphops.gpa(samples, tol=1e-18, max_iters=200, do_scaling=scale, no_reflect=True)
    ours = superpose(samples, scale=scale)
    assert np.abs(gauge_free(ours.mean) - gauge_free(theirs["mean"])).max() < 1e-6
    ratio = theirs["b"] / ours.scales
    assert ratio / ratio.mean() == pytest.approx(np.ones(5), abs=1e-6)
    # It ends one rotation short of the optimum; ours must not be behind.
    assert misfit(ours.aligned) <= misfit(theirs["aligned"]) * (1 + 1e-9)


def test_procrustes_with_scale_agrees_with_morphops_for_any_sizes() -> None:
    samples = configurations(4, spread_mm=0.3) * np.linspace(0.8, 1.3, 5)[:, None, None]
    theirs = morphops.gpa(samples, tol=1e-18, max_iters=200, do_scaling=True, no_reflect=True)
    ours = superpose(samples, scale=True)
    assert np.abs(gauge_free(ours.mean) - gauge_free(theirs["mean"])).max() < 1e-6


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), scale=st.booleans())
def test_the_mean_of_landmarks_knows_no_order_and_no_pose(seed: int, scale: bool) -> None:
    samples = configurations(seed)
    rng = np.random.default_rng(seed + 1)
    ours = superpose(samples, scale=scale)
    shuffled = superpose(samples[::-1], scale=scale)
    assert np.allclose(ours.mean, shuffled.mean, atol=1e-7)
    turned = np.stack(
        [sample @ turn.as_matrix() for sample, turn in zip(samples, Rotation.random(5, rng), strict=True)]
    )
    assert np.allclose(pdist(superpose(turned, scale=scale).mean), pdist(ours.mean), atol=1e-6)
    assert np.allclose(np.linalg.det(ours.rotations), 1)
    assert np.allclose(ours.apply(2, samples[2]), ours.aligned[2])


def test_a_mirror_image_is_not_reflected() -> None:
    samples = configurations(5, count=2)
    samples[1] = samples[0] * [-1, 1, 1]
    aligned = superpose(samples)
    assert np.allclose(np.linalg.det(aligned.rotations), 1)
    assert np.linalg.norm(aligned.aligned[0] - aligned.aligned[1]) > 1


# Correspondence


@settings(max_examples=20)
@given(seed=st.integers(0, 1000))
def test_a_warp_meets_its_landmarks_and_keeps_what_is_linear(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, points = rng.normal(scale=10, size=(9, 3)), rng.normal(scale=10, size=(20, 3))
    target = source + rng.normal(size=(9, 3))
    assert np.allclose(warp(source, target, source), target, atol=1e-6)
    matrix, shift = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), rng.normal(size=3)
    assert np.allclose(warp(source, source @ matrix + shift, points), points @ matrix + shift, atol=1e-6)


def test_a_warp_takes_landmarks_in_a_plane() -> None:
    source = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0.0]])
    target = source + [[0, 0, 1], [0, 0, 0], [0, 0, 0.0]]
    assert np.allclose(warp(source, target, source), target, atol=1e-9)


def test_a_template_comes_to_lie_on_the_surface_tooth_on_tooth(base: Jaw) -> None:
    assert base.face_labels is not None
    template = Template.of(base.mesh, base.face_labels)
    moved = base.mesh.vertices + 0.2 * np.sin(base.mesh.vertices / 8)
    found = fit(template, moved, Target.of(base.mesh, base.face_labels))
    assert 0.93 < found.covered.mean() < 1  # but for the open edge
    assert 1e3 * base.mesh.closest(found.vertices[found.covered])[0].max() < 1e-3
    slid = np.linalg.norm(found.vertices - base.mesh.vertices, axis=1)
    assert 0 < np.median(slid) < 0.15
    tooth = base.mesh.submesh(base.tooth_faces(34))
    inner = template.inner[34]
    assert tooth.closest(found.vertices[inner[found.covered[inner]]])[0].max() < 1e-6


# The file


def test_a_model_is_stored_and_read_back(tmp_path: Path, model: ShapeModel) -> None:
    write_shape_model(tmp_path, model)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mean.json", "mean.ply", "modes.npz", "shape.json"]
    again = read_shape_model(tmp_path)
    assert again.names == model.names
    assert again.log == model.log
    assert np.allclose(again.scores, model.scores)
    one, two = model.sample([1.5, -1.0]), again.sample([1.5, -1.0])
    assert two.mesh.closest(one.mesh.vertices)[0].max() < 1e-4
    assert two.teeth == one.teeth
    for label, point in one.landmarks.items():
        assert np.allclose(two.landmarks[label].position, point.position, atol=1e-6)


def test_a_broken_model_is_refused(tmp_path: Path, model: ShapeModel) -> None:
    write_shape_model(tmp_path, model)
    modes = tmp_path / "modes.npz"
    modes.write_bytes(modes.read_bytes()[:-2000])
    with pytest.raises(InputError, match=r"modes\.npz.*make the shape model again"):
        read_shape_model(tmp_path)
    modes.unlink()
    with pytest.raises(InputError, match=r"modes\.npz.*no such file"):
        read_shape_model(tmp_path)


def test_a_model_that_was_not_finished_is_refused(tmp_path: Path, model: ShapeModel) -> None:
    write_shape_model(tmp_path, model)
    (tmp_path / "shape.json").unlink()
    with pytest.raises(InputError, match=r"shape\.json.*no such file"):
        read_shape_model(tmp_path)


def test_pictures_of_a_model(tmp_path: Path, model: ShapeModel) -> None:
    save_modes_picture(tmp_path / "modes.png", model, modes=1)
    save_variance_picture(tmp_path / "variance.png", model)
    picture = cv2.imread(str(tmp_path / "modes.png"))
    assert picture.shape[1] > 2 * picture.shape[0]
    minus, mean, plus = np.array_split(picture[:, : int(0.91 * picture.shape[1])].astype(float), 3, axis=1)
    # The mean is drawn in plaster, what departs from it in blue and orange.
    colorful = [np.mean(np.ptp(part, axis=2) > 60) for part in (minus, mean, plus)]
    assert colorful[1] < 0.2 * min(colorful[0], colorful[2])
    assert (tmp_path / "variance.png").stat().st_size > 2000


def test_smoothing_keeps_constants_and_spreads_as_far_as_it_says(base: Jaw) -> None:
    assert base.face_labels is not None
    template = Template.of(base.mesh, base.face_labels)
    everywhere = np.ones(len(base.mesh.vertices))
    constant = np.tile([1.0, -2.0, 3.0], (len(everywhere), 1))
    assert np.allclose(template.smooth(constant, everywhere, 1.0), constant)
    assert np.allclose(
        template.smooth(constant, (np.arange(len(everywhere)) % 2).astype(float), 1.0), constant, atol=1e-3
    )
    # A step across a flat place: its slope is that of a Gaussian of the width that was asked for.
    x = base.mesh.vertices[:, 0]
    for sigma_mm in (1.0, 2.0):
        step = np.repeat((x > 0).astype(float)[:, None], 3, axis=1)
        flat = np.abs(base.mesh.vertex_normals[:, 0]) < 0.2
        near = flat & (np.abs(x) < 0.5 * sigma_mm)
        slope = np.polyfit(x[near], template.smooth(step, everywhere, sigma_mm)[near, 0], 1)[0]
        assert 0.7 < slope * sigma_mm * np.sqrt(2 * np.pi) < 1.4
