"""One scan of a study: aligned with its specimen, and all that is measured of its surface, which is then let go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float, Int

from cuspid import storage
from cuspid.evaluation.alignments import AlignmentKind, align_on_area, align_points
from cuspid.evaluation.deformation import Deformation, bend, fit_deformation, straighten
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.places import deviations_um
from cuspid.evaluation.registration import Alignment, RegistrationOptions, best_scale, locate_place, register
from cuspid.evaluation.scan_bodies import BodyFit, BodyOptions, fit_body
from cuspid.evaluation.spans import Station, angle_between_deg, spans
from cuspid.evaluation.spheres import SphereOptions, evaluate_spheres
from cuspid.evaluation.teeth import ScannedTooth, find_teeth
from cuspid.geometry import Rigid3, best_similarity
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SEED, SHARE, TOOTH, Options, Range
from cuspid.storage import MM_PER_UNIT
from cuspid.storage.files import write_arrays
from cuspid.studies.scanners.files import ScanFile
from cuspid.studies.scanners.soundness import cut_notes, mend_faces
from cuspid.studies.scanners.specimen import Specimen, guess_unit, scan_landmarks

Region = Literal["all", "crowns", "area"]
"""What is evaluated of what all scans of a specimen show."""
Precision = Literal["pairs", "meshes", "mean"]
"""How repeats are compared: each pair at the places of the reference, each pair mesh to mesh, or each with their mean
surface."""
_FITTED_PLACES = 20_000
"""Of the places, so many tell the modes of the arch."""
_LEAST_PIECE = 300
"""Places of a tooth or station, at least, that make it one."""
_FEW_POSES = {"anchors": 4, "targets": 1500, "candidates": 40, "finalists": 2}
"""Of a search, what suffices mostly: with all real jaws that were tried, and with halves of them."""
_SURE_OVERLAP = 0.85
"""An alignment by few poses counts where this share of the smaller surface comes to lie near the other one."""
BEYOND = -1
"""The place of a sample of a scan that lies past a border of the reference, or on another side of it."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions(Options):
    """How the scans of a study are compared."""

    align: AlignmentKind = "best-fit"
    """How scans are aligned: a global best fit; a reference area (--align-teeth, or a mesh beside the reference); the
    crowns; landmarks; spheres; scan bodies; or not at all, for files that are in one frame."""
    align_teeth: Annotated[tuple[int, ...], TOOTH] = ()
    """FDI numbers of the teeth that are the reference area."""
    region: Region = "all"
    """What is evaluated, of what all scans of a specimen show."""
    precision: Precision = "pairs"
    """How repeats are compared: each pair, at places of the reference; each pair, mesh to mesh (slower); or each with
    their mean surface."""
    max_distance_mm: Annotated[float, Range(0.01, 100)] = 1.0
    """Surface farther than this from the other one is not shown by it; its share is reported."""
    samples: Annotated[int, Range(1000, 5_000_000)] = 60_000
    """Samples on each scan, uniform by area."""
    min_overlap: Annotated[float, SHARE] = 0.6
    """A scan is taken for one of another jaw where less than this share of the smaller surface comes to lie near the
    other one."""
    min_share: Annotated[float, SHARE] = 0.5
    """A scan that shows less than this share of what any scan of its specimen shows is partial, and left out."""
    seed: Annotated[int, SEED] = 0
    """Of all random draws."""
    registration: RegistrationOptions = field(default_factory=RegistrationOptions)
    """How scans are aligned."""
    spheres: SphereOptions = field(default_factory=SphereOptions)
    """Which points belong to a sphere."""
    bodies: BodyOptions = field(default_factory=BodyOptions)
    """When a scan body counts as found."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured:
    """What is kept of a scan."""

    place_um: Float[np.ndarray, "p"]
    """Deviation at each place of the reference; NaN where the scan does not show it."""
    sample_um: Float[np.ndarray, "s"]
    """Signed distance of each sample of the scan from the reference."""
    sample_place: Int[np.ndarray, "s"]
    """The place next to it, or `BEYOND`."""
    record: Mapping[str, Any]
    """All else, as JSON knows it."""


def measure_file(scan: ScanFile, specimen: Specimen, options: StudyOptions) -> Measured:
    """Read and measure one scan. Raises InputError where it has no part in the study, and says why."""
    mesh, record = _read(scan, specimen)
    rough = _register(mesh, specimen, options)
    samples, _ = mesh.sample(options.samples, np.random.default_rng([options.seed, 1]))
    pose, parts, missed = _align(scan, mesh, samples, specimen, rough.reference_from_scan, options)
    aligned = mesh.transformed(pose)
    points = pose.apply(samples)
    against = SignedDistance(aligned)
    sample_um, sample_place, piece = _project_to_reference(points, specimen)
    place_um = deviations_um(specimen.places, against, options.max_distance_mm)
    deformation = _deformation(specimen, against, place_um)
    stations = {**_pieces(points, sample_um, piece, specimen, deformation, options), **parts}
    return Measured(
        place_um=place_um.astype(np.float32),
        sample_um=sample_um.astype(np.float32),
        sample_place=sample_place.astype(np.int32),
        record={
            **record,
            "reference_from_scan": pose.matrix,
            "overlap": rough.overlap,
            "similarity_scale_ppm": 1e6 * (rough.scale - 1),
            "notes": [*record["notes"], *rough.notes, *missed],
            "deformation": None if deformation is None else asdict(deformation),
            "spans": [asdict(span) for kind, found in _kinds(stations).items() for span in spans(kind, found)],
            "shifts": [_shift(kind, label, station) for (kind, label), station in stations.items()],
        },
    )


def write_measured(folder: Path, key: str, measured: Measured, *, made_from: str, sha256: str) -> None:
    """Write ``<key>.npz`` and, when that is complete, ``<key>.json``, with the digest of the scan's file and what
    identifies all that it was made from."""
    arrays = {name: getattr(measured, name) for name in ("place_um", "sample_um", "sample_place")}
    write_arrays(folder / f"{key}.npz", arrays)
    storage.write_json(
        folder / f"{key}.json", {"made_from": made_from, "sha256": sha256, "failure": None, **measured.record}
    )


def _read(scan: ScanFile, specimen: Specimen) -> tuple[Mesh, dict[str, Any]]:
    read = storage.read_mesh(scan.path)
    unit, odd = guess_unit(scan.path, read, like_mm=specimen.width_mm)
    mesh, mending = mend_faces(Mesh(read.vertices * MM_PER_UNIT[unit], read.faces))
    # From here on in the frame that the reference was turned into: without an alignment both stay together.
    return mesh.transformed(specimen.occlusal_from_file), {
        "unit": unit,
        "faces": len(mesh.faces),
        "area_mm2": float(mesh.face_areas.sum()),
        "notes": [*([] if odd is None else [odd]), *mending, *cut_notes(mesh)],
    }


def _register(mesh: Mesh, specimen: Specimen, options: StudyOptions) -> Alignment:
    rng, surface = np.random.default_rng([options.seed, 0]), specimen.reference_surface
    if options.align == "none":
        points, _ = mesh.sample(options.registration.samples, rng)
        scale = best_scale(points, surface, Rigid3.identity(), options.registration)
        near = np.abs(surface.closest_points(points).signed_mm) < options.registration.outlier_mm
        return Alignment(reference_from_scan=Rigid3.identity(), scale=scale, rms_um=0.0, overlap=float(near.mean()))
    found = _align_quickly(mesh, surface, options.registration) or register(
        mesh, surface, options.registration, rng=rng
    )
    if found.mirrored:
        raise InputError("a mirror image of the reference; mirror it back, or give the reference of its own specimen")
    if found.overlap < options.min_overlap:
        raise InputError(
            f"at best {found.overlap:.0%} of it lies near the reference (--min-overlap {options.min_overlap:g}); "
            f"it seems to show something else than specimen {specimen.name}"
        )
    return found


def _align_quickly(mesh: Mesh, surface: SignedDistance, options: RegistrationOptions) -> Alignment | None:
    """An alignment by few poses, where nothing about it is in doubt."""
    given = options.search
    search = replace(given, **{name: min(getattr(given, name), most) for name, most in _FEW_POSES.items()})
    try:
        found = register(mesh, surface, replace(options, search=search), rng=np.random.default_rng(0))
    except InputError:
        return None
    return None if found.notes or found.overlap < _SURE_OVERLAP else found


Parts = dict[tuple[str, str], Station]


def _align(
    scan: ScanFile,
    mesh: Mesh,
    samples: Float[np.ndarray, "s 3"],
    specimen: Specimen,
    rough: Rigid3,
    options: StudyOptions,
) -> tuple[Rigid3, Parts, list[str]]:
    """The alignment that was asked for, the parts (landmarks, spheres, bodies) in the aligned scan, and which of them
    were not found."""
    parts, missed = _parts(scan, mesh, specimen, rough, options)
    pose = _pose(samples, specimen, rough, parts, options)
    moved = {
        name: Station(nominal=part.nominal, measured=pose @ part.measured, has_axes=part.has_axes, axis=part.axis)
        for name, part in parts.items()
    }
    return pose, moved, missed


def _pose(
    samples: Float[np.ndarray, "s 3"], specimen: Specimen, rough: Rigid3, parts: Parts, options: StudyOptions
) -> Rigid3:
    kind = options.align
    if kind in ("best-fit", "none"):
        return rough
    if kind in ("area", "crowns"):
        faces = specimen.area_faces if kind == "area" else specimen.crown_faces
        if not faces.any():
            what = "reference area (--align-teeth, or <specimen>.area.ply)" if kind == "area" else "crowns"
            raise InputError(f"specimen {specimen.name} has no {what} to align on")
        surface = specimen.area_surface if kind == "area" else specimen.crown_surface
        return align_on_area(samples, surface, rough, options.registration)
    chosen = {label: part for (of, label), part in parts.items() if of == kind}
    return align_points(
        {label: part.measured.translation for label, part in chosen.items()},
        {label: part.nominal.translation for label, part in chosen.items()},
        kind,
    )


def _parts(
    scan: ScanFile, mesh: Mesh, specimen: Specimen, rough: Rigid3, options: StudyOptions
) -> tuple[Parts, list[str]]:
    """Landmarks, spheres and scan bodies, in the frame of the scan as it was read."""
    found: Parts = {}
    missed: list[str] = []
    for label, position in _given_landmarks(scan, specimen).items():
        if label in specimen.landmarks:
            found["landmarks", label] = _point(specimen.landmarks[label], position)
    if specimen.spheres:
        reference = Jaw(mesh=specimen.mesh, spheres=specimen.spheres)
        report = evaluate_spheres(mesh, reference, rough, options.spheres)
        for label, sphere in report.spheres.items():
            found["spheres", label] = _point(specimen.spheres[label].centre, sphere.centre)
        missed += [f"sphere {label}: {reason}" for label, reason in report.not_measured.items()]
    for label, body in _fit_bodies(mesh, specimen, rough, options, missed).items():
        nominal = specimen.bodies[label]
        found["bodies", label] = Station(nominal=nominal, measured=body.scan_from_body, axis=(0.0, 0.0, 1.0))
    return found, missed


def _given_landmarks(scan: ScanFile, specimen: Specimen) -> dict[str, Float[np.ndarray, "3"]]:
    given = scan_landmarks(scan.path) if specimen.landmarks else {}
    return {label: specimen.occlusal_from_file.apply(position) for label, position in given.items()}


def _fit_bodies(
    mesh: Mesh, specimen: Specimen, rough: Rigid3, options: StudyOptions, missed: list[str]
) -> dict[str, BodyFit]:
    found: dict[str, BodyFit] = {}
    library = specimen.body_surface
    if library is None:
        return found
    middle, scan_from_reference = library.mesh.bounds.mean(axis=0), rough.inverse()
    for label, nominal in specimen.bodies.items():
        expected = scan_from_reference @ nominal
        try:
            found[label] = fit_body(
                mesh, library, expected.apply(middle), expected.rotate(np.array([0.0, 0.0, 1.0])), options.bodies
            )
        except InputError as error:
            missed.append(f"scan body {label}: {error}")
    return found


def _point(nominal: Float[np.ndarray, "3"], measured: Float[np.ndarray, "3"]) -> Station:
    return Station(nominal=Rigid3(np.eye(3), nominal), measured=Rigid3(np.eye(3), measured), has_axes=False)


def _project_to_reference(
    points: Float[np.ndarray, "s 3"], specimen: Specimen
) -> tuple[Float[np.ndarray, "s"], Int[np.ndarray, "s"], Int[np.ndarray, "s"]]:
    """Signed distances of samples (um), the place next to each, and the piece that it is on."""
    closest = specimen.reference_surface.closest_points(points)
    on_surface = points - closest.signed_mm[:, None] * closest.directions
    place = np.asarray(specimen.place_tree.query(on_surface)[1])
    beyond = closest.on_border
    piece = np.where(beyond, 0, specimen.piece[place])
    return 1000 * closest.signed_mm, np.where(beyond, BEYOND, place), piece


def _pieces(
    points: Float[np.ndarray, "s 3"],
    sample_um: Float[np.ndarray, "s"],
    piece: Int[np.ndarray, "s"],
    specimen: Specimen,
    deformation: Deformation | None,
    options: StudyOptions,
) -> Parts:
    """Teeth, or stations along the arch, as rigid parts of a scan that its modes are taken out of: a bend within a part
    would shift its rigid fit."""
    used = (np.abs(sample_um) < 1000 * options.max_distance_mm) & (piece != GUM)
    places = {each: specimen.places.points[specimen.piece == each] for each in specimen.pieces}
    centroids = {each: at.mean(axis=0) for each, at in places.items() if len(at) >= _LEAST_PIECE}
    curve = specimen.arch_curve
    straight = points[used]
    if curve is not None and deformation is not None:
        straight = straighten(curve, deformation.amplitudes, straight)
    found = find_teeth(
        straight, piece[used], centroids, specimen.reference_surface, options.registration, order=specimen.pieces
    )
    kind = "teeth" if specimen.labelled else "stations"
    return {
        (kind, specimen.piece_name(each)): _station_of(tooth, places[each], specimen, deformation)
        for each, tooth in found.items()
    }


def _station_of(
    tooth: ScannedTooth, places: Float[np.ndarray, "n 3"], specimen: Specimen, deformation: Deformation | None
) -> Station:
    """Where a part lies in the scan: its own motion first, then what the modes do to it there."""
    centroid, pose, curve = tooth.centroid, tooth.reference_from_scan, specimen.arch_curve
    middle = locate_place(tooth.points, specimen.reference_surface, pose, centroid)
    measured = Rigid3(pose.inverse().rotation, middle)
    if curve is not None and deformation is not None:
        moved = middle + measured.rotate(places - centroid)
        bent = bend(curve, deformation.amplitudes, moved)
        _, turn, _ = best_similarity(moved, bent)
        measured = Rigid3(turn @ measured.rotation, bent.mean(axis=0))
    return Station(nominal=Rigid3(np.eye(3), centroid), measured=measured)


def _kinds(stations: Mapping[tuple[str, str], Station]) -> dict[str, dict[str, Station]]:
    kinds: dict[str, dict[str, Station]] = {}
    for (kind, label), station in stations.items():
        kinds.setdefault(kind, {})[label] = station
    return kinds


def _shift(kind: str, label: str, station: Station) -> dict[str, Any]:
    """Where a part lies in the aligned scan, against the reference."""
    offset_um = 1000 * (station.measured.translation - station.nominal.translation)
    return {
        "kind": kind,
        "label": label,
        "shift_um": float(np.linalg.norm(offset_um)),
        **{f"shift_{axis}_um": float(value) for axis, value in zip("xyz", offset_um, strict=True)},
        "axis_deg": _axis_deg(station),
    }


def _axis_deg(station: Station) -> float | None:
    if not station.has_axes:
        return None
    if station.axis is None:
        return (station.measured @ station.nominal.inverse()).angle_deg
    axis = np.array(station.axis)
    return angle_between_deg(station.measured.rotate(axis), station.nominal.rotate(axis))


def _deformation(specimen: Specimen, scan: SignedDistance, place_um: Float[np.ndarray, "p"]) -> Deformation | None:
    """The modes of the arch, fitted to places on crowns that the scan shows, or on all surface without any."""
    curve = specimen.arch_curve
    if curve is None:
        return None
    asked = np.isfinite(place_um) & (specimen.crown if specimen.crown.any() else True)
    chosen = np.flatnonzero(asked)
    thinned = np.zeros(len(asked), dtype=bool)
    thinned[chosen[:: max(1, len(chosen) // _FITTED_PLACES)]] = True
    return fit_deformation(specimen.places.chosen(thinned), curve, scan)
