"""A scan that is being taken, in the browser: the surface as it grows, its holes, the path, and where it was lost.

The frame is that of the scan (mm); up is where the handpiece was in the first frame.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, Rig
from cuspid.report.live_view import add, start
from cuspid.report.pages.scene import camera_lines, camera_path
from cuspid.report.same_origin import address

_RIMS_EVERY_S = 3.0
"""The holes are looked for so often: it takes the whole surface."""
_PATH, _HERE, _LOST, _RIM = (181, 23, 158), (28, 93, 153), (205, 30, 30), (235, 70, 20)
_UNCOLOURED = 160


@runtime_checkable
class Scan(Protocol):
    """What is shown: :class:`cuspid.pipeline.session.Session`."""

    @property
    def handpiece(self) -> Handpiece:
        """The handpiece."""
        ...

    @property
    def rig_from_world(self) -> Mapping[str, Rigid3]:
        """Where it was."""
        ...

    @property
    def frames(self) -> tuple[Any, ...]:
        """The frames that came in."""
        ...

    def missing(self) -> Float[np.ndarray, "n 3"]:
        """Places on the rims of holes."""
        ...


class GrowingView:
    """A server that shows a scan to its own pages until the program ends."""

    def __init__(self, host: str, port: int) -> None:
        """It takes the next free port. Raises MissingDependencyError without viser."""
        self._server = start(host, port)
        self.address = address(host, int(self._server.get_port()))
        self._nodes = dict[int, Any]()
        self._words = self._server.gui.add_markdown("Waiting for the first frame.")
        self._toggles = {name: self._server.gui.add_checkbox(name, True) for name in ("Path", "Holes")}
        self._begin, self._rims_at = time.monotonic(), float("-inf")
        self._looked = False

    def show(self, scan: Scan, changed: Mapping[int, Mesh], lost: int) -> None:
        """Show what changed of a scan; ``lost`` is the number of its latest frames that could not be placed."""
        for key, mesh in changed.items():
            self._show_part(key, mesh)
        self._show_path(scan, lost)
        if time.monotonic() - self._rims_at > _RIMS_EVERY_S:
            self._show_rims(scan.missing())
        self._words.content = self._status_text(scan, lost)

    def _show_part(self, key: int, mesh: Mesh) -> None:
        if len(mesh.faces) == 0:
            node = self._nodes.pop(key, None)
            if node is not None:
                node.remove()
            return
        rgb = np.full((len(mesh.vertices), 3), _UNCOLOURED, np.uint8) if mesh.colors is None else mesh.colors
        self._nodes[key] = add(self._server, f"/surface/{key}", mesh, rgb, True)

    def _show_path(self, scan: Scan, lost: int) -> None:
        poses = scan.rig_from_world
        if not poses:
            return
        rig = scan.handpiece.rig
        name, latest = list(poses.items())[-1]
        here = camera_lines(rig, {name: latest}).reshape(-1, 2, 3)
        color = np.array(_LOST if lost else _HERE)
        self._server.scene.add_line_segments("/handpiece", here, color, line_width=3 if lost else 1)
        path = camera_path(rig, poses)
        if len(path) > 1:
            segments = np.stack([path[:-1], path[1:]], axis=1)
            shown = self._toggles["Path"].value
            self._server.scene.add_line_segments("/path", segments, np.array(_PATH), line_width=2, visible=shown)
        if not self._looked:
            self._look_at(path[-1], _mean_view_direction(rig, latest), scan.handpiece.working_distance_mm)

    def _look_at(self, place: Float[np.ndarray, "3"], towards: Float[np.ndarray, "3"], distance_mm: float) -> None:
        """From behind the handpiece, at what it sees first, and with light from there."""
        scene, camera = self._server.scene, self._server.initial_camera
        scene.set_up_direction(tuple(map(float, -towards)))
        aside = np.cross(towards, np.eye(3)[np.argmin(np.abs(towards))])
        camera.look_at = tuple(map(float, place + distance_mm * towards))
        camera.position = tuple(map(float, place + distance_mm * (1.5 * aside - 3.5 * towards)))
        # The colours of the images have light and shade of their own, which these lights hardly change.
        scene.add_light_ambient("/lights/ambient", intensity=3.5)
        scene.add_light_directional(
            "/lights/above", intensity=3.0, position=tuple(map(float, 60 * (aside - 2 * towards)))
        )
        self._looked = True

    def _show_rims(self, rims: Float[np.ndarray, "n 3"]) -> None:
        visible, self._rims_at = self._toggles["Holes"].value, time.monotonic()
        colors = np.tile(np.array(_RIM, dtype=np.uint8), (len(rims), 1))
        self._server.scene.add_point_cloud(
            "/holes", rims.astype(np.float32), colors, point_size=0.08, point_shape="circle", visible=visible
        )

    def _status_text(self, scan: Scan, lost: int) -> str:
        rate = len(scan.frames) / max(time.monotonic() - self._begin, 1e-3)
        lines = [
            f"**{len(scan.rig_from_world)}** of {len(scan.frames)} frames placed, {rate:.1f} a second",
            "",
            "Orange: rims of holes.",
        ]
        if lost and scan.rig_from_world:
            back = list(scan.rig_from_world)[-1]
            lines = [
                f"**Lost for {lost} frames.** Go back to the red pyramids, where frame {back} was taken.",
                "",
                *lines,
            ]
        return "\n".join(lines)


def _mean_view_direction(rig: Rig, rig_from_world: Rigid3) -> Float[np.ndarray, "3"]:
    """Unit vector (world) in which the cameras look on the average."""
    mean = np.mean([mounted.cam_from_rig.rotation[2] for mounted in rig.cameras.values()], axis=0)
    towards = rig_from_world.inverse().rotate(mean)
    return np.asarray(towards / np.linalg.norm(towards))
