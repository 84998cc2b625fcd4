"""Colour scales: what the colours of a surface mean, their range, and their legend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.colors import Colormap

from cuspid.report.figures.drawing import (
    NOT_COUNTED,
    RANGES_UM,
    SIGMA_COLORS,
    FigureOptions,
    deviation_map,
    fitting_sigma_um,
)
from cuspid.report.pages.page import pack_array
from cuspid.report.pages.shown_mesh import UM_PER_STEP

_COLORS = 257
_STOPS = 65


@dataclass(frozen=True, eq=False, kw_only=True)
class ColorScale:
    """What the colours of a surface mean."""

    name: str
    """For the viewer: values of a surface have it, too."""
    label: str
    """On the button that chooses it."""
    meaning: str
    """What is coloured, its unit, and what grey is."""
    colors: Colormap
    """From the lower end to the upper."""
    end: float
    """Value at the upper end."""
    ends: tuple[float, ...]
    """Upper ends that a reader can choose."""
    signed: bool = True
    """The lower end is ``-end``; otherwise 0."""
    unit: str = "µm"
    """Of the values."""
    per_step: float = UM_PER_STEP
    """Values are packed in whole steps of this size."""

    @property
    def reach(self) -> str:
        """What stands before the upper end."""
        return "±" if self.signed else "0 to"

    def rgb(self, values: Float[np.ndarray, "v"], end: float | None = None) -> UInt8[np.ndarray, "v 3"]:
        """sRGB of values, grey for NaN, with this or another upper end."""
        shares = np.nan_to_num(values) / (end or self.end)
        colors = self.colors(0.5 + 0.5 * shares if self.signed else shares, bytes=True)[:, :3]
        return np.where(np.isnan(values)[:, None], NOT_COUNTED, colors)

    @property
    def gradient(self) -> str:
        """The bar as a CSS gradient from left to right."""
        return f"linear-gradient(to right, {', '.join(map(css_color, self._table(_STOPS)))})"

    @property
    def in_scene(self) -> dict[str, Any]:
        """What the viewer needs of it, as plain values for JSON."""
        plain = {name: getattr(self, name) for name in ("name", "end", "signed", "unit", "per_step")}
        return {**plain, "colors": pack_array(self._table(_COLORS))}

    def _table(self, count: int) -> UInt8[np.ndarray, "n 3"]:
        return np.asarray(self.colors(np.linspace(0, 1, count), bytes=True)[:, :3], dtype=np.uint8)


def deviation_scale(end_um: float) -> ColorScale:
    """Colour scale of deviations from a reference: green within a quarter of the range to either side."""
    return ColorScale(
        name="deviation",
        label="Deviation",
        meaning="Deviation from the reference in µm, positive outside. Grey: not evaluated.",
        colors=deviation_map(FigureOptions()),
        end=end_um,
        ends=tuple(sorted({*RANGES_UM, end_um})),
    )


def sigma_scale(sigma_um: Float[np.ndarray, "v"], *, has_scale: bool = True) -> ColorScale:
    """Colour scale of standard deviations, whose range covers most of them; for a scan without a scale, in thousandths
    of its unit."""
    return ColorScale(
        name="sigma",
        label="Expected",
        meaning=f"Expected error along the normal in {small_unit(has_scale)}, one standard deviation. Grey: not known.",
        colors=matplotlib.colormaps[SIGMA_COLORS],
        end=fitting_sigma_um(sigma_um),
        ends=RANGES_UM,
        signed=False,
        unit=small_unit(has_scale),
    )


def small_unit(has_scale: bool) -> str:
    """Unit for small lengths on a surface, as text."""
    return "µm" if has_scale else "thousandths of its unit"


def css_color(rgb: UInt8[np.ndarray, "3"]) -> str:
    """An sRGB colour as CSS knows it."""
    return f"#{bytes(rgb).hex()}"
