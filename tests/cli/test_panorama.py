"""The verb stitch: bad input is one line and leaves nothing behind; what it reads, it reads as it is."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from builders import write_frames
from cuspid import storage
from panoramas import CAMERA, picture, write_calibration
from verbs import refused


def test_no_such_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, "pano", "stitch", tmp_path / "nowhere", "--out", tmp_path / "out")
    assert "no such folder or video" in line
    assert not (tmp_path / "out").exists()


def test_one_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path / "frames", map(picture, range(1)))
    assert "1 image(s)" in refused(capsys, "pano", "stitch", folder, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_two_sizes_name_the_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path / "frames", map(picture, range(3)))
    storage.write_image(folder / "001.png", picture(1, (80, 120)))
    line = refused(capsys, "pano", "stitch", folder, "--out", tmp_path / "out")
    assert "001.png: 80 x 120 px, but most frames have 160 x 120 px" in line


def test_frames_of_a_pixel_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_frames(tmp_path / "frames", [picture(seed)[:1, :1] for seed in range(3)])
    assert "frames of 1 x 1 px" in refused(capsys, "pano", "stitch", tmp_path / "frames", "--out", tmp_path / "pan")
    assert not (tmp_path / "pan").exists()


def test_a_truncated_frame_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path / "frames", map(picture, range(3)))
    (folder / "002.png").write_bytes((folder / "002.png").read_bytes()[:-40])
    assert "002.png: truncated" in refused(capsys, "pano", "stitch", folder, "--out", tmp_path / "out")


def test_something_that_is_no_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "film.mp4").write_bytes(b"not a film")
    line = refused(capsys, "pano", "stitch", tmp_path / "film.mp4", "--out", tmp_path / "out")
    assert "0 frame(s) could be decoded" in line


def test_frames_without_overlap_leave_nothing_half_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_frames(tmp_path / "frames", map(picture, range(4)))
    line = refused(capsys, "pano", "stitch", folder, "--out", tmp_path / "out")
    assert "000 to 003" in line
    assert not (tmp_path / "out").exists()


def write_video(path: Path, count: int) -> Path:
    stream = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (160, 120))
    for index in range(count):
        stream.write(cv2.cvtColor(picture(index), cv2.COLOR_RGB2BGR))
    stream.release()
    return path


def test_a_video_is_decoded_frame_by_frame(tmp_path: Path) -> None:
    sequence = storage.read_sequence(write_video(tmp_path / "film.avi", 6), tmp_path / "decoded")
    assert sequence.names == tuple(f"{index:05d}" for index in range(6))
    assert sequence.size == (160, 120)
    assert sequence.frames_per_s == pytest.approx(25.0)
    shown = sequence.image(3).astype(float)
    assert np.abs(shown - picture(3)).mean() < 12 < np.abs(shown - picture(2)).mean()


def test_a_truncated_video_gives_what_it_holds_and_says_so(tmp_path: Path) -> None:
    video = write_video(tmp_path / "film.avi", 30)
    data = video.read_bytes()
    video.write_bytes(data[: len(data) // 2])
    sequence = storage.read_sequence(video, tmp_path / "decoded")
    assert 10 < len(sequence) < 20
    assert f"truncated, only {len(sequence)} of 30 frames" in sequence.notes[0]


@pytest.mark.parametrize("kind", ["json", "colmap", "opencv"])
def test_calibrations_are_read_alike(tmp_path: Path, kind: str) -> None:
    folder = write_frames(tmp_path / "frames", map(picture, range(2)))
    sequence = storage.read_sequence(folder, tmp_path / "d", calibration=write_calibration(tmp_path, kind))
    assert sequence.camera is not None
    np.testing.assert_allclose(sequence.camera.parameters, CAMERA.parameters, atol=1e-9)


def test_a_calibration_of_another_size_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for index in range(3):
        storage.write_image(tmp_path / "frames" / f"{index}.png", picture(index, (320, 240)))
    calibration = write_calibration(tmp_path, "json")
    arguments = [
        "pano",
        "stitch",
        str(tmp_path / "frames"),
        "--out",
        str(tmp_path / "out"),
        "--calibration",
        str(calibration),
    ]
    assert "calibration is for 160 x 120 px, but the frames are 320 x 240 px" in refused(capsys, *arguments)
