"""Pictures of prepared teeth: each enlarged from two sides, its lines drawn on it.

Meshes lie in the occlusal frame (mm).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.report.figures.drawing import OCCLUSAL, look, new_figure, render, save_figure
from cuspid.runtime.errors import InputError

_INK = "#333333"
_LINE = "#c1121f"
_TOOTH = (228, 218, 196)
_OTHER = (206, 212, 218)
_GUM = (222, 160, 156)
_ROOM_MM = 1.6
"""Surroundings that are shown to either side."""


def save_preparation_picture(path: Path, jaw: Jaw, *, title: str = "", width_px: int = 460) -> None:
    """PNG of every tooth of a jaw that has a line ``<FDI>.<name>``: occlusal, and obliquely from outside.

    Raises InputError where no tooth has a line.
    """
    teeth = sorted({int(name.split(".")[0]) for name in jaw.lines if name.split(".")[0].isdigit()})
    if not teeth:
        raise InputError("preparation picture: the jaw has no prepared tooth (no line such as 45.margin)")
    figure = new_figure(3.1 * len(teeth), 6.4, dpi=110)
    figure.text(0.02, 0.965, title, fontsize=14, color=_INK, va="center", fontweight="bold")
    for column, fdi in enumerate(teeth):
        near = _surroundings(jaw, fdi)
        lines = [line for name, line in jaw.lines.items() if name in (f"{fdi}.margin", f"{fdi}.crack")]
        x, y, _ = near.vertices[near.faces].reshape(-1, 3).mean(axis=0)
        outside = look(float(np.rad2deg(np.arctan2(y, x))), 48.0)
        for row, axes in enumerate((OCCLUSAL, outside)):
            place = (column / len(teeth) + 0.004, 0.47 - 0.46 * row, 1 / len(teeth) - 0.008, 0.44)
            _draw(figure, place, near, axes, lines, width_px)
        figure.text((column + 0.5) / len(teeth), 0.925, f"FDI {fdi}", fontsize=12, color=_INK, ha="center")
    save_figure(figure, path)


def _surroundings(jaw: Jaw, fdi: int) -> Mesh:
    """The surface about a tooth, coloured by what it is."""
    mesh, mine = jaw.mesh, jaw.tooth_faces(fdi)
    assert jaw.face_labels is not None
    bounds = mesh.submesh(mine).bounds
    centre, half = bounds.mean(axis=0), np.ptp(bounds, axis=0).max() / 2 + _ROOM_MM
    centres = mesh.face_centres
    keep = (np.abs(centres[:, :2] - centre[:2]) < half).all(axis=1) & (centres[:, 2] > bounds[0, 2] - _ROOM_MM)
    colors = np.empty((len(mesh.vertices), 3), dtype=np.uint8)
    for faces, color in ((jaw.face_labels == GUM, _GUM), (jaw.face_labels != GUM, _OTHER), (mine, _TOOTH)):
        colors[mesh.faces[faces]] = color
    return replace(mesh, colors=colors).submesh(keep)


def _draw(
    figure: Figure,
    place: tuple[float, float, float, float],
    mesh: Mesh,
    axes: Float[np.ndarray, "3 3"],
    lines: list[Float[np.ndarray, "_ 3"]],
    width_px: int,
) -> None:
    """One view, with those parts of the lines that can be seen."""
    view = render(mesh, axes, width_px=width_px)
    seen = mesh.vertices @ axes.T
    margin = 0.02 * np.ptp(seen, axis=0)[:2].max()
    left, top = seen[:, 0].min() - margin, seen[:, 1].max() + margin
    height, width = (view.mm_per_px * pixels for pixels in view.image.shape[:2])
    panel = figure.add_axes(place)
    panel.imshow(view.image, extent=(left, left + width, top - height, top), interpolation="antialiased")
    for line in lines:
        hidden = mesh.occluded(line + 0.03 * axes[2], line + 60.0 * axes[2], 0.02)
        drawn = np.where(hidden[:, None], np.nan, line @ axes.T)
        panel.plot(drawn[:, 0], drawn[:, 1], color=_LINE, linewidth=1.0)
    panel.set_axis_off()
    panel.set_anchor("C")
