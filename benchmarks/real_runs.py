"""Runs of ``cuspid reconstruct`` on real photographs, as a user meets them, and the records that are kept of them."""

from __future__ import annotations

import json
import re
import shutil
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from real_sets import Set, offered

from cuspid.storage import read_json, write_json
from cuspid_thesis.scan_cases import commit, run_program

TIMED_OUT = 124
_WARNING = re.compile(rb"^.*\.py:\d+: \w*Warning: .*$", re.MULTILINE)


def run(each: Set, data: Path, folder: Path, timeout_s: float) -> dict[str, Any]:
    """Reconstruct a set into ``folder/out``, with the log and the record of the run beside it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    given, out, log = offered(each, data, folder / "given"), folder / "out", folder / "log.txt"
    command = [sys.executable, "-m", "cuspid", "reconstruct", str(given), "--out", str(out), *each.arguments]
    with log.open("wb") as stream:
        status, took = run_program("timeout", "-k", "20", str(timeout_s), *command, log=stream)
    said = log.read_bytes()
    for where in (given, out, data.resolve(), folder.resolve()):  # no result tells of the machine's folders
        said = said.replace(str(where).encode(), where.name.encode())
    record = {**told(status, said), **took, "timeout_s": timeout_s, "commit": commit(), "set": asdict(each)}
    write_json(folder / "run.json", record)
    return record


def told(status: int, log: bytes) -> dict[str, Any]:
    """What a run said: how it ended, and in its last line why."""
    lines = [line.strip() for line in log.decode(errors="replace").splitlines() if line.strip()]
    timed_out, traceback = status == TIMED_OUT, b"Traceback (most recent call last)" in log
    return {
        "status": "timed out" if timed_out else "traceback" if traceback else "refused" if status else "done",
        "exit_code": status,
        "traceback": traceback,
        "warnings": len(_WARNING.findall(log)),
        "last_line": "" if not lines else _last(lines),
    }


def _last(lines: list[str]) -> str:
    """The last message of the program, whole where it was wrapped over some lines."""
    begin = next((k for k in reversed(range(len(lines))) if lines[k].startswith("cuspid: ")), len(lines) - 1)
    return " ".join(lines[begin:])[:400]


def kept(record: Path, each: Set) -> dict[str, Any] | None:
    """What was recorded of an earlier run, if the set was the same then."""
    found = read_json(record) if record.exists() else None
    same = found is not None and found.get("set") == json.loads(json.dumps(asdict(each)))
    return found if same else None
