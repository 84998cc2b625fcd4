"""A handpiece as it was built, beside the one that was drawn."""

from dataclasses import replace

import numpy as np
import pytest

from cuspid import storage
from cuspid.handpiece.designs import DesignOptions, essential_four, twelve_cameras
from cuspid.model.tolerances import EXACT, NominalOptions, is_nominal, without_covariances
from cuspid.simulation.manufacturing import ManufacturingOptions, sample_built, with_tolerances
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.simulation.stage import SimulationOptions, simulate

ROUGH = ManufacturingOptions(
    manufacturing_um=10.0,
    manufacturing_deg=0.05,
    manufacturing_focal_pct=0.3,
    manufacturing_centre_px=1.0,
    manufacturing_k1=0.01,
)


def test_without_tolerances_it_is_the_drawn_one():
    drawn = twelve_cameras(DesignOptions())
    assert all(
        sample_built(drawn, ManufacturingOptions()).rig[name] is each for name, each in drawn.rig.cameras.items()
    )
    for mounted in with_tolerances(drawn, ManufacturingOptions()).rig.cameras.values():
        assert not mounted.covariance.any()
        assert not mounted.camera.covariance.any()


def test_what_is_not_manufactured_anew_stays_as_well_known_as_it_was():
    """A calibrated handpiece, of which only the places are off in a simulation."""
    calibrated = ROUGH.tolerances.fill(essential_four(DesignOptions()))
    for name, mounted in with_tolerances(calibrated, ManufacturingOptions(manufacturing_um=77.0)).rig.cameras.items():
        assert np.array_equal(mounted.camera.covariance, calibrated.rig[name].camera.covariance)
        assert np.allclose(np.diag(mounted.covariance), [0, 0, 0, *[77e-3**2] * 3])


def test_only_what_nobody_has_said_is_assumed():
    drawn = essential_four(DesignOptions())
    assumed = NominalOptions(place_um=40.0).for_handpiece(drawn).fill(drawn)
    assert is_nominal(drawn)
    assert not is_nominal(assumed)
    for given in (EXACT.fill(drawn), ROUGH.tolerances.fill(drawn)):
        assert not is_nominal(given)
        for name, mounted in NominalOptions().for_handpiece(given).fill(given).rig.cameras.items():
            assert mounted is given.rig[name]
    for name, mounted in assumed.rig.cameras.items():
        assert np.allclose(np.sqrt(np.diag(mounted.covariance)), [*[np.deg2rad(0.2)] * 3, *[0.04] * 3])
        assert np.array_equal(mounted.cam_from_rig.matrix, drawn.rig[name].cam_from_rig.matrix)
    assert is_nominal(without_covariances(assumed))


@pytest.mark.parametrize("factor", [0.1, 100.0])
def test_a_handpiece_of_another_size_is_as_well_known_for_its_size(factor):
    drawn = essential_four(DesignOptions())
    near, far = drawn.depth_range_mm
    larger = replace(
        drawn,
        working_distance_mm=factor * drawn.working_distance_mm,
        depth_range_mm=(factor * near, factor * far),
    )
    assert NominalOptions().for_handpiece(larger).place_mm == pytest.approx(
        factor * NominalOptions().for_handpiece(drawn).place_mm
    )


def test_what_is_built_is_off_by_what_the_tolerances_say():
    """In the standard deviations of the covariances, each number for itself, over fifty handpieces."""
    drawn = twelve_cameras(DesignOptions())
    known = with_tolerances(drawn, ROUGH)
    places, lenses = [], []
    for seed in range(50):
        true = sample_built(drawn, ManufacturingOptions(**{**vars(ROUGH), "manufacturing_seed": seed}))
        for name, mounted in known.rig.cameras.items():
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
    once, again = sample_built(drawn, ROUGH), sample_built(drawn, ROUGH)
    other = sample_built(drawn, ManufacturingOptions(**{**vars(ROUGH), "manufacturing_seed": 1}))
    for name in drawn.rig.names:
        assert np.array_equal(once.rig[name].cam_from_rig.matrix, again.rig[name].cam_from_rig.matrix)
        assert not np.array_equal(once.rig[name].cam_from_rig.matrix, other.rig[name].cam_from_rig.matrix)


def test_the_scan_is_told_of_the_drawn_one_and_the_truth_has_the_built_one(tmp_path, coarse_phantom):
    options = SimulationOptions(
        path=ScanPathOptions(tooth=46, frames=2, length_mm=1.0),
        manufacturing=ManufacturingOptions(manufacturing_um=20.0),
        supersampling=1,
    )
    drawn = essential_four(DesignOptions(width_px=64, height_px=64))
    simulate(coarse_phantom, drawn, tmp_path, options)
    known, true = (storage.read_handpiece(tmp_path / folder / "handpiece.json") for folder in ("capture", "truth"))
    for name, mounted in drawn.rig.cameras.items():
        assert np.allclose(known.rig[name].cam_from_rig.matrix, mounted.cam_from_rig.matrix, atol=1e-12)
        assert np.allclose(known.rig[name].covariance, np.diag([0, 0, 0, 4e-4, 4e-4, 4e-4]))
        assert not known.rig[name].camera.covariance.any()
        off_um = 1000 * np.linalg.norm((true.rig[name].cam_from_rig @ mounted.cam_from_rig.inverse()).translation)
        assert 1 < off_um < 100
        assert true.rig[name].covariance is None
