"""Figures of a study of scanners, for its page and for a paper: PNG at 300 dpi, and PDF with text that stays text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from cuspid.model.mesh import Mesh
from cuspid.report.figures.drawing import (
    FigureOptions,
    deviation_colors,
    deviation_map,
    fitting_range_um,
    new_figure,
    render,
    save_figure,
)
from cuspid.storage import SpecimenView

_INK, _SOFT = "#333333", "#8795a3"
_COLORS = ("#0b6e78", "#d9480f", "#5f3dc4", "#2b8a3e", "#c2255c", "#1971c2", "#e67700", "#495057")
"""Of scanners, in their order; they stay apart for most who do not see all colours."""
_DPI = 300
_FEW_SPANS = 100
"""Fewer distances are drawn larger."""
_MOST_MAPS = 144
_TRUENESS = {
    "mean_abs_um": "trueness: mean |d| / µm",
    "signed_mean_um": "trueness: signed mean / µm",
    "from_mean_rms_um": "precision: RMS from the mean scan / µm",
    "spans_rms_um": "trueness: distances, RMS / µm",
}
_MODES = {"scale_ppm": "scale / ppm", "spread_um": "spread / µm", "lift_um": "lift / µm", "twist_um": "twist / µm"}

Rows = Sequence[Mapping[str, Any]]


def save_study_figures(folder: Path, scans: Rows, spans: Rows, agreements: Rows, views: Sequence[SpecimenView]) -> None:
    """Write all figures that the rows and views allow into a folder, each as PNG and PDF."""
    for name, figure in (
        ("trueness", boxes(scans, _TRUENESS)),
        ("modes", boxes(scans, _MODES)),
        ("spans", errors_against_span(spans)),
        ("agreement", limits_of_agreement(agreements)),
        ("means", maps(views, means=True)),
        ("maps", maps(views, means=False)),
    ):
        for suffix in (".png", ".pdf"):
            (folder / f"{name}{suffix}").unlink(missing_ok=True)
            if figure is not None:
                with matplotlib.rc_context({"pdf.fonttype": 42}):
                    save_figure(figure, folder / f"{name}{suffix}")


def color_of(names: Sequence[str], name: str) -> str:
    """The colour of a scanner."""
    return _COLORS[list(names).index(name) % len(_COLORS)]


def _names(rows: Rows) -> list[str]:
    return list(dict.fromkeys(str(row["scanner"]) for row in rows))


# --- boxes ------------------------------------------------------------------------------------------------------------


def boxes(scans: Rows, figures: Mapping[str, str]) -> Figure | None:
    """Box plots of figures by scanner, with a point for each scan; None where none is known."""
    known = {column: label for column, label in figures.items() if any(row.get(column) is not None for row in scans)}
    if not known:
        return None
    names = _names(scans)
    across = min(2 if len(names) > 4 or max(map(len, known.values())) > 24 else 4, len(known))
    down = -(-len(known) // across)
    figure = new_figure(7.2, 0.4 + (2.2 + 0.13 * _longest(names)) * down, dpi=_DPI, layout="constrained")
    for k, (column, label) in enumerate(known.items(), start=1):
        _draw_boxes(figure.add_subplot(down, across, k), scans, names, column, label)
    return figure


def _longest(names: Sequence[str]) -> float:
    """How much room the names take below an axis, in letters of slanted text."""
    return 0.35 * min(24, max(map(len, names))) if len(names) > 1 else 0.5


def _draw_boxes(axes: Axes, scans: Rows, names: Sequence[str], column: str, label: str) -> None:
    rng = np.random.default_rng(0)
    groups = [
        [row[column] for row in scans if row["scanner"] == name and row.get(column) is not None] for name in names
    ]
    line = {"color": _INK, "linewidth": 0.8}
    axes.boxplot(
        groups,
        widths=0.55,
        showfliers=False,
        boxprops=line,
        whiskerprops=line,
        capprops=line,
        medianprops={"color": _INK, "linewidth": 1.6},
    )
    for k, (name, values) in enumerate(zip(names, groups, strict=True), start=1):
        places = k + rng.uniform(-0.18, 0.18, len(values))
        axes.plot(places, values, "o", color=color_of(names, name), markersize=3, alpha=0.7, markeredgewidth=0)
    axes.set_xticks(range(1, len(names) + 1), [_short(name) for name in names], rotation=35, ha="right")
    axes.set_title(label, fontsize=7.5, loc="left", color=_INK)
    if min(min(group, default=0) for group in groups) >= 0:
        axes.set_ylim(0, 1.06 * max(max(group, default=0) for group in groups) or 1.0)
    else:
        axes.axhline(0, color=_SOFT, linewidth=0.6)
    _plain(axes)


def _short(name: str) -> str:
    return name if len(name) <= 24 else f"{name[:23]}…"


def _plain(axes: Axes) -> None:
    axes.tick_params(labelsize=7, color=_INK, labelcolor=_INK, length=2.5, width=0.6)
    axes.grid(axis="y", color="#e3e8ed", linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_linewidth(0.6)


# --- spans ------------------------------------------------------------------------------------------------------------

_KINDS = {
    "bodies": "scan bodies",
    "spheres": "spheres",
    "landmarks": "landmarks",
    "teeth": "teeth (centroids)",
    "stations": "stations along the arch",
}


def errors_against_span(spans: Rows) -> Figure | None:
    """Error of each distance over its length, a panel for each kind of points; None without any."""
    kinds = [kind for kind in _KINDS if any(row["kind"] == kind for row in spans)]
    if not kinds:
        return None
    names = _names(spans)
    figure = new_figure(7.2, 0.3 + 2.7 * len(kinds), dpi=_DPI, layout="constrained")
    for k, kind in enumerate(kinds, start=1):
        axes = figure.add_subplot(len(kinds), 1, k)
        axes.axhline(0, color=_SOFT, linewidth=0.6)
        for name in names:
            _draw_spans(axes, [row for row in spans if (row["kind"], row["scanner"]) == (kind, name)], names, name)
        axes.set_title(f"distances between {_KINDS[kind]}", fontsize=8, loc="left", color=_INK)
        axes.set_xlabel("nominal distance / mm", fontsize=7.5, color=_INK)
        axes.set_ylabel("error / µm", fontsize=7.5, color=_INK)
        axes.set_xlim(left=0)
        _plain(axes)
        axes.legend(fontsize=6.5, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _draw_spans(axes: Axes, rows: Rows, names: Sequence[str], name: str) -> None:
    if not rows:
        return
    nominal, error = (np.array([row[column] for row in rows]) for column in ("nominal_mm", "error_um"))
    slope = float(nominal @ error / (nominal @ nominal))
    color = color_of(names, name)
    size, alpha = (3.0, 0.7) if len(rows) < _FEW_SPANS else (1.8, 0.35)
    axes.plot(
        nominal, error, "o", color=color, markersize=size, alpha=alpha, markeredgewidth=0, rasterized=len(rows) > 4000
    )
    ends = np.array([0.0, nominal.max()])
    axes.plot(ends, slope * ends, color=color, linewidth=1.2, label=f"{_short(name)}: {1000 * slope:+.0f} ppm")


# --- two methods ------------------------------------------------------------------------------------------------------


def limits_of_agreement(agreements: Rows) -> Figure | None:
    """A Bland-Altman plot for each pair of scanners; None without any."""
    if not agreements:
        return None
    across = min(2, len(agreements))
    down = -(-len(agreements) // across)
    figure = new_figure(7.2, 0.2 + 2.6 * down, dpi=_DPI, layout="constrained")
    for k, found in enumerate(agreements, start=1):
        axes = figure.add_subplot(down, across, k)
        axes.plot(
            found["means_um"],
            found["differences_um"],
            "o",
            color=_COLORS[0],
            markersize=2.5,
            alpha=0.6,
            markeredgewidth=0,
        )
        for name, style in (("bias", "-"), ("lower", "--"), ("upper", "--")):
            each = found[name]
            axes.axhspan(each["low"], each["high"], color=_SOFT, alpha=0.18, linewidth=0)
            axes.axhline(each["value"], color=_INK, linewidth=0.9, linestyle=style)
        axes.set_title(f"{_short(found['first'])} − {_short(found['second'])}", fontsize=8, loc="left", color=_INK)
        axes.set_xlabel("mean error of both / µm", fontsize=7.5, color=_INK)
        axes.set_ylabel("difference / µm", fontsize=7.5, color=_INK)
        _plain(axes)
    return figure


# --- maps -------------------------------------------------------------------------------------------------------------


def common_range_um(views: Sequence[SpecimenView]) -> float:
    """One range of colours for all maps."""
    p95 = [
        np.nanpercentile(np.abs(field), 95)
        for view in views
        for field in view.frames.values()
        if np.isfinite(field).any()
    ]
    return fitting_range_um(float(np.median(p95))) if p95 else 100.0


def maps(views: Sequence[SpecimenView], *, means: bool) -> Figure | None:
    """Deviations of all scans, or of the mean of each scanner, from the occlusal side on one scale."""
    chosen = [
        (view, name, field)
        for view in views
        for k, (name, field) in enumerate(view.frames.items())
        if (k < view.means) == means
    ][:_MOST_MAPS]
    if not chosen:
        return None
    options = _options(common_range_um(views))
    # A row for each specimen, where the means have room in it.
    across = min(len(chosen), (views[0].means if 2 <= views[0].means <= 4 else 3) if means else 6)
    down = -(-len(chosen) // across)
    width_in = 7.2
    side_in = width_in / across
    figure = new_figure(width_in, 0.7 + (0.9 * side_in + 0.24) * down, dpi=_DPI)
    top = 1 - 0.05 / figure.get_figheight()
    step = (top - 0.62 / figure.get_figheight()) / down
    for k, (view, name, field) in enumerate(chosen):
        row, column = divmod(k, across)
        axes = figure.add_axes((column / across, top - (row + 1) * step, 0.97 / across, step * 0.84))
        axes.imshow(_picture(view.mesh, field, options, round(_DPI * side_in)))
        axes.set_axis_off()
        title = name.removeprefix("mean of ") if means else name
        label = f"{_short(title)}\n{_short(view.name)}" if len(views) > 1 else _short(title)
        axes.set_title(label, fontsize=7 if means else 5, color=_INK, pad=1.5)
    _draw_bar(figure, options)
    return figure


def _options(range_um: float) -> FigureOptions:
    return FigureOptions(range_um=range_um, tolerance_um=range_um / 4)


def _picture(
    mesh: Mesh, field: Float[np.ndarray, "v"], options: FigureOptions, width_px: int
) -> UInt8[np.ndarray, "h w 3"]:
    colored = Mesh(mesh.vertices, mesh.faces, deviation_colors(field, options))
    return render(colored, width_px=width_px, supersampling=1).image


def _draw_bar(figure: Figure, options: FigureOptions) -> None:
    high = figure.get_figheight()
    scale = ScalarMappable(Normalize(-options.range_um, options.range_um), deviation_map(options))
    bar = figure.colorbar(scale, cax=figure.add_axes((0.2, 0.42 / high, 0.6, 0.1 / high)), orientation="horizontal")
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=7, color=_INK, labelcolor=_INK, length=2)
    bar.set_label("deviation from the reference / µm (positive: outside; grey: not shown)", fontsize=7.5, color=_INK)
