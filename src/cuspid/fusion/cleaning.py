"""Remove from a fused mesh what is not surface of the jaw, and report the holes that remain.

Faces are *connected* across edges that exactly two of them share.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.geometry.graph import parts_of
from cuspid.model.mesh import Mesh, used_vertices
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range


@dataclass(frozen=True, kw_only=True)
class CleaningOptions(Options):
    """Cleaning of a fused mesh. Lengths are given in details: what the images resolve of the surface (12 um for the
    built-in handpieces), about a pixel."""

    min_piece_width: Annotated[float, Range(0, 100_000)] = 40.0
    """Connected pieces with less area than a square of this side, in details (0.2 mm2 at 12 um), are removed."""
    min_piece_share: Annotated[float, Range(0, 1)] = 0.005
    """Connected pieces with less than this share of the total area are removed."""
    spared_piece_share: Annotated[float, Range(0, 1)] = 0.05
    """Connected pieces with at least this share of the area of the largest one are kept, however small."""
    ghost_depth: Annotated[float, Range(0, 100_000)] = 41.6
    """A face that looks at the back of another one within this many details (0.5 mm at 12 um) is removed."""


@dataclass(frozen=True, kw_only=True)
class Hole:
    """A closed boundary of the mesh other than the longest one of its piece."""

    perimeter_mm: float
    """Length of the boundary."""
    area_mm2: float
    """Area of the fan from the boundary's centroid."""


@dataclass(frozen=True, kw_only=True)
class CleaningReport:
    """What was removed or moved, and which holes remain."""

    removed_pieces: int
    """Floating pieces."""
    removed_piece_faces: int
    """Faces of floating pieces."""
    removed_ghost_faces: int
    """Faces behind the surface."""
    removed_non_manifold_faces: int
    """Faces that shared an edge with two or more others."""
    split_vertices: int
    """Vertices that were duplicated where two fans of faces met in a point."""
    holes: tuple[Hole, ...]
    """Open places inside the surface, largest first."""
    outer_boundary_mm: float
    """Length of the outer boundaries, one for each piece."""
    sharpened_vertices: int = 0
    """Vertices that were moved afterwards onto sharp edges (:mod:`cuspid.fusion.sharp_edges`)."""
    scale: Literal["known", "unknown"] = "known"
    """unknown: all lengths are in an arbitrary unit, whatever the names say."""
    funnel: Mapping[str, float] | None = None
    """What was left of the pixels from step to step, % (:class:`cuspid.model.reconstruction.Funnel`); None where that
    is not known."""


def clean(mesh: Mesh, detail_mm: float, options: CleaningOptions | None = None) -> tuple[Mesh, CleaningReport]:
    """A manifold mesh without floating pieces and ghosts, and a report. An empty mesh stays empty.

    ``detail_mm`` is the detail that the images show (:func:`cuspid.model.pairing.detail_mm`), the unit of lengths.
    """
    options = options or CleaningOptions()
    ghosts = ghost_faces(mesh, options.ghost_depth * detail_mm)
    cleaned = mesh.submesh(~ghosts)
    crowded = non_manifold_faces(cleaned)
    cleaned = cleaned.submesh(~crowded)
    sides = _Sides.of(cleaned)
    cleaned, split = _split_fans(cleaned, sides)  # which leaves the sides as they are
    floating, pieces = _floating_pieces(cleaned.face_areas, sides.face_pieces, detail_mm, options)
    cleaned = cleaned.submesh(~floating)
    outer, holes = boundaries(cleaned)
    report = CleaningReport(
        removed_pieces=pieces,
        removed_piece_faces=int(floating.sum()),
        removed_ghost_faces=int(ghosts.sum()),
        removed_non_manifold_faces=int(crowded.sum()),
        split_vertices=split,
        holes=holes,
        outer_boundary_mm=outer,
    )
    return cleaned, report


def ghost_faces(mesh: Mesh, depth_mm: float) -> Bool[np.ndarray, "f"]:
    """Faces whose outward normal meets the back of another face within that depth: they lie below the surface."""
    if len(mesh.faces) == 0:
        return np.zeros(0, dtype=bool)
    start = mesh.face_centres + depth_mm / 500 * mesh.face_normals
    normals = mesh.face_normals
    behind = mesh.cast_on_all_cores(start, normals, depth_mm).faces
    same_way = np.einsum("nd,nd->n", normals, normals[behind]) > 0
    return (behind >= 0) & same_way


class _Sides(NamedTuple):
    """The sides of faces: those that begin at their first corners, then at their second ones, then at their third."""

    ends: Int[np.ndarray, "s 2"]
    """Two vertices, in order."""
    edge: Int[np.ndarray, "s"]
    """Number of the undirected edge."""
    before: Int[np.ndarray, "s"]
    """The side before, of those of the same edge; -1 for the first."""

    @staticmethod
    def of(mesh: Mesh) -> _Sides:
        """Of all faces."""
        ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        return _Sides(ends, *_join_sides(ends.min(axis=1), ends.max(axis=1), len(mesh.vertices)))

    @property
    def uses(self) -> Int[np.ndarray, "e"]:
        """How many sides each edge has."""
        return np.bincount(self.edge, minlength=1)

    @property
    def pairs(self) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
        """Sides of one edge, each with the one before."""
        later = np.flatnonzero(self.before >= 0)
        return self.before[later], later

    @property
    def face_pieces(self) -> Int[np.ndarray, "f"]:
        """Number of the connected piece that each face belongs to."""
        (one, other), faces = self.pairs, len(self.ends) // 3
        return parts_of(np.stack([one % faces, other % faces], axis=1), faces)


@kernel
@no_type_check
def _join_sides(low, high, vertices):
    """Of sides by their two vertices: the number of their edge, and the side before that has the same."""
    start = np.zeros(vertices + 2, np.int64)
    for vertex in low:
        start[vertex + 2] += 1
    for vertex in range(vertices):
        start[vertex + 2] += start[vertex + 1]
    around = np.empty(len(low), np.int64)
    edge, before, count = np.empty(len(low), np.int64), np.full(len(low), -1), 0
    for side, vertex in enumerate(low):
        around[start[vertex + 1]] = side
        start[vertex + 1] += 1
    for vertex in range(vertices):
        for k in range(start[vertex], start[vertex + 1]):
            side = around[k]
            edge[side] = count
            for m in range(k - 1, start[vertex] - 1, -1):
                if high[around[m]] == high[side]:
                    edge[side], before[side] = edge[around[m]], around[m]
                    break
            count += edge[side] == count
    return edge, before


def non_manifold_faces(mesh: Mesh) -> Bool[np.ndarray, "f"]:
    """Faces with an edge that three or more faces share, or that two share in the same direction, and faces without
    area."""
    sides = _Sides.of(mesh)
    forward = sides.ends[:, 0] < sides.ends[:, 1]
    count = sides.uses
    along = np.bincount(sides.edge, forward, minlength=1)
    bad = (count > 2) | ((count == 2) & (along != 1))
    return bad[sides.edge].reshape(3, -1).any(axis=0) | (mesh.face_areas == 0)


def _floating_pieces(
    areas: Float[np.ndarray, "f"], pieces: Int[np.ndarray, "f"], detail_mm: float, options: CleaningOptions
) -> tuple[Bool[np.ndarray, "f"], int]:
    """Faces of pieces that are small in details or beside the total, and beside the largest one; and the number of such
    pieces."""
    area = np.bincount(pieces, areas)
    least_mm2 = max((options.min_piece_width * detail_mm) ** 2, options.min_piece_share * area.sum())
    small = (area < least_mm2) & (area < options.spared_piece_share * area.max(initial=0.0))
    return small[pieces], int(small.sum())


def _split_fans(mesh: Mesh, sides: _Sides) -> tuple[Mesh, int]:
    """The mesh with a separate vertex for each fan of faces around a point, and how many vertices were added."""
    corners = mesh.faces.size
    if corners == 0:
        return mesh, 0
    # Corners (face-major) of one fan are joined where two faces share an edge.
    one, other = sides.pairs
    count = len(mesh.faces)
    start = [side % count * 3 + side // count for side in (one, other)]
    end = [side % count * 3 + (side // count + 1) % 3 for side in (one, other)]
    # The two faces run along the edge in opposite directions.
    same = np.stack([np.concatenate([start[0], end[0]]), np.concatenate([end[1], start[1]])], axis=1)
    fan = parts_of(same, corners)
    source = np.empty(fan.max() + 1, dtype=np.int64)
    source[fan] = mesh.faces.ravel()
    colors = None if mesh.colors is None else mesh.colors[source]
    used = len(used_vertices(mesh.faces, len(mesh.vertices)))
    return Mesh(mesh.vertices[source], fan.reshape(-1, 3), colors), len(source) - used


def boundaries(mesh: Mesh) -> tuple[float, tuple[Hole, ...]]:
    """Length of the outer boundaries (the longest of each piece, mm), and the others as holes, largest first."""
    sides, loop, outer = _open_loops(mesh)
    perimeter, area = _loop_measures(mesh.vertices[sides], loop)
    holes = [
        Hole(perimeter_mm=float(perimeter[k]), area_mm2=float(area[k]))
        for k in np.argsort(-perimeter, kind="stable")
        if not outer[k]
    ]
    return float(perimeter[outer].sum()), tuple(holes)


def hole_rims(mesh: Mesh) -> Int[np.ndarray, "n"]:
    """Indices of the vertices on the rims of holes, that is, of all boundaries except the longest of each piece."""
    sides, loop, outer = _open_loops(mesh)
    return np.unique(sides[~outer[loop]])


def _open_loops(mesh: Mesh) -> tuple[Int[np.ndarray, "s 2"], Int[np.ndarray, "s"], Bool[np.ndarray, "l"]]:
    """Sides of one face alone, the loop of each, and which of the loops are outer ones."""
    sides = _Sides.of(mesh)
    alone = sides.uses[sides.edge] == 1
    open_sides = sides.ends[alone]
    if len(open_sides) == 0:
        return open_sides, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool)
    face = np.tile(np.arange(len(mesh.faces)), 3)[alone]
    _, loop = np.unique(parts_of(open_sides, len(mesh.vertices))[open_sides[:, 0]], return_inverse=True)
    perimeter, _ = _loop_measures(mesh.vertices[open_sides], loop)
    piece_of_loop = np.zeros(len(perimeter), dtype=np.int64)
    piece_of_loop[loop] = sides.face_pieces[face]
    by_length = np.argsort(-perimeter, kind="stable")
    _, outermost = np.unique(piece_of_loop[by_length], return_index=True)
    outer = np.zeros(len(perimeter), dtype=bool)
    outer[by_length[outermost]] = True
    return open_sides, loop, outer


def _loop_measures(
    segments: Float[np.ndarray, "s 2 3"], loop: Int[np.ndarray, "s"]
) -> tuple[Float[np.ndarray, "l"], Float[np.ndarray, "l"]]:
    """Perimeter and area of the fan from the centroid, for each boundary loop."""
    count = np.bincount(loop)
    if len(count) == 0:
        return np.zeros(0), np.zeros(0)
    centroid = np.stack([np.bincount(loop, segments[:, 0, axis]) for axis in range(3)], axis=1) / count[:, None]
    to_start, to_end = segments[:, 0] - centroid[loop], segments[:, 1] - centroid[loop]
    perimeter = np.bincount(loop, np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1))
    area = np.bincount(loop, 0.5 * np.linalg.norm(np.cross(to_start, to_end), axis=1))
    return perimeter, area
