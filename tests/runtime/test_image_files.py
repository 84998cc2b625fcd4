"""Images are read by their content, upright, and as 8 bits whatever they store."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import (
    as_8_bits,
    common_brightening,
    exif_orientation,
    image_size,
    read_deep,
    read_image,
    recorded_size,
    stretch_fine,
    undo_exif_orientation,
    visible_in_8_bits,
)

SHADES = np.random.default_rng(0).integers(0, 256, (24, 40), dtype=np.uint8)
COLOURS = np.random.default_rng(1).integers(0, 256, (24, 40, 3), dtype=np.uint8)


def write(path: Path, image: np.ndarray) -> Path:
    """Whatever numbers an image has; colours are RGB."""
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)
    return path


@pytest.mark.parametrize("kind", ["JPEG", "BMP", "TIFF"])
def test_what_an_image_is_its_content_tells_and_not_its_name(tmp_path: Path, kind: str) -> None:
    Image.fromarray(COLOURS).save(tmp_path / "0.png", format=kind)
    assert image_size(tmp_path / "0.png") == (40, 24)
    assert read_image(tmp_path / "0.png").shape == (24, 40, 3)
    whole = (tmp_path / "0.png").read_bytes()
    (tmp_path / "0.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"decoded|truncated"):
        read_image(tmp_path / "0.png")


def test_a_truncated_png_is_told_whatever_its_name(tmp_path: Path) -> None:
    Image.fromarray(COLOURS).save(tmp_path / "0.jpg", format="PNG")
    (tmp_path / "0.jpg").write_bytes((tmp_path / "0.jpg").read_bytes()[:-5])
    with pytest.raises(InputError, match="truncated PNG"):
        image_size(tmp_path / "0.jpg")


def test_a_deep_png_with_a_wrong_checksum_is_told_and_nothing_besides(tmp_path: Path, capfd) -> None:
    """Pillow reads it, and with 8 of its bits; libpng complains to the terminal."""
    path = tmp_path / "0.png"
    cv2.imwrite(str(path), COLOURS.astype(np.uint16) << 8)
    data = bytearray(path.read_bytes())
    end_of_pixels = data.rindex(b"IEND") - 4
    data[end_of_pixels - 1] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"0\.png: cannot be decoded \(wrong checksums\); copy the image again"):
        read_image(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("image", [SHADES, COLOURS])
@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_fewer_bits_in_16_are_told_by_the_brightest_image_of_a_folder(
    tmp_path: Path, suffix: str, image: np.ndarray, bits: int
) -> None:
    deep = (image.astype(np.uint16) << (bits - 8)) + (3 if bits > 8 else 0)
    bright, dark = write(tmp_path / f"0{suffix}", deep), write(tmp_path / f"1{suffix}", deep // 4)
    expected = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    assert np.array_equal(read_image(bright), expected)
    assert np.abs(read_image(dark).astype(int) - expected // 4).max() <= 1
    assert np.array_equal(read_deep(bright), deep)


def test_nothing_waits_for_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "1.png")
    assert exif_orientation(tmp_path / "1.png") == 1
    assert read_image(write(tmp_path / "0.png", SHADES.astype(np.uint16))).any()


def test_black_images_stay_black(tmp_path: Path) -> None:
    path = write(tmp_path / "0.png", np.zeros((24, 40), np.uint16))
    assert not read_image(path).any()


def test_decimals_from_0_to_1_and_whole_numbers_are_grey_values(tmp_path: Path) -> None:
    decimals = write(tmp_path / "0.tiff", SHADES.astype(np.float32) / 255)
    assert np.array_equal(read_image(decimals)[..., 0], SHADES)
    (tmp_path / "whole").mkdir()
    Image.fromarray(SHADES.astype(np.int32) * 257).save(tmp_path / "whole" / "0.tiff")
    assert np.array_equal(read_image(tmp_path / "whole" / "0.tiff")[..., 1], SHADES)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (SHADES.astype(np.float32), "decimals from 0 to 255"),
        (np.full((24, 40), np.nan, np.float32), "decimals from nan to nan"),
        (SHADES.astype(np.int32) * 1000, "its values go from 0 to 255000"),
        (SHADES.astype(np.int32) - 9, "its values go from -9"),
    ],
)
def test_numbers_that_are_no_grey_values_are_refused_in_words(tmp_path: Path, values: np.ndarray, said: str) -> None:
    Image.fromarray(values).save(tmp_path / "0.tiff")
    with pytest.raises(InputError, match=said):
        read_image(tmp_path / "0.tiff")


def test_a_tiff_of_another_kind_is_not_called_truncated_only(tmp_path: Path) -> None:
    write(tmp_path / "0.tiff", SHADES.astype(np.float64))
    with pytest.raises(InputError, match="a TIFF of a kind that is not read"):
        image_size(tmp_path / "0.tiff")


def turned(path: Path, image: np.ndarray, orientation: int, *, late: bool = False) -> Path:
    """An image with an EXIF orientation, of a PNG perhaps behind its pixels."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format={".jpg": "JPEG", ".png": "PNG", ".tiff": "TIFF"}[path.suffix], exif=exif)
    data = stream.getvalue()
    if late:
        at = data.index(b"eXIf") - 4
        length = 12 + int.from_bytes(data[at : at + 4], "big")
        data = data[:at] + data[at + length : -12] + data[at : at + length] + data[-12:]
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["0.jpg", "0.png", "late.png", "0.tiff"])
def test_sizes_are_those_of_the_upright_image(tmp_path: Path, name: str, orientation: int) -> None:
    path = turned(tmp_path / name, COLOURS, orientation, late=name == "late.png")
    upright = read_image(path)
    assert image_size(path) == upright.shape[1::-1]
    assert exif_orientation(path) == orientation
    assert recorded_size(path) == (40, 24)
    back = undo_exif_orientation(upright, orientation)
    assert back.shape == COLOURS.shape
    if path.suffix != ".jpg":
        assert np.array_equal(back, COLOURS)


@pytest.mark.parametrize("image", [SHADES, COLOURS])
@pytest.mark.parametrize("orientation", [1, 6, 7])
def test_deep_images_are_turned_as_others_are(tmp_path: Path, orientation: int, image: np.ndarray) -> None:
    shallow = turned(tmp_path / "0.png", image, orientation)
    deep = write(tmp_path / "1.png", image.astype(np.uint16) * 257)
    donor, data = shallow.read_bytes(), deep.read_bytes()
    at = donor.index(b"eXIf") - 4
    chunk = donor[at : at + 12 + int.from_bytes(donor[at : at + 4], "big")]
    deep.write_bytes(data[:33] + chunk + data[33:])
    assert np.array_equal(read_image(deep), read_image(shallow))
    assert read_deep(deep).dtype == np.uint16


def test_what_is_stretched_beyond_white_stays_white_in_8_bits() -> None:
    dark = np.full((40, 40), 10, np.float32)
    dark[:2, :2] = 60
    stretched = stretch_fine(dark)
    assert stretched.max() > 256
    assert as_8_bits(stretched).min() > 200
    assert visible_in_8_bits(stretched)[0, 0] == visible_in_8_bits(dark)[0, 0] == 255
    assert as_8_bits(np.array([-3.0, 0.5, 255.9, 256.0, 300.0], np.float32)).tolist() == [0, 0, 255, 255, 255]


def test_to_import_cuspid_leaves_the_filters_of_warnings_alone() -> None:
    code = "import warnings, numpy, PIL.Image, cv2, scipy.spatial, trimesh; before = list(warnings.filters);"
    code += "import cuspid.runtime.image_files, cuspid.model.capture, cuspid.storage; print(warnings.filters == before)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"


def test_images_of_a_film_are_made_brighter_alike() -> None:
    """By what all but the brightest tenth of them bear; those of 8 bits, and bright ones, are left as they are."""
    film = [np.full((20, 20, 3), level, np.float32) for level in [5.0] * 18 + [10.0] + [100.0]]
    assert common_brightening(film) == pytest.approx(255 / 5)
    assert common_brightening([*film, *film[-2:]]) < 255 / 5
    assert common_brightening(as_8_bits(image) for image in film) == 1
    assert common_brightening([film[0] + 200]) == 1
    assert common_brightening([]) == 1
    assert as_8_bits(film[0], 51.0).max() == 255
    assert as_8_bits(as_8_bits(film[0]), 51.0).max() == 5
