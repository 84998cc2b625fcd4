"""COLMAP's types and files."""

from __future__ import annotations

import numpy as np
import pycolmap

from cuspid.camera import Camera
from cuspid.geometry import Rigid3


def colmap_camera(camera: Camera) -> pycolmap.Camera:
    """COLMAP's OPENCV camera; it has the same parameters and pixel origin."""
    return pycolmap.Camera(model="OPENCV", width=camera.width, height=camera.height, params=camera.parameters.tolist())


def colmap_rigid(transform: Rigid3) -> pycolmap.Rigid3d:
    """The transform as COLMAP has it."""
    return pycolmap.Rigid3d(transform.matrix[:3])


def rigid_from_colmap(transform: pycolmap.Rigid3d) -> Rigid3:
    """COLMAP's transform as a value."""
    return Rigid3.from_matrix(np.asarray(transform.matrix()))
