"""Surface nets: the zero level of a sparse volume as a mesh (Gibson 1998; "naive" form).

Each cell of eight voxels that the surface crosses gets one vertex, the mean of the crossings of its edges; each grid
edge that the surface crosses gets the quad of the four cells around it. Cells with an unobserved voxel are left out,
so that no surface is invented.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int, Shaped

from cuspid.fusion.volume import BLOCK, SparseVolume, find, neighbour_keys, pack, unpack
from cuspid.model.mesh import Mesh
from cuspid.runtime.kernels import kernel
from cuspid.runtime.workers import map_slices

PART = 4
"""Blocks along the side of a part."""
_FEW = 200
"""Fewer blocks are not shared by threads."""


@kernel
@no_type_check
def _place(neighbours, slot, i, j, k):
    """Slot (-1: none) and index of a voxel given relative to a block, up to one block away."""
    bi, bj, bk = i >> 3, j >> 3, k >> 3
    other = neighbours[slot, (bi + 1) * 9 + (bj + 1) * 3 + bk + 1]
    return other, ((i & 7) * 8 + (j & 7)) * 8 + (k & 7)


@kernel
@no_type_check
def _corners(distance, weight, neighbours, slot, i, j, k, min_weight, values):
    """Distances at the eight corners of a cell; False where one is unobserved or the surface does not cross."""
    inside = 0
    for corner in range(8):
        other, index = _place(neighbours, slot, i + (corner >> 2), j + ((corner >> 1) & 1), k + (corner & 1))
        if other < 0 or weight[other, index] < min_weight:
            return False
        values[corner] = distance[other, index]
        inside += values[corner] < 0
    return 0 < inside < 8


@kernel
@no_type_check
def _cell_vertex(values, vertex):
    """Mean of the crossings of the twelve edges of a cell, in units of the cell."""
    vertex[:] = 0
    count = 0
    for corner in range(8):
        for axis in range(3):
            bit = 4 >> axis
            if corner & bit:
                continue
            a, b = values[corner], values[corner | bit]
            if (a < 0) != (b < 0):
                vertex[0] += corner >> 2
                vertex[1] += (corner >> 1) & 1
                vertex[2] += corner & 1
                vertex[axis] += a / (a - b)
                count += 1
    for axis in range(3):
        vertex[axis] /= count


@kernel
@no_type_check
def _vertices(distance, weight, neighbours, origins, min_weight, index_of_cell, first, last, row, vertices):
    """A vertex (grid units) for each cell of some blocks that the surface crosses, from a row on; returns the row after
    them. Without room for ``vertices`` they are only counted."""
    values, vertex = np.zeros(8), np.zeros(3)
    for slot in range(first, last):
        for voxel in range(512):
            i, j, k = voxel >> 6, (voxel >> 3) & 7, voxel & 7
            if not _corners(distance, weight, neighbours, slot, i, j, k, min_weight, values):
                continue
            if vertices.shape[0] > 0:
                _cell_vertex(values, vertex)
                index_of_cell[slot, voxel] = row
                vertices[row, 0] = origins[slot, 0] + i + vertex[0]
                vertices[row, 1] = origins[slot, 1] + j + vertex[1]
                vertices[row, 2] = origins[slot, 2] + k + vertex[2]
            row += 1
    return row


@kernel
@no_type_check
def _quad_around(index_of_cell, neighbours, slot, i, j, k, axis, quad):
    """Vertices of the four cells around the grid edge that leaves a voxel along an axis; False where one is missing."""
    for n in range(4):
        # Around the axis, counter-clockwise seen from its tip: (-,-), (0,-), (0,0), (-,0) of the next two axes.
        first, second = -(n == 0 or n == 3), -(n == 0 or n == 1)
        shift_i = 0 if axis == 0 else (first if axis == 2 else second)
        shift_j = first if axis == 0 else (0 if axis == 1 else second)
        shift_k = second if axis == 0 else (first if axis == 1 else 0)
        other, index = _place(neighbours, slot, i + shift_i, j + shift_j, k + shift_k)
        if other < 0 or index_of_cell[other, index] < 0:
            return False
        quad[n] = index_of_cell[other, index]
    return True


@kernel
@no_type_check
def _faces(distance, weight, neighbours, index_of_cell, min_weight, first, last, row, faces):
    """Two triangles for each grid edge of some blocks that the surface crosses, as :func:`_vertices`."""
    quad = np.zeros(4, np.int64)
    for slot in range(first, last):
        for voxel in range(512):
            if weight[slot, voxel] < min_weight:
                continue
            i, j, k = voxel >> 6, (voxel >> 3) & 7, voxel & 7
            here = distance[slot, voxel] < 0
            for axis in range(3):
                other, index = _place(neighbours, slot, i + (axis == 0), j + (axis == 1), k + (axis == 2))
                if other < 0 or weight[other, index] < min_weight or (distance[other, index] < 0) == here:
                    continue
                if not _quad_around(index_of_cell, neighbours, slot, i, j, k, axis, quad):
                    continue
                if faces.shape[0] > 0:
                    a, c = quad[0], quad[2]
                    b, d = (quad[1], quad[3]) if here else (quad[3], quad[1])
                    faces[row, 0], faces[row, 1], faces[row, 2] = a, b, c
                    faces[row + 1, 0], faces[row + 1, 1], faces[row + 1, 2] = a, c, d
                row += 2
    return row


def _rows(find: Callable[[int, int, int, np.ndarray], int], blocks: int, dtype: type) -> Shaped[np.ndarray, "n 3"]:
    """What a kernel finds in blocks, in their order, by all cores; ``find`` gets the first of its blocks and the one
    after them, its first row, and the array."""
    none: np.ndarray = np.zeros((0, 3), dtype)
    parts = map_slices(lambda part: (part, find(part.start, part.stop, 0, none)), blocks, few=_FEW)
    ends = np.cumsum([0, *(count for _, count in parts)]).tolist()
    rows = np.zeros((ends[-1], 3), dtype)
    if len(rows):
        row = {part.start: first for (part, _), first in zip(parts, ends, strict=False)}
        map_slices(lambda part: find(part.start, part.stop, row[part.start], rows), blocks, few=_FEW)
    return rows


@dataclass(frozen=True, eq=False)
class _Grid:
    """Some blocks of a volume."""

    keys: Int[np.ndarray, "b"]
    distance: Float[np.ndarray, "b v"]
    weight: Float[np.ndarray, "b v"]

    def surface(
        self, min_weight: float
    ) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], Int[np.ndarray, "v"]]:
        """Vertices (grid units) and faces of the zero level, and which block each vertex is in. The third corner of the
        first and the second of the second triangle of each pair is in the block that the pair belongs to."""
        index_of_cell = np.full(self.distance.shape, -1, dtype=np.int32)
        origins = unpack(self.keys).astype(np.float64) * BLOCK
        grid = (self.distance, self.weight, find(self.keys, neighbour_keys(self.keys)))
        blocks = len(self.keys)
        vertices = _rows(partial(_vertices, *grid, origins, min_weight, index_of_cell), blocks, np.float64)
        faces = _rows(partial(_faces, *grid, index_of_cell, min_weight), blocks, np.int64)
        return vertices, faces, np.repeat(np.arange(len(self.keys)), (index_of_cell >= 0).sum(axis=1))


def extract(volume: SparseVolume, min_weight: float) -> Mesh:
    """The zero level of the volume, where all voxels around it have at least the weight ``min_weight``."""
    keys = volume.keys
    if len(keys) == 0:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    grid = _Grid(keys, volume.distance[: len(keys)], volume.weight[: len(keys)])
    vertices, faces, _ = grid.surface(min_weight)
    return Mesh(vertices * volume.voxel_mm, faces)


def extract_parts(volume: SparseVolume, min_weight: float, parts: Iterable[int]) -> dict[int, Mesh]:
    """The same in some parts of the volume, by their keys (:func:`part_of`), each with vertices of its own: together
    the parts are the whole."""
    asked, keys = np.array(sorted(parts), dtype=np.int64), volume.keys
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    found = dict.fromkeys(asked.tolist(), empty)
    owned = keys[np.isin(part_of(keys), asked)]
    if len(owned) == 0:
        return found
    near = np.flatnonzero(np.isin(keys, neighbour_keys(owned)))
    grid = _Grid(keys[near], volume.distance[near], volume.weight[near])
    vertices, faces, block = grid.surface(min_weight)
    part = np.repeat(part_of(grid.keys)[block[faces[::2, 2]]], 2)
    mesh = Mesh(vertices * volume.voxel_mm, faces)
    return found | {key: mesh.submesh(part == key) for key in np.intersect1d(part, asked).tolist()}


def part_of(keys: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    """Key of the part, a cube of some blocks, that each block lies in."""
    return pack(unpack(keys) // PART)
