"""Landmark files: JSON of cuspid, and 3D Slicer markups (``.mrk.json``).

Frames. ``occlusal``: that of `cuspid.model.jaw`. ``mesh``: the coordinates of the file that the jaw's mesh is in,
before it is brought into the occlusal frame. Slicer knows patient coordinates, LPS (left, posterior, superior) or RAS
(right, anterior, superior), and reads a mesh file as LPS unless the file says otherwise: LPS is taken for the numbers
in the mesh file, and RAS has the signs of x and y turned.

Only their labels distinguish points; the order of a file means nothing. Labels are checked against the scheme of names
by `cuspid.anatomy.landmarks.scheme.validate`, which knows it. Markups follow Slicer's schema, ``markups-schema-v1.0.3``
(github.com/Slicer/Slicer, Modules/Loadable/Markups/Resources/Schema).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from cuspid.model.jaw import Landmark
from cuspid.runtime.errors import InputError
from cuspid.runtime.values import quote
from cuspid.storage.files import read_json, write_json

LandmarkFrame = Literal["occlusal", "mesh"]
"""What the positions of a landmark file are relative to."""

MARKUPS_SUFFIX = ".mrk.json"
_FORMAT = "cuspid landmarks"
_SCHEMA = (
    "https://raw.githubusercontent.com/Slicer/Slicer/main/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
_FROM_SYSTEM: Mapping[str, tuple[float, float, float]] = MappingProxyType({"LPS": (1, 1, 1), "RAS": (-1, -1, 1)})
_MM_PER: Mapping[str, float] = MappingProxyType({"mm": 1.0, "um": 0.001})
_FARTHEST = 1e9
"""No coordinate is larger, whatever its unit; NaN is none."""
_SIGMA = re.compile(r"sigma (\S+) mm")


@dataclass(frozen=True, eq=False, kw_only=True)
class LandmarkFile:
    """What a landmark file holds."""

    landmarks: Mapping[str, Landmark]
    """By label."""
    frame: LandmarkFrame
    """The frame of their positions."""
    notes: tuple[str, ...] = ()
    """Which entries were passed over, and why."""


def read_landmarks(path: Path) -> LandmarkFile:
    """Landmarks from a file of either kind, by its content.

    Raises InputError that names file and label where a label occurs twice or a position is not three finite numbers,
    and where the file is of neither kind.
    """
    content = read_json(path)
    if isinstance(content, dict) and "markups" in content:
        return _from_markups(content, path)
    if isinstance(content, dict) and content.get("format") == _FORMAT:
        return _from_own(content, path)
    raise InputError(
        f"{path}: not a landmark file; give 3D Slicer markups ({MARKUPS_SUFFIX}) or JSON written by cuspid"
    )


def write_landmarks(path: Path, landmarks: Mapping[str, Landmark], frame: LandmarkFrame) -> None:
    """Write landmarks as 3D Slicer markups where the name ends in ``.mrk.json``, else as JSON of cuspid.

    Markups do not state their frame and are read as ``mesh``: give positions in the frame of the mesh file that they
    are to be shown on.
    """
    write_json(path, _markups(landmarks) if path.name.endswith(MARKUPS_SUFFIX) else _own(landmarks, frame))


def _own(landmarks: Mapping[str, Landmark], frame: LandmarkFrame) -> dict[str, object]:
    # A list, because JSON readers drop all but the last of equal keys without a word.
    points = [
        {"label": label, "position_mm": point.position, "estimated_sigma_mm": point.estimated_sigma_mm}
        for label, point in landmarks.items()
    ]
    return {"format": _FORMAT, "frame": frame, "landmarks": points}


def _from_own(content: Mapping[str, Any], path: Path) -> LandmarkFile:
    frame: LandmarkFrame = _one_of(content.get("frame"), ("occlusal", "mesh"), "frame", path)
    entries = []
    for label, entry in _parse_label(content.get("landmarks"), "landmarks", path):
        position = _position(entry.get("position_mm"), label, path)
        entries.append((label, Landmark(position, _sigma(entry.get("estimated_sigma_mm"), label, path))))
    return LandmarkFile(landmarks=_unique(entries, path), frame=frame)


def _markups(landmarks: Mapping[str, Landmark]) -> dict[str, object]:
    points = [_control_point(str(k), label, point) for k, (label, point) in enumerate(landmarks.items(), start=1)]
    markup = {
        "type": "Fiducial",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "locked": False,
        "labelFormat": "%N-%d",
        "controlPoints": points,
    }
    return {"@schema": _SCHEMA, "markups": [markup]}


def _control_point(number: str, label: str, point: Landmark) -> dict[str, object]:
    sigma = point.estimated_sigma_mm
    return {
        "id": number,
        "label": label,
        "description": "" if sigma is None else f"estimated, sigma {sigma!r} mm",
        "position": point.position,
        "positionStatus": "defined",
    }


def _from_markups(content: Mapping[str, Any], path: Path) -> LandmarkFile:
    entries: list[tuple[str, Landmark]] = []
    notes: list[str] = []
    for markup in _objects(content["markups"], "markups", path):
        if markup.get("type") != "Fiducial":
            notes.append(f"{path}: skipped a markup of type {markup.get('type')}; landmarks must be of type Fiducial")
            continue
        to_mesh_mm = _to_mesh_mm(markup, path)
        for label, point in _parse_label(markup.get("controlPoints", []), "controlPoints", path):
            status = _one_of(
                point.get("positionStatus", "defined"), ("defined", "undefined", "preview"), "positionStatus", path
            )
            if status == "defined":
                position = to_mesh_mm * _position(point.get("position"), label, path)
                entries.append((label, Landmark(position, _described_sigma(point, label, path))))
            else:
                notes.append(f"{path}: skipped landmark '{label}': its position is {status}")
    return LandmarkFile(landmarks=_unique(entries, path), frame="mesh", notes=tuple(notes))


def _to_mesh_mm(markup: Mapping[str, Any], path: Path) -> Float[np.ndarray, "3"]:
    """Factors (3,) from the coordinates of a markup to those of the mesh file, mm."""
    units = markup.get("coordinateUnits", "mm")
    unit = units[0] if isinstance(units, list) and units else units
    system = _one_of(markup.get("coordinateSystem", "LPS"), tuple(_FROM_SYSTEM), "coordinateSystem", path)
    return _MM_PER[_one_of(unit, tuple(_MM_PER), "coordinateUnits", path)] * np.array(_FROM_SYSTEM[system])


def _described_sigma(point: Mapping[str, Any], label: str, path: Path) -> float | None:
    """The uncertainty that :func:`write_landmarks` put into the description."""
    found = _SIGMA.search(str(point.get("description", "")))
    if found is None:
        return None
    try:
        return _sigma(float(found[1]), label, path)
    except ValueError:
        return None


def _objects(value: Any, name: str, path: Path) -> list[Mapping[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise InputError(f"{path}: '{name}' must be a list of objects; see docs/landmarks.md")
    return value


def _parse_label(value: Any, name: str, path: Path) -> Iterable[tuple[str, Mapping[str, Any]]]:
    for number, entry in enumerate(_objects(value, name, path), start=1):
        label = entry.get("label")
        if not isinstance(label, str) or not label:
            raise InputError(f"{path}: entry {number} of '{name}' has no label; give it one, such as 46.buccal_groove")
        yield label, entry


def _one_of(value: Any, allowed: tuple[Any, ...], name: str, path: Path) -> Any:
    if not isinstance(value, str) or value not in allowed:
        raise InputError(f"{path}: '{name}' is {quote(value)}; it must be {' or '.join(allowed)}")
    return value


def _position(value: Any, label: str, path: Path) -> Float[np.ndarray, "3"]:
    if not isinstance(value, list) or len(value) != 3 or not all(_is_finite(number) for number in value):
        raise InputError(f"{path}: the position of landmark '{label}' must be three finite numbers, not {quote(value)}")
    return np.array(value, dtype=np.float64)


def _sigma(value: Any, label: str, path: Path) -> float | None:
    if value is None or (_is_finite(value) and value >= 0):
        return None if value is None else float(value)
    raise InputError(
        f"{path}: estimated_sigma_mm of landmark '{label}' must be a number of at least 0, not {quote(value)}"
    )


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _FARTHEST


def _unique(entries: Iterable[tuple[str, Landmark]], path: Path) -> dict[str, Landmark]:
    landmarks: dict[str, Landmark] = {}
    for label, point in entries:
        if label in landmarks:
            raise InputError(f"{path}: landmark '{label}' occurs more than once; keep one of them")
        landmarks[label] = point
    return landmarks
