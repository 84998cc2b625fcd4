"""The method ``ortho``: located frames, rectified on the surface, as a panorama in the occlusal frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from cuspid.geometry import Rigid3, best_similarity
from cuspid.model.panorama import FrameUse, Panorama, Strip
from cuspid.model.sparse_model import SparseModel
from cuspid.runtime.progress import Progress, silent
from cuspid.stitching.compared import Compared, frames_beside
from cuspid.stitching.height_map import (
    HeightMap,
    HeightMapOptions,
    ScaleOptions,
    height_map,
    in_occlusal_frame,
    lower_false_rises,
    scale_factor,
    transform_model,
)
from cuspid.stitching.levelling import level_by_crowns, tilt_surface
from cuspid.stitching.mosaic import Mosaic, MosaicOptions, compose
from cuspid.stitching.plane_sweep import PlaneSweepOptions, plane_sweep
from cuspid.stitching.strip import StripOptions, unroll

_SLACK = 2.0
"""The surface may lie so many times as far from the one before as the camera moved what it looks at."""


@dataclass(frozen=True, kw_only=True)
class OrthoOptions:
    """From located frames to a panorama."""

    scale: ScaleOptions = field(default_factory=ScaleOptions)
    """What sets the scale."""
    height_map: HeightMapOptions = field(default_factory=HeightMapOptions)
    """The smooth surface through the sparse points of the motion."""
    plane_sweep: PlaneSweepOptions = field(default_factory=PlaneSweepOptions)
    """The dense surface on which frames are rectified."""
    mosaic: MosaicOptions = field(default_factory=MosaicOptions)
    """Choice of frames, gain compensation, blending."""
    strip: StripOptions = field(default_factory=StripOptions)
    """The unrolled strip."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Stitched:
    """One panorama and what belongs to it."""

    panorama: Panorama
    """The occlusal view."""
    motion: SparseModel | None
    """The camera's trajectory, in the panorama's world and its lengths; None where the method locates no camera."""
    strip: Strip | None
    """The panorama unrolled along the arch; None where the camera hardly moved, or is not located."""


class Shown(NamedTuple):
    """What located frames show, in the occlusal frame."""

    motion: SparseModel
    """The frames."""
    sparse: HeightMap
    """The smooth surface through the points of the motion."""
    dense: HeightMap | None
    """The surface on which images agree; None where none are compared."""
    scale: ScaleOptions | None
    """What sets the scale; None where the cameras know it."""


def find_surface(
    located: SparseModel,
    read: Callable[[str], UInt8[np.ndarray, "h w 3"]],
    options: OrthoOptions,
    *,
    working_distance_mm: float | None = None,
    beside: Compared | None = None,
    progress: Progress = silent,
) -> Shown:
    """What the frames of one model of the motion show; ``read`` gives an image by its name.

    ``working_distance_mm``: nominal, from the calibration. ``beside``: images of the cameras of one instant, in the
    world of the model, from which the surface is found; the model then is in millimetres and keeps its scale. Raises
    ReconstructionError where there are no points.
    """
    scale = None
    if beside is None:
        given = options.scale.working_distance_mm
        scale = replace(options.scale, working_distance_mm=working_distance_mm if given is None else given)
    motion = in_occlusal_frame(located, scale)
    sparse = height_map(motion, options.height_map)
    return Shown(motion, sparse, _dense(located, motion, sparse, read, beside, options, progress), scale)


def find_surface_again(
    shown: Shown,
    located: SparseModel,
    read: Callable[[str], UInt8[np.ndarray, "h w 3"]],
    options: OrthoOptions,
    *,
    beside: Compared | None = None,
    progress: Progress = silent,
) -> Shown:
    """What the same frames show whose poses are known better, with the surface near the one that they showed before,
    and rescaled to what sets the scale; arguments as for :func:`find_surface`."""
    motion = _align_to_model(located, shown.motion, keeps_scale=beside is not None)
    sparse = height_map(motion, options.height_map)
    start = None if shown.dense is None else (shown.dense, _SLACK * _largest_shift(motion, shown.motion))
    dense = _dense(located, motion, sparse, read, beside, options, progress, start)
    factor = 1.0 if shown.scale is None else scale_factor(motion, shown.scale)
    surface = None if dense is None else dense.scaled(factor)
    return Shown(motion.scaled(factor), sparse.scaled(factor), surface, shown.scale)


def orthophoto(
    shown: Shown,
    frames: Sequence[FrameUse],
    read: Callable[[str], UInt8[np.ndarray, "h w 3"]],
    options: OrthoOptions,
    *,
    progress: Progress = silent,
) -> Stitched:
    """The panorama of what located frames show; ``read`` gives an image by its name."""
    motion, surface, dense, scale = shown
    if dense is not None:
        level = level_by_crowns(dense)
        motion = transform_model(motion, level)
        surface = lower_false_rises(tilt_surface(dense, level), height_map(motion, options.height_map), motion)
    mosaic = compose(motion, surface, read, options.mosaic, progress=progress)
    metric = scale is None or scale.working_distance_mm is not None or scale.width_mm is not None
    panorama = _panorama(mosaic, motion, frames, metric)
    if scale is not None:
        panorama = replace(panorama, notes=(_scale_note(scale, given=scale == options.scale),))
    strip = unroll(panorama, motion, surface, mosaic.canvas.mm_per_px, options.strip)
    in_its_units = motion if metric else motion.scaled(1 / mosaic.canvas.mm_per_px)
    return Stitched(panorama=panorama, motion=in_its_units, strip=strip)


def _dense(
    located: SparseModel,
    motion: SparseModel,
    sparse: HeightMap,
    read: Callable[[str], UInt8[np.ndarray, "h w 3"]],
    beside: Compared | None,
    options: OrthoOptions,
    progress: Progress,
    start: tuple[HeightMap, float] | None = None,
) -> HeightMap | None:
    """The surface on which cameras of one instant agree; without such, frames of one camera."""
    if not options.plane_sweep.enabled:
        return None
    if beside is None:
        compared = frames_beside(motion, options.plane_sweep.baseline_share)
    else:
        compared = beside.in_world(into_occlusal_frame(located, motion).inverse())
    return plane_sweep(motion, compared, sparse, read, options.plane_sweep, start=start, progress=progress)


def into_occlusal_frame(located: SparseModel, motion: SparseModel) -> Rigid3:
    """The motion from the world of a model in millimetres to that of the same in the occlusal frame."""
    first = motion.frames[0]
    return motion.cam_from_world[first].inverse() @ located.cam_from_world[first]


def _align_to_model(model: SparseModel, other: SparseModel, *, keeps_scale: bool) -> SparseModel:
    """A model in the world of another one of the same frames, to which its cameras lie nearest."""
    seen, there = _tripods(model, float(np.median(model.depths))), _tripods(other, float(np.median(other.depths)))
    scale, rotation, _ = best_similarity(seen, there)
    scale = 1.0 if keeps_scale else scale
    onto = Rigid3(rotation, there.mean(axis=0) - scale * rotation @ seen.mean(axis=0))
    return transform_model(model.scaled(scale), onto)


def _largest_shift(model: SparseModel, other: SparseModel) -> float:
    """The farthest way between what one and what the other has in the middle of the same frame."""
    depth = float(np.median(other.depths))
    ways = _tripods(model, depth)[3::4] - _tripods(other, depth)[3::4]
    return float(np.linalg.norm(ways, axis=1).max())


def _tripods(model: SparseModel, length: float) -> Float[np.ndarray, "k 3"]:
    """The centre of each camera, and a point on each of its axes."""
    legs = length * np.vstack([np.zeros(3), np.eye(3)])
    return np.concatenate([pose.inverse().apply(legs) for pose in model.cam_from_world.values()])


_TRUER = "measure between two cusps, and correct it with cuspid pano rescale"


def _scale_note(scale: ScaleOptions, *, given: bool) -> str:
    if scale.width_mm is not None:
        return f"the scale assumes an arch {scale.width_mm:g} mm wide; {_TRUER}"
    if scale.working_distance_mm is None:
        return (
            "the scale is not known, so nothing is in millimetres: give --scale.working-distance-mm, or measure "
            "between two cusps and use cuspid pano rescale"
        )
    source = "as given" if given else "as the calibration says"
    return (
        f"the scale assumes a camera held {scale.working_distance_mm:g} mm over the teeth, {source}; "
        f"it is no more accurate than that: {_TRUER}"
    )


def _panorama(mosaic: Mosaic, motion: SparseModel, frames: Sequence[FrameUse], metric: bool) -> Panorama:
    """The mosaic as the noun; its frames are numbered as in the sequence."""
    canvas, index = mosaic.canvas, {frame.name: number for number, frame in enumerate(frames)}
    number = np.array([index[name] for name in motion.frames] + [-1])
    overlaps = dict(zip(motion.frames, mosaic.overlaps, strict=True))
    return Panorama(
        image=mosaic.image,
        covered=mosaic.frame >= 0,
        frame_index=number[mosaic.frame].astype(np.int16),
        frame_pixel=mosaic.frame_pixel,
        frames=tuple(replace(frame, overlap=overlaps.get(frame.name)) for frame in frames),
        method="ortho",
        origin_px=canvas.origin_px,
        mm_per_px=canvas.mm_per_px if metric else None,
        height_mm=mosaic.height_mm if metric else mosaic.height_mm / np.float32(canvas.mm_per_px),
    )
