"""Calibrations of other programs, as they write them: the same points project to the same pixels."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cuspid import storage
from cuspid.camera import Camera
from cuspid.errors import CuspidError, InputError, OutputError
from cuspid.geometry import Rigid3
from cuspid.rig import MountedCamera, Rig
from cuspid.storage.calibrations import FORMATS, carried_over, read_calibration, write_calibration
from verbs import refused, run

POINTS = np.stack(np.meshgrid(np.linspace(-25, 25, 5), np.linspace(-20, 20, 5), [70.0, 90.0]), -1).reshape(-1, 3)
"""In the frame of the file, mm."""
CLOSE_PX = 0.01
K1 = np.array([[903.5, 0, 618.3], [0, 907.9, 394.2], [0, 0, 1]])
K2 = np.array([[880.0, 0, 640.7], [0, 879.0, 351.2], [0, 0, 1]])
D1, D2 = np.array([-0.33, 0.046, -0.0043, 0.0041, 0.0666]), np.array([-0.2, 0.03, 0.001, -0.002, 0.01])
TURN, SHIFT = np.array([0.02, -0.15, 0.03]), np.array([-12.5, 0.4, 1.5])


def write(folder: Path, name: str, text: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def projected(rig: Rig, points: np.ndarray = POINTS) -> list[np.ndarray]:
    """By each camera, from points in the frame of the rig."""
    return [each.camera.project(each.cam_from_rig.apply(points)) for each in rig.cameras.values()]


def by_opencv(
    points: np.ndarray, turn: np.ndarray, shift: np.ndarray, matrix: np.ndarray, lens: np.ndarray
) -> np.ndarray:
    """In COLMAP's pixels."""
    return cv2.projectPoints(points, turn, shift, matrix, lens)[0].reshape(-1, 2) + 0.5


def require_close(ours: np.ndarray, theirs: np.ndarray, within_px: float = CLOSE_PX) -> None:
    assert np.isfinite(theirs).all()
    assert np.abs(ours - theirs).max() < within_px


# --- OpenCV --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml"])
def test_two_files_of_stereo_calib(tmp_path: Path, suffix: str) -> None:
    """As OpenCV's sample writes them: no image size; R1 and R2 are rectifications."""
    first = cv2.FileStorage(str(tmp_path / f"intrinsics{suffix}"), cv2.FILE_STORAGE_WRITE)
    for name, value in (("M1", K1), ("D1", D1[None]), ("M2", K2), ("D2", D2[None])):
        first.write(name, value)
    first.release()
    second = cv2.FileStorage(str(tmp_path / f"extrinsics{suffix}"), cv2.FILE_STORAGE_WRITE)
    turn = cv2.Rodrigues(TURN)[0]
    for name, value in (("R", turn), ("T", SHIFT[:, None]), ("R1", turn.T.copy()), ("R2", turn), ("Q", np.eye(4))):
        second.write(name, value)
    second.release()
    read = read_calibration(tmp_path, image_size_px=(1280, 720))
    assert read.format == "opencv"
    assert read.rig.names == ("left", "right")
    left, right = projected(read.rig)
    require_close(left, by_opencv(POINTS, np.zeros(3), np.zeros(3), K1, D1))
    require_close(right, by_opencv(POINTS, TURN, SHIFT, K2, D2))
    guessed = read_calibration(tmp_path)
    assert any("1238 x 789 px is assumed" in note for note in guessed.notes), guessed.notes
    (tmp_path / f"extrinsics{suffix}").unlink()
    with pytest.raises(InputError, match="no R and T"):
        read_calibration(tmp_path)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_coefficients_of_opencv(tmp_path: Path, count: int) -> None:
    lens = np.array([-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.003, 0.001, 0.001, 0.0, -0.002, 0.0, 0.001, 0.002])[
        :count
    ]
    file = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 1280), ("image_height", 720), ("camera_matrix", K1)):
        file.write(name, value)
    file.write("distortion_coefficients", lens[None])
    file.release()
    read = read_calibration(tmp_path / "camera.yml")
    loss = 0.0 if count <= 8 else read.losses["camera"].largest_px
    assert (count > 8) == (loss > 0)
    require_close(projected(read.rig)[0], by_opencv(POINTS, np.zeros(3), np.zeros(3), K1, lens), max(loss, CLOSE_PX))


def test_a_fisheye_lens_of_opencv(tmp_path: Path) -> None:
    lens = np.array([0.05, -0.01, 0.003, -0.001])
    file = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 1280), ("image_height", 720), ("fisheye_model", 1), ("camera_matrix", K1)):
        file.write(name, value)
    file.write("distortion_coefficients", lens[:, None])
    file.release()
    theirs = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), K1, lens)[0].reshape(-1, 2) + 0.5
    require_close(projected(read_calibration(tmp_path / "camera.yml").rig)[0], theirs)


# --- what is written is read again ---------------------------------------------------------------------------------

LENSES = {
    "OPENCV": [-0.2, 0.05, 0.001, -0.002],
    "FULL_OPENCV": [-0.2, 0.05, 0.001, -0.002, 0.01, 0.0, 0.0, 0.0],
    "OPENCV_FISHEYE": [0.05, -0.01, 0.003, -0.001],
}
SUFFIXES = {
    "ros": "",
    "opencv": ".yml",
    "kalibr": ".yaml",
    "metashape": ".xml",
    "caliscope": ".toml",
    "anipose": ".toml",
}


def rig_of(count: int, model: str = "OPENCV") -> Rig:
    mounted = {}
    for index in range(count):
        camera = Camera(
            width=640,
            height=480,
            focal_px=np.array([500.0 + index, 510.0]),
            principal_point_px=np.array([322.0, 236.0]),
            distortion=np.array(LENSES[model]),
            model=model,
        )
        turn = np.array([0.02 * index, -0.05 * index, 0.01 + 0.1 * index])
        pose = Rigid3.from_rotation_vector(turn, np.array([3 - 8.0 * index, 0.3 * index, 0.5]))
        mounted[f"c{index}"] = MountedCamera(camera, pose)
    return Rig(mounted)


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("kind", [name for name, each in FORMATS.items() if each.write is not None])
def test_what_is_written_is_read_again(tmp_path: Path, kind: str, model: str) -> None:
    rig = rig_of(min(3, FORMATS[kind].most_cameras or 3), model)
    carried = carried_over(rig, kind)
    path = tmp_path / f"it{SUFFIXES.get(kind, '.json')}"
    write_calibration(path, carried.rig, kind)
    read = read_calibration(path)
    assert read.format == kind
    assert not read.losses
    seen = [projected(each.in_frame(next(iter(each.cameras.values())).cam_from_rig)) for each in (rig, read.rig)]
    lost = max((loss.largest_px for loss in carried.losses.values()), default=0.0)
    for ours, again in zip(*seen, strict=True):
        assert np.nanmax(np.abs(ours - again)) < max(lost, 1e-6)


def test_covariances_and_names_that_are_lost_are_told() -> None:
    camera = rig_of(1)["c0"].camera
    known = MountedCamera(camera, Rigid3.identity(), np.eye(6))
    notes = carried_over(Rig({"a": known, "b": known}), "kalibr").notes
    assert any("covariances" in note for note in notes)
    assert any("a, b" in note for note in notes)
    with pytest.raises(OutputError, match="at most"):
        carried_over(rig_of(3), "ros")


def test_a_lens_that_cannot_be_carried_over_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A fisheye of 150 degrees as a perspective lens."""
    camera = Camera(
        width=640,
        height=480,
        focal_px=np.array([240.0, 240.0]),
        principal_point_px=np.array([320.0, 240.0]),
        distortion=np.zeros(4),
        model="OPENCV_FISHEYE",
    )
    write_calibration(tmp_path / "a.yml", Rig({"a": MountedCamera(camera, Rigid3.identity())}), "opencv")
    line = refused(capsys, "convert", tmp_path / "a.yml", tmp_path / "m.json", "--to", "matlab")
    assert "px off over the image" in line
    assert "--most-px" in line
    assert not (tmp_path / "m.json").exists()
    run("convert", tmp_path / "a.yml", tmp_path / "m.json", "--to", "matlab", "--most-px", "2000")
    assert (tmp_path / "m.json").exists()


def test_metres_are_noticed(tmp_path: Path) -> None:
    """A baseline of 12 mm, written in metres where millimetres are usual."""
    rig = rig_of(2)
    metres = {
        name: MountedCamera(each.camera, Rigid3(each.cam_from_rig.rotation, each.cam_from_rig.translation / 1000))
        for name, each in rig.cameras.items()
    }
    write_calibration(tmp_path / "pair.yml", Rig(metres), "opencv")
    read = read_calibration(tmp_path / "pair.yml")
    assert "m is assumed" in read.notes[0]
    assert "--unit" in read.notes[0]
    apart = [
        np.linalg.norm(np.subtract(*(each.centre_in_rig for each in one.cameras.values()))) for one in (rig, read.rig)
    ]
    assert apart[0] == pytest.approx(apart[1])
    told = read_calibration(tmp_path / "pair.yml", unit="mm")
    assert not told.notes
    assert told.rig["right"].cam_from_rig.translation == pytest.approx(
        read.rig["right"].cam_from_rig.translation / 1000
    )


# --- the verb ------------------------------------------------------------------------------------------------------


def test_convert_writes_a_handpiece(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_calibration(tmp_path / "pair.yml", rig_of(2), "opencv")
    run("convert", tmp_path / "pair.yml", tmp_path / "handpiece.json", "--working-distance-mm", 30)
    handpiece = storage.read_handpiece(tmp_path / "handpiece.json")
    assert handpiece.working_distance_mm == 30
    assert handpiece.rig.names == ("left", "right")
    assert "2 camera(s)" in capsys.readouterr().err
    assert "give --to" in refused(capsys, "convert", tmp_path / "pair.yml", tmp_path / "x.abc")
    assert "is the file that is read" in refused(capsys, "convert", tmp_path / "pair.yml", tmp_path / "pair.yml")
    write(tmp_path, "other.yml", "a: 1\n")
    assert "say with --from" in refused(capsys, "convert", tmp_path / "other.yml", tmp_path / "x.json")


_JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


def _places(value: object) -> list[tuple[object, object]]:
    inner = (
        list(value.items()) if isinstance(value, dict) else list(enumerate(value)) if isinstance(value, list) else []
    )
    return [(value, key) for key, _ in inner] + [place for _, each in inner for place in _places(each)]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("written")
    texts = {}
    for kind in (name for name, each in FORMATS.items() if each.write is not None):
        path = folder / f"{kind}{'.json' if kind == 'opencv' else SUFFIXES.get(kind, '.json')}"
        write_calibration(path, rig_of(1 if kind == "ros" else 2), kind)
        texts[kind] = path.read_text()
    return texts


@settings(max_examples=250, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_refused_in_one_line(data: st.DataObject, written: dict[str, str], tmp_path: Path) -> None:
    """Cut, or with a value of another kind anywhere."""
    kind = data.draw(st.sampled_from(sorted(written)))
    text = written[kind]
    if kind in ("opencv", "nerfstudio", "matlab", "colmap-rig") and data.draw(st.booleans()):
        value = json.loads(text)
        holder, key = data.draw(st.sampled_from(_places(value)))
        holder[key] = data.draw(_JUNK)
        text = json.dumps(value)
    else:
        at = data.draw(st.integers(0, len(text)))
        text = (
            text[:at]
            + data.draw(st.sampled_from(["", "nan", "1e999", "[[[", "\x00", "- - -", "x: {"]))
            + text[at + data.draw(st.integers(0, 60)) :]
        )
    path = tmp_path / "damaged"
    path.write_text(text)
    for told in (None, kind):
        message, rig = "", None
        try:
            rig = read_calibration(path, kind=told).rig
        except CuspidError as error:
            message = str(error)
        assert message.isprintable()
        assert len(message) < 700
        assert rig is None or all(np.isfinite(each.camera.parameters).all() for each in rig.cameras.values())


def test_references_without_end_are_refused(tmp_path: Path) -> None:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    with pytest.raises(InputError, match="values"):
        read_calibration(write(tmp_path, "camchain.yaml", "\n".join(lines)))
    with pytest.raises(InputError, match="document type"):
        read_calibration(write(tmp_path, "a.xml", '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>'))
