"""A sparse grid of signed distances: blocks of 8 x 8 x 8 voxels, allocated only around measured points.

Frames: ``world`` (mm), ``grid`` (world divided by the voxel size; voxel (i, j, k) lies at the integer point), ``block``
(grid divided by 8). Distances are positive outside, on the side of the cameras. A block is found by its packed integer
key in a sorted array; ``neighbours`` holds the slot of each of the 27 blocks around a block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int

from cuspid.fusion.evidence import Evidence, observe, observe_foot
from cuspid.geometry import Rigid3
from cuspid.runtime.kernels import kernel
from cuspid.runtime.workers import run_in_shares

BLOCK = 8
"""Voxels along the side of a block."""

_NOTHING = 1e-4
"""Weight, as a share of that of what was taken out, below which nothing but rounding is left."""
_OFFSET = 1 << 20
"""Added to block coordinates so that packed keys are positive: room for a million blocks in each direction."""
_MASK = (1 << 21) - 1
"""The bits of a coordinate in a packed key."""


def pack(blocks: Int[np.ndarray, "*n 3"]) -> Int[np.ndarray, "*n"]:
    """One integer key for each triple of block coordinates."""
    shifted = blocks.astype(np.int64) + _OFFSET
    return (shifted[..., 0] << 42) | (shifted[..., 1] << 21) | shifted[..., 2]


def unpack(keys: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n 3"]:
    """Inverse of :func:`pack`."""
    return np.stack([keys >> 42, (keys >> 21) & _MASK, keys & _MASK], axis=-1) - _OFFSET


class VolumeUpdate(NamedTuple):
    """A depth map, and the blocks of the volume that it reaches, for a kernel."""

    evidence: Evidence
    """What it says."""
    rotation: Float[np.ndarray, "3 3"]
    """Of ``cam_from_world``, as ``translation``."""
    translation: Float[np.ndarray, "3"]
    keys: Int[np.ndarray, "b"]
    """Keys of the blocks around its points, sorted."""
    nearest: Int[np.ndarray, "h w"]
    """As :meth:`Evidence.nearest` within the truncation distance."""


class _Volume(NamedTuple):
    """A :class:`SparseVolume` for a kernel, and how depth maps are blended into it."""

    distance: np.ndarray
    weight: np.ndarray
    voxel: float
    truncation: float
    sign: float
    """-1 to take them out again."""


@dataclass
class SparseVolume:
    """Signed distances and weights, growing as depth maps come in. Not frozen: it is an accumulator."""

    voxel_mm: float
    """Spacing of the voxels."""
    truncation_mm: float
    """Distances are clipped at this value, and voxels farther behind a surface are not affected by it."""

    def __post_init__(self) -> None:
        self._slot_of_key: dict[int, int] = {}
        self.distance = np.zeros((0, BLOCK**3), dtype=np.float32)
        self.weight = np.zeros((0, BLOCK**3), dtype=np.float32)

    @property
    def keys(self) -> Int[np.ndarray, "b"]:
        """Packed coordinates of the blocks in order of their slots."""
        return np.fromiter(self._slot_of_key, dtype=np.int64, count=len(self._slot_of_key))

    def prepare_update(
        self, evidence: Evidence, cam_from_world: Rigid3, points: Float[np.ndarray, "n 3"]
    ) -> VolumeUpdate:
        """The blocks that a depth map with these points (world, mm) will change, whatever was blended before."""
        nearest = evidence.nearest(self._reach_px(evidence, cam_from_world, points))
        keys = self._keys_around(points)
        return VolumeUpdate(evidence, cam_from_world.rotation, cam_from_world.translation, keys, nearest)

    def integrate(self, maps: Sequence[VolumeUpdate], *, take_out: bool = False) -> None:
        """Blend depth maps into the volume, one after the other, or take out again what was blended so."""
        slots = [self._allocate(one.keys) for one in maps]
        sign = -1.0 if take_out else 1.0
        volume = _Volume(self.distance, self.weight, self.voxel_mm, self.truncation_mm, sign)

        def work(share: int, shares: int) -> None:
            for one, blocks in zip(maps, slots, strict=True):
                _integrate(one, blocks, volume, share, shares)

        run_in_shares(work)

    def _reach_px(self, evidence: Evidence, cam_from_world: Rigid3, points: Float[np.ndarray, "n 3"]) -> int:
        """How many pixels the truncation distance takes at most, seen from the camera."""
        if not len(points):
            return 0
        nearest_mm = float(cam_from_world.apply(points)[:, 2].min())
        return int(np.ceil(evidence.intrinsics[:2].max() * self.truncation_mm / max(nearest_mm, self.truncation_mm)))

    def _keys_around(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "b"]:
        """Blocks within the truncation distance of points, sorted."""
        side = self.voxel_mm * BLOCK
        coarse = np.unique(pack(np.floor(points * (4 / side)).astype(np.int64)))
        centres = (unpack(coarse) + 0.5) * (side / 4)
        reach = self.truncation_mm + side / 8
        corners = np.array(list(np.ndindex(2, 2, 2))) * 2 - 1
        near = [np.floor((centres + reach * corner) / side).astype(np.int64) for corner in corners]
        return np.unique(pack(np.concatenate(near)))

    def _allocate(self, keys: Int[np.ndarray, "b"]) -> Int[np.ndarray, "b"]:
        """Slots of blocks, made where they are new."""
        table = self._slot_of_key
        slots = np.array([table.setdefault(key, len(table)) for key in keys.tolist()], dtype=np.int64)
        if len(table) > len(self.distance):
            room = max(len(table), int(1.5 * len(self.distance)) + 1024)
            self.distance = _grow_array(self.distance, room)
            self.weight = _grow_array(self.weight, room)
        return slots


def neighbour_keys(keys: Int[np.ndarray, "b"]) -> Int[np.ndarray, "b 27"]:
    """Keys of the blocks at offsets (-1..1)^3 from each block."""
    return pack(unpack(keys)[:, None] + (np.array(list(np.ndindex(3, 3, 3))) - 1))


def find(keys: Int[np.ndarray, "b"], queries: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    """Where each of the wanted keys stands among others, -1 where it does not."""
    if len(keys) == 0:
        return np.full(queries.shape, -1)
    order = np.argsort(keys)
    ranked = keys[order]
    place = np.searchsorted(ranked, queries).clip(0, len(keys) - 1)
    return np.where(ranked[place] == queries, order[place], -1)


def _grow_array(array: Float[np.ndarray, "b v"], room: int) -> Float[np.ndarray, "r v"]:
    grown = np.zeros((room, array.shape[1]), dtype=array.dtype)
    grown[: len(array)] = array
    return grown


@kernel
@no_type_check
def _integrate(update, slots, volume, share, shares):
    """Running weighted mean of the signed distance in each voxel of a share of the blocks."""
    evidence, rotation, translation, keys, nearest = update
    distance, weight, voxel, truncation, sign = volume
    seen = np.zeros(6)
    for n in range(slots.size):
        if slots[n] % shares != share:
            continue
        values, weights = distance[slots[n]], weight[slots[n]]
        first, second, third = keys[n] >> 42, (keys[n] >> 21) & _MASK, keys[n] & _MASK  # as unpack
        for i in range(8):
            for j in range(8):
                for k in range(8):
                    x = ((first - _OFFSET) * BLOCK + i) * voxel
                    y = ((second - _OFFSET) * BLOCK + j) * voxel
                    z = ((third - _OFFSET) * BLOCK + k) * voxel
                    depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
                    if depth <= 0:
                        continue
                    right = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
                    down = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
                    if observe(evidence, right, down, depth, seen):
                        if seen[0] < -truncation:
                            continue
                    elif not observe_foot(evidence, nearest, truncation, right, down, depth, seen):
                        continue
                    voxel_index = (i * 8 + j) * 8 + k
                    new = sign * seen[1]
                    total = weights[voxel_index] + new
                    if total < _NOTHING * seen[1]:
                        values[voxel_index], weights[voxel_index] = 0, 0
                        continue
                    step = (min(seen[0], truncation) - values[voxel_index]) * new / total
                    values[voxel_index] += step
                    weights[voxel_index] = total
