"""Five frames of four cameras over textured hills, as a session takes them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from builders import InMemory
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, Frame
from cuspid.pipeline.scan import ReconstructionOptions
from synthetic_scene import diamond, height_field, render

HILLS = height_field(lambda x, y: 5 + 0.25 * np.sin(1.8 * x) * np.cos(1.5 * y), half_width_mm=6.0, count=400)
WAY = {
    f"{k:05d}": Rigid3.from_rotation_vector(np.array([0.01, -0.015, 0.02]) * k, np.array([-0.45, 0.1, 0.03]) * k)
    for k in range(5)
}
FIXED = ReconstructionOptions(calibration="fixed")


@cache
def scan() -> Capture:
    """Five frames of four cameras over the hills."""
    handpiece, rng = diamond(160), np.random.default_rng(3)
    images = {
        (frame, name): render(HILLS, mounted, pose, rng, cell_mm=0.1)
        for frame, pose in WAY.items()
        for name, mounted in handpiece.rig.cameras.items()
    }
    frames = tuple(Frame(name=frame, cameras=handpiece.rig.names) for frame in WAY)
    return Capture(handpiece=handpiece, frames=frames, source=InMemory(images))


def smooth() -> np.ndarray:
    """An image of a plain surface."""
    return np.tile(np.linspace(90, 160, 160)[:, None, None], (1, 160, 3)).astype(np.uint8)


def with_frame(capture: Capture, name: str, image: np.ndarray) -> Capture:
    """With another image in all cameras of one frame."""
    images = {key: image if key[0] == name else each for key, each in capture.source.images.items()}
    return replace(capture, source=InMemory(images))
