"""The benchmark of single frames of plain enamel tells errors that are put into depths and surfaces."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from cuspid.geometry import Rigid3
from cuspid.motion.icp.surfaces import Surface
from hilly_depth import OUT, depth_maps, surface
from synthetic_scene import height_field

DISTANCE_MM = 5.0
TURN = Rigid3.from_rotation_vector(np.array([0, 0, 2e-3]), np.array([0.004, 0, 0]))


@pytest.fixture
def plain_frames(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    return import_module("plain_frames")


def surfaces(turned: Rigid3 | None = None) -> list[Surface]:
    """Of frames without noise, each turned farther than the one before."""
    maps = depth_maps(OUT, noise_mm=0.0)
    made, error = [], Rigid3.identity()
    for frame in OUT:
        shown = [
            replace(each, cam_from_rig=each.cam_from_rig @ error.inverse()) for each in maps if each.frame == frame
        ]
        made.append(surface(shown, frame))
        error = (turned or Rigid3.identity()) @ error
    return made


def test_steps_tell_what_goes_along_from_frame_to_frame(plain_frames) -> None:
    poses = list(OUT.values())
    right = plain_frames.steps(surfaces(), poses, DISTANCE_MM)
    wrong = plain_frames.steps(surfaces(TURN), poses, DISTANCE_MM)
    assert abs(right["step_turn_z"]) < 0.2
    assert abs(right["step_along_x"]) < 1
    assert wrong["step_turn_z"] - right["step_turn_z"] == pytest.approx(2, rel=0.2)
    assert wrong["step_along_x"] - right["step_along_x"] == pytest.approx(4, rel=0.3)


def test_errors_of_depth_come_out_as_they_are_put_in(plain_frames) -> None:
    flat = height_field(lambda x, y: DISTANCE_MM + 0 * x)
    rays = np.dstack([*np.meshgrid(*2 * [np.linspace(-0.3, 0.3, 41)]), np.ones((41, 41))]).reshape(-1, 3)
    cosine = 1 / np.linalg.norm(rays, axis=1)
    depth = DISTANCE_MM + 0.001 * (3 - 40 * cosine)
    depth[:420] = np.nan
    found = plain_frames.summary([plain_frames.compared(flat, rays, depth, Rigid3.identity(), (2.0, 9.0))], "some_")
    assert found["some_known_pct"] == pytest.approx(100 * (1 - 420 / len(rays)), abs=0.01)
    assert found["some_per_cosine_um"] == pytest.approx(-40, abs=1)
    assert found["some_median_um"] == pytest.approx(np.median(40 * cosine - 3), abs=1)
    assert found["some_within_50_um_pct"] == found["some_known_pct"]
