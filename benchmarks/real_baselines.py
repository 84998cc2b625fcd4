"""What others make of the same photographs: OpenCV's StereoSGBM for pairs, fused as cuspid fuses, and COLMAP's mapper.

Each writes the files that ``cuspid reconstruct`` would write, as far as it has them, so that the same is measured.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float32, UInt8

from cuspid.fusion.depth_fusion import FusionOptions, fuse
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.pairing import detail_mm
from cuspid.model.reconstruction import DepthMap
from cuspid.model.rig import Rig
from cuspid.motion.colmap import quiet
from cuspid.mvs.rectification import RectifiedPair, rectify
from cuspid.storage import read_capture, write_mesh
from cuspid.storage.reconstructions import write_depth_maps

BLOCK_PX = 5
LEAST_DEG, MOST_DEG = 3.0, 40.0
"""Angle between the axes of a view and its partner: the smallest one in between is taken."""
FRAME = "0000"


def sgbm(given: Path, out: Path) -> dict[str, Any]:
    """Depth of every view with its nearest neighbour, at full size, and the mesh that these depths are fused to."""
    capture = read_capture(given)
    rig, begin = capture.handpiece.rig, time.process_time()
    maps = []
    for name in rig.names:
        other = partner(rig, name)
        if other is not None:
            maps.append(_pair_depth(capture, name, other))
    write_depth_maps(out / "depth" / f"{FRAME}.npz", maps)
    detail = detail_mm(capture.handpiece)
    options = FusionOptions(min_maps=min(2, len(maps) - 1)).resolve(detail, capture.handpiece.footprint_mm)
    fused = fuse(maps, {FRAME: Rigid3.identity()}, detail, options)
    if len(fused.mesh.faces):
        write_mesh(out / "mesh.ply", fused.mesh)
    return {"cpu_s": round(time.process_time() - begin, 1), "pairs": len(maps)}


def partner(rig: Rig, name: str) -> str | None:
    """The view that is nearest by angle, not so near that there is hardly a baseline (but for two cameras side by
    side)."""
    others = [other for other in rig.names if other != name]
    fair = [other for other in others if LEAST_DEG <= rig.angle_deg(name, other) <= MOST_DEG]
    return min(fair or others[: len(others) == 1], key=lambda other: rig.angle_deg(name, other), default=None)


def _pair_depth(capture: Capture, name: str, other: str) -> DepthMap:
    rig, frame = capture.handpiece.rig, capture.frames[0]
    pair = rectify((name, other), rig[name], rig[other], 1.0)
    images = [capture.image(frame, camera) for camera in (name, other)]
    first, second = (
        np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR)) for image, maps in zip(images, pair.maps, strict=True)
    )
    near, far = capture.handpiece.depth_range_mm
    disparity = matched(first, second, pair.disparity(far), pair.disparity(near))
    seen = cv2.remap(np.ones(images[0].shape[:2], np.uint8), *pair.maps[0], cv2.INTER_NEAREST) > 0
    return _as_depth(pair, np.where(seen, disparity, np.nan), first)


def matched(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"], lowest_px: float, highest_px: float
) -> Float32[np.ndarray, "h w"]:
    """Disparity by StereoSGBM with the penalties of its documentation and its own check from right to left; NaN where
    it has none. The right image is shifted by the lowest one, and both get a border, or the matcher would leave out
    columns for which the highest one does not lie in the image."""
    grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (left, right)]
    lowest = int(np.floor(lowest_px))
    count = 16 * int(np.ceil((highest_px - lowest + 1) / 16))
    width = grey[0].shape[1]
    shifted = np.zeros_like(grey[1])
    kept = max(width - lowest, 0)
    shifted[:, width - kept :] = grey[1][:, :kept]
    bordered = [cv2.copyMakeBorder(each, 0, 0, count, 0, cv2.BORDER_CONSTANT) for each in (grey[0], shifted)]
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=BLOCK_PX,
        P1=8 * BLOCK_PX**2,
        P2=32 * BLOCK_PX**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
    )
    found = matcher.compute(*bordered)[:, count:].astype(np.float32) / 16
    return np.where((found >= 0) & (grey[0] > 0), found + lowest, np.nan).astype(np.float32)


def _as_depth(
    pair: RectifiedPair, disparity: Float32[np.ndarray, "h w"], image: UInt8[np.ndarray, "h w 3"]
) -> DepthMap:
    """A depth map of the first virtual camera."""
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (pair.camera.focal_px[0] * pair.baseline_mm / disparity).astype(np.float32)
    depth[~np.isfinite(depth)] = np.nan
    return DepthMap(
        frame=FRAME,
        camera_name=pair.names[0],
        camera=pair.camera,
        cam_from_rig=pair.first_from_rig,
        depth_mm=depth,
        confidence=np.isfinite(depth).astype(np.float32),
        color=image,
    )


def colmap(given: Path, out: Path) -> dict[str, Any]:
    """COLMAP's features, exhaustive matching and mapper, by its defaults, with one camera for all photographs."""
    out.mkdir(parents=True, exist_ok=True)
    begin, database = time.process_time(), out / "database.db"
    one = pycolmap.CameraMode.SINGLE
    with quiet():
        pycolmap.extract_features(database, given, camera_mode=one, device=pycolmap.Device.cpu)
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
        models = pycolmap.incremental_mapping(database, given, out / "sparse")
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    figures: dict[str, Any] = {"cpu_s": round(time.process_time() - begin, 1), "models": len(models)}
    if best is None:
        return figures
    camera = next(iter(best.cameras.values()))
    return figures | {
        "reprojection_px": best.compute_mean_reprojection_error(),
        "camera": camera.model.name,
        "camera_parameters": list(camera.params),
    }


BASELINES: Mapping[str, Mapping[str, Callable[[Path, Path], dict[str, Any]]]] = {
    "opencas": {"SGBM": sgbm},
    "robovision": {"SGBM": sgbm},
    "dtu": {"SGBM": sgbm},
    "temple": {"SGBM": sgbm},
    "photographs": {"COLMAP": colmap},
}
"""By the kind of a set."""
