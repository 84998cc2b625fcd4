"""Guided and unguided matching, and tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.motion.frontend.features import DESCRIPTOR_NORM, Features
from cuspid.motion.frontend.pairs import (
    IndexedFeatures,
    MatchingOptions,
    frame_pairs,
    index_features,
    match_guided,
    match_unguided,
)
from cuspid.motion.frontend.tracks import intersect_rays, join, thin

B_FROM_A = Rigid3.from_rotation_vector(np.array([0.02, -0.05, 0.03]), np.array([-1.2, 0.3, 0.1]))


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random ones of the right length."""
    raw = rng.gamma(0.5, size=(count, 128))
    return np.minimum(DESCRIPTOR_NORM * np.sqrt(raw / raw.sum(axis=1, keepdims=True)), 255).astype(np.uint8)


def view_of(pixels: np.ndarray, words: np.ndarray, camera: Camera) -> IndexedFeatures:
    """Keypoints at given places."""
    return index_features(
        Features(pixels=pixels, descriptors=words, colors=np.zeros((len(pixels), 3), np.uint8)), camera
    )


def full_range(view: IndexedFeatures) -> tuple[np.ndarray, np.ndarray]:
    """A generous depth of field."""
    return np.full(len(view.features), 2.0), np.full(len(view.features), 10.0)


def scene(seed: int, count: int = 60) -> tuple[IndexedFeatures, IndexedFeatures, np.ndarray]:
    """Two distorted views of points, and the depth of the points in the first."""
    rng = np.random.default_rng(seed)
    camera = Camera.from_field_of_view(500, 500, 62.0)
    camera = camera.with_parameters(camera.parameters + [0, 3, 2, -2, -0.1, 0.02, 1e-3, -1e-3])
    points = np.column_stack([rng.uniform(-1.5, 1.5, (count, 2)), rng.uniform(4, 6, count)])
    words = descriptors(rng, count)
    first = view_of(camera.project(points), words, camera)
    second = view_of(camera.project(B_FROM_A.apply(points)), words, camera)
    return first, second, points[:, 2]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000))
def test_true_matches_lie_on_their_segments(seed: int) -> None:
    """Each point finds itself, with lens distortion and a turn."""
    a, b, _ = scene(seed)
    found = match_guided(a, b, B_FROM_A, full_range(a), full_range(b), MatchingOptions(ratio=1.0))
    np.testing.assert_array_equal(found, np.column_stack([np.arange(60)] * 2))


def test_matching_is_symmetric() -> None:
    """Exchanging the images exchanges the columns."""
    a, b, _ = scene(3)
    forth = match_guided(a, b, B_FROM_A, full_range(a), full_range(b))
    back = match_guided(b, a, B_FROM_A.inverse(), full_range(b), full_range(a))
    np.testing.assert_array_equal(forth, back[np.argsort(back[:, 1])][:, ::-1])


def test_same_descriptors_are_told_apart_by_the_geometry() -> None:
    """All keypoints look alike; narrow depth bounds leave one candidate for most of them, and none is wrong."""
    a, b, depth = scene(4)
    same = np.broadcast_to(a.features.descriptors[0], a.features.descriptors.shape)
    a, b = (replace(v, features=replace(v.features, descriptors=np.ascontiguousarray(same))) for v in (a, b))
    in_b = B_FROM_A.apply(np.column_stack([a.ideal, np.ones(60)]) * depth[:, None])[:, 2]
    bounds = [(d - 0.05, d + 0.05) for d in (depth, in_b)]
    found = match_guided(a, b, B_FROM_A, bounds[0], bounds[1])
    assert len(found) > 40
    np.testing.assert_array_equal(found[:, 0], found[:, 1])


def test_points_outside_the_depth_of_field_are_not_matched() -> None:
    """The bounds are what keeps the specious points out."""
    a, b, depth = scene(5)
    far = depth > 5
    low, high = np.full(60, 2.0), np.full(60, 4.7)
    found = match_guided(a, b, B_FROM_A, (low, high), (low, high))
    assert not far[found[:, 0]].any()
    assert (depth[found[:, 0]] < 5).all()
    assert len(found) > 5


def test_another_image_has_no_matches() -> None:
    """Random descriptors are refused, guided or not; nothing matches nothing."""
    a, b, _ = scene(6)
    other = replace(b, features=replace(b.features, descriptors=descriptors(np.random.default_rng(99), 60)))
    assert len(match_guided(a, other, B_FROM_A, full_range(a), full_range(b))) == 0
    assert len(match_unguided(a.features, other.features)) == 0
    none = view_of(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), Camera.from_field_of_view(500, 500, 62.0))
    assert len(match_guided(a, none, B_FROM_A, full_range(a), full_range(none))) == 0
    assert len(match_unguided(none.features, a.features)) == 0


def test_unguided_matches_are_the_true_ones() -> None:
    """A permutation is undone."""
    a, b, _ = scene(7)
    order = np.random.default_rng(0).permutation(60)
    shuffled = replace(b.features, pixels=b.features.pixels[order], descriptors=b.features.descriptors[order])
    found = match_unguided(a.features, shuffled)
    assert len(found) == 60
    np.testing.assert_array_equal(order[found[:, 1]], found[:, 0])


def test_frame_pairs_are_lean() -> None:
    """Each frame with the next ones only."""
    assert frame_pairs(4, 2) == ((0, 1), (0, 2), (1, 2), (1, 3), (2, 3))
    assert frame_pairs(1, 3) == ()


def test_a_match_that_brings_two_keypoints_of_an_image_together_is_left_out() -> None:
    """0-3-5 is a track; 1-4-2 would have two keypoints in image 0; 6 is alone."""
    image = np.array([0, 0, 0, 1, 1, 2, 2])
    track = join(np.array([[0, 3], [3, 5], [1, 4], [4, 2]]), image)
    np.testing.assert_array_equal(track, [0, 1, -1, 0, 1, 0, -1])
    assert len(join(np.zeros((0, 2), np.int64), np.zeros(0, np.int64))) == 0
    np.testing.assert_array_equal(join(np.zeros((0, 2), np.int64), image), np.full(7, -1))


@given(arrays(np.int64, (12, 2), elements=st.integers(0, 8)))
def test_tracks_never_hold_two_keypoints_of_an_image(matches: np.ndarray) -> None:
    image_of = np.repeat(np.arange(3), 3)
    track = join(matches, image_of)
    for number in range(track.max() + 1):
        members = image_of[track == number]
        assert len(members) >= 2
        assert len(set(members.tolist())) == len(members)


def test_a_clash_keeps_the_earlier_matches() -> None:
    track = join(np.array([[0, 2], [1, 2], [2, 4]]), np.array([0, 0, 1, 1, 2, 2]))
    assert track.tolist() == [0, -1, 0, -1, 0, -1]


@given(seed=st.integers(0, 1000))
def test_rays_meet_where_they_were_aimed(seed: int) -> None:
    """And parallel rays do not meet."""
    rng = np.random.default_rng(seed)
    points, centres = rng.normal(size=(4, 3)), rng.normal(size=(12, 3)) + [0, 0, 9]
    track = np.repeat(np.arange(4), 3)
    directions = (points[track] - centres) * rng.uniform(0.1, 3, (12, 1))
    np.testing.assert_allclose(intersect_rays(centres, directions, track, 4), points, atol=1e-6)
    assert np.isnan(intersect_rays(centres[:2], np.ones((2, 3)), np.zeros(2, np.int64), 1)).all()


@settings(deadline=None)
@given(seed=st.integers(0, 1000), cell=st.sampled_from([20.0, 50.0]))
def test_thinning_keeps_a_track_in_every_cell(seed: int, cell: float) -> None:
    """No cell that had an observation is left empty, whole tracks stay or go, and some go."""
    rng = np.random.default_rng(seed)
    track, image = rng.integers(0, 200, 800), rng.integers(0, 3, 800)
    pixels = rng.uniform(0, 200, (800, 2))
    keep = thin(track, image, pixels, cell)
    cells = np.column_stack([image, (pixels // cell).astype(int)])
    assert {tuple(c) for c in cells} == {tuple(c) for c in cells[keep]}
    assert all(len(np.unique(keep[track == t])) == 1 for t in np.unique(track))
    if cell == 50.0:
        assert keep.mean() < 0.9


def test_a_cell_keeps_its_longest_track() -> None:
    """Track 1 is longer than track 0 in the same place."""
    track, image = np.array([0, 0, 1, 1, 1]), np.array([0, 1, 0, 1, 2])
    keep = thin(track, image, np.full((5, 2), 10.0), 35.0)
    np.testing.assert_array_equal(keep, [False, False, True, True, True])
    assert thin(track[:0], image[:0], np.zeros((0, 2)), 35.0).shape == (0,)


@pytest.mark.parametrize("ratio", [0.5, 0.8])
def test_ambiguous_matches_are_refused(ratio: float) -> None:
    """Two equal keypoints elsewhere on the line leave none."""
    a, b, _ = scene(8, count=1)
    features = b.features
    double = Features(
        pixels=np.vstack([features.pixels, features.pixels + [8.0, 0.0]]),
        descriptors=np.repeat(features.descriptors, 2, axis=0),
        colors=np.repeat(features.colors, 2, axis=0),
    )
    wide = MatchingOptions(ratio=ratio, tolerance_px=20.0)
    twice = index_features(double, Camera.from_field_of_view(500, 500, 62.0))
    assert len(match_guided(a, b, B_FROM_A, full_range(a), full_range(b), wide)) == 1
    assert len(match_guided(a, twice, B_FROM_A, full_range(a), full_range(twice), wide)) == 0
