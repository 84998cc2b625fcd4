"""Draw the pipeline on one scan: images, poses, depth, mesh, deviation (docs/images/pipeline.png).

cuspid run --tooth 46 --out scan
python benchmarks/pipeline_picture.py scan docs/images/pipeline.png
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes

from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.report.figures.drawing import look, new_figure, render, save_figure
from cuspid.storage.reconstructions import read_depth_maps, read_reconstruction
from cuspid.storage.results import ScanResult

VIEW = look(-60.0, 40.0)
GREY = (214, 208, 198)
SIDE_PX = 520


def draw(scan: Path, out: Path) -> None:
    """The picture of a folder of ``cuspid run``."""
    read = storage.read_result(scan)
    if not isinstance(read, ScanResult) or read.reference_from_scan is None:
        raise SystemExit(f"{scan}: no scan that was evaluated")
    capture, found = storage.read_capture(scan / "capture"), read_reconstruction(scan / "motion")
    mesh = storage.read_mesh(scan / "mesh.ply").transformed(read.reference_from_scan)
    deviation = storage.read_mesh(scan / "deviation.ply").transformed(read.reference_from_scan)
    files = sorted((scan / "depth").glob("*.npz"))
    file = files[len(files) // 2]
    frame = next(each for each in capture.frames if each.name == file.stem)
    depth = max(read_depth_maps(file), key=lambda each: np.isfinite(each.depth_mm).sum())

    figure = new_figure(15.0, 3.5, dpi=90)
    titles = ("images", "poses", "depth", "mesh in mm", "deviation in µm")
    panels = [figure.add_axes((0.005 + 0.2 * k, 0.02, 0.19, 0.84)) for k in range(5)]
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title, fontsize=15, color="#333333", pad=8)
        axes.axis("off")
    panels[0].imshow(_mosaic([capture.image(frame, name) for name in frame.cameras[:4]]))
    first = next(iter(capture.handpiece.rig.cameras.values()))
    cam_from_world = [first.cam_from_rig @ pose for pose in found.rig_from_world.values()]
    _draw_poses(panels[1], mesh, [read.reference_from_scan @ pose.inverse() for pose in cam_from_world])
    panels[2].imshow(np.ma.masked_invalid(np.where(depth.depth_mm > 0, depth.depth_mm, np.nan)), cmap="viridis_r")
    panels[3].imshow(_shaded(replace(mesh, colors=np.full((len(mesh.vertices), 3), GREY, dtype=np.uint8))))
    panels[4].imshow(_shaded(deviation))
    save_figure(figure, out)


def _mosaic(images: list[np.ndarray]) -> np.ndarray:
    small = [cv2.resize(each, (SIDE_PX // 2, SIDE_PX // 2), interpolation=cv2.INTER_AREA) for each in images]
    return np.vstack([np.hstack(small[:2]), np.hstack(small[2:])])


def _shaded(mesh: Mesh) -> np.ndarray:
    return render(mesh, VIEW, width_px=SIDE_PX).image


def _draw_poses(axes: Axes, mesh: Mesh, reference_from_cam: list[Rigid3]) -> None:
    points = mesh.vertices[:: max(len(mesh.vertices) // 4000, 1)] @ VIEW.T
    axes.scatter(points[:, 0], points[:, 1], s=0.6, color="#b9b2a6", linewidths=0)
    centres = np.stack([pose.translation for pose in reference_from_cam]) @ VIEW.T
    ahead = np.stack([pose.matrix[:3, 2] for pose in reference_from_cam]) @ VIEW.T
    axes.plot(centres[:, 0], centres[:, 1], "-o", color="#0b6e78", markersize=4, linewidth=1)
    for centre, direction in zip(centres, ahead, strict=True):
        end = centre + 1.5 * direction
        axes.plot([centre[0], end[0]], [centre[1], end[1]], color="#d1603d", linewidth=1)
    axes.set_aspect("equal")


def main() -> None:
    """Draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", type=Path)
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    draw(given.scan, given.out)


if __name__ == "__main__":
    main()
