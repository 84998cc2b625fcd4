"""A film of a jaw: what a camera records that a shaky hand moves freely over the arch, in simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from cuspid.model.capture import Capture
from cuspid.model.jaw import Jaw
from cuspid.model.rig import Handpiece
from cuspid.model.trueness import GroundTruth
from cuspid.runtime.progress import Progress, silent
from cuspid.simulation.appearance import Preset
from cuspid.simulation.lights import with_default_lights
from cuspid.simulation.path.free import FreePathOptions, plan_free_path
from cuspid.simulation.reference_render import ReferenceRenderOptions, render_reference
from cuspid.simulation.stage import RenderOptions, jaw_files, look_of, scene_of, take_images
from cuspid.storage.reference_renders import REFERENCE_RENDER_FILES, write_reference_render
from cuspid.storage.stages import Stage


@dataclass(frozen=True, kw_only=True)
class FilmOptions(RenderOptions):
    """How a jaw is filmed by hand in simulation."""

    texture: Preset = "enamel"
    """Surface: artificial (strong matte texture, the thesis' condition), powder (weak speckle), enamel (plain, wet),
    natural (the same, with stained fissures, fillings, vessels and stippled gum)."""
    path: FreePathOptions = field(default_factory=FreePathOptions)
    """How the hand moves the camera."""


REFERENCE_RENDERS: Mapping[str, float | None] = MappingProxyType({"occlusal": None, "shot": 300.0})
"""Camera height in mm of each picture of the true jaw; None for an orthographic view."""


def film(
    jaw: Jaw, handpiece: Handpiece, folder: Path, options: FilmOptions, *, progress: Progress = silent
) -> tuple[Capture, GroundTruth]:
    """As :func:`cuspid.simulation.stage.simulate`, with a camera that a shaky hand moves freely over the arch.

    Also writes reference renders of the arch from above: ``truth/occlusal``, orthographic, and ``truth/shot``, from far
    above.
    """
    handpiece = with_default_lights(handpiece)
    poses = plan_free_path(jaw, handpiece, options.path, np.random.default_rng([options.seed, 1]))
    capture, truth = take_images(jaw, handpiece, poses, folder, options, progress=progress)
    for done, (name, height_mm) in enumerate(REFERENCE_RENDERS.items(), start=1):
        _render_reference(truth, folder / "truth", name, ReferenceRenderOptions(camera_height_mm=height_mm), options)
        progress("reference renders", done, len(REFERENCE_RENDERS))
    return capture, truth


def _render_reference(
    truth: GroundTruth, folder: Path, name: str, view: ReferenceRenderOptions, options: FilmOptions
) -> None:
    stage = Stage("reference render", folder, [view, look_of(options)], (__name__,))
    scene = scene_of(truth, replace(options, supersampling=max(2, options.supersampling)))
    files = [folder / name / file for file in REFERENCE_RENDER_FILES]
    stage.make(jaw_files(folder), files, lambda: write_reference_render(folder / name, render_reference(scene, view)))
