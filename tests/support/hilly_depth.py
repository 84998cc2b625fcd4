"""Noisy depth maps of a rig that moves over hills."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.ndimage import gaussian_filter

from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import DepthMap
from cuspid.motion.icp.surface_tracking import SurfaceTrackingOptions
from cuspid.motion.icp.surfaces import Surface, surface_of
from cuspid.mvs.matching import coarser
from plain_scene import SIZE_PX
from synthetic_scene import cast_depth, diamond, height_field

HILLS = height_field(
    lambda x, y: 5 + 0.5 * np.sin(1.8 * x) * np.cos(1.5 * y + 0.3 * x) + 0.3 * np.sin(0.7 * x + 0.13 * x * x - y),
    half_width_mm=14.0,
)
STEP = np.array([0.008, -0.01, 0.012]), np.array([-0.6, 0.1, 0.03])
OUT = {f"{k:05d}": Rigid3.from_rotation_vector(STEP[0] * k, STEP[1] * k) for k in range(6)}
NOISE_MM = 0.015


def depth_maps(
    way: Mapping[str, Rigid3], mesh: Mesh = HILLS, noise_mm: float = NOISE_MM, seed: int = 0, wide_px: float = 0.0
) -> list[DepthMap]:
    """With errors that hang together over ``wide_px`` pixels."""
    rng, made = np.random.default_rng(seed), []
    for frame, pose in way.items():
        for name, mounted in diamond(SIZE_PX).rig.cameras.items():
            grid = coarser(mounted.camera, 2)
            noise = gaussian_filter(rng.normal(0, 1, (80, 80)), wide_px)
            depth = cast_depth(mesh, grid, mounted.cam_from_rig @ pose) + noise_mm * noise / noise.std()
            known = np.isfinite(depth).astype(np.float32)
            made.append(
                DepthMap(
                    frame=frame,
                    camera_name=name,
                    camera=grid,
                    cam_from_rig=mounted.cam_from_rig,
                    depth_mm=depth.astype(np.float32),
                    confidence=known,
                )
            )
    return made


def surface(
    maps: Sequence[DepthMap], frame: str = "00000", border_px: int = SurfaceTrackingOptions().border_px
) -> Surface:
    thinning = SurfaceTrackingOptions().thinning
    return surface_of([each for each in maps if each.frame == frame], 5.0, thinning=thinning, border_px=border_px)
