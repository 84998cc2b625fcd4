"""The noise of a camera, from the scatter of the pixels in uniform patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from cuspid.calibration.patches import FREEDOM, Patches
from cuspid.model.rig import MID_GREY_DN, Sensor

_ROUNDING_DN2 = 1 / 12
"""Variance that rounding to whole numbers adds."""
_ROUNDS = 8
_TOO_MUCH = 4.0
"""Multiple of the expected variance above which it is not noise."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Noise:
    """Variance that grows with the level, as in :class:`cuspid.model.rig.Sensor`."""

    read_dn2: float
    """Variance at level 0, including rounding."""
    per_dn: float
    """Increase of the variance per digital number of level."""
    noise_sigma_dn: float
    """Standard deviation of the estimated noise at mid grey."""
    levels_dn: Float[np.ndarray, "n"]
    """Levels of the patches."""
    variances_dn2: Float[np.ndarray, "n"]
    """Variances of the patches."""

    @property
    def noise_dn(self) -> float:
        """See :attr:`cuspid.model.rig.Sensor.noise_dn`."""
        return float(np.sqrt(max(self.read_dn2 + self.per_dn * MID_GREY_DN - _ROUNDING_DN2, 0.0)))

    @property
    def shot_noise_share(self) -> float:
        """See :attr:`cuspid.model.rig.Sensor.shot_noise_share`."""
        if not self.noise_dn:
            return Sensor().shot_noise_share
        return float(np.clip(self.per_dn * MID_GREY_DN / self.noise_dn**2, 0, 1))

    def sigma_dn(self, level_dn: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Standard deviation of one pixel in one channel."""
        return np.asarray(np.sqrt(np.maximum(self.read_dn2 + self.per_dn * level_dn, _ROUNDING_DN2)))


def noise_of(patches: Patches) -> Noise:
    """A line fitted to the variances of patches over their levels; each is weighted by how well it is known (the
    variance of a variance goes with its square), and variances that are far too large are left out."""
    by = np.column_stack([np.ones(len(patches.level_dn)), patches.level_dn])
    expected = _median_variance(patches)
    for _ in range(_ROUNDS):
        weight = (patches.variance_dn2 < _TOO_MUCH * expected) / expected**2
        matrix = (by * weight[:, None]).T @ by
        line = np.linalg.lstsq(matrix, by.T @ (weight * patches.variance_dn2), rcond=None)[0]
        expected = np.maximum(by @ line, _ROUNDING_DN2)
    middle = np.array([1.0, MID_GREY_DN])
    sigma_dn2 = float(np.sqrt(middle @ np.linalg.pinv(matrix) @ middle * 2 / FREEDOM))
    noise_dn = np.sqrt(max(float(middle @ line), _ROUNDING_DN2))
    return Noise(
        read_dn2=float(line[0]),
        per_dn=float(line[1]),
        noise_sigma_dn=sigma_dn2 / (2 * float(noise_dn)),
        levels_dn=patches.level_dn,
        variances_dn2=patches.variance_dn2,
    )


def _median_variance(patches: Patches) -> Float[np.ndarray, "n"]:
    """The median variance of patches of the same tone."""
    usual = np.zeros(len(patches.dark))
    for tone in np.unique(patches.dark):
        usual[patches.dark == tone] = np.median(patches.variance_dn2[patches.dark == tone])
    return np.maximum(usual, _ROUNDING_DN2)
