"""How much room there is between the jaws: the sagittal model of a mouth, and populations of mouths.

Frame: the sagittal plane, in mm. The hinge axis through the condyles of the closed mouth is the origin; x points
forwards, along the occlusal plane, and *down* is counted positive. The occlusal plane lies at depth h below the axis,
the incisal edges at (x_I, h) with r = hypot(x_I, h): alpha = arcsin(h / r) is the Balkwill angle in this plane. A tooth
that lies f behind the incisal edges is at x = x_I - f.

Opening turns the lower jaw by theta about the condyles and lets these slide by T down a path with the slope beta. A
point of the lower occlusal plane at x then stands off its counterpart in the upper jaw by

    V  =  x sin(theta) - h (1 - cos(theta)) + T sin(beta)         downwards
    dx = -x (1 - cos(theta)) - h sin(theta) + T cos(beta)         forwards
    L  = hypot(V, dx)

With x = x_I, L is the opening at the incisors, from which theta follows; without translation L = 2 d sin(theta / 2),
with d the distance from the axis. In closed form: L(x_I)^2 - T^2 = A (1 - cos(theta)) + B sin(theta), where
A = 2 (r^2 - T (h sin(beta) + x_I cos(beta))) and B = 2 T (x_I sin(beta) - h cos(beta)).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float

from cuspid.anatomy.teeth.dentition import ARCH_FORMS, QUADRANTS
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SEED, Options, Range
from cuspid.runtime.workers import computed_once

Sizes = float | Float[np.ndarray, "*n"]
"""A value for one person, or one for each of many."""
Sex = Literal["men", "women"]
Study = Literal["india-2012", "china-2017", "rieder-1978"]
TEETH = 7
"""Teeth of a quadrant, from the midline backwards."""
PRINTED_GAP_MM = (12.0, 26.6)
"""L as the thesis prints it (Eq. 2.4)."""
_CURVE_STEP_MM = 0.25
"""Spacing of the fit curve."""
_ARC_POINTS = 60
"""Points of the trajectory of a tooth in the sagittal view."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Mouth:
    """The sagittal geometry of one person, or of many: arrays of one shape."""

    interincisal_mm: Sizes
    """Mouth opening as it is measured, between the incisal edges."""
    radius_mm: Sizes = 90.0
    """r: from the hinge axis to the incisal edges."""
    depth_mm: Sizes = 34.3
    """h: from the hinge axis down to the occlusal plane."""
    overlap_mm: Sizes = 0.0
    """Vertical overlap of the closed incisors (overbite), by which the lower ones move farther than is measured."""
    path_mm: Sizes = 12.0
    """T: how far the condyles slide."""
    slope_deg: Sizes = 32.0
    """beta: slope of their path against the occlusal plane."""

    def __post_init__(self) -> None:
        for name in ("interincisal_mm", "radius_mm", "depth_mm"):
            _check(np.asarray(getattr(self, name)) > 0, getattr(self, name), f"{name} is {{:g}}; it must be positive")
        _check(np.asarray(self.path_mm) >= 0, self.path_mm, "path_mm is {:g}; it must not be negative")
        deeper = "depth_mm is {:g}; it must be less than the distance to the incisors (radius_mm)"
        _check(np.asarray(self.depth_mm) < self.radius_mm, self.depth_mm, deeper)
        _check(
            np.isfinite(self.turn_rad),
            self.opening_mm,
            "no rotation opens the incisors by {:g} mm; it is less than the condyles slide, or more than the length of "
            "the jaw",
        )

    @property
    def opening_mm(self) -> Sizes:
        """Way of the lower incisal edges: the corrected interincisal distance."""
        return self.interincisal_mm + self.overlap_mm

    @property
    def incisor_mm(self) -> Sizes:
        """x_I: how far the incisal edges lie before the hinge axis."""
        return np.sqrt(np.square(self.radius_mm) - np.square(self.depth_mm))

    @property
    def balkwill_deg(self) -> Sizes:
        """alpha: angle between the occlusal plane and the line from the hinge axis to the incisal edges."""
        return np.rad2deg(np.arcsin(np.divide(self.depth_mm, self.radius_mm)))

    @computed_once
    def turn_rad(self) -> Sizes:
        """theta: how far the lower jaw turns."""
        return opening_turn_rad(self.opening_mm, self.radius_mm, self.depth_mm, self.path_mm, self.slope_deg)

    @property
    def _slide(self) -> tuple[Sizes, Sizes]:
        """The slide of the condyles, forwards and downwards."""
        slope = np.deg2rad(self.slope_deg)
        return self.path_mm * np.cos(slope), self.path_mm * np.sin(slope)

    def displacement_mm(self, behind_mm: Sizes, share: Sizes = 1.0) -> tuple[Sizes, Sizes]:
        """How far a point of the lower occlusal plane moves: forwards (dx) and downwards (V), mm.

        ``behind_mm``: its distance behind the incisal edges (f). ``share``: part of the turn and slide that is done.
        """
        x, turn = self.incisor_mm - behind_mm, share * self.turn_rad
        slide_x, slide_down = self._slide
        down = x * np.sin(turn) - self.depth_mm * (1 - np.cos(turn)) + share * slide_down
        forwards = -x * (1 - np.cos(turn)) - self.depth_mm * np.sin(turn) + share * slide_x
        return forwards, down

    def places_mm(self, behind_mm: Float[np.ndarray, "k"], share: float = 1.0) -> Float[np.ndarray, "k 2"]:
        """Where points of one person's lower occlusal plane are: x forwards and z upwards of the hinge axis."""
        forwards, down = self.displacement_mm(behind_mm, share)
        return np.column_stack([self.incisor_mm - behind_mm + forwards, -self.depth_mm - down])

    def condyle_mm(self, share: float = 1.0) -> Float[np.ndarray, "2"]:
        """Where one person's condyle is: x forwards and z upwards of its place in the closed mouth."""
        slide_x, slide_down = self._slide
        return share * np.array([float(slide_x), -float(slide_down)])

    def gap_mm(self, behind_mm: Sizes) -> Sizes:
        """L: straight distance between upper and lower occlusal plane at a place behind the incisal edges."""
        return np.hypot(*self.displacement_mm(behind_mm))

    def vertical_gap_mm(self, behind_mm: Sizes) -> Sizes:
        """V: how far the point of the lower occlusal plane lies below the upper one."""
        return self.displacement_mm(behind_mm)[1]


def opening_turn_rad(opening_mm: Sizes, radius_mm: Sizes, depth_mm: Sizes, path_mm: Sizes, slope_deg: Sizes) -> Sizes:
    """theta by which the jaw turns for the incisors to move by ``opening_mm``; NaN where no angle does that.

    The fields of `Mouth` describe the arguments.
    """
    with np.errstate(invalid="ignore"):
        incisor_mm = np.sqrt(np.square(radius_mm) - np.square(depth_mm))
        slope = np.deg2rad(slope_deg)
        slide_x, slide_down = path_mm * np.cos(slope), path_mm * np.sin(slope)
        a = 2 * (np.square(radius_mm) - slide_down * depth_mm - slide_x * incisor_mm)
        b = 2 * (slide_down * incisor_mm - slide_x * depth_mm)
        k = np.square(opening_mm) - np.square(path_mm)
        turn = np.arccos((a - k) / np.hypot(a, b)) - np.arctan2(b, a)
    return np.where(turn >= 0, turn, np.nan)


def _check(good: Bool[np.ndarray, "*n"] | bool | np.bool_, values: Sizes, message: str) -> None:
    """Raise InputError with the first value that is not good."""
    if not np.all(good):
        bad = np.broadcast_to(values, np.shape(good))[~np.asarray(good)]
        raise InputError(f"mouth: {message.format(float(bad.flat[0]))}")


def tooth_ends_mm(molar_depth_mm: Sizes) -> Float[np.ndarray, "*n 7"]:
    """How far behind the incisal edges the distal ends of teeth 1 to 7 lie, measured along the occlusal plane.

    ``molar_depth_mm``: the same for the middle of the first molar. The proportions are those of the lower quadrant of
    the built-in phantom (Wheeler's widths along its mean arch form).
    """
    widths = np.array([tooth.crown.width_mm for tooth in QUADRANTS["lower"]])
    ends = np.cumsum(widths * np.sin(np.deg2rad(ARCH_FORMS["lower"].headings_deg)))
    return np.asarray(molar_depth_mm)[..., None] * ends / ((ends[4] + ends[5]) / 2)


# --- people -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Normal:
    """A normal distribution and where it comes from."""

    mean: float
    """Mean, in mm or deg."""
    sd: float
    """Standard deviation, in mm or deg."""
    source: str
    """Author, journal, year; what was assumed."""


_INDIA = "Normal mouth opening in an adult Indian population, 2012 (PMC3428458): 463 men, 431 women of 21-70 years"
_CHINA = "Li, Jia and Zhang, J. Dent. Sci. 12, 2017: 238 men, 214 women of 20-35 years"
_RIEDER = "Rieder 1978 as the thesis reports it: {}; a normal distribution about the middle of that interval is assumed"
OPENINGS: Mapping[Study, Mapping[Sex, Normal]] = MappingProxyType(
    {
        "india-2012": {
            "men": Normal(mean=51.3, sd=8.3, source=_INDIA),
            "women": Normal(mean=44.3, sd=6.7, source=_INDIA),
        },
        "china-2017": {
            "men": Normal(mean=54.18, sd=5.21, source=_CHINA),
            "women": Normal(mean=49.62, sd=3.69, source=_CHINA),
        },
        "rieder-1978": {
            "men": Normal(mean=50.0, sd=7.29, source=_RIEDER.format("83 % of men open 40-60 mm")),
            "women": Normal(mean=45.0, sd=6.60, source=_RIEDER.format("87 % of women open 35-55 mm")),
        },
    }
)
"""Maximal mouth opening (interincisal), mm."""

_MAGGETTI = "Maggetti, Bindl and Mehl, Int. J. Comput. Dent. 18, 2015: {}, 120 people; SD estimated as range / 5.14"
RAMUS = Normal(
    mean=49.23,
    sd=7.22,
    source="ramus height (condyle to gonion) of 910 patients, as the thesis reports it; it reaches farther down than "
    "the occlusal plane",
)
"""The thesis' stand-in for the depth of the occlusal plane."""


@dataclass(frozen=True, kw_only=True)
class Anatomy:
    """Distributions of what men and women are given in common; the values are drawn independently of each other."""

    arm_mm: Normal = Normal(mean=103.3, sd=5.4, source=_MAGGETTI.format("Bonwill arm 103.3 mm (90.2-117.9)"))
    """Condyle to incisal point in space: the long side of Bonwill's triangle."""
    base_mm: Normal = Normal(mean=99.6, sd=5.3, source=_MAGGETTI.format("Bonwill base 99.6 mm (85.2-112.6)"))
    """Condyle to condyle; r is the height of the triangle over it."""
    depth_mm: Normal = Normal(mean=34.3, sd=5.1, source=_MAGGETTI.format("condyles 34.3 mm (21.0-47.2) above it"))
    """Hinge axis to occlusal plane."""
    path_mm: Normal = Normal(
        mean=12.8,
        sd=2.8,
        source="Eur. J. Orthod. 24, 2002, 327-336: 21 women; taken for men too, though theirs is longer (Mapelli et "
        "al., Clin. Anat. 2009). Travers et al., Arch. Oral Biol. 2000, have 11.9 mm for 27 women. None of the three "
        "found a correlation with the opening",
    )
    """Slide of the condyles."""
    slope_deg: Normal = Normal(
        mean=31.8,
        sd=7.8,
        source="mean of 103 people: Johnson and Winstanley, J. Oral Rehabil. 1997; SD: J. Prosthodont. 2013, 561-565; "
        "taken against the occlusal plane and for the whole path, though measured in protrusion against another plane",
    )
    """Slope of the path of the condyles."""
    molar_depth_mm: Normal = Normal(
        mean=28.10,
        sd=2.59,
        source="Mina et al., Odontology 105, 2017: first molar behind the incisal edges in 54 lower arches (about 14 "
        "years old)",
    )
    """Middle of the first molar behind the incisal edges, lower arch."""
    overlap_mm: Normal = Normal(
        mean=2.9,
        sd=2.2,
        source="Brunelle et al., J. Dent. Res. 75, 1996: mean 2.9 mm, 8 % with 6 mm or more (SD from that)",
    )
    """Vertical overlap of the incisors."""


@dataclass(frozen=True, kw_only=True)
class MouthOptions(Options):
    """The handpiece, and the people whom it should fit."""

    thickness_mm: Annotated[float, Range(0, 1000)] = 7.0
    """Thickness of the handpiece between the jaws."""
    working_distance_mm: Annotated[float, Range(0, 1000)] = 5.0
    """Distance from its cameras to the teeth."""
    clearance_mm: Annotated[float, Range(0, 1000)] = 0.0
    """Spare room."""
    study: Study = "india-2012"
    """Source of the mouth openings: a survey of 894 adults, one of 452 young adults, or the thesis (Rieder's
    intervals)."""
    held: Annotated[float, Range(0.01, 1)] = 1.0
    """Share of the maximal opening that is held during a scan; the condyles slide in proportion."""
    overlap: bool = True
    """Add the vertical overlap of the incisors to the opening; without it the room is underestimated."""
    ramus: bool = False
    """Use the ramus height as the depth of the occlusal plane, as the thesis does."""
    vertical: bool = False
    """Judge by the vertical distance between the occlusal planes, V, instead of the straight distance between the
    teeth, L."""
    correlation: Annotated[float, Range(-1, 1)] = 0.0
    """Correlation between opening and condyle-incisor distance; it is not known, so the default assumes none."""
    people: Annotated[int, Range(1, 10_000_000)] = 20_000
    """Number of men, and of women, that are drawn."""
    seed: Annotated[int, SEED] = 0
    """Seed of the random draw."""

    @property
    def total_mm(self) -> float:
        """Room that the handpiece needs."""
        return self.thickness_mm + self.working_distance_mm + self.clearance_mm


@dataclass(frozen=True, eq=False, kw_only=True)
class People:
    """A drawn population."""

    mouth: Mouth
    """Arrays (n,)."""
    ends_mm: Float[np.ndarray, "n 7"]
    """Distal ends of teeth 1 to 7 behind the incisal edges."""
    left_out: int
    """Draws that no mouth can have, for example an opening smaller than the slide of the condyles."""

    @computed_once
    def gap_mm(self) -> Float[np.ndarray, "n 7"]:
        """L at the distal end of each tooth."""
        return np.stack([np.asarray(self.mouth.gap_mm(ends)) for ends in self.ends_mm.T], axis=1)

    @computed_once
    def vertical_gap_mm(self) -> Float[np.ndarray, "n 7"]:
        """V at the distal end of each tooth."""
        return np.stack([np.asarray(self.mouth.vertical_gap_mm(ends)) for ends in self.ends_mm.T], axis=1)


def draw_people(
    opening: Normal, options: MouthOptions, rng: np.random.Generator, anatomy: Anatomy = Anatomy()
) -> People:
    """People drawn from an opening distribution and the common anatomy; impossible draws are left out and counted."""
    deviates = rng.standard_normal((8, options.people))
    deviates[1] = options.correlation * deviates[0] + np.sqrt(1 - options.correlation**2) * deviates[1]
    kinds = (
        opening,
        anatomy.arm_mm,
        anatomy.base_mm,
        RAMUS if options.ramus else anatomy.depth_mm,
        anatomy.path_mm,
        anatomy.slope_deg,
        anatomy.overlap_mm,
        anatomy.molar_depth_mm,
    )
    drawn = (kind.mean + kind.sd * row for kind, row in zip(kinds, deviates, strict=True))
    interincisal, arm, base, depth, path, slope, overlap, molar = drawn
    interincisal, path = options.held * interincisal, options.held * path
    radius = np.sqrt(np.maximum(arm**2 - (base / 2) ** 2, 0))
    overlap = overlap if options.overlap else np.zeros_like(overlap)
    good = np.isfinite(opening_turn_rad(interincisal + overlap, radius, depth, path, slope))
    good &= (np.minimum.reduce([interincisal, depth, molar]) > 0) & (path >= 0)
    if not good.any():
        raise InputError("mouth: none of the sampled people is possible; the distributions do not fit together")
    mouth = Mouth(
        interincisal_mm=interincisal[good],
        radius_mm=radius[good],
        depth_mm=depth[good],
        overlap_mm=overlap[good],
        path_mm=path[good],
        slope_deg=slope[good],
    )
    return People(mouth=mouth, ends_mm=tooth_ends_mm(molar[good]), left_out=int(np.sum(~good)))


def typical_mouth(opening: Normal, options: MouthOptions, anatomy: Anatomy = Anatomy()) -> tuple[Mouth, np.ndarray]:
    """The mouth with the mean of every distribution, and how far behind its incisal edges teeth 1 to 7 end (7,), mm."""
    mouth = Mouth(
        interincisal_mm=options.held * opening.mean,
        radius_mm=float(np.sqrt(anatomy.arm_mm.mean**2 - (anatomy.base_mm.mean / 2) ** 2)),
        depth_mm=(RAMUS if options.ramus else anatomy.depth_mm).mean,
        overlap_mm=anatomy.overlap_mm.mean if options.overlap else 0.0,
        path_mm=options.held * anatomy.path_mm.mean,
        slope_deg=anatomy.slope_deg.mean,
    )
    return mouth, tooth_ends_mm(anatomy.molar_depth_mm.mean)


def fit_pct(room_mm: Float[np.ndarray, "n 7"], needed_mm: Float[np.ndarray, "t"]) -> Float[np.ndarray, "t 7"]:
    """Share of people who have at least the needed room at each tooth."""
    ordered = np.sort(room_mm, axis=0)
    short = np.stack([np.searchsorted(column, needed_mm, side="left") for column in ordered.T], axis=1)
    return np.asarray(100 * (1 - short / len(room_mm)))


# --- the study ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class GroupFit:
    """Room between the jaws of men or women."""

    people: int
    """How many were drawn."""
    left_out: int
    """Draws that no mouth can have."""
    opening_mm: Mapping[str, float]
    """Percentiles of the interincisal opening that is held."""
    turn_deg: Mapping[str, float]
    """Percentiles of theta."""
    gap_mm: Mapping[int, Mapping[str, float]]
    """Percentiles of L at the distal end of teeth 1 (central incisor) to 7 (second molar)."""
    vertical_gap_mm: Mapping[int, Mapping[str, float]]
    """Percentiles of V, likewise."""
    fit_pct: Mapping[int, float]
    """Share whom the handpiece fits, likewise."""


@dataclass(frozen=True, kw_only=True)
class ThesisLine:
    """A number of the thesis beside ours."""

    what: str
    """Equation and quantity."""
    printed: str
    """As the thesis has it."""
    recomputed: str
    """From the same input, and what this model says."""
    reason: str
    """Why they differ."""


@dataclass(frozen=True, kw_only=True)
class MouthReport:
    """Whom a handpiece fits."""

    needed_mm: float
    """Thickness, working distance and clearance."""
    groups: Mapping[Sex, GroupFit]
    """Men and women."""
    sources: Mapping[str, str]
    """Where each distribution comes from."""
    assumptions: tuple[str, ...]
    """What was assumed."""
    thesis: tuple[ThesisLine, ...]
    """The thesis' own numbers."""


def study_mouths(options: MouthOptions = MouthOptions()) -> tuple[MouthReport, dict[Sex, People]]:
    """Draw men and women and find the share whom the handpiece fits at each tooth; the people, for pictures."""
    openings = OPENINGS[options.study]
    rngs = np.random.default_rng(options.seed).spawn(len(openings))
    people = {sex: draw_people(openings[sex], options, rng) for sex, rng in zip(openings, rngs, strict=True)}
    report = MouthReport(
        needed_mm=options.total_mm,
        groups={sex: _group(group, options) for sex, group in people.items()},
        sources=_sources(options),
        assumptions=_assumptions(options),
        thesis=thesis_lines(),
    )
    return report, people


def room_mm(people: People, options: MouthOptions) -> Float[np.ndarray, "n 7"]:
    """The gap that the options judge by, at the distal end of each tooth."""
    return people.vertical_gap_mm if options.vertical else people.gap_mm


def fit_curve(
    people: Mapping[Sex, People], options: MouthOptions
) -> tuple[Float[np.ndarray, "t"], dict[Sex, Float[np.ndarray, "t 7"]]]:
    """Needed room, from nothing up (mm), and for each group the share of people who have it at each tooth (%)."""
    rooms = {sex: room_mm(group, options) for sex, group in people.items()}
    most = max(float(np.percentile(room[:, 0], 90)) for room in rooms.values())
    needed = np.arange(0.0, max(most, options.total_mm) + _CURVE_STEP_MM, _CURVE_STEP_MM)
    return needed, {sex: fit_pct(room, needed) for sex, room in rooms.items()}


@dataclass(frozen=True, eq=False, kw_only=True)
class SagittalView:
    """One mouth closed and open; places are x forwards and z upwards of the hinge axis, mm."""

    closed_mm: Float[np.ndarray, "8 2"]
    """Incisal edges and distal ends of teeth 1 to 7, in the closed mouth."""
    opened_mm: Float[np.ndarray, "8 2"]
    """The same of the lower jaw in the open mouth."""
    condyle_mm: Float[np.ndarray, "2"]
    """The condyle in the open mouth."""
    arcs_mm: tuple[Float[np.ndarray, "a 2"], Float[np.ndarray, "a 2"]]
    """Trajectories of the lower incisal edges and of the second molar's end, the condyles sliding as the jaw turns."""


def sagittal_view(opening: Normal, options: MouthOptions) -> SagittalView:
    """The typical mouth of a group, for a picture."""
    mouth, ends = typical_mouth(opening, options)
    behind = np.concatenate([[0.0], ends])
    arcs = np.stack([mouth.places_mm(behind[[0, -1]], share) for share in np.linspace(0, 1, _ARC_POINTS)])
    return SagittalView(
        closed_mm=mouth.places_mm(behind, 0.0),
        opened_mm=mouth.places_mm(behind),
        condyle_mm=mouth.condyle_mm(),
        arcs_mm=(arcs[:, 0], arcs[:, 1]),
    )


def _group(people: People, options: MouthOptions) -> GroupFit:
    shares = fit_pct(room_mm(people, options), np.array([options.total_mm]))[0]
    return GroupFit(
        people=len(people.ends_mm),
        left_out=people.left_out,
        opening_mm=_percentiles(np.asarray(people.mouth.interincisal_mm)),
        turn_deg=_percentiles(np.rad2deg(people.mouth.turn_rad)),
        gap_mm={k + 1: _percentiles(people.gap_mm[:, k]) for k in range(TEETH)},
        vertical_gap_mm={k + 1: _percentiles(people.vertical_gap_mm[:, k]) for k in range(TEETH)},
        fit_pct={k + 1: float(shares[k]) for k in range(TEETH)},
    )


def _percentiles(values: Float[np.ndarray, "n"]) -> dict[str, float]:
    levels = (1, 5, 25, 50, 75, 95, 99)
    return {f"p{level}": float(value) for level, value in zip(levels, np.percentile(values, levels), strict=True)}


def _sources(options: MouthOptions) -> dict[str, str]:
    """Each distribution as it was used."""
    used: dict[str, Normal] = {f"opening of {sex}, mm": each for sex, each in OPENINGS[options.study].items()}
    used |= {each.name.replace("_", " "): getattr(Anatomy(), each.name) for each in fields(Anatomy)}
    if options.ramus:
        used["depth mm"] = RAMUS
    return {name: f"{each.mean:g} +- {each.sd:g}: {each.source}" for name, each in used.items()}


def _assumptions(options: MouthOptions) -> tuple[str, ...]:
    judged = "vertical distance V of the occlusal planes" if options.vertical else "straight distance L"
    return (
        f"a handpiece fits at a tooth if thickness, working distance and clearance are at most the {judged} at the "
        "tooth's distal end; the gap grows forwards, so that is the narrowest place along a handpiece that comes in "
        "from the front",
        f"the mouth is open to {options.held:.0%} of its maximum; nobody keeps it fully open for long",
        "healthy adults; teeth count as points of the occlusal planes; cheeks, tongue, lips and the curve of Spee are "
        "left out",
        "all values are normal and independent of each other"
        + (f", but for opening and condyle-incisor distance ({options.correlation:+g})" if options.correlation else ""),
        "the corrected opening moves the incisors: interincisal distance plus vertical overlap"
        if options.overlap
        else "the interincisal distance moves the incisors; their vertical overlap is left out",
    )


# --- the thesis ---------------------------------------------------------------------------------------------------

_ARCH_LENGTHS_MM = MappingProxyType({"Lower-14": 51.23, "Upper-14": 55.37, "Lower-12": 45.40, "Upper-12": 46.00})
"""Column f of the thesis' Table 2.1."""
_RAMUS_MM, _TURN_RAD = 49.23, 0.45
_OPENINGS_MM = (35.0, 60.0)
_RADII_MM = (77.7, 134.0)
"""r as the thesis prints it."""


def thesis_lines() -> tuple[ThesisLine, ...]:
    """The thesis' Eq. 2.1 to 2.4 beside what its own inputs give, and what this model gives for a mean person."""
    angles = tuple(float(np.arcsin(_RAMUS_MM / radius)) for radius in _RADII_MM)
    narrow, wide = (Mouth(interincisal_mm=opening) for opening in _OPENINGS_MM)
    return (
        _radius_line(narrow, wide),
        _angle_line(angles, narrow),
        _depth_line(angles),
        _gap_line(angles, narrow, wide),
    )


def _radius_line(narrow: Mouth, wide: Mouth) -> ThesisLine:
    near, far = (opening / _TURN_RAD for opening in _OPENINGS_MM)
    return ThesisLine(
        what="Eq. 2.1: r = C / theta, mm",
        printed="77.7-134",
        recomputed=f"{near:.1f}-{far:.1f}; the model turns by {np.rad2deg(narrow.turn_rad):.1f} and "
        f"{np.rad2deg(wide.turn_rad):.1f} deg for 35 and 60 mm, with one r",
        reason="the smallest and the largest opening are divided by the mean angle, though who opens wider turns "
        "farther; r then varies for want of theta. Here theta follows from the opening",
    )


def _angle_line(angles: tuple[float, ...], narrow: Mouth) -> ThesisLine:
    return ThesisLine(
        what="Eq. 2.2: alpha, deg",
        printed="21-39",
        recomputed=f"{np.rad2deg(angles[1]):.1f}-{np.rad2deg(angles[0]):.1f}; the model has "
        f"{float(np.asarray(narrow.balkwill_deg)):.1f}",
        reason="printed as a sine, meant as its inverse. The ramus height goes from condyle to gonion, below the "
        "occlusal plane, and makes alpha too large; here the measured height of the condyles above that plane",
    )


def _depth_line(angles: tuple[float, ...]) -> ThesisLine:
    length = _ARCH_LENGTHS_MM["Lower-14"]
    printed = _projection_mm(angles, length)
    exact = [
        float(np.sqrt(radius**2 + length**2 - 2 * radius * length * np.cos(angle)))
        for radius, angle in zip(_RADII_MM, angles, strict=True)
    ]
    return ThesisLine(
        what="Eq. 2.3: d = r - f cos(alpha), mm (Lower-14)",
        printed="no number",
        recomputed=f"{printed[0]:.1f}-{printed[1]:.1f}; by the law of cosines {exact[0]:.1f}-{exact[1]:.1f}",
        reason="a projection; the distance from condyle to second molar is d^2 = r^2 + f^2 - 2 r f cos(alpha). The "
        "column f of Table 2.1 agrees with column b to 0.06 mm in every row and looks like a copy of it",
    )


def _gap_line(angles: tuple[float, ...], narrow: Mouth, wide: Mouth) -> ThesisLine:
    every = [_TURN_RAD * depth for length in _ARCH_LENGTHS_MM.values() for depth in _projection_mm(angles, length)]
    lower = [_TURN_RAD * depth for depth in _projection_mm(angles, _ARCH_LENGTHS_MM["Lower-14"])]
    behind = float(tooth_ends_mm(Anatomy().molar_depth_mm.mean)[-1])
    model = [float(np.asarray(mouth.gap_mm(behind))) for mouth in (narrow, wide)]
    return ThesisLine(
        what="Eq. 2.4: L, mm",
        printed="12-26.6",
        recomputed=f"{min(every):.1f}-{max(every):.1f} over the rows of Table 2.1 (Lower-14: {lower[0]:.1f}-"
        f"{lower[1]:.1f}); the model, at the distal end of the second molar, {model[0]:.1f}-{model[1]:.1f} for "
        "openings of 35-60 mm",
        reason="the printed range does not follow from the printed inputs: r - f = 26.55 for the smallest r, and "
        "0.45 times that is 11.95, so the two numbers look like d and L of one case without cos(alpha). As a "
        "conservative gap for a handpiece 12 mm is sound, but not for that reason",
    )


def _projection_mm(angles: tuple[float, ...], length_mm: float) -> list[float]:
    """d of Eq. 2.3 as printed, for each r."""
    return [radius - length_mm * float(np.cos(angle)) for radius, angle in zip(_RADII_MM, angles, strict=True)]
