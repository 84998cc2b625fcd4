"""Pictures of meshes and of their deviations, rendered by Embree rays and framed by matplotlib.

Meshes lie in the occlusal frame (mm). A view is orthographic; its axes are (right, up, towards the eye).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_mixed import MixedModeRenderer
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogFormatter

from cuspid.geometry import read_only
from cuspid.model.mesh import Mesh, RayHits
from cuspid.model.trueness import Trueness
from cuspid.runtime.errors import InputError
from cuspid.runtime.kernels import kernel
from cuspid.runtime.options import Options, Range
from cuspid.storage import whole_file

PLASTER = np.array([222, 214, 200], dtype=np.uint8)
"""Colour of a mesh that has none."""
NOT_COUNTED = np.array([168, 168, 168], dtype=np.uint8)
"""Colour of a vertex without a deviation."""
RANGES_UM = (5.0, 10.0, 25.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
"""Ends of the colour bar from which the reader chooses."""
SIGMA_COLORS = "viridis"
"""Colours of standard deviations from 0 up, by their name in matplotlib."""
_BACK = 0.78
"""Grey of a surface seen from behind."""
_LIGHT = (-0.45, 0.60, 0.66)
"""Where the light is, in the axes of the view."""
_INK = "#333333"


@dataclass(frozen=True, kw_only=True)
class FigureOptions(Options):
    """How deviations are drawn."""

    range_um: Annotated[float, Range(0.01, 1_000_000)] = 100.0
    """Ends of the colour bar; fixed and symmetric, so that pictures can be compared."""
    tolerance_um: Annotated[float, Range(0.001, 1_000_000)] = 25.0
    """Deviations within this, to either side, are green."""
    width_px: Annotated[int, Range(100, 20_000)] = 1000
    """Width of the main view."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.tolerance_um < self.range_um:
            raise InputError(
                f"figure: the tolerance ({self.tolerance_um:g} um) must be positive and below the range "
                f"({self.range_um:g} um)"
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderedMesh:
    """An orthographic picture of a mesh."""

    image: UInt8[np.ndarray, "h w 3"]
    """sRGB, white where nothing is."""
    mm_per_px: float
    """Size of a pixel."""


def deviation_map(options: FigureOptions) -> LinearSegmentedColormap:
    """Colours from -range to +range: blue inside, green within the tolerance, yellow to red outside."""
    t = options.tolerance_um / options.range_um
    stops = [
        (-1.0, "#1b1464"),
        (-(1 + t) / 2, "#1f5fd6"),
        (-t - 0.02 * (1 - t), "#8fdcf2"),
        (-t, "#58b368"),
        (t, "#58b368"),
        (t + 0.02 * (1 - t), "#fff07a"),
        ((1 + t) / 2, "#f58b1f"),
        (1.0, "#a50f15"),
    ]
    return LinearSegmentedColormap.from_list("deviation", [((1 + x) / 2, color) for x, color in stops], N=1024)


def fitting_range_um(p95_um: float) -> float:
    """The smallest range of the colour bar that is at least two and a half times the 95th percentile."""
    return next((each for each in RANGES_UM if each >= 2.5 * p95_um), RANGES_UM[-1])


def fitting_sigma_um(sigma_um: Float[np.ndarray, "v"]) -> float:
    """The smallest end of a colour bar from 0 that holds 95 % of the standard deviations that are known."""
    known = sigma_um[~np.isnan(sigma_um)]
    most = float(np.percentile(known, 95, method="inverted_cdf")) if len(known) else 0.0
    return next((each for each in RANGES_UM if each >= most), RANGES_UM[-1])


def deviation_colors(
    deviation_um: Float[np.ndarray, "v"], options: FigureOptions = FigureOptions()
) -> UInt8[np.ndarray, "v 3"]:
    """sRGB for each signed deviation; grey for NaN."""
    scaled = 0.5 + 0.5 * np.nan_to_num(deviation_um) / options.range_um
    colors = deviation_map(options)(scaled, bytes=True)[:, :3]
    return np.where(np.isnan(deviation_um)[:, None], NOT_COUNTED, colors)


def look(azimuth_deg: float, elevation_deg: float) -> Float[np.ndarray, "3 3"]:
    """Rows (right, up, towards the eye) for an eye at an azimuth from +X towards +Y and an elevation above XY."""
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    towards = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    return np.stack([right, np.cross(towards, right), towards])


OCCLUSAL = look(-90.0, 90.0)
"""From the occlusal side, anterior upwards."""


def render(
    mesh: Mesh, axes: Float[np.ndarray, "3 3"] = OCCLUSAL, *, width_px: int = 1000, supersampling: int = 2
) -> RenderedMesh:
    """A shaded picture of a mesh in its own colours, cropped to it."""
    seen = mesh.vertices @ axes.T
    lower, upper = seen.min(axis=0), seen.max(axis=0)
    margin = 0.02 * (upper - lower)[:2].max()
    width_mm, height_mm = (upper - lower)[:2] + 2 * margin
    step = width_mm / (width_px * supersampling)
    columns, rows = width_px * supersampling, supersampling * int(np.ceil(height_mm / width_mm * width_px))
    x = lower[0] - margin + (np.arange(columns) + 0.5) * step
    y = upper[1] + margin - (np.arange(rows) + 0.5) * step
    across = (x[:, None] * axes[0] + (upper[2] + 1.0) * axes[2]).astype(np.float32)
    eye = (across + (y[:, None, None] * axes[1]).astype(np.float32)).reshape(-1, 3)
    hits = mesh.cast_on_all_cores(eye, np.broadcast_to(-axes[2].astype(np.float32), eye.shape))
    depth = hits.distances.reshape(rows, columns)
    canvas = _shade_hits(mesh, hits, _crevices(depth, step).ravel(), axes).reshape(rows, columns, 3)
    pixels = cv2.resize(canvas, (width_px, rows // supersampling), interpolation=cv2.INTER_AREA)
    return RenderedMesh(
        image=np.rint(255 * np.clip(pixels, 0, 1)).astype(np.uint8), mm_per_px=float(step * supersampling)
    )


def _shade_hits(
    mesh: Mesh, hits: RayHits, crevices: Float[np.ndarray, "n"], axes: Float[np.ndarray, "3 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Colour of each ray under a soft light from the upper left, mild enough to be read off a colour bar; white for a
    miss."""
    colors = np.broadcast_to(PLASTER, mesh.vertices.shape) if mesh.colors is None else mesh.colors
    surface = _Surface(
        faces=read_only(mesh.faces),
        back=mesh.face_cross @ axes[2] < 0,
        normals=(mesh.vertex_normals @ axes.T).astype(np.float32),
        colors=(colors / 255).astype(np.float32),
    )
    canvas = np.ones((len(hits.faces), 3), dtype=np.float32)
    _shade(surface, hits.faces, hits.barycentric, crevices, canvas)
    return canvas


class _Surface(NamedTuple):
    """What is drawn, as arrays for the compiled shading."""

    faces: Int[np.ndarray, "f 3"]
    back: Bool[np.ndarray, "f"]
    normals: Float32[np.ndarray, "v 3"]
    """In the axes of the view."""
    colors: Float32[np.ndarray, "v 3"]
    """From 0 to 1."""


@kernel
@no_type_check
def _shade(surface, faces, weights, crevices, canvas):
    """Paint the rays that meet a face."""
    normal, color = np.zeros(3), np.zeros(3)
    for n in range(len(faces)):
        face = faces[n]
        if face < 0:
            continue
        for i in range(3):
            normal[i], color[i] = 0, 0
            for k in range(3):
                corner = surface.faces[face, k]
                normal[i] += weights[n, k] * surface.normals[corner, i]
                color[i] += weights[n, k] * surface.colors[corner, i]
        scale = 1 / max(np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2), 1e-30)
        if surface.back[face]:
            scale = -scale
            color[:] = _BACK
        key = scale * (_LIGHT[0] * normal[0] + _LIGHT[1] * normal[1] + _LIGHT[2] * normal[2])
        shade = 0.46 + 0.38 * min(max(key, 0.0), 1.0) + 0.22 * min(max(scale * normal[2], 0.0), 1.0)
        for i in range(3):
            canvas[n, i] = color[i] * shade * (1 - crevices[n])


def _crevices(depth_mm: Float[np.ndarray, "h w"], step_mm: float) -> Float[np.ndarray, "h w"]:
    """Darkening where the surface lies deeper than its surroundings (unsharp masking of depth, Luft et al. 2006)."""
    known = np.isfinite(depth_mm)
    depth = np.where(known, depth_mm, 0).astype(np.float32)
    size = (1 + 2 * int(0.8 / step_mm),) * 2
    share, summed = known.astype(np.float32), depth
    for _ in range(2):
        share, summed = cv2.blur(share, size), cv2.blur(summed, size)
    deeper = depth - summed / np.maximum(share, 1e-3)
    return np.asarray(np.where(known, np.clip(0.3 * deeper, 0, 0.35), 0))


def save_picture(path: Path, mesh: Mesh, *, title: str = "", width_px: int = 1000) -> None:
    """PNG of a mesh in its own colours: occlusal, and two oblique views."""
    figure = new_figure(12.0, 6.6, dpi=130)
    _draw_views(figure, mesh, 0.04, width_px=width_px)
    _draw_title(figure, title)
    save_figure(figure, path)


def save_deviation_picture(
    path: Path, scan: Mesh, trueness: Trueness, options: FigureOptions = FigureOptions(), *, title: str = ""
) -> None:
    """PNG of a scan (in its own frame) coloured by its deviation, with the colour bar, histogram and key figures."""
    colors = deviation_colors(trueness.deviation_um, options)
    colored = replace(scan.transformed(trueness.reference_from_scan), colors=colors)
    figure = new_figure(12.0, 8.4, dpi=130)
    _draw_views(figure, colored, 0.30, width_px=options.width_px)
    _draw_histogram(figure, colored.vertex_areas, trueness.deviation_um, options)
    _draw_figures(figure, trueness)
    _draw_title(figure, title)
    save_figure(figure, path)


def save_histogram(path: Path, trueness: Trueness) -> None:
    """PNG of the deviations of the vertices of a scan, and of the key figures, where the scan itself is not at hand."""
    options = FigureOptions()
    figure = new_figure(12.0, 8.4, dpi=130)
    _draw_histogram(figure, np.ones(len(trueness.deviation_um)), trueness.deviation_um, options)
    _draw_figures(figure, trueness)
    with whole_file(path) as temporary:
        figure.savefig(temporary, bbox_inches="tight")


def save_expected_picture(path: Path, mesh: Mesh, sigma_um: Float[np.ndarray, "v"], *, width_px: int = 1000) -> None:
    """PNG of a mesh (in its own frame) coloured by the standard deviation of each vertex, with the colour bar."""
    colours = ScalarMappable(Normalize(0, fitting_sigma_um(sigma_um)), SIGMA_COLORS)
    figure = new_figure(12.0, 7.2, dpi=130)
    colored = replace(mesh, colors=colours.to_rgba(sigma_um, bytes=True)[:, :3])
    _draw_views(figure, colored, 0.18, width_px=width_px)
    bar = figure.colorbar(colours, cax=figure.add_axes((0.06, 0.115, 0.50, 0.028)), orientation="horizontal")
    bar.ax.tick_params(labelsize=11, color=_INK, labelcolor=_INK)
    bar.outline.set_visible(False)
    bar.set_label("expected deviation along the normal / µm (one standard deviation)", fontsize=12, color=_INK)
    _draw_title(figure, "Expected deviation of the scan")
    save_figure(figure, path)


class _Page(Figure):
    """A figure with all texts as they are: a dollar in a name begins no formula, but powers along an axis are ones."""

    def draw(self, renderer: RendererBase | MixedModeRenderer) -> None:
        self._take_texts_as_they_are()
        super().draw(renderer)  # type: ignore[arg-type]  # a mixed one passes on what it does not draw itself

    def tight_layout(self, **options: Any) -> None:
        self._take_texts_as_they_are()
        super().tight_layout(**options)

    def _take_texts_as_they_are(self) -> None:
        along = (axis for axes in self.axes for axis in (axes.xaxis, axes.yaxis))
        powers = [
            axis.get_ticklabels(which="both") for axis in along if isinstance(axis.get_major_formatter(), LogFormatter)
        ]
        formulas = {label for labels in powers for label in labels}
        for text in self.findobj(Text):
            text.set_parse_math(text in formulas)


def new_figure(width_in: float, height_in: float, *, dpi: int, layout: Literal["constrained"] | None = None) -> Figure:
    """A white page of a size in inches, without a screen."""
    figure = _Page(figsize=(width_in, height_in), dpi=dpi, facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure, whole or not at all, and without the time: equal figures are equal bytes. Raises OutputError."""
    with whole_file(path) as temporary:
        figure.savefig(temporary, metadata={"CreationDate": None} if path.suffix == ".pdf" else None)


def _draw_title(figure: Figure, title: str) -> None:
    figure.text(0.03, 0.965, title, fontsize=16, color=_INK, va="center", fontweight="bold")


def _draw_views(figure: Figure, mesh: Mesh, bottom: float, *, width_px: int) -> None:
    """The occlusal view large, and one from each side of the arch at its right."""
    middle, top = 0.5 * (bottom + 0.91), 0.91
    azimuth, names = _outward(mesh)
    _draw_view(figure, (0.02, bottom, 0.55, top - bottom), render(mesh, OCCLUSAL, width_px=width_px), "occlusal")
    for name, turn, low in ((names[0], 0.0, middle), (names[1], 180.0, bottom)):
        view = render(mesh, look(azimuth + turn, 30.0), width_px=width_px // 2)
        _draw_view(figure, (0.60, low + 0.01, 0.38, middle - bottom - 0.05), view, name)


def _outward(mesh: Mesh) -> tuple[float, tuple[str, str]]:
    """Azimuth from which to look at the outer side, and what the two sides are called."""
    x, y, _ = np.average(mesh.vertices, axis=0, weights=mesh.vertex_areas)
    if np.hypot(x, y) > 0.35 * np.ptp(mesh.vertices[:, :2], axis=0).max():
        return float(np.rad2deg(np.arctan2(y, x))), ("from outside", "from inside")
    return 90.0, ("from the front", "from behind")


def _draw_view(figure: Figure, place: tuple[float, float, float, float], view: RenderedMesh, name: str) -> None:
    axes = figure.add_axes(place)
    height, width = view.image.shape[:2]
    axes.imshow(view.image, extent=(0, width * view.mm_per_px, 0, height * view.mm_per_px), interpolation="antialiased")
    axes.set_axis_off()
    axes.set_anchor("C")
    axes.set_title(name, loc="left", fontsize=12, color=_INK, pad=3)
    length = _round_length(0.2 * width * view.mm_per_px)
    axes.plot([0, length], [0, 0], color=_INK, linewidth=3, solid_capstyle="butt", clip_on=False)
    axes.annotate(f"{length:g} mm", (length, 0), (5, -3), textcoords="offset points", fontsize=11, color=_INK)


def _round_length(upper: float) -> float:
    """The largest of 1, 2, 5, 10, 20 .. times a power of ten that is not above ``upper``."""
    power = 10.0 ** np.floor(np.log10(upper))
    return float(power * max(factor for factor in (1, 2, 5) if factor * power <= upper))


def _draw_histogram(
    figure: Figure, weights: Float[np.ndarray, "v"], deviation_um: Float[np.ndarray, "v"], options: FigureOptions
) -> None:
    """Surface, or number of vertices, over deviation, standing on the colour bar that it shares its axis with."""
    limit = options.range_um
    known = np.isfinite(deviation_um)
    clipped = np.clip(deviation_um[known], -limit, limit)
    counts, edges = np.histogram(clipped, bins=100, range=(-limit, limit), weights=weights[known])
    centres = (edges[1:] + edges[:-1]) / 2
    bars = figure.add_axes((0.06, 0.135, 0.50, 0.13))
    bars.bar(centres, counts, width=np.diff(edges), color=deviation_map(options)(0.5 + 0.5 * centres / limit))
    bars.set_axis_off()
    bars.set_xlim(-limit, limit)
    scale = figure.add_axes((0.06, 0.105, 0.50, 0.028))
    bar = figure.colorbar(
        ScalarMappable(Normalize(-limit, limit), deviation_map(options)), cax=scale, orientation="horizontal"
    )
    bar.set_ticks([-limit, -limit / 2, -options.tolerance_um, 0, options.tolerance_um, limit / 2, limit])
    bar.ax.tick_params(labelsize=11, color=_INK, labelcolor=_INK)
    bar.ax.xaxis.set_major_formatter(lambda um, _: f"{um:+g}" if um else "0")
    bar.outline.set_visible(False)
    bar.set_label(
        "deviation from the reference / µm (positive: outside)\ngrey: not evaluated, or seen from behind",
        fontsize=12,
        color=_INK,
    )


def _draw_figures(figure: Figure, trueness: Trueness) -> None:
    accuracy = trueness.accuracy
    rows = [
        ("mean absolute", f"{accuracy.mean_abs_um:.1f} µm"),
        ("signed mean ± SD", f"{accuracy.signed_mean_um:+z.1f} ± {accuracy.std_um:.1f} µm"),
        ("95 % within", f"{accuracy.p95_um:.1f} µm"),
        ("complete within 50 µm", f"{trueness.completeness_pct['50']:.1f} %"),
        ("scale error", f"{trueness.scale_error_ppm:+.0f} ppm"),
    ]
    if trueness.inter_molar_error_um is not None:
        rows.append(("inter-molar error", f"{trueness.inter_molar_error_um:+.1f} µm"))
    for line, (name, value) in enumerate(rows):
        height = 0.245 - 0.034 * line
        figure.text(0.66, height, name, fontsize=13, color=_INK)
        figure.text(0.97, height, value, fontsize=13, color=_INK, ha="right", fontweight="bold")
