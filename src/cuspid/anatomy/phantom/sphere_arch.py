"""The sphere arch: a horseshoe with a sphere at each tooth position, to measure a scanner by.

Frame: the occlusal frame of `cuspid.model.jaw`, mm. The spheres stand on the mean arch form, the beta function of S.
Braun, W. P. Hnat, D. E. Fender and H. L. Legan, *The form of the human dental arch* (Angle Orthod. 68, 1998): with W
the width between the second molars and D the depth of the arch,

    y = 3.0314 D (1/2 + x/W)^0.8 (1/2 - x/W)^0.8

with canines and molars as wide apart as those of `ARCH_FORMS`, and the others evenly between them. Each sphere is sunk
in a ridge so that more than its upper half is free, and no two touch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import trimesh
from jaxtyping import Float, Int
from manifold3d import Error, Manifold, Mesh64, OpType
from scipy.interpolate import CubicSpline

from cuspid.anatomy.teeth.dentition import ARCH_FORMS, ArchForm
from cuspid.geometry import lengths_along
from cuspid.model.jaw import GUM, Arch, Jaw, Sphere
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

_POSITIONS = 7
"""Spheres of a quadrant."""
_LEAST_GAP_MM = 0.5
"""Neighbouring spheres are at least this far apart."""
_RIDGE_MARGIN_MM = 0.5
"""The ridge is wider than the circle where a sphere meets it, by this much on either side."""
_RIDGE_STEP_MM = 0.5
"""Length of the straight pieces of the ridge."""
_RIDGE_EDGE_MM = 0.5
"""Longest edge of the ridge's faces, short enough for a face to be seen as a whole or not at all."""
_ICOSAHEDRON_EDGE = 4 / np.sqrt(10 + 2 * np.sqrt(5))
"""Edge of an icosahedron in a unit sphere."""
_LONGEST_EDGE = 1.26
"""The longest edge of a finely divided icosphere, as a multiple of the icosahedron's over the number of divisions."""


@dataclass(frozen=True, kw_only=True)
class SphereArchOptions(Options):
    """Size of the sphere arch, and how finely it is meshed."""

    radius_mm: Annotated[float, Range(0.1, 20)] = 2.5
    """Radius of the spheres."""
    edge_mm: Annotated[float, Range(0.01, 5)] = 0.11
    """Longest edge of the spheres' faces. A face lies at most edge^2 / (6 radius) inside the sphere: 0.8 um."""
    rise_mm: Annotated[float, Range(0, 20)] = 1.25
    """Height of the centres above the ridge: 0 exposes a hemisphere, the radius the whole sphere but a point."""
    depth_mm: Annotated[float, Range(1, 200)] = 41.0
    """Depth of the arch form, from the front to the line between the second molars (chosen, not measured)."""
    spee_mm: Annotated[float, Range(-20, 20)] = 1.5
    """Depth of the curve of Spee that the centres follow, so that they are not coplanar."""
    ridge_mm: Annotated[float, Range(0.1, 100)] = 8.0
    """Height of the ridge below the foot of the lowest sphere."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.rise_mm < self.radius_mm:
            raise InputError(
                f"sphere arch: --rise-mm is {self.rise_mm:g}; it must be below the radius, {self.radius_mm:g} mm, so "
                "that the ridge holds the spheres"
            )

    @property
    def free_polar_deg(self) -> float:
        """How far down the spheres are free, as an angle from the occlusal direction."""
        return float(np.rad2deg(np.arccos(-self.rise_mm / self.radius_mm)))


def build_sphere_arch(arch: Arch = "lower", options: SphereArchOptions = SphereArchOptions()) -> Jaw:
    """The watertight sphere arch: faces of the sphere at a tooth position carry its FDI number, the ridge 0.

    ``Jaw.spheres`` holds the centres and radii by FDI number. Raises InputError where the spheres would touch.
    """
    spheres = place_spheres(arch, options)
    ball = _ball(options)
    parts: dict[int, Manifold] = {GUM: _ridge(options, np.array([sphere.centre for sphere in spheres.values()]))}
    for label, sphere in spheres.items():
        parts[int(label)] = ball.translate(tuple(sphere.centre))
    mesh, labels = _union(parts)
    return Jaw(mesh=mesh, face_labels=labels, arch=arch, spheres=spheres)


# --- where the spheres are ----------------------------------------------------------------------------------------


def place_spheres(arch: Arch, options: SphereArchOptions) -> dict[str, Sphere]:
    """The spheres by FDI number, from the second molar at X < 0 round to the one at X > 0; their tops level on average.

    Raises InputError where two would touch.
    """
    side = _quadrant(ARCH_FORMS[arch], options.depth_mm)
    xy = np.concatenate([side[::-1] * [-1, 1], side])
    gap = np.linalg.norm(np.diff(xy, axis=0), axis=1).min() - 2 * options.radius_mm
    if gap < _LEAST_GAP_MM:
        raise InputError(
            f"sphere arch: spheres of {options.radius_mm:g} mm radius would be {gap:.2f} mm apart, less than "
            f"{_LEAST_GAP_MM:g} mm; choose a smaller radius_mm"
        )
    quadrants = {"lower": (30, 40), "upper": (10, 20)}[arch]
    numbers = [quadrants[0] + k for k in range(_POSITIONS, 0, -1)] + [quadrants[1] + k + 1 for k in range(_POSITIONS)]
    z = (1 if arch == "upper" else -1) * _spee(xy[:, 1], options.spee_mm) - options.radius_mm
    centres = np.column_stack([xy - xy.mean(axis=0), z])
    return {str(fdi): Sphere(centre, options.radius_mm) for fdi, centre in zip(numbers, centres, strict=True)}


def _quadrant(form: ArchForm, depth_mm: float) -> Float[np.ndarray, "7 2"]:
    """Places of one side from the midline backwards: canine and molars by their widths, the others evenly between."""
    width = form.inter_second_molar_mm
    line = _beta_form(width, depth_mm)
    length = lengths_along(line)
    canine, first, second = np.interp(
        [form.inter_canine_mm / 2, form.inter_first_molar_mm / 2, width / 2], line[:, 0], length
    )
    at = [canine / 5, canine * 3 / 5, canine, *np.linspace(canine, first, 4)[1:], second]
    return np.column_stack([np.interp(at, length, column) for column in line.T])


def _beta_form(width_mm: float, depth_mm: float) -> Float[np.ndarray, "n 2"]:
    """The arch form from the midline to X = W/2, finely sampled where it bends."""
    x = width_mm / 2 * np.sin(np.linspace(0, np.pi / 2, 20_001))
    y = 3.0314 * depth_mm * np.maximum(0.25 - (x / width_mm) ** 2, 0) ** 0.8
    return np.column_stack([x, y])


def _spee(y: Float[np.ndarray, "n"], depth_mm: float) -> Float[np.ndarray, "n"]:
    """Height of the curve of Spee, level on average."""
    u = (y - y.min()) / np.ptp(y)
    z = depth_mm * 4 * u * (1 - u)
    return np.asarray(z - z.mean())


# --- solids -------------------------------------------------------------------------------------------------------


def _ball(options: SphereArchOptions) -> Manifold:
    """A sphere about the origin with its vertices on the sphere."""
    ratio = _LONGEST_EDGE * _ICOSAHEDRON_EDGE * options.radius_mm / options.edge_mm
    ball = trimesh.creation.icosphere(subdivisions=max(0, int(np.ceil(np.log2(ratio)))), radius=options.radius_mm)
    return _solid(np.asarray(ball.vertices), np.asarray(ball.faces))


def _ridge(options: SphereArchOptions, centres: Float[np.ndarray, "n 3"]) -> Manifold:
    """A ridge with a flat underside along the spheres, its top `rise_mm` below their centres."""
    half = np.sqrt(options.radius_mm**2 - options.rise_mm**2) + _RIDGE_MARGIN_MM
    line = _extend_line(_interpolate_line(centres), half)
    tangents = np.gradient(line[:, :2], axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    outwards = np.column_stack([-tangents[:, 1], tangents[:, 0], np.zeros(len(line))])
    top = line - [0, 0, options.rise_mm]
    foot = np.array([1.0, 1.0, 0.0]) * line + [0, 0, centres[:, 2].min() - options.radius_mm - options.ridge_mm]
    rings = np.stack(
        [top + half * outwards, top - half * outwards, foot - half * outwards, foot + half * outwards], axis=1
    )
    return _solid(rings.reshape(-1, 3), _tube(len(line))).refine_to_length(_RIDGE_EDGE_MM)


def _interpolate_line(centres: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """A smooth line through the centres, finely sampled."""
    run = lengths_along(centres)
    return np.asarray(CubicSpline(run, centres)(np.linspace(0, run[-1], round(run[-1] / _RIDGE_STEP_MM))))


def _extend_line(line: Float[np.ndarray, "m 3"], by_mm: float) -> Float[np.ndarray, "k 3"]:
    """The line with a straight level piece added at both ends."""
    start, end = ((line[k] - line[j]) * [1, 1, 0] for k, j in ((0, 1), (-1, -2)))
    return np.vstack(
        [line[0] + by_mm * start / np.linalg.norm(start), line, line[-1] + by_mm * end / np.linalg.norm(end)]
    )


def _tube(rings: int) -> Int[np.ndarray, "f 3"]:
    """Faces of a closed tube of four-cornered rings, counter-clockwise seen along the tube."""
    ring, k = (grid.ravel() for grid in np.meshgrid(np.arange(rings - 1), np.arange(4), indexing="ij"))
    a, b = 4 * ring + k, 4 * ring + (k + 1) % 4
    sides = [np.column_stack([a, b, b + 4]), np.column_stack([a, b + 4, a + 4])]
    ends = [np.array([[2, 1, 0], [3, 2, 0]]), 4 * (rings - 1) + np.array([[0, 1, 2], [0, 2, 3]])]
    return np.concatenate([*sides, *ends])


def _solid(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Manifold:
    return Manifold(Mesh64(np.ascontiguousarray(vertices), np.ascontiguousarray(faces.astype(np.uint64))))


def _union(parts: Mapping[int, Manifold]) -> tuple[Mesh, Int[np.ndarray, "f"]]:
    """The exact union of labelled solids, and for each face the label of the solid that it comes from.

    Raises InputError where a solid is not closed.
    """
    named = {label: part.as_original() for label, part in parts.items()}
    whole = Manifold.batch_boolean(list(named.values()), OpType.Add)
    if whole.status() != Error.NoError:
        raise InputError(f"sphere arch: its solids cannot be joined ({whole.status().name}); choose other options")
    mesh = whole.to_mesh64()
    label_of = {part.original_id(): label for label, part in named.items()}
    runs: Int[np.ndarray, "r"] = np.diff(np.asarray(mesh.run_index, dtype=np.int64)) // 3
    labels = np.repeat([label_of[int(each)] for each in mesh.run_original_id], runs)
    return Mesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts, dtype=np.int64)), labels
