"""Landmarks of a jaw whose teeth are labelled, estimated from its surface.

Each tooth is looked at in its own view (`cuspid.anatomy.landmarks.tooth_view`: z along the tooth, u distal, v buccal).
What is looked for, by the definitions of `cuspid.anatomy.landmarks.scheme`:

- the angle of an incisal edge is the point farthest half-way between up and sideways (on a canine, whose edge slopes,
  60 degrees from up); the middle of the edge lies half-way between its angles, in the middle of what wear made flat;
- cusps are summits, told apart by where the cusps of that tooth normally lie (`cuspid.anatomy.teeth.dentition`), after
  the shift that the row of summits shows; a cusp without a summit is a shoulder, the farthest point outwards and up;
- the tip of a cusp is, of what is nearer to it than to others, the point farthest in a direction that leans outwards a
  little (`tip_direction`): of a top that is worn flat, the corner where its ridges met; that of a canine is the mean
  over such directions all around;
- the buccal groove is where the rim is deepest below the line through the tips of the two buccal cusps; the rim bows
  out from that line a little (`RIM_BOW`);
- the central groove is the deepest point below the plane of the cusps, between mesial and distal (`central_groove_u`)
  and, of a floor that is worn flat, between the rows of cusps;
- a cervix is the bottom of a parabola laid through the margin of the gum.

The uncertainty of a point joins four parts: what phantoms with known landmarks show for that kind of point, a share of
the edge length of the mesh, how far the point moves when the jaw is tilted a little or smoothed more, and what people's
points on real teeth show beyond these.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from cuspid.anatomy.landmarks.dimensions import arch_of
from cuspid.anatomy.landmarks.scheme import (
    ANGLE_DEG,
    TOOTH_LANDMARKS,
    ToothKind,
    below_cusps,
    central_groove_u,
    kind_of,
    labels_of,
    outwards,
    tip_direction,
)
from cuspid.anatomy.landmarks.tooth_view import Place, ToothView, view_teeth
from cuspid.anatomy.teeth.dentition import QUADRANTS
from cuspid.geometry import unit
from cuspid.model.jaw import GUM, Arch, Jaw, Landmark
from cuspid.model.mesh import Mesh, edges_of
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

Point = Float[np.ndarray, "3"]
Points = Float[np.ndarray, "n 3"]

_NO_POINTS = np.zeros((0, 3))
_UP = np.array([0.0, 0.0, 1.0])
_CUSPS_APART_MM = 0.8
"""No two cusps of a tooth are nearer."""
_CUSP_SPREAD_MM = 1.5
"""How far a cusp usually lies from where it is expected."""
_FARTHEST_CUSP_MM = 3.0
"""No cusp is this far from where it is expected."""
_SHOULDER_DEG, _SHOULDER_MM = 40.0, 1.2
"""A cusp without a summit is the farthest point in this direction, from up to outwards, so near to where it is
expected."""
_TIP_REACH_MM = 1.6
"""Half the side of the square about a summit that its tip is looked for in: as wide as tops are worn."""
_WORN_EDGE_DEG, _WORN_TIP_DEG = 25.0, 15.0
"""The middle of an edge, or the tip of a canine, is the mean of the farthest points in directions this far from up."""
_BUCCAL_CUSPS = ("buccal_cusp", "mesiobuccal_cusp", "distobuccal_cusp")
_LINGUAL_CUSPS = ("lingual_cusp", "second_lingual_cusp", "mesiolingual_cusp", "distolingual_cusp")
"""Between these lies the central groove."""
_PIT_PULL_PER_MM = 0.1
"""A place counts as less deep by this times its squared distance from the middle between the rows of cusps: of a floor
that is worn flat, its middle."""
_PIT_SMOOTHING_MM = 0.4
"""Standard deviation of the smoothing before the search for a pit, where scans see least and faces are large."""
RIM_BOW: Mapping[Arch, tuple[float, float]] = MappingProxyType({"lower": (0.094, 0.110), "upper": (0.063, 0.072)})
"""How far buccally of the line through the tips of the buccal cusps the rim of first and of other molars is crossed, as
a fraction of half the depth of the tooth, seen from above; from the phantoms that `SIGMA_MM` is from."""
_GROOVE_CAP_MM = 0.02
"""The groove is the middle of what lies about this far above the lowest place of the rim."""
_PAPILLA_LEAN_DEG = 35.0
"""Direction in which the tip of a lingual papilla is the farthest point, from up to lingual."""
_PAPILLA_CAP_MM = 0.05
"""The tip of a papilla is the middle of what falls about this far short of its farthest point."""
_PAPILLA_BELOW_MM = 1.0
"""The incisive papilla is taken this far apical of the palatal margin of the gum at the central incisors."""


SIGMA_MM: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "canine.cusp_tip": (0.09, 0.06),
        "canine.distal_angle": (0.30, 0.68),
        "canine.labial_cervix": (0.12, 0.06),
        "canine.lingual_cervix": (0.13, 0.00),
        "canine.mesial_angle": (0.20, 0.38),
        "incisor.distal_angle": (0.22, 0.26),
        "incisor.incisal_edge": (0.08, 0.15),
        "incisor.labial_cervix": (0.10, 0.08),
        "incisor.lingual_cervix": (0.11, 0.06),
        "incisor.mesial_angle": (0.13, 0.21),
        "midline": (0.00, 0.22),
        "molar.buccal_groove": (0.04, 0.06),
        "molar.central_groove": (0.15, 0.02),
        "molar.distobuccal_cusp": (0.16, 0.00),
        "molar.mesiobuccal_cusp": (0.14, 0.02),
        "molar.mesiolingual_cusp": (0.14, 0.00),
        "papilla": (0.00, 0.24),
        "premolar.buccal_cervix": (0.08, 0.06),
        "premolar.buccal_cusp": (0.06, 0.04),
        "premolar.central_groove": (0.19, 0.00),
        "premolar.lingual_cervix": (0.10, 0.06),
        "premolar.lingual_cusp": (0.04, 0.08),
    }
)
"""Standard uncertainty (one axis) of each kind of point: a constant in mm, and a share of the edge length of the mesh.

From the errors on phantoms of seeds 100 to 113, both arches, with edges of 0.5 and 0.9 mm: what the spread under tilts
and smoothing does not explain (`python benchmarks/landmarks.py --calibrate`)."""
REAL_TEETH_MM = 0.28
"""Standard uncertainty (one axis) that real teeth, of other forms than the phantom's, worn and restored, and people's
judgement of where a point is add to those: from 133 points that people set on four arches
(``benchmarks/landmarks.py``, `DEVELOPED_ON`)."""


@dataclass(frozen=True, kw_only=True)
class LandmarkingOptions(Options):
    """How landmarks are estimated from a labelled surface."""

    grid_mm: Annotated[float, Range(0.01, 5)] = 0.1
    """Spacing of the height field of a tooth."""
    smoothing_mm: Annotated[float, Range(0, 10)] = 0.2
    """Standard deviation of the smoothing of the height field before the search for cusps."""
    tilt_deg: Annotated[float, Range(0, 45)] = 4.0
    """Tilt of the jaw with which the uncertainty is estimated."""


def estimate_landmarks(jaw: Jaw, options: LandmarkingOptions = LandmarkingOptions()) -> dict[str, Landmark]:
    """Landmarks of a labelled jaw in the occlusal frame, each with its uncertainty; those not to be found are absent.

    Raises InputError where the jaw has no labels.
    """
    if not jaw.teeth:
        raise InputError("landmarks: the jaw has no tooth labels to estimate them from; give labels or a landmark file")
    arch = arch_of(jaw)
    views = view_teeth(jaw, options.grid_mm)
    margins = _margins(jaw)
    tries = [_all_points(jaw, arch, tried, margins) for tried in _tries(views, options)]
    edge_mm = float(np.sqrt(np.median(jaw.mesh.face_areas) * 4 / np.sqrt(3)))
    return {
        label: Landmark(point, _sigma(label, point, [t[label] for t in tries if label in t], edge_mm))
        for label, point in tries[0].items()
    }


def with_estimates(jaw: Jaw, options: LandmarkingOptions = LandmarkingOptions()) -> Jaw:
    """The jaw with the landmarks that it lacks estimated from its surface; those that it has stay as they are."""
    estimated = estimate_landmarks(jaw, options)
    return replace(jaw, landmarks={**estimated, **jaw.landmarks})


def _tries(views: Mapping[int, ToothView], options: LandmarkingOptions) -> list[dict[int, ToothView]]:
    """The views as they are, tilted four ways, and smoothed more."""
    slope = np.tan(np.radians(options.tilt_deg))
    smooth = {fdi: view.smoothed(options.smoothing_mm) for fdi, view in views.items()}
    leans = slope * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    tilted = [{fdi: view.tilted(lean) for fdi, view in smooth.items()} for lean in leans]
    return [smooth, *tilted, {fdi: view.smoothed(2 * options.smoothing_mm) for fdi, view in views.items()}]


def _sigma(label: str, point: Point, tries: Sequence[Point], edge_mm: float) -> float:
    """Standard uncertainty (one axis) of a point that several tries found at other places."""
    fdi, _, name = label.rpartition(".")
    constant, share = SIGMA_MM[f"{kind_of(int(fdi))}.{name}" if fdi else name]
    spread = np.sqrt(np.mean((np.array(tries) - point) ** 2))
    return float(np.linalg.norm([constant, share * edge_mm, spread, REAL_TEETH_MM]))


def _all_points(
    jaw: Jaw, arch: Arch, views: Mapping[int, ToothView], margins: Mapping[int, Points]
) -> dict[str, Point]:
    """Every landmark that can be found, by label, in the jaw."""
    points: dict[str, Point] = {}
    for fdi, view in views.items():
        found = _tooth_points(jaw.mesh, view, arch) | _cervices(view, margins.get(fdi, _NO_POINTS))
        points |= {f"{fdi}.{name}": found[name] for name in TOOTH_LANDMARKS[kind_of(fdi)] if name in found}
    points |= _midline_points(jaw, arch, views, margins, points)
    return {label: points[label] for label in labels_of(views) if label in points}


def _tooth_points(mesh: Mesh, view: ToothView, arch: Arch) -> dict[str, Point]:
    """The landmarks on a crown, in the jaw; on its mesh, which the height field leaves a little."""
    kind = kind_of(view.fdi)
    if kind in ("incisor", "canine"):
        places = _edge_places(view, kind)
    else:
        places = _cusp_places(view, arch)
        places["central_groove"] = _central_groove(view, places)
        if kind == "molar":
            places["buccal_groove"] = _buccal_groove(view, RIM_BOW[arch][view.fdi % 10 > 6], places)
    _, _, points = mesh.closest(np.array([view.lift(place) for place in places.values()]))
    return dict(zip(places, points, strict=True))


# Edges


def _leaning(deg: float, aside: Place) -> Point:
    """A direction (u, v, z), not of length one, that leans from up by an angle along each coordinate of ``aside``."""
    return np.array([*np.tan(np.radians(deg)) * np.asarray(aside), 1.0])


def _edge_places(view: ToothView, kind: ToothKind) -> dict[str, Place]:
    """Corners and middle of an incisal edge, or corners and tip of a canine."""
    mesial, distal = (view.farthest(_leaning(ANGLE_DEG[kind], np.array([side, 0.0]))) for side in (-1, 1))
    if kind == "canine":
        turns = np.arange(8) * np.pi / 4
        around = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        tip = np.mean([view.farthest(_leaning(_WORN_TIP_DEG, aside)) for aside in around], axis=0)
        return {"mesial_angle": mesial, "cusp_tip": tip, "distal_angle": distal}
    strip = np.abs(view.places[..., 0] - (mesial[0] + distal[0]) / 2) < 0.6 * view.grid_mm
    sides = [view.farthest(_leaning(_WORN_EDGE_DEG, np.array([0.0, side])), strip) for side in (-1, 1)]
    return {"mesial_angle": mesial, "incisal_edge": np.mean(sides, axis=0), "distal_angle": distal}


# Cusps and grooves


def _expected_cusps(fdi: int, arch: Arch) -> dict[str, tuple[float, float]]:
    """Where the cusps of a tooth normally lie, as fractions of half its width and depth; a third molar as a second."""
    cusps = sorted(QUADRANTS[arch][min(fdi % 10, 7) - 1].crown.cusps, key=lambda cusp: cusp.x)
    before = ("mesio", "disto", "distal_") if kind_of(fdi) == "molar" else ("", "second_")
    return {
        f"{prefix}{side}_cusp": (cusp.x, cusp.y)
        for side, sign in (("buccal", 1), ("lingual", -1))
        for prefix, cusp in zip(before, (cusp for cusp in cusps if cusp.y * sign > 0), strict=False)
    }


def _cusp_places(view: ToothView, arch: Arch) -> dict[str, Place]:
    """The tips at the summits that suit the cusps of the tooth best; where none does, a shoulder near the expected
    place."""
    expected = _expected_cusps(view.fdi, arch)
    named = np.isin(list(expected), TOOTH_LANDMARKS[kind_of(view.fdi)])
    places = np.array(list(expected.values())) * [view.half_width_mm, view.half_depth_mm]
    summits = view.summits(_CUSPS_APART_MM)
    shift = np.zeros(2)
    for _ in range(2):
        chosen = _suiting(view, places + shift, summits, named)
        known = named & (chosen < len(summits))
        if known.any():
            shift = (summits[chosen[known]] - places[known]).mean(axis=0)
    has_summit = chosen < len(summits)
    centres = places + shift
    centres[has_summit] = summits[chosen[has_summit]]
    nearest = np.linalg.norm(view.places[..., None, :] - centres, axis=-1).argmin(axis=-1)
    found = {}
    for k, (name, centre) in enumerate(zip(expected, centres, strict=True)):
        reach = _TIP_REACH_MM if has_summit[k] else _SHOULDER_MM
        towards = tip_direction(arch, name) if has_summit[k] else _leaning(_SHOULDER_DEG, outwards(name))
        found[name] = view.farthest(towards, view.within(centre - reach, centre + reach) & (nearest == k))
    return found


def _suiting(
    view: ToothView, places: Float[np.ndarray, "c 2"], summits: Float[np.ndarray, "k 2"], named: Bool[np.ndarray, "c"]
) -> Int[np.ndarray, "c"]:
    """The summit of each cusp that is expected at a place; the number of the summits or more where it has none."""
    apart = np.linalg.norm(places[:, None] - summits[None], axis=-1)
    heights = view.surface(summits)
    lower = heights.max(initial=-np.inf) - heights
    suits = np.where(apart < _FARTHEST_CUSP_MM, (apart / _CUSP_SPREAD_MM) ** 2 + lower, 1e3)
    # A cusp may go without a summit; one that is no landmark does so first.
    without = np.broadcast_to(np.where(named, 20.0, 8.0)[:, None], (len(places), len(places)))
    return np.asarray(linear_sum_assignment(np.hstack([suits, without]))[1])


def _buccal_groove(view: ToothView, bow: float, cusps: Mapping[str, Place]) -> Place:
    """The place of the rim that is deepest below the straight line between the tips of the two buccal cusps."""
    mesial, distal = cusps["mesiobuccal_cusp"], cusps["distobuccal_cusp"]
    run = np.linspace(0.15, 0.85, 71)
    line = mesial + run[:, None] * (distal - mesial) + [0.0, bow * view.half_depth_mm]
    heights = view.sample(line)
    tips = np.interp(run, [0.0, 1.0], view.surface(np.stack([mesial, distal])))
    depth = np.where(np.isfinite(heights), tips - heights, -_FARTHEST_CUSP_MM)
    weights = np.exp((depth - depth.max()) / _GROOVE_CAP_MM)
    return np.asarray(weights @ line / weights.sum())


def _central_groove(view: ToothView, cusps: Mapping[str, Place]) -> Place:
    """The deepest place below the plane of the cusps, between mesial and distal."""
    rows = [[place for name, place in cusps.items() if name in row] for row in (_BUCCAL_CUSPS, _LINGUAL_CUSPS)]
    buccal, lingual = (np.column_stack([row, view.surface(np.array(row))]) for row in rows)
    down = below_cusps(buccal, lingual)
    sides = buccal[:, 1].mean(), lingual[:, 1].mean()
    middle = np.array([central_groove_u(kind_of(view.fdi), list(cusps.values())), np.mean(sides)])
    reach = np.array([0.6 * view.grid_mm, 0.3 * abs(sides[0] - sides[1])])
    depths = view.smoothed(_PIT_SMOOTHING_MM).reach(down)
    depths = depths - _PIT_PULL_PER_MM * (view.places[..., 1] - middle[1]) ** 2
    return view.top(depths, view.within(middle - reach, middle + reach))


# The gum


def _margins(jaw: Jaw) -> dict[int, Points]:
    """Middles of the edges between each tooth and the gum, mm."""
    if jaw.face_labels is None:
        return {}
    edges = np.sort(edges_of(jaw.mesh.faces), axis=1)
    owner = np.repeat(jaw.face_labels, 3)
    order = np.lexsort((owner, edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    # Labels are sorted within equal edges, and that of the gum is the lowest.
    border = np.all(edges[1:] == edges[:-1], axis=1) & (owner[:-1] == GUM) & (owner[1:] != GUM)
    middles = jaw.mesh.vertices[edges[1:][border]].mean(axis=1)
    teeth = owner[1:][border]
    return {int(fdi): middles[teeth == fdi] for fdi in np.unique(teeth)}


def _cervices(view: ToothView, margin: Points) -> dict[str, Point]:
    """The lowest point of the margin on either side."""
    local = view.to_view(margin)
    outer = "labial" if kind_of(view.fdi) in ("incisor", "canine") else "buccal"
    found = {}
    for name, side in ((f"{outer}_cervix", 1), ("lingual_cervix", -1)):
        near = local[(side * local[:, 1] > 0) & (np.abs(local[:, 0]) < 0.6 * view.half_width_mm)]
        if len(near) > 4:
            found[name] = view.to_jaw(_bottom(near, 0.5 * view.half_width_mm))
    return found


def _bottom(points: Points, reach_mm: float) -> Point:
    """The lowest point of a parabola z(u) through points (u, v, z), within `reach_mm` of u = 0."""
    across = np.polyfit(points[:, 0], points[:, 1:], 2)
    a, b, _ = across[:, 1]
    u = float(np.clip(-b / (2 * a), -reach_mm, reach_mm)) if a > 0 else reach_mm * -np.sign(b)
    v, z = np.array([u * u, u, 1.0]) @ across
    return np.array([u, v, z])


def _midline_points(
    jaw: Jaw,
    arch: Arch,
    views: Mapping[int, ToothView],
    margins: Mapping[int, Points],
    points: Mapping[str, Point],
) -> dict[str, Point]:
    """Papilla and midline, where both central incisors are there."""
    right, left = (41, 31) if arch == "lower" else (11, 21)
    labels = (f"{right}.mesial_angle", f"{left}.mesial_angle")
    if jaw.face_labels is None or not all(label in points for label in labels):
        return {}
    middle = (points[labels[0]] + points[labels[1]]) / 2
    midpoint = jaw.mesh.centroid(jaw.tooth_faces(right) | jaw.tooth_faces(left))
    inwards = unit(-(views[right].axes[1] + views[left].axes[1]) * [1.0, 1.0, 0.0])
    found = {"midline": _surface_below(jaw, middle)}
    if arch == "lower":
        papilla = _lingual_papilla(jaw.mesh, jaw.face_labels, middle, inwards)
    else:
        cervices = [points[f"{fdi}.lingual_cervix"] for fdi in (right, left) if f"{fdi}.lingual_cervix" in points]
        papilla = _incisive_papilla(jaw, midpoint, inwards, cervices)
    return found if papilla is None else {**found, "papilla": papilla}


def _surface_below(jaw: Jaw, point: Point) -> Point:
    """Where the surface is below a point, as far as that is a contact of teeth and not a gap between them."""
    hit = jaw.mesh.cast((point + 2 * _UP)[None], -_UP[None])
    height = point[2] + 2 - hit.distances[0]
    return np.array([*point[:2], height]) if point[2] - height < 1.5 else point


def _lingual_papilla(mesh: Mesh, labels: Int[np.ndarray, "f"], contact: Point, inwards: Point) -> Point | None:
    """The tip of the gum that is seen from above lingual of the contact of the central incisors."""
    lean = np.radians(_PAPILLA_LEAN_DEG)
    aside = np.array([-inwards[1], inwards[0], 0.0])
    depth, across = np.meshgrid(np.arange(-0.5, 5.0, 0.05), np.linspace(-0.45, 0.45, 7))
    over = contact + depth.reshape(-1, 1) * inwards + across.reshape(-1, 1) * aside + 5.0 * _UP
    hits = mesh.cast(over, np.broadcast_to(-_UP, over.shape))
    gum = (hits.faces >= 0) & (labels[hits.faces] == GUM)
    if not gum.any():
        return None
    seen = over[gum] - hits.distances[gum, None] * _UP
    score = seen @ (np.sin(lean) * inwards + np.cos(lean) * _UP)
    weights = np.exp((score - score.max()) / _PAPILLA_CAP_MM)
    return weights @ seen / weights.sum()


def _incisive_papilla(jaw: Jaw, midpoint: Point, inwards: Point, cervices: Sequence[Point]) -> Point | None:
    """The palatal gum behind the central incisors, `_PAPILLA_BELOW_MM` apical of their palatal margin."""
    if not cervices:
        return None
    depth = np.arange(0.0, 12.0, 0.05)
    over = midpoint * [1, 1, 0] + depth[:, None] * inwards + 20.0 * _UP
    hits = jaw.mesh.cast(over, np.broadcast_to(-_UP, over.shape))
    heights = 20.0 - hits.distances
    below = heights < np.mean([cervix[2] for cervix in cervices]) - _PAPILLA_BELOW_MM
    if not below.any():
        return None
    first = int(below.argmax())
    return np.array([*over[first, :2], heights[first]])
