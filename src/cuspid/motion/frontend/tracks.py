"""Joining matches into tracks, and intersecting the rays of a track."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.runtime.kernels import kernel


@kernel
@no_type_check
def _root(parent, node):
    while parent[node] != node:
        node = parent[node]
    return node


@kernel
@no_type_check
def _join_kernel(matches, image_of, images):
    """One keypoint, the same for all, of the track of each; see :func:`join`."""
    count = len(image_of)
    parent, tail, size = np.arange(count), np.arange(count), np.ones(count, np.int64)
    following, mark = np.full(count, -1), np.full(images, -1)
    for m in range(len(matches)):
        a, b = _root(parent, matches[m, 0]), _root(parent, matches[m, 1])
        if a == b:
            continue
        if size[a] < size[b]:
            a, b = b, a
        member = a
        while member >= 0:
            mark[image_of[member]] = m
            member = following[member]
        member, clash = b, False
        while member >= 0 and not clash:
            clash = mark[image_of[member]] == m
            member = following[member]
        if not clash:
            parent[b] = a
            following[tail[a]] = b
            tail[a] = tail[b]
            size[a] += size[b]
    return np.array([_root(parent, node) for node in range(count)])


def join(matches: Int[np.ndarray, "m 2"], image_of: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Track of each of n keypoints, -1 for one without a match; no track has two keypoints in one image.

    Matches are joined in the given order, so the more reliable ones should come first; a match that would give a track
    two keypoints in one image is left out. Dropping such tracks entirely would cost a long film half of its points and
    gain a rig nothing.
    """
    root = _join_kernel(matches, image_of, image_of.max(initial=-1) + 1)
    _, label, sizes = np.unique(root, return_inverse=True, return_counts=True)
    kept = sizes >= 2
    return np.where(kept, np.cumsum(kept) - 1, -1)[label]


def intersect_rays(
    centres: Float[np.ndarray, "o 3"],
    directions: Float[np.ndarray, "o 3"],
    track: Int[np.ndarray, "o"],
    count: int,
) -> Float[np.ndarray, "p 3"]:
    """For each of ``count`` tracks, the point nearest to its rays (least squares); NaN if they are parallel."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
    flat = np.concatenate([across.reshape(-1, 9), np.einsum("oij,oj->oi", across, centres)], axis=1)
    sums = np.stack([np.bincount(track, column, minlength=count) for column in flat.T], axis=1)
    matrices, vectors = sums[:, :9].reshape(-1, 3, 3), sums[:, 9:]
    solvable: Bool[np.ndarray, "p"] = np.linalg.eigvalsh(matrices)[:, 0] > 1e-7
    points = np.full((count, 3), np.nan)
    points[solvable] = np.linalg.solve(matrices[solvable], vectors[solvable][..., None])[..., 0]
    return points


def first_and_last(
    point: Int[np.ndarray, "o"], frame: Int[np.ndarray, "o"], count: int
) -> tuple[Int[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    """The first and the last frame in which each of ``count`` points was observed; for one that never was, the last is
    -1."""
    first, last = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
    np.minimum.at(first, point, frame)
    np.maximum.at(last, point, frame)
    return first, last


def points_across(point: Int[np.ndarray, "o"], frame: Int[np.ndarray, "o"], frames: int) -> Int[np.ndarray, "k"]:
    """For each of so many frames except the last: the number of points that were observed in it or earlier, and again
    in a later one."""
    first, last = first_and_last(point, frame, int(point.max(initial=-1)) + 1)
    at = np.arange(frames - 1)[:, None]
    return np.asarray(((first <= at) & (at < last)).sum(axis=1))


@kernel
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
    """Observations of the longest tracks that together leave no cell of any image empty.

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
