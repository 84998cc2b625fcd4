"""What the page of a study shows in 3-D: a light mesh of each specimen, with the deviations of each scan."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from cuspid import storage
from cuspid.model.mesh import Mesh
from cuspid.storage.files import read_arrays, write_arrays
from cuspid.studies.scanners.files import ScanFile
from cuspid.studies.scanners.specimen import Specimen
from cuspid.studies.scanners.study import Study, group_file, specimen_folder, specimen_of

MOST_FACES = 24_000
_NEAREST = 5
_NEAR_MM = 1.0
"""Places farther than this from a vertex say nothing of it."""
_UM_PER_STEP, UNKNOWN = 0.1, -32768


def write_views(out: Path, study: Study) -> None:
    """Write ``view.npz`` beside each specimen, and ``means.ply`` with the mean and the standard deviation of each
    scanner for other programs."""
    for stale in (out / "specimens").glob("*/view.*"):
        stale.unlink()  # of specimens that have no part in the study any more
    for name in study.specimens:
        rows = [row for row in study.tables.scans if row["specimen"] == name]
        shown = {(row["scanner"], row["scan"]) for row in rows}
        scans = [scan for scan in study.scans if scan.specimen == name and (scan.scanner, scan.scan) in shown]
        if scans:
            _write_view(out, specimen_of(out, name), scans)


def _write_view(out: Path, specimen: Specimen, scans: Sequence[ScanFile]) -> None:
    shown = specimen.mesh.simplified(MOST_FACES)
    nearest, known = _nearest(specimen, shown)
    scanners = list(dict.fromkeys(scan.scanner for scan in scans))
    groups = [read_arrays(group_file(out, each, specimen.name), remedy="run again") for each in scanners]
    frames = [at_vertices(group["mean_um"], nearest, known) for group in groups]
    labels = [f"mean of {each}" for each in scanners]
    for scan in scans:
        field = read_arrays(out / "maps" / f"{scan.key}.npz", remedy="run again")["um"]
        frames.append(at_vertices(field, nearest, known))
        labels.append(f"{scan.scanner}, {scan.scan}")
    spread = [at_vertices(group["sd_um"], nearest, known) for group in groups]
    folder = specimen_folder(out, specimen.name)
    steps = np.clip(np.rint(np.nan_to_num(np.array(frames)) / _UM_PER_STEP), UNKNOWN + 1, -UNKNOWN - 1)
    arrays = {
        "vertices": shown.vertices,
        "faces": shown.faces,
        "steps": np.where(np.isnan(frames), UNKNOWN, steps).astype(np.int16),
        "means": np.array(len(scanners)),
    }
    write_arrays(folder / "view.npz", arrays, compressed=True)
    about = {"specimen": specimen.name, "arch": specimen.arch, "frames": labels, "faces": len(specimen.mesh.faces)}
    storage.write_json(folder / "view.json", about)
    values = {}
    for k, each in enumerate(scanners):
        word = "".join(letter if letter.isalnum() and letter.isascii() else "_" for letter in each)
        values[f"mean_{word}_um"], values[f"sd_{word}_um"] = frames[k], spread[k]
    storage.write_mesh(folder / "means.ply", shown, values=values)


def _nearest(specimen: Specimen, shown: Mesh) -> tuple[Int[np.ndarray, "v k"], np.ndarray]:
    """The places nearest to each vertex, and which of them are near."""
    distances, nearest = cKDTree(specimen.places.points).query(shown.vertices, k=_NEAREST)
    return np.asarray(nearest), np.asarray(distances) < _NEAR_MM


def at_vertices(
    field_um: Float[np.ndarray, "p"], nearest: Int[np.ndarray, "v k"], near: np.ndarray
) -> Float[np.ndarray, "v"]:
    """The mean of the places around each vertex; NaN where the nearest one is not shown."""
    values = field_um[nearest].astype(np.float64)
    known = np.isfinite(values) & near
    sums = np.where(known, values, 0).sum(axis=1)
    return np.where(known[:, 0], sums / np.maximum(known.sum(axis=1), 1), np.nan)
