"""Which way the faces of a mesh look: files come with faces that look inwards, some of them or all.

Neighbours whose shared edge runs the same way in both look to different sides; each piece is made to look to one side,
that of most of its area. Rays decide which side is outside: from the outside of a surface most directions are free,
from its inside (of a closed one) none, and under the crowns of an open scan few. A piece is turned only if its front
sees less than half of the directions, and clearly less than its back: a hollow, seen from inside, is left as it is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cuspid.geometry import freeze
from cuspid.model.mesh import Mesh, edges_of

_SAMPLES, _DIRECTIONS = 3000, 64
_FEWEST = 24
"""Samples on a piece that tell where its outside is."""
_STEP = 1e-4
"""Rays start so far from the surface, as a share of the size of the mesh."""
_HIDDEN = 0.5
"""The inside of a surface sees less of all directions."""
_CLEARLY = 0.12
"""By how much less the inside sees than the outside, at least."""
_TORN = 0.02
"""Share of the edges that are left torn where a mesh is beyond mending."""
_FAR_MORE = 4.0
"""Times the surface that looks outwards, so that what does not tell looks inwards, too."""
_Share = Any
"""One, or an array of them."""
_GRAZING = 0.1
"""Cosine of directions along the surface, which are not counted."""


def facing_outwards(mesh: Mesh) -> tuple[Mesh, tuple[str, ...]]:
    """The mesh with faces that look inwards turned, and notes on that; the mesh itself where none does."""
    one, other, against = _neighbours(mesh)
    uneven, pieces = _inconsistent_faces(mesh, one, other, against)
    even = _flip_faces(mesh, uneven)
    turned = uneven ^ _inwards(even, pieces)
    left = float(np.mean((against ^ turned[one] ^ turned[other]) if len(one) else 0.0))
    notes: tuple[str, ...] = ()
    if turned.any():
        notes = (f"faces: {_note(mesh, turned)} looked inwards; turned to look out of the surface",)
    if left > _TORN:
        notes = (*notes, f"faces: {left:.0%} of the edges join faces that look to different sides; repair the mesh")
    return (_flip_faces(mesh, turned) if turned.any() else mesh), notes


def pieces_of(mesh: Mesh) -> Int[np.ndarray, "f"]:
    """The number of the piece of each face; faces that share an edge are of one piece."""
    one, other, _ = _neighbours(mesh)
    return _connected_components(len(mesh.faces), one, other)


def _note(mesh: Mesh, turned: Bool[np.ndarray, "f"]) -> str:
    share = float(mesh.face_areas[turned].sum() / max(float(mesh.face_areas.sum()), 1e-300))
    return "all" if turned.all() else f"{turned.sum()} of {len(turned)} ({share:.0%} of the surface)"


def _flip_faces(mesh: Mesh, faces: Bool[np.ndarray, "f"]) -> Mesh:
    if not faces.any():
        return mesh
    return Mesh(mesh.vertices, freeze(np.where(faces[:, None], mesh.faces[:, [0, 2, 1]], mesh.faces)), mesh.colors)


def _neighbours(mesh: Mesh) -> tuple[Int[np.ndarray, "e"], Int[np.ndarray, "e"], Bool[np.ndarray, "e"]]:
    """The two faces of each edge that has two, and whether they look to different sides of it."""
    edges = edges_of(mesh.faces)
    keys = edges.min(axis=1) * len(mesh.vertices) + edges.max(axis=1)
    order = np.argsort(keys, kind="stable")
    begins = np.flatnonzero(np.diff(keys[order], prepend=-1))
    pairs = begins[np.diff(begins, append=len(keys)) == 2]
    first, second = order[pairs], order[pairs + 1]
    return first // 3, second // 3, edges[first, 0] == edges[second, 0]


def _inconsistent_faces(
    mesh: Mesh, one: Int[np.ndarray, "e"], other: Int[np.ndarray, "e"], against: Bool[np.ndarray, "e"]
) -> tuple[Bool[np.ndarray, "f"], Int[np.ndarray, "f"]]:
    """The faces that look to the other side than most of their piece does, and the number of the piece of each face.

    Each face is there twice, as it is and turned; what belongs together hangs together. A piece in which a face hangs
    together with itself turned has no two sides, and is left as it is.
    """
    count = len(mesh.faces)
    piece = _connected_components(count, one, other)
    if not against.any():
        return np.zeros(count, dtype=bool), piece
    as_is, turned = np.where(against, other + count, other), np.where(against, other, other + count)
    sheet = _connected_components(2 * count, np.concatenate([one, one + count]), np.concatenate([as_is, turned]))
    one_sided = sheet[:count] == sheet[count:]
    first = np.full(int(piece.max()) + 1, np.iinfo(np.int64).max)
    np.minimum.at(first, piece, np.minimum(sheet[:count], sheet[count:]))
    is_second = (sheet[:count] != first[piece]) & ~one_sided
    areas = [np.bincount(piece, mesh.face_areas * each, minlength=len(first)) for each in (is_second, ~is_second)]
    keep_second = (areas[0] > areas[1])[piece]
    return np.where(one_sided, False, is_second ^ keep_second), piece


def _connected_components(count: int, one: Int[np.ndarray, "e"], other: Int[np.ndarray, "e"]) -> Int[np.ndarray, "n"]:
    """The number of the piece of each of some nodes that links join."""
    links = coo_array((np.ones(len(one), dtype=bool), (one, other)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def _inwards(mesh: Mesh, piece: Int[np.ndarray, "f"]) -> Bool[np.ndarray, "f"]:
    """The faces of pieces whose front is the inside, among the others and alone; what does not tell goes along with the
    rest, if nearly all of that is turned."""
    count = int(piece.max()) + 1
    faces, ahead, behind = _openness(mesh)
    known, ahead, behind = _piece_means(piece[faces], ahead, behind, count)
    inwards = known & _is_inside(ahead, behind)
    for each in np.flatnonzero(inwards):
        _, alone, back = _openness(mesh.submesh(piece == each))
        inwards[each] = _is_inside(alone.mean(), back.mean())
    outwards = known & (ahead > behind + _CLEARLY)
    areas = np.bincount(piece, mesh.face_areas, minlength=count)
    if areas[inwards].sum() > _FAR_MORE * areas[outwards].sum():
        inwards = ~outwards
    return np.asarray(inwards[piece])


def _is_inside(front: _Share, back: _Share) -> _Share:
    """Whether the front of a surface is its inside, by the shares of the directions that are free."""
    return (front < _HIDDEN) & (back > front + _CLEARLY)


def _piece_means(
    owners: Int[np.ndarray, "n"], front: Float[np.ndarray, "n"], back: Float[np.ndarray, "n"], count: int
) -> tuple[Bool[np.ndarray, "p"], Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """Which pieces have enough samples, and the means of theirs."""
    samples = np.bincount(owners, minlength=count)
    ahead, behind = (np.bincount(owners, each, minlength=count) / np.maximum(samples, 1) for each in (front, back))
    return samples >= _FEWEST, ahead, behind


def _openness(mesh: Mesh) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Faces at places that are uniform by area, and the shares of the directions that are free before and behind
    each."""
    size = max(float(np.ptp(mesh.bounds, axis=0).max()), 1e-300)
    near = Mesh((mesh.vertices - mesh.bounds.mean(axis=0)) / size, mesh.faces)
    points, faces = near.sample(_SAMPLES, np.random.default_rng(0))
    normals, directions = near.normals_of(faces), _even_directions(_DIRECTIONS)
    cosines = normals @ directions.T
    place, way = np.nonzero(np.abs(cosines) > _GRAZING)
    side = np.sign(cosines[place, way])
    free = near.cast(points[place] + _STEP * side[:, None] * normals[place], directions[way]).faces < 0
    front, back = (_mean_of(place[here], free[here], len(faces)) for here in (side > 0, side < 0))
    return faces, front, back


def _mean_of(owners: Int[np.ndarray, "n"], values: Bool[np.ndarray, "n"], count: int) -> Float[np.ndarray, "k"]:
    """Mean of the values of each owner."""
    summed = np.bincount(owners, values, minlength=count)
    return np.asarray(summed / np.maximum(np.bincount(owners, minlength=count), 1))


def _even_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Unit vectors all around, evenly (on a spiral)."""
    k = np.arange(count) + 0.5
    z, angle = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
