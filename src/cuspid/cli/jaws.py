"""What is scanned: phantoms, their populations, and prepared teeth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import OmitSubcommandPrefixes, Positional, arg, subcommand

from cuspid import storage
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.anatomy.phantom.population import GroupName, draw_population
from cuspid.anatomy.phantom.sphere_arch import SphereArchOptions, build_sphere_arch
from cuspid.anatomy.preparation.prepare import (
    CrackOptions,
    CrownOptions,
    FullContourCrownOptions,
    InlayOptions,
    PreparationOptions,
    preset,
)
from cuspid.anatomy.preparation.prepare import prepare as prepare_teeth
from cuspid.anatomy.shape.boxed import box_crowns
from cuspid.cli.shared import Flat, Source, console, load_source, show_progress
from cuspid.model.jaw import Jaw
from cuspid.report.figures.drawing import save_picture
from cuspid.report.figures.preparation import save_preparation_picture
from cuspid.runtime.errors import InputError, OutputError
from cuspid.runtime.options import TOOTH, Range


def phantom(
    *,
    out: Path,
    options: Annotated[PhantomOptions, Flat] = PhantomOptions(),
    group: GroupName | None = None,
    count: Annotated[int, Range(1, 10_000)] = 10,
    spheres: bool = False,
    sphere: SphereArchOptions = SphereArchOptions(),
) -> None:
    """Make the built-in phantom jaw, with tooth labels and landmarks, or a population of phantoms, or the sphere arch.

    Args:
        out: Mesh file to write (.ply, which keeps the labels, .stl, .obj or .off), with landmarks as JSON and a picture
            beside it; for a population, a folder.
        group: Draw a population from this group of Table 2.1 of the thesis instead; --seed seeds the draw.
        count: Number of jaws in the population.
        spheres: Make the sphere arch instead, a metrology object: spheres with known centres along the arch.
        sphere: Size of the sphere arch.
    """
    if group is not None:
        _population(out, group, count, options)
    elif spheres:
        _write_jaw(out, lambda: build_sphere_arch(options.arch, sphere), f"{options.arch} sphere arch")
    else:
        _write_jaw(out, lambda: build_phantom(options), f"{options.arch} phantom, seed {options.seed}")


def _population(out: Path, group: GroupName, count: int, options: PhantomOptions) -> None:
    """Files that are there already are kept: a killed run goes on."""
    drawn = draw_population(group, count, np.random.default_rng(options.seed), options)
    with storage.claimed_folder(out, "phantom", {"group": group, "options": options}, {}), show_progress() as progress:
        for number, jaw in enumerate(drawn):
            path = out / f"{group}_{number:03d}.ply"
            if not path.with_suffix(".json").exists():
                storage.write_jaw(path, build_phantom(jaw))
            progress("phantoms", number + 1, count)
    console.print(f"{out}: {count} jaws of {group}")


def prepare(
    jaw: Annotated[Path | None, Positional, arg(metavar="[JAW]")] = None,
    *,
    out: Path,
    source: Annotated[Source, Flat] = Source(),
    preset_name: Annotated[Literal["thesis-reference"] | None, arg(name="preset")] = None,
    tooth: Annotated[int | None, TOOTH] = None,
    how: OmitSubcommandPrefixes[
        Annotated[None, subcommand("as-preset")]
        | Annotated[CrackOptions, subcommand("crack")]
        | Annotated[CrownOptions, subcommand("crown")]
        | Annotated[FullContourCrownOptions, subcommand("full-contour-crown")]
        | Annotated[InlayOptions, subcommand("mod-inlay")]
    ] = None,
) -> None:
    """Prepare teeth of a labelled jaw: a crack, a crown preparation, a full-contour crown or a MOD inlay; or a preset.

    For one tooth: cuspid jaw prepare JAW --tooth 45 --out FILE crown --taper-deg 8. For several, pass the result to
    the next run.

    Args:
        jaw: Mesh of a jaw with tooth labels; default: the built-in phantom.
        out: Mesh file to write (.ply keeps the labels), with margins and landmarks as JSON and a picture beside it.
        preset_name: thesis-reference: the mandible of Fig. 3.20 (46 cracked, 45 crown, 42 full-contour crown, 35 and 36
            MOD inlays).
        tooth: FDI number of the one tooth to prepare.
        how: Kind of preparation.
    """
    asked = _preparations(preset_name, tooth, how)
    title = f"prepared: {', '.join(map(str, asked))}"
    prepared = _write_jaw(out, lambda: prepare_teeth(load_source(jaw, source), asked), title)
    save_preparation_picture(out.with_suffix(".teeth.png"), prepared, title=title)


def _preparations(name: str | None, tooth: int | None, how: PreparationOptions | None) -> dict[int, PreparationOptions]:
    if name is not None and tooth is None and how is None:
        return dict(preset(name))
    if name is None and tooth is not None and how is not None:
        return {tooth: how}
    raise InputError(
        "prepare: give either --preset thesis-reference, or --tooth with a kind at the end of the command: crack, "
        "crown, full-contour-crown or mod-inlay"
    )


def box(
    jaw: Annotated[Path | None, Positional, arg(metavar="[JAW]")] = None,
    *,
    out: Path,
    source: Annotated[Source, Flat] = Source(),
) -> None:
    """Turn every crown into a box of its own size: the hardest jaw for a handpiece that turns (thesis 3.5.3.2).

    Args:
        jaw: Mesh of a jaw with tooth labels, for example the mean of a shape model; default: the built-in phantom.
        out: Mesh file to write, with a picture beside it.
    """
    _write_jaw(out, lambda: box_crowns(load_source(jaw, source)), "boxed jaw")


def _write_jaw(path: Path, make: Callable[[], Jaw], title: str) -> Jaw:
    """Write a jaw, what its mesh file cannot hold, and a picture of it; say what it has."""
    if path.suffix.lower() not in storage.MESH_SUFFIXES:
        raise InputError(f"{path}: give a file name that ends in .ply, .stl, .obj or .off")
    if path.exists() and not (path.is_file() and storage.is_jaw(path)):
        raise OutputError(f"{path}: exists already, and was not written by cuspid; give another name as --out")
    jaw = make()
    storage.write_jaw(path, jaw)
    save_picture(path.with_suffix(".png"), jaw.mesh, title=title)
    console.print(f"{path}: {len(jaw.mesh.faces):,} faces, teeth {', '.join(map(str, jaw.teeth))}")
    return jaw
