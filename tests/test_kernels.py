"""Compiled code on disk is never another's."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cuspid.kernels import CheckedFile


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


def test_a_kernel_is_compiled_again_when_one_that_it_calls_has_changed(tmp_path: Path) -> None:
    (tmp_path / "outer.py").write_text(
        "from cuspid.kernels import kernel\nfrom inner import grown\n\n"
        "@kernel\ndef twice(x):\n    return 2 * grown(x)\n"
    )

    def run(by: int) -> str:
        inner = tmp_path / "inner.py"
        inner.write_text(f"from cuspid.kernels import kernel\n\n@kernel\ndef grown(x):\n    return x + {by}\n")
        os.utime(inner, (by, by))
        shown = [sys.executable, "-c", "from outer import twice; print(twice(3), twice.stats.cache_hits)"]
        environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
        return subprocess.run(shown, capture_output=True, text=True, check=True, env=environment).stdout.strip()

    assert run(1).startswith("8 Counter()")
    assert run(1).startswith("8 Counter({")
    assert run(2).startswith("10 Counter()")
