"""A jaw whose crowns are boxes of their own sizes, the worst case for a design with few cameras: every edge is sharp.

The box of a crown is the smallest one along the axes of the tooth that holds the whole crown. It is joined with the jaw
by an exact boolean (manifold3d), which swallows the crown; above the gum its size is that of the crown.

Frame of a box: x along the arch, y across it, z the axis of the tooth, from the middle of its gum margin to the middle
of its top. Its axes are found from the labelled surface alone; right-handed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import manifold3d
import numpy as np
from jaxtyping import Float, Int

from cuspid.anatomy.booleans import close_holes, solid_of
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

_ARCH_ORDER = (*range(48, 40, -1), *range(31, 39), *range(18, 10, -1), *range(21, 29))
"""FDI numbers along the lower and the upper arch."""
_TOP = 0.7
"""The top of a crown is what lies above this share of its height."""
_CLEARANCE_MM = 0.002
"""The box is larger than the crown by this much on each side, so that they do not touch in slivers."""


@dataclass(frozen=True, kw_only=True)
class BoxOptions(Options):
    """What the boxes look like."""

    edge_mm: Annotated[float, Range(0.01, 100)] = 0.3
    """Longest side of the right-angled triangles that the sides of a box are divided into."""
    sink_mm: Annotated[float, Range(0, 100)] = 0.0
    """How far a box extends into the gum below the lowest point of the crown."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Box:
    """The box of a crown."""

    axes: Float[np.ndarray, "3 3"]
    """Columns: along the arch, across it, and along the tooth, in the jaw."""
    low: Float[np.ndarray, "3"]
    """Least coordinates of the crown along the axes, mm."""
    high: Float[np.ndarray, "3"]
    """Greatest coordinates of the crown along the axes, mm."""

    @property
    def size_mm(self) -> Float[np.ndarray, "3"]:
        """Mesiodistal width, buccolingual depth and height of the crown, mm."""
        return self.high - self.low


def box_crowns(jaw: Jaw, options: BoxOptions = BoxOptions()) -> Jaw:
    """The jaw with every crown replaced by its box, watertight, with the FDI number of each face.

    An open scan is closed by a point below it. Landmarks, lines and spheres are dropped: they would not lie on the
    boxes. Raises InputError where the jaw has no tooth labels or its mesh is not the border of a solid.
    """
    if not jaw.teeth or jaw.face_labels is None:
        raise InputError("boxed jaw: the jaw has no tooth labels; label its faces with FDI numbers (0 = gum)")
    whole = close_holes(jaw.mesh)
    before = np.pad(jaw.face_labels, (0, len(whole.faces) - len(jaw.mesh.faces)), constant_values=GUM)
    body = solid_of(whole, "boxed jaw")
    boxes = [_solid_box(box, options) for box in crown_boxes(jaw).values()]
    joined = manifold3d.Manifold.batch_boolean([body, *boxes], manifold3d.OpType.Add)
    outside = max(joined.decompose(), key=lambda part: part.volume())
    out = outside.to_mesh64()
    numbers = dict(zip((int(solid.to_mesh64().run_original_id[0]) for solid in boxes), jaw.teeth, strict=True))
    labels = [np.full(length, numbers[run]) if run in numbers else before[face] for run, length, face in _runs(out)]
    mesh = Mesh(np.asarray(out.vert_properties)[:, :3], np.asarray(out.tri_verts).astype(np.int64))
    return Jaw(mesh=mesh, face_labels=np.concatenate(labels), arch=jaw.arch)


def _runs(out: manifold3d.Mesh64) -> list[tuple[int, int, Int[np.ndarray, "_"]]]:
    """Of each run of faces of a result: the solid that it is from, its length, and the faces of that solid."""
    ends = np.asarray(out.run_index).astype(np.int64) // 3
    faces = np.asarray(out.face_id).astype(np.int64)
    spans = zip(out.run_original_id, ends[:-1], ends[1:], strict=True)
    return [(int(origin), int(stop - start), faces[start:stop]) for origin, start, stop in spans]


# The boxes


def crown_boxes(jaw: Jaw) -> dict[int, Box]:
    """The box of every crown, by FDI number."""
    middles = {fdi: jaw.mesh.submesh(jaw.tooth_faces(fdi)).bounds.mean(axis=0) for fdi in jaw.teeth}
    row = [fdi for fdi in _ARCH_ORDER if fdi in middles]
    along = {fdi: middles[row[min(k + 1, len(row) - 1)]] - middles[row[max(k - 1, 0)]] for k, fdi in enumerate(row)}
    return {fdi: _crown_box(jaw, fdi, along[fdi]) for fdi in jaw.teeth}


def _crown_box(jaw: Jaw, fdi: int, along: Float[np.ndarray, "3"]) -> Box:
    crown = jaw.tooth_faces(fdi)
    points = jaw.mesh.vertices[np.unique(jaw.mesh.faces[crown])]
    axes = _axes(_long_axis(jaw, fdi, points), along)
    placed = points @ axes
    return Box(axes=axes, low=placed.min(axis=0), high=placed.max(axis=0))


def _long_axis(jaw: Jaw, fdi: int, crown: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """From the middle of the gum margin, or of the lowest part where there is none, to that of the top."""
    faces, labels = jaw.mesh.faces, jaw.face_labels
    shared = np.intersect1d(faces[labels == GUM], faces[labels == fdi])
    height = crown[:, 2]
    low, high = height.min(), height.max()
    margin = jaw.mesh.vertices[shared] if len(shared) else crown[height < high - _TOP * (high - low)]
    top = crown[height > low + _TOP * (high - low)]
    return np.asarray(_middle(top) - _middle(margin))


def _middle(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def _axes(long_axis: Float[np.ndarray, "3"], along: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Columns x, y, z: z along the tooth, x as near as can be to the direction of the arch."""
    z = long_axis / np.linalg.norm(long_axis)
    x = along - (along @ z) * z if np.linalg.norm(along) > 0 else np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _solid_box(box: Box, options: BoxOptions) -> manifold3d.Manifold:
    """The box with its sides divided into a grid, sunk into the gum."""
    low = box.low - [_CLEARANCE_MM, _CLEARANCE_MM, options.sink_mm]
    vertices, faces = _grid_box(low, box.high + _CLEARANCE_MM, options.edge_mm)
    return solid_of(Mesh(vertices @ box.axes.T, faces), "box of a crown")


def _grid_box(
    low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], edge_mm: float
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """A box between two corners, each side a grid of right-angled triangles."""
    counts = np.maximum(1, np.ceil((high - low) / edge_mm)).astype(int)
    sides = [_side(axis, end, counts) for axis in range(3) for end in (0, 1)]
    places, inverse = np.unique(np.concatenate([quads.reshape(-1, 3) for quads in sides]), axis=0, return_inverse=True)
    quads = inverse.reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return low + places / counts * (high - low), faces


def _side(axis: int, end: int, counts: Sequence[int] | Int[np.ndarray, "3"]) -> Int[np.ndarray, "q 4 3"]:
    """Quads of one side as places on the grid, counter-clockwise seen from outside."""
    one, other = ((axis + 1) % 3, (axis + 2) % 3)
    first, second = (grid.ravel() for grid in np.mgrid[: counts[one], : counts[other]])
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    quads = np.empty((len(first), 4, 3), dtype=np.int64)
    for place, (a, b) in enumerate(corners if end else corners[::-1]):
        quads[:, place, axis] = end * counts[axis]
        quads[:, place, one], quads[:, place, other] = first + a, second + b
    return quads
