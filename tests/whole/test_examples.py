"""The examples run, and say what they promise."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from cuspid import storage
from cuspid.pipeline import scan as pipeline

pytestmark = pytest.mark.documentation

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, *arguments: object) -> str:
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_own_handpiece(tmp_path):
    printed = run("own_handpiece.py", tmp_path)
    assert "(('left', 'right'),)" in printed
    assert {path.name for path in tmp_path.iterdir()} == {"handpiece.json", "rig_config.json"}


def test_scan_one_tooth(tmp_path):
    """The whole flow, from the phantom to the trueness, through the Python interface."""
    printed = run("scan_one_tooth.py", tmp_path)
    assert "located 5 of 5 frames" in printed
    mean, p95 = map(float, re.search(r"deviation ([\d.]+) um, P95 ([\d.]+) um", printed).groups())
    assert 1.3 < mean < 7
    assert 4 < p95 < 24
    assert 92 < float(re.search(r"([\d.]+) % of what", printed).group(1)) <= 100
    assert (tmp_path / "motion" / "sparse").is_dir()
    assert goes_on_where_it_stopped(tmp_path)
    results_belong_to_what_made_them(tmp_path)


def goes_on_where_it_stopped(folder: Path) -> bool:
    """Whether a run that lost its last stages, as a killed one does, makes the same mesh again."""
    whole = (folder / "mesh.stl").read_bytes()
    for lost in ("mesh.ply", "mesh.stl", "mesh.json", "depth/00002.npz", "motion/reconstruction.json"):
        (folder / lost).unlink()
    shutil.rmtree(folder / "depth-across")
    kept = (folder / "depth" / "00004.npz").stat().st_mtime_ns
    pipeline.reconstruct(storage.read_capture(folder / "capture"), folder, pipeline.ReconstructionOptions())
    return (folder / "mesh.stl").read_bytes() == whole and (folder / "depth" / "00004.npz").stat().st_mtime_ns == kept


def results_belong_to_what_made_them(folder: Path) -> None:
    """Poses that are read again have their tracks; another voxel gives another mesh; another image gives another
    depth of its frame, and of no other."""
    capture, options = storage.read_capture(folder / "capture"), pipeline.ReconstructionOptions()
    found = pipeline.locate(capture, folder / "motion", options.tracking)
    assert len(found.tracks.point_index) == found.log["observations"]
    coarse = replace(options, fusion=replace(options.fusion, voxel_mm=0.2))
    fine = storage.read_mesh(folder / "mesh.ply")
    assert len(pipeline.reconstruct(capture, folder, coarse)[1].faces) < 0.5 * len(fine.faces)
    pipeline.measure_depth(capture, folder / "depth", options.stereo)
    shutil.copy(capture.source.path("00004", "o1"), capture.source.path("00003", "o1"))
    before = {path.name: path.stat().st_mtime_ns for path in (folder / "depth").glob("*.npz")}
    pipeline.measure_depth(capture, folder / "depth", options.stereo)
    after = {path.name: path.stat().st_mtime_ns for path in (folder / "depth").glob("*.npz")}
    assert [name for name in before if after[name] != before[name]] == ["00003.npz"]
