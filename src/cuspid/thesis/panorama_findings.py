"""Chapter 4: normal maps, the examination of frames, panoramas."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from cuspid.thesis.catalogue import Item
from cuspid.thesis.findings import (
    CHECKED,
    PANORAMA,
    Finder,
    Finding,
    Result,
    Results,
    Table,
    compare,
    vanishes,
)
from cuspid.thesis.rules import AtLeast, Comparison, Exceeds, Holds

SUBJECTS = 10
"""Of Fig 4.4."""


def _fig_4_1(item: Item, results: Results) -> Finding:
    def more(one: str, other: str, claim: str, because: str) -> Comparison:
        return compare(
            results,
            CHECKED,
            lambda found: (
                found["normal_map_features"][f"{one}_matches"] > found["normal_map_features"][f"{other}_matches"]
            ),
            quantity=claim,
            printed="yes",
            rule=Holds(
                text="reproduced: more matches between consecutive frames agree with a homography; else it differs"
            ),
            because=because,
            shown=lambda found: "{:.0f} against {:.0f} matches".format(
                *(found["normal_map_features"][f"{name}_matches"] for name in (one, other))
            ),
        )

    rows = (
        vanishes(results, "normals", "residual", "normal map against the normals that it is made of", limit=1e-6),
        more("kaze_normal_map", "sift_normal_map", "on normal maps KAZE finds more than SIFT", ""),
        more(
            "kaze_normal_map",
            "kaze_grey",
            "KAZE finds more on normal maps than on the frames",
            "the frames of our enamel have highlights and shading on which KAZE finds even more; they move with the "
            "light, so more matches need not be better ones",
        ),
        more("kaze_normal_map", "sift_grey", "KAZE on normal maps finds more than SIFT on the frames", ""),
    )
    return Finding(item=item, comparisons=rows, notes=("Three pairs of frames of a film over plain enamel.",))


def _fig_4_2(item: Item, results: Results) -> Finding:
    row = compare(
        results,
        CHECKED,
        lambda found: found["free_path"]["unrestricted_height_sd_mm"] > found["free_path"]["restricted_height_sd_mm"],
        quantity="height of the camera over the occlusal plane varies more on the unrestricted path",
        unit="mm",
        printed="yes",
        rule=Holds(text="reproduced: the SD of the height is the larger one; else it differs"),
        shown=lambda found: "SD {unrestricted_height_sd_mm:.2f} against {restricted_height_sd_mm:.2f}".format(
            **found["free_path"]
        ),
    )
    note = "How far the thesis' camera strayed is not told; our hand is in docs/panorama-evaluation.md."
    return Finding(item=item, comparisons=(row,), notes=(note,))


def _fig_4_3(item: Item, results: Results) -> Finding:
    expected = {
        "translation": ("translation",),
        "shearing": ("corner angle",),
        "scale_and_translation": ("translation", "scale"),
        "small_motion": ("",),
    }
    rows = tuple(_refused(results, name, tests) for name, tests in expected.items())
    note = (
        "Limits: corner angles of 80 to 110 deg, translation of 10 % of the frame. The third, 'ratio of the scale and "
        "translation together ... not less than 0.85 and not more than 5 %', contradicts the second and is read as a "
        "scale between 0.85 and 1/0.85."
    )
    return Finding(item=item, comparisons=rows, notes=(note,))


def _refused(results: Results, name: str, tests: tuple[str, ...]) -> Comparison:
    return compare(
        results,
        CHECKED,
        lambda found: tuple(found["rejections"][name].split("; ")) == tests,
        quantity=f"tests that refuse a frame with {name.replace('_', ' ')}",
        printed=", ".join(tests) or "none",
        rule=Holds(text="reproduced: refused by these tests and by no other; else it differs"),
        shown=lambda found: found["rejections"][name].replace(";", ",") or "none",
    )


def panoramas(results: Results, method: str) -> dict[str, Result]:
    """By subject."""
    end = f"-{method}"
    found = {
        name.removeprefix(PANORAMA): result
        for name, result in results.items()
        if name.startswith(PANORAMA) and result.get("method") == method
    }
    return {name.removesuffix(end): result for name, result in sorted(found.items())}


def canvas_ssim(result: Result) -> float:
    """SSIM over the whole canvas as it is, the thesis' measure; 0 where there is no panorama."""
    score = result.get("score")
    picture = None if score is None or result.get("failure") else score.get("picture")
    return 0.0 if picture is None else float(picture["ssim_full"])


_OURS = {"ortho": "our default method", "thesis": "the thesis' method"}


def _fig_4_4(item: Item, results: Results) -> Finding:
    rows = [row for method in _OURS for row in (_least_ssim(results, method), _subjects(results, method))]
    notes = [
        "The thesis' measure, SSIM over the whole canvas, is nearly empty: see what a constant grey in the outline of "
        "the jaw scores. SSIM and ZNCC on the teeth, the share of the teeth that is shown and the geometric error say "
        "more (docs/panorama-evaluation.md).",
        "Panoramas are laid over the truth by a similarity (the thesis: rigidly, in the scale that it took for given). "
        "Subjects are filmed by a shaky hand over plain enamel, 120 frames; a panorama in parts counts with its "
        "largest part, one that failed with 0.",
    ]
    return Finding(item=item, comparisons=tuple(rows), notes=tuple(notes), table=_panorama_table(results))


def _least_ssim(results: Results, method: str) -> Comparison:
    found = panoramas(results, method)
    scores = {name: canvas_ssim(result) for name, result in found.items()}
    failed = [name for name, result in found.items() if result.get("failure")]
    return Comparison(
        quantity=f"least SSIM (canvas) of the subjects, {_OURS[method]}",
        printed="more than 0.70",
        ours=min(scores.values()) if scores else None,
        rule=Exceeds(thesis=0.70),
        because=_why(scores, failed),
        shown=f"{min(scores.values()):.2f} (median {np.median(list(scores.values())):.2f})" if scores else "",
        source=f"{PANORAMA}*-{method}",
        quick=any(result.get("quick") for result in found.values()),
    )


def _why(scores: Mapping[str, float], failed: Sequence[str]) -> str:
    if failed:
        return f"no panorama of {', '.join(failed)}"
    return f"the least is that of {min(scores, key=scores.__getitem__)}" if scores else ""


def _subjects(results: Results, method: str) -> Comparison:
    found = panoramas(results, method)
    full = len(found) >= SUBJECTS
    return Comparison(
        quantity=f"subjects, {_OURS[method]}",
        printed=f"{SUBJECTS}",
        ours=float(len(found)) if full else None,
        rule=AtLeast(limit=float(SUBJECTS)),
        shown=f"{len(found)}" if found else "",
        source=f"{PANORAMA}*-{method}",
    )


def _panorama_table(results: Results) -> Table | None:
    head = (
        "subject",
        "method",
        "SSIM canvas",
        "grey outline scores",
        "SSIM teeth, fitted",
        "ZNCC teeth",
        "teeth shown, %",
        "error median, mm",
        "P95, mm",
    )
    rows = [
        _panorama_row(name.removeprefix(PANORAMA).removesuffix(f"-{result['method']}"), result)
        for name, result in sorted(results.items())
        if name.startswith(PANORAMA)
    ]
    return (head, tuple(rows)) if rows else None


def _panorama_row(subject: str, result: Result) -> tuple[str, ...]:
    score = result.get("score") or {}
    method = f"{result['method']}{' (quick)' if result.get('quick') else ''}"
    picture, geometry = score.get("picture"), score.get("geometry")
    if result.get("failure") or picture is None:
        return (subject, method, f"failed: {result.get('failure')}", *("-",) * 6)
    grey = score["trivial"]["grey jaw"]["ssim_full"]
    errors = ("-", "-") if geometry is None else (f"{geometry['median_mm']:.2f}", f"{geometry['p95_mm']:.2f}")
    return (
        subject,
        method,
        f"{picture['ssim_full']:.2f}",
        f"{grey:.2f}",
        f"{picture['ssim_teeth_fitted']:.2f}",
        f"{picture['zncc']:.2f}",
        f"{score['coverage_pct']:.0f}",
        *errors,
    )


WITHOUT = "thesis-unexamined"
"""Method of Fig 4.5 (d)."""


_STITCHERS = ("opencv-scans", "opencv-panorama")


def _fig_4_5(item: Item, results: Results) -> Finding:
    rows = (
        _examined_better(results, "SSIM (canvas)", lambda result: canvas_ssim(result), 1),
        _examined_better(results, "median error, mm", _median_error_mm, -1),
        _beats_stitcher(results),
    )
    notes = (
        "Means over the subjects for which both were run; our films, which are not the thesis'.",
        "OpenCV's Stitcher is run by `python benchmarks/panorama.py --method opencv-panorama opencv-scans` alone.",
    )
    return Finding(item=item, comparisons=rows, notes=notes)


def _median_error_mm(result: Result) -> float:
    geometry = (result.get("score") or {}).get("geometry")
    return float("nan") if geometry is None else float(geometry["median_mm"])


def _examined_better(results: Results, what: str, figure: Callable[[Result], float], sign: int) -> Comparison:
    examined, plain = panoramas(results, "thesis"), panoramas(results, WITHOUT)
    pairs = np.array([[figure(examined[name]), figure(plain[name])] for name in examined if name in plain])
    pairs = pairs.reshape(-1, 2)[np.isfinite(pairs.reshape(-1, 2)).all(axis=1)]
    means = pairs.mean(axis=0) if len(pairs) else None
    return Comparison(
        quantity=f"{what}: better with the examination than without, the thesis' method",
        printed="much better",
        ours=None if means is None else bool(sign * (means[0] - means[1]) > 0),
        rule=Holds(text="reproduced: the mean over the subjects is the better one; else it differs"),
        because="errors add up along the chain of homographies, which the examination cannot help; frames that it "
        "leaves out break the panorama (docs/panorama-thesis.md)",
        shown="" if means is None else f"{means[0]:.2f} with, {means[1]:.2f} without, {len(pairs)} subject(s)",
        source=f"{PANORAMA}*-{WITHOUT}",
        quick=any(result.get("quick") for result in plain.values()),
    )


def _beats_stitcher(results: Results) -> Comparison:
    ours = panoramas(results, "ortho")
    others = {method: panoramas(results, method) for method in _STITCHERS}
    pairs = [
        (canvas_ssim(ours[name]), max(canvas_ssim(found[name]) for found in others.values() if name in found))
        for name in ours
        if any(name in found for found in others.values())
    ]
    won = sum(one > other for one, other in pairs)
    return Comparison(
        quantity="subjects for which our default method has a larger SSIM (canvas) than OpenCV's Stitcher (the better "
        "mode)",
        printed="outperforms automatic stitching",
        ours=won == len(pairs) if pairs else None,
        rule=Holds(text="reproduced: for all subjects; else it differs"),
        shown=f"{won} of {len(pairs)}" if pairs else "",
        source=f"{PANORAMA}*-{_STITCHERS[0]}",
    )


FINDERS: Mapping[str, Finder] = MappingProxyType(
    {
        "fig-4.1": _fig_4_1,
        "fig-4.2": _fig_4_2,
        "fig-4.3": _fig_4_3,
        "fig-4.4": _fig_4_4,
        "fig-4.5": _fig_4_5,
    }
)
"""By item."""
