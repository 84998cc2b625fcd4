"""How far the edge of a preparation in a scan lies from the true margin line.

At points along the line, scan and reference are cut by the plane perpendicular to it. In the section, the edge is the
point of the section nearest to where its two flanks, each a fitted straight line, would meet: not the point nearest to
the line. A rounded edge therefore lies inwards of the line, by r (1 / sin(a / 2) - 1) for a radius r and an angle a.

Axes of a section: *outward* bisects the reference's edge and points out of the tooth; *lateral* is perpendicular to
it and points away from the preparation (towards the root at a crown, onto the enamel at an inlay). The detector is also
run on the reference: what it finds there is its floor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from cuspid.geometry import Rigid3, axes_about, lengths_along
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.trueness import CutMargin, MarginSection
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

_FINE_MM = 0.01
"""Spacing of the points of a section."""
_TANGENT_MM = 0.15
"""Half the chord from which the direction of the line is taken."""
_STRAIGHT = 0.93
"""A line is evaluated where that chord is at least this share of its arc, which excludes the corners of an inlay."""


@dataclass(frozen=True, kw_only=True)
class MarginOptions(Options):
    """How edges are searched for."""

    step_mm: Annotated[float, Range(0.001, 10)] = 0.1
    """Distance between sections along the line."""
    reach_mm: Annotated[float, Range(0.001, 10)] = 0.4
    """Largest distance of an edge from the line."""
    flank_from_mm: Annotated[float, Range(0, 10)] = 0.08
    """The straight flanks begin at this distance from the edge, measured along the section."""
    flank_to_mm: Annotated[float, Range(0, 10)] = 0.3
    """The flanks end at this distance from the edge."""
    min_bend_deg: Annotated[float, Range(0, 180)] = 25.0
    """Minimum angle between the directions of the flanks."""
    max_floor_um: Annotated[float, Range(0.001, 10_000)] = 20.0
    """A section is evaluated only if the edge of the reference itself is found within this distance of the line."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.flank_from_mm < self.flank_to_mm:
            raise InputError("margin: the flanks must end after they begin")


@dataclass(frozen=True, kw_only=True)
class MarginStatistics:
    """Distances of the detected edge from the true line."""

    sections: int
    """Number of sections in which the reference has an edge."""
    found_pct: float
    """Share of them in which an edge was found."""
    mean_um: float
    """Mean distance in the section; NaN, like all that follow, where nothing was found."""
    std_um: float
    """Standard deviation of the distance."""
    p95_um: float
    """95th percentile of the distance."""
    max_um: float
    """Largest distance."""
    outward_um: float
    """Mean signed distance outwards; negative where the edge is rounded off."""
    lateral_um: float
    """Mean signed distance away from the preparation."""


@dataclass(frozen=True, kw_only=True)
class MarginError:
    """Margin error of one preparation."""

    scan: MarginStatistics
    """For the edge of the scan."""
    evaluated_pct: float
    """Share of the sections that are evaluated: excluding corners, and places where the reference's edge is unclear."""
    floor: MarginStatistics
    """For the reference's own edge, with the same detector: errors that cannot be distinguished from zero."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Edge:
    """An edge in a section, in the plane's coordinates."""

    point: Float[np.ndarray, "2"]
    """Where it is, mm."""
    outward: Float[np.ndarray, "2"]
    """Unit bisector out of the solid."""


def cut_margins(
    scan: Mesh, reference: Jaw, reference_from_scan: Rigid3, options: MarginOptions = MarginOptions()
) -> Mapping[int, CutMargin]:
    """The margins ``<FDI>.margin`` of a reference, cut together with an aligned scan, by FDI number."""
    aligned = scan.transformed(reference_from_scan)
    names = [name for name in reference.lines if name.endswith(".margin")]
    return {
        int(name.split(".")[0]): cut_margin(aligned, reference.mesh, reference.lines[name], options) for name in names
    }


def cut_margin(
    scan: Mesh, reference: Mesh, line: Float[np.ndarray, "n 3"], options: MarginOptions = MarginOptions()
) -> CutMargin:
    """One margin, a closed line on the reference (its last point is its first), cut together with an aligned scan.

    Raises InputError where the line is too short or the reference has no edge along it.
    """
    points, tangents, count = _stations(line, options.step_mm)
    slicers = _Slicer(reference, points), _Slicer(scan, points)
    sections = (_section(*slicers, *station, options) for station in zip(points, tangents, strict=True))
    evaluated = tuple(each for each in sections if each is not None)
    if not evaluated:
        raise InputError("margin: the reference has no edge along its margin line; check that it belongs to this mesh")
    return CutMargin(line=line, stations=count, sections=evaluated)


def margin_error(margin: CutMargin) -> MarginError:
    """How far the scan's edge lies from the line, and the reference's own edge with the same detector."""
    nothing = np.full(2, np.nan)
    found = [nothing if each.scan_edge is None else each.scan_edge for each in margin.sections]
    return MarginError(
        scan=_statistics(np.array(found)),
        evaluated_pct=100 * len(margin.sections) / margin.stations,
        floor=_statistics(np.array([each.reference_edge for each in margin.sections])),
    )


def _section(
    reference: _Slicer,
    scan: _Slicer,
    point: Float[np.ndarray, "3"],
    tangent: Float[np.ndarray, "3"],
    options: MarginOptions,
) -> MarginSection | None:
    """The section at a point of the line; None where the reference's own edge is not clear."""
    axes = axes_about(tangent)[:2]
    own = reference.section(point, tangent, axes, options)
    true = _edge(own, options)
    if own is None or true is None or 1000 * np.linalg.norm(true.point) > options.max_floor_um:
        return None
    found = scan.section(point, tangent, axes, options)
    edge = _edge(found, options)
    turned = np.stack([axes @ np.cross(tangent, true.outward @ axes), true.outward], axis=1)
    return MarginSection(
        place_mm=point,
        reference=own @ turned,
        reference_edge=true.point @ turned,
        scan=None if found is None else found @ turned,
        scan_edge=None if edge is None else edge.point @ turned,
    )


def _statistics(offsets_mm: Float[np.ndarray, "n 2"]) -> MarginStatistics:
    known = offsets_mm[np.isfinite(offsets_mm[:, 0])]
    if not len(known):
        nan = float("nan")
        return MarginStatistics(
            sections=len(offsets_mm), found_pct=0.0, mean_um=nan, std_um=nan, p95_um=nan, max_um=nan,
            outward_um=nan, lateral_um=nan,
        )  # fmt: skip
    distance_um = 1000 * np.linalg.norm(known, axis=1)
    return MarginStatistics(
        sections=len(offsets_mm),
        found_pct=100 * len(known) / len(offsets_mm),
        mean_um=float(distance_um.mean()),
        std_um=float(distance_um.std()),
        p95_um=float(np.percentile(distance_um, 95)),
        max_um=float(distance_um.max()),
        outward_um=float(1000 * known[:, 1].mean()),
        lateral_um=float(1000 * known[:, 0].mean()),
    )


def _stations(
    line: Float[np.ndarray, "n 3"], step_mm: float
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"], int]:
    """Points even along a closed line where it is straight enough, its unit direction there, and their number."""
    run = lengths_along(line)
    length = run[-1]
    if length < 20 * step_mm or length < 8 * _TANGENT_MM:
        raise InputError(f"margin: a line of {length:.2f} mm is too short for sections every {step_mm:g} mm")

    def interpolate(s: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k 3"]:
        return np.column_stack([np.interp(s % length, run, line[:, axis]) for axis in range(3)])

    s = np.arange(0.0, length - step_mm / 2, step_mm)
    chords = interpolate(s + _TANGENT_MM) - interpolate(s - _TANGENT_MM)
    size = np.linalg.norm(chords, axis=1)
    straight = size > _STRAIGHT * 2 * _TANGENT_MM
    return interpolate(s)[straight], chords[straight] / size[straight, None], len(s)


class _Slicer:
    """A mesh that answers sections near some points."""

    def __init__(self, mesh: Mesh, points: Float[np.ndarray, "k 3"]) -> None:
        near, _ = cKDTree(points).query(mesh.face_centres, distance_upper_bound=2.0)
        self._mesh = mesh.submesh(np.isfinite(near)) if np.isfinite(near).any() else None
        if self._mesh is not None:
            corners = self._mesh.vertices[self._mesh.faces]
            self._size = float(np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).max())
            self._tree = cKDTree(self._mesh.face_centres)

    def section(
        self,
        point: Float[np.ndarray, "3"],
        tangent: Float[np.ndarray, "3"],
        axes: Float[np.ndarray, "2 3"],
        options: MarginOptions,
    ) -> Float[np.ndarray, "m 2"] | None:
        """The part of the section that passes nearest to a point, its outside to the left; None where there is none."""
        if self._mesh is None:
            return None
        reach = options.reach_mm + options.flank_to_mm
        faces = self._mesh.faces[self._tree.query_ball_point(point, reach + self._size)]
        height = (self._mesh.vertices[faces] - point) @ tangent
        height = np.where(height == 0, 1e-12, height)
        faces, height = (each[(height.min(axis=1) < 0) & (height.max(axis=1) > 0)] for each in (faces, height))
        if not len(faces):
            return None
        starts, ends = _crossings(faces, height)
        places = {}
        for i, j in {*starts, *ends}:
            a, b = (self._mesh.vertices[k] - point for k in (i, j))
            share = (a @ tangent) / ((a - b) @ tangent)
            places[i, j] = axes @ (a + share * (b - a))
        return _walk(starts, ends, places, reach)


def _crossings(
    faces: Int[np.ndarray, "f 3"], height: Float[np.ndarray, "f 3"]
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """The edges where the section enters and leaves each face that crosses the plane, the outside to its left."""
    alone = np.argmax((height > 0) != (np.median(height, axis=1) > 0)[:, None], axis=1)
    row = np.arange(len(faces))
    a, b, c = (faces[row, (alone + k) % 3] for k in range(3))
    above = height[row, alone] > 0
    one = [(min(i, j), max(i, j)) for i, j in zip(a.tolist(), b.tolist(), strict=True)]
    two = [(min(i, j), max(i, j)) for i, j in zip(a.tolist(), c.tolist(), strict=True)]
    starts = [y if up else x for x, y, up in zip(one, two, above.tolist(), strict=True)]
    ends = [x if up else y for x, y, up in zip(one, two, above.tolist(), strict=True)]
    return starts, ends


def _walk(
    starts: list[tuple[int, int]],
    ends: list[tuple[int, int]],
    places: dict[tuple[int, int], Float[np.ndarray, "2"]],
    reach: float,
) -> Float[np.ndarray, "m 2"]:
    """The connected run of segments nearest to the origin, as far as it stays within reach."""
    after, before = dict(zip(starts, ends, strict=True)), dict(zip(ends, starts, strict=True))
    middles = np.array([(places[s] + places[e]) / 2 for s, e in zip(starts, ends, strict=True)])
    first = starts[int(np.argmin(np.linalg.norm(middles, axis=1)))]
    chain = [first]
    for step, forwards in ((after, True), (before, False)):
        node = first
        while node in step and step[node] != first and np.linalg.norm(places[node]) < reach:
            node = step[node]
            chain = [*chain, node] if forwards else [node, *chain]
    return np.array([places[node] for node in chain])


def _edge(section: Float[np.ndarray, "m 2"] | None, options: MarginOptions) -> _Edge | None:
    """The convex edge of a section nearest to the origin, weighted by how sharp it is."""
    if section is None or len(section) < 3:
        return None
    run = lengths_along(section)
    count = int(run[-1] / _FINE_MM)
    arm = int(options.flank_to_mm / _FINE_MM)
    if count < 2 * arm + 3:
        return None
    s = np.arange(count) * _FINE_MM
    points = np.column_stack([np.interp(s, run, section[:, k]) for k in range(2)])
    chord = arm // 2
    inner = points[arm:-arm]
    before = inner - points[arm - chord : count - arm - chord]
    after = points[arm + chord : count - arm + chord] - inner
    bend = -np.arctan2(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0], np.sum(before * after, axis=1))
    distance = np.linalg.norm(inner, axis=1)
    weight = bend * np.exp(-0.5 * (distance / (0.25 * options.reach_mm)) ** 2)
    at = arm + int(np.argmax(weight))
    return _corner(points, at, arm, options)


def _corner(points: Float[np.ndarray, "m 2"], at: int, arm: int, options: MarginOptions) -> _Edge | None:
    """The edge near the point ``at``: where the section comes nearest to the meeting of its flanks."""
    gap = int(options.flank_from_mm / _FINE_MM)
    (p, u), (q, v) = _line(points[at - arm : at - gap + 1]), _line(points[at + gap : at + arm + 1])
    sine = u[0] * v[1] - u[1] * v[0]
    if -np.rad2deg(np.arctan2(sine, u @ v)) < options.min_bend_deg:
        return None
    meeting = p + u * ((q - p)[0] * v[1] - (q - p)[1] * v[0]) / sine
    near = points[at - arm : at + arm + 1]
    point = near[int(np.argmin(np.linalg.norm(near - meeting, axis=1)))]
    if np.linalg.norm(point) > options.reach_mm:
        return None
    outward = np.array([-u[1] - v[1], u[0] + v[0]])
    return _Edge(point=point, outward=outward / np.linalg.norm(outward))


def _line(points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """The middle of points and the unit direction of the straight line through them, from the first to the last."""
    middle = points.mean(axis=0)
    direction = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    return middle, direction * np.sign(direction @ (points[-1] - points[0]) or 1.0)
