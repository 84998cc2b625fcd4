"""Pictures of landmarks on a jaw, and of the lengths that are measured between them.

Jaws lie in the occlusal frame (mm) and are seen from the occlusal side, anterior upwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cuspid.model.jaw import GUM, Jaw, Landmark
from cuspid.model.mesh import Mesh
from cuspid.report.figures.drawing import OCCLUSAL, new_figure, render, save_figure
from cuspid.runtime.errors import InputError

_INK = "#333333"
_COLORS = {"cusp": "#c4262e", "groove": "#1f5fd6", "angle": "#8a3ab9", "edge": "#8a3ab9", "cervix": "#1d7d4f"}
"""Colour of a point by the last word of its name; others are the midline's."""
_MIDLINE_COLOR = "#d97706"
_PAINT = np.array([[232, 196, 188], [238, 232, 218], [214, 224, 233]], dtype=np.uint8)
"""Gum, and teeth by turns."""
Extent = tuple[float, float, float, float]
"""Left, right, bottom and top of a picture, mm."""


def save_landmark_picture(path: Path, jaw: Jaw, teeth: Sequence[int] = (), *, title: str = "") -> None:
    """PNG of a jaw with its landmarks, and of some of its teeth enlarged with the names of theirs."""
    columns = max(1, (len(teeth) + 1) // 2)
    figure = new_figure(7.4 + 3.4 * (columns if teeth else 0), 6.6, dpi=78)
    share = 7.0 / figure.get_size_inches()[0]
    _draw_points(_jaw_axes(figure, (0.01, 0.03, share, 0.89), paint_jaw(jaw), 900), jaw.landmarks, size=4.0)
    width = (0.99 - share) / columns
    for k, fdi in enumerate(teeth):
        place = (share + 0.01 + (k // 2) * width, 0.50 - 0.46 * (k % 2), width - 0.01, 0.40)
        _draw_tooth(figure, place, jaw, fdi)
    figure.text(0.02, 0.955, title, fontsize=15, color=_INK, va="center", fontweight="bold")
    save_figure(figure, path)


def save_measure_picture(
    path: Path,
    jaw: Jaw,
    lines: Mapping[str, Sequence[str]],
    values_mm: Mapping[str, float],
    *,
    title: str = "",
) -> None:
    """PNG of lengths drawn over a jaw.

    ``lines`` names the landmarks that each length is between: two, or three for the one from the first to the middle of
    the others; ``values_mm`` are written beside them. Raises InputError where the jaw lacks a landmark.
    """
    figure = new_figure(8.4, 6.6, dpi=78)
    axes = _jaw_axes(figure, (0.02, 0.03, 0.96, 0.89), paint_jaw(jaw), 900)
    for name, labels in lines.items():
        _draw_length(axes, name, _ends(jaw.landmarks, labels), values_mm[name])
    figure.text(0.03, 0.955, title, fontsize=15, color=_INK, va="center", fontweight="bold")
    save_figure(figure, path)


def paint_jaw(jaw: Jaw) -> Mesh:
    """The mesh of a jaw with gum and teeth in quiet colours of their own."""
    if jaw.face_labels is None:
        return replace(jaw.mesh, colors=None)
    labels = np.full(len(jaw.mesh.vertices), GUM)
    labels[jaw.mesh.faces.ravel()] = np.repeat(jaw.face_labels, 3)
    return replace(jaw.mesh, colors=_PAINT[np.where(labels == GUM, 0, 1 + labels % 2)])


def _jaw_axes(figure: Figure, place: Extent, mesh: Mesh, width_px: int) -> Axes:
    """A picture of a mesh whose axes are X and Y in mm."""
    axes = figure.add_axes(place)
    view = render(mesh, OCCLUSAL, width_px=width_px, supersampling=1)
    low, high = mesh.bounds
    margin = 0.02 * (high - low)[:2].max()
    height, width = view.image.shape[:2]
    left, top = low[0] - margin, high[1] + margin
    extent = (left, left + width * view.mm_per_px, top - height * view.mm_per_px, top)
    axes.imshow(view.image, extent=extent, interpolation="antialiased")
    axes.set_axis_off()
    return axes


def _draw_points(axes: Axes, landmarks: Mapping[str, Landmark], *, size: float) -> None:
    for label, point in landmarks.items():
        x, y = point.position[:2]
        hollow = point.estimated_sigma_mm is not None
        axes.plot(
            x,
            y,
            "o",
            markersize=size,
            markerfacecolor="white" if hollow else _color(label),
            markeredgecolor=_color(label) if hollow else "white",
            markeredgewidth=1.0 if hollow else 0.4,
        )


def _color(label: str) -> str:
    return next((color for word, color in _COLORS.items() if word in label), _MIDLINE_COLOR)


def _draw_tooth(figure: Figure, place: Extent, jaw: Jaw, fdi: int) -> None:
    """One tooth enlarged, the names of its points in a column beside it."""
    near = jaw.mesh.vertices[np.unique(jaw.mesh.faces[jaw.tooth_faces(fdi)])]
    middle = (near.min(axis=0) + near.max(axis=0))[:2] / 2
    reach = 0.62 * np.ptp(near[:, :2], axis=0).max()
    close = np.all(np.abs(jaw.mesh.face_centres[:, :2] - middle) < reach, axis=1)
    axes = _jaw_axes(figure, place, paint_jaw(jaw).submesh(close), 420)
    own = {label: point for label, point in jaw.landmarks.items() if label.startswith(f"{fdi}.")}
    _draw_points(axes, own, size=6.5)
    axes.set_title(str(fdi), fontsize=12, color=_INK, loc="left", pad=2)
    for rank, (label, point) in enumerate(sorted(own.items(), key=lambda item: -item[1].position[1])):
        x, y = point.position[:2]
        height = middle[1] + reach * (0.8 - 1.6 * rank / max(1, len(own) - 1))
        axes.annotate(
            label.partition(".")[2],
            (x, y),
            (middle[0] + 1.15 * reach, height),
            fontsize=9,
            color=_color(label),
            va="center",
            arrowprops={"arrowstyle": "-", "color": _color(label), "linewidth": 0.7},
        )
    axes.set_xlim(middle[0] - reach, middle[0] + 2.6 * reach)
    axes.set_ylim(middle[1] - reach, middle[1] + reach)


def _ends(landmarks: Mapping[str, Landmark], labels: Sequence[str]) -> Float[np.ndarray, "2 3"]:
    """The two ends of a length."""
    lacking = [label for label in labels if label not in landmarks]
    if lacking:
        raise InputError(f"picture: the jaw has no landmark {', '.join(lacking)}")
    first, *others = (landmarks[label].position for label in labels)
    return np.stack([first, np.mean(others, axis=0)])


def _draw_length(axes: Axes, name: str, ends: Float[np.ndarray, "2 3"], value_mm: float) -> None:
    (x0, y0), (x1, y1) = ends[:, :2]
    axes.annotate("", (x1, y1), (x0, y0), arrowprops={"arrowstyle": "<->", "color": "#1f5fd6", "linewidth": 1.6})
    along = 0.25 if abs(x1 - x0) > abs(y1 - y0) else 0.45
    axes.text(
        x0 + along * (x1 - x0),
        y0 + along * (y1 - y0),
        f"{name} = {value_mm:.1f} mm",
        fontsize=11,
        color="#1f5fd6",
        ha="center",
        va="center",
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.9},
        zorder=4,  # over the arrows of other lengths, too
    )
