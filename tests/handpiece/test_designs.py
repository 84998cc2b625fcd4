"""The designs have the baselines, angles and distances of the thesis."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.handpiece.designs import DESIGNS, DesignOptions, essential_four, six_cameras, stereo_pair, twelve_cameras
from cuspid.model.pairing import camera_groups, stereo_pairs
from cuspid.model.rig import Handpiece
from cuspid.runtime.errors import InputError

OPTIONS = st.builds(
    DesignOptions,
    field_of_view_deg=st.floats(40, 90),
    working_distance_mm=st.floats(1, 30),
    baseline_across_mm=st.floats(0.5, 4),
    baseline_along_mm=st.floats(0.5, 4),
    side_tilt_deg=st.floats(45, 80),
)


def baseline(handpiece: Handpiece, first: str, second: str) -> np.ndarray:
    return handpiece.rig[second].centre_in_rig - handpiece.rig[first].centre_in_rig


@given(OPTIONS)
def test_occlusal_group_has_its_baselines_across_and_along_the_arch(options: DesignOptions) -> None:
    for handpiece in (essential_four(options), twelve_cameras(options)):
        np.testing.assert_allclose(baseline(handpiece, "o2", "o1"), [0, options.baseline_across_mm, 0], atol=1e-12)
        np.testing.assert_allclose(baseline(handpiece, "o3", "o4"), [options.baseline_along_mm, 0, 0], atol=1e-12)
        np.testing.assert_allclose(handpiece.rig["o1"].centre_in_rig[2], options.working_distance_mm, atol=1e-12)


@given(OPTIONS)
def test_side_groups_have_the_same_baselines_and_mirror_each_other(options: DesignOptions) -> None:
    handpiece = twelve_cameras(options)
    for group in "bl":
        across, along = baseline(handpiece, f"{group}1", f"{group}2"), baseline(handpiece, f"{group}3", f"{group}4")
        assert np.linalg.norm(across) == pytest.approx(options.baseline_across_mm)
        np.testing.assert_allclose(np.abs(along), [options.baseline_along_mm, 0, 0], atol=1e-12)
        assert across[2] < 0, "camera 1 is the one farther from the gum"
    for camera in ("1", "2"):
        mirrored = handpiece.rig[f"l{camera}"].centre_in_rig * [1, -1, 1]
        np.testing.assert_allclose(handpiece.rig[f"b{camera}"].centre_in_rig, mirrored, atol=1e-12)


@given(OPTIONS)
def test_axes_of_a_group_are_parallel_and_images_upright(options: DesignOptions) -> None:
    handpiece = twelve_cameras(options)
    for group in "obl":
        rotations = [handpiece.rig[f"{group}{k}"].cam_from_rig.rotation for k in range(1, 5)]
        assert np.ptp(rotations, axis=0).max() < 1e-12
    for side, sign in (("b", -1), ("l", 1)):
        right, down, axis = handpiece.rig[f"{side}1"].cam_from_rig.rotation
        np.testing.assert_allclose(right, [sign, 0, 0], atol=1e-12)
        assert down[2] < 0
        assert np.rad2deg(np.arccos(-axis[2])) == pytest.approx(options.side_tilt_deg)
        assert np.sign(axis[1]) == sign


def test_defaults_are_those_of_the_thesis() -> None:
    handpiece = twelve_cameras()
    assert len(handpiece.rig.names) == 12
    assert len(essential_four().rig.names) == 4
    for mounted in handpiece.rig.cameras.values():
        assert (mounted.camera.width, mounted.camera.height) == (500, 500)
        edge = mounted.camera.rays(np.array([[0.0, 250], [500, 250]]))
        assert np.rad2deg(2 * np.arctan(edge[1, 0])) == pytest.approx(62)
        assert edge[0, 0] == pytest.approx(-edge[1, 0])
    assert np.linalg.norm(baseline(handpiece, "o1", "o2")) == pytest.approx(2.5)
    assert np.linalg.norm(baseline(handpiece, "b3", "b4")) == pytest.approx(1.5)


def test_twelve_cameras_pair_within_their_three_groups_only() -> None:
    rig = twelve_cameras().rig
    assert [set(group) for group in camera_groups(rig, 5.0)] == [{f"{g}{k}" for k in range(1, 5)} for g in "obl"]
    assert len(stereo_pairs(rig, 5.0)) == 3 * 6


def test_side_groups_aim_at_the_crown_from_the_working_distance() -> None:
    options = DesignOptions(side_offset_mm=4.0, side_depth_mm=3.0)
    handpiece = twelve_cameras(options)
    for group, side in (("b", 1), ("l", -1)):
        middle = np.mean([handpiece.rig[f"{group}{k}"].centre_in_rig for k in range(1, 5)], axis=0)
        aim = middle + options.working_distance_mm * handpiece.rig[f"{group}1"].axis_in_rig
        np.testing.assert_allclose(aim, [0, side * 4.0, -3.0], atol=1e-12)


def test_lights_lie_between_the_cameras_of_their_group_and_are_on_in_the_one_lighting_pattern() -> None:
    handpiece = twelve_cameras()
    assert [lighting.name for lighting in handpiece.lightings] == ["all"]
    assert set(handpiece.lightings[0].lights) == set(handpiece.lights)
    for name, light in handpiece.lights.items():
        camera = handpiece.rig[f"{name[0]}1"]
        np.testing.assert_allclose(light.direction, camera.axis_in_rig, atol=1e-12)
        assert (light.position_mm - camera.centre_in_rig) @ camera.axis_in_rig == pytest.approx(0, abs=1e-12)
        gaps = [np.linalg.norm(light.position_mm - each.centre_in_rig) for each in handpiece.rig.cameras.values()]
        assert 0.5 < min(gaps) < 2


@pytest.mark.parametrize("name", DESIGNS)
def test_every_named_design_can_be_built(name: str) -> None:
    handpiece = DESIGNS[name](DesignOptions(width_px=320, height_px=240))
    assert {(each.camera.width, each.camera.height) for each in handpiece.rig.cameras.values()} == {(320, 240)}


@pytest.mark.parametrize(
    "wrong",
    [
        {"working_distance_mm": 0.0},
        {"width_px": 0},
        {"baseline_across_mm": 0.0},
        {"field_of_view_deg": 180.0},
        {"outer_distance_mm": 0.0},
        {"outer_tilt_deg": 90.0},
    ],
)
def test_impossible_designs_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="design"):
        DesignOptions(**wrong)


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("size_px", [(320, 240), (500, 500), (640, 480), (1280, 960)])
@pytest.mark.parametrize("distance_mm", [5.0, 8.0, 12.0, 20.0])
def test_every_camera_of_a_design_has_a_partner(name: str, size_px: tuple[int, int], distance_mm: float) -> None:
    width_px, height_px = size_px
    made = DESIGNS[name](DesignOptions(width_px=width_px, height_px=height_px, working_distance_mm=distance_mm))
    assert all(len(group) > 1 for group in camera_groups(made.rig, made.working_distance_mm))
    near, far = made.depth_range_mm
    assert (near, far) == pytest.approx((distance_mm / 2, 1.8 * distance_mm))


def test_the_depth_range_of_the_thesis_is_kept() -> None:
    assert twelve_cameras().depth_range_mm == (2.5, 9.0)


@given(OPTIONS)
def test_a_pair_is_half_of_the_four(options: DesignOptions) -> None:
    four, two = essential_four(options), stereo_pair(options)
    assert two.rig.names == ("o1", "o2")
    for name, mounted in two.rig.cameras.items():
        np.testing.assert_array_equal(mounted.cam_from_rig.matrix, four.rig[name].cam_from_rig.matrix)
    assert two.lights.keys() == four.lights.keys()


@given(OPTIONS)
def test_six_are_the_four_and_one_more_on_either_side(options: DesignOptions) -> None:
    four, six = essential_four(options), six_cameras(options)
    assert six.rig.names == (*four.rig.names, "o5", "o6")
    for name, mounted in four.rig.cameras.items():
        np.testing.assert_array_equal(six.rig[name].cam_from_rig.matrix, mounted.cam_from_rig.matrix)
    for name, light in four.lights.items():
        np.testing.assert_array_equal(six.lights[name].position_mm, light.position_mm)
    np.testing.assert_allclose(baseline(six, "o1", "o5"), [0, 2.0, 0], atol=1e-12)
    np.testing.assert_allclose(baseline(six, "o2", "o6"), [0, -2.0, 0], atol=1e-12)
    np.testing.assert_allclose(six.rig["o5"].cam_from_rig.rotation, six.rig["o1"].cam_from_rig.rotation, atol=1e-12)


@pytest.mark.parametrize("name", DESIGNS)
def test_colour_coded_lights_ring_each_group_of_the_same_cameras(name: str) -> None:
    white, coded = (DESIGNS[name](DesignOptions(lights=lights)) for lights in ("white", "colour-coded"))
    assert coded.rig.names == white.rig.names
    for light_name, light in coded.lights.items():
        group = white.rig[f"{light_name[0]}1"], white.rig[f"{light_name[0]}2"]
        middle = np.mean([each.centre_in_rig for each in group], axis=0)
        assert np.linalg.norm(light.position_mm - middle) == pytest.approx(DesignOptions().ring_mm)
        np.testing.assert_allclose(light.direction, group[0].axis_in_rig, atol=1e-12)
        assert "rgb"[int(np.argmax(light.colour))] == light_name[1]
        assert 0 < light.glare < 0.1
        if light_name[0] in "bl":  # two stand at the height of the cusps, one nearer to the gum
            assert (light.position_mm[2] > middle[2]) == (light_name[1] != "g")
    assert len(coded.lights) == 3 * len({each[0] for each in coded.rig.names})
    assert set(coded.lightings[0].lights) == set(coded.lights)


@pytest.mark.parametrize("name", DESIGNS)
def test_lights_in_turn_are_two_triples_between_each_other_without_polarisers(name: str) -> None:
    coded, made = (DESIGNS[name](DesignOptions(lights=lights)) for lights in ("colour-coded", "in-turn"))
    first, second = (each.lights for each in made.lightings)
    assert set(first) == set(coded.lights)
    assert set(first) | set(second) == set(made.lights)
    assert len(first) == len(second) == len(made.lights) / 2
    ring = DesignOptions().ring_mm
    for light_name in first:
        one, other = made.lights[light_name], made.lights[f"{light_name}2"]
        np.testing.assert_array_equal(one.position_mm, coded.lights[light_name].position_mm)
        np.testing.assert_array_equal(one.colour, other.colour)
        assert np.linalg.norm(one.position_mm - other.position_mm) == pytest.approx(ring)  # a sixth of a turn
        assert one.glare == other.glare == 1.0
    apart = [
        np.linalg.norm(made.lights[one].position_mm - made.lights[other].position_mm)
        for one in first
        for other in second
        if one[0] == other[0]
    ]
    assert min(apart) == pytest.approx(ring)


@pytest.mark.parametrize("name", DESIGNS)
def test_designs_are_symmetric(name: str) -> None:
    handpiece = DESIGNS[name](DesignOptions(outer_tilt_deg=20.0))
    mirrored = np.array([1, -1, 1])
    centres = np.array([each.centre_in_rig for each in handpiece.rig.cameras.values()])
    axes = np.array([each.axis_in_rig for each in handpiece.rig.cameras.values()])
    lights = np.array([light.position_mm for light in handpiece.lights.values()])
    both = np.concatenate([centres, axes], axis=1)
    for places, mirror in ((both, np.tile(mirrored, 2)), (lights, mirrored)):
        gaps = np.linalg.norm(places[:, None] - places[None] * mirror, axis=2).min(axis=1)
        assert gaps.max() < 1e-12


def test_outer_cameras_lean_inwards_by_the_tilt() -> None:
    six = six_cameras(DesignOptions(outer_tilt_deg=20.0))
    for name, side in (("o5", 1), ("o6", -1)):
        axis = six.rig[name].axis_in_rig
        np.testing.assert_allclose(axis, [0, -side * np.sin(np.deg2rad(20)), -np.cos(np.deg2rad(20))], atol=1e-12)
        np.testing.assert_allclose(six.rig[name].cam_from_rig.rotation[0], [1, 0, 0], atol=1e-12)


def test_six_cameras_are_one_group_for_stereo() -> None:
    assert len(camera_groups(six_cameras().rig, 5.0)) == 1
