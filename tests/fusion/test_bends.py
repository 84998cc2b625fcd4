"""Finer faces where a mesh bends: the same surface, without cracks."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from builders import box_mesh, plate, sphere
from cuspid.fusion.bends import find_bends, subdivide_edges
from cuspid.model.mesh import Mesh, edges_of


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), share=st.floats(0, 1))
def test_halved_faces_cover_the_same_surface(seed: int, share: float) -> None:
    mesh = sphere(1.0, 2)
    marked = np.random.default_rng(seed).random(len(mesh.vertices)) < share
    finer = subdivide_edges(mesh, marked)
    ends = edges_of(mesh.faces)
    sides = np.unique(np.sort(ends[marked[ends].all(axis=1)], axis=1), axis=0)
    assert (finer.vertices[: len(mesh.vertices)] == mesh.vertices).all()
    np.testing.assert_allclose(finer.vertices[len(mesh.vertices) :], mesh.vertices[sides].mean(axis=1), atol=1e-12)
    # Closed, each edge once in each direction, and every part of a face lies in it.
    there = {tuple(edge) for edge in edges_of(finer.faces).tolist()}
    assert len(there) == finer.faces.size
    assert all((b, a) in there for a, b in there)
    distance, face, _ = mesh.closest(finer.face_centres)
    assert distance.max() < 1e-9
    assert ((finer.face_normals * mesh.face_normals[face]).sum(axis=1) > 1 - 1e-9).all()
    assert abs(finer.face_areas.sum() / mesh.face_areas.sum() - 1) < 1e-9


def test_all_marked_gives_four_faces_for_one_and_none_the_mesh_itself() -> None:
    mesh = sphere(1.0, 2)
    assert len(subdivide_edges(mesh, np.ones(len(mesh.vertices), dtype=bool)).faces) == 4 * len(mesh.faces)
    same = subdivide_edges(mesh, np.zeros(len(mesh.vertices), dtype=bool))
    assert (same.faces == mesh.faces).all()
    assert (same.vertices == mesh.vertices).all()


def test_only_edges_bend() -> None:
    assert find_bends(box_mesh(), 0).all()
    flat = plate(0.0, 1.0)
    assert not find_bends(flat, 2).any()
    fold = Mesh(flat.vertices + np.abs(flat.vertices[:, :1]) * [0, 0, 1], flat.faces)
    spacing = 2.0 / 20
    for rings in (0, 1, 2):
        across = np.abs(fold.vertices[find_bends(fold, rings), 0])
        assert abs(across.max() - (1 + rings) * spacing) < 1e-9
        assert find_bends(fold, rings).sum() == (np.abs(fold.vertices[:, 0]) < (1.5 + rings) * spacing).sum()
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    assert find_bends(nothing, 1).shape == (0,)
    assert len(subdivide_edges(nothing, find_bends(nothing, 1)).faces) == 0
