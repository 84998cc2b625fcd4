"""Film a jaw by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from cuspid import storage
from cuspid.cli.shared import Flat, Source, console, load_source, show_progress
from cuspid.handpiece.intra_oral import IntraOralOptions, intra_oral_camera
from cuspid.pipeline import panorama as panorama_pipeline
from cuspid.pipeline.panorama import FilmOptions


def film(
    jaw: Annotated[Path | None, Positional, arg(metavar="[JAW]")] = None,
    *,
    out: Path,
    source: Annotated[Source, Flat] = Source(),
    camera: IntraOralOptions = IntraOralOptions(),
    handpiece: Path | None = None,
    options: Annotated[FilmOptions, Flat, OmitArgPrefixes] = FilmOptions(),
    video: bool = False,
) -> None:
    """Render what an intra-oral camera sees while a shaky hand moves it over the arch: OUT/capture and OUT/truth.

    Args:
        jaw: Mesh of a jaw (STL, PLY, OBJ, OFF); default: the built-in phantom.
        out: Output folder.
        camera: The camera and its LEDs.
        handpiece: Your own handpiece.json, instead of that camera.
        video: Also write OUT/film.mp4, from the first camera (lossy, unlike the images).
    """
    settings = {"source": source, "camera": camera, "film": options}
    given = {"jaw": jaw, "handpiece": handpiece}
    hashes = {name: storage.hash_file(path) for name, path in given.items() if path is not None}
    with storage.claimed_folder(out, "film", settings, hashes):
        device = intra_oral_camera(camera) if handpiece is None else storage.read_handpiece(handpiece)
        with show_progress() as progress:
            capture, _ = panorama_pipeline.film(load_source(jaw, source), device, out, options, progress=progress)
        if video:
            storage.write_video(out / "film.mp4", capture)
    console.print(f"{len(capture.frames)} frames in {out / 'capture'}")
