"""Images of cameras that were exchanged are named, and those of a right rig are not doubted."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from builders import InMemory
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, Frame
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Rig
from cuspid.motion.exchanged import check_cameras, require_own_images
from cuspid.motion.location import MotionOptions
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions
from cuspid.runtime.errors import InputError
from hilly_film import HILLS, WAY
from synthetic_scene import diamond, render

NAMES = diamond(160).rig.names


@cache
def instants(count: int = 2) -> Capture:
    handpiece, rng = diamond(160), np.random.default_rng(3)
    way = dict(list(WAY.items())[:count])
    images = {
        (frame, name): render(HILLS, mounted, pose, rng, cell_mm=0.1)
        for frame, pose in way.items()
        for name, mounted in handpiece.rig.cameras.items()
    }
    frames = tuple(Frame(name=frame, cameras=NAMES) for frame in way)
    return Capture(handpiece=handpiece, frames=frames, source=InMemory(images))


def exchanged(order: tuple[int, ...]) -> Capture:
    """The folder of each camera holds the images of the one at this place."""
    capture = instants()
    images = {
        (frame.name, given): capture.source.images[frame.name, NAMES[true]]
        for frame in capture.frames
        for given, true in zip(NAMES, order, strict=True)
    }
    return replace(capture, source=InMemory(images))


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (1, 0, 2, 3), (2, 3, 0, 1), (3, 0, 1, 2)])
def test_any_exchange_is_named(order: tuple[int, ...]) -> None:
    found = check_cameras(exchanged(order), MotionOptions())
    assert found.taken_by == {NAMES[k]: NAMES[true] for k, true in enumerate(order) if true != k}
    assert found.agreeing >= 2 * found.before
    assert found.contradicted == ()


@pytest.mark.parametrize("turned_rad", [0.005, 0.02])
def test_a_calibration_that_is_off_is_no_exchange(turned_rad: float) -> None:
    capture, rng = instants(), np.random.default_rng(0)
    rig = Rig(
        {
            name: replace(
                mounted,
                cam_from_rig=Rigid3.from_rotation_vector(rng.normal(0, turned_rad, 3), np.zeros(3))
                @ mounted.cam_from_rig,
            )
            for name, mounted in capture.handpiece.rig.cameras.items()
        }
    )
    given = replace(capture, handpiece=replace(capture.handpiece, rig=rig))
    assert check_cameras(given, MotionOptions()).exchange is None


def test_a_camera_that_was_moved_is_named() -> None:
    capture = instants()
    cameras = dict(capture.handpiece.rig.cameras)
    turn = Rigid3.from_rotation_vector(np.array([0.2, 0.1, 0.0]), np.zeros(3))
    moved = cameras[NAMES[2]]
    cameras[NAMES[2]] = replace(moved, cam_from_rig=turn @ moved.cam_from_rig)
    given = replace(capture, handpiece=replace(capture.handpiece, rig=Rig(cameras)))
    (note,) = require_own_images(given, MotionOptions())
    assert f"of the images of {NAMES[2]} agrees" in note


def test_a_scan_with_exchanged_cameras_is_refused_unless_it_is_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture, options = exchanged((1, 0, 2, 3)), ReconstructionOptions(signal="texture")
    said = f"{NAMES[0]} holds those of {NAMES[1]}, {NAMES[1]} holds those of {NAMES[0]}"
    with pytest.raises(InputError, match=f"the images of 2 cameras are exchanged: {said}"):
        pipeline.find_poses(capture, tmp_path, options)
    located = Reconstruction(rig=capture.handpiece.rig, rig_from_world={})
    monkeypatch.setattr(pipeline, "locate", lambda *_, **__: located)
    assert pipeline.find_poses(capture, tmp_path, replace(options, own_images=False)).notes == ()
