"""Covariances from how much the views disagree, not only from how much the corners within a view scatter.

The errors of the corners in a view have causes in common: blur, light, how the board is bent, what the lens model
lacks. Corners with a common error carry less information than as many with independent errors. So each instant is taken
as a whole: what it alone would move the result by, summed as squares over the instants, is a covariance that needs no
model of what is common within one (H. White, Econometrica 48, 1980; clusters: K.-Y. Liang, S. Zeger, Biometrika 73,
1986). It is made free of bias where the corners do err apart (CR2: R. Bell, D. McCaffrey, Survey Methodology 28, 2002).

Few instants make such a covariance erratic, and that of a dozen parameters from fewer instants singular. It is
therefore shrunk towards a multiple of the one that the scatter of the corners gives (as O. Ledoit, M. Wolf, J.
Multivariate Analysis 88, 2004, towards a multiple of the identity).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

_PRIOR_INSTANTS = 4.0
"""What the multiple of the covariance by the corners counts for, in instants per parameter."""
_LEAST_OTHERS = 1e-3
"""Least share of what is known of a combination of parameters that instants other than one are taken to tell."""


def influences(
    matrix: Float[np.ndarray, "k k"],
    instants: Iterable[tuple[Float[np.ndarray, "m k"], Float[np.ndarray, "m"]]],
    own: Int[np.ndarray, "p"],
) -> tuple[Int[np.ndarray, "s"], Float[np.ndarray, "c s"]]:
    """The unknowns that are common to all instants, and by how much each instant moves them.

    Args:
        matrix: Of the normal equations, prior included.
        instants: Of each, derivatives of the projections by all unknowns, and residuals, in standard deviations.
        own: Unknowns that belong to single instants, such as the poses of the board.
    """
    common = np.setdiff1d(np.arange(len(matrix)), own)
    follow = np.linalg.solve(matrix[np.ix_(own, own)], matrix[np.ix_(own, common)])
    reduced = matrix[np.ix_(common, common)] - matrix[np.ix_(common, own)] @ follow
    scale = 1 / np.sqrt(np.diag(reduced))
    values, vectors = np.linalg.eigh(reduced * scale[:, None] * scale)
    whiten = (scale[:, None] * vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))) @ vectors.T
    moved = []
    for seen, residuals in instants:
        white = (seen[:, common] - seen[:, own] @ follow) @ whiten
        share, axes = np.linalg.eigh(white.T @ white)
        others = np.sqrt(np.maximum(1 - share, _LEAST_OTHERS))
        moved.append(whiten @ (axes / others @ (axes.T @ (white.T @ residuals))))
    return common, np.array(moved)


def covariance_of(by_corners: Float[np.ndarray, "n n"], moved: Float[np.ndarray, "c n"]) -> Float[np.ndarray, "n n"]:
    """Covariance of some parameters.

    Args:
        by_corners: As it is if the corners err independently.
        moved: By how much each instant moves the parameters (:func:`influences`).
    """
    scale = np.sqrt(np.diag(by_corners))
    scale = np.where(scale > 0, scale, 1.0)
    known, instants = by_corners / scale / scale[:, None], moved / scale
    by_instants = instants.T @ instants
    freedom = int(np.linalg.matrix_rank(known, hermitian=True))
    ratio = np.trace(np.linalg.pinv(known, hermitian=True) @ by_instants) / max(freedom, 1)
    prior = _PRIOR_INSTANTS * freedom
    shrunk = (prior * max(float(ratio), 1.0) * known + len(moved) * by_instants) / max(prior + len(moved), 1)
    return np.asarray(shrunk * scale * scale[:, None])
