"""Jaws: meshes with tooth labels, and what a mesh file cannot hold as JSON beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, UInt8

from cuspid.model.jaw import ARCHES, FDI_FROM_UNIVERSAL, GUM, Arch, Jaw, Landmark, Sphere
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import is_there, require_file
from cuspid.runtime.values import LONGEST_MM, number, numbers, one_line, quote, whole
from cuspid.storage.files import read_json, reading, write_json
from cuspid.storage.meshes import MESH_SUFFIXES, MeshFile, read_mesh_file, write_mesh
from cuspid.storage.units import Unit

_LARGEST_LABEL = 10_000
OCCLUSAL = "occlusal"
"""Name of the frame of a jaw in its JSON file."""


def read_labelled_mesh(
    path: Path, unit: Unit = "mm"
) -> tuple[Mesh, Int[np.ndarray, "f"] | None, UInt8[np.ndarray, "f 3"] | None]:
    """As :func:`cuspid.storage.meshes.read_mesh`, with the label, in whatever numbers, and the colour of each face
    where the file has them.

    Labels are the PLY face property ``label``, or a file ``<name>_facelabels.npy`` beside it. Raises InputError where
    their number is not that of the faces.
    """
    file = read_mesh_file(path, unit)
    labels = _labels_of(path, file)
    if labels is not None and len(labels) != len(file.mesh.faces):
        raise InputError(f"{path}: {len(labels)} labels for {len(file.mesh.faces)} faces; each face needs exactly one")
    return file.mesh, labels, file.face_colors


def _labels_of(path: Path, file: MeshFile) -> Int[np.ndarray, "f"] | None:
    beside = path.with_name(f"{path.stem}_facelabels.npy")
    if is_there(beside):
        return _whole(beside, _read_array(beside))
    return _whole(path, file.face_values["label"]) if "label" in file.face_values else None


def _read_array(path: Path) -> np.ndarray:
    try:
        return np.asarray(np.load(require_file(path, "arrays"), allow_pickle=False))
    except InputError:
        raise
    except Exception as error:  # NumPy raises whatever it meets, up to MemoryError
        raise InputError(f"{path}: not a readable array of labels ({one_line(error)})") from error


def _whole(path: Path, labels: np.ndarray) -> Int[np.ndarray, "f"]:
    if labels.dtype.kind not in "iuf" or not np.all(np.abs(labels) < _LARGEST_LABEL) or np.any(labels % 1):
        raise InputError(f"{path}: tooth labels must be whole numbers")
    return labels.astype(np.int64).reshape(-1)


def read_label_map(path: Path) -> dict[int, int]:
    """Which FDI number each label stands for, from a JSON file: ``{"1": 47, "2": 46}``; 0 is gum."""
    found = read_json(path)
    if not isinstance(found, dict) or not found:
        raise InputError(f'{path}: must hold each label and its FDI number, as {{"1": 47, "2": 46}}')
    try:
        table = {int(label): int(whole(f"label {label}", fdi, 0, 48)) for label, fdi in found.items()}
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except ValueError as error:
        raise InputError(f"{path}: labels are whole numbers ({one_line(error)})") from error
    for label, fdi in table.items():
        if fdi != GUM and fdi not in FDI_FROM_UNIVERSAL.values():
            raise InputError(f"{path}: label {label} cannot be {fdi}, which is not an FDI number")
    return table


def write_jaw(path: Path, jaw: Jaw) -> None:
    """Write a jaw as PLY with its labels, and what a mesh file cannot hold as JSON beside it."""
    write_mesh(path, jaw.mesh, jaw.face_labels)
    extra = {
        "frame": OCCLUSAL,
        "arch": jaw.arch,
        "landmarks": {
            label: {"position_mm": point.position, "estimated_sigma_mm": point.estimated_sigma_mm}
            for label, point in jaw.landmarks.items()
        },
        "lines_mm": jaw.lines,
        "spheres": {
            label: {"centre_mm": sphere.centre, "radius_mm": sphere.radius_mm} for label, sphere in jaw.spheres.items()
        },
    }
    write_json(path.with_suffix(".json"), extra)


def is_jaw(path: Path) -> bool:
    """Whether :func:`write_jaw` wrote a mesh file, so that its frame is known and more than the mesh may be read."""
    beside = path.with_suffix(".json")
    if path.suffix.lower() not in MESH_SUFFIXES or not is_there(beside):
        return False
    extra = read_json(beside)
    return isinstance(extra, dict) and extra.get("frame") == OCCLUSAL


def read_jaw(path: Path) -> Jaw:
    """A jaw that :func:`write_jaw` wrote, already in the occlusal frame and in mm.

    Raises InputError where the JSON beside the mesh is missing or broken.
    """
    mesh, labels, _ = read_labelled_mesh(path)
    if labels is not None and not set(np.unique(labels).tolist()) <= {GUM, *FDI_FROM_UNIVERSAL.values()}:
        raise InputError(f"{path}: its tooth labels are not FDI numbers, which those of a jaw by cuspid are")
    beside = path.with_suffix(".json")
    extra = read_json(beside)
    with reading(beside):
        arch: Arch | None = extra["arch"]
        if arch not in (*ARCHES, None):
            raise ValueError(f"arch is {quote(arch)}")
        return Jaw(
            mesh=mesh,
            face_labels=labels,
            arch=arch,
            landmarks={
                label: Landmark(_places(point["position_mm"], 3), _length(point["estimated_sigma_mm"]))
                for label, point in extra["landmarks"].items()
            },
            lines={label: _places(line, len(line), 3) for label, line in extra["lines_mm"].items()},
            spheres={
                label: Sphere(
                    _places(sphere["centre_mm"], 3), number("radius_mm", sphere["radius_mm"], 1e-6, LONGEST_MM)
                )
                for label, sphere in extra["spheres"].items()
            },
        )


def _places(value: Any, *shape: int) -> np.ndarray:
    return numbers("a place", value, shape, -LONGEST_MM, LONGEST_MM)


def _length(value: Any) -> float | None:
    return None if value is None else number("estimated_sigma_mm", value, 0.0, LONGEST_MM)
