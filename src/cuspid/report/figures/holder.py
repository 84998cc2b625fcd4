"""A picture of a printable holder: from the side, and its head with modules and views, from outside and cut open.

In the frame of its handle (mm): +Y from the head to the end of the grip, +Z to the teeth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from cuspid.geometry import Rigid3, unit
from cuspid.model.body import Body, Box
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.report.figures.design import colour_of, draw_camera, draw_legend, draw_mesh, draw_scale
from cuspid.report.figures.drawing import PLASTER, new_figure, save_figure

_INK = "#333333"
_WIDTH_PX, _WHOLE_PX = 360, 900
_CAMERA, _LED = (52, 73, 94), (242, 193, 78)
_SIDE = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
"""From the side, the grip on the left, the teeth below."""
_TIP = np.array([[1.0, 0, 0], [0, 0, -1], [0, -1, 0]])
"""From the tip along the neck, the teeth below."""


def save_holder_picture(
    path: Path,
    handpiece: Handpiece,
    handle_from_rig: Rigid3,
    meshes: tuple[Mesh, Mesh, Mesh],
    *,
    title: str = "",
    notes: Sequence[str] = (),
) -> None:
    """PNG with four views of a holder. ``meshes``, in the rig frame: the whole, its head, its head cut open."""
    figure = new_figure(13.0, 8.4, dpi=84)
    figure.text(0.02, 0.965, title or handpiece.name, fontsize=15, color=_INK, va="center", fontweight="bold")
    figure.text(0.02, 0.93, "   ".join(notes), fontsize=10.5, color=_INK, va="center")
    whole, head, opened = meshes
    views = (
        ((0.02, 0.69, 0.96, 0.19), _SIDE, whole, _WHOLE_PX, "from the side", False),
        ((0.02, 0.08, 0.31, 0.56), _oblique(), head, _WIDTH_PX, "from the teeth", False),
        ((0.345, 0.08, 0.31, 0.56), _TIP, head, _WIDTH_PX, "from the tip, with the views of the cameras", True),
        ((0.67, 0.08, 0.31, 0.56), _SIDE, opened, _WIDTH_PX, "cut open along the neck", False),
    )
    for place, axes, mesh, width_px, name, with_views in views:
        panel = figure.add_axes(place)
        _draw(panel, axes @ handle_from_rig.rotation, handpiece, mesh, width_px, with_views=with_views)
        panel.set_title(name, loc="left", fontsize=11, color=_INK)
    draw_legend(figure, replace(handpiece, body=None))
    save_figure(figure, path)


def _oblique() -> Float[np.ndarray, "3 3"]:
    """From the teeth and the tip, the neck going away to the upper left."""
    towards = unit(np.array([0.45, -0.6, 0.75]))
    right = unit(np.cross(np.array([0.0, 0, -1]), towards))
    return np.stack([right, np.cross(towards, right), towards])


def _draw(
    panel: Axes, axes: Float[np.ndarray, "3 3"], handpiece: Handpiece, mesh: Mesh, width_px: int, *, with_views: bool
) -> None:
    draw_mesh(panel, axes, _with_modules(mesh, handpiece.solid), width_px=width_px)
    if with_views:
        for name, mounted in handpiece.rig.cameras.items():
            draw_camera(panel, axes, mounted, handpiece.working_distance_mm, colour_of(name))
    panel.set_aspect("equal")
    panel.autoscale_view()
    panel.margins(0.03)
    panel.set_axis_off()
    draw_scale(panel)


def _with_modules(mesh: Mesh, body: Body) -> Mesh:
    """The holder with its modules, coloured."""
    parts = [(_flat(mesh), tuple(PLASTER.tolist()))]
    parts += [(_mesh_of(box), _CAMERA) for name, box in body.parts.items() if name.startswith("camera ")]
    parts += [(_mesh_of(box), _LED) for name, box in body.parts.items() if name.startswith("light ")]
    starts = np.cumsum([0] + [len(each.vertices) for each, _ in parts])
    return Mesh(
        np.concatenate([each.vertices for each, _ in parts]),
        np.concatenate([each.faces + start for (each, _), start in zip(parts, starts[:-1], strict=True)]),
        np.concatenate([np.tile(np.array(colour, dtype=np.uint8), (len(each.vertices), 1)) for each, colour in parts]),
    )


def _flat(mesh: Mesh) -> Mesh:
    """With corners of its own for each face, that edges are drawn sharp."""
    return Mesh(mesh.vertices[mesh.faces.ravel()], np.arange(mesh.faces.size).reshape(-1, 3))


def _mesh_of(box: Box) -> Mesh:
    sides = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return _flat(Mesh(box.corners, np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])))
