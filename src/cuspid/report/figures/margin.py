"""Pictures of the edge of a preparation: sections across it, of the scan and of the reference."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from cuspid.model.trueness import CutMargin, MarginSection
from cuspid.report.figures.drawing import new_figure, save_figure

_INK, _SOLID, _TRUE, _FOUND = "#333333", "#e6e1d6", "#6f6a5f", "#c1121f"
_SECTIONS = 4
_HALF_MM, _ABOVE_MM, _BELOW_MM = 0.42, 0.17, 0.43
"""What a section shows beside, above and below the line."""
_BAR_MM = 0.1


def save_margin_picture(path: Path, margins: Mapping[int, CutMargin]) -> None:
    """PNG: for each tooth its margin line in plan, and sections evenly along what is evaluated of it.

    In each, the reference is filled, and the edge of the scan has its distance from the true line in um.
    """
    rows = sorted(margins.items())
    figure = new_figure(13.0, 2.25 * len(rows) + 0.6, dpi=110, layout="constrained")
    grid = np.asarray(figure.subplots(len(rows), 1 + _SECTIONS, squeeze=False))
    for panels, (fdi, margin) in zip(grid, rows, strict=True):
        chosen = _evenly(margin.sections)
        _draw_plan(panels[0], fdi, margin, chosen)
        for number, (panel, section) in enumerate(zip(panels[1:], chosen, strict=False), start=1):
            _draw_section(panel, number, section)
        for panel in panels:
            panel.set_axis_off()
    key = (("true surface", _TRUE), ("scan", _FOUND))
    lines = [grid[0, 1].plot([], [], color=color, linewidth=1.8, label=label)[0] for label, color in key]
    figure.legend(handles=lines, loc="outside upper right", ncols=2, frameon=False, fontsize=11, labelcolor=_INK)
    save_figure(figure, path)


def _evenly(sections: tuple[MarginSection, ...]) -> list[MarginSection]:
    """Some of them, in the middles of as many stretches of equal length."""
    count = min(_SECTIONS, len(sections))
    return [sections[int((k + 0.5) * len(sections) / count)] for k in range(count)]


def _draw_plan(axes: Axes, fdi: int, margin: CutMargin, chosen: list[MarginSection]) -> None:
    axes.plot(*margin.line[:, :2].T, color=_TRUE, linewidth=1.5)
    middle = margin.line[:, :2].mean(axis=0)
    for number, section in enumerate(chosen, start=1):
        place = section.place_mm[:2]
        out = (place - middle) / max(float(np.linalg.norm(place - middle)), 1e-9)
        axes.plot(*place, "o", color=_INK, markersize=4)
        x, y = place + 0.9 * out
        axes.text(float(x), float(y), str(number), fontsize=11, color=_INK, ha="center", va="center")
    axes.set_title(f"FDI {fdi}", fontsize=12, color=_INK, fontweight="bold")
    axes.margins(0.2)
    axes.set_aspect("equal")


def _draw_section(axes: Axes, number: int, section: MarginSection) -> None:
    solid = _close_section(section.reference)
    axes.fill(*solid.T, color=_SOLID, linewidth=0)
    axes.plot(*section.reference.T, color=_TRUE, linewidth=1.8)
    if section.scan is not None:
        axes.plot(*section.scan.T, color=_FOUND, linewidth=1.8)
    if section.scan_edge is not None:
        axes.plot(*section.scan_edge, "o", color=_FOUND, markersize=5)
    axes.set_title(f"{number}: {_section_caption(section)}", fontsize=11, color=_INK)
    left, low = -0.12, -_BELOW_MM + 0.03
    axes.plot([left, left + _BAR_MM], [low, low], color=_INK, linewidth=2)
    axes.text(left + _BAR_MM + 0.02, low, f"{1000 * _BAR_MM:.0f} µm", fontsize=9, color=_INK, va="center")
    axes.set_xlim(-_HALF_MM, _HALF_MM)
    axes.set_ylim(-_BELOW_MM, _ABOVE_MM)
    axes.set_aspect("equal")


def _close_section(section: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "k 2"]:
    """The polygon of a section and what lies inside of it, beyond the edges of the picture."""
    rightwards = section if section[0, 0] < section[-1, 0] else section[::-1]
    far, deep = 2 * _HALF_MM, 2 * _BELOW_MM
    return np.array([*rightwards, [far, rightwards[-1, 1]], [far, -deep], [-far, -deep], [-far, rightwards[0, 1]]])


def _section_caption(section: MarginSection) -> str:
    if section.scan is None:
        return "not scanned"
    if section.scan_edge is None:
        return "no edge found"
    return f"{1000 * np.linalg.norm(section.scan_edge):.0f} µm"
