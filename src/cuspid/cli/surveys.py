"""What many jaws have in common: their dimensions, and their mean shape."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional

from cuspid import storage
from cuspid.anatomy.jaw_files import Labelling, jaw_files, load_landmarked_jaw
from cuspid.anatomy.landmarks.dimensions import (
    DIMENSIONS,
    Dimension,
    GroupStatistics,
    Survey,
    arch_dimensions,
    arch_of,
    group_rows,
    implausible,
    jaw_rows,
    needed_landmarks,
    survey,
)
from cuspid.anatomy.numbering import Numbering
from cuspid.anatomy.shape.mean import MeanShapeOptions, mean_shape
from cuspid.cli.report import report
from cuspid.cli.shared import Flat, console, show_progress
from cuspid.model.jaw import Arch, Jaw
from cuspid.model.shape_model import ShapeModel
from cuspid.report.figures.drawing import save_picture
from cuspid.report.figures.landmark import save_landmark_picture, save_measure_picture
from cuspid.report.figures.shape import save_modes_picture, save_variance_picture
from cuspid.runtime.errors import InputError


def measure(
    jaws: Annotated[Path, Positional],
    *,
    out: Path,
    landmarks: Path | None = None,
    unit: storage.Unit = "mm",
    arch: Arch | None = None,
    labels: Numbering = "auto",
    label_map: Path | None = None,
) -> None:
    """Measure the arch dimensions a, b, c and f of a jaw or of a folder of jaws, and tabulate them by group.

    Args:
        jaws: A jaw mesh, or a folder of them. Landmarks are read from <name>.landmarks.json or <name>.mrk.json (3D
            Slicer) beside a mesh, or come with the jaw; missing ones are estimated from the tooth labels.
        out: Folder for jaws.csv, groups.csv (in the form of Table 2.1), measure.json, and a picture and the landmarks
            of each jaw.
        landmarks: File with the landmarks, for a single jaw whose landmarks are not beside it.
        unit: Length unit of the mesh files.
        arch: Upper or lower, if neither the files nor their names say so.
        labels: Numbers of the tooth labels in the files; found out from where the teeth stand unless given.
        label_map: JSON file of each label in the mesh files and its FDI number, for other numbers: {"1": 47, "2": 46}.
    """
    files, labelling = jaw_files(jaws), Labelling(numbering=labels, label_map=label_map)
    if landmarks is not None and len(files) > 1:
        raise InputError(
            f"{landmarks}: a single file of landmarks for {len(files)} jaws; put one beside each mesh instead"
        )
    hashes = {path.name: storage.hash_file(path) for path in _require_different_names(files)}
    with (
        storage.claimed_folder(out, "measure", {"arch": arch, "labels": labels}, hashes, replace=True),
        show_progress() as progress,
    ):

        def load(number: int, path: Path) -> tuple[Jaw, tuple[str, ...]]:
            jaw, notes = load_landmarked_jaw(path, unit=unit, arch=arch, landmarks=landmarks, labelling=labelling)
            storage.write_landmarks(out / f"{path.stem}.landmarks.json", jaw.landmarks, "occlusal")
            _save_pictures(out, path.stem, jaw)
            progress("jaws", number, len(files))
            return jaw, notes

        found = survey({path.stem: partial(load, number, path) for number, path in enumerate(files, start=1)})
        storage.write_table(out / "jaws.csv", jaw_rows(found), digits=3)
        storage.write_table(out / "groups.csv", group_rows(found), digits=3)
        storage.write_json(out / "measure.json", found)
    _print_survey(found)


def _require_different_names(files: Sequence[Path]) -> Sequence[Path]:
    """The files, whose results are named after them."""
    for one, other in pairwise(sorted(files, key=lambda path: path.stem)):
        if one.stem == other.stem:
            raise InputError(f"{one}: {other.name} beside it has the same name; rename one of them")
    return files


def _save_pictures(out: Path, name: str, jaw: Jaw) -> None:
    save_landmark_picture(out / f"{name}.landmarks.png", jaw, title=name)
    dimensions = arch_dimensions(jaw.landmarks, arch_of(jaw))
    values = {each: found.value_mm for each in DIMENSIONS if (found := dimensions[each]) is not None}
    lines = {each: labels for each, labels in needed_landmarks(arch_of(jaw)).items() if each in values}
    save_measure_picture(out / f"{name}.png", jaw, lines, values, title=name)


def _print_survey(found: Survey) -> None:
    table = Table(title="Arch dimensions in mm (± standard uncertainty where estimated)", title_justify="left")
    for column in ("jaw", "group", *DIMENSIONS):
        table.add_column(column, justify="left" if column in ("jaw", "group") else "right", no_wrap=True)
    for jaw in found.jaws:
        table.add_row(jaw.name, jaw.group, *(_length(jaw.dimensions[name]) for name in DIMENSIONS))
    Console().print(table)
    groups = Table(title="Groups: mean ± SD in mm", title_justify="left")
    for column in ("group", "jaws", *DIMENSIONS):
        groups.add_column(column, justify="left" if column == "group" else "right", no_wrap=True)
    for group, cells in found.groups.items():
        count = str(max(cell.count for cell in cells.values()))
        groups.add_row(group, count, *(_format_spread(cells.get(name)) for name in DIMENSIONS))
    Console().print(groups)
    for jaw in found.jaws:
        for flag in (*jaw.notes, *implausible(jaw)):
            console.print(f"note: {jaw.name}: {flag}")
    for name, reason in found.failures.items():
        console.print(f"  not measured: {name}: {reason}")


def _length(found: Dimension | None) -> str:
    if found is None:
        return "-"
    return f"{found.value_mm:.2f}" if found.sigma_mm is None else f"{found.value_mm:.1f}±{found.sigma_mm:.1f}"


def _format_spread(cell: GroupStatistics | None) -> str:
    if cell is None:
        return "-"
    return f"{cell.mean_mm:.1f}" + ("" if cell.std_mm is None else f"±{cell.std_mm:.1f}")


def shape(
    jaws: Annotated[Path, Positional],
    *,
    out: Path,
    unit: storage.Unit = "mm",
    arch: Arch | None = None,
    labels: Numbering = "auto",
    label_map: Path | None = None,
    options: Annotated[MeanShapeOptions, Flat] = MeanShapeOptions(),
) -> None:
    """Find the mean jaw of a folder of labelled jaws, and the principal modes in which they vary.

    Args:
        jaws: Folder of jaw meshes. Landmarks are read from the JSON file beside a mesh, or estimated from its labels.
        out: Folder for mean.ply, modes.npz, shape.json and pictures.
        unit: Length unit of the mesh files.
        arch: Upper or lower, if neither the files nor their names say so.
        labels: Numbers of the tooth labels in the files; found out from where the teeth stand unless given.
        label_map: JSON file of each label in the mesh files and its FDI number, for other numbers: {"1": 47, "2": 46}.
    """
    files, labelling = jaw_files(jaws), Labelling(numbering=labels, label_map=label_map)
    hashes = {path.name: storage.hash_file(path) for path in _require_different_names(files)}
    with storage.claimed_folder(out, "shape", {"shape": options}, hashes, replace=True), show_progress() as progress:
        samples = {path.stem: _load_jaw(path, unit, arch, labelling) for path in files}
        model = mean_shape(samples, options, progress=progress)
        storage.write_shape_model(out, model)
        save_picture(out / "mean.png", model.mean.mesh, title=f"Mean of {len(samples)} jaws")
        save_modes_picture(out / "modes.png", model)
        save_variance_picture(out / "variance.png", model)
    _print_model(model)
    report(out)


def _load_jaw(path: Path, unit: storage.Unit, arch: Arch | None, labelling: Labelling) -> Jaw:
    jaw, notes = load_landmarked_jaw(path, unit=unit, arch=arch, labelling=labelling)
    for note in notes:
        console.print(f"note: {path.stem}: {note}")
    return jaw


def _print_model(model: ShapeModel) -> None:
    for number, step in enumerate(model.log, start=1):
        console.print(f"round {number}: the mean's surface moved {step.surface_change_um:.1f} µm")
    if not model.converged:
        console.print("note: the mean has not converged; increase --max-rounds or --tolerance-um")
    table = Table(title=f"{'Shape' if model.scaled else 'Shape and size'}: modes", title_justify="left")
    for column in ("mode", "SD, mm", "share of variance, %"):
        table.add_column(column, justify="right")
    for number, (sd, share) in enumerate(
        zip(model.standard_deviations_mm, model.variance_shares, strict=True), start=1
    ):
        table.add_row(str(number), f"{sd:.3f}", f"{100 * share:.1f}")
    Console().print(table)
    for note in model.notes:
        console.print(f"note: {note}")
