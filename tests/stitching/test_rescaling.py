"""The scale of a panorama from measured distances: lengths become those that were measured, whatever they were."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid import storage
from cuspid.cli.panorama import clear
from cuspid.model.jaw import Jaw
from cuspid.model.panorama import Panorama
from cuspid.runtime.errors import InputError
from cuspid.stitching.rescaling import MeasuredDistance, rescale_panorama
from panoramas import HEIGHT, WIDTH, known_film, score, stitched_panorama, write_stitched
from verbs import refused, run

SCALES = st.floats(0.05, 20.0)
PIXELS = st.tuples(st.floats(0.0, WIDTH - 0.01), st.floats(0.0, HEIGHT - 0.01))
"""Places in the picture."""


def apart(shown: Panorama, places_px: np.ndarray) -> float:
    """What lies between two pixels in space."""
    columns, rows = np.floor(places_px).astype(int).T
    places = np.column_stack([shown.world_from_pixels(places_px), shown.height_mm[rows, columns]])
    return float(np.linalg.norm(places[1] - places[0]))


def distance(first: Sequence[float], second: Sequence[float], mm: float) -> MeasuredDistance:
    return MeasuredDistance(places_px=np.array([first, second], float), mm=mm)


FAR = (np.array([3.2, 4.5]), np.array([36.0, 22.9]))


@given(SCALES, st.one_of(st.none(), st.floats(1e-3, 1.0)), PIXELS, PIXELS)
def test_every_length_becomes_that_of_the_measurement(
    mm: float, before: float | None, one: tuple[float, float], other: tuple[float, float]
) -> None:
    shown = stitched_panorama(mm_per_px=before)
    found = rescale_panorama(shown, [distance(*FAR, mm)])
    assert apart(found.panorama, np.array(FAR)) == pytest.approx(mm, rel=1e-5)
    assert found.lengths_mm == pytest.approx([mm])
    elsewhere = np.array([one, other])
    assert apart(found.panorama, elsewhere) == pytest.approx(found.factor * apart(shown, elsewhere), rel=1e-4)
    np.testing.assert_array_equal(found.panorama.image, shown.image)
    np.testing.assert_array_equal(found.panorama.origin_px, shown.origin_px)


@given(SCALES, SCALES)
def test_what_the_scale_was_before_does_not_matter(one: float, other: float) -> None:
    first = rescale_panorama(stitched_panorama(), [distance(*FAR, one)]).panorama
    again, at_once = (rescale_panorama(each, [distance(*FAR, other)]).panorama for each in (first, stitched_panorama()))
    assert again.mm_per_px == pytest.approx(at_once.mm_per_px, rel=1e-5)
    np.testing.assert_allclose(again.height_mm, at_once.height_mm, rtol=1e-5)


@given(SCALES, st.floats(-0.4, 0.4))
def test_of_several_distances_the_scale_suits_all(factor: float, off: float) -> None:
    """The squares of what they are off by are least; equal errors either way cancel for equal lengths."""
    shown = stitched_panorama()
    near = np.array([[20.0, 3.0], [22.0, 27.0]])
    lengths = np.array([apart(shown, np.array(FAR)), apart(shown, near)])
    measured = factor * lengths * [1 + off, 1]
    found = rescale_panorama(shown, [distance(*FAR, measured[0]), distance(*near, measured[1])])
    least = np.sum((found.lengths_mm - measured) ** 2)
    for step in (0.999, 1.001):
        assert np.sum((step * found.lengths_mm - measured) ** 2) >= least
    weight = lengths[0] ** 2 / np.sum(lengths**2)
    assert found.factor == pytest.approx(factor * (1 + off * weight), rel=1e-6)


def test_the_notes_tell_where_the_scale_is_from_and_what_does_not_fit() -> None:
    shown = stitched_panorama()
    near = np.array([[20.0, 3.0], [22.0, 27.0]])
    lengths = [apart(shown, np.array(FAR)), apart(shown, near)]
    fits = rescale_panorama(shown, [distance(*FAR, 2 * lengths[0]), distance(*near, 2.04 * lengths[1])]).panorama.notes
    assert "smaller by a factor of 2.0" in fits[0]
    assert fits[1:] == ("the path is weakly constrained at frame 7",)
    off = rescale_panorama(shown, [distance(*FAR, 2 * lengths[0]), distance(*near, 3 * lengths[1])]).panorama.notes
    assert sum("check the places" in note for note in off) == 2
    larger = rescale_panorama(shown, [distance(*FAR, lengths[0] / 1.25)]).panorama.notes[0]
    assert "larger by a factor of 1.2500" in larger
    assert f"is {100 * 0.1 / (lengths[0] / 1.25):.2g} % of all lengths" in larger


def test_without_heights_places_count_as_level_and_that_is_said() -> None:
    flat = replace(stitched_panorama(), height_mm=None)
    found = rescale_panorama(flat, [distance((10, 10), (30, 10), 40.0)])
    assert found.panorama.mm_per_px == pytest.approx(2.0)
    assert any("no heights" in note for note in found.panorama.notes)


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        ((-0.1, 3), (20, 20), "outside"),
        ((3, 3), (20, HEIGHT), "outside"),
        ((3, 3), (5.5, 6.5), "shows nothing at pixel (5.5, 6.5)"),
        ((3, 3), (8.5, 6.5), "shows nothing at pixel (8.5, 6.5)"),
        ((3, 3), (3, 3), "the same pixel"),
    ],
)
def test_places_that_tell_nothing_are_refused(first, second, told: str) -> None:
    shown = stitched_panorama()
    covered, height = np.array(shown.covered), np.array(shown.height_mm)
    covered[6, 5], height[6, 8] = False, np.nan
    with pytest.raises(InputError, match=r".*") as caught:
        rescale_panorama(replace(shown, covered=covered, height_mm=height), [distance(first, second, 10.0)])
    assert told in str(caught.value)


def test_the_scale_of_a_film_becomes_true(coarse_phantom: Jaw) -> None:
    """Of a panorama whose millimetres are 7 % too large, told the distance of two places on the true jaw."""
    known = known_film(coarse_phantom)
    true = replace(known.panorama, height_mm=np.where(known.view.labels >= 0, 0.0, np.nan).astype(np.float32))
    wrong = replace(true, mm_per_px=1.07 * true.mm_per_px)
    rows, columns = np.nonzero(true.covered)
    left, right = columns.argmin(), columns.argmax()
    ends = np.array([[columns[each] + 0.5, rows[each] + 0.5] for each in (left, right)])
    mm = float(np.linalg.norm(np.diff(true.world_from_pixels(ends), axis=0)))
    assert score(known, wrong).geometry.scale_error_pct == pytest.approx(100 / 1.07 - 100, abs=0.1)
    found = score(known, rescale_panorama(wrong, [distance(*ends, mm)]).panorama)
    assert abs(found.geometry.scale_error_pct) < 0.05
    assert found.geometry.median_mm < 1e-3


# --- the verb -----------------------------------------------------------------------------------------------------


def table(path: Path) -> np.ndarray:
    return np.array([[float(cell) for cell in row.values()] for row in csv.DictReader(path.read_text().splitlines())])


@pytest.mark.parametrize("mm_per_px", [0.03, None])
def test_all_files_are_of_the_new_scale(tmp_path: Path, mm_per_px: float | None) -> None:
    folder, out, shown = tmp_path / "pano", tmp_path / "out", stitched_panorama(mm_per_px=mm_per_px)
    poses = write_stitched(folder, shown)
    (u, v), (w, x) = FAR
    mm = 1.5 * apart(shown, np.array(FAR))
    run("pano", "rescale", folder, "--out", out, "--distance", u, v, w, x, mm)
    made = storage.read_panorama(out)
    assert made.mm_per_px == pytest.approx(1.5 * (mm_per_px or 1))
    np.testing.assert_allclose(made.height_mm, 1.5 * shown.height_mm, rtol=1e-5)
    pose = storage.read_poses(out / "poses.json")["a"]
    np.testing.assert_allclose(pose.translation, 1.5 * poses["a"].translation)
    np.testing.assert_allclose(pose.rotation, poses["a"].rotation)
    rounding = 0.5e-4 * (1 + 1.5)
    scaled = table(folder / "strip.csv") * [1, 1.5, 1.5, 1.5]
    np.testing.assert_allclose(table(out / "strip.csv"), scaled, atol=1.01 * rounding, rtol=0)
    strips = [json.loads((each / "strip.json").read_text()) for each in (folder, out)]
    assert strips[1]["mm_per_px"] == pytest.approx(1.5 * (mm_per_px or 1))
    assert strips[1]["length_mm"] == pytest.approx(7 * 1.5 * (mm_per_px or 1))
    assert strips[1]["share_of_zone"] == strips[0]["share_of_zone"]
    assert (out / "strip.png").read_bytes() == (folder / "strip.png").read_bytes()
    told = json.loads((out / "distances.json").read_text())
    assert told["factor"] == pytest.approx(1.5)
    assert told["distances"][0]["panorama_mm"] == pytest.approx(mm)
    assert {"distances.png", "camera_path.png", "report.html", "run.json"} < {path.name for path in out.iterdir()}


def test_several_distances_are_given_one_after_the_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_stitched(tmp_path / "pano", stitched_panorama())
    measured = ("--distance", 3, 4, 36, 22, 40.0, "--distance", 20, 3, 22, 27, 20.0)
    run("pano", "rescale", tmp_path / "pano", "--out", tmp_path / "out", *measured)
    assert len(json.loads((tmp_path / "out" / "distances.json").read_text())["distances"]) == 2
    assert "check the places" in capsys.readouterr().err.replace("\n", " ")


def test_the_page_of_a_killed_run_names_its_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_stitched(tmp_path / "pano", stitched_panorama())
    run("pano", "rescale", tmp_path / "pano", "--out", tmp_path / "out", "--distance", 3, 4, 36, 22, 40.0)
    (tmp_path / "out" / "panorama.json").unlink()
    assert "run the same command again" in refused(capsys, "report", tmp_path / "out")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ((), "at least one --distance"),
        (("--distance", 3, 3, 20, 20, 0), "must be 0.1 mm or more"),
        (("--distance", 3, 3, 20, 20, -5), "must be 0.1 mm or more"),
        (("--distance", 3, 3, 20, 20, "nan"), "--distance is nan"),
        (("--distance", 3, 3, 900, 20, 5), "outside the panorama of 40 x 30 px"),
    ],
)
def test_what_cannot_be_measured_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: tuple[object, ...], told: str
) -> None:
    write_stitched(tmp_path / "pano", stitched_panorama())
    assert told in refused(capsys, "pano", "rescale", tmp_path / "pano", "--out", tmp_path / "out", *given)
    assert not (tmp_path / "out").exists()


def test_the_panorama_itself_parts_and_meshes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    measured = ("--distance", 3, 3, 20, 20, 5)
    write_stitched(tmp_path / "pano", stitched_panorama())
    before = (tmp_path / "pano" / "panorama.json").read_bytes()
    assert "the panorama itself" in refused(
        capsys, "pano", "rescale", tmp_path / "pano", "--out", tmp_path / "pano", *measured
    )
    assert (tmp_path / "pano" / "panorama.json").read_bytes() == before
    write_stitched(tmp_path / "parts" / "part-1", stitched_panorama())
    assert "parts/part-1" in refused(
        capsys, "pano", "rescale", tmp_path / "parts", "--out", tmp_path / "out", *measured
    )
    write_stitched(tmp_path / "mesh", replace(stitched_panorama(), method="mesh"))
    assert "view of a mesh" in refused(
        capsys, "pano", "rescale", tmp_path / "mesh", "--out", tmp_path / "out", *measured
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("file", ["poses.json", "strip.csv", "strip.json", "source.npz"])
def test_a_damaged_file_leaves_nothing_behind(tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str) -> None:
    write_stitched(tmp_path / "pano", stitched_panorama())
    (tmp_path / "pano" / file).write_bytes(b"column,along\n1")
    line = refused(
        capsys, "pano", "rescale", tmp_path / "pano", "--out", tmp_path / "out", "--distance", 3, 3, 20, 20, 5
    )
    assert file in line
    assert not (tmp_path / "out").exists()


def test_no_panorama_is_overwritten_and_nothing_of_an_earlier_one_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measured = ("--distance", 3, 3, 20, 20, 5)
    for name in ("pano", "other"):
        write_stitched(tmp_path / name, stitched_panorama())
    line = refused(capsys, "pano", "rescale", tmp_path / "pano", "--out", tmp_path / "other", *measured)
    assert "other: holds a panorama of cuspid pano stitch" in line
    run("pano", "rescale", tmp_path / "pano", "--out", tmp_path / "out", *measured)
    for file in ("strip.json", "poses.json"):
        (tmp_path / "other" / file).unlink()
    run("pano", "rescale", tmp_path / "other", "--out", tmp_path / "out", *measured)
    assert not any((tmp_path / "out" / file).exists() for file in ("strip.png", "poses.json", "camera_path.png"))
    clear(tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"run.json", "report.html"}
