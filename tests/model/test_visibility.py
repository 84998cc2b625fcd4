"""What the cameras see, against analytic answers on a sphere and on plates."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from builders import joined, moved, plate, sphere
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import essential_four, twelve_cameras
from cuspid.handpiece.optics import in_focus
from cuspid.handpiece.presets import PRESETS
from cuspid.model.camera import Camera
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.model.visibility import (
    VisibilityOptions,
    camera_rows,
    openness,
    scannable_faces,
    surface_rows,
    survey_visibility,
    visible_counts,
    visible_faces,
)
from cuspid.runtime.errors import InputError

CAMERA = Camera.from_field_of_view(500, 500, 62.0)
DEPTHS = (2.5, 9.0)


def looking_along(axes: dict[str, Rigid3]) -> Handpiece:
    return Handpiece(rig=Rig({name: MountedCamera(CAMERA, pose) for name, pose in axes.items()}), depth_range_mm=DEPTHS)


@settings(max_examples=15, deadline=None)
@given(st.floats(3.0, 7.0), st.floats(30, 80))
def test_a_sphere_is_seen_where_the_closed_form_says(distance_mm: float, incidence_deg: float) -> None:
    radius = 3.0
    ball = sphere(radius)
    cam_from_world = Rigid3(np.eye(3), np.array([0, 0, distance_mm + radius]))
    seen = np.zeros(len(ball.faces), dtype=bool)
    seen[visible_faces(ball, CAMERA, cam_from_world, DEPTHS, VisibilityOptions(max_incidence_deg=incidence_deg))] = 1
    centres = cam_from_world.apply(ball.face_centres)
    sight = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    facing = -np.sum(sight * ball.face_normals, axis=1) > np.cos(np.deg2rad(incidence_deg))
    in_image = np.all(np.abs(centres[:, :2] / centres[:, 2:]) < np.tan(np.deg2rad(31)), axis=1)
    in_focus = (centres[:, 2] > DEPTHS[0]) & (centres[:, 2] < DEPTHS[1])
    assert seen.any()
    np.testing.assert_array_equal(seen, facing & in_image & in_focus)


def test_what_is_behind_something_is_not_seen() -> None:
    wall, screen = plate(7.0, 3.0), plate(4.0, 1.0)
    both = joined(wall, screen)
    seen = np.zeros(len(both.faces), dtype=bool)
    seen[visible_faces(both, CAMERA, Rigid3.identity(), DEPTHS, VisibilityOptions())] = True
    shadow = np.all(np.abs(wall.face_centres[:, :2]) < 7.0 / 4.0, axis=1)
    np.testing.assert_array_equal(seen[: len(wall.faces)], ~shadow)
    assert seen[len(wall.faces) :].all()


def test_a_surface_seen_from_behind_does_not_count() -> None:
    wall = plate(5.0, 2.0)
    flipped = Mesh(wall.vertices, wall.faces[:, ::-1])
    assert len(visible_faces(wall, CAMERA, Rigid3.identity(), DEPTHS, VisibilityOptions())) == len(wall.faces)
    assert len(visible_faces(flipped, CAMERA, Rigid3.identity(), DEPTHS, VisibilityOptions())) == 0


def test_lens_distortion_moves_the_border_of_the_image() -> None:
    wall = plate(5.0, 3.0, cells=60)
    barrel = CAMERA.with_parameters(np.array([*CAMERA.parameters[:4], 0.2, 0, 0, 0]))
    seen = visible_faces(wall, barrel, Rigid3.identity(), DEPTHS, VisibilityOptions())
    expected = np.flatnonzero(barrel.contains(barrel.project(wall.face_centres)))
    np.testing.assert_array_equal(seen, expected)
    assert 0 < len(expected) < len(visible_faces(wall, CAMERA, Rigid3.identity(), DEPTHS, VisibilityOptions()))


def test_the_count_is_of_cameras_at_once_not_over_time() -> None:
    wall = plate(5.0, 1.0)
    aside = Rigid3(np.eye(3), np.array([-100.0, 0, 0]))
    one = looking_along({"near": Rigid3.identity(), "far": aside})
    poses = [Rigid3.identity(), aside.inverse(), Rigid3.identity()]
    assert set(visible_counts(wall, one, poses, VisibilityOptions())) == {1}
    assert not scannable_faces(wall, one, poses, VisibilityOptions()).any()
    assert scannable_faces(wall, one, poses, VisibilityOptions(cameras=1)).all()
    pair = looking_along({"near": Rigid3.identity(), "next": Rigid3(np.eye(3), np.array([-1.0, 0, 0]))})
    assert scannable_faces(wall, pair, poses[:1], VisibilityOptions()).all()


# --- the whole against brute force, face by face ----------------------------------------------------------------------


def wanderings(seed: int, count: int) -> list[Rigid3]:
    """Poses of a handpiece some millimetres over the sphere of radius 3, looking at it from all around."""
    rng = np.random.default_rng(seed)
    away = Rigid3(np.eye(3), np.array([0, 0, rng.uniform(7.0, 9.0)]))
    return [away @ Rigid3.from_rotation_vector(rng.normal(0, 1.2, 3), np.zeros(3)) for _ in range(count)]


def crossing(mesh: Mesh, start: np.ndarray, end: np.ndarray) -> bool:
    """Whether the segment crosses any face but at its end: every triangle is asked (Moeller and Trumbore)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    direction = end - start
    normal = np.cross(direction, c - a)
    determinant = np.einsum("nd,nd->n", b - a, normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("nd,nd->n", start - a, normal) / determinant
        q = np.cross(start - a, b - a)
        v = q @ direction / determinant
        along = np.einsum("nd,nd->n", c - a, q) / determinant
    return bool(np.any((u >= 0) & (v >= 0) & (u + v <= 1) & (along > 0) & (along < 1 - 1e-3)))


def seen_by_brute_force(mesh: Mesh, hand: Handpiece, pose: Rigid3, options: VisibilityOptions) -> np.ndarray:
    """Faces by cameras."""
    seen = np.zeros((len(mesh.faces), len(hand.rig.names)), dtype=bool)
    for column, mounted in enumerate(hand.rig.cameras.values()):
        cam_from_world = mounted.cam_from_rig @ pose
        eye = cam_from_world.inverse().translation
        for face, (centre, normal) in enumerate(zip(mesh.face_centres, mesh.face_normals, strict=True)):
            place = cam_from_world.apply(centre)
            sight = (eye - centre) / np.linalg.norm(eye - centre)
            seen[face, column] = (
                hand.depth_range_mm[0] <= place[2] <= hand.depth_range_mm[1]
                and mounted.camera.contains(mounted.camera.project(place[None]))[0]
                and sight @ normal >= np.cos(np.deg2rad(options.max_incidence_deg))
                and not crossing(mesh, eye, centre)
            )
    return seen


@pytest.mark.parametrize("seed", range(3))
def test_the_survey_equals_brute_force_over_the_faces(seed: int) -> None:
    mesh = joined(sphere(3.0, 2), *(moved(sphere(0.6, 1), (x, 0, 4.2)) for x in (-1.5, 1.5)))
    apart = {name: Rigid3(np.eye(3), np.array([x, 0.0, 0.0])) for name, x in (("a", -1.2), ("b", 0.0), ("c", 1.2))}
    hand, options, poses = looking_along(apart), VisibilityOptions(), [Rigid3.identity(), *wanderings(seed, 3)]
    poses[0] = Rigid3(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 9.0]))
    each = np.array([seen_by_brute_force(mesh, hand, pose, options) for pose in poses])
    found = survey_visibility(mesh, hand, poses, options)
    assert each.any(axis=1).all()
    assert set(np.unique(found.most_at_once)) == {0, 1, 2, 3}
    np.testing.assert_array_equal(found.most_at_once, each.sum(axis=2).max(axis=0))
    np.testing.assert_array_equal(found.images, each.sum(axis=(0, 2)))
    np.testing.assert_array_equal(found.by_camera, each.any(axis=0))
    np.testing.assert_array_equal(visible_counts(mesh, hand, poses, options), found.most_at_once)
    for cameras in (1, 2, 3):
        enough = scannable_faces(mesh, hand, poses, VisibilityOptions(cameras=cameras))
        np.testing.assert_array_equal(enough, found.most_at_once >= cameras)


def test_the_far_corners_of_the_image_are_not_left_out() -> None:
    """A plate at the end of the depth range that fills the image; one camera asked for all its faces finds the same."""
    wall = plate(DEPTHS[1] - 0.01, 6.0, cells=40)
    seen = visible_counts(wall, looking_along({"only": Rigid3.identity()}), [Rigid3.identity()], VisibilityOptions())
    alone = visible_faces(wall, CAMERA, Rigid3.identity(), DEPTHS, VisibilityOptions())
    assert np.abs(wall.face_centres[alone]).max(axis=0)[:2].min() > 5.2
    np.testing.assert_array_equal(np.flatnonzero(seen), alone)


# --- laws on a jaw ----------------------------------------------------------------------------------------------------


def over_the_molar(jaw: Jaw) -> list[Rigid3]:
    """A handpiece held upright at three places over the lower right second molar."""
    faces = jaw.tooth_faces(47)
    middle = jaw.mesh.face_centres[faces].mean(axis=0)
    top = jaw.mesh.vertices[jaw.mesh.faces[faces]][..., 2].max()
    axes = np.array([[0, 1.0, 0], [-1.0, 0, 0], [0, 0, 1.0]])
    return [Rigid3(axes, -axes @ np.array([middle[0], middle[1] + along, top])) for along in (-1.0, 0.0, 1.0)]


def test_each_law_of_sight_holds_on_a_jaw(coarse_phantom: Jaw) -> None:
    mesh, poses = coarse_phantom.mesh, over_the_molar(coarse_phantom)
    found = survey_visibility(mesh, twelve_cameras(), poses, VisibilityOptions(max_incidence_deg=60.0))
    seen = found.images > 0
    assert 500 < seen.sum() < len(mesh.faces) / 4
    np.testing.assert_array_equal(found.most_at_once > 0, seen)
    np.testing.assert_array_equal(found.by_camera.any(axis=1), seen)
    np.testing.assert_array_equal(np.isnan(found.incidence_deg), ~seen)
    assert 0 <= np.nanmin(found.incidence_deg) < 20
    assert 50 < np.nanmax(found.incidence_deg) <= 60
    assert found.most_at_once.max() <= 12
    assert found.images.max() <= 36


def test_more_cameras_never_see_less(coarse_phantom: Jaw) -> None:
    mesh, poses, options = coarse_phantom.mesh, over_the_molar(coarse_phantom), VisibilityOptions()
    twelve, counts = twelve_cameras(), [np.zeros(len(mesh.faces), dtype=np.int64)]
    for cameras in (4, 8, 12):
        some = Rig(dict(list(twelve.rig.cameras.items())[:cameras]))
        counts.append(visible_counts(mesh, replace(twelve, rig=some), poses, options))
    for fewer, more in pairwise(counts):
        assert np.all(more >= fewer)
        assert np.any(more > fewer)
    np.testing.assert_array_equal(counts[1], visible_counts(mesh, essential_four(), poses, options))


def test_what_is_seen_ends_where_the_lens_is_no_longer_sharp(coarse_phantom: Jaw) -> None:
    mesh, pose, lens = coarse_phantom.mesh, over_the_molar(coarse_phantom)[1], PRESETS["thesis"]
    extents = []
    for blur_px in (3.0, 5.0):
        hand = in_focus(essential_four(), lens, blur_px)
        camera = hand.rig["o1"]
        cam_from_world = camera.cam_from_rig @ pose
        faces = visible_faces(mesh, camera.camera, cam_from_world, hand.depth_range_mm, VisibilityOptions())
        depth = cam_from_world.apply(mesh.face_centres[faces])[:, 2]
        assert np.all(lens.blur_px(depth) <= blur_px * (1 + 1e-9))
        extents.append(depth.max())
    assert extents[0] == pytest.approx(lens.depth_of_field_mm(3.0)[1], abs=0.1)
    assert extents[1] > extents[0] + 1


def test_a_working_distance_out_of_focus_is_refused() -> None:
    with pytest.raises(InputError, match=r"depth range 3\.51"):
        in_focus(essential_four(), PRESETS["thesis"], 1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"cameras": 0}, "--cameras is 0"), ({"max_incidence_deg": 95.0}, "deg is 95")],
)
def test_options_that_see_nothing_or_backs_are_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        VisibilityOptions(**change)


# --- the sky ----------------------------------------------------------------------------------------------------------


def open_shares(mesh: Mesh, reach_mm: float = np.inf) -> np.ndarray:
    return openness(mesh, mesh.face_centres, mesh.face_normals, reach_mm)


def test_openness_is_that_of_the_sky() -> None:
    flat = np.array([[-50.0, -50, 0], [50, -50, 0], [0, 80, 0]])
    lid = Mesh(np.concatenate([flat, flat + [0, 0, 1.0]]), np.array([[0, 1, 2], [3, 4, 5]]))
    below, above = open_shares(lid)
    assert above == 1
    assert below < 0.1
    wall = Mesh(np.array([[0.0, -5, -5], [0, 5, -5], [0, 0, 5]]), np.array([[0, 1, 2]]))
    assert open_shares(wall)[0] == pytest.approx(0.5, abs=0.05)


def test_only_what_stands_within_reach_closes_the_sky() -> None:
    """A lid at a height h over a plane leaves the directions free that meet it beyond the reach r: a share h/r."""
    flat = 1e3 * np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1.6, 0]])
    lid = Mesh(np.concatenate([flat, flat + [0, 0, 2.0]]), np.array([[0, 1, 2], [3, 4, 5]]))
    for reach_mm in (3.0, 4.0, 8.0):
        assert open_shares(lid, reach_mm)[0] == pytest.approx(2.0 / reach_mm, abs=0.02)


# --- tables -----------------------------------------------------------------------------------------------------------


def test_the_tables_weigh_by_area() -> None:
    """Two plates, one large and seen by both cameras, one small and out of sight."""
    wall, aside = plate(5.0, 1.0), plate(5.0, 0.5)
    both = joined(wall, moved(aside, (50.0, 0, 0)))
    large = np.arange(len(both.faces)) < len(wall.faces)
    hand = looking_along({"a": Rigid3.identity(), "b": Rigid3(np.eye(3), np.array([-1.0, 0, 0]))})
    found = survey_visibility(both, hand, [Rigid3.identity()], VisibilityOptions())
    nothing = np.zeros(len(both.faces), dtype=bool)
    surfaces = {"large": large, "small": ~large, "all": ~nothing, "none": nothing}
    rows = {row["surface"]: row for row in surface_rows(found, both.face_areas, surfaces)}
    assert list(rows) == ["large", "small", "all"]
    assert rows["large"]["area_mm2"] == pytest.approx(4.0)
    assert [rows[name]["seen_by_2_pct"] for name in rows] == pytest.approx([100.0, 0.0, 80.0])
    assert [rows[name]["seen_by_3_pct"] for name in rows] == pytest.approx([0.0, 0.0, 0.0])
    assert [rows[name]["cameras_mean"] for name in rows] == pytest.approx([2.0, 0.0, 1.6])
    assert rows["small"]["incidence_mean_deg"] is None
    sight = np.array([[0, 0, 0], [1.0, 0, 0]])[:, None] - wall.face_centres
    angles = np.rad2deg(np.arccos(5.0 / np.linalg.norm(sight, axis=2)))
    assert rows["all"]["incidence_mean_deg"] == pytest.approx(angles.mean(), rel=1e-9)
    cameras = camera_rows(found, both.face_areas, surfaces)
    assert cameras[0] == {"camera": "a", "large_pct": 100.0, "small_pct": 0.0, "all_pct": pytest.approx(80.0)}
