"""Laws of what an uncertain calibration does to depth, against two cameras side by side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from builders import times
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import twelve_cameras
from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.model.tolerances import NominalOptions, Tolerances, without_covariances
from cuspid.motion.bundle.held_calibration import depth_sigma_mm


def beside(baseline: float, distance: float) -> Handpiece:
    """Two exact cameras that look along +Z, side by side."""
    camera = Camera.from_field_of_view(500, 500, 62.0)
    places = {"left": -baseline / 2, "right": baseline / 2}
    cameras = {
        name: MountedCamera(camera=camera, cam_from_rig=Rigid3(np.eye(3), np.array([-x, 0, 0])))
        for name, x in places.items()
    }
    near_far = 0.5 * distance, 2 * distance
    return Handpiece(name="two", rig=Rig(cameras), working_distance_mm=distance, depth_range_mm=near_far)


@pytest.mark.long
@given(share=st.floats(0.1, 0.4), distance=st.floats(2.0, 50.0), place_um=st.floats(1, 50))
def test_places_of_cameras_move_depth_as_their_baseline_says(share: float, distance: float, place_um: float) -> None:
    """Z / B times the difference of two places, and what both move forwards."""
    handpiece = Tolerances(place_mm=place_um / 1000).fill(beside(share * distance, distance))
    expected = place_um / 1000 * np.sqrt(2 / share**2 + 0.5)
    assert depth_sigma_mm(handpiece) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("turn_deg", [0.05, 0.2])
def test_turns_of_cameras_move_depth_with_the_square_of_the_distance(turn_deg: float) -> None:
    handpiece = Tolerances(turn_deg=turn_deg).fill(beside(2.0, 8.0))
    assert depth_sigma_mm(handpiece) == pytest.approx(8.0**2 / 2.0 * np.sqrt(2) * np.deg2rad(turn_deg), rel=0.1)


@pytest.mark.long
def test_an_exact_handpiece_measures_exactly_and_a_larger_one_errs_in_proportion() -> None:
    drawn = without_covariances(twelve_cameras())
    assert depth_sigma_mm(drawn) == 0
    nominal = NominalOptions().for_handpiece(drawn).fill(drawn)
    sigma = depth_sigma_mm(nominal)
    assert 0.03 < sigma < 0.12
    larger = times(drawn, 3.0)
    assert depth_sigma_mm(NominalOptions().for_handpiece(larger).fill(larger)) == pytest.approx(3 * sigma, rel=1e-3)
    lone = replace(nominal, rig=Rig(dict(list(nominal.rig.cameras.items())[:1])))
    assert depth_sigma_mm(lone) == 0


def test_two_cameras_in_one_place_tell_no_depth_and_end_nothing() -> None:
    handpiece = Tolerances(place_mm=0.01).fill(beside(0.0, 8.0))
    assert np.isfinite(depth_sigma_mm(handpiece))
