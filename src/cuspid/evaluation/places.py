"""Places on a reference, even by area, at which many scans are compared without keeping their surfaces.

A deviation is the distance to the closest surface, positive where the scan lies outside the reference. A scan shows a
place if its closest surface is no border of the scan, looks to the same side and lies within a limit.

Small motions. A motion by d(x) = w x (x - c) + t changes the deviation at a place with normal n by n.d to first order.
The motion that lessens the deviations most is therefore a linear least-squares problem, without the surface; what is
neglected is of second order in angles of some 0.1 degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import biweights
from cuspid.geometry import Rigid3, read_only
from cuspid.model.mesh import Mesh

_ROUNDS, _SETTLED_UM = 30, 1e-3
"""Number of reweightings of a small motion at most, and the change of any deviation that ends them."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Places:
    """Points on a reference."""

    points: Float[np.ndarray, "n 3"]
    """In the frame of the reference, mm."""
    normals: Float[np.ndarray, "n 3"]
    """Unit outward normals of the surface there."""
    faces: Int[np.ndarray, "n"]
    """The face of the reference that each lies on."""

    def __post_init__(self) -> None:
        for name in ("points", "normals", "faces"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def chosen(self, which: Bool[np.ndarray, "n"]) -> Places:
        """Some of them."""
        return Places(points=self.points[which], normals=self.normals[which], faces=self.faces[which])


def scatter(mesh: Mesh, count: int, rng: np.random.Generator) -> Places:
    """Places distributed uniformly by area."""
    points, faces = mesh.sample(count, rng)
    return Places(points=points, normals=mesh.face_normals[faces], faces=faces)


def deviations_um(places: Places, scan: SignedDistance, max_distance_mm: float) -> Float[np.ndarray, "n"]:
    """How far a scan lies outside each place; NaN where it does not show it."""
    closest = scan.closest_points(places.points)
    signed_mm = -closest.signed_mm
    same_side = np.sum(scan.mesh.face_normals[closest.faces] * places.normals, axis=1) > 0
    shown = ~closest.on_border & (np.abs(signed_mm) <= max_distance_mm) & same_side
    return np.where(shown, 1000 * signed_mm, np.nan)


@dataclass(frozen=True, eq=False, kw_only=True)
class SmallMotion:
    """A rotation by a vector (rad) about a centre and a shift (mm)."""

    turn: Float[np.ndarray, "3"]
    shift_mm: Float[np.ndarray, "3"]
    centre: Float[np.ndarray, "3"]

    def changes_um(self, places: Places) -> Float[np.ndarray, "n"]:
        """Change of the deviations at each place, um."""
        moves = np.cross(self.turn, places.points - self.centre) + self.shift_mm
        return np.asarray(1000 * np.sum(moves * places.normals, axis=1))

    @property
    def rigid(self) -> Rigid3:
        """The motion itself."""
        turn = Rigid3.from_rotation_vector(self.turn, np.zeros(3))
        return Rigid3(turn.rotation, self.centre - turn.rotate(self.centre) + self.shift_mm)


def best_motion(places: Places, deviation_um: Float[np.ndarray, "n"]) -> SmallMotion:
    """The small motion of a scan that lessens its deviations most, by reweighted least squares (Tukey); NaN is not
    counted. Without any deviation it moves nothing."""
    known = np.isfinite(deviation_um)
    used, signed_mm = places.chosen(known), deviation_um[known] / 1000
    centre = used.points.mean(axis=0) if known.any() else np.zeros(3)
    jacobian = np.concatenate([np.cross(used.points - centre, used.normals), used.normals], axis=1)
    solution, left = np.zeros(6), signed_mm
    for _ in range(_ROUNDS if known.any() else 0):
        weights = biweights(left, np.ones(len(left), dtype=bool))
        hessian = jacobian.T @ (weights[:, None] * jacobian)
        solution = np.linalg.lstsq(hessian, -jacobian.T @ (weights * signed_mm), rcond=1e-9)[0]
        before, left = left, signed_mm + jacobian @ solution
        if 1000 * np.abs(left - before).max() < _SETTLED_UM:
            break
    return SmallMotion(turn=solution[:3], shift_mm=solution[3:], centre=centre)
