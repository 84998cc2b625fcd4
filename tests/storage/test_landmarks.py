import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.anatomy.landmarks.scheme import in_frame, labels_of, missing, teeth_named, validate
from cuspid.model.jaw import UNIVERSAL_FROM_FDI, Landmark
from cuspid.runtime.errors import InputError
from cuspid.storage import LandmarkFile, read_landmarks, write_landmarks, write_table
from strategies import rigid3s

LOWER = (*range(31, 38), *range(41, 48))
LABELS = labels_of(LOWER)
numbers = st.floats(-200, 200, allow_nan=False, width=64)
points = st.builds(
    lambda xyz, sigma: Landmark(np.array(xyz), sigma),
    st.tuples(numbers, numbers, numbers),
    st.none() | st.floats(0, 5, allow_nan=False),
)
landmark_sets = st.dictionaries(st.sampled_from(LABELS), points, max_size=8)


def same(a: LandmarkFile | dict, b: dict) -> bool:
    found = a.landmarks if isinstance(a, LandmarkFile) else a
    return set(found) == set(b) and all(
        np.array_equal(found[label].position, b[label].position)
        and found[label].estimated_sigma_mm == b[label].estimated_sigma_mm
        for label in b
    )


@given(landmark_sets, st.sampled_from(["points.json", "points.mrk.json"]))
def test_what_is_written_is_read(tmp_path_factory, landmarks, name):
    path = tmp_path_factory.mktemp("landmarks") / name
    write_landmarks(path, landmarks, "mesh")
    found = read_landmarks(path)
    assert same(found, landmarks)
    assert (found.frame, found.notes) == ("mesh", ())


def test_the_frame_is_kept(tmp_path: Path):
    write_landmarks(tmp_path / "a.json", {}, "occlusal")
    assert read_landmarks(tmp_path / "a.json").frame == "occlusal"


@given(landmark_sets, st.randoms())
def test_order_means_nothing(tmp_path_factory, landmarks, random):
    path = tmp_path_factory.mktemp("landmarks") / "a.mrk.json"
    shuffled = list(landmarks.items())
    random.shuffle(shuffled)
    write_landmarks(path, dict(shuffled), "mesh")
    assert same(read_landmarks(path), landmarks)


def markups(*control_points: dict, **markup) -> dict:
    """As 3D Slicer saves a point list."""
    common = {
        "type": "Fiducial",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": False,
        "fixedNumberOfControlPoints": False,
        "labelFormat": "%N-%d",
        "lastUsedControlPointNumber": 3,
        "controlPoints": list(control_points),
        "display": {"visibility": True, "opacity": 1.0, "glyphType": "Sphere3D"},
    }
    schema = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/x.json#"
    return {"@schema": schema, "markups": [{**common, **markup}]}


def control_point(label: str, position: object, **more) -> dict:
    return {
        "id": "1",
        "label": label,
        "description": "",
        "associatedNodeID": "vtkMRMLModelNode1",
        "position": position,
        "orientation": [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0],
        "selected": True,
        "locked": False,
        "visibility": True,
        "positionStatus": "defined",
        **more,
    }


def read(tmp_path: Path, content: object) -> LandmarkFile:
    path = tmp_path / "jaw.mrk.json"
    path.write_text(json.dumps(content))
    return read_landmarks(path)


def test_ras_is_turned_to_the_axes_of_the_mesh_file(tmp_path: Path):
    found = read(tmp_path, markups(control_point("33.cusp_tip", [1.0, 2.0, 3.0]), coordinateSystem="RAS"))
    np.testing.assert_array_equal(found.landmarks["33.cusp_tip"].position, [-1.0, -2.0, 3.0])
    assert found.landmarks["33.cusp_tip"].estimated_sigma_mm is None


@pytest.mark.parametrize("units", ["um", ["um", "UCUM", "micrometer"]])
def test_micrometres_become_millimetres(tmp_path: Path, units):
    found = read(tmp_path, markups(control_point("papilla", [1000.0, 0.0, -500.0]), coordinateUnits=units))
    np.testing.assert_allclose(found.landmarks["papilla"].position, [1.0, 0.0, -0.5])


def test_points_without_a_place_are_passed_over_and_told_but_locked_ones_count(tmp_path: Path):
    content = markups(
        control_point("33.cusp_tip", [0.0, 0.0, 0.0], positionStatus="undefined"),
        control_point("43.cusp_tip", [1.0, 1.0, 1.0], positionStatus="preview"),
        control_point("papilla", [2.0, 2.0, 2.0], locked=True),
    )
    content["markups"].append({"type": "Curve", "controlPoints": []})
    found = read(tmp_path, content)
    assert set(found.landmarks) == {"papilla"}
    assert len(found.notes) == 3
    assert any("'33.cusp_tip'" in note and "undefined" in note for note in found.notes)
    assert any("Curve" in note for note in found.notes)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([control_point("33.cusp_tip", [1.0, 2.0])], "33.cusp_tip.*three finite numbers"),
        ([control_point("33.cusp_tip", [1.0, 2.0, float("nan")])], "position.*finite"),
        ([control_point("33.cusp_tip", [1.0, 2.0, "3"])], "33.cusp_tip.*three finite numbers"),
        ([control_point("33.cusp_tip", None)], "33.cusp_tip.*three finite numbers"),
        ([control_point("papilla", [0, 0, 0]), control_point("papilla", [0, 0, 1])], "'papilla' occurs more than once"),
        ([control_point("", [0, 0, 0])], "entry 1 of 'controlPoints' has no label"),
    ],
)
def test_a_bad_point_is_named_with_its_file(tmp_path: Path, points, message):
    with pytest.raises(InputError, match=rf"jaw\.mrk\.json: .*{message}"):
        read(tmp_path, markups(*points))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"markups": 3}, "'markups' must be a list"),
        (markups(coordinateSystem="IJK"), "'coordinateSystem' is 'IJK'"),
        (markups(coordinateUnits="inch"), "'coordinateUnits' is 'inch'"),
        ([1, 2], "not a landmark file"),
        ({"format": "cuspid landmarks", "frame": "world", "landmarks": []}, "'frame' is 'world'"),
        ({"format": "cuspid landmarks", "frame": "mesh"}, "'landmarks' must be a list"),
    ],
)
def test_a_file_of_another_kind_is_told(tmp_path: Path, content, message):
    with pytest.raises(InputError, match=message):
        read(tmp_path, content)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)


@given(json_values, st.sampled_from(["markups", "landmarks", "controlPoints", "position"]))
def test_any_other_content_is_an_input_error_or_fine(tmp_path_factory, value, place):
    contents = {
        "markups": {"markups": value},
        "landmarks": {"format": "cuspid landmarks", "frame": "mesh", "landmarks": value},
        "controlPoints": markups(controlPoints=value),
        "position": markups(control_point("papilla", value)),
    }
    with suppress(InputError):
        read(tmp_path_factory.mktemp("any"), contents[place])


def test_labels_are_checked_against_the_scheme():
    validate(LABELS, LOWER)
    with pytest.raises(
        InputError, match=r"my\.json: unknown landmark '46.bucal_groove'; did you mean 46.buccal_groove"
    ):
        validate(["46.bucal_groove"], source="my.json")
    with pytest.raises(InputError, match=r"unknown landmark 'F-1'; a label is <FDI>.<point>"):
        validate(["F-1"])
    with pytest.raises(InputError, match=r"'38.buccal_groove' belongs to no tooth of this jaw, which has 31, 32"):
        validate(["38.buccal_groove"], LOWER)


def test_the_scheme_has_72_labels_for_14_teeth_and_62_for_12():
    twelve = [fdi for fdi in LOWER if fdi % 10 < 7]
    assert (len(set(LABELS)), len(labels_of(twelve))) == (72, 62)
    assert set(missing(set(LABELS) - {"papilla", "31.mesial_angle"}, LOWER)) == {"papilla", "31.mesial_angle"}
    assert missing(LABELS, LOWER) == ()
    assert teeth_named(LABELS) == tuple(sorted(LOWER))
    assert len(labels_of(UNIVERSAL_FROM_FDI)) == 5 * 32 + 2


@given(landmark_sets, rigid3s())
def test_landmarks_go_to_another_frame_and_back(landmarks, b_from_a):
    back = in_frame(in_frame(landmarks, b_from_a), b_from_a.inverse())
    assert list(back) == list(landmarks)
    for label, point in landmarks.items():
        np.testing.assert_allclose(back[label].position, point.position, atol=1e-9)
        assert back[label].estimated_sigma_mm == point.estimated_sigma_mm


def test_a_table_is_csv_with_empty_cells(tmp_path: Path):
    rows = [{"jaw": "a, b", "a_mm": 26.81234, "c_mm": None}, {"jaw": "ü", "c_mm": 2.0}]
    write_table(tmp_path / "t.csv", rows, digits=3)
    assert (tmp_path / "t.csv").read_text() == 'jaw,a_mm,c_mm\n"a, b",26.812,\nü,,2.000\n'
    write_table(tmp_path / "t.csv", rows)
    assert (tmp_path / "t.csv").read_text() == 'jaw,a_mm,c_mm\n"a, b",26.81234,\nü,,2.0\n'
