"""The occlusal plane once more, from the dense surface, where the tips of the cusps are known."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.occlusal_plane import level_crowns
from cuspid.stitching.height_map import AXES_SD_DEG, HeightMap

_STEPS = 8
"""Steps by which a height is found on a surface that is seen from elsewhere. Each leaves of its error the product of
the surface's slope and the tangent of the tilt."""


def level_by_crowns(surface: HeightMap) -> Rigid3:
    """The turn about the origin after which the crowns lie level.

    The rule is that of :mod:`cuspid.model.occlusal_plane`, by which a mesh gets its occlusal frame, too.
    """

    def surface_after(turn: Rigid3) -> Float[np.ndarray, "r c 3"]:
        there = tilt_surface(surface, turn)
        return np.where(there.known[..., None], there.places, np.nan)

    return level_crowns(surface_after, surface.cell_mm, AXES_SD_DEG)


def tilt_surface(surface: HeightMap, new_from_world: Rigid3) -> HeightMap:
    """The surface over another plane, tilted by a few degrees against its own."""
    rows, columns = surface.heights.shape
    world_from_new, cell = new_from_world.inverse(), surface.cell_mm
    corners = surface.places[:: max(1, rows - 1), :: max(1, columns - 1)]
    seen = new_from_world.apply(corners)[..., :2].reshape(-1, 2)
    low = seen.min(axis=0)
    x, y = np.meshgrid(*(low[axis] + cell * np.arange(np.ceil(np.ptp(seen[:, axis]) / cell) + 1) for axis in range(2)))
    places = np.stack([x, y, np.zeros(x.shape)], axis=-1)
    for _ in range(_STEPS):
        there = world_from_new.apply(places)
        places[..., 2] += surface.interpolate(there[..., :2]) - there[..., 2]
    known = surface.known_at(world_from_new.apply(places)[..., :2])
    return HeightMap(corner=low, cell_mm=cell, heights=places[..., 2].astype(np.float32), known=known)
