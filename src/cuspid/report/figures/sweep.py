"""Pictures of the sweep of a pair of cameras: maps over baseline and axis angle with their numbers and the best places.

Everything comes as plain values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cuspid.report.figures.drawing import new_figure, save_figure

_INK = "#333333"
_MARKS = {"best": "#d12a1e", "thesis": "#111111"}
_DASHES: Mapping[str, tuple[float, tuple[float, ...]]] = {"best": (0.0, ()), "thesis": (0.0, (3.0, 2.0))}
_SIZES = {"best": 0.46, "thesis": 0.38}

Place = tuple[float, float]
"""A value on each axis."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SweepMap:
    """One figure over the grid."""

    title: str
    """Above it, with the unit."""
    values: Mapping[Place, float]
    """By baseline and angle; what is not there, because it failed, is left grey."""
    best: Place | None = None
    """Framed in red."""
    level: Sequence[Place] = ()
    """Marked with a dot: not worse than the best beyond the noise."""
    less_is_better: bool = False
    """Of errors; bright is good."""
    digits: int = 1
    """Decimals that are written."""


def save_sweep_picture(
    path: Path,
    maps: Sequence[SweepMap],
    baselines_mm: Sequence[float],
    angles_deg: Sequence[float],
    *,
    thesis: Place | None = None,
    title: str = "",
) -> None:
    """PNG: maps side by side, baselines upwards and angles to the right, with the thesis' place framed in each."""
    rows = -(-len(maps) // 2)
    figure = new_figure(10.0, 0.9 + (0.9 + 0.38 * len(baselines_mm)) * rows, dpi=84)
    grid = figure.subplots(rows, 2, squeeze=False).ravel()
    for axes, each in zip(grid, maps, strict=False):
        _draw(axes, each, tuple(baselines_mm), tuple(angles_deg), thesis)
    for axes in grid[len(maps) :]:
        axes.set_axis_off()
    height = figure.get_figheight()
    figure.tight_layout(rect=(0, 0.42 / height, 1, 1 - 0.5 / height), w_pad=2.5, h_pad=1.2)
    figure.text(0.02, 1 - 0.25 / height, title, fontsize=13, color=_INK, va="center", fontweight="bold")
    _explain(figure, thesis is not None)
    save_figure(figure, path)


def _draw(
    axes: Axes, each: SweepMap, baselines: tuple[float, ...], angles: tuple[float, ...], thesis: Place | None
) -> None:
    table = np.array([[each.values.get((baseline, angle), np.nan) for angle in angles] for baseline in baselines])
    colours = colormaps["viridis_r" if each.less_is_better else "viridis"].with_extremes(bad="#bbbbbb")
    norm = Normalize(*_limits(table))
    axes.imshow(np.ma.masked_invalid(table), origin="lower", aspect="auto", norm=norm, cmap=colours)
    _write(axes, each, baselines, angles, table, norm, colours)
    axes.set_yticks(range(len(baselines)), [f"{value:g}" for value in baselines])
    axes.set_xticks(range(len(angles)), [f"{value:g}" for value in angles])
    axes.set_ylabel("baseline / mm", color=_INK)
    axes.set_xlabel("angle of the axes / deg", color=_INK)
    axes.set_title(each.title, loc="left", fontsize=11, color=_INK)
    for kind, place in (("best", each.best), ("thesis", thesis)):
        if place is not None:
            _frame(axes, kind, angles.index(place[1]), baselines.index(place[0]))


def _limits(table: Float[np.ndarray, "m n"]) -> tuple[float, float]:
    """Never empty."""
    known = table[np.isfinite(table)]
    if not len(known):
        return 0.0, 1.0
    return float(known.min()), float(max(known.max(), known.min() + 1e-9))


def _write(
    axes: Axes,
    each: SweepMap,
    baselines: tuple[float, ...],
    angles: tuple[float, ...],
    table: Float[np.ndarray, "m n"],
    norm: Normalize,
    colours: Colormap,
) -> None:
    for (row, column), value in np.ndenumerate(table):
        if not np.isfinite(value):
            axes.text(column, row, "failed", ha="center", va="center", fontsize=8, color=_INK)
            continue
        red, green, blue, _ = colours(norm(value))
        dark = 0.3 * red + 0.59 * green + 0.11 * blue < 0.5
        mark = " •" if (baselines[row], angles[column]) in each.level else ""
        text = f"{value:,.{each.digits}f}{mark}"
        axes.text(column, row, text, ha="center", va="center", fontsize=9, color="white" if dark else _INK)


def _frame(axes: Axes, kind: str, column: int, row: int) -> None:
    size = _SIZES[kind]
    x, y = column + size * np.array([-1, 1, 1, -1, -1]), row + size * np.array([-1, -1, 1, 1, -1])
    axes.plot(x, y, color=_MARKS[kind], linestyle=_DASHES[kind], linewidth=2.0)


def _explain(figure: Figure, with_thesis: bool) -> None:
    kinds = {"best": "best of those repeated", "thesis": "best of the thesis"}
    lines = [
        Line2D([], [], color=_MARKS[kind], linestyle=_DASHES[kind], linewidth=2.0, label=text)
        for kind, text in kinds.items()
        if kind == "best" or with_thesis
    ]
    lines.append(Line2D([], [], color=_INK, linestyle="none", marker="o", markersize=3, label="level with the best"))
    figure.legend(handles=lines, loc="lower left", ncols=3, frameon=False, fontsize=9, bbox_to_anchor=(0.01, 0.0))
