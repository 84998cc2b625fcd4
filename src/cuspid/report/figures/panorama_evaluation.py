"""Pictures of a panorama beside the true arch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from cuspid.report.figures.drawing import new_figure, save_figure

_INK = "#333333"
_COLOURS = "YlOrRd"
_RANGE_MM = 0.5
"""End of the colour bar; fixed, so that pictures can be compared."""


def save_panorama_evaluation(
    path: Path,
    truth: UInt8[np.ndarray, "h w 3"],
    aligned: Float[np.ndarray, "h w 3"] | None,
    places_px: Float[np.ndarray, "n 2"],
    errors_mm: Float[np.ndarray, "n"],
    *,
    title: str,
    captions: tuple[str, str, str],
) -> None:
    """PNG: the reference render of the true jaw, the panorama laid over it, and the error in place of its tooth pixels.

    ``aligned`` (RGB, 0 to 1) is None for a panorama that failed. ``places_px``: where on the reference render the
    errors belong; none where they are not known. ``captions``: one line below each of the three.
    """
    height, width = truth.shape[:2]
    figure = new_figure(15.0, 15 / 3 * height / width + 1.9, dpi=100)
    figure.text(0.02, 0.95, title, fontsize=15, color=_INK, va="center", fontweight="bold")
    panels = [figure.add_axes((0.01 + 0.33 * k, 0.15, 0.32, 0.73)) for k in range(3)]
    for axes, caption in zip(panels, captions, strict=True):
        axes.set_axis_off()
        axes.set_title(caption, fontsize=11, color=_INK, loc="left", wrap=True)
    panels[0].imshow(truth)
    panels[1].imshow(np.zeros_like(truth) if aligned is None else np.clip(aligned, 0, 1))
    _draw_errors(panels[2], truth, places_px, errors_mm)
    save_figure(figure, path)


def _draw_errors(
    axes: Axes,
    truth: UInt8[np.ndarray, "h w 3"],
    places_px: Float[np.ndarray, "n 2"],
    errors_mm: Float[np.ndarray, "n"],
) -> None:
    faint = 255 - (255 - truth.mean(axis=2)) * 0.25
    axes.imshow(np.where(truth.max(axis=2) > 0, faint, 255), cmap="gray", vmin=0, vmax=255)
    if not len(errors_mm):
        return
    # The worst are drawn last, so that none of them hides.
    order = np.argsort(errors_mm)
    x, y = places_px[order].T
    axes.scatter(x, y, c=errors_mm[order], s=1.0, cmap=_COLOURS, vmin=0, vmax=_RANGE_MM, linewidths=0)
    colours = ScalarMappable(Normalize(0, _RANGE_MM), _COLOURS)
    bar = axes.figure.colorbar(
        colours, cax=axes.figure.add_axes((0.70, 0.12, 0.26, 0.02)), orientation="horizontal", extend="max"
    )
    bar.outline.set_visible(False)
    bar.set_label("geometric error of tooth pixels / mm", fontsize=10, color=_INK)
