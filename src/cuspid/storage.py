"""Every folder and file format, read and write (see docs/formats.md).

Files appear whole or not at all: they are written beside their place and renamed. A folder that a run writes into keeps
``run.json`` with what it was made from, so that a run can go on where it stopped and never mixes with another one.
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import trimesh
from jaxtyping import Int, UInt8

import cuspid
from cuspid.camera import Camera
from cuspid.capture import Capture, Frame
from cuspid.errors import CuspidError, InputError, OutputError
from cuspid.geometry import Rigid3
from cuspid.jaw import FDI_FROM_UNIVERSAL, Arch, Jaw
from cuspid.mesh import Mesh
from cuspid.reconstruction import DepthMap, Dropped, Reconstruction
from cuspid.rig import Exposure, Handpiece, Light, MountedCamera, Rig, Sensor
from cuspid.trueness import GroundTruth, Trueness

Unit = Literal["mm", "cm", "m", "in", "um"]
MM_PER_UNIT: Mapping[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "um": 0.001}
"""Length units that a mesh file may be in."""

MESH_SUFFIXES = (".stl", ".ply", ".obj")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")


# --- Writing whole files -------------------------------------------------------------------------------------------


PART = ".part-"
"""How the names of unfinished files begin; a killed run leaves them behind, and nothing reads them."""


def _finished(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if not path.name.startswith(PART)]


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well.

    Raises OutputError where the disk is full, read-only or the folder cannot be made.
    """
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=PART, suffix=path.suffix)
        os.close(handle)
        temporary = Path(name)
        temporary.chmod(0o644)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise OutputError(_describe(path, error)) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _describe(path: Path, error: OSError) -> str:
    if error.errno == errno.ENOSPC:
        return f"{path}: the disk is full; free some space and run the same command again, it goes on where it stopped"
    return f"{path}: cannot be written ({error.strerror or error}); choose another --out"


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value: object) -> None:
    """Write JSON whole or not at all; dataclasses, arrays and paths are converted."""
    write_bytes(path, (json.dumps(_plain(value), indent=2, allow_nan=False) + "\n").encode())


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def read_json(path: Path) -> Any:
    """Parse a JSON file. Raises InputError where it is missing or broken."""
    try:
        return json.loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what a malformed value in a parsed file raises into one clear line."""
    try:
        yield
    except CuspidError:
        raise
    except KeyError as error:
        raise InputError(f"{path}: the field {error} is missing; see docs/formats.md") from error
    except (ValueError, TypeError, AttributeError, IndexError, np.linalg.LinAlgError) as error:
        raise InputError(f"{path}: a value cannot be used ({error}); see docs/formats.md") from error


# --- Runs ----------------------------------------------------------------------------------------------------------


def hash_file(path: Path) -> str:
    """SHA-256 of a file's contents."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def hash_capture(capture: Capture) -> dict[str, str]:
    """SHA-256 of a capture's handpiece and of its list of frames with the sizes of their images.

    The contents of the images are not read: that would take longer than finding a broken one when it is used.
    """
    listing = [
        (path.name, path.stat().st_size)
        for name in capture.handpiece.rig.names
        for frame in capture.frames
        if (path := capture.image_path(frame, name)).exists()
    ]
    parts = {"handpiece": _handpiece_to_json(capture.handpiece), "images": listing}
    return {name: hashlib.sha256(json.dumps(_plain(part)).encode()).hexdigest() for name, part in parts.items()}


def claim_folder(
    folder: Path, stage: str, settings: Mapping[str, object], inputs: Mapping[str, str], *, replace: bool = False
) -> None:
    """Make ``folder`` the home of one run of a stage, or find that it is already.

    ``run.json`` keeps for each stage the version, the settings and the hashes of the inputs. Raises OutputError where
    the folder holds files that no run of cuspid wrote, or the same stage made from something else (unless it may be
    replaced, since it is made anew as a whole).
    """
    manifest_path = folder / "run.json"
    entry = _plain({"cuspid": cuspid.__version__, "settings": settings, "inputs_sha256": inputs})
    manifest = read_json(manifest_path) if manifest_path.exists() else {}
    if not manifest and folder.exists() and _finished(folder):
        raise OutputError(f"{folder}: holds files that are not from cuspid; give an empty or new folder as --out")
    if stage in manifest and manifest[stage] != entry and not replace:
        changed = _first_difference(manifest[stage], entry)
        raise OutputError(
            f"{folder}: holds another run of '{stage}' ({changed} differs); give another --out or delete the folder"
        )
    if manifest.get(stage) != entry:
        write_json(manifest_path, {**manifest, stage: entry})


@contextmanager
def claimed_folder(
    folder: Path, stage: str, settings: Mapping[str, object], inputs: Mapping[str, str], *, replace: bool = False
) -> Iterator[None]:
    """:func:`claim_folder` for the work in the block; leaves no trace where the work is refused before it wrote."""
    existed = folder.exists()
    claim_folder(folder, stage, settings, inputs, replace=replace)
    try:
        yield
    except CuspidError:
        if not existed and [path.name for path in folder.iterdir()] == ["run.json"]:
            (folder / "run.json").unlink()
            folder.rmdir()
        raise


def _first_difference(old: Any, new: Any, name: str = "") -> str:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in {**old, **new}:
            if old.get(key) != new.get(key):
                return _first_difference(old.get(key), new.get(key), f"{name}.{key}" if name else key)
    return name or "it"


# --- Meshes and jaws -----------------------------------------------------------------------------------------------


def read_mesh(path: Path, unit: Unit = "mm") -> Mesh:
    """A mesh from an STL, PLY or OBJ file, in mm, with coincident vertices joined.

    Raises InputError where the file is missing, not a mesh, empty, or has coordinates that are not finite.
    """
    return _read_triangles(path, unit)[0]


def _read_triangles(path: Path, unit: Unit) -> tuple[Mesh, trimesh.Trimesh]:
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{path}: not a mesh file that cuspid reads; give an STL, PLY or OBJ file")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        loaded = trimesh.load(path, process=False, force="mesh", skip_materials=True)
    except Exception as error:  # trimesh's loaders raise whatever the parser met
        raise InputError(f"{path}: not a mesh ({type(error).__name__}: {error}); export it again") from error
    vertices = np.asarray(getattr(loaded, "vertices", np.empty((0, 3))), dtype=np.float64)
    faces = np.asarray(getattr(loaded, "faces", np.empty((0, 3))), dtype=np.int64)
    if len(vertices) == 0 or len(faces) == 0:
        raise InputError(f"{path}: the mesh is empty (no triangles); export the surface, not a point cloud")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: some coordinates are not finite numbers; repair the mesh and export it again")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: faces name vertices that do not exist; export the mesh again")
    colors = _vertex_colors(loaded)
    merged, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    mesh = Mesh(
        merged * MM_PER_UNIT[unit],
        inverse.reshape(-1)[faces],
        None if colors is None else colors[first],
    )
    return mesh, loaded


def _vertex_colors(loaded: trimesh.Trimesh) -> UInt8[np.ndarray, "v 3"] | None:
    if loaded.visual.kind != "vertex":
        return None
    return np.asarray(loaded.visual.vertex_colors, dtype=np.uint8)[:, :3]


def read_labelled_mesh(
    path: Path, unit: Unit = "mm"
) -> tuple[Mesh, Int[np.ndarray, "f"] | None, UInt8[np.ndarray, "f 3"] | None]:
    """As :func:`read_mesh`, with the FDI label and the colour of each face where the file has them.

    Labels are the PLY face property ``label``, or a file ``<name>_facelabels.npy`` beside it, in FDI or Universal
    numbers (recognised by their range). Raises InputError where their number is not that of the faces.
    """
    mesh, loaded = _read_triangles(path, unit)
    colors = None
    if loaded.visual.kind == "face":
        colors = np.asarray(loaded.visual.face_colors, dtype=np.uint8)[:, :3]
    beside = path.with_name(f"{path.stem}_facelabels.npy")
    if beside.exists():
        try:
            labels = np.load(beside, allow_pickle=False).astype(np.int64).reshape(-1)
        except (ValueError, OSError) as error:
            raise InputError(f"{beside}: not a readable array of labels ({error})") from error
    else:
        raw = loaded.metadata.get("_ply_raw", {}).get("face", {}).get("data")
        names = raw.dtype.names if raw is not None and getattr(raw, "dtype", None) is not None else ()
        labels = np.asarray(raw["label"], dtype=np.int64).reshape(-1) if names and "label" in names else None
    if labels is not None and len(labels) != len(mesh.faces):
        raise InputError(f"{path}: {len(labels)} labels for {len(mesh.faces)} faces; one for each is needed")
    return mesh, None if labels is None else _fdi_labels(labels, path), colors


def _fdi_labels(labels: Int[np.ndarray, "f"], path: Path) -> Int[np.ndarray, "f"]:
    values = {int(value) for value in np.unique(labels)} - {0}
    if values <= set(FDI_FROM_UNIVERSAL.values()) and (
        values & set(range(33, 49)) or not values & {9, 10, 19, 20, 29, 30}
    ):
        return labels
    if values <= set(FDI_FROM_UNIVERSAL):
        table = np.zeros(33, dtype=np.int64)
        for universal, fdi in FDI_FROM_UNIVERSAL.items():
            table[universal] = fdi
        return table[labels]
    raise InputError(f"{path}: tooth labels {sorted(values)[:6]} are neither FDI nor Universal numbers")


def write_mesh(path: Path, mesh: Mesh, face_labels: Int[np.ndarray, "f"] | None = None) -> None:
    """Write a mesh in mm: binary PLY (with colour and labels), binary STL or OBJ, by the file's suffix."""
    exported = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colors, process=False)
    if face_labels is not None:
        exported.face_attributes["label"] = face_labels.astype(np.int32)
    data = exported.export(file_type=path.suffix.lower().lstrip("."))
    write_bytes(path, data.encode() if isinstance(data, str) else data)


def write_jaw(path: Path, jaw: Jaw) -> None:
    """Write a jaw as PLY with its labels, and what a mesh file cannot hold as JSON beside it."""
    write_mesh(path, jaw.mesh, jaw.face_labels)
    write_json(path.with_suffix(".json"), {"arch": jaw.arch, "landmarks_mm": jaw.landmarks})


def read_jaw(path: Path) -> Jaw:
    """A jaw that :func:`write_jaw` wrote, already in the occlusal frame and in mm."""
    mesh, labels, _ = read_labelled_mesh(path)
    beside = path.with_suffix(".json")
    extra = read_json(beside) if beside.exists() else {"arch": None, "landmarks_mm": {}}
    with reading(beside):
        landmarks = {name: np.array(point, dtype=np.float64) for name, point in extra["landmarks_mm"].items()}
        arch: Arch | None = extra["arch"]
        return Jaw(mesh=mesh, face_labels=labels, arch=arch, landmarks=landmarks)


# --- Handpiece -----------------------------------------------------------------------------------------------------


def _rigid_to_json(target_from_source: Rigid3) -> dict[str, Any]:
    return {
        "rotation_wxyz": target_from_source.quaternion.tolist(),
        "translation_mm": target_from_source.translation.tolist(),
    }


def _rigid_from_json(value: Mapping[str, Any]) -> Rigid3:
    return Rigid3.from_quaternion(
        np.array(value["rotation_wxyz"], dtype=np.float64),
        np.array(value["translation_mm"], dtype=np.float64),
    )


def _covariance_from_json(value: Any) -> np.ndarray | None:
    return None if value is None else np.array(value, dtype=np.float64)


def _camera_to_json(camera: Camera) -> dict[str, Any]:
    return {
        "width_px": camera.width,
        "height_px": camera.height,
        "focal_px": camera.focal_px,
        "principal_point_px": camera.principal_point_px,
        "distortion_k1_k2_p1_p2": camera.distortion,
        "covariance_fx_fy_cx_cy_k1_k2_p1_p2": camera.covariance,
    }


def _camera_from_json(value: Mapping[str, Any]) -> Camera:
    return Camera(
        width=int(value["width_px"]),
        height=int(value["height_px"]),
        focal_px=np.array(value["focal_px"], dtype=np.float64),
        principal_point_px=np.array(value["principal_point_px"], dtype=np.float64),
        distortion=np.array(value.get("distortion_k1_k2_p1_p2", np.zeros(4)), dtype=np.float64),
        covariance=_covariance_from_json(value.get("covariance_fx_fy_cx_cy_k1_k2_p1_p2")),
    )


def _handpiece_to_json(handpiece: Handpiece) -> dict[str, Any]:
    cameras = {
        name: {
            **_camera_to_json(mounted.camera),
            "cam_from_rig": _rigid_to_json(mounted.cam_from_rig),
            "covariance_rotation_rad_translation_mm": mounted.covariance,
        }
        for name, mounted in handpiece.rig.cameras.items()
    }
    return {
        "name": handpiece.name,
        "working_distance_mm": handpiece.working_distance_mm,
        "depth_range_mm": handpiece.depth_range_mm,
        "cameras": cameras,
        "lights": handpiece.lights,
        "exposures": handpiece.exposures,
        "sensor": handpiece.sensor,
    }


def write_handpiece(path: Path, handpiece: Handpiece) -> None:
    """Write ``handpiece.json``."""
    write_json(path, _handpiece_to_json(handpiece))


def _light_from_json(value: Mapping[str, Any]) -> Light:
    arrays = {key: np.array(value[key], dtype=np.float64) for key in ("position_mm", "direction", "colour")}
    return Light(**{**value, **arrays})


def read_handpiece(path: Path) -> Handpiece:
    """Read ``handpiece.json``, or COLMAP's ``rig_config.json`` with the working distance of the built-in designs.

    Raises InputError that names a missing or unusable field.
    """
    value = read_json(path)
    if isinstance(value, list):
        return Handpiece(rig=read_rig_config(path), name=path.stem)
    with reading(path):
        cameras = {
            name: MountedCamera(
                _camera_from_json(camera),
                _rigid_from_json(camera["cam_from_rig"]),
                _covariance_from_json(camera.get("covariance_rotation_rad_translation_mm")),
            )
            for name, camera in value["cameras"].items()
        }
        near, far = value["depth_range_mm"]
        return Handpiece(
            rig=Rig(cameras),
            lights={name: _light_from_json(light) for name, light in value.get("lights", {}).items()},
            exposures=tuple(
                Exposure(name=exposure["name"], lights=tuple(exposure["lights"]))
                for exposure in value.get("exposures", [])
            ),
            sensor=Sensor(**value.get("sensor", {})),
            working_distance_mm=float(value["working_distance_mm"]),
            depth_range_mm=(float(near), float(far)),
            name=str(value.get("name", path.stem)),
        )


def write_rig_config(path: Path, rig: Rig) -> None:
    """Write COLMAP's ``rig_config.json``; the reference sensor is the first camera."""
    rebased, _ = rig.rebased()
    cameras: list[dict[str, Any]] = []
    for index, (name, mounted) in enumerate(rebased.cameras.items()):
        entry: dict[str, Any] = {
            "image_prefix": f"{name}/",
            "camera_model_name": "OPENCV",
            "camera_params": mounted.camera.parameters,
            "camera_size": [mounted.camera.width, mounted.camera.height],
        }
        if index == 0:
            entry["ref_sensor"] = True
        else:
            entry["cam_from_rig_rotation"] = mounted.cam_from_rig.quaternion
            entry["cam_from_rig_translation"] = mounted.cam_from_rig.translation
        cameras.append(entry)
    write_json(path, [{"cameras": cameras}])


def read_rig_config(path: Path, image_size_px: tuple[int, int] | None = None) -> Rig:
    """Read COLMAP's ``rig_config.json`` (one rig, calibrated cameras of a PINHOLE or OPENCV family).

    The format has no image size: it is taken from cuspid's own extra field ``camera_size``, else from the argument,
    else twice the principal point.
    """
    value = read_json(path)
    with reading(path):
        if len(value) != 1:
            raise InputError(f"{path}: {len(value)} rigs; cuspid works with one")
        cameras: dict[str, MountedCamera] = {}
        for entry in value[0]["cameras"]:
            name = str(entry["image_prefix"]).strip("/")
            cam_from_rig = (
                Rigid3.identity()
                if entry.get("ref_sensor")
                else Rigid3.from_quaternion(
                    np.array(entry["cam_from_rig_rotation"], dtype=np.float64),
                    np.array(entry["cam_from_rig_translation"], dtype=np.float64),
                )
            )
            cameras[name] = MountedCamera(_camera_from_colmap(entry, image_size_px), cam_from_rig)
        return Rig(cameras)


_COLMAP_PARAMETERS: Mapping[str, Sequence[int]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3),
    "RADIAL": (0, 0, 1, 2, 3, 4),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
"""Where (fx, fy, cx, cy, k1, k2, p1, p2) stand among a COLMAP model's parameters."""


def _camera_from_colmap(entry: Mapping[str, Any], image_size_px: tuple[int, int] | None) -> Camera:
    model = entry["camera_model_name"]
    if model not in _COLMAP_PARAMETERS:
        raise InputError(f"camera model {model} is not known here; use one of {', '.join(_COLMAP_PARAMETERS)}")
    given = np.array(entry["camera_params"], dtype=np.float64)
    parameters = np.zeros(8)
    chosen = given[list(_COLMAP_PARAMETERS[model])]
    parameters[: len(chosen)] = chosen
    width, height = entry.get("camera_size") or image_size_px or np.rint(2 * parameters[2:4]).astype(int)
    return Camera(
        width=int(width),
        height=int(height),
        focal_px=parameters[:2],
        principal_point_px=parameters[2:4],
        distortion=parameters[4:],
    )


# --- Captures ------------------------------------------------------------------------------------------------------


def write_capture(capture: Capture) -> None:
    """Write what belongs to a capture besides its images: handpiece, rig configuration and list of frames."""
    write_handpiece(capture.folder / "handpiece.json", capture.handpiece)
    write_rig_config(capture.folder / "rig_config.json", capture.handpiece.rig)
    write_json(capture.folder / "capture.json", {"suffix": capture.suffix, "frames": capture.frames})


def write_image(path: Path, image: UInt8[np.ndarray, "h w 3"]) -> None:
    """Write an RGB image as PNG, whole or not at all."""
    ok, encoded = cv2.imencode(path.suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise OutputError(f"{path}: the image could not be encoded")
    write_bytes(path, encoded.tobytes())


def read_capture(folder: Path, handpiece: Path | None = None) -> Capture:
    """A capture folder: ``images/<camera>/<frame>.*`` and a handpiece file (default ``handpiece.json`` in it).

    Without ``capture.json`` the frames are those of the image folders. Raises InputError where a camera's folder is
    missing, a folder belongs to no camera of the handpiece, the frames differ between cameras, or
    an image is truncated or of another size than its camera's.
    """
    if not (folder / "images").is_dir():
        raise InputError(f"{folder}: no folder 'images' in it; give the folder that holds images/<camera>/<frame>.png")
    known = read_handpiece(handpiece or folder / "handpiece.json")
    present = {path.name for path in (folder / "images").iterdir() if path.is_dir()}
    missing, unknown = set(known.rig.names) - present, present - set(known.rig.names)
    if missing:
        raise InputError(f"{folder / 'images'}: no folder for camera {', '.join(sorted(missing))} of the handpiece")
    if unknown:
        raise InputError(
            f"{folder / 'images'}: the folder {', '.join(sorted(unknown))} is no camera of the handpiece, "
            f"which has {', '.join(known.rig.names)}"
        )
    suffix, stems = _image_stems(folder / "images", known.rig.names)
    manifest = folder / "capture.json"
    if not manifest.exists():
        frames = tuple(Frame(name=stem) for stem in stems)
        return _checked(Capture(folder=folder, handpiece=known, frames=frames, suffix=suffix))
    value = read_json(manifest)
    with reading(manifest):
        frames = tuple(Frame(**frame) for frame in value["frames"])
        suffix = value["suffix"]
    absent = sorted({frame.name for frame in frames} - set(stems))
    if absent:
        raise InputError(
            f"{folder}: {len(absent)} of {len(frames)} frames have no images (first: {absent[0]}); "
            "finish the capture with the command that began it"
        )
    return _checked(Capture(folder=folder, handpiece=known, frames=frames, suffix=suffix))


def _checked(capture: Capture) -> Capture:
    for name in capture.handpiece.rig.names:
        for frame in capture.frames:
            capture.check_image(frame, name)
    return capture


def _image_stems(images: Path, cameras: Sequence[str]) -> tuple[str, list[str]]:
    files = {
        camera: [path for path in _finished(images / camera) if path.suffix.lower() in IMAGE_SUFFIXES]
        for camera in cameras
    }
    stems = {camera: {path.stem for path in paths} for camera, paths in files.items()}
    first = cameras[0]
    for camera in cameras:
        odd = sorted(stems[camera] ^ stems[first])
        if odd:
            raise InputError(
                f"{images}: frames differ between cameras: {odd[0]} is in only one of {first} and {camera}; "
                "each frame needs an image of every camera"
            )
    suffixes = {path.suffix for paths in files.values() for path in paths}
    if not suffixes:
        raise InputError(f"{images}: no images in it")
    if len(suffixes) > 1:
        raise InputError(f"{images}: mixed image types {', '.join(sorted(suffixes))}; convert them to one")
    return suffixes.pop(), sorted(stems[first])


def write_truth(folder: Path, truth: GroundTruth) -> None:
    """Write what only the simulator knows: ``jaw.ply``, ``handpiece.json``, ``poses.json``."""
    write_jaw(folder / "jaw.ply", truth.jaw)
    write_handpiece(folder / "handpiece.json", truth.handpiece)
    write_poses(folder / "poses.json", truth.rig_from_world)


def read_truth(folder: Path) -> GroundTruth:
    """Read what :func:`write_truth` wrote."""
    return GroundTruth(
        jaw=read_jaw(folder / "jaw.ply"),
        handpiece=read_handpiece(folder / "handpiece.json"),
        rig_from_world=read_poses(folder / "poses.json"),
    )


def write_overlap(path: Path, minimum: float, mean: float) -> None:
    """Write the share of the surface in an image that the same camera's next image also sees."""
    write_json(path, {"minimum_overlap": minimum, "mean_overlap": mean})


# --- Reconstructions -----------------------------------------------------------------------------------------------


def write_poses(path: Path, rig_from_world: Mapping[str, Rigid3]) -> None:
    """Write ``rig_from_world`` for each frame."""
    write_json(path, {name: _rigid_to_json(pose) for name, pose in rig_from_world.items()})


def read_poses(path: Path) -> dict[str, Rigid3]:
    """Read what :func:`write_poses` wrote."""
    value = read_json(path)
    with reading(path):
        return {name: _rigid_from_json(pose) for name, pose in value.items()}


def write_reconstruction(folder: Path, reconstruction: Reconstruction, handpiece: Handpiece) -> None:
    """Write poses, refined handpiece and the list of what was dropped; last of all ``reconstruction.json``."""
    write_poses(folder / "poses.json", reconstruction.rig_from_world)
    write_handpiece(folder / "handpiece.json", dataclasses.replace(handpiece, rig=reconstruction.rig))
    write_json(
        folder / "reconstruction.json",
        {
            "frames_located": len(reconstruction.rig_from_world),
            "frames_dropped": reconstruction.dropped,
            "points": 0 if reconstruction.tracks is None else len(reconstruction.tracks.points),
            "reprojection_rms_px": reconstruction.reprojection_rms_px,
            "log": reconstruction.log,
            "pose_covariance_rotation_rad_translation_mm": reconstruction.pose_covariance,
        },
    )


def read_reconstruction(folder: Path) -> Reconstruction:
    """Read what :func:`write_reconstruction` wrote; the sparse tracks stay in COLMAP's model beside it."""
    path = folder / "reconstruction.json"
    value = read_json(path)
    with reading(path):
        return Reconstruction(
            rig=read_handpiece(folder / "handpiece.json").rig,
            rig_from_world=read_poses(folder / "poses.json"),
            dropped=tuple(Dropped(**entry) for entry in value["frames_dropped"]),
            pose_covariance=_covariance_from_json(value["pose_covariance_rotation_rad_translation_mm"]),
            reprojection_rms_px=value["reprojection_rms_px"],
            log=value["log"],
        )


def write_depth_maps(path: Path, depth_maps: Sequence[DepthMap]) -> None:
    """Write the depth maps of one frame as one ``.npz``."""
    arrays: dict[str, np.ndarray] = {}
    for index, depth in enumerate(depth_maps):
        arrays[f"{index}.depth_mm"] = depth.depth_mm
        arrays[f"{index}.confidence"] = depth.confidence.astype(np.float16)
        if depth.color is not None:
            arrays[f"{index}.color"] = depth.color
    header = [
        {
            "frame": depth.frame,
            "camera_name": depth.camera_name,
            "camera": _camera_to_json(depth.camera),
            "cam_from_rig": depth.cam_from_rig.matrix,
        }
        for depth in depth_maps
    ]
    arrays["header"] = np.frombuffer(json.dumps(_plain(header)).encode(), dtype=np.uint8)
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def read_depth_maps(path: Path) -> tuple[DepthMap, ...]:
    """Read what :func:`write_depth_maps` wrote."""
    with np.load(path, allow_pickle=False) as arrays:
        header = json.loads(arrays["header"].tobytes())
        return tuple(
            DepthMap(
                frame=entry["frame"],
                camera_name=entry["camera_name"],
                camera=_camera_from_json(entry["camera"]),
                cam_from_rig=Rigid3.from_matrix(np.array(entry["cam_from_rig"])),
                depth_mm=arrays[f"{index}.depth_mm"],
                confidence=arrays[f"{index}.confidence"].astype(np.float32),
                color=arrays[f"{index}.color"] if f"{index}.color" in arrays else None,
            )
            for index, entry in enumerate(header)
        )


# --- Trueness ------------------------------------------------------------------------------------------------------


def trueness_summary(trueness: Trueness) -> dict[str, Any]:
    """``trueness.json``: the headline at the top level, everything else below it. Unknown numbers are null."""
    accuracy = trueness.accuracy
    details = {
        field.name: getattr(trueness, field.name)
        for field in dataclasses.fields(trueness)
        if field.name not in {"deviation_um", "reference_from_scan"}
    }
    return {
        "mean_abs_um": accuracy.mean_abs_um,
        "signed_mean_um": accuracy.signed_mean_um,
        "std_um": accuracy.std_um,
        "rms_um": accuracy.rms_um,
        "p95_um": accuracy.p95_um,
        "max_um": accuracy.max_um,
        **details,
        "reference_from_scan": trueness.reference_from_scan.matrix,
    }


def write_trueness(path: Path, trueness: Trueness) -> None:
    """Write ``trueness.json``."""
    write_json(path, trueness_summary(trueness))
