"""The pages of a panorama and of its score: pictures to zoom, what became of the frames, and how far to trust it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cuspid.model.panorama import FrameUse, Panorama
from cuspid.report.pages.page import jpeg_uri, number, photo_uri, picture_uri, provenance, render_page, signed_number
from cuspid.storage import PanoramaResult, ScoreResult

_WIDEST_PX = 2600
_GROUND = np.array([17, 22, 27], dtype=np.uint8)


def panorama_page(result: PanoramaResult) -> str:
    """The HTML of a panorama, or of its parts."""
    first = result.parts[0]
    size = first.size_mm
    used = sum(frame.used for frame in first.frames)
    parts = ("part" if len(result.parts) == 1 else "parts", str(len(result.parts)), "")
    placed = [("frames placed", str(used), f"of {len(first.frames)}"), parts] if first.frames else []
    return render_page(
        "panorama.html.j2",
        title=f"Panorama, method {first.method}" if first.frames else "Views of a mesh",
        name=result.name,
        missing=result.missing,
        tiles=[
            *placed,
            (
                "width and height",
                "–" if size is None else f"{size[0]:.1f} × {size[1]:.1f}",
                "mm" if size else "no scale",
            ),
            ("size of a pixel", "–" if first.mm_per_px is None else number(1000 * first.mm_per_px, 1), "µm"),
        ],
        parts=[_part(part, folder) for part, folder in zip(result.parts, result.folders, strict=True)],
        notes=first.notes,
        used=used,
        frames=first.frames,
        reasons=_reasons(first.frames),
        pictures=[(caption, picture_uri(path)) for caption, path in result.pictures.items()],
        made=provenance(result.run),
    )


def _part(part: Panorama, folder: Path) -> dict[str, Any]:
    height, width = part.covered.shape
    return {
        "title": "The arch from above" if part.parts == 1 else f"Part {part.part} of {part.parts}",
        "picture": jpeg_uri(np.where(part.covered[..., None], part.image, _GROUND), widest_px=_WIDEST_PX),
        "caption": f"{width} × {height} px",
        "width_px": width,
        "mm_per_px": part.mm_per_px,
        "rescale": shlex.quote(_folder_title(folder)) if part.frames else None,
        "scaled": shlex.quote(f"{_folder_title(folder)}-mm"),
        "strips": [
            (caption, photo_uri(folder / file, widest_px=_WIDEST_PX))
            for file, caption in _STRIPS.items()
            if (folder / file).exists()
        ],
    }


def _folder_title(folder: Path) -> str:
    """A folder by its last name, that of a part with the folder that it is in: pages name no folders of a machine."""
    whole = folder.resolve()
    return f"{whole.parent.name}/{whole.name}" if whole.name.startswith("part-") else whole.name


_STRIPS = {
    "buccal/strip.png": "Unrolled along the arch, seen from the cheek.",
    "strip.png": "Unrolled along the arch, with the cheek side at the top.",
    "lingual/strip.png": "Unrolled along the arch, seen from the tongue; mirrored, so that all strips show the same "
    "place of the arch in the same column.",
}


def _reasons(frames: tuple[FrameUse, ...]) -> dict[str, list[str]]:
    """The names of the frames that were left out, by the reason."""
    found: dict[str, list[str]] = {}
    for frame in frames:
        if not frame.used:
            found.setdefault(frame.reason or "unknown", []).append(frame.name)
    return found


def score_page(result: ScoreResult) -> str:
    """The HTML of how far a panorama is from the arch that was filmed."""
    score = result.score
    own = {score["method"]: score["picture"], f"{score['method']}, seen from a height": score["shot"]}
    rows = [(name, True, row) for name, row in own.items() if row]
    rows += [(name, False, row) for name, row in score["trivial"].items()]
    return render_page(
        "score.html.j2",
        title=f"How far to trust a panorama of method {score['method']}",
        name=result.name,
        missing=result.missing,
        score=score,
        tiles=_tiles(score),
        made=provenance(result.run),
        true_picture=None if result.true is None else photo_uri(result.true, widest_px=_WIDEST_PX),
        rows=rows,
        pictures=[(caption, picture_uri(path)) for caption, path in result.pictures.items()],
        made_picture=None if result.made is None else photo_uri(result.made, widest_px=_WIDEST_PX),
    )


def _tiles(score: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    found = score["geometry"]
    tiles = [("frames placed", str(score["frames_used"]), f"of {score['frames']}")] if score["frames"] else []
    if found is not None:
        tiles += [
            ("geometric error, median", number(found["median_mm"], 2), "mm"),
            ("95 % within", number(found["p95_mm"], 2), "mm"),
            ("scale error", signed_number(found["scale_error_pct"], 2), "%"),
            ("tilt of its occlusal plane", number(found["tilt_deg"], 1), "deg"),
            ("median seen along its own direction", number(found["own_median_mm"], 2), "mm"),
        ]
    if score["inter_molar_error_mm"] is not None:
        tiles.append(("inter-molar error", signed_number(score["inter_molar_error_mm"], 2), "mm"))
    tiles.append(("share of the teeth shown", number(score["coverage_pct"], 1), "%"))
    return tiles
