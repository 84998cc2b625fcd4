"""What pages hold: numbers that survive packing, honest simplification, what is missing, and nothing from outside."""

import base64
import gzip
import json
import re
import shutil
import socket
import sys
from contextlib import nullcontext
from dataclasses import replace
from importlib.metadata import version
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import trimesh
from hypothesis import example, given
from hypothesis import strategies as st

from cuspid import cli, storage
from cuspid.model.mesh import Mesh
from cuspid.model.panorama import FrameUse, Panorama
from cuspid.model.rig import Rig
from cuspid.report import live_view
from cuspid.report.figures.drawing import (
    NOT_COUNTED,
    RANGES_UM,
    FigureOptions,
    deviation_colors,
    fitting_range_um,
    fitting_sigma_um,
)
from cuspid.report.pages.color_scale import deviation_scale, sigma_scale
from cuspid.report.pages.page import LARGEST_PAGE_BYTES, flat_settings, number, pack_array, script_json, signed_number
from cuspid.report.pages.report import report_page
from cuspid.report.pages.scan import ReportOptions, histogram, worst_places
from cuspid.report.pages.scene import camera_lines
from cuspid.report.pages.shown_mesh import UM_PER_STEP, UNKNOWN, pack_mesh, pack_um, simplify
from cuspid.report.pages.study import heading
from cuspid.runtime.errors import InputError, MissingDependencyError
from report_folders import (
    BUMP_UM,
    FRAMES,
    TOOTH,
    looking_down,
    scanned_tooth,
    tooth_alone,
    write_calibrated,
    write_comparison,
    write_evaluation,
    write_scan,
    write_score,
    write_shape,
)
from verbs import refused


def unpacked(value: dict[str, str]) -> np.ndarray:
    """What the viewer makes of it."""
    kinds = {"Float32Array": "<f4", "Uint32Array": "<u4", "Uint16Array": "<u2", "Int16Array": "<i2", "Uint8Array": "u1"}
    return np.frombuffer(gzip.decompress(base64.b64decode(value["data"])), kinds[value["type"]])


def scene_of(page: str) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="scene">(.*?)</script>', page, re.DOTALL)[1])


@pytest.fixture
def scan_folder(tmp_path, coarse_phantom):
    write_scan(tmp_path / "scan", coarse_phantom)
    return tmp_path / "scan"


# --- packing ----------------------------------------------------------------------------------------------------------


@given(st.lists(st.floats(-3000, 3000), min_size=1))
def test_deviations_survive_to_half_a_step(values):
    given_um = np.array([*values, np.nan])
    found = unpacked(pack_um(given_um))
    assert found[-1] == UNKNOWN
    assert np.abs(UM_PER_STEP * found[:-1] - given_um[:-1]).max() <= 0.5001 * UM_PER_STEP


def test_what_is_off_the_scale_is_clipped_and_not_taken_for_unknown():
    assert list(unpacked(pack_um(np.array([-1e6, 1e6])))) == [UNKNOWN + 1, 32767]


def test_a_jaw_survives_to_a_micrometre(coarse_phantom):
    mesh = coarse_phantom.mesh
    layer = pack_mesh(mesh)
    vertices = layer["origin"] + layer["step"] * unpacked(layer["vertices"]).reshape(-1, 3)
    assert 0 < np.abs(vertices - mesh.vertices).max() < 1e-3
    assert np.array_equal(unpacked(layer["faces"]).reshape(-1, 3), mesh.faces)


def test_text_cannot_end_the_script_that_holds_it():
    text = str(script_json({"name": "</script><b>\u2028"}))
    assert "<" not in text
    assert json.loads(text) == {"name": "</script><b>\u2028"}


@given(st.floats(-1e7, 1e7))
def test_numbers_read_back(value):
    for written in (number(value, 2), signed_number(value, 2)):
        assert float(written.replace("\u202f", "").replace("−", "-")) == pytest.approx(value, abs=0.0051)
    assert signed_number(value, 2)[0] in "+−"
    assert not re.fullmatch(r"−0\.0+", number(value, 2))


def test_settings_are_flat():
    assert flat_settings({"a": {"b": 1, "c": None}, "d": "x"}) == [("a.b", "1"), ("a.c", "–"), ("d", "x")]


# --- simplification ---------------------------------------------------------------------------------------------------


def test_a_simplified_surface_is_near_and_carries_its_values(coarse_phantom):
    mesh = coarse_phantom.mesh
    shown = simplify(mesh, 8000)
    assert 7000 < len(shown.mesh.faces) <= 8000
    assert shown.full_faces == len(mesh.faces)
    distances, _, _ = shown.mesh.closest(mesh.vertices)
    assert shown.off_um == pytest.approx(1000 * np.percentile(distances, 95), rel=0.05)
    assert 0 < shown.off_um < 60
    height = shown.at_vertices(mesh.vertices[:, 2])
    assert np.abs(height - shown.mesh.vertices[:, 2]).max() < 1.0


def test_a_small_surface_is_left_as_it_is(coarse_phantom):
    shown = simplify(coarse_phantom.mesh, len(coarse_phantom.mesh.faces))
    assert shown.mesh is coarse_phantom.mesh
    assert shown.off_um == 0


# --- what is measured on the surface ----------------------------------------------------------------------------------


def test_the_worst_place_is_the_bump(coarse_phantom):
    scan, deviation_um, top = scanned_tooth(coarse_phantom)
    found = worst_places(scan, deviation_um, coarse_phantom, 5)
    places = list(found)
    assert places[0].name == str(TOOTH)
    assert np.linalg.norm(np.array(places[0].position_mm) - scan.vertices[top]) < 0.1
    assert BUMP_UM - 3 < found[places[0]] < BUMP_UM + 3
    apart = np.linalg.norm(np.diff([place.position_mm for place in places], axis=0), axis=1)
    assert apart.min() >= 1.0
    assert np.all(np.diff(np.abs(list(found.values()))) <= 0)


def test_the_worst_of_few_are_few():
    mesh = Mesh(np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]), np.array([[0, 1, 2]]))
    assert len(worst_places(mesh, np.array([1.0, np.nan, 2.0]), None, 8)) == 1
    assert worst_places(mesh, np.full(3, np.nan), None, 8) == {}


@given(range_um=st.sampled_from(RANGES_UM))
def test_the_histogram_is_by_area(range_um):
    """Two triangles, one of nine times the area of the other."""
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [10, 0, 0], [11, 0, 0], [10, 1, 0]], dtype=float)
    mesh = Mesh(vertices, np.array([[0, 1, 2], [3, 4, 5]]))
    found = histogram(mesh, np.array([2.0, 2, 2, 1e4, 1e4, 1e4]), range_um)
    assert found["above_pct"] == pytest.approx(10)
    assert found["below_pct"] == 0
    assert sum(bar["height"] > 0 for bar in found["bars"]) == 1


@given(st.floats(0.01, 300))
def test_the_range_holds_the_95th_percentile_and_is_not_wasteful(p95_um):
    found = fitting_range_um(p95_um)
    assert found in RANGES_UM
    assert found >= 2.5 * p95_um
    assert found == RANGES_UM[0] or found < 2.5 * 2.5 * p95_um + 1e-9


def test_cameras_point_at_what_they_see(scan_folder, coarse_phantom):
    rig = storage.read_reconstruction(scan_folder / "motion").rig
    lines = camera_lines(rig, {"0": looking_down(coarse_phantom, 0.0)}).reshape(2, 8, 2, 3)
    eyes, ends = lines[:, 0, 0], lines[:, :4, 1]
    assert np.linalg.norm(eyes[0] - eyes[1]) == pytest.approx(2.0)
    assert np.all(ends[..., 2] < eyes[:, None, 2]), "they look down"


# --- pages ------------------------------------------------------------------------------------------------------------


def test_the_page_of_a_scan(scan_folder):
    page = report_page(storage.read_result(scan_folder))
    assert len(page) < LARGEST_PAGE_BYTES
    assert f"Scan of tooth {TOOTH}" in page
    assert "Not in this report" not in page
    assert "&lt;script&gt;notes are text" in page
    assert "frame 00002: too few points" in page
    assert page.count("<td>91.5</td>") == 2
    assert "what is evaluated of the open crown" in page
    assert '<th scope="row">everything</th>' in page
    for known in ("reconstruct: images", "b" * 64, "evaluation.samples", "simulate: simulation.seed"):
        assert known in page
    scene = scene_of(page)
    assert [layer["name"] for layer in scene["layers"]] == ["scan", "reference", "cameras", "path"]
    assert scene["layers"][2]["frames"] == list(FRAMES[:2])
    assert [place["name"] for place in scene["teeth"]] == [str(TOOTH)]


def test_nothing_comes_from_outside(scan_folder):
    """No address but those of data; what three.js names for itself is not fetched (the tests in Chromium tell)."""
    page = report_page(storage.read_result(scan_folder))
    without_scripts = re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"https?://", without_scripts)
    assert all(address.startswith("data:") for address in re.findall(r'(?:src|href)="([^"]*)"', without_scripts))
    assert "default-src 'none'" in page


def test_the_shown_surface_lies_on_the_reference(scan_folder, coarse_phantom):
    """The frame of the page is that of the reference, whatever that of the scan."""
    layer = scene_of(report_page(storage.read_result(scan_folder)))["layers"][0]
    shown = layer["origin"] + layer["step"] * unpacked(layer["vertices"]).reshape(-1, 3)
    distances, _, _ = coarse_phantom.mesh.closest(shown)
    assert 0.05 < distances.max() < 0.2, "the bump, and no more"
    assert np.abs(UM_PER_STEP * unpacked(layer["values"]["deviation"])).max() == pytest.approx(BUMP_UM, abs=3)


def test_a_scan_is_coloured_by_its_deviation_or_by_what_was_expected(scan_folder, coarse_phantom):
    page = report_page(storage.read_result(scan_folder))
    scene = scene_of(page)
    layer, scales = scene["layers"][0], {each["name"]: each for each in scene["scales"]}
    assert list(scales) == list(layer["values"]) == ["deviation", "sigma"]
    shown = UM_PER_STEP * unpacked(layer["values"]["sigma"])
    known = unpacked(layer["values"]["sigma"]) != UNKNOWN
    assert 0.01 < np.mean(~known) < 0.03, "those that are NaN"
    assert (shown[known].min(), shown[known].max()) == pytest.approx((1.0, 4.0), abs=0.06)
    across = layer["step"] * unpacked(layer["vertices"]).reshape(-1, 3)[known, 0]
    assert np.corrcoef(across, shown[known])[0, 1] > 0.999, "each vertex has its own"
    assert (scales["sigma"]["end"], scales["sigma"]["signed"]) == (5.0, False)
    assert scales["deviation"]["signed"]
    assert "Expected error along the normal" in page


def test_where_nothing_was_expected_no_colours_are_offered_for_it(scan_folder):
    file = storage.read_mesh_file(scan_folder / "deviation.ply")
    deviations = {"deviation_um": file.vertex_values["deviation_um"]}
    storage.write_mesh(scan_folder / "deviation.ply", file.mesh, values=deviations)
    result = storage.read_result(scan_folder)
    assert result.sigma_um is None
    page = report_page(result)
    assert [each["name"] for each in scene_of(page)["scales"]] == ["deviation"]
    assert "Expected error" not in page


def test_what_no_standard_deviation_can_be_is_not_known(scan_folder):
    file = storage.read_mesh_file(scan_folder / "deviation.ply")
    sigma_um = np.full(len(file.mesh.vertices), 2.0)
    sigma_um[:3] = (-1.0, np.inf, np.nan)
    storage.write_mesh(scan_folder / "deviation.ply", file.mesh, values={storage.SIGMA: sigma_um})
    found = storage.read_result(scan_folder).sigma_um
    assert np.isnan(found[:3]).all()
    assert (found[3:] == 2.0).all()


def test_a_scan_without_a_scale_is_shown_in_its_own_unit(scan_folder):
    result = replace(storage.read_result(scan_folder), trueness=None, deviation_um=None, reference=None)
    assert result.reconstruction is not None
    without = replace(result, reconstruction=replace(result.reconstruction, has_scale=False))
    assert "thousandths of its unit" not in report_page(result)
    page = report_page(without)
    assert "Expected error along the normal in thousandths of its unit" in page
    assert "µm" not in re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


@example([0.0, 501.0], 0)
@example([0.0] * 19 + [501.0], 0)
@given(st.lists(st.floats(0, 1e4), min_size=1), st.integers(0, 5))
def test_the_scale_of_what_is_expected_holds_most_of_it(values, unknown):
    given_um = np.array([*values, *[np.nan] * unknown])
    end = fitting_sigma_um(given_um)
    assert end in RANGES_UM
    assert end == RANGES_UM[-1] or np.mean(np.array(values) <= end) >= 0.95
    smaller = [each for each in RANGES_UM if each < end]
    assert not smaller or np.mean(np.array(values) <= smaller[-1]) < 0.95
    assert fitting_sigma_um(np.full(3, np.nan)) == RANGES_UM[0]


@pytest.mark.parametrize("scale", [deviation_scale(50.0), sigma_scale(np.array([40.0]))], ids=lambda each: each.name)
def test_colours_go_from_one_end_of_the_bar_to_the_other(scale):
    bar = unpacked(scale.in_scene["colors"]).reshape(-1, 3)
    low = -scale.end if scale.signed else 0.0
    asked = np.array([low, scale.end, low - 1e3, 1e3, np.nan])
    found = scale.rgb(asked)
    assert np.array_equal(found[:4], bar[[0, -1, 0, -1]])
    assert np.array_equal(found[4], NOT_COUNTED)
    assert not (bar == NOT_COUNTED).all(axis=1).any(), "grey is none of its colours"
    assert np.array_equal(scale.rgb(2 * asked[:2], 2 * scale.end), found[:2])


def test_deviations_have_the_colours_of_their_picture():
    given_um = np.linspace(-70, 70, 200)
    pictured = deviation_colors(given_um, FigureOptions(range_um=50.0, tolerance_um=12.5))
    assert np.array_equal(deviation_scale(50.0).rgb(given_um), pictured)


def test_a_large_surface_is_simplified_and_the_page_says_so(scan_folder):
    page = report_page(storage.read_result(scan_folder), ReportOptions(max_faces=500, max_reference_faces=2000))
    full = len(storage.read_mesh(scan_folder / "deviation.ply").faces)
    assert f"of its {full:,}".replace(",", "\u202f") + " faces" in page
    layers = scene_of(page)["layers"]
    assert 400 < len(unpacked(layers[0]["faces"])) / 3 <= 500
    assert 1900 < len(unpacked(layers[1]["faces"])) / 3 <= 2000


def test_what_a_folder_lacks_is_said(scan_folder):
    shutil.rmtree(scan_folder / "motion")
    shutil.rmtree(scan_folder / "truth")
    shutil.rmtree(scan_folder / "capture")
    page = report_page(storage.read_result(scan_folder))
    for missing in ("the reference", "the camera poses", "the images"):
        assert f"<li>{missing}" in page
    (scan_folder / "trueness.json").unlink()
    page = report_page(storage.read_result(scan_folder))
    assert "run cuspid evaluate" in page
    assert "not evaluated" in page
    assert list(scene_of(page)["layers"][0]["values"]) == ["sigma"], "expected, though not evaluated"


def test_a_note_of_the_reconstruction_stands_at_the_top(scan_folder):
    result = storage.read_result(scan_folder)
    noted = replace(result, reconstruction=replace(result.reconstruction, notes=("motion: <parts> may be displaced",)))
    assert "Warnings" not in report_page(result)
    page = report_page(noted)
    assert "<li>motion: &lt;parts&gt; may be displaced</li>" in page
    assert page.index("Warnings") < page.index("Trueness")


def test_a_scan_before_its_evaluation_is_seen_from_where_its_cameras_were(scan_folder):
    shutil.move(scan_folder / "deviation.ply", scan_folder / "mesh.ply")
    (scan_folder / "trueness.json").unlink()
    layer = scene_of(report_page(storage.read_result(scan_folder)))["layers"][0]
    vertices = layer["origin"] + layer["step"] * unpacked(layer["vertices"]).reshape(-1, 3)
    normals = Mesh(vertices, unpacked(layer["faces"]).reshape(-1, 3).astype(int)).vertex_normals
    assert normals[:, 2].mean() > 0.2


def test_an_evaluation_needs_the_reference_that_it_had(tmp_path, coarse_phantom, capsys):
    folder = tmp_path / "result"
    write_evaluation(folder, coarse_phantom)
    storage.write_mesh(tmp_path / "reference.stl", coarse_phantom.mesh)
    assert "not the reference" in refused(capsys, "report", folder, "--reference", tmp_path / "reference.stl")
    run = storage.read_json(folder / "run.json")
    run["evaluate"]["inputs_sha256"]["reference"] = storage.hash_file(tmp_path / "reference.stl")
    storage.write_json(folder / "run.json", run)
    cli.main(["report", str(folder), "--reference", str(tmp_path / "reference.stl"), "--out", str(tmp_path / "x.html")])
    assert "reference" in [layer["name"] for layer in scene_of((tmp_path / "x.html").read_text())["layers"]]


def test_a_folder_with_nothing_to_report(tmp_path, capsys, scan_folder):
    assert "no such folder" in refused(capsys, "report", tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    assert "nothing to report" in refused(capsys, "report", tmp_path / "empty")
    storage.claim_folder(tmp_path / "images", "simulate", {}, {})
    assert "it holds only simulate" in refused(capsys, "report", tmp_path / "images")
    storage.claim_folder(tmp_path / "killed", "reconstruct", {}, {})
    assert "run the same command again to continue" in refused(capsys, "report", tmp_path / "killed")
    (scan_folder / "trueness.json").write_text("{")
    assert "not valid JSON" in refused(capsys, "report", scan_folder)
    for broken in ("[]", '{"reconstruct": 3}'):
        (tmp_path / "killed" / "run.json").write_text(broken)
        assert "run.json: not written by cuspid" in refused(capsys, "report", tmp_path / "killed")
    assert "--max-faces" in refused(capsys, "report", scan_folder, "--max-faces", 3)
    assert not list(tmp_path.glob("**/report.html"))


def test_an_alignment_that_puts_all_vertices_in_one_place_is_refused(capsys, scan_folder):
    known = storage.read_json(scan_folder / "trueness.json")
    known["reference_from_scan"][1][3] = 1e30
    (scan_folder / "trueness.json").write_text(json.dumps(known))
    assert "trueness.json: reference_from_scan is [[" in refused(capsys, "report", scan_folder)


def test_the_page_of_a_shape_model(tmp_path, coarse_phantom):
    write_shape(tmp_path / "shape", tooth_alone(coarse_phantom))
    scene = scene_of(report_page(storage.read_result(tmp_path / "shape")))
    [mode] = scene["modes"]
    field = mode["step"] * unpacked(mode["field"]).reshape(-1, 3)
    assert np.sqrt(np.mean(np.sum(field**2, axis=1))) == pytest.approx(1.5, rel=1e-3), "one SD of 1.5 mm"


def test_the_pages_of_a_panorama_and_its_score(tmp_path):
    image = np.zeros((30, 40, 3), dtype=np.uint8)
    image[5:20, 5:30] = 200
    covered = image.any(axis=2)
    frames = (FrameUse(name="00000", used=True, inliers=50), FrameUse(name="00001", used=False, reason="too blurred"))
    panorama = Panorama(
        image=image,
        covered=covered,
        frame_index=np.where(covered, 0, -1).astype(np.int16),
        frame_pixel=np.full((30, 40, 2), np.nan, dtype=np.float32),
        frames=frames,
        method="ortho",
        origin_px=np.zeros(2),
        mm_per_px=0.05,
        notes=("the scale is a guess",),
    )
    storage.claim_folder(tmp_path / "pano", "stitch", {}, {})
    storage.write_panorama(tmp_path / "pano", panorama)
    page = report_page(storage.read_result(tmp_path / "pano"))
    for known in ("too blurred", "the scale is a guess", "1 of 2 frames", "2.0 × 1.5"):
        assert known in page
    write_score(tmp_path / "score")
    page = report_page(storage.read_result(tmp_path / "score"))
    assert page.count('class="zoomed"') == 2
    assert "seen from a height" not in page, "there is no such picture in this folder"
    (tmp_path / "score" / "made.png").unlink()
    assert "run cuspid pano evaluate again" in report_page(storage.read_result(tmp_path / "score"))


def test_the_page_of_a_calibration(tmp_path):
    write_calibrated(tmp_path)
    page = report_page(storage.read_result(tmp_path))
    assert "<other>" not in page
    for said in ("+0.25 ± 0.10 (+12.5 ms)", "+0.312 ± 0.004 (+15.6 ms)"):
        assert said in page, said
    for said in ("&lt;other&gt;", "960", "gamma stays", "3.000", "1.020 ± 0.3 %", "0.08"):
        assert said in page, said
    assert page.count("<img") == 1
    drawn = storage.read_handpiece(tmp_path / "handpiece.json")
    bare = {name: replace(each, covariance=None) for name, each in drawn.rig.cameras.items()}
    storage.write_handpiece(tmp_path / "handpiece.json", replace(drawn, rig=Rig(bare)))
    assert page.count("<td>–</td>") + 4 == report_page(storage.read_result(tmp_path)).count("<td>–</td>")
    (tmp_path / "handpiece.json").unlink()
    assert "the cameras: run cuspid calibrate again" in report_page(storage.read_result(tmp_path))
    assert "nothing to view in 3-D" in refused_view(tmp_path)


def refused_view(folder):
    with pytest.raises(InputError) as raised:
        live_view.serve(storage.read_result(folder), "127.0.0.1", 18082)
    return str(raised.value)


def test_a_study_that_was_killed_shows_what_is_done(tmp_path):
    storage.claim_folder(tmp_path, "sweep", {"options": {"surface": "occlusal"}}, {})
    with pytest.raises(InputError, match="no case of the study is done"):
        report_page(storage.read_result(tmp_path))
    for number_of_case, failure in enumerate([None, "too dark"]):
        entry = {"parameters": {"baseline_mm": 1.0 + number_of_case}, "figures": {"points": 5}, "failure": failure}
        storage.write_json(tmp_path / "cases" / f"case-{number_of_case}.json", entry)
    page = report_page(storage.read_result(tmp_path))
    assert "sweep.json: 2 cases are done" in page
    assert "too dark" in page
    assert "baseline, mm" in page


def test_the_page_of_a_comparison_tells_counts_as_counts(tmp_path):
    write_comparison(tmp_path)
    page = report_page(storage.read_result(tmp_path))
    for cell in ("<td>12</td>", "<td>6</td>", "<td>11.60</td>", "<td>10.60</td>"):
        assert cell in page
    assert "12.00" not in page


def test_the_page_of_a_sweep(tmp_path):
    rows = [{"case": f"{k}", "baseline_mm": float(k), "points": 100 + k, "failure": None} for k in range(3)]
    storage.claim_folder(tmp_path, "sweep", {}, {})
    storage.write_table(tmp_path / "results.csv", rows)
    best = {"term": "points", "setting": [2.0, 3.0], "value": 102.0, "seeds": 1, "noise": None, "level": [[1.0, 3.0]]}
    thesis = {"setting": [2.5, 0.0], "points": 99.0}
    summary = {"surface": "occlusal", "tooth": 47, "direction": "across", "best": {"points": best}, "thesis": thesis}
    storage.write_json(tmp_path / "sweep.json", summary)
    page = report_page(storage.read_result(tmp_path))
    for known in ("most points", "2 mm, 3°", "1 mm, 3°", "2.5 mm, 0°", "3 cases"):
        assert known in page


@pytest.mark.parametrize(
    ("column", "label"),
    [
        ("baseline_mm", "baseline, mm"),
        ("complete_50_um_pct", "within 50 µm, %"),
        ("case", "case"),
        ("tooth_p95_um", "tooth P95, µm"),
    ],
)
def test_headings(column, label):
    assert heading(column) == label


# --- the files behind them --------------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1))
def test_values_of_vertices_are_read_as_they_were_written(tmp_path_factory, seed):
    rng = np.random.default_rng(seed)
    vertices, values = rng.normal(size=(20, 3)).astype(np.float32).astype(float), rng.normal(size=20)
    values[3] = np.nan
    path = tmp_path_factory.mktemp("mesh") / "mesh.ply"
    storage.write_mesh(path, Mesh(vertices, rng.permutation(20)[:18].reshape(6, 3)), values={"deviation_um": values})
    file = storage.read_mesh_file(path)
    order = [int(np.argmin(np.linalg.norm(vertices - vertex, axis=1))) for vertex in file.mesh.vertices]
    np.testing.assert_allclose(file.vertex_values["deviation_um"], values[order], rtol=1e-6)


def test_an_array_is_packed_with_its_type():
    assert pack_array(np.arange(3, dtype=np.uint16))["type"] == "Uint16Array"
    assert list(unpacked(pack_array(np.arange(3, dtype=np.uint16)))) == [0, 1, 2]


# --- the live view ----------------------------------------------------------------------------------------------------


def test_the_live_view_starts_and_stops(scan_folder):
    pytest.importorskip("viser", reason="viser is not installed: pip install 'cuspid[view]'")
    from urllib.request import urlopen

    server = live_view.serve(storage.read_result(scan_folder), "127.0.0.1", 18080)
    try:
        with urlopen(f"http://127.0.0.1:{server.get_port()}", timeout=20) as answer:
            assert answer.status == 200
    finally:
        server.stop()


class Recorded(SimpleNamespace):
    """What viser was asked to show, of which a reader can choose another value."""

    def on_update(self, react) -> None:
        self.react = react

    def choose(self, value: str) -> None:
        self.value = value
        self.react(None)


def colored_surface(result, monkeypatch) -> tuple[dict[str, Recorded], dict[str, trimesh.Trimesh]]:
    """Dropdowns of the live view by their label, its legend as ``legend``, and what is shown by name."""
    choices, shown, server = {}, {}, MagicMock()

    def add_dropdown(label, options, initial_value=None, visible=True):
        choices[label] = Recorded(value=initial_value or options[0], options=options, visible=visible)
        return choices[label]

    def add_html(content):
        choices["legend"] = Recorded(content=content, visible=True)
        return choices["legend"]

    def add_mesh(name, mesh, visible):
        shown[name] = mesh
        return Recorded(visible=visible)

    server.gui.add_dropdown, server.gui.add_html = add_dropdown, add_html
    server.scene.add_mesh_trimesh = add_mesh
    monkeypatch.setitem(sys.modules, "viser", SimpleNamespace(ViserServer=lambda **_: server))
    monkeypatch.setattr(live_view, "only_own_pages", lambda _: nullcontext())
    live_view.serve(result, "127.0.0.1", 18082)
    return choices, shown


def colors_of(mesh: trimesh.Trimesh) -> np.ndarray:
    return np.unique(mesh.visual.vertex_colors, axis=0)


def test_the_live_view_colours_by_what_is_chosen(scan_folder, monkeypatch):
    choices, shown = colored_surface(storage.read_result(scan_folder), monkeypatch)
    assert choices["Colours"].options == ["Deviation", "Expected", "None"]
    deviation, expected = choices["Range in µm, ±"], choices["Range in µm, 0 to"]
    assert (deviation.visible, expected.visible) == (True, False)
    assert "positive outside" in choices["legend"].content
    by_deviation = colors_of(shown["/scan"])
    choices["Colours"].choose("Expected")
    assert (deviation.visible, expected.visible, expected.value) == (False, True, "5")
    assert "standard deviation" in choices["legend"].content
    assert "<span>0</span><span>5</span>" in choices["legend"].content
    by_sigma = colors_of(shown["/scan"])
    assert len(by_sigma) > 20
    assert not np.array_equal(by_sigma, by_deviation)
    expected.choose("100")
    assert "<span>0</span><span>100</span>" in choices["legend"].content
    assert len(colors_of(shown["/scan"])) < len(by_sigma), "all of it near the lower end"
    choices["Colours"].choose("None")
    assert len(colors_of(shown["/scan"])) == 1
    assert not any(each.visible for each in (choices["legend"], deviation, expected))


def test_the_live_view_offers_what_the_folder_has(scan_folder, monkeypatch):
    result = storage.read_result(scan_folder)
    choices, _ = colored_surface(replace(result, deviation_um=None, trueness=None), monkeypatch)
    assert choices["Colours"].options == ["Expected", "None"]
    choices, shown = colored_surface(replace(result, deviation_um=None, sigma_um=None), monkeypatch)
    assert choices == {}
    assert len(colors_of(shown["/scan"])) == 1


def asked(port: int, **headers: str) -> str:
    """The first line of what the live view answers to a request for its WebSocket."""
    wanted = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "x" * 22 + "==",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Protocol": f"viser-v{version('viser')}",
        **headers,
    }
    lines = ["GET / HTTP/1.1", *(f"{name}: {value}" for name, value in wanted.items()), "", ""]
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall("\r\n".join(lines).encode())
        return connection.recv(100).split(b"\r\n")[0].decode()


def test_the_live_view_answers_its_own_pages_alone(scan_folder):
    """Another page in the same browser gets nothing, be it by its Origin or under a name of its own."""
    pytest.importorskip("viser", reason="viser is not installed: pip install 'cuspid[view]'")
    server = live_view.serve(storage.read_result(scan_folder), "127.0.0.1", 18090)
    port = server.get_port()
    try:
        for name in ("127.0.0.1", "localhost"):
            assert " 101 " in asked(port, Host=f"{name}:{port}", Origin=f"http://{name}:{port}")
        assert " 101 " in asked(port, Host=f"127.0.0.1:{port}")
        for host, origin in (
            (f"127.0.0.1:{port}", "http://evil.example"),
            (f"127.0.0.1:{port}", f"http://127.0.0.1:{port + 1}"),
            (f"127.0.0.1:{port}", "null"),
            (f"evil.example:{port}", f"http://evil.example:{port}"),
            ("", f"http://127.0.0.1:{port}"),
            (f"[::1:{port}", f"http://[::1:{port}"),
        ):
            assert " 403 " in asked(port, Host=host, Origin=origin)
    finally:
        server.stop()


def test_what_cannot_be_viewed(tmp_path, monkeypatch, capsys, scan_folder):
    write_score(tmp_path / "score")
    assert "nothing to view in 3-D" in refused(capsys, "view", tmp_path / "score")
    assert "--port" in refused(capsys, "view", scan_folder, "--port", 0)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingDependencyError, match=r"cuspid\[view\]"):
        live_view.serve(storage.read_result(scan_folder), "127.0.0.1", 18081)
