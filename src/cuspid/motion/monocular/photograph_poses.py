"""Poses of photographs from a COLMAP model that somebody else made; where it has no points, they are found anew.

Photographs are known by the stem of their name, whatever its case, suffix and folder. The model may be of larger or
smaller photographs of the same shape.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from cuspid.model.camera import Camera
from cuspid.model.capture import Dropped
from cuspid.model.photographs import PhotoCamera, Photograph, Photographs
from cuspid.model.reconstruction import Tracks
from cuspid.model.sparse_model import PhotoModel
from cuspid.motion.colmap import colmap_camera, colmap_rigid, quiet, read_sparse, rigid_from_colmap
from cuspid.motion.frontend.features import Features
from cuspid.motion.monocular.photograph_matches import camera_of, detect_in_all, image_name
from cuspid.motion.monocular.photographs import (
    PhotographOptions,
    adjusted_rms,
    check_enough,
    from_first,
    in_own_order,
    match_all,
    photo_model,
)
from cuspid.runtime.errors import InputError
from cuspid.runtime.progress import Progress, silent

_LEAST_POINTS = 100
_SHAPE_SHARE = 0.002
"""Sizes are of one shape where their sides are in the same proportion but for this share: sizes are whole numbers."""


def take_photograph_poses(
    photographs: Photographs, folder: Path, options: PhotographOptions | None = None, *, progress: Progress = silent
) -> PhotoModel:
    """Photographs with the poses and the lens of a COLMAP model, in its unit of length.

    Raises InputError where the folder holds no model, or one of other photographs.
    """
    options = options or PhotographOptions()
    check_enough(photographs)
    with quiet():
        model = read_sparse(folder)
        images = _by_name(model, photographs, folder)
        known = _take_model(model, images, photographs, folder)
        if len(known.tracks.points) < _LEAST_POINTS:
            known = _with_points(known, photographs, options, progress)
    missing = [
        Dropped(what=f"photograph {name}", reason=f"not in {folder}")
        for name in photographs.names
        if name not in images
    ]
    return replace(
        known,
        dropped=(*photographs.left_out, *missing),
        notes=photographs.notes,
        log={"points": len(known.tracks.points)},
    )


def _by_name(model: pycolmap.Reconstruction, photographs: Photographs, folder: Path) -> dict[str, pycolmap.Image]:
    """The images of the model that are among the photographs. Raises InputError where none is."""
    names = {name.lower(): name for name in photographs.names}
    found = {}
    for identifier in sorted(model.reg_image_ids()):
        image = model.images[identifier]
        name = names.get(Path(image.name.replace("\\", "/")).stem.lower())
        if name is not None:
            found[name] = image
    if len(found) < 2:
        example = next((model.images[each].name for each in sorted(model.reg_image_ids())), "none")
        raise InputError(
            f"{folder}: {len(found)} of its images are among the photographs; its images are named like {example}, the "
            f"photographs like {photographs.photographs[0].path.name}"
        )
    return {name: found[name] for name in photographs.names if name in found}


def _take_model(
    model: pycolmap.Reconstruction, images: Mapping[str, pycolmap.Image], photographs: Photographs, folder: Path
) -> PhotoModel:
    """Poses, lenses, and the points that the model has. Photographs of one size may have several of its cameras."""
    keys = {name: (photographs[name].camera, image.camera_id) for name, image in images.items()}
    several = len(set(keys.values())) > len({camera for camera, _ in keys.values()})
    label = {key: f"{key[0]}-{key[1]}" if several else key[0] for key in keys.values()}
    cameras = {label[key]: _to_size(model.cameras[key[1]], photographs, name, folder) for name, key in keys.items()}
    camera_names = {name: label[key] for name, key in keys.items()}
    known = PhotoModel(
        cameras=cameras,
        camera_of=camera_names,
        cam_from_world={name: rigid_from_colmap(image.cam_from_world()) for name, image in images.items()},
        tracks=_tracks(model, images, photographs, list(cameras), camera_names),
    )
    return from_first(known)


def _to_size(camera: pycolmap.Camera, photographs: Photographs, name: str, folder: Path) -> Camera:
    """A camera of the model for the size of a photograph. Raises InputError where that has another shape."""
    known = camera_of(camera, f"{folder}: camera {camera.camera_id}")
    width, height = photographs[name].size
    if abs(known.width * height / (known.height * width) - 1) > _SHAPE_SHARE:
        raise InputError(
            f"{folder}: its camera has {known.width} x {known.height} px, but {photographs[name].path.name} has "
            f"{width} x {height} px, which is another shape; give the photographs that the model was made of, as the "
            "camera stored them"
        )
    return known if (known.width, known.height) == (width, height) else known.resized(width, height)


def _tracks(
    model: pycolmap.Reconstruction,
    images: Mapping[str, pycolmap.Image],
    photographs: Photographs,
    cameras: Sequence[str],
    camera_names: Mapping[str, str],
) -> Tracks:
    place = {image.image_id: number for number, image in enumerate(images.values())}
    names = list(images)
    shrink = {
        image.image_id: np.array(photographs[name].size)
        / [model.cameras[image.camera_id].width, model.cameras[image.camera_id].height]
        for name, image in images.items()
    }
    points: list[np.ndarray] = []
    colors, rows, pixels = [], [], []
    for _, point in sorted(model.points3D.items()):
        seen = [each for each in point.track.elements if each.image_id in place]
        if len(seen) < 2:
            continue
        rows += [(len(points), place[e.image_id], cameras.index(camera_names[names[place[e.image_id]]])) for e in seen]
        pixels += [shrink[e.image_id] * model.images[e.image_id].points2D[e.point2D_idx].xy for e in seen]
        points.append(point.xyz)
        colors.append(point.color)
    index = np.array(rows, dtype=np.int64).reshape(-1, 3)
    return Tracks(
        points=np.array(points, dtype=np.float64).reshape(-1, 3),
        colors=np.array(colors, dtype=np.uint8).reshape(-1, 3),
        point_index=index[:, 0],
        frame_index=index[:, 1],
        camera_index=index[:, 2],
        pixels=np.array(pixels, dtype=np.float64).reshape(-1, 2),
    )


# --- points for poses that have none -----------------------------------------------------------------------------


def _with_points(
    known: PhotoModel, photographs: Photographs, options: PhotographOptions, progress: Progress
) -> PhotoModel:
    """The same poses, with points that the photographs show."""
    own = replace(
        photographs,
        photographs=tuple(replace(photographs[name], camera=known.camera_of[name]) for name in known.frames),
        cameras={
            name: PhotoCamera(size=(camera.width, camera.height), calibrated=camera)
            for name, camera in known.cameras.items()
        },
    )
    order = in_own_order(own)
    features, _ = detect_in_all(
        order, options.features, max_image_px=options.max_image_px, even=False, progress=progress
    )
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "first.db"
        match_all(own, order, features, database, options, plain=False, progress=progress)
        posed = _build(known, order, features)
        how = pycolmap.IncrementalPipelineOptions(random_seed=options.seed, num_threads=1, extract_colors=False)
        found = pycolmap.triangulate_points(posed, database, folder, folder, True, how)
    return replace(photo_model(own, order, found, features), reprojection_rms_px=adjusted_rms(found))


def _build(known: PhotoModel, order: Sequence[Photograph], features: Mapping[int, Features]) -> pycolmap.Reconstruction:
    """The poses as COLMAP's model without points, numbered as in the database."""
    model, names = pycolmap.Reconstruction(), list(known.cameras)
    for number, camera in enumerate(known.cameras.values(), start=1):
        made = colmap_camera(camera, number)
        model.add_camera(made)
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(made.sensor_id)
        model.add_rig(rig)
    for index, found in features.items():
        name = order[index].name
        number = names.index(known.camera_of[name]) + 1
        image = pycolmap.Image(image_name(index), found.pixels, number, index + 1)
        frame = pycolmap.Frame(frame_id=index + 1, rig_id=number)
        frame.add_data_id(image.data_id)
        frame.rig_from_world = colmap_rigid(known.cam_from_world[name])
        model.add_frame(frame)
        image.frame_id = index + 1
        model.add_image(image)
        model.register_frame(index + 1)
    return model
