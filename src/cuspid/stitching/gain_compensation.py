"""Brightness that is even over the panorama: a gain for each frame, and the falloff of the lights at the camera.

Model: the logarithm of the recorded brightness of cell c in frame f is  l = a_c + g_f + b q_fc,  with a_c what the
cell itself is like, g_f the gain of the frame, q_fc = log(cos(axis) / d^2) the falloff of a light beside the camera,
and b its exponent (which takes in the sensor's gamma). Burnt-out and dark samples do not take part, so that the clipped
tops of highlights do not pull the gains down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.runtime.options import Options, Range

_ROUNDS = 12
_STRIDE = 3
"""Every so many cells are sampled."""


@dataclass(frozen=True, kw_only=True)
class GainOptions(Options):
    """How brightness differences are evened out."""

    gains: bool = True
    """Estimate a gain for each frame."""
    falloff: bool = True
    """Compensate the falloff of the light."""
    gain_sd: Annotated[float, Range(0.0001, 100)] = 0.2
    """Prior standard deviation of the logarithm of the gains."""
    noise_sd: Annotated[float, Range(0.0001, 100)] = 0.1
    """Standard deviation of the logarithm of a sample: shading and highlights."""


@dataclass
class Samples:
    """Brightness of cells in frames; a few hundred numbers a frame."""

    frame: list[np.ndarray]
    cell: list[np.ndarray]
    level: list[np.ndarray]
    falloff: list[np.ndarray]

    @staticmethod
    def empty() -> Samples:
        """No samples."""
        return Samples([], [], [], [])

    def take(
        self,
        index: int,
        cells: tuple[slice, slice],
        columns: int,
        color: Float[np.ndarray, "r c 3"],
        falloff: Float[np.ndarray, "r c"],
        usable: Bool[np.ndarray, "r c"],
    ) -> None:
        """Keep some of a frame's usable cells."""
        rows, cols = np.nonzero(usable)
        rows_there, cols_there = rows + cells[0].start, cols + cells[1].start
        some = (rows_there % _STRIDE == 0) & (cols_there % _STRIDE == 0)
        rows, cols, number = rows[some], cols[some], (rows_there * columns + cols_there)[some]
        self.frame.append(np.full(len(number), index))
        self.cell.append(number)
        self.level.append(np.log(color[rows, cols].mean(axis=-1)))
        self.falloff.append(falloff[rows, cols])


@dataclass(frozen=True, eq=False)
class Compensation:
    """Gains of the frames and falloff of the light, as found."""

    gains: Float[np.ndarray, "f"]
    """Logarithm of the gain of each frame."""
    exponent: float
    """How strongly the falloff shows, b."""
    reference: float
    """Falloff that is left as it is."""

    def log_gain(self, index: int, falloff: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Logarithm of what is divided out of a frame."""
        return np.asarray(self.gains[index] + self.exponent * (falloff - self.reference), dtype=np.float32)


def balance(samples: Samples, frames: int, options: GainOptions) -> Compensation:
    """Gains and falloff by alternating robust least squares over the cells that several frames saw."""
    frame, cell, level, falloff = (
        np.concatenate(each) if each else np.zeros(0)
        for each in (samples.frame, samples.cell, samples.level, samples.falloff)
    )
    if not len(level):
        return Compensation(np.zeros(frames), 0.0, 0.0)
    frame, (_, number) = frame.astype(np.int64), np.unique(cell, return_inverse=True)
    reference = float(np.median(falloff))
    q = falloff - reference
    gains, exponent = np.zeros(frames), 0.0
    prior = (options.noise_sd / options.gain_sd) ** 2
    for _ in range(_ROUNDS):
        own = _means(level - gains[frame] - exponent * q, number)
        left = level - own[number] - gains[frame] - exponent * q
        weight = 1 / np.maximum(1.0, np.abs(left) / options.noise_sd)
        if options.falloff:
            centred = q - _means(q, number, weight)[number]
            slope = np.sum(weight * centred * (left + exponent * centred)) / max(np.sum(weight * centred**2), 1e-9)
            exponent = float(np.clip(slope, 0.0, 1.5))
        if options.gains:
            rest = level - own[number] - exponent * q
            sums = np.bincount(frame, weight * rest, frames)
            gains = sums / (np.bincount(frame, weight, frames) + prior)
            gains -= gains.mean()
    return Compensation(gains, exponent, reference)


def _means(
    values: Float[np.ndarray, "n"], number: Int[np.ndarray, "n"], weights: Float[np.ndarray, "n"] | None = None
) -> Float[np.ndarray, "c"]:
    """Mean of the values of each cell."""
    weights = np.ones(len(values)) if weights is None else weights
    return np.asarray(np.bincount(number, weights * values) / np.maximum(np.bincount(number, weights), 1e-12))
