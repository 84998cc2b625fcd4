"""Generalised Procrustes analysis of landmarks: many configurations laid on their mean, without reflection.

Notation: a configuration is (l, 3), mm; n of them are laid on each other by ``s_i R_i x + t_i``. The rotations are
those of Gower's algorithm (J. C. Gower, Psychometrika 40, 1975), the scales the best ones for given rotations (J. M. F.
ten Berge, Psychometrika 42, 1977). What the analysis leaves open, the frame and the size of the mean, is fixed by the
samples as they stood, so that it does not depend on their order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from cuspid.geometry import best_similarity
from cuspid.runtime.errors import InputError

_MOST_ROUNDS = 1000
_STILL = 1e-13
"""The mean has converged where it moves less than this, relative to its size."""
_FLAT = 1e-3
"""Points lie in a line or a plane where they depart from it less than this, relative to their extent."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Superposition:
    """Configurations laid on their mean."""

    mean: Float[np.ndarray, "l 3"]
    """Mean of the aligned configurations, mm."""
    aligned: Float[np.ndarray, "n l 3"]
    """The configurations, laid on the mean."""
    rotations: Float[np.ndarray, "n 3 3"]
    """Proper rotation of each."""
    translations: Float[np.ndarray, "n 3"]
    """Translation of each, mm."""
    scales: Float[np.ndarray, "n"]
    """Factor of each; ones where the size was kept."""

    def apply(self, sample: int, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 3"]:
        """Points (p, 3) of a sample moved with its configuration."""
        return self.scales[sample] * points @ self.rotations[sample].T + self.translations[sample]


def dimension(points: Float[np.ndarray, "l 3"]) -> int:
    """How many dimensions points span: 0 where they coincide, 1 in a line, 2 in a plane, 3 in space."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return int((spread > max(_FLAT * spread[0], 1e-9)).sum())


def superpose(samples: Float[np.ndarray, "n l 3"], *, scale: bool = False) -> Superposition:
    """Lay configurations on their mean by rotation, translation and, if asked, scale.

    The mean stands in the mean frame of the samples (the rotation that brings it nearest to the plain mean of the
    coordinates); where they were scaled, it has the mean of their centroid sizes. Raises InputError for fewer
    than three points, or where the points of one configuration lie in a line.
    """
    for number, sample in enumerate(samples):
        if len(sample) < 3 or dimension(sample) < 2:
            raise InputError(
                f"Procrustes: the points of configuration {number} are collinear; three that are not are needed"
            )
    centres = samples.mean(axis=1)
    centred = samples - centres[:, None]
    rotations, scales, mean = _consensus(centred, scale)
    _, turn, _ = best_similarity(mean, centred.mean(axis=0))
    sizes = np.linalg.norm(centred, axis=(1, 2))
    factor = sizes.mean() / np.linalg.norm(mean) if scale else 1.0
    rotations, scales = turn @ rotations, factor * scales
    origin = centres.mean(axis=0)
    translations = origin - scales[:, None] * np.einsum("nij,nj->ni", rotations, centres)
    aligned = scales[:, None, None] * np.einsum("nij,nlj->nli", rotations, centred) + origin
    return Superposition(
        mean=aligned.mean(axis=0), aligned=aligned, rotations=rotations, translations=translations, scales=scales
    )


def _consensus(
    centred: Float[np.ndarray, "n l 3"], scale: bool
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n"], Float[np.ndarray, "l 3"]]:
    """Rotations and scales that lay centred configurations on their mean, and the mean."""
    mean, scales = centred[0], np.ones(len(centred))
    for _ in range(_MOST_ROUNDS):
        rotations = np.stack([best_similarity(sample, mean)[1] for sample in centred])
        turned = np.einsum("nij,nlj->nli", rotations, centred)
        if scale:
            scales = _best_scales(turned)
        before, mean = mean, (scales[:, None, None] * turned).mean(axis=0)
        if np.linalg.norm(mean - before) < _STILL * np.linalg.norm(mean):
            break
    return rotations, scales, mean


def _best_scales(turned: Float[np.ndarray, "n l 3"]) -> Float[np.ndarray, "n"]:
    """Scales that bring rotated configurations nearest to each other, the sum of their squared sizes kept."""
    flat = turned.reshape(len(turned), -1)
    sizes = np.linalg.norm(flat, axis=1)
    units = flat / sizes[:, None]
    leading = np.abs(np.linalg.eigh(units @ units.T)[1][:, -1])
    return np.asarray(leading * np.linalg.norm(sizes) / sizes)
