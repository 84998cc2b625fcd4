"""What a handpiece is wanted for: a TOML file that an engineer writes, read and checked before anything is computed.

    name = "molar-probe"
    sensor = "thesis"                   # a preset, or a table: preset = "ovm6948", focus_mm = 4.0, or all of `Optics`
    thickness_mm = 7.0                  # of the holder behind the cameras
    working_distance_mm = [4.5, 5.5]
    blur_px = 5.5                       # widest disc that still counts as sharp

    [mouth]
    tooth = 7                           # reached up to its distal end: 1 central incisor ... 7 second molar
    people = 0.95                       # share of people with that much room

    [surfaces]                          # least share that two cameras of a stereo pair must see at once
    occlusal = 0.98
    buccal = 0.95
    lingual = 0.90

    [cameras]
    max = 12

    [motion]
    turns = 1                           # 3, 5 ...: the handpiece is also rolled
    turn_deg = 60.0

    [weights]
    coverage = 1.0
    precision = 1.0
    cameras = 0.3

Only ``sensor``, ``thickness_mm``, ``working_distance_mm`` and ``surfaces`` are needed. The room in the mouth is not
known here: it is handed to the checks in mm.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from cuspid.handpiece.cad.holder import HolderOptions
from cuspid.handpiece.optics import Optics
from cuspid.handpiece.presets import PRESETS
from cuspid.model.body import CAMERA_MM
from cuspid.runtime.errors import InputError
from cuspid.runtime.inputs import read_text
from cuspid.runtime.values import one_line, quote, title

_LARGEST = 1e6
"""No figure is larger; NaN is none."""
_FARTHEST_MM = 15.0
"""End of the depth range where a lens is sharp up to infinity."""


@dataclass(frozen=True, kw_only=True)
class MouthBrief:
    """Whom the handpiece must fit."""

    tooth: int = 7
    """It must reach the distal end of this tooth, counted from the midline."""
    people: float = 0.95
    """Share (0 to 1) of people with enough room there."""
    clearance_mm: float = 1.0
    """A steady handpiece keeps its body this far from teeth and gum; a hand that drifts takes up half."""


@dataclass(frozen=True, kw_only=True)
class CamerasBrief:
    """How many cameras, and how near to each other they can be built."""

    max: int = 12
    """Largest number."""
    spacing_mm: float = 1.2
    """Least distance between two of them."""


@dataclass(frozen=True, kw_only=True)
class MotionBrief:
    """How the handpiece is moved, as in the options of a scan path."""

    turns: int = 1
    """Passes over the teeth; an odd number."""
    turn_deg: float = 60.0
    """Roll of the first and the last pass."""


@dataclass(frozen=True, kw_only=True)
class Weights:
    """What counts beside the conditions; each term is about 1 for a poor design."""

    coverage: float = 1.0
    """Of the share of the wanted surfaces that is not seen, in tenths."""
    precision: float = 1.0
    """Of the mean bound in units of 20 um."""
    cameras: float = 0.3
    """Of the number of cameras, in dozens."""


@dataclass(frozen=True, kw_only=True)
class DesignBrief:
    """Conditions and wishes."""

    name: str = "designed"
    """Of the handpiece."""
    sensor: Optics
    """The camera that is built in, everywhere the same."""
    thickness_mm: float
    """Of the holder behind the cameras' entrance pupils."""
    working_distance_mm: tuple[float, float]
    """Least and largest allowed."""
    surfaces: Mapping[str, float]
    """Least share (0 to 1) of each named surface that must be seen."""
    blur_px: float = 5.5
    """Widest blur disc that counts as sharp."""
    width_mm: float | None = None
    """Largest width of the handpiece across the arch; None: any."""
    mouth: MouthBrief = field(default_factory=MouthBrief)
    cameras: CamerasBrief = field(default_factory=CamerasBrief)
    motion: MotionBrief = field(default_factory=MotionBrief)
    weights: Weights = field(default_factory=Weights)

    def __post_init__(self) -> None:
        low, high = self.working_distance_mm
        _check(0 < low <= high, f"working_distance_mm is {low:g}-{high:g}; it must be positive and in ascending order")
        _check(self.thickness_mm > 0, f"thickness_mm is {self.thickness_mm:g}; it must be positive")
        _check(len(self.surfaces) > 0, "[surfaces] is empty; name at least one that must be seen")
        for surface, share in self.surfaces.items():
            _check(0 < share <= 1, f"the share of surface {quote(surface)} is {share:g}; it must lie between 0 and 1")
        _check(self.cameras.max >= 2, f"cameras.max is {self.cameras.max}; depth needs at least two")
        _check(
            self.cameras.spacing_mm >= self.sensor.sensor_width_mm,
            f"cameras.spacing_mm is {self.cameras.spacing_mm:g}, less than the width of the sensor, "
            f"{self.sensor.sensor_width_mm:.2f} mm",
        )
        _check(1 <= self.mouth.tooth <= 7, f"mouth.tooth is {self.mouth.tooth}; it must be from 1 to 7")
        _check(0 < self.mouth.people < 1, f"mouth.people is {self.mouth.people:g}; it must lie between 0 and 1")
        _check(
            self.motion.turns % 2 == 1 and self.motion.turns > 0,
            f"motion.turns is {self.motion.turns}; it must be positive and odd",
        )
        _check(
            0 < self.motion.turn_deg < 90, f"motion.turn_deg is {self.motion.turn_deg:g}; it must lie between 0 and 90"
        )
        weights = (self.weights.coverage, self.weights.precision, self.weights.cameras)
        _check(min(weights) >= 0, "the weights must not be negative")
        near, far = self.depth_range_mm
        _check(
            near < low and high < far,
            f"the depth of field of {self.sensor.name} ({near:.1f}-{far:.1f} mm at {self.blur_px:g} px blur) does not "
            f"cover the working distance {low:g}-{high:g} mm",
        )

    @property
    def depth_range_mm(self) -> tuple[float, float]:
        """Nearest and farthest distance that is drawn sharply."""
        near, far = self.sensor.depth_of_field_mm(self.blur_px)
        return near, min(far, _FARTHEST_MM)

    @property
    def holder(self) -> HolderOptions:
        """Miniature modules and plates that together have the thickness, half of which the modules take up at most."""
        width, height, depth = CAMERA_MM
        depth = min(depth, self.thickness_mm / 2)
        return HolderOptions(camera_mm=(width, height, depth), wall_mm=self.thickness_mm - depth)

    def check_gap(self, gap_mm: float) -> None:
        """Raise InputError where even the nearest working distance leaves no room between the jaws."""
        needed = self.thickness_mm + self.working_distance_mm[0]
        _check(
            needed <= gap_mm,
            f"thickness {self.thickness_mm:g} mm + working distance {self.working_distance_mm[0]:g} mm is {needed:g} "
            f"mm, more than the gap of {gap_mm:.1f} mm that {self.mouth.people:.0%} of people have at tooth "
            f"{self.mouth.tooth}",
        )


def read_brief(path: Path | str) -> DesignBrief:
    """Read and check a TOML file. Raises InputError with the file and the first condition that fails."""
    text = read_text(Path(path))
    try:
        return parse_brief(tomllib.loads(text))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as TOML: {error}") from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def parse_brief(content: Mapping[str, Any]) -> DesignBrief:
    """A brief from the content of its file; raises InputError for what it does not know or what is missing."""
    _check_keys(content, DesignBrief, "brief")
    values = dict(content)
    values["sensor"] = _sensor(values["sensor"])
    distance = values["working_distance_mm"]
    both = [distance, distance] if isinstance(distance, int | float) else distance
    _check(_are_numbers(both) and len(both) == 2, "working_distance_mm must be a number or [least, largest]")
    values["working_distance_mm"] = (float(both[0]), float(both[1]))
    tables = {"mouth": MouthBrief, "cameras": CamerasBrief, "motion": MotionBrief, "weights": Weights}
    for name, kind in tables.items():
        values[name] = _table(values.get(name, {}), kind, name)
    shares = values["surfaces"]
    _check(
        isinstance(shares, Mapping) and _are_numbers(list(shares.values())),
        "[surfaces] must hold lines like name = share",
    )
    values["surfaces"] = {surface: float(share) for surface, share in shares.items()}
    return DesignBrief(**_convert_types(values, DesignBrief, ""))


def _sensor(given: object) -> Optics:
    """By the name of a preset, or from a table: a preset with changes, or all figures."""
    table = {"preset": given} if isinstance(given, str) else given
    _check(isinstance(table, Mapping), "sensor must be the name of a preset or a table")
    own = dict(table)  # type: ignore[call-overload]
    if "preset" not in own:
        return Optics(**{"name": "own sensor", **_figures(own, complete=True)})
    preset = own.pop("preset")
    _check(preset in PRESETS, f"unknown sensor {quote(preset)}; choose one of {', '.join(PRESETS)}")
    return replace(PRESETS[preset], **_figures(own, complete=False))


def _figures(own: dict[str, Any], *, complete: bool) -> dict[str, Any]:
    known = {each.name for each in fields(Optics)}
    needed = {each.name for each in fields(Optics) if each.default is MISSING} - {"name"} if complete else set()
    _check(not set(own) - known, f"sensor: unknown key {one_line(', '.join(sorted(set(own) - known)))}")
    _check(not needed - set(own), f"sensor: {', '.join(sorted(needed - set(own)))} missing; give them or name a preset")
    return _convert_types(own, Optics, "sensor.")


def _table(given: object, kind: type, name: str) -> Any:
    _check(isinstance(given, Mapping), f"{name} must be a table, [{name}]")
    values = dict(given)  # type: ignore[call-overload]
    _check_keys(values, kind, f"[{name}]")
    return kind(**_convert_types(values, kind, f"{name}."))


def _convert_types(values: Mapping[str, Any], kind: type, where: str) -> dict[str, Any]:
    """Whole numbers where a length may have decimals become such; what is no number where one belongs is refused."""
    typed = dict(values)
    for each in fields(kind):
        if each.name in values and each.type in ("float", "float | None"):
            _check(_are_numbers([values[each.name]]), f"{where}{each.name} must be a number")
            typed[each.name] = float(values[each.name])
        if each.name in values and each.type == "int":
            _check(_is_whole(values[each.name]), f"{where}{each.name} must be a whole number")
        if each.name in values and each.type == "str":
            title(f"brief: {where}{each.name}", values[each.name])
    return typed


def _check_keys(values: Mapping[str, Any], kind: type, where: str) -> None:
    known = {each.name for each in fields(kind)}
    needed = {each.name for each in fields(kind) if each.default is MISSING and each.default_factory is MISSING}
    unknown, missing = sorted(set(values) - known), sorted(needed - set(values))
    _check(not unknown, f"{where}: unknown key {one_line(', '.join(unknown))}; choose from {', '.join(sorted(known))}")
    _check(not missing, f"{where}: {', '.join(missing)} missing")


def _are_numbers(values: object) -> bool:
    return isinstance(values, list) and all(
        isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= _LARGEST for v in values
    )


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _check(good: bool, message: str) -> None:
    if not good:
        raise InputError(f"brief: {message}")
