"""Sharp convex edges of a fused mesh, as preparations have them: vertices beside them are moved onto them.

The faces of a grid's surface cut edges off, by up to a third of a voxel, and windows of stereo round them. So, as in
feature-sensitive surface extraction (L. Kobbelt et al., SIGGRAPH 2001), a vertex beside an edge is moved to where its
two flanks meet. The flanks are planes through what lies around, farther than an edge is rounded by the measurement.

Few edges are sharp, and a round one must stay round. Along a round one normals turn evenly: if the faces around are
parted into two kinds by their normals, the mean squared angle to the nearer of the two directions is 1/12 of the
squared angle between these; where two planes meet it is near 0. A limit between the two tells them apart, whatever the
scale, and noise of the normals speaks against an edge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.fusion.bends import find_bends
from cuspid.fusion.volume import neighbour_keys, pack
from cuspid.model.mesh import Mesh, used_vertices
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range
from cuspid.runtime.workers import run_in_shares

_RINGS = 2
"""So many vertices beside a place where the surface bends are tried, too."""
_LEAST_FLANK = 0.12
"""Share of the surface around that each flank must have."""
_ROUNDS = 6
"""Of the search for the two directions."""
_WIDE = 0.85
"""Cosine of the angle within which a flank's faces are looked for at first."""
_MOST_FACES, _LEAST_FACES = 8192, 20
_TURNED = 0.2
"""A face whose normal has a smaller cosine to what it was has turned over, or nearly so."""


@dataclass(frozen=True, kw_only=True)
class SharpEdgeOptions(Options):
    """Restoring sharp convex edges. Lengths are given in details that the handpiece shows (12 um for the built-in
    ones)."""

    enabled: bool = True
    """Whether to do it at all."""
    reach: Annotated[float, Range(1, 1000)] = 16.5
    """The flanks are looked for within this distance (0.2 mm at 12 um)."""
    inner: Annotated[float, Range(0, 1000)] = 5.0
    """What lies within this distance from an edge may be rounded or cut off, and does not show where it is (0.06 mm at
    12 um)."""
    max_outwards: Annotated[float, Range(0.01, 1000)] = 2.0
    """What lies farther below an edge than measuring rounds it (0.024 mm at 12 um) is round."""
    flatness: Annotated[float, Range(0.001, 1000)] = 0.5
    """Largest RMS distance of the flanks from planes (0.006 mm at 12 um)."""
    min_angle_deg: Annotated[float, Range(1, 179)] = 30.0
    """Smallest angle between the flanks' normals."""
    roundness: Annotated[float, Range(0, 1)] = 0.025
    """Largest mean squared angle to the nearer flank, as a share of the squared angle between them: 0.083 for what is
    evenly round, 0 for two planes."""


def sharpen_edges(mesh: Mesh, detail_mm: float, options: SharpEdgeOptions | None = None) -> tuple[Mesh, int]:
    """The mesh with its sharp convex edges, and how many vertices were moved. Faces stay as they are, but for their
    corners.

    ``detail_mm`` is the detail that the handpiece shows (:func:`cuspid.model.pairing.detail_mm`).
    """
    options = options or SharpEdgeOptions()
    if not options.enabled:
        return mesh, 0
    candidates = find_bends(mesh, _RINGS)
    if not candidates.any():
        return mesh, 0
    near = _within_reach(mesh, candidates, options.reach * detail_mm)
    used = used_vertices(mesh.faces[near], len(mesh.vertices))
    vertices = mesh.vertices.copy()
    vertices[used] = _move_to_edges(mesh.submesh(near), np.flatnonzero(candidates[used]), detail_mm, options)
    return replace(mesh, vertices=vertices), int((vertices != mesh.vertices).any(axis=1).sum())


def _move_to_edges(
    mesh: Mesh, candidates: Int[np.ndarray, "c"], detail_mm: float, options: SharpEdgeOptions
) -> Float[np.ndarray, "v 3"]:
    """The vertices, with those of the candidates that an edge asks for on it."""
    foot, along = _lines(mesh, candidates, detail_mm, options)
    places = _targets_on_edges(mesh, foot, along, options.max_outwards * detail_mm)
    return _undo_flips(mesh, np.flatnonzero(np.isfinite(places[:, 0])), places)


def _within_reach(mesh: Mesh, candidates: Bool[np.ndarray, "v"], reach_mm: float) -> Bool[np.ndarray, "f"]:
    """The faces that a candidate may reach, and some more: an edge is looked for in a small part of a mesh."""
    cells = pack(np.floor(mesh.vertices / reach_mm).astype(np.int64))
    near = np.isin(cells, neighbour_keys(np.unique(cells[candidates])))
    return np.asarray(near[mesh.faces].any(axis=1))


class _Surface(NamedTuple):
    """What the kernels see of a mesh."""

    vertices: np.ndarray
    faces: np.ndarray
    centres: np.ndarray
    normals: np.ndarray
    areas: np.ndarray
    start: np.ndarray
    """Where the faces around each vertex begin in ``incident``; one more for the end."""
    incident: np.ndarray

    @staticmethod
    def of(mesh: Mesh) -> _Surface:
        """With the faces around each vertex."""
        start = np.concatenate([[0], np.cumsum(np.bincount(mesh.faces.ravel(), minlength=len(mesh.vertices)))])
        incident = np.argsort(mesh.faces.ravel(), kind="stable") // 3
        return _Surface(
            mesh.vertices, mesh.faces, mesh.face_centres, mesh.face_normals, mesh.face_areas, start, incident
        )


class _Limits(NamedTuple):
    """What makes an edge."""

    reach: float
    inner: float
    angle: float
    flatness: float
    roundness: float


def _lines(
    mesh: Mesh, candidates: Int[np.ndarray, "c"], detail_mm: float, options: SharpEdgeOptions
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v 3"]]:
    """For each vertex beside a sharp convex edge the nearest place of the line where its flanks meet, and that line's
    direction; NaN elsewhere."""
    foot, along = np.full((2, *mesh.vertices.shape), np.nan)
    surface = _Surface.of(mesh)
    limits = _Limits(
        reach=options.reach * detail_mm,
        inner=options.inner * detail_mm,
        angle=float(np.deg2rad(options.min_angle_deg)),
        flatness=options.flatness * detail_mm,
        roundness=options.roundness,
    )

    def work(share: int, shares: int) -> None:
        _find_lines(surface, candidates, share, shares, limits, foot, along)

    run_in_shares(work)
    inwards = ~(_outwards(mesh, np.arange(len(foot)), foot) > 0)
    foot[inwards] = along[inwards] = np.nan
    return foot, along


def _targets_on_edges(
    mesh: Mesh, foot: Float[np.ndarray, "v 3"], along: Float[np.ndarray, "v 3"], most_mm: float
) -> Float[np.ndarray, "v 3"]:
    """New places of the vertices, NaN for those that stay: of the two ends of each side of a face that crosses an edge,
    the one that is nearer to it comes to lie on it. Then no face cuts it off."""
    sides_of_faces = np.concatenate([mesh.faces[:, ends] for ends in ([0, 1], [1, 2], [2, 0], [1, 0], [2, 1], [0, 2])])
    known, other = sides_of_faces[np.isfinite(foot[sides_of_faces[:, 0], 0])].T
    across = np.cross(along[known], mesh.vertex_normals[known])
    ends, feet, distances, sides = [known, other], [], [], []
    for end in ends:
        away = mesh.vertices[end] - foot[known]
        sides.append((away * across).sum(axis=1))
        lengthwise = (away * along[known]).sum(axis=1, keepdims=True) * along[known]
        feet.append(foot[known] + lengthwise)
        distances.append(np.linalg.norm(away - lengthwise, axis=1))
    first = distances[0] <= distances[1]
    near, place = np.where(first, *ends), np.where(first[:, None], *feet)
    outwards = _outwards(mesh, near, place)
    crossed = (sides[0] * sides[1] < 0) & (outwards > 0) & (outwards < most_mm)
    places = np.full(mesh.vertices.shape, np.nan)
    places[near[crossed]] = place[crossed]
    own = np.flatnonzero(np.isfinite(places[:, 0]) & np.isfinite(foot[:, 0]))
    own = own[_outwards(mesh, own, foot[own]) < most_mm]
    places[own] = foot[own]
    return places


def _outwards(mesh: Mesh, vertices: Int[np.ndarray, "n"], places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """How far outwards of vertices these places lie, mm."""
    return np.asarray(((places - mesh.vertices[vertices]) * mesh.vertex_normals[vertices]).sum(axis=1))


def _undo_flips(mesh: Mesh, moved: Int[np.ndarray, "n"], places: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    """The vertices with those that are moved, but for corners of faces that would turn over."""
    vertices = mesh.vertices.copy()
    vertices[moved] = places[moved]
    beside = np.flatnonzero(np.isin(mesh.faces, moved).any(axis=1))
    before = mesh.normals_of(beside)
    while True:
        after = Mesh(vertices, mesh.faces[beside]).face_normals
        corners = np.unique(mesh.faces[beside[(before * after).sum(axis=1) < _TURNED]])
        wrong = corners[(vertices[corners] != mesh.vertices[corners]).any(axis=1)]
        if not len(wrong):
            return vertices
        vertices[wrong] = mesh.vertices[wrong]


# --- the flanks of one vertex ------------------------------------------------------------------------------------


@kernel
@no_type_check
def _find_lines(surface, candidates, share, shares, limits, foot, along):
    """The line where flanks meet, for every so many-th candidate that has two."""
    known_faces = np.full(len(surface.faces), -1, np.int32)
    known_vertices = np.full(len(surface.vertices), -1, np.int32)
    found, queue = np.empty(_MOST_FACES, np.int64), np.empty(_MOST_FACES, np.int64)
    normals, middles, place, direction = np.empty((2, 3)), np.empty((2, 3)), np.empty(3), np.empty(3)
    for k in range(share, len(candidates), shares):
        vertex = candidates[k]
        count = _faces_near(surface, vertex, limits.reach, known_faces, known_vertices, found, queue)
        if count < _LEAST_FACES:
            continue
        near = found[:count]
        _first_directions(surface, near, normals)
        if not _two_flanks(surface, near, normals, middles):
            continue
        if _angle(normals) > limits.angle and _are_planes(surface, near, normals, middles, limits):
            _meet(surface.vertices[vertex], normals, middles, place, direction)
            if _planes(surface, near, np.cos(_angle(normals) / 4), place, direction, limits.inner, normals, middles):
                _meet(surface.vertices[vertex], normals, middles, foot[vertex], along[vertex])


@kernel(inline="always")
@no_type_check
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(inline="always")
@no_type_check
def _add(total, weight, what):
    for c in range(3):
        total[c] += weight * what[c]


@kernel(inline="always")
@no_type_check
def _scale(what, factor):
    for c in range(3):
        what[c] *= factor


@kernel
@no_type_check
def _faces_near(surface, vertex, reach, known_faces, known_vertices, found, queue):
    """Faces within reach that are connected with a vertex; their number, 0 if they are too many."""
    first, last, count = 0, 1, 0
    queue[0], known_vertices[vertex] = vertex, vertex
    while first < last:
        here = queue[first]
        first += 1
        for k in range(surface.start[here], surface.start[here + 1]):
            face = surface.incident[k]
            if known_faces[face] == vertex:
                continue
            known_faces[face] = vertex
            square = 0.0
            for c in range(3):
                square += (surface.centres[face, c] - surface.vertices[vertex, c]) ** 2
            if square > reach * reach:
                continue
            if count == _MOST_FACES or last + 3 > _MOST_FACES:
                return 0
            found[count] = face
            count += 1
            for corner in surface.faces[face]:
                if known_vertices[corner] != vertex:
                    known_vertices[corner] = vertex
                    queue[last] = corner
                    last += 1
    return count


@kernel
@no_type_check
def _first_directions(surface, near, normals):
    """The mean normals of the faces to both sides of the plane that parts their normals best."""
    mean, apart, spread = np.zeros(3), np.empty(3), np.zeros((3, 3))
    for face in near:
        _add(mean, surface.areas[face], surface.normals[face])
    _scale(mean, 1 / np.sqrt(_dot(mean, mean)))
    for face in near:
        along = _dot(surface.normals[face], mean)
        for c in range(3):
            apart[c] = surface.normals[face, c] - along * mean[c]
        for c in range(3):
            _add(spread[c], surface.areas[face] * apart[c], apart)
    widest = np.ascontiguousarray(np.linalg.eigh(spread)[1][:, 2])
    normals[:] = 0
    for face in near:
        _add(normals[int(_dot(surface.normals[face], widest) > 0)], surface.areas[face], surface.normals[face])
    for side in range(2):
        _scale(normals[side], 1 / np.sqrt(_dot(normals[side], normals[side])))


@kernel(inline="always")
@no_type_check
def _flank(normal, normals):
    """The flank that a face belongs to, and the cosine of its angle to it."""
    first, second = _dot(normal, normals[0]), _dot(normal, normals[1])
    return (0, first) if first > second else (1, second)


@kernel
@no_type_check
def _planes(surface, near, limit, foot, along, inner, normals, middles):
    """The mean normals and the centroids of the two flanks, of faces within an angle from one of them and not so near
    to a line; False where one of them is small."""
    sums, areas, whole, away = np.zeros((2, 3)), np.zeros(2), 0.0, np.empty(3)
    middles[:] = 0
    for face in near:
        area = surface.areas[face]
        side, cosine = _flank(surface.normals[face], normals)
        whole += area
        if inner > 0:
            for c in range(3):
                away[c] = surface.centres[face, c] - foot[c]
            if _dot(away, away) - _dot(away, along) ** 2 < inner**2:
                continue
        if cosine > limit:
            areas[side] += area
            _add(sums[side], area, surface.normals[face])
            _add(middles[side], area, surface.centres[face])
    if areas.min() < _LEAST_FLANK * whole:
        return False
    for side in range(2):
        normals[side] = sums[side] / np.sqrt(_dot(sums[side], sums[side]))
        _scale(middles[side], 1 / areas[side])
    return True


@kernel(inline="always")
@no_type_check
def _angle(normals):
    return np.arccos(min(max(_dot(normals[0], normals[1]), -1.0), 1.0))


@kernel
@no_type_check
def _two_flanks(surface, near, normals, middles):
    """What :func:`_planes` gives, once the two directions are found; False where there are none."""
    limit, nothing = _WIDE, np.zeros(3)
    for _ in range(_ROUNDS):
        if not _planes(surface, near, limit, nothing, nothing, 0.0, normals, middles):
            return False
        limit = np.cos(_angle(normals) / 4)
    return True


@kernel
@no_type_check
def _are_planes(surface, near, normals, middles, limits):
    """Whether two planes make up what is there."""
    angle = _angle(normals)
    limit, whole, flat, turned, off = np.cos(angle / 4), 0.0, 0.0, 0.0, 0.0
    for face in near:
        area = surface.areas[face]
        side, cosine = _flank(surface.normals[face], normals)
        whole += area
        turned += area * np.arccos(min(max(cosine, -1.0), 1.0)) ** 2
        if cosine > limit:
            flat += area
            distance = _dot(surface.centres[face], normals[side]) - _dot(middles[side], normals[side])
            off += area * distance**2
    return off <= flat * limits.flatness**2 and turned <= whole * limits.roundness * angle**2


@kernel
@no_type_check
def _meet(point, normals, middles, foot, along):
    """The place nearest to a point where two planes meet, and the direction of their line."""
    cosine = _dot(normals[0], normals[1])
    first, second = _dot(point - middles[0], normals[0]), _dot(point - middles[1], normals[1])
    square = 1 - cosine * cosine
    along[:] = np.cross(normals[0], normals[1]) / np.sqrt(square)
    foot[:] = point + (cosine * second - first) / square * normals[0] + (cosine * first - second) / square * normals[1]
