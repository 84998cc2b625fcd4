"""A labelled tooth seen from the occlusal side: its own directions, and its surface as a height field.

Frame of a view: z out of the crown along the tooth, u distal along the arch, v buccal across it, mm; origin in the
middle of the outline of the tooth, as high as its highest point. It is left-handed on one side of the jaw, where the
teeth are mirror images.

Teeth lean: seen along the jaw's Z, the highest point of a worn cusp lies far down its slope. How a tooth leans is told
by the vector area of its crown, which the border of its label alone fixes. That border is ragged: the mean with the
neighbours, which lean alike, is drawn towards the jaw's Z as far as the border errs.

The height field z(u, v) goes through the vertices that look upwards (Clough-Tocher, C1), so that a point of it does not
stick to a vertex; it stays as near to the triangles as the surface that they were cut from can be.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CloughTocher2DInterpolator, RegularGridInterpolator
from scipy.ndimage import correlate1d, distance_transform_edt, gaussian_filter, maximum_filter

from cuspid.geometry import unit
from cuspid.model.facing import pieces_of
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh

Grid = Float[np.ndarray, "p q"]
Place = Float[np.ndarray, "2"]
"""A point (u, v) of a view, mm."""
Points = Float[np.ndarray, "n 3"]

_ARCH_ORDER = (*range(48, 40, -1), *range(31, 39), *range(18, 10, -1), *range(21, 29))
"""FDI numbers along the lower and the upper arch."""
_UPWARD = 0.15
"""Least z of the normal of a vertex that counts for the height field."""
_NEIGHBOURS = (0.25, 0.5, 0.25)
"""Share of a tooth, and of those beside it, in how it leans."""
_LEAN_SHARE = 0.7
"""Of the lean that borders tell: they err by some 10 degrees, where teeth lean by some 15."""
_STEEPEST_LEAN = 0.3
"""Least cosine of a lean that is taken for one."""
_LEAST_VERTICES = 12
"""Fewer vertices that look upwards make no height field."""
_SAG = 0.15
"""A smooth surface leaves its triangles by less than this share of their edges."""
_CAP_MM = 0.04
"""A summit is the middle of the cap that lies about this far below the highest value."""
_CAP_REACH_MM = 0.9
"""Half the side of the window that the cap is looked for in."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ToothView:
    """A tooth seen from the occlusal side."""

    fdi: int
    """FDI number."""
    axes: Float[np.ndarray, "3 3"]
    """Rows: distal, buccal and occlusal direction in the jaw."""
    origin: Float[np.ndarray, "3"]
    """Origin of the view in the jaw, mm."""
    half_width_mm: float
    """Half the extent along u."""
    half_depth_mm: float
    """Half the extent along v."""
    surface: RegularGridInterpolator
    """Height z over (u, v), mm; beside the tooth that of the nearest place on it."""
    places: Float[np.ndarray, "p q 2"]
    """Grid of (u, v), mm."""
    heights: Grid
    """What summits are looked for in: z on the grid, mm, perhaps tilted or smoothed; minus infinity outside."""

    @property
    def grid_mm(self) -> float:
        """Spacing of the grid."""
        return float(self.places[1, 0, 0] - self.places[0, 0, 0])

    def to_view(self, points: Points) -> Points:
        """Points (n, 3) of the jaw in this view."""
        return (points - self.origin) @ self.axes.T

    def to_jaw(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """A point (3,) of this view in the jaw."""
        return point @ self.axes + self.origin

    def lift(self, place: Place) -> Float[np.ndarray, "3"]:
        """The point (3,) of the surface over a place, in the jaw."""
        return self.to_jaw(np.array([*place, self.surface(place[None])[0]]))

    def tilted(self, lean: Place) -> "ToothView":
        """Summits looked for in a jaw tilted by a slope (2,) along u and v."""
        return replace(self, heights=self.heights + self.places @ lean)

    def smoothed(self, sigma_mm: float) -> "ToothView":
        """Summits looked for in a surface smoothed by a Gaussian."""
        inside = np.isfinite(self.heights)
        filled = np.where(inside, self.heights, 0.0)
        sigma = sigma_mm / self.grid_mm
        share = gaussian_filter(inside.astype(float), sigma)
        smooth = gaussian_filter(filled, sigma) / np.maximum(share, 1e-6)
        return replace(self, heights=np.where(inside, smooth, -np.inf))

    def within(self, low: Place, high: Place) -> Bool[np.ndarray, "p q"]:
        """The places of the surface in a rectangle."""
        return np.asarray(np.all((self.places >= low) & (self.places <= high), axis=-1) & np.isfinite(self.heights))

    def reach(self, towards: Float[np.ndarray, "3"]) -> Grid:
        """How far the surface reaches in a direction (u, v, z), mm; minus infinity beside it."""
        inside = np.isfinite(self.heights)
        along = self.places @ towards[:2] + towards[2] * np.where(inside, self.heights, 0.0)
        return np.where(inside, along, -np.inf)

    def farthest(self, towards: Float[np.ndarray, "3"], among: Bool[np.ndarray, "p q"] | None = None) -> Place:
        """The place where the surface reaches farthest in a direction (u, v, z), between grid points."""
        return self.top(self.reach(towards), among)

    def top(self, values: Grid, among: Bool[np.ndarray, "p q"] | None = None) -> Place:
        """The place of the highest value, between grid points; anywhere where ``among`` is empty."""
        if among is not None and among.any():
            values = np.where(among, values, -np.inf)
        best = np.unravel_index(values.argmax(), values.shape)
        near = np.abs(self.places - self.places[best]).max(axis=-1) < _CAP_REACH_MM
        weights = np.where(near, np.exp((values - values[best]) / _CAP_MM), 0.0)
        return np.asarray(np.einsum("mn,mnk->k", weights, self.places) / weights.sum())

    def sample(self, places: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k"]:
        """What summits are looked for in, at the grid point nearest to each place; minus infinity beside the tooth."""
        rows, columns = np.rint((places - self.places[0, 0]) / self.grid_mm).astype(int).T
        height, width = self.heights.shape
        return self.heights[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]

    def summits(self, apart_mm: float) -> Float[np.ndarray, "k 2"]:
        """Places higher than everything within ``apart_mm``, inside the outline."""
        known = np.isfinite(self.heights)
        inner = gaussian_filter(known.astype(float), 2.0) > 0.999
        size = 2 * round(apart_mm / self.grid_mm) + 1
        return self.places[inner & (self.heights >= maximum_filter(self.heights, size)) & known]


def view_teeth(jaw: Jaw, grid_mm: float) -> Mapping[int, ToothView]:
    """Each tooth that has enough surface, in the order along the arch."""
    order = [fdi for fdi in _ARCH_ORDER if fdi in jaw.teeth]
    crowns = [_crown(jaw, fdi) for fdi in order]
    centroids = np.array([crown.face_areas @ crown.face_centres / crown.face_areas.sum() for crown in crowns])[:, :2]
    views = {}
    for fdi, crown, centroid, tangent, up in zip(
        order, crowns, centroids, _arch_tangents(centroids), _leans(crowns), strict=True
    ):
        view = _view(fdi, crown, _axes(fdi, tangent, centroid, up), grid_mm)
        if view is not None:
            views[fdi] = view
    return views


def _crown(jaw: Jaw, fdi: int) -> Mesh:
    """The surface of a tooth without specks of its label that lie elsewhere."""
    crown = jaw.mesh.submesh(jaw.tooth_faces(fdi))
    piece = pieces_of(crown)
    return crown.submesh(piece == np.argmax(np.bincount(piece, crown.face_areas)))


def _leans(crowns: list[Mesh]) -> Float[np.ndarray, "t 3"]:
    """The direction out of each crown along its tooth, for teeth in the order along the arch."""
    outwards = np.array([unit(crown.face_areas @ crown.face_normals) for crown in crowns])
    slopes = outwards[:, :2] / np.maximum(outwards[:, 2:], _STEEPEST_LEAN)
    mean = _LEAN_SHARE * correlate1d(slopes, _NEIGHBOURS, axis=0, mode="nearest")
    return unit(np.column_stack([mean, np.ones(len(mean))]))


def _arch_tangents(centroids: Float[np.ndarray, "t 2"]) -> Float[np.ndarray, "t 2"]:
    """Unit tangents (t, 2) of the arch at its teeth."""
    if len(centroids) < 2:
        return np.tile([1.0, 0.0], (len(centroids), 1))
    tangents = np.gradient(centroids, axis=0)
    return tangents / np.linalg.norm(tangents, axis=1, keepdims=True)


def _axes(
    fdi: int, tangent: Float[np.ndarray, "2"], centroid: Float[np.ndarray, "2"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Distal, buccal and occlusal direction as rows; ``tangent`` runs along `_ARCH_ORDER`."""
    # The order begins at the patient's right, whose teeth are walked towards the midline.
    along = np.array([*(tangent if fdi // 10 in (2, 3) else -tangent), 0.0])
    distal = unit(along - (along @ up) * up)
    across = np.cross(up, distal)
    return np.array([distal, across if across[:2] @ centroid > 0 else -across, up])


def _view(fdi: int, crown: Mesh, axes: Float[np.ndarray, "3 3"], grid_mm: float) -> ToothView | None:
    local = crown.vertices @ axes.T
    low, high = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
    middle = np.array([*(low + high) / 2, local[:, 2].max()])
    upward = (local - middle)[crown.vertex_normals @ axes[2] > _UPWARD]
    if len(upward) < _LEAST_VERTICES:
        return None
    half = (high - low) / 2
    u, v = (np.arange(-reach, reach + grid_mm, grid_mm) for reach in half)
    places = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    heights = _heights(crown, places, middle, axes, upward)
    return ToothView(
        fdi=fdi,
        axes=axes,
        origin=middle @ axes,
        half_width_mm=float(half[0]),
        half_depth_mm=float(half[1]),
        surface=RegularGridInterpolator((u, v), _fill_unknown(heights), bounds_error=False, fill_value=None),
        places=places,
        heights=np.where(np.isnan(heights), -np.inf, heights),
    )


def _heights(
    crown: Mesh,
    places: Float[np.ndarray, "p q 2"],
    middle: Float[np.ndarray, "3"],
    axes: Float[np.ndarray, "3 3"],
    upward: Points,
) -> Grid:
    """Height of the tooth over each place, mm; NaN beside it."""
    eyes = np.concatenate([places.reshape(-1, 2), np.ones((places[..., 0].size, 1))], axis=1) + middle
    hits = crown.cast(eyes @ axes, np.tile(-axes[2], (len(eyes), 1)))
    flat = np.where(hits.faces >= 0, 1.0 - hits.distances, np.nan)
    smooth = CloughTocher2DInterpolator(upward[:, :2], upward[:, 2])(places.reshape(-1, 2))
    sag = _SAG * np.sqrt(np.median(crown.face_areas) * 4 / np.sqrt(3))
    bounded = np.clip(np.where(np.isnan(smooth), flat, smooth), flat - sag, flat + sag)
    return np.asarray(bounded.reshape(places.shape[:2]))


def _fill_unknown(heights: Grid) -> Grid:
    """Heights with the nearest known one where there is none."""
    nearest = distance_transform_edt(np.isnan(heights), return_distances=False, return_indices=True)
    return np.asarray(heights[tuple(nearest)])
