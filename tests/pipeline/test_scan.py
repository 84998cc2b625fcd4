"""Plain teeth from images to a mesh, as a user would."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cuspid.handpiece.designs import DesignOptions, essential_four
from cuspid.model.jaw import Jaw
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.storage import read_json


@pytest.mark.long
def test_a_plain_tooth_is_scanned_and_resumed(tmp_path: Path, coarse_phantom: Jaw) -> None:
    handpiece = essential_four(DesignOptions(width_px=160, height_px=160, lights="colour-coded"))
    path = ScanPathOptions(tooth=46, length_mm=3.0, frames=4)
    options = SimulationOptions(texture="enamel", path=path, supersampling=1)
    capture, _ = pipeline.simulate(coarse_phantom, handpiece, tmp_path, options)
    found, mesh = pipeline.reconstruct(capture, tmp_path, ReconstructionOptions())
    assert len(found.frames) == 4
    assert found.tracks is None
    assert any("calibration" in note for note in found.notes)
    assert not any("polaris" in note for note in found.notes)
    reference = pipeline.load_reference(tmp_path / "truth")
    trueness = pipeline.evaluate(mesh, reference)
    assert 3 < trueness.accuracy.mean_abs_um < 60
    assert trueness.completeness_pct["100"] > 60
    made = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*") if file.suffix in (".npz", ".ply", ".json")}
    again, same = pipeline.reconstruct(capture, tmp_path, ReconstructionOptions())
    assert made == {file: file.stat().st_mtime_ns for file in made}
    assert again.frames == found.frames
    assert np.array_equal(same.vertices, mesh.vertices)
    assert read_json(tmp_path / "motion" / "reconstruction.json")["log"]["surface_scatter_um"] > 1
