"""Change single places of the code, and see whether the quick tests of their room fail.

    python benchmarks/mutation.py [--mutants 3] [--seed 0] [--only ROOM ...] [--work build/mutation]

In each room of ``src/cuspid`` and in the reproduction, places in the bodies of functions are drawn by the seed: a
comparison is turned round, + and - or * and / are exchanged, a sign or a ``not`` is dropped, ``and`` and ``or`` are
exchanged, a number grows by a tenth (a whole one by 1). The room's tests of ``make test``, and then those of other
rooms that import the module, run in a copy of the project until one fails. Writes benchmarks/results/mutation.json
after each room; other rooms in it are kept. Mutants that no test can tell from the code, as was found by reading, are
named with the reason in mutation_equivalent.toml.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from run import conditions

from cuspid.storage import read_json, write_json

HERE = Path(__file__).parent
ROOT = HERE.parent
ROOMS: Mapping[str, tuple[str, str]] = {
    **{
        folder.name: (f"src/cuspid/{folder.name}", f"tests/{folder.name}")
        for folder in sorted((ROOT / "src/cuspid").iterdir())
        if (folder / "__init__.py").exists()
    },
    "thesis": ("reproduction/src/cuspid_thesis", "reproduction/tests"),
}
"""Folders of the code and of its tests."""
QUICK = ("-m", "not documentation and not long", "-x", "-p", "no:cacheprovider")
LONGEST_S = 300.0
"""Of the tests of a room: a mutant that never ends fails them, too."""
_COMPARISONS: Mapping[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.Gt,
    ast.Gt: ast.Lt,
    ast.LtE: ast.GtE,
    ast.GtE: ast.LtE,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_OPERATORS: Mapping[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}
_TEXT = (ast.JoinedStr, ast.List, ast.Tuple)
"""What is joined by + and repeated by *."""


@dataclass(frozen=True)
class Mutant:
    """One place of a file, and what stands there instead."""

    file: str
    line: int
    begin: int
    """Bytes of the file before the place."""
    end: int
    was: str
    becomes: str
    code: str
    """The line on which the place begins."""

    @property
    def name(self) -> str:
        """For people, and for mutation_equivalent.toml: it lasts while lines only move within their file."""
        return f"{self.file}: {self.was} -> {self.becomes} in {self.code}"

    def apply(self, source: bytes) -> bytes:
        """The file with the other text."""
        return source[: self.begin] + self.becomes.encode() + source[self.end :]


def mutants_of(root: Path, folder: str) -> list[Mutant]:
    """All of a room."""
    return [
        mutant
        for path in sorted((root / folder).rglob("*.py"))
        for mutant in sorted(
            _in_source(str(path.relative_to(root)), path.read_bytes()), key=lambda each: (each.begin, each.end)
        )
    ]


def _in_source(file: str, source: bytes) -> Iterator[Mutant]:
    lines = source.splitlines(keepends=True)
    starts = np.cumsum([0, *map(len, lines)])
    for node in _in_functions(ast.parse(source)):
        changed = _changed(node)
        if changed is None:
            continue
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin = int(starts[node.lineno - 1]) + node.col_offset
        end = int(starts[node.end_lineno - 1]) + node.end_col_offset
        becomes = f"({ast.unparse(changed)})"  # what is around may bind more strongly, and a line must not end within
        code = lines[node.lineno - 1].decode().strip()
        yield Mutant(file, node.lineno, begin, end, ast.unparse(node), becomes, code)


def _in_functions(tree: ast.AST, inside: bool = False) -> Iterator[ast.expr]:
    """Expressions in bodies of functions, but for annotations and for what an error says."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef):
            for statement in node.body:
                yield from _in_functions(ast.Module([statement], []), inside=True)
        elif isinstance(node, ast.AnnAssign):
            if inside and node.value is not None:
                yield from _in_functions(ast.Expr(node.value), inside)
        elif not isinstance(node, ast.Raise | ast.JoinedStr | ast.MatchValue):
            if inside and isinstance(node, ast.expr):
                yield node
            yield from _in_functions(node, inside)


def _changed(node: ast.expr) -> ast.expr | None:
    """The other expression; None where there is none."""
    match node:
        case ast.Compare(left=left, ops=[only], comparators=right):
            return ast.Compare(left, [_COMPARISONS[type(only)]()], right)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS and not (_text(left) or _text(right)):
            return ast.BinOp(left, _OPERATORS[type(op)](), right)
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            return operand
        case ast.BoolOp(op=ast.And(), values=values):
            return ast.BoolOp(ast.Or(), values)
        case ast.BoolOp(op=ast.Or(), values=values):
            return ast.BoolOp(ast.And(), values)
        case ast.Constant(value=bool(value)):
            return ast.Constant(not value)
        case ast.Constant(value=int(value)):
            return ast.Constant(value + 1)
        case ast.Constant(value=float(value)) if value:
            return ast.Constant(float(f"{1.1 * value:.12g}"))
    return None


def _text(node: ast.expr) -> bool:
    return isinstance(node, _TEXT) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def draw(mutants: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """Some of them; with a larger count the same and further ones."""
    order = np.random.default_rng(seed).permutation(len(mutants))
    return [mutants[number] for number in order[:count]]


def copy_project(to: Path) -> None:
    """What tests need, with what numba has compiled."""
    for name in ("src", "tests", "reproduction", "benchmarks", "docs", "examples"):
        shutil.rmtree(to / name, ignore_errors=True)
        shutil.copytree(ROOT / name, to / name)
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy2(path, to)


def tests_of(project: Path, room: str, file: str) -> tuple[list[Path], list[Path]]:
    """A room's files of tests: that of the module before those that name it, and these before all others; and those of
    other rooms that import it."""
    module = Path(file).stem
    folders = {name: project / tests for name, (_, tests) in ROOMS.items()} | {"whole": project / "tests/whole"}
    texts = {name: {path: path.read_text() for path in folders[name].glob("test_*.py")} for name in folders}

    def rank(path: Path) -> tuple[bool, bool, str]:
        return path.stem != f"test_{module}", re.search(rf"\b{module}\b", texts[room][path]) is None, path.name

    imported = re.compile(rf"^(?:from|import) (?:cuspid|cuspid_thesis)\b[\w.]*[ .(\w,]*\b{module}\b", re.MULTILINE)
    others = [path for name in folders if name != room for path, text in texts[name].items() if imported.search(text)]
    return sorted(texts[room], key=rank), sorted(others)


def first_failure(project: Path, *tests: str) -> str | None:
    """The first of the quick tests that fails, or what else went wrong; None where all pass."""
    paths = os.pathsep.join(str(project / each) for each in ("src", "reproduction/src"))
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "pytest", *QUICK, *tests],
            cwd=project,
            env={**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=LONGEST_S,
        )
    except subprocess.TimeoutExpired:
        return f"more than {LONGEST_S:g} s"
    if ended.returncode == 0:
        return None
    failed = re.search(r"^(?:FAILED|ERROR) (\S+(?: .*\])?)(?: - .*)?$", ended.stdout, re.MULTILINE)
    return f"status {ended.returncode} of pytest" if failed is None else failed[1]


def caught_by(project: Path, room: str, mutant: Mutant) -> str | None:
    """The first test that fails with the mutant, one of the room where there is one. Raises SystemExit where that test
    fails without the mutant, too."""
    path, failed = project / mutant.file, None
    source, before = path.read_bytes(), path.stat()
    path.write_bytes(mutant.apply(source))
    try:
        for tests in tests_of(project, room, mutant.file):
            if failed is None and tests:
                failed = first_failure(project, *map(str, tests))
    finally:
        path.write_bytes(source)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    if failed is None:
        return None
    if ".py" in failed and (still := first_failure(project, failed)) is not None:
        raise SystemExit(f"this fails without any mutant: {still}")
    return failed


def measure_room(project: Path, room: str, count: int, seed: int, equivalent: Mapping[str, str]) -> dict[str, Any]:
    """What became of the mutants of a room."""
    rows, caught = [], list[str]()
    for mutant in draw(mutants_of(project, ROOMS[room][0]), count, seed):
        why = equivalent.get(mutant.name)
        failed = None if why is not None else caught_by(project, room, mutant)
        caught += [] if failed is None else [failed]
        rows.append({"mutant": mutant.name, "line": mutant.line, "caught_by": failed, "equivalent": why})
        print(f"{room}, line {mutant.line} of {mutant.name}: {failed or why or 'SURVIVED'}", flush=True)
    return {
        "tried": sum(row["equivalent"] is None for row in rows),
        "caught": len(caught),
        "elsewhere": sum(".py" in each and not each.startswith(f"{ROOMS[room][1]}/") for each in caught),
        "commit": conditions()["commit"],
        "mutants": rows,
    }


def main() -> None:
    """Room after room."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=3, help="of each room")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", choices=ROOMS, default=tuple(ROOMS), help="rooms")
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "mutation")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "mutation.json")
    arguments = parser.parse_args()
    equivalent = tomllib.loads((HERE / "mutation_equivalent.toml").read_text())
    arguments.work.mkdir(parents=True, exist_ok=True)
    copy_project(arguments.work)
    rooms = read_json(arguments.out)["rooms"] if arguments.out.exists() else {}
    for room in arguments.only:
        rooms[room] = measure_room(arguments.work, room, arguments.mutants, arguments.seed, equivalent)
        found = {"seed": arguments.seed, "rooms": {each: rooms[each] for each in ROOMS if each in rooms}}
        write_json(arguments.out, {**found, **conditions()})
    print("\n".join(f"{room}: {row['caught']} of {row['tried']} caught" for room, row in rooms.items()))


if __name__ == "__main__":
    main()
