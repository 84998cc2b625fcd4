"""Which parts of a surface the cameras of a handpiece could see: the rule for what is scannable, and tables of it.

A face is seen by a camera if its centre lies in the image and in the depth range of the lens, if nothing occludes it,
and if the line of sight meets it from the front at no more than the largest angle of incidence (0 degrees is
perpendicular). It is scannable if, from at least one position of the handpiece, enough cameras see it at once. The
world is the frame of the mesh.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.geometry import Rigid3, read_only
from cuspid.model.camera import Camera
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range

LEAST_OPENNESS = 0.05
"""Share of the directions above the occlusal plane that must be free for a place on a crown to count as open."""
OPENNESS_REACH_MM = 15.0
"""What lies farther than this from a crown does not occlude it."""
_OPENNESS_RAYS = 64
_OFF_SURFACE_MM = 2e-3
_AT_ONCE = (1, 2, 3)
"""Numbers of cameras that the tables list."""


@dataclass(frozen=True, kw_only=True)
class VisibilityOptions(Options):
    """When a face counts as seen."""

    max_incidence_deg: Annotated[float, Range(1, 90)] = 75.0
    """Largest angle between the line of sight and the normal of the face."""
    cameras: Annotated[int, Range(1, 1000)] = 2
    """Number of cameras that must see a face at once."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Visibility:
    """What a handpiece saw of each face over all its positions."""

    cameras: tuple[str, ...]
    """Names of the cameras."""
    most_at_once: Int[np.ndarray, "f"]
    """Largest number of cameras that saw it at once."""
    images: Int[np.ndarray, "f"]
    """Number of images that show it, over all cameras and positions."""
    by_camera: Bool[np.ndarray, "f c"]
    """Whether each camera saw it from at least one position."""
    incidence_deg: Float[np.ndarray, "f"]
    """Mean angle between the line of sight and the normal, over those images; NaN where there is none."""

    def __post_init__(self) -> None:
        for name in ("most_at_once", "images", "by_camera", "incidence_deg"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def scannable_faces(
    mesh: Mesh, handpiece: Handpiece, rig_from_world: Iterable[Rigid3], options: VisibilityOptions
) -> Bool[np.ndarray, "f"]:
    """The faces that enough cameras see at once from at least one pose."""
    found = np.zeros(len(mesh.faces), dtype=bool)
    views = _views(handpiece)
    for pose in rig_from_world:
        near = _within_reach(mesh, views, pose)
        undecided = near[~found[near]]
        seen = _visible_faces(mesh, views, pose, options, undecided)
        found[undecided[seen.sum(axis=1) >= options.cameras]] = True
    return found


def visible_counts(
    mesh: Mesh,
    handpiece: Handpiece,
    rig_from_world: Iterable[Rigid3],
    options: VisibilityOptions,
    among: Bool[np.ndarray, "f"] | None = None,
) -> Int[np.ndarray, "f"]:
    """For each face, the largest number of cameras that see it at once; 0 for faces that are not in ``among``."""
    most = np.zeros(len(mesh.faces), dtype=np.int64)
    views = _views(handpiece)
    for pose in rig_from_world:
        near = _within_reach(mesh, views, pose)
        faces = near if among is None else near[among[near]]
        most[faces] = np.maximum(most[faces], _visible_faces(mesh, views, pose, options, faces).sum(axis=1))
    return most


def survey_visibility(
    mesh: Mesh, handpiece: Handpiece, rig_from_world: Iterable[Rigid3], options: VisibilityOptions
) -> Visibility:
    """What each camera sees of each face, and at what incidence, over all poses."""
    count, names = len(mesh.faces), handpiece.rig.names
    most, images = np.zeros((2, count), dtype=np.int64)
    by_camera, angles_deg = np.zeros((count, len(names)), dtype=bool), np.zeros(count)
    for faces, seen, eyes in _faces_by_pose(mesh, handpiece, rig_from_world, options):
        at_once = seen.sum(axis=1)
        most[faces] = np.maximum(most[faces], at_once)
        images[faces] += at_once
        by_camera[faces] |= seen
        for eye, column in zip(eyes, seen.T, strict=True):
            angles_deg[faces[column]] += _incidence_deg(mesh, faces[column], eye)
    with np.errstate(invalid="ignore"):
        incidence = angles_deg / images
    return Visibility(cameras=names, most_at_once=most, images=images, by_camera=by_camera, incidence_deg=incidence)


def visible_faces(
    mesh: Mesh,
    camera: Camera,
    cam_from_world: Rigid3,
    depth_range_mm: tuple[float, float],
    options: VisibilityOptions,
    among: Int[np.ndarray, "m"] | None = None,
) -> Int[np.ndarray, "n"]:
    """Indices of the faces that one camera sees; only those in ``among`` are tested, but all can occlude."""
    view = _view(camera, Rigid3.identity(), depth_range_mm)
    return _visible_among(mesh, view, cam_from_world, options, np.arange(len(mesh.faces)) if among is None else among)


def openness(
    mesh: Mesh, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], reach_mm: float = np.inf
) -> Float[np.ndarray, "n"]:
    """Share of the directions above the occlusal plane (XY) from which points of the surface can be seen at all,
    however flat, where only what stands within the reach occludes them."""
    steps = np.arange(_OPENNESS_RAYS) + 0.5
    z, azimuth = steps / _OPENNESS_RAYS, steps * np.pi * (3 - np.sqrt(5))
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)
    origins = points + _OFF_SURFACE_MM * normals
    free = np.zeros(len(points))
    for direction in directions:
        facing = np.flatnonzero(normals @ direction > 0)
        hits = mesh.cast(origins[facing], np.broadcast_to(direction, (len(facing), 3)))
        free[facing[hits.distances >= reach_mm]] += 1
    return free / _OPENNESS_RAYS


# --- tables -----------------------------------------------------------------------------------------------------------


def surface_rows(
    visibility: Visibility, areas_mm2: Float[np.ndarray, "f"], surfaces: Mapping[str, Bool[np.ndarray, "f"]]
) -> list[dict[str, object]]:
    """One flat row for each surface that has any area: shares of it that at least 1, 2 and 3 cameras see at once.

    ``cameras_mean``: mean over the area of the largest number of cameras at once; ``incidence_mean_deg``: mean over the
    area that is seen, None if none is.
    """
    return [
        {"surface": name, **_row(visibility, np.where(mask, areas_mm2, 0.0))}
        for name, mask in surfaces.items()
        if areas_mm2[mask].sum() > 0
    ]


def _row(visibility: Visibility, weights_mm2: Float[np.ndarray, "f"]) -> dict[str, object]:
    area = float(weights_mm2.sum())
    seen = np.where(visibility.images > 0, weights_mm2, 0.0)
    row: dict[str, object] = {"area_mm2": area}
    for cameras in _AT_ONCE:
        row[f"seen_by_{cameras}_pct"] = float(100 * weights_mm2[visibility.most_at_once >= cameras].sum() / area)
    row["cameras_mean"] = float(weights_mm2 @ visibility.most_at_once / area)
    incidence = np.nan_to_num(visibility.incidence_deg)
    row["incidence_mean_deg"] = float(seen @ incidence / seen.sum()) if seen.sum() > 0 else None
    return row


def camera_rows(
    visibility: Visibility, areas_mm2: Float[np.ndarray, "f"], surfaces: Mapping[str, Bool[np.ndarray, "f"]]
) -> list[dict[str, object]]:
    """One flat row for each camera: the share that it sees of each surface that has any area."""
    areas = {name: areas_mm2[mask].sum() for name, mask in surfaces.items() if areas_mm2[mask].sum() > 0}
    return [
        {
            "camera": camera,
            **{
                f"{name}_pct": float(100 * areas_mm2[surfaces[name] & visibility.by_camera[:, index]].sum() / area)
                for name, area in areas.items()
            },
        }
        for index, camera in enumerate(visibility.cameras)
    ]


# --- one position -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class _View:
    """A camera and the box x/z, y/z, z that holds all that it can see."""

    camera: Camera
    cam_from_rig: Rigid3
    depth_range_mm: tuple[float, float]
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]

    @property
    def reach_mm(self) -> float:
        """Distance of the farthest corner of that box."""
        slopes = np.maximum(np.abs(self.low), np.abs(self.high))
        return float(self.depth_range_mm[1] * np.sqrt(1 + slopes @ slopes))


def _views(handpiece: Handpiece) -> tuple[_View, ...]:
    mounted = handpiece.rig.cameras.values()
    return tuple(_view(each.camera, each.cam_from_rig, handpiece.depth_range_mm) for each in mounted)


def _view(camera: Camera, cam_from_rig: Rigid3, depth_range_mm: tuple[float, float]) -> _View:
    low, high = slope_bounds(camera)
    return _View(camera=camera, cam_from_rig=cam_from_rig, depth_range_mm=depth_range_mm, low=low, high=high)


def slope_bounds(camera: Camera) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Least and greatest x/z and y/z of the rays through the border of the image."""
    ticks = np.linspace(0, 1, 20)
    border = np.array([[t, s] for t in ticks for s in ticks if t in (0, 1) or s in (0, 1)])
    camera = camera.undistorted() if camera.lens.is_equidistant else camera
    rays = camera.rim_rays(border * [camera.width, camera.height])[:, :2]
    return rays.min(axis=0), rays.max(axis=0)


def _faces_by_pose(
    mesh: Mesh, handpiece: Handpiece, rig_from_world: Iterable[Rigid3], options: VisibilityOptions
) -> Iterator[tuple[Int[np.ndarray, "n"], Bool[np.ndarray, "n c"], Float[np.ndarray, "c 3"]]]:
    """For each pose: the faces near it, which camera sees which of them, and where the cameras are."""
    views = _views(handpiece)
    for pose in rig_from_world:
        faces = _within_reach(mesh, views, pose)
        yield faces, _visible_faces(mesh, views, pose, options, faces), _eyes(views, pose)


def _eyes(views: tuple[_View, ...], rig_from_world: Rigid3) -> Float[np.ndarray, "c 3"]:
    return np.array([(view.cam_from_rig @ rig_from_world).inverse().translation for view in views])


def _within_reach(mesh: Mesh, views: tuple[_View, ...], rig_from_world: Rigid3) -> Int[np.ndarray, "n"]:
    """The faces with their centre in a ball that holds all that the cameras can see."""
    eyes = _eyes(views, rig_from_world)
    middle = eyes.mean(axis=0)
    radius = max(float(np.linalg.norm(eye - middle)) + view.reach_mm for eye, view in zip(eyes, views, strict=True))
    return np.asarray(np.flatnonzero(_within_ball(mesh.face_centres, middle, radius)))


def _visible_faces(
    mesh: Mesh,
    views: tuple[_View, ...],
    rig_from_world: Rigid3,
    options: VisibilityOptions,
    faces: Int[np.ndarray, "n"],
) -> Bool[np.ndarray, "n c"]:
    """Which camera sees which of the faces, given in ascending order, from one pose."""
    seen = np.zeros((len(faces), len(views)), dtype=bool)
    for column, view in enumerate(views):
        visible = _visible_among(mesh, view, view.cam_from_rig @ rig_from_world, options, faces)
        seen[np.searchsorted(faces, visible), column] = True
    return seen


def _visible_among(
    mesh: Mesh, view: _View, cam_from_world: Rigid3, options: VisibilityOptions, faces: Int[np.ndarray, "n"]
) -> Int[np.ndarray, "m"]:
    """Those of the faces that a camera sees."""
    minimum_cosine = float(np.cos(np.deg2rad(options.max_incidence_deg)))
    eye = cam_from_world.inverse().translation
    facing = _facing(
        mesh.face_centres,
        mesh.face_normals,
        faces,
        cam_from_world.rotation,
        eye,
        view.low,
        view.high,
        view.depth_range_mm,
        minimum_cosine,
    )
    faces = faces[facing]
    centres = mesh.face_centres[faces]
    in_image = view.camera.contains(view.camera.project(cam_from_world.apply(centres)))
    faces, centres = faces[in_image], centres[in_image]
    return np.asarray(faces[~mesh.occluded(centres, np.broadcast_to(eye, centres.shape))])


def _incidence_deg(mesh: Mesh, faces: Int[np.ndarray, "n"], eye: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n"]:
    """Angle between the normals of the faces and the line of sight to the eye."""
    sight = eye - mesh.face_centres[faces]
    cosine = np.einsum("nd,nd->n", sight, mesh.face_normals[faces]) / np.linalg.norm(sight, axis=1)
    return np.asarray(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))


@kernel
@no_type_check
def _within_ball(points, middle, radius):
    """True for the points in a ball."""
    found = np.zeros(len(points), dtype=np.bool_)
    for i in range(len(points)):
        x, y, z = points[i, 0] - middle[0], points[i, 1] - middle[1], points[i, 2] - middle[2]
        found[i] = x * x + y * y + z * z <= radius * radius
    return found


@kernel
@no_type_check
def _facing(centres, normals, faces, rotation, eye, low, high, depth_range, minimum_cosine):
    """True for those of the faces whose centre lies in the box of view and that face the camera steeply enough."""
    found = np.zeros(len(faces), dtype=np.bool_)
    for k in range(len(faces)):
        i = faces[k]
        x, y, z = centres[i, 0] - eye[0], centres[i, 1] - eye[1], centres[i, 2] - eye[2]
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        if depth < depth_range[0] or depth > depth_range[1]:
            continue
        u = (rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z) / depth
        v = (rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z) / depth
        if u < low[0] or u > high[0] or v < low[1] or v > high[1]:
            continue
        facing = -(normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z)
        found[k] = facing >= minimum_cosine * np.sqrt(x * x + y * y + z * z)
    return found
