"""Sub-pixel depth from all cameras of a group: slanted patches, Gauss-Newton on normalised intensities.

For a pixel (u, v) of the reference image a small window is taken as a plane in space, for which inverse depth is
affine in the pixel: with an offset (du, dv) from the centre

    q(du, dv) = q + q_u du + q_v dv,      x_j ~ A_j (u + du, v + dv, 1) + q(du, dv) b_j,

where x_j is the pixel in camera j, A_j = K_j R_j K_ref^-1, b_j = K_j t_j / s, and q = s / Z is inverse depth scaled by
s, the longest of the K_j t_j, so that q counts pixels of disparity in the widest pair. Patches are brought to weighted
mean 0 and norm 1, so that gain and offset of a camera do not matter; their inner product is the ZNCC. (q, q_u, q_v)
minimises the summed squared differences over the cameras that see the patch; a camera whose ZNCC falls behind is
taken to be occluded and left out. Pixels are OpenCV's here: the first centre is 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

CAMERAS_MAX = 16
"""Most cameras in a group."""

Q, Q_U, Q_V, SCORE, VARIANCE, SUPPORT = range(6)
"""Channels of a refined field: the plane, mean ZNCC of the cameras used, variance of q, how many cameras."""

FAST = {"cache": True, "nogil": True, "fastmath": {"contract", "reassoc", "arcp", "nsz"}}


@dataclass(frozen=True, kw_only=True)
class RefinementOptions:
    """Multi-camera refinement of depth."""

    radius_px: int = 3
    """Half the side of the window (3: 7 x 7 px)."""
    window_sigma_px: float = 2.0
    """Width of the Gaussian weight over the window."""
    iterations: int = 10
    """Most Gauss-Newton steps."""
    converged_px: float = 0.02
    """A step below this many px of disparity ends the iterations."""
    camera_zncc: float = 0.5
    """A camera below this correlation is taken to be occluded."""
    camera_zncc_lag: float = 0.25
    """A camera that falls this much behind the best is taken to be occluded."""
    accept_zncc: float = 0.75
    """Mean correlation from which a plane is kept and handed to neighbours."""
    least_contrast_dn: float = 2.0
    """Standard deviation of a window, in digital numbers, below which it carries no texture."""
    sweeps: int = 2
    """How often planes are handed on to neighbours without one, in each direction."""


@dataclass(frozen=True, eq=False)
class GroupGeometry:
    """One reference camera and the others of its group, as the kernels want them."""

    infinite: Float[np.ndarray, "j 3 3"]
    """A_j."""
    parallax: Float[np.ndarray, "j 3"]
    """b_j."""
    scale: float
    """s in px mm."""
    others: Int[np.ndarray, "j"]
    """Index of each other camera in the stack of images."""


def patch_weights(options: RefinementOptions) -> Float[np.ndarray, "k"]:
    """Gaussian weights over the window, row by row, of sum 1."""
    offsets = np.arange(-options.radius_px, options.radius_px + 1)
    profile = np.exp(-0.5 * (offsets / options.window_sigma_px) ** 2)
    weights = np.outer(profile, profile).ravel()
    return (weights / weights.sum()).astype(np.float32)


@njit(**FAST)
@no_type_check
def _load_template(image, u, v, radius, weights, template):
    """Normalised patch around a pixel of the reference image; returns its standard deviation."""
    count = 0
    mean = np.float32(0)
    for dv in range(-radius, radius + 1):
        for du in range(-radius, radius + 1):
            template[count] = image[v + dv, u + du]
            mean += weights[count] * template[count]
            count += 1
    variance = np.float32(0)
    for k in range(count):
        template[k] -= mean
        variance += weights[k] * template[k] * template[k]
    deviation = np.sqrt(variance)
    if deviation > 0:
        for k in range(count):
            template[k] /= deviation
    return deviation


@njit(**FAST)
@no_type_check
def _warp_is_inside(x, along_u, along_v, radius, width, height):
    """True where the four corners of the window fall into the image, a pixel off its border."""
    for sv in (-radius, radius):
        for su in (-radius, radius):
            z = x[2] + su * along_u[2] + sv * along_v[2]
            if not z > 1e-6:
                return False
            px = (x[0] + su * along_u[0] + sv * along_v[0]) / z
            py = (x[1] + su * along_u[1] + sv * along_v[1]) / z
            if not (px >= 1 and py >= 1 and px < width - 2 and py < height - 2):
                return False
    return True


@njit(**FAST)
@no_type_check
def _warp(image, x, along_u, along_v, parallax, radius, values, slopes):
    """Intensities of the window seen in another image, and their derivative by q."""
    count = 0
    for dv in range(-radius, radius + 1):
        for du in range(-radius, radius + 1):
            inverse = 1 / (x[2] + du * along_u[2] + dv * along_v[2])
            px = (x[0] + du * along_u[0] + dv * along_v[0]) * inverse
            py = (x[1] + du * along_u[1] + dv * along_v[1]) * inverse
            column, row = int(px), int(py)
            fx, fy = np.float32(px - column), np.float32(py - row)
            a, b = image[row, column], image[row, column + 1]
            c, d = image[row + 1, column], image[row + 1, column + 1]
            top, bottom = a + fx * (b - a), c + fx * (d - c)
            values[count] = top + fy * (bottom - top)
            slope_x = (b - a) + fy * ((d - c) - (b - a))
            shift_x = (parallax[0] - px * parallax[2]) * inverse
            shift_y = (parallax[1] - py * parallax[2]) * inverse
            slopes[count] = slope_x * np.float32(shift_x) + (bottom - top) * np.float32(shift_y)
            count += 1


@njit(**FAST)
@no_type_check
def _normal_equations(template, weights, values, slopes, radius, system):
    """ZNCC of a warped patch with the template; its normal equations (6 + 3 numbers) go to ``system``."""
    count = weights.size
    mean = np.float32(0)
    for k in range(count):
        mean += weights[k] * values[k]
    variance, product = np.float32(0), np.float32(0)
    for k in range(count):
        values[k] -= mean
        variance += weights[k] * values[k] * values[k]
        product += weights[k] * values[k] * template[k]
    if not variance > 1e-6:
        return np.float32(-1)
    inverse = 1 / np.sqrt(variance)
    zncc = product * inverse
    side = 2 * radius + 1
    m0 = mu = mv = i0 = iu = iv = e0 = eu = ev = np.float32(0)
    h00 = h0u = h0v = huu = huv = hvv = np.float32(0)
    for k in range(count):
        du, dv = np.float32(k % side - radius), np.float32(k // side - radius)
        slope = slopes[k] * inverse
        seen = values[k] * inverse
        ws = weights[k] * slope
        we = ws * (seen - template[k])
        wi = ws * seen
        wss = ws * slope
        m0 += ws
        mu += ws * du
        mv += ws * dv
        i0 += wi
        iu += wi * du
        iv += wi * dv
        e0 += we
        eu += we * du
        ev += we * dv
        h00 += wss
        h0u += wss * du
        h0v += wss * dv
        huu += wss * du * du
        huv += wss * du * dv
        hvv += wss * dv * dv
    # The derivative of a normalised patch has no component along 1 nor along the patch itself.
    system[0] = h00 - m0 * m0 - i0 * i0
    system[1] = h0u - m0 * mu - i0 * iu
    system[2] = h0v - m0 * mv - i0 * iv
    system[3] = huu - mu * mu - iu * iu
    system[4] = huv - mu * mv - iu * iv
    system[5] = hvv - mv * mv - iv * iv
    lack = 1 - zncc
    system[6] = e0 - i0 * lack
    system[7] = eu - iu * lack
    system[8] = ev - iv * lack
    return zncc


@njit(**FAST)
@no_type_check
def _compare(images, sizes, infinite, parallax, others, u, v, plane, radius, weights, scratch, systems, znccs):
    """ZNCC and normal equations of each other camera at a plane; -1 where the window is not inside the image."""
    template, values, slopes, x, along_u, along_v = scratch
    for j in range(others.size):
        a, b = infinite[j], parallax[j]
        for k in range(3):
            x[k] = a[k, 0] * u + a[k, 1] * v + a[k, 2] + plane[0] * b[k]
            along_u[k] = a[k, 0] + plane[1] * b[k]
            along_v[k] = a[k, 1] + plane[2] * b[k]
        znccs[j] = -1
        if _warp_is_inside(x, along_u, along_v, radius, sizes[others[j], 1], sizes[others[j], 0]):
            _warp(images[others[j]], x, along_u, along_v, b, radius, values, slopes)
            znccs[j] = _normal_equations(template, weights, values, slopes, radius, systems[j])


@njit(**FAST)
@no_type_check
def _combine(systems, znccs, camera_zncc, lag, total):
    """Sum the equations of the cameras that see the patch; returns how many, and their mean ZNCC."""
    best = np.float32(-1)
    for j in range(znccs.size):
        best = max(best, znccs[j])
    total[:] = 0
    used, score = 0, np.float32(0)
    for j in range(znccs.size):
        if znccs[j] >= camera_zncc and znccs[j] >= best - lag:
            used += 1
            score += znccs[j]
            for k in range(9):
                total[k] += systems[j, k]
    return used, (score / used if used > 0 else best)


@njit(**FAST)
@no_type_check
def _solve(total, ridge, step):
    """Gauss-Newton step from the summed equations; returns the variance factor (H^-1)_00, negative if singular."""
    h00, h01, h02, h11, h12, h22 = total[0], total[1], total[2], total[3] + ridge, total[4], total[5] + ridge
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


@njit(**FAST)
@no_type_check
def _refine_plane(view, u, v, plane, settings, buffers, result):
    """Gauss-Newton from a plane, changed in place; ``result`` gets SCORE, VARIANCE, SUPPORT. False where it fails."""
    radius, iterations, converged, camera_zncc, lag = settings[:5]
    images, sizes, infinite, parallax, others, weights, effective = view
    scratch, systems, znccs, total, step = buffers
    for iteration in range(iterations):
        _compare(images, sizes, infinite, parallax, others, u, v, plane, radius, weights, scratch, systems, znccs)
        # The start may be a pixel off: let cameras in that do not agree well yet.
        floor = camera_zncc if iteration >= 2 else np.float32(0.4) * camera_zncc
        used, score = _combine(systems, znccs, floor, lag, total)
        if used == 0:
            return False
        factor = _solve(total, 1e-3, step)
        if factor < 0:
            return False
        result[0], result[1], result[2] = score, 2 * (1 - score) * factor / effective, used
        length = abs(step[0])
        shrink = 1.0 if length <= 1 else 1 / length
        for k in range(3):
            plane[k] += shrink * step[k]
        if length < converged:
            break
    return True


@njit(**FAST)
@no_type_check
def _best_start(view, u, v, candidates, count, settings, buffers):
    """Index of the candidate plane with the best mean ZNCC."""
    if count == 1:
        return 0
    radius, _, _, camera_zncc, lag = settings[:5]
    images, sizes, infinite, parallax, others, weights, _ = view
    scratch, systems, znccs, total, _ = buffers
    best, best_score = 0, np.float32(-2)
    for c in range(count):
        _compare(
            images, sizes, infinite, parallax, others, u, v, candidates[c], radius, weights, scratch, systems, znccs
        )
        _, score = _combine(systems, znccs, np.float32(0.4) * camera_zncc, lag, total)
        if score > best_score:
            best, best_score = c, score
    return best


@njit(**FAST)
@no_type_check
def _gather_candidates(field, seeds, row, column, direction, spacing, accept, candidates):
    """Planes of neighbours that were visited before, carried on to this pixel, and seeds that none of them explains."""
    rows, columns = field.shape[:2]
    count = 0
    for dr, dc in ((0, -1), (-1, 0), (-1, -1), (-1, 1)):
        r, c = row + direction * dr, column + direction * dc
        if 0 <= r < rows and 0 <= c < columns and field[r, c, SCORE] >= accept:
            plane = candidates[count]
            plane[1], plane[2] = field[r, c, Q_U], field[r, c, Q_V]
            plane[0] = field[r, c, Q] + spacing * ((column - c) * plane[1] + (row - r) * plane[2])
            if count == 0 or abs(plane[0] - candidates[0, 0]) > 0.3:
                count += 1
    explained = count
    for layer in range(seeds.shape[0]):
        seed = seeds[layer, row, column]
        fresh = seed > 0
        for k in range(explained):
            fresh = fresh and abs(candidates[k, 0] - seed) > 1.0
        if fresh:
            candidates[count, 0], candidates[count, 1], candidates[count, 2] = seed, 0.0, 0.0
            count += 1
    return count


@njit(**FAST)
@no_type_check
def _sweep(view, reference, seeds, field, direction, spacing, settings, buffers):
    """Visit the pixels that have no accepted plane yet, in raster order or against it."""
    radius, _, _, _, _, accept, least_contrast, q_low, q_high = settings
    rows, columns = field.shape[:2]
    height, width = view[1][reference]
    image, weights, template = view[0][reference], view[5], buffers[0][0]
    candidates = np.zeros((seeds.shape[0] + 4, 3))
    result = np.zeros(3)
    for i in range(rows):
        row = i if direction > 0 else rows - 1 - i
        v = spacing // 2 + row * spacing
        for k in range(columns):
            column = k if direction > 0 else columns - 1 - k
            u = spacing // 2 + column * spacing
            if field[row, column, SCORE] >= accept or not (
                radius <= u < width - radius and radius <= v < height - radius
            ):
                continue
            count = _gather_candidates(field, seeds, row, column, direction, spacing, accept, candidates)
            if count == 0 or _load_template(image, u, v, radius, weights, template) < least_contrast:
                continue
            plane = candidates[_best_start(view, u, v, candidates, count, settings, buffers)]
            if not _refine_plane(view, u, v, plane, settings, buffers, result):
                continue
            if result[0] > field[row, column, SCORE] and q_low <= plane[0] <= q_high:
                field[row, column, :3] = plane
                field[row, column, 3:] = result


@njit(**FAST)
@no_type_check
def _refine_field(view, reference, seeds, spacing, sweeps, settings):
    """The refined field (rows, columns, 6) of a reference camera from layers of seeds (q; 0 where there is none)."""
    size, others = view[5].size, view[4].size
    buffers = (
        (
            np.zeros(size, np.float32),
            np.zeros(size, np.float32),
            np.zeros(size, np.float32),
            np.zeros(3),
            np.zeros(3),
            np.zeros(3),
        ),
        np.zeros((others, 9), np.float32),
        np.zeros(others, np.float32),
        np.zeros(9),
        np.zeros(3),
    )
    field = np.zeros((seeds.shape[1], seeds.shape[2], 6))
    for _ in range(sweeps):
        _sweep(view, reference, seeds, field, 1, spacing, settings, buffers)
        _sweep(view, reference, seeds, field, -1, spacing, settings, buffers)
    return field


def refine(
    images: Float[np.ndarray, "c h w"],
    sizes: Int[np.ndarray, "c 2"],
    reference: int,
    geometry: GroupGeometry,
    seeds_mm: Float[np.ndarray, "l rows columns"],
    depth_range_mm: tuple[float, float],
    spacing_px: int,
    options: RefinementOptions,
) -> Float[np.ndarray, "rows columns 6"]:
    """Refined planes on a grid of every ``spacing_px``-th pixel; SCORE is 0 where nothing was found.

    ``images`` are grey values 0 to 255 in float32, padded to one size; ``sizes`` are their true heights and widths.
    ``seeds_mm`` are layers of first depths on the grid, NaN where there is none.
    """
    weights = patch_weights(options)
    with np.errstate(invalid="ignore"):
        seeds = np.nan_to_num(geometry.scale / seeds_mm).astype(np.float64)
    near, far = depth_range_mm
    view = (
        images,
        sizes,
        geometry.infinite,
        geometry.parallax,
        geometry.others,
        weights,
        float(1 / np.sum(weights.astype(np.float64) ** 2)),
    )
    settings = (
        options.radius_px,
        options.iterations,
        options.converged_px,
        np.float32(options.camera_zncc),
        np.float32(options.camera_zncc_lag),
        options.accept_zncc,
        options.least_contrast_dn,
        geometry.scale / far,
        geometry.scale / near,
    )
    return np.asarray(_refine_field(view, reference, seeds, spacing_px, options.sweeps, settings))
