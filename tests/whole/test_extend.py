"""The page on how to extend cuspid names files and names that are there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "extend.md").read_text()


def test_every_file_is_there() -> None:
    named = set(re.findall(r"`((?:src|reproduction)/[\w/.]+)`", PAGE))
    assert len(named) > 10
    assert not [name for name in named if not (ROOT / name).exists()]


def test_every_step_names_a_file_that_has_what_it_tells_to_change() -> None:
    for step in re.findall(r"^\d\. (.*?)(?=^\d\. |^#|^$)", PAGE, re.MULTILINE | re.DOTALL):
        file, *names = re.findall(r"`([\w/.]+)`", step)
        path = ROOT / file
        text = path.read_text() if path.is_file() else "".join(each.read_text() for each in path.glob("*.py"))
        tables = [name for name in names if name.isupper()]
        assert all(re.search(rf"^{name}\b", text, re.MULTILINE) for name in tables), step


def test_a_figure_is_declared_once() -> None:
    """What shows figures asks the table for their headings."""
    source = ROOT / "src" / "cuspid"
    for heading in ("mean |d|", "signed mean"):
        found = [path for path in source.rglob("*.py") if f'"{heading}"' in path.read_text()]
        assert {path.name for path in found} <= {"trueness.py", "study.py"}, found
