"""What must hold of a printable holder, and what is measured of it. Each rule fails with one line.

Walls are measured by rays: from points spread over each part of the surface straight inwards to where they come out, if
that surface faces the first one within 45 degrees. The thickness is taken along the normal, at points some hundredths
of a millimetre apart on small parts and a millimetre apart on the grip: what is thin along a line only, a wedge sharper
than 45 degrees, or a dent smaller than that spacing is missed. Edges are not walls.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise, product

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from manifold3d import Error, Manifold

from cuspid.geometry import Rigid3
from cuspid.handpiece.cad.printable import NOTHING_MM3, Printable, block, lines_of_sight, pieces, surface, union
from cuspid.handpiece.cad.shell import PrintOptions, module_boxes
from cuspid.model.body import Box
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.runtime.errors import InputError

_POINTS = 1500
"""On each part of the surface."""
_FACING = np.cos(np.deg2rad(45))
_INSIDE_MM = 1e-3
"""Rays start so far below the surface."""
_TOLERANCE = 0.02
"""Of a thickness: rounded edges are polygons."""
_RINGS = 8
"""Rays around the border of an image, and around so many smaller ones within it."""
_G_PER_MM3 = 1.2e-3
"""Of printing resins: about 1.1 to 1.25 g/cm3."""


@dataclass(frozen=True, kw_only=True)
class Wall:
    """The thinnest place between two parts."""

    thickness_mm: float
    """Across it."""
    between: tuple[str, str]
    """Parts whose surfaces face each other."""
    place_mm: tuple[float, float, float]
    """In the rig frame."""

    def __str__(self) -> str:
        at = ", ".join(f"{each:.1f}" for each in self.place_mm)
        return f"{self.thickness_mm:.2f} mm between {self.between[0]} and {self.between[1]} at ({at}) mm"


@dataclass(frozen=True, kw_only=True)
class Printability:
    """What was measured."""

    size_mm: tuple[float, float, float]
    """Of the box around it, along the axes of the rig frame."""
    volume_mm3: float
    """Of what is printed."""
    wall: Wall
    """The thinnest one to the outside or to a duct."""
    web: Wall | None
    """The thinnest one between two seats or channels; None where none is met."""
    thickness_mm: float
    """How far the holder, without the grip, reaches beyond the working distance."""

    @property
    def weight_g(self) -> float:
        """In a resin of 1.2 g/cm3."""
        return self.volume_mm3 * _G_PER_MM3


def check_printable(made: Printable, options: PrintOptions) -> Printability:
    """Measure a holder. Raises InputError for the first rule that it breaks: what, where, what to change."""
    check_seats(made, options)
    check_solid(made)
    check_insertion(made)
    check_sight(made.solid, made.handpiece, options)
    wall, web = thinnest(made, options)
    height_mm = _check_mouth(made.handpiece, options)
    size = np.ptp(made.mesh.bounds, axis=0)
    return Printability(
        size_mm=(float(size[0]), float(size[1]), float(size[2])),
        volume_mm3=made.solid.volume(),
        wall=wall,
        web=web,
        thickness_mm=height_mm,
    )


def check_seats(made: Printable, options: PrintOptions) -> None:
    """Raise InputError where modules overlap or leave no web between their seats, or a duct or channel cuts a seat."""
    modules = module_boxes(made.handpiece)
    blocks = {name: block(box) for name, box in modules.items()}
    reach_mm = options.web_mm + 4 * options.seat_clearance_mm
    near = [
        pair for pair in combinations(modules, 2) if _ball_clearance_mm(*(modules[name] for name in pair)) < reach_mm
    ]
    for one, other in near:
        if (blocks[one] ^ blocks[other]).volume() > NOTHING_MM3:
            raise InputError(
                f"holder: the modules of {one} and {other} overlap; move them farther apart, or give smaller modules "
                "(--holder.camera-mm, --holder.led-mm, or the body in handpiece.json)"
            )
    for one, other in near:
        gap = made.seats[f"seat of {one}"].min_gap(made.seats[f"seat of {other}"], 2 * options.web_mm)
        if gap < options.web_mm - 1e-6:
            raise InputError(
                f"holder: the wall between the seats of {one} and {other} is {gap:.2f} mm thick, less than --web-mm "
                f"{options.web_mm:g}; move them farther apart, or give smaller modules, a smaller --seat-clearance-mm "
                "or a thinner web"
            )
    for (seat, pocket), (duct, hollow) in product(made.seats.items(), {**made.ducts, **made.channels}.items()):
        own = duct.removeprefix("channel of ") == seat.removeprefix("seat of ")
        if not own and (pocket ^ hollow).volume() > NOTHING_MM3:
            raise InputError(
                f"holder: the {duct} runs through the {seat}; rearrange the cameras, or make --duct-mm, "
                "--arm-width-mm or --neck-width-mm smaller"
            )


def _ball_clearance_mm(one: Box, other: Box) -> float:
    """Least distance that the balls around two boxes keep."""
    centres = [box.box_from_rig.inverse().translation for box in (one, other)]
    reach = np.linalg.norm(one.half_mm) + np.linalg.norm(other.half_mm)
    return float(np.linalg.norm(centres[0] - centres[1]) - reach)


def check_solid(made: Printable) -> None:
    """Raise InputError unless the holder is one closed solid, also as a file stores it, and its hollows are one."""
    if made.solid.status() != Error.NoError or made.solid.volume() <= 0:
        raise InputError(f"holder: it does not form a solid ({made.solid.status().name}); try other sizes")
    found = pieces(made.solid)
    if len(found) > 1:
        raise InputError(
            f"holder: it falls into {len(found)} pieces, one around {_part_of(made, found[1])}; make --arm-width-mm, "
            "--neck-width-mm or the walls larger, or rearrange the cameras"
        )
    for one, other in pairwise(pieces(union(made.hollows))):
        raise InputError(
            f"holder: a cable cannot pass from {_part_of(made, other)} to {_part_of(made, one)}; make --duct-mm or "
            "--arm-width-mm larger"
        )
    stored = trimesh.Trimesh(made.mesh.vertices.astype(np.float32), made.mesh.faces)
    if not (stored.is_watertight and stored.is_winding_consistent):
        raise InputError(
            "holder: its surface does not stay closed in the single precision of the files; change a size slightly"
        )


def _part_of(made: Printable, piece: Manifold) -> str:
    """The part in which a piece lies."""
    low, high = np.reshape(piece.bounding_box(), (2, 3))
    parts = made.handpiece.solid
    return parts.names[int(parts.distances((low + high)[None] / 2)[1][0])]


def check_insertion(made: Printable) -> None:
    """Raise InputError where a module does not fit its seat, or not into it from the front."""
    for name, box in module_boxes(made.handpiece).items():
        ahead = Rigid3(np.eye(3), np.array([0, 0, -box.half_mm[2]])) @ box.box_from_rig
        stopped = block(Box(ahead, box.half_mm * [1, 1, 2])) ^ made.solid
        if stopped.volume() > NOTHING_MM3:
            by = [shell for shell, each in made.shells.items() if (stopped ^ each).volume() > NOTHING_MM3 / 10]
            raise InputError(
                f"holder: {name} cannot be pushed into its seat from the front, blocked by {' and '.join(by)}; "
                "move the cameras farther apart or turn them less"
            )


def check_sight(solid: Manifold, handpiece: Handpiece, options: PrintOptions) -> None:
    """Raise InputError where a solid or a module is in the way of a view or a light, up to the far end of the depth
    range."""
    modules = module_boxes(handpiece)
    mesh = surface(solid + union({name: block(box) for name, box in modules.items()}))
    for name in modules:
        origin, rays = lines_of_sight(handpiece, name, options, rings=_RINGS)
        hits = mesh.cast(origin + _INSIDE_MM * rays, rays)
        blocked = hits.distances < handpiece.depth_range_mm[1]
        if blocked.any():
            nearest = int(np.argmin(hits.distances))
            place = origin + hits.distances[nearest] * rays[nearest]
            part = handpiece.solid.names[int(handpiece.solid.distances(place[None])[1][0])]
            raise InputError(
                f"holder: {part} blocks {name}, {hits.distances[nearest]:.1f} mm in front of it, for "
                f"{blocked.mean():.0%} of its rays; move one of them, make {part} smaller, or require less light "
                "(--light-half-angle-deg)"
            )


def thinnest(made: Printable, options: PrintOptions) -> tuple[Wall, Wall | None]:
    """The thinnest wall and the thinnest web. Raises InputError for one that is thinner than asked for."""
    walls, webs = _walls(made)
    wall, web = (min(each, key=lambda one: one.thickness_mm, default=None) for each in (walls, webs))
    for found, least_mm, option in ((wall, options.wall_mm, "--wall-mm"), (web, options.web_mm, "--web-mm")):
        if found is not None and found.thickness_mm < (1 - _TOLERANCE) * least_mm:
            raise InputError(f"holder: a wall is only {found}, less than {option} {least_mm:g}; move the parts apart")
    if wall is None:
        raise InputError("holder: none of its walls could be measured; try other sizes")
    return wall, web


def _walls(made: Printable) -> tuple[list[Wall], list[Wall]]:
    """The thinnest place of each part of the surface: to others, and of pockets to each other."""
    pockets = np.array([name in made.seats or name in made.channels for name in made.names])
    ducts = np.array([name in made.ducts for name in made.names])
    walls: list[Wall] = []
    webs: list[Wall] = []
    for start in np.unique(made.source):
        points, thickness, end = _wall_samples(made.mesh, made.source == start)
        across_pockets = pockets[start] & pockets[made.source[end]]
        across_ducts = ducts[start] & ducts[made.source[end]]
        for found, which in ((walls, ~across_pockets & ~across_ducts), (webs, across_pockets)):
            at = int(np.argmin(np.where(which, thickness, np.inf)))
            if which[at] and np.isfinite(thickness[at]):
                between = (made.names[start], made.names[made.source[end[at]]])
                x, y, z = points[at].tolist()
                found.append(Wall(thickness_mm=float(thickness[at]), between=between, place_mm=(x, y, z)))
    return walls, webs


def _wall_samples(
    mesh: Mesh, part: Bool[np.ndarray, "f"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Points on a part of a surface, how thick the wall is there (infinite where none is), and the face across."""
    points, faces = mesh.submesh(part).sample(_POINTS, np.random.default_rng(0))
    normals = mesh.normals_of(np.flatnonzero(part)[faces])
    hits = mesh.cast(points - _INSIDE_MM * normals, -normals)
    facing = (hits.faces >= 0) & (np.sum(mesh.normals_of(hits.faces) * -normals, axis=1) > _FACING)
    return points, np.where(facing, hits.distances + _INSIDE_MM, np.inf), hits.faces


def _check_mouth(handpiece: Handpiece, options: PrintOptions) -> float:
    """How far the holder reaches beyond the working distance. Raises InputError where the mouth is not open as wide."""
    thickness_mm, distance_mm = handpiece.thickness_mm, handpiece.working_distance_mm
    if options.mouth_opening_mm is not None and thickness_mm + distance_mm > options.mouth_opening_mm:
        raise InputError(
            f"holder: it is {thickness_mm:.1f} mm thick and {distance_mm:g} mm over the teeth, together more than "
            f"--mouth-opening-mm {options.mouth_opening_mm:g}; make --neck-width-mm, --duct-mm or the modules smaller"
        )
    return thickness_mm
