"""How many cores this process may use, the distribution of work over threads and processes, and properties that threads
share."""

from __future__ import annotations

import io
import multiprocessing
import os
import pickle
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields, is_dataclass
from functools import cached_property
from itertools import islice, pairwise
from threading import RLock, Thread
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from cuspid.runtime.progress import Progress, silent

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

_BATCH_PER_CORE = 8

START_METHOD: Literal["fork", "spawn"] = "fork" if sys.platform == "linux" else "spawn"
"""How processes begin: as a copy of this one, with all that it has, or empty, with what they are given
(:func:`pickle_fields`). Elsewhere than on Linux, system libraries do not survive a copy."""


class computed_once(cached_property[_Result]):
    """A cached property that threads do not compute side by side: since Python 3.12, functools' own has no lock."""

    def __init__(self, compute: Callable[[Any], _Result]) -> None:
        super().__init__(compute)
        self._lock = RLock()

    if not TYPE_CHECKING:

        def __get__(self, instance: object, owner: type | None = None) -> object:
            with self._lock:
                return super().__get__(instance, owner)


def core_numbers(thread: int = 0) -> list[int]:
    """The numbers of the cores that a thread may run on: those of the calling thread, or of a process given its id.

    All cores if the system does not say.
    """
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(thread))
    return list(range(os.cpu_count() or 1))


def keep_to_core(number: int) -> None:
    """The calling thread, and those that it starts, run on this core alone from now on; where the system has a say."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {number})


def usable_cores() -> int:
    """Number of cores that the calling thread, and those that it starts, may run on; a case of a study has one."""
    return len(core_numbers())


def map_in_threads(
    work: Callable[[_Item], _Result], items: Iterable[_Item], *, stage: str = "", progress: Progress = silent
) -> list[_Result]:
    """``work`` on each item, in one thread per usable core; results in the order of the items.

    If there are errors, the first in that order is raised, and items that were not started are skipped. ``progress`` is
    called with ``stage`` after each.
    """
    results: list[_Result] = []
    with ThreadPoolExecutor(usable_cores()) as pool:
        jobs = [pool.submit(work, item) for item in items]
        try:
            for job in jobs:
                results.append(job.result())
                progress(stage, len(results), len(jobs))
        finally:
            pool.shutdown(cancel_futures=True)
    return results


def map_ahead(work: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """``work`` on each item, in threads that run one item per usable core ahead of what was consumed; results in the
    order of the items, which are read as they are needed."""
    ahead = usable_cores()
    jobs = deque[Future[_Result]]()
    with ThreadPoolExecutor(ahead) as pool:
        try:
            for item in items:
                jobs.append(pool.submit(work, item))
                if len(jobs) > ahead:
                    yield jobs.popleft().result()
            while jobs:
                yield jobs.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


def map_batches(work: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[list[_Result]]:
    """``work`` on each item, in threads, several items per usable core at a time; the results of each time, in the
    order of the items, which are read as they are needed. What is done with them may use all cores as well."""
    remaining = iter(items)
    while batch := list(islice(remaining, _BATCH_PER_CORE * usable_cores())):
        yield map_in_threads(work, batch)


def run_in_shares(work: Callable[[int, int], None]) -> None:
    """``work(share, shares)``, which must release the GIL, for each of as many shares as there are usable cores, in
    threads."""
    shares = usable_cores()
    map_in_threads(lambda share: work(share, shares), range(shares))


def map_slices(
    work: Callable[[slice], _Result], count: int, parts: int | None = None, *, few: int = 0
) -> list[_Result]:
    """``work``, which must release the GIL, on consecutive slices of ``count`` items, in threads; results in order.

    One slice per usable core, or so many ``parts`` if the result depends on where they are cut. For fewer items than
    ``few``, the slices are processed one after the other: they are done before threads have started.
    """
    bounds = np.linspace(0, count, (parts or usable_cores()) + 1).astype(int)
    slices = [slice(*ends) for ends in pairwise(bounds.tolist())]
    return [work(each) for each in slices] if count < few or len(slices) == 1 else map_in_threads(work, slices)


def end_with_parent() -> None:
    """From now on, end this process as soon as the one that began it has ended: if it is killed, it cannot tell."""

    def watch(parent: multiprocessing.process.BaseProcess) -> None:
        parent.join()
        os._exit(1)

    if (parent := multiprocessing.parent_process()) is not None:
        Thread(target=watch, args=(parent,), daemon=True).start()


def pickle_fields(value: object) -> bytes:
    """A value as bytes for a new process, which restores it by ``pickle.loads``. Of frozen values the fields are
    packed, and not what was computed from them: trees and scenes of libraries cannot leave their process."""
    stream = io.BytesIO()
    _Packer(stream, protocol=pickle.HIGHEST_PROTOCOL).dump(value)
    return stream.getvalue()


class _Packer(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, MappingProxyType):
            return _proxy, (dict(value),)
        if is_dataclass(value) and not isinstance(value, type):
            return _unpickle_fields, (type(value), {each.name: getattr(value, each.name) for each in fields(value)})
        return NotImplemented


def _proxy(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


def _unpickle_fields(kind: type, values: dict[str, Any]) -> Any:
    """The value bit for bit, and its arrays read-only as they were: kernels are compiled for such ones."""
    made: Any = object.__new__(kind)
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        object.__setattr__(made, name, value)
    return made
