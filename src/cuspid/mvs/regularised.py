"""Depth where texture is weak: a plane sweep over all sources of a view, made smooth by semi-global optimisation.

For each of a row of inverse depths the sources are warped onto the reference as if the surface stood there, parallel to
its image, and compared with it in Gaussian windows (ZNCC, in which noise counts as uncorrelated). The depth of a pixel
is then chosen together with those of its neighbours (H. Hirschmueller, IEEE Trans. PAMI 30, 2008). It is known to half
a pixel of disparity: less exactly than a slanted window that has enough texture knows it, but in more places.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Int

from cuspid.geometry.semi_global import semi_global
from cuspid.mvs.refinement import GroupGeometry

_SCALES, _MOST_CELLS = (1.0, 0.5, 0.25, 0.125), 24_000_000
"""Sizes of the images, the largest of which is taken that needs no more cells of cost."""
_STEP_PX, _SIGMA_PX = 0.5, 2.0
"""Distance of two labels, px of disparity, and standard deviation of the windows, px; both at that size."""
_SMALL, _LARGE = 0.3, 1.5
"""Penalties of a step by one label and of a jump, where a perfect match costs 0 and none 1."""
_LEAST_ZNCC = 0.2
"""What correlates less than this is no match."""
_REACH, _STEEP = 5, 0.15
"""Depths are evened out over so many pixels of the grid, where their noise would tilt the surface by more than this
from pixel to pixel."""
_SAME_SIGMAS = 3.0
"""Depths that differ by more, in standard deviations, belong to different surfaces."""
SIGMA_PX = 0.5
"""Standard deviation of the disparity, px at the size of the images that were compared."""


def sweep(
    images: Float[np.ndarray, "c h w"],
    sizes: Int[np.ndarray, "c 2"],
    reference: int,
    geometry: GroupGeometry,
    q_range: tuple[float, float],
    spacing_px: int,
    noise_dn: float,
) -> tuple[Float[np.ndarray, "rows columns"], float]:
    """Inverse depth times ``geometry.scale`` on the grid of every ``spacing_px``-th pixel, NaN where nothing matches,
    and its standard deviation. Arguments as for :func:`cuspid.mvs.refinement.refine`."""
    height, width = (int(side) for side in sizes[reference])
    low, high = q_range
    scale = next((s for s in _SCALES if s**3 * height * width * (high - low) / _STEP_PX <= _MOST_CELLS), _SCALES[-1])
    step = _STEP_PX / scale
    labels = low + step * np.arange(max(int(np.ceil((high - low) / step)) + 1, 3))
    one, to_full = _downsample(images[reference, :height, :width], scale)
    others = [_downsample(images[k, : sizes[k, 0], : sizes[k, 1]], scale) for k in geometry.others]
    mean, variance = _moments(one)
    zncc = np.empty((*one.shape, len(labels)), dtype=np.float32)
    for number, q in enumerate(labels):
        seen = []
        for (other, to_other), a, b in zip(others, geometry.infinite, geometry.parallax, strict=True):
            homography = np.linalg.inv(to_other) @ (a + q * np.outer(b, [0.0, 0.0, 1.0])) @ to_full
            seen.append(_zncc(one, mean, variance, *_warp_image(other, homography, one.shape), noise_dn))
        # Half of the sources may look past what is in front of the surface there.
        best = np.sort(np.stack(seen), axis=0)[len(seen) // 2 :]
        zncc[..., number] = best.mean(axis=0)
    chosen = semi_global(1 - zncc, _SMALL, _LARGE)
    at = np.take_along_axis(zncc, np.rint(chosen).astype(np.int64)[..., None], axis=2)[..., 0]
    q = np.where(at >= _LEAST_ZNCC, np.clip(low + step * chosen, low, high), np.nan)
    return _sample_grid(q, np.linalg.inv(to_full), (height, width), spacing_px), SIGMA_PX / scale


def _downsample(
    image: Float[np.ndarray, "h w"], scale: float
) -> tuple[Float[np.ndarray, "r c"], Float[np.ndarray, "3 3"]]:
    """A smaller image, and what takes its pixels (first centre at 0) to those of the whole one."""
    height, width = image.shape
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    reduced = image if scale == 1 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    by_x, by_y = width / size[0], height / size[1]
    return np.asarray(reduced), np.array([[by_x, 0, (by_x - 1) / 2], [0, by_y, (by_y - 1) / 2], [0, 0, 1.0]])


def _warp_image(
    image: Float[np.ndarray, "h w"], homography: Float[np.ndarray, "3 3"], shape: tuple[int, ...]
) -> tuple[Float[np.ndarray, "r c"], Float[np.ndarray, "r c"]]:
    """An image as seen through a homography from another one's pixels, and where it shows anything there."""
    size, flags = shape[::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    shown = cv2.warpPerspective(np.ones_like(image), homography, size, flags=flags)
    return np.asarray(cv2.warpPerspective(image, homography, size, flags=flags)), np.asarray(shown)


def _blur(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _SIGMA_PX))


def _moments(image: Float[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Mean and variance in the window around each pixel."""
    mean = _blur(image)
    return mean, np.maximum(_blur(image * image) - mean * mean, 0)


def _zncc(
    one: Float[np.ndarray, "h w"],
    mean: Float[np.ndarray, "h w"],
    variance: Float[np.ndarray, "h w"],
    other: Float[np.ndarray, "h w"],
    shown: Float[np.ndarray, "h w"],
    noise_dn: float,
) -> Float[np.ndarray, "h w"]:
    """Correlation in the window around each pixel, less where there is little but noise; 0 where nothing is shown."""
    other_mean, other_variance = _moments(other)
    together = _blur(one * other) - mean * other_mean
    noise = noise_dn**2
    zncc = together / np.sqrt((variance + noise) * (other_variance + noise))
    return np.where(_blur(shown) > 0.99, zncc, 0).astype(np.float32)


def _sample_grid(
    values: Float[np.ndarray, "h w"], from_full: Float[np.ndarray, "3 3"], size: tuple[int, int], spacing_px: int
) -> Float[np.ndarray, "rows columns"]:
    """The nearest value at every ``spacing_px``-th pixel of the whole image."""
    rows, columns = (np.arange(spacing_px // 2, side, spacing_px) for side in size)
    y = np.rint(from_full[1, 1] * rows + from_full[1, 2]).astype(np.int64).clip(0, values.shape[0] - 1)
    x = np.rint(from_full[0, 0] * columns + from_full[0, 2]).astype(np.int64).clip(0, values.shape[1] - 1)
    return values[np.ix_(y, x)]


def even_out(
    depth_mm: Float[np.ndarray, "h w"], sigma_mm: Float[np.ndarray, "h w"], focal_px: float
) -> Float[np.ndarray, "h w"]:
    """Depths on a grid of a camera with this focal length (px of the grid), averaged with those of the same surface
    around them where their own noise would tilt it; a surface needs normals."""
    inverse, spread = 1 / depth_mm, sigma_mm / depth_mm**2
    total, weight = np.zeros_like(inverse), np.zeros_like(inverse)
    padded = [np.pad(each, _REACH, constant_values=np.nan) for each in (inverse, spread)]
    height, width = inverse.shape
    for down in range(2 * _REACH + 1):
        for right in range(2 * _REACH + 1):
            there, of = (each[down : down + height, right : right + width] for each in padded)
            near = np.exp(-2 * ((down - _REACH) ** 2 + (right - _REACH) ** 2) / _REACH**2)
            with np.errstate(invalid="ignore"):
                same = np.abs(there - inverse) < _SAME_SIGMAS * np.hypot(of, spread)
            share = np.where(same, near / np.maximum(of, spread) ** 2, 0)
            total += np.where(same, share * there, 0)
            weight += share
    with np.errstate(invalid="ignore", divide="ignore"):
        tilted = sigma_mm > _STEEP * depth_mm / focal_px
        return np.where(tilted & (weight > 0), weight / total, depth_mm)
