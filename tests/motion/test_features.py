"""Keypoints: accuracy under a known motion, spread, cache."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from builders import folder_capture, image_path, mottled
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Capture
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.motion.frontend.features import (
    DESCRIPTOR_NORM,
    FeatureOptions,
    detect,
    detect_all,
    drop_duplicates,
    select_evenly,
)
from cuspid.motion.frontend.pairs import match_unguided
from cuspid.motion.frontend.pictures import Pictures
from cuspid.runtime.errors import InputError, OutputError

SIZE = 240


def texture(seed: int = 0) -> np.ndarray:
    """Much larger than an image."""
    return mottled(np.random.default_rng(seed), 900)


def photograph(texture_px_from_px: np.ndarray, seed: int = 0, noise: float = 1.5) -> np.ndarray:
    """An RGB image; the matrix takes COLMAP's pixels to texture coordinates, whose first centre is (0.5, 0.5) too."""
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    matrix = np.linalg.inv(shift) @ texture_px_from_px @ shift
    gray = cv2.warpPerspective(
        texture(), matrix, (SIZE, SIZE), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT
    )
    noisy = gray + np.random.default_rng(seed).normal(0, noise, gray.shape)
    return np.repeat(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


TURN = np.deg2rad(4)
FIRST = np.array([[1.5, 0, 200], [0, 1.5, 200], [0, 0, 1]])
SECOND = np.array(
    [[1.4 * np.cos(TURN), -1.5 * np.sin(TURN), 230.3], [1.4 * np.sin(TURN), 1.5 * np.cos(TURN), 190.7], [0, 1e-5, 1]]
)


def move(matrix: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Apply a homography."""
    moved = np.column_stack([pixels, np.ones(len(pixels))]) @ matrix.T
    return moved[:, :2] / moved[:, 2:]


def test_keypoints_are_accurate_and_unbiased() -> None:
    """Between two noisy views of a texture: sub-pixel, and without the half pixel of a wrong origin."""
    a, b = detect(photograph(FIRST, 1)), detect(photograph(SECOND, 2))
    pairs = match_unguided(a, b)
    errors = b.pixels[pairs[:, 1]] - move(np.linalg.inv(SECOND) @ FIRST, a.pixels[pairs[:, 0]])
    good = np.linalg.norm(errors, axis=1) < 2
    assert good.mean() > 0.95
    assert good.sum() > 150
    assert 0.03 < np.sqrt(np.mean(errors[good] ** 2)) < 0.3
    assert np.abs(errors[good].mean(axis=0)).max() < 0.05


@pytest.mark.parametrize(("halved_from_px", "halvings"), [(None, None), (100, None), (100, 2)])
@pytest.mark.parametrize("size", [SIZE, SIZE + 1])
def test_a_blob_lies_where_it_was_drawn(size: int, halved_from_px: int | None, halvings: int | None) -> None:
    """The pixel origin: a Gaussian blob centred on the corner between pixels (60, 80) has COLMAP's (60, 80), also where
    the image is halved, or that again, of an odd size too."""
    x, y = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    gray = 60 + 150 * np.exp(-((x - 60) ** 2 + (y - 80) ** 2) / (2 * 4.0**2))
    image = np.repeat(np.rint(gray).astype(np.uint8)[..., None], 3, axis=2)
    nearest = detect(image, FeatureOptions(halved_from_px=halved_from_px, halvings=halvings)).pixels - [60, 80]
    assert np.linalg.norm(nearest, axis=1).min() < 0.05 * (halvings or 1)


def test_the_smallest_image_that_is_halved_twice_is_searched() -> None:
    """OpenCV fails on images of fewer than 3 px."""
    image = np.random.default_rng(0).integers(0, 255, (16, 16, 3)).astype(np.uint8)
    assert len(detect(image, FeatureOptions(halved_from_px=16, halvings=2))) == 0


def test_descriptors_have_their_length_and_colors_their_place() -> None:
    """RootSIFT of length 512; the colour is the image's."""
    image = photograph(FIRST)
    found = detect(image)
    lengths = np.linalg.norm(found.descriptors.astype(float), axis=1)
    assert np.all(np.abs(lengths / DESCRIPTOR_NORM - 1) < 0.03)
    row, column = found.pixels[7].astype(int)[::-1]
    np.testing.assert_array_equal(found.colors[7], image[row, column])


def test_count_and_uniqueness() -> None:
    """No more than asked for, and no place twice."""
    found = detect(photograph(FIRST), FeatureOptions(count=100))
    assert len(found) == 100
    assert len(np.unique(found.pixels.round(3), axis=0)) == 100


def test_turned_images_match_with_orientations_only() -> None:
    """Upright descriptors are for a handpiece that keeps its roll; the option is there for one that does not."""
    image = photograph(FIRST)
    turned = np.ascontiguousarray(np.rot90(image))
    upright = match_unguided(detect(image), detect(turned))
    free = FeatureOptions(upright=False)
    turning = match_unguided(detect(image, free), detect(turned, free))
    assert len(turning) > 100
    assert len(upright) < 0.1 * len(turning)


def test_a_place_with_several_orientations_is_one_keypoint() -> None:
    """The first that was found there, in the order in which they were found."""
    gray = cv2.cvtColor(photograph(FIRST), cv2.COLOR_RGB2GRAY)
    keypoints = cv2.SIFT.create(contrastThreshold=0.01).detect(gray, None)
    expected = dict[tuple[float, ...], cv2.KeyPoint]()
    for keypoint in keypoints:
        expected.setdefault((*np.round(keypoint.pt, 2).tolist(), round(keypoint.size, 2)), keypoint)
    assert 100 < len(expected) < 0.95 * len(keypoints)
    assert drop_duplicates(keypoints) == list(expected.values())
    assert drop_duplicates([]) == []


@pytest.mark.parametrize("gray", [0, 128, 255])
def test_a_plain_image_has_no_keypoints(gray: int) -> None:
    """And is no error."""
    assert len(detect(np.full((SIZE, SIZE, 3), gray, np.uint8))) == 0


@given(count=st.integers(1, 60), seed=st.integers(0, 100))
def test_spread_takes_the_strongest_of_each_cell_first(count: int, seed: int) -> None:
    """A keypoint that is left out has no stronger rank in its cell than any taken; some lie off the image by a hair."""
    rng = np.random.default_rng(seed)
    pixels, strengths = rng.uniform([-0.4, 0], 100, (80, 2)), rng.random(80)
    chosen = select_evenly(pixels, strengths, count, 25)
    assert len(chosen) == len(np.unique(chosen)) == min(count, 80)
    cells = (pixels // 25).astype(int) @ [1, 10]
    rank = np.array([np.sum((cells == cells[k]) & (strengths > strengths[k])) for k in range(80)])
    left = np.setdiff1d(np.arange(80), chosen)
    assert len(left) == 0 or rank[chosen].max() <= rank[left].min()


# --- captures ----------------------------------------------------------------------------------------------------


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Two cameras and two frames on disk."""
    camera = Camera.from_field_of_view(SIZE, SIZE, 62.0)
    rig = Rig({name: MountedCamera(camera, Rigid3.identity()) for name in ("a", "b")})
    made = folder_capture(tmp_path, Handpiece(rig=rig), ("00000", "00001"))
    for camera_name in rig.names:
        for k, frame in enumerate(made.frames):
            path = image_path(made, frame.name, camera_name)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), photograph(FIRST + [[0, 0, 9 * k], [0, 0, 0], [0, 0, 0]]))
    return made


def test_all_images_are_read_once(capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A second run takes every image from the cache and finds the same; a changed option or image does not."""
    seen: list[tuple[str, int, int]] = []
    cache = tmp_path / "cache"
    first = detect_all(Pictures(capture), cache=cache, progress=lambda *step: seen.append(step))
    assert seen == [("features", k, 4) for k in (1, 2, 3, 4)]
    assert set(first) == {(f"{k:05d}", c) for k in (0, 1) for c in "ab"}
    reads: list[object] = []
    original = Capture.fine_image
    monkeypatch.setattr(Capture, "fine_image", lambda self, *which: reads.append(which) or original(self, *which))
    again = detect_all(Pictures(capture), cache=cache)
    assert not reads
    np.testing.assert_array_equal(again["00001", "b"].descriptors, first["00001", "b"].descriptors)
    np.testing.assert_array_equal(again["00001", "b"].pixels, first["00001", "b"].pixels)
    cv2.imwrite(str(image_path(capture, "00001", "b")), photograph(SECOND))
    detect_all(Pictures(capture), cache=cache)
    assert reads == [(capture.frames[1], "b")]
    assert len(detect_all(Pictures(capture), FeatureOptions(count=10), cache=cache)["00000", "a"]) == 10


def test_grey_pictures_are_read_once_as_far_as_memory_goes(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that were kept and those that are read again are the same."""
    reads: list[tuple[object, ...]] = []
    original = Capture.fine_image
    monkeypatch.setattr(Capture, "fine_image", lambda self, *which: reads.append(which) or original(self, *which))
    every = [(frame, camera) for frame in capture.frames for camera in frame.cameras]
    height, width = original(capture, *every[0]).shape[:2]
    greys, counts = [], []
    for room in (0, 2, 100):
        pictures = Pictures(capture, max_bytes=room * height * width)
        for image in every:
            pictures.image(*image)
        reads.clear()
        greys.append([pictures.grey(*image) for image in every])
        counts.append(len(reads))
    assert counts == [4, 2, 0]
    for some in zip(*greys, strict=True):
        assert some[0].shape == (height, width)
        assert some[0].std() > 0
        np.testing.assert_array_equal(some[0], some[1])
        np.testing.assert_array_equal(some[0], some[2])


def test_a_broken_cache_file_is_made_again(capture: Capture, tmp_path: Path) -> None:
    """A run that was killed while writing leaves nothing that a later one trusts."""
    cache = tmp_path / "cache"
    first = detect_all(Pictures(capture), cache=cache)
    file = cache / "features" / "a" / "00000.npz"
    file.write_bytes(file.read_bytes()[:500])
    np.testing.assert_array_equal(
        detect_all(Pictures(capture), cache=cache)["00000", "a"].pixels, first["00000", "a"].pixels
    )


def test_bad_images_and_caches_are_told(capture: Capture, tmp_path: Path) -> None:
    """Missing image: InputError with its name; a cache that cannot be written: OutputError."""
    blocked = tmp_path / "blocked"
    blocked.write_text("a file, not a folder")
    with pytest.raises(OutputError, match="blocked"):
        detect_all(Pictures(capture), cache=blocked)
    image_path(capture, "00001", "a").unlink()
    with pytest.raises(InputError, match=r"a/00001\.png"):
        detect_all(Pictures(capture), cache=tmp_path / "cache")


def test_how_many_keypoints_follows_from_the_size_of_the_image() -> None:
    usual = FeatureOptions()
    sizes = ((250, 250), (500, 500), (640, 480), (1280, 960))
    assert [usual.count_for(*size) for size in sizes] == [1000, 1000, 1228, 2000]
    assert FeatureOptions(count=50).count_for(1280, 960) == 50
    fine = replace(usual, cell_px=10)
    assert fine.count_for(200, 250) == replace(usual, cell_px=20).count_for(400, 500) == 1250
