"""A path that a hand would take: around what is in the way, over parts of an arch, and again over what was not seen."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest

from builders import any_pose, sphere
from cuspid.evaluation.crown import open_parts
from cuspid.handpiece.designs import twelve_cameras
from cuspid.model.arch_curve import ArchCurve, arch_curve
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.room import Room
from cuspid.model.visibility import VisibilityOptions, scannable_faces, visible_counts
from cuspid.simulation.path.coverage import CrownPoints, crown_points
from cuspid.simulation.path.detour import _APART, _UNITS, _motion, _shortest, plan_detour
from cuspid.simulation.path.further import _interleave_legs, _largest_sum, _Trial, further_legs, points_seen_from
from cuspid.simulation.path.legs import Leg, steady_path
from cuspid.simulation.path.overlap import frame_overlap
from cuspid.simulation.path.scan import ScanPathOptions, _needs_further_passes, plan_scan_path

HANDPIECE = twelve_cameras()


@pytest.fixture(scope="module")
def curve(coarse_phantom: Jaw) -> ArchCurve:
    return arch_curve(coarse_phantom)


@pytest.fixture(scope="module")
def crowns(coarse_phantom: Jaw, curve: ArchCurve) -> CrownPoints:
    return crown_points(coarse_phantom, curve, 9.0)


def part_of(jaw: Jaw, teeth: tuple[int, ...]) -> Jaw:
    """Some teeth with 3 mm of what is around them."""
    wanted = np.isin(jaw.face_labels, teeth)
    gap, _, _ = jaw.mesh.submesh(wanted).closest(jaw.mesh.face_centres)
    kept = wanted | ((jaw.face_labels == GUM) & (gap < 3.0))
    return Jaw(mesh=jaw.mesh.submesh(kept), face_labels=jaw.face_labels[kept], arch=jaw.arch)


# --- around what is in the way ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("anchored", list(product((False, True), repeat=2)))
def test_the_chain_is_the_cheapest_of_all(anchored: tuple[bool, bool]) -> None:
    rng = np.random.default_rng(4)
    stations = [(rng.normal(0, 1, (4, 6)) * _UNITS, rng.uniform(0, 3, 4)) for _ in range(4)]

    def cost(choice: tuple[int, ...]) -> float:
        rows = [station[0][index] for station, index in zip(stations, choice, strict=True)]
        rows = [np.zeros(6)] * anchored[0] + rows + [np.zeros(6)] * anchored[1]
        steps = sum(np.sum(((b - a) / _UNITS) ** 2) for a, b in pairwise(rows))
        return _APART * steps + sum(station[1][index] for station, index in zip(stations, choice, strict=True))

    best = min(product(range(4), repeat=4), key=cost)
    expected = [station[0][index] for station, index in zip(stations, best, strict=True)]
    np.testing.assert_array_equal(_shortest(stations, anchored), expected)


def test_a_path_that_fits_is_left_alone(coarse_phantom: Jaw, curve: ArchCurve, crowns: CrownPoints) -> None:
    room = Room(coarse_phantom.mesh, HANDPIECE.solid, 0.5)
    detour = plan_detour(room, crowns, HANDPIECE, curve.rig_from_world, (5.0, 40.0))
    assert not detour.changes.any()


def test_a_path_around_an_obstacle_fits_and_still_sees(
    coarse_phantom: Jaw, curve: ArchCurve, crowns: CrownPoints
) -> None:
    """The handpiece is to keep more room than there is."""
    room, span = Room(coarse_phantom.mesh, HANDPIECE.solid, 4.3), (24.0, 36.0)
    detour = plan_detour(room, crowns, HANDPIECE, curve.rig_from_world, span)
    poses = [detour.changed_from_rig(float(at)) @ curve.rig_from_world(float(at)) for at in detour.travel_mm]
    steady = [curve.rig_from_world(float(at)) for at in detour.travel_mm]
    assert min(room.clearance(pose)[0] for pose in steady) < 4.2
    assert min(room.clearance(pose)[0] for pose in poses) > 4.25
    steps = np.abs(np.diff(detour.changes, axis=0)) / _UNITS
    assert steps.max() <= 1.7
    middle = crowns.within(np.array([pose.inverse().translation for pose in steady[3:-3]]), 5.0)
    seen = points_seen_from(crowns, HANDPIECE, poses).any(axis=0)[middle].mean()
    assert seen > 0.8


# --- parts ------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    "teeth",
    [(41, 42, 43, 44, 45, 46, 47), (43, 42, 41, 31, 32, 33), (46,), (45,), (31,), (34, 35, 36), (44, 42, 31)],
    ids=str,
)
def test_parts_of_an_arch_are_scanned(coarse_phantom: Jaw, teeth: tuple[int, ...]) -> None:
    part = part_of(coarse_phantom, teeth)
    path = plan_scan_path(part, HANDPIECE, ScanPathOptions(passes="turns"), np.random.default_rng(0))
    assert 9 <= len(path.rig_from_world) <= 210
    counts = visible_counts(part.mesh, HANDPIECE, path.rig_from_world.values(), VisibilityOptions())
    up = part.mesh.face_normals[:, 2] > 0.5
    for tooth in teeth:
        top = part.tooth_faces(tooth) & up
        areas = part.mesh.face_areas
        assert areas[top & (counts >= 2)].sum() / areas[top].sum() > 0.8, tooth


def test_the_curve_runs_over_any_four_teeth_in_a_row(coarse_phantom: Jaw) -> None:
    """They are nearly as wide as long, so that a circle through them may have its centre among them."""
    row = (*range(37, 30, -1), *range(41, 48))
    for first in range(len(row) - 3):
        part = part_of(coarse_phantom, row[first : first + 4])
        curve = arch_curve(part)
        spans = [curve.span_of(part.mesh.face_centres[part.tooth_faces(tooth)]) for tooth in row[first : first + 4]]
        middles = [(low + high) / 2 for low, high in spans]
        assert all(high - low > 3 for low, high in spans), spans
        assert all(after - before > 3 for before, after in pairwise(middles)), spans


def test_the_cheek_is_on_the_outside_of_a_quadrant(coarse_phantom: Jaw) -> None:
    part = part_of(coarse_phantom, (44, 45, 46, 47))
    whole, curve = arch_curve(coarse_phantom), arch_curve(part)
    cheek = curve.rig_from_world(curve.lengths_mm[-1] / 2).inverse().rotation[:, 1]
    middle = curve.place(curve.lengths_mm[-1] / 2)
    outwards = middle[:2] - whole.points[:, :2].mean(axis=0)
    assert cheek[:2] @ outwards / np.linalg.norm(outwards) > 0.7


# --- again over what was not seen -------------------------------------------------------------------------------------


def test_the_quick_look_agrees_with_rays(coarse_phantom: Jaw, curve: ArchCurve, crowns: CrownPoints) -> None:
    poses = [curve.rig_from_world(at) for at in np.linspace(30, 60, 12)]
    among = coarse_phantom.face_labels != GUM
    counts = visible_counts(coarse_phantom.mesh, HANDPIECE, poses, VisibilityOptions(), among)
    assert not counts[~among].any()
    _, faces, _ = coarse_phantom.mesh.closest(crowns.points)
    quick, exact = points_seen_from(crowns, HANDPIECE, poses).any(axis=0), counts[faces] >= 2
    assert 0.2 < exact.mean() < 0.8
    assert (quick == exact).mean() > 0.95


def test_undercuts_are_open_as_comparisons_count_them(curve: ArchCurve) -> None:
    """A ball is seen from a share (90 - b) / 180 of the directions above it where it faces down by b: 5 % at 81 deg."""
    ball = sphere(8.0)
    points = crown_points(Jaw(mesh=ball, face_labels=np.full(len(ball.faces), 46), arch="lower"), curve, 9.0)
    lowest = np.sin(np.deg2rad(-81.0))
    assert points.normals[:, 2].min() == pytest.approx(lowest, abs=0.02)
    assert len(points.points) / (ball.face_areas.sum() / 0.7) == pytest.approx((1 - lowest) / 2, abs=0.015)


def test_the_largest_sum_is_that_of_all_stretches() -> None:
    for seed in range(20):
        values = np.random.default_rng(seed).normal(-0.2, 1, 12)
        sums = {(i, j): values[i : j + 1].sum() for i in range(12) for j in range(i, 12)}
        first, last = _largest_sum(values)
        assert values[first : last + 1].sum() == pytest.approx(max(sums.values()))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_steep_pass_goes_only_where_one_between_ties_it(sign: int) -> None:
    rng = np.random.default_rng(7)
    seen, unseen = rng.random((81, 300)) < 0.1, np.ones(300, bool)
    lengths = np.linspace(0.0, 80.0, 81)
    steep, lower = _Trial(sign * 90.0, lengths, seen), _Trial(sign * 60.0, lengths, seen)
    beside, aside, again = (Leg(roll_deg=sign * roll, start_mm=50.0, end_mm=22.0) for roll in (45.0, -45.0, 90.0))
    for legs in ([], [aside], [again]):
        assert steep.best_stretch(unseen, legs)[2] < 0
        assert lower.best_stretch(unseen, legs) == lower.best_stretch(unseen, [])
    start, end, net = steep.best_stretch(unseen, [aside, beside])
    assert 22 <= start < end <= 50
    assert 0 < net < lower.best_stretch(unseen, [])[2]


def test_further_passes_are_gone_through_on_the_way_without_jumps() -> None:
    base = (Leg(roll_deg=0.0, start_mm=0.0, end_mm=100.0),)
    wanted = ((30.0, 20.0, 40.0), (-30.0, 25.0, 45.0), (45.0, 85.0, 99.0))
    further = [Leg(roll_deg=roll, start_mm=low, end_mm=high) for roll, low, high in wanted]
    legs = list(_interleave_legs(base, further))
    assert sum(leg.length_mm for leg in legs if leg.roll_deg == 0) == pytest.approx(100)
    assert sorted(leg.roll_deg for leg in legs if leg.roll_deg) == [-30, 30, 45]
    rolls = [leg.roll_deg for leg in legs]
    assert rolls.index(30) < rolls.index(45)
    assert rolls[0] == 0
    assert legs[0].end_mm == 45.0
    gaps = [abs(b.start_mm - a.end_mm) for a, b in pairwise(legs)]
    assert max(gaps) <= 25


def test_further_passes_see_more_and_never_less(coarse_phantom: Jaw, curve: ArchCurve, crowns: CrownPoints) -> None:
    room = Room(coarse_phantom.mesh, HANDPIECE.solid, 0.5)
    first = steady_path(
        coarse_phantom.mesh, curve, (Leg(roll_deg=0.0, start_mm=0.0, end_mm=float(curve.lengths_mm[-1])),)
    )
    further = further_legs(coarse_phantom.mesh, room, crowns, HANDPIECE, first)
    assert len(further.legs) > 1
    assert further.legs[0].roll_deg == 0
    before, after = (
        points_seen_from(
            crowns, HANDPIECE, [path.rig_from_world(float(at)) for at in np.arange(*path.span_mm, 1.5)]
        ).any(axis=0)
        for path in (first, further)
    )
    assert after.mean() > before.mean() + 0.005
    assert (before & ~after).mean() < 0.01


@pytest.mark.parametrize(
    ("said", "again"),
    [
        ({}, True),
        ({"passes": "turns"}, False),
        ({"turns": 3}, False),
        ({"frames": 50}, False),
        ({"length_mm": 30.0}, False),
        ({"tooth": 46}, False),
        ({"tooth": 46, "passes": "auto"}, True),
    ],
)
def test_a_whole_arch_of_which_nothing_is_said_is_gone_over_again(curve: ArchCurve, said: dict, again: bool) -> None:
    assert _needs_further_passes(ScanPathOptions(**said), curve) == again


def test_a_part_is_not(coarse_phantom: Jaw) -> None:
    part = arch_curve(part_of(coarse_phantom, (44, 45, 46, 47)))
    assert not _needs_further_passes(ScanPathOptions(), part)
    assert _needs_further_passes(ScanPathOptions(passes="auto"), part)


def test_the_plan_tells_the_share_of_the_open_crowns_that_a_comparison_counts(coarse_phantom: Jaw) -> None:
    teeth = (44, 45, 46, 47)
    kept = np.isin(coarse_phantom.face_labels, teeth)
    jaw = Jaw(mesh=coarse_phantom.mesh.submesh(kept), face_labels=coarse_phantom.face_labels[kept], arch="lower")
    path = plan_scan_path(jaw, HANDPIECE, ScanPathOptions(passes="auto"), np.random.default_rng(0))
    areas = np.where(open_parts(jaw.mesh, jaw.face_labels) != GUM, jaw.mesh.face_areas, 0.0)
    scannable = scannable_faces(jaw.mesh, HANDPIECE, path.rig_from_world.values(), VisibilityOptions())
    share = areas[scannable].sum() / areas.sum()
    assert path.seen[GUM] == pytest.approx(share, abs=0.015)
    assert share > 0.97


def test_a_path_with_further_passes_overlaps_and_fits(coarse_phantom: Jaw) -> None:
    options = ScanPathOptions(tooth=31, passes="auto", length_mm=20.0)
    alone = plan_scan_path(coarse_phantom, HANDPIECE, replace(options, passes="turns"), np.random.default_rng(0))
    path = plan_scan_path(coarse_phantom, HANDPIECE, options, np.random.default_rng(0))
    room = Room(coarse_phantom.mesh, HANDPIECE.solid, 0.5)
    assert min(room.clearance(pose)[0] for pose in path.rig_from_world.values()) >= 0.5
    assert path.min_overlap > 0.7
    assert path.seen[31] >= alone.seen[31] - 0.01


def test_frames_are_evaluated_by_all_their_cameras() -> None:
    overlap = np.array([[0.8, 0.6], [np.nan, 0.9], [np.nan, np.nan]])
    np.testing.assert_allclose(frame_overlap(overlap), [0.7, 0.95, 1.0])


def test_a_detour_is_about_what_is_looked_at() -> None:
    """A turn leaves the place below the handpiece where it is; a shift moves that along the axes of the handpiece."""
    pose = any_pose(3, 20.0)
    place = pose.inverse().translation
    turned = _motion(np.array([0, 0, 0, *np.deg2rad([10.0, -20, 5])])) @ pose
    np.testing.assert_allclose(turned.apply(place[None]), 0, atol=1e-12)
    turn = turned.rotation @ pose.rotation.T
    assert np.rad2deg(np.arccos((np.trace(turn) - 1) / 2)) == pytest.approx(np.linalg.norm([10, 20, 5]))
    shifted = _motion(np.array([0.1, 0.5, 2.0, 0, 0, 0])) @ pose
    np.testing.assert_allclose(pose.apply(shifted.inverse().translation[None])[0], [0.1, 0.5, 2.0], atol=1e-12)
