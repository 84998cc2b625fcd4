"""The holder of a handpiece: camera modules and LEDs, plates behind them, bars from plate to plate, and a neck.

Each *group* of cameras that look the same way has a plate behind its modules; bars join the plates, which of three
groups makes a U (thesis 3.5.2). Frames: ``group`` is that of the first camera of a group, seen from behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.body import CAMERA_MM, LED_MM, Body, Box, module
from cuspid.model.rig import Handpiece
from cuspid.runtime.options import Options, Range

ALIKE_DEG = 20.0
"""Cameras whose axes differ by less share a plate."""


@dataclass(frozen=True, kw_only=True)
class HolderOptions(Options):
    """What carries cameras and LEDs."""

    camera_mm: Annotated[tuple[float, float, float], Range(0.01, 1000)] = CAMERA_MM
    """Width, height and depth of a camera module, from its lens backwards."""
    led_mm: Annotated[tuple[float, float, float], Range(0.01, 1000)] = LED_MM
    """The same for an LED."""
    wall_mm: Annotated[float, Range(0.01, 100)] = 0.8
    """Thickness of the plates and bars."""
    bar_mm: Annotated[float, Range(0.01, 1000)] = 3.0
    """Width of the bars that join the plates."""
    neck_mm: Annotated[float, Range(0, 1000)] = 0.0
    """Length of a neck that leaves the middle of the holder backwards along the path; 0 omits it, as it is not known
    where the handpiece leaves the mouth."""
    neck_width_mm: Annotated[float, Range(0.01, 1000)] = 6.0
    """Width and height of the neck."""


def with_holder(handpiece: Handpiece, options: HolderOptions = HolderOptions()) -> Handpiece:
    """The handpiece with a body: its modules and what carries them."""
    cameras = {name: module(each.cam_from_rig, options.camera_mm) for name, each in handpiece.rig.cameras.items()}
    lights = {name: module(each.light_from_rig, options.led_mm) for name, each in handpiece.lights.items()}
    modules = [*cameras.values(), *lights.values()]
    plates = [_plate(handpiece, group, modules, options) for group in group_by_direction(handpiece)]
    parts: dict[str, Box] = {f"camera {name}": box for name, box in cameras.items()}
    parts |= {f"light {name}": box for name, box in lights.items()}
    parts |= {f"plate {number}": plate for number, plate in enumerate(plates, start=1)}
    parts |= {
        f"bar {number}": bar
        for number, bar in enumerate([_bar(plates[0], other, modules, options) for other in plates[1:]], start=1)
    }
    if options.neck_mm:
        parts["neck"] = _neck(plates[0], options)
    return replace(handpiece, body=Body(parts))


def group_by_direction(handpiece: Handpiece) -> list[list[str]]:
    """Cameras by the way they look, in the order of the rig."""
    groups: list[list[str]] = []
    for name, mounted in handpiece.rig.cameras.items():
        for group in groups:
            if handpiece.rig[group[0]].axis_in_rig @ mounted.axis_in_rig > np.cos(np.deg2rad(ALIKE_DEG)):
                group.append(name)
                break
        else:
            groups.append([name])
    return groups


def _plate(handpiece: Handpiece, group: Sequence[str], boxes: Sequence[Box], options: HolderOptions) -> Box:
    """A plate behind the modules of a group of cameras and the lights among them."""
    group_from_rig = handpiece.rig[group[0]].cam_from_rig
    axis = handpiece.rig[group[0]].axis_in_rig
    own = [module(handpiece.rig[name].cam_from_rig, options.camera_mm) for name in group]
    reach = spans(own, group_from_rig)
    near = [box for box in boxes if _belongs(box, group_from_rig, reach, axis)]
    low, high = spans([*own, *near], group_from_rig)
    back = low[2]
    centre = np.array([*(low[:2] + high[:2]) / 2, back - options.wall_mm / 2])
    half = np.array([*(high[:2] - low[:2]) / 2, options.wall_mm / 2])
    return Box(Rigid3(np.eye(3), -centre) @ group_from_rig, half)


def spans(boxes: Sequence[Box], group_from_rig: Rigid3) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner, in the frame of a group, of what boxes take up there."""
    corners = group_from_rig.apply(np.concatenate([box.corners for box in boxes]))
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def _belongs(box: Box, group_from_rig: Rigid3, reach: Float[np.ndarray, "2 3"], axis: Float[np.ndarray, "3"]) -> bool:
    """Whether a module looks the way a group does, and stands in its plane beside or among its cameras."""
    middle = group_from_rig.apply(box.box_from_rig.inverse().translation)
    sideways = (reach[1] - reach[0])[:2].max() / 2
    inside = np.all(middle > reach[0] - sideways) and np.all(middle < reach[1] + sideways)
    return bool(inside and box.box_from_rig.rotation[2] @ axis > np.cos(np.deg2rad(ALIKE_DEG)))


def _bar(one: Box, other: Box, modules: Sequence[Box], options: HolderOptions) -> Box:
    start, end = (box.box_from_rig.inverse().translation for box in (one, other))
    along = end - start
    length = float(np.linalg.norm(along))
    z = _outward(one, other, along / length)
    axes = np.stack([np.cross(along / length, z), along / length, z])
    half = np.array([options.bar_mm / 2, length / 2, options.wall_mm / 2])
    between_from_rig = Rigid3(axes, -axes @ (start + end) / 2)
    inner = max(-half[2], _farthest_back(modules, between_from_rig, half[1]))
    return Box(Rigid3(np.eye(3), np.array([0, 0, -inner - half[2]])) @ between_from_rig, half)


def _farthest_back(modules: Sequence[Box], between_from_rig: Rigid3, reach: float) -> float:
    """Largest Z of the modules' corners that lie no farther from the middle of a bar than its ends."""
    corners = between_from_rig.apply(np.concatenate([box.corners for box in modules]))
    return float(np.max(corners[np.abs(corners[:, 1]) <= reach, 2], initial=-np.inf))


def _outward(one: Box, other: Box, along: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The way out of the handpiece, square to a bar."""
    away = -(one.box_from_rig.rotation[2] + other.box_from_rig.rotation[2])
    away = away - (away @ along) * along
    if np.linalg.norm(away) < 1e-6:
        away = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    return np.asarray(away / np.linalg.norm(away))


def _neck(plate: Box, options: HolderOptions) -> Box:
    """Behind the first plate, along -X of its group, on the far side from what it looks at."""
    half = np.array([options.neck_mm / 2, options.neck_width_mm / 2, options.neck_width_mm / 2])
    centre = np.array([-options.neck_mm / 2, 0.0, -half[2] + plate.half_mm[2]])
    return Box(Rigid3(np.eye(3), -centre) @ plate.box_from_rig, half)
