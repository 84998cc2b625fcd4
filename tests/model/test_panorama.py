"""The noun and its files: pixel and millimetre, and what is written is what is read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cuspid.runtime.errors import InputError
from cuspid.storage import read_panorama, write_panorama
from panoramas import small_panorama


def test_pixels_and_world_are_inverse_and_the_view_is_from_above() -> None:
    panorama = small_panorama()
    pixels = np.array([[0.5, 0.5], [3.0, 6.5]])
    world = panorama.world_from_pixels(pixels)
    np.testing.assert_allclose(panorama.pixels_from_world(world), pixels)
    assert world[1, 0] > world[0, 0]
    assert world[1, 1] < world[0, 1]
    np.testing.assert_allclose(panorama.world_from_pixels(panorama.origin_px), 0, atol=1e-12)


@pytest.mark.parametrize("with_height", [False, True])
def test_panorama_comes_back_from_its_folder(tmp_path: Path, with_height: bool) -> None:
    panorama = small_panorama()
    if with_height:
        panorama = replace(panorama, height_mm=np.linspace(0, 1, 35, dtype=np.float32).reshape(7, 5))
    write_panorama(tmp_path, panorama)
    found = read_panorama(tmp_path)
    for name in ("image", "covered", "frame_index", "frame_pixel", "origin_px", "height_mm"):
        np.testing.assert_array_equal(getattr(found, name), getattr(panorama, name))
    assert found.frames == panorama.frames
    assert (found.method, found.mm_per_px, found.notes) == (panorama.method, panorama.mm_per_px, panorama.notes)
    steps = [float(line) for line in (tmp_path / "panorama.pgw").read_text().split()]
    np.testing.assert_allclose(steps[4:], panorama.world_from_pixels(np.array([0.5, 0.5])))


@pytest.mark.parametrize("name", ["panorama.png", "panorama.json", "frames.csv", "source.npz"])
def test_a_truncated_panorama_is_one_clear_line(tmp_path: Path, name: str) -> None:
    write_panorama(tmp_path, small_panorama())
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:20])
    with pytest.raises(InputError, match=name.split(".")[0]):
        read_panorama(tmp_path)
