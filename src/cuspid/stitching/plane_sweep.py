"""A dense surface under the occlusal plane, by sweeping horizontal planes through images.

On each plane z = const all images are laid down as if the surface were there (Collins 1996); where it is, images from
different places agree. What agrees is the zero-mean normalised cross-correlation (ZNCC) of small windows, averaged over
all pairs of images a stereo baseline apart, frames of one camera or cameras of one instant: of their grey levels, which
tell the outlines of crowns and the gum, and of their fine detail alone, because the broad light and shade of a lamp
that goes along with the camera moves over the surface and pulls what is matched by it below the crowns. Cameras of one
instant see the same light and shade: there it is the brightness itself that agrees. The height of each cell then
follows from semi-global optimisation (Hirschmueller 2008) over the volume of places and heights.

The volume grows with the arch; of the frames only a few are held at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from skimage.morphology import remove_small_holes, remove_small_objects
from skimage.restoration import inpaint_biharmonic

from cuspid.camera import OPENCV_PIXEL_OFFSET, Camera, undistortion_maps
from cuspid.capture import Frame
from cuspid.errors import InputError
from cuspid.geometry import Rigid3
from cuspid.options import Options, Range
from cuspid.progress import Progress, silent
from cuspid.reconstruction import Reconstruction
from cuspid.semi_global import semi_global
from cuspid.sparse_model import SparseModel
from cuspid.stitching.height_map import HOLE_MM2, HeightMap
from cuspid.stitching.mosaic import BURNT, brightest, footprint
from cuspid.workers import map_in_threads

_BLOCK, _REACH = 24, 14
"""Frames that are paired at a time, and how many frames later a partner may be."""
_NOISE_DN = 1.0
"""Contrast (standard deviation in grey levels) below which there is nothing to agree on."""
_DETAIL = 4
"""Fine detail is held in so many steps to a grey level."""
_LIT, _UNLIKE_DN, _ALIKE_CELLS = 24, 6.0, 3
"""Cameras of one instant: grey level above which there is light, difference of grey levels beyond which two places are
not alike, and the width over which that is averaged."""
_METERED, _USUAL_DN = 40, (40, 230)
"""Images of each camera whose brightness is compared, and grey levels that are."""
_DARKEST = 16
"""Grey levels below are raised to this one: noise."""
_SPECK_MM2 = 4.0
"""Smaller islands of what is known are taken for nothing."""
_RIM_CELLS = 2
"""So wide is the rim of a hole whose heights are not trusted either."""
_ABOVE_MM = 1.5
"""The surface is looked for no higher above the smooth one through the points: highlights would have it there."""
_GLARE_PX = 9
"""Width of the filter that widens highlights: they go along with the camera, as if they lay off the surface."""
_GLARE_WEIGHT = 0.1
"""What a pair of frames counts for where a highlight burns in one of them."""
_PAIRS = 1.0
"""So many pairs without any agreement are added, so that what few saw counts little."""
_POOL = 2
"""Cells of the plane sweep to one cell of the height map, in each direction."""


@dataclass(frozen=True, kw_only=True)
class PlaneSweepOptions(Options):
    """The dense surface."""

    enabled: bool = True
    """Whether to compute it; otherwise a smooth surface through the sparse points of the motion is used."""
    cell_mm: Annotated[float, Range(0.01, 10)] = 0.1
    """Spacing of the places at which frames are compared, but at least one pixel; that of the height map is twice as
    large."""
    step_mm: Annotated[float, Range(0.01, 10)] = 0.2
    """Distance between the planes, but at least what shifts the compared frames by half a pixel."""
    depth_mm: Annotated[float, Range(0.1, 100)] = 11.0
    """Depth of the lowest plane below the occlusal plane."""
    window: Annotated[int, Range(3, 101)] = 5
    """Side of the compared window, in cells."""
    detail_px: Annotated[float, Range(0.1, 1000)] = 4.0
    """Fine detail is what a Gaussian filter of this standard deviation removes from a frame, px."""
    baseline_share: Annotated[float, Range(0.001, 10)] = 0.2
    """Baseline of the frames that are compared, as a share of the distance to the teeth (approximate)."""
    small_jump: Annotated[float, Range(0, 1000)] = 0.03
    """Penalty for a height that differs by one plane from its neighbour's; matching costs lie between 0 (full
    agreement) and 1."""
    large_jump: Annotated[float, Range(0, 1000)] = 0.5
    """Penalty for a height that differs by more."""
    smoothing_mm: Annotated[float, Range(0.001, 100)] = 0.24
    """Standard deviation of the Gaussian filter over the heights."""
    agreement: Annotated[float, Range(-1, 1)] = 0.15
    """Places where the frames agree less than this (0 to 1, by ZNCC) at the height found count as unknown."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window % 2 == 0:
            raise InputError(f"plane sweep: --window is {self.window}; it must be odd")
        if not self.small_jump <= self.large_jump:
            raise InputError("plane sweep: a large jump must cost no less than a small one")


# --- which frames are compared -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class Compared:
    """Images, where they were taken from, and which of them are compared."""

    names: tuple[str, ...]
    """By which the images are read, in order of capture."""
    cameras: tuple[Camera, ...]
    cam_from_world: tuple[Rigid3, ...]
    pairs: tuple[tuple[int, int], ...]
    """Each a stereo baseline apart; a later image is second."""
    baseline_share: float
    """Baseline as a share of the distance to the teeth (approximate)."""
    same_lights: bool
    """Whether the two images of a pair were taken at one instant: a place is then as bright in one as in the other."""

    def seen_from(self, world_from_new: Rigid3) -> Compared:
        """The same in another world."""
        return replace(self, cam_from_world=tuple(pose @ world_from_new for pose in self.cam_from_world))


def frames_beside(motion: SparseModel, share: float) -> Compared:
    """The frames of one camera, each with a later one a stereo baseline from it."""
    names = motion.frames
    poses = tuple(motion.cam_from_world.values())
    return Compared(
        names=names,
        cameras=(motion.camera,) * len(names),
        cam_from_world=poses,
        pairs=tuple(partners(motion, share).items()),
        baseline_share=share,
        same_lights=False,
    )


def cameras_beside(
    found: Reconstruction, frames: Iterable[Frame], pairs: Sequence[tuple[str, str]], distance_mm: float
) -> Compared:
    """The images that two cameras of a rig took of the teeth at one instant, named ``camera/frame``. The same lights
    were on for both, so that their light and shade are of the surface."""
    located = [frame for frame in frames if frame.name in found.rig_from_world]
    together = [
        ((frame.name, one), (frame.name, other))
        for frame in located
        for one, other in pairs
        if one in frame.cameras and other in frame.cameras
    ]
    images = sorted({image for pair in together for image in pair}, key=_in_order(located, found.rig.names))
    place = {image: number for number, image in enumerate(images)}
    apart = [np.linalg.norm(np.diff([found.rig[name].centre_in_rig for name in pair], axis=0)) for pair in pairs]
    return Compared(
        names=tuple(f"{name}/{frame}" for frame, name in images),
        cameras=tuple(found.rig[name].camera for _, name in images),
        cam_from_world=tuple(found.rig[name].cam_from_rig @ found.rig_from_world[frame] for frame, name in images),
        pairs=tuple((place[one], place[other]) for one, other in together),
        baseline_share=float(np.median(apart)) / distance_mm,
        same_lights=True,
    )


def _in_order(frames: Sequence[Frame], cameras: Sequence[str]) -> Callable[[tuple[str, str]], tuple[int, int]]:
    """Sorts images, each by the names of its frame and its camera, in order of capture."""
    frame_of = {frame.name: number for number, frame in enumerate(frames)}
    return lambda image: (frame_of[image[0]], cameras.index(image[1]))


def partners(motion: SparseModel, share: float) -> dict[int, int]:
    """For each frame that has one a later frame beside it, whose baseline is nearest to ``share`` of the distance to
    the points (within a factor 1.8), mostly sideways, looking in about the same direction."""
    poses = [pose.inverse() for pose in motion.cam_from_world.values()]
    centres = np.array([pose.translation for pose in poses])
    axes = np.array([pose.rotation[:, 2] for pose in poses])
    wanted = share * float(np.median(motion.depths))
    found: dict[int, int] = {}
    for one in range(len(poses) - 1):
        others = np.arange(one + 1, min(one + 1 + _REACH, len(poses)))
        shift, axis = centres[others] - centres[one], axes[others] + axes[one]
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        along = np.sum(shift * axis, axis=1)
        sideways = np.linalg.norm(shift - along[:, None] * axis, axis=1)
        off = np.abs(np.log(np.maximum(sideways, 1e-9) / wanted))
        alike = (sideways >= 2 * np.abs(along)) & (axes[others] @ axes[one] > np.cos(np.deg2rad(20)))
        off[~alike] = np.inf
        if off.min() < np.log(1.8):
            found[one] = int(others[off.argmin()])
    return found


# --- one plane ---------------------------------------------------------------------------------------------------


class Grid(NamedTuple):
    """Places in the occlusal plane at which frames are compared."""

    corner: Float[np.ndarray, "2"]
    cell_mm: float
    columns: int
    rows: int

    @staticmethod
    def over(motion: SparseModel, cell_mm: float) -> Grid:
        """About the points of a motion, a whole number of pools wide."""
        low, high = np.percentile(motion.tracks.points[:, :2], [0.2, 99.8], axis=0) + [[-4.0], [4.0]]
        columns, rows = (_POOL * np.ceil((high - low) / cell_mm / _POOL)).astype(int).tolist()
        return Grid(low, cell_mm, columns, rows)


class _Field(NamedTuple):
    """Values on a plane, and what they are like around each place."""

    values: np.ndarray
    mean: np.ndarray
    variance: np.ndarray

    @staticmethod
    def of(values: Float32[np.ndarray, "h w"], window: int) -> _Field:
        mean = _mean(values, window)
        return _Field(values, mean, _mean(values * values, window) - mean * mean)

    def cut(self, part: tuple[slice, slice]) -> _Field:
        return _Field(*(each[part] for each in self))


class _Laid(NamedTuple):
    """A frame on a plane, within its window of the grid."""

    low: np.ndarray
    high: np.ndarray
    gray: _Field
    detail: _Field
    weight: np.ndarray

    def part(self, low: np.ndarray, high: np.ndarray) -> tuple[slice, slice]:
        """Rows and columns of this window."""
        (left, top), (right, bottom) = (low - self.low).tolist(), (high - self.low).tolist()
        return slice(top, bottom), slice(left, right)


def _mean(values: Float32[np.ndarray, "h w"], window: int) -> Float32[np.ndarray, "h w"]:
    return np.asarray(cv2.blur(values, (window, window)))


def _window_of(grid: Grid, camera: Camera, pose: Rigid3, z: float) -> tuple[Int[np.ndarray, "2"], Int[np.ndarray, "2"]]:
    """The part of the grid that a frame sees; to no side farther than it would see if it looked straight down."""
    centre, corners = pose.inverse().translation, footprint(camera, pose, z)
    half = (centre[2] - z) * max(camera.width, camera.height) / 2 / float(np.mean(camera.focal_px))
    limits = np.array([grid.columns, grid.rows])
    low = np.maximum(corners.min(axis=0), centre[:2] - half)
    high = np.minimum(corners.max(axis=0), centre[:2] + half)
    low, high = (np.clip(np.floor((end - grid.corner) / grid.cell_mm), 0, limits).astype(int) for end in (low, high))
    return low, high


def _lay(
    grid: Grid, camera: Camera, pose: Rigid3, z: float, image: UInt8[np.ndarray, "h w 3"], window: int
) -> _Laid | None:
    """A frame on the plane at height z; None where it sees nothing of the grid."""
    low, high = _window_of(grid, camera, pose, z)
    if np.any(high - low < window):
        return None
    corner = grid.corner + grid.cell_mm * (low + 0.5)
    place = np.array([[grid.cell_mm, 0, corner[0]], [0, grid.cell_mm, corner[1]], [0, 0, 1]])
    in_camera = np.column_stack([pose.rotation[:, :2], pose.rotation[:, 2] * z + pose.translation]) @ place
    to_pixel = camera.matrix @ in_camera - OPENCV_PIXEL_OFFSET * np.outer([1, 1, 0], in_camera[2])
    size, flags = (high - low).tolist(), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    laid = cv2.warpPerspective(image, to_pixel, size, flags=flags).astype(np.float32)
    gray, detail, weight = (np.ascontiguousarray(laid[..., channel]) for channel in range(3))
    weight = cv2.erode(weight, np.ones((window, window), np.uint8), borderValue=0)
    return _Laid(low, high, _Field.of(gray, window), _Field.of(detail, window), weight / 255)


def _zncc(one: _Field, other: _Field, noise: float, window: int) -> Float32[np.ndarray, "h w"]:
    """What two fields agree, 0 to 1; little where their contrast is not above the noise."""
    common = _mean(one.values * other.values, window) - one.mean * other.mean
    power = (np.maximum(one.variance, 0) + noise**2) * (np.maximum(other.variance, 0) + noise**2)
    return np.clip(common / np.sqrt(power), 0, 1)


def _alike(one: Float32[np.ndarray, "h w"], other: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """How alike two images are in brightness, 0 to 1; 0 where it is dark, which looks alike at any height."""
    lit = np.minimum(one, other) > _LIT
    return np.asarray(cv2.blur(np.clip(1 - np.abs(one - other) / _UNLIKE_DN, 0, 1) * lit, (_ALIKE_CELLS,) * 2))


def _agreed(
    one: _Laid, a: tuple[slice, slice], other: _Laid, b: tuple[slice, slice], window: int, same_lights: bool
) -> Float32[np.ndarray, "h w"]:
    """What two images agree on parts of a plane, 0 to 1."""
    detail = _zncc(one.detail.cut(a), other.detail.cut(b), _DETAIL * _NOISE_DN, window)
    if same_lights:
        return (2 * _alike(one.gray.values[a], other.gray.values[b]) + detail) / 3
    gray = _zncc(one.gray.cut(a), other.gray.cut(b), _NOISE_DN, window)
    return (gray * gray + detail) / 2


def _add_agreement(
    one: _Laid, other: _Laid, window: int, same_lights: bool, agreement: np.ndarray, pairs: np.ndarray
) -> None:
    """Add what two images agree on a plane, and where both see it, to the sums over the grid."""
    low, high = np.maximum(one.low, other.low), np.minimum(one.high, other.high)
    if np.any(high <= low):
        return
    a, b = one.part(low, high), other.part(low, high)
    weight = np.minimum(one.weight[a], other.weight[b])
    here = slice(low[1], high[1]), slice(low[0], high[0])
    agreement[here] += weight * _agreed(one, a, other, b, window, same_lights)
    pairs[here] += weight


# --- all planes --------------------------------------------------------------------------------------------------


def camera_gains(names: Sequence[str], read: Callable[[str], UInt8[np.ndarray, "h w 3"]]) -> dict[str, float]:
    """How much brighter each camera shows the same surface than the first one, from images ``camera/frame`` in order of
    capture: cameras of one instant see about the same, under the same lights."""
    images = dict[str, list[str]]()
    for name in names:
        images.setdefault(name.rpartition("/")[0], []).append(name)
    instants = slice(None, None, max(1, len(names) // len(images) // _METERED))
    levels = {camera: np.log([_usual_level(read(name)) for name in each[instants]]) for camera, each in images.items()}
    first = next(iter(levels.values()))
    ratios = {camera: each - first for camera, each in levels.items()}
    return {c: float(np.exp(np.nanmedian(each))) if np.isfinite(each).any() else 1.0 for c, each in ratios.items()}


def _usual_level(image: UInt8[np.ndarray, "h w 3"]) -> float:
    """Mean grey level of what is neither dark nor burnt out; NaN where there is nothing."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[::4, ::4]
    usual = gray[(gray > _USUAL_DN[0]) & (gray < _USUAL_DN[1])]
    return float(usual.mean()) if len(usual) else float("nan")


def _compared(
    image: UInt8[np.ndarray, "h w 3"], maps: tuple[np.ndarray, np.ndarray] | None, gain: float, detail_px: float
) -> UInt8[np.ndarray, "h w 3"]:
    """What is compared of a frame, as a camera without distortion sees it: its grey levels, their fine detail (times
    `_DETAIL`, about 128), and what they count for (times 255): in one picture, for that is laid down fastest."""
    gray = cv2.convertScaleAbs(np.maximum(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), _DARKEST), alpha=1 / gain)
    detail = gray - cv2.GaussianBlur(gray.astype(np.float32), (0, 0), detail_px)
    glare = cv2.dilate((brightest(image) >= BURNT).astype(np.uint8), np.ones((_GLARE_PX, _GLARE_PX), np.uint8))
    weight = np.where(glare > 0, 255 * _GLARE_WEIGHT, 255)
    picture = np.dstack([gray, np.clip(128 + _DETAIL * detail, 0, 255), weight]).astype(np.uint8)
    return picture if maps is None else np.asarray(cv2.remap(picture, *maps, cv2.INTER_LINEAR))


def plane_sweep(
    motion: SparseModel,
    compared: Compared,
    sparse: HeightMap,
    read: Callable[[str], UInt8[np.ndarray, "h w 3"]],
    options: PlaneSweepOptions,
    *,
    progress: Progress = silent,
) -> HeightMap | None:
    """The surface on which images agree, in the occlusal frame; None where no two of them are compared.

    ``motion`` tells where the teeth are; ``sparse`` is the smooth surface through its points, which tells how high they
    reach; ``read`` gives an image by its name.
    """
    if not compared.pairs:
        return None
    grid, levels = _places(motion, float(sparse.heights.max()) + _ABOVE_MM, compared.baseline_share, options)
    volume = _agreement(compared, grid, levels, read, options, progress)
    cell_mm = _POOL * grid.cell_mm
    corner, (rows, columns) = grid.corner + cell_mm / 2, volume.shape[1:]
    places = corner + cell_mm * np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    volume[levels[:, None, None] > sparse.at(places) + _ABOVE_MM] = 0
    cost = np.ascontiguousarray(np.moveaxis(1 - volume, 0, -1))
    plane = semi_global(cost, options.small_jump, options.large_jump)
    at = np.clip(np.rint(plane), 0, len(levels) - 1).astype(int)
    certainty = cv2.blur(np.take_along_axis(volume, at[None], axis=0)[0], (5, 5))
    heights = cv2.medianBlur(np.interp(plane, np.arange(len(levels)), levels).astype(np.float32), 5)
    sure = remove_small_objects(certainty >= options.agreement, max_size=round(_SPECK_MM2 / cell_mm**2))
    known = remove_small_holes(sure, max_size=round(HOLE_MM2 / cell_mm**2))
    heights = _bridged(heights, known & ~sure)
    return HeightMap(
        corner=corner,
        cell_mm=cell_mm,
        heights=np.asarray(cv2.GaussianBlur(heights, (0, 0), options.smoothing_mm / cell_mm)),
        known=np.asarray(known),
    )


def _places(
    motion: SparseModel, top: float, baseline_share: float, options: PlaneSweepOptions
) -> tuple[Grid, Float[np.ndarray, "d"]]:
    """Where frames are compared: the cells, and the heights of the planes; not closer than pixels tell apart."""
    camera = motion.camera
    pixel_mm = float(np.median(motion.depths) / np.mean(camera.focal_px))
    step_mm = max(options.step_mm, 0.5 * pixel_mm / baseline_share)
    levels = np.arange(-options.depth_mm, top + step_mm, step_mm)
    return Grid.over(motion, max(options.cell_mm, pixel_mm)), levels


def _bridged(heights: Float32[np.ndarray, "r c"], holes: Bool[np.ndarray, "r c"]) -> Float32[np.ndarray, "r c"]:
    """Heights that span the holes smoothly: where a highlight leaves nothing to agree on, those found are false."""
    wide = cv2.dilate(holes.astype(np.uint8), np.ones((2 * _RIM_CELLS + 1,) * 2, np.uint8)) > 0
    return np.asarray(inpaint_biharmonic(heights, wide, split_into_regions=True), dtype=np.float32)


def _agreement(
    compared: Compared,
    grid: Grid,
    levels: Float[np.ndarray, "d"],
    read: Callable[[str], UInt8[np.ndarray, "h w 3"]],
    options: PlaneSweepOptions,
    progress: Progress,
) -> Float32[np.ndarray, "d r c"]:
    """Mean agreement (0 to 1) of the pairs of images that see a place, at each height; the less, the fewer they are."""
    cameras, poses, names = compared.cameras, compared.cam_from_world, compared.names
    maps, window = {camera: undistortion_maps(camera) for camera in cameras}, options.window
    gains = camera_gains(names, read) if compared.same_lights else {}

    def picture(image: int) -> UInt8[np.ndarray, "h w 3"]:
        name, camera = names[image], cameras[image]
        return _compared(read(name), maps[camera], gains.get(name.rpartition("/")[0], 1.0), options.detail_px)

    sums, counts = np.zeros((2, len(levels), grid.rows // _POOL, grid.columns // _POOL), np.float32)

    def look(block: Sequence[tuple[int, int]], images: Mapping[int, UInt8[np.ndarray, "h w 3"]], level: int) -> None:
        agreement, seen = np.zeros((2, grid.rows, grid.columns), np.float32)
        laid = {
            frame: _lay(grid, cameras[frame], poses[frame], float(levels[level]), each, window)
            for frame, each in images.items()
        }
        for one, other in block:
            first, second = laid[one], laid[other]
            if first is not None and second is not None:
                _add_agreement(first, second, window, compared.same_lights, agreement, seen)
        size = sums.shape[:0:-1]
        sums[level] += cv2.resize(agreement, size, interpolation=cv2.INTER_AREA)
        counts[level] += cv2.resize(seen, size, interpolation=cv2.INTER_AREA)

    for start in range(0, len(names), _BLOCK):
        block = [pair for pair in compared.pairs if start <= pair[0] < start + _BLOCK]
        wanted = sorted({image for pair in block for image in pair})
        images = {frame: picture(frame) for frame in wanted}
        map_in_threads(partial(look, block, images), range(len(levels)))
        progress("surface", min(start + _BLOCK, len(names)), len(names))
    return sums / (counts + np.float32(_PAIRS))
