"""Signed distances to a surface, and where a surface ends.

The sign comes from the angle-weighted pseudo-normal at the closest point (Baerentzen and Aanaes 2005), which is
correct on faces, edges and corners alike: positive on the outer side. At an open border, the sign has a meaning only
for points over the surface, not for points past its edge: these are reported separately.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import igl
import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.model.mesh import Mesh
from cuspid.runtime.workers import computed_once

_ON_EDGE = 1e-7
"""Barycentric weight below which a point of a face is considered to lie on the opposite edge."""
_BLOCK = 1 << 18
"""Points that are processed at once: for millions, the intermediate results would take gigabytes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ClosestPoints:
    """The closest points on a surface to some points."""

    signed_mm: Float[np.ndarray, "n"]
    """Distances, positive outside."""
    faces: Int[np.ndarray, "n"]
    """Face on which each closest point lies."""
    directions: Float[np.ndarray, "n 3"]
    """Unit gradient of the signed distance: from the closest point to the point, turned outwards."""
    on_border: Bool[np.ndarray, "n"]
    """True where the closest point lies on an open border."""
    past_border: Bool[np.ndarray, "n"]
    """True where, in addition, the point is farther sideways past the border than it is above or below the surface."""


@dataclass(frozen=True, eq=False)
class SignedDistance:
    """Signed distances to a mesh."""

    mesh: Mesh
    """The surface; faces are counter-clockwise seen from outside."""

    @computed_once
    def _edges(self) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
        """The key of each edge of each face, in order, and the face."""
        keys = self._edge_keys(
            np.repeat(np.arange(len(self.mesh.faces)), 3), np.tile(np.arange(3), len(self.mesh.faces))
        )
        order = np.argsort(keys, kind="stable")
        return keys[order], (order // 3).astype(np.int32)

    def _edge_keys(self, faces: Int[np.ndarray, "n"], opposite: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
        """A number for the edge of each face opposite to one of its corners, the same in all faces that share it."""
        one, other = (self.mesh.faces[faces, (opposite + step) % 3] for step in (1, 2))
        return np.minimum(one, other) * len(self.mesh.vertices) + np.maximum(one, other)

    def _index_edges(self, keys: Int[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Where the faces of each edge begin among all, and how many there are."""
        ordered, _ = self._edges
        begin = np.searchsorted(ordered, keys)
        return begin, np.searchsorted(ordered, keys, side="right") - begin

    @computed_once
    def _border_vertices(self) -> Bool[np.ndarray, "v"]:
        keys, counts = np.unique(self._edges[0], return_counts=True)
        flags = np.zeros(len(self.mesh.vertices), dtype=bool)
        for ends in np.divmod(keys[counts == 1], len(self.mesh.vertices)):
            flags[ends] = True
        return flags

    @computed_once
    def _corner_normals(self) -> Float[np.ndarray, "v 3"]:
        by_angle = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
        return igl.per_vertex_normals(self.mesh.vertices, self.mesh.faces, by_angle, self.mesh.face_normals)

    def _edge_normals(self, keys: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Sums of the normals of the faces that share each edge."""
        (begin, counts), faces = self._index_edges(keys), self._edges[1]
        summed = np.zeros((len(keys), 3))
        for turn in range(counts.max(initial=0)):
            more = turn < counts
            summed[more] += self.mesh.face_normals[faces[begin[more] + turn]]
        return summed

    def closest_points(self, points: Float[np.ndarray, "n 3"]) -> ClosestPoints:
        """Closest points on the surface to ``points`` (mm)."""
        blocks = [self._closest(points[begin : begin + _BLOCK]) for begin in range(0, max(len(points), 1), _BLOCK)]
        if len(blocks) == 1:
            return blocks[0]
        names = [field.name for field in fields(ClosestPoints)]
        return ClosestPoints(**{name: np.concatenate([getattr(block, name) for block in blocks]) for name in names})

    def _closest(self, points: Float[np.ndarray, "n 3"]) -> ClosestPoints:
        distances, faces, positions = self.mesh.closest(points)
        on_edge = _barycentric(self.mesh.vertices[self.mesh.faces[faces]], positions) < _ON_EDGE
        offsets = points - positions
        pseudo_normals = self._pseudo_normals(faces, on_edge)
        signs = np.where(np.sum(offsets * pseudo_normals, axis=1) < 0, -1.0, 1.0)
        far = distances > 1e-9
        directions = self.mesh.face_normals[faces].copy()
        directions[far] = (signs / np.where(far, distances, 1))[far, None] * offsets[far]
        on_border = self._on_border(faces, on_edge)
        height = np.abs(np.sum(offsets * self.mesh.face_normals[faces], axis=1))
        return ClosestPoints(
            signed_mm=signs * distances,
            faces=faces,
            directions=directions,
            on_border=on_border,
            past_border=on_border & (height < distances * np.sqrt(0.5)),
        )

    def _pseudo_normals(
        self, faces: Int[np.ndarray, "n"], on_edge: Bool[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        normals = self.mesh.face_normals[faces].copy()
        touching = on_edge.sum(axis=1)
        edge, corner = touching == 1, touching >= 2
        normals[edge] = self._edge_normals(self._edge_keys(faces[edge], np.argmax(on_edge[edge], axis=1)))
        normals[corner] = self._corner_normals[self.mesh.faces[faces[corner], np.argmin(on_edge[corner], axis=1)]]
        return normals

    def _on_border(self, faces: Int[np.ndarray, "n"], on_edge: Bool[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        corner = self.mesh.faces[faces, np.argmin(on_edge, axis=1)]
        at_border = (on_edge.sum(axis=1) >= 2) & self._border_vertices[corner]
        points, opposite = np.nonzero(on_edge)
        _, counts = self._index_edges(self._edge_keys(faces[points], opposite))
        at_border[points[counts == 1]] = True
        return np.asarray(at_border)


def _barycentric(corners: Float[np.ndarray, "n 3 3"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Weights of the corners for points in the planes of their triangles; zeros for degenerate triangles."""
    ab, ac, ap = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    cross = np.cross(ab, ac)
    norm = np.sum(cross * cross, axis=1)
    norm = np.where(norm > 0, norm, np.inf)
    v = np.sum(np.cross(ap, ac) * cross, axis=1) / norm
    w = np.sum(np.cross(ab, ap) * cross, axis=1) / norm
    return np.stack([1 - v - w, v, w], axis=1)
