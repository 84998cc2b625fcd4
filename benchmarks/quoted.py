"""Figures on the pages that people write come from the results: quoted.toml says which, and from where.

    python benchmarks/quoted.py [--check]

Puts the figures of today's results into the pages; with ``--check`` it only says where they differ, as the build of the
documentation does. A text of quoted.toml stands on its page with a figure in place of each ``{}``, and is followed by
where each is from:

    NAMES: PATH [& NAMES: PATH ...] FORMAT [min|max|mean|median|rms|sd] [* FACTOR]
                                                           a figure, "20-22" where there are several; without its sign
                                                           unless FORMAT has one
    NAMES: PATH [& NAMES: PATH ...] <= LIMIT count         how many values keep it, by their size
    NAMES: PATH <= LIMIT [and NAMES: PATH >= LIMIT ...]    "met" or "missed", by the size of each value

Names of results and the parts of a path may have wildcards. A part ``KEY=VALUE`` keeps what has this value; a
number takes this entry of a list, or this word of a text.

A table with a quoted text has no other figures. What else looks measured on a page of quoted.toml (12 µm, 5 %, 3 s)
stands in a block (a paragraph, a list item, or a table with what stands above it) that names the commit it was measured
at ("commit 1234567") or the test that holds it ("tests/room/test_it.py"), or that has the comment

    <!-- given -->

on a line of its own or after some words, which says that the figures of its block, or of the section whose heading
stands below it, are options, definitions, arithmetic or other people's.
"""

from __future__ import annotations

import argparse
import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parent

FIGURE = re.compile(r"(?P<where>.+?) (?P<digits>\+?,?\.\d[ef])(?: (?P<one>\w+))?(?: \* (?P<factor>\S+))?")
BAR = re.compile(r"(?P<where>.+) (?P<sign>[<>])= (?P<limit>\S+)")
ONE: Mapping[str, Callable[[Sequence[float]], float]] = {
    "min": min,
    "max": max,
    "mean": fmean,
    "median": median,
    "rms": lambda values: fmean([each**2 for each in values]) ** 0.5,
    "sd": stdev,
}

UNIT = r"(?:µm|um|%|per mille|s|CPU-s|min|minutes|ppm|GiB)(?![\w/²])"
MEASURED = re.compile(rf"\d[\d.,]*\s+{UNIT}|\d+\.\d+\s+px")  # whole pixels are sizes of images and windows
DATED = re.compile(r"\bcommits?\s+[0-9a-f]{7}|\btests/\w+/test_\w+\.py")
GIVEN = "<!-- given -->"
SWALLOWS = rf"^ *(?:[-*] )?{GIVEN}(?= *\S)"  # a comment that begins a line makes what follows it there HTML
NO_PROSE = re.compile(
    rf"^ *```.*?^ *```$|^\$\$.*?^\$\$|{SWALLOWS}|<!-- (?!given).*?-->|`[^`]*`", re.MULTILINE | re.DOTALL
)

Results = Mapping[str, Any]
"""What the files of results hold, by their names."""
Quoted = Mapping[str, Sequence[str]]
"""Texts of a page, and where their figures are from."""


class WrongFigureError(Exception):
    """A page and the results do not say the same; the message has a line for each difference."""


def with_figures(page: str, quoted: Quoted, results: Results) -> str:
    """A page with the figures of the results.

    Raises:
        WrongFigureError: A text is not on the page, a figure has no result, or one on the page has no source.
    """
    wrong = []
    for text, sources in quoted.items():
        places = list(_pattern(text).finditer(page))
        try:
            told = [_told(source, results) for source in sources]
        except WrongFigureError as error:
            wrong.append(f"{text}: {error}")
            continue
        if len(places) != 1 or len(told) != text.count("{}") or text.endswith("{}"):
            wrong.append(f"{text}: {len(places)} times on the page, {len(told)} sources, and words at its end?")
            continue
        (place,) = places
        for number, each in reversed(list(enumerate(told, start=1))):
            page = page[: place.start(number)] + each + page[place.end(number) :]
    wrong += [f"{row}: not in quoted.toml" for row in _rows_of_other_origin(page, quoted)]
    wrong += [f"{block}: measured, but neither quoted nor dated nor given" for block in _without_source(page, quoted)]
    if wrong:
        raise WrongFigureError("\n".join(wrong))
    return page


def _pattern(text: str) -> re.Pattern[str]:
    """A text wherever its lines are broken, a group for each figure."""
    pieces = [r"\s+".join(re.escape(word) for word in re.split(r"\s+", piece)) for piece in text.split("{}")]
    return re.compile(r"(\S+?)".join(pieces) + r"(?!\d)")


def _any_of(quoted: Quoted) -> re.Pattern[str]:
    return re.compile("|".join(_pattern(text).pattern for text in quoted) or "(?!)")


def _told(source: str, results: Results) -> str:
    """A figure, or whether bars are met."""
    if found := FIGURE.fullmatch(source):
        signed = [value * float(found["factor"] or 1) for value in _values(found["where"], results)]
        values = signed if found["digits"].startswith("+") else [abs(value) for value in signed]
        ends = [ONE[found["one"]](values)] if found["one"] else [min(values), max(values)]
        return "-".join(dict.fromkeys(f"{end:{found['digits']}}" for end in ends))
    kept = [_kept(bar, results) for bar in source.removesuffix(" count").split(" and ")]
    if source.endswith(" count"):
        return str(sum(kept[0]))
    return "met" if all(all(each) for each in kept) else "missed"


def _kept(source: str, results: Results) -> list[bool]:
    """Whether each value keeps a bar."""
    bar = BAR.fullmatch(source)
    if bar is None:
        raise WrongFigureError(f"{source} is neither a figure nor a bar")
    sizes, limit = [abs(value) for value in _values(bar["where"], results)], float(bar["limit"])
    return [size <= limit if bar["sign"] == "<" else size >= limit for size in sizes]


def _values(where: str, results: Results) -> list[float]:
    """Figures on paths through the results of some names."""
    places = [place.split(": ") for place in where.split(" & ")]
    found = [
        value
        for names, path in places
        for name, result in results.items()
        if fnmatchcase(name, names)
        for value in _followed(result, path.split("/"))
    ]
    if not found:
        raise WrongFigureError(f"no result has {where}")
    return found


def _followed(value: Any, path: Sequence[str]) -> Iterator[float]:
    """The numbers at the end of a path."""
    if not path and isinstance(value, int | float):
        yield float(value)
    elif isinstance(value, str) and path and path[0].isdigit():
        yield from _followed([float(word) for word in value.split()], path)
    elif isinstance(value, list) and path and path[0].isdigit():
        yield from _followed(value[int(path[0])], path[1:])
    elif isinstance(value, list):
        yield from (end for each in value for end in _followed(each, path))
    elif isinstance(value, Mapping) and path and "=" in path[0]:
        key, _, kept = path[0].partition("=")
        if fnmatchcase(str(value.get(key)), kept):
            yield from _followed(value, path[1:])
    elif isinstance(value, Mapping) and path:
        for key in value:
            if fnmatchcase(key, path[0]):
                yield from _followed(value[key], path[1:])


def _rows_of_other_origin(page: str, quoted: Quoted) -> list[str]:
    """Rows with figures that are not quoted, in tables where others are."""
    tables = re.findall(r"(?:^\|.*\n?)+", page, re.MULTILINE)
    is_quoted = _any_of(quoted)
    touched = [table.splitlines() for table in tables if is_quoted.search(table)]
    return [row for rows in touched for row in rows[2:] if re.search(r"\d", is_quoted.sub("", row))]


def _without_source(page: str, quoted: Quoted) -> Iterator[str]:
    """The beginnings of blocks with figures that look measured, and of which nothing says where they are from."""
    page = _any_of(quoted).sub("...", page)
    page = NO_PROSE.sub(lambda found: found[0] if DATED.search(found[0]) else "", page)
    page = re.sub(r"^(#+ .*)$", r"\n\1\n", page, flags=re.MULTILINE)
    level, above = 0, ""
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", page):
        is_table = block.lstrip().startswith("|")
        with_mark = f"{above} {block}" if is_table or above.strip() == GIVEN else block
        if heading := re.match(r"\s*(#+) ", block):
            if GIVEN in with_mark or len(heading[1]) <= level:
                level = len(heading[1]) if GIVEN in with_mark else 0
        elif (figure := _measured(block, is_table)) and not (level or GIVEN in with_mark or DATED.search(with_mark)):
            yield f"{' '.join(block.split())[:60]} ({figure})"
        above = block


def _measured(block: str, is_table: bool) -> str:
    """The first figure that looks measured: with a unit, or in a table whose head has one."""
    head, _, rows = block.strip().partition("\n")
    found = MEASURED.search(rows if is_table else block)
    if found is None and is_table and re.search(rf"(?<![\w-])(?:{UNIT}|px\b)", head):
        found = re.search(r"\d+", rows)
    return " ".join(found[0].split()) if found else ""


def read_results(folder: Path) -> Results:
    """All results by their paths in the folder, without the ending."""
    return {
        str(path.relative_to(folder).with_suffix("")): json.loads(path.read_text())
        for path in sorted(folder.rglob("*.json"))
    }


def main() -> None:
    """Write the figures into the pages, or only compare them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; fail where a figure differs")
    check = parser.parse_args().check
    results, wrong = read_results(HERE / "results"), []
    for name, quoted in tomllib.loads((HERE / "quoted.toml").read_text()).items():
        before = (ROOT / name).read_text()
        try:
            after = with_figures(before, quoted, results)
        except WrongFigureError as error:
            wrong += [f"{name}: {line}" for line in str(error).splitlines()]
            continue
        if not check:
            (ROOT / name).write_text(after)
        else:
            lines = zip(before.splitlines(), after.splitlines(), strict=True)
            wrong += [f"{name}: {old}\n  now: {new}" for old, new in lines if old != new]
    if wrong:
        raise SystemExit("\n".join([*wrong, "pages and results differ: python benchmarks/quoted.py"]))


if __name__ == "__main__":
    main()
