"""A handpiece: cameras rigidly mounted together, lights, and the properties of the sensors.

Frames: ``rig`` is the frame of the handpiece, ``cam`` that of one camera; ``cam_from_rig`` is constant. The rig frame
is arbitrary; COLMAP requires it to be the frame of a reference camera, see :meth:`Rig.rebased`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from cuspid.geometry import Rigid3, axes_about, read_only, unit
from cuspid.model.body import CAMERA_MM, LED_MM, Body, module
from cuspid.model.camera import Camera
from cuspid.model.shutter import PLAIN, Shutter
from cuspid.runtime.display import Viewable
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import checked_name, join_names, one_line, quote
from cuspid.runtime.workers import computed_once

_NO_SIDE = 1e-3
"""Length of the mean of unit vectors below which they have no common direction."""


@dataclass(frozen=True, eq=False)
class MountedCamera:
    """A camera and its pose in the handpiece."""

    camera: Camera
    """Intrinsic calibration."""
    cam_from_rig: Rigid3
    """Extrinsic calibration."""
    covariance: Float[np.ndarray, "6 6"] | None = None
    """Covariance of a small motion (rotation vector rad, translation mm) applied on the left of ``cam_from_rig``; zero
    for an exact one, None if its uncertainty is not stated (an adjustment then holds it fixed)."""
    shutter: Shutter = PLAIN
    """When its rows are exposed."""

    @property
    def centre_in_rig(self) -> Float[np.ndarray, "3"]:
        """Projection centre in the rig frame, mm."""
        return self.cam_from_rig.inverse().translation

    @property
    def axis_in_rig(self) -> Float[np.ndarray, "3"]:
        """Unit viewing direction in the rig frame."""
        return self.cam_from_rig.rotation[2]


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras by name, in a fixed order."""

    cameras: Mapping[str, MountedCamera]
    """Name to mounted camera; the order is kept and the first one is the reference for COLMAP."""

    def __post_init__(self) -> None:
        if not self.cameras:
            raise InputError("rig: at least one camera is needed")
        for key in self.cameras:
            checked_name("rig: cameras", key)
        object.__setattr__(self, "cameras", MappingProxyType(dict(self.cameras)))

    def __repr__(self) -> str:
        sizes = sorted({f"{each.camera.width} x {each.camera.height}" for each in self.cameras.values()})
        plural = "s" if len(self.cameras) > 1 else ""
        return f"Rig({len(self.cameras)} camera{plural} of {join_names(sizes, 3)} px)"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras in order."""
        return tuple(self.cameras)

    def __getitem__(self, name: str) -> MountedCamera:
        if name not in self.cameras:
            raise InputError(f"rig: no camera named {name!r}; it has {', '.join(self.cameras)}")
        return self.cameras[name]

    def in_own_order(self) -> Rig:
        """The same rig with its cameras ordered by position, whatever their given order and names."""
        ordered = sorted(self.cameras, key=lambda name: self[name].cam_from_rig.matrix[:3, ::-1].T.ravel().tolist())
        return Rig({name: self[name] for name in ordered})

    def rebased(self, reference: str | None = None) -> tuple[Rig, Rigid3]:
        """The same rig in the frame of one of its cameras (default: the first), and ``reference_from_rig``."""
        reference_from_rig = self[reference or self.names[0]].cam_from_rig
        return self.in_frame(reference_from_rig), reference_from_rig

    def over_surface(self, distance_mm: float) -> Rig:
        """The same rig in a frame on the surface that it looks at from a distance: +Z back to the cameras, against
        their mean axis, +X to the right in the image of the camera that looks most nearly along that axis. Raises
        InputError for cameras that look in all directions."""
        mounted = list(self.cameras.values())
        axes = np.array([each.axis_in_rig for each in mounted])
        if np.linalg.norm(axes.mean(axis=0)) < _NO_SIDE:
            raise InputError("rig: its cameras look in all directions, not at one surface")
        back = unit(-axes.mean(axis=0))
        right = mounted[int(np.argmin(axes @ back))].cam_from_rig.rotation[0]
        right = unit(right - (right @ back) * back)
        rotation = np.stack([right, np.cross(back, right), back])
        origin = np.mean([each.centre_in_rig for each in mounted] + distance_mm * axes, axis=0)
        return self.in_frame(Rigid3(rotation, -rotation @ origin))

    def in_frame(self, new_from_rig: Rigid3) -> Rig:
        """The same rig in another frame."""
        rig_from_new = new_from_rig.inverse()
        return Rig(
            {
                name: replace(mounted, cam_from_rig=mounted.cam_from_rig @ rig_from_new)
                for name, mounted in self.cameras.items()
            }
        )

    def motion_onto(self, other: Rig) -> Rigid3:
        """``other_from_self``: the rigid motion that lays the cameras which both rigs have, of which there must be one,
        on those of the other on the whole (mean rotation, mean centre)."""
        both = [name for name in self.names if name in other.names]
        turns = [other[name].cam_from_rig.rotation.T @ self[name].cam_from_rig.rotation for name in both]
        turn = Rotation.from_matrix(np.stack(turns)).mean().as_matrix()
        ours, theirs = (np.mean([rig[name].centre_in_rig for name in both], axis=0) for rig in (self, other))
        return Rigid3(turn, theirs - turn @ ours)

    def largest_shift_px(self, other: Rig, distance_mm: float) -> float:
        """Largest shift of points at a distance between the images of this calibration and of another one of the same
        cameras."""
        shares = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.9, 0.9], [0.5, 0.5]])
        largest = 0.0
        for name, mounted in self.cameras.items():
            pixels = shares * [mounted.camera.width, mounted.camera.height]
            in_rig = mounted.cam_from_rig.inverse().apply(mounted.camera.rays(pixels) * distance_mm)
            there = other[name].camera.project(other[name].cam_from_rig.apply(in_rig))
            largest = max(largest, float(np.nanmax(np.abs(there - pixels), initial=0.0)))
        return largest

    def overlap(self, first: str, second: str, distance_mm: float) -> float:
        """Share (0 to 1) of a plane perpendicular to the first camera's axis, filling its image, that the second also
        sees."""
        one, other = self[first], self[second]
        cells = (np.arange(24) + 0.5) / 24  # middles: on the border rounding would decide
        grid = np.stack(np.meshgrid(cells * one.camera.width, cells * one.camera.height), -1)
        plane = one.camera.rays(grid.reshape(-1, 2)) * distance_mm
        in_other = (other.cam_from_rig @ one.cam_from_rig.inverse()).apply(plane)
        shown = np.isfinite(plane).all(axis=1)
        return float(np.mean(other.camera.contains(other.camera.project(in_other[shown])))) if shown.any() else 0.0

    def angle_deg(self, first: str, second: str) -> float:
        """Angle between the optical axes of two cameras."""
        return _between_deg(self[first].axis_in_rig, self[second].axis_in_rig)

    def meeting_deg(self, first: str, second: str, distance_mm: float) -> float:
        """Angle under which two cameras see the point at a distance on the axis of the first."""
        one, other = self[first], self[second]
        along = distance_mm * one.axis_in_rig
        return _between_deg(along, one.centre_in_rig + along - other.centre_in_rig)


def _between_deg(one: Float[np.ndarray, "3"], other: Float[np.ndarray, "3"]) -> float:
    cosine = one @ other / max(float(np.linalg.norm(one) * np.linalg.norm(other)), float(np.finfo(np.float64).tiny))
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


@dataclass(frozen=True, eq=False, kw_only=True)
class Light:
    """A small LED on the handpiece: a point with a cosine-power lobe and 1/d^2 falloff."""

    position_mm: Float[np.ndarray, "3"]
    """Position in the rig frame."""
    direction: Float[np.ndarray, "3"]
    """Unit axis of the lobe in the rig frame."""
    power: float = 1.0
    """Relative radiant intensity on the axis."""
    colour: Float[np.ndarray, "3"] = field(default_factory=lambda: np.ones(3))
    """Linear RGB."""
    lobe_exponent: float = 1.0
    """Intensity falls as cos(angle)^exponent; 1 is a bare Lambertian LED."""
    glare: float = 1.0
    """Share (0 to 1) of its mirror reflections that the cameras see: 1 without polarisers, what leaks through where the
    polariser of the LED and those of the cameras are crossed (0.03 for common film)."""
    covariance: Float[np.ndarray, "4 4"] | None = None
    """Covariance of the position (mm) and of the logarithm of the power; None if their uncertainty is not stated."""

    def __post_init__(self) -> None:
        direction = np.asarray(self.direction, dtype=np.float64)
        object.__setattr__(self, "direction", read_only(direction / np.linalg.norm(direction)))
        object.__setattr__(self, "position_mm", read_only(np.asarray(self.position_mm, dtype=np.float64)))
        object.__setattr__(self, "colour", read_only(np.asarray(self.colour, dtype=np.float64)))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", read_only(np.asarray(self.covariance, dtype=np.float64)))

    def irradiance(
        self, points: Float[np.ndarray, "*n 3"], normals: Float[np.ndarray, "*n 3"]
    ) -> Float[np.ndarray, "*n"]:
        """Irradiance of a surface at points of the rig frame (mm) with unit normals; that of a light of power 1 at 1
        mm, both facing each other, is 1. 0 behind the light and on the back of the surface; occlusion is ignored."""
        towards = self.position_mm - points
        distance = np.linalg.norm(towards, axis=-1)
        leaving = np.maximum(-(towards @ self.direction) / distance, 0.0)
        arriving = np.maximum((towards * normals).sum(axis=-1) / distance, 0.0)
        return np.asarray(self.power * leaving**self.lobe_exponent * arriving / distance**2)

    def in_frame(self, new_from_rig: Rigid3) -> Light:
        """The same light in another frame."""
        matrix = np.eye(4)
        matrix[:3, :3] = new_from_rig.rotation
        return replace(
            self,
            position_mm=new_from_rig.apply(self.position_mm),
            direction=new_from_rig.rotate(self.direction),
            covariance=None if self.covariance is None else matrix @ self.covariance @ matrix.T,
        )

    @property
    def light_from_rig(self) -> Rigid3:
        """A frame at the light whose +Z is the axis of the lobe."""
        turn = axes_about(self.direction)
        return Rigid3(turn, -turn @ self.position_mm)


MID_GREY_DN = 127.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Sensor:
    """What turns light into digital numbers, including the losses of the lens."""

    noise_dn: float = 1.5
    """Standard deviation of the noise at mid grey, in digital numbers of 255."""
    shot_noise_share: float = 0.5
    """Share (0 to 1) of the noise variance at mid grey that grows with the signal; the rest is constant."""
    gamma: float = 2.2
    """Encoding exponent from linear light to digital numbers."""
    gain: float = 1.0
    """Brightness of its images relative to those of the other cameras, in linear light."""
    falloff: tuple[float, float] = (0.0, 0.0)
    """(a, b) of the share ``exp(a r^2 + b r^4)`` of the light that reaches a pixel, where r is its distance from the
    principal point in units of half the image diagonal (vignetting; as a logarithm, after S. J. Kim, M. Pollefeys, IEEE
    Trans. PAMI 30, 2008)."""
    covariance: Float[np.ndarray, "4 4"] | None = None
    """Covariance of (log gain, a, b, log gamma); None if their uncertainty is not stated."""

    def __post_init__(self) -> None:
        if self.covariance is not None:
            object.__setattr__(self, "covariance", read_only(np.asarray(self.covariance, dtype=np.float64)))

    @property
    def corner_loss(self) -> float:
        """Share of the light that is lost in the corners of an image."""
        return float(1 - np.exp(sum(self.falloff)))

    def noise_sd_dn(self, level_dn: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Standard deviation of the noise at levels of the encoded image, in digital numbers."""
        share = self.shot_noise_share
        return np.asarray(self.noise_dn * np.sqrt(1 - share + share * level_dn / MID_GREY_DN))

    def relative_response(self, camera: Camera, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Linear light that pixels of a camera show, relative to a camera of gain 1 without falloff."""
        return np.asarray(self.gain * np.exp(falloff_terms(camera, pixels) @ self.falloff))


def falloff_terms(camera: Camera, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """r^2 and r^4 of pixels; see :attr:`Sensor.falloff`."""
    half_diagonal_px = np.hypot(camera.width, camera.height) / 2
    squared = (((pixels - camera.principal_point_px) / half_diagonal_px) ** 2).sum(axis=-1)
    return np.stack([squared, squared**2], axis=-1)


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """A lighting pattern: which lights are on while the cameras expose."""

    name: str = "all"
    """Name that frames refer to."""
    lights: tuple[str, ...] = ()
    """Names of the lights that are on."""


_IN_FOCUS = (0.5, 1.8)


def depth_of_field_mm(working_distance_mm: float) -> tuple[float, float]:
    """Nearest and farthest depth that a lens of a handpiece's size keeps usefully sharp, if nothing else is known.

    Its blur disc is f A |1/Z - 1/Z0| wide and grows with the aperture A, while diffraction shrinks; at f = 416 px the
    two are equal at A = 0.07 mm. For a working distance of 5 mm, focused at Z0 = 3.9 mm, the disc is then 4 px wide at
    both ends of the 2.5-9 mm that this gives, and narrower between; around a larger distance it is narrower still.
    """
    near, far = _IN_FOCUS
    return near * working_distance_mm, far * working_distance_mm


@dataclass(frozen=True, eq=False, kw_only=True)
class Handpiece(Viewable):
    """Everything that is built into the handpiece."""

    rig: Rig
    """The cameras."""
    lights: Mapping[str, Light] = field(default_factory=dict)
    """Lights by name."""
    lightings: tuple[Lighting, ...] = ()
    """Lighting patterns, in the order in which they alternate; empty if none are known."""
    sensor: Sensor = field(default_factory=Sensor)
    """Sensor of the cameras that have none of their own."""
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    """Sensors by camera, for those that differ from the others."""
    working_distance_mm: float = 5.0
    """Nominal distance from a camera to the surface that it looks at."""
    depth_range_mm: tuple[float, float] = (2.5, 9.0)
    """Nearest and farthest depth from a camera that is in focus."""
    body: Body | None = None
    """The space that it occupies; None where that is not known."""
    name: str = "handpiece"
    """Human-readable name."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "lights", MappingProxyType(dict(self.lights)))
        object.__setattr__(self, "sensors", MappingProxyType(dict(self.sensors)))
        strange = set(self.sensors) - set(self.rig.names)
        if strange:
            raise InputError(f"handpiece: sensors are given for unknown cameras {one_line(', '.join(sorted(strange)))}")
        unknown = {light for lighting in self.lightings for light in lighting.lights} - set(self.lights)
        if unknown:
            raise InputError(f"handpiece: lighting patterns name unknown lights {one_line(', '.join(sorted(unknown)))}")
        near, far = self.depth_range_mm
        if not 0 < near < self.working_distance_mm < far:
            raise InputError(
                f"handpiece: depth range {near}-{far} mm must enclose the working distance {self.working_distance_mm}"
            )

    def __repr__(self) -> str:
        return (
            f"Handpiece({quote(self.name)}, {self.rig}, {len(self.lights)} lights, "
            f"{self.working_distance_mm:g} mm from the teeth)"
        )

    @computed_once
    def solid(self) -> Body:
        """The body; if it is not known, a box of the size of a miniature module behind each lens and each LED."""
        if self.body is not None:
            return self.body
        cameras = {f"camera {name}": module(each.cam_from_rig, CAMERA_MM) for name, each in self.rig.cameras.items()}
        leds = {f"light {name}": module(light.light_from_rig, LED_MM) for name, light in self.lights.items()}
        return Body({**cameras, **leds})

    @property
    def thickness_mm(self) -> float:
        """How far the body extends, out of the gum, beyond the working distance, with the rig frame over the teeth as
        in :mod:`cuspid.handpiece.designs`."""
        return float(self.solid.bounds[1, 2]) - self.working_distance_mm

    @property
    def footprint_mm(self) -> float:
        """Side of the surface patch that a pixel sees at the working distance, mm: median over the cameras."""
        focal_px = [mounted.camera.focal_px.mean() for mounted in self.rig.cameras.values()]
        return self.working_distance_mm / float(np.median(focal_px))

    def with_cameras(self, rig: Rig) -> Handpiece:
        """The same handpiece with other cameras; sensors of those that it no longer has are left out."""
        return replace(self, rig=rig, sensors={name: own for name, own in self.sensors.items() if name in rig.names})

    def scaled(self, factor: float) -> Handpiece:
        """The same handpiece with images of ``factor`` times the size, in whole pixels, of the same view."""
        cameras = {
            name: replace(mounted, camera=mounted.camera.resized(*_scaled_size(mounted.camera, factor)))
            for name, mounted in self.rig.cameras.items()
        }
        return replace(self, rig=Rig(cameras))

    def sensor_of(self, camera: str) -> Sensor:
        """The sensor of a camera."""
        return self.sensors.get(camera, self.sensor)

    @property
    def only_lighting(self) -> str | None:
        """The lighting pattern of frames that state none; None where there are several, or none."""
        return self.lightings[0].name if len(self.lightings) == 1 else None

    def lights_on(self, lighting: str | None) -> list[Light]:
        """The lights of a lighting pattern; all of them where the pattern is not known (None).

        Raises InputError for a pattern that the handpiece does not have.
        """
        if lighting is None:
            return list(self.lights.values())
        by_name = {each.name: each.lights for each in self.lightings}
        if lighting not in by_name:
            known = ", ".join(by_name) or "none"
            raise InputError(f"handpiece {self.name}: no lighting pattern named {lighting!r}; it has {known}")
        return [self.lights[name] for name in by_name[lighting]]


def _scaled_size(camera: Camera, factor: float) -> tuple[int, int]:
    return max(round(factor * camera.width), 1), max(round(factor * camera.height), 1)
