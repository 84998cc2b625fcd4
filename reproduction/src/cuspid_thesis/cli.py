"""The results of the thesis beside the reproduced ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cuspid import storage
from cuspid.cli.shared import console, show_progress
from cuspid.report.pages.page import photo_uri
from cuspid.runtime.errors import CuspidError, InputError
from cuspid.runtime.options import WORKERS
from cuspid.studies.grid import check_workers
from cuspid_thesis.catalogue import BY_ID, ITEMS, Item
from cuspid_thesis.judging import judge
from cuspid_thesis.page import make_page
from cuspid_thesis.page_format import Page, html, markdown
from cuspid_thesis.pictures import draw_pictures
from cuspid_thesis.runs import gather, missing, run_missing


def reproduce(
    *,
    out: Path,
    quick: bool = False,
    only: tuple[str, ...] = (),
    results: Path | None = None,
    images: Path | None = None,
    run: bool = True,
    workers: Annotated[int | None, WORKERS] = None,
) -> None:
    """Set every table, figure and equation of the thesis beside our result: reproduction.md and reproduction.html.

    Whatever has no results yet is run, which takes hours for all items, or a quarter of an hour on two cores with
    --quick. A killed run resumes when the same command is given again.

    Args:
        out: Folder for the pages, the results (results/, results-quick/) and what they were made from (work/).
        quick: Run a reduced version: fewer jaws, settings and subjects; the complete arch is left out.
        only: Items to include, for example fig-2.5 table-3.2 eq-3.9 (default: all).
        results: Folder with existing results, for example benchmarks/results; these are not run again.
        images: Folder with existing pictures, for example docs/images.
        run: Run what is missing; --no-run only makes the pages, from the existing results.
        workers: Number of parallel runs, one core each (default: one for each core).
    """
    items = asked_items(only)
    check_workers(workers, "reproduce")
    if images is not None and not images.is_dir():
        raise InputError(f"--images {images}: no such folder")
    found = gather(out, results)
    judge(found, items)  # What is broken is refused before hours of work.
    failures: dict[str, str] = {}
    with storage.claimed_folder(out, "reproduce", {}, {}):
        if run:
            failures = _run_and_report(out, missing(items, found, quick), quick, workers)
            found = gather(out, results)
        draw_pictures(out / "images", found)
        pictures = _pictures(out / "images", images)
        page = make_page(judge(found, items), found, pictures=pictures)
        storage.write_bytes(out / "reproduction.md", markdown(page).encode())
        storage.write_bytes(out / "reproduction.html", html(page, _embed(page, out / "images", pictures)).encode())
    _print(page)
    console.print(f"{out / 'reproduction.html'}, {out / 'reproduction.md'}", highlight=False)
    if failures:
        raise CuspidError(
            f"reproduce: {', '.join(failures)} failed, for the reasons above; run the same command to try again"
        )


def asked_items(only: Sequence[str]) -> tuple[Item, ...]:
    """Items by their ids, in the order of the page; all if none is asked for. Raises InputError for an unknown id."""
    for name in only:
        if name not in BY_ID:
            near = get_close_matches(name, BY_ID, n=3)
            raise InputError(
                f"--only {name}: no such item; "
                + (f"did you mean {' or '.join(near)}?" if near else "they are fig-1.1 to fig-4.5, table-1.1 to eq-3.9")
            )
    return tuple(item for item in ITEMS if not only or item.id in only)


def _run_and_report(
    out: Path, wanted: Mapping[str, tuple[str, ...]], quick: bool, workers: int | None
) -> dict[str, str]:
    if not wanted:
        return {}
    console.print(f"to run: {', '.join(wanted)}", highlight=False)
    with show_progress() as progress:
        failures = run_missing(out, wanted, quick=quick, workers=workers, progress=progress)
    for name, reason in failures.items():
        console.print(f"failed: {name}: {reason}", highlight=False)
    return failures


def _pictures(*folders: Path | None) -> dict[str, Path]:
    """Pictures by name, those of the first folder first."""
    there = [path for folder in folders if folder is not None and folder.is_dir() for path in folder.iterdir()]
    return {path.name: path for path in reversed(there)}


def _embed(page: Page, folder: Path, pictures: Mapping[str, Path]) -> dict[str, str]:
    """Addresses that hold the pictures of the page, which are kept in the folder for the Markdown."""
    names = dict.fromkeys(name for entry in page.entries for name, _ in entry.pictures)
    for name in names:
        if pictures[name].parent != folder:
            storage.write_bytes(folder / name, pictures[name].read_bytes())
    return {name: photo_uri(pictures[name], widest_px=900) for name in names}


def _print(page: Page) -> None:
    table = Table(title=page.title, title_justify="left")
    for column in ("item", "what it shows", "verdict", "its figures"):
        table.add_column(column, no_wrap=column == "item")
    for entry in page.entries:
        table.add_row(entry.name, escape(entry.title), entry.verdict, entry.tally)
    Console().print(table)
    console.print(", ".join(f"{number} {verdict}" for verdict, number, _ in page.counts), highlight=False)
