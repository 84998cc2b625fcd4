"""Runs on many jaws and pairs: populations, the mean shape, what the designs see, pairs of cameras in theory.

The benchmarks of the same names measure more (times, memory); what they have in common with the reproduction is here.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cuspid import storage
from cuspid.anatomy.phantom.build import build_phantom, phantom_landmarks
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.phantom.population import GROUPS, Group, GroupName, draw_and_count, draw_population
from cuspid.anatomy.shape.mean import MeanShapeOptions, mean_shape
from cuspid.anatomy.surfaces import named_surfaces
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import essential_four, twelve_cameras
from cuspid.model.jaw import Jaw, Landmark
from cuspid.model.rig import Handpiece
from cuspid.model.shape_model import ShapeModel
from cuspid.model.visibility import VisibilityOptions, surface_rows, survey_visibility
from cuspid.runtime.errors import InputError
from cuspid.simulation.path.scan import ScanPathOptions, plan_scan_path
from cuspid.studies.camera_pair import CameraPairOptions, best_pairs, study_camera_pair

MEAN_GROUP: GroupName = "lower-14"
"""Whose mean shape is found."""
MEAN_EDGE_MM = 0.28
"""Edge of the faces of its jaws: about 200 000 faces each."""


# --- Populations ------------------------------------------------------------------------------------------------------


def measure_populations(count: int) -> dict[str, object]:
    """Draw, place and measure jaws of all groups."""
    return {name: measure_group(name, count, seed) for seed, name in enumerate(GROUPS)}


def measure_group(name: GroupName, count: int, seed: int) -> dict[str, object]:
    """Draw, place and measure one group."""
    group = GROUPS[name]
    jaws, redrawn = draw_and_count(name, count, np.random.default_rng(seed))
    asked, found, failed = [], [], []
    for jaw in jaws:
        try:
            found.append(_dimensions(phantom_landmarks(jaw), group))
            asked.append([jaw.inter_canine_mm, jaw.inter_first_molar_mm, jaw.inter_second_molar_mm, jaw.arch_length_mm])
        except InputError as error:
            failed.append(str(error))
    got, drawn = np.array(found), np.array(asked, dtype=float)
    sources = (group.inter_canine, group.inter_first_molar, group.inter_second_molar, group.arch_length)
    table = {letter: spread for letter, spread in zip("abcf", sources, strict=True) if spread is not None}
    return {
        "jaws": count,
        "drawn_again": redrawn,
        "share_drawn_again": round(redrawn / (redrawn + count), 3),
        "refused": failed,
        "max_abs_asked_minus_measured_mm": round(float(np.nanmax(np.abs(got - drawn))), 4),
        **{
            letter: {
                "source": {"mean_mm": spread.mean_mm, "sd_mm": spread.sd_mm},
                "measured": _summary(got[:, k]),
                "z_of_mean": round(float((got[:, k].mean() - spread.mean_mm) / (spread.sd_mm / np.sqrt(len(got)))), 2),
                "sd_ratio": round(float(got[:, k].std(ddof=1) / spread.sd_mm), 3),
            }
            for k, (letter, spread) in enumerate(table.items())
        },
        **({} if "f" in table else {"f": {"measured": _summary(got[:, 3])}}),
    }


def _dimensions(landmarks: Mapping[str, Landmark], group: Group) -> list[float]:
    """a, b, c and f of a jaw by its landmarks, mm."""
    negative, positive = (30, 40) if group.arch == "lower" else (10, 20)

    def ends(position: int, point: str) -> np.ndarray:
        return np.array([landmarks[f"{quadrant + position}.{point}"].position for quadrant in (negative, positive)])

    pairs = [ends(3, "cusp_tip"), ends(6, "buccal_groove"), ends(7, "buccal_groove")]
    widths = [float(np.linalg.norm(pair[1] - pair[0])) for pair in pairs]
    return [*widths, float(np.linalg.norm(pairs[2].mean(axis=0) - landmarks["papilla"].position))]


def _summary(values: np.ndarray) -> dict[str, float]:
    """Mean and SD, mm."""
    return {"mean_mm": round(float(values.mean()), 3), "sd_mm": round(float(values.std(ddof=1)), 3)}


# --- Mean shape -------------------------------------------------------------------------------------------------------


def make_phantom(path: Path, options: PhantomOptions) -> Jaw:
    """A phantom, from its file where that is there already."""
    if not path.with_suffix(".json").exists():
        storage.write_jaw(path, build_phantom(options))
    return storage.read_jaw(path)


def make_population(folder: Path, count: int, edge_mm: float) -> dict[str, Jaw]:
    """The first phantoms of a drawn population that can be built, kept in ``folder``, by the names of their files."""
    drawn = draw_population(MEAN_GROUP, count + count // 4, np.random.default_rng(0), PhantomOptions(edge_mm=edge_mm))
    jaws: dict[str, Jaw] = {}
    for options in drawn:
        name = f"{len(jaws):02d}"
        try:
            jaws[name] = make_phantom(folder / f"{name}.ply", options)
        except InputError:
            continue
        if len(jaws) == count:
            break
    return jaws


def iteration(model: ShapeModel) -> dict[str, object]:
    """What the search for the mean did, and the modes."""
    return {
        "rounds": len(model.log),
        "converged": model.converged,
        "log": [vars(step) for step in model.log],
        "standard_deviations_mm": model.standard_deviations_mm.round(4).tolist(),
        "variance_shares": model.variance_shares.round(4).tolist(),
    }


def find_mean_shape(work: Path, count: int, edge_mm: float) -> tuple[dict[str, object], Jaw]:
    """The mean of a population, from its first jaw on; the iteration, and the mean."""
    jaws = make_population(work / f"population-{edge_mm:g}-{count}", count, edge_mm)
    model = mean_shape(jaws, MeanShapeOptions(first="00"))
    found = {"group": MEAN_GROUP, "count": len(jaws), "edge_mm": edge_mm, "first_00": iteration(model)}
    return {"population": found}, model.mean


# --- Cameras ----------------------------------------------------------------------------------------------------------


def path_over(jaw: Jaw, handpiece: Handpiece, tooth: int | None) -> tuple[Rigid3, ...]:
    """The scan path of a seed."""
    path = plan_scan_path(jaw, handpiece, ScanPathOptions(tooth=tooth), np.random.default_rng(0))
    return tuple(path.rig_from_world.values())


def surfaces_seen(jaw: Jaw, poses: tuple[Rigid3, ...]) -> dict[str, object]:
    """What the essential four and the twelve see of each named surface along the same path."""
    surfaces = named_surfaces(jaw)
    found = {
        design.name: survey_visibility(jaw.mesh, design, poses, VisibilityOptions())
        for design in (essential_four(), twelve_cameras())
    }
    return {name: surface_rows(seen, jaw.mesh.face_areas, surfaces) for name, seen in found.items()}


def best_camera_pairs(jaw: Jaw, options: CameraPairOptions) -> dict[str, object]:
    """The best pair by distance for each surface faced, with windows that turn with the surface."""
    rows = study_camera_pair(jaw, options)
    return {"cases": len(rows), "best_within_budget": {options.matcher: best_pairs(rows)}}
