"""What is measured on surfaces and poses that were found from real photographs: small functions with known answers.

Lengths are in the unit of the mesh (mm where it has a scale). The truth that they compare with is never given to a
reconstruction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from cuspid.geometry import Rigid3, best_similarity
from cuspid.model.camera import OPENCV_PIXEL_OFFSET, Camera
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import DepthMap
from cuspid.model.rig import MountedCamera
from cuspid.simulation.raycast import render_depth

AGREEING_PX = 1.0
"""A left-out view agrees with the surface where it need not be moved by more."""
_LEAST_GREY_SD = 2.0
_TOLERANCE = 3e-3
"""Of depth, relative, within which a neighbour is held to see the same point."""
_EROSION_PX = 3
"""Pixels next to those without a value, whose displacement is not looked at."""


def within_pct(points: Float[np.ndarray, "n 3"], mesh: Mesh, limits_mm: Sequence[float]) -> dict[str, float]:
    """Share of points (%) within some distances of a mesh, by the distance."""
    distances = mesh.closest(points)[0]
    return {f"{limit:g}": 100 * float(np.mean(distances <= limit)) for limit in limits_mm}


def median_to_points_mm(points: Float[np.ndarray, "n 3"], mesh: Mesh) -> float:
    """Median distance of points from a mesh."""
    return float(np.median(mesh.closest(points)[0]))


@dataclass(frozen=True)
class SeenDistance:
    """How far a surface lies from a reference, at the pixels at which a camera sees both."""

    median_mm: float
    """Median of the distances of the surface's points from the reference; NaN where there are none."""
    covered_pct: float
    """Share of the pixels that show the reference (%) that show the surface, too."""


def seen_distance(mesh: Mesh, reference: Mesh, camera: Camera, cam_from_world: Rigid3) -> SeenDistance:
    """Of the points of a mesh that a camera sees, where it would see the reference as well."""
    ours, theirs = (render_depth(each, camera, cam_from_world) for each in (mesh, reference))
    both = np.isfinite(ours) & np.isfinite(theirs)
    rays = camera.rays(camera.pixel_centres()[both])
    points = cam_from_world.inverse().apply(rays * ours[both][:, None])
    median = median_to_points_mm(points, reference) if both.any() else float("nan")
    return SeenDistance(median, coverage_pct(np.isfinite(ours), np.isfinite(theirs)))


def seen_by_all(
    points: Float[np.ndarray, "n 3"], cameras: Mapping[str, tuple[Camera, Rigid3]]
) -> Bool[np.ndarray, "n"]:
    """Whether points lie in front of each camera (with its ``cam_from_world``) and in its image."""
    inside = [camera.contains(camera.project(pose.apply(points))) for camera, pose in cameras.values()]
    return np.all(inside, axis=0)


# --- Boxes ------------------------------------------------------------------------------------------------------------

Box = Float[np.ndarray, "2 3"]
"""Lower and upper corner, mm."""


def box_gaps_mm(mesh: Mesh, box: Box, margin_mm: float = 1.0) -> Float[np.ndarray, "2 3"]:
    """How far the surface stays inside each side of a box; negative where it goes beyond, at most by the margin: what
    lies still farther outside does not count. Infinite where nothing of the mesh is in the box."""
    places = mesh.vertices[np.unique(mesh.faces)]
    near = places[np.all((places >= box[0] - margin_mm) & (places <= box[1] + margin_mm), axis=1)]
    if not len(near):
        return np.full((2, 3), np.inf)
    return np.stack([near.min(axis=0) - box[0], box[1] - near.max(axis=0)])


def outside_pct(mesh: Mesh, box: Box, margin_mm: float = 1.0) -> float:
    """Share of the area (%) whose faces have their middle outside a box by more than the margin."""
    inside = np.all((mesh.face_centres >= box[0] - margin_mm) & (mesh.face_centres <= box[1] + margin_mm), axis=1)
    return 100 * float(mesh.face_areas[~inside].sum() / mesh.face_areas.sum())


# --- Pixels -----------------------------------------------------------------------------------------------------------


def mask_at(depth: DepthMap, mounted: MountedCamera, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "r c"]:
    """A mask of the image of a camera at the pixels of a depth map of it, which may be coarser, undistorted and turned.
    A pixel that the image does not show is not masked."""
    rays = depth.camera.rays(depth.camera.pixel_centres())
    turn = mounted.cam_from_rig.rotation @ depth.cam_from_rig.rotation.T
    pixels = mounted.camera.project(rays @ turn.T)
    inside = mounted.camera.contains(pixels)
    column, row = np.floor(np.where(inside[..., None], pixels, 0)).astype(int).reshape(-1, 2).T
    chosen = mask[np.minimum(row, mounted.camera.height - 1), np.minimum(column, mounted.camera.width - 1)]
    return np.asarray(inside & chosen.reshape(inside.shape))


def coverage_pct(known: Bool[np.ndarray, "h w"], within: Bool[np.ndarray, "h w"]) -> float:
    """Share of some pixels (%) that have a value; NaN for no pixels."""
    return 100 * float(known[within].mean()) if within.any() else float("nan")


def silhouette_iou(found: Bool[np.ndarray, "h w"], true: Bool[np.ndarray, "h w"]) -> float:
    """Pixels in both silhouettes as a share (0 to 1) of those in either; NaN where both are empty."""
    either = (found | true).sum()
    return float((found & true).sum() / either) if either else float("nan")


@dataclass(frozen=True, eq=False)
class View:
    """A photograph with its camera."""

    camera: Camera
    cam_from_world: Rigid3
    image: UInt8[np.ndarray, "h w 3"]


def depth_of(mesh: Mesh, view: View) -> Float[np.ndarray, "h w"]:
    """Depth of the mesh at each pixel of a view, NaN where it shows nothing."""
    return render_depth(mesh, view.camera, view.cam_from_world)


def warped(
    view: View, depth: Float[np.ndarray, "h w"], other: View, other_depth: Float[np.ndarray, "h w"]
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """The other photograph seen from a view by way of a surface, whose depth in both is given; and the pixels for which
    the other one sees the same point of it, and not something before it."""
    centres = view.camera.pixel_centres()
    points = view.cam_from_world.inverse().apply((view.camera.rays(centres) * depth[..., None]).reshape(-1, 3))
    in_other = other.cam_from_world.apply(points).reshape(*depth.shape, 3)
    places = np.nan_to_num(other.camera.project(in_other), nan=-1e4)
    maps = (places - OPENCV_PIXEL_OFFSET).astype(np.float32)
    maps = np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])
    image = np.asarray(cv2.remap(other.image, *maps, cv2.INTER_LINEAR))
    nearest = cv2.remap(other_depth.astype(np.float32), *maps, cv2.INTER_NEAREST, borderValue=float("nan"))
    with np.errstate(invalid="ignore"):
        same = np.abs(nearest - in_other[..., 2]) <= _TOLERANCE * in_other[..., 2]
    return image, np.asarray(same & other.camera.contains(places, 1.0) & np.isfinite(depth))


def displacement_px(
    image: UInt8[np.ndarray, "h w 3"], moved: UInt8[np.ndarray, "h w 3"], valid: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """By how much each pixel of an image must be moved to meet another one (dense inverse search, T. Kroeger et al.,
    ECCV 2016, on locally normalised grey levels); NaN where either is not valid, and next to there."""
    grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (image, moved)]
    grey[1] = np.where(valid, grey[1], grey[0])
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setFinestScale(0)
    found = np.asarray(flow.calc(_normalised(grey[0]), _normalised(grey[1]), np.zeros((*valid.shape, 2), np.float32)))
    size = 2 * _EROSION_PX + 1
    inner = cv2.erode(valid.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    return np.where(inner, np.linalg.norm(found, axis=-1), np.nan).astype(np.float32)


def _normalised(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """With the same mean and contrast everywhere, so that light that changes with the view counts for less."""
    values = grey.astype(np.float32)
    mean = cv2.GaussianBlur(values, (0, 0), 8)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur(values**2, (0, 0), 8) - mean**2, 0))
    return np.clip(128 + 40 * (values - mean) / np.maximum(spread, _LEAST_GREY_SD), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class LeftOut:
    """How a view that was left out agrees with a surface, through which its neighbours are seen."""

    surface_pct: float
    """Share of the masked pixels (%) at which the surface is seen."""
    compared_pct: float
    """Share of the masked pixels (%) that some neighbour shows, too."""
    agreeing_pct: float
    """Share of these (%) at which the displacement is at most 1 px."""
    agreeing_of_mask_pct: float
    """Share of all masked pixels (%) that agree with some neighbour."""
    median_px: float
    """Median displacement."""
    silhouette_iou: float
    """Of the rendered surface with the mask."""


def left_out(mesh: Mesh, view: View, neighbours: Sequence[View], mask: Bool[np.ndarray, "h w"]) -> LeftOut:
    """Measure a left-out view against a mesh. At each pixel the first of the neighbours counts that shows it."""
    depth = depth_of(mesh, view)
    moved = np.full(depth.shape, np.nan, np.float32)
    for other in neighbours:
        image, valid = warped(view, depth, other, depth_of(mesh, other))
        moved = np.where(np.isfinite(moved), moved, displacement_px(view.image, image, valid & mask))
    compared = np.isfinite(moved) & mask
    agreeing = compared & (np.nan_to_num(moved, nan=np.inf) <= AGREEING_PX)
    return LeftOut(
        surface_pct=coverage_pct(np.isfinite(depth), mask),
        compared_pct=coverage_pct(compared, mask),
        agreeing_pct=coverage_pct(agreeing, compared),
        agreeing_of_mask_pct=coverage_pct(agreeing, mask),
        median_px=float(np.median(moved[compared])) if compared.any() else float("nan"),
        silhouette_iou=silhouette_iou(np.isfinite(depth), mask),
    )


# --- Poses ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PoseDifference:
    """Poses beside those of somebody else, after a similarity of the camera centres."""

    located: int
    """Views with a pose in both."""
    scale: float
    """Unit of the others per unit of these."""
    rotation_mean_deg: float
    rotation_max_deg: float
    centre_rms_pct: float
    """Distance of the centres, RMS, in % of the diagonal of the box around the others' centres."""
    centre_max_pct: float


def pose_difference(found: Mapping[str, Rigid3], others: Mapping[str, Rigid3]) -> PoseDifference | None:
    """Of ``cam_from_world`` of the views that both have; None for fewer than three. The rotation that is left after the
    similarity is that of each view, less what all have in common."""
    names = [name for name in others if name in found]
    if len(names) < 3:
        return None
    ours, theirs = (np.array([poses[name].inverse().translation for name in names]) for poses in (found, others))
    scale, rotation, shift = best_similarity(ours, theirs)
    off = np.linalg.norm(scale * ours @ rotation.T + shift - theirs, axis=1)
    size = float(np.linalg.norm(np.ptp(theirs, axis=0)))
    turns = [found[name].rotation.T @ others[name].rotation for name in names]  # world of ours from that of others
    common = _mean_rotation(turns)
    angles = np.array([_angle_deg(turn @ common.T) for turn in turns])
    return PoseDifference(
        located=len(names),
        scale=scale,
        rotation_mean_deg=float(angles.mean()),
        rotation_max_deg=float(angles.max()),
        centre_rms_pct=100 * float(np.sqrt(np.mean(off**2))) / size,
        centre_max_pct=100 * float(off.max()) / size,
    )


def _mean_rotation(turns: Sequence[Float[np.ndarray, "3 3"]]) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to the mean of some (chordal mean)."""
    u, _, vt = np.linalg.svd(np.mean(turns, axis=0))
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)


def _angle_deg(rotation: Float[np.ndarray, "3 3"]) -> float:
    return float(np.rad2deg(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))))
