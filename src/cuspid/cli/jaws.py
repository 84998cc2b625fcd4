"""What is scanned: phantoms."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cuspid import storage
from cuspid.anatomy.phantom import PhantomOptions, build_phantom
from cuspid.anatomy.sphere_arch import SphereArchOptions, build_sphere_arch
from cuspid.cli.shared import Flat, console
from cuspid.errors import InputError
from cuspid.jaw import Jaw
from cuspid.reporting.figures import save_picture


def phantom(
    *,
    out: Path,
    options: Annotated[PhantomOptions, Flat] = PhantomOptions(),
    spheres: bool = False,
    sphere: SphereArchOptions = SphereArchOptions(),
) -> None:
    """Make the built-in phantom jaw: a mesh with tooth labels and landmarks, and a picture of it.

    Args:
        out: Mesh file to write (.ply keeps the labels; .stl, .obj), with landmarks as JSON beside it.
        spheres: Make the sphere arch instead, a metrology object: spheres of known centres along the arch.
        sphere: Size of the sphere arch.
    """
    check_mesh_name(out)
    if spheres:
        write_jaw_and_picture(out, build_sphere_arch(options.arch, sphere), f"{options.arch} sphere arch")
    else:
        write_jaw_and_picture(out, build_phantom(options), f"{options.arch} phantom, seed {options.seed}")


def check_mesh_name(path: Path) -> None:
    """Raise InputError where a file name is not that of a mesh."""
    if path.suffix.lower() not in storage.MESH_SUFFIXES:
        raise InputError(f"{path}: give a file name that ends in .ply, .stl or .obj")


def write_jaw_and_picture(path: Path, jaw: Jaw, title: str) -> None:
    """Write a jaw, what its mesh file cannot hold, and a picture of it; say what it has."""
    storage.write_jaw(path, jaw)
    save_picture(path.with_suffix(".png"), jaw.mesh, title=title)
    console.print(f"{path}: {len(jaw.mesh.faces):,} faces, teeth {', '.join(map(str, jaw.teeth))}")
