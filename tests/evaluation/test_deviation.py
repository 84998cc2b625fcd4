import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from builders import sphere
from cuspid.evaluation.crown import OpenCrown, open_parts
from cuspid.evaluation.deviation import EvaluationOptions, evaluate, statistics
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import RegistrationOptions
from cuspid.evaluation.search import SearchOptions
from cuspid.geometry import Rigid3
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.trueness import Trueness
from cuspid.model.visibility import openness
from cuspid.runtime.errors import InputError
from horseshoe import horseshoe

IN_PLACE = EvaluationOptions(align=False, samples=40_000, registration=RegistrationOptions(samples=10_000))
ALIGNED = replace(
    IN_PLACE,
    align=True,
    registration=RegistrationOptions(samples=10_000, search=SearchOptions(targets=2500, candidates=300)),
)


@cache
def jaw() -> Jaw:
    return horseshoe()


def trueness(
    scan: Mesh,
    options: EvaluationOptions = IN_PLACE,
    *,
    reference: Jaw | None = None,
    scannable: np.ndarray | None = None,
) -> Trueness:
    return evaluate(scan, reference or jaw(), options, scannable=scannable, rng=np.random.default_rng(0))


def displaced(mesh: Mesh, offset: np.ndarray) -> Mesh:
    return replace(mesh, vertices=mesh.vertices + offset)


def with_plate(mesh: Mesh, centre: tuple[float, float, float], size_mm: float = 4.0) -> Mesh:
    """The mesh and a floating square, facing up."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size_mm / 2 + centre
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + len(mesh.vertices)
    return Mesh(np.concatenate([mesh.vertices, corners]), np.concatenate([mesh.faces, faces]))


# Signed distances


@given(st.integers(0, 2**32 - 1))
def test_signed_distance_to_a_box_is_the_analytic_one(seed: int):
    box = trimesh.creation.box((4.0, 6.0, 8.0))
    surface = SignedDistance(Mesh(np.asarray(box.vertices), np.asarray(box.faces)))
    points = np.random.default_rng(seed).uniform(-6, 6, (50, 3))
    beyond = np.abs(points) - [2.0, 3.0, 4.0]
    expected = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
    closest = surface.closest_points(points)
    np.testing.assert_allclose(closest.signed_mm, expected, atol=1e-12)
    assert not closest.on_border.any()
    step = 1e-6
    grown = surface.closest_points(points + step * closest.directions).signed_mm - closest.signed_mm
    np.testing.assert_allclose(grown[np.abs(expected) > 0.01], step, rtol=1e-3)


def test_what_lies_past_a_border_is_told_from_what_lies_over_it():
    square = SignedDistance(
        Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    )
    points = np.array([[0.5, 0.5, 0.3], [0.5, 0.5, -0.3], [1.2, 0.5, 0.1], [1.1, 0.5, 0.2], [1.2, 1.2, 0.0]])
    closest = square.closest_points(points)
    np.testing.assert_allclose(closest.signed_mm[:2], [0.3, -0.3])
    assert closest.on_border.tolist() == [False, False, True, True, True]
    assert closest.past_border.tolist() == [False, False, True, False, True]


def test_an_edge_of_one_face_is_a_border_and_of_three_none():
    fins = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    surface = SignedDistance(Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0], [0.5, 0, 1]]), fins))
    closest = surface.closest_points(np.array([[0.5, 0, -0.2], [0.5, 0.2, -0.2], [0.5, 1.1, 0.0], [0.2, 0.9, 0.0]]))
    assert closest.on_border.tolist() == [False, False, True, True]


def test_many_points_are_answered_as_each_of_them_is(monkeypatch):
    surface = SignedDistance(sphere(5.0, subdivisions=2).submesh(np.arange(320) % 5 > 0))
    points = np.random.default_rng(0).uniform(-6, 6, (50, 3))
    whole = surface.closest_points(points)
    monkeypatch.setattr("cuspid.evaluation.distance._BLOCK", 7)
    blocks = surface.closest_points(points)
    for name in ("signed_mm", "faces", "directions", "on_border", "past_border"):
        np.testing.assert_array_equal(getattr(blocks, name), getattr(whole, name))
    assert len(surface.closest_points(np.empty((0, 3))).faces) == 0


# Statistics


def test_statistics_of_a_normal_distribution():
    signed_mm = np.random.default_rng(0).normal(0.005, 0.02, 200_000)
    found = statistics(signed_mm)
    assert found.count == 200_000
    assert found.signed_mean_um == pytest.approx(5, abs=0.2)
    assert found.std_um == pytest.approx(20, rel=0.01)
    assert found.rms_um == pytest.approx(np.hypot(5, 20), rel=0.01)
    assert found.half_p90_p10_um == pytest.approx(1.2816 * 20, rel=0.01)
    assert found.std_abs_um == pytest.approx(np.sqrt(found.rms_um**2 - found.mean_abs_um**2), rel=1e-6)
    assert 0 <= found.min_um < found.mean_abs_um < found.max_um
    assert found.mean_abs_um == pytest.approx(np.abs(1000 * signed_mm).mean())
    assert found.max_um == pytest.approx(1000 * np.abs(signed_mm).max())
    assert np.mean(np.abs(1000 * signed_mm) <= found.p95_um) == pytest.approx(0.95, abs=1e-4)


# Known deformations


@pytest.mark.parametrize("offset_um", [20.0, -35.0])
def test_an_offset_along_the_normals_is_the_signed_mean(offset_um: float):
    mesh = jaw().mesh
    found = trueness(displaced(mesh, offset_um / 1000 * mesh.vertex_normals))
    for direction in (found.accuracy, found.completeness):
        assert direction.signed_mean_um == pytest.approx(offset_um, abs=1)
        assert direction.mean_abs_um == pytest.approx(abs(offset_um), abs=1)
        assert direction.std_um < 5
    assert np.nanmedian(found.deviation_um) == pytest.approx(offset_um, abs=0.5)
    assert found.completeness_pct["50"] > 99.9


def test_noise_is_measured_as_what_it_is():
    mesh = jaw().mesh
    noise = np.random.default_rng(1).normal(0, 0.01, len(mesh.vertices))
    found = trueness(displaced(mesh, noise[:, None] * mesh.vertex_normals))
    assert np.mean(np.abs(found.deviation_um)) == pytest.approx(10 * np.sqrt(2 / np.pi), rel=0.1)
    # Between the vertices noise averages out: a uniform point of a triangle has half the variance of its corners.
    assert found.accuracy.std_um == pytest.approx(10 * np.sqrt(0.5), rel=0.1)
    assert abs(found.accuracy.signed_mean_um) < 0.5


@pytest.mark.long
def test_what_a_scan_expects_of_itself_is_held_against_it():
    rng = np.random.default_rng(3)
    mesh = jaw().mesh
    sigma_um = rng.uniform(2, 10, len(mesh.vertices))
    along = 1e-3 * sigma_um * rng.standard_normal(len(mesh.vertices))
    noisy = replace(mesh, vertices=mesh.vertices + along[:, None] * mesh.vertex_normals)
    for factor, (one, two) in {1.0: (68.3, 95.4), 2.0: (95.4, 100.0), 0.5: (38.3, 68.3)}.items():
        found = evaluate(noisy, jaw(), IN_PLACE, sigma_um=factor * sigma_um).within_sigmas_pct
        assert found["1"] == pytest.approx(one, abs=3)
        assert found["2"] == pytest.approx(two, abs=3)
    assert trueness(noisy).within_sigmas_pct is None


@pytest.mark.long
def test_a_scaled_scan_from_any_pose_has_its_scale_error_and_nothing_is_scaled_away():
    mesh = jaw().mesh
    scan = Mesh(1.001 * mesh.vertices, mesh.faces).transformed(
        Rigid3.from_rotation_vector(np.array([1.0, -2.0, 0.5]), np.array([30.0, 200.0, -70.0]))
    )
    found = trueness(scan, ALIGNED)
    assert found.scale_error_ppm == pytest.approx(1000, abs=20)
    assert 5 < found.accuracy.mean_abs_um < 30
    laid = scan.transformed(found.reference_from_scan)
    np.testing.assert_allclose(laid.face_areas.sum(), 1.001**2 * mesh.face_areas.sum(), rtol=1e-9)


def test_half_a_scan_is_half_complete():
    mesh = jaw().mesh
    right = mesh.face_centres[:, 0] > 0
    found = trueness(mesh.submesh(right))
    share = 100 * mesh.face_areas[right].sum() / mesh.face_areas.sum()
    for within in ("50", "100", "200"):
        assert found.completeness_pct[within] == pytest.approx(share, abs=1.5)
    assert found.accuracy.max_um < 1e-3
    assert set(found.per_tooth) == {41, 42, 43, 44, 45, 46, 47}
    assert found.per_tooth_completeness_pct[36]["200"] == 0
    assert found.inter_molar_error_um is None
    assert found.inter_canine_error_um is None


def test_a_crop_takes_what_was_not_scanned_out_of_the_completeness():
    mesh = jaw().mesh
    right = mesh.face_centres[:, 0] > 0
    found = trueness(mesh.submesh(right), replace(IN_PLACE, crop_mm=0.5))
    assert found.completeness_pct["50"] > 95
    assert found.scannable_pct == pytest.approx(100 * mesh.face_areas[right].sum() / mesh.face_areas.sum(), abs=3)
    assert any("0.5 mm from the scan" in note for note in found.notes)


def test_a_tooth_that_stands_far_off_is_still_reported():
    mesh, labels = jaw().mesh, jaw().face_labels
    assert labels is not None
    moved = np.zeros(len(mesh.vertices))
    moved[np.unique(mesh.faces[labels == 46])] = 0.6
    found = trueness(displaced(mesh, moved[:, None] * mesh.vertex_normals))
    assert found.per_tooth[46].mean_abs_um > 300
    assert found.per_tooth[36].mean_abs_um < 1
    assert 46 not in found.drift_um
    assert found.inter_molar_error_um is not None  # of the second molars


# Distances across the arch


def widened(per_side_um: float) -> Mesh:
    """The jaw with its halves pushed apart, smoothly at the front."""
    mesh = jaw().mesh
    return displaced(mesh, per_side_um / 1000 * np.tanh(mesh.vertices[:, :1] / 4) * np.array([1.0, 0, 0]))


@pytest.mark.parametrize("per_side_um", [40.0, -25.0])
def test_widening_is_the_error_of_the_distances_across_the_arch(per_side_um: float):
    found = trueness(widened(per_side_um))
    assert found.inter_molar_error_um == pytest.approx(2 * per_side_um, abs=2)
    assert found.inter_canine_error_um == pytest.approx(2 * per_side_um, abs=6)


def test_drift_grows_along_the_arch_from_the_first_tooth():
    mesh = jaw().mesh
    turn = np.deg2rad(0.15) * (25 - mesh.vertices[:, 0]) / 50
    x, y, z = (mesh.vertices - [25.0, -24, 0]).T
    bent = np.stack([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, z], axis=1)
    found = trueness(Mesh(bent + [25.0, -24, 0], mesh.faces))
    assert list(found.drift_um) == [47, 46, 45, 44, 43, 42, 41, 31, 32, 33, 34, 35, 36, 37]
    assert found.drift_um[47] < 5
    assert 20 < found.drift_um[37] < 200
    assert found.drift_um[37] > 3 * found.drift_um[45]


# What is evaluated


@cache
def crown_side() -> np.ndarray:
    return jaw().mesh.face_centres[:, 2] > 1.0


def test_what_could_not_be_seen_is_not_missed():
    mesh = jaw().mesh
    scan = mesh.submesh(crown_side())
    evaluated = trueness(scan, scannable=crown_side())
    assert evaluated.completeness_pct["50"] > 99.5
    assert evaluated.scannable_pct == pytest.approx(100 * mesh.face_areas[crown_side()].sum() / mesh.face_areas.sum())
    assert trueness(scan).completeness_pct["50"] == pytest.approx(evaluated.scannable_pct, abs=3)


def test_errors_over_unseen_surface_are_left_out_only_near_it():
    mesh = jaw().mesh
    clean = trueness(mesh, scannable=crown_side())
    assert clean.accuracy.max_um < 1e-3
    assert np.isnan(clean.deviation_um[mesh.vertices[:, 2] < 0]).all()
    near = trueness(with_plate(mesh, (22.0, -10.0, -6.3)), scannable=crown_side())
    assert near.accuracy.max_um < 1
    far = trueness(with_plate(mesh, (22.0, -10.0, -8.0)), scannable=crown_side())
    assert far.accuracy.max_um == pytest.approx(2000, rel=0.05)


def square(size_mm: float) -> Mesh:
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * size_mm / 2
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def test_a_scan_that_shows_more_than_the_reference_is_wrong_only_where_the_reference_is_all_there_was():
    reference, all_of_it = Jaw(mesh=square(10.0)), np.ones(2, dtype=bool)
    more = trueness(square(13.0), reference=reference)
    assert more.accuracy.max_um < 1e-9
    (past,) = re.findall(r"([\d.]+) % past an open border", " ".join(more.notes))
    assert float(past) == pytest.approx(100 * (1 - (10 / 13) ** 2), abs=1)
    strict = trueness(square(13.0), reference=reference, scannable=all_of_it)
    assert strict.accuracy.max_um == pytest.approx(1500 * np.sqrt(2), rel=0.03)
    frayed = trueness(square(10.6), reference=reference, scannable=all_of_it)
    assert frayed.accuracy.max_um < 1e-9


def test_what_floats_over_the_reference_counts_with_and_without_a_mask():
    mesh = jaw().mesh
    top = mesh.vertices[:, 2].max()
    scan = with_plate(mesh, (22.0, -10.0, top + 3.0))
    for mask in (None, crown_side()):
        assert trueness(scan, scannable=mask).accuracy.max_um > 3000


def test_insides_and_base_can_be_left_out():
    mesh = jaw().mesh
    found = trueness(mesh.submesh(mesh.face_centres[:, 2] > -2), replace(IN_PLACE, min_openness=0.1))
    assert 40 < found.scannable_pct < 95
    assert (
        found.completeness_pct["50"] > trueness(mesh.submesh(mesh.face_centres[:, 2] > -2)).completeness_pct["50"] + 3
    )


# The whole crown


@cache
def open_crown_of_jaw() -> OpenCrown:
    labels = jaw().face_labels
    assert labels is not None
    return OpenCrown(mesh=jaw().mesh, parts=open_parts(jaw().mesh, labels))


def crowned(scan: Mesh, scannable: np.ndarray | None = None) -> Trueness:
    crown = open_crown_of_jaw()
    return evaluate(scan, jaw(), IN_PLACE, scannable=scannable, crown=crown, rng=np.random.default_rng(0))


def test_the_open_crown_is_tooth_by_tooth_what_the_sky_sees():
    mesh, parts = jaw().mesh, open_crown_of_jaw().parts
    assert np.all((parts == 0) | (parts == jaw().face_labels))
    faces = np.flatnonzero(jaw().tooth_faces(46))
    open_share = openness(mesh, mesh.face_centres[faces], mesh.face_normals[faces])
    assert np.mean((parts[faces] == 46) == (open_share >= 0.05)) > 0.95


def test_what_no_camera_could_see_of_a_crown_is_missed_beside_what_could_be_seen():
    mesh, tooth = jaw().mesh, jaw().tooth_faces(46)
    upper = tooth & (mesh.face_centres[:, 2] > 3.5)
    found = crowned(mesh.submesh(upper), scannable=upper)
    assert found.completeness_pct["50"] > 99.5
    assert found.crown is not None
    assert found.crown.teeth == (46,)
    share = 100 * mesh.face_areas[upper & (open_crown_of_jaw().parts == 46)].sum() / found.crown.open_mm2
    assert 20 < share < 95
    assert found.crown.completeness_pct["50"] == pytest.approx(share, abs=2)
    assert found.crown.per_tooth_pct[46] == found.crown.completeness_pct


def test_teeth_that_the_scan_was_not_meant_for_do_not_count_over_all():
    mesh = jaw().mesh
    whole, half = jaw().tooth_faces(46), jaw().tooth_faces(47) & (mesh.face_centres[:, 2] > 5)
    for scannable in (whole | half, None):
        crown = crowned(mesh.submesh(whole | half), scannable).crown
        assert crown is not None
        assert crown.teeth == (46,)
        assert crown.completeness_pct["200"] > 99
        assert 0 < crown.per_tooth_pct[47]["200"] < 75
        assert 31 not in crown.per_tooth_pct


def test_a_tooth_that_could_be_seen_but_was_lost_counts():
    mesh = jaw().mesh
    both = jaw().tooth_faces(46) | jaw().tooth_faces(36)
    crown = crowned(mesh.submesh(jaw().tooth_faces(46)), both).crown
    assert crown is not None
    assert crown.teeth == (36, 46)
    assert crown.per_tooth_pct[36]["200"] < 5
    assert 30 < crown.completeness_pct["200"] < 70


def test_without_crowns_in_reach_nothing_is_said_of_them():
    mesh = jaw().mesh
    below = mesh.face_centres[:, 2] < -2
    assert crowned(mesh.submesh(below), below).crown is None
    assert trueness(mesh).crown is None


def test_in_everything_counts_also_what_was_scanned_where_nothing_could_be_seen():
    mesh = jaw().mesh
    raised = displaced(mesh, 0.1 * (mesh.vertices[:, 2:] < 0.5) * mesh.vertex_normals)
    found = trueness(raised, scannable=crown_side())
    assert found.accuracy.mean_abs_um < 5
    assert found.everything.mean_abs_um > 20
    assert found.everything.count > found.accuracy.count
    assert trueness(raised).everything == trueness(raised).accuracy


def test_a_mask_of_another_reference_is_refused():
    with pytest.raises(InputError, match=r"has 3 faces, the reference \d+; give the reference"):
        trueness(jaw().mesh, scannable=np.ones(3, dtype=bool))
    with pytest.raises(InputError, match="no face of the reference is left to evaluate"):
        trueness(jaw().mesh, scannable=np.zeros(len(jaw().mesh.faces), dtype=bool))
