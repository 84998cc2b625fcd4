"""What the viewer of a page draws: layers, colours, standard views and places, as plain values for JSON.

The frame is the occlusal one (mm); a view names where the eye is and what is up, as directions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.jaw import Arch
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Rig
from cuspid.report.figures.drawing import fitting_range_um
from cuspid.report.pages.color_scale import ColorScale, deviation_scale, sigma_scale
from cuspid.report.pages.page import pack_array
from cuspid.report.pages.shown_mesh import pack_mesh, pack_um
from cuspid.storage import ScanResult

PLASTER_COLOR = (222, 214, 200)
"""sRGB of a surface without deviations."""
REFERENCE_COLOR = (196, 205, 214)
"""sRGB of the reference."""
_FRUSTUM_MM = 1.2


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where the view can go."""

    name: str
    """For people."""
    position_mm: tuple[float, float, float]
    """The middle of it."""
    radius_mm: float
    """How much of its surroundings is to be seen."""
    towards: tuple[float, float, float] | None = None
    """From where it is best seen, a direction; None to keep the present one."""


def shown_frame(result: ScanResult) -> Rigid3:
    """``shown_from_scan``: the frame of the reference; without one the cameras look down on average."""
    if result.reference_from_scan is not None:
        return result.reference_from_scan
    if result.reconstruction is None:
        return Rigid3.identity()
    axes = [
        pose.inverse().rotate(mounted.axis_in_rig)
        for pose in result.reconstruction.rig_from_world.values()
        for mounted in result.reconstruction.rig.cameras.values()
    ]
    up = -np.mean(axes, axis=0)
    up /= np.linalg.norm(up)
    turn = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(turn))
    if sine < 1e-9:
        return Rigid3(np.diag([1.0, np.sign(up[2]), np.sign(up[2])]), np.zeros(3))
    return Rigid3.from_rotation_vector(turn / sine * np.arctan2(sine, up[2]), np.zeros(3))


def deviation_range_um(result: ScanResult) -> float:
    """The range that fits the deviations of a scan, as far as they are known."""
    return fitting_range_um(float(result.trueness["p95_um"])) if result.trueness else 100.0


def has_scale(result: ScanResult) -> bool:
    """Whether lengths of a scan are millimetres: photographs alone have none."""
    return result.reconstruction is None or result.reconstruction.has_scale


def surface_maps(result: ScanResult, range_um: float) -> list[tuple[ColorScale, Float[np.ndarray, "v"]]]:
    """What the surface of a scan can be coloured by, with the values of its vertices: its deviations, with this range,
    and what was expected of them; those of them that the folder has."""
    maps = []
    if result.deviation_um is not None:
        maps.append((deviation_scale(range_um), result.deviation_um))
    if result.sigma_um is not None:
        maps.append((sigma_scale(result.sigma_um, has_scale=has_scale(result)), result.sigma_um))
    return maps


def poses_from(reconstruction: Reconstruction, shown_from_scan: Rigid3) -> dict[str, Rigid3]:
    """``rig_from_shown`` of each frame."""
    scan_from_shown = shown_from_scan.inverse()
    return {name: pose @ scan_from_shown for name, pose in reconstruction.rig_from_world.items()}


def standard_views(arch: Arch | None) -> list[dict[str, Any]]:
    """Occlusal, front, the patient's right and left (+X and -X where the arch is not known), and from behind."""
    names = {"lower": ("Right", "Left"), "upper": ("Left", "Right"), None: ("+X", "−X")}[arch]
    up = (0.0, 0.0, 1.0)
    views = {
        "Occlusal": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
        "Front": ((0.0, 1.0, 0.25), up),
        names[0]: ((1.0, 0.0, 0.25), up),
        names[1]: ((-1.0, 0.0, 0.25), up),
        "Behind": ((0.0, -1.0, 0.6), up),
    }
    return [{"name": name, "eye": eye, "up": above} for name, (eye, above) in views.items()]


def mesh_layer(
    name: str,
    label: str,
    mesh: Mesh,
    *,
    visible: bool = True,
    values_um: Mapping[str, Float[np.ndarray, "v"]] = MappingProxyType({}),
    color: Sequence[int] = PLASTER_COLOR,
    behind: bool = False,
) -> dict[str, Any]:
    """A surface. ``values_um`` of its vertices by the name of their colour scale. ``behind``: where it coincides with
    another one, the other is seen."""
    values = {each: pack_um(values) for each, values in values_um.items()}
    look = {"visible": visible, "color": list(color), "behind": behind, "values": values}
    return {"kind": "mesh", "name": name, "label": label, **pack_mesh(mesh), **look}


def camera_layer(rig: Rig, rig_from_shown: Mapping[str, Rigid3]) -> dict[str, Any]:
    """Every camera at every frame as a small pyramid of lines."""
    points = camera_lines(rig, rig_from_shown)
    return {
        "kind": "segments",
        "name": "cameras",
        "label": "Cameras",
        "visible": False,
        "points": pack_array(points.astype(np.float32)),
        "frames": list(rig_from_shown),
        "points_per_frame": len(points) // max(1, len(rig_from_shown)),
    }


def camera_lines(rig: Rig, rig_from_shown: Mapping[str, Rigid3]) -> Float[np.ndarray, "n 3"]:
    """Ends of lines, two by two, frame by frame: what each camera sees, as a pyramid of eight edges."""
    in_rig = np.concatenate([_frustum(rig, name) for name in rig.names])
    points = [pose.inverse().apply(in_rig) for pose in rig_from_shown.values()]
    return np.concatenate(points) if points else np.empty((0, 3))


def _frustum(rig: Rig, name: str) -> Float[np.ndarray, "16 3"]:
    """The eight edges of the pyramid that a camera sees, as pairs of points in the rig frame."""
    mounted = rig[name]
    size = np.array([mounted.camera.width, mounted.camera.height], dtype=np.float64)
    corners = mounted.camera.rays(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size)
    ends = _FRUSTUM_MM * corners / corners[:, 2:]
    apex = np.zeros((4, 3))
    edges = np.concatenate([np.stack([apex, ends], axis=1), np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)])
    return np.asarray(mounted.cam_from_rig.inverse().apply(edges.reshape(-1, 3)))


def path_layer(rig: Rig, rig_from_shown: Mapping[str, Rigid3]) -> dict[str, Any]:
    """The trajectory of the middle of the cameras."""
    points = camera_path(rig, rig_from_shown)
    return {
        "kind": "line",
        "name": "path",
        "label": "Path",
        "visible": False,
        "points": pack_array(points.astype(np.float32)),
    }


def camera_path(rig: Rig, rig_from_shown: Mapping[str, Rigid3]) -> Float[np.ndarray, "n 3"]:
    """Where the middle of the cameras was at each frame."""
    middle = np.mean([mounted.centre_in_rig for mounted in rig.cameras.values()], axis=0)
    return np.array([pose.inverse().apply(middle) for pose in rig_from_shown.values()]).reshape(-1, 3)
