"""Drawings of a handpiece: its cameras with their views, lights and body, the tooth below, the outline of the holder.

All in the rig frame (mm): +X along the arch, +Y to the cheek, +Z out of the gum. The views are orthographic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.spatial import ConvexHull

from cuspid.model.body import Body
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, MountedCamera
from cuspid.report.figures.drawing import look, new_figure, render, save_figure

GROUP_COLOURS: Mapping[str, str] = {"o": "#c8860a", "b": "#3b7dd8", "l": "#8e5bb5"}
"""By the first letter of a camera's name: occlusal, buccal, lingual."""
_OTHER = "#3fa66b"
_LIGHT = "#f2c14e"
_INK = "#333333"
_HOLDER = "#9aa5ad"
_BODY = "#5f6f7a"
_BODY_MM = 0.55
"""Half the side of the square that stands for a camera."""
_END_MM = 1.5
"""The holder goes on so far beyond the outermost camera or light along the arch."""

ALONG = look(0.0, 0.0)
"""Along the arch, against the direction of travel: the cheek on the right."""
ABOVE = look(-90.0, 90.0)
"""From above: travel to the right, the cheek upwards."""
OBLIQUE = look(-35.0, 25.0)
"""From the tongue's side, before and above."""


def save_design_picture(
    path: Path,
    handpiece: Handpiece,
    mesh: Mesh | None = None,
    outline: Float[np.ndarray, "n 2"] | None = None,
    *,
    title: str = "",
    notes: Sequence[str] = (),
) -> None:
    """PNG with three views of a handpiece: along the arch, from above, oblique.

    ``mesh``: what lies below, in the rig frame (mm). ``outline``: cross-section of the holder as a polygon in (y, z).
    ``notes``: lines of text below the title.
    """
    figure = new_figure(13.0, 5.6, dpi=84)
    places = ((0.02, 0.10, 0.31, 0.70), (0.345, 0.10, 0.31, 0.70), (0.67, 0.10, 0.31, 0.70))
    views = ((ALONG, "along the arch"), (ABOVE, "from above"), (OBLIQUE, "oblique"))
    for place, (axes, name) in zip(places, views, strict=True):
        panel = figure.add_axes(place)
        _draw_view(panel, axes, handpiece, mesh, outline)
        panel.set_title(name, loc="left", fontsize=11, color=_INK)
    figure.text(0.02, 0.955, title or handpiece.name, fontsize=15, color=_INK, va="center", fontweight="bold")
    figure.text(0.02, 0.90, "   ".join(notes), fontsize=10.5, color=_INK, va="center")
    draw_legend(figure, handpiece)
    save_figure(figure, path)


def _draw_view(
    panel: Axes,
    axes: Float[np.ndarray, "3 3"],
    handpiece: Handpiece,
    mesh: Mesh | None,
    outline: Float[np.ndarray, "n 2"] | None,
) -> None:
    if mesh is not None:
        draw_mesh(panel, axes, mesh)
    if outline is not None:
        _draw_holder(panel, axes, handpiece, outline)
    if handpiece.body is not None:
        _draw_body(panel, axes, handpiece.body)
    for name, mounted in handpiece.rig.cameras.items():
        draw_camera(panel, axes, mounted, handpiece.working_distance_mm, colour_of(name))
    if handpiece.lights:
        lights = np.array([light.position_mm for light in handpiece.lights.values()]) @ axes.T
        panel.plot(lights[:, 0], lights[:, 1], "o", color=_LIGHT, markeredgecolor=_INK, markeredgewidth=0.6, ms=5)
    panel.set_aspect("equal")
    panel.autoscale_view()
    panel.margins(0.03)
    panel.set_axis_off()
    draw_scale(panel)


def draw_mesh(panel: Axes, axes: Float[np.ndarray, "3 3"], mesh: Mesh, *, width_px: int = 420) -> None:
    """A shaded picture of it, in its place."""
    view = render(mesh, axes, width_px=width_px)
    seen = mesh.vertices @ axes.T
    # The picture is centred on the mesh across, and begins a margin above it.
    low, high = seen.min(axis=0), seen.max(axis=0)
    rows, columns = view.image.shape[:2]
    margin = (columns * view.mm_per_px - (high - low)[0]) / 2
    top = high[1] + margin
    extent = (low[0] - margin, high[0] + margin, top - rows * view.mm_per_px, top)
    panel.imshow(view.image, extent=extent, interpolation="antialiased", zorder=0)


def _draw_holder(
    panel: Axes, axes: Float[np.ndarray, "3 3"], handpiece: Handpiece, outline: Float[np.ndarray, "n 2"]
) -> None:
    parts = [mounted.centre_in_rig[0] for mounted in handpiece.rig.cameras.values()]
    parts += [light.position_mm[0] for light in handpiece.lights.values()]
    ends = [
        np.column_stack([np.full(len(outline), x), outline]) @ axes.T
        for x in (min(parts) - _END_MM, max(parts) + _END_MM)
    ]
    walls = [np.array([a[k], a[k - 1], b[k - 1], b[k]])[:, :2] for a, b in [ends] for k in range(len(outline))]
    faces = [*(end[:, :2] for end in ends), *walls]
    panel.add_collection(PolyCollection(faces, facecolors=_HOLDER, alpha=0.05, edgecolors="none", zorder=1))
    corners = [np.array([a, b])[:, :2] for a, b, turns in zip(*ends, _turns(outline), strict=True) if turns]
    edges = [np.concatenate([end, end[:1]])[:, :2] for end in ends] + corners
    panel.add_collection(LineCollection(edges, colors=_HOLDER, linewidths=0.8, zorder=1))


def _draw_body(panel: Axes, axes: Float[np.ndarray, "3 3"], body: Body) -> None:
    """The silhouette of each box."""
    seen = [box.corners @ axes[:2].T for box in body.parts.values()]
    shapes = [corners[ConvexHull(corners).vertices] for corners in seen]
    panel.add_collection(PolyCollection(shapes, facecolors="none", edgecolors=_BODY, linewidths=0.8, zorder=2))


def _turns(outline: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
    """Whether a polygon changes its direction at a corner by more than 5 degrees."""
    before, after = outline - np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0) - outline
    lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    return np.sum(before * after, axis=1) < np.cos(np.deg2rad(5)) * lengths


def draw_camera(
    panel: Axes, axes: Float[np.ndarray, "3 3"], mounted: MountedCamera, distance_mm: float, colour: str
) -> None:
    """A square for the camera, and the pyramid of its view up to the working distance."""
    camera, rig_from_cam = mounted.camera, mounted.cam_from_rig.inverse()
    border = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * np.array([camera.width, camera.height], dtype=float)
    far = rig_from_cam.apply(camera.rays(border) * distance_mm) @ axes.T
    square = _BODY_MM * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
    body = rig_from_cam.apply(square) @ axes.T
    apex = axes @ rig_from_cam.translation
    sides = [np.array([apex, far[k - 1], far[k]])[:, :2] for k in range(4)]
    panel.add_collection(PolyCollection(sides, facecolors=colour, alpha=0.04, edgecolors="none", zorder=3))
    rays = [np.array([apex, corner])[:, :2] for corner in far] + [np.concatenate([far, far[:1]])[:, :2]]
    panel.add_collection(LineCollection(rays, colors=colour, linewidths=0.7, alpha=0.8, zorder=3))
    panel.add_collection(PolyCollection([body[:, :2]], facecolors=colour, edgecolors=_INK, linewidths=0.8, zorder=4))


def draw_scale(panel: Axes) -> None:
    """A bar of 5 mm in the lower left corner."""
    left, bottom = panel.get_xlim()[0], panel.get_ylim()[0]
    panel.plot([left, left + 5], [bottom, bottom], color=_INK, linewidth=2, solid_capstyle="butt")
    panel.annotate(
        "5 mm", (left + 2.5, bottom), (0, 3), textcoords="offset points", ha="center", fontsize=9, color=_INK
    )


def colour_of(name: str) -> str:
    """The colour of a camera, by the first letter of its name."""
    return GROUP_COLOURS.get(name[:1], _OTHER)


def draw_legend(figure: Figure, handpiece: Handpiece) -> None:
    """Below all views."""
    figure.legend(handles=_legend(handpiece), loc="lower center", ncols=6, frameon=False, fontsize=10)


def _legend(handpiece: Handpiece) -> list[Line2D]:
    names = {"o": "occlusal cameras", "b": "buccal cameras", "l": "lingual cameras"}
    present = dict.fromkeys(name[:1] if name[:1] in names else "" for name in handpiece.rig.names)
    marks = [
        Line2D([], [], marker="s", color="none", markerfacecolor=colour_of(letter), label=names.get(letter, "cameras"))
        for letter in present
    ]
    marks += [Line2D([], [], color=_INK, linewidth=0.7, label="their views up to the working distance")]
    if handpiece.body is not None:
        marks.append(Line2D([], [], color=_BODY, linewidth=0.8, label="body"))
    if handpiece.lights:
        marks.append(Line2D([], [], marker="o", color="none", markerfacecolor=_LIGHT, label="LED"))
    return marks
