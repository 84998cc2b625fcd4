"""Where the teeth of a phantom stand: fourteen teeth in a row that touch and have the asked widths.

Frames. *Jaw*: the occlusal frame of `cuspid.jaw`. Seen along -Z with +Y up, +X points right; that is the patient's
right in a lower jaw (teeth 41-47) and the patient's left in an upper one (teeth 21-27). *Tooth*: see
`cuspid.anatomy.crowns`; the frame of a tooth with X < 0 is left-handed, for it is the mirror image of its counterpart.

The teeth of a quadrant are a chain of segments, each as long as its tooth is wide, that touch at the contact points.
Their headings are those nearest to a natural arch that give it its transverse widths.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from cuspid.anatomy.crown_points import Point, crown_points
from cuspid.anatomy.crowns import Crown, Points, crown_distance, silhouettes, top_of
from cuspid.anatomy.dentition import ARCH_FORMS, QUADRANTS, ArchForm, Tooth
from cuspid.anatomy.landmarks import kind_of
from cuspid.jaw import Arch

CONTACT_OVERLAP_MM = 0.02
"""Neighbours overlap by this much, beside the rounding of creases: contact points are worn to small areas."""
CONTACT_ROUNDS = 4
"""How often the teeth are moved together until they touch."""
WIDTH_POINTS = {3: "cusp_tip", 6: "buccal_groove", 7: "buccal_groove"}
"""Landmarks between which the transverse widths of the arch are measured, by the position of the tooth."""
PIVOT = 0.7
"""Height of the contacts, about which a tooth is inclined, as a fraction of its crown."""


@dataclass(frozen=True, kw_only=True)
class PhantomOptions:
    """What the phantom looks like and how finely it is meshed."""

    arch: Arch = "lower"
    """Which jaw."""
    seed: int = 0
    """Individual variation of size, shape, rotation and height of the teeth, and of the gum."""
    edge_mm: float = 0.2
    """Spacing of the sampling grid, about the edge length of the faces; 0.2 gives some 400 000 faces."""
    spee_mm: float = 1.5
    """Depth of the curve of Spee between the incisors and the second molar."""
    variation: float = 1.0
    """Strength of the individual variation: 0 = the textbook arch, 1 = natural."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedTooth:
    """A tooth in the jaw."""

    fdi: int
    """FDI number."""
    tooth: Tooth
    """Shape and stand."""
    axes: Float[np.ndarray, "3 3"]
    """Columns: distal, buccal and occlusal direction in the jaw; a reflection for X < 0."""
    origin: Float[np.ndarray, "3"]
    """Centre of the cervix in the jaw, mm."""

    @property
    def is_last(self) -> bool:
        """Whether no tooth stands behind it."""
        return self.fdi % 10 == 7

    def to_tooth(self, points: Points) -> Points:
        """Points (n, 3) of the jaw in the frame of the tooth."""
        return np.einsum("ni,ij->nj", points - self.origin, self.axes)

    def to_jaw(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """A point (3,) of the tooth in the jaw."""
        return self.axes @ point + self.origin


def place_teeth(options: PhantomOptions, rng: np.random.Generator) -> tuple[PlacedTooth, ...]:
    """The fourteen teeth from the last molar at X < 0 round to the one at X > 0."""
    quadrants = _individuals(QUADRANTS[options.arch], options.variation, rng)
    closing = {side: np.zeros(7) for side in (-1, 1)}
    teeth = _arrange(quadrants, closing, options)
    for _ in range(CONTACT_ROUNDS):
        excess = np.array([clearance(one, other) for one, other in pairwise(teeth)]) + CONTACT_OVERLAP_MM
        excess[6] /= 2  # either central incisor moves half of the way to the midline
        closing = {-1: closing[-1] + excess[6::-1], 1: closing[1] + excess[6:]}
        teeth = _arrange(quadrants, closing, options)
    return teeth


def clearance(one: PlacedTooth, other: PlacedTooth) -> float:
    """Width of the gap between two neighbours at its narrowest, mm; negative where they overlap."""
    front, back = sorted((one, other), key=lambda placed: placed.fdi % 10)
    crown = back.tooth.crown
    box = np.array([crown.half_width_mm, crown.half_depth_mm, crown.height_mm])
    low, high = box * [-1.25, -0.8, 0.35], box * [-0.75, 0.8, 1.0]
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 13).T, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.einsum("ni,ji->nj", grid, back.axes) + back.origin
    outside = np.maximum(crown_distance(crown, grid), crown_distance(front.tooth.crown, front.to_tooth(points)))
    return 2 * float(outside.min())


def _arrange(
    quadrants: dict[int, tuple[Tooth, ...]], closing: dict[int, Float[np.ndarray, "7"]], options: PhantomOptions
) -> tuple[PlacedTooth, ...]:
    """The teeth in the occlusal frame, each drawn towards its mesial neighbour by `closing` (7,), mm."""

    def placed(headings: Float[np.ndarray, "7"]) -> tuple[PlacedTooth, ...]:
        left, right = (
            _place_quadrant(quadrants[side], options.arch, side, headings, closing[side]) for side in (-1, 1)
        )
        return _level((*reversed(left), *right), options)

    return placed(_solve_headings(placed, ARCH_FORMS[options.arch]))


def _individuals(teeth: tuple[Tooth, ...], variation: float, rng: np.random.Generator) -> dict[int, tuple[Tooth, ...]]:
    """The varied teeth of both quadrants, by the sign of X; counterparts are alike but not the same."""
    common = rng.standard_normal((len(teeth), 8))
    deviates = {side: 0.8 * common + 0.6 * rng.standard_normal(common.shape) for side in (-1, 1)}
    return {
        side: tuple(_vary(tooth, variation * row) for tooth, row in zip(teeth, rows, strict=True))
        for side, rows in deviates.items()
    }


def _vary(tooth: Tooth, z: Float[np.ndarray, "8"]) -> Tooth:
    """A tooth changed in size, shape and stand by standard normal deviates (8,)."""
    crown = tooth.crown
    cusps = tuple(replace(cusp, height=cusp.height + 0.012 * z[6 + k % 2]) for k, cusp in enumerate(crown.cusps))
    varied = replace(
        crown,
        width_mm=crown.width_mm * (1 + 0.02 * z[0]),
        depth_mm=crown.depth_mm * (1 + 0.02 * z[1]),
        height_mm=crown.height_mm * (1 + 0.03 * z[2]),
        cusps=cusps,
        phase=3.0 * float(z.sum()),
    )
    return replace(
        tooth,
        crown=varied,
        rotation_deg=tooth.rotation_deg + 2.5 * z[3],
        inclination_deg=tooth.inclination_deg + 1.5 * z[4],
        rise_mm=tooth.rise_mm + 0.12 * z[5],
    )


def _fdi(arch: Arch, side: int, position: int) -> int:
    """FDI number of the tooth at `position` (1 = central incisor) on the side of the sign of X."""
    quadrant = {("lower", 1): 40, ("lower", -1): 30, ("upper", 1): 20, ("upper", -1): 10}[arch, side]
    return quadrant + position


def _solve_headings(
    placed: Callable[[Float[np.ndarray, "7"]], tuple[PlacedTooth, ...]], form: ArchForm
) -> Float[np.ndarray, "7"]:
    """Headings (7,) in radians of a quadrant's teeth: nearest to the natural ones, giving the arch its widths."""
    targets = np.array([form.inter_canine_mm, form.inter_first_molar_mm, form.inter_second_molar_mm])
    natural = np.radians(form.headings_deg)

    def misfit(change: Float[np.ndarray, "7"]) -> Float[np.ndarray, "10"]:
        return np.concatenate([100.0 * (arch_widths(placed(natural + change)) - targets), np.diff(change, prepend=0.0)])

    return natural + least_squares(misfit, np.zeros(7), xtol=1e-5, ftol=1e-6).x


def arch_widths(teeth: tuple[PlacedTooth, ...]) -> Float[np.ndarray, "3"]:
    """Distances (3,) in mm between the canines' tips, and between the buccal grooves of first and second molars."""
    points: dict[int, list[Point]] = {position: [] for position in WIDTH_POINTS}
    for placed in teeth:
        if placed.fdi % 10 in WIDTH_POINTS:
            point = crown_points(placed.tooth.crown, kind_of(placed.fdi))[WIDTH_POINTS[placed.fdi % 10]]
            points[placed.fdi % 10].append(placed.to_jaw(point))
    return np.array([np.linalg.norm(np.subtract(*points[position])) for position in WIDTH_POINTS])


def _place_quadrant(
    teeth: tuple[Tooth, ...],
    arch: Arch,
    side: int,
    headings: Float[np.ndarray, "7"],
    closing: Float[np.ndarray, "7"],
) -> tuple[PlacedTooth, ...]:
    """Teeth set one after the other from the midline backwards, each along its heading; X has the sign of `side`."""
    widths = np.array([tooth.crown.width_mm for tooth in teeth])[:, None]
    directions = np.column_stack([np.cos(headings), -np.sin(headings)])
    ends = np.cumsum((widths - closing[:, None]) * directions, axis=0)
    centres = ends - widths / 2 * directions
    return tuple(_place(tooth, _fdi(arch, side, k + 1), side, centres[k], headings[k]) for k, tooth in enumerate(teeth))


def _place(tooth: Tooth, fdi: int, side: int, centre: Float[np.ndarray, "2"], heading: float) -> PlacedTooth:
    """A tooth with the middle of its contacts above `centre` (2,), turned along `heading`, its top at Z = 0."""
    distal = np.array([np.cos(heading), -np.sin(heading), 0.0])
    buccal = np.array([np.sin(heading), np.cos(heading), 0.0])
    axes = np.column_stack([distal, buccal, [0.0, 0.0, 1.0]]) @ _stand(tooth)
    pivot = np.array([*centre, 0.0]) + tooth.offset_mm * buccal
    origin = pivot - axes @ _contact_centre(tooth.crown)
    mirror = np.array([side, 1.0, 1.0])
    placed = PlacedTooth(fdi=fdi, tooth=tooth, axes=mirror[:, None] * axes, origin=mirror * origin)
    return replace(placed, origin=placed.origin - [0.0, 0.0, _top(placed)[2]])


def _contact_centre(crown: Crown) -> Float[np.ndarray, "3"]:
    """The point midway between the contacts of a tooth, in its frame, mm."""
    _, _, buccal, lingual = silhouettes(crown, np.array([PIVOT]))
    return np.array([0.0, (buccal[0] + lingual[0]) / 2, PIVOT * crown.height_mm])


def _stand(tooth: Tooth) -> Float[np.ndarray, "3 3"]:
    """Rotation (3, 3) of the tooth by its rotation, inclination and angulation."""
    r, i, a = np.radians([tooth.rotation_deg, -tooth.inclination_deg, -tooth.angulation_deg])
    about_z = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(i), -np.sin(i)], [0, np.sin(i), np.cos(i)]])
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    return about_z @ about_x @ about_y


def _tips(tooth: Tooth) -> Float[np.ndarray, "c 3"]:
    """The cusp tips, or the middle of the incisal edge, in the frame of the tooth, mm."""
    crown = tooth.crown
    middle = (0.0, (crown.buccal[-2] - crown.lingual[-2]) / 2 * crown.depth_mm)
    cusps = [(cusp.x * crown.half_width_mm, cusp.y * crown.half_depth_mm) for cusp in crown.cusps]
    return np.array([(x, y, top_of(crown, x, y)) for x, y in cusps or [middle]])


def _top(placed: PlacedTooth) -> Float[np.ndarray, "3"]:
    """The highest tip in the jaw, mm."""
    tips = np.array([placed.to_jaw(tip) for tip in _tips(placed.tooth)])
    return tips[tips[:, 2].argmax()]


def _level(teeth: tuple[PlacedTooth, ...], options: PhantomOptions) -> tuple[PlacedTooth, ...]:
    """The teeth on the curve of Spee, in the occlusal frame: centred, their tops level on average."""
    tops = np.array([_top(placed) for placed in teeth])
    u = (tops[:, 1] - tops[:, 1].min()) / np.ptp(tops[:, 1])
    spee = (1 if options.arch == "upper" else -1) * options.spee_mm * 4 * u * (1 - u)
    rise = spee + [placed.tooth.rise_mm for placed in teeth]
    rise -= np.polyval(np.polyfit(tops[:, 1], rise, 1), tops[:, 1])
    centroid = np.array([*tops[:, :2].mean(axis=0), 0.0])
    return tuple(
        replace(placed, origin=placed.origin - centroid + [0.0, 0.0, height])
        for placed, height in zip(teeth, rise, strict=True)
    )
