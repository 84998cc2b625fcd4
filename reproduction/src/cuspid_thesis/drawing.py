"""Pictures of the reproduction of the thesis: its figures beside ours, on one scale."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cuspid.report.figures.drawing import new_figure, save_figure

_INK, _THESIS, _OURS = "#333333", "#9aa7b3", "#0b6e78"


def save_trueness_picture(
    path: Path, names: Sequence[str], thesis_um: Sequence[float], ours_um: Sequence[float | None], *, title: str
) -> None:
    """PNG: for each name the mean deviation of the thesis and ours (None: not run), on a logarithmic scale."""
    height = 1.1 + 0.42 * len(names)
    figure = new_figure(9.0, height, dpi=100)
    axes = figure.add_axes((0.24, 0.62 / height, 0.72, 1 - 1.15 / height))
    for place, printed, value in zip(range(len(names))[::-1], thesis_um, ours_um, strict=True):
        axes.axhline(place, color="#e3e8ec", linewidth=1, zorder=0)
        axes.plot(printed, place, "o", color=_THESIS, markersize=10)
        axes.text(printed * 1.15, place, f"{printed:g}", va="center", fontsize=10, color=_INK)
        if value is None:
            axes.text(0.55, place, "not run yet", va="center", fontsize=9, color=_OURS)
        else:
            axes.plot([value, printed], [place, place], color="#c4ced6", linewidth=2, zorder=1)
            axes.plot(value, place, "o", color=_OURS, markersize=10)
            axes.text(value / 1.15, place, f"{value:.1f}", va="center", ha="right", fontsize=10, color=_OURS)
    axes.set_xscale("log")
    axes.set_xlim(0.5, 800)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.set_xticks([1, 10, 100], ["1", "10", "100"])
    axes.set_yticks(range(len(names))[::-1], names, fontsize=10, color=_INK)
    axes.set_xlabel("mean absolute deviation / µm", color=_INK)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.plot([], [], "o", color=_THESIS, markersize=9, label="thesis")
    axes.plot([], [], "o", color=_OURS, markersize=9, label="cuspid")
    axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0), fontsize=10)
    figure.text(0.02, 1 - 0.22 / height, title, fontsize=13, color=_INK, va="center", fontweight="bold")
    save_figure(figure, path)


def save_ssim_picture(
    path: Path,
    subjects: Sequence[str],
    methods: Sequence[tuple[str, Sequence[float | None]]],
    grey: Sequence[float | None],
    *,
    title: str,
) -> None:
    """PNG: SSIM of each subject by each method, the thesis' limit, and what a grey outline scores (a line each)."""
    figure = new_figure(9.0, 4.6, dpi=100)
    axes = figure.add_axes((0.08, 0.19, 0.89, 0.61))
    places, width = np.arange(len(subjects)), 0.8 / max(len(methods), 1)
    for number, (name, values) in enumerate(methods):
        at = places - 0.4 + (number + 0.5) * width
        heights = np.array([np.nan if value is None else value for value in values])
        colour = (_OURS, "#d98e32", "#7a6fb0")[number % 3]
        axes.bar(at, heights, 0.92 * width, color=colour, label=name)
        axes.plot(at[heights == 0], np.full((heights == 0).sum(), 0.03), "x", color=colour, markersize=9)
    for place, value in zip(places, grey, strict=True):
        if value is not None:
            axes.plot([place - 0.45, place + 0.45], [value, value], color=_INK, linewidth=1.4)
    axes.plot([], [], color=_INK, linewidth=1.4, label="constant grey in the outline of the jaw")
    axes.axhline(0.70, color="#b3261e", linestyle="--", linewidth=1.2, label="the thesis: more than 0.70")
    axes.plot([], [], "x", color=_INK, markersize=8, label="failed")
    axes.set_ylim(0, 1)
    axes.set_ylabel("SSIM, whole canvas", color=_INK)
    axes.set_xticks(places, subjects, rotation=20, ha="right", fontsize=9, color=_INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9, ncols=3, loc="lower left", bbox_to_anchor=(-0.02, 1.0))
    figure.text(0.02, 0.955, title, fontsize=13, color=_INK, va="center", fontweight="bold")
    save_figure(figure, path)
