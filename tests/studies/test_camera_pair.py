"""The study of a pair: its geometry, its laws, and the answer to whether a smaller baseline is more accurate."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cuspid.model.camera import Camera
from cuspid.model.jaw import Jaw
from cuspid.runtime.errors import InputError
from cuspid.studies.camera_pair import (
    CameraPairOptions,
    best_pairs,
    camera_pair,
    convergence_deg,
    pose_facing,
    study_camera_pair,
    table,
    tooth_surfaces,
)
from cuspid.studies.matching_noise import (
    MatchingNoiseOptions,
    MatchingSamples,
    bin_samples,
    fit_noise,
    sample_matching,
)

CAMERA = Camera.from_field_of_view(512, 512, 62.0)
BASELINES, ANGLES, DISTANCES = (1.0, 2.0, 4.0), (0.0, 20.0, 40.0), (3.0, 5.0, 9.0, 13.0)


@pytest.fixture(scope="module")
def rows(coarse_phantom):
    """A small study of the occlusal surface by the matcher of this program."""
    options = CameraPairOptions(
        facing=("occlusal",), baselines_mm=BASELINES, axis_angles_deg=ANGLES, distances_mm=DISTANCES
    )
    return study_camera_pair(coarse_phantom, options)


@given(baseline=st.floats(0.5, 5.0), angle=st.floats(0.0, 60.0))
def test_the_axes_meet_where_the_convergence_is_their_angle(baseline, angle):
    left, right = camera_pair(baseline, angle, CAMERA).cameras.values()
    np.testing.assert_allclose(right.centre_in_rig - left.centre_in_rig, [baseline, 0, 0], atol=1e-12)
    assert left.axis_in_rig @ right.axis_in_rig == pytest.approx(np.cos(np.deg2rad(angle)), abs=1e-9)
    assert left.axis_in_rig[0] >= 0 >= right.axis_in_rig[0]
    if angle > 1:
        distance = baseline / (2 * np.tan(np.deg2rad(angle) / 2))
        assert convergence_deg(baseline, distance) == pytest.approx(angle)
        for each in (left, right):
            seen = each.camera.project(each.cam_from_rig.apply(np.array([0.0, 0.0, distance])))
            np.testing.assert_allclose(seen, [256, 256], atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("surface", ["occlusal", "buccal", "lingual"])
def test_a_pair_faces_the_middle_of_a_surface_from_outside(coarse_phantom, surface):
    mesh, mask = coarse_phantom.mesh, tooth_surfaces(coarse_phantom, 47)[surface]
    pose = pose_facing(mesh, mask, np.array([1.0, 0.2, 0.3]), 6.0)
    middle = np.average(mesh.face_centres[mask], axis=0, weights=mesh.face_areas[mask])
    np.testing.assert_allclose(pose.apply(middle), [0, 0, 6], atol=1e-9)
    assert np.linalg.det(pose.rotation) == pytest.approx(1)
    assert np.median(pose.rotate(mesh.face_normals[mask])[:, 2]) < -0.6


def test_each_named_surface_has_a_row_and_shares_nest(rows):
    assert len(rows) == len(BASELINES) * len(ANGLES) * len(DISTANCES) * 5
    assert {row["surface"] for row in rows} == {"occlusal", "buccal", "lingual", "mesial", "distal"}
    for row in rows:
        assert 0 <= row["within_budget_pct"] <= row["matched_pct"] <= row["seen_pct"] <= 100
        if row["seen_pct"] > 0:
            assert row["noise_growth"] >= 1
            assert row["expected_rms_um"] >= row["bound_rms_um"] > 0
    assert max(row["seen_pct"] for row in rows if row["surface"] == "occlusal") > 95


@pytest.mark.parametrize("angle", ANGLES)
def test_the_bound_falls_with_the_baseline_and_grows_with_the_distance(rows, angle):
    """Against the thesis' claim, at the target whatever is seen, about as Z^2 / b."""
    _, _, bound = table(rows, "occlusal", "bound_centre_um", axis_angle_deg=angle)
    assert (np.diff(bound, axis=0) < 0).all()
    assert (np.diff(bound, axis=1) > 0).all()
    if angle == 0:
        far = bound[:, -1] * np.array(BASELINES)
        assert 0.95 < far.max() / far.min() < 1.10


def test_near_the_tooth_parallel_cameras_share_less_the_longer_the_baseline(rows):
    _, distances, seen = table(rows, "occlusal", "seen_pct", axis_angle_deg=0.0)
    assert (np.diff(seen[:, distances == 5.0], axis=0) < -3).all()
    assert np.ptp(seen[:, distances == 13.0]) < 3


def test_a_smaller_distance_needs_a_larger_angle(rows):
    """The other claim of the thesis: what both see is most where the axes meet on the surface."""
    best = best_pairs([row for row in rows if row["baseline_mm"] == 4.0], "seen_pct")
    angles = {row["distance_mm"]: row["axis_angle_deg"] for row in best}
    assert angles[3.0] == 40
    assert angles[3.0] >= angles[5.0] >= angles[9.0]
    assert angles[9.0] <= 20


def test_matching_grows_noisier_with_the_baseline(rows):
    _, _, growth = table(rows, "occlusal", "noise_growth", axis_angle_deg=0.0)
    assert (np.diff(growth[:, -1]) > 0).all()
    assert growth[0, -1] < 1.1
    assert growth[2, 1] > 1.2


def test_upright_windows_cost_what_the_baseline_gains(coarse_phantom, rows):
    """With windows that turn with the surface a longer baseline stays worth it; with upright ones much less."""
    options = CameraPairOptions(
        facing=("occlusal",),
        matcher="upright",
        baselines_mm=(1.0, 4.0),
        axis_angles_deg=(0.0,),
        distances_mm=(5.0,),
    )
    _, _, upright = table(study_camera_pair(coarse_phantom, options), "occlusal", "expected_rms_um")
    _, _, slanted = table(rows, "occlusal", "expected_rms_um", axis_angle_deg=0.0)
    gain = slanted[0, 1] / slanted[2, 1]
    assert 1.8 < gain < 4
    assert 0.8 < upright[0, 0] / upright[1, 0] < 0.75 * gain


def test_best_pairs_pick_the_extreme_of_each_group(rows):
    own = [row for row in rows if row["surface"] == "occlusal"]
    for best in best_pairs(rows, "seen_pct"):
        rivals = [row["seen_pct"] for row in own if row["distance_mm"] == best["distance_mm"]]
        assert best["seen_pct"] == max(rivals)
    for best in best_pairs(rows, "expected_rms_um", ("distance_mm", "axis_angle_deg")):
        same = ("distance_mm", "axis_angle_deg")
        rivals = [row for row in own if all(row[name] == best[name] for name in same)]
        assert best["expected_rms_um"] == min(row["expected_rms_um"] for row in rivals if row["seen_pct"] > 0)


def test_a_camera_in_the_tooth_sees_nothing(coarse_phantom):
    options = CameraPairOptions(
        facing=("occlusal",), baselines_mm=(6.0,), axis_angles_deg=(0.0,), distances_mm=(0.1, 9.0)
    )
    inside, outside = (row for row in study_camera_pair(coarse_phantom, options) if row["surface"] == "occlusal")
    assert inside["in_tissue"]
    assert inside["seen_pct"] == 0
    assert inside["expected_rms_um"] is None
    assert not outside["in_tissue"]
    assert outside["seen_pct"] > 20


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"facing": ("mesial",)}, "can face"),
        ({"baselines_mm": (0.0,)}, "baselines-mm is 0"),
        ({"distances_mm": ()}, "given"),
        ({"axis_angles_deg": (190.0,)}, "axis-angles-deg"),
        ({"sensor": "iphone"}, "unknown sensor"),
        ({"budget_um": 0.0}, "budget"),
    ],
)
def test_options_say_what_is_wrong(wrong, says):
    with pytest.raises(InputError, match=says):
        CameraPairOptions(**wrong)


def test_a_tooth_without_the_surface_is_refused(coarse_phantom):
    with pytest.raises(InputError, match="tooth 41 has no occlusal"):
        study_camera_pair(coarse_phantom, CameraPairOptions(tooth=41))


# --- Matching noise ---------------------------------------------------------------------------------------------------


@settings(max_examples=10)
@given(sigma=st.floats(0.03, 0.2), doubling=st.floats(0.1, 0.6))
def test_the_fit_finds_the_law_that_made_the_samples(sigma, doubling):
    rng = np.random.default_rng(0)
    deformation = rng.uniform(0, 1, 60_000)
    deviation = sigma * np.sqrt(2 * (1 + (deformation / doubling) ** 2))
    samples = MatchingSamples(
        convergence_deg=np.zeros(60_000), deformation=deformation, error_px=deviation * rng.standard_normal(60_000)
    )
    found = fit_noise(bin_samples(samples, np.linspace(0, 1, 21).tolist()))
    assert found.sigma_px == pytest.approx(sigma, rel=0.1)
    assert found.doubling == pytest.approx(doubling, rel=0.15)


def test_failed_matches_are_counted_and_are_no_noise():
    errors = np.where(np.arange(1000) % 4 == 0, np.nan, 0.1)
    samples = MatchingSamples(convergence_deg=np.zeros(1000), deformation=np.full(1000, 0.3), error_px=errors)
    (row,) = bin_samples(samples, (0.2, 0.4))
    assert row["matched_pct"] == 75
    assert row["sigma_px"] == pytest.approx(0.1 / np.sqrt(2))


def test_upright_windows_suffer_from_deformation_and_slanted_ones_hardly(coarse_phantom: Jaw):
    options = MatchingNoiseOptions(baselines_mm=(2.0,), spacing_px=4)
    samples = sample_matching(coarse_phantom, options, np.random.default_rng(0))
    noise = {
        name: [row["sigma_px"] for row in bin_samples(each, (0.05, 0.15, 0.3, 0.5))] for name, each in samples.items()
    }
    assert 0.02 < noise["slanted"][1] < 0.1
    assert 1.5 * noise["slanted"][1] < noise["upright"][1] < 0.4
    assert noise["upright"][0] < noise["upright"][1] < noise["upright"][2]
