"""Studies of scanners: which files are compared, what comes back of known errors, what is left out and why."""

import shutil
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from cuspid import storage
from cuspid.evaluation.alignments import align_points
from cuspid.evaluation.deformation import bend, fit_deformation, straighten
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.places import best_motion, deviations_um, scatter
from cuspid.evaluation.registration import RegistrationOptions
from cuspid.evaluation.repeatability import PairOptions, compare_pair
from cuspid.evaluation.search import SearchOptions
from cuspid.geometry import Rigid3
from cuspid.model.arch_curve import ArchCurve
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.studies.scanners.files import find_files, without_repeats
from cuspid.studies.scanners.scan import StudyOptions
from cuspid.studies.scanners.soundness import count_cuts, cut_notes, mend_faces
from cuspid.studies.scanners.specimen import _segments, guess_unit, load_specimen
from cuspid.studies.scanners.study import Intake, compare, measure_share, plan_comparison, prepare
from cuspid.studies.scanners.summary import Group, difference_um, group_row, region_of
from horseshoe import horseshoe, without_base
from verbs import refused, run

ROOT = Path(__file__).parents[2]
QUICK = StudyOptions(
    samples=20_000,
    registration=RegistrationOptions(
        samples=6000, search=SearchOptions(anchors=3, targets=400, candidates=40, turn_step_deg=20.0)
    ),
)
"""The horseshoe is found with few poses."""
FLAGS = (
    *("--samples", "5000", "--registration.samples", "3000", "--registration.search.anchors", "3"),
    *("--registration.search.targets", "400", "--registration.search.candidates", "40"),
    *("--registration.search.turn-step-deg", "20"),
)


@pytest.fixture(scope="module")
def jaw():
    return horseshoe(120, 40)


@pytest.fixture(autouse=True)
def _few_places(monkeypatch):
    """And small figures."""
    monkeypatch.setattr("cuspid.studies.scanners.specimen.PLACES", 12_000)
    monkeypatch.setattr("cuspid.report.figures.scanner_study._DPI", 60)


@pytest.fixture(scope="module")
def specimen(jaw, tmp_path_factory):
    """The reference of all studies here."""
    path = tmp_path_factory.mktemp("specimen") / "m.ply"
    storage.write_mesh(path, without_base(jaw.mesh))
    return load_specimen("m", path)


@pytest.fixture
def cases(monkeypatch):
    """The errors of the benchmark, which know nothing of the code that finds them."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return import_module("study_cases")


def moved(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    return mesh.transformed(Rigid3.from_quaternion(rng.normal(size=4), rng.normal(0, 30, 3)))


def noisy(mesh: Mesh, rng: np.random.Generator, sd_mm: float = 0.01) -> Mesh:
    return moved(Mesh(mesh.vertices + rng.normal(0, sd_mm, mesh.vertices.shape), mesh.faces), rng)


def put(folder: Path, name: str, mesh: Mesh) -> None:
    storage.write_mesh(folder / name, mesh)


# --- which files ------------------------------------------------------------------------------------------------------


def test_folders_tell_scanner_specimen_and_scan(tmp_path):
    for name in ("reference/Modèle 1.stl", "Scan ñ/Modèle 1/a b.stl", "Scan ñ/Modèle 1/c.PLY", "B/Modèle 1/a b.obj"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "B" / "other").mkdir()
    (tmp_path / "B" / "other" / "x.stl").touch()
    (tmp_path / "reference" / "Modèle 1.area.ply").touch()
    found = find_files(tmp_path)
    assert [scan.name for scan in found.scans] == ["B/Modèle 1/a b", "Scan ñ/Modèle 1/a b", "Scan ñ/Modèle 1/c"]
    assert list(found.references) == ["Modèle 1"]
    assert [remark.what for remark in found.remarks if remark.left_out] == ["B/other"]


def test_with_one_reference_a_folder_for_each_scanner_is_enough(tmp_path):
    for name in ("reference/jaw.stl", "A/1.stl", "A/2.stl"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [scan.name for scan in find_files(tmp_path).scans] == ["A/jaw/1", "A/jaw/2"]


@pytest.mark.parametrize("separator", [",", ";"])
def test_a_manifest_tells_operators_and_further_factors(tmp_path, separator):
    rows = ["Scanner,specimen,operator,file,reference,light", "A,m,Ann,x/1.stl,r.stl,on", "A,m,Bo,x/2.stl,r.stl,off"]
    (tmp_path / "study.csv").write_text("\n".join(rows).replace(",", separator) + "\n\n", encoding="utf-8-sig")
    found = find_files(tmp_path / "study.csv")
    assert [(scan.operator, scan.factors["light"]) for scan in found.scans] == [("Ann", "on"), ("Bo", "off")]
    assert found.scans[0].path == tmp_path / "x" / "1.stl"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("scanner,file,reference\nA,1.stl,r.stl\n", "no column specimen"),
        ("scanner,specimen,file,reference\n", "no rows"),
        ("scanner,specimen,file,reference\nA,m,,r.stl\n", "line 2 has no file"),
        ("scanner,specimen,file,reference\nA,m,1.stl,r.stl\nB,m,2.stl,q.stl\n", "another reference"),
        ("scanner,specimen,file,reference\nA,m,1.stl,r.stl\nA,m,x/1.stl,r.stl\n", "more than once"),
    ],
)
def test_a_manifest_that_cannot_be_used_says_why(tmp_path, text, told):
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(InputError, match=told):
        find_files(tmp_path / "m.csv")


def test_the_same_file_twice_counts_once(tmp_path):
    for name in ("reference/m.stl", "A/m/1.stl", "A/m/2.stl"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    found = find_files(tmp_path)
    digests = {scan.key: "same" for scan in found.scans}
    once = without_repeats(found, digests)
    assert len(once.scans) == 1
    assert "same file as A/m/1" in str(once.remarks[-1])


@pytest.mark.parametrize(("per_mm", "unit"), [(1.0, "mm"), (0.1, "cm"), (0.001, "m"), (1 / 25.4, "in"), (1000.0, "um")])
def test_the_unit_of_a_file_is_told_by_its_reference(tmp_path, jaw, per_mm, unit):
    put(tmp_path, "a.stl", Mesh(jaw.mesh.vertices * per_mm, jaw.mesh.faces))
    found, odd = guess_unit(tmp_path / "a.stl", storage.read_mesh(tmp_path / "a.stl"), like_mm=60.0)
    assert found == unit
    assert (odd is None) == (unit == "mm")
    put(tmp_path, "b.stl", Mesh(jaw.mesh.vertices * 25.4, jaw.mesh.faces))
    with pytest.raises(InputError, match="not the size of teeth or jaws"):
        guess_unit(tmp_path / "b.stl", storage.read_mesh(tmp_path / "b.stl"), like_mm=60.0)


# --- odd triangles ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True])
def test_faces_that_are_there_twice_are_used_once(jaw, turned):
    mesh = without_base(jaw.mesh)
    again = mesh.faces[:, ::-1] if turned else mesh.faces
    one, notes = mend_faces(Mesh(mesh.vertices, np.concatenate([mesh.faces, again])))
    assert notes == ("every face is there twice; one of each is used",)
    assert one.face_areas.sum() == pytest.approx(mesh.face_areas.sum())
    assert np.sum(one.face_centres * one.face_normals) == pytest.approx(np.sum(mesh.face_centres * mesh.face_normals))
    some, notes = mend_faces(Mesh(mesh.vertices, np.concatenate([mesh.faces, again[::3]])))
    assert len(some.faces) == len(mesh.faces)
    assert f"{len(again[::3])} of {len(mesh.faces) + len(again[::3])} faces" in notes[0]
    assert mend_faces(mesh) == (mesh, ())


@given(st.integers(1, 4), st.integers(0, 99))
@settings(max_examples=5, deadline=None)
def test_places_where_a_surface_cuts_itself_are_counted(posts, seed):
    """Posts through a sheet: each cuts it around once, and in whatever order its faces are."""
    sheet = trimesh.creation.box((40, 40, 1)).subdivide_to_size(0.9)
    parts = [trimesh.creation.cylinder(0.8, 6, sections=24).subdivide_to_size(0.7) for _ in range(posts)]
    for k, post in enumerate(parts):
        post.apply_translation([8.03 * k - 12.1, 1.07, 3.2])
    whole = trimesh.util.concatenate([sheet, *parts])
    order = np.random.default_rng(seed).permutation(len(whole.faces))
    mesh = Mesh(np.asarray(whole.vertices), np.asarray(whole.faces)[order])
    assert count_cuts(mesh) == posts
    assert count_cuts(Mesh(np.asarray(sheet.vertices), np.asarray(sheet.faces))) == 0
    assert ("one place" in cut_notes(mesh)[0]) == (posts == 1)


# --- places and small motions -----------------------------------------------------------------------------------------


@given(turn=st.floats(-0.002, 0.002), shift=st.floats(-0.1, 0.1), axis=st.integers(0, 2))
@settings(max_examples=10, deadline=None)
def test_a_small_motion_is_found_from_deviations_alone(turn, shift, axis):
    mesh = horseshoe(80, 30).mesh
    places = scatter(mesh, 4000, np.random.default_rng(0))
    way = np.eye(3)[axis]
    motion = Rigid3.from_rotation_vector(turn * way, shift * np.roll(way, 1))
    field = deviations_um(places, SignedDistance(mesh.transformed(motion)), 1.0)
    back = best_motion(places, field)
    left = field + back.changes_um(places)
    assert np.nanmedian(np.abs(left)) < 0.5 + 0.01 * np.nanmedian(np.abs(field))
    both = back.rigid @ motion
    assert np.abs(both.apply(places.points) - places.points).max() < 0.003


def test_pairs_at_places_agree_with_pairs_of_meshes(jaw):
    rng = np.random.default_rng(1)
    waves = [np.cos(jaw.mesh.vertices @ rng.normal(0, 0.2, 3) + k)[:, None] * 0.02 for k in range(2)]
    scans = [Mesh(jaw.mesh.vertices + wave * jaw.mesh.vertex_normals, jaw.mesh.faces) for wave in waves]
    places = scatter(jaw.mesh, 20_000, rng)
    fields = [deviations_um(places, SignedDistance(scan), 1.0) for scan in scans]
    at_places = float(np.abs(difference_um(places, *fields, align=True)).mean())
    of_meshes = compare_pair(*scans, PairOptions(samples=20_000), rng=rng).deviation.mean_abs_um
    assert at_places == pytest.approx(of_meshes, rel=0.03)
    assert 3 < of_meshes < 40


@pytest.mark.parametrize(("bias_um", "noise_um", "scans"), [(6.0, 4.0, 8), (0.0, 5.0, 12)])
def test_systematic_and_random_parts_are_told_apart(bias_um, noise_um, scans):
    rng = np.random.default_rng(1)
    bias = bias_um * rng.normal(size=20_000)
    fields = bias + noise_um * rng.normal(size=(scans, len(bias)))
    mean = Group(scanner="s", specimen="m", count=scans, mean_um=fields.mean(axis=0), sd_um=fields.std(axis=0, ddof=1))
    row = group_row([], mean, [], [{"mean_abs_um": 1.0, "rms_um": 2.0}])
    assert row["repeatability_sd_um"] == pytest.approx(noise_um, rel=0.02)
    assert row["repeatability_limit_um"] == pytest.approx(2.8 * row["repeatability_sd_um"])
    assert 0.9 * noise_um < row["median_sd_um"] < row["repeatability_sd_um"]
    assert row["systematic_rms_um"] == pytest.approx(bias_um, rel=0.03, abs=0.3)


def test_points_are_aligned_without_scale_and_a_line_is_refused():
    rng = np.random.default_rng(0)
    nominal = {str(k): rng.normal(0, 20, 3) for k in range(5)}
    motion = Rigid3.from_quaternion(rng.normal(size=4), rng.normal(size=3))
    measured = {name: motion.inverse().apply(1.01 * point) for name, point in nominal.items()}
    found = align_points(measured, nominal, "spheres")
    assert (found @ motion.inverse()).angle_deg < 1e-6
    line = {str(k): np.array([float(k), 0.0, 0.0]) for k in range(4)}
    with pytest.raises(InputError, match="on one line"):
        align_points(line, line, "spheres")


@given(spread=st.floats(-300, 300), twist=st.floats(-300, 300), ppm=st.floats(-500, 500))
@settings(max_examples=10, deadline=None)
def test_a_bend_is_taken_back(spread, twist, ppm):
    angle = np.linspace(np.pi, 0, 200)
    curve = ArchCurve(points=np.stack([25 * np.cos(angle), 30 * np.sin(angle), 0 * angle], axis=1))
    told = {"scale": ppm, "spread": spread, "lift": 50.0, "twist": twist}
    points = curve.points[::7] + np.array([1.0, -2.0, -3.0])
    bent = bend(curve, told, points)
    assert np.abs(straighten(curve, told, bent) - points).max() < 1e-5
    assert 0.005 < np.abs(bent - points).max() < 1


@pytest.mark.parametrize(("share", "is_told"), [(0.7, True), (0.3, False)])
def test_modes_are_not_told_of_a_small_part_of_the_arch(jaw, specimen, share, is_told):
    curve = specimen.arch_curve
    along = curve.lengths_mm[KDTree(curve.points[:, :2]).query(specimen.places.points[:, :2])[1]]
    part = specimen.places.chosen(along < share * curve.lengths_mm[-1])
    assert (fit_deformation(part, curve, specimen.reference_surface) is not None) == is_told


# --- a whole study ----------------------------------------------------------------------------------------------------


@pytest.fixture
def in_place(monkeypatch):
    """Without processes of its own, which take seconds to start."""

    def done(cases, work, folder, **_):
        for case in cases:
            work(**case.parameters)
        return ()

    monkeypatch.setattr("cuspid.studies.scanners.study.run_grid", done)


def specimen_bent(cases, specimen, told):
    """The middles of the pieces where the bends of a scan move them."""
    points = specimen.places.points
    bent = points + sum(cases.bent(points, specimen.curve, mode, um) - points for mode, um in told.items())
    return [bent[specimen.piece == piece].mean(axis=0) for piece in specimen.pieces]


@pytest.mark.long
def test_known_errors_come_back_and_the_rest_is_left_out(tmp_path, jaw, specimen, cases, in_place):
    mesh, rng = jaw.mesh, np.random.default_rng(0)
    probe = without_base(mesh)
    put(tmp_path, "reference/m.ply", probe)
    upright = probe.transformed(specimen.occlusal_from_file)
    curve = specimen.curve
    told = {"lift": 120.0, "spread": -60.0}
    bent = upright.vertices
    for mode, um in told.items():
        bent = bent + cases.bent(upright.vertices, curve, mode, um) - upright.vertices
    put(tmp_path, "A/m/bent.stl", moved(Mesh(bent, probe.faces), rng))
    put(tmp_path, "A/m/inches.stl", Mesh(noisy(probe, rng).vertices / 25.4, probe.faces))
    put(tmp_path, "B/m/mirror.stl", moved(Mesh(probe.vertices * [-1, 1, 1], probe.faces[:, ::-1]), rng))
    part = probe.submesh(probe.face_centres[:, 0] > np.quantile(probe.face_centres[:, 0], 0.68))
    put(tmp_path, "B/m/part.stl", noisy(part, rng))
    (tmp_path / "B" / "m" / "empty.stl").touch()
    twofold = noisy(probe, rng)
    put(tmp_path, "Scan ñ 2/m/two fold é.stl", Mesh(twofold.vertices, np.concatenate([twofold.faces] * 2)))
    out = tmp_path / "out"
    prepared = prepare(tmp_path, out, QUICK, Intake())
    told_before = [str(remark) for remark in plan_comparison(prepared, out, QUICK)]
    found = compare(prepared, out, QUICK)
    assert told_before == [str(remark) for remark in found.remarks]
    assert "Scan ñ 2/m/two fold é: every face is there twice; one of each is used" in told_before
    assert "Scan ñ 2: one scan of m alone: its precision cannot be told" in told_before
    rows = {row["scan"]: row for row in found.tables.scans}
    assert set(rows) == {"bent", "inches", "two fold é"}
    assert 2 < rows["two fold é"]["mean_abs_um"] < 8
    groups = {row["scanner"]: row["precision_rms_um"] for row in found.tables.groups}
    assert groups["Scan ñ 2"] is None
    assert groups["A"] > 0
    assert rows["bent"]["lift_um"] == pytest.approx(120, rel=0.05)
    assert rows["bent"]["spread_um"] == pytest.approx(-60, rel=0.05)
    assert abs(rows["bent"]["twist_um"]) < 3
    assert abs(rows["bent"]["scale_ppm"]) < 10
    truth = cases.truth_of(upright, bent, {})
    assert rows["bent"]["rms_um"] == pytest.approx(truth.rms_um, rel=0.02, abs=0.5)
    assert 2 < rows["inches"]["mean_abs_um"] < 8
    at = {
        specimen.piece_name(piece): specimen.places.points[specimen.piece == piece].mean(axis=0)
        for piece in specimen.pieces
    }
    bent_at = dict(zip(at, specimen_bent(cases, specimen, told), strict=True))
    spans = [row for row in found.tables.spans if row["scan"] == "bent"]
    assert len(spans) > 20
    for row in spans:
        pair = row["first"], row["second"]
        true_mm, nominal_mm = (np.linalg.norm(where[pair[0]] - where[pair[1]]) for where in (bent_at, at))
        assert row["error_um"] == pytest.approx(1000 * (true_mm - nominal_mm), abs=0.5)
    reasons = {remark.what: remark.why for remark in found.remarks if remark.left_out}
    assert "mirror image" in reasons["B/m/mirror"]
    assert "of what the median scan" in reasons["B/m/part"]
    assert "empty" in reasons["B/m/empty"]
    assert any("read in in" in str(remark) for remark in found.remarks)


@pytest.mark.long
def test_what_is_kept_is_used_again_until_a_file_changes(tmp_path, jaw, in_place, monkeypatch):
    probe, rng = without_base(jaw.mesh), np.random.default_rng(0)
    put(tmp_path, "reference/m.ply", probe)
    for name in ("1", "2"):
        put(tmp_path, f"A/m/{name}.stl", noisy(probe, rng))
    out = tmp_path / "out"
    measured: list[str] = []

    def counted(*, keys, **others):
        measured.extend(keys.split())
        return measure_share(keys=keys, **others)

    monkeypatch.setattr("cuspid.studies.scanners.study.measure_share", counted)
    prepare(tmp_path, out, QUICK, Intake())
    assert len(measured) == 2
    assert not (out / "shares").exists()  # which would tell where it was interrupted
    prepare(tmp_path, out, QUICK, Intake())
    assert len(measured) == 2
    put(tmp_path, "A/m/2.stl", noisy(probe, rng))
    prepare(tmp_path, out, QUICK, Intake())
    assert len(measured) == 3
    changed = find_files(tmp_path).scans[1]
    record = storage.read_json(out / "scans" / f"{changed.key}.json")
    assert record["failure"] is None
    # A file that changes between its digest and its reading.
    listed = {changed.key: {**vars(changed), "path": str(changed.path), "digest": "another", "made_from": "x"}}
    storage.write_json(out / "shares" / "left.json", listed)
    measure_share(keys=changed.key, out=out, options=QUICK)
    assert "changed while" in storage.read_json(out / "scans" / f"{changed.key}.json")["failure"]


@pytest.mark.long
def test_the_command_writes_the_page_figures_and_tables(tmp_path, jaw, in_place, capsys):
    pytest.importorskip("statsmodels", reason="statsmodels is not installed: pip install 'cuspid[study]'")
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not installed: pip install 'cuspid[study]'")
    probe, rng = without_base(jaw.mesh), np.random.default_rng(0)
    put(tmp_path, "given/reference/m.ply", probe)
    for scanner, sd_mm in (("A", 0.006), ("=B <x>", 0.012)):
        for k in range(3):
            put(tmp_path, f"given/{scanner}/m/{k}.stl", noisy(probe, rng, sd_mm))
    run("study", "scanners", tmp_path / "given", "--out", tmp_path / "out", *FLAGS, "--plan-um", "3")
    capsys.readouterr()
    told = storage.read_json(tmp_path / "out" / "study.json")
    assert told["counts"]["scans"] == 6
    quiet, loud = (told["scanners"][name]["precision"]["mean_abs_um"] for name in ("A", "=B <x>"))
    assert 1.7 < loud["value"] / quiet["value"] < 2.3
    assert quiet["low"] < quiet["value"] < quiet["high"] < loud["low"]
    assert told["plan"]["scans"]["3"] >= 2
    page = (tmp_path / "out" / "report.html").read_text()
    assert "=B &lt;x&gt;" in page
    assert "<x>" not in page
    for name in ("trueness", "modes", "spans", "means", "maps"):
        assert (tmp_path / "out" / "figures" / f"{name}.png").stat().st_size > 3_000
        assert b"/Type /Font" in (tmp_path / "out" / "figures" / f"{name}.pdf").read_bytes()
    book = openpyxl.load_workbook(tmp_path / "out" / "tables.xlsx")
    sheet = book["scans"]
    assert sheet.max_row == 7
    assert {row[0].value for row in sheet.iter_rows(min_row=2)} == {"A", "=B <x>"}
    assert all(row[0].data_type == "s" for row in sheet.iter_rows(min_row=2))
    rows = storage.read_table(tmp_path / "out" / "tables" / "scans.csv")
    assert float(rows[0]["mean_abs_um"]) > 0


def test_a_study_without_anything_to_compare_says_so(tmp_path, capsys):
    assert "no such folder" in refused(capsys, "study", "scanners", tmp_path / "none", "--out", tmp_path / "out")
    (tmp_path / "given").mkdir()
    assert "no folder 'reference'" in refused(
        capsys, "study", "scanners", tmp_path / "given", "--out", tmp_path / "out"
    )
    (tmp_path / "given" / "reference").mkdir()
    assert "holds no mesh" in refused(capsys, "study", "scanners", tmp_path / "given", "--out", tmp_path / "out")
    shutil.copy(ROOT / "pyproject.toml", tmp_path / "given" / "reference" / "m.stl")
    assert "no scan can be compared" in refused(
        capsys, "study", "scanners", tmp_path / "given", "--out", tmp_path / "out"
    )


def test_a_region_that_is_not_there_is_refused(tmp_path, jaw, specimen):
    put(tmp_path, "m.ply", without_base(jaw.mesh))
    with pytest.raises(InputError, match="no such region 'area'"):
        region_of(specimen, StudyOptions(region="area"))
    with pytest.raises(InputError, match="no tooth 46"):
        load_specimen("m", tmp_path / "m.ply", align_teeth=(46,))


def test_a_segment_is_a_third_of_the_length_of_the_curve():
    curve = np.array([[0.0, 0, 0], [10, 0, 0], [10, 20, 0]])
    assert _segments(np.array([0.0, 9.9, 10.1, 19.9, 20.1, 30.0]), curve).tolist() == [0, 0, 1, 1, 2, 2]
    assert _segments(np.array([np.nan]), np.empty((0, 3))).tolist() == [-1]
