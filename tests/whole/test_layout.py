"""Tests mirror the package, and what several of them need is in tests/support."""

from __future__ import annotations

import ast
from pathlib import Path

import cuspid

ROOT = Path(__file__).parents[2]
TESTS = ROOT / "tests"


def imported(source: str) -> set[str]:
    """Modules that a module of tests imports, wherever in it."""
    nodes = list(ast.walk(ast.parse(source)))
    plain = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    return plain | {node.module or "." for node in nodes if isinstance(node, ast.ImportFrom)}


def from_tests(source: str) -> set[str]:
    return {name for name in imported(source) if any(part.startswith("test_") for part in name.split("."))}


def test_no_module_imports_a_module_of_tests() -> None:
    assert from_tests("from tests.model.test_rig import a\nimport test_b, numpy") == {"tests.model.test_rig", "test_b"}
    sources = {path: path.read_text() for folder in (TESTS, ROOT / "reproduction") for path in folder.rglob("*.py")}
    assert len(sources) > 150
    assert not {path.name: found for path, source in sources.items() if (found := from_tests(source))}


def test_each_folder_is_that_of_a_room() -> None:
    rooms = {path.name for path in Path(cuspid.__file__).parent.iterdir() if (path / "__init__.py").exists()}
    folders = {path.parent.relative_to(TESTS).as_posix() for path in TESTS.rglob("test_*.py")}
    assert folders == rooms | {"whole"}
