"""A finished mesh as a panorama: its occlusal view, and strips along the arch from above, from the cheek and from the
tongue.

All views are orthographic, so that lengths in them are those of the mesh. Frames: the world is the occlusal frame of
:mod:`cuspid.model.panorama`. A side strip looks across the arch curve, and a pixel shows what lies on its side of the
curve: the arch bends, so that lengths along it are those of the curve, and lengths across it, which are heights, are
true.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, UInt8

from cuspid.geometry import lengths_along, unit
from cuspid.model.mesh import Mesh, RayHits
from cuspid.model.panorama import ZONES, Panorama, Strip
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.stitching.strip import StripOptions, outward_normals, zones_of

_MOST_PX = 30_000_000
"""Pixels of the largest picture."""
_MARGIN_MM = 1.0
_AMBIENT, _WHITE = 0.25, 235.0
"""Share of the light that comes from all around, and the brightest level, of a mesh without colours."""
_BLOCK = 1 << 20
"""Rays that are cast at once."""
_STRAIGHT_ON_MM = 4.0
"""A strip goes on by so much beyond the arch curve, which ends in the middle of the last crowns."""


@dataclass(frozen=True, kw_only=True)
class MeshViewOptions(Options):
    """How a mesh is drawn."""

    mm_per_px: Annotated[float, Range(0.001, 10)] = 0.03
    """Size of a pixel, mm."""
    above_mm: Annotated[float, Range(0, 100)] = 3.0
    """How far the strips from the cheek and from the tongue extend above the tips of the crowns."""
    below_mm: Annotated[float, Range(0.1, 100)] = 14.0
    """How far they extend below the tips of the crowns."""
    strip: StripOptions = field(default_factory=StripOptions)
    """The strip from above."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeshViews:
    """The views of a mesh."""

    panorama: Panorama
    """From above."""
    strips: Mapping[str, Strip]
    """By what they show: ``buccal``, ``occlusal`` and ``lingual``; empty where there is no arch curve."""


def draw_mesh(
    mesh: Mesh, curve: Float[np.ndarray, "n 3"] | None, options: MeshViewOptions, *, progress: Progress = silent
) -> MeshViews:
    """The views of a mesh in its occlusal frame, in its own colours, or shaded from where one looks if it has none.

    ``curve``: the middle of the crowns at the height of their tips, finely sampled; without it there are no strips.
    Raises InputError where a picture would have more than 30 million pixels.
    """
    steps = 1 if curve is None else 1 + len(ZONES)
    progress("views", 0, steps)
    panorama = _from_above(mesh, options)
    progress("views", 1, steps)
    strips = dict[str, Strip]()
    if curve is not None:
        line = _columns(curve, options.mm_per_px)
        widest_mm = max(2 * options.strip.half_width_mm, options.above_mm + options.below_mm)
        _require_few(len(line), round(widest_mm / options.mm_per_px))
        for name, rays in _strip_rays(mesh, line, options):
            strips[name] = _strip(mesh, line, name, rays, options)
            progress("views", 1 + len(strips), steps)
    return MeshViews(panorama=panorama, strips=_crop_strips(strips))


@dataclass(frozen=True, eq=False)
class _Rays:
    """What the pixels of a strip look along."""

    eyes: Float[np.ndarray, "h w 3"]
    directions: Float[np.ndarray, "h w 3"]
    """Unit vectors."""
    reach_mm: float = np.inf


def _from_above(mesh: Mesh, options: MeshViewOptions) -> Panorama:
    low, high = mesh.bounds
    step = options.mm_per_px
    columns, rows = np.ceil((high - low + 2 * _MARGIN_MM)[:2] / step).astype(int).tolist()
    _require_few(columns, rows)
    origin_px = np.array([_MARGIN_MM - low[0], _MARGIN_MM + high[1]]) / step
    u, v = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    eyes = np.stack([(u - origin_px[0]) * step, (origin_px[1] - v) * step, np.full(u.shape, high[2] + 1)], axis=-1)
    image, distance_mm = _cast_rays(mesh, _Rays(eyes, np.broadcast_to([0, 0, -1.0], eyes.shape)))
    covered = np.isfinite(distance_mm)
    return Panorama(
        image=image,
        covered=covered,
        frame_index=np.full(covered.shape, -1, np.int16),
        frame_pixel=np.full((*covered.shape, 2), np.nan, np.float32),
        frames=(),
        method="mesh",
        origin_px=origin_px,
        mm_per_px=step,
        height_mm=np.where(covered, high[2] + 1 - distance_mm, np.nan).astype(np.float32),
    )


def _require_few(columns: int, rows: int) -> None:
    """Raise InputError where a picture would be too large."""
    if columns * rows > _MOST_PX:
        raise InputError(f"stitch: a picture would have {columns} x {rows} px; give a larger --view.mm-per-px")


def _cast_rays(mesh: Mesh, rays: _Rays) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """What rays see, and how far away; black and infinite where they meet nothing, or a back."""
    shape = rays.eyes.shape[:2]
    eyes, directions = rays.eyes.reshape(-1, 3), rays.directions.reshape(-1, 3)
    image, distance_mm = np.zeros((len(eyes), 3), np.uint8), np.full(len(eyes), np.inf)
    for begin in range(0, len(eyes), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        hits = mesh.cast(eyes[part], directions[part])
        facing = -np.einsum("nd,nd->n", mesh.face_normals[hits.faces], directions[part])
        seen = (hits.faces >= 0) & (facing > 0) & (hits.distances <= rays.reach_mm)
        image[part][seen] = _levels(mesh, hits, directions[part])[seen]
        distance_mm[part][seen] = hits.distances[seen]
    return image.reshape(*shape, 3), distance_mm.reshape(shape)


def _levels(mesh: Mesh, hits: RayHits, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The colours of the mesh where rays meet it; without colours, light from where they come from."""
    corners = mesh.faces[hits.faces]
    if mesh.colors is not None:
        mixed = np.einsum("nk,nkc->nc", hits.barycentric, mesh.colors[corners].astype(np.float64))
        return np.asarray(np.rint(mixed).clip(0, 255))
    normals = unit(np.einsum("nk,nkc->nc", hits.barycentric, mesh.vertex_normals[corners]))
    facing = -np.einsum("nd,nd->n", normals, rays).clip(-1, 0)
    return np.repeat((_WHITE * (_AMBIENT + (1 - _AMBIENT) * facing))[:, None], 3, axis=1)


# --- along the arch ---------------------------------------------------------------------------------------------------


def _columns(curve: Float[np.ndarray, "n 3"], step_mm: float) -> Float[np.ndarray, "w 3"]:
    """The curve at every column of a strip; straight on beyond its ends, at their height."""
    head, tail = (unit((curve[a] - curve[b]) * [1, 1, 0]) for a, b in ((0, min(10, len(curve) - 1)), (-1, -11)))
    longer = np.concatenate([[curve[0] + _STRAIGHT_ON_MM * head], curve, [curve[-1] + _STRAIGHT_ON_MM * tail]])
    lengths = lengths_along(longer[:, :2])
    at = np.arange(step_mm / 2, lengths[-1], step_mm)
    return np.stack([np.interp(at, lengths, longer[:, axis]) for axis in range(3)], axis=1)


def _strip_rays(mesh: Mesh, line: Float[np.ndarray, "w 3"], options: MeshViewOptions) -> Iterator[tuple[str, _Rays]]:
    """The rays of each strip; from one side they reach to where those from the other side start."""
    step, half_mm = options.mm_per_px, options.strip.half_width_mm
    normals = np.column_stack([outward_normals(line[:, :2]), np.zeros(len(line))])
    across = np.arange(half_mm, -half_mm, -step)[:, None, None]
    above = np.concatenate([line[:, :2], np.full((len(line), 1), mesh.bounds[1, 2] + 1)], axis=1) + across * normals
    yield "occlusal", _Rays(above, np.broadcast_to([0, 0, -1.0], above.shape))
    heights = np.arange(options.above_mm, -options.below_mm, -step)[:, None, None] * [0, 0, 1.0]
    for name, side in (("buccal", normals), ("lingual", -normals)):
        beside = line + half_mm * side + heights
        yield name, _Rays(beside, np.broadcast_to(-side, beside.shape), 2 * half_mm)


def _strip(mesh: Mesh, line: Float[np.ndarray, "w 3"], name: str, rays: _Rays, options: MeshViewOptions) -> Strip:
    image, distance_mm = _cast_rays(mesh, rays)
    covered = np.isfinite(distance_mm)
    zone = _zone(name, np.where(covered, rays.eyes[..., 2] - distance_mm, -np.inf), covered, options.strip)
    return Strip(image=image, covered=covered, zone=zone, curve=line[:, :2], mm_per_px=options.mm_per_px)


def _crop_strips(strips: Mapping[str, Strip]) -> dict[str, Strip]:
    """Without the columns in which no strip shows anything, and those from the sides without empty rows."""
    if not strips:
        return {}
    shown = np.flatnonzero(np.any([strip.covered.any(axis=0) for strip in strips.values()], axis=0))
    columns, found = slice(shown[0], shown[-1] + 1) if len(shown) else slice(0), dict[str, Strip]()
    for name, strip in strips.items():
        rows = np.arange(len(strip.covered)) if name == "occlusal" else np.flatnonzero(strip.covered.any(axis=1))
        if len(rows) and len(shown):
            window = slice(rows[0], rows[-1] + 1), columns
            arrays = {part: getattr(strip, part)[window] for part in ("image", "covered", "zone")}
            found[name] = replace(strip, curve=strip.curve[columns], **arrays)
    return found


def _zone(
    name: str, heights_mm: Float[np.ndarray, "h w"], covered: Bool[np.ndarray, "h w"], options: StripOptions
) -> np.ndarray:
    """What each pixel of a strip shows, as an index into `ZONES`; -1 for nothing."""
    shown = zones_of(heights_mm, len(heights_mm) // 2, options) if name == "occlusal" else ZONES.index(name)
    return np.where(covered, shown, -1).astype(np.int16)
