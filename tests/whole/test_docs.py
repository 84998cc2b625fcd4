"""The documentation says nothing that does not work: its commands are read by the real parser, those of the tutorial
and of the how-to pages run as they stand there, and every verb and every module has its page."""

import ast
import functools
import importlib
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import pytest

from cuspid import cli, storage
from cuspid.model.pairing import stereo_pairs
from cuspid_thesis.scan_cases import scan_cases
from documents import ROOT, Block, blocks, commands, mentions, pages, words

RUN = ["tutorial.md", *(f"how-to/{path.name}" for path in sorted((ROOT / "docs/how-to").glob("*.md")))]
"""Pages whose commands run, each page in a folder of its own, in their order."""
WHOLE = ["mouth.md", "optics.md"]
"""Further pages whose Python needs nothing that is not on the page, and no more than seconds."""
SHELL = ("sh", "bash", "console")
NOT_PYTHON = ("", "sh", "bash", "console", "toml", "json", "text", "math", "{toctree}")


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.fixture
def parsed(monkeypatch):
    """Verbs that only have their arguments read."""
    seen = []

    def stub(verb):
        @functools.wraps(verb)
        def remember(*args, **kwargs):
            seen.append(verb)

        return remember

    monkeypatch.setattr(cli, "COMMANDS", {verb: stub(command) for verb, command in cli.COMMANDS.items()})
    return seen


def refused(arguments: list[str], capsys) -> str | None:
    """What the parser says against a command."""
    try:
        cli.main(arguments)
    except SystemExit:
        return capsys.readouterr().err
    return None


@pytest.mark.long
@pytest.mark.parametrize("page", pages(), ids=name)
def test_the_parser_takes_every_command(page, parsed, capsys):
    found = list(commands(page))
    complaints = {place: said for place, arguments in found if (said := refused(arguments, capsys)) is not None}
    assert not complaints
    assert len(parsed) == len(found)
    assert not [place for place, arguments in mentions(page) if not is_understood(arguments, capsys)]


def is_understood(arguments: list[str], capsys) -> bool:
    """Whether nothing is wrong with a command but what it leaves out."""
    said = refused(arguments, capsys)
    return said is None or ("Missing from" in said and "Unrecognized" not in said)


@pytest.mark.long
def test_every_command_of_version_02_works_or_tells_its_successor(parsed, capsys):
    """Those of its README, one a line; the page on what has changed lists the successors."""
    page, makefile = (ROOT / "docs/from-0.2.md").read_text(), (ROOT / "Makefile").read_text()
    given = [shlex.split(line) for line in (ROOT / "tests/support/commands-of-0.2.txt").read_text().splitlines()]
    verbs = [arguments for program, *arguments in given if program == "cuspid"]
    for arguments in verbs:
        said = refused(arguments, capsys)
        if said is not None:
            (answer,) = said.splitlines()
            successor = re.search(rf"{arguments[0]} is now called ([a-z ]+):", answer)[1]
            assert f"| `{arguments[0]}` | `{successor}`" in page
            assert refused([*successor.split(), *arguments[1:]], capsys) is None, answer
    assert len(parsed) == len(verbs) > 30
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for program, target, *_ in given if program == "make")


def commands_of_benchmarks(monkeypatch, folder: Path) -> list[list[str]]:
    """Those of the scans that are measured, and of the runs that are killed."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    kill, made = importlib.import_module("kill"), []
    monkeypatch.setattr(kill, "cuspid", lambda *arguments: made.append(list(arguments)))
    kill.prepare(folder)
    killed = [[*arguments, "--out", "out"] for arguments in kill.verbs(folder).values()]
    scanned = [
        arguments
        for case in scan_cases(Path("jaw.ply")).values()
        for arguments in ([*case.make, "--out", "jaw.ply"], ["simulate", *case.simulate, "--out", "scan"])
        if arguments[0] != "--out"
    ]
    return made + killed + scanned


def test_the_parser_takes_every_command_of_the_benchmarks(parsed, capsys, monkeypatch, tmp_path):
    found = commands_of_benchmarks(monkeypatch, tmp_path)
    complaints = {" ".join(arguments): said for arguments in found if (said := refused(arguments, capsys)) is not None}
    assert not complaints
    assert len(parsed) == len(found) > 20


@pytest.mark.parametrize("wrong", ["run --tooht 46 --out scan/", "scan --out scan/", "run --tooth six --out scan/"])
def test_the_parser_refuses_what_does_not_exist(wrong, parsed, capsys):
    assert refused(wrong.split(), capsys)
    assert not parsed


def test_a_mention_may_be_incomplete_but_not_wrong(parsed, capsys):
    assert is_understood(["run", "--tooth", "46"], capsys)
    assert not is_understood(["run", "--tooht", "46"], capsys)


def test_commands_are_found_wherever_they_stand(tmp_path, monkeypatch):
    monkeypatch.setattr("documents.ROOT", tmp_path)
    page = tmp_path / "page.md"
    page.write_text(
        "Text `cuspid run --out a/` text, `cuspid run` text.\n\n    cuspid jaw shape JAWS/ --out b/   # comment\n\n"
        "<!-- not run: why -->\n```sh\n$ cuspid run \\\n    --out c/\nls\n```\n\n```sh\ncuspid rig optics\n```\n"
    )
    found = [" ".join(words) for _, words in commands(page)]
    assert found == ["jaw shape JAWS/ --out b/", "run --out c/", "rig optics"]
    assert [" ".join(words) for _, words in mentions(page)] == ["run --out a/"]
    assert [block.run for block in blocks(page)] == [True, False, True]


@pytest.mark.documentation
@pytest.mark.parametrize("page", RUN)
def test_the_commands_of_a_page_run(page, tmp_path, monkeypatch, phantom_file):
    """In their order, in an empty folder; a how-to page has ``jaw.ply``, as it says."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    if page != "tutorial.md":
        for suffix in (".ply", ".json"):
            shutil.copy(phantom_file.with_suffix(suffix), f"jaw{suffix}")
    done = [line for block in blocks(ROOT / "docs" / page) for line in follow(block)]
    assert any(line.startswith("cuspid") for line in done)


def follow(block: Block) -> list[str]:
    """Do what a block says: run its commands or its Python, or write the brief that it shows."""
    if block.language == "toml":
        Path("brief.toml").write_text(block.text)
    if block.language == "python":
        execute(block)
    if block.language not in SHELL or not block.run:
        return []
    for line in block.lines():
        run(line)
    return list(block.lines())


def run(line: str) -> None:
    if line.startswith("cuspid "):
        cli.main(words(line))
        return
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, env={**os.environ, "PATH": path})
    assert done.returncode == 0, f"{line}: {done.stderr}"


def execute(block: Block) -> None:
    exec(compile(block.text, block.place, "exec"), {"__name__": "page"})


@pytest.mark.parametrize("page", WHOLE)
def test_python_that_is_whole_runs(page):
    found = [block for block in blocks(ROOT / "docs" / page) if block.language == "python"]
    assert found
    for block in found:
        execute(block)


@pytest.mark.parametrize("page", pages(), ids=name)
def test_python_on_a_page_is_python_and_imports_what_there_is(page):
    for block in blocks(page):
        assert block.language in (*NOT_PYTHON, "python"), f"{block.place}: {block.language}"
        if block.language == "python":
            check_imports(block)


def check_imports(block: Block) -> None:
    for node in ast.walk(compile(block.text, block.place, "exec", ast.PyCF_ONLY_AST)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                importlib.import_module(alias.name)
        if isinstance(node, ast.ImportFrom):
            module = importlib.import_module(node.module)
            for alias in node.names:
                there = hasattr(module, alias.name) or importlib.util.find_spec(f"{node.module}.{alias.name}")
                assert there, f"{block.place}: {node.module} has no {alias.name}"


def test_the_calibration_on_a_page_can_be_read(tmp_path):
    page = ROOT / "docs/how-to/bring-your-own-rig.md"
    (shown,) = (block.text for block in blocks(page) if block.language == "json")
    (tmp_path / "handpiece.json").write_text(shown)
    rig = storage.read_handpiece(tmp_path / "handpiece.json").rig
    assert stereo_pairs(rig, 6.0) == (("left", "right"),)
    assert 0.7 < rig.overlap("left", "right", 6.0) < 0.8


def test_every_verb_is_documented():
    shown = {cli.split_verb(arguments)[0] for page in pages() for _, arguments in commands(page)}
    assert set(cli.COMMANDS) <= shown


def test_the_command_line_has_a_page_for_every_verb(monkeypatch):
    command_pages = generator("command_pages", monkeypatch)
    found = command_pages.pages()
    assert set(found) == {"index.rst", *(f"{verb.replace(' ', '-')}.rst" for verb in cli.COMMANDS)}
    for verb, command in cli.COMMANDS.items():
        text = found[f"{verb.replace(' ', '-')}.rst"]
        assert f".. program:: cuspid {verb}" in text
        assert all(argument in text.replace("-", "_") for argument in own_options(command)), verb
    assert ".. program:: cuspid jaw prepare crown" in found["jaw-prepare.rst"]
    assert ".. option:: --taper-deg FLOAT" in found["jaw-prepare.rst"]
    assert all(command_pages.summary(command).endswith(".") for command in cli.COMMANDS.values())
    assert "*(default: 46 41)*" in found["rig-design.rst"]
    assert "--noise.…" in found["rig-design.rst"]


def own_options(command) -> list[str]:
    """Arguments of a verb that are plain values."""
    plain = (str, int, int | None, float, float | None, bool, str | None)
    return [name for name, hint in get_type_hints(command).items() if hint in plain]


@pytest.mark.long
def test_every_public_module_has_its_docstrings_on_a_page(monkeypatch):
    module_pages = generator("module_pages", monkeypatch)
    text = "\n".join(module_pages.pages().values())
    shown = {line.split()[-1] for line in text.splitlines() if line.startswith(".. automodule::")}
    source = ROOT / "src"
    files = {path.relative_to(source).with_suffix("") for path in (source / "cuspid").rglob("*.py")}
    dotted = {".".join(path.parts).removesuffix(".__init__") for path in files}
    assert dotted - shown == set(module_pages.SCRIPTS)
    assert all(module_pages.public_modules().values()), "a module without a docstring"


def generator(module: str, monkeypatch):
    """A module of the site's own, that writes pages."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return importlib.import_module(f"_site.{module}")
