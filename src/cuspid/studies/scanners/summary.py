"""The scans of a study beside each other: what all of a specimen show, figures of each scan, and precision.

Scans are read one by one from what :mod:`cuspid.studies.scanners.scan` kept of them; of a group of repeats, the
deviations at the places of the reference are in memory at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from cuspid import storage
from cuspid.anatomy.surfaces import SURFACES
from cuspid.evaluation.deviation import statistics
from cuspid.evaluation.places import Places, SmallMotion, best_motion
from cuspid.evaluation.repeatability import LIMIT_FACTOR, PairOptions, compare_pair
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.progress import Progress, silent
from cuspid.storage.files import read_arrays
from cuspid.studies.scanners.files import Remark, ScanFile
from cuspid.studies.scanners.scan import BEYOND, Measured, StudyOptions
from cuspid.studies.scanners.soundness import mend_faces
from cuspid.studies.scanners.specimen import SEGMENTS, Specimen

WITHIN_UM = (10, 25, 50, 100)
"""Distances within which the share of the surface is reported."""
_LEAST_SAMPLES = 50
"""Of a region, for figures."""
_INTERPROXIMAL = ("mesial", "distal")
Row = dict[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class Common:
    """What is evaluated of a specimen."""

    places: Bool[np.ndarray, "p"]
    """The places that all of its scans show, in the region that is asked for."""
    asked: Bool[np.ndarray, "p"]
    """The places of the region that any scan shows: completeness is a share of these."""
    scans: tuple[ScanFile, ...]
    """The scans that have a part in it."""
    remarks: tuple[Remark, ...]
    """Which scans are partial, which scanner has but one, and what all show."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Tables:
    """What a study found, as rows."""

    scans: list[Row]
    """A row for each scan: figures from scan to reference, ``back_`` from reference to scan, modes, spans."""
    regions: list[Row]
    """Of each scan, for each tooth, surface, segment."""
    spans: list[Row]
    """Each distance of each scan."""
    shifts: list[Row]
    """How far each tooth, station, sphere or body lies off in each aligned scan."""
    pairs: list[Row]
    """Each pair of repeats, or each scan against the mean of its group."""
    groups: list[Row]
    """Of each scanner on each specimen: precision, and its systematic part."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Group:
    """The mean surface of a scanner on a specimen, at the places of its reference."""

    scanner: str
    specimen: str
    count: int
    mean_um: Float[np.ndarray, "p"]
    """Mean deviation; NaN where not all show it."""
    sd_um: Float[np.ndarray, "p"]
    """Standard deviation over the scans (n - 1); NaN for one scan."""


def read_measured(folder: Path, key: str) -> Measured:
    """What is kept of a scan."""
    arrays = read_arrays(folder / f"{key}.npz", remedy="delete it and run the same command again")
    return Measured(
        place_um=arrays["place_um"].astype(np.float64),
        sample_um=arrays["sample_um"].astype(np.float64),
        sample_place=arrays["sample_place"].astype(np.int64),
        record=storage.read_json(folder / f"{key}.json"),
    )


def find_common(specimen: Specimen, scans: Sequence[ScanFile], folder: Path, options: StudyOptions) -> Common:
    """What all scans of a specimen show, without those that are partial. Raises InputError where that is nothing."""
    region = region_of(specimen, options)
    shown = {scan.key: _read_shown(folder, scan.key) & region for scan in scans}
    any_shows = np.any(list(shown.values()), axis=0)
    most = max(1, int(np.sort([each.sum() for each in shown.values()])[len(shown) // 2]))
    kept, remarks = [], []
    for scan in scans:
        share = float(shown[scan.key].sum() / most)
        if share < options.min_share:
            why = f"shows {share:.0%} of what the median scan of its specimen shows (--min-share); left out"
            remarks.append(Remark(what=scan.name, why=why, left_out=True))
        else:
            kept.append(scan)
    made = [scan.scanner for scan in kept]
    for scanner in dict.fromkeys(made):
        if made.count(scanner) == 1:
            why = f"one scan of {specimen.name} alone: its precision cannot be told"
            remarks.append(Remark(what=scanner, why=why))
    common = np.all([shown[scan.key] for scan in kept], axis=0)
    if common.sum() < _LEAST_SAMPLES:
        raise InputError(
            f"specimen {specimen.name}: its scans have no surface in common in the region '{options.region}'"
        )
    share = float(common.sum() / max(any_shows.sum(), 1))
    why = f"all its {len(kept)} scans show {share:.0%} of what any of them shows; that is evaluated"
    return Common(
        places=np.asarray(common),
        asked=np.asarray(any_shows),
        scans=tuple(kept),
        remarks=(*remarks, Remark(what=f"specimen {specimen.name}", why=why)),
    )


def coverage_remarks(
    specimen_of: Callable[[str], Specimen], scans: Sequence[ScanFile], folder: Path, options: StudyOptions
) -> tuple[Remark, ...]:
    """Which scans are partial, and what all of each specimen show, without any figures."""
    remarks: list[Remark] = []
    for name in dict.fromkeys(scan.specimen for scan in scans):
        of = [scan for scan in scans if scan.specimen == name]
        try:
            remarks += find_common(specimen_of(name), of, folder, options).remarks
        except InputError as error:
            remarks.append(Remark(what=f"specimen {name}", why=str(error), left_out=True))
    return tuple(remarks)


def _read_shown(folder: Path, key: str) -> Bool[np.ndarray, "p"]:
    return np.isfinite(read_arrays(folder / f"{key}.npz", remedy="delete it and run again")["place_um"])


def region_of(specimen: Specimen, options: StudyOptions) -> Bool[np.ndarray, "p"]:
    """The places of the region that is asked for. Raises InputError where the specimen has none."""
    if options.region == "all":
        return np.ones(len(specimen.places.points), dtype=bool)
    region = specimen.crown if options.region == "crowns" else specimen.area_places
    if not region.any():
        raise InputError(f"specimen {specimen.name}: has no such region '{options.region}'; give another --region")
    return region


@dataclass(frozen=True, eq=False, kw_only=True)
class Compared:
    """A scan, finally aligned on what all scans of its specimen show."""

    scan: ScanFile
    measured: Measured
    motion: SmallMotion | None
    """Correction of the alignment; None where it is not one of the whole surface."""
    place_um: Float[np.ndarray, "p"]
    """Deviation at each place; NaN where it is not shown."""
    sample_um: Float[np.ndarray, "s"]
    """Signed distances of the samples on what is evaluated."""
    sample_place: np.ndarray
    """The place next to each of them."""
    far_pct: float
    """Share of the scan's surface over what is evaluated that is farther from it than the limit."""


def compare_scan(scan: ScanFile, folder: Path, specimen: Specimen, common: Common, options: StudyOptions) -> Compared:
    """Read a scan and align it finally: a best fit is repeated with the places that all scans show, so that gum and
    borders of one scan do not move it."""
    measured = read_measured(folder, scan.key)
    motion = None
    place_um, sample_um = measured.place_um, measured.sample_um
    if options.align == "best-fit":
        motion = best_motion(specimen.places.chosen(common.places), place_um[common.places])
        changes = motion.changes_um(specimen.places)
        place_um = place_um + changes
        sample_um = sample_um + np.where(measured.sample_place == BEYOND, 0, changes[measured.sample_place])
    over = (measured.sample_place != BEYOND) & common.places[measured.sample_place]
    near = np.abs(sample_um) <= 1000 * options.max_distance_mm
    return Compared(
        scan=scan,
        measured=measured,
        motion=motion,
        place_um=place_um,
        sample_um=sample_um[over & near],
        sample_place=measured.sample_place[over & near],
        far_pct=float(100 * np.mean(~near[over])) if over.any() else 0.0,
    )


# --- figures of a scan ------------------------------------------------------------------------------------------------


def figures(signed_um: Float[np.ndarray, "n"]) -> Row:
    """The figures of some signed distances (um)."""
    found = statistics(signed_um / 1000)
    names = ("mean_abs_um", "signed_mean_um", "std_um", "rms_um", "half_p90_p10_um", "p95_um")
    within = {f"within_{um}_um_pct": float(100 * np.mean(np.abs(signed_um) <= um)) for um in WITHIN_UM}
    return {**{name: getattr(found, name) for name in names}, **within}


def scan_row(found: Compared, common: Common) -> Row:
    """The row of a scan."""
    record = found.measured.record
    shown = found.place_um[common.places]
    asked = found.place_um[common.asked]
    back = {f"back_{name}": value for name, value in figures(shown[np.isfinite(shown)]).items()}
    spans_um = np.array([span["error_um"] for span in record["spans"]])
    nominal_mm = np.array([span["nominal_mm"] for span in record["spans"]])
    return {
        **found.scan.levels,
        **figures(found.sample_um),
        **back,
        "complete_pct": float(100 * np.mean(np.isfinite(asked))),
        **{
            f"complete_{um}_um_pct": float(100 * np.mean(np.abs(np.nan_to_num(asked, nan=np.inf)) <= um))
            for um in WITHIN_UM
        },
        "far_pct": found.far_pct,
        "similarity_scale_ppm": record["similarity_scale_ppm"],
        **_modes(record["deformation"]),
        "spans_rms_um": float(np.sqrt(np.mean(spans_um**2))) if len(spans_um) else None,
        "spans_ppm": float(1000 * nominal_mm @ spans_um / (nominal_mm @ nominal_mm)) if len(spans_um) else None,
        "faces": record["faces"],
        "unit": record["unit"],
        "file": str(found.scan.path),
        "sha256": record["sha256"],
    }


def _modes(deformation: Mapping[str, Any] | None) -> Row:
    names = {"scale": "scale_ppm", "spread": "spread_um", "lift": "lift_um", "twist": "twist_um"}
    if deformation is None:
        return {**dict.fromkeys(names.values()), "modes_rms_um": None, "remainder_um": None}
    amplitudes = deformation["amplitudes"]
    return {
        **{column: amplitudes[name] for name, column in names.items()},
        "modes_rms_um": float(np.sqrt(max(0.0, deformation["before_um"] ** 2 - deformation["remainder_um"] ** 2))),
        "remainder_um": deformation["remainder_um"],
    }


def region_rows(found: Compared, specimen: Specimen) -> list[Row]:
    """The figures of a scan on each tooth or station, surface and segment that has enough samples."""
    rows = []
    for kind, name, places in regions(specimen):
        here = found.sample_um[places[found.sample_place]]
        if len(here) >= _LEAST_SAMPLES:
            rows.append({**found.scan.levels, "kind": kind, "region": name, "samples": len(here), **figures(here)})
    return rows


def regions(specimen: Specimen) -> Iterator[tuple[str, str, Bool[np.ndarray, "p"]]]:
    """Kind, name and places of each region."""
    kind = "tooth" if specimen.labelled else "station"
    for piece in specimen.pieces:
        yield kind, specimen.piece_name(piece), specimen.piece == piece
    codes = {name: specimen.surface == SURFACES.index(name) for name in SURFACES}
    outer = {"occlusal": ("occlusal", "incisal"), "buccal": ("buccal", "labial"), "lingual": ("lingual",)}
    groups = {**outer, "interproximal": _INTERPROXIMAL, "gingival": ("gingival",)}
    for name, members in groups.items():
        places = np.any([codes[each] for each in members], axis=0)
        if places.any():
            yield "surface", name, np.asarray(places)
    if specimen.margin.any():
        yield "surface", "margin", specimen.margin
    names = SEGMENTS if specimen.arch == "upper" else SEGMENTS[::-1]
    for code, name in enumerate(names):
        if np.any(specimen.segment == code):
            yield "segment", name, specimen.segment == code
    if specimen.crown.any() and not specimen.crown.all():
        yield "segment", "crowns", specimen.crown
        yield "segment", "gum and base", ~specimen.crown


# --- precision --------------------------------------------------------------------------------------------------------


def difference_um(
    places: Places, one_um: Float[np.ndarray, "p"], other_um: Float[np.ndarray, "p"], *, align: bool
) -> Float[np.ndarray, "n"]:
    """Differences of two scans at the places that both show, after the best motion of one onto the other."""
    both = np.isfinite(one_um) & np.isfinite(other_um)
    difference = other_um[both] - one_um[both]
    if not align:
        return difference
    used = places.chosen(both)
    return np.asarray(difference + best_motion(used, difference).changes_um(used))


def precision_rows(
    group: Sequence[Compared], specimen: Specimen, common: Common, options: StudyOptions
) -> tuple[list[Row], Group]:
    """How the repeats of one scanner on one specimen agree, and their mean surface."""
    places = specimen.places.chosen(common.places)
    fields = [each.place_um[common.places] for each in group]
    stacked = np.stack(fields)
    mean_um = stacked.mean(axis=0)
    align = options.align != "none"
    rows = list(_compare(group, places, fields, mean_um, specimen, options, align=align))
    whole = np.full((2, len(common.places)), np.nan)
    whole[0, common.places] = mean_um
    if len(group) > 1:
        whole[1, common.places] = stacked.std(axis=0, ddof=1)
    first = group[0].scan
    return rows, Group(
        scanner=first.scanner, specimen=first.specimen, count=len(group), mean_um=whole[0], sd_um=whole[1]
    )


def _compare(
    group: Sequence[Compared],
    places: Places,
    fields: Sequence[Float[np.ndarray, "n"]],
    mean_um: Float[np.ndarray, "n"],
    specimen: Specimen,
    options: StudyOptions,
    *,
    align: bool,
) -> Iterator[Row]:
    first = group[0].scan
    head = {"scanner": first.scanner, "specimen": first.specimen}
    if options.precision == "mean":
        for each, field in zip(group, fields, strict=True):
            if len(group) > 1:
                values = difference_um(places, mean_um, field, align=align)
                yield {**head, "first": "mean of the group", "second": each.scan.scan, **figures(values)}
        return
    for k, m in combinations(range(len(group)), 2):
        named = {**head, "first": group[k].scan.scan, "second": group[m].scan.scan}
        if options.precision == "pairs":
            yield {**named, **figures(difference_um(places, fields[k], fields[m], align=align))}
        else:
            yield {**named, **_mesh_to_mesh(group[k], group[m], specimen, options)}


def _mesh_to_mesh(one: Compared, other: Compared, specimen: Specimen, options: StudyOptions) -> Row:
    """Two scans as meshes, aligned with each other, without the reference but for where they begin."""
    pairs = PairOptions(
        align=options.align != "none",
        registration=options.registration,
        samples=options.samples,
        max_distance_mm=options.max_distance_mm,
    )
    first, second = (_aligned_mesh(each, specimen) for each in (one, other))
    found = compare_pair(first, second, pairs, rng=np.random.default_rng([options.seed, 2]))
    names = ("mean_abs_um", "signed_mean_um", "std_um", "rms_um", "half_p90_p10_um", "p95_um")
    return {**{name: getattr(found.deviation, name) for name in names}, "common_pct": found.common_pct}


def _aligned_mesh(each: Compared, specimen: Specimen) -> Mesh:
    unit = each.measured.record["unit"]
    mesh, _ = mend_faces(storage.read_mesh(each.scan.path, unit))
    pose = Rigid3.from_matrix(np.array(each.measured.record["reference_from_scan"])) @ specimen.occlusal_from_file
    return mesh.transformed(pose if each.motion is None else each.motion.rigid @ pose)


def spread_from_mean_um(
    group: Sequence[Compared], common: Common, places: Places, *, align: bool
) -> list[float | None]:
    """The root mean square of the differences of each scan from the mean of its group, times sqrt(n / (n - 1)), as the
    mean contains the scan: what Levene's test compares."""
    count = len(group)
    if count < 2:
        return [None]
    fields = [each.place_um[common.places] for each in group]
    mean_um = np.mean(fields, axis=0)
    chosen = places.chosen(common.places)
    factor = np.sqrt(count / (count - 1))
    return [
        float(factor * np.sqrt(np.mean(difference_um(chosen, mean_um, field, align=align) ** 2))) for field in fields
    ]


def group_row(group: Sequence[Compared], found: Group, pairs: Sequence[Row], scans: Sequence[Row]) -> Row:
    """Trueness and precision of one scanner on one specimen."""
    known = np.isfinite(found.mean_um)
    mean, sd = found.mean_um[known], found.sd_um[known]
    random = float(np.mean(sd**2)) if found.count > 1 else None
    return {
        "scanner": found.scanner,
        "specimen": found.specimen,
        "scans": found.count,
        "trueness_mean_abs_um": float(np.mean([row["mean_abs_um"] for row in scans])),
        "trueness_rms_um": float(np.mean([row["rms_um"] for row in scans])),
        "precision_mean_abs_um": float(np.mean([row["mean_abs_um"] for row in pairs])) if pairs else None,
        "precision_rms_um": float(np.mean([row["rms_um"] for row in pairs])) if pairs else None,
        "repeatability_sd_um": None if random is None else float(np.sqrt(random)),
        "median_sd_um": None if random is None else float(np.median(sd)),
        "repeatability_limit_um": None if random is None else float(LIMIT_FACTOR * np.sqrt(random)),
        "systematic_rms_um": None
        if random is None
        else float(np.sqrt(max(0.0, float(np.mean(mean**2)) - random / found.count))),
    }


# --- all of a study ---------------------------------------------------------------------------------------------------


def summarise(
    specimen_of: Callable[[str], Specimen],
    by_specimen: Mapping[str, Sequence[ScanFile]],
    folder: Path,
    options: StudyOptions,
    *,
    keep: Callable[[Compared, Specimen], None],
    keep_group: Callable[[Group, Specimen], None],
    progress: Progress = silent,
) -> tuple[Tables, tuple[Remark, ...]]:
    """All tables of a study, from what is kept of its scans in a folder. ``keep`` and ``keep_group`` take each scan and
    each mean surface as it comes, for pictures."""
    tables = Tables(scans=[], regions=[], spans=[], shifts=[], pairs=[], groups=[])
    remarks: list[Remark] = []
    total, done = sum(map(len, by_specimen.values())), 0
    for name, scans in by_specimen.items():
        specimen = specimen_of(name)
        try:
            common = find_common(specimen, scans, folder, options)
        except InputError as error:
            remarks.append(Remark(what=f"specimen {name}", why=str(error), left_out=True))
            done += len(scans)
            continue
        remarks += common.remarks
        for scanner in dict.fromkeys(scan.scanner for scan in common.scans):
            group = []
            for scan in (each for each in common.scans if each.scanner == scanner):
                group.append(compare_scan(scan, folder, specimen, common, options))
                keep(group[-1], specimen)
                done += 1
                progress("figures", done, total)
            _add_group(tables, group, specimen, common, options, keep_group)
    return tables, tuple(remarks)


def _add_group(
    tables: Tables,
    group: Sequence[Compared],
    specimen: Specimen,
    common: Common,
    options: StudyOptions,
    keep_group: Callable[[Group, Specimen], None],
) -> None:
    rows = [scan_row(each, common) for each in group]
    spreads = spread_from_mean_um(group, common, specimen.places, align=options.align != "none")
    for row, spread in zip(rows, spreads, strict=True):
        row["from_mean_rms_um"] = spread
    pairs, mean = precision_rows(group, specimen, common, options)
    tables.scans.extend(rows)
    tables.pairs.extend(pairs)
    tables.groups.append(group_row(group, mean, pairs, rows))
    for each in group:
        levels = each.scan.levels
        tables.regions.extend(region_rows(each, specimen))
        tables.spans.extend({**levels, **span} for span in each.measured.record["spans"])
        tables.shifts.extend({**levels, **shift} for shift in each.measured.record["shifts"])
    keep_group(mean, specimen)
