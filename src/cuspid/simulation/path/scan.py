"""The path of a scan: over the arch of a jaw or one tooth, following the curve of Spee, held by a human hand.

Frames: the world is the jaw's occlusal frame. Rig frame as in :mod:`cuspid.handpiece.designs`: the origin rides on the
arch curve, +X along it, +Y towards the cheek, +Z out of the gum. Seen from above (+Z), the path runs clockwise.

A path is built in layers, each a function of the travel: a steady hand on its passes
(:mod:`~cuspid.simulation.path.legs`), changed where the body of the handpiece does not fit
(:mod:`~cuspid.simulation.path.detour`), the drift of the hand (:mod:`~cuspid.simulation.path.hand`), and a lift where
it would touch. Frames are then taken so that they overlap roughly evenly.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.arch_curve import ArchCurve, arch_curve
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.model.room import Room, room_about
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import TOOTH, Options, Range
from cuspid.simulation.path.coverage import CrownPoints, crown_points
from cuspid.simulation.path.cross import plan_crossing
from cuspid.simulation.path.detour import Detour, PoseAt, lift_path, plan_detour, repair_path
from cuspid.simulation.path.further import further_legs, points_seen_from
from cuspid.simulation.path.hand import HandMotion, hand_motion
from cuspid.simulation.path.legs import Leg, SteadyPath, steady_path, there_and_back
from cuspid.simulation.path.overlap import frame_overlap, image_overlap

TOOTH_FRAMES, ARCH_FRAMES = 10, 100
"""Positions of the handpiece in the thesis: 120 images of a tooth and 1200 of an arch with twelve cameras."""

TOOTH_PATH_MM = 9.0
"""Length of the path over a tooth: ten positions 1 mm apart, which overlap by some 80 %."""

_ARCH_MM = 80.0
"""A longer path is one over a whole arch."""
_GROWTH = 1.15
"""Maximum factor by which the number of frames is raised at once, where there are turns."""
_LEAD_MM = 2.0
"""How far a handpiece travels along the arch before it leaves it for the other side."""
_MOST = 2
"""Maximum number of frames for the sake of overlap, as a multiple of the usual number."""
_COARSE = 12
"""Rays along each side of an image that measure how fast it changes."""
_LOW_SHARE = 0.9
"""Teeth of which less than this share can be seen get a note."""

_LOG = logging.getLogger("cuspid")


@dataclass(frozen=True, kw_only=True)
class ScanPathOptions(Options):
    """How the jaw is scanned."""

    tooth: Annotated[int | None, TOOTH] = None
    """FDI number of the one tooth to scan; default: the whole arch, or as much of one as the mesh has."""
    frames: Annotated[int | None, Range(2, 100_000)] = None
    """Positions of the handpiece; default: 10 over a tooth, 100 over an arch and one per millimetre over a part of an
    arch, or more if the overlap requires it."""
    length_mm: Annotated[float | None, Range(0.1, 1000)] = None
    """Length of the path over the middle of the tooth or arch; default: 9 mm over a tooth (the images see 3 mm more on
    both sides), and from the first crown to the last over an arch."""
    jitter_mm: Annotated[float, Range(0, 20)] = 0.15
    """Standard deviation of the hand's drift along each axis."""
    jitter_deg: Annotated[float, Range(0, 90)] = 1.5
    """Standard deviation of the hand's rotation about each axis."""
    jitter_length_mm: Annotated[float, Range(0.01, 10_000)] = 6.0
    """Length of path over which the hand's drift changes."""
    min_overlap: Annotated[float, Range(0, 0.99)] = 0.75
    """Minimum share (0 to 1) of the surface in the images of a frame that the next frame must also see, with the same
    cameras."""
    clearance_mm: Annotated[float, Range(0, 100)] = 0.5
    """Minimum distance of the body of the handpiece from the jaw; where it does not fit, it is lifted, shifted and
    tilted."""
    turns: Annotated[int, Range(1, 99)] = 1
    """Passes over the teeth, an odd number: with 1 the handpiece only looks down; with 3 it looks from the cheek, down
    and from the tongue; with more, also in finer steps between."""
    turn_deg: Annotated[float, Range(0.1, 89)] = 60.0
    """How far the handpiece is rolled to either side in the first and last pass."""
    passes: Literal["turns", "auto"] | None = None
    """turns: the passes given by --turns. auto: also further ones, with other rolls, over what two cameras did not see;
    a note says how many frames they take. Default: auto for a whole arch if neither the turns, the frames nor the
    length are given, otherwise turns."""
    cross_sweep: bool = False
    """After the passes of a whole arch, sweep from one side straight to the other, as over the palate, as far back as
    there is surface between them: this ties the two ends together, and so the width of the arch. A note says if there
    is none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.turns % 2 == 0:
            raise InputError(f"scan path: the number of turns must be odd (1, 3, 5 ...), not {self.turns}")

    @property
    def rolls_deg(self) -> tuple[float, ...]:
        """Roll of each pass, in order."""
        if self.turns == 1:
            return (0.0,)
        return tuple(map(float, np.linspace(self.turn_deg, -self.turn_deg, self.turns)))


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanPath:
    """Poses of the handpiece and the resulting overlap."""

    rig_from_world: Mapping[str, Rigid3]
    """Pose by frame name, in order."""
    overlap: Float[np.ndarray, "n c"]
    """For each frame but the last, and each camera: share of the surface in its image that the next image also sees;
    NaN where the image shows no surface."""
    travel_mm: Float[np.ndarray, "f"]
    """Travel at each frame."""
    steady: SteadyPath = field(repr=False)
    """The trajectory of a steady hand."""
    further_frames: int = 0
    """About how many of the frames further passes take."""
    seen: Mapping[int, float] = field(default_factory=dict)
    """Approximate share (0 to 1) of the open surface of each crown along the path that two cameras see at once, by FDI
    number; under 0, that of all crowns together."""

    @property
    def curve(self) -> ArchCurve:
        """The curve that the path follows."""
        return self.steady.curve

    @property
    def cross_sweep(self) -> tuple[str, ...]:
        """Names of the frames of the sweep from one side to the other."""
        if self.steady.crossing is None:
            return ()
        return tuple(np.array(list(self.rig_from_world))[self.travel_mm > self.steady.legs_end_mm].tolist())

    @property
    def min_overlap(self) -> float:
        """Overlap of the frame that overlaps least with the next one, as the mean over its cameras."""
        return float(frame_overlap(self.overlap).min())

    @property
    def mean_overlap(self) -> float:
        """Mean overlap over all frames."""
        return float(frame_overlap(self.overlap).mean())


def plan_scan_path(jaw: Jaw, handpiece: Handpiece, options: ScanPathOptions, rng: np.random.Generator) -> ScanPath:
    """A path over the arch or one tooth on which the handpiece fits and consecutive images overlap enough.

    What a user should know about it is logged. Raises InputError where the jaw has no such tooth, nothing can
    be seen from where the handpiece fits, or the given number of frames is too small for the overlap.
    """
    curve, room = arch_curve(jaw), room_about(jaw.mesh, handpiece, options.clearance_mm)
    crowns = crown_points(jaw, curve, handpiece.depth_range_mm[1])
    steady = first = steady_path(jaw.mesh, curve, _legs(jaw, curve, options))
    if _needs_further_passes(options, curve):
        steady = further_legs(jaw.mesh, room, crowns, handpiece, first)
    if options.cross_sweep:
        steady = _cross(jaw.mesh, room, handpiece, steady, options)
    detour = plan_detour(room, crowns, handpiece, steady.rig_from_world, steady.span_mm)
    hand = hand_motion(
        steady.span_mm,
        rng,
        jitter_mm=options.jitter_mm,
        jitter_deg=options.jitter_deg,
        jitter_length_mm=options.jitter_length_mm,
    )
    pose_at = lift_path(room, _apply_drift(steady, detour, hand), steady.span_mm)
    path = _sample_frames(room, handpiece, first, steady, pose_at, options)
    if not np.isfinite(path.overlap).any():
        raise InputError(
            f"scan path: with the handpiece {options.clearance_mm:g} mm from the jaw, no camera sees it in focus; "
            "use a narrower handpiece, a larger depth of field or a smaller --clearance-mm"
        )
    seen, further = _seen_faces(crowns, handpiece, path, options.tooth), _further_frames(first, path)
    path = replace(path, seen=seen, further_frames=further)
    notes = (_gap_notes(steady), _detour_notes(jaw, steady, detour), _further_pass_notes(steady, first, path))
    across = _crossing_notes(jaw, path) if options.cross_sweep else ()
    for note in chain(*notes, across, _blind_notes(path), _unseen_notes(path)):
        _LOG.info(note)
    return path


def _seen_faces(crowns: CrownPoints, handpiece: Handpiece, path: ScanPath, tooth: int | None) -> dict[int, float]:
    """As :attr:`ScanPath.seen`."""
    found = np.asarray(points_seen_from(crowns, handpiece, list(path.rig_from_world.values())).any(axis=0))
    if tooth is not None:
        return {tooth: float(found[crowns.teeth == tooth].mean())}
    teeth = np.unique(crowns.teeth[crowns.teeth != GUM])
    return {GUM: float(found.mean()), **{int(each): float(found[crowns.teeth == each].mean()) for each in teeth}}


def steady_poses(jaw: Jaw, options: ScanPathOptions, per_pass: int) -> tuple[Rigid3, ...]:
    """``rig_from_world`` at this many positions on each pass, evenly spaced, without the drift of a hand or the
    turns."""
    curve = arch_curve(jaw)
    steady = steady_path(jaw.mesh, curve, _legs(jaw, curve, options))
    ends = steady.travel_mm.reshape(-1, 2)
    return tuple(steady.rig_from_world(float(at)) for first, last in ends for at in np.linspace(first, last, per_pass))


def _legs(jaw: Jaw, curve: ArchCurve, options: ScanPathOptions) -> tuple[Leg, ...]:
    return there_and_back(options.rolls_deg, *_stretch(jaw, curve, options))


def _needs_further_passes(options: ScanPathOptions, curve: ArchCurve) -> bool:
    """Whether further passes go over what the first ones did not see."""
    if options.passes is not None:
        return options.passes == "auto"
    said = (options.tooth, options.frames, options.length_mm)
    return float(curve.lengths_mm[-1]) > _ARCH_MM and options.turns == 1 and all(each is None for each in said)


def _cross(mesh: Mesh, room: Room, handpiece: Handpiece, steady: SteadyPath, options: ScanPathOptions) -> SteadyPath:
    """With a sweep to the other side from that on which the passes end; as it was where there is none.

    Raises InputError for a single tooth and for a part of an arch, which have no other side.
    """
    if options.tooth is not None or float(steady.curve.lengths_mm[-1]) <= _ARCH_MM:
        raise InputError(
            "scan path: a sweep across goes from one side of a whole arch to the other, but this is a tooth or part "
            "of an arch; leave out --cross-sweep"
        )
    ends_at = steady.legs[-1].end_mm
    crossing = plan_crossing(mesh, room, handpiece, steady.curve, ends_at)
    if crossing is None:
        return steady
    before = crossing.start_mm + np.sign(ends_at - crossing.start_mm) * _LEAD_MM
    lead = Leg(roll_deg=0.0, start_mm=float(before), end_mm=crossing.start_mm)
    led = steady_path(mesh, steady.curve, (*steady.legs, lead))
    return replace(led, crossing=crossing.preceded_by(led.rig_from_world(led.legs_end_mm)))


def _stretch(jaw: Jaw, curve: ArchCurve, options: ScanPathOptions) -> tuple[float, float]:
    """Start and end of the path, in mm along the curve."""
    if options.tooth is None:
        first, last = 0.0, float(curve.lengths_mm[-1])
        length = max(last, TOOTH_PATH_MM)
    else:
        first, last = curve.span_of(jaw.mesh.face_centres[jaw.tooth_faces(options.tooth)])
        length = TOOTH_PATH_MM
    middle, half = (first + last) / 2, (options.length_mm or length) / 2
    return middle - half, middle + half


def _apply_drift(steady: SteadyPath, detour: Detour, hand: HandMotion) -> PoseAt:
    """The trajectory of a hand that drifts."""
    if not detour.changes.any():
        return lambda at: hand.jittered_from_rig(at) @ steady.rig_from_world(at)
    return lambda at: hand.jittered_from_rig(at) @ detour.changed_from_rig(at) @ steady.rig_from_world(at)


# --- frames -----------------------------------------------------------------------------------------------------------


def _sample_frames(
    room: Room,
    handpiece: Handpiece,
    first: SteadyPath,
    steady: SteadyPath,
    pose_at: PoseAt,
    options: ScanPathOptions,
) -> ScanPath:
    """As many frames as asked for, or as many as the overlap needs; ``first`` is the path without further passes."""
    usual = options.frames or _default_frames(steady, first, options)
    frames = usual
    while True:
        path = _even_path(room, handpiece, steady, pose_at, frames)
        if path.min_overlap >= options.min_overlap:
            return path
        needed = _needed_frames(frames, path, options)
        shortfall = (
            f"with {frames} frames, consecutive images overlap by only {path.min_overlap:.0%}, less than "
            f"{options.min_overlap:.0%}"
        )
        if options.frames:
            raise InputError(f"scan path: {shortfall}; raise --frames to about {needed} or shorten the path")
        if needed > _MOST * usual:
            _LOG.info(f"scan path: {shortfall} in places; the scan may break there")
            return path
        frames = needed


def _default_frames(steady: SteadyPath, first: SteadyPath, options: ScanPathOptions) -> int:
    """Of the thesis for a tooth and a whole arch, one per millimetre for parts; for further passes in proportion."""
    length = first.legs[0].length_mm
    per_pass = TOOTH_FRAMES if options.tooth is not None else ARCH_FRAMES if length > _ARCH_MM else 1 + round(length)
    return round(per_pass * len(first.legs) * np.ptp(steady.span_mm) / np.ptp(first.span_mm))


def _needed_frames(frames: int, path: ScanPath, options: ScanPathOptions) -> int:
    """Frames that are about enough: the surface that an image loses is in proportion to the step."""
    growth = (1 - path.min_overlap) / (1 - options.min_overlap)
    if len(path.steady.legs) > 1:
        # A single image on a turn is no reason for as many more everywhere.
        growth = min(growth, _GROWTH)
    return max(frames + 1, int(np.ceil(1 + (frames - 1) * growth)))


def _even_path(room: Room, handpiece: Handpiece, steady: SteadyPath, pose_at: PoseAt, frames: int) -> ScanPath:
    """The path on which the hand goes slower where the images change faster, so that the overlap is about even. All its
    frames fit."""
    mesh = room.mesh
    travel = np.linspace(*steady.span_mm, frames)
    for _ in range(2):
        lost = 1 - frame_overlap(image_overlap(mesh, handpiece, [pose_at(float(at)) for at in travel], _COARSE))
        change = np.concatenate([[0], np.cumsum(np.maximum(lost, 0.25 * lost.max()))])
        travel = np.interp(np.linspace(0, change[-1], frames), change, travel)
    poses = repair_path(room, [pose_at(float(at)) for at in travel])
    return ScanPath(
        rig_from_world={f"{index:05d}": pose for index, pose in enumerate(poses)},
        overlap=image_overlap(mesh, handpiece, poses),
        travel_mm=travel,
        steady=steady,
    )


# --- what a user should know ------------------------------------------------------------------------------------------


def _gap_notes(steady: SteadyPath) -> tuple[str, ...]:
    """How the handpiece follows the gum where teeth are missing."""
    if not steady.sinks_mm.any():
        return ()
    return (f"scan path: where teeth are missing, the handpiece sinks by up to {steady.sinks_mm.max():.1f} mm",)


def _blind_notes(path: ScanPath) -> tuple[str, ...]:
    """Frames of which next to nothing can be measured."""
    seeing = np.isfinite(path.overlap).sum(axis=1)
    blind = np.array(list(path.rig_from_world))[np.flatnonzero(seeing < 2)]
    if len(blind) == 0:
        return ()
    return (
        f"scan path: in {len(blind)} frames ({', '.join(blind[:5])}{', ...' if len(blind) > 5 else ''}) fewer than two "
        "cameras see the jaw in focus; the scan may break there",
    )


def _detour_notes(jaw: Jaw, steady: SteadyPath, detour: Detour) -> tuple[str, ...]:
    """Where the handpiece leaves the trajectory of a steady hand."""
    changed = np.any(detour.changes != 0, axis=1) & (detour.travel_mm <= steady.legs_end_mm)
    if not changed.any():
        return ()
    _, shift, lift, *turns = detour.largest
    places = np.array([steady.curve.place(steady.place(float(at))[0]) for at in detour.travel_mm[changed]])
    return (
        f"scan path: the handpiece does not fit everywhere{_describe_teeth_near(jaw, places)}; there it is lifted by "
        f"up to {lift:.1f} mm, shifted by {shift:.1f} mm and tilted by {np.rad2deg(max(turns)):.0f} deg",
    )


def _describe_teeth_near(jaw: Jaw, places: Float[np.ndarray, "n 3"]) -> str:
    if not jaw.teeth:
        return ""
    centres = np.array([jaw.mesh.centroid(jaw.tooth_faces(tooth))[:2] for tooth in jaw.teeth])
    nearest = np.argmin(np.linalg.norm(places[:, None, :2] - centres[None], axis=2), axis=1)
    return " (near " + ", ".join(str(jaw.teeth[index]) for index in np.unique(nearest)) + ")"


def _further_frames(first: SteadyPath, path: ScanPath) -> int:
    """By the length of the passes; ``first`` is the path without further ones."""
    passes_mm = path.steady.legs_end_mm - path.steady.span_mm[0]
    return round((len(path.rig_from_world) - len(path.cross_sweep)) * (1 - float(np.ptp(first.span_mm)) / passes_mm))


def _further_pass_notes(steady: SteadyPath, first: SteadyPath, path: ScanPath) -> tuple[str, ...]:
    """What further passes cost."""
    rolls = {leg.roll_deg for leg in first.legs}
    further = [leg for leg in steady.legs if leg.roll_deg not in rolls]
    if not further:
        return ()
    what = ", ".join(f"{leg.roll_deg:+.0f} deg over {leg.length_mm:.0f} mm" for leg in further)
    return (
        f"scan path: further passes, rolled towards the cheek by {what}, take about {path.further_frames} of "
        f"{len(path.rig_from_world)} frames",
    )


def _crossing_notes(jaw: Jaw, path: ScanPath) -> tuple[str, ...]:
    """Where the sweep to the other side goes, or that there is none."""
    crossing, swept = path.steady.crossing, path.cross_sweep
    if crossing is None:
        return (
            "scan path: no sweep across; nowhere between the sides of this arch does the handpiece fit with two "
            "cameras seeing surface in focus all the way",
        )
    ends = np.array([path.curve.place(at) for at in (crossing.start_mm, crossing.end_mm)])
    return (
        f"scan path: the sweep across{_describe_teeth_near(jaw, ends)} takes frames {swept[0]} to {swept[-1]}, "
        f"{len(swept)} of {len(path.rig_from_world)}; it covers {np.linalg.norm(ends[1] - ends[0]):.0f} mm from one "
        "side to the other",
    )


def _unseen_notes(path: ScanPath) -> tuple[str, ...]:
    """Teeth of which two cameras see little."""
    low = [f"{tooth} {100 * share:.0f} %" for tooth, share in path.seen.items() if share < _LOW_SHARE and tooth != GUM]
    if not low:
        return ()
    return (f"scan path: two cameras see little of the open surface of some crowns: {', '.join(low)}",)
