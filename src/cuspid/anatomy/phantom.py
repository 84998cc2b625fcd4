"""A procedural dental arch: fourteen teeth and their gum as one watertight mesh with an FDI number for each face.

Frames. *Jaw*: the occlusal frame of `cuspid.jaw`: origin at the arch centroid, occlusal plane = XY, +Z out of the
gum, +Y anterior, mm. Seen along -Z with +Y up, +X points right; that is the patient's right in a lower jaw (teeth
41-47) and the patient's left in an upper one (teeth 21-27). *Tooth*: see `cuspid.anatomy.crowns`; the frame of a
tooth with X < 0 is left-handed, for it is the mirror image of its counterpart.

The teeth of a quadrant are a chain of segments, each as long as its tooth is wide, that touch at the contact points.
Their headings are those nearest to a natural arch that give it its transverse widths. The solid is the union of
implicit functions: the crowns, and a gum made of a ridge and a collar round each tooth.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cuspid.anatomy.crowns import Crown, Points, Values, crown_distance, silhouettes, smooth_max, smooth_min, top_of
from cuspid.anatomy.dentition import ARCH_FORMS, QUADRANTS, ArchForm, Tooth
from cuspid.anatomy.isosurface import (
    edges_of,
    evaluate,
    graph_of,
    mesh_of,
    neighbours_of,
    newton_step,
    onto_surface,
    value_and_gradient,
    without_folds,
)
from cuspid.jaw import GUM, Arch, Jaw
from cuspid.mesh import Mesh

FAR_MM = 3.0
"""Distance that stands for all larger ones."""
CONTACT_OVERLAP_MM = 0.02
"""Neighbours overlap by this much, beside the rounding of creases: contact points are worn to small areas."""
CONTACT_ROUNDS = 4
"""How often the teeth are moved together until they touch."""
PIVOT = 0.7
"""Height of the contacts, about which a tooth is inclined, as a fraction of its crown."""
CREASE_MM = 0.2
"""Rounding of the creases between neighbours and along the margin of the gum."""
ROOT = 0.7
"""Length of the root that is modelled, as a fraction of the crown height; it ends inside the gum."""


@dataclass(frozen=True, kw_only=True)
class PhantomOptions:
    """What the phantom looks like and how finely it is meshed."""

    arch: Arch = "lower"
    """Which jaw."""
    seed: int = 0
    """Individual variation of size, shape, rotation and height of the teeth, and of the gum."""
    edge_mm: float = 0.2
    """Spacing of the sampling grid, about the edge length of the faces; 0.2 gives some 400 000 faces."""
    spee_mm: float = 1.5
    """Depth of the curve of Spee between the incisors and the second molar."""
    variation: float = 1.0
    """Strength of the individual variation: 0 = the textbook arch, 1 = natural."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedTooth:
    """A tooth in the jaw."""

    fdi: int
    """FDI number."""
    tooth: Tooth
    """Shape and stand."""
    axes: Float[np.ndarray, "3 3"]
    """Columns: distal, buccal and occlusal direction in the jaw; a reflection for X < 0."""
    origin: Float[np.ndarray, "3"]
    """Centre of the cervix in the jaw, mm."""

    @property
    def is_last(self) -> bool:
        """Whether no tooth stands behind it."""
        return self.fdi % 10 == 7

    def to_tooth(self, points: Points) -> Points:
        """Points (n, 3) of the jaw in the frame of the tooth."""
        return np.einsum("ni,ij->nj", points - self.origin, self.axes)

    def to_jaw(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """A point (3,) of the tooth in the jaw."""
        return self.axes @ point + self.origin


def build_phantom(options: PhantomOptions = PhantomOptions()) -> Jaw:
    """The phantom jaw for the given options; the same options give the same jaw."""
    rng = np.random.default_rng(options.seed)
    teeth = place_teeth(options, rng)
    model = _Model(teeth=teeth, gum=_Gum.around(teeth, rng))
    vertices, faces = mesh_of(model.distance, *model.bounds, options.edge_mm)
    vertices = _onto_margin(model, vertices, faces, options.edge_mm)
    labels = model.labels(vertices[faces].mean(axis=1))
    return Jaw(mesh=Mesh(vertices, faces), face_labels=_one_patch_each(faces, labels), arch=options.arch)


# The arch


def place_teeth(options: PhantomOptions, rng: np.random.Generator) -> tuple[PlacedTooth, ...]:
    """The fourteen teeth from the last molar at X < 0 round to the one at X > 0."""
    quadrants = _individuals(QUADRANTS[options.arch], options.variation, rng)
    closing = {side: np.zeros(7) for side in (-1, 1)}
    teeth = _arrange(quadrants, closing, options)
    for _ in range(CONTACT_ROUNDS):
        excess = np.array([clearance(one, other) for one, other in pairwise(teeth)]) + CONTACT_OVERLAP_MM
        excess[6] /= 2  # either central incisor moves half of the way to the midline
        closing = {-1: closing[-1] + excess[6::-1], 1: closing[1] + excess[6:]}
        teeth = _arrange(quadrants, closing, options)
    return teeth


def clearance(one: PlacedTooth, other: PlacedTooth) -> float:
    """Width of the gap between two neighbours at its narrowest, mm; negative where they overlap."""
    front, back = sorted((one, other), key=lambda placed: placed.fdi % 10)
    crown = back.tooth.crown
    box = np.array([crown.half_width_mm, crown.half_depth_mm, crown.height_mm])
    low, high = box * [-1.25, -0.8, 0.35], box * [-0.75, 0.8, 1.0]
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 13).T, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.einsum("ni,ji->nj", grid, back.axes) + back.origin
    outside = np.maximum(crown_distance(crown, grid), crown_distance(front.tooth.crown, front.to_tooth(points)))
    return 2 * float(outside.min())


def _arrange(
    quadrants: dict[int, tuple[Tooth, ...]], closing: dict[int, Float[np.ndarray, "7"]], options: PhantomOptions
) -> tuple[PlacedTooth, ...]:
    """The teeth in the occlusal frame, each drawn towards its mesial neighbour by `closing` (7,), mm."""

    def placed(headings: Float[np.ndarray, "7"]) -> list[tuple[PlacedTooth, ...]]:
        return [_place_quadrant(quadrants[side], options.arch, side, headings, closing[side]) for side in (-1, 1)]

    left, right = placed(_solve_headings(placed, ARCH_FORMS[options.arch]))
    return _level((*reversed(left), *right), options)


def _individuals(teeth: tuple[Tooth, ...], variation: float, rng: np.random.Generator) -> dict[int, tuple[Tooth, ...]]:
    """The varied teeth of both quadrants, by the sign of X; counterparts are alike but not the same."""
    common = rng.standard_normal((len(teeth), 8))
    deviates = {side: 0.8 * common + 0.6 * rng.standard_normal(common.shape) for side in (-1, 1)}
    return {
        side: tuple(_vary(tooth, variation * row) for tooth, row in zip(teeth, rows, strict=True))
        for side, rows in deviates.items()
    }


def _vary(tooth: Tooth, z: Float[np.ndarray, "8"]) -> Tooth:
    """A tooth changed in size, shape and stand by standard normal deviates (8,)."""
    crown = tooth.crown
    cusps = tuple(replace(cusp, height=cusp.height + 0.012 * z[6 + k % 2]) for k, cusp in enumerate(crown.cusps))
    varied = replace(
        crown,
        width_mm=crown.width_mm * (1 + 0.02 * z[0]),
        depth_mm=crown.depth_mm * (1 + 0.02 * z[1]),
        height_mm=crown.height_mm * (1 + 0.03 * z[2]),
        cusps=cusps,
        phase=3.0 * float(z.sum()),
    )
    return replace(
        tooth,
        crown=varied,
        rotation_deg=tooth.rotation_deg + 2.5 * z[3],
        inclination_deg=tooth.inclination_deg + 1.5 * z[4],
        rise_mm=tooth.rise_mm + 0.12 * z[5],
    )


def _fdi(arch: Arch, side: int, position: int) -> int:
    """FDI number of the tooth at `position` (1 = central incisor) on the side of the sign of X."""
    quadrant = {("lower", 1): 40, ("lower", -1): 30, ("upper", 1): 20, ("upper", -1): 10}[arch, side]
    return quadrant + position


def _solve_headings(
    placed: Callable[[Float[np.ndarray, "7"]], list[tuple[PlacedTooth, ...]]], form: ArchForm
) -> Float[np.ndarray, "7"]:
    """Headings (7,) in radians of a quadrant's teeth: nearest to the natural ones, giving the arch its widths."""
    targets = np.array([form.inter_canine_mm, form.inter_first_molar_mm, form.inter_second_molar_mm])
    natural = np.radians(form.headings_deg)

    def misfit(change: Float[np.ndarray, "7"]) -> Float[np.ndarray, "10"]:
        left, right = placed(natural + change)
        widths = _landmark_x(right) - _landmark_x(left)
        return np.concatenate([100.0 * (widths - targets), np.diff(change, prepend=0.0)])

    return natural + least_squares(misfit, np.zeros(7), xtol=1e-5, ftol=1e-6).x


def _landmark_x(quadrant: tuple[PlacedTooth, ...]) -> Float[np.ndarray, "3"]:
    """X of the canine's tip and of the two molars' buccal grooves at the occlusal rim, mm."""
    return np.array([placed.to_jaw(_landmark(placed.tooth))[0] for placed in (quadrant[2], quadrant[5], quadrant[6])])


def _landmark(tooth: Tooth) -> Float[np.ndarray, "3"]:
    """Cusp tip of a canine, or the mesiobuccal groove of a molar at the rim, in the frame of the tooth, mm."""
    crown = tooth.crown
    if crown.edge:
        return _tips(tooth)[0]
    x, y = crown.grooves[0].x * crown.half_width_mm, 0.62 * crown.half_depth_mm
    return np.array([x, y, top_of(crown, x, y)])


def _place_quadrant(
    teeth: tuple[Tooth, ...],
    arch: Arch,
    side: int,
    headings: Float[np.ndarray, "7"],
    closing: Float[np.ndarray, "7"],
) -> tuple[PlacedTooth, ...]:
    """Teeth set one after the other from the midline backwards, each along its heading; X has the sign of `side`."""
    widths = np.array([tooth.crown.width_mm for tooth in teeth])[:, None]
    directions = np.column_stack([np.cos(headings), -np.sin(headings)])
    ends = np.cumsum((widths - closing[:, None]) * directions, axis=0)
    centres = ends - widths / 2 * directions
    return tuple(_place(tooth, _fdi(arch, side, k + 1), side, centres[k], headings[k]) for k, tooth in enumerate(teeth))


def _place(tooth: Tooth, fdi: int, side: int, centre: Float[np.ndarray, "2"], heading: float) -> PlacedTooth:
    """A tooth with the middle of its contacts above `centre` (2,), turned along `heading`, its top at Z = 0."""
    distal = np.array([np.cos(heading), -np.sin(heading), 0.0])
    buccal = np.array([np.sin(heading), np.cos(heading), 0.0])
    axes = np.column_stack([distal, buccal, [0.0, 0.0, 1.0]]) @ _stand(tooth)
    pivot = np.array([*centre, 0.0]) + tooth.offset_mm * buccal
    origin = pivot - axes @ _contact_centre(tooth.crown)
    mirror = np.array([side, 1.0, 1.0])
    placed = PlacedTooth(fdi=fdi, tooth=tooth, axes=mirror[:, None] * axes, origin=mirror * origin)
    return replace(placed, origin=placed.origin - [0.0, 0.0, _top(placed)[2]])


def _contact_centre(crown: Crown) -> Float[np.ndarray, "3"]:
    """The point midway between the contacts of a tooth, in its frame, mm."""
    _, _, buccal, lingual = silhouettes(crown, np.array([PIVOT]))
    return np.array([0.0, (buccal[0] + lingual[0]) / 2, PIVOT * crown.height_mm])


def _stand(tooth: Tooth) -> Float[np.ndarray, "3 3"]:
    """Rotation (3, 3) of the tooth by its rotation, inclination and angulation."""
    r, i, a = np.radians([tooth.rotation_deg, -tooth.inclination_deg, -tooth.angulation_deg])
    about_z = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(i), -np.sin(i)], [0, np.sin(i), np.cos(i)]])
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    return about_z @ about_x @ about_y


def _tips(tooth: Tooth) -> Float[np.ndarray, "c 3"]:
    """The cusp tips, or the middle of the incisal edge, in the frame of the tooth, mm."""
    crown = tooth.crown
    middle = (0.0, (crown.buccal[-2] - crown.lingual[-2]) / 2 * crown.depth_mm)
    cusps = [(cusp.x * crown.half_width_mm, cusp.y * crown.half_depth_mm) for cusp in crown.cusps]
    return np.array([(x, y, top_of(crown, x, y)) for x, y in cusps or [middle]])


def _top(placed: PlacedTooth) -> Float[np.ndarray, "3"]:
    """The highest tip in the jaw, mm."""
    tips = np.array([placed.to_jaw(tip) for tip in _tips(placed.tooth)])
    return tips[tips[:, 2].argmax()]


def _level(teeth: tuple[PlacedTooth, ...], options: PhantomOptions) -> tuple[PlacedTooth, ...]:
    """The teeth on the curve of Spee, in the occlusal frame: centred, their tops level on average."""
    tops = np.array([_top(placed) for placed in teeth])
    u = (tops[:, 1] - tops[:, 1].min()) / np.ptp(tops[:, 1])
    spee = (1 if options.arch == "upper" else -1) * options.spee_mm * 4 * u * (1 - u)
    rise = spee + [placed.tooth.rise_mm for placed in teeth]
    rise -= np.polyval(np.polyfit(tops[:, 1], rise, 1), tops[:, 1])
    centroid = np.array([*tops[:, :2].mean(axis=0), 0.0])
    return tuple(
        replace(placed, origin=placed.origin - centroid + [0.0, 0.0, height])
        for placed, height in zip(teeth, rise, strict=True)
    )


# The gum

WAVES = 10
"""Number of waves that make the gum uneven."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Gum:
    """The alveolar ridge, swept along the cervices of the teeth."""

    path: Float[np.ndarray, "s 2"]
    """Points of the centre line in XY, mm."""
    crest: Float[np.ndarray, "s"]
    """Height of the crest of the ridge, mm."""
    half_width: Float[np.ndarray, "s"]
    """Half-width of the ridge at its crest, mm."""
    base: float
    """Height of the flat base, mm."""
    waves: Float[np.ndarray, "w 4"]
    """Unevenness: wave vector (rad/mm) and phase of each wave."""

    @staticmethod
    def around(teeth: tuple[PlacedTooth, ...], rng: np.random.Generator) -> "_Gum":
        """The ridge that holds the teeth."""
        cervices = np.array([placed.origin for placed in teeth])
        first, last = (_beyond(cervices[k], cervices[j]) for k, j in ((0, 1), (-1, -2)))
        knots = np.vstack([first, cervices, last])
        widths = np.array([placed.tooth.crown.half_depth_mm for placed in teeth])
        table = np.column_stack([knots, np.pad(widths, 1, mode="edge")])
        run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots[:, :2], axis=0), axis=1))])
        samples = CubicSpline(run, table)(np.linspace(0.0, run[-1], 1200))
        return _Gum(
            path=samples[:, :2],
            crest=samples[:, 2] - 0.6,
            half_width=samples[:, 3],
            waves=np.column_stack([rng.normal(0.0, 0.45, (WAVES, 3)), rng.uniform(0.0, 2 * np.pi, WAVES)]),
            base=float(cervices[:, 2].min() - 8.0),
        )

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.path)

    def ridge_distance(self, points: Points) -> Values:
        """Approximate signed distance in mm, shape (n,), to the ridge."""
        _, nearest = self._tree.query(points[:, :2])
        offset = points[:, :2] - self.path[nearest]
        across = np.hypot(offset[:, 0], offset[:, 1])
        depth = self.crest[nearest] - points[:, 2]
        side = across - self.half_width[nearest] - 0.12 * np.maximum(depth, 0.0) - self.undulation(points)
        return smooth_max(smooth_max(side, -depth, 3.0), self.base - points[:, 2], 0.6)

    def undulation(self, points: Points) -> Values:
        """Unevenness of the gum in mm, shape (n,)."""
        waves = np.sin(np.einsum("ni,wi->nw", points, self.waves[:, :3]) + self.waves[:, 3])
        return 0.25 / np.sqrt(WAVES) * waves.sum(axis=1)


def _beyond(end: Float[np.ndarray, "3"], before: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """A point (3,) behind the last molar, along the line from the tooth before it."""
    step = end - before
    return end + 0.5 * step * [1.0, 1.0, 0.0]


def _collar(placed: PlacedTooth, local: Points, distance: Values) -> Values:
    """Signed distance, shape (n,), to the gum round one tooth, from that to the tooth.

    A thin sleeve about the root, and a slab that leans inwards: it shows as a papilla where the tooth recedes.
    """
    crown = placed.tooth.crown
    level = np.maximum(local[:, 2] / crown.height_mm, -0.1)
    u = np.minimum(np.abs(local[:, 0]) / crown.half_width_mm, 1.2)
    _, _, buccal, lingual = silhouettes(crown, level)
    lean = 0.45 - 0.8 * u * u - 3.0 * level
    across = smooth_max(local[:, 1] - buccal - lean, lingual - lean - local[:, 1], 0.5)
    behind = (0.4 if placed.is_last else 1.0) * crown.half_width_mm
    along = np.maximum(-crown.half_width_mm - local[:, 0], local[:, 0] - behind) - 0.3
    slab = smooth_max(across, along, 1.5)
    above = 0.9 * (local[:, 2] - _margin(placed, local))
    sleeve = smooth_max(distance - 0.45, above, 0.6)
    return _above_root_end(crown, local, smooth_min(sleeve, smooth_max(slab, above - 0.3, 1.6), 0.8))


def _above_root_end(crown: Crown, local: Points, distance: Values) -> Values:
    """A signed distance, shape (n,), cut off at the end of the modelled root."""
    return smooth_max(distance, -local[:, 2] - ROOT * crown.height_mm, 2.0)


def _margin(placed: PlacedTooth, local: Points) -> Values:
    """Height in mm, shape (n,), of the scalloped margin: low in the middle of a tooth, high towards its neighbours."""
    crown = placed.tooth.crown
    u = local[:, 0] / crown.half_width_mm
    papilla = 0.5 if crown.edge else 0.41
    rise = np.where(u > 0, 0.1 if placed.is_last else papilla, papilla)
    return crown.height_mm * (0.03 + rise * np.minimum(np.abs(u), 1.05) ** 2.5)


# The solid


@dataclass(frozen=True, eq=False, kw_only=True)
class _Model:
    """The union of teeth and gum."""

    teeth: tuple[PlacedTooth, ...]
    """The teeth."""
    gum: _Gum
    """The gum."""

    @property
    def bounds(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Lower and upper corner of a box round the solid, mm."""
        reach = self.gum.half_width.max() + 4.0
        low, high = self.gum.path.min(axis=0) - reach, self.gum.path.max(axis=0) + reach
        return np.array([*low, self.gum.base - 1.0]), np.array([*high, 3.0])

    def parts(self, points: Points) -> tuple[Values, Values, Int[np.ndarray, "n"]]:
        """Signed distances to the teeth and to the gum, and the FDI number of the nearest tooth, each (n,)."""
        tooth = np.full(len(points), FAR_MM)
        gum = np.minimum(self.gum.ridge_distance(points), FAR_MM)
        nearest = np.zeros(len(points), dtype=np.int64)
        for placed in self.teeth:
            near = _within_reach(placed, points)
            local = placed.to_tooth(points[near])
            shape = placed.tooth.crown
            crown = _above_root_end(shape, local, crown_distance(shape, local))
            gum[near] = smooth_min(gum[near], _collar(placed, local, crown), 1.6)
            nearest[near] = np.where(crown < tooth[near], placed.fdi, nearest[near])
            tooth[near] = smooth_min(tooth[near], crown, CREASE_MM)
        return tooth, gum, nearest

    def distance(self, points: Points) -> Values:
        """Approximate signed distance, shape (n,), to the solid."""
        tooth, gum, _ = self.parts(points)
        return smooth_min(tooth, gum, CREASE_MM)

    def lead_of_gum(self, points: Points) -> Values:
        """How much nearer the gum is than the teeth, mm, shape (n,); zero at the margin."""
        tooth, gum, _ = self.parts(points)
        return tooth - gum

    def labels(self, points: Points) -> Int[np.ndarray, "n"]:
        """FDI number, or 0 for gum, of points on the surface."""
        tooth, gum, nearest = self.parts(points)
        return np.where(tooth <= gum, nearest, GUM)


def _within_reach(placed: PlacedTooth, points: Points) -> Int[np.ndarray, "m"]:
    """Indices (m,) of the points nearer to a tooth than about `FAR_MM`."""
    crown = placed.tooth.crown
    reach = np.hypot(crown.half_width_mm, crown.half_depth_mm) + FAR_MM
    from_axis = points[:, :2] - placed.to_jaw(np.array([0.0, 0.0, crown.height_mm / 2]))[:2]
    return np.flatnonzero((from_axis**2).sum(axis=1) < reach**2)


# The labels


def _onto_margin(
    model: _Model, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], edge_mm: float
) -> Float[np.ndarray, "v 3"]:
    """Vertices beside the margin of the gum moved onto it, so that edges run along it."""
    lead = evaluate(model.lead_of_gum, vertices)
    ends = edges_of(faces)
    ends = ends[lead[ends[:, 0]] * lead[ends[:, 1]] < 0]
    nearer = np.abs(lead[ends[:, 0]]) < np.abs(lead[ends[:, 1]])
    beside = np.unique(np.where(nearer, ends[:, 0], ends[:, 1]))
    moved = vertices.copy()
    moved[beside] = _along_surface(model, vertices[beside], 0.4 * edge_mm)
    return without_folds(vertices, moved, faces)


def _along_surface(model: _Model, points: Points, limit_mm: float) -> Points:
    """Points (n, 3) of the surface moved within it towards the margin of the gum."""
    values, slope = value_and_gradient(model.lead_of_gum, points)
    _, normal = value_and_gradient(model.distance, points)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    tangential = slope - (slope * normal).sum(axis=1, keepdims=True) * normal
    return onto_surface(model.distance, newton_step(points, values, tangential, limit_mm), limit_mm)


def _one_patch_each(faces: Int[np.ndarray, "f 3"], labels: Int[np.ndarray, "f"]) -> Int[np.ndarray, "f"]:
    """Labels (f,) of which each is one connected patch: specks take the label that surrounds them."""
    pairs = neighbours_of(faces)
    for _ in range(3):
        same = pairs[labels[pairs[:, 0]] == labels[pairs[:, 1]]]
        _, patch = connected_components(graph_of(same, len(faces)), directed=False)
        size = np.bincount(patch)
        largest = np.zeros(labels.max() + 1, dtype=np.int64)
        np.maximum.at(largest, labels, size[patch])
        speck = size[patch] < largest[labels]
        if not speck.any():
            break
        border = pairs[speck[pairs[:, 0]] & ~speck[pairs[:, 1]]]
        source = np.full(len(size), -1)
        source[patch[border[:, 0]]] = labels[border[:, 1]]
        labels = np.where(speck & (source[patch] >= 0), source[patch], labels)
    return labels
