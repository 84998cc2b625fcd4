"""The whole pipeline of a scan. Each verb reads and writes folders (docs/formats.md) and resumes where it stopped.

handpiece            = DESIGNS["twelve"](DesignOptions())
capture, truth       = simulate(jaw, handpiece, folder, ...)        images, and what only the simulator knows
reconstruction       = locate(capture, folder, ...)                 metric poses, refined calibration
depths               = measure_depth(capture, folder, ...)          frame by frame, from the rig alone
mesh                 = fuse(depths, ...)
trueness             = evaluate(mesh, truth)

``measure_depth``, ``locate`` and ``fuse`` see only images and calibration. Panoramas: ``panorama_pipeline``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float

from cuspid import storage
from cuspid.anatomy.crowns import crowns_of
from cuspid.anatomy.jaw_files import Labelling
from cuspid.anatomy.orientation import find_occlusal_frame
from cuspid.evaluation.crown import OpenCrown, open_parts, pieces
from cuspid.evaluation.deviation import EvaluationOptions
from cuspid.evaluation.deviation import evaluate as measure_deviation
from cuspid.fusion.cleaning import CleaningOptions
from cuspid.fusion.depth_fusion import FusionOptions
from cuspid.fusion.sharp_edges import SharpEdgeOptions
from cuspid.fusion.stage import find_holes, fuse
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.facing import facing_outwards
from cuspid.model.jaw import GUM, Arch, Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.pairing import detail_mm, stereo_pairs
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Handpiece
from cuspid.model.tolerances import NominalOptions, is_nominal, without_covariances
from cuspid.model.trueness import GroundTruth, Trueness
from cuspid.model.unrolling import is_rolling, unroll_capture
from cuspid.model.visibility import VisibilityOptions, scannable_faces
from cuspid.motion.epipolar_check import epipolar_offset_px
from cuspid.motion.exchanged import require_own_images
from cuspid.motion.icp.surface_tracking import SurfaceTrackingOptions
from cuspid.motion.location import MotionOptions
from cuspid.motion.stage import MotionMethod, locate, locate_by_surfaces, take_poses
from cuspid.mvs.across import AcrossOptions
from cuspid.mvs.matching import Signal, StereoOptions
from cuspid.mvs.signal import choose_signal
from cuspid.mvs.stage import (
    StoredDepthMaps,
    measure_depth,
    measure_depth_across,
    measure_enough_depth,
)
from cuspid.mvs.view_stage import measure_view_depth
from cuspid.runtime.memory import trim_heap
from cuspid.runtime.options import SHARE, Options
from cuspid.runtime.progress import Progress, silent
from cuspid.simulation.stage import RenderOptions, SimulationOptions, simulate, take_images

__all__ = [
    "EvaluationOptions",
    "ReconstructionOptions",
    "Reference",
    "RenderOptions",
    "SimulationOptions",
    "crown_surface",
    "evaluate",
    "fuse",
    "load_reference",
    "locate",
    "measure_depth",
    "measure_depth_across",
    "measure_enough_depth",
    "measure_view_depth",
    "reconstruct",
    "reference_of",
    "scannable",
    "simulate",
    "take_images",
]


Quality = Literal["draft", "standard", "fine"]
_DRAFT_KEYPOINTS, _DRAFT_HALVINGS = 500, 2
_LEFT_SHARE, _DRAFT_LEFT_SHARE = 0.005, 1.0
_DRAFT_ACROSS_LEFT_SHARE, _DRAFT_BEND_PX = 0.03, 1000.0
_FINE_SPACING_PX, _FINE_VOXELS = 2, 0.5
_MOST_PX = {"draft": 1_000_000, "standard": 3_500_000}
"""Images with more pixels than this are halved before depth is measured."""
_MOST_DEPTHS = 150_000
"""Number of depths in a view, unless it is asked for more."""
_FITS_PX = 1.0
"""Matches may lie this far from their epipolar lines for a calibration to be taken as it is."""


@dataclass(frozen=True, kw_only=True)
class ReconstructionOptions(Options):
    """How images become a mesh."""

    quality: Quality = "standard"
    """draft: a quick look at a scan, with keypoints from images of a quarter of the size, depth of every second frame
    from images of half the size, and more small holes. standard: everything that the images give, except for frames
    that add nothing. fine: sharper edges, with depth of all frames at every second pixel and voxels of half the size,
    for several times the time and the memory."""
    left_share: Annotated[float | None, SHARE] = None
    """Depth is measured in every second frame, and then in those frames between them that add to the surface, until the
    sparse points that few depth maps confirm, and that more frames could still improve, are no more than this share (0
    to 1) of all points. 0: in all frames. Default: 0.005, for a draft 1 (every second frame only), for fine 0."""
    calibration: Literal["refined", "fixed"] = "refined"
    """refined: adjusted to the images, within its covariance. fixed: treated as exact."""
    nominal: NominalOptions = field(default_factory=NominalOptions)
    """What is assumed about the calibration if the file does not state how well it is known."""
    motion: MotionMethod = "rig"
    """How the frames are located: rig (cuspid's own method), or COLMAP's mapper without the rig (colmap) or with it
    (colmap-rig)."""
    signal: Literal["auto", "texture", "shading"] = "auto"
    """What is matched: texture, or the light and shade of plain surfaces, where the frames are then located by their
    surfaces. auto: texture if the images hold any."""
    own_images: bool = True
    """Look first whether the images of each camera are its own, or those of another one."""
    stereo: StereoOptions = field(default_factory=StereoOptions)
    """Depth of a view from those that it is matched with."""
    across: AcrossOptions = field(default_factory=AcrossOptions)
    """Depth from consecutive frames, where only one camera of a handpiece saw the surface."""
    tracking: MotionOptions = field(default_factory=MotionOptions)
    """Features, odometry and adjustment for the method ``rig``."""
    surfaces: SurfaceTrackingOptions = field(default_factory=SurfaceTrackingOptions)
    """How plain surfaces are laid onto each other."""
    fusion: FusionOptions = field(default_factory=FusionOptions)
    """How depth maps are fused into one surface."""
    cleaning: CleaningOptions = field(default_factory=CleaningOptions)
    """What is removed from the surface."""
    sharp_edges: SharpEdgeOptions = field(default_factory=SharpEdgeOptions)
    """How sharp edges are restored."""


def reconstruct(
    capture: Capture,
    folder: Path | str,
    options: ReconstructionOptions = ReconstructionOptions(),
    *,
    colmap_model: Path | None = None,
    progress: Progress = silent,
) -> tuple[Reconstruction, Mesh]:
    """Reconstruct poses and a mesh from images and calibration, and keep both, and the depth of each view, in a folder.
    With a COLMAP model, its poses are taken instead of found.

    Raises ReconstructionError where too few frames can be located, or no surface is left.
    """
    folder = Path(folder)
    options = replace(options, signal=resolve_signal(capture, options))
    found = find_poses(capture, folder, options, colmap_model=colmap_model, progress=progress)
    return found, surface(capture, found, folder, options, progress=progress)[0]


def find_poses(
    capture: Capture,
    folder: Path,
    options: ReconstructionOptions,
    *,
    colmap_model: Path | None = None,
    progress: Progress = silent,
) -> Reconstruction:
    """The poses of the frames, and the calibration adjusted to the images (first part of :func:`reconstruct`)."""
    options = resolve_options(options)
    nominal = options.calibration == "refined" and is_nominal(capture.handpiece)
    capture = replace(capture, handpiece=apply_uncertainty(capture.handpiece, options))
    if colmap_model is not None:
        return take_poses(capture, colmap_model, folder / "motion")
    if resolve_signal(capture, options) == "shading":
        depths = _shaded_depth(capture, folder, options, progress)
        made_from, tracking = depths.digest, options.surfaces
        found = locate_by_surfaces(capture, depths, made_from, folder / "motion", tracking, progress=progress)
        return replace(found, notes=(*_unused_shutters(capture, "shading"), *found.notes))
    doubts = _unused_shutters(capture, "texture")
    if options.own_images:
        cache = folder / "motion" / "cache"
        doubts += require_own_images(capture, options.tracking, cache=cache, progress=progress)
    capture, notes = _hold_consistent_calibration(capture, nominal, folder / "motion", options, progress)
    found = locate(capture, folder / "motion", options.tracking, options.motion, progress=progress)
    return replace(found, notes=(*doubts, *notes, *found.notes))


def _unused_shutters(capture: Capture, signal: Signal) -> tuple[str, ...]:
    """That rolling shutters and delays are not taken into account, and why."""
    cameras = capture.handpiece.rig.cameras.values()
    if len(capture.frames) < 2 or all(each.shutter.is_plain for each in cameras):
        return ()
    unused = "shutter: readouts and delays of the handpiece's file are not taken into account"
    if signal == "shading":
        return (f"{unused}: on plain surfaces depth comes before the motion, which they depend on",)
    if not is_rolling(capture.handpiece.rig, [frame.name for frame in capture.frames]):
        return (f"{unused}: the frames' names are not ascending numbers, so their times are unknown",)
    return ()


def _hold_consistent_calibration(
    capture: Capture, nominal: bool, folder: Path, options: ReconstructionOptions, progress: Progress
) -> tuple[Capture, tuple[str, ...]]:
    """One instant with the calibration held, and a note, where that states no uncertainty and the images do not
    contradict it."""
    if not nominal or len(capture.frames) > 1 or options.motion != "rig":
        return capture, ()
    offset_px = epipolar_offset_px(capture, options.tracking, cache=folder / "cache", progress=progress)
    if offset_px is not None and offset_px > _FITS_PX:
        return capture, ()
    finding = (
        "too little is matched to refine it"
        if offset_px is None
        else f"its epipolar lines fit within {offset_px:.1f} px"
    )
    note = f"calibration: kept as in the file, which states no uncertainty: {finding}"
    return replace(capture, handpiece=without_covariances(capture.handpiece)), (note,)


def surface(
    capture: Capture,
    found: Reconstruction,
    folder: Path,
    options: ReconstructionOptions,
    *,
    progress: Progress = silent,
) -> tuple[Mesh, Float[np.ndarray, "v"]]:
    """The mesh, given the poses of the frames (second part of :func:`reconstruct`), and how well each of its vertices
    is known: standard deviation along the normal, um."""
    trim_heap()
    options, capture = resolve_options(options), unroll_capture(capture, found)
    of_size = resize_for_quality(replace(capture, handpiece=replace(capture.handpiece, rig=found.rig)), options)
    detail = detail_mm(of_size.handpiece)
    if resolve_signal(capture, options) == "shading":
        depths = _shaded_depth(capture, folder, options, progress)
    else:
        depths = _textured_depth(of_size, found, detail, folder, options, progress)
    trim_heap()
    return fuse(
        depths,
        depths.digest,
        _poses(found, depths),
        detail,
        folder,
        fusion_for(of_size.handpiece, options),
        options.cleaning,
        options.sharp_edges,
        expected=found.expectation,
        has_scale=found.has_scale,
        progress=progress,
    )


def resolve_signal(capture: Capture, options: ReconstructionOptions) -> Signal:
    """What the images of a capture are matched by."""
    return (
        choose_signal(resize_for_quality(capture, options), options.stereo)
        if options.signal == "auto"
        else options.signal
    )


def resize_for_quality(capture: Capture, options: ReconstructionOptions) -> Capture:
    """The capture with images of the size that depth is measured from: photographs of many megapixels are reduced."""
    if options.quality == "draft":
        capture = capture.halved()
    while options.quality != "fine" and _largest_px(capture) > _MOST_PX[options.quality]:
        capture = capture.halved()
    return capture


def _resolve_spacing(stereo: StereoOptions, capture: Capture) -> StereoOptions:
    """With depth at so many pixels that a view of large images has not many more than one of a handpiece's."""
    spacing_px = round(float(np.sqrt(_largest_px(capture) / _MOST_DEPTHS)))
    if stereo.spacing_px is not None or spacing_px <= stereo.grid_px:
        return stereo
    return replace(stereo, spacing_px=spacing_px)


def _largest_px(capture: Capture) -> int:
    """Number of pixels of the largest images."""
    return max(each.camera.width * each.camera.height for each in capture.handpiece.rig.cameras.values())


def _shaded_depth(
    capture: Capture, folder: Path, options: ReconstructionOptions, progress: Progress
) -> StoredDepthMaps:
    """Depth within frames, before anything is known of their poses."""
    return measure_depth(
        resize_for_quality(capture, options), folder / "depth", options.stereo, "shading", progress=progress
    )


def _textured_depth(
    capture: Capture,
    found: Reconstruction,
    detail: float,
    folder: Path,
    options: ReconstructionOptions,
    progress: Progress,
) -> StoredDepthMaps:
    """Depth within frames and, where only one camera of a group saw the surface, from consecutive ones."""
    assert options.left_share is not None
    handpiece, stereo = capture.handpiece, _resolve_spacing(options.stereo, capture)
    if not stereo_pairs(handpiece.rig, handpiece.working_distance_mm, stereo.pairing):
        return measure_view_depth(capture, found, folder / "depth", stereo, progress=progress)
    agreement_mm = options.fusion.agreement * detail
    depths = measure_enough_depth(
        capture,
        found,
        folder / "depth",
        stereo,
        agreement_mm=agreement_mm,
        left_share=options.left_share,
        progress=progress,
    )
    if not options.across.enabled:
        return depths
    holes = None
    if found.tracks is not None and options.across.small_holes is not False and options.across.left_share != 0:
        poses, fusion = _poses(found, depths), fusion_for(handpiece, options)
        holes = find_holes(depths, depths.digest, poses, detail, folder, fusion, progress=progress)
    return depths | measure_depth_across(
        capture,
        found,
        depths,
        folder / "depth-across",
        options.across,
        stereo,
        agreement_mm=agreement_mm,
        min_maps=options.fusion.min_maps,
        holes=holes,
        progress=progress,
    )


def _poses(found: Reconstruction, depths: StoredDepthMaps) -> dict[str, Rigid3]:
    """``rig_from_world`` of the located frames that have depth maps."""
    return {name: found.rig_from_world[name] for name in depths.frames if name in found.rig_from_world}


def fusion_for(handpiece: Handpiece, options: ReconstructionOptions) -> FusionOptions:
    """How the depth maps of a handpiece are fused."""
    detail = detail_mm(handpiece)
    fusion = options.fusion.resolve(detail, handpiece.footprint_mm)
    if options.quality != "fine" or options.fusion.voxel_mm is not None:
        return fusion
    return replace(fusion, voxel_mm=_FINE_VOXELS * fusion.voxel_for(detail))


def resolve_options(options: ReconstructionOptions) -> ReconstructionOptions:
    """The options with everything that the quality decides filled in, unless given."""
    if options.left_share is None:
        left = {"draft": _DRAFT_LEFT_SHARE, "standard": _LEFT_SHARE, "fine": 0.0}
        options = replace(options, left_share=left[options.quality])
    if options.quality == "draft":
        return _resolve_draft(options)
    if options.quality == "fine" and options.stereo.spacing_px is None:
        options = replace(options, stereo=replace(options.stereo, spacing_px=_FINE_SPACING_PX))
    return options


def _resolve_draft(options: ReconstructionOptions) -> ReconstructionOptions:
    """As for a draft, where nothing else was asked for."""
    tracking, across, fusion = options.tracking, options.across, options.fusion
    features = tracking.features
    if features.count is None:
        features = replace(features, count=_DRAFT_KEYPOINTS)
    if features.halvings is None:
        features = replace(features, halvings=_DRAFT_HALVINGS)
    if across.left_share is None:
        across = replace(across, left_share=_DRAFT_ACROSS_LEFT_SHARE)
    if across.small_holes is None:
        across = replace(across, small_holes=False)
    if fusion.finer_bends is None:
        fusion = replace(fusion, finer_bends=False)
    stereo = options.stereo
    if stereo.refinement.bend_px is None:
        stereo = replace(stereo, refinement=replace(stereo.refinement, bend_px=_DRAFT_BEND_PX))
    tracking = replace(tracking, features=features)
    return replace(options, tracking=tracking, stereo=stereo, across=across, fusion=fusion)


def apply_uncertainty(handpiece: Handpiece, options: ReconstructionOptions) -> Handpiece:
    """The handpiece with the uncertainty that is assumed for it."""
    if options.calibration == "fixed":
        return without_covariances(handpiece)
    return options.nominal.for_handpiece(handpiece).fill(handpiece)


# --- What a scan is compared with ------------------------------------------------------------------------------------


def scannable(truth: GroundTruth, options: VisibilityOptions = VisibilityOptions()) -> Bool[np.ndarray, "f"]:
    """The faces of the true jaw that at least two cameras of one frame could see."""
    return scannable_faces(truth.jaw.mesh, truth.handpiece, truth.rig_from_world.values(), options)


@dataclass(frozen=True, eq=False, kw_only=True)
class Reference:
    """What a scan is compared with."""

    jaw: Jaw
    """The surface, and tooth labels where there are any."""
    scannable: Bool[np.ndarray, "f"] | None
    """The faces that at least two cameras of one frame could see; None if that is not known."""
    crown: OpenCrown | None
    """The open crown surface; None if nothing is crown or looks like it."""
    hashes: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of the files that it was read from, by what they contain."""
    notes: tuple[str, ...] = ()
    """How its files were understood."""


def evaluate(
    mesh: Mesh,
    reference: Reference | GroundTruth | Jaw | Mesh,
    options: EvaluationOptions = EvaluationOptions(),
    *,
    sigma_um: Float[np.ndarray, "v"] | None = None,
) -> Trueness:
    """Trueness of a mesh in any pose. The evaluation covers the surface that at least two cameras could see, which the
    ground truth of a simulation states; of a jaw or a mesh all of it.

    ``sigma_um``: the standard deviation that the scan predicts for each of its vertices, along its normal. Raises
    InputError where the two do not belong together or nothing is left to compare.
    """
    against = reference if isinstance(reference, Reference) else reference_of(reference)
    scan, facing = facing_outwards(mesh)
    found = measure_deviation(
        scan, against.jaw, options, scannable=against.scannable, crown=against.crown, sigma_um=sigma_um
    )
    notes = (*(f"scan: {note}" for note in facing), *(() if against is reference else against.notes))
    return replace(found, notes=(*notes, *found.notes))


def reference_of(truth: GroundTruth | Jaw | Mesh) -> Reference:
    """What a scan is compared with, of what is known of its object: a mesh, in any pose, says least, the ground truth
    of a simulation most."""
    if isinstance(truth, GroundTruth):
        seen = scannable(truth)
        return Reference(jaw=truth.jaw, scannable=seen, crown=crown_surface(truth.jaw, seen=seen))
    if isinstance(truth, Jaw):
        return Reference(jaw=truth, scannable=None, crown=crown_surface(truth))
    mesh, notes = facing_outwards(truth)
    jaw = Jaw(mesh=mesh)
    crown = crown_surface(jaw, find_occlusal_frame(mesh).occlusal_from_mesh)
    return Reference(jaw=jaw, scannable=None, crown=crown, notes=tuple(f"reference: {note}" for note in notes))


def load_reference(
    path: Path,
    *,
    unit: storage.Unit = "mm",
    arch: Arch | None = None,
    scan: storage.MeasuredFile | None = None,
    labelling: Labelling = Labelling(),
) -> Reference:
    """What a scan is compared with: a mesh file, or the ``truth`` folder of a simulation, which also knows which faces
    could be seen. Raises InputError where a mesh is too small or too large for teeth, or for the ``scan``."""
    if not path.is_dir():
        return _loaded_reference(path, unit, arch, scan, labelling)
    truth = storage.read_truth(path)
    if scan is not None and not _SMALLEST_SCAN_MM < scan.width_mm < _LARGEST_SCAN_MM:
        storage.require_one_unit(scan, storage.MeasuredFile(path=path, mesh=truth.jaw.mesh, unit="mm"))
    reference = reference_of(truth)
    hashes = {name: storage.hash_file(path / name) for name in ("jaw.ply", "poses.json", "handpiece.json")}
    return replace(reference, hashes=hashes)


def _loaded_reference(
    path: Path, unit: storage.Unit, arch: Arch | None, scan: storage.MeasuredFile | None, labelling: Labelling
) -> Reference:
    hashes = {"reference": storage.hash_file(path)}
    if storage.is_jaw(path):
        jaw = storage.read_jaw(path)
        _require_sizes(storage.MeasuredFile(path=path, mesh=jaw.mesh, unit="mm", option=_REFERENCE_UNIT), scan)
        return replace(reference_of(jaw), hashes=hashes)
    mesh, labels, _ = storage.read_labelled_mesh(path, unit)
    _require_sizes(storage.MeasuredFile(path=path, mesh=mesh, unit=unit, option=_REFERENCE_UNIT), scan)
    mesh, notes = facing_outwards(mesh)
    occlusal = find_occlusal_frame(mesh)
    if labels is not None:
        upright = mesh.transformed(occlusal.occlusal_from_mesh)
        numbered = labelling.fdi(path, labels, upright, arch=arch, sure=not occlusal.notes)
        labels, notes = numbered.labels, (*notes, *numbered.notes)
    jaw = Jaw(mesh=mesh, face_labels=labels, arch=arch)
    crown = crown_surface(jaw, occlusal.occlusal_from_mesh)
    return Reference(
        jaw=jaw, scannable=None, crown=crown, hashes=hashes, notes=tuple(f"reference: {note}" for note in notes)
    )


_REFERENCE_UNIT = "--reference-unit"
_SMALLEST_SCAN_MM, _LARGEST_SCAN_MM = 0.3, 300.0
"""Extent of what a simulated handpiece scans, which may be a small part of a tooth."""


def _require_sizes(reference: storage.MeasuredFile, scan: storage.MeasuredFile | None) -> None:
    """Before anything is looked for that takes memory by the size."""
    if scan is not None:
        storage.require_one_unit(scan, reference)
    storage.require_size(reference)


def crown_surface(
    jaw: Jaw, occlusal_from_jaw: Rigid3 = Rigid3.identity(), *, seen: Bool[np.ndarray, "f"] | None = None
) -> OpenCrown | None:
    """The open crown surface of a jaw: of each tooth, or of whatever looks like crown if it has no tooth labels; None
    if there is no such surface.

    ``occlusal_from_jaw``: for a mesh that is not in its occlusal frame. ``seen``: teeth with none of these faces are
    left out, which saves time.
    """
    upright = replace(jaw, mesh=jaw.mesh.transformed(occlusal_from_jaw), landmarks={}, lines={}, spheres={})
    crowns = crowns_of(upright)
    if not crowns.faces.any():
        return None
    parts = pieces(upright.mesh, crowns.faces) if jaw.face_labels is None else jaw.face_labels
    if seen is not None:
        parts = np.where(np.isin(parts, parts[seen]), parts, GUM)
    return OpenCrown(mesh=jaw.mesh, parts=open_parts(upright.mesh, parts), estimated=crowns.estimated)
