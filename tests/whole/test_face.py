"""``import cuspid`` offers what a program needs: quickly, typed, with a line and a picture for each value."""

from __future__ import annotations

import base64
import inspect
import re
import subprocess
import sys
from pathlib import Path
from urllib.request import urlopen

import cv2
import numpy as np
import pytest

import cuspid
from builders import folder_capture, handpiece, write_frames
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DesignOptions
from cuspid.model.arch_curve import arch_curve
from cuspid.model.capture import Dropped
from cuspid.model.image_sequence import ImageSequence
from cuspid.model.jaw import Jaw
from cuspid.model.panorama import FrameUse, Panorama
from cuspid.model.reconstruction import DepthMap, Reconstruction
from cuspid.model.trueness import GroundTruth, Trueness
from cuspid.pipeline import panorama as panorama_pipeline
from cuspid.pipeline.scan import scannable
from cuspid.stitching.ortho import Stitched

QUICK = cuspid.EvaluationOptions(align=False, samples=20_000)
ASKED = {
    *("read_mesh", "read_jaw", "read_handpiece", "read_capture", "build_phantom", "design", "simulate", "reconstruct"),
    *("evaluate", "stitch", "calibrate", "Session", "Jaw", "Handpiece", "Capture", "Mesh", "Trueness", "Panorama"),
}


def test_the_face_is_there_and_nothing_else_is_loaded_for_it() -> None:
    code = """
import sys, warnings
filters = list(warnings.filters)
import cuspid
import time
print(time.process_time(), sorted({"numpy", "scipy", "numba", "cv2"} & set(sys.modules)), warnings.filters == filters)
"""
    bare = subprocess.run([sys.executable, "-c", "import time; print(time.process_time())"], capture_output=True)
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    seconds, rest = ended.stdout.split(maxsplit=1)
    assert float(seconds) - float(bare.stdout) < 0.1
    assert rest.strip() == "[] True"


@pytest.mark.long
def test_loading_all_of_it_leaves_the_warning_filters_of_the_host_alone() -> None:
    code = "import warnings; import cuspid, numba, cv2, scipy.stats, igl, matplotlib.figure, trimesh, pycolmap\n"
    code += "before = list(warnings.filters)\nfor name in cuspid.__all__: getattr(cuspid, name)\n"
    code += "print(warnings.filters == before)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "True"


def test_every_name_is_there_and_documented() -> None:
    assert set(cuspid.__all__) >= ASKED
    assert sorted(cuspid.__all__) == cuspid.__all__
    for name in cuspid.__all__:
        value = getattr(cuspid, name)
        assert value.__name__ == name
        assert inspect.getdoc(value), name
    assert not hasattr(cuspid, "nothing")


def test_every_option_has_a_default() -> None:
    functions = [getattr(cuspid, name) for name in cuspid.__all__ if name[0].islower()] + [cuspid.Session]
    options = [
        (function.__name__, parameter)
        for function in functions
        for parameter in inspect.signature(function).parameters.values()
        if "Options" in str(parameter.annotation)
    ]
    assert len(options) > 8
    assert not [(name, str(each)) for name, each in options if each.default is inspect.Parameter.empty]


def test_types_come_along() -> None:
    package = Path(cuspid.__file__).parent
    assert (package / "py.typed").is_file()
    assert (package / "__init__.pyi").is_file()


@pytest.fixture(scope="module")
def truth(coarse_phantom: Jaw) -> GroundTruth:
    """A molar and its neighbours below a pair of cameras."""
    device = cuspid.build_handpiece("two", DesignOptions(width_px=160, height_px=160))
    whole = coarse_phantom.mesh
    molar = whole.centroid(coarse_phantom.tooth_faces(46))
    near = np.linalg.norm(whole.face_centres - molar, axis=1) < 9
    assert coarse_phantom.face_labels is not None
    jaw = Jaw(mesh=whole.submesh(near), face_labels=coarse_phantom.face_labels[near], arch="lower")
    curve = arch_curve(coarse_phantom)
    along = int(np.argmin(np.linalg.norm(curve.points[:, :2] - molar[:2], axis=1)))
    pose = curve.rig_from_world(float(curve.lengths_mm[along]))
    return GroundTruth(jaw=jaw, handpiece=device, rig_from_world={"00000": pose})


@pytest.fixture(scope="module")
def scan(truth: GroundTruth) -> cuspid.Mesh:
    """What was scanned of the jaw lies 10 um too far out."""
    mesh = truth.jaw.mesh
    seen = mesh.submesh(scannable(truth))
    return cuspid.Mesh(seen.vertices + 0.01 * seen.vertex_normals, seen.faces)


@pytest.fixture(scope="module")
def found(scan: cuspid.Mesh, truth: GroundTruth) -> Trueness:
    return cuspid.evaluate(scan, truth, QUICK)


def test_what_could_be_seen_follows_from_the_truth(found: Trueness, scan: cuspid.Mesh, truth: GroundTruth) -> None:
    """Against the truth a scan of a little of the jaw is complete, against the jaw alone it is not."""
    jaw = truth.jaw
    share = 100 * jaw.mesh.face_areas[scannable(truth)].sum() / jaw.mesh.face_areas.sum()
    assert found.scannable_pct == pytest.approx(share, abs=0.01)
    assert found.completeness_pct["50"] > 99
    assert found.accuracy.signed_mean_um == pytest.approx(10, abs=1)
    alone = cuspid.evaluate(scan, jaw, QUICK)
    assert alone.completeness_pct["50"] == pytest.approx(share, abs=1)
    assert alone.scannable_pct == pytest.approx(100)


@pytest.mark.long
def test_a_mesh_may_be_the_reference_and_may_face_inwards(truth: GroundTruth) -> None:
    mesh = truth.jaw.mesh
    inwards = cuspid.Mesh(mesh.vertices + 0.01 * mesh.vertex_normals, mesh.faces[:, ::-1])
    found = cuspid.evaluate(inwards, cuspid.Mesh(mesh.vertices, mesh.faces), QUICK)
    assert found.accuracy.signed_mean_um == pytest.approx(10, abs=1)
    assert any(note.startswith("scan: faces: all looked inwards") for note in found.notes)


def test_files_are_read_by_their_names(tmp_path: Path, coarse_phantom: Jaw, caplog: pytest.LogCaptureFixture) -> None:
    """A jaw in any pose stands upright, and what is unsure about it is logged."""
    tilt = Rigid3.from_rotation_vector(np.array([2.0, 0.5, 0.1]), np.array([5.0, 6.0, 7.0]))
    cuspid.write_mesh(str(tmp_path / "jaw.stl"), coarse_phantom.mesh.transformed(tilt))
    assert len(cuspid.read_mesh(str(tmp_path / "jaw.stl")).faces) == len(coarse_phantom.mesh.faces)
    jaw = cuspid.read_jaw(str(tmp_path / "jaw.stl"), arch="lower")
    assert jaw.mesh.face_normals[:, 2] @ jaw.mesh.face_areas == pytest.approx(
        coarse_phantom.mesh.face_normals[:, 2] @ coarse_phantom.mesh.face_areas, abs=5
    )
    cuspid.write_handpiece(str(tmp_path / "handpiece.json"), cuspid.build_handpiece("four"))
    assert len(cuspid.read_handpiece(str(tmp_path / "handpiece.json")).rig.names) == 4


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> cuspid.Capture:
    folder, device = tmp_path_factory.mktemp("capture"), handpiece("left", "right")
    rng, camera = np.random.default_rng(0), device.rig["left"].camera
    images = [rng.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8) for _ in range(2)]
    for name in device.rig.names:
        write_frames(folder / "images" / name, images)
    stems = sorted(path.stem for path in (folder / "images" / "left").iterdir())
    return folder_capture(folder, device, stems)


def test_a_capture_is_stitched_with_all_its_cameras(capture: cuspid.Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Stitched(panorama=panorama(), motion=None, strip=None)
    monkeypatch.setattr(panorama_pipeline, "stitch_rig", lambda frames, options, progress: made)
    assert cuspid.stitch(capture) == (made,)


def panorama() -> Panorama:
    size, rng = (60, 90), np.random.default_rng(1)
    return Panorama(
        image=rng.integers(0, 256, (*size, 3), dtype=np.uint8),
        covered=np.ones(size, dtype=bool),
        frame_index=np.zeros(size, dtype=np.int16),
        frame_pixel=np.zeros((*size, 2)),
        frames=(FrameUse(name="a", used=True), FrameUse(name="b", used=False, reason="blurred")),
        method="ortho",
        origin_px=np.zeros(2),
        mm_per_px=0.5,
    )


def values(capture: cuspid.Capture, truth: GroundTruth, found: Trueness) -> dict[str, object]:
    camera = capture.handpiece.rig["left"].camera
    located = Reconstruction(
        rig=capture.handpiece.rig,
        rig_from_world={"00000": Rigid3.identity()},
        dropped=(Dropped(what="frame 00001", reason="blurred"),),
    )
    depth = DepthMap(
        frame="00000",
        camera_name="left",
        camera=camera,
        cam_from_rig=Rigid3.identity(),
        depth_mm=np.full((8, 9), 5.0),
        confidence=np.full((8, 9), 1.0),
    )
    sequence = ImageSequence(source=Path("film"), paths=(Path("a.png"), Path("b.png")), size=(64, 48))
    jaw, rig = truth.jaw, capture.handpiece.rig
    return {
        r"Mesh\([\d,]+ vertices, [\d,]+ faces, 1\d\.\d x 1\d\.\d x 1\d\.\d mm\)": jaw.mesh,
        r"Jaw\(lower, \d teeth, Mesh\(.*\)\)": jaw,
        r"Camera\(\d+ x \d+ px, OPENCV, focal length [\d.]+ x [\d.]+ px\)": camera,
        r"Rig\(2 cameras of \d+ x \d+ px\)": rig,
        r"Handpiece\('twelve-cameras', Rig\(12 cameras of 500 x 500 px\), 12 lights, 5 mm from the teeth\)": (
            cuspid.build_handpiece()
        ),
        r"Capture\(2 frames, 4 images, Handpiece\(.*\)\)": capture,
        r"GroundTruth\(1 poses, Jaw\(.*\)\)": truth,
        r"DepthMap\(frame 00000, camera left, 9 x 8 px, 100% known\)": depth,
        r"Reconstruction\(1 frames, 1 left out, no points, mm, Rig\(.*\)\)": located,
        r"Trueness\(mean \|d\| (9|10)\.\d um, P95 \d+\.\d um, [\d.]+ % within 50 um, [\d,]+ vertices\)": found,
        r"Panorama\(90 x 60 px, 45\.0 x 30\.0 mm, 1 of 2 frames, ortho\)": panorama(),
        r"ImageSequence\(2 frames of 64 x 48 px, not calibrated, film\)": sequence,
    }


def test_a_value_is_one_line_with_its_counts_and_sizes(
    capture: cuspid.Capture, truth: GroundTruth, found: Trueness
) -> None:
    for pattern, value in values(capture, truth, found).items():
        assert re.fullmatch(pattern, repr(value)), repr(value)
        assert len(repr(value)) < 200
    assert repr(cuspid.Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))) == "Mesh(0 vertices, 0 faces, 0 mm)"


@pytest.mark.long
def test_a_notebook_shows_a_picture(capture: cuspid.Capture, truth: GroundTruth, found: Trueness) -> None:
    for value in (truth.jaw, truth.handpiece, capture, panorama(), found):
        html = value._repr_html_()
        assert html is not None
        assert f"{type(value).__name__}(" in html
        (encoded,) = re.findall(r'base64,([^"]+)"', html)
        image = cv2.imdecode(np.frombuffer(base64.b64decode(encoded), dtype=np.uint8), cv2.IMREAD_COLOR)
        assert image.std() > 5, type(value)


def test_a_mesh_a_jaw_and_a_handpiece_are_shown_in_the_browser(
    truth: GroundTruth, capture: cuspid.Capture, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'cuspid[view]'")
    for value in (truth.jaw.mesh, truth.jaw, truth.handpiece):
        server = value.show(port=18090)
        try:
            told = capsys.readouterr().out
            assert f"http://127.0.0.1:{server.get_port()} shows {type(value).__name__}(" in told
            with urlopen(f"http://127.0.0.1:{server.get_port()}", timeout=20) as answer:
                assert answer.status == 200
        finally:
            server.stop()
    assert not hasattr(capture, "show")
