"""What a panorama scores whose errors are known."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid import storage
from cuspid.cli import main
from cuspid.evaluation import panorama as evaluation
from cuspid.evaluation.panorama import (
    Similarity2,
    grey,
    image_scores,
    inter_molar_error,
    own_direction,
    seen_by_frames,
    trace_pixels,
    trivial_scores,
)
from cuspid.geometry import Rigid3
from cuspid.model.jaw import Jaw
from cuspid.model.panorama import FrameUse, Panorama
from cuspid.runtime.errors import InputError
from panoramas import STEP_MM, Known, known_film, score, write_truth


@pytest.fixture(scope="module")
def known(coarse_phantom: Jaw) -> Known:
    return known_film(coarse_phantom)


def test_a_perfect_panorama_has_no_error(known: Known) -> None:
    found = score(known, known.panorama)
    assert found.failure is None
    # Rays at the edges of teeth may meet what lies below them; all others end where they began.
    assert found.geometry.median_mm < 1e-3
    assert found.geometry.p95_mm < 0.02
    assert abs(found.geometry.scale_error_pct) < 0.05
    assert found.geometry.tilt_deg < 0.02
    assert found.geometry.own_median_mm < 1e-3
    assert abs(found.inter_molar_error_mm) < 0.02
    assert found.complete
    assert found.coverage_pct > 99.5
    assert min(found.tooth_coverage_pct.values()) > 99
    assert found.picture.ssim_teeth > 0.98
    assert found.picture.zncc > 0.99
    assert found.picture.ssim_full > 0.99


@given(st.floats(0.1, 12.0), st.floats(0.0, 360.0), st.floats(0.5, 2.0), st.floats(-180.0, 180.0))
def test_a_jaw_seen_from_another_direction_is_told_by_its_angle(
    tilt_deg: float, azimuth_deg: float, scale: float, turn_deg: float
) -> None:
    """Along its own direction such a picture has no error but what is added; along that of the jaw it has."""
    rng = np.random.default_rng(0)
    true = rng.uniform([-30, -20, -6], [30, 20, 1], (400, 3))
    azimuth = np.deg2rad(azimuth_deg)
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    turned = Rigid3.from_rotation_vector(np.deg2rad(tilt_deg) * axis, np.zeros(3)).rotate(true)[:, :2]
    noise = rng.normal(0, 0.01, turned.shape)
    about = np.deg2rad(turn_deg)
    spin = np.array([[np.cos(about), -np.sin(about)], [np.sin(about), np.cos(about)]])
    turn, errors = own_direction(scale * (turned + noise) @ spin.T + [3.0, -4.0], true)
    assert np.rad2deg(np.arccos(turn.rotation[2, 2])) == pytest.approx(tilt_deg, abs=0.05)
    assert np.median(errors) == pytest.approx(np.median(np.linalg.norm(noise, axis=1)), rel=0.1)


def test_a_flat_jaw_has_no_direction_of_its_own() -> None:
    flat = np.column_stack([np.random.default_rng(1).uniform(-20, 20, (50, 2)), np.zeros(50)])
    turn, errors = own_direction(flat[:, :2], flat)
    assert turn.rotation[2, 2] == pytest.approx(1.0)
    assert errors.max() < 1e-9


@pytest.mark.parametrize(
    ("turn_deg", "scale", "shift"), [(0.0, 1.0, (7.0, -3.0)), (25.0, 1.0, (0.0, 0.0)), (-90.0, 1.2, (1.0, 2.0))]
)
def test_a_similarity_is_no_error_but_its_scale_is_told(known: Known, turn_deg, scale, shift) -> None:
    plain = score(known, known.panorama)
    found = score(known, moved(known.panorama, turn_deg, scale, np.array(shift)))
    assert found.geometry.median_mm < 0.5 * STEP_MM
    assert found.geometry.scale_error_pct == pytest.approx(100 * (scale - 1), abs=0.1)
    # The same number of pixels, of another size: the distance between the molars is wrong by the scale.
    assert found.inter_molar_error_mm == pytest.approx(50 * (1 / scale - 1), abs=1.5)
    assert found.picture.ssim_teeth > 0.80
    assert found.coverage_pct == pytest.approx(plain.coverage_pct, abs=1.0)


def moved(panorama: Panorama, turn_deg: float, scale: float, shift_mm: np.ndarray) -> Panorama:
    """The panorama turned on its canvas and shifted in its world, with pixels that claim to be smaller by ``scale``."""
    height, width = panorama.covered.shape
    matrix = cv2.getRotationMatrix2D((width / 2 - 0.5, height / 2 - 0.5), turn_deg, 1.0)
    side = int(1.5 * max(height, width))
    matrix[:, 2] += (side - width) / 2, (side - height) / 2

    def turned(array: np.ndarray, flag: int, border: float) -> np.ndarray:
        return cv2.warpAffine(array, matrix, (side, side), flags=flag, borderValue=(border, border, border))

    return replace(
        panorama,
        image=turned(panorama.image, cv2.INTER_LINEAR, 0),
        covered=turned(panorama.covered.astype(np.uint8), cv2.INTER_NEAREST, 0) > 0,
        frame_index=turned(panorama.frame_index, cv2.INTER_NEAREST, -1),
        frame_pixel=turned(panorama.frame_pixel, cv2.INTER_NEAREST, np.nan),
        origin_px=np.array([40.0, 50.0]) + shift_mm,
        mm_per_px=panorama.mm_per_px / scale,
    )


def tilted_places(panorama: Panorama, pixels: int) -> Panorama:
    """Cells of 1 mm are shown so many pixels to the right or to the left of where they should be, at random."""
    rng = np.random.default_rng(0)
    height, width = panorama.covered.shape
    cells = rng.random((height // 5 + 1, width // 5 + 1)) < 0.5
    right = np.kron(cells, np.ones((5, 5), dtype=bool))[:height, :width]

    def taken(array: np.ndarray) -> np.ndarray:
        sides = np.roll(array, pixels, axis=1), np.roll(array, -pixels, axis=1)
        return np.where(right.reshape(right.shape + (1,) * (array.ndim - 2)), *sides)

    return replace(
        panorama,
        image=taken(panorama.image),
        covered=taken(panorama.covered),
        frame_index=taken(panorama.frame_index),
        frame_pixel=taken(panorama.frame_pixel),
    )


@pytest.mark.parametrize("pixels", [1, 5])
def test_shifts_of_s_mm_score_s(known: Known, pixels: int) -> None:
    found = score(known, tilted_places(known.panorama, pixels)).geometry
    shift = pixels * STEP_MM
    for figure in (found.median_mm, found.rms_mm, found.p95_mm):
        assert figure == pytest.approx(shift, rel=0.1)


def test_worse_places_score_worse(known: Known) -> None:
    scores = [score(known, tilted_places(known.panorama, pixels)).picture for pixels in (0, 1, 3)]
    for name in ("zncc", "ssim_teeth", "ssim_teeth_fitted", "ssim_full"):
        figures = [getattr(each, name) for each in scores]
        assert figures == sorted(figures, reverse=True)
        assert figures[0] > figures[1] + 0.01


@given(
    turn=st.floats(-3, 3),
    scale=st.floats(0.3, 3),
    shift=st.tuples(st.floats(-50, 50), st.floats(-50, 50)),
    seed=st.integers(0, 100),
)
def test_the_best_similarity_is_found(turn: float, scale: float, shift: tuple[float, float], seed: int) -> None:
    source = np.random.default_rng(seed).normal(0, 20, (30, 2))
    linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    true = Similarity2(linear, np.array(shift))
    found = Similarity2.best(source, true.apply(source))
    np.testing.assert_allclose(found.apply(source), true.apply(source), atol=1e-8)
    np.testing.assert_allclose(found.inverse().apply(true.apply(source)), source, atol=1e-8)
    assert found.scale == pytest.approx(scale)


@given(stretch=st.floats(0.001, 0.1), seed=st.integers(0, 100))
def test_a_stretch_leaves_half_of_it_in_each_direction(stretch: float, seed: int) -> None:
    points = np.random.default_rng(seed).normal(0, 20, (4000, 2))
    stretched = points * [1 + stretch, 1]
    left = Similarity2.best(stretched, points).apply(stretched) - points
    expected = stretch / 2 * np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))
    assert np.sqrt(np.mean(np.sum(left**2, axis=1))) == pytest.approx(expected, rel=0.12)


def test_gain_and_offset_do_not_change_the_fitted_scores(known: Known) -> None:
    truth, teeth = grey(known.view.image), known.view.teeth
    everywhere = np.ones_like(teeth)
    same = image_scores(truth, everywhere, truth, teeth)
    dimmed = image_scores(0.5 * truth + 0.1, everywhere, truth, teeth)
    for name in ("zncc", "ssim_teeth_fitted"):
        assert getattr(dimmed, name) == pytest.approx(getattr(same, name), abs=1e-9) == 1
    assert dimmed.ssim_teeth < 0.95
    halved = image_scores(0.5 * truth, everywhere, truth, teeth)
    assert halved.ssim_full_fitted == pytest.approx(1, abs=1e-9)
    assert halved.ssim_full < 0.95


def test_what_was_not_seen_lowers_only_the_score_of_the_canvas(known: Known) -> None:
    truth, teeth = grey(known.view.image), known.view.teeth
    seen = teeth & (np.arange(teeth.shape[1]) < teeth.shape[1] // 2)
    near = cv2.dilate(seen.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    half = image_scores(truth, near, truth, teeth, seen)
    assert half.ssim_seen == pytest.approx(1, abs=1e-6)
    assert half.ssim_full < 0.9
    assert image_scores(truth, near, truth, teeth).ssim_seen is None
    assert image_scores(0 * truth, near, truth, teeth, seen).ssim_seen < 0.5


def test_trivial_pictures_score_as_they_deserve(known: Known) -> None:
    scores = trivial_scores(known.view)
    assert scores["empty"].zncc == scores["grey canvas"].zncc == 0
    assert scores["empty"].ssim_teeth < 0.1
    assert scores["empty"].ssim_teeth_fitted < 0.1
    # The whole canvas flatters: an empty picture agrees with the background.
    assert scores["empty"].ssim_full > 0.4
    assert scores["grey jaw"].ssim_full > scores["empty"].ssim_full
    assert scores["truth shifted by 1 mm"].ssim_teeth < 0.6


def test_what_is_not_shown_is_missing(known: Known) -> None:
    half = known.panorama.covered.copy()
    half[:, : int(known.view.origin_px[0])] = False
    found = score(
        known, replace(known.panorama, covered=half, frame_index=np.where(half, known.panorama.frame_index, -1))
    )
    assert found.coverage_pct == pytest.approx(50, abs=4)
    assert not found.complete
    assert found.inter_molar_error_mm is None
    assert found.tooth_coverage_pct[46] > 99 or found.tooth_coverage_pct[36] > 99
    assert min(found.tooth_coverage_pct.values()) < 1
    assert found.geometry.median_mm < 1e-3
    assert 0.4 < found.picture.ssim_teeth < 0.6


def test_what_no_frame_saw_is_not_asked_for(known: Known) -> None:
    mounted = known.truth.handpiece.rig["camera"]
    aside = Rigid3(np.eye(3), np.array([48.0, 0, 0]))
    truth = replace(known.truth, rig_from_world={"00000": aside})
    seen = seen_by_frames(known.view, truth)
    points = known.view.points_at(known.view.teeth)
    inside = mounted.camera.contains(mounted.camera.project((mounted.cam_from_rig @ aside).apply(points)))
    assert 0.3 < inside.mean() < 0.7
    assert seen[known.view.teeth].mean() == pytest.approx(inside.mean(), abs=0.04)
    assert np.mean(seen[known.view.teeth] == inside) > 0.95


def shuffled(made: Panorama) -> Panorama:
    pixels = made.frame_pixel.copy()
    where = made.frame_index >= 0
    pixels[where] = np.random.default_rng(0).permutation(pixels[where])
    return replace(made, frame_pixel=pixels)


def coarse(made: Panorama) -> Panorama:
    parts = {name: getattr(made, name)[::4, ::4] for name in ("image", "covered", "frame_index", "frame_pixel")}
    return replace(made, **parts, mm_per_px=None)


def unplaced(made: Panorama) -> Panorama:
    return replace(made, frames=tuple(replace(each, used=False) for each in made.frames))


def empty(made: Panorama) -> Panorama:
    return replace(made, frame_pixel=np.where(np.isfinite(made.frame_pixel), np.float32(1), np.float32(np.nan)))


BROKEN: dict[str, Callable[[Panorama], Panorama]] = {
    "true ones": lambda made: replace(made, mm_per_px=made.mm_per_px * 3),
    "one pixel for": coarse,
    "no arch": shuffled,
    "frames are placed": unplaced,
    "show teeth": empty,
}


@pytest.mark.parametrize("reason", BROKEN)
def test_a_collapsed_panorama_failed_and_has_no_score(known: Known, reason: str) -> None:
    found = score(known, BROKEN[reason](known.panorama))
    assert found.failure is not None
    assert reason in found.failure
    assert found.geometry is found.picture is found.coverage_pct is None
    assert not found.complete


def test_frames_of_another_film_are_refused(known: Known) -> None:
    other = (*known.panorama.frames, FrameUse(name="elsewhere", used=True))
    with pytest.raises(InputError, match="no frame 'elsewhere'"):
        score(known, replace(known.panorama, frames=other))
    numbered = tuple(replace(each, name=str(k)) for k, each in enumerate(known.panorama.frames))
    assert len(trace_pixels(replace(known.panorama, frames=numbered), known.truth, 5000).labels) > 1000


def test_molars_of_one_side_have_no_distance(known: Known) -> None:
    traced = trace_pixels(known.panorama, known.truth, 100_000)
    assert inter_molar_error(traced, 1.0) == pytest.approx(0, abs=0.02)
    one_side = replace(traced, labels=np.where(traced.labels > 40, 0, traced.labels))
    assert inter_molar_error(one_side, 1.0) is None


def test_reference_renders_are_read_as_they_were_written(known: Known, tmp_path: Path) -> None:
    truth = write_truth(known, tmp_path)
    for name, view in (("occlusal", known.view), ("shot", known.shot)):
        read = storage.read_reference_render(truth / name)
        for array in ("image", "labels", "height_mm", "origin_px"):
            np.testing.assert_array_equal(getattr(read, array), getattr(view, array))
        assert (read.mm_per_px, read.camera_height_mm) == (view.mm_per_px, view.camera_height_mm)


def test_a_camera_at_a_height_sees_what_stands_out_farther_out(known: Known) -> None:
    flat, high = known.view, known.shot
    points = flat.points_at(flat.teeth)
    np.testing.assert_allclose(flat.on_plane(points), points[:, :2])
    far = np.linalg.norm(points[:, :2], axis=1) > 5
    grown = np.linalg.norm(high.on_plane(points), axis=1) / np.linalg.norm(points[:, :2], axis=1)
    np.testing.assert_allclose(grown[far], 300 / (300 - points[far, 2]))
    again = known.truth.jaw.mesh.closest(high.points_at(high.teeth))[0]
    assert np.median(again) < 1e-3


def test_stitch_eval_writes_its_figures_and_refuses_what_it_cannot_judge(
    known: Known, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = write_truth(known, tmp_path)
    storage.write_panorama(tmp_path / "pano", known.panorama)
    main(["pano", "evaluate", str(tmp_path / "pano"), str(truth), "--out", str(tmp_path / "score")])
    written = json.loads((tmp_path / "score" / "score.json").read_text())
    assert written["geometry"]["median_mm"] < 1e-3
    assert set(written["trivial"]) == {"empty", "grey canvas", "grey jaw", "truth shifted by 1 mm"}
    assert (tmp_path / "score" / "score.png").stat().st_size > 20_000
    assert "complete in 1 part" in capsys.readouterr().err
    (tmp_path / "notes.png").write_text("hello")
    for wrong in (tmp_path / "missing", tmp_path / "notes.png"):
        with pytest.raises(SystemExit, match="1"):
            main(["pano", "evaluate", str(wrong), str(truth), "--out", str(tmp_path / "none")])
        assert not (tmp_path / "none").exists()


def test_a_picture_of_another_program_is_laid_over_by_its_features(known: Known, tmp_path: Path) -> None:
    truth = write_truth(known, tmp_path)
    turned = moved(known.panorama, 30.0, 1.0, np.zeros(2)).image
    storage.write_image(tmp_path / "other.png", turned)
    main(["pano", "evaluate", str(tmp_path / "other.png"), str(truth), "--out", str(tmp_path / "score")])
    written = json.loads((tmp_path / "score" / "score.json").read_text())
    assert written["aligned_by"] == "pictures"
    assert written["geometry"] is None
    assert written["picture"]["zncc"] > 0.9
    assert written["coverage_pct"] > 95


@pytest.mark.parametrize("scale", [0.0, 1e-4])
def test_a_picture_that_lies_on_one_place_failed(
    known: Known, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scale: float
) -> None:
    truth = write_truth(known, tmp_path)
    storage.write_image(tmp_path / "other.png", known.panorama.image)
    onto_one_place = Similarity2(scale * np.eye(2), np.zeros(2))
    monkeypatch.setattr(evaluation, "align_by_pictures", lambda *_: onto_one_place)
    main(["pano", "evaluate", str(tmp_path / "other.png"), str(truth), "--out", str(tmp_path / "score")])
    written = json.loads((tmp_path / "score" / "score.json").read_text())
    assert "the whole picture lies on" in written["failure"]
    assert written["picture"] is None
