"""Poses that may align one surface with another, from any start: an exhaustive search.

Anchors of the moving surface (points with normals) are placed on points all over the fixed one and rotated about the
normal in steps. Each of these millions of poses is scored by truncated distances that are looked up in a voxel table of
nearest points; the best are refined together on the same table. Nothing is assumed about the start, and the moving
surface may be a small part of the fixed one.

Frames: ``fixed`` and ``moving``. A batch of poses ``fixed_from_moving`` is an array (k, 3, 4) of [R|t].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, no_type_check

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3, axes_about, unit
from cuspid.model.mesh import Mesh
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range
from cuspid.runtime.workers import map_in_threads

_MAX_VOXELS = 1e6
_TESTED = 144
"""Maximum number of points that score a pose in the search; fewer if it soon looks hopeless."""
_AGREE = 0.2
"""Minimum cosine between the normals of two points that may be the same place."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions(Options):
    """How densely poses are sampled."""

    anchors: Annotated[int, Range(1, 1000)] = 12
    """Points of the moving surface that are placed on the fixed one."""
    targets: Annotated[int, Range(10, 100_000)] = 5000
    """Points of the fixed surface on which each anchor is placed."""
    turn_step_deg: Annotated[float, Range(1, 90)] = 10.0
    """Step of the rotation about the normal."""
    candidates: Annotated[int, Range(1, 100_000)] = 600
    """Number of poses that are refined."""
    finalists: Annotated[int, Range(1, 1000)] = 8
    """Maximum number of distinct poses that are returned."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Cloud:
    """Points even by area, in random order: the first n are a sample too."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    """Of the face at each point."""
    smooth_normals: Float[np.ndarray, "n 3"]
    """Averaged over a neighbourhood, so that two triangulations of one surface agree."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Table:
    """The fixed cloud, and for each voxel which of its points is nearest."""

    cloud: _Cloud
    nearest: Int[np.ndarray, "x y z"]
    origin: Float[np.ndarray, "3"]
    """Centre of the first voxel, mm."""
    pitch_mm: float

    def look_up(self, points: Float[np.ndarray, "*n 3"]) -> Int[np.ndarray, "*n"]:
        """Index of (nearly) the nearest point of the cloud."""
        voxels = np.rint((points - self.origin) / self.pitch_mm).astype(np.int64)
        x, y, z = np.moveaxis(np.clip(voxels, 0, np.array(self.nearest.shape) - 1), -1, 0)
        return np.asarray(self.nearest[x, y, z])


def find_poses(moving: Mesh, fixed: Mesh, options: SearchOptions, *, rng: np.random.Generator) -> list[Rigid3]:
    """Distinct ``fixed_from_moving`` that bring the surfaces together, the best first."""
    sample, _ = moving.sample(2000, rng)
    reach_mm = float(np.sqrt(sample.var(axis=0).sum()))
    smoothing_mm, cap_mm = min(0.1 * reach_mm, 2.5), 0.1 * reach_mm + 0.4
    cloud = _cloud(moving, 4000, smoothing_mm, rng)
    table = _table(_cloud(fixed, 30_000, smoothing_mm, rng), 1.5 * cap_mm)
    poses = _try_all(cloud, table, cap_mm, options)
    for fraction in np.geomspace(1.0, 0.2, 12):
        poses = _step_point_to_plane(poses, cloud, table, fraction * cap_mm)
    order = np.argsort(_scores(poses, cloud, table, 0.2 * cap_mm), kind="stable")
    return _distinct(poses[order], cloud.points[:50], 0.05 * reach_mm, options.finalists)


def _cloud(mesh: Mesh, count: int, smoothing_mm: float, rng: np.random.Generator) -> _Cloud:
    points, faces = mesh.sample(count, rng)
    order = rng.permutation(count)
    points, normals = points[order], mesh.normals_of(faces[order])
    a, b = cKDTree(points).query_pairs(smoothing_mm, output_type="ndarray").T
    alike = np.sum(normals[a] * normals[b], axis=1) > 0
    a, b = np.concatenate([a[alike], b[alike]]), np.concatenate([b[alike], a[alike]])
    summed = normals + np.stack([np.bincount(a, normals[b, axis], minlength=count) for axis in range(3)], axis=1)
    return _Cloud(points=points, normals=normals, smooth_normals=unit(summed))


def _table(cloud: _Cloud, margin_mm: float) -> _Table:
    lower, upper = cloud.points.min(axis=0) - margin_mm, cloud.points.max(axis=0) + margin_mm
    pitch = max(margin_mm / 6, float((np.prod(upper - lower) / _MAX_VOXELS) ** (1 / 3)))
    owner = np.full(np.ceil((upper - lower) / pitch).astype(int) + 1, -1, dtype=np.int32)
    owner[tuple(np.rint((cloud.points - lower) / pitch).astype(int).T)] = np.arange(len(cloud.points))
    voxels = distance_transform_edt(owner < 0, return_distances=False, return_indices=True)
    return _Table(cloud=cloud, nearest=owner[tuple(voxels)], origin=lower, pitch_mm=pitch)


def _frames(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """A rotation for each normal whose third column it is."""
    return np.ascontiguousarray(np.swapaxes(axes_about(normals), 1, 2))


def _farthest_points(points: Float[np.ndarray, "n 3"], count: int) -> Int[np.ndarray, "k"]:
    """Farthest-point sampling that begins at the point nearest the centroid."""
    picks = [int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distances = np.full(len(points), np.inf)
    for _ in range(count - 1):
        distances = np.minimum(distances, np.linalg.norm(points - points[picks[-1]], axis=1))
        picks.append(int(np.argmax(distances)))
    return np.array(picks)


def _try_all(cloud: _Cloud, table: _Table, cap_mm: float, options: SearchOptions) -> Float[np.ndarray, "k 3 4"]:
    """The best poses of anchors x targets x turns."""
    anchors = _farthest_points(cloud.points[:1000], options.anchors)
    targets = table.cloud.points[: options.targets]
    target_frames = _frames(table.cloud.smooth_normals[: options.targets])
    angles = np.deg2rad(np.arange(0, 360, options.turn_step_deg))
    turns = Rotation.from_rotvec(angles[:, None] * np.array([0, 0, 1.0])).as_matrix()
    anchor_turns = np.einsum("tij,akj->atik", turns, _frames(cloud.smooth_normals[anchors]))
    fixed = np.concatenate([table.cloud.points, table.cloud.normals], axis=1).astype(np.float32)

    def score(a: int) -> Float[np.ndarray, "targets turns"]:
        points = np.einsum("tik,nk->tni", anchor_turns[a], cloud.points[:_TESTED] - cloud.points[anchors[a]])
        normals = np.einsum("tik,nk->tni", anchor_turns[a], cloud.normals[:_TESTED])
        turned = np.concatenate([points, normals], axis=2).astype(np.float32)
        return _score_turns(turned, targets, target_frames, fixed, table.nearest, table.origin, table.pitch_mm, cap_mm)

    scores = np.stack(map_in_threads(score, range(len(anchors))))
    best = np.argsort(scores, axis=None, kind="stable")[: options.candidates]
    anchor, target, turn = np.unravel_index(best, scores.shape)
    rotation = target_frames[target] @ anchor_turns[anchor, turn]
    shift = targets[target] - np.einsum("kij,kj->ki", rotation, cloud.points[anchors[anchor]])
    return np.concatenate([rotation, shift[..., None]], axis=2)


@kernel(fastmath=True)
@no_type_check
def _score_turns(turned, targets, frames, fixed, nearest, origin, pitch, cap):
    """Mean truncated distance (share of the cap) for each target and turn; 1 for a pose that soon looks hopeless."""
    scores = np.ones((len(targets), len(turned)), dtype=np.float32)
    for t in range(len(targets)):
        for k in range(len(turned)):
            summed = 0.0
            for i in range(turned.shape[1]):
                if (i == 6 and summed > 0.9 * i) or (i == 12 and summed > 0.85 * i) or (i == 36 and summed > 0.72 * i):
                    break
                summed += _distance(turned, k, i, targets, frames, t, fixed, nearest, origin, pitch, cap)
            else:
                scores[t, k] = summed / turned.shape[1]
    return scores


@kernel(fastmath=True)
@no_type_check
def _distance(turned, k, i, targets, frames, t, fixed, nearest, origin, pitch, cap):
    """Truncated distance of one point, as a share of the cap; 1 where the normals disagree."""
    x, y, z = turned[k, i, 0], turned[k, i, 1], turned[k, i, 2]
    p0 = frames[t, 0, 0] * x + frames[t, 0, 1] * y + frames[t, 0, 2] * z + targets[t, 0]
    p1 = frames[t, 1, 0] * x + frames[t, 1, 1] * y + frames[t, 1, 2] * z + targets[t, 1]
    p2 = frames[t, 2, 0] * x + frames[t, 2, 1] * y + frames[t, 2, 2] * z + targets[t, 2]
    i0 = int((p0 - origin[0]) / pitch + 0.5)
    i1 = int((p1 - origin[1]) / pitch + 0.5)
    i2 = int((p2 - origin[2]) / pitch + 0.5)
    if min(i0, i1, i2) < 0 or i0 >= nearest.shape[0] or i1 >= nearest.shape[1] or i2 >= nearest.shape[2]:
        return 1.0
    j = nearest[i0, i1, i2]
    squared = (p0 - fixed[j, 0]) ** 2 + (p1 - fixed[j, 1]) ** 2 + (p2 - fixed[j, 2]) ** 2
    if squared > cap * cap:
        return 1.0
    x, y, z = turned[k, i, 3], turned[k, i, 4], turned[k, i, 5]
    n0 = frames[t, 0, 0] * x + frames[t, 0, 1] * y + frames[t, 0, 2] * z
    n1 = frames[t, 1, 0] * x + frames[t, 1, 1] * y + frames[t, 1, 2] * z
    n2 = frames[t, 2, 0] * x + frames[t, 2, 1] * y + frames[t, 2, 2] * z
    if n0 * fixed[j, 3] + n1 * fixed[j, 4] + n2 * fixed[j, 5] < _AGREE:
        return 1.0
    return np.sqrt(squared) / cap


def _perturb_poses(poses: Float[np.ndarray, "k 3 4"], vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k n 3"]:
    return np.einsum("kij,nj->kni", poses[:, :, :3], vectors) + poses[:, None, :, 3]


def _pairs(
    poses: Float[np.ndarray, "k 3 4"], cloud: _Cloud, table: _Table, count: int
) -> tuple[
    Float[np.ndarray, "k n 3"], Float[np.ndarray, "k n 3"], Float[np.ndarray, "k n 3"], Float[np.ndarray, "k n"]
]:
    """Moved points, their offsets from the nearest fixed points, the normals there, and how far the normals agree."""
    moved = _perturb_poses(poses, cloud.points[:count])
    nearest = table.look_up(moved)
    normals = table.cloud.normals[nearest]
    agreement = np.einsum("kni,kij,nj->kn", normals, poses[:, :, :3], cloud.normals[:count], optimize=True)
    return moved, moved - table.cloud.points[nearest], normals, agreement


def _step_point_to_plane(
    poses: Float[np.ndarray, "k 3 4"], cloud: _Cloud, table: _Table, cap_mm: float
) -> Float[np.ndarray, "k 3 4"]:
    """One damped point-to-plane step for each pose."""
    moved, offsets, normals, agreement = _pairs(poses, cloud, table, 250)
    close = (np.linalg.norm(offsets, axis=2) < cap_mm) & (agreement > _AGREE)
    centres = moved.mean(axis=1, keepdims=True)
    jacobian = np.concatenate([np.cross(moved - centres, normals), normals], axis=2) * close[..., None]
    residuals = np.sum(offsets * normals, axis=2)
    hessian = np.einsum("kni,knj->kij", jacobian, jacobian) + 1e-2 * np.eye(6)
    step = np.linalg.solve(hessian, -np.einsum("kni,kn->ki", jacobian, residuals)[..., None])[..., 0]
    turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
    shift = np.einsum("kij,kj->ki", turn, poses[:, :, 3] - centres[:, 0]) + centres[:, 0] + step[:, 3:]
    return np.concatenate([turn @ poses[:, :, :3], shift[..., None]], axis=2)


def _scores(poses: Float[np.ndarray, "k 3 4"], cloud: _Cloud, table: _Table, cap_mm: float) -> Float[np.ndarray, "k"]:
    """Mean truncated distance to the plane at the nearest point; the cap where that is far or the normals disagree."""
    _, offsets, normals, agreement = _pairs(poses, cloud, table, 1000)
    close = (np.linalg.norm(offsets, axis=2) < 2 * cap_mm) & (agreement > _AGREE)
    heights = np.abs(np.sum(offsets * normals, axis=2))
    return np.asarray(np.where(close, np.minimum(heights, cap_mm), cap_mm).mean(axis=1))


def _distinct(
    poses: Float[np.ndarray, "k 3 4"], probes: Float[np.ndarray, "n 3"], apart_mm: float, count: int
) -> list[Rigid3]:
    """The first poses that differ from all before by more than ``apart_mm`` on the probes."""
    moved = _perturb_poses(poses, probes)
    kept: list[int] = []
    for k in range(len(poses)):
        if all(np.linalg.norm(moved[k] - moved[other], axis=1).mean() > apart_mm for other in kept):
            kept.append(k)
        if len(kept) == count:
            break
    return [Rigid3(poses[k, :, :3], poses[k, :, 3]) for k in kept]
