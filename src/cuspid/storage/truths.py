"""What only the simulator knows of a capture; reconstruction never reads it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from cuspid.model.jaw import GUM
from cuspid.model.trueness import GroundTruth
from cuspid.storage.files import write_json
from cuspid.storage.handpieces import read_handpiece, write_handpiece
from cuspid.storage.jaws import read_jaw, write_jaw
from cuspid.storage.reconstructions import read_poses, write_poses


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


def write_path(
    path: Path, min_overlap: float, mean_overlap: float, seen: Mapping[int, float], cross_sweep: Sequence[str] = ()
) -> None:
    """Write what is known of a path before anything is rendered.

    ``seen`` is about the share of each crown that two cameras see at once, by FDI number; 0 stands for all crowns.
    ``cross_sweep`` names the frames of the sweep from one side of the arch to the other.
    """
    shares = {"all" if tooth == GUM else str(tooth): share for tooth, share in seen.items()}
    overlaps = {"minimum_overlap": min_overlap, "mean_overlap": mean_overlap}
    write_json(path, {**overlaps, "crowns_seen": shares, "cross_sweep_frames": list(cross_sweep)})
