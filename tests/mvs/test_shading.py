"""Depth from light and shade: right on plain surfaces, and silent where there is nothing to compare."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from builders import times
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.reconstruction import DepthMap
from cuspid.model.rig import Handpiece, Lighting, MountedCamera, Rig, Sensor
from cuspid.mvs import shading
from cuspid.mvs.matching import DepthEstimator, gray
from cuspid.mvs.refinement import RefinementOptions
from cuspid.mvs.shading import ShadingOptions
from cuspid.mvs.signal import choose_signal, detail_dn
from cuspid.runtime.errors import InputError
from plain_scene import HILLS, OPTIONS, WAY, capture_of, errors_um, lit, of_one_frame, photographs, plain_scan, white
from synthetic_scene import cast_depth, textured

FRAME = {"00000": Rigid3.identity()}


def measured(handpiece: Handpiece, images: Mapping[str, np.ndarray]) -> tuple[DepthMap, ...]:
    return DepthEstimator(handpiece, OPTIONS, signal="shading").measure(images, "00000")


def known_share(maps: Sequence[DepthMap]) -> float:
    return float(np.mean([each.known.mean() for each in maps]))


@pytest.fixture(scope="module")
def images() -> dict[str, np.ndarray]:
    return of_one_frame({key: plain_scan().source.read(*key) for key in [("00000", n) for n in lit().rig.names]})


def test_plain_hills_are_measured(images: dict[str, np.ndarray]) -> None:
    maps = measured(lit(), images)
    errors = errors_um(maps)
    assert known_share(maps) > 0.6
    assert 2 < np.median(np.abs(errors)) < 40
    assert abs(np.median(errors)) < 15
    assert np.mean(np.abs(errors) > 200) < 0.02


@pytest.mark.parametrize("window_sigma_px", [None, 3.0])
def test_texture_cannot_measure_them(images: dict[str, np.ndarray], window_sigma_px: float | None) -> None:
    """Shade correlates between the cameras as well, at depths that are a tenth of a millimetre off."""
    refinement = RefinementOptions(window_sigma_px=window_sigma_px)
    options = replace(OPTIONS, refinement=refinement)
    assert known_share(DepthEstimator(lit(), options).measure(images, "00000")) < 0.01


@pytest.mark.parametrize("factor", [0.1, 1000.0])
def test_all_lengths_scale_with_the_rig(images: dict[str, np.ndarray], factor: float) -> None:
    one, other = measured(lit(), images), measured(times(lit(), factor), images)
    for here, there in zip(one, other, strict=True):
        assert np.mean(here.known != there.known) < 0.01
        both = here.known & there.known
        assert there.depth_mm[both] == pytest.approx(factor * here.depth_mm[both], rel=1e-3)


def test_nothing_is_found_in_the_dark(images: dict[str, np.ndarray]) -> None:
    rng = np.random.default_rng(0)
    dark = {name: rng.integers(0, 8, image.shape).astype(np.uint8) for name, image in images.items()}
    assert known_share(measured(lit(), dark)) == 0


def test_a_channel_that_burnt_out_is_not_compared(images: dict[str, np.ndarray]) -> None:
    burnt = {name: image.copy() for name, image in images.items()}
    for image in burnt.values():
        image[..., 0] = 255
    maps = measured(lit(), burnt)
    assert known_share(maps) > 0.4
    assert np.median(np.abs(errors_um(maps))) < 60


def test_gains_are_corrected_where_they_are_known_and_colours_need_none() -> None:
    gains = dict(zip(lit().rig.names, (0.8, 1.0, 1.1, 0.9), strict=True))
    uneven = {name: Sensor(gain=gain, falloff=(-0.2, -0.1)) for name, gain in gains.items()}
    images = of_one_frame(photographs(lit(sensors=uneven), FRAME))
    known, unknown = measured(lit(sensors=uneven), images), measured(lit(), images)
    assert known_share(known) > 0.6
    for one, other in zip(known, unknown, strict=True):
        both = one.known & other.known
        assert both.sum() > 0.95 * one.known.sum()
        assert np.median(np.abs(one.depth_mm - other.depth_mm)[both]) < 0.002
    images = of_one_frame(photographs(white(lit(sensors=uneven)), FRAME))
    known, unknown = measured(white(lit(sensors=uneven)), images), measured(white(lit()), images)
    assert known_share(known) > 0.4
    assert known_share(unknown) < 0.5 * known_share(known)


def test_mirror_reflections_make_it_worse(images: dict[str, np.ndarray]) -> None:
    glossy = measured(lit(glare=1.0), of_one_frame(photographs(lit(glare=1.0), FRAME)))
    assert known_share(glossy) < 0.8 * known_share(measured(lit(), images))


def test_some_of_what_is_mirrored_is_seen_under_lights_between(images: dict[str, np.ndarray]) -> None:
    def known(turned_deg: float) -> np.ndarray:
        glossy = lit(glare=1.0, turned_deg=turned_deg)
        return np.stack([each.known for each in measured(glossy, of_one_frame(photographs(glossy, FRAME)))])

    first, second = known(0.0), known(60.0)
    assert 0.2 < first.mean() < 0.8
    assert 1.05 * max(first.mean(), second.mean()) < (first | second).mean() < known_share(measured(lit(), images))


def test_lights_that_are_not_told_are_asked_for(images: dict[str, np.ndarray]) -> None:
    one, *others = lit().lights
    two = replace(lit(), lightings=(Lighting(name="a", lights=(one,)), Lighting(name="b", lights=tuple(others))))
    estimator = DepthEstimator(two, OPTIONS, signal="shading")
    with pytest.raises(InputError, match=r"frame 7: which lights were on is unknown.*\(a, b\)"):
        estimator.measure(images, "7")
    assert known_share(estimator.measure(images, "7", "b")) > 0.1
    assert DepthEstimator(two, OPTIONS).measure(images, "7")  # texture does not ask


def test_neighbours_tell_how_well_a_smooth_surface_is_known() -> None:
    sigma, known = np.full((40, 50), 3.0), np.ones((40, 50), dtype=bool)
    assert shading._pool_sigma(sigma, known) == pytest.approx(3.0)
    sigma[20, 20] = 30.0
    assert 3.0 < shading._pool_sigma(sigma, known)[20, 20] < 3.2
    sigma[20, 20], known[:, 25:] = np.nan, False
    known[20, 20] = False
    pooled = shading._pool_sigma(sigma, known)
    assert np.array_equal(np.isfinite(pooled), known)
    assert 3.5 < pooled[20, 24] < 3.0 * np.sqrt(2.0)  # little more than half of its neighbours are known
    assert shading._pool_sigma(7 * sigma, known)[known] == pytest.approx(7 * pooled[known])


@pytest.mark.parametrize("how", [{"sweep_spacing": 100}, {"sweep_step_px": 100.0}, {"radius_px": 1}, {"radius_px": 7}])
def test_extreme_options_give_fewer_depths_not_an_error(images: dict[str, np.ndarray], how: dict[str, float]) -> None:
    options = replace(OPTIONS, shading=ShadingOptions(**how))
    maps = DepthEstimator(lit(), options, signal="shading").measure(images, "00000")
    assert len(maps) == 4
    assert np.sum(np.abs(errors_um(maps)) > 200) <= 0.05 * len(errors_um(maps))


def test_the_order_of_the_cameras_decides_nothing(images: dict[str, np.ndarray]) -> None:
    handpiece = lit()
    rig = replace(handpiece.rig, cameras=dict(reversed(list(handpiece.rig.cameras.items()))))
    one = {each.camera_name: each for each in measured(handpiece, images)}
    other = {each.camera_name: each for each in measured(replace(handpiece, rig=rig), images)}
    assert one.keys() == other.keys()
    for name, depth_map in one.items():
        assert np.array_equal(depth_map.depth_mm, other[name].depth_mm, equal_nan=True)


def test_plain_images_are_told_from_textured_ones() -> None:
    rng = np.random.default_rng(1)
    capture = plain_scan()
    assert choose_signal(capture, OPTIONS) == "shading"
    speckled = {}
    for frame in WAY:
        for name in capture.handpiece.rig.names:
            image = capture.source.read(frame, name).astype(float)
            speckle = np.kron(rng.normal(0, 12, (40, 40, 1)), np.ones((4, 4, 1)))
            speckled[frame, name] = np.clip(image + speckle, 0, 255).astype(np.uint8)
    assert choose_signal(capture_of(capture.handpiece, speckled), OPTIONS) == "texture"


def sprayed_to_the_right(images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The images of the first frame, with bold texture where x > 0."""
    return {name: sprayed(image, lit().rig[name]) for name, image in images.items()}


def sprayed(image: np.ndarray, mounted: MountedCamera) -> np.ndarray:
    points = surface_points(mounted.camera, mounted.cam_from_rig)
    grain = textured(points.reshape(-1, 3), cell_mm=0.12).reshape(points.shape[:2]) / 255
    factor = np.where(points[..., 0] > 0, np.clip(grain, 0.1, 1.0), 1.0)
    return np.clip(image * factor[..., None], 0, 255).astype(np.uint8)


def surface_points(camera: Camera, cam_from_rig: Rigid3) -> np.ndarray:
    """Of the hills at each pixel, in the rig."""
    depth = np.nan_to_num(cast_depth(HILLS, camera, cam_from_rig), nan=1e3)
    in_cam = camera.rays(camera.pixel_centres().reshape(-1, 2)) * depth.reshape(-1, 1)
    return cam_from_rig.inverse().apply(in_cam).reshape(camera.height, camera.width, 3)


def test_bold_texture_beside_a_plain_surface_is_matched_as_such(images: dict[str, np.ndarray]) -> None:
    handpiece, sprayed_images = lit(), sprayed_to_the_right(images)
    estimators = [DepthEstimator(handpiece, OPTIONS, signal=signal) for signal in ("texture", "shading")]
    by_texture, both = (estimator.measure(sprayed_images, "00000") for estimator in estimators)
    plain = measured(handpiece, images)
    for one, mixed, other in zip(by_texture, both, plain, strict=True):
        middle = surface_points(one.camera, one.cam_from_rig)[..., 0]
        right, left = (middle > 0.7) & (middle < 2.0), middle < -0.3
        assert other.known[left].mean() > 0.5
        assert one.known[left].mean() < 0.3
        assert mixed.known[left].mean() > 0.9 * other.known[left].mean()
        assert mixed.known[right].mean() > 0.9 * one.known[right].mean()
    right_um, left_um = errors_right_and_left(both)
    assert 0.2 < np.median(np.abs(right_um)) < 5
    assert 2 < np.median(np.abs(left_um)) < 40


def errors_right_and_left(maps: Sequence[DepthMap]) -> tuple[np.ndarray, np.ndarray]:
    off, across = errors_um(maps), []
    for each in maps:
        across.append(surface_points(each.camera, each.cam_from_rig)[..., 0][each.known])
    x = np.concatenate(across)
    return off[(x > 0.7) & (x < 2.0)], off[x < -0.3]


def test_what_is_plain_beside_texture_is_measured_by_its_shade(images: dict[str, np.ndarray]) -> None:
    capture = plain_scan()
    one = capture_of(capture.handpiece, {("00000", name): each for name, each in sprayed_to_the_right(images).items()})
    assert choose_signal(one, OPTIONS) == "shading"


@pytest.mark.long
@pytest.mark.parametrize(("grain_dn", "signal"), [(0.0, "shading"), (3.0, "texture")])
def test_faint_grain_on_large_images_is_texture(grain_dn: float, signal: str) -> None:
    """Spray, seen through the lens and the compression of a small camera, has a detail of 0.6 to 1."""
    capture, rng, images = plain_scan(), np.random.default_rng(3), {}
    cameras = {
        name: replace(each, camera=each.camera.resized(480, 480))
        for name, each in capture.handpiece.rig.cameras.items()
    }
    handpiece = capture.handpiece.with_cameras(Rig(cameras))
    for frame in WAY:
        for name in cameras:
            small = capture.source.read(frame, name)
            image = cv2.resize(small, (480, 480), interpolation=cv2.INTER_CUBIC).astype(float)
            grain = cv2.GaussianBlur(rng.normal(0, 1, (480, 480, 1)), (0, 0), 2.0)[..., None]
            images[frame, name] = np.clip(image + grain_dn * grain / grain.std(), 0, 255).astype(np.uint8)
    details = [detail_dn(gray(image)) for image in images.values()]
    assert all(0.65 < each < 1.2 for each in details if each is not None) == (grain_dn > 0)
    assert choose_signal(capture_of(handpiece, images), OPTIONS) == signal


def test_noise_is_no_texture() -> None:
    noise = np.random.default_rng(2).normal(120, 4.0, (200, 200))
    found = detail_dn(np.clip(noise, 0, 255).astype(np.uint8))
    assert found is not None
    assert 0.1 < found < 0.7
    assert detail_dn(np.zeros((200, 200), np.uint8)) is None
