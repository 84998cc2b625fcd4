"""A picture of repeated scans: where they err together, where they scatter, and how each agrees with each other."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure

from cuspid.model.mesh import Mesh
from cuspid.report.figures.drawing import (
    NOT_COUNTED,
    OCCLUSAL,
    FigureOptions,
    deviation_map,
    fitting_range_um,
    new_figure,
    render,
    save_figure,
)

_INK = "#333333"
_MOST_NAMED = 12


def save_repeat_picture(
    path: Path,
    reference: Mesh,
    mean_um: Float[np.ndarray, "v"],
    sd_um: Float[np.ndarray, "v"],
    trueness_um: Mapping[str, float],
    pairs_um: Mapping[tuple[str, str], float],
) -> None:
    """PNG: the mean deviation and its standard deviation on the reference, and the matrix of all pairs, with the
    trueness of each scan on its diagonal. Vertices with NaN are not on all scans."""
    known = np.isfinite(sd_um)
    faces = faces_around(reference, known)
    shown, keep = reference.submesh(faces), np.unique(reference.faces[faces])
    figure = new_figure(15.0, 5.4, dpi=100)
    limit = fitting_range_um(float(np.percentile(np.abs(mean_um[known]), 95)))
    top = fitting_range_um(float(np.percentile(sd_um[known], 95)) / 2)
    diverging = deviation_map(FigureOptions())
    _draw_map(figure, 0.01, shown, mean_um[keep], (-limit, limit), diverging, "mean deviation / µm: systematic")
    _draw_map(figure, 0.35, shown, sd_um[keep], (0.0, top), "viridis", "SD over the scans / µm: random")
    _draw_matrix(figure.add_axes((0.73, 0.13, 0.25, 0.7)), trueness_um, pairs_um)
    save_figure(figure, path)


def faces_around(mesh: Mesh, known: Bool[np.ndarray, "v"], margin_mm: float = 2.0) -> Bool[np.ndarray, "f"]:
    """The faces in the box of some vertices and a margin."""
    low, high = mesh.vertices[known].min(axis=0) - margin_mm, mesh.vertices[known].max(axis=0) + margin_mm
    return np.asarray(((mesh.face_centres > low) & (mesh.face_centres < high)).all(axis=1))


def _draw_map(
    figure: Figure,
    left: float,
    mesh: Mesh,
    values: Float[np.ndarray, "v"],
    limits: tuple[float, float],
    colors: Colormap | str,
    label: str,
) -> None:
    scale = ScalarMappable(Normalize(*limits), colors)
    rgb = scale.to_rgba(np.nan_to_num(values), bytes=True)[:, :3]
    colored = Mesh(mesh.vertices, mesh.faces, np.where(np.isnan(values)[:, None], NOT_COUNTED, rgb).astype(np.uint8))
    axes = figure.add_axes((left, 0.13, 0.32, 0.80))
    axes.imshow(render(colored, OCCLUSAL, width_px=700).image)
    axes.set_axis_off()
    bar = figure.colorbar(scale, cax=figure.add_axes((left + 0.04, 0.10, 0.24, 0.022)), orientation="horizontal")
    bar.outline.set_visible(False)
    bar.set_label(label, fontsize=11, color=_INK)


def _draw_matrix(axes: Axes, trueness_um: Mapping[str, float], pairs_um: Mapping[tuple[str, str], float]) -> None:
    names = list(trueness_um)
    cells = np.full((len(names), len(names)), np.nan)
    for (first, second), value in pairs_um.items():
        row, column = names.index(first), names.index(second)
        cells[row, column] = cells[column, row] = value
    cells[np.diag_indices(len(names))] = list(trueness_um.values())
    axes.imshow(cells, cmap="YlGnBu", vmin=0, vmax=1.6 * float(np.nanmax(cells)))
    axes.set_title("mean |d| of each pair / µm;\ndiagonal: to the reference", fontsize=11, color=_INK, loc="left")
    if len(names) > _MOST_NAMED:
        return
    axes.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=9)
    axes.set_yticks(range(len(names)), names, fontsize=9)
    for row, column in np.ndindex(cells.shape):
        if np.isfinite(cells[row, column]):
            weight = "bold" if row == column else "normal"
            axes.text(column, row, f"{cells[row, column]:.2f}", ha="center", va="center", fontsize=9, fontweight=weight)
