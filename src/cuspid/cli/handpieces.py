"""Handpieces: the built-in designs, the search for new ones, and their holders."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from cuspid import storage
from cuspid.anatomy.mouth import MouthOptions
from cuspid.cli.shared import Flat, Source, console, load_source, show_progress
from cuspid.handpiece.brief import read_brief
from cuspid.handpiece.cad.printability import check_printable
from cuspid.handpiece.cad.printable import printable, views_of
from cuspid.handpiece.cad.shell import PrintOptions
from cuspid.handpiece.designs import DesignName, DesignOptions, build_handpiece
from cuspid.handpiece.optimise import SearchOptions, handpiece_outline
from cuspid.model.rig import Handpiece
from cuspid.report.figures.design import save_design_picture
from cuspid.report.figures.holder import save_holder_picture
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import TOOTH
from cuspid.studies import forecast


def build(
    *,
    out: Path,
    design: DesignName = "twelve",
    handpiece: Path | None = None,
    body: Path | None = None,
    options: Annotated[DesignOptions, Flat] = DesignOptions(),
    printing: Annotated[PrintOptions, Flat] = PrintOptions(),
) -> None:
    """Write a built-in handpiece as handpiece.json and COLMAP's rig_config.json, and a printable holder for it.

    Args:
        out: Output folder.
        design: Built-in design: a stereo pair, the essential four cameras, six cameras (to be turned), or all twelve.
        handpiece: Your own handpiece.json, or COLMAP's rig_config.json, instead of a built-in design.
        body: STL, PLY, OBJ or OFF file for the holder: one solid with seats, cable channels, neck and grip, in mm in
            the rig frame, with a picture beside it. The handpiece is then written with this body.
    """
    made = build_handpiece(design, options) if handpiece is None else storage.read_handpiece(handpiece)
    if body is not None:
        made = _print_holder(body, made, printing)
    elif vars(printing) != vars(PrintOptions()):
        raise InputError(
            "handpiece: options for printing a holder are given, but no file for it; add --body holder.stl"
        )
    storage.write_handpiece(out / "handpiece.json", made)
    storage.write_rig_config(out / "rig_config.json", made.rig)
    console.print(f"{out / 'handpiece.json'}: {len(made.rig.names)} cameras, {len(made.lights)} lights")


def _print_holder(path: Path, handpiece: Handpiece, options: PrintOptions) -> Handpiece:
    """Build, check and write a holder; the handpiece with its body."""
    if path.suffix.lower() not in storage.MESH_SUFFIXES:
        raise InputError(f"{path}: --body must end in {', '.join(storage.MESH_SUFFIXES)}")
    made = printable(handpiece, options)
    found = check_printable(made, options)
    storage.write_mesh(path, made.mesh)
    lines = (
        f"{' x '.join(f'{side:.0f}' for side in found.size_mm)} mm, {found.volume_mm3 / 1000:.1f} cm3, about "
        f"{found.weight_g:.0f} g in resin",
        f"head {found.thickness_mm:.1f} mm thick, {handpiece.working_distance_mm:g} mm over the teeth",
    )
    picture = path.with_suffix(".png")
    save_holder_picture(
        picture, made.handpiece, made.handle_from_rig, views_of(made), title=handpiece.name, notes=lines
    )
    for line in (*lines, f"thinnest wall {found.wall}", *([f"thinnest web {found.web}"] if found.web else [])):
        console.print(f"{path}: {line}")
    return made.handpiece


def design(
    brief: Annotated[Path, Positional],
    *,
    out: Path,
    jaw: Path | None = None,
    source: Annotated[Source, Flat] = Source(),
    teeth: Annotated[tuple[int, ...], TOOTH] = (46, 41),
    mouth: MouthOptions = MouthOptions(),
    search: Annotated[SearchOptions, Flat] = SearchOptions(),
) -> None:
    """Search for a handpiece that meets a brief: a TOML file with sensor, size, mouth and the surfaces it must see.

    Args:
        brief: The brief (docs/designs.md).
        out: Folder for handpiece.json, rig_config.json, design.json (how each condition is met) and design.png.
        jaw: Mesh of a jaw with tooth labels; default: the built-in phantom.
        teeth: FDI numbers of the teeth that the handpiece is designed for.
        mouth: The people whom it should fit.
    """
    wanted = read_brief(brief)
    settings = {"search": search, "mouth": mouth, "teeth": teeth, "source": source}
    inputs = {"brief": storage.hash_file(brief)} | ({} if jaw is None else {"jaw": storage.hash_file(jaw)})
    with storage.claimed_folder(out, "design", settings, inputs, replace=True), show_progress() as progress:
        found = forecast.design(wanted, load_source(jaw, source), search, teeth=teeth, mouth=mouth, progress=progress)
        storage.write_handpiece(out / "handpiece.json", found.handpiece)
        storage.write_rig_config(out / "rig_config.json", found.handpiece.rig)
        storage.write_json(out / "design.json", {"gap_mm": found.gap_mm, "best": found.best, "trials": found.trials})
        first = found.sections[0]
        below = first.mesh.transformed(first.rig_from_world[len(first.rig_from_world) // 2])
        outline = handpiece_outline(found.handpiece, wanted.thickness_mm)
        save_design_picture(out / "design.png", found.handpiece, below, outline, title=wanted.name)
    for condition in found.best.assessment.conditions:
        console.print(f"{'met   ' if condition.is_met else 'missed'} {condition}")
    console.print(
        f"{out / 'handpiece.json'}: {len(found.handpiece.rig.names)} cameras, the best of {found.evaluations} designs; "
        f"mean bound {found.best.assessment.mean_bound_um:.1f} µm, {found.best.assessment.unseen:.1%} unseen"
    )
    found.check(wanted)
