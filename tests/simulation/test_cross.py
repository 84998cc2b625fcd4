"""A sweep across goes from one side of the arch to the other over what lies between, or says that nothing does."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import essential_four
from cuspid.handpiece.intra_oral import intra_oral_camera
from cuspid.model.arch_curve import ArchCurve, arch_curve
from cuspid.model.jaw import Jaw
from cuspid.model.room import Room, room_about
from cuspid.runtime.errors import InputError
from cuspid.simulation.path.cross import Crossing, plan_crossing
from cuspid.simulation.path.overlap import image_overlap
from cuspid.simulation.path.scan import ScanPath, ScanPathOptions, plan_scan_path
from cuspid.storage import write_path
from horseshoe import horseshoe, with_palate

HANDPIECE = essential_four()
SWEEP = ScanPathOptions(passes="turns", cross_sweep=True)


@pytest.fixture(scope="module")
def upper() -> Jaw:
    return with_palate(horseshoe(), 6.0)


@pytest.fixture(scope="module")
def curve(upper: Jaw) -> ArchCurve:
    return arch_curve(upper)


@pytest.fixture(scope="module")
def path(upper: Jaw) -> ScanPath:
    return plan_scan_path(upper, HANDPIECE, SWEEP, np.random.default_rng([0, 1]))


def crossing_of(jaw: Jaw, near_mm: float = 0.0) -> Crossing | None:
    return plan_crossing(jaw.mesh, Room(jaw.mesh, HANDPIECE.solid, 0.5), HANDPIECE, arch_curve(jaw), near_mm)


def apart(one: Rigid3, other: Rigid3) -> tuple[float, float]:
    """Distance of the origins in mm, and angle in degrees."""
    motion = one @ other.inverse()
    away = one.inverse().translation - other.inverse().translation
    return float(np.linalg.norm(away)), float(np.rad2deg(np.linalg.norm(motion.rotation_vector)))


@pytest.mark.parametrize("from_the_end", [False, True])
def test_it_begins_and_ends_as_a_pass_comes_by(upper: Jaw, curve: ArchCurve, from_the_end: bool) -> None:
    length = float(curve.lengths_mm[-1])
    crossing = crossing_of(upper, length if from_the_end else 0.0)
    assert (crossing.start_mm > crossing.end_mm) == from_the_end
    assert crossing.start_mm + crossing.end_mm == pytest.approx(length)
    assert min(crossing.start_mm, crossing.end_mm) < 0.2 * length
    for at, place in ((0.0, crossing.start_mm), (crossing.length_mm, crossing.end_mm)):
        away, angle = apart(crossing.pose_at(at), curve.rig_from_world(place))
        assert away < 1.5
        assert angle < 3


def test_it_follows_the_surface_without_jumps_and_keeps_clear(upper: Jaw) -> None:
    crossing = crossing_of(upper)
    poses = [crossing.pose_at(float(at)) for at in np.linspace(0, crossing.length_mm, 150)]
    heights = np.array([pose.inverse().translation[2] for pose in poses])
    assert heights[75] < heights[[0, -1]].min() - 3
    steps = np.array([apart(*pair) for pair in pairwise(poses)])
    assert steps[:, 0].max() < 1.0
    assert steps[:, 1].max() < 8
    room = Room(upper.mesh, HANDPIECE.solid, 0.5)
    assert min(room.clearance(pose)[0] for pose in crossing.rig_from_world) > 0.49
    seeing = np.isfinite(image_overlap(upper.mesh, HANDPIECE, poses[::5])).sum(axis=1)
    assert seeing.min() >= 2


def test_it_goes_as_far_back_as_there_is_surface(upper: Jaw) -> None:
    short = crossing_of(with_palate(horseshoe(), 6.0, back_mm=-5.0))
    whole = crossing_of(upper)
    assert short.start_mm > whole.start_mm + 5
    assert short.pose_at(short.length_mm / 2).inverse().translation[1] > -6


def test_a_single_camera_goes_across_too(upper: Jaw) -> None:
    camera = intra_oral_camera()
    crossing = plan_crossing(upper.mesh, room_about(upper.mesh, camera, 2.0), camera, arch_curve(upper), 0.0)
    assert crossing.length_mm > 0.8 * crossing_of(upper).length_mm


def test_where_nothing_lies_between_the_sides_there_is_none() -> None:
    assert crossing_of(horseshoe()) is None


@pytest.mark.long
def test_of_a_vault_too_deep_to_see_there_is_none_either() -> None:
    """Seen from where the handpiece fits between the teeth, its middle is out of focus."""
    deep = with_palate(horseshoe(), 6.0)
    wide = replace(HANDPIECE, depth_range_mm=(4.9, 5.1))
    room = Room(deep.mesh, HANDPIECE.solid, 3.0)
    assert plan_crossing(deep.mesh, room, wide, arch_curve(deep), 0.0) is None


@pytest.mark.long
def test_the_frames_of_the_sweep_are_the_last_and_overlap(upper: Jaw, path: ScanPath, tmp_path: Path) -> None:
    names = list(path.rig_from_world)
    assert 10 < len(path.cross_sweep) < len(names) / 2
    assert list(path.cross_sweep) == names[-len(path.cross_sweep) :]
    assert path.min_overlap >= 0.75
    write_path(tmp_path / "path.json", path.min_overlap, path.mean_overlap, path.seen, path.cross_sweep)
    assert json.loads((tmp_path / "path.json").read_text())["cross_sweep_frames"] == list(path.cross_sweep)
    room = Room(upper.mesh, HANDPIECE.solid, 0.5)
    assert min(room.clearance(pose)[0] for pose in path.rig_from_world.values()) >= 0.5


def test_the_hand_comes_from_the_passes_to_both_sides(path: ScanPath) -> None:
    """Its first and its last frame look at what frames of the pass look at, from about the same side."""
    swept = [path.rig_from_world[name] for name in path.cross_sweep]
    passes = [pose for name, pose in path.rig_from_world.items() if name not in path.cross_sweep]
    nearest = [min((apart(end, pose) for pose in passes), key=sum) for end in (swept[0], swept[-1])]
    assert np.array(nearest)[:, 0].max() < 2.0
    assert np.array(nearest)[:, 1].max() < 12
    assert apart(swept[0], swept[-1])[0] > 25


@pytest.mark.long
def test_a_jaw_without_it_is_scanned_all_the_same(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "cuspid")
    lower = horseshoe()
    path = plan_scan_path(lower, HANDPIECE, SWEEP, np.random.default_rng([0, 1]))
    without = plan_scan_path(lower, HANDPIECE, replace(SWEEP, cross_sweep=False), np.random.default_rng([0, 1]))
    assert path.cross_sweep == ()
    assert list(path.rig_from_world) == list(without.rig_from_world)
    assert sum("no sweep across" in record.message for record in caplog.records) == 1


@pytest.mark.parametrize("said", [{"tooth": 46}, {}])
def test_a_tooth_or_a_part_has_no_other_side(upper: Jaw, said: dict[str, int]) -> None:
    part = upper.mesh.face_centres[:, 0] > 8
    jaw = upper if said else replace(upper, mesh=upper.mesh.submesh(part), face_labels=upper.face_labels[part])
    with pytest.raises(InputError, match="a tooth or part of an arch; leave out --cross-sweep"):
        plan_scan_path(jaw, HANDPIECE, replace(SWEEP, **said), np.random.default_rng(0))
