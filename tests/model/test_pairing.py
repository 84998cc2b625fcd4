"""Which cameras are matched, and at what distance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from builders import rig_of, shifted
from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import essential_four, six_cameras, twelve_cameras
from cuspid.model.pairing import (
    PairingOptions,
    angle_weight,
    camera_groups,
    guess_working_distance_mm,
    rank_by_points,
    rank_sources,
    stereo_pairs,
)
from cuspid.runtime.errors import InputError

DESIGNS = Path(__file__).parents[2] / "benchmarks" / "designs"
FOUND = [storage.read_handpiece(path) for path in sorted(DESIGNS.glob("*.json"))]


def turned(x: float, degrees: float) -> Rigid3:
    """A camera beside the origin that looks along +Z, turned towards -X."""
    return Rigid3.from_rotation_vector(np.array([0, np.deg2rad(degrees), 0]), np.zeros(3)) @ shifted(x)


@given(distance=st.floats(1.0, 1000.0), angle=st.floats(11.0, 29.0))
def test_a_converging_pair_works_where_its_axes_meet(distance, angle):
    aside = distance * np.tan(np.deg2rad(angle / 2))
    rig = rig_of(a=turned(-aside, -angle / 2), b=turned(aside, angle / 2))
    found, source = guess_working_distance_mm(rig)
    assert found == pytest.approx(np.hypot(distance, aside))
    assert source == "where their axes meet"


@given(baseline=st.floats(0.5, 500.0))
@example(baseline=356.89921938757624)
def test_a_parallel_pair_works_where_it_shares_enough(baseline):
    found, source = guess_working_distance_mm(rig_of(a=shifted(0), b=shifted(baseline)))
    assert found == pytest.approx(baseline / (2 * np.tan(np.deg2rad(31)) * (1 - 0.6)), rel=0.1)
    assert source == "their baselines"


@pytest.mark.parametrize("handpiece", [*(make() for make in (essential_four, six_cameras, twelve_cameras)), *FOUND])
def test_the_guess_for_a_design_is_of_the_right_size(handpiece):
    found, _ = guess_working_distance_mm(handpiece.rig)
    assert 0.5 < found / handpiece.working_distance_mm < 2.0


@pytest.mark.parametrize(
    "rig",
    [
        rig_of(alone=shifted(0)),
        rig_of(ahead=shifted(0), back=turned(0, 180)),
        rig_of(here=shifted(0), too=shifted(0)),
        rig_of(a=turned(-1, 10), b=turned(1, -10)),
    ],
)
def test_where_cameras_tell_no_distance_none_is_guessed(rig):
    with pytest.raises(InputError, match="working distance cannot be inferred from the cameras"):
        guess_working_distance_mm(rig)


def test_groups_join_cameras_that_see_the_same():
    side = Rigid3.from_rotation_vector(np.array([0, np.pi / 2, 0]), np.array([0, 0, 0.0]))
    rig = rig_of(o1=shifted(-1.25), o2=shifted(1.25), s1=side, s2=shifted(1.5) @ side, lone=shifted(40))
    assert camera_groups(rig, 5.0) == (("o1", "o2"), ("s1", "s2"), ("lone",))
    assert stereo_pairs(rig, 5.0) == (("o1", "o2"), ("s1", "s2"))


def test_groups_follow_from_what_is_asked_of_a_pair():
    rig = rig_of(a=shifted(0), b=shifted(2), c=shifted(4))
    assert stereo_pairs(rig, 5.0) == (("a", "b"), ("b", "c"))
    assert camera_groups(rig, 5.0) == (("a", "b", "c"),)
    assert len(stereo_pairs(rig, 5.0, PairingOptions(min_overlap=0.2))) == 3
    assert camera_groups(rig, 5.0, PairingOptions(min_overlap=0.9)) == (("a",), ("b",), ("c",))


def around(*degrees: float) -> dict[str, Rigid3]:
    """Cameras on a circle of 5 mm that look at its middle."""
    back = Rigid3(np.eye(3), np.array([0, 0, 5.0]))
    return {
        f"c{angle:g}": back @ Rigid3.from_rotation_vector(np.array([0, np.deg2rad(angle), 0]), np.zeros(3))
        for angle in degrees
    }


@given(st.floats(0.1, 70.0))
def test_the_largest_angle_of_a_pair_is_still_one(angle):
    rig = rig_of(**around(0, angle))
    names = rig.names
    assert rig.angle_deg(*names) == pytest.approx(angle)
    assert rig.meeting_deg(*names, 5.0) == pytest.approx(angle)
    assert stereo_pairs(rig, 5.0, PairingOptions(min_overlap=0.0, max_angle_deg=angle)) == (names,)
    assert stereo_pairs(rig, 5.0, PairingOptions(min_overlap=0.0, max_angle_deg=0.99 * angle)) == ()


@given(st.floats(5.0, 30.0), st.integers(5, 9))
def test_a_ring_is_no_group_each_camera_has_its_neighbours(step, count):
    rig = rig_of(**around(*(step * k for k in range(count))))
    ranked = rank_sources(rig, 5.0, PairingOptions(min_overlap=0.1))
    for k, name in enumerate(rig.names):
        neighbours = {rig.names[j] for j in (k - 1, k + 1) if 0 <= j < count}
        near = {other for other in ranked[name] if rig.angle_deg(name, other) < 2 * step - 0.01}
        assert near == neighbours or step < 8
        assert all(rig.angle_deg(name, other) <= 60.001 for other in ranked[name])


@given(st.permutations(["c0", "c7", "c15", "c24", "c33", "c41"]))
def test_sources_do_not_depend_on_the_order_of_the_cameras(names):
    poses = around(0, 7, 15, 24, 33, 41)
    ranked = rank_sources(rig_of(**poses), 5.0)
    permuted = rank_sources(rig_of(**{name: poses[name] for name in names}), 5.0)
    assert {name: set(sources) for name, sources in permuted.items()} == {k: set(v) for k, v in ranked.items()}
    assert ranked["c0"][0] == "c15"


def test_views_share_points_or_are_no_sources():
    rng = np.random.default_rng(0)
    points = rng.normal(0, 1, (300, 3)) + [0, 0, 100]
    centres = np.array([[0, 0, 0], [30.0, 0, 0], [0, 33.0, 0], [31.0, 30, 0], [0.0, 0, 10000]])
    half = np.arange(150)
    sightings = [(v, p) for v, seen in enumerate((range(300), half, half + 150, half + 150, range(300))) for p in seen]
    ranked = rank_by_points(centres, points, np.array(sightings))
    assert ranked[0] == (1, 2, 3)
    assert set(ranked[2]) == {0, 3}
    assert set(ranked[1]) == {0}
    assert ranked[4] == ()


@given(st.floats(0.0, 180.0))
def test_no_angle_is_a_wall(angle):
    at, beside = angle_weight(np.array([angle, angle + 0.01]))
    assert 0 <= at <= 1
    assert abs(at - beside) < 0.002


@pytest.mark.parametrize("wrong", [{"min_overlap": 1.1}, {"max_angle_deg": -1.0}])
def test_pairs_that_cannot_be_asked_for_are_refused(wrong):
    with pytest.raises(InputError, match="pairing: --"):
        PairingOptions(**wrong)
