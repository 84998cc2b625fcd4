"""Three frames of four cameras over textured hills."""

from __future__ import annotations

from functools import cache

import numpy as np

from builders import Images, InMemory
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, Frame
from cuspid.model.rig import Handpiece
from synthetic_scene import diamond, height_field, render

HILLS = height_field(lambda x, y: 5 + 0.25 * np.sin(1.8 * x) * np.cos(1.5 * y), half_width_mm=5.0)
SIZE_PX = 160
WAY = {
    f"{k:05d}": Rigid3.from_rotation_vector(np.array([0.01, -0.015, 0.02]) * k, np.array([-0.5, 0.1, 0.03]) * k)
    for k in range(3)
}


@cache
def scan() -> Capture:
    """Three frames of four cameras over the hills."""
    handpiece, rng = diamond(SIZE_PX), np.random.default_rng(3)
    images = {
        (frame, name): render(HILLS, mounted, pose, rng, cell_mm=0.1)
        for frame, pose in WAY.items()
        for name, mounted in handpiece.rig.cameras.items()
    }
    return capture_of(handpiece, images)


def capture_of(handpiece: Handpiece, images: Images) -> Capture:
    frames = tuple(Frame(name=frame, cameras=handpiece.rig.names) for frame in WAY)
    return Capture(handpiece=handpiece, frames=frames, source=InMemory(images))
