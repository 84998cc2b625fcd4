"""The solid of a phantom: the smooth union of its crowns and its gum, as an implicit surface in the jaw's frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from cuspid.anatomy.phantom.arrangement import PlacedTooth
from cuspid.anatomy.phantom.gum import Gum, above_root_end, collar
from cuspid.anatomy.teeth.crowns import Points, Values, crown_distance, smooth_min
from cuspid.model.jaw import GUM

FAR_MM = 3.0
"""Distance that stands for all larger ones."""
CREASE_MM = 0.2
"""Rounding of the creases between neighbours and along the margin of the gum."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Solid:
    """The union of teeth and gum."""

    teeth: tuple[PlacedTooth, ...]
    """The teeth."""
    gum: Gum
    """The gum."""

    @property
    def bounds(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Lower and upper corner of a box round the solid, mm."""
        reach = self.gum.half_width.max() + 4.0
        low, high = self.gum.path.min(axis=0) - reach, self.gum.path.max(axis=0) + reach
        return np.array([*low, self.gum.base - 1.0]), np.array([*high, 3.0])

    def parts(self, points: Points) -> tuple[Values, Values, Int[np.ndarray, "n"]]:
        """Signed distances to the teeth and to the gum, and the FDI number of the nearest tooth, each (n,)."""
        tooth = np.full(len(points), FAR_MM)
        gum = self.gum.ridge_distance(points, FAR_MM)
        nearest = np.zeros(len(points), dtype=np.int64)
        low, high = points[:, :2].min(axis=0, initial=np.inf), points[:, :2].max(axis=0, initial=-np.inf)
        for placed in self.teeth:
            near = _within_reach(placed, points, low, high)
            if not len(near):
                continue
            local = placed.to_tooth(points[near])
            shape = placed.tooth.crown
            crown = above_root_end(shape, local, crown_distance(shape, local))
            gum[near] = smooth_min(gum[near], collar(placed, local, crown), 1.6)
            nearest[near] = np.where(crown < tooth[near], placed.fdi, nearest[near])
            tooth[near] = smooth_min(tooth[near], crown, CREASE_MM)
        return tooth, gum, nearest

    def distance(self, points: Points) -> Values:
        """Approximate signed distance, shape (n,), to the solid."""
        tooth, gum, _ = self.parts(points)
        return smooth_min(tooth, gum, CREASE_MM)

    def lead_of_gum(self, points: Points) -> Values:
        """How much nearer the gum is than the teeth, mm, shape (n,); zero at the margin."""
        tooth, gum, _ = self.parts(points)
        return tooth - gum

    def labels(self, points: Points) -> Int[np.ndarray, "n"]:
        """FDI number, or 0 for gum, of points on the surface."""
        tooth, gum, nearest = self.parts(points)
        return np.where(tooth <= gum, nearest, GUM)


def _within_reach(
    placed: PlacedTooth, points: Points, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> Int[np.ndarray, "m"]:
    """Indices (m,) of the points, all between two corners seen from above, nearer to a tooth than about `FAR_MM`."""
    crown = placed.tooth.crown
    reach = np.hypot(crown.half_width_mm, crown.half_depth_mm) + FAR_MM
    axis = placed.to_jaw(np.array([0.0, 0.0, crown.height_mm / 2]))[:2]
    if np.any(axis < low - reach) or np.any(axis > high + reach):
        return np.zeros(0, dtype=np.int64)
    x, y = points[:, 0] - axis[0], points[:, 1] - axis[1]
    return np.flatnonzero(x * x + y * y < reach**2)
