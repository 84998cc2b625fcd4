"""The scale of a finished panorama, from distances that were measured in the mouth between places that it shows.

One camera does not know how large things are. Two cusps can be found both in the mouth and in the picture, so that the
distance between them, taken with callipers, sets the scale: of all that is to be had without a second camera the truest
(docs/panorama-evaluation.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.panorama import Panorama
from cuspid.runtime.errors import InputError

_READING_MM = 0.1
"""An error in reading callipers, to tell what it amounts to."""
_APART_PCT = 3.0
"""Distances that differ by more than this from the scale that suits all of them are noted: drift alone is mostly less
(docs/panorama.md, Limits)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredDistance:
    """How far two places of a panorama lie apart."""

    places_px: Float[np.ndarray, "2 2"]
    """Pixels (u, v) of the panorama, the centre of the first at (0.5, 0.5)."""
    mm: float
    """The distance between them in space, as measured."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Rescaled:
    """A panorama at the scale of what was measured."""

    panorama: Panorama
    """In millimetres."""
    factor: float
    """Factor by which its lengths grew (millimetres per pixel where they were pixels)."""
    lengths_mm: Float[np.ndarray, "n"]
    """The measured distances, in the panorama as it is now."""


def rescale_panorama(panorama: Panorama, distances: Sequence[MeasuredDistance]) -> Rescaled:
    """The panorama at the scale that suits the distances best (least squares of their errors in mm).

    Raises InputError where a place is not shown, where the places of a distance are the same, and for a view of a mesh,
    whose millimetres are those of the mesh.
    """
    if panorama.method == "mesh":
        raise InputError("the picture is a view of a mesh, and in its millimetres; scale the mesh")
    lengths = np.array([_length(panorama, each) for each in distances])
    measured = np.array([each.mm for each in distances])
    factor = float(lengths @ measured / (lengths @ lengths))
    fitted = factor * lengths
    height = None if panorama.height_mm is None else panorama.height_mm * np.float32(factor)
    new = replace(
        panorama,
        mm_per_px=factor * (panorama.mm_per_px or 1.0),
        height_mm=height,
        notes=(
            *_notes(panorama, factor, measured, fitted),
            *(note for note in panorama.notes if not note.startswith("the scale ")),
        ),
    )
    return Rescaled(panorama=new, factor=factor, lengths_mm=fitted)


def scaled_pose(cam_from_world: Rigid3, factor: float) -> Rigid3:
    """A pose in a world whose lengths grew by a factor."""
    return Rigid3(cam_from_world.rotation, factor * cam_from_world.translation)


def _length(panorama: Panorama, distance: MeasuredDistance) -> float:
    """In the panorama's own lengths; in the occlusal plane where it has no heights."""
    first, second = (_place(panorama, pixel) for pixel in distance.places_px)
    length = float(np.linalg.norm(second - first))
    if length == 0:
        u, v = distance.places_px[0]
        raise InputError(f"a distance between ({u:g}, {v:g}) and the same pixel; give two places")
    return length


def _place(panorama: Panorama, pixel: Float[np.ndarray, "2"]) -> Float[np.ndarray, "k"]:
    """World (x, y, z) of a pixel, or (x, y) where there are no heights."""
    height, width = panorama.covered.shape
    column, row = (int(np.floor(each)) for each in pixel)
    u, v = pixel
    if not (0 <= column < width and 0 <= row < height):
        raise InputError(f"pixel ({u:g}, {v:g}) lies outside the panorama of {width} x {height} px")
    place = panorama.world_from_pixels(pixel)
    if panorama.height_mm is not None:
        place = np.append(place, panorama.height_mm[row, column])
    if not (panorama.covered[row, column] and np.isfinite(place).all()):
        raise InputError(f"the panorama shows nothing at pixel ({u:g}, {v:g}); give a place on a tooth")
    return place


def _notes(
    panorama: Panorama, factor: float, measured: Float[np.ndarray, "n"], fitted: Float[np.ndarray, "n"]
) -> tuple[str, ...]:
    """What the scale is from, how well it can be known, and what does not fit."""
    lengths = " and ".join(f"{each:g} mm" for each in measured)
    before = "none" if panorama.mm_per_px is None else f"smaller by a factor of {factor:.4f}"
    if panorama.mm_per_px is not None and factor < 1:
        before = f"larger by a factor of {1 / factor:.4f}"
    reading_pct = 100 * _READING_MM / float(np.linalg.norm(fitted))
    known = f"an error of {_READING_MM:g} mm in them is {reading_pct:.2g} % of all lengths"
    scale = f"the scale is that of {lengths} between places of the picture (before: {before}); {known}"
    off_pct = 100 * (fitted / measured - 1)
    apart = tuple(
        f"{mm:g} mm come out as {length:.2f} ({off:+.1f} %): check the places and the number, or whether the scale "
        f"drifts along the arch"
        for mm, length, off in zip(measured, fitted, off_pct, strict=True)
        if abs(off) > _APART_PCT
    )
    flat = () if panorama.height_mm is not None else ("the panorama has no heights: distances count as level",)
    return (scale, *apart, *flat)
