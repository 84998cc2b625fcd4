"""Estimates metric poses and a sparse model from a capture, stage by stage."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int, UInt8

from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.pairing import PairingOptions, require_stereo, resolved_mm, stereo_pairs
from cuspid.model.reconstruction import Reconstruction, Tracks
from cuspid.model.rig import Handpiece, Rig
from cuspid.model.unrolling import is_rolling, unrollings
from cuspid.motion.bundle.adjustment import AdjustmentOptions, adjust, calibration_sigma_px
from cuspid.motion.frontend.closure import Image, closing_pairs
from cuspid.motion.frontend.features import FeatureOptions, Features, detect_all
from cuspid.motion.frontend.least_squares_matching import LeastSquaresOptions, ReadGray, match_patches
from cuspid.motion.frontend.odometry import (
    Cloud,
    FrameFeatures,
    OdometryOptions,
    Trajectory,
    chain,
    find_edges,
    rays_in_rig,
    triangulate_frame,
)
from cuspid.motion.frontend.pairs import IndexedFeatures, MatchingOptions, frame_pairs, index_features, match_guided
from cuspid.motion.frontend.pictures import Pictures
from cuspid.motion.frontend.tracks import intersect_rays, join, points_across, thin
from cuspid.runtime.errors import ReconstructionError
from cuspid.runtime.options import SEED, SHARE, Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import computed_once, map_in_threads

_LOOSE_SCALE_PPM, _LOOSE_SPAN_PPM = 1000.0, 300.0
"""Standard deviations of the scale and, apart from it, of the length of a scan, above which advice is given."""


_ROLLING_SHARE = 0.008
"""Of the height of an image, by which what it shows may move between its rows, before that is known."""
_HELD = (
    "calibration: kept as in the file, since the images of the one frame share too few points to refine it: its "
    "cameras stand far apart, or the surface shows little detail"
)


@dataclass(frozen=True, kw_only=True)
class MotionOptions(Options):
    """How the trajectory of the handpiece is found from features."""

    features: FeatureOptions = field(default_factory=lambda: FeatureOptions(halved_from_px=400))
    """Keypoints; images are halved only where patches make the positions accurate afterwards."""
    pairing: PairingOptions = field(default_factory=PairingOptions)
    """Which cameras are matched within a frame."""
    within: MatchingOptions = field(default_factory=MatchingOptions)
    """Matching of the cameras of a group within a frame."""
    odometry: OdometryOptions = field(default_factory=OdometryOptions)
    """How the first poses are found."""
    across_frames: MatchingOptions = field(default_factory=lambda: MatchingOptions(tolerance_px=3.0))
    """Matching of a camera with itself across frames (motion stereo), once the poses are approximately known."""
    reach: Annotated[int, Range(1, 1000)] = 3
    """A camera is matched with itself in the following frames, up to this many."""
    depth_slack: Annotated[float, Range(0, 100_000)] = 8.3
    """Uncertainty of the depth of a point triangulated within one frame, when it is searched for in another, in
    resolutions of the handpiece (0.1 mm at 12 um)."""
    least_squares: LeastSquaresOptions = field(default_factory=LeastSquaresOptions)
    """Patches that make the keypoint positions accurate."""
    cell_px: Annotated[float | None, Range(0, 10_000)] = None
    """In each cell of this size, an image keeps its longest track for the adjustment; 0 keeps all tracks. Default: a
    tenth of the shorter side."""
    min_located: Annotated[float, SHARE] = 0.5
    """Minimum share (0 to 1) of the frames that must be located."""
    adjustment: AdjustmentOptions = field(default_factory=AdjustmentOptions)
    """The final refinement."""
    seed: Annotated[int, SEED] = 0
    """Seed of the random samples in pose estimation."""

    @property
    def sought(self) -> FeatureOptions:
        """Keypoints; those that no patches will make accurate, in images of full size."""
        return self.features if self.least_squares.enabled else replace(self.features, halved_from_px=None)

    def cell_for(self, rig: Rig) -> float:
        """Size of the cells that each keep their longest track, px."""
        sides = [min(each.camera.width, each.camera.height) for each in rig.cameras.values()]
        return min(sides) / 10 if self.cell_px is None else self.cell_px


@contextmanager
def _log_time(log: dict[str, float], stage: str) -> Iterator[None]:
    """Add the seconds that a stage takes to the log."""
    start = time.perf_counter()
    yield
    log[f"{stage}_s"] = log.get(f"{stage}_s", 0.0) + time.perf_counter() - start


@dataclass(frozen=True, eq=False)
class _Numbering:
    """Numbers every keypoint of the located frames: frame after frame, camera after camera."""

    starts: Mapping[tuple[int, str], int]
    """Number of the first keypoint of an image."""
    frame: Int[np.ndarray, "n"]
    """Index of the located frame of each keypoint."""
    camera: Int[np.ndarray, "n"]
    """Index of the camera of each keypoint."""

    @staticmethod
    def of(frames: Sequence[FrameFeatures], rig: Rig) -> _Numbering:
        """Number the keypoints of frames."""
        sizes = {(f, name): len(view.features) for f, views in enumerate(frames) for name, view in views.items()}
        counts = list(sizes.values())
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        cameras = {name: index for index, name in enumerate(rig.names)}
        return _Numbering(
            dict(zip(sizes, starts.tolist(), strict=False)),
            np.repeat([frame for frame, _ in sizes], counts),
            np.repeat([cameras[name] for _, name in sizes], counts),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Scan:
    """The located frames."""

    handpiece: Handpiece
    frames: Sequence[FrameFeatures]
    """Keypoints where they are at the instants of the frames."""
    taken: Sequence[FrameFeatures]
    """Where the images show them."""
    clouds: Sequence[Cloud]
    poses: Sequence[Rigid3]

    @computed_once
    def numbering(self) -> _Numbering:
        """Of all keypoints."""
        return _Numbering.of(self.frames, self.handpiece.rig)

    @computed_once
    def resolved_mm(self) -> float:
        """Of the handpiece."""
        return resolved_mm(self.handpiece)

    def has(self, image: Image) -> bool:
        """Whether the camera has an image of the frame."""
        frame, camera = image
        return camera in self.frames[frame]

    def cam_from_world(self, image: Image) -> Rigid3:
        """Where an image was taken from."""
        frame, camera = image
        return self.handpiece.rig[camera].cam_from_rig @ self.poses[frame]

    def depth_bounds(self, image: Image, slack_mm: float) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Least and greatest depth of each keypoint: about that of its point, else the depth of field.

        The slack is that at the working distance; behind it grows with the square of the depth, as in all stereo.
        """
        frame, camera = image
        depth = self.clouds[frame].depths(self.handpiece.rig, camera)
        near, far = self.handpiece.depth_range_mm
        slack = slack_mm * np.maximum(1.0, (depth / self.handpiece.working_distance_mm) ** 2)
        slack = np.minimum(slack, depth / 2)
        known = np.isfinite(depth)
        return np.where(known, depth - slack, near), np.where(known, depth + slack, far)

    def match(self, one: Image, other: Image, options: MotionOptions) -> Int[np.ndarray, "k 2"]:
        """Matches of two images, as numbers of keypoints."""
        here, there = (self.frames[frame][camera] for frame, camera in (one, other))
        motion = self.cam_from_world(other) @ self.cam_from_world(one).inverse()
        slack_mm = options.depth_slack * self.resolved_mm
        depths_here, depths_there = (self.depth_bounds(image, slack_mm) for image in (one, other))
        found = match_guided(here, there, motion, depths_here, depths_there, options.across_frames)
        return found + [self.numbering.starts[one], self.numbering.starts[other]]


def _within_frames(scan: _Scan) -> list[Int[np.ndarray, "_ 2"]]:
    """Matches within the frames, as numbers of keypoints."""
    starts = scan.numbering.starts
    return [
        found + [starts[f, first], starts[f, second]]
        for f, cloud in enumerate(scan.clouds)
        for first, second, found in cloud.matches
    ]


def _triangulate_tracks(scan: _Scan, track: Int[np.ndarray, "n"]) -> Tracks:
    """Tracks with a point each where their rays meet."""
    centres, directions = [], []
    for views, pose in zip(scan.frames, scan.poses, strict=True):
        world_from_rig = pose.inverse()
        in_rig = rays_in_rig(scan.handpiece.rig, views)
        centres.append(world_from_rig.apply(in_rig[0]))
        directions.append(world_from_rig.rotate(in_rig[1]))
    seen = np.flatnonzero(track >= 0)
    count = int(track.max(initial=-1)) + 1
    points = intersect_rays(np.concatenate(centres)[seen], np.concatenate(directions)[seen], track[seen], count)
    finite = np.isfinite(points).all(axis=1)
    seen = seen[finite[track[seen]]]
    every = [view.features for views in scan.taken for view in views.values()]
    colors = np.zeros((count, 3), dtype=np.uint8)
    colors[track[seen]] = np.concatenate([f.colors for f in every])[seen]
    return Tracks(
        points=np.nan_to_num(points),
        colors=colors,
        point_index=track[seen],
        frame_index=scan.numbering.frame[seen],
        camera_index=scan.numbering.camera[seen],
        pixels=np.concatenate([f.pixels for f in every])[seen],
    )


def _across_frames(
    scan: _Scan, pairs: Iterable[tuple[Image, Image]], options: MotionOptions, stage: str, progress: Progress
) -> list[Int[np.ndarray, "_ 2"]]:
    """Matches of pairs of images, guided by the poses, as numbers of keypoints."""
    there = [pair for pair in pairs if all(map(scan.has, pair))]
    return map_in_threads(lambda pair: scan.match(*pair, options), there, stage=stage, progress=progress)


def _tracks(scan: _Scan, matches: Sequence[Int[np.ndarray, "_ 2"]], cell_px: float) -> Tracks:
    """Matches joined, and thinned out."""
    numbering = scan.numbering
    image = numbering.frame * len(scan.handpiece.rig.names) + numbering.camera
    track = join(np.concatenate([np.zeros((0, 2), dtype=np.int64), *matches]), image)
    if cell_px > 0:
        seen = np.flatnonzero(track >= 0)
        pixels = np.concatenate([view.features.pixels for views in scan.taken for view in views.values()])
        track[seen[~thin(track[seen], image[seen], pixels[seen], cell_px)]] = -1
    return _triangulate_tracks(scan, track)


def _require_enough(trajectory: Trajectory, clouds: Sequence[Cloud], options: MotionOptions) -> None:
    """Raise ReconstructionError where too few frames are located."""
    placed, total = len(trajectory.rig_from_world), len(clouds)
    if placed >= options.min_located * total and (placed > 1 or total == 1):
        return
    shown = "; ".join(f"{d.what}: {d.reason}" for d in trajectory.dropped[:3])
    more = f"; and {len(trajectory.dropped) - 3} more" if len(trajectory.dropped) > 3 else ""
    typical = int(np.median([len(cloud.points) for cloud in clouds]))
    raise ReconstructionError(
        f"motion: only {placed} of {total} frames could be placed, with {typical} points in a typical frame ({shown}"
        f"{more}); give the surface more texture (powder), take frames closer together, or check the handpiece file"
    )


def loosen_tolerances(options: MotionOptions, handpiece: Handpiece) -> MotionOptions:
    """Options with tolerances that allow for an uncertain calibration."""
    slack_px = 2 * calibration_sigma_px(handpiece.rig, handpiece.working_distance_mm)
    within, odometry, across = options.within, options.odometry, options.across_frames
    return replace(
        options,
        within=replace(within, tolerance_px=within.tolerance_px + slack_px),
        odometry=replace(odometry, error_px=odometry.error_px + slack_px),
        across_frames=replace(across, tolerance_px=across.tolerance_px + slack_px),
    )


def index_frame(rig: Rig, features: Mapping[tuple[str, str], Features], frame: str) -> FrameFeatures:
    """The keypoints of one frame, ready to be matched, by the cameras of the rig that have some."""
    there = ((camera, features.get((frame, camera)), mounted) for camera, mounted in rig.cameras.items())
    return {camera: index_features(found, mounted.camera) for camera, found, mounted in there if found is not None}


def locate_features(
    handpiece: Handpiece,
    features: Mapping[tuple[str, str], Features],
    names: Sequence[str],
    options: MotionOptions,
    *,
    read: ReadGray | None = None,
    progress: Progress = silent,
) -> Reconstruction:
    """As :func:`locate`, from the keypoints by (frame, camera) of the frames ``names`` in the order of capture.

    A camera without keypoints of a frame is left out of that frame. The order of the cameras in the handpiece affects
    only their order in the result. ``read`` returns the grey image of a frame and a camera, given their names; without
    it, keypoint positions are not refined.
    """
    given, handpiece = handpiece.rig.names, replace(handpiece, rig=handpiece.rig.in_own_order())
    options = loosen_tolerances(options, handpiece)
    taken = {name: index_frame(handpiece.rig, features, name) for name in names}
    refined = read if options.least_squares.enabled else None
    if not is_rolling(handpiece.rig, names):
        found = _locate_indexed(handpiece, taken, taken, options, refined, progress)
    else:
        rough = _locate_indexed(handpiece, taken, taken, _loosen_for_rolling(options, handpiece), None, progress)
        found = _locate_indexed(handpiece, taken, _unroll_features(taken, rough), options, refined, progress)
    noted = add_advice(found, options.odometry.min_matches)
    return noted.with_cameras_as(given)


def _loosen_for_rolling(options: MotionOptions, handpiece: Handpiece) -> MotionOptions:
    """With tolerances for what moves between the rows of an image."""
    slack_px = _ROLLING_SHARE * float(np.mean([each.camera.height for each in handpiece.rig.cameras.values()]))
    within, odometry, across = options.within, options.odometry, options.across_frames
    return replace(
        options,
        within=replace(within, tolerance_px=within.tolerance_px + slack_px),
        odometry=replace(odometry, error_px=odometry.error_px + slack_px),
        across_frames=replace(across, tolerance_px=across.tolerance_px + slack_px),
    )


def _unroll_features(taken: Mapping[str, FrameFeatures], found: Reconstruction) -> dict[str, FrameFeatures]:
    """The keypoints where they would have been seen at the instants of the frames, by poses that are about right."""
    made = unrollings(found)

    def unroll(frame: str, camera: str, view: IndexedFeatures) -> IndexedFeatures:
        unrolling = made.get((frame, camera))
        if unrolling is None or not len(view.features):
            return view
        features = replace(view.features, pixels=unrolling.at_instant(view.features.pixels))
        return index_features(features, found.rig[camera].camera)

    return {
        frame: {camera: unroll(frame, camera, view) for camera, view in views.items()} for frame, views in taken.items()
    }


def _locate_indexed(
    handpiece: Handpiece,
    taken: Mapping[str, FrameFeatures],
    at_instants: Mapping[str, FrameFeatures],
    options: MotionOptions,
    read: ReadGray | None,
    progress: Progress,
) -> Reconstruction:
    """As :func:`locate_features`, from keypoints as the images show them and where they are at the instants of the
    frames."""
    rig, log, names, frames = handpiece.rig, dict[str, float](), list(taken), list(at_instants.values())
    with _log_time(log, "triangulation"):
        pairs = stereo_pairs(rig, handpiece.working_distance_mm, options.pairing)
        clouds = map_in_threads(
            lambda views: triangulate_frame(handpiece, pairs, views, options.within),
            frames,
            stage="triangulation",
            progress=progress,
        )
    with _log_time(log, "odometry"):
        trajectory = chain(find_edges(rig, frames, clouds, options.odometry, options.seed), names, options.odometry)
    _require_enough(trajectory, clouds, options)
    start = Reconstruction(
        rig=rig,
        rig_from_world={names[f]: pose for f, pose in trajectory.rig_from_world.items()},
        dropped=trajectory.dropped,
    )
    scan = _Scan(
        handpiece=handpiece,
        frames=[frames[f] for f in trajectory.rig_from_world],
        taken=[taken[names[f]] for f in trajectory.rig_from_world],
        clouds=[clouds[f] for f in trajectory.rig_from_world],
        poses=list(trajectory.rig_from_world.values()),
    )
    try:
        adjusted = _adjust_and_reconnect(start, scan, options, read, log, progress)
    except ReconstructionError:
        if len(scan.frames) > 1:
            raise
        adjusted = replace(start, notes=(*start.notes, _HELD))  # the rig alone tells where the cameras of a frame are
    return replace(adjusted, log={**log, **adjusted.log})


def add_advice(found: Reconstruction, least: int) -> Reconstruction:
    """Adds notes where fewer points than ``least`` link frames, with advice on how to make the path more certain."""
    return replace(found, notes=(*found.notes, *_loose_notes(found, least), *_advice(found)))


def _loose_notes(found: Reconstruction, least: int) -> tuple[str, ...]:
    """Where too few points that two cameras saw at once before a place in the scan were so seen behind it: images of
    single cameras tie the two, and what lies behind may lie elsewhere, however well it fits."""
    if found.tracks is None:
        return ()
    ties = stereo_ties(found.tracks, len(found.frames))
    loose = [f"{found.frames[k]} and {found.frames[k + 1]} ({ties[k]})" for k in np.flatnonzero(ties < least)]
    if not loose:
        return ()
    return (
        f"motion: fewer than {least} points seen in stereo on both sides connect frames {', '.join(loose[:5])}"
        f"{', ...' if len(loose) > 5 else ''}: parts of the scan may be displaced; scan there again, more slowly",
    )


def _advice(found: Reconstruction) -> Iterator[str]:
    """What would tell the scale or the shape of the path better, where they are loosely known."""
    expected = found.expectation
    if expected is None:
        return
    if expected.scale_sigma_ppm > _LOOSE_SCALE_PPM:
        yield (
            f"expected: the scale is known only to within {expected.scale_sigma_ppm / 1e4:.2g} % (one sigma), because "
            "the calibration does not fix it; calibrate the handpiece with a board (cuspid calibrate)"
        )
        return
    by_scale_um = expected.scale_sigma_ppm * expected.span_mm / 1000
    bent_um = float(np.sqrt(max(expected.span_sigma_um**2 - by_scale_um**2, 0.0)))
    if 1000 * bent_um > _LOOSE_SPAN_PPM * expected.span_mm:
        yield (
            f"expected: apart from the scale, the {expected.span_mm:.0f} mm from end to end are known only to "
            f"within {bent_um:.0f} um (one sigma); a sweep straight from one side to the other, such as over the "
            "palate, helps (in simulation: --cross-sweep)"
        )


def stereo_ties(tracks: Tracks, frames: int) -> Int[np.ndarray, "k"]:
    """For each frame except the last: the number of points that two cameras see at once in it or earlier, and again in
    a later frame."""
    seen = np.unique(np.stack([tracks.point_index, tracks.frame_index, tracks.camera_index], axis=1), axis=0)
    sightings, cameras = np.unique(seen[:, :2], axis=0, return_counts=True)
    point, frame = sightings[cameras >= 2].T
    return points_across(point, frame, frames)


def _adjust_and_reconnect(
    start: Reconstruction,
    scan: _Scan,
    options: MotionOptions,
    read: ReadGray | None,
    log: dict[str, float],
    progress: Progress,
) -> Reconstruction:
    """Tracks over the located frames, adjusted; and again with those that join what was seen twice, and with exact
    places."""
    cell_px = options.cell_for(start.rig)
    first = options.adjustment if read is None else replace(options.adjustment, rounds=2)
    with _log_time(log, "matching"):
        pairs = frame_pairs(len(scan.frames), options.reach)
        images = (((i, camera), (j, camera)) for i, j in pairs for camera in scan.handpiece.rig.names)
        matches = [*_within_frames(scan), *_across_frames(scan, images, options, "matching", progress)]
        tracks = _tracks(scan, matches, cell_px)
    with _log_time(log, "adjustment"):
        adjusted = adjust(replace(start, tracks=tracks), first, covariance=read is None)
    with _log_time(log, "closure"):
        scan = replace(scan, poses=list(adjusted.rig_from_world.values()))
        closing = closing_pairs(scan.handpiece, scan.poses, adjusted.tracks or tracks)
        again = _across_frames(scan, closing, options, "loop closure", progress)
        log["closing_matches"] = float(sum(map(len, again)))
        if log["closing_matches"]:
            tracks = _tracks(scan, [*matches, *again], cell_px)
            joined = replace(start, rig_from_world=adjusted.rig_from_world, tracks=tracks)
            adjusted = adjust(joined, first, covariance=read is None)
    if read is None:
        return adjusted
    with _log_time(log, "patches"):
        placed = match_patches(adjusted, read, options.least_squares, progress=progress)
        found = np.bincount(placed.frame_index, minlength=len(adjusted.frames))
        few = np.flatnonzero(found < options.odometry.min_matches)
        if len(few):
            note = (
                f"motion: in {len(few)} frames (first: {adjusted.frames[few[0]]}) hardly any patches could be matched, "
                "as with glare or blur: keypoints are used as detected, and the path is less accurate"
            )
            start, placed = replace(start, notes=(*start.notes, note)), tracks
    with _log_time(log, "adjustment"):
        exact = replace(start, rig_from_world=adjusted.rig_from_world, tracks=placed)
        return adjust(exact, options.adjustment)


def locate(
    capture: Capture,
    options: MotionOptions | None = None,
    *,
    progress: Progress = silent,
    cache: Path | None = None,
) -> Reconstruction:
    """Metric poses of the frames and a sparse model; finished images are kept in ``cache`` for a later run.

    Raises InputError for images that cannot be used and ReconstructionError where too few frames can be placed.
    """
    options, log = options or MotionOptions(), dict[str, float]()
    require_stereo(capture.handpiece, options.pairing)
    pictures = Pictures(capture) if options.least_squares.enabled else Pictures(capture, max_bytes=0)
    with _log_time(log, "features"):
        features = detect_all(pictures, options.sought, progress=progress, cache=cache)
    names = [frame.name for frame in capture.frames]
    frames = {frame.name: frame for frame in capture.frames}

    def read(frame: str, camera: str) -> UInt8[np.ndarray, "h w"]:
        return pictures.grey(frames[frame], camera)

    found = locate_features(capture.handpiece, features, names, options, read=read, progress=progress)
    return replace(found, dropped=(*capture.left_out, *found.dropped), log={**log, **found.log})
