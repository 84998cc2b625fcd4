from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.text import Text

from builders import joined, moved, sphere
from cuspid.evaluation.deviation import EvaluationOptions, evaluate
from cuspid.evaluation.registration import RegistrationOptions
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.report.figures.comparison import Curve, save_comparison_picture
from cuspid.report.figures.drawing import (
    NOT_COUNTED,
    OCCLUSAL,
    FigureOptions,
    deviation_colors,
    look,
    new_figure,
    render,
    save_deviation_picture,
    save_figure,
    save_picture,
)
from cuspid.runtime.errors import InputError, OutputError
from horseshoe import horseshoe


def ball(radius_mm: float, centre: tuple[float, float, float], color: tuple[int, int, int]) -> Mesh:
    mesh = moved(sphere(radius_mm), centre)
    return replace(mesh, colors=np.tile(np.array(color, dtype=np.uint8), (len(mesh.vertices), 1)))


def place_of(image: np.ndarray, channel: int) -> np.ndarray:
    """Mean (column, row) of the pixels in which a channel prevails."""
    others = [other for other in range(3) if other != channel]
    rows, columns = np.nonzero(image[..., channel].astype(int) > image[..., others].max(axis=2).astype(int) + 40)
    return np.array([columns.mean(), rows.mean()])


def test_colours_are_green_within_tolerance_red_outside_blue_inside_grey_unknown():
    colors = deviation_colors(np.array([-500.0, -100, -60, -20, 0, 20, 60, 100, 500, np.nan])).astype(int)
    red, green, blue = colors.T
    assert (green[3:6] > red[3:6]).all()
    assert (green[3:6] > blue[3:6]).all()
    assert (blue[:3] > red[:3] + 50).all()
    assert (red[6:9] > blue[6:9] + 50).all()
    np.testing.assert_array_equal(colors[0], colors[1])
    np.testing.assert_array_equal(colors[7], colors[8])
    np.testing.assert_array_equal(colors[9], NOT_COUNTED)
    wide = FigureOptions(range_um=500.0, tolerance_um=90.0)
    np.testing.assert_array_equal(deviation_colors(np.array([80.0]), wide), deviation_colors(np.array([0.0])))


def test_names_are_drawn_as_they_are_and_begin_no_formula(tmp_path: Path):
    """In titles, ticks, legends and notes, laid out before or while they are drawn; powers of ten stay ones."""
    name = "$x_{$"
    for layout in (None, "constrained"):
        figure = new_figure(6.0, 4.0, dpi=50, layout=layout)
        axes, other = figure.subplots(1, 2)
        axes.plot([1, 100], [0, 1], label=name)
        axes.legend()
        axes.set_xscale("log")
        axes.set_title(name)
        axes.set_ylabel(name)
        axes.annotate(name, (1, 0))
        other.set_xticks([0, 1], [name, "b"])
        figure.suptitle(name)
        if layout is None:
            figure.tight_layout()
        save_figure(figure, tmp_path / "figure.png")
        labels = {label for label in axes.xaxis.get_ticklabels() if "10^" in label.get_text()}
        assert labels
        assert {text for text in figure.findobj(Text) if text.get_parse_math()} >= labels
        assert not any(text.get_parse_math() for text in figure.findobj(Text) if name in text.get_text())


@pytest.mark.parametrize("tolerance_um", [0.0, 100.0])
def test_a_tolerance_outside_the_range_is_refused(tolerance_um: float):
    with pytest.raises(InputError, match="tolerance"):
        FigureOptions(tolerance_um=tolerance_um)


def test_views_are_rotations_and_look_where_they_say():
    for axes in (OCCLUSAL, look(90.0, 30.0), look(-20.0, 10.0)):
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(OCCLUSAL, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(look(90.0, 0.0)[2], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(look(0.0, 0.0)[1], [0, 0, 1], atol=1e-12)


def test_a_picture_is_to_scale_and_the_right_way_round():
    red, green = ball(3.0, (-10, 0, 0), (200, 30, 30)), ball(3.0, (0, 8, 0), (30, 200, 30))
    view = render(joined(red, green), width_px=300)
    covered = np.sum(view.image.min(axis=2) < 240) * view.mm_per_px**2
    assert covered == pytest.approx(2 * np.pi * 9, rel=0.02)
    apart = (place_of(view.image, 1) - place_of(view.image, 0)) * view.mm_per_px
    np.testing.assert_allclose(apart, [10, -8], atol=0.3)


def test_what_is_nearer_hides_what_is_farther():
    scene = joined(ball(3.0, (0, 0, 0), (200, 30, 30)), ball(2.0, (0, 0, 10), (30, 200, 30)))
    centre = np.array(render(scene, width_px=200).image.shape[:2]) // 2
    assert np.argmax(render(scene, width_px=200).image[tuple(centre)]) == 1
    assert np.argmax(render(scene, look(-90.0, -90.0), width_px=200).image[tuple(centre)]) == 0


@pytest.mark.parametrize("eye", [OCCLUSAL, look(30.0, 20.0), look(-90.0, -90.0)])
def test_a_surface_shows_its_colours_from_the_front_and_grey_from_behind_in_the_same_light(eye: np.ndarray):
    """Corners of three colours: in the middle of the triangle their mean."""
    corners = np.array([[-1.0, -0.6, 0], [1.0, -0.6, 0], [0.0, 1.2, 0]]) @ eye
    colors = np.diag([240, 150, 90]).astype(np.uint8)
    front = Mesh(corners, np.array([[0, 1, 2]]), colors=colors)
    lit = 0.46 + 0.38 * 0.66 / np.linalg.norm([0.45, 0.60, 0.66]) + 0.22
    for mesh, expected in ((front, np.array([80, 50, 30])), (replace(front, faces=front.faces[:, ::-1]), 0.78 * 255)):
        image = render(mesh, eye, width_px=100).image
        row, column = np.argwhere(image.min(axis=2) < 255).mean(axis=0).round().astype(int)
        np.testing.assert_allclose(image[row, column], expected * lit, atol=3)


def test_a_long_title_is_not_cut_off(tmp_path: Path):
    box = [np.array([[-4.0, 5.0], [4.0, 5.0], [4.0, 9.0], [-4.0, 9.0]])]
    curve = Curve(turns=(1, 3), images=(40.0, 120.0), complete_pct=(30.0, 60.0), error_um=(5.0, 4.0))
    long = "Handpieces over a tooth; dashed: room at the second molar that 95 % of women have"
    save_comparison_picture(tmp_path / "picture.png", {"four": box}, {"jaw": {"four": curve}}, 12.0, title=long)
    drawn = cv2.imread(str(tmp_path / "picture.png"), cv2.IMREAD_GRAYSCALE)
    assert drawn is not None
    assert drawn[:60].min() < 100
    assert drawn[:60, -4:].min() == 255


@pytest.mark.long
def test_pictures_are_written_whole(tmp_path: Path):
    jaw = horseshoe(120, 40)
    moved = Rigid3.from_rotation_vector(np.array([0.0, 0.001, 0.0]), np.array([0.0, 0.0, 0.02]))
    scan = jaw.mesh.transformed(moved)
    options = EvaluationOptions(align=False, samples=5000, registration=RegistrationOptions(samples=2000))
    trueness = evaluate(scan, jaw, options, rng=np.random.default_rng(0))
    small = FigureOptions(width_px=300)
    save_deviation_picture(tmp_path / "deviation.png", scan, trueness, small, title="A jaw")
    save_picture(tmp_path / "jaw.png", jaw.mesh, width_px=300)
    for name in ("deviation.png", "jaw.png"):
        image = cv2.imread(str(tmp_path / name))
        assert image is not None
        assert image.shape[1] == 1560
        assert 0.1 < np.mean(image.min(axis=2) < 250) < 0.8
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deviation.png", "jaw.png"]
    nothing = replace(trueness, deviation_um=np.full(len(scan.vertices), np.nan))
    save_deviation_picture(tmp_path / "nothing.png", scan, nothing, small)


@pytest.mark.parametrize("suffix", [".pdf", ".png"])
def test_the_same_figure_is_the_same_file_at_any_time(tmp_path: Path, monkeypatch, suffix: str):
    """The run that a kill interrupted leaves what an undisturbed one does."""
    for instant in (0, 2_000_000_000):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", str(instant))
        figure = new_figure(2.0, 1.0, dpi=50)
        figure.text(0.1, 0.5, "trueness / µm")
        save_figure(figure, tmp_path / f"{instant}{suffix}")
    first, second = (path.read_bytes() for path in sorted(tmp_path.iterdir()))
    assert first == second


def test_a_picture_that_cannot_be_written_is_one_line(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be written"):
        save_picture(tmp_path / "file" / "jaw.png", horseshoe(60, 20).mesh, width_px=100)
