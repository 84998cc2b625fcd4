"""The whole pipeline of a panorama.

capture, truth       = film(jaw, camera, folder, ...)               frames, and what only the simulator knows
panorama             = stitch(frames, ...)                          from the frames alone
panorama             = stitch_rig(capture, ...)                     from two or more cameras, in true millimetres
views                = view_mesh(mesh, ...)                         the same views of a finished mesh
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from cuspid.anatomy.orientation import find_occlusal_frame
from cuspid.geometry import Rigid3
from cuspid.model.arch_curve import arch_curve
from cuspid.model.capture import Capture
from cuspid.model.image_sequence import ImageSequence
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.pairing import stereo_pairs
from cuspid.model.panorama import FrameUse
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.sparse_model import SparseModel
from cuspid.model.tolerances import NominalOptions
from cuspid.model.unrolling import unroll_capture
from cuspid.motion.frontend.patches import PatchOptions
from cuspid.motion.location import MotionOptions
from cuspid.motion.monocular.single import (
    SingleMotion,
    SingleOptions,
    count_observations,
    locate_single,
    refine_on_surface,
    weak_stretch_notes,
)
from cuspid.motion.rig_film import (
    film_options,
    locate_rig_film,
    refine_rig_on_surface,
    surface_patches,
    trajectory_of_camera,
)
from cuspid.runtime.errors import InputError, ReconstructionError
from cuspid.runtime.image_files import as_8_bits, common_brightening
from cuspid.runtime.plugins import load_plugin
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import computed_once
from cuspid.simulation.film import FilmOptions, film
from cuspid.stitching.compared import cameras_beside
from cuspid.stitching.height_map import ScaleOptions
from cuspid.stitching.mesh_views import MeshViewOptions, MeshViews, draw_mesh
from cuspid.stitching.ortho import (
    OrthoOptions,
    Shown,
    Stitched,
    find_surface,
    find_surface_again,
    into_occlusal_frame,
    orthophoto,
)

__all__ = [
    "FilmOptions",
    "MeshViewOptions",
    "StitchOptions",
    "film",
    "require_content",
    "stitch",
    "stitch_rig",
    "view_mesh",
]


_NOT_ON_SURFACE = "motion: the path is less accurate, for too few points are found again on the surface"

_LEAST_COVERED = 0.01
"""Share of a picture that shows something, at least; a narrow arch fills a tenth of it."""
_METERED = 40
"""Images of a film whose brightness is looked at."""
_ENOUGH_SHARED = 50
"""Points that frames which overlap by half share many times over."""
_SLIDING_PCT = 0.06
"""What the scale of a film of bare teeth is off by beside what its points tell, because light that goes along with the
camera makes them slide (root mean square of nine simulated films, docs/panorama-evaluation.md)."""


@dataclass(frozen=True, kw_only=True)
class StitchOptions(OrthoOptions):
    """How the frames of one hand-held camera become a panorama."""

    method: Literal["ortho", "thesis"] = "ortho"
    """ortho: frames located by structure from motion and rectified on the surface. thesis: chapter 4 of the thesis, a
    baseline of the distribution cuspid-thesis. PATENT NOTICE: it appears to be claimed by US 11,044,400; check the law
    where you are before you use it. cuspid itself does not contain it."""
    motion: SingleOptions = field(default_factory=SingleOptions)
    """How the trajectory of the camera is found (method ortho)."""
    examination: bool = True
    """Leave out frames that fail the examination of the thesis (method thesis)."""
    rig: MotionOptions = field(default_factory=film_options)
    """How the trajectory of a handpiece of two or more cameras is found (method ortho)."""
    rig_patches: PatchOptions = field(default_factory=surface_patches)
    """How its points are followed over the dense surface."""


def stitch(
    frames: ImageSequence | Capture, options: StitchOptions = StitchOptions(), *, progress: Progress = silent
) -> tuple[Stitched, ...]:
    """The panorama of an arch: from the frames of one camera, in several parts where the sequence broke, largest first;
    or from a capture, as :func:`stitch_rig`.

    Raises ReconstructionError, naming the frames, where nothing can be placed, or nothing of it can be shown.
    """
    if isinstance(frames, Capture):
        return (stitch_rig(frames, options, progress=progress),)
    if options.method == "thesis":
        method = load_plugin("cuspid.stitching", "thesis", requested="--method thesis", distribution="cuspid-thesis")
        panoramas = method(frames, examination=options.examination, progress=progress)
        return require_content(Stitched(panorama=panorama, motion=None, strip=None) for panorama in panoramas)
    motion = locate_single(frames, options.motion, progress=progress)
    brighter = common_brightening(map(frames.fine_image, range(len(frames))[_metering_slice(len(frames))]))
    notes = (*frames.notes, *motion.notes, *_brightness_notes(brighter))
    stitched = [_stitch_part(frames, motion, k, brighter, options, progress) for k in range(len(motion.parts))]
    return require_content(
        replace(
            part,
            panorama=replace(part.panorama, part=number, parts=len(stitched), notes=(*notes, *part.panorama.notes)),
        )
        for number, part in enumerate(stitched, start=1)
    )


def require_content(parts: Iterable[Stitched]) -> tuple[Stitched, ...]:
    """The parts of a panorama. Raises ReconstructionError where the pictures of all of them are as good as empty."""
    made = tuple(parts)
    if any(part.panorama.covered.mean() > _LEAST_COVERED for part in made):
        return made
    shared = [_median_shared_points(part.motion) for part in made if part.motion is not None]
    found = f", as neighbours share only {max(shared):.0f} points" if shared and max(shared) < _ENOUGH_SHARED else ""
    placed = sum(frame.used for part in made for frame in part.panorama.frames)
    raise ReconstructionError(
        f"stitch: the {placed} frames that were placed give no picture{found}; take them so that each overlaps the one "
        "before by at least half"
    )


def _median_shared_points(motion: SparseModel) -> float:
    """How many points a frame has in common with the one before (median)."""
    tracks = motion.tracks
    seen = [set(tracks.point_index[tracks.frame_index == number].tolist()) for number in range(len(motion.frames))]
    return float(np.median([len(before & after) for before, after in pairwise(seen)] or [0]))


def _metering_slice(images: int) -> slice:
    """Those of a film whose brightness is looked at."""
    return slice(None, None, max(1, images // _METERED))


def _brightness_notes(brighter: float) -> Iterator[str]:
    if brighter > 1:
        yield f"the images are dark, and have more than 8 bits: they are shown {brighter:.1f} times brighter"


def _stitch_part(
    sequence: ImageSequence,
    motion: SingleMotion,
    number: int,
    brighter: float,
    options: StitchOptions,
    progress: Progress,
) -> Stitched:
    """The panorama of a part of the motion, whose path is made more precise on the surface that it shows, from images
    that are so many times brighter."""
    index = {name: each for each, name in enumerate(sequence.names)}
    located, notes = motion.parts[number], tuple[str, ...]()

    def read(name: str) -> UInt8[np.ndarray, "h w 3"]:
        return as_8_bits(sequence.fine_image(index[name]), brighter)

    shown = find_surface(located, read, options, working_distance_mm=sequence.working_distance_mm, progress=progress)
    if options.motion.on_surface and shown.dense is not None:
        refined = refine_on_surface(shown.motion, shown.dense.mesh(), sequence, options.motion, progress=progress)
        if refined is None:
            notes = (_NOT_ON_SURFACE,)
        else:
            shown = find_surface_again(shown, refined, read, options, progress=progress)
    made = orthophoto(
        shown, count_observations(motion.frames_of(number), shown.motion), read, options, progress=progress
    )
    loose = weak_stretch_notes(made.panorama.frames)
    return replace(made, panorama=replace(made.panorama, notes=(*notes, *made.panorama.notes, *loose)))


def stitch_rig(capture: Capture, options: StitchOptions = StitchOptions(), *, progress: Progress = silent) -> Stitched:
    """The panorama of an arch from the images of a handpiece of two or more cameras, in true millimetres: the picture
    is that of its camera which looks down most, the path and the surface are of all.

    Raises InputError where no two cameras see the same surface or a scale is asked for, and ReconstructionError where
    too few frames can be placed.
    """
    if options.method != "ortho":
        raise InputError("stitch: --method thesis takes the images of one camera; give the folder of one camera")
    if options.scale != ScaleOptions():
        raise InputError("stitch: the cameras of the handpiece set the scale; leave out --scale")
    capture = replace(capture, handpiece=NominalOptions().for_handpiece(capture.handpiece).fill(capture.handpiece))
    found = locate_rig_film(capture, options.rig, options.motion, progress=progress)
    scene = _RigScene(unroll_capture(capture, found), found, options)
    shown, notes = scene.surface(progress), tuple[str, ...]()
    if options.motion.on_surface and shown.dense is not None:
        refined = scene.on_surface(shown, progress)
        if refined is None:
            notes = (_NOT_ON_SURFACE,)
        else:
            scene = replace(scene, found=refined)
            shown = scene.surface(progress, before=shown)
    uses = _uses(capture, scene.found, scene.camera)
    made = orthophoto(shown, uses, scene.read, options, progress=progress)
    noted = (*_scale_notes(scene.found, scene.camera), *scene.found.notes, *_brightness_notes(scene.brighter), *notes)
    return require_content([replace(made, panorama=replace(made.panorama, notes=noted))])[0]


@dataclass(frozen=True, eq=False)
class _RigScene:
    """The frames of a handpiece, located."""

    capture: Capture
    found: Reconstruction
    options: StitchOptions

    @computed_once
    def camera(self) -> str:
        """That whose picture it is."""
        return _facing_down(self.found)

    @computed_once
    def path(self) -> SparseModel:
        """The trajectory of that camera."""
        has = {frame.name for frame in self.capture.frames if self.camera in frame.cameras}
        return trajectory_of_camera(self.found, self.camera, has)

    @computed_once
    def brighter(self) -> float:
        """How many times brighter the images are shown and compared."""
        taken = [(frame.name, camera) for frame in self.capture.frames for camera in frame.cameras]
        return common_brightening(self.capture.source.read(*image) for image in taken[_metering_slice(len(taken))])

    def read(self, name: str) -> UInt8[np.ndarray, "h w 3"]:
        """The image ``camera/frame``, or that of a frame and the camera whose picture it is."""
        one, _, frame = name.rpartition("/")
        return as_8_bits(self.capture.source.read(frame, one or self.camera), self.brighter)

    def surface(self, progress: Progress, before: Shown | None = None) -> Shown:
        """What cameras of one instant agree on; near what they showed ``before``."""
        handpiece = self.capture.handpiece
        pairs = stereo_pairs(self.found.rig, handpiece.working_distance_mm, self.options.rig.pairing)
        beside = cameras_beside(self.found, self.capture.frames, pairs, handpiece)
        if before is None:
            return find_surface(self.path, self.read, self.options, beside=beside, progress=progress)
        return find_surface_again(before, self.path, self.read, self.options, beside=beside, progress=progress)

    def on_surface(self, shown: Shown, progress: Progress) -> Reconstruction | None:
        """The poses, refined on the surface that the frames show; None where that does not hold them."""
        assert shown.dense is not None
        surface = shown.dense.mesh().transformed(into_occlusal_frame(self.path, shown.motion).inverse())
        options = self.options
        return refine_rig_on_surface(
            self.found, surface, self.capture, options.rig, options.motion, options.rig_patches, progress=progress
        )


def _facing_down(found: Reconstruction) -> str:
    """The camera that looks along the mean of the optical axes, as far as a tenth of a right angle tells; of several,
    the first."""
    axes = {name: mounted.axis_in_rig for name, mounted in found.rig.cameras.items()}
    down = np.mean(list(axes.values()), axis=0)
    along = {name: float(axis @ down / np.linalg.norm(down)) for name, axis in axes.items()}
    return next(name for name in axes if np.arccos(min(along[name], 1)) < np.arccos(min(max(along.values()), 1)) + 0.16)


def _uses(capture: Capture, found: Reconstruction, camera: str) -> tuple[FrameUse, ...]:
    """What became of the frames in the picture of a camera."""
    reasons = {each.what.removeprefix("frame "): each.reason for each in found.dropped}
    observations = {
        frame.name: None
        if camera in frame.cameras and frame.name in found.rig_from_world
        else reasons.get(frame.name, f"no image of camera {camera}")
        for frame in capture.frames
    }
    return tuple(FrameUse(name=name, used=reason is None, reason=reason) for name, reason in observations.items())


def _scale_notes(found: Reconstruction, camera: str) -> Iterator[str]:
    """Where the scale and the picture are from."""
    expected = found.expectation
    sigma_pct = None if expected is None else float(np.hypot(expected.scale_sigma_ppm / 1e4, _SLIDING_PCT))
    known = "" if sigma_pct is None else f", known to within {sigma_pct:.2g} % (one sigma)"
    yield f"the scale is that of the handpiece{known}; the picture is that of camera {camera}"


def view_mesh(mesh: Mesh, options: MeshViewOptions, *, progress: Progress = silent) -> tuple[MeshViews, Rigid3]:
    """The occlusal view of a mesh and its strips along the arch, and the motion that takes it into its occlusal frame,
    which is found from its shape.

    Where no crowns are found there are no strips, and a note says so.
    """
    found = find_occlusal_frame(mesh)
    upright = mesh.transformed(found.occlusal_from_mesh)
    try:
        curve, notes = arch_curve(Jaw(mesh=upright)).points, found.notes
    except InputError as error:
        curve, notes = None, (*found.notes, f"no strips: {error}")
    views = draw_mesh(upright, curve, options, progress=progress)
    return replace(views, panorama=replace(views.panorama, notes=notes)), found.occlusal_from_mesh
