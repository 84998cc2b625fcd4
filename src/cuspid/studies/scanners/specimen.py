"""A specimen of a study: its reference in the occlusal frame, and what each place on it belongs to.

It is made once, kept on disk, and read by whatever process measures a scan of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from cuspid import storage
from cuspid.anatomy.crowns import crowns_of
from cuspid.anatomy.jaw_files import Labelling, arch_from_name
from cuspid.anatomy.orientation import find_occlusal_frame
from cuspid.anatomy.surfaces import SURFACES, named_surfaces
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.places import Places, scatter
from cuspid.evaluation.scan_bodies import fit_body
from cuspid.evaluation.teeth import ARCH_ORDER
from cuspid.geometry import Rigid3
from cuspid.model.arch_curve import ArchCurve, arch_curve
from cuspid.model.facing import facing_outwards
from cuspid.model.jaw import GUM, Arch, Jaw, Sphere
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import CuspidError, InputError
from cuspid.runtime.values import LONGEST_MM, number
from cuspid.runtime.workers import computed_once
from cuspid.storage import MM_PER_UNIT, MeasuredFile, Unit
from cuspid.storage.files import read_arrays, write_arrays
from cuspid.studies.scanners.files import area_file, body_file, find_beside, landmark_file
from cuspid.studies.scanners.soundness import cut_notes, first_of_each, mend_faces

PLACES = 60_000
"""Number of places on a reference."""
STATION_MM = 8.0
"""Length of the pieces of an arch that stand in for teeth where these have no labels."""
SEGMENTS = ("right", "front", "left")
"""Thirds of the arch, along the curve."""
_ON_AREA_MM = 0.05
"""A face of the reference belongs to a reference area if its centre lies this near to it."""
UNITS: tuple[Unit, ...] = get_args(Unit)
_SIZES_MM = (3.0, 300.0)
_USUAL_MM = 60.0
_LEAST_CURVE_MM = 15.0
_MARGIN_MM = 0.5
_REMEDY = "delete the folder and run cuspid study scanners again"


@dataclass(frozen=True, eq=False, kw_only=True)
class Specimen:
    """What a scan is compared with. All positions are in the occlusal frame, mm."""

    name: str
    mesh: Mesh
    occlusal_from_file: Rigid3
    places: Places
    tooth: Int[np.ndarray, "p"]
    """FDI number at each place, 0 for gum or unknown."""
    surface: Int[np.ndarray, "p"]
    """Index into `SURFACES`, -1 where there is none."""
    piece: Int[np.ndarray, "p"]
    """Tooth, or station along the arch from 1 where teeth have no labels; 0 for none."""
    segment: Int[np.ndarray, "p"]
    """Index into `SEGMENTS`, -1 without a curve."""
    crown: Bool[np.ndarray, "p"]
    """Whether it is crown."""
    margin: Bool[np.ndarray, "p"]
    """Whether a margin line of a preparation runs near."""
    area_faces: Bool[np.ndarray, "f"]
    """Faces of the reference area; none without one."""
    crown_faces: Bool[np.ndarray, "f"]
    """Faces of crowns."""
    curve: Float[np.ndarray, "c 3"]
    """The arch curve; empty where there is none."""
    spheres: Mapping[str, Sphere]
    bodies: Mapping[str, Rigid3]
    """``occlusal_from_body`` of each scan body."""
    body: Mesh | None
    """The library's scan body, in its own frame."""
    landmarks: Mapping[str, Float[np.ndarray, "3"]]
    labelled: bool
    """Whether pieces are teeth."""
    arch: Arch | None
    notes: tuple[str, ...]

    @computed_once
    def width_mm(self) -> float:
        """The largest extent of the reference."""
        return MeasuredFile(path=Path(self.name), mesh=self.mesh, unit="mm").width_mm

    @computed_once
    def reference_surface(self) -> SignedDistance:
        """Distances to the reference."""
        return SignedDistance(self.mesh)

    @computed_once
    def area_surface(self) -> SignedDistance:
        """Distances to the reference area."""
        return SignedDistance(self.mesh.submesh(self.area_faces))

    @computed_once
    def crown_surface(self) -> SignedDistance:
        """Distances to the crowns."""
        return SignedDistance(self.mesh.submesh(self.crown_faces))

    @computed_once
    def body_surface(self) -> SignedDistance | None:
        """Distances to the library's scan body."""
        return None if self.body is None else SignedDistance(self.body)

    @computed_once
    def place_tree(self) -> KDTree:
        """Of the places."""
        return KDTree(self.places.points)

    @property
    def arch_curve(self) -> ArchCurve | None:
        """The line along the crowns."""
        return ArchCurve(points=self.curve) if len(self.curve) else None

    @property
    def area_places(self) -> Bool[np.ndarray, "p"]:
        """The places of the reference area."""
        return np.asarray(self.area_faces[self.places.faces])

    def piece_name(self, piece: int) -> str:
        """What a piece is called in tables."""
        if self.labelled:
            return str(piece)
        return f"station {STATION_MM * (piece - 0.5):.0f} mm"

    @property
    def pieces(self) -> tuple[int, ...]:
        """The pieces, along the arch."""
        there = set(np.unique(self.piece[self.piece != GUM]).tolist())
        order = ARCH_ORDER if self.labelled else range(1, max(there, default=0) + 1)
        return tuple(piece for piece in order if piece in there)


def guess_unit(path: Path, mesh: Mesh, like_mm: float | None = None) -> tuple[Unit, str | None]:
    """The unit of a file whose mesh was read in mm, by its size, which is that of teeth or jaws, or nearly ``like_mm``
    where that is known; and what is odd about it. Raises InputError where no unit fits."""
    file = MeasuredFile(path=path, mesh=mesh, unit="mm")
    low, high = _SIZES_MM if like_mm is None else (like_mm / 3, like_mm * 3)
    if low <= file.width_mm <= high:
        return "mm", None
    nearest = file.unit_nearest(like_mm or _USUAL_MM)
    width_mm = file.width_in(nearest)
    if not low <= width_mm <= high:
        raise InputError(
            f"{path}: {file.width_mm:.4g} wide, which is not the size of teeth or jaws in any unit"
            + ("" if like_mm is None else f", as its reference is {like_mm:.3g} mm wide")
            + f"; divided by 25.4 it would be {file.width_mm / 25.4:.3g}; scale it to millimetres"
        )
    unit = next(each for each in UNITS if each == nearest)
    return unit, f"read in {unit}: in mm it would be {file.width_mm:.3g} mm wide, so it is {width_mm:.3g} mm"


def load_specimen(
    name: str,
    path: Path,
    *,
    unit: Unit | None = None,
    arch: Arch | None = None,
    labelling: Labelling = Labelling(),
    align_teeth: tuple[int, ...] = (),
) -> Specimen:
    """The reference of a specimen and what lies beside it. Raises InputError where it cannot be used."""
    read_in, odd = (unit, None) if unit is not None else guess_unit(path, storage.read_mesh(path))
    jaw, occlusal_from_file, notes = _load_reference(path, read_in, arch, labelling)
    mesh, mm = jaw.mesh, MM_PER_UNIT[read_in]
    area = _area_of(path, jaw, occlusal_from_file, read_in, align_teeth)
    places = scatter(mesh, PLACES, np.random.default_rng(0))
    crowns = crowns_of(jaw)
    curve, note = _curve_of(jaw)
    labels = np.zeros(len(mesh.faces), dtype=np.int64) if jaw.face_labels is None else np.asarray(jaw.face_labels)
    labelled = bool(np.unique(labels[labels != GUM]).size > 1)
    crown = crowns.faces[places.faces]
    at = _length_along(curve, places.points)
    body, bodies, missed = _bodies_of(path, mesh, occlusal_from_file, mm)
    notes = (*notes, *note, *missed) if odd is None else (odd, *notes, *note, *missed)
    return Specimen(
        name=name,
        mesh=mesh,
        occlusal_from_file=occlusal_from_file,
        places=places,
        tooth=labels[places.faces],
        surface=_surfaces_of(jaw)[places.faces] if labelled else np.full(len(places.points), -1),
        piece=labels[places.faces] if labelled else np.where(crown, _stations(at), 0),
        segment=_segments(at, curve),
        crown=np.asarray(crown),
        margin=_near_lines(jaw, places.points),
        area_faces=area,
        crown_faces=np.asarray(crowns.faces),
        curve=curve,
        spheres={**_spheres_of(path, occlusal_from_file, mm), **jaw.spheres},
        bodies=bodies,
        body=body,
        landmarks=_landmarks_of(path, jaw, occlusal_from_file, mm),
        labelled=labelled,
        arch=jaw.arch,
        notes=notes,
    )


def scan_landmarks(path: Path) -> dict[str, Float[np.ndarray, "3"]]:
    """The landmarks that lie beside a scan, in mm in its own frame; none without a file."""
    file = landmark_file(path)
    if file is None:
        return {}
    return {label: np.asarray(point.position) for label, point in storage.read_landmarks(file).landmarks.items()}


# --- what lies beside the reference -----------------------------------------------------------------------------------


def _load_reference(
    path: Path, unit: Unit, arch: Arch | None, labelling: Labelling
) -> tuple[Jaw, Rigid3, tuple[str, ...]]:
    if storage.is_jaw(path):
        return storage.read_jaw(path), Rigid3.identity(), ()
    mesh, labels, _ = storage.read_labelled_mesh(path, unit)
    keep, doubled = first_of_each(mesh)
    if doubled:
        mesh, labels = mesh.submesh(keep), None if labels is None else labels[keep]
    mesh, facing = facing_outwards(mesh)
    occlusal = find_occlusal_frame(mesh)
    upright = mesh.transformed(occlusal.occlusal_from_mesh)
    notes = (*doubled, *facing, *cut_notes(mesh), *occlusal.notes)
    arch = arch or arch_from_name(path)
    if labels is not None:
        try:
            numbered = labelling.fdi(path, labels, upright, arch=arch, sure=not occlusal.notes)
            labels, notes = numbered.labels, (*notes, *numbered.notes)
        except InputError as error:
            labels, notes = None, (*notes, f"its tooth labels are not used: {error}")
    return Jaw(mesh=upright, face_labels=labels, arch=arch), occlusal.occlusal_from_mesh, notes


def _curve_of(jaw: Jaw) -> tuple[Float[np.ndarray, "c 3"], tuple[str, ...]]:
    try:
        curve = arch_curve(jaw)
    except CuspidError as error:
        return np.empty((0, 3)), (f"no arch curve, so that modes of the arch are not told: {error}",)
    if curve.lengths_mm[-1] < _LEAST_CURVE_MM:
        return np.empty((0, 3)), (f"modes of the arch are not told of {curve.lengths_mm[-1]:.0f} mm of it",)
    return np.array(curve.points), ()


def _length_along(curve: Float[np.ndarray, "c 3"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Length along the curve at points; NaN without one."""
    if not len(curve):
        return np.full(len(points), np.nan)
    line = ArchCurve(points=curve)
    return np.asarray(line.lengths_mm[KDTree(curve[:, :2]).query(points[:, :2])[1]])


def _stations(at_mm: Float[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    return np.where(np.isnan(at_mm), 0, 1 + np.floor(np.nan_to_num(at_mm) / STATION_MM)).astype(np.int64)


def _segments(at_mm: Float[np.ndarray, "n"], curve: Float[np.ndarray, "c 3"]) -> Int[np.ndarray, "n"]:
    """Which third of the curve; it runs clockwise seen from +Z, so that it begins at -X, the patient's left of a lower
    jaw and right of an upper one."""
    if not len(curve):
        return np.full(len(at_mm), -1)
    length = ArchCurve(points=curve).lengths_mm[-1]
    return np.minimum(np.floor(3 * at_mm / length), 2).astype(np.int64)


def _surfaces_of(jaw: Jaw) -> Int[np.ndarray, "f"]:
    codes = np.full(len(jaw.mesh.faces), -1)
    for code, name in enumerate(SURFACES):
        codes[named_surfaces(jaw)[name]] = code
    return codes


def _near_lines(jaw: Jaw, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    near = np.zeros(len(points), dtype=bool)
    for line in jaw.lines.values():
        near |= KDTree(line).query(points)[0] <= _MARGIN_MM
    return near


def _area_of(
    path: Path, jaw: Jaw, occlusal_from_file: Rigid3, unit: Unit, teeth: tuple[int, ...]
) -> Bool[np.ndarray, "f"]:
    if teeth:
        lacking = sorted(set(teeth) - set(jaw.teeth))
        if lacking:
            known = ", ".join(map(str, jaw.teeth)) or "no labels"
            raise InputError(f"{path}: has no tooth {', '.join(map(str, lacking))} (FDI) to align on; it has {known}")
        return np.any([jaw.tooth_faces(fdi) for fdi in teeth], axis=0)
    file = area_file(path)
    if file is None:
        return np.zeros(len(jaw.mesh.faces), dtype=bool)
    area = _read_painted(file, unit).transformed(occlusal_from_file)
    chosen = area.closest(jaw.mesh.face_centres)[0] <= _ON_AREA_MM
    if not chosen.any():
        raise InputError(f"{file}: lies nowhere on {path}; it must be a part or a painted copy of it")
    return np.asarray(chosen)


def _read_painted(file: Path, unit: Unit) -> Mesh:
    """The painted faces of a mesh: those of another colour or label than most; all of it where nothing is painted."""
    mesh, labels, colors = storage.read_labelled_mesh(file, unit)
    if labels is None and colors is not None:
        labels = np.unique(colors, axis=0, return_inverse=True)[1].reshape(-1)
    if labels is None and mesh.colors is not None:
        number = np.unique(mesh.colors, axis=0, return_inverse=True)[1].reshape(-1)
        labels = np.median(number[mesh.faces], axis=1).astype(np.int64)
    if labels is None or np.ptp(labels) == 0:
        return mesh
    values, counts = np.unique(labels, return_counts=True)
    return mesh.submesh(labels != values[np.argmax(counts)])


def _spheres_of(path: Path, occlusal_from_file: Rigid3, mm: float) -> dict[str, Sphere]:
    file = find_beside(path, [".spheres.csv"])
    if file is None:
        return {}
    rows = storage.read_table(file, ("label", "x", "y", "z", "radius"))
    return {
        row["label"]: Sphere(
            centre=occlusal_from_file.apply(mm * _position(file, row)), radius_mm=mm * _cell(file, row, "radius")
        )
        for row in rows
    }


def _bodies_of(
    path: Path, mesh: Mesh, occlusal_from_file: Rigid3, mm: float
) -> tuple[Mesh | None, dict[str, Rigid3], tuple[str, ...]]:
    """The library body, where the reference has it, and what was not found."""
    table, library = find_beside(path, [".bodies.csv"]), body_file(path)
    if table is None or library is None:
        return None, {}, ()
    read = storage.read_mesh(library)
    unit, _ = guess_unit(library, read, like_mm=8.0)
    body, _ = mend_faces(Mesh(read.vertices * MM_PER_UNIT[unit], read.faces))
    surface = SignedDistance(body)
    found, notes = {}, []
    for row in storage.read_table(table, ("label", "x", "y", "z")):
        centre = occlusal_from_file.apply(mm * _position(table, row))
        up = np.array([0.0, 0.0, 1.0])
        if row.get("ax"):
            up = occlusal_from_file.rotate(np.array([_cell(table, row, axis) for axis in ("ax", "ay", "az")]))
        try:
            found[row["label"]] = fit_body(mesh, surface, centre, up).scan_from_body
        except InputError as error:
            notes.append(f"scan body {row['label']} is not found in the reference: {error}")
    return body, found, tuple(notes)


def _landmarks_of(path: Path, jaw: Jaw, occlusal_from_file: Rigid3, mm: float) -> dict[str, Float[np.ndarray, "3"]]:
    file = landmark_file(path)
    if file is None:
        return {label: np.asarray(point.position) for label, point in jaw.landmarks.items()}
    given = storage.read_landmarks(file)
    if given.frame == "occlusal":
        return {label: np.asarray(point.position) for label, point in given.landmarks.items()}
    return {label: occlusal_from_file.apply(mm * point.position) for label, point in given.landmarks.items()}


def _position(file: Path, row: Mapping[str, str]) -> Float[np.ndarray, "3"]:
    return np.array([_cell(file, row, axis) for axis in "xyz"])


def _cell(file: Path, row: Mapping[str, str], column: str) -> float:
    try:
        value = float(row[column])
    except ValueError as error:
        raise InputError(f"{file}: {column} of {row['label']} is no number ('{row[column]}')") from error
    return number(f"{file}: {column} of {row['label']}", value, -LONGEST_MM, LONGEST_MM)


# --- on disk ----------------------------------------------------------------------------------------------------------

_ARRAYS = ("tooth", "surface", "piece", "segment", "crown", "margin", "area_faces", "crown_faces", "curve")


def write_specimen(folder: Path, specimen: Specimen) -> None:
    """Write ``specimen.npz`` and ``specimen.json``."""
    body = specimen.body
    arrays = {
        **{name: getattr(specimen, name) for name in _ARRAYS},
        "vertices": specimen.mesh.vertices,
        "faces": specimen.mesh.faces,
        "place_points": specimen.places.points,
        "place_normals": specimen.places.normals,
        "place_faces": specimen.places.faces,
        "body_vertices": np.empty((0, 3)) if body is None else body.vertices,
        "body_faces": np.empty((0, 3), dtype=np.int64) if body is None else body.faces,
    }
    write_arrays(folder / "specimen.npz", arrays)
    storage.write_json(
        folder / "specimen.json",
        {
            "name": specimen.name,
            "occlusal_from_file": specimen.occlusal_from_file.matrix,
            "spheres": specimen.spheres,
            "bodies": {label: pose.matrix for label, pose in specimen.bodies.items()},
            "landmarks": specimen.landmarks,
            "labelled": specimen.labelled,
            "arch": specimen.arch,
            "notes": specimen.notes,
        },
    )


def read_specimen(folder: Path) -> Specimen:
    """What :func:`write_specimen` wrote. Raises InputError where it is damaged."""
    arrays = read_arrays(folder / "specimen.npz", remedy=_REMEDY)
    record: dict[str, Any] = storage.read_json(folder / "specimen.json")
    with storage.reading(folder / "specimen.json"):
        body = Mesh(arrays["body_vertices"], arrays["body_faces"]) if len(arrays["body_faces"]) else None
        return Specimen(
            name=record["name"],
            mesh=Mesh(arrays["vertices"], arrays["faces"]),
            occlusal_from_file=Rigid3.from_matrix(np.array(record["occlusal_from_file"])),
            places=Places(points=arrays["place_points"], normals=arrays["place_normals"], faces=arrays["place_faces"]),
            **{name: arrays[name] for name in _ARRAYS},
            spheres={
                label: Sphere(centre=np.array(each["centre"]), radius_mm=each["radius_mm"])
                for label, each in record["spheres"].items()
            },
            bodies={label: Rigid3.from_matrix(np.array(matrix)) for label, matrix in record["bodies"].items()},
            body=body,
            landmarks={label: np.array(position) for label, position in record["landmarks"].items()},
            labelled=record["labelled"],
            arch=record["arch"],
            notes=tuple(record["notes"]),
        )
