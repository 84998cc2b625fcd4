"""Where the teeth of a phantom stand: in a row, touching, with the asked widths and length of the arch.

Frames. *Jaw*: the occlusal frame of `cuspid.model.jaw`. Seen along -Z with +Y up, +X points right; that is the
patient's right in a lower jaw (teeth 41-47) and the patient's left in an upper one (teeth 21-27). *Tooth*: see
`cuspid.anatomy.teeth.crowns`; the frame of a tooth with X < 0 is left-handed, for it is the mirror image of its
counterpart.

The teeth of a quadrant are a chain of segments, each as long as its tooth is wide, that touch at the contact points.
Their headings are those nearest to a natural arch that give it its dimensions (`arch_form`). Rotated or displaced teeth
touch elsewhere than at their widest, and the row closes up behind them: that is what a crowded front is made of.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from cuspid.anatomy.landmarks.scheme import kind_of
from cuspid.anatomy.phantom.arch_form import Aim, Chain, Seen, Shape, dimensions, segments, solve_shape
from cuspid.anatomy.phantom.crown_points import Point, crown_point
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.teeth.crowns import Crown, Points, crown_distance, silhouettes, top_of
from cuspid.anatomy.teeth.dentition import ARCH_FORMS, QUADRANTS, Tooth
from cuspid.model.jaw import Arch
from cuspid.runtime.errors import InputError

CONTACT_OVERLAP_MM = 0.07
"""Neighbours overlap by this much, beside the rounding of creases: contact points are worn to small areas."""
CONTACT_ROUNDS = 4
"""How often the teeth are moved together until they touch."""
MORE_ROUNDS = 14
"""How often more, where a crowded front or a rotated tooth has to find its place."""
DIMENSION_POINTS: Mapping[int, str] = {3: "cusp_tip", 6: "buccal_groove", 7: "buccal_groove"}
"""Landmarks between which the arch is measured, by the position of the tooth."""
CUBE = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
"""Points of a cube, for the search of a contact."""
PIVOT = 0.7
"""Height of the contacts, about which a tooth is inclined, as a fraction of its crown."""
CROWDED = {1: np.array([-5.0, 0.1]), 2: np.array([7.0, -1.0]), 3: np.array([-6.0, 0.3])}
"""How a crowded front is displaced: for each position degrees of rotation (distal end towards labial) and mm towards
labial, per mm that the lateral incisors stand lingually."""
MOST_CROWDED_MM = 4.0
"""How far a lateral incisor is displaced at most."""

OPTION_OF = {3: "inter_canine_mm", 6: "inter_first_molar_mm", 7: "inter_second_molar_mm"}
"""The option that asks for the distance between the teeth at a position."""
TOLERANCE_MM = 0.05
"""How far an asked dimension may be missed."""
CROWDING_TOLERANCE_MM = 0.3
"""How far asked crowding may be missed."""
MOST_KINK_DEG = 50.0
"""How much the direction of neighbouring teeth may depart from that of a natural arch."""
KINK_MARGIN_DEG = 8.0
"""How much individual teeth may add to a kink of the textbook's."""

PapillaOf = Callable[[tuple["PlacedTooth", ...]], Point]
"""Where the papilla lies behind given teeth."""


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
    is_last: bool = False
    """Whether no tooth stands behind it."""

    @property
    def position(self) -> int:
        """Place in the quadrant, 1 (central incisor) to 7 (second molar)."""
        return self.fdi % 10

    @property
    def arch(self) -> Arch:
        """The arch that it stands in."""
        return "lower" if self.fdi > 30 else "upper"

    def to_tooth(self, points: Points) -> Points:
        """Points (n, 3) of the jaw in the frame of the tooth."""
        return np.einsum("ni,ij->nj", points - self.origin, self.axes)

    def to_jaw(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """A point (3,) of the tooth in the jaw."""
        return self.axes @ point + self.origin


# The row of teeth

Rows = dict[int, tuple[tuple[int, Tooth], ...]]
"""Position and shape of each tooth of a quadrant from the midline backwards, by the sign of X."""


def place_teeth(
    options: PhantomOptions, individuals: dict[int, tuple[Tooth, ...]], papilla_of: PapillaOf
) -> tuple[PlacedTooth, ...]:
    """The teeth from the last one at X < 0 round to the last at X > 0.

    Raises:
        InputError: a tooth that is not there is named, or the asked dimensions cannot be met together.
    """
    rows = _rows(options, individuals)
    aim = _aim(options, rows)
    closing = {side: np.zeros(len(row)) for side, row in rows.items()}
    shape, crowd, seen = Shape(size=options.tooth_size or 1.0), 0.0, Seen()
    loose = {side: np.zeros(len(row)) for side, row in rows.items()}
    teeth: tuple[PlacedTooth, ...] = ()
    for turn in range(_rounds(options) + 1):
        if turn:
            closing = _closing_shifts_mm(teeth, closing)
            seen = _measure_landmarks(teeth, aim, papilla_of)
        if turn == CONTACT_ROUNDS:
            loose = closing
        if turn >= CONTACT_ROUNDS and turn % 2 == 0 and options.crowding_mm:
            crowd = _next_displacement_mm(crowd, _closed_gaps_mm(closing, loose), options.crowding_mm)
        stood = _crowd_front(rows, crowd, options)
        sized = _resize_teeth(stood, shape.size)
        shape = solve_shape(_chains(sized, closing, options.arch), shape.size, aim, seen, shape)
        teeth = _arrange(_resize_teeth(stood, shape.size), closing, shape, options)
    _check(teeth, shape, aim, papilla_of)
    short_mm = options.crowding_mm - _closed_gaps_mm(closing, loose)
    if options.crowding_mm and abs(short_mm) > CROWDING_TOLERANCE_MM:
        raise InputError(
            f"crowding_mm: these teeth can overlap by at most {options.crowding_mm - short_mm:.1f} mm, not "
            f"{options.crowding_mm:g}; ask for less"
        )
    return teeth


def _rounds(options: PhantomOptions) -> int:
    """How often the teeth are moved together."""
    unusual = options.crowding_mm or options.rotate_deg or options.displace_mm
    return CONTACT_ROUNDS + (MORE_ROUNDS if unusual else 3 if options.arch_length_mm else 0)


def _rows(options: PhantomOptions, individuals: dict[int, tuple[Tooth, ...]]) -> Rows:
    """The teeth that are there, varied, rotated and displaced as asked."""
    numbers = {fdi_of(options.arch, side, k + 1): (side, k) for side in (-1, 1) for k in range(7)}
    for name, teeth in (
        ("missing", options.missing),
        ("rotate_deg", options.rotate_deg),
        ("displace_mm", options.displace_mm),
    ):
        for fdi in teeth:
            if fdi not in numbers or (name != "missing" and fdi in options.missing):
                raise InputError(f"{name}: no tooth {fdi} in this {options.arch} jaw; give FDI numbers of its teeth")
            if name == "missing" and fdi % 10 in (1, 3):
                raise InputError(f"missing: {fdi} defines the arch (midline, canine width); do not remove it")
    rows: Rows = {}
    for side in (-1, 1):
        kept = [(k + 1, tooth) for k, tooth in enumerate(individuals[side])]
        named = [(position, tooth, fdi_of(options.arch, side, position)) for position, tooth in kept]
        rows[side] = tuple(
            (position, _rotate_tooth(tooth, options.rotate_deg.get(fdi, 0.0), options.displace_mm.get(fdi, 0.0)))
            for position, tooth, fdi in named
            if fdi not in options.missing
        )
    return rows


def _rotate_tooth(tooth: Tooth, rotation_deg: float, displacement_mm: float) -> Tooth:
    """A tooth rotated about its axis and displaced towards buccal."""
    return replace(tooth, rotation_deg=tooth.rotation_deg + rotation_deg, offset_mm=tooth.offset_mm + displacement_mm)


def _aim(options: PhantomOptions, rows: Rows) -> Aim:
    """The dimensions that the arch shall have."""
    form = ARCH_FORMS[options.arch]
    asked = {3: options.inter_canine_mm, 6: options.inter_first_molar_mm, 7: options.inter_second_molar_mm}
    usual = {3: form.inter_canine_mm, 6: form.inter_first_molar_mm, 7: form.inter_second_molar_mm}
    there = {position for position in asked if all(position in dict(row) for row in rows.values())}
    for position in asked:
        if asked[position] is not None and position not in there:
            raise InputError(f"{OPTION_OF[position]}: a tooth {position} is missing; leave this dimension out")
    if options.arch_length_mm is not None and 7 not in there:
        raise InputError("arch_length_mm: a second molar is missing; leave this dimension out")
    shortened = any(set(range(1, 6)) - set(dict(row)) for row in rows.values())
    widths = {
        position: asked[position] or usual[position]
        for position in sorted(there)
        if asked[position] is not None or position == 3 or not shortened
    }
    given = [*asked.values(), options.arch_length_mm, options.crowding_mm or None]
    free = options.tooth_size is None and any(value is not None for value in given)
    # A crowded arch shall be about as long as before, not its teeth as large as its shorter front allows.
    weight = 10.0 if options.crowding_mm else 4.0
    return Aim(widths_mm=widths, length_mm=options.arch_length_mm, free_size=free, size_weight=weight)


def _resize_teeth(rows: Rows, size: float) -> Rows:
    """The teeth at another size."""

    def resize(tooth: Tooth) -> Tooth:
        crown = tooth.crown
        return replace(
            tooth,
            crown=replace(
                crown,
                width_mm=size * crown.width_mm,
                depth_mm=size * crown.depth_mm,
                height_mm=size * crown.height_mm,
            ),
        )

    return {side: tuple((position, resize(tooth)) for position, tooth in row) for side, row in rows.items()}


def _chains(rows: Rows, closing: dict[int, Float[np.ndarray, "_"]], arch: Arch) -> tuple[Chain, Chain]:
    """The row as segments of the plane."""

    def chain(side: int) -> Chain:
        positions = tuple(position for position, _ in rows[side])
        return Chain(
            side=side,
            positions=positions,
            natural=_natural_headings(positions, arch),
            widths=np.array([tooth.crown.width_mm for _, tooth in rows[side]]),
            closing=closing[side],
            points=np.array([_landmark_from_contacts(position, tooth, arch) for position, tooth in rows[side]]),
        )

    return chain(-1), chain(1)


def _natural_headings(positions: tuple[int, ...], arch: Arch) -> Float[np.ndarray, "n"]:
    """Headings in radians of the teeth at the given positions, closed up along the natural arch."""
    widths = np.array([tooth.crown.width_mm for tooth in QUADRANTS[arch]])
    kept = widths[np.array(positions) - 1]
    along, natural = np.cumsum(widths) - widths / 2, np.radians(ARCH_FORMS[arch].headings_deg)
    return np.interp(np.cumsum(kept) - kept / 2, along, natural)


def _landmark_from_contacts(position: int, tooth: Tooth, arch: Arch) -> Point:
    """The landmark that the arch is measured at, or else the middle of the tooth, from the line of contacts."""
    if position not in DIMENSION_POINTS:
        return np.array([0.0, tooth.offset_mm, 0.0])
    point = crown_point(tooth.crown, arch, kind_of(position), DIMENSION_POINTS[position])
    return _stand(tooth) @ (point - _contact_centre(tooth.crown)) + [0.0, tooth.offset_mm, 0.0]


def _arrange(
    rows: Rows, closing: dict[int, Float[np.ndarray, "_"]], shape: Shape, options: PhantomOptions
) -> tuple[PlacedTooth, ...]:
    """The teeth in the occlusal frame."""
    quadrants = []
    for chain in _chains(rows, closing, options.arch):
        headings = shape.headings(chain)
        centres, _, _ = segments(headings, chain.widths, chain.closing)
        quadrants.append(
            [
                _place(tooth, fdi_of(options.arch, chain.side, position), chain.side, centres[k], float(headings[k]))
                for k, (position, tooth) in enumerate(rows[chain.side])
            ]
        )
        quadrants[-1][-1] = replace(quadrants[-1][-1], is_last=True)
    return _level((*reversed(quadrants[0]), *quadrants[1]), options)


def _measure_landmarks(teeth: tuple[PlacedTooth, ...], aim: Aim, papilla_of: PapillaOf) -> Seen:
    """Heights of the landmarks, and the place of the papilla, of teeth as they stand."""
    heights = {
        (1 if placed.origin[0] > 0 else -1, placed.position): float(dimension_point(placed)[2])
        for placed in teeth
        if placed.position in DIMENSION_POINTS
    }
    centrals = [placed for placed in teeth if placed.position == 1]
    if aim.length_mm is None:
        return Seen(heights=heights)
    middle = np.mean([p.to_jaw(_contact_centre(p.tooth.crown)) for p in centrals], axis=0)
    return Seen(heights=heights, papilla=papilla_of(teeth) - middle * [1.0, 1.0, 0.0])


def dimension_point(placed: PlacedTooth) -> Point:
    """The landmark of a canine or molar that the arch is measured at, in the jaw."""
    name = DIMENSION_POINTS[placed.position]
    return placed.to_jaw(crown_point(placed.tooth.crown, placed.arch, kind_of(placed.fdi), name))


def arch_dimensions(teeth: tuple[PlacedTooth, ...], aim: Aim, papilla_of: PapillaOf) -> Float[np.ndarray, "d"]:
    """The dimensions of placed teeth in the order of `Aim.values`, mm."""
    points = {
        position: [dimension_point(placed) for placed in teeth if placed.position == position]
        for position in {*aim.widths_mm, *([] if aim.length_mm is None else [7])}
    }
    widths = [float(np.linalg.norm(points[position][1] - points[position][0])) for position in aim.widths_mm]
    if aim.length_mm is None:
        return np.array(widths)
    return np.array([*widths, np.linalg.norm(np.mean(points[7], axis=0) - papilla_of(teeth))])


def can_stand(options: PhantomOptions) -> bool:
    """Whether a row of textbook teeth can have the asked dimensions: quick, before contacts are looked at."""
    rows = _rows(options, dict.fromkeys((-1, 1), QUADRANTS[options.arch]))
    aim, size = _aim(options, rows), options.tooth_size or 1.0
    chains = _chains(_resize_teeth(rows, size), {side: np.zeros(len(row)) for side, row in rows.items()}, options.arch)
    shape = solve_shape(chains, size, aim, Seen(), Shape(size=size))
    missed = np.abs(dimensions(chains, size, shape, aim, Seen()) - aim.values).max()
    return bool(missed < TOLERANCE_MM and shape.kinks_deg.max() < MOST_KINK_DEG - KINK_MARGIN_DEG)


def _check(teeth: tuple[PlacedTooth, ...], shape: Shape, aim: Aim, papilla_of: PapillaOf) -> None:
    """Raise an error if the teeth miss the aim."""
    got, asked = arch_dimensions(teeth, aim, papilla_of), aim.values
    names = [*(OPTION_OF[position] for position in aim.widths_mm), "arch_length_mm"][: len(got)]
    worst = int(np.abs(got - asked).argmax())
    if abs(got[worst] - asked[worst]) > TOLERANCE_MM:
        nearest = ", ".join(f"{name} {value:.1f}" for name, value in zip(names, got, strict=True))
        raise InputError(
            f"{names[worst]}: {asked[worst]:g} is incompatible with the other dimensions and teeth of size "
            f"{shape.size:.2f}; the nearest arch has {nearest}"
        )
    if shape.kinks_deg.max() > MOST_KINK_DEG:
        raise InputError(
            f"{', '.join(names)}: {', '.join(f'{value:g}' for value in asked)} would bend the row by "
            f"{shape.kinks_deg.max():.0f} degrees at tooth {int(shape.kinks_deg.argmax()) + 1} from the midline; ask "
            "for dimensions closer to the mean, or for another tooth_size"
        )


# Contacts


def _closing_shifts_mm(
    teeth: tuple[PlacedTooth, ...], closing: dict[int, Float[np.ndarray, "_"]]
) -> dict[int, Float[np.ndarray, "_"]]:
    """How far each tooth is to be drawn towards its mesial neighbour so that they touch, mm."""
    excess = np.array([clearance(one, other) for one, other in pairwise(teeth)]) + CONTACT_OVERLAP_MM
    middle = len(closing[-1]) - 1
    excess[middle] /= 2  # either central incisor moves half of the way to the midline
    return {-1: closing[-1] + excess[middle::-1], 1: closing[1] + excess[middle:]}


def clearance(one: PlacedTooth, other: PlacedTooth) -> float:
    """Width of the gap between two neighbours at its narrowest, mm; negative where they overlap."""
    front, back = sorted((one, other), key=lambda placed: placed.position)
    crown = back.tooth.crown
    across = front.to_jaw(_contact_centre(front.tooth.crown)) - back.to_jaw(_contact_centre(crown))
    towards = across * [1.0, 1.0, 0.0] / np.hypot(*across[:2])
    aside = np.array([-towards[1], towards[0], 0.0])
    along = crown.width_mm / (crown.width_mm + front.tooth.crown.width_mm) * np.hypot(*across[:2])
    reach, depth = 0.25 * crown.half_width_mm, 0.8 * crown.half_depth_mm
    middle = back.to_jaw(_contact_centre(crown)) + along * towards + across[2] / 2 * np.array([0.0, 0.0, 1.0])
    box = np.stack([reach * towards, depth * aside, [0.0, 0.0, 0.33 * crown.height_mm]])
    for _ in range(2):
        points = middle + CUBE @ box
        one_side, other_side = (crown_distance(p.tooth.crown, p.to_tooth(points)) for p in (front, back))
        outside = np.maximum(one_side, other_side)
        middle, box = points[outside.argmin()], 0.3 * box
    return 2 * float(outside.min())


# A crowded front


def _crowd_front(rows: Rows, lingual_mm: float, options: PhantomOptions) -> Rows:
    """The front teeth displaced and rotated by the pattern `CROWDED`, unevenly, for lateral incisors that stand
    lingually by the given mm."""
    uneven = 1.0 + 0.3 * options.variation * np.random.default_rng([options.seed, 1]).uniform(-1.0, 1.0, (2, 3))
    crowded: Rows = {}
    for side in (-1, 1):
        crowded[side] = tuple(
            (position, _rotate_tooth(tooth, *(lingual_mm * uneven[(side + 1) // 2, position - 1] * CROWDED[position])))
            if position in CROWDED
            else (position, tooth)
            for position, tooth in rows[side]
        )
    return crowded


def _closed_gaps_mm(closing: dict[int, Float[np.ndarray, "_"]], loose: dict[int, Float[np.ndarray, "_"]]) -> float:
    """By how much the five contacts of the front have closed up, mm."""
    return float(sum((closing[side] - loose[side])[:3].sum() for side in (-1, 1)))


def _next_displacement_mm(lingual_mm: float, got_mm: float, asked_mm: float) -> float:
    """The next displacement: the shortening goes about with its square."""
    if not lingual_mm:
        return float(np.sqrt(asked_mm))
    return float(np.clip(lingual_mm * np.clip(asked_mm / max(got_mm, 1e-3), 0.5, 2.0) ** 0.5, 0.0, MOST_CROWDED_MM))


# One tooth


def vary_teeth(options: PhantomOptions, rng: np.random.Generator) -> dict[int, tuple[Tooth, ...]]:
    """The varied teeth of both quadrants, by the sign of X; counterparts are alike but not the same."""
    teeth = QUADRANTS[options.arch]
    common = rng.standard_normal((len(teeth), 8))
    deviates = {side: 0.8 * common + 0.6 * rng.standard_normal(common.shape) for side in (-1, 1)}
    return {
        side: tuple(_vary(tooth, options.variation * row) for tooth, row in zip(teeth, rows, strict=True))
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


def fdi_of(arch: Arch, side: int, position: int) -> int:
    """FDI number of the tooth at `position` (1 = central incisor) on the side of the sign of X."""
    quadrant = {("lower", 1): 40, ("lower", -1): 30, ("upper", 1): 20, ("upper", -1): 10}[arch, side]
    return quadrant + position


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
