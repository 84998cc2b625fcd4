"""Boxes in the place of crowns: of their sizes, right-angled, in one closed surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from cuspid.anatomy.shape.boxed import BoxOptions, box_crowns, crown_boxes
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError


@pytest.fixture(scope="module")
def result(coarse_phantom: Jaw) -> Jaw:
    return box_crowns(coarse_phantom)


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.long
def test_the_boxed_jaw_is_one_closed_surface(coarse_phantom: Jaw, result: Jaw) -> None:
    surface = solid(result.mesh)
    assert surface.is_watertight
    assert surface.is_winding_consistent
    assert surface.body_count == 1
    before = solid(coarse_phantom.mesh).volume
    assert 1.05 * before < surface.volume < 1.3 * before


def test_each_box_has_the_size_of_its_crown(coarse_phantom: Jaw, result: Jaw) -> None:
    for fdi, box in crown_boxes(coarse_phantom).items():
        crown = coarse_phantom.mesh.submesh(coarse_phantom.tooth_faces(fdi)).vertices @ box.axes
        made = result.mesh.submesh(result.tooth_faces(fdi)).vertices @ box.axes
        assert np.ptp(crown, axis=0) == pytest.approx(box.size_mm)
        inwards = np.stack([made.min(axis=0) - crown.min(axis=0), crown.max(axis=0) - made.max(axis=0)])
        # Along the arch the end of a box can lie within its neighbour's.
        assert np.all((inwards > -0.01) & (inwards < [0.3, 0.01, 0.01]))


def test_crowns_have_only_right_angles_left(coarse_phantom: Jaw, result: Jaw) -> None:
    for fdi, box in crown_boxes(coarse_phantom).items():
        faces = result.tooth_faces(fdi) & (result.mesh.face_areas > 1e-4)
        cosines = np.abs(result.mesh.face_normals[faces] @ box.axes)
        assert np.allclose(cosines.max(axis=1), 1, atol=1e-9)
        along = np.argmax(cosines, axis=1)
        assert set(along) == {0, 1, 2}
        assert np.allclose(box.axes.T @ box.axes, np.eye(3), atol=1e-12)
        assert np.linalg.det(box.axes) == pytest.approx(1)


def test_boxes_stand_as_the_teeth_do(coarse_phantom: Jaw) -> None:
    boxes = crown_boxes(coarse_phantom)
    for box in boxes.values():
        assert np.rad2deg(np.arccos(box.axes[2, 2])) < 25
    # A lower second molar is broader than an incisor, and the arch turns by about a right angle between them.
    assert boxes[37].size_mm[0] > 1.5 * boxes[31].size_mm[0]
    turn = np.rad2deg(np.arccos(abs(boxes[37].axes[:2, 0] @ boxes[31].axes[:2, 0])))
    assert 60 < turn < 95


def test_every_face_has_a_label_and_gum_stays(coarse_phantom: Jaw, result: Jaw) -> None:
    assert result.teeth == coarse_phantom.teeth
    assert result.arch == coarse_phantom.arch
    assert not result.landmarks
    gum = result.mesh.submesh(np.asarray(result.face_labels) == GUM)
    assert coarse_phantom.mesh.closest(gum.vertices)[0].max() < 0.01
    assert 0.5 < gum.face_areas.sum() / coarse_phantom.mesh.face_areas.sum() < 0.9


def test_sides_are_finely_divided(result: Jaw) -> None:
    corners = result.mesh.vertices[result.mesh.faces[np.asarray(result.face_labels) != GUM]]
    lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert 0.25 < np.median(lengths) < lengths.max() <= BoxOptions().edge_mm * np.sqrt(2) + 1e-6


def test_the_same_jaw_gives_the_same_boxes(coarse_phantom: Jaw, result: Jaw) -> None:
    again = box_crowns(coarse_phantom)
    assert np.array_equal(again.mesh.vertices, result.mesh.vertices)
    assert np.array_equal(again.mesh.faces, result.mesh.faces)
    assert np.array_equal(np.asarray(again.face_labels), np.asarray(result.face_labels))


def blocks(sizes: list[tuple[float, float, float]]) -> Jaw:
    """Upright boxes of known sizes in a row on a slab: 41, 42, 43."""
    slab = trimesh.creation.box((40, 20, 10))
    slab.apply_translation([0, 0, -5])
    parts = [slab]
    for number, size in enumerate(sizes):
        block = trimesh.creation.box(size)
        block.apply_translation([9 * (number - 1), 0, size[2] / 2 - 1])
        parts.append(block)
    joined = trimesh.boolean.union(parts, engine="manifold").subdivide_to_size(2.0)
    joined.merge_vertices()
    centres = joined.triangles_center
    labels = np.where(centres[:, 2] > 1e-6, 41 + np.rint(centres[:, 0] / 9).astype(int) + 1, GUM)
    return Jaw(mesh=Mesh(np.asarray(joined.vertices), np.asarray(joined.faces)), face_labels=labels, arch="lower")


def test_a_crown_that_is_a_box_stays_as_it_is() -> None:
    sizes = [(6.0, 7.0, 8.0), (5.0, 6.0, 9.0), (7.0, 6.0, 7.0)]
    jaw = blocks(sizes)
    for fdi, size in zip((41, 42, 43), sizes, strict=True):
        # A tooth of the row and of the arch may be seen from either end; one millimetre of it is in the slab.
        assert crown_boxes(jaw)[fdi].size_mm == pytest.approx(np.subtract(size, [0, 0, 1]), abs=0.15)
    made = box_crowns(jaw)
    assert solid(made.mesh).is_watertight
    assert solid(made.mesh).volume == pytest.approx(solid(jaw.mesh).volume, rel=0.02)


def test_a_gap_and_a_single_tooth_are_no_trouble(coarse_phantom: Jaw) -> None:
    labels = np.asarray(coarse_phantom.face_labels)
    for kept in (set(coarse_phantom.teeth) - {36}, {46}):
        made = box_crowns(replace(coarse_phantom, face_labels=np.where(np.isin(labels, list(kept)), labels, GUM)))
        assert set(made.teeth) == kept
        assert solid(made.mesh).is_watertight


def test_a_box_can_go_on_into_the_gum(coarse_phantom: Jaw, result: Jaw) -> None:
    deeper = box_crowns(coarse_phantom, BoxOptions(sink_mm=1.0, edge_mm=0.6))
    assert solid(deeper.mesh).volume > solid(result.mesh).volume
    assert len(deeper.mesh.faces) < len(result.mesh.faces)


def test_an_open_scan_is_closed_below(coarse_phantom: Jaw) -> None:
    scanned = coarse_phantom.mesh.face_centres[:, 2] > coarse_phantom.mesh.bounds[0, 2] + 3
    made = box_crowns(Jaw(mesh=coarse_phantom.mesh.submesh(scanned), face_labels=coarse_phantom.face_labels[scanned]))
    assert made.teeth == coarse_phantom.teeth
    assert solid(made.mesh).is_watertight


def test_what_cannot_be_boxed_is_refused(coarse_phantom: Jaw) -> None:
    with pytest.raises(InputError, match="no tooth labels"):
        box_crowns(replace(coarse_phantom, face_labels=None))
    with pytest.raises(InputError, match="no tooth labels"):
        box_crowns(replace(coarse_phantom, face_labels=np.zeros(len(coarse_phantom.mesh.faces), dtype=np.int64)))
    doubled = np.concatenate([coarse_phantom.mesh.faces, coarse_phantom.mesh.faces[:1, ::-1]])
    labels = np.concatenate([coarse_phantom.face_labels, [GUM]])
    with pytest.raises(InputError, match=r"boxed jaw: not a solid .* shared by more than two faces"):
        box_crowns(Jaw(mesh=Mesh(coarse_phantom.mesh.vertices, doubled), face_labels=labels))
    flipped = Mesh(coarse_phantom.mesh.vertices, coarse_phantom.mesh.faces[:, ::-1])
    with pytest.raises(InputError, match="inside out"):
        box_crowns(replace(coarse_phantom, mesh=flipped))
    with pytest.raises(InputError, match="edge-mm"):
        BoxOptions(edge_mm=0.0)
