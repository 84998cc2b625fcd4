"""The anatomical points of a crown, in the frame of the tooth (see `cuspid.anatomy.crowns`).

A cusp tip is the point farthest along the long axis; the angle of an incisal edge, the point farthest in a direction
half-way between edge and side. The buccal groove of a molar crosses the rim at `RIM`, where its profile turns from
the occlusal surface to the side. The central groove is taken at its deepest: of a molar, at its
central pit; of a premolar, whose pits lie to either side, half-way between mesial and distal.
"""

from collections.abc import Mapping
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from cuspid.anatomy.crowns import Crown, Values, crown_distance, top_of
from cuspid.anatomy.landmarks import TOOTH_LANDMARKS, ToothKind

Point = Float[np.ndarray, "3"]

RIM = 0.62
"""Where the buccal groove of a molar crosses the rim, as a fraction of half the depth of the crown."""
ANGLE_DEG = {"incisor": 45.0, "canine": 60.0}
"""Direction in which the angle of an edge is the farthest point, from the long axis to the side: the edge of a canine
slopes."""
STEEPEST = 0.02
"""Residual distance in mm above which a vertical line does not meet the crown."""


@lru_cache(maxsize=4096)
def crown_points(crown: Crown, kind: ToothKind) -> Mapping[str, Point]:
    """The landmarks on the crown by name, mm: those of `TOOTH_LANDMARKS` but for the cervices."""
    if crown.edge:
        return MappingProxyType(_edge_points(crown, kind))
    wide = 0.15 if kind == "molar" else 0.0
    points = {**_cusp_points(crown), "central_groove": _deepest(crown, wide)}
    if kind == "molar":
        points["buccal_groove"] = _buccal_groove(crown)
    return MappingProxyType({name: points[name] for name in TOOTH_LANDMARKS[kind] if name in points})


def _edge_points(crown: Crown, kind: ToothKind) -> dict[str, Point]:
    """Corners and middle of an incisal edge."""
    half, y = crown.half_width_mm, (crown.buccal[-2] - crown.lingual[-2]) / 2 * crown.depth_mm
    lean = np.radians(ANGLE_DEG[kind])
    corners = {
        name: _farthest(crown, (0.8 * side * half, y), np.array([side * np.sin(lean), 0.0, np.cos(lean)]), (1.0, 1.0))
        for name, side in (("mesial_angle", -1), ("distal_angle", 1))
    }
    up = np.array([0.0, 0.0, 1.0])
    middle = ("cusp_tip", (0.5, 0.8)) if kind == "canine" else ("incisal_edge", (0.0, 0.8))
    return {
        "mesial_angle": corners["mesial_angle"],
        middle[0]: _farthest(crown, (0.0, y), up, middle[1]),
        "distal_angle": corners["distal_angle"],
    }


def _cusp_points(crown: Crown) -> dict[str, Point]:
    """Tips of the cusps that have a name on a premolar or a molar."""
    up = np.array([0.0, 0.0, 1.0])
    row = sorted(crown.cusps, key=lambda cusp: cusp.x)
    tips = {
        side: [
            _farthest(crown, (cusp.x * crown.half_width_mm, cusp.y * crown.half_depth_mm), up, (0.6, 0.6))
            for cusp in row
            if cusp.y * sign > 0
        ]
        for side, sign in (("buccal", 1), ("lingual", -1))
    }
    points = {f"{side}_cusp": tips[side][0] for side in tips} | {f"mesio{side}_cusp": tips[side][0] for side in tips}
    return points | ({"distobuccal_cusp": tips["buccal"][1]} if len(tips["buccal"]) > 1 else {})


def _buccal_groove(crown: Crown) -> Point:
    """The (mesio)buccal groove where it crosses the rim."""
    x, y = crown.grooves[0].x * crown.half_width_mm, RIM * crown.half_depth_mm
    return np.array([x, y, top_of(crown, x, y)])


def _deepest(crown: Crown, wide: float) -> Point:
    """The lowest point between buccal and lingual cusps, within a fraction of half the width about the middle."""
    low = max(cusp.y for cusp in crown.cusps if cusp.y < 0)
    high = min(cusp.y for cusp in crown.cusps if cusp.y > 0.25)
    centre = (low + high) / 2 * crown.half_depth_mm
    reach = (wide * crown.half_width_mm, 0.8 * (high - low) / 2 * crown.half_depth_mm)
    return _farthest(crown, (0.0, centre), np.array([0.0, 0.0, -1.0]), reach)


def _farthest(crown: Crown, start: tuple[float, float], towards: Point, reach: tuple[float, float]) -> Point:
    """The point of the occlusal surface farthest in a direction, within `reach` mm of a start (x, y)."""
    best, spread = np.array(start), np.array(reach)
    low, high = best - spread, best + spread
    steps = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    for _ in range(7):
        xy = np.clip(best + spread * steps, low, high)
        points = np.column_stack([xy, heights(crown, xy)])
        best = xy[(points @ towards).argmax()]
        spread = 0.45 * spread
    return np.array([*best, heights(crown, best[None])[0]])


def heights(crown: Crown, xy: Float[np.ndarray, "n 2"]) -> Values:
    """Height in mm, shape (n,), of the surface above points of the cervical plane; minus infinity beside the crown."""
    z = np.full(len(xy), 1.1 * crown.height_mm)
    distance = z
    for _ in range(9):
        distance = crown_distance(crown, np.column_stack([xy, z]))
        z = z - distance
    return np.where(np.abs(distance) < STEEPEST, z, -np.inf)
