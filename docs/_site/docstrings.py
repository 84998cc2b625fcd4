"""Docstrings are plain text: what reStructuredText would take for markup is escaped, save ``literals`` and :roles:."""

from __future__ import annotations

import dataclasses
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx


KEPT = re.compile(r"(``.+?``|:\w+:`[^`]+`)")
MARKUP = re.compile(r"([\\*`|]|(?<=\w)_(?!\w))")
LETTERED = re.compile(r"^( +\([a-z]\) )", re.MULTILINE)
DRAWING = re.compile(r"(?<=\n\n)((?: {4}.*(?:\n  .*)*(?:\n+|\Z))+)")
"""Paragraphs that are indented as a whole stay as they are drawn."""


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
    text = "\n".join(_with_fields(lines))
    parts = DRAWING.split(text) if what == "module" else [text]
    lines[:] = "".join(f"::\n\n{part}" if k % 2 else _text(part) for k, part in enumerate(parts)).split("\n")


def _with_fields(lines: list[str]) -> list[str]:
    """A section "Args:" as fields. Not left to napoleon as a whole, which takes "Surface: matt" for a field's type."""
    if "Args:" not in lines:
        return lines
    from sphinx.ext.napoleon import GoogleDocstring

    return list(GoogleDocstring(lines, what="function").lines())


def _text(text: str) -> str:
    return LETTERED.sub(r"\n\1", escaped(text))
