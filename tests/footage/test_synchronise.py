"""Footage to a capture: closed loops from films whose offsets, times and bad frames are known, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from builders import mottled
from cuspid import storage
from cuspid.footage.quality import Looks, QualityOptions, faults, measure_quality, shrink_to_grey
from cuspid.footage.synchronise import (
    SyncOptions,
    flash_starts,
    match_names,
    match_starts,
    match_times,
    motion_starts,
    offset_between,
)
from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera, Rig
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import read_image
from cuspid.storage.videos import read_video
from verbs import refused, run

WIDTH, HEIGHT = 96, 72
STARTS = {"left": 0, "middle": 7, "right": 3}
FRAMES = 120
KEEP_SAME = ("--same-below-dn", 0)
"""A hand may come back to a place within a frame."""
OPTIONS = SyncOptions()


# --- films -----------------------------------------------------------------------------------------------------------


def path_of(count: int, seed: int = 0) -> np.ndarray:
    """Where a hand is at each instant, px: now slow, now quick."""
    rng = np.random.default_rng(seed)
    speeds = 2 + rng.gamma(0.7, 2.0, count)
    turns = np.cumsum(rng.normal(size=count))
    steps = speeds[:, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return np.abs((np.cumsum(steps, axis=0) + 100) % 200 - 100).astype(int)


def views(camera: str, path: np.ndarray) -> list[np.ndarray]:
    """What a camera sees of its own surface along a path."""
    ground = mottled(np.random.default_rng([*camera.encode()]), 256, (1.5, 4.0)).astype(np.uint8)
    return [np.repeat(ground[y : y + HEIGHT, x : x + WIDTH, None], 3, axis=2) for x, y in path]


def filmed(starts: Mapping[str, int] = STARTS, count: int = FRAMES, seed: int = 0) -> dict[str, list[np.ndarray]]:
    """Films of one path by cameras that began one after the other."""
    path = path_of(count + max(starts.values()), seed)
    return {camera: views(camera, path[start : start + count]) for camera, start in starts.items()}


def write_film(path: Path, images: Sequence[np.ndarray], times_ms: Sequence[int] | None = None) -> Path:
    """A video without loss, with given times (25 frames a second unless given)."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = images[0].shape[1], images[0].shape[0], "bgr0"
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = 40 * number if times_ms is None else times_ms[number], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_films(folder: Path, films: Mapping[str, Sequence[np.ndarray]]) -> Path:
    folder.mkdir()
    for camera, images in films.items():
        write_film(folder / f"{camera}.mkv", images)
    return folder


def write_folders(folder: Path, films: Mapping[str, Sequence[np.ndarray]]) -> Path:
    for camera, images in films.items():
        for number, image in enumerate(images):
            storage.write_image(folder / camera / f"{number:03d}.png", image)
    return folder


@pytest.fixture
def probe(tmp_path: Path) -> Path:
    """A handpiece with the three cameras."""
    camera = Camera.from_field_of_view(WIDTH, HEIGHT, 62.0)
    cameras = {
        name: MountedCamera(camera, Rigid3(np.eye(3), np.array([-2.0 * k, 0, 0]))) for k, name in enumerate(STARTS)
    }
    storage.write_handpiece(tmp_path / "handpiece.json", Handpiece(rig=Rig(cameras)))
    return tmp_path / "handpiece.json"


def imported(footage: Path, probe: Path, *more: object) -> Path:
    out = probe.parent / "capture"
    run("import", footage, "--handpiece", probe, "--out", out, *more)
    return out


def told(out: Path) -> dict:
    return json.loads((out / "import.json").read_text())


# --- synchronising ---------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("sync", ["flash", "motion"])
def test_cameras_that_began_one_after_the_other_are_brought_together(sync, tmp_path, probe):
    films = filmed()
    for camera, start in STARTS.items():
        films[camera][30 - start] = np.minimum(films[camera][30 - start].astype(int) + 90, 255).astype(np.uint8)
    out = imported(write_films(tmp_path / "footage", films), probe, "--sync", sync, "--burnt-above", 1, *KEEP_SAME)
    assert told(out)["starts_frames"] == STARTS
    capture = storage.read_capture(out)
    assert [frame.name for frame in capture.frames] == [f"{k:05d}" for k in range(3, FRAMES + 3)]
    for frame in capture.frames[::10]:
        for camera in frame.cameras:
            np.testing.assert_array_equal(capture.image(frame, camera), films[camera][int(frame.name) - STARTS[camera]])


def test_images_of_one_name_are_one_frame_and_keep_their_bytes(tmp_path, probe):
    films = filmed(dict.fromkeys(STARTS, 0), count=12)
    footage = write_folders(tmp_path / "footage", films)
    (footage / "right" / "004.png").unlink()
    out = imported(footage, probe, "--every", 2)
    capture = storage.read_capture(out)
    assert [frame.name for frame in capture.frames] == ["000", "002", "004", "006", "008", "010"]
    assert capture.frames[2].cameras == ("left", "middle")
    for frame in capture.frames:
        for camera in frame.cameras:
            taken = footage / camera / f"{frame.name}.png"
            assert (out / "images" / camera / taken.name).read_bytes() == taken.read_bytes()


def test_dropped_frames_are_told_by_number_and_right_by_time(tmp_path, probe, capsys):
    films = filmed(dict.fromkeys(STARTS, 0), count=60)
    (tmp_path / "footage").mkdir()
    kept = [k for k in range(60) if k not in range(20, 26)]
    for camera, images in films.items():
        some = kept if camera == "right" else range(60)
        write_film(tmp_path / "footage" / f"{camera}.mkv", [images[k] for k in some], [40 * k for k in some])
    line = refused(capsys, "import", tmp_path / "footage", "--handpiece", probe, "--out", tmp_path / "by-name")
    assert "frames were dropped, or the frame rates differ" in line
    capture = storage.read_capture(imported(tmp_path / "footage", probe, "--sync", "times"))
    assert "right: frames are missing; time jumps before frame 20" in capsys.readouterr().err
    assert len(capture.frames) == 60
    assert [frame.name for frame in capture.frames if "right" not in frame.cameras] == [
        f"{k:05d}" for k in range(20, 26)
    ]
    for frame in capture.frames[::7]:
        for camera in frame.cameras:
            np.testing.assert_array_equal(capture.image(frame, camera), films[camera][int(frame.name)])


def test_a_table_of_times_goes_before_those_of_the_videos(tmp_path, probe):
    films = filmed(STARTS, count=40)
    footage = write_films(tmp_path / "footage", films)
    rows = [
        f"{camera},{number + 100},{1000 + (number + start) / 30}"
        for camera, start in STARTS.items()
        for number in range(40)
    ]
    (footage / "timestamps.csv").write_text("\n".join(["cam_id,frame_index,frame_time", *reversed(rows)]))
    out = imported(footage, probe, "--sync", "times")
    capture = storage.read_capture(out)
    frame = capture.frames[10]
    assert frame.time_s == pytest.approx(1000 + int(frame.name) / 30)
    for camera in frame.cameras:
        np.testing.assert_array_equal(capture.image(frame, camera), films[camera][int(frame.name) - STARTS[camera]])
    assert told(out)["apart_ms"]["max"] < 0.01


def test_cameras_that_are_not_synchronised_have_frames_of_their_own(tmp_path, probe):
    films = filmed(STARTS, count=6)
    capture = storage.read_capture(imported(write_films(tmp_path / "footage", films), probe, "--sync", "none"))
    assert len(capture.frames) == 18
    assert all(len(frame.cameras) == 1 and frame.name.startswith(frame.cameras[0]) for frame in capture.frames)


def test_motion_that_contradicts_the_names_is_told(tmp_path, probe, capsys):
    imported(write_films(tmp_path / "footage", filmed({"left": 0, "right": 4})), probe)
    assert "right is 4 frames later than left" in " ".join(capsys.readouterr().err.split())


def lit(probe: Path) -> Path:
    """The handpiece with two lights, of which one is on at a time."""
    known = storage.read_handpiece(probe)
    ahead = np.array([0.0, 0, 1])
    lights = {
        name: Light(position_mm=np.array([x, 0.0, 0]), direction=ahead) for name, x in (("east", 3.0), ("west", -3.0))
    }
    patterns = (Lighting(name="a", lights=("east",)), Lighting(name="b", lights=("west",)))
    storage.write_handpiece(probe, replace(known, lights=lights, lightings=patterns))
    return probe


@pytest.mark.parametrize("in_turn", [("a", "b"), ("b", "a"), ("a", "a", "b")])
def test_lights_take_turns_whatever_is_left_out_or_lost(in_turn, tmp_path, probe, capsys):
    films = filmed(dict.fromkeys(STARTS, 0), count=40)
    kept = [k for k in range(40) if k not in range(20, 25)]
    (tmp_path / "footage").mkdir()
    for camera, images in films.items():
        write_film(tmp_path / "footage" / f"{camera}.mkv", [images[k] for k in kept], [40 * k for k in kept])
    asked = "--lightings", *in_turn
    out = imported(tmp_path / "footage", lit(probe), "--sync", "times", "--every", 3, *asked)
    capture = storage.read_capture(out)
    assert len(capture.frames) == 12
    for frame in capture.frames:
        assert frame.lighting == in_turn[round(frame.time_s / 0.04) % len(in_turn)]
    assert "lighting pattern" not in capsys.readouterr().err


def test_lights_that_are_not_told_or_cannot_be_are_said(tmp_path, probe, capsys):
    footage = write_folders(tmp_path / "footage", filmed(dict.fromkeys(STARTS, 0), count=6))
    for more, reason in (
        (("--lightings", "a", "c"), "no lighting pattern named 'c'; it has a, b"),
        (("--lightings", "a", "b", "--sync", "none"), "--lightings: alternating lights require cameras"),
    ):
        line = refused(capsys, "import", footage, "--handpiece", lit(probe), "--out", tmp_path / "capture", *more)
        assert reason in line
        assert not (tmp_path / "capture").exists()
    capture = storage.read_capture(imported(footage, probe))
    assert {frame.lighting for frame in capture.frames} == {None}
    assert "if the patterns alternate, give --lightings a b" in " ".join(capsys.readouterr().err.split())


def test_a_part_of_a_long_film_is_chosen_by_time(tmp_path, probe):
    footage = write_films(tmp_path / "footage", filmed(dict.fromkeys(STARTS, 0), count=50))
    capture = storage.read_capture(imported(footage, probe, "--start-s", 0.4, "--end-s", 1.2, "--every", 5))
    assert [frame.name for frame in capture.frames] == ["00010", "00015", "00020", "00025", "00030"]
    assert [frame.time_s for frame in capture.frames] == pytest.approx([0.4, 0.6, 0.8, 1.0, 1.2])


def jerks(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).gamma(0.7, 2.0, count)


@settings(max_examples=25)
@given(later=st.integers(-60, 60), seed=st.integers(0, 1000), gain=st.floats(0.2, 5))
def test_an_offset_is_found_whatever_the_cameras_see_of_the_motion(later, seed, gain):
    rng = np.random.default_rng(seed + 5000)
    all_of_it = jerks(400, seed)
    one, other = all_of_it[100:300], gain * all_of_it[100 + later : 310 + later]
    other = other * np.exp(0.2 * rng.normal(size=len(other)))
    found = offset_between(one, other, OPTIONS)
    assert found.doubt is None
    assert found.frames == later
    back = offset_between(other, one, OPTIONS)
    assert (back.frames, back.doubt) == (-later, None)


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), count=st.integers(5, 400))
def test_noise_and_other_motion_are_no_offset(seed, count):
    rng = np.random.default_rng(seed)
    noise = [np.abs(rng.normal(3, 0.1, count)) for _ in range(2)]
    hands = [jerks(count, seed), jerks(count, seed + 20_000)]
    for one, other in (noise, hands):
        assert offset_between(one, other, OPTIONS).doubt is not None
        with pytest.raises(InputError, match="no offset found from motion can be trusted"):
            motion_starts({"a": one, "b": other}, OPTIONS)


def test_rates_that_differ_and_a_rhythm_are_no_offset():
    hand = jerks(1600, 3)
    slower = np.interp(np.arange(1500) * 1.01, np.arange(1600), hand)
    assert offset_between(hand[:1500], slower, OPTIONS).doubt is not None
    rhythm = np.tile(jerks(25, 4), 12)
    assert offset_between(rhythm, rhythm, OPTIONS).doubt is not None


@settings(max_examples=25)
@given(order=st.permutations(["a", "b", "c"]), starts=st.tuples(*[st.integers(0, 20)] * 3))
def test_the_order_of_the_cameras_changes_nothing(order, starts):
    all_of_it, names = jerks(260, 1), ["a", "b", "c"]
    signals = {name: all_of_it[start : start + 200] for name, start in zip(names, starts, strict=True)}
    lit = {name: np.where(np.arange(200) == 60 - start, 200.0, 90.0) for name, start in zip(names, starts, strict=True)}
    first = min(starts)
    expected = {name: start - first for name, start in zip(names, starts, strict=True)}
    assert motion_starts({name: signals[name] for name in order}, OPTIONS) == expected
    assert flash_starts({name: lit[name] for name in order}, OPTIONS) == expected
    instants = match_starts(expected, dict.fromkeys(order, 200))
    assert all(k == int(instant.name) - expected[name] for instant in instants for name, k in instant.numbers.items())


@settings(max_examples=25)
@given(shift=st.floats(-1e4, 1e4), order=st.permutations(["a", "b", "c"]), seed=st.integers(0, 100))
def test_a_shift_of_all_times_and_the_order_of_the_cameras_change_nothing(shift, order, seed):
    rng = np.random.default_rng(seed)
    times = {name: np.arange(30) / 30 + rng.uniform(0, 0.007, 30) for name in ("a", "b", "c")}
    times["b"] = np.delete(times["b"], [4, 5, 20])
    plain = [dict(each.numbers) for each in match_times(times, OPTIONS)]
    moved = match_times({name: times[name] + shift for name in order}, OPTIONS)
    assert [dict(each.numbers) for each in moved] == plain
    assert len(plain) == 30
    assert sum("b" not in numbers for numbers in plain) == 3


@pytest.mark.parametrize("wrong", ["none", "flicker", "weak"])
def test_a_flash_that_is_not_clear_is_refused(wrong):
    level = 100 + np.random.default_rng(0).normal(0, 1.0, 120)
    if wrong == "flicker":
        level[10:115:10] += 80
    if wrong == "weak":
        level[20] += 6
    with pytest.raises(InputError, match="no clear flash" if wrong == "flicker" else "no flash"):
        flash_starts({"a": level}, OPTIONS)


def flashed(*frames: int) -> np.ndarray:
    level = 100 + np.random.default_rng(0).normal(0, 1.0, 200)
    level[list(frames)] += 80
    return level


def test_a_flash_before_and_one_after_tell_of_lost_frames():
    """A last one that comes a frame early may be rounding; two frames are not."""
    assert flash_starts({"a": flashed(20, 150), "b": flashed(17, 146)}, OPTIONS) == {"a": 0, "b": 3}
    with pytest.raises(InputError, match=r"b: two flashes are 128 frames apart, but 130 in a: the frame rates differ"):
        flash_starts({"a": flashed(20, 150), "b": flashed(20, 148)}, OPTIONS)
    with pytest.raises(InputError, match=r"b: one flash, at frame 20, but in a 2 flashes, at frames 20, 150; cut"):
        flash_starts({"a": flashed(20, 150), "b": flashed(20)}, OPTIONS)


def test_a_flash_is_found_where_it_is_not_whole_or_the_light_stays_on_and_no_dark_frame_is_one():
    """A rolling shutter has a part of it in the frame before; a dark frame ends as suddenly as a flash begins."""
    level = 100 + np.random.default_rng(0).normal(0, 1.0, 80)
    level[60] = 3
    whole, part, stays = level.copy(), level.copy(), level.copy()
    whole[20] += 80
    part[[20, 21]] += (40, 80)
    stays[20:] += 80
    assert flash_starts({"whole": whole, "part": part, "stays": stays}, OPTIONS) == {"whole": 0, "part": 0, "stays": 0}


def test_a_flash_that_contradicts_the_names_is_told(tmp_path, probe, capsys):
    films = filmed({"left": 0, "right": 4}, count=20)
    films["left"][12] = np.full_like(films["left"][12], 250)
    films["right"][8] = np.full_like(films["right"][8], 250)
    imported(write_films(tmp_path / "footage", films), probe)
    said = " ".join(capsys.readouterr().err.split())
    assert "saw a flash at different frames (left 00012, right 00008)" in said


def test_names_are_in_the_order_of_their_numbers():
    instants = match_names({"a": ["f2", "f10", "f1"], "b": ["f10", "f3"]})
    assert [each.name for each in instants] == ["f1", "f2", "f3", "f10"]
    assert dict(instants[3].numbers) == {"a": 1, "b": 0}


# --- judging ---------------------------------------------------------------------------------------------------------


def spoilt(images: list[np.ndarray]) -> dict[int, str]:
    """Spoil some; what of."""
    images[5] = cv2.GaussianBlur(images[5], (0, 0), 4.0)
    images[9] = (images[9] * 0.04).astype(np.uint8)
    images[14] = np.where(np.arange(WIDTH)[None, :, None] < 0.6 * WIDTH, 255, images[14]).astype(np.uint8)
    images[21] = images[20]
    return {5: "blurred", 9: "dark", 14: "burnt", 21: "duplicate"}


def test_bad_images_are_named_with_their_reason_and_only_they_are_left_out(tmp_path, probe, capsys):
    films = filmed(dict.fromkeys(STARTS, 0), count=30)
    expected = spoilt(films["middle"])
    for camera in STARTS:
        films[camera][25] = np.zeros_like(films[camera][25])
    out = imported(write_films(tmp_path / "footage", films), probe)
    found = {(each["camera"], int(each["frame"])): each["reason"].split(":")[0] for each in told(out)["left_out"]}
    assert found == {("middle", k): why for k, why in expected.items()} | {(camera, 25): "dark" for camera in STARTS}
    capture = storage.read_capture(out)
    assert len(capture.frames) == 29
    assert [int(frame.name) for frame in capture.frames if "middle" not in frame.cameras] == sorted(expected)
    assert "1 blurred (00005)" in " ".join(capsys.readouterr().err.replace("│", " ").split())


def looks_of(images: Sequence[np.ndarray]) -> Looks:
    shown = [shrink_to_grey(image) for image in images]
    rows = [measure_quality(each, shown[k - 1] if k else None) for k, each in enumerate(shown)]
    level, bright, burnt, sharpness, change = np.array(rows).T
    nothing = np.full(len(images), np.nan)
    return Looks(
        time_s=nothing, level_dn=level, bright_dn=bright, burnt=burnt, sharpness=sharpness, change_dn=change,
        peak=nothing,
    )  # fmt: skip


@pytest.mark.parametrize("change", ["darker", "deeper", "turned"])
def test_what_is_bad_does_not_depend_on_exposure_depth_or_how_the_camera_is_held(change):
    images = filmed({"left": 0}, count=30)["left"]
    expected = spoilt(images)
    if change == "darker":
        images = [(0.8 * image).astype(np.uint8) if k != 14 else image for k, image in enumerate(images)]
    if change == "deeper":
        images = [image.astype(np.uint16) * 257 for image in images]
    if change == "turned":
        images = [np.ascontiguousarray(np.rot90(image)) for image in images]
    found = faults(looks_of(images), QualityOptions())
    assert {k: why.split(":")[0] for k, why in found.items()} == expected


def test_nothing_is_bad_where_nothing_is_asked_for():
    images = filmed({"left": 0}, count=30)["left"]
    spoilt(images)
    assert not faults(
        looks_of(images), QualityOptions(blurred_below=0.0, dark_below_dn=0.0, burnt_above=1.0, same_below_dn=0.0)
    )


# --- developing ------------------------------------------------------------------------------------------------------


def mosaic(image: np.ndarray, order: str) -> np.ndarray:
    raw = np.zeros(image.shape[:2], image.dtype)
    for k, colour in enumerate(order):
        raw[k // 2 :: 2, k % 2 :: 2] = image[k // 2 :: 2, k % 2 :: 2, "RGB".index(colour)]
    return raw


@pytest.mark.parametrize("order", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_bayer_images_of_ten_bits_get_their_colours(order, tmp_path, probe):
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    for number in range(3):
        image = np.stack([300 + 4 * x + 40 * number, 200 + 3 * y, 900 - 4 * x], axis=2).astype(np.uint16)
        (tmp_path / "footage" / "left").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "footage" / "left" / f"{number}.tiff"), mosaic(image, order))
    out = imported(tmp_path / "footage", probe, "--bayer", order, "--bits", 10, "--blurred-below", 0)
    stored = cv2.imread(str(out / "images" / "left" / "2.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert stored.dtype == np.uint16
    assert np.abs(stored[2:-2, 2:-2].astype(int) - 64 * image[2:-2, 2:-2]).max() <= 64 * 4
    shown = read_image(out / "images" / "left" / "2.png").astype(int)
    assert np.abs(shown[2:-2, 2:-2] - image[2:-2, 2:-2] // 4).max() <= 2


def test_a_video_of_ten_bits_keeps_them(tmp_path):
    image = np.repeat(np.linspace(0, 65535, WIDTH).astype(np.uint16)[None, :, None], HEIGHT, axis=0).repeat(3, axis=2)
    with av.open(str(tmp_path / "deep.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "gray10le"
        frame = av.VideoFrame.from_ndarray(image, format="rgb48le")
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    (frame,) = read_video(tmp_path / "deep.mkv")
    assert frame.rgb().dtype == np.uint16
    assert len(np.unique(frame.rgb())) > 90
    assert np.abs(frame.rgb().astype(int) - image).max() < 5 * 64


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_video_that_was_held_on_its_side_is_upright(quarters, tmp_path):
    upright = views("left", path_of(4))
    path = tmp_path / "film.mp4"
    stream = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, upright[0].shape[1::-1])
    for image in upright:
        stream.write(image)
    stream.release()
    lying = next(read_video(path)).rgb()
    data = bytearray(path.read_bytes())
    one = 1 << 16
    matrix = {1: (0, one, -one, 0), 2: (-one, 0, 0, -one), 3: (0, -one, one, 0)}[quarters]
    a, b, c, d = (int(each).to_bytes(4, "big", signed=True) for each in matrix)
    nothing = bytes(4)
    start = data.index(b"tkhd") + 44
    data[start : start + 32] = a + b + nothing + c + d + nothing + nothing + nothing
    path.write_bytes(data)
    frame = next(read_video(path))
    assert frame.size == frame.rgb().shape[1::-1]
    np.testing.assert_array_equal(frame.rgb(), np.rot90(lying, -quarters))
    _, shown = cv2.VideoCapture(str(path)).read()
    assert np.abs(shown[..., ::-1].astype(int) - frame.rgb()).max() <= 2


# --- going on --------------------------------------------------------------------------------------------------------


def test_an_import_goes_on_where_it_was_ended_and_gives_the_same_bits(tmp_path, probe, monkeypatch):
    footage = write_films(tmp_path / "footage", filmed(count=100))
    out = imported(footage, probe, "--sync", "motion", "--every", 5)
    files = sorted(path for path in out.rglob("*") if path.is_file() and path.name != "made.jsonl")
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files}
    gone = [out / "images" / "left" / "00013.png", out / "images" / "left" / "00018.png", out / "capture.json"]
    damaged = out / "images" / "right" / "00023.png"
    for path in gone:
        path.unlink()
    damaged.write_bytes(b"cut")
    decoded = []
    read = read_video
    monkeypatch.setattr(
        "cuspid.footage.films.read_video", lambda path: (decoded.append(path.stem) or each for each in read(path))
    )
    imported(footage, probe, "--sync", "motion", "--every", 5)
    assert {path: path.read_bytes() for path in files} == {path: data for path, (data, _) in before.items()}
    images = [path for path in files if path.suffix == ".png"]
    assert {path for path in images if path.stat().st_mtime_ns != before[path][1]} == {*gone[:2], damaged}
    assert decoded.count("middle") <= 2  # to see that it is a video, and its size
    assert decoded.count("left") <= 2 + 19


def test_another_try_at_synchronising_goes_into_the_same_folder(tmp_path, probe, capsys):
    footage = write_films(tmp_path / "footage", filmed(count=100))
    out = tmp_path / "capture"
    assert "no flash" in refused(capsys, "import", footage, "--handpiece", probe, "--sync", "flash", "--out", out)
    assert {path.name for path in out.iterdir()} == {"run.json", "made.jsonl", "survey"}
    imported(footage, probe, "--sync", "motion")
    assert "another run of 'import'" in refused(capsys, "import", footage, "--handpiece", probe, "--out", out)


# --- what is refused or told -----------------------------------------------------------------------------------------


def test_bad_footage_is_one_clear_line_and_nothing_is_written(tmp_path, probe, capsys):
    def line(footage: Path, *more: object) -> str:
        said = refused(capsys, "import", footage, "--handpiece", probe, "--out", tmp_path / "out", *more)
        assert not (tmp_path / "out").exists()
        return said

    short = filmed(dict.fromkeys(STARTS, 0), count=3)
    assert "no such folder" in line(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "no folder of images and no video" in line(tmp_path / "empty")
    write_folders(tmp_path / "hole", {"left": short["left"]})
    (tmp_path / "hole" / "right").mkdir()
    assert "right: it contains no images" in line(tmp_path / "hole")
    write_folders(tmp_path / "named", {"lefty": short["left"]})
    assert "no camera of the handpiece is named lefty; it has left, middle, right" in line(tmp_path / "named")
    write_films(tmp_path / "size", {"left": [image[:60, :80] for image in short["left"]]})
    assert "80 x 60 px, but camera left has 96 x 72 px" in line(tmp_path / "size")
    for said in (b"not a film", b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n", b""):
        (tmp_path / "text").mkdir(exist_ok=True)
        (tmp_path / "text" / "left.mp4").write_bytes(said)
        assert "no frame can be decoded" in line(tmp_path / "text")
    coded = write_films(tmp_path / "coded", {"left": short["left"]}) / "left.mkv"
    whole = coded.read_bytes()
    assert whole.count(b"V_FFV1") == 1
    coded.write_bytes(whole.replace(b"V_FFV1", b"V_NONE"))
    assert "unknown codec" in line(tmp_path / "coded")
    footage = write_films(tmp_path / "footage", short)
    (footage / "times.csv").write_text("camera,frame\nleft,0\n")
    assert "needs one column 'time'" in line(footage)
    (footage / "times.csv").write_text("camera,frame,time\nother,0,1.0\n")
    assert "unknown camera 'other'; the cameras are left, middle, right" in line(footage)
    (footage / "times.csv").write_text("camera,frame,time\nleft,0,nan\n")
    assert "line 2: time is nan" in line(footage)


def test_what_is_found_out_while_looking_is_one_clear_line(tmp_path, probe, capsys):
    def line(footage: Path, *more: object) -> str:
        return refused(capsys, "import", footage, "--handpiece", probe, "--out", footage.with_suffix(".out"), *more)

    films = filmed(dict.fromkeys(STARTS, 0), count=6)
    footage = write_films(tmp_path / "footage", films)
    rows = [f"{camera},{k},{k / 10}" for camera in STARTS for k in range(6)]
    back = [row if row != "right,3,0.3" else "right,3,0.1" for row in rows]
    (footage / "times.csv").write_text("\n".join(["camera,frame,time", *back]))
    assert "right: time runs backwards, 0.2 s at frame 2 and 0.1 s at frame 3" in line(footage, "--sync", "times")
    apart = [f"{camera},{k},{k / 10 + 60 * (camera == 'right')}" for camera in STARTS for k in range(6)]
    (footage / "times.csv").write_text("\n".join(["camera,frame,time", *apart]))
    assert "no image of right was taken within" in line(footage, "--sync", "times")
    (footage / "times.csv").write_text("\n".join(["camera,frame,time", *rows, "left,9,0.9"]))
    assert "the table of times lists 7 frames of left" in line(footage)
    (footage / "times.csv").unlink()
    assert "no frame lies between 9 and inf s" in line(footage, "--start-s", 9)
    assert "no image of 6 frames is usable: 18 dark" in line(footage, "--dark-below-dn", 255)
    folders = write_folders(tmp_path / "folders", films)
    assert "--start-s and --end-s need frame times" in line(folders, "--end-s", 2)
    assert "left: 0 of 6 frames have a time" in line(folders, "--sync", "times")
    for path in (folders / "right").iterdir():
        path.rename(path.with_stem(f"x{path.stem}"))
    assert "right: no image shares its name with one of another camera" in line(folders)
    write_film(folders / "middle.mkv", films["middle"])
    for path in (folders / "middle").iterdir():
        path.unlink()
    (folders / "middle").rmdir()
    assert "folders and videos have no names in common" in line(folders)


def test_a_film_that_ends_early_and_a_damaged_image_are_told(tmp_path, probe, capsys):
    films = filmed(dict.fromkeys(STARTS, 0), count=20)
    footage = write_folders(tmp_path / "footage", {name: films[name] for name in ("left", "right")})
    data = (footage / "left" / "004.png").read_bytes()
    (footage / "left" / "004.png").write_bytes(data[: len(data) // 2])
    path = footage / "film.avi"
    stream = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (WIDTH, HEIGHT))
    for image in films["middle"]:
        stream.write(image)
    stream.release()
    out = imported(footage, probe) if path.rename(tmp_path / "middle.avi") else None
    assert [(each["camera"], each["frame"]) for each in told(out)["left_out"]] == [("left", "004")]
    assert "camera middle has no footage" in " ".join(capsys.readouterr().err.split())
    (tmp_path / "cut").mkdir()
    whole = (tmp_path / "middle.avi").read_bytes()
    (tmp_path / "cut" / "middle.avi").write_bytes(whole[: len(whole) // 2])
    run("import", tmp_path / "cut", "--handpiece", probe, "--out", tmp_path / "out")
    assert "middle.avi: truncated" in " ".join(capsys.readouterr().err.split())
