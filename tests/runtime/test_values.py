"""Values from outside: what can be reckoned with passes unchanged, all else is one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid import cli, storage
from cuspid.handpiece.designs import twelve_cameras
from cuspid.model.capture import Frame
from cuspid.model.rig import Rig
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import checked_name, covariance, number, numbers, quote, whole

BAD_NAMES = [
    *("", ".", "..", "../../x", "/etc/x", "a//b", "a/", "a/../b", "C:x", "a\\b", " a", "a\n", "a\0", "a\x1b[2J"),
    "x" * 101,
]
GOOD_NAMES = ["o1", "o1+", "left eye", "Kamera-ä", "rig/left", "frame_00001.5", "x" * 100]


@pytest.mark.parametrize("bad", [*BAD_NAMES, None, 3, ["a"]])
def test_what_could_leave_the_folder_is_no_name(bad):
    with pytest.raises(InputError, match="cannot be used as a name") as caught:
        checked_name("rig.json: cameras", bad)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("good", GOOD_NAMES)
def test_a_name_stays_as_it_is(good, tmp_path):
    assert checked_name("camera", good) == good
    assert (tmp_path / good).resolve().is_relative_to(tmp_path)


@given(st.text(alphabet=st.sampled_from("ab./\\ \n\0:"), max_size=8))
def test_no_name_leads_out_of_a_folder(text):
    try:
        checked_name("camera", text)
    except InputError:
        return
    inside = (Path("/folder") / text).resolve()
    assert inside.is_relative_to("/folder")
    assert inside != Path("/folder")


@given(st.lists(st.floats(), min_size=3, max_size=3))
def test_numbers_pass_or_are_refused(values):
    try:
        found = numbers("focal_px", values, (3,), -10.0, 10.0)
    except InputError:
        assert not all(-10 <= each <= 10 for each in values)
        return
    assert found.tolist() == values


@pytest.mark.parametrize(
    "bad",
    [None, "1", [1, 2], [1, 2, None], [1, 2, "x"], [[1], [2, 3], 4], {"a": 1}, [1, 2, 10**400], True, [1, 2, True]],
    ids=str,
)
def test_what_is_not_so_many_numbers_is_refused(bad):
    with pytest.raises(InputError, match=r"^focal_px is .* must be 3 numbers"):
        numbers("focal_px", bad, (3,), -10.0, 10.0)


@pytest.mark.parametrize("bad", [None, "1", True, float("nan"), float("inf"), 11, -11, [1]])
def test_a_number_is_one(bad):
    with pytest.raises(InputError, match=r"^gamma is .*; it must"):
        number("gamma", bad, -10.0, 10.0)
    with pytest.raises(InputError, match=r"^gamma is .*; it must"):
        whole("gamma", bad, -10, 10)
    assert number("gamma", 3, -10.0, 10.0) == whole("gamma", 3.0, -10, 10) == 3
    with pytest.raises(InputError, match="whole number"):
        whole("gamma", 2.5, -10, 10)


@given(st.integers(0, 2**32 - 1), st.floats(1e-9, 1e9))
def test_a_covariance_is_one_at_any_scale(seed, scale):
    factor = np.random.default_rng(seed).normal(size=(4, 3))
    matrix = scale * factor @ factor.T
    np.testing.assert_array_equal(covariance("covariance", matrix.tolist(), 4), matrix)
    np.testing.assert_array_equal(covariance("covariance", np.zeros((4, 4)).tolist(), 4), 0)
    crooked, negative = matrix.copy(), matrix - 0.1 * np.trace(matrix) * np.eye(4)
    crooked[0, 1] += 0.1 * scale * (1 + abs(matrix).max() / scale)
    for wrong in (crooked, negative, np.full((4, 4), np.nan), np.full((4, 4), -1e308), np.eye(3)):
        with pytest.raises(InputError, match=r"^covariance"), np.errstate(over="raise"):
            covariance("covariance", wrong.tolist(), 4)


def test_long_values_are_cut_short():
    assert len(quote("x" * 10_000)) == 40
    assert "\n" not in quote(np.eye(30))


# --- a handpiece from outside -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", BAD_NAMES)
def test_cameras_and_frames_have_names(bad):
    mounted = next(iter(twelve_cameras().rig.cameras.values()))
    with pytest.raises(InputError, match="cannot be used as a name"):
        Rig({bad: mounted})
    with pytest.raises(InputError, match="cannot be used as a name"):
        Frame(name=bad, cameras=())


def changed(place: tuple[str, ...], value: object) -> dict:
    """A handpiece.json with something else in one place."""
    whole_file = json.loads(json.dumps(storage.files.to_plain(storage.handpieces.handpiece_to_json(twelve_cameras()))))
    inner = whole_file
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    return whole_file


NAN, INF = float("nan"), float("inf")
NONSENSE = [
    (("cameras", "o1", "focal_px"), [INF, 400]),
    (("cameras", "o1", "focal_px"), [0, 400]),
    (("cameras", "o1", "focal_px"), [400]),
    (("cameras", "o1", "principal_point_px"), [None, 250]),
    (("cameras", "o1", "principal_point_px"), [1e9, 250]),
    (("cameras", "o1", "distortion_k1_k2_p1_p2"), [NAN, 0, 0, 0]),
    (("cameras", "o1", "distortion_k1_k2_p1_p2"), [1e9, 0, 0, 0]),
    (("cameras", "o1", "width_px"), 10**12),
    (("cameras", "o1", "width_px"), 0),
    (("cameras", "o1", "width_px"), "500"),
    (("cameras", "o1", "covariance_fx_fy_cx_cy_k1_k2_p1_p2"), [[1.0]]),
    (("cameras", "o1", "cam_from_rig", "translation_mm"), [1e30, 0, 0]),
    (("cameras", "o1", "cam_from_rig", "translation_mm"), [NAN, 0, 0]),
    (("cameras", "o1", "cam_from_rig", "rotation_wxyz"), [0, 0, 0, 0]),
    (("cameras", "o1", "cam_from_rig", "rotation_wxyz"), [1e-300, 0, 0, 0]),
    (("cameras", "o1", "cam_from_rig", "rotation_wxyz"), [1, 0, 0]),
    (("cameras", "o1", "covariance_rotation_rad_translation_mm"), (-np.eye(6)).tolist()),
    (("lights", "o1", "direction"), [0, 0, 0]),
    (("lights", "o1", "direction"), [0, 0, 1e-300]),
    (("lights", "o1", "position_mm"), [0, INF, 0]),
    (("lights", "o1", "power"), NAN),
    (("lights", "o1", "watts"), 3),
    (("sensor", "gamma"), 0),
    (("sensor", "noise_dn"), NAN),
    (("working_distance_mm",), INF),
    (("name",), "x" * 101),
    (("name",), "a\nb"),
    (("name",), None),
    (("depth_range_mm",), [2.5, NAN]),
    (("cameras", "../../x"), {}),
]


@pytest.mark.parametrize(("place", "value"), NONSENSE, ids=lambda each: str(each)[:40])
def test_nonsense_in_a_handpiece_is_one_line_that_names_file_and_field(place, value, tmp_path, capsys):
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(changed(place, value)))
    with pytest.raises(InputError) as caught:
        storage.read_handpiece(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    assert place[-1] in said
    assert "\n" not in said
    assert len(said) < 300
    with pytest.raises(SystemExit) as ended:
        cli.main(["simulate", "--handpiece", str(path), "--out", str(tmp_path / "inner" / "out")])
    assert ended.value.code == 1
    assert capsys.readouterr().err.count("\n") < 6
    assert [each for each in tmp_path.rglob("*") if each.is_file()] == [path]
    assert not (tmp_path / "inner" / "out").exists()


def test_a_handpiece_comes_back_as_it_was(tmp_path):
    path = tmp_path / "rig.json"
    storage.write_handpiece(path, twelve_cameras())
    again = storage.read_handpiece(path)
    for camera, mounted in twelve_cameras().rig.cameras.items():
        np.testing.assert_array_equal(again.rig[camera].camera.parameters, mounted.camera.parameters)
        np.testing.assert_allclose(again.rig[camera].cam_from_rig.matrix, mounted.cam_from_rig.matrix, atol=1e-15)


RIG = {"image_prefix": "b/", "camera_model_name": "PINHOLE", "camera_params": [400, 400, 250, 250]}
"""A camera of COLMAP's rig_config.json without its place."""


def rig_config(tmp_path, **place):
    path = tmp_path / "rig_config.json"
    path.write_text(json.dumps([{"cameras": [{**RIG, "image_prefix": "a/", "ref_sensor": True}, {**RIG, **place}]}]))
    return storage.read_rig_config(path)


@pytest.mark.parametrize("missing", ["cam_from_rig_rotation", "cam_from_rig_translation"])
def test_a_camera_of_a_rig_has_a_whole_place(tmp_path, missing):
    place = {"cam_from_rig_rotation": [1, 0, 0, 0], "cam_from_rig_translation": [-2, 0, 0]}
    assert rig_config(tmp_path, **place)["b"].centre_in_rig.tolist() == [2, 0, 0]
    with pytest.raises(InputError, match=f"the field '{missing}' is missing"):
        rig_config(tmp_path, **{key: value for key, value in place.items() if key != missing})


def test_the_reference_sensor_is_the_rig(tmp_path):
    place = {"ref_sensor": True, "cam_from_rig_rotation": [1, 0, 0, 0], "cam_from_rig_translation": [-2, 0, 0]}
    assert rig_config(tmp_path, **place)["b"].centre_in_rig.tolist() == [0, 0, 0]


def test_a_word_longer_than_any_name_is_cut_in_a_message():
    path = "/".join(["a" * 255] * 4)
    assert str(InputError(f"{path}: no camera '{'x' * 400}'; give another")) == (
        f"{path}: no camera '{'x' * 40}...'; give another"
    )


def test_control_characters_are_written_out_in_a_message():
    assert str(InputError("landmark 'a\0b\n\x1b[31m' is not 'ö'")) == r"landmark 'a\x00b\n\x1b[31m' is not 'ö'"
