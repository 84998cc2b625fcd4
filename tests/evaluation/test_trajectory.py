"""Errors of trajectories: none for any rigid motion of all, and those that were put in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.evaluation.trajectory import trajectory_error
from cuspid.geometry import Rigid3
from cuspid.runtime.errors import InputError
from strategies import rigid3s


def walk(count: int, seed: int = 0) -> dict[str, Rigid3]:
    rng = np.random.default_rng(seed)
    return {f"{k:05d}": Rigid3.from_rotation_vector(rng.normal(0, 0.2, 3), rng.normal(0, 5, 3)) for k in range(count)}


@given(scan_from_reference=rigid3s(), seed=st.integers(0, 100))
def test_the_frame_of_the_scan_means_nothing(scan_from_reference: Rigid3, seed: int) -> None:
    true = walk(6, seed)
    found = {name: pose @ scan_from_reference.inverse() for name, pose in true.items()}
    error = trajectory_error(found, true, scan_from_reference.inverse())
    assert error.frames == 6
    assert max(error.ape_um.max, error.rpe_um.max) < 1e-6
    assert max(error.ape_deg.max, error.rpe_deg.max) < 1e-5


def test_an_error_is_told_as_large_as_it_is_put_in() -> None:
    """One frame 10 um aside is one absolute error and two relative ones; all of them aside are no relative error."""
    true = walk(5)
    aside = Rigid3(np.eye(3), np.array([0.006, 0.0, -0.008]))
    one = trajectory_error({**true, "00002": aside @ true["00002"]}, true, Rigid3.identity())
    assert one.ape_um.max == pytest.approx(10)
    assert one.ape_um.median == pytest.approx(0, abs=1e-9)
    assert one.ape_um.rmse == pytest.approx(10 / np.sqrt(5))
    assert one.rpe_um.rmse == pytest.approx(10 / np.sqrt(2))
    assert one.ape_deg.max == pytest.approx(0, abs=1e-6)
    moved = {name: pose @ Rigid3(np.eye(3), np.array([0.01, 0, 0])) for name, pose in true.items()}
    every = trajectory_error(moved, true, Rigid3.identity())
    assert every.ape_um.mean == pytest.approx(10)
    assert every.ape_um.std == pytest.approx(0, abs=1e-9)
    assert every.rpe_um.max == pytest.approx(0, abs=1e-9)


def test_a_turn_is_an_angle() -> None:
    true = walk(4)
    turn = Rigid3.from_rotation_vector(np.array([0, np.deg2rad(0.5), 0]), np.zeros(3))
    turned = {name: turn @ pose for name, pose in true.items()}
    error = trajectory_error(turned, true, Rigid3.identity())
    assert error.ape_deg.mean == pytest.approx(0.5)
    assert error.ape_um.max == pytest.approx(0, abs=1e-9)


def test_frames_that_were_lost_do_not_count_but_two_must_be_left() -> None:
    true = walk(4)
    assert trajectory_error({name: true[name] for name in ("00001", "00003")}, true, Rigid3.identity()).frames == 2
    with pytest.raises(InputError, match="1 of 4 true poses"):
        trajectory_error({"00001": true["00001"]}, true, Rigid3.identity())
