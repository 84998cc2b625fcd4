"""Crown surface that is open to some direction, and how much of it a scan covers, whether or not a camera could see it.

A face is open if a share of at least `LEAST_OPENNESS` of the directions above the occlusal plane (XY) is free, where
only what lies within 15 mm of the tooth can occlude it.

The overall figures include the teeth that the scan was meant for: those of whose open crown at least three quarters as
large a share was *in reach* as of the tooth that was best in reach. In reach is what two cameras could see at once if
that is known, otherwise what lies within 200 um of the scan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.geometry import read_only
from cuspid.model.jaw import GUM
from cuspid.model.mesh import Mesh
from cuspid.model.trueness import CrownCompleteness
from cuspid.model.visibility import LEAST_OPENNESS, OPENNESS_REACH_MM, openness

WITHIN_UM = (50, 100, 200)
"""Distances at which completeness is evaluated."""
_IN_REACH_MM = 0.2
_PIECE_MM = 10.0
"""Side of the squares of the occlusal plane that stand in for teeth if these have no labels."""
_MEANT = 0.75
"""Minimum share in reach, relative to that of the tooth best in reach, for a tooth to be included in the overall
figures."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OpenCrown:
    """The open crown surface of a jaw."""

    mesh: Mesh
    """The surface of the jaw, in the frame of the reference."""
    parts: Int[np.ndarray, "f"]
    """For each open face of a crown, the FDI number of its tooth, or the number of a tooth-sized piece if crowns were
    separated from gum by shape; 0 for all other faces."""
    estimated: bool = False
    """Whether crowns were separated from gum by shape, for lack of tooth labels."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", read_only(self.parts))


def open_parts(mesh: Mesh, parts: Int[np.ndarray, "f"]) -> Int[np.ndarray, "f"]:
    """The parts of the crowns of a mesh with +Z out of the gum, as in :class:`OpenCrown`; 0 where a face is not
    open."""
    is_open = np.zeros(len(parts), dtype=bool)
    for part in np.unique(parts[parts != GUM]):
        is_open |= open_faces(mesh, parts == part, LEAST_OPENNESS)
    return np.where(is_open, parts, GUM)


def pieces(mesh: Mesh, crown: Bool[np.ndarray, "f"]) -> Int[np.ndarray, "f"]:
    """Numbers of tooth-sized pieces for the faces of crowns without labels, 0 for the others."""
    cells = np.floor(mesh.face_centres[crown, :2] / _PIECE_MM).astype(np.int64)
    parts = np.full(len(mesh.faces), GUM)
    parts[crown] = 1 + np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    return parts


def open_faces(mesh: Mesh, tooth: Bool[np.ndarray, "f"], least_openness: float) -> Bool[np.ndarray, "f"]:
    """The open faces of a tooth, for a mesh with +Z out of the gum."""
    middle = mesh.face_centres[tooth].mean(axis=0)
    near = np.linalg.norm(mesh.face_centres - middle, axis=1) < OPENNESS_REACH_MM
    candidates = near & tooth
    is_open = np.zeros(len(near), dtype=bool)
    is_open[candidates] = (
        openness(mesh.submesh(near), mesh.face_centres[candidates], mesh.face_normals[candidates]) >= least_openness
    )
    return is_open


def within_pct(distances_mm: Float[np.ndarray, "n"]) -> dict[str, float]:
    """Percentage within each of `WITHIN_UM`."""
    return {str(um): float(100 * np.mean(np.abs(distances_mm) <= um / 1000)) for um in WITHIN_UM}


def crown_completeness(
    aligned: Mesh,
    crown: OpenCrown,
    scannable: Bool[np.ndarray, "f"] | None,
    samples: int,
    rng: np.random.Generator,
) -> CrownCompleteness | None:
    """How much of the open crown an aligned scan covers; None if none of it was in reach.

    ``scannable``: the faces that two cameras could see at once, if that is known. ``samples``: points on the crowns
    that were in reach.
    """
    reach = _in_reach(aligned, crown, scannable)
    faces = np.flatnonzero(np.isin(crown.parts, [part for part, share in reach.items() if share > 0]))
    if len(faces) == 0:
        return None
    surface = Mesh(crown.mesh.vertices, crown.mesh.faces[faces])
    points, picks = surface.sample(samples, rng)
    distances_mm, _, _ = aligned.closest(points)
    owners = crown.parts[faces][picks]
    parts = [part for part in reach if np.any(owners == part)]
    evaluated = [part for part in parts if reach[part] >= _MEANT * max(reach.values())]
    return CrownCompleteness(
        completeness_pct=within_pct(distances_mm[np.isin(owners, evaluated)]),
        open_mm2=float(crown.mesh.face_areas[np.isin(crown.parts, evaluated)].sum()),
        teeth=() if crown.estimated else tuple(evaluated),
        per_tooth_pct={} if crown.estimated else {part: within_pct(distances_mm[owners == part]) for part in parts},
        estimated=crown.estimated,
        note=_note(crown, scannable is not None, evaluated),
    )


def _in_reach(aligned: Mesh, crown: OpenCrown, scannable: Bool[np.ndarray, "f"] | None) -> dict[int, float]:
    """Share of the open crown of each part that was in reach."""
    faces = np.flatnonzero(crown.parts != GUM)
    owners, areas = crown.parts[faces], crown.mesh.face_areas[faces]
    if scannable is not None:
        reached = scannable[faces]
    else:
        centres = Mesh(crown.mesh.vertices, crown.mesh.faces[faces]).face_centres
        reached = aligned.closest(centres)[0] <= _IN_REACH_MM
    return {
        int(part): float(areas[(owners == part) & reached].sum() / areas[owners == part].sum())
        for part in np.unique(owners)
    }


def _note(crown: OpenCrown, could_be_seen: bool, evaluated: list[int]) -> str:
    """What is evaluated, for people."""
    where = "could be seen by two cameras" if could_be_seen else "lies within 200 µm of the scan"
    named = f"{len(evaluated)} pieces" if crown.estimated else ", ".join(map(str, evaluated))
    estimated = "; crowns were separated from gum by their shape, which is an estimate" if crown.estimated else ""
    return (
        f"evaluated part of the open crown surface: {named}; the share of each that {where} is "
        f"at least three quarters of the best one's{estimated}"
    )
