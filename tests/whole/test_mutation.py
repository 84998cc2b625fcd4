"""The mutants of benchmarks/mutation.py: which places are changed, and into what."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
SOURCE = '''
"""Of a module: 1 + 1."""
LIMIT = 3

def grow(size: "3 n", *, by: int = 2) -> int:
    """No mutant: 1 < 2."""
    left: "2 n" = -size
    if not size >= 0.5 and by is not None:
        raise ValueError(f"{size + 1} is too much")
    name = "ä" + str(by)
    return (size + 10) * left[
        1
    ], name, True
'''


@pytest.fixture
def mutation(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return import_module("mutation")


def test_bodies_of_functions_are_changed_at_one_place_each(mutation: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "grow.py").write_text(SOURCE)
    mutants = mutation.mutants_of(tmp_path, "room")
    assert [(each.was, each.becomes) for each in mutants] == [
        ("-size", "(size)"),
        ("not size >= 0.5", "(size >= 0.5)"),
        ("not size >= 0.5 and by is not None", "(not size >= 0.5 or by is not None)"),
        ("size >= 0.5", "(size <= 0.5)"),
        ("0.5", "(0.55)"),
        ("by is not None", "(by is None)"),
        ("(size + 10) * left[1]", "((size + 10) / left[1])"),
        ("size + 10", "(size - 10)"),
        ("10", "(11)"),
        ("1", "(2)"),
        ("True", "(False)"),
    ]
    assert mutants[0].name == 'room/grow.py: -size -> (size) in left: "2 n" = -size'
    whole = SOURCE.encode()
    for each in mutants:
        changed = each.apply(whole)
        assert len({ast.unparse(ast.parse(source)) for source in (changed, whole)}) == 2
        assert changed[: each.begin] == whole[: each.begin]
        assert changed.endswith(whole[each.end :])


def test_more_mutants_are_the_same_and_further_ones(mutation: ModuleType) -> None:
    code, _ = mutation.ROOMS["geometry"]
    every = mutation.mutants_of(ROOT, code)
    few, many, others = (mutation.draw(every, count, seed) for count, seed in ((3, 0), (9, 0), (9, 1)))
    assert many[:3] == few
    assert len(set(many)) == 9
    assert others != many
