"""Run a grid of cases: each is a call of one function with its own parameters and returns a row of figures.

Every finished case is a file ``cases/<name>.json`` at once, so that a killed study goes on where it stopped. A case
that fails is recorded with its reason and does not stop the others. Locally each case is a process of its own, pinned
to one core; with the address of a Dask scheduler the same calls go to its workers, each thread of them pinned to one
core, too. They need the package and nothing else: what they return is written here.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import sys
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from cuspid import storage
from cuspid.runtime.errors import CuspidError, InputError, MissingDependencyError
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import core_numbers, end_with_parent, keep_to_core, usable_cores

Value = float | int | str | bool | None
"""What a cell of the table holds."""

CLUSTER_TIMEOUT_S = 10
"""How long a scheduler may take to answer."""
WORKER_DEATHS = 2
"""How often a case may lose its worker before it counts as failed."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One point of the grid."""

    name: str
    """Unique in the study, and fit for a file name."""
    parameters: Mapping[str, Value]
    """Arguments of the function; units in the names."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a case."""

    case: Case
    """Which one."""
    figures: Mapping[str, Value]
    """What the function returned, units in the names; empty where it failed."""
    failure: str | None = None
    """Why it failed, one line."""


Work = Callable[..., Mapping[str, Value]]
"""A function of a module that workers can import: takes the parameters of a case by name, returns figures by name, and
raises where the case fails."""


def grid(**axes: Sequence[Value]) -> tuple[Case, ...]:
    """All combinations of the values on the axes, the last axis fastest, named after their values."""
    names = tuple(axes)
    return tuple(
        Case(
            name="_".join(f"{name}-{value}" for name, value in zip(names, values, strict=True)),
            parameters=dict(zip(names, values, strict=True)),
        )
        for values in itertools.product(*axes.values())
    )


def run_grid(
    cases: Sequence[Case],
    work: Work,
    folder: Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    retry_failed: bool = False,
    stage: str = "cases",
    progress: Progress = silent,
) -> tuple[Outcome, ...]:
    """Run the cases that have no result in ``folder`` yet and return all outcomes, in the order of the cases.

    ``workers`` local processes (default: one for each core), or the workers of the Dask scheduler at ``cluster``.
    ``stage`` is what ``progress`` calls the cases. Writes ``cases/<name>.json`` for each case and the table
    ``results.csv``. Raises InputError for fewer than one worker, where two cases share a name or the cluster cannot be
    reached, MissingDependencyError where Dask is not installed.
    """
    check_workers(workers)
    names = [case.name for case in cases]
    if len(set(names)) < len(names):
        raise InputError(f"study: two cases are called {next(name for name in names if names.count(name) > 1)}")
    done = {case.name: found for case in cases if (found := _read_outcome(folder, case)) is not None}
    if retry_failed:
        done = {name: outcome for name, outcome in done.items() if outcome.failure is None}
    left = [case for case in cases if case.name not in done]
    progress(stage, len(done), len(cases))
    if left:
        outcomes = (
            _run_on_cluster(left, work, cluster)
            if cluster
            else _run_in_processes(left, work, workers or usable_cores())
        )
        for outcome in outcomes:
            done[outcome.case.name] = outcome
            _write(folder, outcome)
            progress(stage, len(done), len(cases))
    ordered = tuple(done[case.name] for case in cases)
    storage.write_bytes(folder / "results.csv", table(ordered).encode())
    return ordered


def check_workers(workers: int | None, verb: str = "study") -> None:
    """Raise InputError where a number of workers is given that is less than one."""
    if workers is not None and workers < 1:
        raise InputError(f"{verb}: --workers is {workers}; at least one is needed")


def table(outcomes: Sequence[Outcome]) -> str:
    """The outcomes as CSV: parameters, figures, and the reason where a case failed."""
    heads = [{"case": outcome.case.name, **outcome.case.parameters} for outcome in outcomes]
    columns = dict.fromkeys(name for outcome in outcomes for name in outcome.figures)
    return storage.csv_table(
        [
            {**head, **columns, **outcome.figures, "failure": outcome.failure}
            for head, outcome in zip(heads, outcomes, strict=True)
        ]
    )


def _path(folder: Path, case: Case) -> Path:
    return folder / "cases" / f"{case.name}.json"


def _write(folder: Path, outcome: Outcome) -> None:
    entry = {"parameters": outcome.case.parameters, "figures": outcome.figures, "failure": outcome.failure}
    storage.write_json(_path(folder, outcome.case), entry)


def _read_outcome(folder: Path, case: Case) -> Outcome | None:
    path = _path(folder, case)
    if not path.exists():
        return None
    entry = storage.read_json(path)
    with storage.reading(path):
        if entry["parameters"] != dict(case.parameters):
            raise InputError(f"{path}: made with other parameters; give another --out or delete the folder")
        return Outcome(case=case, figures=entry["figures"], failure=entry["failure"])


def _attempt(work: Work, case: Case) -> Outcome:
    """The outcome of a case, whatever its function raises."""
    try:
        return Outcome(case=case, figures=dict(work(**case.parameters)))
    except CuspidError as error:
        return Outcome(case=case, figures={}, failure=str(error))
    except Exception as error:  # one broken case must not end a study of many hours
        return Outcome(case=case, figures={}, failure=f"{type(error).__name__}: {error}".splitlines()[0])


# --- Local processes -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Running:
    """A case in its process."""

    case: Case
    process: BaseProcess
    answer: Connection
    core: int


def _run_in_processes(cases: Sequence[Case], work: Work, workers: int) -> Iterator[Outcome]:
    """Outcomes as they come, from at most so many processes at once."""
    waiting = list(reversed(cases))
    cores = core_numbers()
    free = [cores[k % len(cores)] for k in range(workers)]
    running: dict[Connection, _Running] = {}
    try:
        while waiting or running:
            while waiting and free:
                started = _start(waiting.pop(), work, free.pop())
                running[started.answer] = started
            for answer in wait(list(running)):
                finished = running.pop(answer)  # type: ignore[call-overload]
                free.append(finished.core)
                yield _collect(finished)
    finally:
        for left in running.values():
            left.process.terminate()


def _start(case: Case, work: Work, core: int) -> _Running:
    context = multiprocessing.get_context("spawn")
    receiving, sending = context.Pipe(duplex=False)
    process = context.Process(target=_work_alone, args=(sending, work, case, core), daemon=False)
    process.start()
    sending.close()
    return _Running(case, process, receiving, core)


def _work_alone(sending: Connection, work: Work, case: Case, core: int) -> None:
    end_with_parent()
    keep_to_core(core)
    sending.send(_attempt(work, case))
    sending.close()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # With the watching thread alive, libraries complain of leaks while Python ends.


def _collect(finished: _Running) -> Outcome:
    try:
        outcome: Outcome = finished.answer.recv()
    except EOFError:
        finished.process.join()
        status = finished.process.exitcode or 0
        reason = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        outcome = Outcome(case=finished.case, figures={}, failure=f"its process {reason} (out of memory?)")
    finished.process.join()
    finished.answer.close()
    return outcome


# --- Dask ----------------------------------------------------------------------------------------------------------


def _run_on_cluster(cases: Sequence[Case], work: Work, address: str) -> Iterator[Outcome]:
    """Outcomes as they come from the workers of a Dask scheduler."""
    try:
        import distributed
    except ImportError as error:
        raise MissingDependencyError("--cluster needs Dask: pip install 'cuspid[cluster]'") from error
    try:
        client = distributed.Client(address, timeout=CLUSTER_TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(f"--cluster {address}: no Dask scheduler answers there ({type(error).__name__})") from error
    with client, client.as_current():
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise InputError(
                f"--cluster {address}: the scheduler has no workers; start some with: dask worker {address}"
            )
        slots = _slots(client.scheduler_info(n_workers=-1)["workers"])
        submit = partial(client.submit, _attempt_on_worker, work, slots=slots, pure=False, retries=WORKER_DEATHS)
        futures = {submit(case, key=f"cuspid-{uuid.uuid4().hex}"): case for case in cases}
        for future in distributed.as_completed(list(futures)):
            if future.status == "finished":
                yield future.result()
            else:
                yield Outcome(case=futures[future], figures={}, failure=_failure(future, address))


def _failure(future: Any, address: str) -> str:
    """Why there is no outcome, in one line; a future without an exception went down with its scheduler."""
    error = future.exception() if future.status == "error" else None
    if error is None:
        return f"the Dask scheduler at {address} was lost; start it again and give --retry-failed"
    return f"{type(error).__name__}: {error}".splitlines()[0]


def _slots(workers: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """For each worker, by address: how many threads the workers before it have on the same host."""
    used: dict[str, int] = {}
    slots = {}
    for address, worker in workers.items():
        slots[address] = used.get(worker["host"], 0)
        used[worker["host"]] = slots[address] + int(worker["nthreads"])
    return slots


_threads: dict[int, int] = {}
"""Of this worker: the number of each thread that has had a case."""


def _attempt_on_worker(work: Work, case: Case, slots: Mapping[str, int]) -> Outcome:
    """As :func:`_attempt`, with one core for this thread of a worker.

    A worker is a daemon, which may have no children: a pipeline that found more cores would try to start some.
    """
    import distributed

    cores = core_numbers(os.getpid())
    number = _threads.setdefault(threading.get_ident(), len(_threads))
    keep_to_core(cores[(slots.get(distributed.get_worker().address, 0) + number) % len(cores)])
    return _attempt(work, case)
