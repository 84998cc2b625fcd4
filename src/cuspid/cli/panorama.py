"""Stitch the frames of a hand-held camera."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from cuspid import storage
from cuspid.anatomy.orientation import require_one_jaw
from cuspid.cli.report import report
from cuspid.cli.shared import Flat, console, show_progress
from cuspid.geometry import Rigid3
from cuspid.model.facing import facing_outwards
from cuspid.model.image_sequence import ImageSequence
from cuspid.model.panorama import FrameUse, Panorama
from cuspid.motion.monocular.single import weak_stretches
from cuspid.pipeline import panorama as panorama_pipeline
from cuspid.pipeline.panorama import MeshViewOptions, StitchOptions
from cuspid.report.figures.panorama import save_camera_path
from cuspid.runtime.errors import InputError
from cuspid.runtime.progress import Progress
from cuspid.runtime.values import join_names
from cuspid.runtime.workers import map_in_threads
from cuspid.stitching.ortho import Stitched


def stitch(
    frames: Annotated[Path | None, Positional, arg(metavar="[FRAMES]")] = None,
    *,
    out: Path,
    mesh: Path | None = None,
    unit: storage.Unit = "mm",
    calibration: Path | None = None,
    options: Annotated[StitchOptions, Flat] = StitchOptions(),
    view: MeshViewOptions = MeshViewOptions(),
) -> None:
    """Stitch the frames of a hand-held camera into a panorama of the arch: the occlusal view at true scale, the
    unrolled strip, what became of each frame, and the camera's path. Or draw the same views of a finished mesh, and
    strips from the cheek and from the tongue.

    Args:
        frames: Folder of images, a video (mp4, avi, mov, mkv), or a capture; with two or more cameras that see the same
            surface the panorama is in true millimetres.
        out: Folder for the results; if the sequence broke, it has a subfolder for each part: part-1/, part-2/ ...
        mesh: Instead of frames: the folder of a scan (its mesh.ply), or a mesh file (STL, PLY, OBJ, OFF) in any pose.
        unit: Length unit of that mesh file.
        calibration: handpiece.json or rig_config.json of one camera, COLMAP's cameras.txt, or OpenCV's YAML; without
            one (and without that of a capture) the focal length is found from the images.
        view: How the mesh is drawn.
    """
    if (frames is None) == (mesh is None):
        raise InputError("stitch: give either FRAMES or --mesh")
    if frames is not None and calibration is None and _is_rig(frames):
        _stitch_rig(frames, out, options)
    elif frames is not None:
        _stitch_frames(frames, out, calibration, options)
    elif mesh is not None:
        _view_mesh(mesh / "mesh.ply" if mesh.is_dir() else mesh, out, unit, view)
    report(out)


def _stitch_frames(frames: Path, out: Path, calibration: Path | None, options: StitchOptions) -> None:
    with show_progress() as progress:
        sequence = _read_frames(frames, out, calibration, progress)
        hashes = _hashes(sequence, calibration)
        with storage.claimed_folder(out, "stitch", {"stitch": options}, hashes, replace=True):
            parts = panorama_pipeline.stitch(sequence, options, progress=progress)
            folders = [out if len(parts) == 1 else out / f"part-{part.panorama.part}" for part in parts]
            clear(out)
            for folder, part in zip(folders, parts, strict=True):
                _write(folder, part)
    _print(parts, folders)


def _is_rig(frames: Path) -> bool:
    """Whether this is a capture of several cameras."""
    file = frames / "handpiece.json"
    return file.is_file() and len(storage.read_handpiece(file).rig.names) > 1


def _stitch_rig(folder: Path, out: Path, options: StitchOptions) -> None:
    capture = storage.read_capture(folder)
    with show_progress() as progress:
        hashes = storage.hash_capture(capture)
        with storage.claimed_folder(out, "stitch", {"stitch": options}, hashes, replace=True):
            made = panorama_pipeline.stitch_rig(capture, options, progress=progress)
            clear(out)
            _write(out, made)
    _print((made,), [out])


def _view_mesh(path: Path, out: Path, unit: storage.Unit, options: MeshViewOptions) -> None:
    mesh, hashes = storage.read_mesh(path, unit), {"mesh": storage.hash_file(path)}
    storage.require_size(storage.MeasuredFile(path=path, mesh=mesh, unit=unit))
    mesh, facing = facing_outwards(mesh)
    with storage.reading(path):
        require_one_jaw(mesh)
    with show_progress() as progress, storage.claimed_folder(out, "stitch", {"view": options}, hashes, replace=True):
        views, occlusal_from_mesh = panorama_pipeline.view_mesh(mesh, options, progress=progress)
        clear(out)
        for name, strip in views.strips.items():
            storage.write_strip(out if name == "occlusal" else out / name, strip)
        storage.write_json(out / "orientation.json", {"occlusal_from_mesh": occlusal_from_mesh.matrix})
        storage.write_panorama(out, views.panorama)
    width_mm, depth_mm = views.panorama.size_mm or (0.0, 0.0)
    strips = ", ".join(views.strips) or "none"
    console.print(f"{out / 'panorama.png'}: {width_mm:.1f} x {depth_mm:.1f} mm; strips: {strips}")
    for note in (*facing, *views.panorama.notes):
        console.print(f"note: {note}")


def _read_frames(frames: Path, out: Path, calibration: Path | None, progress: Progress) -> ImageSequence:
    """The frames; those of a video are decoded into the folder of the results, which is home to this video alone."""
    read = partial(storage.read_sequence, frames, out / "frames", calibration=calibration, progress=progress)
    if not frames.is_file():
        return read()
    with storage.claimed_folder(out, "decode", {}, {"video": storage.hash_file(frames)}):
        return read()


def _hashes(sequence: ImageSequence, calibration: Path | None) -> dict[str, str]:
    """Of the frames, and of the calibration."""
    frames = map_in_threads(storage.hash_file, sequence.paths)
    named = dict(zip((path.name for path in sequence.paths), frames, strict=True))
    hashes = {"frames": storage.digest_of(named)}
    return hashes if calibration is None else {**hashes, "calibration": storage.hash_file(calibration)}


_FILES = (
    *("panorama.png", "panorama.json", "panorama.pgw", "source.npz", "frames.csv", "poses.json", "camera_path.png"),
    *("strip.png", "strip.json", "strip.csv", "orientation.json", "distances.json", "distances.png"),
)
"""What a panorama, scaled or not, or the views of a mesh consist of."""


def clear(out: Path) -> None:
    """Remove what an earlier run made: not every run makes all of it, and the rest would be shown as of this one."""
    for folder in (*out.glob("part-*"), out / "buccal", out / "lingual", out):
        for name in _FILES:
            (folder / name).unlink(missing_ok=True)
        if folder != out and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _write(folder: Path, part: Stitched) -> None:
    if part.motion is not None:
        storage.write_poses(folder / "poses.json", part.motion.cam_from_world)
        save_path_picture(folder, part.panorama, part.motion.cam_from_world)
    if part.strip is not None:
        storage.write_strip(folder, part.strip)
    storage.write_panorama(folder, part.panorama)


def save_path_picture(folder: Path, panorama: Panorama, cam_from_world: Mapping[str, Rigid3]) -> None:
    """camera_path.png, with weakly constrained frames marked."""
    loose = {frame.name for stretch in weak_stretches(panorama.frames) for frame in stretch}
    save_camera_path(folder / "camera_path.png", panorama, cam_from_world, loose)


def _print(parts: tuple[Stitched, ...], folders: list[Path]) -> None:
    for part, folder in zip(parts, folders, strict=True):
        panorama = part.panorama
        height, width = panorama.covered.shape
        size = panorama.size_mm
        measure = "no scale" if size is None else f"{size[0]:.1f} x {size[1]:.1f} mm"
        used = sum(frame.used for frame in panorama.frames)
        name = "panorama" if len(parts) == 1 else f"part {panorama.part} of {len(parts)}"
        console.print(f"{name}: {folder / 'panorama.png'}, {width} x {height} px, {measure}; {used} frames")
    whole = parts[0].panorama
    for note in whole.notes:
        console.print(f"note: {note}")
    for line in left_out_reasons(whole.frames):
        console.print(f"  left out {line}")


def left_out_reasons(frames: Iterable[FrameUse]) -> list[str]:
    """The frames that are in no part, one line for each reason."""
    names: dict[str, list[str]] = {}
    for frame in frames:
        if not frame.used and frame.reason is not None and not frame.reason.startswith("in part "):
            names.setdefault(frame.reason.split(":")[0], []).append(frame.name)
    return [f"{len(each)} frames, {reason}: {join_names(each)}" for reason, each in names.items()]
