"""A surface that grows frame by frame is the same as one that is made at once, and frames can be taken out again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cuspid.fusion.growing import GrowingSurface
from cuspid.fusion.meshing import extract
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from synthetic_scene import diamond, height_field, true_depth_map

HILLS = height_field(lambda x, y: 5 + 0.3 * np.sin(2 * x) * np.cos(1.7 * y))
DETAIL_MM = 0.012
POSES = [
    Rigid3.from_rotation_vector(np.array([0.02 * k, 0.03 * k, 0.1 * k]), np.array([0.5 * k - 0.5, 0.2, 0.0]))
    for k in range(3)
]
RED, BLUE = (200, 30, 30), (30, 30, 200)


def maps_of(k: int, color: tuple[int, int, int] = RED):
    rig = diamond(120).rig
    maps = [true_depth_map(HILLS, rig[name], POSES[k], f"{k:05d}", name) for name in ("west", "north")]
    return [replace(m, color=np.full((*m.depth_mm.shape, 3), color, dtype=np.uint8)) for m in maps]


def whole(surface: GrowingSurface) -> Mesh:
    return extract(surface._volume, surface._least_weight)


def corners(meshes: list[Mesh]) -> np.ndarray:
    """The corners of all triangles, in an order of their own."""
    each = np.concatenate([mesh.vertices[mesh.faces].reshape(-1, 9) for mesh in meshes])
    return each[np.lexsort(each.T)]


@pytest.mark.long
def test_parts_are_together_the_whole_whenever_they_are_asked_for() -> None:
    """Also where surfaces lie over each other, so that one changes the other beyond its own blocks."""
    surface, parts = GrowingSurface(DETAIL_MM), dict[int, Mesh]()
    for k, z_mm in ((0, 0.0), (1, 0.0), (2, 0.3), (0, -0.5), (1, 0.4)):
        surface.add(maps_of(k), POSES[k] @ Rigid3(np.eye(3), np.array([0.0, 0.0, z_mm])))
        news = surface.pop_changes()
        parts |= news
        assert news
        assert np.array_equal(corners([*parts.values()]), corners([whole(surface)]))
    assert len(parts) > 3
    assert surface.pop_changes() == {}


def test_only_what_changed_is_told() -> None:
    """Of a frame elsewhere."""
    surface, away = GrowingSurface(DETAIL_MM), Rigid3(np.eye(3), np.array([40.0, 0.0, 0.0]))
    surface.add(maps_of(0), POSES[0])
    before = surface.pop_changes()
    surface.add(maps_of(0), POSES[0] @ away)
    after = surface.pop_changes()
    assert len(after) > 3
    assert not before.keys() & after.keys()


@pytest.mark.long
@pytest.mark.parametrize("out", [0, 1, 2])
def test_what_is_taken_out_leaves_what_it_would_have_been_without(out: int) -> None:
    surface, never = GrowingSurface(DETAIL_MM), GrowingSurface(DETAIL_MM)
    for k in range(3):
        surface.add(maps_of(k, BLUE if k == out else RED), POSES[k])
        if k != out:
            never.add(maps_of(k), POSES[k])
    surface.take_out(maps_of(out, BLUE), POSES[out])
    mesh, expected = whole(surface), whole(never)
    assert len(mesh.faces) == len(expected.faces)
    assert expected.closest(mesh.vertices[np.unique(mesh.faces)])[0].max() < 1e-5
    assert all(part.colors is not None and (part.colors == RED).all() for part in surface.pop_changes().values())


def test_nothing_is_left_of_what_was_alone() -> None:
    surface = GrowingSurface(DETAIL_MM)
    surface.add(maps_of(0), POSES[0])
    there = surface.pop_changes()
    surface.take_out(maps_of(0), POSES[0])
    assert surface.pop_changes().keys() == there.keys()
    assert not len(whole(surface).faces)
    assert len(surface.hole_rims()) == 0


def test_a_moved_frame_moves_its_surface() -> None:
    """Taken out and put back 0.2 mm higher."""
    surface, higher = GrowingSurface(DETAIL_MM), Rigid3(np.eye(3), np.array([0.0, 0.0, 0.2]))
    surface.add(maps_of(0), POSES[0])
    surface.take_out(maps_of(0), POSES[0])
    surface.add(maps_of(0), POSES[0] @ higher.inverse())
    vertices = whole(surface).vertices
    distance = HILLS.closest(vertices - [0.0, 0.0, 0.2])[0]
    assert 0 < np.percentile(distance, 99) < 0.02


def test_colours_are_those_of_the_maps() -> None:
    surface = GrowingSurface(DETAIL_MM)
    surface.add(maps_of(0, RED), POSES[0])
    surface.add(maps_of(0, BLUE), POSES[0])
    colors = np.concatenate([part.colors for part in surface.pop_changes().values() if part.colors is not None])
    mixed = np.mean([RED, BLUE], axis=0)
    assert (np.abs(colors - mixed) <= 1).all(axis=1).mean() > 0.99


def test_holes_have_rims() -> None:
    maps = maps_of(0)
    for each in maps:
        height, width = each.depth_mm.shape
        each.depth_mm.flags.writeable = True
        each.depth_mm[height // 2 - 8 : height // 2 + 8, width // 2 - 8 : width // 2 + 8] = np.nan
    surface = GrowingSurface(DETAIL_MM)
    surface.add(maps[:1], POSES[0])
    rims = surface.hole_rims()
    assert len(rims) > 20
    assert np.ptp(rims, axis=0)[:2].max() < 2.5
