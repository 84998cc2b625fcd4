"""Precision of repeated scans: known offsets and known noise are found again, and repeated scans share their object."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cuspid import storage
from cuspid.evaluation.deviation import EvaluationOptions
from cuspid.evaluation.distance import SignedDistance
from cuspid.evaluation.registration import RegistrationOptions
from cuspid.evaluation.repeatability import PairOptions, compare_pair
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DESIGNS, DesignOptions
from cuspid.model.mesh import Mesh
from cuspid.pipeline.scan import SimulationOptions
from cuspid.runtime.errors import InputError
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.studies.design_comparison import with_smaller_images
from cuspid.studies.grid import Outcome
from cuspid.studies.repetition import MANIFEST, RepeatOptions, list_scans, scan_again, scan_cases, shoot_again
from cuspid.studies.scanners.files import find_files
from cuspid.studies.trial import TrialOptions
from verbs import refused

PAIRS = PairOptions(samples=20_000)
IN_PLACE = dataclasses.replace(PAIRS, align=False)


def dome() -> Mesh:
    """A part of a sphere of 8 mm: curved, open, and with normals that are known."""
    grid = np.linspace(-0.8, 0.8, 60)
    azimuth, height = (each.ravel() for each in np.meshgrid(grid, grid))
    directions = np.stack([np.sin(azimuth), np.sin(height), np.cos(azimuth) * np.cos(height) + 0.4], axis=1)
    vertices = 8 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    corner = np.arange(59 * 60).reshape(59, 60)[:, :-1].ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 60], 1), np.stack([corner + 1, corner + 61, corner + 60], 1)]
    )
    return Mesh(vertices, faces)


def lifted(mesh: Mesh, by_um: np.ndarray | float) -> Mesh:
    """A mesh moved outwards along the normals of a sphere about the origin."""
    outwards = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    return Mesh(mesh.vertices + 1e-3 * np.broadcast_to(by_um, len(outwards))[:, None] * outwards, mesh.faces)


def waves(mesh: Mesh, rng: np.random.Generator) -> np.ndarray:
    """A smooth field over the surface, standard deviation 1 over its phases."""
    return np.sqrt(2) * np.cos(mesh.vertices @ rng.normal(size=3) + rng.uniform(0, 2 * np.pi))


@given(by_um=st.floats(-40, 40))
@settings(max_examples=8)
def test_an_offset_is_found_with_its_sign(by_um):
    mesh = dome()
    found = compare_pair(mesh, lifted(mesh, by_um), IN_PLACE, rng=np.random.default_rng(0))
    assert found.deviation.signed_mean_um == pytest.approx(by_um, abs=0.02)
    assert found.deviation.mean_abs_um == pytest.approx(abs(by_um), abs=0.02)
    back = compare_pair(lifted(mesh, by_um), mesh, IN_PLACE, rng=np.random.default_rng(0))
    assert back.deviation.signed_mean_um == pytest.approx(-by_um, abs=0.02)


def test_alignment_takes_a_motion_away_and_leaves_a_shape_error(coarse_phantom):
    mesh = coarse_phantom.mesh.submesh(coarse_phantom.tooth_faces(46))
    motion = Rigid3.from_rotation_vector(np.array([0.002, -0.001, 0.003]), np.array([0.02, 0.03, -0.01]))
    moved = mesh.transformed(motion)
    assert compare_pair(mesh, moved, IN_PLACE, rng=np.random.default_rng(0)).deviation.mean_abs_um > 10
    assert compare_pair(mesh, moved, PAIRS, rng=np.random.default_rng(0)).deviation.mean_abs_um < 0.1
    wavy_um = 10 * np.cos(3 * mesh.vertices[:, 0])
    wavy = Mesh(mesh.vertices + 1e-3 * wavy_um[:, None] * mesh.vertex_normals, mesh.faces).transformed(motion)
    found = compare_pair(mesh, wavy, PAIRS, rng=np.random.default_rng(0)).deviation.rms_um
    assert 4 < found < 10


def test_what_one_scan_alone_shows_does_not_count():
    mesh = dome()
    half = mesh.submesh(mesh.face_centres[:, 0] < 0)
    found = compare_pair(mesh, half, IN_PLACE, rng=np.random.default_rng(0))
    assert found.deviation.max_um < 0.1
    assert 72 < found.common_pct < 78, "all of the half, half of the whole"
    away = mesh.transformed(Rigid3(np.eye(3), np.array([0, 0, 50.0])))
    with pytest.raises(InputError, match="no surface in common"):
        compare_pair(mesh, away, IN_PLACE, rng=np.random.default_rng(0))


# --- the study --------------------------------------------------------------------------------------------------------


def small_trial(**path: float) -> TrialOptions:
    simulation = SimulationOptions(supersampling=1, path=ScanPathOptions(tooth=46, length_mm=2.0, frames=3, **path))
    few = EvaluationOptions(samples=20_000, registration=RegistrationOptions(samples=10_000))
    return TrialOptions(simulation=simulation, evaluation=few)


@pytest.mark.long
@pytest.mark.parametrize("new_texture", [False, True])
def test_hand_and_noise_differ_but_the_object_stays(tmp_path, coarse_phantom, new_texture):
    """With a hand that does not shake, two scans differ by the noise of their images alone, or by the texture, too."""
    handpiece = with_smaller_images(DESIGNS["four"](DesignOptions()), 0.2)
    options, trial = RepeatOptions(new_texture=new_texture), small_trial(jitter_mm=0.0, jitter_deg=0.0)
    images = []
    for seed in (0, 1):
        capture, _ = shoot_again(coarse_phantom, handpiece, tmp_path / str(seed), options, trial.simulation, seed=seed)
        images.append(capture.image(capture.frames[0], handpiece.rig.names[0]).astype(float))
    difference = float(np.abs(images[0] - images[1]).mean())
    assert difference > 10 if new_texture else 0.5 < difference < 3


@pytest.mark.long
def test_two_scans_are_compared_as_those_of_any_scanner(tmp_path, coarse_phantom):
    """Each step as its grid calls it, and what is listed for the study."""
    options, trial = RepeatOptions(scans=2), small_trial()
    storage.write_jaw(tmp_path / "jaw.ply", coarse_phantom)
    storage.write_handpiece(tmp_path / "handpiece.json", with_smaller_images(DESIGNS["four"](DesignOptions()), 0.4))
    scans = tuple(
        Outcome(case=case, figures=scan_again(**case.parameters, folder=tmp_path, options=options, trial=trial))
        for case in scan_cases(options, trial)
    )
    assert scans[0].figures["mean_abs_um"] != scans[1].figures["mean_abs_um"]
    assert not [path for path in (tmp_path / "meshes").iterdir() if path.is_dir()], "images and depth maps are gone"
    list_scans(coarse_phantom, scans, tmp_path)
    found = find_files(tmp_path / MANIFEST)
    assert [(scan.scan, scan.path.exists()) for scan in found.scans] == [("scan-0", True), ("scan-1", True)]
    reference, scan = storage.read_jaw(found.references["jaw"]), storage.read_mesh(found.scans[0].path)
    assert 46 in reference.teeth
    assert len(reference.mesh.faces) < 0.5 * len(coarse_phantom.mesh.faces)
    assert np.abs(reference.mesh.bounds - scan.bounds).max() < 3
    assert np.mean(np.abs(SignedDistance(reference.mesh).closest_points(scan.vertices).signed_mm)) < 0.03


def test_one_scan_that_succeeded_is_no_study(tmp_path, coarse_phantom):
    cases = scan_cases(RepeatOptions(scans=2), small_trial())
    scans = (Outcome(case=cases[0], figures={}), Outcome(case=cases[1], figures={}, failure="too dark"))
    with pytest.raises(InputError, match=r"1 of 2 scans succeeded; at least two are needed \(too dark\)"):
        list_scans(coarse_phantom, scans, tmp_path)
    assert not (tmp_path / MANIFEST).exists()


def test_bad_input_of_repeat(tmp_path, capsys, phantom_file):
    for arguments, message in (
        (["--scans", "1"], "--scans is 1"),
        (["--tooth", "16"], "no tooth 16"),
        (["--tooth", "46", "--workers", "0"], "--workers is 0"),
        (["--tooth", "46", "--jitter-mm", "-1"], "--jitter-mm"),
        (["--tooth", "46", "--supersampling", "0"], "--supersampling is 0"),
        (["--tooth", "46", "--seed", "-1"], "--seed is -1"),
        (["--tooth", "46", "--scans", "3", "--study.max-distance-mm", "0"], "--max-distance-mm is 0"),
    ):
        assert message in refused(capsys, "study", "repeat", phantom_file, *arguments, "--out", tmp_path / "out")
        assert not (tmp_path / "out").exists()
