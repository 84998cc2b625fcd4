"""How far a surface may be off by the poses, from draws of what they and the calibration may be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cuspid.model.epipolar import skew
from cuspid.model.reconstruction import Expectation

DRAWS = 64
"""Number of draws."""
MOST_POINTS = 2000
"""Number of points for which they are made, at most."""
_END = 0.02
"""Share of the points that counts as an end of a scan."""


def covariance_factor(covariance: Float[np.ndarray, "n n"] | None, size: int) -> Float[np.ndarray, "n n"]:
    """L with L L^T = covariance, which may be singular (parameters without variance are held fixed); zero for None."""
    if covariance is None:
        return np.zeros((size, size))
    scale = np.sqrt(np.diag(covariance))
    unit = np.where(scale > 0, scale, 1)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    return scale[:, None] * vectors * np.sqrt(np.clip(values, 0, None))


def steps_drawn(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n d"]:
    """Draws of parameters with a covariance, one in each column."""
    draws = np.random.default_rng(0).standard_normal((DRAWS, len(covariance)))
    return covariance_factor(covariance, len(covariance)) @ draws.T


def expectation_of(points: Float[np.ndarray, "n 3"], moved: Float[np.ndarray, "d n 3"]) -> Expectation:
    """What is expected of points (mm, in the world) that draws move: each draw is first fitted rigidly to no motion, as
    an evaluation does."""
    offsets = points - points.mean(axis=0)
    scale = np.einsum("dni,ni->d", moved, offsets) / np.sum(offsets**2)
    by_motion = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -np.stack([*map(skew, offsets)])], axis=2
    ).reshape(-1, 6)
    flat = moved.reshape(len(moved), -1).T
    left = (flat - by_motion @ np.linalg.lstsq(by_motion, flat, rcond=None)[0]).T.reshape(moved.shape)
    along = offsets @ np.linalg.svd(offsets, full_matrices=False)[2][0]
    ends = [along >= np.quantile(along, 1 - _END), along <= np.quantile(along, _END)]
    span = points[ends[0]].mean(axis=0) - points[ends[1]].mean(axis=0)
    change = (moved[:, ends[0]].mean(axis=1) - moved[:, ends[1]].mean(axis=1)) @ span / np.linalg.norm(span)
    return Expectation(
        points=points,
        covariance=np.einsum("dni,dnj->nij", left, left) / len(moved),
        scale_sigma_ppm=1e6 * _rms(scale),
        span_mm=float(np.linalg.norm(span)),
        span_sigma_um=1000 * _rms(change),
    )


def _rms(values: Float[np.ndarray, "n"]) -> float:
    return float(np.sqrt(np.mean(values**2)))
