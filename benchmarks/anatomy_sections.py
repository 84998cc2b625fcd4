"""Sections of the pages of results on jaws, mouths and metrology objects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import Any

from cuspid_thesis.catalogue import TABLE_3_2
from cuspid_thesis.results import value_at

Result = Mapping[str, Any]


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)])


def mark(value: float, limit: float, digits: int = 2) -> str:
    """A figure, marked where it misses the limit that it must not exceed."""
    return f"{value:.{digits}f}" if abs(value) <= limit else f"**{value:.{digits}f}** (missed)"


def spheres(result: Result) -> str:
    """The sphere arch, scanned."""
    report, trueness = result["spheres"], result["trueness"]
    named = {
        name: report[key]
        for name, key in (
            ("inter-canine", "inter_canine_um"),
            ("inter-first-molar", "inter_first_molar_um"),
            ("inter-second-molar", "inter_second_molar_um"),
        )
    } | {f"cross-arch {label}": error for label, error in report["cross_arch_um"].items()}
    form = [sphere["form_rms_um"] for sphere in report["spheres"].values()]
    size = [sphere["size_error_um"] for sphere in report["spheres"].values()]
    rows = [
        ("spheres measured", f"{len(report['spheres'])} of {len(report['spheres']) + len(report['not_measured'])}"),
        ("sphere-spacing error, max of all pairs, um", f"{report['spacing_max_um']:.1f}"),
        ("sphere-spacing error, RMS, um", f"{report['spacing_rms_um']:.1f}"),
        ("scale, ppm", f"{report['scale_ppm']:+.0f}"),
        ("RMS without scale, um", f"{report['spacing_rms_without_scale_um']:.1f}"),
        *((f"{name}, um", f"{error:+.1f}") for name, error in named.items()),
        ("form error of the worst sphere, RMS, um", f"{max(form):.1f}"),
        ("size error (diameter), mean, um", f"{sum(size) / len(size):+.1f}"),
        ("for comparison, with a best fit: mean abs. deviation, um", f"{trueness['mean_abs_um']:.1f}"),
        ("images to mesh, s", f"{result['images_to_mesh']['wall_s']:.0f}"),
    ]
    return "\n".join(
        ["Spheres fitted to the scan; all distances between their centres, no best fit (docs/sphere-arch.md).", ""]
        + [markdown_table(("figure", "value"), rows)]
    )


def prepared(results: Sequence[Result]) -> str:
    """The thesis' reference model in the form of its Table 3.2, and the margins."""
    by_case, arch = {result["case"]: result for result in results}, "prepared-arch"
    rows = []
    for row in TABLE_3_2:
        if row.result in by_case:
            found = value_at(by_case[row.result], row.path)
            ours = (found["min_um"], found["max_um"], found["mean_abs_um"], found["std_abs_um"], found["p95_um"])
            printed = "/".join(f"{value:g}" for value in (row.min_um, row.max_um, row.mean_um, row.std_um))
            rows.append((f"{row.part}, {row.what}", row.tooth or "all", printed, *(f"{figure:.1f}" for figure in ours)))
    head = ("part", "FDI", "thesis min/max/mean/SD", "min", "max", "mean", "SD", "P95")
    margins = [
        (result["case"], tooth, *_margin(entry))
        for result in results
        for tooth, entry in result.get("margins", {}).items()
        if result["case"] in (f"prepared-{tooth}", f"all-round-{tooth}", arch)
    ]
    margin_head = ("scan", "FDI", "evaluated %", "found %", "mean", "SD", "P95", "max", "outward", "detector's floor")
    return "\n".join(
        [
            "Absolute deviations in um of all points of the scan on the tooth; 120 images for a tooth"
            + (f", {by_case[arch]['images']} for the arch" if arch in by_case else "")
            + " (the thesis measured line distances at few points).",
            "",
            markdown_table(head, rows),
            "",
            "Margins in um: distance of the edge in the scan from the true margin line, in sections across it; "
            "`outward` is negative where the edge is rounded off (docs/preparations.md).",
            "",
            markdown_table(margin_head, margins),
        ]
    )


def _margin(entry: Result) -> list[str]:
    found = entry["scan"]
    figures = [entry["evaluated_pct"], *(found[f"{name}"] for name in ("found_pct", "mean_um", "std_um", "p95_um"))]
    figures += [found["max_um"], found["outward_um"], entry["floor"]["mean_um"]]
    return ["-" if figure is None else f"{figure:.1f}" for figure in figures]


def measured(result: Result) -> str:
    """Arch dimensions of phantoms and of real jaws."""
    rows = [
        (
            f"{arch}, {kind}",
            *(
                mark(found[f"{name}_{kind}_worst_mm"], 0.05 if kind == "given" else 0.5)
                if f"{name}_{kind}_worst_mm" in found
                else "-"
                for name in "abcf"
            ),
        )
        for arch, found in result["phantom_summary"].items()
        for kind in ("given", "estimated")
    ]
    real = [
        (group["group"], group["jaws"], *(_spread(group[f"{n}_mean_mm"], group[f"{n}_sd_mm"]) for n in "abcf"))
        for group in result["real"]["groups"]
    ]
    flags = [f"- {name}: {', '.join(why)}" for name, why in result["real"]["beyond_3_sd_of_table_2_1"].items()]
    return "\n".join(
        [
            "Worst error in mm over the phantoms, with landmarks given (bar 0.05) or estimated from tooth labels "
            f"(bar 0.5); meshes with edges of {result['phantom_edge_mm']} mm:",
            "",
            markdown_table(("arch, landmarks", "a", "b", "c", "f"), rows),
            "",
            f"Twenty real intra-oral scans with estimated landmarks, mean ± SD in mm; not measured: "
            f"{len(result['real']['failures'])}.",
            "",
            markdown_table(("group", "jaws", "a", "b", "c", "f"), real),
            "",
            "More than 3 SD from Table 2.1 of the thesis:",
            "",
            *flags,
        ]
    )


def landmarks(result: Result) -> str:
    """Estimated landmarks against those that phantoms know and that people set."""
    real, phantoms = result["real"], result["phantoms"]
    kinds = [
        (kind, found["count"], *(f"{found[f'{name}_mm']:.2f}" for name in ("median", "p90")), found["over_stated"])
        for kind, found in phantoms["kinds"].items()
    ]
    arches = [
        (
            name,
            found["count"],
            *(f"{found[f'{figure}_mm']:.2f}" for figure in ("median", "p90")),
            f"{found['beyond_1_mm_pct']:.0f}",
            *(f"{found['widths'][width]:+.2f}" for width in real["widths"]),
        )
        for name, found in real["arches"].items()
    ]
    total, held, sure = real["all"], real["looked_at_only_at_the_end"], real["without_those_in_doubt"]
    doubts = "; ".join(f"{label}: {why}" for label, why in real["in_doubt"].items())
    return "\n".join(
        [
            f"Six real arches with landmarks that people set: {total['count']} are the same points as ours. Median "
            f"{mark(total['median_mm'], 0.35)} mm (bar 0.35), P90 {mark(total['p90_mm'], 1.0)} mm (bar 1.0), "
            f"{total['beyond_1_mm_pct']:.0f} % beyond 1 mm; error over stated uncertainty {total['over_stated']:.1f}. "
            f"On those that were looked at only at the end: {held['median_mm']:.2f} and {held['p90_mm']:.2f} mm, "
            f"error over stated uncertainty {held['over_stated']:.1f}. Widths, median error in mm (bars 0.5, largest "
            f"1.2): {_widths(real['widths'])}. Not counted, as they do not lie on their tooth: "
            f"{', '.join(real['not_on_their_tooth']) or 'none'}.",
            "",
            f"Counted, but pictures of the teeth speak against them ({doubts}); without them median "
            f"{sure['median_mm']:.2f}, P90 {sure['p90_mm']:.2f} mm, error over stated uncertainty "
            f"{sure['over_stated']:.1f}; {_widths(sure['widths'])}.",
            "",
            markdown_table(("arch", "points", "median mm", "P90 mm", "> 1 mm, %", *real["widths"]), arches),
            "",
            f"{2 * phantoms['seeds']} phantoms with edges of {' and '.join(map(str, phantoms['edges_mm']))} mm; over "
            f"all points the error is {phantoms['all']['over_stated']:.2f} times the stated uncertainty, which is "
            "that of real teeth:",
            "",
            markdown_table(("point", "count", "median mm", "P90 mm", "error / stated"), kinds),
        ]
    )


def orientation(result: Result) -> str:
    """Whole jaws and quadrants in any pose."""
    jaws, quadrants, limit = result["jaws"], result["quadrants"], f"{result['within_deg']:g}"
    whole = {name: found for name, found in jaws.items() if not found["doubted"]}
    rows = [
        (
            name,
            *(f"{found[angle][figure]:.1f}" for angle in ("tilt_deg", "turn_deg") for figure in ("median", "max")),
            f"{found['doubted']} of {found['poses']}",
            {None: "-", True: "yes", False: "**no**"}[found["labels_agree"]],
        )
        for name, found in jaws.items()
    ]
    halves = {
        name: [each for each in quadrants.values() if each["looked_at_only_at_the_end"] == at_the_end]
        for name, at_the_end in (("looked at", False), ("looked at only at the end", True))
    }
    off = max((found[angle]["max"] for found in whole.values() for angle in ("tilt_deg", "turn_deg")), default=0.0)
    undoubted = sum(found["wrong_undoubted"] for found in (*jaws.values(), *quadrants.values()))
    return "\n".join(
        [
            f"{len(jaws)} jaws of other people, each in {max(each['poses'] for each in jaws.values())} poses, against "
            f"how they come out as their file has them, in degrees. The {len(whole)} that are never doubted are "
            f"{off:.1f} off at most. More than {limit} off and not doubted: {mark(undoubted, 0, 0)} (bar 0), quadrants "
            "included.",
            "",
            markdown_table(
                ("jaw", "tilt", "largest", "turn", "largest", "doubted", "crowns up and front first by labels"), rows
            ),
            "",
            *([f"These are of commit {result['jaws_of_commit']}.", ""] if "jaws_of_commit" in result else []),
            "Quadrants cut from those with labels, 3 mm of gum around them, against the jaw that they are of; all are "
            "to be doubted in one line:",
            "",
            markdown_table(
                ("quadrants", "poses", "tilt", "largest", "turn", "largest", f"> {limit} off", "doubted"),
                [_quadrant_row(name, found) for name, found in halves.items() if found],
            ),
        ]
    )


def _quadrant_row(name: str, found: Sequence[Result]) -> tuple[object, ...]:
    poses = sum(each["poses"] for each in found)
    figures = (
        f"{figure([each[angle][which] for each in found]):.1f}"
        for angle in ("tilt_deg", "turn_deg")
        for which, figure in (("median", median), ("max", max))
    )
    counts = (f"{sum(each[which] for each in found)} of {poses}" for which in ("wrong", "doubted"))
    return (f"{len(found)}, {name}", poses, *figures, *counts)


def _widths(widths: Mapping[str, Mapping[str, float]]) -> str:
    return ", ".join(
        f"{name.replace('_', '-')} {found['median_abs_mm']:.2f} (largest {found['max_abs_mm']:.2f})"
        for name, found in widths.items()
    )


def _spread(mean: float | None, sd: float | None) -> str:
    if mean is None:
        return "-"
    return f"{mean:.1f}" + ("" if sd is None else f" ± {sd:.1f}")


def populations(result: Result) -> str:
    """Drawn populations, measured."""
    rows = []
    for group, found in result["groups"].items():
        cells = []
        for name in "abcf":
            entry = found[name]
            asked = entry.get("table") or entry.get("source")
            printed = f"{asked['mean_mm']:.2f} ± {asked['sd_mm']:.2f}: " if asked else ""
            cells.append(f"{printed}{entry['measured']['mean_mm']:.2f} ± {entry['measured']['sd_mm']:.2f}")
        again = f"{100 * found['share_drawn_again']:.0f} %"
        rows.append((group, found["jaws"], *cells, again, mark(found["max_abs_asked_minus_measured_mm"], 0.05, 3)))
    build = result["build"]
    return "\n".join(
        [
            "Mean ± SD in mm, of the distribution drawn from (before the colon) and as measured (after it):",
            "",
            markdown_table(("group", "jaws", "a", "b", "c", "f", "redrawn", "worst, requested - measured"), rows),
            "",
            f"Building a phantom of {build['faces']:,} faces takes {build['cpu_s']} CPU-s.",
        ]
    )


def mean_shape(result: Result) -> str:
    """The mean of many phantoms, from two different first samples."""
    population, known = result["population"], result["known_mean"]
    rows = [
        (name, mark(run["wall_s"], 600, 0), run["cpu_s"], mark(run["peak_gib"], 4), run["rounds"], run["converged"])
        for name, run in ((first, population[f"first_{first}"]) for first in ("00", "01"))
    ]
    head = ("first sample", "wall s (bar 600)", "CPU s", "peak GiB (bar 4)", "rounds", "converged")
    apart, teeth = (population["surfaces_apart"]["00_to_01"][part] for part in ("all", "teeth"))
    mean_to_known = known["mean_to_known_mean"]["all"]
    angles = ", ".join(f"{angle:.1f}" for angle in known["largest_angle_between_modes_deg"])
    return "\n".join(
        [
            f"The mean of {population['count']} phantoms of {population['group']} with edges of "
            f"{population['edge_mm']} mm (about 200,000 faces each), from two different first samples:",
            "",
            markdown_table(head, rows),
            "",
            f"The two means are {_quantiles(apart)} apart, on the teeth {_quantiles(teeth)}; their landmarks are at "
            f"most {population['landmarks_apart_um']:.2g} um apart. With a known mean and {known['count']} remeshed "
            f"samples, the mean found is {_quantiles(mean_to_known)} from it; the angles between known and found modes "
            f"are {angles} deg.",
        ]
    )


def _quantiles(found: Result) -> str:
    return f"{found['median_um']:.1f} um (median) and {found['p95_um']:.0f} um (P95)"


def mouth(result: Result) -> str:
    """Whom 12 mm fit."""
    rows = [
        (
            study,
            sex,
            "second molar" if position == "7" else "first molar",
            f"{entry['gap_mm']['p50']:.1f} ({entry['gap_mm']['p5']:.1f}-{entry['gap_mm']['p95']:.1f})",
            f"{entry['fit_pct']:.1f}",
            f"{entry['fit_vertical_pct']:.1f}",
        )
        for study, groups in result["studies"].items()
        for sex, teeth in groups.items()
        for position, entry in teeth.items()
    ]
    head = ("openings", "sex", "tooth", "L: median (5-95 %), mm", "L fits, %", "V fits, %")
    return "\n".join(
        [f"A handpiece that needs {result['needed_mm']:g} mm, for {result['people']:,} people drawn of each sex:", ""]
        + [markdown_table(head, rows)]
    )


_LONGEST_PLAN_S = 60.0
_JAW_COLUMNS = {
    "faces": "faces",
    "frames": "frames",
    "planning s": "plan_s",
    "smallest overlap %": "minimum_overlap_pct",
    "open crown that two cameras see %": "seen_pct",
    "frames located": "located",
    "trajectory, RMSE um": "trajectory_um",
    "mean um": "mean_um",
    "P95 um": "p95_um",
    "mean of everything um": "everything_mean_um",
    "of what could be seen, within 50 um %": "seen_complete_50_um_pct",
    "of open crown, within 50 um %": "crown_complete_50_um_pct",
    "inter-molar um": "inter_molar_um",
    "images to mesh, CPU s": "reconstruction_cpu_s",
    "peak GB": "peak_gb",
    "commit": "commit",
}


def jaws(result: Result) -> str:
    """Real jaws and parts of them, each scanned without options of its own."""
    scans = result["scans"]
    planned = [scan for scan in scans.values() if scan["failure"] is None]
    return "\n".join(
        [
            f"{len(scans)} of {result['cases']} cases were tried{_at(planned)}; {len(planned)} finished. A name with "
            "*smooth* stands for a coarse jaw after two Loop subdivisions; quadrants, single teeth and jaws with gaps "
            "are cut from smooth ones, rotated at random and without labels. Twelve cameras, seed 0; bar for planning: "
            f"{_LONGEST_PLAN_S:g} s; machine load at the end: {result['load'][0]:g}. "
            "`python benchmarks/jaws.py`.",
            "",
            _scans_table(scans),
        ]
    )


def _commits(scans: Iterable[Result]) -> set[str]:
    """Those that scans are of."""
    return {str(scan["commit"]) for scan in scans if scan.get("commit")}


def _at(scans: Iterable[Result]) -> str:
    """Where all are of one commit, which."""
    commits = _commits(scans)
    return f" (at commit {commits.pop()})" if len(commits) == 1 else ""


def _scans_table(scans: Mapping[str, Result]) -> str:
    """A row of figures for each scan; with its commit, where not all are of one."""
    heads = [head for head, key in _JAW_COLUMNS.items() if any(key in scan for scan in scans.values())]
    if len(_commits(scans.values())) == 1:
        heads.remove("commit")
    rows = [
        (name, *(_jaw_figure(scan, _JAW_COLUMNS[head]) for head in heads), scan["failure"] or scan.get("notes") or "")
        for name, scan in scans.items()
    ]
    return markdown_table(("jaw", *heads, "failure or note"), rows)


def enamel(result: Result) -> str:
    """Teeth and arches without texture, under several kinds of light."""
    told = {name: {**scan, "notes": ""} for name, scan in result["scans"].items()}
    return "\n".join(
        [
            "One tooth each or, where the name begins with *arch*, a whole arch in one pass; twelve cameras of "
            "500 x 500 px, texture `enamel` (plain, glossy and wet), noise 1.5 DN. "
            "Three colour-coded LEDs about each group, behind crossed polarisers (3 % of mirror reflections pass), "
            "except: *glossy* colour-coded without polarisers, *in-turn* six of them in turn, without polarisers, "
            "*white-crossed* four white LEDs a group behind polarisers, *white* without; *pairs* two of the four "
            "cameras of each group, 2.5 mm apart; *as-texture* the images of phantom-0, located by keypoints and "
            "matched by correlation, as textured teeth are, *colmap* the same with the motion of COLMAP's mapper. "
            "*clinical* has `--optics clinical` (defocus and diffraction, motion during the exposure, light below the "
            "surface, saliva, crosstalk, Bayer, JPEG), *dense* 20 frames instead of 10; "
            "*natural* has the texture `natural` (stains, fillings, vessels), *cross* also a sweep to the other side; "
            "*artificial-clinical* has these optics, white light, and the texture `artificial`. Bars: under "
            "colour-coded, polarised light a mean of 6 um (clinical 10 um) with 94 % within 50 um, in turn 12 um; "
            "artificial-clinical 4 um; of arches 20 um (clinical 30 um, in turn 35 um, artificial-clinical 6 um) and "
            "an inter-molar error of 40 um (clinical 60 um, in turn 70 um). Developed "
            "on phantom-0, ideal and clinical, on 048_lower, with which the places of the LEDs were chosen, too, on "
            "023_lower, and on arch-upper, ideal and clinical, and arch-phantom for paths; a limit was chosen with "
            "phantom-1 in view; the others were looked at only at the end, but most also with earlier versions. Real "
            "jaws that are *clinical*, and the arches of phantoms 1 and 2, were scanned once, at the end. "
            "`python benchmarks/enamel.py`.",
            "",
            _scans_table(told),
        ]
    )


def plain_frames(result: Result) -> str:
    """Single frames of plain enamel, and single steps between them."""
    return "\n".join(
        [
            "Sixteen frames of twelve cameras over each tooth, 1 mm apart, texture `enamel`, colour-coded LEDs behind "
            "crossed polarisers. Of all pixels that see the jaw in the range of depth: depth by light and shade, and "
            "beside it OpenCV's StereoSGBM of the widest pair of each group, rectified at full resolution, checked "
            "both ways. *Per cosine*: by how much depths change, as errors, with the cosine between line of sight and "
            "normal; below 0, oblique surfaces come out too far. Steps: each frame laid onto the next from its true "
            "place; mean of what they are off by and its standard error, which is chance, in the frame of the "
            "handpiece (x along the arch, z up): what differs from 0 by more bends an arch. "
            "`python benchmarks/plain_frames.py`.",
            "",
            markdown_table(
                (
                    *("tooth", "depth, %", "within 50 um, %", "median, um", "per cosine, um"),
                    *("SGBM: depth, %", "within 50 um, %", "median, um"),
                    *("steps: turn about z, mrad", "pitch about y, mrad", "along x, um", "failure"),
                ),
                [
                    (
                        name,
                        *(_jaw_figure(scan, key) for key in _PLAIN_FRAME),
                        *(_mean_and_error(scan, step) for step in ("turn_z", "pitch_y", "along_x")),
                        scan["failure"] or "",
                    )
                    for name, scan in result["scans"].items()
                ],
            ),
        ]
    )


_PLAIN_FRAME = (
    *("known_pct", "within_50_um_pct", "median_um", "per_cosine_um"),
    *("sgbm_known_pct", "sgbm_within_50_um_pct", "sgbm_median_um"),
)


def _mean_and_error(scan: Result, step: str) -> str:
    mean, error = scan.get(f"step_{step}"), scan.get(f"step_{step}_error")
    return "" if mean is None else f"{mean:+.2f} ± {error:.2f}"


def real_gloss(result: Result) -> str:
    """Photographs of a ball whose lights and normals are known."""
    ways = {
        "as if it were matte": "matte_deg",
        "without the brightest and the darkest fifth of the lights": "trimmed_deg",
        "where the model trusts the brightness": "weighted_deg",
        "there, with the modelled reflections taken off": "taken_off_deg",
    }
    return "\n".join(
        [
            "The model of mirror reflections, with the values of wet enamel, on 96 photographs of a ball (DiLiGenT, "
            "not part of the project), each under one known light: normals by least squares against the true ones. "
            f"The model distrusts {result['distrusted_pct']:.0f} % of the lit pixels, and "
            f"{result['distrusted_of_shiny_pct']:.0f} % of the {result['shiny_pct']:.1f} % that are brighter than 1.2 "
            "times what is matte. "
            "`python benchmarks/real_gloss.py`.",
            "",
            markdown_table(
                ("brightness used", "mean error of normals, deg"),
                [(way, f"{result[key]:.2f}") for way, key in ways.items()],
            ),
        ]
    )


def _jaw_figure(scan: Result, key: str) -> str:
    value = scan.get(key)
    if value is None:
        return ""
    if key == "plan_s":
        return mark(value, _LONGEST_PLAN_S, 1)
    if key == "commit":
        return str(value)[:7]
    return f"{value:,}" if isinstance(value, int) else f"{value:.1f}"
