"""Why a board is not found is told, and images count as what they are."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from boards import photograph, photographs, pose_before, scene, undistorted
from builders import rig_of, shifted
from cuspid import storage
from cuspid.calibration import corners
from cuspid.calibration.calibrate import size_notes
from cuspid.calibration.causes import cause_of_absence, is_part_of_a_larger_one
from cuspid.calibration.corners import find_corners
from cuspid.calibration.from_images import _match_frames
from cuspid.calibration.instants import common_instants
from cuspid.model.board import Board, BoardSet, Target
from cuspid.model.camera import Camera
from cuspid.model.image_sequence import ImageSequence
from cuspid.model.rig import Rig
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import exif_orientation, read_image, undo_exif_orientation
from verbs import refused, run

BOARD = Board(columns=7, rows=6, square_mm=2.5)
CHESSBOARD = Board(kind="chessboard", columns=7, rows=6, square_mm=2.5)


def pictures(folder: Path, board: Board, instants: int = 3) -> list[np.ndarray]:
    whole = scene(0, board, cameras=1, instants=instants)
    photographs(folder, replace(whole, cameras={k: undistorted(each) for k, each in whole.cameras.items()}), board)
    return [cv2.cvtColor(read_image(path), cv2.COLOR_RGB2GRAY) for path in sorted(folder.glob("cam0/*.png"))]


@pytest.mark.parametrize(
    ("shown", "described", "told"),
    [
        ({"legacy": True}, {}, "old layout of OpenCV: give --legacy"),
        ({}, {"legacy": True}, "new layout of OpenCV: give --no-legacy"),
        ({"first_id": 100}, {}, "ids of its markers begin at 100: give --first-id 100"),
        ({}, {"first_id": 200}, "give --first-id 0"),
        ({}, {"columns": 6, "rows": 5}, "corners were counted, not its squares: give --columns 7 --rows 6"),
        ({}, {"columns": 6, "rows": 7}, "columns and rows are swapped: give --columns 7 --rows 6"),
        ({}, {"columns": 9, "rows": 6}, "a board of 7 x 6 squares: give --columns 7 --rows 6"),
        ({"legacy": True}, {"rows": 7}, "a board of 7 x 6 squares: give --columns 7 --rows 6 --legacy"),
        ({}, {"kind": "circles"}, "(ids 0-20): give --kind charuco --dictionary 4X4_1000 --columns 7 --rows 6, with"),
        ({"dictionary": "5X5_100"}, {}, "another family: give --dictionary 5X5_1000"),
        ({"kind": "chessboard"}, {}, "no markers: give --kind chessboard"),
    ],
)
def test_what_a_board_should_have_been_called(tmp_path: Path, shown: dict, described: dict, told: str) -> None:
    images, asked = pictures(tmp_path, replace(BOARD, **shown)), replace(BOARD, **described)
    assert not any(find_corners(image, asked) for image in images)
    cause = cause_of_absence(images, asked)
    assert cause is not None
    assert told in cause


def test_a_part_of_a_larger_chessboard_is_told(tmp_path: Path) -> None:
    images = pictures(tmp_path, CHESSBOARD)
    assert is_part_of_a_larger_one(images, replace(CHESSBOARD, columns=6, rows=5))
    assert not is_part_of_a_larger_one(images, CHESSBOARD)


def test_mirrored_images_are_told(tmp_path: Path) -> None:
    images = [np.ascontiguousarray(image[:, ::-1]) for image in pictures(tmp_path, BOARD)]
    assert "mirrored" in str(cause_of_absence(images, BOARD))


def test_without_a_board_there_is_no_cause() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (1, 90, 120), dtype=np.uint8)
    assert cause_of_absence(list(noise), BOARD) is None


def test_ids_may_begin_anywhere_in_the_dictionary(tmp_path: Path) -> None:
    board = replace(BOARD, first_id=40)
    assert all(find_corners(image, board) is not None for image in pictures(tmp_path, board))
    with pytest.raises(InputError, match="needed, but the dictionary 4X4_50 has 50"):
        replace(BOARD, first_id=40, dictionary="4X4_50")


def test_a_chessboard_is_searched_for_exhaustively(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def find(image: np.ndarray, size: tuple[int, int], flags: int = 0) -> tuple[bool, np.ndarray | None]:
        asked.append(flags)
        places = np.stack(np.meshgrid(np.arange(1, 7), np.arange(1, 6)), axis=-1).reshape(-1, 1, 2)
        return (True, 10 * places.astype(np.float32) - 0.5) if flags == cv2.CALIB_CB_EXHAUSTIVE else (False, None)

    monkeypatch.setattr(corners.cv2, "findChessboardCornersSB", find)
    squares = np.indices((6, 7)).sum(axis=0) % 2 * 200
    assert find_corners(np.kron(squares, np.ones((10, 10))).astype(np.uint8), CHESSBOARD) is not None
    assert asked == [0, cv2.CALIB_CB_EXHAUSTIVE]


@pytest.mark.parametrize("gone", [np.s_[-1], np.s_[:, 0]])
def test_the_ends_of_outer_squares_are_no_corners(monkeypatch: pytest.MonkeyPatch, gone: object) -> None:
    """A board whose other end is out of the picture: a row of corners is found where its border is white."""
    places = np.stack(np.meshgrid(np.arange(1, 7), np.arange(1, 6)), axis=-1).reshape(-1, 1, 2)
    found = (True, 10 * places.astype(np.float32) - 0.5)
    monkeypatch.setattr(corners.cv2, "findChessboardCornersSB", lambda *_, **__: found)
    squares = np.indices((6, 7)).sum(axis=0) % 2 * 200
    squares[gone] = 200
    assert find_corners(np.kron(squares, np.ones((10, 10))).astype(np.uint8), CHESSBOARD) is None


@pytest.mark.parametrize(
    ("names", "instants"),
    [
        ({"cam1": ["cam1_0001", "cam1_0002"], "cam2": ["cam2_0001", "cam2_0002"]}, ("1", "2")),
        ({"left": ["left_0009", "left_0010"], "right": ["right_0009", "right_0010"]}, ("09", "10")),
        ({"l": ["l1_t3", "l1_t4"], "r": ["r2-004", "r2-005"]}, ("3", "4")),
    ],
)
def test_names_with_a_prefix_are_matched_by_their_number(names: dict, instants: tuple[str, str]) -> None:
    found = common_instants(names)
    assert found is not None
    assert found[next(iter(names))] == instants


def test_common_names_are_the_instants_and_others_are_told() -> None:
    assert common_instants({"a": ["01", "02"], "b": ["02", "03"]}) is None
    assert common_instants({"a": ["x", "y"]}) is None
    with pytest.raises(InputError, match="no two cameras have an image of the same name, or with the same number"):
        common_instants({"a": ["one", "two"], "b": ["three", "four"]})
    with pytest.raises(InputError, match=r"\(a: x1, b: y8\)"):
        common_instants({"a": ["x1", "x2"], "b": ["y8", "y9"]})


def test_prefixed_images_are_matched_and_it_is_told() -> None:
    sequences = {
        camera: ImageSequence(
            source=Path(camera), paths=tuple(Path(f"{camera}_{number:04d}.png") for number in (1, 2)), size=(64, 64)
        )
        for camera in ("left", "right")
    }
    matched, (note,) = _match_frames(sequences)
    assert [each.names for each in matched.values()] == [("1", "2"), ("1", "2")]
    assert "left: left_0001 is 1, right: right_0001 is 1" in note


def test_the_verb_names_the_cause_and_the_images_without_a_board(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures(tmp_path / "photos", BOARD, instants=6)
    asked = ["calibrate", tmp_path / "photos", "--square-mm", 2.5, "--columns", 7, "--rows", 6, "--no-photometry"]
    message = refused(capsys, *asked, "--legacy", "--out", tmp_path / "out")
    assert "found in 0 of 6 images of camera cam0; the board has the new layout" in message
    assert not (tmp_path / "out").exists()
    (file,) = (tmp_path / "photos" / "cam0").glob("03.png")
    storage.write_image(file, np.full((480, 640, 3), 90, np.uint8))
    run(*asked, "--out", tmp_path / "out")
    assert "the board was not found in 1 of 6 images: 03" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(("growth", "told"), [(0.96, "closer"), (1.0, None), (1.005, None), (1.05, "farther")])
def test_a_print_of_another_size_is_asked_for(growth: float, told: str | None) -> None:
    drawn, found = (rig_of(a=shifted(0), b=shifted(20 * size), c=shifted(9, 5 * size)) for size in (1.0, growth))
    found = Rig({**found.cameras, "c": rig_of(c=shifted(9 * growth, 5 * growth))["c"]})
    notes = size_notes(found, drawn, BOARD)
    assert bool(notes) == (told is not None)
    assert all(f"{told} " in note and f"With {2.5 / growth:.3g} they lie as drawn" in note for note in notes)
    assert size_notes(rig_of(a=shifted(0)), rig_of(a=shifted(3)), BOARD) == ()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_image_is_turned_back_to_the_sensor(tmp_path: Path, orientation: int) -> None:
    sensor = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(sensor).save(tmp_path / "x.png", exif=exif)
    assert exif_orientation(tmp_path / "x.png") == orientation
    np.testing.assert_array_equal(undo_exif_orientation(read_image(tmp_path / "x.png"), orientation), sensor)


@pytest.mark.parametrize("ways", [(1, 6), (3, 1), (8, 6), (6, 6)])
def test_a_camera_that_was_held_in_several_ways_has_one_sensor(tmp_path: Path, ways: tuple[int, int]) -> None:
    sensor = np.random.default_rng(0).integers(0, 255, (60, 90, 3), dtype=np.uint8)
    for number, way in enumerate(2 * ways):
        exif = Image.Exif()
        exif[0x0112] = way
        Image.fromarray(sensor).save(tmp_path / f"{number}.png", exif=exif)
    sequence = storage.read_sequence(tmp_path, tmp_path / "out")
    if len(set(ways)) == 1:
        assert sequence.notes == ()
        return
    assert sequence.size == (90, 60)
    assert "EXIF" in sequence.notes[0]
    for index in range(len(sequence)):
        np.testing.assert_array_equal(sequence.image(index), sensor)


TAGS = Board(kind="aprilgrid", columns=4, rows=3, square_mm=3.0, first_id=20)
CIRCLES = Board(kind="circles", columns=7, rows=5, square_mm=2.5)
SHIFTED = Board(kind="asymmetric-circles", columns=4, rows=9, square_mm=1.6)
BOTH = BoardSet(boards=(BOARD, replace(BOARD, first_id=30)))


@pytest.fixture(scope="module")
def shots() -> Callable[[Board], list[np.ndarray]]:
    """Two images of a board, taken once."""
    camera = Camera(width=320, height=240, focal_px=np.full(2, 260.0), principal_point_px=np.array([160.0, 120.0]))

    @cache
    def taken(board: Board) -> list[np.ndarray]:
        return [photograph(board, camera, pose_before(board, 26.0, tilt), 3) for tilt in (0.0, 25.0)]

    return taken


@pytest.mark.long
@pytest.mark.parametrize(
    ("shown", "asked", "told"),
    [
        (TAGS, replace(TAGS, first_id=100), "begin at 20: give --first-id 20 ("),
        (TAGS, replace(TAGS, border_bits=1), "its tags have borders of 2 bits: give --border-bits 2"),
        (TAGS, replace(TAGS, columns=3, rows=4), "there are 4 tags in a row: give --columns 4 --rows 3"),
        (TAGS, replace(TAGS, columns=8, rows=6), "there are 4 tags in a row: give --columns 4 --rows 3"),
        (TAGS, replace(TAGS, inverted=True), "light and dark are swapped: give --no-inverted"),
        (TAGS, BOARD, "-31): give --kind aprilgrid"),
        (BOARD, TAGS, "markers of the family 4X4_1000 (ids 0-20): give --kind charuco --dictionary 4X4_1000"),
        (CHESSBOARD, TAGS, "a chessboard of 7 x 6 squares: give --kind chessboard --columns 7 --rows 6"),
        (
            CIRCLES,
            replace(CIRCLES, columns=8, rows=6),
            "a grid of 7 x 5 circles: give --kind circles --columns 7 --rows 5",
        ),
        (CIRCLES, SHIFTED, "a grid of 7 x 5 circles: give --kind circles --columns 7 --rows 5"),
        (SHIFTED, CIRCLES, "a grid of 4 x 9 circles: give --kind asymmetric-circles --columns 4 --rows 9"),
        (CHESSBOARD, CIRCLES, "a chessboard of 7 x 6 squares: give --kind chessboard --columns 7 --rows 6"),
        (CIRCLES, replace(CIRCLES, inverted=True), "light and dark are swapped: give --no-inverted"),
        (CIRCLES, CHESSBOARD, "a grid of 7 x 5 circles: give --kind circles --columns 7 --rows 5"),
        (replace(BOARD, first_id=100), BOTH, "with the ids 100-120 found, these boards have 0-20 and 30-50"),
    ],
)
def test_what_other_kinds_of_boards_should_have_been_called(
    shots: Callable[[Board], list[np.ndarray]], shown: Board, asked: Target, told: str
) -> None:
    images = shots(shown)
    assert not any(find_corners(image, asked) is not None for image in images)
    assert told in str(cause_of_absence(images, asked))


@pytest.mark.parametrize("board", [TAGS, Board(kind="asymmetric-circles", columns=4, rows=8, square_mm=1.6)])
def test_mirrored_prints_of_other_kinds_are_told(shots: Callable[[Board], list[np.ndarray]], board: Board) -> None:
    images = [np.ascontiguousarray(image[:, ::-1]) for image in shots(board)]
    assert "mirrored" in str(cause_of_absence(images, board))


@pytest.mark.long
def test_the_layout_of_one_of_several_boards_is_told(shots: Callable[[Board], list[np.ndarray]]) -> None:
    images = shots(replace(BOARD, first_id=30, legacy=True))
    assert "board 2: the board has the old layout of OpenCV: give --legacy" in str(cause_of_absence(images, BOTH))


def test_a_larger_chart_of_markers_is_told_with_its_ids(tmp_path: Path) -> None:
    """More ids than the board has, so no first id would do."""
    images = pictures(tmp_path, replace(BOARD, columns=11, rows=9, first_id=100), instants=1)
    assert "with the ids 1" in str(cause_of_absence(images, BOARD))
    assert "found, this board has 0-20" in str(cause_of_absence(images, BOARD))
