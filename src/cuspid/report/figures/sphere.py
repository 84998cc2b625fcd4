"""Pictures of how well a scan holds the spheres of a metrology object, seen in the occlusal frame of the reference."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from cuspid.model.jaw import Jaw
from cuspid.report.figures.drawing import new_figure, save_figure

_INK, _FAINT, _LINE = "#333333", "#9a9a9a", "#1f5fd6"
_COLOURS = "YlOrRd"


def save_sphere_picture(
    path: Path,
    reference: Jaw,
    form_um: Mapping[str, float],
    nominal_mm: Float[np.ndarray, "p"],
    spacing_error_um: Float[np.ndarray, "p"],
    named_um: Mapping[str, float],
    scale_ppm: float,
    *,
    title: str = "",
) -> None:
    """PNG: the spheres of the reference in plan, coloured by form error, and the spacing errors over distance.

    ``form_um``: RMS form error by label; a sphere that is not in it is drawn as not measured. ``named_um``: errors of
    distances to be written into the plan, by "<label>-<label>". ``scale_ppm``: slope of the line through zero.
    """
    figure = new_figure(13.0, 6.4, dpi=110)
    figure.text(0.03, 0.955, title, fontsize=16, color=_INK, va="center", fontweight="bold")
    _draw_plan(figure, reference, form_um, named_um)
    _draw_spacing(figure.add_axes((0.60, 0.13, 0.38, 0.73)), nominal_mm, spacing_error_um, scale_ppm)
    save_figure(figure, path)


def _draw_plan(figure: Figure, reference: Jaw, form_um: Mapping[str, float], named_um: Mapping[str, float]) -> None:
    axes = figure.add_axes((0.02, 0.16, 0.52, 0.76))
    colours = ScalarMappable(Normalize(0, max([*form_um.values(), 1e-9])), _COLOURS)
    for label, sphere in reference.spheres.items():
        known = label in form_um
        face = colours.to_rgba(np.array(form_um[label])) if known else "white"
        place = (float(sphere.centre[0]), float(sphere.centre[1]))
        axes.add_patch(Circle(place, sphere.radius_mm, facecolor=face, edgecolor=_INK, hatch=None if known else "///"))
        _draw_label(axes, reference, label, form_um.get(label))
    _draw_named(axes, reference, named_um)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.margins(0.10)
    axes.set_axis_off()
    bar = figure.colorbar(colours, cax=figure.add_axes((0.10, 0.10, 0.36, 0.022)), orientation="horizontal")
    bar.outline.set_visible(False)
    bar.set_label("form error of the sphere / µm (RMS); hatched: not measured", fontsize=11, color=_INK)


def _draw_label(axes: Axes, reference: Jaw, label: str, form_um: float | None) -> None:
    """Number and form error beside a sphere, on the outer side of the arch."""
    centres = np.array([sphere.centre[:2] for sphere in reference.spheres.values()])
    inside = np.array([0.0, centres[:, 1].min() + 0.35 * np.ptp(centres[:, 1])])
    sphere = reference.spheres[label]
    outwards = sphere.centre[:2] - inside
    place = sphere.centre[:2] + outwards / np.linalg.norm(outwards) * (sphere.radius_mm + 2.6)
    text = label if form_um is None else f"{label}\n{form_um:.1f}"
    axes.text(place[0], place[1], text, fontsize=10, color=_INK, ha="center", va="center", linespacing=1.0)


def _draw_named(axes: Axes, reference: Jaw, named_um: Mapping[str, float]) -> None:
    """Lines between spheres with the errors of their distances; the text of crossing lines lies off their middle."""
    for name, error in named_um.items():
        first, second = (reference.spheres[label].centre[:2] for label in name.split("-"))
        axes.plot(*np.column_stack([first, second]), color=_LINE, linewidth=1.0, alpha=0.55, zorder=0)
        level = abs(first[1] - second[1]) < 0.2 * abs(first[0] - second[0])
        x, y = first + (0.5 if level else 0.24) * (second - first)
        axes.text(
            x,
            y,
            f"{error:+.1f}",
            fontsize=11,
            color=_LINE,
            ha="center",
            va="center",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        )


def _draw_spacing(
    axes: Axes, nominal_mm: Float[np.ndarray, "p"], error_um: Float[np.ndarray, "p"], scale_ppm: float
) -> None:
    axes.axhline(0, color=_FAINT, linewidth=1)
    axes.scatter(nominal_mm, error_um, s=18, color=_LINE, alpha=0.7, linewidths=0)
    reach = np.array([0, 1.05 * np.max(nominal_mm)])
    axes.plot(reach, 1e-3 * scale_ppm * reach, color="#c8501e", linewidth=1.5, label=f"scale {scale_ppm:+.0f} ppm")
    axes.set_xlim(*reach)
    low, high = min(error_um.min(), 0.0), max(error_um.max(), 0.0)
    spare = 0.15 * max(high - low, 0.1)
    axes.set_ylim(low - spare, high + spare)
    axes.set_xlabel("distance between two spheres / mm", fontsize=12, color=_INK)
    axes.set_ylabel("sphere-spacing error / µm", fontsize=12, color=_INK)
    axes.legend(frameon=False, fontsize=11, loc="upper left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title("all pairs", loc="left", fontsize=12, color=_INK)
