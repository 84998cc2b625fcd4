import os
import resource
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from builders import any_pose, sphere
from cuspid.geometry import Rigid3
from cuspid.model.jaw import FDI_FROM_UNIVERSAL, UNIVERSAL_FROM_FDI, Jaw
from cuspid.model.mesh import Mesh, edges_of
from cuspid.runtime.errors import InputError
from strategies import rigid3s


def test_areas_and_normals_of_a_sphere():
    mesh = sphere(10.0)
    assert 0.995 < mesh.face_areas.sum() / (4 * np.pi * 100) < 1
    np.testing.assert_allclose(mesh.vertex_normals, mesh.vertices / 10, atol=1e-2)
    assert np.all(np.sum(mesh.face_normals * mesh.face_centres, axis=1) > 9.9)


@pytest.mark.parametrize("seed", range(3))
def test_crosses_and_vertex_normals_are_those_that_numpy_gives(seed):
    rng = np.random.default_rng(seed)
    mesh = Mesh(rng.normal(size=(40, 3)), rng.integers(0, 40, (100, 3)))  # some faces are lines, some vertices unused
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    crosses = np.cross(b - a, c - a)
    np.testing.assert_array_equal(mesh.face_cross, crosses)
    summed = np.zeros_like(mesh.vertices)
    np.add.at(summed, mesh.faces, crosses[:, None])
    lengths = np.linalg.norm(summed, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.vertex_normals * lengths, summed, atol=1e-12)
    assert set(np.linalg.norm(mesh.vertex_normals, axis=1).round(9)) <= {0.0, 1.0}


def test_rays_of_all_cores_hit_what_those_of_one_hit(monkeypatch):
    monkeypatch.setattr("cuspid.runtime.workers.usable_cores", lambda: 5)
    mesh, rng = sphere(10.0), np.random.default_rng(0)
    origins, directions = rng.normal(0, 12, (2, 503, 3))
    expected, found = mesh.cast(origins, directions, 0.5), mesh.cast_on_all_cores(origins, directions, 0.5)
    hits = (expected.faces >= 0).sum()
    assert 50 < hits < 0.8 * (mesh.cast(origins, directions).faces >= 0).sum()
    for name in ("faces", "distances", "barycentric"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_rays_hit_where_they_should():
    mesh = sphere(10.0)
    rng = np.random.default_rng(0)
    origins, directions = rng.normal(size=(500, 3)), rng.normal(size=(500, 3))
    hits = mesh.cast(origins, directions)
    at = np.einsum("nk,nkd->nd", hits.barycentric, mesh.vertices[mesh.faces[hits.faces]])
    np.testing.assert_allclose(origins + hits.distances[:, None] * directions, at, atol=2e-5)
    away = mesh.cast(np.array([[20.0, 0, 0]]), np.array([[1.0, 0, 0]]))
    assert away.faces[0] == -1
    assert np.isinf(away.distances[0])


@pytest.mark.parametrize("size", [1.0, 1000.0])
def test_occlusion_is_of_the_open_segment(size):
    mesh = sphere(10.0 * size)
    near, far = mesh.face_centres[:50], -mesh.face_centres[:50]
    eye = near * 2
    assert not mesh.occluded(near, eye).any()
    assert mesh.occluded(far, eye).all()


def test_what_is_occluded_is_what_a_first_hit_lies_before():
    mesh, rng = sphere(10.0, 3), np.random.default_rng(1)
    points, eyes = rng.uniform(-15, 15, (2, 2000, 3))
    distances = mesh.cast(eyes, points - eyes).distances
    occluded = mesh.occluded(points, eyes)
    np.testing.assert_array_equal(occluded, distances < 1 - 1e-3 / np.linalg.norm(points - eyes, axis=1))
    assert 0.2 < occluded.mean() < 0.8
    assert not mesh.occluded(points[:1], points[:1]).any()


def test_each_edge_of_a_closed_surface_is_there_once_in_either_direction():
    edges = edges_of(sphere(10.0, 2).faces)
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert set(map(tuple, edges.tolist())) == set(map(tuple, edges[:, ::-1].tolist()))


def test_the_centroid_of_a_cap_lies_above_its_middle():
    """Half-way between the rim and the top of a sphere (Archimedes)."""
    mesh = sphere(10.0, 6)
    np.testing.assert_allclose(mesh.centroid(mesh.face_centres[:, 2] > 6), [0, 0, 8], atol=0.05)


def test_closest_points_on_a_sphere():
    mesh = sphere(10.0, subdivisions=6)
    points = np.random.default_rng(0).normal(size=(200, 3)) * 20
    distances, faces, positions = mesh.closest(points)
    np.testing.assert_allclose(distances, np.abs(np.linalg.norm(points, axis=1) - 10), atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(points - positions, axis=1), distances, atol=1e-9)
    assert ((faces >= 0) & (faces < len(mesh.faces))).all()


def test_samples_are_even_by_area():
    corners = np.array([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 0], [-1, 0, 0], [0, -1, 0]])
    mesh = Mesh(corners, np.array([[0, 1, 2], [3, 4, 5]]))
    points, faces = mesh.sample(4000, np.random.default_rng(0))
    assert np.mean(faces == 0) == pytest.approx(0.75, abs=2e-3)
    np.testing.assert_allclose(points[faces == 0].mean(axis=0), [1, 1 / 3, 0], atol=0.03)
    assert mesh.closest(points)[0].max() < 1e-12


@given(rigid3s())
def test_moving_a_mesh_moves_its_normals(target_from_source: Rigid3):
    mesh = sphere(10.0, subdivisions=1)
    moved = mesh.transformed(target_from_source)
    np.testing.assert_allclose(moved.face_normals, target_from_source.rotate(mesh.face_normals), atol=1e-9)
    np.testing.assert_allclose(moved.face_areas, mesh.face_areas, rtol=1e-9)


def test_submesh_keeps_only_what_it_uses():
    mesh = sphere(10.0, subdivisions=2)
    upper = mesh.face_centres[:, 2] > 0
    part = mesh.submesh(upper)
    np.testing.assert_allclose(part.face_centres, mesh.face_centres[upper])
    assert len(np.unique(part.faces)) == len(part.vertices) < len(mesh.vertices)


def test_a_face_must_name_existing_vertices():
    with pytest.raises(InputError, match=r"outside 0\.\.2"):
        Mesh(np.zeros((3, 3)), np.array([[0, 1, 3]]))


def test_tooth_numbers_of_the_thesis():
    assert [FDI_FROM_UNIVERSAL[number] for number in (19, 20, 26, 29, 30)] == [36, 35, 42, 45, 46]
    assert sorted(UNIVERSAL_FROM_FDI.values()) == list(range(1, 33))


def test_a_jaw_knows_its_teeth():
    mesh = sphere(10.0, subdivisions=1)
    labels = np.zeros(len(mesh.faces), dtype=int)
    labels[:5], labels[5:9] = 46, 45
    jaw = Jaw(mesh=mesh, face_labels=labels)
    assert jaw.teeth == (45, 46)
    assert jaw.tooth_faces(46).sum() == 5
    with pytest.raises(InputError, match=r"no tooth 11 \(FDI\); it has 45, 46"):
        jaw.tooth_faces(11)
    with pytest.raises(InputError, match="labels for"):
        Jaw(mesh=mesh, face_labels=labels[1:])


@pytest.mark.parametrize("most", [700, 20_000])
def test_a_simplified_mesh_has_no_more_faces_and_the_same_surface(most: int) -> None:
    """Also where much of it is flat, in any pose, on which the library gives up early."""
    box = trimesh.creation.box((20, 14, 6)).subdivide_to_size(0.4)
    mesh = Mesh(np.asarray(box.vertices), np.asarray(box.faces)).transformed(any_pose(3, 10.0))
    found = mesh.simplified(most)
    assert 0.5 * min(most, len(mesh.faces)) < len(found.faces) <= most
    np.testing.assert_allclose(found.face_areas.sum(), mesh.face_areas.sum(), rtol=0.02)
    assert (found is mesh) == (len(mesh.faces) <= most)


def test_a_mesh_of_many_faces_is_joined_before_it_is_collapsed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As fine as it would have to be for the collapse alone, and as good."""
    monkeypatch.setattr("cuspid.model.mesh._MOST_COLLAPSED", 10_000)
    ball = sphere(10.0, subdivisions=6)
    found = ball.simplified(2000)
    assert 1000 < len(found.faces) <= 2000
    np.testing.assert_allclose(np.linalg.norm(found.vertices, axis=1), 10.0, atol=0.05)
    np.testing.assert_allclose(found.face_areas.sum(), ball.face_areas.sum(), rtol=0.01)
    assert np.sum(found.face_normals * found.face_centres, axis=1).min() > 0
    assert 5_000 < len(ball.thinned(10_000).faces) < 15_000
    assert ball.thinned(len(ball.faces)) is ball


def test_some_normals_are_those_of_all() -> None:
    mesh = sphere(10.0, subdivisions=2)
    some = np.array([3, 100, 3, 7])
    np.testing.assert_array_equal(mesh.normals_of(some), mesh.face_normals[some])


@given(farthest=st.floats(0.5, 4.0))
def test_rays_go_no_farther_than_told(farthest: float) -> None:
    ball = sphere(1.0, 3)
    origins = np.column_stack([np.linspace(-0.5, 0.5, 7), np.full(7, 0.1), np.full(7, 3.0)])
    down = np.broadcast_to([0, 0, -2.0], origins.shape)
    whole, limited = ball.cast(origins, down), ball.cast(origins, down, farthest)
    near = whole.distances < farthest
    np.testing.assert_array_equal(limited.faces, np.where(near, whole.faces, -1))
    np.testing.assert_array_equal(limited.distances, np.where(near, whole.distances, np.inf))


def test_rays_without_memory_are_an_error_and_not_the_end_of_the_process() -> None:
    mesh = sphere(10.0)
    child = os.fork()
    if child == 0:
        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (held + (4 << 20), resource.RLIM_INFINITY))
        filled: list[bytearray] = []
        with suppress(MemoryError):  # what was freed before is there to be had
            while True:
                filled.append(bytearray(1 << 18))
        try:
            mesh.cast(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
        except MemoryError:
            os._exit(7)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
