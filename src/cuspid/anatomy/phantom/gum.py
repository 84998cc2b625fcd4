"""The gum of a phantom as an implicit surface: an alveolar ridge, and a collar round each tooth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from cuspid.anatomy.phantom.arrangement import PlacedTooth
from cuspid.anatomy.teeth.crowns import Crown, Points, Values, silhouettes, smooth_max, smooth_min
from cuspid.geometry import lengths_along
from cuspid.runtime.workers import computed_once

ROOT = 0.7
"""Length of the root that is modelled, as a fraction of the crown height; it ends inside the gum."""
WAVES = 10
"""Number of waves that make the gum uneven."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Gum:
    """The alveolar ridge, swept along the cervices of the teeth."""

    path: Float[np.ndarray, "s 2"]
    """Points of the centre line in XY, mm."""
    crest: Float[np.ndarray, "s"]
    """Height of the crest of the ridge, mm."""
    half_width: Float[np.ndarray, "s"]
    """Half-width of the ridge at its crest, mm."""
    base: float
    """Height of the flat base, mm."""
    waves: Float[np.ndarray, "w 4"]
    """Unevenness: wave vector (rad/mm) and phase of each wave."""

    @staticmethod
    def from_teeth(teeth: tuple[PlacedTooth, ...], waves: Float[np.ndarray, "w 4"]) -> "Gum":
        """The ridge that holds the teeth, uneven by the given waves."""
        cervices = np.array([placed.origin for placed in teeth])
        first, last = (_extrapolate(cervices[k], cervices[j]) for k, j in ((0, 1), (-1, -2)))
        knots = np.vstack([first, cervices, last])
        widths = np.array([placed.tooth.crown.half_depth_mm for placed in teeth])
        table = np.column_stack([knots, np.pad(widths, 1, mode="edge")])
        run = lengths_along(knots[:, :2])
        samples = CubicSpline(run, table)(np.linspace(0.0, run[-1], 1200))
        return Gum(
            path=samples[:, :2],
            crest=samples[:, 2] - 0.6,
            half_width=samples[:, 3],
            waves=waves,
            base=float(cervices[:, 2].min() - 8.0),
        )

    @staticmethod
    def random_waves(rng: np.random.Generator) -> Float[np.ndarray, "w 4"]:
        """Unevenness of an individual."""
        return np.column_stack([rng.normal(0.0, 0.45, (WAVES, 3)), rng.uniform(0.0, 2 * np.pi, WAVES)])

    @computed_once
    def _tree(self) -> cKDTree:
        return cKDTree(self.path)

    def ridge_distance(self, points: Points, far_mm: float) -> Values:
        """Approximate signed distance in mm, shape (n,), to the ridge, no larger than ``far_mm``."""
        distance = np.full(len(points), far_mm)
        low = np.flatnonzero(points[:, 2] < self.crest.max() + far_mm)
        distance[low] = np.minimum(self._ridge_distance(points[low]), far_mm)
        return distance

    def _ridge_distance(self, points: Points) -> Values:
        _, nearest = self._tree.query(points[:, :2])
        offset = points[:, :2] - self.path[nearest]
        across = np.hypot(offset[:, 0], offset[:, 1])
        depth = self.crest[nearest] - points[:, 2]
        side = across - self.half_width[nearest] - 0.12 * np.maximum(depth, 0.0) - self.undulation(points)
        return smooth_max(smooth_max(side, -depth, 3.0), self.base - points[:, 2], 0.6)

    def undulation(self, points: Points) -> Values:
        """Unevenness of the gum in mm, shape (n,)."""
        waves = np.sin(np.einsum("ni,wi->nw", points, self.waves[:, :3]) + self.waves[:, 3])
        return 0.25 / np.sqrt(WAVES) * waves.sum(axis=1)


def _extrapolate(end: Float[np.ndarray, "3"], before: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """A point (3,) behind the last molar, along the line from the tooth before it."""
    step = end - before
    return end + 0.5 * step * [1.0, 1.0, 0.0]


def collar(placed: PlacedTooth, local: Points, distance: Values) -> Values:
    """Signed distance, shape (n,), to the gum round one tooth, from that to the tooth.

    A thin sleeve about the root, and a slab that leans inwards: it shows as a papilla where the tooth recedes.
    """
    crown = placed.tooth.crown
    level = np.maximum(local[:, 2] / crown.height_mm, -0.1)
    u = np.minimum(np.abs(local[:, 0]) / crown.half_width_mm, 1.2)
    _, _, buccal, lingual = silhouettes(crown, level)
    lean = 0.45 - 0.8 * u * u - 3.0 * level
    across = smooth_max(local[:, 1] - buccal - lean, lingual - lean - local[:, 1], 0.5)
    behind = (0.4 if placed.is_last else 1.0) * crown.half_width_mm
    along = np.maximum(-crown.half_width_mm - local[:, 0], local[:, 0] - behind) - 0.3
    slab = smooth_max(across, along, 1.5)
    above = 0.9 * (local[:, 2] - margin_height(placed, local))
    sleeve = smooth_max(distance - 0.45, above, 0.6)
    return above_root_end(crown, local, smooth_min(sleeve, smooth_max(slab, above - 0.3, 1.6), 0.8))


def above_root_end(crown: Crown, local: Points, distance: Values) -> Values:
    """A signed distance, shape (n,), cut off at the end of the modelled root."""
    return smooth_max(distance, -local[:, 2] - ROOT * crown.height_mm, 2.0)


def margin_height(placed: PlacedTooth, local: Points) -> Values:
    """Height in mm, shape (n,), of the scalloped margin: low in the middle of a tooth, high towards its neighbours."""
    crown = placed.tooth.crown
    u = local[:, 0] / crown.half_width_mm
    papilla = 0.5 if crown.edge else 0.41
    rise = np.where(u > 0, 0.1 if placed.is_last else papilla, papilla)
    return crown.height_mm * (0.03 + rise * np.minimum(np.abs(u), 1.05) ** 2.5)
