"""The tool that prepares a tooth for a mesio-occluso-distal inlay: an occlusal slot between two proximal boxes.

Frame: that of the tooth's site (`cuspid.anatomy.preparation.tooth_site`). Slot and boxes are convex: flat floors, plane
walls that diverge towards occlusal, and internal edges rounded as by a bur. Where the gum covers the rim of a box, a
second body clears it, with a sulcus below the gingival floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import manifold3d
import numpy as np
from jaxtyping import Float

from cuspid.anatomy.booleans import CAVITY, TROUGH, Tool, run_lengths
from cuspid.anatomy.preparation.crown_tool import EMERGENCE, SULCUS_MM
from cuspid.anatomy.preparation.tooth_site import ToothSite
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError

_ROUND = 24
"""Segments of a full turn of a rounded edge."""


@dataclass(frozen=True, kw_only=True)
class InlayShape:
    """The measures of an inlay preparation."""

    isthmus_mm: float
    depth_mm: float
    box_width_mm: float
    box_floor_mm: float
    box_depth_mm: float
    divergence_deg: float
    edge_radius_mm: float


@dataclass(frozen=True, kw_only=True)
class InlayPlan:
    """Where slot and boxes lie, in the frame of the site, mm."""

    centre_y: float
    """Middle of the slot."""
    box_y: tuple[float, float]
    """Middles of the boxes: at the contacts, as far as the slot still opens into them."""
    pulpal_z: float
    """Pulpal floor."""
    gingival_z: float
    """Gingival floors."""
    axial_x: tuple[float, float]
    """Axial walls at the gingival floors, the smaller x first."""
    proximal_x: tuple[float, float]
    """Proximal ends of the gingival floors."""
    outer_x: tuple[float, float]
    """Where the tool ends."""
    covered: tuple[bool, bool]
    """Whether gum or contact hides the proximal end of a floor."""


def inlay_tool(site: ToothSite, shape: InlayShape) -> Tool:
    """The tool for an inlay preparation. Raises InputError where slot or boxes do not fit into the tooth."""
    plan = inlay_plan(site, shape)
    high = float(site.surface.vertices[:, 2].max()) + 2.0
    inside = [_slot(plan, shape, high)] + [_box(plan, shape, end, high) for end in (0, 1)]
    outside = [_proximal_clearance(plan, shape, end, high) for end in (0, 1) if plan.covered[end]]
    cavity = manifold3d.Manifold.batch_boolean(inside, manifold3d.OpType.Add).as_original()
    whole = manifold3d.Manifold.batch_boolean([cavity, *outside], manifold3d.OpType.Add)
    whole = whole.refine_to_length(0.4)
    out = whole.to_mesh64()
    runs = np.repeat(np.asarray(out.run_original_id), run_lengths(out))
    mesh = Mesh(np.asarray(out.vert_properties)[:, :3], np.asarray(out.tri_verts).astype(np.int64))
    return Tool(mesh=mesh, marks=np.where(runs == cavity.original_id(), CAVITY, TROUGH))


def inlay_plan(site: ToothSite, shape: InlayShape) -> InlayPlan:
    """Where slot and boxes of an inlay lie in a tooth."""
    if site.kind not in ("premolar", "molar"):
        raise InputError(f"tooth {site.fdi}: a mesio-occluso-distal inlay needs a premolar or molar")
    centre_y, groove = _central_groove(site)
    pulpal = groove - shape.depth_mm
    gingival = pulpal - shape.box_depth_mm
    if gingival < site.gum_margin[:, 2].min() + 0.3:
        raise InputError(
            f"tooth {site.fdi}: a gingival floor {shape.depth_mm + shape.box_depth_mm:g} mm below the central groove "
            "would lie below the lowest gum; make the slot or the boxes shallower"
        )
    ends = [_proximal_end(site, sign, centre_y, gingival) for sign in (-1.0, 1.0)]
    axial = (ends[0][0] + shape.box_floor_mm, ends[1][0] - shape.box_floor_mm)
    if axial[1] - axial[0] < 1.0:
        raise InputError(f"tooth {site.fdi}: gingival floors {shape.box_floor_mm:g} mm wide meet; make them narrower")
    room = _room_mm(site, gingival)
    if max(shape.box_width_mm, shape.isthmus_mm) > room - 1.0:
        raise InputError(
            f"tooth {site.fdi}: it is {room:.1f} mm deep at the gingival floor; boxes and isthmus must be at least "
            "1 mm narrower"
        )
    return InlayPlan(
        centre_y=centre_y,
        box_y=(_box_middle(site, shape, -1.0, centre_y), _box_middle(site, shape, 1.0, centre_y)),
        pulpal_z=pulpal,
        gingival_z=gingival,
        axial_x=axial,
        proximal_x=(ends[0][0], ends[1][0]),
        outer_x=(ends[0][1], ends[1][1]),
        covered=(ends[0][2], ends[1][2]),
    )


def _central_groove(site: ToothSite) -> tuple[float, float]:
    """The y and the height of the central groove: the median of the lowest points of transverse sections."""
    half = site.width_mm / 2
    low, high = site.surface.vertices[:, 1].min(), site.surface.vertices[:, 1].max()
    middle, depth = (low + high) / 2, (high - low) / 2
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 21) * half, middle + np.linspace(-0.3, 0.3, 41) * depth, indexing="ij")
    z = site.occlusal_height(x, y)
    if not np.isfinite(z).all():
        raise InputError(f"tooth {site.fdi}: its occlusal surface has holes; close them first")
    at = np.argmin(z, axis=1)
    return float(np.median(y[np.arange(21), at])), float(np.median(z[np.arange(21), at]))


def _box_middle(site: ToothSite, shape: InlayShape, sign: float, centre_y: float) -> float:
    contact = next((float(border.centre[0]) for border in site.borders if border.side * sign > 0), centre_y)
    play = (shape.box_width_mm - shape.isthmus_mm) / 2
    return float(np.clip(contact, centre_y - play, centre_y + play))


def _room_mm(site: ToothSite, height: float) -> float:
    """Buccolingual depth of the tooth at a height."""
    vertices = site.surface.vertices
    near = np.abs(vertices[:, 2] - height) < 0.6
    return float(np.ptp(vertices[near, 1])) if near.any() else 0.0


def _proximal_end(site: ToothSite, sign: float, y: float, z: float) -> tuple[float, float, bool]:
    """X of the proximal surface at the gingival floor, x where the tool ends, and whether the surface is hidden."""
    vertices = site.surface.vertices
    here = vertices[
        (np.abs(vertices[:, 1] - y) < 1.0) & (np.abs(vertices[:, 2] - z) < 0.3) & (sign * vertices[:, 0] > 0)
    ]
    reach = float((sign * vertices[:, 0]).max())
    for border in site.borders:
        if sign * border.side > 0:
            reach = sign * float(border.x(np.array([y]), np.array([z]))[0])
    if len(here) >= 3:
        end = float((sign * here[:, 0]).max())
        return sign * end, sign * (max(reach, end) + 1.0), False
    return sign * (reach - EMERGENCE * site.width_mm), sign * (reach + 1.0), True


def _slot(plan: InlayPlan, shape: InlayShape, high: float) -> manifold3d.Manifold:
    """The occlusal slot, from inside one box to inside the other."""
    tilt, rho = np.tan(np.deg2rad(shape.divergence_deg)), shape.edge_radius_mm
    ends = (plan.axial_x[0] - 0.5 * shape.box_floor_mm, plan.axial_x[1] + 0.5 * shape.box_floor_mm)
    half = shape.isthmus_mm / 2
    inset = _edge_inset(shape)
    up = high - plan.pulpal_z
    points: list[Float[np.ndarray, "_ 3"]] = []
    for x in ends:
        for side in (-1, 1):
            centre = (x, plan.centre_y + side * (half - inset), plan.pulpal_z + rho)
            points += [_ball(centre, rho), np.array([[x, plan.centre_y + side * (half + up * tilt), high]])]
    return manifold3d.Manifold.hull_points(np.concatenate(points))


def _box(plan: InlayPlan, shape: InlayShape, end: int, high: float) -> manifold3d.Manifold:
    """A proximal box, from its axial wall to the proximal surface, or beyond it where that is bare."""
    sign, rho = (-1.0, 1.0)[end], shape.edge_radius_mm
    tilt, inset = np.tan(np.deg2rad(shape.divergence_deg)), _edge_inset(shape)
    half, up = shape.box_width_mm / 2, high - plan.gingival_z
    outer = plan.proximal_x[end] if plan.covered[end] else plan.outer_x[end]
    points: list[Float[np.ndarray, "_ 3"]] = []
    for side in (-1, 1):
        y = plan.box_y[end] + side * (half - inset)
        points += [_ball((plan.axial_x[end] + sign * inset, y, plan.gingival_z + rho), rho)]
        points += [_disc((outer, y, plan.gingival_z + rho), rho)]
        top = plan.box_y[end] + side * (half + up * tilt)
        points += [np.array([[plan.axial_x[end] - sign * up * tilt, top, high], [outer, top, high]])]
    return manifold3d.Manifold.hull_points(np.concatenate(points))


def _proximal_clearance(plan: InlayPlan, shape: InlayShape, end: int, high: float) -> manifold3d.Manifold:
    """What is cleared beyond the hidden proximal end of a box: the rest of the contact, and a sulcus in the gum."""
    sign, tilt = (-1.0, 1.0)[end], np.tan(np.deg2rad(shape.divergence_deg))
    near, far = plan.proximal_x[end], plan.outer_x[end]
    half, low, up = shape.box_width_mm / 2, plan.gingival_z, high - plan.gingival_z
    points = []
    for side in (-1, 1):
        for x, z, wide in (
            (near, low, half + 0.15),
            (near, low + 1.0, half + 1.0 * tilt),
            (near + 0.1 * sign, low - SULCUS_MM, half + 0.05),
            (near + 0.25 * sign, low - SULCUS_MM, half + 0.05),
            (far, low - SULCUS_MM + 1.7 * (abs(far - near) - 0.25), half + 0.15),
            (near, high, half + up * tilt),
            (far, high, half + up * tilt),
        ):
            points.append((x, plan.box_y[end] + side * wide, z))
    return manifold3d.Manifold.hull_points(np.array(points))


def _edge_inset(shape: InlayShape) -> float:
    """How far inside of a wall, measured at the floor, the rounding of their common edge has its centre."""
    tilt = np.deg2rad(shape.divergence_deg)
    return float(shape.edge_radius_mm * (1 / np.cos(tilt) - np.tan(tilt)))


def _ball(centre: tuple[float, float, float], radius: float) -> Float[np.ndarray, "n 3"]:
    sphere = manifold3d.Manifold.sphere(radius, _ROUND).to_mesh64()
    return np.asarray(sphere.vert_properties)[:, :3] + centre


def _disc(centre: tuple[float, float, float], radius: float) -> Float[np.ndarray, "n 3"]:
    angles = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)
    return np.column_stack([np.zeros(_ROUND), radius * np.cos(angles), radius * np.sin(angles)]) + centre
