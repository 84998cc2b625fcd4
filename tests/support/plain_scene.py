"""A plain surface under a handpiece with a red, a green and a blue light, rendered without any texture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from builders import InMemory
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, Frame
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import DepthMap
from cuspid.model.rig import Handpiece, Light, Lighting, Sensor
from cuspid.mvs.matching import StereoOptions
from cuspid.simulation.appearance import APPEARANCES
from cuspid.simulation.raycast import Scene, auto_gain, render_image
from synthetic_scene import cast_depth, diamond, height_field

SIZE_PX = 160
HILLS = height_field(lambda x, y: 5 + 0.4 * np.sin(1.8 * x) * np.cos(1.5 * y), half_width_mm=7.0)
WAY = {
    f"{k:05d}": Rigid3.from_rotation_vector(np.array([0.01, -0.015, 0.02]) * k, np.array([-0.6, 0.1, 0.03]) * k)
    for k in range(4)
}


def lit(*, glare: float = 0.0, sensors: Mapping[str, Sensor] | None = None, turned_deg: float = 0.0) -> Handpiece:
    """Four cameras within a ring of three lights."""
    turns = np.deg2rad(np.array([90, 210, 330]) + turned_deg)
    lights = {
        name: Light(
            position_mm=3 * np.array([np.cos(turn), np.sin(turn), 0.0]),
            direction=np.array([0, 0, 1.0]),
            colour=colour,
            glare=glare,
        )
        for name, turn, colour in zip("rgb", turns, np.eye(3), strict=True)
    }
    all_of_them = (Lighting(name="all", lights=tuple(lights)),)
    return replace(diamond(SIZE_PX), lights=lights, lightings=all_of_them, sensors=sensors or {})


def photographs(
    handpiece: Handpiece, way: Mapping[str, Rigid3], mesh: Mesh = HILLS
) -> dict[tuple[str, str], np.ndarray]:
    """By frame and camera."""
    scene = Scene(jaw=Jaw(mesh=mesh), handpiece=handpiece, appearance=APPEARANCES["enamel"], supersampling=1)
    gain = auto_gain(scene, [next(iter(way.values()))])
    return {
        (frame, camera): render_image(scene, Frame(name=frame, cameras=handpiece.rig.names), camera, pose, gain)
        for frame, pose in way.items()
        for camera in handpiece.rig.names
    }


def capture_of(handpiece: Handpiece, images: Mapping[tuple[str, str], np.ndarray]) -> Capture:
    names = dict.fromkeys(frame for frame, _ in images)
    frames = tuple(Frame(name=name, cameras=handpiece.rig.names) for name in names)
    return Capture(handpiece=handpiece, frames=frames, source=InMemory(images))


@cache
def plain_scan() -> Capture:
    """Four frames over plain hills."""
    handpiece = lit()
    return capture_of(handpiece, photographs(handpiece, WAY))


OPTIONS = StereoOptions(spacing_px=4)


def of_one_frame(images: Mapping[tuple[str, str], np.ndarray]) -> dict[str, np.ndarray]:
    return {camera: image for (frame, camera), image in images.items() if frame == "00000"}


def errors_um(maps: Sequence[DepthMap]) -> np.ndarray:
    """All errors of known depths; the world is the rig frame."""
    off = [1000 * (each.depth_mm - cast_depth(HILLS, each.camera, each.cam_from_rig))[each.known] for each in maps]
    return np.concatenate(off)


def white(handpiece: Handpiece) -> Handpiece:
    lights = {name: replace(light, colour=np.ones(3)) for name, light in handpiece.lights.items()}
    return replace(handpiece, lights=lights)
