"""What the C library does with memory that is freed. Without glibc, nothing here has an effect.

By default every array of more than some hundred kilobytes is mapped afresh, and the system clears its pages: over an
arch this took a twentieth of all time. Kept memory is used again at once; but what one stage leaves, another may not
need.
"""

from __future__ import annotations

import ctypes
import sys

_LIBC = ctypes.CDLL(None) if sys.platform == "linux" else None
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_MAPPED_FROM = 32 << 20
"""Bytes; larger arrays are mapped, and so given back when they are freed. glibc takes no more."""
_KEPT = 1 << 30
"""Bytes that each thread may keep at most."""


def keep_freed() -> None:
    """From now on, keep freed memory for later allocations."""
    if _LIBC is not None and hasattr(_LIBC, "mallopt"):
        _LIBC.mallopt(_M_MMAP_THRESHOLD, _MAPPED_FROM)
        _LIBC.mallopt(_M_TRIM_THRESHOLD, _KEPT)


def trim_heap() -> None:
    """Return to the system what is kept, as at the end of a stage."""
    if _LIBC is not None and hasattr(_LIBC, "malloc_trim"):
        _LIBC.malloc_trim(0)
