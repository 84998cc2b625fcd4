"""The comparison of designs: what counts as the same surface, how large a holder is, and a whole study in small."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid import storage
from cuspid.anatomy.mouth import study_mouths
from cuspid.cli import comparison, main
from cuspid.evaluation.deviation import EvaluationOptions
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DesignOptions, essential_four, six_cameras, twelve_cameras
from cuspid.model.mesh import Mesh
from cuspid.pipeline.scan import SimulationOptions
from cuspid.runtime.errors import InputError
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.studies.design_comparison import (
    ComparisonOptions,
    compare_designs,
    comparison_cases,
    comparison_rows,
    data_mb,
    enough_turns,
    holder_size,
    load_design,
    markdown,
    open_surfaces,
    prepare_comparison,
    section_outlines,
    tooth_completeness,
    trajectory_mm,
    with_smaller_images,
)
from cuspid.studies.grid import Case, Outcome
from cuspid.studies.trial import TrialOptions
from verbs import refused

TOOTH = 46
OPTIONS = ComparisonOptions(samples=20_000)


def test_open_faces_are_of_the_tooth_and_fewer_where_more_must_be_free(coarse_phantom):
    areas = [
        sum(coarse_phantom.mesh.face_areas[mask].sum() for mask in open_surfaces(coarse_phantom, TOOTH, least).values())
        for least in (0.0, 0.25, 0.4)
    ]
    tooth = coarse_phantom.tooth_faces(TOOTH)
    assert areas[0] == pytest.approx(coarse_phantom.mesh.face_areas[tooth].sum())
    assert areas[0] > areas[1] > areas[2] > 0
    for mask in open_surfaces(coarse_phantom, TOOTH, 0.05).values():
        assert not (mask & ~tooth).any()


def test_the_sides_towards_the_neighbours_are_less_open_than_the_others(coarse_phantom):
    everything, some = (open_surfaces(coarse_phantom, TOOTH, least) for least in (0.0, 0.3))
    shares = {name: some[name].sum() / everything[name].sum() for name in everything}
    assert min(shares[name] for name in ("occlusal", "buccal", "lingual")) > 0.95
    assert max(shares[name] for name in ("mesial", "distal")) < 0.9


def test_completeness_of_a_perfect_scan_is_all(coarse_phantom):
    seen = np.ones(len(coarse_phantom.mesh.faces), dtype=bool)
    shares = tooth_completeness(coarse_phantom, coarse_phantom.mesh, seen, TOOTH, OPTIONS)
    assert shares.pop("open_mm2") > 50
    assert set(shares.values()) == {100.0}


def test_completeness_finds_the_surface_that_is_missing(coarse_phantom):
    mesh = coarse_phantom.mesh
    missing = open_surfaces(coarse_phantom, TOOTH, 0.0)["buccal"]
    # What lies at the rim of the hole is near the scan all the same.
    shares = tooth_completeness(coarse_phantom, mesh.submesh(~missing), ~missing, TOOTH, OPTIONS)
    assert 0 < shares["buccal_within_50_um_pct"] < 10
    assert shares["buccal_seen_pct"] == 0
    assert shares["lingual_within_50_um_pct"] == shares["occlusal_within_50_um_pct"] == 100
    buccal = mesh.face_areas[missing].sum() / shares["open_mm2"]
    assert shares["tooth_within_50_um_pct"] == pytest.approx(100 * (1 - buccal), abs=4)


def test_completeness_tells_fifty_from_a_hundred_um(coarse_phantom):
    mesh = coarse_phantom.mesh
    inflated = Mesh(mesh.vertices + 0.07 * mesh.vertex_normals, mesh.faces)
    shares = tooth_completeness(coarse_phantom, inflated, np.ones(len(mesh.faces), dtype=bool), TOOTH, OPTIONS)
    assert shares["tooth_within_50_um_pct"] < 20
    assert shares["tooth_within_100_um_pct"] > 95


def test_the_holder_of_the_four_is_as_large_as_its_parts_say(coarse_phantom):
    size = holder_size(section_outlines(coarse_phantom, essential_four(), ScanPathOptions(tooth=TOOTH), 7.0))
    assert size["holder_width_mm"] == pytest.approx(2.5 + 2 * 1.0)
    # The path keeps the working distance from the arch, the tops of whose crowns are not level.
    assert 12 - 1.5 < size["height_mm"] < 12 + 1.5
    thicker = holder_size(section_outlines(coarse_phantom, essential_four(), ScanPathOptions(tooth=TOOTH), 9.0))
    assert thicker["height_mm"] - size["height_mm"] == pytest.approx(2.0, abs=0.05)


def test_a_turned_holder_sweeps_more_width_and_the_twelve_are_wide_as_they_are(coarse_phantom):
    def size(handpiece, turns):
        return holder_size(section_outlines(coarse_phantom, handpiece, ScanPathOptions(tooth=TOOTH, turns=turns), 7.0))

    still, turned, twelve = size(six_cameras(), 1), size(six_cameras(), 3), size(twelve_cameras(), 1)
    assert still["swept_width_mm"] == pytest.approx(still["holder_width_mm"], abs=0.05)
    assert turned["holder_width_mm"] == pytest.approx(still["holder_width_mm"], abs=0.05)
    assert turned["swept_width_mm"] > 3 * still["swept_width_mm"]
    assert 28 < twelve["holder_width_mm"] < 36
    assert len(section_outlines(coarse_phantom, six_cameras(), ScanPathOptions(tooth=TOOTH, turns=5), 7.0)) == 5


def test_way_and_data_follow_from_the_frames():
    handpiece = essential_four(DesignOptions(width_px=200, height_px=100))
    poses = [Rigid3(np.eye(3), np.array([-float(x), 0, 0])) for x in range(4)]
    assert trajectory_mm(handpiece, poses) == pytest.approx(3.0)
    assert data_mb(handpiece, 4) == pytest.approx(4 * 4 * 200 * 100 / 1e6)


@pytest.mark.long
@given(scale=st.floats(0.1, 1.0))
def test_smaller_images_show_the_same(scale):
    handpiece = twelve_cameras(DesignOptions(width_px=400, height_px=300))
    smaller = with_smaller_images(handpiece, scale)
    for name, mounted in handpiece.rig.cameras.items():
        before, after = mounted.camera, smaller.rig[name].camera
        corners = np.array([[0.0, 0.0], [0.3, 0.8], [1.0, 1.0]])
        np.testing.assert_allclose(
            before.rays(corners * [before.width, before.height]), after.rays(corners * [after.width, after.height])
        )
        assert after.width == round(400 * scale)
    assert smaller.lights.keys() == handpiece.lights.keys()


def test_only_turned_designs_are_turned_and_cheap_scans_come_first():
    options = ComparisonOptions(designs=("twelve", "six"), turns=(1, 3), seeds=(0, 1))
    cases = comparison_cases(options, dict(map(load_design, options.designs)))
    assert [(case.parameters["design"], case.parameters["turns"]) for case in cases[::2]] == [
        ("six", 1),
        ("twelve", 1),
        ("six", 3),
    ]
    assert len({case.name for case in cases}) == 6


def outcome(turns, seed=0, complete=90.0, failure=None, design="six"):
    parameters = {"jaw": "phantom", "tooth": TOOTH, "design": design, "turns": turns, "seed": seed}
    figures = {
        "frames": 10 * turns,
        "trajectory_mm": 9.0 * turns,
        "height_mm": 12.0,
        "tooth_within_50_um_pct": complete,
    }
    figures |= {"cameras": 6, "tooth_mean_abs_um": None if seed else 2.0}
    case = Case(name=f"{design}_{turns}_{seed}", parameters=parameters)
    return Outcome(case=case, figures={} if failure else figures, failure=failure)


def test_rows_are_means_over_the_seeds_that_succeeded():
    outcomes = [outcome(3, 0, 90.0), outcome(3, 1, 92.0), outcome(3, 2, failure="dark"), outcome(1)]
    rows = comparison_rows(outcomes, ComparisonOptions(frame_rate_hz=15.0))
    first, second = rows
    assert (first["turns"], second["turns"], second["seeds"]) == (1, 3, 2)
    assert second["tooth_within_50_um_pct"] == pytest.approx(91.0)
    assert second["tooth_mean_abs_um"] == pytest.approx(2.0)
    assert second["capture_s"] == pytest.approx(2.0)
    assert second["speed_mm_s"] == pytest.approx(13.5)
    # docs/mouth.md: 12 mm fit 99.9 % of women at the second molar, and everybody in front.
    assert 99.5 < second["fits_women_7_pct"] <= second["fits_women_1_pct"] <= 100
    lines = markdown(rows).splitlines()
    assert len(lines) == 4 + 1 + 4
    assert len({line.count("|") for line in lines[:4]}) == 1


def test_turns_are_enough_where_completeness_stops_to_grow():
    options = ComparisonOptions(designs=("six",), turns=(1, 3, 5, 7), enough_pct=0.5)
    rows = comparison_rows([outcome(t, complete=c) for t, c in ((1, 70), (3, 90.0), (5, 96.0), (7, 96.3))], options)
    assert enough_turns(rows, options) == {"phantom, 46, six": 5}
    growing = [row for row in rows if row["turns"] in (1, 3, 5)]
    assert enough_turns(growing, options) == {}
    still = comparison_rows([outcome(1, design="twelve")], options)
    assert enough_turns(still, options) == {}


@pytest.mark.parametrize(
    "wrong",
    [
        {"turns": (2,)},
        {"designs": ()},
        {"seeds": (1, 1)},
        {"frame_rate_hz": 0.0},
        {"min_openness": 1.0},
        {"image_scale": 0.0},
    ],
)
def test_wrong_options_are_refused(wrong):
    with pytest.raises(InputError):
        ComparisonOptions(**wrong)


# --- whole studies ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def files(coarse_phantom, tmp_path_factory):
    """A jaw, and a handpiece with small images."""
    folder = tmp_path_factory.mktemp("compared")
    storage.write_jaw(folder / "jaw.ply", coarse_phantom)
    storage.write_handpiece(folder / "tiny.json", essential_four(DesignOptions(width_px=140, height_px=140)))
    return folder


@pytest.mark.long
def test_a_scan_is_simulated_reconstructed_and_evaluated(files, tmp_path):
    options = ComparisonOptions(designs=(str(files / "tiny.json"),), jaws=(str(files / "jaw.ply"),), samples=5000)
    trial = TrialOptions(
        simulation=SimulationOptions(supersampling=1, path=ScanPathOptions(frames=5, length_mm=4.0)),
        evaluation=EvaluationOptions(samples=20_000),
    )
    (done,) = compare_designs(tmp_path, options, trial, workers=1)
    assert done.failure is None
    assert not list((tmp_path / "scans").iterdir())
    figures = done.figures
    assert (figures["cameras"], figures["frames"], figures["images"]) == (4, 5, 20)
    assert 75 < figures["minimum_overlap_pct"] < 100
    assert figures["data_mb"] == pytest.approx(20 * 140 * 140 / 1e6)
    assert 3 < figures["trajectory_mm"] < 6
    assert 0 < figures["tooth_mean_abs_um"] < 30
    # Nearly all that two cameras saw at once, and what lies within 100 um of it; the views from above show no side.
    assert 0.8 < figures["occlusal_within_100_um_pct"] / figures["occlusal_seen_pct"] < 1.05
    assert figures["lingual_within_100_um_pct"] < figures["occlusal_within_50_um_pct"]
    assert figures["tooth_within_50_um_pct"] <= figures["tooth_within_100_um_pct"] < figures["tooth_seen_pct"] + 15


def test_the_verb_shows_what_is_done_without_scanning_again(files, tmp_path, capsys, monkeypatch):
    out, drawn = tmp_path / "comparison", []
    save = comparison.save_comparison_picture
    monkeypatch.setattr(comparison, "save_comparison_picture", lambda *of, **how: [drawn.append(of), save(*of, **how)])
    compare = [
        "study",
        "compare",
        "--jaws",
        str(files / "jaw.ply"),
        "--designs",
        str(files / "tiny.json"),
        "--turned",
        "tiny",
    ]
    compare += ["--out", str(out), "--turns"]
    storage.claim_folder(out, "simulate", {}, {})
    shares = {f"{name}_{what}_pct": 90.0 for name in ("tooth", "buccal") for what in ("seen", "within_50_um")}
    for turns in (1, 3):
        figures = outcome(turns).figures | shares | {"images": 40 * turns, "cameras": 4}
        case = {"jaw": "jaw", "tooth": TOOTH, "design": "tiny", "turns": turns, "seed": 0}
        entry = {"parameters": case, "figures": figures, "failure": None}
        storage.write_json(out / "cases" / f"jaw_{TOOTH}_tiny_{turns}_0.json", entry)
    main([*compare, "1", "3"])
    printed = capsys.readouterr()
    assert "What each needs" in printed.out
    assert "stops growing at 1 turns" in printed.err
    assert len((out / "results.csv").read_text().splitlines()) == 3
    assert len(json.loads((out / "comparison.json").read_text())["rows"]) == 2
    assert (out / "comparison.md").read_text().count("| jaw | 46 | tiny |") == 4
    for name in ("comparison.png", "surfaces.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    second_molars_mm = study_mouths()[1]["women"].gap_mm[:, 6]
    assert np.mean(second_molars_mm > drawn[0][3]) == pytest.approx(0.95, abs=0.002)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--designs", "nine"], "unknown design 'nine'"),
        (["--jaws", "nowhere.ply"], "unknown jaw 'nowhere.ply'"),
        (["--turns", "2"], "must be odd"),
        (["--workers", "0"], "--workers is 0"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_line(tmp_path, capsys, arguments, reason):
    assert reason in refused(capsys, "study", "compare", "--out", tmp_path / "out", *arguments, alone=True)
    assert not (tmp_path / "out").exists()


def test_another_file_of_the_same_name_is_refused(files, tmp_path):
    design = tmp_path / "tiny.json"
    design.write_bytes((files / "tiny.json").read_bytes())
    options = ComparisonOptions(designs=(str(design),), jaws=(str(files / "jaw.ply"),), tooth=(TOOTH,))
    prepare_comparison(tmp_path / "out", options)
    with pytest.raises(InputError, match="no tooth 48"):
        prepare_comparison(tmp_path / "out", dataclasses.replace(options, tooth=(48,)))
    storage.write_handpiece(design, six_cameras())
    with pytest.raises(InputError, match=r"tiny\.json differs"):
        prepare_comparison(tmp_path / "out", options)
