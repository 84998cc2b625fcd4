"""The pictures show the colours that their values ask for."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib.colors import to_rgb

from builders import sphere
from cuspid.report.figures.visibility import (
    COUNT_COLOURS,
    SURFACE_COLOURS,
    save_counts_picture,
    save_shares_picture,
    save_surfaces_picture,
)

MESH = sphere(10.0, 3)
RIGHT = MESH.face_centres[:, 0] > 0


def share_of_hue(path: Path, colour: str, columns: slice) -> float:
    """Share of the pixels of a picture that have about the hue of a colour and are no grey."""
    hsv = cv2.cvtColor(cv2.imread(str(path))[:, columns], cv2.COLOR_BGR2HSV).astype(int)
    wanted = cv2.cvtColor(np.float32([[to_rgb(colour)]]), cv2.COLOR_RGB2HSV)[0, 0, 0] / 2
    away = np.abs(hsv[..., 0] - wanted)
    return float(np.mean((np.minimum(away, 180 - away) < 5) & (hsv[..., 1] > 60)))


def halves(path: Path, colour: str) -> tuple[float, float]:
    """The share left and right of the middle of the occlusal view, which fills the left half of the picture."""
    width = cv2.imread(str(path)).shape[1]
    middle = round(0.26 * width)
    return share_of_hue(path, colour, slice(0, middle)), share_of_hue(path, colour, slice(middle, round(0.51 * width)))


def test_named_surfaces_have_their_colours_where_they_are(tmp_path: Path) -> None:
    save_surfaces_picture(tmp_path / "s.png", MESH, {"mesial": RIGHT, "buccal": ~RIGHT, "distal": RIGHT & ~RIGHT})
    left, right = halves(tmp_path / "s.png", SURFACE_COLOURS["mesial"])
    assert left < 0.02 < 0.2 < right
    left, right = halves(tmp_path / "s.png", SURFACE_COLOURS["buccal"])
    assert right < 0.02 < 0.2 < left
    assert share_of_hue(tmp_path / "s.png", SURFACE_COLOURS["distal"], slice(None)) == 0


def test_counts_above_the_last_colour_share_it(tmp_path: Path) -> None:
    save_counts_picture(tmp_path / "c.png", MESH, np.where(RIGHT, 9, 1))
    left, right = halves(tmp_path / "c.png", COUNT_COLOURS[4])
    assert left < 0.02 < 0.2 < right
    assert halves(tmp_path / "c.png", COUNT_COLOURS[1])[0] > 0.2


def test_longer_bars_have_more_of_their_colour(tmp_path: Path) -> None:
    def coloured(share: float) -> float:
        row = {"surface": "buccal", "seen_by_1_pct": 100.0, "seen_by_2_pct": share, "seen_by_3_pct": 1.0}
        save_shares_picture(tmp_path / "b.png", {"four": [row], "twelve": [row]})
        return share_of_hue(tmp_path / "b.png", COUNT_COLOURS[2], slice(None))

    assert 1.6 < coloured(80.0) / coloured(40.0) < 2.0
