"""The path follows the arch, overlaps as measured, stays clear of the jaw, and trembles as asked."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import essential_four, six_cameras, twelve_cameras
from cuspid.model.arch_curve import ArchCurve, arch_curve
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, Rig
from cuspid.model.room import Room
from cuspid.model.visibility import VisibilityOptions, scannable_faces
from cuspid.runtime.errors import InputError
from cuspid.simulation.path.hand import HandMotion, hand_motion
from cuspid.simulation.path.legs import steady_path, there_and_back
from cuspid.simulation.path.overlap import image_overlap
from cuspid.simulation.path.scan import ScanPath, ScanPathOptions, plan_scan_path, steady_poses

STILL = ScanPathOptions(tooth=46, jitter_mm=0.0, jitter_deg=0.0)


def plan(jaw: Jaw, options: ScanPathOptions, handpiece: Handpiece | None = None, seed: int = 0) -> ScanPath:
    return plan_scan_path(jaw, handpiece or twelve_cameras(), options, np.random.default_rng(seed))


def hand_of(options: ScanPathOptions, span_mm: tuple[float, float]) -> HandMotion:
    jitter = {name: getattr(options, name) for name in ("jitter_mm", "jitter_deg", "jitter_length_mm")}
    return hand_motion(span_mm, np.random.default_rng(0), **jitter)


@pytest.fixture(scope="module")
def curve(coarse_phantom: Jaw) -> ArchCurve:
    return arch_curve(coarse_phantom)


@pytest.fixture(scope="module")
def molar_path(coarse_phantom: Jaw) -> ScanPath:
    return plan(coarse_phantom, ScanPathOptions(tooth=46))


# --- the arch -----------------------------------------------------------------------------------------------------


def test_the_arch_runs_over_the_middle_of_every_tooth_from_one_end_to_the_other(
    coarse_phantom: Jaw, curve: ArchCurve
) -> None:
    order = [tooth for quadrant in ((37, 36, 35, 34, 33, 32, 31), (41, 42, 43, 44, 45, 46, 47)) for tooth in quadrant]
    places = []
    for tooth in order:
        points = coarse_phantom.mesh.face_centres[coarse_phantom.tooth_faces(tooth)]
        top = points[points[:, 2] > points[:, 2].max() - 3.0]
        gaps = np.linalg.norm(curve.points[:, :2] - top[:, :2].mean(axis=0), axis=1)
        assert gaps.min() < 1.3, tooth
        assert abs(curve.points[gaps.argmin(), 2] - points[:, 2].max()) < 1.5, tooth
        places.append(curve.lengths_mm[gaps.argmin()])
    assert np.all(np.diff(places) > 3)
    assert places[0] == pytest.approx(5.5, abs=2.5)
    assert curve.lengths_mm[-1] - places[-1] == pytest.approx(5.5, abs=2.5)


def test_the_arch_is_found_without_labels(coarse_phantom: Jaw, curve: ArchCurve) -> None:
    blind = arch_curve(replace(coarse_phantom, face_labels=None))
    gaps = np.linalg.norm(blind.points[:, None, :2] - curve.points[None, ::5, :2], axis=2).min(axis=1)
    assert np.percentile(gaps, 95) < 1.0
    assert blind.lengths_mm[-1] == pytest.approx(curve.lengths_mm[-1], abs=4.0)


def test_the_arch_moves_with_the_jaw(coarse_phantom: Jaw, curve: ArchCurve) -> None:
    moved = coarse_phantom.mesh.transformed(Rigid3(np.eye(3), np.array([7.0, -3.0, 2.0])))
    there = arch_curve(replace(coarse_phantom, mesh=moved))
    assert there.lengths_mm[-1] == pytest.approx(curve.lengths_mm[-1], abs=0.5)
    gaps = np.linalg.norm(there.points[:, None] - (curve.points[None, ::3] + [7.0, -3.0, 2.0]), axis=2).min(axis=1)
    assert np.percentile(gaps, 95) < 0.4


def test_the_handpiece_is_upright_and_its_y_axis_points_to_the_cheek(curve: ArchCurve) -> None:
    for length in np.linspace(-2, curve.lengths_mm[-1] + 2, 9):
        world_from_rig = curve.rig_from_world(float(length)).inverse()
        along, cheek, up = world_from_rig.rotation.T
        assert np.linalg.det(world_from_rig.rotation) == pytest.approx(1)
        assert up[2] > 0.95
        assert cheek[2] == pytest.approx(0, abs=1e-12)
        outward = world_from_rig.translation[:2] - curve.points[:, :2].mean(axis=0)
        assert cheek[:2] @ outward > 0
        ahead = curve.rig_from_world(float(length) + 0.5).inverse().translation - world_from_rig.translation
        assert along @ ahead == pytest.approx(0.5, abs=0.02)


def test_a_mesh_without_crowns_is_refused() -> None:
    corners = np.array([[0, 0, 0], [3.0, 0, 0], [0, 3.0, 0]])
    with pytest.raises(InputError, match="no crowns found"):
        arch_curve(Jaw(mesh=Mesh(corners, np.array([[0, 2, 1]])), face_labels=np.array([0])))


# --- the path -----------------------------------------------------------------------------------------------------


def test_a_tooth_is_scanned_with_the_images_of_the_thesis(molar_path: ScanPath) -> None:
    assert list(molar_path.rig_from_world) == [f"{k:05d}" for k in range(10)]
    assert 0.75 < molar_path.min_overlap <= molar_path.mean_overlap < 0.99


def test_cameras_look_at_the_tooth_from_about_the_working_distance(coarse_phantom: Jaw, molar_path: ScanPath) -> None:
    rig = twelve_cameras().rig
    pose = molar_path.rig_from_world["00005"]
    tooth = coarse_phantom.tooth_faces(46)
    for group in "obl":
        mounted = rig[f"{group}3"]
        world_from_cam = (mounted.cam_from_rig @ pose).inverse()
        hits = coarse_phantom.mesh.cast(world_from_cam.translation[None], world_from_cam.rotation[:, 2][None])
        assert tooth[hits.faces[0]], group
        assert 3.5 < hits.distances[0] < 7.5, group


def test_overlap_of_a_plane_is_the_closed_form() -> None:
    corners = np.array([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], dtype=float)
    plane = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    poses = [Rigid3(np.eye(3), np.array([-x, 0, 0])) for x in (0.0, 1.0, 3.0)]
    overlap = image_overlap(plane, essential_four(), poses, grid=60)
    expected = 1 - np.array([1.0, 2.0]) / (2 * 5 * np.tan(np.deg2rad(31)))
    np.testing.assert_allclose(overlap, np.tile(expected[:, None], 4), atol=1 / 60)


def test_overlap_leaves_out_what_something_hides() -> None:
    """A wall on the plane hides half of what lies behind it from the next position."""
    corners = np.array([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], dtype=float)
    wall = np.array([[1.0, -50, 0], [1.0, 50, 0], [1.0, 50, 2.0], [1.0, -50, 2.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    both = Mesh(np.concatenate([corners, wall]), np.concatenate([faces, faces + 4]))
    poses = [Rigid3(np.eye(3), np.array([-x, 0, 0])) for x in (1.0, 0.0)]
    flat, walled = (image_overlap(mesh, essential_four(), poses, 40)[0, 0] for mesh in (Mesh(corners, faces), both))
    hidden_mm = 2.0 / 3.0
    assert flat - walled == pytest.approx(hidden_mm / (2 * 5 * np.tan(np.deg2rad(31))), abs=0.04)


def test_too_few_frames_are_refused_and_more_are_taken_where_none_is_asked(coarse_phantom: Jaw) -> None:
    few = Handpiece(rig=Rig({"o1": twelve_cameras().rig["o1"]}))
    with pytest.raises(
        InputError, match=r"with 4 frames, consecutive images overlap by only \d\d%, less than 75%; raise"
    ):
        plan(coarse_phantom, ScanPathOptions(tooth=46, frames=4), few)
    dense = plan(coarse_phantom, ScanPathOptions(tooth=46, min_overlap=0.87), few)
    assert len(dense.rig_from_world) > 10
    assert dense.min_overlap > 0.87


def test_unknown_teeth_are_refused(coarse_phantom: Jaw) -> None:
    with pytest.raises(InputError, match="no tooth 11"):
        plan(coarse_phantom, ScanPathOptions(tooth=11))
    with pytest.raises(InputError, match="no labels"):
        plan(replace(coarse_phantom, face_labels=None), ScanPathOptions(tooth=46))


def test_a_handpiece_that_would_touch_the_jaw_is_lifted(coarse_phantom: Jaw, caplog: pytest.LogCaptureFixture) -> None:
    still, steady = replace(STILL, length_mm=5.0), Room(coarse_phantom.mesh, twelve_cameras().solid, 4.0)
    least = min(steady.clearance(pose)[0] for pose in steady_poses(coarse_phantom, still, 10))
    wanted = replace(still, clearance_mm=least + 0.3)
    with caplog.at_level("INFO", logger="cuspid"):
        path = plan(coarse_phantom, wanted)
    clearances = [steady.clearance(pose)[0] for pose in path.rig_from_world.values()]
    assert least + 0.3 <= min(clearances) < least + 1.0, "lifted, but not much higher than needed"
    assert "does not fit everywhere (near 4" in caplog.text


def test_what_sees_nothing_where_it_fits_is_refused(coarse_phantom: Jaw) -> None:
    with pytest.raises(InputError, match="no camera sees it in focus"):
        plan(coarse_phantom, replace(STILL, length_mm=5.0, clearance_mm=11.0), essential_four())


def with_gap(jaw: Jaw, teeth: tuple[int, ...], ridge_mm: float) -> Jaw:
    """Teeth and the gum around them cut off at a height."""
    gone = np.unique(jaw.mesh.faces[np.isin(jaw.face_labels, teeth)])
    vertices = jaw.mesh.vertices.copy()
    distance, _ = KDTree(vertices[gone, :2]).query(vertices[:, :2])
    vertices[distance < 1.5, 2] = np.minimum(vertices[distance < 1.5, 2], ridge_mm)
    return Jaw(mesh=Mesh(vertices, jaw.mesh.faces), arch=jaw.arch)


def test_the_handpiece_follows_the_gum_where_teeth_are_missing(
    coarse_phantom: Jaw, caplog: pytest.LogCaptureFixture
) -> None:
    """Held up, it would see nothing in focus there, and the scan would break."""
    ridge = coarse_phantom.mesh.bounds[1, 2] - 11.0
    options = ScanPathOptions(passes="turns", jitter_mm=0.0, jitter_deg=0.0)
    curve = arch_curve(coarse_phantom)
    whole = steady_path(coarse_phantom.mesh, curve, there_and_back((0.0,), 0.0, float(curve.lengths_mm[-1])))
    with caplog.at_level("INFO", logger="cuspid"):
        path = plan(with_gap(coarse_phantom, (34, 35, 36), ridge), options)
    assert not whole.sinks_mm.any()
    assert 5.0 < path.steady.sinks_mm.max() < 11.0
    assert 15.0 < np.count_nonzero(path.steady.sinks_mm) < 35.0, "over the gap alone"
    assert np.isfinite(path.overlap).sum(axis=1).min() >= 2
    assert "where teeth are missing, the handpiece sinks by up to" in caplog.text
    assert "fewer than two cameras see the jaw in focus" not in caplog.text


def test_a_rolled_handpiece_keeps_its_distance_over_a_gap_too(coarse_phantom: Jaw) -> None:
    jaw = with_gap(coarse_phantom, (34, 35, 36), coarse_phantom.mesh.bounds[1, 2] - 11.0)
    curve = arch_curve(jaw)
    steady = steady_path(jaw.mesh, curve, there_and_back((30.0,), 0.0, float(curve.lengths_mm[-1])))
    middle = float(steady.stations_mm[int(steady.sinks_mm.argmax())])
    world_from_rig = steady.rig_from_world(middle).inverse()
    ticks = np.linspace(-1.5, 1.5, 5)
    above = np.stack(np.meshgrid(ticks, ticks, 8.0), axis=-1).reshape(-1, 3)
    hits = jaw.mesh.cast(world_from_rig.apply(above), np.broadcast_to(-world_from_rig.rotation[:, 2], above.shape))
    assert abs(8.0 - np.median(hits.distances)) < 1.0, "the surface lies where it looks"


# --- the hand -----------------------------------------------------------------------------------------------------


def test_without_jitter_the_handpiece_rides_on_the_curve(coarse_phantom: Jaw, curve: ArchCurve) -> None:
    path = plan(coarse_phantom, STILL)
    places = np.array([pose.inverse().translation for pose in path.rig_from_world.values()])
    gaps = np.linalg.norm(places[:, None] - curve.points[None], axis=2).min(axis=1)
    assert gaps.max() < 0.06
    assert np.linalg.norm(places[-1] - places[0]) == pytest.approx(9.0, abs=0.2)


def test_jitter_has_the_asked_deviation_and_is_smooth() -> None:
    options = ScanPathOptions(jitter_mm=0.2, jitter_deg=1.0, jitter_length_mm=5.0)
    hand = hand_of(options, (0.0, 5000.0))
    np.testing.assert_allclose(hand.drift[:, 3:].std(axis=0), 0.2, rtol=0.1)
    np.testing.assert_allclose(np.rad2deg(hand.drift[:, :3].std(axis=0)), 1.0, rtol=0.1)
    step = 1.0
    places = np.array([hand.jittered_from_rig(length).translation for length in np.arange(0, 3000, step)])
    change = np.diff(places, axis=0).std()
    assert 0.02 < change < 0.2 * np.sqrt(2) * 0.4, "white noise would change by sqrt(2) of its deviation"


@pytest.mark.long
def test_the_hand_moves_the_same_whatever_the_number_of_frames(coarse_phantom: Jaw) -> None:
    few = Handpiece(rig=Rig({"o1": twelve_cameras().rig["o1"]}))
    first, second, other = (
        plan(coarse_phantom, ScanPathOptions(tooth=46, frames=frames), few, seed)
        for frames, seed in ((10, 1), (19, 1), (10, 2))
    )
    for name in ("00000", "00009"):
        later = {"00000": "00000", "00009": "00018"}[name]
        np.testing.assert_allclose(first.rig_from_world[name].matrix, second.rig_from_world[later].matrix, atol=1e-9)
        assert np.abs(first.rig_from_world[name].matrix - other.rig_from_world[name].matrix).max() > 0.01


# --- turns --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def turned_path(coarse_phantom: Jaw) -> ScanPath:
    return plan(coarse_phantom, replace(STILL, turns=3), six_cameras())


def rolls_deg(curve: ArchCurve, poses: Iterable[Rigid3]) -> np.ndarray:
    """Angle towards the cheek from a handpiece held upright over the nearest place of the curve to each pose."""
    rolls = []
    for pose in poses:
        place = pose.inverse().translation
        nearest = np.linalg.norm(curve.points[:, :2] - place[:2], axis=1).argmin()
        up = (curve.rig_from_world(float(curve.lengths_mm[nearest])).rotation @ pose.rotation.T)[:, 2]
        rolls.append(np.rad2deg(np.arctan2(up[1], up[2])))
    return np.array(rolls)


def test_one_turn_is_the_path_along_the_curve_to_the_last_bit(coarse_phantom: Jaw) -> None:
    """As planned before there were turns: a steady pose of the curve, moved by the hand, at evened places."""
    options = ScanPathOptions(tooth=46)
    curve, path = arch_curve(coarse_phantom), plan(coarse_phantom, options)
    start, end = curve.span_of(coarse_phantom.mesh.face_centres[coarse_phantom.tooth_faces(46)])
    stretch = (start + end) / 2 - 4.5, (start + end) / 2 + 4.5
    hand = hand_of(options, stretch)
    for name, at in (("00000", stretch[0]), ("00009", stretch[1])):
        expected = hand.jittered_from_rig(at) @ curve.rig_from_world(at)
        np.testing.assert_array_equal(path.rig_from_world[name].matrix, expected.matrix)


def test_three_turns_look_from_the_cheek_down_and_from_the_tongue(curve: ArchCurve, turned_path: ScanPath) -> None:
    assert list(turned_path.rig_from_world) == [f"{k:05d}" for k in range(len(turned_path.rig_from_world))]
    rolls = rolls_deg(curve, turned_path.rig_from_world.values())
    assert rolls[0] == pytest.approx(60, abs=2)
    assert rolls[-1] == pytest.approx(-60, abs=2)
    assert np.all(np.diff(rolls) < 2), "it never turns back"
    assert min(np.sum(np.abs(rolls - roll) < 2) for roll in (60, 0, -60)) >= 6


def test_the_passes_go_there_and_back_and_overlap_at_the_turns_too(turned_path: ScanPath) -> None:
    assert 0.75 < turned_path.min_overlap < 0.95
    assert len(turned_path.overlap) == len(turned_path.rig_from_world) - 1
    places = np.array([pose.inverse().translation for pose in turned_path.rig_from_world.values()])
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() < 2.5, "no jump from the end of a pass to the next"


def test_rolled_cameras_keep_the_working_distance(coarse_phantom: Jaw, turned_path: ScanPath) -> None:
    rig, distances = six_cameras().rig, []
    for pose in turned_path.rig_from_world.values():
        world_from_cam = (rig["o3"].cam_from_rig @ pose).inverse()
        hits = coarse_phantom.mesh.cast(world_from_cam.translation[None], world_from_cam.rotation[:, 2][None])
        distances.append(hits.distances[0])
    assert 4.5 < np.median(distances) < 6.2
    assert np.percentile(distances, 5) > 3.5
    assert np.percentile(distances, 80) < 7.5


def test_three_turns_of_six_see_the_sides_as_well_as_twelve(coarse_phantom: Jaw, turned_path: ScanPath) -> None:
    tooth, mesh = coarse_phantom.tooth_faces(46), coarse_phantom.mesh
    towards_cheek = mesh.face_centres[tooth].mean(axis=0) - mesh.face_centres[:, :].mean(axis=0)
    facing = mesh.face_normals[:, :2] @ towards_cheek[:2] / np.linalg.norm(towards_cheek[:2])
    sides = {"buccal": tooth & (facing > 0.8), "lingual": tooth & (facing < -0.8)}

    def shares(handpiece: Handpiece, path: ScanPath) -> dict[str, float]:
        found = scannable_faces(mesh, handpiece, path.rig_from_world.values(), VisibilityOptions())
        return {name: mesh.face_areas[mask & found].sum() / mesh.face_areas[mask].sum() for name, mask in sides.items()}

    twelve, turned = shares(twelve_cameras(), plan(coarse_phantom, STILL)), shares(six_cameras(), turned_path)
    flat = shares(six_cameras(), plan(coarse_phantom, STILL, six_cameras()))
    for name in sides:
        assert turned[name] > twelve[name] - 0.02
        assert flat[name] < 0.6 < turned[name]


def test_more_turns_are_finer_steps(curve: ArchCurve, coarse_phantom: Jaw) -> None:
    assert ScanPathOptions(turns=5, turn_deg=60.0).rolls_deg == (60, 30, 0, -30, -60)
    poses = steady_poses(coarse_phantom, replace(STILL, turns=5), 3)
    assert len(poses) == 15
    np.testing.assert_allclose(rolls_deg(curve, poses), np.repeat([60, 30, 0, -30, -60], 3), atol=2)


def test_the_hand_drifts_on_turns_too(coarse_phantom: Jaw) -> None:
    one = Handpiece(rig=Rig({"o1": six_cameras().rig["o1"]}))
    steady, jittered = (
        plan(coarse_phantom, options, one)
        for options in (replace(STILL, turns=3, frames=60), ScanPathOptions(tooth=46, turns=3, frames=60))
    )
    moved = [
        np.abs(steady.rig_from_world[name].inverse().translation - pose.inverse().translation).max()
        for name, pose in jittered.rig_from_world.items()
    ]
    assert 0.02 < np.mean(moved) < 1.5


@pytest.mark.parametrize(
    "wrong",
    [
        *({"frames": frames} for frames in (1, 0, -3)),
        *({"length_mm": length} for length in (0.0, -1.0, np.nan)),
        *({"min_overlap": share} for share in (1.0, -0.1, np.nan)),
        *({name: -0.1} for name in ("jitter_mm", "jitter_deg", "clearance_mm")),
        *({"jitter_length_mm": length} for length in (0.0, np.nan)),
    ],
)
def test_impossible_paths_are_refused_before_anything_is_made(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"scan path: .*--{next(iter(wrong)).replace('_', '-')}"):
        ScanPathOptions(**wrong)


@pytest.mark.parametrize("wrong", [{"turns": 2}, {"turns": 0}, {"turn_deg": 90.0}, {"turn_deg": 0.0}])
def test_impossible_turns_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match=r"scan path: .*turn"):
        ScanPathOptions(**wrong)
