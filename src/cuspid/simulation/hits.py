"""What the rays of an image hit first.

The rays of a pixel lie between its first ray and those of the pixels to the right and below. Where these four hit the
same face, or faces around one vertex, the other rays meet those faces and are not traced: what could still hide them
there is narrower than a pixel and met by none of the four.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float

from cuspid.model.mesh import Mesh
from cuspid.runtime.kernels import kernel


class ShadedMesh(NamedTuple):
    """A mesh as arrays for the compiled shading."""

    vertices: np.ndarray
    faces: np.ndarray
    face_normals: np.ndarray
    vertex_normals: np.ndarray
    materials: np.ndarray
    mark_colours: np.ndarray
    marks: np.ndarray
    """Share of each mark at each vertex."""
    stippled: np.ndarray
    """How much of the stippling of its material each vertex has."""


class Rays(NamedTuple):
    """Rays and their hits, as arrays for the compiled shading."""

    origins: np.ndarray
    """One for each ray, or one for all."""
    directions: np.ndarray
    faces: np.ndarray
    """-1 for a miss."""
    distances: np.ndarray
    """In lengths of the direction; infinite for a miss."""
    barycentric: np.ndarray


def trace(mesh: Mesh, origins: Float[np.ndarray, "#n 3"], directions: Float[np.ndarray, "n 3"]) -> Rays:
    """Rays with what each of them hits. ``origins``: one for each ray, or one for all."""
    directions = np.ascontiguousarray(directions)
    hits = mesh.cast(np.broadcast_to(origins, directions.shape), directions)
    return Rays(np.ascontiguousarray(origins), directions, hits.faces, hits.distances, hits.barycentric)


def first_hits(
    mesh: Mesh,
    surface: ShadedMesh,
    origins: Float[np.ndarray, "#n 3"],
    directions: Float[np.ndarray, "n 3"],
    firsts: Rays,
    samples: int,
    width: int,
    *,
    moving: bool = False,
) -> Rays:
    """As :func:`trace`, for all rays of whole rows of pixels, ``samples`` consecutive ones for each pixel, few of
    which are traced. ``firsts``: the first ray of each pixel, and of those in the row below, where there is one. All
    others are traced if neighbouring rays are ``moving`` against each other."""
    count = len(directions)
    faces, distances, barycentric = np.full(count, -1), np.full(count, np.inf), np.zeros((count, 3))
    rays = Rays(np.ascontiguousarray(origins), np.ascontiguousarray(directions), faces, distances, barycentric)
    left = _meet(surface, rays, firsts, samples, width, moving)
    some = trace(mesh, rays.origins if len(origins) == 1 else rays.origins[left], rays.directions[left])
    faces[left], distances[left], barycentric[left] = some.faces, some.distances, some.barycentric
    return rays


@kernel
@no_type_check
def _meet(surface, rays, firsts, samples, width, moving):
    """Fill in what is known from the first rays of the pixels; which rays are left."""
    left, corners, count = np.empty(len(rays.faces), np.int64), np.empty(4, np.int64), 0
    for pixel in range(len(rays.faces) // samples):
        first = pixel * samples
        rays.faces[first], rays.distances[first] = firsts.faces[pixel], firsts.distances[pixel]
        for corner in range(3):
            rays.barycentric[first, corner] = firsts.barycentric[pixel, corner]
        below = pixel + width
        known = not moving and (pixel + 1) % width != 0 and below < len(firsts.faces)
        if known:
            corners[0], corners[1] = firsts.faces[pixel], firsts.faces[pixel + 1]
            corners[2], corners[3] = firsts.faces[below], firsts.faces[below + 1]
            if corners.max() < 0:
                continue
            known = _adjoin(surface.faces, corners)
        for ray in range(first + 1, first + samples):
            if not (known and _meets(surface, rays, ray, corners)):
                left[count] = ray
                count += 1
    return left[:count]


@kernel
@no_type_check
def _adjoin(faces, some):
    """Whether any two of some faces have a vertex in common."""
    for a in range(len(some)):
        if some[a] < 0:
            return False
        for b in range(a):
            if some[a] == some[b]:
                continue
            common = False
            for corner in range(3):
                for other in range(3):
                    common |= faces[some[a], corner] == faces[some[b], other]
            if not common:
                return False
    return True


@kernel
@no_type_check
def _meets(surface, rays, ray, candidates):
    """Fill in where a ray meets the nearest of some faces (T. Moeller, B. Trumbore, Journal of Graphics Tools 2, 1997);
    whether it meets any."""
    vertices, at = surface.vertices, ray if len(rays.origins) > 1 else 0
    d0, d1, d2 = rays.directions[ray, 0], rays.directions[ray, 1], rays.directions[ray, 2]
    for k in range(len(candidates)):
        face = candidates[k]
        if (k > 0 and face == candidates[k - 1]) or face == rays.faces[ray]:
            continue
        a, b, c = surface.faces[face, 0], surface.faces[face, 1], surface.faces[face, 2]
        ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        bx, by, bz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
        cx, cy, cz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
        x, y, z = rays.origins[at, 0] - ax, rays.origins[at, 1] - ay, rays.origins[at, 2] - az
        px, py, pz = d1 * cz - d2 * cy, d2 * cx - d0 * cz, d0 * cy - d1 * cx
        qx, qy, qz = y * bz - z * by, z * bx - x * bz, x * by - y * bx
        inverse = 1 / (bx * px + by * py + bz * pz)
        u, v = (x * px + y * py + z * pz) * inverse, (d0 * qx + d1 * qy + d2 * qz) * inverse
        distance = (cx * qx + cy * qy + cz * qz) * inverse
        if u >= 0 and v >= 0 and u + v <= 1 and 0 < distance < rays.distances[ray]:  # False where the face has no area
            rays.faces[ray], rays.distances[ray] = face, distance
            rays.barycentric[ray, 0], rays.barycentric[ray, 1], rays.barycentric[ray, 2] = 1 - u - v, u, v
    return rays.faces[ray] >= 0


@kernel(fastmath=True)
@no_type_check
def dot(a, b):
    """Dot product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(fastmath=True)
@no_type_check
def point_of(rays, i):
    """Where a ray hits."""
    t, origin = rays.distances[i], rays.origins[i if len(rays.origins) > 1 else 0]
    return (
        origin[0] + t * rays.directions[i, 0],
        origin[1] + t * rays.directions[i, 1],
        origin[2] + t * rays.directions[i, 2],
    )


@kernel(fastmath=True)
@no_type_check
def normal_of(rays, i, surface):
    """Interpolated unit normal at a hit, on the side that the ray came from."""
    face = rays.faces[i]
    u, v, w = rays.barycentric[i, 0], rays.barycentric[i, 1], rays.barycentric[i, 2]
    a = surface.vertex_normals[surface.faces[face, 0]]
    b = surface.vertex_normals[surface.faces[face, 1]]
    c = surface.vertex_normals[surface.faces[face, 2]]
    x, y, z = (u * a[0] + v * b[0] + w * c[0], u * a[1] + v * b[1] + w * c[1], u * a[2] + v * b[2] + w * c[2])
    scale = 1 / np.sqrt(x * x + y * y + z * z + 1e-30)
    if dot(surface.face_normals[face], rays.directions[i]) > 0:
        scale = -scale
    return x * scale, y * scale, z * scale
