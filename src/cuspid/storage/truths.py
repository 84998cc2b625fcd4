"""What only the simulator knows of a capture; reconstruction never reads it."""

from __future__ import annotations

from pathlib import Path

from cuspid.storage.files import write_json
from cuspid.storage.handpieces import read_handpiece, write_handpiece
from cuspid.storage.jaws import read_jaw, write_jaw
from cuspid.storage.reconstructions import read_poses, write_poses
from cuspid.trueness import GroundTruth


def write_truth(folder: Path, truth: GroundTruth) -> None:
    """Write what only the simulator knows: ``jaw.ply``, ``handpiece.json``, ``poses.json``."""
    write_jaw(folder / "jaw.ply", truth.jaw)
    write_handpiece(folder / "handpiece.json", truth.handpiece)
    write_poses(folder / "poses.json", truth.rig_from_world)


def read_truth(folder: Path) -> GroundTruth:
    """Read what :func:`write_truth` wrote."""
    return GroundTruth(
        jaw=read_jaw(folder / "jaw.ply"),
        handpiece=read_handpiece(folder / "handpiece.json"),
        rig_from_world=read_poses(folder / "poses.json"),
    )


def write_overlap(path: Path, minimum: float, mean: float) -> None:
    """Write the share of the surface in an image that the same camera's next image also sees."""
    write_json(path, {"minimum_overlap": minimum, "mean_overlap": mean})
