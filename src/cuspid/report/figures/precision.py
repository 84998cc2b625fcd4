"""Pictures of precision: bounds over a tooth, error ellipsoids, maps of the study of a pair, matching noise.

Meshes lie in the occlusal frame (mm), figures in um. Everything comes as plain values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from cuspid.model.mesh import Mesh
from cuspid.report.figures.drawing import NOT_COUNTED, look, new_figure, render, save_figure

_INK = "#333333"
_ERRORS = colormaps["viridis_r"]
_LINES = ("#3b7dd8", "#3fa66b", "#f2a33a", "#d1603d", "#8e5bb5")


Best = Literal["least", "most", "none"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Panel:
    """A map over two axes."""

    title: str
    """Above it."""
    unit: str
    """Of the values."""
    values: Float[np.ndarray, "m n"]
    """Rows along the first axis, drawn upwards, columns along the second; NaN is left empty."""
    best: Best = "least"
    """Which value of each column is framed: the least of errors, the most of shares, which run from 0 to 100."""


def save_precision_picture(
    path: Path,
    mesh: Mesh,
    rms_um: Mapping[str, Float[np.ndarray, "f"]],
    *,
    views: Mapping[str, tuple[float, float]],
    limits_um: tuple[float, float],
    title: str = "",
) -> None:
    """PNG: a row for each design with the bound of each face (NaN: grey, not seen by two), seen from several sides.

    ``views``: azimuth and elevation in degrees by name. The colours run from the first to the second limit, in steps of
    equal ratio.
    """
    height_in = 3.1 * len(rms_um) + 1.6
    figure = new_figure(3.2 * len(views) + 0.4, height_in, dpi=84)
    axes = figure.subplots(len(rms_um), len(views), squeeze=False)
    norm = LogNorm(*limits_um)
    for row, (design, values) in zip(axes, rms_um.items(), strict=True):
        colored = replace(mesh, colors=_face_colors(mesh, values, norm))
        for panel, (view, angles) in zip(row, views.items(), strict=True):
            panel.imshow(render(colored, look(*angles), width_px=360).image)
            panel.set_axis_off()
            panel.set_title(f"{design}: {view}", loc="left", fontsize=11, color=_INK)
    figure.subplots_adjust(
        left=0.02, right=0.98, top=1 - 0.75 / height_in, bottom=0.85 / height_in, wspace=0.05, hspace=0.15
    )
    scale = figure.add_axes((0.25, 0.6 / height_in, 0.5, 0.15 / height_in))
    bar = figure.colorbar(ScalarMappable(norm, _ERRORS), cax=scale, orientation="horizontal")
    ticks = [tick for tick in (1, 2, 3, 5, 10, 20, 30, 50, 100, 200) if limits_um[0] <= tick <= limits_um[1]]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    bar.set_label("bound, RMS / µm (grey: fewer than two cameras)", color=_INK)
    _finish(figure, path, title)


def save_ellipsoids_picture(
    path: Path,
    mesh: Mesh,
    covariance_mm2: Float[np.ndarray, "f 3 3"],
    *,
    picked: Int[np.ndarray, "n"],
    angles_deg: tuple[float, float],
    magnification: float = 20.0,
    title: str = "",
) -> None:
    """PNG: error ellipses (one standard deviation, magnified) of picked faces over a view of the mesh."""
    axes = look(*angles_deg)
    view = render(mesh, axes, width_px=700)
    low, high = (mesh.vertices @ axes.T).min(axis=0), (mesh.vertices @ axes.T).max(axis=0)
    height, width = view.image.shape[:2]
    centre = (low + high)[:2] / 2
    half = np.array([width, height]) * view.mm_per_px / 2
    figure = new_figure(7.0, 7.0 * height / width + 0.8, dpi=84)
    panel = figure.add_axes((0.02, 0.08, 0.96, 0.80))
    panel.imshow(
        view.image, extent=(centre[0] - half[0], centre[0] + half[0], centre[1] - half[1], centre[1] + half[1])
    )
    for face in picked:
        panel.add_patch(_ellipse(mesh.face_centres[face] @ axes.T, axes @ covariance_mm2[face] @ axes.T, magnification))
    panel.set_axis_off()
    panel.set_aspect("equal")
    figure.text(0.03, 0.03, f"ellipses: one standard deviation, magnified {magnification:g} times", color=_INK)
    _finish(figure, path, title)


def _ellipse(place: Float[np.ndarray, "3"], covariance_mm2: Float[np.ndarray, "3 3"], magnification: float) -> Ellipse:
    """The ellipsoid's outline, seen along the third axis."""
    variances, directions = np.linalg.eigh(covariance_mm2[:2, :2])
    width, height = 2 * magnification * np.sqrt(np.maximum(variances, 0))
    angle = np.rad2deg(np.arctan2(directions[1, 0], directions[0, 0]))
    return Ellipse((place[0], place[1]), width, height, angle=angle, fill=False, edgecolor="#c2261c", linewidth=1.4)


def save_maps_picture(
    path: Path,
    panels: Sequence[Panel],
    first: Float[np.ndarray, "m"],
    second: Float[np.ndarray, "n"],
    *,
    labels: tuple[str, str] = ("baseline / mm", "distance / mm"),
    columns: int = 3,
    title: str = "",
) -> None:
    """PNG: panels over the same two axes (first upwards, second to the right), with their numbers written in."""
    rows = -(-len(panels) // columns)
    figure = new_figure(4.6 * columns, 3.3 * rows + 0.6, dpi=84)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.ravel()[len(panels) :]:
        axes.set_axis_off()
    for axes, panel in zip(grid.ravel(), panels, strict=False):
        _draw_map(axes, panel, first, second)
        axes.set_ylabel(labels[0], color=_INK)
        axes.set_xlabel(labels[1], color=_INK)
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.45 / figure.get_figheight()))
    _finish(figure, path, title)


def _draw_map(axes: Axes, panel: Panel, first: Float[np.ndarray, "m"], second: Float[np.ndarray, "n"]) -> None:
    norm = (
        LogNorm(*_range(panel.values)) if panel.best == "least" else Normalize(0, 100 if panel.best == "most" else None)
    )
    colours = colormaps["viridis"] if panel.best == "most" else _ERRORS
    axes.imshow(np.ma.masked_invalid(panel.values), origin="lower", aspect="auto", norm=norm, cmap=colours)
    axes.set_yticks(range(len(first)), [f"{value:g}" for value in first])
    axes.set_xticks(range(len(second)), [f"{value:g}" for value in second])
    axes.set_title(f"{panel.title} / {panel.unit}" if panel.unit else panel.title, loc="left", fontsize=11, color=_INK)
    for (row, column), value in np.ndenumerate(panel.values):
        if np.isfinite(value):
            light = (norm(value) < 0.5) == (panel.best == "most")
            text = f"{value:.1f}" if panel.best == "least" and value < 9.95 else f"{value:.0f}"
            axes.text(column, row, text, ha="center", va="center", fontsize=8, color="white" if light else _INK)
    if panel.best != "none":
        _frame_best(axes, panel.values, -1 if panel.best == "least" else 1)


def _range(values: Float[np.ndarray, "m n"]) -> tuple[float, float]:
    """Limits of a scale of ratios, never empty."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 1.0, 10.0
    return float(known.min()), float(max(known.max(), 1.2 * known.min()))


def _frame_best(axes: Axes, values: Float[np.ndarray, "m n"], sign: int) -> None:
    """A frame around the largest value times the sign in each column, where they differ."""
    ranked = np.where(np.isfinite(values), sign * values, -np.inf)
    for column, row in enumerate(ranked.argmax(axis=0)):
        if np.isfinite(ranked[row, column]) and np.nanmin(ranked[:, column]) < ranked[row, column]:
            x, y = column + 0.46 * np.array([-1, 1, 1, -1, -1]), row + 0.44 * np.array([-1, -1, 1, 1, -1])
            axes.plot(x, y, color="#d12a1e", linewidth=1.8)


def save_best_picture(
    path: Path,
    curves: Mapping[str, Mapping[str, tuple[Float[np.ndarray, "_"], Float[np.ndarray, "_"]]]],
    *,
    labels: tuple[str, str] = ("distance / mm", "best baseline / mm"),
    title: str = "",
) -> None:
    """PNG: a panel for each name with curves by name, each x and y. Curves that meet are drawn a little apart."""
    figure = new_figure(4.4 * len(curves), 3.9, dpi=84)
    panels = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for axes, (name, lines) in zip(panels, curves.items(), strict=True):
        for index, (line, (x, y)) in enumerate(lines.items()):
            shift = 0.03 * (index - (len(lines) - 1) / 2)
            axes.plot(x, y + shift, "o-", color=_LINES[index % len(_LINES)], markersize=4, linewidth=1.5, label=line)
        _decorate(axes, labels[0])
        axes.set_title(name, loc="left", fontsize=12, color=_INK)
    panels[0].set_ylabel(labels[1], color=_INK)
    panels[-1].legend(frameon=False, fontsize=9, loc="best")
    figure.tight_layout(rect=(0, 0, 1, 0.90))
    _finish(figure, path, title)


def save_noise_picture(
    path: Path,
    measured: Mapping[str, Sequence[Mapping[str, float]]],
    laws: Mapping[str, tuple[float, float]],
    *,
    title: str = "",
) -> None:
    """PNG: noise of matchers over the deformation with their laws, and the share that is matched.

    ``measured``: for each matcher bins with ``low``, ``high``, ``sigma_px`` and ``matched_pct``; ``laws``: sigma in px
    and the deformation that doubles the variance.
    """
    figure = new_figure(9.6, 4.0, dpi=84)
    noise, share = figure.subplots(1, 2)
    for (name, rows), colour in zip(measured.items(), _LINES[::3], strict=False):
        middles = np.array([(row["low"] + row["high"]) / 2 for row in rows])
        noise.plot(middles, [row["sigma_px"] for row in rows], "o", color=colour, label=f"{name}, measured")
        sigma_px, doubling = laws[name]
        x = np.linspace(0, middles.max(), 200)
        noise.plot(x, sigma_px * np.sqrt(1 + (x / doubling) ** 2), color=colour, linewidth=1.2, label=f"{name}, law")
        share.plot(middles, [row["matched_pct"] for row in rows], "o-", color=colour, label=name)
    noise.set_ylabel("noise in each image / px", color=_INK)
    noise.set_ylim(0, None)
    share.set_ylabel("matched within 1 px / %", color=_INK)
    share.set_ylim(0, 103)
    for axes in (noise, share):
        _decorate(axes, "deformation between the images")
        axes.legend(frameon=False, fontsize=9)
    figure.tight_layout(rect=(0, 0, 1, 0.90))
    _finish(figure, path, title)


def _face_colors(mesh: Mesh, values: Float[np.ndarray, "f"], norm: Normalize) -> UInt8[np.ndarray, "v 3"]:
    """Colour of the mean of the known faces around each vertex; grey where most of them are unknown."""
    corners = mesh.faces.ravel()
    known = np.repeat(np.isfinite(values), 3)
    every = np.bincount(corners, minlength=len(mesh.vertices))
    count = np.bincount(corners[known], minlength=len(mesh.vertices))
    total = np.bincount(corners[known], np.repeat(values, 3)[known], minlength=len(mesh.vertices))
    colors = _ERRORS(norm(total / np.maximum(count, 1) + 1e-9), bytes=True)[:, :3]
    return np.where((2 * count >= every)[:, None] & (count > 0)[:, None], colors, NOT_COUNTED)


def _decorate(axes: Axes, label: str) -> None:
    axes.set_xlabel(label, color=_INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#e2e2e2", linewidth=0.6)
    axes.set_axisbelow(True)


def _finish(figure: Figure, path: Path, title: str) -> None:
    figure.text(0.02, 1 - 0.25 / figure.get_figheight(), title, fontsize=13, color=_INK, va="center", fontweight="bold")
    save_figure(figure, path)
