"""Tooth labels of a file in FDI numbers: which numbering they use is inferred from where the labelled teeth stand.

A numbering says at which position each label stands: -1, -2 ... from the midline backwards on the patient's right, and
1, 2 ... on the left. How far along the arch from the midline each position lies is known from the widths of teeth. A
numbering fits if the teeth stand where it says; one that is a tooth off misses by the width of a tooth.

Numberings: FDI; Universal; 1-14 or 1-16 along the arch, from either end; halves, 1-7 and 8-14 or 1-8 and 9-16, each
from the midline backwards or towards it; Palmer's 1-8 from the midline backwards, each on both sides.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from cuspid.model.jaw import ARCHES, FDI_FROM_UNIVERSAL, GUM, Arch
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError

Numbering = Literal["auto", "fdi", "universal", "along-arch"]
"""What the labels of a file may be said to be."""
_WIDTHS_MM: Mapping[Arch, tuple[float, ...]] = {
    "lower": (5.3, 5.8, 6.9, 7.1, 7.2, 11.2, 10.6, 10.2),
    "upper": (8.6, 6.7, 7.7, 7.1, 6.8, 10.2, 9.7, 8.9),
}
"""Of the teeth along the arch, from the midline backwards (Wheeler)."""
_FITS_MM = 4.5
"""Mean distance of the teeth from where a numbering says that they stand: half the width of a tooth, and more where
neighbours of a missing tooth have moved."""
_DOUBTFUL_MM = 6.5
"""FDI and Universal numbers are taken as such up to here, unless another numbering fits better."""
_BETTER = 0.6
"""One numbering fits better than another one if it misses by less than this share."""
_WHOLE = 10
"""Fewer teeth do not tell where the midline is."""
_BOTH_SIDES = 0.25
"""Share of the surface of a label on each side of the midline that makes it a label of two teeth."""
Positions = Mapping[int, int]
"""Position of each label: -1 ... -8 on the patient's right, 1 ... 8 on the left."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Numbered:
    """Labels in FDI numbers."""

    labels: Int[np.ndarray, "f"]
    """Of each face, 0 for gum."""
    notes: tuple[str, ...] = ()
    """How labels were understood that are not FDI or Universal numbers."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Reading:
    """Labels read in one numbering."""

    name: str
    arch: Arch
    positions: Positions
    misfit_mm: float

    def fdi(self) -> dict[int, int]:
        """The FDI number of each label."""
        right, left = (1, 2) if self.arch == "upper" else (4, 3)
        return {label: 10 * (right if at < 0 else left) + abs(at) for label, at in self.positions.items()}

    def __str__(self) -> str:
        return f"{self.name} of the {self.arch} jaw"


def number_teeth(
    source: str,
    labels: Int[np.ndarray, "f"],
    mesh: Mesh,
    *,
    arch: Arch | None = None,
    sure: bool = True,
    numbering: Numbering = "auto",
    label_map: Mapping[int, int] | None = None,
) -> Numbered:
    """FDI numbers for the labels of a mesh in its occlusal frame.

    ``sure``: whether the frame is that of a whole arch; otherwise the numbers alone decide. ``arch``: where it is known
    from elsewhere than the labels. ``numbering`` and ``label_map`` (label to FDI) overrule the inference. ``source``
    names the file. Raises InputError where the labels are in no numbering that is known, or contradict where the teeth
    stand, or the arch; the message names the numbering that fits.
    """
    values = _values(labels)
    if not values:
        return Numbered(labels=labels)
    if label_map is not None:
        return Numbered(labels=_map_labels(labels, _complete(source, label_map, values)))
    if numbering in ("fdi", "universal"):
        return _read_by_numbers(source, labels, values, numbering, arch)
    plain = _guess_numbering(values) if numbering == "auto" else None
    teeth = _Teeth(labels, mesh) if sure else None
    if teeth is not None and len(teeth.labels) >= _WHOLE:
        return _read_in_place(source, labels, teeth, plain, arch, numbering)
    if numbering == "along-arch":
        raise InputError(f"{source}: labels along the arch are only understood on a whole arch; give --label-map")
    return _read_by_numbers(source, labels, values, plain, arch)


def _values(labels: Int[np.ndarray, "f"]) -> tuple[int, ...]:
    return tuple(int(value) for value in np.unique(labels) if value != GUM)


def _map_labels(labels: Int[np.ndarray, "f"], table: Mapping[int, int]) -> Int[np.ndarray, "f"]:
    """Labels by a table; what it does not know is gum."""
    known, place = np.unique(labels, return_inverse=True)
    return np.array([table.get(int(value), GUM) for value in known], dtype=np.int64)[place.reshape(-1)]


def _complete(source: str, label_map: Mapping[int, int], values: tuple[int, ...]) -> Mapping[int, int]:
    absent = [value for value in values if value not in label_map]
    if absent:
        raise InputError(f"{source}: --label-map does not say what label {absent[0]} is; give its FDI number, or 0")
    return label_map


def _guess_numbering(values: tuple[int, ...]) -> Literal["fdi", "universal"] | None:
    found, fdi = set(values), set(FDI_FROM_UNIVERSAL.values())
    if found <= fdi and (found & set(range(33, 49)) or not found & {9, 10, 19, 20, 29, 30}):
        return "fdi"
    return "universal" if found <= set(FDI_FROM_UNIVERSAL) else None


def _read_by_numbers(
    source: str, labels: Int[np.ndarray, "f"], values: tuple[int, ...], numbering: str | None, arch: Arch | None
) -> Numbered:
    """Labels as the numbers say; the teeth may not stand against the arch that is given."""
    table = FDI_FROM_UNIVERSAL if numbering == "universal" else {fdi: fdi for fdi in FDI_FROM_UNIVERSAL.values()}
    if numbering is None or not set(values) <= set(table):
        what = "neither FDI nor Universal" if numbering is None else f"not {_NAMES[numbering]}"
        raise InputError(
            f"{source}: tooth labels {_abbreviate(values)} are {what} numbers; give --label-map, a JSON file of each "
            "label and its FDI number"
        )
    labelled_arch = _arch_of(table[value] for value in values)
    if arch is not None and labelled_arch is not None and labelled_arch != arch:
        raise InputError(
            f"{source}: its labels {_abbreviate(values)}, read as {_NAMES[numbering]} numbers, are {labelled_arch} "
            f"teeth, but its name or --arch says {arch}; give the right --arch or --labels, or --label-map"
        )
    return Numbered(labels=_map_labels(labels, table))


_NAMES = {"fdi": "FDI", "universal": "Universal", "along-arch": "along-the-arch"}


def _abbreviate(values: tuple[int, ...]) -> str:
    """Labels in few words: ``1-14``, or the first of them."""
    runs: list[list[int]] = []
    for value in values:
        if runs and value == runs[-1][1] + 1:
            runs[-1][1] = value
        else:
            runs.append([value, value])
    ranges = [str(a) if a == b else f"{a}-{b}" for a, b in runs]
    return ", ".join(ranges[:5]) + (" ..." if len(ranges) > 5 else "")


def _arch_of(fdi: Iterator[int]) -> Arch | None:
    """The arch of FDI numbers; None where they are of both."""
    lower = {each >= 30 for each in fdi}
    return None if len(lower) != 1 else "lower" if lower.pop() else "upper"


class _Teeth:
    """Where labelled teeth stand: along the arch from the midline, positive towards +X."""

    def __init__(self, labels: Int[np.ndarray, "f"], mesh: Mesh) -> None:
        owners = labels
        self.values = _values(labels)
        self.sides = np.ones(len(labels), dtype=np.int64)
        self.paired = self._are_paired(labels, mesh)
        """Whether labels occur on both sides, as in Palmer's notation."""
        if self.paired:
            first = labels == min(self.values)
            middle = float(np.average(mesh.face_centres[first, 0], weights=mesh.face_areas[first] + 1e-12))
            self.sides = np.where(mesh.face_centres[:, 0] < middle, -1, 1)
            owners = labels * self.sides
        areas = {int(each): float(mesh.face_areas[owners == each].sum()) for each in np.unique(owners) if each != GUM}
        least = 0.1 * float(np.median(list(areas.values())))
        self.labels = tuple(each for each, area in areas.items() if area > least)
        """Of each tooth that is more than specks; of paired ones, negative on the side of -X."""
        self.along_mm = _arch_lengths(np.array([mesh.centroid(owners == each)[:2] for each in self.labels]))

    def _are_paired(self, labels: Int[np.ndarray, "f"], mesh: Mesh) -> bool:
        if not 4 <= len(self.values) <= 8 or not set(self.values) <= set(range(1, 9)):
            return False
        right = mesh.face_centres[:, 0] < 0
        areas = [
            (mesh.face_areas[faces & right].sum(), mesh.face_areas[faces].sum())
            for faces in (labels == value for value in self.values)
        ]
        both = [_BOTH_SIDES * whole < part < (1 - _BOTH_SIDES) * whole for part, whole in areas]
        return float(np.mean(both)) > 0.7

    def misfit_mm(self, positions: Positions, arch: Arch) -> float:
        """Mean distance along the arch of the teeth from where a numbering says that they stand; infinite if it does
        not know a label."""
        if not set(self.labels) <= set(positions):
            return float("inf")
        leftwards = self.along_mm if arch == "upper" else -self.along_mm
        expected = np.array([_expected_mm(positions[label], arch) for label in self.labels])
        scale = np.clip(float(leftwards @ expected) / float(expected @ expected), 0.75, 1.3)
        return float(np.abs(leftwards - scale * expected).mean())


def _arch_lengths(places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Length along the chain of teeth from where it crosses the midline x = 0, positive towards +X, mm."""
    around = np.arctan2(places[:, 0], places[:, 1] - places[:, 1].min() + 1.0)
    order = np.argsort(around)
    chain = places[order]
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))])
    crossings = [
        float(lengths[k] + (lengths[k + 1] - lengths[k]) * a / (a - b))
        for k, (a, b) in enumerate(pairwise(chain[:, 0]))
        if a < 0 <= b
    ]
    along = np.empty(len(places))
    along[order] = lengths - (
        min(crossings, key=lambda at: abs(at - lengths[-1] / 2)) if crossings else lengths[-1] / 2
    )
    return along


def _expected_mm(position: int, arch: Arch) -> float:
    """Where a position usually lies along the arch from the midline, positive on the patient's left."""
    widths = _WIDTHS_MM[arch]
    return float(np.sign(position)) * (sum(widths[: abs(position) - 1]) + widths[abs(position) - 1] / 2)


def _read_in_place(
    source: str,
    labels: Int[np.ndarray, "f"],
    teeth: _Teeth,
    plain: str | None,
    arch: Arch | None,
    numbering: Numbering,
) -> Numbered:
    """Labels in the numbering by which the teeth stand where they do."""
    found = [
        _Reading(name=name, arch=of, positions=positions, misfit_mm=teeth.misfit_mm(positions, of))
        for of in ARCHES
        for name, positions in _numberings(teeth, of)
    ]
    found = sorted((each for each in found if np.isfinite(each.misfit_mm)), key=lambda each: each.misfit_mm)
    if not found and numbering == "auto" and plain is not None:  # teeth of both jaws
        return _read_by_numbers(source, labels, teeth.values, plain, arch)
    others = [each for each in found if each.misfit_mm < _FITS_MM and each.name not in ("FDI", "Universal")]
    plainly = next((each for each in found if each.name == _NAMES.get(plain or "")), None)
    if plainly is not None and numbering == "auto" and plainly.misfit_mm < _DOUBTFUL_MM:
        if arch in (None, plainly.arch) and not any(_is_better(each, plainly) for each in others):
            return Numbered(labels=_map_labels(labels, plainly.fdi()))
        fitting = [each for each in others if each.arch == arch]
        against = arch not in (None, plainly.arch) and plainly.misfit_mm < _FITS_MM
        if against and not any(_is_better(each, plainly) for each in fitting):
            raise InputError(f"{source}: {_arch_conflict(teeth.values, plainly, arch, others)}")
    best = _unambiguous_reading([each for each in others if each.arch == arch])
    if best is None:
        raise InputError(f"{source}: {_complaint(teeth.values, plain, arch, others)}")
    return _numbered_with_note(_map_labels(labels * teeth.sides, best.fdi()), best)


def _is_better(one: _Reading, other: _Reading) -> bool:
    return one.misfit_mm < _BETTER * other.misfit_mm


def _unambiguous_reading(readings: list[_Reading]) -> _Reading | None:
    """The reading of which no other one, with other numbers, fits about as well; None where there is none."""
    first = min(readings, key=lambda each: each.misfit_mm, default=None)
    if first is None or any(each.fdi() != first.fdi() and not _is_better(first, each) for each in readings):
        return None
    return first


def _numbered_with_note(labels: Int[np.ndarray, "f"], reading: _Reading) -> Numbered:
    present = set(_values(labels))
    fdi = [each for _, each in sorted(reading.fdi().items()) if each in present]
    note = f"labels: read as {reading} (FDI {fdi[0]} to {fdi[-1]}), as the teeth stand; --label-map overrides this"
    return Numbered(labels=labels, notes=(note,))


def _arch_conflict(values: tuple[int, ...], plainly: _Reading, arch: Arch | None, others: list[_Reading]) -> str:
    """What is said of teeth that stand where their numbers say, in the other jaw."""
    along = ", or --labels along-arch" if any(each.arch == arch for each in others) else ""
    return (
        f"its labels {_abbreviate(values)} are {plainly.name} numbers of {plainly.arch} teeth and stand as those do, "
        f"but its name or --arch says {arch}; give --arch {plainly.arch}{along}"
    )


def _complaint(values: tuple[int, ...], plain: str | None, arch: Arch | None, others: list[_Reading]) -> str:
    """What is said of labels that are not understood."""
    what = f"tooth labels {_abbreviate(values)}"
    if plain is None:
        what += " are not understood"
    else:
        what += f" are no {_NAMES[plain]} numbers, as its teeth do not stand where those{_teeth_of_arch(arch)} do"
    fitting = [each for each in others if arch in (None, each.arch)]
    if not fitting:
        return f"{what}, and no other numbering fits; is the mesh mirrored? Give --label-map, or --labels to insist"
    if arch is None:
        return f"{what}; {fitting[0].name.partition(' from the patient')[0]} fits: give --arch lower or upper"
    return f"{what}; {' or '.join(map(str, fitting[:3]))} fit about as well: give --label-map"


def _teeth_of_arch(arch: Arch | None) -> str:
    return "" if arch is None else f" of {'an' if arch == 'upper' else 'a'} {arch} jaw"


def _numberings(teeth: _Teeth, arch: Arch) -> Iterator[tuple[str, Positions]]:
    """Each numbering of an arch with the positions of its labels."""
    right = range(-8, 0)
    if teeth.paired:
        leftwards = 1 if arch == "upper" else -1
        yield "Palmer's numbers", {side * n: side * n * leftwards for n in range(1, 9) for side in (-1, 1)}
        return
    fdi = {fdi: _position(fdi) for fdi in FDI_FROM_UNIVERSAL.values() if (fdi >= 30) == (arch == "lower")}
    yield "FDI", fdi
    yield "Universal", {number: fdi[tooth] for number, tooth in FDI_FROM_UNIVERSAL.items() if tooth in fdi}
    for half in (7, 8):
        row = [*right[-half:], *range(1, half + 1)]
        for first, side in (("right", 1), ("left", -1)):
            numbers = f"1-{2 * half}"
            yield f"{numbers} along the arch from the patient's {first}", _positions(side * at for at in row)
            backwards = [*(-n for n in range(1, half + 1)), *range(1, half + 1)]
            yield (
                f"{numbers} from the midline backwards, {first} side first",
                _positions(side * at for at in backwards),
            )
            towards = [*row[:half], *reversed(row[half:])]
            yield f"{numbers} towards the midline, {first} side first", _positions(side * at for at in towards)


def _position(fdi: int) -> int:
    return (-1 if fdi // 10 in (1, 4) else 1) * (fdi % 10)


def _positions(positions: Iterator[int]) -> dict[int, int]:
    return dict(enumerate(positions, start=1))
