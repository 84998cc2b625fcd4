"""Length units of mesh files, which no mesh file states: sizes reveal them, most of all where two files meet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.runtime.workers import computed_once

Unit = Literal["mm", "cm", "m", "in", "um"]
MM_PER_UNIT: Mapping[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "um": 0.001}
"""Length units that a mesh file may be in."""

_SURFACE_MM = (3.0, 300.0)
"""Smallest and largest extent of what is scanned: a part of a tooth, a head. A jaw in inches is smaller."""
_FARTHEST_MM = 1000.0
"""Largest extent of two surfaces that agree in size."""
_USUAL_MM = 60.0
"""Of a jaw."""
_ALIKE = 1.04
"""Extents of one object in two files differ by less."""
_APART = 3.0
"""Larger ratios of two surfaces that belong together are those of a tooth and a jaw."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredFile:
    """A mesh file and the unit in which it was read."""

    path: Path
    mesh: Mesh
    """In mm, if the unit is right."""
    unit: Unit
    option: str = "--unit"
    """Which option gives the unit."""

    @computed_once
    def extents_mm(self) -> Float[np.ndarray, "3"]:
        """Of the surface along its own axes, the largest first, mm; the same in any pose."""
        mesh = self.mesh
        weights = mesh.face_areas / max(mesh.face_areas.max(), 1e-300)
        weights = weights / weights.sum()
        size = max(float(np.ptp(mesh.bounds, axis=0).max()), 1e-300)
        centred = (mesh.face_centres - weights @ mesh.face_centres) / size
        axes = np.linalg.eigh(centred.T @ (weights[:, None] * centred))[1]
        return np.sort(np.ptp((mesh.vertices - mesh.bounds[0]) @ axes, axis=0))[::-1]

    @property
    def width_mm(self) -> float:
        """The largest extent, mm."""
        return float(self.extents_mm[0])

    def width_in(self, unit: str) -> float:
        """The largest extent if the file were in another unit, mm."""
        return self.width_mm / MM_PER_UNIT[self.unit] * MM_PER_UNIT[unit]

    def unit_nearest(self, width_mm: float) -> str:
        """The unit in which it would be most nearly so large."""
        return min(MM_PER_UNIT, key=lambda unit: abs(np.log(max(self.width_in(unit), 1e-300) / width_mm)))


def require_size(file: MeasuredFile) -> None:
    """Raise InputError where a surface is too small or too large to have been scanned, naming the unit that it seems to
    be in."""
    if not _SURFACE_MM[0] <= file.width_mm <= _FARTHEST_MM:
        raise InputError(f"{_describe_unit(file)}, which is not the size of teeth or jaws; {_advice(file, _USUAL_MM)}")


def require_one_unit(scan: MeasuredFile, reference: MeasuredFile) -> None:
    """Raise InputError where the sizes of two surfaces to be compared show that one or both are in another unit; it
    names which, and the likely unit."""
    wrong = _in_another_unit(scan, reference)
    if wrong is None:
        return
    other = reference if wrong is scan else scan
    sound = _SURFACE_MM[0] <= other.width_mm <= _SURFACE_MM[1]
    sizes = f"{_describe_unit(wrong)}, {other.path} {other.width_mm:.3g} mm ({other.option} {other.unit})"
    raise InputError(f"{sizes}: their sizes do not match; {_advice(wrong, other.width_mm if sound else _USUAL_MM)}")


def _in_another_unit(scan: MeasuredFile, reference: MeasuredFile) -> MeasuredFile | None:
    """The one of two surfaces, the less likely one, that is in another unit; None where they may be in one."""
    ratios = scan.extents_mm / np.maximum(reference.extents_mm, 1e-300)
    least_usual = max(scan, reference, key=lambda file: abs(np.log(max(file.width_mm, 1e-300) / _USUAL_MM)))
    if 1 / _APART < ratios[0] < _APART:
        return None if _SURFACE_MM[0] <= scan.width_mm <= _FARTHEST_MM else least_usual
    if any(np.all(np.abs(np.log(ratios / each)) < np.log(_ALIKE)) for each in _ratios_of_units()):
        return least_usual
    beyond = [each for each in (scan, reference) if not _SURFACE_MM[0] <= each.width_mm <= _SURFACE_MM[1]]
    return least_usual if beyond else None


def _ratios_of_units() -> Iterable[float]:
    return (one / other for one in MM_PER_UNIT.values() for other in MM_PER_UNIT.values() if one != other)


def _describe_unit(file: MeasuredFile) -> str:
    return f"{file.path}: the mesh is {file.width_mm:.3g} mm wide ({file.option} {file.unit})"


def _advice(file: MeasuredFile, like_mm: float) -> str:
    unit = file.unit_nearest(like_mm)
    width_mm = file.width_in(unit)
    if unit == file.unit or not like_mm / 9 < width_mm < like_mm * 9:
        return "scale it to millimetres"
    return f"in {unit} it would be {width_mm:.3g} mm: give {file.option} {unit}"
