"""A calibration that is held and wrong is told, a right one is not, and neither order nor size of anything decides."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from bundle_scenes import EXTRINSIC_SIGMA, PARAMETER_SIGMA, SIGMA_PX, disturbed, make_rig, make_scene, pose_errors
from cuspid.geometry import Rigid3
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import MountedCamera, Rig
from cuspid.motion.bundle import misfit
from cuspid.motion.bundle.adjustment import AdjustmentOptions, adjust


def notes_of(found: Reconstruction) -> list[str]:
    return [note for note in found.notes if note.startswith("calibration: held")]


def figures_of(note: str) -> tuple[float, str, float, float]:
    """Sigmas, the camera that is farthest, reprojection error now and as expected (px)."""
    sigmas, camera, now, left = re.search(
        r"move it ([\d.]+) standard .* camera (\w+) the most; .* error is ([\d.]+) px .* about ([\d.]+) px",
        note,
    ).groups()
    return float(sigmas), camera, float(now), float(left)


def held_wrongly(name: str, change: dict[str, np.ndarray]) -> Reconstruction:
    """A scan by cameras of which one is not what the file says: its ``motion`` or its ``lens`` differs."""
    mounted = make_rig()[name]
    turn, shift = np.split(change.get("motion", np.zeros(6)), 2)
    camera = mounted.camera.with_parameters(mounted.camera.parameters + change.get("lens", np.zeros(8)))
    moved = MountedCamera(camera, Rigid3.from_rotation_vector(turn, shift) @ mounted.cam_from_rig)
    truth = Rig({**make_rig().cameras, name: moved})
    return disturbed(make_scene(rig=truth, points=400), np.random.default_rng(5), rig=make_rig())


def sliding(start: Reconstruction, sigma_px: float, rng: np.random.Generator) -> Reconstruction:
    """With keypoints that slide over the surface from frame to frame, in all cameras alike."""
    tracks, frames = start.tracks, len(start.frames)
    walks = np.cumsum(rng.normal(0, sigma_px, (len(tracks.points), frames, 2)), axis=1)
    pixels = tracks.pixels + walks[tracks.point_index, tracks.frame_index]
    return replace(start, tracks=replace(tracks, pixels=pixels))


@pytest.mark.long
@pytest.mark.parametrize("slide_px", [0.0, 0.3])
def test_a_right_calibration_is_never_told(slide_px: float) -> None:
    scene = make_scene(points=200)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        assert not adjust(sliding(disturbed(scene, rng), slide_px, rng)).notes, seed


@pytest.mark.parametrize("frames", [2, 4])
def test_small_scans_are_not_either(frames: int) -> None:
    pair = Rig({name: make_rig()[name] for name in ("c0", "c1")})
    for rig in (pair, make_rig()):
        scene = make_scene(rig=rig, frames=frames, points=60)
        for seed in range(4):
            assert not adjust(disturbed(scene, np.random.default_rng(seed))).notes, (len(rig.names), seed)


@pytest.mark.long
def test_the_pull_is_chi_squared_where_nothing_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """So what is told is what the keypoints' own scatter cannot explain, neither more nor less."""
    seen = []
    wanted = misfit.ScoreTest.one_step_estimate

    def noted(pull: misfit.ScoreTest) -> tuple[np.ndarray, float, int]:
        seen.append(wanted(pull._replace(curvature=1e-9 * pull.curvature)))
        return wanted(pull)

    monkeypatch.setattr(misfit.ScoreTest, "one_step_estimate", noted)
    monkeypatch.setattr(misfit, "_OBSERVABLE", 1e-11)
    scene = make_scene(points=400)
    for seed in range(5):
        adjust(disturbed(scene, np.random.default_rng(seed)))
    mean = np.mean([square * (1 - directions / 400) / directions for _, square, directions in seen])
    assert all(60 < directions <= 6 * 14 - 7 for *_, directions in seen)  # never the similarity of the rig
    assert 0.8 < mean < 1.25


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("c4", {"motion": np.array([0, 0, 0, 0, 0.02, 0])}),
        ("c1", {"motion": np.array([0, 0.003, 0, 0, 0, 0])}),
        ("c2", {"lens": np.array([0, 0, 1.0, 0, 0, 0, 0, 0])}),
        ("c0", {"lens": np.array([2.0, 2.0, 0, 0, 0, 0, 0, 0])}),
        ("c5", {"lens": np.array([0, 0, 0, 0, 0.02, 0, 0, 0])}),
    ],
)
def test_a_wrong_one_is_told_with_its_camera_and_what_is_expected(name: str, change: dict[str, np.ndarray]) -> None:
    note, *more = notes_of(adjust(held_wrongly(name, change)))
    sigmas, camera, now, left = figures_of(note)
    assert not more
    assert camera == name
    assert sigmas > 1.3
    assert now > left
    assert left == pytest.approx(np.sqrt(2 * np.log(2)) * SIGMA_PX, rel=0.15)  # the median of a Rayleigh distribution


def test_what_is_smaller_than_what_is_allowed_is_not_told() -> None:
    start = held_wrongly("c1", {"lens": np.array([0, 0, 0.03, 0, 0, 0, 0, 0])})
    assert not adjust(start).notes


@pytest.mark.long
def test_neither_the_order_of_the_cameras_nor_the_unit_of_length_decides() -> None:
    start = held_wrongly("c4", {"motion": np.array([0, 0, 0, 0, 0.02, 0])})
    names = start.rig.names
    expected = figures_of(notes_of(adjust(start))[0])
    for other in (start.with_cameras_as(names[::-1]), start.with_cameras_as(names[2:] + names[:2]), enlarged(start)):
        assert figures_of(notes_of(adjust(other))[0]) == pytest.approx(expected)


def enlarged(start: Reconstruction, size: float = 7.0) -> Reconstruction:
    """Every length times so much; the images stay the same."""

    def larger(pose: Rigid3) -> Rigid3:
        return Rigid3(pose.rotation, size * pose.translation)

    return replace(
        start,
        rig=Rig(
            {name: replace(each, cam_from_rig=larger(each.cam_from_rig)) for name, each in start.rig.cameras.items()}
        ),
        rig_from_world={name: larger(pose) for name, pose in start.rig_from_world.items()},
        tracks=replace(start.tracks, points=size * start.tracks.points),
    )


def test_a_handpiece_that_is_larger_than_its_file_is_beyond_any_image() -> None:
    """The similarity of the whole rig: no test can tell."""
    scene = make_scene()
    start = disturbed(scene, np.random.default_rng(0))
    assert not adjust(replace(enlarged(start, 1.02), tracks=start.tracks), AdjustmentOptions(start_px=200.0)).notes


def part_held(start: Reconstruction) -> Reconstruction:
    """With places free, and lenses held."""
    covariance = np.diag(EXTRINSIC_SIGMA**2)
    return replace(
        start, rig=Rig({name: replace(each, covariance=covariance) for name, each in start.rig.cameras.items()})
    )


@pytest.mark.long
def test_of_a_calibration_that_is_partly_held_that_part_is_tested() -> None:
    right = held_wrongly("c1", {"motion": np.array([0, 2e-3, 0, 0.02, 0, 0])})
    wrong = held_wrongly("c1", {"lens": np.array([0, 0, 0, 0, 0.05, 0, 0, 0])})
    assert notes_of(adjust(right))
    assert not notes_of(adjust(part_held(right)))
    assert figures_of(notes_of(adjust(part_held(wrong)))[0])[1] == "c1"


def test_what_is_refined_is_not_tested_as_held() -> None:
    wrong = held_wrongly("c1", {"lens": np.array([0, 0, 1.0, 0, 0, 0, 0, 0])})
    camera = replace(make_rig()["c1"].camera, covariance=np.diag(PARAMETER_SIGMA**2))
    cameras = {name: replace(each, camera=camera) for name, each in part_held(wrong).rig.cameras.items()}
    assert not notes_of(adjust(replace(wrong, rig=Rig(cameras))))


def test_of_few_tracks_a_right_calibration_is_not_called_wrong() -> None:
    scene = make_scene(points=12)
    found = adjust(disturbed(scene, np.random.default_rng(0)))
    assert not notes_of(found)
    assert 1e-4 < np.abs(pose_errors(found, scene.rig_from_world)).max() < 0.05
