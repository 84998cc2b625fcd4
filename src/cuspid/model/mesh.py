"""A triangle mesh in millimetres, with ray casting (Embree) and distance queries (libigl).

Visibility, rendering and evaluation all use these, so that there is one implementation of each.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import no_type_check

import fast_simplification
import igl
import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from jaxtyping import Bool, Float, Int, UInt8

from cuspid.geometry import Rigid3, freeze, read_only
from cuspid.runtime.display import Viewable
from cuspid.runtime.errors import InputError
from cuspid.runtime.kernels import kernel
from cuspid.runtime.workers import computed_once, map_slices

_ROUNDING = 5e-7
"""Rounding of a length in single precision, relative: four steps."""
_MOST_COLLAPSED = 500_000
"""Largest number of faces that edge collapse starts from."""


_SCENE_BYTES, _BYTES_A_FACE = 64 << 20, 300
"""What Embree needs for rays at a mesh, at most."""


@dataclass(frozen=True, eq=False)
class RayHits:
    """First intersections of rays with a mesh."""

    faces: Int[np.ndarray, "n"]
    """Index of the face that was hit, -1 for a miss."""
    distances: Float[np.ndarray, "n"]
    """Distance along the ray in units of its direction's length; infinite for a miss."""
    barycentric: Float[np.ndarray, "n 3"]
    """Weights of the face's three vertices at the hit."""


def edges_of(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """Edges of the faces, face by face; each edge of a closed mesh appears once in each direction."""
    return np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)


def used_vertices(faces: Int[np.ndarray, "f 3"], count: int) -> Int[np.ndarray, "u"]:
    """Indices, in ascending order, of the vertices that the faces use, out of ``count``."""
    return np.flatnonzero(np.bincount(faces.ravel(), minlength=count))


@kernel
@no_type_check
def _face_cross(vertices, faces):
    """Cross product of the sides of each face that leave its first vertex."""
    crosses, a, b = np.empty(faces.shape), np.empty(3), np.empty(3)
    for i in range(len(faces)):
        first, second, third = faces[i]
        for k in range(3):
            a[k], b[k] = vertices[second, k] - vertices[first, k], vertices[third, k] - vertices[first, k]
        for k in range(3):
            crosses[i, k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3]
    return crosses


@kernel
@no_type_check
def _sum_at_vertices(faces, vectors, count):
    """The sum of the vectors of the faces around each vertex."""
    summed = np.zeros((count, 3))
    for i in range(len(faces)):
        for vertex in faces[i]:
            for k in range(3):
                summed[vertex, k] += vectors[i, k]
    return summed


@kernel
@no_type_check
def _widen_hits(faces, lengths, u, v):
    """What Embree tells of first hits, as :class:`RayHits` has it."""
    count = len(faces)
    wide, distances, barycentric = np.empty(count, np.int64), np.empty(count), np.empty((count, 3))
    for i in range(count):
        wide[i], distances[i] = faces[i], lengths[i] if faces[i] >= 0 else np.inf
        second, third = np.float64(u[i]), np.float64(v[i])
        barycentric[i, 0], barycentric[i, 1], barycentric[i, 2] = 1 - second - third, second, third
    return wide, distances, barycentric


@kernel
@no_type_check
def _backwards(points, towards, tolerance_mm):
    """The rays of :meth:`Mesh.occluded`, from ``towards`` to the points, as Embree takes them, and how far occluders
    are looked for."""
    origins, directions = np.empty(points.shape, np.float32), np.empty(points.shape, np.float32)
    farthest = np.empty(len(points), np.float32)
    for i in range(len(points)):
        x, y, z = points[i, 0] - towards[i, 0], points[i, 1] - towards[i, 1], points[i, 2] - towards[i, 2]
        length = np.sqrt(x * x + y * y + z * z)
        for c in range(3):
            origins[i, c] = towards[i, c]
        directions[i, 0], directions[i, 1], directions[i, 2] = x / length, y / length, z / length
        largest = max(abs(points[i, 0]), abs(points[i, 1]), abs(points[i, 2]))
        farthest[i] = length - max(tolerance_mm, _ROUNDING * (largest + length))
    return origins, directions, farthest


@dataclass(frozen=True, eq=False)
class Mesh(Viewable):
    """Vertices and triangles."""

    vertices: Float[np.ndarray, "v 3"]
    """Positions in mm."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex indices, counter-clockwise seen from outside."""
    colors: UInt8[np.ndarray, "v 3"] | None = None
    """sRGB colour per vertex."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices", read_only(np.asarray(self.vertices, dtype=np.float64)))
        object.__setattr__(self, "faces", read_only(np.asarray(self.faces, dtype=np.int64)))
        if self.colors is not None:
            object.__setattr__(self, "colors", read_only(np.asarray(self.colors, dtype=np.uint8)))
        if self.faces.size and (self.faces.min() < 0 or self.faces.max() >= len(self.vertices)):
            raise InputError(f"mesh: a face refers to a vertex outside 0..{len(self.vertices) - 1}")

    def __repr__(self) -> str:
        extent = " x ".join(f"{side:.1f}" for side in np.ptp(self.bounds, axis=0)) if len(self.vertices) else "0"
        return f"Mesh({len(self.vertices):,} vertices, {len(self.faces):,} faces, {extent} mm)"

    @property
    def face_cross(self) -> Float[np.ndarray, "f 3"]:
        """Cross product of two edges of each face: along its outward normal, with a length of twice its area (mm^2)."""
        return np.asarray(_face_cross(self.vertices, self.faces))

    @computed_once
    def face_normals(self) -> Float[np.ndarray, "f 3"]:
        """Unit outward normals; zero for a degenerate face."""
        normals = self.face_cross
        norms = np.linalg.norm(normals, axis=1, keepdims=True)
        normals /= np.where(norms > 0, norms, 1)
        return freeze(normals)

    def normals_of(self, faces: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Unit outward normals of some faces."""
        return Mesh(self.vertices, self.faces[faces]).face_normals

    @computed_once
    def face_areas(self) -> Float[np.ndarray, "f"]:
        """Areas in mm^2."""
        return freeze(0.5 * np.linalg.norm(self.face_cross, axis=1))

    @computed_once
    def vertex_areas(self) -> Float[np.ndarray, "v"]:
        """A third of the total area of the faces around each vertex, mm^2."""
        shares = np.repeat(self.face_areas / 3, 3)
        return freeze(np.bincount(self.faces.ravel(), shares, minlength=len(self.vertices)))

    @computed_once
    def face_centres(self) -> Float[np.ndarray, "f 3"]:
        """Centroids in mm."""
        centres = self.vertices[self.faces[:, 0]]
        for corner in (1, 2):
            centres += self.vertices[self.faces[:, corner]]
        centres /= 3
        return freeze(centres)

    @computed_once
    def vertex_normals(self) -> Float[np.ndarray, "v 3"]:
        """Unit normals, the area-weighted mean of the adjoining faces."""
        summed = _sum_at_vertices(self.faces, self.face_cross, len(self.vertices))
        norms = np.linalg.norm(summed, axis=1, keepdims=True)
        return freeze(summed / np.where(norms > 0, norms, 1))

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Lower and upper corner of the bounding box of the vertices, mm."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def centroid(self, faces: Bool[np.ndarray, "f"]) -> Float[np.ndarray, "3"]:
        """Centroid of the surface of some faces, mm."""
        return np.asarray(np.average(self.face_centres[faces], axis=0, weights=self.face_areas[faces]))

    def transformed(self, target_from_source: Rigid3) -> Mesh:
        """The same mesh in another frame."""
        return replace(self, vertices=target_from_source.apply(self.vertices))

    def submesh(self, keep: Bool[np.ndarray, "f"]) -> Mesh:
        """The faces where ``keep`` is true, with only the vertices that they use."""
        faces = self.faces[keep]
        used = used_vertices(faces, len(self.vertices))
        number = np.zeros(len(self.vertices), dtype=np.int64)
        number[used] = np.arange(len(used))
        colors = None if self.colors is None else freeze(self.colors[used])
        return Mesh(freeze(self.vertices[used]), freeze(number[faces]), colors)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
        """Points distributed uniformly by area (stratified over the faces), and the face of each."""
        cumulative = np.cumsum(self.face_areas)
        picks = (np.arange(count) + rng.random(count)) / count * cumulative[-1]
        faces = np.minimum(np.searchsorted(cumulative, picks), len(self.faces) - 1)
        u, v = rng.random((2, count))
        flip = u + v > 1
        u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
        corners = self.vertices[self.faces[faces]]
        weights = np.stack([1 - u - v, u, v], axis=1)
        return np.einsum("nk,nkd->nd", weights, corners), faces

    @computed_once
    def _scene(self) -> rtcore_scene.EmbreeScene:
        # MemoryError, before Embree ends the process for want of it.
        np.empty(_SCENE_BYTES + _BYTES_A_FACE * len(self.faces), np.uint8)
        scene = rtcore_scene.EmbreeScene()
        TriangleMesh(scene, self.vertices.astype(np.float32), self.faces.astype(np.int32))
        return scene

    def cast(
        self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"], farthest: float = np.inf
    ) -> RayHits:
        """First hit of each ray (Embree, single precision), none farther away than so many lengths of its direction."""
        hits = self._scene.run(
            np.ascontiguousarray(origins, dtype=np.float32),
            np.ascontiguousarray(directions, dtype=np.float32),
            dists=np.full(len(origins), farthest, dtype=np.float32),
            output=True,
        )
        return RayHits(*_widen_hits(hits["primID"], hits["tfar"], hits["u"], hits["v"]))

    def cast_on_all_cores(
        self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"], farthest: float = np.inf
    ) -> RayHits:
        """As :meth:`cast`, with the rays distributed over all cores."""
        parts = map_slices(lambda part: self.cast(origins[part], directions[part], farthest), len(origins))
        return RayHits(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(RayHits)))

    def occluded(
        self,
        points: Float[np.ndarray, "n 3"],
        towards: Float[np.ndarray, "n 3"],
        tolerance_mm: float = 1e-3,
    ) -> Bool[np.ndarray, "n"]:
        """True where the open segment from ``points`` to ``towards`` meets the mesh farther away than the tolerance
        (or, for long rays, than single precision resolves)."""
        # The segment is shot backwards: a hit nearer than the surface point is an occluder.
        origins, directions, farthest = _backwards(*map(np.ascontiguousarray, (points, towards)), tolerance_mm)
        hits = self._scene.run(origins, directions, dists=farthest, query="OCCLUDED")
        return np.asarray((hits >= 0) & (farthest > 0))

    @computed_once
    def _tree(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(self.vertices, self.faces)
        return tree

    def simplified(self, max_faces: int) -> Mesh:
        """The mesh with at most so many faces, or as few as possible, by collapsing edges where it matters least
        (quadric error metric, Garland and Heckbert 1997); the mesh itself if it has no more. Colours are lost.

        In a mesh of millions of faces, vertices closer together than those of the result will be are merged first: the
        collapse takes 300 bytes a face, which its library does not release.
        """
        if len(self.faces) <= max_faces:
            return self
        start = self.thinned(max(_MOST_COLLAPSED, 4 * max_faces))
        vertices, faces = start.vertices.astype(np.float64), start.faces.astype(np.int32)
        while len(faces) > max_faces:
            before = len(faces)
            vertices, faces = fast_simplification.simplify(vertices, faces, target_count=max_faces)
            if len(faces) > 0.95 * before:  # it may give up early, and go on when it is asked again
                break
        return Mesh(vertices, faces)

    def thinned(self, about_faces: int) -> Mesh:
        """The mesh with about so many faces, by merging the vertices in each cell of a grid into their mean (J.
        Rossignac, P. Borrel, 1993); the mesh itself if it has no more. Fast, for use where a rough surface suffices.
        Colours are lost."""
        if len(self.faces) <= about_faces:
            return self
        cell_mm = float(np.sqrt(2 * self.face_areas.sum() / about_faces))
        cells = np.floor((self.vertices - self.bounds[0]) / cell_mm).astype(np.int64)
        _, joined, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        joined = joined.reshape(-1)
        sums = [np.bincount(joined, self.vertices[:, axis]) for axis in range(3)]
        faces = joined[self.faces]
        whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        return Mesh(np.stack(sums, axis=1) / counts[:, None], faces[whole]) if whole.any() else self

    def closest(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
        """Exact closest points on the mesh: unsigned distances (mm), face indices, positions (libigl's AABB tree)."""
        squared, faces, positions = self._tree.squared_distance(
            self.vertices, self.faces, np.ascontiguousarray(points, dtype=np.float64)
        )
        return np.sqrt(squared), np.asarray(faces, dtype=np.int64), positions
