"""The method ``thesis``: chapter 4 of the thesis as it is written, the baseline for the method ``ortho``.

Frames: as in :mod:`cuspid_thesis.stitching.placing`.

Every frame becomes a normal map (:mod:`shading`, :mod:`normal_map`); KAZE features of it are matched with those of the
frame used before, the homography between the two is examined (:mod:`examination`), and the frame is put where its
matches already lie in the panorama, segment by segment (:mod:`warps`). Errors add up from frame to frame: where the
chain stretches a frame beyond a limit it has collapsed, and a new part begins.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float, Int16, UInt8

from cuspid.model.camera import Camera, undistortion_maps
from cuspid.model.image_sequence import ImageSequence
from cuspid.model.panorama import FrameUse, Panorama
from cuspid.runtime.errors import ReconstructionError
from cuspid.runtime.options import Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads
from cuspid_thesis.stitching.examination import ExaminationOptions, examine, frame_corners, scale_of, warp
from cuspid_thesis.stitching.normal_map import grey_normal_map, normal_map, rectify
from cuspid_thesis.stitching.placing import Blend, Canvas, Placed
from cuspid_thesis.stitching.shading import ShadingOptions, shape_from_shading
from cuspid_thesis.stitching.warps import (
    Link,
    Points,
    WarpOptions,
    centroids,
    find_points,
    find_segments,
    link,
    location_weights,
    weighted_dlt,
)


@dataclass(frozen=True, kw_only=True)
class ThesisOptions(Options):
    """The method of chapter 4 of the thesis."""

    shading: ShadingOptions = field(default_factory=ShadingOptions)
    """Shape from shading."""
    mean_px: Annotated[int, Range(1, 1001)] = 9
    """Width in px of the mean filter over the rectified normals."""
    warps: WarpOptions = field(default_factory=WarpOptions)
    """Features, matches, warps."""
    limits: ExaminationOptions = field(default_factory=ExaminationOptions)
    """The examination of frames."""
    patience: Annotated[int, Range(1, 10_000)] = 5
    """After this many unusable frames in a row the panorama breaks, and a new part begins with them."""
    max_stretch: Annotated[float, Range(1.01, 1_000_000)] = 10.0
    """If the chain of homographies stretches or shrinks a frame by more than this factor, it has collapsed, and a new
    part begins."""
    max_canvas_mpx: Annotated[float, Range(0.01, 1000)] = 25.0
    """Largest size of the panorama, in millions of px; beyond it a new part begins."""
    field_of_view_deg: Annotated[float, Range(1, 170)] = 60.0
    """Horizontal angle of view if there is no calibration."""


@dataclass(frozen=True, eq=False)
class Look:
    """What is kept of a frame."""

    points: Points
    """Features of its normal map."""
    segments: Int16[np.ndarray, "r c"]
    """Segments of its normal map, `SEGMENT_PX` times as coarse."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Chain:
    """Frames that hang together, and why the frames between them were left out."""

    placed: tuple[Placed, ...]
    """In order."""
    refused: dict[int, str]
    """Reasons by index of the frame; also of those that follow the last one used."""
    collapse: str | None = None
    """How it collapsed; None where it ended otherwise."""


# --- frames ----------------------------------------------------------------------------------------------------------


def calibration(sequence: ImageSequence, options: ThesisOptions) -> tuple[Camera, tuple[str, ...]]:
    """The camera, calibrated or with an assumed angle of view (which is noted)."""
    if sequence.camera is not None:
        return sequence.camera, ()
    angle = options.field_of_view_deg
    note = f"not calibrated: an angle of view of {angle:g} deg is assumed for the shading"
    return Camera.from_field_of_view(*sequence.size, angle), (note,)


def without_distortion(image: UInt8[np.ndarray, "h w 3"], camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The image as a lens without distortion would have taken it."""
    maps = undistortion_maps(camera)
    return image if maps is None else np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), dtype=np.uint8)


def look(image: UInt8[np.ndarray, "h w 3"], camera: Camera, options: ThesisOptions) -> Look:
    """Features and segments of an image without distortion."""
    shape = shape_from_shading(image, camera, options.shading)
    picture = normal_map(rectify(shape.normals, options.mean_px))
    return Look(find_points(grey_normal_map(picture), options.warps), find_segments(picture, options.warps))


def look_at_all(sequence: ImageSequence, camera: Camera, options: ThesisOptions, progress: Progress) -> list[Look]:
    """Every frame; the images are read one by one."""
    ideal = camera.as_pinhole()

    def one(index: int) -> Look:
        return look(without_distortion(sequence.image(index), camera), ideal, options)

    return map_in_threads(one, range(len(sequence)), stage="normal maps", progress=progress)


# --- the chain -------------------------------------------------------------------------------------------------------


def first_of_chain(index: int, look: Look, size: tuple[int, int]) -> Placed:
    """The frame that a part begins with, as it is."""
    cells = np.broadcast_to(np.eye(3), (int(look.segments.max()) + 1, 3, 3))
    return Placed(index=index, size=size, canvas_from_frame=np.eye(3), cells=cells, segments=look.segments)


def place(index: int, look: Look, found: Link, before: Placed, options: WarpOptions) -> Placed | None:
    """A frame where its matches with the frame before lie already, the whole of it and each segment; None where most of
    them lie beyond the horizon."""
    anchors = before.apply(found.fixed)
    usable = np.isfinite(anchors).all(axis=1)
    if 2 * usable.sum() < len(usable):
        return None
    moving, whole = found.moving[usable], np.ones((1, usable.sum()))
    near = location_weights(moving, centroids(look.segments), options)
    homographies = weighted_dlt(moving, anchors[usable], np.concatenate([whole, near]))
    return Placed(
        index=index,
        size=before.size,
        canvas_from_frame=homographies[0],
        cells=homographies[1:],
        segments=look.segments,
        inliers=len(anchors),
        overlap=overlap(found.fixed_from_moving, before.size),
    )


def overlap(fixed_from_moving: Float[np.ndarray, "3 3"], size: tuple[int, int]) -> float | None:
    """Share of the moving frame that the fixed one sees, by area in the fixed frame; None beyond the horizon."""
    corners = warp(np.broadcast_to(fixed_from_moving, (4, 3, 3)), frame_corners(size))
    if not scale_of(corners, size) > 0:
        return None
    common, _ = cv2.intersectConvexConvex(corners.astype(np.float32), frame_corners(size).astype(np.float32))
    return float(min(1.0, max(0.0, common) / (size[0] * size[1] * scale_of(corners, size) ** 2)))


def collapse_of(placed: list[Placed], options: ThesisOptions) -> str | None:
    """How the last frame of a chain collapses: stretched too much, or on too large a canvas; None where it does not."""
    worst = placed[-1].max_stretch
    if not np.isfinite(worst):
        return "the next frame reaches beyond the horizon"
    if worst > options.max_stretch:
        return f"the next frame is stretched by a factor of {worst:.3g}"
    canvas = Canvas.from_frames(placed)
    if canvas.width * canvas.height > 1e6 * options.max_canvas_mpx:
        return f"the panorama grows beyond {options.max_canvas_mpx:g} million px"
    return None


def build_chain(
    looks: list[Look], start: int, size: tuple[int, int], options: ThesisOptions, examination: bool
) -> Chain:
    """Frames from ``start`` on, each joined to the one used before, until the chain breaks or collapses."""
    placed, refused = [first_of_chain(start, looks[start], size)], dict[int, str]()
    for index in range(start + 1, len(looks)):
        before = placed[-1]
        found = link(looks[index].points, looks[before.index].points, options.warps)
        reason = refusal(found, before.index, size, options, examination)
        if found is None or reason:
            refused[index] = reason
            if index - before.index >= options.patience:
                break
            continue
        now = place(index, looks[index], found, before, options.warps)
        collapse = "most matches lie beyond the horizon" if now is None else collapse_of([*placed, now], options)
        if now is None or collapse:
            return Chain(placed=tuple(placed), refused=refused, collapse=collapse)
        placed.append(now)
    return Chain(placed=tuple(placed), refused=refused)


def refusal(found: Link | None, before: int, size: tuple[int, int], options: ThesisOptions, examination: bool) -> str:
    """Why a frame must not be used; empty where it may."""
    if found is None:
        return f"matches: fewer than {options.warps.min_inliers} agree with a homography to frame {before}"
    return "; ".join(examine(found.fixed_from_moving, size, options.limits)) if examination else ""


def build_chains(
    looks: list[Look], size: tuple[int, int], options: ThesisOptions, examination: bool, progress: Progress
) -> list[Chain]:
    """Every part of the sequence. What follows the last frame that one could use begins the next."""
    chains: list[Chain] = []
    start = 0
    while start < len(looks):
        chains.append(build_chain(looks, start, size, options, examination))
        start = chains[-1].placed[-1].index + 1
        progress("warps", start, len(looks))
    return chains


# --- the whole -------------------------------------------------------------------------------------------------------


def stitch_as_thesis(
    sequence: ImageSequence,
    options: ThesisOptions = ThesisOptions(),
    *,
    examination: bool = True,
    progress: Progress = silent,
) -> tuple[Panorama, ...]:
    """The panorama of a sequence, in parts where it broke or collapsed, largest first; ``examination`` leaves out the
    frames that fail it.

    Raises ReconstructionError where no two frames hang together.
    """
    camera, notes = calibration(sequence, options)
    looks = look_at_all(sequence, camera, options, progress)
    chains = build_chains(looks, sequence.size, options, examination, progress)
    parts = sorted((chain for chain in chains if len(chain.placed) > 1), key=lambda chain: -len(chain.placed))
    reasons = {index: reason for chain in chains for index, reason in chain.refused.items()}
    if not parts:
        raise ReconstructionError(_describe_failure(sequence, reasons))
    notes = (*sequence.notes, *notes, *_break_notes(sequence, parts), _PLANE_NOTE)
    panoramas = []
    for number, chain in enumerate(parts, start=1):
        blend = _lay(sequence, camera, chain, number, progress)
        frames = _frame_uses(sequence, parts, number - 1, reasons)
        panoramas.append(_panorama(blend, frames, number, len(parts), notes))
    return tuple(panoramas)


_PLANE_NOTE = (
    "the picture lies in the plane of the first frame, not in the occlusal plane, and its scale is not known: the "
    "thesis method does not locate the camera"
)


def _lay(sequence: ImageSequence, camera: Camera, chain: Chain, part: int, progress: Progress) -> Blend:
    """All frames of a part on its canvas; the pixels of frames as the lens distorts them."""
    blend = Blend(Canvas.from_frames(chain.placed))
    for done, placed in enumerate(chain.placed, start=1):
        blend.add(placed, without_distortion(sequence.image(placed.index), camera))
        progress(f"mosaic, part {part}", done, len(chain.placed))
    if not camera.is_pinhole:
        seen = blend.frame >= 0
        ideal = camera.as_pinhole()
        blend.pixel[seen] = camera.project(ideal.rays(blend.pixel[seen].astype(np.float64)))
    return blend


def _panorama(blend: Blend, frames: tuple[FrameUse, ...], part: int, parts: int, notes: tuple[str, ...]) -> Panorama:
    canvas = blend.canvas
    return Panorama(
        image=blend.image(),
        covered=blend.frame >= 0,
        frame_index=blend.frame,
        frame_pixel=blend.pixel,
        frames=frames,
        method="thesis",
        origin_px=np.array([canvas.width, canvas.height]) / 2,
        part=part,
        parts=parts,
        notes=notes,
    )


def _frame_uses(
    sequence: ImageSequence, parts: list[Chain], mine: int, reasons: Mapping[int, str]
) -> tuple[FrameUse, ...]:
    """Every frame of the sequence as one part sees it."""
    placed = {placed.index: (number, placed) for number, chain in enumerate(parts) for placed in chain.placed}

    def use(index: int, name: str) -> FrameUse:
        if index not in placed:
            return FrameUse(name=name, used=False, reason=reasons.get(index, "no neighbouring frame connects to it"))
        part, found = placed[index]
        if part != mine:
            refused = parts[mine].refused.get(index)
            return FrameUse(name=name, used=False, reason=f"in part {part + 1}" + (f"; {refused}" if refused else ""))
        return FrameUse(name=name, used=True, inliers=found.inliers, overlap=found.overlap)

    return tuple(use(index, name) for index, name in enumerate(sequence.names))


def _break_notes(sequence: ImageSequence, parts: list[Chain]) -> tuple[str, ...]:
    """Where and why parts ended before the sequence did."""
    notes = []
    for chain in sorted(parts, key=lambda chain: chain.placed[0].index):
        first, last = chain.placed[0].index, chain.placed[-1].index
        span = f"frames {sequence.names[first]} to {sequence.names[last]}"
        if chain.collapse:
            notes.append(f"{span}: then the chain of homographies collapses: {chain.collapse}")
        elif last + 1 < len(sequence):
            notes.append(f"{span}: the next frames could not be used")
    return tuple(notes)


def _describe_failure(sequence: ImageSequence, reasons: Mapping[int, str]) -> str:
    common, count = Counter(reason.split(":")[0] for reason in reasons.values()).most_common(1)[0]
    return (
        f"{sequence.source}: no two of {len(sequence)} frames could be connected ({count} failed on {common}); "
        "they need more overlap, light or sharpness"
    )
