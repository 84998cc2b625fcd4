"""Pictures of the room in a mouth: the sagittal plane to scale, and whom a handpiece fits.

Places are (x forwards, z upwards) of the hinge axis of the closed mouth, mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from cuspid.report.figures.drawing import new_figure, save_figure

TOOTH_NAMES = (
    "central incisor",
    "lateral incisor",
    "canine",
    "first premolar",
    "second premolar",
    "first molar",
    "second molar",
)
_INK, _FAINT, _GAP, _PROBE = "#333333", "#9a9a9a", "#c8501e", "#1f5fd6"
_TOOTH, _GUM = "#f3ead9", "#cfa39a"
_CROWN_MM = 8.0
"""Height of the drawn crowns."""
_PROBE_MM = 78.0
"""Length of the drawn handpiece."""
_COLOURS = ("#1f5fd6", "#c8501e")


def save_sagittal_picture(
    path: Path,
    upper_mm: Float[np.ndarray, "k 2"],
    lower_mm: Float[np.ndarray, "k 2"],
    condyle_mm: Float[np.ndarray, "2"],
    arcs_mm: tuple[Float[np.ndarray, "a 2"], Float[np.ndarray, "a 2"]],
    thickness_mm: float,
    working_distance_mm: float,
    *,
    title: str = "",
) -> None:
    """PNG of the sagittal plane to scale, closed and open, with a handpiece over the lower teeth.

    ``upper_mm``: the incisal edges and the distal ends of the teeth, front to back, with the mouth closed;
    ``lower_mm``: the same of the lower jaw with the mouth open; ``condyle_mm``: the condyle then (closed: 0, 0);
    ``arcs_mm``: trajectories of the lower incisal edges and of the last tooth's end.
    """
    figure = new_figure(11.0, 8.6, dpi=110)
    figure.text(0.03, 0.965, title, fontsize=15, color=_INK, va="center", fontweight="bold")
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.91))
    _draw_teeth(axes, upper_mm, np.array([0.0, 1.0]))
    along = (lower_mm[0] - lower_mm[-1]) / np.linalg.norm(lower_mm[0] - lower_mm[-1])
    normal = np.array([-along[1], along[0]])
    _draw_teeth(axes, lower_mm, -normal)
    _draw_hinge(axes, upper_mm, lower_mm, condyle_mm, arcs_mm)
    _draw_probe(axes, lower_mm[-1], along, normal, thickness_mm, working_distance_mm)
    _draw_gap(axes, upper_mm[-1], lower_mm[-1], "L", -6.0)
    _draw_gap(axes, upper_mm[0], lower_mm[0], "opening", 5.0)
    _draw_scale(axes, float(upper_mm[0, 0]), float(lower_mm[:, 1].min()) - 16)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.margins(0.06)
    axes.set_axis_off()
    save_figure(figure, path)


def _draw_teeth(axes: Axes, edge: Float[np.ndarray, "k 2"], rootwards: Float[np.ndarray, "2"]) -> None:
    """Crowns between the ends of the teeth, and the gum behind them."""
    gum = [edge[0] + _CROWN_MM * rootwards, edge[-1] + _CROWN_MM * rootwards]
    axes.add_patch(Polygon([*gum, gum[1] + 5 * rootwards, gum[0] + 5 * rootwards], facecolor=_GUM, edgecolor="none"))
    for front, back in pairwise(edge):
        corners = [front, back, back + _CROWN_MM * rootwards, front + _CROWN_MM * rootwards]
        axes.add_patch(Polygon(corners, facecolor=_TOOTH, edgecolor=_INK, linewidth=0.8, joinstyle="round"))


def _draw_hinge(
    axes: Axes,
    upper: Float[np.ndarray, "k 2"],
    lower: Float[np.ndarray, "k 2"],
    condyle: Float[np.ndarray, "2"],
    arcs: tuple[Float[np.ndarray, "a 2"], Float[np.ndarray, "a 2"]],
) -> None:
    """Condyle closed and open, lines from it to incisors and last molar, their trajectories, and the occlusal plane."""
    axes.add_patch(Circle((0, 0), 4.5, facecolor="#ececec", edgecolor=_FAINT))
    axes.add_patch(Circle((float(condyle[0]), float(condyle[1])), 4.5, facecolor="none", edgecolor=_INK))
    axes.annotate("", tuple(condyle), (0, 0), arrowprops={"arrowstyle": "->", "color": _INK})
    axes.text(-7, 5, "condyle", fontsize=11, color=_INK, ha="right")
    axes.plot([0, upper[0, 0]], [upper[0, 1]] * 2, color=_FAINT, linewidth=1, linestyle=":")
    axes.plot([0, 0], [0, upper[0, 1]], color=_FAINT, linewidth=1, linestyle=":")
    turn = -np.rad2deg(np.arctan2(*(lower[0] - lower[-1])[::-1]))
    angle = np.rad2deg(np.arctan2(-upper[0, 1], upper[0, 0]))
    sizes = (
        f"r = {np.linalg.norm(upper[0]):.1f} mm\nα = {angle:.1f}°\nθ = {turn:.1f}°\n"
        f"condyle slides {np.linalg.norm(condyle):.1f} mm"
    )
    axes.text(upper[0, 0], 0, sizes, fontsize=11, color=_INK, ha="right", va="center", linespacing=1.5)
    axes.text(-1.5, upper[0, 1] / 2, f"h = {-upper[0, 1]:.1f}", fontsize=11, color=_INK, ha="right")
    for start, points, style in ((np.zeros(2), upper, "--"), (condyle, lower, "-")):
        for end in (points[0], points[-1]):
            axes.plot(*np.column_stack([start, end]), color=_FAINT, linewidth=1, linestyle=style, zorder=0)
    for arc in arcs:
        axes.plot(arc[:, 0], arc[:, 1], color=_INK, linewidth=1.2, linestyle=(0, (1, 1.5)))


def _draw_probe(
    axes: Axes,
    corner: Float[np.ndarray, "2"],
    along: Float[np.ndarray, "2"],
    normal: Float[np.ndarray, "2"],
    thickness: float,
    distance: float,
) -> None:
    """The handpiece parallel to the lower teeth, its tip over the end of the last one."""
    low = corner + distance * normal
    corners = [low, low + _PROBE_MM * along, low + _PROBE_MM * along + thickness * normal, low + thickness * normal]
    axes.add_patch(Polygon(corners, facecolor=_PROBE, alpha=0.22, edgecolor="none"))
    axes.add_patch(Polygon(corners, facecolor="none", edgecolor=_PROBE, linewidth=1.4))
    place = low + 0.78 * _PROBE_MM * along + thickness / 2 * normal
    turn = float(np.rad2deg(np.arctan2(along[1], along[0])))
    text = f"handpiece {thickness:.4g} mm, at {distance:.4g} mm"
    axes.text(place[0], place[1], text, fontsize=11, color=_PROBE, ha="center", va="center", rotation=turn)


def _draw_gap(
    axes: Axes, upper: Float[np.ndarray, "2"], lower: Float[np.ndarray, "2"], name: str, aside: float
) -> None:
    axes.annotate("", tuple(upper), tuple(lower), arrowprops={"arrowstyle": "<->", "color": _GAP, "linewidth": 1.8})
    place = (upper + lower) / 2 + [aside, 0]
    text = f"{name} = {np.linalg.norm(upper - lower):.1f}"
    side = "left" if aside > 0 else "right"
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
    axes.text(place[0], place[1], text, fontsize=12, color=_GAP, va="center", ha=side, bbox=box)


def _draw_scale(axes: Axes, right: float, z: float) -> None:
    axes.plot([right - 20, right], [z, z], color=_INK, linewidth=3, solid_capstyle="butt")
    axes.text(right + 2, z, "20 mm", fontsize=11, color=_INK, va="center")


def save_fit_picture(
    path: Path,
    needed_mm: Float[np.ndarray, "t"],
    share_pct: Mapping[str, Float[np.ndarray, "t 7"]],
    total_mm: float,
    *,
    title: str = "",
) -> None:
    """PNG: for each group, share of people with at least the needed room at each tooth; ``total_mm`` is marked."""
    figure = new_figure(12.0, 5.2, dpi=110)
    figure.text(0.03, 0.955, title, fontsize=15, color=_INK, va="center", fontweight="bold")
    for place, (group, shares) in enumerate(share_pct.items()):
        axes = figure.add_axes((0.07 + 0.48 * place, 0.12, 0.42, 0.73))
        for tooth, name in reversed(list(enumerate(TOOTH_NAMES))):
            colour = (0.12 + 0.10 * tooth, 0.40 - 0.03 * tooth, 0.85 - 0.10 * tooth)
            axes.plot(needed_mm, shares[:, tooth], color=colour, linewidth=2.4 if tooth == 6 else 1.3, label=name)
        axes.axvline(total_mm, color=_FAINT, linewidth=1, linestyle="--")
        axes.text(total_mm, 60, f" {total_mm:g} mm", fontsize=10, color=_INK)
        _style(axes, "thickness + working distance + clearance / mm", "share of people / %")
        axes.set_ylim(0, 101)
        axes.set_xlim(needed_mm[0], needed_mm[-1])
        axes.set_title(group, loc="left", fontsize=13, color=_INK)
        if place == 0:
            axes.legend(frameon=True, framealpha=1, edgecolor="white", fontsize=10, loc="lower left")
    save_figure(figure, path)


def save_gap_picture(
    path: Path,
    gap_mm: Mapping[str, Float[np.ndarray, "n"]],
    printed_mm: tuple[float, float],
    *,
    title: str = "",
) -> None:
    """PNG: distribution of the gap at the second molar by group, and the range that the thesis prints."""
    figure = new_figure(9.0, 5.0, dpi=110)
    figure.text(0.03, 0.955, title, fontsize=15, color=_INK, va="center", fontweight="bold")
    axes = figure.add_axes((0.08, 0.13, 0.88, 0.74))
    top = max(float(np.percentile(gap, 99.8)) for gap in gap_mm.values())
    edges = np.linspace(0, top, 90)
    for colour, (group, gap) in zip(_COLOURS, gap_mm.items(), strict=False):
        low, median, high = np.percentile(gap, [5, 50, 95])
        label = f"{group}: median {median:.1f}, 5-95 %: {low:.1f}-{high:.1f} mm"
        share = np.full(len(gap), 100 / len(gap) / (edges[1] - edges[0]))
        axes.hist(gap, bins=edges.tolist(), weights=share, histtype="stepfilled", color=colour, alpha=0.35, label=label)
        axes.hist(gap, bins=edges.tolist(), weights=share, histtype="step", color=colour, linewidth=1.5)
    axes.axvspan(*printed_mm, color=_FAINT, alpha=0.18, label="thesis, Eq. 2.4: {:g}-{:g} mm".format(*printed_mm))
    axes.set_xlim(0, top)
    axes.set_ylim(0, 1.35 * axes.get_ylim()[1])
    axes.legend(frameon=False, fontsize=11, loc="upper left")
    _style(axes, "gap L at the distal end of the second molar / mm", "share of people / % per mm")
    save_figure(figure, path)


def _style(axes: Axes, x: str, y: str) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel(x, fontsize=12, color=_INK)
    axes.set_ylabel(y, fontsize=12, color=_INK)
    axes.grid(alpha=0.25)
