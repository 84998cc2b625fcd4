from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh

from builders import any_pose, plate
from cuspid.anatomy.crowns import crowns_by_shape, crowns_of
from cuspid.anatomy.orientation import find_occlusal_frame
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.evaluation.deviation import evaluate
from cuspid.model.jaw import Arch, Jaw
from cuspid.model.mesh import Mesh
from cuspid.pipeline import scan as pipeline


@cache
def phantom(arch: Arch = "lower") -> Jaw:
    return build_phantom(PhantomOptions(arch=arch, edge_mm=0.6))


@cache
def estimate(arch: Arch = "lower") -> np.ndarray:
    return crowns_by_shape(phantom(arch).mesh)


def true_crowns(jaw: Jaw) -> np.ndarray:
    return crowns_of(jaw).faces


def overlap(mesh: Mesh, one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union, by area."""
    return float(mesh.face_areas[one & other].sum() / mesh.face_areas[one | other].sum())


@pytest.mark.long
def test_labels_tell_crowns_where_there_are_any():
    crowns = crowns_of(phantom())
    assert not crowns.estimated
    np.testing.assert_array_equal(crowns.faces, np.asarray(phantom().face_labels) > 0)
    assert crowns_of(replace(phantom(), face_labels=None)).estimated


@pytest.mark.long
@pytest.mark.parametrize("arch", ["lower", "upper"])
def test_crowns_of_a_phantom_are_found_by_shape(arch: Arch):
    assert overlap(phantom(arch).mesh, estimate(arch), true_crowns(phantom(arch))) > 0.9


@pytest.mark.long
def test_crowns_without_gum_are_crowns():
    crowns = true_crowns(phantom("upper"))
    alone = phantom("upper").mesh.submesh(crowns)
    assert alone.face_areas[crowns_by_shape(alone)].sum() > 0.85 * alone.face_areas.sum()


def test_a_part_of_a_jaw_is_enough():
    mesh, crowns = phantom().mesh, true_crowns(phantom())
    quadrant = mesh.face_centres[:, 0] > 0
    molar = mesh.centroid(phantom().tooth_faces(46))
    around = np.linalg.norm(mesh.face_centres - molar, axis=1) < 12
    for part in (quadrant, around):
        assert overlap(mesh.submesh(part), crowns_by_shape(mesh.submesh(part)), crowns[part]) > 0.9


@pytest.mark.long
def test_a_mirrored_jaw_has_the_mirrored_crowns():
    mesh = phantom().mesh
    mirrored = Mesh(mesh.vertices * [-1.0, 1, 1], mesh.faces[:, ::-1])
    assert overlap(mesh, crowns_by_shape(mirrored), estimate()) > 0.95


@pytest.mark.long
def test_a_finer_mesh_has_the_same_crowns():
    mesh = phantom().mesh
    finer = Mesh(*map(np.asarray, trimesh.remesh.subdivide(mesh.vertices, mesh.faces)))
    at = mesh.closest(finer.face_centres)[1]
    assert overlap(finer, crowns_by_shape(finer), estimate()[at]) > 0.93


def test_the_pose_of_a_jaw_does_not_matter():
    mesh = phantom().mesh
    moved = mesh.transformed(any_pose(3, 30.0))
    upright = moved.transformed(find_occlusal_frame(moved).occlusal_from_mesh)
    assert overlap(mesh, crowns_by_shape(upright), estimate()) > 0.93


@pytest.mark.long
def test_a_flat_plate_has_no_crowns():
    mesh = plate(0.0, 20.0)
    assert not crowns_by_shape(mesh).any()
    assert pipeline.crown_surface(Jaw(mesh=mesh)) is None
    assert find_occlusal_frame(mesh).notes


@pytest.mark.long
def test_without_labels_open_crown_is_an_estimate_and_nothing_is_said_tooth_by_tooth():
    jaw = phantom()
    named, unnamed = pipeline.crown_surface(jaw), pipeline.crown_surface(replace(jaw, face_labels=None))
    assert named is not None
    assert unnamed is not None
    assert not named.estimated
    assert unnamed.estimated
    assert overlap(jaw.mesh, unnamed.parts > 0, named.parts > 0) > 0.9
    scan = jaw.mesh.submesh(jaw.mesh.face_centres[:, 0] > 0)
    options = pipeline.EvaluationOptions(align=False, samples=20_000)
    for crown in (named, unnamed):
        found = evaluate(scan, jaw, options, crown=crown).crown
        assert found is not None
        assert found.completeness_pct["50"] > 95
        assert found.open_mm2 == pytest.approx(0.5 * jaw.mesh.face_areas[named.parts > 0].sum(), rel=0.15)
        assert (found.teeth == ()) == crown.estimated
        assert ("an estimate" in found.note) == crown.estimated


def test_teeth_of_which_nothing_was_seen_are_left_out():
    jaw = phantom()
    seen = jaw.tooth_faces(46) & (jaw.mesh.face_centres[:, 2] > -2)
    whole, part = pipeline.crown_surface(jaw), pipeline.crown_surface(jaw, seen=seen)
    assert whole is not None
    assert part is not None
    np.testing.assert_array_equal(part.parts, np.where(whole.parts == 46, 46, 0))
