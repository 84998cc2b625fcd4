"""Photographs of a calibrated camera: the calibration must be of their size, or of their shape."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from builders import handpiece, write_frames
from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.rig import MountedCamera, Rig
from cuspid.runtime.errors import InputError
from cuspid.storage.photographs import read_photographs

CAMERA = Camera.from_field_of_view(64, 48, 62.0)


def taken(folder: Path, *cameras: str, size: tuple[int, int] = (CAMERA.width, CAMERA.height)) -> Path:
    """Three photographs, and a calibration beside them."""
    write_frames(folder, [np.full((size[1], size[0], 3), shade, np.uint8) for shade in (90, 100, 110)])
    rig = Rig({name: MountedCamera(CAMERA, Rigid3.identity()) for name in cameras})
    storage.write_handpiece(folder / "handpiece.json", replace(handpiece(*cameras), rig=rig))
    return folder


@pytest.mark.parametrize("times", [1, 2])
def test_a_calibration_holds_for_the_same_image_in_more_pixels(tmp_path: Path, times: int) -> None:
    folder = taken(tmp_path / "photos", "a", size=(times * CAMERA.width, times * CAMERA.height))
    (camera,) = read_photographs(folder, tmp_path).cameras.values()
    assert camera.calibrated is not None
    assert camera.size == (camera.calibrated.width, camera.calibrated.height)
    assert camera.calibrated.focal_px == pytest.approx(times * CAMERA.focal_px)


def test_a_calibration_of_another_shape_or_of_several_cameras_is_refused(tmp_path: Path) -> None:
    wide = taken(tmp_path / "wide", "a", size=(2 * CAMERA.width, CAMERA.height))
    with pytest.raises(InputError, match=f"px, but the calibration is for {CAMERA.width} x {CAMERA.height} px; give"):
        read_photographs(wide, tmp_path)
    with pytest.raises(InputError, match=r"2 cameras, but .* holds photographs of one"):
        read_photographs(taken(tmp_path / "rig", "a", "b"), tmp_path)
