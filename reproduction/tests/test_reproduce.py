"""The thesis beside ours: nothing is left out, verdicts follow from numbers by rules, a killed run goes on."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid import storage
from cuspid.cli import main
from cuspid.runtime.errors import CuspidError, InputError
from cuspid_thesis import runs
from cuspid_thesis.catalogue import BY_ID, ITEMS, TABLE_3_2
from cuspid_thesis.checks import cameras, mouth
from cuspid_thesis.judging import judge
from cuspid_thesis.page import GENERATED, conditions, figure_text, make_page
from cuspid_thesis.page_format import html, markdown
from cuspid_thesis.results import PANORAMA
from cuspid_thesis.rules import (
    FAVOUR,
    AtLeast,
    AtMost,
    Equals,
    Exceeds,
    Holds,
    LessIsBetter,
    least_favourable,
)
from cuspid_thesis.runs import ALL_RESULTS, RUNS, SUBJECT_NAMES, gather, missing, needed_results, read_results
from cuspid_thesis.scan_cases import run_timed
from verbs import refused

ROOT = Path(__file__).parents[2]
CASES = Path(__file__).parent / "reproduction_cases.py"
positive = st.floats(1e-3, 1e6)
finite = st.floats(-1e6, 1e6)


# --- The catalogue ----------------------------------------------------------------------------------------------------


def test_every_figure_table_and_equation_is_there_once():
    figures = {1: 3, 2: 6, 3: 22, 4: 5}
    expected = [f"fig-{chapter}.{number}" for chapter, count in figures.items() for number in range(1, count + 1)]
    expected += ["table-1.1", "table-2.1", "table-3.1", "table-3.2"]
    expected += [f"eq-2.{number}" for number in range(1, 5)] + [f"eq-3.{number}" for number in range(1, 10)]
    assert [item.id for item in ITEMS] == expected


def test_each_item_is_judged_or_lost_and_says_so():
    for finding in judge({}):
        assert bool(finding.comparisons) != bool(finding.item.lost), finding.item.id
        assert finding.verdict == ("not known" if finding.item.lost else "not run")
        assert finding.item.states
        assert all(each.rule.text and each.printed for each in finding.comparisons)


def test_what_judges_an_item_is_made_by_a_run():
    for item in ITEMS:
        assert bool(needed_results([item])) != bool(item.lost), item.id
    assert len(set(ALL_RESULTS)) == len(ALL_RESULTS)
    assert len(SUBJECT_NAMES) == len(set(SUBJECT_NAMES)) == 10


def test_table_3_2_is_that_of_the_thesis():
    assert [(row.part, row.tooth) for row in TABLE_3_2] == list(zip("BCDEFA", (46, 45, 42, 35, 36, None), strict=True))
    assert [row.mean_um for row in TABLE_3_2] == [130, 74, 61, 135, 120, 280]


# --- Rules ------------------------------------------------------------------------------------------------------------


@given(thesis=positive, factor=st.floats(0, 10), scale=st.floats(1e-3, 1e3))
def test_a_smaller_error_is_better_in_whatever_unit(thesis, factor, scale):
    verdict = LessIsBetter(thesis=thesis).verdict(factor * thesis)
    if not 0.0499 < abs(factor - 1) < 0.0501:  # else rounding decides
        expected = "better" if factor < 0.95 else "reproduced" if factor <= 1.05 else "falls short"
        assert verdict == expected
        assert LessIsBetter(thesis=scale * thesis).verdict(scale * factor * thesis) == verdict


@given(thesis=finite, within=positive, away=st.floats(0, 3))
def test_what_is_neither_good_nor_bad_is_judged_alike_on_both_sides(thesis, within, away):
    rule = Equals(thesis=thesis, within=within)
    if abs(away - 1) > 1e-3 and within * away > 1e-6 * abs(thesis) + 1e-9:
        expected = "reproduced" if away < 1 else "differs"
        assert rule.verdict(thesis + away * within) == rule.verdict(thesis - away * within) == expected
    assert rule.verdict(thesis) == "reproduced"


def test_an_interval_needs_both_ends():
    rule = Equals(thesis=(12.0, 26.6), within=1.0)
    assert rule.verdict((12.5, 26.0)) == "reproduced"
    assert rule.verdict((12.5, 41.3)) == rule.verdict((10.9, 26.6)) == "differs"
    with pytest.raises(InputError, match="cannot be compared"):
        rule.verdict(12.0)


@given(limit=finite, ours=finite)
def test_limits_from_above_and_below_are_mirrored(limit, ours):
    assert AtMost(limit=limit).verdict(ours) == AtLeast(limit=-limit).verdict(-ours)
    assert (AtMost(limit=limit).verdict(ours) == "differs") == (ours > limit)
    assert (Exceeds(thesis=limit).verdict(ours) == "reproduced") == (ours > limit)


def test_a_statement_holds_or_not():
    assert [Holds(condition="").verdict(value) for value in (True, False)] == ["reproduced", "differs"]


@given(st.lists(st.sampled_from([*FAVOUR, "not run"]), max_size=8), st.sampled_from(FAVOUR))
def test_the_least_favourable_verdict_never_gains_by_another_figure(verdicts, another):
    before, after = least_favourable(verdicts), least_favourable([*verdicts, another])
    assert after == least_favourable([another, *reversed(verdicts)])
    assert before == "not run" or FAVOUR.index(after) <= FAVOUR.index(before)
    assert after in (before, another)


# --- Results to verdicts ----------------------------------------------------------------------------------------------


def prepared(tooth: int, mean: float = 1.0, largest: float = 50.0) -> dict:
    statistics = {
        "min_um": 0.1,
        "max_um": largest,
        "mean_abs_um": mean,
        "std_abs_um": 2.0,
        "rms_um": 3.0,
        "p95_um": 4.0,
    }
    trueness = {"per_tooth": {str(tooth): statistics}, "per_tooth_completeness_pct": {str(tooth): {"50": 97.0}}}
    return {"case": f"prepared-{tooth}", "trueness": trueness, "images": 120, "commands": ["cuspid simulate"]}


def finding(item: str, results: dict):
    return judge(results, [BY_ID[item]])[0]


@pytest.mark.parametrize(("mean", "expected"), [(1.0, "better"), (130.0, "reproduced"), (140.0, "falls short")])
def test_table_3_2_follows_the_mean_deviation(mean, expected):
    found = finding("table-3.2", {"prepared-46": prepared(46, mean)})
    rows = {each.quantity: each for each in found.comparisons}
    assert rows["B, cracked: mean"].verdict == expected
    assert rows["A, complete arch: mean"].verdict == "not run"
    assert rows["B: images"].verdict == "reproduced"
    assert found.missing == ("prepared-45", "prepared-42", "prepared-35", "prepared-36", "prepared-arch")


def test_one_figure_that_falls_short_is_not_hidden_by_the_others():
    found = finding("table-3.2", {"prepared-46": prepared(46, 1.0, largest=300.0)})
    assert found.verdict == "falls short"
    assert sum(each.verdict == "better" for each in found.comparisons) == 2


def panorama(subject: str, method: str = "ortho", ssim: float = 0.8, failure: str | None = None) -> dict:
    picture = {"ssim_full": ssim, "ssim_teeth_fitted": 0.7, "zncc": 0.6}
    score = {
        "failure": failure,
        "picture": None if failure else picture,
        "geometry": {"median_mm": 0.3, "p95_mm": 0.8},
        "trivial": {"grey jaw": {"ssim_full": 0.86}},
        "coverage_pct": 99.0,
    }
    return {"subject": subject, "method": method, "failure": failure, "score": score}


def panoramas_of(count: int, **others: object) -> dict:
    return {f"panorama/{name}-ortho": panorama(name, **others) for name in SUBJECT_NAMES[:count]}


@pytest.mark.parametrize(("ssim", "expected"), [(0.71, "reproduced"), (0.69, "falls short")])
def test_fig_4_4_asks_the_worst_subject(ssim, expected):
    results = panoramas_of(9) | {"panorama/mine-ortho": panorama("mine", ssim=ssim)}
    least, subjects = finding("fig-4.4", results).comparisons[:2]
    assert least.verdict == expected
    assert subjects.verdict == "reproduced"


def test_nine_subjects_are_not_ten_and_a_panorama_that_failed_scores_nothing():
    results = panoramas_of(8) | {"panorama/mine-ortho": panorama("mine", failure="in pieces")}
    least, subjects = finding("fig-4.4", results).comparisons[:2]
    assert (least.ours, least.verdict) == (0.0, "falls short")
    assert "mine" in least.because
    assert subjects.verdict == "not run"
    assert "9" in subjects.shown


def test_the_examination_is_judged_where_both_were_run():
    better = {"panorama/a-thesis": panorama("a", "thesis", 0.8), "panorama/b-thesis": panorama("b", "thesis", 0.2)}
    assert finding("fig-4.5", better).comparisons[0].verdict == "not run"
    plain = {"panorama/a-thesis-unexamined": panorama("a", "thesis-unexamined", 0.7)}
    assert finding("fig-4.5", better | plain).comparisons[0].verdict == "reproduced"


def swept(best: float, thesis: float, noise: float | None = 0.5) -> dict:
    term = {"setting": [1.0, 9.0], "value": best, "seeds": 2, "noise": noise, "level": []}
    figures = {"complete_50_um_pct": thesis, "mean_abs_um": thesis}
    one = {"best": dict.fromkeys(figures, term), "thesis": {"setting": [2.5, 0.0], **figures}}
    return {"camera_sweep": {"surfaces": {"occlusal": one}}}


def test_the_best_pair_of_the_thesis_is_judged_by_the_noise():
    first = [finding("fig-3.14", swept(80.0, thesis)).comparisons[0].verdict for thesis in (79.2, 70.0)]
    assert first == ["reproduced", "differs"]
    assert finding("fig-3.14", swept(80.0, 79.0, noise=None)).comparisons[0].verdict == "not run"


def test_a_result_that_lacks_a_field_is_named():
    with pytest.raises(InputError, match=r"results populations\.json"):
        judge({"populations": {"groups": {"lower-14": {}}}}, [BY_ID["fig-2.2"]])


# --- What is computed -------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("content", [[], {}, "x", 1, {"0": "x"}])
def test_fields_of_another_kind_are_one_line(content):
    """Whatever stands for any field of a result: it is judged or refused, here and on the page."""
    found = read_results(ROOT / "benchmarks" / "results")
    for name in [*(name for name in found if PANORAMA not in name), f"{PANORAMA}lower-14-0-ortho"]:
        for field in found[name]:
            results = {name: {**found[name], field: content}}
            with contextlib.suppress(InputError):
                make_page(judge(results), results)


def test_closed_forms_agree_with_another_way_and_could_disagree():
    assert 0 < mouth.sagittal_model()["residual_mm"] < 1e-9
    assert 0 < cameras.closed_form()["relative_residual"] < 1e-9
    assert 0.1 < cameras.closed_form()["printed_ratio_1_mm"] < 0.5
    assert 0 < cameras.likelihood()["relative_difference"] < 0.01
    assert all(0 < value < 1e-9 for value in cameras.epipolar().values())
    assert cameras.projection_matrices()["parameters"] == 11


def test_the_printed_numbers_of_chapter_2_come_out_as_the_errata_say():
    assert mouth.radius()["largest_mm"] == pytest.approx(133.33, abs=0.01)
    gap = mouth.gap()
    assert (gap["least_mm"], gap["largest_mm"]) == pytest.approx((15.7, 41.3), abs=0.05)
    assert gap["without_cosine_mm"] == pytest.approx(11.95, abs=0.01)


def test_a_smaller_baseline_is_less_precise_by_the_bound():
    found = cameras.baseline_bound()
    assert found["rms_1_mm_um"] > 2 * found["rms_2.5_mm_um"] > found["rms_4_mm_um"] > 0
    turned = dict(zip(found, reversed(found.values()), strict=True))
    checks = read_results(ROOT / "benchmarks" / "results")["thesis_checks"]
    for bound, expected in ((found, "differs"), (turned, "reproduced")):
        rows = finding("fig-3.10", {"thesis_checks": {**checks, "baseline_bound": bound}}).comparisons
        assert rows[0].verdict == expected


# --- The page ---------------------------------------------------------------------------------------------------------


def test_the_page_without_results_says_what_to_run():
    text = markdown(make_page(judge({}), {}))
    for item in ITEMS:
        assert f"## {item.name}: " in text
        assert (f"cuspid reproduce --only {item.id} --out" in text) != bool(item.lost)


def test_every_link_of_the_page_leads_to_a_heading():
    text = markdown(make_page(judge({}), {}))
    anchors = {
        re.sub(r"[^\w\- ]", "", line.removeprefix("## ").lower()).replace(" ", "-")
        for line in text.splitlines()
        if line.startswith("## ")
    }
    links = re.findall(r"\]\(#([^)]*)\)", text)
    assert len(links) == len(ITEMS)
    assert set(links) <= anchors


def test_reduced_results_are_marked():
    result = {**json.loads((ROOT / "benchmarks/results/populations.json").read_text()), "quick": True}
    page = make_page(judge({"populations": result}, [BY_ID["fig-2.2"]]), {"populations": result})
    assert page.entries[0].rows[0].ours.endswith("(quick)")
    assert page.conditions[0][1].startswith("quick")


def test_what_results_say_cannot_break_out_of_the_page():
    evil = {**prepared(46), "commands": ["<script>alert(1)</script> | `x`"]}
    page = make_page(judge({"prepared-46": evil}, [BY_ID["table-3.2"]]), {"prepared-46": evil})
    document = html(page, {})
    assert "<script" not in document
    assert "&lt;script&gt;" in document
    assert "http" not in re.sub(r"http-equiv", "", document)
    row = next(line for line in markdown(page).splitlines() if line.startswith("| prepared-46"))
    assert len(re.findall(r"(?<!\\)\|", row)) == 3


def test_pictures_are_in_the_page_and_others_left_out():
    page = make_page(judge({}, [BY_ID["fig-2.5"], BY_ID["fig-3.17"]]), {}, pictures=["mouth-sagittal.png"])
    document = html(page, {"mouth-sagittal.png": "data:image/png;base64,AAAA"})
    assert document.count("<img") == markdown(page).count("![") == 1


def test_each_rule_names_its_rows_where_there_are_several():
    rules = make_page(judge({}, [BY_ID["fig-3.18"]]), {}).entries[0].rules
    assert [rule.split(":")[0] for rule in rules] == ["rows 1 and 2", "row 3", "row 4"]
    assert "row" not in make_page(judge({}, [BY_ID["fig-2.6"]]), {}).entries[0].rules[0]


def test_figures_keep_the_digits_that_matter():
    figures = [7.99e-06, 0.68, 99.9, 120.0, 1234.5, True, (77.8, 133.3), 0.0]
    assert list(map(figure_text, figures)) == ["8.0e-06", "0.68", "99.9", "120", "1,234", "yes", "77.8 to 133", "0"]


def test_the_page_of_the_documentation_is_that_of_the_results():
    results = read_results(ROOT / "benchmarks" / "results")
    pictures = {path.name for path in (ROOT / "docs" / "images").iterdir()}
    text = markdown(make_page(judge(results), results, pictures=pictures, origin=GENERATED))
    assert (ROOT / "docs" / "reproduction.md").read_text() == text, "run: python benchmarks/reproduction.py"
    assert len(re.findall(r"!\[[^]]*\]\(images/([^)]*)\)", text)) > 10
    for name in re.findall(r"\]\(([\w-]+\.md)\)", text):
        assert (ROOT / "docs" / name).is_file()


def test_conditions_name_the_command_and_the_commit():
    assert (
        conditions("mouth", {"commands": ["cuspid x"], "commit": "abc", "cores": 2})
        == "`cuspid x`; commit abc; 2 cores"
    )


# --- Runs -------------------------------------------------------------------------------------------------------------


def test_reduced_results_do_for_quick_alone_and_never_hide_full_ones(tmp_path):
    item = [BY_ID["fig-2.2"]]
    storage.write_json(tmp_path / "results-quick" / "populations.json", {"groups": {}})
    results = gather(tmp_path, None)
    assert results["populations"]["quick"]
    assert missing(item, results, quick=True) == {}
    assert missing(item, results, quick=False) == {"populations": ("populations",)}
    storage.write_json(tmp_path / "results" / "populations.json", {"groups": {"full": 1}})
    assert "quick" not in gather(tmp_path, None)["populations"]


def test_quick_leaves_the_arch_out_and_takes_two_subjects():
    wanted = missing(ITEMS, {}, quick=True)
    assert "prepared-arch" not in wanted
    assert len(wanted["prepared-teeth"]) == 3
    assert [name for name in wanted if name.startswith("panorama")] == ["panorama-lower-14-0", "panorama-upper-14-0"]
    assert set(missing(ITEMS, {}, quick=False)) == set(RUNS)


def test_ten_subjects_of_whatever_name_are_enough():
    results = {f"panorama/mine{number}-ortho": panorama(f"mine{number}") for number in range(10)}
    wanted = missing([BY_ID["fig-4.4"]], results, quick=False)
    assert {name for names in wanted.values() for name in names} == {
        f"panorama/{name}-thesis" for name in SUBJECT_NAMES
    }


def start(folder: Path, *arguments: str) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, str(CASES), str(folder), *arguments], stdout=subprocess.PIPE, text=True)


def wait_for(path: Path) -> None:
    end = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < end, f"{path} did not appear"
        time.sleep(0.05)


def wait_until_gone(pid: int) -> None:
    end = time.monotonic() + 20
    while Path(f"/proc/{pid}").exists():
        assert time.monotonic() < end, f"process {pid} outlives the run that was killed"
        time.sleep(0.05)


@pytest.mark.long
def test_a_killed_run_goes_on_and_loses_nothing(tmp_path):
    first = start(tmp_path)
    wait_for(tmp_path / "waiting")
    first.send_signal(signal.SIGKILL)
    first.wait()
    wait_until_gone(int((tmp_path / "waiting").read_text()))
    assert set(gather(tmp_path, None)) == {"populations"}
    (tmp_path / "go").touch()
    second = start(tmp_path)
    assert second.communicate(timeout=300)[0].strip() == "{}"
    assert set(gather(tmp_path, None)) == {"populations", "visibility"}
    assert (tmp_path / "calls").read_text() == "populations\n"


@pytest.mark.long
def test_a_run_that_fails_is_named_and_left_to_be_tried_again(tmp_path):
    assert "ZeroDivisionError" in start(tmp_path, "fails").communicate(timeout=300)[0]
    results = gather(tmp_path, None)
    assert set(results) == {"populations"}
    assert missing([BY_ID["fig-2.2"], BY_ID["fig-3.15"]], results, quick=True).keys() >= {"visibility"}


def test_what_cannot_be_stitched_is_a_result_and_the_next_method_is_tried(tmp_path, monkeypatch):
    def pretend(*arguments: str, log: Path) -> dict[str, float]:
        if arguments[:2] == ("pano", "stitch") and "ortho" in arguments:
            raise CuspidError("cuspid pano stitch failed with status 1: no frame could be placed")
        if arguments[:2] == ("pano", "evaluate"):
            storage.write_json(Path(arguments[-1]) / "score.json", panorama("x")["score"])
        return {"wall_s": 1.0, "cpu_s": 1.0, "peak_gib": 1.0}

    monkeypatch.setattr(runs, "run_timed", pretend)
    storage.write_json(tmp_path / "work" / "panorama-lower-14-0" / "jaw.json", {})
    wanted = {"panorama-lower-14-0": ("panorama/lower-14-0-ortho", "panorama/lower-14-0-thesis")}
    runs.run_one(run="panorama-lower-14-0", folder=tmp_path, wanted=wanted, quick=True)
    found = gather(tmp_path, None)
    assert "no frame could be placed" in found["panorama/lower-14-0-ortho"]["failure"]
    assert found["panorama/lower-14-0-thesis"]["failure"] is None
    least = finding("fig-4.4", found).comparisons
    assert (least[0].ours, least[2].ours) == (0.0, 0.8)
    assert "quick" not in found["panorama/lower-14-0-thesis"]


@pytest.mark.long
def test_a_command_that_fails_is_told_with_its_last_words(tmp_path):
    with pytest.raises(CuspidError, match=r"evaluate failed with status 1: .*nowhere"):
        run_timed("evaluate", "nowhere.ply", "nowhere", "--out", str(tmp_path / "out"), log=tmp_path / "log")


# --- The command line -------------------------------------------------------------------------------------------------


def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    broken, empty = tmp_path / "broken", tmp_path / "empty"
    empty.mkdir()
    storage.write_bytes(broken / "populations.json", b'{"groups": ')
    cases = {
        "did you mean": ["--only", "fig-3.23"],
        "no such item": ["--only", "x"],
        "no such folder": ["--results", str(tmp_path / "nowhere")],
        "no results in it": ["--results", str(empty)],
        "not valid JSON": ["--results", str(broken)],
        "--images": ["--images", str(tmp_path / "nowhere")],
        "--workers is 0": ["--workers", "0"],
    }
    for expected, arguments in cases.items():
        assert expected in refused(capsys, "reproduce", *out, "--no-run", *arguments, alone=True)
        assert not (tmp_path / "out").exists()


def test_results_of_another_form_are_one_line_and_leave_nothing(tmp_path, capsys):
    storage.write_json(tmp_path / "given" / "populations.json", {"groups": {"lower-14": 3}})
    arguments = ["--out", str(tmp_path / "out"), "--results", str(tmp_path / "given"), "--no-run"]
    assert "populations.json" in refused(capsys, "reproduce", *arguments, alone=True)
    assert not (tmp_path / "out").exists()


def test_pages_are_made_of_what_is_there(tmp_path, capsys):
    given_results = str(ROOT / "benchmarks" / "results")
    main(["reproduce", "--out", str(tmp_path / "out"), "--results", given_results, "--no-run", "--only", "fig-2.2"])
    page = (tmp_path / "out" / "reproduction.html").read_text()
    assert "Fig 2.2" in page
    assert "Fig 2.3" not in page
    assert "0.0068" in page
    assert "1 reproduced" in capsys.readouterr().err
