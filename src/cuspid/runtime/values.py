"""Values from outside, checked once where they come in: numbers that can be computed with, names that can be files.

``what`` names the value in the one line that an error shows, for example ``rig.json: camera a: focal_px``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from cuspid.runtime.errors import InputError

LONGEST_MM = 1e5
"""Upper limit of every position, distance or size of a handpiece or a jaw."""
MOST_PX = 65_535
"""Largest side of an image; PNG and JPEG files of cameras stay below."""
_LONGEST_NAME = 100
_NOT_IN_FILES = '/\\:*?"<>|'
_SHOWN = 40
_LARGEST_VARIANCE = 1e30
"""In whatever unit; sums of larger ones could overflow."""
_ROUNDING = 1e-6
"""Smallest eigenvalue of a covariance, as a share of the largest, that counts as zero."""


def checked_name(what: str, value: object) -> str:
    """A name that can be the stem of a file, or of one in subfolders (``rig/left``), on any system, and leads nowhere
    else.

    Raises InputError for one that is empty or too long, or where a part of it is empty, begins with a dot, or has a
    character that some system does not allow in file names.
    """
    if not (isinstance(value, str) and len(value) <= _LONGEST_NAME and all(map(_can_be_a_file, value.split("/")))):
        raise InputError(f"{what}: {quote(value)} cannot be used as a name; use letters, digits, - and _")
    return value


def _can_be_a_file(part: str) -> bool:
    if not part or part[0] == "." or part != part.strip():
        return False
    return part.isprintable() and not any(each in _NOT_IN_FILES for each in part)


def title(what: str, value: object) -> str:
    """Text that fits in one line of a page or a picture. Raises InputError otherwise."""
    if not (isinstance(value, str) and value.isprintable() and len(value) <= _LONGEST_NAME):
        raise InputError(
            f"{what} is {quote(value)}; it must be text of one line, of at most {_LONGEST_NAME} characters"
        )
    return value


def number(what: str, value: object, low: float, high: float) -> float:
    """A finite number between two bounds (inclusive). Raises InputError otherwise."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise InputError(f"{what} is {quote(value)}; it must be a number")
    if not low <= value <= high:
        raise InputError(f"{what} is {quote(value)}; it must lie between {low:g} and {high:g}")
    return float(value)


def whole(what: str, value: object, low: int, high: int) -> int:
    """An integer between two bounds (inclusive). Raises InputError otherwise."""
    found = number(what, value, float(low), float(high))
    if found != int(found):
        raise InputError(f"{what} is {quote(value)}; it must be a whole number")
    return int(found)


def numbers(what: str, value: Any, shape: tuple[int, ...], low: float, high: float) -> Float[np.ndarray, "..."]:
    """Finite numbers of a given shape, each between two bounds (inclusive). Raises InputError otherwise."""
    try:
        found = np.asarray(value)
        plain = found.dtype.kind in "iuf" and not _has_truth(value)
        found = found.astype(np.float64) if plain else np.full(1, np.nan)
    except (ValueError, TypeError, OverflowError):  # a list of unequal lists, or of what is no number
        found = np.full(1, np.nan)
    if found.shape != shape:
        size = " x ".join(map(str, shape))
        raise InputError(f"{what} is {quote(value)}; it must be {size} numbers")
    if not np.all((found >= low) & (found <= high)):
        raise InputError(f"{what} is {quote(value)}; each must lie between {low:g} and {high:g}")
    return found


def _has_truth(value: Any) -> bool:
    """Whether true or false stands somewhere in lists of lists."""
    return isinstance(value, bool) or (isinstance(value, list) and any(map(_has_truth, value)))


def covariance(what: str, value: Any, size: int) -> Float[np.ndarray, "n n"]:
    """A covariance matrix: symmetric, without a negative eigenvalue. Raises InputError otherwise."""
    found = numbers(what, value, (size, size), -math.inf, math.inf)
    if not np.abs(found).max() <= _LARGEST_VARIANCE:
        raise InputError(f"{what} is not finite, or beyond {_LARGEST_VARIANCE:g}; leave it out if it is unknown")
    eigenvalues = np.linalg.eigvalsh((found + found.T) / 2)
    if not np.allclose(found, found.T, rtol=0, atol=_ROUNDING * np.abs(found).max()) or eigenvalues[
        0
    ] < -_ROUNDING * abs(eigenvalues[-1]):
        raise InputError(f"{what} is not a covariance matrix: it must be symmetric, without negative eigenvalues")
    return found


def printable(text: str) -> str:
    """Text whose control characters, and bytes that are no text, are written out: ``\\x1b``."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def one_line(message: object) -> str:
    """A message from a library or a file, cut to one short line."""
    return quote(" ".join(str(message).split()), longest=120)[1:-1]


def quote(value: object, *, longest: int = _SHOWN) -> str:
    """A value for a message: short, on one line, without control characters."""
    text = repr(value if not isinstance(value, np.ndarray) else value.tolist()).replace("\n", " ")
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def join_names(names: Sequence[str], most: int = 6) -> str:
    """Names on one line; if there are many, those in the middle are left out."""
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(names[: most - 1])} ... {names[-1]}"
