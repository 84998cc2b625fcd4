"""Handpieces: the thesis' essential four cameras (3.5.1), twelve (3.5.2) and six (3.5.3), and a stereo pair.

Rig frame: origin at the height of the cusp tips under the probe, +X along the arch in the direction of
travel, +Y across the arch towards the cheek (buccal), +Z out of the gum. A group is four cameras with parallel axes in
one plane: two across the arch and two along the curve of Spee, with the LEDs at the corners between them.

    image up        o occlusal: +X to the right of the image, buccal up
     5              b buccal:   -X to the right, occlusal up
     1              l lingual:  +X to the right, occlusal up
   3   4
     2              5 and 6 only where the design has outer cameras
     6
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from types import MappingProxyType
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.handpiece.cad.holder import HolderOptions, with_holder
from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig, depth_of_field_mm
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range


@dataclass(frozen=True, kw_only=True)
class DesignOptions(Options):
    """What the designs of the thesis have in common."""

    width_px: Annotated[int, Range(16, 10_000)] = 500
    """Image width in px."""
    height_px: Annotated[int, Range(16, 10_000)] = 500
    """Image height in px."""
    field_of_view_deg: Annotated[float, Range(1, 170)] = 62.0
    """Full horizontal angle of view."""
    working_distance_mm: Annotated[float, Range(0.1, 1000)] = 5.0
    """Distance from the cameras to the surface that they look at."""
    baseline_across_mm: Annotated[float, Range(0.01, 1000)] = 2.5
    """Distance between the two cameras across the arch (up and down the tooth for the side groups)."""
    baseline_along_mm: Annotated[float, Range(0.01, 1000)] = 1.5
    """Distance between the two cameras along the curve of Spee."""
    side_tilt_deg: Annotated[float, Range(-90, 90)] = 60.0
    """Angle between the occlusal axis and the axes of the buccal and lingual groups (twelve cameras only)."""
    side_offset_mm: Annotated[float, Range(-1000, 1000)] = 4.5
    """Distance from the middle of the crown to where the axes of the side groups meet its side (twelve cameras
    only)."""
    side_depth_mm: Annotated[float, Range(-1000, 1000)] = 2.5
    """Depth below the cusp tips at which the axes of the side groups meet the side (twelve cameras only)."""
    outer_distance_mm: Annotated[float, Range(0.01, 1000)] = 2.0
    """Distance from the outer of the four cameras across the arch to the additional one on each side (six cameras
    only)."""
    outer_tilt_deg: Annotated[float, Range(-89, 89)] = 0.0
    """How far the axes of these two tilt towards the middle of the tooth (six cameras only)."""
    lights: Literal["white", "colour-coded", "in-turn"] = "white"
    """white: four LEDs among the cameras of each group. colour-coded: a red, a green and a blue one about each group,
    with crossed polarisers before them and the lenses, which scan plain enamel. in-turn: without polarisers, but with
    three more LEDs between these, which are on in every second exposure: mirror reflections then lie elsewhere."""
    ring_mm: Annotated[float, Range(0.01, 1000)] = 4.5
    """Distance of coloured LEDs from the middle of their group. The farther apart they are, the more their shades
    differ; much farther, and an LED shines into what carries another group."""
    holder: HolderOptions = field(default_factory=HolderOptions)
    """What carries cameras and LEDs."""


def stereo_pair(options: DesignOptions = DesignOptions()) -> Handpiece:
    """The two cameras of the essential four that lie across the arch, with the same lights."""
    four = _four(options)
    pair = replace(four, rig=Rig({name: four.rig[name] for name in ("o1", "o2")}), name="stereo-pair")
    return with_holder(pair, options.holder)


def essential_four(options: DesignOptions = DesignOptions()) -> Handpiece:
    """Four cameras that look down on the occlusal or incisal surface (thesis 3.5.1)."""
    return with_holder(_four(options), options.holder)


def twelve_cameras(options: DesignOptions = DesignOptions()) -> Handpiece:
    """Three groups of four in a U-shaped holder: occlusal, buccal and lingual (thesis 3.5.2)."""
    views = {"o": _occlusal_view(options), "b": _side_view(options, +1), "l": _side_view(options, -1)}
    return with_holder(_handpiece("twelve-cameras", views, options), options.holder)


def six_cameras(options: DesignOptions = DesignOptions()) -> Handpiece:
    """The essential four and one more on either side of them, for a handpiece that is also rolled (thesis 3.5.3).

    The thesis says "in both sides with a 2mm away from the essential sensors": read as farther out across the arch, in
    line with the two cameras there, 2 mm from the nearer of them. Between the two lies an LED.
    """
    four = _four(options)
    cameras = {f"o{5 + k}": _outer_camera(options, side) for k, side in enumerate((+1, -1))}
    six = replace(four, rig=Rig({**four.rig.cameras, **cameras}), name="six-cameras")
    if options.lights == "white":
        lights = {**four.lights, **{f"o{5 + k}": _outer_light(options, side) for k, side in enumerate((+1, -1))}}
        six = replace(six, lights=lights, lightings=_single_lighting(lights))
    return with_holder(six, options.holder)


DesignName = Literal["two", "four", "six", "twelve"]
"""A built-in design: a stereo pair, the essential four cameras, six cameras (to be turned), or all twelve."""
DESIGNS: Mapping[str, Callable[[DesignOptions], Handpiece]] = MappingProxyType(
    {"two": stereo_pair, "four": essential_four, "six": six_cameras, "twelve": twelve_cameras}
)
"""Designs by the name that the command line takes."""


def build_handpiece(design: DesignName = "twelve", options: DesignOptions = DesignOptions()) -> Handpiece:
    """A handpiece of a built-in design. Raises InputError where there is no such design."""
    if design not in DESIGNS:
        raise InputError(f"handpiece: there is no design {design!r}; it is one of {', '.join(DESIGNS)}")
    return DESIGNS[design](options)


def _four(options: DesignOptions) -> Handpiece:
    return _handpiece("essential-four", {"o": _occlusal_view(options)}, options)


def _handpiece(name: str, views: Mapping[str, Rigid3], options: DesignOptions) -> Handpiece:
    cameras: dict[str, MountedCamera] = {}
    for prefix, group_from_rig in views.items():
        cameras |= _group_cameras(prefix, group_from_rig, options)
    lights, lightings = _add_leds(views, options)
    return Handpiece(
        rig=Rig(cameras),
        lights=lights,
        lightings=lightings,
        working_distance_mm=options.working_distance_mm,
        depth_range_mm=depth_of_field_mm(options.working_distance_mm),
        name=name,
    )


def _occlusal_view(options: DesignOptions) -> Rigid3:
    return look_at(np.zeros(3), np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), options.working_distance_mm)


def _side_view(options: DesignOptions, side: int) -> Rigid3:
    """``group_from_rig`` of the buccal (side +1) or lingual (-1) group; image up is occlusal."""
    tilt = np.deg2rad(options.side_tilt_deg)
    target = np.array([0, side * options.side_offset_mm, -options.side_depth_mm])
    axis = np.array([0, -side * np.sin(tilt), -np.cos(tilt)])
    return look_at(target, axis, np.array([-side, 0.0, 0.0]), options.working_distance_mm)


def _outer_camera(options: DesignOptions, side: int) -> MountedCamera:
    tilt = np.deg2rad(options.outer_tilt_deg)
    axis = np.array([0, -side * np.sin(tilt), -np.cos(tilt)])
    centre = np.array([0, side * _outer_place_mm(options), options.working_distance_mm])
    camera = Camera.from_field_of_view(options.width_px, options.height_px, options.field_of_view_deg)
    return MountedCamera(camera, look_at(centre, axis, np.array([1.0, 0, 0]), 0.0))


def _outer_light(options: DesignOptions, side: int) -> Light:
    middle = _outer_place_mm(options) - options.outer_distance_mm / 2
    return Light(
        position_mm=np.array([0, side * middle, options.working_distance_mm]), direction=np.array([0, 0, -1.0])
    )


def _outer_place_mm(options: DesignOptions) -> float:
    """Of the outer cameras, from the middle of the rig across the arch."""
    return options.baseline_across_mm / 2 + options.outer_distance_mm


def look_at(
    target: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"], right: Float[np.ndarray, "3"], distance_mm: float
) -> Rigid3:
    """``view_from_rig`` of a view along ``axis`` onto a point, with ``right`` to the right of the image."""
    rotation = np.stack([right, np.cross(axis, right), axis])
    return Rigid3(rotation, -rotation @ (target - distance_mm * axis))


def _group_cameras(prefix: str, group_from_rig: Rigid3, options: DesignOptions) -> dict[str, MountedCamera]:
    camera = Camera.from_field_of_view(options.width_px, options.height_px, options.field_of_view_deg)
    across, along = options.baseline_across_mm / 2, options.baseline_along_mm / 2
    places = [(0, -across), (0, across), (-along, 0), (along, 0)]
    return {
        f"{prefix}{k + 1}": MountedCamera(camera, Rigid3(np.eye(3), np.array([-x, -y, 0.0])) @ group_from_rig)
        for k, (x, y) in enumerate(places)
    }


def _add_leds(views: Mapping[str, Rigid3], options: DesignOptions) -> tuple[dict[str, Light], tuple[Lighting, ...]]:
    """The LEDs about all groups, and which of them are on together."""
    if options.lights == "white":
        white = {name: light for view in views.items() for name, light in _group_lights(*view, options).items()}
        return white, _single_lighting(white)
    in_turn = options.lights == "in-turn"
    first = _coded_lights(views, options, glare=1.0 if in_turn else _CROSSED)
    if not in_turn:
        return first, _single_lighting(first)
    second = _coded_lights(views, options, glare=1.0, turned_deg=_BETWEEN_DEG, suffix="2")
    return first | second, (Lighting(name="first", lights=tuple(first)), Lighting(name="second", lights=tuple(second)))


def _single_lighting(lights: Mapping[str, Light]) -> tuple[Lighting, ...]:
    return (Lighting(name="all", lights=tuple(lights)),)


def _group_lights(prefix: str, group_from_rig: Rigid3, options: DesignOptions) -> dict[str, Light]:
    """Four LEDs in the plane of the cameras, at the corners between them, shining along the axes."""
    across, along = options.baseline_across_mm / 2, options.baseline_along_mm
    rig_from_group = group_from_rig.inverse()
    axis = rig_from_group.rotate(np.array([0, 0, 1.0]))
    corners = [(x, y, 0.0) for y in (-across, across) for x in (-along, along)]
    return {
        f"{prefix}{k + 1}": Light(position_mm=rig_from_group.apply(np.array(corner)), direction=axis)
        for k, corner in enumerate(corners)
    }


_CODED = {"r": ((1.0, 0.0, 0.0), 1.0, 150.0), "g": ((0.0, 1.0, 0.0), 1.0, 270.0), "b": ((0.0, 0.0, 1.0), 1.4, 30.0)}
"""Colour of each LED, its power (enamel is yellowish), and where it stands about its group, deg from the right of the
image anticlockwise: of a group beside the teeth two at the height of the cusps, one nearer to the gum."""
_CROSSED = 0.03
"""Share of a mirror reflection that passes crossed polarising films."""
_BETWEEN_DEG = 60.0
"""How far a second triple of LEDs is turned about its group, to stand between those of the first."""


def _coded_lights(
    views: Mapping[str, Rigid3], options: DesignOptions, *, glare: float, turned_deg: float = 0.0, suffix: str = ""
) -> dict[str, Light]:
    """Three LEDs in the plane of the cameras of each group, on a ring about them, shining along the axes."""
    lights = {}
    for (prefix, group_from_rig), (name, (colour, power, place_deg)) in product(views.items(), _CODED.items()):
        rig_from_group, angle = group_from_rig.inverse(), np.deg2rad(place_deg + turned_deg)
        place = options.ring_mm * np.array([np.cos(angle), -np.sin(angle), 0.0])
        lights[f"{prefix}{name}{suffix}"] = Light(
            position_mm=rig_from_group.apply(place),
            direction=rig_from_group.rotate(np.array([0, 0, 1.0])),
            power=power,
            colour=np.array(colour),
            glare=glare,
        )
    return lights
