"""The whole flow, one function a stage. Each reads and writes folders (docs/formats.md) and goes on where it stopped.

jaw            = load_jaw(path)  or  make_phantom(options)
capture, truth = simulate(jaw, folder)
depths         = measure_depth(capture, folder)
reconstruction = locate(capture, folder)
mesh           = fuse(depths, reconstruction, folder)
trueness       = evaluate(mesh, truth.jaw, scannable=...)
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Bool

from cuspid import storage
from cuspid.anatomy.landmarks.estimation import with_estimates
from cuspid.anatomy.landmarks.scheme import in_frame, missing, validate
from cuspid.anatomy.mouth import MouthOptions, room_mm, study_mouths
from cuspid.anatomy.orientation import check_scale, find_occlusal_frame, labels_from_colors
from cuspid.anatomy.surfaces import named_surfaces
from cuspid.capture import Capture, Frame
from cuspid.errors import InputError, ReconstructionError
from cuspid.evaluation.deviation import EvaluationOptions
from cuspid.evaluation.deviation import evaluate as compare_with_reference
from cuspid.geometry import Rigid3
from cuspid.handpiece.brief import DesignBrief
from cuspid.handpiece.optimise import Section
from cuspid.handpiece.precision import NoiseModel, PrecisionMap, at_best, precision_map
from cuspid.handpiece.visibility import Visibility, VisibilityOptions, scannable_faces, survey_visibility
from cuspid.jaw import ARCHES, Arch, Jaw
from cuspid.mesh import Mesh
from cuspid.motion.colmap import locate_with_colmap, read_model, write_model
from cuspid.motion.location import MotionOptions
from cuspid.motion.location import locate as locate_with_rig
from cuspid.motion.single import SingleOptions, locate_single
from cuspid.reconstruction import DepthMap, Reconstruction
from cuspid.rig import Handpiece
from cuspid.sequence import Sequence as FrameSequence
from cuspid.simulation.appearance import APPEARANCES, Preset
from cuspid.simulation.blender import render_with_blender
from cuspid.simulation.free_path import FreePathOptions, plan_free_path
from cuspid.simulation.occlusal import OcclusalOptions, render_occlusal_view
from cuspid.simulation.raycast import Scene, render_capture
from cuspid.simulation.scan_path import ScanPathOptions, plan_scan_path, steady_poses
from cuspid.stereo.between import BetweenOptions, measure_between
from cuspid.stereo.matching import DepthEstimator, StereoOptions
from cuspid.stitching.ortho import OrthoOptions, Stitched, orthophoto
from cuspid.stitching.thesis_method import ThesisOptions, stitch_as_thesis
from cuspid.surface.cleaning import CleaningOptions, clean
from cuspid.surface.fusion import FusionOptions
from cuspid.surface.fusion import fuse as fuse_depth_maps
from cuspid.trueness import GroundTruth, Trueness

Progress = Callable[[str, int, int], None]
"""Told the stage, how much of it is done and how much there is."""

MotionMethod = Literal["rig", "colmap", "colmap-rig"]


def silent(stage: str, done: int, total: int) -> None:
    """A :data:`Progress` that says nothing."""


def usable_cores() -> int:
    """Cores that this process may run on: a case of a study is pinned to one."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# --- What is scanned -----------------------------------------------------------------------------------------------


def load_jaw(path: Path, *, unit: storage.Unit = "mm", arch: Arch | None = None) -> tuple[Jaw, tuple[str, ...]]:
    """A user's jaw mesh, brought into the occlusal frame, and notes on what was found or is unsure; a jaw that cuspid
    wrote, as it is.

    Raises InputError where the file is no mesh, or its width is not that of a jaw in the given unit.
    """
    jaw, notes, _ = _load_oriented(path, unit, arch)
    return jaw, notes


def _load_oriented(path: Path, unit: storage.Unit, arch: Arch | None) -> tuple[Jaw, tuple[str, ...], Rigid3]:
    """As :func:`load_jaw`, with ``occlusal_from_mesh``."""
    if storage.is_jaw(path):
        return storage.read_jaw(path), (), Rigid3.identity()
    mesh, labels, colors = storage.read_labelled_mesh(path, unit)
    notes = check_scale(mesh, unit)
    occlusal = find_occlusal_frame(mesh)
    moved = mesh.transformed(occlusal.occlusal_from_mesh)
    if labels is None and colors is not None:
        labels = labels_from_colors(colors, moved, arch)
    return Jaw(mesh=moved, face_labels=labels, arch=arch), (*notes, *occlusal.notes), occlusal.occlusal_from_mesh


def jaw_files(folder: Path) -> list[Path]:
    """The mesh files of a folder, or the one file that is given. Raises InputError where there is none."""
    if folder.is_file():
        return [folder]
    found = sorted(path for path in folder.glob("*") if path.suffix.lower() in storage.MESH_SUFFIXES)
    if not found:
        raise InputError(f"{folder}: no jaw meshes in it; give a folder with STL, PLY or OBJ files")
    return found


def load_landmarked_jaw(
    path: Path, *, unit: storage.Unit = "mm", arch: Arch | None = None, landmarks: Path | None = None
) -> tuple[Jaw, tuple[str, ...]]:
    """As :func:`load_jaw`, with landmarks: from a file, or those that the jaw came with; the rest is estimated from its
    labels, where it has any.

    A file ``<name>.landmarks.json`` or ``<name>.mrk.json`` beside the mesh is found by itself. ``lower`` or ``upper``
    in the name of the mesh tells the arch where nothing else does. Raises InputError for a landmark that the scheme or
    the jaw does not know, and where there are neither landmarks nor labels.
    """
    named: Arch | None = next((each for each in ARCHES if each in path.stem.lower()), None)
    jaw, notes, occlusal_from_mesh = _load_oriented(path, unit, arch or named)
    beside = (path.with_suffix(suffix) for suffix in (".landmarks.json", storage.MARKUPS_SUFFIX))
    file = landmarks or next((each for each in beside if each.exists()), None)
    if file is not None:
        given = storage.read_landmarks(file)
        validate(given.landmarks, jaw.teeth, source=str(file))
        placed = in_frame(given.landmarks, occlusal_from_mesh) if given.frame == "mesh" else given.landmarks
        jaw, notes = dataclasses.replace(jaw, landmarks=placed), (*notes, *given.notes)
    if jaw.face_labels is not None and missing(jaw.landmarks, jaw.teeth):
        jaw = with_estimates(jaw)
    if not jaw.landmarks:
        raise InputError(f"{path}: neither landmarks nor tooth labels; give a landmark file or a labelled mesh")
    return jaw, notes


def load_reference(
    path: Path, *, unit: storage.Unit = "mm", arch: Arch | None = None
) -> tuple[Jaw, Bool[np.ndarray, "f"] | None, dict[str, str]]:
    """What a scan is compared with: a mesh file, or the ``truth`` folder of a simulation, which also knows which faces
    could be seen (None for a mesh file). Also the hashes of the files."""
    if not path.is_dir():
        if storage.is_jaw(path):
            return storage.read_jaw(path), None, {"reference": storage.hash_file(path)}
        mesh, labels, _ = storage.read_labelled_mesh(path, unit)
        return Jaw(mesh=mesh, face_labels=labels, arch=arch), None, {"reference": storage.hash_file(path)}
    truth = storage.read_truth(path)
    hashes = {name: storage.hash_file(path / name) for name in ("jaw.ply", "poses.json", "handpiece.json")}
    return truth.jaw, scannable(truth, VisibilityOptions()), hashes


# --- What scans it -------------------------------------------------------------------------------------------------


def room_for(brief: DesignBrief, mouth: MouthOptions) -> float:
    """Gap in mm at the tooth that the brief names, which the asked share of men and of women have at least."""
    _, people = study_mouths(mouth)
    return min(
        float(np.quantile(room_mm(group, mouth)[:, brief.mouth.tooth - 1], 1 - brief.mouth.people))
        for group in people.values()
    )


def sections_of(jaw: Jaw, teeth: Sequence[int], brief: DesignBrief) -> list[Section]:
    """The teeth for which a handpiece is sought, with the poses in which it passes over them."""
    surfaces = named_surfaces(jaw)

    def section(fdi: int) -> Section:
        passes = ScanPathOptions(tooth=fdi, turns=brief.motion.turns, turn_deg=brief.motion.turn_deg)
        return Section.near(jaw.mesh, jaw.tooth_faces(fdi), surfaces, steady_poses(jaw, passes, per_pass=5))

    return [section(fdi) for fdi in teeth]


def foresee(
    jaw: Jaw, handpiece: Handpiece, path: ScanPathOptions, options: VisibilityOptions, *, seed: int = 0
) -> Visibility:
    """What the cameras will see of each face along the path of a simulated scan with the same seed."""
    poses = plan_scan_path(jaw, handpiece, path, np.random.default_rng([seed, 1])).rig_from_world
    return survey_visibility(jaw.mesh, handpiece, poses.values(), options)


def bound_over(
    jaw: Jaw, handpiece: Handpiece, path: ScanPathOptions, noise: NoiseModel, visibility: VisibilityOptions
) -> PrecisionMap:
    """How precisely each face could be measured from the best of five places on each pass of a steady hand."""
    poses = steady_poses(jaw, path, per_pass=5)
    return at_best([precision_map(jaw.mesh, handpiece, pose, noise, visibility=visibility) for pose in poses])


# --- Simulation ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """What the images of a simulation look like."""

    texture: Preset = "artificial"
    """Surface: artificial (strong matte texture, the thesis' condition), powder (weak speckle), enamel (plain, wet)."""
    renderer: Literal["embree", "blender"] = "embree"
    """Embree rays (default), or Blender Cycles with subsurface scattering (needs an environment of its own)."""
    supersampling: int = 2
    """Rays through a pixel along each side."""
    seed: int = 0
    """Chooses texture, hand jitter and sensor noise."""

    def __post_init__(self) -> None:
        if self.supersampling < 1:
            raise InputError(f"simulation: --supersampling is {self.supersampling}; at least 1 is needed")
        if self.seed < 0:
            raise InputError(f"simulation: --seed is {self.seed}; it must not be negative")


@dataclass(frozen=True, kw_only=True)
class SimulationOptions(RenderOptions):
    """How a jaw is scanned in simulation."""

    path: ScanPathOptions = field(default_factory=ScanPathOptions)
    """How the handpiece moves."""


@dataclass(frozen=True, kw_only=True)
class FilmOptions(RenderOptions):
    """How a jaw is filmed by hand in simulation."""

    texture: Preset = "enamel"
    """Surface: artificial (strong matte texture, the thesis' condition), powder (weak speckle), enamel (plain, wet)."""
    path: FreePathOptions = field(default_factory=FreePathOptions)
    """How the hand moves the camera."""


SINGLE_SHOTS: Mapping[str, float | None] = MappingProxyType({"occlusal": None, "shot": 300.0})
"""Height in mm of the camera of each picture of the true jaw; None for an orthographic view."""


def simulate(
    jaw: Jaw, handpiece: Handpiece, folder: Path, options: SimulationOptions, *, progress: Progress = silent
) -> tuple[Capture, GroundTruth]:
    """Scan a jaw: images to ``folder/capture``, what only the simulator knows to ``folder/truth``.

    Images that are there already are kept; a run that goes on gives the same bits as one that was not interrupted.
    """
    path = plan_scan_path(jaw, handpiece, options.path, np.random.default_rng([options.seed, 1]))
    storage.write_overlap(folder / "truth" / "path.json", path.minimum_overlap, path.mean_overlap)
    return take_images(jaw, handpiece, path.rig_from_world, folder, options, progress=progress)


def film(
    jaw: Jaw, handpiece: Handpiece, folder: Path, options: FilmOptions, *, progress: Progress = silent
) -> tuple[Capture, GroundTruth]:
    """As :func:`simulate`, with a camera that a shaky hand moves freely over the arch.

    Also the arch in a single shot from above: ``truth/occlusal``, orthographic, and ``truth/shot``, from far above.
    """
    poses = plan_free_path(jaw, handpiece, options.path, np.random.default_rng([options.seed, 1]))
    capture, truth = take_images(jaw, handpiece, poses, folder, options, progress=progress)
    for done, (name, height_mm) in enumerate(SINGLE_SHOTS.items(), start=1):
        if not (folder / "truth" / name / "view.json").exists():
            scene = _scene(truth, dataclasses.replace(options, supersampling=max(2, options.supersampling)))
            view = render_occlusal_view(scene, OcclusalOptions(camera_height_mm=height_mm))
            storage.write_occlusal_view(folder / "truth" / name, view)
        progress("single shots", done, len(SINGLE_SHOTS))
    return capture, truth


def take_images(
    jaw: Jaw,
    handpiece: Handpiece,
    rig_from_world: Mapping[str, Rigid3],
    folder: Path,
    options: RenderOptions,
    *,
    progress: Progress = silent,
) -> tuple[Capture, GroundTruth]:
    """As :func:`simulate`, from given poses of the handpiece, by the name of the frame."""
    truth = GroundTruth(jaw=jaw, handpiece=handpiece, rig_from_world=rig_from_world)
    storage.write_truth(folder / "truth", truth)
    capture = Capture(
        folder=folder / "capture", handpiece=handpiece, frames=tuple(Frame(name=name) for name in rig_from_world)
    )
    storage.write_capture(capture)
    for done, total in _render(capture, truth, options):
        progress("images", done, total)
    return capture, truth


def _render(capture: Capture, truth: GroundTruth, options: RenderOptions) -> Iterator[tuple[int, int]]:
    names = truth.handpiece.rig.names
    total = len(capture.frames) * len(names)
    present = sum(capture.image_path(frame, name).exists() for frame in capture.frames for name in names)
    render = render_with_blender if options.renderer == "blender" else render_capture
    rendered = render(
        _scene(truth, options),
        truth.rig_from_world,
        lambda frame, camera, image: storage.write_image(capture.image_path(frame, camera), image),
        skip=lambda frame, camera: capture.image_path(frame, camera).exists(),
        processes=usable_cores(),
    )
    for done, _ in enumerate(rendered, start=present + 1):
        yield done, total


def _scene(truth: GroundTruth, options: RenderOptions) -> Scene:
    return Scene(
        jaw=truth.jaw,
        handpiece=truth.handpiece,
        appearance=APPEARANCES[options.texture],
        supersampling=options.supersampling,
        seed=options.seed,
    )


def scannable(truth: GroundTruth, options: VisibilityOptions) -> Bool[np.ndarray, "f"]:
    """The faces of the true jaw that at least two cameras of one exposure could see."""
    return scannable_faces(truth.jaw.mesh, truth.handpiece, truth.rig_from_world.values(), options)


# --- Reconstruction: sees images and calibration alone -------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ReconstructionOptions:
    """How images become a mesh."""

    motion: MotionMethod = "rig"
    """How the frames are located: rig (ours), or COLMAP's own mapper without (colmap) and with the rig (colmap-rig)."""
    stereo: StereoOptions = field(default_factory=StereoOptions)
    """Depth within an exposure."""
    between: BetweenOptions = field(default_factory=BetweenOptions)
    """Depth between consecutive exposures, where one camera of a group alone saw the surface."""
    tracking: MotionOptions = field(default_factory=MotionOptions)
    """Features, odometry and adjustment of the method ``rig``."""
    fusion: FusionOptions = field(default_factory=FusionOptions)
    """Depth maps to one surface."""
    cleaning: CleaningOptions = field(default_factory=CleaningOptions)
    """What is removed from the surface."""


@dataclass(frozen=True)
class StoredDepthMaps:
    """Depth maps on disk, read while they are iterated, as often as need be."""

    files: Sequence[Path]
    """One file a frame."""

    def __iter__(self) -> Iterator[DepthMap]:
        for file in self.files:
            yield from storage.read_depth_maps(file)


def measure_depth(
    capture: Capture, folder: Path, options: StereoOptions, *, progress: Progress = silent
) -> StoredDepthMaps:
    """Depth maps of every frame, exposure by exposure, kept in ``folder``."""
    estimator = DepthEstimator(capture.handpiece, options)

    def measure(frame: Frame) -> tuple[DepthMap, ...]:
        return estimator.measure(capture.images(frame), frame.name)

    return _measure_all(capture.frames, measure, folder, partial(progress, "depth"))


def measure_depth_between(
    capture: Capture,
    reconstruction: Reconstruction,
    folder: Path,
    options: BetweenOptions,
    *,
    progress: Progress = silent,
) -> StoredDepthMaps:
    """Depth maps of each camera together with itself at the next located frame, kept in ``folder``."""
    located = [frame for frame in capture.frames if frame.name in reconstruction.rig_from_world]
    following = {frame.name: after for frame, after in pairwise(located)}

    def measure(frame: Frame) -> tuple[DepthMap, ...]:
        after = following[frame.name]
        poses = reconstruction.rig_from_world
        after_from_rig = poses[after.name] @ poses[frame.name].inverse()
        return measure_between(
            capture.handpiece, capture.images(frame), capture.images(after), after_from_rig, frame.name, options
        )

    return _measure_all(located[:-1], measure, folder, partial(progress, "depth between"))


def _measure_all(
    frames: Sequence[Frame],
    measure: Callable[[Frame], tuple[DepthMap, ...]],
    folder: Path,
    progress: Callable[[int, int], None],
) -> StoredDepthMaps:
    files = [folder / f"{frame.name}.npz" for frame in frames]

    def keep(frame: Frame, file: Path) -> None:
        if not file.exists():
            storage.write_depth_maps(file, measure(frame))

    with ThreadPoolExecutor(usable_cores()) as pool:
        for done, _ in enumerate(pool.map(keep, frames, files), start=1):
            progress(done, len(files))
    return StoredDepthMaps(files)


def locate(
    capture: Capture, folder: Path, options: ReconstructionOptions, *, progress: Progress = silent
) -> Reconstruction:
    """Metric poses of the frames, kept in ``folder`` together with a COLMAP model."""
    if (folder / "reconstruction.json").exists():
        return storage.read_reconstruction(folder)
    if options.motion == "rig":
        found = locate_with_rig(capture, options.tracking, progress=progress, cache=folder / "cache")
    else:
        found = locate_with_colmap(capture, folder / "colmap", with_rig=options.motion == "colmap-rig")
    write_model(folder / "sparse", found, capture)
    storage.write_reconstruction(folder, found, capture.handpiece)
    return found


def fuse(
    depths: StoredDepthMaps,
    reconstruction: Reconstruction,
    folder: Path,
    options: ReconstructionOptions,
    *,
    progress: Progress = silent,
) -> Mesh:
    """One clean mesh: ``mesh.ply`` with colour, ``mesh.stl``, and what was removed in ``mesh.json``."""
    if (folder / "mesh.ply").exists():
        return storage.read_mesh(folder / "mesh.ply")
    raw = fuse_depth_maps(depths, reconstruction.rig_from_world, options.fusion, progress=progress)
    if not len(raw.faces):
        raise ReconstructionError(
            "no surface: the depth maps are empty; the images need texture (spray, powder) or sharper focus"
        )
    mesh, report = clean(raw, options.cleaning)
    storage.write_json(folder / "mesh.json", report)
    storage.write_mesh(folder / "mesh.stl", mesh)
    storage.write_mesh(folder / "mesh.ply", mesh)
    return mesh


def reconstruct(
    capture: Capture,
    folder: Path,
    options: ReconstructionOptions,
    *,
    colmap_model: Path | None = None,
    progress: Progress = silent,
) -> tuple[Reconstruction, Mesh]:
    """Images and calibration to poses and a mesh. With a COLMAP model its poses are taken instead of found."""
    depths = measure_depth(capture, folder / "depth", options.stereo, progress=progress)
    if colmap_model is None:
        reconstruction = locate(capture, folder / "motion", options, progress=progress)
    else:
        reconstruction = read_model(colmap_model, capture)
        storage.write_reconstruction(folder / "motion", reconstruction, capture.handpiece)
    if _moved(capture.handpiece, reconstruction):
        capture = dataclasses.replace(capture, handpiece=dataclasses.replace(capture.handpiece, rig=reconstruction.rig))
        depths = measure_depth(capture, folder / "depth-refined", options.stereo, progress=progress)
    if options.between.enabled:
        between = measure_depth_between(
            capture, reconstruction, folder / "depth-between", options.between, progress=progress
        )
        depths = StoredDepthMaps([*depths.files, *between.files])
    return reconstruction, fuse(depths, reconstruction, folder, options, progress=progress)


def _moved(handpiece: Handpiece, reconstruction: Reconstruction, tolerance_px: float = 0.02) -> bool:
    """Whether the refined calibration moves a point at the working distance by more than a tolerance in any image."""
    for name, before in handpiece.rig.cameras.items():
        after = reconstruction.rig[name]
        corners = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.9, 0.9], [0.5, 0.5]])
        rays = before.camera.rays(corners * [before.camera.width, before.camera.height])
        in_rig = before.cam_from_rig.inverse().apply(rays * handpiece.working_distance_mm)
        shift = after.camera.project(after.cam_from_rig.apply(in_rig)) - before.camera.project(
            before.cam_from_rig.apply(in_rig)
        )
        if np.abs(shift).max() > tolerance_px:
            return True
    return False


# --- Panorama: sees images and calibration alone -------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StitchOptions(OrthoOptions):
    """How the frames of one hand-held camera become a panorama."""

    method: Literal["ortho", "thesis"] = "ortho"
    """ortho: frames located by structure from motion and rectified on the surface. thesis: chapter 4 of the thesis,
    homographies chained from normal map to normal map, as a baseline. PATENT NOTICE: the method thesis appears to be
    claimed by US 11,044,400; check the law where you are before you use it. The method ortho does not use it."""
    motion: SingleOptions = field(default_factory=SingleOptions)
    """Where the camera was (method ortho)."""
    examination: bool = True
    """Leave out frames that fail the examination of the thesis (method thesis)."""
    thesis: ThesisOptions = field(default_factory=ThesisOptions)
    """The method thesis."""


def stitch(sequence: FrameSequence, options: StitchOptions, *, progress: Progress = silent) -> tuple[Stitched, ...]:
    """The panorama of an arch from the frames of one camera; several parts where the sequence broke, largest first.

    Raises ReconstructionError, naming the frames, where nothing can be placed.
    """
    if options.method == "thesis":
        panoramas = stitch_as_thesis(sequence, options.thesis, examination=options.examination, progress=progress)
        return tuple(Stitched(panorama=panorama, motion=None, strip=None) for panorama in panoramas)
    motion = locate_single(sequence, options.motion, progress=progress)
    notes = (*sequence.notes, *motion.notes)
    parts: list[Stitched] = []
    for number, located in enumerate(motion.parts, start=1):
        frames = motion.frames_of(number - 1)
        part = orthophoto(sequence, located, frames, options, progress=progress)
        numbered = dataclasses.replace(
            part.panorama, part=number, parts=len(motion.parts), notes=(*notes, *part.panorama.notes)
        )
        parts.append(dataclasses.replace(part, panorama=numbered))
    return tuple(parts)


# --- Evaluation ----------------------------------------------------------------------------------------------------


def evaluate(
    mesh: Mesh,
    reference: Jaw,
    options: EvaluationOptions,
    *,
    scannable: Bool[np.ndarray, "f"] | None = None,
    seed: int = 0,
) -> Trueness:
    """Trueness of a mesh against its reference (:func:`cuspid.evaluation.deviation.evaluate`)."""
    return compare_with_reference(mesh, reference, options, scannable=scannable, rng=np.random.default_rng(seed))
