"""The crowns of the permanent teeth as implicit surfaces.

Frame of a tooth: origin on its axis at the height of the cervix, +x distal, +y buccal (labial), +z occlusal
(incisal), mm. A left and a right tooth are mirror images, so one specification serves both.

A crown is described the way a book on dental anatomy draws it: by its mesial, distal, buccal and lingual
silhouettes over the height, by how square and how tapered its horizontal sections are, and by its occlusal
surface. The occlusal surface follows the tooth's development: it is the upper envelope of *lobes* (cusps and
marginal ridges, each a dome with ridges running down from its tip), and the lines where two lobes meet are the
developmental grooves. An incisor or canine has an incisal edge instead.

Sizes: mesiodistal, buccolingual and cervico-occlusal dimensions of Wheeler's table of measurements (S. J. Nelson,
*Wheeler's Dental Anatomy, Physiology and Occlusion*, 11th ed., table 1.1).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

Values = Float[np.ndarray, "n"]
Points = Float[np.ndarray, "n 3"]

LEVELS = np.array([-0.9, -0.3, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2])
"""Heights at which silhouettes are given, as fractions of the crown height: 0 the cervix, 1 the highest cusp."""

GROOVE_WIDTH_MM = 0.38
"""Half-width of a developmental groove, as the height difference of the two cusps that meet in it."""
FILLET_MM = 0.35
"""Height difference within which the valley between two cusps is rounded."""
RIDGE_BLEND_MM = 0.5
"""Height difference within which a marginal ridge blends into the cusps."""
RIDGE_SHARPNESS = 3.0
"""Concentration of a ridge about its direction: larger is narrower."""
SECONDARY = 0.07
"""Slope added and taken by the secondary ridges and grooves of a cusp."""
WANDER_MM = 0.14
"""How far grooves and ridges stray from straight lines."""


@dataclass(frozen=True, kw_only=True)
class Lobe:
    """A cusp or a marginal ridge of the occlusal surface: a dome with ridges."""

    x: float
    """Tip, as a fraction of half the mesiodistal width; + distal."""
    y: float
    """Tip, as a fraction of half the buccolingual width; + buccal."""
    height: float
    """Tip, as a fraction of the crown height."""
    ridges: tuple[tuple[float, float], ...] = ()
    """Direction (degrees from +x towards +y) and how much gentler the slope is along each ridge."""
    slope: float = 0.9
    """Fall of the surface away from the tip, between the ridges, mm per mm."""
    radius_mm: float = 0.7
    """Radius within which the tip is rounded."""
    stretch: tuple[float, float] = (1.0, 1.0)
    """Elongation along x and y: a marginal ridge is long in y."""
    groove_mm: float = 0.35
    """Depth of the groove that parts it from its neighbours."""


@dataclass(frozen=True, kw_only=True)
class Edge:
    """The incisal edge: highest at the axis, falling to the mesial and distal corners."""

    mesial_fall_mm: float
    """Fall from the highest point to the mesial corner."""
    distal_fall_mm: float
    """Fall from the highest point to the distal corner."""
    mesial_power: float
    """1 = straight cusp slope; large = straight edge with a tight corner."""
    distal_power: float
    """As `mesial_power`."""
    fossa_mm: float
    """Depth of the lingual fossa between the marginal ridges."""
    lingual_ridge_mm: float = 0.0
    """Height of the lingual ridge that divides the fossa of a canine."""


@dataclass(frozen=True, kw_only=True)
class AxialGroove:
    """A developmental groove that runs from the occlusal surface down the buccal or lingual side."""

    side: Literal["buccal", "lingual"]
    """The side that it marks."""
    x: float
    """Position, as a fraction of half the mesiodistal width."""
    depth_mm: float
    """Depth at the occlusal rim."""
    width_mm: float = 0.5
    """Half-width."""
    end: float = 0.35
    """Height at which it has run out, as a fraction of the crown height."""


@dataclass(frozen=True, kw_only=True)
class Crown:
    """Shape of one kind of tooth. Silhouettes are given at `LEVELS`."""

    width_mm: float
    """Mesiodistal width of the crown."""
    depth_mm: float
    """Buccolingual width of the crown."""
    height_mm: float
    """Cervico-occlusal height of the crown on the buccal side."""
    mesial: tuple[float, ...]
    """Mesial silhouette seen from buccal, as fractions of half the width."""
    distal: tuple[float, ...]
    """Distal silhouette seen from buccal, as fractions of half the width."""
    buccal: tuple[float, ...]
    """Buccal silhouette seen from mesial, as fractions of the depth."""
    lingual: tuple[float, ...]
    """Lingual silhouette seen from mesial, as fractions of the depth."""
    squareness: float = 2.5
    """Exponent of the superelliptic horizontal section: 2 an ellipse, 4 a rounded box."""
    taper: float = 0.1
    """How much narrower the lingual half is than the buccal half, as a fraction."""
    skew: float = 0.0
    """Shear of the section: x shifts distally by this per mm towards buccal (rhomboid upper molars)."""
    rim_mm: float = 0.8
    """Rounding between the sides and the occlusal surface."""
    cusps: tuple[Lobe, ...] = ()
    """Cusps; empty where there is an incisal edge."""
    marginal_ridges: tuple[Lobe, ...] = ()
    """Mesial and distal marginal ridges."""
    edge: Edge | None = None
    """Incisal edge; None where there are cusps."""
    grooves: tuple[AxialGroove, ...] = ()
    """Grooves on the buccal and lingual sides."""
    phase: float = 0.0
    """Individual wandering of the occlusal grooves, radians."""

    @property
    def half_width_mm(self) -> float:
        return self.width_mm / 2

    @property
    def half_depth_mm(self) -> float:
        return self.depth_mm / 2


@lru_cache(maxsize=4096)
def top_of(crown: Crown, x: float, y: float) -> float:
    """Height of the surface above a point of the cervical plane, mm."""
    z = np.linspace(0.0, 1.1 * crown.height_mm, 500)
    distance = crown_distance(crown, np.column_stack([np.full(500, x), np.full(500, y), z]))
    last = np.flatnonzero(distance < 0).max(initial=0)
    return float(np.interp(0.0, distance[last : last + 2], z[last : last + 2]))


def smooth_max(a: Values, b: Values, radius: float) -> Values:
    """The larger of two values (n,), rounded where they differ by less than `radius`."""
    blend = np.maximum(radius - np.abs(a - b), 0.0) / radius
    return np.maximum(a, b) + blend * blend * (radius / 4)


def smooth_min(a: Values, b: Values, radius: float) -> Values:
    """The smaller of two values (n,), rounded where they differ by less than `radius`."""
    blend = np.maximum(radius - np.abs(a - b), 0.0) / radius
    return np.minimum(a, b) - blend * blend * (radius / 4)


def smooth_step(x: Values, low: float, high: float) -> Values:
    """0 below `low`, 1 above `high`, a cubic between, shape (n,)."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def crown_distance(crown: Crown, points: Points) -> Values:
    """Approximate signed distance in mm, shape (n,), of points (n, 3) in the frame of the tooth; negative inside."""
    level = points[:, 2] / crown.height_mm
    side, lingual_side = _side_distance(crown, points, level)
    relief = _side_relief(crown, points, level, lingual_side)
    top = _edge_height(crown, crown.edge, points) if crown.edge else _occlusal_height(crown, points)
    return smooth_max(side + relief, 0.8 * (points[:, 2] - top), crown.rim_mm)


def silhouettes(crown: Crown, level: Values) -> tuple[Values, Values, Values, Values]:
    """Mesial and distal x, buccal and lingual y of the outline in mm, each (n,), at heights given as in `LEVELS`."""
    mesial, distal, buccal, lingual = _silhouette_spline(crown)(np.clip(level, LEVELS[0], LEVELS[-1])).T
    return mesial, distal, buccal, lingual


@lru_cache(maxsize=256)
def _silhouette_spline(crown: Crown) -> CubicSpline:
    half, depth = crown.half_width_mm, crown.depth_mm
    table = np.column_stack(
        [-half * np.array(crown.mesial), half * np.array(crown.distal), depth * np.array(crown.buccal),
         -depth * np.array(crown.lingual)]
    )  # fmt: skip
    return CubicSpline(LEVELS, table, bc_type="natural")


def _side_distance(crown: Crown, points: Points, level: Values) -> tuple[Values, Values]:
    """Distance to the sides, shape (n,), and the position from buccal (-1) to lingual (+1), shape (n,)."""
    mesial, distal, buccal, lingual = silhouettes(crown, level)
    b = (buccal - lingual) / 2
    v = (points[:, 1] - (buccal + lingual) / 2) / b
    a = (distal - mesial) / 2 * (1 + crown.taper * np.clip(v, -1.2, 1.2)) / _fullness(crown)
    u = (points[:, 0] - (distal + mesial) / 2 - crown.skew * points[:, 1]) / a
    n = crown.squareness
    pu, pv = np.abs(u) ** (n - 1), np.abs(v) ** (n - 1)
    q = (pu * np.abs(u) + pv * np.abs(v) + 1e-12) ** (1 / n)
    gradient = q ** (1 - n) * np.hypot(pu / a, pv / b)
    return (q - 1) / np.maximum(gradient, 1e-6), -v


@lru_cache(maxsize=256)
def _fullness(crown: Crown) -> float:
    """How much wider taper and skew would make the section, as a ratio."""
    v = np.linspace(-1.0, 1.0, 401)
    reach = (1 + crown.taper * v) * (1 - np.abs(v) ** crown.squareness) ** (1 / crown.squareness)
    shift = crown.skew * v * crown.half_depth_mm / crown.half_width_mm
    return float((reach + shift).max() + (reach - shift).max()) / 2


def _side_relief(crown: Crown, points: Points, level: Values, lingual_side: Values) -> Values:
    """Depth in mm, shape (n,), that grooves and fossae take away from the sides."""
    relief = np.zeros(len(points))
    for groove in crown.grooves:
        facing = smooth_step(lingual_side if groove.side == "lingual" else -lingual_side, 0.2, 0.7)
        across = np.exp(-(((points[:, 0] - groove.x * crown.half_width_mm) / groove.width_mm) ** 2))
        relief += groove.depth_mm * facing * across * smooth_step(level, groove.end, 0.95)
    if crown.edge:
        relief += _lingual_fossa(crown, crown.edge, points, level) * smooth_step(lingual_side, 0.0, 0.6)
    return relief


def _lingual_fossa(crown: Crown, edge: Edge, points: Points, level: Values) -> Values:
    """Depth in mm, shape (n,), of the hollow between cingulum, marginal ridges and incisal edge."""
    u = points[:, 0] / crown.half_width_mm
    window = np.exp(-((u / 0.55) ** 4)) * np.exp(-(((level - 0.58) / 0.27) ** 4))
    return window * (edge.fossa_mm - edge.lingual_ridge_mm * np.exp(-((u / 0.2) ** 2)))


def _edge_height(crown: Crown, edge: Edge, points: Points) -> Values:
    """Height in mm, shape (n,), of the incisal edge above each point."""
    u = points[:, 0] / crown.half_width_mm
    soft = np.sqrt(u * u + 0.01) - 0.1
    mesial = edge.mesial_fall_mm * soft**edge.mesial_power
    distal = edge.distal_fall_mm * soft**edge.distal_power
    return crown.height_mm - np.where(u < 0, mesial, distal)


def _occlusal_height(crown: Crown, points: Points) -> Values:
    """Height in mm, shape (n,), of the occlusal surface above each point."""
    x, y = _wander(crown, points)
    height = _cusp_envelope(crown, x, y)
    for ridge in crown.marginal_ridges:
        height = smooth_max(height, _dome(crown, ridge, x, y), RIDGE_BLEND_MM)
    return height


def _wander(crown: Crown, points: Points) -> tuple[Values, Values]:
    """X and Y of the points, each (n,), displaced so that grooves and ridges do not run straight."""
    x, y = points[:, 0], points[:, 1]
    return (
        x + WANDER_MM * (np.sin(1.5 * y + crown.phase) + 0.5 * np.sin(3.1 * y - 0.9 * x + 2 * crown.phase)),
        y + WANDER_MM * (np.sin(1.4 * x - crown.phase) + 0.5 * np.sin(2.9 * x + 1.1 * y + 3 * crown.phase)),
    )


def _cusp_envelope(crown: Crown, x: Values, y: Values) -> Values:
    """Height in mm, shape (n,), of the highest cusp at each point, with a groove wherever two cusps meet."""
    first = np.full(len(x), -np.inf)
    second, depth = first, np.zeros(len(x))
    for cusp in crown.cusps:
        height = _dome(crown, cusp, x, y)
        depth = np.where(height > first, cusp.groove_mm, depth)
        second = np.maximum(second, np.minimum(first, height))
        first = np.maximum(first, height)
    lead = first - second
    fillet = np.maximum(FILLET_MM - lead, 0.0) ** 2 / (4 * FILLET_MM)
    return first + fillet - depth * np.exp(-((lead / GROOVE_WIDTH_MM) ** 2))


def _dome(crown: Crown, lobe: Lobe, x: Values, y: Values) -> Values:
    """Height in mm, shape (n,), of one lobe at each point."""
    x = (x - lobe.x * crown.half_width_mm) / lobe.stretch[0]
    y = (y - lobe.y * crown.half_depth_mm) / lobe.stretch[1]
    angle = np.arctan2(y, x)
    slope = lobe.slope + SECONDARY * np.sin(6 * angle + crown.phase + 9 * lobe.x)
    for direction, gentler in lobe.ridges:
        slope -= gentler * np.exp(RIDGE_SHARPNESS * (np.cos(angle - np.radians(direction)) - 1))
    run = np.sqrt(x * x + y * y + lobe.radius_mm**2) - lobe.radius_mm
    return lobe.height * crown.height_mm - slope * run
