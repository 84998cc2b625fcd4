"""Compiled code on disk is never another's, and kernels are arrays in, arrays out."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

import cuspid
from cuspid.runtime.kernels import CheckedFile


def cache_file(folder: Path, stamp: str = "source") -> CheckedFile:
    return CheckedFile(cache_path=str(folder), filename_base="f", source_stamp=stamp)


def test_code_comes_back_under_its_key(tmp_path: Path) -> None:
    cache_file(tmp_path).save("whole", "code for whole numbers")
    cache_file(tmp_path).save("real", "code for reals")
    assert cache_file(tmp_path).load("whole") == "code for whole numbers"
    assert cache_file(tmp_path).load("real") == "code for reals"
    assert cache_file(tmp_path).load("text") is None


def test_two_processes_that_compile_at_once_never_load_each_others_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both find the first number free: the index is of the one, the file of the other."""
    first, second = cache_file(tmp_path), cache_file(tmp_path)
    write = first._save_data

    def late(name: str, data: object) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(second, "_load_index", dict)
            second.save("real", "code for reals")
        write(name, data)

    monkeypatch.setattr(first, "_save_data", late)
    first.save("whole", "code for whole numbers")
    assert cache_file(tmp_path).load("real") is None
    assert cache_file(tmp_path).load("whole") is None


def test_code_of_older_sources_does_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the writing of an index and that of a file, the file is an older one."""
    cache_file(tmp_path, "old").save("whole", "old code")
    new = cache_file(tmp_path, "new")
    monkeypatch.setattr(new, "_save_data", lambda name, data: None)
    new.save("whole", "new code")
    assert cache_file(tmp_path, "new").load("whole") is None


@pytest.mark.long
def test_a_kernel_is_compiled_again_when_one_that_it_calls_has_changed(tmp_path: Path) -> None:
    (tmp_path / "outer.py").write_text(
        "from cuspid.runtime.kernels import kernel\nfrom inner import grown\n\n"
        "@kernel\ndef twice(x):\n    return 2 * grown(x)\n"
    )

    def run(by: int) -> str:
        inner = tmp_path / "inner.py"
        inner.write_text(f"from cuspid.runtime.kernels import kernel\n\n@kernel\ndef grown(x):\n    return x + {by}\n")
        os.utime(inner, (by, by))
        shown = [sys.executable, "-c", "from outer import twice; print(twice(3), twice.stats.cache_hits)"]
        environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
        return subprocess.run(shown, capture_output=True, text=True, check=True, env=environment).stdout.strip()

    assert run(1).startswith("8 Counter()")
    assert run(1).startswith("8 Counter({")
    assert run(2).startswith("10 Counter()")


SLOW = """
from cuspid.runtime.kernels import kernel

@kernel
def inner(x):
    return x + 1

@kernel
def outer(x):
    total = 0.0
    for k in range(9):
        total += inner(x) ** k
    return total

outer(2.0)
print(sum(outer.stats.cache_misses.values()) + sum(inner.stats.cache_misses.values()))
"""
WRONG = """
from cuspid.runtime.kernels import kernel

@kernel
def wrong(x):
    return x.nothing

for k in (1, 2.0):
    try:
        wrong(k)
    except Exception as error:
        print(type(error).__name__)
"""

FORKED = """
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from cuspid.runtime.kernels import kernel

@kernel
def twice(x):
    return 2 * x

def use(x):
    return twice(x)

if __name__ == "__main__":
    with ProcessPoolExecutor(2, get_context("fork")) as pool:
        print(sum(pool.map(use, range(8))))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system does not fork")
def test_a_forked_process_may_be_the_first_to_use_a_kernel(tmp_path: Path) -> None:
    """As where a film is rendered with optics whose kernels its parent never calls."""
    (tmp_path / "forked.py").write_text(FORKED)
    ended = subprocess.run([sys.executable, tmp_path / "forked.py"], capture_output=True, text=True, timeout=60)
    assert ended.stdout.split() == ["56"], ended.stderr


@pytest.mark.long
def test_processes_that_need_kernels_at_once_compile_them_once(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    running = [
        subprocess.Popen([sys.executable, tmp_path / "slow.py"], stdout=subprocess.PIPE, text=True) for _ in range(4)
    ]
    assert sorted(each.communicate(timeout=60)[0].strip() for each in running) == ["0", "0", "0", "2"]
    assert [each.returncode for each in running] == [0] * 4


def test_a_kernel_that_cannot_be_compiled_leaves_no_lock(tmp_path: Path) -> None:
    (tmp_path / "wrong.py").write_text(WRONG)
    for _ in range(2):
        ended = subprocess.run([sys.executable, tmp_path / "wrong.py"], capture_output=True, text=True, timeout=60)
        assert ended.stdout.split() == ["TypingError", "TypingError"]


def test_numba_is_bounded_by_what_is_tested() -> None:
    """Its cache on disk is extended, which its next version may change: whoever takes that runs these tests with it."""
    root = Path(__file__).parents[2]
    tested = re.search(r"^numba==0\.(\d+)", (root / "constraints.txt").read_text(), re.M)
    bound = re.search(r'"numba>=0\.\d+,<0\.(\d+)"', (root / "pyproject.toml").read_text())
    assert tested is not None
    assert bound is not None
    assert int(bound[1]) == int(tested[1]) + 1


def kernels() -> Iterator[Dispatcher]:
    names = (found.name for found in walk_packages(cuspid.__path__, "cuspid."))
    modules = [import_module(name) for name in names if not name.endswith(("__main__", "blender_script"))]
    return (value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher))


def test_kernels_depend_on_nothing_but_numbers_and_other_kernels() -> None:
    """So that another compiler could take them; and none starts threads, or keeps others waiting."""
    found = {kernel.py_func: kernel for kernel in kernels()}
    assert len(found) > 100
    for function, kernel in found.items():
        used = {name: function.__globals__[name] for name in function.__code__.co_names if name in function.__globals__}
        allowed = (bool, int, float, tuple, np.generic, Dispatcher)
        strange = [name for name, value in used.items() if not (isinstance(value, allowed) or value in (np, math))]
        assert not strange, (function.__module__, function.__qualname__, strange)
        assert function.__closure__ is None
        assert kernel.targetoptions["nogil"]
        assert not kernel.targetoptions.get("parallel")
