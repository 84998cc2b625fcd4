"""A live view in the browser at full resolution, by viser: surfaces, cameras and path, or the modes of a shape model.

The frame is that of the page of the same folder (mm).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import singledispatch
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from cuspid.geometry import unit
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.model.shape_model import ShapeModel
from cuspid.report.pages.color_scale import ColorScale
from cuspid.report.pages.scene import (
    PLASTER_COLOR,
    REFERENCE_COLOR,
    camera_lines,
    camera_path,
    deviation_range_um,
    poses_from,
    shown_frame,
    surface_maps,
)
from cuspid.report.same_origin import address, only_own_pages, require_address
from cuspid.runtime.display import Viewable
from cuspid.runtime.errors import InputError, MissingDependencyError
from cuspid.storage import Result, ScanResult, ShapeResult

Server = Any
"""``viser.ViserServer``; viser may be missing."""
Node = Any
"""What viser shows, with ``visible``."""
_MOST_MODES = 5
_GAMMA = 2.2
_NO_COLORS = "None"
LOCAL = "127.0.0.1"
_RAGGED_PCT = 2.0
"""Of the faces of a mesh, on each side, that may lie outside of what is shown first."""
_CAMERA_SHARE = 0.3
"""Of the working distance, the depth of the frustum by which a camera is shown."""
_LIGHT_COLOR = (255, 200, 60)
_FROM = np.array([2.0, -3.0, -2.5])
"""From where a handpiece is seen first, in working distances."""


def serve(result: Result, host: str, port: int) -> Server:
    """A server that shows a scan or a shape model until it is stopped, to its own pages alone; it takes the next free
    port.

    Raises MissingDependencyError without viser, InputError where there is nothing to show in 3-D.
    """
    show = _what_to_show(result)
    server = start(host, port)
    server.scene.set_up_direction("+z")
    _light(server)
    show(server)
    return server


def start(host: str, port: int) -> Server:
    """An empty scene without lights or surroundings that are mirrored, for its own pages alone. Raises
    MissingDependencyError without viser."""
    try:
        import viser
    except ImportError as error:
        raise MissingDependencyError("the view needs viser: pip install 'cuspid[view]'") from error
    require_address(host)
    with only_own_pages(host):
        server = viser.ViserServer(host=host, port=port, label="cuspid", verbose=False)
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(enabled=False)
    return server


def show_value(value: Viewable, port: int) -> Server:
    """A server for this machine alone that shows a mesh, a jaw or a handpiece; its address is printed.

    Raises MissingDependencyError without viser, TypeError for another value.
    """
    server = start(LOCAL, port)
    _light(server)
    _add_value(value, server)
    print(f"{address(LOCAL, server.get_port())} shows {value!r}")
    return server


@singledispatch
def _add_value(value: object, server: Server) -> None:
    raise TypeError(f"there is no view of a {type(value).__name__}")


@_add_value.register
def _(value: Mesh, server: Server) -> None:
    add(server, "/mesh", value, _plain(value, PLASTER_COLOR) if value.colors is None else value.colors, visible=True)
    centres = value.face_centres
    low, high = np.percentile(centres, [_RAGGED_PCT, 100 - _RAGGED_PCT], axis=0)
    outwards = unit(np.sum(value.face_normals * value.face_areas[:, None], axis=0))
    across = unit(np.cross(outwards, np.eye(3)[np.argmin(np.abs(outwards))]))
    server.scene.set_up_direction(outwards)
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    server.initial_camera.look_at = tuple(map(float, middle))
    server.initial_camera.position = tuple(map(float, middle + size * (outwards - 0.35 * across)))


@_add_value.register
def _(value: Jaw, server: Server) -> None:
    _add_value(value.mesh, server)


@_add_value.register
def _(value: Handpiece, server: Server) -> None:
    size = value.working_distance_mm * _CAMERA_SHARE
    for name, mounted in value.rig.cameras.items():
        camera, rig_from_cam = mounted.camera, mounted.cam_from_rig.inverse()
        server.scene.add_camera_frustum(
            f"/cameras/{name}",
            fov=2 * float(np.arctan(camera.height / (2 * camera.focal_px[1]))),
            aspect=camera.width / camera.height,
            scale=size,
            wxyz=Rotation.from_matrix(rig_from_cam.rotation).as_quat(scalar_first=True),
            position=rig_from_cam.translation,
        )
        server.scene.add_label(f"/cameras/{name}/name", name)
    for name, light in value.lights.items():
        server.scene.add_icosphere(f"/lights/{name}", radius=size / 8, position=light.position_mm, color=_LIGHT_COLOR)
    middle = np.mean([mounted.cam_from_rig.inverse().translation for mounted in value.rig.cameras.values()], axis=0)
    server.initial_camera.look_at = tuple(map(float, middle))
    server.initial_camera.position = tuple(map(float, middle + _FROM * value.working_distance_mm))


def _what_to_show(result: Result) -> Callable[[Server], None]:
    match result:
        case ScanResult(scan=Mesh() as scan):
            return lambda server: _show_scan(server, result, scan)
        case ShapeResult():
            return lambda server: _show_shape(server, result.model)
        case _:
            why = "; ".join(result.missing) or "open its report instead: cuspid report"
            raise InputError(f"{result.name}: nothing to view in 3-D; {why}")


def _show_scan(server: Server, result: ScanResult, scan: Mesh) -> None:
    shown_from_scan = shown_frame(result)
    moved = scan.transformed(shown_from_scan)
    _look_down_on(server, moved)
    nodes: dict[str, Node] = {}

    def paint(rgb: UInt8[np.ndarray, "v 3"] | None) -> None:
        visible = nodes["scan"].visible if "scan" in nodes else True
        colors = _plain(moved, PLASTER_COLOR) if rgb is None else rgb
        nodes["scan"] = add(server, "/scan", moved, colors, visible)

    maps = surface_maps(result, deviation_range_um(result))
    paint(next((scale.rgb(values) for scale, values in maps), None))
    if result.reference is not None:
        mesh = result.reference.mesh
        nodes["reference"] = add(server, "/reference", mesh, _plain(mesh, REFERENCE_COLOR), False)
    if result.reconstruction is not None:
        rig, poses = result.reconstruction.rig, poses_from(result.reconstruction, shown_from_scan)
        path = camera_path(rig, poses)
        lines = {
            "cameras": (camera_lines(rig, poses).reshape(-1, 2, 3), (28, 93, 153)),
            "path": (np.stack([path[:-1], path[1:]], axis=1), (181, 23, 158)),
        }
        for name, (points, color) in lines.items():
            nodes[name] = server.scene.add_line_segments(f"/{name}", points, np.array(color), visible=False)
    _add_toggles(server, nodes)
    if maps:
        _add_colors(server, maps, paint)


def _add_colors(
    server: Server,
    maps: Sequence[tuple[ColorScale, Float[np.ndarray, "v"]]],
    paint: Callable[[UInt8[np.ndarray, "v 3"] | None], None],
) -> None:
    """A choice of what the surface is coloured by (it is by the first) and up to which value, and a legend."""
    first = maps[0][0]
    chosen = server.gui.add_dropdown("Colours", [*(scale.label for scale, _ in maps), _NO_COLORS])
    ends = [_add_ends(server, scale, visible=scale is first) for scale, _ in maps]
    legend = server.gui.add_html(_legend(first, first.end))

    def update(_: Any) -> None:
        legend.visible, rgb = False, None
        for (scale, values), choice in zip(maps, ends, strict=True):
            choice.visible = scale.label == chosen.value
            if choice.visible:
                end = float(choice.value)
                legend.visible, legend.content, rgb = True, _legend(scale, end), scale.rgb(values, end)
        paint(rgb)

    for choice in (chosen, *ends):
        choice.on_update(update)


def _add_ends(server: Server, scale: ColorScale, *, visible: bool) -> Node:
    """A choice of the upper end of a scale."""
    ends, name = [f"{each:g}" for each in scale.ends], f"Range in {scale.unit}, {scale.reach}"
    return server.gui.add_dropdown(name, ends, initial_value=f"{scale.end:g}", visible=visible)


def _legend(scale: ColorScale, end: float) -> str:
    """The bar with its ends, and what it means, as HTML."""
    low, high = (f"−{end:g}", f"+{end:g}") if scale.signed else ("0", f"{end:g}")
    bar = f'<div style="height: 12px; border-radius: 3px; background: {scale.gradient}"></div>'
    ticks = f'<div style="display: flex; justify-content: space-between"><span>{low}</span><span>{high}</span></div>'
    return f'<div style="margin: 6px 12px; font-size: 12px">{bar}{ticks}{scale.meaning}</div>'


def _show_shape(server: Server, model: ShapeModel) -> None:
    _look_down_on(server, model.mean.mesh)
    count = min(_MOST_MODES, len(model.modes))
    sliders = [
        server.gui.add_slider(
            f"Mode {k + 1}, {100 * model.variance_shares[k]:.0f} %", min=-3.0, max=3.0, step=0.1, initial_value=0.0
        )
        for k in range(count)
    ]

    def bend(_: Any = None) -> None:
        mesh = model.sample([float(slider.value) for slider in sliders]).mesh
        add(server, "/jaw", mesh, _plain(mesh, PLASTER_COLOR), True)

    for slider in sliders:
        slider.on_update(bend)
    bend()


def _add_toggles(server: Server, nodes: dict[str, Node]) -> None:
    """A check box for each node; a node that is painted again is found by its name."""

    def add(name: str) -> None:
        box = server.gui.add_checkbox(name.capitalize(), nodes[name].visible)

        def update(_: Any) -> None:
            nodes[name].visible = box.value

        box.on_update(update)

    for name in nodes:
        add(name)


def _light(server: Server) -> None:
    """Light from all sides, some more from above, and no shadows."""
    server.scene.add_light_ambient("/lights/ambient", intensity=2.4)
    for name, position in (("above", (-20.0, 30.0, 60.0)), ("front", (0.0, 80.0, 20.0)), ("back", (30.0, -80.0, 20.0))):
        server.scene.add_light_directional(f"/lights/{name}", intensity=1.8, position=position)


def _look_down_on(server: Server, mesh: Mesh) -> None:
    low, high = mesh.bounds
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    server.initial_camera.look_at = tuple(map(float, middle))
    server.initial_camera.position = tuple(map(float, middle + size * np.array([0.0, -0.35, 1.0])))


def add(server: Server, name: str, mesh: Mesh, rgb: UInt8[np.ndarray, "v 3"], visible: bool) -> Node:
    """Show a surface with the colours (sRGB) of its vertices."""
    # The colours of vertices are linear in glTF, in which the mesh is sent.
    linear = np.rint(255 * (rgb / 255) ** _GAMMA).astype(np.uint8)
    shown = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=linear, process=False)
    return server.scene.add_mesh_trimesh(name, shown, visible=visible)


def _plain(mesh: Mesh, color: tuple[int, int, int]) -> UInt8[np.ndarray, "v 3"]:
    return np.tile(np.array(color, dtype=np.uint8), (len(mesh.vertices), 1))
