"""Depth of any views: one camera that goes around, masks, weak texture, and what is said where nothing is left."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial import KDTree

from builders import InMemory
from cuspid import cli, storage
from cuspid.fusion.cleaning import CleaningOptions
from cuspid.fusion.depth_fusion import FusionOptions
from cuspid.fusion.sharp_edges import SharpEdgeOptions
from cuspid.fusion.stage import fuse
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Capture, Frame, ImageFolder, read_mask
from cuspid.model.reconstruction import DepthMap, Funnel, Reconstruction, sum_funnels
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.model.tolerances import NominalOptions
from cuspid.motion.frontend.features import detect
from cuspid.mvs import DepthEstimator, StereoOptions
from cuspid.mvs.confidence import ConfidenceOptions, Resolution, reject_speckle
from cuspid.mvs.matching import find_weak_texture, group_geometry
from cuspid.mvs.rectification import IdealView
from cuspid.mvs.refinement import image_noise
from cuspid.mvs.regularised import even_out, sweep
from cuspid.mvs.view_stage import measure_view_depth
from cuspid.pipeline.scan import ReconstructionOptions, _hold_consistent_calibration
from cuspid.runtime.errors import InputError, ReconstructionError
from hilly_scan import scan
from synthetic_scene import cast_depth, diamond, height_field, render

HILLS = height_field(lambda x, y: 5 + 0.25 * np.sin(1.8 * x) * np.cos(1.5 * y), half_width_mm=6.0)
TURNS_DEG = (-24.0, -12.0, 0.0, 12.0, 24.0)


class Masked(InMemory):
    """Images of which the left half does not count."""

    def mask(self, frame: str, camera: str) -> np.ndarray:
        height, width = self.images[frame, camera].shape[:2]
        return np.repeat((np.arange(width) >= width // 2)[None], height, axis=0).astype(np.uint8)


def around() -> Mapping[str, Rigid3]:
    """Places of one camera that goes around a point 5 mm before it."""
    back = Rigid3(np.eye(3), np.array([0, 0, 5.0]))
    turns = (Rigid3.from_rotation_vector(np.array([0.0, np.deg2rad(turn), 0]), np.zeros(3)) for turn in TURNS_DEG)
    return {f"{k:02}": back @ turn @ back.inverse() for k, turn in enumerate(turns)}


def one_camera() -> Handpiece:
    camera = diamond().rig["west"].camera
    return Handpiece(rig=Rig({"camera": MountedCamera(camera, Rigid3.identity())}), depth_range_mm=(3.5, 7.0))


@cache
def photographs() -> Mapping[tuple[str, str], np.ndarray]:
    rng, mounted = np.random.default_rng(1), one_camera().rig["camera"]
    return {(name, "camera"): render(HILLS, mounted, pose, rng) for name, pose in around().items()}


def measured(folder: Path, names: list[str], source: type[InMemory] = InMemory) -> dict[str, DepthMap]:
    frames = tuple(Frame(name=name, cameras=("camera",)) for name in names)
    capture = Capture(handpiece=one_camera(), frames=frames, source=source(photographs()))
    found = Reconstruction(rig=capture.handpiece.rig, rig_from_world={name: around()[name] for name in names})
    maps = measure_view_depth(capture, found, folder, StereoOptions())
    return {depth_map.frame: depth_map for depth_map in maps}


def errors_um(depth_map: DepthMap) -> np.ndarray:
    truth = cast_depth(HILLS, depth_map.camera, depth_map.cam_from_rig @ around()[depth_map.frame])
    difference = 1000 * (depth_map.depth_mm - truth)
    return difference[np.isfinite(difference)]


def test_one_camera_that_goes_around_measures_depth_in_any_order(tmp_path: Path) -> None:
    names = list(around())
    one = measured(tmp_path / "one", names)
    assert list(one) == names
    for depth_map in one.values():
        error = errors_um(depth_map)
        assert error.size > 0.4 * depth_map.depth_mm.size
        assert 0.1 < np.median(np.abs(error)) < 12
        assert abs(np.median(error)) < 3
    other = measured(tmp_path / "other", names[::-1])
    for name, depth_map in one.items():
        apart = np.abs(depth_map.depth_mm - other[name].depth_mm)
        assert np.nanmedian(apart) < 1e-4
        assert np.mean(depth_map.known != other[name].known) < 0.02


def test_what_is_masked_out_has_no_depth(tmp_path: Path) -> None:
    whole, masked = measured(tmp_path / "a", list(around())), measured(tmp_path / "b", list(around()), Masked)
    for name, depth_map in masked.items():
        middle = depth_map.depth_mm.shape[1] // 2
        assert not depth_map.known[:, :middle].any()
        assert depth_map.known[:, middle + 1 :].sum() > 0.9 * whole[name].known[:, middle + 1 :].sum()


def test_views_that_were_measured_are_not_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = measured(tmp_path, list(around()))
    (tmp_path / "02.npz").unlink()  # as of a run that was killed
    monkeypatch.setattr("cuspid.mvs.matching.refine", None)
    again = measured(tmp_path, list(around()))
    assert np.array_equal(first["02"].depth_mm, again["02"].depth_mm, equal_nan=True)


@pytest.mark.parametrize(("mask", "told"), [(np.zeros((8, 9)), "leaves nothing"), (np.ones((9, 8)), "8 x 9 px, but")])
def test_a_mask_that_is_empty_or_of_another_size_is_refused(tmp_path: Path, mask: np.ndarray, told: str) -> None:
    image, file = tmp_path / "image.png", tmp_path / "mask.png"
    storage.write_image(image, np.full((8, 9, 3), 90, np.uint8))
    storage.write_image(file, np.repeat(255 * mask[..., None], 3, axis=2).astype(np.uint8))
    assert read_mask(image, None) is None
    with pytest.raises(InputError, match=told):
        read_mask(image, file)


def weak(seed: int) -> dict[str, np.ndarray]:
    """Hardly more contrast than noise."""
    rng = np.random.default_rng(seed)
    rig = diamond().rig
    return {
        name: render(HILLS, mounted, Rigid3.identity(), rng, contrast=0.1, cell_mm=0.2)
        for name, mounted in rig.cameras.items()
    }


def test_weak_texture_gives_depth_that_is_less_certain() -> None:
    found = DepthEstimator(diamond()).measure(weak(0), "00000")
    for depth_map in found:
        truth = cast_depth(HILLS, depth_map.camera, depth_map.cam_from_rig)
        error = np.abs(1000 * (depth_map.depth_mm - truth))
        assert np.isfinite(error).mean() > 0.25
        assert 5 < np.nanmedian(error) < 75  # a pixel of disparity of the widest pair
        assert 0 < np.median(depth_map.confidence[depth_map.known]) < 0.7


def across_mm(camera: Camera, cam_from_rig: Rigid3) -> np.ndarray:
    """How far to the right in the rig each pixel of a camera sees the hills."""
    depth = cast_depth(HILLS, camera, cam_from_rig)
    return cam_from_rig.inverse().apply(camera.rays(camera.pixel_centres()) * depth[..., None])[..., 0]


def test_what_is_weak_in_a_good_view_is_made_smooth_and_the_rest_stays_as_it_is() -> None:
    rng, faint = np.random.default_rng(0), weak(1)
    strong = {name: render(HILLS, each, Rigid3.identity(), rng) for name, each in diamond().rig.cameras.items()}
    part = {
        name: np.where(across_mm(each.camera, each.cam_from_rig)[..., None] > 0.8, faint[name], strong[name])
        for name, each in diamond().rig.cameras.items()
    }
    for whole, found in zip(
        *(DepthEstimator(diamond()).measure(each, "00000") for each in (strong, part)), strict=True
    ):
        place = across_mm(found.camera, found.cam_from_rig)
        error_um = 1000 * np.abs(found.depth_mm - cast_depth(HILLS, found.camera, found.cam_from_rig))
        good, poor = whole.known & (place < 0.4), whole.known & (place > 1.2)
        assert found.known[good].mean() > 0.97
        assert 0.5 < np.nanmedian(error_um[good]) < 5
        assert found.known[poor].mean() > 0.25
        assert 3 < np.nanmedian(error_um[poor]) < 75
        assert np.nanmedian(found.sigma_mm[poor]) > 1.5 * np.nanmedian(found.sigma_mm[good])


@given(st.floats(0.0, 85.0), st.integers(0, 9))
@example(tilt_deg=85.0, seed=0)
def test_a_surface_is_one_piece_however_steep_and_what_stands_alone_is_none(tilt_deg: float, seed: int) -> None:
    resolution, options = Resolution(0.012, 5.0), ConfidenceOptions()
    depth = 5 / (1 + np.tan(np.deg2rad(tilt_deg)) * np.linspace(-0.06, 0.06, 60))[None].repeat(40, axis=0)
    depth[:, :3] = np.nan
    depth[20, 30] += 1.0
    depth[5:8, 5:8] = 3 + 0.1 * np.random.default_rng(seed).random((3, 3))
    kept = reject_speckle(depth, resolution, options)
    expected = np.isfinite(depth)
    expected[20, 30] = False
    expected[5:8, 5:8] = False
    assert np.array_equal(kept, expected)
    made_smooth = reject_speckle(depth, resolution, options, np.ones(depth.shape, dtype=bool))
    gentle = np.abs(np.diff(np.log(depth[30]))[3:]).max() < 5 * 0.012 / 5
    assert not (made_smooth & ~expected).any()
    assert np.array_equal(made_smooth, expected) == gentle


def test_only_the_part_of_a_view_that_has_weak_texture_is_made_smooth() -> None:
    begun = np.ones((90, 120), dtype=bool)
    agreed = np.ones_like(begun)
    agreed[:, 80:] = np.random.default_rng(0).random((90, 40)) < 0.2
    weak_part = find_weak_texture(agreed, begun)
    assert weak_part[:, 90:].all()
    assert not weak_part[:, :70].any()
    assert find_weak_texture(agreed & (np.arange(120) > 60), begun).all()
    assert not find_weak_texture(begun, begun).any()


@pytest.mark.long
@given(st.floats(20.0, 40.0))
def test_a_sweep_finds_a_plane_within_a_pixel_of_disparity(disparity: float) -> None:
    camera = diamond().rig["west"].camera
    rig = {"a": Rigid3.identity(), "b": Rigid3(np.eye(3), np.array([-1.0, 0, 0]))}
    views = [IdealView(name, camera, pose, None) for name, pose in rig.items()]
    geometry = group_geometry(views, 0, (1,))
    scene = np.random.default_rng(0).normal(120, 10, (160, 320)).astype(np.float32)
    columns = np.arange(160)
    second = np.array([np.interp(columns + disparity, np.arange(320), row) for row in scene], dtype=np.float32)
    q, sigma = sweep(
        np.stack([scene[:, :160], second]), np.full((2, 2), 160), 0, geometry, (15.0, 45.0), 4, image_noise(second)
    )
    inside = q[4:-4, 12:-2]
    assert np.isfinite(inside).mean() > 0.9
    assert abs(np.nanmedian(inside) - disparity) < 2 * sigma == 1.0


def test_noise_is_evened_out_and_steps_stay() -> None:
    rng, sigma = np.random.default_rng(0), np.full((40, 40), 0.05)
    step = np.where(np.arange(40) < 20, 5.0, 7.0) * np.ones((40, 1))
    noisy = step + sigma * rng.normal(size=step.shape)
    even = even_out(noisy, sigma, 30.0)
    assert 0.1 < np.std(even - step) / np.std(noisy - step) < 0.5
    assert np.array_equal(even_out(noisy, 1e-4 * sigma, 30.0), noisy)


@pytest.mark.parametrize("level", [0, 255])
def test_a_flat_background_takes_no_noise_from_an_image(level: int) -> None:
    noisy = np.random.default_rng(0).normal(100, 3.0, (120, 160)).astype(np.float32)
    alone = image_noise(noisy)
    noisy[:, :80] = level
    assert image_noise(noisy) == pytest.approx(alone, rel=0.25)
    assert image_noise(np.full((50, 50), float(level), np.float32)) > 0


COUNTS = st.integers(0, 1000)


@given(COUNTS, COUNTS, COUNTS, COUNTS)
def test_a_funnel_names_the_step_that_takes_most(a: int, b: int, c: int, d: int) -> None:
    left = sorted((a, b, c, d), reverse=True)
    funnel = Funnel(pixels=1000, begun=left[0], matched=left[1], agreed=left[2], kept=left[3])
    assert funnel.narrowest in funnel.shares_pct
    assert all(0 <= share <= 100 for share in funnel.shares_pct.values())
    both = sum_funnels([funnel, None, funnel])
    assert both is not None
    assert both.shares_pct == funnel.shares_pct
    assert sum_funnels([None]) is None


def test_an_empty_surface_is_refused_with_what_took_it(tmp_path: Path) -> None:
    camera = one_camera().rig["camera"].camera
    empty = DepthMap(
        frame="00",
        camera_name="camera",
        camera=camera,
        cam_from_rig=Rigid3.identity(),
        depth_mm=np.full((160, 160), np.nan, np.float32),
        confidence=np.zeros((160, 160), np.float32),
        funnel=Funnel(pixels=25600, begun=20000, matched=15000, agreed=100, kept=0),
    )
    options = FusionOptions(), CleaningOptions(), SharpEdgeOptions()
    with pytest.raises(ReconstructionError, match=r"no surface: .* 0\.39 % one that other views agree with") as refusal:
        fuse([empty], "a", {"00": Rigid3.identity()}, 0.03, tmp_path, *options)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "mesh.ply").exists()


@pytest.mark.long
@pytest.mark.parametrize(("off_px", "held"), [(0.0, True), (4.0, False)])
def test_one_instant_refines_only_a_calibration_that_it_contradicts(tmp_path: Path, off_px: float, held: bool) -> None:
    """One of the cameras looks so many pixels higher than its file says."""
    handpiece, rng = diamond(320), np.random.default_rng(2)
    turned = Rigid3.from_rotation_vector(
        np.array([off_px / handpiece.rig["east"].camera.focal_px[0], 0, 0]), np.zeros(3)
    )
    built = {
        name: replace(each, cam_from_rig=(turned if name == "east" else Rigid3.identity()) @ each.cam_from_rig)
        for name, each in handpiece.rig.cameras.items()
    }
    images = {("0", name): render(HILLS, each, Rigid3.identity(), rng) for name, each in built.items()}
    nominal = NominalOptions().for_handpiece(handpiece).fill(handpiece)
    capture = Capture(handpiece=nominal, frames=(Frame(name="0", cameras=nominal.rig.names),), source=InMemory(images))
    known, notes = _hold_consistent_calibration(capture, True, tmp_path, ReconstructionOptions(), lambda *_: None)
    assert (known.handpiece.rig["east"].covariance is None) == held
    assert bool(notes) == held


def test_a_mesh_without_scale_says_so_and_is_not_evaluated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, reference = tmp_path / "mesh.ply", tmp_path / "reference.ply"
    storage.write_mesh(file, HILLS, comment=storage.NO_SCALE)
    storage.write_mesh(reference, HILLS)
    assert len(storage.read_mesh_file(file).mesh.faces) == len(HILLS.faces)
    assert not storage.has_scale(file)
    assert storage.has_scale(reference)
    with pytest.raises(SystemExit, match="1"):
        cli.main(["evaluate", str(file), str(reference), "--out", str(tmp_path / "out")])
    assert "it has no scale" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# --- bits -------------------------------------------------------------------------------------------------------------


def write_images(folder: Path, capture: Capture, of: Callable[[np.ndarray], np.ndarray]) -> Capture:
    """The capture with images in files, each made of its own."""
    for frame in capture.frames:
        for camera in frame.cameras:
            path = folder / "images" / camera / f"{frame.name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), of(capture.image(frame, camera))[..., ::-1])
    return replace(capture, source=ImageFolder(folder))


def twelve_bits_of_a_dark_image(image: np.ndarray) -> np.ndarray:
    """A sixteenth as bright, beside a reflection that is not."""
    dark = image.astype(np.uint16)
    dark[:2, :2] = 4095
    return dark


def test_what_more_bits_show_of_dark_images_is_measured(tmp_path: Path) -> None:
    bright = scan()
    frame = bright.frames[0]
    dark = write_images(tmp_path / "deep", replace(bright, frames=(frame,)), twelve_bits_of_a_dark_image)
    eight = write_images(tmp_path / "eight", replace(bright, frames=(frame,)), lambda image: image // 16)
    fine = dark.fine_image(frame, frame.cameras[0])
    assert fine.dtype == np.float32
    assert np.array_equal(16 * fine[2:, 2:], bright.image(frame, frame.cameras[0])[2:, 2:])
    assert np.array_equal(dark.image(frame, frame.cameras[0])[2:, 2:], eight.image(frame, frame.cameras[0])[2:, 2:])
    expected, found, lost = (
        DepthEstimator(bright.handpiece).measure(each.fine_images(frame), frame.name) for each in (bright, dark, eight)
    )
    off_mm = [np.abs(one.depth_mm - other.depth_mm) for one, other in zip(found, expected, strict=True)]
    assert np.nanmedian(off_mm) < 1e-3
    shares = [sum(one.known.sum() for one in maps) for maps in (expected, found, lost)]
    assert shares[1] > 0.95 * shares[0]
    assert shares[2] < 0.5 * shares[0]


@pytest.mark.parametrize("factor", [1 / 3, 1 / 50])
def test_how_dark_an_image_of_more_bits_is_decides_nothing(factor: float) -> None:
    capture = scan()
    frame = capture.frames[0]
    fine = {name: image.astype(np.float32) for name, image in capture.images(frame).items()}
    dark = {name: image * np.float32(factor) for name, image in fine.items()}
    expected, found = (DepthEstimator(capture.handpiece).measure(each, frame.name) for each in (fine, dark))
    for one, other in zip(found, expected, strict=True):
        assert np.mean(one.known == other.known) > 0.98
        assert np.nanquantile(np.abs(one.depth_mm - other.depth_mm), 0.95) < 2e-3


def test_keypoints_of_dark_images_are_those_of_bright_ones(tmp_path: Path) -> None:
    bright = scan()
    frame = bright.frames[0]
    dark = write_images(tmp_path, replace(bright, frames=(frame,)), twelve_bits_of_a_dark_image)
    expected, found = (detect(each.fine_image(frame, frame.cameras[0])) for each in (bright, dark))
    near, _ = KDTree(found.pixels).query(expected.pixels)
    assert np.mean(near < 0.1) > 0.7
