"""The flow of a study of scanners: files, specimens, scans, figures, statistics; every step is kept and resumed.

A scan is measured by whatever process has it in its share, and what is kept of it lies in ``scans/``, made from the
contents of its file, its specimen and the options. It is measured again only where one of these has changed.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cuspid import storage
from cuspid.anatomy.jaw_files import Labelling
from cuspid.model.jaw import Arch
from cuspid.runtime.errors import CuspidError, InputError
from cuspid.runtime.progress import Progress, silent
from cuspid.storage.files import to_plain, write_arrays
from cuspid.storage.stages import Stage, code_version
from cuspid.studies.grid import Case, Value, run_grid
from cuspid.studies.scanners.files import Remark, ScanFile, StudyFiles, belongings, find_files, without_repeats
from cuspid.studies.scanners.scan import StudyOptions, measure_file, write_measured
from cuspid.studies.scanners.specimen import Specimen, load_specimen, read_specimen, write_specimen
from cuspid.studies.scanners.summary import Compared, Group, Tables, coverage_remarks, summarise

CODE = ("cuspid.studies.scanners.specimen", "cuspid.studies.scanners.scan")
"""What makes the results of a scan."""
_WORK = "shares"
"""Folder of what processes are told, while they measure."""
_SHARE = 5
"""Scans that one process measures after another: to start it and to read the specimen takes as long as one of them."""


@dataclass(frozen=True, kw_only=True)
class Intake:
    """How the references are read."""

    unit: storage.Unit | None = None
    """Their length unit; inferred from their size unless given. That of each scan is inferred from its reference."""
    arch: Arch | None = None
    """Which jaw they show, if their teeth are to be numbered."""
    labelling: Labelling = field(default_factory=Labelling)
    """How their tooth labels are understood."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Study:
    """What a study found."""

    files: StudyFiles
    """The scans that were asked for, without repeated files."""
    scans: tuple[ScanFile, ...]
    """Those that could be measured."""
    specimens: tuple[str, ...]
    tables: Tables
    remarks: tuple[Remark, ...]
    """All that is odd, and what was left out."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Prepared:
    """Scans that were measured, each for itself."""

    files: StudyFiles
    scans: tuple[ScanFile, ...]
    remarks: tuple[Remark, ...]
    records: Mapping[str, Mapping[str, Any]]
    """What is kept of each of these scans, by its key."""


def prepare(
    given: Path,
    out: Path,
    options: StudyOptions,
    intake: Intake,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    retry_failed: bool = False,
    progress: Progress = silent,
) -> Prepared:
    """Find the files, load the specimens, and measure each scan; goes on where it stopped.

    Raises InputError where nothing can be compared at all.
    """
    found = find_files(given)
    digests, unreadable = _digests(found, progress)
    readable = StudyFiles(
        scans=tuple(scan for scan in found.scans if scan.key in digests),
        references=found.references,
        remarks=(*found.remarks, *unreadable),
    )
    files = without_repeats(readable, digests)
    made, lost = _specimens(files, out, options, intake, progress)
    chosen = [scan for scan in files.scans if scan.specimen in made]
    if not chosen:
        raise InputError(f"{given}: no specimen can be used: {'; '.join(map(str, lost[:3]))}")
    keys = {scan.key: _provenance_of(scan, digests, made, options) for scan in chosen}
    _measure(chosen, keys, out, options, workers, cluster, retry_failed, progress)
    records = {scan.key: storage.read_json(_record(out, scan.key)) for scan in chosen}
    failed = [
        Remark(what=scan.name, why=f"{records[scan.key]['failure']}; left out", left_out=True)
        for scan in chosen
        if records[scan.key]["failure"] is not None
    ]
    good = tuple(scan for scan in chosen if records[scan.key]["failure"] is None)
    odd = [Remark(what=scan.name, why=note) for scan in good for note in records[scan.key]["notes"]]
    return Prepared(
        files=files,
        scans=good,
        remarks=(*files.remarks, *lost, *failed, *odd),
        records={scan.key: records[scan.key] for scan in good},
    )


def compare(prepared: Prepared, out: Path, options: StudyOptions, progress: Progress = silent) -> Study:
    """All figures of the scans that could be measured. Raises InputError where there are none."""
    if not prepared.scans:
        raise InputError(f"no scan can be compared: {'; '.join(map(str, prepared.remarks[:3]))}")
    by_specimen: dict[str, list[ScanFile]] = {}
    for scan in prepared.scans:
        by_specimen.setdefault(scan.specimen, []).append(scan)
    tables, remarks = summarise(
        partial(specimen_of, out),
        by_specimen,
        out / "scans",
        options,
        keep=partial(_keep, out),
        keep_group=partial(_keep_group, out),
        progress=progress,
    )
    if not tables.scans:
        raise InputError(f"no scan can be compared: {'; '.join(map(str, remarks[:3]))}")
    return Study(
        files=prepared.files,
        scans=prepared.scans,
        specimens=tuple(by_specimen),
        tables=tables,
        remarks=(*prepared.remarks, *remarks),
    )


def plan_comparison(prepared: Prepared, out: Path, options: StudyOptions) -> tuple[Remark, ...]:
    """All that is odd about scans that were prepared, before they are compared."""
    found = coverage_remarks(partial(specimen_of, out), prepared.scans, out / "scans", options)
    return (*prepared.remarks, *found)


def specimen_of(out: Path, name: str) -> Specimen:
    """A specimen that was loaded before."""
    return read_specimen(specimen_folder(out, name))


def specimen_folder(out: Path, name: str) -> Path:
    """Where a specimen is kept."""
    return out / "specimens" / storage.digest_of(name)[:12]


def group_file(out: Path, scanner: str, specimen: str) -> Path:
    """Where the mean surface of a scanner on a specimen is kept."""
    return out / "maps" / f"mean-{storage.digest_of([scanner, specimen])[:12]}.npz"


# --- files and specimens ----------------------------------------------------------------------------------------------


def _digests(files: StudyFiles, progress: Progress) -> tuple[dict[str, str], list[Remark]]:
    digests: dict[str, str] = {}
    remarks = []
    for done, scan in enumerate(files.scans, start=1):
        try:
            digests[scan.key] = storage.hash_file(scan.path)
        except InputError as error:
            remarks.append(Remark(what=scan.name, why=f"{error}; left out", left_out=True))
        progress("files", done, len(files.scans))
    return digests, remarks


def _specimens(
    files: StudyFiles, out: Path, options: StudyOptions, intake: Intake, progress: Progress
) -> tuple[dict[str, str], list[Remark]]:
    """The key of each specimen that can be used, and what is odd about them."""
    made: dict[str, str] = {}
    remarks: list[Remark] = []
    names = sorted({scan.specimen for scan in files.scans})
    settings = {"intake": intake, "align_teeth": options.align_teeth}
    stage = Stage("specimen", out, settings, CODE)
    for done, name in enumerate(names, start=1):
        path, folder = files.references[name], specimen_folder(out, name)
        try:
            inputs = {each.name: storage.hash_file(each) for each in belongings(path)}
            made[name] = stage.make(
                inputs,
                [folder / "specimen.npz", folder / "specimen.json"],
                partial(_write_specimen, folder, name, path, options, intake),
            )
            notes = storage.read_json(folder / "specimen.json")["notes"]
            remarks += [Remark(what=f"reference of {name}", why=note) for note in notes]
        except CuspidError as error:
            count = len(files.scans_of(name))
            why = f"{error}; its {count} scan{'s are' if count > 1 else ' is'} left out"
            remarks.append(Remark(what=f"reference of {name}", why=why, left_out=True))
        progress("specimens", done, len(names))
    return made, remarks


def _write_specimen(folder: Path, name: str, path: Path, options: StudyOptions, intake: Intake) -> None:
    specimen = load_specimen(
        name,
        path,
        unit=intake.unit,
        arch=intake.arch,
        labelling=intake.labelling,
        align_teeth=options.align_teeth,
    )
    write_specimen(folder, specimen)


# --- scans ------------------------------------------------------------------------------------------------------------


def _record(out: Path, key: str) -> Path:
    return out / "scans" / f"{key}.json"


def _provenance_of(
    scan: ScanFile, digests: Mapping[str, str], specimens: Mapping[str, str], options: StudyOptions
) -> tuple[str, str]:
    """The digest of a scan's file, and what identifies what is kept of it."""
    # What is decided later, from what is kept, changes nothing of it.
    later = ("region", "precision", "min_share")
    settings = {name: value for name, value in vars(options).items() if name not in later}
    return digests[scan.key], storage.digest_of(
        [digests[scan.key], specimens[scan.specimen], to_plain(settings), code_version(*CODE)]
    )


def _is_done(out: Path, key: str, made_from: str, retry_failed: bool) -> bool:
    path = _record(out, key)
    if not path.exists():
        return False
    try:
        record = storage.read_json(path)
    except InputError:  # damaged: it is made again
        return False
    if record.get("made_from") != made_from or (record["failure"] is not None and retry_failed):
        return False
    return record["failure"] is not None or (out / "scans" / f"{key}.npz").exists()


def _measure(
    scans: Sequence[ScanFile],
    keys: Mapping[str, tuple[str, str]],
    out: Path,
    options: StudyOptions,
    workers: int | None,
    cluster: str | None,
    retry_failed: bool,
    progress: Progress,
) -> None:
    left = [scan for scan in scans if not _is_done(out, scan.key, keys[scan.key][1], retry_failed)]
    listed = {
        scan.key: {
            **vars(scan),
            "path": str(scan.path.resolve()),
            "digest": keys[scan.key][0],
            "made_from": keys[scan.key][1],
        }
        for scan in left
    }
    shutil.rmtree(out / _WORK, ignore_errors=True)  # of a run that was killed
    cases = []
    for specimen in dict.fromkeys(scan.specimen for scan in left):
        of = [scan.key for scan in left if scan.specimen == specimen]
        for begin in range(0, len(of), _SHARE):
            share = of[begin : begin + _SHARE]
            name = storage.digest_of([listed[key]["made_from"] for key in share])[:16]
            cases.append(Case(name=name, parameters={"keys": " ".join(share)}))
    if cases:
        storage.write_json(out / _WORK / "left.json", listed)
        outcomes = run_grid(
            cases,
            partial(measure_share, out=out.resolve(), options=options),
            out / _WORK,
            workers=workers,
            cluster=cluster,
            stage="scans",
            progress=progress,
        )
        for outcome in outcomes:
            for key in str(outcome.case.parameters["keys"]).split() if outcome.failure else ():
                if not _is_done(out, key, keys[key][1], retry_failed=False):
                    _fail(out, key, keys[key][1], outcome.failure or "")
        shutil.rmtree(out / _WORK, ignore_errors=True)


def measure_share(*, keys: str, out: Path, options: StudyOptions) -> dict[str, Value]:
    """Measure some scans of one specimen, listed in ``shares/left.json``; each that fails says why in its record."""
    listed = storage.read_json(out / _WORK / "left.json")
    specimen = specimen_of(out, listed[keys.split()[0]]["specimen"])
    failed = 0
    for key in keys.split():
        entry = listed[key]
        scan = ScanFile(
            scanner=entry["scanner"],
            specimen=entry["specimen"],
            scan=entry["scan"],
            path=Path(entry["path"]),
            operator=entry["operator"],
            factors=entry["factors"],
        )
        try:
            measured = measure_file(scan, specimen, options)
            if storage.hash_file(scan.path) != entry["digest"]:
                raise InputError("the file changed while the study ran; run the same command again")
            write_measured(out / "scans", key, measured, made_from=entry["made_from"], sha256=entry["digest"])
        except CuspidError as error:
            failed += 1
            _fail(out, key, entry["made_from"], str(error).removeprefix(f"{scan.path}: "))
        except Exception as error:  # one broken scan must not end the others of its share
            failed += 1
            _fail(out, key, entry["made_from"], f"{type(error).__name__}: {error}".splitlines()[0])
    return {"scans": len(keys.split()), "failed": failed}


def _fail(out: Path, key: str, made_from: str, reason: str) -> None:
    storage.write_json(_record(out, key), {"made_from": made_from, "failure": reason})


# --- what pictures need -----------------------------------------------------------------------------------------------


def _keep(out: Path, found: Compared, specimen: Specimen) -> None:
    write_arrays(out / "maps" / f"{found.scan.key}.npz", {"um": found.place_um.astype(np.float32)})


def _keep_group(out: Path, group: Group, specimen: Specimen) -> None:
    arrays = {"mean_um": group.mean_um.astype(np.float32), "sd_um": group.sd_um.astype(np.float32)}
    write_arrays(group_file(out, group.scanner, group.specimen), arrays)
