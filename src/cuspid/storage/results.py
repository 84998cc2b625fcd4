"""What lies in a folder that a verb wrote, gathered for those who show it.

A folder may hold less than its verb writes, because the run was killed or only some stages were run: what is missing is
listed, one line each, with the command that makes it.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.facing import facing_outwards
from cuspid.model.jaw import FDI_FROM_UNIVERSAL, GUM, Arch, Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.panorama import Panorama
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Rig
from cuspid.model.shape_model import ShapeModel
from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import read_text
from cuspid.runtime.values import LONGEST_MM, numbers
from cuspid.storage.captures import read_capture
from cuspid.storage.files import hash_file, read_arrays, read_json, read_manifest, reading
from cuspid.storage.handpieces import read_handpiece
from cuspid.storage.jaws import is_jaw, read_jaw, read_labelled_mesh
from cuspid.storage.meshes import SIGMA, MeshFile, read_mesh_file
from cuspid.storage.panoramas import read_panorama
from cuspid.storage.reconstructions import read_reconstruction
from cuspid.storage.shapes import read_shape_model
from cuspid.storage.units import Unit


@dataclass(frozen=True, eq=False, kw_only=True)
class _Result:
    """What all folders have."""

    name: str
    """Of the folder."""
    run: Mapping[str, Any]
    """``run.json``: for each stage its version, settings and the hashes of its inputs."""
    pictures: Mapping[str, Path] = field(default_factory=dict)
    """Pictures that the verb drew, by their caption."""
    missing: tuple[str, ...] = ()
    """What is not there, and how to get it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanResult(_Result):
    """A folder of ``run``, ``reconstruct`` or ``evaluate``."""

    scan: Mesh | None
    """The surface in its own frame."""
    deviation_um: Float[np.ndarray, "v"] | None
    """Signed deviation of each of its vertices, NaN where it is not evaluated; None before it was evaluated."""
    sigma_um: Float[np.ndarray, "v"] | None = None
    """Standard deviation that was expected of each of its vertices along the normal, NaN where it is not known; None
    where the surface does not have it."""
    trueness: Mapping[str, Any] | None
    """``trueness.json``."""
    reference_from_scan: Rigid3 | None
    """The alignment of the evaluation."""
    reference: Jaw | None
    """What it was compared with."""
    capture: Capture | None
    """The images."""
    reconstruction: Reconstruction | None
    """Where the frames were, in the frame of the scan."""
    cleaning: Mapping[str, Any] | None
    """``mesh.json``."""
    margins: Mapping[str, Any] | None
    """``margins.json``."""
    spheres: Mapping[str, Any] | None
    """``spheres.json``."""
    trajectory: Mapping[str, Any] | None
    """``trajectory.json``."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeResult(_Result):
    """A folder of ``shape``."""

    model: ShapeModel
    """The mean and the modes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StudyResult(_Result):
    """A folder of ``sweep`` or ``compare``."""

    verb: str
    """Which of them."""
    summary: Mapping[str, Any] | None
    """What was found: the JSON file with the name of the verb."""
    rows: Sequence[Mapping[str, str]]
    """``results.csv``, or what stands in ``cases/`` so far."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SpecimenView:
    """A specimen of a study of scanners, as it is shown."""

    name: str
    mesh: Mesh
    """A light mesh of the reference, in its occlusal frame."""
    full_faces: int
    """Faces of the reference itself."""
    arch: Arch | None
    frames: Mapping[str, Float[np.ndarray, "v"]]
    """Deviations in um at its vertices, by what they are of: the means of the scanners, then the scans. NaN is not
    known."""
    means: int
    """Number of means among them."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScannerStudyResult(_Result):
    """A folder of ``study``."""

    summary: Mapping[str, Any]
    """``study.json``."""
    views: tuple[SpecimenView, ...]
    """What is shown in 3-D."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PanoramaResult(_Result):
    """A folder of ``stitch``."""

    parts: tuple[Panorama, ...]
    """The panorama, or its parts where the sequence broke."""
    folders: tuple[Path, ...]
    """Where each of them lies."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoreResult(_Result):
    """A folder of ``stitch-eval``."""

    score: Mapping[str, Any]
    """``score.json``."""
    made: Path | None
    """The panorama laid over the true jaw, a picture of the same size as ``true``."""
    true: Path | None
    """The reference render of the true jaw."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationResult(_Result):
    """A folder of ``calibrate``."""

    calibration: Mapping[str, Any]
    """``calibration.json``."""
    rig: Rig | None
    """The calibrated cameras."""


Result = ScanResult | ShapeResult | StudyResult | ScannerStudyResult | PanoramaResult | ScoreResult | CalibrationResult


def read_result(folder: Path, reference: Path | None = None, unit: Unit = "mm") -> Result:
    """What lies in a folder that ``run``, ``evaluate``, ``shape``, ``sweep``, ``compare``, ``repeat``, ``study``,
    ``stitch``, ``rescale``, ``stitch-eval`` or ``calibrate`` wrote.

    ``reference``: the mesh (in a unit) with which a scan was compared, or the folder ``truth`` of a simulation, where
    the folder does not hold it. Raises InputError where there is nothing to report, a file is damaged, or the reference
    is another one.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the --out folder of a cuspid command")
    run = read_manifest(folder)
    for is_there, read in _READERS:
        if is_there(folder, run):
            return read(folder, run)
    if _is_scan(folder, run):
        return _read_scan(folder, run, reference, unit)
    made = f"; it holds only {', '.join(run)}" if run else ""
    raise InputError(
        f"{folder}: nothing to report{made}; give the --out folder of run, reconstruct, evaluate, shape, sweep, "
        "compare, repeat, study, stitch, rescale, stitch-eval or calibrate"
    )


# --- a scan -----------------------------------------------------------------------------------------------------------


def _is_scan(folder: Path, run: Mapping[str, Any]) -> bool:
    return bool(run.keys() & {"reconstruct", "evaluate"}) or (folder / "mesh.ply").exists()


def _read_scan(folder: Path, run: Mapping[str, Any], reference: Path | None, unit: Unit) -> ScanResult:
    missing: list[str] = []
    file = _surface(folder, missing)
    scan = None if file is None else file.mesh
    values = {} if file is None else file.vertex_values
    deviation_um = values.get("deviation_um")
    trueness = _optional_json(folder / "trueness.json")
    if trueness is None and scan is not None:
        missing.append("the trueness: run cuspid evaluate")
    jaw = _reference(folder, run, reference, unit, _evaluated_teeth(trueness))
    if jaw is None and trueness is not None:
        missing.append("the reference: give it with cuspid report --reference")
    known = trueness is not None
    if known and deviation_um is None:
        missing.append("the deviation of each vertex, which an older version did not keep: run cuspid evaluate again")
    if trueness is not None and "everything" not in trueness:
        missing.append("the open crown surface, which an older version did not measure: run cuspid evaluate again")
    located, captured = folder / "motion" / "reconstruction.json", folder / "capture" / "handpiece.json"
    if not located.exists():
        missing.append("the camera poses: a folder of cuspid run or reconstruct has them")
    if not captured.exists():
        missing.append("the images: a folder of cuspid run has them")
    return ScanResult(
        name=folder.resolve().name,
        run=run,
        missing=tuple(missing),
        scan=scan,
        deviation_um=deviation_um if known else None,
        sigma_um=_sigma_um(values.get(SIGMA)),
        trueness=trueness,
        reference_from_scan=None if trueness is None else _alignment(folder / "trueness.json", trueness),
        reference=jaw,
        capture=read_capture(folder / "capture") if captured.exists() else None,
        reconstruction=read_reconstruction(folder / "motion") if located.exists() else None,
        cleaning=_optional_json(folder / "mesh.json"),
        margins=_optional_json(folder / "margins.json"),
        spheres=_optional_json(folder / "spheres.json"),
        trajectory=_optional_json(folder / "trajectory.json"),
        pictures=_pictures(folder, _SCAN_PICTURES),
    )


_SCAN_PICTURES = {
    "expected.png": "How well each place is expected to be known (one standard deviation along the normal)",
    "spheres.png": "The spheres, measured without a best fit",
    "margins.png": "The margins of preparations, in sections across them",
}


def _surface(folder: Path, missing: list[str]) -> MeshFile | None:
    for name in ("deviation.ply", "mesh.ply"):
        if (folder / name).exists():
            return read_mesh_file(folder / name)
    missing.append("the surface: the run is not complete; run the same command again to continue")
    return None


def _sigma_um(given: Float[np.ndarray, "v"] | None) -> Float[np.ndarray, "v"] | None:
    """What a file says; what no standard deviation can be is not known."""
    return None if given is None else np.where(np.isfinite(given) & (given >= 0), given, np.nan)


def _evaluated_teeth(trueness: Any) -> set[str]:
    found = trueness.get("per_tooth", {}) if isinstance(trueness, dict) else {}
    return set(found) if isinstance(found, dict) else set()


def _reference(folder: Path, run: Mapping[str, Any], given: Path | None, unit: Unit, teeth: set[str]) -> Jaw | None:
    path = folder / "truth" if given is None else given
    path = path / "jaw.ply" if given is None or path.is_dir() else path
    if given is None and not path.exists():
        return None
    known = run.get("evaluate", {}).get("inputs_sha256", {})
    if given is not None and known and hash_file(path) not in known.values():
        raise InputError(f"{path}: not the reference that this scan was compared with; give that one")
    if is_jaw(path):
        return read_jaw(path)
    mesh, labels, _ = read_labelled_mesh(path, unit)
    # Labels of another numbering, which the evaluation understood, would name the wrong teeth.
    fdi = labels is not None and teeth <= set(map(str, np.unique(labels))) <= _FDI
    return Jaw(mesh=facing_outwards(mesh)[0], face_labels=labels if fdi else None)


_FDI = {str(GUM), *map(str, FDI_FROM_UNIVERSAL.values())}


def _alignment(path: Path, trueness: Mapping[str, Any]) -> Rigid3:
    with reading(path):
        matrix = numbers("reference_from_scan", trueness["reference_from_scan"], (4, 4), -LONGEST_MM, LONGEST_MM)
        return Rigid3.from_matrix(matrix)


# --- the others -------------------------------------------------------------------------------------------------------


def _read_shape(folder: Path, run: Mapping[str, Any]) -> ShapeResult:
    captions = {"modes.png": "Modes to either side of the mean", "variance.png": "Share of the variance"}
    return ShapeResult(
        name=folder.resolve().name,
        run=run,
        model=read_shape_model(folder),
        pictures=_pictures(folder, captions),
    )


_STUDIES: Mapping[str, tuple[str, Mapping[str, str]]] = {
    "sweep": ("sweep.json", {"sweep.png": "Each figure over baseline and angle"}),
    "compare": (
        "comparison.json",
        {"comparison.png": "What each handpiece needs and gives", "surfaces.png": "What each reconstructs, by surface"},
    ),
}


def _study_of(folder: Path, run: Mapping[str, Any]) -> str | None:
    return next((verb for verb, (file, _) in _STUDIES.items() if verb in run or (folder / file).exists()), None)


def _is_study(folder: Path, run: Mapping[str, Any]) -> bool:
    return _study_of(folder, run) is not None


def _read_study(folder: Path, run: Mapping[str, Any]) -> StudyResult:
    verb = _study_of(folder, run) or ""
    file, captions = _STUDIES[verb]
    summary, rows = _optional_json(folder / file), _rows(folder)
    missing = []
    if summary is None:
        missing.append(f"{file}: {len(rows)} cases are done; run the same command again to continue")
    return StudyResult(
        name=folder.resolve().name,
        run=run,
        verb=verb,
        summary=summary,
        rows=rows,
        missing=tuple(missing),
        pictures=_pictures(folder, captions),
    )


def _rows(folder: Path) -> list[Mapping[str, str]]:
    """The table of a study, or what is known before it is complete."""
    table = folder / "results.csv"
    if table.exists():
        return list(csv.DictReader(read_text(table).splitlines()))
    found: list[Mapping[str, str]] = []
    for path in sorted((folder / "cases").glob("*.json")):
        entry = read_json(path)
        with reading(path):
            cells = {**entry["parameters"], **entry["figures"], "failure": entry["failure"]}
        found.append({"case": path.stem, **{name: "" if cell is None else str(cell) for name, cell in cells.items()}})
    return found


_STUDY_FIGURES: Mapping[str, str] = {
    "trueness.png": "Trueness and precision: each point is a scan; boxes from the first to the third quartile, "
    "whiskers to the last scan within 1.5 of that range",
    "modes.png": "Deformation of the arch, a point for each scan: scale, and how far its ends move while the middle "
    "is fixed",
    "spans.png": "Error against span: each point is a distance of a scan; lines through zero by least squares",
    "agreement.png": "Two scanners on the same distances (Bland and Altman): bias and limits of agreement with their "
    "95 % intervals",
    "means.png": "Mean deviation of each scanner on each specimen, on one scale",
    "maps.png": "All scans, on one scale",
}


def _read_scanner_study(folder: Path, run: Mapping[str, Any]) -> ScannerStudyResult:
    summary = read_json(folder / "study.json")
    views = [_specimen_view(path) for path in (folder / "specimens").glob("*/view.npz")]
    return ScannerStudyResult(
        name=folder.resolve().name,
        run=run,
        summary=summary,
        views=tuple(sorted(views, key=lambda view: view.name)),
        missing=() if views else ("the 3-D view: run the same command again",),
        pictures=_pictures(folder / "figures", _STUDY_FIGURES),
    )


def _specimen_view(path: Path) -> SpecimenView:
    arrays = read_arrays(path, remedy="run the same command again")
    about = read_json(path.with_suffix(".json"))
    with reading(path):
        steps = arrays["steps"].astype(np.float64)
        values = np.where(steps == steps.dtype.type(-32768), np.nan, steps * 0.1)
        return SpecimenView(
            name=about["specimen"],
            mesh=Mesh(arrays["vertices"], arrays["faces"]),
            full_faces=about["faces"],
            arch=about["arch"],
            frames=dict(zip(about["frames"], values, strict=True)),
            means=int(arrays["means"]),
        )


def _is_panorama(folder: Path, run: Mapping[str, Any]) -> bool:
    return bool(run.keys() & {"stitch", "rescale"}) or (folder / "panorama.json").exists()


def _read_panorama(folder: Path, run: Mapping[str, Any]) -> PanoramaResult:
    folders = [folder, *sorted(folder.glob("part-*"))]
    there = tuple(each for each in folders if (each / "panorama.json").exists())
    if not there:
        raise InputError(f"{folder}: the panorama is not complete; run the same command again")
    captions = {
        "distances.png": "What the scale is from: distances that were measured between places of the arch",
        "camera_path.png": "The path of the camera over the arch",
    }
    pictures = _pictures(there[0], captions)
    return PanoramaResult(
        name=folder.resolve().name,
        run=run,
        parts=tuple(read_panorama(each) for each in there),
        folders=there,
        pictures=pictures,
    )


def _read_score(folder: Path, run: Mapping[str, Any]) -> ScoreResult:
    made, true = (_existing(folder / name) for name in ("made.png", "true.png"))
    missing = () if made and true else ("the side-by-side pictures: run cuspid pano evaluate again",)
    return ScoreResult(
        name=folder.resolve().name,
        run=run,
        score=read_json(folder / "score.json"),
        made=made,
        true=true,
        missing=missing,
        pictures=_pictures(folder, {"score.png": "The true jaw, the panorama over it, and where it errs"}),
    )


def _read_calibration(folder: Path, run: Mapping[str, Any]) -> CalibrationResult:
    handpiece = _existing(folder / "handpiece.json")
    captions = {
        "residuals.png": "Where each camera saw corners, and their residuals as lines",
        "uncertainty.png": "How well each lens is known: standard deviation of a projection, px",
        "lenses.png": "What a richer lens model would change, px",
        "photometry.png": "What the cameras make of light: gain and falloff, residuals, noise",
    }
    return CalibrationResult(
        name=folder.resolve().name,
        run=run,
        calibration=read_json(folder / "calibration.json"),
        rig=None if handpiece is None else read_handpiece(handpiece).rig,
        missing=() if handpiece else ("the cameras: run cuspid calibrate again",),
        pictures=_pictures(folder, captions),
    )


def _holds(file: str) -> Callable[[Path, Mapping[str, Any]], bool]:
    return lambda folder, run: (folder / file).exists()


_READERS: tuple[tuple[Callable[[Path, Mapping[str, Any]], bool], Callable[[Path, Mapping[str, Any]], Result]], ...] = (
    (_holds("shape.json"), _read_shape),
    (_holds("score.json"), _read_score),
    (_holds("calibration.json"), _read_calibration),
    (_holds("study.json"), _read_scanner_study),
    (_is_panorama, _read_panorama),
    (_is_study, _read_study),
)


def _optional_json(path: Path) -> Any:
    return read_json(path) if path.exists() else None


def _existing(path: Path) -> Path | None:
    return path if path.exists() else None


def _pictures(folder: Path, captions: Mapping[str, str]) -> dict[str, Path]:
    return {caption: folder / name for name, caption in captions.items() if (folder / name).exists()}
