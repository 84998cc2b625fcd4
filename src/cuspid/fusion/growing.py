"""A surface that grows while frames come in, part by part, and from which a frame can be taken out again.

It is the zero level of the same sparse volume as that of :mod:`cuspid.fusion.depth_fusion`, without the second pass:
its vertices are not moved to the mean of the depth maps, and what only one of them saw is shown.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial import cKDTree

from cuspid.fusion.cleaning import hole_rims
from cuspid.fusion.depth_fusion import FusionOptions
from cuspid.fusion.evidence import Evidence, colors_of
from cuspid.fusion.meshing import extract, extract_parts, part_of
from cuspid.fusion.volume import BLOCK, SparseVolume, find, neighbour_keys, pack
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import DepthMap

_GREY = 128
_MANY = 100
"""Frames that a surface is expected to get."""


class GrowingSurface:
    """Accumulates the depth maps of located frames; needs memory for the surface alone."""

    def __init__(self, detail_mm: float, options: FusionOptions | None = None) -> None:
        """``detail_mm`` is the detail that the handpiece shows, the unit of lengths."""
        options = options or FusionOptions()
        voxel_mm = options.voxel_for(detail_mm)
        self._volume = SparseVolume(voxel_mm, options.truncation_voxels * voxel_mm)
        self._jump_mm, self._least_weight = options.max_jump * detail_mm, options.least_weight_for(_MANY)
        self._colors = np.zeros((0, BLOCK**3, 4), dtype=np.float32)
        self._changed = set[int]()

    def add(self, depth_maps: Iterable[DepthMap], rig_from_world: Rigid3) -> None:
        """Blend in the depth maps of a frame."""
        for depth_map in depth_maps:
            self._blend(depth_map, rig_from_world, take_out=False)

    def take_out(self, depth_maps: Iterable[DepthMap], rig_from_world: Rigid3) -> None:
        """Undo :meth:`add` with the same arguments."""
        for depth_map in depth_maps:
            self._blend(depth_map, rig_from_world, take_out=True)

    def pop_changes(self) -> dict[int, Mesh]:
        """The parts of the coloured surface that changed since this was last asked for, by their keys, as they are now;
        parts are cubes of some blocks of voxels, and each has vertices of its own."""
        touched = np.array(sorted(self._changed), dtype=np.int64)
        self._changed.clear()
        parts = np.unique(part_of(neighbour_keys(touched))).tolist() if len(touched) else []
        found = extract_parts(self._volume, self._least_weight, parts)
        return {key: replace(mesh, colors=self._colors_at(mesh.vertices)) for key, mesh in found.items()}

    def hole_rims(self) -> Float[np.ndarray, "n 3"]:
        """Places (mm) on the rims of the holes that are there now."""
        mesh = extract(self._volume, self._least_weight)
        return mesh.vertices[hole_rims(mesh)] if len(mesh.faces) else np.zeros((0, 3))

    def _blend(self, depth_map: DepthMap, rig_from_world: Rigid3, *, take_out: bool) -> None:
        evidence = Evidence.of(depth_map, self._jump_mm)
        in_rig, pixel = depth_map.points_in_rig()
        points, cam_from_world = rig_from_world.inverse().apply(in_rig), depth_map.cam_from_rig @ rig_from_world
        update = self._volume.prepare_update(evidence, cam_from_world, points)
        self._volume.integrate([update], take_out=take_out)
        self._changed.update(update.keys.tolist())
        self._paint(points, colors_of(depth_map)[pixel], -1.0 if take_out else 1.0)

    def _paint(self, points: Float[np.ndarray, "n 3"], rgb: UInt8[np.ndarray, "n 3"], sign: float) -> None:
        """Add the colours of points to their voxels."""
        keys = self._volume.keys
        if len(keys) > len(self._colors):
            grown = np.zeros((int(1.5 * len(keys)) + 1024, *self._colors.shape[1:]), dtype=np.float32)
            grown[: len(self._colors)] = self._colors
            self._colors = grown
        slot, voxel = self._voxels(np.rint(points / self._volume.voxel_mm).astype(np.int64), keys)
        there = slot >= 0
        painted = sign * np.column_stack([rgb, np.ones(len(rgb))])[there]
        np.add.at(self._colors, (slot[there], voxel[there]), painted.astype(np.float32))

    def _colors_at(self, vertices: Float[np.ndarray, "v 3"]) -> UInt8[np.ndarray, "v 3"]:
        """Mean of what was painted about each vertex; where nothing was, that of the nearest where something was."""
        keys = self._volume.keys
        lowest = np.floor(vertices / self._volume.voxel_mm).astype(np.int64)
        total = np.zeros((len(vertices), 4))
        for corner in np.ndindex(2, 2, 2):
            slot, voxel = self._voxels(lowest + corner, keys)
            total += np.where((slot >= 0)[:, None], self._colors[slot, voxel], 0)
        painted = np.flatnonzero(total[:, 3] > 0.5)
        if len(painted) == 0:
            return np.full((len(vertices), 3), _GREY, dtype=np.uint8)
        nearest = painted[cKDTree(vertices[painted]).query(vertices)[1]]
        return np.rint(total[nearest, :3] / total[nearest, 3:]).clip(0, 255).astype(np.uint8)

    @staticmethod
    def _voxels(
        grid: Int[np.ndarray, "n 3"], keys: Int[np.ndarray, "b"]
    ) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Slot of the block (-1: none) and index in it of voxels."""
        within = grid % BLOCK
        return find(keys, pack(grid // BLOCK)), (within[:, 0] * BLOCK + within[:, 1]) * BLOCK + within[:, 2]
