import contextlib
import dataclasses
import errno
import json
import os
import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from builders import CAMERA, box_mesh, handpiece, image_path, make_capture, rig_of, shifted
from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.geometry.cameras import MODELS
from cuspid.model.body import Body, Box
from cuspid.model.capture import Dropped
from cuspid.model.jaw import Jaw, Landmark, Sphere
from cuspid.model.reconstruction import DepthMap, Expectation, Reconstruction, Refinement
from cuspid.model.rig import MountedCamera, Rig, Sensor
from cuspid.model.shape_model import MeanStep
from cuspid.model.trueness import ReferenceRender
from cuspid.runtime.errors import CuspidError, InputError, OutputError
from cuspid.storage.files import as_declared, read_arrays, whole_files, write_arrays
from cuspid.storage.handpieces import camera_from_json, hash_handpiece
from strategies import lenses, rigid3s


@pytest.mark.parametrize("suffix", storage.MESH_SUFFIXES)
@pytest.mark.parametrize("unit", ["mm", "m", "in", "um"])
def test_meshes_return_from_every_format_and_unit(tmp_path, suffix, unit):
    mesh = box_mesh()
    path = tmp_path / f"box{suffix}"
    storage.write_mesh(path, dataclasses.replace(mesh, vertices=mesh.vertices / storage.MM_PER_UNIT[unit]))
    again = storage.read_mesh(path, unit)
    assert len(again.vertices) == 8
    np.testing.assert_allclose(again.bounds, mesh.bounds, rtol=1e-6)
    assert again.face_areas.sum() == pytest.approx(mesh.face_areas.sum(), rel=1e-5)


def test_off_files_have_comments_polygons_and_colours(tmp_path):
    """As other programs write them: a square and two triangles, counts behind the name or below it."""
    places = "0 0 0\n2 0 0 # a corner\n2 2 0\n0 2 0\n1 1 2\n"
    for start in ("OFF\n# a comment: OFF 1 1 1\n5 3 0\n", "OFF 5 3 0\n"):
        (tmp_path / "tent.off").write_text(f"{start}{places}4 0 3 2 1 255 0 0\n3 0 1 4\n3 1 2 4\n")
        mesh = storage.read_mesh(tmp_path / "tent.off", "cm")
        assert len(mesh.faces) == 4
        np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [20, 20, 20]])
        assert mesh.face_areas.sum() == pytest.approx(100 * (4 + 2 * np.sqrt(5)))


def test_a_jaw_keeps_labels_colours_landmarks_lines_and_spheres(tmp_path):
    mesh = box_mesh()
    colored = dataclasses.replace(mesh, colors=np.arange(24, dtype=np.uint8).reshape(8, 3))
    jaw = Jaw(
        mesh=colored,
        face_labels=np.arange(12) % 2 * 46,
        arch="lower",
        landmarks={"46.tip": Landmark(np.array([1.0, 2, 3])), "midline": Landmark(np.array([4.0, 5, 6]), 0.2)},
        lines={"46.margin": np.arange(9.0).reshape(3, 3)},
        spheres={"1": Sphere(np.array([7.0, 8, 9]), 2.5)},
    )
    storage.write_jaw(tmp_path / "jaw.ply", jaw)
    again = storage.read_jaw(tmp_path / "jaw.ply")
    np.testing.assert_allclose(again.mesh.face_centres, mesh.face_centres, atol=1e-5)
    np.testing.assert_array_equal(again.face_labels, jaw.face_labels)
    assert again.arch == "lower"
    np.testing.assert_array_equal(again.landmarks["46.tip"].position, [1, 2, 3])
    assert [point.estimated_sigma_mm for point in again.landmarks.values()] == [None, 0.2]
    np.testing.assert_array_equal(again.lines["46.margin"], jaw.lines["46.margin"])
    np.testing.assert_array_equal(again.spheres["1"].centre, [7, 8, 9])
    assert again.spheres["1"].radius_mm == 2.5
    order = np.lexsort(again.mesh.vertices.T)
    np.testing.assert_array_equal(again.mesh.colors[order], colored.colors[np.lexsort(mesh.vertices.T)])


def test_labels_may_lie_beside_the_mesh(tmp_path):
    storage.write_mesh(tmp_path / "box.ply", box_mesh())
    given = [0, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]
    np.save(tmp_path / "box_facelabels.npy", np.array(given))
    _, labels, _ = storage.read_labelled_mesh(tmp_path / "box.ply")
    assert list(labels) == given


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("jaw.txt", b"hello", "not a mesh file that cuspid reads; give an STL, PLY, OBJ or OFF file"),
        ("jaw.stl", b"hello", "jaw.stl: (not a mesh|the mesh is empty)"),
        (
            "jaw.ply",
            b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n",
            "jaw.ply: (not a mesh|the mesh is empty)",
        ),
        ("jaw.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "jaw.obj: (not a mesh|the mesh is empty)"),
        ("jaw.obj", b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "jaw.obj: its vertices do not have three coordinates each"),
        ("jaw.off", b"hello", "jaw.off: not a mesh"),
        ("jaw.off", b"OFF\n3 9 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "jaw.off: 1 of 9 faces could be read"),
        ("jaw.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "jaw.off: not a mesh"),
        ("jaw.off", b"OFF\n99999999999 1 0\n0 0 0\n", "jaw.off: not a mesh"),
        ("jaw.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "jaw.obj: (not a mesh|some coordinates are not finite)"),
    ],
)
def test_what_is_no_mesh_is_refused_in_one_line(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        storage.read_mesh(tmp_path / name)
    assert "\n" not in str(caught.value)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(cut=st.floats(0, 0.999), flips=st.lists(st.tuples(st.floats(0, 0.999), st.integers(0, 255)), max_size=4))
def test_broken_mesh_files_never_crash(tmp_path, cut, flips):
    path = tmp_path / "box.ply"
    storage.write_mesh(path, box_mesh())
    data = bytearray(path.read_bytes())
    for place, value in flips:
        data[int(place * len(data))] = value
    path.write_bytes(bytes(data[: int(cut * len(data))]))
    with contextlib.suppress(CuspidError):
        assert len(storage.read_mesh(path).faces) > 0


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        storage.read_mesh(tmp_path / "jaw.stl")


def test_polarised_lights_return_and_plain_ones_are_written_as_before(tmp_path):
    plain = handpiece("x")
    polarised = dataclasses.replace(plain.lights["led"], glare=0.03)
    file = tmp_path / "handpiece.json"
    storage.write_handpiece(file, dataclasses.replace(plain, lights={"led": polarised}))
    assert storage.read_handpiece(file).lights["led"].glare == 0.03
    file.write_text(file.read_text().replace("0.03", "1.5"))
    with pytest.raises(InputError, match=r"light 'led': glare is 1\.5"):
        storage.read_handpiece(file)
    storage.write_handpiece(file, plain)
    assert "glare" not in file.read_text()
    assert storage.read_handpiece(file).lights["led"].glare == 1


@given(camera=st.sampled_from([*MODELS]).flatmap(lenses), transform=rigid3s(), other=rigid3s())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None)
def test_handpiece_and_rig_config_return(tmp_path, camera, transform, other):
    camera = dataclasses.replace(camera, covariance=1e-3 * np.eye(len(camera.parameters)))
    rig = Rig({"o1": MountedCamera(camera, transform, 1e-4 * np.eye(6)), "o2": MountedCamera(camera, other)})
    original = dataclasses.replace(handpiece("x"), rig=rig, depth_range_mm=(2.0, 9.5))
    storage.write_handpiece(tmp_path / "handpiece.json", original)
    again = storage.read_handpiece(tmp_path / "handpiece.json")
    np.testing.assert_allclose(again.rig["o1"].covariance, 1e-4 * np.eye(6))
    assert again.rig["o2"].covariance is None
    assert again.depth_range_mm == (2.0, 9.5)
    assert again.lightings == original.lightings
    np.testing.assert_allclose(again.lights["led"].position_mm, [1, 2, 3])
    storage.write_rig_config(tmp_path / "rig_config.json", rig)
    colmap = storage.read_rig_config(tmp_path / "rig_config.json")
    expected, _ = rig.rebased()
    for name in rig.names:
        np.testing.assert_allclose(again.rig[name].cam_from_rig.matrix, rig[name].cam_from_rig.matrix, atol=1e-9)
        np.testing.assert_allclose(colmap[name].cam_from_rig.matrix, expected[name].cam_from_rig.matrix, atol=1e-8)
        np.testing.assert_allclose(colmap[name].camera.parameters, camera.parameters)
        np.testing.assert_allclose(again.rig[name].camera.parameters, camera.parameters)
        np.testing.assert_allclose(again.rig[name].camera.covariance, camera.covariance)
        assert again.rig[name].camera.model == colmap[name].camera.model == camera.model
        assert (colmap[name].camera.width, colmap[name].camera.height) == (camera.width, camera.height)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"params": [500.0] * 8}, "params has 8 numbers; those of the model FULL_OPENCV are 12: fx, fy, cx, cy, k1"),
        ({"model": "BROWN"}, "model 'BROWN' is not supported; use one of OPENCV, FULL_OPENCV"),
        ({"focal_px": [500, 500]}, "it has both model and focal_px"),
        ({"params": [500.0, 500, 250, 250, *[0.0] * 7, 1e9]}, "k6 of params"),
    ],
)
def test_a_lens_of_a_named_model_has_its_parameters(change, told):
    entry = {"width_px": 500, "height_px": 500, "model": "FULL_OPENCV", "params": [500.0, 500, 250, 250, *[0.0] * 8]}
    assert camera_from_json(entry).model == "FULL_OPENCV"
    with pytest.raises(InputError, match=re.escape(told)):
        camera_from_json(entry | change)


def test_a_rig_config_serves_as_a_handpiece(tmp_path, caplog):
    path = tmp_path / "rig_config.json"
    storage.write_rig_config(path, rig_of(a=shifted(0), b=shifted(2)))
    with caplog.at_level("INFO", logger="cuspid"):
        again = storage.read_handpiece(path)
    assert again.rig.names == ("a", "b")
    assert 2 < again.depth_range_mm[0] < again.working_distance_mm < again.depth_range_mm[1] < 9
    (told,) = caplog.messages
    assert f"{again.working_distance_mm:.3g} mm is assumed, from their baselines" in told
    assert "--working-distance-mm" in told
    caplog.clear()
    given = storage.read_handpiece(path, 50.0)
    assert (given.working_distance_mm, *given.depth_range_mm) == (50.0, 25.0, 90.0)
    assert not caplog.messages


def test_a_working_distance_that_cannot_be_known_or_is_known_is_told(tmp_path):
    storage.write_rig_config(tmp_path / "rig_config.json", handpiece("a").rig)
    with pytest.raises(
        InputError, match=r"rig_config.json: the working distance cannot be inferred .*; give a handpiece"
    ):
        storage.read_handpiece(tmp_path / "rig_config.json")
    storage.write_handpiece(tmp_path / "handpiece.json", handpiece("a"))
    with pytest.raises(InputError, match="already has a working distance"):
        storage.read_handpiece(tmp_path / "handpiece.json", 7.0)


def test_a_rig_config_of_colmap_without_sizes(tmp_path):
    entry = {
        "image_prefix": "cam1/",
        "ref_sensor": True,
        "camera_model_name": "SIMPLE_RADIAL",
        "camera_params": [400, 250, 200, 0.1],
    }
    storage.write_json(tmp_path / "rig.json", [{"cameras": [entry]}])
    camera = storage.read_rig_config(tmp_path / "rig.json")["cam1"].camera
    np.testing.assert_array_equal(camera.parameters, [400, 400, 250, 200, 0.1, 0, 0, 0])
    assert (camera.width, camera.height) == (500, 400)
    storage.write_json(tmp_path / "rig.json", [{"cameras": [{**entry, "camera_model_name": "FISHEYE"}]}])
    with pytest.raises(InputError, match="FISHEYE"):
        storage.read_rig_config(tmp_path / "rig.json")


def test_a_missing_field_is_named(tmp_path):
    storage.write_handpiece(tmp_path / "h.json", handpiece("a"))
    value = storage.read_json(tmp_path / "h.json")
    del value["cameras"]["a"]["focal_px"]
    storage.write_json(tmp_path / "h.json", value)
    with pytest.raises(InputError, match="'focal_px' is missing"):
        storage.read_handpiece(tmp_path / "h.json")


def test_a_capture_returns(tmp_path):
    capture = make_capture(tmp_path)
    again = storage.read_capture(tmp_path)
    assert again.frames == capture.frames
    second = capture.frames[1]
    np.testing.assert_array_equal(again.image(second, "b"), capture.image(second, "b"))
    (tmp_path / "capture.json").unlink()
    assert [frame.name for frame in storage.read_capture(tmp_path).frames] == ["00000", "00001"]


def test_what_a_killed_run_left_unfinished_is_passed_over(tmp_path):
    capture = make_capture(tmp_path / "capture")
    (tmp_path / "capture" / "images" / "b" / f"{storage.PART}x1y2.png").write_bytes(b"half an image")
    assert storage.read_capture(tmp_path / "capture").frames == capture.frames
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / f"{storage.PART}x1y2.json").write_text("{")
    storage.claim_folder(tmp_path / "out", "simulate", {}, {})


def test_broken_captures_are_refused(tmp_path):
    capture = make_capture(tmp_path)
    path = image_path(capture, "00001", "b")
    whole = path.read_bytes()

    path.write_bytes(whole[:-20])
    with pytest.raises(InputError, match="truncated PNG"):
        capture.image(capture.frames[1], "b")
    storage.write_image(path, np.zeros((9, 9, 3), dtype=np.uint8))
    with pytest.raises(InputError, match="9 x 9 px, but camera b has 16 x 12 px"):
        capture.image(capture.frames[1], "b")
    path.write_bytes(b"")
    with pytest.raises(InputError, match="truncated"):
        capture.image(capture.frames[1], "b")
    path.unlink()
    without = storage.read_capture(tmp_path)
    assert [frame.cameras for frame in without.frames] == [("a", "b"), ("a",)]
    assert [dropped.what for dropped in without.left_out] == ["camera b of frame 00001"]
    assert set(without.images(without.frames[1])) == {"a"}
    path.write_bytes(whole)
    (tmp_path / "images" / "zz").mkdir()
    with pytest.raises(InputError, match="no camera of the handpiece matches the folder zz"):
        storage.read_capture(tmp_path)
    (tmp_path / "images" / "zz").rmdir()
    (tmp_path / "images" / "b").rename(tmp_path / "b")
    without = storage.read_capture(tmp_path)
    assert without.handpiece.rig.names == ("a",)
    assert [dropped.what for dropped in without.left_out] == ["camera b"]
    calibrated = dataclasses.replace(handpiece("a", "b"), sensors={"a": Sensor(gamma=1.9), "b": Sensor(gamma=2.0)})
    storage.write_handpiece(tmp_path / "handpiece.json", calibrated)
    assert storage.read_capture(tmp_path).handpiece.sensors.keys() == {"a"}
    with pytest.raises(InputError, match="no folder 'images'"):
        storage.read_capture(tmp_path / "images")


def test_what_a_capture_is_made_from_is_told_by_its_contents(tmp_path):
    """Another image of the same size on disk is another capture; the same image again is the same one."""
    capture = make_capture(tmp_path)
    before, path = storage.hash_capture(capture), image_path(capture, "00000", "a")
    whole = path.read_bytes()
    path.write_bytes(bytes([*whole[:60], whole[60] ^ 1, *whole[61:]]))
    after = storage.hash_capture(capture)
    assert after["handpiece"] == before["handpiece"]
    assert after["images"] != before["images"]
    path.write_bytes(whole)
    assert storage.hash_capture(capture) == before


def test_a_handpiece_with_a_field_that_means_nothing_is_refused(tmp_path):
    storage.write_handpiece(tmp_path / "handpiece.json", handpiece("a", "b"))
    value = storage.read_json(tmp_path / "handpiece.json")
    storage.write_json(tmp_path / "handpiece.json", {**value, "exposures": value["lightings"]})
    with pytest.raises(InputError, match="unknown field 'exposures'"):
        storage.read_handpiece(tmp_path / "handpiece.json")


@given(poses=st.lists(rigid3s(), min_size=1, max_size=4), sizes=st.lists(st.floats(0.1, 80.0), min_size=3, max_size=6))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25, deadline=None)
def test_the_body_of_a_handpiece_returns(tmp_path, poses, sizes):
    boxes = {f"part {k}": Box(pose, np.roll(sizes, k)[:3] / 2) for k, pose in enumerate(poses)}
    original = dataclasses.replace(handpiece("a", "b"), body=Body(boxes))
    storage.write_handpiece(tmp_path / "handpiece.json", original)
    again = storage.read_handpiece(tmp_path / "handpiece.json")
    assert again.body.names == tuple(boxes)
    for name, box in boxes.items():
        np.testing.assert_array_equal(again.body.parts[name].half_mm, box.half_mm)
        np.testing.assert_allclose(again.body.parts[name].corners, box.corners, atol=1e-9)


def test_a_body_changes_no_reconstruction(tmp_path):
    bare = handpiece("a", "b")
    solid = dataclasses.replace(bare, body=Body({"bar": Box(Rigid3.identity(), np.ones(3))}))
    assert hash_handpiece(solid) == hash_handpiece(bare)
    storage.write_handpiece(tmp_path / "handpiece.json", bare)
    assert "body" not in storage.read_json(tmp_path / "handpiece.json")
    assert storage.read_handpiece(tmp_path / "handpiece.json").body is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size_mm": [1, 2]}, r"bar: size_mm is \[1, 2\]; it must be 3 numbers"),
        ({"size_mm": [1, 2, 0]}, "bar: size_mm"),
        ({"size_mm": [1, 2, None]}, "bar: size_mm"),
        ({"size_mm": [1, 2, True]}, "bar: size_mm"),
        ({"size_mm": "big"}, "bar: size_mm"),
        ({"half_mm": [1, 2, 3]}, "bar: a box must have exactly the fields box_from_rig and size_mm"),
        ({"box_from_rig": {"translation_mm": [0, 0, 0]}}, "bar: box_from_rig must have exactly the fields"),
        ({"box_from_rig": [0, 0, 0]}, "bar: box_from_rig must have exactly the fields"),
        (
            {"box_from_rig": {"rotation_wxyz": [0, 0, 0, 0], "translation_mm": [0, 0, 0]}},
            "bar: box_from_rig: rotation_wxyz",
        ),
        (
            {"box_from_rig": {"rotation_wxyz": [1, 0, 0], "translation_mm": [0, 0, 0]}},
            "bar: box_from_rig: rotation_wxyz",
        ),
        (
            {"box_from_rig": {"rotation_wxyz": [1, 0, 0, 0], "translation_mm": [0, 0]}},
            "bar: box_from_rig: translation_mm",
        ),
    ],
)
def test_a_mistake_in_a_body_is_told_in_one_line(tmp_path, change, message):
    path = tmp_path / "handpiece.json"
    solid = dataclasses.replace(handpiece("a"), body=Body({"bar": Box(Rigid3.identity(), np.ones(3))}))
    storage.write_handpiece(path, solid)
    value = storage.read_json(path)
    value["body"]["bar"] |= change
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match=f"handpiece.json: body, {message}") as caught:
        storage.read_handpiece(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("body", [{}, [], "box", 3])
def test_a_body_without_boxes_is_refused(tmp_path, body):
    path = tmp_path / "handpiece.json"
    storage.write_handpiece(path, handpiece("a"))
    storage.write_json(path, {**storage.read_json(path), "body": body})
    with pytest.raises(InputError, match=r"handpiece.json: body must map names to boxes"):
        storage.read_handpiece(path)


def test_depth_maps_return(tmp_path):
    rng = np.random.default_rng(0)
    depth = rng.uniform(4, 6, (12, 16)).astype(np.float32)
    depth[3, 4] = np.nan
    original = DepthMap(
        frame="00000",
        camera_name="o1",
        camera=CAMERA,
        cam_from_rig=Rigid3.from_rotation_vector(np.array([0.1, 0.2, 0.3]), np.ones(3)),
        depth_mm=depth,
        confidence=rng.random((12, 16)).astype(np.float32),
        color=rng.integers(0, 255, (12, 16, 3), dtype=np.uint8),
        best_mm=0.002,
    )
    storage.write_depth_maps(tmp_path / "d.npz", [original, dataclasses.replace(original, color=None)])
    first, second = storage.read_depth_maps(tmp_path / "d.npz")
    np.testing.assert_array_equal(first.depth_mm, depth)
    np.testing.assert_allclose(first.confidence, original.confidence, atol=1e-3)
    np.testing.assert_array_equal(first.color, original.color)
    assert second.color is None
    assert first.best_mm == 0.002
    points, known = first.points_in_rig()
    assert len(points) == 12 * 16 - 1
    in_cam = original.cam_from_rig.apply(points)
    np.testing.assert_allclose(in_cam[:, 2], depth.ravel()[known], atol=1e-6)
    np.testing.assert_allclose(CAMERA.project(in_cam), CAMERA.pixel_centres().reshape(-1, 2)[known], atol=1e-4)


def test_a_reconstruction_returns(tmp_path):
    device = handpiece("a", "b")
    original = Reconstruction(
        rig=device.rig,
        rig_from_world={"1": Rigid3.identity(), "0": Rigid3(np.eye(3), np.ones(3))},
        refinement=Refinement(rms_sigmas=0.5, camera_sigmas={"a": 0.4, "b": 0.6}),
        expectation=Expectation(
            points=np.ones((5, 3)),
            covariance=np.stack([np.eye(3)] * 5),
            scale_sigma_ppm=120.0,
            span_mm=55.0,
            span_sigma_um=8.0,
        ),
        dropped=(Dropped(what="frame 2", reason="blank"),),
        pose_covariance=np.stack([np.eye(6)] * 2),
        reprojection_rms_px=0.3,
        log={"pairs": 12},
    )
    storage.write_reconstruction(tmp_path, original, device)
    again = storage.read_reconstruction(tmp_path)
    assert again.frames == ("1", "0")
    assert again.dropped == original.dropped
    assert vars(again.refinement) == vars(original.refinement)
    for name, value in vars(original.expectation).items():
        assert np.array_equal(getattr(again.expectation, name), value)
    np.testing.assert_array_equal(again.pose_covariance, original.pose_covariance)
    np.testing.assert_allclose(again.rig_from_world["0"].matrix, original.rig_from_world["0"].matrix)


def test_a_folder_belongs_to_one_run(tmp_path):
    folder = tmp_path / "scan"
    storage.claim_folder(folder, "simulate", {"seed": 0}, {"jaw": "abc"})
    storage.claim_folder(folder, "simulate", {"seed": 0}, {"jaw": "abc"})
    storage.claim_folder(folder, "reconstruct", {"voxel_mm": 0.05}, {})
    with pytest.raises(OutputError, match=r"another run of 'simulate' \(settings.seed differs\)"):
        storage.claim_folder(folder, "simulate", {"seed": 1}, {"jaw": "abc"})
    assert set(json.loads((folder / "run.json").read_text())) == {"simulate", "reconstruct"}
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.doc").write_text("precious")
    with pytest.raises(OutputError, match="files that are not from cuspid"):
        storage.claim_folder(tmp_path / "other", "simulate", {}, {})


def test_results_stay_those_of_the_run_that_made_them_until_they_are_replaced(tmp_path):
    def settings() -> dict[str, object]:
        return storage.read_json(tmp_path / "out" / "run.json")["measure"]["settings"]

    def measure(arch: str, error: BaseException | None = None) -> None:
        with storage.claimed_folder(tmp_path / "out", "measure", {"arch": arch}, {}, replace=True):
            assert settings() == {"arch": "lower"}  # of the first run, or of what is there still
            if error is not None:
                raise error
            (tmp_path / "out" / "jaws.csv").write_text(arch)

    measure("lower")
    for error in (InputError("no jaw"), KeyboardInterrupt()):
        with pytest.raises(type(error)):
            measure("upper", error)
        assert settings() == {"arch": "lower"}
    measure("upper")
    assert settings() == {"arch": "upper"}


def test_files_are_whole_or_absent(tmp_path):
    path = tmp_path / "value.json"
    storage.write_json(path, {"a": float("nan"), "b": np.float32(0.5)})
    assert storage.read_json(path) == {"a": None, "b": 0.5}

    def fill_the_disk() -> None:
        with storage.whole_file(path) as temporary:
            temporary.write_text("half")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OutputError, match="disk is full"):
        fill_the_disk()
    assert storage.read_json(path) == {"a": None, "b": 0.5}
    assert [item.name for item in tmp_path.iterdir()] == ["value.json"]


def test_arrays_return_and_damaged_ones_are_told_with_what_to_do(tmp_path):
    path = tmp_path / "arrays.npz"
    write_arrays(path, {"one": np.arange(3), "other": np.eye(2)}, compressed=True)
    np.testing.assert_array_equal(read_arrays(path, remedy="make it again")["other"], np.eye(2))
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"arrays\.npz: damaged .*; make it again"):
        read_arrays(path, remedy="make it again")
    path.unlink()
    with pytest.raises(InputError, match=r"arrays\.npz: no such file; make it again"):
        read_arrays(path, remedy="make it again")


def test_files_of_a_folder_are_there_together_or_not_at_all(tmp_path):
    def write(text: str, *, fails: bool = False) -> None:
        with whole_files(tmp_path / "model") as part:
            for name in ("a.txt", "b.txt"):
                (part / name).write_text(text)
            if fails:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    write("first")
    with pytest.raises(OutputError, match="disk is full"):
        write("second", fails=True)
    assert {file.name: file.read_text() for file in (tmp_path / "model").iterdir()} == dict.fromkeys(
        ("a.txt", "b.txt"), "first"
    )


def test_a_film_that_the_disk_cannot_hold_is_no_film(tmp_path, monkeypatch):
    """OpenCV's writer fails in silence."""
    capture = make_capture(tmp_path / "capture")
    storage.write_video(tmp_path / "whole.mp4", capture)
    assert (tmp_path / "whole.mp4").stat().st_size > 100
    monkeypatch.setattr("cuspid.storage.videos.cv2.cvtColor", lambda image, code: np.zeros((3, 3, 3), np.uint8))
    with pytest.raises(OutputError, match="0 of 2 frames were written"):
        storage.write_video(tmp_path / "broken.mp4", capture)
    assert not (tmp_path / "broken.mp4").exists()


# What files say is of the type that its class declares


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mm_per_px", "0.1"),
        ("mm_per_px", True),
        ("mm_per_px", float("nan")),
        ("camera_height_mm", [1.0]),
        ("labels", np.zeros((2, 3), dtype=np.float64)),
        ("labels", np.zeros((3, 2), dtype=np.int16)),
        ("origin_px", np.zeros(3)),
        ("image", None),
    ],
)
def test_a_value_of_another_kind_than_declared_is_refused_by_its_name(name, value):
    fitting = {
        "image": np.zeros((2, 3, 3), dtype=np.uint8),
        "labels": np.zeros((2, 3), dtype=np.int16),
        "height_mm": np.zeros((2, 3), dtype=np.float32),
        "mm_per_px": 1,
        "origin_px": np.zeros(2),
        "camera_height_mm": None,
    }
    assert as_declared(ReferenceRender, **fitting).mm_per_px == 1
    with pytest.raises(InputError, match=f"'{name}' cannot be"):
        as_declared(ReferenceRender, **fitting | {name: value})


def test_a_list_of_values_is_looked_through():
    round_of = {"change_um": 1.0, "surface_change_um": 1, "largest_change_um": 0.0, "covered_pct": 99.0}
    assert as_declared(MeanStep, **round_of).surface_change_um == 1
    with pytest.raises(InputError, match="'covered_pct' cannot be 'all'"):
        as_declared(MeanStep, **round_of | {"covered_pct": "all"})
    with pytest.raises(InputError, match="unknown field 'round'"):
        as_declared(MeanStep, **round_of, round=1)
    with pytest.raises(InputError, match="'notes' cannot be"):
        as_declared(Reconstruction, rig=handpiece("a", "b").rig, rig_from_world={}, notes=("one", 2))


def test_libraries_log_nothing_of_a_damaged_mesh(tmp_path, caplog):
    """Normals that cannot be read are not needed."""
    normal, corners = "facet normal 0 x1 1\nouter loop\n", "vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    (tmp_path / "jaw.stl").write_text(f"solid jaw\n{normal}{corners}endloop\nendfacet\nendsolid jaw\n")
    assert len(storage.read_mesh(tmp_path / "jaw.stl").faces) == 1
    assert not caplog.records
