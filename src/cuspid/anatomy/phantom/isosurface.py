"""A triangle mesh of the zero surface of a signed distance function.

The function is sampled on a grid in a narrow band about its surface, cut by marching cubes, and the vertices are
evened out and drawn onto the exact surface, so that the mesh is smooth and its faces are well shaped.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from skimage.measure import marching_cubes

from cuspid.anatomy.teeth.crowns import Points, Values
from cuspid.geometry.graph import graph_of, parts_of
from cuspid.model.mesh import edges_of

Field = Callable[[Points], Values]
"""Signed distance in mm, shape (n,), of points (n, 3); negative inside."""

BLOCK = 4
"""Grid cells along the edge of a block that is halved, down to single cells, where the surface may be near."""
STENCIL_MM = 0.02
"""Size of the stencil of a gradient."""
CHUNK = 30_000
"""Points evaluated at once: enough for numpy, few enough for the cache."""


def mesh_of(
    field: Field, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], edge_mm: float
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The zero surface of a field as one closed mesh with well-shaped faces; it is cut off where it leaves the box."""
    volume = _clear_border(_sample_band(field, low, high, edge_mm), edge_mm)
    vertices, faces, _, _ = marching_cubes(volume, 0.0, gradient_direction="descent")
    vertices, faces = _largest_part(low + edge_mm * vertices.astype(float), faces.astype(np.int64))
    for _ in range(2):
        vertices = project_to_surface(field, _relax(vertices, faces), edge_mm)
    return vertices, faces


def _sample_band(field: Field, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], edge_mm: float) -> np.ndarray:
    """The field on a grid, exact near its zero surface and of the right sign elsewhere."""
    blocks = np.ceil((high - low) / (BLOCK * edge_mm)).astype(int)
    cells = np.stack(np.meshgrid(*map(np.arange, blocks), indexing="ij"), axis=-1).reshape(-1, 3)
    volume = np.empty(BLOCK * blocks, dtype=np.float32)
    size = BLOCK
    while size:
        values = evaluate(field, low + (cells * size + (size - 1) / 2) * edge_mm)
        x, y, z = np.moveaxis(size * cells[:, None] + _inner(size), -1, 0)
        volume[x, y, z] = _avoid_zero(values, 0.02 * edge_mm)[:, None]
        near = np.abs(values) < 1.25 * size * edge_mm
        size //= 2
        cells = (2 * cells[near, None] + _inner(2)).reshape(-1, 3)
    return volume


def _clear_border(volume: np.ndarray, distance: float) -> np.ndarray:
    """The volume with nothing of the inside on its border, where the surface would be open."""
    border = np.pad(np.zeros(np.subtract(volume.shape, 2), dtype=bool), 1, constant_values=True)
    return np.where(border & (volume < 0), np.float32(distance), volume)


def _inner(size: int) -> Int[np.ndarray, "c 3"]:
    """Indices of the cells of a cubic block."""
    return np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def evaluate(field: Field, points: Points) -> Values:
    """The field at many points, shape (n,)."""
    parts = np.array_split(points, max(1, len(points) // CHUNK))
    return np.concatenate([field(part) for part in parts])


def _avoid_zero(values: Values, least: float) -> Values:
    """Values (n,) kept away from zero, so that no vertex coincides with a grid point."""
    return np.where(values < 0, np.minimum(values, -least), np.maximum(values, least))


def _largest_part(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """The connected part with the most vertices: the outer surface, without enclosed voids."""
    part = parts_of(edges_of(faces), len(vertices))
    keep = part == np.bincount(part).argmax()
    renumbered = np.cumsum(keep) - 1
    return vertices[keep], renumbered[faces[keep[faces[:, 0]]]]


def _relax(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Vertices moved half-way to the mean of their neighbours, which evens out the faces."""
    adjacency = graph_of(edges_of(faces), len(vertices)).tocsr()
    degree = adjacency.sum(axis=1)
    return 0.5 * vertices + 0.5 * (adjacency @ vertices) / degree[:, None]


def project_to_surface(field: Field, vertices: Float[np.ndarray, "v 3"], edge_mm: float) -> Float[np.ndarray, "v 3"]:
    """Vertices moved along the gradient onto the zero surface, by at most half an edge."""
    values, gradient = value_and_gradient(field, vertices)
    return newton_step(vertices, values, gradient, 0.5 * edge_mm)


def value_and_gradient(field: Field, points: Points) -> tuple[Values, Points]:
    """A field, shape (n,), and its gradient, (n, 3), from its values at the corners of a small tetrahedron."""
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * STENCIL_MM
    values = np.stack([evaluate(field, points + corner) for corner in corners], axis=1)
    return values.mean(axis=1), np.einsum("nc,ck->nk", values, corners) / (4 * STENCIL_MM**2)


def newton_step(points: Points, values: Values, gradient: Points, limit_mm: float) -> Points:
    """Points (n, 3) after a step along the gradient towards the zero of a field, no longer than the limit."""
    move = -(values / np.maximum((gradient**2).sum(axis=1), 0.4))[:, None] * gradient
    length = np.linalg.norm(move, axis=1, keepdims=True)
    return points + move * np.minimum(1.0, limit_mm / np.maximum(length, 1e-12))


def prevent_folds(
    vertices: Float[np.ndarray, "v 3"], moved: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v 3"]:
    """The moved vertices, but for those that would turn one of their faces over or flatten it."""
    before = _face_cross(vertices, faces)
    for _ in range(3):
        after = _face_cross(moved, faces)
        folded = (before * after).sum(axis=1) < 0.2 * (before**2).sum(axis=1)
        moved = moved.copy()
        moved[faces[folded]] = vertices[faces[folded]]
    return moved


def _face_cross(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Cross products (f, 3) of two edges of each face, mm^2."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)
