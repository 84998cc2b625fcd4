"""Evaluate a panorama."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import Console
from rich.table import Table
from tyro.conf import Positional

from cuspid import storage
from cuspid.cli.report import report
from cuspid.cli.shared import Flat, console
from cuspid.evaluation.panorama import (
    ImageScores,
    PanoramaComparison,
    PanoramaEvaluationOptions,
    PanoramaScore,
    evaluate_panorama,
)
from cuspid.model.panorama import FrameUse, Panorama
from cuspid.model.trueness import ReferenceRender
from cuspid.report.figures.panorama_evaluation import save_panorama_evaluation
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import read_rgba


def evaluate(
    panorama: Annotated[Path, Positional],
    truth: Annotated[Path, Positional],
    *,
    out: Path,
    options: Annotated[PanoramaEvaluationOptions, Flat] = PanoramaEvaluationOptions(),
) -> None:
    """Evaluate a panorama against the arch that was filmed: score.json, a table, and score.png, where both are shown.

    Args:
        panorama: Folder that cuspid pano stitch wrote, or a picture from another program (black or transparent pixels
            count as empty).
        truth: The folder truth/ that cuspid pano film wrote.
        out: Folder for the results.
    """
    known, view = storage.read_truth(truth), storage.read_reference_render(truth / "occlusal")
    shot = storage.read_reference_render(truth / "shot")
    made = storage.read_panorama(panorama) if panorama.is_dir() else read_picture(panorama)
    pictured = panorama / "panorama.png" if panorama.is_dir() else panorama
    hashes = {"panorama": storage.hash_file(pictured), "truth": storage.hash_file(truth / "poses.json")}
    with storage.claimed_folder(out, "stitch-eval", {"evaluation": options}, hashes, replace=True):
        comparison = evaluate_panorama(made, known, view, shot, options)
        storage.write_json(out / "score.json", comparison.score)
        _save_picture(out / "score.png", view, comparison)
        _save_beside(out, view, comparison)
    _print(comparison.score)
    report(out)


def read_picture(path: Path) -> Panorama:
    """A panorama from a picture alone. Raises InputError where it cannot be read or shows nothing."""
    pixels = read_rgba(path)
    opaque = pixels[..., 3] > 0
    covered = opaque & (pixels[..., :3].max(axis=2) > 0) if opaque.all() else opaque
    if not covered.any():
        raise InputError(f"{path}: the image is entirely black or transparent; give a panorama")
    frames: tuple[FrameUse, ...] = ()
    return Panorama(
        image=np.ascontiguousarray(pixels[..., :3]),
        covered=covered,
        frame_index=np.full(covered.shape, -1, dtype=np.int16),
        frame_pixel=np.full((*covered.shape, 2), np.nan, dtype=np.float32),
        frames=frames,
        method=path.stem,
        origin_px=np.zeros(2),
    )


def _save_picture(path: Path, view: ReferenceRender, comparison: PanoramaComparison) -> None:
    score, places = comparison.score, comparison.points_mm
    save_panorama_evaluation(
        path,
        view.image,
        comparison.aligned,
        places * [1, -1] / view.mm_per_px + view.origin_px,
        comparison.errors_mm,
        title=f"{score.method}: {score.frames_used} of {score.frames} frames" if score.frames else score.method,
        captions=("reference render of the true jaw", _draw_score(score), _format_score(score)),
    )


def _save_beside(out: Path, view: ReferenceRender, comparison: PanoramaComparison) -> None:
    """true.png and made.png: the reference render and the panorama laid over it, pixel by pixel."""
    storage.write_image(out / "true.png", view.image)
    if comparison.aligned is not None:
        storage.write_image(out / "made.png", np.rint(255 * np.clip(comparison.aligned, 0, 1)).astype(np.uint8))


def _draw_score(score: PanoramaScore) -> str:
    if score.failure or score.picture is None:
        return f"failed: {score.failure}"
    one = score.picture
    return (
        f"panorama: SSIM on teeth {one.ssim_teeth_fitted:.2f}, ZNCC {one.zncc:.2f}, covers {score.coverage_pct:.1f} %"
    )


def _format_score(score: PanoramaScore) -> str:
    if score.geometry is None:
        return "geometric error not known"
    found = score.geometry
    return f"error: median {found.median_mm:.2f}, RMS {found.rms_mm:.2f}, P95 {found.p95_mm:.2f} mm"


def _print(score: PanoramaScore) -> None:
    table = Table(title="Likeness to the reference render", title_justify="left")
    heads = ("picture", "ZNCC teeth", "SSIM teeth, fitted", "as it is", "SSIM seen, fitted", "SSIM canvas, fitted")
    for head in heads:
        table.add_column(head, justify="left" if head == "picture" else "right")
    rows: dict[str, ImageScores | None] = {score.method: score.picture, f"{score.method}, from a height": score.shot}
    for name, one in {**rows, **score.trivial}.items():
        if one is not None:
            figures = (one.zncc, one.ssim_teeth_fitted, one.ssim_teeth, one.ssim_seen_fitted, one.ssim_full_fitted)
            table.add_row(name, *("-" if figure is None else f"{figure:.3f}" for figure in figures))
    Console().print(table)
    if score.failure:
        console.print(f"failed: {score.failure}", style="red")
        return
    console.print(_format_score(score) if score.geometry is None else f"geometric {_format_score(score)}")
    _print_extent(score)
    for note in score.notes:
        console.print(f"note: {note}")


def _print_extent(score: PanoramaScore) -> None:
    console.print(
        f"shows {score.coverage_pct:.1f} % of the teeth, of which the frames saw {score.seen_pct:.1f} %, and "
        f"{score.coverage_of_seen_pct:.1f} % of what they saw; the arch is "
        f"{'complete' if score.complete else 'not complete'} in {score.parts} part(s)"
    )
    if score.inter_molar_error_mm is not None:
        console.print(f"inter-molar distance error {score.inter_molar_error_mm:+.2f} mm")
    if score.geometry is None:
        return
    own = score.geometry
    console.print(
        f"it looks at the jaw {own.tilt_deg:.1f} deg from the occlusal frame's direction; along its own, the error is "
        f"{own.own_median_mm:.3f} mm (median), {own.own_p95_mm:.3f} mm (95 %)"
    )
    if own.scale_error_pct is not None:
        console.print(f"scale error {own.scale_error_pct:+.2f} %")
