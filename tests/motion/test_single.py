"""Where a trajectory is held loosely: where few observations hold it, in whatever number they are, nowhere else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cuspid.model.panorama import FrameUse
from cuspid.motion.monocular.single import weak_stretch_notes, weak_stretches

USUAL = 400


def frames(counts: Sequence[int | None]) -> tuple[FrameUse, ...]:
    """None: a frame without a place."""
    return tuple(
        FrameUse(name=f"{index:03d}", used=count is not None, inliers=count) for index, count in enumerate(counts)
    )


def weak(*stretches: tuple[int, int, int], count: int = 60) -> list[int]:
    """A film whose frames from the first to the last of each stretch have so many observations."""
    counts = np.full(count, USUAL)
    for first, last, fewer in stretches:
        counts[first : last + 1] = fewer
    return counts.tolist()


def names(counts: Sequence[int | None]) -> list[tuple[str, str]]:
    return [(stretch[0].name, stretch[-1].name) for stretch in weak_stretches(frames(counts))]


@given(st.integers(4, 50), st.integers(0, 5), st.integers(1, 190))
def test_a_weak_stretch_is_told_and_no_other(first: int, more: int, fewer: int) -> None:
    last = first + more
    assert names(weak((first, last, fewer))) == [(f"{first:03d}", f"{last:03d}")]


@given(st.lists(st.integers(200, 399), min_size=10, max_size=60), st.integers(1, 50))
def test_what_varies_less_than_twofold_is_held_well_whatever_the_number(counts: list[int], factor: int) -> None:
    assert weak_stretches(frames([factor * count for count in counts])) == ()


@given(st.integers(0, 59), st.integers(2, 1000))
def test_the_unit_of_counting_does_not_matter(first: int, factor: int) -> None:
    counts = weak((first, first + 3, 150), (10, 11, 90))
    assert names(counts) == names([factor * count for count in counts])


def test_stretches_near_each_other_are_one_and_the_weakest_comes_first() -> None:
    assert names(weak((10, 12, 150), (16, 17, 100), (30, 31, 50))) == [("030", "031"), ("010", "017")]
    assert names(weak((10, 12, 150), (17, 18, 100))) == [("017", "018"), ("010", "012")]


def test_ends_and_frames_without_a_place_do_not_count() -> None:
    assert names(weak((0, 3, 10), (56, 59, 10))) == []
    counts: list[int | None] = [*weak((20, 22, 10))]
    counts[5] = counts[40] = None
    assert names(counts) == [("020", "022")]


def test_nothing_is_told_where_observations_are_not_known() -> None:
    assert weak_stretches(()) == ()
    assert weak_stretches(tuple(FrameUse(name=f"{k}", used=True) for k in range(20))) == ()


def test_the_note_names_the_frames_and_what_is_usual() -> None:
    (note,) = weak_stretch_notes(frames(weak((10, 12, 150), (30, 30, 50))))
    assert "frame 030 (50 points), frames 010 to 012 (150 points), where 400 are usual" in note
    assert weak_stretch_notes(frames(weak())) == ()
    (many,) = weak_stretch_notes(frames(weak(*((first, first, 9) for first in range(8, 56, 8)))))
    assert "and at 3 other places" in many
