"""Search the family of handpieces for the one that serves a brief best: precision and coverage under its conditions.

A *section* is the neighbourhood of a tooth in the frame of its mesh (+Z out of the gum) with the positions that the
handpiece takes there. A face counts as seen if, at one position at least, both cameras of a stereo pair see it
(:func:`cuspid.model.pairing.stereo_pairs`: the pairs that depth is measured from). Its *bound* is the Cramer-Rao bound
at the best position and for the best camera r, matched with its partners p:

    I = J_r^T J_r / sigma^2 + sum_p J_p^T J_p / sigma_rp^2

where sigma_rp is the noise of the pair (:mod:`cuspid.handpiece.precision`). It is asked at some of the faces,
always the same ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize
from scipy.stats import qmc

from cuspid.geometry import Rigid3
from cuspid.handpiece.brief import DesignBrief
from cuspid.handpiece.cad.holder import with_holder
from cuspid.handpiece.family import BOUNDS, LAYOUTS, Layout, Shape, build_handpiece
from cuspid.handpiece.optics import Optics
from cuspid.handpiece.precision import NoiseModel, bound_rms_um, noise_px, projection_jacobian
from cuspid.model.mesh import Mesh
from cuspid.model.pairing import PairingOptions, stereo_pairs
from cuspid.model.rig import Handpiece, MountedCamera
from cuspid.model.room import FAR_MM, Room
from cuspid.model.visibility import VisibilityOptions, visible_faces
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SEED, Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.values import quote

_REACH_MM = 11.0
"""Of the mesh around the middle of a tooth, so much is kept on all sides."""
_VIOLATED = 30.0
"""Cost of a condition that is missed by its whole size: more than any wish is worth."""
_UNSEEN = 0.1
"""Share of the wanted surfaces that costs 1 when it is not seen."""
_BOUND_UM = 20.0
"""Mean bound that costs 1."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions(Options):
    """How long and how finely the search runs."""

    noise: NoiseModel = field(default_factory=lambda: NoiseModel(sigma_px=0.5, convergence_deg=25.0))
    """Noise of matched points. That matching loses half of its precision at 25 deg is an assumption."""
    visibility: VisibilityOptions = field(default_factory=VisibilityOptions)
    """When a camera sees a face."""
    pairing: PairingOptions = field(default_factory=PairingOptions)
    """Which cameras form the stereo pairs that depth is measured from."""
    points: Annotated[int, Range(1, 100_000)] = 80
    """Faces of each section at which the bound is evaluated."""
    samples: Annotated[int, Range(0, 64)] = 4
    """Random shapes tried for each layout, besides the thesis' own."""
    finalists: Annotated[int, Range(1, 1000)] = 3
    """Layouts whose shape is then refined."""
    evaluations: Annotated[int, Range(1, 1_000_000)] = 80
    """Designs tried while refining one shape."""
    seed: Annotated[int, SEED] = 0
    """Seed of the random shapes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Section:
    """A tooth, what is around it, and how the handpiece passes."""

    mesh: Mesh
    """The surface near the tooth, +Z out of the gum."""
    surfaces: Mapping[str, Bool[np.ndarray, "f"]]
    """Masks over its faces: the named surfaces of the tooth."""
    rig_from_world: tuple[Rigid3, ...]
    """Positions of the handpiece."""

    @staticmethod
    def cut(
        mesh: Mesh,
        tooth: Bool[np.ndarray, "f"],
        surfaces: Mapping[str, Bool[np.ndarray, "f"]],
        rig_from_world: Sequence[Rigid3],
    ) -> Section:
        """Cut from a whole jaw: what lies near the tooth; of the named surfaces, its own faces."""
        centres = mesh.face_centres[tooth]
        middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
        near = np.linalg.norm((mesh.face_centres - middle)[:, :2], axis=1) < _REACH_MM
        kept = {name: (mask & tooth)[near] for name, mask in surfaces.items() if (mask & tooth).any()}
        return Section(mesh=mesh.submesh(near), surfaces=kept, rig_from_world=tuple(rig_from_world))


@dataclass(frozen=True, kw_only=True)
class Condition:
    """What the brief demands and what a design gives."""

    name: str
    """With the unit."""
    wanted: float
    """Limit."""
    reached: float
    """Value of the design."""
    at_least: bool
    """Whether the limit is a lower one."""

    @property
    def is_met(self) -> bool:
        """Up to rounding."""
        return self.shortfall <= 1e-6

    @property
    def shortfall(self) -> float:
        """Shortfall as a share of the limit; 0 if the condition is met."""
        missing = self.wanted - self.reached if self.at_least else self.reached - self.wanted
        return max(0.0, missing) / max(abs(self.wanted), 1e-6)

    def __str__(self) -> str:
        return f"{self.name}: {self.reached:.3g}, required {'>=' if self.at_least else '<='} {self.wanted:.3g}"


@dataclass(frozen=True, kw_only=True)
class Assessment:
    """What a design reaches."""

    cameras: int
    """How many it has."""
    seen: Mapping[str, float]
    """Share (0 to 1) of each surface that is seen, over all sections."""
    bound_um: Mapping[str, float]
    """Mean bound over the seen part of each surface; NaN where nothing is seen."""
    unseen: float
    """Share of the wanted surfaces that is not seen, the mean over them."""
    mean_bound_um: float
    """Mean bound over the wanted surfaces."""
    conditions: tuple[Condition, ...]
    """All of the brief's."""
    cost: float
    """What the search makes small."""

    @property
    def unmet(self) -> tuple[Condition, ...]:
        """The conditions that are missed."""
        return tuple(condition for condition in self.conditions if not condition.is_met)


@dataclass(frozen=True, eq=False, kw_only=True)
class Trial:
    """The best shape that was found for a layout."""

    layout: Layout
    shape: Shape
    assessment: Assessment
    refined: bool = False
    """Whether the layout was among the finalists."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Design:
    """What the search found."""

    handpiece: Handpiece
    """The best."""
    best: Trial
    """Its layout, shape and assessment."""
    trials: tuple[Trial, ...] = field(repr=False)
    """The best of each layout, cheapest first."""
    evaluations: int
    """How many designs were assessed."""
    gap_mm: float
    """Room between the jaws at the tooth that the brief names."""
    sections: tuple[Section, ...] = field(repr=False)
    """The teeth that it was designed for."""

    def check(self, brief: DesignBrief) -> None:
        """Raise InputError that names the conditions which no handpiece that was found fulfils."""
        unmet = self.best.assessment.unmet
        if unmet:
            raise InputError(
                f"brief: no handpiece with at most {brief.cameras.max} cameras was found that meets it; the best "
                f"one fails on {'; '.join(map(str, unmet))}"
            )


# --- the search -------------------------------------------------------------------------------------------------------


def optimise_handpiece(
    brief: DesignBrief,
    sections: Sequence[Section],
    gap_mm: float,
    options: SearchOptions = SearchOptions(),
    *,
    progress: Progress = silent,
) -> Design:
    """The cheapest handpiece of the family by precision, coverage and cameras, conditions first.

    Every layout with few enough cameras is tried with the thesis' lengths and with drawn ones (Latin hypercube); the
    best are refined (Nelder and Mead, Computer Journal 7, 1965). The same input and seed give the same design. The best
    is returned even where it does not meet all conditions: see `Assessment.unmet` and `Design.check`.
    Raises InputError where the gap is too small for any, or no section has a wanted surface.
    """
    brief.check_gap(gap_mm)
    _check_surfaces(brief, sections)
    search = _Search(brief, sections, gap_mm, options)
    layouts = [layout for layout in LAYOUTS if layout.cameras <= brief.cameras.max]
    trials = []
    for done, layout in enumerate(layouts, start=1):
        trials.append(search.explore(layout))
        progress("layouts", done, len(layouts))
    trials.sort(key=_cost)
    for index in range(min(options.finalists, len(trials))):
        trials[index] = search.refine(trials[index])
        progress("refined", index + 1, min(options.finalists, len(trials)))
    trials.sort(key=_cost)
    best = trials[0]
    return Design(
        handpiece=search.build(best.layout, best.shape),
        best=best,
        trials=tuple(trials),
        evaluations=search.evaluations,
        gap_mm=gap_mm,
        sections=tuple(sections),
    )


def _cost(trial: Trial) -> float:
    return trial.assessment.cost


def _check_surfaces(brief: DesignBrief, sections: Sequence[Section]) -> None:
    there = {name for section in sections for name in section.surfaces}
    for name in brief.surfaces:
        if name not in there:
            raise InputError(
                f"brief: the surface {quote(name)} must be seen, but the teeth given have only "
                f"{', '.join(sorted(there)) or 'none'}"
            )


class _Search:
    """Assesses designs and counts them."""

    def __init__(self, brief: DesignBrief, sections: Sequence[Section], gap_mm: float, options: SearchOptions) -> None:
        self.brief, self.sections, self.gap_mm, self.options = brief, sections, gap_mm, options
        self.evaluations = 0

    def build(self, layout: Layout, shape: Shape) -> Handpiece:
        bare = build_handpiece(layout, shape, self.brief.sensor, self.brief.depth_range_mm, self.brief.name)
        return with_holder(bare, self.brief.holder)

    def assess(self, layout: Layout, shape: Shape) -> Trial:
        self.evaluations += 1
        handpiece = self.build(layout, shape)
        assessment = assess_handpiece(handpiece, self.brief, self.sections, self.gap_mm, self.options)
        return Trial(layout=layout, shape=shape, assessment=assessment)

    def explore(self, layout: Layout) -> Trial:
        """The best of the thesis' shape and of drawn ones."""
        bounds = self.bounds(layout)
        draws = qmc.LatinHypercube(len(bounds), rng=np.random.default_rng(self.options.seed)).random(
            self.options.samples
        )
        shapes = [self.shape(layout, low_high) for low_high in bounds[:, 0] + draws * np.ptp(bounds, axis=1)]
        return min((self.assess(layout, shape) for shape in [self.start(), *shapes]), key=_cost)

    def refine(self, trial: Trial) -> Trial:
        """The cheapest of all shapes that a simplex walks over."""
        bounds = self.bounds(trial.layout)
        span = np.maximum(np.ptp(bounds, axis=1), 1e-9)
        best = [trial]

        def cost(unit: Float[np.ndarray, "p"]) -> float:
            tried = self.assess(trial.layout, self.shape(trial.layout, bounds[:, 0] + unit * span))
            best[0] = min(best[0], tried, key=_cost)
            return _cost(tried)

        start = (np.array([getattr(trial.shape, name) for name in trial.layout.parameters]) - bounds[:, 0]) / span
        # A simplex reaches inwards from the start, by a fifth of the range.
        steps = np.diag(np.where(start > 0.5, -0.2, 0.2))
        minimize(
            cost,
            start,
            method="Nelder-Mead",
            bounds=[(0.0, 1.0)] * len(start),
            options={
                "maxfev": self.options.evaluations,
                "initial_simplex": np.concatenate([start[None], start + steps]),
                "xatol": 1e-3,
                "fatol": 1e-4,
            },
        )
        return replace(best[0], refined=True)

    def bounds(self, layout: Layout) -> Float[np.ndarray, "p 2"]:
        """Of the layout's parameters."""
        return np.array(
            [self.brief.working_distance_mm if p == "distance_mm" else BOUNDS[p] for p in layout.parameters]
        )

    def start(self) -> Shape:
        """The thesis', at the allowed distance next to it."""
        return Shape(distance_mm=float(np.clip(Shape.distance_mm, *self.brief.working_distance_mm)))

    def shape(self, layout: Layout, values: Float[np.ndarray, "p"]) -> Shape:
        return replace(self.start(), **dict(zip(layout.parameters, map(float, values), strict=True)))


# --- one design -------------------------------------------------------------------------------------------------------


def assess_handpiece(
    handpiece: Handpiece,
    brief: DesignBrief,
    sections: Sequence[Section],
    gap_mm: float,
    options: SearchOptions = SearchOptions(),
) -> Assessment:
    """What a handpiece, of the family or not, reaches of a brief."""
    seen_mm2, area_mm2 = dict.fromkeys(_names(sections), 0.0), dict.fromkeys(_names(sections), 0.0)
    bounds: dict[str, list[float]] = {name: [] for name in area_mm2}
    for section in sections:
        seen, places, bound_um = _survey(handpiece, section, options, brief.sensor)
        for name, mask in section.surfaces.items():
            area_mm2[name] += float(section.mesh.face_areas[mask].sum())
            seen_mm2[name] += float(section.mesh.face_areas[mask & seen].sum())
            bounds[name] += bound_um[mask[places] & np.isfinite(bound_um)].tolist()
    shares = {name: seen_mm2[name] / area_mm2[name] for name in area_mm2}
    bound_by_name = {name: float(np.mean(values)) if values else float("nan") for name, values in bounds.items()}
    unseen = float(np.mean([1 - shares[name] for name in brief.surfaces]))
    bounds_um = [value for name in brief.surfaces for value in bounds[name]]
    mean_bound = float(np.mean(bounds_um)) if bounds_um else 1000.0
    conditions = tuple(
        [
            Condition(name=f"share of {name}", wanted=w, reached=shares[name], at_least=True)
            for name, w in brief.surfaces.items()
        ]
        + _room(handpiece, brief, sections, gap_mm)
    )
    weights, count = brief.weights, len(handpiece.rig.names)
    cost = (
        weights.coverage * unseen / _UNSEEN
        + weights.precision * mean_bound / _BOUND_UM
        + weights.cameras * count / 12
        + _VIOLATED * sum(condition.shortfall for condition in conditions)
    )
    return Assessment(
        cameras=count,
        seen=shares,
        bound_um=bound_by_name,
        unseen=unseen,
        mean_bound_um=mean_bound,
        conditions=conditions,
        cost=float(cost),
    )


def _names(sections: Sequence[Section]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for section in sections for name in section.surfaces))


def _room(handpiece: Handpiece, brief: DesignBrief, sections: Sequence[Section], gap_mm: float) -> list[Condition]:
    """The conditions on the size and the place of the parts."""
    rig = list(handpiece.rig.cameras.values())
    spacing = min(float(np.linalg.norm(a.centre_in_rig - b.centre_in_rig)) for a, b in combinations(rig, 2))
    heights, clearances = zip(*(_height_and_clearance(handpiece, brief, each) for each in sections), strict=True)
    at_most = {
        "height above the teeth, mm": (gap_mm, max(heights)),
        "cameras": (float(brief.cameras.max), float(len(rig))),
    }
    if brief.width_mm is not None:
        at_most["width, mm"] = (brief.width_mm, float(np.ptp(handpiece_outline(handpiece, brief.thickness_mm)[:, 0])))
    at_least = {
        "clearance, mm": (brief.mouth.clearance_mm, min(clearances)),
        "spacing of the cameras, mm": (brief.cameras.spacing_mm, spacing),
    }
    return [Condition(name=n, wanted=w, reached=r, at_least=False) for n, (w, r) in at_most.items()] + [
        Condition(name=n, wanted=w, reached=r, at_least=True) for n, (w, r) in at_least.items()
    ]


def _height_and_clearance(handpiece: Handpiece, brief: DesignBrief, section: Section) -> tuple[float, float]:
    """Height in mm of the back of holder and body above the tooth, and the least distance of the body from the mesh,
    over all positions. Distances are told up to some millimetres; they are negative where the body cuts the surface,
    and those of a part within the tooth are all alike."""
    backs = [m.centre_in_rig - brief.thickness_mm * m.axis_in_rig for m in handpiece.rig.cameras.values()]
    corners = np.concatenate([backs, *(box.corners for box in handpiece.solid.parts.values())])
    tooth = np.any(list(section.surfaces.values()), axis=0)
    top = section.mesh.face_centres[tooth, 2].max()
    height = max(float(pose.inverse().apply(corners)[:, 2].max()) for pose in section.rig_from_world) - top
    required_mm = brief.mouth.clearance_mm
    room = Room(section.mesh, handpiece.solid, required_mm)
    nearest = min(room.clearance(pose)[0] for pose in section.rig_from_world)
    return float(height), float(np.clip(nearest, -_REACH_MM, required_mm + FAR_MM))


def _survey(
    handpiece: Handpiece, section: Section, options: SearchOptions, optics: Optics
) -> tuple[Bool[np.ndarray, "f"], Int[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """Whether each face is seen; some faces, and the bound there (NaN where unseen)."""
    rig, mesh = handpiece.rig, section.mesh
    paired = _pair_cameras(handpiece, options.pairing)
    faces = np.flatnonzero(np.any(list(section.surfaces.values()), axis=0))
    places = faces[np.linspace(0, len(faces) - 1, min(options.points, len(faces))).astype(int)]
    found, best = np.zeros(len(mesh.faces), dtype=bool), np.full(len(places), np.inf)
    for pose in section.rig_from_world:
        sees = np.zeros((len(rig.names), len(mesh.faces)), dtype=bool)
        for row, mounted in enumerate(rig.cameras.values()):
            cam_from_world = mounted.cam_from_rig @ pose
            visible = visible_faces(mesh, mounted.camera, cam_from_world, handpiece.depth_range_mm, options.visibility)
            sees[row, visible] = True
        for first, second in np.argwhere(np.triu(paired)):
            found |= sees[first] & sees[second]
        points, normals = pose.apply(mesh.face_centres[places]), pose.rotate(mesh.face_normals[places])
        bounds = _bounds_um(
            tuple(rig.cameras.values()), points, normals, sees[:, places], paired, options.noise, optics
        )
        best = np.fmin(best, bounds)
    return found, places, np.where(np.isfinite(best), best, np.nan)


def _pair_cameras(handpiece: Handpiece, pairing: PairingOptions) -> Bool[np.ndarray, "c c"]:
    names = handpiece.rig.names
    paired = np.zeros((len(names), len(names)), dtype=bool)
    for first, second in stereo_pairs(handpiece.rig, handpiece.working_distance_mm, pairing):
        i, j = names.index(first), names.index(second)
        paired[i, j] = paired[j, i] = True
    return paired


def _bounds_um(
    cameras: tuple[MountedCamera, ...],
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    sees: Bool[np.ndarray, "c n"],
    paired: Bool[np.ndarray, "c c"],
    noise: NoiseModel,
    optics: Optics,
) -> Float[np.ndarray, "n"]:
    """For each point: the bound of the best camera matched with its partners; NaN where no pair sees it."""
    best = np.full(len(points), np.nan)
    asked = np.flatnonzero((sees.T @ paired * sees.T).any(axis=1))
    if len(asked) == 0:
        return best
    points, normals, sees = points[asked], normals[asked], sees[:, asked]
    squares = []
    for each in cameras:
        jacobian = np.nan_to_num(projection_jacobian(each.camera, each.cam_from_rig, points))
        squares.append(np.einsum("nki,nkj->nij", jacobian, jacobian))
    information = np.array(squares) * (sees / noise.sigma_px**2)[..., None, None]
    for first, second in np.argwhere(np.triu(paired)):
        both = sees[[first, second]].all(axis=0)
        pair, twice = [cameras[first], cameras[second]], np.stack([both, both])
        sigma = noise_px(pair, points, noise, twice, optics=optics, normals=normals)
        for reference, partner, deviation in ((first, second, sigma[1]), (second, first, sigma[0])):
            information[reference] += squares[partner] * (both / deviation**2)[:, None, None]
    for own in information:
        best[asked] = np.fmin(best[asked], bound_rms_um(own))
    return best


def handpiece_outline(handpiece: Handpiece, thickness_mm: float, margin_mm: float = 1.0) -> Float[np.ndarray, "n 2"]:
    """The holder's cross-section as a polygon (y, z in the rig frame, mm): a shell behind the cameras."""
    rig = handpiece.rig.cameras.values()
    centres, axes = (np.array([getattr(m, name)[1:] for m in rig]) for name in ("centre_in_rig", "axis_in_rig"))
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    # Around a place below the cameras, from the tongue's side over the top to the cheek's.
    order = np.argsort(np.arctan2(centres[:, 0], centres[:, 1] + thickness_mm), kind="stable")
    inner, axes = centres[order], axes[order]
    along = np.stack([axes[:, 1], -axes[:, 0]], axis=1)
    inner = np.concatenate([inner[:1] + margin_mm * along[:1], inner, inner[-1:] - margin_mm * along[-1:]])
    axes = np.concatenate([axes[:1], axes, axes[-1:]])
    return np.concatenate([inner, (inner - thickness_mm * axes)[::-1]])
