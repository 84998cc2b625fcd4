"""Frames of one camera, rectified on the surface, to one occlusal view: an orthophoto.

Frames: the world is the occlusal frame of :mod:`cuspid.model.panorama`. The *canvas* is the panorama's pixel grid. Only
one frame is in memory at a time; what grows is the canvas.

First every frame is looked at on a grid of coarse cells, each `CELL_PX` wide: for every cell the best few frames are
kept, those that look straight down on it, see it away from their border and not burnt out. Then the choice is made
even over neighbouring cells, the gains and the falloff of the light are estimated where frames overlap, and every frame
is put on the canvas in bands of frequencies, each fading over about its own wavelength (Burt and Adelson 1983).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Int16, Shaped, UInt8
from skimage.morphology import remove_small_objects

from cuspid.geometry import Rigid3
from cuspid.model.camera import OPENCV_PIXEL_OFFSET, Camera
from cuspid.model.sparse_model import SparseModel
from cuspid.runtime.options import Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_ahead
from cuspid.stitching.gain_compensation import Compensation, GainOptions, Samples, balance
from cuspid.stitching.height_map import HeightMap
from cuspid.stitching.seams import SeamOptions, choose

CELL_PX = 6
"""Width in px of the cells on which the frame is chosen."""
_GRID_PX = 3
"""Spacing in px of the places that are projected exactly; between them the map is bilinear."""
_MARGIN_MM = 4.0
"""The canvas reaches so far beyond the points of the motion."""
_UNLIT, _UNLIT_PX = 8, 25
"""What is darker than the first (grey level of the largest channel) over a width of the second, in px of the panorama,
shows nothing: the depth of the mouth behind the teeth."""
_SPECK_MM2 = 4.0
"""Smaller pieces of the panorama are left out."""
BURNT, DARK = 245, 20
"""Grey levels (largest and smallest channel) beyond which a pixel says nothing of brightness."""


@dataclass(frozen=True, kw_only=True)
class MosaicOptions(Options):
    """How frames become one picture."""

    mm_per_px: Annotated[float | None, Range(0.001, 10)] = None
    """Size of a pixel in mm; default: that of the frames where they look straight down."""
    border_px: Annotated[int, Range(0, 10_000)] = 6
    """Width of the border of each frame that is not used."""
    bands_px: Annotated[tuple[float, ...], Range(0.1, 1000)] = (1.5, 6.0, 24.0)
    """Standard deviations in px of the Gaussians that separate the frequency bands."""
    seams: SeamOptions = field(default_factory=SeamOptions)
    """How the frame of each pixel is chosen."""
    gain_compensation: GainOptions = field(default_factory=GainOptions)
    """How brightness differences are evened out."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Canvas:
    """The panorama's pixel grid: pixel (u, v) shows x = (u - u0) s, y = (v0 - v) s."""

    origin_px: Float[np.ndarray, "2"]
    """(u0, v0)."""
    mm_per_px: float
    """s."""
    width: int
    """Columns."""
    height: int
    """Rows."""

    def world(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """World (x, y) of pixels."""
        return np.asarray((pixels - self.origin_px) * [self.mm_per_px, -self.mm_per_px])

    def pixels(self, world: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Pixels of world (x, y)."""
        return np.asarray(world / [self.mm_per_px, -self.mm_per_px] + self.origin_px)


@dataclass(frozen=True, eq=False, kw_only=True)
class Mosaic:
    """What is composed on the canvas."""

    canvas: Canvas
    image: UInt8[np.ndarray, "h w 3"]
    """RGB."""
    frame: Int16[np.ndarray, "h w"]
    """Index of the located frame that dominates each pixel, -1 for none."""
    frame_pixel: Float[np.ndarray, "h w 2"]
    """Where it lies in that frame, px; NaN for none. float32."""
    height_mm: Float[np.ndarray, "h w"]
    """World Z of each pixel. float32."""
    overlaps: tuple[float | None, ...]
    """For each located frame: share of what it sees that the one before sees too."""


def brightest(image: Shaped[np.ndarray, "h w 3"]) -> Shaped[np.ndarray, "h w"]:
    """Largest of the three channels; many times faster than the maximum along the axis."""
    return np.asarray(np.maximum(np.maximum(image[..., 0], image[..., 1]), image[..., 2]))


def _to_border(px: Float[np.ndarray, "h w 2"], camera: Camera) -> Float[np.ndarray, "h w"]:
    """Distance of pixels from the border of their frame, negative outside; NaN where there is none."""
    x, y = px[..., 0], px[..., 1]
    return np.asarray(np.minimum(np.minimum(x, camera.width - x), np.minimum(y, camera.height - y)))


# --- where frames lie --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PlacedFrame:
    """Where on the canvas a frame lies."""

    camera: Camera
    cam_from_world: Rigid3
    left: int
    top: int
    width: int
    height: int

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the canvas."""
        return slice(self.top, self.top + self.height), slice(self.left, self.left + self.width)


def footprint(camera: Camera, cam_from_world: Rigid3, height: float) -> Float[np.ndarray, "4 2"]:
    """Where the corners of a frame meet the plane z = height; not farther than 60 deg off the vertical."""
    corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]) * [camera.width, camera.height]
    world_from_cam = cam_from_world.inverse()
    rays = world_from_cam.rotate(camera.rays(corners))
    sideways = np.linalg.norm(rays[:, :2], axis=1)
    steepness = np.maximum(-rays[:, 2], sideways / np.sqrt(3.0))
    return np.asarray(
        world_from_cam.translation[:2] + rays[:, :2] / steepness[:, None] * (world_from_cam.translation[2] - height)
    )


def make_canvas(motion: SparseModel, camera: Camera, mm_per_px: float | None) -> Canvas:
    """The grid that holds what the frames see of the occlusal plane, not far beyond the points of the motion."""
    poses = list(motion.cam_from_world.values())
    corners = np.concatenate([footprint(camera, pose, 0.0) for pose in poses])
    distances = [pose.inverse().translation[2] for pose in poses]
    size = mm_per_px or float(np.median(distances) / np.mean(camera.focal_px))
    seen = np.percentile(motion.tracks.points[:, :2], [0.2, 99.8], axis=0) + [[-_MARGIN_MM], [_MARGIN_MM]]
    low, high = np.maximum(corners.min(axis=0), seen[0]), np.minimum(corners.max(axis=0), seen[1])
    width, height = (CELL_PX * np.ceil((high - low) / size / CELL_PX)).astype(int).tolist()
    return Canvas(origin_px=np.array([-low[0], high[1]]) / size, mm_per_px=size, width=width, height=height)


def place(canvas: Canvas, camera: Camera, cam_from_world: Rigid3) -> PlacedFrame:
    """The part of the canvas that a frame can see, in whole cells."""
    corners = canvas.pixels(footprint(camera, cam_from_world, 0.0))
    limits = np.array([canvas.width, canvas.height])
    low = np.clip(np.floor(corners.min(axis=0) / CELL_PX) * CELL_PX, 0, limits - CELL_PX).astype(int)
    high = np.clip(np.ceil(corners.max(axis=0) / CELL_PX) * CELL_PX, low + CELL_PX, limits).astype(int)
    return PlacedFrame(camera, cam_from_world, *low.tolist(), *(high - low).tolist())


def positions(canvas: Canvas, view: PlacedFrame, surface: HeightMap, step: int) -> Float[np.ndarray, "r c 3"]:
    """World places on the surface at the middle of every block of ``step`` px of a view."""
    columns, rows = -(-view.width // step), -(-view.height // step)
    u, v = np.meshgrid(
        view.left + step * (np.arange(columns) + 0.5),
        view.top + step * (np.arange(rows) + 0.5),
    )
    xy = canvas.world(np.stack([u, v], axis=-1))
    return np.concatenate([xy, surface.interpolate(xy)[..., None]], axis=-1)


def frame_map(canvas: Canvas, view: PlacedFrame, surface: HeightMap) -> Float[np.ndarray, "h w 2"]:
    """Where in the frame each pixel of a view lies, px (COLMAP's origin). float32."""
    world = positions(canvas, view, surface, _GRID_PX)
    px = view.camera.project(view.cam_from_world.apply(world)).astype(np.float32)
    rows, columns = px.shape[:2]
    dense = cv2.resize(px, (columns * _GRID_PX, rows * _GRID_PX), interpolation=cv2.INTER_LINEAR)
    return np.asarray(dense[: view.height, : view.width])


# --- choosing ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Glance:
    """One frame on the cells of its view."""

    cost: Float[np.ndarray, "r c"]
    color: Float[np.ndarray, "r c 3"]
    usable: Bool[np.ndarray, "r c"]
    light: Float[np.ndarray, "r c"]


def glance(
    canvas: Canvas, view: PlacedFrame, surface: HeightMap, image: UInt8[np.ndarray, "h w 3"], options: MosaicOptions
) -> _Glance:
    """The weight of a frame in each cell: infinite where it does not see it."""
    world = positions(canvas, view, surface, CELL_PX)
    in_cam = view.cam_from_world.apply(world)
    px = view.camera.project(in_cam).astype(np.float32)
    burnt = cv2.dilate((brightest(image) >= BURNT).astype(np.uint8) * 255, np.ones((5, 5), np.uint8))
    blurred = cv2.blur(image, (5, 5))
    where = px - np.float32(OPENCV_PIXEL_OFFSET)
    color = cv2.remap(blurred, where, None, cv2.INTER_LINEAR).astype(np.float32)
    glare = cv2.remap(cv2.blur(burnt, (9, 9)), where, None, cv2.INTER_LINEAR).astype(np.float32) / 255
    towards = view.cam_from_world.inverse().translation - world
    tangent2 = np.sum(towards[..., :2] ** 2, axis=-1) / np.maximum(towards[..., 2], 1e-6) ** 2
    border, largest = _to_border(px, view.camera), brightest(color)
    dark = (largest < DARK).astype(np.float32)
    cost = options.seams.cost(tangent2, border - options.border_px, np.maximum(glare, dark))
    seen = (border >= options.border_px) & (in_cam[..., 2] > 0)
    seen &= surface.known_at(world[..., :2]) & ~surface.occludes(world, view.cam_from_world.inverse().translation)
    cost = np.where(seen, cost, np.inf)
    bright = (largest < BURNT) & (largest > DARK) & (glare < 0.02)
    # Lights at the camera: 1 / d^2, and a lobe about the optical axis.
    distance2 = np.sum(in_cam**2, axis=-1)
    falloff = np.log(np.maximum(in_cam[..., 2], 1e-6) / np.sqrt(distance2) / distance2)
    return _Glance(cost.astype(np.float32), color, seen & bright, falloff.astype(np.float32))


def _cells(view: PlacedFrame) -> tuple[slice, slice]:
    rows, columns = view.window
    return slice(rows.start // CELL_PX, rows.stop // CELL_PX), slice(columns.start // CELL_PX, columns.stop // CELL_PX)


@dataclass
class _Best:
    """The best few frames of every cell so far; grows with the canvas alone."""

    cost: np.ndarray
    frame: np.ndarray
    color: np.ndarray

    @staticmethod
    def empty(canvas: Canvas, count: int) -> _Best:
        shape = (count, canvas.height // CELL_PX, canvas.width // CELL_PX)
        return _Best(
            np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int16), np.zeros((*shape, 3), np.float32)
        )

    def offer(self, index: int, cells: tuple[slice, slice], seen: _Glance) -> None:
        """Let a frame take its place among the best of each cell."""
        rows, columns = cells
        cost, frame, color = (array[:, rows, columns] for array in (self.cost, self.frame, self.color))
        all_costs = np.concatenate([cost, seen.cost[None]])
        order = np.argsort(all_costs, axis=0, kind="stable")[: len(cost)]
        all_frames = np.concatenate([frame, np.where(np.isfinite(seen.cost), index, -1).astype(np.int16)[None]])
        all_colors = np.concatenate([color, seen.color[None]])
        self.cost[:, rows, columns] = np.take_along_axis(all_costs, order, axis=0)
        self.frame[:, rows, columns] = np.take_along_axis(all_frames, order, axis=0)
        self.color[:, rows, columns] = np.take_along_axis(all_colors, order[..., None], axis=0)


# --- composing ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Layers:
    """The bands of one frame, from fine to coarse."""

    window: tuple[slice, slice]
    """Its rows and columns of the canvas."""
    bands: list[Float[np.ndarray, "h w 3"]]
    """Each times its weight."""
    weights: list[Float[np.ndarray, "h w"]]
    """Where the frame is chosen, faded over the width of the band."""

    @staticmethod
    def of(
        window: tuple[slice, slice],
        image: Float[np.ndarray, "h w 3"],
        valid: Float[np.ndarray, "h w"],
        chosen: Float[np.ndarray, "h w"],
        sigmas: tuple[float, ...],
    ) -> _Layers:
        """Of a rectified image, with the widths of the bands in px."""
        layers, finer = _Layers(window, [], []), image
        for level, sigma in enumerate([*sigmas, sigmas[-1]]):
            last = level == len(sigmas)
            coarser = np.zeros_like(finer) if last else _masked_blur(finer, valid, sigma)
            weight = valid * _gaussian(chosen, 2 * sigma)
            layers.bands.append((finer - coarser) * weight[..., None])
            layers.weights.append(weight)
            if not last:
                finer = coarser
        return layers


class _Bands:
    """Sums of the bands of all frames on the canvas, each with its own weights."""

    def __init__(self, canvas: Canvas, count: int) -> None:
        shape = (canvas.height, canvas.width)
        self.sums = [np.zeros((*shape, 3), np.float32) for _ in range(count)]
        self.weights = [np.zeros(shape, np.float32) for _ in range(count)]

    def add(self, layers: _Layers) -> None:
        """Add the bands of a frame."""
        for total, weights, band, weight in zip(self.sums, self.weights, layers.bands, layers.weights, strict=True):
            total[layers.window] += band
            weights[layers.window] += weight

    def image(self) -> Float[np.ndarray, "h w 3"]:
        """The sum of the bands."""
        total = np.zeros_like(self.sums[0])
        for band, weight in zip(self.sums, self.weights, strict=True):
            total += band / np.maximum(weight, 1e-6)[..., None]
        return total


def _gaussian(array: np.ndarray, sigma: float) -> np.ndarray:
    """A Gaussian filter, on a smaller picture where it is wide."""
    factor = int(sigma // 4)
    if factor < 2:
        return np.asarray(cv2.GaussianBlur(array, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))
    size = array.shape[1::-1]
    small = cv2.resize(array, (-(-size[0] // factor), -(-size[1] // factor)), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma / factor, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(small, size, interpolation=cv2.INTER_LINEAR))


def _masked_blur(image: Float[np.ndarray, "h w 3"], valid: Float[np.ndarray, "h w"], sigma: float) -> np.ndarray:
    """Gaussian filter that looks at valid pixels alone."""
    total = _gaussian(valid, sigma)
    return np.asarray(_gaussian(image * valid[..., None], sigma) / np.maximum(total, 1e-3)[..., None])


def compose(
    motion: SparseModel,
    surface: HeightMap,
    read: Callable[[str], UInt8[np.ndarray, "h w 3"]],
    options: MosaicOptions,
    *,
    progress: Progress = silent,
) -> Mosaic:
    """The orthophoto of all located frames; ``read`` gives the image of a frame by its name."""
    camera = motion.camera
    canvas = make_canvas(motion, camera, options.mm_per_px)
    names = motion.frames
    views = [place(canvas, camera, motion.cam_from_world[name]) for name in names]
    best, samples, overlaps = _survey(canvas, views, names, surface, read, options, progress)
    compensation = balance(samples, len(names), options.gain_compensation)
    choice = choose(best.cost, best.frame, _compensated_colors(best, compensation), options.seams)
    return _render(canvas, views, names, surface, read, choice, compensation, overlaps, options, progress)


def _survey(
    canvas: Canvas,
    views: list[PlacedFrame],
    names: tuple[str, ...],
    surface: HeightMap,
    read: Callable[[str], UInt8[np.ndarray, "h w 3"]],
    options: MosaicOptions,
    progress: Progress,
) -> tuple[_Best, Samples, tuple[float | None, ...]]:
    """Every frame at a glance: the best few of each cell, samples of brightness, overlaps."""
    best = _Best.empty(canvas, options.seams.candidates)
    samples = Samples.empty()
    overlaps: list[float | None] = []
    before = np.zeros(best.cost.shape[1:], bool)

    def look(one: tuple[PlacedFrame, str]) -> _Glance:
        view, name = one
        return glance(canvas, view, surface, read(name), options)

    for index, seen in enumerate(map_ahead(look, zip(views, names, strict=True))):
        cells = _cells(views[index])
        best.offer(index, cells, seen)
        samples.take(index, cells, best.cost.shape[2], seen.color, seen.light, seen.usable)
        now = np.zeros_like(before)
        now[cells] = np.isfinite(seen.cost) & (brightest(seen.color) > DARK)
        overlaps.append(float((now & before).sum() / max(now.sum(), 1)) if index else None)
        before = now
        progress("survey", index + 1, len(names))
    return best, samples, tuple(overlaps)


def _compensated_colors(best: _Best, compensation: Compensation) -> Float[np.ndarray, "k r c 3"]:
    """Colours of the candidates after the gains, for comparing them across a seam."""
    gains = np.append(compensation.gains, 0.0)[best.frame]
    return np.asarray(best.color * np.exp(-gains)[..., None], dtype=np.float32)


def _render(
    canvas: Canvas,
    views: list[PlacedFrame],
    names: tuple[str, ...],
    surface: HeightMap,
    read: Callable[[str], UInt8[np.ndarray, "h w 3"]],
    choice: Int[np.ndarray, "r c"],
    compensation: Compensation,
    overlaps: tuple[float | None, ...],
    options: MosaicOptions,
    progress: Progress,
) -> Mosaic:
    shape = (canvas.height, canvas.width)
    bands = _Bands(canvas, len(options.bands_px) + 1)
    frame = cv2.resize(choice.astype(np.int16), shape[::-1], interpolation=cv2.INTER_NEAREST)
    frame_pixel = np.full((*shape, 2), np.nan, np.float32)

    def layers(index: int) -> tuple[_Layers, Float[np.ndarray, "h w 2"]] | None:
        view = views[index]
        chosen = frame[view.window] == index
        if not chosen.any():
            return None
        px = frame_map(canvas, view, surface)
        return _split_bands(canvas, view, surface, px, read(names[index]), chosen, compensation, index, options), px

    for index, found in enumerate(map_ahead(layers, range(len(names)))):
        if found is not None:
            bands.add(found[0])
            window = views[index].window
            chosen = frame[window] == index
            frame_pixel[window][chosen] = found[1][chosen]
        progress("mosaic", index + 1, len(names))
    image = np.clip(np.rint(bands.image()), 0, 255).astype(np.uint8)
    shown = (frame >= 0) & ~unlit(image)
    nothing = ~remove_small_objects(shown, max_size=round(_SPECK_MM2 / canvas.mm_per_px**2))
    image[nothing], frame[nothing], frame_pixel[nothing] = 0, -1, np.nan
    whole = PlacedFrame(views[0].camera, views[0].cam_from_world, 0, 0, canvas.width, canvas.height)
    heights = cv2.resize(positions(canvas, whole, surface, CELL_PX)[..., 2].astype(np.float32), shape[::-1])
    return Mosaic(
        canvas=canvas, image=image, frame=frame, frame_pixel=frame_pixel, height_mm=heights, overlaps=overlaps
    )


def unlit(image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Where no light came back: dark places wider than `_UNLIT_PX`, so not the fissures and the gaps between teeth."""
    dark = (brightest(cv2.blur(image, (5, 5))) < _UNLIT).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_UNLIT_PX, _UNLIT_PX))
    return np.asarray(cv2.morphologyEx(dark, cv2.MORPH_OPEN, disc) > 0)


def _split_bands(
    canvas: Canvas,
    view: PlacedFrame,
    surface: HeightMap,
    px: Float[np.ndarray, "h w 2"],
    image: UInt8[np.ndarray, "a b 3"],
    chosen: Bool[np.ndarray, "h w"],
    compensation: Compensation,
    index: int,
    options: MosaicOptions,
) -> _Layers:
    """Rectify one frame, even out its light and part it into bands."""
    where = px - np.float32(OPENCV_PIXEL_OFFSET)
    rectified = cv2.remap(image, where, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    inside = _to_border(px, view.camera) >= 1
    burnt = cv2.dilate((brightest(rectified) >= BURNT).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    # A burnt-out pixel counts only where no other frame was to be had.
    world = positions(canvas, view, surface, CELL_PX)
    occluded = surface.occludes(world, view.cam_from_world.inverse().translation).astype(np.uint8)
    in_view = cv2.resize(occluded, (view.width, view.height), interpolation=cv2.INTER_NEAREST) == 0
    valid = (inside & ((in_view & ~burnt) | chosen)).astype(np.float32)
    valid[burnt & chosen] = 0.05
    in_cam = view.cam_from_world.apply(world)
    distance2 = np.sum(in_cam**2, axis=-1)
    falloff = np.log(np.maximum(in_cam[..., 2], 1e-6) / np.sqrt(distance2) / distance2).astype(np.float32)
    factor = cv2.resize(
        np.exp(-compensation.log_gain(index, falloff)), (view.width, view.height), interpolation=cv2.INTER_LINEAR
    )
    return _Layers.of(view.window, rectified * factor[..., None], valid, chosen.astype(np.float32), options.bands_px)
