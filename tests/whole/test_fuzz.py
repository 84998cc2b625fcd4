"""Damaged input is read or refused in one line: some hundred cases here, thousands in benchmarks/fuzz.py."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from fuzzing import SCENARIOS, Fuzzer, wrong_with

CASES = 10
"""Of each scenario."""
FEWER = {
    **{name: 4 for name in SCENARIOS if name.startswith("report")},
    **dict.fromkeys(("reproduce", "prepare", "calibrate", "record", "units", "boards", "rescale", "study files"), 4),
    **dict.fromkeys(("reconstruct", "evaluate", "measure", "simulate", "precision", "film"), 3),
    **dict.fromkeys(("box", "design", "stitch of a mesh", "stitch-eval", "visibility", "photographs"), 2),
    **dict.fromkeys(("study of scanners", "study by a table", "exchanged cameras", "long names"), 2),
    **dict.fromkeys(("labels", "face directions", "tiny scans", "files of others", "cameras at one place"), 2),
    **{name: 2 for name in SCENARIOS if name.startswith(("terminal", "full", "folder in use"))},
    **dict.fromkeys(("live", "resume", "strange files beside", "mean shape", "stitch"), 1),
}
"""Of those that take longest."""


@pytest.fixture(scope="module")
def fuzzer(tmp_path_factory: pytest.TempPathFactory) -> Fuzzer:
    return Fuzzer(tmp_path_factory.mktemp("fuzz"))


ALONE = {"little memory"}
"""What depends on what the process held before: only benchmarks/fuzz.py runs it."""


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in SCENARIOS if name not in ALONE])
def test_damaged_input_is_read_or_refused_in_one_line(fuzzer: Fuzzer, name: str) -> None:
    """And undamaged input is taken, without which all would be refused at once."""
    wrong = {seed: found for seed in range(FEWER.get(name, CASES)) if (found := fuzzer.case(name, seed))[1] is not None}
    assert not wrong


def test_the_fuzzer_sees_what_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A traceback, a hang, noise, two lines, too much memory."""
    monkeypatch.setattr("fuzzing.LONGEST_S", 0.2)

    def busy() -> None:
        end = time.process_time() + 5
        while time.process_time() < end:
            pass

    def two_lines() -> None:
        raise SystemExit(1)

    def says(text: str):
        import os

        return lambda: os.write(2, text.encode())

    said = tmp_path / "said.txt"
    assert "ZeroDivisionError" in wrong_with(lambda: 1 // 0, said)
    assert "more than" in wrong_with(busy, said)
    assert "noise" in wrong_with(says("libpng error: bad"), said)
    assert "status 1" in wrong_with(two_lines, said)
    assert "MemoryError" in wrong_with(lambda: bytearray(5 << 30), said)
    assert wrong_with(lambda: None, said) is None
