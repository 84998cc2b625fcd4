"""Boards to print, and pictures of a calibration: where each camera saw corners, what was left over there, and what the
cameras make of light."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection, PolyCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from cuspid.model.board import Board
from cuspid.model.camera import Camera
from cuspid.model.rig import Sensor
from cuspid.report.figures.drawing import SIGMA_COLORS, new_figure, save_figure
from cuspid.runtime.errors import InputError

BOARD_SUFFIXES = (".pdf", ".svg", ".png")
_MM_PER_INCH = 25.4
_MARGIN_MM, _RULER_MM = 5.0, 7.0
_GAP_MM, _FOLD_MM = 0.5, 3.5
"""Distances from the squares between which lines tell where to cut and to fold."""
_CUT, _FOOT, _HEAD = (0.0, ()), (0.0, (4.0, 2.0)), (0.0, (1.0, 1.5))
"""Dashes of these lines."""
_INK = "#333333"
_BEFORE, _AFTER = "#9a9a9a", "#1f5fd6"
_SIGMAS_PX = (0.01, 10.0)
"""Ends of the colours of standard deviations of projections."""
_BINS = 12
"""Of radii and of levels, over which points are averaged."""
_FEWEST = 5
"""Points in one of them at least."""
_LONGEST = 0.1
"""Line of the largest residual, as a share of the width of an image."""


def save_board(path: Path, board: Board) -> None:
    """PDF, SVG or PNG of a board in its true size, with a ruler that shows whether the printer kept it; of terraces a
    strip to be folded over the steps, blank where the risers are, with the folds beside it.

    Raises InputError for another kind of file.
    """
    if path.suffix.lower() not in BOARD_SUFFIXES:
        raise InputError(f"{path}: a board is written as {', '.join(BOARD_SUFFIXES)}, its body as .stl")
    width, height = board.size_mm[0] + board.height_mm, board.size_mm[1]
    margin = max(_MARGIN_MM, board.square_mm / 2)
    page = np.array([width + 2 * margin, height + 2 * margin + _RULER_MM])
    figure = Figure(figsize=tuple(page / _MM_PER_INCH), dpi=600, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(-margin, width + margin)
    axes.set_ylim(height + margin + _RULER_MM, -margin)
    axes.set_axis_off()
    places, sides = _unfold_squares(board)
    if board.inverted:
        ground = np.array([[-margin / 2, -margin / 2]])
        axes.add_collection(_squares(ground, np.array([[width + margin, height + margin]]), "black"))
    ink = "white" if board.inverted else "black"
    axes.add_collection(_squares(places, np.stack([sides, sides], axis=1), ink))
    if board.has_circles:
        axes.add_collection(_circles(board, axes, ink))
    if board.terraces > 1:
        _draw_folds(axes, board, height)
    _draw_ruler(figure, board, height + margin)
    save_figure(figure, path)


def _unfold_squares(board: Board) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
    """The printed squares on the strip that is folded over the steps: the top left corner and the side of each, mm."""
    places, sides = board.dark
    risers = board.step_mm * board.terrace_at(places[:, 0] + sides / 2)
    return places + np.outer(risers, [1, 0]), sides


def _draw_folds(axes: Axes, board: Board, height: float) -> None:
    """Lines beside the strip, not on it, for cameras must not see them: whole where it is cut, dashed at the foot and
    dotted at the top of each riser."""
    edges, steps, width = board.edges_mm, board.step_mm * np.arange(board.terraces), board.size_mm[0] + board.height_mm
    feet, heads = edges[1:-1] + steps[:-1], edges[1:-1] + steps[1:]
    for dashes, places in ((_CUT, [0.0, width]), (_FOOT, feet), (_HEAD, heads)):
        for ends in (-_FOLD_MM, -_GAP_MM), (height + _GAP_MM, height + _FOLD_MM):
            axes.vlines(places, *ends, colors="black", linewidth=0.4, linestyles=dashes)
    for ends in (-_FOLD_MM, -_GAP_MM), (width + _GAP_MM, width + _FOLD_MM):
        axes.hlines([0.0, height], *ends, colors="black", linewidth=0.4)


def _squares(places: Float[np.ndarray, "n 2"], sizes: Float[np.ndarray, "n 2"], colour: str) -> PolyCollection:
    corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return PolyCollection(
        places[:, None] + sizes[:, None] * corners, facecolors=colour, edgecolors="none", antialiased=False
    )


def _circles(board: Board, axes: Axes, colour: str) -> EllipseCollection:
    across = np.full(len(board.corners), board.circle_mm)
    return EllipseCollection(
        across,
        across,
        np.zeros(len(across)),
        units="xy",
        offsets=board.corners[:, :2],
        offset_transform=axes.transData,
        facecolors=colour,
        edgecolors="none",
    )


def _draw_ruler(figure: Figure, board: Board, top_mm: float) -> None:
    """As many sides of a square as there are in a row; and what they must measure."""
    axes, length = figure.axes[0], board.columns * board.square_mm
    axes.plot([0, length], [top_mm, top_mm], color="black", linewidth=0.5, solid_capstyle="butt")
    for x in board.square_mm * np.arange(board.columns + 1):
        axes.plot([x, x], [top_mm - 1, top_mm + 1], color="black", linewidth=0.5, solid_capstyle="butt")
    size = min(8.0, 72 / _MM_PER_INCH * length / 30)
    axes.text(0, top_mm + 1.5, f"{length:g} mm, {_describe_board(board)}", fontsize=size, va="top", color="black")


def _describe_board(board: Board) -> str:
    text = f"{board.kind} {board.columns} x {board.rows} x {board.square_mm:g} mm"
    if board.kind == "charuco":
        text += f", {board.dictionary}, markers {board.marker_share:g}"
    if board.kind == "aprilgrid":
        text += f", {board.family}, spacing {board.spacing_share:g}"
    if board.has_circles:
        text += f", circles of {board.circle_mm:g} mm"
    if board.has_markers:
        text += f", ids {board.ids_told}"
    return text + (f"\n{board.terraces} terraces, steps of {board.step_mm:g} mm" if board.terraces > 1 else "")


def save_residuals_picture(
    path: Path,
    cameras: Mapping[str, Camera],
    pixels: Mapping[str, Float[np.ndarray, "n 2"]],
    residuals: Mapping[str, Float[np.ndarray, "n 2"]],
    *,
    title: str = "",
) -> None:
    """PNG with an image frame for each camera: where corners were seen, and the residual of each as a line."""
    columns = min(4, len(cameras))
    rows = -(-len(cameras) // columns)
    figure = new_figure(3.4 * columns, 0.5 + 3.0 * rows, dpi=130)
    largest = max(float(np.linalg.norm(each, axis=1).max()) for each in residuals.values())
    for index, (name, camera) in enumerate(cameras.items()):
        axes = figure.add_subplot(rows, columns, index + 1)
        _draw_residuals(axes, camera, pixels[name], residuals[name] * _LONGEST * camera.width / largest)
        rms = float(np.sqrt(np.mean(residuals[name] ** 2)))
        axes.set_title(f"{name}: {rms:.2f} px RMS", fontsize=10, color=_INK)
    figure.suptitle(f"{title}\nlongest line: {largest:.2g} px", fontsize=11, color=_INK)
    figure.tight_layout()
    save_figure(figure, path)


def _draw_residuals(axes: Axes, camera: Camera, at: Float[np.ndarray, "n 2"], drawn: Float[np.ndarray, "n 2"]) -> None:
    lines = np.stack([at, at + drawn], axis=1)
    axes.add_collection(LineCollection(lines.tolist(), colors="#d1603d", linewidths=0.6))
    axes.plot(*at.T, ".", color="#1f5fd6", markersize=1.2)
    axes.set_xlim(0, camera.width)
    axes.set_ylim(camera.height, 0)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7, colors=_INK)


def save_uncertainty_picture(
    path: Path, cameras: Mapping[str, Camera], sigma_px: Mapping[str, Float[np.ndarray, "r c"]]
) -> None:
    """PNG with an image frame for each camera, coloured by the standard deviation of its projections on a grid over the
    image; grey where there is none. Colours mean the same in all pictures."""
    columns = min(4, len(cameras))
    rows = -(-len(cameras) // columns)
    figure = new_figure(3.4 * columns, 0.5 + 3.0 * rows, dpi=130)
    colours = colormaps[SIGMA_COLORS].with_extremes(bad="#cccccc")
    for index, (name, camera) in enumerate(cameras.items()):
        axes = figure.add_subplot(rows, columns, index + 1)
        extent = (0.0, float(camera.width), float(camera.height), 0.0)
        drawn = axes.imshow(sigma_px[name], cmap=colours, norm=LogNorm(*_SIGMAS_PX), extent=extent)
        known = sigma_px[name][np.isfinite(sigma_px[name])]
        middle = f"{np.median(known):.2g} px (median)" if known.size else "not known"
        axes.set_title(f"{name}: {middle}", fontsize=10, color=_INK)
        axes.tick_params(labelsize=7, colors=_INK)
        bar = figure.colorbar(drawn, ax=axes, shrink=0.6, extend="both", label="px")
        bar.ax.tick_params(labelsize=7, colors=_INK)
    figure.tight_layout()
    save_figure(figure, path)


def save_lenses_picture(
    path: Path,
    cameras: Mapping[str, tuple[Camera, Camera]],
    moved_px: Mapping[str, Float[np.ndarray, "r c 2"]],
    seen: Mapping[str, Float[np.ndarray, "n 2"]],
) -> None:
    """PNG with an image frame for each camera, coloured by how far another lens model would move what it shows, on a
    grid over the image, with arrows to where; and the corners that both were calibrated from, as dots.

    Args:
        cameras: The camera as it was taken, and by the other model.
        moved_px: By how much the latter moves projections; NaN where there are none.
        seen: Where corners were seen, px.
    """
    columns = min(4, len(cameras))
    rows = -(-len(cameras) // columns)
    figure = new_figure(max(4.0, 3.6 * columns), 0.5 + 3.2 * rows, dpi=130)
    colours = colormaps[SIGMA_COLORS].with_extremes(bad="#cccccc")
    for index, (name, (camera, other)) in enumerate(cameras.items()):
        axes, moved = figure.add_subplot(rows, columns, index + 1), moved_px[name]
        extent, size = (0.0, float(camera.width), float(camera.height), 0.0), np.linalg.norm(moved, axis=2)
        drawn = axes.imshow(size, cmap=colours, norm=LogNorm(*_SIGMAS_PX), extent=extent)
        _draw_arrows(axes, camera, moved)
        axes.plot(*seen[name].T, ".", color="white", markersize=0.8, alpha=0.6)
        axes.set_xlim(0, camera.width)
        axes.set_ylim(camera.height, 0)
        axes.set_title(f"{name}: {other.model} instead of {camera.model}", fontsize=9, color=_INK)
        axes.tick_params(labelsize=7, colors=_INK)
        bar = figure.colorbar(drawn, ax=axes, shrink=0.6, extend="both", label="px")
        bar.ax.tick_params(labelsize=7, colors=_INK)
    figure.tight_layout()
    save_figure(figure, path)


def _draw_arrows(axes: Axes, camera: Camera, moved: Float[np.ndarray, "r c 2"]) -> None:
    """In every third cell, so long that the longest of most spans three; which way alone is told beyond that."""
    rows, columns = moved.shape[:2]
    cell = camera.width / columns
    down, across = np.mgrid[1:rows:3, 1:columns:3]
    arrows = moved[down, across]
    length = np.linalg.norm(arrows, axis=2)
    if not np.isfinite(length).any():
        return
    longest = max(float(np.nanpercentile(length, 90)), 1e-9)
    shown = arrows * (3 * cell / longest * np.minimum(1, longest / np.maximum(length, 1e-12)))[..., None]
    places = (np.stack([across, down], axis=2) + 0.5) * cell
    axes.quiver(
        *np.moveaxis(places, 2, 0), *np.moveaxis(shown, 2, 0), angles="xy", scale_units="xy", scale=1, color="#d1603d"
    )


Residuals = Mapping[str, tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]]
"""By camera: distance of patches from the principal point in halves of the diagonal, residuals before and after, %."""


def save_photometry_picture(
    path: Path,
    sensors: Mapping[str, Sensor],
    variances: Mapping[str, tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]],
    residuals: Residuals,
) -> None:
    """PNG of what cameras make of light: gain and falloff with standard deviations, what is left over of the grey
    values before and after, and the noise at each level (``variances``: levels and variances of patches, DN)."""
    figure = new_figure(12.5, 4.4, dpi=130)
    colours = colormaps["turbo"](np.linspace(0.05, 0.95, len(sensors)))
    axes = [figure.add_subplot(1, 3, k + 1) for k in range(3)]
    for (name, sensor), colour in zip(sensors.items(), colours, strict=True):
        _draw_falloff(axes[0], name, sensor, colour)
        _draw_noise(axes[2], sensor, *variances[name], colour)
    _draw_residual_shading(axes[1], residuals)
    _label(axes[0], "gain and falloff", "distance from the principal point, half diagonals", "share of the light")
    _label(axes[1], "residuals", "distance from the principal point, half diagonals", "residual, % of the grey value")
    _label(axes[2], "noise", "grey value, DN", "standard deviation, DN")
    axes[0].legend(fontsize=7, ncols=-(-len(sensors) // 6), frameon=False)
    axes[1].legend(fontsize=8, frameon=False)
    figure.tight_layout()
    save_figure(figure, path)


def _draw_falloff(axes: Axes, name: str, sensor: Sensor, colour: Float[np.ndarray, "4"]) -> None:
    """Gain times falloff, with one standard deviation to either side."""
    r = np.linspace(0, 1, 60)
    by = np.stack([np.ones_like(r), r**2, r**4], axis=1)
    curve = sensor.gain * np.exp(by[:, 1:] @ sensor.falloff)
    axes.plot(r, curve, color=colour, linewidth=1.2, label=name)
    if sensor.covariance is not None:
        sigma = np.sqrt(np.einsum("ni,ij,nj->n", by, sensor.covariance[:3, :3], by))
        axes.fill_between(r, curve * np.exp(-sigma), curve * np.exp(sigma), color=colour, alpha=0.2, linewidth=0)


def _draw_residual_shading(axes: Axes, residuals: Residuals) -> None:
    """The mean over each ring of each camera, as lines, over all patches, as points."""
    for index, (colour, label) in enumerate(((_BEFORE, "before"), (_AFTER, "after"))):
        r = np.concatenate([each[0] for each in residuals.values()])
        left = np.concatenate([each[index + 1] for each in residuals.values()])
        axes.plot(r, left, ".", color=colour, markersize=1, alpha=0.25, rasterized=True)
        for camera in residuals.values():
            axes.plot(*_bin_means(camera[0], camera[index + 1]), color=colour, linewidth=1.2)
        axes.plot([], [], color=colour, label=f"{label}: {np.sqrt(np.mean(left**2)):.2f} % RMS")
    before = np.concatenate([each[1] for each in residuals.values()])
    axes.set_ylim(*(1.2 * np.percentile(before, [0.5, 99.5])))


def _draw_noise(
    axes: Axes,
    sensor: Sensor,
    levels: Float[np.ndarray, "n"],
    variances: Float[np.ndarray, "n"],
    colour: Float[np.ndarray, "4"],
) -> None:
    """Of patches alike, as points, and of the sensor, as a line."""
    at, variance = _bin_means(levels, variances)
    axes.plot(at, np.sqrt(variance), ".", color=colour, markersize=5)
    level = np.linspace(0, 255, 60)
    axes.plot(level, sensor.noise_sd_dn(level), color=colour, linewidth=1)
    axes.set_ylim(bottom=0)


def _bin_means(
    at: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Means over runs of points that are near to each other."""
    edges = np.linspace(at.min(), at.max(), _BINS + 1)
    which = np.clip(np.searchsorted(edges, at) - 1, 0, _BINS - 1)
    full = [k for k in range(_BINS) if np.sum(which == k) >= _FEWEST]
    return np.array([at[which == k].mean() for k in full]), np.array([values[which == k].mean() for k in full])


def _label(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, fontsize=10, color=_INK)
    axes.set_xlabel(x, fontsize=8, color=_INK)
    axes.set_ylabel(y, fontsize=8, color=_INK)
    axes.tick_params(labelsize=7, colors=_INK)
