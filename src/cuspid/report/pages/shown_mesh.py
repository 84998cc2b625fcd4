"""Meshes as a page shows them: fewer faces, whole numbers instead of floats, and what was measured on the full mesh.

A page shows a mesh in *steps*: a coordinate is ``origin + step * q`` with q from 0 to 65535 over the box of the mesh,
so that a jaw of 65 mm is shown to the micrometre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from cuspid.model.mesh import Mesh
from cuspid.report.pages.page import pack_array

_MOST = 65535
_PROBES = 50_000
"""About so many vertices of the full mesh tell how near the shown one is."""
UM_PER_STEP = 0.1
"""Deviations and standard deviations are kept in whole steps of this size."""
UNKNOWN = -32768
"""What is not known."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownMesh:
    """A mesh with at most so many faces."""

    mesh: Mesh
    """Simplified by quadric error metrics (Garland and Heckbert 1997), or the mesh itself where it was small enough."""
    nearest: Int[np.ndarray, "v"]
    """For each of its vertices the nearest one of the full mesh."""
    full_faces: int
    """Faces of the full mesh."""
    off_um: float
    """95 % of the vertices of the full mesh lie within this distance of it."""

    def at_vertices(self, values: Float[np.ndarray, "f"]) -> Float[np.ndarray, "v"]:
        """Values of the vertices of the full mesh, at these."""
        return values[self.nearest]


def simplify(mesh: Mesh, max_faces: int) -> ShownMesh:
    """A mesh with at most ``max_faces`` faces."""
    full = len(mesh.faces)
    if full <= max_faces:
        return ShownMesh(mesh=mesh, nearest=np.arange(len(mesh.vertices)), full_faces=full, off_um=0.0)
    shown = mesh.simplified(max_faces)
    nearest = cKDTree(mesh.vertices).query(shown.vertices)[1]
    distances, _, _ = shown.closest(mesh.vertices[:: 1 + len(mesh.vertices) // _PROBES])
    return ShownMesh(
        mesh=shown, nearest=np.asarray(nearest), full_faces=full, off_um=float(1000 * np.percentile(distances, 95))
    )


def pack_mesh(mesh: Mesh) -> dict[str, Any]:
    """Vertices in steps, and faces."""
    origin = mesh.vertices.min(axis=0)
    step = float(np.ptp(mesh.vertices, axis=0).max()) / _MOST or 1.0
    return {
        "origin": origin,
        "step": step,
        "vertices": pack_array(np.rint((mesh.vertices - origin) / step).astype(np.uint16)),
        "faces": pack_array(mesh.faces.astype(np.uint32)),
    }


def pack_um(values_um: Float[np.ndarray, "v"]) -> dict[str, str]:
    """Values of vertices in steps of `UM_PER_STEP`; NaN is not known."""
    limit = -UNKNOWN - 1
    steps = np.clip(np.rint(np.nan_to_num(values_um) / UM_PER_STEP), -limit, limit)
    return pack_array(np.where(np.isnan(values_um), UNKNOWN, steps).astype(np.int16))
