"""How far the surface of one camera may be off: the covariance of its poses and lens, from the normal equations of the
adjustment that found them (B. Triggs et al., Bundle adjustment: a modern synthesis, 2000, section 9), and what draws
from it make of the points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import bsr_array, coo_array, csr_array

from cuspid.model.camera import Camera
from cuspid.model.reconstruction import Expectation
from cuspid.model.sparse_model import PhotoModel
from cuspid.motion.bundle.expectation import DRAWS, MOST_POINTS, expectation_of

_GAUGE = 7
"""Rotation, translation and scale of the whole, which no photograph determines."""
_LEAST_SHARE = 1e-13
"""Eigenvalues below this share of the largest one mean that the photographs do not determine the poses."""
_POSE = 6


def expect_accuracy(model: PhotoModel, scale_sigma: float, held: frozenset[str] = frozenset()) -> Expectation | None:
    """How far the points of a model in millimetres may be off, by poses, lens and scale. None where the photographs do
    not determine the poses.

    The errors of the keypoints are taken to be independent and all as large as their residuals say. Of lenses that are
    not ``held`` the focal length and those coefficients of distortion that are not zero count as found.

    Args:
        model: adjusted poses, lens and points.
        scale_sigma: standard deviation of the scale, as a share of it.
        held: names of the cameras whose calibration was given.
    """
    system = _normal_equations(model, held)
    unit = 1 / np.sqrt(np.maximum(np.diag(system.reduced), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(system.reduced * np.outer(unit, unit))
    if values[_GAUGE] <= _LEAST_SHARE * values[-1]:
        return None
    factor = unit[:, None] * vectors[:, _GAUGE:] * (system.sigma_px / np.sqrt(values[_GAUGE:]))
    rng = np.random.default_rng(0)
    steps = factor @ rng.standard_normal((factor.shape[1], DRAWS))
    count = len(model.tracks.points)
    some = np.unique(np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(np.int64))
    rows = (3 * some[:, None] + np.arange(3)).ravel()
    moved = np.moveaxis((system.follow[rows] @ steps).reshape(len(some), 3, DRAWS), 2, 0)
    points = model.tracks.points[some]
    return expectation_of(points, _scale_by(points, moved, scale_sigma * rng.standard_normal(DRAWS)))


def _scale_by(
    points: Float[np.ndarray, "n 3"], moved: Float[np.ndarray, "d n 3"], shares: Float[np.ndarray, "d"]
) -> Float[np.ndarray, "d n 3"]:
    """Draws whose scale, which the photographs do not tell, is that of the given ones."""
    offsets = points - points.mean(axis=0)
    own = np.einsum("dni,ni->d", moved, offsets) / np.sum(offsets**2)
    return np.asarray(moved + (shares - own)[:, None, None] * offsets)


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations with the points eliminated."""

    reduced: Float[np.ndarray, "k k"]
    """Of all poses (rotation vector, rad, and translation on the left of each) and free parameters, in px^-2."""
    follow: csr_array
    """By how much each coordinate of the points follows these, shape (3 points, k)."""
    sigma_px: float
    """Standard deviation of a coordinate of a keypoint."""


def _normal_equations(model: PhotoModel, held: frozenset[str]) -> _System:
    tracks, poses = model.tracks, list(model.cam_from_world.values())
    free = {name: () if name in held else _free_parameters(camera) for name, camera in model.cameras.items()}
    first = _first_columns(free, _POSE * len(poses))
    size = _POSE * len(poses) + sum(map(len, free.values()))
    rows, columns, values, by_points, residuals = [], [], [], [], []
    order = np.argsort(tracks.frame_index, kind="stable")
    limits = np.searchsorted(tracks.frame_index[order], np.arange(len(poses) + 1))
    for frame, pose in enumerate(poses):
        seen = order[limits[frame] : limits[frame + 1]]
        name = model.camera_of[model.frames[frame]]
        camera = model.cameras[name]
        in_cam = pose.apply(tracks.points[tracks.point_index[seen]])
        by_cam, by_lens = camera.projection_derivatives(in_cam)
        by_turn = np.cross(in_cam[:, None, :], by_cam)
        lens = [by_lens[..., list(group)].sum(axis=-1) for group in free[name]]
        block = np.concatenate([by_turn, by_cam, *(each[..., None] for each in lens)], axis=2)
        column = np.concatenate([_POSE * frame + np.arange(_POSE), first[name] + np.arange(len(lens))])
        row = (2 * seen[:, None] + np.arange(2))[..., None]
        rows.append(np.broadcast_to(row, block.shape).ravel())
        columns.append(np.broadcast_to(column, block.shape).ravel())
        values.append(block.ravel())
        by_points.append((seen, by_cam @ pose.rotation))
        residuals.append(tracks.pixels[seen] - camera.project(in_cam))
    count = 2 * len(tracks.pixels)
    design = coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (count, size)).tocsr()
    by_point = _point_columns(by_points, tracks.point_index, len(tracks.points))
    own = by_point.T @ by_point
    blocks = np.zeros((len(tracks.points), 3, 3))
    entries = own.tocoo()
    blocks[entries.row // 3, entries.row % 3, entries.col % 3] = entries.data
    coupling = by_point.T @ design
    inverse = np.linalg.pinv(blocks, hermitian=True)
    place = np.arange(len(blocks) + 1)
    follow = (-bsr_array((inverse, place[:-1], place), shape=own.shape).tocsr() @ coupling).tocsr()
    reduced = (design.T @ design + coupling.T @ follow).toarray()
    off = np.concatenate(residuals)
    freedom = max(count - 3 * len(tracks.points) - size + _GAUGE, 1)
    return _System(reduced=(reduced + reduced.T) / 2, follow=follow, sigma_px=float(np.sqrt(np.sum(off**2) / freedom)))


def _point_columns(
    parts: list[tuple[Int[np.ndarray, "_"], Float[np.ndarray, "_ 2 3"]]], point_index: Int[np.ndarray, "o"], count: int
) -> csr_array:
    """Derivatives of all keypoints by all points, shape (2 keypoints, 3 points)."""
    seen = np.concatenate([each for each, _ in parts])
    values = np.concatenate([each for _, each in parts])
    row = np.broadcast_to((2 * seen[:, None] + np.arange(2))[..., None], values.shape)
    column = np.broadcast_to((3 * point_index[seen][:, None] + np.arange(3))[:, None, :], values.shape)
    shape = (2 * len(point_index), 3 * count)
    return coo_array((values.ravel(), (row.ravel(), column.ravel())), shape).tocsr()


def _free_parameters(camera: Camera) -> tuple[tuple[int, ...], ...]:
    """Groups of parameters that were found as one: the focal length, and each coefficient that is not zero."""
    square = camera.focal_px[0] == camera.focal_px[1]
    focal = ((0, 1),) if square else ((0,), (1,))
    begin = len(camera.parameters) - len(camera.distortion)
    return focal + tuple((begin + k,) for k, value in enumerate(camera.distortion) if value != 0)


def _first_columns(free: Mapping[str, tuple[tuple[int, ...], ...]], begin: int) -> dict[str, int]:
    """Where the parameters of each camera begin."""
    starts = begin + np.cumsum([0, *map(len, free.values())])
    return dict(zip(free, map(int, starts), strict=False))
