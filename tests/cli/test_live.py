"""``cuspid live``: a scan is followed while its images are written, or replayed, and ends as a reconstruction does."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from cuspid import storage
from cuspid.cli.live import _Feed, _follow_feed, _pace_frames
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, Frame
from cuspid.model.mesh import Mesh
from cuspid.report import live_view
from cuspid.report.growing_view import GrowingView
from cuspid.runtime.errors import InputError
from hilly_film import FIXED, scan, smooth, with_frame
from verbs import refused, run

STANDARD = ("--quality", "standard", "--calibration", "fixed")


def write(folder: Path, frames: tuple[Frame, ...], pause_s: float = 0.0, black: str | None = None) -> None:
    """The images of the frames, camera after camera, one frame in black."""
    for frame in frames:
        for camera in frame.cameras:
            image = scan().source.read(frame.name, camera) * np.uint8(frame.name != black)
            storage.write_image(folder / "images" / camera / f"{frame.name}.png", image)
            time.sleep(pause_s)


@pytest.mark.long
def test_a_capture_is_replayed_and_reconstructed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = scan().frames[:3]
    storage.write_capture(tmp_path / "capture", replace(scan(), frames=frames))
    write(tmp_path / "capture", frames)
    (tmp_path / "capture" / "images" / "north" / "00001.png").unlink()
    run("live", tmp_path / "capture", "--out", tmp_path / "live", *STANDARD)
    said = " ".join(capsys.readouterr().err.split())
    assert "3 of 3 frames placed as they came" in said
    assert "left out camera north of frame 00001: its image is missing" in said
    assert {"live", "reconstruct"} <= storage.read_json(tmp_path / "live" / "run.json").keys()
    made = (tmp_path / "live" / "mesh.ply").stat().st_mtime_ns
    run("reconstruct", tmp_path / "capture", "--out", tmp_path / "live", *STANDARD)
    assert (tmp_path / "live" / "mesh.ply").stat().st_mtime_ns == made, "it is the same reconstruction"


@pytest.mark.long
def test_a_folder_is_followed_while_images_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The third frame is black: the surface stays, and the scan goes on."""
    storage.write_handpiece(tmp_path / "capture" / "handpiece.json", scan().handpiece)
    writer = threading.Thread(target=write, args=(tmp_path / "capture", scan().frames, 0.02, "00002"))
    writer.start()
    run("live", tmp_path / "capture", "--watch", "--end-s", 3, "--pause-s", 1, "--out", tmp_path / "scan", *STANDARD)
    writer.join()
    said = " ".join(capsys.readouterr().err.split())
    assert "4 of 5 frames placed as they came" in said
    assert "frame 00002: not placed" in said
    assert "go back to where frame 00001 was taken" in said
    assert "frame 00003: found again" in said
    assert "located 4 of 5 frames" in said
    assert len(storage.read_mesh(tmp_path / "scan" / "mesh.ply").faces) > 1000


@pytest.mark.long
def test_without_frames_nothing_is_left(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "scan"
    assert "no such folder" in refused(capsys, "live", tmp_path / "none", "--watch", "--out", out)
    storage.write_handpiece(tmp_path / "capture" / "handpiece.json", scan().handpiece)
    message = refused(capsys, "live", tmp_path / "capture", "--watch", "--end-s", 0.2, "--out", out)
    assert "no usable frame has arrived" in message
    assert not out.exists()


def test_plain_teeth_are_refused_and_nothing_is_left(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = scan().frames[:1]
    storage.write_capture(tmp_path / "capture", replace(scan(), frames=frames))
    for camera in frames[0].cameras:
        storage.write_image(tmp_path / "capture" / "images" / camera / "00000.png", smooth())
    assert "it shows no texture" in refused(capsys, "live", tmp_path / "capture", "--out", tmp_path / "scan")
    assert not (tmp_path / "scan").exists()


def feed(*frames: Frame | None, error: InputError | None = None, capture: Capture | None = None) -> _Feed:
    """Frames, of which None is a pause, and what ends them."""
    taken = capture or scan()

    def coming() -> Iterator[Frame | None]:
        yield from frames
        if error is not None:
            raise error

    return _Feed(handpiece=taken.handpiece, source=lambda: taken.source, frames=coming(), left_out=lambda: ())


@pytest.mark.long
def test_pauses_and_incomplete_frames_before_the_first_whole_one_do_no_harm(tmp_path: Path) -> None:
    torn, alone, whole = scan().frames[:3]
    alone = replace(alone, cameras=alone.cameras[:1])
    capture = with_frame(scan(), torn.name, np.zeros((8, 160, 3), np.uint8))
    taken = _follow_feed(feed(None, torn, None, alone, None, whole, capture=capture), tmp_path, FIXED, None)
    assert [frame.name for frame in taken.frames] == [alone.name, whole.name]
    assert [each.what for each in taken.left_out] == [f"frame {torn.name}"]


def test_what_was_taken_is_reconstructed_whatever_ends_the_scan(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = InputError("folder: closed")
    taken = _follow_feed(feed(scan().frames[0], error=error), tmp_path, FIXED, None)
    assert len(taken.frames) == 1
    assert "note: folder: closed; scan ended" in capsys.readouterr().err
    with pytest.raises(InputError, match="closed"):
        _follow_feed(feed(error=error), tmp_path, FIXED, None)


def test_a_replay_keeps_its_pace() -> None:
    frames = tuple(replace(frame, time_s=100 + 0.1 * k) for k, frame in enumerate(scan().frames[:3]))
    for capture, pace, most_s in ((replace(scan(), frames=frames), None, 0.6), (scan(), 25.0, 0.6)):
        begin = time.monotonic()
        assert list(_pace_frames(capture, pace)) == list(capture.frames)
        took = time.monotonic() - begin
        assert (0.2 if pace is None else 4 / pace) <= took < most_s


def triangle() -> Mesh:
    return Mesh(np.eye(3), np.array([[0, 1, 2]]), np.full((3, 3), 100, np.uint8))


def test_the_view_shows_what_changes_and_where_to_go_back(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, server = {}, MagicMock()

    def add_mesh(name, mesh, visible):
        shown[name] = mesh
        return SimpleNamespace(remove=lambda: shown.pop(name))

    words = SimpleNamespace(content="")
    server.scene.add_mesh_trimesh, server.gui.add_markdown = add_mesh, lambda content: words
    monkeypatch.setitem(sys.modules, "viser", SimpleNamespace(ViserServer=lambda **_: server))
    monkeypatch.setattr(live_view, "only_own_pages", lambda _: nullcontext())
    view = GrowingView("127.0.0.1", 18090)
    poses = {"00000": Rigid3.identity(), "00001": Rigid3(np.eye(3), np.array([-1.0, 0, 0]))}
    session = SimpleNamespace(
        handpiece=scan().handpiece, rig_from_world=poses, frames=scan().frames, missing=lambda: np.zeros((2, 3))
    )
    view.show(session, {7: triangle(), 8: triangle()}, 0)
    assert shown.keys() == {"/surface/7", "/surface/8"}
    assert "**2** of 5 frames placed" in words.content
    assert "Lost" not in words.content
    nothing = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    view.show(session, {7: nothing, 9: nothing}, 2)
    assert shown.keys() == {"/surface/8"}
    assert "Lost for 2 frames" in words.content
    assert "frame 00001" in words.content
    assert {call.args[0] for call in server.scene.add_line_segments.call_args_list} == {"/handpiece", "/path"}
    assert server.scene.add_point_cloud.call_count == 1, "rims of holes are looked for now and then"
