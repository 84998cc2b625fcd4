"""Tooth labels from colours: white or grey gum and a colour for each tooth, of the faces or of the vertices.

Colours of a camera are not labels: they are many. Where vertices are coloured, or a mesh was thinned, faces on a border
have mixed colours, each on little surface; they go to the nearest colour that is not mixed.
"""

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial import KDTree

from cuspid.model.jaw import GUM, Arch
from cuspid.model.mesh import Mesh

Colors = UInt8[np.ndarray, "f 3"]

_LEAST_SHARE = 0.0015
"""Of the surface; a colour on less is a mixed one."""
_MIXED_SHARE = 0.1
"""Of the surface that may have mixed colours; more are those of a camera."""
_GREY = 10
"""Grey are colours whose channels differ by no more."""
_FEWEST, _MOST = 10, 16
"""Teeth of an arch that colours may tell."""


def face_colors_of(mesh: Mesh, face_colors: Colors | None) -> Colors | None:
    """The colours of the faces or, where only the vertices have colours, that of most corners of each face."""
    if face_colors is not None or mesh.colors is None:
        return face_colors
    corners = mesh.colors[mesh.faces]
    others_agree = np.all(corners[:, 1] == corners[:, 2], axis=1)
    return np.asarray(np.where(others_agree[:, None], corners[:, 1], corners[:, 0]))


def tooth_regions(colors: Colors, mesh: Mesh) -> Int[np.ndarray, "f"] | None:
    """A number for each face by its colour, 0 for gum; None where the colours are not those of teeth and gum.

    Gum is the largest part that is white or grey or, where none is, the largest of all.
    """
    known, region = np.unique(colors, axis=0, return_inverse=True)
    region = region.reshape(-1)
    areas = np.bincount(region, mesh.face_areas, minlength=len(known)) / mesh.face_areas.sum()
    main = areas >= _LEAST_SHARE
    if not _FEWEST < main.sum() <= _MOST + 1 or areas[~main].sum() > _MIXED_SHARE:
        return None
    mixed = ~main[region]
    if mixed.any():
        _, nearest = KDTree(mesh.face_centres[~mixed]).query(mesh.face_centres[mixed])
        region[mixed] = region[~mixed][nearest]
    grey = main & (np.ptp(known.astype(int), axis=1) <= _GREY)
    gum = int(np.argmax(np.where(grey if grey.any() else main, areas, -1.0)))
    numbers = np.zeros(len(known), dtype=np.int64)
    teeth = main & (np.arange(len(known)) != gum)
    numbers[teeth] = np.arange(1, teeth.sum() + 1)
    return np.asarray(numbers[region])


def number_regions(regions: Int[np.ndarray, "f"], mesh: Mesh, arch: Arch) -> Int[np.ndarray, "f"] | None:
    """FDI number for each face of a mesh in the occlusal frame whose teeth are separated.

    The teeth are numbered from the midline backwards on each side as if none were missing; None where a gap shows that
    one is, or where they are no row.
    """
    teeth = range(1, int(regions.max()) + 1)
    numbers = _number_teeth(np.array([mesh.centroid(regions == tooth)[:2] for tooth in teeth]), arch)
    return None if numbers is None else np.concatenate([[GUM], numbers])[regions]


def _number_teeth(centroids: Float[np.ndarray, "n 2"], arch: Arch) -> Int[np.ndarray, "n"] | None:
    """FDI numbers by place along the arch, or None where they are not those of a row without gaps."""
    numbers = np.zeros(len(centroids), dtype=np.int64)
    around = np.arctan2(centroids[:, 0], centroids[:, 1] - centroids[:, 1].min() + 1.0)
    for side, quadrant in ((1, 4), (-1, 3)) if arch == "lower" else ((1, 2), (-1, 1)):
        members = np.flatnonzero(side * centroids[:, 0] > 0)
        ordered = members[np.argsort(np.abs(around[members]))]
        steps = np.linalg.norm(np.diff(centroids[ordered], axis=0), axis=1)
        if not 5 <= len(ordered) <= 8 or np.any(steps > 14) or np.any(steps < 2):
            return None
        numbers[ordered] = 10 * quadrant + 1 + np.arange(len(ordered))
    return numbers
