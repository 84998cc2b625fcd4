"""Sizes tell the units of files that meet: what is refused, and what is told."""

from pathlib import Path

import pytest

from builders import any_pose
from cuspid import storage
from cuspid.cli import main
from cuspid.model.mesh import Mesh
from cuspid.pipeline import scan as pipeline
from cuspid.runtime.errors import InputError
from horseshoe import horseshoe, without_base

JAW = horseshoe(120, 40).mesh
TOOTH = JAW.submesh((JAW.face_centres[:, 1] > 8) & (abs(JAW.face_centres[:, 0]) < 4))


def scaled(mesh: Mesh, factor: float) -> Mesh:
    return Mesh(mesh.vertices * factor, mesh.faces)


def measured(mesh: Mesh, unit: storage.Unit = "mm", option: str = "--unit") -> storage.MeasuredFile:
    return storage.MeasuredFile(path=Path("mesh.ply"), mesh=mesh, unit=unit, option=option)


OTHERS = [("m", 1e-3), ("cm", 0.1), ("in", 1 / 25.4), ("um", 1e3)]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("unit", "factor"), OTHERS)
def test_of_two_sizes_the_unlikely_one_is_told_its_unit(unit: str, factor: float, seed: int) -> None:
    right = measured(JAW, option="--reference-unit")
    wrong = measured(scaled(JAW.transformed(any_pose(seed, 30)), factor))
    with pytest.raises(InputError, match=rf"give --unit {unit}$"):
        storage.require_one_unit(wrong, right)
    with pytest.raises(InputError, match=rf"give --unit {unit}$"):
        storage.require_one_unit(right, wrong)


@pytest.mark.parametrize(("unit", "factor"), OTHERS)
def test_a_right_file_read_in_a_wrong_unit_is_told_the_right_one(unit: storage.Unit, factor: float) -> None:
    with pytest.raises(InputError, match=r"give --unit mm$"):
        storage.require_one_unit(measured(scaled(JAW, 1 / factor), unit), measured(JAW, option="--reference-unit"))


@pytest.mark.parametrize(("unit", "factor"), [each for each in OTHERS if each[0] != "cm"])
def test_two_files_in_one_wrong_unit_are_told_it(unit: str, factor: float) -> None:
    small = measured(scaled(JAW, factor))
    with pytest.raises(InputError, match=rf"give --unit {unit}$"):
        storage.require_size(small)
    with pytest.raises(InputError, match=rf"give --unit {unit}$"):
        storage.require_one_unit(small, small)


@pytest.mark.parametrize("part", [JAW, TOOTH, without_base(JAW), JAW.submesh(JAW.face_centres[:, 0] > 0)])
@pytest.mark.parametrize("size", [0.7, 1.0, 1.4])
def test_a_part_of_a_jaw_may_meet_all_of_it(part: Mesh, size: float) -> None:
    one, other = measured(scaled(part, size)), measured(scaled(JAW, size))
    storage.require_one_unit(one, other)
    storage.require_one_unit(other, one)
    storage.require_size(one)


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    with pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    assert ended.value.code == 1
    (line,) = (each for each in capsys.readouterr().err.splitlines() if each.startswith("cuspid: "))
    return line


@pytest.mark.parametrize(("unit", "factor"), [("m", 1e-3), ("um", 1e3)])
def test_evaluate_compares_sizes_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], unit: str, factor: float
) -> None:
    right, wrong, out = tmp_path / "right.stl", tmp_path / "wrong.stl", tmp_path / "out"
    storage.write_mesh(right, JAW)
    storage.write_mesh(wrong, scaled(JAW, factor))
    assert f"give --unit {unit}" in refused(capsys, "evaluate", wrong, right, "--out", out)
    assert f"give --reference-unit {unit}" in refused(capsys, "evaluate", right, wrong, "--out", out)
    both = ("evaluate", wrong, right, "--unit", "m", "--out", out) if unit == "m" else ()
    if both:
        assert "--reference-unit mm" in refused(capsys, *both)
    assert f"give --unit {unit}" in refused(capsys, "pano", "stitch", "--mesh", wrong, "--out", out)
    assert not out.exists()


def test_each_file_has_its_own_unit(tmp_path: Path) -> None:
    storage.write_mesh(tmp_path / "metres.stl", scaled(JAW, 1e-3))
    storage.write_mesh(tmp_path / "inches.stl", scaled(JAW, 1 / 25.4))
    scan = storage.read_mesh(tmp_path / "metres.stl", "m")
    found = pipeline.load_reference(
        tmp_path / "inches.stl",
        unit="in",
        scan=storage.MeasuredFile(path=tmp_path / "metres.stl", mesh=scan, unit="m"),
    )
    assert found.jaw.mesh.bounds == pytest.approx(scan.bounds, abs=1e-4)


@pytest.mark.parametrize(("size_mm", "refused"), [(0.06, True), (1.5, False), (6.0, False)])
def test_a_small_simulated_scan_is_compared_with_its_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size_mm: float, refused: bool
) -> None:
    class Known:
        jaw = horseshoe(120, 40)

    def seen(*given: object) -> None:
        raise LookupError

    monkeypatch.setattr(storage, "read_truth", lambda path: Known)
    monkeypatch.setattr(pipeline, "reference_of", seen)
    part = measured(scaled(JAW, size_mm / 58.6))
    with pytest.raises(InputError if refused else LookupError):
        pipeline.load_reference(tmp_path, scan=part)
