"""The mesh of a capture, and the holes of a rough one, each computed once and kept on disk."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from cuspid.fusion.cleaning import CleaningOptions, clean
from cuspid.fusion.depth_fusion import Fused, FusionOptions
from cuspid.fusion.depth_fusion import find_holes as find_holes_of_depth_maps
from cuspid.fusion.depth_fusion import fuse as fuse_depth_maps
from cuspid.fusion.sharp_edges import SharpEdgeOptions, sharpen_edges
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.model.reconstruction import DepthMap, Expectation, Funnel, SurfacePoints, sum_funnels
from cuspid.runtime.errors import ReconstructionError
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import usable_cores
from cuspid.storage.files import digest_of, write_json
from cuspid.storage.meshes import NO_SCALE, SIGMA, read_mesh_file, write_mesh
from cuspid.storage.reconstructions import read_surface_points, write_surface_points
from cuspid.storage.stages import Stage

_CODE = (__name__,)


def find_holes(
    depths: Iterable[DepthMap],
    made_from: str,
    rig_from_world: Mapping[str, Rigid3],
    detail_mm: float,
    folder: Path,
    fusion: FusionOptions,
    *,
    progress: Progress = silent,
) -> SurfacePoints:
    """Places on the rims of the holes found by :func:`cuspid.fusion.depth_fusion.find_holes`: ``holes.npz``. Same
    arguments as :func:`fuse`."""
    stage, file = Stage("holes", folder, [fusion, detail_mm], _CODE), folder / "holes.npz"

    def write() -> None:
        holes = find_holes_of_depth_maps(depths, rig_from_world, detail_mm, fusion, progress=progress)
        write_surface_points(file, holes)

    stage.make({"depths": made_from, "poses": digest_of(dict(rig_from_world))}, [file], write)
    return read_surface_points(file)


def fuse(
    depths: Iterable[DepthMap],
    made_from: str,
    rig_from_world: Mapping[str, Rigid3],
    detail_mm: float,
    folder: Path,
    fusion: FusionOptions,
    cleaning: CleaningOptions,
    sharp_edges: SharpEdgeOptions,
    *,
    expected: Expectation | None = None,
    has_scale: bool = True,
    progress: Progress = silent,
) -> tuple[Mesh, Float[np.ndarray, "v"]]:
    """One clean mesh: ``mesh.ply`` with colour and ``sigma_um``, ``mesh.stl``, and in ``mesh.json`` what was removed
    and how many vertices were moved onto sharp edges. Also returns the standard deviation of each vertex along its
    normal (um): that of its depth and, if they are ``expected``, of the poses and the calibration.

    ``made_from`` is the digest of the depth maps, which may be iterated more than once; ``detail_mm`` is the detail
    that the handpiece shows. Raises ReconstructionError where no surface is left, with the reason.
    """
    stage = Stage("mesh", folder, [fusion, cleaning, sharp_edges, detail_mm], _CODE)
    files = [folder / name for name in ("mesh.json", "mesh.stl", "mesh.ply")]

    def write() -> None:
        raw = fuse_depth_maps(depths, rig_from_world, detail_mm, fusion, progress=progress)
        funnel = sum_funnels(depth_map.funnel for depth_map in depths)
        cleaned, report = clean(raw.mesh, detail_mm, cleaning)
        if not len(cleaned.faces):
            raise ReconstructionError(f"no surface: {_explain_empty_surface(funnel, len(raw.mesh.faces))}")
        sigma_um = _sigma_um(cleaned, raw, expected)
        mesh, moved = sharpen_edges(cleaned, detail_mm, sharp_edges)
        scale: Literal["known", "unknown"] = "known" if has_scale else "unknown"
        write_json(
            files[0],
            replace(
                report, scale=scale, sharpened_vertices=moved, funnel=None if funnel is None else funnel.shares_pct
            ),
        )
        write_mesh(files[1], mesh)
        comment = None if has_scale else NO_SCALE
        write_mesh(files[2], mesh, values={SIGMA: sigma_um}, comment=comment)

    inputs = {
        "depths": made_from,
        "poses": digest_of(dict(rig_from_world)),
        "expected": digest_of([expected, has_scale]),
    }
    stage.make(inputs, files, write)
    made = read_mesh_file(files[2])
    return made.mesh, made.vertex_values[SIGMA]


def _explain_empty_surface(funnel: Funnel | None, faces: int) -> str:
    """Why nothing is left, and what to change."""
    if funnel is None or not funnel.kept:
        finding = "the depth maps are empty" if funnel is None else f"the depth maps are empty ({funnel.summary})"
        advice = {
            "begun": "the images overlap too little, are out of focus, or their depth lies outside the depth range of "
            "the calibration",
            "matched": "the images need texture (spray, powder), sharper focus or more light, or the calibration is "
            "off",
            "agreed": "views contradict each other: check the calibration and the poses",
            "kept": "what agrees is scattered: the images need more texture or sharper focus",
        }
        return f"{finding}; {advice[funnel.narrowest] if funnel else 'the images need texture or sharper focus'}"
    if not faces:
        return f"no {FusionOptions.min_maps} depth maps confirm the same surface ({funnel.summary}); check the poses"
    return f"cleaning removed all of {faces:,} faces; lower --cleaning.min-piece-width ({funnel.summary})"


def _sigma_um(mesh: Mesh, raw: Fused, expected: Expectation | None) -> Float[np.ndarray, "v"]:
    """Of each vertex of a mesh that was cleaned, which moves none."""
    depth_mm = raw.sigma_mm[cKDTree(raw.mesh.vertices).query(mesh.vertices, workers=usable_cores())[1]]
    motion_mm = 0.0 if expected is None else expected.sigma_mm(mesh.vertices, mesh.vertex_normals)
    return np.asarray(1000 * np.hypot(depth_mm, motion_mm))
