"""Compare estimated landmarks with given ones: on real arches, where people set them, and on phantoms, which know them.

    python benchmarks/landmarks.py --data FOLDER [--seeds 8] [--out benchmarks/results/landmarks.json]
    python benchmarks/landmarks.py --calibrate

FOLDER holds, for each arch, ``<name>_UPPER.ply`` or ``<name>_LOWER.ply`` with tooth labels, and
``<name>_..._landmarks.csv`` beside it: label, code, and place in the coordinates of the mesh. Codes are compared with
the landmark that is the same point:

- 6 (cusp) of an incisor with the middle of its edge, of a canine with its tip;
- 7 (outer cusp) of a premolar with its buccal cusp, 8 (inner cusp), or 12 where there are two, with its lingual one;
- 9 (outer mesial cusp) and 12 (inner mesial cusp) of a molar with its mesiobuccal and mesiolingual cusp, 10 (outer
  middle cusp), or 11 (outer distal cusp) where there is none, with its distobuccal cusp;
- 5 (pit) of premolars and molars with the central groove.

1 and 2 (mesial, distal), 3 and 4 (buccal, lingual) lie where a crown bulges most: no landmark of ours. Nor is 13 (inner
distal cusp). Buccal grooves have no code, so the widths at molars are between mesiobuccal cusps. A given point that
does not lie on the tooth whose label it bears is a slip, and is told but not counted; those in doubt (`IN_DOUBT`) are
counted, and figures without them are told, too.

``--calibrate`` prints the uncertainties to state (`SIGMA_MM`): it fits them to the errors on phantoms of other seeds.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from run import conditions
from scipy.optimize import minimize

from cuspid.anatomy.jaw_files import load_jaw
from cuspid.anatomy.landmarks.estimation import REAL_TEETH_MM, SIGMA_MM, estimate_landmarks
from cuspid.anatomy.landmarks.scheme import kind_of
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.geometry import best_similarity
from cuspid.model.jaw import ARCHES, Arch, Landmark
from cuspid.storage import write_json
from cuspid.storage.jaws import read_labelled_mesh

DEVELOPED_ON = ("AE_LOWER", "AE_UPPER", "HC_LOWER", "HC_UPPER")
"""Arches that were looked at while the estimator was made; the others only at the end (KEC_LOWER also while an earlier
version was)."""
CODES: Mapping[str, Mapping[str, tuple[int, ...]]] = {
    "incisor": {"incisal_edge": (6,)},
    "canine": {"cusp_tip": (6,)},
    "premolar": {"buccal_cusp": (7,), "lingual_cusp": (8, 12), "central_groove": (5,)},
    "molar": {
        "mesiobuccal_cusp": (9,),
        "distobuccal_cusp": (10, 11),
        "mesiolingual_cusp": (12,),
        "central_groove": (5,),
    },
}
"""By kind of tooth and landmark, the codes that may be the same point; the first that a tooth has counts."""
WIDTHS = {"inter_canine": (3, "cusp_tip"), "inter_first_molar": (6, "mesiobuccal_cusp")} | {
    "inter_second_molar": (7, "mesiobuccal_cusp")
}
EDGES_MM = (0.5, 0.9)
SLIP_MM = 1.0
"""A given point that is farther from the tooth whose label it bears is none of that tooth."""
IN_DOUBT = {
    "AE_UPPER 15.buccal_cusp": "the tooth has two buccal cusps, 5 mm apart; given is the distal one",
    "HC_UPPER 13.cusp_tip": "given 1.8 mm mesial of the tip, on the slope, 0.6 mm lower",
}
"""Given points that a picture of the tooth speaks against, and what it shows."""
CALIBRATION_SEEDS, SEEDS_FROM = range(100, 114), 200


@dataclass(frozen=True, eq=False, kw_only=True)
class Error:
    """An estimated landmark against the given one."""

    label: str
    vector_mm: np.ndarray
    sigma_mm: float
    edge_mm: float = 0.0

    @property
    def kind(self) -> str:
        """Kind of point, as in `SIGMA_MM`."""
        fdi, _, name = self.label.rpartition(".")
        return f"{kind_of(int(fdi))}.{name}" if fdi else name

    @property
    def distance_mm(self) -> float:
        """How far apart they are."""
        return float(np.linalg.norm(self.vector_mm))


def given_points(path: Path, arch: Arch) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, Landmark]]:
    """The given landmarks of an arch, those of them that are far from their tooth with that distance in mm, and the
    estimated ones, all by our labels and in its occlusal frame."""
    raw, labels, _ = read_labelled_mesh(path)
    jaw, _ = load_jaw(path, arch=arch)
    if labels is None or jaw.face_labels is None:
        raise SystemExit(f"{path}: no tooth labels")
    weights = np.ones(len(raw.vertices))
    _, rotation, shift = best_similarity(raw.vertices, jaw.mesh.vertices, weights)
    teeth = dict({(int(a), int(b)) for a, b in zip(labels, jaw.face_labels, strict=True)})
    marks: dict[int, dict[int, np.ndarray]] = defaultdict(dict)
    with path.with_name(f"{path.stem}_landmarks.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            place = np.array([float(row[axis]) for axis in "xyz"])
            marks[teeth[int(row["label"])]][int(row["landmark"])] = rotation @ place + shift
    points = {
        f"{fdi}.{name}": next(found[code] for code in codes if code in found)
        for fdi, found in sorted(marks.items())
        for name, codes in CODES[kind_of(fdi)].items()
        if any(code in found for code in codes)
    }
    off = {
        label: round(float(jaw.mesh.submesh(jaw.tooth_faces(int(label[:2]))).closest(place[None])[0][0]), 2)
        for label, place in points.items()
    }
    slips = {label: distance for label, distance in off.items() if distance > SLIP_MM}
    kept = {label: place for label, place in points.items() if label not in slips}
    return kept, slips, estimate_landmarks(replace(jaw, landmarks={}))


def errors_of(given: Mapping[str, np.ndarray], found: Mapping[str, Landmark], edge_mm: float = 0.0) -> list[Error]:
    """Of each landmark that both have."""
    return [
        Error(
            label=label,
            vector_mm=found[label].position - place,
            sigma_mm=found[label].estimated_sigma_mm or np.nan,
            edge_mm=edge_mm,
        )
        for label, place in given.items()
        if label in found
    ]


def width_errors(given: Mapping[str, np.ndarray], found: Mapping[str, Landmark], arch: Arch) -> dict[str, float]:
    """Estimated minus given width, mm."""
    errors = {}
    for name, (position, point) in WIDTHS.items():
        pair = [f"{quadrant}{position}.{point}" for quadrant in ((4, 3) if arch == "lower" else (1, 2))]
        if all(label in given and label in found for label in pair):
            widths = [
                np.linalg.norm(places[0] - places[1])
                for places in ([found[label].position for label in pair], [given[label] for label in pair])
            ]
            errors[name] = round(float(widths[0] - widths[1]), 3)
    return errors


def statistics(errors: Iterable[Error]) -> dict[str, float]:
    """Distances, and errors over what is stated, root mean square along an axis."""
    errors = list(errors)
    distances = [error.distance_mm for error in errors]
    scaled = np.array([error.vector_mm / error.sigma_mm for error in errors])
    return {
        "count": len(errors),
        "median_mm": round(float(np.median(distances)), 3),
        "p90_mm": round(float(np.percentile(distances, 90)), 3),
        "max_mm": round(float(np.max(distances)), 3),
        "beyond_1_mm_pct": round(100 * float(np.mean(np.array(distances) > 1)), 1),
        "over_stated": round(float(np.sqrt(np.mean(scaled**2))), 3),
    }


def width_statistics(errors: list[float]) -> dict[str, float]:
    """Of the errors of one width, mm."""
    sizes = np.abs(errors)
    return {"median_abs_mm": round(float(np.median(sizes)), 3), "max_abs_mm": round(float(sizes.max()), 3)}


def by_kind(errors: Iterable[Error]) -> dict[str, dict[str, float]]:
    """Statistics of each kind of point."""
    kinds: dict[str, list[Error]] = defaultdict(list)
    for error in errors:
        kinds[error.kind].append(error)
    return {kind: statistics(found) for kind, found in sorted(kinds.items())}


def real(folder: Path) -> dict[str, object]:
    """The arches of a folder."""
    errors: dict[str, list[Error]] = {}
    widths: dict[str, dict[str, float]] = {}
    slips: dict[str, float] = {}
    for path in sorted(folder.glob("*_*ER.ply")):
        arch: Arch = "lower" if path.stem.endswith("LOWER") else "upper"
        given, off, found = given_points(path, arch)
        slips |= {f"{path.stem} {label}": distance for label, distance in off.items()}
        errors[path.stem], widths[path.stem] = errors_of(given, found), width_errors(given, found, arch)
    flat = [error for found in errors.values() for error in found]
    held = [error for name, found in errors.items() if name not in DEVELOPED_ON for error in found]
    sure = [error for name, found in errors.items() for error in found if f"{name} {error.label}" not in IN_DOUBT]
    sure_widths = {
        name: [
            each[name]
            for arch, each in widths.items()
            if name in each and not any(doubt.startswith(arch) and doubt.endswith(point) for doubt in IN_DOUBT)
        ]
        for name, (_, point) in WIDTHS.items()
    }
    return {
        "all": statistics(flat),
        "looked_at_only_at_the_end": statistics(held),
        "arches": {name: statistics(found) | {"widths": widths[name]} for name, found in errors.items()},
        "kinds": by_kind(flat),
        "widths": {
            name: width_statistics([found[name] for found in widths.values() if name in found]) for name in WIDTHS
        },
        "without_those_in_doubt": statistics(sure)
        | {"widths": {name: width_statistics(found) for name, found in sure_widths.items()}},
        "in_doubt": IN_DOUBT,
        "not_on_their_tooth": slips,
        "far": {
            f"{name} {error.label}": round(error.distance_mm, 2)
            for name, found in errors.items()
            for error in found
            if error.distance_mm > 1
        },
    }


def phantom_errors(seeds: Iterable[int]) -> Iterator[Error]:
    """Of all landmarks of phantoms."""
    for seed in seeds:
        for arch in ARCHES:
            for edge_mm in EDGES_MM:
                jaw = build_phantom(PhantomOptions(arch=arch, seed=seed, edge_mm=edge_mm))
                given = {label: point.position for label, point in jaw.landmarks.items()}
                yield from errors_of(given, estimate_landmarks(replace(jaw, landmarks={})), edge_mm)
                print(f"seed {seed}, {arch}, {edge_mm} mm", flush=True)


def calibrated(errors: Iterable[Error]) -> dict[str, tuple[float, float]]:
    """`SIGMA_MM` that explains errors: most likely for normal ones, then scaled to their root mean square."""
    kinds: dict[str, list[Error]] = defaultdict(list)
    for error in errors:
        kinds[error.kind].append(error)
    return {kind: _fitted(kind, found) for kind, found in sorted(kinds.items())}


def _fitted(kind: str, errors: list[Error]) -> tuple[float, float]:
    square = np.array([np.mean(error.vector_mm**2) for error in errors])
    edge = np.array([error.edge_mm for error in errors])
    constant, share = SIGMA_MM[kind]
    stated = np.array([error.sigma_mm for error in errors]) ** 2
    spread = np.maximum(stated - constant**2 - (share * edge) ** 2 - REAL_TEETH_MM**2, 0.0)

    def cost(parameters: np.ndarray) -> float:
        variance = spread + parameters[0] ** 2 + (parameters[1] * edge) ** 2 + 1e-6
        off = np.log(np.mean(square / variance))
        return float(np.mean(np.log(variance) + square / variance) + 10 * off**2)

    best = min(
        (minimize(cost, start, method="Nelder-Mead") for start in ([0.1, 0.1], [0.3, 0.0], [0.0, 0.3])),
        key=lambda m: m.fun,
    )
    return tuple(round(abs(float(value)), 2) for value in best.x)  # type: ignore[return-value]


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of arches with given landmarks")
    parser.add_argument("--seeds", type=int, default=8, help="number of phantoms of each arch")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "landmarks.json")
    parser.add_argument("--calibrate", action="store_true", help="only print the uncertainties to state")
    arguments = parser.parse_args()
    if arguments.calibrate:
        for kind, (constant, share) in calibrated(phantom_errors(CALIBRATION_SEEDS)).items():
            print(f'        "{kind}": ({constant:.2f}, {share:.2f}),')
        return
    errors = list(phantom_errors(range(SEEDS_FROM, SEEDS_FROM + arguments.seeds)))
    phantoms = {"seeds": arguments.seeds, "edges_mm": EDGES_MM, "all": statistics(errors), "kinds": by_kind(errors)}
    arches = real(arguments.data) if arguments.data else None
    write_json(arguments.out, {"case": "landmarks", "phantoms": phantoms, "real": arches, **conditions()})


if __name__ == "__main__":
    main()
