"""Laws of the thin lens, and the published figures of the presets."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.handpiece.optics import Optics, horizontal_from_diagonal_deg
from cuspid.handpiece.presets import PRESETS
from cuspid.runtime.errors import InputError

THESIS = Optics(name="thesis", width_px=500, height_px=500, pixel_um=1.6, field_of_view_deg=62.0, f_number=7.0)


def test_the_thesis_camera_at_5_mm():
    """416 px of focal length, 12 um a pixel, 6 mm of footprint, and the overlap 1 - b / (2 Z tan 31 deg)."""
    assert pytest.approx(416.07, abs=0.01) == THESIS.focal_px
    assert THESIS.um_per_px(5.0) == pytest.approx(12.02, abs=0.01)
    assert THESIS.footprint_mm(5.0)[0] == pytest.approx(6.009, abs=0.001)
    assert THESIS.parallel_overlap(2.5, 5.0) == pytest.approx(1 - 2.5 / (2 * 5 * np.tan(np.deg2rad(31))), abs=1e-12)
    assert THESIS.parallel_overlap(7.0, 5.0) == 0


@given(blur=st.floats(0.2, 20), focus=st.floats(2.0, 12.0))
def test_the_ends_of_the_depth_of_field_have_the_asked_blur(blur, focus):
    lens = Optics(
        name="lens",
        width_px=500,
        height_px=500,
        pixel_um=1.6,
        field_of_view_deg=62.0,
        f_number=7.0,
        focus_mm=focus,
    )
    near, far = lens.depth_of_field_mm(blur)
    assert near < focus < far
    assert lens.blur_px(near) == pytest.approx(blur, rel=1e-9)
    if np.isfinite(far):
        assert lens.blur_px(far) == pytest.approx(blur, rel=1e-9)
    else:
        assert lens.blur_px(1e9) <= blur * (1 + 1e-6)


def test_blur_follows_the_image_distances_of_the_lens_equation():
    f, n = THESIS.focal_mm, THESIS.f_number
    image_of = lambda z: 1 / (1 / f - 1 / z)  # noqa: E731
    at_focus, at_3 = image_of(THESIS.focus_mm), image_of(3.0)
    disc_mm = (f / n) * abs(at_focus - at_3) / at_3
    assert THESIS.blur_px(3.0) == pytest.approx(1000 * disc_mm / THESIS.pixel_um, rel=1e-9)


def test_diffraction_grows_with_the_f_number_and_near_objects():
    assert THESIS.diffraction_px(1e9) == pytest.approx(2.44 * 0.55 * 7.0 / 1.6, rel=1e-6)
    assert THESIS.diffraction_px(2.0) > THESIS.diffraction_px(5.0) > THESIS.diffraction_px(50.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pixel_um": 0.0}, "must be positive"),
        ({"field_of_view_deg": 180.0}, "angle of view"),
        ({"focus_mm": 0.3}, "within its focal length"),
    ],
)
def test_impossible_optics_are_refused(change, message):
    good = {"width_px": 500, "height_px": 500, "pixel_um": 1.6, "field_of_view_deg": 62.0, "f_number": 7.0}
    with pytest.raises(InputError, match=message):
        Optics(name="bad", **{**good, **change})


@given(diagonal=st.floats(5, 170), width=st.integers(50, 2000), height=st.integers(50, 2000))
def test_a_diagonal_angle_of_view_reaches_the_corners(diagonal, width, height):
    horizontal = horizontal_from_diagonal_deg(diagonal, width, height)
    lens = Optics(
        name="lens", width_px=width, height_px=height, pixel_um=1.0, field_of_view_deg=horizontal, f_number=4.0,
        focus_mm=1e6,
    )  # fmt: skip
    left_up, right_down = lens.camera.rays(np.array([[0.0, 0.0], [width, height]]))
    cosine = left_up @ right_down / np.linalg.norm(left_up) / np.linalg.norm(right_down)
    assert np.rad2deg(np.arccos(cosine)) == pytest.approx(diagonal, abs=1e-5)
    even = horizontal_from_diagonal_deg(diagonal, width, height, "equidistant")
    assert even == pytest.approx(diagonal * width / np.hypot(width, height))
    assert even < horizontal < diagonal


def test_a_diagonal_angle_that_no_lens_has_is_refused():
    with pytest.raises(InputError, match="not 180 deg"):
        horizontal_from_diagonal_deg(180.0, 100, 100)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_says_what_is_published_and_what_is_inferred(name):
    lens = PRESETS[name]
    assert "Published" in lens.source
    assert "Inferred" in lens.source
    assert 0.1 < lens.focal_mm < 1.0
    assert 0.03 < lens.aperture_mm < 0.2
    assert lens.sensor_width_mm < 1.0
    near, far = lens.depth_of_field_mm(5.0)
    assert near < 5.0 < far


def test_the_presets_have_the_published_figures():
    thesis, omni, nan = PRESETS["thesis"], PRESETS["ovm6948"], PRESETS["naneye-c"]
    assert (thesis.width_px, thesis.height_px, thesis.field_of_view_deg) == (500, 500, 62.0)
    assert np.hypot(1, 1) * thesis.sensor_width_mm == pytest.approx(16 / 14, rel=0.01)
    assert (omni.width_px, omni.pixel_um) == (200, 1.75)
    assert omni.blur_px(3.0) == pytest.approx(omni.blur_px(30.0), rel=0.01)
    assert (nan.width_px, nan.pixel_um, nan.f_number) == (320, 2.4, 4.0)
    assert 2 * np.rad2deg(np.arctan(np.hypot(160, 160) / nan.focal_px)) == pytest.approx(120.0, abs=0.01)
