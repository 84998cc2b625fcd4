"""Tables as CSV, for spreadsheets and statistics programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from cuspid.storage.files import write_bytes


def write_table(path: Path, rows: Sequence[Mapping[str, object]], *, digits: int | None = None) -> None:
    """Write :func:`csv_table` to a file."""
    write_bytes(path, csv_table(rows, digits=digits).encode())


def csv_table(rows: Sequence[Mapping[str, object]], *, digits: int | None = None) -> str:
    """Rows as CSV with a header of all their keys, in the order in which they first occur.

    What a row lacks, and None, is an empty cell. Numbers have ``digits`` decimals, or all they need.
    """
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value, digits) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _cell(value: object, digits: int | None) -> object:
    return f"{value:.{digits}f}" if isinstance(value, float) and digits is not None else value
