"""The page of the benchmarks: which results still hold, and how those are shown that do not."""

import json
import shutil
import subprocess
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
REFINEMENT = "src/cuspid/mvs/refinement.py"


@pytest.fixture
def freshness(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return import_module("freshness")


@pytest.fixture
def repository(tmp_path, freshness, monkeypatch):
    """The code as it stands, committed."""
    for folder in ("src", "reproduction", "benchmarks"):
        kept = shutil.ignore_patterns("__pycache__", "results")
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=kept)
    git = ("git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e@x.org")
    for command in (("init", "-q"), ("add", "."), ("commit", "-qm", "as it stands")):
        subprocess.run([*git, *command], check=True)
    monkeypatch.setattr(freshness, "ROOT", tmp_path)
    forget(freshness)
    return tmp_path


def forget(freshness) -> None:
    """The code as it was."""
    freshness._changed_since.cache_clear()
    freshness._code_of_today.cache_clear()


def commit_of(repository: Path) -> str:
    return subprocess.check_output(["git", "-C", str(repository), "rev-parse", "--short=12", "HEAD"], text=True).strip()


def add(repository: Path, file: str, text: str) -> None:
    with (repository / file).open("a") as stream:
        stream.write(text)


@pytest.mark.long
def test_a_result_of_the_same_code_holds(freshness, repository):
    result = {"commit": commit_of(repository)}
    assert all(freshness.changes(pattern.replace("*", "x"), result) == () for pattern in freshness.MAKERS)


@pytest.mark.parametrize("text", ["\n# a remark\n", '\n"""What is said."""\n'])
def test_what_is_only_read_changes_no_result(freshness, repository, text):
    add(repository, REFINEMENT, text)
    assert freshness.changes("jaws_half", {"commit": commit_of(repository)}) == ()


@pytest.mark.long
def test_a_module_that_is_moved_changes_no_result(freshness, repository):
    """Its folder, its name and all that import it."""
    moved = repository / "src/cuspid/mvs/depth_refinement.py"
    (repository / REFINEMENT).rename(moved)
    for path in [*repository.rglob("*.py")]:
        path.write_text(path.read_text().replace("cuspid.mvs.refinement", "cuspid.mvs.depth_refinement"))
    result = {"commit": commit_of(repository)}
    assert freshness.changes("measure", result) == ()
    assert freshness.changes("stereo_pairs", result) == ()
    moved.write_text(moved.read_text() + "\nNEW = 1\n")
    forget(freshness)
    assert str(moved.relative_to(repository)) in freshness.changes("stereo_pairs", result)


def test_a_script_that_a_benchmark_starts_has_a_part_in_its_result(freshness, repository):
    add(repository, "benchmarks/staged.py", "\nNEW = 1\n")
    result = {"commit": commit_of(repository)}
    assert freshness.changes("qualities", result) == ("benchmarks/staged.py",)
    assert freshness.changes("live", result) == ()


def test_a_change_ends_what_it_made_and_nothing_else(freshness, repository):
    add(repository, REFINEMENT, "\nNEW = 1\n")
    result = {"commit": commit_of(repository)}
    for name in ("jaws_half", "molar-seed0", "fuzz", "stereo_pairs"):
        assert freshness.changes(name, result) == (REFINEMENT,)
    for name in ("mouth", "populations", "measure"):
        assert freshness.changes(name, result) == ()


def test_what_only_plain_surfaces_need_ends_only_their_results(freshness, repository):
    add(repository, "src/cuspid/mvs/glare.py", "\nNEW = 1\n")
    result = {"commit": commit_of(repository)}
    assert freshness.changes("enamel", result) == freshness.changes("fuzz", result) == ("src/cuspid/mvs/glare.py",)
    for name in ("jaws_half", "molar-seed0", "stereo_pairs"):
        assert freshness.changes(name, result) == ()


def test_pictures_and_pages_are_no_part_of_figures(freshness, repository):
    add(repository, "src/cuspid/report/figures/drawing.py", "\nNEW = 1\n")
    add(repository, "benchmarks/page.py", "\nNEW = 1\n")
    assert freshness.changes("molar-seed0", {"commit": commit_of(repository)}) == ()


def test_scripts_of_one_another_count(freshness, repository):
    add(repository, "benchmarks/run.py", "\nNEW = 1\n")
    assert freshness.changes("jaws_half", {"commit": commit_of(repository)}) == ("benchmarks/run.py",)


def test_every_scan_of_a_result_tells_of_its_own_code(freshness, repository):
    old = commit_of(repository)
    add(repository, REFINEMENT, "\nNEW = 1\n")
    subprocess.run(
        ["git", "-C", str(repository), "-c", "user.name=n", "-c", "user.email=e@x.org", "commit", "-qam", "new"],
        check=True,
    )
    new = commit_of(repository)
    scans = {"a": {"commit": new}, "b": {"commit": old}}
    assert freshness.changes("jaws_half", {"commit": new, "scans": scans}) == (REFINEMENT,)
    assert freshness.changes("jaws_half", {"commit": new, "scans": {"a": scans["a"]}}) == ()


@pytest.mark.parametrize("commit", [None, "0123456789ab-dirty", "0123456789ab"])
def test_code_that_nobody_has_is_no_code_of_a_result(freshness, repository, commit):
    assert freshness.changes("molar-seed0", {"commit": commit})


def of_release(freshness, results: dict) -> dict:
    return {name: result for name, result in results.items() if freshness.maker_of(name).release}


def test_every_result_has_a_maker_and_a_place_on_a_page(freshness):
    page = import_module("page")
    results = page.read(ROOT / "benchmarks" / "results")
    release = of_release(freshness, results)
    others = {name: result for name, result in results.items() if name not in release}
    for write, chosen in ((page.benchmarks, release), (page.experiments, others)):
        text = write(chosen, {})
        for name, result in chosen.items():
            assert str(result["commit"]) in text, name
        assert "older code" not in text
        shown = write(chosen, dict.fromkeys(results, ("src/a.py", "src/b.py", "src/c.py", "src/d.py")))
        assert f"0 of {len(chosen)} results hold" in shown
        assert "`src/a.py`, `src/b.py`, `src/c.py` and 1 more" in shown
        assert ("| molar-seed0 (older code) |" in shown) == (chosen is release)


def test_results_of_older_code_are_refused_unless_asked_for(freshness, monkeypatch, tmp_path):
    """Commits do not matter by themselves: most change nothing that makes a result."""
    page = import_module("page")
    older = {"kill": ("src/a.py",)}
    (tmp_path / "benchmarks" / "results").mkdir(parents=True)
    (tmp_path / "docs").mkdir()
    for name, commit in {"molar-seed0": "0123456789ab", "kill": "ba9876543210"}.items():
        result = json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text()) | {"commit": commit}
        (tmp_path / "benchmarks" / "results" / f"{name}.json").write_text(json.dumps(result))
    monkeypatch.setattr(page, "HERE", tmp_path / "benchmarks")
    monkeypatch.setattr(page, "changes", lambda name, _: older.get(name, ()))
    monkeypatch.setattr("sys.argv", ["page.py"])
    with pytest.raises(SystemExit, match=r"kill: src/a\.py\n1 of 2 results no longer hold"):
        page.main()
    assert not list((tmp_path / "docs").iterdir())
    monkeypatch.setattr("sys.argv", ["page.py", "--older"])
    page.main()
    assert "**1 of 2 results hold" in (tmp_path / "docs" / "benchmarks.md").read_text()
    older.clear()
    monkeypatch.setattr("sys.argv", ["page.py"])
    page.main()
    assert "All 2 results hold" in (tmp_path / "docs" / "benchmarks.md").read_text()


def test_a_campaign_measures_what_no_longer_holds(freshness, repository, monkeypatch, capsys):
    """At a clean commit, once; what fails, and what has not been given, is told."""
    campaign = import_module("campaign")
    describe = '["git", "describe", "--always", "--dirty", "--abbrev=12"]'
    add(
        repository,
        "benchmarks/toy.py",
        f'"""Tell the commit."""\n\nimport json\nimport subprocess\nimport sys\nfrom pathlib import Path\n\n'
        f"commit = subprocess.check_output({describe}, text=True).strip()\n"
        'Path(sys.argv[-1]).write_text(json.dumps({"commit": commit}))\n',
    )
    add(repository, "benchmarks/broken.py", "raise SystemExit(3)\n")
    for command in (("add", "."), ("-c", "user.name=n", "-c", "user.email=e@x.org", "commit", "-qm", "toys")):
        subprocess.run(["git", "-C", str(repository), *command], check=True)
    results = repository / "benchmarks" / "results"
    results.mkdir()
    toys = [("mouth", "toy.py {out}"), ("precision", "broken.py {out}"), ("measure", "toy.py {jaws} {out}")]
    monkeypatch.setattr(campaign, "ROOT", repository)
    monkeypatch.setattr(campaign, "RESULTS", results)
    monkeypatch.setattr(campaign, "BENCHMARKS", [campaign.Benchmark(*each) for each in toys])
    compiled: list[Path] = []  # a scan of some minutes, of which nothing here is measured
    monkeypatch.setattr(campaign, "compile_all", compiled.append)
    monkeypatch.setattr("sys.argv", ["campaign.py", "--work", str(repository / "work")])
    campaign.main()
    assert [(each / "checkout").is_dir() for each in compiled] == [True]
    said = capsys.readouterr().out
    assert "mouth: 0.0 min\n" in said
    assert "precision: 0.0 min, failed, see " in said
    assert "measure: left out, needs --jaws\n" in said
    assert json.loads((results / "mouth.json").read_text()) == {"commit": commit_of(repository), "campaign_min": 0.0}
    assert not (results / "precision.json").exists()
    campaign.main()
    assert "mouth: holds\n" in capsys.readouterr().out


def test_the_page_tells_at_which_commits_it_was_measured_and_how_long_that_took(freshness):
    page = import_module("page")
    results = {name: {"commit": "0123456789ab", "campaign_min": minutes} for name, minutes in (("a", 90), ("b", 12))}
    assert page.measured_at(results) == "They were measured at commit 0123456789ab, in 1.7 h in all."
    assert page.measured_at({**results, "c": {"commit": "ba9876543210"}}) == (
        "They were measured at commits 0123456789ab, ba9876543210."
    )


def test_for_a_release_only_what_no_longer_holds_is_measured(freshness, repository, monkeypatch, capsys):
    campaign = import_module("campaign")
    commits = {"molar-seed0": commit_of(repository), "kill": "0123456789ab", "mouth": "0123456789ab"}
    results = repository / "benchmarks" / "results"
    results.mkdir()
    for name, commit in commits.items():
        (results / f"{name}.json").write_text(json.dumps({"commit": commit}))
    add(repository, "CHANGELOG.md", "Something else.\n")
    for command in (("add", "."), ("-c", "user.name=n", "-c", "user.email=e@x.org", "commit", "-qm", "else")):
        subprocess.run(["git", "-C", str(repository), *command], check=True)
    monkeypatch.setattr(campaign, "ROOT", repository)
    monkeypatch.setattr(campaign, "RESULTS", results)
    monkeypatch.setattr(campaign, "BENCHMARKS", [campaign.Benchmark(name, "toy.py") for name in commits])
    monkeypatch.setattr("sys.argv", ["campaign.py", "--release", "--list"])
    campaign.main()
    assert capsys.readouterr().out == "molar-seed0: holds\nkill: would be measured\n"


@pytest.mark.parametrize(("alone", "several", "cores"), [(10.0, 5.0, 2), (10.0, 8.0, 2), (12.0, 4.0, 4), (3.0, 3.0, 2)])
def test_what_is_foretold_is_what_was_measured_where_that_was(freshness, alone, several, cores):
    sections = import_module("trust_sections")
    share = sections.parallel_share(alone, several, cores)
    assert sections.foretold(alone, share, 1) == alone
    assert sections.foretold(alone, share, cores) == pytest.approx(several)
    assert sections.foretold(alone, share, 10**9) >= alone - (alone - several) * cores / (cores - 1) - 1e-6
    assert sections.parallel_share(alone, 1.1 * alone, cores) == 0


@pytest.mark.parametrize(
    ("wall_s", "cpu_s", "told"), [(40, 70, "40"), (60, 90, "**60** (missed)"), (60, 50, "60 (shared)")]
)
def test_no_wall_time_of_a_shared_machine_is_judged(freshness, wall_s, cpu_s, told):
    assert import_module("panorama_sections").wall({"wall_s": wall_s, "cpu_s": cpu_s}) == told


@pytest.mark.parametrize(("value", "told"), [(-2.0, "-2.0"), (2.04, "**+2.0** (missed)"), (-3.0, "**-3.0** (missed)")])
def test_a_figure_is_within_its_limit_on_both_sides(freshness, value, told):
    assert import_module("panorama_sections").within(value, 2.0, 1) == told


def test_a_path_is_counted_by_its_films_and_those_without_an_arch_are_within_no_limit(freshness):
    def film(subject, median_mm, scale_pct, complete=True):
        geometry = {"median_mm": median_mm, "p95_mm": 3 * median_mm, "scale_error_pct": scale_pct}
        return {"subject": subject, "score": {"geometry": geometry, "complete": complete}}

    one_pass = [film("a", 0.3, 5.0), film("b", 0.05, 5.0), film("c", 0.4, 5.0)]
    swung = [film("a", 0.1, -2.0), film("b", 0.15, 3.0, complete=False), {"subject": "c", "score": None}]
    row = import_module("panorama_sections").path_row("s-shape", swung, {each["subject"]: each for each in one_pass})
    assert row == ["`s-shape`", "3", "0.12 (0.10-0.15)", "0.38 (0.30-0.45)", "1", "2", "1", "1", "1 of 2"]


def test_the_page_begins_with_real_photographs_misses_included(freshness):
    page = import_module("page")
    results = page.read(ROOT / "benchmarks" / "results")
    lines = page.benchmarks(of_release(freshness, results), {}).splitlines()
    table = next(k for k, line in enumerate(lines) if line.startswith("|"))
    assert [line for line in lines[:table] if line.startswith("## ")] == ["## Real photographs"]
    assert "(missed)" in "\n".join(lines[table : lines.index("", table)])


# --- figures that people quote ----------------------------------------------------------------------------------------


def test_pages_quote_what_the_results_say(freshness, monkeypatch):
    monkeypatch.setattr("sys.argv", ["quoted.py", "--check"])
    import_module("quoted").main()


QUOTED = {"mean {} µm, {} s\nfor {};": ["tooth-*: found/mean .1f", "tooth-a: s .0f * 60", "tooth-*: found/mean <= 2"]}
RESULTS = {"tooth-a": {"found": {"mean": 1.04}, "s": 2}, "tooth-b": {"found": {"mean": -1.96}}, "arch": {"s": 7}}


def test_figures_are_put_into_a_page_wherever_its_lines_are_broken(freshness):
    quoted = import_module("quoted")
    page = "It is mean 9 µm, 8\ns for good; 7 of 6.\n"
    assert quoted.with_figures(page, QUOTED, RESULTS) == "It is mean 1.0-2.0 µm, 120\ns for met; 7 of 6.\n"
    worse = RESULTS | {"tooth-b": {"found": {"mean": -2.04}}}
    assert "for missed;" in quoted.with_figures(page, QUOTED, worse)


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("a: x/*/y .1f median", "3.0"),
        ("a: x/*/y .1f max", "8.0"),
        ("a: x/*/y .2f rms", "4.97"),
        ("a: x/p/y & a: x/q/y .0f", "1-3"),
        ("a: x/r/y .0f", "8"),
        ("a: x/r/y .1e * 0.01", "8.0e-02"),
        ("a: x/*/y ,.0f mean * 1000", "4,000"),
        ("a: x/*/y .2f sd", "3.61"),
        ("a: x/*/of=q/y +.0f", "-3"),
        ("a: x/r/0/y .0f", "8"),
        ("a: x/q/row/1 .0f", "5"),
        ("a: x/s .0f", "2-6"),
        ("a: x/*/y <= 3 count", "2"),
        ("a: x/*/y >= 1 and a: x/r/y <= 8", "met"),
        ("a: x/*/y >= 1 and a: x/r/y <= 7.9", "missed"),
    ],
)
def test_what_a_source_says(freshness, source, told):
    results = {
        "a": {"x": {"p": {"y": 1}, "q": {"y": -3, "of": "q", "row": "4 5"}, "r": [{"y": 8}, {"y": None}], "s": [2, 6]}}
    }
    for page in ("so 9.99.", f"so {told}."):
        assert import_module("quoted").with_figures(page, {"so {}.": [source]}, results) == f"so {told}."


@pytest.mark.parametrize(
    ("page", "changed", "said"),
    [
        ("nothing", {}, "0 times on the page"),
        ("a 1; a 2;", {}, "2 times on the page"),
        ("a 1;", {"a {};": ["b: x .1f"]}, "no result has b: x"),
        ("a 1;", {"a {};": ["a: z .1f"]}, "no result has a: z"),
        ("a 1;", {"a {};": ["a: word .1f"]}, "no result has a: word"),
        ("a 1;", {"a {};": ["a: x"]}, "neither a figure nor a bar"),
        ("a 1;", {"a {};": []}, "0 sources"),
        ("a 1;", {"a {}": ["a: x .1f"]}, "words at its end"),
        ("| h |\n|---|\n| a 1; |\n| words |\n| b 2; |\n", {}, "| b 2; |: not in quoted.toml"),
        ("a 1; and 3 µm", {}, "... and 3 µm (3 µm): measured, but neither"),
        ("a 1; at commit 12345ab\n- 3\n  µm\n", {}, "- 3 µm (3 µm): measured, but neither"),
        ("a 1;\n\n| b | s |\n|---|---|\n| c | 3 |\n", {}, "| b | s | |---|---|"),
        ("a 1;\n<!-- given -->\n## B\n3 s\n### C\n4 s\n## D\n5 s\n", {}, "5 s (5 s): measured"),
        ("a 1;\n<!-- given -->\n3 s\n\n4 s\n", {}, "4 s (4 s): measured"),
        ("a 1;\n\n<!-- given --> 3 s\n", {}, "3 s (3 s): measured"),
    ],
)
def test_a_figure_without_a_result_is_refused(freshness, page, changed, said):
    quoted = import_module("quoted")
    with pytest.raises(quoted.WrongFigureError) as caught:
        quoted.with_figures(page, changed or {"a {};": ["a: x .1f"]}, {"a": {"x": 1, "word": "1"}})
    assert said in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "3 µm, commit 12345ab",
        "3 % off (`tests/room/test_it.py`)",
        "At commit 12345ab:\n\n| b | s |\n|---|---|\n| c | 3 |\n",
        "## B\n\n3 words, `--option 3 s`\n\n```sh\nrun 3 s\n```",
        "3 s <!-- given -->",
        "<!-- given -->\n## B\n3 s\n\n| b | s |\n|---|---|\n| c | 3 |\n",
    ],
)
def test_a_figure_that_is_dated_or_given_needs_no_result(freshness, text):
    page = f"a 1;\n\n{text}\n"
    assert import_module("quoted").with_figures(page, {"a {};": ["a: x .0f"]}, {"a": {"x": 1}}) == page
