"""What a handpiece will meet and see on its path, before anything is rendered."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cuspid.anatomy.mouth import MouthOptions, room_mm, study_mouths
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.surfaces import named_surfaces
from cuspid.handpiece.brief import DesignBrief
from cuspid.handpiece.optimise import Design, SearchOptions, Section, optimise_handpiece
from cuspid.handpiece.precision import NoiseModel, PrecisionMap, best_of_positions, precision_map
from cuspid.model.jaw import Jaw
from cuspid.model.rig import Handpiece
from cuspid.model.visibility import Visibility, VisibilityOptions, survey_visibility
from cuspid.runtime.progress import Progress, silent
from cuspid.simulation.path.scan import ScanPathOptions, plan_scan_path, steady_poses


def design(
    brief: DesignBrief,
    jaw: Jaw | None = None,
    options: SearchOptions = SearchOptions(),
    *,
    teeth: Sequence[int] = (46, 41),
    mouth: MouthOptions = MouthOptions(),
    progress: Progress = silent,
) -> Design:
    """Search for a handpiece that meets a brief: it has room in the mouths of the asked share of people, and sees the
    named surfaces of some teeth (FDI) of a labelled jaw, by default of the built-in phantom.

    The best one that was found comes back even if it does not meet all (:meth:`Design.check`). Raises InputError where
    the mouth has no room for any, or the jaw does not have the teeth.
    """
    gap_mm = room_for(brief, mouth)
    brief.check_gap(gap_mm)
    sections = sections_of(build_phantom() if jaw is None else jaw, teeth, brief)
    return optimise_handpiece(brief, sections, gap_mm, options, progress=progress)


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
        return Section.cut(jaw.mesh, jaw.tooth_faces(fdi), surfaces, steady_poses(jaw, passes, per_pass=5))

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
    return best_of_positions([precision_map(jaw.mesh, handpiece, pose, noise, visibility=visibility) for pose in poses])
