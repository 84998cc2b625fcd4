"""Where the handpiece was, from the surfaces that it measured: for teeth without texture, which give no tracks.

The depth maps of each frame are metric, so that frames are placed by laying their surfaces onto each other: first each
onto an earlier one, by iterative closest points with point-to-plane distances (Y. Chen, G. Medioni, Image and Vision
Computing 10, 1992) and a motion model; then all at once (:mod:`cuspid.motion.icp.surface_adjustment`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, islice, product
from typing import Annotated

import numpy as np

from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, Dropped
from cuspid.model.reconstruction import DepthMap, Expectation, Reconstruction
from cuspid.model.rig import Handpiece
from cuspid.motion.bundle.held_calibration import depth_sigma_mm
from cuspid.motion.icp.surface_adjustment import lay_together, neighbours
from cuspid.motion.icp.surfaces import (
    LEAST_MATCHES,
    Correspondences,
    OrientedPoints,
    Surface,
    match_point_to_plane,
    small_motion,
    solve_damped,
    surface_of,
)
from cuspid.runtime.errors import ReconstructionError
from cuspid.runtime.options import SEED, SHARE, Options, Range
from cuspid.runtime.progress import Progress, silent

_REACHES = (0.2, 0.2, 0.14, 0.14, 0.1, 0.1, 0.06, 0.06, 0.04, 0.04, 0.03, 0.03)
"""Largest distance between the same place in two frames, step by step, as a share of the working distance."""
_FIRST_STEPS = (0.0, -0.2, 0.2, -0.4, 0.4)
"""How far the handpiece may have moved at first, along each axis across its view, as shares of the working distance."""
_LAST_STEPS = 4
"""Steps with all points, once a few have found the place."""
_FOUND_AGAIN = 0.5
"""Least overlap with a frame from long ago: smooth parts of two teeth are alike."""
_FEW = 600
"""Points of a frame by which most others are ruled out where a lost piece is looked for."""
_WITNESSES, _LEAST_WITNESSES, _AGREED = 20, 2, 0.8
"""Pairs of frames that are asked whether a piece was found in the right place, how many there must be at least, and how
many of them must agree."""
_NEAR = 0.25
"""Largest motion between frames that see about the same: working distances, and radians."""
_BRIEFLY = 3
"""Frames back that are tried first."""
_DAMPING = 1e-9
"""Share of the diagonal that is added to the normal equations of one pair."""
_LITTLE_GLARE = 0.1
"""Share of mirror reflections that does little harm."""
_LEAST_DEPTH = 1e-4
"""Errors of depth, as a share of the working distance, below which a calibration counts as exact."""
_LONG = 5.0
"""Length of a path, in working distances, from which on its drift is seen."""


@dataclass(frozen=True, kw_only=True)
class SurfaceTrackingOptions(Options):
    """How the trajectory of the handpiece is found from surfaces."""

    thinning: Annotated[float, Range(0.0001, 1)] = 0.02
    """Each frame is thinned to one point per cube of this side, as a share of the working distance (0.1 mm at 5 mm)."""
    border_px: Annotated[int, Range(0, 1000)] = 2
    """Depths within so many pixels of a depth map (in each direction) of one that is not known are not laid onto
    others: surfaces are smoothed from one side only there, and turn along with the cameras."""
    min_overlap: Annotated[float, SHARE] = 0.3
    """Share (0 to 1) of a frame's surface that must lie on an earlier one for the frame to be placed."""
    max_scatter: Annotated[float, Range(0.0001, 1)] = 0.018
    """Standard deviation of the distances between the surfaces of two frames, as a share of the working distance (0.09
    mm at 5 mm), above which they do not fit each other; less where less of the surface lies on the other one, in
    proportion."""
    min_relief: Annotated[float, SHARE] = 0.003
    """How much a surface must turn to hold another in place: least mean squared cosine between its normals and any
    direction; 0 is a plane, 1/3 a ball."""
    min_located: Annotated[float, SHARE] = 0.5
    """Minimum share (0 to 1) of the frames that must be placed."""
    joint_overlap: Annotated[float, SHARE] = 0.15
    """Frames that share at least this part of the smaller surface are adjusted to each other, if neither shares more
    with one that lies between."""
    samples: Annotated[int, Range(100, 1_000_000)] = 6000
    """Points of each frame that are laid onto others in searches and in the joint adjustment."""
    rounds: Annotated[int, Range(1, 1000)] = 20
    """Maximum number of rounds of the joint adjustment."""
    seed: Annotated[int, SEED] = 0
    """Seed of the choice of these points."""


@dataclass(frozen=True, eq=False)
class _Step:
    """A frame laid onto another one."""

    this_from_other: Rigid3
    match: Correspondences | None

    @property
    def rank(self) -> float:
        """The more overlap and the less scatter, the better."""
        return 0.0 if self.match is None else self.match.share / self.match.sigma


# --- one frame onto another --------------------------------------------------------------------------------------


def _register_icp(
    one: Surface | OrientedPoints,
    other: Surface,
    start: Rigid3,
    distance_mm: float,
    reaches: Sequence[float] = _REACHES,
) -> _Step:
    """Lay a surface onto another one, from a pose nearby."""
    pose = start
    for reach in reaches:
        match = match_point_to_plane(one, other, pose, reach, distance_mm)
        if match is None:
            return _Step(pose, None)
        pose = small_motion(-solve_damped(*match.normal_equations(), _DAMPING)) @ pose
    # A start that was made of other poses is a rotation only up to rounding, which would double from frame to frame.
    pose = Rigid3.from_rotation_vector(pose.rotation_vector, pose.translation)
    return _Step(pose, match_point_to_plane(one, other, pose, reaches[-1], distance_mm))


def _rejection_reason(step: _Step, overlap: float, options: SurfaceTrackingOptions, distance_mm: float) -> str | None:
    """Why a frame must not be placed so; None if it may be."""
    match = step.match
    if match is None or match.share < overlap:
        share = 0.0 if match is None else match.share
        return f"only {share:.0%} of its surface lies on that of an earlier frame"
    if match.sigma > match.share * options.max_scatter * distance_mm:
        return f"its surface scatters about that of earlier frames by {1000 * match.sigma:.0f} um"
    if match.relief < options.min_relief:
        return "its surface is too flat to determine its pose"
    return None


# --- the whole path ----------------------------------------------------------------------------------------------


def _starts(motion: Rigid3 | None, distance_mm: float) -> Iterator[Rigid3]:
    """Where to look for the next frame: moved on as before, or as far as a hand may move at first."""
    if motion is not None:
        yield motion
        yield Rigid3.identity()
        return
    for along in _FIRST_STEPS:
        for across in _FIRST_STEPS:
            yield Rigid3(np.eye(3), distance_mm * np.array([along, across, 0.0]))


def _track_frame(
    surfaces: Sequence[Surface],
    placed: Mapping[int, Rigid3],
    frame: int,
    motion: Rigid3 | None,
    options: SurfaceTrackingOptions,
    distance_mm: float,
) -> tuple[Rigid3 | None, str]:
    """``rig_from_world`` of a frame, from the latest few placed before; else why there is none."""
    reason = "no earlier frame shows any surface"
    for number, earlier in enumerate(list(placed)[: -_BRIEFLY - 1 : -1]):
        starts = _starts(motion, distance_mm)
        step = _register_from_starts(surfaces, earlier, frame, starts, options, distance_mm)
        doubt = _rejection_reason(step, options.min_overlap, options, distance_mm)
        if doubt is None:
            return step.this_from_other @ placed[earlier], ""
        reason = doubt if number == 0 else reason
    return None, reason


def _register_from_starts(
    surfaces: Sequence[Surface],
    earlier: int,
    frame: int,
    starts: Iterable[Rigid3],
    options: SurfaceTrackingOptions,
    distance_mm: float,
) -> _Step:
    """A frame laid onto an earlier one from the best of some starts."""
    one, other = surfaces[earlier], surfaces[frame]
    some = one.some(options.samples, np.random.default_rng([options.seed, frame]))
    tried = max((_register_icp(some, other, start, distance_mm) for start in starts), key=lambda step: step.rank)
    return _register_icp(one, other, tried.this_from_other, distance_mm, _REACHES[-_LAST_STEPS:])


def _track_frames(
    surfaces: Sequence[Surface],
    names: Sequence[str],
    options: SurfaceTrackingOptions,
    distance_mm: float,
    progress: Progress,
) -> tuple[dict[int, Rigid3], list[Dropped]]:
    """``rig_from_world`` of the frames, one after the other.

    A frame that lies neither on the end of the latest piece nor on that of the largest begins a piece of its own, for
    it is not known which of them is wrong. The largest is kept, with those that are found on it in the end.
    """
    pieces, reasons, motion = list[dict[int, Rigid3]](), dict[int, str](), None
    for frame, surface in enumerate(surfaces):
        progress("odometry", frame + 1, len(surfaces))
        if len(surface) < LEAST_MATCHES:
            reasons[frame] = f"only {len(surface)} points of its surface"
            continue
        largest, pose = sorted(pieces, key=len)[-1:], None
        for piece in pieces[-1:] + [each for each in largest if each is not pieces[-1]]:
            moved_on = motion if frame - 1 in piece else None
            pose, reason = _track_frame(surfaces, piece, frame, moved_on, options, distance_mm)
            reasons.setdefault(frame, reason)
            if pose is not None:
                break
        if pose is None:
            piece, pose = {}, Rigid3.identity()
            pieces.append(piece)
        motion = pose @ piece[frame - 1].inverse() if frame - 1 in piece else None
        piece[frame] = pose
    placed = _join_pieces(surfaces, sorted(pieces, key=len, reverse=True), options, distance_mm, progress)
    dropped = [
        Dropped(what=f"frame {name}", reason=reasons.get(frame) or "it lies only on frames that lie on no others")
        for frame, name in enumerate(names)
        if frame not in placed
    ]
    world_from_first = placed[min(placed)].inverse() if placed else Rigid3.identity()
    return {frame: placed[frame] @ world_from_first for frame in sorted(placed)}, dropped


def _join_pieces(
    surfaces: Sequence[Surface],
    pieces: Sequence[Mapping[int, Rigid3]],
    options: SurfaceTrackingOptions,
    distance_mm: float,
    progress: Progress,
) -> dict[int, Rigid3]:
    """The first piece, with all others that are found on it or on what was found."""
    placed, left = dict(pieces[0]) if pieces else {}, list(pieces[1:])
    number = 0
    while number < len(left):
        progress("lost pieces", len(pieces) - len(left) + number, len(pieces))
        found = _relocate_piece(surfaces, placed, left[number], options, distance_mm)
        if found:
            placed |= found
            del left[number]
            number = 0  # what was found may show those that were not
        else:
            number += 1
    return placed


def _relocate_piece(
    surfaces: Sequence[Surface],
    placed: Mapping[int, Rigid3],
    piece: Mapping[int, Rigid3],
    options: SurfaceTrackingOptions,
    distance_mm: float,
) -> dict[int, Rigid3]:
    """The frames of a piece among those placed, if one of them is found there and the others bear it out."""
    overlap = max(options.min_overlap, _FOUND_AGAIN)
    few = {each: surfaces[each].some(_FEW, np.random.default_rng([options.seed, each])) for each in placed}
    for frame, pose in piece.items():
        for earlier in sorted(placed, key=lambda each: abs(each - frame)):
            tried = _register_icp(few[earlier], surfaces[frame], Rigid3.identity(), distance_mm)
            if _rejection_reason(tried, options.min_overlap, options, distance_mm) is not None:
                continue
            step = _register_from_starts(surfaces, earlier, frame, [tried.this_from_other], options, distance_mm)
            if _rejection_reason(step, overlap, options, distance_mm) is not None:
                continue
            found = pose.inverse() @ step.this_from_other @ placed[earlier]
            moved = {each: its @ found for each, its in piece.items()}
            if _verify_with_neighbours(surfaces, placed, moved, overlap, options, distance_mm):
                return moved
    return {}


def _verify_with_neighbours(
    surfaces: Sequence[Surface],
    placed: Mapping[int, Rigid3],
    moved: Mapping[int, Rigid3],
    overlap: float,
    options: SurfaceTrackingOptions,
    distance_mm: float,
) -> bool:
    """Whether frames that would look at the same place, if they were there, see the same: one that lies on another by
    chance has neighbours that do not."""
    near = [
        pair for pair in product(placed, moved) if _is_near(moved[pair[1]] @ placed[pair[0]].inverse(), distance_mm)
    ]
    witnesses = near[:: max(len(near) // _WITNESSES, 1)]
    steps = (
        _register_icp(surfaces[a], surfaces[b], moved[b] @ placed[a].inverse(), distance_mm, _REACHES[-_LAST_STEPS:])
        for a, b in witnesses
    )
    agree = [_rejection_reason(step, overlap, options, distance_mm) is None for step in steps]
    return len(agree) >= _LEAST_WITNESSES and sum(agree) >= _AGREED * len(agree)


def _is_near(motion: Rigid3, distance_mm: float) -> bool:
    """Whether the handpiece sees about the same after a motion."""
    across = float(np.linalg.norm(motion.translation)) / distance_mm
    return max(across, float(np.linalg.norm(motion.rotation_vector))) < _NEAR


def adjust_poses(
    surfaces: Sequence[Surface],
    poses: Sequence[Rigid3],
    options: SurfaceTrackingOptions,
    distance_mm: float,
    progress: Progress,
) -> tuple[list[Rigid3], float, Expectation | None]:
    """The poses with which all surfaces that overlap lie on each other best, their mean scatter, mm, and what follows
    for the surface."""
    rng = np.random.default_rng(options.seed)
    some = [surface.some(options.samples, rng) for surface in surfaces]
    pairs = neighbours(surfaces, poses, options.joint_overlap, distance_mm)
    return lay_together(surfaces, some, poses, pairs, distance_mm, options.rounds, progress)


def track_surfaces(
    capture: Capture,
    depths: Iterable[DepthMap],
    options: SurfaceTrackingOptions = SurfaceTrackingOptions(),
    *,
    progress: Progress = silent,
) -> Reconstruction:
    """Metric poses of the frames of a capture, from their depth maps, which come frame by frame in the order of
    capture. The calibration is fixed.

    Raises ReconstructionError where too few frames can be placed.
    """
    distance_mm = capture.handpiece.working_distance_mm
    names, surfaces = [], []
    for name, maps in groupby(depths, key=lambda depth_map: depth_map.frame):
        names.append(name)
        surfaces.append(surface_of(maps, distance_mm, thinning=options.thinning, border_px=options.border_px))
        progress("surfaces", len(names), max(len(capture.frames), len(names)))
    placed, dropped = _track_frames(surfaces, names, options, distance_mm, progress)
    _require_enough(len(placed), len(names), dropped, capture.handpiece, options)
    kept = [surfaces[frame] for frame in placed]
    poses, scatter_mm, expectation = adjust_poses(kept, list(placed.values()), options, distance_mm, progress)
    return Reconstruction(
        rig=capture.handpiece.rig,
        expectation=expectation,
        rig_from_world={names[frame]: pose for frame, pose in zip(placed, poses, strict=True)},
        dropped=(*capture.left_out, *dropped),
        log={"surface_scatter_um": 1000 * scatter_mm},
        notes=(
            _held_calibration(capture.handpiece),
            *_drift(poses, distance_mm),
            *glare_notes(capture.handpiece),
            *_lost(names, placed),
        ),
    )


def _held_calibration(handpiece: Handpiece) -> str:
    """What the calibration, which surfaces do not refine, does to them."""
    taken = "motion: the frames were located by their surfaces, which do not refine the calibration"
    sigma_mm = depth_sigma_mm(handpiece)
    if sigma_mm < _LEAST_DEPTH * handpiece.working_distance_mm:
        return f"{taken}: it is taken as exact; an error of it is in the result, but not in the sigmas of its vertices"
    return (
        f"{taken}, and with what is known of it depths are off by about {sigma_mm:.2g} mm; this is not in the sigmas "
        "of the vertices, nor in what is expected of the scale: calibrate the handpiece (cuspid calibrate) for less"
    )


def _drift(poses: Sequence[Rigid3], distance_mm: float) -> tuple[str, ...]:
    """Whether the path is so long that small errors from frame to frame matter."""
    centres = np.array([pose.inverse().translation for pose in poses])
    extent_mm = float(np.linalg.norm(np.ptp(centres, axis=0)))
    if extent_mm < _LONG * distance_mm:
        return ()
    return (
        f"motion: over {extent_mm:.0f} mm, small errors from surface to surface add up: in simulation the ends of a "
        "whole arch come out up to 0.1 mm off, or 0.2 with poor optics or without polarisers; do not rely on "
        "distances across it",
    )


def glare_notes(handpiece: Handpiece) -> tuple[str, ...]:
    """Whether mirror reflections may deceive the cameras."""
    if handpiece.lights and all(light.glare <= _LITTLE_GLARE for light in handpiece.lights.values()):
        return ()
    return (
        "depth: according to the handpiece file (glare of each light), there are no crossed polarisers: in "
        "simulation, mirror reflections of wet teeth hide from a sixth (six coloured lights in turn) to half of the "
        "surface (white lights, and 0.03 mm of error); use polarisers or powder",
    )


def _lost(names: Sequence[str], placed: Mapping[int, Rigid3]) -> tuple[str, ...]:
    """Where tracking was lost."""
    gaps = [frame for frame in range(len(names)) if frame not in placed]
    if not gaps:
        return ()
    shown = ", ".join(names[frame] for frame in islice(gaps, 5))
    more = ", ..." if len(gaps) > 5 else ""
    return (f"motion: tracking was lost at {len(gaps)} of {len(names)} frames ({shown}{more}); scan there again",)


def _require_enough(
    placed: int, total: int, dropped: Sequence[Dropped], handpiece: Handpiece, options: SurfaceTrackingOptions
) -> None:
    """Raise ReconstructionError where too few frames are placed."""
    if placed >= options.min_located * total and (placed > 1 or total == 1):
        return
    shown = "; ".join(f"{each.what}: {each.reason}" for each in dropped[:3])
    polarisers = "cross polarisers (the handpiece file states none), " if glare_notes(handpiece) else ""
    raise ReconstructionError(
        f"motion: only {placed} of {total} frames could be placed by their surfaces ({shown}); {polarisers}take frames "
        "closer together, see that the lights are on and nothing else shines, or give the surface texture (powder)"
    )
