"""The poses of the handpiece, found once and kept on disk, or taken from a COLMAP model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Literal

from cuspid.model.capture import Capture
from cuspid.model.reconstruction import DepthMap, Reconstruction
from cuspid.motion.colmap import hash_model, locate_with_colmap, read_model, write_model
from cuspid.motion.icp.surface_tracking import SurfaceTrackingOptions, track_surfaces
from cuspid.motion.location import MotionOptions
from cuspid.motion.location import locate as locate_with_rig
from cuspid.runtime.progress import Progress, silent
from cuspid.storage.captures import hash_capture
from cuspid.storage.reconstructions import RECONSTRUCTION_FILES, read_reconstruction, write_reconstruction
from cuspid.storage.stages import Stage

MotionMethod = Literal["rig", "colmap", "colmap-rig"]


def locate(
    capture: Capture, folder: Path, options: MotionOptions, method: MotionMethod = "rig", *, progress: Progress = silent
) -> Reconstruction:
    """Metric poses of the frames, kept in ``folder`` together with a COLMAP model.

    ``method``: ``rig`` is cuspid's own; COLMAP's mapper without (``colmap``) or with the rig (``colmap-rig``).
    """

    def find() -> Reconstruction:
        if method == "rig":
            return locate_with_rig(capture, options, progress=progress, cache=folder / "cache")
        return locate_with_colmap(capture, folder / "colmap", with_rig=method == "colmap-rig")

    stage = Stage("motion", folder, {"method": method, "options": options if method == "rig" else None}, (__name__,))
    return _make_and_read(stage, capture, hash_capture(capture), find)


def locate_by_surfaces(
    capture: Capture,
    depths: Iterable[DepthMap],
    made_from: str,
    folder: Path,
    options: SurfaceTrackingOptions,
    *,
    progress: Progress = silent,
) -> Reconstruction:
    """As :func:`locate`, from the depth maps of the frames; ``made_from`` is their digest."""
    stage = Stage("motion", folder, {"method": "surfaces", "options": options}, (__name__,))
    inputs = {**hash_capture(capture), "depths": made_from}
    return _make_and_read(stage, capture, inputs, lambda: track_surfaces(capture, depths, options, progress=progress))


def take_poses(capture: Capture, model: Path, folder: Path) -> Reconstruction:
    """The poses of a COLMAP model of the capture, made metric by the rig and kept in ``folder``."""
    inputs = {**hash_capture(capture), "model": hash_model(model)}
    return _make_and_read(
        Stage("motion", folder, "from poses", (__name__,)), capture, inputs, lambda: read_model(model, capture)
    )


def _make_and_read(
    stage: Stage, capture: Capture, inputs: Mapping[str, str], find: Callable[[], Reconstruction]
) -> Reconstruction:
    def write() -> None:
        found = find()
        write_model(stage.folder / "sparse", found, capture)
        write_reconstruction(stage.folder, found, capture.handpiece)

    stage.make(inputs, [stage.folder / name for name in RECONSTRUCTION_FILES], write)
    return read_reconstruction(stage.folder)
