"""The command line as a user meets it: what bad input gets, and that each verb is documented."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from builders import box_mesh, handpiece, image_path, make_capture, shifted, sphere
from cuspid import __version__, cli, storage
from cuspid.cli.scan import _evaluate_trajectory, reconstruct_capture
from cuspid.cli.shared import Probe, load_probe, suit_lights
from cuspid.geometry import Rigid3
from cuspid.model.mesh import Mesh
from cuspid.pipeline.scan import ReconstructionOptions
from cuspid.runtime.errors import InputError, ReconstructionError
from report_folders import known_trueness
from verbs import refused, run


def test_what_is_no_jaw_is_refused_and_nothing_is_written(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "empty.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    out = tmp_path / "scan"
    assert "not a mesh file" in refused(capsys, "run", tmp_path / "notes.txt", "--out", out)
    assert "empty.ply" in refused(capsys, "run", tmp_path / "empty.ply", "--out", out)
    assert "no such file" in refused(capsys, "run", tmp_path / "missing.stl", "--out", out)
    assert not out.exists()


@pytest.mark.parametrize("unit", ["m", "in", "um"])
def test_a_mesh_in_another_unit_is_told_its_unit(tmp_path, capsys, unit):
    box = box_mesh()
    storage.write_mesh(tmp_path / "jaw.stl", Mesh(box.vertices / storage.MM_PER_UNIT[unit], box.faces))
    message = refused(capsys, "run", tmp_path / "jaw.stl", "--out", tmp_path / "scan")
    assert f"--unit {unit}" in message
    assert "40-90 mm" in message
    assert not (tmp_path / "scan").exists()


def test_a_tooth_that_is_not_there(tmp_path, capsys, coarse_phantom):
    storage.write_jaw(tmp_path / "jaw.ply", coarse_phantom)
    message = refused(capsys, "simulate", tmp_path / "jaw.ply", "--tooth", 16, "--out", tmp_path / "scan")
    assert "no tooth 16" in message
    assert not (tmp_path / "scan").exists()


@pytest.mark.long
@pytest.mark.parametrize("existed", [False, True])
def test_without_blender_nothing_is_written(tmp_path, capsys, monkeypatch, coarse_phantom, existed):
    monkeypatch.delenv("CUSPID_BLENDER_PYTHON", raising=False)
    storage.write_jaw(tmp_path / "jaw.ply", coarse_phantom)
    out = tmp_path / "scan"
    if existed:
        out.mkdir()
    for verb in (["simulate"], ["pano", "film"]):
        assert "Blender" in refused(capsys, *verb, tmp_path / "jaw.ply", "--renderer", "blender", "--out", out)
        assert out.exists() == existed
        assert not existed or not any(out.iterdir())


def test_plain_enamel_has_crossed_polarisers_unless_others_are_asked_for(capsys):
    def glare(probe, texture):
        return {light.glare for light in load_probe(suit_lights(probe, texture)).lights.values()}

    assert max(glare(Probe(), "enamel")) < 0.1
    assert "--lights white" in " ".join(capsys.readouterr().err.split())
    assert glare(Probe(), "artificial") == glare(Probe(lights="white"), "enamel") == {1.0}
    assert max(glare(Probe(lights="colour-coded"), "artificial")) < 0.1
    assert suit_lights(Probe(handpiece=Path("mine.json")), "enamel") == Probe(handpiece=Path("mine.json"))
    assert not capsys.readouterr().err


def test_images_are_scaled_and_none_is_too_small() -> None:
    cameras = load_probe(Probe(design="four", scale=0.3)).rig.cameras.values()
    assert {(each.camera.width, each.camera.height) for each in cameras} == {(150, 150)}
    with pytest.raises(InputError, match=r"--scale 0\.02 leaves images of 10 x 10 px of camera \w+; give a larger one"):
        load_probe(Probe(scale=0.02))


def test_broken_captures(tmp_path, capsys):
    folder, out = tmp_path / "capture", tmp_path / "scan"
    image = image_path(make_capture(folder), "00001", "b")
    whole = image.read_bytes()

    image.write_bytes(whole[: len(whole) // 2])
    assert "truncated PNG" in refused(capsys, "reconstruct", folder, "--out", out)
    image.unlink()
    image_path(make_capture(folder), "00001", "a").unlink()
    image.unlink()
    assert "1 of 2 frames have no images" in refused(capsys, "reconstruct", folder, "--out", out)
    make_capture(folder)
    shutil.rmtree(folder / "images" / "b")
    assert "no two cameras see the same surface" in refused(capsys, "reconstruct", folder, "--out", out)
    assert not out.exists()


def test_images_of_a_wrong_size(tmp_path, capsys):
    capture = make_capture(tmp_path / "capture")
    storage.write_image(image_path(capture, "00000", "a"), np.zeros((9, 9, 3), dtype=np.uint8))
    message = refused(capsys, "reconstruct", tmp_path / "capture", "--out", tmp_path / "scan")
    assert "9 x 9 px, but camera a has 16 x 12 px" in message


@pytest.mark.parametrize(("stems", "told"), [(("0",), False), (("0", "1"), True)])
def test_what_is_assumed_of_a_calibration_is_told_where_it_is_refined(tmp_path, capsys, monkeypatch, stems, told):
    """Two frames are enough for that, one is not."""

    def fail(*_: object, **__: object) -> None:
        raise ReconstructionError("nothing located")

    monkeypatch.setattr("cuspid.pipeline.scan.find_poses", fail)
    capture = make_capture(tmp_path / "capture", stems=stems)
    with pytest.raises(ReconstructionError, match="nothing located"):
        reconstruct_capture(capture, tmp_path / "scan", ReconstructionOptions(signal="texture"))
    assert ("taken as nominal" in " ".join(capsys.readouterr().err.split())) == told


def test_a_handpiece_with_an_unknown_camera(tmp_path, capsys):
    make_capture(tmp_path / "capture")
    storage.write_handpiece(tmp_path / "other.json", handpiece("a", "z"))
    message = refused(
        capsys, "reconstruct", tmp_path / "capture", "--handpiece", tmp_path / "other.json", "--out", tmp_path / "scan"
    )
    assert "no camera of the handpiece matches the folder b" in message


def test_a_folder_that_holds_another_run(tmp_path, capsys):
    storage.claim_folder(tmp_path, "simulate", {"seed": 5}, {})
    message = refused(capsys, "simulate", "--tooth", 46, "--out", tmp_path)
    assert "holds another run of 'simulate'" in message


@pytest.mark.long
def test_evaluate_works_on_meshes_that_cuspid_never_saw(tmp_path, capsys, jaw_like):
    storage.write_mesh(tmp_path / "reference.stl", jaw_like)
    turned = jaw_like.transformed(Rigid3.from_rotation_vector(np.array([1.0, 2, 0.5]), np.array([100.0, 5, -30])))
    storage.write_mesh(tmp_path / "scan.obj", turned)
    search = ("--registration.search.targets", 1500, "--registration.search.candidates", 200)
    few = ("--samples", 50_000, "--registration.samples", 20_000)
    run("evaluate", tmp_path / "scan.obj", tmp_path / "reference.stl", "--out", tmp_path / "result", *search, *few)
    trueness = storage.read_json(tmp_path / "result" / "trueness.json")
    assert 0 <= trueness["mean_abs_um"] < 0.5
    assert trueness["completeness_pct"]["50"] > 99.9
    assert abs(trueness["scale_error_ppm"]) < 10
    assert trueness["inter_molar_error_um"] is None
    assert (tmp_path / "result" / "deviation.png").stat().st_size > 10_000
    assert "mean absolute deviation" in (tmp_path / "result" / "report.html").read_text()
    assert "Trueness" in capsys.readouterr().out


@pytest.mark.parametrize("asked", [(), ("--help",), ("-h",)])
def test_every_verb_is_in_the_overview(capsys, asked):
    run(*asked)
    printed = capsys.readouterr().out
    assert [line.split("  ")[1] for line in printed.splitlines() if line.startswith("  ")] == list(cli.COMMANDS)
    assert max(map(len, printed.splitlines())) < 120


@pytest.mark.parametrize(
    ("asked", "said"), [("evalute", "did you mean evaluate?"), ("xyz", "no verb xyz; cuspid --help")]
)
def test_an_unknown_verb_is_answered_with_the_nearest_one(capsys, asked, said):
    with pytest.raises(SystemExit) as caught:
        run(asked)
    assert caught.value.code == 2
    assert said in capsys.readouterr().err


def test_the_module_runs():
    done = subprocess.run([sys.executable, "-m", "cuspid", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"cuspid {__version__}\n"


def test_the_version(capsys):
    run("--version")
    assert capsys.readouterr().out == f"cuspid {__version__}\n"


@pytest.mark.long
@pytest.mark.parametrize(("asked", "modules"), [(["view"], {"shared", "verbs", "view"}), (["--help"], {"verbs"})])
def test_only_what_is_asked_for_is_loaded(asked, modules):
    """To load everything takes seconds."""
    code = f"import sys; from cuspid import cli; cli.load({asked}); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {name.split(".")[2] for name in loaded if name.startswith("cuspid.cli.")} == modules
    assert ("numpy" in loaded) == ("view" in asked)


@pytest.mark.long
def test_an_evaluation_keeps_nothing_of_another_one(tmp_path, monkeypatch):
    """Of another mesh, errors of poses, spheres and margins would look like those of this one."""
    for costly in ("save_deviation_picture", "report"):
        monkeypatch.setattr(f"cuspid.cli.scan.{costly}", lambda *_, **__: None)
    mesh, out = tmp_path / "scan.stl", tmp_path / "out"
    storage.write_mesh(mesh, sphere(8.0, 3))
    run("evaluate", mesh, mesh, "--out", out, "--no-align", "--samples", 2000)
    for name in ("trajectory.json", "spheres.json", "margins.json"):
        (out / name).write_text("{}")
    run("evaluate", mesh, mesh, "--out", out, "--no-align", "--samples", 2000)
    assert not [path for path in out.iterdir() if path.stem in ("trajectory", "spheres", "margins")]


def test_the_trajectory_is_that_of_the_mesh_that_it_made(tmp_path, capsys):
    """Not of any mesh that lies beside it; and of a frame alone there is none."""
    trueness, truth = known_trueness(np.zeros(3)), tmp_path / "truth"
    poses = {f"{k:05d}": shifted(float(k)) for k in range(3)}
    storage.write_poses(truth / "poses.json", poses)
    found = {name: pose @ trueness.reference_from_scan for name, pose in poses.items()}
    storage.write_poses(tmp_path / "motion" / "poses.json", found)
    _evaluate_trajectory(tmp_path / "other.ply", truth, trueness, tmp_path)
    assert not (tmp_path / "trajectory.json").exists()
    _evaluate_trajectory(tmp_path / "mesh.ply", truth, trueness, tmp_path)
    error = storage.read_json(tmp_path / "trajectory.json")
    assert error["frames"] == 3
    assert error["ape_um"]["max"] < 1e-6
    (tmp_path / "trajectory.json").unlink()
    other = Rigid3.from_rotation_vector(np.array([0.2, 0.1, 0]), np.array([3.0, 0, -5]))
    storage.write_handpiece(truth / "handpiece.json", handpiece("a", "b"))
    calibrated = replace(handpiece("a", "b"), rig=handpiece("a", "b").rig.in_frame(other))
    storage.write_handpiece(tmp_path / "motion" / "handpiece.json", calibrated)
    storage.write_poses(tmp_path / "motion" / "poses.json", {name: other @ pose for name, pose in found.items()})
    _evaluate_trajectory(tmp_path / "mesh.ply", truth, trueness, tmp_path)
    error = storage.read_json(tmp_path / "trajectory.json")
    assert error["ape_um"]["max"] < 1e-6, "the same cameras, described in another frame"
    (tmp_path / "trajectory.json").unlink()
    storage.write_poses(tmp_path / "motion" / "poses.json", {"00001": found["00001"]})
    _evaluate_trajectory(tmp_path / "mesh.ply", truth, trueness, tmp_path)
    assert "note: trajectory: 1 of 3 true poses" in capsys.readouterr().err
    assert not (tmp_path / "trajectory.json").exists()
