"""The occlusal plane from the tips of crowns, of which the truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from scipy.spatial import KDTree

from cuspid.geometry import Rigid3
from cuspid.model.occlusal_plane import crown_tips, crown_tops, level_crowns, upright
from cuspid.stitching.height_map import HeightMap
from cuspid.stitching.levelling import level_by_crowns, tilt_surface
from strategies import vectors

CELL_MM = 0.2
TIPS = np.array([[26.0 * x, -40.0 * abs(x) ** 2.3 + 18.0] for x in np.linspace(-1, 1, 13)])
"""Of crowns 6-10 mm apart on an arch, at z = 0."""


def crowns(xy: np.ndarray) -> np.ndarray:
    """Heights of domes of 2.5 mm radius of curvature under the tips, that run out into gum 5 mm below."""
    return np.asarray(-5.0 * (1 - np.exp(-((from_tips(xy) / 2.8) ** 2))))


def from_tips(xy: np.ndarray) -> np.ndarray:
    """How far the nearest tip is."""
    return np.asarray(KDTree(TIPS).query(xy)[0])


def seen_from(world_from_new: Rigid3) -> HeightMap:
    """The crowns as a height map over a tilted plane, by bisection along its normal."""
    x, y = np.meshgrid(np.arange(-35, 35, CELL_MM), np.arange(-32, 30, CELL_MM))
    low, high = np.full(x.shape, -12.0), np.full(x.shape, 8.0)
    for _ in range(15):
        middle = (low + high) / 2
        places = world_from_new.apply(np.stack([x, y, middle], axis=-1))
        above = places[..., 2] > crowns(places[..., :2])
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    places = world_from_new.apply(np.stack([x, y, low], axis=-1))
    near = from_tips(places[..., :2]) < 5.0
    return HeightMap(corner=np.array([-35.0, -32.0]), cell_mm=CELL_MM, heights=low.astype(np.float32), known=near)


def known_places(surface: HeightMap) -> np.ndarray:
    return np.where(surface.known[..., None], surface.places, np.nan)


def tilt(degrees: float, towards_degrees: float) -> Rigid3:
    towards = np.deg2rad(towards_degrees)
    return Rigid3.from_rotation_vector(
        np.deg2rad(degrees) * np.array([np.cos(towards), np.sin(towards), 0]), np.zeros(3)
    )


def angle_degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.rad2deg(np.arccos(np.clip(a @ b, -1, 1))))


tilts = pytest.mark.parametrize("world_from_new", [tilt(*each) for each in [(0.5, 10), (2, 130), (3.5, 250), (5, 340)]])


@pytest.mark.long
@tilts
def test_a_tilted_surface_is_levelled(world_from_new: Rigid3):
    surface = seen_from(world_from_new)
    level = level_by_crowns(surface)
    # What is known before holds back less than an eighth.
    assert angle_degrees(level.rotation[2], world_from_new.rotation[2]) < 0.1 + world_from_new.angle_deg / 8
    assert np.all(level.translation == 0)
    unprejudiced = level_crowns(lambda turn: known_places(tilt_surface(surface, turn)), CELL_MM, 90.0)
    assert angle_degrees(unprejudiced.rotation[2], world_from_new.rotation[2]) < 0.15


@pytest.mark.long
@tilts
def test_a_turned_surface_lies_where_it_lay(world_from_new: Rigid3):
    tilted, upright_there = seen_from(world_from_new), seen_from(Rigid3.identity())
    back = tilt_surface(tilted, world_from_new)
    inside = back.known & (np.abs(back.places[..., :2]) < 28).all(axis=-1)
    off = back.heights - upright_there.interpolate(back.places[..., :2])
    assert inside.sum() > 10_000
    assert np.percentile(np.abs(off[inside]), 99) < 0.02
    assert np.abs(off[inside]).max() < 0.15
    assert np.abs(tilt_surface(tilted, Rigid3.identity()).heights - tilted.heights).max() < 1e-5


def test_what_is_not_known_stays_unknown_and_is_no_tip():
    surface = seen_from(Rigid3.identity())
    peak = np.linalg.norm(surface.places[..., :2] - [0, -20], axis=-1) < 2
    spoilt = HeightMap(
        corner=surface.corner,
        cell_mm=CELL_MM,
        heights=np.where(peak, 4.0, surface.heights).astype(np.float32),
        known=surface.known & ~peak,
    )
    assert angle_degrees(level_by_crowns(spoilt).rotation[2], np.array([0, 0, 1.0])) < 0.15
    assert not tilt_surface(spoilt, tilt(2, 30)).known_at(np.array([[[0.0, -20.0]]])).any()


def test_tips_are_the_highest_of_their_surroundings_and_lie_on_the_tops_of_crowns():
    surface = seen_from(Rigid3.identity())
    heights = np.where(surface.known, surface.heights, np.nan)
    tips, tops = crown_tips(heights, CELL_MM), crown_tops(heights, CELL_MM)
    assert np.all(tops[tips])
    places = surface.places[tips]
    nearest = np.linalg.norm(places[:, None, :2] - TIPS, axis=-1)
    assert nearest.min(axis=1).max() < 2 * CELL_MM
    assert len(set(nearest.argmin(axis=1))) >= 7
    assert np.nanmin(heights[tops]) > -3.01


@given(up=vectors(1.0))
def test_upright_takes_a_direction_to_z_the_short_way(up: np.ndarray):
    up[2] = abs(up[2])
    length = float(np.linalg.norm(up))
    if length < 1e-6:
        return
    turn = upright(up)
    assert turn.apply(up) == pytest.approx([0, 0, length], abs=1e-7 * length)
    assert turn.angle_deg == pytest.approx(angle_degrees(up / length, np.array([0, 0, 1.0])), abs=1e-3)


@pytest.mark.parametrize(("half_width_mm", "least", "most"), [(35.0, 0.85, 1.0), (3.0, 0.0, 0.05)])
def test_few_crowns_hardly_tilt(half_width_mm: float, least: float, most: float):
    tilted = seen_from(tilt(4, 90))
    known = tilted.known & (np.abs(tilted.places[..., 0]) < half_width_mm)
    part = replace(tilted, known=known)
    assert least <= level_by_crowns(part).angle_deg / 4 <= most


@pytest.mark.parametrize("cell_mm", [CELL_MM, 30.0])
def test_where_nothing_is_known_or_it_is_coarse_nothing_is_turned(cell_mm: float):
    flat = np.zeros((4, 5), np.float32)
    nowhere = HeightMap(corner=np.zeros(2), cell_mm=cell_mm, heights=flat, known=flat > 0)
    assert level_by_crowns(nowhere).angle_deg == 0
    assert level_by_crowns(replace(nowhere, known=flat == 0)).angle_deg < 1e-6
