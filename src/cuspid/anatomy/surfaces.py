"""The named surfaces of the teeth of a labelled jaw, and of the gum around them (thesis, figure 3.13).

Each tooth has axes of its own: distal along the tangent of the arch, outward (to cheek and lip) along its normal,
occlusal along +Z of the occlusal frame. The origin is the middle of the crown's extent along them; *relative* places
are divided by half that extent, so that the crown spans -1 to 1.

- *occlusal* (premolars and molars): in the upper half, what looks upwards and does not slope outwards; and all that
  looks up at all within the rim of that, but for the lowest quarter of the crown. The rim is smoothed around the tooth:
  it follows the cusp ridges and marginal ridges.
- *incisal* (incisors and canines): what looks upwards less than `SurfaceOptions.incisal_mm` below the edge.
- the four *sides*: all other faces of a tooth, by the horizontal direction in which they look plus, with half the
  weight, that in which they relatively lie. What looks upwards on incisors and canines, as the hollow behind the edge
  does, is named by the side of the edge that it lies on. The outer side is *buccal*, of incisors and canines *labial*;
  the inner one is called *lingual* in both jaws.
- *gingival*: gum up to `SurfaceOptions.gingival_mm` from a tooth. Other gum has no name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import median_filter, uniform_filter1d

from cuspid.anatomy.landmarks.scheme import kind_of
from cuspid.geometry import unit
from cuspid.model.jaw import Jaw
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

SURFACES = ("occlusal", "incisal", "buccal", "labial", "lingual", "mesial", "distal", "gingival")
"""Names of the surfaces, in the order of tables."""

_ARCH_ORDER = (*range(48, 40, -1), *range(31, 39), *range(18, 10, -1), *range(21, 29))
"""FDI numbers along the lower and the upper arch, from the patient's right to the left."""
_UPWARDS = 0.5
"""Least z of the normal of a face of an edge or rim: it is inclined by less than 60 degrees."""
_OUTWARDS = 0.5
"""A face slopes outwards if its normal has more than this away from the middle: by more than 30 degrees."""
_WEDGES = 24
"""Directions in which the rim is looked for."""
_BINS = 12
"""Places along a tooth at which its edge is looked for."""

Local = Float[np.ndarray, "n 3"]
"""Distal, outward and occlusal components for each face."""


@dataclass(frozen=True, kw_only=True)
class SurfaceOptions(Options):
    """Where the named surfaces of a tooth end."""

    incisal_mm: Annotated[float, Range(0.01, 100)] = 1.0
    """Height of the incisal surface."""
    gingival_mm: Annotated[float, Range(0.01, 100)] = 3.0
    """Width of the gum around the teeth that counts as gingival surface."""


def named_surfaces(jaw: Jaw, options: SurfaceOptions = SurfaceOptions()) -> dict[str, Bool[np.ndarray, "f"]]:
    """A mask over the faces for each of `SURFACES`; no face is in two of them, each face of a tooth is in one.

    Raises InputError for a jaw with fewer than two labelled teeth, too few to define the course of the arch.
    """
    codes = np.full(len(jaw.mesh.faces), -1)
    for fdi, axes in tooth_axes(jaw).items():
        faces = np.flatnonzero(jaw.tooth_faces(fdi))
        codes[faces] = _codes(fdi, _places(jaw, faces, axes), jaw.mesh.face_normals[faces] @ axes.T, options)
    codes[_gum_beside_teeth(jaw, options.gingival_mm)] = SURFACES.index("gingival")
    return {name: codes == code for code, name in enumerate(SURFACES)}


def tooth_axes(jaw: Jaw) -> dict[int, Float[np.ndarray, "3 3"]]:
    """Distal, outward and occlusal unit vectors as rows, for each tooth (FDI), in the order along the arch.

    Raises InputError for a jaw with fewer than two labelled teeth.
    """
    order = [fdi for fdi in _ARCH_ORDER if fdi in jaw.teeth]
    if len(order) < 2:
        raise InputError(
            f"surfaces: the jaw has {len(order)} labelled teeth; at least two are needed to find the course of the "
            f"arch (label each face with its FDI number, gum with 0)"
        )
    tangents = np.gradient([jaw.mesh.centroid(jaw.tooth_faces(fdi))[:2] for fdi in order], axis=0)
    return {fdi: _axes(fdi, along / np.linalg.norm(along)) for fdi, along in zip(order, tangents, strict=True)}


def _axes(fdi: int, along: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3 3"]:
    """``along`` points from the patient's right to the left: seen from +Z, counter-clockwise in a lower jaw only."""
    quadrant = fdi // 10
    outward = np.array([along[1], -along[0]]) * (1 if quadrant in (3, 4) else -1)
    distal = along * (1 if quadrant in (2, 3) else -1)
    return np.array([[*distal, 0.0], [*outward, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False, kw_only=True)
class _Places:
    """Where the faces of a tooth lie along its axes, from the middle of its extent."""

    mm: Local
    half_mm: Float[np.ndarray, "3"]
    """Half the extent."""

    @property
    def relative(self) -> Local:
        return self.mm / self.half_mm


def _places(jaw: Jaw, faces: Int[np.ndarray, "n"], axes: Float[np.ndarray, "3 3"]) -> _Places:
    corners = jaw.mesh.vertices[jaw.mesh.faces[faces]] @ axes.T
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    return _Places(mm=jaw.mesh.face_centres[faces] @ axes.T - (low + high) / 2, half_mm=(high - low) / 2)


def _codes(fdi: int, places: _Places, normals: Local, options: SurfaceOptions) -> Int[np.ndarray, "n"]:
    towards = unit(normals[:, :2]) + 0.5 * unit(places.relative[:, :2])
    if kind_of(fdi) in ("incisor", "canine"):
        names, upwards = ("incisal", "labial"), normals[:, 2] > _UPWARDS
        from_edge = places.mm - _edge(places)
        is_top = upwards & (from_edge[:, 2] > -options.incisal_mm)
        towards[upwards] = from_edge[upwards, :2] * [0, 1]
    else:
        names, is_top = ("occlusal", "buccal"), _is_occlusal(places, normals)
    top, outer, lingual, mesial, distal = (SURFACES.index(name) for name in (*names, "lingual", "mesial", "distal"))
    proximal = np.abs(towards[:, 0]) > np.abs(towards[:, 1])
    sides = np.where(proximal, np.where(towards[:, 0] > 0, distal, mesial), np.where(towards[:, 1] > 0, outer, lingual))
    return np.asarray(np.where(is_top, top, sides))


def _edge(places: _Places) -> Local:
    """For each face: the highest place of the tooth at about the same distance along it."""
    bins = np.clip(np.floor((places.relative[:, 0] + 1) / 2 * _BINS).astype(int), 0, _BINS - 1)
    upwards = np.argsort(places.mm[:, 2])
    highest = np.zeros(_BINS, dtype=np.int64)
    highest[bins[upwards]] = upwards
    return places.mm[highest[bins]]


def _is_occlusal(places: _Places, normals: Local) -> Bool[np.ndarray, "n"]:
    """Within the rim of the crown."""
    radius = np.linalg.norm(places.relative[:, :2], axis=1)
    turns = np.arctan2(places.relative[:, 1], places.relative[:, 0]) / (2 * np.pi)
    sloping = np.einsum("nk,nk->n", normals[:, :2], unit(places.mm[:, :2]))
    table = (normals[:, 2] > _UPWARDS) & (sloping < _OUTWARDS) & (places.relative[:, 2] > 0)
    rim = _rim(turns[table], radius[table], turns)
    return np.asarray(table | (radius <= rim) & (normals[:, 2] > 0) & (places.relative[:, 2] > -0.5))


def _rim(
    turns: Float[np.ndarray, "m"], radius: Float[np.ndarray, "m"], directions: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Largest radius in each direction (in turns), smoothed around the circle, at the wanted directions."""
    largest = np.zeros(_WEDGES)
    np.maximum.at(largest, np.floor(turns * _WEDGES).astype(int) % _WEDGES, radius)
    smooth = uniform_filter1d(median_filter(largest, 3, mode="wrap"), 3, mode="wrap")
    return np.interp(directions, (np.arange(_WEDGES) + 0.5) / _WEDGES, smooth, period=1.0)


def _gum_beside_teeth(jaw: Jaw, reach_mm: float) -> Int[np.ndarray, "n"]:
    """The faces of the gum that lie near a tooth."""
    tooth = np.any([jaw.tooth_faces(fdi) for fdi in jaw.teeth], axis=0)
    gum = np.flatnonzero(~tooth)
    distances, _, _ = jaw.mesh.submesh(tooth).closest(jaw.mesh.face_centres[gum])
    return np.asarray(gum[distances <= reach_mm])
