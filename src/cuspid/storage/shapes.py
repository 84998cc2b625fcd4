"""How a shape model is stored: the mean as a jaw, the modes as arrays beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from cuspid.model.mesh import Mesh
from cuspid.model.shape_model import MeanStep, ShapeModel
from cuspid.runtime.errors import InputError
from cuspid.storage.files import as_declared, read_arrays, read_json, reading, write_arrays, write_json
from cuspid.storage.jaws import read_jaw, write_jaw


def write_shape_model(folder: Path, model: ShapeModel) -> None:
    """Write ``mean.ply`` (with ``mean.json``), ``modes.npz`` and, last, ``shape.json``, which completes them."""
    (folder / "shape.json").unlink(missing_ok=True)
    write_jaw(folder / "mean.ply", model.mean)
    arrays = {
        # A mesh file does not keep the order of the vertices.
        "vertices": model.mean.mesh.vertices,
        "faces": model.mean.mesh.faces,
        "modes": model.modes.astype(np.float32),
        "landmark_modes": model.landmark_modes,
    }
    write_arrays(folder / "modes.npz", arrays)
    summary = {
        "samples": model.names,
        "first": model.first,
        "scaled": model.scaled,
        "scales": model.scales,
        "correspondence": model.correspondence,
        "converged": model.converged,
        "standard_deviations_mm": model.standard_deviations_mm,
        "variance_mm2": model.variance_mm2,
        "variance_shares": model.variance_shares,
        "scores_sd": model.scores,
        "log": model.log,
        "notes": model.notes,
    }
    write_json(folder / "shape.json", summary)


def read_shape_model(folder: Path) -> ShapeModel:
    """A shape model that :func:`write_shape_model` wrote. Raises InputError where a part is missing or broken."""
    summary_path = folder / "shape.json"
    summary = read_json(summary_path)
    mean = read_jaw(folder / "mean.ply")
    mesh, modes, landmark_modes = _read_modes(folder / "modes.npz")
    if len(mesh.faces) != len(mean.mesh.faces) or landmark_modes.shape[1] != len(mean.landmarks):
        raise InputError(
            f"{folder / 'modes.npz'}: its modes do not match mean.ply beside it; make the shape model again"
        )
    with reading(summary_path):
        return as_declared(
            ShapeModel,
            mean=replace(mean, mesh=mesh),
            modes=modes,
            landmark_modes=landmark_modes,
            standard_deviations_mm=np.array(summary["standard_deviations_mm"], dtype=np.float64),
            variance_shares=np.array(summary["variance_shares"], dtype=np.float64),
            scores=np.array(summary["scores_sd"], dtype=np.float64).reshape(len(summary["samples"]), -1),
            names=tuple(summary["samples"]),
            scales=np.array(summary["scales"], dtype=np.float64),
            scaled=summary["scaled"],
            first=summary["first"],
            correspondence=summary["correspondence"],
            converged=summary["converged"],
            log=tuple(as_declared(MeanStep, **step) for step in summary["log"]),
            notes=tuple(summary["notes"]),
        )


def _read_modes(path: Path) -> tuple[Mesh, Float[np.ndarray, "k v 3"], Float[np.ndarray, "k l 3"]]:
    stored = read_arrays(path, remedy="make the shape model again")
    with reading(path):
        return Mesh(stored["vertices"], stored["faces"]), stored["modes"], stored["landmark_modes"]
