"""Frames of a folder that is still being written come when they are whole, each once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from builders import handpiece
from cuspid import storage
from cuspid.footage.arrivals import Arrivals
from cuspid.runtime.errors import InputError

IMAGE = np.random.default_rng(0).integers(0, 255, (12, 16, 3), dtype=np.uint8)


def write(folder: Path, camera: str, frame: str, share: float = 1.0, suffix: str = ".png") -> Path:
    """An image, or the first bytes of one."""
    path = folder / "images" / camera / f"{frame}{suffix}"
    storage.write_image(path, IMAGE)
    if share < 1:
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    return path


def names(frames) -> list[str]:
    return [frame.name for frame in frames]


def test_frames_come_once_when_they_are_whole_and_in_order(tmp_path: Path) -> None:
    arrivals = Arrivals(tmp_path, handpiece("a", "b"), late_s=2.0)
    assert arrivals.news(0.0) == []
    assert arrivals.source is None
    for frame in ("00001", "00000"):
        for camera in "ab":
            write(tmp_path, camera, frame)
    assert arrivals.news(0.1) == [], "they might still be written"
    found = arrivals.news(0.2)
    assert names(found) == ["00000", "00001"]
    assert all(frame.cameras == ("a", "b") and frame.lighting == "all" for frame in found)
    assert arrivals.source is not None
    assert np.array_equal(arrivals.source.read("00000", "a"), IMAGE)
    assert arrivals.news(0.3) == arrivals.news(9.0) == arrivals.rest() == []


def test_a_frame_is_waited_for_but_not_for_ever(tmp_path: Path) -> None:
    arrivals = Arrivals(tmp_path, handpiece("a", "b"), late_s=2.0)
    write(tmp_path, "a", "00000")
    late = write(tmp_path, "b", "00000", share=0.5)
    for camera in "ab":
        write(tmp_path, camera, "00001")
    for now in (0.0, 0.1, 1.0, 2.0):
        assert arrivals.news(now) == []
    found = arrivals.news(2.2)
    assert names(found) == ["00000", "00001"]
    assert found[0].cameras == ("a",)
    (left_out,) = arrivals.left_out
    assert left_out.what == "camera b of frame 00000"
    assert "truncated" in left_out.reason
    late.unlink()
    write(tmp_path, "b", "00000")
    assert arrivals.news(3.0) == arrivals.news(3.1) == [], "it was given without"


def test_what_is_whole_in_time_is_given_whole(tmp_path: Path) -> None:
    arrivals = Arrivals(tmp_path, handpiece("a", "b"), late_s=2.0)
    write(tmp_path, "a", "00000")
    for camera in "ab":
        write(tmp_path, camera, "00001")
    assert arrivals.news(0.0) == arrivals.news(0.1) == []
    write(tmp_path, "b", "00000")
    assert arrivals.news(0.2) == []
    found = arrivals.news(0.3)
    assert names(found) == ["00000", "00001"]
    assert found[0].cameras == ("a", "b")
    assert arrivals.left_out == ()


def test_a_camera_that_never_has_an_image_holds_up_the_first_frame_only(tmp_path: Path) -> None:
    arrivals = Arrivals(tmp_path, handpiece("a", "b", "c"), late_s=2.0)
    for frame in ("00000", "00001"):
        for camera in "ab":
            write(tmp_path, camera, frame)
    assert arrivals.news(0.0) == arrivals.news(0.1) == arrivals.news(1.9) == []
    assert names(arrivals.news(2.2)) == ["00000"]
    assert names(arrivals.news(2.3)) == ["00001"]
    for camera in "ab":
        write(tmp_path, camera, "00002")
    assert names(arrivals.news(3.0)) == []
    assert names(arrivals.news(3.1)) == ["00002"]
    assert [each.what for each in arrivals.left_out] == ["camera c"]


def test_at_the_end_the_rest_is_given(tmp_path: Path) -> None:
    arrivals = Arrivals(tmp_path, handpiece("a", "b"), late_s=2.0)
    write(tmp_path, "a", "00000")
    assert arrivals.news(0.0) == arrivals.news(0.1) == []
    (last,) = arrivals.rest()
    assert last.cameras == ("a",)
    assert [(each.what, each.reason) for each in arrivals.left_out] == [("camera b", "it has no images")]


def test_what_is_not_of_the_handpiece_is_refused(tmp_path: Path) -> None:
    write(tmp_path, "x", "00000")
    with pytest.raises(InputError, match="the handpiece has no camera x; its cameras are a, b"):
        Arrivals(tmp_path, handpiece("a", "b"), late_s=2.0).news(0.0)


def test_mixed_types_are_refused(tmp_path: Path) -> None:
    arrivals = Arrivals(tmp_path, handpiece("a", "b"), late_s=2.0)
    write(tmp_path, "a", "00000")
    write(tmp_path, "b", "00000", suffix=".jpg")
    arrivals.news(0.0)
    with pytest.raises(InputError, match="write all images in one type"):
        arrivals.news(0.1)


def test_a_running_scan_passes_over_what_does_not_belong_to_it(tmp_path: Path) -> None:
    arrivals = Arrivals(tmp_path, handpiece("a", "b"), late_s=2.0)
    assert arrivals.news(0.0) == [], "there is no folder yet"
    for camera in "ab":
        write(tmp_path, camera, "00000")
        (tmp_path / "images" / camera / ".part-x.png").write_bytes(b"unfinished")
        (tmp_path / "images" / camera / "._00000.png").write_bytes(b"Mac OS X")
        write(tmp_path, f"{camera}/@eaDir", "00000")
    write(tmp_path, ".git", "00000")
    (tmp_path / "images" / "notes").mkdir()
    arrivals.news(0.1)
    assert names(arrivals.news(0.2)) == ["00000"]
    for camera in "ab":
        write(tmp_path, camera, "00001")
    write(tmp_path, "x", "00001")
    write(tmp_path, "b", "00002", suffix=".jpg")
    arrivals.news(0.3)
    assert names(arrivals.news(0.4)) == ["00001"]
    told = [(Path(each.what).name, each.reason.partition(";")[0]) for each in arrivals.left_out]
    assert told == [("x", "the handpiece has no camera x"), ("00002.jpg", "the images before are .png files")]


def test_an_image_that_is_not_whole_is_waited_for_whatever_its_type(tmp_path: Path) -> None:
    arrivals = Arrivals(tmp_path, handpiece("a"), late_s=2.0)
    half = write(tmp_path, "a", "00000", share=0.7, suffix=".bmp")
    assert arrivals.news(0.0) == arrivals.news(0.1) == arrivals.news(5.0) == []
    half.unlink()
    write(tmp_path, "a", "00000", suffix=".bmp")
    assert arrivals.news(6.0) == []
    assert names(arrivals.news(6.1)) == ["00000"]


def test_cameras_may_be_named_with_a_folder(tmp_path: Path) -> None:
    arrivals = Arrivals(tmp_path, handpiece("rig/a", "rig/b"), late_s=2.0)
    for camera in "ab":
        write(tmp_path, f"rig/{camera}", "00000")
    arrivals.news(0.0)
    (frame,) = arrivals.news(0.1)
    assert frame.cameras == ("rig/a", "rig/b")
