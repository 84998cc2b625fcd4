"""Labels on a grid that are cheap in themselves and like their neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cuspid.geometry.semi_global import semi_global


@given(arrays(np.float32, (4, 5, 7), elements=st.floats(0, 1, width=16)))
def test_without_penalties_each_cell_has_its_own_best_label(cost: np.ndarray) -> None:
    found = semi_global(cost, 0.0, 0.0)
    nearest = np.clip(np.rint(found), 0, 6).astype(int)[..., None]
    beside = [np.take_along_axis(cost, np.clip(nearest + step, 0, 6), axis=2) for step in (-1, 0, 1)]
    assert np.all(np.min(beside, axis=0)[..., 0] <= cost[..., 1:-1].min(axis=2) + 1e-6)


@given(st.integers(1, 5), st.integers(1, 5), st.floats(0.05, 1.0))
def test_a_lone_cell_follows_its_neighbours_if_penalties_outweigh_it(label: int, own: int, gain: float) -> None:
    cost = np.ones((9, 9, 7), np.float32)
    cost[..., label] = 0
    cost[4, 4], cost[4, 4, own] = gain, 0
    assert semi_global(cost, 1.1, 1.1)[4, 4] == pytest.approx(label, abs=0.5)
    assert semi_global(cost, 0.0, 0.0)[4, 4] == pytest.approx(own, abs=0.5)


@given(arrays(np.float32, (5, 4, 6), elements=st.floats(0, 1, width=16)))
def test_no_direction_is_preferred(cost: np.ndarray) -> None:
    found = semi_global(cost, 0.1, 0.4)
    for turned, back in ((cost[::-1], found[::-1]), (cost[:, ::-1], found[:, ::-1]), (cost.swapaxes(0, 1), found.T)):
        again = semi_global(np.ascontiguousarray(turned), 0.1, 0.4)
        unlike = np.abs(again - back) > 0.01  # where two labels cost the same, rounding decides
        assert unlike.mean() <= 0.2


def test_fractions_of_labels_are_those_of_a_parabola() -> None:
    true = np.linspace(2.0, 6.0, 12).reshape(3, 4)
    cost = ((np.arange(9) - true[..., None]) ** 2).astype(np.float32)
    assert semi_global(cost, 0.0, 0.0) == pytest.approx(true, abs=1e-4)
