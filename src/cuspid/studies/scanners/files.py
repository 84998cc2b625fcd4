"""Which files a study compares: folders, or a manifest.

Folders: ``FOLDER/<scanner>/<specimen>/<scan>.stl`` and ``FOLDER/reference/<specimen>.stl``; with one reference alone,
scans may lie in ``FOLDER/<scanner>/`` at once. A manifest is a CSV table with the columns ``scanner``, ``specimen``,
``file`` and ``reference``, and, where there are any, ``scan``, ``operator`` and further factors; paths are relative to
it. What goes with a reference lies beside it, named after it: ``<specimen>.area.ply`` (a reference area),
``<specimen>.spheres.csv``, ``<specimen>.bodies.csv``, ``<specimen>.scanbody.stl`` (or one ``scanbody.stl`` for all),
``<specimen>.landmarks.json``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from cuspid import storage
from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import is_there
from cuspid.storage import MARKUPS_SUFFIX, MESH_SUFFIXES
from cuspid.storage.files import list_finished

REFERENCE = "reference"
"""Name of the folder of references."""
COLUMNS = ("scanner", "specimen", "operator", "scan", "file", "reference")
"""Columns of a manifest that have a meaning; others are further factors."""
_BESIDE = (".area", ".scanbody")
"""How the names of meshes that go with a reference end."""
_COMMON_BODY = "scanbody"


@dataclass(frozen=True, kw_only=True)
class ScanFile:
    """One scan of the study."""

    scanner: str
    """Which scanner made it."""
    specimen: str
    """What it shows."""
    scan: str
    """Its name among the repeats."""
    path: Path
    """The mesh."""
    operator: str | None = None
    """Who made it."""
    factors: Mapping[str, str] = field(default_factory=dict)
    """Levels of further factors."""

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.scanner}/{self.specimen}/{self.scan}"

    @property
    def key(self) -> str:
        """For file names: the same for the same place in the study, whatever its name is."""
        return hashlib.sha256("\0".join((self.scanner, self.specimen, self.scan)).encode()).hexdigest()[:12]

    @property
    def levels(self) -> dict[str, str | None]:
        """The cells that identify it in tables."""
        return {
            "scanner": self.scanner,
            "specimen": self.specimen,
            "operator": self.operator,
            "scan": self.scan,
            **self.factors,
        }


@dataclass(frozen=True, kw_only=True)
class Remark:
    """What is odd, a line for people."""

    what: str
    """A scan, a specimen or a file."""
    why: str
    """What is odd about it, and what comes of it."""
    left_out: bool = False
    """Whether it has no part in the study."""

    def __str__(self) -> str:
        return f"{self.what}: {self.why}"


@dataclass(frozen=True, kw_only=True)
class StudyFiles:
    """What was found."""

    scans: tuple[ScanFile, ...]
    """In the order of their names."""
    references: Mapping[str, Path]
    """By specimen."""
    remarks: tuple[Remark, ...] = ()
    """What is odd about them."""

    def scans_of(self, specimen: str) -> tuple[ScanFile, ...]:
        """The scans of a specimen."""
        return tuple(scan for scan in self.scans if scan.specimen == specimen)


def find_files(given: Path) -> StudyFiles:
    """The files of a folder or of a manifest. Raises InputError where there is nothing to compare."""
    found = _from_manifest(given) if given.suffix.lower() == ".csv" else _from_folder(given)
    if not found.scans:
        reasons = "; ".join(map(str, found.remarks[:3]))
        raise InputError(f"{given}: no scan can be compared{f' ({reasons})' if reasons else ''}")
    return found


def without_repeats(files: StudyFiles, digests: Mapping[str, str]) -> StudyFiles:
    """The files without scans that repeat the file of an earlier one, by digest (of each key): duplicates would feign
    precision."""
    first: dict[str, ScanFile] = {}
    kept, remarks = [], []
    for scan in files.scans:
        earlier = first.setdefault(digests[scan.key], scan)
        if earlier is scan:
            kept.append(scan)
        else:
            remarks.append(Remark(what=scan.name, why=f"the same file as {earlier.name}; left out", left_out=True))
    return StudyFiles(scans=tuple(kept), references=files.references, remarks=(*files.remarks, *remarks))


def find_beside(reference: Path, endings: Sequence[str]) -> Path | None:
    """The first file that is named after a reference with one of the endings; None where there is none."""
    paths = (reference.with_name(reference.stem + ending) for ending in endings)
    return next((path for path in paths if is_there(path)), None)


def area_file(reference: Path) -> Path | None:
    """The mesh of the reference area of a specimen."""
    return find_beside(reference, [f".area{suffix}" for suffix in MESH_SUFFIXES])


def body_file(reference: Path) -> Path | None:
    """The library mesh of the scan bodies of a specimen."""
    own = find_beside(reference, [f".scanbody{suffix}" for suffix in MESH_SUFFIXES])
    common = (reference.with_name(f"{_COMMON_BODY}{suffix}") for suffix in MESH_SUFFIXES)
    return own or next((path for path in common if is_there(path)), None)


def landmark_file(mesh: Path) -> Path | None:
    """The landmarks of a scan or a reference."""
    return find_beside(mesh, (".landmarks.json", MARKUPS_SUFFIX))


def belongings(reference: Path) -> tuple[Path, ...]:
    """All files that describe a specimen, the reference first."""
    others = (area_file(reference), body_file(reference), landmark_file(reference))
    tables = (
        find_beside(reference, [ending]) for ending in (".spheres.csv", ".bodies.csv", "_facelabels.npy", ".json")
    )
    return (reference, *(path for path in (*others, *tables) if path is not None))


# --- folders ----------------------------------------------------------------------------------------------------------


def _from_folder(folder: Path) -> StudyFiles:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give FOLDER/<scanner>/<specimen>/<scan>.stl, or a CSV manifest")
    home = next((path for path in list_finished(folder) if path.is_dir() and path.name.lower() == REFERENCE), None)
    if home is None:
        raise InputError(f"{folder}: has no folder '{REFERENCE}' with a mesh of each specimen, <specimen>.stl")
    references = {path.stem: path for path in _meshes(home) if not _goes_along(path)}
    if not references:
        raise InputError(f"{home}: holds no mesh; give one of each specimen (STL, PLY, OBJ, OFF)")
    scans: list[ScanFile] = []
    remarks: list[Remark] = []
    for scanner in sorted(path for path in list_finished(folder) if path.is_dir() and path != home):
        for specimen, path in _of_scanner(scanner, references, remarks):
            scans.append(ScanFile(scanner=scanner.name, specimen=specimen, scan=path.stem, path=path))
    return StudyFiles(scans=_distinguish_names(scans), references=references, remarks=tuple(remarks))


def _of_scanner(scanner: Path, references: Mapping[str, Path], remarks: list[Remark]) -> Iterator[tuple[str, Path]]:
    """Specimen and file of each scan; what has no reference goes to the remarks."""
    direct = _meshes(scanner)
    if direct and len(references) == 1:
        yield from ((next(iter(references)), path) for path in direct)
    elif direct:
        why = f"{len(direct)} meshes lie in no folder of a specimen ({', '.join(references)}); left out"
        remarks.append(Remark(what=scanner.name, why=why, left_out=True))
    for folder in sorted(path for path in list_finished(scanner) if path.is_dir()):
        meshes = _meshes(folder)
        if folder.name in references:
            yield from ((folder.name, path) for path in meshes)
        elif meshes:
            known = ", ".join(references)
            why = f"no reference of this name (there are {known}); left out, with {len(meshes)} meshes"
            remarks.append(Remark(what=f"{scanner.name}/{folder.name}", why=why, left_out=True))


def _meshes(folder: Path) -> list[Path]:
    return sorted(path for path in list_finished(folder) if path.is_file() and path.suffix.lower() in MESH_SUFFIXES)


def _goes_along(path: Path) -> bool:
    return path.stem == _COMMON_BODY or path.stem.endswith(_BESIDE)


def _distinguish_names(scans: Sequence[ScanFile]) -> tuple[ScanFile, ...]:
    """Scans of one name, as a.stl and a.ply, get their endings back."""
    keys = [scan.key for scan in scans]
    return tuple(
        ScanFile(scanner=scan.scanner, specimen=scan.specimen, scan=scan.path.name, path=scan.path)
        if keys.count(scan.key) > 1
        else scan
        for scan in scans
    )


# --- a manifest -------------------------------------------------------------------------------------------------------


def _from_manifest(path: Path) -> StudyFiles:
    rows = storage.read_table(path, ("scanner", "specimen", "file", "reference"))
    references: dict[str, Path] = {}
    scans: list[ScanFile] = []
    remarks: list[Remark] = []
    for number, row in enumerate(rows, start=2):
        empty = [name for name in ("scanner", "specimen", "file", "reference") if not row[name]]
        if empty:
            raise InputError(f"{path}: line {number} has no {empty[0]}")
        reference = path.parent / row["reference"]
        if references.setdefault(row["specimen"], reference) != reference:
            raise InputError(f"{path}: line {number} gives specimen {row['specimen']} another reference than before")
        scans.append(_of_row(path, row))
    names = [scan.name for scan in scans]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{path}: {twice} occurs more than once; give each repeat its own name in the column scan")
    return StudyFiles(scans=tuple(scans), references=references, remarks=tuple(remarks))


def _of_row(path: Path, row: Mapping[str, str]) -> ScanFile:
    file = path.parent / row["file"]
    return ScanFile(
        scanner=row["scanner"],
        specimen=row["specimen"],
        scan=row.get("scan") or file.stem,
        path=file,
        operator=row.get("operator") or None,
        factors={name: value for name, value in row.items() if name and name not in COLUMNS},
    )
