"""The motion of the handpiece, frame by frame: points triangulated within one frame are found again in the next.

The points of a frame are given in its rig frame, in millimetres, because the rig fixes the scale; the pose of another
frame relative to it follows from where all cameras see them there (generalised absolute pose). Frames that the next
frame (+1) does not connect to the others are tried at +2, +3, ...; what remains unconnected is listed with its reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.csgraph import breadth_first_order

from cuspid.geometry import Rigid3
from cuspid.geometry.graph import graph_of, parts_of
from cuspid.model.camera import stack_lenses
from cuspid.model.capture import Dropped
from cuspid.model.rig import Handpiece, Rig
from cuspid.motion.bundle.normal_equations import pose_equations
from cuspid.motion.colmap import find_rig_pose
from cuspid.motion.frontend.features import Features, select_evenly
from cuspid.motion.frontend.pairs import IndexedFeatures, MatchingOptions, match_guided, match_unguided
from cuspid.motion.frontend.tracks import intersect_rays, join
from cuspid.runtime.options import SHARE, Options, Range
from cuspid.runtime.workers import map_in_threads

FrameFeatures = Mapping[str, IndexedFeatures]
"""Keypoints of one frame by camera."""

_SEARCHED = 8.0
"""Within a frame, matches are searched for up to this many times the far end of the depth of field. A camera sees the
jaw beyond it as well; if the true match were out of range, a wrong one would be found, and such points look consistent
and move too little."""
_CELL_PX = 40
_POLISHING_ROUNDS = 100
"""At most; ten to twenty are usual."""
_SETTLED = 1e-12
_DECIMALS = 9
"""Decimals of a polished pose, in rad and in mean distances of the points."""


@dataclass(frozen=True, kw_only=True)
class OdometryOptions(Options):
    """How a frame is placed relative to its neighbours."""

    reach: Annotated[int, Range(1, 1000)] = 3
    """Frames are connected to the next one, failing that to the second next, and so on up to this many frames on."""
    min_matches: Annotated[int, Range(4, 100_000)] = 15
    """Minimum number of consistent matches that locate a frame."""
    min_share: Annotated[float, SHARE] = 0.4
    """Minimum share (0 to 1) of the matches to a neighbour that must be consistent."""
    error_px: Annotated[float, Range(0.01, 1000)] = 4.0
    """Largest reprojection error of a consistent match, px."""
    max_per_camera: Annotated[int, Range(4, 1_000_000)] = 200
    """Maximum number of points of a frame that are searched for in a camera of another frame; those that most cameras
    saw come first."""
    unguided: MatchingOptions = field(default_factory=lambda: MatchingOptions(ratio=0.8))
    """Matching where nothing is known about the motion."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Cloud:
    """Points triangulated within one frame."""

    points: Float[np.ndarray, "p 3"]
    """In the rig frame, mm."""
    point_of: Mapping[str, Int[np.ndarray, "_"]]
    """For each camera: the point of each keypoint, -1 for none."""
    matches: tuple[tuple[str, str, Int[np.ndarray, "_ 2"]], ...]
    """(camera, camera, pairs of keypoints) that the points were made from."""

    def depths(self, rig: Rig, camera: str) -> Float[np.ndarray, "n"]:
        """Depth of each keypoint in its camera, mm; NaN if it has no point."""
        in_rig = np.vstack([self.points, np.full((1, 3), np.nan)])[self.point_of[camera]]
        return np.asarray(rig[camera].cam_from_rig.apply(in_rig)[:, 2])


@dataclass(frozen=True, eq=False, kw_only=True)
class Edge:
    """Relative pose of two frames."""

    target_from_source: Rigid3 | None
    """Pose of the later frame relative to the earlier one, None if it could not be found."""
    matches: int
    """Number of consistent matches."""
    sought: int
    """Number of matches of which these are."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory:
    """The largest set of connected frames."""

    rig_from_world: Mapping[int, Rigid3]
    """Poses by frame index; the world is the rig frame of the first one."""
    dropped: tuple[Dropped, ...]
    """The other frames."""


def search_range_mm(
    handpiece: Handpiece, view: IndexedFeatures
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Least and greatest depth at which each keypoint is sought where nothing is known of it."""
    near, far = handpiece.depth_range_mm
    return np.full(len(view.features), near), np.full(len(view.features), _SEARCHED * far)


def _consistent(
    rig: Rig,
    views: FrameFeatures,
    points: Float[np.ndarray, "p 3"],
    track: Mapping[str, Int[np.ndarray, "_"]],
    limit_px: float,
) -> np.ndarray:
    """True for the points that lie before each of their cameras and within ``limit_px`` of each of their keypoints."""
    good = np.all(np.isfinite(points), axis=1)
    for camera, view in views.items():
        seen = np.flatnonzero(track[camera] >= 0)
        in_cam = rig[camera].cam_from_rig.apply(points[track[camera][seen]])
        with np.errstate(invalid="ignore", divide="ignore"):
            error = np.linalg.norm(in_cam[:, :2] / in_cam[:, 2:] - view.ideal[seen], axis=1) * view.focal_px
            bad = ~((in_cam[:, 2] > 0) & (error <= limit_px))
        good[track[camera][seen[bad]]] = False
    return good


def rays_in_rig(rig: Rig, views: FrameFeatures) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Centre and direction, in the rig frame, of the ray of every keypoint of a frame, camera after camera."""
    centres, directions = [], []
    for camera, view in views.items():
        rig_from_cam = rig[camera].cam_from_rig.inverse()
        ray = np.column_stack([view.ideal, np.ones(len(view.ideal))])
        directions.append(rig_from_cam.rotate(ray))
        centres.append(np.broadcast_to(rig_from_cam.translation, ray.shape))
    return np.concatenate(centres), np.concatenate(directions)


def triangulate_frame(
    handpiece: Handpiece, pairs: Sequence[tuple[str, str]], views: FrameFeatures, options: MatchingOptions
) -> Cloud:
    """Match the camera pairs of one frame along their epipolar lines and triangulate."""
    rig, matches = handpiece.rig, []
    for first, second in pairs:
        if first not in views or second not in views:
            continue
        a, b = views[first], views[second]
        second_from_first = rig[second].cam_from_rig @ rig[first].cam_from_rig.inverse()
        bounds = search_range_mm(handpiece, a), search_range_mm(handpiece, b)
        found = match_guided(a, b, second_from_first, *bounds, options)
        matches.append((first, second, found))
    sizes = [len(view.features) for view in views.values()]
    starts = dict(zip(views, np.concatenate([[0], np.cumsum(sizes)]), strict=False))
    offset = [found + [starts[first], starts[second]] for first, second, found in matches]
    track = join(np.concatenate([np.zeros((0, 2), np.int64), *offset]), np.repeat(np.arange(len(sizes)), sizes))
    centres, directions = rays_in_rig(rig, views)
    seen = track >= 0
    points = intersect_rays(centres[seen], directions[seen], track[seen], int(track.max(initial=-1)) + 1)
    by_camera = dict(zip(views, np.split(track, np.cumsum(sizes)[:-1]), strict=True))
    good = _consistent(rig, views, points, by_camera, options.tolerance_px)
    renumbered = np.append(np.where(good, np.cumsum(good) - 1, -1), -1)
    return Cloud(
        points=points[good],
        point_of={camera: renumbered[which] for camera, which in by_camera.items()},
        matches=tuple(matches),
    )


def _subset(features: Features, indices: Int[np.ndarray, "k"]) -> Features:
    """Some of the keypoints."""
    return Features(
        pixels=features.pixels[indices],
        descriptors=features.descriptors[indices],
        colors=features.colors[indices],
    )


def _best_known(cloud: Cloud, view: IndexedFeatures, camera: str, count: int) -> Int[np.ndarray, "k"]:
    """Keypoints that have a point, well spread, those whose points most cameras saw first."""
    known = np.flatnonzero(cloud.point_of[camera] >= 0)
    sightings = np.bincount(np.concatenate([p[p >= 0] for p in cloud.point_of.values()]), minlength=1)
    strength = sightings[cloud.point_of[camera][known]].astype(np.float64)
    return known[select_evenly(view.features.pixels[known], strength, count, _CELL_PX)]


def _sightings(
    rig: Rig, cloud: Cloud, source: FrameFeatures, target: FrameFeatures, options: OdometryOptions
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 2"], Int[np.ndarray, "k"]]:
    """Points of a cloud, where the cameras of another frame see them (px), and the index of that camera in the rig."""
    points, pixels, cameras = [np.zeros((0, 3))], [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    for index, camera in enumerate(rig.names):
        if camera not in source or camera not in target:
            continue
        known = _best_known(cloud, source[camera], camera, options.max_per_camera)
        found = match_unguided(_subset(source[camera].features, known), target[camera].features, options.unguided)
        points.append(cloud.points[cloud.point_of[camera][known[found[:, 0]]]])
        pixels.append(target[camera].features.pixels[found[:, 1]])
        cameras.append(np.full(len(found), index))
    return np.concatenate(points), np.concatenate(pixels), np.concatenate(cameras)


def polish(
    rig: Rig,
    rig_from_world: Rigid3,
    points: Float[np.ndarray, "k 3"],
    pixels: Float[np.ndarray, "k 2"],
    cameras: Int[np.ndarray, "k"],
    limit_px: float,
) -> tuple[Rigid3, int]:
    """The best-fitting pose near a given one, rounded, and the number of sightings that lie within ``limit_px`` of it:
    Gauss-Newton over all sightings with weights that fall to zero there.

    COLMAP's estimate, and what it takes for outliers, differ from call to call, and its refinement stops some
    nanometres before the optimum.
    """
    unit_mm = float(np.linalg.norm(points, axis=1).mean())
    scale = np.array([1.0, 1.0, 1.0, unit_mm, unit_mm, unit_mm])
    mounted = list(rig.cameras.values())
    models, lenses = stack_lenses([each.camera for each in mounted])
    rotations = np.array([each.cam_from_rig.rotation for each in mounted])
    translations = np.array([each.cam_from_rig.translation for each in mounted])
    pose, within = rig_from_world, 0
    for _ in range(_POLISHING_ROUNDS):
        at = pose.rotation, pose.translation
        matrix, gradient, within = pose_equations(
            models, lenses, rotations, translations, at, points, pixels, cameras, limit_px
        )
        step = np.linalg.lstsq(scale[:, None] * matrix * scale, -scale * gradient, rcond=None)[0]
        pose = Rigid3.from_rotation_vector(step[:3], unit_mm * step[3:]) @ pose
        if np.abs(step).max() < _SETTLED:
            break
    rounded_mm = unit_mm * (pose.translation / unit_mm).round(_DECIMALS)
    return Rigid3.from_rotation_vector(pose.rotation_vector.round(_DECIMALS), rounded_mm), within


def relative_pose(
    rig: Rig, cloud: Cloud, source: FrameFeatures, target: FrameFeatures, options: OdometryOptions, seed: int
) -> Edge:
    """Pose of the target frame relative to the frame of the point cloud."""
    points, pixels, cameras = _sightings(rig, cloud, source, target, options)
    if len(points) < options.min_matches:
        return Edge(target_from_source=None, matches=len(points), sought=len(points))
    found = find_rig_pose(rig, points, pixels, cameras, error_px=options.error_px, seed=seed)
    if found is None:
        return Edge(target_from_source=None, matches=0, sought=len(points))
    pose, inliers = polish(rig, found, points, pixels, cameras, options.error_px)
    enough = inliers >= max(options.min_matches, options.min_share * len(points))
    return Edge(target_from_source=pose if enough else None, matches=inliers, sought=len(points))


def _parts(edges: Mapping[tuple[int, int], Edge], count: int) -> Int[np.ndarray, "f"]:
    """For each frame the number of the connected part it belongs to."""
    tied = [pair for pair, edge in edges.items() if edge.target_from_source is not None]
    return parts_of(np.array(tied, dtype=np.int64).reshape(-1, 2), count)


def find_edges(
    rig: Rig, frames: Sequence[FrameFeatures], clouds: Sequence[Cloud], options: OdometryOptions, seed: int
) -> dict[tuple[int, int], Edge]:
    """Relative poses of neighbouring frames (+1) and, between components that are still unconnected, at +2 and
    farther."""

    def find(pair: tuple[int, int]) -> Edge:
        i, j = pair
        return relative_pose(rig, clouds[i], frames[i], frames[j], options, seed + i)

    edges: dict[tuple[int, int], Edge] = {}
    for step in range(1, options.reach + 1):
        part = _parts(edges, len(frames))
        open_pairs = [(i, i + step) for i in range(len(frames) - step) if part[i] != part[i + step]]
        edges.update(zip(open_pairs, map_in_threads(find, open_pairs), strict=True))
    return edges


def _reason(
    frame: int, part: Int[np.ndarray, "f"], edges: Mapping[tuple[int, int], Edge], options: OdometryOptions
) -> str:
    """Why a frame is not in the largest part."""
    fellows = int(np.sum(part == part[frame]))
    if fellows > 1:
        return f"with {fellows - 1} others in a part of the scan that nothing connects to the rest"
    most = max((edge.matches for pair, edge in edges.items() if frame in pair), default=0)
    if most >= options.min_matches:
        return f"only {most} of its matches to its neighbours agree; too small a share"
    return f"only {most} matches to its neighbours; {options.min_matches} are needed"


def chain(edges: Mapping[tuple[int, int], Edge], names: Sequence[str], options: OdometryOptions) -> Trajectory:
    """Poses of the largest component, by following the edges from its first frame."""
    part = _parts(edges, len(names))
    largest = int(np.argmax(np.bincount(part)))
    located = np.flatnonzero(part == largest)
    tied = {pair: edge.target_from_source for pair, edge in edges.items() if edge.target_from_source is not None}
    rows = np.array([*tied, *((j, i) for i, j in tied)], dtype=np.int64).reshape(-1, 2)
    order, before = breadth_first_order(graph_of(rows, len(names)).tocsr(), int(located[0]))
    poses = {int(located[0]): Rigid3.identity()}
    for j in order[1:].tolist():
        i = int(before[j])
        forward = tied.get((i, j)) or tied[j, i].inverse()
        poses[j] = forward @ poses[i]
    return Trajectory(
        rig_from_world={int(frame): poses[int(frame)] for frame in located},
        dropped=tuple(
            Dropped(what=f"frame {name}", reason=_reason(index, part, edges, options))
            for index, name in enumerate(names)
            if part[index] != largest
        ),
    )
