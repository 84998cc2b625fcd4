"""Where a mesh bends from vertex to vertex, as at edges, and finer faces there."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Int

from cuspid.model.mesh import Mesh
from cuspid.runtime.kernels import kernel

_BENT_DEG = 20.0
"""Neighbouring normals differ by more beside an edge."""


def find_bends(mesh: Mesh, rings: int) -> Bool[np.ndarray, "v"]:
    """The vertices beside which the surface bends, and so many rings of neighbours."""
    found = np.zeros(len(mesh.vertices), dtype=bool)
    _mark_bent(mesh.faces, mesh.vertex_normals, np.cos(np.deg2rad(_BENT_DEG)), found)
    for _ in range(rings):
        if found.any():
            found = _dilate(mesh.faces, found)
    return found


def subdivide_edges(mesh: Mesh, marked: Bool[np.ndarray, "v"]) -> Mesh:
    """The same surface with a new vertex, without colour, in the middle of each side of a face both ends of which are
    marked. New vertices follow the old ones, in the order of these."""
    faces, count = mesh.faces, len(mesh.vertices)
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1)
    cut = marked[ends].all(axis=-1)
    sides, number = np.unique(ends[cut] @ [count, 1], return_inverse=True)
    middle = np.full(faces.shape, -1)
    middle[cut] = count + number
    one, other = np.divmod(sides, count)
    vertices = np.concatenate([mesh.vertices, (mesh.vertices[one] + mesh.vertices[other]) / 2])
    return Mesh(vertices, np.concatenate([faces[~cut.any(axis=1)], *_parts(faces, middle, cut)]))


def _parts(
    faces: Int[np.ndarray, "f 3"], middle: Int[np.ndarray, "f 3"], cut: Bool[np.ndarray, "f 3"]
) -> list[Int[np.ndarray, "_ 3"]]:
    """Faces with one, two or three sides cut, in parts; ``middle`` is the new vertex of each side that is."""
    parts = list[np.ndarray]()

    def add(chosen: Bool[np.ndarray, "f"], turn: int, *corners: str) -> None:
        named = dict(zip("abc", np.roll(faces, -turn, axis=1)[chosen].T, strict=True))
        named |= dict(zip("xyz", np.roll(middle, -turn, axis=1)[chosen].T, strict=True))
        parts.extend(np.stack([named[corner] for corner in part], axis=1) for part in corners)

    number = cut.sum(axis=1)
    for turn in range(3):  # x lies between a and b, y between b and c, z between c and a
        first, second, _ = np.roll(cut, -turn, axis=1).T
        add((number == 1) & first, turn, "axc", "xbc")
        add((number == 2) & first & second, turn, "xby", "axy", "ayc")
    add(number == 3, 0, "axz", "xby", "zyc", "xyz")
    return parts


@kernel
@no_type_check
def _mark_bent(faces, normals, cosine, found):
    """Mark both ends of each side of a face along which the surface turns by more than an angle."""
    for face in faces:
        for k in range(3):
            one, other = face[k], face[(k + 1) % 3]
            turn = 0.0
            for c in range(3):
                turn += normals[one, c] * normals[other, c]
            if turn < cosine:
                found[one] = found[other] = True


@kernel
@no_type_check
def _dilate(faces, marked):
    """What is marked, and the vertices that share a face with it."""
    more = marked.copy()
    for face in faces:
        if marked[face[0]] or marked[face[1]] or marked[face[2]]:
            for corner in face:
                more[corner] = True
    return more
