"""Sums over the corners of each view, compiled: the normal equations of an adjustment, from which what each view alone
knows of the unknowns that it does not see is left out, so that their cost follows what the views see.

A corner has two residuals, and derivatives of these by some of the unknowns. Those that the corners of one view have to
do with are numbered within it (:class:`Layout`). A view may besides have a motion of its own, which is eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int

from cuspid.runtime.kernels import kernel

_PLACE = 6


@dataclass(frozen=True, eq=False)
class Layout:
    """Which unknowns each corner has to do with, numbered within its view."""

    count: int
    """How many unknowns there are."""
    columns: Int[np.ndarray, "n w"]
    """The unknowns of each corner; -1 for derivatives that belong to none. An unknown may occur more than once."""
    places: Int[np.ndarray, "n w"]
    """The same, numbered within the view."""
    unknowns: Int[np.ndarray, "t"]
    """Those of one view after the other, in the order of these numbers."""
    first: Int[np.ndarray, "s"]
    """Where those of each view begin, and their number."""
    starts: Int[np.ndarray, "s"]
    """Where the corners of each view begin, and their number."""

    @staticmethod
    def of(columns: Int[np.ndarray, "n w"], starts: Int[np.ndarray, "s"], count: int) -> Layout:
        """The layout for corners in the order of their views."""
        places, own = np.empty_like(columns), []
        for begin, end in pairwise(starts.tolist()):
            known = np.unique(columns[begin:end])
            own.append(known[known >= 0])
            places[begin:end] = np.searchsorted(own[-1], columns[begin:end])
        places[columns < 0] = -1
        first = np.cumsum([0, *map(len, own)])
        return Layout(count, columns, places, np.concatenate(own), first, starts)

    def rows_of(self, view: int, values: Float[np.ndarray, "n 2 w"]) -> Float[np.ndarray, "m k"]:
        """Derivatives of the residuals in a view by all unknowns."""
        part = slice(self.starts[view], self.starts[view + 1])
        rows = np.zeros((2 * len(values[part]), self.count + 1))
        column = np.repeat(self.columns[part], 2, axis=0)  # -1 is the last one
        np.add.at(rows, (np.arange(len(rows))[:, None], column), values[part].reshape(len(rows), -1))
        return rows[:, :-1]


def without_motions(
    raw: Float[np.ndarray, "n 2"],
    by_motion: Float[np.ndarray, "n 2 6"],
    starts: Int[np.ndarray, "s"],
    motions: Float[np.ndarray, "v 6"],
) -> Float[np.ndarray, "n 2"]:
    """Residuals, given the motion of each view."""
    out = np.empty_like(raw)
    _without_motions(raw, by_motion, starts, motions, out)
    return out


@kernel
@no_type_check
def _without_motions(raw, by_motion, starts, motions, out):
    for view in range(len(starts) - 1):
        for n in range(starts[view], starts[view + 1]):
            for i in range(2):
                out[n, i] = raw[n, i]
                for k in range(_PLACE):
                    out[n, i] -= by_motion[n, i, k] * motions[view, k]


def motion_equations(
    raw: Float[np.ndarray, "n 2"],
    by_motion: Float[np.ndarray, "n 2 6"],
    weights: Float[np.ndarray, "n"],
    starts: Int[np.ndarray, "s"],
) -> tuple[Float[np.ndarray, "v 6 6"], Float[np.ndarray, "v 6"]]:
    """Normal equations of the motion of each view: matrix, and right-hand side."""
    views = len(starts) - 1
    matrix, right = np.zeros((views, _PLACE, _PLACE)), np.zeros((views, _PLACE))
    _motion_equations(raw, by_motion, weights, starts, matrix, right)
    return matrix, right


@kernel
@no_type_check
def _motion_equations(raw, by_motion, weights, starts, matrix, right):
    for view in range(len(starts) - 1):
        for n in range(starts[view], starts[view + 1]):
            for k in range(_PLACE):
                one, other = weights[n] * by_motion[n, 0, k], weights[n] * by_motion[n, 1, k]
                right[view, k] += one * raw[n, 0] + other * raw[n, 1]
                for m in range(k + 1):
                    matrix[view, k, m] += one * by_motion[n, 0, m] + other * by_motion[n, 1, m]
        for k in range(_PLACE):
            for m in range(k):
                matrix[view, m, k] = matrix[view, k, m]


def gradient_of(
    values: Float[np.ndarray, "n 2 w"], residuals: Float[np.ndarray, "n 2"], layout: Layout
) -> Float[np.ndarray, "k"]:
    """Product of the transposed derivatives with the residuals."""
    out = np.zeros(layout.count)
    _gradient(values, residuals, layout.columns, out)
    return out


@kernel
@no_type_check
def _gradient(values, residuals, columns, out):
    for n in range(columns.shape[0]):
        for a in range(columns.shape[1]):
            if columns[n, a] >= 0:
                out[columns[n, a]] += values[n, 0, a] * residuals[n, 0] + values[n, 1, a] * residuals[n, 1]


def between_motions(
    values: Float[np.ndarray, "n 2 w"], by_motion: Float[np.ndarray, "n 2 6"], layout: Layout
) -> Float[np.ndarray, "t 6"]:
    """Blocks of the normal matrix between the unknowns of each view (``layout.unknowns``) and its motion."""
    out = np.zeros((len(layout.unknowns), _PLACE))
    _between_motions(values, by_motion, layout.places, layout.starts, layout.first, out)
    return out


@kernel
@no_type_check
def _between_motions(values, by_motion, places, starts, first, out):
    for view in range(len(starts) - 1):
        for n in range(starts[view], starts[view + 1]):
            for a in range(places.shape[1]):
                if places[n, a] >= 0:
                    row = first[view] + places[n, a]
                    for k in range(_PLACE):
                        out[row, k] += values[n, 0, a] * by_motion[n, 0, k] + values[n, 1, a] * by_motion[n, 1, k]


def matrix_of(
    values: Float[np.ndarray, "n 2 w"],
    layout: Layout,
    between: Float[np.ndarray, "t 6"] | None = None,
    spread: Float[np.ndarray, "v 6 6"] | None = None,
) -> Float[np.ndarray, "k k"]:
    """Matrix of the normal equations of the unknowns, which the motions of the views follow: these have the covariance
    ``spread``, were all else known."""
    if between is None or spread is None:
        between, spread = np.zeros((len(layout.unknowns), 0)), np.zeros((len(layout.starts) - 1, 0, 0))
    each = np.diff(layout.first)
    follow = np.einsum("tkl,tl->tk", np.repeat(spread, each, axis=0), between)
    out = np.zeros((layout.count, layout.count))
    most = int(each.max(initial=0))
    _matrix(values, layout.places, layout.starts, layout.first, layout.unknowns, between, follow, most, out)
    return out + out.T


@kernel
@no_type_check
def _matrix(values, places, starts, first, unknowns, between, follow, most, out):
    """Half of it: adding the transposed one gives the whole."""
    own = np.empty((most, most))
    place, one, other = np.empty(places.shape[1], np.int64), np.empty(places.shape[1]), np.empty(places.shape[1])
    for view in range(len(starts) - 1):
        begin, count = first[view], first[view + 1] - first[view]
        own[:count, :count] = 0
        for n in range(starts[view], starts[view + 1]):
            used = 0
            for a in range(places.shape[1]):
                if places[n, a] >= 0 and (values[n, 0, a] != 0 or values[n, 1, a] != 0):
                    place[used], one[used], other[used] = places[n, a], values[n, 0, a], values[n, 1, a]
                    used += 1
            for a in range(used):
                row, x, y = place[a], one[a], other[a]
                own[row, row] += 0.5 * (x * x + y * y)
                for b in range(a):
                    own[row, place[b]] += x * one[b] + y * other[b]
        for a in range(count):
            for b in range(count):
                value = own[a, b]
                if b <= a:
                    less = 0.0
                    for k in range(between.shape[1]):
                        less += follow[begin + a, k] * between[begin + b, k]
                    value -= 0.5 * less if a == b else less
                out[unknowns[begin + a], unknowns[begin + b]] += value
