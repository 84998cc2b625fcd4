"""Measuring, preparing and averaging jaws as a user meets it: the files that appear, and what bad input gets."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from cuspid import storage
from cuspid.handpiece.designs import twelve_cameras
from cuspid.model.jaw import Jaw, Landmark
from cuspid.model.mesh import Mesh
from verbs import refused, run


def test_a_jaw_and_a_broken_one_are_measured(tmp_path, capsys, phantom_file, coarse_phantom):
    jaws = tmp_path / "jaws"
    storage.write_jaw(jaws / "good.ply", coarse_phantom)
    (jaws / "broken.stl").write_text("solid nothing")
    run("jaw", "measure", jaws, "--out", tmp_path / "out")
    rows = {row["jaw"]: row for row in csv.DictReader((tmp_path / "out" / "jaws.csv").open())}
    tips = [coarse_phantom.landmarks[f"{tooth}.cusp_tip"].position for tooth in (33, 43)]
    assert float(rows["good"]["a_mm"]) == pytest.approx(np.linalg.norm(tips[0] - tips[1]), abs=1e-3)
    assert "not measured" in rows["broken"]["notes"]
    groups = list(csv.DictReader((tmp_path / "out" / "groups.csv").open()))
    assert [(group["group"], group["jaws"]) for group in groups] == [("Lower-14", "1")]
    assert (tmp_path / "out" / "good.png").stat().st_size > 10_000
    assert "broken" in capsys.readouterr().err


@pytest.mark.long
def test_landmarks_in_the_frame_of_a_turned_mesh_are_found_beside_it(tmp_path, coarse_phantom):
    """3D Slicer's points lie in the frame of the mesh, which is brought into the occlusal frame, and they with it."""
    landmarks = {label: coarse_phantom.landmarks[label] for label in ("33.cusp_tip", "43.cusp_tip")}
    storage.write_mesh(tmp_path / "my_lower.ply", coarse_phantom.mesh)
    storage.write_landmarks(tmp_path / "my_lower.mrk.json", landmarks, "mesh")
    run("jaw", "measure", tmp_path / "my_lower.ply", "--out", tmp_path / "out")
    row = next(csv.DictReader((tmp_path / "out" / "jaws.csv").open()))
    gap = np.subtract(*(point.position for point in landmarks.values()))
    assert float(row["a_mm"]) == pytest.approx(np.linalg.norm(gap), abs=2e-3)
    assert row["b_mm"] == ""
    assert "46.buccal_groove" in row["notes"]


def test_a_landmark_that_the_scheme_does_not_know(tmp_path, capsys, phantom_file):
    storage.write_landmarks(tmp_path / "points.json", {"46.bucal_groove": Landmark(np.zeros(3))}, "occlusal")
    command = ("jaw", "measure", phantom_file, "--landmarks", tmp_path / "points.json", "--out", tmp_path / "out")
    assert "did you mean 46.buccal_groove" in refused(capsys, *command)


def test_no_jaws_to_measure(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert "no jaw meshes" in refused(capsys, "jaw", "measure", tmp_path / "empty", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_a_prepared_jaw_keeps_labels_and_has_its_line(tmp_path, phantom_file):
    run(
        "jaw", "prepare", phantom_file, "--tooth", 46, "--out", tmp_path / "cracked.ply", "crack", "--width-um", "200.0"
    )
    cracked, sound = storage.read_jaw(tmp_path / "cracked.ply"), storage.read_jaw(phantom_file)
    assert cracked.teeth == sound.teeth
    assert set(cracked.landmarks) == set(sound.landmarks)
    assert "46.crack" in cracked.lines
    assert (tmp_path / "cracked.teeth.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--tooth", "48", "crown"), "no tooth 48"),
        (("--tooth", "46"), "give either --preset"),
        (("--preset", "thesis-reference", "--tooth", "46", "crown"), "give either --preset"),
        (("--tooth", "46", "crown", "--taper-deg", "50.0"), "--taper-deg is 50"),
    ],
)
def test_preparations_that_cannot_be(tmp_path, capsys, phantom_file, arguments, message):
    out = tmp_path / "prepared.ply"
    assert message in refused(capsys, "jaw", "prepare", phantom_file, "--out", out, *arguments)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("option", "value"),
    [("--seed", -1), ("--edge-mm", 0.0), ("--edge-mm", -1.0), ("--edge-mm", 9.0), ("--edge-mm", "nan")]
    + [("--variation", -1.0), ("--tooth-size", 0.0)],
)
def test_phantoms_that_cannot_be(tmp_path, capsys, option, value):
    assert option.removeprefix("--") in refused(capsys, "jaw", "phantom", "--out", tmp_path / "jaw.ply", option, value)
    assert not any(tmp_path.iterdir())


def test_a_jaw_that_is_no_manifold(tmp_path, capsys, coarse_phantom):
    mesh = coarse_phantom.mesh
    faces = np.concatenate([mesh.faces, mesh.faces[:1, ::-1]])
    labels = np.concatenate([coarse_phantom.face_labels, coarse_phantom.face_labels[:1]])
    broken = replace(coarse_phantom, mesh=Mesh(mesh.vertices, faces), face_labels=labels)
    storage.write_jaw(tmp_path / "jaw.ply", broken)
    message = refused(
        capsys, "jaw", "prepare", tmp_path / "jaw.ply", "--tooth", 46, "--out", tmp_path / "out.ply", "crack"
    )
    assert "edge" in message
    assert not (tmp_path / "out.ply").exists()


def test_a_mean_needs_common_landmarks(tmp_path, capsys, coarse_phantom):
    jaws = tmp_path / "jaws"
    points = list(coarse_phantom.landmarks.items())
    for name, some in (("one", points[:20]), ("other", points[18:40])):
        bare = Jaw(mesh=coarse_phantom.mesh, arch="lower", landmarks=dict(some))
        storage.write_jaw(jaws / f"{name}.ply", bare)
    message = refused(capsys, "jaw", "shape", jaws, "--out", tmp_path / "shape")
    assert "2 landmarks in common" in message
    assert not (tmp_path / "shape").exists()


def test_a_box_needs_labels(tmp_path, capsys, coarse_phantom):
    storage.write_jaw(tmp_path / "bare.ply", replace(coarse_phantom, face_labels=None))
    assert "label" in refused(capsys, "jaw", "box", tmp_path / "bare.ply", "--out", tmp_path / "box.ply")
    assert not (tmp_path / "box.ply").exists()


def test_a_mouth_takes_the_size_of_a_handpiece(tmp_path, capsys):
    made = twelve_cameras()
    storage.write_handpiece(tmp_path / "handpiece.json", made)
    run("jaw", "mouth", "--handpiece", tmp_path / "handpiece.json", "--people", "50", "--out", tmp_path / "mouth")
    needed = storage.read_json(tmp_path / "mouth" / "mouth.json")["needed_mm"]
    assert needed == pytest.approx(made.solid.bounds[1, 2])
    storage.write_handpiece(tmp_path / "bare.json", replace(made, body=None))
    refusal = refused(capsys, "jaw", "mouth", "--handpiece", tmp_path / "bare.json", "--out", tmp_path / "none")
    assert "bare.json: its body is not known" in refusal
    assert not (tmp_path / "none").exists()


def test_a_mouth_that_cannot_be(tmp_path, capsys):
    assert "--thickness-mm" in refused(capsys, "jaw", "mouth", "--thickness-mm", "-1.0", "--out", tmp_path / "mouth")
    assert not (tmp_path / "mouth").exists()
