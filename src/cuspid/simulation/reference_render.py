"""A reference render: a single image of a jaw from above, the ground truth for a panorama (thesis 4.3).

The camera looks straight down on the occlusal plane, orthographic or from a height, with its light beside it, as the
thesis assumes for the frames. Pixels: see :class:`cuspid.model.trueness.ReferenceRender`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int16

from cuspid.model.mesh import RayHits
from cuspid.model.trueness import NOTHING, ReferenceRender
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range
from cuspid.simulation.raycast import BRIGHT_LEVEL, BRIGHT_PERCENTILE, Scene, radiance_along
from cuspid.simulation.sensor import expose
from cuspid.simulation.shadows import Lamps

FAR_LIGHT_MM = 1000.0
"""Height of the light for an orthographic view, from which its direction is within 2 deg of straight down over the
whole arch."""
_ABOVE_MM = 5.0
"""Height above the jaw from which orthographic rays start."""
_ROWS = 64
"""Rows of the picture that are traced at once; limits the memory."""


@dataclass(frozen=True, kw_only=True)
class ReferenceRenderOptions(Options):
    """How the jaw is rendered from above."""

    mm_per_px: Annotated[float, Range(0.001, 10)] = 0.05
    """Millimetres per pixel, in the occlusal plane."""
    margin_mm: Annotated[float, Range(0, 1000)] = 2.0
    """Margin around the jaw."""
    camera_height_mm: Annotated[float | None, Range(0.1, 100_000)] = None
    """Height of the camera and its light above the occlusal plane; None for an orthographic view."""


def render_reference(scene: Scene, options: ReferenceRenderOptions = ReferenceRenderOptions()) -> ReferenceRender:
    """The jaw from above, with the materials, texture and sensor gamma of its scene, without noise."""
    low, high = scene.jaw.mesh.bounds
    height = options.camera_height_mm
    if height is not None and height < high[2] + _ABOVE_MM:
        raise InputError(
            f"reference render: the camera at {height:g} mm is inside the jaw, which reaches up to "
            f"{high[2]:.1f} mm; raise the camera"
        )
    sides = (high - low + 2 * options.margin_mm) / options.mm_per_px
    columns, bottom = int(np.ceil(sides[0])), int(np.ceil(sides[1]))
    origin = np.array([options.margin_mm - low[0], options.margin_mm + high[1]]) / options.mm_per_px
    light = np.zeros((bottom, columns, 3), dtype=np.float32)
    heights = np.full(light.shape[:2], np.nan, dtype=np.float32)
    labels = np.full(light.shape[:2], NOTHING, dtype=np.int16)
    for top in range(0, bottom, _ROWS):
        rows = slice(top, min(top + _ROWS, bottom))
        light[rows] = _light(scene, _on_plane(rows, columns, scene.supersampling, origin, options), height)
        heights[rows], labels[rows] = _surface(scene, _on_plane(rows, columns, 1, origin, options), height)
    quiet = replace(scene.handpiece.sensor, noise_dn=0.0)
    return ReferenceRender(
        image=expose(light, _gain(light), quiet, np.random.default_rng(0)),
        labels=labels,
        height_mm=heights,
        mm_per_px=options.mm_per_px,
        origin_px=origin,
        camera_height_mm=height,
    )


def _on_plane(
    rows: slice, width: int, samples: int, origin_px: Float[np.ndarray, "2"], options: ReferenceRenderOptions
) -> Float[np.ndarray, "r w s 2"]:
    """Where the rays through some rows of pixels meet the occlusal plane, mm."""
    offsets = (np.arange(samples) + 0.5) / samples
    within = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    corners = np.stack(np.meshgrid(np.arange(width), np.arange(rows.start, rows.stop)), axis=-1)
    return (corners[:, :, None] + within - origin_px) * [1, -1] * options.mm_per_px


def _rays(
    scene: Scene, plane: Float[np.ndarray, "*n 2"], height_mm: float | None
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    flat = plane.reshape(-1, 2)
    if height_mm is None:
        above = scene.jaw.mesh.bounds[1, 2] + _ABOVE_MM
        return np.column_stack([flat, np.full(len(flat), above)]), np.broadcast_to([0, 0, -1.0], (len(flat), 3))
    directions = np.column_stack([flat, np.full(len(flat), -height_mm)])
    return np.broadcast_to([0, 0, height_mm], directions.shape), directions / height_mm


def _light(scene: Scene, plane: Float[np.ndarray, "r w s 2"], height_mm: float | None) -> Float[np.ndarray, "r w 3"]:
    lamp_mm = height_mm or FAR_LIGHT_MM
    lamp = Lamps(np.array([[0, 0, lamp_mm]]), np.array([[0, 0, -1.0]]), np.full((1, 3), lamp_mm**2), *np.ones((2, 1)))
    return radiance_along(scene, *_rays(scene, plane, height_mm), plane.shape[1], lamp)


def _surface(
    scene: Scene, plane: Float[np.ndarray, "r w 1 2"], height_mm: float | None
) -> tuple[Float[np.ndarray, "r w"], Int16[np.ndarray, "r w"]]:
    """Height and label at each pixel's centre."""
    origins, directions = _rays(scene, plane, height_mm)
    hits = scene.jaw.mesh.cast(origins, directions)
    heights = origins[:, 2] + np.where(hits.faces >= 0, hits.distances, np.nan) * directions[:, 2]
    return heights.reshape(plane.shape[:2]), _labels(scene, hits).reshape(plane.shape[:2])


def _labels(scene: Scene, hits: RayHits) -> Int16[np.ndarray, "n"]:
    known = scene.jaw.face_labels
    labels = np.zeros(len(hits.faces), dtype=np.int16) if known is None else known[hits.faces].astype(np.int16)
    return np.where(hits.faces >= 0, labels, np.int16(NOTHING))


def _gain(light: Float[np.ndarray, "h w 3"]) -> float:
    """As the exposure of a capture is metered."""
    levels = light.mean(axis=-1)
    return float(BRIGHT_LEVEL / np.percentile(levels[levels > 0], BRIGHT_PERCENTILE))
