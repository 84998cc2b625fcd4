"""Section of the pages of results on panoramas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from anatomy_sections import mark, markdown_table

Result = Mapping[str, Any]

ONE_CAMERA = {
    "ortho": "One pass along the arch",
    "cusps": "The same panoramas, scaled by the distance of two cusps, read to half a millimetre (`cusps`)",
    "callipers": "The same films, and the width of the arch over the teeth, read to half a millimetre (`callipers`)",
    "return": "There and back again (`return`)",
    "s-shape": "One pass, swung to either side (`s-shape`)",
    "cross": "Along the arch, and straight across to the other side (`cross`)",
    "natural": "One pass over teeth with what real ones bear (`natural`)",
    "natural-return": "There and back again over such teeth (`natural-return`)",
}
"""What the films of one camera show, by the method that takes them."""
METHODS = (*ONE_CAMERA, "pair", "thesis", "thesis-unexamined", "opencv-panorama", "opencv-scans")
MEDIAN_MM, ALL_MEDIAN_MM, P95_MM, SSIM_TEETH, SSIM_CANVAS, SCALE_PCT, WALL_S = 0.1, 0.2, 0.5, 0.80, 0.93, 2.0, 45.0
"""Bars for one camera: greatest errors (the median, in most films and in all), least likeness; and for all, the longest
time."""
PAIR_MEDIAN_MM, PAIR_MOLARS_MM = 0.05, 0.15
"""Bars for two cameras."""
LOOKED_AT = frozenset(
    {"lower-14-0", "upper-14-0", "001_lower", "005_upper"}
    | {"014_lower", "014_upper", "lower-12-0", "lower-14-1", "upper-12-1"}
)
"""Subjects on which two cameras were developed; the others were looked at only at the end."""


def panoramas(results: Sequence[Result]) -> str:
    """All methods side by side, then one camera, path by path and subject by subject, and two cameras."""
    by_method = {name: [each for each in results if each["method"] == name] for name in METHODS}
    return "\n".join(
        [
            "Phantoms of the population and real jaws (`benchmarks/panorama.py`), each filmed in 120 frames of "
            "640 x 480 px with full hand shake, texture `enamel`; `pair` is the default method on the film of two "
            "cameras 5 mm apart, `return`, `s-shape` and `cross` on a film of that path, `natural` on one of teeth "
            "with what real ones bear (texture `natural`); `callipers` is told the width of the arch; `cusps` is "
            "`ortho`, scaled by `cuspid pano rescale` (whose times it tells) to the distance between two cusps. "
            "docs/panorama-evaluation.md explains the figures. *No arch* counts the panoramas that failed: too few "
            "frames, collapsed, or nowhere near the "
            "jaw. Medians are over those that did not fail.",
            "",
            markdown_table(
                (
                    *("method", "subjects", "no arch", "complete", "frames placed, %", "error: median mm", "P95 mm"),
                    *("scale, % off", "inter-molar, mm off", "SSIM teeth, fitted", "SSIM canvas, as it is", "CPU-s"),
                ),
                [method_row(name, rows) for name, rows in by_method.items() if rows],
            ),
            "",
            *paths({name: by_method[name] for name in ONE_CAMERA if by_method[name]}),
            "",
            f"One camera, subject by subject. Bars: median {MEDIAN_MM} mm, P95 {P95_MM} mm, SSIM on teeth "
            f"{SSIM_TEETH}, on the canvas {SSIM_CANVAS}, scale within {SCALE_PCT:.0f} %, {WALL_S:.0f} s on 2 cores, "
            "complete, in one part. For a fitted SSIM, one gain and offset (on the canvas: a gain) is removed first; "
            "`grey jaw` is the score of constant grey in the outline of the jaw. *Shared*: other work had more than "
            "half of the machine, so that the wall time is not judged.",
            *(line for name, told in ONE_CAMERA.items() if by_method[name] for line in singles(told, by_method[name])),
            *pairs(by_method["pair"]),
        ]
    )


def paths(by_method: Mapping[str, Sequence[Result]]) -> list[str]:
    """What each way over the arch brings to one camera, and how often it is truer than a single pass."""
    heads = (
        *("film", "films", "error: median mm, over the films (least-greatest)", "P95 mm, likewise"),
        *(f"median within {limit} mm" for limit in (MEDIAN_MM, ALL_MEDIAN_MM)),
        *(f"scale within {SCALE_PCT:.0f} %", "complete", "median below that of one pass"),
    )
    pass_of = {each["subject"]: each for each in by_method.get("ortho", ())}
    return [
        "One camera: what a path brings. The bar is a median within the first limit in eighteen of twenty films, and "
        "within the second in all.",
        "",
        markdown_table(heads, [path_row(name, results, pass_of) for name, results in by_method.items()]),
    ]


def path_row(name: str, results: Sequence[Result], pass_of: Mapping[str, Result]) -> list[str]:
    """One path; films without an arch are within no limit."""
    errors = {each["subject"]: at(each["score"], ("geometry", "median_mm")) for each in results}
    tails = [at(each["score"], ("geometry", "p95_mm")) for each in results]
    scales = [at(each["score"], ("geometry", "scale_error_pct")) for each in results]
    ours = {subject: error for subject, error in errors.items() if error is not None}
    theirs = {subject: at(each["score"], ("geometry", "median_mm")) for subject, each in pass_of.items()}
    both = [(ours[subject], error) for subject, error in theirs.items() if error is not None and subject in ours]
    return [
        *(f"`{name}`", str(len(results)), spread(list(ours.values())), spread([each for each in tails if each])),
        *(str(sum(error <= limit for error in ours.values())) for limit in (MEDIAN_MM, ALL_MEDIAN_MM)),
        str(sum(each is not None and abs(each) <= SCALE_PCT for each in scales)),
        str(sum(bool(each["score"] and each["score"]["complete"]) for each in results)),
        "-" if name in ("ortho", "cusps") else f"{sum(own < other for own, other in both)} of {len(both)}",
    ]


def spread(values: Sequence[float]) -> str:
    """The median with the least and the greatest."""
    return f"{median(values):.2f} ({min(values):.2f}-{max(values):.2f})" if values else "-"


def singles(told: str, results: Sequence[Result]) -> list[str]:
    """One camera, subject by subject."""
    heads = (
        *("subject", "frames", "parts", "complete", "median mm", "P95 mm", "SSIM teeth", "grey jaw"),
        *("SSIM canvas", "grey jaw", "ZNCC teeth", "inter-molar mm", "scale %", "wall s", "CPU-s", "GiB"),
    )
    return ["", f"{told}:", "", markdown_table(heads, [subject_row(result) for result in results])]


def pairs(results: Sequence[Result]) -> list[str]:
    """Two cameras, subject by subject."""
    if not results:
        return []
    heads = (
        *("subject", "frames", "complete", "median mm", "P95 mm", "tilt deg", "median along it", "inter-molar mm"),
        *("scale %", "teeth shown, %"),
        *("SSIM teeth", "SSIM seen", "grey jaw", "wall s", "CPU-s", "GiB"),
    )
    return [
        "",
        f"Two cameras, subject by subject; the scale is theirs. Bars: median {PAIR_MEDIAN_MM} mm, inter-molar distance "
        f"{PAIR_MOLARS_MM} mm, {WALL_S:.0f} s on 2 cores. *Tilt* is the angle between the directions of the "
        "picture and of the jaw's occlusal frame, beside it the median of the error along the picture's own. SSIM is "
        "fitted; *seen* is what the frames saw of the jaw, and `grey jaw` its score there. Subjects on which the "
        f"method was developed: {', '.join(sorted(LOOKED_AT))}; all others were looked at only at the end.",
        "",
        markdown_table(heads, [pair_row(result) for result in results]),
    ]


def pair_row(result: Result) -> list[str]:
    """One panorama of two cameras."""
    name, score, took = result["subject"], result["score"], result["frames_to_panorama"]
    if result["failure"] is not None or score["geometry"] is None:
        return [name, "-", f"no: {result['failure']}", *["-"] * 10, str(took["wall_s"]), str(took["cpu_s"]), "-"]
    geometry, picture, molars = score["geometry"], score["picture"], score["inter_molar_error_mm"]
    return [
        *(name, f"{score['frames_used']} of {score['frames']}", "yes" if score["complete"] else "**no**"),
        *(mark(geometry["median_mm"], PAIR_MEDIAN_MM, 3), f"{geometry['p95_mm']:.2f}"),
        *(f"{geometry['tilt_deg']:.1f}", f"{geometry['own_median_mm']:.3f}"),
        "-" if molars is None else within(molars, PAIR_MOLARS_MM, 2),
        *(f"{geometry['scale_error_pct']:+.2f}", f"{score['coverage_pct']:.1f}"),
        *(f"{picture['ssim_teeth_fitted']:.2f}", f"{picture['ssim_seen_fitted']:.2f}"),
        f"{score['trivial']['grey jaw']['ssim_seen_fitted']:.2f}",
        *(wall(took), f"{took['cpu_s']:.0f}", f"{took['peak_gib']:.1f}"),
    ]


def method_row(name: str, results: Sequence[Result]) -> list[str]:
    """Medians of a method over the subjects that it made an arch of."""
    made = [result for result in results if result["failure"] is None]

    def middle(*path: str, digits: int = 2) -> str:
        found = [abs(value) for value in (at(result["score"], path) for result in made) if value is not None]
        return f"{median(found):.{digits}f}" if found else "-"

    placed = [100 * share for share in map(placed_share, results) if share is not None]
    return [
        *(f"`{name}`", str(len(results)), str(len(results) - len(made))),
        str(sum(bool(result["score"]["complete"]) for result in made)),
        f"{median(placed):.0f}" if placed else "-",
        *(middle("geometry", key) for key in ("median_mm", "p95_mm", "scale_error_pct")),
        middle("inter_molar_error_mm"),
        *(middle("picture", key) for key in ("ssim_teeth_fitted", "ssim_full")),
        f"{median(result['frames_to_panorama']['cpu_s'] for result in results):.0f}",
    ]


def placed_share(result: Result) -> float | None:
    """Share of the frames that are in the panorama."""
    opencv, score = result.get("opencv"), result.get("score")
    if opencv is not None:
        return len(opencv.get("placed", ())) / opencv["frames"] if opencv.get("frames") else None
    return None if not score else score["frames_used"] / score["frames"]


def subject_row(result: Result) -> list[str]:
    """One panorama of the default method."""
    name, score, took = result["subject"], result["score"], result["frames_to_panorama"]
    if result["failure"] is not None or score["geometry"] is None:
        return [name, "-", "-", f"no: {result['failure']}", *["-"] * 9, str(took["wall_s"]), str(took["cpu_s"]), "-"]
    geometry, picture, grey = score["geometry"], score["picture"], score["trivial"]["grey jaw"]
    inter_molar = score["inter_molar_error_mm"]
    return [
        *(name, f"{score['frames_used']} of {score['frames']}", str(score["parts"])),
        "yes" if score["complete"] else "**no**",
        *(mark(geometry["median_mm"], MEDIAN_MM), mark(geometry["p95_mm"], P95_MM)),
        *(least(picture["ssim_teeth_fitted"], SSIM_TEETH), f"{grey['ssim_teeth_fitted']:.2f}"),
        *(least(picture["ssim_full_fitted"], SSIM_CANVAS), f"{grey['ssim_full_fitted']:.2f}"),
        f"{picture['zncc']:.2f}",
        "-" if inter_molar is None else f"{inter_molar:+.2f}",
        "-" if geometry["scale_error_pct"] is None else within(geometry["scale_error_pct"], SCALE_PCT, 1),
        *(wall(took), f"{took['cpu_s']:.0f}", f"{took['peak_gib']:.1f}"),
    ]


def least(value: float, limit: float) -> str:
    """A figure, marked where it is below the limit."""
    return f"{value:.2f}" if value >= limit else f"**{value:.2f}** (missed)"


def within(value: float, limit: float, digits: int) -> str:
    """A figure with its sign, marked where it is farther from 0 than the limit."""
    return f"{value:+.{digits}f}" if abs(value) <= limit else f"**{value:+.{digits}f}** (missed)"


def wall(took: Mapping[str, float]) -> str:
    """Wall time, judged where the method had more than one core, as it has on a machine of its own."""
    shared = took["wall_s"] > took["cpu_s"]
    return f"{took['wall_s']:.0f} (shared)" if shared else mark(took["wall_s"], WALL_S, 0)


def at(value: Any, path: Sequence[str]) -> Any:
    """What lies at a path of keys, None where a key has nothing."""
    for key in path:
        value = None if value is None else value.get(key)
    return value
