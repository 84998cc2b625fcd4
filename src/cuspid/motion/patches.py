"""Tracks of one camera, followed by patch alignment into the frames where none of their keypoints was found.

Keypoints on plain enamel come and go: their tracks are short and their positions uncertain by about a pixel, so an arch
bends. Once the poses are known, the patch around each point, from the frame that shows it nearest to the image centre,
is projected into the neighbouring frames where it should be seen, and shifted until it fits (Lucas and Kanade 1981,
with the template's gradients, Baker and Matthews 2004; gain, offset and slope of the light are free).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, NamedTuple, no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from cuspid.camera import OPENCV_PIXEL_OFFSET
from cuspid.kernels import kernel
from cuspid.options import Options, Range
from cuspid.progress import Progress, silent
from cuspid.reconstruction import Tracks
from cuspid.sparse_model import SparseModel
from cuspid.workers import map_in_threads

_LEAST_CONTRAST = 0.5
"""Standard deviation of the grey levels of a patch, below which it carries no information."""
_LEAST_AREA = 1e-3
"""Smallest area of the image of a patch, as a share of its own, that can be aligned."""
_STILL_PX = 0.003
"""The alignment ends when a step is shorter than this."""


@dataclass(frozen=True, kw_only=True)
class AlignmentOptions(Options):
    """How patches are aligned, and what counts as found."""

    radius_px: Annotated[int, Range(1, 100)] = 7
    """Half the width of a patch."""
    blur_px: Annotated[float, Range(0, 100)] = 1.0
    """Standard deviation of the Gaussian filter that is first applied to the images."""
    limit_px: Annotated[float, Range(0.01, 1000)] = 3.0
    """Largest distance from the predicted position."""
    correlation: Annotated[float, Range(-1, 1)] = 0.85
    """Minimum correlation (-1 to 1) between the patch and the place where it is found."""
    iterations: Annotated[int, Range(1, 10_000)] = 15
    """Maximum number of steps of an alignment."""


@dataclass(frozen=True, kw_only=True)
class PatchOptions(AlignmentOptions):
    """Which patches are followed, and what counts as found."""

    reach: Annotated[int, Range(1, 10_000)] = 12
    """A patch is searched for in this many frames before and after its own."""
    turn_deg: Annotated[float, Range(0, 180)] = 40.0
    """Frames whose direction of view differs by more than this are skipped."""
    minimum_views: Annotated[int, Range(2, 1000)] = 4
    """Points that are found in fewer frames are left unchanged."""


def smooth(picture: UInt8[np.ndarray, "h w"], sigma_px: float) -> Float32[np.ndarray, "h w"]:
    """Grey levels, smoothed against the noise of single pixels."""
    levels = picture.astype(np.float32)
    return levels if sigma_px == 0 else np.asarray(cv2.GaussianBlur(levels, (0, 0), sigma_px))


@kernel
@no_type_check
def _at(image, x, y):
    """Bilinear; NaN outside."""
    height, width = image.shape
    if not (0 <= x < width - 1 and 0 <= y < height - 1):
        return np.nan
    i, j = int(x), int(y)
    a, b = x - i, y - j
    top = (1 - a) * image[j, i] + a * image[j, i + 1]
    return (1 - b) * top + b * ((1 - a) * image[j + 1, i] + a * image[j + 1, i + 1])


@kernel
@no_type_check
def _cut(image, places, patches):
    """Fill in the levels around places; NaN outside."""
    side = patches.shape[1]
    for n in range(len(places)):
        for j in range(side):
            for i in range(side):
                patches[n, j, i] = _at(image, places[n, 0] + i - side // 2, places[n, 1] + j - side // 2)


@kernel
@no_type_check
def _flatten(levels, radius):
    """Take the plane that fits the levels of a patch best out of them: offset and slope of the light."""
    total = across = down = square = 0.0
    k = 0
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            total += levels[k]
            across += dx * levels[k]
            down += dy * levels[k]
            square += dx * dx
            k += 1
    total, across, down = total / k, across / square, down / square
    k = 0
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            levels[k] -= total + across * dx + down * dy
            k += 1


@kernel
@no_type_check
def _template(patch, levels, slopes):
    """Fill in the levels of a patch less the plane through them, and their slopes; their standard deviation, NaN where
    it reaches over the border."""
    k, side = 0, len(patch)
    for j in range(1, side - 1):
        for i in range(1, side - 1):
            levels[k] = patch[j, i]
            slopes[k, 0] = (patch[j, i + 1] - patch[j, i - 1]) / 2
            slopes[k, 1] = (patch[j + 1, i] - patch[j - 1, i]) / 2
            k += 1
    _flatten(levels, side // 2 - 1)
    _flatten(slopes[:, 0], side // 2 - 1)
    _flatten(slopes[:, 1], side // 2 - 1)
    return np.sqrt((levels**2).mean()) + 0 * slopes.sum()


@kernel
@no_type_check
def _aligned(patches, image, there, warps, limit, iterations, shifts, correlations):
    """Fill in for every patch its shift from where it should be, and the correlation there; NaN where it is lost."""
    radius = patches.shape[1] // 2 - 1
    count = (2 * radius + 1) ** 2
    levels, slopes, found = np.empty(count), np.empty((count, 2)), np.empty(count)
    for n in range(len(there)):
        shifts[n] = 0.0
        correlations[n] = np.nan
        spread = _template(patches[n], levels, slopes)
        if not spread > _LEAST_CONTRAST:
            continue
        warp = warps[n]
        area = warp[0, 0] * warp[1, 1] - warp[0, 1] * warp[1, 0]
        if not abs(area) > _LEAST_AREA:
            continue
        slopes_there = slopes @ np.linalg.inv(warp)
        square = slopes_there.T @ slopes_there
        determinant = square[0, 0] * square[1, 1] - square[0, 1] ** 2
        if determinant <= 1e-6 * (square[0, 0] + square[1, 1]) ** 2:
            continue
        x, y = there[n, 0], there[n, 1]
        for _ in range(iterations):
            k = 0
            for dy in range(-radius, radius + 1):
                for dx in range(-radius, radius + 1):
                    found[k] = _at(image, x + warp[0, 0] * dx + warp[0, 1] * dy, y + warp[1, 0] * dx + warp[1, 1] * dy)
                    k += 1
            _flatten(found, radius)
            power, common = (found**2).sum(), (found * levels).sum()
            correlations[n] = common / (np.sqrt(power * count) * spread + 1e-9)
            off = slopes_there.T @ (levels - common / (power + 1e-9) * found)
            step_x = (square[1, 1] * off[0] - square[0, 1] * off[1]) / determinant
            step_y = (square[0, 0] * off[1] - square[0, 1] * off[0]) / determinant
            x, y = x + step_x, y + step_y
            if not (x - there[n, 0]) ** 2 + (y - there[n, 1]) ** 2 <= limit**2:
                correlations[n] = np.nan
                break
            if step_x**2 + step_y**2 < _STILL_PX**2:
                break
        shifts[n, 0], shifts[n, 1] = x - there[n, 0], y - there[n, 1]


def cut_patches(
    picture: Float32[np.ndarray, "h w"], places_px: Float[np.ndarray, "n 2"], radius_px: int
) -> Float32[np.ndarray, "n s s"]:
    """The patches around positions in an image, one px larger on each side, for their gradients; NaN outside."""
    patches = np.empty((len(places_px), 2 * radius_px + 3, 2 * radius_px + 3), dtype=np.float32)
    _cut(picture, np.ascontiguousarray(places_px - OPENCV_PIXEL_OFFSET), patches)
    return patches


def align_patches(
    patches: Float32[np.ndarray, "n s s"],
    picture: Float32[np.ndarray, "h w"],
    there_px: Float[np.ndarray, "n 2"],
    warps: Float[np.ndarray, "n 2 2"],
    options: AlignmentOptions,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
    """Positions of patches (:func:`cut_patches`) in another image, px, and their correlation there (NaN where they are
    not found).

    ``warps`` map an offset from the middle of a patch to the one in the other image; ``there_px`` are the starting
    positions.
    """
    shifts, correlations = np.empty_like(there_px), np.empty(len(there_px))
    start = np.ascontiguousarray(there_px - OPENCV_PIXEL_OFFSET)
    _aligned(
        *(patches, picture, start, np.ascontiguousarray(warps)),
        *(options.limit_px, options.iterations, shifts, correlations),
    )
    return there_px + shifts, correlations


class _Poses(NamedTuple):
    """The poses as arrays."""

    rotations: np.ndarray
    shifts: np.ndarray

    @staticmethod
    def of(model: SparseModel) -> _Poses:
        """``cam_from_world`` of all frames."""
        poses = list(model.cam_from_world.values())
        return _Poses(np.stack([pose.rotation for pose in poses]), np.array([pose.translation for pose in poses]))

    def inside(self, frame: int, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points in the camera of a frame."""
        return points @ self.rotations[frame].T + self.shifts[frame]

    def directions(self, frame: int, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Unit vectors from points to the camera."""
        towards = -self.rotations[frame].T @ self.shifts[frame] - points
        return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def lengthen(
    model: SparseModel,
    read: Callable[[str], UInt8[np.ndarray, "h w"]],
    options: PatchOptions,
    *,
    progress: Progress = silent,
) -> SparseModel:
    """The model of one camera with a second track for each point whose patch was found in enough frames.

    ``read`` returns the image of a frame, given its name; only those within reach are in memory at a time.
    """
    own = _own_observations(model)
    tracks, names = model.tracks, model.frames
    poses, pictures = _Poses.of(model), dict[int, np.ndarray]()
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for frame in range(len(names)):
        near = range(max(0, frame - options.reach), min(len(names), frame + options.reach + 1))
        kept = {other: pictures[other] for other in near if other in pictures}
        pictures = kept | {n: smooth(read(names[n]), options.blur_px) for n in near if n not in kept}
        mine = np.flatnonzero(tracks.frame_index[own] == frame)
        patches = cut_patches(pictures[frame], tracks.pixels[own[mine]], options.radius_px)
        follow = partial(_follow, model, poses, pictures, frame, mine, patches, options)
        found += [
            (mine, np.full(len(mine), frame), tracks.pixels[own[mine]]),
            *map_in_threads(follow, [other for other in near if other != frame]),
        ]
        progress("patches", frame + 1, len(names))
    point, seen_in, pixels = (np.concatenate(each) for each in zip(*found, strict=True))
    return replace(model, tracks=_with_second(tracks, point, seen_in, pixels, options))


def _own_observations(model: SparseModel) -> Int[np.ndarray, "p"]:
    """The observation of each point that is nearest to the middle of its frame."""
    tracks, camera = model.tracks, model.camera
    off = np.linalg.norm(tracks.pixels - np.array([camera.width, camera.height]) / 2, axis=1)
    order = np.lexsort((off, tracks.point_index))
    return np.asarray(order[np.unique(tracks.point_index[order], return_index=True)[1]])


def _follow(
    model: SparseModel,
    poses: _Poses,
    pictures: Mapping[int, np.ndarray],
    here: int,
    mine: Int[np.ndarray, "k"],
    patches: Float32[np.ndarray, "k s s"],
    options: PatchOptions,
    there: int,
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"], Float[np.ndarray, "m 2"]]:
    """Of the points ``mine`` of one frame those found in another: points, frames, pixels."""
    camera, points = model.camera, model.tracks.points[mine]
    turn = np.sum(poses.directions(here, points) * poses.directions(there, points), axis=1)
    depth = poses.inside(here, points)[:, 2]
    expected = camera.project(poses.inside(there, points))
    seen = camera.contains(expected, 2.0 * options.radius_px) & (turn > np.cos(np.deg2rad(options.turn_deg)))
    points, mine, expected = points[seen], mine[seen], expected[seen]
    step = (depth[seen] / float(np.mean(camera.focal_px)))[:, None]
    beside = [camera.project(poses.inside(there, points + poses.rotations[here][axis] * step)) for axis in (0, 1)]
    warps = np.stack([each - expected for each in beside], axis=-1)
    pixels, correlation = align_patches(patches[seen], pictures[there], expected, warps, options)
    good = correlation > options.correlation
    return mine[good], np.full(int(good.sum()), there), pixels[good]


def _with_second(
    tracks: Tracks,
    point: Int[np.ndarray, "m"],
    frame: Int[np.ndarray, "m"],
    pixels: Float[np.ndarray, "m 2"],
    options: PatchOptions,
) -> Tracks:
    """The tracks, and behind them those of the patches."""
    enough = np.bincount(point, minlength=len(tracks.points))[point] >= options.minimum_views
    kept, number = np.unique(point[enough], return_inverse=True)
    return Tracks(
        points=np.concatenate([tracks.points, tracks.points[kept]]),
        colors=np.concatenate([tracks.colors, tracks.colors[kept]]),
        point_index=np.concatenate([tracks.point_index, len(tracks.points) + number]),
        frame_index=np.concatenate([tracks.frame_index, frame[enough]]),
        camera_index=np.concatenate([tracks.camera_index, np.zeros(int(enough.sum()), np.int64)]),
        pixels=np.concatenate([tracks.pixels, pixels[enough]]),
    )
