"""The command line as a process: how it ends when it is told to, and what a terminal gets to see."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from verbs import refused, run

CUSPID = (sys.executable, "-m", "cuspid")


@pytest.mark.long
@pytest.mark.parametrize(
    ("how", "after_s"), [(signal.SIGINT, 0.5), (signal.SIGINT, 1.2), (signal.SIGTERM, 2.0), (signal.SIGTERM, 6.0)]
)
def test_it_ends_at_once_and_without_a_trace_of_where_it_was(tmp_path: Path, how: signal.Signals, after_s: float):
    """While it loads, and while libraries work that have handlers of their own."""
    begun = subprocess.Popen(
        [*CUSPID, "simulate", "--out", str(tmp_path / "scan")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # also where the tests run in the background
    )
    try:
        time.sleep(after_s)
        begun.send_signal(how)
        said = begun.communicate(timeout=60)[0].decode()
    finally:
        begun.kill()
    assert begun.returncode in (-how, 130)
    assert not any(word in said for word in ("Traceback", "***", "@     0x", 'File "'))


@pytest.mark.long
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_run_that_was_killed_while_it_rendered_goes_on_at_once(
    tmp_path: Path, phantom_file: Path, how: signal.Signals
) -> None:
    """The processes that rendered for it end with it, and leave the folder to the next."""
    run("rig", "build", "--design", "four", "--width-px", 160, "--height-px", 160, "--out", tmp_path / "probe")
    scan = ("--handpiece", tmp_path / "probe" / "handpiece.json", "--tooth", "46", "--frames", "30")
    command = [*CUSPID, "simulate", phantom_file, *scan, "--out", tmp_path / "scan"]
    begun = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    while begun.poll() is None and not any(tmp_path.glob("scan/capture/images/*/*.png")):
        time.sleep(0.02)
    begun.send_signal(how)
    assert begun.wait(60) != 0
    again = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert again.returncode == 0, again.stderr
    assert len(list(tmp_path.glob("scan/capture/images/*/*.png"))) == 120


@pytest.mark.long
def test_an_interrupt_that_is_passed_over_stays_so(tmp_path: Path) -> None:
    """As a shell has it for what runs in the background."""
    begun = subprocess.Popen(
        [*CUSPID, "rig", "optics", "--out", str(tmp_path / "optics.csv")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    time.sleep(0.7)
    begun.send_signal(signal.SIGINT)
    assert begun.wait(60) == 0


@pytest.mark.long
def test_whoever_reads_it_may_stop_reading():
    """As ``cuspid run --help | head -1`` does."""
    reader, writer = os.pipe()
    os.close(reader)
    begun = subprocess.run([*CUSPID, "run", "--help"], stdout=writer, stderr=subprocess.PIPE, timeout=120)
    os.close(writer)
    assert begun.returncode == 1
    assert begun.stderr == b""


@pytest.mark.parametrize("name", ["a\nb.stl", "\x1b[31mred.stl", "[/bold].stl", os.fsdecode(b"\xff.stl")])
def test_a_name_of_a_file_steers_no_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str):
    line = refused(capsys, "evaluate", tmp_path / name, tmp_path / name, "--out", tmp_path / "out", alone=True)
    assert line.isprintable()
    assert line.endswith(".stl: no such file")
    assert ("[/bold]" in line) == ("[/bold]" in name)


@pytest.mark.parametrize("given", [None, "2"])
def test_linear_algebra_starts_no_threads_unless_it_is_told_to(given: str | None) -> None:
    """Those of the stages use the cores."""
    code = (
        "import sys; from cuspid.__main__ import main; sys.argv = ['cuspid', '--version']\n"
        "try: main()\nexcept SystemExit: pass\n"
        "import numpy as np; np.ones((500, 500)) @ np.ones((500, 500))\n"
        "print(len(__import__('os').listdir('/proc/self/task')))"
    )
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    if given is not None:
        environment["OPENBLAS_NUM_THREADS"] = given
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    alone = given is None or len(os.sched_getaffinity(0)) == 1
    assert (int(ended.stdout.split()[-1]) == 1) == alone


def test_out_may_not_be_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "out").write_text("mine")
    assert "is a file" in refused(capsys, "simulate", "--tooth", "46", "--out", tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"
