"""Temporal stereo goes where depth from one frame left holes."""

from __future__ import annotations

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
from cuspid.reconstruction import DepthMap, Reconstruction, Tracks
from cuspid.stereo import stage
from cuspid.stereo.holes import Sightings, covering
from cuspid.stereo.temporal import TemporalOptions
from synthetic_scene import diamond

SETS = st.lists(st.sets(st.integers(0, 39), max_size=15), max_size=12)


@given(sets=SETS, left=st.integers(0, 12))
def test_the_sets_that_are_taken_cover_all_but_what_may_be_left(sets: list[set[int]], left: int) -> None:
    taken = covering([np.array(sorted(each), dtype=np.int64) for each in sets], 40, float(left))
    every, covered = set().union(*sets), set().union(*(sets[k] for k in taken))
    assert len(every - covered) <= left
    assert taken == sorted(set(taken))
    assert len(taken) <= max(len(every) - left, 0)


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
    count = Sightings.of(found, tracks).confirmed(maps, found.rig_from_world, 0.08)
    assert (count == expected).all()


def test_maps_of_all_images_count_and_only_where_they_show_the_point() -> None:
    found, tracks = scene()
    seen = (tracks.point_index > 4) | (tracks.frame_index == 1)
    columns = ("point_index", "frame_index", "camera_index", "pixels")
    tracks = replace(tracks, **{name: getattr(tracks, name)[seen] for name in columns})
    depth = {name: found.rig[name].cam_from_rig.apply(tracks.points)[0, 2] for name in ("west", "east")}
    maps = [plane(found, frame, name, depth[name]) for frame in ("00000", "00001") for name in ("west", "east")]
    count = Sightings.of(found, tracks).confirmed(maps, found.rig_from_world, 0.08)
    assert (count[:5] == 2).all()
    assert (count[5:] == 4).all()


def test_images_share_the_points_that_both_show() -> None:
    found, tracks = scene()
    sightings = Sightings.of(found, tracks)
    assert sightings.both(("00000", "west"), ("00001", "west")).tolist() == list(range(25))
    assert sightings.both(("00000", "west"), ("00001", "nobody")).size == 0


STEP = Rigid3.from_rotation_vector(np.array([0.01, -0.02, 0.03]), np.array([-1.1, 0.15, 0.05]))


def matched(
    folder: Path, monkeypatch: pytest.MonkeyPatch, found: Reconstruction, maps: list[DepthMap], left_share: float
) -> list[list[str]]:
    """The cameras that temporal stereo is measured of, frame by frame."""
    capture, asked = folder_capture(folder, diamond(), ("00000", "00001")), list[list[str]]()
    for frame, name in product(("00000", "00001"), diamond().rig.names):
        camera = diamond().rig[name].camera
        blank = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
        storage.write_image(image_path(capture, frame, name), blank)
    monkeypatch.setattr(stage, "measure_temporal", lambda _, now, after, *__: asked.append(sorted(now)) or ())
    options = TemporalOptions(left_share=left_share)
    stage.measure_temporal_depth(capture, found, maps, folder / "temporal", options, agreement_mm=0.08, least_maps=2)
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
