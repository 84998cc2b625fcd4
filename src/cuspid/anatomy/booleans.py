"""Exact booleans between a jaw and tools (manifold3d), with the origin of each face of the result.

All in the occlusal frame, mm. A tool is a closed mesh whose faces are marked by what they leave behind in the jaw.
"""

from __future__ import annotations

from dataclasses import dataclass

import manifold3d
import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.anatomy.edges import describe_edges, loops_of, open_edges
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError

CAVITY = 1
"""Mark of the faces of a tool that leave prepared tooth."""
ROOT = 2
"""Mark of the faces that lay the tooth bare below its finish line."""
TROUGH = 3
"""Mark of the faces that leave gum."""
OUTSIDE = 0
"""Mark of the faces that should leave nothing, for they lie in the air."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tool:
    """A closed mesh that is taken away from a jaw."""

    mesh: Mesh
    """In the frame of the tooth, or of the jaw after `in_jaw`."""
    marks: Int[np.ndarray, "f"]
    """What each face leaves behind."""
    line: Float[np.ndarray, "n 3"] | None = None
    """A further line of the preparation in the same frame, for example the bottom of a crack."""

    def in_jaw(self, jaw_from_site: Rigid3) -> Tool:
        """The tool in the frame of the jaw."""
        line = None if self.line is None else jaw_from_site.apply(self.line)
        return Tool(mesh=self.mesh.transformed(jaw_from_site), marks=self.marks, line=line)


@dataclass(frozen=True, eq=False, kw_only=True)
class Cut:
    """A mesh from which tools were taken away, and where each of its faces comes from."""

    mesh: Mesh
    """The result, one closed part."""
    source: Int[np.ndarray, "f"]
    """-1 for a face of the mesh that was cut, k for one of tool k, -2 - k for one of a block that ends tool k."""
    face: Int[np.ndarray, "f"]
    """Index of the face in its source."""
    removed_mm3: float
    """Volume taken away."""


def subtract(mesh: Mesh, tools: list[tuple[Tool, list[Mesh]]], names: list[str]) -> Cut:
    """Take tools, each less the blocks beside it, away from a closed mesh; loose pieces are dropped.

    Raises InputError where a mesh is not a solid, a tool takes nothing away, or all.
    """
    body = solid_of(mesh, "jaw")
    origin = {body.to_mesh64().run_original_id[0]: -1}
    result = body
    for index, (tool, blocks) in enumerate(tools):
        cutter = solid_of(tool.mesh, names[index])
        origin[cutter.to_mesh64().run_original_id[0]] = index
        for block in blocks:
            stop = solid_of(block, names[index])
            origin[stop.to_mesh64().run_original_id[0]] = -2 - index
            cutter -= stop
        before, result = result.volume(), result - cutter
        if result.status() != manifold3d.Error.NoError or result.is_empty():
            raise InputError(f"{names[index]}: nothing is left after the boolean ({result.status().name}); reduce less")
        if before - result.volume() < 1e-6:
            raise InputError(f"{names[index]}: the preparation removes nothing; make it deeper")
    largest = max(result.decompose(), key=lambda part: part.volume())
    out = largest.to_mesh64()
    runs = np.repeat([origin[run] for run in out.run_original_id], run_lengths(out))
    return Cut(
        mesh=Mesh(np.asarray(out.vert_properties)[:, :3], np.asarray(out.tri_verts).astype(np.int64)),
        source=runs,
        face=np.asarray(out.face_id).astype(np.int64),
        removed_mm3=body.volume() - largest.volume(),
    )


def solid_of(mesh: Mesh, name: str) -> manifold3d.Manifold:
    """A closed mesh as a solid that remembers its faces. Raises InputError with the number of bad edges."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(
            vert_properties=np.array(mesh.vertices),
            tri_verts=np.array(mesh.faces, dtype=np.uint64),
            run_original_id=np.array([manifold3d.Manifold.reserve_ids(1)], dtype=np.uint32),
            run_index=np.array([0, 3 * len(mesh.faces)], dtype=np.uint64),
            face_id=np.arange(len(mesh.faces), dtype=np.uint64),
        )
    )
    if solid.status() != manifold3d.Error.NoError or solid.is_empty():
        raise InputError(f"{name}: not a solid ({solid.status().name}): {describe_edges(mesh.faces)}; repair the mesh")
    if solid.volume() <= 0:
        raise InputError(f"{name}: the mesh is inside out (volume {solid.volume():.1f} mm^3); flip its faces")
    return solid


def run_lengths(mesh: manifold3d.Mesh64) -> Int[np.ndarray, "r"]:
    """Number of faces of each origin."""
    return np.asarray(np.diff(np.asarray(mesh.run_index, dtype=np.int64)) // 3)


def close_holes(mesh: Mesh) -> Mesh:
    """The mesh with its holes closed; the faces that close them come last.

    The longest border, the rim of an open scan, is drawn together far below; every other one to its middle.
    """
    border = open_edges(mesh.faces)
    if not len(border):
        return mesh
    loops = sorted(loops_of(border), key=len, reverse=True)
    vertices, faces = [mesh.vertices], [mesh.faces]
    for number, loop in enumerate(loops):
        apex = mesh.vertices[loop].mean(axis=0)
        if number == 0:
            apex[2] = mesh.vertices[:, 2].min() - 20.0
        vertices.append(apex[None])
        tip = np.full(len(loop), len(mesh.vertices) + number)
        faces.append(np.column_stack([np.roll(loop, -1), loop, tip]))
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def rim_of(cut: Cut, inside: Bool[np.ndarray, "f"]) -> Float[np.ndarray, "n 3"]:
    """The longest closed line between the faces inside and all others; its last point is its first."""
    loops = loops_of(open_edges(cut.mesh.faces[inside]))
    if not loops:
        return np.empty((0, 3))
    lines = [cut.mesh.vertices[np.append(loop, loop[0])] for loop in loops]
    return max(lines, key=lambda line: float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()))
