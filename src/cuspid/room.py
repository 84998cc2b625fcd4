"""The room that a jaw leaves for the body of a handpiece.

A pose *fits* if no part of the body comes nearer to the surface than the clearance and no part lies inside the jaw.
Inside is where the generalised winding number (Jacobson et al., SIGGRAPH 2013) exceeds one half. This works for open
surfaces such as scans as well as for closed models: distant faces subtend little, whether they are there or not.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import no_type_check

import igl
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates

from cuspid.body import CAMERA_MM, LED_MM, Body, nearest_box
from cuspid.errors import InputError
from cuspid.geometry import Rigid3
from cuspid.kernels import kernel
from cuspid.mesh import Mesh
from cuspid.rig import Handpiece
from cuspid.workers import computed_once

_LOG = logging.getLogger("cuspid")

_APART_MM = 0.3
"""Largest distance between points on the surface along an edge."""
_PITCH_MM, _MOST_NODES = 0.5, 2_000_000
"""Spacing of the grid of distances to the body, wider for a body that would need more nodes than that: only points that
it does not decide are looked at exactly."""
_INSIDE_PITCH_MM = 1.0
"""Spacing of the grid of winding numbers; nearer to the surface than this, the distance decides."""
_INSIDE = 0.5
FAR_MM = 3.0
"""Distances are computed up to this far beyond the clearance."""


@dataclass(frozen=True, eq=False)
class _Grid:
    """Values at the nodes of a regular grid."""

    values: Float[np.ndarray, "x y z"]
    origin: Float[np.ndarray, "3"]
    pitch_mm: float

    @staticmethod
    def places(
        lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], pitch_mm: float
    ) -> Float[np.ndarray, "x y z 3"]:
        ticks = [np.arange(low, high + pitch_mm, pitch_mm) for low, high in zip(lower, upper, strict=True)]
        return np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1)


@dataclass(frozen=True, eq=False)
class Room:
    """A jaw, and the body of a handpiece that moves around it."""

    mesh: Mesh
    """In the occlusal frame."""
    body: Body
    """In the rig frame."""
    clearance_mm: float
    """Distance that they must keep from each other."""

    def fits(self, rig_from_world: Rigid3, pose_from_rig: Sequence[Rigid3]) -> Bool[np.ndarray, "n"]:
        """Whether the body fits at each of several poses, given relative to one pose."""
        rotations = np.stack([each.rotation for each in pose_from_rig])
        translations = np.stack([each.translation for each in pose_from_rig])
        swept = np.einsum("nji,nkj->nki", rotations, self._corners - translations[:, None]).reshape(-1, 3)
        points = self._within(
            rig_from_world, swept.min(axis=0) - self.clearance_mm, swept.max(axis=0) + self.clearance_mm
        )
        # What is nearest to the body meets most poses first.
        points = points[np.argsort(np.sum((points - self._corners.mean(axis=0)) ** 2, axis=1))]
        grid = self._distances
        coarse = grid.values, grid.origin, grid.pitch_mm
        free = _clear(points, rotations, translations, coarse, self.body.boxes, self.clearance_mm)
        which = np.flatnonzero(free)
        free[which] = ~self._inside([pose_from_rig[index] @ rig_from_world for index in which.tolist()]).any(axis=1)
        return free

    def clearance(self, rig_from_world: Rigid3) -> tuple[float, str]:
        """Distance in mm between body and surface, minus infinity if a part lies inside the jaw, and the name of that
        part.

        Infinite if they are some millimetres apart.
        """
        inside = self._inside([rig_from_world])[0]
        if inside.any():
            return -np.inf, self.body.names[int(np.argmax(inside))]
        reach = self.clearance_mm + FAR_MM
        low, high = self._corners[0] - reach, self._corners[-1] + reach
        distances, parts = self.body.distances(self._within(rig_from_world, low, high))
        if len(distances) == 0:
            return np.inf, self.body.names[0]
        least = int(np.argmin(distances))
        return float(distances[least]), self.body.names[parts[least]]

    def _within(
        self, rig_from_world: Rigid3, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Points of the surface in a box of the rig frame."""
        return np.asarray(_in_box(self._points, rig_from_world.rotation, rig_from_world.translation, low, high))

    @property
    def _points(self) -> Float[np.ndarray, "n 3"]:
        return _points_of(self.mesh)

    @computed_once
    def _corners(self) -> Float[np.ndarray, "8 3"]:
        """Of the box around the body, the lower one first and the upper one last."""
        return np.array(list(product(*self.body.bounds.T)))

    @computed_once
    def _distances(self) -> _Grid:
        """Signed distance to the body, in the rig frame."""
        low, high = self.body.bounds + [[-self.clearance_mm], [self.clearance_mm]]
        pitch_mm = max(_PITCH_MM, float(np.cbrt(np.prod(high - low) / _MOST_NODES)))
        places = _Grid.places(low, high, pitch_mm)
        return _Grid(self.body.distances(places.reshape(-1, 3))[0].reshape(places.shape[:3]), low, pitch_mm)

    @property
    def _winding(self) -> _Grid:
        """Winding number of the jaw, in the world."""
        return _winding_of(self.mesh)

    def _inside(self, rig_from_world: Sequence[Rigid3]) -> Bool[np.ndarray, "n p"]:
        """At each pose, which parts have their middle inside the jaw."""
        middles = np.array([pose.inverse().apply(self._middles) for pose in rig_from_world]).reshape(-1, 3)
        at = ((middles - self._winding.origin) / self._winding.pitch_mm).T
        numbers = map_coordinates(self._winding.values, at, order=1, cval=0.0)
        return np.asarray(numbers.reshape(len(rig_from_world), len(self._middles)) > _INSIDE)

    @computed_once
    def _middles(self) -> Float[np.ndarray, "p 3"]:
        return np.array([box.box_from_rig.inverse().translation for box in self.body.parts.values()])


# A search for a handpiece asks many bodies about few meshes.
@lru_cache(maxsize=8)
def _points_of(mesh: Mesh) -> Float[np.ndarray, "n 3"]:
    return surface_points(mesh, _APART_MM)


@lru_cache(maxsize=8)
def _winding_of(mesh: Mesh) -> _Grid:
    low, high = mesh.bounds + [[-FAR_MM], [FAR_MM]]
    places = _Grid.places(low, high, _INSIDE_PITCH_MM)
    vertices, faces = (np.ascontiguousarray(each) for each in (mesh.vertices, mesh.faces))
    numbers = igl.fast_winding_number(vertices, faces, np.ascontiguousarray(places.reshape(-1, 3)))
    return _Grid(np.asarray(numbers).reshape(places.shape[:3]), low, _INSIDE_PITCH_MM)


def surface_points(mesh: Mesh, apart_mm: float) -> Float[np.ndarray, "n 3"]:
    """The vertices of a mesh and, on faces with longer edges, a lattice of points no farther apart than required."""
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    steps = np.ceil(longest / apart_mm).astype(int)
    points = [mesh.vertices]
    for count in np.unique(steps[steps > 1]):
        i, j = np.array([(i, j) for i in range(count + 1) for j in range(count + 1 - i)]).T
        weights = np.stack([i, j, count - i - j], axis=1) / count
        points.append(np.einsum("kc,fcd->fkd", weights, corners[steps == count]).reshape(-1, 3))
    return np.concatenate(points)


def room_about(mesh: Mesh, handpiece: Handpiece, clearance_mm: float) -> Room:
    """The room for a handpiece. If its body is not known, what is assumed is logged."""
    if handpiece.body is None:
        camera, led = (" x ".join(f"{side:.1f}" for side in size) for size in (CAMERA_MM, LED_MM))
        _LOG.info(
            f"{handpiece.name}: its body is not known; a box of {camera} mm is assumed behind each lens and one of "
            f"{led} mm behind each LED; to change them, add a body to its handpiece.json (docs/formats.md)"
        )
    return Room(mesh, handpiece.solid, clearance_mm)


def check_clearance(room: Room, poses: Mapping[str, Rigid3]) -> None:
    """Raise InputError where a part of the handpiece comes too near to the jaw or lies inside it."""
    for frame, rig_from_world in poses.items():
        distance, part = room.clearance(rig_from_world)
        if distance < room.clearance_mm:
            where = "lies inside the jaw" if distance == -np.inf else f"comes within {distance:.2f} mm of the jaw"
            raise InputError(
                f"scan path: at frame {frame} the {part} of the handpiece {where}, "
                f"but must keep {room.clearance_mm:g} mm away"
            )


@kernel
@no_type_check
def _in_box(points, r, t, low, high):
    """The points, moved, that then lie in a box."""
    found = np.empty((len(points), 3))
    count = 0
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        u = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]
        if not low[0] <= u <= high[0]:
            continue
        v = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]
        if not low[1] <= v <= high[1]:
            continue
        w = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
        if low[2] <= w <= high[2]:
            found[count, 0], found[count, 1], found[count, 2] = u, v, w
            count += 1
    return found[:count].copy()


@kernel
@no_type_check
def _clear(points, rotations, translations, coarse, boxes, limit):
    """For each pose, whether the distances of all points, moved by the pose, from the boxes reach the limit.

    ``coarse`` is a grid of them, about the boxes as far as the limit: (values, origin, pitch).
    """
    free = np.ones(len(rotations), dtype=np.bool_)
    grid, origin, pitch = coarse
    nx, ny, nz = grid.shape
    slack = pitch * np.sqrt(3.0) / 2  # of a point from the node nearest to it, and so of their distances
    for k in range(len(rotations)):
        r, t = rotations[k], translations[k]
        for n in range(len(points)):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            u = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]
            v = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]
            w = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
            i, j, l = (u - origin[0]) / pitch + 0.5, (v - origin[1]) / pitch + 0.5, (w - origin[2]) / pitch + 0.5
            if not (0 <= i < nx and 0 <= j < ny and 0 <= l < nz):
                continue
            near = grid[int(i), int(j), int(l)]
            if near >= limit + slack:
                continue
            if near < limit - slack or nearest_box(u, v, w, boxes[0], boxes[1], boxes[2])[0] < limit:
                free[k] = False
                break
    return free
