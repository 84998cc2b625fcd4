"""Frames with a homography for each segment, and the canvas that they are blended on (thesis 4.2).

Frames: ``canvas_from_frame`` homographies take px of a frame (without distortion) to px of the picture of the first
frame of a part, which stays as it is; a :class:`Canvas` adds an offset to these, so that none is negative.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Int16, UInt8

from cuspid.model.camera import OPENCV_PIXEL_OFFSET
from cuspid.runtime.kernels import kernel
from cuspid_thesis.stitching.examination import frame_corners, warp
from cuspid_thesis.stitching.warps import SEGMENT_PX, centroids


@dataclass(frozen=True, eq=False, kw_only=True)
class Placed:
    """A frame in the panorama."""

    index: int
    """Its number in the sequence."""
    size: tuple[int, int]
    """Its width and height in px."""
    canvas_from_frame: Float[np.ndarray, "3 3"]
    """Homography of the whole frame, where no segment has one."""
    cells: Float[np.ndarray, "k 3 3"]
    """Homographies of its segments."""
    segments: Int16[np.ndarray, "r c"]
    """Which segment each place belongs to, `SEGMENT_PX` times as coarse as the frame."""
    inliers: int | None = None
    """Matches with the frame before that agree."""
    overlap: float | None = None
    """Share of it that the frame before sees too."""

    @property
    def corners(self) -> Float[np.ndarray, "4 2"]:
        """Its corners in the panorama."""
        return warp(np.broadcast_to(self.canvas_from_frame, (4, 3, 3)), frame_corners(self.size))

    def apply(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Where the panorama places pixels of the frame, each with its segment."""
        rows, columns = self.segments.shape
        column, row = (pixels // SEGMENT_PX).astype(int).T
        segment = self.segments[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        return warp(self.cells[segment], pixels)

    @property
    def max_stretch(self) -> float:
        """The largest factor by which lengths grow or shrink, at the corners and at the segments' centroids; infinite
        beyond the horizon."""
        whole = stretch(np.broadcast_to(self.canvas_from_frame, (4, 3, 3)), frame_corners(self.size))
        return float(max(whole.max(), stretch(self.cells, centroids(self.segments)).max()))


def stretch(homographies: Float[np.ndarray, "n 3 3"], points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """The larger of how much homographies lengthen and shorten steps of a px at points; infinite beyond the horizon."""
    here = warp(homographies, points)
    steps = np.stack([warp(homographies, points + step) - here for step in np.eye(2)], axis=-1)
    usable = np.isfinite(steps).all(axis=(-1, -2))
    lengths = np.linalg.svd(np.where(usable[:, None, None], steps, np.eye(2)), compute_uv=False)
    return np.where(usable, np.maximum(lengths[:, 0], 1 / np.maximum(lengths[:, 1], 1e-9)), np.inf)


@dataclass(frozen=True, eq=False)
class Canvas:
    """The pixels of a panorama."""

    offset: Float[np.ndarray, "2"]
    """Added to px of the first frame's picture."""
    width: int
    """Columns."""
    height: int
    """Rows."""

    @staticmethod
    def from_frames(frames: Iterable[Placed]) -> Canvas:
        """Around the corners of all frames."""
        corners = np.concatenate([placed.corners for placed in frames])
        low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
        width, height = (high - low).astype(int)
        return Canvas(-low, int(width), int(height))

    def window(self, placed: Placed) -> tuple[slice, slice]:
        """Rows and columns around a frame."""
        corners = placed.corners + self.offset
        low = np.maximum(np.floor(corners.min(axis=0)), 0).astype(int)
        high = np.minimum(np.ceil(corners.max(axis=0)), [self.width, self.height]).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])


def frame_pixels(canvas: Canvas, placed: Placed, window: tuple[slice, slice]) -> Float[np.ndarray, "a b 2"]:
    """Which px of a frame lies at each px of a window of the canvas, NaN for none. float32."""
    rows, columns = window
    pixels = np.empty((rows.stop - rows.start, columns.stop - columns.start, 2), np.float32)
    first = np.array([columns.start, rows.start]) + 0.5 - canvas.offset
    inverses = np.linalg.inv(np.concatenate([placed.canvas_from_frame[None], placed.cells]))
    _trace(first, inverses, placed.segments, SEGMENT_PX, np.array(placed.size, np.float64), pixels)
    return pixels


@kernel
@no_type_check
def _trace(first, inverses, segments, segment_px, size, pixels):
    """Where the whole frame's homography leads says which segment's to take, and where this one leads, once more."""
    rows, columns = segments.shape
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            pixels[i, j, 0] = pixels[i, j, 1] = np.nan
            x, y, which = first[0] + j, first[1] + i, 0
            for step in range(3):
                h = inverses[which]
                w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
                if w <= 0:
                    break
                u, v = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w
                if not (u >= 0 and v >= 0 and u < size[0] and v < size[1]):
                    break
                which = 1 + segments[min(int(v) // segment_px, rows - 1), min(int(u) // segment_px, columns - 1)]
                if step == 2:
                    pixels[i, j, 0], pixels[i, j, 1] = u, v


class Blend:
    """The canvas as it fills: frames are averaged, each with the distance of its pixels from its border as the weight.
    It grows with the canvas, not with the number of frames."""

    def __init__(self, canvas: Canvas) -> None:
        shape = (canvas.height, canvas.width)
        self.canvas = canvas
        self.total = np.zeros((*shape, 3), np.float32)
        self.weight = np.zeros(shape, np.float32)
        self.most = np.zeros(shape, np.float32)
        self.frame = np.full(shape, -1, np.int16)
        self.pixel = np.full((*shape, 2), np.nan, np.float32)

    def add(self, placed: Placed, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Lay a frame without distortion over the canvas."""
        window = self.canvas.window(placed)
        pixel = frame_pixels(self.canvas, placed, window)
        edge = np.minimum(pixel, np.array(placed.size, np.float32) - pixel).min(axis=-1)
        weight = np.nan_to_num(edge)
        where = np.nan_to_num(pixel, nan=-1) - np.float32(OPENCV_PIXEL_OFFSET)
        seen = cv2.remap(image, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        self.total[window] += seen * weight[..., None]
        self.weight[window] += weight
        first = weight > self.most[window]
        self.most[window][first] = weight[first]
        self.frame[window][first] = placed.index
        self.pixel[window][first] = pixel[first]

    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """The weighted mean, black where nothing was seen."""
        return np.rint(self.total / np.maximum(self.weight, 1e-9)[..., None]).astype(np.uint8)
