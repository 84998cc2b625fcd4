"""Docstrings are plain text: what reStructuredText would take for markup is escaped, save ``literals`` and :roles:."""

from __future__ import annotations

import dataclasses
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx


KEPT = re.compile(r"(``.+?``|:\w+:`[^`]+`)")
MARKUP = re.compile(r"([\\*`|]|(?<=\w)_(?!\w))")
LETTERED = re.compile(r"\s+\([a-z]\) ")


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("autodoc-process-docstring", _process)
    app.connect("autodoc-process-signature", _sign)
    return {"parallel_read_safe": True}


def escaped(text: str) -> str:
    """Plain text as reStructuredText."""
    return "".join(part if k % 2 else MARKUP.sub(r"\\\1", part) for k, part in enumerate(KEPT.split(text)))


def _sign(app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str, returned: str) -> Any:
    """None for dataclasses: their fields follow, one by one, with types, defaults and what they mean."""
    return ("", None) if isinstance(obj, type) and dataclasses.is_dataclass(obj) else None


def _process(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    paragraphs = "\n".join(lines).split("\n\n")
    lines[:] = "\n\n".join(_drawing(each) if what == "module" else _text(each) for each in paragraphs).split("\n")


def _drawing(paragraph: str) -> str:
    """A paragraph that is indented as a whole stays as it is drawn."""
    if paragraph.startswith("    ") and all(line.startswith("  ") for line in paragraph.rstrip().split("\n")):
        return f"::\n\n{paragraph}"
    return _text(paragraph)


def _text(paragraph: str) -> str:
    lines = [f"\n{line}" if LETTERED.match(line) else line for line in escaped(paragraph).split("\n")]
    return "\n".join(lines)
