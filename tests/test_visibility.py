"""What the cameras see, against analytic answers on a sphere and on plates."""

from __future__ import annotations

import numpy as np
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from cuspid.camera import Camera
from cuspid.geometry import Rigid3
from cuspid.handpiece.visibility import VisibilityOptions, scannable_faces, visible_counts, visible_faces
from cuspid.mesh import Mesh
from cuspid.rig import Handpiece, MountedCamera, Rig

CAMERA = Camera.from_field_of_view(500, 500, 62.0)
DEPTHS = (2.5, 9.0)


def sphere(radius_mm: float) -> Mesh:
    ball = trimesh.creation.icosphere(4, radius_mm)
    return Mesh(np.asarray(ball.vertices), np.asarray(ball.faces))


def plate(z: float, half_width: float, cells: int = 20) -> Mesh:
    """A square plate of small triangles that faces -Z, towards a camera at the origin."""
    ticks = np.linspace(-half_width, half_width, cells + 1)
    x, y = np.meshgrid(ticks, ticks)
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, -1)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)
    return Mesh(vertices, np.concatenate([np.stack([a, c, b], 1), np.stack([a, d, c], 1)]))


def joined(first: Mesh, second: Mesh) -> Mesh:
    return Mesh(
        np.concatenate([first.vertices, second.vertices]),
        np.concatenate([first.faces, second.faces + len(first.vertices)]),
    )


def looking_along(axes: dict[str, Rigid3]) -> Handpiece:
    return Handpiece(rig=Rig({name: MountedCamera(CAMERA, pose) for name, pose in axes.items()}), depth_range_mm=DEPTHS)


@settings(max_examples=15, deadline=None)
@given(st.floats(3.0, 7.0), st.floats(30, 80))
def test_a_sphere_is_seen_where_the_closed_form_says(distance_mm: float, incidence_deg: float) -> None:
    radius = 3.0
    ball = sphere(radius)
    cam_from_world = Rigid3(np.eye(3), np.array([0, 0, distance_mm + radius]))
    seen = np.zeros(len(ball.faces), dtype=bool)
    seen[
        visible_faces(ball, CAMERA, cam_from_world, DEPTHS, VisibilityOptions(maximum_incidence_deg=incidence_deg))
    ] = 1
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
