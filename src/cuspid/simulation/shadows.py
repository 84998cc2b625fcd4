"""Which lights reach what the pixels of an image show, and how much light each of them gives there.

Shadows are traced once for each surface in a pixel, at its first ray. Their edges are few: they are traced at every
third pixel of every third row, and a pixel agrees with the four of them about it where these agree about a light and
all lie on one surface.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int, UInt8

from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Handpiece
from cuspid.runtime.errors import InputError
from cuspid.runtime.kernels import kernel
from cuspid.simulation.hits import Rays, ShadedMesh, dot, normal_of, point_of

AMBIENT = 0.08
"""Share of the light reaching a point that arrives from all directions after reflection in the mouth, unshadowed."""

NOTICEABLE = 0.005
"""A light that contributes less than this share of the light at a point is ignored there, and no shadow ray is
traced."""

SAME_SURFACE = 0.03
"""Rays through a pixel whose lengths differ by less than this share hit the same surface (12 um at 5 mm, up to 85
deg)."""

STEP = 3
"""Pixels from one place where shadows are traced to the next."""

_GRAZING = 0.1
"""Sine of the angle to a face below which light may be hidden by the next face: there shadows are traced in each
pixel."""

_LIT, _HIDDEN = 1, 2


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


class Illumination(NamedTuple):
    """The light at some hits, as arrays for the compiled shading."""

    strengths: np.ndarray
    """Cosine to the normal times the lobe over the squared distance, of each light."""
    lit: np.ndarray
    """Whether the light gets there; False also where it is too weak to matter."""
    ambient: np.ndarray
    """What comes from all directions."""


def illuminate(
    mesh: Mesh,
    surface: ShadedMesh,
    rays: Rays,
    samples: int,
    lights: Lamps,
    grid: Rays,
    width: int,
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"], Illumination]:
    """The surfaces that pixels see, ``samples`` consecutive rays each: the first ray to each, how many rays see it, and
    what light it gets.

    ``grid``: the first rays of the pixels to which ``rays`` belong, whole rows of ``width`` pixels, and of the row
    below, if there is one.
    """
    chosen, counts = _surfaces(rays.distances, samples)
    points, light = _unoccluded_light(surface, rays, chosen, counts, lights)
    asked = light.lit.copy()
    shadows = _trace_grid(mesh, surface, grid, lights, width)
    _adopt_agreement(rays, chosen, samples, surface, lights, points, shadows, light.lit, asked)
    darken(light.lit, asked, mesh.occluded(*segments(points, asked, lights.positions)))
    return chosen, counts, light


@kernel
@no_type_check
def _surfaces(distances, samples):
    """The rays for which shadows are traced, and for how many consecutive rays each answers.

    One ray answers for a pixel, but where a pixel sees more than one surface each ray asks for itself: the shadow of an
    edge on what lies behind must not darken the edge.
    """
    chosen, counts = np.empty(len(distances), np.int64), np.empty(len(distances), np.int64)
    count = 0
    for first in range(0, len(distances), samples):
        nearest = farthest = distances[first]
        for i in range(first + 1, first + samples):
            nearest, farthest = min(nearest, distances[i]), max(farthest, distances[i])
        together = 1 if farthest > (1 + SAME_SURFACE) * nearest else samples
        for i in range(first, first + samples, together):
            chosen[count], counts[count] = i, together
            count += 1
    return chosen[:count], counts[:count]


def _unoccluded_light(
    surface: ShadedMesh, rays: Rays, chosen: Int[np.ndarray, "n"], counts: Int[np.ndarray, "n"], lights: Lamps
) -> tuple[Float[np.ndarray, "n 3"], Illumination]:
    """Where chosen rays hit, and the light there if nothing hides it."""
    shape = len(chosen), len(lights.positions)
    points, ambient = np.zeros((2, len(chosen), 3))
    light = Illumination(np.zeros(shape), np.zeros(shape, np.bool_), ambient)
    _light_matters(rays, chosen, counts, surface, lights, points, light)
    return points, light


class _ShadowGrid(NamedTuple):
    """The places of an image where shadows are traced, as arrays for the compiled shading."""

    distances: Float[np.ndarray, "n"]
    """Of the first rays of all pixels."""
    width: int
    """Of a row of pixels."""
    places: Int[np.ndarray, "r c"]
    """Indices of these rays."""
    seen: UInt8[np.ndarray, "r c l"]
    """Whether each light is lit or hidden there; 0 where it does not matter."""


def _trace_grid(mesh: Mesh, surface: ShadedMesh, grid: Rays, lights: Lamps, width: int) -> _ShadowGrid:
    rows = np.arange(0, len(grid.faces) // width, STEP)
    places = rows[:, None] * width + np.arange(0, width, STEP)
    chosen = places.ravel()
    points, light = _unoccluded_light(surface, grid, chosen, np.ones_like(chosen), lights)
    seen = np.where(light.lit, np.uint8(_LIT), np.uint8(0))
    darken(light.lit, light.lit, mesh.occluded(*segments(points, light.lit, lights.positions)))
    seen[(seen == _LIT) & ~light.lit] = _HIDDEN
    return _ShadowGrid(grid.distances, width, places, seen.reshape(*places.shape, -1))


@kernel
@no_type_check
def segments(points, asked, positions):
    """The ends of the way from each point to each light that is asked for, light by light."""
    begins, ends = np.empty((2, asked.sum(), 3))
    n = 0
    for k in range(len(positions)):
        for i in range(len(points)):
            if asked[i, k]:
                for c in range(3):
                    begins[n, c], ends[n, c] = points[i, c], positions[k, c]
                n += 1
    return begins, ends


@kernel
@no_type_check
def darken(lit, asked, hidden):
    """Take away the lights that something hides, in the order of :func:`segments`."""
    n = 0
    for k in range(lit.shape[1]):
        for i in range(len(lit)):
            if asked[i, k]:
                lit[i, k] = not hidden[n]
                n += 1


@kernel(fastmath=True)
@no_type_check
def incoming(point, index, lights):
    """Unit vector towards a light, and its lobe over the squared distance at a point."""
    x = lights.positions[index, 0] - point[0]
    y = lights.positions[index, 1] - point[1]
    z = lights.positions[index, 2] - point[2]
    squared = x * x + y * y + z * z
    inverse = 1 / np.sqrt(squared)
    towards = (x * inverse, y * inverse, z * inverse)
    cosine = -dot(towards, lights.axes[index])
    if cosine <= 0:
        return towards, 0.0
    exponent = lights.exponents[index]
    return towards, (cosine if exponent == 1 else cosine**exponent) / squared


@kernel(fastmath=True)
@no_type_check
def _light_matters(rays, chosen, counts, surface, lights, points, light):
    """Fill in for each chosen ray the point hit, and the light at the middle of those for which it answers; a light
    that does not give a noticeable part of it is not lit."""
    for i in range(len(chosen)):
        if rays.faces[chosen[i]] < 0:
            continue
        point, normal = point_of(rays, chosen[i]), normal_of(rays, chosen[i], surface)
        points[i, 0], points[i, 1], points[i, 2] = point
        if counts[i] > 1:
            point, normal = _middle(rays, chosen[i], counts[i], surface)
        total = 0.0
        for k in range(len(lights.positions)):
            towards, falloff = incoming(point, k, lights)
            light.strengths[i, k] = max(0.0, dot(normal, towards)) * falloff
            total += light.strengths[i, k]
            for c in range(3):
                light.ambient[i, c] += AMBIENT * falloff * lights.intensities[k, c]
        for k in range(len(lights.positions)):
            light.lit[i, k] = light.strengths[i, k] > NOTICEABLE * total


@kernel(fastmath=True)
@no_type_check
def _middle(rays, first, count, surface):
    """Mean of the points that consecutive rays hit, and of the normals there."""
    x, y, z, a, b, c = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(first, first + count):
        point, normal = point_of(rays, i), normal_of(rays, i, surface)
        x, y, z = x + point[0], y + point[1], z + point[2]
        a, b, c = a + normal[0], b + normal[1], c + normal[2]
    return (x / count, y / count, z / count), (a / count, b / count, c / count)


@kernel(fastmath=True)
@no_type_check
def _adopt_agreement(rays, chosen, samples, surface, lights, points, shadows, lit, asked):
    """Take over what the four places about a pixel agree on: hidden lights are not lit, none of them is asked for."""
    distances, width, places, seen = shadows
    for i in range(len(chosen)):
        pixel = chosen[i] // samples
        top, left = pixel // width // STEP, pixel % width // STEP
        bottom, right = top + (pixel // width % STEP > 0), left + (pixel % width % STEP > 0)
        if rays.faces[chosen[i]] < 0 or chosen[i] % samples or bottom >= len(places) or right >= places.shape[1]:
            continue
        corners = ((top, left), (top, right), (bottom, left), (bottom, right))
        nearest = farthest = distances[pixel]
        for r, c in corners:
            there = distances[places[r, c]]
            nearest, farthest = min(nearest, there), max(farthest, there)
        if farthest > (1 + SAME_SURFACE) * nearest:
            continue
        for k in range(lit.shape[1]):
            if not lit[i, k] or _grazes(rays, chosen[i], surface, points[i], lights.positions[k]):
                continue
            found = seen[top, left, k]
            for r, c in corners:
                if seen[r, c, k] != found:
                    found = 0
            if found:
                asked[i, k], lit[i, k] = False, found == _LIT


@kernel(fastmath=True)
@no_type_check
def _grazes(rays, ray, surface, point, position):
    """Whether light from a position grazes the face that a ray hits, or comes from behind it."""
    normal = surface.face_normals[rays.faces[ray]]
    x, y, z = position[0] - point[0], position[1] - point[1], position[2] - point[2]
    height = normal[0] * x + normal[1] * y + normal[2] * z
    if dot(normal, rays.directions[ray]) > 0:
        height = -height
    return height <= 0 or height * height < _GRAZING * _GRAZING * (x * x + y * y + z * z)
