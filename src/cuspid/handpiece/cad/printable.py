"""A holder that can be printed: seats for cameras and LEDs, channels for their cables, a neck and a grip; one solid.

Solids by exact booleans (manifold3d), in the rig frame, mm. What is printed is the union of the *shells* less the union
of the *hollows*; every face of the result knows which of them it comes from. :mod:`cuspid.handpiece.cad.shell` says
where they are, :mod:`cuspid.handpiece.cad.printability` what must hold of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from manifold3d import Manifold, OpType

from cuspid.geometry import Rigid3
from cuspid.handpiece.cad.shell import Handle, PrintOptions, Shell, seat_of, shell_of
from cuspid.model.body import Box
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, Light, MountedCamera

_SEGMENTS = 24
"""Of a full circle, where edges are rounded."""
_GRIP_ROUNDED = 0.3
"""Radius of the edges of the grip, in its widths."""
_COLLAR_MM = 0.1
"""Length of the neck that the taper to the grip begins with."""
_SHARP_MM = 0.01
"""Radius of edges that are not rounded."""
_TAPER = 1.5
"""Length of the taper from neck to grip, in the difference of their widths."""
_OPEN_MM = 0.01
"""Seats reach so far out of the front of a head, that rounding leaves no film over them."""
_SIMPLIFIED_MM = 1e-3
"""Slivers that joining leaves are removed as long as the surface moves by less."""
NOTHING_MM3 = 1e-6
"""Volume that rounding may leave."""
_AROUND = 24
"""Rays around the light of an LED."""
_BORDER = 5
"""Rays along an edge of an image."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Printable:
    """A holder, and what it was made of."""

    handpiece: Handpiece
    """With the body that the holder has in a mouth: all but the grip, as boxes around it."""
    solid: Manifold
    """What is printed."""
    shells: Mapping[str, Manifold]
    """What was joined, by name."""
    seats: Mapping[str, Manifold]
    """Pockets by the name of their module, open in front."""
    channels: Mapping[str, Manifold]
    """From each seat to the duct behind it."""
    ducts: Mapping[str, Manifold]
    """Within heads, arms, neck and grip."""
    mesh: Mesh
    """The solid, with the digits that a file keeps."""
    handle_from_rig: Rigid3
    """Origin where the bore of the neck begins, +Y to its end, +Z as the first head looks."""
    source: Int[np.ndarray, "f"]
    """Of each face the index in `names`."""
    names: tuple[str, ...]
    """Of shells, seats, channels and ducts."""

    @property
    def hollows(self) -> dict[str, Manifold]:
        """All that was taken away."""
        return {**self.seats, **self.channels, **self.ducts}


def printable(handpiece: Handpiece, options: PrintOptions = PrintOptions()) -> Printable:
    """The holder of a handpiece; nothing of it is checked yet.

    Raises InputError for a body without a box for a camera or a light, and for a shoulder that leaves no channel.
    """
    shell = shell_of(handpiece, options)
    shells = _shells(shell, options)
    seats = {f"seat of {name}": _seat(box, options).as_original() for name, box in shell.modules.items()}
    channels = {f"channel of {name}": block(box).as_original() for name, box in shell.channels.items()}
    ducts = {name: each.as_original() for name, each in _ducts(shell, options).items()}
    parts = {**shells, **seats, **channels, **ducts}
    raw = (union(shells) - union({**seats, **channels, **ducts})).simplify(_SIMPLIFIED_MM)
    solid = Manifold.compose(pieces(raw))
    mesh, source = _mesh_of(solid, [each.original_id() for each in parts.values()])
    return Printable(
        handpiece=replace(handpiece, body=shell.body),
        solid=solid,
        shells=shells,
        seats=seats,
        channels=channels,
        ducts=ducts,
        mesh=mesh,
        handle_from_rig=shell.handle.handle_from_rig,
        source=source,
        names=tuple(parts),
    )


def block(box: Box) -> Manifold:
    """A box as a solid."""
    return _place_solid(Manifold.cube(2 * box.half_mm, True), box.box_from_rig)


def _shells(shell: Shell, options: PrintOptions) -> dict[str, Manifold]:
    blocks = {name: make_rounded_box(box, options.rounding_mm) for name, box in shell.blocks.items()}
    handle = {"neck": _neck(shell.handle, options)}
    if options.grip_mm:
        handle["grip"] = _grip(shell.handle, options, inside_mm=0.0)
    return {name: each.as_original() for name, each in {**blocks, **handle}.items()}


def _ducts(shell: Shell, options: PrintOptions) -> dict[str, Manifold]:
    heads = {f"duct of head {number}": block(head.tube.inner) for number, head in enumerate(shell.heads, start=1)}
    arms = {f"duct of {name}": block(arm.inner) for name, arm in shell.arms.items()}
    beyond = options.handle_wall_mm + 1.0
    bore = shell.handle.neck.inner
    through = Box(
        Rigid3(np.eye(3), np.array([0, -beyond / 2, 0])) @ bore.box_from_rig, bore.half_mm + [0, beyond / 2, 0]
    )
    grip = {"bore of the grip": _grip(shell.handle, options, options.handle_wall_mm)} if options.grip_mm else {}
    return {**heads, **arms, "bore of the neck": block(through), **grip}


def make_rounded_box(box: Box, radius_mm: float) -> Manifold:
    """A box with rounded edges, within the box."""
    return _place_solid(_rounded_box(box.half_mm, radius_mm), box.box_from_rig)


def _rounded_box(half: Float[np.ndarray, "3"], radius_mm: float) -> Manifold:
    radius = min(radius_mm, 0.999 * float(half.min()))
    ball = Manifold.sphere(radius, _SEGMENTS)
    signs = np.array(list(np.ndindex(2, 2, 2))) * 2 - 1
    return Manifold.batch_hull([ball.translate(sign * (half - radius)) for sign in signs])


def _place_solid(solid: Manifold, own_from_rig: Rigid3) -> Manifold:
    return solid.transform(own_from_rig.inverse().matrix[:3])


def _seat(box: Box, options: PrintOptions) -> Manifold:
    """The room of a module, open in front."""
    forward = Rigid3(np.eye(3), np.array([0, 0, -_OPEN_MM / 2])) @ box.box_from_rig
    return block(Box(forward, seat_of(box, options).half_mm + [0, 0, _OPEN_MM / 2]))


def lines_of_sight(
    handpiece: Handpiece, name: str, options: PrintOptions, rings: int = 1
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "n 3"]]:
    """Where a camera or a light stands and rays in the rig frame, so long that they advance by 1 along its axis: around
    the border of its image or light, and around ``rings`` - 1 smaller ones within it."""
    kind, own = name.split(" ", 1)
    shares = np.arange(1, rings + 1) / rings
    if kind == "camera":
        mounted = handpiece.rig[own]
        return mounted.centre_in_rig, _view(mounted, shares)
    return handpiece.lights[own].position_mm, _lobe(handpiece.lights[own], shares, options.light_half_angle_deg)


def _view(mounted: MountedCamera, shares: Float[np.ndarray, "k"]) -> Float[np.ndarray, "n 3"]:
    camera = mounted.camera
    along = np.linspace(-1, 1, 4 * _BORDER + 1)[:-1]
    ones = np.ones_like(along)
    ring = np.concatenate(
        [np.stack(pair, 1) for pair in ((along, -ones), (ones, along), (-along, ones), (-ones, -along))]
    )
    grid = (shares[:, None, None] * ring).reshape(-1, 2)
    rays = camera.rays((grid + 1) / 2 * [camera.width, camera.height])
    return mounted.cam_from_rig.inverse().rotate(rays)


def _lobe(light: Light, shares: Float[np.ndarray, "k"], half_angle_deg: float) -> Float[np.ndarray, "n 3"]:
    turns = 2 * np.pi * np.arange(_AROUND) / _AROUND
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    sideways = (np.tan(np.deg2rad(half_angle_deg) * shares)[:, None, None] * ring).reshape(-1, 2)
    return light.light_from_rig.inverse().rotate(np.column_stack([sideways, np.ones(len(sideways))]))


def _neck(handle: Handle, options: PrintOptions) -> Manifold:
    """Rounded, but flat at its end."""
    width, start = options.neck_width_mm / 2, -options.handle_wall_mm
    longer = np.array([width, (options.neck_mm - start) / 2 + options.handle_wall_mm, width])
    solid = _rounded_box(longer, options.handle_wall_mm).translate([0, start + longer[1], 0])
    return _place_solid(solid.trim_by_plane((0, -1, 0), -options.neck_mm), handle.handle_from_rig)


def _grip(handle: Handle, options: PrintOptions, inside_mm: float) -> Manifold:
    """The grip with its taper, or what lies inside of it by a wall: then it goes on at both ends."""
    wider = options.grip_width_mm - options.neck_width_mm
    taper = _TAPER * abs(wider)
    start = options.neck_mm + inside_mm * np.tan(np.arctan2(wider / 2, taper) / 2)
    end = options.neck_mm + max(options.grip_mm, taper + 1.0) + (1.0 if inside_mm else 0.0)
    neck, grip = options.neck_width_mm / 2, options.grip_width_mm / 2
    collar = _bar(neck - inside_mm, options.handle_wall_mm - inside_mm, start - _COLLAR_MM, start)
    body = _bar(grip - inside_mm, _GRIP_ROUNDED * options.grip_width_mm - inside_mm, start + taper, end)
    return _place_solid(Manifold.batch_hull([collar, body]), handle.handle_from_rig)


def _bar(half_mm: float, radius_mm: float, start: float, end: float) -> Manifold:
    """Along Y, square, with rounded edges and flat ends."""
    radius = max(radius_mm, _SHARP_MM)
    longer = _rounded_box(np.array([half_mm, (end - start) / 2 + 2 * radius, half_mm]), radius)
    middle = longer.translate([0, (start + end) / 2, 0])
    return middle.trim_by_plane((0, 1, 0), start).trim_by_plane((0, -1, 0), -end)


def views_of(made: Printable) -> tuple[Mesh, Mesh, Mesh]:
    """The whole, its head with a piece of the neck, and the same cut open along the neck."""
    origin = made.handle_from_rig.inverse().translation
    across, along, _ = made.handle_from_rig.rotation
    shown = [box.corners for name, box in made.handpiece.solid.parts.items() if name != "neck"]
    reach = 1.3 * float(np.linalg.norm(np.concatenate(shown) - origin, axis=1).max()) + 3.0
    head = made.solid.trim_by_plane(-along, float(-along @ origin) - reach)
    opened = head.trim_by_plane(-across, float(-across @ origin))
    return made.mesh, surface(head), surface(opened)


def surface(solid: Manifold) -> Mesh:
    """The surface of a solid as a mesh."""
    made = solid.to_mesh64()
    return Mesh(np.asarray(made.vert_properties)[:, :3], np.asarray(made.tri_verts).astype(np.int64))


def pieces(solid: Manifold) -> list[Manifold]:
    """What of a solid hangs together, largest first, without the dust that rounding leaves where surfaces touch."""
    found = [each for each in solid.decompose() if abs(each.volume()) > NOTHING_MM3]
    return sorted(found, key=lambda each: -abs(each.volume()))


def union(solids: Mapping[str, Manifold]) -> Manifold:
    return Manifold.batch_boolean(list(solids.values()), OpType.Add)


def _mesh_of(solid: Manifold, ids: list[int]) -> tuple[Mesh, Int[np.ndarray, "f"]]:
    """The surface, and of each face which of the originals it comes from."""
    made = solid.to_mesh64()
    lengths = np.asarray(np.diff(np.asarray(made.run_index, dtype=np.int64)) // 3, dtype=np.int64)
    source = np.repeat([ids.index(each) for each in made.run_original_id], lengths)
    return surface(solid), source
