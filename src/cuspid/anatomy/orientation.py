"""The occlusal frame, scale and tooth numbers of a jaw that a user brings, from its shape alone.

The outside of a scan shows where the crowns point: an open surface by the mean of its normals, a closed model by its
side that is not smooth. Seen from there the tips of the crowns give the occlusal plane, the symmetry of the crowns the
midline, and their spread across it which end is anterior. Of a quadrant the anterior end is the one with the narrower
crowns, and half of an arch, laid on them from there, tells where its front lies.

Frames: ``occlusal`` as in :mod:`cuspid.model.jaw`: origin in the middle of the crowns at the mean height of their tips.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter
from scipy.spatial import ConvexHull, cKDTree

from cuspid.geometry import Rigid3, axes_about, best_similarity, unit
from cuspid.model.facing import pieces_of
from cuspid.model.mesh import Mesh
from cuspid.model.occlusal_plane import SPEE_MM, crown_tips, crown_tops, level_crowns, upright
from cuspid.runtime.errors import InputError
from cuspid.storage import MM_PER_UNIT, Unit

_GRID_MM = 0.5
"""Spacing of the height map."""
_ARCHES_MM = ((25.0, 42.0), (20.5, 46.0))
"""Half the width, and the depth, of a mean arch and of a narrow one, at the middle of the second molars."""
_BEND_MM, _SMOOTH = 3.5, 0.05
"""In a square of this side that is smooth, the mean of the normals is shorter than one by no more than this."""
_ON_ARCH = 0.85
"""Share of the crowns that an arch is laid on: the rest may be flaps of gum and cheek."""
_ARCH_MISFIT_MM = 2.0
"""A whole arch lies closer than this to the mean arch, as crowns are up to 11 mm wide."""
_JAW_MM = (40.0, 90.0)
"""Usual width of a jaw."""
_PART_MM = 9.0
"""What is smaller is not a tooth, but may be a jaw in cm."""
_NARROW_MM = 32.0
"""What is narrower across is part of an arch."""
_NARROW_ARCH_MM = 36.0
"""Crowns that are narrower across are those of a part of an arch; whole ones are 45 mm and more."""
_EDGE_MM = 2.0
"""So far below their tips, front teeth are edges and molars are broad."""
_TURNS = tuple(np.deg2rad([-20.0, 0.0, 20.0]))
"""Of half of an arch that is laid on a part of one, from where its ends lie like those of the part, radians."""
_LEANS_DEG = (25.0, 50.0, 75.0)
"""How far from where a part of an arch seems to look its crowns are looked for."""
_PART_NOTE = (
    "occlusal frame: unsure which way is up and which anterior, as this does not look like a whole arch; check the "
    "picture"
)
_PART_OFF_PLANE_MM = 10.0
"""So much higher or lower than most the tips of a part of an arch may lie, which is seen at a tilt."""
_SECOND_JAW = 0.4
"""Least surface of one of two jaws, as a share of that of the other one."""
_TOWARDS = 0.6
"""Least cosine between where the crowns of a jaw point and where the other jaw lies."""
_ENOUGH_FACES = 500_000
"""More say no more of how a jaw lies."""
_TILT_SD_DEG = 30.0
"""Standard deviation of what the outside of a scan, or the plane on which it rests, tells of its tilt."""
_PART_TILT_SD_DEG = 15.0
"""The same for a part of an arch, seen from where most of it is rough: its tips lie nearly on a line."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OcclusalFrame:
    """Where the occlusal frame lies in a mesh."""

    occlusal_from_mesh: Rigid3
    """Takes the mesh into its occlusal frame."""
    notes: tuple[str, ...]
    """Why this is unsure; empty where it is not."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Relief:
    """A mesh seen from +Z of some frame, on a grid."""

    points: Float[np.ndarray, "h w 3"]
    """First surface under each place of the grid, mm; NaN where there is none or only its back is seen."""
    normals: Float[np.ndarray, "h w 3"]
    """Normal there."""
    off_plane_mm: float
    """How much higher or lower than most the tips of its crowns may lie."""

    def crowns(self) -> Float[np.ndarray, "n 3"]:
        """Points of the tops of the crowns. What else stands as high, a trimmed base or the gum behind the last tooth,
        is smooth."""
        tops = crown_tops(self.points[..., 2], _GRID_MM, off_plane_mm=self.off_plane_mm)
        rough = tops & self.rough()
        return np.asarray(self.points[rough if rough.any() else tops])

    def edges(self) -> Float[np.ndarray, "n 3"]:
        """Points of the crowns just below their tips."""
        return np.asarray(self.points[crown_tops(self.points[..., 2], _GRID_MM, _EDGE_MM, self.off_plane_mm)])

    def rough(self) -> Bool[np.ndarray, "h w"]:
        """Where the normals of the surroundings point apart, which shortens their mean."""
        seen = np.isfinite(self.normals[..., 2])
        size = (round(_BEND_MM / _GRID_MM),) * 2
        share = np.maximum(uniform_filter(seen.astype(float), size), 1e-6)
        known = np.where(seen[..., None], self.normals, 0.0)
        mean = uniform_filter(known, (*size, 1)) / share[..., None]
        return np.asarray(seen & (1 - np.linalg.norm(mean, axis=-1) > _SMOOTH))

    def tips(self) -> Float[np.ndarray, "n 3"]:
        """Points that are the highest of their surroundings."""
        return np.asarray(self.points[crown_tips(self.points[..., 2], _GRID_MM, off_plane_mm=self.off_plane_mm)])


def find_occlusal_frame(mesh: Mesh) -> OcclusalFrame:
    """The occlusal frame of a jaw in any orientation, in mm; says so where it is unsure."""
    mesh = mesh.thinned(_ENOUGH_FACES)
    start, notes = _upright(mesh)
    rests = not _is_part(mesh, start.rotation[2])
    relief, level = _level_frame(mesh, _rest_on_crowns(_relief(mesh, start), start) if rests else start)
    crowns = relief.crowns()
    if len(crowns) == 0:
        note = "occlusal frame: unsure, as nothing looks like a crown; check the picture"
        return OcclusalFrame(occlusal_from_mesh=level, notes=(*notes, note))
    anterior, one_way = _anterior(crowns[:, :2])
    wide = _width_mm(crowns[:, :2]) > _NARROW_ARCH_MM
    if not (wide and one_way):
        notes = (*notes, _PART_NOTE)
    if not wide:
        relief, level = _level_frame(mesh, _roughest(mesh, start), _PART_TILT_SD_DEG, _PART_OFF_PLANE_MM)
        crowns = relief.crowns()
        anterior = _anterior_of_part(crowns[:, :2], relief.edges()[:, :2])
    centre = np.array([*crowns[:, :2].mean(axis=0), relief.tips()[:, 2].mean()])
    turn = np.array([[anterior[1], -anterior[0], 0], [anterior[0], anterior[1], 0], [0, 0, 1.0]])
    return OcclusalFrame(occlusal_from_mesh=Rigid3(turn, -turn @ centre) @ level, notes=notes)


def _frame(up: Float[np.ndarray, "3"], centre: Float[np.ndarray, "3"]) -> Rigid3:
    """A frame at ``centre`` with +Z along ``up``."""
    axes = axes_about(up)
    return Rigid3(axes, -axes @ centre)


def _upright(mesh: Mesh) -> tuple[Rigid3, tuple[str, ...]]:
    """A frame whose +Z leaves the crowns, within some ten degrees."""
    weights = mesh.face_areas / mesh.face_areas.sum()
    centre = weights @ mesh.face_centres
    spread = (mesh.face_centres - centre).T @ (weights[:, None] * (mesh.face_centres - centre))
    across = np.linalg.eigh(spread)[1][:, 0]
    mean_normal = weights @ mesh.face_normals
    openness = float(np.linalg.norm(mean_normal))
    if openness > 0.15:
        outwards = mean_normal / openness
        along = float(across @ outwards)
        whole = abs(along) > 0.8 and not _is_part(mesh, across)
        up = np.sign(along) * across if whole else outwards
        return _frame(up, centre), ()
    sides = [_frame(sign * across, centre) for sign in (1.0, -1.0)]
    rough = [_roughness(_relief(mesh, side)) for side in sides]
    best = int(np.argmax(rough))
    sure = rough[best] > 1.3 * rough[1 - best]
    notes = (
        () if sure else ("occlusal frame: unsure which side the crowns are on, as both are rough; check the picture",)
    )
    return sides[best], notes


def _roughest(mesh: Mesh, start: Rigid3) -> Rigid3:
    """Of frames that lean from ``start``, that from which most of what is seen is rough: of a quadrant with its base or
    palate, the labial or the inner side may be the larger one, but both are smooth."""
    centre = start.inverse().apply(np.zeros((1, 3)))[0]
    around = np.deg2rad(np.arange(0, 360, 30.0))
    leans = [
        start.rotation.T @ [np.sin(lean) * np.cos(turn), np.sin(lean) * np.sin(turn), np.cos(lean)]
        for lean in np.deg2rad(_LEANS_DEG)
        for turn in around
    ]
    frames = [start, *(_frame(up, centre) for up in leans)]
    return max(frames, key=lambda frame: _relief(mesh, frame).rough().sum())


def _is_part(mesh: Mesh, up: Float[np.ndarray, "3"]) -> bool:
    """Whether this is a quadrant or less, seen from above."""
    return _width_mm(mesh.vertices @ axes_about(up)[:2].T) < _NARROW_MM


def _width_mm(places: Float[np.ndarray, "n 2"]) -> float:
    """The lesser extent of places seen from above."""
    axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[2]
    return float(np.ptp(places @ axes.T, axis=0).min())


def _relief(mesh: Mesh, frame: Rigid3, off_plane_mm: float = SPEE_MM) -> _Relief:
    """The mesh seen from +Z of ``frame``."""
    seen = frame.apply(mesh.vertices)
    lower, upper = seen.min(axis=0), seen.max(axis=0)
    x, y = (np.arange(lower[axis], upper[axis] + _GRID_MM, _GRID_MM) for axis in range(2))
    eyes = np.stack(np.broadcast_arrays(x[None], y[:, None], upper[2] + 1.0), axis=-1)
    rays = frame.inverse()
    hits = mesh.cast(rays.apply(eyes).reshape(-1, 3), np.broadcast_to(-frame.rotation[2], (eyes.size // 3, 3)))
    normals = np.where(hits.faces[:, None] >= 0, frame.rotate(mesh.face_normals[hits.faces]), np.nan)
    unseen = ~(normals[:, 2] > 0)
    points = eyes.reshape(-1, 3) - np.where(unseen, np.nan, hits.distances)[:, None] * np.array([0, 0, 1.0])
    points[unseen], normals[unseen] = np.nan, np.nan
    return _Relief(points=points.reshape(eyes.shape), normals=normals.reshape(eyes.shape), off_plane_mm=off_plane_mm)


def _roughness(relief: _Relief) -> float:
    """Mean change of the normal from one place of the grid to the next, radians; 0 on a flat base."""
    a, b = relief.normals[:, :-1].reshape(-1, 3), relief.normals[:, 1:].reshape(-1, 3)
    cosines = np.sum(a * b, axis=1)
    known = np.isfinite(cosines)
    return float(np.arccos(np.clip(cosines[known], -1, 1)).mean()) if known.any() else 0.0


def _level_frame(
    mesh: Mesh, start: Rigid3, tilt_sd_deg: float = _TILT_SD_DEG, off_plane_mm: float = SPEE_MM
) -> tuple[_Relief, Rigid3]:
    """A frame turned so that the tips of the crowns lie in the plane XY on average, and what is seen from there."""
    frame = level_crowns(lambda turn: _relief(mesh, turn @ start).points, _GRID_MM, tilt_sd_deg, off_plane_mm) @ start
    return _relief(mesh, frame, off_plane_mm), frame


def _rest_on_crowns(relief: _Relief, frame: Rigid3) -> Rigid3:
    """Turn a frame so that +Z is normal to the plane on which the jaw would rest, crowns down."""
    points = relief.points[np.isfinite(relief.points[..., 2])]
    if np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6) < 3:
        return frame
    hull = ConvexHull(points)
    up = hull.equations[:, 2] > 0.5
    centre = points.mean(axis=0)
    normals, offsets = hull.equations[up, :3], hull.equations[up, 3]
    if len(normals) == 0:
        return frame
    # The facet over the centre of mass is the one at which the line upwards leaves the hull first.
    exits = -(offsets + normals @ centre) / normals[:, 2]
    return upright(normals[int(np.argmin(exits))]) @ frame


def _anterior(crowns: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], bool]:
    """Unit vector towards anterior, from the places of the crowns seen from above: how an arch fits them best. And
    whether it fits well, and one way only."""
    places = crowns[:: max(1, len(crowns) // 1000)]
    angles = np.deg2rad(np.arange(0, 360, 20.0))
    halves = np.linspace(-1, 1, 61)
    fits = [_fit_arch(places, _arch(halves, *size_mm), angle) for size_mm in _ARCHES_MM for angle in angles]
    misfits = np.array([misfit for misfit, _ in fits])
    directions = np.array([direction for _, direction in fits])
    best = int(np.argmin(misfits))
    rivals = misfits[directions @ directions[best] < np.cos(np.deg2rad(60))]
    one_way = misfits[best] < _ARCH_MISFIT_MM and (len(rivals) == 0 or misfits[best] < 0.85 * rivals.min())
    return _midline(places, directions[best]), bool(one_way)


def _anterior_of_part(crowns: Float[np.ndarray, "n 2"], edges: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "2"]:
    """Unit vector towards anterior from the places of the crowns of a part of an arch, and from those just below their
    tips, seen from above."""
    places = crowns[:: max(1, len(crowns) // 500)]
    centre = places.mean(axis=0)
    row = np.linalg.svd(places - centre, full_matrices=False)[2][0]
    along = (places - centre) @ row
    low, high = np.quantile(along, [0.02, 0.98])
    ends = np.digitize((edges - centre) @ row, np.linspace(low, high, 4)[1:3])
    front = row if np.sum(ends == 2) < np.sum(ends == 0) else -row
    # The row bulges outwards: to the side that x is on where its front is +y.
    outwards = np.array([front[1], -front[0]])
    side = 1.0 if (places - centre) @ outwards @ (along**2 - np.mean(along**2)) < 0 else -1.0
    arch = _arch(side * np.linspace(0, 1, 31), *_ARCHES_MM[0])
    chord = arch[0] - arch[-1]
    start = np.arctan2(front[1], front[0]) - np.arctan2(chord[1], chord[0])
    return min((_fit_arch(places, arch, start + turn) for turn in _TURNS), key=lambda fit: fit[0])[1]


def _midline(places: Float[np.ndarray, "n 2"], front: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """The direction near ``front`` of the axis in which the crowns are most nearly their own mirror image."""
    tree, centre, start = cKDTree(places), places.mean(axis=0), float(np.arctan2(front[1], front[0]))

    def asymmetry(angle: float, offset_mm: float) -> float:
        axis = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-axis[1], axis[0]])
        mirrored = places - 2 * ((places - centre) @ across - offset_mm)[:, None] * across
        return float(np.minimum(tree.query(mirrored)[0], 3.0).mean())

    tries = [(start + np.deg2rad(turn), offset) for turn in range(-26, 27, 2) for offset in np.arange(-4.0, 5.0)]
    best, _ = min(tries, key=lambda attempt: asymmetry(*attempt))
    return np.array([np.cos(best), np.sin(best)])


def _arch(across: Float[np.ndarray, "m"], half_width_mm: float, depth_mm: float) -> Float[np.ndarray, "m 2"]:
    """Points of an arch whose front is +y, at fractions of half its width."""
    return np.stack([half_width_mm * across, -depth_mm * np.abs(across) ** 2.3], axis=1)


def _fit_arch(
    places: Float[np.ndarray, "n 2"], arch: Float[np.ndarray, "m 2"], angle: float
) -> tuple[float, Float[np.ndarray, "2"]]:
    """Lay an arch on the crowns from a start ``angle``: misfit in mm (0 to 4), and where its front points."""
    arch = arch - arch.mean(axis=0)
    c, s = np.cos(angle), np.sin(angle)
    fitted = arch @ np.array([[c, s], [-s, c]]) + places.mean(axis=0)
    tree = cKDTree(places)
    for _ in range(20):
        beside, from_places = cKDTree(fitted).query(places)
        far, to_places = tree.query(fitted)
        on, near = beside <= np.quantile(beside, _ON_ARCH), far < 6.0
        source = np.concatenate([arch[from_places[on]], arch[near]])
        target = np.concatenate([places[on], places[to_places[near]]])
        weights = np.concatenate([np.full(on.sum(), 1 / on.sum()), np.full(near.sum(), 1 / len(arch))])
        fitted = _apply_similarity(source, target, weights, arch)
    distances, _ = cKDTree(fitted).query(places)
    distances = distances[distances <= np.quantile(distances, _ON_ARCH)]
    back, _ = tree.query(fitted)
    _, rotation, _ = best_similarity(arch, fitted, np.ones(len(arch)))
    misfit = np.minimum(distances, 4.0).mean() + np.minimum(back, 4.0).mean()
    return float(misfit / 2), rotation[:, 1]


def _apply_similarity(
    source: Float[np.ndarray, "n 2"],
    target: Float[np.ndarray, "n 2"],
    weights: Float[np.ndarray, "n"],
    points: Float[np.ndarray, "m 2"],
) -> Float[np.ndarray, "m 2"]:
    """``points`` moved by the similarity, of moderate scale, that lays ``source`` best on ``target``."""
    scale, rotation, _ = best_similarity(source, target, weights)
    from_centre, to_centre = (np.average(each, axis=0, weights=weights) for each in (source, target))
    return np.asarray(np.clip(scale, 0.75, 1.3) * (points - from_centre) @ rotation.T + to_centre)


def require_one_jaw(mesh: Mesh) -> None:
    """Raise InputError where a mesh shows two jaws that bite: two wide pieces, one over the other, whose crowns point
    to each other."""
    piece = pieces_of(mesh)
    areas = np.bincount(piece, mesh.face_areas)
    largest = np.argsort(areas)[::-1][:2]
    if len(largest) < 2 or areas[largest[1]] < _SECOND_JAW * areas[largest[0]]:
        return
    jaws = [mesh.submesh(piece == each) for each in largest]
    if min(float(np.sort(np.ptp(jaw.vertices, axis=0))[1]) for jaw in jaws) < _JAW_MM[0] / 2:
        return
    first, second = (jaw.thinned(_ENOUGH_FACES) for jaw in jaws)
    (one, doubts), (other, more) = _upright(first), _upright(second)
    between = unit(second.vertices.mean(axis=0) - first.vertices.mean(axis=0))
    facing = one.rotation[2] @ between > _TOWARDS and other.rotation[2] @ between < -_TOWARDS
    if facing and not doubts and not more:
        height_mm = float(np.ptp(mesh.vertices @ unit(one.rotation[2] - other.rotation[2])))
        raise InputError(
            f"the mesh shows two jaws that bite, {height_mm:.0f} mm high; export each jaw into its own file"
        )


def check_scale(mesh: Mesh, unit: Unit = "mm") -> tuple[str, ...]:
    """Notes on the width of a jaw that was read in ``unit`` and is now in mm.

    Raises InputError where it cannot be in that unit, naming the unit that it seems to be in.
    """
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    width_mm = float(np.ptp(centred @ axes[:, 1:], axis=0).max())
    lower, upper = _JAW_MM
    measured = f"the mesh is {width_mm:.3g} mm wide (--unit {unit}); a jaw is {lower:g}-{upper:g} mm wide"
    if _PART_MM < width_mm < 1.5 * upper:
        return () if lower < width_mm < upper else (f"scale: {measured}, unless it is only part of one",)
    raw = width_mm / MM_PER_UNIT[unit]
    likely = [other for other, factor in MM_PER_UNIT.items() if lower <= raw * factor <= upper]
    advice = f"give --unit {likely[0]}" if likely else "rescale it, or give the correct --unit"
    raise InputError(f"{measured}; {advice}")
