"""Figures on the pages that people write come from the results: quoted.toml says which, and from where.

    python benchmarks/quoted.py [--check]

Puts the figures of today's results into the pages; with ``--check`` it only says where they differ, as the build of the
documentation does. A text of quoted.toml stands on its page with a figure in place of each ``{}``, and is followed by
where each is from:

    NAMES: PATH [& NAMES: PATH ...] FORMAT [median|rms|max] [* FACTOR]     a figure, "20-22" where there are several;
                                                                           without its sign unless FORMAT has one
    NAMES: PATH <= LIMIT [and NAMES: PATH >= LIMIT ...]                    "met" or "missed", by the size of each value

Names of results and the parts of a path may have wildcards. A table with a quoted text has no other figures.
"""

from __future__ import annotations

import argparse
import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from statistics import fmean, median
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parent

FIGURE = re.compile(r"(?P<where>.+?) (?P<digits>\+?\.\df)(?: (?P<one>\w+))?(?: \* (?P<factor>\S+))?")
BAR = re.compile(r"(?P<where>.+) (?P<sign>[<>])= (?P<limit>\S+)")
ONE: Mapping[str, Callable[[Sequence[float]], float]] = {
    "median": median,
    "max": max,
    "rms": lambda values: fmean([each**2 for each in values]) ** 0.5,
}

Results = Mapping[str, Any]
"""What the files of results hold, by their names."""
Quoted = Mapping[str, Sequence[str]]
"""Texts of a page, and where their figures are from."""


class WrongFigureError(Exception):
    """A page and the results do not say the same; the message has a line for each difference."""


def with_figures(page: str, quoted: Quoted, results: Results) -> str:
    """A page with the figures of the results.

    Raises:
        WrongFigureError: A text is not on the page, a figure has no result, or a row of a table is not quoted.
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
    if wrong:
        raise WrongFigureError("\n".join(wrong))
    return page


def _pattern(text: str) -> re.Pattern[str]:
    """A text wherever its lines are broken, a group for each figure."""
    pieces = [r"\s+".join(re.escape(word) for word in re.split(r"\s+", piece)) for piece in text.split("{}")]
    return re.compile(r"(\S+?)".join(pieces))


def _told(source: str, results: Results) -> str:
    """A figure, or whether bars are met."""
    if found := FIGURE.fullmatch(source):
        signed = [value * float(found["factor"] or 1) for value in _values(found["where"], results)]
        values = signed if found["digits"].startswith("+") else [abs(value) for value in signed]
        ends = [ONE[found["one"]](values)] if found["one"] else [min(values), max(values)]
        return "-".join(dict.fromkeys(f"{end:{found['digits']}}" for end in ends))
    bars = [BAR.fullmatch(each) for each in source.split(" and ")]
    return "met" if all(_is_met(bar, source, results) for bar in bars) else "missed"


def _is_met(bar: re.Match[str] | None, source: str, results: Results) -> bool:
    if bar is None:
        raise WrongFigureError(f"{source} is neither a figure nor a bar")
    values, limit = [abs(value) for value in _values(bar["where"], results)], float(bar["limit"])
    return max(values) <= limit if bar["sign"] == "<" else min(values) >= limit


def _values(where: str, results: Results) -> list[float]:
    """Figures on paths through the results of some names."""
    places = [place.split(": ") for place in where.split(" & ")]
    found = [
        float(value)
        for names, path in places
        for name, result in results.items()
        if fnmatchcase(name, names)
        for value in _followed(result, path.split("/"))
    ]
    if not found:
        raise WrongFigureError(f"no result has {where}")
    return found


def _followed(value: Any, path: Sequence[str]) -> Iterator[Any]:
    if not path:
        yield from () if value is None else (value,)
    elif isinstance(value, list):
        yield from (end for each in value for end in _followed(each, path))
    elif isinstance(value, Mapping):
        for key in value:
            if fnmatchcase(key, path[0]):
                yield from _followed(value[key], path[1:])


def _rows_of_other_origin(page: str, quoted: Quoted) -> list[str]:
    """Rows with figures that are not quoted, in tables where others are."""
    tables = re.findall(r"(?:^\|.*\n?)+", page, re.MULTILINE)
    is_quoted = re.compile("|".join(_pattern(text).pattern for text in quoted))
    touched = [table.splitlines() for table in tables if is_quoted.search(table)]
    return [row for rows in touched for row in rows[2:] if re.search(r"\d", is_quoted.sub("", row))]


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
