"""Compiled kernels: numba's ``njit`` without the GIL, cached on disk. Division by zero gives infinity or NaN, as in
numpy: raising an error would put a branch into each loop that divides, which would then not vectorise.

numba keeps the machine code of a function in numbered files, with an index that names the file of each signature. It
loads what the index names unchecked, although two processes that compile at the same time may have written each
other's numbers (numba issue 10128 is such a case), and although a function that is called, and so compiled into it, may
have changed in another module. Either gives wrong results silently. Here each piece of compiled code records what it
was compiled from, and is used only if that is what is wanted; and processes that need the same kernel at the same time
wait for the one that compiles it. Nothing public of numba does this, so pyproject.toml bounds its version by the last
one that was tested.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial, wraps
from pathlib import Path
from typing import Any

from filelock import FileLock
from numba import njit
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

_LONGEST_WAIT_S = 120.0


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Decorator: compile a function when it is first called; in each process again where nothing can be cached on disk
    (``NUMBA_CACHE_DIR`` names a place). ``options`` are those of ``numba.njit``."""
    if function is None:
        return partial(kernel, **options)
    compiled = njit(nogil=True, error_model="numpy", **options)(function)
    if isinstance(compiled, Dispatcher):  # otherwise numba is told not to compile
        try:
            cache = _KernelCache(function)
        except RuntimeError:  # nowhere to keep it: a read-only installation without a home
            return compiled
        compiled._cache = cache  # type: ignore[attr-defined]
        compiled.compile = _serialize_compilation(compiled.compile, cache)  # type: ignore[method-assign]
    return compiled


def _serialize_compilation(compile_for: Callable[..., Any], cache: _KernelCache) -> Callable[..., Any]:
    """``Dispatcher.compile``, which takes what is on disk or compiles and stores it, in one process at a time."""

    @wraps(compile_for)
    def compile_locked(signature: object) -> Any:
        with cache.hold_lock():
            return compile_for(signature)

    return compile_locked


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
        self._lock_path = Path(self._cache_path) / f"{self._impl.filename_base}.lock"

    @contextmanager
    def hold_lock(self) -> Iterator[None]:
        """Let no other thread or process compile this kernel; where files cannot be locked, no other thread."""
        with global_compiler_lock, ExitStack() as stack:  # in this order: a thread that compiles may wait for files
            with suppress(OSError):
                self._impl.locator.ensure_cache_path()
                # A lock of its own each time: a forked process must not use one that it inherited.
                stack.enter_context(FileLock(self._lock_path, timeout=_LONGEST_WAIT_S, thread_local=False))
            yield


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
