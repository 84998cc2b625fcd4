"""What a handpiece records of a jaw, in simulation: images on disk, and what only the simulator knows beside them."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import UInt8

from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, ImageFolder
from cuspid.model.jaw import Jaw
from cuspid.model.rig import Handpiece
from cuspid.model.tolerances import EXACT
from cuspid.model.trueness import GroundTruth
from cuspid.runtime.options import SEED, Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import usable_cores
from cuspid.simulation.appearance import APPEARANCES, Preset
from cuspid.simulation.blender import check_blender, render_with_blender
from cuspid.simulation.lights import with_default_lights
from cuspid.simulation.manufacturing import ManufacturingOptions, sample_built, with_tolerances
from cuspid.simulation.optics import OpticsOptions, with_shutters
from cuspid.simulation.path.scan import ScanPath, ScanPathOptions, plan_scan_path
from cuspid.simulation.raycast import Scene, lit_frames, render_capture
from cuspid.storage.captures import write_capture, write_image
from cuspid.storage.files import digest_of, hash_file
from cuspid.storage.handpieces import read_handpiece
from cuspid.storage.stages import Stage
from cuspid.storage.truths import write_path, write_truth

_LOG = logging.getLogger("cuspid")


@dataclass(frozen=True, kw_only=True)
class RenderOptions(Options):
    """What the images of a simulation look like."""

    texture: Preset = "artificial"
    """Surface: artificial (strong matte texture, the thesis' condition), powder (weak speckle), enamel (plain, wet),
    natural (the same, with stained fissures, fillings, vessels and stippled gum)."""
    renderer: Literal["embree", "blender"] = "embree"
    """embree: ray casting (default). blender: Blender Cycles with subsurface scattering (needs its own environment)."""
    supersampling: Annotated[int, Range(1, 16)] = 2
    """Rays per pixel along each side."""
    seed: Annotated[int, SEED] = 0
    """Seed of texture, hand jitter and sensor noise."""
    optics: OpticsOptions = field(default_factory=OpticsOptions)
    """What lenses, sensors, hands and the mouth do to the images."""


@dataclass(frozen=True, kw_only=True)
class SimulationOptions(RenderOptions):
    """How a jaw is scanned in simulation."""

    path: ScanPathOptions = field(default_factory=ScanPathOptions)
    """How the handpiece moves."""
    manufacturing: ManufacturingOptions = field(default_factory=ManufacturingOptions)
    """How the handpiece that takes the images differs from the one that the reconstruction is given."""


def simulate(
    jaw: Jaw,
    handpiece: Handpiece,
    folder: Path | str,
    options: SimulationOptions = SimulationOptions(),
    *,
    progress: Progress = silent,
) -> tuple[Capture, GroundTruth]:
    """Scan a jaw: images to ``folder/capture``, what only the simulator knows to ``folder/truth``.

    A handpiece without lights is given one beside each camera (:mod:`cuspid.simulation.lights`). If it is not built as
    it was drawn, the capture has the drawn one with its tolerances, and the truth the built one. Existing images are
    kept; a run that is resumed gives the same bits as one that was not interrupted.
    """
    folder = Path(folder)
    handpiece = with_shutters(with_default_lights(handpiece), options.optics)
    true, known = sample_built(handpiece, options.manufacturing), with_tolerances(handpiece, options.manufacturing)
    _check(true, options)
    path = plan_scan_path(jaw, handpiece, options.path, np.random.default_rng([options.seed, 1]))
    write_path(folder / "truth" / "path.json", path.min_overlap, path.mean_overlap, path.seen, path.cross_sweep)
    return take_images(
        jaw,
        true,
        path.rig_from_world,
        folder,
        options,
        known=known,
        less=_cheaper_settings(path),
        progress=progress,
    )


def take_images(
    jaw: Jaw,
    handpiece: Handpiece,
    rig_from_world: Mapping[str, Rigid3],
    folder: Path,
    options: RenderOptions,
    *,
    known: Handpiece | None = None,
    less: Sequence[str] = (),
    progress: Progress = silent,
) -> tuple[Capture, GroundTruth]:
    """As :func:`simulate`, from given poses of the handpiece by frame name. The capture has the handpiece ``known``; by
    default the true one, as exact. ``less``: settings that take less time, suggested where it takes long."""
    if options.optics.scattering and not any(APPEARANCES[options.texture].enamel.scattering_mm):
        _LOG.info(f"optics: --scattering changes nothing, for light does not go below the texture {options.texture}")
    handpiece = with_shutters(with_default_lights(handpiece), options.optics)
    _check(handpiece, options)
    frames, poses = lit_frames(handpiece, rig_from_world)
    truth = GroundTruth(jaw=jaw, handpiece=handpiece, rig_from_world=poses)
    write_truth(folder / "truth", truth)
    capture = Capture(handpiece=known or EXACT.fill(handpiece), frames=frames, source=ImageFolder(folder / "capture"))
    write_capture(folder / "capture", capture)
    for done, total in _log_expected_time(_render(folder, capture, truth, options), less):
        progress("images", done, total)
    # As it will be read: a rotation may differ in its last bit once it was written, and results go by that.
    return replace(capture, handpiece=read_handpiece(folder / "capture" / "handpiece.json")), truth


def _check(handpiece: Handpiece, options: RenderOptions) -> None:
    """Refuse what cannot be rendered before anything is written."""
    if options.renderer == "blender":
        check_blender(handpiece, APPEARANCES[options.texture], options.optics.resolved)


def _render(folder: Path, capture: Capture, truth: GroundTruth, options: RenderOptions) -> Iterator[tuple[int, int]]:
    """Render what is not there yet; yields how many images are there, and how many there will be."""
    images = ImageFolder(folder / "capture")
    stage = Stage("images", folder / "truth", look_of(options), _CODE)
    # The gain is metered over the whole path, so each image depends on all of the truth.
    key = stage.key({**jaw_files(folder / "truth"), "poses": digest_of(dict(truth.rig_from_world))})
    there = {
        (frame.name, camera): stage.has(key, [images.path(frame.name, camera)])
        for frame in capture.frames
        for camera in frame.cameras
    }
    rendered = _RENDERERS[options.renderer](
        scene_of(truth, options),
        capture.frames,
        truth.rig_from_world,
        _Sink(images),
        skip=lambda frame, camera: there[frame, camera],
        processes=usable_cores(),
    )
    for done, image in enumerate(rendered, start=sum(there.values()) + 1):
        stage.record(key, [images.path(*image)])
        yield done, len(there)


@dataclass(frozen=True)
class _Sink:
    images: ImageFolder

    def __call__(self, frame: str, camera: str, image: UInt8[np.ndarray, "h w 3"]) -> None:
        write_image(self.images.path(frame, camera), image)


def _cheaper_settings(path: ScanPath) -> tuple[str, ...]:
    share = 1 - path.further_frames / len(path.rig_from_world)
    passes = f"--passes turns takes about {share:.0%} of the images"
    return (passes, _FEWER_PIXELS) if path.further_frames else (_FEWER_PIXELS,)


def _log_expected_time(rendered: Iterator[tuple[int, int]], less: Sequence[str]) -> Iterator[tuple[int, int]]:
    """What is rendered; after the first images it is logged how many are to come, how long they take here, and, if that
    is long, what takes less."""
    warm = usable_cores()  # the first image of each process is not timed
    begin = time.perf_counter()
    for number, (done, total) in enumerate(rendered, start=1):
        if number == warm:
            begin = time.perf_counter()
        elif number == (1 + _TIMED) * warm and total > done:
            seconds = (total - done) * (time.perf_counter() - begin) / (number - warm)
            duration = f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"
            shorter = f"; for less: {', '.join(less)}" if less and seconds > _LONG_S else ""
            _LOG.info(f"simulation: {total - done:,} of {total:,} images are to come, about {duration} here{shorter}")
        yield done, total


_FEWER_PIXELS = "half the --scale takes a quarter of the pixels"
_TIMED = 3
"""Images of each process that are timed for the forecast."""
_LONG_S = 60.0
"""Nobody minds waiting so long."""
_CODE = (__name__, "cuspid.simulation.blender_script")
"""What images are made by: their key has what this code does. Blender runs the script."""
_RENDERERS = {"embree": render_capture, "blender": render_with_blender}


def look_of(options: RenderOptions) -> dict[str, object]:
    """The options, besides the path, that the images depend on."""
    return {each.name: getattr(options, each.name) for each in fields(RenderOptions)}


def jaw_files(truth: Path) -> dict[str, str]:
    """SHA-256 of the files of the truth that images are made from, besides the poses."""
    return {name: hash_file(truth / name) for name in ("jaw.ply", "jaw.json", "handpiece.json")}


def scene_of(truth: GroundTruth, options: RenderOptions) -> Scene:
    """What is rendered."""
    return Scene(
        jaw=truth.jaw,
        handpiece=truth.handpiece,
        appearance=APPEARANCES[options.texture].at_footprint(truth.handpiece.footprint_mm),
        supersampling=options.supersampling,
        seed=options.seed,
        optics=options.optics.resolved,
    )
