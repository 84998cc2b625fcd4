"""Pictures of handpieces beside each other: how large they are, what their images buy, and which surfaces they miss.

Sections are drawn across the arch: y to the cheek, z up from the highest point of the tooth, mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray

from cuspid.report.figures.drawing import new_figure, save_figure

_INK, _GAP, _TOOTH = "#333333", "#c8501e", "#f3ead9"
_COLOURS = ("#3b7dd8", "#c8860a", "#3fa66b", "#8e5bb5", "#b8405e", "#5a6872", "#2a9d9d", "#8a6d3b")
_SHARES = LinearSegmentedColormap.from_list("shares", ["#f08a6b", "#fbe7a8", "#9fd8a4"])
"""From little to all."""
_TOOTH_MM = (9.0, 7.0)
"""Width and height of the drawn tooth."""
_LETTERS_PER_IN = 7.5
"""Of a bold title."""
_TICKS = (50, 100, 200, 300, 500, 1000, 2000, 3000)
"""Numbers of images that are named on an axis."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Curve:
    """A design with its numbers of turns."""

    turns: tuple[int, ...]
    """Ascending."""
    images: tuple[float, ...]
    """Taken with so many turns."""
    complete_pct: tuple[float, ...]
    """Share of the tooth that was reconstructed."""
    error_um: tuple[float, ...]
    """Mean absolute deviation of the tooth."""


def save_comparison_picture(
    path: Path,
    sections: Mapping[str, Sequence[Float[np.ndarray, "n 2"]]],
    panels: Mapping[str, Mapping[str, Curve]],
    gap_mm: float,
    *,
    title: str = "",
    within_um: int = 50,
) -> None:
    """PNG: sections of the holders, and below, for each jaw, completeness and error by the number of images.

    ``sections``: by design, outlines (y, z) of each pass; ``panels``: by jaw, the curve of each design;
    ``gap_mm``: room between the jaws, drawn over the sections.
    """
    colours = {name: _COLOURS[index % len(_COLOURS)] for index, name in enumerate(sections)}
    figure = new_figure(max(9.0, 3.3 * len(panels), 1.7 * len(sections)), 9.4, dpi=84, layout="constrained")
    halves: NDArray[np.object_] = np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 2.6)))
    above, below = halves
    wrapped = fill(title, int(_LETTERS_PER_IN * figure.get_figwidth()))
    above.suptitle(f"{wrapped}\n", x=0.01, ha="left", fontsize=14, color=_INK, fontweight="bold")
    _draw_sections(above.subplots(1, len(sections), squeeze=False)[0].tolist(), sections, colours, gap_mm)
    places = below.subplots(2, len(panels), squeeze=False)
    for (complete, error), (name, curves) in zip(places.T, panels.items(), strict=True):
        for design, curve in curves.items():
            _draw_curve(complete, curve.images, curve.complete_pct, curve.turns, colours[design])
            _draw_curve(error, curve.images, curve.error_um, curve.turns, colours[design])
        complete.set_title(name, loc="left", fontsize=12, color=_INK)
        error.set_xlabel("images (numbers at the points: turns)", color=_INK)
        for axes in (complete, error):
            _label_images(axes)
        error.set_ylim(0.0, 1.15 * max(np.nanmax(curve.error_um) for curve in curves.values()))
    places[0, 0].set_ylabel(f"tooth within {within_um} µm / %", color=_INK)
    places[1, 0].set_ylabel("mean deviation of the tooth / µm", color=_INK)
    handles = [Line2D([], [], color=colour, marker="o", label=name) for name, colour in colours.items()]
    below.legend(handles=handles, loc="outside lower center", ncols=6, frameon=False, fontsize=10)
    save_figure(figure, path)


def _draw_sections(
    places: Sequence[Axes],
    sections: Mapping[str, Sequence[Float[np.ndarray, "n 2"]]],
    colours: Mapping[str, str],
    gap: float,
) -> None:
    """Side by side, to one scale."""
    points = np.concatenate([outline for outlines in sections.values() for outline in outlines])
    half, top = np.abs(points[:, 0]).max() + 1, max(gap, points[:, 1].max()) + 2
    for axes, (name, outlines) in zip(places, sections.items(), strict=True):
        width, height = _TOOTH_MM
        axes.add_patch(Polygon(_rounded_box(width, height), facecolor=_TOOTH, edgecolor=_INK, linewidth=0.8))
        for outline in outlines:
            axes.add_patch(Polygon(outline, facecolor=colours[name], alpha=0.16, edgecolor="none"))
            axes.add_patch(Polygon(outline, facecolor="none", edgecolor=colours[name], linewidth=1.3))
        axes.axhline(gap, color=_GAP, linewidth=1.2, linestyle="--")
        swept = np.concatenate(list(outlines))
        size = f"{np.ptp(swept[:, 0]):.0f} x {swept[:, 1].max():.0f} mm"
        axes.set_title(f"{name}\n{size}", loc="left", fontsize=10, color=_INK)
        axes.set(xlim=(-half, half), ylim=(-_TOOTH_MM[1] - 1, top), aspect="equal")
        axes.set_axis_off()


def _rounded_box(width: float, height: float) -> Float[np.ndarray, "n 2"]:
    """A crown in section: flat below, its top at z = 0."""
    angle = np.linspace(0, np.pi, 40)
    shape = np.column_stack([np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.5, np.sin(angle) ** 0.5])
    return shape * [width / 2, height] - [0, height]


def _draw_curve(
    axes: Axes, images: Sequence[float], values: Sequence[float], turns: Sequence[int], colour: str
) -> None:
    axes.plot(images, values, "-o", color=colour, markersize=5, linewidth=1.4)
    if len(turns) > 1:
        for number, x, y in zip(turns, images, values, strict=True):
            axes.annotate(
                str(number), (x, y), (0, 6), textcoords="offset points", fontsize=9, color=colour, ha="center"
            )


def _label_images(axes: Axes) -> None:
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xticks([tick for tick in _TICKS if low <= tick <= high], minor=False)
    axes.set_xticklabels([str(tick) for tick in _TICKS if low <= tick <= high])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.margins(0.08, 0.12)


def save_surface_shares_picture(
    path: Path, panels: Mapping[str, Mapping[str, Mapping[str, float]]], *, title: str = ""
) -> None:
    """PNG: for each jaw a table of colours with a row for each design and a column for each surface, in %.

    ``panels``: by jaw and design, the share of each surface.
    """
    columns = {
        name: list(dict.fromkeys(s for shares in rows.values() for s in shares)) for name, rows in panels.items()
    }
    most = max(len(rows) for rows in panels.values())
    lines = -(-len(panels) // 2)
    widths = [max(map(len, list(columns.values())[k::2]), default=1) for k in range(min(2, len(panels)))]
    figure = new_figure(
        1.6 * len(widths) + 0.72 * sum(widths), 0.6 + lines * (1.2 + 0.3 * most), dpi=84, layout="constrained"
    )
    figure.suptitle(f"{title}\n", x=0.01, ha="left", fontsize=13, color=_INK, fontweight="bold")
    places = figure.subplots(lines, len(widths), squeeze=False, width_ratios=widths).ravel()
    for axes in places[len(panels) :]:
        axes.set_axis_off()
    for axes, (name, rows) in zip(places, panels.items(), strict=False):
        values = np.array([[shares.get(s, np.nan) for s in columns[name]] for shares in rows.values()])
        axes.imshow(values, cmap=_SHARES, vmin=0, vmax=100, aspect="auto")
        for (row, column), value in np.ndenumerate(values):
            if np.isfinite(value):
                axes.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=9, color=_INK)
        axes.set_xticks(range(len(columns[name])), columns[name], color=_INK, fontsize=9)
        axes.set_yticks(range(len(rows)), list(rows), color=_INK)
        axes.tick_params(length=0)
        axes.set_title(name, loc="left", fontsize=12, color=_INK)
        axes.spines[:].set_visible(False)
    save_figure(figure, path)
