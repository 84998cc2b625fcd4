"""What a handpiece sees of the crowns from many poses, quickly: for planning, not for evaluation.

Whether something occludes a point is looked up in its *sky*, the directions in which nothing stands within reach, so
that thousands of poses are evaluated at the cost of one round of rays. The evaluation of a plan casts actual rays:
:func:`cuspid.model.visibility.visible_counts`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from cuspid.geometry import Rigid3, compose_motions
from cuspid.model.arch_curve import ArchCurve
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.rig import Handpiece
from cuspid.model.visibility import LEAST_OPENNESS, OPENNESS_REACH_MM, openness, slope_bounds
from cuspid.runtime.kernels import kernel

_AREA_MM2 = 0.7
"""Area of the surface that each point represents."""
_DIRECTIONS = 256
_LEAST_COSINE = float(np.cos(np.deg2rad(75.0)))
"""Minimum cosine of the incidence at which a point is seen; as in :mod:`cuspid.model.visibility`."""
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

    def seen_by_two(
        self,
        which: Int[np.ndarray, "k"],
        handpiece: Handpiece,
        rig_from_world: Rigid3,
        pose_from_rig: Sequence[Rigid3],
    ) -> Bool[np.ndarray, "p k"]:
        """Whether two cameras see each of some points from each of several poses, given relative to one pose."""
        cameras = handpiece.rig.cameras.values()
        seen = np.empty((len(pose_from_rig), len(which)), dtype=np.bool_)
        _mark_seen_by_two(
            self.points[which],
            self.normals[which],
            self.open[which],
            self.nearest,
            compose_motions(pose_from_rig, rig_from_world),
            compose_motions([each.cam_from_rig for each in cameras], Rigid3.identity()),
            np.array([np.concatenate(slope_bounds(each.camera)) for each in cameras]),
            np.array(handpiece.depth_range_mm),
            seen,
        )
        return seen


def crown_faces(jaw: Jaw, curve: ArchCurve) -> Bool[np.ndarray, "f"]:
    """Faces of crowns, by their labels; without labels, those around the arch."""
    if jaw.face_labels is not None and np.any(jaw.face_labels != GUM):
        return np.asarray(jaw.face_labels != GUM)
    aside, nearest = KDTree(curve.points[:, :2]).query(jaw.mesh.face_centres[:, :2])
    below = curve.points[nearest, 2] - jaw.mesh.face_centres[:, 2]
    return np.asarray((aside < _ASIDE_MM) & (below < _BELOW_MM))


def crown_points(jaw: Jaw, curve: ArchCurve, reach_mm: float) -> CrownPoints:
    """Points on the crowns, and in which directions something stands within ``reach_mm`` of them."""
    selected = crown_faces(jaw, curve)
    crowns = jaw.mesh.submesh(selected)
    labels = np.full(len(selected), GUM) if jaw.face_labels is None else jaw.face_labels
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
        teeth=labels[selected][faces],
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
def _mark_seen_by_two(points, normals, open_, nearest, poses, cameras, bounds, depths, seen):
    latitudes, longitudes = nearest.shape
    near, inside, own = np.empty(len(points), np.int64), np.empty(len(points), np.bool_), np.empty((3, len(points)))
    counts = np.empty(len(points), np.int64)
    rotations, translations, eyes = np.empty_like(cameras[0]), np.empty_like(cameras[1]), np.empty_like(cameras[1])
    longest = depths[1] * np.sqrt(1 + np.max(np.abs(bounds[:, :2])) ** 2 + np.max(np.abs(bounds[:, 2:])) ** 2)
    for k in range(len(seen)):
        _place(cameras, poses[0][k], poses[1][k], rotations, translations, eyes)
        found = _within(points, eyes, longest, near, own)
        counts[:] = 0
        for c in range(len(eyes)):
            _mark_in_image(own, found, rotations[c], translations[c], bounds[c], depths, inside)
            x, y, z = eyes[c]
            for i in range(found):
                n = near[i]
                if not inside[i] or counts[n] == 2:
                    continue
                dx, dy, dz = x - own[0, i], y - own[1, i], z - own[2, i]
                length = np.sqrt(dx * dx + dy * dy + dz * dz)
                facing = (dx * normals[n, 0] + dy * normals[n, 1] + dz * normals[n, 2]) / length
                if facing < _LEAST_COSINE:
                    continue
                latitude = min(int((dz / length + 1) / 2 * latitudes), latitudes - 1)
                longitude = min(int((np.arctan2(dy, dx) + np.pi) / (2 * np.pi) * longitudes), longitudes - 1)
                if open_[n, nearest[latitude, longitude]]:
                    counts[n] += 1
        seen[k] = counts == 2


@kernel
@no_type_check
def _place(cameras, rotation, translation, rotations, translations, eyes):
    """Fill in ``cam_from_world`` and the centre of each camera; several times as fast as by BLAS."""
    for c in range(len(eyes)):
        for i in range(3):
            translations[c, i] = cameras[1][c, i]
            for j in range(3):
                translations[c, i] += cameras[0][c, i, j] * translation[j]
                rotations[c, i, j] = 0.0
                for l in range(3):
                    rotations[c, i, j] += cameras[0][c, i, l] * rotation[l, j]
        for i in range(3):
            eyes[c, i] = 0.0
            for j in range(3):
                eyes[c, i] -= rotations[c, j, i] * translations[c, j]


@kernel
@no_type_check
def _within(points, eyes, longest, near, own):
    """Fill in the points that are not too far away for any of the eyes, by coordinate, and tell how many there are."""
    x, y, z = eyes[:, 0].mean(), eyes[:, 1].mean(), eyes[:, 2].mean()
    apart, found = 0.0, 0
    for c in range(len(eyes)):
        apart = max(apart, (eyes[c, 0] - x) ** 2 + (eyes[c, 1] - y) ** 2 + (eyes[c, 2] - z) ** 2)
    reach = (longest + np.sqrt(apart)) ** 2
    for n in range(len(points)):
        if (points[n, 0] - x) ** 2 + (points[n, 1] - y) ** 2 + (points[n, 2] - z) ** 2 <= reach:
            near[found], own[0, found], own[1, found], own[2, found] = n, points[n, 0], points[n, 1], points[n, 2]
            found += 1
    return found


@kernel
@no_type_check
def _mark_in_image(own, found, r, t, bounds, depths, inside):
    """Which of the points lie in an image and in focus: without branches, so that several are computed at once."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = r.ravel()
    t0, t1, t2 = t
    left, top, right, bottom = bounds
    nearest, farthest = depths
    for i in range(found):
        x = r00 * own[0, i] + r01 * own[1, i] + r02 * own[2, i] + t0
        y = r10 * own[0, i] + r11 * own[1, i] + r12 * own[2, i] + t1
        z = r20 * own[0, i] + r21 * own[1, i] + r22 * own[2, i] + t2
        in_focus = (z >= nearest) & (z <= farthest)
        inside[i] = in_focus & (x >= left * z) & (y >= top * z) & (x <= right * z) & (y <= bottom * z)
