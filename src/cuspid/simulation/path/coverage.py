"""What a handpiece sees of the crowns from many poses, quickly: for planning, not for evaluation.

Whether something occludes a point is looked up in its *sky*, the directions in which nothing stands within reach, so
that thousands of poses are evaluated at the cost of one round of rays. The evaluation of a plan casts actual rays:
:func:`cuspid.visibility.visible_counts`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from cuspid.arch_curve import ArchCurve
from cuspid.geometry import Rigid3
from cuspid.jaw import GUM, Jaw
from cuspid.kernels import kernel
from cuspid.rig import Handpiece
from cuspid.visibility import LEAST_OPENNESS, OPENNESS_REACH_MM, openness, slope_bounds

_AREA_MM2 = 0.7
"""Area of the surface that each point represents."""
_DIRECTIONS = 256
_LEAST_COSINE = float(np.cos(np.deg2rad(75.0)))
"""Minimum cosine of the incidence at which a point is seen; as in :mod:`cuspid.visibility`."""
_ASIDE_MM, _BELOW_MM = 7.0, 8.0
"""Without labels, crowns are what lies this near to the arch, seen from above, and this far below its line."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CrownPoints:
    """Points, uniform on the crown surface that is open to some direction."""

    points: Float[np.ndarray, "n 3"]
    """In the occlusal frame, mm."""
    normals: Float[np.ndarray, "n 3"]
    teeth: Int[np.ndarray, "n"]
    """FDI number of each point's tooth; 0 where it is not known."""
    open: Bool[np.ndarray, "n d"]
    """Whether a direction is free."""
    directions: Float[np.ndarray, "d 3"]
    nearest: Int[np.ndarray, "lat lon"]
    """The direction nearest to a height above the plane XY and an angle in it."""

    def within(self, places: Float[np.ndarray, "p 3"], radius_mm: float) -> Int[np.ndarray, "k"]:
        """Points that lie within the radius of one of the places."""
        near = KDTree(places).query(self.points, distance_upper_bound=radius_mm)[0]
        return np.flatnonzero(np.isfinite(near))

    def cameras_at(
        self, which: Int[np.ndarray, "k"], handpiece: Handpiece, rig_from_world: Sequence[Rigid3]
    ) -> Int[np.ndarray, "p k"]:
        """From each pose, the number of cameras that see each of some points."""
        cameras = handpiece.rig.cameras.values()
        bounds = np.array([np.concatenate(slope_bounds(each.camera)) for each in cameras])
        return np.asarray(
            _cameras_at(
                self.points[which],
                self.normals[which],
                self.open[which],
                self.nearest,
                np.stack([pose.rotation for pose in rig_from_world]),
                np.stack([pose.translation for pose in rig_from_world]),
                np.stack([each.cam_from_rig.rotation for each in cameras]),
                np.stack([each.cam_from_rig.translation for each in cameras]),
                bounds,
                np.array(handpiece.depth_range_mm),
                _LEAST_COSINE,
            )
        )


def crown_faces(jaw: Jaw, curve: ArchCurve) -> Bool[np.ndarray, "f"]:
    """Faces of crowns, by their labels; without labels, those around the arch."""
    if jaw.face_labels is not None and np.any(jaw.face_labels != GUM):
        return np.asarray(jaw.face_labels != GUM)
    aside, nearest = KDTree(curve.points[:, :2]).query(jaw.mesh.face_centres[:, :2])
    below = curve.points[nearest, 2] - jaw.mesh.face_centres[:, 2]
    return np.asarray((aside < _ASIDE_MM) & (below < _BELOW_MM))


def crown_points(jaw: Jaw, curve: ArchCurve, reach_mm: float) -> CrownPoints:
    """Points on the crowns, and in which directions something stands within ``reach_mm`` of them."""
    wanted = crown_faces(jaw, curve)
    crowns = jaw.mesh.submesh(wanted)
    labels = np.full(len(wanted), GUM) if jaw.face_labels is None else jaw.face_labels
    count = max(int(crowns.face_areas.sum() / _AREA_MM2), 1)
    points, faces = crowns.sample(count, np.random.default_rng(0))
    is_open = openness(jaw.mesh, points, crowns.face_normals[faces], OPENNESS_REACH_MM) >= LEAST_OPENNESS
    points, faces = points[is_open], faces[is_open]
    normals, directions = crowns.face_normals[faces], _evenly(_DIRECTIONS)
    open_ = normals @ directions.T > _LEAST_COSINE
    row, column = np.nonzero(open_)
    open_[row, column] = ~jaw.mesh.occluded(points[row], points[row] + reach_mm * directions[column])
    return CrownPoints(
        points=points,
        normals=normals,
        teeth=labels[wanted][faces],
        open=open_,
        directions=directions,
        nearest=_nearest_table(directions),
    )


def _evenly(count: int) -> Float[np.ndarray, "d 3"]:
    """Directions about evenly on the sphere (Fibonacci's lattice)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    return np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)


def _nearest_table(directions: Float[np.ndarray, "d 3"]) -> Int[np.ndarray, "lat lon"]:
    z, angle = np.meshgrid((np.arange(64) + 0.5) / 32 - 1, (np.arange(128) + 0.5) / 64 * np.pi - np.pi, indexing="ij")
    radius = np.sqrt(1 - z**2)
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
    return np.asarray(KDTree(directions).query(places)[1])


@kernel
@no_type_check
def _cameras_at(
    points, normals, open_, nearest, rotations, translations, cam_rotations, cam_translations, bounds, depths, cosine
):
    seen = np.zeros((len(rotations), len(points)), dtype=np.int64)
    latitudes, longitudes = nearest.shape
    for k in range(len(rotations)):
        for c in range(len(cam_rotations)):
            r = cam_rotations[c] @ rotations[k]
            t = cam_rotations[c] @ translations[k] + cam_translations[c]
            eye = -r.T @ t
            for n in range(len(points)):
                p = points[n]
                z = r[2, 0] * p[0] + r[2, 1] * p[1] + r[2, 2] * p[2] + t[2]
                if z < depths[0] or z > depths[1]:
                    continue
                x = (r[0, 0] * p[0] + r[0, 1] * p[1] + r[0, 2] * p[2] + t[0]) / z
                y = (r[1, 0] * p[0] + r[1, 1] * p[1] + r[1, 2] * p[2] + t[1]) / z
                if x < bounds[c, 0] or y < bounds[c, 1] or x > bounds[c, 2] or y > bounds[c, 3]:
                    continue
                dx, dy, dz = eye[0] - p[0], eye[1] - p[1], eye[2] - p[2]
                length = np.sqrt(dx * dx + dy * dy + dz * dz)
                facing = (dx * normals[n, 0] + dy * normals[n, 1] + dz * normals[n, 2]) / length
                if facing < cosine:
                    continue
                i = min(int((dz / length + 1) / 2 * latitudes), latitudes - 1)
                j = min(int((np.arctan2(dy, dx) + np.pi) / (2 * np.pi) * longitudes), longitudes - 1)
                if open_[n, nearest[i, j]]:
                    seen[k, n] += 1
    return seen
