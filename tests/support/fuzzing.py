"""A fuzzer: small inputs that are read well, damaged in ways that happen and in ways that are meant.

A scenario makes a folder and does something with it. What it may do with a damaged one is to succeed, or to say in one
line what is wrong: no traceback, no hang, no gigabytes, no noise of libraries, no file outside of ``out``.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import resource
import shutil
import signal
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import trimesh
from PIL import Image

import photo_scene
from boards import photographs, scene, undistorted
from builders import image_path, write_frames
from colmap_models import make_capture, make_found, without_rig, write_colmap
from cuspid import cli, storage
from cuspid.anatomy.jaw_files import Labelling, load_jaw
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.evaluation.deviation import EvaluationOptions
from cuspid.evaluation.registration import RegistrationOptions
from cuspid.evaluation.search import SearchOptions
from cuspid.handpiece.brief import read_brief
from cuspid.handpiece.designs import DESIGNS
from cuspid.handpiece.intra_oral import IntraOralOptions, intra_oral_camera
from cuspid.model.arch_curve import arch_curve
from cuspid.model.board import Board
from cuspid.model.facing import facing_outwards
from cuspid.model.jaw import Jaw, Landmark
from cuspid.model.mesh import Mesh
from cuspid.model.rig import Rig
from cuspid.motion.colmap import read_model
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import RenderOptions, take_images
from cuspid.runtime.errors import CuspidError
from cuspid.runtime.image_files import image_size, read_fine, read_image
from cuspid.studies.grid import Case, Work
from cuspid.studies.scanners.files import find_files
from cuspid.studies.scanners.specimen import load_specimen
from panoramas import (
    known_film,
    picture,
    small_panorama,
    stitched_panorama,
    write_calibration,
    write_stitched,
    write_truth,
)
from report_folders import (
    TOOTH,
    write_calibrated,
    write_comparison,
    write_evaluation,
    write_scan,
    write_score,
    write_shape,
)

LONGEST_S = 10.0
"""Of work; waiting may take more on a busy machine."""
LONGEST_WAIT_S = 60.0
MOST_BYTES = 2 << 30
_NOISE = re.compile(
    r"Traceback|Warning:|corrupt|libpng|\[ ?WARN|\[ERROR|OpenCV[(:]|Exception|glog|\*\*\*", re.IGNORECASE
)
_OUT = "out"
_SOURCES = Path(cli.__file__).parent.parent.parent
"""Results name no folder of this machine."""
RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


@dataclass(frozen=True)
class Scenario:
    """Something that is done with files."""

    make: Callable[[Path], None]
    """Writes good files into a folder."""
    use: Callable[[Path], object]
    """Reads them; what it writes goes to ``out`` in the folder."""
    is_good: bool | None = True
    """Whether the undamaged files are taken; False if they, too, must be refused, None if either will do."""


# --- scenarios ----------------------------------------------------------------------------------------------------


@cache
def arch(edge_mm: float) -> Jaw:
    """A whole one."""
    return build_phantom(PhantomOptions(edge_mm=edge_mm))


@cache
def small_jaw() -> Jaw:
    """A molar with its neighbours, in big faces."""
    jaw = arch(1.0)
    near = (
        np.linalg.norm(jaw.mesh.face_centres - jaw.mesh.face_centres[jaw.tooth_faces(TOOTH)].mean(axis=0), axis=1) < 12
    )
    return Jaw(
        mesh=jaw.mesh.submesh(near),
        face_labels=None if jaw.face_labels is None else jaw.face_labels[near],
        arch=jaw.arch,
        landmarks={"46.buccal_groove": Landmark(np.array([1.0, 2.0, 3.0]), None)},
    )


def verb(*arguments: str) -> Callable[[Path], None]:
    """A verb on the folder; ``@name`` stands for a file in it."""

    def use(folder: Path) -> None:
        cli.main([str(folder / each[1:]) if each.startswith("@") else each for each in arguments])

    return use


def _handpiece(folder: Path) -> None:
    storage.write_handpiece(folder / "handpiece.json", DESIGNS["four"]())
    storage.write_rig_config(folder / "rig_config.json", DESIGNS["two"]().rig)


def _meshes(folder: Path) -> None:
    jaw = small_jaw()
    storage.write_jaw(folder / "jaw.ply", jaw)
    storage.write_mesh(folder / "binary.stl", jaw.mesh)
    storage.write_mesh(folder / "mesh.obj", jaw.mesh)
    storage.write_mesh(folder / "mesh.off", jaw.mesh)
    loaded = trimesh.Trimesh(jaw.mesh.vertices, jaw.mesh.faces, process=False)
    (folder / "text.ply").write_bytes(loaded.export(file_type="ply", encoding="ascii"))
    (folder / "text.stl").write_text(str(loaded.export(file_type="stl_ascii")))
    np.save(folder / "text_facelabels.npy", np.full(len(jaw.mesh.faces), 46))


def _read_meshes(folder: Path) -> None:
    for path in sorted(folder.glob("*.*")):
        if path.suffix in storage.MESH_SUFFIXES:
            facing_outwards(storage.read_labelled_mesh(path)[0])
    storage.read_jaw(folder / "jaw.ply")


def _evaluate(folder: Path) -> None:
    """As the verb does, but for its pictures, which take the most time."""
    scan, against = storage.read_mesh(folder / "binary.stl"), pipeline.load_reference(folder / "text.ply")
    pipeline.evaluate(scan, against, EvaluationOptions(align=False, samples=2000))


def _study(folder: Path) -> None:
    """A manifest, and a reference with what lies beside it."""
    storage.write_mesh(folder / "m.stl", arch(1.6).mesh)
    (folder / "m.spheres.csv").write_text("label,x,y,z,radius\n36,1.5,-2,0.25,2.5\n46,20,3,1,2.5\n")
    (folder / "study.csv").write_text(
        "scanner,specimen,operator,file,reference\nA,m,x,1.stl,m.stl\nB,m,y,2.stl,m.stl\n"
    )


def _read_study(folder: Path) -> None:
    """As the verb does before it aligns scans."""
    found = find_files(folder / "study.csv")
    load_specimen("m", folder / "m.stl" if "m" not in found.references else found.references["m"])


def _units(folder: Path) -> None:
    """An arch in mm, and the same in text in whatever unit a damaged number makes of it."""
    mesh = arch(1.6).mesh
    storage.write_mesh(folder / "reference.stl", mesh)
    loaded = trimesh.Trimesh(mesh.vertices / 1000, mesh.faces, process=False)
    (folder / "metres.ply").write_bytes(loaded.export(file_type="ply", encoding="ascii"))


def _compare_units(folder: Path) -> None:
    """As the verb does until the surfaces are aligned."""
    for unit in ("m", "mm", "um"):
        with contextlib.suppress(CuspidError):
            scan = storage.read_mesh(folder / "metres.ply", unit)
            measured = storage.MeasuredFile(path=folder / "metres.ply", mesh=scan, unit=unit)
            pipeline.load_reference(folder / "reference.stl", scan=measured)


def _landmarks(folder: Path) -> None:
    points = small_jaw().landmarks
    storage.write_landmarks(folder / "own.json", points, "mesh")
    storage.write_landmarks(folder / "slicer.mrk.json", points, "mesh")


def _brief(folder: Path) -> None:
    (folder / "brief.toml").write_text(
        'name = "probe"\nsensor = "thesis"\nthickness_mm = 7.0\nworking_distance_mm = [4.5, 5.5]\n'
        "[mouth]\ntooth = 7\npeople = 0.95\n[surfaces]\nocclusal = 0.98\nbuccal = 0.9\n[cameras]\nmax = 12\n"
        "[motion]\nturns = 1\nturn_deg = 60.0\n[weights]\ncoverage = 1.0\nprecision = 1.0\ncameras = 0.3\n"
    )


def _demand(folder: Path) -> None:
    """A brief, and the jaw that it is for."""
    _brief(folder)
    storage.write_jaw(folder / "jaw.ply", small_jaw())


def _scan(folder: Path) -> None:
    write_scan(folder / "scan", small_jaw())


def _read_scan(folder: Path) -> None:
    scan = folder / "scan"
    capture = storage.read_capture(scan / "capture")
    for frame in capture.frames:
        capture.images(frame)
    storage.hash_capture(capture)
    storage.read_reconstruction(scan / "motion")
    storage.read_jaw(scan / "truth" / "jaw.ply")


def _images(folder: Path) -> None:
    rng = np.random.default_rng(0)
    write_frames(folder / "frames", [rng.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(2)])
    for suffix in ("jpg", "bmp", "tiff"):
        (folder / suffix).mkdir()
        for number in range(2):
            cv2.imwrite(str(folder / suffix / f"{number}.{suffix}"), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))


def _calibrations(folder: Path) -> None:
    write_frames(folder / "frames", [picture(seed) for seed in range(2)])
    for kind in ("json", "colmap", "opencv"):
        write_calibration(folder, kind)


def _read_calibrations(folder: Path) -> None:
    for name in ("camera.json", "cameras.txt", "camera.yml"):
        storage.read_sequence(folder / "frames", folder / _OUT, calibration=folder / name)


def _read_images(folder: Path) -> None:
    for name in ("frames", "jpg", "bmp", "tiff"):
        sequence = storage.read_sequence(folder / name, folder / _OUT)
        for path in sequence.paths:
            read_fine(path)


def _panorama(folder: Path) -> None:
    storage.write_panorama(folder / "panorama", small_panorama())


def _colmap(folder: Path) -> None:
    found = make_found()
    capture = make_capture(folder / "capture", found)
    for name, mounted in found.rig.cameras.items():
        black = np.zeros((mounted.camera.height, mounted.camera.width, 3), dtype=np.uint8)
        for frame in capture.frames:
            storage.write_image(image_path(capture, frame.name, name), black)
    storage.write_capture(folder / "capture", capture)
    write_colmap(without_rig(found), folder / "model")


def _shape(folder: Path) -> None:
    write_shape(folder / "shape", small_jaw())


def _evaluation(folder: Path) -> None:
    reference = folder / "reference.ply"
    storage.write_mesh(reference, small_jaw().mesh)
    write_evaluation(folder / "evaluation", small_jaw())
    settings, hashes = {"evaluation": {"samples": 100}}, {"reference": storage.hash_file(reference)}
    with storage.claimed_folder(folder / "evaluation", "evaluate", settings, hashes, replace=True):
        pass


def _studies(folder: Path) -> None:
    write_comparison(folder / "comparison", 3)
    write_score(folder / "score")


def _calibration(folder: Path) -> None:
    write_calibrated(folder / "calibration")


def _boards(folder: Path) -> None:
    kalibr = "target_type: aprilgrid\ntagCols: 3\ntagRows: 2\ntagSize: 0.02\ntagSpacing: 0.3\ncodeOffset: 9\n"
    (folder / "kalibr.yaml").write_text(kalibr)
    (folder / "boards.yaml").write_text("boards:\n- {kind: charuco, columns: 5, rows: 4, square_mm: 3, legacy: true}\n")


def _results(folder: Path) -> None:
    shutil.copytree(RESULTS, folder / "results", ignore=shutil.ignore_patterns("*opencv*", "0*", "*film*"))


def _arrays(folder: Path) -> None:
    storage.files.write_arrays(folder / "a.npz", {"one": np.arange(300), "other": np.eye(9)}, compressed=True)


def _probe(folder: Path) -> None:
    """A labelled jaw, and a handpiece with small images to scan it with."""
    storage.write_jaw(folder / "jaw.ply", small_jaw())
    verb("rig", "build", "--design", "four", "--width-px", "96", "--height-px", "96", "--out", "@.")(folder)


WATCHED = ("--watch", "--end-s", "0.4", "--late-s", "0", "--quality", "standard")
HOLDER = ("--out", f"@{_OUT}", "--body", f"@{_OUT}/holder.stl")
PROBE = ("--handpiece", "@handpiece.json", "--tooth", str(TOOTH))
BOARD = ("--columns", "6", "--rows", "5", "--square-mm", "1", "--instants", "1", "--supersampling", "1")
FILM = ("--handpiece", "@handpiece.json", "--frames", "3", "--supersampling", "1")
SHORT = ("--points", "10", "--samples", "1", "--finalists", "1", "--evaluations", "4")
SEARCH = ("--jaw", "@jaw.ply", "--teeth", str(TOOTH), *SHORT)
MEASURED = ("--distance", "3", "4", "36", "22", "47.5")
QUICK_STUDY = ("--samples", "1000", "--registration.samples", "1000", "--registration.search.anchors", "3")
QUICK_STUDY += ("--registration.search.targets", "100", "--registration.search.candidates", "20", "--dry-run")
SCAN = ("--frames", "2", "--length-mm", "0.8", "--supersampling", "1")


def _textured_capture(folder: Path) -> None:
    """A scan, of which the folder has what reconstruction is given."""
    with tempfile.TemporaryDirectory() as made:
        _probe(Path(made))
        verb("simulate", "@jaw.ply", *PROBE, *SCAN, "--out", "@scan")(Path(made))
        shutil.move(Path(made) / "scan" / "capture", folder)


_MESH = f"{_OUT}/mesh.ply"


@cache
def _scanned() -> Mapping[str, bytes]:
    """The files of a scan that nothing disturbed."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        _textured_capture(folder)
        verb("reconstruct", "@capture", "--out", f"@{_OUT}")(folder)
        return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _cut_short(folder: Path) -> None:
    """A scan that was killed before it had a mesh."""
    for name, content in _scanned().items():
        if name != _MESH:
            storage.write_bytes(folder / name, content)


def _resume(folder: Path) -> None:
    """The same mesh comes out, whatever became of files in between, unless the images are others."""
    verb("reconstruct", "@capture", "--out", f"@{_OUT}")(folder)
    whole = _scanned()
    capture = [name for name in whole if name.startswith("capture/")]
    if (folder / _MESH).read_bytes() != whole[_MESH] and all((folder / k).read_bytes() == whole[k] for k in capture):
        raise AssertionError("another mesh")


def _four_cameras(folder: Path) -> None:
    storage.write_handpiece(folder / "handpiece.json", DESIGNS["four"]())


def _arch(folder: Path) -> None:
    storage.write_jaw(folder / "jaw.ply", arch(1.0))


def _population(folder: Path) -> None:
    (folder / "jaws").mkdir()
    for seed in range(2):
        jaw = build_phantom(PhantomOptions(seed=seed, edge_mm=1.6))
        storage.write_jaw(folder / "jaws" / f"{seed}.ply", jaw)
        storage.write_landmarks(folder / "jaws" / f"{seed}.json", jaw.landmarks, "mesh")


def _filmed(folder: Path) -> None:
    """An arch, and a camera with small images to film it with."""
    _arch(folder)
    camera = intra_oral_camera(IntraOralOptions(width_px=96, height_px=72))
    storage.write_handpiece(folder / "handpiece.json", camera)


def _film(folder: Path) -> None:
    """Some small frames along the teeth."""
    jaw = arch(0.8)
    camera, curve = intra_oral_camera(IntraOralOptions(width_px=160, height_px=120)), arch_curve(jaw)
    poses = {f"{k:03d}": curve.rig_from_world(16.0 + 0.8 * k) for k in range(5)}
    take_images(jaw, camera, poses, folder / "film", RenderOptions(texture="artificial", supersampling=1))


def _photographs(folder: Path) -> None:
    whole = scene(0, Board(columns=6, rows=5, square_mm=3.0), cameras=2, instants=4)
    halved = {
        name: replace(
            undistorted(camera),
            width=camera.width // 2,
            height=camera.height // 2,
            focal_px=camera.focal_px / 2,
            principal_point_px=camera.principal_point_px / 2,
        )
        for name, camera in whole.cameras.items()
    }
    photographs(folder / "photos", replace(whole, cameras=halved), Board(columns=6, rows=5, square_mm=3.0))


def _labelled(folder: Path) -> None:
    """An arch whose labels run along it, and what they are."""
    jaw = arch(1.6)
    assert jaw.face_labels is not None
    row = [*range(37, 30, -1), *range(41, 48)]
    along = np.array([row.index(label) + 1 if label in row else 0 for label in jaw.face_labels.tolist()])
    storage.write_mesh(folder / "jaw_lower.ply", jaw.mesh, along)
    (folder / "map.json").write_text(json.dumps({str(number): fdi for number, fdi in enumerate(row, start=1)}))


def _read_labels(folder: Path) -> None:
    """As the verbs do that take a jaw, with and without the map."""
    for table in (None, folder / "map.json"):
        load_jaw(folder / "jaw_lower.ply", labelling=Labelling(label_map=table))


def _beside(folder: Path) -> None:
    """Images in folders with what systems put beside them."""
    _images(folder)
    for each in ("frames", "jpg"):
        (folder / each / "._0.png").write_bytes(b"Mac OS X")
        (folder / each / "@eaDir").mkdir()


def _facing(folder: Path) -> None:
    """An arch with every other face turned, and one that is inside out."""
    mesh = arch(1.6).mesh
    faces = mesh.faces.copy()
    faces[::2] = faces[::2, ::-1]
    for name, turned in (("half.ply", faces), ("inside.ply", mesh.faces[:, ::-1])):
        loaded = trimesh.Trimesh(mesh.vertices, turned, process=False)
        (folder / name).write_bytes(loaded.export(file_type="ply", encoding="ascii"))


def _read_facing(folder: Path) -> None:
    for name in ("half.ply", "inside.ply"):
        with contextlib.suppress(CuspidError):
            load_jaw(folder / name)


def _tiny(folder: Path) -> None:
    """Scans and a reference of next to nothing."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    for name, size, times in (("one", 4.0, 1), ("again", 4.0, 10), ("speck", 1e-30, 1), ("reference", 5.0, 1)):
        loaded = trimesh.Trimesh(size * corners, np.tile(faces, (times, 1)), process=False)
        (folder / f"{name}.ply").write_bytes(loaded.export(file_type="ply", encoding="ascii"))


def _evaluate_tiny(folder: Path) -> None:
    for name in ("one", "again", "speck"):
        with contextlib.suppress(CuspidError):
            scan, against = storage.read_mesh(folder / f"{name}.ply"), pipeline.load_reference(folder / "reference.ply")
            search = SearchOptions(anchors=2, targets=50, candidates=20, turn_step_deg=45.0)
            options = EvaluationOptions(samples=500, registration=RegistrationOptions(search=search, samples=200))
            pipeline.evaluate(scan, against, options)


def _image_types(folder: Path) -> None:
    """Images of every kind, some of them under the name of another."""
    rng = np.random.default_rng(0)
    grey, colours = (
        rng.integers(0, 1024, (40, 60), dtype=np.uint16),
        rng.integers(0, 1024, (40, 60, 3), dtype=np.uint16),
    )
    shown = (colours >> 2).astype(np.uint8)
    for suffix in ("png", "tiff"):
        cv2.imwrite(str(folder / f"grey.{suffix}"), grey)
        cv2.imwrite(str(folder / f"colours.{suffix}"), colours)
    cv2.imwrite(str(folder / "decimals.tiff"), grey.astype(np.float32) / 1023)
    cv2.imwrite(str(folder / "whole.tiff"), grey.astype(np.int32))
    exif = Image.Exif()
    exif[0x0112] = 6
    for name, kind in (("jpeg.png", "JPEG"), ("png.jpg", "PNG"), ("bmp.tiff", "BMP"), ("lying.png", "PNG")):
        Image.fromarray(shown).save(folder / name, format=kind, **({"exif": exif} if kind != "BMP" else {}))


def _read_image_types(folder: Path) -> None:
    for path in sorted(folder.iterdir()):
        with contextlib.suppress(CuspidError):
            size, image = image_size(path), read_image(path)
            if image.shape[1::-1] != size:
                raise AssertionError(f"{path.name} is {image.shape}, and was said to be {size}")


def _in_folders(folder: Path) -> None:
    """A capture whose cameras are named with a folder."""
    two = DESIGNS["two"]()
    cameras = {f"rig/{name}": mounted for name, mounted in two.rig.cameras.items()}
    handpiece = replace(two, rig=Rig(cameras), sensors={f"rig/{name}": each for name, each in two.sensors.items()})
    storage.write_handpiece(folder / "handpiece.json", handpiece)
    for name, mounted in cameras.items():
        size = (mounted.camera.height, mounted.camera.width, 3)
        storage.write_image(folder / "images" / name / "00000.png", np.zeros(size, np.uint8))


def _at_one_place(folder: Path) -> None:
    """Cameras that all stand where the first one does."""
    storage.write_jaw(folder / "jaw.ply", small_jaw())
    four = DESIGNS["four"]()
    first = next(iter(four.rig.cameras.values()))
    rig = Rig({name: replace(each, cam_from_rig=first.cam_from_rig) for name, each in four.rig.cameras.items()})
    storage.write_handpiece(folder / "handpiece.json", replace(four, rig=rig))


def _exchanged(folder: Path) -> None:
    """A scan of which the folders of two cameras are exchanged."""
    _textured_capture(folder)
    images = folder / "capture" / "images"
    one, other = sorted(images.iterdir())[:2]
    one.rename(images / "x")
    other.rename(one)
    (images / "x").rename(other)


def _strange_beside(folder: Path) -> None:
    """A scan into whose folders systems and cuspid itself have put something."""
    _textured_capture(folder)
    for camera in sorted((folder / "capture" / "images").iterdir()):
        (camera / ".part-x.png").write_bytes(b"unfinished")
        (camera / "._00000.png").write_bytes(b"Mac OS X")
        (camera / "@eaDir").mkdir()
        (camera / "loop").symlink_to(camera / "loop")
    (folder / "capture" / "images" / ".git").mkdir()


def _written_over(folder: Path) -> None:
    """Files of others, and a scan whose page might be written over them."""
    _scan(folder)
    storage.write_jaw(folder / "jaw.ply", small_jaw())
    (folder / "notes.txt").write_text("of mine")


def _write_over(folder: Path) -> None:
    for name in ("jaw.ply", "notes.txt"):
        before = (folder / name).read_bytes() if (folder / name).is_file() else None
        with contextlib.suppress(SystemExit, CuspidError):
            verb("report", "@scan", "--out", f"@{name}")(folder)
        if before is not None and (folder / name).read_bytes() != before:
            raise AssertionError(f"{name} was written over")


def _in_use(folder: Path) -> None:
    """Another run works in the folder: the verb says so, and writes nothing there."""
    (folder / _OUT).mkdir()
    descriptor = os.open(folder / _OUT, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        before = sorted(folder.rglob("*"))
        verb("rig", "photograph", "@handpiece.json", *BOARD, "--out", f"@{_OUT}")(folder)
    finally:
        os.close(descriptor)
        if sorted(folder.rglob("*")) != before:
            raise AssertionError("something was written where another run works")


def _in_little_memory(folder: Path) -> None:
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (held + (4 << 20), hard))
    try:
        verb("jaw", "measure", "@jaw.ply", "--out", f"@{_OUT}")(folder)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def on_terminal(encoding: str, use: Callable[[Path], object]) -> Callable[[Path], None]:
    """With what is printed going to a terminal of other letters."""

    def used(folder: Path) -> None:
        with (
            open(1, "w", encoding=encoding, closefd=False) as out,
            open(2, "w", encoding=encoding, closefd=False) as err,
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            use(folder)

    return used


def _into_a_full_output(folder: Path) -> None:
    """A full output is told, whatever was to be printed."""
    full = Path("/dev/full").open("w")  # noqa: SIM115 - what cannot be written cannot be closed either
    try:
        with contextlib.redirect_stdout(full):
            verb("rig", "visibility", "@jaw.ply", *PROBE, *SCAN[:4], "--out", f"@{_OUT}")(folder)
    finally:
        with contextlib.suppress(OSError):
            full.close()


def _footage(folder: Path) -> None:
    """Films of two cameras in two kinds of videos, images of a third one, and when they were taken."""
    verb("rig", "build", "--design", "four", "--width-px", "96", "--height-px", "96", "--out", "@.")(folder)
    names = storage.read_handpiece(folder / "handpiece.json").rig.names
    images = [cv2.resize(picture(seed), (96, 96)) for seed in range(4)]
    (folder / "footage").mkdir()
    for name, kind, code in ((names[0], "avi", "MJPG"), (names[1], "mp4", "mp4v")):
        film = cv2.VideoWriter(
            str(folder / "footage" / f"{name}.{kind}"), cv2.VideoWriter.fourcc(*code), 25.0, (96, 96)
        )
        for image in images:
            film.write(image)
        film.release()
    write_frames(folder / "footage" / names[2], images)
    rows = [f"{name},{number},{number / 25}" for name in names[:2] for number in range(4)]
    rows += [f"{names[2]},{number:03d},{number / 25 + 0.002}" for number in range(4)]
    (folder / "footage" / "times.csv").write_text("\n".join(["camera,frame,time", *rows]))


SETTINGS = ("rig build", "simulate", "reconstruct", "evaluate", "study scanners", "rig design", "calibrate")
_GIVEN = {"reconstruct": ("c",), "evaluate": ("m", "r"), "study scanners": ("f",)}
_GIVEN |= {"rig design": ("b",), "calibrate": ("i",)}


def _settings(folder: Path) -> None:
    """All options of some verbs."""
    for name in SETTINGS:
        into = ("--out", "x", "--write-config", f"@{name.replace(' ', '-')}.toml")
        verb(*name.split(), *_GIVEN.get(name, ()), *into)(folder)


def _read_settings(folder: Path) -> None:
    """Each as its verb does; what the first one says is written, too."""
    for name in SETTINGS:
        file = f"@{name.replace(' ', '-')}.toml"
        verb(*name.split(), *_GIVEN.get(name, ()), "--config", file, "--write-config", f"@{_OUT}.toml")(folder)
    verb("rig", "build", "--config", "@rig-build.toml", "--out", f"@{_OUT}")(folder)


CALIBRATIONS = {
    **dict.fromkeys(("rig_config.json", "transforms.json", "camchain.yaml", "camera_array.toml"), None),
    **dict.fromkeys(("stereo.xml", "stereo.json", "stereo.yml"), "opencv"),
    "stereoParams.json": "matlab",
    "anipose.toml": "anipose",
    "scene.xml": "metashape",
    "ros": "ros",
}
"""Files of other programs, and the formats that their names do not tell."""


def _other_calibrations(folder: Path) -> None:
    storage.write_handpiece(folder / "handpiece.json", DESIGNS["two"]())
    for name, kind in CALIBRATIONS.items():
        to = () if kind is None else ("--to", kind)
        verb("rig", "convert", "@handpiece.json", f"@{name}", *to)(folder)


def _convert(folder: Path) -> None:
    """Each into ours; after the last one that is refused, the others still are read."""
    refused = None
    for name in ("handpiece.json", *CALIBRATIONS):
        try:
            verb("rig", "convert", f"@{name}", f"@{_OUT}/{name.replace('.', '-')}.json", "--to", "handpiece")(folder)
        except SystemExit as ended:
            refused = ended
    if refused is not None:
        raise refused


def _scanners(folder: Path) -> None:
    """A small study: two scanners with a scan each, and a table of the same."""
    mesh = arch(1.6).mesh
    rng = np.random.default_rng(0)
    storage.write_mesh(folder / "given" / "reference" / "m.stl", mesh)
    rows = ["scanner,specimen,file,reference"]
    for scanner in "AB":
        scan = Mesh(mesh.vertices + rng.normal(0, 0.01, mesh.vertices.shape), mesh.faces)
        storage.write_mesh(folder / "given" / scanner / "m" / "1.stl", scan)
        rows.append(f"{scanner},m,{scanner}/m/1.stl,reference/m.stl")
    (folder / "given" / "study.csv").write_text("\n".join(rows))


def _study_scanners(given: str) -> Callable[[Path], None]:
    """As far as the table of what would be compared, without processes of its own, which take seconds to start."""

    def done(cases: Iterable[Case], work: Work, folder: Path, **_: object) -> tuple[()]:
        for case in cases:
            work(**case.parameters)
        return ()

    def use(folder: Path) -> None:
        with patch("cuspid.studies.scanners.study.run_grid", done):
            verb("study", "scanners", given, *QUICK_STUDY, "--out", f"@{_OUT}")(folder)

    return use


def _one_camera(folder: Path) -> None:
    """Photographs of one camera with a board beside the object."""
    images = photo_scene.scene(4).images.values()
    write_frames(folder / "photos", [cv2.resize(each, (240, 180), interpolation=cv2.INTER_AREA) for each in images])


def _stitched(folder: Path) -> None:
    write_stitched(folder / "panorama", stitched_panorama())


def _score(folder: Path) -> None:
    known = known_film(small_jaw())
    write_truth(known, folder)
    storage.write_panorama(folder / "panorama", known.panorama)


SCENARIOS: Mapping[str, Scenario] = {
    "handpiece": Scenario(_handpiece, lambda folder: storage.read_handpiece(folder / "handpiece.json")),
    "rig config": Scenario(_handpiece, lambda folder: storage.read_handpiece(folder / "rig_config.json", 5.0)),
    "meshes": Scenario(_meshes, _read_meshes),
    "landmarks": Scenario(_landmarks, lambda folder: [storage.read_landmarks(each) for each in folder.glob("*.json")]),
    "brief": Scenario(_brief, lambda folder: read_brief(folder / "brief.toml")),
    "scan": Scenario(_scan, _read_scan),
    "images": Scenario(_images, _read_images),
    "files of systems": Scenario(_beside, _read_images),
    "labels": Scenario(_labelled, _read_labels),
    "calibrations": Scenario(_calibrations, _read_calibrations),
    "panorama": Scenario(_panorama, lambda folder: storage.read_panorama(folder / "panorama")),
    "colmap": Scenario(_colmap, lambda folder: read_model(folder / "model", storage.read_capture(folder / "capture"))),
    "shape": Scenario(_shape, lambda folder: storage.read_shape_model(folder / "shape")),
    "arrays": Scenario(_arrays, lambda folder: storage.files.read_arrays(folder / "a.npz", remedy="make it again")),
    "study files": Scenario(_study, _read_study),
    "report of a scan": Scenario(_scan, verb("report", "@scan")),
    "report of an evaluation": Scenario(_evaluation, verb("report", "@evaluation", "--reference", "@reference.ply")),
    "report of a panorama": Scenario(_panorama, verb("report", "@panorama")),
    "report of a study": Scenario(_studies, verb("report", "@comparison")),
    "report of a score": Scenario(_studies, verb("report", "@score")),
    "report of a calibration": Scenario(_calibration, verb("report", "@calibration")),
    "report of a shape": Scenario(_shape, verb("report", "@shape")),
    "prepare": Scenario(
        _arch, verb("jaw", "prepare", "@jaw.ply", "--tooth", str(TOOTH), "--out", f"@{_OUT}.ply", "crack")
    ),
    "box": Scenario(_arch, verb("jaw", "box", "@jaw.ply", "--out", f"@{_OUT}.ply")),
    "mean shape": Scenario(_population, verb("jaw", "shape", "@jaws", "--max-rounds", "1", "--out", f"@{_OUT}")),
    "visibility": Scenario(_probe, verb("rig", "visibility", "@jaw.ply", *PROBE, *SCAN[:4], "--out", f"@{_OUT}")),
    "photograph": Scenario(_four_cameras, verb("rig", "photograph", "@handpiece.json", *BOARD, "--out", f"@{_OUT}")),
    "film": Scenario(_filmed, verb("pano", "film", "@jaw.ply", *FILM, "--out", f"@{_OUT}")),
    "design": Scenario(_demand, verb("rig", "design", "@brief.toml", *SEARCH, "--out", f"@{_OUT}")),
    "reproduce": Scenario(_results, verb("reproduce", "--results", "@results", "--no-run", "--out", f"@{_OUT}")),
    "evaluate": Scenario(_meshes, _evaluate),
    "face directions": Scenario(_facing, _read_facing),
    "tiny scans": Scenario(_tiny, _evaluate_tiny),
    "image types": Scenario(_image_types, _read_image_types),
    "cameras in folders": Scenario(_in_folders, storage.read_capture),
    "cameras at one place": Scenario(
        _at_one_place, verb("rig", "visibility", "@jaw.ply", *PROBE, *SCAN[:4], "--out", f"@{_OUT}"), is_good=False
    ),
    "exchanged cameras": Scenario(_exchanged, verb("reconstruct", "@capture", "--out", f"@{_OUT}"), is_good=False),
    "strange files beside": Scenario(_strange_beside, verb("live", "@capture", *WATCHED, "--out", f"@{_OUT}")),
    "files of others": Scenario(_written_over, _write_over),
    "folder in use": Scenario(_four_cameras, _in_use, is_good=False),
    "little memory": Scenario(_arch, _in_little_memory, is_good=None),  # a warm process may have enough
    "full output": Scenario(_probe, _into_a_full_output, is_good=False),
    "long names": Scenario(
        _four_cameras, verb("rig", "photograph", "@handpiece.json", *BOARD, "--out", f"@{'long' * 60}"), is_good=None
    ),
    **{
        f"terminal of {encoding}": Scenario(
            _arch, on_terminal(encoding, verb("jaw", "measure", "@jaw.ply", "--out", f"@{_OUT}"))
        )
        for encoding in ("ascii", "cp437", "latin-1")
    },
    "units": Scenario(_units, _compare_units),
    "measure": Scenario(_arch, verb("jaw", "measure", "@jaw.ply", "--out", f"@{_OUT}")),
    "simulate": Scenario(_probe, verb("simulate", "@jaw.ply", *PROBE, *SCAN, "--out", f"@{_OUT}")),
    "precision": Scenario(_probe, verb("rig", "precision", "@jaw.ply", *PROBE, "--out", f"@{_OUT}")),
    "mouth": Scenario(_four_cameras, verb("jaw", "mouth", "--handpiece", "@handpiece.json", "--out", f"@{_OUT}")),
    "holder": Scenario(_four_cameras, verb("rig", "build", "--handpiece", "@handpiece.json", *HOLDER)),
    "reconstruct": Scenario(_textured_capture, verb("reconstruct", "@capture", "--out", f"@{_OUT}")),
    "live": Scenario(_textured_capture, verb("live", "@capture", *WATCHED, "--out", f"@{_OUT}")),
    "resume": Scenario(_cut_short, _resume),
    "boards": Scenario(
        _boards, verb("rig", "target", "--board", "@boards.yaml", "@kalibr.yaml", "--out", f"@{_OUT}/board.svg")
    ),
    "calibrate": Scenario(
        _photographs,
        verb("calibrate", "@photos", "--columns", "6", "--rows", "5", "--square-mm", "3", "--out", f"@{_OUT}"),
    ),
    "record": Scenario(
        _footage,
        verb("record", "--cameras", "@footage/o1.avi", "@footage/o2.mp4", "@footage/o3", "--out", f"@{_OUT}"),
    ),
    "import": Scenario(
        _footage,
        verb("import", "@footage", "--handpiece", "@handpiece.json", "--sync", "times", "--out", f"@{_OUT}"),
    ),
    "settings": Scenario(_settings, _read_settings),
    "convert": Scenario(_other_calibrations, _convert),
    "study of scanners": Scenario(_scanners, _study_scanners("@given")),
    "study by a table": Scenario(_scanners, _study_scanners("@given/study.csv")),
    "photographs": Scenario(
        _one_camera,
        verb("reconstruct", "@photos", "--columns", "7", "--rows", "5", "--square-mm", "3", "--out", f"@{_OUT}"),
    ),
    "stitch": Scenario(_film, verb("pano", "stitch", "@film/capture/images/camera", "--out", f"@{_OUT}")),
    "stitch of a mesh": Scenario(
        _arch, verb("pano", "stitch", "--mesh", "@jaw.ply", "--view.mm-per-px", "2", "--out", f"@{_OUT}")
    ),
    "rescale": Scenario(_stitched, verb("pano", "rescale", "@panorama", *MEASURED, "--out", f"@{_OUT}")),
    "stitch-eval": Scenario(_score, verb("pano", "evaluate", "@panorama", "@truth", "--out", f"@{_OUT}")),
}


# --- damage -------------------------------------------------------------------------------------------------------


NUMBERS = ("0", "-1", "1e9", "1e30", "1e999", "-1e308", "nan", "inf", "4000000000", "9" * 400, "0.5", "1e-300")
VALUES: tuple[Any, ...] = (
    *(None, True, "", "x", "../../x", "/etc/x", "a\nb", "\x00", "\x1b[31m", [], {}, [[]], {"a": 1}, -1, 0, 0.5),
    *(1e9, 1e30, 1e308, 10**30, 10**400, float("nan"), float("inf"), [1, 2], [[1, 2], [3]], "1", [None] * 3),
)


def damaged(data: bytes, rng: np.random.Generator, suffix: str) -> bytes:
    """Contents with one to three things wrong."""
    for _ in range(int(rng.integers(1, 4))):
        ways: list[Callable[[bytes, np.random.Generator], bytes]] = [_flipped, _cut, _removed, _inserted, _repeated]
        if suffix in (".json", ".toml", ".txt", ".yml", ".csv", ".obj", ".off", ".stl", ".ply", ".jsonl"):
            ways += 4 * [_renumbered]
        if suffix == ".json":
            ways += 9 * [_revalued]
        if suffix == ".toml":
            ways += 9 * [_reset]
        data = ways[rng.integers(len(ways))](data, rng)
    return data


def _flipped(data: bytes, rng: np.random.Generator) -> bytes:
    changed = np.frombuffer(data, np.uint8).copy()
    # Headers are short and mean the most.
    reach = len(changed) if rng.random() < 0.5 else min(len(changed), 200)
    for at in rng.integers(0, max(1, reach), int(rng.integers(1, 9))) if reach else ():
        changed[at] ^= 1 << rng.integers(8) if rng.random() < 0.5 else rng.integers(256)
    return changed.tobytes()


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(0, len(data) + 1))]


def _removed(data: bytes, rng: np.random.Generator) -> bytes:
    first, last = np.sort(rng.integers(0, len(data) + 1, 2))
    return data[:first] + data[min(last, first + 300) :]


def _inserted(data: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(0, len(data) + 1))
    new = (b"\0" * 40, b"\xff" * 40, b"[" * 200_000, rng.bytes(40), b"\n", b" 1e999 ", "\u202e\x1b[31m".encode())
    return data[:at] + new[rng.integers(len(new))] + data[at:]


def _repeated(data: bytes, rng: np.random.Generator) -> bytes:
    first, last = np.sort(rng.integers(0, len(data) + 1, 2))
    return data[:last] + data[first : min(last, first + 2000)] + data[last:]


def _renumbered(data: bytes, rng: np.random.Generator) -> bytes:
    found = list(re.finditer(rb"-?\d+(?:\.\d+)?(?:e-?\d+)?", data[:20_000]))
    if not found:
        return data
    one = found[rng.integers(len(found))]
    return data[: one.start()] + NUMBERS[rng.integers(len(NUMBERS))].encode() + data[one.end() :]


def _revalued(data: bytes, rng: np.random.Generator) -> bytes:
    """One place of a JSON value replaced, removed or renamed."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return data
    places: list[tuple[Any, Any]] = []
    left = [value]
    while left:
        each = left.pop()
        inner = list(each.items()) if isinstance(each, dict) else []
        inner = list(enumerate(each)) if isinstance(each, list) else inner
        places += [(each, key) for key, _ in inner]
        left += [item for _, item in inner]
    if not places:
        return json.dumps(VALUES[rng.integers(len(VALUES))]).encode()
    holder, key = places[rng.integers(len(places))]
    way = rng.random()
    if way < 0.15:
        del holder[key]
    elif way < 0.3 and isinstance(holder, dict):
        holder[str(VALUES[rng.integers(len(VALUES))])] = holder.pop(key)
    else:
        holder[key] = VALUES[rng.integers(len(VALUES))]
    return json.dumps(value).encode()


def _reset(data: bytes, rng: np.random.Generator) -> bytes:
    """A line of a TOML file with another value or name, or twice."""
    lines = data.decode(errors="surrogateescape").split("\n")
    at = int(rng.integers(len(lines)))
    name, _, value = lines[at].partition(" = ")
    other = json.dumps(VALUES[rng.integers(len(VALUES))])
    way = rng.random()
    if way < 0.15:
        lines.insert(at, lines[at])
    elif way < 0.3:
        lines[at] = f"{other} = {value}"
    else:
        lines[at] = f"{name} = {other}"
    return "\n".join(lines).encode(errors="surrogateescape")


def damage(folder: Path, rng: np.random.Generator) -> str:
    """Damage one file of a folder, or put something else in its place; what was done."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    path = files[rng.integers(len(files))]
    way = rng.random()
    if way < 0.9:
        path.write_bytes(damaged(path.read_bytes(), rng, path.suffix))
        return f"damaged {path.relative_to(folder)}"
    other = files[rng.integers(len(files))].read_bytes()
    path.unlink()
    if way < 0.92:
        return f"removed {path.relative_to(folder)}"
    if way < 0.94:
        path.mkdir()
    elif way < 0.95:
        os.mkfifo(path)
    elif way < 0.97:
        path.symlink_to("/dev/zero")
    else:
        path.write_bytes(other)
    return f"replaced {path.relative_to(folder)}"


# --- what came of it ----------------------------------------------------------------------------------------------


class Hung(BaseException):
    """Not an Exception, so that nothing takes it for an error of a file."""


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Ends what takes too long or too much memory."""

    def hung(number: int, frame: FrameType | None) -> None:
        raise Hung

    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = {each: signal.signal(each, hung) for each in (signal.SIGALRM, signal.SIGPROF)}
    resource.setrlimit(resource.RLIMIT_AS, (held + MOST_BYTES, hard))
    signal.setitimer(signal.ITIMER_REAL, LONGEST_WAIT_S)
    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        for number, old in before.items():
            signal.signal(number, old)


@contextlib.contextmanager
def captured(into: Path) -> Iterator[None]:
    """What is printed, by C libraries too, goes to a file."""
    saved = os.dup(1), os.dup(2)
    with into.open("wb") as stream:
        os.dup2(stream.fileno(), 1)
        os.dup2(stream.fileno(), 2)
        try:
            with (
                contextlib.redirect_stdout(open(1, "w", closefd=False)),
                contextlib.redirect_stderr(open(2, "w", closefd=False)),
            ):
                yield
        finally:
            for number, old in enumerate(saved, start=1):
                os.dup2(old, number)
                os.close(old)


def wrong_with(use: Callable[[], object], said: Path) -> str | None:
    """What is wrong with how damaged input was taken; None where nothing is."""
    message, status = "", 0
    warnings.filterwarnings("ignore", module="PIL")  # as the command line does, for what reads without it
    try:
        with captured(said), limited():
            try:
                use()
            except CuspidError as error:
                message = str(error)
            except SystemExit as ended:
                status = ended.code if isinstance(ended.code, int) else 9
    except Hung:
        return f"more than {LONGEST_S:g} s"
    except BaseException as error:
        return f"{type(error).__name__}: {error}"[:300]
    printed = said.read_text(errors="replace").replace(f"{_SOURCES}/", "")
    lines = [line for line in printed.splitlines() if line.startswith("cuspid: ")]
    if noise := _NOISE.search(printed):
        return f"noise: {printed[max(0, noise.start() - 80) : noise.end() + 80]!r}"
    left_out = status == 2 and "Missing from cuspid" in printed  # an option that must be given: how it is used is shown
    if not left_out and (status not in (0, 1) or (status == 1 and len(lines) != 1)):
        return f"status {status} and {len(lines)} lines: {printed[-3000:]!r}"
    for line in (message, *lines):
        if not line.isprintable() or len(line) > 500:
            return f"not one short line: {line[:600]!r}"
    return None


def _use_good(scenario: Scenario, folder: Path) -> None:
    refused = False
    try:
        scenario.use(folder)
    except (CuspidError, SystemExit):
        if scenario.is_good:
            raise
        refused = True
    if scenario.is_good is False and not refused:
        raise AssertionError("what must be refused is taken")


class Fuzzer:
    """Makes the good folders once, and a damaged copy for each case."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def good(self, name: str) -> Path:
        """The undamaged files of a scenario, read once: what is compiled at its first use takes no case's time."""
        there = self.folder / "good" / name
        if not there.exists():
            there.mkdir(parents=True)
            with (
                tempfile.TemporaryDirectory(dir=self.folder, prefix="first-") as made,
                captured(Path(made) / "said.txt"),
            ):
                SCENARIOS[name].make(there)
                first = Path(made) / name
                shutil.copytree(there, first, symlinks=True)
                _use_good(SCENARIOS[name], first)
        return there

    def case(self, name: str, seed: int) -> tuple[str, str | None]:
        """What was done to the files, and what is wrong with what came of it."""
        good = self.good(name)
        with tempfile.TemporaryDirectory(dir=self.folder, prefix="case-") as made:
            inner = Path(made) / "a" / "b"
            shutil.copytree(good, inner, symlinks=True)
            what = damage(inner, np.random.default_rng([seed, *name.encode()]))
            before = set(Path(made).rglob("*"))
            wrong = wrong_with(lambda: SCENARIOS[name].use(inner), Path(made) / "said.txt")
            new = set(Path(made).rglob("*")) - before - {Path(made) / "said.txt"}
            outside = [path for path in new if not path.is_relative_to(inner)]
            unfinished = [path for path in new if path.name.startswith(storage.PART)]
            if wrong is None and (outside or unfinished):
                wrong = f"left {[str(path) for path in (*outside, *unfinished)][:3]}"
            return what, wrong
