"""Measure rectified pairs of photographs whose disparity is known, by cuspid's stereo and by OpenCV's matcher.

    python benchmarks/stereo_pairs.py FOLDER [--pictures FOLDER]

Each folder in FOLDER is a pair: ``left.*`` and ``right.*``, images that OpenCV reads, and ``disparity.npy``, px of the
left image, not finite where unknown. Nothing else is known of the cameras: the pair is given to :class:`DepthEstimator`
as a handpiece whose working distance is that of the middle disparity.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from cuspid.camera import Camera
from cuspid.geometry import Rigid3
from cuspid.rig import Handpiece, MountedCamera, Rig
from cuspid.stereo import DepthEstimator, StereoOptions

Image = UInt8[np.ndarray, "h w 3"]
Disparity = Float[np.ndarray, "h w"]
BASELINE_MM = 100.0


def handpiece(image: Image, lowest_px: float, highest_px: float) -> Handpiece:
    """Two cameras that could have taken the pair."""
    height, width = image.shape[:2]
    camera = Camera.from_field_of_view(width, height, 60.0)
    right = Rigid3(np.eye(3), np.array([-BASELINE_MM, 0.0, 0.0]))
    far, near = (float(camera.focal_px[0]) * BASELINE_MM / disparity for disparity in (lowest_px, highest_px))
    return Handpiece(
        rig=Rig({"left": MountedCamera(camera, Rigid3.identity()), "right": MountedCamera(camera, right)}),
        working_distance_mm=float(np.sqrt(near * far)),
        depth_range_mm=(near, far),
    )


def cuspid(left: Image, right: Image, lowest_px: float, highest_px: float) -> Disparity:
    """Disparity of the left image from its depth."""
    pair = handpiece(left, lowest_px, highest_px)
    found = DepthEstimator(pair, StereoOptions(spacing_px=1)).measure({"left": left, "right": right}, "pair")
    return pair.rig["left"].camera.focal_px[0] * BASELINE_MM / found[0].depth_mm


def sgbm(left: Image, right: Image, lowest_px: float, highest_px: float) -> Disparity:
    """OpenCV's semi-global matching with the penalties of its documentation."""
    lowest, block = int(lowest_px), 5
    matcher = cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=16 * int(np.ceil((highest_px - lowest + 1) / 16)),
        blockSize=block,
        P1=8 * 3 * block**2,
        P2=32 * 3 * block**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
    )
    disparity = matcher.compute(left, right).astype(np.float32) / 16
    return np.where(disparity >= lowest, disparity, np.nan)


METHODS: dict[str, Callable[[Image, Image, float, float], Disparity]] = {"cuspid": cuspid, "SGBM": sgbm}


def row(folder: Path, method: str, pictures: Path | None) -> str:
    """Line of the table: pixels with depth, median error, gross errors, CPU seconds."""
    left, right = (
        cv2.cvtColor(cv2.imread(str(next(folder.glob(f"{side}.*")))), cv2.COLOR_BGR2RGB) for side in ("left", "right")
    )
    truth = np.load(folder / "disparity.npy")
    known = np.isfinite(truth)
    lowest, highest = np.quantile(truth[known], [0.001, 0.999]) + [-2, 2]
    start = time.process_time()
    found = METHODS[method](left, right, max(float(lowest), 1.0), float(highest))
    seconds = time.process_time() - start
    error = np.abs(found - truth)
    both = known & np.isfinite(found)
    if pictures is not None:
        _draw(pictures / f"{folder.name}-{method}.png", found, error, (lowest, highest))
    return (
        f"| {folder.name} | {method} | {100 * both.sum() / known.sum():.1f} | {np.median(error[both]):.3f} | "
        f"{100 * np.mean(error[both] > 1):.1f} | {seconds:.1f} |"
    )


def _draw(path: Path, found: Disparity, error: Disparity, limits: tuple[float, float]) -> None:
    """Disparity beside its error (white: 1 px and more; blue: nothing found)."""
    shown = [(found - limits[0]) / (limits[1] - limits[0]), error]
    levels = [(255 * np.nan_to_num(each).clip(0, 1)).astype(np.uint8) for each in shown]
    coloured = [cv2.applyColorMap(levels[0], cv2.COLORMAP_TURBO), cv2.cvtColor(levels[1], cv2.COLOR_GRAY2BGR)]
    for image in coloured:
        image[~np.isfinite(found)] = (120, 0, 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.hstack(coloured))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pictures", type=Path, help="where pictures of disparity and error go")
    arguments = parser.parse_args()
    print("| pair | method | with depth, % | median error, px | off by more than 1 px, % | CPU s |")
    print("|---|---|---|---|---|---|")
    for folder in sorted(arguments.folder.iterdir()):
        for method in METHODS:
            print(row(folder, method, arguments.pictures), flush=True)


if __name__ == "__main__":
    main()
