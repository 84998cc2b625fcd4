"""Files that are not what they should be: too short, endless, too large, without area, or none at all."""

from __future__ import annotations

import os
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from builders import sphere, write_frames
from cuspid import storage
from cuspid.handpiece.designs import DESIGNS
from cuspid.runtime.errors import InputError, OutputError
from cuspid.runtime.image_files import image_size, read_image
from cuspid.runtime.inputs import LARGEST_MIB, read_text, require_file
from verbs import refused


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/urandom", "fifo", "folder", "missing"])
def test_only_regular_files_are_opened(tmp_path: Path, device: str) -> None:
    """The others would never end, or never begin."""
    path = Path(device) if device.startswith("/") else tmp_path / device
    if device == "fifo":
        os.mkfifo(path)
    elif device == "folder":
        path.mkdir()
    for read in (read_text, storage.read_json, storage.hash_file, read_image, storage.read_handpiece):
        with pytest.raises(InputError, match=r"pipe or a device|is a folder|no such file"):
            read(path)


def test_a_file_is_as_large_as_its_kind_allows(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    with path.open("wb") as stream:
        stream.truncate(LARGEST_MIB["text"] << 20)
    assert require_file(path, "text") == path
    with path.open("ab") as stream:
        stream.write(b" " * (1 << 20))
    with pytest.raises(InputError, match=r"65 MiB is too large .*\(text\); the limit is 64 MiB"):
        read_text(path)


@pytest.mark.parametrize("text", ['{"a": [1, NaN]}', '{"a": [1, -Infinity]}', '{"a": [1, 1e999]}'])
def test_what_is_no_number_of_json_is_named_with_its_place(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InputError, match=r"x\.json: a\[1\] is (nan|-?inf); a number must be finite"):
        storage.read_json(tmp_path / "x.json")


def test_json_that_is_nested_without_end_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("[" * 200_000)
    with pytest.raises(InputError, match="nested too deep"):
        storage.read_json(tmp_path / "x.json")


# --- meshes -------------------------------------------------------------------------------------------------------


def text_ply() -> bytes:
    ball = sphere(3.0, 2)
    return trimesh.Trimesh(ball.vertices, ball.faces, process=False).export(file_type="ply", encoding="ascii")


def text_stl() -> bytes:
    ball = sphere(3.0, 2)
    return str(trimesh.Trimesh(ball.vertices, ball.faces, process=False).export(file_type="stl_ascii")).encode()


@pytest.mark.parametrize(("suffix", "data"), [(".ply", text_ply()), (".stl", text_stl())])
@pytest.mark.parametrize("share", [0.3, 0.8, 0.97])
def test_a_truncated_text_mesh_is_no_mesh(tmp_path: Path, suffix: str, data: bytes, share: float) -> None:
    path = tmp_path / f"mesh{suffix}"
    path.write_bytes(data)
    assert len(storage.read_mesh(path).faces) == 320
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=r"truncated|not a mesh|empty"):
        storage.read_mesh(path)


@pytest.mark.parametrize("count", [b"4000000000", b"9" * 30])
def test_a_header_may_not_promise_more_than_the_file_holds(tmp_path: Path, count: bytes) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(text_ply().replace(b"element face 320", b"element face " + count))
    with pytest.raises(InputError, match=r"too short for its \d+ elements"):
        storage.read_mesh(path)


@pytest.mark.parametrize("far", [1e200, 2e5, -1e30])
def test_a_vertex_beyond_all_reason_is_told(tmp_path: Path, far: float) -> None:
    ball = sphere(3.0, 2)
    vertices = np.array(ball.vertices)
    vertices[7, 1] = far
    path = tmp_path / "mesh.obj"
    path.write_text(trimesh.Trimesh(vertices, ball.faces, process=False).export(file_type="obj"))
    with pytest.raises(InputError, match="coordinates beyond 100 m"):
        storage.read_mesh(path)


def test_triangles_without_area_are_no_surface(tmp_path: Path) -> None:
    path = tmp_path / "line.obj"
    path.write_text("v 0 0 0\nv 1 1 1\nv 2 2 2\nf 1 2 3\n")
    with pytest.raises(InputError, match="have no area"):
        storage.read_mesh(path)


# --- images -------------------------------------------------------------------------------------------------------


def test_a_large_image_is_read_and_a_bomb_is_not(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    path = tmp_path / "x.png"
    Image.new("1", (12_000, 9_000)).save(path)
    assert image_size(path) == (12_000, 9_000)
    data = path.read_bytes()
    header = b"IHDR" + (60_000).to_bytes(4, "big") * 2 + data[24:29]
    path.write_bytes(data[:12] + header + zlib.crc32(header).to_bytes(4, "big") + data[33:])
    with pytest.raises(InputError, match="too many pixels"):
        image_size(path)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_an_image_is_as_upright_as_its_camera_says(tmp_path: Path, orientation: int) -> None:
    """The size at a glance is that of the image that is read."""
    lying = np.zeros((20, 30, 3), np.uint8)
    lying[:5, :5] = 255
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "x.jpg"
    Image.fromarray(lying).save(path, exif=exif, quality=100)
    image = read_image(path)
    assert image_size(path) == (image.shape[1], image.shape[0])
    assert (image.shape[0] > image.shape[1]) == (orientation > 4)
    corner = {1: (0, 0), 2: (0, -1), 3: (-1, -1), 4: (-1, 0), 5: (0, 0), 6: (0, -1), 7: (-1, -1), 8: (-1, 0)}
    assert image[corner[orientation]].min() > 200


@pytest.mark.parametrize("mode", ["L", "P", "RGBA", "I;16", "1", "LA"])
def test_images_of_any_mode_become_rgb_of_8_bits(tmp_path: Path, mode: str) -> None:
    gray = np.tile(np.arange(0, 256, 8, dtype=np.uint8), (4, 1))
    made = Image.fromarray(gray.astype(np.uint16) * 257) if mode == "I;16" else Image.fromarray(gray).convert(mode)
    made.save(tmp_path / "x.png")
    image = read_image(tmp_path / "x.png")
    assert image.shape == (4, 32, 3)
    if mode != "1":
        np.testing.assert_allclose(image[..., 1], gray, atol=1)


# --- verbs --------------------------------------------------------------------------------------------------------


def test_measure_fails_where_nothing_was_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    jaws = tmp_path / "jaws"
    jaws.mkdir()
    (jaws / "junk.stl").write_bytes(b"junk")
    assert "none of the 1 jaws can be measured; junk: " in refused(
        capsys, "jaw", "measure", jaws, "--out", tmp_path / "out"
    )
    assert not (tmp_path / "out").exists()


def test_jaws_of_one_name_are_told_apart_by_the_user(
    tmp_path: Path, phantom_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    jaws = tmp_path / "jaws"
    jaws.mkdir()
    for suffix in (".ply", ".stl"):
        shutil.copy(phantom_file, jaws / f"one{suffix}")
    assert "has the same name" in refused(capsys, "jaw", "measure", jaws, "--out", tmp_path / "out")
    assert "has the same name" in refused(capsys, "jaw", "shape", jaws, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_of_a_file_the_contents_count_not_where_it_lies(tmp_path: Path) -> None:
    """A run goes on with the same handpiece from elsewhere, and does not with another one from the same place."""
    for name in ("here", "there"):
        storage.write_handpiece(tmp_path / f"{name}.json", DESIGNS["four"]())
    same = {"handpiece": storage.hash_file(tmp_path / "there.json")}
    storage.claim_folder(tmp_path / "out", "simulate", {"handpiece": tmp_path / "here.json"}, same)
    entry = storage.read_json(tmp_path / "out" / "run.json")
    storage.claim_folder(tmp_path / "out", "simulate", {"handpiece": tmp_path / "there.json"}, same)
    assert storage.read_json(tmp_path / "out" / "run.json") == entry
    storage.write_handpiece(tmp_path / "here.json", DESIGNS["six"]())
    other = {"handpiece": storage.hash_file(tmp_path / "here.json")}
    with pytest.raises(OutputError, match=r"inputs_sha256\.handpiece differs"):
        storage.claim_folder(tmp_path / "out", "simulate", {"handpiece": tmp_path / "here.json"}, other)


@pytest.mark.parametrize("opening", ["[", "{a: ", "- ", "<a>"])
def test_a_calibration_that_is_nested_without_end_is_refused(tmp_path, opening):
    """OpenCV's readers end the program by it."""
    write_frames(tmp_path / "frames", [np.zeros((48, 64, 3), dtype=np.uint8)] * 2)
    (tmp_path / "camera.yml").write_text(f"%YAML:1.0\n---\ncamera_matrix: {100_000 * opening}")
    with pytest.raises(InputError, match="nested more than"):
        storage.read_sequence(tmp_path / "frames", tmp_path / "out", calibration=tmp_path / "camera.yml")


@pytest.mark.parametrize("text", ["- 1\n- 2\n", "3\n"])
def test_a_calibration_of_opencv_that_is_a_list_or_a_number_is_told(tmp_path: Path, text: str) -> None:
    file, image = tmp_path / "camera.yml", np.zeros((40, 60, 3), np.uint8)
    file.write_text(f"%YAML:1.0\n---\n{text}")
    for name in ("0", "1"):
        storage.write_image(tmp_path / "frames" / f"{name}.png", image)
    with pytest.raises(InputError, match="no known calibration format"):
        storage.read_sequence(tmp_path / "frames", tmp_path / "out", calibration=file)
