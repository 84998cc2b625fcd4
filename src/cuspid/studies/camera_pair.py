"""Two cameras over a tooth: what baseline, angle of the axes and distance buy (thesis 3.4, Fig 3.10).

Three things decide how well a pair reconstructs a surface, and they pull in different directions. They are reported
apart and together:

- the *bound*: with constant noise in the images, a longer baseline triangulates more precisely (Eq 3.9);
- *co-visibility*: what both cameras see at once, of a surface with cusps, within their fields of view;
- *matching*: the noise grows where the two images show the surface differently, and in the end there is no match
  (`MATCHING`, measured on rendered pairs by :mod:`cuspid.studies.matching_noise`).

Pair frame: origin midway between the projection centres, +X along the baseline, +Z where the pair looks. Each camera is
turned inwards by half the *axis angle*; the *convergence* is the angle between its rays to the target.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from types import MappingProxyType
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.anatomy.surfaces import named_surfaces, tooth_axes
from cuspid.geometry import Rigid3
from cuspid.handpiece.precision import (
    NoiseModel,
    bound_rms_um,
    deformation,
    fisher_information,
    noise_px,
)
from cuspid.handpiece.presets import PRESETS
from cuspid.model.camera import Camera
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import MountedCamera, Rig
from cuspid.model.visibility import VisibilityOptions, visible_faces
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import TOOTH, Options, Range
from cuspid.runtime.progress import Progress, silent

Direction = Literal["across", "along"]
"""How the baseline lies: across the arch (for a side of a tooth: up and down), or along it."""
Row = dict[str, str | float | bool | None]

Matcher = Literal["slanted", "upright"]
"""Whose noise counts: the refinement of this program, whose window turns with the surface, or a window that is only
shifted, as plain correlation does."""


@dataclass(frozen=True, kw_only=True)
class MatchingLaw:
    """What becomes of points that two images show differently."""

    noise: NoiseModel
    """Of a point that is matched."""
    largest_deformation: float | None = None
    """From here on most points find no match, and count as not matched; None: there is no such limit."""


MATCHING: Mapping[Matcher, MatchingLaw] = MappingProxyType(
    {
        "slanted": MatchingLaw(noise=NoiseModel(sigma_px=0.048, deformation=0.52)),
        "upright": MatchingLaw(noise=NoiseModel(sigma_px=0.040, deformation=0.055), largest_deformation=0.9),
    }
)
"""Measured on rendered pairs of the textured phantom (:mod:`cuspid.studies.matching_noise`, docs/precision.md)."""
_FACED = ("occlusal", "buccal", "lingual")
_ANY_DEPTH_MM = (1e-3, 1e3)
_CLEARANCE_MM = 0.3
"""A projection centre nearer to the jaw than this is in the way of the tooth."""


@dataclass(frozen=True, kw_only=True)
class CameraPairOptions(Options):
    """The grid of pairs and how they are evaluated."""

    tooth: Annotated[int, TOOTH] = 47
    """FDI number of the tooth."""
    facing: tuple[str, ...] = _FACED
    """Surfaces that the pair faces perpendicularly, each in turn: occlusal, buccal, lingual."""
    direction: Direction = "across"
    """Direction of the baseline."""
    baselines_mm: Annotated[tuple[float, ...], Range(0.01, 1000)] = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
    """Distances between the projection centres."""
    axis_angles_deg: Annotated[tuple[float, ...], Range(-179, 179)] = (0.0, 10.0, 20.0, 30.0, 40.0)
    """Angles between the optical axes; positive turns the cameras towards each other."""
    distances_mm: Annotated[tuple[float, ...], Range(0.1, 1000)] = tuple(map(float, range(3, 14)))
    """Distances from the middle of the pair to the middle of the surface."""
    sensor: str = "thesis"
    """Name of the optics (a preset), of which image size and angle of view are used."""
    matcher: Matcher = "slanted"
    """Matcher whose noise is assumed."""
    visibility: VisibilityOptions = field(default_factory=VisibilityOptions)
    """When a face counts as seen by a camera; both must see it."""
    budget_um: Annotated[float, Range(0.001, 100_000)] = 10.0
    """RMS error that a point may have at most."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.baselines_mm and self.distances_mm and self.axis_angles_deg):
            raise InputError("camera pair: baselines, distances and axis angles must be given")
        if not self.facing or set(self.facing) - set(_FACED):
            raise InputError(f"camera pair: it can face {', '.join(_FACED)}, not {', '.join(self.facing) or 'nothing'}")
        if self.sensor not in PRESETS:
            raise InputError(f"camera pair: unknown sensor {self.sensor!r}; choose one of {', '.join(PRESETS)}")


def camera_pair(baseline_mm: float, axis_angle_deg: float, camera: Camera) -> Rig:
    """Two equal cameras, ``left`` and ``right``, in the pair frame."""
    return Rig(
        {
            name: _toed_in_camera(side * baseline_mm / 2, -side * axis_angle_deg / 2, camera)
            for name, side in (("left", -1), ("right", 1))
        }
    )


def _toed_in_camera(x_mm: float, yaw_deg: float, camera: Camera) -> MountedCamera:
    """A camera at (x, 0, 0) whose axis is turned from +Z towards +X by an angle."""
    rotation = Rigid3.from_rotation_vector(np.array([0.0, -np.deg2rad(yaw_deg), 0.0]), np.zeros(3)).rotation
    return MountedCamera(camera, Rigid3(rotation, -rotation @ np.array([x_mm, 0.0, 0.0])))


def convergence_deg(baseline_mm: float, distance_mm: float) -> float:
    """Angle between the rays of a pair to a target straight ahead."""
    return float(np.rad2deg(2 * np.arctan(baseline_mm / (2 * distance_mm))))


def pose_facing(
    mesh: Mesh, surface: Bool[np.ndarray, "f"], baseline_along: Float[np.ndarray, "3"], distance_mm: float
) -> Rigid3:
    """``pair_from_world`` of a pair that looks squarely at the middle of a surface, along its mean normal."""
    target = mesh.centroid(surface)
    axis = -mesh.face_cross[surface].sum(axis=0)
    axis /= np.linalg.norm(axis)
    right = baseline_along - (baseline_along @ axis) * axis
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(axis, right), axis])
    return Rigid3(rotation, -rotation @ (target - distance_mm * axis))


def tooth_surfaces(jaw: Jaw, tooth: int) -> dict[str, Bool[np.ndarray, "f"]]:
    """Masks of the named surfaces that a tooth has."""
    faces = jaw.tooth_faces(tooth)
    masks = {name: mask & faces for name, mask in named_surfaces(jaw).items()}
    return {name: mask for name, mask in masks.items() if mask.any()}


def baseline_axis(jaw: Jaw, tooth: int, surface: str, direction: Direction) -> Float[np.ndarray, "3"]:
    """Unit vector of the jaw along which the baseline lies, before it is made square to the view."""
    distal, outward, occlusal = tooth_axes(jaw)[tooth]
    if direction == "along":
        return distal
    return outward if surface in ("occlusal", "incisal") else occlusal


def study_camera_pair(
    jaw: Jaw,
    options: CameraPairOptions = CameraPairOptions(),
    progress: Progress = silent,
) -> tuple[Row, ...]:
    """One row for each surface faced, baseline, angle and distance, and for each named surface of the tooth.

    Of a row: ``bound_centre_um`` is the bound at the target, were it seen; ``seen_pct`` the share of the surface that
    both cameras see, ``matched_pct`` that of it which finds a match; ``bound_*_um`` are root mean square and median
    over what is seen of the bound with constant noise, ``noise_growth`` is the RMS factor by which matching there is
    noisier; ``expected_*_um`` are those of the bound with that noise, over what is matched; ``within_budget_pct`` is
    the share of the whole surface that is matched and expected within the budget. None where nothing is seen or
    matched; ``in_tissue`` says that a camera would touch the jaw, and then nothing is seen.

    Raises InputError where the jaw lacks the tooth, or the tooth a surface to face.
    """
    tooth = _tooth(jaw, options)
    cases = list(product(options.facing, options.baselines_mm, options.axis_angles_deg, options.distances_mm))
    rows: list[Row] = []
    for done, case in enumerate(cases, start=1):
        rows += _evaluate(jaw.mesh, tooth, options, *case)
        progress("camera pairs", done, len(cases))
    return tuple(rows)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Tooth:
    """What is looked at."""

    surfaces: Mapping[str, Bool[np.ndarray, "f"]]
    baseline_along: Mapping[str, Float[np.ndarray, "3"]]
    """For each surface faced."""
    faces: Int[np.ndarray, "m"]
    """Those of any surface."""


def _tooth(jaw: Jaw, options: CameraPairOptions) -> _Tooth:
    surfaces = tooth_surfaces(jaw, options.tooth)
    missing = [name for name in options.facing if name not in surfaces]
    if missing:
        raise InputError(
            f"camera pair: tooth {options.tooth} has no {missing[0]} surface; it has {', '.join(surfaces)}"
        )
    return _Tooth(
        surfaces=surfaces,
        baseline_along={name: baseline_axis(jaw, options.tooth, name, options.direction) for name in options.facing},
        faces=np.flatnonzero(np.any(list(surfaces.values()), axis=0)),
    )


def _evaluate(
    mesh: Mesh,
    tooth: _Tooth,
    options: CameraPairOptions,
    faced: str,
    baseline_mm: float,
    axis_angle_deg: float,
    distance_mm: float,
) -> list[Row]:
    """The rows of one pair."""
    law = MATCHING[options.matcher]
    pose = pose_facing(mesh, tooth.surfaces[faced], tooth.baseline_along[faced], distance_mm)
    cameras = tuple(camera_pair(baseline_mm, axis_angle_deg, PRESETS[options.sensor].camera).cameras.values())
    in_tissue = _touches(mesh, pose, cameras)
    faces = tooth.faces[:0] if in_tissue else _seen_by_all(mesh, pose, cameras, options.visibility, tooth.faces)
    constant = NoiseModel(sigma_px=law.noise.sigma_px)
    target = np.array([[0.0, 0.0, distance_mm]])
    common: Row = {
        "pose_facing": faced,
        "baseline_mm": baseline_mm,
        "axis_angle_deg": axis_angle_deg,
        "distance_mm": distance_mm,
        "convergence_deg": convergence_deg(baseline_mm, distance_mm),
        "in_tissue": in_tissue,
        "bound_centre_um": float(bound_rms_um(fisher_information(cameras, target, constant))[0]),
    }
    points, normals = pose.apply(mesh.face_centres[faces]), pose.rotate(mesh.face_normals[faces])
    figures = _figures(cameras, faces, points, normals, law)
    return [
        {**common, "surface": name, **figures.summarise(mask, mesh.face_areas, options.budget_um)}
        for name, mask in tooth.surfaces.items()
    ]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Figures:
    """What holds for each face that both cameras see."""

    faces: Int[np.ndarray, "n"]
    matched: Bool[np.ndarray, "n"]
    bound_um: Float[np.ndarray, "n"]
    expected_um: Float[np.ndarray, "n"]
    growth: Float[np.ndarray, "n"]

    def summarise(self, surface: Bool[np.ndarray, "f"], areas_mm2: Float[np.ndarray, "f"], budget_um: float) -> Row:
        """Shares and means over one surface."""
        inside = surface[self.faces]
        matched = inside & self.matched
        good = matched & (self.expected_um <= budget_um)
        areas, whole = areas_mm2[self.faces], areas_mm2[surface].sum()
        return {
            "seen_pct": float(100 * areas[inside].sum() / whole),
            "matched_pct": float(100 * areas[matched].sum() / whole),
            "bound_rms_um": _rms(self.bound_um[inside], areas[inside]),
            "bound_median_um": _median(self.bound_um[inside], areas[inside]),
            "noise_growth": _rms(self.growth[inside], areas[inside]),
            "expected_rms_um": _rms(self.expected_um[matched], areas[matched]),
            "expected_median_um": _median(self.expected_um[matched], areas[matched]),
            "within_budget_pct": float(100 * areas[good].sum() / whole),
        }


def _figures(
    cameras: tuple[MountedCamera, ...],
    faces: Int[np.ndarray, "n"],
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    law: MatchingLaw,
) -> _Figures:
    """The figures at points of the pair frame."""
    seen = np.ones((2, len(faces)), dtype=bool)
    growth = noise_px(cameras, points, law.noise, seen, normals=normals) / law.noise.sigma_px
    constant = NoiseModel(sigma_px=law.noise.sigma_px)
    limit = np.inf if law.largest_deformation is None else law.largest_deformation
    return _Figures(
        faces=faces,
        matched=deformation(cameras, points, normals, seen)[0] < limit,
        bound_um=bound_rms_um(fisher_information(cameras, points, constant)),
        expected_um=bound_rms_um(fisher_information(cameras, points, law.noise, normals=normals)),
        growth=np.sqrt((growth**2).mean(axis=0)),
    )


def _rms(values: Float[np.ndarray, "n"], weights: Float[np.ndarray, "n"]) -> float | None:
    return float(np.sqrt(np.average(values**2, weights=weights))) if len(values) else None


def _median(values: Float[np.ndarray, "n"], weights: Float[np.ndarray, "n"]) -> float | None:
    if not len(values):
        return None
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(below, below[-1] / 2)])


def _seen_by_all(
    mesh: Mesh,
    pose: Rigid3,
    cameras: Sequence[MountedCamera],
    options: VisibilityOptions,
    faces: Int[np.ndarray, "m"],
) -> Int[np.ndarray, "n"]:
    """Those of the faces that every camera sees, at whatever depth."""
    for mounted in cameras:
        faces = visible_faces(mesh, mounted.camera, mounted.cam_from_rig @ pose, _ANY_DEPTH_MM, options, faces)
    return faces


def _touches(mesh: Mesh, pose: Rigid3, cameras: Sequence[MountedCamera]) -> bool:
    """True where a projection centre lies inside the jaw or hardly off it."""
    world_from_pair = pose.inverse()
    centres = world_from_pair.apply(np.array([mounted.centre_in_rig for mounted in cameras]))
    axes = world_from_pair.rotate(np.array([mounted.axis_in_rig for mounted in cameras]))
    hits = mesh.cast(centres, axes)
    inside = (hits.faces >= 0) & (np.sum(mesh.face_normals[hits.faces] * axes, axis=1) > 0)
    return bool(inside.any() or (mesh.closest(centres)[0] < _CLEARANCE_MM).any())


# --- Which setting is best --------------------------------------------------------------------------------------------

Term = Literal["bound_centre_um", "seen_pct", "expected_rms_um", "within_budget_pct"]


def best_pairs(
    rows: Sequence[Row], term: Term = "within_budget_pct", by: Sequence[str] = ("distance_mm",)
) -> list[Row]:
    """For each surface faced, evaluated on itself, and each value of ``by``: the row that is best in one term.

    More is better of what is a share, less of what is an error.
    """
    sign = 1 if term.endswith("_pct") else -1
    groups: dict[tuple[object, ...], list[Row]] = {}
    for row in rows:
        if row["surface"] == row["pose_facing"] and row[term] is not None:
            groups.setdefault((row["pose_facing"], *(row[name] for name in by)), []).append(row)
    return [max(group, key=lambda row: sign * float(row[term] or 0.0)) for group in groups.values()]


def table(
    rows: Sequence[Row], faced: str, column: str, axes: tuple[str, str] = ("baseline_mm", "distance_mm"), **fixed: float
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "n"], Float[np.ndarray, "m n"]]:
    """Values on both axes and a column over them, for a surface faced and evaluated on itself; NaN where unknown."""
    chosen = [
        row
        for row in rows
        if row["surface"] == row["pose_facing"] == faced and all(row[name] == value for name, value in fixed.items())
    ]
    places = np.array([[float(row[name] or 0.0) for name in axes] for row in chosen]).reshape(-1, 2)
    first, at_first = np.unique(places[:, 0], return_inverse=True)
    second, at_second = np.unique(places[:, 1], return_inverse=True)
    values = np.full((len(first), len(second)), np.nan)
    known = [np.nan if row[column] is None else float(row[column] or 0.0) for row in chosen]
    values[at_first, at_second] = known
    return first, second, values
