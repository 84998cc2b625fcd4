"""Faces that look inwards are turned, whatever the piece; a right mesh stays as it is."""

from pathlib import Path

import numpy as np
import pytest

from builders import any_pose, joined, moved, plate, sphere
from cuspid import storage
from cuspid.anatomy.jaw_files import load_jaw
from cuspid.cli import main
from cuspid.model.facing import facing_outwards
from cuspid.model.mesh import Mesh
from cuspid.pipeline import scan as pipeline
from horseshoe import horseshoe, with_palate, without_base

JAW = horseshoe(120, 40)
CLOSED, OPEN, PALATE = JAW.mesh, without_base(JAW.mesh), with_palate(JAW, 12.0).mesh
CROWNS = joined(*(moved(sphere(4.0, 3), (9.0 * k, 0, 0)) for k in range(5)))
SHEETS = {"closed": CLOSED, "open": OPEN, "with a palate": PALATE, "crowns": CROWNS}


def turned(mesh: Mesh, faces: np.ndarray) -> Mesh:
    return Mesh(mesh.vertices, np.where(faces[:, None], mesh.faces[:, ::-1], mesh.faces), mesh.colors)


@pytest.mark.parametrize("name", SHEETS)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_a_right_mesh_is_the_same(name: str, scale: float) -> None:
    mesh = Mesh(scale * SHEETS[name].vertices + 100 * scale, SHEETS[name].faces)
    assert facing_outwards(mesh) == (mesh, ())


@pytest.mark.parametrize("name", ["closed", "open", "crowns"])
@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_faces_that_look_inwards_are_turned(name: str, share: float) -> None:
    mesh = SHEETS[name]
    wrong = np.random.default_rng(0).random(len(mesh.faces)) < share
    found, notes = facing_outwards(turned(mesh, wrong))
    np.testing.assert_allclose(found.face_normals, mesh.face_normals, atol=1e-12)
    (note,) = notes
    assert ("all looked" if share == 1 else f"{wrong.sum()} of {len(wrong)}") in note


def test_each_piece_has_its_own_outside() -> None:
    third = np.arange(len(CROWNS.faces)) // (len(CROWNS.faces) // 5) == 2
    found, _ = facing_outwards(turned(CROWNS, third))
    np.testing.assert_allclose(found.face_normals, CROWNS.face_normals, atol=1e-12)


def test_where_there_is_no_outside_nothing_is_turned() -> None:
    """A plate, a dish that is seen from inside, a hollow in a solid."""
    x = plate(5.0, 20.0)
    dish = Mesh(x.vertices + [[0, 0, 1]] * (x.vertices[:, :2] ** 2).sum(axis=1, keepdims=True) / 60, x.faces)
    hollow = joined(sphere(10.0, 3), turned(sphere(6.0, 3), np.ones(20 * 4**3, dtype=bool)))
    for mesh in (x, dish, hollow):
        assert facing_outwards(mesh) == (mesh, ())


def test_a_band_with_one_side_is_told() -> None:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    across = np.stack([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], axis=1)
    middle = 10 * np.stack([np.cos(angle), np.sin(angle), np.zeros(40)], axis=1)
    k = np.arange(40)
    a, b = 2 * k, 2 * k + 1
    c, d = np.where(k < 39, 2 * k + 2, 1), np.where(k < 39, 2 * k + 3, 0)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    band = Mesh(np.stack([middle - 3 * across, middle + 3 * across], axis=1).reshape(-1, 3), faces)
    assert facing_outwards(band)[0] is band


@pytest.mark.long
@pytest.mark.parametrize("share", [0.5, 1.0])
@pytest.mark.parametrize("mesh", [CLOSED, OPEN])
def test_a_jaw_with_wrong_faces_is_loaded_as_the_right_one(tmp_path: Path, mesh: Mesh, share: float) -> None:
    """Inside-out jaws ended in a traceback, or came out teeth down."""
    wrong = np.random.default_rng(1).random(len(mesh.faces)) < share
    storage.write_mesh(tmp_path / "right.stl", mesh.transformed(any_pose(1, 50)))
    storage.write_mesh(tmp_path / "wrong.stl", turned(mesh.transformed(any_pose(1, 50)), wrong))
    (right, no_notes), (jaw, notes) = (load_jaw(tmp_path / name) for name in ("right.stl", "wrong.stl"))
    assert no_notes == ()
    assert "looked inwards" in notes[0]
    np.testing.assert_allclose(np.sort(jaw.mesh.vertices, axis=0), np.sort(right.mesh.vertices, axis=0), atol=0.3)
    reference = pipeline.load_reference(tmp_path / "wrong.stl")
    assert "looked inwards" in reference.notes[0]


def test_views_of_a_mesh_say_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    storage.write_mesh(tmp_path / "wrong.stl", turned(CLOSED, np.ones(len(CLOSED.faces), dtype=bool)))
    main(
        [
            "pano",
            "stitch",
            "--mesh",
            str(tmp_path / "wrong.stl"),
            "--view.mm-per-px",
            "0.5",
            "--out",
            str(tmp_path / "out"),
        ]
    )
    assert "all looked inwards" in " ".join(capsys.readouterr().err.split())
