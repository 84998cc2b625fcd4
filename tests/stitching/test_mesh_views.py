"""The views of a finished mesh, against surfaces whose colour and height are known at every place."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.panorama import ZONES, Panorama
from cuspid.pipeline.panorama import MeshViewOptions, view_mesh
from cuspid.runtime.errors import InputError
from cuspid.stitching.mesh_views import MeshViews, draw_mesh
from cuspid.stitching.strip import StripOptions
from verbs import refused, run

RADIUS_MM, HEIGHT_MM, HALF_TOP_MM, HALF_FOOT_MM = 22.0, 7.0, 3.0, 4.5
"""A ridge along half a circle, with slanting sides; its top is at z = 0."""
RED, GREEN, BLUE = [200, 40, 40], [40, 200, 40], [40, 40, 200]
"""Its outer side, its top and its inner side."""
OPTIONS = MeshViewOptions(mm_per_px=0.1)


def section(turn: np.ndarray) -> np.ndarray:
    """The ridge's corners at angles: foot and rim outside, rim and foot inside."""
    radii = RADIUS_MM + np.array([HALF_FOOT_MM, HALF_TOP_MM, -HALF_TOP_MM, -HALF_FOOT_MM])
    heights = np.array([-HEIGHT_MM, 0, 0, -HEIGHT_MM])
    x, y = (np.multiply.outer(f(turn), radii) for f in (np.cos, np.sin))
    return np.stack([x, y, np.broadcast_to(heights, x.shape)], axis=-1)


def ridge(count: int = 400) -> Mesh:
    """Each side has vertices of its own, in its colour."""
    corners = section(np.linspace(np.pi, 0, count))
    vertices, faces, colors = [], [], []
    for side, color in enumerate((RED, GREEN, BLUE)):
        strip = corners[:, side : side + 2].reshape(-1, 3)
        first = 2 * np.arange(count - 1)[:, None] + 2 * count * side
        faces += [first + [0, 1, 2], first + [1, 3, 2]]
        vertices.append(strip)
        colors.append(np.tile(color, (len(strip), 1)))
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(colors).astype(np.uint8))


def middle() -> np.ndarray:
    """The line along the middle of its top."""
    turn = np.linspace(np.pi, 0, 500)
    return RADIUS_MM * np.stack([np.cos(turn), np.sin(turn), np.zeros(500)], axis=1)


@pytest.fixture(scope="module")
def views() -> MeshViews:
    return draw_mesh(ridge(), middle(), OPTIONS)


def pixels_of(panorama: Panorama) -> np.ndarray:
    rows, columns = np.indices(panorama.covered.shape)
    return panorama.world_from_pixels(np.stack([columns, rows], axis=-1) + 0.5)


def test_from_above_every_place_has_its_colour_and_height(views: MeshViews) -> None:
    panorama = views.panorama
    xy = pixels_of(panorama)
    off = np.linalg.norm(xy, axis=-1) - RADIUS_MM
    top, outer = np.abs(off) < HALF_TOP_MM - 0.1, (off > HALF_TOP_MM + 0.1) & (off < HALF_FOOT_MM - 0.1)
    upper = xy[..., 1] > 0.2
    assert panorama.covered[top & upper].all()
    assert not panorama.covered[np.abs(off) > HALF_FOOT_MM + 0.1].any()
    assert (panorama.image[top & upper] == GREEN).all()
    assert (panorama.image[outer & upper] == RED).all()
    slope = -HEIGHT_MM * (off - HALF_TOP_MM) / (HALF_FOOT_MM - HALF_TOP_MM)
    assert panorama.height_mm is not None
    assert np.abs(panorama.height_mm[top & upper]).max() < 1e-3
    assert np.abs(panorama.height_mm - slope)[outer & upper].max() < 0.05
    assert panorama.mm_per_px == OPTIONS.mm_per_px


@pytest.mark.parametrize(("name", "color"), [("buccal", RED), ("lingual", BLUE)])
def test_a_side_strip_shows_its_side_at_true_length_and_height(views: MeshViews, name: str, color: list[int]) -> None:
    strip = views.strips[name]
    assert (strip.image[strip.covered] == color).all()
    rows, columns = strip.covered.shape
    assert columns * OPTIONS.mm_per_px == pytest.approx(np.pi * RADIUS_MM, abs=0.5)
    assert rows * OPTIONS.mm_per_px == pytest.approx(HEIGHT_MM, abs=0.3)
    assert (strip.zone[strip.covered] == ZONES.index(name)).all()
    assert (strip.zone[~strip.covered] == -1).all()


def test_the_occlusal_strip_is_straight_and_tells_its_zones(views: MeshViews) -> None:
    strip = views.strips["occlusal"]
    columns = strip.covered.shape[1]
    inner = slice(5, columns - 5)
    widths = strip.covered[:, inner].sum(axis=0) * OPTIONS.mm_per_px
    assert np.abs(widths - 2 * HALF_FOOT_MM).max() < 0.3
    for color, zone in zip((RED, GREEN, BLUE), ZONES, strict=True):
        shown = strip.zone[:, inner] == ZONES.index(zone)
        deep = np.abs(strip.image[:, inner].astype(int) - color).max(axis=-1) == 0
        assert (deep & shown).sum() > 0.5 * deep.sum()
    assert np.argmax(strip.zone[:, columns // 2] == ZONES.index("buccal")) < strip.covered.shape[0] / 2


def test_strips_share_their_columns(views: MeshViews) -> None:
    curves = [strip.curve for strip in views.strips.values()]
    assert all(np.array_equal(curve, curves[0]) for curve in curves)
    on_circle = np.linalg.norm(curves[0], axis=1)
    assert np.abs(on_circle - RADIUS_MM).max() < 0.2


def test_backs_show_nothing() -> None:
    turned = replace(ridge(), faces=ridge().faces[:, ::-1])
    made = draw_mesh(turned, None, OPTIONS)
    assert not made.panorama.covered.any()
    assert not made.strips


def test_a_mesh_without_colours_is_brightest_where_it_faces_the_viewer() -> None:
    plain = replace(ridge(), colors=None)
    panorama = draw_mesh(plain, None, OPTIONS).panorama
    off = np.linalg.norm(pixels_of(panorama), axis=-1) - RADIUS_MM
    top, outer = (np.median(panorama.image[panorama.covered & part]) for part in (np.abs(off) < 2, off > 3.5))
    assert top > 230
    assert 60 < outer < 150


def test_a_picture_too_large_is_refused() -> None:
    with pytest.raises(InputError, match=r"--view\.mm-per-px"):
        draw_mesh(ridge(), None, MeshViewOptions(mm_per_px=0.001))
    with pytest.raises(InputError, match=r"--view\.mm-per-px"):
        draw_mesh(ridge(), middle(), MeshViewOptions(mm_per_px=0.02, strip=StripOptions(half_width_mm=100.0)))


@pytest.mark.long
def test_how_a_jaw_lies_in_its_file_makes_no_difference(coarse_phantom: Jaw) -> None:
    moved = Rigid3.from_rotation_vector(np.array([0.6, -0.9, 1.3]), np.array([12.0, -40.0, 7.0]))
    options = MeshViewOptions(mm_per_px=0.2)
    (plain, upright), (turned, found) = (
        view_mesh(mesh, options) for mesh in (coarse_phantom.mesh, coarse_phantom.mesh.transformed(moved))
    )
    between = found @ moved @ upright.inverse()
    assert between.angle_deg < 2.5
    assert np.abs(between.translation).max() < 0.25  # half the spacing of the grid on which the crowns are found
    assert list(turned.strips) == list(plain.strips) == ["occlusal", "buccal", "lingual"]
    for name, strip in plain.strips.items():
        assert turned.strips[name].covered.shape[1] == pytest.approx(strip.covered.shape[1], rel=0.03)
        assert turned.strips[name].covered.mean() == pytest.approx(strip.covered.mean(), abs=0.05)


@pytest.mark.long
def test_a_scan_is_drawn_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan, out = tmp_path / "scan", tmp_path / "views"
    scan.mkdir()
    storage.write_mesh(scan / "mesh.ply", ridge())
    run("pano", "stitch", "--mesh", scan, "--view.mm-per-px", 0.2, "--out", out)
    made = storage.read_panorama(out)
    assert made.method == "mesh"
    assert made.image[made.covered].max() > 150
    assert np.shape(json.loads((out / "orientation.json").read_text())["occlusal_from_mesh"]) == (4, 4)
    report = (out / "report.html").read_text()
    assert "seen from the cheek" in report
    assert "frames placed" not in report
    left = [out / name for name in ("poses.json", "camera_path.png", "part-2/panorama.json")]
    for path in (*left, out / "mine.txt"):
        path.parent.mkdir(exist_ok=True)
        path.write_text("of an earlier run")
    run("pano", "stitch", "--mesh", scan, "--view.mm-per-px", 0.4, "--out", out)
    assert not any(path.exists() for path in (*left, out / "part-2"))
    assert (out / "mine.txt").exists()
    for arguments in (["--mesh", scan, scan], []):
        assert "either FRAMES or --mesh" in refused(capsys, "pano", "stitch", *arguments, "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()
