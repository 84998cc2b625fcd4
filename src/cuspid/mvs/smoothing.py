"""A depth map whose surface is smooth where little is known about it.

Of all surfaces near what was measured the one that bends least: with the measured inverse depth q, its standard
deviation s, and the second differences D of the surface x,

    sum rho((x - q) / s) + sum g rho(D x / b)  ->  min.

It is the thin plate of W. Grimson (Phil. Trans. R. Soc. B 298, 1982), but with a loss rho (P. Huber, Ann. Math. Stat.
35, 1964) that is linear from half the usual bend b on: many small bends then cost as much as a sharp one, so that
creases stay sharp and do not swing (K. Bredies, K. Kunisch, T. Pock, SIAM J. Imaging Sci. 3, 2010). Where the colour
changes, as from a tooth to the gum, a bend costs less (g; after D. Ferstl et al., ICCV 2013). Outliers go; across a
step the surface is cut. Inverse depth, because that of a plane is affine in the pixel.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.sparse.linalg import cg

_ROUNDS = 4
"""Least-squares problems, each with the weights that follow from the one before."""
_STEPS, _TOLERANCE = 200, 1e-3
"""Limits of the conjugate gradients."""
_SHARP, _CUT = 0.5, 18.0
"""Multiples of the usual bend: from the first on a bend counts less, from the second on two surfaces meet there."""
_OUTLYING = 3.0
"""Standard deviations from which on a measurement counts less."""
_EDGE = 0.06
"""Difference of colours within three pixels (standard deviation) at which a bend costs half."""


def smooth(
    values: Float[np.ndarray, "h w"],
    sigma: Float[np.ndarray, "h w"],
    bend: float,
    colours: Float[np.ndarray, "h w c"] | None = None,
) -> Float[np.ndarray, "h w"]:
    """The smooth surface through measured values, where there are any; NaN elsewhere.

    ``sigma``: their standard deviations. ``bend``: usual second difference of the surface from pixel to pixel. All are
    of one unit.
    """
    known = np.isfinite(values)
    measured = np.where(known, values, 0.0).ravel()
    precision = np.where(known, sigma, 1.0).ravel() ** -2
    second = _second_differences(known)
    rigid = 1.0 if colours is None else _rigid(second, colours.reshape(-1, colours.shape[-1]))
    change, trust = np.zeros_like(measured), np.ones_like(measured)
    for _ in range(_ROUNDS):
        bends = np.abs(second @ (measured + change)) / bend
        stiffness = rigid * np.where(bends < _CUT, _huber(bends, _SHARP), 0) / bend**2
        stiff = second.T @ sparse.diags_array(stiffness) @ second
        system = (sparse.diags_array(precision * trust) + stiff).tocsr()
        scaled = sparse.diags_array(1 / system.diagonal())
        change, _ = cg(system, -(stiff @ measured), x0=change, rtol=_TOLERANCE, maxiter=_STEPS, M=scaled)
        trust = _huber(np.abs(change) * np.sqrt(precision), _OUTLYING)
    return np.where(known, values + change.reshape(values.shape), np.nan)


def _huber(multiples: Float[np.ndarray, "n"], limit: float) -> Float[np.ndarray, "n"]:
    """Weights of residuals, which count less beyond the limit."""
    return limit / np.maximum(multiples, limit)


def _rigid(second: sparse.csr_array, colours: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "d"]:
    """What a bend costs at each second difference, of what it costs where the colour does not change."""
    weights = abs(second)
    weights = sparse.diags_array(1 / weights.sum(axis=1)) @ weights
    variance = (weights @ colours**2 - (weights @ colours) ** 2).sum(axis=-1)
    return np.asarray(1 / (1 + variance / _EDGE**2))


def _second_differences(known: Bool[np.ndarray, "h w"]) -> sparse.csr_array:
    """Across, down, and mixed (which occurs twice in the sum of squares), where all pixels of a difference are
    known."""
    across = np.array([[1.0, -2.0, 1.0]])
    stencils = across, across.T, np.sqrt(2) * np.array([[1, -1], [-1, 1]])
    return sparse.vstack([_filter_stencils(stencil, known) for stencil in stencils], format="csr")


def _filter_stencils(stencil: Float[np.ndarray, "a b"], known: Bool[np.ndarray, "h w"]) -> sparse.csr_array:
    """The stencil at each place where it fits, one row for each."""
    rows, columns = (size - extent + 1 for size, extent in zip(known.shape, stencil.shape, strict=True))
    index = np.arange(known.size).reshape(known.shape)
    places = product(*(range(extent) for extent in stencil.shape))
    under = np.stack([index[row : row + rows, column : column + columns].ravel() for row, column in places])
    under = under[:, known.ravel()[under].all(axis=0)]
    shape = under.shape[1], known.size
    starts = len(under) * np.arange(shape[0] + 1)
    return sparse.csr_array((np.tile(stencil.ravel(), shape[0]), under.T.ravel(), starts), shape=shape)
