"""The body of a handpiece: the space that it occupies, as boxes.

Frames: ``rig`` is the frame of the handpiece; ``box`` is that of a box, with its origin in the middle and its axes
along the edges.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int

from cuspid.geometry import Rigid3, read_only
from cuspid.runtime.errors import InputError
from cuspid.runtime.kernels import kernel
from cuspid.runtime.workers import computed_once


@dataclass(frozen=True, eq=False)
class Box:
    """A solid block."""

    box_from_rig: Rigid3
    """Its pose."""
    half_mm: Float[np.ndarray, "3"]
    """Half its side lengths, along its axes."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "half_mm", read_only(np.asarray(self.half_mm, dtype=np.float64)))
        if not (np.isfinite(self.half_mm).all() and (self.half_mm > 0).all()):
            raise InputError(f"body: the sides of a box must be positive, not {2 * self.half_mm} mm")

    @property
    def corners(self) -> Float[np.ndarray, "8 3"]:
        """The corners in the rig frame, mm."""
        return self.box_from_rig.inverse().apply((np.array(list(np.ndindex(2, 2, 2))) * 2 - 1.0) * self.half_mm)


CAMERA_MM, LED_MM = (1.0, 1.0, 1.6), (0.5, 0.5, 0.6)
"""Width, height and depth of a miniature camera module (with a sensor of 1/14 inch or less) and of an LED."""


def module(front_from_rig: Rigid3, size_mm: tuple[float, float, float]) -> Box:
    """The box of a component whose front is the XY plane of a frame; it extends behind it, towards -Z."""
    half = np.array(size_mm) / 2
    return Box(Rigid3(np.eye(3), np.array([0, 0, half[2]])) @ front_from_rig, half)


@dataclass(frozen=True, eq=False)
class Body:
    """The boxes that make up the handpiece."""

    parts: Mapping[str, Box]
    """Boxes by name."""

    def __post_init__(self) -> None:
        if not self.parts:
            raise InputError("body: at least one box is needed")
        object.__setattr__(self, "parts", MappingProxyType(dict(self.parts)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts in order."""
        return tuple(self.parts)

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Lower and upper corner of the bounding box, in the rig frame, mm."""
        corners = np.concatenate([box.corners for box in self.parts.values()])
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    def distances(self, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Signed distance in mm from points in the rig frame to the nearest part, negative inside, and the index of
        that part."""
        distance, part = np.empty(len(points)), np.empty(len(points), dtype=np.int64)
        _distances(np.ascontiguousarray(points, dtype=np.float64), *self.boxes, distance, part)
        return distance, part

    @computed_once
    def boxes(self) -> tuple[Float[np.ndarray, "p 3 3"], Float[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
        """Rotations and translations into the boxes, and half their sides, as :func:`nearest_box` takes them."""
        boxes = self.parts.values()
        return (
            np.stack([box.box_from_rig.rotation for box in boxes]),
            np.stack([box.box_from_rig.translation for box in boxes]),
            np.stack([box.half_mm for box in boxes]),
        )


@kernel
@no_type_check
def nearest_box(x, y, z, rotations, translations, halves):
    """Signed distance from a point to the nearest box, and its index."""
    nearest, which = np.inf, -1
    for b in range(len(halves)):
        outside, inside = 0.0, -np.inf
        for i in range(3):
            along = rotations[b, i, 0] * x + rotations[b, i, 1] * y + rotations[b, i, 2] * z + translations[b, i]
            over = abs(along) - halves[b, i]
            inside = max(inside, over)
            if over > 0:
                outside += over * over
        signed = np.sqrt(outside) if inside > 0 else inside
        if signed < nearest:
            nearest, which = signed, b
    return nearest, which


@kernel
@no_type_check
def _distances(points, rotations, translations, halves, distance, part):
    for n in range(len(points)):
        distance[n], part[n] = nearest_box(points[n, 0], points[n, 1], points[n, 2], rotations, translations, halves)
