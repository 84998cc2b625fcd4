"""What lenses, sensors, hands and mouths do to images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Frame
from cuspid.runtime.errors import InputError
from cuspid.simulation.appearance import APPEARANCES
from cuspid.simulation.optics import CLINICAL, IDEAL, Optics, OpticsOptions, encode_image, mix_channels, through_lens
from cuspid.simulation.raycast import Scene, limit_motion, motions, render_image
from ray_scenes import CAMERA, jaw_of, led, probe, quad

SMALL = Camera.from_field_of_view(61, 61, 60.0)
WORKING_MM = 5.0
FOCUS_MM = 0.78 * WORKING_MM


def spot(depth_mm: float, optics: Optics) -> np.ndarray:
    """Image of a point at a depth, green."""
    light, depth = np.zeros((61, 61, 3)), np.full((61, 61), depth_mm)
    light[30, 30] = 1.0
    return through_lens(light, depth, SMALL, WORKING_MM, optics)[..., 1]


def width_px(image: np.ndarray) -> float:
    """Standard deviation along the rows."""
    share = image.sum(axis=0) / image.sum()
    return float(np.sqrt((share * (np.arange(61) - 30.0) ** 2).sum()))


def test_each_option_overrides_the_preset() -> None:
    assert OpticsOptions().resolved == IDEAL
    assert OpticsOptions(optics="clinical").resolved == CLINICAL
    assert OpticsOptions(optics="clinical", bayer=False, smear_mm=0.0).resolved == replace(
        CLINICAL, bayer=False, smear_mm=0.0
    )
    assert OpticsOptions(aperture_mm=0.1).resolved == replace(IDEAL, aperture_mm=0.1)
    with pytest.raises(InputError, match=r"optics: --crosstalk is 0\.5"):
        OpticsOptions(crosstalk=0.5)


@pytest.mark.parametrize("depth_mm", [2.5, 3.0, 9.0])
def test_the_disc_of_defocus_is_as_wide_as_the_thin_lens_makes_it(depth_mm: float) -> None:
    optics = Optics(aperture_mm=0.6)
    blurred, sharp = (width_px(spot(depth, optics)) for depth in (depth_mm, FOCUS_MM))
    radius_px = SMALL.focal_px[0] * 0.3 * abs(1 / depth_mm - 1 / FOCUS_MM)
    # A disc has a standard deviation of half its radius along any axis.
    assert np.sqrt(blurred**2 - sharp**2) == pytest.approx(radius_px / 2, rel=0.25)


def test_smaller_lenses_diffract_more() -> None:
    widths = [width_px(spot(FOCUS_MM, Optics(aperture_mm=aperture))) for aperture in (0.02, 0.04)]
    assert widths[0] == pytest.approx(0.42 * 0.00055 / 0.02 * SMALL.focal_px[0], rel=0.15)
    assert widths[0] > 1.3 * widths[1]


def test_a_lens_keeps_even_light_and_does_not_spread_what_is_hidden() -> None:
    even = through_lens(np.full((61, 61, 3), 0.4), np.full((61, 61), 2.6), SMALL, WORKING_MM, Optics(aperture_mm=0.5))
    assert even == pytest.approx(0.4, abs=1e-5)
    # A sharp black edge before a bright blurred background stays black.
    light, depth = np.zeros((61, 61, 3)), np.full((61, 61), FOCUS_MM)
    light[:, 31:], depth[:, 31:] = 1.0, np.inf
    seen = through_lens(light, depth, SMALL, WORKING_MM, Optics(aperture_mm=0.6))
    assert seen[30, 25, 1] < 0.01
    assert seen[30, 40, 1] > 0.9


def test_crosstalk_mixes_colours_and_keeps_grey() -> None:
    some = Optics(crosstalk=0.1)
    assert mix_channels(np.array([[[1.0, 0.0, 0.0]]]), some)[0, 0] == pytest.approx([0.8, 0.1, 0.1])
    assert mix_channels(np.full((1, 1, 3), 0.3), some) == pytest.approx(0.3)


def test_colour_filters_and_compression_keep_what_is_smooth() -> None:
    rows, columns = np.mgrid[:64, :64]
    smooth = np.dstack([80 + rows, 200 - columns, 60 + (rows + columns) // 2]).astype(np.uint8)
    for optics in (Optics(bayer=True), Optics(jpeg_quality=95), CLINICAL):
        off = encode_image(smooth, optics)[4:-4, 4:-4].astype(float) - smooth[4:-4, 4:-4]
        assert np.abs(off).max() <= 4
        assert np.abs(off.mean(axis=(0, 1))).max() < 1
    fine = np.where((rows + columns)[..., None] % 2 == 0, [200, 40, 40], [40, 40, 200]).astype(np.uint8)
    assert np.abs(encode_image(fine, Optics(bayer=True)).astype(float) - fine).mean() > 20


def test_the_handpiece_moves_from_frame_to_frame_and_smears_by_a_share_of_it() -> None:
    poses = {name: Rigid3(np.eye(3), np.array([-0.5 * k, 0.1 * k, 0.0])) for k, name in enumerate("abc")}
    frames = [Frame(name=name, cameras=("a",)) for name in poses]
    found = motions(frames, poses)
    for name, motion in found.items():
        assert motion == pytest.approx([0, 0, 0, -0.5, 0.1, 0])
        smear = limit_motion(motion, poses[name], 0.02)
        assert np.linalg.norm(smear[3:]) == pytest.approx(0.02)
        assert smear[3:5] / np.linalg.norm(smear[3:5]) == pytest.approx(np.array([-5, 1]) / np.sqrt(26))
    still = motions(frames, dict.fromkeys(poses, Rigid3.identity()))
    assert not any(motion.any() for motion in still.values())
    assert not limit_motion(still["a"], Rigid3.identity(), 0.02).any()


def test_motion_blurs_across_it_and_not_along() -> None:
    """An edge across the motion becomes a ramp as wide as the motion, about the same place."""
    jaw = jaw_of(quad((2.0, 0.0, 5.0), 2.0), labels=[11])
    scene = Scene(jaw=jaw, handpiece=probe(led()), appearance=APPEARANCES["powder"], supersampling=4)
    frame = Frame(name="a", cameras=("a",), lighting="all")

    def edge(shift_mm: tuple[float, float, float]) -> np.ndarray:
        motion = 20 * np.array([0.0, 0, 0, *shift_mm])  # from frame to frame, of which the exposure takes a share
        seen = replace(scene, optics=Optics(smear_mm=float(np.linalg.norm(shift_mm))))
        image = render_image(seen, frame, "a", Rigid3.identity(), 20.0, motion)
        middle = CAMERA.height // 2
        return image[middle - 5 : middle + 5].astype(float).mean(axis=(0, 2))

    far = 10 * 5.0 / CAMERA.focal_px[0]  # 10 px
    still, across, along = edge((0, 0, 0)), edge((far, 0, 0)), edge((0, far, 0))
    ramp = [np.count_nonzero((each > 0.15 * each.max()) & (each < 0.6 * each.max())) for each in (still, across, along)]
    assert ramp[0] <= 2
    assert 3 <= ramp[1] <= 9
    assert ramp[2] <= 2
    assert across.sum() == pytest.approx(still.sum(), rel=0.1)


@pytest.mark.parametrize("readout", [0.3, 1.0])
def test_rows_are_exposed_one_after_the_other(readout: float) -> None:
    """An upright edge that moves aside slants: from the first row to the last by what it moves meanwhile."""
    jaw = jaw_of(quad((8.0, 0.0, 5.0), 8.0), labels=[11])
    scene = Scene(jaw=jaw, handpiece=probe(led()), appearance=APPEARANCES["powder"], optics=Optics(readout=readout))
    frame = Frame(name="a", cameras=("a",), lighting="all")
    moved_px = 12.0
    motion = np.array([0.0, 0, 0, moved_px * 5.0 / CAMERA.focal_px[0], 0, 0])

    def image(optics: Optics, motion: np.ndarray) -> np.ndarray:
        return render_image(replace(scene, optics=optics), frame, "a", Rigid3.identity(), 20.0, motion)

    def edges(seen: np.ndarray) -> np.ndarray:
        lit = seen.astype(float).mean(axis=2)
        return np.array([np.argmax(row > 0.25 * row.max()) for row in lit], dtype=float)

    slanted, upright = edges(image(scene.optics, motion)), edges(image(IDEAL, motion))
    rows = np.arange(CAMERA.height)
    slope, _ = np.polyfit(rows, slanted - upright, 1)
    assert slope * CAMERA.height == pytest.approx(readout * moved_px, rel=0.1)
    # The middle row is where it would be without.
    assert abs((slanted - upright)[CAMERA.height // 2]) <= 1
    np.testing.assert_array_equal(image(scene.optics, np.zeros(6)), image(IDEAL, np.zeros(6)))
