"""The one error family of cuspid.

    CuspidError                 every known error: one line that says what, where, what to change
    ├── InputError              a file, folder or value that the user gave cannot be used
    ├── OutputError             the output cannot be written (other run's folder, full disk)
    ├── ReconstructionError     the images do not carry enough to locate the frames or build a surface
    └── MissingDependencyError  an optional program or package is not there

The command line prints the message of a ``CuspidError`` on one line and exits with status 1.
"""

from __future__ import annotations

import re

_OVERLONG = re.compile(r"[^\s/\\'\"]{260,}")
"""No name of a file or folder is this long: it comes from a damaged file."""


class CuspidError(Exception):
    """Root of the family. ``str(error)`` is the one line shown to the user, with words longer than any file name cut
    and control characters escaped."""

    def __init__(self, message: str) -> None:
        cut = _OVERLONG.sub(lambda word: f"{word[0][:40]}...", message)
        super().__init__("".join(each if each.isprintable() else repr(each)[1:-1] for each in cut))


class InputError(CuspidError):
    """A file, folder or value that was given cannot be used."""


class OutputError(CuspidError):
    """The output folder belongs to another run, or the disk is full or read-only."""


class ReconstructionError(CuspidError):
    """The images do not carry enough information; says how many frames failed and why."""


class MissingDependencyError(CuspidError):
    """An optional program, package or system library is missing; says how to get it."""
