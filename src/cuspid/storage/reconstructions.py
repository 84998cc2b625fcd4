"""Reconstructions and depth maps."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cuspid.geometry import Rigid3
from cuspid.model.capture import Dropped
from cuspid.model.reconstruction import DepthMap, Expectation, Funnel, Reconstruction, Refinement, SurfacePoints, Tracks
from cuspid.model.rig import Handpiece
from cuspid.runtime.values import checked_name, quote
from cuspid.storage.files import as_declared, read_arrays, read_json, reading, to_plain, write_arrays, write_json
from cuspid.storage.handpieces import (
    camera_from_json,
    camera_to_json,
    read_handpiece,
    rigid_from_json,
    rigid_to_json,
    write_handpiece,
)


def write_poses(path: Path, rig_from_world: Mapping[str, Rigid3]) -> None:
    """Write ``rig_from_world`` for each frame."""
    write_json(path, {name: rigid_to_json(pose) for name, pose in rig_from_world.items()})


def read_poses(path: Path) -> dict[str, Rigid3]:
    """Read what :func:`write_poses` wrote."""
    value = read_json(path)
    with reading(path):
        return {
            checked_name(f"{path}: frames", key): rigid_from_json(pose, f"{path}: frame {quote(key)}")
            for key, pose in value.items()
        }


RECONSTRUCTION_FILES = ("poses.json", "handpiece.json", "tracks.npz", "expectation.npz", "reconstruction.json")
"""What :func:`write_reconstruction` writes."""


def write_reconstruction(folder: Path, reconstruction: Reconstruction, handpiece: Handpiece) -> None:
    """Write poses, refined handpiece, tracks and what was dropped; last of all ``reconstruction.json``."""
    write_poses(folder / "poses.json", reconstruction.rig_from_world)
    if reconstruction.tracks is not None:
        write_arrays(folder / "tracks.npz", {name: getattr(reconstruction.tracks, name) for name in _TRACKS})
    if reconstruction.expectation is not None:
        arrays = {name: getattr(reconstruction.expectation, name) for name in _EXPECTED}
        write_arrays(folder / "expectation.npz", {name: np.asarray(each) for name, each in arrays.items()})
    write_handpiece(folder / "handpiece.json", dataclasses.replace(handpiece, rig=reconstruction.rig))
    write_json(
        folder / "reconstruction.json",
        {
            "scale": "known" if reconstruction.has_scale else "unknown",
            "frames_located": len(reconstruction.rig_from_world),
            "frames_dropped": reconstruction.dropped,
            "points": 0 if reconstruction.tracks is None else len(reconstruction.tracks.points),
            "reprojection_rms_px": reconstruction.reprojection_rms_px,
            "refinement": reconstruction.refinement,
            "expected": None if reconstruction.expectation is None else _expected_numbers(reconstruction.expectation),
            "notes": reconstruction.notes,
            "log": reconstruction.log,
            "pose_covariance_rotation_rad_translation_mm": reconstruction.pose_covariance,
        },
    )


def read_reconstruction(folder: Path) -> Reconstruction:
    """Read what :func:`write_reconstruction` wrote. Raises InputError where it is missing or broken."""
    path, tracks = folder / "reconstruction.json", folder / "tracks.npz"
    value = read_json(path)
    with reading(path):
        covariance = value["pose_covariance_rotation_rad_translation_mm"]
        return as_declared(
            Reconstruction,
            rig=read_handpiece(folder / "handpiece.json").rig,
            rig_from_world=read_poses(folder / "poses.json"),
            refinement=None if (moved := value.get("refinement")) is None else as_declared(Refinement, **moved),
            expectation=None if value.get("expected") is None else _read_expectation(folder / "expectation.npz"),
            tracks=_read_tracks(tracks) if value["points"] else None,
            dropped=tuple(as_declared(Dropped, **entry) for entry in value["frames_dropped"]),
            pose_covariance=None if covariance is None else np.array(covariance, dtype=np.float64),
            reprojection_rms_px=value["reprojection_rms_px"],
            has_scale=value.get("scale") != "unknown",
            log=value["log"],
            notes=tuple(value.get("notes", ())),
        )


_TRACKS = [field.name for field in dataclasses.fields(Tracks)]


_EXPECTED = [field.name for field in dataclasses.fields(Expectation)]


def _expected_numbers(expected: Expectation) -> dict[str, float]:
    return {name: value for name in _EXPECTED if isinstance(value := getattr(expected, name), float)}


def _read_expectation(path: Path) -> Expectation:
    arrays = read_arrays(path, remedy="delete the folder and locate the frames again")
    with reading(path):
        values = {name: arrays[name] for name in _EXPECTED}
        return as_declared(Expectation, **{name: each if each.ndim else each.item() for name, each in values.items()})


def _read_tracks(path: Path) -> Tracks:
    arrays = read_arrays(path, remedy="delete the folder and locate the frames again")
    with reading(path):
        return as_declared(Tracks, **{name: arrays[name] for name in _TRACKS})


_MADE_ANEW = "run the same command again to recreate it"


def write_depth_maps(path: Path, depth_maps: Sequence[DepthMap]) -> None:
    """Write the depth maps of one frame as one ``.npz``."""
    arrays: dict[str, np.ndarray] = {}
    for index, depth in enumerate(depth_maps):
        arrays[f"{index}.depth_mm"] = depth.depth_mm
        arrays[f"{index}.confidence"] = depth.confidence.astype(np.float16)
        if depth.color is not None:
            arrays[f"{index}.color"] = depth.color
    header = [
        {
            "frame": depth.frame,
            "camera_name": depth.camera_name,
            "camera": camera_to_json(depth.camera),
            "cam_from_rig": depth.cam_from_rig.matrix,
            "funnel": depth.funnel,
            "best_mm": depth.best_mm,
        }
        for depth in depth_maps
    ]
    arrays["header"] = np.frombuffer(json.dumps(to_plain(header)).encode(), dtype=np.uint8)
    write_arrays(path, arrays)


def read_depth_maps(path: Path) -> tuple[DepthMap, ...]:
    """Read what :func:`write_depth_maps` wrote. Raises InputError."""
    arrays = read_arrays(path, remedy=_MADE_ANEW)
    with reading(path):
        header = json.loads(arrays["header"].tobytes())
        return tuple(
            as_declared(
                DepthMap,
                frame=entry["frame"],
                camera_name=entry["camera_name"],
                camera=camera_from_json(entry["camera"]),
                cam_from_rig=Rigid3.from_matrix(np.array(entry["cam_from_rig"])),
                depth_mm=arrays[f"{index}.depth_mm"],
                confidence=arrays[f"{index}.confidence"].astype(np.float32),
                color=arrays[f"{index}.color"] if f"{index}.color" in arrays else None,
                funnel=None if entry.get("funnel") is None else as_declared(Funnel, **entry["funnel"]),
                best_mm=entry.get("best_mm"),
            )
            for index, entry in enumerate(header)
        )


def write_surface_points(path: Path, places: SurfacePoints) -> None:
    """Write points of a surface as ``.npz``."""
    write_arrays(path, {"points": places.points, "normals": places.normals})


def read_surface_points(path: Path) -> SurfacePoints:
    """Read what :func:`write_surface_points` wrote. Raises InputError."""
    arrays = read_arrays(path, remedy=_MADE_ANEW)
    with reading(path):
        return as_declared(SurfacePoints, points=arrays["points"], normals=arrays["normals"])
