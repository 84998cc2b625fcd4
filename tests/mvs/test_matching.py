"""Stereo against depth that is known by ray casting."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from threading import Barrier

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.pairing import rank_sources
from cuspid.model.reconstruction import DepthMap
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.mvs.confidence import (
    ConfidenceOptions,
    Measured,
    Resolution,
    agreement,
    confidence,
    occlusion_borders,
    reject_speckle,
)
from cuspid.mvs.initial_depth import initial_pairs, semi_global
from cuspid.mvs.matching import DepthEstimator, StereoOptions, ViewSet, coarser, group_geometry
from cuspid.mvs.rectification import IdealView, rectify
from cuspid.mvs.refinement import (
    RefinementOptions,
    detail_px,
    half_window,
    image_noise,
    patch_window,
    window_size,
)
from cuspid.runtime.errors import InputError
from cuspid.runtime.workers import map_in_threads
from synthetic_scene import cast_depth, diamond, height_field, render

HILLS = height_field(lambda x, y: 5 + 0.25 * np.sin(1.8 * x) * np.cos(1.5 * y))
STEP = height_field(lambda x, y: np.where(x < 0, 4.6, 5.4), count=400)
ROOF = height_field(lambda x, y: 4.6 + 0.8 * np.abs(x), count=401)
LENS = (-0.12, 0.03, 0.001, -0.002)


def photograph(handpiece: Handpiece, mesh=HILLS, seed: int = 0, **options) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        name: render(mesh, mounted, Rigid3.identity(), rng, **options)
        for name, mounted in handpiece.rig.cameras.items()
    }


def errors_um(depth_map: DepthMap, mesh=HILLS) -> np.ndarray:
    truth = cast_depth(mesh, depth_map.camera, depth_map.cam_from_rig)
    difference = 1000 * (depth_map.depth_mm - truth)
    return difference[np.isfinite(difference)]


@cache
def hills_images() -> dict[str, np.ndarray]:
    return photograph(diamond())


@cache
def measured_hills() -> tuple[DepthMap, ...]:
    return DepthEstimator(diamond(), StereoOptions(spacing_px=2)).measure(hills_images(), "00000")


def test_depth_is_right_in_every_camera() -> None:
    # One pixel of disparity in the widest pair is 75 um here.
    for depth_map in measured_hills():
        error = errors_um(depth_map)
        assert error.size > 0.55 * depth_map.depth_mm.size
        assert 0.1 < np.median(np.abs(error)) < 6
        assert np.percentile(np.abs(error), 95) < 30
        assert abs(np.median(error)) < 1.5


def test_depth_map_is_well_formed() -> None:
    for depth_map in measured_hills():
        known = np.isfinite(depth_map.depth_mm)
        assert depth_map.depth_mm.dtype == depth_map.confidence.dtype == np.float32
        assert np.array_equal(known, depth_map.confidence > 0)
        assert depth_map.confidence.max() <= 1
        assert depth_map.color is not None
        assert depth_map.color.shape == (*known.shape, 3)
        assert not np.any(depth_map.camera.distortion)


def test_confidence_orders_the_errors() -> None:
    depth_map = measured_hills()[0]
    truth = cast_depth(HILLS, depth_map.camera, depth_map.cam_from_rig)
    known = np.isfinite(depth_map.depth_mm)
    error, weight = np.abs(depth_map.depth_mm - truth)[known], depth_map.confidence[known]
    sure, unsure = error[weight >= np.median(weight)], error[weight < np.quantile(weight, 0.1)]
    assert np.median(unsure) > 1.3 * np.median(sure)


def test_four_cameras_beat_two() -> None:
    handpiece = diamond()
    pair = replace(handpiece, rig=Rig({name: handpiece.rig[name] for name in ("west", "east")}))
    two = DepthEstimator(pair, StereoOptions(spacing_px=2)).measure(hills_images(), "00000")
    four = {depth_map.camera_name: depth_map for depth_map in measured_hills()}
    assert len(two) == 2
    for depth_map in two:
        both = np.isfinite(depth_map.depth_mm) & np.isfinite(four[depth_map.camera_name].depth_mm)
        truth = cast_depth(HILLS, depth_map.camera, depth_map.cam_from_rig)
        with_two = np.abs(depth_map.depth_mm - truth)[both]
        with_four = np.abs(four[depth_map.camera_name].depth_mm - truth)[both]
        assert 0 < with_four.mean() < with_two.mean() < 0.02


def test_a_camera_without_an_image_leaves_the_others_their_depth() -> None:
    images = {name: image for name, image in hills_images().items() if name != "west"}
    found = DepthEstimator(diamond(), StereoOptions(spacing_px=2)).measure(images, "00000")
    assert {depth_map.camera_name for depth_map in found} == set(images)
    for depth_map in found:
        error = errors_um(depth_map)
        assert error.size > 0.3 * depth_map.depth_mm.size
        assert 0.1 < np.median(np.abs(error)) < 12


def test_distorted_and_turned_cameras_measure_as_well() -> None:
    handpiece = diamond(distortion=LENS, turn_rad=0.05)
    for depth_map in DepthEstimator(handpiece).measure(photograph(handpiece), "00000"):
        error = errors_um(depth_map)
        assert error.size > 0.4 * depth_map.depth_mm.size
        assert 0.1 < np.median(np.abs(error)) < 8
        assert abs(np.median(error)) < 2


def test_no_texture_gives_no_depth() -> None:
    handpiece = diamond()
    for depth_map in DepthEstimator(handpiece).measure(photograph(handpiece, contrast=0.0), "00000"):
        assert np.isfinite(depth_map.depth_mm).mean() < 0.002


def test_unrelated_images_give_no_depth() -> None:
    handpiece = diamond()
    rng = np.random.default_rng(1)
    images = {name: rng.integers(0, 255, (160, 160), dtype=np.uint8) for name in handpiece.rig.names}
    for depth_map in DepthEstimator(handpiece).measure(images, "00000"):
        assert np.isfinite(depth_map.depth_mm).mean() < 0.002


def test_gain_and_offset_of_a_camera_do_not_matter() -> None:
    handpiece = diamond()
    images = hills_images()
    dimmed = images | {"east": (images["east"] * 0.6 + 20).astype(np.uint8)}
    depth_map = DepthEstimator(handpiece).measure(dimmed, "00000")[0]
    assert depth_map.camera_name == "west"
    assert np.median(np.abs(errors_um(depth_map))) < 7


def test_depth_outside_of_the_range_is_not_kept() -> None:
    handpiece = replace(diamond(), depth_range_mm=(4.95, 7.0))
    for depth_map in DepthEstimator(handpiece).measure(hills_images(), "00000"):
        known = depth_map.depth_mm[np.isfinite(depth_map.depth_mm)]
        assert known.size > 0
        assert known.min() >= 4.949


def roofs() -> tuple[DepthMap, DepthMap]:
    """The depth map of one camera with and without half windows."""
    images = photograph(diamond(), ROOF)
    options = StereoOptions(spacing_px=2)
    plain = replace(options, refinement=replace(options.refinement, bend_px=1000.0))
    sharp, blunt = (DepthEstimator(diamond(), each).measure(images, "00000")[0] for each in (options, plain))
    return sharp, blunt


def test_an_edge_is_not_rounded_off() -> None:
    """Half windows see one side of a roof; beyond the reach of a window hardly anything changes."""
    sharp, blunt = roofs()
    truth = cast_depth(ROOF, sharp.camera, sharp.cam_from_rig)
    across = np.abs(truth - 4.6) / 0.8
    both = np.isfinite(sharp.depth_mm) & np.isfinite(blunt.depth_mm)
    near, far = both & (across < 0.06), both & (across > 0.4)
    assert near.sum() > 100
    off = {name: 1000 * (each.depth_mm - truth)[near] for name, each in (("sharp", sharp), ("blunt", blunt))}
    assert np.median(off["blunt"]) > 4
    assert abs(np.median(off["sharp"])) < 0.4 * np.median(off["blunt"])
    assert 0 < np.abs(off["sharp"]).mean() < 0.7 * np.abs(off["blunt"]).mean()
    assert (sharp.depth_mm != blunt.depth_mm)[far].mean() < 0.005


def changed_share(half_sigmas: float) -> float:
    """On smooth hills of which every pixel is tried with half windows: how many take one."""
    options = StereoOptions(spacing_px=4)
    tried = replace(options.refinement, bend_px=0.0, half_sigmas=half_sigmas)
    plain = replace(options.refinement, bend_px=1000.0)
    halves, whole = (
        DepthEstimator(diamond(), replace(options, refinement=each)).measure(hills_images(), "00000")[0].depth_mm
        for each in (tried, plain)
    )
    return float((halves != whole)[np.isfinite(whole)].mean())


def test_noise_seldom_makes_an_edge() -> None:
    """The best of eight halves leaves less than the whole window by chance; so much less it seldom does."""
    assert 0 < changed_share(2.5) < 0.4 * changed_share(0.5)


@pytest.mark.parametrize("side", [(0, 1), (-1, 0), (1, -1)])
def test_half_of_a_window_has_the_middle_and_one_side(side: tuple[int, int]) -> None:
    window = patch_window(3, 2.0)
    half, other = half_window(window, side), half_window(window, (-side[0], -side[1]))
    assert half.shape[1] + other.shape[1] == window.shape[1] + 2 * 3 + 1
    assert half[2].sum() == pytest.approx(1)
    assert np.all(half[1] * side[0] + half[0] * side[1] >= 0)
    np.testing.assert_allclose(np.sort(half[2]), np.sort(other[2]), rtol=1e-6)


def test_a_step_is_not_bridged() -> None:
    handpiece = diamond()
    for depth_map in DepthEstimator(handpiece).measure(photograph(handpiece, STEP), "00000"):
        known = depth_map.depth_mm[np.isfinite(depth_map.depth_mm)]
        between = (known > 4.7) & (known < 5.3)
        assert known.size > 0.4 * depth_map.depth_mm.size
        assert between.mean() < 0.01


@pytest.mark.parametrize("alone", [False, True])
def test_the_same_images_give_the_same_depth(alone: bool) -> None:
    """Also where the cameras are measured side by side."""
    again = DepthEstimator(diamond(), StereoOptions(spacing_px=2)).measure(hills_images(), "00000", alone=alone)
    for one, other in zip(measured_hills(), again, strict=True):
        assert np.array_equal(one.depth_mm, other.depth_mm, equal_nan=True)


def test_what_frames_have_in_common_is_prepared_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where many threads begin at once."""
    monkeypatch.setattr("cuspid.runtime.workers.usable_cores", lambda: 8)
    prepared, together, prepare = [], Barrier(8), DepthEstimator._prepare

    def told(self: DepthEstimator, rig: Rig) -> tuple[ViewSet, ...]:
        prepared.append(rig.names)
        return prepare(self, rig)

    monkeypatch.setattr(DepthEstimator, "_prepare", told)
    estimator, images = DepthEstimator(diamond(), StereoOptions(spacing_px=8)), hills_images()

    def measure(frame: int) -> tuple[DepthMap, ...]:
        together.wait(10)
        return estimator.measure(images, f"{frame:05}")

    map_in_threads(measure, range(8))
    assert sorted(prepared) == sorted(set(prepared)) != []


def test_cameras_that_share_no_view_are_refused() -> None:
    camera = Camera.from_field_of_view(100, 100, 62.0)
    back = Rigid3.from_rotation_vector(np.array([0, np.pi, 0]), np.zeros(3))
    rig = Rig({"a": MountedCamera(camera, Rigid3.identity()), "b": MountedCamera(camera, back)})
    with pytest.raises(InputError, match="no two cameras see the same surface"):
        DepthEstimator(Handpiece(rig=rig))


def test_cameras_behind_each_other_are_refused() -> None:
    camera = Camera.from_field_of_view(100, 100, 62.0)
    behind = MountedCamera(camera, Rigid3(np.eye(3), np.array([0, 0, 1.0])))
    with pytest.raises(InputError, match="one behind the other"):
        rectify(("a", "b"), MountedCamera(camera, Rigid3.identity()), behind, 0.5)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), turn=st.floats(0, 0.1))
def test_rectified_pairs_share_rows_and_disparity_is_depth(seed: int, turn: float) -> None:
    rig = diamond(turn_rad=turn).rig
    rng = np.random.default_rng(seed)
    first, second = rng.choice(rig.names, 2, replace=False)
    pair = rectify((str(first), str(second)), rig[str(first)], rig[str(second)], 0.5)
    points = rng.uniform([-1, -1, 4], [1, 1, 6], (20, 3))
    in_first, in_second = pair.first_from_rig.apply(points), pair.second_from_rig.apply(points)
    left, right = pair.camera.project(in_first), pair.camera.project(in_second)
    assert np.allclose(left[:, 1], right[:, 1], atol=1e-9)
    assert np.allclose(left[:, 0] - right[:, 0], [pair.disparity(z) for z in in_first[:, 2]], atol=1e-9)


def test_resampling_honours_the_pixel_origin() -> None:
    mounted = diamond(distortion=LENS).rig["west"]
    view = IdealView.of("west", mounted)
    assert view.maps is not None
    row, column = 40, 100
    ray = view.camera.rays(np.array([column + 0.5, row + 0.5]))
    expected = mounted.camera.project(ray) - 0.5
    assert np.allclose([view.maps[0][row, column], view.maps[1][row, column]], expected, atol=1e-4)


@given(spacing=st.integers(1, 7), size=st.integers(20, 60))
def test_coarser_pinhole_keeps_the_rays(spacing: int, size: int) -> None:
    camera = Camera.from_field_of_view(size, size + 3, 62.0)
    grid = coarser(camera, spacing)
    fine = camera.pixel_centres()[spacing // 2 :: spacing, spacing // 2 :: spacing]
    assert np.allclose(camera.rays(fine), grid.rays(grid.pixel_centres()), atol=1e-12)


def test_group_geometry_projects_as_the_cameras_do() -> None:
    rig = diamond(turn_rad=0.05).rig
    views = [IdealView.of(name, mounted) for name, mounted in rig.cameras.items()]
    geometry = group_geometry(views, 1, (0, 2, 3))
    point = np.array([0.3, -0.2, 5.1])
    in_reference = views[1].cam_from_rig.apply(point)
    pixel = views[1].camera.project(in_reference) - 0.5
    for a, b, other in zip(geometry.infinite, geometry.parallax, geometry.others, strict=True):
        homogeneous = a @ [*pixel, 1.0] + geometry.scale / in_reference[2] * b
        expected = views[other].camera.project(views[other].cam_from_rig.apply(point)) - 0.5
        assert np.allclose(homogeneous[:2] / homogeneous[2], expected, atol=1e-9)


def test_semi_global_matching_finds_a_known_shift() -> None:
    rng = np.random.default_rng(2)
    scene = rng.integers(0, 255, (60, 140), dtype=np.uint8)
    disparity = semi_global(scene[:, :100].copy(), scene[:, 12:112].copy(), (4.0, 20.0))
    known = np.isfinite(disparity)
    assert known[5:-5, 25:-5].mean() > 0.95
    assert np.median(np.abs(disparity[known] - 12)) < 0.1
    # What lies left of the second image cannot be matched.
    assert not np.any(known[:, :11])


def test_each_camera_gets_its_widest_partner_that_sees_the_same() -> None:
    handpiece = diamond()
    pairs = initial_pairs(handpiece.rig, rank_sources(handpiece.rig, 5.0), 5.0)
    assert {frozenset(pair) for pair in pairs.values()} == {
        frozenset({"west", "east"}),
        frozenset({"north", "south"}),
    }


RESOLUTION = Resolution(mm=0.012, working_distance_mm=5.0)


def flat(centre: tuple[float, float], depth: float) -> Measured:
    camera = Camera.from_field_of_view(20, 20, 62.0)
    full = np.full((20, 20), depth)
    return Measured(camera, Rigid3(np.eye(3), -np.array([*centre, 0.0])), full, np.full((20, 20), 0.001))


PLACES = ((0, 0), 0.0), ((0.5, 0), 0.06), ((0, 0.5), -0.5)
"""Where cameras are, and how far behind the plane of the first they see it; mm."""


def test_cameras_that_agree_vote_for_a_depth_and_others_against() -> None:
    measured = [flat((0, 0), 5.0), flat((0.5, 0), 5.01), flat((0, 0.5), 5.5), flat((0.5, 0.5), 4.5)]
    votes = agreement(measured[0], measured[1:], RESOLUTION, ConfidenceOptions())[10, 10]
    # The second agrees, the third looks through the point, the fourth sees something in front and knows nothing of it.
    assert votes == 0
    assert agreement(measured[0], measured[1:2], RESOLUTION, ConfidenceOptions())[10, 10] == 1
    assert agreement(measured[0], measured[3:], RESOLUTION, ConfidenceOptions())[10, 10] == 0


@pytest.mark.parametrize(("sigmas", "votes"), [(3.0, 1), (1.0, 0)])
def test_uncertain_depths_may_differ_by_some_of_their_sigmas(sigmas: float, votes: int) -> None:
    measured = [replace(flat(at, 5 + off), sigma_mm=np.full((20, 20), 0.04)) for at, off in PLACES]
    options = ConfidenceOptions(agreement_sigmas=sigmas)
    assert agreement(measured[0], measured[1:], RESOLUTION, options)[10, 10] == votes


def test_two_cameras_alone_must_agree_better() -> None:
    measured = [flat((0, 0), 5.0), flat((0.5, 0), 5.02), flat((0, 0.5), 4.5)]
    assert agreement(measured[0], measured[1:], RESOLUTION, ConfidenceOptions())[10, 10] == 1
    assert agreement(measured[0], measured[1:2], RESOLUTION, ConfidenceOptions())[10, 10] == 0


def test_the_near_side_of_a_border_is_found() -> None:
    depth = np.full((20, 20), 5.0)
    depth[:, :10], depth[:3] = 4.0, np.nan
    pair = [replace(flat((0, 0), 5.0), depth_mm=depth), flat((2.5, 0), 5.0)]
    borders = occlusion_borders(*pair, 2, RESOLUTION, ConfidenceOptions())
    assert borders[3:, 8:10].all()
    assert not borders[:, :8].any()
    assert not borders[:, 10:].any()


def sloping(slant_deg: float, towards_deg: float) -> np.ndarray:
    """Depth on the grid of :func:`flat` of a plane 5 mm away, tilted away from the camera in one direction."""
    camera = flat((0, 0), 5.0).camera
    x, y, _ = camera.rays(camera.pixel_centres().reshape(-1, 2)).T
    downhill = np.cos(np.deg2rad(towards_deg)) * x + np.sin(np.deg2rad(towards_deg)) * y
    return (5.0 / (1 - np.tan(np.deg2rad(slant_deg)) * downhill)).reshape(20, 20)


@given(slant_deg=st.floats(0, 55), towards_deg=st.floats(0, 360), baseline_mm=st.floats(0.3, 5))
def test_a_steep_surface_has_no_borders_within(slant_deg: float, towards_deg: float, baseline_mm: float) -> None:
    pair = [replace(flat((0, 0), 5.0), depth_mm=sloping(slant_deg, towards_deg)), flat((baseline_mm, 0), 5.0)]
    borders = occlusion_borders(*pair, 2, RESOLUTION, ConfidenceOptions())
    assert not borders[2:-2, 2:-2].any()


@pytest.mark.parametrize("slope", [lambda x, y: 5 + y, lambda x, y: 5 + 0.8 * x], ids=["across", "along"])
def test_a_pair_of_cameras_measures_a_steep_surface(slope) -> None:
    """It falls by more between two pixels of the grid than lies between two surfaces at a border."""
    rig, mesh = diamond().rig, height_field(slope)
    pair = replace(diamond(), rig=Rig({name: rig[name] for name in ("west", "east")}))
    for one, other in zip(DepthEstimator(pair).measure(photograph(pair, mesh), "0"), ("east", "west"), strict=True):
        rays = one.camera.rays(one.camera.pixel_centres())
        truth = cast_depth(mesh, one.camera, one.cam_from_rig)
        in_other = rig[other].cam_from_rig.apply(one.cam_from_rig.inverse().apply(rays * truth[..., None]))
        pixels, size = rig[other].camera.project(in_other), rig[other].camera.width
        shared = (np.abs(pixels - size / 2) < size / 2 - 8).all(axis=-1) & (np.abs(truth - 5) < 1.2)
        assert np.isfinite(one.depth_mm[shared]).mean() > 0.8
        assert 0 < np.median(np.abs(errors_um(one, mesh))) < 10


@given(noise=st.floats(0.5, 5.0))
def test_noise_is_told_where_the_image_is_smooth(noise: float) -> None:
    rng = np.random.default_rng(0)
    image = 128 + rng.normal(0, noise, (120, 120))
    image[:60] += rng.normal(0, 30, (60, 120))
    assert 0.7 * noise < image_noise(image.astype(np.float32)) < 1.1 * noise


def blurred_noise(sigma_px: float, seed: int = 0) -> np.ndarray:
    white = np.random.default_rng(seed).normal(0, 1, (200, 240)).astype(np.float32)
    grain = cv2.GaussianBlur(white, (0, 0), sigma_px)
    return np.asarray(128 + 20 * grain / grain.std(), dtype=np.float32)


@pytest.mark.parametrize("sigma_px", [1.5, 2.0, 3.0])
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_detail_is_told_from_noise(sigma_px: float, noise: float) -> None:
    """White noise after a Gaussian filter has the correlation exp(-(d / L)^2) with L = 2 sigma."""
    image = blurred_noise(sigma_px)
    noisy = image + np.random.default_rng(1).normal(0, noise, image.shape).astype(np.float32)
    assert detail_px(noisy, noise) == pytest.approx(2 * sigma_px, rel=0.15)
    dark = np.vstack([noisy, np.full_like(noisy, 3)])
    assert detail_px(dark, noise) == pytest.approx(detail_px(noisy, noise), rel=0.02)


def test_windows_grow_with_blur_within_bounds() -> None:
    usual = RefinementOptions()
    sizes = [window_size(usual, blurred_noise(sigma_px), 0.5) for sigma_px in (0.5, 1.9, 2.2, 6.0)]
    assert sizes[0] == (3, 2.0)
    assert 2.0 < sizes[1][1] < sizes[2][1] < 3.0
    assert sizes[3] == (4, 3.0)
    assert window_size(RefinementOptions(radius_px=5, window_sigma_px=1.0), blurred_noise(6.0), 0.5) == (5, 1.0)
    assert window_size(usual, np.full((50, 50), 100, np.float32), 0.5) == (4, 3.0)
    assert window_size(usual, np.zeros((5, 2), np.float32), 0.5) == (4, 3.0)


def test_blurred_images_are_measured_better_with_their_larger_windows() -> None:
    images = {
        name: np.clip(
            cv2.GaussianBlur(image.astype(np.float32), (0, 0), 2.0)
            + np.random.default_rng(5).normal(0, 1.0, image.shape),
            *(0, 255),
        ).astype(np.uint8)
        for name, image in hills_images().items()
    }
    usual = DepthEstimator(diamond(), StereoOptions(spacing_px=4)).measure(images, "00000")
    small = RefinementOptions(window_sigma_px=2.0)
    before = DepthEstimator(diamond(), StereoOptions(spacing_px=4, refinement=small)).measure(images, "00000")
    for one, other in zip(usual, before, strict=True):
        assert errors_um(one).size > 0.97 * errors_um(other).size
        assert np.median(np.abs(errors_um(one))) < 0.9 * np.median(np.abs(errors_um(other)))


def test_speckle_goes_and_surface_stays() -> None:
    depth = np.full((40, 40), np.nan)
    depth[:, :20] = 5.0
    depth[5:8, 30:33] = 5.0
    depth[20:23, 5:8] = 6.0
    keep = reject_speckle(depth, RESOLUTION, ConfidenceOptions(speckle_px=20))
    assert keep[:, :5].all()
    assert not keep[:, 20:].any()
    assert not keep[20:23, 5:8].any()


@given(sigma=st.floats(1e-5, 0.1))
def test_confidence_is_inverse_variance_up_to_one(sigma: float) -> None:
    options = ConfidenceOptions()
    sigmas, keep = np.array([[sigma, 2 * sigma]]), np.array([[True, True]])
    one = Measured(Camera.from_field_of_view(2, 1, 62.0), Rigid3.identity(), np.full((1, 2), 5.0), sigmas)
    weight = confidence(one, keep, RESOLUTION, options)
    assert 0 < weight[0, 1] <= weight[0, 0] <= 1
    if sigma > options.best_sigma * RESOLUTION.mm:
        assert weight[0, 0] == pytest.approx(4 * weight[0, 1], rel=1e-5)
    assert not confidence(one, ~keep, RESOLUTION, options).any()
