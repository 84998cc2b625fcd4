"""Optics, visibility, precision and design as a user meets them: the files that appear, and what bad input gets."""

import csv

import pytest

from cuspid import storage
from cuspid.handpiece.presets import PRESETS
from verbs import refused, run

BRIEF = """
name = "probe"
sensor = "thesis"
thickness_mm = {thickness}
working_distance_mm = [4.0, 6.0]
[surfaces]
occlusal = 0.9
[cameras]
max = 4
"""


def rows_of(path) -> dict[str, dict[str, str]]:
    """The rows of a table by their first cell."""
    return {next(iter(row.values())): row for row in csv.DictReader(path.open())}


def test_optics_compares_the_presets(tmp_path):
    run("rig", "optics", "--distance-mm", 10, "--out", tmp_path / "optics.csv")
    rows = rows_of(tmp_path / "optics.csv")
    assert set(rows) == set(PRESETS)
    assert float(rows["thesis"]["um_per_px"]) == pytest.approx(PRESETS["thesis"].um_per_px(10.0))


def test_optics_refuses_a_surface_in_the_lens(capsys):
    assert "--distance-mm" in refused(capsys, "rig", "optics", "--distance-mm", 0)


@pytest.mark.long
def test_visibility_of_a_tooth(tmp_path, phantom_file):
    out = tmp_path / "seen"
    run("rig", "visibility", phantom_file, "--tooth", 46, "--design", "four", "--out", out)
    rows = rows_of(out / "surfaces.csv")
    assert float(rows["occlusal"]["seen_by_2_pct"]) > 85
    assert float(rows["buccal"]["seen_by_2_pct"]) < 60
    assert float(rows["all"]["area_mm2"]) == pytest.approx(
        sum(float(row["area_mm2"]) for name, row in rows.items() if name != "all"), abs=0.05
    )
    assert set(rows_of(out / "cameras.csv")) == {"o1", "o2", "o3", "o4"}
    assert (out / "visibility.png").stat().st_size > 10_000


@pytest.mark.long
def test_a_rig_of_colmap_is_simulated_and_what_is_assumed_is_said(tmp_path, phantom_file, capsys):
    probe, scan = tmp_path / "probe", tmp_path / "scan"
    run("rig", "build", "--design", "two", "--width-px", 48, "--height-px", 48, "--out", probe)
    short = ("--tooth", 46, "--frames", 2, "--length-mm", 1, "--supersampling", 1)
    run("simulate", phantom_file, "--handpiece", probe / "rig_config.json", *short, "--out", scan)
    notes = " ".join(capsys.readouterr().err.split())
    assert "mm is assumed, from their baselines" in notes
    assert "it has no lights; one beside each camera is assumed" in notes
    made = storage.read_handpiece(scan / "capture" / "handpiece.json")
    assert len(made.lights) == 2
    assert 2.5 < made.working_distance_mm < 10


def test_a_working_distance_is_not_given_twice(tmp_path, phantom_file, capsys):
    run("rig", "build", "--design", "two", "--out", tmp_path)
    command = (
        "rig",
        "visibility",
        phantom_file,
        "--handpiece",
        tmp_path / "handpiece.json",
        "--out",
        tmp_path / "seen",
    )
    assert "already has a working distance" in refused(capsys, *command, "--working-distance-mm", 8)
    assert "must lie between" in refused(capsys, *command, "--working-distance-mm", 0)


@pytest.mark.long
def test_precision_of_a_tooth_follows_the_noise(tmp_path, phantom_file):
    medians = []
    for sigma_px in (0.5, 1.0):
        out = tmp_path / f"{sigma_px}"
        run("rig", "precision", phantom_file, "--tooth", 46, "--design", "four", "--sigma-px", sigma_px, "--out", out)
        medians.append(float(rows_of(out / "surfaces.csv")["occlusal"]["rms_median_um"]))
    assert 5 < medians[0] < 50
    assert medians[1] == pytest.approx(2 * medians[0], abs=0.02)


def test_precision_of_a_tooth_that_is_not_there(tmp_path, capsys, phantom_file):
    assert "no tooth 16" in refused(capsys, "rig", "precision", phantom_file, "--tooth", 16, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_a_handpiece_for_a_brief(tmp_path, capsys, phantom_file):
    (tmp_path / "brief.toml").write_text(BRIEF.format(thickness=7.0))
    out = tmp_path / "found"
    search = ("--samples", 0, "--finalists", 1, "--evaluations", 5)
    run("rig", "design", tmp_path / "brief.toml", "--jaw", phantom_file, "--teeth", 46, *search, "--out", out)
    found = storage.read_handpiece(out / "handpiece.json")
    assert 2 <= len(found.rig.names) <= 4
    assert storage.read_json(out / "design.json")["gap_mm"] > 11
    assert (out / "design.png").stat().st_size > 10_000
    assert "met    " in capsys.readouterr().err


def test_a_brief_that_no_mouth_has_room_for(tmp_path, capsys, phantom_file):
    (tmp_path / "brief.toml").write_text(BRIEF.format(thickness=30.0))
    message = refused(
        capsys, "rig", "design", tmp_path / "brief.toml", "--jaw", phantom_file, "--out", tmp_path / "found"
    )
    assert "gap" in message
    assert not (tmp_path / "found").exists()
