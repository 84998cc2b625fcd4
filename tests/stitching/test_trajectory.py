"""How far a camera goes before it turns back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.handpiece.intra_oral import intra_oral_camera
from cuspid.model.arch_curve import ArchCurve, arch_curve
from cuspid.simulation.path.free import FreePathOptions, plan_free_path
from cuspid.stitching.trajectory import frames_before_return
from horseshoe import horseshoe


@pytest.fixture(scope="module")
def curve() -> ArchCurve:
    return arch_curve(horseshoe())


@given(turn=st.floats(0.3, 0.7), frames=st.integers(60, 200), seed=st.integers(0, 100), angle=st.floats(-3, 3))
def test_it_turns_back_where_it_does(curve: ArchCurve, turn: float, frames: int, seed: int, angle: float) -> None:
    length, there = float(curve.lengths_mm[-1]), round(turn * frames)
    at = np.concatenate([np.linspace(0, length, there), np.linspace(length, 0, frames - there)])
    noise = np.random.default_rng(seed).normal(0, 0.3, (frames, 2))
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    places = (np.array([curve.place(each)[:2] for each in at]) + noise) @ turned.T + [5, -7]
    assert abs(frames_before_return(places) - there) < 0.08 * frames


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("path", ["arch", "s-shape"])
def test_a_shaky_hand_that_only_goes_on_never_turns_back(path: str, seed: int) -> None:
    camera = intra_oral_camera()
    poses = plan_free_path(horseshoe(), camera, FreePathOptions(path=path), np.random.default_rng(seed))
    centres = np.array([pose.inverse().apply(camera.rig["camera"].centre_in_rig[None])[0] for pose in poses.values()])
    assert frames_before_return(centres[:, :2]) == len(centres)


def test_what_hardly_moves_never_turns_back() -> None:
    assert frames_before_return(np.zeros((5, 2))) == 5
    assert frames_before_return(np.array([[0.0, 0.0], [3.0, 0.0]])) == 2
