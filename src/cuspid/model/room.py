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
from typing import NamedTuple, no_type_check

import igl
import numpy as np
from jaxtyping import Bool, Float

from cuspid.geometry import Rigid3, compose_motions
from cuspid.model.body import CAMERA_MM, LED_MM, Body, nearest_box
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.runtime.errors import InputError
from cuspid.runtime.kernels import kernel
from cuspid.runtime.workers import computed_once

_LOG = logging.getLogger("cuspid")

_APART_MM = 0.3
"""Largest distance between points on the surface along an edge."""
_PITCH_MM, _MOST_NODES = 0.25, 2_000_000
"""Spacing of the grid of distances to the body, wider for a body that would need more nodes than that. It decides where
it can, and the exact distance elsewhere."""
_OFF = float(np.sqrt(3) / 2)
"""How far a distance may be from that at the nearest node of the grid, in spacings: it changes nowhere faster than a
place does."""
_INSIDE_PITCH_MM = 1.0
"""Spacing of the grid of winding numbers; nearer to the surface than this, the distance decides."""
_INSIDE = 0.5
_LEAF = 8
"""Least number of points in the smallest balls of the tree."""
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
class _Balls:
    """Points in a balanced binary tree of balls: the two halves of ball ``k`` are ``2 k + 1`` and ``2 k + 2``."""

    points: Float[np.ndarray, "n 3"]
    """Those of a smallest ball are consecutive, in the order of these balls; some occur twice."""
    centres: Float[np.ndarray, "b 3"]
    radii: Float[np.ndarray, "b"]

    @staticmethod
    def build(points: Float[np.ndarray, "n 3"]) -> _Balls:
        """Halved across the longest side of the box around them, again and again."""
        levels = max(0, int(np.log2(len(points) / _LEAF)))
        leaf = -(-len(points) // 2**levels)
        points = points[np.arange(leaf * 2**levels) % len(points)]
        centres, radii = np.empty((2 ** (levels + 1) - 1, 3)), np.empty(2 ** (levels + 1) - 1)
        _halve(points, centres, radii)
        return _Balls(points, centres, radii)


class _Surface(NamedTuple):
    """A jaw as arrays for the compiled search."""

    points: np.ndarray
    centres: np.ndarray
    radii: np.ndarray
    winding: np.ndarray
    winding_origin: np.ndarray


class _Solid(NamedTuple):
    """A body likewise."""

    rotations: np.ndarray
    translations: np.ndarray
    halves: np.ndarray
    middles: np.ndarray
    bounds: np.ndarray
    distances: np.ndarray
    origin: np.ndarray
    pitch: float


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
        free = np.empty(len(pose_from_rig), dtype=np.bool_)
        poses = compose_motions(pose_from_rig, rig_from_world)
        _fits(*poses, self._surface, self._solid, self.clearance_mm, free)
        return free

    def fits_at(self, rig_from_world: Sequence[Rigid3]) -> Bool[np.ndarray, "n"]:
        """Whether the body fits at each of several poses."""
        return self.fits(Rigid3.identity(), rig_from_world)

    def clearance(self, rig_from_world: Rigid3) -> tuple[float, str]:
        """Distance in mm between body and surface, minus infinity if a part lies inside the jaw, and the name of that
        part.

        Infinite if they are some millimetres apart.
        """
        inside = self._parts_inside(rig_from_world)
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
        return np.asarray(_points_in_box(self._points, rig_from_world.rotation, rig_from_world.translation, low, high))

    @property
    def _points(self) -> Float[np.ndarray, "n 3"]:
        return _balls_of(self.mesh).points

    @property
    def _surface(self) -> _Surface:
        balls, winding = _balls_of(self.mesh), _winding_of(self.mesh)
        return _Surface(balls.points, balls.centres, balls.radii, winding.values, winding.origin)

    @computed_once
    def _corners(self) -> Float[np.ndarray, "8 3"]:
        """Of the box around the body, the lower one first and the upper one last."""
        return np.array(list(product(*self.body.bounds.T)))

    @computed_once
    def _solid(self) -> _Solid:
        """With the signed distances to the body around it."""
        size = np.ptp(self.body.bounds, axis=0) + 2 * self.clearance_mm
        pitch_mm = max(_PITCH_MM, float(np.cbrt(np.prod(size) / _MOST_NODES)))
        reach = self.clearance_mm + 2 * pitch_mm
        low, high = self.body.bounds + [[-reach], [reach]]
        places = _Grid.places(low, high, pitch_mm)
        return _Solid(
            *self.body.boxes,
            self._middles,
            self.body.bounds,
            self.body.distances(places.reshape(-1, 3))[0].reshape(places.shape[:3]),
            low,
            pitch_mm,
        )

    @property
    def _winding(self) -> _Grid:
        """Winding number of the jaw, in the world."""
        return _winding_of(self.mesh)

    def _parts_inside(self, rig_from_world: Rigid3) -> Bool[np.ndarray, "p"]:
        """Which parts have their middle inside the jaw."""
        winding = self._winding
        middles = rig_from_world.inverse().apply(self._middles)
        return np.asarray([_winding_at(place, winding.values, winding.origin) > _INSIDE for place in middles])

    @computed_once
    def _middles(self) -> Float[np.ndarray, "p 3"]:
        return np.array([box.box_from_rig.inverse().translation for box in self.body.parts.values()])


# A search for a handpiece asks many bodies about few meshes.
@lru_cache(maxsize=8)
def _balls_of(mesh: Mesh) -> _Balls:
    return _Balls.build(surface_points(mesh, _APART_MM))


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
    fits = room.fits_at(list(poses.values()))
    if fits.all():
        return
    frame = list(poses)[int(np.argmin(fits))]
    distance, part = room.clearance(poses[frame])
    where = "lies inside the jaw" if distance == -np.inf else f"comes within {distance:.2f} mm of the jaw"
    raise InputError(
        f"scan path: at frame {frame} the {part} of the handpiece {where}, but must keep {room.clearance_mm:g} mm away"
    )


@kernel
@no_type_check
def _points_in_box(points, r, t, low, high):
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
def _halve(points, centres, radii):
    """Sort points into balls, in place, and fill in the balls."""
    for ball in range(len(radii)):
        level = int(np.log2(ball + 1.0))
        size = len(points) >> level
        some = points[(ball + 1 - (1 << level)) * size :][:size]
        low, high = some[0].copy(), some[0].copy()
        for p in some:
            for i in range(3):
                low[i], high[i] = min(low[i], p[i]), max(high[i], p[i])
        x, y, z = (low + high) / 2
        centres[ball], squared = (low + high) / 2, 0.0
        for p in some:
            squared = max(squared, (p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2)
        radii[ball] = np.sqrt(squared)
        if 2 * ball + 1 < len(radii):
            _part(some, np.argmax(high - low))


@kernel
@no_type_check
def _part(points, axis):
    """Move the lower half of some points along an axis to the front (C. A. R. Hoare's selection)."""
    first, last, middle = 0, len(points) - 1, len(points) // 2
    while first < last:
        pivot = points[(first + last) // 2, axis]
        i, j = first, last
        while i <= j:
            while points[i, axis] < pivot:
                i += 1
            while points[j, axis] > pivot:
                j -= 1
            if i <= j:
                for c in range(3):
                    points[i, c], points[j, c] = points[j, c], points[i, c]
                i, j = i + 1, j - 1
        if middle <= j:
            last = j
        elif middle >= i:
            first = i
        else:
            return


@kernel
@no_type_check
def _winding_at(place, winding, origin):
    """The winding number of the jaw at a place, interpolated linearly; zero far from it."""
    u = (place[0] - origin[0]) / _INSIDE_PITCH_MM
    v = (place[1] - origin[1]) / _INSIDE_PITCH_MM
    w = (place[2] - origin[2]) / _INSIDE_PITCH_MM
    nx, ny, nz = winding.shape
    if not (0 <= u < nx - 1 and 0 <= v < ny - 1 and 0 <= w < nz - 1):
        return 0.0
    i, j, l = int(u), int(v), int(w)
    a, b, c = u - i, v - j, w - l
    low = (winding[i, j, l] * (1 - a) + winding[i + 1, j, l] * a) * (1 - b) + (
        winding[i, j + 1, l] * (1 - a) + winding[i + 1, j + 1, l] * a
    ) * b
    high = (winding[i, j, l + 1] * (1 - a) + winding[i + 1, j, l + 1] * a) * (1 - b) + (
        winding[i, j + 1, l + 1] * (1 - a) + winding[i + 1, j + 1, l + 1] * a
    ) * b
    return low * (1 - c) + high * c


@kernel
@no_type_check
def _box_distance(x, y, z, bounds):
    """From a place to a box along the axes, zero inside."""
    a = max(bounds[0, 0] - x, 0.0, x - bounds[1, 0])
    b = max(bounds[0, 1] - y, 0.0, y - bounds[1, 1])
    c = max(bounds[0, 2] - z, 0.0, z - bounds[1, 2])
    return np.sqrt(a * a + b * b + c * c)


@kernel
@no_type_check
def _distance_bound(x, y, z, solid):
    """A lower bound of the distance from a place in the rig frame to the body: near to it twice `_OFF` spacings below
    an upper bound."""
    nx, ny, nz = solid.distances.shape
    scale = 1 / solid.pitch
    u = (x - solid.origin[0]) * scale + 0.5
    v = (y - solid.origin[1]) * scale + 0.5
    w = (z - solid.origin[2]) * scale + 0.5
    if 0 <= u < nx and 0 <= v < ny and 0 <= w < nz:
        return solid.distances[int(u), int(v), int(w)] - _OFF * solid.pitch
    return _box_distance(x, y, z, solid.bounds)


@kernel
@no_type_check
def _is_free(rotation, translation, surface, solid, limit, stack):
    """Whether a body at a pose keeps its distance from all points."""
    leaves = (len(surface.radii) + 1) // 2
    leaf = len(surface.points) // leaves
    stack[0], count = 0, 1
    while count > 0:
        count -= 1
        ball = stack[count]
        x, y, z = _transform_point(rotation, translation, surface.centres[ball])
        if _distance_bound(x, y, z, solid) - surface.radii[ball] >= limit:
            continue
        if ball < leaves - 1:
            stack[count], stack[count + 1] = 2 * ball + 1, 2 * ball + 2
            count += 2
            continue
        first = (ball - leaves + 1) * leaf
        for n in range(first, first + leaf):
            x, y, z = _transform_point(rotation, translation, surface.points[n])
            least = _distance_bound(x, y, z, solid)
            if least >= limit:
                continue
            undecided = least + 2 * _OFF * solid.pitch >= limit
            if undecided and nearest_box(x, y, z, solid.rotations, solid.translations, solid.halves)[0] >= limit:
                continue
            return False
    return True


@kernel
@no_type_check
def _transform_point(rotation, translation, p):
    return (
        rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + translation[0],
        rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + translation[1],
        rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + translation[2],
    )


@kernel
@no_type_check
def _fits(rotations, translations, surface, solid, limit, free):
    """For each pose, whether the body keeps its distance and no part has its middle inside the jaw."""
    stack, place = np.empty(128, np.int64), np.empty(3)
    for k in range(len(rotations)):
        r, t = rotations[k], translations[k]
        free[k] = True
        for middle in solid.middles:
            for i in range(3):
                place[i] = 0.0
                for j in range(3):
                    place[i] += r[j, i] * (middle[j] - t[j])
            if _winding_at(place, surface.winding, surface.winding_origin) > _INSIDE:
                free[k] = False
                break
        free[k] = free[k] and _is_free(r, t, surface, solid, limit, stack)
