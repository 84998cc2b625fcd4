"""Meshes and jaws: STL, PLY, OBJ, and what they cannot hold as JSON beside them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from cuspid.errors import InputError
from cuspid.jaw import FDI_FROM_UNIVERSAL, Arch, Jaw, Landmark, Sphere
from cuspid.mesh import Mesh
from cuspid.storage.files import read_json, reading, write_bytes, write_json

Unit = Literal["mm", "cm", "m", "in", "um"]
MM_PER_UNIT: Mapping[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "um": 0.001}
"""Length units that a mesh file may be in."""

_PLACE_AND_COLOR = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha"}
MESH_SUFFIXES = (".stl", ".ply", ".obj")

OCCLUSAL = "occlusal"
"""Name of the frame of a jaw in its JSON file."""


def read_mesh(path: Path, unit: Unit = "mm") -> Mesh:
    """A mesh from an STL, PLY or OBJ file, in mm, with coincident vertices joined.

    Raises InputError where the file is missing, not a mesh, empty, or has coordinates that are not finite.
    """
    return _read_triangles(path, unit)[0]


def _read_triangles(path: Path, unit: Unit) -> tuple[Mesh, trimesh.Trimesh]:
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{path}: not a mesh file that cuspid reads; give an STL, PLY or OBJ file")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        loaded = trimesh.load(path, process=False, force="mesh", skip_materials=True)
    except Exception as error:  # trimesh's loaders raise whatever the parser met
        raise InputError(f"{path}: not a mesh ({type(error).__name__}: {error}); export it again") from error
    vertices = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float64)
    faces = np.asarray(getattr(loaded, "faces", np.empty((0, 3))), dtype=np.int64)
    if len(vertices) == 0 or len(faces) == 0:
        raise InputError(f"{path}: the mesh is empty (no triangles); export the surface, not a point cloud")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: some coordinates are not finite numbers; repair the mesh and export it again")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: faces name vertices that do not exist; export the mesh again")
    colors = _vertex_colors(loaded)
    merged, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    mesh = Mesh(
        merged * MM_PER_UNIT[unit],
        inverse.reshape(-1)[faces],
        None if colors is None else colors[first],
    )
    return mesh, loaded


def _vertex_colors(loaded: trimesh.Trimesh) -> UInt8[np.ndarray, "v 3"] | None:
    if loaded.visual.kind != "vertex":
        return None
    return np.asarray(loaded.visual.vertex_colors, dtype=np.uint8)[:, :3]


def read_labelled_mesh(
    path: Path, unit: Unit = "mm"
) -> tuple[Mesh, Int[np.ndarray, "f"] | None, UInt8[np.ndarray, "f 3"] | None]:
    """As :func:`read_mesh`, with the FDI label and the colour of each face where the file has them.

    Labels are the PLY face property ``label``, or a file ``<name>_facelabels.npy`` beside it, in FDI or Universal
    numbers (recognised by their range). Raises InputError where their number is not that of the faces.
    """
    mesh, loaded = _read_triangles(path, unit)
    colors = None
    if loaded.visual.kind == "face":
        colors = np.asarray(loaded.visual.face_colors, dtype=np.uint8)[:, :3]
    beside = path.with_name(f"{path.stem}_facelabels.npy")
    if beside.exists():
        try:
            labels = np.load(beside, allow_pickle=False).astype(np.int64).reshape(-1)
        except (ValueError, OSError) as error:
            raise InputError(f"{beside}: not a readable array of labels ({error})") from error
    else:
        raw = loaded.metadata.get("_ply_raw", {}).get("face", {}).get("data")
        names = raw.dtype.names if raw is not None and getattr(raw, "dtype", None) is not None else ()
        labels = np.asarray(raw["label"], dtype=np.int64).reshape(-1) if names and "label" in names else None
    if labels is not None and len(labels) != len(mesh.faces):
        raise InputError(f"{path}: {len(labels)} labels for {len(mesh.faces)} faces; one for each is needed")
    return mesh, None if labels is None else _fdi_labels(labels, path), colors


def _fdi_labels(labels: Int[np.ndarray, "f"], path: Path) -> Int[np.ndarray, "f"]:
    values = {int(value) for value in np.unique(labels)} - {0}
    if values <= set(FDI_FROM_UNIVERSAL.values()) and (
        values & set(range(33, 49)) or not values & {9, 10, 19, 20, 29, 30}
    ):
        return labels
    if values <= set(FDI_FROM_UNIVERSAL):
        table = np.zeros(33, dtype=np.int64)
        for universal, fdi in FDI_FROM_UNIVERSAL.items():
            table[universal] = fdi
        return table[labels]
    raise InputError(f"{path}: tooth labels {sorted(values)[:6]} are neither FDI nor Universal numbers")


def write_mesh(
    path: Path,
    mesh: Mesh,
    face_labels: Int[np.ndarray, "f"] | None = None,
    *,
    values: Mapping[str, Float[np.ndarray, "v"]] = MappingProxyType({}),
) -> None:
    """Write a mesh in mm: binary PLY (with colour, labels and values of the vertices by name), binary STL or OBJ, by
    the file's suffix. CloudCompare shows such values as scalar fields."""
    exported = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colors, process=False)
    for name, each in values.items():
        exported.vertex_attributes[name] = each.astype(np.float32)
    if face_labels is not None:
        exported.face_attributes["label"] = face_labels.astype(np.int32)
    data = exported.export(file_type=path.suffix.lower().lstrip("."))
    write_bytes(path, data.encode() if isinstance(data, str) else data)


def read_vertex_values(path: Path) -> tuple[Mesh, dict[str, Float[np.ndarray, "v"]]]:
    """As :func:`read_mesh`, with the values of the vertices by name, which :func:`write_mesh` wrote to a PLY file."""
    mesh, loaded = _read_triangles(path, "mm")
    raw = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = [] if raw is None else [name for name in raw.dtype.names or () if name not in _PLACE_AND_COLOR]
    _, first = np.unique(np.asarray(loaded.vertices, dtype=np.float64), axis=0, return_index=True)
    return mesh, {name: np.asarray(raw[name], dtype=np.float64).reshape(-1)[first] for name in names}


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
    if path.suffix.lower() not in MESH_SUFFIXES or not beside.is_file():
        return False
    extra = read_json(beside)
    return isinstance(extra, dict) and extra.get("frame") == OCCLUSAL


def read_jaw(path: Path) -> Jaw:
    """A jaw that :func:`write_jaw` wrote, already in the occlusal frame and in mm.

    Raises InputError where the JSON beside the mesh is missing or broken.
    """
    mesh, labels, _ = read_labelled_mesh(path)
    beside = path.with_suffix(".json")
    extra = read_json(beside)
    with reading(beside):
        arch: Arch | None = extra["arch"]
        return Jaw(
            mesh=mesh,
            face_labels=labels,
            arch=arch,
            landmarks={
                label: Landmark(np.array(point["position_mm"], dtype=np.float64), point["estimated_sigma_mm"])
                for label, point in extra["landmarks"].items()
            },
            lines={label: np.array(line, dtype=np.float64) for label, line in extra["lines_mm"].items()},
            spheres={
                label: Sphere(np.array(sphere["centre_mm"], dtype=np.float64), sphere["radius_mm"])
                for label, sphere in extra["spheres"].items()
            },
        )
