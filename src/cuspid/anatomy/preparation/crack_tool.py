"""The tool that cracks a tooth: a wedge-shaped slit that wanders mesiodistally over the occlusal surface.

Frame: that of the tooth's site (`cuspid.anatomy.preparation.tooth_site`). The slit is V-shaped: as wide as asked at the
surface and closed at its depth, which is measured along the axis. It begins in the fossa at the far end, crosses a
marginal ridge and runs out on the proximal side; at its ends width and depth fade together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from cuspid.anatomy.booleans import CAVITY, OUTSIDE, Tool
from cuspid.anatomy.preparation.tooth_site import ToothSite, outward
from cuspid.geometry import lengths_along
from cuspid.runtime.errors import InputError

WANDER_MM = 0.18
"""How far the slit strays to either side."""
FADE_MM = 0.8
"""Length over which it fades at its ends."""
OVER_RIDGE_MM = 0.8
"""How far below the crest of the marginal ridge it ends."""
_STEP_MM = 0.05


@dataclass(frozen=True, kw_only=True)
class CrackShape:
    """The measures of a crack."""

    width_mm: float
    depth_mm: float
    ridge: Literal["mesial", "distal"]


def crack_tool(site: ToothSite, shape: CrackShape) -> Tool:
    """The tool for a crack. Raises InputError for a tooth without an occlusal surface, or one too low for the depth."""
    if site.kind not in ("premolar", "molar"):
        raise InputError(f"tooth {site.fdi}: a crack needs an occlusal surface; choose a premolar or molar")
    path = _path(site, shape.ridge)
    if path[:, 2].min() - shape.depth_mm < site.gum_margin[:, 2].min():
        raise InputError(
            f"tooth {site.fdi}: a crack {1000 * shape.depth_mm:g} um deep reaches below the gum; make it shallower"
        )
    run = lengths_along(path[:, :2])
    fade = np.clip(np.minimum(run, run[-1] - run) / FADE_MM, 0.12, 1.0)
    return _wedge(path, fade * shape.depth_mm, fade * shape.width_mm / 2)


def _path(site: ToothSite, ridge: Literal["mesial", "distal"]) -> Float[np.ndarray, "n 3"]:
    """Points of the surface along the crack, from the fossa to beyond the ridge."""
    side = site.distal if ridge == "distal" else -site.distal
    half = site.width_mm / 2
    x = side * np.arange(-0.55 * half, 1.3 * half, _STEP_MM)
    middle = site.surface.vertices[:, 1]
    y = (middle.max() + middle.min()) / 2 + WANDER_MM * (np.sin(1.3 * x + 0.5) + 0.4 * np.sin(3.7 * x + 2.0))
    z = site.occlusal_height(x, y)
    there = np.isfinite(z)
    end = len(z) if there.all() else int(np.argmin(there))
    crest_at = int(np.argmax(np.where(np.abs(x[:end]) > 0.5 * half, z[:end], -np.inf)))
    beyond = np.flatnonzero(z[crest_at:end] < z[crest_at] - OVER_RIDGE_MM)
    end = crest_at + int(beyond[0]) if len(beyond) else end
    return np.column_stack([x, y, z])[:end]


def _wedge(path: Float[np.ndarray, "n 3"], depth: Float[np.ndarray, "n"], half_width: Float[np.ndarray, "n"]) -> Tool:
    """A wedge along a path: a bottom line, and two upper ones above the surface."""
    along = np.gradient(path[:, :2], axis=0)
    across = np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(path))])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    down = np.array([0.0, 0.0, 1.0]) * depth[:, None]
    bottom = path - down
    spread = 1.6 * half_width[:, None] * across
    rows = np.stack([bottom, path + 0.6 * down + spread, path + 0.6 * down - spread])
    n, k = len(path), np.arange(len(path) - 1)
    faces, marks = [], []
    for one, other, mark in ((0, 1, CAVITY), (1, 2, OUTSIDE), (2, 0, CAVITY)):
        a, b, c, d = one * n + k, one * n + k + 1, other * n + k + 1, other * n + k
        faces += [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
        marks += [np.full(2 * len(k), mark)]
    ends = np.array([[0, n, 2 * n], [n - 1, 3 * n - 1, 2 * n - 1]])
    mesh = outward(rows.reshape(-1, 3), np.concatenate([*faces, ends]))
    return Tool(mesh=mesh, marks=np.concatenate([*marks, [CAVITY, CAVITY]]), line=bottom)
