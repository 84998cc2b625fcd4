"""Findings in words: what the page shows of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Sequence

from cuspid_thesis.judging import Finding
from cuspid_thesis.page_format import Entry, FigureRow, Page
from cuspid_thesis.results import PANORAMA, Result, Results, looking
from cuspid_thesis.rules import FAVOUR, Comparison, Figure, Verdict
from cuspid_thesis.scan_cases import with_todays_verb

TITLE = "The thesis, reproduced"
WORDS: dict[Verdict, str] = {
    "better": "better",
    "reproduced": "reproduced",
    "differs": "differs",
    "falls short": "falls short",
    "not run": "not run yet",
    "not known": "cannot be known",
}
MEANINGS: dict[Verdict, str] = {
    "better": "a smaller error under the same conditions",
    "reproduced": "the thesis' statement holds, or its number is obtained",
    "differs": "a different number, or the statement does not hold; the reason is given",
    "falls short": "at least one figure is worse than the thesis'",
    "not run": "there are no results yet; the command is given",
    "not known": "lost in our copy of the thesis, and not stated in its text",
}
INTRO = (
    "Every figure, table and numbered equation of the thesis (M. Ghanoum, Passive method for 3D reconstruction of "
    "human jaw: theory and application, University of Louisville, 2021) beside what cuspid finds. Our copy of the "
    "thesis lacks all pictures, Tables 1.1 and 3.1 and the references; what its text still says about them is "
    "compared.",
    "Verdicts follow from rules, which are listed below each item; none is set by hand. An item has the least "
    "favourable verdict of its figures, with the count of each verdict beside it. Figures that have not been run yet "
    "do not count.",
    "All our results are simulated: ideal optics, an artificial texture on the teeth as in the thesis unless stated "
    "otherwise, an exactly known rig. The thesis' jaws are not public; ours are the built-in phantom and others named "
    "below. Teeth have FDI numbers (the thesis' 30, 29, 26, 20 and 19 are 46, 45, 42, 35 and 36).",
)
MADE = "Made by `cuspid reproduce`. Results of reduced runs (`--quick`) are marked."
GENERATED = (
    "Generated from `benchmarks/results/` by `python benchmarks/reproduction.py`; do not edit. `cuspid reproduce --out "
    "FOLDER` runs everything again, `--quick` a reduced version in a quarter of an hour, `--only table-3.2` a part; an "
    "interrupted run resumes where it stopped."
)
"""Of the page in the documentation."""


def make_page(
    findings: Sequence[Finding], results: Results, *, pictures: Container[str] = (), origin: str = MADE
) -> Page:
    """The page of some findings and the results that they come from, with those of the pictures that there are."""
    counts = Counter(finding.verdict for finding in findings)
    used = dict.fromkeys(name for finding in findings for name in sources(finding, results))
    return Page(
        title=TITLE,
        intro=(*INTRO, origin),
        counts=tuple((WORDS[each], counts[each], MEANINGS[each]) for each in WORDS if counts[each]),
        entries=tuple(_entry(finding, sources(finding, results), pictures) for finding in findings),
        conditions=tuple((name, conditions(name, results[name])) for name in used),
    )


def sources(finding: Finding, results: Results) -> tuple[str, ...]:
    """Names of the results that the figures come from."""
    named = dict.fromkeys(each.source for each in finding.comparisons)
    found = [name for name in named if name in results]
    if any(name.startswith(PANORAMA) for name in named):
        found += sorted(name for name in results if name.startswith(PANORAMA))
    return tuple(found)


def _entry(finding: Finding, names: tuple[str, ...], pictures: Container[str]) -> Entry:
    item = finding.item
    return Entry(
        id=item.id,
        name=item.name,
        section=item.section,
        title=item.title,
        states=item.states,
        verdict=WORDS[finding.verdict],
        tally=_tally(finding.comparisons),
        lost=item.lost,
        rows=tuple(map(_row, finding.comparisons)),
        rules=_rules(finding.comparisons),
        notes=finding.notes,
        table=finding.table,
        pictures=tuple((name, caption) for name, caption in item.pictures if name in pictures),
        command=f"cuspid reproduce --only {item.id} --out FOLDER" if finding.missing else "",
        sources=names,
    )


def _rules(comparisons: Sequence[Comparison]) -> tuple[str, ...]:
    """Each rule once, with the rows that it is for where there are several rules."""
    rows: dict[str, list[int]] = {}
    for number, each in enumerate(comparisons, start=1):
        rows.setdefault(each.rule.text, []).append(number)
    if len(rows) == 1:
        return tuple(rows)
    return tuple(f"{_row_numbers(numbers)}: {text}" for text, numbers in rows.items())


def _row_numbers(numbers: Sequence[int]) -> str:
    if len(numbers) == 1:
        return f"row {numbers[0]}"
    if len(numbers) > 2 and numbers[-1] - numbers[0] == len(numbers) - 1:
        return f"rows {numbers[0]} to {numbers[-1]}"
    return f"rows {', '.join(map(str, numbers[:-1]))} and {numbers[-1]}"


def _tally(comparisons: Sequence[Comparison]) -> str:
    counts = Counter(each.verdict for each in comparisons)
    order: tuple[Verdict, ...] = (*reversed(FAVOUR), "not run")
    named = [f"{counts[each]} {_verdict_word(each, counts[each])}" for each in order if counts[each]]
    return ", ".join(named) if len(comparisons) > 1 else ""


def _verdict_word(verdict: Verdict, count: int) -> str:
    plural = {"differs": "differ", "falls short": "fall short"}
    return WORDS[verdict] if count == 1 else plural.get(verdict, WORDS[verdict])


def _row(comparison: Comparison) -> FigureRow:
    unit = f", {comparison.unit}" if comparison.unit else ""
    bad = comparison.verdict in ("differs", "falls short")
    return FigureRow(
        quantity=f"{comparison.quantity}{unit}",
        thesis=comparison.printed,
        ours=_ours(comparison),
        verdict=WORDS[comparison.verdict],
        because=comparison.because if bad else "",
    )


def _ours(comparison: Comparison) -> str:
    words = comparison.shown or ("-" if comparison.ours is None else figure_text(comparison.ours))
    return f"{words} (quick)" if comparison.quick and comparison.ours is not None else words


def figure_text(figure: Figure) -> str:
    """A figure with the digits that matter."""
    if isinstance(figure, bool):
        return "yes" if figure else "no"
    if isinstance(figure, tuple):
        return " to ".join(map(figure_text, figure))
    size = abs(figure)
    if size != 0 and size < 1e-3:
        return f"{figure:.1e}"
    return f"{figure:,.0f}" if size >= 100 or figure == round(figure) else f"{figure:.3g}"


def conditions(name: str, result: Result) -> str:
    """How a result of that name came about, in a line. Raises InputError where it is not as a run writes it."""
    with looking(f"{name}.json"):
        commands = result.get("commands") or ([result["command"]] if result.get("command") else [])
        made = [
            "quick" if result.get("quick") else "",
            *(f"`{with_todays_verb(command)}`" for command in commands),
            f"commit {result['commit']}" if result.get("commit") else "",
            f"cuspid {result['versions']['cuspid']}" if "versions" in result else "",
            f"Python {result['python']}" if "python" in result else "",
            f"{result['cores']} cores" if "cores" in result else "",
        ]
    return "; ".join(filter(None, made))
