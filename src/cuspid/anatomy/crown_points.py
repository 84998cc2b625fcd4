"""The anatomical points of a crown, in the frame of the tooth (see `cuspid.anatomy.crowns`).

A cusp tip is the point farthest along the long axis; the angle of an incisal edge, the point farthest in a direction
half-way between edge and side. The buccal groove of a molar crosses the rim at `RIM`, where its profile turns from
the occlusal surface to the side. The central groove is taken at its deepest: of a molar, at its
central pit; of a premolar, whose pits lie to either side, half-way between mesial and distal.
"""

from functools import lru_cache

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
UP = np.array([0.0, 0.0, 1.0])
"""The occlusal direction."""
STEEPEST = 0.02
"""Residual distance in mm above which a vertical line does not meet the crown."""


def crown_points(crown: Crown, kind: ToothKind) -> dict[str, Point]:
    """The landmarks on the crown by name, mm: those of `TOOTH_LANDMARKS` but for the cervices."""
    names = [name for name in TOOTH_LANDMARKS[kind] if not name.endswith("_cervix")]
    return {name: crown_point(crown, kind, name) for name in names}


@lru_cache(maxsize=4096)
def crown_point(crown: Crown, kind: ToothKind, name: str) -> Point:
    """One landmark on the crown, mm."""
    if name == "central_groove":
        return _deepest(crown, 0.15 if kind == "molar" else 0.0)
    if name == "buccal_groove":
        return _buccal_groove(crown)
    return _edge_point(crown, kind, name) if crown.edge else _tip(crown, name)


def _edge_point(crown: Crown, kind: ToothKind, name: str) -> Point:
    """A corner of an incisal edge, or its middle or tip."""
    y = (crown.buccal[-2] - crown.lingual[-2]) / 2 * crown.depth_mm
    if name in ("cusp_tip", "incisal_edge"):
        return _farthest(crown, (0.0, y), UP, (0.5 if name == "cusp_tip" else 0.0, 0.8))
    side, lean = (-1 if name == "mesial_angle" else 1), np.radians(ANGLE_DEG[kind])
    towards = np.array([side * np.sin(lean), 0.0, np.cos(lean)])
    return _farthest(crown, (0.8 * side * crown.half_width_mm, y), towards, (1.0, 1.0))


def _tip(crown: Crown, name: str) -> Point:
    """The tip of a cusp by its name: the mesial or distal one of its side."""
    side = 1 if "buccal" in name else -1
    row = sorted((cusp for cusp in crown.cusps if side * cusp.y > 0), key=lambda cusp: cusp.x)
    cusp = row[1 if name.startswith("disto") else 0]
    return _farthest(crown, (cusp.x * crown.half_width_mm, cusp.y * crown.half_depth_mm), UP, (0.6, 0.6))


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
    axes = [np.linspace(-1.0, 1.0, 5) if reach_mm else np.zeros(1) for reach_mm in reach]
    steps = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    for _ in range(5):
        xy = np.clip(best + spread * steps, low, high)
        points = np.column_stack([xy, heights(crown, xy)])
        best = xy[(points @ towards).argmax()]
        spread = 0.35 * spread
    return np.array([*best, heights(crown, best[None])[0]])


def heights(crown: Crown, xy: Float[np.ndarray, "n 2"]) -> Values:
    """Height in mm, shape (n,), of the surface above points of the cervical plane; minus infinity beside the crown."""
    z = np.full(len(xy), 1.1 * crown.height_mm)
    distance = z
    for _ in range(6):
        distance = crown_distance(crown, np.column_stack([xy, z]))
        z = z - distance / 0.8  # the slope of the occlusal part of the distance
    return np.where(np.abs(distance) < STEEPEST, z, -np.inf)
