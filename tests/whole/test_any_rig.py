"""Laws that hold for every rig: its size, and the order and the names of its cameras, decide nothing."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from importlib import import_module
from inspect import isfunction
from pathlib import Path

import numpy as np
import pytest

from builders import InMemory, times
from cuspid.fusion.depth_fusion import FusionOptions
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Capture, Frame
from cuspid.model.mesh import Mesh
from cuspid.model.pairing import detail_mm, resolved_mm
from cuspid.model.reconstruction import DepthMap, Reconstruction
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.model.tolerances import EXACT
from cuspid.motion import MotionOptions, locate
from cuspid.mvs import DepthEstimator, StereoOptions
from cuspid.mvs.across import AcrossOptions
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions
from hilly_scan import HILLS, SIZE_PX, WAY, capture_of, scan
from synthetic_scene import DIAMOND_MM, diamond, height_field, render

FACTORS = (0.1, 2.0, 1000.0)


def far_scan() -> tuple[Capture, Mesh]:
    """Three frames of the same cameras four times as far away, where depth is less certain than a pixel is wide."""
    handpiece = replace(diamond(SIZE_PX), working_distance_mm=20.0, depth_range_mm=(14.0, 28.0))
    hills = height_field(lambda x, y: 20 + 0.8 * np.sin(1.8 * x) * np.cos(1.5 * y), half_width_mm=16.0)
    way = {frame: Rigid3(pose.rotation, 3 * pose.translation) for frame, pose in WAY.items()}
    rng = np.random.default_rng(3)
    images = {
        (frame, name): render(hills, mounted, pose, rng, cell_mm=0.5)
        for frame, pose in way.items()
        for name, mounted in handpiece.rig.cameras.items()
    }
    return capture_of(handpiece, images), hills


def uncertain(handpiece: Handpiece) -> Handpiece:
    """The handpiece with a calibration that is only about right: 1 mrad, and 10 um at its size."""
    covariance = np.diag(np.repeat([1e-3, 1e-2], 3) ** 2)
    return replace(
        handpiece,
        rig=Rig({name: replace(each, covariance=covariance) for name, each in handpiece.rig.cameras.items()}),
    )


FIXED = ReconstructionOptions(calibration="fixed")


@cache
def measured(factor: float = 1.0) -> tuple[DepthMap, ...]:
    capture = scan()
    return DepthEstimator(times(capture.handpiece, factor)).measure(capture.images(capture.frames[0]), "00000")


@cache
def reconstructed(factor: float, folder: Path) -> tuple[Reconstruction, Mesh]:
    capture = replace(scan(), handpiece=times(scan().handpiece, factor))
    return pipeline.reconstruct(capture, folder / f"{factor:g}", FIXED)


@pytest.fixture(scope="module", autouse=True)
def what_only_plain_surfaces_need_is_not_called() -> Iterator[None]:
    """benchmarks/freshness.py counts on it."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a scan of texture called what only plain surfaces need")

    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
        plain = import_module("freshness").PLAIN
        for module in [each for name, each in list(sys.modules.items()) if name.startswith("cuspid")]:
            for name, value in list(vars(module).items()):
                if isfunction(value) and value.__module__ in plain:
                    patch.setattr(module, name, refuse)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scans")


def check_depths(found: DepthMap, expected: DepthMap, factor: float = 1.0) -> None:
    """Alike but for single pixels on the brink of a limit."""
    share, wanted = (np.isfinite(each.depth_mm) for each in (found, expected))
    assert share.mean() == pytest.approx(wanted.mean(), abs=0.01)
    both = share & wanted
    off = np.abs(found.depth_mm[both] / factor / expected.depth_mm[both] - 1)
    assert both.sum() > 0.99 * wanted.sum()
    assert np.quantile(off, 0.99) < 1e-5
    assert np.quantile(np.abs(found.confidence[both] - expected.confidence[both]), 0.99) < 1e-3


def check_poses(found: Reconstruction, expected: Reconstruction, factor: float = 1.0) -> None:
    assert found.frames == expected.frames
    for name, pose in found.rig_from_world.items():
        off = Rigid3(pose.rotation, pose.translation / factor) @ expected.rig_from_world[name].inverse()
        assert np.abs(off.rotation_vector).max() < 1e-5
        assert np.abs(off.translation).max() < 5e-5


def check_mesh(found: Mesh, expected: Mesh, factor: float = 1.0) -> None:
    """As many faces, and the one lies on the other."""
    assert len(found.faces) == pytest.approx(len(expected.faces), rel=0.01)
    distance, _, _ = expected.closest(found.vertices / factor)
    assert np.quantile(distance, 0.95) < 5e-4
    assert (distance < 0.02).mean() > 0.99


# --- lengths ----------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_depth_is_dense_at_the_size_of_a_handpiece() -> None:
    for depth_map in measured():
        assert np.isfinite(depth_map.depth_mm).mean() > 0.6


@pytest.mark.parametrize("factor", FACTORS)
def test_the_same_images_of_a_larger_rig_give_larger_depths(factor: float) -> None:
    for found, expected in zip(measured(factor), measured(), strict=True):
        check_depths(found, expected, factor)


@pytest.mark.long
@pytest.mark.parametrize("factor", FACTORS)
def test_the_same_images_of_a_larger_rig_give_a_larger_scan(factor: float, folder: Path) -> None:
    (found, mesh), (expected, reference) = reconstructed(factor, folder), reconstructed(1.0, folder)
    assert len(expected.frames) == len(WAY)
    assert len(reference.faces) > 4500
    check_poses(found, expected, factor)
    check_mesh(mesh, reference, factor)


@pytest.mark.long
def test_a_rig_held_far_away_shows_what_its_pixels_see(folder: Path) -> None:
    """Hills 4 mm apart under pixels of 0.15 mm: fused at half a pixel of disparity, 0.6 mm, they would be lost."""
    capture, hills = far_scan()
    assert detail_mm(capture.handpiece) == pytest.approx(0.15, abs=0.01)
    assert resolved_mm(capture.handpiece) == pytest.approx(0.6, abs=0.01)
    _, mesh = pipeline.reconstruct(capture, folder / "far", FIXED)
    assert 0.02 < np.mean(hills.closest(mesh.vertices)[0]) < 0.08
    seen = hills.vertices[np.abs(hills.vertices[:, :2]).max(axis=1) < 5]
    assert (mesh.closest(seen)[0] < 0.15).mean() > 0.85


# --- lenses -----------------------------------------------------------------------------------------------------------


def converging(size_px: int, focal_factor: float = 1.0) -> Handpiece:
    """Four cameras that look at one place in the working distance, through a longer lens."""
    camera = Camera(
        width=size_px,
        height=size_px,
        focal_px=np.full(2, size_px * 0.832 * focal_factor),
        principal_point_px=np.full(2, size_px / 2),
    )
    mounted = {name: MountedCamera(camera, aimed(np.array([x, y, 0.0]))) for name, (x, y) in DIAMOND_MM.items()}
    return replace(diamond(size_px), rig=Rig(mounted))


def aimed(centre_mm: np.ndarray, at_mm: tuple[float, float, float] = (0.0, 0.0, 5.0)) -> Rigid3:
    """``cam_from_rig`` of a camera that looks at a place."""
    along = np.array(at_mm) - centre_mm
    z = along / np.linalg.norm(along)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return Rigid3(rotation, -rotation @ centre_mm)


def cropped(capture: Capture, border_px: int) -> Capture:
    """The same images without their border."""
    window = slice(border_px, -border_px)

    def narrower(mounted: MountedCamera) -> MountedCamera:
        camera = mounted.camera
        return replace(
            mounted,
            camera=replace(
                camera,
                width=camera.width - 2 * border_px,
                height=camera.height - 2 * border_px,
                principal_point_px=camera.principal_point_px - border_px,
            ),
        )

    rig = Rig({name: narrower(mounted) for name, mounted in capture.handpiece.rig.cameras.items()})
    images = {
        (frame.name, camera): np.ascontiguousarray(capture.image(frame, camera)[window, window])
        for frame in capture.frames
        for camera in frame.cameras
    }
    return replace(capture, handpiece=replace(capture.handpiece, rig=rig), source=InMemory(images))


def test_images_without_their_border_give_the_same_depth() -> None:
    """So that no limit depends on how wide the field is."""
    handpiece, rng = converging(256), np.random.default_rng(3)
    frame = next(iter(WAY))
    images = {
        (frame, name): render(HILLS, mounted, WAY[frame], rng, cell_mm=0.07)
        for name, mounted in handpiece.rig.cameras.items()
    }
    frames = (Frame(name=frame, cameras=handpiece.rig.names),)
    whole = Capture(handpiece=handpiece, frames=frames, source=InMemory(images))
    border_px = 63
    middle = cropped(whole, border_px)
    for one, other in zip(depths_of(whole), depths_of(middle), strict=True):
        border = border_px // StereoOptions().grid_px
        height, width = other.depth_mm.shape
        expected = one.depth_mm[border : border + height, border : border + width]
        both = np.isfinite(expected) & np.isfinite(other.depth_mm)
        assert both.mean() > 0.75 * np.isfinite(expected).mean()
        assert np.quantile(np.abs(other.depth_mm - expected)[both], 0.95) < 0.1 * resolved_mm(handpiece)


def depths_of(capture: Capture) -> tuple[DepthMap, ...]:
    return DepthEstimator(capture.handpiece).measure(capture.images(capture.frames[0]), capture.frames[0].name)


@pytest.mark.long
def test_a_longer_lens_gives_the_same_scan_of_smaller_hills(folder: Path) -> None:
    """From the same distance, twelve times as small: a surface of 0.6 mm is no piece to be removed."""
    factor = 12.0
    hills = height_field(
        lambda x, y: 5 + 0.25 / factor * np.sin(1.8 * factor * x) * np.cos(1.5 * factor * y), half_width_mm=5.0 / factor
    )
    handpiece, rng = converging(SIZE_PX, factor), np.random.default_rng(3)
    way = {
        frame: Rigid3.from_rotation_vector(pose.rotation_vector / factor, pose.translation / factor)
        for frame, pose in WAY.items()
    }
    images = {
        (frame, name): render(hills, mounted, pose, rng, cell_mm=0.1 / factor)
        for frame, pose in way.items()
        for name, mounted in handpiece.rig.cameras.items()
    }
    _, mesh = pipeline.reconstruct(capture_of(handpiece, images), folder / f"lens {factor:g}", FIXED)
    assert 4000 < len(mesh.faces) < 5500
    assert 0.01 < hills.closest(mesh.vertices)[0].mean() / detail_mm(handpiece) < 0.1
    assert np.ptp(mesh.vertices, axis=0)[:2].min() > 5.5 / factor


@pytest.mark.parametrize("factor", FACTORS)
def test_a_larger_rig_is_taken_to_be_as_well_known_for_its_size(factor: float) -> None:
    given, options = scan().handpiece, ReconstructionOptions()
    found, expected = (
        pipeline.apply_uncertainty(times(given, factor), options),
        times(pipeline.apply_uncertainty(given, options), factor),
    )
    for one, other in zip(found.rig.cameras.values(), expected.rig.cameras.values(), strict=True):
        assert np.allclose(one.covariance, other.covariance, rtol=1e-12, atol=0)
        assert np.array_equal(one.camera.covariance, other.camera.covariance)
        assert other.covariance.any()


@pytest.mark.long
def test_a_larger_rig_is_calibrated_alike() -> None:
    capture, factor = scan(), 1000.0
    given = uncertain(capture.handpiece)
    expected, found = (locate(replace(capture, handpiece=times(given, k)), MotionOptions()) for k in (1.0, factor))
    check_poses(found, expected, factor)
    refined = times(replace(given, rig=expected.rig), factor).rig
    for one, other in zip(found.rig.cameras.values(), refined.cameras.values(), strict=True):
        assert np.allclose(one.cam_from_rig.rotation, other.cam_from_rig.rotation, atol=1e-6)
        assert np.allclose(one.cam_from_rig.translation / factor, other.cam_from_rig.translation / factor, atol=1e-5)
        sigmas = np.sqrt(np.diag(other.covariance))
        assert np.abs((one.covariance - other.covariance) / np.outer(sigmas, sigmas)).max() < 0.002


@pytest.mark.long
def test_what_is_known_of_a_handpiece_decides_what_is_refined(folder: Path) -> None:
    """Nobody has said: taken as nominal. Said to be exact, or asked to be held: as it is, and the same bits."""
    capture = scan()
    exact = replace(capture, handpiece=EXACT.fill(capture.handpiece))
    nominal = pipeline.find_poses(capture, folder / "nominal", ReconstructionOptions())
    held = pipeline.find_poses(capture, folder / "held", FIXED)
    said = pipeline.find_poses(exact, folder / "exact", ReconstructionOptions())
    assert held.refinement is said.refinement is None
    assert nominal.refinement.rms_sigmas < 1
    assert 500 < nominal.expectation.scale_sigma_ppm < 20_000
    for name, pose in held.rig_from_world.items():
        assert np.array_equal(said.rig_from_world[name].matrix, pose.matrix)
    for name, pose in list(held.rig_from_world.items())[1:]:
        assert not np.array_equal(nominal.rig_from_world[name].matrix, pose.matrix)


# --- order and names --------------------------------------------------------------------------------------------------


def rearranged(capture: Capture, name_of: Mapping[str, str]) -> Capture:
    """The capture with its cameras in this order, under these names."""
    images = {
        (frame.name, new): capture.source.read(frame.name, old)
        for frame in capture.frames
        for old, new in name_of.items()
    }
    rig = Rig({new: capture.handpiece.rig[old] for old, new in name_of.items()})
    return capture_of(replace(capture.handpiece, rig=rig), images)


def with_another(capture: Capture, name: str, mounted: MountedCamera) -> Capture:
    """The capture with a camera more, first in order, whose images are black."""
    black = {(frame.name, name): np.zeros((SIZE_PX, SIZE_PX, 3), np.uint8) for frame in capture.frames}
    taken = {(frame.name, each): capture.image(frame, each) for frame in capture.frames for each in frame.cameras}
    rig = Rig({name: mounted, **capture.handpiece.rig.cameras})
    return capture_of(replace(capture.handpiece, rig=rig), black | taken)


def blind_cameras() -> dict[str, MountedCamera]:
    """One among the others, its lens covered, and one that looks away."""
    camera = scan().handpiece.rig["west"].camera
    away = Rigid3.from_rotation_vector(np.array([0, np.pi, 0]), np.array([0.5, 0.5, 0.0]))
    return {"covered": MountedCamera(camera, Rigid3.identity()), "away": MountedCamera(camera, away)}


CHANGES = {
    "reversed": lambda capture: rearranged(capture, {name: name for name in reversed(capture.handpiece.rig.names)}),
    "shuffled": lambda capture: rearranged(capture, {name: name for name in ("north", "east", "south", "west")}),
    "renamed": lambda capture: rearranged(
        capture, dict(zip(capture.handpiece.rig.names, ("zeta", "a", "m 1", "B"), strict=True))
    ),
    "with one covered": lambda capture: with_another(capture, "covered", blind_cameras()["covered"]),
    "with one that looks away": lambda capture: with_another(capture, "away", blind_cameras()["away"]),
}


def place(depth_map: DepthMap) -> tuple[float, ...]:
    """Where its camera is, which tells it from the others whatever it is called."""
    return tuple(depth_map.cam_from_rig.translation.round(6))


@pytest.mark.parametrize("change", CHANGES)
def test_order_and_names_do_not_change_the_depth(change: str) -> None:
    capture = CHANGES[change](scan())
    found = DepthEstimator(capture.handpiece).measure(capture.images(capture.frames[0]), "00000")
    expected = {place(depth_map): depth_map for depth_map in measured()}
    assert len(found) == len(expected)
    for depth_map in found:
        check_depths(depth_map, expected[place(depth_map)])


@pytest.mark.long
@pytest.mark.parametrize("change", ["reversed", "with one covered"])
def test_order_and_names_do_not_change_the_scan(change: str, folder: Path) -> None:
    capture = CHANGES[change](scan())
    found, mesh = pipeline.reconstruct(capture, folder / change, FIXED)
    expected, reference = reconstructed(1.0, folder)
    assert found.rig.names == capture.handpiece.rig.names
    check_poses(found, expected)
    check_mesh(mesh, reference)


@pytest.mark.long
def test_a_draft_is_the_same_scan_at_a_glance(folder: Path) -> None:
    """The same frames at about the same places, and the same surface in fewer faces, less exactly."""
    shown = dict[str, tuple[int, int]]()
    found, mesh = pipeline.reconstruct(
        *(scan(), folder / "draft", replace(FIXED, quality="draft")),
        progress=lambda stage, done, total: shown.update({stage: (done, total)}),
    )
    assert all(done == total for done, total in shown.values())
    expected, reference = reconstructed(1.0, folder)
    assert found.frames == expected.frames
    for frame, pose in found.rig_from_world.items():
        motion = pose @ expected.rig_from_world[frame].inverse()
        assert np.linalg.norm(motion.translation) < 0.003
    assert 0.1 < len(mesh.faces) / len(reference.faces) < 0.5
    distance, _, _ = reference.closest(mesh.vertices)
    assert 0.0003 < np.median(distance) < 0.01


@pytest.mark.long
def test_fine_is_the_same_scan_with_more_faces(folder: Path) -> None:
    """The same path, for only depth and fusion differ, and a surface that lies where that of the usual quality does."""
    found, mesh = pipeline.reconstruct(scan(), folder / "fine", replace(FIXED, quality="fine"))
    expected, reference = reconstructed(1.0, folder)
    check_poses(found, expected)
    assert 3 < len(mesh.faces) / len(reference.faces) < 5
    distance, _, _ = reference.closest(mesh.vertices)
    assert 0.0001 < np.median(distance) < 0.003


def test_what_was_asked_for_goes_before_the_quality() -> None:
    asked = ReconstructionOptions(quality="draft", across=AcrossOptions(left_share=0.2))
    assert pipeline.resolve_options(asked).across.left_share == 0.2
    assert pipeline.resolve_options(asked).tracking.features.count == 500
    assert pipeline.resolve_options(asked).tracking.features.size_for(640, 480) == (160, 120)
    assert pipeline.resolve_options(asked).left_share == 1
    assert pipeline.resolve_options(replace(asked, left_share=0.3)).left_share == 0.3
    assert pipeline.resolve_options(asked).stereo.refinement.bend_px == 1000
    assert pipeline.resolve_options(asked).fusion.finer_bends is False
    assert pipeline.resolve_options(replace(asked, fusion=FusionOptions(finer_bends=True))).fusion.finer_bends is True
    fine = ReconstructionOptions(quality="fine")
    assert (
        pipeline.resolve_options(fine).stereo.grid_px < pipeline.resolve_options(ReconstructionOptions()).stereo.grid_px
    )
    assert pipeline.resolve_options(replace(fine, stereo=StereoOptions(spacing_px=5))).stereo.grid_px == 5
    assert (
        pipeline.resolve_options(fine).left_share,
        pipeline.resolve_options(replace(fine, left_share=0.3)).left_share,
    ) == (0, 0.3)
    handpiece = diamond(SIZE_PX)
    usual = ReconstructionOptions().fusion.voxel_for(detail_mm(handpiece))
    assert pipeline.fusion_for(handpiece, fine).voxel_mm == usual / 2
    assert pipeline.fusion_for(handpiece, replace(fine, fusion=FusionOptions(voxel_mm=0.2))).voxel_mm == 0.2
    standard = ReconstructionOptions()
    assert pipeline.resolve_options(standard).tracking.features.size_for(640, 480) == (320, 240)
    assert pipeline.resolve_options(standard) == replace(standard, left_share=pipeline._LEFT_SHARE)
