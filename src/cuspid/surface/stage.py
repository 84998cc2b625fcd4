"""The mesh of a capture, made once and kept on disk."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from cuspid.errors import ReconstructionError
from cuspid.geometry import Rigid3
from cuspid.mesh import Mesh
from cuspid.progress import Progress, silent
from cuspid.reconstruction import DepthMap
from cuspid.storage.files import digest_of, write_json
from cuspid.storage.meshes import read_mesh, write_mesh
from cuspid.storage.stages import Stage
from cuspid.surface.cleaning import CleaningOptions, clean
from cuspid.surface.fusion import FusionOptions
from cuspid.surface.fusion import fuse as fuse_depth_maps


def fuse(
    depths: Iterable[DepthMap],
    made_from: str,
    rig_from_world: Mapping[str, Rigid3],
    resolution_mm: float,
    working_distance_mm: float,
    folder: Path,
    fusion: FusionOptions,
    cleaning: CleaningOptions,
    *,
    progress: Progress = silent,
) -> Mesh:
    """One clean mesh: ``mesh.ply`` with colour, ``mesh.stl``, and what was removed in ``mesh.json``.

    ``made_from`` is the digest of the depth maps, which may be gone through more than once; ``resolution_mm`` is what
    the handpiece resolves, ``working_distance_mm`` how far it is held. Raises ReconstructionError where they hold
    nothing.
    """
    stage = Stage("mesh", folder, [fusion, cleaning, resolution_mm, working_distance_mm], ("surface",))
    files = [folder / name for name in ("mesh.json", "mesh.stl", "mesh.ply")]

    def write() -> None:
        raw = fuse_depth_maps(depths, rig_from_world, resolution_mm, fusion, progress=progress)
        if not len(raw.faces):
            raise ReconstructionError(
                "no surface: the depth maps are empty; the images need texture (spray, powder) or sharper focus"
            )
        mesh, report = clean(raw, working_distance_mm, cleaning)
        write_json(files[0], report)
        write_mesh(files[1], mesh)
        write_mesh(files[2], mesh)

    stage.make({"depths": made_from, "poses": digest_of(dict(rig_from_world))}, files, write)
    return read_mesh(files[2])
