from functools import cache
from pathlib import Path

import numpy as np
import pytest

from builders import any_pose, joined, moved, sphere
from cuspid import storage
from cuspid.anatomy.jaw_files import load_jaw
from cuspid.anatomy.orientation import _anterior_of_part, check_scale, find_occlusal_frame, require_one_jaw
from cuspid.model.jaw import Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from cuspid.storage import Unit
from horseshoe import horseshoe, without_base


@cache
def jaw() -> Jaw:
    return horseshoe()


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("closed", [True, False])
def test_the_frame_is_found_from_any_orientation(seed: int, closed: bool):
    mesh = jaw().mesh if closed else without_base(jaw().mesh)
    found = find_occlusal_frame(mesh.transformed(any_pose(seed, 300)))
    to_truth = found.occlusal_from_mesh @ any_pose(seed, 300)
    assert to_truth.angle_deg < 6
    assert found.notes == ()
    crowns = to_truth.apply(jaw().mesh.vertices)
    assert abs(crowns[:, 0].max() + crowns[:, 0].min()) < 4
    assert 0 < crowns[:, 2].max() < 2.5


@pytest.mark.long
def test_where_there_is_no_arch_the_frame_is_unsure():
    notes = find_occlusal_frame(sphere(25.0)).notes
    assert any("unsure" in note for note in notes)
    quadrant = jaw().mesh.submesh(jaw().mesh.face_centres[:, 0] > 8)
    assert any("anterior" in note for note in find_occlusal_frame(quadrant).notes)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_quadrant_with_its_base_lies_crowns_up_and_is_doubted(seed: int):
    quadrant = jaw().mesh.submesh(jaw().mesh.face_centres[:, 0] > 1)
    found = find_occlusal_frame(quadrant.transformed(any_pose(seed, 300)))
    up = (found.occlusal_from_mesh @ any_pose(seed, 300)).rotation[2, 2]
    assert np.degrees(np.arccos(up)) < 12
    assert any("which way is up" in note for note in found.notes)


@pytest.mark.long
def test_a_wide_jaw_that_no_whole_arch_fits_is_doubted_and_keeps_its_frame(monkeypatch: pytest.MonkeyPatch):
    """Of a cast without its molars, say, only the front is doubtful."""
    mesh = horseshoe(120, 40).mesh.transformed(any_pose(1, 300))
    sure = find_occlusal_frame(mesh)
    monkeypatch.setattr("cuspid.anatomy.orientation._ARCH_MISFIT_MM", 0.0)
    found = find_occlusal_frame(mesh)
    assert len(found.notes) == 1
    assert sure.notes == ()
    assert (found.occlusal_from_mesh @ sure.occlusal_from_mesh.inverse()).angle_deg < 1e-6


@pytest.mark.parametrize("side", [-1, 1])
def test_the_front_of_a_quadrant_is_where_its_crowns_are_narrow(side: int):
    """On either side of the jaw, and from any direction in the plane; its mirror image has its front where it has."""
    rng = np.random.default_rng(5)
    x = rng.uniform(0, 1, 4000)
    across, turn = np.stack([25 * x, -42 * x**2.3], 1), np.radians(rng.uniform(0, 360))
    tangent = np.stack([np.full(4000, 25.0), -42 * 2.3 * x**1.3], 1)
    aside = np.stack([-tangent[:, 1], tangent[:, 0]], 1) / np.linalg.norm(tangent, axis=1)[:, None]
    crowns = across + aside * rng.uniform(-4, 4, (4000, 1))
    edges = across + aside * rng.uniform(-4, 4, (4000, 1)) * x[:, None]
    kept = rng.uniform(0, 1, 4000) < x  # edges are counted: of narrow crowns there is less
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    front = _anterior_of_part(crowns * [side, 1] @ rotation.T, edges[kept] * [side, 1] @ rotation.T)
    off = np.degrees(np.arccos(front @ rotation[:, 1]))
    assert off < 12


def in_unit(mm_per_unit_read: float) -> Mesh:
    mesh = jaw().mesh.transformed(any_pose(0, 300))
    return Mesh(mesh.vertices * mm_per_unit_read, mesh.faces)


def test_a_jaw_in_millimetres_passes():
    assert check_scale(in_unit(1.0)) == ()


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "m"), (1 / 25.4, "in"), (0.1, "cm"), (1000.0, "um")])
def test_another_unit_is_recognised(factor: float, unit: str):
    with pytest.raises(InputError, match=rf"\d mm wide .--unit mm.; a jaw is 40-90 mm wide; give --unit {unit}$"):
        check_scale(in_unit(factor))


def test_a_wrong_unit_leads_back_to_the_right_one():
    unit: Unit = "m"
    with pytest.raises(InputError, match=r"--unit mm$"):
        check_scale(in_unit(1000.0), unit)


def test_an_unlikely_width_is_told_and_an_impossible_one_refused():
    (note,) = check_scale(in_unit(0.5))
    assert "a jaw is 40-90 mm wide" in note
    with pytest.raises(InputError, match="rescale it"):
        check_scale(in_unit(3.0))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("closed", [True, False])
def test_two_jaws_that_bite_are_named(tmp_path: Path, closed: bool, seed: int):
    lower = jaw().mesh if closed else without_base(jaw().mesh)
    upper = Mesh(lower.vertices * [-0.95, 1.0, -1.05] + [0, 2, 13], lower.faces)
    pair = joined(lower, upper).transformed(any_pose(seed, 100))
    with pytest.raises(InputError, match=r"two jaws that bite, \d\d mm high; export each"):
        require_one_jaw(pair)
    storage.write_mesh(tmp_path / "pair.stl", pair)
    with pytest.raises(InputError, match=r"pair\.stl: the mesh shows two jaws"):
        load_jaw(tmp_path / "pair.stl")


def test_a_jaw_of_several_pieces_is_one():
    lower = jaw().mesh
    base = Mesh(lower.vertices * [1.05, 1.05, 0.3] - [0, 0, 8], lower.faces)
    crowns = joined(*(moved(sphere(4.0, 2), (9.0 * k, 0, 0)) for k in range(5)))
    side_by_side = joined(lower, moved(lower, (70.0, 0, 0)))
    for mesh in (lower, joined(lower, base), crowns, side_by_side):
        require_one_jaw(mesh)
