"""The tool that prepares a tooth for a crown: everything above the finish line but a tapered stump.

Frame: that of the tooth's site (`cuspid.anatomy.preparation.tooth_site`). The tool's inner surface is a grid of
profiles, one for each direction round the axis. A profile runs from the sulcus over the finish line, the shoulder or
chamfer and the axial wall to the reduced occlusal surface and on to the axis. One row of the grid is the finish line,
and so it is crisp.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from cuspid.anatomy.booleans import CAVITY, OUTSIDE, ROOT, TROUGH, Tool
from cuspid.anatomy.preparation.tooth_site import TURNS, Heights, ToothSite, round_means
from cuspid.anatomy.teeth.crowns import smooth_max, smooth_min, smooth_step
from cuspid.geometry import lengths_along
from cuspid.model.mesh import Mesh, edges_of
from cuspid.runtime.errors import InputError

EMERGENCE = 0.09
"""How far the proximal side at the finish line stands back from the contact, as a share of the crown's width: two
thirds of half the difference between the mesiodistal diameters of crown and cervix in Wheeler's table."""
SCALLOP_MM = {"incisor": 2.5, "canine": 2.0, "premolar": 1.0, "molar": 1.0}
"""Curvature of the cervical line towards the contacts, rounded from Wheeler's table of measurements."""
SULCUS_MM = 0.4
"""Depth below the finish line to which the gum is retracted where it covers it."""
_LEVELS = 48
_ROWS = 96
_OUTER_MM = 2.5


@dataclass(frozen=True, kw_only=True)
class CrownShape:
    """The measures of a preparation for a crown."""

    occlusal_mm: float
    axial_mm: float
    taper_deg: float
    finish_line: Literal["shoulder", "chamfer"]
    width_mm: float
    above_gum_mm: float
    edge_radius_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class FinishLine:
    """Where the preparation ends, for each of `TURNS` directions."""

    angles: Float[np.ndarray, "TURNS"]
    """Direction round the axis, radians."""
    radius: Float[np.ndarray, "TURNS"]
    """Distance from the axis, mm."""
    height: Float[np.ndarray, "TURNS"]
    """Height, mm."""
    covered: Float[np.ndarray, "TURNS"]
    """0 where the line lies on bare tooth, 1 where the gum covers it."""


def crown_tool(site: ToothSite, shape: CrownShape) -> Tool:
    """The tool for a crown preparation. Raises InputError where it leaves no stump."""
    line = finish_line(site, shape.above_gum_mm)
    top = _reduce_top(site, shape)
    profiles = _profiles(site, shape, line, top)
    return _tool(site, line, profiles)


def finish_line(site: ToothSite, above_gum_mm: float) -> FinishLine:
    """A line above the gum margin, but no higher at the proximal sides than the cervical line of such a tooth."""
    angles = (np.arange(TURNS) + 0.5) * 2 * np.pi / TURNS
    gum = site.gum_height()
    buccal, lingual = gum[: TURNS // 2].min(), gum[TURNS // 2 :].min()
    limit = (buccal + lingual) / 2 + above_gum_mm + SCALLOP_MM[site.kind]
    height = smooth_min(gum + above_gum_mm, np.full(TURNS, max(limit, buccal + 0.1, lingual + 0.1)), 0.8)
    height = gaussian_filter1d(height, 4 * TURNS / 360, mode="wrap")
    covered = smooth_step(gum - height, -0.6 * above_gum_mm, 0.0)
    radius = _radius(site, angles, height, covered)
    return FinishLine(angles=angles, radius=radius, height=height, covered=covered)


def _radius(
    site: ToothSite,
    angles: Float[np.ndarray, "TURNS"],
    height: Float[np.ndarray, "TURNS"],
    covered: Float[np.ndarray, "TURNS"],
) -> Float[np.ndarray, "TURNS"]:
    """Distance of the tooth's surface from the axis at the given heights; guessed where gum or a contact hides it."""
    crossings = _crossings(site, height)
    around, distance = site.polar(crossings)
    bare = np.bincount((around / (2 * np.pi) * TURNS).astype(int), minlength=TURNS) > 0
    bare &= covered < 0.5
    if bare.sum() < TURNS // 6:
        raise InputError(f"tooth {site.fdi}: the gum hides most of the finish line; raise it above the gum")
    radius = round_means(around, distance)
    knots, values = list(angles[bare]), list(radius[bare])
    for side in (0.0, np.pi):
        at = int(np.argmin(np.abs((angles - side + np.pi) % (2 * np.pi) - np.pi)))
        reach = _reach_to_border(site, side, height[at])
        if not bare[at] and reach is not None:
            knots.append(side)
            values.append(reach - EMERGENCE * site.width_mm)
    order = np.argsort(knots)
    turns = np.array(knots)[order]
    wrapped = np.concatenate([turns - 2 * np.pi, turns, turns + 2 * np.pi])
    spline = PchipInterpolator(wrapped, np.tile(np.array(values)[order], 3))
    return gaussian_filter1d(spline(angles), 3 * TURNS / 360, mode="wrap") + 0.01


def _crossings(site: ToothSite, height: Float[np.ndarray, "TURNS"]) -> Float[np.ndarray, "c 3"]:
    """Points where edges of the tooth's surface cross the given height above their direction."""
    vertices = site.surface.vertices
    turn = site.polar(vertices)[0] / (2 * np.pi) * TURNS - 0.5
    above = vertices[:, 2] - np.interp(turn, np.arange(TURNS), height, period=TURNS)
    edges = edges_of(site.surface.faces)
    edges = edges[above[edges[:, 0]] * above[edges[:, 1]] < 0]
    share = (above[edges[:, 0]] / (above[edges[:, 0]] - above[edges[:, 1]]))[:, None]
    return (1 - share) * vertices[edges[:, 0]] + share * vertices[edges[:, 1]]


def _reach_to_border(site: ToothSite, side: float, height: float) -> float | None:
    """Distance from the axis to the neighbour's border in a direction, mm."""
    middle_x, middle_y = height * site.lean
    sign = np.cos(side)
    reaches = [
        sign * (float(border.x(np.array([middle_y]), np.array([height]))[0]) - middle_x)
        for border in site.borders
        if border.side * sign > 0
    ]
    return min(reaches, default=None)


def _reduce_top(site: ToothSite, shape: CrownShape) -> Heights:
    surface = site.table if site.kind in ("premolar", "molar") else site.edge
    return lambda x, y: surface(x, y) - shape.occlusal_mm


def _profiles(site: ToothSite, shape: CrownShape, line: FinishLine, top: Heights) -> Float[np.ndarray, "TURNS rows 2"]:
    """Distance from the axis and height along each profile, from the finish line to the axis."""
    highest = float(np.nanmax(site.surface.vertices[:, 2])) - shape.occlusal_mm + 0.2
    share = np.linspace(0, 1, _LEVELS)
    heights = line.height[:, None] + share * (highest - line.height[:, None])
    if (highest - line.height).min() < 0.5:
        raise InputError(
            f"tooth {site.fdi}: an occlusal reduction of {shape.occlusal_mm:g} mm leaves no stump above the finish line"
        )
    radii = _wall(site, shape, line, heights)
    x, y, _ = np.moveaxis(_points(site, line.angles, radii, heights), -1, 0)
    above = heights - top(x, y)
    rows = []
    for turn in range(TURNS):
        first = int(np.argmax(above[turn] > 0))
        if first < 4 or radii[turn, :first].min() < 0.15:
            raise InputError(
                f"tooth {site.fdi}: the reductions meet (width {shape.width_mm:g} mm, taper {shape.taper_deg:g} deg, "
                f"occlusal {shape.occlusal_mm:g} mm) and leave no stump; reduce less"
            )
        rows.append(_profile(site, shape, line, turn, radii[turn], heights[turn], above[turn], first, top))
    return np.stack(rows)


def _profile(
    site: ToothSite,
    shape: CrownShape,
    line: FinishLine,
    turn: int,
    radii: Float[np.ndarray, "l"],
    heights: Float[np.ndarray, "l"],
    above: Float[np.ndarray, "l"],
    first: int,
    top: Heights,
) -> Float[np.ndarray, "rows 2"]:
    """One profile: finish line, wall up to the occlusal surface, and that surface to the axis, with rounded corners."""
    share = above[first - 1] / (above[first - 1] - above[first])
    edge = radii[first - 1] + share * (radii[first] - radii[first - 1])
    across = np.linspace(edge, 0.0, 40)
    crest = np.full(40, heights[first])
    for _ in range(4):
        x, y, _ = _points(site, line.angles[turn : turn + 1], across[None], crest[None])[0].T
        crest = top(x, y)
    wall = np.column_stack([radii[:first], heights[:first]])
    rise = shape.width_mm * np.tan(np.deg2rad(30.0)) if shape.finish_line == "chamfer" else 0.0
    wall = wall[wall[:, 1] >= heights[0] + rise]
    foot = [np.interp(heights[0] + rise, heights, radii), heights[0] + rise]
    corners = np.vstack([[line.radius[turn], line.height[turn]], foot, wall[1:], np.column_stack([across, crest])])
    return _round_corner(shape, corners)


def _round_corner(shape: CrownShape, corners: Float[np.ndarray, "c 2"]) -> Float[np.ndarray, "rows 2"]:
    """A profile resampled evenly, the inner corner rounded by the chamfer, the outer one by the edge radius."""
    run = lengths_along(corners)
    even = np.linspace(0.0, run[-1], _ROWS)
    points = np.column_stack([np.interp(even, run, corners[:, k]) for k in range(2)])
    step = even[1]
    inner = 0.35 * shape.width_mm if shape.finish_line == "chamfer" else 0.12
    lower, upper = (_smooth_line(points, size / step) for size in (inner, 0.5 * shape.edge_radius_mm))
    weight = smooth_step(even, run[1] + 0.8, run[1] + 1.2)[:, None]
    return lower + weight * (upper - lower)


def _smooth_line(points: Float[np.ndarray, "n 2"], sigma: float) -> Float[np.ndarray, "n 2"]:
    """Points smoothed along their line; the ends stay."""
    pad = 40
    before, after = 2 * points[0] - points[pad:0:-1], 2 * points[-1] - points[-2 : -pad - 2 : -1]
    return gaussian_filter1d(np.concatenate([before, points, after]), sigma, axis=0)[pad:-pad]


def _wall(
    site: ToothSite, shape: CrownShape, line: FinishLine, heights: Float[np.ndarray, "t l"]
) -> Float[np.ndarray, "t l"]:
    """Distance of the stump from the axis: inside of the tapered walls and of the tooth less the axial reduction."""
    rise = heights - line.height[:, None]
    inset = shape.width_mm + rise * np.tan(np.deg2rad(shape.taper_deg))
    floor = 0.9 * shape.width_mm
    depth = floor + (shape.axial_mm - floor) * smooth_step(rise.ravel(), 0.0, 1.2).reshape(rise.shape)
    within = _plan_distance(site, line)
    radii = np.repeat(line.radius[:, None], heights.shape[1], axis=1)
    moving = np.ones(radii.shape, dtype=bool)
    for _ in range(25):
        points = _points(site, line.angles, radii, heights)[moving]
        from_walls = inset[moving] - within(points[:, :2])
        from_surface = np.maximum(site.side_distance(points) + depth[moving], -9.0)
        excess = smooth_max(from_walls, from_surface, 0.1)
        before, radii[moving] = radii[moving], np.maximum(radii[moving] - np.maximum(excess, 0.0), 0.05)
        moving[moving] = radii[moving] != before
        if not moving.any():
            break
    return radii


def _points(
    site: ToothSite, angles: Float[np.ndarray, "t"], radii: Float[np.ndarray, "t l"], heights: Float[np.ndarray, "t l"]
) -> Float[np.ndarray, "t l 3"]:
    """Points by direction, distance from the leaning middle line, and height."""
    ray = np.column_stack([np.cos(angles), np.sin(angles)])
    plan = radii[..., None] * ray[:, None] + heights[..., None] * site.lean
    return np.concatenate([plan, heights[..., None]], axis=-1)


def _plan_distance(site: ToothSite, line: FinishLine) -> Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n"]]:
    """How far points (n, 2) lie inside the finish line seen from occlusal, mm."""
    fine = np.linspace(0, 2 * np.pi, 20 * TURNS, endpoint=False)
    radius, height = (
        gaussian_filter1d(np.interp(fine, line.angles, values, period=2 * np.pi), 10, mode="wrap")
        for values in (line.radius, line.height)
    )
    curve = _points(site, fine, radius[:, None], height[:, None])[:, 0, :2]
    along = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    inwards = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1, keepdims=True)
    tree = cKDTree(curve)

    def distance(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        _, nearest = tree.query(points)
        return np.sum((points - curve[nearest]) * inwards[nearest], axis=1)

    return distance


def _tool(site: ToothSite, line: FinishLine, profiles: Float[np.ndarray, "TURNS rows 2"]) -> Tool:
    """The closed mesh of the tool."""
    g = line.covered
    high = site.surface.vertices[:, 2].max() + 2.0
    outer = [
        (line.radius + _OUTER_MM, np.full(TURNS, high), OUTSIDE),
        (line.radius + _OUTER_MM, line.height + 0.1 + 3.4 * g, TROUGH),
        (line.radius + 1.0, line.height + 0.05 + 1.1 * g, TROUGH),
        (line.radius + 0.15 + 0.1 * g, line.height - SULCUS_MM * g, TROUGH),
        (line.radius + 0.05 + 0.1 * g, line.height - SULCUS_MM * g, ROOT),
    ]
    rows = [(r, z) for r, z, _ in outer] + [(profiles[:, k, 0], profiles[:, k, 1]) for k in range(_ROWS - 1)]
    marks = [mark for _, _, mark in outer] + [CAVITY] * (_ROWS - 2)
    radii, heights = (np.stack([row[k] for row in rows], axis=1) for k in range(2))
    grid = _points(site, line.angles, radii, heights).transpose(1, 0, 2)
    poles = np.array([[*(z * site.lean), z] for z in (profiles[:, -1, 1].mean(), high)])
    vertices = np.concatenate([grid.reshape(-1, 3), poles])
    faces, owners = _grid_faces(len(rows))
    return Tool(mesh=Mesh(vertices, faces), marks=np.array([*marks, CAVITY, OUTSIDE])[owners])


def _grid_faces(rows: int) -> tuple[Int[np.ndarray, "f 3"], Int[np.ndarray, "f"]]:
    """Faces between the rows of a closed grid and to its two poles, and the row each belongs to."""
    turn = np.arange(TURNS)
    after = (turn + 1) % TURNS
    faces, owners = [], []
    for row in range(rows - 1):
        a, b, c, d = row * TURNS + turn, row * TURNS + after, (row + 1) * TURNS + after, (row + 1) * TURNS + turn
        faces += [np.column_stack([a, d, c]), np.column_stack([a, c, b])]
        owners += [np.full(2 * TURNS, row)]
    last, inner, outer = (rows - 1) * TURNS, rows * TURNS, rows * TURNS + 1
    faces += [np.column_stack([last + turn, np.full(TURNS, inner), last + after])]
    faces += [np.column_stack([turn, after, np.full(TURNS, outer)])]
    owners += [np.full(TURNS, rows - 1), np.full(TURNS, rows)]
    return np.concatenate(faces), np.concatenate(owners)
