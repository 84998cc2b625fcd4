"""Where the handpiece goes: along the arch of a jaw, following the curve of Spee, held by a human hand.

Frames: the world is the jaw's occlusal frame. Rig frame as in :mod:`cuspid.handpiece.designs`: the origin rides on the
arch curve, +X along it, +Y towards the cheek, +Z out of the gum. Seen from above (+Z), the path runs clockwise.

A handpiece with few cameras is also rolled about the tangent of the arch (thesis 3.5.3), to scan a cross-section from
several sides. ``hold`` is the rig frame of a handpiece held upright; a roll is positive when the cameras turn to the
cheek. Each roll is a pass along the whole path, there and back in turn, from the cheek's side to the tongue's; at the
end of a pass the handpiece turns on the spot. The *travel* is the way on all passes and turns, in mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import gaussian_filter1d, maximum_filter
from scipy.spatial import KDTree

from cuspid.errors import InputError
from cuspid.geometry import Rigid3, lengths_along, read_only
from cuspid.jaw import GUM, Jaw
from cuspid.mesh import Mesh
from cuspid.rig import Handpiece

TOOTH_FRAMES, ARCH_FRAMES = 10, 100
"""Positions of the handpiece in the thesis: 120 images of a tooth and 1200 of an arch with twelve cameras."""

TOOTH_PATH_MM = 9.0
"""Length of the path over a tooth: ten positions 1 mm apart, which overlap by some 80 %."""

_GRID_MM = 0.25
"""Spacing of the height map in which the arch is found."""
_CROWN_TOP_MM = 4.0
"""A point belongs to a crown if it lies less than this below the highest point near it ..."""
_NEAR_MM = 8.0
"""... where near means within a square of this side, about a tooth."""
_ARCH_DROP_MM = 5.0
"""Crowns end less than this below the highest ones (the curve of Spee and short teeth take up to 3 mm)."""
_ROUND_MM = 3.0
"""Length of the rounded ends of the arch, where a cut across it does not show the middle of a crown."""
_SAMPLE_MM = 0.1
"""Spacing of the samples of the curve."""
_WAVELENGTH_MM = 35.0
"""Bends of the arch of this wavelength are halved: the path keeps to the arch, but not to one crooked tooth."""

_SIDE_DEG, _SIDE_MM = 60.0, (4.5, 2.5)
"""A handpiece rolled so far looks at this place: across from the middle of the crown, and down from the cusp tips."""
_TURN_RADIUS_MM = 8.0
"""A turn by an angle counts as the way on a circle of this radius: about that of the cameras around the crown."""
_GROWTH = 1.15
"""By so much at most the number of frames is raised at once, where there are turns."""
_STATION_MM = 1.0
"""Spacing of the places at which the room beside the teeth is measured."""
_PATCH_MM = 1.5
"""Half the side of the patch of rays that measures it."""
_FAR_MM = 8.0
"""Whence these rays come, from the place that the handpiece looks at; they end as far behind it."""
_LIFT_MM = 3.0
"""The nominal crown is corrected by this much at most."""


@dataclass(frozen=True, kw_only=True)
class ScanPathOptions:
    """How the jaw is scanned."""

    tooth: int | None = None
    """FDI number of the one tooth to scan; None for the whole arch."""
    frames: int | None = None
    """Positions of the handpiece; None for 10 over a tooth and 100 over an arch, or more where the overlap needs it."""
    length_mm: float | None = None
    """Length of the path over the middle of the tooth or arch; None for 9 mm over a tooth (the images see 3 mm farther
    on both sides) and from the first crown to the last over an arch."""
    jitter_mm: float = 0.15
    """Standard deviation of the hand's drift along each axis."""
    jitter_deg: float = 1.5
    """Standard deviation of the hand's turning about each axis."""
    jitter_length_mm: float = 6.0
    """Length of path over which the hand's drift changes."""
    minimum_overlap: float = 0.75
    """Share (0 to 1) of the surface in an image that the same camera's next image must see."""
    clearance_mm: float = 0.5
    """Cameras and lights keep this distance from the jaw."""
    turns: int = 1
    """Passes over the teeth, an odd number: 1 looks down only, 3 look from the cheek, down and from the tongue, more
    look in finer steps between."""
    turn_deg: float = 60.0
    """How far the handpiece is rolled to either side in the first and the last pass."""

    def __post_init__(self) -> None:
        if self.turns < 1 or self.turns % 2 == 0:
            raise InputError(f"scan path: the number of turns must be odd (1, 3, 5 ...), not {self.turns}")
        if not 0 < self.turn_deg < 90:
            raise InputError(f"scan path: --turn-deg must lie between 0 and 90, not {self.turn_deg:g}")
        if self.frames is not None and self.frames < 2:
            raise InputError(f"scan path: --frames is {self.frames}; at least 2 are needed")
        if self.length_mm is not None and not self.length_mm > 0:
            raise InputError(f"scan path: --length-mm must be positive, not {self.length_mm:g}")
        if not 0 <= self.minimum_overlap < 1:
            raise InputError(f"scan path: --minimum-overlap must lie between 0 and 1, not {self.minimum_overlap:g}")
        if min(self.jitter_mm, self.jitter_deg, self.clearance_mm) < 0 or not self.jitter_length_mm > 0:
            raise InputError(
                "scan path: --jitter-mm, --jitter-deg and --clearance-mm must not be negative, --jitter-length-mm "
                "must be positive"
            )

    @property
    def rolls_deg(self) -> tuple[float, ...]:
        """Roll of each pass, in order."""
        if self.turns == 1:
            return (0.0,)
        return tuple(map(float, np.linspace(self.turn_deg, -self.turn_deg, self.turns)))


@dataclass(frozen=True, eq=False, kw_only=True)
class ArchCurve:
    """A line through the middle of the crowns at the height of their cusp tips, finely sampled."""

    points: Float[np.ndarray, "n 3"]
    """Positions in the occlusal frame, mm; clockwise seen from +Z."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", read_only(self.points))

    @property
    def lengths_mm(self) -> Float[np.ndarray, "n"]:
        """Length of the curve up to each sample."""
        return lengths_along(self.points)

    def span_of(self, points: Float[np.ndarray, "m 3"]) -> tuple[float, float]:
        """The stretch of the curve (mm from its start) beside which most of the points lie."""
        nearest = np.argmin(np.linalg.norm(points[:, None, :2] - self.points[None, ::5, :2], axis=2), axis=1)
        first, last = np.percentile(self.lengths_mm[::5][nearest], [2, 98])
        return float(first), float(last)

    def rig_from_world(self, length_mm: float) -> Rigid3:
        """A handpiece held upright over a place of the curve; straight on beyond its ends."""
        lengths = self.lengths_mm
        tangents = np.gradient(self.points, lengths, axis=0)
        at = np.clip(length_mm, 0, lengths[-1])
        tangent = np.array([np.interp(at, lengths, tangents[:, axis]) for axis in range(3)])
        tangent /= np.linalg.norm(tangent)
        place = np.array([np.interp(at, lengths, self.points[:, axis]) for axis in range(3)])
        buccal = np.cross([0, 0, 1.0], tangent)
        buccal /= np.linalg.norm(buccal)
        axes = np.stack([tangent, buccal, np.cross(tangent, buccal)])
        return Rigid3(axes, -axes @ (place + (length_mm - at) * tangent))


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanPath:
    """Poses of the handpiece and the overlap that they give."""

    rig_from_world: Mapping[str, Rigid3]
    """Pose by frame name, in order."""
    overlap: Float[np.ndarray, "n c"]
    """For each frame but the last, and each camera: share of the surface in its image that the next image also sees;
    NaN where the image shows no surface."""
    curve: ArchCurve = field(repr=False)
    """The curve that the path follows."""

    @property
    def minimum_overlap(self) -> float:
        """The worst of all images."""
        return float(np.nanmin(self.overlap))

    @property
    def mean_overlap(self) -> float:
        """The mean over all images."""
        return float(np.nanmean(self.overlap))


def plan_scan_path(jaw: Jaw, handpiece: Handpiece, options: ScanPathOptions, rng: np.random.Generator) -> ScanPath:
    """A path over the arch or one tooth on which consecutive images of each camera overlap enough.

    Raises InputError where the jaw has no such tooth, the handpiece would touch it, or the asked number of frames is
    too small for the overlap.
    """
    curve = arch_curve(jaw)
    passes = _passes(jaw, curve, options)
    hand = _hand_motion(passes.span_mm, options, rng)
    frames = options.frames or options.turns * (ARCH_FRAMES if options.tooth is None else TOOTH_FRAMES)
    most = frames if options.frames else 3 * frames
    while True:
        path = _even_path(jaw.mesh, handpiece, passes, hand, np.linspace(*passes.span_mm, frames))
        check_clearance(jaw.mesh, handpiece, path.rig_from_world, options.clearance_mm)
        if path.minimum_overlap > options.minimum_overlap:
            return path
        # The surface that an image loses is about in proportion to the step.
        growth = (1 - path.minimum_overlap) / (1 - options.minimum_overlap)
        if options.turns > 1:
            # A single image on a turn is no reason for as many more everywhere.
            growth = min(growth, _GROWTH)
        needed = max(frames + 1, int(np.ceil(1 + (frames - 1) * growth)))
        if needed > most:
            raise InputError(
                f"scan path: with {frames} frames consecutive images overlap by only {path.minimum_overlap:.0%}, less "
                f"than {options.minimum_overlap:.0%}; about {needed} would be needed: give --frames or a shorter path"
            )
        frames = needed


def _stretch(jaw: Jaw, curve: ArchCurve, options: ScanPathOptions) -> tuple[float, float]:
    """Start and end of the path, in mm along the curve."""
    if options.tooth is None:
        first, last, length = 0.0, float(curve.lengths_mm[-1]), float(curve.lengths_mm[-1])
    else:
        first, last = curve.span_of(jaw.mesh.face_centres[jaw.tooth_faces(options.tooth)])
        length = TOOTH_PATH_MM
    middle, half = (first + last) / 2, (options.length_mm or length) / 2
    return middle - half, middle + half


def _even_path(
    mesh: Mesh, handpiece: Handpiece, passes: _Passes, hand: _HandMotion, travel_mm: Float[np.ndarray, "n"]
) -> ScanPath:
    """The path on which the hand goes slower where the images change faster, so that the overlap is about even."""
    path = _sampled(mesh, handpiece, passes, hand, travel_mm)
    for _ in range(2):
        worst = 1 - np.min(path.overlap, axis=1, initial=1.0, where=np.isfinite(path.overlap))
        change = np.concatenate([[0], np.cumsum(np.maximum(worst, 0.25 * worst.max()))])
        travel_mm = np.interp(np.linspace(0, change[-1], len(travel_mm)), change, travel_mm)
        path = _sampled(mesh, handpiece, passes, hand, travel_mm)
    return path


def _sampled(
    mesh: Mesh, handpiece: Handpiece, passes: _Passes, hand: _HandMotion, travel_mm: Float[np.ndarray, "n"]
) -> ScanPath:
    poses = [hand.at(travel) @ passes.rig_from_world(travel) for travel in travel_mm]
    names = [f"{index:05d}" for index in range(len(poses))]
    return ScanPath(
        rig_from_world=dict(zip(names, poses, strict=True)),
        overlap=image_overlap(mesh, handpiece, poses),
        curve=passes.curve,
    )


# --- the passes -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class _Passes:
    """The way of a steady hand on all passes and the turns between them."""

    curve: ArchCurve
    travel_mm: Float[np.ndarray, "k"]
    """At the start and the end of each pass."""
    lengths_mm: Float[np.ndarray, "k"]
    """Places on the curve there."""
    rolls_deg: Float[np.ndarray, "k"]
    """Rolls there."""
    stations_mm: Float[np.ndarray, "s"]
    """Places on the curve at which the room was measured."""
    lifts_mm: Float[np.ndarray, "p s"]
    """For each pass: how far the surface lies outside of the nominal crown at those places."""

    @property
    def span_mm(self) -> tuple[float, float]:
        """First and last travel."""
        return float(self.travel_mm[0]), float(self.travel_mm[-1])

    def rig_from_world(self, travel_mm: float) -> Rigid3:
        """The handpiece without the drift of a hand."""
        if len(self.travel_mm) == 2:
            return self.curve.rig_from_world(travel_mm)
        length = float(np.interp(travel_mm, self.travel_mm, self.lengths_mm))
        hold_from_world = self.curve.rig_from_world(length)
        roll = float(np.interp(travel_mm, self.travel_mm, self.rolls_deg))
        at_passes = [np.interp(length, self.stations_mm, lifts) for lifts in self.lifts_mm]
        # Passes run from the largest roll to the smallest.
        lift = float(np.interp(-roll, -self.rolls_deg[::2], at_passes))
        return _rig_from_hold(roll, lift) @ hold_from_world


def _passes(jaw: Jaw, curve: ArchCurve, options: ScanPathOptions) -> _Passes:
    start, end = _stretch(jaw, curve, options)
    rolls = np.array(options.rolls_deg)
    lengths = np.array([(start, end) if number % 2 == 0 else (end, start) for number in range(len(rolls))]).ravel()
    turning = np.abs(np.diff(rolls, prepend=rolls[0])) * np.deg2rad(_TURN_RADIUS_MM)
    steps = np.column_stack([turning, np.full(len(rolls), end - start)]).ravel()
    travel = start + np.cumsum(steps)
    travel[:2] = start, end
    stations = np.linspace(start, end, max(2, round((end - start) / _STATION_MM)))
    return _Passes(
        curve=curve,
        travel_mm=travel,
        lengths_mm=lengths,
        rolls_deg=np.repeat(rolls, 2),
        stations_mm=stations,
        lifts_mm=np.array([_lifts(jaw.mesh, curve, stations, roll) for roll in rolls]),
    )


def steady_poses(jaw: Jaw, options: ScanPathOptions, per_pass: int) -> tuple[Rigid3, ...]:
    """``rig_from_world`` at so many places on each pass, evenly spaced, without the drift of a hand or the turns."""
    passes = _passes(jaw, arch_curve(jaw), options)
    ends = passes.travel_mm.reshape(-1, 2)
    return tuple(passes.rig_from_world(float(at)) for first, last in ends for at in np.linspace(first, last, per_pass))


def _rig_from_hold(roll_deg: float, lift_mm: float) -> Rigid3:
    """A handpiece that looks square at the place of a rounded crown whose normal is rolled by an angle.

    The crown is an ellipse across the arch; at `_SIDE_DEG` its place is that of `_SIDE_MM`, where the side groups of
    the twelve cameras look.
    """
    roll, side = np.deg2rad([roll_deg, _SIDE_DEG])
    outward = np.array([0, np.sin(roll), np.cos(roll)])
    across = _SIDE_MM[0] * np.sin(roll) / np.sin(side)
    down = _SIDE_MM[1] * (1 - np.cos(roll)) / (1 - np.cos(side))
    rotation = np.stack([[1.0, 0, 0], np.cross(outward, [1.0, 0, 0]), outward])
    return Rigid3(rotation, -rotation @ (np.array([0, across, -down]) + lift_mm * outward))


def _lifts(
    mesh: Mesh, curve: ArchCurve, stations_mm: Float[np.ndarray, "s"], roll_deg: float
) -> Float[np.ndarray, "s"]:
    """How far a rolled handpiece must move out, or in (negative), for its working distance to be kept.

    Rays on a patch square before it find the surface. What stands out most nearby counts, so that the handpiece does
    not dive behind the last crown; then smoothed along the arch, for a hand does not follow each crown.
    """
    if roll_deg == 0:
        return np.zeros(len(stations_mm))
    ticks = np.linspace(-_PATCH_MM, _PATCH_MM, 5)
    patch = np.stack(np.meshgrid(ticks, ticks, _FAR_MM), axis=-1).reshape(-1, 3)
    lifts = np.zeros(len(stations_mm))
    for index, length in enumerate(stations_mm):
        world_from_rig = (_rig_from_hold(roll_deg, 0.0) @ curve.rig_from_world(float(length))).inverse()
        hits = mesh.cast(world_from_rig.apply(patch), np.broadcast_to(-world_from_rig.rotation[:, 2], patch.shape))
        heights = _FAR_MM - hits.distances[hits.distances < 2 * _FAR_MM]
        lifts[index] = np.median(heights) if len(heights) else 0.0
    highest = maximum_filter(lifts, size=round(_NEAR_MM / _STATION_MM), mode="nearest")
    smooth = gaussian_filter1d(highest, _NEAR_MM / 2 / _STATION_MM, mode="nearest")
    return np.asarray(np.clip(smooth, -_LIFT_MM, _LIFT_MM))


# --- the arch ---------------------------------------------------------------------------------------------------------


def arch_curve(jaw: Jaw) -> ArchCurve:
    """The arch of a jaw in its occlusal frame, from the mesh; labels, where there are any, keep the gum out of it."""
    crowns = _crown_tops(jaw)
    points = _rough_curve(crowns)
    for _ in range(3):
        points = _centred_curve(points, crowns)
    return ArchCurve(points=points)


def _rough_curve(crowns: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """The arch as seen from the centre of the circle through it."""
    centre = _circle_centre(crowns[:, :2])
    offset = crowns[:, :2] - centre
    middle = np.arctan2(*offset.mean(axis=0)[::-1])
    # Angles grow clockwise and are zero at the middle of the arch, so that the cut lies behind the mouth.
    angle = -np.angle(np.exp(1j * (np.arctan2(offset[:, 1], offset[:, 0]) - middle)))
    radius = np.linalg.norm(offset, axis=1)
    along = angle * np.median(radius)
    at, middles = _middles(along, radius, crowns[:, 2])
    fine, smooth = _smooth(at, middles)
    turn = middle - fine / np.median(radius)
    return np.column_stack([centre + smooth[:, :1] * np.stack([np.cos(turn), np.sin(turn)], axis=1), smooth[:, 1]])


def _centred_curve(points: Float[np.ndarray, "m 3"], crowns: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k 3"]:
    """A curve moved sideways to the middle of the crowns and lengthened or shortened to where they end."""
    line = _lengthened(points, _NEAR_MM)
    lengths = lengths_along(line[:, :2])
    tangents = np.gradient(line[:, :2], lengths, axis=0)
    normals = np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)
    _, nearest = KDTree(line[:, :2]).query(crowns[:, :2])
    sideways = np.sum((crowns[:, :2] - line[nearest, :2]) * normals[nearest], axis=1)
    at, middles = _middles(lengths[nearest], sideways, crowns[:, 2])
    base = np.column_stack([np.interp(at, lengths, line[:, axis]) for axis in (0, 1)])
    normal = np.column_stack([np.interp(at, lengths, normals[:, axis]) for axis in (0, 1)])
    _, smooth = _smooth(at, np.column_stack([base + middles[:, :1] * normal, middles[:, 1]]))
    return smooth


def _lengthened(points: Float[np.ndarray, "m 3"], by_mm: float) -> Float[np.ndarray, "k 3"]:
    """A line with straight pieces added at both ends."""
    reach = np.arange(1, round(by_mm / _SAMPLE_MM) + 1)[:, None] * _SAMPLE_MM
    start, end = points[0] - points[10], points[-1] - points[-11]
    before = points[0] + reach[::-1] * start / np.linalg.norm(start)
    after = points[-1] + reach * end / np.linalg.norm(end)
    return np.concatenate([before, points, after])


def _crown_tops(jaw: Jaw) -> Float[np.ndarray, "n 3"]:
    """Points of the surface seen from above that lie near the top of a crown."""
    (low_x, low_y, _), (high_x, high_y, top) = jaw.mesh.bounds
    x, y = np.meshgrid(np.arange(low_x, high_x, _GRID_MM), np.arange(low_y, high_y, _GRID_MM))
    above = np.stack([x.ravel(), y.ravel(), np.full(x.size, top + 1)], axis=1)
    hits = jaw.mesh.cast(above, np.broadcast_to([0, 0, -1.0], above.shape))
    height = (top + 1 - hits.distances).reshape(x.shape)
    if jaw.face_labels is not None:
        height[(jaw.face_labels[hits.faces] == GUM).reshape(x.shape)] = -np.inf
    crown = _is_crown(height)
    if crown.sum() < 100:
        raise InputError(
            "scan path: no crowns found on the jaw; is it in its occlusal frame (+Z out of the gum), in mm?"
        )
    return np.stack([x[crown], y[crown], height[crown]], axis=1)


def _is_crown(height: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    nearby = maximum_filter(height, size=round(_NEAR_MM / _GRID_MM), mode="nearest")
    seen = np.isfinite(height)
    if not seen.any():
        return seen
    highest = np.percentile(nearby[seen], 95)
    return seen & (height > nearby - _CROWN_TOP_MM) & (height > highest - _ARCH_DROP_MM)


def _circle_centre(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "2"]:
    """Centre of the least-squares circle (Kasa), from which the arch is seen one tooth after the other."""
    mean = points.mean(axis=0)
    centred = points - mean
    solution, *_ = np.linalg.lstsq(
        np.column_stack([2 * centred, np.ones(len(points))]), np.sum(centred**2, axis=1), rcond=None
    )
    return np.asarray(mean + solution[:2])


def _middles(
    along: Float[np.ndarray, "n"], sideways: Float[np.ndarray, "n"], height: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m 2"]]:
    """For each millimetre along the arch: where it is, the middle between the crowns' sides, their height."""
    bins = np.floor(along - along.min()).astype(int)
    cuts = np.zeros((bins.max() + 1, 3))
    for index in np.unique(bins):
        inside = bins == index
        cuts[index] = *np.percentile(sideways[inside], [3, 97]), np.percentile(height[inside], 95)
    counted = np.unique(bins)
    at = along.min() + counted + 0.5
    return at, np.column_stack([cuts[counted, :2].mean(axis=1), cuts[counted, 2]])


def _smooth(
    at: Float[np.ndarray, "m"], values: Float[np.ndarray, "m d"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n d"]]:
    """Smoothing spline through values given about every millimetre, finely sampled.

    The rounded ends of the last crowns say nothing of the middle: they are left out and the spline goes on straight.
    """
    inner = (at >= at[0] + _ROUND_MM) & (at <= at[-1] - _ROUND_MM)
    fine = np.linspace(at[0], at[-1], max(50, round(np.ptp(at) / _SAMPLE_MM)))
    stiffness = (_WAVELENGTH_MM / (2 * np.pi)) ** 4
    splines = [make_smoothing_spline(at[inner], column[inner], lam=stiffness) for column in values.T]
    return fine, np.stack([spline(fine) for spline in splines], axis=1)


# --- the hand ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _HandMotion:
    """Smooth random drift along the path, independent of where the frames are taken."""

    lengths_mm: Float[np.ndarray, "n"]
    """Places on the arch curve."""
    drift: Float[np.ndarray, "n 6"]
    """Rotation vector (rad) and translation (mm) at those places."""

    def at(self, length_mm: float) -> Rigid3:
        """``jittered_rig_from_rig`` at a place on the arch curve."""
        drift = np.array([np.interp(length_mm, self.lengths_mm, column) for column in self.drift.T])
        return Rigid3.from_rotation_vector(drift[:3], drift[3:])


def _hand_motion(stretch: tuple[float, float], options: ScanPathOptions, rng: np.random.Generator) -> _HandMotion:
    """Gaussian noise smoothed over ``jitter_length_mm``, with the asked standard deviations in expectation."""
    sigma, padding = 10, 60
    step = options.jitter_length_mm / (2 * sigma)
    lengths = np.arange(stretch[0], stretch[1] + step, step)
    white = rng.standard_normal((len(lengths) + 2 * padding, 6))
    unit = gaussian_filter1d(white, sigma, axis=0)[padding:-padding] * np.sqrt(2 * sigma * np.sqrt(np.pi))
    return _HandMotion(lengths, unit * ([np.deg2rad(options.jitter_deg)] * 3 + [options.jitter_mm] * 3))


# --- checks -----------------------------------------------------------------------------------------------------------


def image_overlap(
    mesh: Mesh, handpiece: Handpiece, rig_from_world: Sequence[Rigid3], grid: int = 24
) -> Float[np.ndarray, "n c"]:
    """Share of the surface in each camera's image that its next image also sees: in its field of view, not hidden.

    The surface in an image is what lies within the depth range of the lens. It is asked on a grid of rays over the
    image, so the share is of the image's area. NaN where fewer than a tenth of the rays meet it.
    """
    rig = handpiece.rig
    overlap = np.full((len(rig_from_world) - 1, len(rig.names)), np.nan)
    for row, (now, following) in enumerate(pairwise(rig_from_world)):
        for column, mounted in enumerate(rig.cameras.values()):
            camera = mounted.camera
            ticks = (np.arange(grid) + 0.5) / grid
            pixels = np.stack(np.meshgrid(ticks * camera.width, ticks * camera.height), axis=-1).reshape(-1, 2)
            points = _surface_at(mesh, mounted.cam_from_rig @ now, camera.rays(pixels), handpiece.depth_range_mm)
            if len(points) >= 0.1 * len(pixels):
                cam_from_world = mounted.cam_from_rig @ following
                inside = camera.contains(camera.project(cam_from_world.apply(points)))
                centre = np.broadcast_to(cam_from_world.inverse().translation, points.shape)
                overlap[row, column] = np.mean(inside & ~mesh.occluded(points, centre))
    return overlap


def _surface_at(
    mesh: Mesh, cam_from_world: Rigid3, rays: Float[np.ndarray, "n 3"], depth_range_mm: tuple[float, float]
) -> Float[np.ndarray, "m 3"]:
    world_from_cam = cam_from_world.inverse()
    directions = world_from_cam.rotate(rays)
    hits = mesh.cast(np.broadcast_to(world_from_cam.translation, directions.shape), directions)
    hit = (hits.distances >= depth_range_mm[0]) & (hits.distances <= depth_range_mm[1])
    return world_from_cam.translation + hits.distances[hit, None] * directions[hit]


def check_clearance(mesh: Mesh, handpiece: Handpiece, poses: Mapping[str, Rigid3], clearance_mm: float) -> None:
    """Raise InputError where a camera or light comes too near to the jaw or lies inside it."""
    parts = {f"camera {name}": (each.centre_in_rig, each.axis_in_rig) for name, each in handpiece.rig.cameras.items()}
    parts |= {f"light {name}": (light.position_mm, light.direction) for name, light in handpiece.lights.items()}
    places = np.array([place for place, _ in parts.values()])
    axes = np.array([axis for _, axis in parts.values()])
    for frame, rig_from_world in poses.items():
        world_from_rig = rig_from_world.inverse()
        points, directions = world_from_rig.apply(places), world_from_rig.rotate(axes)
        hits = mesh.cast(points, directions)
        from_inside = (hits.faces >= 0) & (np.sum(mesh.face_normals[hits.faces] * directions, axis=1) > 0)
        touching = (mesh.closest(points)[0] < clearance_mm) | from_inside
        if touching.any():
            part = list(parts)[int(np.argmax(touching))]
            raise InputError(
                f"scan path: at frame {frame} {part} of the handpiece comes nearer to the jaw than {clearance_mm} mm "
                "or lies inside it; use a narrower design or a larger working distance"
            )
