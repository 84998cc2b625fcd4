"""A bumpy closed horseshoe with flat underside that stands for a lower jaw: fourteen uneven teeth on a ridge of gum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh

GUM_TOP_MM, BOTTOM_MM = 0.0, -6.0


def _centre_line(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points along the arch, evenly, and the unit vectors across it (outwards)."""
    t = np.linspace(-1, 1, 4001)
    line = np.stack([25 * t, 18 - 42 * np.abs(t) ** 2.3], axis=1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    even = np.linspace(0, length[-1], count)
    points = np.stack([np.interp(even, length, line[:, k]) for k in range(2)], axis=1)
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return points, np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)


def horseshoe(along: int = 300, around: int = 80) -> Jaw:
    """The closed jaw in its occlusal frame, with FDI labels."""
    points, outwards = _centre_line(along)
    sizes = np.random.default_rng(7).uniform(0.8, 1.2, 14)
    place = np.linspace(0, 14 - 1e-9, along)
    tooth, within = place.astype(int), place % 1
    bump = sizes[tooth] * np.sin(np.pi * within) ** 0.5
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    across = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.7 * (4.2 + 0.8 * bump[:, None])
    cusps = 0.8 * np.sin(0.9 * across + tooth[:, None]) * np.sin(4 * np.pi * within[:, None]) * bump[:, None]
    up = np.clip(np.sin(angle), 0, None)
    crown, base = up**0.4 * (1 + 6 * bump[:, None] + cusps * up), BOTTOM_MM * np.clip(-3 * np.sin(angle), 0, 1)
    height = np.where(up > 0, crown, base)
    rings = np.concatenate([points[:, None] + across[..., None] * outwards[:, None], height[..., None]], axis=2)
    ring, k = np.meshgrid(np.arange(along - 1), np.arange(around), indexing="ij")
    a, b = ring * around + k, ring * around + (k + 1) % around
    faces = [np.stack([a, a + around, b], -1).reshape(-1, 3), np.stack([b, a + around, b + around], -1).reshape(-1, 3)]
    ends = along * around + np.arange(2)
    first, last = np.arange(around), (along - 1) * around + np.arange(around)
    faces.append(np.stack([np.full(around, ends[0]), first, np.roll(first, -1)], axis=1))
    faces.append(np.stack([np.full(around, ends[1]), np.roll(last, -1), last], axis=1))
    vertices = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)])
    mesh = Mesh(vertices, np.concatenate(faces)[:, ::-1])
    numbers = np.array([*range(37, 30, -1), *range(41, 48)])
    owner = np.concatenate([np.repeat(tooth, around), [0, 13]])[mesh.faces].max(axis=1)
    labels = np.where(mesh.face_centres[:, 2] > GUM_TOP_MM + 1.0, numbers[owner], 0)
    return Jaw(mesh=mesh, face_labels=labels, arch="lower")


def without_base(mesh: Mesh) -> Mesh:
    """Only what lies above the underside: an open surface, as a scanner sees it."""
    return mesh.submesh(mesh.face_centres[:, 2] > BOTTOM_MM + 2)


def with_palate(jaw: Jaw, depth_mm: float, back_mm: float = -30.0) -> Jaw:
    """The jaw with a vault between its sides, so deep in the middle, from behind the front teeth to ``back_mm``."""
    x, y = np.meshgrid(np.linspace(-24, 24, 49), np.linspace(back_mm, 16, 47))
    z = 1.0 - depth_mm * np.clip(1 - (x / 20) ** 2, 0, None)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    vertices = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    mesh = Mesh(
        np.concatenate([jaw.mesh.vertices, vertices]), np.concatenate([jaw.mesh.faces, faces + len(jaw.mesh.vertices)])
    )
    return replace(jaw, mesh=mesh, face_labels=np.concatenate([jaw.face_labels, np.full(len(faces), GUM)]))
