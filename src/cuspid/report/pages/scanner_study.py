"""The page of a study of scanners: what was compared, trueness and precision, statistics, and all scans in 3-D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cuspid.model.mesh import Mesh
from cuspid.model.trueness import METRICS
from cuspid.report.figures.drawing import render
from cuspid.report.figures.scanner_study import common_range_um
from cuspid.report.pages.color_scale import deviation_scale
from cuspid.report.pages.page import jpeg_uri, number, photo_uri, provenance, render_page, script_json, signed_number
from cuspid.report.pages.scene import mesh_layer, standard_views
from cuspid.report.pages.shown_mesh import pack_um
from cuspid.storage import ScannerStudyResult, SpecimenView

_LARGEST_FRAMES_BYTES = 9_000_000
"""Room for the deviations of scans in a page; of more, the first are shown."""
_HEADS = {
    "mean_abs_um": "mean |d|, µm",
    "signed_mean_um": "signed mean, µm",
    "rms_um": "RMS, µm",
    "p95_um": "P95, µm",
    "complete_pct": "complete, %",
    "spans_rms_um": "distances RMS, µm",
    "scale_ppm": "scale, ppm",
    "spread_um": "spread, µm",
    "lift_um": "lift, µm",
    "twist_um": "twist, µm",
    "modes_rms_um": "all modes, RMS µm",
    "remainder_um": "remainder, RMS µm",
    "similarity_scale_ppm": "best similarity, ppm",
    "from_mean_rms_um": "precision (RMS from the mean scan), µm",
}
_MODES = ("scale_ppm", "spread_um", "lift_um", "twist_um", "modes_rms_um", "remainder_um", "similarity_scale_ppm")
_KINDS = {
    "bodies": "scan bodies",
    "spheres": "spheres",
    "landmarks": "landmarks",
    "teeth": "teeth (centroids)",
    "stations": "stations along the arch",
}
_SMALL = 2.0
Table = dict[str, Any]


def scanner_study_page(result: ScannerStudyResult) -> str:
    """The HTML of a study of scanners."""
    summary = result.summary
    counts = summary["counts"]
    return render_page(
        "scanner_study.html.j2",
        title="Trueness and precision of scanners",
        name=result.name,
        missing=result.missing,
        tiles=[
            ("scanners", str(counts["scanners"]), ""),
            ("specimens", str(counts["specimens"]), ""),
            ("scans compared", str(counts["scans"]), ""),
            ("left out", str(counts["left_out"]), ""),
        ],
        left_out=[f"{each['what']}: {each['why']}" for each in summary["remarks"] if each["left_out"]],
        odd=[f"{each['what']}: {each['why']}" for each in summary["remarks"] if not each["left_out"]],
        consequence=summary["consequence"],
        view=_view(result.views) if result.views else None,
        tables=_tables(summary),
        tests=_tests(summary["comparisons"]),
        plan=_plan(summary["plan"]),
        agreements=_agreements(summary["agreements"]),
        methods=summary["methods"],
        checklist=summary["checklist"],
        pictures=[(caption, photo_uri(path, widest_px=1500)) for caption, path in result.pictures.items()],
        made=provenance(result.run),
    )


# --- 3-D --------------------------------------------------------------------------------------------------------------


def _view(views: Sequence[SpecimenView]) -> dict[str, Any]:
    """A layer for each specimen, and frames: the means first, then all scans, as far as a page has room."""
    scale = deviation_scale(common_range_um(views))
    frames, left = [], 0
    room = _LARGEST_FRAMES_BYTES
    order = [(view, k) for view in views for k in range(view.means)]
    order += [(view, k) for view in views for k in range(view.means, len(view.frames))]
    several = len(views) > 1
    for view, k in order:
        name, field = list(view.frames.items())[k]
        values = pack_um(field)
        room -= len(values["data"])
        if room < 0:
            left += 1
            continue
        label = f"{name} – {view.name}" if several else name
        frames.append({"label": label, "layer": view.name, "values": values})
    layers = [
        {
            **mesh_layer(view.name, view.name, view.mesh, visible=k == 0, values_um={"deviation": _first(view)}),
            "group": "specimen",
        }
        for k, view in enumerate(views)
    ]
    meaning = "Deviation from the reference in µm, positive outside; one scale for all scans. Grey: not shown."
    scale = replace(scale, label="Deviation", meaning=meaning)
    first = views[0]
    still = render(Mesh(first.mesh.vertices, first.mesh.faces, scale.rgb(_first(first))), width_px=900, supersampling=1)
    standard = standard_views(first.arch)
    scene = {
        "layers": layers,
        "scales": [scale.in_scene],
        "views": standard,
        "teeth": [],
        "worst": [],
        "frames": frames,
    }
    return {
        "scene": script_json(scene),
        "still": jpeg_uri(still.image),
        "views": [each["name"] for each in standard],
        "shown": [
            {
                "name": f"reference of {view.name}",
                "full": view.full_faces,
                "shown": len(view.mesh.faces),
                "off_um": None,
            }
            for view in views
        ],
        "scales": [scale],
        "frames": [frame["label"] for frame in frames],
        "left": left,
    }


def _first(view: SpecimenView) -> np.ndarray:
    return next(iter(view.frames.values()))


# --- tables -----------------------------------------------------------------------------------------------------------


def _estimate(found: Mapping[str, Any] | None, digits: int = 1, *, plus: bool = False) -> str:
    """A value with its interval; of a small one, a digit more."""
    if found is None:
        return "–"
    digits += bool(digits) and abs(found["value"]) < _SMALL
    text = (signed_number if plus else number)(found["value"], digits)
    if found["low"] is None:
        return text
    show = signed_number if plus else number
    return f"{text} ({show(found['low'], digits)} to {show(found['high'], digits)})"


def _size(value: float | None) -> str:
    return number(value, 2 if value is not None and abs(value) < _SMALL else 1)


def _has_sign(figure: str) -> bool:
    return figure in ("signed_mean_um", "scale_ppm", "similarity_scale_ppm", "spread_um", "lift_um", "twist_um")


def _tables(summary: Mapping[str, Any]) -> list[Table]:
    return [
        _trueness_table(summary["scanners"]),
        _modes_table(summary["scanners"]),
        *([_spans_table(summary["spans"])] if summary["spans"] else []),
        *([_parts_table(summary)] if summary["parts"] else []),
        *(_factor_table(factor, levels) for factor, levels in summary["factors"].items() if factor != "scanner"),
        _groups_table(summary["groups"]),
    ]


def _trueness_table(scanners: Mapping[str, Any]) -> Table:
    rows = []
    for name, found in scanners.items():
        true, precise = found["trueness"], found["precision"]
        rows.append(
            [
                name,
                str(found["scans"]),
                _estimate(true["mean_abs_um"]),
                _estimate(true["signed_mean_um"], plus=True),
                _estimate(true["rms_um"]),
                _estimate(precise["mean_abs_um"]),
                _estimate(precise["rms_um"]),
                number(found["repeatability_sd_um"]),
                _estimate(true["complete_pct"]),
            ]
        )
    mean, signed_mean, rms = (METRICS[name].heading for name in ("mean_abs_um", "signed_mean_um", "rms_um"))
    heads = ["scanner", "scans", f"trueness: {mean}", signed_mean, rms, f"precision: {mean}", f"precision: {rms}"]
    return {
        "title": "Trueness and precision",
        "caption": "In µm, means over specimens with 95 % intervals; from scan to reference. Precision: repeats "
        "against each other. s_r: repeatability standard deviation at a place (ISO 5725-1).",
        "heads": [*heads, "s_r", "complete, %"],
        "rows": rows,
    }


def _modes_table(scanners: Mapping[str, Any]) -> Table:
    rows = [
        [
            name,
            *(
                _estimate(found["trueness"][figure], 0 if "ppm" in figure else 1, plus=_has_sign(figure))
                for figure in _MODES
            ),
        ]
        for name, found in scanners.items()
    ]
    return {
        "title": "Deformation of the arch",
        "caption": "Means with 95 % intervals. Spread: the arch opens; lift: both ends rise; twist: one rises, one "
        "sinks; how far the ends move while the middle is fixed. Remainder: of the deviations, without them.",
        "heads": ["scanner", *(_HEADS[figure] for figure in _MODES)],
        "rows": rows,
    }


def _spans_table(spans: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        [
            f"{_KINDS[row['kind']]}, {row['distances']}",
            row["scanner"],
            str(row["count"]),
            f"{number(row['from_mm'])} to {number(row['to_mm'])}",
            signed_number(row["mean_um"]),
            number(row["mean_abs_um"]),
            number(row["rms_um"]),
            signed_number(row["slope_ppm"], 0),
            number(row["angle_deg"], 3),
        ]
        for row in spans
    ]
    heads = ["distances", "scanner", "number", "length, mm", "mean, µm", "mean |error|, µm", "RMS, µm"]
    return {
        "title": "Distances and angles",
        "caption": "Measured minus nominal; they do not depend on the alignment. Slope: error in proportion to length.",
        "heads": [*heads, "slope, ppm", "angle, °"],
        "rows": rows,
    }


def _parts_table(summary: Mapping[str, Any]) -> Table:
    rows = [
        [
            f"{_KINDS[row['kind']]}, {row['scanner']}",
            str(row["count"]),
            number(row["position_um"]),
            number(row["precision_um"]),
            number(row["axis_deg"], 3),
        ]
        for row in summary["parts"]
    ]
    rows += [[f"{what} ({source})", "published", *cells] for what, *cells, source in summary["anchors"]]
    return {
        "title": "Positions and axes",
        "caption": "Mean distance of each sphere or scan body from its place in the reference after the alignment, and "
        "between repeats. Published figures are of other objects and other alignments: they only indicate the order "
        "of size.",
        "heads": ["parts", "number", "trueness, µm", "precision, µm", "axis, °"],
        "rows": rows,
    }


def _factor_table(factor: str, levels: Mapping[str, Any]) -> Table:
    figures = [name for name in _HEADS if any(each.get(name) is not None for each in levels.values())]
    rows = [
        [
            level,
            str(next(each["scans"] for each in found.values() if each is not None)),
            *(_estimate(found.get(name), 0 if "ppm" in name else 1, plus=_has_sign(name)) for name in figures),
        ]
        for level, found in levels.items()
        if any(each is not None for each in found.values())
    ]
    heads = [factor, "scans", *(_HEADS[name] for name in figures)]
    return {
        "title": f"By {factor}",
        "caption": "Means with 95 % intervals.",
        "heads": heads,
        "rows": rows,
    }


def _groups_table(groups: Sequence[Mapping[str, Any]]) -> Table:
    columns = {
        "trueness_mean_abs_um": "trueness: mean |d|",
        "trueness_rms_um": "RMS",
        "precision_mean_abs_um": "precision: mean |d|",
        "precision_rms_um": "RMS",
        "repeatability_sd_um": "s_r",
        "median_sd_um": "s at the median place",
        "repeatability_limit_um": "limit 2.8 s_r",
        "systematic_rms_um": "systematic, RMS",
    }
    rows = [
        [f"{row['scanner']} – {row['specimen']}", str(row["scans"]), *(_size(row[column]) for column in columns)]
        for row in groups
    ]
    return {
        "title": "Each scanner on each specimen",
        "caption": "In µm. Systematic: of the mean surface, without what is left of the random part in it.",
        "heads": ["scanner – specimen", "scans", *columns.values()],
        "rows": rows,
    }


# --- statistics -------------------------------------------------------------------------------------------------------


def _p(value: float) -> str:
    return "< 0.0001" if value < 1e-4 else f"= {value:.4f}" if value < 0.01 else f"= {value:.3f}"


def _holds(assumption: Mapping[str, Any]) -> str:
    """An assumption, and whether it holds."""
    words = {True: "holds", False: "does not hold", None: "not tested"}
    return f"{assumption['what']}: {words[assumption['holds']]}"


def _tests(comparisons: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    found = []
    for each in comparisons:
        digits = 0 if "ppm" in each["figure"] else 1
        rows = [
            [
                f"{pair['first']} − {pair['second']}",
                _estimate(pair["difference"], digits, plus=True),
                _p(pair["p"]).removeprefix("= "),
                f"{pair['effect_name']} {_estimate(pair['effect'], 2, plus=True)}",
            ]
            for pair in each["contrasts"]
        ]
        parts = ", ".join(f"{name} {number(sd, 2)}" for name, sd in each["components"].items())
        found.append(
            {
                "title": _HEADS[each["figure"]],
                "told": f"{each['test']}: statistic {each['statistic']:.2f}, p {_p(each['p'])}, corrected for "
                f"{len(comparisons)} figures {_p(each['p_holm'])} ({each['scans']} scans). By the model "
                f"{_p(each['model_p'])}, by ranks {_p(each['rank_p'])}. Standard deviations: {parts}.",
                "assumptions": [f"{_holds(one)} ({one['told']})" for one in each["assumptions"]],
                "rows": rows,
            }
        )
    return found


def _plan(plan: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if plan is None:
        return None
    return {
        "told": f"From the scatter of this study: SD of mean |d| between scans of one scanner and specimen "
        f"{number(plan['sd_um'], 2)} µm ({plan['freedom']} degrees of freedom). Power 80 %, two-sided 5 % over "
        f"{plan['pairs']} pair{'s' if plan['pairs'] != 1 else ''} of scanners (Bonferroni), t test.",
        "scans": [
            (
                f"{difference} µm",
                "more than 10 000" if count is None else str(count),
                float(difference) == plan["asked_um"],
            )
            for difference, count in plan["scans"].items()
        ],
        "precision": [(ratio, str(count)) for ratio, count in plan["precision"].items()],
    }


def _agreements(agreements: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [
        {
            "row": [
                f"{each['first']} − {each['second']}",
                str(each["count"]),
                *(_estimate(each[name], plus=True) for name in ("bias", "lower", "upper")),
                "; ".join(map(_holds, each["assumptions"])),
            ]
        }
        for each in agreements
    ]
