"""What a first depth tells of mirror reflections and of light that does not leave a surface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from cuspid.geometry import Rigid3, unit
from cuspid.geometry.gloss import transmittance
from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece, Light
from cuspid.mvs.glare import estimate_glare, mirror_reflections
from cuspid.mvs.matching import DepthEstimator, StereoOptions
from cuspid.mvs.shading import ShadingOptions
from plain_scene import OPTIONS, errors_um, lit, of_one_frame, photographs, white
from synthetic_scene import cast_depth, height_field

GRID = Camera.from_field_of_view(60, 60, 60.0)
BALL = height_field(lambda x, y: 7 - np.sqrt(np.maximum(9 - x**2 - y**2, 0.01)), half_width_mm=2.5)
LEAK = 0.1
FRAME = {"00000": Rigid3.identity()}


def led(x_mm: float, *, glare: float = 0.03, colour: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Light:
    return Light(
        position_mm=np.array([x_mm, 0.0, 0.0]),
        direction=np.array([0, 0, 1.0]),
        glare=glare,
        colour=np.array(colour, dtype=float),
    )


def brightest(values: np.ndarray) -> np.ndarray:
    """Row and column."""
    return np.array(np.unravel_index(values.argmax(), values.shape))


@pytest.mark.parametrize("x_mm", [-3.0, 0.0, 2.0])
def test_a_spot_lies_where_the_surface_mirrors_the_light(x_mm: float) -> None:
    depth = cast_depth(BALL, GRID, Rigid3.identity())
    spot = brightest(estimate_glare(GRID, depth, [led(x_mm)], 1.4).mirrored[..., 0])
    # Where the normal of the ball (centre at 7 mm) halves the angle between camera and light.
    rays = GRID.rays(GRID.pixel_centres().reshape(-1, 2)).reshape(60, 60, 3)
    points = rays * depth[..., None]
    halfway = unit(unit(np.array([x_mm, 0.0, 0.0]) - points) - unit(points))
    aligned = (halfway * unit(points - np.array([0, 0, 7.0]))).sum(axis=-1)
    assert np.abs(spot - brightest(np.where(np.isfinite(aligned), aligned, -1))).max() <= 2


def test_spots_have_the_colour_of_their_lights_and_no_other_has_any() -> None:
    depth = cast_depth(BALL, GRID, Rigid3.identity())
    lights = [led(-3.0, colour=(1, 0, 0)), led(3.0, colour=(0, 1, 0))]
    found = estimate_glare(GRID, depth, lights, 1.4).mirrored
    assert brightest(found[..., 0])[1] < 30 < brightest(found[..., 1])[1]
    assert not found[..., 2].any()
    assert not estimate_glare(GRID, depth, [], 1.4).mirrored.any()


def test_reflections_go_with_the_share_that_passes_and_not_with_power_or_scale() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -2, 4], [2, 2, 6], (50, 3))
    normals = unit(rng.normal([0, 0, -2], 0.5, (50, 3)))
    one = mirror_reflections(points, normals, [led(1.0)])
    assert one.max() > 0
    assert mirror_reflections(points, normals, [led(1.0, glare=0.06)]) == pytest.approx(2 * one)
    assert mirror_reflections(points, normals, [replace(led(1.0), power=7.0)]) == pytest.approx(one)
    far = replace(led(1.0), position_mm=np.array([1000.0, 0, 0]))
    assert mirror_reflections(1000 * points, normals, [far]) == pytest.approx(one, rel=1e-6)


def test_less_light_leaves_at_grazing_angles() -> None:
    angles = np.deg2rad([0, 30, 60, 80, 90])
    shares = np.array([transmittance(np.cos(angle), 1.4) for angle in angles])
    # Fresnel's equations: 6.7 % of the light is reflected at 60 degrees, 2.8 % at 0, 38.8 % at 80, all at 90.
    assert shares == pytest.approx([1, 0.9990, 0.955, 0.651, 0], abs=0.004)
    assert transmittance(0.3, 1.0) == pytest.approx(1)


def test_a_pit_that_a_reflection_made_is_looked_past() -> None:
    """The first depth is wrong where a light is mirrored: that its slope hides the spot there is known."""
    depth = np.full((60, 60), 5.0)
    clean = estimate_glare(GRID, depth, [led(0.0)], 1.4)
    rows, columns = np.mgrid[:60, :60]
    away = (rows - 30) ** 2 + (columns - 30) ** 2
    pit = estimate_glare(GRID, depth + 0.1 * np.exp(-away / 3), [led(0.0)], 1.4)
    most = clean.mirrored.max()
    assert pit.mirrored[away < 9].min() < 0.6 * most
    assert (pit.mirrored + 2 * pit.uncertain)[away < 9].min() > 0.7 * most
    assert clean.uncertain.max() < 0.25 * most
    hole = estimate_glare(GRID, np.where(away < 2, np.nan, depth), [led(0.0)], 1.4)
    assert hole.mirrored[30, 30, 0] > 0.8 * most


def test_finer_images_show_the_same_spots() -> None:
    def spots(fineness: int) -> np.ndarray:
        grid = Camera.from_field_of_view(60 * fineness, 60 * fineness, 60.0)
        depth = cast_depth(BALL, grid, Rigid3.identity())
        found = estimate_glare(grid, depth, [led(1.0)], 1.4).mirrored[..., 0]
        return found.reshape(60, fineness, 60, fineness).mean(axis=(1, 3))

    coarse, fine = spots(1), spots(4)
    assert np.abs(coarse - fine).max() < 0.25 * fine.max()
    assert np.corrcoef(coarse.ravel(), fine.ravel())[0, 1] > 0.95


def rms_um(handpiece: Handpiece, images: Mapping[str, np.ndarray]) -> float:
    maps = DepthEstimator(handpiece, OPTIONS, signal="shading").measure(images, "00000")
    return float(np.sqrt(np.mean(errors_um(maps) ** 2)))


@cache
def matte_um() -> float:
    """Where nothing is reflected."""
    return rms_um(lit(), of_one_frame(photographs(lit(), FRAME)))


@pytest.mark.long
@pytest.mark.parametrize(("leak", "most"), [(0.03, 1.3), (LEAK, 2.0)])
def test_polarisers_that_leak_do_little_harm(leak: float, most: float) -> None:
    images = of_one_frame(photographs(lit(glare=leak), FRAME))
    known, unknown = rms_um(lit(glare=leak), images), rms_um(lit(), images)
    assert matte_um() < known < most * matte_um()
    assert known < 0.95 * unknown


@pytest.mark.long
@pytest.mark.parametrize("coloured", [False, True])
def test_light_that_is_lost_matters_where_the_lights_have_one_colour(coloured: bool) -> None:
    handpiece = lit() if coloured else white(lit())
    images = of_one_frame(photographs(handpiece, FRAME))
    errors = []
    for index in (1.0, 1.4):
        options = StereoOptions(spacing_px=4, shading=ShadingOptions(exit_index=index))
        maps = DepthEstimator(handpiece, options, signal="shading").measure(images, "00000")
        errors.append(np.mean(np.abs(errors_um(maps))))
    if coloured:
        assert errors[1] == pytest.approx(errors[0], rel=0.01)
    else:
        assert errors[1] < 0.9 * errors[0]
