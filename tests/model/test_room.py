"""The body of a handpiece keeps its distance from the surface itself, whether a scan is open or closed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from builders import any_pose, plate, sphere
from cuspid.geometry import Rigid3
from cuspid.handpiece.cad.holder import HolderOptions, with_holder
from cuspid.handpiece.designs import DESIGNS, DesignOptions, twelve_cameras
from cuspid.handpiece.family import LAYOUTS, Layout, Shape, build_handpiece
from cuspid.handpiece.presets import PRESETS
from cuspid.model.arch_curve import arch_curve
from cuspid.model.body import Body, Box, module
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.model.room import Room, check_clearance, room_about, surface_points
from cuspid.runtime.errors import InputError
from cuspid.simulation.path.detour import lifted_from_rig
from cuspid.simulation.path.scan import ScanPathOptions, plan_scan_path

CUBE = Body({"cube": Box(Rigid3.identity(), np.array([1.0, 1.0, 1.0]))})


def at(*place: float) -> Rigid3:
    """``rig_from_world`` of a handpiece at a place, not turned."""
    return Rigid3(np.eye(3), -np.array(place, dtype=float))


def test_the_distance_to_a_box_is_the_closed_form() -> None:
    points = np.array([[3.0, 0, 0], [2.0, 2.0, 0], [2.0, 2.0, 2.0], [0, 0, 0], [0.9, 0, 0]])
    distances, parts = CUBE.distances(points)
    np.testing.assert_allclose(distances, [2, np.sqrt(2), np.sqrt(3), -1, -0.1], atol=1e-12)
    assert set(parts) == {0}


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_distances_move_with_the_body(seed: int) -> None:
    move, points = any_pose(seed, 10.0), np.random.default_rng(seed).normal(0, 5, (50, 3))
    box = Box(any_pose(seed + 1, 3.0), np.array([0.5, 1.0, 2.0]))
    there = Body({"box": Box(box.box_from_rig @ move.inverse(), box.half_mm)})
    np.testing.assert_allclose(
        there.distances(move.apply(points))[0], Body({"box": box}).distances(points)[0], atol=1e-9
    )


def test_a_module_lies_behind_its_front() -> None:
    corners = module(Rigid3.identity(), (1.0, 2.0, 3.0)).corners
    np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [[-0.5, -1, -3], [0.5, 1, 0]], atol=1e-12)


def test_a_box_without_a_size_is_refused() -> None:
    with pytest.raises(InputError, match="must be positive"):
        Box(Rigid3.identity(), np.array([1.0, 0.0, 1.0]))


@pytest.mark.parametrize("height_mm", [1.2, 1.6, 3.0])
def test_the_clearance_over_a_plate_is_the_closed_form(height_mm: float) -> None:
    room = Room(plate(0.0, 20.0), CUBE, 0.5)
    distance, part = room.clearance(at(0, 0, height_mm))
    assert distance == pytest.approx(height_mm - 1, abs=0.02)
    assert part == "cube"
    turned = Rigid3(Rotation.from_euler("x", 45, degrees=True).as_matrix(), np.zeros(3)) @ at(0, 0, height_mm + 1)
    assert room.clearance(turned)[0] == pytest.approx(height_mm + 1 - np.sqrt(2), abs=0.04)


def test_a_long_handle_held_obliquely_takes_little_memory_and_is_exact() -> None:
    turn = Rotation.from_euler("x", 30, degrees=True).as_matrix()
    handle = Box(Rigid3(turn, turn @ np.array([0.0, -80.0, 0.0])), np.array([9.0, 90.0, 9.0]))
    room = Room(plate(0.0, 20.0), Body({"cube": CUBE.parts["cube"], "handle": handle}), 0.5)
    poses = [at(0, 0, height_mm) for height_mm in np.arange(0.3, 60.0, 1.7)]
    exact = [room.clearance(pose)[0] >= 0.5 for pose in poses]
    assert room.fits(Rigid3.identity(), poses).tolist() == exact
    assert 0 < np.count_nonzero(exact) < len(exact)
    assert room._solid.distances.nbytes < 50e6


@pytest.mark.parametrize("height_mm", [0.5, 1.3, 1.7, 2.4])
def test_what_fits_has_its_clearance(height_mm: float) -> None:
    """The grid of distances and the exact distance agree."""
    poses = [Rigid3.identity(), Rigid3(np.eye(3), np.array([0, 0, -0.3])), any_pose(1, 0.2)]
    room = Room(plate(0.0, 20.0), CUBE, 0.5)
    distances = np.array([room.clearance(pose @ at(0, 0, height_mm))[0] for pose in poses])
    for limit in (0.2, 0.5, 0.9):
        sure = np.abs(distances - limit) > 0.05
        fits = Room(plate(0.0, 20.0), CUBE, limit).fits(at(0, 0, height_mm), poses)
        np.testing.assert_array_equal(fits[sure], (distances >= limit)[sure])


def test_inside_a_closed_model_is_not_free_room() -> None:
    room = Room(sphere(10.0), CUBE, 0.5)
    assert room.clearance(at(0, 0, 0)) == (-np.inf, "cube")
    assert not room.fits(at(0, 0, 0), [Rigid3.identity()])[0]
    assert room.clearance(at(0, 0, 12.5))[0] == pytest.approx(1.5, abs=0.05)
    assert room.fits(at(0, 0, 12.5), [Rigid3.identity()])[0]


def test_behind_an_open_sheet_is_not_inside() -> None:
    """As under the border of the cheek's side of a scan, in front of the back of the tongue's side."""
    half = sphere(10.0)
    wall = half.submesh(half.face_centres[:, 0] > 2.0)
    assert Room(wall, CUBE, 0.5).clearance(at(-3, 0, 0))[0] > 0


@pytest.mark.parametrize("length_mm", [10.0, 45.0, 80.0])
@pytest.mark.parametrize("height_mm", [-5.0, -1.0, 0.3, 1.5, 3.0])
def test_opening_the_jaw_far_away_changes_no_verdict(coarse_phantom: Jaw, length_mm: float, height_mm: float) -> None:
    """The phantom is closed; cut off 25 mm from the handpiece, it is an open sheet with the same room."""
    mesh, body = coarse_phantom.mesh, twelve_cameras().solid
    pose = lifted_from_rig(height_mm) @ arch_curve(coarse_phantom).rig_from_world(length_mm)
    near = np.linalg.norm(mesh.face_centres - pose.inverse().translation, axis=1) < 25.0
    assert near.mean() < 0.7
    closed, opened = (Room(each, body, 0.5).clearance(pose) for each in (mesh, mesh.submesh(near)))
    assert (closed[0] < 0.5) == (opened[0] < 0.5)
    if closed[0] > 0:
        assert opened == closed


def test_the_verdicts_of_that_law_differ(coarse_phantom: Jaw) -> None:
    curve, room = arch_curve(coarse_phantom), Room(coarse_phantom.mesh, twelve_cameras().solid, 0.5)
    found = [room.clearance(lifted_from_rig(lift) @ curve.rig_from_world(45.0))[0] for lift in (-8.0, 0.0, 3.0)]
    assert found[0] < 0
    assert 0.5 < found[1] < found[2]


def test_the_part_that_touches_is_named() -> None:
    room = Room(plate(0.0, 20.0), CUBE, 0.5)
    check_clearance(room, {"00000": at(0, 0, 2.0)})
    with pytest.raises(
        InputError, match=r"at frame 00001 the cube .* comes within 0\.30 mm of the jaw, but must keep 0\.5"
    ):
        check_clearance(room, {"00000": at(0, 0, 2.0), "00001": at(0, 0, 1.3)})


def test_an_assumed_body_is_told(caplog: pytest.LogCaptureFixture) -> None:
    known = twelve_cameras()
    with caplog.at_level("INFO", logger="cuspid"):
        assert room_about(plate(0.0, 20.0), known, 0.5).body is known.body
        assert caplog.messages == []
        assumed = room_about(plate(0.0, 20.0), replace(known, body=None), 0.5).body
    (told,) = caplog.messages
    assert "a box of 1.0 x 1.0 x 1.6 mm is assumed behind each lens" in told
    assert set(assumed.names) < set(known.solid.names)


def test_points_on_a_coarse_surface_are_close_together() -> None:
    corners = np.array([[0, 0, 0], [5.0, 0, 0], [0, 4.0, 0], [0.1, 0.1, 0.05]])
    mesh = Mesh(corners, np.array([[0, 1, 2], [0, 1, 3]]))
    points = surface_points(mesh, 0.3)
    samples, _ = mesh.sample(2000, np.random.default_rng(0))
    gaps = np.linalg.norm(samples[:, None] - points[None], axis=2).min(axis=1)
    assert gaps.max() < 0.3
    np.testing.assert_allclose(mesh.closest(points)[0], 0, atol=1e-9)


def test_the_holder_carries_all_modules() -> None:
    handpiece = twelve_cameras()
    body = handpiece.solid
    assert {f"camera {name}" for name in handpiece.rig.names} <= set(body.names)
    assert {f"light {name}" for name in handpiece.lights} <= set(body.names)
    assert sum(name.startswith("plate") for name in body.names) == 3
    low, high = body.bounds
    assert high[1] - low[1] < 26
    assert high[2] - low[2] < 12


@pytest.mark.parametrize("wall_mm", [0.8, 5.4])
@pytest.mark.parametrize("layout", LAYOUTS, ids=str)
def test_the_holder_hides_nothing(layout: Layout, wall_mm: float) -> None:
    bare = build_handpiece(layout, Shape(), PRESETS["thesis"], (2.5, 9.0))
    body = with_holder(bare, HolderOptions(wall_mm=wall_mm)).solid
    looked_at = np.array(
        [each.cam_from_rig.inverse().apply(np.array([[0, 0, 5.0]]))[0] for each in bare.rig.cameras.values()]
    )
    eyes = np.array([each.centre_in_rig for each in bare.rig.cameras.values()])
    on_the_way = (eyes[:, None] + np.linspace(0.05, 1, 20)[None, :, None] * (looked_at - eyes)[:, None]).reshape(-1, 3)
    assert body.distances(on_the_way)[0].min() > 0


@pytest.mark.parametrize("name", DESIGNS)
def test_a_built_in_design_has_the_body_of_its_own_cameras(name: str) -> None:
    thick = DESIGNS[name](DesignOptions(holder=HolderOptions(wall_mm=3.0)))
    for handpiece in (DESIGNS[name](DesignOptions()), thick):
        assert handpiece.body is not None
        modules = {part.removeprefix("camera ") for part in handpiece.body.names if part.startswith("camera ")}
        assert modules == set(handpiece.rig.names)
    assert thick.solid.parts["plate 1"].half_mm[2] == 1.5


def test_the_holder_of_the_twelve_fits_on_the_path_of_their_cameras(coarse_phantom: Jaw) -> None:
    solid, curve = twelve_cameras(), arch_curve(coarse_phantom)
    room = Room(coarse_phantom.mesh, solid.solid, 0.5)
    assert min(room.clearance(curve.rig_from_world(at))[0] for at in np.linspace(0, curve.lengths_mm[-1], 40)) > 0.5
    found, bare = (
        plan_scan_path(coarse_phantom, each, ScanPathOptions(tooth=46), np.random.default_rng(0)).rig_from_world
        for each in (solid, replace(solid, body=None))
    )
    for name, pose in bare.items():
        np.testing.assert_array_equal(found[name].matrix, pose.matrix)
    assert found.keys() == bare.keys()
