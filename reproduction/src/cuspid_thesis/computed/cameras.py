"""Chapters 1, 3.1 to 3.4 and 4.1: figures of what is computed in seconds, and of pairs of cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from cuspid_thesis.checks.cameras import BASELINES_MM
from cuspid_thesis.results import Result, value_at


def ratio(result: Result, of: str, to: str) -> Mapping[str, float]:
    """One figure over another."""
    return {"ours": value_at(result, of) / value_at(result, to)}


def more(result: Result, one: str, other: str) -> Mapping[str, Any]:
    """Whether one figure is larger than the other."""
    values = {"one": value_at(result, one), "other": value_at(result, other)}
    return {"ours": values["one"] > values["other"], **values}


def covers(result: Result, least: str, largest: str, thesis: Sequence[float]) -> Mapping[str, Any]:
    """Whether the range between two figures holds that of the thesis."""
    low, high = value_at(result, least), value_at(result, largest)
    return {"ours": bool(low <= thesis[0] and high >= thesis[1]), "low": low, "high": high}


def refused(result: Result, motion: str, by: Sequence[str]) -> Mapping[str, Any]:
    """Whether a frame with a motion is refused by some tests and by no other."""
    reasons: str = result["rejections"][motion]
    return {"ours": reasons == "; ".join(by), "tests": reasons.replace(";", ",") or "none"}


def rises_with_the_baseline(result: Result, check: str, figure: str) -> Mapping[str, Any]:
    """Whether a figure of a check, which has the baseline in its name, is larger for each larger baseline."""
    return _over_baselines(result[check], figure, lambda near, far: near < far)


def falls_with_the_baseline(result: Result, check: str, figure: str) -> Mapping[str, Any]:
    """Whether such a figure is smaller for each larger baseline."""
    return _over_baselines(result[check], figure, lambda near, far: near > far)


def _over_baselines(check: Result, figure: str, ordered: Callable[[float, float], bool]) -> Mapping[str, Any]:
    baselines = [f"{baseline:g}" for baseline in BASELINES_MM]
    values = [check[figure.format(baseline)] for baseline in baselines]
    return {
        "ours": all(ordered(near, far) for near, far in pairwise(values)),
        "values": " / ".join(f"{value:.1f}" for value in values),
        "baselines": " / ".join(baselines),
    }


def distance_and_best_angle(result: Result) -> Mapping[str, Any]:
    """Rank correlation of the distance from the occlusal surface and the best angle there."""
    best = [row for row in result["best_within_budget"]["slanted"] if row["facing"] == "occlusal"]
    pairs = [(row["distance_mm"], row["axis_angle_deg"]) for row in best]
    angles = ", ".join(f"{distance:g} mm: {angle:g}°" for distance, angle in pairs)
    return {"ours": _rank_correlation(pairs), "angles": angles}


def _rank_correlation(pairs: Sequence[tuple[float, float]]) -> float:
    """Spearman's; 0 where one of the two does not vary."""
    ranks = np.array([_ranks(np.array(column)) for column in zip(*pairs, strict=True)])
    return 0.0 if np.ptp(ranks, axis=1).min() == 0 else float(np.corrcoef(ranks)[0, 1])


def _ranks(values: np.ndarray) -> np.ndarray:
    """Mean rank among equal ones."""
    return np.array([(values < value).sum() + (values == value).sum() / 2 for value in values])
