"""The page of a scan: the surface in colours of its deviation, the trueness, the worst places, what it was made of.

Everything is shown in the frame of the reference; before an evaluation the surface is turned so that its cameras look
down on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.trueness import METRICS, STATISTICS
from cuspid.report.figures.drawing import (
    FigureOptions,
    deviation_map,
    render,
)
from cuspid.report.pages.color_scale import ColorScale, css_color, small_unit
from cuspid.report.pages.page import jpeg_uri, picture_uri, provenance, render_page, script_json
from cuspid.report.pages.scene import (
    REFERENCE_COLOR,
    Place,
    camera_layer,
    deviation_range_um,
    has_scale,
    mesh_layer,
    path_layer,
    poses_from,
    shown_frame,
    standard_views,
    surface_maps,
)
from cuspid.report.pages.shown_mesh import ShownMesh, simplify
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range
from cuspid.storage import ScanResult

_Maps = Sequence[tuple[ColorScale, Float[np.ndarray, "v"]]]
"""What a surface can be coloured by, the first one at the start, with the values of its vertices."""
_BINS = 80
_WORST_APART_MM = 1.0
_WORST_VIEW_MM = 2.5
_THUMBNAIL_PX = 240


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Options):
    """What a page shows."""

    max_faces: Annotated[int, Range(100, 10_000_000)] = 300_000
    """Faces of the shown surface at most; a finer one is simplified, and the page says so."""
    max_reference_faces: Annotated[int, Range(100, 10_000_000)] = 120_000
    """The same for the reference."""
    range_um: Annotated[float | None, Range(0.01, 100_000)] = None
    """Ends of the colour bar; default: the smallest of 5, 10, 25 ... that is at least 2.5 times the 95th percentile."""
    frames: Annotated[int, Range(0, 100)] = 4
    """Number of frames shown as pictures, evenly spaced."""
    worst: Annotated[int, Range(0, 100)] = 8
    """Number of the worst places that are listed."""


_NO_SCALE = (
    "scale: unknown, so all lengths and areas are in an arbitrary unit, not in millimetres or "
    "micrometres, whatever is written beside them"
)


def scan_page(result: ScanResult, options: ReportOptions = ReportOptions()) -> str:
    """The HTML of a scan. Raises InputError where there is no surface."""
    if result.scan is None:
        raise InputError(f"{result.name}: nothing to show; {'; '.join(result.missing)}")
    shown_from_scan = shown_frame(result)
    scan = result.scan.transformed(shown_from_scan)
    range_um = options.range_um or deviation_range_um(result)
    worst = worst_places(scan, result.deviation_um, result.reference, options.worst)
    shown = simplify(scan, options.max_faces)
    maps = [(scale, shown.at_vertices(values)) for scale, values in surface_maps(result, range_um)]
    scene, sizes = _scene(result, shown, maps, shown_from_scan, options)
    return render_page(
        "scan.html.j2",
        title=_title(result),
        name=result.name,
        missing=result.missing,
        scene=script_json({**scene, "worst": [asdict(place) for place in worst]}),
        still=_still(shown.mesh, maps),
        scales=[scale for scale, _ in maps],
        toggles=[(layer["name"], layer["label"], layer["visible"]) for layer in scene["layers"]],
        views=[view["name"] for view in scene["views"]],
        shown=sizes,
        small_unit=small_unit(has_scale(result)),
        tiles=_tiles(result),
        warnings=_warnings(result),
        trueness=result.trueness,
        statistics=[METRICS[name] for name in STATISTICS],
        rows=_table(result.trueness),
        histogram=None if result.deviation_um is None else histogram(scan, result.deviation_um, range_um),
        worst=[
            {"number": number, "place": place.name, "at": place.position_mm, "um": um}
            for number, (place, um) in enumerate(worst.items(), start=1)
        ],
        frames=_frames(result.capture, options.frames, result.reconstruction is not None),
        dropped=[] if result.reconstruction is None else result.reconstruction.dropped,
        cleaning=result.cleaning,
        margins=result.margins,
        spheres=result.spheres,
        pictures=[(caption, picture_uri(path)) for caption, path in result.pictures.items()],
        made=provenance(result.run),
    )


def _title(result: ScanResult) -> str:
    settings = result.run.get("simulate", {}).get("settings", {})
    tooth = settings.get("simulation", {}).get("path", {}).get("tooth")
    what = "Scan" if not settings else f"Scan of tooth {tooth}" if tooth else "Scan of an arch"
    return what if result.trueness is not None else f"{what}, not evaluated"


# --- what is drawn ----------------------------------------------------------------------------------------------------


def _scene(
    result: ScanResult,
    shown: ShownMesh,
    maps: _Maps,
    shown_from_scan: Rigid3,
    options: ReportOptions,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The scene, and from how many to how many faces each surface was simplified."""
    layers = [mesh_layer("scan", "Scan", shown.mesh, values_um={scale.name: values for scale, values in maps})]
    sizes = [_size("scan", shown.full_faces, len(shown.mesh.faces), shown.off_um)]
    if result.reference is not None:
        truth = simplify(result.reference.mesh, options.max_reference_faces)
        layers.append(
            mesh_layer("reference", "Reference", truth.mesh, visible=False, color=REFERENCE_COLOR, behind=True)
        )
        sizes.append(_size("reference", truth.full_faces, len(truth.mesh.faces), truth.off_um))
    if result.reconstruction is not None:
        rig, poses = result.reconstruction.rig, poses_from(result.reconstruction, shown_from_scan)
        layers += [camera_layer(rig, poses), path_layer(rig, poses)]
    arch = None if result.reference is None else result.reference.arch
    scene = {
        "layers": layers,
        "scales": [scale.in_scene for scale, _ in maps],
        "views": standard_views(arch),
        "teeth": [asdict(place) for place in _teeth(result)],
        "length_unit": "mm" if has_scale(result) else "units of its own",
    }
    return scene, sizes


def _warnings(result: ScanResult) -> tuple[str, ...]:
    notes = () if result.reconstruction is None else result.reconstruction.notes
    return notes if has_scale(result) else (_NO_SCALE, *notes)


def _size(name: str, full: int, shown: int, off_um: float) -> dict[str, Any]:
    return {"name": name, "full": full, "shown": shown, "off_um": off_um}


def _teeth(result: ScanResult) -> list[Place]:
    """The teeth that were evaluated."""
    jaw, evaluated = result.reference, {} if result.trueness is None else result.trueness["per_tooth"]
    if jaw is None:
        return []
    return [_tooth_place(jaw, fdi) for fdi in jaw.teeth if str(fdi) in evaluated]


def _tooth_place(jaw: Jaw, fdi: int) -> Place:
    centres = jaw.mesh.face_centres[jaw.tooth_faces(fdi)]
    x, y, z = (float(each) for each in centres.mean(axis=0))
    radius = float(np.percentile(np.linalg.norm(centres - [x, y, z], axis=1), 95))
    return Place(name=str(fdi), position_mm=(x, y, z), radius_mm=1.25 * radius)


def _still(scan: Mesh, maps: _Maps) -> str:
    """What is seen where there is no WebGL, and in print before the view was drawn."""
    colors = next((scale.rgb(values) for scale, values in maps), None)
    return jpeg_uri(render(Mesh(scan.vertices, scan.faces, colors), width_px=900, supersampling=1).image)


# --- figures ----------------------------------------------------------------------------------------------------------


def _tiles(result: ScanResult) -> list[tuple[str, str, str]]:
    """The figures that matter most: name, value, unit."""
    tiles: list[tuple[str, str, str]] = []
    if result.trueness is not None:
        found = result.trueness
        tiles += [
            ("mean absolute deviation", f"{found['mean_abs_um']:.1f}", "µm"),
            ("95 % within", f"{found['p95_um']:.1f}", "µm"),
            ("complete within 50 µm", f"{found['completeness_pct']['50']:.1f}", "%"),
            *_crown_tiles(found.get("crown")),
            ("scale error", f"{found['scale_error_ppm']:+.0f}".replace("-", "−"), "ppm"),
        ]
        if found["inter_molar_error_um"] is not None:
            tiles.append(("inter-molar error", f"{found['inter_molar_error_um']:+.1f}".replace("-", "−"), "µm"))
    if result.reconstruction is not None:
        located, dropped = len(result.reconstruction.frames), len(result.reconstruction.dropped)
        tiles.append(("frames located", f"{located}", f"of {located + dropped}" if dropped else ""))
        tiles += _expected_tiles(result.reconstruction)
    if result.trajectory is not None:
        tiles.append(("position error of the handpiece, RMSE", f"{result.trajectory['ape_um']['rmse']:.1f}", "µm"))
    if result.capture is not None:
        tiles.append(("images", f"{len(result.capture.frames) * len(result.capture.handpiece.rig.names)}", ""))
    return tiles


def _expected_tiles(found: Reconstruction) -> list[tuple[str, str, str]]:
    tiles = []
    if found.refinement is not None:
        tiles.append(("refinement of the calibration, RMS", f"{found.refinement.rms_sigmas:.2f}", "σ"))
    if found.expectation is not None:
        tiles.append((f"scale, from {found.told_by}, one σ", f"±{found.expectation.scale_sigma_ppm:.0f}", "ppm"))
        span = f"{found.expectation.span_mm:.0f} mm from end to end, from these, one σ"
        tiles.append((span, f"±{found.expectation.span_sigma_um:.1f}", "µm"))
    return tiles


def _crown_tiles(crown: Mapping[str, Any] | None) -> list[tuple[str, str, str]]:
    if crown is None:
        return []
    estimated = ", crowns estimated by shape" if crown["estimated"] else ""
    return [(f"of all open crown surface within 50 µm{estimated}", f"{crown['completeness_pct']['50']:.1f}", "%")]


def _table(trueness: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Trueness in whole, by tooth, and with everything that was scanned."""
    if trueness is None:
        return []
    seen = trueness["per_tooth_completeness_pct"]
    crown = trueness.get("crown") or {"completeness_pct": None, "per_tooth_pct": {}}
    teeth = [
        _table_row(fdi, trueness["per_tooth"][fdi], seen[fdi], crown["per_tooth_pct"].get(fdi))
        for fdi in sorted(trueness["per_tooth"], key=int)
    ]
    return [
        _table_row("all", trueness, trueness["completeness_pct"], crown["completeness_pct"]),
        *teeth,
        *(_table_row("everything", trueness[each], None, None) for each in ("everything",) if each in trueness),
    ]


def _table_row(
    name: str, figures: Mapping[str, Any], seen: Mapping[str, float] | None, crown: Mapping[str, float] | None
) -> dict[str, Any]:
    """A row; shares of what could be seen and of the open crown, None where there are none."""
    return {"name": name, "figures": [figures[each] for each in STATISTICS], "seen": seen, "crown": crown}


def histogram(mesh: Mesh, deviation_um: Float[np.ndarray, "v"], range_um: float) -> dict[str, Any]:
    """Share of the surface by deviation: bars (height 0 to 1, colour), and the shares beyond either end, in %."""
    area = np.bincount(mesh.faces.ravel(), np.repeat(mesh.face_areas, 3), minlength=len(mesh.vertices))
    known = np.isfinite(deviation_um)
    values, weights = deviation_um[known], area[known]
    counts, edges = np.histogram(values, bins=_BINS, range=(-range_um, range_um), weights=weights)
    colors = deviation_map(FigureOptions())(0.5 + 0.25 * (edges[1:] + edges[:-1]) / range_um, bytes=True)[:, :3]
    total = float(weights.sum()) or 1.0
    return {
        "bars": [
            {"height": float(count / (counts.max() or 1.0)), "color": css_color(color)}
            for count, color in zip(counts, colors, strict=True)
        ],
        "below_pct": float(100 * weights[values < -range_um].sum() / total),
        "above_pct": float(100 * weights[values > range_um].sum() / total),
        "range_um": range_um,
    }


def worst_places(
    scan: Mesh, deviation_um: Float[np.ndarray, "v"] | None, reference: Jaw | None, count: int
) -> dict[Place, float]:
    """The vertices of the full surface with the largest deviations, at least 1 mm from each other, and these."""
    if deviation_um is None:
        return {}
    left = np.abs(np.nan_to_num(deviation_um))
    found: dict[Place, float] = {}
    while len(found) < count and left.max() > 0:
        worst = int(left.argmax())
        at, normal = scan.vertices[worst], scan.vertex_normals[worst]
        left[np.linalg.norm(scan.vertices - at, axis=1) < _WORST_APART_MM] = 0
        place = Place(
            name=_tooth_at(reference, at),
            position_mm=(float(at[0]), float(at[1]), float(at[2])),
            radius_mm=_WORST_VIEW_MM,
            towards=(float(normal[0]), float(normal[1]), float(normal[2])),
        )
        found[place] = float(deviation_um[worst])
    return found


def _tooth_at(reference: Jaw | None, at: Float[np.ndarray, "3"]) -> str:
    if reference is None or reference.face_labels is None:
        return "–"
    label = int(reference.face_labels[reference.mesh.closest(at[None])[1][0]])
    return "gum" if label == GUM else str(label)


# --- pictures ---------------------------------------------------------------------------------------------------------


def _frames(capture: Capture | None, count: int, located: bool) -> list[dict[str, Any]]:
    """Evenly spaced frames, each as one picture of all cameras."""
    if capture is None or count == 0 or not capture.frames:
        return []
    picks = np.unique(np.linspace(0, len(capture.frames) - 1, min(count, len(capture.frames))).round().astype(int))
    return [
        {
            "name": frame.name,
            "picture": jpeg_uri(contact_sheet(list(capture.images(frame).values()))),
            "cameras": len(frame.cameras),
            "located": located,
        }
        for frame in (capture.frames[pick] for pick in picks)
    ]


def contact_sheet(images: Sequence[UInt8[np.ndarray, "_ _ 3"]]) -> UInt8[np.ndarray, "h w 3"]:
    """Images beside each other in two rows (one for up to three), each made small."""
    widest = 2 * _THUMBNAIL_PX if len(images) == 1 else _THUMBNAIL_PX
    small = [_fit_width(image, widest) for image in images]
    columns = len(small) if len(small) <= 3 else (len(small) + 1) // 2
    height, width = (max(image.shape[axis] for image in small) for axis in (0, 1))
    rows = -(-len(small) // columns)
    sheet = np.full((rows * height, columns * width, 3), 255, dtype=np.uint8)
    for k, image in enumerate(small):
        top, left = k // columns * height, k % columns * width
        sheet[top : top + image.shape[0], left : left + image.shape[1]] = image
    return sheet


def _fit_width(image: UInt8[np.ndarray, "_ _ 3"], width: int) -> UInt8[np.ndarray, "_ _ 3"]:
    if image.shape[1] <= width:
        return image
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
