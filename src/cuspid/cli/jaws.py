"""What is scanned: the phantom."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cuspid import storage
from cuspid.anatomy.phantom import PhantomOptions, build_phantom
from cuspid.cli.shared import Flat, console
from cuspid.errors import InputError
from cuspid.reporting.figures import save_picture


def phantom(*, out: Path, options: Annotated[PhantomOptions, Flat] = PhantomOptions()) -> None:
    """Make the built-in phantom jaw: a mesh with tooth labels, and a picture of it.

    Args:
        out: Mesh file to write (.ply keeps the labels; .stl, .obj).
    """
    made = build_phantom(options)
    if out.suffix.lower() not in storage.MESH_SUFFIXES:
        raise InputError(f"{out}: give a file name that ends in .ply, .stl or .obj")
    if out.suffix.lower() == ".ply":
        storage.write_jaw(out, made)
    else:
        storage.write_mesh(out, made.mesh)
    save_picture(out.with_suffix(".png"), made.mesh, title=f"{options.arch} phantom, seed {options.seed}")
    console.print(f"{out}: {len(made.mesh.faces):,} faces, teeth {', '.join(map(str, made.teeth))}")
