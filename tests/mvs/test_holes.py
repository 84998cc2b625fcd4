"""Depth is measured where it adds to the surface, and temporal stereo where it left holes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from builders import folder_capture, image_path
from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.model.capture import Frame
from cuspid.model.reconstruction import DepthMap, Reconstruction, SurfacePoints, Tracks
from cuspid.mvs import stage
from cuspid.mvs.across import AcrossOptions
from cuspid.mvs.holes import Sightings, Views, greedy_cover
from cuspid.mvs.matching import StereoOptions
from synthetic_scene import diamond

SETS = st.lists(st.sets(st.integers(0, 39), max_size=15), max_size=12)


@given(sets=SETS, left=st.integers(0, 12))
def test_the_sets_that_are_taken_cover_all_but_what_may_be_left(sets: list[set[int]], left: int) -> None:
    taken = greedy_cover([np.array(sorted(each), dtype=np.int64) for each in sets], 40, float(left))
    every, covered = set().union(*sets), set().union(*(sets[k] for k in taken))
    assert len(every - covered) <= left
    assert taken == sorted(set(taken))
    assert len(taken) <= max(len(every) - left, 0)


@given(sets=SETS, least=st.integers(1, 6))
def test_no_set_is_taken_that_adds_too_little(sets: list[set[int]], least: int) -> None:
    taken = greedy_cover([np.array(sorted(each), dtype=np.int64) for each in sets], 40, least=least)
    covered = set().union(*(sets[k] for k in taken))
    assert all(len(each - covered) < least for each in sets)
    assert len(taken) * least <= len(covered)


def scene() -> tuple[Reconstruction, Tracks]:
    """Points 5 mm ahead of the cameras of two frames in one place, all seen by ``west`` and ``east`` in both."""
    rig = diamond().rig
    places = np.stack(np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)), axis=-1).reshape(-1, 2)
    points = np.column_stack([places, np.full(25, 5.0)])
    images = [(frame, rig.names.index(name)) for frame in (0, 1) for name in ("west", "east")]
    frame, camera = np.repeat(images, 25, axis=0).T
    tracks = Tracks(
        points=points,
        colors=np.zeros((25, 3), dtype=np.uint8),
        point_index=np.tile(np.arange(25), 4),
        frame_index=frame,
        camera_index=camera,
        pixels=np.zeros((100, 2)),
    )
    still = {"00000": Rigid3.identity(), "00001": Rigid3.identity()}
    return Reconstruction(rig=rig, rig_from_world=still, tracks=tracks), tracks


def plane(found: Reconstruction, frame: str, name: str, depth_mm: float) -> DepthMap:
    mounted = found.rig[name]
    camera = replace(mounted.camera, distortion=np.zeros(4))
    depth = np.full((camera.height, camera.width), depth_mm, dtype=np.float32)
    return DepthMap(
        frame=frame,
        camera_name=name,
        camera=camera,
        cam_from_rig=mounted.cam_from_rig,
        depth_mm=depth,
        confidence=np.ones_like(depth),
    )


@pytest.mark.parametrize(("off_mm", "expected"), [(0.0, 1), (0.05, 1), (-0.05, 1), (0.2, 0), (-0.2, 0), (np.nan, 0)])
def test_a_map_confirms_the_points_on_its_surface(off_mm: float, expected: int) -> None:
    found, tracks = scene()
    at_mm = found.rig["west"].cam_from_rig.apply(tracks.points)[:, 2]
    assert np.ptp(at_mm) < 1e-9
    maps = [plane(found, "00000", "west", at_mm[0] + off_mm)]
    count = Sightings.of(found, tracks).count_confirmations(maps, found.rig_from_world, 0.08)
    assert (count == expected).all()


def test_maps_of_all_located_frames_count_whether_keypoints_were_found_there_or_not() -> None:
    found, tracks = scene()
    seen = (tracks.point_index > 4) | (tracks.frame_index == 1)
    columns = ("point_index", "frame_index", "camera_index", "pixels")
    tracks = replace(tracks, **{name: getattr(tracks, name)[seen] for name in columns})
    depth = {name: found.rig[name].cam_from_rig.apply(tracks.points)[0, 2] for name in ("west", "east")}
    maps = [plane(found, frame, name, depth[name]) for frame in ("00000", "00001") for name in ("west", "east")]
    sightings = Sightings.of(found, tracks)
    assert (sightings.count_confirmations(maps, found.rig_from_world, 0.08) == 4).all()
    assert (sightings.count_confirmations(maps, {"00001": found.rig_from_world["00001"]}, 0.08) == 2).all()
    aside = found.rig_from_world | {"00001": Rigid3(np.eye(3), np.array([50.0, 0, 0]))}
    assert (sightings.count_confirmations(maps, aside, 0.08) == 2).all()


def test_points_in_stereo_are_those_that_two_of_the_cameras_show() -> None:
    found, tracks = scene()
    seen = (tracks.point_index < 7) | (tracks.camera_index == found.rig.names.index("west"))
    columns = ("point_index", "frame_index", "camera_index", "pixels")
    sightings = Sightings.of(found, replace(tracks, **{name: getattr(tracks, name)[seen] for name in columns}))
    assert sightings.in_stereo("00001", found.rig.names).tolist() == list(range(7))
    assert sightings.in_stereo("00001", ["west", "nobody"]).size == 0
    assert sightings.in_stereo("elsewhere", found.rig.names).size == 0


def test_images_share_the_points_that_both_show() -> None:
    found, tracks = scene()
    sightings = Sightings.of(found, tracks)
    assert sightings.both(("00000", "west"), ("00001", "west")).tolist() == list(range(25))
    assert sightings.both(("00000", "west"), ("00001", "nobody")).size == 0


def facing_cameras(points: np.ndarray) -> SurfacePoints:
    return SurfacePoints(points, np.tile([0.0, 0.0, -1.0], (len(points), 1)))


@pytest.mark.parametrize(("nearer_mm", "hides"), [(0.2, True), (0.05, False), (-0.5, False), (np.nan, False)])
def test_a_place_is_hidden_behind_a_depth_that_is_nearer(nearer_mm: float, hides: bool) -> None:
    found, tracks = scene()
    maps = [plane(found, "00000", "west", 5.0 - nearer_mm)]
    images = ("00000", "west"), ("00001", "west")  # the second has no depth map
    both = Views.of(facing_cameras(tracks.points), found, images, maps, 0.08).both(*images)
    assert both.tolist() == ([] if hides else list(range(25)))


@pytest.mark.parametrize(("turned_deg", "shown"), [(0, True), (65, True), (75, False), (180, False)])
def test_an_image_shows_what_is_turned_to_it(turned_deg: float, shown: bool) -> None:
    found, _ = scene()
    straight_ahead = found.rig["west"].cam_from_rig.inverse().apply(np.array([[0.0, 0, 5]]))
    turn = Rigid3.from_rotation_vector(np.array([0, np.deg2rad(turned_deg), 0]), np.zeros(3))
    places = SurfacePoints(straight_ahead, turn.rotate(np.array([[0.0, 0, -1]])))
    image = ("00000", "west")
    for maps in ([], [plane(found, "00000", "west", 5.0)]):
        assert (len(Views.of(places, found, [image], maps, 0.08).both(image, image)) == 1) == shown


def test_an_image_shows_what_lies_in_it() -> None:
    found, tracks = scene()
    places = facing_cameras(tracks.points + [30.0, 0, 0])
    image = ("00000", "west")
    for maps in ([], [plane(found, "00000", "west", 5.0)]):
        assert Views.of(places, found, [image], maps, 0.08).both(image, image).size == 0


STEP = Rigid3.from_rotation_vector(np.array([0.01, -0.02, 0.03]), np.array([-1.1, 0.15, 0.05]))


def matched(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    found: Reconstruction,
    maps: list[DepthMap],
    left_share: float,
    holes: SurfacePoints | None = None,
) -> list[list[str]]:
    """The cameras that are matched with themselves in the next frame, frame by frame."""
    capture, asked = folder_capture(folder, diamond(), ("00000", "00001")), list[list[str]]()
    for frame, name in product(("00000", "00001"), diamond().rig.names):
        camera = diamond().rig[name].camera
        blank = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
        storage.write_image(image_path(capture, frame, name), blank)
    monkeypatch.setattr(stage, "measure_moving_cameras", lambda _, now, after, *__: asked.append(sorted(now)) or ())
    stage.measure_depth_across(
        *(capture, found, maps, folder / "across", AcrossOptions(left_share=left_share), StereoOptions()),
        agreement_mm=0.08,
        min_maps=2,
        holes=holes,
    )
    return asked


def test_a_camera_is_matched_with_its_next_frame_where_that_fills_a_hole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, _ = scene()
    found = replace(found, rig_from_world={"00000": Rigid3.identity(), "00001": STEP})
    full = [plane(found, "00000", name, 5.0) for name in ("west", "east")]
    every = sorted(found.rig.names)
    assert matched(tmp_path / "full", monkeypatch, found, full, 0.03) == []
    assert matched(tmp_path / "holes", monkeypatch, found, full[:1], 0.03) in ([["west"]], [["east"]])
    assert matched(tmp_path / "everywhere", monkeypatch, found, full, 0.0) == [every]
    assert matched(tmp_path / "unknown", monkeypatch, replace(found, tracks=None), full, 0.03) == [every]


def test_a_hole_that_no_sparse_point_tells_is_matched_by_two_cameras_that_show_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, tracks = scene()
    found = replace(found, rig_from_world={"00000": Rigid3.identity(), "00001": STEP})
    full = [plane(found, "00000", name, 5.0) for name in ("west", "east")]
    behind = [plane(found, "00000", name, 4.0) for name in ("north", "south")]
    holes = facing_cameras(tracks.points[:9])
    [taken] = matched(tmp_path / "hole", monkeypatch, found, full, 0.03, holes)
    assert len(taken) == 2
    assert matched(tmp_path / "hidden", monkeypatch, found, [*full, *behind], 0.03, holes) == [["east", "west"]]
    assert matched(tmp_path / "tiny", monkeypatch, found, full, 0.03, facing_cameras(tracks.points[:4])) == []


def measured(
    folder: Path, monkeypatch: pytest.MonkeyPatch, found: Reconstruction, cameras: Sequence[str], left_share: float
) -> list[tuple[str, ...]]:
    """The frame and the cameras of each frame that depth is measured of, where some cameras get all of the surface."""
    capture, asked = folder_capture(folder, diamond(), ("00000", "00001")), list[tuple[str, ...]]()
    for frame, name in product(("00000", "00001"), diamond().rig.names):
        camera = diamond().rig[name].camera
        blank = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
        storage.write_image(image_path(capture, frame, name), blank)

    def measure(
        _: object, images: Mapping[str, np.ndarray], frame: str, lighting: str | None, **how: bool
    ) -> tuple[DepthMap, ...]:
        asked.append((frame, *sorted(images)))
        return tuple(plane(found, frame, name, 5.0) for name in cameras)

    monkeypatch.setattr(stage.DepthEstimator, "measure", measure)
    told = dict[str, tuple[int, int]]()
    depths = stage.measure_enough_depth(
        *(capture, found, folder / "depth", StereoOptions()),
        agreement_mm=0.08,
        left_share=left_share,
        progress=lambda name, done, total: told.update({name: (done, total)}),
    )
    asked.sort()  # threads take them in any order
    assert depths.frames == tuple(frame for frame, *_ in asked)
    assert all(done == total for done, total in told.values())
    return asked


def test_depth_of_a_frame_between_is_measured_where_it_adds_to_the_surface(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, _ = scene()
    every = tuple(sorted(found.rig.names))
    first, both = [("00000", *every)], [("00000", *every), ("00001", *every)]
    assert measured(tmp_path / "enough", monkeypatch, found, every, 0.1) == first
    assert measured(tmp_path / "few", monkeypatch, found, every[:3], 0.1) == both
    assert measured(tmp_path / "left", monkeypatch, found, every[:3], 1.0) == first
    assert measured(tmp_path / "all", monkeypatch, found, every, 0.0) == both
    assert measured(tmp_path / "unknown", monkeypatch, replace(found, tracks=None), every, 0.1) == both
    assert measured(tmp_path / "draft", monkeypatch, replace(found, tracks=None), every, 1.0) == first


def test_a_frame_between_is_measured_by_the_cameras_that_show_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, tracks = scene()
    seen = (tracks.frame_index == 0) | (tracks.camera_index == found.rig.names.index("west"))
    columns = ("point_index", "frame_index", "camera_index", "pixels")
    alone = replace(tracks, **{name: getattr(tracks, name)[seen] for name in columns})
    assert len(measured(tmp_path, monkeypatch, replace(found, tracks=alone), ["west"], 0.1)) == 1


def test_every_second_frame_of_each_light_comes_first() -> None:
    frames = [Frame(name=f"{k}", cameras=("a",), lighting=lit) for k, lit in enumerate("xyxyyxx")]
    assert [frame.name for frame in stage._select_every_second(frames)] == ["0", "1", "4", "5"]
