"""All frames at once: the poses with which their surfaces lie on each other best, over the pairs of frames that show
most of the same surface, whether consecutive or not.

A pair counts for as much as its surfaces overlap and as little as they scatter about each other. Thus drift is spread
where it is least certain, and a path that comes back is closed.

How far the poses may be off follows from how the gradients of all pairs scatter (covariance of an M-estimate with
clusters, as for tracks), from one block of space to the next, for surfaces are smooth, so that their errors hang
together within a block, whichever frames show it; and from one part of the view to the next, for some errors go along
with the cameras, through all frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy import sparse

from cuspid.geometry import Rigid3
from cuspid.model.reconstruction import Expectation
from cuspid.motion.bundle.expectation import MOST_POINTS, expectation_of, steps_drawn
from cuspid.motion.icp.surfaces import (
    Correspondences,
    OrientedPoints,
    Surface,
    match_point_to_plane,
    small_motion,
    solve_damped,
)
from cuspid.runtime.progress import Progress
from cuspid.runtime.workers import map_in_threads

_REACH = 0.04
"""Largest distance between the same place in two frames, as a share of the working distance."""
_BLOCK = 0.1
"""Side of the blocks by which overlap is told, as a share of the working distance."""
_IN_SPACE, _IN_VIEW = 0.2, 0.8
"""Sides of the blocks of space, and of those that go along with the handpiece, within which errors of surfaces hang
together, as shares of the working distance."""
_DAMPING = 1e-13
"""Share of the diagonal that is added to the normal equations: what bends a whole path stands out so little from it
that more would freeze the bend."""
_CONVERGED = 2e-6
"""Step of the joint adjustment, as a share of the working distance, that ends it."""

_Blocks = set[tuple[int, ...]]


def _blocks(surface: Surface, pose: Rigid3, distance_mm: float) -> _Blocks:
    """Those of space that a surface fills."""
    blocks = np.floor(pose.inverse().apply(surface.points) / (_BLOCK * distance_mm)).astype(int)
    return set(map(tuple, blocks.tolist()))


def _shared_fraction(one: _Blocks, other: _Blocks) -> float:
    """The part of the smaller surface that both share."""
    return len(one & other) / max(min(len(one), len(other)), 1)


def neighbours(
    surfaces: Sequence[Surface], poses: Sequence[Rigid3], min_overlap: float, distance_mm: float
) -> list[tuple[int, int]]:
    """Pairs of frames that share more than this part of the smaller surface, estimated from the blocks of space that it
    fills, in both orders.

    Only relative neighbours (G. Toussaint, Pattern Recognition 12, 1980): a pair is left out if both overlap more with
    a third frame. The farther apart two frames are, the less alike are the errors of their surfaces, and what these do
    to a pose adds up along a path; pairs of one pass and another stay where these come closest.
    """
    blocks = [_blocks(surface, pose, distance_mm) for surface, pose in zip(surfaces, poses, strict=True)]
    shared = np.array([[_shared_fraction(one, other) for other in blocks] for one in blocks])
    np.fill_diagonal(shared, 0.0)
    through_third = np.array([np.minimum(one, shared).max(axis=1) for one in shared])
    found = (shared > min_overlap) & (shared >= through_third)
    return [(int(one), int(other)) for one, other in np.argwhere(found)]


def lay_together(
    surfaces: Sequence[Surface],
    some: Sequence[OrientedPoints],
    poses: Sequence[Rigid3],
    pairs: Sequence[tuple[int, int]],
    distance_mm: float,
    rounds: int,
    progress: Progress,
) -> tuple[list[Rigid3], float, Expectation | None]:
    """The poses with which some points of each surface lie best on those that it is paired with, their mean scatter,
    mm, and what follows for the surface."""
    found, matches = list(poses), list[Correspondences | None]()
    for number in range(rounds):
        matches = map_in_threads(partial(_compare_surfaces, some, surfaces, found, distance_mm), pairs)
        step = _step(_pairs_in_world(pairs, matches, found), len(found))
        found = [pose @ small_motion(motion).inverse() for pose, motion in zip(found, step, strict=True)]
        progress("adjustment", number + 1, rounds)
        if np.abs(step[:, 3:]).max() < _CONVERGED * distance_mm:
            break
    progress("adjustment", rounds, rounds)
    scatter = float(np.mean([each.sigma for each in matches if each is not None] or [0.0]))
    return found, scatter, _expected_error(some, _pairs_in_world(pairs, matches, found), found, distance_mm)


def _compare_surfaces(
    some: Sequence[OrientedPoints],
    surfaces: Sequence[Surface],
    poses: Sequence[Rigid3],
    distance_mm: float,
    pair: tuple[int, int],
) -> Correspondences | None:
    """Some points of one frame on the surface of another."""
    one, other = pair
    return match_point_to_plane(some[one], surfaces[other], poses[other] @ poses[one].inverse(), _REACH, distance_mm)


_Pair = tuple[int, int, Correspondences]
"""Two frames, and how the surface of the first lies on that of the second, in the world."""


def _pairs_in_world(
    pairs: Sequence[tuple[int, int]], matches: Sequence[Correspondences | None], poses: Sequence[Rigid3]
) -> list[_Pair]:
    """The pairs that lie on each other."""
    world_from_rig = [pose.inverse() for pose in poses]
    return [
        (
            *(one, other),
            each._replace(
                points=world_from_rig[other].apply(each.points), normals=world_from_rig[other].rotate(each.normals)
            ),
        )
        for (one, other), each in zip(pairs, matches, strict=True)
        if each is not None
    ]


def _equations(pairs: Sequence[_Pair], count: int) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n"]]:
    """Normal equations of small motions of all frames, in the world; the first frame stays."""
    matrix, right = np.zeros((count, 6, count, 6)), np.zeros((count, 6))
    for one, other, each in pairs:
        block, side = each.normal_equations()
        matrix[one, :, one] += block
        matrix[other, :, other] += block
        matrix[one, :, other] -= block
        matrix[other, :, one] -= block
        right[one] -= side
        right[other] += side
    free = 6 * (count - 1)
    return matrix[1:, :, 1:].reshape(free, free), right[1:].ravel()


def _step(pairs: Sequence[_Pair], count: int) -> Float[np.ndarray, "f 6"]:
    """Small motions of all frames that bring surfaces together."""
    step = np.zeros((count, 6))
    if pairs:
        step[1:] = solve_damped(*_equations(pairs, count), _DAMPING).reshape(-1, 6)
    return step


def _covariance(pairs: Sequence[_Pair], poses: Sequence[Rigid3], distance_mm: float) -> Float[np.ndarray, "n n"]:
    """Covariance of the motions of all frames but the first (rotation vector, translation in mm, in the world).

    It follows from how the gradients of all pairs scatter (Huber, 5th Berkeley Symposium, 1967) from block to block of
    space, and of the view; what scatters within both would be counted twice (C. Cameron, J. Gelbach, D. Miller, Journal
    of Business and Economic Statistics 29, 2011).
    """
    matrix, _ = _equations(pairs, len(poses))

    def in_space(one: int, match: Correspondences) -> Float[np.ndarray, "n 3"]:
        return np.floor(match.points / (_IN_SPACE * distance_mm))

    def in_view(one: int, match: Correspondences) -> Float[np.ndarray, "n 3"]:
        return np.floor(poses[one].apply(match.points) / (_IN_VIEW * distance_mm))

    def in_both(one: int, match: Correspondences) -> Float[np.ndarray, "n 6"]:
        return np.concatenate([in_space(one, match), in_view(one, match)], axis=1)

    scatter = (
        _scatter(pairs, in_space, len(poses), len(matrix))
        + _scatter(pairs, in_view, len(poses), 1)
        - _scatter(pairs, in_both, len(poses), len(matrix))
    )
    slope = sum(each.slopes.sum() for *_, each in pairs) / sum(each.weights.sum() for *_, each in pairs)
    found = solve_damped(matrix, solve_damped(matrix, scatter, _DAMPING).T, _DAMPING) / slope**2
    values, vectors = np.linalg.eigh((found + found.T) / 2)
    return np.asarray((vectors * np.clip(values, 0, None)) @ vectors.T)


def _scatter(
    pairs: Sequence[_Pair], blocks_of: Callable[[int, Correspondences], Float[np.ndarray, "n k"]], count: int, used: int
) -> Float[np.ndarray, "m m"]:
    """How the gradients scatter from block to block of points, of which the motions use up so many."""
    gradients, blocks, frames = [], [], []
    for one, other, each in pairs:
        gradient = each.rows * (each.weights * each.distances)[:, None]
        shown, inside = np.unique(blocks_of(one, each), axis=0, return_inverse=True)
        sums = np.stack([np.bincount(inside.reshape(-1), column, len(shown)) for column in gradient.T], axis=1)
        gradients += [-sums, sums]
        blocks += [shown, shown]
        frames += [np.full(len(shown), one), np.full(len(shown), other)]
    block = np.unique(np.concatenate(blocks), axis=0, return_inverse=True)[1].reshape(-1)
    columns = 6 * np.concatenate(frames)[:, None] + np.arange(6)
    rows = np.broadcast_to(block[:, None], columns.shape)
    shape = block.max() + 1, 6 * count
    by_block = sparse.coo_array((np.concatenate(gradients).ravel(), (rows.ravel(), columns.ravel())), shape).tocsr()
    left = max(1 - used / shape[0], 1 / shape[0])
    return (by_block.T @ by_block).toarray()[6:, 6:] / left


def _expected_error(
    some: Sequence[OrientedPoints], pairs: Sequence[_Pair], poses: Sequence[Rigid3], distance_mm: float
) -> Expectation | None:
    """How far the surface may be off by its poses; None for a single frame, and where none lies on another."""
    if not pairs:
        return None
    each = max(MOST_POINTS // len(poses), 1)
    parts = [pose.inverse().apply(shown.points[:each]) for shown, pose in zip(some, poses, strict=True)]
    points = np.concatenate(parts)
    owner = np.repeat(np.arange(len(poses)), [len(part) for part in parts])
    steps = steps_drawn(_covariance(pairs, poses, distance_mm)).T.reshape(-1, len(poses) - 1, 6)
    of_points = np.pad(steps, ((0, 0), (1, 0), (0, 0)))[:, owner]
    return expectation_of(points, np.cross(of_points[..., :3], points) + of_points[..., 3:])
