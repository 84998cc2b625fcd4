"""The landmarks of a phantom, exact points of its implicit surface (scheme: `cuspid.anatomy.landmarks.scheme`).

A *cervix* is the lowest point of the gum's margin on that side of a tooth, along its long axis. The papilla of a lower
jaw is the tip of the gum that shows lingually between the central incisors: of what is seen from above, the point
farthest in a direction that leans from occlusal to lingual. That of an upper jaw lies behind the central incisors,
about 1 mm apical of the palatal margin.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from cuspid.anatomy.landmarks.scheme import TOOTH_LANDMARKS, kind_of, labels_of
from cuspid.anatomy.phantom.arrangement import PlacedTooth
from cuspid.anatomy.phantom.crown_points import Point, crown_points
from cuspid.anatomy.phantom.gum import margin_height
from cuspid.anatomy.phantom.isosurface import newton_step, value_and_gradient
from cuspid.anatomy.phantom.solid import CREASE_MM, Solid
from cuspid.anatomy.teeth.crowns import Points, Values, crown_distance, silhouettes
from cuspid.model.jaw import Arch, Landmark

PAPILLA_ABOVE_MM = 0.35
"""Height of the centre of the incisive papilla above the cervices of the upper central incisors, in the middle of which
the palatal margin is about 1.35 mm high."""
PAPILLA_LEAN_DEG = 35.0
"""Direction in which the tip of a lingual papilla is the farthest point, from occlusal to lingual: its crest runs level
into the crevice under the contact."""
SAMPLES_PER_MM = 12
"""Density of the points at which a ray looks for the surface."""
REACH = 0.5
"""Half the part of the margin that is searched for its lowest point, as a fraction of half the width of the tooth."""


def landmarks_of(solid: Solid, arch: Arch) -> dict[str, Landmark]:
    """All landmarks of the teeth and the midline, by label, in the occlusal frame."""
    points = {f"{placed.fdi}.{name}": p for placed in solid.teeth for name, p in _crown_points(placed).items()}
    points = dict(zip(points, _project_to_surface(solid, np.array(list(points.values()))), strict=True))
    points |= _cervices(solid) | {"papilla": papilla(solid, arch), "midline": _midline(solid, points)}
    return {label: Landmark(points[label]) for label in labels_of(placed.fdi for placed in solid.teeth)}


def _crown_points(placed: PlacedTooth) -> dict[str, Point]:
    """The landmarks on a crown, in the jaw."""
    points = crown_points(placed.tooth.crown, placed.arch, kind_of(placed.fdi))
    return {name: placed.to_jaw(point) for name, point in points.items()}


def _project_to_surface(solid: Solid, points: Points) -> Points:
    """Points (n, 3) moved onto the surface: where neighbours touch, their crease is rounded."""
    for _ in range(5):
        points = newton_step(points, *value_and_gradient(solid.distance, points), 0.2)
    return points


# Points on the margin of the gum


def _cervices(solid: Solid) -> dict[str, Point]:
    """The lowest points of the margin, where the scheme has them, by label."""
    sides = [
        (placed, name, -1 if name.startswith("lingual") else 1)
        for placed in solid.teeth
        for name in TOOTH_LANDMARKS[kind_of(placed.fdi)]
        if name.endswith("_cervix")
    ]
    reach = np.array([REACH * placed.tooth.crown.half_width_mm for placed, _, _ in sides])[:, None]
    middle, rows = np.zeros_like(reach), np.arange(len(sides))
    lowest = np.zeros((len(sides), 3))
    for _ in range(2):
        x = middle + reach * np.linspace(-1.0, 1.0, 9)
        local, missed_mm = _margin_points(solid, [(placed, side) for placed, _, side in sides], x)
        # In a crowded row the neighbour may hide a part of the margin.
        lowest = local[rows, np.where(missed_mm < 0.05, local[:, :, 2], np.inf).argmin(axis=1)]
        middle, reach = lowest[:, :1], 0.25 * reach
    return {
        f"{placed.fdi}.{name}": placed.to_jaw(point) for (placed, name, _), point in zip(sides, lowest, strict=True)
    }


def _margin_points(
    solid: Solid, sides: list[tuple[PlacedTooth, int]], x: Float[np.ndarray, "t n"]
) -> tuple[Float[np.ndarray, "t n 3"], Float[np.ndarray, "t n"]]:
    """The points of the margin at given x on a side of each tooth, in the frame of the tooth, and by how much either of
    its surfaces is missed there."""
    local = np.concatenate([_start_of_margin(placed, side, row) for (placed, side), row in zip(sides, x, strict=True)])
    axes = np.repeat([placed.axes for placed, _ in sides], x.shape[1], axis=0)
    origins = np.repeat([placed.origin for placed, _ in sides], x.shape[1], axis=0)

    def parts(points: Points) -> Float[np.ndarray, "n 2"]:
        tooth, gum, _ = solid.parts(np.einsum("nij,nj->ni", axes, points) + origins)
        return np.column_stack([tooth, gum]) - CREASE_MM / 4

    points = _root(parts, local, np.eye(3)[1:])
    return points.reshape(*x.shape, 3), np.abs(parts(points)).max(axis=1).reshape(x.shape)


def _start_of_margin(placed: PlacedTooth, side: int, x: Values) -> Points:
    """A guess at the margin (n, 3): the side of the crown at the height that its collar aims at."""
    crown = placed.tooth.crown
    local = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])
    local[:, 2] = margin_height(placed, local)
    local[:, 1] = silhouettes(crown, local[:, 2] / crown.height_mm)[2 if side > 0 else 3]
    return local


def _root(
    function: Callable[[Points], Float[np.ndarray, "n 2"]], points: Points, along: Float[np.ndarray, "2 3"]
) -> Points:
    """Points (n, 3) moved along two directions to where both values of a function vanish (Newton's method)."""
    step_mm = 0.01
    for _ in range(8):
        values = function(points)
        slopes = np.stack([(function(points + step_mm * d) - values) / step_mm for d in along], axis=2)
        move = np.einsum("nij,nj->ni", np.linalg.pinv(slopes, rcond=0.1), -values)
        points = points + np.clip(move, -0.5, 0.5) @ along
    return points


# Points at the midline


def papilla(solid: Solid, arch: Arch) -> Point:
    """The papilla behind the central incisors."""
    return _incisive_papilla(solid) if arch == "upper" else _lingual_papilla(solid)


def _midline(solid: Solid, points: dict[str, Point]) -> Point:
    """The surface half-way between the mesial angles of the central incisors, seen from above; beside crowded incisors,
    the surface nearest to that."""
    left, right = (placed.fdi for placed in solid.teeth if placed.position == 1)
    middle = (points[f"{left}.mesial_angle"] + points[f"{right}.mesial_angle"]) / 2
    below = np.linspace(0.0, 3.0, 60)[:, None] * [0.0, 0.0, -1.0]
    if (solid.distance(middle + below) < 0).any():
        return _first_inside(solid, middle[None] + [0.0, 0.0, 2.0], np.array([0.0, 0.0, -1.0]), 6.0)[0]
    return _project_to_surface(solid, middle[None])[0]


def _incisive_papilla(solid: Solid) -> Point:
    """The point of the palatal gum behind the contact of the central incisors."""
    midpoint, lingual = _midpoint_of_centrals(solid)
    level = np.mean([placed.origin[2] for placed in solid.teeth if placed.position == 1])
    start = np.array([[*midpoint[:2], level + PAPILLA_ABOVE_MM]])
    return _first_inside(solid, start + 12.0 * lingual, -lingual, 12.0)[0]


def _lingual_papilla(solid: Solid) -> Point:
    """The tip of the gum between the central incisors, seen from lingual and above."""
    midpoint, lingual = _midpoint_of_centrals(solid)
    lean = np.radians(PAPILLA_LEAN_DEG)
    towards = lingual * np.sin(lean) + [0.0, 0.0, np.cos(lean)]
    along, best = np.linspace(-1.0, 4.0, 26), midpoint
    for _ in range(3):
        above = midpoint + along[:, None] * lingual + [0.0, 0.0, 6.0]
        seen = _first_inside(solid, above, np.array([0.0, 0.0, -1.0]), 12.0)
        score = np.where(solid.lead_of_gum(seen) > 0, seen @ towards, -np.inf)
        best = seen[score.argmax()]
        along = (best - midpoint) @ lingual + (along[1] - along[0]) * np.linspace(-1.0, 1.0, 11)
    return best


def _midpoint_of_centrals(solid: Solid) -> tuple[Point, Point]:
    """The point between the central incisors where they are equally near, and the lingual direction there."""
    one, other = (placed for placed in solid.teeth if placed.position == 1)
    ends = [placed.to_jaw(np.array([0.0, 0.0, 0.4 * placed.tooth.crown.height_mm])) for placed in (one, other)]
    line = np.linspace(ends[0], ends[1], 201)
    lead = np.abs(
        crown_distance(one.tooth.crown, one.to_tooth(line)) - crown_distance(other.tooth.crown, other.to_tooth(line))
    )
    across = ends[1] - ends[0]
    lingual = np.array([across[1], -across[0], 0.0])
    return line[lead.argmin()], lingual / np.linalg.norm(lingual)


def _first_inside(solid: Solid, starts: Points, direction: Point, length_mm: float) -> Points:
    """Where parallel rays from points (n, 3) first meet the surface; the end of a ray that does not."""
    reach = np.linspace(0.0, length_mm, int(SAMPLES_PER_MM * length_mm))
    points = starts[:, None] + reach[:, None] * direction
    distance = solid.distance(points.reshape(-1, 3)).reshape(points.shape[:2])
    first = np.where((distance < 0).any(axis=1), (distance < 0).argmax(axis=1), len(reach) - 1)
    rows = np.arange(len(starts))
    before, after = distance[rows, first - 1], distance[rows, first]
    share = np.where(after < 0, before / (before - after), 1.0)
    return points[rows, first - 1] + share[:, None] * reach[1] * direction
