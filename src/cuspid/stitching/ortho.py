"""The method ``ortho``: located frames, rectified on the surface, as a panorama in the occlusal frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import UInt8

from cuspid.image_sequence import ImageSequence
from cuspid.panorama import FrameUse, Panorama, Strip
from cuspid.progress import Progress, silent
from cuspid.sparse_model import SparseModel
from cuspid.stitching.height_map import HeightMapOptions, ScaleOptions, height_map, in_occlusal_frame, uncovered
from cuspid.stitching.mosaic import Mosaic, MosaicOptions, compose
from cuspid.stitching.plane_sweep import PlaneSweepOptions, plane_sweep
from cuspid.stitching.strip import StripOptions, unroll


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


def orthophoto(
    sequence: ImageSequence,
    located: SparseModel,
    frames: Sequence[FrameUse],
    options: OrthoOptions,
    *,
    progress: Progress = silent,
) -> Stitched:
    """The panorama of one model of the motion. Raises ReconstructionError where it has no points."""
    scale = options.scale
    if scale.working_distance_mm is None:
        scale = replace(scale, working_distance_mm=sequence.working_distance_mm)
    motion = in_occlusal_frame(located, scale)
    index = {name: number for number, name in enumerate(sequence.names)}

    def read(name: str) -> UInt8[np.ndarray, "h w 3"]:
        return sequence.image(index[name])

    sparse = height_map(motion, options.height_map)
    dense = (
        plane_sweep(motion, sparse, read, options.plane_sweep, progress=progress)
        if options.plane_sweep.enabled
        else None
    )
    surface = sparse if dense is None else uncovered(dense, sparse, motion)
    mosaic = compose(motion, surface, read, options.mosaic, progress=progress)
    metric = scale.working_distance_mm is not None or scale.width_mm is not None
    panorama = _panorama(mosaic, motion, frames, index, metric)
    panorama = replace(panorama, notes=(_scale_note(scale, given=scale == options.scale),))
    strip = unroll(panorama, motion, surface, mosaic.canvas.mm_per_px, options.strip)
    in_its_units = motion if metric else motion.scaled(1 / mosaic.canvas.mm_per_px)
    return Stitched(panorama=panorama, motion=in_its_units, strip=strip)


def _scale_note(scale: ScaleOptions, *, given: bool) -> str:
    if scale.width_mm is not None:
        return f"the scale is that of an arch {scale.width_mm:g} mm wide"
    if scale.working_distance_mm is None:
        return "the scale is not known, so no millimetres: give --scale.working-distance-mm or --scale.width-mm"
    source = "as given" if given else "as the calibration says"
    return f"the scale is that of a camera held {scale.working_distance_mm:g} mm over the teeth, {source}: no truer"


def _panorama(
    mosaic: Mosaic, motion: SparseModel, frames: Sequence[FrameUse], index: Mapping[str, int], metric: bool
) -> Panorama:
    """The mosaic as the noun; its frames are numbered as in the sequence."""
    canvas = mosaic.canvas
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
