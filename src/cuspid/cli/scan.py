"""Scan, reconstruct and evaluate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from cuspid import storage
from cuspid.cli.photographs import reconstruct_photographs
from cuspid.cli.report import report
from cuspid.cli.shared import (
    Flat,
    Probe,
    Source,
    console,
    load_probe,
    load_source,
    print_expected,
    show_progress,
    suit_lights,
)
from cuspid.evaluation.deviation import EvaluationOptions
from cuspid.evaluation.margin import MarginError, cut_margins, margin_error
from cuspid.evaluation.spheres import SphereReport, evaluate_spheres
from cuspid.evaluation.trajectory import trajectory_error
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.facing import facing_outwards
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Handpiece
from cuspid.model.tolerances import NominalOptions, is_nominal
from cuspid.model.trueness import METRICS, STATISTICS, DeviationStatistics, Trueness
from cuspid.motion.colmap import hash_model
from cuspid.motion.icp.surface_tracking import glare_notes
from cuspid.motion.monocular.photographs import PhotographOptions
from cuspid.motion.monocular.scale import PhotoScaleOptions
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.report.figures.drawing import deviation_colors, save_deviation_picture, save_expected_picture
from cuspid.report.figures.margin import save_margin_picture
from cuspid.report.figures.sphere import save_sphere_picture
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Range


def run(
    jaw: Annotated[Path | None, Positional, arg(metavar="[JAW]")] = None,
    *,
    out: Path,
    source: Annotated[Source, Flat] = Source(),
    probe: Annotated[Probe, Flat] = Probe(),
    simulation: Annotated[SimulationOptions, Flat, OmitArgPrefixes] = SimulationOptions(),
    reconstruction: Annotated[ReconstructionOptions, Flat] = ReconstructionOptions(),
    evaluation: EvaluationOptions = EvaluationOptions(),
) -> None:
    """Scan a jaw in simulation, reconstruct it, and measure the trueness.

    Args:
        jaw: Mesh of a jaw or of a part of one (STL, PLY, OBJ, OFF); default: the built-in phantom.
        out: Folder for everything that is made. A killed run resumes when the same command is given again.
        evaluation: How the trueness is measured.
    """
    _simulate(jaw, out, source, probe, simulation)
    reconstruct_capture(storage.read_capture(out / "capture"), out, reconstruction)
    _evaluate(out / "mesh.ply", out / "truth", out, Source(), evaluation)


def simulate(
    jaw: Annotated[Path | None, Positional, arg(metavar="[JAW]")] = None,
    *,
    out: Path,
    source: Annotated[Source, Flat] = Source(),
    probe: Annotated[Probe, Flat] = Probe(),
    simulation: Annotated[SimulationOptions, Flat, OmitArgPrefixes] = SimulationOptions(),
) -> None:
    """Render what the handpiece sees: OUT/capture (images, calibration) and OUT/truth (what only the simulator knows).

    Args:
        jaw: Mesh of a jaw or of a part of one (STL, PLY, OBJ, OFF); default: the built-in phantom.
        out: Output folder.
    """
    _simulate(jaw, out, source, probe, simulation)


def reconstruct(
    capture: Annotated[Path, Positional],
    *,
    out: Path,
    handpiece: Path | None = None,
    working_distance_mm: Annotated[float | None, Range(0.1, 100_000)] = None,
    from_poses: Path | None = None,
    scale: Annotated[PhotoScaleOptions, Flat] = PhotoScaleOptions(),
    photographs: PhotographOptions = PhotographOptions(),
    reconstruction: Annotated[ReconstructionOptions, Flat] = ReconstructionOptions(),
) -> None:
    """Reconstruct poses and a mesh: in millimetres from images and a handpiece file, or from photographs of one camera,
    scaled by a board or a measured distance.

    Args:
        capture: Folder with images/<camera>/<frame>.png of a handpiece, folder of photographs, or video of one camera.
        out: Folder for depth/, motion/, mesh.ply and mesh.stl.
        handpiece: Calibration (default: handpiece.json in the capture folder; photographs do not need one).
        working_distance_mm: Distance from the cameras to the teeth, for a rig_config.json, which does not contain it
            (guessed unless given).
        from_poses: Folder of a COLMAP model whose poses are used instead of finding them.
    """
    if storage.is_photographs(capture, handpiece):
        reconstruct_photographs(capture, out, handpiece, reconstruction, photographs, scale, from_poses)
        return
    if scale != PhotoScaleOptions():
        raise InputError("--square-mm and --distance are for photographs of one camera; a handpiece sets the scale")
    reconstruct_capture(storage.read_capture(capture, handpiece, working_distance_mm), out, reconstruction, from_poses)


def evaluate(
    mesh: Annotated[Path, Positional],
    reference: Annotated[Path, Positional],
    *,
    out: Path,
    source: Annotated[Source, Flat] = Source(),
    reference_unit: storage.Unit | None = None,
    options: Annotated[EvaluationOptions, Flat] = EvaluationOptions(),
) -> None:
    """Measure the trueness of a mesh against a reference: trueness.json, and the colour map as PLY and PNG.

    Args:
        mesh: The scan (STL, PLY, OBJ, OFF), in any pose, in --unit.
        reference: A mesh, or the folder truth/ of a simulation, which also records what could be seen.
        out: Folder for the results.
        reference_unit: Length unit of the reference, if it is another one than that of the scan.
    """
    _evaluate(mesh, reference, out, source, options, reference_unit)


def _simulate(mesh: Path | None, out: Path, source: Source, probe: Probe, options: SimulationOptions) -> None:
    probe = suit_lights(probe, options.texture)
    settings = {"source": source, "probe": probe, "simulation": options}
    given = {"jaw": mesh, "handpiece": probe.handpiece}
    hashes = {name: storage.hash_file(path) for name, path in given.items() if path is not None}
    with storage.claimed_folder(out, "simulate", settings, hashes):
        device, jaw = load_probe(probe), load_source(mesh, source)
        with show_progress() as progress:
            capture, _ = pipeline.simulate(jaw, device, out, options, progress=progress)
    overlap = storage.read_json(out / "truth" / "path.json")
    console.print(
        f"{len(capture.frames)} frames of {len(device.rig.names)} cameras; consecutive images overlap by "
        f"at least {overlap['minimum_overlap']:.1%}, {overlap['mean_overlap']:.1%} on average"
    )


def reconstruct_capture(capture: Capture, out: Path, options: ReconstructionOptions, model: Path | None = None) -> None:
    """Reconstruct and print a summary. ``model``: a COLMAP model, whose poses are taken."""
    settings = {"reconstruction": options, "from_poses": model}
    inputs = storage.hash_capture(capture) | ({} if model is None else {"poses": hash_model(model)})
    with storage.claimed_folder(out, "reconstruct", settings, inputs):
        options = replace(options, signal=pipeline.resolve_signal(capture, options))
        if options.signal == "shading":
            console.print(
                "the images show no texture: their light and shade are matched, and the frames are located by their "
                "surfaces (--signal texture for the other way)"
            )
            for note in glare_notes(capture.handpiece):
                console.print(f"note: {note}")
        elif options.calibration == "refined" and is_nominal(capture.handpiece) and len(capture.frames) > 1:
            _print_nominal(capture.handpiece, options.nominal)
        with show_progress() as progress:
            found = pipeline.find_poses(capture, out, options, colmap_model=model, progress=progress)
        _print_located(found, capture)
        with show_progress() as progress:
            mesh, sigma_um = pipeline.surface(capture, found, out, options, progress=progress)
        save_expected_picture(out / "expected.png", mesh, sigma_um)
    console.print(f"{out / 'mesh.ply'}: {len(mesh.faces):,} faces")
    print_expected(found, sigma_um)


def _evaluate(
    mesh: Path,
    reference: Path,
    out: Path,
    source: Source,
    options: EvaluationOptions,
    reference_unit: storage.Unit | None = None,
) -> None:
    unit = reference_unit or source.unit
    _measure_trueness(mesh, reference, out, source, options, unit)  # lets go of the surfaces, which the report reads
    report(out, reference=reference, unit=unit)


def _measure_trueness(
    mesh: Path, reference: Path, out: Path, source: Source, options: EvaluationOptions, reference_unit: storage.Unit
) -> None:
    if not storage.has_scale(mesh):
        raise InputError(
            f"{mesh}: it has no scale, so its deviations are in no unit; reconstruct its photographs with --square-mm "
            "(a board beside the object) or --distance"
        )
    file = storage.read_mesh_file(mesh, source.unit)
    (scan, facing), sigma_um = facing_outwards(file.mesh), file.vertex_values.get(storage.SIGMA)
    measured = storage.MeasuredFile(path=mesh, mesh=scan, unit=source.unit)
    against = pipeline.load_reference(
        reference, unit=reference_unit, arch=source.arch, scan=measured, labelling=source.labelling
    )
    for note in (*(f"scan: {note}" for note in facing), *against.notes):
        console.print(f"note: {note}")
    known, hashes = against.jaw, {**against.hashes, "mesh": storage.hash_file(mesh)}
    with storage.claimed_folder(out, "evaluate", {"evaluation": options}, hashes, replace=True):
        trueness = pipeline.evaluate(scan, against, options, sigma_um=sigma_um)
        for name in _FURTHER:  # of another mesh or reference they would be shown as of this one
            (out / name).unlink(missing_ok=True)
        coloured = replace(scan, colors=deviation_colors(trueness.deviation_um))
        values = {"deviation_um": trueness.deviation_um} | ({} if sigma_um is None else {storage.SIGMA: sigma_um})
        storage.write_mesh(out / "deviation.ply", coloured, values=values)
        save_deviation_picture(out / "deviation.png", scan, trueness)
        storage.write_trueness(out / "trueness.json", trueness)
    _print_trueness(trueness)
    _evaluate_trajectory(mesh, reference, trueness, out)
    if known.spheres:
        _evaluate_spheres(scan, known, trueness, out)
    if known.lines:
        _evaluate_margins(scan, known, trueness, out)


_FURTHER = ("trajectory.json", "spheres.json", "spheres.png", "margins.json", "margins.png")
"""What only some scans have."""


def _evaluate_trajectory(mesh: Path, truth: Path, trueness: Trueness, out: Path) -> None:
    """The poses that a reconstruction made its mesh with, where the true ones are known."""
    found, true = mesh.parent / "motion" / "poses.json", truth / "poses.json"
    if mesh.stem != "mesh" or not (found.is_file() and true.is_file()):
        return
    poses = _in_true_frame(storage.read_poses(found), found.parent, truth)
    try:
        error = trajectory_error(poses, storage.read_poses(true), trueness.reference_from_scan)
    except InputError as reason:
        console.print(f"note: {reason}")
        return
    storage.write_json(out / "trajectory.json", error)
    console.print(
        f"trajectory of {error.frames} frames, RMSE: absolute pose error {error.ape_um.rmse:.1f} µm and "
        f"{error.ape_deg.rmse:.4f} deg, relative from frame to frame {error.rpe_um.rmse:.1f} µm and "
        f"{error.rpe_deg.rmse:.4f} deg"
    )


def _in_true_frame(rig_from_world: Mapping[str, Rigid3], motion: Path, truth: Path) -> dict[str, Rigid3]:
    """Poses of the frame in which the true handpiece is described: where a calibration has its own, no image tells."""
    files = [folder / "handpiece.json" for folder in (motion, truth)]
    if not all(file.is_file() for file in files):
        return dict(rig_from_world)
    found, true = (storage.read_handpiece(file).rig for file in files)
    if set(found.names).isdisjoint(true.names):
        return dict(rig_from_world)
    true_from_found = found.motion_onto(true)
    return {name: true_from_found @ pose for name, pose in rig_from_world.items()}


def _evaluate_spheres(scan: Mesh, reference: Jaw, trueness: Trueness, out: Path) -> None:
    try:
        report = evaluate_spheres(scan, reference, trueness.reference_from_scan)
    except InputError as error:
        console.print(f"note: {error}")
        return
    storage.write_json(out / "spheres.json", report)
    save_sphere_picture(
        out / "spheres.png",
        reference,
        {label: sphere.form_rms_um for label, sphere in report.spheres.items()},
        np.array([spacing.nominal_mm for spacing in report.spacings]),
        np.array([spacing.error_um for spacing in report.spacings]),
        report.named_um,
        report.scale_ppm,
        title="Spheres in the scan, without a best fit",
    )
    _print_spheres(report)


def _evaluate_margins(scan: Mesh, reference: Jaw, trueness: Trueness, out: Path) -> None:
    """Margins of preparations, on the teeth that were scanned."""
    lines = {name: line for name, line in reference.lines.items() if int(name.split(".")[0]) in trueness.per_tooth}
    margins = cut_margins(scan, replace(reference, lines=lines), trueness.reference_from_scan)
    errors = {fdi: margin_error(margin) for fdi, margin in margins.items()}
    storage.write_json(out / "margins.json", errors)
    if errors:
        save_margin_picture(out / "margins.png", margins)
        _print_margins(errors)


def _print_margins(errors: Mapping[int, MarginError]) -> None:
    table = Table(title="Margins in µm: distance of the scan's edge from the true line", title_justify="left")
    for column in ("tooth", "evaluated, %", "found, %", "mean", "SD", "P95", "max", "outward", "floor"):
        table.add_column(column, justify="right")
    for fdi, error in sorted(errors.items()):
        found = error.scan
        shares = (error.evaluated_pct, found.found_pct)
        figures = (found.mean_um, found.std_um, found.p95_um, found.max_um, found.outward_um, error.floor.mean_um)
        table.add_row(str(fdi), *(f"{figure:.1f}" for figure in (*shares, *figures)))
    Console().print(table)


def _print_spheres(report: SphereReport) -> None:
    table = Table(title="Spheres in µm, without a best fit", title_justify="left")
    for column in ("sphere", "size error", "form error (range)", "form RMS", "cap covered, %"):
        table.add_column(column, justify="left" if column == "sphere" else "right")
    for label, sphere in report.spheres.items():
        figures = (sphere.size_error_um, sphere.form_range_um, sphere.form_rms_um, sphere.coverage_pct)
        table.add_row(label, *(f"{figure:.1f}" for figure in figures))
    Console().print(table)
    console.print(
        f"spacing error of {len(report.spacings)} pairs: max {report.spacing_max_um:.1f} µm, RMS "
        f"{report.spacing_rms_um:.1f} µm, scale {report.scale_ppm:+.0f} ppm; "
        + ", ".join(f"{name} {error:+.1f}" for name, error in report.named_um.items())
    )
    for label, reason in report.not_measured.items():
        console.print(f"  not measured: {label}: {reason}")


def _print_nominal(handpiece: Handpiece, options: NominalOptions) -> None:
    assumed = options.for_handpiece(handpiece)
    console.print(
        "calibration: the handpiece file gives no uncertainties; it is taken as nominal, accurate (one sigma) to "
        f"{1000 * assumed.place_mm:.3g} µm and {assumed.turn_deg:g}° in the pose of each camera, "
        f"{100 * assumed.focal_share:g} % in focal length, {assumed.centre_px:g} px in principal point and "
        f"{assumed.k1:g} in k1; change this with --nominal.*, or hold the calibration with --calibration fixed"
    )


def _print_located(reconstruction: Reconstruction, capture: Capture) -> None:
    console.print(f"located {len(reconstruction.frames)} of {len(capture.frames)} frames")
    for dropped in reconstruction.dropped:
        console.print(f"  left out {dropped.what}: {dropped.reason}")
    if reconstruction.refinement is not None:
        console.print(f"calibration: {reconstruction.refinement.summary}")
    for note in reconstruction.notes:
        if note not in glare_notes(capture.handpiece):  # which were printed before the depth was measured
            console.print(f"note: {note}")


_COLUMNS = ("region", *(METRICS[name].heading for name in STATISTICS))
_SHARES = tuple(METRICS[name].title for name in ("complete_50_um_pct", "crown_50_um_pct"))


def _print_trueness(trueness: Trueness) -> None:
    table = Table(title="Trueness in µm, scan to reference", title_justify="left")
    for column in (*_COLUMNS, *_SHARES):
        table.add_column(column, justify="left" if column == "region" else "right")
    for region, d, shares in _regions(trueness):
        figures = (getattr(d, name) for name in STATISTICS)
        cells = ("-" if share is None else f"{share['50']:.1f}" for share in shares)
        table.add_row(region, *(f"{figure:.1f}" for figure in figures), *cells)
    Console().print(table)
    if trueness.within_sigmas_pct is not None:
        one, two = trueness.within_sigmas_pct["1"], trueness.within_sigmas_pct["2"]
        console.print(f"of the surface {one:.0f} % lies within one and {two:.0f} % within two of the expected sigmas")
    for note in trueness.notes if trueness.crown is None else (*trueness.notes, trueness.crown.note):
        console.print(f"note: {note}")


_Shares = tuple[Mapping[str, float] | None, Mapping[str, float] | None]
"""Within some um, of what could be seen and of the open crown."""


def _regions(trueness: Trueness) -> list[tuple[str, DeviationStatistics, _Shares]]:
    """Rows of the table: all that could be seen, each tooth, and everything that was scanned."""
    seen, crown = trueness.per_tooth_completeness_pct, trueness.crown
    by_tooth = {} if crown is None else crown.per_tooth_pct
    whole: _Shares = (trueness.completeness_pct, None if crown is None else crown.completeness_pct)
    teeth = [(str(fdi), d, (seen[fdi], by_tooth.get(fdi))) for fdi, d in sorted(trueness.per_tooth.items())]
    return [("all", trueness.accuracy, whole), *teeth, ("everything", trueness.everything, (None, None))]
