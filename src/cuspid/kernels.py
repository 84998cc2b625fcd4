"""Compiled kernels: numba's ``njit`` without the GIL, cached on disk. Division by zero gives infinity or NaN, as in
numpy: raising an error would put a branch into each loop that divides, which would then not vectorise.

numba keeps the machine code of a function in numbered files, with an index that names the file of each signature. It
loads what the index names unchecked, although two processes that compile at the same time may have written each
other's numbers (numba issue 10128 is such a case), and although a function that is called, and so compiled into it, may
have changed in another module. Either gives wrong results silently. Here each piece of compiled code records what it
was compiled from, and is used only if that is what is wanted.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Decorator: compile a function when it is first called. ``options`` are those of ``numba.njit``."""
    if function is None:
        return partial(kernel, **options)
    compiled = njit(nogil=True, error_model="numpy", **options)(function)
    if isinstance(compiled, Dispatcher):  # otherwise numba is told not to compile
        compiled._cache = _KernelCache(function)  # type: ignore[attr-defined]
    return compiled


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """The compiled code of one kernel on disk."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stamp = self._impl.locator.get_source_stamp()
        called = [getattr(function.__globals__.get(name), "_cache", None) for name in function.__code__.co_names]
        self.stamp: tuple[object, ...] = stamp, *(each.stamp for each in called if isinstance(each, _KernelCache))
        self._cache_file = CheckedFile(
            cache_path=self._cache_path, filename_base=self._impl.filename_base, source_stamp=self.stamp
        )


class CheckedFile(IndexDataCacheFile):  # type: ignore[misc]
    """Files of compiled code that record what they were compiled from: the sources and the signature."""

    def save(self, key: object, data: object) -> None:
        """Store code under a key."""
        super().save(key, (self._source_stamp, key, data))

    def load(self, key: object) -> object | None:
        """The code stored under a key; None where there is none, or the file was compiled from something else."""
        found = super().load(key)
        if found is None or tuple(found[:2]) != (self._source_stamp, key):
            return None
        return found[2]
