"""Pictures of a shape model: its mean, its modes to either side of the mean, and how much each of them explains.

All jaws are drawn to one scale in the mean's frame (mm), seen from the occlusal side.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize

from cuspid.model.mesh import Mesh
from cuspid.model.shape_model import ShapeModel
from cuspid.report.figures.drawing import OCCLUSAL, new_figure, render, save_figure

_INK = "#333333"
_MARGIN = 0.02
"""Of a rendered view, as a share of its longer side."""
SHIFT_COLORS = LinearSegmentedColormap.from_list("shift", ["#1f5fd6", "#a9c4ee", "#ded6c8", "#f3b98a", "#c2410c"])
"""Of a shift along the normals: blue inwards, the colour of plaster for none, orange outwards."""


def save_modes_picture(path: Path, model: ShapeModel, *, modes: int = 3, deviations: float = 2.0) -> None:
    """PNG: a row for each of the first modes, with the jaw at minus, zero and plus some standard deviations.

    Colour shows how far the surface moved along the normals of the mean.
    """
    count = min(modes, len(model.modes))
    weights = (-deviations, 0.0, deviations)
    jaws = [[model.sample([0.0] * mode + [weight]).mesh for weight in weights] for mode in range(count)]
    shifts = [[_outward_shift(model.mean.mesh, jaw) for jaw in row] for row in jaws]
    limit = float(np.percentile(np.abs(shifts), 99.5)) or 1.0
    low, high = _frame([jaw for row in jaws for jaw in row])
    row_in = float(3.6 * (high - low)[1] / (high - low)[0]) + 0.4
    figure = new_figure(12.0, 0.1 + row_in * count, dpi=100)
    for mode in range(count):
        for column, weight in enumerate(weights):
            axes = figure.add_subplot(count, 3, 3 * mode + column + 1)
            _draw(axes, replace(jaws[mode][column], colors=_colors(shifts[mode][column], limit)), low, high)
            share = f"mode {mode + 1}, {100 * model.variance_shares[mode]:.0f} % of the variance: "
            axes.set_title(
                f"{share if column == 0 else ''}{weight:+g} SD" if weight else "mean", fontsize=11, color=_INK
            )
    top = 1 - 0.35 / (0.1 + row_in * count)
    figure.subplots_adjust(left=0.01, right=0.91, bottom=0.01, top=top, wspace=0.02, hspace=0.4 / (row_in - 0.4))
    bar = figure.colorbar(
        ScalarMappable(Normalize(-limit, limit), SHIFT_COLORS), cax=figure.add_axes((0.93, 0.25, 0.012, 0.5))
    )
    bar.set_label("shift along the normal / mm (positive: outwards)", fontsize=11, color=_INK)
    save_figure(figure, path)


def save_variance_picture(path: Path, model: ShapeModel) -> None:
    """PNG: the standard deviation of each mode, and how much of the variance the first modes explain together."""
    figure = new_figure(7.0, 3.6, dpi=100)
    axes = figure.add_subplot()
    numbers = np.arange(1, len(model.modes) + 1)
    axes.bar(numbers, model.standard_deviations_mm, color="#7b93b8", width=0.7)
    axes.set_xlabel("mode", color=_INK)
    axes.set_ylabel("standard deviation / mm\n(root mean square over the surface)", color=_INK)
    axes.set_xticks(numbers)
    together = axes.twinx()
    together.plot(numbers, 100 * np.cumsum(model.variance_shares), color="#c2410c", marker="o", markersize=4)
    together.set_ylim(0, 105)
    together.set_ylabel("cumulative variance explained / %", color="#c2410c")
    for side in (axes, together):
        side.spines["top"].set_visible(False)
    figure.tight_layout()
    save_figure(figure, path)


def _outward_shift(mean: Mesh, jaw: Mesh) -> Float[np.ndarray, "v"]:
    return np.asarray(np.einsum("vd,vd->v", jaw.vertices - mean.vertices, mean.vertex_normals))


def _colors(shift: Float[np.ndarray, "v"], limit: float) -> UInt8[np.ndarray, "v 3"]:
    return np.asarray(SHIFT_COLORS(0.5 + 0.5 * shift / limit, bytes=True)[:, :3])


def _frame(meshes: list[Mesh]) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Lower and upper corner, seen from the occlusal side, of what holds all meshes."""
    bounds = np.stack([mesh.bounds[:, :2] for mesh in meshes])
    return bounds[:, 0].min(axis=0) - 1, bounds[:, 1].max(axis=0) + 1


def _draw(axes: Axes, mesh: Mesh, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]) -> None:
    view = render(mesh, OCCLUSAL, width_px=420)
    lower, upper = mesh.bounds[:, :2]
    margin = _MARGIN * (upper - lower).max()
    height, width = np.array(view.image.shape[:2]) * view.mm_per_px
    left, top = lower[0] - margin, upper[1] + margin
    axes.imshow(view.image, extent=(left, left + width, top - height, top), interpolation="antialiased")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_axis_off()
