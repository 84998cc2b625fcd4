"""Input files: only regular files of a manageable size, and text only if it is valid.

A pipe, a device or an endless file is refused before it is opened.
"""

from __future__ import annotations

import stat
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from cuspid.runtime.errors import InputError

Kind = Literal["text", "image", "mesh", "arrays", "file"]
LARGEST_MIB: Mapping[Kind, int] = MappingProxyType(
    {"text": 64, "image": 1024, "mesh": 4096, "arrays": 8192, "file": 1 << 20}
)
"""Largest size of each kind of file; ``file`` is any other, such as a video."""


def is_there(path: Path) -> bool:
    """Whether there is such a file; a name that is too long for any, or lies where nobody may look, is none."""
    try:
        return path.is_file()
    except OSError:
        return False


def require_file(path: Path, kind: Kind) -> Path:
    """Return the path. Raises InputError where it is not a regular file, or is too large for its kind."""
    try:
        found = path.stat()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:  # a name with a NUL is no OSError
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if not stat.S_ISREG(found.st_mode):
        what = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe or a device"
        raise InputError(f"{path}: is {what}; give a file")
    if found.st_size > LARGEST_MIB[kind] << 20:
        raise InputError(
            f"{path}: {found.st_size >> 20} MiB is too large for this kind of file ({kind}); "
            f"the limit is {LARGEST_MIB[kind]} MiB"
        )
    return path


def read_bytes(path: Path, kind: Kind) -> bytes:
    """The contents of a file. Raises InputError as :func:`require_file` does, and where it cannot be read."""
    try:
        return require_file(path, kind).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


def read_text(path: Path) -> str:
    """The contents of a text file in UTF-8. Raises InputError."""
    try:
        return read_bytes(path, "text").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a UTF-8 text file") from error
