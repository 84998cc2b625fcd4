"""A camera that began later is told, and by how much; the motion that most instants agree with is found."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boards import BOARD, moving, scene, views_of
from cuspid.calibration.agreement import consensus_motion, disagreement_between, started_later
from cuspid.calibration.bundle import BoardScene, Timing
from cuspid.calibration.calibrate import _delays, _numbering_notes
from cuspid.calibration.corners import BoardView
from cuspid.calibration.joining import join_boards
from cuspid.calibration.start import join_cameras
from cuspid.geometry import Rigid3
from cuspid.model.board import BoardSet
from cuspid.runtime.errors import ReconstructionError

AWAY_MM = 24.0


def random_poses(rng: np.random.Generator, count: int) -> list[Rigid3]:
    vectors = rng.normal(0, 0.5, (count, 3))
    return [Rigid3.from_rotation_vector(each, rng.normal(0, 3, 3) + [0, 0, AWAY_MM]) for each in vectors]


@settings(max_examples=12)
@given(
    late=st.integers(-5, 5),
    name=st.sampled_from(["{:05d}", "{}", "shot_{}"]),
    lost=st.sets(st.integers(0, 13), max_size=3),
    turns=st.sampled_from([1, 2]),
    seed=st.integers(0, 2**16),
)
def test_how_much_later_a_camera_began_is_found(late: int, name: str, lost: set[int], turns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    boards, second = random_poses(rng, 14), random_poses(rng, 1)[0]
    half = Rigid3.from_rotation_vector(np.array([0, 0, np.pi]), np.array([20.0, 14.0, 0.0]))
    known = {name.format(k): [pose, pose @ half][:turns] for k, pose in enumerate(boards)}
    new = {
        name.format(k - late): [second @ pose, second @ pose @ half][:turns][:: rng.choice([1, -1])]
        for k, pose in enumerate(boards)
        if k not in lost and k >= late
    }
    found = started_later(new, known, AWAY_MM)
    if late == 0:
        assert found is None
        return
    assert found == (late, len(new), len(new))
    told = disagreement_between(("b", "a"), (new, known), 1, 12, AWAY_MM)
    first, other = "ba" if late > 0 else "ab"
    assert f"if {first} began {abs(late)} instant{'s' * (abs(late) > 1)} later than {other}" in told


def test_nothing_is_told_of_what_never_agrees() -> None:
    rng = np.random.default_rng(0)
    one, other = ({str(k): [pose] for k, pose in enumerate(random_poses(rng, 16))} for _ in range(2))
    assert started_later(one, other, AWAY_MM) is None
    told = disagreement_between(("b", "a"), (one, other), 1, 16, AWAY_MM)
    assert "only 1 of 16 instants agree on the pose of b relative to a; check" in told


@given(wrong=st.integers(0, 7), seed=st.integers(0, 2**16))
def test_the_motion_of_most_instants_is_the_agreed_one(wrong: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = random_poses(rng, 1)[0]
    near = [Rigid3.from_rotation_vector(v, rng.normal(0, 0.1, 3)) @ true for v in rng.normal(0, 0.005, (10, 3))]
    said = [[pose, *random_poses(rng, 1)] for pose in near] + [random_poses(rng, 2) for _ in range(wrong)]
    best, agreeing, off_deg = consensus_motion(said, AWAY_MM)
    assert 10 <= agreeing <= 10 + wrong
    assert (best @ true.inverse()).angle_deg < 3
    assert 0 < off_deg < 5


def test_cameras_one_of_which_began_later_are_refused_with_its_name() -> None:
    truth = moving(1, instants=20)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    late = {(name, f"{int(at) - 4 * (name == 'cam2'):05d}"): view for (name, at), view in views.items()}
    instants = sorted({at for _, at in late})
    with pytest.raises(ReconstructionError, match=r"if cam2 began 4 instants later than cam[01]: number the"):
        join_cameras(late, BOARD, truth.cameras, instants)


def test_cameras_before_several_boards_are_told_too() -> None:
    boards = BoardSet(boards=(BOARD, replace(BOARD, first_id=40)))
    truth = scene(2, cameras=2, instants=16)
    views = views_of(truth, BOARD, 0.1, np.random.default_rng(0))
    late = {(name, f"{int(at) - 3 * (name == 'cam1'):02d}"): view for (name, at), view in views.items()}
    with pytest.raises(ReconstructionError, match="13 of 13 do if cam1 began 3 instants later than cam0"):
        join_boards(late, boards, truth.cameras)


@pytest.mark.parametrize(
    ("delays", "told"),
    [
        ({"a": -0.3, "b": 0.2}, []),
        ({"a": -2.5, "b": 2.4}, ["camera b began 5 frames later than most: number its images 5 higher"]),
        ({"a": 0.4, "b": 0.2, "c": -0.8}, ["camera c began 1 frame earlier than most: number its images 1 lower"]),
    ],
)
def test_delays_of_whole_frames_are_wrong_numbers(delays: dict[str, float], told: list[str]) -> None:
    assert list(_numbering_notes(delays)) == told


def test_delays_do_not_depend_on_which_cameras_missed_the_board() -> None:
    """Of cameras that are late by known times, each view a little off."""
    rng, late = np.random.default_rng(0), {"a": -0.1, "b": 0.5, "c": -0.4}
    view = BoardView(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
    keys = [(name, f"{k:02d}") for name in late for k in range(40) if name != "b" or k % 3]
    drift = {key: 0.3 * int(key[1]) + rng.normal(0, 0.01) for key in keys}
    timing = Timing(frame={}, near={}, by_camera=late, by_view=drift)
    scene = BoardScene(
        cameras=dict.fromkeys(late, moving(0).cameras["cam0"]),
        cam_from_rig=dict.fromkeys(late, Rigid3.identity()),
        rig_from_board={},
        bending_mm=np.zeros(3),
        timing=timing,
    )
    found = _delays(scene, dict.fromkeys(keys, view))
    for name, delay in late.items():
        assert found[name][0] == pytest.approx(delay, abs=0.006)
        assert 0.004 < found[name][1] < 0.012
