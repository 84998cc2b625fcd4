"""The default renderer: Embree rays, compiled shading.

Each ray through a pixel gives the albedo of the solid texture at the hit, lit by the lights that are on, each a point
light with a lobe and 1/d^2 falloff, through a GGX coat with Schlick's Fresnel term (Walter et al. 2007). Few of the
rays are traced (:mod:`cuspid.simulation.hits`, :mod:`cuspid.simulation.shadows`). Interreflection is a constant share
of the light that reaches a point. Where light travels below the surface, what enters is known at the vertices, and
spreads among them (:mod:`cuspid.simulation.scattering`). Radiance is linear RGB in units in which a white diffuse
surface facing a light of power 1 at 1 mm has radiance 1 plus that share. The world is the frame of the jaw.
"""

from __future__ import annotations

import pickle
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from multiprocessing import get_context
from operator import itemgetter
from typing import no_type_check

import numpy as np
from jaxtyping import Float, UInt8

from cuspid.geometry import Rigid3, read_only
from cuspid.geometry.gloss import coat, transmittance
from cuspid.model.camera import Camera
from cuspid.model.capture import Frame
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece, MountedCamera
from cuspid.model.shutter import Shutter, screw_of
from cuspid.runtime import workers
from cuspid.runtime.errors import InputError
from cuspid.runtime.kernels import kernel
from cuspid.runtime.workers import computed_once, pickle_fields
from cuspid.simulation.appearance import (
    NO_MATERIAL,
    Appearance,
    Palette,
    albedo,
    face_materials,
    palette,
    scattering_mm,
    stipple_normal,
)
from cuspid.simulation.hits import Rays, ShadedMesh, dot, first_hits, normal_of, point_of, trace
from cuspid.simulation.marks import natural_marks, no_marks
from cuspid.simulation.optics import IDEAL, Optics, encode_image, mix_channels, through_lens
from cuspid.simulation.scattering import Scattering
from cuspid.simulation.sensor import record
from cuspid.simulation.shadows import NOTICEABLE, STEP, Lamps, darken, illuminate, incoming, lamps, segments

_FILM_REFLECTANCE, _FILM_ROUGHNESS = 0.02, 0.03
"""Of a film of saliva (water): Fresnel reflectance at normal incidence, GGX roughness."""

BRIGHT_PERCENTILE, BRIGHT_LEVEL = 98.0, 0.75
"""The exposure puts this percentile of the metered pixels at this share of full scale (linear)."""

METERED_POSES = 5
"""The exposure is metered at this many poses, spread over the capture."""

_TOGETHER = 8
"""Frames for which a process remembers what leaves the surface from below: 5 MB each for 200,000 vertices."""

_BLOCK = 1 << 15
"""Number of rays that are traced and shaded at once: intermediate results take some 300 bytes per ray."""

Sink = Callable[[str, str, UInt8[np.ndarray, "h w 3"]], None]
"""Takes frame, camera and image; called in the process that rendered it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """What is in front of the cameras, and the cameras."""

    jaw: Jaw
    """The jaw, in whose frame the poses are given."""
    handpiece: Handpiece
    """Cameras, lights, sensor."""
    appearance: Appearance
    """Materials."""
    supersampling: int = 2
    """Rays per pixel along each side."""
    seed: int = 0
    """Seed of the texture and the sensor noise."""
    optics: Optics = IDEAL
    """What lenses, sensors, hands and the mouth do to the images."""

    @computed_once
    def surface(self) -> ShadedMesh:
        """The jaw as arrays for the compiled shading."""
        mesh = self.jaw.mesh
        marks = natural_marks(self.jaw, self.seed) if self.appearance.marked else no_marks(mesh)
        return ShadedMesh(
            vertices=mesh.vertices,
            # Arrays from another process are writable: the shading would be compiled once more.
            faces=read_only(mesh.faces),
            face_normals=mesh.face_normals,
            vertex_normals=mesh.vertex_normals,
            materials=face_materials(self.jaw),
            mark_colours=marks.colours,
            marks=marks.shares,
            stippled=marks.stippled,
        )

    @computed_once
    def rays(self) -> Callable[[Camera], Float[np.ndarray, "n 3"]]:
        """:func:`pixel_rays` of a camera, cached for the last one: through a lens with distortion they cost more than
        the rest of an image, and those of twelve cameras of 500 x 500 px would take 300 MB in each process."""
        return lru_cache(maxsize=1)(partial(pixel_rays, supersampling=self.supersampling))

    @computed_once
    def palette(self) -> Palette:
        """The materials as arrays for the compiled shading."""
        return palette(self.appearance, self.seed, self.optics.saliva)

    @computed_once
    def scattering(self) -> Scattering | None:
        """How light spreads below the surface; None if it does not."""
        lengths = self.optics.scattering * scattering_mm(self.appearance, self.surface.materials)
        return Scattering(self.jaw.mesh, lengths) if lengths.any() else None

    @computed_once
    def light_from_below(self) -> Callable[[str | None, Rigid3], Float[np.ndarray, "v 3"]]:
        """The light that leaves each vertex from below under a lighting pattern, by the pose of the handpiece
        (``rig_from_world``), cached for the last ones; of no vertex where light does not travel below the surface."""
        return lru_cache(maxsize=_TOGETHER)(self._light_from_below)

    def _light_from_below(self, lighting: str | None, rig_from_world: Rigid3) -> Float[np.ndarray, "v 3"]:
        if self.scattering is None:
            return _NONE
        lights = lamps(self.handpiece, lighting, rig_from_world)
        return self.scattering.leaving(_entering_light(self, lights))


_NONE: Float[np.ndarray, "0 3"] = np.zeros((0, 3))
"""Light from below the surface, where there is none."""


def pixel_rays(camera: Camera, supersampling: int) -> Float[np.ndarray, "n 3"]:
    """Directions (Z = 1, camera frame) on a regular grid within each pixel; the rays of one pixel are consecutive."""
    offsets = (np.arange(supersampling) + 0.5) / supersampling - 0.5
    within = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(1, 1, -1, 2)
    return camera.rays((camera.pixel_centres()[:, :, None] + within).reshape(-1, 2))


def render_depth(mesh: Mesh, camera: Camera, cam_from_world: Rigid3) -> Float[np.ndarray, "h w"]:
    """True depth (Z in the camera, mm) at each pixel centre, NaN where nothing is hit."""
    world_from_cam = cam_from_world.inverse()
    rays = pixel_rays(camera, 1)
    hits = mesh.cast(np.tile(world_from_cam.translation, (len(rays), 1)), world_from_cam.rotate(rays))
    depth = np.where(hits.faces >= 0, hits.distances, np.nan)
    return depth.reshape(camera.height, camera.width)


def radiance(
    scene: Scene,
    camera: Camera,
    cam_from_world: Rigid3,
    lights: Lamps,
    below: Float[np.ndarray, "v 3"] = _NONE,
    smear: Float[np.ndarray, "6"] | None = None,
    row: int | None = None,
) -> Float[np.ndarray, "h w 3"]:
    """Linear light at each pixel, or at those of one row, averaged over the pixel's area and, with a smear (rotation
    vector and shift of the jaw in its own frame during the exposure), over time; 0 where nothing is hit. ``below``: see
    :attr:`Scene.light_from_below`."""
    rays = scene.rays(camera)
    if row is not None:
        rays = rays.reshape(camera.height, -1, 3)[row]
    if smear is None:
        world_from_cam = cam_from_world.inverse()
        origins, directions = np.array([world_from_cam.translation]), _rotate_directions(rays, world_from_cam.rotation)
        return radiance_along(scene, origins, directions, camera.width, lights, below)
    origins, directions = np.empty_like(rays), np.empty_like(rays)
    moments = _moments(scene.supersampling**2)
    for index, moment in enumerate(moments):
        motion = moment * smear
        world_from_cam = (cam_from_world @ Rigid3.from_rotation_vector(motion[:3], motion[3:])).inverse()
        directions[index :: len(moments)] = _rotate_directions(rays[index :: len(moments)], world_from_cam.rotation)
        origins[index :: len(moments)] = world_from_cam.translation
    return radiance_along(scene, origins, directions, camera.width, lights, below, moving=True)


def _row_by_row(
    scene: Scene,
    mounted: MountedCamera,
    lighting: str | None,
    rig_from_world: Rigid3,
    motion: Float[np.ndarray, "6"],
    smear: Float[np.ndarray, "6"] | None,
) -> Float[np.ndarray, "h w 3"]:
    """As :func:`radiance`, if the rows are exposed as the shutter of the camera says while the jaw moves in its own
    frame by ``motion`` (rotation vector and shift) from one frame to the next. The lights go along with the camera;
    what is softened below the surface is that of the middle row."""
    camera, rows = mounted.camera, []
    below = scene.light_from_below(lighting, rig_from_world)
    for row in range(camera.height):
        moved = mounted.shutter.late(np.array((row + 0.5) / camera.height)) * motion
        then = rig_from_world @ Rigid3.from_rotation_vector(moved[:3], moved[3:])
        lights = lamps(scene.handpiece, lighting, then)
        rows.append(radiance(scene, camera, mounted.cam_from_rig @ then, lights, below, smear, row))
    return np.concatenate(rows)


def _moments(count: int) -> Float[np.ndarray, "n"]:
    """When the rays of a pixel are cast, from -1/2 to 1/2 of the exposure, in another order than that of their
    places."""
    in_order = (np.arange(count) + 0.5) / count - 0.5
    return in_order[np.random.default_rng(count).permutation(count)]


def motions(
    frames: Sequence[Frame], poses: Mapping[str, Rigid3], *, steady: bool = False
) -> dict[str, Float[np.ndarray, "6"]]:
    """How the jaw moves in its own frame (rotation vector and shift) from each frame to the next, as it does on average
    from the frame before; if ``steady``, by a screw, so that its speed in a frame is that of the way through it."""
    names = [frame.name for frame in frames]
    found = {}
    for index, name in enumerate(names):
        before, after = max(index - 1, 0), min(index + 1, len(names) - 1)
        motion = poses[names[before]].inverse() @ poses[names[after]]
        way = screw_of(motion) if steady else (motion.rotation_vector, motion.translation)
        found[name] = np.concatenate(way) / max(after - before, 1)
    return found


def _is_rolling(scene: Scene) -> bool:
    """Whether not all rows are exposed at the instants of the frames."""
    cameras = scene.handpiece.rig.cameras.values()
    return scene.optics.readout > 0 or not all(each.shutter.is_plain for each in cameras)


def limit_motion(motion: Float[np.ndarray, "6"], rig_from_world: Rigid3, smear_mm: float) -> Float[np.ndarray, "6"]:
    """The share of a motion in which the handpiece itself moves by ``smear_mm``; none if it only turns, or rests."""
    then = rig_from_world @ Rigid3.from_rotation_vector(motion[:3], motion[3:])
    way = float(np.linalg.norm(then.inverse().translation - rig_from_world.inverse().translation))
    return motion * (smear_mm / way if way > 0 else 0.0)


def radiance_along(
    scene: Scene,
    origins: Float[np.ndarray, "#n 3"],
    directions: Float[np.ndarray, "n 3"],
    width: int,
    lights: Lamps,
    below: Float[np.ndarray, "v 3"] = _NONE,
    *,
    moving: bool = False,
) -> Float[np.ndarray, "h w 3"]:
    """Linear light (float32) of rows of pixels, given their rays, ``supersampling**2`` consecutive ones for each pixel.

    Neighbouring rays have neighbouring origins, or one for all, unless they are ``moving`` during the exposure.
    ``below``: see :attr:`Scene.light_from_below`.
    """
    samples = scene.supersampling**2
    row = samples * width
    height = len(directions) // row
    out = np.zeros((height, width, 3), dtype=np.float32)
    rows = max(1, _BLOCK // (STEP * row)) * STEP
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        own, firsts = slice(top * row, bottom * row), slice(top * row, (bottom + 1) * row, samples)
        grid = trace(scene.jaw.mesh, _slice_origins(origins, firsts), directions[firsts])
        begins = _slice_origins(origins, own)
        rays = first_hits(scene.jaw.mesh, scene.surface, begins, directions[own], grid, samples, width, moving=moving)
        _add_light(scene, rays, grid, lights, below, out[top:bottom])
    return out


def _slice_origins(origins: Float[np.ndarray, "#n 3"], which: slice) -> Float[np.ndarray, "#m 3"]:
    return origins if len(origins) == 1 else origins[which]


def _add_light(
    scene: Scene,
    rays: Rays,
    grid: Rays,
    lights: Lamps,
    below: Float[np.ndarray, "v 3"],
    out: Float[np.ndarray, "h w 3"],
) -> None:
    """:func:`radiance_along` for some rows, into ``out``. ``grid``: the first rays of their pixels and of the row
    below."""
    samples, width = scene.supersampling**2, out.shape[1]
    chosen, counts, light = illuminate(scene.jaw.mesh, scene.surface, rays, samples, lights, grid, width)
    points, materials = _places(rays, scene.surface)
    albedos = albedo(points, materials, scene.palette)
    _mark(rays, scene.surface, albedos)
    pixels = out.reshape(-1, 3)
    _shade(rays, albedos, scene.surface, scene.palette, lights, chosen, counts, light, samples, below, pixels)


@kernel
@no_type_check
def _rotate_directions(directions, rotation):
    """``Rigid3.rotate`` without BLAS, whose threads would fight with the other processes."""
    out = np.empty_like(directions)
    for i in range(len(directions)):
        for r in range(3):
            out[i, r] = (
                rotation[r, 0] * directions[i, 0]
                + rotation[r, 1] * directions[i, 1]
                + rotation[r, 2] * directions[i, 2]
            )
    return out


@kernel(fastmath=True)
@no_type_check
def _reflect(normal, view, towards, reflectance, roughness, saliva):
    """Diffuse (to be multiplied by the albedo) and glossy answer to a light of strength 1; ``view`` points away."""
    nl = dot(normal, towards)
    if nl <= 0:
        return 0.0, 0.0
    if reflectance == 0:
        return nl, 0.0
    half = (towards[0] - view[0], towards[1] - view[1], towards[2] - view[2])
    inverse = 1 / np.sqrt(dot(half, half))
    nv = max(1e-3, -dot(normal, view))
    nh, vh = dot(normal, half) * inverse, dot(towards, half) * inverse
    glossy, fresnel = coat(nl, nv, nh, vh, reflectance, roughness)
    if saliva > 0:
        glossy += saliva * (coat(nl, nv, nh, vh, _FILM_REFLECTANCE, _FILM_ROUGHNESS)[0] - glossy)
    return nl * (1 - fresnel), glossy


@kernel(fastmath=True)
@no_type_check
def _places(rays, surface):
    """The point that each ray hits, and its material."""
    points, materials = np.zeros((len(rays.faces), 3)), np.full(len(rays.faces), NO_MATERIAL, np.uint8)
    for i in range(len(rays.faces)):
        if rays.faces[i] >= 0:
            points[i, 0], points[i, 1], points[i, 2] = point_of(rays, i)
            materials[i] = surface.materials[rays.faces[i]]
    return points, materials


@kernel(fastmath=True)
@no_type_check
def _interpolate_hit(rays, i, surface, values):
    """What a hit has of a value of each vertex."""
    corners, total = surface.faces[rays.faces[i]], 0.0
    for corner in range(3):
        total += rays.barycentric[i, corner] * values[corners[corner]]
    return total


@kernel(fastmath=True)
@no_type_check
def _mark(rays, surface, albedos):
    """Replace what lies below the marks of teeth by them."""
    for i in range(len(rays.faces)):
        if rays.faces[i] < 0 or surface.materials[rays.faces[i]] != 0:
            continue
        for mark in range(len(surface.mark_colours)):
            share = _interpolate_hit(rays, i, surface, surface.marks[:, mark])
            for c in range(3):
                albedos[i, c] += share * (surface.mark_colours[mark, c] - albedos[i, c])


@kernel(fastmath=True)
@no_type_check
def _shade(rays, albedos, surface, palette, lights, chosen, counts, light, samples, below, out):
    spread, received = len(below) > 0, np.zeros(3)
    for n in range(len(chosen)):
        if rays.faces[chosen[n]] < 0:
            continue
        pixel = chosen[n] // samples
        for c in range(3):
            received[c] = light.ambient[n, c]
            for k in range(len(lights.positions)):
                if light.lit[n, k]:
                    received[c] += light.strengths[n, k] * lights.intensities[k, c]
        for i in range(chosen[n], chosen[n] + counts[n]):
            m = surface.materials[rays.faces[i]]
            matte = palette.reflectance[m] == 0 and palette.exit_index[m] <= 1 and palette.stipple_mm[m] == 0
            if matte and not spread:
                for c in range(3):
                    out[pixel, c] += albedos[i, c] * received[c] / samples
                continue
            point, normal = point_of(rays, i), normal_of(rays, i, surface)
            if palette.stipple_mm[m] > 0:
                height = palette.stipple_mm[m] * _interpolate_hit(rays, i, surface, surface.stippled)
                normal = stipple_normal(normal, point, height, palette.stipple_from_jaw)
            albedo = (albedos[i, 0], albedos[i, 1], albedos[i, 2])
            direction = rays.directions[i]
            inverse = 1 / np.sqrt(dot(direction, direction))
            view = (direction[0] * inverse, direction[1] * inverse, direction[2] * inverse)
            scattered = albedo
            if palette.exit_index[m] > 1:
                share = transmittance(-dot(normal, view), palette.exit_index[m])
                scattered = (albedo[0] * share, albedo[1] * share, albedo[2] * share)
            for c in range(3):
                out[pixel, c] += scattered[c] * light.ambient[n, c] / samples
            if spread:
                for corner in range(3):
                    share = rays.barycentric[i, corner] / samples
                    for c in range(3):
                        out[pixel, c] += scattered[c] * share * below[surface.faces[rays.faces[i], corner], c]
            for k in range(len(lights.positions)):
                if light.lit[n, k]:
                    towards, falloff = incoming(point, k, lights)
                    reflectance, roughness = palette.reflectance[m], palette.roughness[m]
                    diffuse, glossy = _reflect(normal, view, towards, reflectance, roughness, palette.saliva)
                    glossy *= lights.glare[k]
                    if spread:
                        diffuse = 0.0
                    for c in range(3):
                        out[pixel, c] += (
                            falloff * lights.intensities[k, c] * (scattered[c] * diffuse + glossy) / samples
                        )


def _entering_light(scene: Scene, lights: Lamps) -> Float[np.ndarray, "v 3"]:
    """The light that enters the surface at each vertex, in the units of radiance."""
    mesh, materials = scene.jaw.mesh, scene.surface.materials
    shares = np.zeros((len(mesh.vertices), len(lights.positions)))
    reflectance = np.zeros(len(mesh.vertices))
    reflectance[mesh.faces] = scene.palette.reflectance[materials][:, None]
    heights = scene.palette.stipple_mm[1] * scene.surface.stippled
    _add_entering_light(mesh.vertices, mesh.vertex_normals, heights, scene.palette, reflectance, lights, shares)
    lit = shares > NOTICEABLE * shares.sum(axis=1, keepdims=True)
    darken(lit, lit, mesh.occluded(*segments(mesh.vertices, lit, lights.positions)))
    return np.einsum("vl,lc->vc", np.where(lit, shares, 0.0), lights.intensities)


@kernel(fastmath=True)
@no_type_check
def _add_entering_light(points, normals, heights, palette, reflectance, lights, shares):
    """Fill in the share of each light that enters at each point, if nothing hides it."""
    for i in range(len(points)):
        normal = (normals[i, 0], normals[i, 1], normals[i, 2])
        if heights[i] > 0:
            normal = stipple_normal(normal, points[i], heights[i], palette.stipple_from_jaw)
        for k in range(len(lights.positions)):
            towards, falloff = incoming(points[i], k, lights)
            cosine = max(0.0, dot(normal, towards))
            mirrored = reflectance[i] + (1 - reflectance[i]) * (1 - cosine) ** 5
            shares[i, k] = falloff * cosine * (1 - mirrored)


def auto_gain(scene: Scene, poses: Iterable[Rigid3], lighting: str | None = None, stride: int = 10) -> float:
    """The gain for a lighting pattern, metered over all cameras at some poses, on images reduced by ``stride``.

    It is metered by their brightness or, under coloured lights, by their brightest channel, for none should burn out.
    """
    on = scene.handpiece.lights_on(lighting)
    level_of = np.mean if all(np.ptp(light.colour) == 0 for light in on) else np.max
    levels = []
    for rig_from_world in poses:
        lights = lamps(scene.handpiece, lighting, rig_from_world)
        for mounted in scene.handpiece.rig.cameras.values():
            camera, cam_from_world = _coarser(mounted.camera, stride), mounted.cam_from_rig @ rig_from_world
            coarse = radiance(scene, camera, cam_from_world, lights, scene.light_from_below(lighting, rig_from_world))
            levels.append(level_of(coarse, axis=-1).ravel())
    seen = np.concatenate(levels)
    seen = seen[seen > 0]
    if not len(seen):
        raise InputError("simulation: no camera sees the jaw; check the scan path and the handpiece")
    return float(BRIGHT_LEVEL / np.percentile(seen, BRIGHT_PERCENTILE))


def metered_gains(scene: Scene, frames: Sequence[Frame], poses: Mapping[str, Rigid3]) -> dict[str | None, float]:
    """The common gain of each lighting pattern of a capture, metered at a few frames spread over it."""
    gains: dict[str | None, float] = {}
    for lighting in dict.fromkeys(frame.lighting for frame in frames):
        lit = [poses[frame.name] for frame in frames if frame.lighting == lighting]
        spread = np.unique(np.linspace(0, len(lit) - 1, METERED_POSES).astype(int))
        gains[lighting] = auto_gain(scene, [lit[index] for index in spread], lighting)
    return gains


def _coarser(camera: Camera, stride: int) -> Camera:
    return replace(
        camera,
        width=-(-camera.width // stride),
        height=-(-camera.height // stride),
        focal_px=camera.focal_px / stride,
        principal_point_px=camera.principal_point_px / stride,
    )


def lit_frames(
    handpiece: Handpiece, rig_from_world: Mapping[str, Rigid3]
) -> tuple[tuple[Frame, ...], dict[str, Rigid3]]:
    """The frames taken at some poses, under each lighting pattern of the handpiece in turn, and the pose of each.

    With one pattern, or none, a frame has the name of its pose; with more, a letter is appended.
    """
    patterns: list[str | None] = [each.name for each in handpiece.lightings] or [None]
    letters = [chr(ord("a") + index) for index in range(len(patterns))] if len(patterns) > 1 else [""]
    cameras, frames, poses = handpiece.rig.names, [], {}
    for name, pose in rig_from_world.items():
        for letter, lighting in zip(letters, patterns, strict=True):
            frames.append(Frame(name=f"{name}{letter}", cameras=cameras, lighting=lighting))
            poses[f"{name}{letter}"] = pose
    return tuple(frames), poses


def render_image(
    scene: Scene,
    frame: Frame,
    camera_name: str,
    rig_from_world: Rigid3,
    gain: float,
    motion: Float[np.ndarray, "6"] | None = None,
) -> UInt8[np.ndarray, "h w 3"]:
    """One image; ``motion`` is the jaw's about it (:func:`motions`), none at rest. Depends on its arguments alone, so
    that a resumed capture equals an uninterrupted one."""
    mounted, optics = scene.handpiece.rig[camera_name], scene.optics
    if mounted.shutter.is_plain and optics.readout > 0:
        mounted = replace(mounted, shutter=Shutter(readout=optics.readout))
    motion = np.zeros(6) if motion is None else motion
    cam_from_world = mounted.cam_from_rig @ rig_from_world
    smear = limit_motion(motion, rig_from_world, optics.smear_mm) if optics.smear_mm > 0 else None
    if not mounted.shutter.is_plain:
        light = _row_by_row(scene, mounted, frame.lighting, rig_from_world, motion, smear)
    else:
        lights = lamps(scene.handpiece, frame.lighting, rig_from_world)
        below = scene.light_from_below(frame.lighting, rig_from_world)
        light = radiance(scene, mounted.camera, cam_from_world, lights, below, smear)
    if optics.aperture_mm > 0:
        depth_mm = np.nan_to_num(render_depth(scene.jaw.mesh, mounted.camera, cam_from_world), nan=np.inf)
        light = through_lens(light, depth_mm, mounted.camera, scene.handpiece.working_distance_mm, optics)
    rng = image_rng(scene, frame.name, camera_name)
    return encode_image(record(mix_channels(light, optics), gain, scene.handpiece, camera_name, rng), optics)


def image_rng(scene: Scene, frame: str, camera_name: str) -> np.random.Generator:
    """Random generator for the sensor noise of one image, independent of what was rendered before."""
    return np.random.default_rng([scene.seed, zlib.crc32(frame.encode()), zlib.crc32(camera_name.encode())])


@dataclass(frozen=True, kw_only=True)
class _Worker:
    scene: Scene
    poses: Mapping[str, Rigid3]
    gains: Mapping[str | None, float]
    motions: Mapping[str, Float[np.ndarray, "6"]]
    sink: Sink

    def __call__(self, task: tuple[Frame, str]) -> tuple[str, str]:
        frame, camera = task
        pose, gain, motion = self.poses[frame.name], self.gains[frame.lighting], self.motions[frame.name]
        self.sink(frame.name, camera, render_image(self.scene, frame, camera, pose, gain, motion))
        return frame.name, camera


_worker: _Worker


def _adopt(worker: _Worker | bytes) -> None:
    global _worker
    workers.end_with_parent()
    _worker = pickle.loads(worker) if isinstance(worker, bytes) else worker


def _work(task: tuple[Frame, str]) -> tuple[str, str]:
    return _worker(task)


def _frame_by_frame(
    frames: Sequence[Frame], skip: Callable[[str, str], bool], together: int
) -> list[tuple[Frame, str]]:
    """All cameras of so many frames at a time, one after the other, for a process remembers the rays of the last."""
    numbered = [
        (index // together, camera, frame)
        for index, frame in enumerate(frames)
        for camera in frame.cameras
        if not skip(frame.name, camera)
    ]
    return [(frame, camera) for _, camera, frame in sorted(numbered, key=itemgetter(0, 1))]


def render_capture(
    scene: Scene,
    frames: Sequence[Frame],
    poses: Mapping[str, Rigid3],
    sink: Sink,
    *,
    skip: Callable[[str, str], bool] = lambda frame, camera: False,
    processes: int = 1,
) -> Iterator[tuple[str, str]]:
    """Render the cameras of every frame, except those that ``skip`` excludes, and yield (frame, camera) as each is
    done.

    Embree holds the interpreter lock, so the work is distributed over processes. Forked ones trace rays in the scene
    that the parent built (a forked child could not build one) and run kernels that the parent compiled; new ones build
    their own, and are given the ``sink``, which must then be picklable.
    """
    tasks = _frame_by_frame(frames, skip, _TOGETHER if scene.scattering else max(len(frames), 1))
    if not tasks:
        return
    worker = _Worker(
        scene=scene,
        poses=poses,
        gains=metered_gains(scene, frames, poses),
        motions=motions(frames, poses, steady=_is_rolling(scene)),
        sink=sink,
    )
    if processes == 1:
        yield from map(worker, tasks)
        return
    given = worker if workers.START_METHOD == "fork" else pickle_fields(worker)
    with ProcessPoolExecutor(processes, get_context(workers.START_METHOD), _adopt, (given,)) as pool:
        for done in as_completed([pool.submit(_work, task) for task in tasks]):
            yield done.result()
