"""What is measured on real photographs, where the answers are known: planes, spheres and boxes that were moved."""

from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import DepthMap
from cuspid.model.rig import MountedCamera

ROOT = Path(__file__).parents[2]
CAMERA = Camera.from_field_of_view(160, 120, 40.0)
AHEAD = Rigid3.identity()


@pytest.fixture(autouse=True)
def _benchmarks(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))


@pytest.fixture
def measures():
    return import_module("real_measures")


def plane(depth_mm: float, half_mm: float = 60.0) -> Mesh:
    """Facing the origin."""
    x, y = float(half_mm) * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]).T
    return Mesh(np.stack([x, y, np.full(4, float(depth_mm))], axis=1), np.array([[0, 2, 1], [0, 3, 2]]))


def ball(radius_mm: float, middle: tuple[float, float, float]) -> Mesh:
    made = trimesh.creation.icosphere(subdivisions=4, radius=radius_mm)
    return Mesh(np.asarray(made.vertices) + middle, np.asarray(made.faces, dtype=np.int64))


def box(low: list[float], high: list[float]) -> Mesh:
    made = trimesh.creation.box(bounds=[low, high])
    return Mesh(np.asarray(made.vertices), np.asarray(made.faces))


def pattern(camera: Camera, cam_from_world: Rigid3, depth_mm: float) -> np.ndarray:
    """A photograph of a plane at Z = depth with waves on it."""
    centre = cam_from_world.inverse().translation
    rays = cam_from_world.inverse().rotate(camera.rays(camera.pixel_centres()).reshape(-1, 3))
    x, y, _ = (centre + rays * ((depth_mm - centre[2]) / rays[:, 2])[:, None]).T
    level = 128 + 40 * np.sin(0.9 * x + 0.5 * np.sin(0.7 * y)) + 40 * np.cos(0.8 * y + 0.6 * np.sin(0.5 * x))
    grey = level.reshape(camera.height, camera.width).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def test_points_of_a_sphere_lie_as_far_from_another_as_it_is_larger(measures):
    points = ball(10.6, (0, 0, 50)).vertices
    found = measures.within_pct(points, ball(10.0, (0, 0, 50)), (0.5, 0.7))
    assert found == {"0.5": 0.0, "0.7": 100.0}
    assert 0.59 < measures.median_to_points_mm(points, ball(10.0, (0, 0, 50))) < 0.63


@pytest.mark.parametrize("moved_mm", [-0.8, 0.3])
def test_a_plane_is_as_far_from_a_reference_as_it_was_moved(measures, moved_mm):
    found = measures.seen_distance(plane(50 + moved_mm), plane(50, half_mm=10), CAMERA, AHEAD)
    assert found.median_mm == pytest.approx(abs(moved_mm), rel=1e-3)
    assert found.covered_pct == 100
    half = measures.seen_distance(plane(50, half_mm=5), plane(50, half_mm=10), CAMERA, AHEAD)
    assert 23 < half.covered_pct < 27
    assert half.median_mm < 1e-4


def test_points_are_seen_by_all_only_where_every_image_shows_them(measures):
    aside = Rigid3(np.eye(3), np.array([-20.0, 0, 0]))
    points = np.array([[10.0, 0, 50], [-15, 0, 50], [10, 0, -50]])
    assert measures.seen_by_all(points, {"a": (CAMERA, AHEAD), "b": (CAMERA, aside)}).tolist() == [True, False, False]


def test_a_box_tells_what_is_short_of_it_and_what_is_beyond(measures):
    limits = np.array([[0.0, 0, 0], [10, 20, 30]])
    gaps = measures.box_gaps_mm(box([0.5, 0, 0], [10, 20.4, 27]), limits)
    np.testing.assert_allclose(gaps, [[0.5, 0, 0], [0, -0.4, 3]], atol=1e-6)
    assert measures.outside_pct(box([0, 0, 0], [10, 20, 30]), limits) == 0
    far = measures.outside_pct(box([50, 0, 0], [60, 20, 30]), limits)
    assert far == 100
    assert np.isinf(measures.box_gaps_mm(box([50, 0, 0], [60, 20, 30]), limits)).all()


def test_a_mask_is_read_at_the_pixels_of_a_coarser_and_of_a_turned_map(measures):
    mask = np.zeros((120, 160), bool)
    mask[:, :80] = True
    depth = np.full((60, 80), 50, np.float32)
    depth[:, :20] = np.nan
    coarse = DepthMap(
        frame="0",
        camera_name="a",
        camera=CAMERA.resized(80, 60),
        cam_from_rig=AHEAD,
        depth_mm=depth,
        confidence=np.ones((60, 80), np.float32),
    )
    within = measures.mask_at(coarse, MountedCamera(CAMERA, AHEAD), mask)
    assert within.sum() == 60 * 40
    assert measures.coverage_pct(coarse.known, within) == 50
    assert np.isnan(measures.coverage_pct(coarse.known, np.zeros_like(within)))
    upside_down = Rigid3(Rotation.from_euler("z", 180, degrees=True).as_matrix(), np.zeros(3))
    turned = measures.mask_at(coarse, MountedCamera(CAMERA, upside_down), mask)
    assert np.array_equal(turned, ~within)


def test_silhouettes_share_what_they_share(measures):
    one, other = np.zeros((2, 10, 10), bool)
    one[:, :6], other[:, 4:] = True, True
    assert measures.silhouette_iou(one, other) == pytest.approx(0.2)
    assert measures.silhouette_iou(one, one) == 1
    assert np.isnan(measures.silhouette_iou(~(one | other), ~(one | other)))


@pytest.mark.parametrize(("off_mm", "low", "high"), [(0.0, 99.0, 100.0), (8.0, 0.0, 15.0)])
def test_a_left_out_view_agrees_with_the_right_surface_only(measures, off_mm, low, high):
    """A neighbour 12 mm aside: 8 mm of depth are 7 px there."""
    aside = Rigid3(np.eye(3), np.array([-12.0, 0, 0]))
    views = [measures.View(CAMERA, pose, pattern(CAMERA, pose, 50.0)) for pose in (AHEAD, aside)]
    mask = np.zeros((120, 160), bool)
    mask[20:100, 40:120] = True
    found = measures.left_out(plane(50 + off_mm), views[0], [views[1]], mask)
    assert low <= found.agreeing_pct <= high
    assert found.surface_pct == 100
    assert 60 < found.compared_pct < 90
    assert found.silhouette_iou == pytest.approx(mask.mean())


def test_what_something_hides_is_not_compared(measures):
    aside = Rigid3(np.eye(3), np.array([-12.0, 0, 0]))
    views = [measures.View(CAMERA, pose, pattern(CAMERA, pose, 50.0)) for pose in (AHEAD, aside)]
    depth = measures.depth_of(plane(50), views[0])
    nearer = measures.depth_of(plane(30), views[1])
    assert not measures.warped(views[0], depth, views[1], nearer)[1].any()
    assert measures.warped(views[0], depth, views[1], measures.depth_of(plane(50), views[1]))[1].mean() > 0.6


@pytest.mark.parametrize("by_px", [0.5, 2.0])
def test_an_image_is_displaced_by_as_much_as_it_was_moved(measures, by_px):
    image = pattern(CAMERA, AHEAD, 50.0)
    moved = cv2.warpAffine(image, np.array([[1, 0, by_px], [0, 1, 0]]), (160, 120))
    found = measures.displacement_px(image, moved, np.ones((120, 160), bool))
    inner = found[20:100, 20:140]
    assert np.isfinite(inner).all()
    assert abs(np.median(inner) - by_px) < 0.15


def poses_around(count: int) -> dict[str, Rigid3]:
    rng = np.random.default_rng(3)
    turns = Rotation.random(count, rng=rng).as_matrix()
    return {f"{k}": Rigid3(turn, rng.normal(0, 100, 3)) for k, turn in enumerate(turns)}


def test_poses_in_another_frame_and_unit_do_not_differ(measures):
    others = poses_around(8)
    world = Rigid3(Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix(), np.array([5.0, 6, 7]))
    found = {}
    for name, pose in others.items():
        moved = pose @ world
        found[name] = Rigid3(moved.rotation, moved.translation / 40)
    same = measures.pose_difference(found, others)
    assert same.scale == pytest.approx(40)
    assert same.located == 8
    assert max(same.rotation_max_deg, same.centre_max_pct) < 1e-4


def test_one_pose_that_was_turned_and_moved_is_told(measures):
    others = poses_around(30)
    turn = Rigid3(Rotation.from_euler("x", 2.0, degrees=True).as_matrix(), np.zeros(3))
    size = np.linalg.norm(np.ptp([pose.inverse().translation for pose in others.values()], axis=0))
    found = others | {"4": turn @ others["4"]}
    assert 1.8 < measures.pose_difference(found, others).rotation_max_deg < 2.05
    back = others["7"].inverse()
    shifted = Rigid3(back.rotation, back.translation + [0.02 * size, 0, 0]).inverse()
    moved = measures.pose_difference(others | {"7": shifted}, others)
    assert 1.5 < moved.centre_max_pct < 2.1
    assert measures.pose_difference({"1": others["1"]}, others) is None


def test_a_log_tells_how_a_run_ended():
    told = import_module("real_runs").told
    warned = b"/a/b.py:12: RuntimeWarning: invalid value\n  x = y\ncuspid: no surface: too\nlittle texture\n"
    found = told(1, warned)
    assert (found["status"], found["warnings"], found["traceback"]) == ("refused", 1, False)
    assert found["last_line"] == "cuspid: no surface: too little texture"
    assert told(1, b"Traceback (most recent call last):\nValueError: x\n")["status"] == "traceback"
    assert told(124, b"")["status"] == "timed out"
    assert told(0, b"fine\n")["status"] == "done"


def test_crowns_are_off_by_as_much_as_they_were_grown(monkeypatch):
    """Of a ball whose upper half is wanted; a scan elsewhere does not count."""
    judging = import_module("cast_judging")
    monkeypatch.setattr(judging, "_SAMPLES", 4000)
    true, grown = ball(10.0, (0, 0, 0)), ball(10.05, (0, 0, 0))
    wanted = true.face_centres[:, 2] > 0
    far = ball(3.0, (0, 0, -40))
    scan = Mesh(
        np.concatenate([grown.vertices, far.vertices]), np.concatenate([grown.faces, far.faces + len(grown.vertices)])
    )
    found = judging.crown_figures(scan, true, wanted)
    assert 20 < found["mean_abs_um"] < 52  # a shift takes some of it off the half
    assert found["crowns_complete_pct"] == 100
    assert 0.1 < found["surface_scale_error_pct"] < 0.6
    same = judging.crown_figures(true, true, wanted)
    assert same["mean_abs_um"] < 1e-3
    assert judging.crown_figures(far, true, wanted) == {"crowns_complete_pct": 0.0}


def test_faces_that_three_photographs_show_are_visible():
    judging = import_module("cast_judging")
    above = Rigid3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0, 60]))
    true = ball(10.0, (0, 0, 0))
    seen = judging.visible_faces(true, CAMERA, dict.fromkeys("abc", above))
    cosine = true.face_centres[:, 2] / 10
    assert seen[cosine > 0.5].all()
    assert not seen[cosine < 0.2].any()
    assert not judging.visible_faces(true, CAMERA, dict.fromkeys("ab", above)).any()
