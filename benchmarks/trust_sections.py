"""Sections of docs/benchmarks.md on damaged input, killed runs and large meshes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from anatomy_sections import mark, markdown_table

Result = Mapping[str, Any]
MOST_GIB = 4.0


def fuzz(result: Result) -> str:
    """Damaged input, by what is done with it."""
    wrong = [case["scenario"] for case in result["wrong"]]
    rows = [
        (name, count, mark(wrong.count(name), 0, 0), f"{result['slowest_s'][name]:.1f}")
        for name, count in result["cases"].items()
    ]
    rows.append(
        ("all", sum(result["cases"].values()), mark(len(wrong), 0, 0), f"{max(result['slowest_s'].values()):.1f}")
    )
    seeds = ", ".join(f"{first} to {last}" for first, last in result["seeds"])
    return "\n".join(
        [
            "Small inputs, damaged by a seed: bytes, lines, numbers and names changed, files cut, emptied, left out or "
            "swapped, and nonsense of formats' own (`tests/fuzzing.py`). Right is success, or one short line and "
            "status 1 or 2. Wrong are tracebacks, more than 10 CPU seconds or 2 GiB, noise of libraries, whatever is "
            "left half-written or outside of `--out`. Bar: 0 of 10,000. "
            f"`OPENBLAS_NUM_THREADS=1 python benchmarks/fuzz.py`, seeds {seeds}.",
            "",
            markdown_table(("what reads them", "cases", "wrong", "slowest, s"), rows),
        ]
    )


def kill(result: Result) -> str:
    """Killed runs."""
    rows = [
        (name, f"{result['undisturbed_s'][name]:.0f}", count, mark(_wrong(result, name), 0, 0))
        for name, count in result["kills"].items()
    ]
    rows.append(("all", "", sum(result["kills"].values()), mark(len(result["wrong"]), 0, 0)))
    return "\n".join(
        [
            "Runs of a small scan and a small film are ended by KILL, TERM and INT at random moments, up to "
            f"three times each, and then finish ({result['runs']} runs). All files must equal those of an undisturbed "
            "run, times and keys of results aside. Bar: 0 of 100. `python benchmarks/kill.py`.",
            "",
            markdown_table(("verb", "undisturbed, s", "kills", "runs that differ"), rows),
        ]
    )


def _wrong(result: Result, verb: str) -> int:
    return sum(run["verb"] == verb for run in result["wrong"])


def large(result: Result) -> str:
    """A mesh of millions of faces."""
    rows = [
        (name, mark(verb["peak_gib"], MOST_GIB), f"{verb['wall_s']:.0f}", f"{verb['cpu_s']:.0f}")
        for name, verb in result["verbs"].items()
    ]
    return "\n".join(
        [
            f"A jaw of {result['faces']:,} faces. `evaluate` lays it on itself, without labels; from `view` a client "
            f"takes all that is shown. Bar: {MOST_GIB:g} GiB. `python benchmarks/large.py`.",
            "",
            markdown_table(("verb", "peak memory, GiB", "wall s", "CPU s"), rows),
        ]
    )
