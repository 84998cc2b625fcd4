"""Triangle meshes: STL, PLY, OBJ and OFF."""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8

from cuspid.geometry import distinct_rows, freeze
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import read_bytes, require_file
from cuspid.runtime.values import LONGEST_MM, one_line
from cuspid.storage.files import write_bytes
from cuspid.storage.units import MM_PER_UNIT, Unit

_PLACE_AND_COLOR = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha"}
_COLOR = ("red", "green", "blue")
_PLY_ELEMENT = re.compile(rb"^element\s+(\w+)\s+(\d{1,400})\s*$", re.MULTILINE)
_COMMENT, _COUNT = re.compile(rb"#[^\n]*"), re.compile(rb"\d{1,18}")
_LONGEST_HEADER = 1 << 16
_LEAST_AREA = 1e-9
"""Of the square of its extent: less is a line."""
MESH_SUFFIXES = (".stl", ".ply", ".obj", ".off")
SIGMA = "sigma_um"
"""Name of the standard deviation of each vertex along its normal, in a PLY file."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeshFile:
    """What a mesh file holds."""

    mesh: Mesh
    """In mm, with coincident vertices joined."""
    face_colors: UInt8[np.ndarray, "f 3"] | None
    """sRGB colour per face, where the file has them."""
    vertex_values: Mapping[str, Float[np.ndarray, "v"]]
    """Properties of the vertices beside place and colour (PLY), by name."""
    face_values: Mapping[str, np.ndarray]
    """Properties of the faces (PLY), by name."""


def read_mesh(path: Path | str, unit: Unit = "mm") -> Mesh:
    """A mesh from an STL, PLY, OBJ or OFF file, in mm, with coincident vertices joined.

    Raises InputError where the file is missing, not a mesh, empty, or has coordinates that are not finite.
    """
    return read_mesh_file(Path(path), unit).mesh


def read_mesh_file(path: Path, unit: Unit = "mm") -> MeshFile:
    """As :func:`read_mesh`, with what else the file says."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{path}: not a mesh file that cuspid reads; give an STL, PLY, OBJ or OFF file")
    declared = _declared_faces(path)
    try:
        with np.errstate(all="ignore"), _silence_trimesh():  # what cannot be used is told below
            scene = trimesh.load_scene(_readable(path), path.suffix[1:].lower(), process=False, skip_materials=True)
            parts = list(scene.geometry.values())
            loaded = parts[0] if len(parts) == 1 else scene.to_mesh()
    except Exception as error:  # trimesh's loaders raise whatever the parser met
        raise InputError(f"{path}: not a mesh ({type(error).__name__}: {one_line(error)}); export it again") from error
    with _free_meshes(loaded, *parts):
        if not isinstance(loaded, trimesh.Trimesh) or len(loaded.vertices) == 0 or len(loaded.faces) == 0:
            raise InputError(f"{path}: the mesh is empty (no triangles); export the surface, not a point cloud")
        return _check_mesh(path, loaded, declared, unit)


def _readable(path: Path) -> Path | io.BytesIO:
    """What trimesh reads: of an OFF file with comments behind numbers it would read lines twice."""
    return io.BytesIO(_COMMENT.sub(b"", read_bytes(path, "mesh"))) if path.suffix.lower() == ".off" else path


@contextmanager
def _silence_trimesh() -> Iterator[None]:
    """trimesh logs what it could not read of a file, with where it was, and goes on."""
    log = logging.getLogger("trimesh")
    before = log.level
    log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        log.setLevel(before)


@contextmanager
def _free_meshes(*meshes: trimesh.parent.Geometry) -> Iterator[None]:
    """Free meshes after the block: their parts refer to them and they to their parts, and of millions of faces a
    gigabyte would stay until the garbage is collected."""
    try:
        yield
    finally:
        for mesh in meshes:
            vars(mesh).clear()


def _check_mesh(path: Path, loaded: trimesh.Trimesh, declared: int, unit: Unit) -> MeshFile:
    mm_per_unit = MM_PER_UNIT[unit]
    vertices, faces = np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces, dtype=np.int64)
    if len(faces) < declared:
        raise InputError(
            f"{path}: {len(faces)} of {declared} faces could be read; the file is truncated, copy it again"
        )
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise InputError(f"{path}: its vertices do not have three coordinates each; export the mesh again")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: some coordinates are not finite numbers; repair the mesh and export it again")
    if np.abs(vertices).max() * mm_per_unit > LONGEST_MM:
        raise InputError(
            f"{path}: coordinates beyond {LONGEST_MM / 1000:g} m (read in {unit}); repair the mesh, or give its unit "
            "(--unit; --reference-unit where it is what a scan is compared with)"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: faces refer to vertices that do not exist; export the mesh again")
    first, number = distinct_rows(vertices)
    colors = _colors(loaded, "vertex")
    merged = freeze(vertices[first] * mm_per_unit)
    mesh = Mesh(merged, freeze(number[faces]), None if colors is None else freeze(colors[first]))
    if not mesh.face_areas.sum() > _LEAST_AREA * np.ptp(mesh.bounds, axis=0).max() ** 2:
        raise InputError(f"{path}: its triangles have no area; export the surface again")
    values = _ply_values(loaded, "vertex")
    return MeshFile(
        mesh=mesh,
        face_colors=_colors(loaded, "face"),
        vertex_values={
            name: each[first].astype(np.float64).reshape(-1)
            for name, each in values.items()
            if name not in _PLACE_AND_COLOR
        },
        face_values=_ply_values(loaded, "face"),
    )


def _ply_values(loaded: trimesh.Trimesh, element: str) -> dict[str, np.ndarray]:
    raw = loaded.metadata.get("_ply_raw", {}).get(element, {}).get("data")
    names = getattr(getattr(raw, "dtype", None), "names", None) or ()
    return {name: raw[name].copy() for name in names if raw[name].dtype.names is None}


def _declared_faces(path: Path) -> int:
    """How many faces the file says that it has; 0 where it does not say. Raises InputError where it is too short for
    what it says."""
    suffix, data = path.suffix.lower(), read_bytes(path, "mesh")
    if suffix == ".ply":
        header = data[:_LONGEST_HEADER].partition(b"end_header")[0]
        counts = {name: int(count) for name, count in _PLY_ELEMENT.findall(header)}
        if sum(counts.values()) > len(data):  # an element takes a byte at least
            raise InputError(f"{path}: too short for its {sum(counts.values())} elements; copy the file again")
        return counts.get(b"face", 0)
    if suffix == ".stl" and data.lstrip()[:5].lower() == b"solid":
        if b"facet" in data[:_LONGEST_HEADER] and b"endsolid" not in data[-_LONGEST_HEADER:]:
            raise InputError(f"{path}: truncated, it does not end with 'endsolid'; copy the file again")
        return data.count(b"facet normal")
    if suffix == ".off":
        said = _COMMENT.sub(b"", data[:_LONGEST_HEADER]).partition(b"OFF")[2].split(maxsplit=2)[1:2]
        return int(said[0]) if said and _COUNT.fullmatch(said[0]) else 0
    return 0


def _colors(loaded: trimesh.Trimesh, kind: Literal["vertex", "face"]) -> UInt8[np.ndarray, "n 3"] | None:
    if loaded.visual.kind != kind:
        return None
    return np.array(getattr(loaded.visual, f"{kind}_colors"), dtype=np.uint8)[:, :3]


def write_mesh(
    path: Path | str,
    mesh: Mesh,
    face_labels: Int[np.ndarray, "f"] | None = None,
    *,
    values: Mapping[str, Float[np.ndarray, "v"]] = MappingProxyType({}),
    comment: str | None = None,
) -> None:
    """Write a mesh in mm: binary PLY (with colour, labels, values of the vertices by name, and a comment of one line),
    binary STL, OBJ or OFF, by the file's suffix. CloudCompare shows such values as scalar fields."""
    path = Path(path)
    # STL holds the normals of the faces; trimesh would compute them in five times the time.
    normals = mesh.face_normals if path.suffix.lower() == ".stl" else None
    exported = trimesh.Trimesh(
        mesh.vertices, mesh.faces, face_normals=normals, vertex_colors=mesh.colors, process=False
    )
    with _free_meshes(exported):
        for name, each in values.items():
            exported.vertex_attributes[name] = each.astype(np.float32)
        if face_labels is not None:
            exported.face_attributes["label"] = face_labels.astype(np.int32)
        data = exported.export(file_type=path.suffix.lower().lstrip("."))
    data = data.encode() if isinstance(data, str) else data
    if comment is not None and data.startswith(b"ply\n"):
        data = data.replace(b"\nelement ", f"\ncomment {comment}\nelement ".encode(), 1)
    write_bytes(path, data)


NO_SCALE = "scale unknown: lengths are not in mm"
"""Comment of a PLY file whose scale is unknown."""


def has_scale(path: Path) -> bool:
    """Whether the lengths of a mesh file are in a known unit: not where a PLY file says :data:`NO_SCALE`."""
    with require_file(path, "mesh").open("rb") as stream:
        head = stream.read(4096)
    return not (head.startswith(b"ply") and NO_SCALE.encode() in head.split(b"end_header")[0])


def write_points(path: Path, points: Float[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"], comment: str) -> None:
    """Write points with their colours as binary PLY, with a comment of one line."""
    rows = np.zeros(len(points), dtype=[(axis, "<f8") for axis in "xyz"] + [(c, "u1") for c in _COLOR])
    for number, axis in enumerate("xyz"):
        rows[axis] = points[:, number]
    for number, name in enumerate(_COLOR):
        rows[name] = colors[:, number]
    properties = [f"property double {axis}" for axis in "xyz"] + [f"property uchar {name}" for name in _COLOR]
    header = ["ply", "format binary_little_endian 1.0", f"comment {comment}", f"element vertex {len(points)}"]
    write_bytes(path, "\n".join([*header, *properties, "end_header", ""]).encode() + rows.tobytes())
