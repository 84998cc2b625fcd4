"""When the frames of films were taken: a table as CSV, beside the films."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import read_text
from cuspid.runtime.values import number, quote
from cuspid.storage.files import reading

TIMES_FILES = ("times.csv", "timestamps.csv")
"""How it is named where nobody says."""
_COLUMNS: Mapping[str, Sequence[str]] = {
    "camera": ("camera", "cam", "cam_id", "camera_id"),
    "frame": ("frame", "frame_index", "frame_id", "image"),
    "time": ("time", "time_s", "frame_time", "timestamp"),
}
_LONGEST_S = 1e10


def read_frame_times(path: Path, cameras: Sequence[str]) -> dict[str, dict[str, float]]:
    """For each camera the time in s of each of its frames, by what the table calls the frame (a number or a name).

    The table may call a camera by its number: 0 is ``cam_0``. Raises InputError where a column is missing, a camera is
    none of those, a frame stands there twice, or a time is no number.
    """
    found: dict[str, dict[str, float]] = {camera: {} for camera in cameras}
    text = read_text(path)
    with reading(path):
        table = csv.DictReader(io.StringIO(text, newline=""))
        columns = {meaning: _column(table.fieldnames or (), meaning) for meaning in _COLUMNS}
        for line, row in enumerate(table, start=2):
            called, frame, time = ((row[columns[each]] or "").strip() for each in _COLUMNS)
            times = found[_camera(called, cameras)]
            if frame in times:
                raise InputError(f"line {line}: frame {quote(frame)} of {called} is listed twice")
            times[frame] = number(f"line {line}: time", float(time), -_LONGEST_S, _LONGEST_S)
    return found


def _column(names: Sequence[str], meaning: str) -> str:
    fitting = [name for name in names if name and name.strip().lower() in _COLUMNS[meaning]]
    if len(fitting) != 1:
        raise InputError(f"needs one column '{meaning}' (or {', '.join(_COLUMNS[meaning][1:])}); it has {quote(names)}")
    return fitting[0]


def _camera(called: str, cameras: Sequence[str]) -> str:
    ending = re.compile(rf"(.*\D)?0*{re.escape(called)}")
    fitting = [called] if called in cameras else [name for name in cameras if called and ending.fullmatch(name)]
    if len(fitting) != 1:
        raise InputError(f"unknown camera {quote(called)}; the cameras are {', '.join(cameras)}")
    return fitting[0]
