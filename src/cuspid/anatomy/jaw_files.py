"""Jaws that a user brings: mesh files in any frame, with labels and landmarks where there are any."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int

from cuspid.anatomy.landmarks.estimation import with_estimates
from cuspid.anatomy.landmarks.scheme import in_frame, missing, validate
from cuspid.anatomy.numbering import Numbered, Numbering, number_teeth
from cuspid.anatomy.orientation import check_scale, find_occlusal_frame, require_one_jaw
from cuspid.anatomy.tooth_colors import face_colors_of, number_regions, tooth_regions
from cuspid.geometry import Rigid3
from cuspid.model.facing import facing_outwards
from cuspid.model.jaw import ARCHES, Arch, Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import is_there
from cuspid.storage.files import list_finished, reading
from cuspid.storage.jaws import is_jaw, read_label_map, read_labelled_mesh
from cuspid.storage.jaws import read_jaw as read_own_jaw
from cuspid.storage.landmarks import MARKUPS_SUFFIX, read_landmarks
from cuspid.storage.meshes import MESH_SUFFIXES
from cuspid.storage.units import Unit

_log = logging.getLogger("cuspid")

_GIVE_LABELS = "give a landmark file or a labelled mesh"


@dataclass(frozen=True, kw_only=True)
class Labelling:
    """How the tooth labels of a mesh file are understood."""

    numbering: Numbering = "auto"
    """Their numbers; found out from where the teeth stand unless given."""
    label_map: Path | None = None
    """A JSON file of each label and its FDI number."""

    def fdi(
        self, path: Path, labels: Int[np.ndarray, "f"], mesh: Mesh, *, arch: Arch | None = None, sure: bool = True
    ) -> Numbered:
        """The labels of a file in FDI numbers, for its mesh in the occlusal frame; see :func:`number_teeth`."""
        table = None if self.label_map is None else read_label_map(self.label_map)
        return number_teeth(
            str(path),
            labels,
            mesh,
            arch=arch or arch_from_name(path),
            sure=sure,
            numbering=self.numbering,
            label_map=table,
        )


def arch_from_name(path: Path) -> Arch | None:
    """The arch that the name of a file says: ``lower`` or ``upper`` stands in it."""
    named = [arch for arch in ARCHES if arch in path.stem.lower()]
    return named[0] if len(named) == 1 else None


def read_jaw(
    path: Path | str, *, unit: Unit = "mm", arch: Arch | None = None, labelling: Labelling = Labelling()
) -> Jaw:
    """As :func:`load_jaw`; the notes are logged."""
    jaw, notes = load_jaw(Path(path), unit=unit, arch=arch, labelling=labelling)
    for note in notes:
        _log.warning(note)
    return jaw


def load_jaw(
    path: Path, *, unit: Unit = "mm", arch: Arch | None = None, labelling: Labelling = Labelling()
) -> tuple[Jaw, tuple[str, ...]]:
    """A user's jaw mesh, brought into the occlusal frame, and notes on what was found or is unsure; a jaw that cuspid
    wrote, as it is.

    Raises InputError where the file is no mesh, its width is not that of a jaw in the given unit, or its labels are not
    understood.
    """
    jaw, notes, _ = _load_oriented(path, unit, arch, labelling)
    return jaw, notes


def _load_oriented(
    path: Path, unit: Unit, arch: Arch | None, labelling: Labelling, *, needs_teeth: bool = False
) -> tuple[Jaw, tuple[str, ...], Rigid3]:
    """As :func:`load_jaw`, with ``occlusal_from_mesh``; where teeth are needed, what does not tell them is refused
    before it takes time."""
    if is_jaw(path):
        return read_own_jaw(path), (), Rigid3.identity()
    mesh, labels, colors = read_labelled_mesh(path, unit)
    colors = face_colors_of(mesh, colors)
    regions = tooth_regions(colors, mesh) if labels is None and colors is not None else None
    if needs_teeth:
        _require_teeth(path, labels is not None, colors is not None, regions, arch)
    scale = check_scale(mesh, unit)
    mesh, facing = facing_outwards(mesh)
    with reading(path):
        require_one_jaw(mesh)
    occlusal = find_occlusal_frame(mesh)
    moved = mesh.transformed(occlusal.occlusal_from_mesh)
    notes = (*scale, *facing, *occlusal.notes)
    if labels is not None:
        numbered = labelling.fdi(path, labels, moved, arch=arch, sure=not occlusal.notes)
        labels, notes = numbered.labels, (*notes, *numbered.notes)
    elif regions is not None and arch is not None:
        labels = number_regions(regions, moved, arch)
        if labels is None and needs_teeth:
            raise InputError(
                f"{path}: its colours separate {regions.max()} teeth, but these are not one row without a gap, so they "
                f"cannot be numbered; {_GIVE_LABELS}"
            )
    return Jaw(mesh=moved, face_labels=labels, arch=arch), notes, occlusal.occlusal_from_mesh


def _require_teeth(
    path: Path, labelled: bool, colored: bool, regions: Int[np.ndarray, "f"] | None, arch: Arch | None
) -> None:
    """Raise InputError where neither labels nor colours tell the teeth."""
    if labelled:
        return
    if regions is None:
        colors = "; its colours are not those of gum and teeth, one each" if colored else ""
        raise InputError(f"{path}: it has neither landmarks nor tooth labels{colors}; {_GIVE_LABELS}")
    if arch is None:
        raise InputError(
            f"{path}: its colours separate {regions.max()} teeth, but do not show whether they are lower or upper; "
            f"give --arch"
        )


def jaw_files(folder: Path) -> list[Path]:
    """The mesh files of a folder, or the one file that is given. Raises InputError where there is none."""
    if folder.is_file():
        return [folder]
    if not folder.is_dir():
        raise InputError(f"{folder}: no such file or folder")
    found = sorted(path for path in list_finished(folder) if path.suffix.lower() in MESH_SUFFIXES)
    if not found:
        raise InputError(f"{folder}: there are no jaw meshes in it; give a folder with STL, PLY, OBJ or OFF files")
    return found


def load_landmarked_jaw(
    path: Path,
    *,
    unit: Unit = "mm",
    arch: Arch | None = None,
    landmarks: Path | None = None,
    labelling: Labelling = Labelling(),
) -> tuple[Jaw, tuple[str, ...]]:
    """As :func:`load_jaw`, with landmarks: from a file, or those that the jaw came with; the rest is estimated from its
    labels, where it has any.

    A file ``<name>.landmarks.json`` or ``<name>.mrk.json`` beside the mesh is found by itself. ``lower`` or ``upper``
    in the name of the mesh gives the arch where nothing else does. Raises InputError for a landmark that the scheme or
    the jaw does not know, and where there are neither landmarks nor labels.
    """
    beside = (path.with_suffix(suffix) for suffix in (".landmarks.json", MARKUPS_SUFFIX))
    file = landmarks or next((each for each in beside if is_there(each)), None)
    jaw, notes, occlusal_from_mesh = _load_oriented(
        path, unit, arch or arch_from_name(path), labelling, needs_teeth=file is None
    )
    if file is not None:
        given = read_landmarks(file)
        validate(given.landmarks, jaw.teeth, source=str(file))
        placed = in_frame(given.landmarks, occlusal_from_mesh) if given.frame == "mesh" else given.landmarks
        jaw, notes = replace(jaw, landmarks=placed), (*notes, *given.notes)
    if jaw.face_labels is not None and missing(jaw.landmarks, jaw.teeth):
        jaw = with_estimates(jaw)
    if not jaw.landmarks:
        raise InputError(f"{path}: it has neither landmarks nor tooth labels; {_GIVE_LABELS}")
    return jaw, notes
