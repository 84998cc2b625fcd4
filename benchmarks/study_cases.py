"""Jaws with errors that are known, for ``study.py``: written without the code that is to find them again.

Bends are made of finite rotations: the arch curve is a chain of short links, each turned against the one before it, and
what lies beside a link is carried along. The amplitude is reached by searching the angle. What a best fit leaves of an
error is found from the displacements themselves, by plain least squares over the whole surface.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from cuspid.geometry import lengths_along
from cuspid.model.facing import pieces_of
from cuspid.model.mesh import Mesh

Points = Float[np.ndarray, "n 3"]
Field = Callable[[Points], Points]
BESIDE_MM = 11.0
"""Surface farther beside the curve is cut away: a palate between the sides belongs to both."""
LINK = 8
"""Samples of the curve in a link: they are 0.1 mm apart."""
DENT_UM, DENT_MM = 100.0, 2.5
"""Depth and radius of the dent."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What must come back."""

    amplitudes: Mapping[str, float]
    """Of the modes: ppm, um at the ends."""
    mean_abs_um: float
    rms_um: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """A scan with a known error."""

    scan: Mesh
    truth: Truth
    dent: Float[np.ndarray, "3"] | None = None
    """Where the dent is."""


def bent(points: Points, curve: Points, mode: str, amplitude_um: float) -> Points:
    """Points moved by a bend of a bar along the curve, the middle held; ``amplitude_um``: RMS of both ends."""
    curve, unit = curve[_links(curve)], 1e-4
    for _ in range(3):  # nearly linear
        ends = _bent(curve[[0, -1]], curve, mode, unit) - curve[[0, -1]]
        reached_um = 1000 * np.sqrt(np.mean(np.sum(ends**2, axis=1)))
        unit *= abs(amplitude_um) / reached_um
    return _bent(points, curve, mode, unit * np.sign(amplitude_um))


def _links(curve: Points) -> Int[np.ndarray, "k"]:
    """Ends of links of about a millimetre, the middle of the curve among them."""
    middle = len(curve) // 2
    return np.unique([*range(middle, -1, -LINK), 0, *range(middle, len(curve), LINK), len(curve) - 1])


def _bent(points: Points, curve: Points, mode: str, rate: float) -> Points:
    """``rate``: rad per mm of curvature, or rad per mm of torsion."""
    lengths = lengths_along(curve)
    middle = int(np.argmin(np.abs(lengths - lengths[-1] / 2)))
    nearest = KDTree(curve[:, :2]).query(points[:, :2])[1]
    moved = points.copy()
    for side in (1, -1):
        turn, place = Rotation.identity(), curve[middle].copy()
        at = middle
        while 0 <= at < len(curve):
            here = nearest == at
            moved[here] = turn.apply(points[here] - curve[at]) + place
            if not 0 <= at + side < len(curve):
                break
            step = curve[at + side] - curve[at]
            length, tangent = np.linalg.norm(step), side * step / np.linalg.norm(step)
            axis = {
                "spread": np.array([0.0, 0.0, 1.0]),
                "lift": -np.cross([0.0, 0.0, 1.0], tangent),
                "twist": tangent,
            }[mode]
            half = Rotation.from_rotvec(0.5 * rate * length * side * axis)
            turn = half * turn
            place = place + turn.apply(step)
            turn = half * turn
            at += side
    return moved


def signed_twist(curve: Points, amplitude_um: float) -> float:
    """The amplitude with the sign that a positive one has: the first end of the curve rises."""
    rises = _bent(curve[[0]], curve, "twist", 1e-5)[0, 2] - curve[0, 2] > 0
    return amplitude_um if rises else -amplitude_um


def truth_of(
    mesh: Mesh, moved: Points, amplitudes: Mapping[str, float], keep: Bool[np.ndarray, "f"] | None = None
) -> Truth:
    """What a best fit leaves of displacements of the vertices, over the surface, or the faces that are kept of it, by
    plain least squares."""
    rng = np.random.default_rng(11)
    areas = mesh.face_areas if keep is None else mesh.face_areas * keep
    picks = rng.choice(len(mesh.faces), 60_000, p=areas / areas.sum())
    weights = rng.dirichlet((1, 1, 1), len(picks))
    places = np.einsum("nk,nkd->nd", weights, mesh.vertices[mesh.faces[picks]])
    shifts = np.einsum("nk,nkd->nd", weights, (moved - mesh.vertices)[mesh.faces[picks]])
    normals = mesh.face_normals[picks]
    along = 1000 * np.sum(shifts * normals, axis=1)
    rigid = np.concatenate([np.cross(places - places.mean(axis=0), normals), normals], axis=1)
    left = along - rigid @ np.linalg.lstsq(rigid, along, rcond=None)[0]
    return Truth(
        amplitudes=amplitudes,
        mean_abs_um=float(np.abs(left).mean()),
        rms_um=float(np.sqrt(np.mean(left**2))),
    )


def errors(mesh: Mesh, curve: Points, rng: np.random.Generator) -> dict[str, Case]:
    """All known errors of a jaw, by name; without rigid motions, which come later."""
    nothing = dict.fromkeys(("scale", "spread", "lift", "twist"), 0.0)
    found: dict[str, Case] = {}

    def add(
        name: str, moved: Points, amplitudes: Mapping[str, float], keep: Bool[np.ndarray, "f"] | None = None
    ) -> None:
        scan = Mesh(moved, mesh.faces) if keep is None else Mesh(moved, mesh.faces).submesh(keep)
        found[name] = Case(scan=scan, truth=truth_of(mesh, moved, {**nothing, **amplitudes}, keep))

    for name, (amplitudes, field) in fields(curve).items():
        add(name, field(mesh.vertices), amplitudes)
    told, mix = fields(curve)["mixed"]
    mixed = mix(mesh.vertices)
    noise = rng.normal(0, 0.01, len(mesh.vertices))[:, None] * mesh.vertex_normals
    add("noise 10 um", mesh.vertices + noise, nothing)
    add("mixed, noise 10 um", mixed + noise, told)
    add("smoothed", mesh.vertices + _smoothing(mesh), nothing)
    add("mixed, holes", mixed, told, _without_holes(mesh, rng))
    add("mixed, cut borders", mixed, told, _within_ragged(mesh, curve))
    found["mixed, other triangles"] = Case(scan=_remeshed(found["mixed"].scan), truth=found["mixed"].truth)
    dent, at = _dented(mesh, curve)
    found["dent 100 um"] = Case(scan=Mesh(dent, mesh.faces), truth=truth_of(mesh, dent, nothing), dent=at)
    return found


def fields(curve: Points) -> dict[str, tuple[dict[str, float], Field]]:
    """Amplitudes of smooth errors, and where they move points, by name."""
    middle = curve[len(curve) // 2]
    found: dict[str, tuple[dict[str, float], Field]] = {}
    for ppm in (-50, 200, 500):
        found[f"scale {ppm:+d} ppm"] = {"scale": float(ppm)}, partial(_scaled, middle, ppm)
    for mode in ("spread", "lift", "twist"):
        for um in (10, 200) if mode != "lift" else (-50, 200):
            found[f"{mode} {um:+d} um"] = {mode: float(um)}, partial(_bent_by, curve, ((mode, um),))
    told = {"scale": 150.0, "spread": -60.0, "lift": 120.0, "twist": 80.0}
    bends = tuple((mode, told[mode]) for mode in ("spread", "lift", "twist"))
    found["mixed"] = told, lambda points: _scaled(middle, told["scale"], _bent_by(curve, bends, points))
    return found


def _scaled(middle: Float[np.ndarray, "3"], ppm: float, points: Points) -> Points:
    return middle + (1 + 1e-6 * ppm) * (points - middle)


def _bent_by(curve: Points, bends: Sequence[tuple[str, float]], points: Points) -> Points:
    moved = points
    for mode, um in bends:
        moved = moved + bent(points, curve, mode, signed_twist(curve, um) if mode == "twist" else um) - points
    return moved


def _smoothing(mesh: Mesh) -> Points:
    """What a light Laplacian smoothing moves along the normals; borders stay."""
    smooth = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    operator = trimesh.smoothing.laplacian_calculation(smooth, equal_weight=True)
    shift = 0.15 * (operator @ mesh.vertices - mesh.vertices)
    border = trimesh.grouping.group_rows(smooth.edges_sorted, require_count=1)
    inside = np.ones(len(mesh.vertices))
    inside[smooth.edges_sorted[border]] = 0
    along = np.clip(np.sum(shift * mesh.vertex_normals, axis=1), -0.06, 0.06)
    return np.asarray((inside * along)[:, None] * mesh.vertex_normals)


def _remeshed(mesh: Mesh) -> Mesh:
    """The same surface in other triangles: each in four, in another order."""
    vertices, faces = trimesh.remesh.subdivide(mesh.vertices, mesh.faces)
    order = np.random.default_rng(3).permutation(len(faces))
    return Mesh(np.asarray(vertices), np.roll(np.asarray(faces)[order], 1, axis=1))


def _without_holes(mesh: Mesh, rng: np.random.Generator) -> Bool[np.ndarray, "f"]:
    """All but twelve holes of 1.5 mm radius."""
    middles = mesh.face_centres[rng.integers(0, len(mesh.faces), 12)]
    return np.asarray(KDTree(middles).query(mesh.face_centres)[0] > 1.5)


def _within_ragged(mesh: Mesh, curve: Points) -> Bool[np.ndarray, "f"]:
    """What lies within a ragged line at 6 to 8 mm beside the curve."""
    beside, nearest = KDTree(curve[:, :2]).query(mesh.face_centres[:, :2])
    return np.asarray(beside < 7 + np.cos(nearest / 70))


def _dented(mesh: Mesh, curve: Points) -> tuple[Points, Float[np.ndarray, "3"]]:
    """A round dent in a crown at a third of the curve, as deep as said in its middle."""
    at = mesh.vertices[KDTree(mesh.vertices).query(curve[len(curve) // 3])[1]]
    share = np.clip(1 - np.sum((mesh.vertices - at) ** 2, axis=1) / DENT_MM**2, 0, None)
    return mesh.vertices - DENT_UM / 1000 * share[:, None] * mesh.vertex_normals, at


def near_curve(mesh: Mesh, curve: Points) -> Mesh:
    """The surface near the arch, the largest piece of it."""
    near = mesh.submesh(KDTree(curve[:, :2]).query(mesh.face_centres[:, :2])[0] < BESIDE_MM)
    pieces = pieces_of(near)
    return near.submesh(pieces == np.argmax(np.bincount(pieces)))
