"""Kill runs at random moments, let the same command go on, and compare what it leaves with an undisturbed run.

    python benchmarks/kill.py [--kills 100] [--seed 0] [--only stitch] [--work build/kill] [--add]

Signals are KILL, TERM and INT, each once at most, sent to the program alone before it may finish. Files must be equal
byte for byte, but for the times that a stage took, when a workbook was written, and the keys of what was kept. Writes
benchmarks/results/kill.json after each run; ``--add`` goes on with it.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
from run import conditions

from cuspid.storage import read_json, write_json

HERE = Path(__file__).parent
CUSPID = (sys.executable, "-m", "cuspid")
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
SCAN = ("--tooth", "46", "--frames", "6", "--length-mm", "3", "--supersampling", "1")
KEYS = {"made.jsonl"}
"""Files of nothing but the keys of results."""


def verbs(work: Path) -> dict[str, tuple[str, ...]]:
    """What is killed, without ``--out``."""
    probe = ("--handpiece", str(work / "probe" / "handpiece.json"))
    jaw = str(work / "jaw.ply")
    return {
        "run": ("run", jaw, *probe, *SCAN),
        "reconstruct": ("reconstruct", str(work / "scan" / "capture")),
        "stitch": ("pano", "stitch", str(work / "film" / "capture" / "images" / "camera")),
        "repeat": ("study", "repeat", jaw, *probe, *SCAN, "--scans", "2", "--workers", "1"),
    }


def cuspid(*arguments: str) -> None:
    """Run a verb to its end."""
    subprocess.run([*CUSPID, *arguments], check=True, capture_output=True)


def prepare(work: Path) -> None:
    """What the verbs take: a handpiece with small images, a jaw, a scan, a film."""
    cuspid("rig", "build", "--design", "four", "--width-px", "160", "--height-px", "160", "--out", str(work / "probe"))
    jaw, probe = str(work / "jaw.ply"), str(work / "probe" / "handpiece.json")
    cuspid("jaw", "phantom", "--edge-mm", "0.5", "--out", jaw)
    cuspid("simulate", jaw, "--handpiece", probe, *SCAN, "--out", str(work / "scan"))
    camera = ("--camera.width-px", "320", "--camera.height-px", "240")
    cuspid(
        "pano",
        "film",
        jaw,
        *camera,
        "--frames",
        "40",
        "--shake",
        "0.3",
        "--texture",
        "artificial",
        "--out",
        str(work / "film"),
    )


def killed(arguments: tuple[str, ...], how: signal.Signals, after_s: float) -> bool:
    """Whether a run was still going when its time came."""
    begun = subprocess.Popen([*CUSPID, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        begun.wait(after_s)
        return False
    except subprocess.TimeoutExpired:
        begun.send_signal(how)
        begun.wait(60)
        return True


def differences(one: Path, other: Path) -> list[str]:
    """Files that only one folder has or that differ, times and keys aside."""
    names = {path.relative_to(root) for root in (one, other) for path in root.rglob("*") if path.is_file()}
    unlike = (name for name in sorted(names) if name.name not in KEYS and "cache" not in name.parts)
    return [str(name) for name in unlike if not _same(one / name, other / name)]


def _same(one: Path, other: Path) -> bool:
    if one.name.startswith(".part-") or other.name.startswith(".part-"):
        return True  # what a killed run left, which nothing reads
    if not (one.is_file() and other.is_file()):
        return False
    if one.suffix == ".json":
        return bool(_without_times(json.loads(one.read_text())) == _without_times(json.loads(other.read_text())))
    if one.suffix == ".csv":
        return _rows(one) == _rows(other)
    if one.suffix == ".xlsx":  # which tells when it was written
        return _cells(one) == _cells(other)
    if one.suffix == ".html":
        return True  # a page of what is compared itself, with the times
    return one.read_bytes() == other.read_bytes()


def _rows(path: Path) -> list[Any]:
    with path.open(newline="") as stream:
        return [_without_times(row) for row in csv.DictReader(stream)]


def _cells(path: Path) -> dict[str, list[tuple[Any, ...]]]:
    return {sheet.title: list(sheet.values) for sheet in openpyxl.load_workbook(path)}


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_times(each) for key, each in value.items() if not key.endswith(("_s", "seconds"))}
    return [_without_times(each) for each in value] if isinstance(value, list) else value


def main() -> None:
    """Kill the verbs in turns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--work", type=Path, default=Path("build/kill"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "kill.json")
    parser.add_argument("--add", action="store_true", help="go on with the runs that the file holds")
    arguments = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have it passed over in the background
    work = arguments.work.resolve()
    shutil.rmtree(work, ignore_errors=True)
    prepare(work)
    (work / "whole").mkdir()
    whole: dict[str, float] = {}
    chosen = {name: command for name, command in verbs(work).items() if arguments.only in name}
    for name, command in chosen.items():
        begin = time.perf_counter()
        cuspid(*command, "--out", str(work / "killed"))  # tables tell where meshes lie
        whole[name] = time.perf_counter() - begin
        (work / "killed").rename(work / "whole" / name)
        print(f"{name}: {whole[name]:.0f} s undisturbed", flush=True)
    found: dict[str, Any] = {"kills": dict.fromkeys(chosen, 0), "runs": 0, "wrong": []}
    if arguments.add:
        found = read_json(arguments.out)
    if found.get("commit", conditions()["commit"]) != conditions()["commit"]:
        raise SystemExit(f"the runs so far are of commit {found['commit']}: run all anew")
    while sum(found["kills"].values()) < arguments.kills:
        name = list(chosen)[found["runs"] % len(chosen)]
        rng = np.random.default_rng([arguments.seed, found["runs"]])
        sent = kill_and_finish(chosen[name], work / "killed", whole[name], rng)
        unlike = differences(work / "whole" / name, work / "killed")
        found["kills"][name] += len(sent)
        found["runs"] += 1
        print(f"{sum(found['kills'].values())} kills: {name} {sent}", flush=True)
        if unlike:
            found["wrong"].append({"verb": name, "sent": sent, "unlike": unlike[:10]})
            print(f"  wrong: {unlike[:5]}", flush=True)
        write_json(arguments.out, {**found, "undisturbed_s": whole, **conditions()})
    print(f"{sum(found['kills'].values())} kills in {found['runs']} runs, {len(found['wrong'])} wrong")


def kill_and_finish(
    command: tuple[str, ...], out: Path, whole_s: float, rng: np.random.Generator
) -> list[tuple[str, float]]:
    """Kill a run once to three times and let it finish; what was sent when. A run that then fails leaves no folder."""
    shutil.rmtree(out, ignore_errors=True)
    command, sent = (*command, "--out", str(out)), []
    for how in rng.permutation(np.array(SIGNALS))[: int(rng.integers(1, 4))]:
        after_s = float(rng.uniform(0.2, whole_s))
        if killed(command, signal.Signals(how), after_s):
            sent.append((signal.Signals(how).name, round(after_s, 2)))
    ended = subprocess.run([*CUSPID, *command], capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        print(ended.stderr[-500:], flush=True)
        shutil.rmtree(out, ignore_errors=True)
    return sent


if __name__ == "__main__":
    main()
