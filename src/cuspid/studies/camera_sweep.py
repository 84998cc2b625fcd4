"""The practical study of a pair of cameras (thesis 3.5.1, Fig 3.14): baseline and axis angle for a surface of a tooth.

Each case is a whole scan: the pair moves over the tooth in a human hand, its images are rendered and reconstructed, and
the mesh is evaluated on the faces of the named surface alone. What one pass of the pair does not see is missing.
:mod:`cuspid.studies.camera_pair` is the theory of the same.

Frames: ``pair`` as there: origin midway between the projection centres, +X along the baseline, +Z where the pair looks.
``rig`` as in :mod:`cuspid.simulation.path.scan`: it rides along the arch. The pair is mounted so that in the middle of
the path it looks squarely at the middle of the surface.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float

from cuspid.anatomy.surfaces import SURFACES, named_surfaces, tooth_axes
from cuspid.evaluation.deviation import EvaluationOptions
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DesignOptions
from cuspid.model.camera import Camera
from cuspid.model.jaw import Jaw
from cuspid.model.pairing import PairingOptions
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig
from cuspid.model.room import Room, check_clearance
from cuspid.model.trueness import METRICS
from cuspid.motion.location import MotionOptions
from cuspid.mvs.across import AcrossOptions
from cuspid.mvs.matching import StereoOptions
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import TOOTH, Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.simulation.appearance import Preset
from cuspid.simulation.path.detour import repair_path
from cuspid.simulation.path.overlap import image_overlap
from cuspid.simulation.path.scan import ScanPathOptions, plan_scan_path, steady_poses
from cuspid.studies.camera_pair import Direction, baseline_axis, camera_pair, pose_facing
from cuspid.studies.grid import Case, Outcome, Value, run_grid
from cuspid.studies.trial import Trial, TrialOptions, run_trial

Setting = tuple[float, float]
"""Baseline in mm and axis angle in degrees."""

THESIS: Mapping[str, Setting] = MappingProxyType(
    {"occlusal": (2.5, 0.0), "incisal": (1.5, 0.0), "buccal": (2.5, 0.0), "lingual": (2.5, 0.0), "gingival": (2.5, 0.0)}
)
"""The best settings of the thesis: 3.5.1 for the first two; 3.5.2 finds the same pairs suitable for the others, of
which the one across the arch, here up and down the tooth, is taken."""

_ALONG_THE_ARCH = ("incisal",)
_FRONT_TEETH = ("incisal", "labial")
_NEIGHBOURHOOD_MM = 13.0
"""What lies farther from the middle of the surface is out of every camera's reach."""
_NEAREST_MM = 0.5
"""Depth range of a lens begins here at the least."""
_DRIFT_SIGMAS = 3.0
"""Standard deviations of the hand's drift by which the pair may be moved so that it keeps clear of the jaw."""
_BUDGET_UM = 10.0
"""The error that the theoretical study allows a point."""
_ANY_DISTANCE_MM = 1e3


@dataclass(frozen=True, kw_only=True)
class SweepOptions(Options):
    """The grid, the camera pair and how it moves."""

    surface: str = "occlusal"
    """Named surface of the tooth: occlusal, incisal, buccal, labial, lingual, mesial, distal or gingival (the gum on
    the outer side)."""
    tooth: Annotated[int | None, TOOTH] = None
    """FDI number; default: 41 with incisal and labial, 47 with the others."""
    baseline_mm: Annotated[tuple[float, ...], Range(0.01, 1000)] = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
    """Distances between the projection centres."""
    angle_deg: Annotated[tuple[float, ...], Range(-89, 89)] = (0.0, 3.0, 6.0, 9.0)
    """Angles between the optical axes; positive turns the cameras towards each other."""
    direction: Direction | None = None
    """Direction of the baseline: along the arch, or across it (for a side of a tooth: up and down); default: along with
    incisal and across with the others, as in the thesis."""
    distance_mm: Annotated[float, Range(0.1, 1000)] = 5.0
    """Distance from the middle of the pair to the middle of the surface."""
    depth_of_field_mm: Annotated[float, Range(0.01, 1000)] = 5.0
    """Depth range in focus, half of it before and half behind the distance."""
    image_px: Annotated[int, Range(32, 10_000)] = 512
    """Width and height of an image."""
    field_of_view_deg: Annotated[float, Range(1, 170)] = 62.0
    """Full angle of view across the width."""
    supersampling: Annotated[int, Range(1, 16)] = 1
    """Rays per pixel along each side; more take longer and change little here (docs/sweep.md)."""
    path_mm: Annotated[float, Range(0.1, 1000)] = 5.0
    """Length of the path along the arch."""
    frames: Annotated[int, Range(2, 100_000)] = 6
    """Positions of the pair on the path; consecutive images must overlap by more than 75 %."""
    texture: Preset = "artificial"
    """Surface of the teeth: artificial (the thesis' condition), powder, enamel."""
    pairing: PairingOptions = field(default_factory=lambda: PairingOptions(min_overlap=0.0))
    """When the two cameras are matched at all. By default whatever their overlap at the distance is, because a wide,
    parallel pair overlaps more behind it."""
    across: bool = False
    """Also measure depth from consecutive frames, which reveals less of what the pair itself can do."""
    contenders: Annotated[int, Range(1, 1000)] = 2
    """How many of the best settings by completeness, and as many by accuracy, are repeated, besides that of the
    thesis."""
    repeats: Annotated[int, Range(0, 1000)] = 2
    """Number of repeats, with other textures, hand motions and noise. 0 leaves the noise of the study unknown."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.surface not in SURFACES:
            raise InputError(f"sweep: unknown surface {self.surface!r}; choose one of {', '.join(SURFACES)}")
        if not (self.baseline_mm and self.angle_deg):
            raise InputError("sweep: --baseline-mm and --angle-deg need one or more values")

    @property
    def chosen_tooth(self) -> int:
        """The given or the default tooth."""
        return self.tooth or (41 if self.surface in _FRONT_TEETH else 47)

    @property
    def chosen_direction(self) -> Direction:
        """The given direction, or that of the thesis."""
        return self.direction or ("along" if self.surface in _ALONG_THE_ARCH else "across")

    @property
    def path(self) -> ScanPathOptions:
        """How the hand moves."""
        return ScanPathOptions(tooth=self.chosen_tooth, frames=self.frames, length_mm=self.path_mm)

    @property
    def settings(self) -> tuple[Setting, ...]:
        """All settings of the grid."""
        return tuple(product(self.baseline_mm, self.angle_deg))

    @property
    def thesis(self) -> Setting | None:
        """The thesis' best setting, if it is on the grid and the baseline has the same direction."""
        found = THESIS.get(self.surface)
        return found if self.direction is None and found in self.settings else None


@dataclass(frozen=True, eq=False, kw_only=True)
class Site:
    """Where the pair works; the same for all settings, and small enough to be sent to a worker."""

    jaw: Jaw
    """The surface and what lies around it."""
    faces: Bool[np.ndarray, "f"]
    """Those of the surface."""
    pair_from_rig: Rigid3
    """How the pair is mounted."""
    rig_from_world: Mapping[int, Mapping[str, Rigid3]]
    """For each seed the path: the pose of each frame."""


# --- Where the pair works ---------------------------------------------------------------------------------------------


def find_site(jaw: Jaw, options: SweepOptions) -> Site:
    """The surface on a labelled jaw, the mounting of the pair and the paths over it.

    Raises InputError where the tooth or its surface is not there, the narrowest pair or its lights touch the jaw, or
    the images overlap too little.
    """
    mask = surface_faces(jaw, options.chosen_tooth, options.surface)
    axis = baseline_axis(jaw, options.chosen_tooth, options.surface, options.chosen_direction)
    pair_from_world = pose_facing(jaw.mesh, mask, axis, options.distance_mm)
    middle = steady_poses(jaw, options.path, per_pass=3)[1]
    pair_from_rig = pair_from_world @ middle.inverse()
    narrowest = pair_handpiece(pair_from_rig, (min(options.baseline_mm), options.angle_deg[0]), options)
    steady = steady_poses(jaw, options.path, per_pass=options.path.frames or 10)
    room = Room(jaw.mesh, narrowest.solid, options.path.clearance_mm)
    clear_path(room, {f"{index:05d}": pose for index, pose in enumerate(steady)}, pair_from_rig, options)
    paths = {
        seed: plan_scan_path(jaw, narrowest, options.path, np.random.default_rng([seed, 1])).rig_from_world
        for seed in range(options.repeats + 1)
    }
    target = pair_from_world.inverse().apply(np.array([0.0, 0.0, options.distance_mm]))
    near = np.linalg.norm(jaw.mesh.face_centres - target, axis=1) < max(_NEIGHBOURHOOD_MM, 2.5 * options.distance_mm)
    labels = None if jaw.face_labels is None else jaw.face_labels[near]
    return Site(
        jaw=Jaw(mesh=jaw.mesh.submesh(near), face_labels=labels, arch=jaw.arch),
        faces=mask[near],
        pair_from_rig=pair_from_rig,
        rig_from_world=paths,
    )


def surface_faces(jaw: Jaw, tooth: int, surface: str) -> Bool[np.ndarray, "f"]:
    """Mask of a named surface of a tooth; of the gum what lies beside the tooth on its outer side.

    Raises InputError where the jaw lacks the tooth, or the tooth the surface.
    """
    on_tooth = jaw.tooth_faces(tooth)
    named = named_surfaces(jaw)
    masks = {name: mask & on_tooth for name, mask in named.items()}
    masks["gingival"] = named["gingival"] & _outside_of(jaw, tooth, on_tooth)
    if not masks[surface].any():
        found = ", ".join(name for name, mask in masks.items() if mask.any())
        raise InputError(f"sweep: tooth {tooth} has no {surface} surface; it has {found}")
    return masks[surface]


def _outside_of(jaw: Jaw, tooth: int, faces: Bool[np.ndarray, "f"]) -> Bool[np.ndarray, "f"]:
    """What lies outwards of a tooth, within its width along the arch."""
    distal, outward, _ = tooth_axes(jaw)[tooth]
    along, out = jaw.mesh.face_centres @ distal, jaw.mesh.face_centres @ outward
    middle = (out[faces].min() + out[faces].max()) / 2
    within = (along >= along[faces].min()) & (along <= along[faces].max())
    return within & (out > middle) & (out < out[faces].max() + _NEIGHBOURHOOD_MM)


def clear_path(
    room: Room, rig_from_world: Mapping[str, Rigid3], pair_from_rig: Rigid3, options: SweepOptions
) -> dict[str, Rigid3]:
    """The path of the pair, its frames changed by as little as it needs to keep clear of the jaw, as those of any scan.

    A sweep keeps its distance: raises InputError where a frame would have to move the pair by more than a hand drifts.
    """
    poses = dict(zip(rig_from_world, repair_path(room, list(rig_from_world.values())), strict=True))
    moved = [
        np.linalg.norm((pair_from_rig @ rig_from_world[name]).inverse().translation - after.inverse().translation)
        for name, after in ((name, pair_from_rig @ pose) for name, pose in poses.items())
    ]
    check_clearance(room, poses if max(moved) <= _DRIFT_SIGMAS * options.path.jitter_mm else rig_from_world)
    return poses


def pair_handpiece(pair_from_rig: Rigid3, setting: Setting, options: SweepOptions) -> Handpiece:
    """Two cameras and four LEDs around them. The LEDs do not move with the baseline: the light is the same for all."""
    camera = Camera.from_field_of_view(options.image_px, options.image_px, options.field_of_view_deg)
    pair = camera_pair(*setting, camera).cameras
    rig = Rig({name: MountedCamera(camera, each.cam_from_rig @ pair_from_rig) for name, each in pair.items()})
    near = max(options.distance_mm - options.depth_of_field_mm / 2, _NEAREST_MM)
    far = options.distance_mm + options.depth_of_field_mm / 2
    lights = _lights(pair_from_rig.inverse())
    return Handpiece(
        rig=rig,
        lights=lights,
        lightings=(Lighting(name="all", lights=tuple(lights)),),
        working_distance_mm=options.distance_mm,
        depth_range_mm=(near, far),
        name=f"pair-{setting[0]:g}mm-{setting[1]:g}deg",
    )


def _lights(rig_from_pair: Rigid3) -> dict[str, Light]:
    """As in the essential four: at the corners between its cameras."""
    usual = DesignOptions()
    corners = product((-1, 1), (-usual.baseline_across_mm / 2, usual.baseline_across_mm / 2))
    axis = rig_from_pair.rotate(np.array([0.0, 0.0, 1.0]))
    return {
        f"l{number}": Light(
            position_mm=rig_from_pair.apply(np.array([across, side * usual.baseline_along_mm, 0.0])), direction=axis
        )
        for number, (side, across) in enumerate(corners, start=1)
    }


# --- A case -----------------------------------------------------------------------------------------------------------


def sweep_case(
    *,
    surface: str,
    tooth: int,
    baseline_mm: float,
    angle_deg: float,
    seed: int,
    site: Site,
    options: SweepOptions,
) -> dict[str, float | int]:
    """Scan, reconstruct and evaluate one setting; the figures of the surface, units in the names.

    Raises what the stages raise, InputError where a camera touches the jaw. (``surface`` and ``tooth`` are for the
    table; the site knows them.)
    """
    begin = time.process_time()
    handpiece = pair_handpiece(site.pair_from_rig, (baseline_mm, angle_deg), options)
    room = Room(site.jaw.mesh, handpiece.solid, options.path.clearance_mm)
    poses = clear_path(room, site.rig_from_world[seed], site.pair_from_rig, options)
    overlap = image_overlap(site.jaw.mesh, handpiece, list(poses.values()))
    how = TrialOptions(
        simulation=SimulationOptions(texture=options.texture, supersampling=options.supersampling, seed=seed),
        reconstruction=_reconstruction(options),
        evaluation=EvaluationOptions(margin_mm=_ANY_DISTANCE_MM, samples=50_000),
    )
    with tempfile.TemporaryDirectory(prefix="cuspid-sweep-") as folder:
        trial = run_trial(
            lambda out: pipeline.take_images(site.jaw, handpiece, poses, out, how.simulation),
            Path(folder),
            how,
            evaluated=site.faces,
            start_from_truth=True,
        )
    return {
        "overlap_min_pct": float(100 * np.nanmin(overlap)),
        **_figures(trial, site),
        "cpu_s": time.process_time() - begin,
    }


def _reconstruction(options: SweepOptions) -> ReconstructionOptions:
    stereo = StereoOptions(pairing=options.pairing)
    return ReconstructionOptions(
        stereo=stereo,
        across=AcrossOptions(enabled=options.across),
        tracking=MotionOptions(pairing=options.pairing),
    )


def _figures(trial: Trial, site: Site) -> dict[str, float | int]:
    areas = site.jaw.mesh.face_areas
    return {
        "located_frames": len(trial.reconstruction.frames),
        "seen_pct": float(100 * areas[site.faces & trial.scannable].sum() / areas[site.faces].sum()),
        "points": int(np.isfinite(trial.trueness.deviation_um).sum()),
        **{name: value for name, metric in METRICS.items() if (value := metric.of(trial.trueness)) is not None},
        "complete_10_um_pct": _within_pct(trial, site, _BUDGET_UM),
        "simulation_s": trial.simulation_s,
        "reconstruction_s": trial.reconstruction_s,
    }


def _within_pct(trial: Trial, site: Site, limit_um: float) -> float:
    """Share of the surface that the mesh comes so near to."""
    points, _ = site.jaw.mesh.submesh(site.faces).sample(20_000, np.random.default_rng(0))
    distances, _, _ = trial.mesh.transformed(trial.trueness.reference_from_scan).closest(points)
    return float(100 * np.mean(distances <= limit_um / 1000))


# --- The study --------------------------------------------------------------------------------------------------------


def sweep(
    jaw: Jaw,
    folder: Path,
    options: SweepOptions = SweepOptions(),
    *,
    workers: int | None = None,
    cluster: str | None = None,
    retry_failed: bool = False,
    progress: Progress = silent,
) -> tuple[Outcome, ...]:
    """Run the grid once, then the contenders again with other seeds; what is in the folder already is not run again.

    Raises what :func:`find_site` and :func:`cuspid.studies.grid.run_grid` raise.
    """
    site = find_site(jaw, options)
    run = partial(
        run_grid,
        work=partial(sweep_case, site=site, options=options),
        folder=folder,
        workers=workers,
        cluster=cluster,
        retry_failed=retry_failed,
        stage="scans",
    )
    cases = [_case(options, setting, 0) for setting in options.settings]
    repeated = options.repeats * min(len(cases), 2 * options.contenders + (options.thesis is not None))
    first = run(cases, progress=lambda stage, done, total: progress(stage, done, total + repeated))
    again = [
        _case(options, each, seed) for seed in range(1, options.repeats + 1) for each in contenders(first, options)
    ]
    return run([*cases, *again], progress=progress)


def _case(options: SweepOptions, setting: Setting, seed: int) -> Case:
    baseline_mm, angle_deg = setting
    tooth = options.chosen_tooth
    return Case(
        name=f"{options.surface}-{tooth}_{baseline_mm:g}mm_{angle_deg:g}deg_seed{seed}",
        parameters={
            "surface": options.surface,
            "tooth": tooth,
            "baseline_mm": baseline_mm,
            "angle_deg": angle_deg,
            "seed": seed,
        },
    )


# --- Which setting is best --------------------------------------------------------------------------------------------

Term = Literal["complete_50_um_pct", "complete_10_um_pct", "points", "mean_abs_um"]
TERMS: Mapping[Term, int] = MappingProxyType(
    {"complete_50_um_pct": 1, "complete_10_um_pct": 1, "points": 1, "mean_abs_um": -1}
)
"""What a setting is evaluated by, and whether more of it (1) or less (-1) is better."""
_SURE = 2.0
"""A difference of so many standard errors counts (95 % for one comparison of two settings)."""


@dataclass(frozen=True, kw_only=True)
class Best:
    """The best setting by one term."""

    term: Term
    """By what."""
    setting: Setting
    """Baseline and angle."""
    value: float
    """Of the term, mean over the seeds."""
    seeds: int
    """How many there were."""
    noise: float | None
    """Standard deviation of one case beside others of the same seed; None where nothing was repeated."""
    level: tuple[Setting, ...]
    """Other settings that are not worse beyond the noise; empty where that is unknown."""


def values_of(outcomes: Sequence[Outcome], column: str) -> dict[Setting, dict[int, float]]:
    """A figure of the cases that did not fail, by setting and seed."""
    found: dict[Setting, dict[int, float]] = {}
    for outcome in outcomes:
        if outcome.failure is None:
            given = outcome.case.parameters
            setting = (_number(given["baseline_mm"]), _number(given["angle_deg"]))
            found.setdefault(setting, {})[int(_number(given["seed"]))] = _number(outcome.figures[column])
    return found


def _number(value: Value) -> float:
    if value is None:
        raise InputError("sweep: a value is missing from the results; delete the folder")
    return float(value)


def contenders(outcomes: Sequence[Outcome], options: SweepOptions) -> tuple[Setting, ...]:
    """The settings that are best by completeness and by accuracy, and the thesis', where they did not fail."""
    chosen: dict[Setting, None] = {}
    terms: tuple[Term, ...] = ("complete_50_um_pct", "mean_abs_um")
    for term in terms:
        values = values_of(outcomes, term)
        ranked = sorted(values, key=lambda setting: -TERMS[term] * values[setting][0])
        chosen |= dict.fromkeys(ranked[: options.contenders])
    if options.thesis in values_of(outcomes, terms[0]):
        chosen[options.thesis] = None
    return tuple(chosen)


def best_setting(outcomes: Sequence[Outcome], term: Term) -> Best | None:
    """The best by the mean over the seeds, among those that were run most often; None where all failed."""
    values = values_of(outcomes, term)
    if not values:
        return None
    most = max(map(len, values.values()))
    often = {setting: found for setting, found in values.items() if len(found) == most}
    best = max(often, key=lambda setting: TERMS[term] * np.mean(list(often[setting].values())))
    noise = _noise(np.array([[found[seed] for seed in sorted(found)] for found in often.values()]))
    return Best(
        term=term,
        setting=best,
        value=float(np.mean(list(values[best].values()))),
        seeds=most,
        noise=noise,
        level=() if noise is None else _level(values, best, TERMS[term], noise),
    )


def _noise(values: Float[np.ndarray, "k n"]) -> float | None:
    """Standard deviation of what neither the setting (row) nor the seed (column) explains."""
    freedom = (values.shape[0] - 1) * (values.shape[1] - 1)
    if freedom < 1:
        return None
    rows, columns = values.mean(axis=1, keepdims=True), values.mean(axis=0, keepdims=True)
    return float(np.sqrt(np.sum((values - rows - columns + values.mean()) ** 2) / freedom))


def _level(
    values: Mapping[Setting, Mapping[int, float]], best: Setting, sign: int, noise: float
) -> tuple[Setting, ...]:
    """Those whose mean over the seeds that they share with the best one is not surely worse."""

    def behind(setting: Setting) -> float:
        common = sorted(set(values[setting]) & set(values[best]))
        lead = sign * np.mean([values[best][seed] - values[setting][seed] for seed in common])
        return float(lead / max(noise * np.sqrt(2 / len(common)), 1e-12))

    return tuple(setting for setting in values if setting != best and behind(setting) < _SURE)
