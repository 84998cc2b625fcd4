"""Sub-pixel depth from all cameras of a group: slanted patches, Gauss-Newton on normalised intensities.

For a pixel (u, v) of the reference image, a small window is treated as a plane in space, whose inverse depth is affine
in the pixel coordinates: with an offset (du, dv) from the centre

    q(du, dv) = q + q_u du + q_v dv,      x_j ~ A_j (u + du, v + dv, 1) + q(du, dv) b_j,

where x_j is the pixel in camera j, A_j = K_j R_j K_ref^-1, b_j = K_j t_j / s, and q = s / Z is inverse depth scaled by
s, the longest of the K_j t_j, so that q counts pixels of disparity in the widest pair. Patches are brought to weighted
mean 0 and norm 1, so that gain and offset of a camera do not matter; their inner product is the ZNCC. (q, q_u, q_v)
minimises the summed squared differences over the cameras that see the patch; a camera whose ZNCC falls behind is
considered occluded and left out. Pixels are OpenCV's here: the first centre is 0.

A window across an edge sees two planes, and rounds the edge off. Where the planes around a pixel differ, halves of its
window are therefore tried as well, each from the plane on its side, and the one that leaves the least unexplained is
taken. What is blurred has larger windows: they need some detail within them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple, no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Int

from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range

Q, Q_U, Q_V, SCORE, VARIANCE, SUPPORT = range(6)
"""Channels of a refined field: the plane, mean ZNCC of the cameras used, variance of q, number of cameras."""

_ROUNDING_DN = 12**-0.5
_FLAT_DN = 0.05
"""Noise of a window in which next to nothing changes: no sensor made it."""

_BEND_PX = 0.75
_SIDES = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
"""Rows and columns towards which half windows lie."""

_DARK_DN, _DARK_SHARE = 16, 0.1
"""Pixels below this level, or below this share of an image's brightest ones if that is less, are dark."""
_RATIOS = 1.001, 3.999
"""Mean squared differences 4 px apart, over those 2 px apart: fine noise has 1, a slope 4."""
_DETAILS, _SIGMAS_PX, _REACH = 0.65, (2.0, 3.0), 1.5
"""Standard deviation of a window's weight, in distances within which the image changes, its bounds, and the radius of
the window in standard deviations."""

FAST = {"fastmath": {"contract", "reassoc", "arcp", "nsz"}}


@dataclass(frozen=True, kw_only=True)
class RefinementOptions(Options):
    """Multi-camera refinement of depth."""

    radius_px: Annotated[int | None, Range(1, 50)] = None
    """Half the side of the window (3: 7 x 7 px). Default: one and a half standard deviations of its weight."""
    window_sigma_px: Annotated[float | None, Range(0.1, 100)] = None
    """Standard deviation of the Gaussian weight over the window. Default: 2, and up to 3 for an image in which nothing
    is as fine as a pixel: blurred by its lens, by a Bayer filter, or of a coarse texture."""
    iterations: Annotated[int, Range(0, 1000)] = 10
    """Maximum number of Gauss-Newton steps."""
    converged_px: Annotated[float, Range(1e-06, 10)] = 0.06
    """A step below this many px of disparity ends the iterations."""
    camera_zncc: Annotated[float, Range(-1, 1)] = 0.5
    """A camera whose correlation (ZNCC) is below this is considered occluded."""
    camera_zncc_lag: Annotated[float, Range(0, 2)] = 0.25
    """A camera whose correlation is below the best one by more than this is considered occluded."""
    accept_zncc: Annotated[float, Range(-1, 1)] = 0.75
    """Minimum mean correlation for a plane to be kept and propagated to neighbours, where the texture is much stronger
    than the noise."""
    weak_zncc: Annotated[float, Range(-1, 1)] = 0.6
    """Lower bound of that limit in weaker texture: noise of standard deviation n reduces the correlation of a texture
    of standard deviation c to the share c^2 / (c^2 + n^2)."""
    min_contrast: Annotated[float, Range(0, 1000)] = 1.2
    """Standard deviation of what no plane explains of a window's brightness, in multiples of that of the noise, below
    which it has no texture: what a plane explains is shade."""
    propagations: Annotated[int, Range(0, 100)] = 1
    """Number of times that planes are propagated to neighbours without one, in each direction."""
    bend_px: Annotated[float | None, Range(0, 1000)] = None
    """If the planes on two sides of a window differ by this much disparity at its border, they are assumed to meet in
    an edge, and halves of the window are tried. Default: 0.75, for a draft 1000, that is, nowhere."""
    half_sigmas: Annotated[float, Range(0, 100)] = 2.5
    """Half a window is taken if it leaves less of the texture unexplained (1 - ZNCC) than the whole window does, by
    this many standard deviations of what noise makes half a window leave."""


@dataclass(frozen=True, eq=False)
class GroupGeometry:
    """One reference camera and the others of its group, as arrays for the kernels."""

    infinite: Float[np.ndarray, "j 3 3"]
    """A_j."""
    parallax: Float[np.ndarray, "j 3"]
    """b_j."""
    scale: float
    """s in px mm."""
    others: Int[np.ndarray, "j"]
    """Index of each other camera in the stack of images."""


class _View(NamedTuple):
    """What the kernels see of a reference camera and its group."""

    images: np.ndarray
    pixels: np.ndarray
    sizes: np.ndarray
    reference: int
    infinite: np.ndarray
    parallax: np.ndarray
    others: np.ndarray
    window: np.ndarray
    radius: int
    spacing: int
    q_low: float
    q_high: float


class _Limits(NamedTuple):
    """The numbers of :class:`RefinementOptions`."""

    iterations: int
    converged: float
    camera_zncc: np.float32
    lag: np.float32
    accept: float
    weak: float
    noise2: float
    min_contrast: float
    effective: float


class _Buffers(NamedTuple):
    """Memory that the kernels use again for each pixel."""

    template: np.ndarray
    warp: np.ndarray
    places: np.ndarray
    indices: np.ndarray
    corners: np.ndarray
    systems: np.ndarray
    znccs: np.ndarray
    total: np.ndarray
    step: np.ndarray
    result: np.ndarray
    candidates: np.ndarray


def image_noise(image: Float[np.ndarray, "h w"]) -> float:
    """Standard deviation of the noise of an image (Immerkaer 1996), from the smoothest tenth of what is not flat, as a
    background that was masked out is; at least that of rounding to integers."""
    mask = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]).astype(np.float32) / 6
    power = cv2.boxFilter(cv2.filter2D(image, -1, mask) ** 2, -1, (15, 15))[::5, ::5]
    noisy = power[power > _FLAT_DN**2]
    return max(float(np.sqrt(np.quantile(noisy, 0.1))), _ROUNDING_DN) if noisy.size else _ROUNDING_DN


def detail_px(image: Float[np.ndarray, "h w"], noise_dn: float) -> float:
    """Distance L within which an image changes, from mean squared differences of pixels 2 and 4 px apart where it is
    not dark, less those of its noise: of a texture with the correlation exp(-(d / L)^2) at the distance d, they are as
    1 - a to 1 - a^4 with a = exp(-4 / L^2). Infinite for an image without texture."""
    near, far = (_mean_squared_difference(image, distance) - 2 * noise_dn**2 for distance in (2, 4))
    if not near > 0:
        return np.inf
    # (1 - a^4) / (1 - a) = 1 + a + a^2 + a^3 = far / near, which grows with a.
    roots = np.roots([1, 1, 1, 1 - np.clip(far / near, *_RATIOS)])
    return float(2 / np.sqrt(-np.log(roots[np.abs(roots.imag).argmin()].real)))


def _mean_squared_difference(image: Float[np.ndarray, "h w"], distance: int) -> float:
    """Of pixels so far apart in their row or column, neither of them dark; 0 if there are none."""
    dark = min(_DARK_DN, _DARK_SHARE * float(np.quantile(image[::5, ::5], 0.99)))
    return float(_mean_squared_step(image, distance, dark))


@kernel
@no_type_check
def _mean_squared_step(image, distance, dark):
    total, count = 0.0, 0
    rows, columns = image.shape
    for rows_off, columns_off in ((distance, 0), (0, distance)):
        for i in range(rows - rows_off):
            for j in range(columns - columns_off):
                here, there = image[i + rows_off, j + columns_off], image[i, j]
                if here > dark and there > dark:
                    total += (here - there) * (here - there)
                    count += 1
    return total / max(count, 1)


def window_size(
    options: RefinementOptions, image: Float[np.ndarray, "h w"], noise_dn: float, widening: int = 1
) -> tuple[int, float]:
    """Half the side of the window that suits an image, and the standard deviation of its weight, px; so many times
    wider."""
    sigma_px = options.window_sigma_px
    if sigma_px is None:
        sigma_px = float(np.clip(_DETAILS * detail_px(image, noise_dn), *_SIGMAS_PX))
    sigma_px *= widening
    return (options.radius_px or 0) * widening or max(int(_REACH * sigma_px), 1), sigma_px


def patch_window(radius_px: int, sigma_px: float, step_px: int = 1) -> Float[np.ndarray, "3 k"]:
    """Offsets du and dv over the window, row by row, of every so many pixels, and Gaussian weights with sum 1."""
    offsets = step_px * np.arange(-(radius_px // step_px), radius_px // step_px + 1)
    du, dv = np.meshgrid(offsets, offsets)
    weights = np.exp(-0.5 * (du**2 + dv**2) / sigma_px**2)
    return np.stack([du.ravel(), dv.ravel(), (weights / weights.sum()).ravel()]).astype(np.float32)


def half_window(window: Float[np.ndarray, "3 k"], side: tuple[int, int]) -> Float[np.ndarray, "3 h"]:
    """The part of a window on one side, given by rows and columns, including the middle, with weights of sum 1."""
    half = np.ascontiguousarray(window[:, window[1] * side[0] + window[0] * side[1] >= 0])
    half[2] /= half[2].sum()
    return half


def _effective(window: Float[np.ndarray, "3 k"]) -> float:
    """How many samples of equal weight a window is worth."""
    return float(1 / np.sum(window[2].astype(np.float64) ** 2))


@kernel(**FAST)
@no_type_check
def _load_template(view, u, v, template):
    """Normalised patch around a pixel of the reference image; returns its standard deviation."""
    image, window = view.images[view.reference], view.window
    weights, count = window[2], window.shape[1]
    mean = np.float32(0)
    for k in range(count):
        template[k] = image[v + int(window[1, k]), u + int(window[0, k])]
        mean += weights[k] * template[k]
    variance = np.float32(0)
    for k in range(count):
        template[k] -= mean
        variance += weights[k] * template[k] * template[k]
    deviation = np.sqrt(variance)
    if deviation > 0:
        for k in range(count):
            template[k] /= deviation
    return deviation


@kernel(**FAST)
@no_type_check
def _detail(window, template):
    """Share of the variance of a whole window's template that no plane explains."""
    along = across = moment = np.float32(0)
    for k in range(window.shape[1]):
        along += window[2, k] * window[0, k] * template[k]
        across += window[2, k] * window[1, k] * template[k]
        moment += window[2, k] * window[0, k] * window[0, k]
    return max(1 - (along * along + across * across) / moment, np.float32(0))


@kernel(inline="always", **FAST)
@no_type_check
def _is_inside(warp, radius, width, height):
    """True where the four corners of the window fall into the image, a pixel off its border."""
    for dv in (-radius, radius):
        for du in (-radius, radius):
            z = warp[0, 2] + du * warp[1, 2] + dv * warp[2, 2]
            if not z > 1e-6:
                return False
            x = (warp[0, 0] + du * warp[1, 0] + dv * warp[2, 0]) / z
            y = (warp[0, 1] + du * warp[1, 1] + dv * warp[2, 1]) / z
            if not (x >= 1 and y >= 1 and x < width - 2 and y < height - 2):
                return False
    return True


@kernel(inline="always", **FAST)
@no_type_check
def _locate(window, warp, parallax, j, places):
    """Where the window's pixels lie in another image (x, y), and how these move with q. Loops that vectorise."""
    inverse = 1 / warp[0, 2]
    x, y = warp[0, 0] * inverse, warp[0, 1] * inverse
    xu, xv = np.float32((warp[1, 0] - x * warp[1, 2]) * inverse), np.float32((warp[2, 0] - x * warp[2, 2]) * inverse)
    yu, yv = np.float32((warp[1, 1] - y * warp[1, 2]) * inverse), np.float32((warp[2, 1] - y * warp[2, 2]) * inverse)
    zu, zv = np.float32(warp[1, 2] * inverse), np.float32(warp[2, 2] * inverse)
    bx, by = np.float32(parallax[j, 0] * inverse), np.float32(parallax[j, 1] * inverse)
    bz = np.float32(parallax[j, 2] * inverse)
    x0, y0, one = np.float32(x), np.float32(y), np.float32(1)
    samples = window.shape[1]
    for k in range(samples):
        places[4, k] = one / (one + window[0, k] * zu + window[1, k] * zv)
    for k in range(samples):
        du, dv = window[0, k], window[1, k]
        places[0, k] = x0 + (du * xu + dv * xv) * places[4, k]
        places[1, k] = y0 + (du * yu + dv * yv) * places[4, k]
    for k in range(samples):
        places[2, k] = (bx - places[0, k] * bz) * places[4, k]
        places[3, k] = (by - places[1, k] * bz) * places[4, k]


@kernel(inline="always", **FAST)
@no_type_check
def _look_up(pixels, first, stride, places, indices, corners):
    """The four pixels around each place of an image that begins at ``first``; x and y become the fractions between."""
    for k in range(indices.size):
        indices[k] = np.int32(first) + np.int32(places[1, k]) * np.int32(stride) + np.int32(places[0, k])
    for k in range(indices.size):
        places[0, k] -= np.floor(places[0, k])
        places[1, k] -= np.floor(places[1, k])
    for k in range(indices.size):
        # Unsigned: numba would look for negative indices otherwise.
        above = np.uint32(indices[k])
        below = above + np.uint32(stride)
        corners[0, k], corners[1, k] = pixels[above], pixels[above + np.uint32(1)]
        corners[2, k], corners[3, k] = pixels[below], pixels[below + np.uint32(1)]


@kernel(inline="always", **FAST)
@no_type_check
def _sums(template, window, places, corners):
    """Weighted sums over the window seen in another image (bilinear): of its values, their squares and products with
    the template; of its slopes s along q, q_u and q_v, of these times values (i) and template (t); and of s times s."""
    start = corners[0, corners.shape[1] // 2]
    mean = square = product = s0 = su = sv = i0 = iu = iv = t0 = tu = tv = np.float32(0)
    h00 = h0u = h0v = huu = huv = hvv = np.float32(0)
    for k in range(window.shape[1]):
        du, dv, weight, fx, fy = window[0, k], window[1, k], window[2, k], places[0, k], places[1, k]
        a, b, c, d = corners[0, k], corners[1, k], corners[2, k], corners[3, k]
        top, bottom = a + fx * (b - a), c + fx * (d - c)
        slope_x, slope_y = (b - a) + fy * ((d - c) - (b - a)), bottom - top
        value = top + fy * slope_y - start
        slope = slope_x * places[2, k] + slope_y * places[3, k]
        mean += weight * value
        square += weight * value * value
        product += weight * value * template[k]
        ws = weight * slope
        wi, wt, wss = ws * value, ws * template[k], ws * slope
        s0 += ws
        su += ws * du
        sv += ws * dv
        i0 += wi
        iu += wi * du
        iv += wi * dv
        t0 += wt
        tu += wt * du
        tv += wt * dv
        h00 += wss
        h0u += wss * du
        h0v += wss * dv
        huu += wss * du * du
        huv += wss * du * dv
        hvv += wss * dv * dv
    return mean, square, product, s0, su, sv, i0, iu, iv, t0, tu, tv, h00, h0u, h0v, huu, huv, hvv


@kernel(inline="always", **FAST)
@no_type_check
def _normal_equations(template, window, places, corners, systems, j):
    """ZNCC of the template and the window seen in another image, and its normal equations: H (upper triangle, row by
    row), then the gradient. The patch is normalised in the sums, not pixel by pixel."""
    sums = _sums(template, window, places, corners)
    mean, square, product, s0, su, sv, i0, iu, iv, t0, tu, tv, h00, h0u, h0v, huu, huv, hvv = sums
    variance = square - mean * mean
    if not variance > 1e-6:
        return np.float32(-1)
    gain = 1 / np.sqrt(variance)
    zncc = product * gain
    s0, su, sv, t0, tu, tv = s0 * gain, su * gain, sv * gain, t0 * gain, tu * gain, tv * gain
    power = gain * gain
    i0, iu, iv = i0 * power - mean * gain * s0, iu * power - mean * gain * su, iv * power - mean * gain * sv
    # The derivative of a normalised patch has no component along 1 nor along the patch itself.
    systems[j, 0] = h00 * power - s0 * s0 - i0 * i0
    systems[j, 1] = h0u * power - s0 * su - i0 * iu
    systems[j, 2] = h0v * power - s0 * sv - i0 * iv
    systems[j, 3] = huu * power - su * su - iu * iu
    systems[j, 4] = huv * power - su * sv - iu * iv
    systems[j, 5] = hvv * power - sv * sv - iv * iv
    systems[j, 6], systems[j, 7], systems[j, 8] = i0 * zncc - t0, iu * zncc - tu, iv * zncc - tv
    return zncc


@kernel(**FAST)
@no_type_check
def _compare(view, u, v, plane, buffers):
    """ZNCC and normal equations of each other camera at a plane; -1 where the window is not inside the image."""
    # No slices: each would count a reference.
    warp, infinite, parallax, places = buffers.warp, view.infinite, view.parallax, buffers.places
    corners, indices, systems, znccs = buffers.corners, buffers.indices, buffers.systems, buffers.znccs
    height, width = view.images.shape[1:]
    for j in range(view.others.size):
        other = view.others[j]
        for k in range(3):
            warp[0, k] = infinite[j, k, 0] * u + infinite[j, k, 1] * v + infinite[j, k, 2] + plane[0] * parallax[j, k]
            warp[1, k] = infinite[j, k, 0] + plane[1] * parallax[j, k]
            warp[2, k] = infinite[j, k, 1] + plane[2] * parallax[j, k]
        znccs[j] = -1
        if _is_inside(warp, view.radius, view.sizes[other, 1], view.sizes[other, 0]):
            _locate(view.window, warp, parallax, j, places)
            _look_up(view.pixels, other * height * width, width, places, indices, corners)
            znccs[j] = _normal_equations(buffers.template, view.window, places, corners, systems, j)


@kernel(**FAST)
@no_type_check
def _combine(buffers, camera_zncc, lag):
    """Sum the equations of the cameras that see the patch; returns how many, and their mean ZNCC."""
    znccs, total = buffers.znccs, buffers.total
    for k in range(9):
        total[k] = 0
    used, score, best = 0, np.float32(0), np.float32(-1)
    for j in range(znccs.size):
        best = max(best, znccs[j])
    for j in range(znccs.size):
        if znccs[j] >= camera_zncc and znccs[j] >= best - lag:
            used += 1
            score += znccs[j]
            for k in range(9):
                total[k] += buffers.systems[j, k]
    return used, (score / used if used > 0 else best)


@kernel(**FAST)
@no_type_check
def solve(total, step):
    """Gauss-Newton step from the summed equations; returns the variance factor (H^-1)_00, negative if singular."""
    # A slight damping of the slants, which a window of poor texture leaves open.
    h00, h01, h02, h11, h12, h22 = total[0], total[1], total[2], total[3] + 1e-3, total[4], total[5] + 1e-3
    c00, c01, c02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
    c11, c12, c22 = h00 * h22 - h02 * h02, h01 * h02 - h00 * h12, h00 * h11 - h01 * h01
    determinant = h00 * c00 + h01 * c01 + h02 * c02
    if not (determinant > 1e-12 * h00 * h11 * h22 and h00 > 1e-6):
        return -1.0
    g0, g1, g2 = total[6], total[7], total[8]
    step[0] = -(c00 * g0 + c01 * g1 + c02 * g2) / determinant
    step[1] = -(c01 * g0 + c11 * g1 + c12 * g2) / determinant
    step[2] = -(c02 * g0 + c12 * g1 + c22 * g2) / determinant
    return c00 / determinant


@kernel(**FAST)
@no_type_check
def _refine_plane(view, limits, buffers, u, v, plane):
    """Gauss-Newton from a plane, changed in place; ``buffers.result`` gets SCORE, VARIANCE, SUPPORT. False: failed."""
    result, step, solved = buffers.result, buffers.step, True
    for iteration in range(limits.iterations):
        _compare(view, u, v, plane, buffers)
        # The start may be a pixel off: let cameras in that do not agree well yet.
        floor = limits.camera_zncc if iteration >= 2 else np.float32(0.4) * limits.camera_zncc
        used, score = _combine(buffers, floor, limits.lag)
        factor = solve(buffers.total, step) if used > 0 else -1.0
        solved = factor >= 0
        if not solved:
            break
        result[0], result[1], result[2] = score, 2 * (1 - score) * factor / limits.effective, used
        length = abs(step[0])
        shrink = 1.0 if length <= 1 else 1 / length
        for k in range(3):
            plane[k] += shrink * step[k]
        if length < limits.converged:
            break
    return solved


@kernel(**FAST)
@no_type_check
def _best_start(view, limits, buffers, u, v, count):
    """Index of the candidate plane with the best mean ZNCC."""
    best, best_score = 0, np.float32(-2)
    for c in range(count if count > 1 else 0):
        _compare(view, u, v, buffers.candidates[c], buffers)
        _, score = _combine(buffers, np.float32(0.4) * limits.camera_zncc, limits.lag)
        if score > best_score:
            best, best_score = c, score
    return best


@kernel(**FAST)
@no_type_check
def _gather_candidates(field, initial, row, column, direction, spacing, candidates):
    """Planes of neighbours that were visited before, carried on to this pixel, and initial ones that differ."""
    rows, columns = field.shape[:2]
    count = 0
    for dr, dc in ((0, -1), (-1, 0), (-1, -1), (-1, 1)):
        r, c = row + direction * dr, column + direction * dc
        if 0 <= r < rows and 0 <= c < columns and field[r, c, SCORE] > 0:
            plane = candidates[count]
            plane[1], plane[2] = field[r, c, Q_U], field[r, c, Q_V]
            plane[0] = field[r, c, Q] + spacing * ((column - c) * plane[1] + (row - r) * plane[2])
            if count == 0 or abs(plane[0] - candidates[0, 0]) > 0.3:
                count += 1
    explained = count
    for layer in range(initial.shape[0]):
        q = initial[layer, row, column]
        fresh = q > 0
        for k in range(explained):
            fresh = fresh and abs(candidates[k, 0] - q) > 1.0
        if fresh:
            candidates[count, 0], candidates[count, 1], candidates[count, 2] = q, 0.0, 0.0
            count += 1
    return count


@kernel(**FAST)
@no_type_check
def _visit(view, limits, buffers, initial, field, row, column, direction):
    """Refine a pixel from the best of its candidates; writes the field where it correlates as well as it should."""
    u, v = view.spacing // 2 + column * view.spacing, view.spacing // 2 + row * view.spacing
    height, width = view.sizes[view.reference]
    if not (view.radius <= u < width - view.radius and view.radius <= v < height - view.radius):
        return
    count = _gather_candidates(field, initial, row, column, direction, view.spacing, buffers.candidates)
    if count == 0:
        return
    contrast = _load_template(view, u, v, buffers.template)
    if contrast * np.sqrt(_detail(view.window, buffers.template)) < limits.min_contrast:
        return
    plane = buffers.candidates[_best_start(view, limits, buffers, u, v, count)]
    if not _refine_plane(view, limits, buffers, u, v, plane):
        return
    least = max(limits.weak, limits.accept * contrast * contrast / (contrast * contrast + limits.noise2))
    if buffers.result[0] >= least and view.q_low <= plane[0] <= view.q_high:
        field[row, column, :3] = plane
        field[row, column, 3:] = buffers.result


@kernel(**FAST)
@no_type_check
def _refine_field(view, limits, buffers, initial, field, propagations):
    """Visit the pixels of the field that have no plane yet, in raster order and against it, ``propagations`` times."""
    rows, columns = field.shape[:2]
    for number in range(2 * propagations):
        direction = 1 - 2 * (number % 2)
        for i in range(rows):
            row = i if direction > 0 else rows - 1 - i
            for k in range(columns):
                column = k if direction > 0 else columns - 1 - k
                if field[row, column, SCORE] == 0:
                    _visit(view, limits, buffers, initial, field, row, column, direction)
    return field


@kernel
@no_type_check
def _bends(field, row, column, reach, least):
    """Whether the slants on opposite sides of a pixel differ."""
    for d_row, d_column in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one, other = (row - reach * d_row, column - reach * d_column), (row + reach * d_row, column + reach * d_column)
        if field[one[0], one[1], SCORE] > 0 and field[other[0], other[1], SCORE] > 0:
            for slant in (Q_U, Q_V):
                if abs(field[one[0], one[1], slant] - field[other[0], other[1], slant]) > least:
                    return True
    return False


@kernel(**FAST)
@no_type_check
def _refine_half(view, limits, buffers, field, row, column, side):
    """Refine a pixel with the half of a window, from the plane on that side; False where that fails."""
    if field[side[0], side[1], SCORE] == 0:
        return False
    spacing, plane = view.spacing, buffers.candidates[0]
    u, v = spacing // 2 + column * spacing, spacing // 2 + row * spacing
    if _load_template(view, u, v, buffers.template) < limits.min_contrast:
        return False
    plane[1], plane[2] = field[side[0], side[1], Q_U], field[side[0], side[1], Q_V]
    plane[0] = field[side[0], side[1], Q] + spacing * ((column - side[1]) * plane[1] + (row - side[0]) * plane[2])
    _compare(view, u, v, plane, buffers)
    # A plane of the other side of the edge fits worse than what is there.
    if _combine(buffers, limits.camera_zncc, limits.lag)[1] < field[row, column, SCORE]:
        return False
    return _refine_plane(view, limits, buffers, u, v, plane) and view.q_low <= plane[0] <= view.q_high


@kernel(**FAST)
@no_type_check
def _sharpen(views, limits, buffers, field, reach, least_bend, sigmas):
    """The field with the planes of half windows where it bends and they explain more."""
    rows, columns = field.shape[:2]
    out = field.copy()
    for row in range(reach, rows - reach):
        for column in range(reach, columns - reach):
            if field[row, column, SCORE] == 0 or not _bends(field, row, column, reach, least_bend):
                continue
            # What is left of n samples of noise scatters by the share sqrt(2 / n).
            chance = sigmas * np.sqrt(2 / (limits.effective * field[row, column, SUPPORT]))
            least = (1 - chance) * (1 - field[row, column, SCORE])
            for k in range(len(views)):
                side = (row + reach * _SIDES[k][0], column + reach * _SIDES[k][1])
                found = _refine_half(views[k], limits, buffers, field, row, column, side)
                if found and 1 - buffers.result[0] < least:
                    least = 1 - buffers.result[0]
                    out[row, column, :3] = buffers.candidates[0]
                    out[row, column, 3:] = buffers.result
    return out


def refine(
    images: Float[np.ndarray, "c h w"],
    sizes: Int[np.ndarray, "c 2"],
    reference: int,
    geometry: GroupGeometry,
    initial_mm: Float[np.ndarray, "l rows columns"],
    depth_range_mm: tuple[float, float],
    spacing_px: int,
    noise_dn: float,
    options: RefinementOptions,
    *,
    known: Float[np.ndarray, "rows columns 6"] | None = None,
    widening: int = 1,
) -> Float[np.ndarray, "rows columns 6"]:
    """Refined planes on a grid of every ``spacing_px``-th pixel; SCORE is 0 where nothing was found. Those that are
    ``known`` stay; the others are sought from them and the initial depths, in windows that are ``widening`` times as
    wide as usual, with samples as far apart: the images should be that blurred.

    ``images`` are grey values 0 to 255 in float32, padded to one size; ``sizes`` are their true heights and widths.
    ``initial_mm`` are layers of initial depths on the grid, NaN where there is none; ``noise_dn`` is the noise of the
    reference image.
    """
    height, width = sizes[reference]
    radius, sigma_px = window_size(options, images[reference, :height, :width], noise_dn, widening)
    window = patch_window(radius, sigma_px, widening)
    near, far = depth_range_mm
    view = _View(
        images=images,
        pixels=images.ravel(),
        sizes=sizes,
        reference=reference,
        infinite=geometry.infinite,
        parallax=geometry.parallax,
        others=geometry.others,
        window=window,
        radius=radius,
        spacing=spacing_px,
        q_low=geometry.scale / far,
        q_high=geometry.scale / near,
    )
    limits = _Limits(
        iterations=options.iterations,
        converged=options.converged_px,
        camera_zncc=np.float32(options.camera_zncc),
        lag=np.float32(options.camera_zncc_lag),
        accept=options.accept_zncc,
        weak=options.weak_zncc,
        noise2=noise_dn**2,
        min_contrast=options.min_contrast * noise_dn,
        effective=_effective(window),
    )
    buffers = _new_buffers(window.shape[1], len(geometry.others), len(initial_mm))
    initial = np.nan_to_num(geometry.scale / initial_mm).astype(np.float64)
    field = np.zeros((*initial.shape[1:], 6)) if known is None else known.copy()
    field = _refine_field(view, limits, buffers, initial, field, options.propagations)
    halves = [half_window(window, side) for side in _SIDES]
    views = tuple(view._replace(window=half) for half in halves)
    reach = -(-radius // spacing_px)
    bend = (_BEND_PX if options.bend_px is None else options.bend_px) / radius
    limits = limits._replace(effective=_effective(halves[0]))
    buffers = _new_buffers(halves[0].shape[1], len(geometry.others), len(initial_mm))
    return np.asarray(_sharpen(views, limits, buffers, field, reach, bend, options.half_sigmas))


def _new_buffers(samples: int, others: int, layers: int) -> _Buffers:
    return _Buffers(
        template=np.zeros(samples, np.float32),
        warp=np.zeros((3, 3)),
        places=np.zeros((5, samples), np.float32),
        indices=np.zeros(samples, np.int32),
        corners=np.zeros((4, samples), np.float32),
        systems=np.zeros((others, 9), np.float32),
        znccs=np.zeros(others, np.float32),
        total=np.zeros(9),
        step=np.zeros(3),
        result=np.zeros(3),
        candidates=np.zeros((4 + layers, 3)),
    )
