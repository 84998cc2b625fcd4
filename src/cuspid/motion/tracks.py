"""Matches joined to tracks, and the place where the rays of a track meet."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def join(matches: Int[np.ndarray, "m 2"], image_of: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Track of each of n keypoints; -1 for one that is unmatched or whose track has two keypoints in one image."""
    count = len(image_of)
    graph = coo_array((np.ones(len(matches), bool), (matches[:, 0], matches[:, 1])), shape=(count, count))
    label = connected_components(graph, directed=False)[1].astype(np.int64)
    sizes = np.bincount(label, minlength=1)
    images = image_of.max(initial=0) + 1
    distinct = np.unique(label * images + image_of) // images
    consistent = np.bincount(distinct, minlength=len(sizes)) == sizes
    kept = consistent & (sizes >= 2)
    renumbered = np.where(kept, np.cumsum(kept) - 1, -1)
    return renumbered[label]


def intersect_rays(
    centres: Float[np.ndarray, "o 3"],
    directions: Float[np.ndarray, "o 3"],
    track: Int[np.ndarray, "o"],
    count: int,
) -> Float[np.ndarray, "p 3"]:
    """For each of ``count`` tracks the point nearest to its rays (least squares); NaN where they are parallel."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    flat = np.concatenate([across.reshape(-1, 9), np.einsum("oij,oj->oi", across, centres)], axis=1)
    sums = np.stack([np.bincount(track, column, minlength=count) for column in flat.T], axis=1)
    matrices, vectors = sums[:, :9].reshape(-1, 3, 3), sums[:, 9:]
    solvable: Bool[np.ndarray, "p"] = np.linalg.eigvalsh(matrices)[:, 0] > 1e-7
    points = np.full((count, 3), np.nan)
    points[solvable] = np.linalg.solve(matrices[solvable], vectors[solvable][..., None])[..., 0]
    return points
