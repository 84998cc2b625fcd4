"""Reconstructs a mesh from photographs of one camera: the part of ``cuspid reconstruct`` that has no handpiece."""

from __future__ import annotations

from pathlib import Path

from cuspid import storage
from cuspid.cli.shared import console, print_expected, show_progress
from cuspid.model.photographs import Photographs
from cuspid.motion.colmap import hash_sparse
from cuspid.pipeline import photographs as photograph_pipeline
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.photographs import LocatedPhotographs, PhotographOptions, PhotoScaleOptions
from cuspid.pipeline.scan import ReconstructionOptions
from cuspid.report.figures.drawing import save_expected_picture
from cuspid.runtime.progress import Progress

_MOST_TOLD = 12


def reconstruct_photographs(
    source: Path,
    out: Path,
    handpiece: Path | None,
    options: ReconstructionOptions,
    photographs: PhotographOptions,
    scale: PhotoScaleOptions,
    model: Path | None = None,
) -> None:
    """Reconstruct and print a summary. ``model``: a COLMAP model, whose poses are taken."""
    settings = {"reconstruction": options, "photographs": photographs, "scale": scale, "from_poses": model}
    with show_progress() as progress:
        given = _read_photographs(source, out, handpiece, progress)
    inputs = storage.hash_photographs(given) | ({} if model is None else {"poses": hash_sparse(model)})
    with storage.claimed_folder(out, "reconstruct", settings, inputs):
        with show_progress() as progress:
            located = photograph_pipeline.locate(
                given, out / "motion", photographs, scale, colmap_model=model, progress=progress
            )
        _print(located, given)
        with show_progress() as progress:
            mesh, sigma_um = pipeline.surface(located.capture, located.found, out, options, progress=progress)
        if located.scale is not None:
            save_expected_picture(out / "expected.png", mesh, sigma_um)
    unit = "" if located.scale is not None else "; its scale is unknown: its lengths are not millimetres"
    console.print(f"{out / 'mesh.ply'}: {len(mesh.faces):,} faces{unit}")
    if located.scale is not None:
        print_expected(located.found, sigma_um)


def _read_photographs(source: Path, out: Path, handpiece: Path | None, progress: Progress) -> Photographs:
    """The photographs; a video is decoded into the output folder first."""
    if source.is_dir():
        return storage.read_photographs(source, out / "frames", handpiece=handpiece, progress=progress)
    with storage.claimed_folder(out, "frames", {}, {"video": storage.hash_source(source)}):
        return storage.read_photographs(source, out / "frames", handpiece=handpiece, progress=progress)


def _print(located: LocatedPhotographs, given: Photographs) -> None:
    found, scale = located.found, located.scale
    points = 0 if found.tracks is None else len(found.tracks.points)
    error = "" if found.reprojection_rms_px is None else f", seen to {found.reprojection_rms_px:.2f} px (RMS)"
    console.print(f"located {len(found.frames)} of {len(given.names)} photographs by {points:,} points{error}")
    for dropped in found.dropped[:_MOST_TOLD]:
        console.print(f"  left out {dropped.what}: {dropped.reason}")
    if len(found.dropped) > _MOST_TOLD:
        console.print(f"  and {len(found.dropped) - _MOST_TOLD} others (motion/reconstruction.json)")
    for note in found.notes:
        console.print(f"note: {note}")
    if scale is None:
        console.print(
            "note: the scale is unknown: the result has none, and its lengths are not millimetres; give --square-mm "
            "for a board in the photographs, or a measured --distance --between two of them"
        )
        return
    near, far = located.capture.handpiece.depth_range_mm
    console.print(
        f"scale by {scale.told_by}: within {100 * scale.sigma_share:.2g} % (one sigma), residual "
        f"{scale.residual_mm:.3f} mm (RMS); the surface is {near:.0f} to {far:.0f} mm away"
    )
