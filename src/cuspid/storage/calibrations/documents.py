"""Text of a calibration file, parsed by what it is: JSON, YAML, TOML, XML, or lines of words."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
import yaml

from cuspid.runtime.errors import InputError
from cuspid.runtime.values import one_line

_MOST_CHARACTERS = 16 << 20
_MOST_VALUES = 1_000_000
"""Also of those that references within a YAML file repeat."""
_DEEPEST = 32
_STEPS = re.compile(r"</|<(?=\w)|[\[\]{}]")
_DASHES = re.compile(rf"(?:-[ \t]+){{{_DEEPEST}}}|^[ \t]{{{10 * _DEEPEST}}}", re.MULTILINE)
"""Lists of lists in a line of YAML, or a line that stands far to the right."""
_HEAD = re.compile(r"\A%YAML[: ]\d\.\d\s*\n")
"""OpenCV's, which no YAML parser takes."""
_KEY = re.compile(r"^[\w/-]+\s*:", re.MULTILINE)
_NO_YAML = re.compile(r"^\s*ParGroup:", re.MULTILINE)
"""HALCON's parameters only look like it."""


@dataclass(frozen=True, eq=False)
class Document:
    """A parsed file."""

    kind: Literal["values", "xml", "text"]
    """What :attr:`value` is: values of JSON, YAML or TOML, the root of an XML document, or the text itself."""
    value: Any
    """In whatever types the file has: to be checked where it is read."""

    def has(self, *keys: str) -> bool:
        """Whether it is a mapping with these keys."""
        return isinstance(self.value, Mapping) and all(key in self.value for key in keys)


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """YAML without objects, with OpenCV's matrices as mappings, and numbers such as 1e-3."""


_Loader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
)
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def parse(text: str) -> Document:
    """Parse a file by its content. Raises InputError for one that is broken, huge, or nested without end."""
    if len(text) > _MOST_CHARACTERS:
        raise InputError(f"it is no calibration: {len(text) >> 20} MiB of text")
    if _is_nested_deeply(text):
        raise InputError(f"it is no calibration (nested more than {_DEEPEST} deep)")
    try:
        found = _parse(text)
    except (ValueError, ElementTree.ParseError, yaml.YAMLError, RecursionError) as error:
        raise InputError(f"it can be read neither as JSON nor as YAML, TOML or XML ({one_line(error)})") from error
    if found.kind == "values":
        _require_few(found.value)
    return found


def _parse(text: str) -> Document:
    start = text.lstrip()[:1]
    if start == "<":
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("it declares a document type")
        return Document("xml", ElementTree.fromstring(text))
    if start == "{":
        return Document("values", json.loads(text))
    for parser in (json.loads, tomllib.loads) if start == "[" else (tomllib.loads,):
        try:
            found = parser(text)
        except ValueError:
            continue
        if found:
            return Document("values", found)
    if not _HEAD.match(text) and (_NO_YAML.search(text) or not _KEY.search(text)):
        return Document("text", text)
    found = yaml.load(_HEAD.sub("", text), Loader=_Loader)
    return Document("text", text) if isinstance(found, str) or found is None else Document("values", found)


def _is_nested_deeply(text: str) -> bool:
    steps = [1 if step[0] in "[{<" and step[1:] != "/" else -1 for step in _STEPS.findall(text)]
    return bool(np.cumsum([0, *steps]).max() > _DEEPEST or _DASHES.search(text))


def _require_few(value: object) -> None:
    left, count = [value], 0
    while left:
        each = left.pop()
        count += 1
        if count > _MOST_VALUES:
            raise InputError(f"it is no calibration: more than {_MOST_VALUES} values")
        inner: Iterable[object] = each.values() if isinstance(each, dict) else each if isinstance(each, list) else ()
        left.extend(inner)
