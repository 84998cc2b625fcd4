"""Calibrations of other programs, as they write them: the same points project to the same pixels."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.geometry.cameras import GRID
from cuspid.model.camera import Camera
from cuspid.model.rig import MountedCamera, Rig
from cuspid.runtime.errors import CuspidError, InputError, OutputError
from cuspid.storage.calibrations import FORMATS, fit_to_format, read_calibration, write_calibration
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


def test_the_same_reader_serves_stitch(tmp_path: Path) -> None:
    """With k3, which was refused, and with the size of the frames where the file has none."""
    for index in range(2):
        storage.write_image(tmp_path / "frames" / f"{index}.png", np.full((48, 64, 3), 90 + index, dtype=np.uint8))
    file = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    file.write("camera_matrix", np.array([[60.0, 0, 31.5], [0, 61, 23.5], [0, 0, 1]]))
    file.write("distortion_coefficients", D1[None])
    file.release()
    read = storage.read_sequence(tmp_path / "frames", tmp_path / "d", calibration=tmp_path / "camera.yml")
    assert read.camera is not None
    assert (read.camera.model, read.camera.width, read.camera.height) == ("FULL_OPENCV", 64, 48)
    np.testing.assert_allclose(read.camera.distortion[[0, 1, 2, 3, 4]], D1)


def test_a_fisheye_lens_of_opencv(tmp_path: Path) -> None:
    lens = np.array([0.05, -0.01, 0.003, -0.001])
    file = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 1280), ("image_height", 720), ("fisheye_model", 1), ("camera_matrix", K1)):
        file.write(name, value)
    file.write("distortion_coefficients", lens[:, None])
    file.release()
    theirs = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), K1, lens)[0].reshape(-1, 2) + 0.5
    require_close(projected(read_calibration(tmp_path / "camera.yml").rig)[0], theirs)


# --- Kalibr --------------------------------------------------------------------------------------------------------

CAMCHAIN = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.2834, 0.0739, 0.00019, 1.76e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.9999972564, 0.0023171355, 0.0003433931, -0.1100737]
  - [-0.0023122015, 0.9998980487, -0.0140910475, 0.0003991215]
  - [-0.0003760088, 0.0140902375, 0.9999006564, -0.0008537025]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.0034, 0.0007, -0.0020, 0.0002]
  distortion_model: equidistant
  intrinsics: [190.978, 190.973, 254.931, 256.897]
  resolution: [512, 512]
  rostopic: /cam1/image_raw
"""
"""As Kalibr writes it (wiki, yaml formats): metres."""


def test_a_chain_of_kalibr(tmp_path: Path) -> None:
    read = read_calibration(write(tmp_path, "any.yaml", CAMCHAIN))
    assert (read.format, read.losses, read.notes) == ("kalibr", {}, ())
    points = POINTS * 10
    matrix = np.array([[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1]])
    lens = np.array([-0.2834, 0.0739, 0.00019, 1.76e-05])
    second = np.array([[0.9999972564, 0.0023171355, 0.0003433931], [-0.0023122015, 0.9998980487, -0.0140910475],
                       [-0.0003760088, 0.0140902375, 0.9999006564]])  # fmt: skip
    moved = points @ second.T + np.array([-110.0737, 0.3991215, -0.8537025])
    fisheye = np.array([[190.978, 0, 254.931], [0, 190.973, 256.897], [0, 0, 1]])
    theirs = cv2.fisheye.projectPoints(
        moved[:, None], np.zeros(3), np.zeros(3), fisheye, np.array([0.0034, 0.0007, -0.0020, 0.0002])
    )[0]
    first, other = projected(read.rig, points)
    require_close(first, by_opencv(points, np.zeros(3), np.zeros(3), matrix, lens))
    require_close(other, theirs.reshape(-1, 2) + 0.5)


def _double_sphere_ray(plane: np.ndarray, xi: float, alpha: float) -> np.ndarray:
    """Usenko et al. 2018, Eq. 46 to 50."""
    square = (plane**2).sum(axis=1)
    z = (1 - alpha**2 * square) / (alpha * np.sqrt(1 - (2 * alpha - 1) * square) + 1 - alpha)
    share = (z * xi + np.sqrt(z**2 + (1 - xi**2) * square)) / (z**2 + square)
    return np.column_stack([share[:, None] * plane, share * z - xi])


def _unified_ray(plane: np.ndarray, alpha: float, beta: float) -> np.ndarray:
    """Khomutenko et al. 2016, Eq. 10."""
    square = (plane**2).sum(axis=1)
    z = (1 - beta * alpha**2 * square) / (alpha * np.sqrt(1 - (2 * alpha - 1) * beta * square) + 1 - alpha)
    return np.column_stack([plane, z])


def _omni_ray(plane: np.ndarray, xi: float) -> np.ndarray:
    """Mei and Rives 2007, Eq. 4."""
    square = (plane**2).sum(axis=1)
    share = (xi + np.sqrt(1 + (1 - xi**2) * square)) / (1 + square)
    return np.column_stack([share[:, None] * plane, share - xi])


@pytest.mark.parametrize(
    ("model", "own", "ray"),
    [
        ("ds", (-0.18, 0.59), _double_sphere_ray),
        ("eucm", (0.6, 1.1), _unified_ray),
        ("omni", (1.2,), _omni_ray),
    ],
)
def test_other_models_of_kalibr_lie_as_near_as_is_told(tmp_path: Path, model: str, own: tuple, ray) -> None:
    """Against the inverse of each model that its authors print."""
    focal = {"ds": 190.0, "eucm": 240.0, "omni": 560.0}[model]
    text = json.dumps({"cam0": {"camera_model": model, "distortion_model": "none", "distortion_coeffs": [],
                                "intrinsics": [*own, focal, focal + 1, 322.5, 238.0],
                                "resolution": [640, 480]}})  # fmt: skip
    read = read_calibration(write(tmp_path, "camchain.yaml", text))
    loss = read.losses["cam0"]
    assert 0 < loss.rms_px <= loss.largest_px < 0.5
    pixels = np.stack(np.meshgrid(np.linspace(5, 635, 13), np.linspace(5, 475, 9)), -1).reshape(-1, 2)
    rays = ray((pixels - 0.5 - [322.5, 238.0]) / [focal, focal + 1], *own)
    off = np.linalg.norm(read.rig["cam0"].camera.project(rays) - pixels, axis=1)
    assert off.max() < 1.1 * loss.largest_px + 0.001


def test_the_fov_distortion_of_kalibr(tmp_path: Path) -> None:
    """Its inverse is r_u = tan(r_d w) / (2 tan(w / 2))."""
    text = json.dumps({"cam0": {"camera_model": "pinhole", "distortion_model": "fov", "distortion_coeffs": [0.9],
                                "intrinsics": [300.0, 300.0, 320.0, 240.0], "resolution": [640, 480]}})  # fmt: skip
    read = read_calibration(write(tmp_path, "camchain.yaml", text))
    pixels = np.stack(np.meshgrid(np.linspace(20, 620, 9), np.linspace(20, 460, 7)), -1).reshape(-1, 2)
    bent = (pixels - 0.5 - [320, 240]) / 300
    radius = np.linalg.norm(bent, axis=1, keepdims=True)
    rays = np.column_stack([bent * np.tan(radius * 0.9) / (2 * np.tan(0.45)) / radius, np.ones(len(bent))])
    off = np.linalg.norm(projected(read.rig, rays)[0] - pixels, axis=1)
    assert off.max() < 1.1 * read.losses["cam0"].largest_px + 0.001


# --- ROS -----------------------------------------------------------------------------------------------------------


def camera_info(name: str, matrix: np.ndarray, lens: np.ndarray, turn: np.ndarray, projection: np.ndarray) -> str:
    """As camera_calibration writes it."""

    def rows(values: np.ndarray, count: int, columns: int) -> str:
        return f"  rows: {count}\n  cols: {columns}\n  data: [{', '.join(f'{each:.8f}' for each in values.ravel())}]\n"

    return (
        f"image_width: 1280\nimage_height: 720\ncamera_name: {name}\ncamera_matrix:\n{rows(matrix, 3, 3)}"
        f"distortion_model: plumb_bob\ndistortion_coefficients:\n{rows(lens, 1, 5)}"
        f"rectification_matrix:\n{rows(turn, 3, 3)}projection_matrix:\n{rows(projection, 3, 4)}"
    )


def test_a_pair_of_ros(tmp_path: Path) -> None:
    turn = cv2.Rodrigues(TURN)[0]
    found = cv2.stereoRectify(K1, D1, K2, D2, (1280, 720), turn, SHIFT / 1000, flags=cv2.CALIB_ZERO_DISPARITY)
    write(tmp_path, "left.yaml", camera_info("left", K1, D1, found[0], found[2]))
    write(tmp_path, "right.yaml", camera_info("right", K2, D2, found[1], found[3]))
    read = read_calibration(tmp_path)
    assert (read.format, read.notes) == ("ros", ())
    assert read.rig["right"].camera.width == 1280
    left = read.rig["left"].cam_from_rig
    rig = read.rig.in_frame(left)
    ours = projected(rig)
    require_close(ours[0], by_opencv(POINTS, np.zeros(3), np.zeros(3), K1, D1))
    require_close(ours[1], by_opencv(POINTS, TURN, SHIFT, K2, D2))


def test_a_message_of_ros(tmp_path: Path) -> None:
    """As ``ros2 topic echo`` prints it."""
    lens = [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.003, 0.001]
    text = (
        "header:\n  frame_id: camera\nheight: 720\nwidth: 1280\ndistortion_model: rational_polynomial\nd:\n"
        + "".join(f"- {each}\n" for each in lens)
        + f"k: {K1.ravel().tolist()}\nr: {np.eye(3).ravel().tolist()}\n"
        + f"p: {np.hstack([K1, np.zeros((3, 1))]).ravel().tolist()}\n"
    )
    read = read_calibration(write(tmp_path, "info.yaml", text))
    assert read.format == "ros"
    require_close(projected(read.rig)[0], by_opencv(POINTS, np.zeros(3), np.zeros(3), K1, np.array(lens)))


# --- anipose and caliscope -----------------------------------------------------------------------------------------

ANIPOSE = """[cam_0]
name = "A"
size = [ 1280, 720,]
matrix = [ [ 903.5, 0.0, 618.3,], [ 0.0, 907.9, 394.2,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.33, 0.046, -0.0043, 0.0041, 0.0666,]
rotation = [ 0.1, -0.2, 0.05,]
translation = [ 12.5, -3.0, 4.0,]

[cam_1]
name = "B"
size = [ 1280, 720,]
matrix = [ [ 450.0, 0.0, 640.0,], [ 0.0, 452.0, 360.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.05, -0.01, 0.003, -0.001,]
rotation = [ 0.3, 0.4, -0.1,]
translation = [ -40.0, 6.0, 9.0,]
fisheye = true

[metadata]
adjusted = true
error = 0.31
"""
"""Written by aniposelib 0.8.0."""


def test_cameras_of_anipose(tmp_path: Path) -> None:
    """Against what aniposelib projects, in OpenCV's pixels."""
    read = read_calibration(write(tmp_path, "calibration.toml", ANIPOSE))
    assert (read.format, read.rig.names) == ("anipose", ("A", "B"))
    assert "mm is assumed" in read.notes[0]
    first, second = projected(read.rig, np.array([[3.0, -4, 120], [20, 15, 150], [-10, 12, 90]]))
    theirs = [[560.67168661, 250.4774812], [628.85994004, 377.18640075], [464.82745499, 385.7833627]]
    require_close(first, np.array(theirs) + 0.5)
    theirs = [[664.69256972, 223.69168364], [754.73104491, 274.9464412], [573.59054603, 313.77581295]]
    require_close(second, np.array(theirs) + 0.5)


CALISCOPE = """[cameras.0]
cam_id = 0
rotation_count = 0
fisheye = false
size = [1280, 720]
matrix = [[900.0, 0.0, 620.0], [0.0, 905.0, 390.0], [0.0, 0.0, 1.0]]
distortions = [-0.3, 0.04, -0.004, 0.004, 0.06]
translation = [0.12, -0.2, 0.66]
rotation = [0.09999999999999984, -0.19999999999999968, 0.049999999999999926]

[cameras.1]
cam_id = 1
rotation_count = 0
fisheye = false
size = [1280, 720]
matrix = [[901.0, 0.0, 620.0], [0.0, 905.0, 390.0], [0.0, 0.0, 1.0]]
distortions = [-0.3, 0.04, -0.004, 0.004, 0.06]
translation = [-0.18, -0.2, 0.66]
rotation = ROTATION

[cameras.2]
cam_id = 2
fisheye = false
size = [1280, 720]
matrix = [[901.0, 0.0, 620.0], [0.0, 905.0, 390.0], [0.0, 0.0, 1.0]]
distortions = [-0.3, 0.04, -0.004, 0.004, 0.06]
"""
"""Written by caliscope 0.11.8; the third camera has no place yet."""


@pytest.mark.parametrize("is_matrix", [False, True])
def test_cameras_of_caliscope(tmp_path: Path, is_matrix: bool) -> None:
    """Metres; older versions wrote the rotation as a matrix."""
    turn = np.array([0.1, 0.1, 0.05])
    written = cv2.Rodrigues(turn)[0].tolist() if is_matrix else turn.tolist()
    read = read_calibration(write(tmp_path, "camera_array.toml", CALISCOPE.replace("ROTATION", str(written))))
    assert (read.format, read.rig.names) == ("caliscope", ("cam_0", "cam_1"))
    assert "camera cam_2 has no place" in read.notes[0]
    points = POINTS * 8
    matrix = np.array([[901.0, 0, 620.0], [0, 905.0, 390], [0, 0, 1]])
    lens = np.array([-0.3, 0.04, -0.004, 0.004, 0.06])
    theirs = by_opencv(points, turn, np.array([-180.0, -200, 660]), matrix, lens)
    require_close(projected(read.rig, points)[1], theirs)


# --- Nerfstudio ----------------------------------------------------------------------------------------------------


def test_transforms_of_nerfstudio(tmp_path: Path) -> None:
    """As its page on data conventions has it: OpenGL's axes, the middle of the first pixel at 0.5."""
    shared = {"camera_model": "OPENCV", "fl_x": 1072.0, "fl_y": 1068.0, "cx": 1504.0, "cy": 1000.0, "w": 3008,
              "h": 2000, "k1": 0.0312, "k2": 0.0051, "p1": 0.0006, "p2": -0.0013}  # fmt: skip
    frames, seen = [], []
    for index, turn in enumerate(([0.1, 0.2, 0.0], [0.0, -0.3, 0.1])):
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        world_from_camera[:3, 3] = [0.3 * index, 0.1, 1.5]
        frames.append({"file_path": f"images/frame_0000{index}.jpeg", "transform_matrix": world_from_camera.tolist()})
        x, y, z = ((np.column_stack([POINTS / 1000, np.ones(len(POINTS))])) @ np.linalg.inv(world_from_camera).T)[
            :, :3
        ].T
        right, down = x / -z, -y / -z
        r2 = right**2 + down**2
        radial = 1 + 0.0312 * r2 + 0.0051 * r2**2
        u = right * radial + 2 * 0.0006 * right * down - 0.0013 * (r2 + 2 * right**2)
        v = down * radial + 0.0006 * (r2 + 2 * down**2) - 2 * 0.0013 * right * down
        seen.append(np.stack([1072.0 * u + 1504.0, 1068.0 * v + 1000.0], axis=1))
    read = read_calibration(write(tmp_path, "t.json", json.dumps({**shared, "frames": frames})))
    assert (read.format, read.rig.names) == ("nerfstudio", ("frame_00000", "frame_00001"))
    assert "m is assumed" in read.notes[0]
    for ours, theirs in zip(projected(read.rig), seen, strict=True):
        require_close(ours, theirs)


# --- COLMAP --------------------------------------------------------------------------------------------------------


def test_a_text_model_of_colmap(tmp_path: Path) -> None:
    """Written by pycolmap, and projected by it."""
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(
        camera_id=1, model="RADIAL_FISHEYE", width=640, height=480, params=[300, 321, 239, 0.05, -0.01]
    )
    model.add_camera_with_trivial_rig(lens)
    poses = []
    for index, turn in enumerate(([0.1, 0.2, 0.0], [0.0, -0.3, 0.1]), start=1):
        pose = pycolmap.Rigid3d(
            pycolmap.Rotation3d(Rotation.from_rotvec(turn).as_matrix()), np.array([index, 2.0, 3.0])
        )
        model.add_image_with_trivial_frame(pycolmap.Image(name=f"a/{index}.png", camera_id=1, image_id=index), pose)
        poses.append(pose)
    model.write_text(tmp_path)
    read = read_calibration(tmp_path)
    assert (read.format, read.rig.names) == ("colmap", ("a/1", "a/2"))
    for ours, pose in zip(projected(read.rig), poses, strict=True):
        require_close(ours, np.array([lens.img_from_cam(pose * point) for point in POINTS]).reshape(-1, 2))


def test_cameras_of_colmap_alone(tmp_path: Path) -> None:
    path = write(tmp_path, "endoscope.txt", "# comment\n1 SIMPLE_RADIAL 640 480 500.0 320.5 240.5 -0.1\n")
    read = read_calibration(path)
    assert (read.format, read.rig.names) == ("colmap", ("camera",))
    np.testing.assert_allclose(read.rig["camera"].camera.parameters, [500, 500, 320.5, 240.5, -0.1, 0, 0, 0])
    with pytest.raises(InputError, match="folder of both"):
        read_calibration(write(tmp_path, "two.txt", path.read_text() + path.read_text().replace("\n1 ", "\n2 ")))


# --- Metashape -----------------------------------------------------------------------------------------------------

METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="1">
      <sensor id="0" label="M3M (12.29mm)" type="frame">
        <resolution width="5280" height="3956"/>
        <property name="layer_index" value="0"/>
        <calibration type="frame" class="initial"><f>3700</f></calibration>
        <calibration type="frame" class="adjusted">
          <resolution width="5280" height="3956"/>
          <f>3705.4728</f><cx>11.67385</cx><cy>-27.7498</cy><b1>2.5262</b1><b2>{b2}</b2>
          <k1>-0.0919</k1><k2>-0.0763</k2><k3>0.1163</k3><k4>{k4}</k4><p1>-0.000313</p1><p2>0.000116</p2>
        </calibration>
      </sensor>
    </sensors>
    <components next_id="1" active_id="0">
      <component id="0" label="Component 1">
        <transform><scale locked="true">2.5</scale></transform>
      </component>
    </components>
    <cameras next_id="3" next_group_id="0">
      <camera id="0" sensor_id="0" component_id="0" label="IMG_1.JPG"><transform>{first}</transform></camera>
      <camera id="1" sensor_id="0" component_id="0" label="IMG_2.JPG"><transform>{second}</transform></camera>
      <camera id="2" sensor_id="0" label="IMG_3.JPG"/>
    </cameras>
  </chunk>
</document>
"""


@pytest.mark.parametrize(("b2", "k4"), [(0.0, 0.0), (-3.1, -0.0761)])
def test_cameras_of_metashape(tmp_path: Path, b2: float, k4: float) -> None:
    """By the formulas of its manual (appendix C); a unit of the chunk is 2.5 m."""
    matrices, seen = [], []
    for turn in ([0.1, 0.2, 0.0], [0.0, -0.3, 0.1]):
        matrices.append(np.eye(4))
        matrices[-1][:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        matrices[-1][:3, 3] = [0.01 * len(matrices), 0.002, -0.03]
        in_chunk = np.column_stack([POINTS / 2500, np.ones(len(POINTS))])
        points = (in_chunk @ np.linalg.inv(matrices[-1]).T)[:, :3]
        x, y = (points[:, :2] / points[:, 2:]).T
        r2 = x**2 + y**2
        radial = 1 - 0.0919 * r2 - 0.0763 * r2**2 + 0.1163 * r2**3 + k4 * r2**4
        bent_x = x * radial + (-0.000313 * (r2 + 2 * x**2) + 2 * 0.000116 * x * y)
        bent_y = y * radial + (0.000116 * (r2 + 2 * y**2) + 2 * -0.000313 * x * y)
        u = 5280 * 0.5 + 11.67385 + bent_x * 3705.4728 + bent_x * 2.5262 + bent_y * b2
        seen.append(np.stack([u, 3956 * 0.5 - 27.7498 + bent_y * 3705.4728], axis=1))
    first, second = (" ".join(f"{each:.16e}" for each in matrix.ravel()) for matrix in matrices)
    read = read_calibration(write(tmp_path, "cameras.xml", METASHAPE.format(b2=b2, k4=k4, first=first, second=second)))
    assert (read.format, read.rig.names) == ("metashape", ("IMG_1", "IMG_2"))
    assert read.notes == ("1 cameras are not aligned, and are left out",)
    assert bool(read.losses) == bool(k4)
    lost = max((loss.largest_px for loss in read.losses.values()), default=0.0)
    assert lost < 2
    for ours, theirs in zip(projected(read.rig), seen, strict=True):
        require_close(ours, theirs, 1.05 * lost + CLOSE_PX)


# --- MATLAB --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_new", [False, True])
def test_a_pair_of_matlab(tmp_path: Path, is_new: bool) -> None:
    """``[x y z] R + t``, ``[u v 1] ~ [x y z] IntrinsicMatrix``, the first pixel at (1, 1); newer versions have K and
    PoseCamera2, whose vectors are columns."""
    turn = cv2.Rodrigues(TURN)[0]

    def struct(matrix: np.ndarray, lens: np.ndarray) -> dict[str, object]:
        own = matrix + np.array([[0, 0, 1.0], [0, 0, 1], [0, 0, 0]])
        return {"RadialDistortion": lens[[0, 1, 4]].tolist(), "TangentialDistortion": lens[2:4].tolist(),
                "ImageSize": [720, 1280], "WorldPoints": [[0, 0], [0, 25]], "WorldUnits": "centimeters",
                **({"K": own.tolist()} if is_new else {"IntrinsicMatrix": own.T.tolist()})}  # fmt: skip

    pose = {"RotationOfCamera2": turn.T.tolist(), "TranslationOfCamera2": (SHIFT / 10).tolist()}
    if is_new:
        pose = {"PoseCamera2": {"Dimensionality": 3, "R": turn.tolist(), "Translation": (SHIFT / 10).tolist()}}
    values = {"CameraParameters1": struct(K1, D1), "CameraParameters2": struct(K2, D2), **pose}
    read = read_calibration(write(tmp_path, "m.json", json.dumps(values)))
    assert (read.format, read.notes) == ("matlab", ())
    first, second = projected(read.rig)
    require_close(first, by_opencv(POINTS, np.zeros(3), np.zeros(3), K1, D1))
    require_close(second, by_opencv(POINTS, TURN, SHIFT, K2, D2))


# --- HALCON --------------------------------------------------------------------------------------------------------


def campar(lens: dict[str, float]) -> str:
    """As ``write_cam_par`` writes it (reference manual, read_cam_par)."""
    values = {"Focus": 0.00806039, **lens, "Sx": 1.0629e-05, "Sy": 1.1e-05, "Cx": 378.236, "Cy": 297.587}
    fields = (f'{name}:{name.lower()}: {value:.17g};\n  DOUBLE::;\n  "[meter]";\n\n' for name, value in values.items())
    size = 'ImageWidth:imgw: 768;\n  INT:1:32767;\n  "[pixel]";\n\nImageHeight:imgh: 576;\n  INT:1:32767;\n'
    head = '# INTERNAL CAMERA PARAMETERS\n\nParGroup: Camera: Parameter;\n  "Internal camera parameters";\n\n'
    return head + "".join(fields) + size


def undistorted_by_halcon(lens: dict[str, float], pixels: np.ndarray) -> np.ndarray:
    """Directions through pixels whose first centre is (0, 0)."""
    u, v = (pixels[:, 0] - 378.236) * 1.0629e-05, (pixels[:, 1] - 297.587) * 1.1e-05
    r2 = u**2 + v**2
    if "Kappa" in lens:
        x, y = u / (1 + lens["Kappa"] * r2), v / (1 + lens["Kappa"] * r2)
    else:
        k1, k2, k3, p1, p2 = lens.values()
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x = u * radial + p1 * (r2 + 2 * u**2) + 2 * p2 * u * v
        y = v * radial + 2 * p1 * u * v + p2 * (r2 + 2 * v**2)
    return np.stack([x / 0.00806039, y / 0.00806039, np.ones(len(x))], axis=1)


@pytest.mark.parametrize(
    "lens",
    [
        {"Kappa": -2253.5},
        {"Kappa": 0.0},
        {"Poly1": 2100.0, "Poly2": 3e6, "Poly3": 1e10, "Poly4": 0.02, "Poly5": -0.03},
    ],
)
def test_camera_parameters_of_halcon(tmp_path: Path, lens: dict[str, float]) -> None:
    read = read_calibration(write(tmp_path, "campar.dat", campar(lens)))
    assert read.format == "halcon"
    pixels = np.stack(np.meshgrid(np.linspace(0, 767, 9), np.linspace(0, 575, 7)), -1).reshape(-1, 2)
    require_close(projected(read.rig, undistorted_by_halcon(lens, pixels))[0], pixels + 0.5)
    assert all(loss.largest_px < CLOSE_PX for loss in read.losses.values())


def test_a_pair_of_halcon(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The pose is that of the second camera in the frame of the first: R_x(a) R_y(b) R_z(c), metres."""
    for side in ("left", "right"):
        write(tmp_path, f"cam_{side}.dat", campar({"Kappa": 0.0}))
    pose = "# Used representation type:\nf 0\n\n# Rotation angles [deg] or Rodriguez vector:\nr 2 {} 5\n\n"
    write(tmp_path, "relpose.dat", pose.format(350) + "# Translation vector (x y z [m]):\nt 0.0046 0.0001 -0.0002\n")
    read = read_calibration(tmp_path)
    assert (read.format, read.rig.names) == ("halcon", ("cam_left", "cam_right"))
    (a, b, c), place = np.deg2rad([2, 350, 5]), read.rig["cam_right"].cam_from_rig.inverse()
    about_x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_z = np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    np.testing.assert_allclose(place.rotation, about_x @ about_y @ about_z, atol=1e-12)
    np.testing.assert_allclose(place.translation, [4.6, 0.1, -0.2], atol=1e-9)
    assert "only read" in refused(capsys, "rig", "convert", tmp_path, tmp_path / "x.dat", "--to", "halcon")
    (tmp_path / "relpose.dat").unlink()
    with pytest.raises(InputError, match="two and a pose"):
        read_calibration(tmp_path)


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
    rig = rig_of(min(3, FORMATS[kind].max_cameras or 3), model)
    carried = fit_to_format(rig, kind)
    path = tmp_path / f"it{SUFFIXES.get(kind, '.json')}"
    write_calibration(path, carried.rig, kind)
    read = read_calibration(path)
    assert read.format == kind
    assert not read.losses
    assert FORMATS[kind].keeps_names == (read.rig.names == rig.names)
    seen = [projected(each.in_frame(next(iter(each.cameras.values())).cam_from_rig)) for each in (rig, read.rig)]
    lost = max((loss.largest_px for loss in carried.losses.values()), default=0.0)
    for ours, again in zip(*seen, strict=True):
        assert np.nanmax(np.abs(ours - again)) < max(lost, 1e-6)


def test_covariances_and_names_that_are_lost_are_told() -> None:
    camera = rig_of(1)["c0"].camera
    known = MountedCamera(camera, Rigid3.identity(), np.eye(6))
    notes = fit_to_format(Rig({"a": known, "b": known}), "kalibr").notes
    assert any("covariances" in note for note in notes)
    assert any("a, b" in note for note in notes)
    with pytest.raises(OutputError, match="at most"):
        fit_to_format(rig_of(3), "ros")


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
    line = refused(capsys, "rig", "convert", tmp_path / "a.yml", tmp_path / "m.json", "--to", "matlab")
    assert "px off over the image" in line
    assert "--max-px" in line

    assert not (tmp_path / "m.json").exists()
    run("rig", "convert", tmp_path / "a.yml", tmp_path / "m.json", "--to", "matlab", "--max-px", "2000")
    assert (tmp_path / "m.json").exists()


def test_a_splined_lens_is_kept_by_handpieces_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shifts = np.random.default_rng(0).normal(0, 5 / 240, 2 * GRID**2)
    camera = Camera(
        width=640,
        height=480,
        focal_px=np.array([240.0, 240.0]),
        principal_point_px=np.array([320.0, 240.0]),
        distortion=np.array([0.0, 0, 0, 0, 1.4, *shifts]),
        model="SPLINED_FISHEYE",
    )
    rig = Rig({"a": MountedCamera(camera, Rigid3.identity())})
    assert fit_to_format(rig, "handpiece").rig["a"].camera is camera
    write_calibration(tmp_path / "handpiece.json", rig, "handpiece", 10.0)
    for kind in ("colmap-rig", "opencv", "kalibr"):
        lost = fit_to_format(rig, kind).losses["a"]
        assert 2 < lost.rms_px < lost.largest_px < 20
        target = tmp_path / f"x{SUFFIXES.get(kind, '.json')}"
        line = refused(capsys, "rig", "convert", tmp_path / "handpiece.json", target, "--to", kind)
        assert "SPLINED_FISHEYE as" in line
        assert "px off over the image" in line


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
    assert told.rig["c1"].cam_from_rig.translation == pytest.approx(read.rig["c1"].cam_from_rig.translation / 1000)


# --- the verb ------------------------------------------------------------------------------------------------------


def test_convert_writes_a_handpiece(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_calibration(tmp_path / "pair.yml", rig_of(2), "opencv")
    run("rig", "convert", tmp_path / "pair.yml", tmp_path / "handpiece.json", "--working-distance-mm", 30)
    handpiece = storage.read_handpiece(tmp_path / "handpiece.json")
    assert handpiece.working_distance_mm == 30
    assert handpiece.rig.names == ("c0", "c1")
    assert "2 camera(s)" in capsys.readouterr().err
    assert "give --to" in refused(capsys, "rig", "convert", tmp_path / "pair.yml", tmp_path / "x.abc")
    assert "is the file that is read" in refused(capsys, "rig", "convert", tmp_path / "pair.yml", tmp_path / "pair.yml")
    write(tmp_path, "other.yml", "a: 1\n")
    told = refused(capsys, "rig", "convert", tmp_path / "other.yml", tmp_path / "x.json")
    assert "name it with cuspid rig convert --from" in told


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
    texts = {"halcon": campar({"Poly1": 2100.0, "Poly2": 3e6, "Poly3": 1e10, "Poly4": 0.02, "Poly5": -0.03})}
    for kind in (name for name, each in FORMATS.items() if each.write is not None):
        path = folder / f"{kind}{'.json' if kind == 'opencv' else SUFFIXES.get(kind, '.json')}"
        write_calibration(path, rig_of(1 if kind == "ros" else 2), kind)
        texts[kind] = path.read_text()
    return texts


@pytest.mark.long
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
