"""A handpiece as it was built, beside the one that was drawn."""

import numpy as np
import pytest

from cuspid import storage
from cuspid.handpiece.designs import DesignOptions, essential_four, twelve_cameras
from cuspid.simulation.manufacturing import ManufacturingOptions, built, with_tolerances
from verbs import run

ROUGH = ManufacturingOptions(
    manufacturing_um=10.0,
    manufacturing_deg=0.05,
    manufacturing_focal_pct=0.3,
    manufacturing_centre_px=1.0,
    manufacturing_k1=0.01,
)


def test_without_tolerances_it_is_the_drawn_one():
    drawn = twelve_cameras(DesignOptions())
    for same in (built(drawn, ManufacturingOptions()), with_tolerances(drawn, ManufacturingOptions())):
        assert all(same.rig[name] is mounted for name, mounted in drawn.rig.cameras.items())


def test_what_is_built_is_off_by_what_the_tolerances_say():
    """In the standard deviations of the covariances, each number for itself, over fifty handpieces."""
    drawn = twelve_cameras(DesignOptions())
    told = with_tolerances(drawn, ROUGH)
    places, lenses = [], []
    for seed in range(50):
        true = built(drawn, ManufacturingOptions(**{**vars(ROUGH), "manufacturing_seed": seed}))
        for name, mounted in told.rig.cameras.items():
            motion = true.rig[name].cam_from_rig @ mounted.cam_from_rig.inverse()
            places.append([*motion.rotation_vector, *motion.translation] / np.sqrt(np.diag(mounted.covariance)))
            shift = true.rig[name].camera.parameters - mounted.camera.parameters
            lenses.append(shift[:5] / np.sqrt(np.diag(mounted.camera.covariance))[:5])
            assert not shift[5:].any()
            assert shift[0] / mounted.camera.focal_px[0] == pytest.approx(shift[1] / mounted.camera.focal_px[1])
    for numbers in (np.array(places), np.array(lenses)):
        assert np.allclose(numbers.std(axis=0), 1, atol=0.12)
        assert np.abs(numbers.mean(axis=0)).max() < 0.15


def test_another_seed_is_another_handpiece_and_the_same_one_the_same():
    drawn = essential_four(DesignOptions())
    once, again = built(drawn, ROUGH), built(drawn, ROUGH)
    other = built(drawn, ManufacturingOptions(**{**vars(ROUGH), "manufacturing_seed": 1}))
    for name in drawn.rig.names:
        assert np.array_equal(once.rig[name].cam_from_rig.matrix, again.rig[name].cam_from_rig.matrix)
        assert not np.array_equal(once.rig[name].cam_from_rig.matrix, other.rig[name].cam_from_rig.matrix)


def test_the_scan_is_told_of_the_drawn_one_and_the_truth_has_the_built_one(tmp_path):
    tiny = ("--handpiece", tmp_path / "probe" / "handpiece.json", "--tooth", 46, "--frames", 2, "--length-mm", 1)
    run("handpiece", "--design", "four", "--width-px", 64, "--height-px", 64, "--out", tmp_path / "probe")
    run("simulate", *tiny, "--supersampling", 1, "--manufacturing-um", 20, "--out", tmp_path / "scan")
    drawn, told, true = (
        storage.read_handpiece(tmp_path / path / "handpiece.json") for path in ("probe", "scan/capture", "scan/truth")
    )
    for name, mounted in drawn.rig.cameras.items():
        assert np.allclose(told.rig[name].cam_from_rig.matrix, mounted.cam_from_rig.matrix, atol=1e-12)
        assert np.allclose(told.rig[name].covariance, np.diag([0, 0, 0, 4e-4, 4e-4, 4e-4]))
        assert told.rig[name].camera.covariance is None
        off_um = 1000 * np.linalg.norm((true.rig[name].cam_from_rig @ mounted.cam_from_rig.inverse()).translation)
        assert 1 < off_um < 100
        assert true.rig[name].covariance is None
