"""A tooth of a labelled jaw as a place to work on: its frame, its gum margin, and its borders with the neighbours.

Frame of a site: right-handed, mm; +z the long axis of the crown, out of the gum; +y buccal (labial); x mesiodistal (the
sign of distal is `ToothSite.distal`). The origin lies on the axis at the height of the lowest gum margin. All is
estimated from the labelled surface, so that it works on the phantom and on a user's scan alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, gaussian_filter, gaussian_filter1d, map_coordinates
from scipy.spatial import cKDTree

from cuspid.anatomy.landmarks.scheme import ToothKind, kind_of
from cuspid.geometry import Rigid3
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh, edges_of
from cuspid.runtime.errors import InputError
from cuspid.runtime.workers import computed_once

TURNS = 240
"""Directions round the axis in which a tooth is described."""
GRID_MM = 0.1
"""Grid of the map of heights."""
TABLE_MM = 0.5
"""Smoothing of the occlusal surface into planes without grooves."""
MOST_TILT_DEG = 8.0
"""Largest angle between a tooth's axis and the occlusal direction."""
_ARCHES = ((*range(48, 40, -1), *range(31, 39)), (*range(18, 10, -1), *range(21, 29)))
_LEAST_CONTACT = 6
"""Edges between two teeth below which they do not touch."""
_REACH_MM = 4.0
"""A neighbour farther away than this is none."""

Heights = Callable[[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]], Float[np.ndarray, "*n"]]
"""A height z for positions x, y."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Border:
    """The surface between a tooth and its neighbour, in the frame of the site: x over (y, z), quadratic there."""

    fdi: int
    """The neighbour."""
    side: float
    """Sign of x of the neighbour."""
    centre: Float[np.ndarray, "2"]
    """The y and z about which the coefficients hold, mm."""
    reach: Float[np.ndarray, "2"]
    """Half extents in y and z beyond which x is continued level, mm."""
    coefficients: Float[np.ndarray, "6"]
    """Of 1, y, z, y^2, yz and z^2."""

    def x(self, y: Float[np.ndarray, "*n"], z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """The x of the border, mm."""
        dy = np.clip(y - self.centre[0], -self.reach[0], self.reach[0])
        dz = np.clip(z - self.centre[1], -self.reach[1], self.reach[1])
        return np.tensordot(self.coefficients, _terms(dy, dz), axes=1)

    def beyond(self, shift_mm: float) -> Mesh:
        """A closed block of all that lies beyond the border, moved by a shift towards the neighbour."""
        steps = np.arange(-40, 41) * 0.25
        y, z = np.meshgrid(self.centre[0] + steps, self.centre[1] + steps, indexing="ij")
        x = self.x(y, z) + self.side * shift_mm
        n = len(steps)
        near, far = (np.stack([at, y, z], axis=-1).reshape(-1, 3) for at in (x, np.full_like(y, self.side * 25.0)))
        index = np.arange(n * n).reshape(n, n)
        a, b, c, d = (k.ravel() for k in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
        sheet = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
        rim = np.concatenate([index[:, 0], index[-1, 1:], index[-2::-1, -1], index[0, -2:0:-1]])
        after, m = np.roll(rim, -1), n * n
        sides = np.concatenate([np.column_stack([after, rim, rim + m]), np.column_stack([after, rim + m, after + m])])
        faces = np.concatenate([sheet, sheet[:, ::-1] + m, sides])
        return outward(np.concatenate([near, far]), faces)


def _terms(y: Float[np.ndarray, "*n"], z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "6 *n"]:
    return np.stack([np.ones_like(y), y, z, y * y, y * z, z * z])


def outward(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Mesh:
    """A closed mesh with its normals outwards."""
    a, b, c = (vertices[faces[:, k]] - vertices[0] for k in range(3))
    inside_out = np.sum(a * np.cross(b, c)) < 0
    return Mesh(vertices, faces[:, ::-1] if inside_out else faces)


@dataclass(frozen=True, eq=False, kw_only=True)
class ToothSite:
    """A tooth, its frame and its surroundings."""

    fdi: int
    """FDI number."""
    site_from_jaw: Rigid3
    """Into the frame of the site."""
    distal: float
    """+1 where +x is distal, -1 where it is mesial."""
    surface: Mesh
    """The faces of the tooth, in the frame of the site."""
    gum_margin: Float[np.ndarray, "g 3"]
    """Points where the tooth meets the gum, in the frame of the site, mm."""
    borders: tuple[Border, ...]
    """At most one for each side."""

    @property
    def kind(self) -> ToothKind:
        """Kind of tooth."""
        return kind_of(self.fdi)

    @property
    def width_mm(self) -> float:
        """Mesiodistal extent of the visible crown."""
        return float(np.ptp(self.surface.vertices[:, 0]))

    def gum_height(self) -> Float[np.ndarray, "TURNS"]:
        """Height of the gum margin in each direction round the axis, mm; interpolated across contacts."""
        angles, _ = self.polar(self.gum_margin)
        return round_means(angles, self.gum_margin[:, 2])

    @computed_once
    def lean(self) -> Float[np.ndarray, "2"]:
        """Shift in x and y per mm of height of the line from the cervix to the middle of the occlusal surface."""
        vertices = self.surface.vertices
        top = vertices[vertices[:, 2] > self._top - (0.6 if self.kind in ("incisor", "canine") else 2.0)]
        return np.clip((top.min(axis=0) + top.max(axis=0))[:2] / 2 / top[:, 2].mean(), -0.35, 0.35)

    def polar(self, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
        """Direction (radians, 0 to 2 pi) and horizontal distance (mm) of points from the leaning middle line."""
        x, y = (points[:, :2] - points[:, 2:] * self.lean).T
        return np.arctan2(y, x) % (2 * np.pi), np.hypot(x, y)

    @computed_once
    def _sides(self) -> Mesh:
        angles, _ = self.polar(self.surface.face_centres)
        normals = self.surface.face_normals
        outwards = normals[:, 0] * np.cos(angles) + normals[:, 1] * np.sin(angles)
        return self.surface.submesh((np.abs(normals[:, 2]) < 0.7) & (outwards > 0.6))

    def side_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Distance to the sides of the tooth, mm; negative inside, minus infinity where a side is not the nearest."""
        distances, faces, closest = self._sides.closest(points)
        above = np.sum((points - closest) * self._sides.face_normals[faces], axis=1)
        return np.where(np.abs(above) < 0.8 * distances, -np.inf, above)

    def occlusal_height(self, x: Float[np.ndarray, "*n"], y: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Height of the surface seen from occlusal, mm; NaN beside the tooth."""
        points = np.stack(np.broadcast_arrays(x, y, self._top + 1.0), axis=-1).reshape(-1, 3)
        hits = self.surface.cast(points, np.tile([0.0, 0.0, -1.0], (len(points), 1)))
        return np.where(hits.faces >= 0, self._top + 1.0 - hits.distances, np.nan).reshape(np.shape(x))

    @property
    def _top(self) -> float:
        return float(self.surface.vertices[:, 2].max())

    @computed_once
    def table(self) -> Heights:
        """The occlusal surface smoothed over `TABLE_MM` and continued level beyond its rim."""
        low, high = self.surface.vertices[:, :2].min(axis=0) - 1, self.surface.vertices[:, :2].max(axis=0) + 1
        x, y = (np.arange(a, b, GRID_MM) for a, b in zip(low, high, strict=True))
        points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((len(x), len(y)), self._top + 1)], axis=-1)
        hits = self.surface.cast(points.reshape(-1, 3), np.tile([0.0, 0.0, -1.0], (points[..., 0].size, 1)))
        level = (hits.faces >= 0) & (self.surface.face_normals[hits.faces, 2] > 0.55)
        height = (self._top + 1 - hits.distances).reshape(len(x), len(y))
        nearest = distance_transform_edt(~level.reshape(height.shape), return_distances=False, return_indices=True)
        smooth = gaussian_filter(height[tuple(nearest)], TABLE_MM / GRID_MM, mode="nearest")
        return lambda x, y: map_coordinates(
            smooth, [(x - low[0]) / GRID_MM, (y - low[1]) / GRID_MM], order=1, mode="nearest"
        )

    @computed_once
    def edge(self) -> Heights:
        """The height of the incisal edge over x, smoothed over 0.3 mm, whatever y."""
        vertices = self.surface.vertices
        x = np.arange(vertices[:, 0].min(), vertices[:, 0].max(), GRID_MM)
        near = np.abs(vertices[:, 0][None] - x[:, None]) < 2 * GRID_MM
        height = np.where(near, vertices[:, 2], -np.inf).max(axis=1)
        height[[0, -1]] = height[[1, -2]]
        smooth = gaussian_filter1d(height, 0.3 / GRID_MM, mode="nearest")
        return lambda at, _: np.interp(at, x, smooth)


def round_means(angles: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "TURNS"]:
    """Mean of the values in each of `TURNS` directions, interpolated where there is none."""
    bins = np.floor(angles / (2 * np.pi) * TURNS).astype(int) % TURNS
    count = np.bincount(bins, minlength=TURNS)
    means = np.bincount(bins, values, minlength=TURNS) / np.maximum(count, 1)
    known = np.flatnonzero(count)
    return np.interp(np.arange(TURNS), known, means[known], period=TURNS)


def site_of(jaw: Jaw, fdi: int) -> ToothSite:
    """The site of a tooth. Raises InputError where the tooth is not there or has no gum round it."""
    mine = jaw.tooth_faces(fdi)
    assert jaw.face_labels is not None
    labels = jaw.face_labels
    pairs, middles = _seams(jaw.mesh, labels)
    gum = middles[(pairs == sorted((GUM, fdi))).all(axis=1)]
    if len(gum) < 10:
        raise InputError(f"tooth {fdi}: no gum faces border it, so its cervix is unknown; label the gum 0")
    site_from_jaw, distal = _frame(jaw, fdi, mine, gum)
    surface = jaw.mesh.submesh(mine).transformed(site_from_jaw)
    return ToothSite(
        fdi=fdi,
        site_from_jaw=site_from_jaw,
        distal=distal,
        surface=surface,
        gum_margin=site_from_jaw.apply(gum),
        borders=tuple(
            border
            for other in _neighbours(jaw, fdi)
            if (
                border := _border(
                    jaw, surface, site_from_jaw, other, middles[(pairs == sorted((fdi, other))).all(axis=1)]
                )
            )
        ),
    )


def _seams(mesh: Mesh, labels: Int[np.ndarray, "f"]) -> tuple[Int[np.ndarray, "s 2"], Float[np.ndarray, "s 3"]]:
    """Edges between faces of different labels: the two labels in ascending order, and the middle of each edge."""
    edges = np.sort(edges_of(mesh.faces), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    same = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
    one, two = labels[order[:-1][same] // 3], labels[order[1:][same] // 3]
    at = np.flatnonzero(one != two)
    middles = mesh.vertices[edges[order[:-1][same][at]]].mean(axis=1)
    return np.sort(np.column_stack([one, two])[at], axis=1), middles


def _neighbours(jaw: Jaw, fdi: int) -> list[int]:
    """The nearest teeth that are there, to either side along the arch."""
    arch = next((order for order in _ARCHES if fdi in order), None)
    if arch is None:
        raise InputError(f"tooth {fdi}: not the FDI number of a permanent tooth")
    at, there = arch.index(fdi), set(jaw.teeth)
    before = [tooth for tooth in arch[:at] if tooth in there][-1:]
    return before + [tooth for tooth in arch[at + 1 :] if tooth in there][:1]


def _frame(jaw: Jaw, fdi: int, mine: Bool[np.ndarray, "f"], gum: Float[np.ndarray, "g 3"]) -> tuple[Rigid3, float]:
    """The frame of a site, and the sign of x that is distal."""
    centre = jaw.mesh.centroid(mine)
    z = _long_axis(jaw.mesh.face_normals[mine], jaw.mesh.face_areas[mine])
    others = [jaw.mesh.centroid(jaw.tooth_faces(other)) for other in _neighbours(jaw, fdi)]
    outwards = centre * [1.0, 1.0, 0.0] if np.hypot(*centre[:2]) > 1 else np.array([0.0, 1.0, 0.0])
    along = {0: np.cross(outwards, z), 1: others[0] - centre if others else z}.get(
        len(others), others[-1] - others[0] if others else z
    )
    y = np.cross(z, along)
    y *= np.sign(y @ outwards) / np.linalg.norm(y)
    x = np.cross(y, z)
    rotation = np.stack([x, y, z])
    local = (gum - centre) @ rotation.T
    middle = (local.min(axis=0) + local.max(axis=0)) / 2
    middle[2] = local[:, 2].min()
    distal = 1.0 if x @ np.array([np.sign(centre[0]) or 1.0, -1.0, 0.0]) > 0 else -1.0
    return Rigid3(rotation, -rotation @ centre - middle), distal


def _long_axis(normals: Float[np.ndarray, "f 3"], areas: Float[np.ndarray, "f"]) -> Float[np.ndarray, "3"]:
    """The direction that the sides of a tooth run along, near the occlusal direction."""
    axis = np.array([0.0, 0.0, 1.0])
    for _ in range(5):
        side = np.abs(normals @ axis) < 0.6
        if not side.any():
            break
        moment = np.einsum("f,fi,fj->ij", areas[side], normals[side], normals[side])
        found = np.linalg.eigh(moment)[1][:, 0]
        axis = found * np.sign(found[2] or 1.0)
    tilt = np.arccos(np.clip(axis[2], -1, 1))
    if tilt > np.deg2rad(MOST_TILT_DEG):
        flat = axis[:2] / np.linalg.norm(axis[:2]) * np.sin(np.deg2rad(MOST_TILT_DEG))
        axis = np.array([*flat, np.cos(np.deg2rad(MOST_TILT_DEG))])
    return axis


def _border(
    jaw: Jaw, surface: Mesh, site_from_jaw: Rigid3, other: int, contact: Float[np.ndarray, "c 3"]
) -> Border | None:
    """The plane through the contact with a neighbour, or midway to one that does not touch; None where it is far."""
    if len(contact) >= _LEAST_CONTACT:
        points = site_from_jaw.apply(contact)
    else:
        neighbour = site_from_jaw.apply(jaw.mesh.submesh(jaw.tooth_faces(other)).vertices)
        distances, nearest = cKDTree(neighbour).query(surface.vertices)
        at = int(np.argmin(distances))
        if distances[at] > _REACH_MM:
            return None
        points = (surface.vertices[at] + neighbour[nearest[at]])[None] / 2
    centre = (points.min(axis=0) + points.max(axis=0))[1:] / 2
    extent = np.ptp(points[:, 1:], axis=0) / 2
    terms = _terms(points[:, 1] - centre[0], points[:, 2] - centre[1]).T
    weights = np.array([0.0, 0.05, 0.05, 0.2, 0.2, 0.2]) * np.sqrt(len(points))
    middle = points[:, 0].mean()
    system = np.concatenate([terms, np.diag(weights)])
    found = np.linalg.lstsq(system, np.concatenate([points[:, 0] - middle, np.zeros(6)]), rcond=None)[0]
    found[0] += middle
    return Border(fdi=other, side=float(np.sign(middle)), centre=centre, reach=extent + 0.2, coefficients=found)
