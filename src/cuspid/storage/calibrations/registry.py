"""The formats by name; that of a file to read follows from its content, that of a file to write from its name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from cuspid.model.rig import MountedCamera, Rig
from cuspid.runtime.errors import InputError, OutputError
from cuspid.runtime.inputs import read_text
from cuspid.storage.calibrations import colmap, halcon, kalibr, matlab, metashape, nerfstudio, opencv, ros, tables
from cuspid.storage.calibrations.documents import Document, parse
from cuspid.storage.calibrations.fields import Calibration, Hints, scale_lengths
from cuspid.storage.calibrations.lenses import SPLINED, Lens, Loss, convert_lens
from cuspid.storage.files import list_finished, reading, whole_files, write_bytes
from cuspid.storage.handpieces import handpiece_of_rig, write_handpiece
from cuspid.storage.units import MM_PER_UNIT, Unit

Name = Literal[
    "opencv", "kalibr", "ros", "caliscope", "anipose", "nerfstudio", "colmap-rig", "colmap", "handpiece", "metashape",
    "matlab", "halcon",
]  # fmt: skip
_SUFFIXES = (".yml", ".yaml", ".json", ".toml", ".xml", ".txt", ".dat", ".cal")
_MOST_FILES = 64
_NEAREST_MM, _FARTHEST_MM = 0.5, 20_000.0
"""Between the two cameras of a rig that are farthest apart."""


@dataclass(frozen=True, kw_only=True)
class Format:
    """How a program keeps a calibration."""

    title: str
    unit: Unit | None
    """Of its lengths: where its files do not state it, the usual one."""
    tells_unit: bool = False
    """Whether that is always the unit."""
    lenses: tuple[Lens, ...]
    """What it can hold, the smallest first."""
    recognises: Callable[[Mapping[str, Document]], bool]
    """Whether files, by their stem, are of this format."""
    read: Callable[[Mapping[str, Document], Hints], Calibration]
    write: Callable[[Mapping[str, MountedCamera], str], str | Mapping[str, str]] | None
    """Text of a file with a given suffix, or several by their name; lengths are in :attr:`unit`."""
    max_cameras: int | None = None
    keeps_names: bool = True


FORMATS: Mapping[Name, Format] = {
    "handpiece": Format(
        title="cuspid's handpiece.json", unit="mm", tells_unit=True, lenses=(*colmap.LENSES, SPLINED),
        recognises=colmap.recognises_handpiece, read=colmap.read_handpiece, write=None,
    ),
    "colmap-rig": Format(
        title="COLMAP's rig_config.json", unit="mm", lenses=colmap.LENSES, recognises=colmap.recognises_config,
        read=colmap.read_config, write=colmap.write_config,
    ),
    "colmap": Format(
        title="COLMAP's cameras.txt and images.txt", unit="mm", lenses=colmap.LENSES,
        recognises=colmap.recognises_model, read=colmap.read_model, write=None,
    ),
    "nerfstudio": Format(
        title="Nerfstudio's transforms.json", unit="m", lenses=nerfstudio.LENSES, recognises=nerfstudio.recognises,
        read=nerfstudio.read, write=nerfstudio.write,
    ),
    "kalibr": Format(
        title="Kalibr's camchain", unit="m", tells_unit=True, lenses=kalibr.LENSES, recognises=kalibr.recognises,
        read=kalibr.read, write=kalibr.write, keeps_names=False,
    ),
    "ros": Format(
        title="ROS camera_info", unit="m", tells_unit=True, lenses=ros.LENSES, recognises=ros.recognises,
        read=ros.read, write=ros.write, max_cameras=2,
    ),
    "matlab": Format(
        title="MATLAB's stereoParameters", unit="mm", lenses=matlab.LENSES, recognises=matlab.recognises,
        read=matlab.read, write=matlab.write, max_cameras=2, keeps_names=False,
    ),
    "metashape": Format(
        title="Metashape's XML", unit="m", lenses=metashape.LENSES, recognises=metashape.recognises,
        read=metashape.read, write=metashape.write,
    ),
    "caliscope": Format(
        title="caliscope's camera_array.toml", unit="m", lenses=tables.LENSES, recognises=tables.recognises_caliscope,
        read=tables.read, write=tables.write_caliscope, keeps_names=False,
    ),
    "anipose": Format(
        title="anipose's calibration.toml", unit="mm", lenses=tables.LENSES, recognises=tables.recognises_anipose,
        read=tables.read, write=tables.write_anipose,
    ),
    "halcon": Format(
        title="HALCON's camera parameters", unit="m", tells_unit=True, lenses=halcon.LENSES,
        recognises=halcon.recognises, read=halcon.read, write=None,
    ),
    "opencv": Format(
        title="OpenCV's FileStorage", unit="mm", lenses=opencv.LENSES, recognises=opencv.recognises, read=opencv.read,
        write=opencv.write,
    ),
}  # fmt: skip
"""In the order in which they are recognised: what has marks of its own comes first."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReadCalibration:
    """A calibration of any program, in millimetres."""

    rig: Rig
    format: Name
    losses: Mapping[str, Loss]
    """Of cameras whose lens is of another kind than cuspid's."""
    notes: tuple[str, ...]
    """What was assumed, or left out."""


def read_calibration(
    path: Path,
    *,
    kind: Name | None = None,
    unit: Unit | None = None,
    image_size_px: tuple[int, int] | None = None,
) -> ReadCalibration:
    """Read a file, or the files of a folder where a program writes several. ``unit`` and ``image_size_px`` say what a
    file leaves out, ``kind`` what it is. Raises InputError."""
    files = _documents(path)
    with reading(path):
        name = kind or _recognise(files)
        found = FORMATS[name].read(files, Hints(image_size_px=image_size_px))
        unit_found, note = _unit(FORMATS[name], found, unit)
        rig = Rig({each: scale_lengths(mounted, MM_PER_UNIT[unit_found]) for each, mounted in found.cameras.items()})
    return ReadCalibration(rig=rig, format=name, losses=found.losses, notes=found.notes + note)


def _documents(path: Path) -> Mapping[str, Document]:
    paths = [path]
    if path.is_dir():
        paths = sorted(each for each in list_finished(path) if each.suffix.lower() in _SUFFIXES and each.is_file())
        if not 0 < len(paths) <= _MOST_FILES:
            raise InputError(f"{path}: {len(paths)} files may be calibrations; give the file, or a folder of few")
    documents = {}
    for each in paths:
        with reading(each):
            documents[each.stem] = parse(read_text(each))
    return documents


def _recognise(files: Mapping[str, Document]) -> Name:
    for name, each in FORMATS.items():
        if each.recognises(files):
            return name
    known = ", ".join(FORMATS)
    raise InputError(f"it is no known calibration format ({known}); name it with cuspid rig convert --from")


def _unit(format: Format, found: Calibration, given: Unit | None) -> tuple[Unit, tuple[str, ...]]:
    """The unit of lengths, and what is to be said of it."""
    known_unit = format.unit if format.tells_unit else found.unit
    if given is not None or known_unit is not None:
        return given or known_unit or "mm", ()
    centres = [each.centre_in_rig for each in found.cameras.values()]
    apart = max((float(np.linalg.norm(one - other)) for one, other in combinations(centres, 2)), default=0.0)
    usual = format.unit or "mm"
    if apart == 0:
        return usual, ()
    candidates: tuple[Unit, ...] = (usual, "m", "mm")
    likely = next((each for each in candidates if _NEAREST_MM <= apart * MM_PER_UNIT[each] <= _FARTHEST_MM), usual)
    note = f"the file states no unit of length; {likely} is assumed: its cameras are up to {apart:.4g} {likely} apart"
    return likely, (f"{note} (--unit)",)


def format_of_name(path: Path) -> Name:
    """The format that a file of this name has. Raises OutputError where several could be meant."""
    name, suffix = path.name.lower(), path.suffix.lower()
    by_name: dict[str, Name] = {
        "rig_config": "colmap-rig", "transforms": "nerfstudio", "camera_array": "caliscope", "calibration": "anipose",
        "stereoparams": "matlab",
    }  # fmt: skip
    by_suffix: dict[str, Name] = {".json": "handpiece", ".toml": "anipose", ".xml": "metashape"}
    if suffix in (".json", ".toml"):
        return by_name.get(path.stem.lower(), by_suffix[suffix])
    if suffix in (".yml", ".yaml"):
        return "kalibr" if "camchain" in name else "ros" if "camera_info" in name else "opencv"
    if suffix in by_suffix:
        return by_suffix[suffix]
    raise OutputError(f"{path}: its name does not say what to write; give --to: {', '.join(FORMATS)}")


@dataclass(frozen=True, eq=False, kw_only=True)
class CarriedOver:
    """A rig as far as a format can hold it."""

    rig: Rig
    losses: Mapping[str, Loss]
    """Of cameras whose lens the format does not have."""
    notes: tuple[str, ...]
    """What else is left out."""


def fit_to_format(rig: Rig, kind: Name) -> CarriedOver:
    """What a format can hold of a rig. Raises OutputError where that is too little."""
    format = FORMATS[kind]
    if format.write is None and kind != "handpiece":
        raise OutputError(f"{format.title} is only read; give another --to")
    count = len(rig.names)
    if format.max_cameras is not None and count > format.max_cameras:
        raise OutputError(f"{format.title} holds {format.max_cameras} cameras at most, not {count}; give another --to")
    lenses = {name: convert_lens(mounted.camera, format.lenses) for name, mounted in rig.cameras.items()}
    cameras = {name: replace(mounted, camera=lenses[name][0]) for name, mounted in rig.cameras.items()}
    notes = []
    if kind != "handpiece" and any(
        each.covariance is not None or each.camera.covariance is not None for each in rig.cameras.values()
    ):
        notes.append(f"{format.title} has no place for covariances: they are left out")
    if not format.keeps_names and count > 1:
        notes.append(f"{format.title} numbers cameras: their order is {', '.join(rig.names)}")
    return CarriedOver(
        rig=Rig(cameras),
        losses={name: loss for name, (_, loss) in lenses.items() if loss is not None},
        notes=tuple(notes),
    )


def write_calibration(path: Path, rig: Rig, kind: Name, working_distance_mm: float | None = None) -> None:
    """Write a rig that a format can hold: a file, or a folder of several where it has one for each camera. The working
    distance is that of a handpiece; see :func:`cuspid.storage.handpieces.read_handpiece`."""
    if kind == "handpiece":
        write_handpiece(path, handpiece_of_rig(path, rig, working_distance_mm))
        return
    format = FORMATS[kind]
    if format.write is None:
        raise OutputError(f"{path}: {format.title} is only read; give another format")
    cameras = {name: scale_lengths(each, 1 / MM_PER_UNIT[format.unit or "mm"]) for name, each in rig.cameras.items()}
    text = format.write(cameras, path.suffix.lower())
    if isinstance(text, str):
        write_bytes(path, text.encode())
        return
    if path.suffix:
        raise OutputError(f"{path}: {format.title} has a file for each camera; give a folder")
    with whole_files(path) as folder:
        for name, each in text.items():
            (folder / name).write_text(each, encoding="utf-8")
