"""What is not traced is what tracing would have found."""

from __future__ import annotations

import numpy as np
import pytest

from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DesignOptions, twelve_cameras
from cuspid.model.camera import Camera
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.simulation.appearance import APPEARANCES
from cuspid.simulation.hits import Rays, ShadedMesh, first_hits, point_of, trace
from cuspid.simulation.raycast import Scene, lamps, pixel_rays
from cuspid.simulation.shadows import illuminate, segments

SAMPLES = 4
HANDPIECE = twelve_cameras(DesignOptions(width_px=200, height_px=200))
VIEWS = [("o1", 46), ("b2", 36), ("l3", 41)]


class Traced(Mesh):
    """A mesh that counts the rays that are traced."""

    counts: list[int]

    def cast(self, origins: np.ndarray, directions: np.ndarray, farthest: float = np.inf):  # type: ignore[no-untyped-def]
        self.counts.append(len(directions))
        return super().cast(origins, directions, farthest)

    def occluded(self, points: np.ndarray, towards: np.ndarray, tolerance_mm: float = 1e-3):  # type: ignore[no-untyped-def]
        self.counts.append(len(points))
        return super().occluded(points, towards, tolerance_mm)


def counted(mesh: Mesh) -> Traced:
    made = Traced(mesh.vertices, mesh.faces)
    object.__setattr__(made, "counts", [])
    return made


def view(jaw: Jaw, name: str, tooth: int) -> tuple[ShadedMesh, np.ndarray, np.ndarray, Camera, Rigid3]:
    """What a camera of the handpiece sees above a tooth: the surface, the rays, the camera, the pose."""
    points = jaw.mesh.face_centres[jaw.tooth_faces(tooth)]
    pose = Rigid3(np.eye(3), -np.array([*points[:, :2].mean(axis=0), points[:, 2].max() - 1.0]))
    scene = Scene(jaw=jaw, handpiece=HANDPIECE, appearance=APPEARANCES["artificial"])
    mounted = HANDPIECE.rig[name]
    world_from_cam = (mounted.cam_from_rig @ pose).inverse()
    rays = world_from_cam.rotate(pixel_rays(mounted.camera, 2))
    return scene.surface, world_from_cam.translation[None].copy(), rays, mounted.camera, pose


def all_traced(mesh: Mesh, origins: np.ndarray, rays: np.ndarray) -> tuple[Rays, Rays]:
    """All rays, and the first ones of the pixels."""
    return trace(mesh, origins, rays), trace(mesh, origins, rays[::SAMPLES])


@pytest.mark.parametrize(("name", "tooth"), VIEWS)
@pytest.mark.parametrize("one_origin", [True, False])
def test_rays_that_are_not_traced_hit_what_they_would_hit(
    coarse_phantom: Jaw, name: str, tooth: int, one_origin: bool
) -> None:
    surface, origins, rays, camera, _ = view(coarse_phantom, name, tooth)
    if not one_origin:
        origins = np.tile(origins, (len(rays), 1))
    mesh = counted(coarse_phantom.mesh)
    firsts = trace(mesh, origins[:: SAMPLES if len(origins) > 1 else 1], rays[::SAMPLES])
    found = first_hits(mesh, surface, origins, rays, firsts, SAMPLES, camera.width)
    expected = trace(coarse_phantom.mesh, origins, rays)
    same = found.faces == expected.faces
    assert same.mean() > 0.9995
    hit = same & (found.faces >= 0)
    assert hit.mean() > 0.5
    np.testing.assert_allclose(found.distances[hit], expected.distances[hit], rtol=2e-5)
    np.testing.assert_allclose(found.barycentric[hit], expected.barycentric[hit], atol=2e-3)
    assert 1 <= sum(mesh.counts) / len(firsts.faces) < 1.5  # rays a pixel, of four


@pytest.mark.parametrize(("name", "tooth"), VIEWS)
def test_shadows_that_are_not_traced_are_where_they_would_be(coarse_phantom: Jaw, name: str, tooth: int) -> None:
    surface, origins, rays, camera, pose = view(coarse_phantom, name, tooth)
    lights = lamps(HANDPIECE, None, pose)
    everything, firsts = all_traced(coarse_phantom.mesh, origins, rays)
    mesh = counted(coarse_phantom.mesh)
    chosen, counts, light = illuminate(mesh, surface, everything, SAMPLES, lights, firsts, camera.width)
    assert counts.sum() == len(rays)
    first = everything.faces[chosen] >= 0
    points = everything.origins + everything.distances[chosen, None] * everything.directions[chosen]
    points[~first] = 0
    matters = light.strengths > 0.005 * light.strengths.sum(axis=1, keepdims=True)
    hidden = coarse_phantom.mesh.occluded(*segments(points, matters, lights.positions))
    expected = matters.copy()
    expected.T[matters.T] = ~hidden
    assert 0.02 < hidden.mean() < 0.9
    assert (light.lit != expected).sum() < 1e-3 * matters.sum()
    bias = (light.lit.astype(int) - expected).sum()
    assert abs(bias) < 5e-4 * matters.sum()
    assert sum(mesh.counts) < 0.7 * matters.sum()  # and fewer in larger images: edges grow by the side


def test_what_is_narrower_than_a_pixel_is_the_only_thing_to_be_missed() -> None:
    """A post before a wall is seen as wide as it is from one pixel on, wherever it stands between the rays."""
    camera = Camera.from_field_of_view(60, 60, 60.0)
    rays, origin = pixel_rays(camera, 2), np.zeros((1, 3))
    pixel_mm = 3.0 / camera.focal_px[0]
    wall = np.array([[-9, -9, 6], [-9, 9, 6], [9, 9, 6], [9, -9, 6]], dtype=float)
    for left in np.linspace(0, pixel_mm, 7):
        x = np.array([left, left + 1.01 * pixel_mm])
        post = np.array([[x[0], -9, 3], [x[0], 9, 3], [x[1], 9, 3], [x[1], -9, 3]])
        mesh = Mesh(np.concatenate([wall, post]), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]))
        scene = Scene(jaw=Jaw(mesh=mesh), handpiece=HANDPIECE, appearance=APPEARANCES["artificial"])
        everything, firsts = all_traced(mesh, origin, rays)
        found = first_hits(mesh, scene.surface, origin, rays, firsts, SAMPLES, camera.width)
        np.testing.assert_array_equal(found.faces >= 2, everything.faces >= 2)
        assert (found.faces >= 2).sum() >= 2 * 2 * camera.height


def test_a_ray_hits_at_its_distance_from_its_own_origin() -> None:
    towards = np.array([[0.0, 0, 2], [0, 1, 0]])
    for origins in (np.array([[1.0, 2, 3], [10, 20, 30]]), np.array([[1.0, 2, 3]])):
        rays = Rays(origins, towards, np.zeros(2, np.int64), np.array([5.0, 7.0]), np.zeros((2, 2)))
        found = [point_of(rays, index) for index in range(2)]
        np.testing.assert_allclose(found, origins + [[0, 0, 10], [0, 7, 0]])
