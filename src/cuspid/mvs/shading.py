"""Depth of plain surfaces from their light and shade: no texture is needed, but lights that all cameras share.

The cameras of a rig expose at once under the same lights, so that the shade of a matte surface looks the same from all
of them. Normalising brightness over a window, as for texture, would remove what is matched. Three lights at different
places, one for each channel, give three shades of one exposure (R. Woodham, Optical Engineering 19, 1980, has the idea
for one camera). Then the ratios of the channels are compared: the gain of a camera, the falloff of its lens, the colour
of the tooth and the light that does not leave a clear surface at grazing angles are the same in all channels, and
cancel. Under lights of one colour brightness itself must be compared, and a first depth shows how much of it was lost.
Mirror reflections move with the camera: crossed polarisers take most of them away, a first depth predicts what is left
(:mod:`cuspid.mvs.glare`), which is taken off; what burns out is not compared, and a camera that differs from the others
is left out.

First planes of constant inverse depth are swept (R. Collins, CVPR 1996) over a coarse grid, by clipped absolute
differences of the better half of the cameras, and the plane of each cell is chosen by semi-global optimisation. Then a
slanted plane is fitted around each pixel by Gauss-Newton, as in :mod:`cuspid.mvs.refinement`, whose notation is used
here, with the plain differences of brightness as residuals. Last a smooth surface is laid through all of them
(:mod:`cuspid.mvs.smoothing`): windows are small, and where the shade does not change they carry little information. It
may bend where the colour changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple, no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from cuspid.geometry import unit
from cuspid.geometry.semi_global import semi_global
from cuspid.model.camera import Camera
from cuspid.model.rig import Light, Sensor
from cuspid.mvs.confidence import ConfidenceOptions
from cuspid.mvs.glare import estimate_glare
from cuspid.mvs.rectification import IdealView
from cuspid.mvs.refinement import FAST, GroupGeometry, solve
from cuspid.mvs.smoothing import smooth
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range

_BURNT_DN, _DARK_DN, _UNUSABLE = 252, 16, np.float32(-1)
"""A channel from the first level on is burnt out, a pixel whose channels all lie below the second shows nothing:
darkness looks alike everywhere. Both have the last value among those that are compared."""
_LEAST_SHARE = 0.5
"""Share of a window that another camera must see for it to be compared."""
_LEAST_PLANES = 3
"""So many planes have a middle one, with fractions."""
_STRIDE = 2
"""Distance between the compared pixels of a window."""
_SMOOTH_PX = 4.0
"""Neighbours on the swept grid whose disparities differ by more are not on one surface."""
_LENIENT = 2
_ROUNDS = 2
"""How often the depth is refined once it is known where lights are mirrored."""
_COLOURED = 0.2
"""Difference of the colours (unit vectors) of two lights from which on they are told apart."""
_COMMON_DN, _LEAST_DN, _ABOVE_ZERO = 100.0, 4.0, 600.0
"""Brightness for which ratios are scaled, below which they are not taken, and what keeps them positive."""
_SIGMA_PX, _LEAST_VARIANCE = 1.7, 1e-9
"""Standard deviation (px) of a depth whose fit gives 1 px, and the least variance of a fit. Errors are as the square
root of what fits give: samples that overlap understate them, a smooth start keeps them small where images tell little.
"""
_POOLED_PX, _TINY = 2.0, 1e-12
"""Standard deviation, in pixels of the depth map, of the weight by which neighbours tell how well a smooth surface is
known."""
_SLANT_DAMPING = 3.0
"""Added to the normal equations of the slants, for each camera: what DN^2 of slope would add."""


@dataclass(frozen=True, kw_only=True)
class ShadingOptions(Options):
    """Depth of plain surfaces, from their light and shade."""

    sweep_step_px: Annotated[float, Range(0.5, 100)] = 2.0
    """Distance between the planes that are swept, in px of disparity of the widest pair."""
    sweep_spacing: Annotated[int, Range(1, 100)] = 2
    """The planes are swept at every n-th pixel of the depth map, in each direction."""
    blur_px: Annotated[float, Range(0.1, 100)] = 2.0
    """Standard deviation of the Gaussian filter over the images, px. The slopes of shade are small: noise in them would
    make every step of the refinement too short."""
    unlike_dn: Annotated[float, Range(0.1, 255)] = 8.0
    """Difference of brightness (mean of the channels, digital numbers) beyond which places are no more unlike."""
    small_jump: Annotated[float, Range(0, 1000)] = 0.04
    """Penalty for a plane that is the next one to its neighbour's; costs lie between 0 and 1 (unlike)."""
    large_jump: Annotated[float, Range(0, 1000)] = 0.5
    """Penalty for a plane that is farther from its neighbour's."""
    radius_px: Annotated[int, Range(1, 50)] = 2
    """Half the side of the window of the refinement (2: 5 x 5 px)."""
    window_sigma_px: Annotated[float, Range(0.1, 100)] = 2.5
    """Standard deviation of the Gaussian weight over the window."""
    iterations: Annotated[int, Range(1, 1000)] = 10
    """Maximum number of Gauss-Newton steps."""
    converged_px: Annotated[float, Range(1e-6, 10)] = 0.03
    """A step below this many px of disparity ends the iterations."""
    camera_rms_dn: Annotated[float, Range(0.1, 255)] = 6.0
    """A camera whose brightness differs by more (RMS over the window, digital numbers) sees something else."""
    camera_lag_dn: Annotated[float, Range(0, 255)] = 2.0
    """A camera whose difference exceeds the best one's by more sees something else."""
    bend_px: Annotated[float, Range(0.001, 1000)] = 0.14
    """How much a surface bends from one pixel of the depth map to the next: change of its slope, px of disparity.
    Smaller values make surfaces smoother where the images constrain them weakly."""
    glare_dn: Annotated[float, Range(0.001, 1000)] = 0.05
    """Where mirror reflections of the lights are uncertain by this much (digital numbers), brightness counts half."""
    exit_index: Annotated[float, Range(1, 3)] = 1.4
    """Refractive index of the surface, by which less of its light leaves it at grazing angles; 1 for what is matte.
    Only lights of one colour need it."""
    confidence: ConfidenceOptions = field(
        default_factory=lambda: ConfidenceOptions(agreement_sigmas=1.0, max_sigma=4.0, best_sigma=1.0)
    )
    """Checks and weights. Shade is broad: the limits are wider than those for texture. Smooth surfaces agree easily
    where two cameras are deceived alike, so that standard deviations excuse less."""

    @property
    def window(self) -> Float32[np.ndarray, "k k"]:
        """Weights of the window of the refinement, at every second pixel: the images are smooth."""
        steps = self.radius_px // _STRIDE
        offsets = _STRIDE * np.arange(-steps, steps + 1)
        return np.exp(-0.5 * (offsets[:, None] ** 2 + offsets**2) / self.window_sigma_px**2).astype(np.float32)


class _View(NamedTuple):
    """What the kernels see of a reference camera and its group."""

    images: np.ndarray
    """(camera, row, column, channel), brightness in digital numbers, `_UNUSABLE` where that is not known."""
    trust: np.ndarray
    """Weight of each of them."""
    reference: int
    infinite: np.ndarray
    parallax: np.ndarray
    others: np.ndarray


class _Fit(NamedTuple):
    """What the refinement is asked for."""

    window: np.ndarray
    iterations: int
    converged: float
    camera_rms: float
    lag: float
    lowest: float
    highest: float
    lenient: int
    """Iterations that let cameras in which do not agree well yet: the start may be some pixels off."""
    correlation: float
    """Of weighted samples, by which their normal equations understate a variance."""


# --- what is compared --------------------------------------------------------------------------------------------


def correction(camera: Camera, sensor: Sensor) -> Float32[np.ndarray, "h w 1"]:
    """What turns the digital numbers of a camera into those of one of gain 1 without falloff, pixel by pixel."""
    return sensor.relative_response(camera, camera.pixel_centres())[..., None].astype(np.float32) ** (-1 / sensor.gamma)


def brightness(
    views: Sequence[IdealView],
    images: Sequence[UInt8[np.ndarray, "_ _ 3"] | Float32[np.ndarray, "_ _ 3"]],
    corrections: Sequence[Float32[np.ndarray, "_ _ 1"]],
) -> Float32[np.ndarray, "c h w 3"]:
    """What the cameras of a group are compared by, in digital numbers; `_UNUSABLE` where a channel burnt out, where it
    is dark, where the real camera saw nothing, and beyond the smaller images."""
    sizes = np.array([image.shape[:2] for image in images])
    stack = np.full((len(images), *sizes.max(axis=0), 3), _UNUSABLE)
    for slot, view, image, factor in zip(stack, views, images, corrections, strict=True):
        useless = (image >= _BURNT_DN) | (cv2.blur(image, (3, 3)).max(axis=-1) < _DARK_DN)[..., None]
        useless = cv2.dilate(useless.astype(np.float32), np.ones((3, 3), np.uint8))
        seen = view.resample_values(image.astype(np.float32) * factor, 0.0)
        usable = view.resample_values(useless, 1.0) <= 0
        slot[: image.shape[0], : image.shape[1]] = np.where(usable, seen, _UNUSABLE)
    return stack


def _masked_blur(image: Float32[np.ndarray, "h w 3"], sigma_px: float) -> Float32[np.ndarray, "h w 3"]:
    """Smooth where it is usable."""
    usable = (image >= 0).astype(np.float32)
    weight = cv2.GaussianBlur(usable, (0, 0), sigma_px)
    smooth = cv2.GaussianBlur(image * usable, (0, 0), sigma_px) / np.maximum(weight, np.float32(1e-6))
    return np.where(image >= 0, smooth, _UNUSABLE)


@kernel(inline="always", **FAST)
@no_type_check
def _place(view, j, u, v, q):
    """Where a pixel of the reference lies in another image, and its depth there as a multiple of that here."""
    a, b = view.infinite, view.parallax
    z = a[j, 2, 0] * u + a[j, 2, 1] * v + a[j, 2, 2] + q * b[j, 2]
    x = (a[j, 0, 0] * u + a[j, 0, 1] * v + a[j, 0, 2] + q * b[j, 0]) / z
    y = (a[j, 1, 0] * u + a[j, 1, 1] * v + a[j, 1, 2] + q * b[j, 1]) / z
    return x, y, z


@kernel(inline="always", **FAST)
@no_type_check
def _is_in(view, x, y, z):
    """Whether a place has four pixels around it."""
    height, width = view.images.shape[1:3]
    return z > 1e-6 and x >= 0 and y >= 0 and x < width - 1 and y < height - 1


@kernel(inline="always", **FAST)
@no_type_check
def _bilinear_corners(view, j, row, column, channel):
    """The four pixels around a place, and whether all of them are usable."""
    images, camera = view.images, view.others[j]
    a, b = images[camera, row, column, channel], images[camera, row, column + 1, channel]
    c, d = images[camera, row + 1, column, channel], images[camera, row + 1, column + 1, channel]
    return a, b, c, d, min(min(a, b), min(c, d)) >= 0


# --- the sweep ---------------------------------------------------------------------------------------------------


@kernel(**FAST)
@no_type_check
def _difference(view, j, u, v, q):
    """Mean difference of brightness of a pixel and another image on a plane; negative where it cannot be told."""
    x, y, z = _place(view, j, u, v, q)
    if not _is_in(view, x, y, z):
        return np.float32(-1)
    column, row = int(x), int(y)
    fx, fy = np.float32(x - column), np.float32(y - row)
    total, count = np.float32(0), 0
    for channel in range(view.images.shape[3]):
        here = view.images[view.reference, v, u, channel]
        a, b, c, d, usable = _bilinear_corners(view, j, row, column, channel)
        if usable and here >= 0:
            top, bottom = a + fx * (b - a), c + fx * (d - c)
            total += abs(top + fy * (bottom - top) - here)
            count += 1
    return total / count if count > 0 else np.float32(-1)


@kernel(**FAST)
@no_type_check
def _costs(view, columns, rows, planes, unlike):
    """What the better half of the cameras differ by at each place and plane, as a share of ``unlike``, at most 1."""
    count = view.others.size
    half = (count + 1) // 2
    costs = np.empty((rows.size, columns.size, planes.size), np.float32)
    each = np.empty(count, np.float32)
    for r in range(rows.size):
        for c in range(columns.size):
            for k in range(planes.size):
                for j in range(count):
                    difference = _difference(view, j, columns[c], rows[r], planes[k])
                    each[j] = min(difference, unlike) if difference >= 0 else unlike
                each.sort()
                costs[r, c, k] = each[:half].sum() / (half * unlike)
    return costs


def _sweep(
    view: _View,
    rows: Int[np.ndarray, "r"],
    columns: Int[np.ndarray, "c"],
    planes: Float[np.ndarray, "p"],
    options: ShadingOptions,
) -> Float[np.ndarray, "r c"]:
    """Scaled inverse depth at some rows and columns of the reference."""
    costs = _costs(view, columns, rows, planes, np.float32(options.unlike_dn))
    for k in range(len(planes)):
        costs[..., k] = cv2.blur(costs[..., k], (3, 3))
    label = semi_global(costs, options.small_jump, options.large_jump)
    return np.asarray(planes[0] + label * options.sweep_step_px)


@kernel
@no_type_check
def _upsample_planes(coarse, spacing, rows, columns, fine):
    """Planes for a grid of pixels from those of a coarser one: q, and its slopes where the surface is smooth."""
    out = np.zeros((rows.size, columns.size, 3))
    height, width = coarse.shape
    for r in range(rows.size):
        i = min(r // spacing, height - 1)
        for c in range(columns.size):
            j = min(c // spacing, width - 1)
            right = coarse[i, min(j + 1, width - 1)] - coarse[i, max(j - 1, 0)]
            down = coarse[min(i + 1, height - 1), j] - coarse[max(i - 1, 0), j]
            out[r, c, 1] = right / (2 * spacing * fine) if abs(right) < 2 * _SMOOTH_PX else 0.0
            out[r, c, 2] = down / (2 * spacing * fine) if abs(down) < 2 * _SMOOTH_PX else 0.0
            away = fine * (c - j * spacing - spacing // 2), fine * (r - i * spacing - spacing // 2)
            out[r, c, 0] = coarse[i, j] + out[r, c, 1] * away[0] + out[r, c, 2] * away[1]
    return out


# --- the refinement ----------------------------------------------------------------------------------------------


@kernel(**FAST)
@no_type_check
def _add_sample(view, j, u, v, du, dv, plane, weight, system):
    """Add a pixel of the window to the normal equations of another camera; returns the number of channels used.

    ``system``: H (upper triangle, row by row), the gradient, the squared differences, the weights.
    """
    x, y, z = _place(view, j, u + du, v + dv, plane[0] + plane[1] * du + plane[2] * dv)
    if not _is_in(view, x, y, z):
        return 0
    column, row = int(x), int(y)
    fx, fy, used = x - column, y - row, 0
    near_column, near_row, camera = int(x + 0.5), int(y + 0.5), view.others[j]
    along_x = (view.parallax[j, 0] - x * view.parallax[j, 2]) / z
    along_y = (view.parallax[j, 1] - y * view.parallax[j, 2]) / z
    for channel in range(view.images.shape[3]):
        here = view.images[view.reference, v + dv, u + du, channel]
        a, b, c, d, usable = _bilinear_corners(view, j, row, column, channel)
        if not usable or here < 0:
            continue
        top, bottom = a + fx * (b - a), c + fx * (d - c)
        difference = top + fy * (bottom - top) - here
        slope = ((b - a) + fy * ((d - c) - (b - a))) * along_x + (bottom - top) * along_y
        trusted = (
            view.trust[view.reference, v + dv, u + du, channel],
            view.trust[camera, near_row, near_column, channel],
        )
        w = weight * min(trusted)
        ws, wd = w * slope * slope, w * slope * difference
        system[0] += ws
        system[1] += ws * du
        system[2] += ws * dv
        system[3] += ws * du * du
        system[4] += ws * du * dv
        system[5] += ws * dv * dv
        system[6] += wd
        system[7] += wd * du
        system[8] += wd * dv
        system[9] += w * difference * difference
        system[10] += w
        used += 1
    return used


@kernel(**FAST)
@no_type_check
def _compare(view, fit, u, v, plane, systems):
    """The normal equations of each other camera, with its RMS difference in the last column; that is infinite where too
    little of the window is seen."""
    size, channels = fit.window.shape[0], view.images.shape[3]
    radius = _STRIDE * (size // 2)
    for j in range(view.others.size):
        seen, whole = 0.0, 0.0
        systems[j] = 0
        for row in range(size):
            for column in range(size):
                du, dv, weight = _STRIDE * column - radius, _STRIDE * row - radius, fit.window[row, column]
                used = _add_sample(view, j, u, v, du, dv, plane, weight, systems[j])
                seen += weight * used
                whole += weight * channels
        enough = seen > _LEAST_SHARE * whole / channels
        systems[j, 9] = np.sqrt(systems[j, 9] / systems[j, 10]) if enough else np.inf


@kernel(**FAST)
@no_type_check
def _combine(systems, rms, lag, total):
    """Sum the equations of the cameras that see the same; returns how many, and their mean squared difference."""
    best = systems[:, 9].min()
    total[:] = 0
    used, square = 0, 0.0
    for j in range(len(systems)):
        if systems[j, 9] <= rms and systems[j, 9] <= best + lag:
            used += 1
            square += systems[j, 9] ** 2
            for k in range(9):
                total[k] += systems[j, k]
    total[3] += used * _SLANT_DAMPING
    total[5] += used * _SLANT_DAMPING
    return used, square / max(used, 1)


@kernel(**FAST)
@no_type_check
def _refine_plane(view, fit, u, v, plane, systems, total, step):
    """Gauss-Newton from a plane, changed in place; returns the variance of q and the number of cameras, 0 if it
    failed."""
    variance, used = 0.0, 0
    for iteration in range(fit.iterations):
        _compare(view, fit, u, v, plane, systems)
        rms = fit.camera_rms if iteration >= fit.lenient else 3 * fit.camera_rms
        used, square = _combine(systems, rms, fit.lag, total)
        factor = solve(total, step) if used > 0 else -1.0
        if factor < 0:
            return 0.0, 0
        variance = square * factor * fit.correlation
        length = abs(step[0])
        shrink = 1.0 if length <= 1 else 1 / length
        for k in range(3):
            plane[k] += shrink * step[k]
        if length < fit.converged and iteration >= fit.lenient:
            break
    return variance, used


@kernel(**FAST)
@no_type_check
def _refine_all(view, fit, rows, columns, planes):
    """For each pixel of the grid q, its variance, and the number of cameras, 0 where nothing is found. The planes, from
    which it starts, become those found."""
    height, width = view.images.shape[1:3]
    radius = _STRIDE * (fit.window.shape[0] // 2)
    out = np.zeros((rows.size, columns.size, 3))
    systems, total, step = np.zeros((view.others.size, 11)), np.zeros(9), np.zeros(3)
    plane = np.zeros(3)
    for r in range(rows.size):
        for c in range(columns.size):
            u, v = columns[c], rows[r]
            if radius <= u < width - radius and radius <= v < height - radius:
                plane[:] = planes[r, c]
                variance, used = _refine_plane(view, fit, u, v, plane, systems, total, step)
                if used > 0 and fit.lowest <= plane[0] <= fit.highest:
                    out[r, c, 0], out[r, c, 1], out[r, c, 2] = plane[0], variance, used
                    planes[r, c] = plane
    return out


class ShadedView(NamedTuple):
    """A camera of a group."""

    grid: Camera
    """Pinhole camera of its depth map, of every ``spacing_px``-th pixel."""
    size: tuple[int, int]
    """Height and width of its images."""
    geometry: GroupGeometry
    """With this camera as the reference."""
    lights: Sequence[Light]
    """Those that are on, in the frame of the camera."""
    gamma: float
    """Encoding exponent."""


def shaded_depths(
    images: Float32[np.ndarray, "c h w 3"],
    views: Sequence[ShadedView],
    depth_range_mm: tuple[float, float],
    spacing_px: int,
    options: ShadingOptions,
) -> list[tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]]:
    """For each camera of a group depth (mm) and its standard deviation on the grid of its depth map, NaN where nothing
    is found.

    ``images`` are those of :func:`brightness`.
    """
    blurred = np.stack([_masked_blur(image, options.blur_px) for image in images])
    compared_of = _ratios if _are_coloured(views[0].lights) else _intensities
    compared, trust = compared_of(blurred, np.ones_like(blurred))
    refinements = [
        _Refinement(compared, hue, index, view, depth_range_mm, spacing_px, options)
        for index, (view, hue) in enumerate(zip(views, _hues(blurred), strict=True))
    ]
    found = [each.refine(compared, trust, _LENIENT) for each in refinements]
    for _ in range(_ROUNDS):
        depths = [depth for depth, _ in found]
        compared, trust = compared_of(*_matte(blurred, views, depths, spacing_px, options))
        found = [each.refine(compared, trust, 0) for each in refinements]
    return found


_Compared = tuple[Float32[np.ndarray, "c h w 3"], Float32[np.ndarray, "c h w 3"]]


def _matte(
    images: Float32[np.ndarray, "c h w 3"],
    views: Sequence[ShadedView],
    depths: Sequence[Float[np.ndarray, "rows columns"]],
    spacing_px: int,
    options: ShadingOptions,
) -> _Compared:
    """The images as they would be without mirror reflections and without what does not leave the surface, as a first
    depth tells, and how far to trust that."""
    matte, trust = images.copy(), np.ones_like(images)
    for view, image, weight, depth in zip(views, matte, trust, depths, strict=True):
        part, encoded = np.s_[: view.size[0], : view.size[1]], np.float32(-1 / view.gamma)
        what = estimate_glare(view.grid, depth, view.lights, options.exit_index)
        spot, uncertain, share = (_spread_values(each, view.size, spacing_px) for each in what)
        weight[part] = trust_weights(image[part], uncertain, view.gamma, options.glare_dn)
        image[part] = np.where(image[part] >= 0, image[part] * ((1 + spot) * share[..., None]) ** encoded, _UNUSABLE)
    return matte, trust


def trust_weights(
    image: Float32[np.ndarray, "*n"], uncertain: Float32[np.ndarray, "*n"], gamma: float, glare_dn: float
) -> Float32[np.ndarray, "*n"]:
    """Weight of brightness (digital numbers) whose mirror reflections are uncertain by a share of the shade: half where
    that is ``glare_dn``."""
    left = np.maximum(image, 0) * (1 - (1 + uncertain) ** np.float32(-1 / gamma))
    return 1 / (1 + (left / np.float32(glare_dn)) ** 2)


def _are_coloured(lights: Sequence[Light]) -> bool:
    """Whether the channels see different shades."""
    return any(np.abs(unit(one.colour) - unit(lights[0].colour)).max() > _COLOURED for one in lights)


def _intensities(images: Float32[np.ndarray, "c h w 3"], trust: Float32[np.ndarray, "c h w 3"]) -> _Compared:
    return images, trust


def _ratios(images: Float32[np.ndarray, "c h w 3"], trust: Float32[np.ndarray, "c h w 3"]) -> _Compared:
    """Ratios of each channel to the next one, and how far both are to be trusted, where they are darker also because of
    their noise. Ratios are logarithms, times what makes a change of a channel at common brightness one of as many
    digital numbers, and never negative."""
    there = images >= _LEAST_DN
    share = np.maximum(images, _LEAST_DN) / np.float32(_COMMON_DN)
    level = _COMMON_DN * np.log(share)
    variance = share**-2 + np.roll(share, -1, axis=-1) ** -2
    both = there & np.roll(there, -1, axis=-1)
    ratios = np.where(both, level - np.roll(level, -1, axis=-1) + _ABOVE_ZERO, _UNUSABLE)
    return ratios.astype(np.float32), 2 / variance * np.minimum(trust, np.roll(trust, -1, axis=-1))


def _hues(images: Float32[np.ndarray, "*n 3"]) -> Float32[np.ndarray, "*n 3"]:
    """Logarithms of the ratios of each channel to the next one, which brightness does not change."""
    level = np.log(np.maximum(images, np.float32(_LEAST_DN)))
    return level - np.roll(level, -1, axis=-1)


def _spread_values(
    values: Float32[np.ndarray, "h w *c"], size: tuple[int, int], spacing_px: int
) -> Float32[np.ndarray, "_ _ *c"]:
    """From every n-th pixel to all."""
    rows, columns = ((np.arange(count, dtype=np.float32) - spacing_px // 2) / spacing_px for count in size)
    where = np.meshgrid(columns, rows)
    return np.asarray(cv2.remap(values, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


class _Refinement:
    """Depth of one camera, refined as often as is asked for."""

    def __init__(
        self,
        images: Float32[np.ndarray, "c h w 3"],
        colours: Float32[np.ndarray, "_ _ 3"],
        reference: int,
        view: ShadedView,
        depth_range_mm: tuple[float, float],
        spacing_px: int,
        options: ShadingOptions,
    ) -> None:
        geometry = self._geometry = view.geometry
        self._spacing_px, self._bend_px = spacing_px, options.bend_px
        self._view = _View(images, images, reference, geometry.infinite, geometry.parallax, geometry.others)
        self._rows, self._columns = (np.arange(spacing_px // 2, count, spacing_px) for count in view.size)
        self._colours = colours[np.ix_(self._rows, self._columns)]
        lowest, highest = (view.geometry.scale / depth for depth in reversed(depth_range_mm))
        self._fit = _fit(options, lowest, highest)
        count = max(int(np.ceil((highest - lowest) / options.sweep_step_px)) + 1, _LEAST_PLANES)
        planes = lowest + options.sweep_step_px * np.arange(count)
        every = min(options.sweep_spacing, len(self._rows), len(self._columns))
        coarse = _sweep(
            self._view, self._rows[every // 2 :: every], self._columns[every // 2 :: every], planes, options
        )
        self._planes = _upsample_planes(coarse, every, self._rows, self._columns, spacing_px)

    def refine(
        self, images: Float32[np.ndarray, "c h w 3"], trust: Float32[np.ndarray, "c h w 3"], lenient: int
    ) -> tuple[Float[np.ndarray, "rows columns"], Float[np.ndarray, "rows columns"]]:
        """Depth and standard deviation, from what was found before."""
        view = self._view._replace(images=images, trust=trust)
        fit = self._fit._replace(lenient=lenient)
        found = _refine_all(view, fit, self._rows, self._columns, self._planes)
        sigma = _SIGMA_PX * np.maximum(found[..., 1], _LEAST_VARIANCE) ** 0.25
        known = found[..., 2] > 0
        q = smooth(np.where(known, found[..., 0], np.nan), sigma, self._bend_px, self._colours)
        self._restart(q)
        scale = self._geometry.scale
        return scale / q, _pool_sigma(sigma, known) * scale / q**2

    def _restart(self, q: Float[np.ndarray, "rows columns"]) -> None:
        """From a smooth surface, next time, where it is known."""
        along = [_slope(q, axis) / self._spacing_px for axis in (1, 0)]
        for channel, values in enumerate((q, *along)):
            self._planes[..., channel] = np.where(np.isfinite(values), values, self._planes[..., channel])


def _pool_sigma(sigma: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Standard deviation of a smooth surface, of which neighbours tell, too; NaN where it is not known."""
    precision = cv2.GaussianBlur(np.where(known, sigma, np.inf) ** -2, (0, 0), _POOLED_PX)
    return np.where(known, np.maximum(precision, _TINY) ** -0.5, np.nan)


def _slope(values: Float[np.ndarray, "h w"], axis: int) -> Float[np.ndarray, "h w"]:
    """Mean difference to the pixels on both sides, or to the one that is known; NaN without any."""
    step = np.diff(values, axis=axis)
    empty = np.full_like(values.take([0], axis=axis), np.nan)
    sides = np.stack([np.concatenate([empty, step], axis=axis), np.concatenate([step, empty], axis=axis)])
    known = np.isfinite(sides)
    return np.where(known, sides, 0).sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan)


def _fit(options: ShadingOptions, lowest: float, highest: float) -> _Fit:
    window = options.window
    return _Fit(
        window=window,
        iterations=options.iterations,
        converged=options.converged_px,
        camera_rms=options.camera_rms_dn,
        lag=options.camera_lag_dn,
        lowest=lowest,
        highest=highest,
        lenient=0,
        correlation=float((window**2).sum() / window.sum()),
    )
