"""Show what was found."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rich.filesize import decimal
from tyro.conf import Positional

from cuspid import storage
from cuspid.cli.shared import Flat, console
from cuspid.report.pages.report import report_page
from cuspid.report.pages.scan import ReportOptions


def report(
    folder: Annotated[Path, Positional],
    *,
    out: Path | None = None,
    reference: Path | None = None,
    unit: storage.Unit = "mm",
    options: Annotated[ReportOptions, Flat] = ReportOptions(),
) -> None:
    """Write one HTML page on the results in a folder: the surface in 3-D, figures, pictures, and how they were made.

    The page is one file that opens without a network.

    Args:
        folder: Folder that run, reconstruct, evaluate, shape, sweep, compare, repeat, study, stitch, rescale,
            stitch-eval or calibrate wrote.
        out: The page (default: report.html in the folder).
        reference: Mesh that the scan was compared with, if the folder does not contain it (after evaluate).
        unit: Length unit of the reference.
    """
    path = out or folder / "report.html"
    storage.require_suffix(path, ".html", ".htm")
    with storage.reading(folder):
        page = report_page(storage.read_result(folder, reference, unit), options)
    storage.write_bytes(path, page.encode())
    console.print(f"{path}: {decimal(path.stat().st_size)}", highlight=False)
