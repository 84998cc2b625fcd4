"""Which point of one jaw is which point of another: a thin-plate spline through landmarks, then the surface itself.

The thin-plate spline (F. L. Bookstein, IEEE PAMI 11, 1989) has in space the kernel ``r`` and a linear part. It is exact
at the landmarks and only there: between them the warped template floats beside the sample. It is therefore drawn onto
the sample's surface from coarse to fine: each vertex to the nearest point of the same tooth that faces the same way, a
vertex on the border of two labels to that border, all displacements smoothed over the template. What finds no partner
follows its neighbours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import RBFInterpolator
from scipy.sparse import csr_array, diags_array
from scipy.spatial import cKDTree
from scipy.stats import binom

from cuspid.anatomy.shape.procrustes import dimension
from cuspid.model.jaw import GUM
from cuspid.model.mesh import Mesh, edges_of
from cuspid.runtime.options import Options, Range

_ON_BORDER = 0.7
"""A partner on the rim of a patch counts only if the line to it leaves the patch at least this steeply (sine)."""
_PER_EDGE = 8
"""Points that stand for an edge of a border."""
_LEAST_WEIGHT = 0.01
"""Where fewer partners than this share are near, displacements fade away."""
_TAIL = 4.5
"""Terms of a smoothing beyond this many standard deviations are left out."""

Border = tuple[int, int]
"""The two labels on the sides of an edge, the smaller one first."""


@dataclass(frozen=True, kw_only=True)
class FitOptions(Options):
    """How a warped template is fitted to a sample."""

    smoothing_mm: Annotated[tuple[float, ...], Range(0.001, 100)] = (2.0, 1.0, 0.5, 0.25)
    """Smoothing of the displacements in each round: standard deviation of a Gaussian over the surface, mm."""
    reach_mm: Annotated[float, Range(0.01, 100)] = 3.0
    """A nearest point farther away than this is no match."""
    min_cosine: Annotated[float, Range(-1, 1)] = 0.5
    """Minimum cosine between the normals; a nearest point whose normal differs by more is no match."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit:
    """A template laid on a sample."""

    vertices: Float[np.ndarray, "v 3"]
    """Where the template's vertices lie on the sample, mm."""
    covered: Bool[np.ndarray, "v"]
    """Which of them lie on its surface; the others follow their neighbours."""


def warp(
    source: Float[np.ndarray, "l 3"], target: Float[np.ndarray, "l 3"], points: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, "p 3"]:
    """Points moved by the thin-plate spline that takes ``source`` to ``target``; rigid far away where they are flat."""
    degree = 1 if dimension(source) == 3 else 0
    return np.asarray(points + RBFInterpolator(source, target - source, kernel="linear", degree=degree)(points))


# The template


@dataclass(frozen=True, eq=False, kw_only=True)
class Template:
    """What stays of the template while its vertices move: which belongs to what, and who is whose neighbour."""

    faces: Int[np.ndarray, "f 3"]
    """Vertex indices."""
    edge_mm: float
    """Mean length of an edge, mm."""
    inner: Mapping[int, Int[np.ndarray, "_"]]
    """Vertices all of whose faces have one label, by label."""
    borders: Mapping[Border, Int[np.ndarray, "_"]]
    """Vertices between two labels."""
    averaging: csr_array
    """Takes values at the vertices to the mean of the neighbours of each, (v, v)."""

    @staticmethod
    def of(mesh: Mesh, labels: Int[np.ndarray, "f"]) -> Template:
        """The template of a mesh with a label for each face."""
        count = len(mesh.vertices)
        low, high = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
        for corner in mesh.faces.T:
            np.minimum.at(low, corner, labels)
            np.maximum.at(high, corner, labels)
        pairs = np.stack([low, high], axis=1)
        inner = {int(label): np.flatnonzero((low == label) & (high == label)) for label in np.unique(labels)}
        adjacent = np.unique(pairs[low < high], axis=0)
        ends = mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)]
        return Template(
            faces=mesh.faces,
            edge_mm=float(np.linalg.norm(ends, axis=2).mean()),
            inner=inner,
            borders={(int(a), int(b)): np.flatnonzero((low == a) & (high == b)) for a, b in adjacent},
            averaging=_averaging_matrix(mesh.faces, count),
        )

    def smooth(
        self, values: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, "v"], sigma_mm: float
    ) -> Float[np.ndarray, "v 3"]:
        """Weighted mean of the values round each vertex, by diffusion over the surface."""
        # A step of diffusion is A = (1 + W) / 2 with W the mean over the neighbours: a walk with a quarter of an edge's
        # variance along each axis. In Chebyshev polynomials A^n = sum_k c_k T_k(W) with binomial c_k, which vanish long
        # before k = n.
        steps = max(1, round(4 * (sigma_mm / self.edge_mm) ** 2))
        last = min(steps, int(_TAIL * np.sqrt(steps / 2)) + 1)
        shares = 2 * binom.pmf(steps - np.arange(last + 1), 2 * steps, 0.5)
        before = np.column_stack([values * weights[:, None], weights])
        now = self.averaging @ before
        total = shares[0] / 2 * before + shares[1] * now
        for share in shares[2:]:
            before, now = now, 2 * (self.averaging @ now) - before
            total += share * now
        return np.asarray(total[:, :3] / np.maximum(total[:, 3:], _LEAST_WEIGHT))


def _averaging_matrix(faces: Int[np.ndarray, "f 3"], count: int) -> csr_array:
    sides = edges_of(faces)
    both = np.concatenate([sides, sides[:, ::-1]])
    adjacency = csr_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    adjacency.data[:] = 1.0
    degree = np.maximum(adjacency.sum(axis=1), 1.0)
    return csr_array(diags_array(1.0 / degree) @ adjacency)


# The sample


@dataclass(frozen=True, eq=False, kw_only=True)
class Patch:
    """The surface with one label."""

    mesh: Mesh
    """Its faces."""
    at_rim: Bool[np.ndarray, "f"]
    """Which of them touch its open edge."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Target:
    """A sample, ready to be asked for the nearest points of each label."""

    patches: Mapping[int, Patch]
    """The surface by label."""
    borders: Mapping[Border, cKDTree]
    """Points on the edges between two labels."""

    @staticmethod
    def of(mesh: Mesh, labels: Int[np.ndarray, "f"]) -> Target:
        """The target of a mesh with a label for each face."""
        patches = {int(label): _patch(mesh.submesh(labels == label)) for label in np.unique(labels)}
        return Target(patches=patches, borders=_border_points(mesh, labels))


def _patch(mesh: Mesh) -> Patch:
    sides = np.sort(edges_of(mesh.faces), axis=1)
    _, first, count = np.unique(sides[:, 0] * len(mesh.vertices) + sides[:, 1], return_index=True, return_counts=True)
    rim = np.zeros(len(mesh.vertices), dtype=bool)
    rim[sides[first[count == 1]]] = True
    return Patch(mesh=mesh, at_rim=rim[mesh.faces].any(axis=1))


def _border_points(mesh: Mesh, labels: Int[np.ndarray, "f"]) -> dict[Border, cKDTree]:
    """Points along the edges whose two faces have different labels, by the two labels."""
    sides = np.sort(edges_of(mesh.faces), axis=1)
    key = sides[:, 0] * len(mesh.vertices) + sides[:, 1]
    order = np.argsort(key, kind="stable")
    twins = np.flatnonzero(key[order][1:] == key[order][:-1])
    one, other = order[twins], order[twins + 1]
    pairs = np.sort(np.stack([labels[one // 3], labels[other // 3]], axis=1), axis=1)
    share = (np.arange(_PER_EDGE) + 0.5)[:, None] / _PER_EDGE
    trees = {}
    for a, b in np.unique(pairs[pairs[:, 0] < pairs[:, 1]], axis=0):
        ends = mesh.vertices[sides[one[(pairs[:, 0] == a) & (pairs[:, 1] == b)]]]
        trees[int(a), int(b)] = cKDTree(((1 - share) * ends[:, None, 0] + share * ends[:, None, 1]).reshape(-1, 3))
    return trees


# The fit


def fit(template: Template, start: Float[np.ndarray, "v 3"], target: Target, options: FitOptions = FitOptions()) -> Fit:
    """The template, its vertices near the sample already, drawn onto the sample's surface.

    Vertices that find a partner end exactly on the surface.
    """
    vertices = start
    for sigma_mm in options.smoothing_mm:
        offsets, found = partners(template, vertices, target, options)
        vertices = vertices + template.smooth(offsets, found.astype(np.float64), sigma_mm)
    offsets, found = partners(template, vertices, target, options)
    followed = template.smooth(offsets, found.astype(np.float64), options.smoothing_mm[-1])
    return Fit(vertices=vertices + np.where(found[:, None], offsets, followed), covered=found)


def partners(
    template: Template, vertices: Float[np.ndarray, "v 3"], target: Target, options: FitOptions
) -> tuple[Float[np.ndarray, "v 3"], Bool[np.ndarray, "v"]]:
    """The offset from each vertex to its partner on the sample, mm, and whether it has one."""
    normals = Mesh(vertices, template.faces).vertex_normals
    offsets, found = np.zeros_like(vertices), np.zeros(len(vertices), dtype=bool)
    for label, inner in template.inner.items():
        if label in target.patches and len(inner):
            offsets[inner], found[inner] = _project_onto_patch(
                vertices[inner], normals[inner], target.patches[label], options.min_cosine
            )
    for border, on_border in template.borders.items():
        if border in target.borders:
            _, nearest = target.borders[border].query(vertices[on_border])
            offsets[on_border] = target.borders[border].data[nearest] - vertices[on_border]
            found[on_border] = True
    found &= np.linalg.norm(offsets, axis=1) < options.reach_mm
    return np.where(found[:, None], offsets, 0.0), found


def _project_onto_patch(
    points: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"], patch: Patch, min_cosine: float
) -> tuple[Float[np.ndarray, "p 3"], Bool[np.ndarray, "p"]]:
    distances, faces, nearest = patch.mesh.closest(points)
    offsets = nearest - points
    facing = patch.mesh.face_normals[faces]
    steep = np.abs(np.einsum("pk,pk->p", offsets, facing)) >= _ON_BORDER * distances
    compatible = np.einsum("pk,pk->p", normals, facing) > min_cosine
    return offsets, compatible & (steep | ~patch.at_rim[faces])


def labels_or_gum(labels: Int[np.ndarray, "f"] | None, count: int) -> Int[np.ndarray, "f"]:
    """Face labels, or one label for all where there are none."""
    return np.full(count, GUM) if labels is None else labels
