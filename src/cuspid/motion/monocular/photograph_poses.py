"""Poses of photographs from a COLMAP model that somebody else made; where it has no points, they are triangulated.

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
from cuspid.model.photographs import PhotoCamera, Photographs
from cuspid.model.reconstruction import Tracks
from cuspid.model.sparse_model import PhotoModel
from cuspid.motion.colmap import ColmapModel, quiet, read_sparse, rigid_from_colmap
from cuspid.motion.monocular.mapping import adjusted_rms, camera_of, from_first, photo_model, triangulate
from cuspid.motion.monocular.photograph_matches import detect_in_all
from cuspid.motion.monocular.photographs import PhotographOptions, canonical_order, check_enough, match_all
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
        images = _images_by_name(model, photographs, folder)
        known = _take_model(model, images, photographs, folder)
        if len(known.tracks.points) < _LEAST_POINTS:
            known = _triangulate(known, photographs, options, progress)
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


def _images_by_name(model: ColmapModel, photographs: Photographs, folder: Path) -> dict[str, pycolmap.Image]:
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
    model: ColmapModel, images: Mapping[str, pycolmap.Image], photographs: Photographs, folder: Path
) -> PhotoModel:
    """Poses, lenses, and the points that the model has. Photographs of one size may have several of its cameras."""
    keys = {name: (photographs[name].camera, image.camera_id) for name, image in images.items()}
    several = len(set(keys.values())) > len({camera for camera, _ in keys.values()})
    label = {key: f"{key[0]}-{key[1]}" if several else key[0] for key in keys.values()}
    cameras = {
        label[key]: _camera_of_size(model.cameras[key[1]], photographs, name, folder) for name, key in keys.items()
    }
    camera_names = {name: label[key] for name, key in keys.items()}
    known = PhotoModel(
        cameras=cameras,
        camera_of=camera_names,
        cam_from_world={name: rigid_from_colmap(image.cam_from_world()) for name, image in images.items()},
        tracks=_tracks(model, images, photographs, list(cameras), camera_names),
    )
    return from_first(known)


def _camera_of_size(camera: pycolmap.Camera, photographs: Photographs, name: str, folder: Path) -> Camera:
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
    model: ColmapModel,
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


def _triangulate(
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
    order = canonical_order(own)
    features, _ = detect_in_all(
        order, options.features, max_image_px=options.max_image_px, even=False, progress=progress
    )
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "first.db"
        match_all(own, order, features, database, options, plain=False, progress=progress)
        found = triangulate(known, order, features, database, options.seed)
    return replace(photo_model(own, order, found, features), reprojection_rms_px=adjusted_rms(found))
