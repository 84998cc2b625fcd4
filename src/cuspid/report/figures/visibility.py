"""Pictures of what a handpiece sees: the named surfaces, how many cameras saw each face at once, and shares as bars.

Meshes lie in the occlusal frame. A vertex has the colour of most faces around it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from cuspid.model.mesh import Mesh
from cuspid.report.figures.drawing import OCCLUSAL, PLASTER, RenderedMesh, look, new_figure, render, save_figure

SURFACE_COLOURS: Mapping[str, str] = {
    "occlusal": "#f2c14e",
    "incisal": "#f2c14e",
    "buccal": "#3b7dd8",
    "labial": "#3b7dd8",
    "lingual": "#8e5bb5",
    "mesial": "#3fa66b",
    "distal": "#d1603d",
    "gingival": "#e3a5ae",
}
"""Colour by the name of a surface."""
COUNT_COLOURS = ("#b9b9b9", "#d1603d", "#f2c14e", "#8cc56b", "#1f7a4d")
"""Colour by the number of cameras that saw a face at once: 0, 1, 2, 3, and 4 or more."""
_INK = "#333333"


def save_surfaces_picture(
    path: Path, mesh: Mesh, surfaces: Mapping[str, Bool[np.ndarray, "f"]], *, title: str = ""
) -> None:
    """PNG of a jaw with its named surfaces: occlusal, from the front and from behind. Other faces are plaster."""
    names = [name for name, mask in surfaces.items() if mask.any()]
    codes = np.zeros(len(mesh.faces), dtype=np.int64)
    for code, name in enumerate(names, start=1):
        codes[surfaces[name]] = code
    plaster = "#{:02x}{:02x}{:02x}".format(*PLASTER)
    palette = [plaster, *(SURFACE_COLOURS[name] for name in names)]
    legend = {", ".join(name for name in names if SURFACE_COLOURS[name] == colour): colour for colour in palette[1:]}
    _save_views(path, mesh, codes, palette, legend, title)


def save_counts_picture(path: Path, mesh: Mesh, most_at_once: Int[np.ndarray, "f"], *, title: str = "") -> None:
    """PNG of a jaw coloured by the largest number of cameras that saw each face at once."""
    codes = np.minimum(most_at_once, len(COUNT_COLOURS) - 1)
    shares = np.bincount(codes, mesh.face_areas, minlength=len(COUNT_COLOURS)) / mesh.face_areas.sum()
    names = ("no camera", "1 camera", "2 at once", "3 at once", "4 or more")
    legend = {f"{name} ({share:.0%})": colour for name, share, colour in zip(names, shares, COUNT_COLOURS, strict=True)}
    _save_views(path, mesh, codes, COUNT_COLOURS, legend, title)


def save_shares_picture(path: Path, designs: Mapping[str, Sequence[Mapping[str, object]]], *, title: str = "") -> None:
    """PNG: for each design a panel with the share of each surface that at least 1, 2 and 3 cameras see at once.

    ``designs``: rows with the keys ``surface`` and ``seen_by_1_pct`` to ``seen_by_3_pct``, by the name of the design.
    """
    figure = new_figure(5.2 * len(designs), 4.2, dpi=84)
    panels = figure.subplots(1, len(designs), sharey=True, squeeze=False)[0]
    for axes, (design, rows) in zip(panels, designs.items(), strict=True):
        places = np.arange(len(rows))
        for offset, cameras in zip((-0.26, 0.0, 0.26), (1, 2, 3), strict=True):
            shares = [row[f"seen_by_{cameras}_pct"] for row in rows]
            axes.barh(places + offset, shares, height=0.25, color=COUNT_COLOURS[cameras], label=f">= {cameras}")
        axes.set_yticks(places, [str(row["surface"]) for row in rows], color=_INK)
        axes.set_xlim(0, 100)
        axes.set_title(design, loc="left", fontsize=12, color=_INK)
        axes.set_xlabel("share of the surface / %", color=_INK)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="x", color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
    panels[0].invert_yaxis()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, title="cameras at once", loc="upper right", ncols=3, frameon=False, fontsize=10)
    figure.text(0.02, 0.94, title, fontsize=14, color=_INK, va="center", fontweight="bold")
    figure.tight_layout(rect=(0, 0, 1, 0.90))
    save_figure(figure, path)


def _save_views(
    path: Path,
    mesh: Mesh,
    codes: Int[np.ndarray, "f"],
    palette: Sequence[str],
    legend: Mapping[str, str],
    title: str,
) -> None:
    colored = replace(mesh, colors=_vertex_colors(mesh, codes, palette))
    figure = new_figure(11.0, 6.6, dpi=84)
    _draw(figure, (0.01, 0.10, 0.50, 0.80), render(colored, OCCLUSAL, width_px=640), "occlusal")
    _draw(figure, (0.53, 0.52, 0.46, 0.38), render(colored, look(90.0, 25.0), width_px=560), "from the front")
    _draw(figure, (0.53, 0.10, 0.46, 0.38), render(colored, look(-90.0, 35.0), width_px=560), "from behind")
    handles = [Patch(facecolor=colour, label=name) for name, colour in legend.items()]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=11)
    figure.text(0.02, 0.955, title, fontsize=15, color=_INK, va="center", fontweight="bold")
    save_figure(figure, path)


def _vertex_colors(mesh: Mesh, codes: Int[np.ndarray, "f"], palette: Sequence[str]) -> UInt8[np.ndarray, "v 3"]:
    votes: Float[np.ndarray, "v k"] = np.stack(
        [np.bincount(mesh.faces[codes == code].ravel(), minlength=len(mesh.vertices)) for code in range(len(palette))],
        axis=1,
    )
    colours = np.rint(255 * np.array([to_rgb(colour) for colour in palette])).astype(np.uint8)
    return colours[votes.argmax(axis=1)]


def _draw(figure: Figure, place: tuple[float, float, float, float], view: RenderedMesh, name: str) -> None:
    axes = figure.add_axes(place)
    axes.imshow(view.image, interpolation="antialiased")
    axes.set_axis_off()
    axes.set_title(name, loc="left", fontsize=11, color=_INK, pad=3)
