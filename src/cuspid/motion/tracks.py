"""Matches joined to tracks, and the place where the rays of a track meet."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from cuspid.graph import parts_of


def join(matches: Int[np.ndarray, "m 2"], image_of: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Track of each of n keypoints; -1 for one that is unmatched or whose track has two keypoints in one image."""
    label = parts_of(matches, len(image_of))
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


@njit(cache=True, nogil=True)
@no_type_check
def _claim(order, start, cell_of):
    """Tracks, taken in order, that come first to some cell."""
    claimed = np.zeros(cell_of.max() + 1, np.bool_)
    keep = np.zeros(len(start) - 1, np.bool_)
    for track in order:
        for o in range(start[track], start[track + 1]):
            if not claimed[cell_of[o]]:
                keep[track] = claimed[cell_of[o]] = True
    return keep


def thin(
    track: Int[np.ndarray, "o"], image: Int[np.ndarray, "o"], pixels: Float[np.ndarray, "o 2"], cell_px: float
) -> Bool[np.ndarray, "o"]:
    """Observations of the longest tracks that together leave no cell of an image empty.

    Neighbouring keypoints share their errors: more of them cost time and add little.
    """
    if not len(track):
        return np.zeros(0, dtype=bool)
    place = np.maximum(pixels // cell_px, 0).astype(np.int64)
    columns, rows = place.max(axis=0) + 1
    order = np.argsort(track, kind="stable")
    counts = np.bincount(track)
    cell_of = (image * rows + place[:, 1]) * columns + place[:, 0]
    longest_first = np.argsort(-counts, kind="stable")
    return np.asarray(_claim(longest_first, np.concatenate([[0], np.cumsum(counts)]), cell_of[order]))[track]
