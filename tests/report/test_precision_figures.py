"""Pictures of precision say with their colours what the numbers say."""

import numpy as np
import pytest
from matplotlib.image import imread

from builders import plate
from cuspid.report.figures.precision import (
    Panel,
    save_best_picture,
    save_ellipsoids_picture,
    save_maps_picture,
    save_noise_picture,
    save_precision_picture,
)

RED = np.array([0xD1, 0x2A, 0x1E]) / 255


def colourful(path) -> int:
    """How many pixels are clearly not grey."""
    image = imread(path)[..., :3]
    return int((np.ptp(image, axis=2) > 0.2).sum())


def test_what_fewer_than_two_see_is_grey(tmp_path):
    """The wall faces down, so it is looked at from below."""
    mesh = plate(0.0, 2.0, 10)
    few = np.where(mesh.face_centres[:, 0] < 0, 20.0, np.nan)
    views, counts = {"below": (0.0, -90.0)}, []
    for name, values in (("none", np.full(200, np.nan)), ("half", few), ("all", np.full(200, 20.0))):
        save_precision_picture(tmp_path / "p.png", mesh, {name: values}, views=views, limits_um=(5.0, 50.0))
        counts.append(colourful(tmp_path / "p.png"))
    bar, half, full = counts
    assert 0 < bar < half < full
    assert (half - bar) / (full - bar) == pytest.approx(0.5, abs=0.15)


def test_larger_ellipsoids_are_drawn_larger(tmp_path):
    sizes = []
    for deviation_mm in (0.01, 0.02):
        covariance = np.tile(deviation_mm**2 * np.eye(3), (200, 1, 1))
        path = tmp_path / "e.png"
        save_ellipsoids_picture(path, plate(0.0, 2.0, 10), covariance, picked=np.array([55]), angles_deg=(0.0, -90.0))
        image = imread(path)[..., :3]
        rows, columns = np.nonzero(image[..., 0] - image[..., 1] > 0.4)
        sizes.append(np.ptp(rows) * np.ptp(columns))
    assert sizes[1] / sizes[0] == pytest.approx(4, rel=0.2)


def test_the_best_of_each_column_is_framed(tmp_path):
    values = np.array([[10.0, 5.0, np.nan], [20.0, 2.0, np.nan]])

    def framed(best: str) -> int:
        save_maps_picture(
            tmp_path / "m.png",
            [Panel(title="t", unit="", values=values, best=best)],
            np.array([1.0, 2.0]),
            np.array([3.0, 4.0, 5.0]),
            columns=1,
        )
        return int((np.abs(imread(tmp_path / "m.png")[..., :3] - RED).max(axis=2) < 0.05).sum())

    assert framed("none") == 0
    assert framed("least") > 100
    assert framed("most") > 100


def test_curves_and_noise_are_drawn(tmp_path):
    line = (np.array([3.0, 5.0]), np.array([1.0, 2.0]))
    save_best_picture(tmp_path / "b.png", {"occlusal": {"0°": line}, "buccal": {"0°": line}})
    rows = [{"low": 0.0, "high": 0.2, "sigma_px": 0.05, "matched_pct": 99.0}]
    save_noise_picture(tmp_path / "n.png", {"slanted": rows}, {"slanted": (0.05, 0.5)})
    assert colourful(tmp_path / "b.png") > 50
    assert colourful(tmp_path / "n.png") > 50
