"""Triangle meshes: STL, PLY and OBJ."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from cuspid.errors import InputError
from cuspid.mesh import Mesh
from cuspid.storage.files import write_bytes

Unit = Literal["mm", "cm", "m", "in", "um"]
MM_PER_UNIT: Mapping[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "um": 0.001}
"""Length units that a mesh file may be in."""

_PLACE_AND_COLOR = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha"}
MESH_SUFFIXES = (".stl", ".ply", ".obj")


def read_mesh(path: Path, unit: Unit = "mm") -> Mesh:
    """A mesh from an STL, PLY or OBJ file, in mm, with coincident vertices joined.

    Raises InputError where the file is missing, not a mesh, empty, or has coordinates that are not finite.
    """
    return read_triangles(path, unit)[0]


def read_triangles(path: Path, unit: Unit) -> tuple[Mesh, trimesh.Trimesh]:
    """As :func:`read_mesh`, with what trimesh loaded, which holds what else the file says."""
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
    mesh, loaded = read_triangles(path, "mm")
    raw = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = [] if raw is None else [name for name in raw.dtype.names or () if name not in _PLACE_AND_COLOR]
    _, first = np.unique(np.asarray(loaded.vertices, dtype=np.float64), axis=0, return_index=True)
    return mesh, {name: np.asarray(raw[name], dtype=np.float64).reshape(-1)[first] for name in names}
