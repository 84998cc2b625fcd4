"""The tables, figures and equations of the thesis (Ghanoum 2021): what its text still says of each, and how ours is
found and judged. It stands in ``figures.toml``, whose head tells the keys, ``tables.toml`` and ``equations.toml``.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib import resources
from types import MappingProxyType
from typing import Any, Literal

from cuspid.runtime.errors import InputError
from cuspid.runtime.values import quote
from cuspid_thesis.results import CHECKED
from cuspid_thesis.rules import RULES, Equals, Rule

Kind = Literal["figure", "table", "equation"]
_KINDS: Mapping[str, tuple[Kind, str]] = {
    "fig": ("figure", "Fig"),
    "table": ("table", "Table"),
    "eq": ("equation", "Eq"),
}


@dataclass(frozen=True, kw_only=True)
class Row:
    """A figure of the thesis, and how ours is found and judged."""

    quantity: str
    """What is compared, without its unit."""
    unit: str = ""
    """Empty where there is none."""
    thesis: str
    """As printed."""
    source: tuple[str, ...] = (CHECKED,)
    """Names of results, of which the first that is there counts; one with a ``*`` stands for all results."""
    ours: tuple[str, ...] = ()
    """Path of our figure in the results, or of both ends of an interval."""
    computed: str = ""
    """Function that finds it instead."""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    """Of that function."""
    rule: Rule
    """How the two are judged."""
    shown: str = ""
    """Our figure in words, with fields; empty where the number alone tells."""
    because: str = ""
    """Why ours differs or falls short, if it does."""


@dataclass(frozen=True, kw_only=True)
class MadeRows:
    """Rows that follow from a table, or from what was measured."""

    function: str
    """That makes them."""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    """Of that function."""


@dataclass(frozen=True, kw_only=True)
class Note:
    """What else is to be known: conditions, figures that the thesis has no counterpart of."""

    text: str
    """With fields where there is a source."""
    source: str = ""
    """Name of the results that it speaks of."""
    otherwise: str = ""
    """What is said where they are not there."""


@dataclass(frozen=True, kw_only=True)
class TruenessRow:
    """A row of Table 3.2, absolute deviations in um."""

    part: str
    """Its letter in the table."""
    tooth: int | None = None
    """FDI number; None for the complete arch."""
    what: str
    """What was done to the tooth."""
    min_um: float
    max_um: float
    mean_um: float
    std_um: float

    @property
    def result(self) -> str:
        """Name of our results."""
        return f"prepared-{self.tooth or 'arch'}"

    @property
    def path(self) -> str:
        """Where our statistics stand in them: of its tooth, or of the whole scan."""
        return "trueness.accuracy" if self.tooth is None else f"trueness.per_tooth.{self.tooth}"


@dataclass(frozen=True, kw_only=True)
class Item:
    """One table, figure or equation."""

    id: str
    """As the command line takes it: fig-2.5, table-3.2, eq-3.9."""
    section: str
    """Of the thesis."""
    title: str
    """What it shows, in our own words."""
    states: str
    """What the thesis states with it."""
    lost: str = ""
    """Why nothing can be compared, where nothing can."""
    pictures: tuple[tuple[str, str], ...] = ()
    """Files of ours that show the same, and what is in them."""
    printed: tuple[TruenessRow, ...] = ()
    """A table as printed, where ours is compared row by row."""
    table: str = ""
    """Function that makes a table of ours."""
    table_note: str = ""
    """What stands below it."""
    rows: tuple[Row | MadeRows, ...] = ()
    """Figures beside each other."""
    notes: tuple[Note, ...] = ()
    """Below them."""

    @property
    def kind(self) -> Kind:
        """By the id."""
        return _KINDS[self.id.split("-")[0]][0]

    @property
    def name(self) -> str:
        """For headings."""
        kind, number = self.id.split("-")
        return f"{_KINDS[kind][1]} {number}"


# --- Reading ----------------------------------------------------------------------------------------------------------

ROUNDING = 1e-9
"""What differs by no more is equal."""
Keys = Mapping[str, type | tuple[type, ...]]
_NUMBER = (int, float)
_ITEM: Keys = {
    **dict.fromkeys(("id", "section", "title", "states", "lost", "table", "table_note"), str),
    **dict.fromkeys(("pictures", "printed", "row", "note"), list),
    "each": dict,
}
_ROW: Keys = {
    **dict.fromkeys(("quantity", "unit", "thesis", "computed", "shown", "because", "holds"), str),
    **dict.fromkeys(("less_is_better", "exceeds", "at_most", "at_least", "within"), _NUMBER),
    **dict.fromkeys(("source", "ours"), (str, list)),
    "equals": (*_NUMBER, list),
    "with": dict,
}
_MADE_ROWS: Keys = {"rows": str, "with": dict}
_NOTE: Keys = dict.fromkeys(("text", "source", "otherwise"), str)
_PRINTED: Keys = {
    **dict.fromkeys(("part", "what"), str),
    **dict.fromkeys(("min_um", "max_um", "mean_um", "std_um"), _NUMBER),
    "tooth": int,
}


def read_items(text: str, source: str) -> tuple[Item, ...]:
    """The items of a file. Raises InputError, with the name of the item, where one is not as it should be."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: not valid TOML: {error}") from error
    _check(data, {"item": list}, ("item",), source)
    return tuple(_item(entry, source) for entry in data["item"])


def _item(entry: Any, source: str) -> Item:
    name = entry.get("id") if isinstance(entry, dict) else None
    where = f"{source}: {name or 'an item without an id'}"
    _check(entry, _ITEM, ("id", "section", "title", "states"), where)
    if not re.fullmatch(rf"({'|'.join(_KINDS)})-\d+\.\d+", entry["id"]):
        raise InputError(f"{where}: an id is fig-, table- or eq- and a number, such as fig-2.5")
    return Item(
        **{key: entry[key] for key in _ITEM if key in entry and _ITEM[key] is str},
        pictures=tuple(_picture(pair, where) for pair in entry.get("pictures", ())),
        printed=tuple(_trueness_row(row, where) for row in entry.get("printed", ())),
        rows=tuple(_row(row, entry.get("each", {}), where) for row in entry.get("row", ())),
        notes=tuple(_note(note, where) for note in entry.get("note", ())),
    )


def _picture(pair: Any, where: str) -> tuple[str, str]:
    if not (isinstance(pair, list) and len(pair) == 2 and all(isinstance(each, str) for each in pair)):
        raise InputError(f"{where}: a picture must be a file and what it shows, not {quote(pair)}")
    return pair[0], pair[1]


def _row(entry: Any, each: Any, where: str) -> Row | MadeRows:
    if isinstance(entry, dict) and "rows" in entry:
        _check(entry, _MADE_ROWS, (), where)
        return MadeRows(function=entry["rows"], arguments=entry.get("with", {}))
    _check(entry, _ROW, ("quantity",), where)
    where = f"{where}: {entry['quantity']}"
    _check(each, _ROW, (), where)
    ruled = not RULES.keys().isdisjoint(entry)
    row = {**{key: value for key, value in each.items() if not (ruled and key in (*RULES, "within"))}, **entry}
    _check(row, _ROW, ("thesis",), where)
    if ("ours" in row) == ("computed" in row):
        raise InputError(f"{where}: give either 'ours', a path, or 'computed', a function")
    return Row(
        **{key: row[key] for key in ("quantity", "unit", "thesis", "computed", "shown", "because") if key in row},
        source=_several(row.get("source", CHECKED)),
        ours=_several(row.get("ours", [])),
        arguments=row.get("with", {}),
        rule=_rule(row, where),
    )


def _several(value: str | list[str]) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else tuple(value)


def _rule(row: Mapping[str, Any], where: str) -> Rule:
    """The one rule among the keys of a row."""
    named = [name for name in RULES if name in row]
    if len(named) != 1:
        raise InputError(f"{where}: {' and '.join(named) or 'no rule'} given; give exactly one of {', '.join(RULES)}")
    if "within" in row and named != ["equals"]:
        raise InputError(f"{where}: 'within' can only be used with 'equals'")
    kind, name = RULES[named[0]]
    try:
        values: dict[str, Any] = {name: _as_floats(row[named[0]])}
        return kind(**values | ({"within": float(row.get("within", ROUNDING))} if kind is Equals else {}))
    except (InputError, TypeError, ValueError) as error:
        raise InputError(f"{where}: {error}") from error


def _as_floats(value: Any) -> Any:
    """Numbers as floats, intervals as tuples of them, words as they are."""
    if isinstance(value, list):
        return tuple(map(_as_floats, value))
    return value if isinstance(value, str) else float(value)


def _note(entry: Any, where: str) -> Note:
    _check(entry, _NOTE, ("text",), where)
    return Note(**entry)


def _trueness_row(entry: Any, where: str) -> TruenessRow:
    _check(entry, _PRINTED, set(_PRINTED) - {"tooth"}, where)
    return TruenessRow(**entry | {key: float(entry[key]) for key in entry if key.endswith("_um")})


def _check(entry: object, known: Keys, required: Collection[str], where: str) -> None:
    """Raise InputError where an entry is no table, has an unknown key or a value of another kind, or lacks a key."""
    if not isinstance(entry, dict):
        raise InputError(f"{where}: {quote(entry)} is not a table")
    for key, value in entry.items():
        if key not in known:
            near = get_close_matches(key, known, n=1)
            raise InputError(f"{where}: unknown key {quote(key)}" + (f"; did you mean {near[0]}?" if near else ""))
        if not isinstance(value, known[key]):
            raise InputError(f"{where}: {key} cannot be {quote(value)}")
    for key in required:
        if key not in entry:
            raise InputError(f"{where}: {key} is missing")


def _read(name: str) -> tuple[Item, ...]:
    return read_items((resources.files("cuspid_thesis") / name).read_text(encoding="utf-8"), name)


ITEMS: tuple[Item, ...] = (*_read("figures.toml"), *_read("tables.toml"), *_read("equations.toml"))
"""In the order of the page."""
BY_ID: Mapping[str, Item] = MappingProxyType({item.id: item for item in ITEMS})
TABLE_3_2 = BY_ID["table-3.2"].printed
"""As printed."""
