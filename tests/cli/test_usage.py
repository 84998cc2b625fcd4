"""The help of the verbs, and their options as TOML."""

from __future__ import annotations

import re
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path

import pytest

from cuspid import cli
from cuspid.cli.config import options_of, read_config
from cuspid.cli.verbs import DROPPED_OPTIONS, LIMITS, RENAMED, RENAMED_OPTIONS
from documents import ROOT
from verbs import refused, run

VERBS = sorted(set(cli.COMMANDS) - {"reproduce"})
OLD = [line.split(": ") for line in (ROOT / "tests/support/options-of-0.2.txt").read_text().splitlines()]
"""Verbs of version 0.2, and options that they all had, as its parser told them; also of the kinds of ``prepare``."""
NEGATED = re.compile(r"(?<![^.])no-")


@cache
def help_of(*words: str) -> str:
    printed = StringIO()
    with pytest.raises(SystemExit) as caught, redirect_stdout(printed):
        run(*words)
    assert caught.value.code == 0
    return printed.getvalue()


def options_in(printed: str) -> list[str]:
    return re.findall(r"^(?:│ |  )(?:-\w, )?--(\w[\w.-]*)", printed, re.MULTILINE)


@pytest.mark.parametrize("verb", VERBS)
def test_the_help_shows_what_people_need_and_all_of_it_on_demand(verb: str) -> None:
    short, every = help_of(*verb.split(), "--help"), help_of(*verb.split(), "--help-all")
    few, many = set(options_in(short)) - {"help"}, set(options_in(every)) - {"help"}
    assert len(few) <= 25
    assert few <= many
    assert not [name for name in few if "." in name]
    assert {name.rpartition(".")[2] for name in options_of(cli.COMMANDS[verb])} <= {
        name.rpartition(".")[2].removeprefix("no-") for name in many
    }
    assert "default: None" not in short + every
    first = (cli.COMMANDS[verb].__doc__ or "").split(".")[0].split()[:3]
    assert " ".join(first) in short


@pytest.mark.parametrize("verb", ["run", "study repeat", "pano stitch", "rig visibility"])
def test_settings_written_and_read_are_the_same(tmp_path: Path, verb: str) -> None:
    """Whatever was given: what a file tells is what is written again."""
    given = {"out": "a", "study repeat": ("--scans", 3), "run": ("--stereo.spacing-px", 2, "--evaluation.no-align")}
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    run(*verb.split(), "--out", "a", *given.get(verb, ()), "--write-config", first)
    run(*verb.split(), "--config", first, "--write-config", second)
    assert first.read_text().splitlines()[1:] == second.read_text().splitlines()[1:]
    assert f"--config {first.name}" in first.read_text().splitlines()[0]
    if verb == "run":
        assert "stereo.spacing-px = 2\n" in first.read_text()
        assert "evaluation.align = false\n" in first.read_text()


def test_what_is_typed_after_a_file_wins(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text('quality = "fine"\nseed = 3\n[stereo]\nspacing_px = 2\n')
    run("run", "--config", tmp_path / "a.toml", "--seed", 4, "--out", "a", "--write-config", tmp_path / "b.toml")
    lines = (tmp_path / "b.toml").read_text().splitlines()
    assert {'quality = "fine"', "seed = 4", "stereo.spacing-px = 2"} <= set(lines)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('qualty = "fine"\n', "run has no option qualty; did you mean quality?"),
        ("xyzxyz = 1\n", "cuspid run --help-all lists its options"),
        ("quality fine\n", "not valid TOML"),
        (f"quality = {'[' * 20_000}\n", "not valid TOML"),
        ('quality = "fin"\n', "a.toml: quality is 'fin', which is not allowed; cuspid run --help-all"),
        ('[stereo]\nspacing-px = "two"\n', "a.toml: stereo.spacing-px is 'two', which is not allowed"),
        ("seed = [1, 2]\n", "a.toml: seed is [1, 2]"),
        ('seed = "--help"\n', "a.toml: seed is '--help'"),
    ],
)
def test_settings_that_are_not_understood_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    (tmp_path / "a.toml").write_text(text)
    assert said in refused(capsys, "run", "--config", tmp_path / "a.toml", "--out", tmp_path / "out", alone=True)
    assert not (tmp_path / "out").exists()


def test_a_file_of_distances_gives_each_of_them(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("distance = [[3, 4, 36, 22, 40.0], [1, 2, 3, 4, 5.0]]\n")
    command, file = cli.COMMANDS["pano rescale"], str(tmp_path / "a.toml")
    found = read_config("pano rescale", command, ["pano", "--config", file])
    assert " ".join(found) == "pano --distance 3 4 36 22 40.0 --distance 1 2 3 4 5.0"


@pytest.mark.parametrize("given", ["--config", "--write-config"])
def test_a_file_is_named(capsys: pytest.CaptureFixture[str], given: str) -> None:
    assert "name a file" in refused(capsys, "run", given)


@pytest.mark.parametrize(
    ("old", "new"), [("phantom", "jaw phantom"), ("stitch-eval", "pano evaluate"), ("handpiece", "rig build")]
)
def test_old_names_tell_the_new_ones(capsys: pytest.CaptureFixture[str], old: str, new: str) -> None:
    with pytest.raises(SystemExit) as caught:
        run(old, "--out", "x")
    assert caught.value.code == 2
    assert f"{old} is now called {new}" in capsys.readouterr().err


@pytest.mark.parametrize("old", sorted({verb for verbs, _ in OLD for verb in verbs.split(", ")}))
def test_an_option_of_version_02_is_taken_or_tells_its_successor(capsys: pytest.CaptureFixture[str], old: str) -> None:
    """As far as the real parser's own help lists what it takes."""
    verb, *kind = old.split()
    words = [*RENAMED.get(verb, verb).split(), *kind]
    taken = {re.sub(NEGATED, "", name) for name in options_in(help_of(*words, "--help-all"))}
    had = [name for verbs, names in OLD if old in verbs.split(", ") for name in names.split()]
    assert len(had) == len(set(had)) > 0
    for name in had:
        if re.sub(NEGATED, "", name) not in taken:
            said = refused(capsys, *words, f"--{name}=3", alone=True)
            told = re.fullmatch(rf"cuspid: [a-z ]+: --{name} is now called --([\w.-]+)", said)
            dropped = f"--{name} of version 0.2 was dropped: "
            assert re.sub(NEGATED, "", told[1]) in taken if told else dropped in said, said


@pytest.mark.parametrize("verb", VERBS)
def test_no_option_has_a_name_of_version_02(verb: str) -> None:
    parts = "|".join(map(re.escape, [*RENAMED_OPTIONS, *DROPPED_OPTIONS]))
    old = re.compile(rf"(^|\.)(({'|'.join(LIMITS)})-[\w-]*$|({parts})(\.|$))")
    assert not [name for name in options_of(cli.COMMANDS[verb]) if old.search(name)]


def test_the_page_on_version_02_tells_the_successors_of_options() -> None:
    page = (ROOT / "docs/from-0.2.md").read_text()
    rows = re.findall(r"^\| `(?:[a-z ]+ )?--([\w.-]+?)(?:\.…)?` \| (.+?) \|$", page, re.MULTILINE)
    expected = {old: f"--{new}" for old, new in RENAMED_OPTIONS.items()}
    expected |= {old: f"dropped: {instead}" for old, instead in DROPPED_OPTIONS.items()}
    assert {old: re.sub(r"`|\.….*", "", said) for old, said in rows} == expected
    assert all(f"`{old}-`" in page for old in LIMITS)


def test_a_group_lists_its_verbs(capsys: pytest.CaptureFixture[str]) -> None:
    run("jaw", "--help")
    printed = capsys.readouterr().out
    assert "jaw phantom" in printed
    assert "rig build" not in printed
