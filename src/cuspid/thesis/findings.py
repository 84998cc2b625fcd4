"""What is found of an item: its figures beside those of the thesis, from results that the runs wrote."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from cuspid.errors import InputError
from cuspid.thesis.catalogue import Item
from cuspid.thesis.rules import AtMost, Comparison, Equals, Figure, Rule, Verdict, least_favourable

Result = Mapping[str, Any]
Results = Mapping[str, Result]
"""By name."""
Figures = dict[str, float | bool | str]
"""What a check returns, units in the names."""
Check = Callable[[], Figures]
Table = tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]
"""Headings, and rows of cells."""

CHECKED = "thesis_checks"
"""Name of the results of what is computed in seconds."""
PANORAMA = "panorama/"
"""How the names of results of panoramas begin; then follow subject and method."""
EXACT = 1e-9
"""What differs by no more agrees to rounding."""


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


Finder = Callable[[Item, Results], Finding]


def compare(
    results: Results,
    source: str,
    ours: Callable[[Result], Figure | None],
    *,
    quantity: str,
    printed: str,
    rule: Rule,
    unit: str = "",
    because: str = "",
    shown: Callable[[Result], str] = lambda result: "",
) -> Comparison:
    """A figure of a result beside the thesis; not run where there is no such result.

    Raises InputError where the result has no such field.
    """
    result = results.get(source)
    try:
        found = None if result is None else ours(result)
        words = "" if result is None or found is None else shown(result)
    except (KeyError, TypeError, IndexError, AttributeError, StopIteration) as error:
        raise InputError(f"results {source}.json: not what is expected there ({error!r}); run it again") from error
    return Comparison(
        quantity=quantity,
        unit=unit,
        printed=printed,
        ours=found,
        rule=rule,
        because=because,
        shown=words,
        source=source,
        quick=bool(result and result.get("quick")),
    )


def of_check(results: Results, check: str, *names: str, **fields: Any) -> Comparison:
    """A figure, or the ends of an interval, of a check."""

    def ours(result: Result) -> Figure:
        values = tuple(result[check][name] for name in names)
        return values[0] if len(values) == 1 else values

    return compare(results, CHECKED, ours, **fields)


def vanishes(
    results: Results,
    check: str,
    name: str,
    quantity: str,
    unit: str = "",
    limit: float = EXACT,
    printed: str = "the formula",
) -> Comparison:
    """A residual that should vanish."""
    return of_check(results, check, name, quantity=quantity, unit=unit, printed=printed, rule=AtMost(limit=limit))


def only(*rows: Callable[[Results], Comparison], notes: tuple[str, ...] = ()) -> Finder:
    """A finder of rows that need no item."""
    return lambda item, results: Finding(item=item, comparisons=tuple(row(results) for row in rows), notes=notes)


def vanishing(
    check: str, name: str, quantity: str, unit: str = "", limit: float = EXACT, printed: str = "the formula"
) -> Callable[[Results], Comparison]:
    """A row with a residual that should vanish."""
    return lambda results: vanishes(results, check, name, quantity, unit, limit, printed)


def counted(check: str, name: str, quantity: str, thesis: float, unit: str = "") -> Callable[[Results], Comparison]:
    """A row with a number that should be the same."""
    return lambda results: of_check(
        results,
        check,
        name,
        quantity=quantity,
        unit=unit,
        printed=f"{thesis:g}",
        rule=Equals(thesis=thesis, within=EXACT),
    )
