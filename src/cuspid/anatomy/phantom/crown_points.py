"""The anatomical points of a crown, in the frame of the tooth (see `cuspid.anatomy.teeth.crowns`).

A cusp tip is the point farthest along the long axis, or in a direction that leans outwards a little; the angle of an
incisal edge, the point farthest in a direction half-way between edge and side. The rim of a molar is taken at
`RIM`, where its profile turns from the occlusal surface to the side; the buccal groove crosses it at the lowest point
between the two mesial buccal cusps. The central groove is taken where it is deepest below the plane of the cusps,
between mesial and distal.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from cuspid.anatomy.landmarks.scheme import (
    ANGLE_DEG,
    TOOTH_LANDMARKS,
    ToothKind,
    below_cusps,
    central_groove_u,
    tip_direction,
)
from cuspid.anatomy.teeth.crowns import Crown, Lobe, Values, crown_distance
from cuspid.model.jaw import Arch

Point = Float[np.ndarray, "3"]

RIM = 0.62
"""Where the rim of a molar is, as a fraction of half the depth of the crown."""
GRID = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
"""Points of a square."""
UP = np.array([0.0, 0.0, 1.0])
"""The occlusal direction."""
STEEPEST = 0.02
"""Residual distance in mm above which a vertical line does not meet the crown."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Goal:
    """A point of the occlusal surface: the farthest in a direction within a rectangle."""

    start: Float[np.ndarray, "2"]
    """Middle of the rectangle, mm."""
    reach: Float[np.ndarray, "2"]
    """Half its sides, mm."""
    towards: Point
    """The direction."""


def crown_points(crown: Crown, arch: Arch, kind: ToothKind) -> dict[str, Point]:
    """The landmarks on the crown by name, mm: those of `TOOTH_LANDMARKS` but for the cervices."""
    names = [name for name in TOOTH_LANDMARKS[kind] if not name.endswith("_cervix")]
    return dict(zip(names, _farthest(crown, [_goal(crown, arch, kind, name) for name in names]), strict=True))


@lru_cache(maxsize=4096)
def crown_point(crown: Crown, arch: Arch, kind: ToothKind, name: str) -> Point:
    """One landmark on the crown, mm."""
    return _farthest(crown, [_goal(crown, arch, kind, name)])[0]


def _goal(crown: Crown, arch: Arch, kind: ToothKind, name: str) -> _Goal:
    """What a landmark is."""
    if name == "central_groove":
        return _deepest(crown, kind)
    if name == "buccal_groove":
        return _crossing(crown)
    return _edge_point(crown, kind, name) if crown.edge else _tip(crown, arch, name)


def _edge_point(crown: Crown, kind: ToothKind, name: str) -> _Goal:
    """A corner of an incisal edge, or its middle or tip."""
    y = (crown.buccal[-2] - crown.lingual[-2]) / 2 * crown.depth_mm
    if name in ("cusp_tip", "incisal_edge"):
        reach = np.array([0.5 if name == "cusp_tip" else 0.0, 0.8])
        return _Goal(start=np.array([0.0, y]), reach=reach, towards=UP)
    side, lean = (-1 if name == "mesial_angle" else 1), np.radians(ANGLE_DEG[kind])
    towards = np.array([side * np.sin(lean), 0.0, np.cos(lean)])
    return _Goal(start=np.array([0.8 * side * crown.half_width_mm, y]), reach=np.ones(2), towards=towards)


def _tip(crown: Crown, arch: Arch, name: str) -> _Goal:
    """The tip of a cusp by its name: the mesial or distal one of its side."""
    cusp = _row(crown, 1 if "buccal" in name else -1)[1 if name.startswith("disto") else 0]
    return _Goal(start=_foot(crown, cusp), reach=np.full(2, 0.6), towards=tip_direction(arch, name))


def _foot(crown: Crown, cusp: Lobe) -> Float[np.ndarray, "2"]:
    """Where a cusp stands, mm."""
    return np.array([cusp.x * crown.half_width_mm, cusp.y * crown.half_depth_mm])


def _row(crown: Crown, side: int) -> list[Lobe]:
    """The buccal (1) or lingual (-1) cusps from mesial to distal."""
    return sorted((cusp for cusp in crown.cusps if side * cusp.y > 0), key=lambda cusp: cusp.x)


def _crossing(crown: Crown) -> _Goal:
    """The lowest point of the rim between the two mesial buccal cusps."""
    mesial, distal = (cusp.x * crown.half_width_mm for cusp in _row(crown, 1)[:2])
    start = np.array([(mesial + distal) / 2, RIM * crown.half_depth_mm])
    return _Goal(start=start, reach=np.array([0.3 * (distal - mesial), 0.0]), towards=-UP)


def _deepest(crown: Crown, kind: ToothKind) -> _Goal:
    """The deepest point between buccal and lingual cusps, between mesial and distal."""
    rows = [np.array([_foot(crown, cusp) for cusp in cusps]) for cusps in (_row(crown, 1)[:2], _row(crown, -1))]
    buccal, lingual = (np.column_stack([row, heights(crown, row)]) for row in rows)
    low, high = lingual[:, 1].max(), buccal[:, 1].min()
    reach = np.array([0.0, 0.4 * (high - low)])
    start = np.array([central_groove_u(kind, [_foot(crown, cusp) for cusp in crown.cusps]), (low + high) / 2])
    return _Goal(start=start, reach=reach, towards=below_cusps(buccal, lingual))


def _farthest(crown: Crown, goals: list[_Goal]) -> Float[np.ndarray, "g 3"]:
    """The points that are sought, by grids that narrow down."""
    best = np.array([goal.start for goal in goals])
    spread = np.array([goal.reach for goal in goals])
    low, high = (best - spread)[:, None], (best + spread)[:, None]
    towards = np.array([goal.towards for goal in goals])
    for _ in range(5):
        xy = np.clip(best[:, None] + spread[:, None] * GRID, low, high)
        z = heights(crown, xy.reshape(-1, 2)).reshape(xy.shape[:2])
        score = np.einsum("gnk,gk->gn", xy, towards[:, :2]) + z * towards[:, 2:]
        best = xy[np.arange(len(goals)), score.argmax(axis=1)]
        spread = 0.35 * spread
    return np.column_stack([best, heights(crown, best)])


def heights(crown: Crown, xy: Float[np.ndarray, "n 2"]) -> Values:
    """Height in mm, shape (n,), of the surface above points of the cervical plane; minus infinity beside the crown."""
    z = np.full(len(xy), 1.1 * crown.height_mm)
    distance = z
    for _ in range(6):
        distance = crown_distance(crown, np.column_stack([xy, z]))
        z = z - distance / 0.8  # the slope of the occlusal part of the distance
    return np.where(np.abs(distance) < STEEPEST, z, -np.inf)
