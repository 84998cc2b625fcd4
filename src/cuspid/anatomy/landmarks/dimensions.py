"""The dimensions a, b, c and f of a dental arch, from its landmarks, and tables of them over groups of jaws.

Definitions (thesis 2.2, figure 2.2), all as three-dimensional distances, as callipers take them:

    a  cusp tip of one canine to that of the other
    b  buccal groove of one first molar, where it crosses the occlusal rim, to that of the other
    c  the same for the second molars
    f  incisive (lower jaw: lingual) papilla to the middle of the line of c

A lower first molar has two buccal grooves; the mesial one counts. Without second molars there is no c and no f; the
same length to the middle of the line of b has a name of its own, ``f_first``, so that the two are never mixed.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby
from types import MappingProxyType

import numpy as np

from cuspid.anatomy.landmarks.scheme import teeth_named
from cuspid.model.jaw import Arch, Jaw, Landmark
from cuspid.runtime.errors import CuspidError, InputError, OutputError

DIMENSIONS = ("a", "b", "c", "f", "f_first")
"""Names of the dimensions, in the order of tables."""
_SIDES: Mapping[Arch, tuple[int, int]] = MappingProxyType({"lower": (40, 30), "upper": (10, 20)})
"""FDI numbers of the right and left quadrant, before the tooth's place is added."""


@dataclass(frozen=True, kw_only=True)
class Dimension:
    """A length with its uncertainty."""

    value_mm: float
    """The length."""
    sigma_mm: float | None = None
    """Standard uncertainty from that of the landmarks; None where all of them are known or were placed by hand."""


@dataclass(frozen=True, kw_only=True)
class ArchDimensions:
    """The dimensions of one arch; None where a landmark is missing."""

    a: Dimension | None = None
    """Between the canines' cusp tips."""
    b: Dimension | None = None
    """Between the buccal grooves of the first molars."""
    c: Dimension | None = None
    """Between the buccal grooves of the second molars."""
    f: Dimension | None = None
    """Papilla to the middle of the line of c."""
    f_first: Dimension | None = None
    """Papilla to the middle of the line of b; not in the thesis."""
    notes: tuple[str, ...] = ()
    """Which landmarks are missing for which dimension."""

    def __getitem__(self, name: str) -> Dimension | None:
        """A dimension by its name in `DIMENSIONS`."""
        value: Dimension | None = getattr(self, name)
        return value


@dataclass(frozen=True, kw_only=True)
class MeasuredJaw:
    """One row of a survey."""

    name: str
    """File or other name."""
    group: str
    """Arch and number of teeth, as ``Lower-14``."""
    dimensions: ArchDimensions
    """What was measured."""
    estimated: int
    """How many of its landmarks were estimated from the surface."""
    notes: tuple[str, ...] = ()
    """What is unsure about the jaw itself."""


@dataclass(frozen=True, kw_only=True)
class GroupStatistics:
    """A dimension over the jaws of a group that have it."""

    count: int
    """Number of jaws."""
    mean_mm: float
    """Mean."""
    std_mm: float | None
    """Standard deviation with n - 1; None for a single jaw."""


@dataclass(frozen=True, kw_only=True)
class Survey:
    """The jaws of a folder, measured."""

    jaws: tuple[MeasuredJaw, ...]
    """Each jaw that could be measured."""
    groups: Mapping[str, Mapping[str, GroupStatistics]]
    """By group and dimension, in the form of table 2.1; a dimension that no jaw of the group has is absent."""
    failures: Mapping[str, str]
    """By name, why a jaw could not be measured."""


PRINTED_TABLE: Mapping[str, Mapping[str, tuple[float, float]]] = MappingProxyType(
    {
        "Lower-14": {"a": (26.77, 1.99), "b": (51.19, 1.32), "c": (55.90, 2.78), "f": (51.23, 1.28)},
        "Upper-14": {"a": (34.46, 2.52), "b": (55.36, 1.89), "c": (59.09, 2.67), "f": (55.37, 1.90)},
        "Lower-12": {"a": (28.17, 1.70), "b": (45.42, 1.61), "c": (53.63, 2.57), "f": (45.40, 1.63)},
        "Upper-12": {"a": (33.19, 2.92), "b": (46.06, 3.16), "c": (51.69, 7.74), "f": (46.00, 3.17)},
    }
)
"""Table 2.1 of the thesis as printed, mean and SD in mm. Its column f repeats b to 0.06 mm: do not trust it."""


def needed_landmarks(arch: Arch) -> Mapping[str, tuple[str, ...]]:
    """Labels of the landmarks that each dimension is made of."""
    right, left = _SIDES[arch]

    def pair(place: int, point: str) -> tuple[str, str]:
        return f"{right + place}.{point}", f"{left + place}.{point}"

    first, second = pair(6, "buccal_groove"), pair(7, "buccal_groove")
    return {
        "a": pair(3, "cusp_tip"),
        "b": first,
        "c": second,
        "f": ("papilla", *second),
        "f_first": ("papilla", *first),
    }


def arch_dimensions(landmarks: Mapping[str, Landmark], arch: Arch) -> ArchDimensions:
    """The dimensions of an arch; the notes name each landmark that one of them lacks."""
    needed = needed_landmarks(arch)
    lacking = {name: [label for label in labels if label not in landmarks] for name, labels in needed.items()}
    values = {
        name: _length([landmarks[label] for label in labels]) for name, labels in needed.items() if not lacking[name]
    }
    notes = tuple(f"{name}: no landmark {', '.join(labels)}" for name, labels in lacking.items() if labels)
    return ArchDimensions(**values, notes=notes)


def _length(points: list[Landmark]) -> Dimension:
    """Distance between two points, or from the first of three to the middle of the others."""
    weights = np.array([1.0, -1.0] if len(points) == 2 else [1.0, -0.5, -0.5])
    difference = weights @ np.array([point.position for point in points])
    sigmas = [point.estimated_sigma_mm for point in points]
    known = all(sigma is None for sigma in sigmas)
    # Errors along the line, the same along each axis and independent from point to point.
    sigma = None if known else float(np.linalg.norm(weights * [value or 0.0 for value in sigmas]))
    return Dimension(value_mm=float(np.linalg.norm(difference)), sigma_mm=sigma)


def arch_of(jaw: Jaw) -> Arch:
    """Upper or lower, as the jaw says or its tooth numbers do. Raises InputError where neither tells."""
    if jaw.arch is not None:
        return jaw.arch
    lower = {fdi >= 30 for fdi in _teeth(jaw)}
    if len(lower) != 1:
        raise InputError("jaw: the tooth numbers do not show whether it is upper or lower; give --arch")
    return "lower" if lower.pop() else "upper"


def _teeth(jaw: Jaw) -> tuple[int, ...]:
    return jaw.teeth or teeth_named(jaw.landmarks)


def group_of(jaw: Jaw) -> str:
    """Arch and number of teeth, as the rows of table 2.1 are named: ``Lower-14``."""
    return f"{arch_of(jaw).capitalize()}-{len(_teeth(jaw))}"


def measure(name: str, jaw: Jaw, notes: tuple[str, ...] = ()) -> MeasuredJaw:
    """The dimensions of a jaw by its landmarks. Raises InputError where none of them can be measured."""
    arch = arch_of(jaw)
    dimensions = arch_dimensions(jaw.landmarks, arch)
    if all(dimensions[dimension] is None for dimension in DIMENSIONS):
        raise InputError(f"{name}: no dimension can be measured ({'; '.join(dimensions.notes)})")
    estimated = sum(point.estimated_sigma_mm is not None for point in jaw.landmarks.values())
    return MeasuredJaw(name=name, group=group_of(jaw), dimensions=dimensions, estimated=estimated, notes=notes)


def survey(jaws: Mapping[str, Callable[[], tuple[Jaw, tuple[str, ...]]]]) -> Survey:
    """Measure jaws that are loaded one after the other, each with notes on it.

    A jaw that cannot be loaded or measured is listed with the reason and does not stop the others. Raises InputError
    where none can, OutputError where something cannot be written.
    """
    measured, failures = [], {}
    for name, load in jaws.items():
        try:
            measured.append(measure(name, *load()))
        except OutputError:
            raise
        except CuspidError as error:
            failures[name] = str(error)
    if not measured:
        first, reason = next(iter(failures.items()))
        raise InputError(f"none of the {len(failures)} jaws can be measured; {first}: {reason}")
    return Survey(jaws=tuple(measured), groups=group_statistics(measured), failures=failures)


def group_statistics(jaws: Iterable[MeasuredJaw]) -> dict[str, dict[str, GroupStatistics]]:
    """Mean, SD and number of jaws for each group and dimension."""
    ordered = sorted(jaws, key=lambda jaw: jaw.group)
    return {group: _statistics(list(members)) for group, members in groupby(ordered, key=lambda jaw: jaw.group)}


def _statistics(jaws: list[MeasuredJaw]) -> dict[str, GroupStatistics]:
    table = {}
    for name in DIMENSIONS:
        values = [found.value_mm for jaw in jaws if (found := jaw.dimensions[name]) is not None]
        if values:
            spread = float(np.std(values, ddof=1)) if len(values) > 1 else None
            table[name] = GroupStatistics(count=len(values), mean_mm=float(np.mean(values)), std_mm=spread)
    return table


def jaw_rows(found: Survey) -> list[dict[str, object]]:
    """One flat row for each jaw, as a table with units in the names of its columns; the failures come last."""
    rows = [_jaw_row(jaw) for jaw in found.jaws]
    empty = dict.fromkeys(_jaw_columns())
    failed = [{**empty, "jaw": name, "notes": f"not measured: {why}"} for name, why in found.failures.items()]
    return rows + failed


def _jaw_columns() -> tuple[str, ...]:
    lengths = (f"{name}_{kind}" for name in DIMENSIONS for kind in ("mm", "sigma_mm"))
    return ("jaw", "group", *lengths, "estimated_landmarks", "notes")


def _jaw_row(jaw: MeasuredJaw) -> dict[str, object]:
    row: dict[str, object] = dict.fromkeys(_jaw_columns())
    row |= {"jaw": jaw.name, "group": jaw.group, "estimated_landmarks": jaw.estimated}
    row["notes"] = "; ".join((*jaw.notes, *jaw.dimensions.notes))
    for name in DIMENSIONS:
        if (found := jaw.dimensions[name]) is not None:
            row |= {f"{name}_mm": found.value_mm, f"{name}_sigma_mm": found.sigma_mm}
    return row


def group_rows(found: Survey) -> list[dict[str, object]]:
    """One flat row for each group, as table 2.1, with units in the names of the columns."""
    rows = []
    for group, table in found.groups.items():
        row: dict[str, object] = {"group": group, "jaws": sum(jaw.group == group for jaw in found.jaws)}
        for name in DIMENSIONS:
            cell = table.get(name)
            row |= {
                f"{name}_mean_mm": cell and cell.mean_mm,
                f"{name}_sd_mm": cell and cell.std_mm,
                f"{name}_n": cell.count if cell else 0,
            }
        rows.append(row)
    return rows


def implausible(jaw: MeasuredJaw, limit_sd: float = 3.0) -> tuple[str, ...]:
    """Which of a, b, c lie farther than ``limit_sd`` SD from the mean of the jaw's group in table 2.1.

    A group that the table lacks is compared with the group of fourteen teeth of its arch. Column f is not used.
    """
    table = PRINTED_TABLE.get(jaw.group) or PRINTED_TABLE[f"{jaw.group.split('-')[0]}-14"]
    flags = []
    for name in ("a", "b", "c"):
        found, (mean, spread) = jaw.dimensions[name], table[name]
        if found is not None and abs(found.value_mm - mean) > limit_sd * spread:
            flags.append(f"{name} = {found.value_mm:.1f} mm, {(found.value_mm - mean) / spread:+.1f} SD from {mean} mm")
    return tuple(flags)
