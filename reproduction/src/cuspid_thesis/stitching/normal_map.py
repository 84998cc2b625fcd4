"""Rectified normals as a picture: the image in which the thesis looks for features (4.1).

Shape from shading gives rough normals N in the camera frame. They are crossed with the direction towards the light,
L = (0, 0, -1), for light and camera look the same way and the light counts as distant here; the result lies in the
image plane and is as long as the sine of the angle between them. A mean filter follows. The picture is a tangent space
normal map: R = (x + 1) / 2, G = (y + 1) / 2, B = z.

The thesis maps a Z that is always positive, but the cross product with L has none: z is taken as what makes the vector
a unit one, z = sqrt(1 - x^2 - y^2), the cosine of the angle to the light.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

LIGHT = np.array([0.0, 0.0, -1.0])
"""Unit vector from the surface towards the light, in the camera frame."""


def rectify(normals: Float[np.ndarray, "h w 3"], window: int) -> Float[np.ndarray, "h w 3"]:
    """Normals crossed with the direction of the light, behind a mean filter of the given width in px."""
    crossed = np.cross(normals, LIGHT).astype(np.float32)
    return np.asarray(cv2.blur(crossed, (window, window), borderType=cv2.BORDER_REPLICATE))


def normal_map(rectified: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """RGB picture, 0 to 1, of rectified normals."""
    x, y = rectified[..., 0], rectified[..., 1]
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    return np.asarray(np.stack([(x + 1) / 2, (y + 1) / 2, z], axis=-1), dtype=np.float32)


def grey_normal_map(picture: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """The normal map as a grey picture, 0 to 1 (Rec. 601)."""
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
