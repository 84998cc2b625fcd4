"""Image files: read by their content, whole, upright, and as 8 bits whatever they store.

Cameras of 10 and 12 bits often store them in 16. The largest value in the images of a folder shows how many bits they
use: one alone may just be dark.
"""

from __future__ import annotations

import io
import warnings
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float32, Shaped, UInt8, UInt16
from PIL import ExifTags, Image, ImageFile, ImageOps, UnidentifiedImageError

from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import read_bytes, require_file
from cuspid.runtime.values import one_line

Pixels = UInt8[np.ndarray, "h w 3"] | Float32[np.ndarray, "h w 3"]
"""An RGB image of 8 bits, or one with fractions of digital numbers of 255."""

PNG_END = b"IEND\xaeB`\x82"
"""The last bytes of a whole PNG file."""
LYING = (5, 6, 7, 8)
"""EXIF orientations of images whose sides are swapped to turn them upright."""
_PNG_START = b"\x89PNG\r\n\x1a\n"
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_TEXTS, _TURNING_TEXTS = (b"tEXt", b"zTXt", b"iTXt"), (b"Raw profile type", b"XML:com.adobe.xmp")
_PIXELS = (b"IHDR", b"IDAT", b"IEND")
_LARGEST = 65535
_DARK_DN, _BRIGHT_PERCENTILES = 128.0, (99.5, 99.9)
"""An image is dark if the second percentile is below this grey level; it is stretched until the first one is white."""
_CLIPPED_SHARE = 0.1
"""Share of the images of a film that are clipped where all are made brighter alike."""
_FULL, _FEWER_BITS = 16, (8, 10, 12)
"""Bits of what is stored in 16: with more than twelve, the upper eight show what there is."""


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit RGB image, upright. Raises InputError where the file is missing or cannot be decoded whole, or holds
    numbers that are no grey values."""
    return _decode(path, "RGB")


def read_fine(path: Path, *, upright: bool = True) -> Pixels:
    """As :func:`read_image`, but with fractions of its digital numbers (float32, below 256) where the file stores more
    than 8 bits; not ``upright``: in the grid of the sensor, whichever way the camera was held."""
    image_size(path)
    with _reading(path), Image.open(path) as image:
        levels = _levels(path, image, upright=upright)
        if levels is not None:
            fine = (levels / np.float32(1 << (_bits_of(path, image) - 8))).astype(np.float32)
            return np.ascontiguousarray(fine[..., :3] if fine.ndim == 3 else np.repeat(fine[..., None], 3, axis=2))
        return _as_8_bit(image, "RGB", upright=upright)


def as_8_bits(
    image: UInt8[np.ndarray, "*s"] | Float32[np.ndarray, "*s"], brighter: float = 1.0
) -> UInt8[np.ndarray, "*s"]:
    """The upper 8 bits of what :func:`read_fine` reads, or of more bits those of an image so many times brighter; black
    and white are the ends of what was stretched."""
    return image if image.dtype == np.uint8 else np.clip(image * np.float32(brighter), 0, 255).astype(np.uint8)


def visible_in_8_bits(grey: UInt8[np.ndarray, "h w"] | Float32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """An image of 8 bits as it is; of more bits those that show most of it, where it is dark."""
    return grey if grey.dtype == np.uint8 else brighten(grey)


def visible_grey(image: Pixels) -> UInt8[np.ndarray, "h w"]:
    """An RGB image in grey, as :func:`visible_in_8_bits`."""
    return visible_in_8_bits(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)))


def full_range_grey(image: Pixels) -> UInt8[np.ndarray, "h w"]:
    """An RGB image in grey; of more than 8 bits with the whole range of 8, however bright it is: where the corners of a
    chessboard are found depends on the contrast, by up to 0.3 px."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    bright = 0.0 if grey.dtype == np.uint8 else float(np.percentile(grey[::2, ::2], _BRIGHT_PERCENTILES[0]))
    return np.asarray(cv2.convertScaleAbs(grey, alpha=255 / bright), np.uint8) if bright > 0 else as_8_bits(grey)


def brighten(grey: UInt8[np.ndarray, "h w"] | Float32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """A dark image stretched to the whole range: the contrast of a keypoint is a share of it. Others as they are."""
    factor = _brightness_factor(grey)
    return as_8_bits(grey) if factor == 1 else np.asarray(cv2.convertScaleAbs(grey, alpha=factor), dtype=np.uint8)


def stretch_fine(
    grey: UInt8[np.ndarray, "h w"] | Float32[np.ndarray, "h w"],
) -> UInt8[np.ndarray, "h w"] | Float32[np.ndarray, "h w"]:
    """A dark image of more than 8 bits as bright as :func:`brighten` makes it, unrounded and unclipped; others as they
    are."""
    return grey if grey.dtype == np.uint8 else grey * np.float32(_brightness_factor(grey))


def common_brightening(images: Iterable[Pixels]) -> float:
    """How many times brighter images of one film can be, which are compared with each other: as :func:`brighten` makes
    all but the brightest tenth of them, if they have more than 8 bits."""
    greys = (np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in images)
    factors = [1.0 if grey.dtype == np.uint8 else _brightness_factor(grey) for grey in greys]
    return float(np.quantile(factors, _CLIPPED_SHARE, method="higher")) if factors else 1.0


def _brightness_factor(grey: UInt8[np.ndarray, "h w"] | Float32[np.ndarray, "h w"]) -> float:
    """How many times brighter a dark image can be; 1 for others."""
    bright, brightest = np.percentile(grey[::2, ::2], _BRIGHT_PERCENTILES).tolist()
    return 255 / bright if 0 < bright <= brightest < _DARK_DN else 1.0


def read_rgba(path: Path) -> UInt8[np.ndarray, "h w 4"]:
    """As :func:`read_image`, with the opacity of each pixel; 255 where the file has none."""
    return _decode(path, "RGBA")


def read_as_stored(path: Path) -> UInt8[np.ndarray, "h w 4"]:
    """As :func:`read_rgba`, but in the grid of the sensor, whichever way the camera was held."""
    return _decode(path, "RGBA", upright=False)


def read_deep(path: Path) -> UInt8[np.ndarray, "h w *c"] | UInt16[np.ndarray, "h w *c"]:
    """As :func:`read_image`, but as stored, with 8 or 16 bits; grey as (h, w)."""
    image_size(path)
    with _reading(path), Image.open(path) as image:
        if (levels := _levels(path, image)) is not None:
            return levels if levels.ndim == 2 else np.ascontiguousarray(levels[..., :3])
        ImageOps.exif_transpose(image, in_place=True)
        return np.asarray(image if image.mode in ("L", "RGB") else image.convert("RGB"))


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in px, upright, from the header. Raises InputError where the file is missing, truncated or no
    image."""
    try:
        with require_file(path, "image").open("rb") as stream:
            start = stream.read(4)
            stream.seek(0)
            image = Image.open(stream)
            width, height = image.size
            # Pillow turns TIFF by itself.
            if image.format != "TIFF" and _orientation(image, stream) in LYING:
                width, height = height, width
            stream.seek(max(0, path.stat().st_size - len(PNG_END)))
            end = stream.read()
    except Image.DecompressionBombError as error:
        raise InputError(
            f"{path}: too many pixels; at most {2 * (Image.MAX_IMAGE_PIXELS or 0):,} can be read"
        ) from error
    except UnidentifiedImageError as error:
        if start in _TIFF_STARTS:
            raise InputError(
                f"{path}: a TIFF of a kind that is not read, or truncated; save it with 8 or 16 bits"
            ) from error
        raise InputError(f"{path}: not an image, or truncated; copy the image again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); put the image back") from error
    except InputError:
        raise
    except Exception as error:  # a reader of Pillow raises whatever its format makes of the header
        raise InputError(f"{path}: damaged ({one_line(error)}); copy the image again") from error
    if image.format == "PNG" and end != PNG_END:
        raise InputError(f"{path}: truncated PNG; copy the image again")
    return width, height


def has_opacity(path: Path) -> bool:
    """Whether an image file states the opacity of its pixels."""
    image_size(path)
    with Image.open(path) as image:
        return image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info


# --- how the camera was held ------------------------------------------------------------------------------------------


def exif_orientation(path: Path) -> int:
    """How an image was held when it was taken, as EXIF has it: 1 (upright) to 8; 1 where the file does not say."""
    try:
        with warnings.catch_warnings(action="ignore"), require_file(path, "image").open("rb") as stream:
            return _orientation(Image.open(stream), stream)
    except Exception:  # what is wrong with the file is told where it is read
        return 1


def recorded_size(path: Path) -> tuple[int, int]:
    """Width and height of an image as the sensor recorded it, px. Raises InputError as :func:`image_size`."""
    width, height = image_size(path)
    return (height, width) if exif_orientation(path) in LYING else (width, height)


def undo_exif_orientation(upright: Shaped[np.ndarray, "h w *c"], orientation: int) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """An image that was turned upright by its EXIF orientation, as the sensor recorded it."""
    # Each way is its own reverse, but for the two quarter turns, which are each other's.
    return _undo_exif_rotation(upright, {6: 8, 8: 6}.get(orientation, orientation))


def _undo_exif_rotation(image: Shaped[np.ndarray, "h w *c"], orientation: int) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """An image as the sensor recorded it, upright."""
    across = image.swapaxes(0, 1)
    return {
        1: image,
        2: image[:, ::-1],
        3: image[::-1, ::-1],
        4: image[::-1],
        5: across,
        6: across[:, ::-1],
        7: across[::-1, ::-1],
        8: across[::-1],
    }[orientation]


def _orientation(image: Image.Image, stream: io.BufferedIOBase) -> int:
    """Of a PNG, Pillow would decode everything to see whether it tells something behind the pixels."""
    if image.format == "PNG" and not any(_may_turn(*chunk) for chunk in _chunks(stream)):
        return 1
    found = image.getexif().get(ExifTags.Base.Orientation, 1)
    return found if isinstance(found, int) and 1 <= found <= 8 else 1


def _may_turn(kind: bytes, start: bytes, at: int, length: int) -> bool:
    return kind == b"eXIf" or (kind in _TEXTS and start.startswith(_TURNING_TEXTS))


def _chunks(stream: io.BufferedIOBase) -> Iterator[tuple[bytes, bytes, int, int]]:
    """Kind, first bytes, place and length of the chunks of a PNG; the stream is left where it was."""
    before = stream.tell()
    try:
        stream.seek(len(_PNG_START))
        while len(head := stream.read(8)) == 8:
            length, kind, at = int.from_bytes(head[:4], "big"), head[4:], stream.tell()
            yield kind, stream.read(min(length, 24)), at, length
            stream.seek(at + length + 4)
    finally:
        stream.seek(before)


# --- grey values ------------------------------------------------------------------------------------------------------


def _decode(path: Path, mode: Literal["RGB", "RGBA"], *, upright: bool = True) -> UInt8[np.ndarray, "h w *c"]:
    image_size(path)
    with _reading(path), Image.open(path) as image:
        levels = _levels(path, image, upright=upright)
        if levels is not None:
            shown = Image.fromarray((levels >> (_bits_of(path, image) - 8)).astype(np.uint8))
            return np.asarray(shown.convert(mode))
        return _as_8_bit(image, mode, upright=upright)


def _as_8_bit(image: Image.Image, mode: Literal["RGB", "RGBA"], *, upright: bool = True) -> UInt8[np.ndarray, "h w *c"]:
    """Of an image of 8 bits."""
    if upright:
        ImageOps.exif_transpose(image, in_place=True)
    return np.asarray(image if image.mode == mode else image.convert(mode))


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # a reader of Pillow raises whatever its format makes of the file
        raise InputError(f"{path}: cannot be decoded ({one_line(error)}); copy the image again") from error


def _levels(path: Path, image: Image.Image, *, upright: bool = True) -> UInt16[np.ndarray, "h w *c"] | None:
    """What is stored in more than 8 bits, as 16; None of an image of 8."""
    if image.mode in ("I", "F") or image.mode.startswith("I;16"):
        if upright:
            ImageOps.exif_transpose(image, in_place=True)
        return _as_levels(path, np.asarray(image))
    if not isinstance(image, ImageFile.ImageFile) or not any(";16" in str(tile.args) for tile in image.tile):
        return None
    turn = exif_orientation(path) if upright or image.format == "TIFF" else 1
    is_png = image.format == "PNG"
    image.load()  # refuses what is damaged, and keeps the upper 8 bits of colours
    data = _bare_png(path) if is_png else read_bytes(path, "image")
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.dtype != np.uint16:
        return None
    if stored.ndim == 3:
        stored = cv2.cvtColor(stored, cv2.COLOR_BGR2RGB if stored.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)
    return np.ascontiguousarray(_undo_exif_rotation(stored, turn), dtype=np.uint16)


def _as_levels(path: Path, values: Shaped[np.ndarray, "h w"]) -> UInt16[np.ndarray, "h w"]:
    """Raises InputError for numbers of which it is not known what they mean."""
    low, high = values.min(), values.max()
    if values.dtype.kind == "f":
        if not (low >= 0 and high <= 1):
            raise InputError(
                f"{path}: its values are decimals from {low:.4g} to {high:.4g}; save it with 8 or 16 bits, or as "
                "decimals from 0 to 1"
            )
        return np.rint(values * np.float64(_LARGEST)).astype(np.uint16)
    if low < 0 or high > _LARGEST:
        raise InputError(f"{path}: its values go from {low} to {high}; save it with 8 or 16 bits")
    return values.astype(np.uint16)


def _bare_png(path: Path) -> bytes:
    """A PNG with its pixels only: of anything else, libpng may complain to the terminal. Raises ValueError for wrong
    checksums, which Pillow passes over and libpng does not."""
    data = read_bytes(path, "image")
    chunks = [data[at - 8 : at + length + 4] for kind, _, at, length in _chunks(io.BytesIO(data)) if kind in _PIXELS]
    if any(zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:], "big") for chunk in chunks):
        raise ValueError("wrong checksums")
    return b"".join([_PNG_START, *chunks])


_lock = Lock()


def _bits_of(path: Path, image: Image.Image) -> int:
    """Bits that an image of more than 8 uses."""
    return _FULL if image.mode == "F" else _bits_used(path.parent, path.suffix)


def _bits_used(folder: Path, suffix: str) -> int:
    """Bits that the images of a folder use, of the 16 that they are stored in."""
    with _lock:  # or every thread would read all of them
        return _bits_used_then(folder, suffix, folder.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _bits_used_then(folder: Path, suffix: str, modified_ns: int) -> int:
    most = 0
    for path in sorted(folder.iterdir()):
        if path.suffix == suffix and not path.name.startswith("."):
            with suppress(OSError, InputError):
                state = require_file(path, "image").stat()
                most = max(most, _peak(path, state.st_size, state.st_mtime_ns))
        if most >> max(_FEWER_BITS):
            return _FULL
    return next(bits for bits in _FEWER_BITS if most >> bits == 0)


@lru_cache(maxsize=1 << 16)
def _peak(path: Path, size: int, modified_ns: int) -> int:
    """Largest value of an image, 0 if it is none of 16 bits; whoever reads it is told what is wrong with it."""
    try:
        with _reading(path), Image.open(path) as image:
            levels = None if image.mode == "F" else _levels(path, image)
    except InputError:
        return 0
    return 0 if levels is None else int(levels.max())
