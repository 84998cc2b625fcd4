"""COLMAP's types, its sparse models on disk, and its own mapper for comparison.

COLMAP's rig frame is that of the rig's reference camera, here always the first one; see
:meth:`cuspid.model.rig.Rig.rebased`. Images are named ``<camera>/<frame><suffix>``. COLMAP's mapper runs in several
threads and is not repeatable bit for bit.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pycolmap
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Capture, Dropped, Frame, ImageFolder, image_name
from cuspid.model.reconstruction import Reconstruction, Tracks
from cuspid.model.rig import Rig
from cuspid.motion.bundle.adjustment import residuals_px
from cuspid.runtime.errors import InputError, OutputError, ReconstructionError
from cuspid.runtime.inputs import read_bytes
from cuspid.storage.calibrations.lenses import ALL, convert_lens
from cuspid.storage.files import digest_of, hash_file, whole_files

ColmapModel: TypeAlias = pycolmap.Reconstruction
"""COLMAP's sparse model."""
MODEL_FILES = ("cameras", "images", "points3D")
"""Files of a sparse model, ``.bin`` or ``.txt``; newer ones also have ``rigs`` and ``frames``."""

SCALE_SPREAD = 0.02
"""Largest relative spread of the scale between frames for a model that is accepted as made with this handpiece."""


def colmap_camera(camera: Camera, camera_id: int = 0) -> pycolmap.Camera:
    """The same camera as COLMAP's, which has the same models, parameters and pixel origin; with the nearest of its
    lenses for a splined one, which it lacks."""
    camera = _convert_splined_lens(camera)
    return pycolmap.Camera(
        camera_id=camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=camera.parameters.tolist(),
    )


@lru_cache(maxsize=64)
def _convert_splined_lens(camera: Camera) -> Camera:
    return convert_lens(camera, ALL)[0] if camera.lens.splined else camera


def colmap_rigid(transform: Rigid3) -> pycolmap.Rigid3d:
    """The transform as a COLMAP object."""
    return pycolmap.Rigid3d(transform.matrix[:3])


def rigid_from_colmap(transform: pycolmap.Rigid3d) -> Rigid3:
    """A COLMAP transform as a :class:`Rigid3`."""
    return Rigid3.from_matrix(np.asarray(transform.matrix()))


def find_rig_pose(
    rig: Rig,
    points: Float[np.ndarray, "n 3"],
    pixels: Float[np.ndarray, "n 2"],
    cameras: Int[np.ndarray, "n"],
    *,
    error_px: float,
    seed: int,
) -> Rigid3 | None:
    """rig_from_world by RANSAC and refinement (generalised absolute pose), from points and where the cameras, by their
    index in the rig, see them; None where nothing agrees."""
    ransac = pycolmap.RANSACOptions(
        max_error=error_px, random_seed=seed, num_threads=1, min_num_trials=50, max_num_trials=3000
    )
    found = pycolmap.estimate_and_refine_generalized_absolute_pose(
        pixels,
        points,
        cameras.tolist(),
        [colmap_rigid(mounted.cam_from_rig) for mounted in rig.cameras.values()],
        [colmap_camera(mounted.camera) for mounted in rig.cameras.values()],
        ransac,
    )
    return None if found is None else rigid_from_colmap(found["rig_from_world"])


# --- writing -----------------------------------------------------------------------------------------------------


def _sensor(index: int) -> pycolmap.sensor_t:
    """The camera of that index in the rig."""
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, index + 1)


def _colmap_rig(rig: Rig) -> pycolmap.Rig:
    """The rig in the frame of its first camera."""
    made = pycolmap.Rig(rig_id=1)
    made.add_ref_sensor(_sensor(0))
    for index, mounted in enumerate(list(rig.rebased()[0].cameras.values())[1:], start=1):
        made.add_sensor(_sensor(index), colmap_rigid(mounted.cam_from_rig))
    return made


def _add_images(
    model: ColmapModel, found: Reconstruction, taken: Mapping[str, Sequence[str]], suffix: str
) -> Int[np.ndarray, "o"]:
    """Add frames and images with their keypoints; returns the number of each observation within its image."""
    cameras, tracks = found.rig.names, found.tracks
    reference_from_rig = found.rig.rebased()[1]
    image_of = np.zeros(0, np.int64)
    if tracks is not None:
        image_of = tracks.frame_index * len(cameras) + tracks.camera_index
    within = np.zeros(len(image_of), dtype=np.int64)
    by_image = np.split(
        np.argsort(image_of, kind="stable"),
        np.searchsorted(np.sort(image_of), np.arange(1, len(found.frames) * len(cameras))),
    )
    for f, (name, rig_from_world) in enumerate(found.rig_from_world.items()):
        frame = pycolmap.Frame(frame_id=f + 1, rig_id=1)
        images = [(c, f * len(cameras) + c + 1) for c, camera in enumerate(cameras) if camera in taken[name]]
        for c, identifier in images:
            frame.add_data_id(pycolmap.data_t(_sensor(c), identifier))
        frame.rig_from_world = colmap_rigid(reference_from_rig @ rig_from_world)
        model.add_frame(frame)
        for c, identifier in images:
            seen = by_image[identifier - 1]
            within[seen] = np.arange(len(seen))
            pixels = np.zeros((0, 2)) if tracks is None else tracks.pixels[seen]
            image = pycolmap.Image(image_name(name, cameras[c], suffix), pixels, c + 1, identifier)
            image.frame_id = f + 1
            model.add_image(image)
        model.register_frame(f + 1)
    return within


def _add_points(model: ColmapModel, tracks: Tracks, cameras: int, within: Int[np.ndarray, "o"]) -> None:
    """Add the points with their tracks."""
    order = np.argsort(tracks.point_index, kind="stable")
    image = (tracks.frame_index * cameras + tracks.camera_index + 1)[order].tolist()
    number = within[order].tolist()
    ends = np.searchsorted(tracks.point_index[order], np.arange(len(tracks.points) + 1)).tolist()
    for point, (first, last) in enumerate(pairwise(ends)):
        if last - first >= 2:
            elements = [pycolmap.TrackElement(image[o], number[o]) for o in range(first, last)]
            model.add_point3D(tracks.points[point], pycolmap.Track(elements), tracks.colors[point])


def to_colmap(found: Reconstruction, frames: Sequence[Frame] | None = None, suffix: str = ".png") -> ColmapModel:
    """The reconstruction as COLMAP's, with one rig; its observations become the images' keypoints.

    ``frames`` specify which cameras have an image of each located frame; None: all of them.
    """
    every = dict.fromkeys(found.frames, found.rig.names)
    taken = every if frames is None else {frame.name: frame.cameras for frame in frames}
    model = ColmapModel()
    for index, mounted in enumerate(found.rig.cameras.values()):
        model.add_camera(colmap_camera(mounted.camera, index + 1))
    model.add_rig(_colmap_rig(found.rig))
    within = _add_images(model, found, taken, suffix)
    if found.tracks is not None:
        _add_points(model, found.tracks, len(found.rig.names), within)
    model.update_point_3d_errors()
    return model


def write_model(folder: Path, found: Reconstruction, capture: Capture, names: Mapping[str, str] | None = None) -> None:
    """Write COLMAP's sparse model (binary) to a folder, completely or not at all. Raises OutputError.

    ``names``: of the image file of each frame, for photographs, which are not in COLMAP's rig layout.
    """
    model = to_colmap(found, capture.frames, capture.source.suffix)
    if names is not None:
        for image in model.images.values():
            image.name = names[Path(image.name).stem]
    with whole_files(folder) as part:
        try:
            model.write(part)
            written = _read_checked_model(part)
        except (InputError, RuntimeError, ValueError) as error:
            raise OutputError(f"{folder}: the sparse model cannot be written ({error}); free some space") from error
        if (written.num_points3D(), written.num_reg_images()) != (model.num_points3D(), model.num_reg_images()):
            raise OutputError(f"{folder}: the sparse model was not written completely; free some space")


# --- reading -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _PosedImages:
    """Images of a model that belong to a capture."""

    cam_from_world: Mapping[tuple[str, str], Rigid3]
    """By (frame, camera), in the model's unit of length."""
    image_ids: Mapping[int, tuple[str, str]]
    """(frame, camera) of COLMAP's identifiers."""


def _model_folder(folder: Path) -> Path:
    """The folder itself or its subfolder ``0``, whichever holds a model. Raises InputError."""
    for candidate in (folder, folder / "0", folder / "sparse", folder / "sparse" / "0"):
        for suffix in (".bin", ".txt"):
            if all((candidate / f"{name}{suffix}").is_file() for name in MODEL_FILES):
                return candidate
    raise InputError(
        f"{folder}: it contains no COLMAP model; a folder with cameras, images and points3D (.bin or .txt) is needed"
    )


def hash_model(folder: Path) -> str:
    """SHA-256 of a sparse model. Raises InputError where the folder contains none."""
    files = sorted(path for path in _model_folder(folder).iterdir() if path.stem in (*MODEL_FILES, "rigs", "frames"))
    return digest_of({path.name: hash_file(path) for path in files})


def _integer(data: bytes, at: int, size: int) -> int:
    """A little-endian integer."""
    return int.from_bytes(data[at : at + size], "little")


def _after_camera(data: bytes, at: int) -> int:
    """End of a camera of ``cameras.bin``: identifier, model, size, parameters."""
    model = pycolmap.CameraModelId(_integer(data, at + 4, 4))
    return at + 24 + 8 * len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params)


def _after_rig(data: bytes, at: int) -> int:
    """End of a rig of ``rigs.bin``: identifier, reference sensor, other sensors with or without a pose."""
    sensors = _integer(data, at + 4, 4)
    at += 16 if sensors else 8
    for _ in range(1, sensors):
        at += 65 if data[at + 8] else 9
    return at


def _after_frame(data: bytes, at: int) -> int:
    """End of a frame of ``frames.bin``: identifiers, pose, images."""
    return at + 68 + 16 * _integer(data, at + 64, 4)


def _after_image(data: bytes, at: int) -> int:
    """End of an image of ``images.bin``: identifiers, pose, name, keypoints."""
    name_end = data.index(b"\0", at + 64)
    return name_end + 9 + 24 * _integer(data, name_end + 1, 8)


def _after_point(data: bytes, at: int) -> int:
    """End of a point of ``points3D.bin``: identifier, place, colour, error, track."""
    return at + 51 + 8 * _integer(data, at + 43, 8)


_AFTER = {
    "cameras": _after_camera,
    "rigs": _after_rig,
    "frames": _after_frame,
    "images": _after_image,
    "points3D": _after_point,
}


def _is_whole(data: bytes, after: Callable[[bytes, int], int]) -> bool:
    """Whether a binary file ends where its last entry does."""
    at = 8
    try:
        for _ in range(_integer(data, 0, 8)):
            at = after(data, at)
            if at > len(data):
                return False
    except (ValueError, IndexError, TypeError):
        return False
    return at == len(data)


def _read_checked_model(folder: Path) -> ColmapModel:
    """A model from disk. Raises InputError, also for truncated files, on which COLMAP's own reader may hang."""
    folder = _model_folder(folder)
    for name, after in _AFTER.items():
        file = folder / f"{name}.bin"
        if file.is_file() and not _is_whole(read_bytes(file, "arrays"), after):
            raise InputError(f"{file}: truncated or damaged; copy the COLMAP model again")
    try:
        return ColmapModel(folder)
    except (RuntimeError, ValueError, IndexError, MemoryError, KeyError, OverflowError) as error:
        raise InputError(f"{folder}: the COLMAP model cannot be read; copy or export it again") from error


def read_sparse(folder: Path) -> ColmapModel:
    """A model from disk, which may lack ``points3D``: cameras and images are enough. Raises InputError."""
    for candidate in (folder, folder / "0", folder / "sparse", folder / "sparse" / "0"):
        for suffix, empty in ((".bin", bytes(8)), (".txt", b"# none\n")):
            needed = [candidate / f"{name}{suffix}" for name in MODEL_FILES[:2]]
            if not all(path.is_file() for path in needed) or (candidate / f"{MODEL_FILES[2]}{suffix}").is_file():
                continue
            with tempfile.TemporaryDirectory() as made:
                for path in needed:
                    (Path(made) / path.name).write_bytes(read_bytes(path, "arrays"))
                (Path(made) / f"{MODEL_FILES[2]}{suffix}").write_bytes(empty)
                try:
                    return _read_checked_model(Path(made))
                except InputError as error:
                    message = f"{candidate}: the COLMAP model is damaged or of another version; export it again"
                    raise InputError(message) from error
    return _read_checked_model(folder)


def hash_sparse(folder: Path) -> str:
    """As :func:`hash_model`, for a model that may lack ``points3D``; "" where there is none."""
    for candidate in (folder, folder / "0", folder / "sparse", folder / "sparse" / "0"):
        names = (*MODEL_FILES, "rigs", "frames")
        files = sorted(candidate.iterdir()) if candidate.is_dir() else []
        found = {path.name: hash_file(path) for path in files if path.stem in names and path.is_file()}
        if found:
            return digest_of(found)
    return ""


def _match_names(model: ColmapModel, capture: Capture, source: str) -> _PosedImages:
    """Registered images by frame and camera. Raises InputError where the names are not those of the capture."""
    frames, cameras = {frame.name for frame in capture.frames}, set(capture.handpiece.rig.names)
    poses, identifiers, strange = {}, {}, []
    for identifier in sorted(model.reg_image_ids()):
        image = model.images[identifier]
        path = Path(image.name)
        frame, camera = path.stem, path.parent.name
        if frame in frames and camera in cameras:
            poses[frame, camera] = rigid_from_colmap(image.cam_from_world())
            identifiers[identifier] = frame, camera
        else:
            strange.append(image.name)
    if not poses:
        first = capture.frames[0]
        example = image_name(first.name, first.cameras[0], capture.source.suffix)
        found = f"named like {strange[0]}" if strange else "none placed"
        raise InputError(f"{source}: its images ({found}) are not those of the capture, which are named like {example}")
    return _PosedImages(poses, identifiers)


def _centres(rig: Rig, poses: Mapping[str, Rigid3]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Camera centres of one frame in the model's world and in the rig."""
    return (
        np.array([pose.inverse().translation for pose in poses.values()]),
        np.array([rig[camera].centre_in_rig for camera in poses]),
    )


def _baselines(rig: Rig, poses: Mapping[str, Rigid3]) -> Float[np.ndarray, "n 2"]:
    """Distances of each two cameras of one frame in the model and in the rig (mm)."""
    in_model, in_rig = _centres(rig, poses)
    pairs = np.array(list(combinations(range(len(in_model)), 2)), dtype=np.int64).reshape(-1, 2)
    return np.stack([np.linalg.norm(c[pairs[:, 0]] - c[pairs[:, 1]], axis=1) for c in (in_model, in_rig)], axis=1)


def _scale(rig: Rig, frames: Mapping[str, Mapping[str, Rigid3]], source: str) -> tuple[float, float]:
    """Millimetres per unit of the model and its relative spread over the frames. Raises InputError."""
    sums = np.array([_baselines(rig, poses).sum(axis=0) for poses in frames.values()])
    sums = sums[(sums > 0).all(axis=1)]
    if not len(sums):
        raise InputError(f"{source}: no frame has two placed cameras, so its scale is unknown; use a model of the rig")
    scales = sums[:, 1] / sums[:, 0]
    middle = float(np.median(scales))
    return middle, float(np.median(np.abs(scales - middle)) / middle)


def _rig_pose(rig: Rig, poses: Mapping[str, Rigid3], scale: float) -> Rigid3:
    """rig_from_world (mm) that agrees best with the cameras of a frame: mean rotation, mean centre."""
    turns = [rig[camera].cam_from_rig.rotation.T @ pose.rotation for camera, pose in poses.items()]
    rotation = Rotation.from_matrix(np.stack(turns)).mean().as_matrix()
    in_model, in_rig = _centres(rig, poses)
    return Rigid3(rotation, in_rig.mean(axis=0) - rotation @ (scale * in_model.mean(axis=0)))


def _tracks(
    model: ColmapModel,
    images: _PosedImages,
    frames: Sequence[str],
    cameras: Sequence[str],
    world_from_model: Rigid3,
    scale: float,
) -> Tracks:
    """Points and observations in the new world, mm."""
    points: list[Any] = []
    colors, rows, pixels = [], [], []
    for _, point in sorted(model.points3D.items()):
        for element in point.track.elements:
            frame, camera = images.image_ids.get(element.image_id, ("", ""))
            if frame:
                rows.append((len(points), frames.index(frame), cameras.index(camera)))
                pixels.append(model.images[element.image_id].points2D[element.point2D_idx].xy)
        points.append(point.xyz)
        colors.append(point.color)
    index = np.array(rows, dtype=np.int64).reshape(-1, 3)
    return Tracks(
        points=world_from_model.apply(scale * np.array(points, dtype=np.float64).reshape(-1, 3)),
        colors=np.array(colors, dtype=np.uint8).reshape(-1, 3),
        point_index=index[:, 0],
        frame_index=index[:, 1],
        camera_index=index[:, 2],
        pixels=np.array(pixels, dtype=np.float64).reshape(-1, 2),
    )


def from_colmap(model: ColmapModel, capture: Capture, source: str) -> Reconstruction:
    """Metric poses of a capture from a COLMAP model made with or without the rig; the rig's baselines set the scale.

    The log contains ``mm_per_model_unit`` and ``scale_spread``, from which a caller can judge whether the model fits
    the handpiece. Raises InputError where the image names do not match or the scale cannot be found.
    """
    rig, images = capture.handpiece.rig, _match_names(model, capture, source)
    by_frame: dict[str, dict[str, Rigid3]] = {}
    for frame in capture.frames:
        poses = {c: images.cam_from_world[frame.name, c] for c in rig.names if (frame.name, c) in images.cam_from_world}
        if poses:
            by_frame[frame.name] = poses
    scale, spread = _scale(rig, by_frame, source)
    rig_from_model = {frame: _rig_pose(rig, poses, scale) for frame, poses in by_frame.items()}
    world_from_model = next(iter(rig_from_model.values()))
    model_from_world = world_from_model.inverse()
    tracks = _tracks(model, images, list(by_frame), rig.names, world_from_model, scale)
    found = Reconstruction(
        rig=rig,
        rig_from_world={frame: pose @ model_from_world for frame, pose in rig_from_model.items()},
        tracks=tracks if len(tracks.points) else None,
        dropped=(
            *capture.left_out,
            *(
                Dropped(what=f"frame {frame.name}", reason=f"not in {source}")
                for frame in capture.frames
                if frame.name not in by_frame
            ),
        ),
        log={"mm_per_model_unit": scale, "scale_spread": spread},
    )
    if found.tracks is None:
        return found
    rms_px = float(np.sqrt(np.nanmean(np.sum(residuals_px(found) ** 2, axis=1))))  # without those behind a camera
    return replace(found, reprojection_rms_px=rms_px)


def read_model(folder: Path, capture: Capture) -> Reconstruction:
    """Poses of a capture from a folder with a COLMAP model (``--from-poses``), made metric by the handpiece's rig.

    Raises InputError where the folder contains no model, its image names are not those of the capture, or its cameras
    do not have the distances that they have in the handpiece.
    """
    found = from_colmap(_read_checked_model(folder), capture, str(folder))
    if found.log["scale_spread"] > SCALE_SPREAD:
        raise InputError(
            f"{folder}: relative to the handpiece, the distances between its cameras vary by "
            f"{100 * found.log['scale_spread']:.1f} % from frame to frame; give the file of the handpiece that took "
            "these images, or make the model with its rig_config.json"
        )
    return found


# --- COLMAP's own mapper -----------------------------------------------------------------------------------------


def _rig_config(rig: Rig) -> pycolmap.RigConfig:
    """The rig as COLMAP's rig_config.json has it."""
    cameras = []
    for index, (name, mounted) in enumerate(rig.rebased()[0].cameras.items()):
        entry = pycolmap.RigConfigCamera(
            ref_sensor=index == 0, image_prefix=f"{name}/", camera=colmap_camera(mounted.camera)
        )
        if index:
            entry.cam_from_rig = colmap_rigid(mounted.cam_from_rig)
        cameras.append(entry)
    return pycolmap.RigConfig(cameras=cameras)


def _mapper_options(with_rig: bool, seed: int) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's defaults; the given calibration is held where the rig is used."""
    options = pycolmap.IncrementalPipelineOptions(random_seed=seed)
    if with_rig:
        options.ba_refine_focal_length = False
        options.ba_refine_extra_params = False
        options.ba_refine_sensor_from_rig = False
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
    return options


@contextmanager
def quiet() -> Iterator[None]:
    """COLMAP without its log messages, including errors: the caller reports what they mean."""
    before, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 3
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def _map(capture: Capture, folder: Path, with_rig: bool, seed: int) -> tuple[list[ColmapModel], list[float]]:
    """COLMAP's models of the capture and the seconds of extraction, matching and mapping."""
    if not isinstance(capture.source, ImageFolder):
        raise InputError("COLMAP reads images from a folder: write the capture to one, or use --motion rig")
    images, database = capture.source.folder / "images", folder / "database.db"
    frames, suffix = capture.frames, capture.source.suffix
    names = [image_name(f.name, c, suffix) for c in capture.handpiece.rig.names for f in frames if c in f.cameras]
    moments = [time.perf_counter()]
    pycolmap.extract_features(database, images, names, camera_mode=pycolmap.CameraMode.PER_FOLDER)
    moments.append(time.perf_counter())
    if with_rig:
        with pycolmap.Database.open(database) as opened:
            pycolmap.apply_rig_config([_rig_config(capture.handpiece.rig)], opened)
    pycolmap.match_sequential(database)
    moments.append(time.perf_counter())
    models = pycolmap.incremental_mapping(database, images, folder / "sparse", _mapper_options(with_rig, seed))
    moments.append(time.perf_counter())
    return list(models.values()), np.diff(moments).tolist()


def locate_with_colmap(capture: Capture, folder: Path, *, with_rig: bool, seed: int = 0) -> Reconstruction:
    """COLMAP as a user would run it: default features, sequential matching, incremental mapper; for comparison.

    Without the rig, the largest of its models is returned, scaled by the rig's baselines. The log contains the number
    of models, the images placed, and the seconds of each step. Raises ReconstructionError where there is no model.
    """
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "sparse").mkdir(parents=True)
    with quiet():
        models, seconds = _map(capture, folder, with_rig, seed)
    if not models:
        raise ReconstructionError(
            f"COLMAP placed none of {len(capture.frames)} frames; give the surface more texture or use --motion rig"
        )
    largest = max(models, key=lambda model: int(model.num_reg_images()))
    found = from_colmap(largest, capture, "COLMAP's largest model")
    log = dict(zip(("extraction_s", "matching_s", "mapping_s"), seconds, strict=True))
    counts = {"models": len(models), "images_placed": largest.num_reg_images()}
    return replace(found, log={**found.log, **log, **counts})
