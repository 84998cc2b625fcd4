"""The form of the arch: headings of the teeth, and their common size, that give a row of teeth asked dimensions.

Notation: the teeth of a quadrant are a chain of segments in the occlusal plane, from the midline backwards. A heading
is the direction of a segment, turned from transverse (0) towards backwards (90 degrees). `a`, `b` and `c` are the
distances between the landmarks of canines, first and second molars, `f` that from the papilla to the middle of the
latter.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from cuspid.anatomy.phantom.crown_points import Point

TOOTH_SIZES = (0.8, 1.2)
"""Sizes of the teeth, relative to the textbook's, among which one is chosen that fits an asked length of the arch."""
WEIGHT_PER_MM = 100.0
"""How much a dimension missed by 1 mm counts, against one radian of a kink."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain:
    """The teeth of one quadrant, at some size."""

    side: int
    """Sign of X."""
    positions: tuple[int, ...]
    """Place of each tooth in the full quadrant, 1 to 7."""
    natural: Float[np.ndarray, "n"]
    """Headings of a natural arch, radians."""
    widths: Float[np.ndarray, "n"]
    """Mesiodistal widths, mm."""
    closing: Float[np.ndarray, "n"]
    """How far each tooth is drawn towards its mesial neighbour, mm."""
    points: Float[np.ndarray, "n 3"]
    """A landmark of each tooth from the middle of its contacts: along the heading, towards buccal, occlusal, mm."""


@dataclass(frozen=True, kw_only=True)
class Aim:
    """The asked dimensions."""

    widths_mm: Mapping[int, float]
    """Distance between the landmarks of the two teeth at each position."""
    length_mm: float | None = None
    """Distance f, where it is asked for."""
    free_size: bool = False
    """Whether the size of the teeth may be chosen."""
    size_weight: float = 4.0
    """How much the logarithm of a free size counts: at 4, teeth 10 % too large as much as a kink of 0.4 radian."""

    @property
    def values(self) -> Float[np.ndarray, "d"]:
        """All dimensions in order."""
        return np.array([*self.widths_mm.values(), *([] if self.length_mm is None else [self.length_mm])])


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """What the plane leaves open: taken from the teeth as they stood before."""

    heights: Mapping[tuple[int, int], float] = field(default_factory=dict)
    """Z of the landmark of each tooth by side and position, mm."""
    papilla: Float[np.ndarray, "3"] = field(default_factory=lambda: np.array([0.0, -4.0, -5.0]))
    """The papilla from the middle between the contacts of the central incisors, mm."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shape:
    """The solution."""

    change: Float[np.ndarray, "7"] = field(default_factory=lambda: np.zeros(7))
    """Change of the headings of both quadrants, tooth by tooth from the midline, radians."""
    size: float = 1.0
    """Size of the teeth relative to the textbook's."""

    @property
    def kinks_deg(self) -> Float[np.ndarray, "7"]:
        """How much each tooth turns from its mesial neighbour other than in a natural arch."""
        return np.degrees(np.abs(np.diff(self.change, prepend=0.0)))

    def headings(self, chain: Chain) -> Float[np.ndarray, "n"]:
        """Headings of a chain, radians."""
        return chain.natural + self.change[: len(chain.natural)]


def solve_shape(chains: tuple[Chain, Chain], size: float, aim: Aim, seen: Seen, start: Shape) -> Shape:
    """The shape nearest to a natural arch that meets the aim, for chains whose teeth have the given size."""

    def misfit(x: Float[np.ndarray, "8"]) -> Float[np.ndarray, "_"]:
        shape = Shape(change=x[:7], size=float(np.exp(x[7])))
        miss = WEIGHT_PER_MM * (dimensions(chains, size, shape, aim, seen) - aim.values)
        return np.concatenate([miss, np.diff(x[:7], prepend=0.0), [aim.size_weight * x[7]]])

    free = np.log(TOOTH_SIZES) if aim.free_size else np.log(start.size) + np.array([-1e-9, 1e-9])
    low, high = np.append(np.full(7, -np.inf), free[0]), np.append(np.full(7, np.inf), free[1])
    x0 = np.append(start.change, np.clip(np.log(start.size), free[0] + 1e-10, free[1] - 1e-10))
    x = least_squares(misfit, x0, bounds=(low, high), xtol=1e-6, ftol=1e-8).x
    return Shape(change=x[:7], size=float(np.exp(x[7])))


def dimensions(chains: tuple[Chain, Chain], size: float, shape: Shape, aim: Aim, seen: Seen) -> Float[np.ndarray, "d"]:
    """The dimensions of the arch in the order of `Aim.values`, mm."""
    points = [_landmarks(chain, shape, shape.size / size, seen) for chain in chains]
    widths = [float(np.linalg.norm(points[1][position] - points[0][position])) for position in aim.widths_mm]
    if aim.length_mm is None:
        return np.array(widths)
    papilla = (points[0][1] + points[1][1]) / 2 + seen.papilla
    return np.array([*widths, np.linalg.norm((points[0][7] + points[1][7]) / 2 - papilla)])


def _landmarks(chain: Chain, shape: Shape, ratio: float, seen: Seen) -> dict[int, Point]:
    """The landmark of each tooth by its position, mm."""
    headings = shape.headings(chain)
    centres, distal, buccal = segments(headings, ratio * chain.widths, chain.closing)
    points = ratio * chain.points
    flat = (centres + points[:, :1] * distal + points[:, 1:2] * buccal) * [chain.side, 1.0]
    heights = [seen.heights.get((chain.side, position), 0.0) for position in chain.positions]
    return dict(zip(chain.positions, np.column_stack([flat, heights]), strict=True))


def segments(
    headings: Float[np.ndarray, "n"], widths: Float[np.ndarray, "n"], closing: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Middles, distal and buccal directions of the segments of the chain at X > 0, each (n, 2)."""
    distal = np.column_stack([np.cos(headings), -np.sin(headings)])
    buccal = np.column_stack([np.sin(headings), np.cos(headings)])
    ends = np.cumsum((widths - closing)[:, None] * distal, axis=0)
    return ends - widths[:, None] / 2 * distal, distal, buccal
