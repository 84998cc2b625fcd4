"""Cleaning removes what was added to a good surface, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from builders import joined, moved, sphere
from cuspid.fusion.cleaning import CleaningReport, boundaries, non_manifold_faces
from cuspid.fusion.cleaning import clean as clean_mesh
from cuspid.model.mesh import Mesh
from synthetic_scene import height_field

SHEET = height_field(lambda x, y: 5 + 0.2 * np.sin(x), half_width_mm=2.0, count=41)
DETAIL_MM = 0.012


def clean(mesh: Mesh) -> tuple[Mesh, CleaningReport]:
    return clean_mesh(mesh, DETAIL_MM)


def test_a_good_surface_is_left_alone() -> None:
    cleaned, report = clean(SHEET)
    assert len(cleaned.faces) == len(SHEET.faces)
    assert cleaned.face_areas.sum() == pytest.approx(SHEET.face_areas.sum())
    assert report.removed_pieces == report.removed_ghost_faces == report.removed_non_manifold_faces == 0
    assert report.split_vertices == 0
    assert report.holes == ()
    assert report.outer_boundary_mm == pytest.approx(16.0, rel=0.05)


def test_floating_pieces_go() -> None:
    crumb = moved(sphere(0.1, 3), (0, 0, -3))
    cleaned, report = clean(joined(SHEET, crumb))
    assert report.removed_pieces == 1
    assert report.removed_piece_faces == len(crumb.faces)
    assert len(cleaned.faces) == len(SHEET.faces)


def test_a_wall_behind_the_surface_goes() -> None:
    # The outside looks at -Z: what lies at a larger z is below the surface.
    ghost = moved(SHEET, (0, 0, 0.2))
    cleaned, report = clean(joined(SHEET, ghost))
    assert report.removed_ghost_faces > 0.9 * len(ghost.faces)
    assert len(SHEET.faces) <= len(cleaned.faces) < 1.02 * len(SHEET.faces)
    # The other side of a thin body is no ghost.
    back = Mesh(ghost.vertices, ghost.faces[:, ::-1])
    assert clean(joined(SHEET, back))[1].removed_ghost_faces == 0


def test_holes_are_measured() -> None:
    centre = np.linalg.norm(SHEET.face_centres[:, :2] - [0.5, 0.3], axis=1)
    corner = np.linalg.norm(SHEET.face_centres[:, :2] + [1.0, 1.0], axis=1)
    _, report = clean(SHEET.submesh((centre > 0.4) & (corner > 0.2)))
    large, small = report.holes
    assert large.area_mm2 == pytest.approx(np.pi * 0.16, rel=0.25)
    assert large.perimeter_mm == pytest.approx(2 * np.pi * 0.4, rel=0.35)
    assert 0 < small.area_mm2 < large.area_mm2


def test_a_closed_surface_has_no_boundary() -> None:
    assert boundaries(sphere(2.0, 3)) == (0.0, ())


def test_fins_are_cut_off() -> None:
    fin = Mesh(np.vstack([SHEET.vertices, [[0, 0, 3.0]]]), np.vstack([SHEET.faces, [[820, 821, 1681]]]))
    assert non_manifold_faces(fin).sum() >= 1
    cleaned, report = clean(fin)
    assert report.removed_non_manifold_faces >= 1
    check = trimesh.Trimesh(cleaned.vertices, cleaned.faces, process=False)
    assert len(trimesh.grouping.group_rows(check.edges_sorted, require_count=3)) == 0
    assert len(cleaned.faces) > len(SHEET.faces) - 5


def test_surfaces_that_touch_in_a_point_are_parted() -> None:
    other = moved(SHEET, (4.0, 4.0, 5.0))
    touching = joined(SHEET, other)
    last, first = len(SHEET.vertices) - 1, len(SHEET.vertices)
    faces = np.where(touching.faces == first, last, touching.faces)
    cleaned, report = clean(Mesh(touching.vertices, faces))
    assert report.split_vertices == 1
    assert len(cleaned.faces) == 2 * len(SHEET.faces)
    assert len(cleaned.vertices) == 2 * len(SHEET.vertices)


def test_pieces_are_counted_by_shared_edges() -> None:
    crumbs = [moved(sphere(0.1, 2), (0, 0, -3)), moved(sphere(0.12, 2), (0, 0, -5))]
    cleaned, report = clean(joined(SHEET, moved(SHEET, (0, 0, 2)), *crumbs))
    assert report.removed_pieces == 2
    assert report.removed_piece_faces == sum(len(crumb.faces) for crumb in crumbs)
    assert len(cleaned.faces) == 2 * len(SHEET.faces)


def test_colours_stay_with_their_vertices() -> None:
    colors = np.tile((SHEET.vertices[:, :1] * 50 + 120).astype(np.uint8), 3)
    half = joined(moved(sphere(0.1, 3), (0, 0, -3)), SHEET)
    black = np.zeros((len(half.vertices) - len(colors), 3), dtype=np.uint8)
    painted = Mesh(half.vertices, half.faces, np.vstack([black, colors]))
    cleaned, _ = clean(painted)
    assert cleaned.colors is not None
    assert np.array_equal(cleaned.colors[:, 0], (cleaned.vertices[:, 0] * 50 + 120).astype(np.uint8))


def test_nothing_stays_nothing() -> None:
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    cleaned, report = clean(empty)
    assert len(cleaned.faces) == 0
    assert report.holes == ()


@pytest.mark.long
@given(factor=st.floats(1e-3, 1e3), radius=st.floats(0.01, 0.3))
def test_a_surface_is_never_removed_whole_however_small(factor: float, radius: float) -> None:
    """What is small is so beside the rest. At any scale the same is removed."""
    alone = sphere(radius, 3)
    assert len(clean(alone)[0].faces) == len(alone.faces)
    both = joined(SHEET, moved(alone, (0, 0, -3)))
    scaled = Mesh(factor * both.vertices, both.faces)
    kept = len(clean_mesh(scaled, factor * DETAIL_MM)[0].faces)
    assert kept == len(clean(both)[0].faces)
    assert (kept == len(both.faces)) == (alone.face_areas.sum() >= (40 * DETAIL_MM) ** 2)
