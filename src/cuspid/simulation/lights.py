"""Lights for a handpiece that has none."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera

_BESIDE = 0.1
"""Distance of a light from its camera, as a share of the working distance."""

_log = logging.getLogger("cuspid")


def with_default_lights(handpiece: Handpiece) -> Handpiece:
    """The handpiece; if it has no lights, with one beside each camera, which is logged."""
    if handpiece.lights:
        return handpiece
    _log.info(f"handpiece {handpiece.name}: it has no lights; one beside each camera is assumed")
    offset_mm = _BESIDE * handpiece.working_distance_mm
    lights = {name: _light_beside(mounted, offset_mm) for name, mounted in handpiece.rig.cameras.items()}
    return replace(handpiece, lights=lights, lightings=(Lighting(lights=tuple(lights)),))


def _light_beside(mounted: MountedCamera, offset_mm: float) -> Light:
    """To the right of the camera, in its plane, shining along its axis."""
    place = mounted.cam_from_rig.inverse().apply(np.array([offset_mm, 0.0, 0.0]))
    return Light(position_mm=place, direction=mounted.axis_in_rig)
