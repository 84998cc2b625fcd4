"""A dense surface under the occlusal plane, by sweeping surfaces through images.

On each plane z = const all images are laid down as if the surface were there (Collins 1996); where it is, images from
different places agree. What agrees is the zero-mean normalised cross-correlation (ZNCC) of small windows, averaged over
all pairs of images a stereo baseline apart, frames of one camera or cameras of one instant: of their grey levels, which
tell the outlines of crowns and the gum, and of their fine detail alone, because the broad light and shade of a lamp
that goes along with the camera moves over the surface and pulls what is matched by it below the crowns. Cameras of one
instant see the same light and shade: there it is the brightness itself that agrees. The height of each cell then
follows from semi-global optimisation (Hirschmueller 2008) over the volume of places and heights.

Windows on a plane are wrong where the surface is steep, and its slope determines the light it loses on the way to each
camera (see :mod:`cuspid.mvs.glare`). Therefore the same is done again, twice, with finer steps, on copies of the
surface found before that lie a little higher and lower.

The volume grows with the arch; only some of the frames are in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, NamedTuple, no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from skimage.morphology import remove_small_holes, remove_small_objects
from skimage.restoration import inpaint_biharmonic

from cuspid.geometry import Rigid3
from cuspid.geometry.gloss import transmittance
from cuspid.geometry.semi_global import semi_global
from cuspid.model.camera import Camera, undistortion_maps
from cuspid.model.sparse_model import SparseModel
from cuspid.runtime.errors import InputError
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads
from cuspid.stitching.compared import Compared, camera_gains
from cuspid.stitching.height_map import HOLE_MM2, HeightMap
from cuspid.stitching.mosaic import BURNT, brightest, footprint

_BLOCK = 24
"""Images that are paired at a time."""
_FINER = ((4, 9), (8, 6))
"""Copies of a surface: by what the step between planes is divided, and how many lie above it and below."""
_BYTES = 400_000_000
"""Memory for images that are used again."""
_NOISE_DN = 1.0
"""Contrast (standard deviation in grey levels) below which there is nothing to agree on."""
_DETAIL = 4
"""Fine detail is held in so many steps to a grey level."""
_LIT, _UNLIKE_DN, _ALIKE_CELLS = 24, 6.0, 3
"""Cameras of one instant: grey level above which there is light, difference of grey levels beyond which two places are
not alike, and the width over which that is averaged."""
_DARKEST = 16
"""Grey levels below are raised to this one: noise."""
_SLOPE_MM = 0.3
"""Standard deviation of the Gaussian filter over the heights from which slopes are taken."""
_OBLIQUE = 0.2
"""Cosine of the angle to the normal below which the light that is lost is not told apart further: the normal is not
known well enough."""
_SPECK_MM2 = 4.0
"""Smaller islands of what is known are taken for nothing."""
_RIM_CELLS = 3
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
    step_mm: Annotated[float, Range(0.01, 10)] = 0.4
    """Distance between the planes; beside the surface that they give, others are tried at a quarter and then at an
    eighth of it. At least what shifts the compared frames by half a pixel."""
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
    smoothing_mm: Annotated[float, Range(0.001, 100)] = 0.1
    """Standard deviation of the Gaussian filter over the heights."""
    exit_index: Annotated[float, Range(1, 3)] = 1.4
    """Refractive index of the teeth, by which less of their light leaves them at grazing angles; 1 for what is
    matte."""
    agreement: Annotated[float, Range(-1, 1)] = 0.15
    """Places where the frames agree less than this (0 to 1, by ZNCC) at the height found count as unknown."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window % 2 == 0:
            raise InputError(f"plane sweep: --window is {self.window}; it must be odd")
        if not self.small_jump <= self.large_jump:
            raise InputError("plane sweep: a large jump must cost no less than a small one")


# --- what is swept -----------------------------------------------------------------------------------------------


class Grid(NamedTuple):
    """Places in the occlusal plane at which frames are compared."""

    corner: Float[np.ndarray, "2"]
    cell_mm: float
    columns: int
    rows: int

    @staticmethod
    def from_motion(motion: SparseModel, cell_mm: float) -> Grid:
        """About the points of a motion, a whole number of pools wide."""
        low, high = np.percentile(motion.tracks.points[:, :2], [0.2, 99.8], axis=0) + [[-4.0], [4.0]]
        columns, rows = (_POOL * np.ceil((high - low) / cell_mm / _POOL)).astype(int).tolist()
        return Grid(low, cell_mm, columns, rows)

    @staticmethod
    def of(surface: HeightMap) -> Grid:
        """The grid that a height map was pooled from."""
        rows, columns = surface.heights.shape
        cell_mm = surface.cell_mm / _POOL
        return Grid(surface.corner - surface.cell_mm / 2, cell_mm, _POOL * columns, _POOL * rows)

    @property
    def pooled(self) -> Grid:
        """The cells of the height map."""
        return Grid(self.corner, _POOL * self.cell_mm, self.columns // _POOL, self.rows // _POOL)

    @property
    def centres(self) -> Float[np.ndarray, "h w 2"]:
        """Centres of the cells."""
        across, down = (self.cell_mm * (np.arange(count) + 0.5) for count in (self.columns, self.rows))
        return self.corner + np.stack(np.meshgrid(across, down), axis=-1)


class _Ground(NamedTuple):
    """A surface, of which copies are tried that lie higher or lower."""

    grid: Grid
    places: Float[np.ndarray, "h w 3"]
    """Of the cells of the grid on the surface."""
    normals: Float[np.ndarray, "h w 3"]
    height: float
    """About its Z."""

    @staticmethod
    def level(grid: Grid, z: float) -> _Ground:
        """A plane."""
        centres = grid.centres
        up = np.broadcast_to([0.0, 0.0, 1.0], (*centres.shape[:2], 3))
        return _Ground(grid, np.dstack([centres, np.full(centres.shape[:2], z)]), up, z)

    @staticmethod
    def of(surface: HeightMap, grid: Grid) -> _Ground:
        """A surface, with the slopes that it has on average."""
        smooth = cv2.GaussianBlur(surface.heights, (0, 0), _SLOPE_MM / surface.cell_mm)
        slopes = np.gradient(smooth, surface.cell_mm)
        down, across = (replace(surface, heights=slope).interpolate(grid.centres) for slope in slopes)
        normals = np.dstack([-across, -down, np.ones_like(down)]).astype(np.float64)
        places = np.dstack([grid.centres, surface.interpolate(grid.centres)])
        height = float(np.median(places[..., 2]))
        return _Ground(grid, places, normals / np.linalg.norm(normals, axis=-1, keepdims=True), height)

    def part(self, low: Int[np.ndarray, "2"], high: Int[np.ndarray, "2"]) -> _Ground:
        """Some of its columns and rows."""
        here = slice(low[1], high[1]), slice(low[0], high[0])
        return self._replace(places=self.places[here], normals=self.normals[here])


# --- one image on one surface ------------------------------------------------------------------------------------


class _Laid(NamedTuple):
    """An image on a surface, within its window of the grid."""

    low: np.ndarray
    high: np.ndarray
    gray: Float32[np.ndarray, "h w"]
    detail: Float32[np.ndarray, "h w"]
    weight: Float32[np.ndarray, "h w"]

    def part(self, low: np.ndarray, high: np.ndarray) -> tuple[slice, slice]:
        """Rows and columns of this window."""
        (left, top), (right, bottom) = (low - self.low).tolist(), (high - self.low).tolist()
        return slice(top, bottom), slice(left, right)


class _Projected(NamedTuple):
    """Where an image shows the places of a ground, within its window of the grid, and copies of them."""

    low: np.ndarray
    high: np.ndarray
    pixels: Float32[np.ndarray, "h w 3"]
    """Homogeneous, of the ground itself."""
    upwards: Float32[np.ndarray, "3"]
    """What is added to them for each mm that a copy lies higher."""
    brighter: Float32[np.ndarray, "h w"]
    """By what grey levels are multiplied to make up for the light that does not leave the surface."""

    @staticmethod
    def of(
        ground: _Ground, camera: Camera, pose: Rigid3, gamma: float, exit_index: float, window: int
    ) -> _Projected | None:
        """None where the image sees nothing of the grid."""
        low, high = _window_of(ground.grid, camera, pose, ground.height)
        if np.any(high - low < window):
            return None
        part = ground.part(low, high)
        in_camera = pose.apply(part.places)
        facing = -(in_camera * pose.rotate(part.normals)).sum(axis=-1) / np.linalg.norm(in_camera, axis=-1)
        return _Projected(
            low,
            high,
            (in_camera @ camera.opencv_matrix.T).astype(np.float32),
            (camera.opencv_matrix @ pose.rotation[:, 2]).astype(np.float32),
            _limb_darkening_gain(facing, exit_index, gamma),
        )

    def lay(self, image: UInt8[np.ndarray, "h w 3"], higher_mm: float, window: int) -> _Laid:
        """The image on a copy of the ground."""
        gray, detail, weight = np.zeros((3, *self.brighter.shape), np.float32)
        _sample(image, self.pixels, np.float32(higher_mm) * self.upwards, gray, detail, weight)
        weight = cv2.erode(weight, np.ones((window, window), np.uint8), borderValue=0)
        return _Laid(self.low, self.high, gray * self.brighter, detail, weight / 255)


_Image = tuple[UInt8[np.ndarray, "h w 3"], _Projected | None]
"""A picture, and where it shows the ground."""


@kernel(fastmath=True)
@no_type_check
def _limb_darkening_gain(facing, index, gamma):
    """By what grey levels are to be multiplied where a body is seen at an angle of this cosine to its normal."""
    out = np.empty(facing.shape, np.float32)
    for place in np.ndindex(facing.shape):
        out[place] = transmittance(max(facing[place], _OBLIQUE), index) ** (-1 / gamma)
    return out


@kernel(fastmath=True)
@no_type_check
def _sample(image, pixels, moved, gray, detail, weight):
    """Fill in the three channels of an image at homogeneous pixels that are moved, bilinearly; 0 outside."""
    rows, columns = image.shape[:2]
    for i in range(gray.shape[0]):
        for j in range(gray.shape[1]):
            z = pixels[i, j, 2] + moved[2]
            if z <= 0:
                continue
            x, y = (pixels[i, j, 0] + moved[0]) / z, (pixels[i, j, 1] + moved[1]) / z
            if not (0 <= x < columns - 1 and 0 <= y < rows - 1):
                continue
            c, r = int(x), int(y)
            x, y = x - c, y - r
            w00, w01, w10, w11 = (1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y
            here, right, below, beyond = image[r, c], image[r, c + 1], image[r + 1, c], image[r + 1, c + 1]
            gray[i, j] = w00 * here[0] + w01 * right[0] + w10 * below[0] + w11 * beyond[0]
            detail[i, j] = w00 * here[1] + w01 * right[1] + w10 * below[1] + w11 * beyond[1]
            weight[i, j] = w00 * here[2] + w01 * right[2] + w10 * below[2] + w11 * beyond[2]


def _window_of(grid: Grid, camera: Camera, pose: Rigid3, z: float) -> tuple[Int[np.ndarray, "2"], Int[np.ndarray, "2"]]:
    """The part of the grid that a frame sees; to no side farther than it would see if it looked straight down."""
    centre, corners = pose.inverse().translation, footprint(camera, pose, z)
    half = (centre[2] - z) * max(camera.width, camera.height) / 2 / float(np.mean(camera.focal_px))
    limits = np.array([grid.columns, grid.rows])
    low = np.maximum(corners.min(axis=0), centre[:2] - half)
    high = np.minimum(corners.max(axis=0), centre[:2] + half)
    low, high = (np.clip(np.floor((end - grid.corner) / grid.cell_mm), 0, limits).astype(int) for end in (low, high))
    return low, high


def _zncc(
    one: Float32[np.ndarray, "h w"], other: Float32[np.ndarray, "h w"], noise: float, window: int
) -> Float32[np.ndarray, "h w"]:
    """What two images agree in windows, 0 to 1; little where their contrast is not above the noise."""

    def mean(values: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        return np.asarray(cv2.blur(values, (window, window)))

    first, second = mean(one), mean(other)
    power = np.maximum(mean(one * one) - first * first, 0) + noise**2
    power *= np.maximum(mean(other * other) - second * second, 0) + noise**2
    return np.clip((mean(one * other) - first * second) / np.sqrt(power), 0, 1)


def _alike(one: Float32[np.ndarray, "h w"], other: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """How alike two images are in brightness, 0 to 1; 0 where it is dark, which looks alike at any height."""
    lit = np.minimum(one, other) > _LIT
    return np.asarray(cv2.blur(np.clip(1 - np.abs(one - other) / _UNLIKE_DN, 0, 1) * lit, (_ALIKE_CELLS,) * 2))


def _correlate(
    one: _Laid, a: tuple[slice, slice], other: _Laid, b: tuple[slice, slice], window: int, same_lights: bool
) -> Float32[np.ndarray, "h w"]:
    """What two images agree on parts of a surface, 0 to 1."""
    detail = _zncc(one.detail[a], other.detail[b], _DETAIL * _NOISE_DN, window)
    if same_lights:
        return (2 * _alike(one.gray[a], other.gray[b]) + detail) / 3
    gray = _zncc(one.gray[a], other.gray[b], _NOISE_DN, window)
    return (gray * gray + detail) / 2


def _add_agreement(
    one: _Laid, other: _Laid, window: int, same_lights: bool, agreement: np.ndarray, pairs: np.ndarray
) -> None:
    """Add what two images agree on a surface, and where both see it, to the sums over the grid."""
    low, high = np.maximum(one.low, other.low), np.minimum(one.high, other.high)
    if np.any(high <= low):
        return
    a, b = one.part(low, high), other.part(low, high)
    weight = np.minimum(one.weight[a], other.weight[b])
    here = slice(low[1], high[1]), slice(low[0], high[0])
    agreement[here] += weight * _correlate(one, a, other, b, window, same_lights)
    pairs[here] += weight


# --- all of them ------------------------------------------------------------------------------------------------


def _prepare_frame(
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


class _Pictures:
    """What is compared of each image, by its number; the first of them, as many as fit in memory, are kept."""

    def __init__(self, compared: Compared, read: Callable[[str], UInt8[np.ndarray, "h w 3"]], detail_px: float) -> None:
        self._names, self._cameras = compared.names, compared.cameras
        self._read, self._detail_px = read, detail_px
        self._maps = {camera: undistortion_maps(camera) for camera in compared.cameras}
        self._gains = camera_gains(compared.names, read) if compared.same_lights else {}
        self._kept = dict[int, UInt8[np.ndarray, "h w 3"]]()

    def __call__(self, image: int) -> UInt8[np.ndarray, "h w 3"]:
        if image in self._kept:
            return self._kept[image]
        name, maps = self._names[image], self._maps[self._cameras[image]]
        made = _prepare_frame(self._read(name), maps, self._gains.get(name.rpartition("/")[0], 1.0), self._detail_px)
        if (len(self._kept) + 1) * made.nbytes <= _BYTES:
            self._kept[image] = made
        return made


def plane_sweep(
    motion: SparseModel,
    compared: Compared,
    sparse: HeightMap,
    read: Callable[[str], UInt8[np.ndarray, "h w 3"]],
    options: PlaneSweepOptions,
    *,
    start: tuple[HeightMap, float] | None = None,
    progress: Progress = silent,
) -> HeightMap | None:
    """The surface on which images agree, in the occlusal frame; None where no two of them are compared.

    ``motion`` shows where the teeth are; ``sparse`` is the smooth surface through its points, which shows how high they
    reach; ``read`` gives an image by its name. ``start``: what was found with poses that were a little different, and
    how far from it the surface may lie, mm; it is looked for there alone, and taken as known where it was.
    """
    if not compared.pairs:
        return None
    camera = motion.camera
    pixel_mm = float(np.median(motion.depths) / np.mean(camera.focal_px))
    finest_mm = 0.5 * pixel_mm / compared.baseline_share
    grid = Grid.from_motion(motion, max(options.cell_mm, pixel_mm)) if start is None else Grid.of(start[0])
    ceiling = sparse.interpolate(grid.pooled.centres) + _ABOVE_MM
    step_mm = max(options.step_mm, finest_mm)
    sweep = partial(_sweep_part, compared, _Pictures(compared, read, options.detail_px), ceiling, options)
    finer = [max(step_mm / parts, finest_mm) * np.arange(-copies, copies + 1) for parts, copies in _FINER]
    if start is None:
        levels = np.arange(-options.depth_mm, float(sparse.heights.max()) + _ABOVE_MM + step_mm, step_mm)
        middle, everywhere = float(levels.mean()), np.ones(ceiling.shape, bool)
        plane, part = _Ground.level(grid, middle), _part(progress, 0, 1 + len(finer))
        surface, sure = sweep(plane, levels - middle, everywhere, part)
    else:
        (surface, off_mm), sure = start, start[0].known
        finer = finer[max([n for n, higher in enumerate(finer) if higher[-1] >= off_mm], default=0) :]
    known, before = surface.known, int(start is None)
    for number, higher in enumerate(finer, start=before):
        part = _part(progress, number, before + len(finer))
        surface, sure = sweep(_Ground.of(surface, grid), higher, sure, part)
    return replace(surface, known=known)


def _part(progress: Progress, number: int, rounds: int) -> Progress:
    """Progress of one round as that of all."""
    return lambda stage, done, total: progress(stage, number * total + done, rounds * total)


def _sweep_part(
    compared: Compared,
    pictures: _Pictures,
    ceiling: Float[np.ndarray, "r c"],
    options: PlaneSweepOptions,
    ground: _Ground,
    higher_mm: Float[np.ndarray, "d"],
    sure: Bool[np.ndarray, "r c"],
    progress: Progress,
) -> tuple[HeightMap, Bool[np.ndarray, "r c"]]:
    """The best of the copies of a ground at each place, not above the ceiling, and where images agree on it of those
    places that were ``sure`` before."""
    pooled = ground.grid.pooled
    volume = _agreement(compared, pictures, ground, higher_mm, options, progress)
    base = cv2.resize(ground.places[..., 2], (pooled.columns, pooled.rows), interpolation=cv2.INTER_AREA)
    volume[base + higher_mm[:, None, None] > ceiling] = 0
    cost = np.ascontiguousarray(np.moveaxis(1 - volume, 0, -1))
    copy = semi_global(cost, options.small_jump, options.large_jump)
    at = np.clip(np.rint(copy), 0, len(higher_mm) - 1).astype(int)
    certainty = cv2.blur(np.take_along_axis(volume, at[None], axis=0)[0], (5, 5))
    moved = cv2.medianBlur(np.interp(copy, np.arange(len(higher_mm)), higher_mm).astype(np.float32), 5)
    agreed = sure & (certainty >= options.agreement)
    sure = np.asarray(remove_small_objects(agreed, max_size=round(_SPECK_MM2 / pooled.cell_mm**2)))
    known = remove_small_holes(sure, max_size=round(HOLE_MM2 / pooled.cell_mm**2))
    heights = _bridge_holes((base + moved).astype(np.float32), known & ~sure)
    smooth = np.asarray(cv2.GaussianBlur(heights, (0, 0), options.smoothing_mm / pooled.cell_mm))
    corner = pooled.centres[0, 0]
    return HeightMap(corner=corner, cell_mm=pooled.cell_mm, heights=smooth, known=np.asarray(known)), sure


def _bridge_holes(heights: Float32[np.ndarray, "r c"], holes: Bool[np.ndarray, "r c"]) -> Float32[np.ndarray, "r c"]:
    """Heights that span the holes smoothly: where a highlight leaves nothing to agree on, those found are false."""
    wide = cv2.dilate(holes.astype(np.uint8), np.ones((2 * _RIM_CELLS + 1,) * 2, np.uint8)) > 0
    return np.asarray(inpaint_biharmonic(heights, wide, split_into_regions=True), dtype=np.float32)


def _agreement(
    compared: Compared,
    pictures: _Pictures,
    ground: _Ground,
    higher_mm: Float[np.ndarray, "d"],
    options: PlaneSweepOptions,
    progress: Progress,
) -> Float32[np.ndarray, "d r c"]:
    """Mean agreement (0 to 1) of the pairs of images that see a place, on each copy of the ground; the less, the fewer
    they are."""
    grid, pooled, window, names = ground.grid, ground.grid.pooled, options.window, compared.names
    sums, counts = np.zeros((2, len(higher_mm), pooled.rows, pooled.columns), np.float32)

    def project(image: int) -> _Projected | None:
        camera, pose = compared.cameras[image], compared.cam_from_world[image]
        return _Projected.of(ground, camera, pose, compared.gammas[image], options.exit_index, window)

    def look(block: Sequence[tuple[int, int]], images: Mapping[int, _Image], copy: int) -> None:
        agreement, seen = np.zeros((2, grid.rows, grid.columns), np.float32)
        laid = {
            image: None if where is None else where.lay(picture, float(higher_mm[copy]), window)
            for image, (picture, where) in images.items()
        }
        for one, other in block:
            first, second = laid[one], laid[other]
            if first is not None and second is not None:
                _add_agreement(first, second, window, compared.same_lights, agreement, seen)
        size = pooled.columns, pooled.rows
        sums[copy] += cv2.resize(agreement, size, interpolation=cv2.INTER_AREA)
        counts[copy] += cv2.resize(seen, size, interpolation=cv2.INTER_AREA)

    for start in range(0, len(names), _BLOCK):
        block = [pair for pair in compared.pairs if start <= pair[0] < start + _BLOCK]
        wanted = sorted({image for pair in block for image in pair})
        found = map_in_threads(lambda image: (pictures(image), project(image)), wanted)
        map_in_threads(partial(look, block, dict(zip(wanted, found, strict=True))), range(len(higher_mm)))
        progress("surface", min(start + _BLOCK, len(names)), len(names))
    return sums / (counts + np.float32(_PAIRS))
