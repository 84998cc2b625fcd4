"""OpenCV's Stitcher on the frames of a capture, as a program of its own so that its time and memory can be measured.

python benchmarks/opencv_stitcher.py CAPTURE --mode panorama|scans --out FOLDER [--cpu-s 600]

Writes panorama.png (RGBA) and result.json: the status, and which frames OpenCV placed. It says nothing of where a pixel
came from.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from pathlib import Path

import cv2
import numpy as np

MODES = {"panorama": cv2.Stitcher_PANORAMA, "scans": cv2.Stitcher_SCANS}
STATUS = {0: "ok", 1: "needs more images", 2: "homography not found", 3: "camera parameters not found"}


def stitch(capture: Path, mode: str, out: Path) -> dict[str, object]:
    """Stitch and write; the result, where it has no picture with the reason."""
    files = sorted((capture / "images").glob("*/*.png"))
    images = [cv2.imread(str(file)) for file in files]
    stitcher = cv2.Stitcher.create(MODES[mode])
    try:
        status, picture = stitcher.stitch(images)
    except cv2.error as error:
        return {"status": f"error: {error.err}", "frames": len(files), "placed": []}
    result = {"status": STATUS.get(status, str(status)), "frames": len(files), "placed": []}
    if status == 0:
        alpha = np.where(picture.max(axis=2) > 0, 255, 0).astype(np.uint8)
        cv2.imwrite(str(out / "panorama.png"), np.dstack([picture, alpha]))
        result |= {
            "placed": [files[int(index)].stem for index in stitcher.component()],
            "size_px": picture.shape[1::-1],
        }
    return result


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--mode", choices=MODES, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cpu-s", type=int, default=600, help="give up after so many seconds of CPU time")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    resource.setrlimit(resource.RLIMIT_CPU, (options.cpu_s, options.cpu_s + 5))
    result = stitch(options.capture, options.mode, options.out)
    (options.out / "result.json").write_text(json.dumps(result) + "\n")
    print(options.mode, result["status"], len(list(result["placed"])), file=sys.stderr)  # type: ignore[call-overload]


if __name__ == "__main__":
    main()
