from functools import cache

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings

from builders import any_pose, joined, moved, sphere
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import RegistrationOptions, fit, refine, register
from cuspid.evaluation.search import SearchOptions
from cuspid.geometry import Rigid3
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from horseshoe import horseshoe
from strategies import rigid3s
from synthetic_scene import height_field

FAST = RegistrationOptions(search=SearchOptions(targets=1500, candidates=200), samples=10_000)


@cache
def jaw() -> Jaw:
    return horseshoe()


@cache
def surface() -> SignedDistance:
    return SignedDistance(jaw().mesh)


def error_um(found: Rigid3, true: Rigid3, points: np.ndarray) -> float:
    return 1000 * float(np.linalg.norm(found.apply(points) - true.apply(points), axis=1).max())


def around_tooth(fdi: int, radius_mm: float) -> Mesh:
    mesh = jaw().mesh
    centre = mesh.face_centres[jaw().tooth_faces(fdi)].mean(axis=0)
    return mesh.submesh(np.linalg.norm(mesh.face_centres - centre, axis=1) < radius_mm)


def noisy(mesh: Mesh, sd_mm: float) -> Mesh:
    noise = np.random.default_rng(5).normal(scale=sd_mm, size=len(mesh.vertices))
    return Mesh(mesh.vertices + noise[:, None] * mesh.vertex_normals, mesh.faces)


def test_an_identical_surface_is_laid_exactly():
    scan_from_reference = any_pose(1, 200)
    scan = jaw().mesh.transformed(scan_from_reference)
    found = register(scan, surface(), FAST, rng=np.random.default_rng(0))
    assert error_um(found.reference_from_scan, scan_from_reference.inverse(), scan.vertices) < 0.1
    assert found.overlap == 1
    assert found.notes == ()
    assert abs(found.scale - 1) < 1e-7


@pytest.mark.long
@pytest.mark.parametrize(("fdi", "seed"), [(46, 3), (31, 4), (35, 5)])
def test_a_noisy_tooth_finds_its_place_in_the_arch(fdi: int, seed: int):
    scan_from_reference = any_pose(seed, 200)
    scan = noisy(around_tooth(fdi, 8.0), 0.01).transformed(scan_from_reference)
    found = register(scan, surface(), FAST, rng=np.random.default_rng(0))
    assert 0.01 < error_um(found.reference_from_scan, scan_from_reference.inverse(), scan.vertices) < 5
    assert 4 < found.rms_um < 10
    assert found.notes == ()


def test_a_scan_larger_than_its_reference_is_laid_too():
    scan_from_reference = any_pose(6, 200)
    scan = jaw().mesh.transformed(scan_from_reference)
    found = register(scan, SignedDistance(around_tooth(44, 10.0)), FAST, rng=np.random.default_rng(0))
    assert error_um(found.reference_from_scan, scan_from_reference.inverse(), scan.vertices) < 1


@settings(max_examples=10, deadline=None)
@given(rigid3s())
def test_refinement_undoes_a_small_motion(motion: Rigid3):
    small = Rigid3.from_rotation_vector(motion.rotation_vector / 60, motion.translation / 200)
    points = small.apply(jaw().mesh.sample(2000, np.random.default_rng(0))[0])
    found = refine(points, surface(), Rigid3.identity(), RegistrationOptions())
    assert error_um(found, small.inverse(), points) < 0.1


@pytest.mark.parametrize("scale", [0.998, 1.001])
def test_scale_is_measured_but_never_applied(scale: float):
    mesh = jaw().mesh
    points = Mesh(scale * mesh.vertices, mesh.faces).sample(20_000, np.random.default_rng(0))[0]
    found = fit(points, surface(), Rigid3.identity(), RegistrationOptions())
    assert 1e6 * (found.scale - scale) == pytest.approx(0, abs=1)
    rotation = found.reference_from_scan.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert found.rms_um > 5


def test_floating_pieces_do_not_move_the_alignment():
    scan = joined(jaw().mesh, moved(sphere(3.0, 3), (0, 0, 15.0)))
    points = scan.sample(20_000, np.random.default_rng(0))[0]
    start = Rigid3.from_rotation_vector(np.array([0.0, 0.02, 0.01]), np.array([0.2, -0.2, 0.1]))
    found = fit(points, surface(), start, RegistrationOptions())
    assert error_um(found.reference_from_scan, Rigid3.identity(), points) < 0.1
    assert 0.9 < found.overlap < 0.995


@pytest.mark.long
def test_two_poses_that_fit_alike_are_told_and_chosen_from_alike():
    box = trimesh.creation.box((10.0, 6.0, 4.0)).subdivide_to_size(0.5)
    mesh = Mesh(np.asarray(box.vertices), np.asarray(box.faces))
    scan = mesh.transformed(any_pose(1, 200))
    found, again = (register(scan, SignedDistance(mesh), FAST, rng=np.random.default_rng(0)) for _ in range(2))
    np.testing.assert_array_equal(found.reference_from_scan.matrix, again.reference_from_scan.matrix)
    assert any("another pose" in note for note in found.notes)
    assert found.rms_um < 0.01


@pytest.mark.long
def test_surfaces_that_do_not_belong_together_are_refused():
    with pytest.raises(InputError, match="same teeth, in the same unit"):
        register(sphere(25.0), surface(), FAST, rng=np.random.default_rng(0))


def flaring(mesh: Mesh, share: float, most_mm: float) -> Mesh:
    """Outwards at the rim, as walls are that few cameras see: the more, the farther from the middle."""
    radius = np.linalg.norm(mesh.vertices - mesh.vertices.mean(axis=0), axis=1)
    rim = np.quantile(radius, 1 - share)
    off_mm = most_mm * np.clip((radius - rim) / (radius.max() - rim), 0, 1)
    return Mesh(mesh.vertices + off_mm[:, None] * mesh.vertex_normals, mesh.faces)


@pytest.mark.parametrize("most_mm", [0.05, 0.1, 0.2])
def test_a_flaring_rim_neither_moves_nor_swells_the_rest(most_mm: float):
    scan = flaring(noisy(around_tooth(46, 8.0), 0.003), 0.15, most_mm)
    found = fit(scan.sample(20_000, np.random.default_rng(0))[0], surface(), Rigid3.identity(), FAST)
    assert error_um(found.reference_from_scan, Rigid3.identity(), scan.vertices) < 3
    assert abs(found.scale - 1) < 2e-4


@pytest.mark.long
def test_a_plate_that_slides_but_for_two_posts_finds_its_place():
    """All that holds it are their walls, a thirtieth of it, which lie far beyond the usual errors at first."""

    def posts(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 5 - sum(0.3 * (1 + np.tanh((0.7 - np.hypot(x - a, y - b)) / 0.02)) for a, b in ((-2, -1), (1.5, 1.2)))

    plate = height_field(posts, count=600)
    points, surface = noisy(plate, 0.0005).sample(20_000, np.random.default_rng(0))[0], SignedDistance(plate)
    found = fit(points, surface, Rigid3(np.eye(3), np.array([0.3, -0.15, 0])), FAST)
    assert error_um(found.reference_from_scan, Rigid3.identity(), plate.vertices) < 0.5


def mirrored(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices * [1.0, 1.0, -1.0], mesh.faces[:, ::-1])


@pytest.mark.long
def test_a_mirror_image_is_named():
    """An arch that is nearly its own mirror image is laid onto the other side; a part of it is refused."""
    scan = mirrored(jaw().mesh).transformed(any_pose(2, 100))
    found = register(scan, surface(), FAST, rng=np.random.default_rng(0))
    assert "the scan is a mirror image of the reference" in found.notes[0]
    right = register(noisy(jaw().mesh, 0.12), surface(), FAST, rng=np.random.default_rng(0))
    assert not any("mirror" in note for note in right.notes)


@pytest.mark.long
def test_a_bad_scan_is_no_mirror_image():
    bad = jaw().mesh.vertices + 0.3 * np.sin(jaw().mesh.vertices[:, [1, 2, 0]] / 2)
    found = register(Mesh(bad, jaw().mesh.faces), surface(), FAST, rng=np.random.default_rng(0))
    assert not any("mirror" in note for note in found.notes)
