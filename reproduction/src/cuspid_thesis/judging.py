"""From results to verdicts: for every item of the catalogue what we find beside what the thesis states.

Nothing is computed here but what follows from the results, and no verdict is given but by a rule of
:mod:`cuspid_thesis.rules`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import filter as matching
from functools import partial
from inspect import signature
from typing import Any

from cuspid.runtime.errors import InputError
from cuspid_thesis.catalogue import ITEMS, Item, Note, Row
from cuspid_thesis.computed import FIGURES, ROWS, TABLES
from cuspid_thesis.page_format import Table
from cuspid_thesis.results import Result, Results, in_words, looking, value_at
from cuspid_thesis.rules import Comparison, Verdict, least_favourable


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What we find of an item."""

    item: Item
    """Which one."""
    comparisons: tuple[Comparison, ...] = ()
    """Figures beside each other."""
    notes: tuple[str, ...] = ()
    """What else is to be known: conditions, figures that the thesis has no counterpart of."""
    table: Table | None = None
    """Such figures in rows."""

    @property
    def verdict(self) -> Verdict:
        """The least favourable of its figures."""
        return "not known" if self.item.lost else least_favourable(each.verdict for each in self.comparisons)

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the results that have not been run."""
        return tuple(dict.fromkeys(each.source for each in self.comparisons if each.verdict == "not run"))


def judge(results: Results, items: Sequence[Item] = ITEMS) -> tuple[Finding, ...]:
    """The finding of each item.

    Raises InputError where a result lacks a field, and where the catalogue names a function that is not there.
    """
    return tuple(_finding(item, results) for item in items)


def _finding(item: Item, results: Results) -> Finding:
    with looking(f"for {item.id}"):
        comparisons = tuple(_compare(row, item, results) for row in _rows(item, results))
        table = _function(TABLES, item.table, {}, item)(results) if item.table else None
        notes = (*(_note_text(note, results) for note in item.notes), item.table_note if table else "")
    return Finding(item=item, comparisons=comparisons, notes=tuple(filter(None, notes)), table=table)


def _rows(item: Item, results: Results) -> Iterator[Row]:
    for row in item.rows:
        if isinstance(row, Row):
            yield row
        else:
            yield from _function(ROWS, row.function, row.arguments, item)(results)


def _note_text(note: Note, results: Results) -> str:
    if not note.source:
        return note.text
    return in_words(note.text, results[note.source]) if note.source in results else note.otherwise


def _compare(row: Row, item: Item, results: Results) -> Comparison:
    """A figure of ours beside the thesis; not run where there is no such result.

    Raises InputError where the result has no such field.
    """
    look = _function(FIGURES, row.computed, row.arguments, item) if row.computed else partial(_figure, row.ours)
    source = next((name for name in row.source if name in results), row.source[-1])
    result = results if "*" in source else results.get(source)
    with looking(f"{source}.json"):
        found = (None if result is None else look(result)) or {}
        return Comparison(
            quantity=row.quantity,
            unit=row.unit,
            printed=row.thesis,
            ours=found.get("ours"),
            rule=row.rule,
            because=found.get("because", row.because),
            shown=in_words(row.shown, result or {}, found) if found else "",
            source=source,
            quick=any(results[name].get("quick") for name in matching(results, source)),
        )


def _figure(paths: Sequence[str], result: Result) -> Mapping[str, Any] | None:
    values = tuple(_number(value_at(result, path)) for path in paths)
    return None if None in values else {"ours": values[0] if len(values) == 1 else values}


def _number(value: Any) -> Any:
    return float(value) if type(value) is int else value


def _function(
    functions: Mapping[str, Callable[..., Any]], name: str, arguments: Mapping[str, Any], item: Item
) -> Callable[..., Any]:
    """A function of the catalogue, with its arguments but the results. Raises InputError where they do not fit."""
    if name not in functions:
        raise InputError(f"{item.id}: unknown function '{name}'; choose one of {', '.join(functions)}")
    try:
        signature(functions[name]).bind({}, **arguments)
    except TypeError as error:
        raise InputError(f"{item.id}: {name}: {error}") from error
    return partial(functions[name], **arguments)
