"""Depth from views of different frames, once the frames are located: the same matching in time as within a frame.

A camera that has no partner in its frame (one camera around a cast, say) is matched with the views of other frames that
see the same points. A handpiece needs this only for the strips at the borders of what its cameras see in common, for
example cusps between the occlusal and the buccal view: there a camera is matched with itself a moment later. That
relies on the motion, which is less certain than the rig, so it gets little weight where there is depth from one frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Int, UInt8

from cuspid.geometry import Rigid3
from cuspid.model.capture import Frame
from cuspid.model.pairing import PairingOptions, rank_by_points, rank_sources, resolved_mm, stereo_pairs
from cuspid.model.reconstruction import DepthMap, Reconstruction
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.mvs.confidence import Resolution
from cuspid.mvs.matching import Levels, StereoOptions, depth_maps_of, measure_views, prepare_views
from cuspid.runtime.options import SHARE, Options

_LEAST_BASELINE = 0.08
"""Smallest movement of a camera relative to the distance of the surface."""
_LARGEST_TURN_DEG = 20.0
"""Largest rotation of a handpiece between two frames that its cameras are matched in."""
_RANGE_PERCENTILES, _RANGE_POINTS = (1, 99), 30
"""Depths of the sparse points of a view that bound its surface, and how many points that takes."""
_BEYOND, _LEAST_BEYOND = 0.5, 0.05
"""How far the surface may reach beyond them: a share of what lies between them, at least of their distance."""


@dataclass(frozen=True, kw_only=True)
class AcrossOptions(Options):
    """Cameras of a handpiece matched with themselves in the next frame."""

    enabled: bool = True
    """Whether to do so at all."""
    left_share: Annotated[float | None, SHARE] = None
    """Cameras are matched with themselves where that fills holes, until the sparse points that depth within the frames
    leaves without a surface, and that could still be filled, are no more than this share (0 to 1) of all points. 0:
    wherever a camera moved enough. Default: 0.005, for a draft 0.03."""
    small_holes: bool | None = None
    """Also fill holes in the surface that are too small for sparse points to reveal. Default: yes, but not for a
    draft."""
    confidence_share: Annotated[float, SHARE] = 0.05
    """Confidence relative to that of depth from a single frame."""


def measure_moving_cameras(
    handpiece: Handpiece,
    images: Mapping[str, Levels],
    next_images: Mapping[str, Levels],
    masks: Mapping[str, UInt8[np.ndarray, "h w"]],
    next_from_rig: Rigid3,
    frame: str,
    options: AcrossOptions,
    stereo: StereoOptions,
) -> tuple[DepthMap, ...]:
    """Depth maps of each camera that moved enough, at its pose at ``frame`` and a moment later.

    ``next_from_rig`` moves points from the rig frame at ``frame`` to that at the next frame. All depth maps are given
    in the rig frame at ``frame``; those of the moved cameras have ``+`` after the camera's name, as have their
    ``masks``.
    """
    resolution = Resolution(resolved_mm(handpiece), handpiece.working_distance_mm)
    found = list[DepthMap]()
    for name in handpiece.rig.names:
        moved = f"{name}+"
        pair = consecutive_pair(handpiece, name, next_from_rig, stereo.pairing)
        if name not in images or name not in next_images or pair is None:
            continue
        both = {name: images[name], moved: next_images[name]}
        sources = {name: (moved,), moved: (name,)}
        views = prepare_views(pair, sources, handpiece.working_distance_mm, handpiece.depth_range_mm, stereo)
        measured = measure_views(views, both, handpiece.depth_range_mm, resolution, stereo, widenings=())
        found += depth_maps_of(views, measured, both, masks, frame, resolution, stereo.confidence, stereo.grid_px)
    return tuple(_discount_weight(depth_map, options.confidence_share) for depth_map in found)


def _discount_weight(depth_map: DepthMap, share: float) -> DepthMap:
    """With so much less weight, though its depths scatter no more: they share the errors of two poses."""
    best_mm = None if depth_map.best_mm is None else depth_map.best_mm * float(np.sqrt(share))
    return replace(depth_map, confidence=(share * depth_map.confidence).astype(np.float32), best_mm=best_mm)


def consecutive_pair(handpiece: Handpiece, name: str, next_from_rig: Rigid3, options: PairingOptions) -> Rig | None:
    """A camera and the same camera at the next frame; None where they are no stereo pair."""
    mounted = handpiece.rig[name]
    moved = MountedCamera(mounted.camera, mounted.cam_from_rig @ next_from_rig)
    shift = mounted.cam_from_rig.rotate(moved.centre_in_rig - mounted.centre_in_rig)
    sideways = float(np.linalg.norm(shift[:2]))
    if next_from_rig.angle_deg > _LARGEST_TURN_DEG or sideways < abs(shift[2]):
        return None
    if sideways < _LEAST_BASELINE * handpiece.working_distance_mm:
        return None
    rig = Rig({name: mounted, f"{name}+": moved})
    return rig if stereo_pairs(rig, handpiece.working_distance_mm, options) else None


# --- Any views ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class LocatedView:
    """An image, where it was taken from, and what it is matched with."""

    frame: Frame
    """The instant."""
    camera: str
    """The camera that took it."""
    mounted: MountedCamera
    """The camera at its place in the world."""
    depth_range_mm: tuple[float, float]
    """Between which depths the surface lies."""
    distance_mm: float
    """About how far away it is."""
    sources: tuple[int, ...]
    """Indices of the views that it is matched with."""


def locate_views(
    handpiece: Handpiece, frames: Sequence[Frame], found: Reconstruction, options: PairingOptions
) -> tuple[LocatedView, ...]:
    """The images of the located frames, each with the views that suit it as sources: by the sparse points that both
    see, or, where there are none, by how their fields of view overlap at the working distance."""
    rig = handpiece.rig
    images = [(f, c) for f in frames if f.name in found.rig_from_world for c in f.cameras]
    places = [MountedCamera(rig[c].camera, rig[c].cam_from_rig @ found.rig_from_world[f.name]) for f, c in images]
    sightings = _sightings([(f.name, c) for f, c in images], found)
    sources = _rank(places, sightings, found, handpiece.working_distance_mm, options)
    views = list[LocatedView]()
    for k, ((frame, camera), mounted) in enumerate(zip(images, places, strict=True)):
        near, far, middle = _depth_range(mounted, sightings[k], found, handpiece)
        views.append(
            LocatedView(
                frame=frame,
                camera=camera,
                mounted=mounted,
                depth_range_mm=(near, far),
                distance_mm=middle,
                sources=sources[k],
            )
        )
    return tuple(views)


def _sightings(images: Sequence[tuple[str, str]], found: Reconstruction) -> list[Int[np.ndarray, "_"]]:
    """Indices of the sparse points that each image shows."""
    tracks = found.tracks
    if tracks is None:
        return [np.zeros(0, dtype=np.int64) for _ in images]
    frames, cameras = list(found.frames), list(found.rig.names)
    number = tracks.frame_index * len(cameras) + tracks.camera_index
    order = np.argsort(number, kind="stable")
    image_numbers = np.array([frames.index(frame) * len(cameras) + cameras.index(camera) for frame, camera in images])
    start, end = (np.searchsorted(number[order], image_numbers, side) for side in ("left", "right"))
    return [np.unique(tracks.point_index[order[a:b]]) for a, b in zip(start, end, strict=True)]


def _rank(
    places: Sequence[MountedCamera],
    sightings: Sequence[Int[np.ndarray, "_"]],
    found: Reconstruction,
    distance_mm: float,
    options: PairingOptions,
) -> tuple[tuple[int, ...], ...]:
    """Sources of each view, by points where these tell any."""
    if found.tracks is not None:
        pairs = np.array([(k, point) for k, seen in enumerate(sightings) for point in seen]).reshape(-1, 2)
        centres = np.array([mounted.centre_in_rig for mounted in places]).reshape(-1, 3)
        ranked = rank_by_points(centres, found.tracks.points, pairs, options)
        if any(ranked):
            return ranked
    rig = Rig({f"{k:06}": mounted for k, mounted in enumerate(places)})
    return tuple(tuple(map(int, others)) for others in rank_sources(rig, distance_mm, options).values())


def _depth_range(
    mounted: MountedCamera, seen: Int[np.ndarray, "_"], found: Reconstruction, handpiece: Handpiece
) -> tuple[float, float, float]:
    """Nearest, farthest and middle depth of a view's surface: those of its sparse points, within the handpiece's."""
    near, far = handpiece.depth_range_mm
    if found.tracks is None or len(seen) < _RANGE_POINTS:
        return near, far, handpiece.working_distance_mm
    depths = mounted.cam_from_rig.apply(found.tracks.points[seen])[:, 2]
    low, high = np.percentile(depths, _RANGE_PERCENTILES)
    middle = float(np.median(depths))
    beyond = max(_BEYOND * (high - low), _LEAST_BEYOND * middle)
    low, high = max(near, low - beyond), min(far, high + beyond)
    return (float(low), float(high), middle) if 0 < low < high else (near, far, handpiece.working_distance_mm)


def view_resolution(views: Sequence[LocatedView], index: int) -> Resolution:
    """The detail that a view resolves in depth at the distance of its surface: the footprint of a pixel, or half a
    pixel of disparity to the source that stands farthest aside, whichever is more."""
    view = views[index]
    focal_px, distance_mm = float(view.mounted.camera.focal_px.mean()), view.distance_mm
    aside = [view.mounted.cam_from_rig.apply(views[k].mounted.centre_in_rig)[:2] for k in view.sources]
    baseline_mm = max((float(np.linalg.norm(each)) for each in aside), default=0.0)
    half_step = distance_mm**2 / (2 * focal_px * baseline_mm) if baseline_mm > 0 else 0.0
    return Resolution(max(distance_mm / focal_px, half_step), distance_mm)
