"""Frames that show a place again are found by the look of their keypoints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cuspid.motion.frontend.features import DESCRIPTOR_NORM, Features
from cuspid.motion.frontend.revisits import look_alike


def film(places: np.ndarray, rng: np.random.Generator) -> list[Features]:
    """Frames along a line of 30 keypoints a step, each of which shows eight steps of it, with noise."""
    line = rng.gamma(0.3, size=(30 * (int(places.max()) + 8), 128))

    def frame(place: int) -> Features:
        seen = line[30 * place : 30 * (place + 8)] * rng.lognormal(0, 0.3, (240, 128))
        descriptors = DESCRIPTOR_NORM * np.sqrt(seen / seen.sum(axis=1, keepdims=True))
        order = rng.permutation(240)
        return Features(
            pixels=rng.uniform(0, 400, (240, 2)),
            descriptors=np.minimum(descriptors, 255).astype(np.uint8)[order],
            colors=np.zeros((240, 3), np.uint8),
        )

    return [frame(int(place)) for place in places]


@pytest.mark.parametrize("seed", range(3))
def test_on_the_way_back_each_frame_finds_that_of_the_way_there(seed: int) -> None:
    places = np.concatenate([np.arange(40), np.arange(40)[::-1]])
    pairs = look_alike(film(places, np.random.default_rng(seed)), 16, seed)
    partners = [{one + other - index for one, other in pairs if index in (one, other)} for index in range(80)]
    far = [index for index in range(80) if abs(79 - 2 * index) >= 16]
    found = [any(abs(places[index] - places[other]) <= 1 for other in partners[index]) for index in far]
    assert len(found) == 64
    assert np.mean(found) > 0.95


@given(count=st.integers(1, 12), apart=st.integers(2, 15), keypoints=st.integers(0, 3))
def test_pairs_are_ordered_unique_and_far_apart(count: int, apart: int, keypoints: int) -> None:
    rng = np.random.default_rng(0)
    frames = [
        Features(
            pixels=np.zeros((keypoints * 10, 2)),
            descriptors=rng.integers(0, 255, (keypoints * 10, 128), dtype=np.uint8),
            colors=np.zeros((keypoints * 10, 3), np.uint8),
        )
        for _ in range(count)
    ]
    pairs = look_alike(frames, apart, 0)
    assert pairs == sorted(set(pairs))
    assert all(other - one >= apart for one, other in pairs)
    enough = count * keypoints * 10 >= 32
    partnered = {index for pair in pairs for index in pair}
    assert partnered == {i for i in range(count) if max(i, count - 1 - i) >= apart and enough}
