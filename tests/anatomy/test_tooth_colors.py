"""Teeth of which each has a colour are labelled; other colours are refused at once."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh

from builders import any_pose
from cuspid.anatomy.jaw_files import load_landmarked_jaw
from cuspid.anatomy.tooth_colors import face_colors_of, number_regions, tooth_regions
from cuspid.model.jaw import GUM, Jaw
from cuspid.model.mesh import Mesh
from cuspid.runtime.errors import InputError
from horseshoe import horseshoe


@cache
def jaw() -> Jaw:
    return horseshoe(150, 40)


def labels() -> np.ndarray:
    found = jaw().face_labels
    assert found is not None
    return found


def painted(numbers: np.ndarray, gum: int = 255) -> np.ndarray:
    """White or grey gum and a colour for each tooth."""
    palette = np.random.default_rng(0).integers(0, 250, (50, 3)).astype(np.uint8)
    palette[GUM] = gum
    return palette[numbers]


def numbered(colors: np.ndarray, arch: str = "lower") -> np.ndarray | None:
    regions = tooth_regions(colors, jaw().mesh)
    assert regions is not None
    return number_regions(regions, jaw().mesh, "lower" if arch == "lower" else "upper")


@pytest.mark.parametrize("gum", [255, 125])
def test_colours_of_teeth_become_their_numbers(gum: int) -> None:
    np.testing.assert_array_equal(numbered(painted(labels(), gum)), labels())
    upper = numbered(painted(labels(), gum), "upper")
    assert upper is not None
    np.testing.assert_array_equal(upper[labels() == 41], 21)
    np.testing.assert_array_equal(upper[labels() == 37], 17)


def test_mixed_colours_on_the_borders_do_not_count() -> None:
    mesh = jaw().mesh
    of_vertices = np.full((len(mesh.vertices), 3), 125, dtype=np.uint8)
    of_vertices[mesh.faces.reshape(-1)] = np.repeat(painted(labels(), 125), 3, axis=0)
    rng = np.random.default_rng(0)
    mixed = rng.random(len(of_vertices)) < 0.03
    of_vertices[mixed] = rng.integers(0, 255, (mixed.sum(), 3))
    colors = face_colors_of(Mesh(mesh.vertices, mesh.faces, of_vertices), None)
    assert colors is not None
    found = numbered(colors)
    assert found is not None
    assert 0.9 < np.mean(found == labels()) < 1.0


def test_other_colours_are_no_teeth() -> None:
    mesh = jaw().mesh
    assert tooth_regions(np.full((len(mesh.faces), 3), 255, dtype=np.uint8), mesh) is None
    noise = np.random.default_rng(0).integers(0, 255, (len(mesh.faces), 3)).astype(np.uint8)
    assert tooth_regions(noise, mesh) is None
    assert numbered(painted(np.where(np.isin(labels(), (45, 44)), GUM, labels()))) is None


def saved(path: Path, colors: np.ndarray) -> Path:
    mesh = jaw().mesh.transformed(any_pose(1, 100))
    trimesh.Trimesh(mesh.vertices, mesh.faces, face_colors=colors, process=False).export(path)
    return path


def test_a_coloured_file_has_landmarks(tmp_path: Path) -> None:
    found, _ = load_landmarked_jaw(saved(tmp_path / "scan_lower.ply", painted(labels(), 125)))
    assert found.teeth == jaw().teeth
    assert "46.buccal_groove" in found.landmarks


@pytest.mark.parametrize(
    ("name", "missing", "said"),
    [
        ("scan", (), r"colours separate 14 teeth, but do not show whether they are lower or upper; give --arch$"),
        ("lower", (45, 44), r"colours separate 12 teeth, but these are not one row without a gap"),
        ("lower", range(30, 50), r"its colours are not those of gum and teeth, one each; give a landmark file"),
    ],
)
def test_what_cannot_be_used_is_refused(tmp_path: Path, name: str, missing: tuple[int, ...], said: str) -> None:
    colors = painted(np.where(np.isin(labels(), tuple(missing)), GUM, labels()))
    with pytest.raises(InputError, match=said):
        load_landmarked_jaw(saved(tmp_path / f"{name}.ply", colors))


def test_colours_of_no_teeth_are_refused_before_the_jaw_is_turned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cuspid.anatomy.jaw_files.find_occlusal_frame", None)
    noise = np.random.default_rng(0).integers(0, 255, (len(jaw().mesh.faces), 3)).astype(np.uint8)
    with pytest.raises(InputError, match="one each"):
        load_landmarked_jaw(saved(tmp_path / "lower.ply", noise))
