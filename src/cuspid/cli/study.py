"""Studies of any scanner, from folders of meshes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, arg

from cuspid import storage
from cuspid.anatomy.jaw_files import Labelling
from cuspid.anatomy.numbering import Numbering
from cuspid.cli.report import report
from cuspid.cli.shared import Flat, console, show_progress
from cuspid.evaluation.alignments import CONSEQUENCES
from cuspid.model.jaw import Arch
from cuspid.model.trueness import METRICS
from cuspid.report.figures.scanner_study import save_study_figures
from cuspid.runtime.errors import MissingDependencyError
from cuspid.runtime.options import WORKERS, Options, Range
from cuspid.studies.grid import check_workers
from cuspid.studies.scanners.files import Remark
from cuspid.studies.scanners.scan import StudyOptions
from cuspid.studies.scanners.statistics import summary as summarised
from cuspid.studies.scanners.study import Intake, Prepared, Study, compare, plan_comparison, prepare
from cuspid.studies.scanners.text import ANCHORS, checklist, methods
from cuspid.studies.scanners.views import write_views

_MOST_LINES = 40
_NEEDED = {"statsmodels": "statistics", "openpyxl": "XLSX tables"}


@dataclass(frozen=True, kw_only=True)
class References(Options):
    """How the reference meshes are read."""

    unit: storage.Unit | None = None
    """Length unit of the references; inferred from their size unless given. That of each scan is inferred from its
    reference."""
    arch: Arch | None = None
    """Which jaw they show, if their teeth are to be numbered."""
    labels: Numbering = "auto"
    """Numbers of the tooth labels in the references; found out from where the teeth stand unless given."""
    label_map: Path | None = None
    """JSON file of each label in the references and its FDI number, for other numbers."""

    @property
    def intake(self) -> Intake:
        """The same for the study."""
        labelling = Labelling(numbering=self.labels, label_map=self.label_map)
        return Intake(unit=self.unit, arch=self.arch, labelling=labelling)


def study(
    folder: Annotated[Path, Positional, arg(metavar="FOLDER|MANIFEST.csv")],
    *,
    out: Path,
    options: Annotated[StudyOptions, Flat] = StudyOptions(),
    references: Annotated[References, Flat] = References(),
    plan_um: Annotated[float | None, Range(0.001, 100_000)] = None,
    dry_run: bool = False,
    workers: Annotated[int | None, WORKERS] = None,
    cluster: str | None = None,
    retry_failed: bool = False,
) -> None:
    """Trueness and precision of any scanners: repeated scans of specimens against a reference of each.

    Give FOLDER/<scanner>/<specimen>/<scan>.stl with FOLDER/reference/<specimen>.stl (STL, PLY, OBJ, OFF; any unit and
    orientation), or a CSV table with the columns scanner, specimen, file, reference, and if you like scan, operator and
    further factors. A killed run goes on with the same command; changed files are measured again.

    Args:
        folder: The folder, or the CSV table.
        out: Folder for report.html, figures/ (PNG at 300 dpi, PDF), tables/ (CSV) and tables.xlsx, study.json.
        plan_um: A difference of mean deviations that the next study should see: its sample size is printed.
        dry_run: List what would be compared and what is odd (duplicates, other units, mirrored or partial scans, other
            jaws), after a first alignment, which the study uses again.
        workers: Processes on this machine, one core each (default: one for each core).
        cluster: Address of a Dask scheduler, tcp://host:port, whose workers can access the folders too.
        retry_failed: Measure scans that failed before once more.
    """
    check_workers(workers, "study")
    require_packages("study")
    settings = {"study": options, "references": references, "given": folder.name, "plan_um": plan_um}
    # What is measured again follows from the contents of the files, scan by scan.
    with storage.claimed_folder(out, "study", settings, {}, replace=True):
        with show_progress() as progress:
            prepared = prepare(
                folder,
                out,
                options,
                references.intake,
                workers=workers,
                cluster=cluster,
                retry_failed=retry_failed,
                progress=progress,
            )
            found = None if dry_run else compare(prepared, out, options, progress)
        if found is None:
            _print_remarks(plan_comparison(prepared, out, options))
            _print_plan(prepared)
            return
        save_study(out, found, options, plan_um)
    report(out)


def require_packages(verb: str) -> None:
    """Raise MissingDependencyError before hours of work, not after them."""
    for package, what in _NEEDED.items():
        if find_spec(package) is None:
            raise MissingDependencyError(f"{verb}: {what} need {package}: pip install 'cuspid[study]'")


def save_study(out: Path, found: Study, options: StudyOptions, plan_um: float | None = None) -> None:
    """Write and print what a study found."""
    _print_remarks(found.remarks)
    tables = asdict_of(found)
    for name, rows in tables.items():
        if rows:
            storage.write_table(out / "tables" / f"{name}.csv", rows, digits=4)
    storage.write_workbook(out / "tables.xlsx", {name: rows for name, rows in tables.items() if rows})
    record = {
        **summarised(found.tables, seed=options.seed, plan_um=plan_um),
        "groups": found.tables.groups,
        "remarks": [asdict(each) for each in found.remarks],
        "consequence": f"{options.align}: {CONSEQUENCES[options.align]}",
        "anchors": ANCHORS,
        "counts": counts(found),
    }
    record |= {"methods": methods(options, record), "checklist": checklist(options, record)}
    write_views(out, found)
    storage.write_json(out / "study.json", record)
    views = storage.read_result(out)
    if isinstance(views, storage.ScannerStudyResult):
        save_study_figures(out / "figures", found.tables.scans, found.tables.spans, record["agreements"], views.views)
    _print(record)


def asdict_of(found: Study) -> dict[str, Any]:
    """The tables by the names of their files."""
    remarks = [asdict(each) for each in found.remarks]
    tables = found.tables
    return {
        "scans": tables.scans,
        "regions": tables.regions,
        "distances": tables.spans,
        "positions": tables.shifts,
        "pairs": tables.pairs,
        "groups": tables.groups,
        "remarks": remarks,
    }


def counts(found: Study) -> dict[str, int]:
    """How many of what was compared."""
    rows = found.tables.scans
    return {
        "scans": len(rows),
        "scanners": len({row["scanner"] for row in rows}),
        "specimens": len({row["specimen"] for row in rows}),
        "operators": len({row["operator"] for row in rows if row["operator"] is not None}),
        "fewest": min(row["scans"] for row in found.tables.groups),
        "most": max(row["scans"] for row in found.tables.groups),
        "spans": len(found.tables.spans),
        "left_out": sum(each.left_out for each in found.remarks),
    }


def _print_remarks(remarks: Iterable[Remark]) -> None:
    lines = [f"{'left out' if each.left_out else 'note'}: {each}" for each in remarks]
    for line in lines[:_MOST_LINES]:
        console.print(line, highlight=False, soft_wrap=True)
    if len(lines) > _MOST_LINES:
        console.print(f"... and {len(lines) - _MOST_LINES} more, in study.json", highlight=False)


def _print_plan(prepared: Prepared) -> None:
    table = Table(title="What would be compared", title_justify="left")
    for column in ("scanner", "specimen", "scans", "unit", "faces", "overlap"):
        table.add_column(column, justify="left" if column in ("scanner", "specimen", "unit") else "right")
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for scan in prepared.scans:
        groups.setdefault((scan.scanner, scan.specimen), []).append(prepared.records[scan.key])
    for (scanner, specimen), records in groups.items():
        faces = [each["faces"] for each in records]
        overlap = [each["overlap"] for each in records]
        table.add_row(
            scanner,
            specimen,
            str(len(records)),
            ", ".join(sorted({each["unit"] for each in records})),
            _range([f"{each:,}" for each in sorted(faces)]),
            _range([f"{each:.0%}" for each in sorted(overlap)]),
        )
    Console().print(table)


def _range(ordered: Sequence[str]) -> str:
    return ordered[0] if ordered[0] == ordered[-1] else f"{ordered[0]} to {ordered[-1]}"


def _print(figures: Mapping[str, Any]) -> None:
    table = Table(title="Trueness and precision / µm, with 95 % intervals", title_justify="left")
    mean, signed_mean = METRICS["mean_abs_um"].heading, METRICS["signed_mean_um"].heading
    for column in ("scanner", "scans", f"trueness: {mean}", signed_mean, f"precision: {mean}", "s_r"):
        table.add_column(column, justify="left" if column == "scanner" else "right")
    for name, found in figures["scanners"].items():
        table.add_row(
            name,
            str(found["scans"]),
            _estimate(found["trueness"]["mean_abs_um"]),
            _estimate(found["trueness"]["signed_mean_um"]),
            _estimate(found["precision"]["mean_abs_um"]),
            "-" if found["repeatability_sd_um"] is None else f"{found['repeatability_sd_um']:.1f}",
        )
    Console().print(table)


def _estimate(found: Mapping[str, Any] | None) -> str:
    if found is None:
        return "-"
    digits = 2 if abs(found["value"]) < 2 else 1
    interval = "" if found["low"] is None else f" ({found['low']:.{digits}f} to {found['high']:.{digits}f})"
    return f"{found['value']:.{digits}f}{interval}"
