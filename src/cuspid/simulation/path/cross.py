"""A sweep from one side of the arch straight to the other, over what lies between them, which ties the two ends.

A pass along the arch determines the distance between its ends only through a long chain, which bends; a sweep across
measures it directly. It begins over the crowns of one side like a pass, follows the surface between the sides, tilted
with its slope, and ends over the crowns of the other side like a pass there. On the way the handpiece rotates by half a
turn, as along the arch: what it sees at the ends then looks the same as in the passes, and is recognised.

It goes as far back as there is surface all the way that two cameras, or the only one, see in focus where the handpiece
fits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3
from cuspid.model.arch_curve import ArchCurve
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.model.room import Room
from cuspid.simulation.path.detour import ease_lifts, least_lifts, lifted_from_rig
from cuspid.simulation.path.overlap import image_overlap

_STEP_MM = 1.0
"""Spacing of the positions of a sweep."""
_INSET_MM, _APART_MM = 4.0, 2.0
"""Sweeps are tried from so far before the end of the arch, and this far apart along it ..."""
_NARROWEST = 0.5
"""... until they are no longer than this share of the way between the ends: in front there is no side to cross to."""
_PATCH_MM = 1.5
"""Half the width of the strip under the handpiece whose highest surface it follows."""
_SMOOTH_MM = 3.0
"""A hand follows the surface no closer than this (standard deviation of a Gaussian)."""
_EASE_MM = 5.0
"""Length over which the sweep leaves the pose of a pass at its ends."""
_STEEPEST_DEG = 40.0
"""Maximum tilt with the surface."""
_ABOVE_MM = 8.0
"""Height from which the rays start that find the surface."""
_SLOPE = 4
"""Number of positions over which it lifts where the body would touch."""
_GRID = 12
"""Rays along each side of an image that determine whether it shows surface."""


@dataclass(frozen=True, eq=False)
class Crossing:
    """A sweep across: poses of a steady hand, evenly along it."""

    start_mm: float
    """Where on the arch curve it begins ..."""
    end_mm: float
    """... and where it ends."""
    length_mm: float
    """Length of the way between them; initially of the straight one."""
    rig_from_world: tuple[Rigid3, ...]

    def preceded_by(self, pose: Rigid3) -> Crossing:
        """The sweep after a pose of a pass over the place where it begins."""
        step = self.length_mm / (len(self.rig_from_world) - 1)
        poses = (pose, *self.rig_from_world)
        return replace(self, length_mm=self.length_mm + step, rig_from_world=poses)

    def pose_at(self, travel_mm: float) -> Rigid3:
        """The handpiece after this travel along the sweep."""
        place = np.clip(travel_mm / self.length_mm, 0, 1) * (len(self.rig_from_world) - 1)
        before = min(int(place), len(self.rig_from_world) - 2)
        return _interpolate_pose(self.rig_from_world[before], self.rig_from_world[before + 1], float(place - before))


def _interpolate_pose(one: Rigid3, other: Rigid3, share: float) -> Rigid3:
    """A pose on the way from one to another, with an even turn and the origin on a straight line."""
    first, second = one.inverse(), other.inverse()
    turn = Rotation.from_matrix(second.rotation @ first.rotation.T).as_rotvec()
    rotation = Rotation.from_rotvec(share * turn).as_matrix() @ first.rotation
    return Rigid3(rotation, (1 - share) * first.translation + share * second.translation).inverse()


def plan_crossing(mesh: Mesh, room: Room, handpiece: Handpiece, curve: ArchCurve, near_mm: float) -> Crossing | None:
    """The sweep that lies farthest back, from the side of the given point of the curve; None if there is none."""
    length = float(curve.lengths_mm[-1])
    for inset in np.arange(_INSET_MM, length / 2, _APART_MM):
        ends = (float(inset), length - float(inset))
        if _width(curve, *ends) < _NARROWEST * _width(curve, 0.0, length):
            break
        crossing = _crossing(mesh, room, curve, *(ends if near_mm < length / 2 else ends[::-1]))
        if crossing is not None and _is_seen(mesh, handpiece, crossing):
            return crossing
    return None


def _width(curve: ArchCurve, one_mm: float, other_mm: float) -> float:
    """Of the arch between two places of the curve, mm."""
    return float(np.linalg.norm(curve.place(other_mm) - curve.place(one_mm)))


def _crossing(mesh: Mesh, room: Room, curve: ArchCurve, start_mm: float, end_mm: float) -> Crossing | None:
    """The sweep between two places of the curve, lifted to fit; None where it does not, or there is no surface."""
    ends = [curve.rig_from_world(at).inverse() for at in (start_mm, end_mm)]
    length = float(np.linalg.norm(ends[1].translation - ends[0].translation))
    heights = _heights(mesh, ends[0].translation, ends[1].translation, max(3, 1 + round(length / _STEP_MM)))
    if not np.isfinite(heights).all():
        return None
    poses = list(_follow_surface(ends[0], ends[1], heights, length))
    lifts = least_lifts(room, poses)
    if not np.isfinite(lifts).all():
        return None
    lifted = tuple(
        lifted_from_rig(float(lift)) @ pose for lift, pose in zip(ease_lifts(lifts, _SLOPE), poses, strict=True)
    )
    return Crossing(start_mm, end_mm, length, lifted)


def _heights(
    mesh: Mesh, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], count: int
) -> Float[np.ndarray, "n"]:
    """How high the highest surface in a strip lies above the straight line, at even places; infinite without any."""
    along = (end - start) / np.linalg.norm(end - start)
    aside = np.cross([0, 0, 1.0], along)
    line = start + np.linspace(0, 1, count)[:, None] * (end - start)
    offsets = np.linspace(-_PATCH_MM, _PATCH_MM, 5)[:, None] * aside / np.linalg.norm(aside)
    above = (line[:, None] + offsets + [0, 0, _ABOVE_MM]).reshape(-1, 3)
    hits = mesh.cast(above, np.broadcast_to([0, 0, -1.0], above.shape))
    return np.asarray(_ABOVE_MM - hits.distances.reshape(count, -1).min(axis=1))


def _follow_surface(
    start: Rigid3, end: Rigid3, heights_mm: Float[np.ndarray, "n"], length_mm: float
) -> Iterator[Rigid3]:
    """``rig_from_world`` along the surface, from ``world_from_rig`` at the start to that at the end."""
    step = length_mm / (len(heights_mm) - 1)
    at = np.arange(len(heights_mm)) * step
    highest = maximum_filter1d(heights_mm, 1 + 2 * round(_PATCH_MM / step), mode="nearest")
    inside = np.clip(np.minimum(at, length_mm - at) / _EASE_MM, 0, 1)
    height = inside * gaussian_filter1d(highest, _SMOOTH_MM / step, mode="nearest")
    slope = np.arctan(np.gradient(height, step)) * inside
    tilt = np.clip(slope, *np.deg2rad([-_STEEPEST_DEG, _STEEPEST_DEG]))
    axis = np.cross((end.translation - start.translation) / length_mm, [0, 0, 1.0])
    turn = Rotation.from_matrix(end.rotation @ start.rotation.T).as_rotvec()
    for share, lift, angle in zip(at / length_mm, height, tilt, strict=True):
        rotation = Rotation.from_rotvec(angle * axis) * Rotation.from_rotvec(share * turn)
        place = (1 - share) * start.translation + share * end.translation + [0, 0, lift]
        yield Rigid3(rotation.as_matrix() @ start.rotation, place).inverse()


def _is_seen(mesh: Mesh, handpiece: Handpiece, crossing: Crossing) -> bool:
    """Whether two cameras, or the only one, see surface in focus everywhere on the way, and again in the next place."""
    overlap = image_overlap(mesh, handpiece, crossing.rig_from_world, _GRID)
    return bool(np.all(np.sum(np.nan_to_num(overlap) > 0, axis=1) >= min(2, len(handpiece.rig.cameras))))
