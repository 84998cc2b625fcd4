"""The practical study of a pair: where it is held, what a case measures, how a sweep goes on, and what is level."""

import csv
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cuspid import cli, storage
from cuspid.model.pairing import stereo_pairs
from cuspid.model.room import Room
from cuspid.runtime.errors import InputError
from cuspid.studies import camera_sweep, grid
from cuspid.studies.camera_sweep import (
    SweepOptions,
    best_setting,
    clear_path,
    contenders,
    find_site,
    pair_handpiece,
    surface_faces,
    sweep,
    values_of,
)
from cuspid.studies.grid import Case, Outcome
from verbs import refused

SMALL = SweepOptions(
    baseline_mm=(1.0, 2.0), angle_deg=(0.0,), image_px=160, path_mm=1.2, frames=2, repeats=0, contenders=1
)
"""Two cases of two frames each, in small images."""


@pytest.fixture(scope="module")
def site(coarse_phantom):
    return find_site(coarse_phantom, SMALL)


@pytest.fixture(scope="module")
def swept(coarse_phantom, tmp_path_factory):
    """A real sweep of two cases, its folder and its progress."""
    folder, seen = tmp_path_factory.mktemp("sweep"), []
    outcomes = sweep(coarse_phantom, folder, SMALL, workers=1, progress=lambda *at: seen.append(at))
    return outcomes, folder, seen


def outcome(baseline, angle, seed, failure=None, **figures):
    name = f"{baseline}-{angle}-{seed}"
    parameters = {"baseline_mm": baseline, "angle_deg": angle, "seed": seed}
    return Outcome(case=Case(name=name, parameters=parameters), figures=figures, failure=failure)


# --- Where the pair works


@pytest.mark.long
@pytest.mark.parametrize(
    ("surface", "tooth", "along"), [("occlusal", 47, False), ("incisal", 41, True), ("buccal", 36, False)]
)
def test_a_pair_looks_squarely_at_its_surface_and_lies_as_in_the_thesis(coarse_phantom, surface, tooth, along):
    options = SweepOptions(surface=surface, tooth=tooth, path_mm=2.0, frames=4, repeats=0)
    site = find_site(coarse_phantom, options)
    mesh, poses = site.jaw.mesh, site.rig_from_world[0]
    assert len(poses) == 4
    middle = np.average(mesh.face_centres[site.faces], axis=0, weights=mesh.face_areas[site.faces])
    normal = mesh.face_cross[site.faces].sum(axis=0)
    handpiece = pair_handpiece(site.pair_from_rig, (2.0, 6.0), options)
    left, right = (each.centre_in_rig for each in handpiece.rig.cameras.values())
    assert np.linalg.norm(right - left) == pytest.approx(2.0)
    # Rig frame: +X along the arch.
    assert abs((right - left)[0]) > 1.9 if along else abs((right - left)[0]) < 0.6
    in_pair = [(site.pair_from_rig @ pose).apply(middle) for pose in poses.values()]
    looks = [-(site.pair_from_rig @ pose).rotate(normal / np.linalg.norm(normal))[2] for pose in poses.values()]
    # A hand drifts by tenths of a millimetre and a few degrees.
    assert np.linalg.norm(np.mean(in_pair, axis=0) - [0, 0, 5.0]) < 1.0
    assert min(looks) > np.cos(np.deg2rad(12))


def test_only_what_is_near_is_sent_to_the_workers(site, coarse_phantom):
    assert site.faces.sum() == surface_faces(coarse_phantom, 47, "occlusal").sum()
    assert len(site.jaw.mesh.faces) < 0.35 * len(coarse_phantom.mesh.faces)
    assert len(pickle.dumps(site)) < 5e6


def test_the_gum_of_a_tooth_lies_on_its_outer_side(coarse_phantom):
    gum = surface_faces(coarse_phantom, 46, "gingival")
    assert gum.any()
    assert not (gum & coarse_phantom.tooth_faces(46)).any()
    tooth = coarse_phantom.mesh.face_centres[coarse_phantom.tooth_faces(46)]
    # 46 stands on the patient's right, which is +X in a lower jaw.
    assert np.median(coarse_phantom.mesh.face_centres[gum, 0]) > np.median(tooth[:, 0]) + 2


def test_a_pair_that_hardly_touches_is_moved_a_little_and_one_that_is_in_the_way_is_refused(site):
    handpiece, poses = pair_handpiece(site.pair_from_rig, (2.0, 0.0), SMALL), site.rig_from_world[0]
    free = Room(site.jaw.mesh, handpiece.solid, SMALL.path.clearance_mm)
    nearest_mm = min(free.clearance(pose)[0] for pose in poses.values())
    assert clear_path(replace(free, clearance_mm=nearest_mm - 0.01), poses, site.pair_from_rig, SMALL) == dict(poses)
    tight = replace(free, clearance_mm=nearest_mm + 0.1)
    held = clear_path(tight, poses, site.pair_from_rig, SMALL)
    assert list(held) == list(poses)
    assert tight.fits_at(list(held.values())).all()
    moved = [np.linalg.norm(held[name].matrix - poses[name].matrix) for name in poses]
    assert 0.05 < max(moved) < 0.6
    with pytest.raises(InputError, match=r"mm of the jaw, but must keep"):
        clear_path(replace(free, clearance_mm=nearest_mm + 2.0), poses, site.pair_from_rig, SMALL)


@settings(max_examples=20)
@given(baseline=st.floats(0.5, 4.0), angle=st.floats(0.0, 9.0))
def test_every_setting_of_the_thesis_is_taken_for_a_pair(site, baseline, angle):
    handpiece = pair_handpiece(site.pair_from_rig, (baseline, angle), SMALL)
    assert handpiece.working_distance_mm == SMALL.distance_mm
    assert stereo_pairs(handpiece.rig, handpiece.working_distance_mm, SMALL.pairing) == (("left", "right"),)


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"surface": "incisal", "tooth": 47}, "tooth 47 has no incisal surface; it has occlusal, buccal, lingual"),
        ({"tooth": 48}, "no tooth 48"),
        ({"distance_mm": 0.6, "depth_of_field_mm": 1.0}, "mm of the jaw|lies inside"),
        ({"surface": "mesial"}, "mm of the jaw|lies inside"),
        ({"path_mm": 9.0}, "frames, consecutive images overlap by only"),
    ],
)
def test_what_cannot_be_scanned_is_refused(coarse_phantom, change, message):
    with pytest.raises(InputError, match=message):
        find_site(coarse_phantom, SweepOptions(**{"frames": 4, "path_mm": 2.0, "repeats": 0, **change}))


@pytest.mark.parametrize(
    "change",
    [
        {"surface": "frontal"},
        {"baseline_mm": ()},
        {"baseline_mm": (0.0, 1.0)},
        {"angle_deg": (95.0,)},
        {"distance_mm": 0.0},
        {"frames": 1},
        {"image_px": 8},
        {"contenders": 0},
        {"repeats": -1},
    ],
)
def test_options_that_make_no_sense(change):
    with pytest.raises(InputError, match="sweep: "):
        SweepOptions(**change)


# --- A sweep


@pytest.mark.long
def test_a_real_sweep_measures_the_surface_alone(swept):
    outcomes, folder, seen = swept
    assert [each.failure for each in outcomes] == [None, None]
    assert seen[0] == ("scans", 0, 2)
    assert seen[-1] == ("scans", 2, 2)
    for each in outcomes:
        figures = each.figures
        assert 0.1 < figures["mean_abs_um"] < 25
        assert figures["mean_abs_um"] < figures["p95_um"] < figures["max_um"]
        assert 10 < figures["complete_50_um_pct"] <= figures["seen_pct"] + 6 < 90
        assert figures["complete_10_um_pct"] <= figures["complete_50_um_pct"] <= figures["complete_100_um_pct"]
        assert figures["points"] > 250
        assert figures["located_frames"] == 2
    narrow, wide = (each.figures for each in outcomes)
    assert narrow["seen_pct"] > wide["seen_pct"] + 3, "a longer baseline shares less"
    rows = list(csv.DictReader((folder / "results.csv").open()))
    assert [row["baseline_mm"] for row in rows] == ["1.0", "2.0"]
    assert float(rows[0]["mean_abs_um"]) == narrow["mean_abs_um"]


@pytest.mark.long
def test_a_killed_sweep_goes_on(coarse_phantom, swept, tmp_path, monkeypatch):
    outcomes, folder, _ = swept
    (tmp_path / "cases").mkdir()
    kept = outcomes[0].case.name
    shutil.copy(folder / "cases" / f"{kept}.json", tmp_path / "cases")
    ran = []
    monkeypatch.setattr("cuspid.studies.grid._run_in_processes", lambda cases, work, workers: ran.extend(cases) or [])
    with pytest.raises(KeyError):
        sweep(coarse_phantom, tmp_path, SMALL)
    assert [case.name for case in ran] == [outcomes[1].case.name]
    again = sweep(coarse_phantom, folder, SMALL)
    assert [each.figures for each in again] == [each.figures for each in outcomes]


@pytest.mark.long
def test_contenders_are_repeated_with_other_seeds(coarse_phantom, tmp_path, monkeypatch):
    """The grid in this process, with invented figures: 2 mm is best, 1 mm and 4 mm fail or are far behind."""
    calls = []

    def invented(*, baseline_mm, angle_deg, seed, **_):
        calls.append((baseline_mm, angle_deg, seed))
        if baseline_mm == 4.0:
            raise InputError("a camera lies inside the tooth")
        value = {1.0: 50.0, 2.0: 80.0, 2.5: 79.5}[baseline_mm] - angle_deg + 0.5 * seed
        return {"complete_50_um_pct": value, "complete_10_um_pct": value, "points": value, "mean_abs_um": 1.0}

    monkeypatch.setattr(camera_sweep, "sweep_case", invented)
    monkeypatch.setattr(
        "cuspid.studies.grid._run_in_processes",
        lambda cases, work, workers: [grid._attempt(work, case) for case in cases],
    )
    options = SweepOptions(
        baseline_mm=(1.0, 2.0, 2.5, 4.0), angle_deg=(0.0, 9.0), frames=2, path_mm=1.0, contenders=2, repeats=2
    )
    outcomes = sweep(coarse_phantom, tmp_path, options)
    failed = [each for each in outcomes if each.failure]
    assert {each.failure for each in failed} == {"a camera lies inside the tooth"}
    assert len(failed) == 2
    assert sorted(calls[8:]) == [(b, a, s) for b, a in ((1.0, 0.0), (1.0, 9.0), (2.0, 0.0), (2.5, 0.0)) for s in (1, 2)]
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 1 + 8 + 8


# --- Which setting is best


def test_the_best_is_named_and_what_is_level_with_it():
    means = {(1.0, 0.0): 60.0, (2.0, 0.0): 80.0, (2.5, 0.0): 79.8, (3.0, 0.0): 70.0}
    outcomes = [
        outcome(*setting, seed, complete_50_um_pct=mean + 5 * seed + 0.5 * (-1) ** (number + seed))
        for number, (setting, mean) in enumerate(means.items())
        for seed in range(6)
    ]
    first = outcomes[6].figures["complete_50_um_pct"]
    outcomes += [outcome(b, 9.0, 0, complete_50_um_pct=first - behind) for b, behind in ((3.0, 0.1), (3.5, 3.0))]
    outcomes.append(outcome(4.0, 9.0, 0, failure="touches"))
    best = best_setting(outcomes, "complete_50_um_pct")
    assert best.setting == (2.0, 0.0)
    assert best.value == pytest.approx(92.5)
    assert best.level == ((2.5, 0.0), (3.0, 9.0)), "79.8 is near; so is what one seed alone tells"
    # The seeds differ by 5 each, but that is common to all settings.
    assert best.noise == pytest.approx(0.5 * np.sqrt(24 / 15))
    assert best.seeds == 6


def test_less_is_better_of_errors_and_one_seed_tells_no_noise():
    outcomes = [outcome(b, 0.0, 0, mean_abs_um=value) for b, value in ((1.0, 2.0), (2.0, 1.0), (3.0, 1.01))]
    best = best_setting(outcomes, "mean_abs_um")
    assert (best.setting, best.value, best.noise, best.level) == ((2.0, 0.0), 1.0, None, ())
    assert best_setting([outcome(1.0, 0.0, 0, failure="x")], "mean_abs_um") is None


@given(noise=st.floats(0.1, 3.0), seed=st.integers(0, 1000))
@settings(max_examples=15)
def test_the_noise_is_what_neither_setting_nor_seed_explains(noise, seed):
    rng = np.random.default_rng(seed)
    outcomes = [
        outcome(float(b), 0.0, s, points=100.0 * b + 30.0 * s + noise * rng.standard_normal())
        for b in range(1, 13)
        for s in range(6)
    ]
    # 55 degrees of freedom: the estimate scatters by a tenth.
    assert 0.6 * noise < best_setting(outcomes, "points").noise < 1.45 * noise


def test_the_thesis_setting_is_a_contender_unless_it_failed():
    options = SweepOptions(contenders=1)
    figures = [outcome(b, 0.0, 0, complete_50_um_pct=9.0 - b, mean_abs_um=5.0 - b) for b in (1.0, 2.5, 4.0)]
    assert contenders(figures, options) == ((1.0, 0.0), (4.0, 0.0), (2.5, 0.0))
    failed = [outcome(2.5, 0.0, 0, failure="x") if each.case.name == "2.5-0.0-0" else each for each in figures]
    assert contenders(failed, options) == ((1.0, 0.0), (4.0, 0.0))
    assert SweepOptions(direction="along").thesis is None
    assert values_of(failed, "mean_abs_um") == {(1.0, 0.0): {0: 4.0}, (4.0, 0.0): {0: 1.0}}


# --- The command line


@pytest.fixture
def jaw_file(tmp_path, coarse_phantom):
    storage.write_jaw(tmp_path / "jaw.ply", coarse_phantom)
    return tmp_path / "jaw.ply"


@pytest.mark.long
def test_bad_input_is_one_line_and_leaves_nothing(jaw_file, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    absent = refused(capsys, "study", "sweep", jaw_file, "--surface", "incisal", "--tooth", 47, "--out", out)
    assert "no incisal surface" in absent
    close = refused(capsys, "study", "sweep", jaw_file, "--distance-mm", 0.6, "--depth-of-field-mm", 1, "--out", out)
    assert "of the handpiece" in close
    assert "--workers is 0" in refused(capsys, "study", "sweep", jaw_file, "--workers", 0, "--out", out)
    pytest.importorskip("distributed")
    monkeypatch.setattr("cuspid.studies.grid.CLUSTER_TIMEOUT_S", 1)
    alone = refused(capsys, "study", "sweep", jaw_file, "--cluster", "tcp://127.0.0.1:9", "--out", out)
    assert "no Dask scheduler answers" in alone
    assert not out.exists()


@pytest.mark.long
def test_the_verb_writes_its_results_and_does_not_mix_them(jaw_file, tmp_path, capsys, swept):
    outcomes, folder, _ = swept
    out = tmp_path / "out"
    settings_given = ["--baseline-mm", 1, 2, "--angle-deg", 0, "--image-px", 160, "--path-mm", 1.2, "--frames", 2]
    arguments = [jaw_file, *settings_given, "--repeats", 0, "--contenders", 1, "--out", out]
    options = SMALL
    storage.claim_folder(
        out,
        "sweep",
        {
            "options": options,
            "source": {"unit": "mm", "arch": None, "labels": "auto", "label_map": None, "jaw_seed": 0},
        },
        {"jaw": storage.hash_file(jaw_file)},
    )
    shutil.copytree(folder / "cases", out / "cases")
    broken = storage.read_json(out / "cases" / f"{outcomes[1].case.name}.json")
    storage.write_json(
        out / "cases" / f"{outcomes[1].case.name}.json", {**broken, "figures": {}, "failure": "no surface: dark"}
    )
    cli.main(["study", "sweep", *map(str, arguments)])
    printed = capsys.readouterr()
    assert "no surface: dark" in printed.err
    assert "1 mm, 0°" in printed.out
    summary = storage.read_json(out / "sweep.json")
    assert summary["best"]["complete_50_um_pct"]["setting"] == [1.0, 0.0]
    assert summary["failures"] == {outcomes[1].case.name: "no surface: dark"}
    assert (out / "sweep.png").stat().st_size > 10_000
    other = refused(capsys, "study", "sweep", *arguments[:-2], "--angle-deg", 0, 3, "--out", out)
    assert "holds another run of 'sweep' (settings.options.angle_deg differs)" in other
