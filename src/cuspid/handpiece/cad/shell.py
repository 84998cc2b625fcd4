"""What the walls of a printable holder are to enclose: boxes and, inside of them, the boxes that stay hollow.

Each *group* of cameras that look the same way, with the lights among them, has a head: from the front of its modules to
a duct for cables behind them. Arms are tubes that continue the ducts, behind all modules of their heads, to the line
where the planes of two ducts meet. A neck leaves the first head. Every hollow box lies within its own solid one by a
wall at least; the walls of what they are joined to are then no thinner. Frames: ``head`` is that of the first camera of
a group (or of a light that stands alone), seen from behind: +Z is where it looks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3, unit
from cuspid.handpiece.cad.holder import ALIKE_DEG, group_by_direction, spans
from cuspid.model.body import Body, Box
from cuspid.model.rig import Handpiece
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range

Towards = Literal["left", "right", "up", "down"]
_TOWARDS: Mapping[Towards, tuple[float, float, float]] = {
    "left": (-1, 0, 0),
    "right": (1, 0, 0),
    "up": (0, -1, 0),
    "down": (0, 1, 0),
}
_ROUNDED = 0.5
"""Radius of the edges of heads and arms, in walls."""
_RIM = 0.3
"""So much of that radius the walls beside the seats are thicker, that their rounded rim is no thinner than a wall where
it still faces the seat (within 45 degrees: 1 - cos 45)."""
_OVERLAP_MM = 0.1
"""Of two tubes where they meet, at least; where they bend, as much as the outer side of the bend needs."""
_STEEP = 0.99
"""Cosine to a duct beyond which a tube leaves it backwards."""
_FAR_ELBOW = 3.0
"""An elbow farther from both ducts than so many times their distance is none: the tube goes straight."""


@dataclass(frozen=True, kw_only=True)
class PrintOptions(Options):
    """A holder that can be printed."""

    seat_clearance_mm: Annotated[float, Range(0, 10)] = 0.05
    """Gap between a module and the walls of its seat; there is none behind it, where it rests."""
    wall_mm: Annotated[float, Range(0.05, 100)] = 0.8
    """Minimum wall thickness between a hollow and the outside, or behind a seat."""
    web_mm: Annotated[float, Range(0.01, 100)] = 0.1
    """Minimum wall thickness between two seats."""
    shoulder_mm: Annotated[float, Range(0.01, 100)] = 0.1
    """Width of the rim on which a module rests, around the channel for its cable."""
    duct_mm: Annotated[float, Range(0.1, 100)] = 1.0
    """Depth of the cable ducts behind the modules."""
    arm_width_mm: Annotated[float, Range(0.2, 1000)] = 4.0
    """Width of the tubes that join the heads."""
    neck_mm: Annotated[float, Range(1, 1000)] = 50.0
    """Distance from the middle of the first head to the grip."""
    neck_width_mm: Annotated[float, Range(0.2, 1000)] = 6.0
    """Width and height of the neck."""
    neck_towards: Towards = "left"
    """Direction in which the neck leaves the first head, in the images of its first camera."""
    grip_mm: Annotated[float, Range(0, 1000)] = 90.0
    """Length of the grip; 0 omits it."""
    grip_width_mm: Annotated[float, Range(0.2, 1000)] = 14.0
    """Width and height of the grip."""
    handle_wall_mm: Annotated[float, Range(0.05, 100)] = 1.5
    """Wall thickness of the neck and the grip."""
    light_half_angle_deg: Annotated[float, Range(0, 85)] = 35.0
    """Angle around the axis of an LED within which its light must not be blocked."""
    mouth_opening_mm: Annotated[float | None, Range(0.1, 1000)] = None
    """Space available between the teeth for working distance and holder; not checked unless given."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, width_mm, wall_mm in (
            ("arm_width_mm", self.arm_width_mm, self.wall_mm),
            ("neck_width_mm", self.neck_width_mm, self.handle_wall_mm),
            ("grip_width_mm", self.grip_width_mm, self.handle_wall_mm),
        ):
            if width_mm <= 2 * wall_mm:
                option = name.replace("_", "-")
                raise InputError(
                    f"print: --{option} is {width_mm:g}; it must be wider than two walls of {wall_mm:g} mm"
                )
        if self.handle_wall_mm < self.wall_mm:
            raise InputError(
                f"print: --handle-wall-mm is {self.handle_wall_mm:g}; it must not be less than --wall-mm "
                f"{self.wall_mm:g}"
            )

    @property
    def rounding_mm(self) -> float:
        """Radius of the edges of heads and arms."""
        return _ROUNDED * self.wall_mm


@dataclass(frozen=True, eq=False, kw_only=True)
class Tube:
    """A solid box and the hollow one within it."""

    outer: Box
    """What is printed of it."""
    inner: Box
    """What stays free in it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Head:
    """Modules that look the same way, and the duct behind them."""

    head_from_rig: Rigid3
    """Where it looks: +Z."""
    modules: Mapping[str, Box]
    """By the name of the part."""
    channels: Mapping[str, Box]
    """From the middle of the seat of each module to the middle of the duct."""
    tube: Tube
    """The block that they are let into, and its duct."""
    collars: Mapping[str, Box]
    """Around modules that stand out of the block by more than half their depth, by the name of the part."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Handle:
    """The neck, and what is needed to build the grip behind it."""

    handle_from_rig: Rigid3
    """Origin in the middle of the bore where it begins, +Y to where it ends, +Z as the first head looks."""
    neck: Tube
    """Its boxes, a wall longer at the beginning."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shell:
    """All of it."""

    heads: tuple[Head, ...]
    """The first carries the neck."""
    arms: Mapping[str, Tube]
    """By name: two for each further head."""
    handle: Handle
    """The neck."""

    @property
    def modules(self) -> dict[str, Box]:
        """All modules by the name of the part."""
        return {name: box for head in self.heads for name, box in head.modules.items()}

    @property
    def channels(self) -> dict[str, Box]:
        """All channels by the name of the part that they lead to."""
        return {name: box for head in self.heads for name, box in head.channels.items()}

    @property
    def body(self) -> Body:
        """What takes up room in a mouth: all but the grip."""
        return Body({**self.modules, **self.blocks, "neck": self.handle.neck.outer})

    @property
    def blocks(self) -> dict[str, Box]:
        """What is solid of heads and arms, before anything is taken away."""
        heads = {f"head {number}": head.tube.outer for number, head in enumerate(self.heads, start=1)}
        collars = {f"collar of {name}": box for head in self.heads for name, box in head.collars.items()}
        return {**heads, **collars, **{name: arm.outer for name, arm in self.arms.items()}}


def shell_of(handpiece: Handpiece, options: PrintOptions) -> Shell:
    """The boxes of a holder for the modules that the body of a handpiece names (where it has none, assumed ones).

    Raises InputError for a body without a box for a camera or a light, or with one that looks elsewhere, and for a
    shoulder that leaves no channel.
    """
    heads = tuple(_head(frame, modules, options) for frame, modules in _groups(handpiece, module_boxes(handpiece)))
    arms: dict[str, Tube] = {}
    for number, head in enumerate(heads[1:], start=1):
        root, tip = _arm(heads[0], head, options)
        arms |= {f"arm {number} root": root, f"arm {number} tip": tip}
    return Shell(heads=heads, arms=arms, handle=_handle(heads[0], options))


def module_boxes(handpiece: Handpiece) -> dict[str, Box]:
    """The boxes of cameras and lights, by the name of the part, each with its +Z where that looks.

    Raises InputError where one is missing or looks elsewhere.
    """
    axes = {f"camera {name}": each.axis_in_rig for name, each in handpiece.rig.cameras.items()}
    axes |= {f"light {name}": each.direction for name, each in handpiece.lights.items()}
    parts = handpiece.solid.parts
    for name, axis in axes.items():
        if name not in parts:
            raise InputError(
                f"holder: the body of {handpiece.name} has no box named {name!r}; add it, or leave out the body to "
                "get modules of the default size"
            )
        if parts[name].box_from_rig.rotation[2] @ axis < np.cos(np.deg2rad(1.0)):
            raise InputError(f"holder: +Z of the box {name!r} of {handpiece.name} must point where {name} looks")
    return {name: parts[name] for name in axes}


def _groups(handpiece: Handpiece, modules: Mapping[str, Box]) -> list[tuple[Rigid3, dict[str, Box]]]:
    """Cameras that look the same way, with the lights that shine most nearly that way; other lights by themselves."""
    groups: list[tuple[Rigid3, dict[str, Box]]] = [
        (handpiece.rig[names[0]].cam_from_rig, {f"camera {name}": modules[f"camera {name}"] for name in names})
        for names in group_by_direction(handpiece)
    ]
    for name in (f"light {each}" for each in handpiece.lights):
        frame = modules[name].box_from_rig
        cosines = [group.rotation[2] @ frame.rotation[2] for group, _ in groups]
        nearest = int(np.argmax(cosines))
        if cosines[nearest] > np.cos(np.deg2rad(ALIKE_DEG)):
            groups[nearest][1][name] = modules[name]
        else:
            groups.append((frame, {name: modules[name]}))
    return groups


def _head(head_from_rig: Rigid3, modules: Mapping[str, Box], options: PrintOptions) -> Head:
    boxes = list(modules.values())
    floor = spans(boxes, head_from_rig)[0, 2] - options.wall_mm
    ceiling = floor - options.duct_mm
    fronts = {name: _front(head_from_rig, seat_of(box, options)) for name, box in modules.items()}
    front = min(low for low, _ in fronts.values())
    channels = {
        name: _channel(name, box, head_from_rig, (floor + ceiling) / 2, options) for name, box in modules.items()
    }
    low, high = spans([*boxes, *channels.values()], head_from_rig)[:, :2]
    beside = options.wall_mm + options.seat_clearance_mm + _RIM * options.rounding_mm
    return Head(
        head_from_rig=head_from_rig,
        modules=modules,
        channels=channels,
        collars={
            name: _collar(box, head_from_rig, front, beside)
            for name, box in modules.items()
            if fronts[name][1] - front > box.half_mm[2]
        },
        tube=Tube(
            outer=_box(head_from_rig, [*(low - beside), ceiling - options.wall_mm], [*(high + beside), front]),
            inner=_box(head_from_rig, [*low, ceiling], [*high, floor]),
        ),
    )


def _channel(name: str, module: Box, head_from_rig: Rigid3, middle_mm: float, options: PrintOptions) -> Box:
    """From the middle of a module backwards to a depth in its head."""
    width = module.half_mm[:2] - options.shoulder_mm
    if width.min() <= 0:
        raise InputError(
            f"print: --shoulder-mm is {options.shoulder_mm:g}; {name} is {2 * module.half_mm[:2].min():g} mm wide, "
            "which leaves no room for its cable"
        )
    head_from_module = head_from_rig @ module.box_from_rig.inverse()
    length = (head_from_module.translation[2] - middle_mm) / head_from_module.rotation[2, 2]
    return Box(Rigid3(np.eye(3), np.array([0, 0, length / 2])) @ module.box_from_rig, np.array([*width, length / 2]))


def seat_of(module: Box, options: PrintOptions) -> Box:
    """A module with its clearance at the sides."""
    return replace(module, half_mm=module.half_mm + [options.seat_clearance_mm, options.seat_clearance_mm, 0])


def _front(head_from_rig: Rigid3, seat: Box) -> tuple[float, float]:
    """Least and largest Z of the front of a seat."""
    corners = head_from_rig.apply(seat.corners[1::2])[:, 2]
    return float(corners.min()), float(corners.max())


def _collar(module: Box, head_from_rig: Rigid3, front: float, beside_mm: float) -> Box:
    """Around a module, from its own front back into the head."""
    head_from_module = head_from_rig @ module.box_from_rig.inverse()
    ahead = head_from_module.apply(np.array([[0, 0, module.half_mm[2]]]))[0, 2]
    sunk = (ahead - front) / head_from_module.rotation[2, 2] + beside_mm
    half = np.array([*(module.half_mm[:2] + beside_mm), module.half_mm[2]])
    return _box(module.box_from_rig, [*-half[:2], half[2] - sunk], half.tolist())


def _box(frame_from_rig: Rigid3, low: Sequence[float], high: Sequence[float]) -> Box:
    """Between two corners in a frame."""
    lower, upper = np.array(low, dtype=float), np.array(high, dtype=float)
    return Box(Rigid3(np.eye(3), -(lower + upper) / 2) @ frame_from_rig, (upper - lower) / 2)


def _arm(one: Head, other: Head, options: PrintOptions) -> tuple[Tube, Tube]:
    """From the duct of one head to where its plane meets that of the other, and from there to the other."""
    elbow = _elbow(one, other)
    to_one, to_other = (unit(_centre(head) - elbow) for head in (one, other))
    bend = np.sqrt(max(0.0, 1 + to_one @ to_other) / max(1e-9, 1 - to_one @ to_other))
    beyond = max(_OVERLAP_MM, options.duct_mm / 2 * min(float(bend), 1.0))
    return _tube_to(one, elbow, beyond, options), _tube_to(other, elbow, beyond, options)


def _elbow(one: Head, other: Head) -> Float[np.ndarray, "3"]:
    """Of the points in the planes of both ducts the one nearest to both; between them where there is none."""
    starts = np.array([_centre(one), _centre(other)])
    normals = np.array([head.head_from_rig.rotation[2] for head in (one, other)])
    middle = starts.mean(axis=0)
    if np.linalg.norm(np.cross(*normals)) < np.sin(np.deg2rad(10)):
        return middle
    offsets = np.sum(normals * (starts - middle), axis=1)
    elbow = middle + np.linalg.lstsq(normals, offsets, rcond=None)[0]
    far = np.linalg.norm(starts - elbow, axis=1).max() > _FAR_ELBOW * np.linalg.norm(starts[0] - starts[1])
    return middle if far else np.asarray(elbow)


def _centre(head: Head) -> Float[np.ndarray, "3"]:
    """Of its duct, in the rig frame."""
    return head.tube.inner.box_from_rig.inverse().translation


def _tube_to(head: Head, end: Float[np.ndarray, "3"], beyond_mm: float, options: PrintOptions) -> Tube:
    """A tube from the middle of a duct to a point and beyond."""
    start = _centre(head)
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length if length > 1e-9 else head.head_from_rig.rotation[0]
    _, up, back = head.head_from_rig.rotation
    z = next(unit(each - (each @ along) * along) for each in (back, up) if abs(each @ along) < _STEEP)
    frame = _frame(start, along, z)
    half = np.array([options.arm_width_mm / 2 - options.wall_mm, 0.0, options.duct_mm / 2])
    low, high = -half, half + [0.0, length + beyond_mm, 0.0]
    return Tube(
        outer=_box(frame, (low - options.wall_mm).tolist(), (high + options.wall_mm).tolist()),
        inner=_box(frame, low.tolist(), high.tolist()),
    )


def _frame(origin: Float[np.ndarray, "3"], y: Float[np.ndarray, "3"], z: Float[np.ndarray, "3"]) -> Rigid3:
    """``frame_from_rig`` with these axes."""
    axes = np.stack([np.cross(y, z), y, z])
    return Rigid3(axes, -axes @ origin)


def _handle(head: Head, options: PrintOptions) -> Handle:
    """Its bore begins in the duct, whose front it shares, so that it stays behind the lenses."""
    rotation = head.head_from_rig.rotation
    bore = options.neck_width_mm / 2 - options.handle_wall_mm
    forward = options.duct_mm / 2 - bore
    frame = _frame(
        _centre(head) + forward * rotation[2], np.array(_TOWARDS[options.neck_towards]) @ rotation, rotation[2]
    )
    half = options.neck_width_mm / 2
    return Handle(
        handle_from_rig=frame,
        neck=Tube(
            outer=_box(frame, [-half, -options.handle_wall_mm, -half], [half, options.neck_mm, half]),
            inner=_box(frame, [-bore, 0.0, -bore], [bore, options.neck_mm, bore]),
        ),
    )
