"""The page that sets the thesis beside ours: as Markdown for the documentation, and as one HTML file.

Everything comes as plain values and words; verdicts are given elsewhere.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from cuspid.report.pages.page import render_page

Table = tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]
"""Headings, and rows of cells."""


@dataclass(frozen=True, kw_only=True)
class FigureRow:
    """A figure of the thesis beside ours."""

    quantity: str
    """With its unit."""
    thesis: str
    """As printed."""
    ours: str
    """As found."""
    verdict: str
    """One of a few words."""
    because: str = ""
    """Why ours is different or worse; empty where it is not."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A table, figure or equation."""

    id: str
    """For links and the command line."""
    name: str
    """Fig 2.5."""
    section: str
    """Of the thesis."""
    title: str
    """What it shows."""
    states: str
    """What the thesis states with it."""
    verdict: str
    """Over all rows."""
    tally: str
    """Verdicts of the rows, counted; empty where there is only one."""
    lost: str
    """Why nothing can be compared; empty where something can."""
    rows: tuple[FigureRow, ...]
    """Figures."""
    rules: tuple[str, ...]
    """How they were judged."""
    notes: tuple[str, ...]
    """Conditions and remarks."""
    table: Table | None
    """More figures."""
    pictures: tuple[tuple[str, str], ...]
    """Files and what is in them."""
    command: str
    """Makes what has not been run; empty where all has."""
    sources: tuple[str, ...]
    """Names of the results."""


@dataclass(frozen=True, kw_only=True)
class Page:
    """The whole page."""

    title: str
    intro: tuple[str, ...]
    """Paragraphs."""
    counts: tuple[tuple[str, int, str], ...]
    """Verdicts, how many items have each, and what the word means."""
    entries: tuple[Entry, ...]
    conditions: tuple[tuple[str, str], ...]
    """Names of results, and how they came about."""


# --- Markdown ---------------------------------------------------------------------------------------------------------


def markdown(page: Page, *, images: str = "images/") -> str:
    """The page; pictures are looked for in a folder beside it, and mentions of docs/x.md become links to x.md."""
    parts = [
        f"# {page.title}",
        "",
        *(line for text in page.intro for line in (_link_pages(text), "")),
        "## At a glance",
        "",
    ]
    parts += [*_markdown_table(("verdict", "items", "meaning"), [(v, str(n), m) for v, n, m in page.counts]), ""]
    heads = ("item", "what it shows", "verdict", "its figures")
    glance = [(f"[{each.name}](#{_anchor(each)})", each.title, each.verdict, each.tally) for each in page.entries]
    parts += [*_markdown_table(heads, glance), ""]
    for entry in page.entries:
        parts += _markdown_entry(entry, images)
    parts += ["## Conditions", "", *_markdown_table(("results", "how they were made"), page.conditions), ""]
    return "\n".join(parts)


def _markdown_entry(entry: Entry, images: str) -> list[str]:
    lines = [f"## {_heading(entry)}", "", f"Section {entry.section}. {_link_pages(entry.states)}", ""]
    lines += [f"**{entry.verdict}**" + (f" ({entry.tally})" if entry.tally else "") + _tail(entry.lost), ""]
    if entry.rows:
        cells = [
            (row.quantity, row.thesis, row.ours, row.verdict + (f": {row.because}" if row.because else ""))
            for row in entry.rows
        ]
        lines += [*_markdown_table(("figure", "thesis", "ours", "verdict"), cells), ""]
    if entry.table is not None:
        lines += [*_markdown_table(*entry.table), ""]
    if entry.rules:
        lines += ["How it is judged:", "", *(f"- {_link_pages(rule)}" for rule in entry.rules), ""]
    lines += [line for note in entry.notes for line in (_link_pages(note), "")]
    if entry.command:
        lines += ["Not run yet:", "", f"    {entry.command}", ""]
    lines += [line for name, caption in entry.pictures for line in (f"![{caption}]({images}{name})", "", caption, "")]
    if entry.sources:
        lines += [f"Results: {', '.join(f'`{name}`' for name in entry.sources)}.", ""]
    return lines


def _tail(text: str) -> str:
    return f": {_link_pages(text)}" if text else ""


def _heading(entry: Entry) -> str:
    return _escape(f"{entry.name}: {entry.title}")


def _anchor(entry: Entry) -> str:
    """As GitHub and MyST make it from the heading."""
    kept = re.sub(r"[^\w\- ]", "", f"{entry.name}: {entry.title}".lower())
    return kept.replace(" ", "-")


def _markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    return [*lines, *("| " + " | ".join(_link_pages(cell).replace("|", r"\|") for cell in row) + " |" for row in rows)]


def _link_pages(text: str) -> str:
    """Mentions of other pages of the documentation as links."""
    return re.sub(r"docs/([\w-]+)\.md", r"[\1](\1.md)", _escape(text))


def _escape(text: str) -> str:
    """What Markdown would take for something else, outside of code."""
    spans = re.split(r"(`[^`]*`|\]\(#[^)]*\))", text)
    return "".join(each if number % 2 else re.sub(r"([*<$])", r"\\\1", each) for number, each in enumerate(spans))


# --- HTML -------------------------------------------------------------------------------------------------------------


def html(page: Page, pictures: Mapping[str, str]) -> str:
    """One file: ``pictures`` are addresses that hold the data, by the names of the files; others are left out."""
    return render_page("reproduction.html.j2", package="cuspid_thesis", page=page, pictures=pictures, words=_words)


def _words(text: str) -> Markup:
    """Escaped, with what stands between backticks as code."""
    parts = [escape(part) for part in text.split("`")]
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if number % 2 else part for number, part in enumerate(parts)
    )
