"""Signed distances to a surface, and where a surface ends.

The sign comes from the angle-weighted pseudo-normal at the closest point (Baerentzen and Aanaes 2005), which is right
on faces, edges and corners alike: positive on the outer side. An open border has an outside only where a point lies
over the surface, not where it lies past its edge: such points are told apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.mesh import Mesh

_ON_EDGE = 1e-7
"""Barycentric weight below which a point of a face lies on the opposite edge."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ClosestPoints:
    """The closest points of a surface to some points."""

    signed_mm: Float[np.ndarray, "n"]
    """Distances, positive outside."""
    faces: Int[np.ndarray, "n"]
    """Face on which each closest point lies."""
    directions: Float[np.ndarray, "n 3"]
    """Unit gradient of the signed distance: from the closest point to the point, turned outwards."""
    on_border: Bool[np.ndarray, "n"]
    """True where the closest point lies on an open border."""
    past_border: Bool[np.ndarray, "n"]
    """True where, besides, the point is farther sideways past the border than it is above or below the surface."""


@dataclass(frozen=True, eq=False)
class SignedDistance:
    """Signed distances to a mesh."""

    mesh: Mesh
    """The surface, outward normals counter-clockwise."""

    @cached_property
    def _edges(self) -> tuple[Int[np.ndarray, "f 3"], Int[np.ndarray, "e"]]:
        """For each face the number of the edge opposite to each corner, and how many faces share each edge."""
        faces = self.mesh.faces
        ends = np.sort(np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1), axis=2)
        keys = ends[..., 0] * len(self.mesh.vertices) + ends[..., 1]
        _, numbers, counts = np.unique(keys.ravel(), return_inverse=True, return_counts=True)
        return numbers.reshape(-1, 3), counts

    @cached_property
    def _border(self) -> Bool[np.ndarray, "f 3"]:
        numbers, counts = self._edges
        return np.asarray(counts[numbers] == 1)

    @cached_property
    def _border_vertices(self) -> Bool[np.ndarray, "v"]:
        flags = np.zeros(len(self.mesh.vertices), dtype=bool)
        for corner in range(3):
            at = self._border[:, corner]
            flags[self.mesh.faces[at][:, [(corner + 1) % 3, (corner + 2) % 3]]] = True
        return flags

    @cached_property
    def _edge_normals(self) -> Float[np.ndarray, "e 3"]:
        numbers, counts = self._edges
        return _summed(numbers, np.repeat(self.mesh.face_normals[:, None], 3, axis=1), len(counts))

    @cached_property
    def _corner_normals(self) -> Float[np.ndarray, "v 3"]:
        corners = self.mesh.vertices[self.mesh.faces]
        after, before = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
        angles = np.arctan2(np.linalg.norm(np.cross(after, before), axis=2), np.sum(after * before, axis=2))
        return _summed(self.mesh.faces, angles[..., None] * self.mesh.face_normals[:, None], len(self.mesh.vertices))

    def closest_points(self, points: Float[np.ndarray, "n 3"]) -> ClosestPoints:
        """Closest points of the surface to ``points`` (mm)."""
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
        normals[edge] = self._edge_normals[self._edges[0][faces[edge], np.argmax(on_edge[edge], axis=1)]]
        normals[corner] = self._corner_normals[self.mesh.faces[faces[corner], np.argmin(on_edge[corner], axis=1)]]
        return normals

    def _on_border(self, faces: Int[np.ndarray, "n"], on_edge: Bool[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        at_edge = np.any(on_edge & self._border[faces], axis=1)
        corner = self.mesh.faces[faces, np.argmin(on_edge, axis=1)]
        return np.asarray(at_edge | ((on_edge.sum(axis=1) >= 2) & self._border_vertices[corner]))


def _summed(
    indices: Int[np.ndarray, "f 3"], vectors: Float[np.ndarray, "f 3 3"], length: int
) -> Float[np.ndarray, "length 3"]:
    """Sum of the vectors that carry the same index."""
    return np.stack(
        [np.bincount(indices.ravel(), vectors[..., axis].ravel(), minlength=length) for axis in range(3)], axis=1
    )


def _barycentric(corners: Float[np.ndarray, "n 3 3"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Weights of the corners for points in the planes of their triangles; zeros for degenerate triangles."""
    ab, ac, ap = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    cross = np.cross(ab, ac)
    norm = np.sum(cross * cross, axis=1)
    norm = np.where(norm > 0, norm, np.inf)
    v = np.sum(np.cross(ap, ac) * cross, axis=1) / norm
    w = np.sum(np.cross(ab, ap) * cross, axis=1) / norm
    return np.stack([1 - v - w, v, w], axis=1)
