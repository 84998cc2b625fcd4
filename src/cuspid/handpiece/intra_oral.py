"""One intra-oral camera in a wand, with its LEDs in a ring around the lens (thesis chapter 4), or two of them side by
side, which know the scale of what they see.

Rig frame as in :mod:`cuspid.handpiece.designs`: origin at the cusp tips under the camera, +X along the arch and to
the right of the image, +Y towards the cheek and up in the image, +Z out of the gum.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from cuspid.handpiece.cad.holder import HolderOptions, with_holder
from cuspid.handpiece.designs import look_at
from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig
from cuspid.runtime.options import Options, Range


@dataclass(frozen=True, kw_only=True)
class IntraOralOptions(Options):
    """A video camera that is held over the teeth, or a pair of them."""

    cameras: Annotated[int, Range(1, 2)] = 1
    """One camera, or two that are turned towards each other so that they look at the same place on the teeth."""
    baseline_mm: Annotated[float, Range(0.1, 1000)] = 5.0
    """Distance between two cameras, along the arch."""
    width_px: Annotated[int, Range(16, 10_000)] = 640
    """Image width in px."""
    height_px: Annotated[int, Range(16, 10_000)] = 480
    """Image height in px."""
    field_of_view_deg: Annotated[float, Range(1, 170)] = 62.0
    """Full horizontal angle of view."""
    working_distance_mm: Annotated[float, Range(0.1, 1000)] = 14.0
    """Distance from the camera to the cusp tips."""
    leds: Annotated[int, Range(1, 100)] = 4
    """Number of LEDs around the lens."""
    led_ring_mm: Annotated[float, Range(0, 1000)] = 3.0
    """Radius of the ring of LEDs."""
    holder: HolderOptions = field(default_factory=HolderOptions)
    """What carries the camera and the LEDs."""


def intra_oral_camera(options: IntraOralOptions = IntraOralOptions()) -> Handpiece:
    """A handpiece of one camera, named ``camera``, that looks down on the teeth, or of two, ``left`` and ``right``."""
    down = np.array([0, 0, -1.0])
    angles = 2 * np.pi * (np.arange(options.leds) + 0.5) / options.leds
    lights = {
        f"led{k + 1}": Light(
            position_mm=np.array(
                [*options.led_ring_mm * np.array([np.cos(angle), np.sin(angle)]), options.working_distance_mm]
            ),
            direction=down,
        )
        for k, angle in enumerate(angles)
    }
    bare = Handpiece(
        rig=Rig(_cameras(options)),
        lights=lights,
        lightings=(Lighting(name="all", lights=tuple(lights)),),
        working_distance_mm=options.working_distance_mm,
        depth_range_mm=(options.working_distance_mm / 3, 2.5 * options.working_distance_mm),
        name="intra-oral-camera" if options.cameras == 1 else "intra-oral-pair",
    )
    return with_holder(bare, options.holder)


def _cameras(options: IntraOralOptions) -> dict[str, MountedCamera]:
    camera = Camera.from_field_of_view(options.width_px, options.height_px, options.field_of_view_deg)
    places = {"camera": 0.0} if options.cameras == 1 else {"left": -0.5, "right": 0.5}
    mounted = {}
    for name, place in places.items():
        eye = np.array([place * options.baseline_mm, 0, options.working_distance_mm])
        axis = -eye / np.linalg.norm(eye)
        right = np.array([-axis[2], 0, axis[0]])
        mounted[name] = MountedCamera(camera, look_at(np.zeros(3), axis, right, float(np.linalg.norm(eye))))
    return mounted
