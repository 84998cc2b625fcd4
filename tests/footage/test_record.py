"""Recording: closed loops from cameras whose images, times and faults are known, and what is refused."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boards import BOARD, SIZE, looking_at, options, photographs, scene, undistorted
from builders import mottled
from cuspid import storage
from cuspid.calibration.corners import BoardView
from cuspid.calibration.coverage import SIDES, Coverage, CoverageOptions, focal_px_of, homography_of, tilt_of
from cuspid.footage import record as recorder
from cuspid.footage.cameras import ExposureOptions
from cuspid.footage.devices import FormatOptions, V4L2Camera, find_cameras
from cuspid.footage.jpeg import complete_jpeg
from cuspid.footage.played import FilmCamera, RenderedCamera
from cuspid.footage.record import TABLE, Recording, RecordOptions
from cuspid.footage.slots import Slots
from cuspid.geometry import Rigid3
from cuspid.model.board import Board, BoardSet
from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece, MountedCamera, Rig
from cuspid.report.preview import Preview, mark_focus
from cuspid.runtime.errors import InputError, OutputError
from cuspid.runtime.image_files import read_image
from cuspid.storage.files import AppendedTable
from verbs import refused, run

WIDTH, HEIGHT = 96, 72
GROUND = mottled(np.random.default_rng(0), 256, (1.5, 4.0)).astype(np.uint8)


def view(time_s: float, seed: int = 0) -> np.ndarray:
    """What a rendered camera sees at a moment: a ground that moves by 3 px a millisecond or so."""
    x, y = (round(2900 * time_s) + 31 * seed) % 160, (round(1700 * time_s) + 17 * seed) % 160
    return np.repeat(GROUND[y : y + HEIGHT, x : x + WIDTH, None], 3, axis=2)


def rendered(rate_per_s: float = 100.0, delay_s: float = 0.0, seed: int = 0) -> RenderedCamera:
    return RenderedCamera(
        lambda time_s: view(time_s, seed), size=(WIDTH, HEIGHT), rate_per_s=rate_per_s, delay_s=delay_s
    )


def record(cameras: dict, folder: Path, watch=lambda _: False, **given: float) -> Recording:
    """Record without a command line."""
    recording = Recording(cameras, folder, RecordOptions(**given))
    ready = recording.prepare(ExposureOptions(auto=True))
    recording.run(ready, watch)
    recording.close()
    return recording


def times_of(folder: Path, cameras: list[str]) -> dict[str, dict[str, float]]:
    return storage.read_frame_times(folder / TABLE, cameras)


def require_readable(folder: Path, cameras: list[str]) -> dict[str, dict[str, float]]:
    """All images are whole, and those that the table lists are there."""
    times = times_of(folder, cameras)
    for camera in cameras:
        images = {path.stem: read_image(path) for path in storage.images_in(folder / camera)}
        assert set(times[camera]) <= set(images)
    return times


# --- which images belong together ------------------------------------------------------------------------------------


def numbered(times: dict[str, list[float]], interval_s: dict[str, float]) -> dict[str, dict[int, float]]:
    """The times of the images of each camera by their numbers, images coming in the order of time."""
    slots, found = Slots(0.0, interval_s), {camera: {} for camera in times}
    for time_s, camera in sorted((each, camera) for camera, its in times.items() for each in its):
        number = slots.number(camera, time_s)
        if number is not None:
            assert number > max(found[camera], default=-1)
            found[camera][number] = time_s
    return found


@settings(max_examples=12, deadline=None)
@given(
    phases=st.lists(st.floats(0, 1), min_size=2, max_size=4),
    drift=st.floats(-0.004, 0.004),
    dropped=st.floats(0, 0.3),
    seed=st.integers(0, 1000),
)
def test_images_of_one_number_were_taken_together(phases, drift, dropped, seed):
    """Free-running cameras, at rates that differ a little, with jitter and lost images."""
    rng, step = np.random.default_rng(seed), 0.04
    times = {
        f"c{k}": [
            step * ((1 + k * drift) * i + phase + rng.normal(0, 0.02)) for i in range(120) if rng.random() >= dropped
        ]
        for k, phase in enumerate(phases)
    }
    found = numbered(times, dict.fromkeys(times, step))
    for camera, its in found.items():
        assert len(its) >= len(times[camera]) - 6, "images are left out where a camera slips, which is rare"
        for other in found.values():
            apart = [abs(its[k] - other[k]) / step for k in its.keys() & other.keys()]
            assert max(apart) < 1.1
            assert np.median(apart) < 0.85
            assert len(apart) >= 0.9 * (1 - dropped) ** 2 * 120 - 12, "most images have their counterparts"


def test_the_slowest_camera_sets_the_pace():
    """Of a camera that is twice as fast, every other image is taken, the one that is nearest."""
    times = {"slow": [0.04 * k + 0.003 for k in range(200)], "fast": [0.02 * k for k in range(400)]}
    found = numbered(times, {"slow": 0.04, "fast": 0.02})
    assert len(found["slow"]) == 200
    assert sorted(found["fast"]) == sorted(found["slow"])
    assert max(abs(found["fast"][k] - found["slow"][k]) for k in found["slow"]) < 0.011


def test_a_camera_that_slows_down_is_not_lost():
    """In the dark it exposes for longer, and its images may all lie aside of the slots that it was quick for."""
    quick, dark = [0.02 * k for k in range(40)], [0.812 + 0.04 * k for k in range(100)]
    found = numbered({"a": [0.04 * k for k in range(120)], "b": quick + dark}, {"a": 0.04, "b": 0.02})
    assert len([time_s for time_s in found["b"].values() if time_s > 0.8]) >= 98


# --- JPEG ------------------------------------------------------------------------------------------------------------


def jpeg(image: np.ndarray, quality: int = 90) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def without_tables(image: bytes) -> bytes:
    """As many USB cameras send it."""
    found, place = image[:2], 2
    while image[place + 1] != 0xDA:
        end = place + 2 + int.from_bytes(image[place + 2 : place + 4], "big")
        found += b"" if image[place + 1] == 0xC4 else image[place:end]
        place = end
    return found + image[place:]


def test_a_jpeg_of_a_usb_camera_becomes_a_file_with_the_same_pixels():
    whole = jpeg(view(0.1))
    sent = without_tables(whole)
    assert len(sent) < len(whole) - 300
    mended = complete_jpeg(sent + bytes(57))
    assert mended is not None
    assert mended.count(b"\xff\xc4") >= 1
    np.testing.assert_array_equal(*(cv2.imdecode(np.frombuffer(each, np.uint8), 1) for each in (mended, whole)))
    assert complete_jpeg(whole) == whole, "one that has tables stays as it is"


def test_a_jpeg_that_was_cut_off_is_none():
    whole = jpeg(view(0.1))
    assert complete_jpeg(whole[:-200]) is None
    assert complete_jpeg(whole[5:]) is None
    assert complete_jpeg(b"") is None
    assert complete_jpeg(b"\xff\xd8\xff\xd9") is None


# --- closed loops ----------------------------------------------------------------------------------------------------


@pytest.fixture
def probe(tmp_path: Path) -> Path:
    camera = Camera.from_field_of_view(WIDTH, HEIGHT, 62.0)
    cameras = {
        name: MountedCamera(camera, Rigid3(np.eye(3), np.array([-2.0 * k, 0, 0])))
        for k, name in enumerate(("left", "right"))
    }
    storage.write_handpiece(tmp_path / "handpiece.json", Handpiece(rig=Rig(cameras)))
    return tmp_path / "handpiece.json"


@pytest.mark.parametrize("sync", ["names", "times"])
def test_what_is_recorded_is_imported_bit_by_bit(sync, tmp_path, probe):
    """Two cameras, one 2 ms behind, so that the times and the pixels of an image tell the moment when it was due."""
    delays = {"left": 0.0, "right": 0.002}
    cameras = {name: rendered(delay_s=delay, seed=k) for k, (name, delay) in enumerate(delays.items())}
    recording = record(cameras, tmp_path / "footage", seconds=0.25)
    assert {name: each.written for name, each in recording.status.items()} == {"left": 25, "right": 25}
    assert sum(each.missing + each.unwritten for each in recording.status.values()) == 0
    run("import", tmp_path / "footage", "--handpiece", probe, "--sync", sync, "--out", tmp_path / "capture")
    capture = storage.read_capture(tmp_path / "capture")
    assert len(capture.frames) == 25
    assert all(len(frame.cameras) == 2 for frame in capture.frames)
    begin = capture.frames[0].time_s
    for number, frame in enumerate(capture.frames):
        assert frame.time_s - begin == pytest.approx(number / 100, abs=1e-5)
        for k, (camera, delay) in enumerate(delays.items()):
            np.testing.assert_array_equal(capture.image(frame, camera), view(number / 100 + delay, k))


def test_a_recording_can_be_the_images_of_a_capture(tmp_path, probe):
    """Which ``cuspid live`` follows."""
    record({"left": rendered(), "right": rendered(seed=1)}, tmp_path / "images", seconds=0.05)
    capture = storage.read_capture(tmp_path)
    assert [frame.name for frame in capture.frames] == [f"{k:06d}" for k in range(5)]
    np.testing.assert_array_equal(capture.image(capture.frames[2], "right"), view(0.02, 1))


def test_every_keeps_the_same_instants_of_all_cameras(tmp_path):
    cameras = {"left": rendered(100.0), "right": rendered(200.0, seed=1)}
    record(cameras, tmp_path / "footage", seconds=0.3, every_s=0.1)
    times = require_readable(tmp_path / "footage", ["left", "right"])
    assert list(times["left"]) == list(times["right"]) == ["000000", "000010", "000020"]
    assert all(abs(times["left"][frame] - times["right"][frame]) < 0.0051 for frame in times["left"])


def mjpeg_film(path: Path, images: list[np.ndarray]) -> list[bytes]:
    """A Motion JPEG film, and its images as they are stored."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=100)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuvj422p"
        packets = [
            packet for image in images for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24"))
        ] + stream.encode()
        stored = [bytes(packet) for packet in packets]
        container.mux(packets)
    return stored


def test_motion_jpeg_is_written_as_it_comes(tmp_path):
    stored = mjpeg_film(tmp_path / "left.avi", [view(k / 100) for k in range(12)])
    (tmp_path / "right").mkdir()
    for k, image in enumerate(stored):
        (tmp_path / "right" / f"{k:02d}.jpg").write_bytes(image)
    run("record", "--cameras", tmp_path / "left.avi", f"other={tmp_path / 'right'}", "--frames-per-s", 200, "--out",
        tmp_path / "footage")  # fmt: skip
    for camera in ("left", "other"):
        assert [path.read_bytes() for path in storage.images_in(tmp_path / "footage" / camera)] == stored
    told = storage.read_json(tmp_path / "footage" / "recording.json")["cameras"]["left"]
    assert (told["images"], told["missing"], told["size_px"], told["clock"]) == (12, 0, [WIDTH, HEIGHT], "schedule")


def test_a_film_is_played_at_its_own_times(tmp_path):
    mjpeg_film(tmp_path / "left.avi", [view(k / 100) for k in range(12)])
    record({"left": FilmCamera("left", tmp_path / "left.avi", None)}, tmp_path / "footage")
    times = list(times_of(tmp_path / "footage", ["left"])["left"].values())
    assert np.allclose(np.diff(times), 0.01, atol=1e-5)


def test_a_board_that_is_recorded_calibrates_the_cameras(tmp_path, capsys):
    board = Board(columns=6, rows=5, square_mm=3.0)
    whole = scene(5, board, cameras=2, instants=5)
    lenses = {name: undistorted(each).resized(320, 240) for name, each in whole.cameras.items()}
    truth = replace(whole, cameras=lenses, bending_mm=np.zeros(3))
    photographs(tmp_path / "photos", truth, board)
    named = [f"{name}={tmp_path / 'photos' / name}" for name in truth.cameras]
    run("record", "--cameras", *named, "--frames-per-s", 20, "--coach", *options(board), "--out", tmp_path / "footage")
    said = capsys.readouterr().err
    assert "lacks" in said
    assert "6 views of the board" not in said, "no view is counted twice"
    lens = ("--lens", "OPENCV", "--no-photometry")
    run("calibrate", tmp_path / "footage", *options(board), *lens, "--out", tmp_path / "rig")
    found = storage.read_handpiece(tmp_path / "rig" / "handpiece.json").rig
    for name, camera in truth.cameras.items():
        assert 0 < np.abs(found[name].camera.focal_px / camera.focal_px - 1).max() < 0.02
    between = found["cam1"].cam_from_rig @ found["cam0"].cam_from_rig.inverse()
    assert np.allclose(between.translation, truth.cam_from_rig["cam1"].translation, atol=0.1)


# --- a device that is not there --------------------------------------------------------------------------------------


class Uvc:
    """What OpenCV makes of a UVC camera: Motion JPEG on the monotonic clock, an automatic exposure, no focus; its gain
    is fixed. Its own clock runs as fast as it is read."""

    def __init__(self, images: int = 10**6, *, clock_s: float = 0.0, tells: bool = True) -> None:
        self.values = {
            cv2.CAP_PROP_FRAME_WIDTH: float(WIDTH), cv2.CAP_PROP_FRAME_HEIGHT: float(HEIGHT),
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"YUYV")), cv2.CAP_PROP_CONVERT_RGB: 1.0,
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0, cv2.CAP_PROP_EXPOSURE: 156.0, cv2.CAP_PROP_GAIN: 4.0,
            cv2.CAP_PROP_AUTO_WB: 1.0, cv2.CAP_PROP_WB_TEMPERATURE: 4600.0,
        }  # fmt: skip
        self.left, self.read_count, self.clock_s, self.tells = images, 0, clock_s, tells
        self.now = 100.0

    def set(self, control: int, value: float) -> bool:
        fixed = {cv2.CAP_PROP_GAIN, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT}
        if control not in self.values or control in fixed:
            return False
        self.values[control] = value
        return True

    def get(self, control: int) -> float:
        if control == cv2.CAP_PROP_POS_MSEC:
            return 1000 * (self.now + self.clock_s - 0.004)
        return self.values.get(control, -1.0)

    def read(self) -> tuple[bool, np.ndarray | None]:
        if self.read_count >= self.left:
            return False, None
        self.read_count += 1
        self.now += 0.01
        level = 60 if self.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 3 or self.tells else 20
        image = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
        image[:8, : self.read_count % WIDTH] = 200
        return True, np.frombuffer(without_tables(jpeg(image)) + bytes(9), np.uint8)[None]

    def release(self) -> None:
        self.left = 0


def device(uvc: Uvc, form: FormatOptions = FormatOptions(settle_s=0.1)) -> V4L2Camera:
    return V4L2Camera("/dev/video-none", form, open_device=lambda _: uvc, clock=lambda: uvc.now)


def test_a_camera_is_held_as_it_says_itself():
    camera = device(Uvc())
    ready = camera.prepare(ExposureOptions(exposure_ms=8.0, gain=10.0, focus=3.0))
    held = {each.name: (each.told, each.is_held) for each in ready.settings}
    assert held == {
        "exposure_ms": (8.0, True),
        "gain": (4.0, False),
        "white_balance_k": (4600.0, True),
        "focus": (None, False),
    }
    assert [str(each) for each in ready.settings] == [
        "exposure_ms 8 held",
        "gain 10 refused (it reports 4)",
        "white_balance_k 4600 held",
        "focus not settable",
    ]
    assert (ready.size, ready.clock) == ((WIDTH, HEIGHT), "driver")
    assert "MJPG" in ready.what
    assert ready.interval_s == pytest.approx(0.01)
    assert ready.notes == ()


def test_what_the_automatic_chose_is_held():
    ready = device(Uvc()).prepare(ExposureOptions())
    assert {each.name: each.told for each in ready.settings if each.is_held} == {
        "exposure_ms": 15.6, "white_balance_k": 4600.0,
    }  # fmt: skip
    assert str(ready.settings[1]) == "gain 4 (the driver does not allow it to be set)"


def test_a_camera_whose_automatic_does_not_tell_what_it_chose_is_found_out():
    (note,) = device(Uvc(tells=False)).prepare(ExposureOptions()).notes
    assert "times as bright since the exposure was fixed" in note
    assert "--exposure-ms" in note


def test_images_of_another_clock_have_the_time_of_their_arrival():
    uvc = Uvc(clock_s=-5000.0)
    camera = device(uvc)
    ready = camera.prepare(ExposureOptions())
    assert ready.clock == "arrival"
    assert "not stamp" in ready.notes[-1]
    assert next(camera.shots(0.0)).time_s == pytest.approx(uvc.now)


def test_what_a_driver_delivers_is_written(tmp_path):
    uvc = Uvc(40)
    camera = device(uvc)
    ready = camera.prepare(ExposureOptions())
    taken = []
    with pytest.raises(InputError, match="unplugged"):
        taken.extend(camera.shots(0.0))
    assert 40 - 20 <= len(taken) <= 40 - 16, "what came while it settled is not recorded"
    assert all(shot.suffix == ".jpg" and shot.rgb().shape == (HEIGHT, WIDTH, 3) for shot in taken)
    assert ready.size == (WIDTH, HEIGHT)


def test_a_size_that_a_camera_does_not_have_is_refused():
    with pytest.raises(InputError, match="delivers 96 x 72 px, not 640 x 72"):
        device(Uvc(), FormatOptions(width_px=640)).prepare(ExposureOptions())


def test_a_bus_without_room_is_told(monkeypatch):
    monkeypatch.setattr(Path, "exists", lambda path: True)
    with pytest.raises(InputError, match="delivers no images; cameras on one USB hub share"):
        device(Uvc(0)).prepare(ExposureOptions())
    with pytest.raises(InputError, match="delivers no more images"):
        device(Uvc(12)).prepare(ExposureOptions())

    class CutOff(Uvc):
        def read(self):
            is_read, data = super().read()
            return is_read, data[:, :300]

    with pytest.raises(InputError, match="cut off"):
        device(CutOff()).prepare(ExposureOptions())


def test_grey_of_16_bits_keeps_them(tmp_path):
    class Deep(Uvc):
        def read(self):
            is_read, _ = super().read()
            return is_read, np.full((HEIGHT, WIDTH), 1000 + self.read_count, np.uint16)

    uvc = Deep()
    uvc.values[cv2.CAP_PROP_FOURCC] = float(cv2.VideoWriter.fourcc(*"Y16 "))
    camera = device(uvc, FormatOptions(settle_s=0.1, pixels="raw"))
    camera.prepare(ExposureOptions(auto=True))
    shot = next(camera.shots(0.0))
    stored = cv2.imdecode(np.frombuffer(shot.file(), np.uint8), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    assert set(np.unique(stored)) == {1000 + uvc.read_count}


def test_cameras_that_are_not_there(tmp_path, capsys):
    assert find_cameras(tmp_path) == ()
    (tmp_path / "video0").write_bytes(b"")
    assert find_cameras(tmp_path) == (), "a file is no camera"


# --- how it ends -----------------------------------------------------------------------------------------------------


class Unplugged(RenderedCamera):
    def shots(self, start_s: float) -> Iterator:
        for number, shot in zip(count(), super().shots(start_s), strict=False):
            if number == 10:
                raise InputError("/dev/video2: it is unplugged")
            yield shot


def test_a_camera_that_is_unplugged_ends_the_recording_and_what_was_taken_stays(tmp_path):
    gone = Unplugged(view, size=(WIDTH, HEIGHT), rate_per_s=100.0)
    with pytest.raises(InputError, match=r"^camera right: /dev/video2: it is unplugged$"):
        record({"left": rendered(), "right": gone}, tmp_path / "footage", seconds=30.0)
    times = require_readable(tmp_path / "footage", ["left", "right"])
    assert len(times["right"]) == 10
    assert 9 <= len(times["left"]) <= 40


def test_a_full_disk_ends_the_recording_and_what_was_taken_stays(tmp_path, monkeypatch, capsys):
    left, write = iter(range(12)), recorder.write_bytes

    def until_full(path: Path, data: bytes) -> None:
        if next(left, None) is None:
            raise OutputError(f"{path}: the disk is full") from OSError(errno.ENOSPC, "no space left")
        write(path, data)

    monkeypatch.setattr(recorder, "write_bytes", until_full)
    mjpeg_film(tmp_path / "left.avi", [view(k / 100) for k in range(30)])
    films = tmp_path / "left.avi", shutil.copy(tmp_path / "left.avi", tmp_path / "right.avi")
    said = refused(capsys, "record", "--cameras", *films, "--out", tmp_path / "footage")
    assert "the disk is full; what was taken is kept" in said
    assert storage.read_json(tmp_path / "footage" / "recording.json")["cameras"]["left"]["images"] > 0
    times = require_readable(tmp_path / "footage", ["left", "right"])
    assert sum(map(len, times.values())) == 12


def test_no_part_of_a_line_stays_in_a_table_on_a_full_disk(tmp_path, monkeypatch):
    def cut(descriptor: int, data: bytes) -> int:
        return write(descriptor, data[:5])

    with AppendedTable(tmp_path / "a.csv", ("camera", "frame", "time")) as table:
        table.add("left", "000000", "1.5")
        write = os.write
        monkeypatch.setattr("cuspid.storage.files.os.write", cut)
        with pytest.raises(OutputError, match="the disk is full"):
            table.add("left", "000001", "2.5")
        monkeypatch.undo()
    assert (tmp_path / "a.csv").read_text() == "camera,frame,time\nleft,000000,1.5\n"


def test_ctrl_c_ends_it_cleanly(tmp_path):
    def interrupt(recording: Recording) -> bool:
        if recording.status["left"].written > 5:
            raise KeyboardInterrupt
        return False

    recording = record({"left": rendered()}, tmp_path / "footage", interrupt)
    times = require_readable(tmp_path / "footage", ["left"])
    assert len(times["left"]) == recording.status["left"].written > 5
    assert len(list((tmp_path / "footage" / "left").iterdir())) == len(times["left"])


def test_it_ends_when_it_is_enough(tmp_path):
    began = time.monotonic()
    recording = record({"left": rendered()}, tmp_path / "footage", lambda each: each.status["left"].written > 3)
    assert 3 < recording.status["left"].written < 100 * (time.monotonic() - began)
    assert len(require_readable(tmp_path / "footage", ["left"])["left"]) == recording.status["left"].written


KILLED = """
import sys, threading
from pathlib import Path
import numpy as np
from cuspid.footage.cameras import ExposureOptions
from cuspid.footage.played import RenderedCamera
from cuspid.footage.record import Recording, RecordOptions
camera = RenderedCamera(lambda t: np.random.default_rng(0).integers(0, 255, (72, 96, 3)).astype(np.uint8),
                        size=(96, 72), rate_per_s=500.0)
recording = Recording({"left": camera}, Path(sys.argv[1]), RecordOptions())
recording.run(recording.prepare(ExposureOptions()), lambda _: print("on", flush=True))
"""


def test_a_recording_that_is_killed_can_be_read(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path / "footage")], stdout=subprocess.PIPE)
    process.stdout.readline()
    until = time.monotonic() + 30
    while len(list((tmp_path / "footage").glob("left/*.png"))) < 10 and time.monotonic() < until:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    times = require_readable(tmp_path / "footage", ["left"])["left"]
    assert len(times) >= 9
    assert all(late > early for early, late in pairwise(times.values()))


def test_images_that_cannot_be_written_in_time_are_counted(tmp_path, monkeypatch):
    write = recorder.write_bytes

    def slowly(path: Path, data: bytes) -> None:
        time.sleep(0.01)
        write(path, data)

    monkeypatch.setattr(recorder, "write_bytes", slowly)
    monkeypatch.setattr(recorder, "_WAITING_MIB", 0)
    status = record({"left": rendered(300.0)}, tmp_path / "footage", seconds=0.3).status["left"]
    assert 20 <= status.written < 90
    assert status.written + status.unwritten == 90
    assert status.missing == status.unwritten


# --- what is refused -------------------------------------------------------------------------------------------------


def test_what_cannot_be_recorded_is_refused(tmp_path, capsys):
    out = tmp_path / "footage"
    stored = mjpeg_film(tmp_path / "left.avi", [view(0.0), view(0.1)])
    (tmp_path / "text.txt").write_text("no camera")
    assert len(stored) == 2
    film = tmp_path / "left.avi"
    for arguments, message in (
        (("--cameras", "0"), "nowhere to record to"),
        (("--out", out), "no camera is given"),
        (("--cameras", tmp_path / "video77", "--out", out), "no such camera"),
        (("--cameras", film, f"left={film}", "--out", out), "two cameras are named left"),
        (("--cameras", film, f"right={film}", "--out", out), "is camera left already"),
        (("--cameras", f"../x={film}", "--out", out), "cannot be used as a name"),
        (("--cameras", tmp_path / "text.txt", "--out", out), "not a camera, video or folder"),
        (("--cameras", film, "--rehearse", film, "--out", out), "leave out --cameras"),
    ):
        assert message in refused(capsys, "record", *arguments)
        assert not out.exists()
    run("record", "--cameras", film, "--out", out)
    before = sorted(out.rglob("*"))
    assert "holds images already" in refused(capsys, "record", "--cameras", film, "--out", out)
    assert "of another recording" in refused(capsys, "record", "--cameras", f"other={film}", "--out", out)
    assert sorted(out.rglob("*")) == before


def test_cameras_are_listed_in_one_line_where_there_are_none(capsys, monkeypatch):
    monkeypatch.setattr("cuspid.cli.record.find_cameras", lambda: ())
    run("record", "--list")
    assert capsys.readouterr().err.splitlines() == [
        "no camera is plugged in (there is no /dev/video* that delivers images)"
    ]


# --- the coach -------------------------------------------------------------------------------------------------------


ENOUGH = CoverageOptions()
CAMERA = Camera.from_field_of_view(*SIZE, 60.0)


def board_at(middle: np.ndarray, tilt: tuple[float, float]) -> BoardView | None:
    """A view of the board, turned about the X and Y axes of the camera, degrees, around its middle."""
    turn = Rotation.from_euler("xy", tilt, degrees=True).as_matrix()
    pose = Rigid3(turn, middle - turn @ np.array([*BOARD.size_mm, 0]) / 2)
    pixels = CAMERA.project(pose.apply(BOARD.corners))
    seen = np.flatnonzero(CAMERA.contains(pixels))
    return BoardView(seen, pixels[seen]) if len(seen) >= 6 else None


@pytest.mark.parametrize("tilt_deg", [20.0, 35.0, 50.0])
def test_tilts_are_read_from_a_view_alone(tilt_deg):
    """Turned about Y by a positive angle, +X comes nearer, against Z."""
    for tilt, side in (
        ((0, tilt_deg), "right"), ((0, -tilt_deg), "left"), ((tilt_deg, 0), "top"), ((-tilt_deg, 0), "bottom"),
    ):  # fmt: skip
        for aside in (np.zeros(3), np.array([6.0, -4.0, 0])):
            homography = homography_of(board_at(np.array([0, 0, 40.0]) + aside, tilt), BOARD, SIZE)
            found_deg, found, distance_mm = tilt_of(homography, CAMERA.focal_px[0])
            assert found == side
            assert found_deg == pytest.approx(tilt_deg, abs=0.01)
            assert distance_mm == pytest.approx(40.0)
    assert set(SIDES) == {"left", "right", "top", "bottom"}


def test_of_several_boards_the_one_that_is_seen_best_tells_the_tilt():
    other = replace(BOARD, first_id=BOARD.markers)
    view = board_at(np.array([3.0, 0, 40.0]), (0, 35))
    second = BoardView(view.corner + len(BOARD.corners), view.pixels)
    both = BoardView(
        np.concatenate([[0, 1, 2], second.corner]), np.concatenate([[[5.0, 5], [9, 9], [9, 5]], view.pixels])
    )
    alone = homography_of(view, BOARD, SIZE)
    for each in (second, both):
        assert np.allclose(homography_of(each, BoardSet(boards=(BOARD, other)), SIZE), alone)


def test_the_focal_length_is_read_from_tilted_views():
    views = [board_at(np.array(middle), tilt) for middle, tilt in ALL_OVER[:12]]
    homographies = [homography_of(each, BOARD, SIZE) for each in views]
    assert focal_px_of(homographies, SIZE[0]) == pytest.approx(CAMERA.focal_px[0], rel=0.01)
    facing = homography_of(board_at(np.array([0, 0, 40.0]), (0, 0)), BOARD, SIZE)
    assert focal_px_of([facing] * 3, SIZE[0]) == SIZE[0]


def covered(poses: list[tuple[np.ndarray, tuple[float, float]]]) -> Coverage:
    found = Coverage.of_nothing({"left": SIZE, "right": SIZE, "far": SIZE})
    for middle, tilt in poses:
        seen = board_at(np.array(middle), tilt)
        found = found.with_instant({"left": seen, "right": seen, "far": None}, BOARD, ENOUGH)
    return found


TILTS = [(0, 30), (0, -30), (30, 0), (-30, 0)]
ALL_OVER = [((x, y, z), tilt) for z in (20.0, 28.0) for tilt in TILTS for x in (-7, 0, 7) for y in (-5, 0, 5)]


def test_the_coach_says_when_it_is_enough_and_what_is_missing():
    everything = covered(ALL_OVER)
    missing = everything.missing(ENOUGH)
    assert set(missing) == {"far"}
    assert everything.apart(ENOUGH) == [["left", "right"], ["far"]]
    assert not everything.is_enough(ENOUGH)
    pair = Coverage(
        cameras={name: everything.cameras[name] for name in ("left", "right")},
        shared={("left", "right"): everything.shared["left", "right"]},
    )
    assert pair.is_enough(ENOUGH)


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        (lambda middle, tilt: middle[0] <= 0 and middle[2] == 20, "right"),
        (lambda middle, tilt: middle[1] >= 0 and middle[2] == 20, "top"),
        (lambda middle, tilt: tilt != (0, 30), "tilts with the right nearer"),
        (lambda middle, tilt: tilt not in ((30, 0), (-30, 0)), "tilts with the top / bottom nearer"),
        (lambda middle, tilt: middle[2] == 20, "another distance"),
    ],
)
def test_what_is_left_out_is_missed(kept, words):
    found = covered([pose for pose in ALL_OVER if kept(*pose)])
    assert words in ", ".join(found.missing(ENOUGH)["left"])
    assert found.missing(ENOUGH)["left"] == found.missing(ENOUGH)["right"]


def test_a_board_that_is_held_still_is_one_view():
    found = covered([ALL_OVER[4]] * 30)
    assert found.cameras["left"].views == 1
    assert found.shared["left", "right"] == 1


def test_the_preview_marks_what_is_sharp_and_what_is_not_covered():
    squares = np.kron(np.indices((30, 30)).sum(axis=0) % 2, np.ones((8, 8)))
    sharp = np.repeat(np.rint(60 + 120 * squares).astype(np.uint8)[..., None], 3, axis=2)
    sharp[:, 120:] = cv2.GaussianBlur(sharp[:, 120:], (0, 0), 3)
    green = (mark_focus(sharp) == (40, 255, 90)).all(axis=2)
    half = green.shape[1] // 2
    assert green[:, :half].mean() > 0.02
    assert green[:, half + 20 :].mean() < 0.001
    covered = np.ones((6, 6))
    covered[0, 0] = 0
    plain = np.full((240, 240, 3), 100, np.uint8)
    shown = mark_focus(plain, covered)
    assert (shown[100:, 100:] == 100).all()
    assert shown[20, 20, 0] > 130 > 100 > shown[20, 20, 2]


def test_the_preview_shows_each_camera_and_what_is_said():
    pytest.importorskip("viser")
    preview = Preview("127.0.0.1", 8200, ["left", "right"])
    try:
        image = np.full((60, 80, 3), 50, np.uint8)
        preview.show({"right": image}, ["left <b> 3 views"])
        assert np.array_equal(preview.images["right"].image, image)
        assert not np.array_equal(preview.images["left"].image, image)
        assert "left &lt;b&gt; 3 views" in preview.said.content
        assert preview.address.startswith("http://127.0.0.1:82")
    finally:
        preview.stop()


def test_a_rehearsal_without_cameras_is_recorded(tmp_path):
    storage.write_handpiece(tmp_path / "h.json", Handpiece(rig=Rig({
        "a": MountedCamera(Camera.from_field_of_view(64, 48, 60.0), looking_at(np.array([0, 0, 5.0]), np.zeros(3), 0.0))
    })))  # fmt: skip
    run("record", "--rehearse", tmp_path / "h.json", "--frames-per-s", 20, "--seconds", 0.3, *options(BOARD), "--out",
        tmp_path / "footage")  # fmt: skip
    images = [read_image(path) for path in storage.images_in(tmp_path / "footage" / "a")]
    assert len(images) == 6
    assert images[0].std() > 20
