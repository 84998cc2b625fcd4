"""Photographs of one thing, taken by one camera from many places: files on disk that are read on demand.

An image is read in the grid of the sensor, whichever way the camera was held: that is what a calibration means. A
place that a person picked is one of the upright picture; :meth:`Photograph.in_sensor` converts it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, UInt8

from cuspid.model.camera import Camera
from cuspid.model.capture import Dropped, file_digest
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import Pixels, image_size, read_as_stored, read_deep, read_fine
from cuspid.runtime.values import checked_name

UPRIGHT, _LYING = 1, (5, 6, 7, 8)
"""EXIF orientations: none, and those that swap width and height."""
_FROM_RIGHT, _FROM_BELOW = (2, 3, 7, 8), (3, 4, 6, 7)
"""Those whose upright picture begins at the right, or at the lower, edge of the sensor."""


@dataclass(frozen=True, kw_only=True)
class Photograph:
    """One photograph."""

    name: str
    """Name of its frame: the stem of the file."""
    path: Path
    """The file."""
    camera: str
    """Name of the camera that took it: photographs of one size and focal length have one."""
    size: tuple[int, int]
    """Width and height in px, in the grid of the sensor."""
    orientation: int = UPRIGHT
    """EXIF orientation, 1 to 8: how the picture is turned for people to look at."""
    mask: Path | None = None
    """Image of the same size that is zero where the photograph does not count; None: all of it counts, but for what is
    transparent."""

    def __post_init__(self) -> None:
        checked_name("photograph", self.name)

    def in_sensor(self, upright: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """A place of the upright picture, px, in the grid of the sensor."""
        (u, v), (width, height) = upright, self.size
        if self.orientation in _LYING:
            u, v = v, u
        return np.array(
            [
                width - u if self.orientation in _FROM_RIGHT else u,
                height - v if self.orientation in _FROM_BELOW else v,
            ]
        )

    def pixels(self) -> Pixels:
        """RGB in the grid of the sensor, with fractions of digital numbers where more than 8 bits are stored. Raises
        InputError where it cannot be read or changed its size."""
        image = read_fine(self.path, upright=False)
        if image.shape[1::-1] != self.size:
            raise InputError(f"{self.path}: its size changed while it was in use; start again")
        return image

    def counts(self) -> UInt8[np.ndarray, "h w"] | None:
        """Where the photograph counts (not zero), by its mask and its opacity; None: everywhere."""
        shown = None if self.mask is None else self._mask()
        opacity = read_as_stored(self.path)[..., 3] if self._may_be_transparent else None
        if opacity is None or opacity.all():
            return shown
        return opacity if shown is None else np.where(shown > 0, opacity, 0).astype(np.uint8)

    def check_mask(self) -> None:
        """Raises InputError where the mask is of another size, or leaves nothing."""
        counts = self.counts()
        if counts is not None and not counts.any():
            raise InputError(f"{self.mask or self.path}: the mask is empty; white is what counts, black what does not")

    @property
    def _may_be_transparent(self) -> bool:
        return self.path.suffix.lower() in (".png", ".tif", ".tiff")

    def _mask(self) -> UInt8[np.ndarray, "h w"]:
        assert self.mask is not None
        values = read_deep(self.mask)
        shown = values if values.ndim == 2 else values[..., :3].max(axis=2)
        whole = np.where(shown > 0, 255, 0).astype(np.uint8)
        width, height = self.size
        if whole.shape == (width, height) and self.orientation in _LYING:  # of the upright picture
            whole = _as_stored(whole, self.orientation)
        if whole.shape != (height, width):
            raise InputError(
                f"{self.mask}: {values.shape[1]} x {values.shape[0]} px, but {self.path.name} has {width} x {height} "
                "px; a mask has the size of its photograph"
            )
        return np.ascontiguousarray(whole)


def _as_stored(upright: UInt8[np.ndarray, "h w"], orientation: int) -> UInt8[np.ndarray, "w h"]:
    """A lying picture from the upright one."""
    stored = upright.T
    return {5: stored, 6: stored[::-1], 7: stored[::-1, ::-1], 8: stored[:, ::-1]}[orientation]


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotoCamera:
    """What is known about a camera before the photographs are looked at."""

    size: tuple[int, int]
    """Width and height of its photographs, px."""
    focal_px: float | None = None
    """Focal length by EXIF; None where it is unknown."""
    calibrated: Camera | None = None
    """Calibration; None if it is to be found from the photographs."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Photographs:
    """Photographs of one thing. An :class:`cuspid.model.capture.ImageSource`, whose frames are the photographs'
    names."""

    source: Path
    """What the user gave: a folder or a video."""
    photographs: tuple[Photograph, ...] = field(repr=False)
    """In the order of their names."""
    cameras: Mapping[str, PhotoCamera]
    """The cameras by name."""
    is_film: bool = False
    """Whether each was taken shortly after the one before it."""
    left_out: tuple[Dropped, ...] = ()
    """Files that are not used, and why."""
    notes: tuple[str, ...] = ()
    """What was found while reading, one line each."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", MappingProxyType(dict(self.cameras)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the photographs."""
        return tuple(each.name for each in self.photographs)

    @cached_property
    def _by_name(self) -> Mapping[str, Photograph]:
        return {each.name: each for each in self.photographs}

    def __getitem__(self, name: str) -> Photograph:
        """The photograph of a name, with or without its suffix. Raises InputError where there is none."""
        found = self._by_name.get(name) or self._by_name.get(Path(name).stem)
        if found is None:
            raise InputError(f"{self.source}: no photograph named {name}; the first one is {self.names[0]}")
        return found

    # --- as a source of images -------------------------------------------------------------------------------------

    @property
    def suffix(self) -> str:
        """As :attr:`cuspid.model.capture.ImageSource.suffix`; that of the first one, where they differ."""
        return self.photographs[0].path.suffix

    def read(self, frame: str, camera: str) -> Pixels:
        """As :meth:`cuspid.model.capture.ImageSource.read`, in the grid of the sensor."""
        return np.ascontiguousarray(self[frame].pixels())

    def mask(self, frame: str, camera: str) -> UInt8[np.ndarray, "h w"] | None:
        """Where an image counts (not zero); None: everywhere."""
        return self[frame].counts()

    def size(self, frame: str, camera: str) -> tuple[int, int]:
        """As :meth:`cuspid.model.capture.ImageSource.size`."""
        image_size(self[frame].path)
        return self[frame].size

    def digest(self, frame: str, camera: str) -> str:
        """As :meth:`cuspid.model.capture.ImageSource.digest`; of the mask as well."""
        photograph = self[frame]
        return " ".join(file_digest(path) for path in (photograph.path, photograph.mask) if path is not None)

    def where(self, frame: str, camera: str) -> str:
        """As :meth:`cuspid.model.capture.ImageSource.where`."""
        return str(self[frame].path)
