"""The default renderer: Embree rays, compiled shading.

Each ray through a pixel gives the albedo of the solid texture at the hit, lit by the lights that are on, each a point
light with a lobe and 1/d^2 falloff, through a GGX coat with Schlick's Fresnel term (Walter et al. 2007). Shadows are
traced once for each surface in a pixel. Interreflection is a constant share of the light that reaches a point. Where
light travels below the surface, what enters is known at the vertices, and spreads among them
(:mod:`cuspid.simulation.scattering`). Radiance is linear RGB in units in which a white diffuse surface facing a light
of power 1 at 1 mm has radiance 1 plus that share. The world is the frame of the jaw.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from multiprocessing import get_context
from operator import itemgetter
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from cuspid.camera import Camera
from cuspid.capture import Frame
from cuspid.errors import InputError
from cuspid.geometry import Rigid3, read_only
from cuspid.gloss import coat, leaving
from cuspid.jaw import Jaw
from cuspid.kernels import kernel
from cuspid.mesh import Mesh
from cuspid.rig import Handpiece, MountedCamera
from cuspid.simulation.appearance import (
    NO_MATERIAL,
    Appearance,
    Palette,
    albedo,
    face_materials,
    palette,
    scattering_mm,
    stippled,
)
from cuspid.simulation.marks import natural_marks, no_marks
from cuspid.simulation.optics import IDEAL, Optics, mixed, recorded, through_lens
from cuspid.simulation.scattering import Scattering
from cuspid.simulation.sensor import record
from cuspid.workers import computed_once

AMBIENT = 0.08
"""Share of the light reaching a point that arrives from all directions after reflection in the mouth, unshadowed."""

NOTICEABLE = 0.005
"""A light that contributes less than this share of the light at a point is ignored there, and no shadow ray is
traced."""

SAME_SURFACE = 0.03
"""Rays through a pixel whose lengths differ by less than this share hit the same surface (12 um at 5 mm, up to 85
deg)."""

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
            read_only(mesh.faces),  # arrays from another process are writable: the shading would be compiled once more
            *(mesh.face_normals, mesh.vertex_normals, face_materials(self.jaw)),
            *(marks.colours, marks.shares, marks.stippled),
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
    def below(self) -> Callable[[str | None, Rigid3], Float[np.ndarray, "v 3"]]:
        """The light that leaves each vertex from below under a lighting pattern, by the pose of the handpiece
        (``rig_from_world``), cached for the last ones; of no vertex where light does not travel below the surface."""
        return lru_cache(maxsize=_TOGETHER)(self._below)

    def _below(self, lighting: str | None, rig_from_world: Rigid3) -> Float[np.ndarray, "v 3"]:
        if self.scattering is None:
            return _NONE
        lights = lamps(self.handpiece, lighting, rig_from_world)
        return self.scattering.leaving(_entering_light(self, lights))


class ShadedMesh(NamedTuple):
    """A mesh as arrays for the compiled shading."""

    faces: np.ndarray
    face_normals: np.ndarray
    vertex_normals: np.ndarray
    materials: np.ndarray
    mark_colours: np.ndarray
    marks: np.ndarray
    """Share of each mark at each vertex."""
    stippled: np.ndarray
    """How much of the stippling of its material each vertex has."""


_NONE: Float[np.ndarray, "0 3"] = np.zeros((0, 3))
"""Light from below the surface, where there is none."""


class Lamps(NamedTuple):
    """Lights in the world frame as arrays for the compiled shading."""

    positions: np.ndarray
    axes: np.ndarray
    intensities: np.ndarray
    exponents: np.ndarray
    glare: np.ndarray


def lamps(handpiece: Handpiece, lighting: str | None, rig_from_world: Rigid3) -> Lamps:
    """The lights of a lighting pattern in the world frame. Raises InputError where there are none."""
    on = handpiece.lights_on(lighting)
    if not on:
        raise InputError(f"handpiece {handpiece.name}: no light is on (lighting pattern {lighting or 'not given'})")
    world_from_rig = rig_from_world.inverse()
    return Lamps(
        world_from_rig.apply(np.array([light.position_mm for light in on])),
        world_from_rig.rotate(np.array([light.direction for light in on])),
        np.array([light.power * light.colour for light in on]),
        np.array([light.lobe_exponent for light in on]),
        np.array([light.glare for light in on]),
    )


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
    :attr:`Scene.below`."""
    rays = scene.rays(camera)
    if row is not None:
        rays = rays.reshape(camera.height, -1, 3)[row]
    origins, directions = np.empty_like(rays), np.empty_like(rays)
    moments = (0.0,) if smear is None else _moments(scene.supersampling**2)
    for index, moment in enumerate(moments):
        motion = np.zeros(6) if smear is None else moment * smear
        world_from_cam = (cam_from_world @ Rigid3.from_rotation_vector(motion[:3], motion[3:])).inverse()
        directions[index :: len(moments)] = _turned(rays[index :: len(moments)], world_from_cam.rotation)
        origins[index :: len(moments)] = world_from_cam.translation
    return radiance_along(scene, origins, directions, lights, below).reshape(-1, camera.width, 3)


def _row_by_row(
    scene: Scene,
    mounted: MountedCamera,
    lighting: str | None,
    rig_from_world: Rigid3,
    motion: Float[np.ndarray, "6"],
    smear: Float[np.ndarray, "6"] | None,
) -> Float[np.ndarray, "h w 3"]:
    """As :func:`radiance`, if the rows are exposed one after the other while the jaw moves in its own frame by
    ``motion`` (rotation vector and shift) from one frame to the next. The lights go along with the camera; what is
    softened below the surface is that of the middle row."""
    camera, rows = mounted.camera, []
    below = scene.below(lighting, rig_from_world)
    for row in range(camera.height):
        moved = scene.optics.readout * ((row + 0.5) / camera.height - 0.5) * motion
        then = rig_from_world @ Rigid3.from_rotation_vector(moved[:3], moved[3:])
        lights = lamps(scene.handpiece, lighting, then)
        rows.append(radiance(scene, camera, mounted.cam_from_rig @ then, lights, below, smear, row))
    return np.concatenate(rows)


def _moments(count: int) -> Float[np.ndarray, "n"]:
    """When the rays of a pixel are cast, from -1/2 to 1/2 of the exposure, in another order than that of their
    places."""
    in_order = (np.arange(count) + 0.5) / count - 0.5
    return in_order[np.random.default_rng(count).permutation(count)]


def motions(frames: Sequence[Frame], poses: Mapping[str, Rigid3]) -> dict[str, Float[np.ndarray, "6"]]:
    """How the jaw moves in its own frame (rotation vector and shift) from each frame to the next, as it does on average
    from the frame before."""
    names = [frame.name for frame in frames]
    found = {}
    for index, name in enumerate(names):
        before, after = max(index - 1, 0), min(index + 1, len(names) - 1)
        motion = poses[names[before]].inverse() @ poses[names[after]]
        found[name] = np.concatenate([motion.rotation_vector, motion.translation]) / max(after - before, 1)
    return found


def smeared(motion: Float[np.ndarray, "6"], rig_from_world: Rigid3, smear_mm: float) -> Float[np.ndarray, "6"]:
    """The share of a motion in which the handpiece itself moves by ``smear_mm``; none if it only turns, or rests."""
    then = rig_from_world @ Rigid3.from_rotation_vector(motion[:3], motion[3:])
    way = float(np.linalg.norm(then.inverse().translation - rig_from_world.inverse().translation))
    return motion * (smear_mm / way if way > 0 else 0.0)


def radiance_along(
    scene: Scene,
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    lights: Lamps,
    below: Float[np.ndarray, "v 3"] = _NONE,
) -> Float[np.ndarray, "m 3"]:
    """Linear light (float32) of pixels, given their rays, ``supersampling**2`` consecutive ones for each pixel.
    ``below``: see :attr:`Scene.below`."""
    samples = scene.supersampling**2
    out = np.zeros((len(directions) // samples, 3), dtype=np.float32)
    pixels = max(1, _BLOCK // samples)
    for begin in range(0, len(out), pixels):
        some = slice(begin * samples, (begin + pixels) * samples)
        _add_light(scene, origins[some], directions[some], lights, below, out[begin : begin + pixels])
    return out


def _add_light(
    scene: Scene,
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    lights: Lamps,
    below: Float[np.ndarray, "v 3"],
    out: Float[np.ndarray, "m 3"],
) -> None:
    """:func:`radiance_along` for some of the pixels, into ``out``."""
    # One origin or direction for all, repeated by a stride of none, would be of another kind for the compiler.
    origins, directions = np.ascontiguousarray(origins), np.ascontiguousarray(directions)
    hits = scene.jaw.mesh.cast(origins, directions)
    rays = _Rays(origins, directions, hits.faces, hits.distances, hits.barycentric)
    chosen, row = _shadow_rows(hits.distances, scene.supersampling**2)
    lit, ambient = _lighting(scene, rays, chosen, lights)
    points, materials = _places(rays, scene.surface)
    albedos = albedo(points, materials, scene.palette)
    _mark(rays, scene.surface, albedos)
    _shade(rays, albedos, scene.surface, scene.palette, lights, lit, ambient, row, below, out)


@kernel
@no_type_check
def _shadow_rows(distances, samples):
    """The rays for which shadows are traced, and for each ray the row of its answer among them.

    One ray answers for a pixel, but where a pixel sees more than one surface each ray asks for itself: the shadow of an
    edge on what lies behind must not darken the edge.
    """
    chosen, row = np.empty(len(distances), np.int64), np.empty(len(distances), np.int64)
    count = 0
    for first in range(0, len(distances), samples):
        nearest = farthest = distances[first]
        for i in range(first + 1, first + samples):
            nearest, farthest = min(nearest, distances[i]), max(farthest, distances[i])
        mixed = farthest > (1 + SAME_SURFACE) * nearest
        for i in range(first, first + samples):
            count += mixed or i == first
            chosen[count - 1] = i
            row[i] = count - 1
    return chosen[:count], row


class _Rays(NamedTuple):
    """Rays and their hits, as arrays for the compiled shading."""

    origins: np.ndarray
    directions: np.ndarray
    faces: np.ndarray
    distances: np.ndarray
    barycentric: np.ndarray


@kernel
@no_type_check
def _turned(directions, rotation):
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


def _lighting(
    scene: Scene, rays: _Rays, chosen: Int[np.ndarray, "n"], lights: Lamps
) -> tuple[Bool[np.ndarray, "n l"], Float[np.ndarray, "n 3"]]:
    """Which lights reach the hits of chosen rays (False also where a light is too weak to matter), and the ambient
    light there."""
    points, ambient = np.zeros((2, len(chosen), 3))
    lit = np.zeros((len(chosen), len(lights.positions)), dtype=np.bool_)
    _light_matters(rays, chosen, scene.surface, lights, points, lit, ambient)
    _darken(lit, scene.jaw.mesh.occluded(*_segments(points, lit, lights.positions)))
    return lit, ambient


@kernel
@no_type_check
def _segments(points, lit, positions):
    """The ends of the way from each point to each light that may reach it, light by light."""
    begins, ends = np.empty((2, lit.sum(), 3))
    n = 0
    for k in range(len(positions)):
        for i in range(len(points)):
            if lit[i, k]:
                for c in range(3):
                    begins[n, c], ends[n, c] = points[i, c], positions[k, c]
                n += 1
    return begins, ends


@kernel
@no_type_check
def _darken(lit, hidden):
    """Take away the lights that something hides, in the order of :func:`_segments`."""
    n = 0
    for k in range(lit.shape[1]):
        for i in range(len(lit)):
            if lit[i, k]:
                lit[i, k] = not hidden[n]
                n += 1


@kernel(fastmath=True)
@no_type_check
def _point(rays, i):
    t = rays.distances[i]
    return (
        rays.origins[i, 0] + t * rays.directions[i, 0],
        rays.origins[i, 1] + t * rays.directions[i, 1],
        rays.origins[i, 2] + t * rays.directions[i, 2],
    )


@kernel(fastmath=True)
@no_type_check
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(fastmath=True)
@no_type_check
def _normal(rays, i, surface):
    """Interpolated unit normal at a hit, on the side that the ray came from."""
    face = rays.faces[i]
    u, v, w = rays.barycentric[i, 0], rays.barycentric[i, 1], rays.barycentric[i, 2]
    a = surface.vertex_normals[surface.faces[face, 0]]
    b = surface.vertex_normals[surface.faces[face, 1]]
    c = surface.vertex_normals[surface.faces[face, 2]]
    x, y, z = (u * a[0] + v * b[0] + w * c[0], u * a[1] + v * b[1] + w * c[1], u * a[2] + v * b[2] + w * c[2])
    scale = 1 / np.sqrt(x * x + y * y + z * z + 1e-30)
    if _dot(surface.face_normals[face], rays.directions[i]) > 0:
        scale = -scale
    return x * scale, y * scale, z * scale


@kernel(fastmath=True)
@no_type_check
def _incoming(point, index, lights):
    """Unit vector towards a light, and its lobe over the squared distance at a point."""
    x = lights.positions[index, 0] - point[0]
    y = lights.positions[index, 1] - point[1]
    z = lights.positions[index, 2] - point[2]
    squared = x * x + y * y + z * z
    inverse = 1 / np.sqrt(squared)
    towards = (x * inverse, y * inverse, z * inverse)
    cosine = -_dot(towards, lights.axes[index])
    if cosine <= 0:
        return towards, 0.0
    exponent = lights.exponents[index]
    return towards, (cosine if exponent == 1 else cosine**exponent) / squared


@kernel(fastmath=True)
@no_type_check
def _light_matters(rays, chosen, surface, lights, points, matters, ambient):
    """Fill in for each chosen ray: the point hit, the lights that give a noticeable part of its light, the ambient
    light."""
    strength = np.zeros(len(lights.positions))
    for i in range(len(chosen)):
        if rays.faces[chosen[i]] < 0:
            continue
        point = _point(rays, chosen[i])
        points[i, 0], points[i, 1], points[i, 2] = point
        normal = _normal(rays, chosen[i], surface)
        for k in range(len(strength)):
            towards, falloff = _incoming(point, k, lights)
            strength[k] = max(0.0, _dot(normal, towards)) * falloff
            for c in range(3):
                ambient[i, c] += AMBIENT * falloff * lights.intensities[k, c]
        threshold = NOTICEABLE * strength.sum()
        for k in range(len(strength)):
            matters[i, k] = strength[k] > threshold


@kernel(fastmath=True)
@no_type_check
def _reflected(normal, view, towards, reflectance, roughness, saliva):
    """Diffuse (to be multiplied by the albedo) and glossy answer to a light of strength 1; ``view`` points away."""
    nl = _dot(normal, towards)
    if nl <= 0:
        return 0.0, 0.0
    if reflectance == 0:
        return nl, 0.0
    half = (towards[0] - view[0], towards[1] - view[1], towards[2] - view[2])
    inverse = 1 / np.sqrt(_dot(half, half))
    nv = max(1e-3, -_dot(normal, view))
    nh, vh = _dot(normal, half) * inverse, _dot(towards, half) * inverse
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
            points[i, 0], points[i, 1], points[i, 2] = _point(rays, i)
            materials[i] = surface.materials[rays.faces[i]]
    return points, materials


@kernel(fastmath=True)
@no_type_check
def _mixed(rays, i, surface, values):
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
            share = _mixed(rays, i, surface, surface.marks[:, mark])
            for c in range(3):
                albedos[i, c] += share * (surface.mark_colours[mark, c] - albedos[i, c])


@kernel(fastmath=True)
@no_type_check
def _shade(rays, albedos, surface, palette, lights, lit, ambient, row, below, out):
    spread = len(below) > 0
    samples = len(rays.faces) // len(out)
    for i in range(len(rays.faces)):
        if rays.faces[i] < 0:
            continue
        pixel = i // samples
        m = surface.materials[rays.faces[i]]
        point, normal = _point(rays, i), _normal(rays, i, surface)
        if palette.stipple_mm[m] > 0:
            height = palette.stipple_mm[m] * _mixed(rays, i, surface, surface.stippled)
            normal = stippled(normal, point, height, palette.stipple_from_jaw)
        albedo = (albedos[i, 0], albedos[i, 1], albedos[i, 2])
        direction = rays.directions[i]
        inverse = 1 / np.sqrt(_dot(direction, direction))
        view = (direction[0] * inverse, direction[1] * inverse, direction[2] * inverse)
        scattered = albedo
        if palette.exit_index[m] > 1:
            share = leaving(-_dot(normal, view), palette.exit_index[m])
            scattered = (albedo[0] * share, albedo[1] * share, albedo[2] * share)
        for c in range(3):
            out[pixel, c] += scattered[c] * ambient[row[i], c] / samples
        if spread:
            for corner in range(3):
                share = rays.barycentric[i, corner] / samples
                for c in range(3):
                    out[pixel, c] += scattered[c] * share * below[surface.faces[rays.faces[i], corner], c]
        for k in range(len(lights.positions)):
            if lit[row[i], k]:
                towards, falloff = _incoming(point, k, lights)
                surface_coat = palette.reflectance[m], palette.roughness[m], palette.saliva
                diffuse, glossy = _reflected(normal, view, towards, *surface_coat)
                glossy *= lights.glare[k]
                if spread:
                    diffuse = 0.0
                for c in range(3):
                    out[pixel, c] += falloff * lights.intensities[k, c] * (scattered[c] * diffuse + glossy) / samples


def _entering_light(scene: Scene, lights: Lamps) -> Float[np.ndarray, "v 3"]:
    """The light that enters the surface at each vertex, in the units of radiance."""
    mesh, materials = scene.jaw.mesh, scene.surface.materials
    shares = np.zeros((len(mesh.vertices), len(lights.positions)))
    reflectance = np.zeros(len(mesh.vertices))
    reflectance[mesh.faces] = scene.palette.reflectance[materials][:, None]
    heights = scene.palette.stipple_mm[1] * scene.surface.stippled
    _entering(mesh.vertices, mesh.vertex_normals, heights, scene.palette, reflectance, lights, shares)
    lit = shares > NOTICEABLE * shares.sum(axis=1, keepdims=True)
    _darken(lit, mesh.occluded(*_segments(mesh.vertices, lit, lights.positions)))
    return np.einsum("vl,lc->vc", np.where(lit, shares, 0.0), lights.intensities)


@kernel(fastmath=True)
@no_type_check
def _entering(points, normals, heights, palette, reflectance, lights, shares):
    """Fill in the share of each light that enters at each point, if nothing hides it."""
    for i in range(len(points)):
        normal = (normals[i, 0], normals[i, 1], normals[i, 2])
        if heights[i] > 0:
            normal = stippled(normal, points[i], heights[i], palette.stipple_from_jaw)
        for k in range(len(lights.positions)):
            towards, falloff = _incoming(points[i], k, lights)
            cosine = max(0.0, _dot(normal, towards))
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
            coarse = radiance(scene, camera, cam_from_world, lights, scene.below(lighting, rig_from_world))
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
    motion = np.zeros(6) if motion is None else motion
    cam_from_world = mounted.cam_from_rig @ rig_from_world
    smear = smeared(motion, rig_from_world, optics.smear_mm) if optics.smear_mm > 0 else None
    if optics.readout > 0:
        light = _row_by_row(scene, mounted, frame.lighting, rig_from_world, motion, smear)
    else:
        lights = lamps(scene.handpiece, frame.lighting, rig_from_world)
        below = scene.below(frame.lighting, rig_from_world)
        light = radiance(scene, mounted.camera, cam_from_world, lights, below, smear)
    if optics.aperture_mm > 0:
        depth_mm = np.nan_to_num(render_depth(scene.jaw.mesh, mounted.camera, cam_from_world), nan=np.inf)
        light = through_lens(light, depth_mm, mounted.camera, scene.handpiece.working_distance_mm, optics)
    rng = image_rng(scene, frame.name, camera_name)
    return recorded(record(mixed(light, optics), gain, scene.handpiece, camera_name, rng), optics)


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
        how = self.poses[frame.name], self.gains[frame.lighting], self.motions[frame.name]
        self.sink(frame.name, camera, render_image(self.scene, frame, camera, *how))
        return frame.name, camera


_worker: _Worker


def _adopt(worker: _Worker) -> None:
    global _worker
    _worker = worker


def _work(task: tuple[Frame, str]) -> tuple[str, str]:
    return _worker(task)


def _in_order(frames: Sequence[Frame], skip: Callable[[str, str], bool], together: int) -> list[tuple[Frame, str]]:
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

    Embree holds the interpreter lock, so the work is distributed over processes. They are forked, and only trace rays
    in the scene that the parent built (a forked child could not build one) and run kernels that the parent compiled.
    """
    tasks = _in_order(frames, skip, _TOGETHER if scene.scattering else max(len(frames), 1))
    if not tasks:
        return
    worker = _Worker(
        scene=scene,
        poses=poses,
        gains=metered_gains(scene, frames, poses),
        motions=motions(frames, poses),
        sink=sink,
    )
    if processes == 1:
        yield from map(worker, tasks)
        return
    with ProcessPoolExecutor(processes, get_context("fork"), _adopt, (worker,)) as pool:
        for done in as_completed([pool.submit(_work, task) for task in tasks]):
            yield done.result()
