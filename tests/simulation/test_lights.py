"""A handpiece of which no lights are known can be simulated, and it is said how."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cuspid.handpiece.designs import DesignOptions, essential_four
from cuspid.pipeline import scan as pipeline
from cuspid.simulation.lights import with_default_lights
from cuspid.simulation.optics import OpticsOptions
from cuspid.simulation.path.scan import ScanPathOptions, steady_poses

FOUR = essential_four(DesignOptions(width_px=24, height_px=24))
DARK = dataclasses.replace(FOUR, lights={}, lightings=())


def test_each_camera_gets_a_light_beside_it(caplog):
    with caplog.at_level("INFO", logger="cuspid"):
        shining = with_default_lights(DARK)
    assert tuple(shining.lights) == DARK.rig.names
    for name, mounted in DARK.rig.cameras.items():
        light = shining.lights[name]
        assert 0.4 < np.linalg.norm(light.position_mm - mounted.centre_in_rig) < 0.6
        assert mounted.cam_from_rig.apply(light.position_mm)[2] == 0
        np.testing.assert_array_equal(light.direction, mounted.axis_in_rig)
    assert caplog.messages == ["handpiece essential-four: it has no lights; one beside each camera is assumed"]


def test_known_lights_are_left_alone(caplog):
    assert with_default_lights(FOUR) is FOUR
    assert not caplog.messages


def test_a_handpiece_without_lights_is_simulated(coarse_phantom, tmp_path):
    poses = steady_poses(coarse_phantom, ScanPathOptions(tooth=46), per_pass=1)
    capture, truth = pipeline.take_images(
        coarse_phantom, DARK, {"00000": poses[0]}, tmp_path, pipeline.RenderOptions(supersampling=1)
    )
    assert len(truth.handpiece.lights) == 4
    for image in capture.images(capture.frames[0]).values():
        assert image.std() > 10


@pytest.mark.long
def test_light_that_cannot_go_below_the_surface_is_told(coarse_phantom, tmp_path, caplog):
    poses = {"00000": steady_poses(coarse_phantom, ScanPathOptions(tooth=46), per_pass=1)[0]}
    told = {}
    for texture, optics in (
        ("artificial", OpticsOptions(scattering=1.0)),
        ("artificial", OpticsOptions(optics="clinical")),
        ("enamel", OpticsOptions(scattering=1.0)),
    ):
        options = pipeline.RenderOptions(texture=texture, optics=optics, supersampling=1)
        with caplog.at_level("INFO", logger="cuspid"):
            pipeline.take_images(coarse_phantom, FOUR, poses, tmp_path / f"{len(told)}", options)
        told[texture, optics] = "--scattering changes nothing" in caplog.text
        caplog.clear()
    assert list(told.values()) == [True, False, False]
