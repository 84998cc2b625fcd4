"""Which cameras are matched, and at what distance."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from builders import rig_of, shifted
from cuspid.errors import InputError
from cuspid.geometry import Rigid3
from cuspid.pairing import PairingOptions, camera_groups, stereo_pairs


def test_groups_join_cameras_that_see_the_same():
    side = Rigid3.from_rotation_vector(np.array([0, np.pi / 2, 0]), np.array([0, 0, 0.0]))
    rig = rig_of(o1=shifted(-1.25), o2=shifted(1.25), s1=side, s2=shifted(1.5) @ side, lone=shifted(40))
    assert camera_groups(rig, 5.0) == (("o1", "o2"), ("s1", "s2"), ("lone",))
    assert stereo_pairs(rig, 5.0) == (("o1", "o2"), ("s1", "s2"))


def test_groups_follow_from_what_is_asked_of_a_pair():
    rig = rig_of(a=shifted(0), b=shifted(2), c=shifted(4))
    assert stereo_pairs(rig, 5.0) == (("a", "b"), ("b", "c"))
    assert camera_groups(rig, 5.0) == (("a", "b", "c"),)
    assert len(stereo_pairs(rig, 5.0, PairingOptions(minimum_overlap=0.2))) == 3
    assert camera_groups(rig, 5.0, PairingOptions(minimum_overlap=0.9)) == (("a",), ("b",), ("c",))


@given(st.floats(0.1, 170.0))
def test_the_largest_angle_of_a_pair_is_still_one(angle):
    turned = Rigid3.from_rotation_vector(np.array([0, np.deg2rad(angle), 0]), np.zeros(3))
    rig = rig_of(a=shifted(0), b=turned)
    assert rig.angle_deg("a", "b") == pytest.approx(angle)
    assert stereo_pairs(rig, 5.0, PairingOptions(minimum_overlap=0.0, maximum_angle_deg=angle)) == (("a", "b"),)
    assert stereo_pairs(rig, 5.0, PairingOptions(minimum_overlap=0.0, maximum_angle_deg=0.99 * angle)) == ()


@pytest.mark.parametrize("wrong", [{"minimum_overlap": 1.1}, {"maximum_angle_deg": -1.0}])
def test_pairs_that_cannot_be_asked_for_are_refused(wrong):
    with pytest.raises(InputError, match="pairing: the overlap"):
        PairingOptions(**wrong)
