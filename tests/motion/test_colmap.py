"""COLMAP's sparse models: there and back, models of others, and its own mapper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from builders import image_path, mottled
from colmap_models import make_capture, make_found, without_rig, write_colmap
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Capture
from cuspid.model.reconstruction import Reconstruction
from cuspid.motion.bundle.adjustment import residuals_px
from cuspid.motion.colmap import locate_with_colmap, read_model, write_model
from cuspid.runtime.errors import InputError, ReconstructionError


def assert_same_poses(one: Reconstruction, other: Reconstruction, atol: float = 1e-9) -> None:
    """Same frames at the same places."""
    assert one.frames == other.frames
    for name, pose in one.rig_from_world.items():
        np.testing.assert_allclose(other.rig_from_world[name].matrix, pose.matrix, atol=atol)


def observations(found: Reconstruction) -> set[tuple[float, ...]]:
    """Observations with their point's place, in no order."""
    t = found.tracks
    table = np.column_stack([t.points[t.point_index], t.colors[t.point_index], t.frame_index, t.camera_index, t.pixels])
    return {tuple(row) for row in table.round(6)}


# --- there and back ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [False, True])
def test_a_model_comes_back_as_it_went(tmp_path: Path, text: bool) -> None:
    """Poses, points, colours and observations, in binary and in text; the log tells that the scale is one."""
    found = make_found()
    capture = make_capture(tmp_path, found)
    write_model(tmp_path / "sparse" / "0", found, capture)
    folder = tmp_path / "sparse"
    if text:
        folder = tmp_path / "text"
        folder.mkdir()
        pycolmap.Reconstruction(tmp_path / "sparse" / "0").write_text(folder)
    back = read_model(folder, capture)
    assert_same_poses(found, back)
    assert observations(back) == observations(found)
    assert back.log["mm_per_model_unit"] == pytest.approx(1, abs=1e-9)
    assert not back.dropped
    errors = np.linalg.norm(residuals_px(found), axis=1)
    assert back.reprojection_rms_px == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-6)


def test_colmap_agrees_with_our_projection(tmp_path: Path) -> None:
    """COLMAP's own mean reprojection error of the model is that of our residuals; nothing is left beside the model."""
    found = make_found()
    write_model(tmp_path / "sparse", found, make_capture(tmp_path, found))
    assert sorted(file.name for file in (tmp_path / "sparse").iterdir()) == [
        f"{name}.bin" for name in ("cameras", "frames", "images", "points3D", "rigs")
    ]
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    model.update_point_3d_errors()
    errors = np.linalg.norm(residuals_px(found), axis=1)
    tracked = np.bincount(found.tracks.point_index, minlength=120)
    per_point = np.bincount(found.tracks.point_index, errors, minlength=120)[tracked > 0] / tracked[tracked > 0]
    assert model.num_frames() == 4
    assert model.num_images() == 12
    np.testing.assert_allclose(
        sorted(p.error for p in model.points3D.values()), np.sort(per_point), rtol=1e-6, atol=1e-9
    )


def test_poses_without_tracks_make_a_model_too(tmp_path: Path) -> None:
    """Images without keypoints."""
    found = replace(make_found(), tracks=None)
    capture = make_capture(tmp_path, found)
    write_model(tmp_path / "sparse", found, capture)
    assert_same_poses(found, read_model(tmp_path / "sparse", capture))


# --- models of others --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("units_per_mm", [1.0, 0.001, 7.3])
def test_the_rig_sets_the_scale(tmp_path: Path, units_per_mm: float) -> None:
    """A model in any unit and world comes back in millimetres, in the rig frame of the first frame."""
    found = make_found()
    folder = write_colmap(without_rig(found, units_per_mm=units_per_mm), tmp_path / "m")
    back = read_model(folder, make_capture(tmp_path, found))
    assert_same_poses(found, back, atol=1e-6)
    assert back.log["mm_per_model_unit"] == pytest.approx(1 / units_per_mm, rel=1e-6)


def test_cameras_of_a_frame_are_averaged(tmp_path: Path) -> None:
    """Small errors of single images shrink; the spread of the scale is told."""
    found = make_found()
    folder = write_colmap(without_rig(found, noise_mm=0.005), tmp_path / "m")
    back = read_model(folder, make_capture(tmp_path, found))
    offsets = [
        np.linalg.norm(back.rig_from_world[n].inverse().translation - p.inverse().translation)
        for n, p in found.rig_from_world.items()
    ]
    assert 0 < max(offsets) < 0.03
    assert 0 < back.log["scale_spread"] < 0.02


def test_another_handpiece_is_refused(tmp_path: Path) -> None:
    """The cameras of the model do not keep the distances of the rig."""
    found = make_found()
    folder = write_colmap(without_rig(found, noise_mm=0.5), tmp_path / "m")
    with pytest.raises(InputError, match="handpiece"):
        read_model(folder, make_capture(tmp_path, found))


def test_scale_needs_two_cameras(tmp_path: Path) -> None:
    """One image a frame has no baseline."""
    found = make_found()
    model = without_rig(found)
    for frame in list(model.frames.values()):
        if frame.frame_id % 3 != 1:
            model.deregister_frame(frame.frame_id)
    with pytest.raises(InputError, match="two placed cameras"):
        read_model(write_colmap(model, tmp_path / "m"), make_capture(tmp_path, found))


def test_frames_that_the_model_lacks_are_listed(tmp_path: Path) -> None:
    """The others are read; the world is the first of them."""
    found = make_found()
    capture = make_capture(tmp_path, found)
    some = replace(found, rig_from_world=dict(list(found.rig_from_world.items())[1:]), tracks=None)
    write_model(tmp_path / "sparse", some, capture)
    back = read_model(tmp_path / "sparse", capture)
    assert back.frames == found.frames[1:]
    assert [d.what for d in back.dropped] == ["frame 00000"]
    np.testing.assert_allclose(back.rig_from_world["00001"].matrix, np.eye(4), atol=1e-9)


def test_names_of_another_capture_are_refused(tmp_path: Path) -> None:
    """And both ways of naming are shown."""
    found = make_found()
    write_model(tmp_path / "sparse", found, make_capture(tmp_path, found))
    other = make_capture(tmp_path, replace(found, rig_from_world={"x1": Rigid3.identity()}, tracks=None))
    with pytest.raises(InputError, match=r"a/00000\.png.*a/x1\.png"):
        read_model(tmp_path / "sparse", other)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.99])
def test_truncated_files_are_told(tmp_path: Path, name: str, share: float) -> None:
    """Never a crash and never a hang."""
    found = make_found()
    capture = make_capture(tmp_path, found)
    write_model(tmp_path / "sparse", found, capture)
    file = tmp_path / "sparse" / f"{name}.bin"
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(InputError, match="again"):
        read_model(tmp_path / "sparse", capture)


def test_a_folder_without_a_model_is_told(tmp_path: Path) -> None:
    """With what it should hold."""
    with pytest.raises(InputError, match="points3D"):
        read_model(tmp_path, make_capture(tmp_path, make_found()))


# --- COLMAP's mapper ---------------------------------------------------------------------------------------------


def photograph(camera: Camera, cam_from_world: Rigid3, texture: np.ndarray) -> np.ndarray:
    """The plane z = 5 with a texture of 80 px/mm."""
    rays = cam_from_world.inverse().rotate(camera.rays(camera.pixel_centres()))
    centre = cam_from_world.inverse().translation
    on_plane = centre + rays * ((5 - centre[2]) / rays[..., 2:])
    place = (on_plane[..., :2] * 80 + 800).astype(np.float32)
    gray = cv2.remap(texture, place[..., 0], place[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8)


def take_images(folder: Path, found: Reconstruction, texture: np.ndarray) -> Capture:
    """Images on disk."""
    capture = make_capture(folder, found)
    for frame, pose in found.rig_from_world.items():
        for name, mounted in found.rig.cameras.items():
            file = image_path(capture, frame, name)
            file.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(file), photograph(mounted.camera, mounted.cam_from_rig @ pose, texture))
    return capture


@pytest.mark.long
def test_colmap_maps_with_the_rig(tmp_path: Path) -> None:
    """One metric model, poses to some micrometres, and the seconds that it took."""
    found = make_found(frames=3)
    capture = take_images(tmp_path, found, mottled(np.random.default_rng(0), 1600, (3.0, 6.0, 12.0)))
    mapped = locate_with_colmap(capture, tmp_path / "colmap", with_rig=True)
    assert_same_poses(replace(found, tracks=None), mapped, atol=0.02)
    assert mapped.log["models"] == 1
    assert mapped.log["images_placed"] == 9
    assert mapped.log["mm_per_model_unit"] == pytest.approx(1, abs=1e-6)
    assert 0 < mapped.reprojection_rms_px < 1
    assert mapped.log["mapping_s"] > 0


def test_colmap_without_texture_is_told(tmp_path: Path) -> None:
    """No model, no crash."""
    capture = take_images(tmp_path, make_found(frames=2), np.full((1600, 1600), 90, np.float32))
    with pytest.raises(ReconstructionError, match="texture"):
        locate_with_colmap(capture, tmp_path / "colmap", with_rig=False)
