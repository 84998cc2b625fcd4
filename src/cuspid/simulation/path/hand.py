"""How a hand drifts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from cuspid.geometry import Rigid3


@dataclass(frozen=True, eq=False)
class HandMotion:
    """Smooth random drift along the path, independent of where frames are taken."""

    travel_mm: Float[np.ndarray, "n"]
    """Places on the path."""
    drift: Float[np.ndarray, "n 6"]
    """Rotation vector (rad) and translation (mm) at those places."""

    def jittered_from_rig(self, travel_mm: float) -> Rigid3:
        """``jittered_rig_from_rig`` at a place on the path."""
        drift = np.array([np.interp(travel_mm, self.travel_mm, column) for column in self.drift.T])
        return Rigid3.from_rotation_vector(drift[:3], drift[3:])


def hand_motion(
    span_mm: tuple[float, float],
    rng: np.random.Generator,
    *,
    jitter_mm: float,
    jitter_deg: float,
    jitter_length_mm: float,
) -> HandMotion:
    """Gaussian noise smoothed over ``jitter_length_mm``, with the given standard deviations in expectation."""
    sigma, padding = 10, 60
    step = jitter_length_mm / (2 * sigma)
    travel = np.arange(span_mm[0], span_mm[1] + step, step)
    white = rng.standard_normal((len(travel) + 2 * padding, 6))
    unit = gaussian_filter1d(white, sigma, axis=0)[padding:-padding] * np.sqrt(2 * sigma * np.sqrt(np.pi))
    return HandMotion(travel, unit * ([np.deg2rad(jitter_deg)] * 3 + [jitter_mm] * 3))
