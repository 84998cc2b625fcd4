from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from builders import THESIS_CAMERA, rig_of, shifted
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import essential_four, six_cameras, stereo_pair
from cuspid.model.camera import Camera
from cuspid.model.pairing import depth_step_mm, detail_mm, resolved_mm
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig
from cuspid.runtime.errors import InputError
from strategies import rigid3s


@given(st.lists(rigid3s(), min_size=2, max_size=4))
def test_rebasing_keeps_the_relative_poses(transforms):
    rig = rig_of(**{f"c{index}": transform for index, transform in enumerate(transforms)})
    rebased, reference_from_rig = rig.rebased("c1")
    np.testing.assert_allclose(rebased["c1"].cam_from_rig.matrix, np.eye(4), atol=1e-9)
    for name in rig.names:
        np.testing.assert_allclose(
            (rebased[name].cam_from_rig @ reference_from_rig).matrix, rig[name].cam_from_rig.matrix, atol=1e-8
        )


@given(rigid3s(), st.sampled_from([stereo_pair, essential_four, six_cameras]))
def test_the_frame_on_the_surface_is_that_of_the_designs(other_from_rig, design):
    """The rig frame of a design comes back from cameras that are given in any other one."""
    rig = design().rig
    elsewhere = Rig(
        {
            name: replace(mounted, cam_from_rig=mounted.cam_from_rig @ other_from_rig.inverse())
            for name, mounted in rig.cameras.items()
        }
    )
    found = elsewhere.over_surface(5.0)
    for name, mounted in rig.cameras.items():
        np.testing.assert_allclose(found[name].cam_from_rig.matrix, mounted.cam_from_rig.matrix, atol=1e-7)


def test_cameras_that_look_in_all_directions_have_no_surface():
    turned = Rigid3.from_rotation_vector(np.array([0, np.pi, 0]), np.zeros(3))
    with pytest.raises(InputError, match="look in all directions"):
        rig_of(ahead=shifted(0), back=turned).over_surface(5.0)


def test_overlap_of_a_parallel_pair_is_the_textbook_value():
    rig = rig_of(a=shifted(0), b=shifted(2.5))
    expected = 1 - 2.5 / (2 * 5 * np.tan(np.deg2rad(31)))
    assert rig.overlap("a", "b", 5.0) == pytest.approx(expected, abs=0.09)


def test_what_a_handpiece_resolves_is_a_pixel_or_half_a_pixel_of_disparity():
    pixel_mm = 5.0 / THESIS_CAMERA.focal_px[0]
    wide, narrow = (Handpiece(rig=rig_of(a=shifted(0), b=shifted(x))) for x in (2.5, 0.5))
    assert resolved_mm(wide) == pytest.approx(pixel_mm) == pytest.approx(depth_step_mm(wide) / 2)
    assert resolved_mm(narrow) == pytest.approx(5 * pixel_mm)
    assert resolved_mm(Handpiece(rig=rig_of(a=shifted(0)))) == pytest.approx(pixel_mm)
    # Depth is known far better than to half a pixel, so that it spoils the detail only where cameras are very close.
    assert detail_mm(wide) == pytest.approx(pixel_mm)
    assert detail_mm(narrow) == pytest.approx(1.25 * pixel_mm)
    assert detail_mm(Handpiece(rig=rig_of(a=shifted(0), b=shifted(1.0)))) == pytest.approx(pixel_mm)


@given(st.permutations(["a", "b", "c", "d"]))
def test_cameras_have_an_order_of_their_own(names):
    places = {"a": shifted(0), "b": shifted(0, 1), "c": shifted(1), "d": shifted(-2, 3)}
    ordered = rig_of(**{name: places[name] for name in names}).in_own_order()
    assert ordered.names == rig_of(**places).in_own_order().names


def test_place_and_axis_in_the_rig():
    mounted = MountedCamera(THESIS_CAMERA, Rigid3.from_rotation_vector(np.array([np.pi, 0, 0]), np.array([0, 0, 7.0])))
    np.testing.assert_allclose(mounted.centre_in_rig, [0, 0, 7], atol=1e-12)
    np.testing.assert_allclose(mounted.axis_in_rig, [0, 0, -1], atol=1e-12)


def test_unknown_names_are_named():
    rig = rig_of(a=shifted(0))
    with pytest.raises(InputError, match="no camera named 'z'; it has a"):
        rig["z"]
    with pytest.raises(InputError, match="unknown lights blue"):
        Handpiece(rig=rig, lightings=(Lighting(lights=("blue",)),))
    with pytest.raises(InputError, match="at least one camera"):
        Rig({})


def test_the_depth_range_encloses_the_working_distance():
    with pytest.raises(InputError, match="must enclose"):
        Handpiece(rig=rig_of(a=shifted(0)), working_distance_mm=5.0, depth_range_mm=(6.0, 9.0))


def test_a_light_has_a_unit_direction():
    light = Light(position_mm=np.zeros(3), direction=np.array([0, 0, 4.0]))
    np.testing.assert_array_equal(light.direction, [0, 0, 1])


@given(st.floats(0.1, 3.0), st.integers(17, 400), st.integers(17, 400))
def test_scaled_cameras_see_the_same_rays(factor, width, height):
    """Through the same place of the image, whole pixels or not; the corners stay where they are."""
    camera = Camera(
        width=width,
        height=height,
        focal_px=np.array([0.8 * width, 0.9 * height]),
        principal_point_px=np.array([0.47, 0.52]) * [width, height],
        distortion=np.array([-0.08, 0.02, 0.002, -0.003]),
    )
    whole = Handpiece(rig=Rig({"a": MountedCamera(camera, Rigid3.identity())}))
    fewer = whole.scaled(factor).rig["a"].camera
    np.testing.assert_allclose([fewer.width, fewer.height], [factor * width, factor * height], atol=0.5)
    places = np.array([[0, 0], [1, 1], [0.5, 0.5], [0.1, 0.8]])
    seen = [each.rays(places * [each.width, each.height]) for each in (camera, fewer)]
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-9)


@pytest.mark.parametrize("design", [stereo_pair, six_cameras])
def test_a_scale_of_1_changes_nothing_and_another_only_the_images(design):
    whole = design()
    same, half = whole.scaled(1.0), whole.scaled(0.5)
    assert half.footprint_mm == pytest.approx(2 * whole.footprint_mm)
    for name, mounted in whole.rig.cameras.items():
        camera = same.rig[name].camera
        assert (camera.width, camera.height) == (mounted.camera.width, mounted.camera.height)
        np.testing.assert_array_equal(camera.parameters, mounted.camera.parameters)
        np.testing.assert_array_equal(half.rig[name].cam_from_rig.matrix, mounted.cam_from_rig.matrix)
    assert half.lights == whole.lights
    assert half.working_distance_mm == whole.working_distance_mm
