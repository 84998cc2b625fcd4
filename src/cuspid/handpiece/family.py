"""A family of handpieces, from a pair of cameras to the thesis' twelve and beyond, for an optimiser to choose from.

Rig frame and groups as in :mod:`cuspid.handpiece.designs`: a group over the teeth, one more camera on either side of
it, and a group on either side of the tooth. Buccal and lingual mirror each other. A group of two has them along the
arch, one of three a third on the side away from the gum, one of four is the thesis' cross.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import look_at
from cuspid.handpiece.optics import Optics
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How many cameras look from where."""

    occlusal: int
    """Over the teeth: 2 or 4."""
    outer: int
    """Beside these, further out and tilted inwards: 0 or 2."""
    side: int
    """On the buccal and on the lingual side, each: 0, 2, 3 or 4."""

    @property
    def cameras(self) -> int:
        """All together."""
        return self.occlusal + self.outer + 2 * self.side

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the fields of `Shape` that this layout depends on."""
        names = ["distance_mm", "along_mm"]
        names += ["across_mm"] if self.occlusal == 4 else []
        names += ["outer_distance_mm", "outer_tilt_deg"] if self.outer else []
        names += ["side_tilt_deg", "side_offset_mm", "side_depth_mm", "side_along_mm"] if self.side else []
        names += ["side_across_mm"] if self.side > 2 else []
        return tuple(names)

    def __str__(self) -> str:
        return f"{self.occlusal}+{self.outer}+2x{self.side}"


LAYOUTS = tuple(Layout(occlusal=o, outer=e, side=s) for o in (2, 4) for e in (0, 2) for s in (0, 2, 3, 4))
"""All of the family: 2 to 14 cameras."""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """Lengths and angles; the defaults are the thesis'."""

    distance_mm: float = 5.0
    """From the cameras to the surface that they look at."""
    across_mm: float = 2.5
    """Baseline of the occlusal group across the arch."""
    along_mm: float = 1.5
    """Baseline of the occlusal group along the arch."""
    outer_distance_mm: float = 2.0
    """From the occlusal group's last camera across the arch to the outer one."""
    outer_tilt_deg: float = 0.0
    """Lean of the outer cameras towards the middle."""
    side_tilt_deg: float = 60.0
    """Angle between the occlusal axis and those of the side groups."""
    side_offset_mm: float = 4.5
    """From the middle of the crown to where the side groups look."""
    side_depth_mm: float = 2.5
    """From the cusp tips down to there."""
    side_across_mm: float = 2.5
    """Baseline of a side group up the tooth."""
    side_along_mm: float = 1.5
    """Baseline of a side group along the arch."""


BOUNDS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "across_mm": (1.0, 4.0),
        "along_mm": (1.0, 4.0),
        "outer_distance_mm": (1.0, 5.0),
        "outer_tilt_deg": (0.0, 60.0),
        "side_tilt_deg": (35.0, 85.0),
        "side_offset_mm": (2.0, 6.0),
        "side_depth_mm": (0.5, 6.0),
        "side_across_mm": (1.0, 4.0),
        "side_along_mm": (1.0, 4.0),
    }
)
"""Of all but the working distance, which the brief bounds."""


def build_handpiece(
    layout: Layout, shape: Shape, optics: Optics, depth_range_mm: tuple[float, float], name: str = "designed"
) -> Handpiece:
    """The handpiece of a layout and a shape."""
    cameras: dict[str, MountedCamera] = {}
    lights: dict[str, Light] = {}
    for prefix, (count, group_from_rig, across, along) in _groups(layout, shape).items():
        for number, (x, y) in enumerate(_places(count, across, along), start=1):
            cam_from_group = Rigid3(np.eye(3), np.array([-x, -y, 0.0]))
            cameras[f"{prefix}{number}"] = MountedCamera(optics.camera, cam_from_group @ group_from_rig)
        corners = [(x, y) for y in (-across / 2, across / 2) for x in (-along, along)]
        for number, (x, y) in enumerate(corners, start=1):
            lights[f"{prefix}{number}"] = _light(group_from_rig, x, y)
    if layout.outer:
        for number, side in ((5, +1), (6, -1)):
            cameras[f"o{number}"] = MountedCamera(optics.camera, _outer_view(layout, shape, side))
            lights[f"o{number}"] = _light(
                _occlusal_view(shape), 0.0, -side * (_reach(layout, shape) - shape.outer_distance_mm / 2)
            )
    return Handpiece(
        rig=Rig(cameras),
        lights=lights,
        lightings=(Lighting(name="all", lights=tuple(lights)),),
        working_distance_mm=shape.distance_mm,
        depth_range_mm=depth_range_mm,
        name=name,
    )


def _groups(layout: Layout, shape: Shape) -> dict[str, tuple[int, Rigid3, float, float]]:
    """By prefix: number of cameras, ``group_from_rig``, baselines across and along."""
    groups = {"o": (layout.occlusal, _occlusal_view(shape), shape.across_mm, shape.along_mm)}
    if layout.side:
        for prefix, side in (("b", +1), ("l", -1)):
            groups[prefix] = (layout.side, _side_view(shape, side), shape.side_across_mm, shape.side_along_mm)
    return groups


def _places(count: int, across_mm: float, along_mm: float) -> list[tuple[float, float]]:
    """In the plane of the images: x to the right, y down."""
    pair = [(-along_mm / 2, 0.0), (along_mm / 2, 0.0)]
    if count == 2:
        return pair
    return [(0.0, -across_mm / 2), *([(0.0, across_mm / 2)] if count == 4 else []), *pair]


def _light(group_from_rig: Rigid3, x_mm: float, y_mm: float) -> Light:
    rig_from_group = group_from_rig.inverse()
    return Light(
        position_mm=rig_from_group.apply(np.array([x_mm, y_mm, 0.0])), direction=rig_from_group.rotation[:, 2].copy()
    )


def _occlusal_view(shape: Shape) -> Rigid3:
    return look_at(np.zeros(3), np.array([0, 0, -1.0]), np.array([1.0, 0, 0]), shape.distance_mm)


def _side_view(shape: Shape, side: int) -> Rigid3:
    target = np.array([0, side * shape.side_offset_mm, -shape.side_depth_mm])
    return look_at(target, _inwards(shape.side_tilt_deg, side), np.array([-side, 0.0, 0.0]), shape.distance_mm)


def _outer_view(layout: Layout, shape: Shape, side: int) -> Rigid3:
    centre = np.array([0, side * _reach(layout, shape), shape.distance_mm])
    return look_at(centre, _inwards(shape.outer_tilt_deg, side), np.array([1.0, 0, 0]), 0.0)


def _inwards(tilt_deg: float, side: int) -> Float[np.ndarray, "3"]:
    tilt = np.deg2rad(tilt_deg)
    return np.array([0, -side * np.sin(tilt), -np.cos(tilt)])


def _reach(layout: Layout, shape: Shape) -> float:
    """Of the outer cameras, from the middle across the arch."""
    return (shape.across_mm / 2 if layout.occlusal == 4 else 0.0) + shape.outer_distance_mm
