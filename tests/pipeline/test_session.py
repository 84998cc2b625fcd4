"""A scan that grows frame by frame: always a pose and a surface, and in the end what a reconstruction gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, Frame
from cuspid.model.mesh import Mesh
from cuspid.motion.tracker import Tracker
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.session import Session, Step
from cuspid.runtime.errors import InputError, ReconstructionError
from hilly_film import FIXED, HILLS, WAY, scan, smooth, with_frame


def session_of(capture: Capture, folder: Path) -> Session:
    return Session(capture.handpiece, capture.source, folder, FIXED)


def followed(session: Session, frames: tuple[Frame, ...]) -> tuple[list[Step], dict[int, Mesh]]:
    """The steps, and all parts of the surface as they are at the end."""
    steps = [session.push(frame) for frame in frames]
    parts = dict[int, Mesh]()
    for step in steps:
        parts |= step.changed
    return steps, parts


def off_um(parts: Mapping[int, Mesh]) -> np.ndarray:
    """Distances of the surface from the hills."""
    return 1000 * HILLS.closest(np.concatenate([mesh.vertices for mesh in parts.values()]))[0]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, list[Step], dict[int, Mesh], Path]:
    folder = tmp_path_factory.mktemp("session")
    session = session_of(scan(), folder)
    return session, *followed(session, scan().frames), folder


@pytest.mark.long
def test_every_frame_has_a_pose_and_the_surface_grows(whole) -> None:
    session, steps, parts, _ = whole
    assert [step.frame for step in steps] == list(WAY)
    for step in steps:
        assert step.reason is None
        motion = step.rig_from_world @ WAY[step.frame].inverse()
        assert np.linalg.norm(motion.translation) < 0.02
        assert np.linalg.norm(motion.rotation_vector) < 0.006
    assert [bool(step.changed) for step in steps] == [True, False, True, False, True], "depth of every second frame"
    off = off_um(parts)
    assert 0.1 < np.median(off) < 15
    assert np.percentile(off, 95) < 60
    assert all(mesh.colors is not None and mesh.colors.std() > 5 for mesh in parts.values() if len(mesh.faces) > 50)
    assert set(session.rig_from_world) == set(WAY)


@pytest.mark.long
def test_at_its_end_a_session_is_a_reconstruction(whole, tmp_path: Path) -> None:
    """With the same figures to the last bit, from what was kept on the way."""
    session, _, _, folder = whole
    kept = {path: path.stat().st_mtime_ns for path in (folder / "motion" / "cache" / "features").rglob("*.npz")}
    found, mesh = session.finish()
    expected, expected_mesh = pipeline.reconstruct(scan(), tmp_path, FIXED)
    assert {name: pose.matrix.tobytes() for name, pose in found.rig_from_world.items()} == {
        name: pose.matrix.tobytes() for name, pose in expected.rig_from_world.items()
    }
    assert np.array_equal(mesh.vertices, expected_mesh.vertices)
    assert np.array_equal(mesh.faces, expected_mesh.faces)
    assert len(kept) == 20
    assert all(path.stat().st_mtime_ns == then for path, then in kept.items())


def test_black_frames_lose_nothing_that_was_there(tmp_path: Path) -> None:
    capture = with_frame(scan(), "00002", np.zeros((160, 160, 3), np.uint8))
    session = session_of(capture, tmp_path)
    steps, parts = followed(session, capture.frames)
    assert [step.rig_from_world is None for step in steps] == [False, False, True, False, False]
    assert "points seen in stereo" in steps[2].reason
    assert steps[2].changed == {}
    assert np.linalg.norm((steps[4].rig_from_world @ WAY["00004"].inverse()).translation) < 0.03
    assert np.percentile(off_um(parts), 95) < 60
    assert [frame.name for frame in session.frames] == list(WAY)


def test_a_frame_that_cannot_be_read_is_left_out_and_told_of(tmp_path: Path) -> None:
    capture = with_frame(scan(), "00001", np.zeros((100, 160, 3), np.uint8))
    session = session_of(capture, tmp_path)
    steps, _ = followed(session, capture.frames[:3])
    assert "but camera" in steps[1].reason
    assert [frame.name for frame in session.frames] == ["00000", "00002"]
    found, _ = session.finish()
    assert [each.what for each in found.dropped] == ["frame 00001"]


@pytest.mark.long
def test_a_correction_puts_the_surface_where_it_belongs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A frame that was placed 0.3 mm too far away shows its surface twice, until all poses are adjusted."""
    usual = Tracker.push

    def displaced(self, name, features):
        placed = usual(self, name, features)
        if name == "00002":
            aside = Rigid3(np.eye(3), np.array([0.0, 0.0, 0.3])) @ placed.rig_from_world
            self.rig_from_world[name] = aside
            return replace(placed, rig_from_world=aside)
        return placed

    monkeypatch.setattr(Tracker, "push", displaced)
    session = session_of(scan(), tmp_path)
    _, parts = followed(session, scan().frames)
    assert np.percentile(off_um(parts), 90) > 100
    changed = session.correct()
    assert changed
    assert np.percentile(off_um(parts | changed), 95) < 60
    assert session.correct() == {}
    assert np.linalg.norm((session.rig_from_world["00002"] @ WAY["00002"].inverse()).translation) < 0.01


@pytest.mark.long
def test_what_a_correction_cannot_place_is_taken_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    session = session_of(scan(), tmp_path)
    _, parts = followed(session, scan().frames)
    found = pipeline.find_poses(session.capture, tmp_path, FIXED)
    fewer = replace(found, rig_from_world={n: p for n, p in found.rig_from_world.items() if n < "00003"})
    monkeypatch.setattr(pipeline, "find_poses", lambda *_, **__: fewer)
    left = parts | session.correct()
    assert sum(len(mesh.faces) for mesh in left.values()) < 0.95 * sum(len(mesh.faces) for mesh in parts.values())
    assert list(session.rig_from_world) == list(WAY)[:3]


def test_plain_surfaces_are_refused_with_what_to_do(tmp_path: Path) -> None:
    capture = with_frame(scan(), "00000", smooth())
    session = Session(capture.handpiece, capture.source, tmp_path)
    with pytest.raises(InputError, match="run cuspid reconstruct when all images are there"):
        session.push(capture.frames[0])


def test_nothing_gives_no_reconstruction(tmp_path: Path) -> None:
    with pytest.raises(ReconstructionError, match="no frame has come in"):
        session_of(scan(), tmp_path).finish()
    lonely = replace(
        scan().handpiece, rig=replace(scan().handpiece.rig, cameras={"west": scan().handpiece.rig["west"]})
    )
    with pytest.raises(InputError, match="no two cameras"):
        Session(lonely, scan().source, tmp_path)
