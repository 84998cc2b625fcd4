"""Tables as CSV and as Excel workbooks, for spreadsheets and statistics programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from cuspid.runtime.errors import InputError, MissingDependencyError
from cuspid.runtime.inputs import read_text
from cuspid.storage.files import whole_file, write_bytes

_LONGEST_SHEET = 31
"""Letters in the name of a sheet."""
_WIDEST_COLUMN = 40


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


def read_table(path: Path, needed: Sequence[str] = ()) -> list[dict[str, str]]:
    """The rows of a CSV file with a header, by column; separated by commas or semicolons, without blanks around cells
    and without empty rows.

    Raises InputError where it is no such file, a column that is needed is missing, or it has no rows.
    """
    text = read_text(path)
    first = text.partition("\n")[0]
    separator = ";" if first.count(";") > first.count(",") else ","
    try:
        rows = list(csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True))
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV table ({error})") from error
    header = [name.strip().lower() for name in rows[0]] if rows else []
    lacking = [name for name in needed if name not in header]
    if lacking:
        raise InputError(f"{path}: has no column {', '.join(lacking)}; its first line must name the columns")
    cells = [[cell.strip() for cell in row] for row in rows[1:] if any(cell.strip() for cell in row)]
    if not cells:
        raise InputError(f"{path}: has no rows")
    return [dict(zip(header, row + [""] * (len(header) - len(row)), strict=False)) for row in cells]


def write_workbook(path: Path, sheets: Mapping[str, Sequence[Mapping[str, object]]]) -> None:
    """Write tables as an Excel workbook (XLSX), a sheet each, with a bold header that stays in view; numbers are
    numbers. Text is never taken for a formula. Raises MissingDependencyError without openpyxl."""
    try:
        from openpyxl import Workbook
        from openpyxl.cell import WriteOnlyCell
        from openpyxl.styles import Font
        from openpyxl.utils import get_column_letter
    except ImportError as error:
        raise MissingDependencyError("XLSX tables need openpyxl: pip install 'cuspid[study]'") from error
    book = Workbook(write_only=True)
    for name, rows in sheets.items():
        sheet = book.create_sheet(name[:_LONGEST_SHEET])
        columns = list(dict.fromkeys(column for row in rows for column in row))
        sheet.freeze_panes = "A2"
        for k, column in enumerate(columns, start=1):
            widest = max(len(column), *(len(str(row.get(column, ""))) for row in rows[:50]))
            sheet.column_dimensions[get_column_letter(k)].width = min(widest + 2, _WIDEST_COLUMN)
        heads = [WriteOnlyCell(sheet, column) for column in columns]
        for head in heads:
            head.font = Font(bold=True)
        sheet.append(heads)
        for row in rows:
            cells = [WriteOnlyCell(sheet, row.get(column)) for column in columns]
            for cell in cells:
                if cell.data_type == "f":
                    cell.data_type = "s"
            sheet.append(cells)
    with whole_file(path) as temporary:
        book.save(temporary)
