"""What a camera or a handpiece can do, before anything is scanned: optics, visibility, precision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Int
from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, arg

from cuspid import storage
from cuspid.anatomy.surfaces import named_surfaces, tooth_axes
from cuspid.cli.shared import Flat, Probe, Source, console, load_probe, load_source
from cuspid.handpiece.optics import Optics
from cuspid.handpiece.precision import NoiseModel, PrecisionMap
from cuspid.handpiece.presets import PRESETS
from cuspid.model.jaw import Jaw
from cuspid.model.visibility import VisibilityOptions, camera_rows, surface_rows
from cuspid.report.figures.precision import save_precision_picture
from cuspid.report.figures.visibility import save_counts_picture, save_surfaces_picture
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SEED, TOOTH, Range
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.studies.forecast import bound_over, foresee

VIEWS = {"occlusal": (0.0, 90.0), "from the cheek": (0.0, 15.0), "from the tongue": (180.0, 15.0)}
"""Azimuth from the buccal side of a tooth, and elevation, in degrees."""


def optics(
    *,
    distance_mm: Annotated[float, Range(0.01, 100_000)] = 5.0,
    blur_px: Annotated[float, Range(0.01, 1000)] = 2.0,
    baseline_mm: Annotated[float, Range(0.001, 10_000)] = 2.5,
    out: Path | None = None,
) -> None:
    """Compare miniature cameras: footprint, um per px, depth of field, diffraction, overlap of a parallel pair.

    Args:
        distance_mm: Distance from the lens to the surface.
        blur_px: Diameter of the largest blur disc that still counts as sharp.
        baseline_mm: Distance between the two cameras of a pair.
        out: CSV file for the table.
    """
    if not (distance_mm > 0 and blur_px > 0 and baseline_mm >= 0):
        raise InputError("optics: --distance-mm and --blur-px must be larger than 0, --baseline-mm at least 0")
    if out is not None:
        storage.require_suffix(out, ".csv")
    rows = [_optics_row(name, lens, distance_mm, blur_px, baseline_mm) for name, lens in PRESETS.items()]
    if out is not None:
        storage.write_table(out, rows)
    _print_rows(f"Miniature cameras at {distance_mm:g} mm", _transpose(rows), digits=2)
    for name, lens in PRESETS.items():
        console.print(f"{name}: {lens.source}")


def _optics_row(name: str, lens: Optics, distance_mm: float, blur_px: float, baseline_mm: float) -> dict[str, object]:
    near_mm, far_mm = lens.depth_of_field_mm(blur_px)
    width_mm, height_mm = lens.footprint_mm(distance_mm)
    return {
        "sensor": name,
        "width_px": lens.width_px,
        "height_px": lens.height_px,
        "view_deg": lens.field_of_view_deg,
        "focal_length_mm": lens.focal_mm,
        "um_per_px": lens.um_per_px(distance_mm),
        "footprint_width_mm": width_mm,
        "footprint_height_mm": height_mm,
        "sharp_from_mm": near_mm,
        "sharp_to_mm": far_mm,
        "airy_disc_px": lens.diffraction_px(distance_mm),
        "overlap_pct": 100 * lens.parallel_overlap(baseline_mm, distance_mm),
    }


def visibility(
    jaw: Annotated[Path | None, Positional, arg(metavar="[JAW]")] = None,
    *,
    out: Path,
    source: Annotated[Source, Flat] = Source(),
    probe: Annotated[Probe, Flat] = Probe(),
    path: Annotated[ScanPathOptions, Flat] = ScanPathOptions(),
    seed: Annotated[int, SEED] = 0,
    options: Annotated[VisibilityOptions, Flat] = VisibilityOptions(),
) -> None:
    """Find how much of each surface a handpiece sees along its scan path, camera by camera.

    Args:
        jaw: Mesh of a jaw (STL, PLY, OBJ, OFF); default: the built-in phantom.
        out: Folder for surfaces.csv, cameras.csv and pictures.
        seed: Seed of the hand's drift.
    """
    settings = {"source": source, "probe": probe, "path": path, "seed": seed, "visibility": options}
    with storage.claimed_folder(out, "visibility", settings, _hashes(jaw, probe), replace=True):
        device, scanned = load_probe(probe), load_source(jaw, source)
        seen = foresee(scanned, device, path, options, seed=seed)
        surfaces = _surfaces(scanned, path.tooth)
        rows = surface_rows(seen, scanned.mesh.face_areas, surfaces)
        storage.write_table(out / "surfaces.csv", rows, digits=2)
        storage.write_table(out / "cameras.csv", camera_rows(seen, scanned.mesh.face_areas, surfaces), digits=2)
        save_counts_picture(out / "visibility.png", scanned.mesh, seen.most_at_once, title=f"What {device.name} sees")
        if scanned.face_labels is not None:
            named = {name: mask for name, mask in surfaces.items() if name != "all"}
            save_surfaces_picture(out / "surfaces.png", scanned.mesh, named, title="Named surfaces")
    _print_rows(f"Share of each surface that {device.name} sees", rows, digits=1)


def precision(
    jaw: Annotated[Path | None, Positional, arg(metavar="[JAW]")] = None,
    *,
    tooth: Annotated[int, TOOTH],
    out: Path,
    source: Annotated[Source, Flat] = Source(),
    probe: Annotated[Probe, Flat] = Probe(),
    turns: Annotated[int, Range(1, 99)] = 1,
    noise: Annotated[NoiseModel, Flat] = NoiseModel(),
    visibility: VisibilityOptions = VisibilityOptions(),
) -> None:
    """Map how precisely a handpiece could measure a tooth: the Cramer-Rao bound of all its cameras.

    Args:
        jaw: Mesh of a jaw (STL, PLY, OBJ, OFF) with tooth labels; default: the built-in phantom.
        tooth: FDI number of the tooth.
        out: Folder for precision.csv (one row per face), surfaces.csv and precision.png.
        turns: Passes over the tooth, as in `cuspid run`. Each face is measured from the best of five positions on each
            pass.
        visibility: When a camera counts as seeing a face.
    """
    settings = {"source": source, "probe": probe, "tooth": tooth, "turns": turns, "noise": noise, "rule": visibility}
    with storage.claimed_folder(out, "precision", settings, _hashes(jaw, probe), replace=True):
        device, scanned = load_probe(probe), load_source(jaw, source)
        found = bound_over(scanned, device, ScanPathOptions(tooth=tooth, turns=turns), noise, visibility)
        faces = scanned.tooth_faces(tooth)
        rows = _precision_rows(scanned, found, _surfaces(scanned, tooth))
        storage.write_table(out / "surfaces.csv", rows, digits=2)
        storage.write_table(out / "precision.csv", _face_rows(scanned, found, np.flatnonzero(faces)), digits=4)
        _save_map(out / "precision.png", scanned, tooth, found, f"{device.name} over tooth {tooth}")
    _print_rows(f"Bound over tooth {tooth}, {device.name}, noise {noise.sigma_px:g} px", rows, digits=1)


def _hashes(jaw: Path | None, probe: Probe) -> dict[str, str]:
    given = {"jaw": jaw, "handpiece": probe.handpiece}
    return {name: storage.hash_file(path) for name, path in given.items() if path is not None}


def _surfaces(jaw: Jaw, tooth: int | None) -> dict[str, Bool[np.ndarray, "f"]]:
    """All that counts, and its named surfaces where there are labels."""
    everything = np.ones(len(jaw.mesh.faces), dtype=bool) if tooth is None else jaw.tooth_faces(tooth)
    named = {} if jaw.face_labels is None else named_surfaces(jaw)
    return {"all": everything, **{name: mask & everything for name, mask in named.items()}}


def _precision_rows(
    jaw: Jaw, found: PrecisionMap, surfaces: Mapping[str, Bool[np.ndarray, "f"]]
) -> list[dict[str, object]]:
    """Share that two cameras see, and medians of the bound there."""
    areas, rms, across = jaw.mesh.face_areas, found.rms_um, found.normal_um(jaw.mesh.face_normals)
    rows: list[dict[str, object]] = []
    for name, mask in surfaces.items():
        if not mask.any():
            continue
        seen = mask & np.isfinite(rms)
        rows.append(
            {
                "surface": name,
                "area_mm2": float(areas[mask].sum()),
                "seen_by_2_pct": float(100 * areas[seen].sum() / areas[mask].sum()),
                "rms_median_um": float(np.median(rms[seen])) if seen.any() else None,
                "across_surface_median_um": float(np.median(across[seen])) if seen.any() else None,
            }
        )
    return rows


def _face_rows(jaw: Jaw, found: PrecisionMap, faces: Int[np.ndarray, "n"]) -> list[dict[str, object]]:
    rms, across, centres = found.rms_um, found.normal_um(jaw.mesh.face_normals), jaw.mesh.face_centres
    return [
        {
            "face": int(face),
            **{f"{axis}_mm": float(centres[face, k]) for k, axis in enumerate("xyz")},
            "cameras_at_once": int(found.cameras_at_once[face]),
            "rms_um": float(rms[face]),
            "across_surface_um": float(across[face]),
        }
        for face in faces
    ]


def _save_map(path: Path, jaw: Jaw, fdi: int, found: PrecisionMap, title: str) -> None:
    faces = jaw.tooth_faces(fdi)
    rms = found.rms_um[faces]
    if not np.isfinite(rms).any():
        raise InputError(
            f"{title}: no face is seen by two cameras; bring the handpiece nearer or look at another tooth"
        )
    low, high = np.nanpercentile(rms, [2, 98])
    outward = tooth_axes(jaw)[fdi][1]
    buccal_deg = float(np.degrees(np.arctan2(outward[1], outward[0])))
    views = {name: (buccal_deg + azimuth, elevation) for name, (azimuth, elevation) in VIEWS.items()}
    tooth = replace(jaw.mesh.submesh(faces), colors=None)
    save_precision_picture(
        path, tooth, {"best place": rms}, views=views, limits_um=(low, max(high, 1.5 * low)), title=title
    )


def _print_rows(title: str, rows: Sequence[Mapping[str, object]], *, digits: int) -> None:
    table = Table(title=title, title_justify="left")
    for name, cell in rows[0].items():
        is_text = isinstance(cell, str)
        table.add_column(name.replace("_", " "), justify="left" if is_text else "right", no_wrap=is_text)
    for row in rows:
        table.add_row(*(f"{cell:.{digits}f}" if isinstance(cell, float) else str(cell or "-") for cell in row.values()))
    Console().print(table)


def _transpose(rows: Sequence[Mapping[str, object]]) -> list[dict[str, object]]:
    """A row for each column but the first, whose cells become the names of the columns."""
    head, *names = rows[0]
    return [{head: name.replace("_", " "), **{str(row[head]): row[name] for row in rows}} for name in names]
