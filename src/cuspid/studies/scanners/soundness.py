"""What is odd about the triangles of a mesh, whatever it shows: faces that are there twice, a surface that cuts itself.

Files of two objects in one, or of a surface with both of its sides, hold each face twice: borders would not be found,
and normals cancel. One of each is used. A surface that cuts itself is left as it is: nothing shows which sheet is
right.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cuspid.geometry import distinct_rows
from cuspid.model.facing import facing_outwards
from cuspid.model.mesh import Mesh, edges_of

_TOLD = 0.01
"""Share of faces that are there twice from which on it is told: exports leave a few slivers."""
_LEAST_CUT = 12
"""Faces that cut each other at one place, at least: noise folds single triangles of a fine mesh."""
_INSIDE = 0.01
"""The ends of an edge, as a share of its length, that touch its neighbours and are not looked at."""


def mend_faces(mesh: Mesh) -> tuple[Mesh, tuple[str, ...]]:
    """One of each face, looking outwards, and what was odd about them."""
    keep, doubled = first_of_each(mesh)
    outwards, turned = facing_outwards(mesh.submesh(keep) if doubled else mesh)
    return outwards, (*doubled, *turned)


def first_of_each(mesh: Mesh) -> tuple[Bool[np.ndarray, "f"], tuple[str, ...]]:
    """The faces without those that are there again, either side up, and what is said of these."""
    first, _ = distinct_rows(np.sort(mesh.faces, axis=1))
    keep = np.zeros(len(mesh.faces), dtype=bool)
    keep[first] = True
    again = len(keep) - len(first)
    if again < _TOLD * len(first):
        return keep, ()
    what = "every face is" if again == len(first) else f"{again} of {len(keep)} faces are"
    return keep, (f"{what} there twice; one of each is used",)


def cut_notes(mesh: Mesh) -> tuple[str, ...]:
    """What is said where the surface cuts itself."""
    places = count_cuts(mesh)
    if not places:
        return ()
    where = "one place" if places == 1 else f"{places} places"
    return (f"the surface cuts itself at {where}; figures there depend on which sheet is nearest",)


def count_cuts(mesh: Mesh) -> int:
    """Number of places where edges of the surface pass through other faces of it, by rays along them (Embree)."""
    one, other = _cuts(mesh)
    if not len(one):
        return 0
    faces, number = np.unique(np.concatenate([one, other]), return_inverse=True)
    first, second = np.split(number.reshape(-1), 2)
    # Faces are of one place if they cut each other or share a corner.
    count, corners = len(faces), mesh.faces[faces]
    links = coo_array(
        (
            np.ones(corners.size + len(first), dtype=bool),
            (
                np.concatenate([np.repeat(np.arange(count), 3), first]),
                np.concatenate([count + corners.ravel(), second]),
            ),
        ),
        shape=(count + len(mesh.vertices),) * 2,
    )
    place = connected_components(links, directed=False)[1][:count]
    return int(np.sum(np.bincount(place) >= _LEAST_CUT))


def _cuts(mesh: Mesh) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """For each edge that passes through a face that it shares no corner with: a face of the edge, and that face."""
    edges = np.sort(edges_of(mesh.faces), axis=1)
    _, first = np.unique(edges[:, 0] * len(mesh.vertices) + edges[:, 1], return_index=True)
    ends = edges[first]
    start = mesh.vertices[ends[:, 0]]
    way = mesh.vertices[ends[:, 1]] - start
    hits = mesh.cast(start + _INSIDE * way, (1 - 2 * _INSIDE) * way, 1.0).faces
    hit = np.flatnonzero(hits >= 0)
    touches = (mesh.faces[hits[hit]][:, :, None] == ends[hit][:, None, :]).any(axis=(1, 2))
    cutting = hit[~touches]
    return first[cutting] // 3, hits[cutting]
