"""Section 4.3: panoramas of ten subjects, of their methods, and with and without the examination."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from cuspid_thesis.page_format import Table
from cuspid_thesis.results import PANORAMA, Result, Results

SUBJECTS = 10
"""Of Fig 4.4."""
EXAMINED, UNEXAMINED = "thesis", "thesis-unexamined"
"""Methods of Fig 4.5 (c) and (d)."""
_STITCHERS = ("opencv-scans", "opencv-panorama")


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


def _median_error_mm(result: Result) -> float:
    geometry = (result.get("score") or {}).get("geometry")
    return float("nan") if geometry is None else float(geometry["median_mm"])


def least_ssim(results: Results, method: str) -> Mapping[str, Any] | None:
    """The least SSIM of the subjects, and whose it is."""
    found = panoramas(results, method)
    if not found:
        return None
    scores = {name: canvas_ssim(result) for name, result in found.items()}
    failed = [name for name, result in found.items() if result.get("failure")]
    worst = min(scores, key=scores.__getitem__)
    because = f"no panorama of {', '.join(failed)}" if failed else f"the smallest is that of {worst}"
    return {"ours": scores[worst], "median": np.median(list(scores.values())), "because": because}


def subjects(results: Results, method: str) -> Mapping[str, Any] | None:
    """How many subjects there are; not run while there are fewer than in the thesis."""
    count = len(panoramas(results, method))
    return {"ours": float(count) if count >= SUBJECTS else None, "count": count} if count else None


def ssim_is_larger_examined(results: Results) -> Mapping[str, Any] | None:
    """Whether the mean SSIM of the subjects is larger with the examination than without."""
    return _with_and_without(results, canvas_ssim, lambda examined, unexamined: examined > unexamined)


def error_is_smaller_examined(results: Results) -> Mapping[str, Any] | None:
    """Whether the mean of their median errors is smaller with the examination than without."""
    return _with_and_without(results, _median_error_mm, lambda examined, unexamined: examined < unexamined)


def _with_and_without(
    results: Results, figure: Callable[[Result], float], better: Callable[[float, float], bool]
) -> Mapping[str, Any] | None:
    """Means over the subjects that have a figure both ways."""
    examined, plain = panoramas(results, EXAMINED), panoramas(results, UNEXAMINED)
    pairs = np.array([[figure(examined[name]), figure(plain[name])] for name in examined if name in plain])
    pairs = pairs.reshape(-1, 2)[np.isfinite(pairs.reshape(-1, 2)).all(axis=1)]
    if not len(pairs):
        return None
    one, other = map(float, pairs.mean(axis=0))
    return {"ours": better(one, other), "examined": one, "unexamined": other, "count": len(pairs)}


def beats_stitcher(results: Results) -> Mapping[str, Any] | None:
    """Whether our default method has a larger SSIM than OpenCV's Stitcher in its better mode, for all subjects."""
    others = [panoramas(results, method) for method in _STITCHERS]
    pairs = [
        (canvas_ssim(result), max(canvas_ssim(found[name]) for found in others if name in found))
        for name, result in panoramas(results, "ortho").items()
        if any(name in found for found in others)
    ]
    won = sum(one > other for one, other in pairs)
    return {"ours": won == len(pairs), "won": won, "count": len(pairs)} if pairs else None


def panoramas_table(results: Results) -> Table | None:
    """Likeness and error of every panorama."""
    head = (
        *("subject", "method", "SSIM canvas", "SSIM canvas of a grey outline", "SSIM teeth, fitted", "ZNCC teeth"),
        *("teeth shown, %", "error median, mm", "P95, mm"),
    )
    rows = [
        _cells(name.removeprefix(PANORAMA).removesuffix(f"-{result['method']}"), result)
        for name, result in sorted(results.items())
        if name.startswith(PANORAMA)
    ]
    return (head, tuple(rows)) if rows else None


def _cells(subject: str, result: Result) -> tuple[str, ...]:
    score = result.get("score") or {}
    method = f"{result['method']}{' (quick)' if result.get('quick') else ''}"
    picture, geometry = score.get("picture"), score.get("geometry")
    if result.get("failure") or picture is None:
        return (subject, method, f"failed: {result.get('failure')}", *("-",) * 6)
    likeness = (picture["ssim_full"], score["trivial"]["grey jaw"]["ssim_full"], picture["ssim_teeth_fitted"])
    errors = ("-", "-") if geometry is None else (f"{geometry['median_mm']:.2f}", f"{geometry['p95_mm']:.2f}")
    shown = f"{score['coverage_pct']:.0f}"
    return (subject, method, *(f"{value:.2f}" for value in (*likeness, picture["zncc"])), shown, *errors)
