"""Sections of the pages of results on handpieces."""

from __future__ import annotations

from collections.abc import Mapping
from math import sqrt
from statistics import mean
from typing import Any

from anatomy_sections import mark, markdown_table

Result = Mapping[str, Any]


def visibility(result: Result) -> str:
    """How long it takes to ask what a design sees."""
    rows = [
        (
            name,
            f"{result[name]['faces']:,}",
            f"{result[name]['cameras']} x {result[name]['positions']}",
            mark(result[name]["survey"]["wall_s"], 60 if name == "arch" else 2),
            result[name]["scannable"]["wall_s"],
        )
        for name in ("arch", "molar")
    ]
    head = ("surface", "faces", "cameras x positions", "survey, s (bar 60, molar 2)", "scannable faces, s")
    return markdown_table(head, rows)


def precision(result: Result) -> str:
    """The bound against Monte-Carlo and its closed form."""
    found = result["monte_carlo"]
    rows = [
        (f"Monte-Carlo, RMS, worst of {found['cases']} cases", f"{mark(found['worst_rms_pct'], 3)} %", "3 %"),
        ("the same in the worst direction", f"{mark(found['worst_axis_pct'], 3)} %", "3 %"),
        ("closed form, relative", f"{result['closed_form_worst']:.1e}", "1e-9"),
    ]
    pair = ", ".join(f"{value:.1f}" for value in result["parallel_pair_at_5_mm_um"].values())
    baselines = ", ".join(result["parallel_pair_at_5_mm_um"])
    return "\n".join(
        [
            markdown_table(("difference from the bound", "found", "bar"), rows),
            "",
            f"Parallel pair at 5 mm, 512 px, 62 deg, 0.5 px: baselines of {baselines} mm give {pair} um.",
        ]
    )


def camera_pair(result: Result) -> str:
    """The best pair of cameras by distance, over the occlusal surface of a second molar."""
    head = ("matcher", "distance mm", "baseline mm", "axis angle deg", "seen by both %", "expected RMS um")
    rows = [
        (
            matcher,
            f"{best['distance_mm']:g}",
            f"{best['baseline_mm']:g}",
            f"{best['axis_angle_deg']:g}",
            f"{best['seen_pct']:.0f}",
            f"{best['expected_rms_um']:.1f}",
        )
        for matcher, rows_of in result["best_within_budget"].items()
        for best in rows_of
        if best["facing"] == "occlusal"
    ]
    return "\n".join(
        [
            f"{result['cases']} pairs, {result['cpu_s']} CPU-s. For each distance, the pair with the largest share of "
            "the surface within 10 um (docs/precision.md discusses whether a smaller baseline is more accurate):",
            "",
            markdown_table(head, rows),
        ]
    )


def camera_sweep(result: Result) -> str:
    """The best pair of cameras for each surface, by simulated scans."""
    head = (
        "surface",
        "most complete (mm, deg)",
        "within 50 um %",
        "most accurate (mm, deg)",
        "mean um",
        "thesis (mm, deg): within 50 um %, mean um",
        "scans",
        "failed",
        "CPU s",
        "wall s on 2 cores (bar 1800)",
    )
    return markdown_table(head, [_sweep_row(name, found) for name, found in result["surfaces"].items()])


def _sweep_row(surface: str, found: Result) -> tuple[object, ...]:
    complete, accurate, thesis, run = (
        found["best"]["complete_50_um_pct"],
        found["best"]["mean_abs_um"],
        found["thesis"],
        found["run"],
    )
    beside = "-" if thesis is None else f"{thesis['complete_50_um_pct']:.1f}, {thesis['mean_abs_um']:.2f}"
    return (
        surface,
        _setting(complete["setting"]),
        f"{complete['value']:.1f} ± {complete['noise']:.1f}",
        _setting(accurate["setting"]),
        f"{accurate['value']:.2f} ± {accurate['noise']:.2f}",
        beside if thesis is None else f"{_setting(thesis['setting'])}: {beside}",
        found["cases"],
        found["failed"],
        f"{found['cases_cpu_s']:.0f}",
        "in several runs" if run is None else f"{mark(run['wall_s'], 1800, 0)} (load {run['load_before']:.0f})",
    )


def _setting(setting: tuple[float, float]) -> str:
    return f"{setting[0]:g}, {setting[1]:g}"


def grid(result: Result) -> str:
    """How much faster two workers are than one."""
    rows = [
        (way, f"{ratio:.2f}" if ratio >= 1.7 else f"**{ratio:.2f}** (missed)", ", ".join(f"{x:.2f}" for x in each))
        for (way, ratio), each in zip(result["median_speed_up"].items(), result["speed_up"].values(), strict=True)
    ]
    load = result["load_average_before"][0]
    return "\n".join(
        [
            f"{result['cases']} cases of the sweep, {len(result['rounds'])} rounds; load average before: {load:.1f}.",
            "",
            markdown_table(("workers", "speed-up of two over one, median (bar >= 1.7)", "each round"), rows),
        ]
    )


def design_comparison(result: Result) -> str:
    """Six cameras or twelve, and found handpieces with fewer."""
    head = (
        "jaw",
        "tooth",
        "design",
        "turns",
        "seeds",
        "cameras",
        "positions",
        "images",
        "mean um",
        "P95 um",
        "tooth within 50 um %",
        "reconstruction CPU s",
    )
    rows = [
        (
            *(f"{row[name]:g}" if isinstance(row[name], float) else row[name] for name in head[:6] if name in row),
            f"{row['frames']:.0f}",
            f"{row['images']:.0f}",
            f"{row['tooth_mean_abs_um']:.2f}",
            f"{row['tooth_p95_um']:.1f}",
            f"{row['tooth_within_50_um_pct']:.1f}",
            f"{row['reconstruction_cpu_s']:.0f}" if "reconstruction_cpu_s" in row else "-",
        )
        for row in result["rows"]
    ]
    scale = result["options"]["image_scale"]
    return "\n".join(
        [
            f"One tooth per scan, images scaled by {scale:g}; the share refers to all faces of the tooth that are "
            "open to the occlusal side, the same for all designs (docs/six-or-twelve.md).",
            "",
            markdown_table(head, rows),
        ]
    )


def any_rig(result: Result) -> str:
    """One molar, scanned with many rigs."""
    scans = result["scans"]
    parts = [
        f"Tooth {result['tooth']} of the phantom, without options specific to a rig. The share within 50 um refers to "
        "what two cameras of one frame could see, which differs between the rigs; *seen* is how much of the tooth "
        "that is. The rigs of eight and ten cameras were found by a search (docs/designs.md).",
    ]
    for title, names in result["tables"].items():
        found = [scans[name] for name in names if name in scans]
        parts += ["", f"By {title}:", "", markdown_table(_ANY_RIG, [_any_rig_row(scan) for scan in found])]
    return "\n".join(parts)


def targets(result: Result) -> str:
    """Calibrations with a flat board and with terraces: what is stated, and what is true."""
    rows = []
    for tilt in (40, 15):
        for kind, board in {"flat": "flat", **dict.fromkeys(("known", "off", "trusted"), "terraces")}.items():
            starts = f"{board}-{tilt}deg"
            made = [each for name, each in result["calibrations"].items() if name.startswith(starts)]
            found = [each for each in made if each["failure"] is None]
            keys = ("focal_sigma_permille", "focal_error_permille", "place_error_um")
            spans = [_spread([each[f"{kind}_{key}"] for each in found]) for key in keys]
            steps = "" if kind == "flat" else f", steps {kind}"
            corners = f"{mean(each[f'{kind}_corners'] for each in found):.0f}"
            rows.append((tilt, f"{board}{steps}", f"{len(found)} of {len(made)}", corners, *spans))
    heads = (
        *("largest tilt, deg", "board", "calibrated", "corners", "focal lengths, stated, per mille"),
        *("true error, per mille", "positions, true error, um"),
    )
    return "\n".join(
        [
            f"Six cameras of {result['pixels']} px, built within tolerances, {result['instants']} instants; root mean "
            "squares over the handpieces, with the smallest and the largest value (docs/calibration.md). Steps are "
            "*known* to 1 um; *off* by 10 um, and known to that accuracy; or off and *trusted* to 1 um.",
            "",
            markdown_table(heads, rows),
        ]
    )


def _spread(values: list[float]) -> str:
    return f"{sqrt(mean(each**2 for each in values)):.2f} ({min(values):.2f} to {max(values):.2f})"


def stereo_pairs(result: Result) -> str:
    """Photographs with known disparity, by two matchers."""
    heads = (
        *("pair", "matcher", "with depth %", "of what both cameras see %", "median error px"),
        *("off by more than 1 px, %", "CPU s"),
    )
    keys = ("density_pct", "density_of_seen_by_both_pct", "median_px", "above_1_px_pct", "cpu_s")
    rows = [
        (pair, method, *(f"{found[key]:.{3 if key == 'median_px' else 1}f}" for key in keys))
        for pair, methods in result["pairs"].items()
        for method, found in methods.items()
    ]
    return "\n".join(
        [
            "Rectified photographs from Middlebury, which are not part of the project, taken as those of a handpiece "
            "with two cameras whose working distance is that of the middle disparity; OpenCV's StereoSGBM for "
            "comparison. Targets: depth on 70 % of the pixels, a median of 0.15 px and 3 % above 1 px. "
            "`python benchmarks/stereo_pairs.py`.",
            "",
            markdown_table(heads, rows),
        ]
    )


_ANY_RIG = (
    "cameras",
    "working distance mm",
    "image px",
    "mean um",
    "P95 um",
    "within 50 um %",
    "tooth seen %",
    "frames located",
    "images",
    "CPU s",
)


def _any_rig_row(scan: Result) -> tuple[object, ...]:
    """Of a scan that failed, the reason."""
    size = f"{scan['width_px']} x {scan['height_px']}"
    if scan["failure"] is not None:
        return (scan["cameras"], f"{scan['working_distance_mm']:g}", size, scan["failure"], *[""] * 6)
    return (
        scan["cameras"],
        f"{scan['true_distance_mm']:.2g}",
        size,
        f"{scan['mean_abs_um']:.2f}",
        f"{scan['p95_um']:.1f}",
        f"{scan['complete_50_um_pct']:.1f}",
        f"{scan['tooth_seen_pct']:.1f}",
        f"{scan['located_frames']} of {scan['frames']}",
        scan["images"],
        f"{scan['reconstruction_cpu_s']:.0f}",
    )


_BUILT_BARS_UM = {"fine": 3, "usual": 5, "rough": 10}
"""Mean deviation after the refinement."""
_BUILT = (
    *("handpiece", "calibration", "mean um", "P95 um", "within 50 um %", "mean after a similarity um"),
    *("path um", "path shape um", "inter-molar um", "scale ppm (one sigma)", "within 1, 2 expected sigmas %"),
    *("adjustments s", "images to mesh s"),
)


def manufacturing(result: Result) -> str:
    """Scans with handpieces that are off from their files, held as they say and refined."""
    rows = []
    for name, scan in result["scans"].items():
        bar = _BUILT_BARS_UM.get(name.split("-")[0])
        if scan["failure"] is not None:
            rows.append((name, scan["failure"], *[""] * (len(_BUILT) - 2)))
            continue
        for how in ("held", "refined"):
            if f"{how}_mean_um" in scan:
                figures = _built_figures(scan, how, bar if how == "refined" else None, across="swept" in result["what"])
                rows.append((name, how, *figures))
    return "\n".join(
        [
            f"{result['what']}, twelve cameras. Standard deviations of the positions, rotations, focal lengths, "
            "principal points and k1 of the built cameras: fine 3 um, 0.02 deg; usual 10 um, 0.05 deg, 0.3 %, 1 px, "
            "0.01; rough 30 um, 0.2 deg, and lenses as in usual. *Held*: the file is taken as exact; *refined*: within "
            "these tolerances. The images are those of the drawn handpiece; it is the file that is off. Bars, refined: "
            "mean 3, 5 and 10 um, 2.5 um after a similarity transform, 2 um for the shape of the path (RMS, after a "
            "similarity transform, of the place that the true origin of the handpiece has among the cameras), scale "
            "within two of its stated standard deviations, 30 s for the adjustments; with a sweep, 30 um between "
            "the molars. The shares are those of the surface within one and two of the standard deviations that the "
            f"scan states. Each case had one core; the load of the machine was {result['load'][0]:.1f} on "
            f"{result['cores']} cores, and times are longer where it was more than that. "
            "`python benchmarks/manufacturing.py`.",
            "",
            markdown_table(_BUILT, rows),
        ]
    )


def _built_figures(scan: Result, how: str, bar: float | None, *, across: bool) -> tuple[object, ...]:
    def get(figure: str) -> Any:
        return scan[f"{how}_{figure}"]

    def against(figure: str, limit: float) -> str:
        return f"{get(figure):.1f}" if bar is None else mark(get(figure), limit, 1)

    seen = get("inter_molar_um")
    scale = f"{get('scale_ppm'):+.0f} ({get('scale_sigma_ppm'):.0f})"
    return (
        against("mean_um", bar or 0.0),
        *(f"{get(each):.1f}" for each in ("p95_um", "complete_50_um_pct")),
        against("similar_mean_um", 2.5),
        f"{get('trajectory_um'):.1f}",
        against("similar_trajectory_um", 2.0),
        "-" if seen is None else against("inter_molar_um", 30.0) if across else f"{seen:+.1f}",
        scale if bar is None or abs(get("scale_ppm")) <= 2 * get("scale_sigma_ppm") else f"**{scale}** (missed)",
        f"{get('within_sigma_pct'):.0f}, {get('within_2_sigmas_pct'):.0f}",
        against("adjustments_s", 30.0) if f"{how}_adjustments_s" in scan else "-",
        f"{get('reconstruction_s'):.0f}",
    )
