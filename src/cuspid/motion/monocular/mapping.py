"""COLMAP's part in the poses of one camera: its database, verification of matches, mapper and bundle adjustment.

What other modules of this package see of it are models by number (photograph or frame k is image k + 1), sizes and
nouns. One thread throughout: several would add in another order in each run, and bundle adjustment makes much of that.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pycolmap
from jaxtyping import Float, Int

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.photographs import PhotoCamera, Photograph, Photographs
from cuspid.model.reconstruction import Tracks
from cuspid.model.sparse_model import PhotoModel
from cuspid.motion.colmap import ColmapModel, colmap_camera, colmap_rigid, quiet, rigid_from_colmap
from cuspid.motion.frontend.features import Features
from cuspid.motion.monocular.photograph_matches import Pair
from cuspid.runtime.progress import Progress
from cuspid.storage.handpieces import camera_from_colmap

LEAST_PHOTOGRAPHS = 3
"""Two determine no more than their relative direction."""
_GUESSED_FOCAL = 1.2
"""Of the longer side: COLMAP's guess, an angle of view of 45 degrees."""
_STILL_PX, _STILL_SHARE = 0.002, 0.6
"""Matches that move by less than this share of the longer side are still; a pair is, where this share of its are."""
_BATCH = 150
_TELLING = 5
"""A model of so many photographs tells a focal length."""
_LENS_GAIN = 0.03
"""Share of the RMS error that a further lens parameter must take away, not to be left at zero."""
_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""COLMAP's models of a lens, each with all parameters of the one before it."""
_MANY_PER_CAMERA = 8
_LOSS_PX, _WORST_SIGMAS, _LEAST_PX = 1.0, 4.0, 1.0

FilmCamera: TypeAlias = pycolmap.Camera
VerifiedPair: TypeAlias = pycolmap.TwoViewGeometry
"""Matches of two frames that agree with one motion, with ``inlier_matches`` (k, 2), indices of keypoints."""


# --- the database ------------------------------------------------------------------------------------------------


def image_name(index: int) -> str:
    """Name of a photograph in the database."""
    return f"{index:06d}"


def _write_cameras(database: pycolmap.Database, cameras: Sequence[pycolmap.Camera]) -> None:
    """Each camera as a rig of its own, both numbered from 1."""
    for number, camera in enumerate(cameras, start=1):
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)


def _write_image(database: pycolmap.Database, index: int, found: Features, camera_id: int) -> None:
    """An image of a camera with its keypoints, as a frame of its own."""
    image = pycolmap.Image(image_name(index), found.pixels, camera_id, index + 1)
    database.write_image(image, use_image_id=True)
    frame = pycolmap.Frame(frame_id=index + 1, rig_id=camera_id)
    frame.add_data_id(image.data_id)
    database.write_frame(frame, use_frame_id=True)
    database.write_keypoints(index + 1, found.pixels.astype(np.float32))


def fill_database(
    path: Path, photographs: Photographs, order: Sequence[Photograph], features: Mapping[int, Features]
) -> None:
    """A COLMAP database with cameras, keypoints and descriptors; photograph k of ``order`` is image k + 1."""
    names = list(photographs.cameras)
    with pycolmap.Database.open(path) as database:
        _write_cameras(
            database, [guess_camera(known, number) for number, known in enumerate(photographs.cameras.values(), 1)]
        )
        for index, found in features.items():
            _write_image(database, index, found, names.index(order[index].camera) + 1)
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(index + 1, pycolmap.FeatureDescriptors(kind, found.descriptors))


def guess_camera(known: PhotoCamera, camera_id: int, focal_share: float | None = None) -> pycolmap.Camera:
    """The calibrated camera, or one of the focal length that EXIF states, or is guessed as a share of the longer
    side."""
    if known.calibrated is not None:
        camera = colmap_camera(known.calibrated, camera_id)
        camera.has_prior_focal_length = True
        return camera
    width, height = known.size
    focal = known.focal_px if known.focal_px is not None else (focal_share or _GUESSED_FOCAL) * max(known.size)
    return pycolmap.Camera(
        camera_id=camera_id,
        model="SIMPLE_RADIAL",
        width=width,
        height=height,
        params=[focal, width / 2, height / 2, 0.0],
        has_prior_focal_length=known.focal_px is not None,
    )


def guess_focal_lengths(database: Path, photographs: Photographs, shares: Mapping[int, float]) -> None:
    """Start from other guesses of the focal lengths that neither a calibration nor EXIF states, by number of the
    camera, or by 0 for any, as shares of the longer side."""
    with pycolmap.Database.open(database) as opened:
        for number, known in enumerate(photographs.cameras.values(), start=1):
            opened.update_camera(guess_camera(known, number, shares.get(number, shares.get(0))))


# --- matches -----------------------------------------------------------------------------------------------------


def match_pairs(
    database: Path,
    pairs: Sequence[tuple[int, int]],
    *,
    ratio: float,
    min_matches: int,
    seed: int,
    progress: Progress,
) -> None:
    """Match pairs of photographs, and keep in the database what one motion explains."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.sift.max_ratio = ratio
    verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=min_matches)
    verification.ransac.random_seed = seed
    listed = database.with_name("pairs.txt")
    pairing = pycolmap.ImportedPairingOptions(match_list_path=str(listed))
    for first in range(0, len(pairs), _BATCH):
        batch = pairs[first : first + _BATCH]
        listed.write_text("".join(f"{image_name(one)} {image_name(other)}\n" for one, other in batch))
        pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu)
        progress("matching", first + len(batch), len(pairs))


def read_verified_pairs(database: Path, features: Mapping[int, Features], order: Sequence[Photograph]) -> list[Pair]:
    """The pairs that have consistent matches."""
    with pycolmap.Database.open(database) as opened:
        numbers, geometries = opened.read_two_view_geometries()
    found = []
    for number, geometry in zip(numbers, geometries, strict=True):
        if not len(geometry.inlier_matches):
            continue
        one, other = (index - 1 for index in pycolmap.pair_id_to_image_pair(number))
        matches = np.asarray(geometry.inlier_matches, dtype=np.int64)
        shift_px = np.linalg.norm(features[one].pixels[matches[:, 0]] - features[other].pixels[matches[:, 1]], axis=1)
        same = order[one].camera == order[other].camera
        still = same and float(np.mean(shift_px < _STILL_PX * max(order[one].size))) > _STILL_SHARE
        found.append(Pair(first=one, second=other, matches=len(matches), is_still=still))
    return found


def verify_matches(
    camera: FilmCamera,
    one: Features,
    other: Features,
    matches: Int[np.ndarray, "k 2"],
    *,
    error_px: float,
    min_matches: int,
    min_share: float,
    seed: int,
) -> VerifiedPair | None:
    """Matches of two frames of one camera that agree with one motion, or None where there are too few."""
    if len(matches) < min_matches:
        return None
    options = pycolmap.TwoViewGeometryOptions(min_num_inliers=min_matches)
    options.ransac.max_error, options.ransac.random_seed = error_px, seed
    options.ransac.min_num_trials, options.ransac.max_num_trials = 30, 300
    found = pycolmap.estimate_calibrated_two_view_geometry(
        camera, one.pixels, camera, other.pixels, matches.astype(np.uint32), options
    )
    return found if len(found.inlier_matches) >= max(min_matches, min_share * len(matches)) else None


# --- photographs -------------------------------------------------------------------------------------------------


def _run_mapper(
    database: Path, folder: Path, count: int, options: pycolmap.IncrementalPipelineOptions, progress: Progress
) -> list[ColmapModel]:
    placed = 0

    def tell() -> None:
        nonlocal placed
        placed = min(placed + 1, count)
        progress("mapping", placed, count)

    models = pycolmap.incremental_mapping(database, folder, folder, options, next_image_callback=tell)
    progress("mapping", count, count)
    return list(models.values())


def map_photographs(
    photographs: Photographs,
    database: Path,
    count: int,
    *,
    min_matches: int,
    seed: int,
    loose: bool,
    progress: Progress,
) -> list[ColmapModel]:
    """Models of ``count`` photographs, largest first; calibrated cameras stay fixed. ``loose``: from fewer matches."""
    mapper_options = pycolmap.IncrementalPipelineOptions(
        random_seed=seed, num_threads=1, extract_colors=False, min_model_size=LEAST_PHOTOGRAPHS
    )
    mapper_options.min_num_matches = min_matches
    mapper_options.constant_cameras = calibrated_cameras(photographs)
    mapper_options.mapper.constant_cameras = mapper_options.constant_cameras
    if loose or len(photographs.names) < 2 * LEAST_PHOTOGRAPHS:
        mapper_options.mapper.init_min_num_inliers, mapper_options.mapper.init_min_tri_angle = 40, 6.0
        mapper_options.mapper.abs_pose_min_num_inliers, mapper_options.mapper.abs_pose_min_inlier_ratio = 15, 0.15
    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
        models = _run_mapper(database, Path(folder), count, mapper_options, progress)
    return sorted(models, key=model_size, reverse=True)


def calibrated_cameras(photographs: Photographs) -> set[int]:
    """Numbers of the cameras whose calibration is given."""
    numbered = enumerate(photographs.cameras.values(), start=1)
    return {number for number, known in numbered if known.calibrated is not None}


def model_size(model: ColmapModel) -> tuple[int, int]:
    """Number of images that a model places, and of their observations."""
    return int(model.num_reg_images()), int(model.compute_num_observations())


def located_images(model: ColmapModel) -> list[int]:
    """Numbers of the photographs, from 0, that a model places."""
    return [int(identifier) - 1 for identifier in model.reg_image_ids()]


def focal_shares(models: Sequence[ColmapModel]) -> dict[int, float]:
    """Focal lengths that a model of several photographs has found, by number of the camera, as shares of the longer
    side."""
    if not models or models[0].num_reg_images() < _TELLING:
        return {}
    cameras = models[0].cameras.items()
    return {number: float(camera.params[0]) / max(camera.width, camera.height) for number, camera in cameras}


def triangulate(
    known: PhotoModel, order: Sequence[Photograph], features: Mapping[int, Features], database: Path, seed: int
) -> ColmapModel:
    """Points for given poses, from the matches of a database."""
    posed = _to_colmap(known, order, features)
    mapper_options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=1, extract_colors=False)
    return pycolmap.triangulate_points(posed, database, database.parent, database.parent, True, mapper_options)


def _to_colmap(known: PhotoModel, order: Sequence[Photograph], features: Mapping[int, Features]) -> ColmapModel:
    """The poses as COLMAP's model without points, numbered as in the database."""
    model, names = ColmapModel(), list(known.cameras)
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


# --- the lens ----------------------------------------------------------------------------------------------------


def camera_of(camera: pycolmap.Camera, what: str) -> Camera:
    """A camera of COLMAP's, of any model that OPENCV's contains. Raises InputError for others."""
    entry = {"camera_model_name": camera.model.name, "camera_params": list(camera.params)}
    return camera_from_colmap(entry, (camera.width, camera.height), what)


def refine_lens(model: ColmapModel, held: Collection[int]) -> tuple[ColmapModel, float]:
    """A model adjusted with as many parameters of the lens as its photographs bear, without what does not fit, and its
    RMS reprojection error, px.

    A parameter more must pay: one that the images do not determine turns with the poses. The principal point stays in
    the middle: it can hardly be distinguished from a rotation of the camera, above all in a ring of photographs.
    ``held``: numbers of the cameras whose lens is known.
    """
    rms = _adjust_model(model, held)
    by_camera = dict.fromkeys(model.cameras, 0)
    for identifier in model.reg_image_ids():
        by_camera[model.images[identifier].camera_id] += 1
    free = {number for number, count in by_camera.items() if number not in held and count >= _MANY_PER_CAMERA}
    for kind in _MODELS[1:] if free else ():
        wider = ColmapModel(model)
        for number in free:
            _widen(wider.cameras[number], kind)
        better = _adjust_model(wider, held)
        if better < (1 - _LENS_GAIN) * rms:
            model, rms = wider, better
    return model, rms


def _widen(camera: pycolmap.Camera, kind: str) -> None:
    """The same lens with more parameters."""
    wide = camera_of(camera, "camera")
    chosen = {"RADIAL": [0, 2, 3, 4, 5], "OPENCV": list(range(8))}[kind]
    camera.model = getattr(pycolmap.CameraModelId, kind)
    camera.params = wide.parameters[chosen].tolist()


def _adjust_model(model: ColmapModel, held: Collection[int]) -> float:
    """Adjust all, twice, without what does not fit after the first time; RMS, px."""
    for _ in range(2):
        config = pycolmap.BundleAdjustmentConfig()
        for identifier in model.reg_image_ids():
            config.add_image(identifier)
        for number in held:
            config.set_constant_cam_intrinsics(number)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        options = pycolmap.BundleAdjustmentOptions(print_summary=False)
        options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
        options.ceres.loss_function_scale = _LOSS_PX
        options.ceres.solver_options.num_threads = 1
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
        model.update_point_3d_errors()
        errors = np.array([point.error for point in model.points3D.values()])
        limit_px = max(_WORST_SIGMAS * float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0, _LEAST_PX)
        manager = pycolmap.ObservationManager(model)
        manager.filter_all_points3D(limit_px, 1.5)
    return adjusted_rms(model)


def adjusted_rms(model: ColmapModel) -> float:
    """RMS reprojection error, px."""
    model.update_point_3d_errors()
    lengths = np.array([point.track.length() for point in model.points3D.values()], dtype=np.float64)
    errors = np.array([point.error for point in model.points3D.values()])
    return float(np.sqrt(np.sum(lengths * errors**2) / max(lengths.sum(), 1)))


# --- models as values --------------------------------------------------------------------------------------------


def photo_model(
    photographs: Photographs,
    order: Sequence[Photograph],
    model: pycolmap.Reconstruction,
    features: Mapping[int, Features],
) -> PhotoModel:
    """A model of COLMAP's, whose image k + 1 is photograph k of ``order``, as the noun."""
    by_name = {order[identifier - 1].name: identifier for identifier in model.reg_image_ids()}
    names = [name for name in photographs.names if name in by_name]
    poses = {name: rigid_from_colmap(model.images[by_name[name]].cam_from_world()) for name in names}
    used = {number: name for number, name in enumerate(photographs.cameras, start=1) if number in model.cameras}
    cameras = {name: camera_of(model.cameras[number], name) for number, name in used.items()}
    camera_names = {name: photographs[name].camera for name in names}
    cameras = {name: camera for name, camera in cameras.items() if name in camera_names.values()}
    known = PhotoModel(
        cameras={name: photographs.cameras[name].calibrated or camera for name, camera in cameras.items()},
        camera_of=camera_names,
        cam_from_world=poses,
        tracks=_tracks(model, [by_name[name] for name in names], list(cameras), camera_names, names, features),
    )
    return from_first(known)


def _tracks(
    model: pycolmap.Reconstruction,
    identifiers: Sequence[int],
    cameras: Sequence[str],
    camera_names: Mapping[str, str],
    names: Sequence[str],
    features: Mapping[int, Features],
) -> Tracks:
    place = {identifier: frame for frame, identifier in enumerate(identifiers)}
    points: list[np.ndarray] = []
    colors, rows, pixels = [], [], []
    for _, point in sorted(model.points3D.items()):
        seen = [each for each in point.track.elements if each.image_id in place]
        rows += [(len(points), place[each.image_id]) for each in seen]
        pixels += [features[each.image_id - 1].pixels[each.point2D_idx] for each in seen]
        colors.append(np.mean([features[e.image_id - 1].colors[e.point2D_idx] for e in seen], axis=0))
        points.append(point.xyz)
    index = np.array(rows, dtype=np.int64).reshape(-1, 2)
    camera_index = np.array([cameras.index(camera_names[name]) for name in names], dtype=np.int64)
    return Tracks(
        points=np.array(points, dtype=np.float64).reshape(-1, 3),
        colors=np.rint(np.array(colors).reshape(-1, 3)).astype(np.uint8),
        point_index=index[:, 0],
        frame_index=index[:, 1],
        camera_index=camera_index[index[:, 1]],
        pixels=np.array(pixels, dtype=np.float64).reshape(-1, 2),
    )


def from_first(model: PhotoModel) -> PhotoModel:
    """The same in the frame of the first located photograph."""
    first = next(iter(model.cam_from_world.values()))
    world_from_first = first.inverse()
    poses = {name: pose @ world_from_first for name, pose in model.cam_from_world.items()}
    identity = {model.frames[0]: Rigid3.identity()}
    tracks = replace(model.tracks, points=first.apply(model.tracks.points))
    return replace(model, cam_from_world={**poses, **identity}, tracks=tracks)


# --- films -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FilmModel:
    """A model of frames of a film while it is joined with others."""

    poses: Mapping[int, Rigid3]
    """cam_from_world by index of the frame."""
    points: Float[np.ndarray, "p 3"]
    seen: Int[np.ndarray, "o 3"]
    """Rows of (point, frame, keypoint)."""
    focal_px: float
    """That the mapper found or was given."""


def build_film_camera(camera: Camera | None, size: tuple[int, int], field_of_view_deg: float) -> FilmCamera:
    """The calibrated camera, or one with a guessed focal length."""
    if camera is not None:
        known = colmap_camera(camera, 1)
        known.has_prior_focal_length = True
        return known
    width, height = size
    focal = Camera.from_field_of_view(width, height, field_of_view_deg).focal_px[0]
    parameters = [focal, width / 2, height / 2]
    return pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=width, height=height, params=parameters)


def map_film(
    camera: FilmCamera,
    features: Mapping[int, Features],
    verified: Mapping[tuple[int, int], VerifiedPair],
    *,
    calibrated: bool,
    min_matches: int,
    error_px: float,
    seed: int,
    progress: Progress,
) -> list[FilmModel]:
    """Models of the frames of one camera, largest first: short steps over a low relief, few and noisy matches."""
    options = pycolmap.IncrementalPipelineOptions(
        random_seed=seed, num_threads=1, extract_colors=False, min_model_size=3
    )
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not calibrated
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.init_min_num_inliers, options.mapper.init_min_tri_angle = 2 * min_matches, 5.0
    options.mapper.abs_pose_min_num_inliers = min_matches
    options.mapper.abs_pose_max_error, options.mapper.abs_pose_min_inlier_ratio = 3 * error_px, 0.15
    options.mapper.filter_max_reproj_error = 1.5 * error_px
    options.ba_local_max_refinements, options.ba_global_max_refinements = 1, 2
    options.ba_global_frames_ratio, options.ba_global_points_ratio = 1.3, 1.4
    with tempfile.TemporaryDirectory() as folder, quiet():
        database = Path(folder) / "database.db"
        with pycolmap.Database.open(database) as opened:
            _write_cameras(opened, [camera])
            for index, found in features.items():
                _write_image(opened, index, found, 1)
            for (one, other), geometry in verified.items():
                opened.write_two_view_geometry(one + 1, other + 1, geometry)
        models = _run_mapper(database, Path(folder), len(features), options, progress)
    return [_read_film(model) for model in sorted(models, key=lambda model: -int(model.num_reg_images()))]


def _read_film(found: ColmapModel) -> FilmModel:
    images = {identifier: found.images[identifier] for identifier in sorted(found.reg_image_ids())}
    points: list[np.ndarray] = []
    rows: list[tuple[int, int, int]] = []
    for _, point in sorted(found.points3D.items()):
        rows += [(len(points), each.image_id - 1, each.point2D_idx) for each in point.track.elements]
        points.append(point.xyz)
    return FilmModel(
        {identifier - 1: rigid_from_colmap(image.cam_from_world()) for identifier, image in images.items()},
        np.array(points, dtype=np.float64).reshape(-1, 3),
        np.array(rows, dtype=np.int64).reshape(-1, 3),
        float(found.cameras[1].params[0]),
    )
