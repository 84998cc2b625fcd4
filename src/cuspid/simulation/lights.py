"""Lights for a handpiece of which none are known."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from cuspid.rig import Handpiece, Light, Lighting, MountedCamera

_BESIDE = 0.1
"""Of the working distance: how far a light lies from its camera."""

_log = logging.getLogger("cuspid")


def lit(handpiece: Handpiece) -> Handpiece:
    """The handpiece, or, said aloud, with one light beside each camera where it has none."""
    if handpiece.lights:
        return handpiece
    _log.info(f"handpiece {handpiece.name}: it has no lights; one beside each camera is assumed")
    offset_mm = _BESIDE * handpiece.working_distance_mm
    lights = {name: _beside(mounted, offset_mm) for name, mounted in handpiece.rig.cameras.items()}
    return replace(handpiece, lights=lights, lightings=(Lighting(lights=tuple(lights)),))


def _beside(mounted: MountedCamera, offset_mm: float) -> Light:
    """To the right of the camera, in its plane, shining along its axis."""
    place = mounted.cam_from_rig.inverse().apply(np.array([offset_mm, 0.0, 0.0]))
    return Light(position_mm=place, direction=mounted.axis_in_rig)
