"""Rigid motions in three dimensions, and the alignment of points with other points.

Notation: a transform is named ``target_from_source``; ``x_in_target = target_from_source @ x_in_source``.
Lengths are millimetres. There is no similarity transform on purpose: the rig fixes the scale. Where nothing does (one
camera, jaws of different size), :func:`best_similarity` returns the scale separately.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy.spatial.transform import Rotation

from cuspid.runtime.errors import InputError
from cuspid.runtime.values import quote

_Array = TypeVar("_Array", bound=np.ndarray)
_ROUNDING = 1e-6
"""How far rotations of files that were written with few digits may be off."""


def read_only(array: _Array) -> _Array:
    """A contiguous read-only copy of ``array`` (itself, where it is one already)."""
    if array.flags.writeable or not array.flags.c_contiguous:
        array = array.copy(order="C")
        array.flags.writeable = False
    return array


def freeze(array: _Array) -> _Array:
    """``array`` itself, made read-only: for what nothing else refers to."""
    array.flags.writeable = False
    return array


def distinct_rows(rows: Shaped[np.ndarray, "n d"]) -> tuple[Int[np.ndarray, "u"], Int[np.ndarray, "n"]]:
    """Where each of the distinct rows stands first, in the order of their values, and which of them each row is.

    As ``numpy.unique`` along the first axis, which takes twice as long.
    """
    order = np.lexsort(rows.T[::-1])  # stable: the first of equal rows stays the first
    new = np.ones(len(order), dtype=bool)
    new[1:] = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.cumsum(new) - 1
    return order[new], number


def unit(vectors: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "*n d"]:
    """Vectors scaled to length one; those of length zero stay zero."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def lengths_along(line: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
    """Length along a line from its start to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def axes_about(directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Right-handed axes, as rows, whose last one is a given unit vector; the rotation about it is arbitrary."""
    first = unit(np.cross(np.eye(3)[np.argmin(np.abs(directions), axis=-1)], directions))
    return np.stack([first, np.cross(directions, first), directions], axis=-2)


def _is_rotation(matrix: np.ndarray) -> bool:
    if matrix.shape != (3, 3):
        return False
    # In numbers of Python: several times as fast as in arrays this small, and motions are made by the thousand.
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    lengths = a * a + b * b + c * c - 1, d * d + e * e + f * f - 1, g * g + h * h + i * i - 1
    angles = a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i
    turned = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0
    return turned and all(abs(off) < _ROUNDING for off in (*lengths, *angles))


@dataclass(frozen=True, eq=False)
class Rigid3:
    """A rotation followed by a translation."""

    rotation: Float[np.ndarray, "3 3"]
    """Proper orthonormal matrix."""
    translation: Float[np.ndarray, "3"]
    """Translation in mm."""

    def __post_init__(self) -> None:
        """Raise InputError unless the rotation is proper and orthonormal and all values are finite."""
        object.__setattr__(self, "rotation", read_only(np.asarray(self.rotation, dtype=np.float64)))
        object.__setattr__(self, "translation", read_only(np.asarray(self.translation, dtype=np.float64)))
        if not _is_rotation(self.rotation):
            raise InputError(
                f"rigid motion: {quote(self.rotation)} is not a rotation; it must be a 3 x 3 matrix without scale"
            )
        if self.translation.shape != (3,) or not all(map(isfinite, self.translation.tolist())):
            raise InputError(f"rigid motion: its translation is {quote(self.translation)}; it must be 3 finite numbers")

    @staticmethod
    def identity() -> Rigid3:
        """The transform that moves nothing."""
        return Rigid3(np.eye(3), np.zeros(3))

    @staticmethod
    def from_quaternion(wxyz: Float[np.ndarray, "4"], translation: Float[np.ndarray, "3"]) -> Rigid3:
        """From a quaternion in COLMAP's order (w, x, y, z), of any positive length, and a translation in mm."""
        return Rigid3(Rotation.from_quat(wxyz, scalar_first=True).as_matrix(), translation)

    @staticmethod
    def from_rotation_vector(rotation_vector: Float[np.ndarray, "3"], translation: Float[np.ndarray, "3"]) -> Rigid3:
        """From an axis-angle vector in radians and a translation in mm."""
        return Rigid3(Rotation.from_rotvec(rotation_vector).as_matrix(), translation)

    @staticmethod
    def from_matrix(matrix: Float[np.ndarray, "r 4"]) -> Rigid3:
        """From a 3x4 or 4x4 homogeneous matrix."""
        return Rigid3(matrix[:3, :3], matrix[:3, 3])

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """Homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix

    @property
    def quaternion(self) -> Float[np.ndarray, "4"]:
        """Unit quaternion (w, x, y, z), w >= 0."""
        return np.asarray(Rotation.from_matrix(self.rotation).as_quat(canonical=True, scalar_first=True))

    @property
    def rotation_vector(self) -> Float[np.ndarray, "3"]:
        """Axis-angle vector in radians, of length at most pi."""
        return np.asarray(Rotation.from_matrix(self.rotation).as_rotvec())

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation in degrees, 0 to 180."""
        return float(np.rad2deg(np.linalg.norm(self.rotation_vector)))

    def inverse(self) -> Rigid3:
        """``source_from_target``."""
        return Rigid3(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: Rigid3) -> Rigid3:
        """``a_from_b @ b_from_c`` is ``a_from_c``."""
        return Rigid3(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def apply(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Transform points (mm)."""
        return points @ self.rotation.T + self.translation

    def rotate(self, directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Rotate directions, without translation."""
        return directions @ self.rotation.T


def compose_motions(
    motions: Sequence[Rigid3], first: Rigid3
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    """Rotations and translations of ``motion @ first`` for each of the motions: fast, for thousands of them."""
    rotations = np.stack([each.rotation for each in motions])
    translations = np.stack([each.translation for each in motions])
    return rotations @ first.rotation, rotations @ first.translation + translations


def best_similarity(
    source: Float[np.ndarray, "n d"], target: Float[np.ndarray, "n d"], weights: Float[np.ndarray, "n"] | None = None
) -> tuple[float, Float[np.ndarray, "d d"], Float[np.ndarray, "d"]]:
    """Scale s, proper rotation R and translation t for which ``s R x + t`` is nearest to the target, in any dimension.

    Nearest in the sum of the squares, times ``weights`` where there are any (S. Umeyama, IEEE PAMI 13, 1991). The
    rotation is also the best one where the scale is kept (W. Kabsch, Acta Cryst. A32, 1976).
    """
    shares = np.full(len(source), 1 / len(source)) if weights is None else weights / weights.sum()
    from_centre, to_centre = shares @ source, shares @ target
    centred = source - from_centre
    u, spread, vt = np.linalg.svd((shares[:, None] * (target - to_centre)).T @ centred)
    signs = np.ones(len(spread))
    signs[-1] = np.sign(np.linalg.det(u @ vt))
    rotation = u * signs @ vt
    scale = float(np.sum(spread * signs) / np.sum(shares @ centred**2))
    return scale, rotation, to_centre - scale * rotation @ from_centre
