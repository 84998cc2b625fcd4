"""The occlusal frame and a coarse surface, from what the motion of one camera gives: poses and sparse points.

Frames: the *model* is the frame of the motion, in its own units; the *world* is the occlusal frame of
:mod:`cuspid.model.panorama`, with z = 0 at the tips of the cusps. Where the scale is unknown, lengths of the world are
such that the camera was `NOMINAL_MM` from the teeth, and are not called millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import gaussian_filter, grey_dilation
from scipy.spatial import KDTree
from skimage.morphology import remove_small_holes

from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.model.sparse_model import SparseModel
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range
from cuspid.runtime.workers import computed_once
from cuspid.stitching.trajectory import frames_before_return

NOMINAL_MM = 14.0
"""Distance from an intra-oral camera to the teeth, where nothing else is known."""

_PATCH_MM = 3.0
"""Size of the patches of which each gives one height to the occlusal plane: about half a tooth."""
_PATCH_SD_MM = 1.0
"""How far the tops of patches stand off the occlusal plane."""
AXES_SD_DEG = 4.0
"""How far the mean of the optical axes stands off the normal of the occlusal plane."""
_RIDGE_MM, _BELOW_MM = 6.0, 1.2
"""A patch lower by more than the second than the highest patch within the first is no top of a tooth."""
_TEETH_MM = 4.0
"""What lies so near to the occlusal plane is a tooth."""
_STRAIGHT = 0.12
"""A path is straight whose middle stands off its chord by less than this share of the chord."""
_NEIGHBOURS, _REACH_MM, _UPPER = 12, 2.5, 75
"""A height is this percentile of that many points, of those within this distance: smooth enamel has few points, and the
gum deep beside it many."""
_DEEP_MM = 8.0
"""No tooth is seen so far below the cusps; what lies deeper does not shape the surface."""
_ROUND_MM = 0.8
"""Crowns bulge out below their edges: the surface goes on by one cell, at most so much lower."""

_RIM_MM, _OVER_MM = 0.4, 0.2
"""The surface occludes what it stands over by more than the second, farther away than the first."""
HOLE_MM2 = 20.0
"""Holes up to this size in what is known or seen of the teeth are none."""
_CROWN_MM, _HOLLOW_MM = 1.5, 3.0
"""Crowns lie no deeper below the smooth surface, and their hollows no deeper below the tips of the cusps."""


@dataclass(frozen=True, kw_only=True)
class ScaleOptions(Options):
    """What a single camera cannot determine: the scale."""

    working_distance_mm: Annotated[float | None, Range(0.1, 10_000)] = None
    """Median height of the camera above the cusp tips; default: that of the calibration file. Without either, no
    millimetres are stated."""
    width_mm: Annotated[float | None, Range(1, 1000)] = None
    """Known greatest width of the arch across the teeth, left to right; takes precedence over the working distance."""


@dataclass(frozen=True, kw_only=True)
class HeightMapOptions(Options):
    """How coarse the surface is."""

    cell_mm: Annotated[float, Range(0.01, 10)] = 0.4
    """Spacing of the height map."""
    smoothing_mm: Annotated[float, Range(0, 100)] = 0.5
    """Standard deviation of the Gaussian filter over the height map."""


def _disc(radius_mm: float, cell_mm: float) -> UInt8[np.ndarray, "k k"]:
    """A disc for filters of shape."""
    size = 2 * round(radius_mm / cell_mm) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))


@kernel
@no_type_check
def _mark_occluded(places, centre, occluder, corner, cell, start, over, occluded):
    """Fill in whether a place's line of sight to the centre passes under the occluder, beyond ``start`` cells."""
    top, (rows, columns) = occluder.max(), occluder.shape
    for r in range(places.shape[0]):
        for c in range(places.shape[1]):
            x, y, z = places[r, c]
            dx, dy, dz = centre[0] - x, centre[1] - y, centre[2] - z
            length = np.sqrt(dx * dx + dy * dy)
            if dz <= 0 or length == 0:
                continue
            for step in range(start, int(length * min(1.0, max(0.0, top - z) / dz) / cell) + 1):
                share = step * cell / length
                i = int(np.rint((x + share * dx - corner[0]) / cell))
                j = int(np.rint((y + share * dy - corner[1]) / cell))
                if 0 <= i < columns and 0 <= j < rows and occluder[j, i] > z + share * dz + over:
                    occluded[r, c] = True
                    break


@dataclass(frozen=True, eq=False, kw_only=True)
class HeightMap:
    """World Z over the occlusal plane, on a regular grid."""

    corner: Float[np.ndarray, "2"]
    """World (x, y) of the first cell; rows run along +Y."""
    cell_mm: float
    """Spacing."""
    heights: Float[np.ndarray, "r c"]
    """World Z of each cell. float32."""
    known: Bool[np.ndarray, "r c"]
    """Whether there is a surface that was seen."""
    visible: Bool[np.ndarray, "r c"] | None = None
    """Places that nothing occludes, whatever rises beside them."""

    @computed_once
    def places(self) -> Float[np.ndarray, "r c 3"]:
        """The surface at each cell."""
        rows, columns = self.heights.shape
        x, y = (low + self.cell_mm * np.arange(n) for low, n in zip(self.corner, (columns, rows), strict=True))
        return np.stack([*np.meshgrid(x, y), self.heights], axis=-1)

    @computed_once
    def _occluder(self) -> Float[np.ndarray, "r c"]:
        """The highest surface within `_RIM_MM`, for the crowns' rims may lie that far out."""
        return np.asarray(cv2.dilate(self.heights, _disc(_RIM_MM, self.cell_mm)))

    def occludes(self, places: Float[np.ndarray, "h w 3"], centre: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "h w"]:
        """Whether the surface stands between places on it and a camera's centre."""
        occluded = np.zeros(places.shape[:2], bool)
        start = round(_RIM_MM / self.cell_mm) + 1
        places, centre = np.array(places, order="C"), np.array(centre)  # of one kind for the compiler
        _mark_occluded(places, centre, self._occluder, self.corner, self.cell_mm, start, _OVER_MM, occluded)
        return occluded if self.visible is None else occluded & ~self._mark_cells(self.visible, places[..., :2])

    def scaled(self, scale: float) -> HeightMap:
        """The same surface in a unit that is smaller by this factor."""
        return HeightMap(
            corner=scale * self.corner,
            cell_mm=scale * self.cell_mm,
            heights=self.heights * np.float32(scale),
            known=self.known,
            visible=self.visible,
        )

    def mesh(self) -> Mesh:
        """The seen surface as triangles that look up."""
        cells = np.arange(self.heights.size).reshape(self.heights.shape)
        corners = cells[:-1, :-1], cells[:-1, 1:], cells[1:, 1:], cells[1:, :-1]
        a, b, c, d = (each.ravel() for each in corners)
        faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
        seen = self.known.ravel()[faces].all(axis=1)
        return Mesh(self.places.reshape(-1, 3).astype(np.float64), faces[seen])

    def known_at(self, xy: Float[np.ndarray, "h w 2"]) -> Bool[np.ndarray, "h w"]:
        """Whether the surface was seen at a grid of places; not so beyond the border."""
        return self._mark_cells(self.known, xy)

    def _mark_cells(self, cells: Bool[np.ndarray, "r c"], xy: Float[np.ndarray, "h w 2"]) -> Bool[np.ndarray, "h w"]:
        place = np.rint((xy - self.corner) / self.cell_mm).astype(int)
        rows, columns = np.array(cells.shape) - 1
        inside = ((place >= 0) & (place <= [columns, rows])).all(axis=-1)
        return np.asarray(inside & cells[place[..., 1].clip(0, rows), place[..., 0].clip(0, columns)])

    def interpolate(self, xy: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w"]:
        """Heights at a grid of places, bilinear; that of the border beyond it."""
        place = ((xy - self.corner) / self.cell_mm).astype(np.float32)
        return np.asarray(
            cv2.remap(self.heights, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )


# --- the occlusal frame ------------------------------------------------------------------------------------------


def in_occlusal_frame(model: SparseModel, scale: ScaleOptions | None) -> SparseModel:
    """The motion with the occlusal frame as its world, scaled to the known width of the arch, else to the working
    distance, else to `NOMINAL_MM`; without ``scale`` it is in millimetres and remains so.

    Raises ReconstructionError where there are no points.
    """
    nearer = NOMINAL_MM / float(np.median(model.depths))
    near = model.scaled(nearer)
    points, (centres, axes) = near.tracks.points, _centres_and_axes(near)
    world_from_model = _upright(points, centres, axes)
    world_from_model = _level_rotation(world_from_model.apply(points)) @ world_from_model
    above = world_from_model.apply(centres)
    front = _turn_to_front(above[: frames_before_return(above[:, :2])], world_from_model.apply(points))
    found = transform_model(near, front @ world_from_model)
    return found.scaled(1 / nearer if scale is None else scale_factor(found, scale))


def scale_factor(model: SparseModel, scale: ScaleOptions) -> float:
    """Factor that scales a motion in the occlusal frame: to the known width of the arch, else to the working distance,
    else to `NOMINAL_MM`."""
    if scale.width_mm is not None:
        nearer = NOMINAL_MM / float(np.median(model.depths))
        return nearer * scale.width_mm / _width(nearer * model.tracks.points)
    heights = _centres_and_axes(model)[0][:, 2]
    return (scale.working_distance_mm or NOMINAL_MM) / float(np.median(heights))


def _width(points: Float[np.ndarray, "p 3"]) -> float:
    """Extent along X of what lies near the occlusal plane."""
    teeth = points[np.abs(points[:, 2]) < _TEETH_MM]
    return float(np.diff(np.percentile(teeth[:, 0], [0.2, 99.8]))[0])


def transform_model(model: SparseModel, new_from_world: Rigid3) -> SparseModel:
    """The same motion in another world."""
    world_from_new = new_from_world.inverse()
    tracks = model.tracks
    return replace(
        model,
        cam_from_world={name: pose @ world_from_new for name, pose in model.cam_from_world.items()},
        tracks=replace(tracks, points=new_from_world.apply(tracks.points)),
    )


def _centres_and_axes(model: SparseModel) -> tuple[Float[np.ndarray, "f 3"], Float[np.ndarray, "f 3"]]:
    """Where the camera was and where it looked."""
    poses = [pose.inverse() for pose in model.cam_from_world.values()]
    return np.array([pose.translation for pose in poses]), np.array([pose.rotation[:, 2] for pose in poses])


def _upright(
    points: Float[np.ndarray, "p 3"], centres: Float[np.ndarray, "f 3"], axes: Float[np.ndarray, "f 3"]
) -> Rigid3:
    """Z against the mean of the optical axes, origin in the middle of the points."""
    up = -axes.mean(axis=0)
    up /= np.linalg.norm(up)
    along = np.linalg.svd(centres - centres.mean(axis=0))[2][0]
    x = along - (along @ up) * up
    if np.linalg.norm(x) < 0.1:
        x = np.cross(up, [0.3, 0.5, 0.8])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(up, x), up])
    return Rigid3(rotation, -rotation @ np.median(points, axis=0))


def _tops(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "k 3"]:
    """The upper points of each patch that is about as high as the highest near it: tops of teeth, not gum."""
    cells = np.floor(points[:, :2] / _PATCH_MM).astype(np.int64) @ [1, 1 << 20]
    tops = []
    for cell in np.unique(cells):
        inside = points[cells == cell]
        if len(inside) >= 5:
            high = inside[inside[:, 2] >= np.percentile(inside[:, 2], 75)]
            tops.append([*high[:, :2].mean(axis=0), np.median(high[:, 2])])
    found = np.array(tops, dtype=np.float64).reshape(-1, 3)
    if not len(found):
        return found
    near = KDTree(found[:, :2]).query_ball_point(found[:, :2], _RIDGE_MM)
    highest = np.array([found[which, 2].max() for which in near])
    return found[found[:, 2] > highest - _BELOW_MM]


def _level_rotation(points: Float[np.ndarray, "p 3"]) -> Rigid3:
    """Turns the plane through the tops of the teeth to z = 0; the fewer and the closer they are, the less it turns.

    Least squares with a prior on the tilt; what stands off the plane is dropped in rounds.
    """
    tops = _tops(points)
    if len(tops) < 3:
        return Rigid3(np.eye(3), np.array([0, 0, -float(np.percentile(points[:, 2], 90))]))
    prior = np.diag([0, 1, 1]) * (_PATCH_SD_MM / np.deg2rad(AXES_SD_DEG)) ** 2
    for _ in range(4):
        design = np.column_stack([np.ones(len(tops)), tops[:, :2]])
        plane = np.linalg.solve(design.T @ design + prior, design.T @ tops[:, 2])
        off = tops[:, 2] - design @ plane
        kept = np.abs(off) < 2 * _PATCH_SD_MM
        if kept.sum() < 3:
            break
        tops = tops[kept]
    normal = np.array([-plane[1], -plane[2], 1.0])
    normal /= np.linalg.norm(normal)
    x = np.array([1.0, 0, 0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(normal, x), normal])
    return Rigid3(rotation, -rotation @ np.array([0, 0, plane[0]]))


def _turn_to_front(centres: Float[np.ndarray, "f 3"], points: Float[np.ndarray, "p 3"]) -> Rigid3:
    """Turns about Z so that +Y is anterior where the path bends (an arch), else so that the path runs along +X."""
    first, last = centres[0, :2], centres[-1, :2]
    chord = last - first
    bulge = centres[:, :2].mean(axis=0) - (first + last) / 2
    x = chord / max(float(np.linalg.norm(chord)), 1e-9)
    bent = np.linalg.norm(bulge) > _STRAIGHT * np.linalg.norm(chord)
    if bent:
        y = bulge - (bulge @ x) * x if np.linalg.norm(chord) > 5 else bulge
        y /= np.linalg.norm(y)
        x = np.array([y[1], -y[0]])
    rotation = np.array([[x[0], x[1], 0], [-x[1], x[0], 0], [0, 0, 1]])
    middle = np.array([*np.median(points[:, :2], axis=0), 0])
    return Rigid3(rotation, -rotation @ middle)


# --- the surface -------------------------------------------------------------------------------------------------


def height_map(model: SparseModel, options: HeightMapOptions) -> HeightMap:
    """A smooth surface through the sparse points of a motion in the occlusal frame; robust against single points."""
    points = _sure_points(model)
    low, high = points[:, :2].min(axis=0) - 4, points[:, :2].max(axis=0) + 4
    columns, rows = np.ceil((high - low) / options.cell_mm).astype(int) + 1
    x, y = np.meshgrid(low[0] + options.cell_mm * np.arange(columns), low[1] + options.cell_mm * np.arange(rows))
    distances, nearest = KDTree(points[:, :2]).query(
        np.stack([x, y], axis=-1), k=min(_NEIGHBOURS, len(points)), distance_upper_bound=_REACH_MM
    )
    near = np.isfinite(distances)
    heights = np.where(near, points[np.minimum(nearest, len(points) - 1), 2], np.nan)
    known = near.sum(axis=-1) >= 3
    upper = np.full(known.shape, np.nan)
    upper[known] = np.nanpercentile(heights[known], _UPPER, axis=-1)
    smooth = _fill_smooth(_grow_crowns(upper), options.smoothing_mm / options.cell_mm, float(np.median(points[:, 2])))
    heights = smooth.astype(np.float32)
    return HeightMap(corner=low, cell_mm=options.cell_mm, heights=heights, known=np.ones(heights.shape, bool))


def lower_false_rises(dense: HeightMap, sparse: HeightMap, motion: SparseModel) -> HeightMap:
    """A dense surface whose false rises do not occlude what the camera went over.

    Where seen surface lies all around a place of a crown that is occluded in every frame, something rises beside it
    that cannot be: a highlight in a hollow. Gum far below the cusps may well be occluded by a crown.
    """
    camera, cells, places = motion.camera, dense.known.shape, dense.places
    seen = np.zeros(cells, bool)
    for pose in motion.cam_from_world.values():
        there = pose.apply(places)
        inside = camera.contains(camera.project(there)) & (there[..., 2] > 0) & dense.known
        part = tuple(slice(at.min(initial=max(cells)), at.max(initial=-1) + 1) for at in np.nonzero(inside & ~seen))
        seen[part] |= inside[part] & ~dense.occludes(places[part], pose.inverse().translation)
    holes = remove_small_holes(seen, max_size=round(HOLE_MM2 / dense.cell_mm**2)) & ~seen
    crown = dense.heights > np.maximum(sparse.interpolate(places[..., :2]) - _CROWN_MM, -_HOLLOW_MM)
    wide = cv2.dilate(holes.astype(np.uint8), _disc(_RIM_MM, dense.cell_mm)) > 0
    return replace(dense, visible=wide & crown)


def _grow_crowns(heights: Float[np.ndarray, "r c"]) -> Float[np.ndarray, "r c"]:
    """Edges of crowns moved outwards by one cell; unknown cells beside known ones take their height."""
    highest = grey_dilation(np.where(np.isfinite(heights), heights, -np.inf), size=3)
    beside = np.where(np.isfinite(highest), highest, np.nan)
    return np.where(np.isfinite(heights), np.maximum(heights, beside - _ROUND_MM), beside)


def _sure_points(model: SparseModel) -> Float[np.ndarray, "p 3"]:
    """Points that three frames saw, that do not stand apart in height and are not deep below the teeth."""
    tracks = model.tracks
    counts = np.bincount(tracks.point_index, minlength=len(tracks.points))
    points = tracks.points[counts >= 3] if np.sum(counts >= 3) >= 20 else tracks.points
    low, high = np.percentile(points[:, 2], [1, 99.5])
    return points[(points[:, 2] >= max(low, min(-_DEEP_MM, high - 1))) & (points[:, 2] <= high)]


def _fill_smooth(heights: Float[np.ndarray, "r c"], sigma: float, background: float) -> Float[np.ndarray, "r c"]:
    """Smooth, and without holes: what is unknown takes the mean of what is known farther and farther away."""
    known = np.isfinite(heights)
    values, weights = np.where(known, heights, 0.0), known.astype(np.float64)
    filled, level = np.full(heights.shape, background), sigma * 16
    while level >= sigma:
        total = gaussian_filter(weights, level)
        mean = gaussian_filter(values, level) / np.maximum(total, 1e-12)
        share = np.clip(total / 0.3, 0, 1)
        filled = share * mean + (1 - share) * filled
        level /= 2
    return filled
