"""A statistical shape model of jaws.

Notation: a jaw of the model is ``mean + sum_k w_k sd_k mode_k`` with weights ``w`` in standard deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from cuspid.model.jaw import Jaw, Landmark
from cuspid.runtime.errors import InputError


@dataclass(frozen=True, kw_only=True)
class MeanStep:
    """One round of the iteration: the current mean is fitted to all samples, and their mean is taken."""

    change_um: float
    """How far the vertices of the mean moved, root mean square."""
    surface_change_um: float
    """How far they moved along the normals of the mean: what changes its surface, root mean square."""
    largest_change_um: float
    """How far the vertex that moved most moved."""
    covered_pct: float
    """Share of the vertices, over all samples, that lie on the sample's surface."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeModel:
    """The mean of a set of jaws and how they vary about it."""

    mean: Jaw
    """Mean jaw with the faces and labels of the first sample, and the mean of the common landmarks."""
    modes: Float[np.ndarray, "k v 3"]
    """Principal modes: displacement of each vertex of the mean, root mean square 1 over the surface."""
    landmark_modes: Float[np.ndarray, "k l 3"]
    """The same modes at the landmarks, in the order of ``mean.landmarks``."""
    standard_deviations_mm: Float[np.ndarray, "k"]
    """Standard deviation of each mode over the samples: root mean square displacement of the surface, mm."""
    variance_shares: Float[np.ndarray, "k"]
    """Share of each mode in the total variance, including the modes that were left out."""
    scores: Float[np.ndarray, "n k"]
    """Weights of each sample, in standard deviations."""
    names: tuple[str, ...]
    """The samples."""
    scales: Float[np.ndarray, "n"]
    """Factor by which each sample was scaled; ones if the size was kept."""
    scaled: bool
    """Whether the samples were scaled to a common size."""
    first: str
    """The sample that gave the mean its faces and labels."""
    correspondence: str
    """How corresponding points were found: ``surface`` or ``landmarks``."""
    converged: bool
    """Whether the iteration converged."""
    log: tuple[MeanStep, ...]
    """Each round of the iteration."""
    notes: tuple[str, ...]
    """What the user should know: teeth that some samples lack, landmarks that were left out."""

    @property
    def variance_mm2(self) -> Float[np.ndarray, "k"]:
        """Variance of each mode, mm^2."""
        return np.asarray(self.standard_deviations_mm**2)

    def sample(self, weights: Sequence[float] | Float[np.ndarray, "w"]) -> Jaw:
        """The jaw with the given weights of the first modes, in standard deviations; the other weights are zero.

        Raises InputError for more weights than modes.
        """
        given = np.asarray(weights, dtype=np.float64)
        if len(given) > len(self.modes):
            raise InputError(f"shape model: {len(given)} weights for {len(self.modes)} modes; give fewer")
        steps = given * self.standard_deviations_mm[: len(given)]
        moved = self.mean.mesh.vertices + np.einsum("k,kvd->vd", steps, self.modes[: len(given)])
        points = np.einsum("k,kld->ld", steps, self.landmark_modes[: len(given)])
        landmarks = {
            label: Landmark(point.position + shift)
            for (label, point), shift in zip(self.mean.landmarks.items(), points, strict=True)
        }
        return replace(self.mean, mesh=replace(self.mean.mesh, vertices=moved), landmarks=landmarks)
