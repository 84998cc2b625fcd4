"""Separates crowns from gum: by tooth labels, or by shape where a jaw has none, which is an estimate.

By shape, a random walker (Grady 2006) on the surface finds for each place whether a walk from there ends sooner on
crown or on gum. It hardly crosses furrows, and where crowns meet the gum a furrow runs. A walk ends

- anywhere, with a small chance, as crown or gum by how the place looks: crowns stand out of their surroundings, and lie
  near the tops, which rise within `_TOP_MM` of the highest point around them;
- at an open border as gum, mostly where it looks like either: what a scan ends with, such as a flap behind the last
  molar, is rarely a tooth.

Specks are given to what is around them. All this happens on a surface of `_FACE_MM2` a face, so that the fineness of
the mesh hardly counts; distances are in mm, in the occlusal frame, +Z out of the gum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from cuspid.anatomy.edges import open_edges
from cuspid.geometry import read_only, unit
from cuspid.geometry.graph import parts_of
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh, edges_of

_FACE_MM2, _COARSE_FACE_MM2 = 0.3, 1.2
"""Mean area of the faces of the surface that is walked, and of the one that tells what stands out."""
_SMOOTH_MM, _FURROW_REACH_MM, _PROTRUSION_REACH_MM = 1.2, 2.0, 7.0
"""Radius within which normals are smoothed, and how far one looks for furrows and for what stands out."""
_GRID_MM, _NEAR_MM = 0.5, 8.0
"""Cells in which the highest point is looked for, and side of the square, about the width of a tooth."""
_TOP_MM, _SPEE_MM = 2.0, 5.0
"""Tops lie less than this below the highest point near, and that point so near to the occlusal plane."""
_TOP_PROTRUSION_MM = 0.3
"""How far tops stand out at least."""
_DEPTH_MM, _ASIDE_MM = 14.0, 8.0
"""Below or beside the tops by more is not worse."""
_ALONG, _AROUND_PER_MM = 0.4, 2.4
"""Weights of how far normals close along an edge (1/mm) and how far the surface around it lies above it (mm)."""
_CLOSING_PER_MM = 1 / 60
"""An edge that is hollow by so much is passed e times less often."""
_LEAST_CROSSING = np.exp(-12.0)
_END, _BORDER_END = 0.003, 0.1
"""Chance that a walk ends at a vertex of mean area that surely is one or the other, and four times that at a vertex of
an open border that looks like either."""
_DOUBT = 4
"""Power of the likelihood: where a place looks like either, few walks end."""
_LEAST_SHARE = 0.35
"""Share of the walks that must end on crown; in doubt more is crown, as fissures keep walks in."""
_SPECK_MM2 = 15.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Crowns:
    """Which surface of a jaw is crown."""

    faces: Bool[np.ndarray, "f"]
    """Faces of crowns; the others are gum or base."""
    estimated: bool
    """Whether they were separated from gum by shape."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "faces", read_only(self.faces))


def crowns_of(jaw: Jaw) -> Crowns:
    """The crowns of a jaw in its occlusal frame, by its labels or, without any, by shape."""
    if jaw.face_labels is not None:
        return Crowns(faces=jaw.face_labels != GUM, estimated=False)
    return Crowns(faces=crowns_by_shape(jaw.mesh), estimated=True)


def crowns_by_shape(mesh: Mesh) -> Bool[np.ndarray, "f"]:
    """The faces that look like crown, of a mesh in the occlusal frame; none where nothing looks like a top."""
    walked = _simplify(mesh, _FACE_MM2)
    look = _look(walked, _simplify(mesh, _COARSE_FACE_MM2))
    if look is None:
        return np.zeros(len(mesh.faces), dtype=bool)
    pairs = np.unique(np.sort(edges_of(walked.faces), axis=1), axis=0)
    share = _remove_specks(_share_on_crown(walked, pairs, look), pairs, walked.vertex_areas)
    by_face = share[walked.faces].mean(axis=1)
    return np.asarray((by_face if walked is mesh else by_face[walked.closest(mesh.face_centres)[1]]) > _LEAST_SHARE)


def _simplify(mesh: Mesh, face_mm2: float) -> Mesh:
    """With faces of that mean area, or the mesh itself where its own are about as large."""
    face_count = max(int(mesh.face_areas.sum() / face_mm2), 100)
    return mesh if len(mesh.faces) <= 1.3 * face_count else mesh.simplified(face_count)


# --- how places look --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class _Look:
    """What each vertex looks like."""

    normals: Float[np.ndarray, "v 3"]
    """Smoothed unit normals."""
    furrow_mm: Float[np.ndarray, "v"]
    """How far the surface around it lies above it, near by; negative on ridges."""
    crown: Float[np.ndarray, "v"]
    """Likelihood of being crown."""


def _look(mesh: Mesh, coarse: Mesh) -> _Look | None:
    """None where nothing looks like the top of a crown."""
    normals, furrow_mm = _local_relief(mesh)
    protrusion_mm = _protrusion_mm(mesh, coarse, normals)
    summit_mm = _summit_mm(mesh)
    below_mm = summit_mm - mesh.vertices[:, 2]
    tops = (below_mm < _TOP_MM) & (np.abs(summit_mm) < _SPEE_MM) & (normals[:, 2] > 0)
    tops &= protrusion_mm > _TOP_PROTRUSION_MM
    if not tops.any():
        return None
    aside_mm, _ = cKDTree(mesh.vertices[tops, :2]).query(mesh.vertices[:, :2])
    return _Look(
        normals=normals,
        furrow_mm=furrow_mm,
        crown=_likelihood(below_mm, np.asarray(aside_mm), protrusion_mm, normals[:, 2]),
    )


def _likelihood(
    below_mm: Float[np.ndarray, "v"],
    aside_mm: Float[np.ndarray, "v"],
    protrusion_mm: Float[np.ndarray, "v"],
    upwards: Float[np.ndarray, "v"],
) -> Float[np.ndarray, "v"]:
    """Logistic regression on labelled jaws, rounded: docs/crowns.md."""
    depth, aside = np.minimum(below_mm, _DEPTH_MM) / 5, np.minimum(aside_mm, _ASIDE_MM) / 4
    score = 2.1 - 1.4 * depth**2 - 2.3 * aside**2 + 1.6 * protrusion_mm - 1.2 * upwards
    return 1 / (1 + np.exp(-np.clip(score, -30, 30)))


def _local_relief(mesh: Mesh) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, "v"]]:
    """Smoothed unit normals, and how far the surface within `_FURROW_REACH_MM` lies above each vertex, mm."""
    pairs = cKDTree(mesh.vertices).query_pairs(_FURROW_REACH_MM, output_type="ndarray")
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    offsets = mesh.vertices[j] - mesh.vertices[i]
    squared = np.sum(offsets**2, axis=1)
    facing = mesh.vertex_areas[j] * np.maximum(np.sum(mesh.vertex_normals[i] * mesh.vertex_normals[j], axis=1), 0)
    close = squared < _SMOOTH_MM**2
    weights = facing[close] * np.exp(-2 * squared[close] / _SMOOTH_MM**2)
    count = len(mesh.vertices)
    smoothing = csr_array((weights, (i[close], j[close])), shape=(count, count)) + diags_array(mesh.vertex_areas)
    normals = unit(smoothing @ mesh.vertex_normals)
    weights = facing * np.exp(-2 * squared / _FURROW_REACH_MM**2)
    above = np.bincount(i, weights * np.sum(offsets * normals[i], axis=1), minlength=count)
    total = np.bincount(i, weights, minlength=count) + mesh.vertex_areas
    return normals, above / np.where(total > 0, total, 1)


def _protrusion_mm(mesh: Mesh, coarse: Mesh, normals: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v"]:
    """How far each vertex stands out of the surface within `_PROTRUSION_REACH_MM`."""
    near = cKDTree(mesh.vertices).query_ball_point(coarse.vertices, _PROTRUSION_REACH_MM)
    i = np.concatenate([np.asarray(each, dtype=np.int64) for each in near])
    j = np.repeat(np.arange(len(near)), [len(each) for each in near])
    offsets = mesh.vertices[i] - coarse.vertices[j]
    weights = coarse.vertex_areas[j] * np.exp(-2 * np.sum(offsets**2, axis=1) / _PROTRUSION_REACH_MM**2)
    above = np.bincount(i, weights * np.sum(offsets * normals[i], axis=1), minlength=len(mesh.vertices))
    total = np.bincount(i, weights, minlength=len(mesh.vertices))
    return above / np.where(total > 0, total, 1)


def _summit_mm(mesh: Mesh) -> Float[np.ndarray, "v"]:
    """Height of the highest vertex within the square of `_NEAR_MM` about each."""
    columns, rows = np.floor((mesh.vertices[:, :2] - mesh.bounds[0, :2]) / _GRID_MM).astype(int).T
    highest = np.full((columns.max() + 1, rows.max() + 1), -np.inf)
    np.maximum.at(highest, (columns, rows), mesh.vertices[:, 2])
    return np.asarray(maximum_filter(highest, round(_NEAR_MM / _GRID_MM) | 1)[columns, rows])


# --- the walk ---------------------------------------------------------------------------------------------------------


def _share_on_crown(mesh: Mesh, pairs: Int[np.ndarray, "e 2"], look: _Look) -> Float[np.ndarray, "v"]:
    """Share of the walks from each vertex that end on crown."""
    laplacian = _laplacian(pairs, _hollow_per_mm(mesh, pairs, look), len(mesh.vertices))
    chance = _END * mesh.vertex_areas / mesh.vertex_areas.mean()
    on_crown, on_gum = chance * look.crown**_DOUBT, chance * (1 - look.crown) ** _DOUBT
    border = np.unique(open_edges(mesh.faces))
    on_gum[border] += _BORDER_END * (look.crown * (1 - look.crown))[border]
    undecided = 1e-9
    ends = diags_array(on_crown + on_gum + undecided)
    return np.asarray(spsolve((laplacian + ends).tocsc(), on_crown + undecided / 2))


def _hollow_per_mm(mesh: Mesh, pairs: Int[np.ndarray, "e 2"], look: _Look) -> Float[np.ndarray, "e"]:
    """How hollow the surface is at each edge; 0 where it is convex."""
    i, j = pairs.T
    along = mesh.vertices[j] - mesh.vertices[i]
    squared = np.maximum(np.sum(along**2, axis=1), 1e-9)
    closing = -np.sum((look.normals[j] - look.normals[i]) * along, axis=1) / squared
    around = _AROUND_PER_MM * look.furrow_mm[pairs].mean(axis=1)
    return _ALONG * np.maximum(closing, 0) + np.maximum(around, 0)


def _laplacian(pairs: Int[np.ndarray, "e 2"], hollow_per_mm: Float[np.ndarray, "e"], count: int) -> csr_array:
    """Of the edges, by how easily a walk passes them."""
    crossing = np.maximum(np.exp(-hollow_per_mm / _CLOSING_PER_MM), _LEAST_CROSSING)
    half = coo_array((crossing, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    both = (half + half.T).tocsr()
    return csr_array(diags_array(both.sum(axis=1)) - both)


def _remove_specks(
    share: Float[np.ndarray, "v"], pairs: Int[np.ndarray, "e 2"], areas: Float[np.ndarray, "v"]
) -> Float[np.ndarray, "v"]:
    """Specks of crown become gum, then those of gum crown."""
    for speck_of_crown in (True, False):
        is_crown = share > _LEAST_SHARE
        parts = parts_of(pairs[is_crown[pairs[:, 0]] == is_crown[pairs[:, 1]]], len(share))
        small = (np.bincount(parts, areas) < _SPECK_MM2)[parts] & (is_crown == speck_of_crown)
        share = np.where(small, 0.0 if speck_of_crown else 1.0, share)
    return share
