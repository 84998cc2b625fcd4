"""What real teeth bear follows from their shape, and stays on the teeth; gums are stippled where real ones are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from builders import plate, sphere
from cuspid.geometry import Rigid3
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.simulation import raycast
from cuspid.simulation.appearance import APPEARANCES, GRADIENT_NOISE_SD, gradient_noise, palette
from cuspid.simulation.marks import Marks, hollow_mm, natural_marks, no_marks
from cuspid.simulation.optics import Optics
from cuspid.simulation.raycast import Scene, lamps, radiance
from plain_scene import lit
from synthetic_scene import height_field

BALL = sphere(4.0, subdivisions=3)


@given(st.floats(0.3, 3), st.floats(0.1, 10), st.integers(0, 100))
def test_a_ball_is_hollow_from_inside_only_and_as_much_as_its_curvature_says(
    length_mm: float, scale: float, seed: int
) -> None:
    """Spread along a ball of radius R, its coordinates shrink by 1 + 2 (l / R)^2, wherever it lies."""
    shift = np.random.default_rng(seed).uniform(-100, 100, 3)
    ball = Mesh(scale * BALL.vertices + shift, BALL.faces)
    inside = Mesh(ball.vertices, ball.faces[:, ::-1])
    ratio = 2 * (length_mm / 4.0) ** 2
    depth = scale * 4.0 * ratio / (1 + ratio)
    assert hollow_mm(ball, scale * length_mm) == pytest.approx(-depth, rel=0.1)
    assert hollow_mm(inside, scale * length_mm) == pytest.approx(depth, rel=0.1)


def test_a_plane_is_not_hollow_and_a_groove_is() -> None:
    inner = np.abs(plate(5.0, 3.0, 60).vertices[:, :2]).max(axis=1) < 1.5
    assert np.abs(hollow_mm(plate(5.0, 3.0, 60), 0.3))[inner].max() < 1e-4
    groove = height_field(lambda x, y: 5 + 0.3 * np.exp(-((x / 0.2) ** 2)), count=121)
    x, hollow = groove.vertices[:, 0], hollow_mm(groove, 0.3)
    far = (np.abs(groove.vertices[:, :2]).max(axis=1) < 2.5) & (np.abs(x) > 1.5)
    assert hollow[np.abs(x) < 0.05].min() > 0.1 > 0.01 > np.abs(hollow[far]).max()


@pytest.fixture(scope="module")
def marked(coarse_phantom: Jaw) -> list[np.ndarray]:
    """Shares of each mark, by seed."""
    return [natural_marks(coarse_phantom, seed).shares for seed in range(8)]


@pytest.mark.long
def test_shares_are_shares_and_seeds_choose_stains_and_fillings(marked: list[np.ndarray]) -> None:
    for shares in marked:
        assert shares.min() >= 0
        assert shares.max() <= 1
        np.testing.assert_array_equal(shares[:, 0], marked[0][:, 0])  # dentine follows from the shape alone
    stains, fillings = ([shares[:, k] for shares in marked] for k in (1, 2))
    assert 0.1 < np.corrcoef(stains[0], stains[1])[0, 1] < 0.95  # in the same fissures, not in the same of them
    assert len({tuple(each) for each in fillings}) > 3


def test_stains_are_hollow_and_far_from_the_gum(coarse_phantom: Jaw, marked: list[np.ndarray]) -> None:
    mesh, labels = coarse_phantom.mesh, coarse_phantom.face_labels
    gum = np.unique(mesh.faces[labels == GUM])
    stained = np.max([shares[:, 1] for shares in marked], axis=0) > 0.3
    assert 20 < stained.sum() < 0.2 * len(stained)
    assert not stained[gum].any()
    assert hollow_mm(mesh, 0.3)[stained].min() > 0


def test_fillings_lie_on_chewing_surfaces_of_some_back_teeth(coarse_phantom: Jaw, marked: list[np.ndarray]) -> None:
    filled = dict[int, list[bool]]()
    for shares in marked:
        either = shares[:, 2] + shares[:, 3]
        assert either.max() <= 1  # one or the other
        assert not (coarse_phantom.mesh.vertex_normals[either > 0, 2] < 0.2).any()
        for tooth in coarse_phantom.teeth:
            vertices = np.unique(coarse_phantom.mesh.faces[coarse_phantom.tooth_faces(tooth)])
            filled.setdefault(tooth, []).append(bool((either[vertices] > 0.5).any()))
    assert not any(any(each) for tooth, each in filled.items() if tooth % 10 < 4)
    share = np.mean([each for tooth, each in filled.items() if tooth % 10 >= 4])
    assert 0.12 < share < 0.4
    kinds = [np.max([shares[:, k].max() for shares in marked]) for k in (2, 3)]
    assert min(kinds) > 0.9


def test_marks_replace_the_colour_of_teeth_and_leave_the_gum(
    coarse_phantom: Jaw, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The topmost hides those below; without a mark on it, a tooth is as it was."""
    tooth = coarse_phantom.mesh.vertices[np.unique(coarse_phantom.mesh.faces[coarse_phantom.tooth_faces(46)])]
    pose = Rigid3(np.diag([1.0, -1.0, -1.0]), np.array([-tooth[0, 0], tooth[0, 1], tooth[:, 2].max() + 5]))
    camera, rig_from_jaw = lit().rig[lit().rig.names[0]], lamps(lit(), "all", pose)
    matte = replace(APPEARANCES["natural"].enamel, reflectance=0.0)

    def seen(marks: Marks) -> np.ndarray:
        monkeypatch.setattr(raycast, "natural_marks", lambda jaw, seed: marks)
        look = replace(APPEARANCES["natural"], enamel=matte)
        scene = Scene(jaw=coarse_phantom, handpiece=lit(), appearance=look, supersampling=1)
        return radiance(scene, camera.camera, camera.cam_from_rig @ pose, rig_from_jaw)

    count = len(coarse_phantom.mesh.vertices)
    colours, none = np.array([[0.9, 0.1, 0.2], [0.0, 0.0, 0.0]]), np.zeros((count, 2), np.float32)
    smooth = np.zeros(count, np.float32)
    bare, black, red = (seen(Marks(colours, none + np.float32(share), smooth)) for share in ((0, 0), (1, 1), (1, 0)))
    on_tooth = (black.sum(axis=2) == 0) & (bare.sum(axis=2) > 0)
    assert 0.2 < on_tooth.mean() < 1
    np.testing.assert_array_equal(black[~on_tooth], bare[~on_tooth])
    np.testing.assert_array_equal(red[~on_tooth], bare[~on_tooth])
    light = red[on_tooth] / colours[0]
    assert (bare[on_tooth] / light).min() > 0.3  # what is below is enamel again
    assert (bare[on_tooth] / light).max() < 0.9


def test_gum_is_stippled_beside_teeth_but_not_at_their_margin(coarse_phantom: Jaw) -> None:
    mesh, labels = coarse_phantom.mesh, coarse_phantom.face_labels
    share = natural_marks(coarse_phantom, 0).stippled
    teeth = np.unique(mesh.faces[labels != GUM])
    away = cKDTree(mesh.vertices[teeth]).query(mesh.vertices)[0]
    assert (share[(away < 0.4) | (away > 6)] == 0).all()
    assert (share[(away > 1) & (away < 4)] == 1).all()
    assert ((share > 0) & (share < 1)).any()
    for without in (None, np.full(len(labels), GUM)):
        assert not natural_marks(replace(coarse_phantom, face_labels=without), 0).stippled.any()


@pytest.mark.long
@pytest.mark.parametrize("scattering", [0.0, 1.0])
def test_stippling_looks_as_if_the_surface_had_that_height(scattering: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A plane with stippled normals beside a mesh that has the relief."""
    everywhere = np.ones(151**2, np.float32)
    monkeypatch.setattr(raycast, "natural_marks", lambda jaw, seed: replace(no_marks(jaw.mesh), stippled=everywhere))
    matte = replace(APPEARANCES["natural"].gum, reflectance=0.0, veins=None, dark=(0.5,) * 3, light=(0.5,) * 3)
    pose = Rigid3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 10.0]))
    camera, lights = lit().rig[lit().rig.names[0]], lamps(lit(), "all", pose)

    def seen(mesh: Mesh, stipple_mm: float) -> tuple[Scene, np.ndarray]:
        jaw = Jaw(mesh=mesh, face_labels=np.full(len(mesh.faces), GUM))
        look = replace(APPEARANCES["natural"], gum=replace(matte, stipple_mm=stipple_mm))
        optics = Optics(scattering=scattering)
        scene = Scene(jaw=jaw, handpiece=lit(), appearance=look, supersampling=1, optics=optics)
        return scene, radiance(
            scene, camera.camera, camera.cam_from_rig @ pose, lights, scene.light_from_below("all", pose)
        )

    down = plate(0.0, 3.0, 150)
    flat = Mesh(down.vertices, down.faces[:, ::-1])
    scene, stippled = seen(flat, 0.01)
    noise = scene.palette.stipple_from_jaw
    height = np.array([gradient_noise(*(noise[:, :3] @ point + noise[:, 3])) for point in flat.vertices])
    risen = flat.vertices + np.outer(0.01 * height / GRADIENT_NOISE_SD, [0, 0, 1])
    plain, relief = (seen(Mesh(vertices, flat.faces), 0.0)[1] for vertices in (flat.vertices, risen))
    on = (plain > 0).all(axis=2) & (relief > 0).all(axis=2)
    told, true = np.log(stippled[on] / plain[on]), np.log(relief[on] / plain[on])
    assert on.sum() > 5000
    for colour in range(3):
        assert np.corrcoef(told[:, colour], true[:, colour])[0, 1] > 0.95
        assert told[:, colour].std() == pytest.approx(true[:, colour].std(), rel=0.1)
    if not scattering:
        assert 0.01 < true.std() < 0.1


def test_a_square_millimetre_of_stippled_gum_has_as_many_hollows_as_were_counted() -> None:
    noise, step = palette(APPEARANCES["natural"], 0).stipple_from_jaw, 0.02
    x, y = np.meshgrid(*2 * [np.arange(-8, 8, step)])
    points = np.stack([x, y, np.zeros_like(x)], axis=-1) @ noise[:, :3].T + noise[:, 3]
    height = np.vectorize(gradient_noise)(*np.moveaxis(points, -1, 0))
    lowest = (height == minimum_filter(height, 5))[3:-3, 3:-3]
    assert lowest.sum() / (lowest.size * step**2) == pytest.approx(2.6, rel=0.08)


def test_lone_vertices_and_flat_teeth_do_no_harm() -> None:
    """Meshes of users have both."""
    vertices = np.concatenate([BALL.vertices, [[9.0, 9, 9], [1, 0, 8], [1, 3, 8], [1, 3, 9]]])
    faces = np.concatenate([BALL.faces, [[0, 1, 1], [643, 644, 645]]])
    labels = np.concatenate([np.full(len(BALL.faces), 47), [GUM, 46]])
    for seed in range(20):
        marks = natural_marks(Jaw(mesh=Mesh(vertices, faces), face_labels=labels), seed)
        shares = marks.shares
        assert np.isfinite(shares).all()
        assert np.isfinite(marks.stippled).all()
        assert shares.min() >= 0
        assert shares.max() <= 1
