"""What frames show of a surface, and how one surface lies on another: by the distances along the normals between points
and their nearest (Y. Chen, G. Medioni, Image and Vision Computing 10, 1992).

A point counts for as much as its depth is known: what is smooth for lack of evidence moves along with the cameras, and
would hold them back.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from cuspid.geometry import Rigid3, unit
from cuspid.model.reconstruction import DepthMap

_JUMP = 0.06
"""Neighbours in a depth map that lie farther apart, as a share of the working distance, are not on one surface."""
_LEAST_COSINE = 0.3
"""Of the angle between surface and line of sight: what is seen more obliquely is too noisy to lay anything on."""
_LEAST_MEMBERS = 3
"""Depths that make a point."""
_ALIKE = 0.7
"""Cosine of the largest angle between the normals of the same place in two frames."""
_TUKEY = 3.0
"""Robust standard deviations beyond which a distance has no weight."""
_LEAST_SIGMA = 0.0006
"""Standard deviation of distances, as a share of the working distance, below which none is assumed."""
LEAST_MATCHES = 100
"""Points that must lie on another surface to say anything."""


class OrientedPoints(NamedTuple):
    """Points of a surface that a frame shows, in its rig frame."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    trust: Float[np.ndarray, "n"]
    """Inverse variance, in any unit."""


class Surface:
    """What a frame shows, ready to be asked for the nearest point."""

    def __init__(self, shown: OrientedPoints) -> None:
        self.points, self.normals, self.trust = shown
        self._tree = cKDTree(self.points)

    def __len__(self) -> int:
        return len(self.points)

    def nearest(
        self, points: Float[np.ndarray, "n 3"], reach_mm: float
    ) -> tuple[Bool[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Whether a point lies within reach, and which."""
        distance, index = self._tree.query(points, distance_upper_bound=reach_mm)
        near = np.isfinite(distance)
        return near, np.where(near, index, 0)

    def some(self, count: int, rng: np.random.Generator) -> OrientedPoints:
        """A random choice of the points."""
        chosen = rng.permutation(len(self))[:count]
        return OrientedPoints(self.points[chosen], self.normals[chosen], self.trust[chosen])


class Correspondences(NamedTuple):
    """How one surface lies on another."""

    points: np.ndarray
    """Of the first, in the frame of the second."""
    normals: np.ndarray
    """Mean of both."""
    distances: np.ndarray
    """Along them."""
    sigmas: np.ndarray
    """Standard deviation of each."""
    sigma: float
    """That of a typical one."""
    share: float
    """Of the first surface that lies on the second."""

    @property
    def _scaled_squares(self) -> Float[np.ndarray, "n"]:
        return np.asarray(np.minimum((self.distances / (_TUKEY * self.sigmas)) ** 2, 1.0))

    @property
    def weights(self) -> Float[np.ndarray, "n"]:
        """Tukey's, over the variance."""
        return np.asarray((1 - self._scaled_squares) ** 2 / self.sigmas**2)

    @property
    def slopes(self) -> Float[np.ndarray, "n"]:
        """How much weight times distance changes with the distance."""
        return np.asarray((1 - self._scaled_squares) * (1 - 5 * self._scaled_squares) / self.sigmas**2)

    @property
    def rows(self) -> Float[np.ndarray, "n 6"]:
        """What a small motion (rotation vector, translation) of the points does to their distances."""
        return np.concatenate([np.cross(self.points, self.normals), self.normals], axis=1)

    def normal_equations(self) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6"]]:
        """Matrix and right-hand side of the normal equations for that motion."""
        rows = self.rows
        weighted = rows * self.weights[:, None]
        return weighted.T @ rows, weighted.T @ self.distances

    @property
    def relief(self) -> float:
        """How much the surface turns: least mean squared cosine between its normals and any direction; 0 is a plane,
        1/3 a ball."""
        return float(np.linalg.eigvalsh(self.normals.T @ self.normals / len(self.normals))[0])


def _oriented_points(depth_map: DepthMap, jump_mm: float, border_px: int) -> OrientedPoints:
    """The points of a depth map that have neighbours on all sides, in the rig frame."""
    camera = depth_map.camera
    rays = camera.rays(camera.pixel_centres().reshape(-1, 2)).reshape(camera.height, camera.width, 3)
    points = rays * np.where(depth_map.known, depth_map.depth_mm, np.nan)[..., None]
    right, down = np.full((2, *points.shape), np.nan)
    right[:, 1:-1], down[1:-1] = points[:, 2:] - points[:, :-2], points[2:] - points[:-2]
    normals = unit(np.cross(down, right))
    facing = -(normals * points).sum(axis=-1) / np.linalg.norm(points, axis=-1)
    normals, facing = normals * np.sign(facing)[..., None], np.abs(facing)
    with np.errstate(invalid="ignore"):
        smooth = np.maximum(np.linalg.norm(right, axis=-1), np.linalg.norm(down, axis=-1)) < jump_mm
        good = smooth & (facing > _LEAST_COSINE) & _away_from_border(depth_map.known, border_px)
    rig_from_cam = depth_map.cam_from_rig.inverse()
    return OrientedPoints(
        rig_from_cam.apply(points[good]), rig_from_cam.rotate(normals[good]), depth_map.confidence[good].astype(float)
    )


def _away_from_border(known: Bool[np.ndarray, "h w"], border_px: int) -> Bool[np.ndarray, "h w"]:
    """Pixels with no unknown one so close; beyond the image nothing is unknown."""
    window = np.ones((2 * border_px + 1,) * 2, np.uint8)
    return cv2.erode(known.astype(np.uint8), window).astype(bool)


def surface_of(depth_maps: Iterable[DepthMap], distance_mm: float, *, thinning: float, border_px: int) -> Surface:
    """What the depth maps of a frame show, thinned out: the mean of what lies in one cube and faces one way.

    ``thinning`` is the side of a cube, as a share of the working distance; what lies within ``border_px`` pixels of a
    depth that is not known is left out.
    """
    parts = [_oriented_points(each, _JUMP * distance_mm, border_px) for each in depth_maps]
    nothing = OrientedPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    points, normals, trust = (np.concatenate(each) for each in zip(nothing, *parts, strict=True))
    cubes = np.floor(points / (thinning * distance_mm)).astype(np.int64)
    sides = np.abs(normals).argmax(axis=1, keepdims=True) if len(normals) else np.zeros((0, 1), int)
    facing = sides + 3 * (np.take_along_axis(normals, sides, axis=1) > 0)
    _, cell, members = np.unique(
        np.concatenate([cubes, facing], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    cell, enough = cell.reshape(-1), members >= _LEAST_MEMBERS
    total = np.bincount(cell, trust, len(members))

    def mean(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        sums = [np.bincount(cell, trust * values[:, axis], len(members)) for axis in range(3)]
        return (np.stack(sums, axis=1) / total[:, None])[enough]

    return Surface(OrientedPoints(mean(points), unit(mean(normals)), (total / members)[enough]))


def match_point_to_plane(
    one: Surface | OrientedPoints, other: Surface, other_from_one: Rigid3, reach: float, distance_mm: float
) -> Correspondences | None:
    """One surface on another, as far as both lie within reach, a share of the working distance, and face one way; None
    where hardly anything does."""
    points, normals = other_from_one.apply(one.points), other_from_one.rotate(one.normals)
    near, index = other.nearest(points, reach * distance_mm)
    near &= (normals * other.normals[index]).sum(axis=1) > _ALIKE
    if near.sum() < LEAST_MATCHES:
        return None
    points, index = points[near], index[near]
    normals = unit(normals[near] + other.normals[index])
    distances = ((points - other.points[index]) * normals).sum(axis=1)
    uncertain = np.sqrt(1 / one.trust[near] + 1 / other.trust[index])
    uncertain /= np.median(uncertain)
    sigma = max(1.4826 * float(np.median(np.abs(distances) / uncertain)), _LEAST_SIGMA * distance_mm)
    return Correspondences(points, normals, distances, sigma * uncertain, sigma, float(near.mean()))


def small_motion(motion: Float[np.ndarray, "6"]) -> Rigid3:
    """The rigid motion of a small step (rotation vector, translation)."""
    return Rigid3.from_rotation_vector(motion[:3], motion[3:])


def solve_damped(
    matrix: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n *k"], damping: float
) -> Float[np.ndarray, "n *k"]:
    """The solution of normal equations, with a share of their diagonal added, which only matters where nothing is
    known."""
    diagonal = np.diag(matrix)
    return np.asarray(np.linalg.solve(matrix + damping * np.diag(np.maximum(diagonal, diagonal.mean())), right))
