"""Measure rectified pairs of photographs whose disparity is known, by cuspid's stereo and by OpenCV's matcher.

    python benchmarks/stereo_pairs.py FOLDER [--pictures FOLDER] [--out benchmarks/results/stereo_pairs.json]

Each folder in FOLDER is a pair: ``left.*`` and ``right.*``, images that OpenCV reads, and ``disparity.npy``, px of the
left image, not finite where unknown. Nothing else is known of the cameras: the pair is given to :class:`DepthEstimator`
as a handpiece whose working distance is that of the middle disparity. Densities are of all pixels whose disparity is
known, and, as Middlebury's tables have them, of those of them that both cameras see.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from run import conditions

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.mvs import DepthEstimator, StereoOptions
from cuspid.storage import write_json

Image = UInt8[np.ndarray, "h w 3"]
Disparity = Float[np.ndarray, "h w"]
HERE = Path(__file__).parent
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


def seen_by_both(truth: Disparity) -> Bool[np.ndarray, "h w"]:
    """Pixels of the left image whose place in the right one lies within it, and nothing nearer comes to the same."""
    row, left = np.nonzero(np.isfinite(truth))
    right = np.rint(left - truth[row, left]).astype(int)
    row, left, right = row[right >= 0], left[right >= 0], right[right >= 0]
    nearest = np.full(truth.shape, -np.inf)
    np.maximum.at(nearest, (row, right), truth[row, left])
    seen = np.zeros(truth.shape, bool)
    seen[row, left] = truth[row, left] >= nearest[row, right] - 1.0
    return seen


def measured(folder: Path, method: str, pictures: Path | None) -> dict[str, float]:
    """Pixels with depth, median error, gross errors, CPU seconds."""
    left, right = (
        cv2.cvtColor(cv2.imread(str(next(folder.glob(f"{side}.*")))), cv2.COLOR_BGR2RGB) for side in ("left", "right")
    )
    truth = np.load(folder / "disparity.npy")
    known, both = np.isfinite(truth), seen_by_both(truth)
    lowest, highest = np.quantile(truth[known], [0.001, 0.999]) + [-2, 2]
    start = time.process_time()
    disparity = METHODS[method](left, right, max(float(lowest), 1.0), float(highest))
    seconds = time.process_time() - start
    found, error = np.isfinite(disparity), np.abs(disparity - truth)
    if pictures is not None:
        _draw(pictures / f"{folder.name}-{method}.png", disparity, error, (lowest, highest))
    return {
        "density_pct": 100 * float(np.mean(found[known])),
        "density_of_seen_by_both_pct": 100 * float(np.mean(found[both])),
        "median_px": float(np.median(error[found & known])),
        "above_1_px_pct": 100 * float(np.mean(error[found & known] > 1)),
        "cpu_s": seconds,
    }


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
    """Measure all pairs by all methods."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pictures", type=Path, help="where pictures of disparity and error go")
    parser.add_argument("--out", type=Path, default=HERE / "results" / "stereo_pairs.json")
    arguments = parser.parse_args()
    folders = sorted(each for each in arguments.folder.iterdir() if each.is_dir())
    for method in METHODS:
        measured(folders[0], method, None)  # compiles
    pairs = {
        folder.name: {method: measured(folder, method, arguments.pictures) for method in METHODS} for folder in folders
    }
    write_json(arguments.out, {"pairs": pairs, **conditions()})


if __name__ == "__main__":
    main()
