"""Errors of a trajectory: absolute and relative pose errors, named and defined as by evo (Grupp 2017) and in the
benchmark of Sturm et al. (IROS 2012), but in um.

The alignment is that of the surface: the poses are compared where the registration of the scan puts them, so that they
explain the errors of the surface, and do not show how well a rigid motion hides them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.runtime.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ErrorStatistics:
    """Statistics of non-negative errors."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


@dataclass(frozen=True, kw_only=True)
class TrajectoryError:
    """How far the poses of a handpiece are from the true ones."""

    frames: int
    """Number of frames with a pose that was found and whose true pose is known."""
    ape_um: ErrorStatistics
    """Absolute pose error, translation part: distance of the handpiece's origin from its true position."""
    ape_deg: ErrorStatistics
    """Absolute pose error, rotation part: angle to the true orientation."""
    rpe_um: ErrorStatistics
    """Relative pose error, translation part: error of the motion from one of these frames to the next."""
    rpe_deg: ErrorStatistics
    """Relative pose error, rotation part."""


def trajectory_error(
    found: Mapping[str, Rigid3], true: Mapping[str, Rigid3], reference_from_scan: Rigid3
) -> TrajectoryError:
    """Errors of ``rig_from_world`` by frame; the worlds are those of the scan and of its reference.

    Raises InputError if fewer than two frames are in both.
    """
    frames = [name for name in true if name in found]
    if len(frames) < 2:
        raise InputError(f"trajectory: {len(frames)} of {len(true)} true poses were found; at least two are needed")
    placed = [reference_from_scan @ found[name].inverse() for name in frames]
    known = [true[name].inverse() for name in frames]
    absolute = [real.inverse() @ pose for real, pose in zip(known, placed, strict=True)]
    steps = zip(pairwise(known), pairwise(placed), strict=True)
    relative = [(a.inverse() @ b).inverse() @ (c.inverse() @ d) for (a, b), (c, d) in steps]
    return TrajectoryError(
        frames=len(frames),
        ape_um=_statistics(_lengths_um(absolute)),
        ape_deg=_statistics(_angles_deg(absolute)),
        rpe_um=_statistics(_lengths_um(relative)),
        rpe_deg=_statistics(_angles_deg(relative)),
    )


def _lengths_um(motions: Sequence[Rigid3]) -> Float[np.ndarray, "n"]:
    return np.array([1000 * np.linalg.norm(motion.translation) for motion in motions])


def _angles_deg(motions: Sequence[Rigid3]) -> Float[np.ndarray, "n"]:
    return np.array([np.rad2deg(np.linalg.norm(motion.rotation_vector)) for motion in motions])


def _statistics(errors: Float[np.ndarray, "n"]) -> ErrorStatistics:
    return ErrorStatistics(
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        std=float(errors.std()),
        min=float(errors.min()),
        max=float(errors.max()),
    )
