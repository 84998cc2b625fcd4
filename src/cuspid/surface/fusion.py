"""Depth maps to one mesh, in two passes over the maps.

The first pass blends signed distances in a sparse volume, whose zero level gives the topology. The second asks every
depth map about every vertex and moves the vertex along its normal to the robust weighted mean of the surfaces that were
seen, which takes out what the voxels rounded; it also counts who saw the vertex, and in which colour. A vertex that
too few maps confirm from its outer side is not kept: that takes away ghosts and back walls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import njit

from cuspid.errors import ReconstructionError
from cuspid.geometry import Rigid3
from cuspid.mesh import Mesh
from cuspid.reconstruction import DepthMap
from cuspid.surface.evidence import Evidence, colors_of, observe
from cuspid.surface.meshing import extract
from cuspid.surface.volume import SparseVolume


@dataclass(frozen=True, kw_only=True)
class FusionOptions:
    """Fusion of depth maps into a mesh."""

    voxel_mm: float = 0.05
    """Spacing of the grid, about the spacing of the mesh's vertices."""
    truncation_voxels: float = 3.0
    """Distance from a surface, in voxels, up to which it is blended."""
    largest_jump_mm: float = 0.15
    """Neighbouring depths that differ by more do not belong to one surface."""
    least_weight: float = 0.05
    """Weight (sum of confidences) from which a voxel counts as observed."""
    agreement_mm: float = 0.08
    """A depth map confirms a vertex within this distance; nearer ones count more."""
    least_maps: int = 2
    """Number of depth maps that must confirm a vertex."""


def fuse(
    depth_maps: Sequence[DepthMap], rig_from_world: Mapping[str, Rigid3], options: FusionOptions | None = None
) -> Mesh:
    """One coloured mesh in the world frame from the depth maps whose frame was located.

    ``depth_maps`` is gone through twice and may read its items lazily. Raises ReconstructionError where there is none.
    """
    options = options or FusionOptions()
    volume = SparseVolume(options.voxel_mm, options.truncation_voxels * options.voxel_mm)
    for depth_map in depth_maps:
        if depth_map.frame in rig_from_world:
            cam_from_world = depth_map.cam_from_rig @ rig_from_world[depth_map.frame]
            points, _ = depth_map.points_in_rig()
            world_points = rig_from_world[depth_map.frame].inverse().apply(points)
            volume.integrate(Evidence.of(depth_map, options.largest_jump_mm), cam_from_world, world_points)
    rough = extract(volume, options.least_weight)
    del volume
    if len(rough.faces) == 0:
        raise ReconstructionError(
            "surface: the located frames hold no depth; more texture, more overlap or a better calibration is needed"
        )
    return _projected(rough, depth_maps, rig_from_world, options)


@dataclass(frozen=True, eq=False)
class _Votes:
    """What the depth maps say about each vertex; filled map by map."""

    moment: Float[np.ndarray, "v 2"]
    """Sum of weights, and of weights times distance along the vertex normal (mm)."""
    color: Float[np.ndarray, "v 3"]
    """Sum of weights times RGB."""
    maps: Int[np.ndarray, "v"]
    """Number of depth maps that confirm the vertex."""


def _projected(
    rough: Mesh, depth_maps: Sequence[DepthMap], rig_from_world: Mapping[str, Rigid3], options: FusionOptions
) -> Mesh:
    """The mesh with its vertices on the mean of the depth maps, coloured, without what too few maps confirm."""
    count = len(rough.vertices)
    votes = _Votes(np.zeros((count, 2)), np.zeros((count, 3)), np.zeros(count, dtype=np.int64))
    for depth_map in depth_maps:
        if depth_map.frame in rig_from_world:
            cam_from_world = depth_map.cam_from_rig @ rig_from_world[depth_map.frame]
            _collect(rough, Evidence.of(depth_map, options.largest_jump_mm), depth_map, cam_from_world, options, votes)
    return _moved(rough, votes, options.least_maps)


def _collect(
    rough: Mesh,
    evidence: Evidence,
    depth_map: DepthMap,
    cam_from_world: Rigid3,
    options: FusionOptions,
    votes: _Votes,
) -> None:
    _vote(
        rough.vertices,
        rough.vertex_normals,
        cam_from_world.rotation,
        cam_from_world.translation,
        evidence.arrays,
        colors_of(depth_map),
        options.agreement_mm,
        votes.moment,
        votes.color,
        votes.maps,
    )


def _moved(rough: Mesh, votes: _Votes, least_maps: int) -> Mesh:
    total = np.maximum(votes.moment[:, :1], 1e-12)
    vertices = rough.vertices + rough.vertex_normals * votes.moment[:, 1:] / total
    colors: UInt8[np.ndarray, "v 3"] = np.rint(votes.color / total).clip(0, 255).astype(np.uint8)
    confirmed = votes.maps >= least_maps
    return Mesh(vertices, rough.faces, colors).submesh(confirmed[rough.faces].all(axis=1))


@njit(cache=True, nogil=True)
@no_type_check
def _vote(vertices, normals, rotation, translation, evidence, colors, agreement, moment, color, maps):
    """Each vertex that a depth map sees from its outer side and near its surface gets the map's vote."""
    seen = np.zeros(6)
    for n in range(vertices.shape[0]):
        x = rotation @ vertices[n] + translation
        if x[2] <= 0 or not observe(evidence, x[0], x[1], x[2], seen):
            continue
        distance = seen[0]
        normal = rotation @ normals[n]
        facing = normal[0] * seen[2] + normal[1] * seen[3] + normal[2] * seen[4]
        if abs(distance) >= agreement or facing < 0.3:
            continue
        closeness = 1 - (distance / agreement) ** 2
        weight = seen[1] * closeness * closeness
        moment[n, 0] += weight
        # The surface lies a distance below the point: move against the normal where the point is outside.
        moment[n, 1] -= weight * distance / facing
        pixel = int(seen[5])
        for channel in range(3):
            color[n, channel] += weight * colors[pixel, channel]
        maps[n] += 1
