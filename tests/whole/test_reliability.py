"""What systems, terminals and people do to files and folders is taken, or told in one line."""

import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from builders import box_mesh, handpiece, make_capture, rig_of, shifted
from cuspid import cli, storage
from cuspid.anatomy.jaw_files import jaw_files
from cuspid.model.rig import MountedCamera
from cuspid.report.same_origin import address, require_address
from cuspid.runtime import kernels
from cuspid.runtime.errors import InputError, OutputError
from cuspid.runtime.inputs import is_there
from cuspid.storage.files import list_finished
from panoramas import stitched_panorama, write_stitched
from verbs import refused, run

BESIDE = ("._00.png", ".DS_Store", ".git", "@eaDir", "__MACOSX", "Thumbs.db", ".part-x.png")


def test_what_systems_put_beside_files_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / "00.png").write_bytes(b"")
    for name in BESIDE:
        (tmp_path / name).mkdir() if "." not in name[1:] else (tmp_path / name).write_bytes(b"no image")
    assert [path.name for path in list_finished(tmp_path)] == ["00.png"]
    (tmp_path / "._jaw.stl").write_bytes(b"Mac OS X")
    storage.write_mesh(tmp_path / "jaw.stl", box_mesh())
    assert [path.name for path in jaw_files(tmp_path)] == ["jaw.stl"]


def test_a_capture_may_have_them_too(tmp_path: Path) -> None:
    capture = make_capture(tmp_path)
    first = sorted((tmp_path / "images").iterdir())[0]
    for folder in (tmp_path / "images", first):
        (folder / "@eaDir").mkdir()
        (folder / "._x.png").write_bytes(b"Mac OS X")
    assert storage.read_capture(tmp_path).frames == capture.frames


def test_a_damaged_strip_is_told_before_anything_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_stitched(tmp_path / "panorama", stitched_panorama())
    (tmp_path / "panorama" / "strip.json").write_text('{"mm_per_px": 0.05, "width_px": 4}')
    (tmp_path / "panorama" / "strip.csv").write_text("column,along,x,y\n")
    (tmp_path / "panorama" / "strip.png").write_bytes(b"\x89PNG no picture")
    asked = ("pano", "rescale", tmp_path / "panorama", "--distance", 3, 4, 36, 22, 47.5, "--out", tmp_path / "out")
    assert "strip.png" in refused(capsys, *asked)
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is closed to root")
def test_a_folder_that_may_not_be_entered_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "closed").mkdir(mode=0)
    assert "closed" in refused(capsys, "pano", "stitch", tmp_path / "closed", "--out", tmp_path / "out")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            PermissionError(13, "Permission denied", "/x/closed"),
            "/x/closed: cannot be used (Permission denied)",
        ),
        (OSError(36, "File name too long", "/x/long"), "/x/long: cannot be used (File name too long)"),
        (MemoryError("Unable to allocate 309. GiB for an array"), "not enough memory (Unable to allocate 309. GiB"),
        (MemoryError(), "not enough memory (for this size)"),
        (ImportError("a.so: failed to map segment from shared object"), "not enough memory (a.so: failed to map"),
        (RuntimeError("can't start new thread"), "not enough memory (can't start new thread)"),
    ],
)
def test_what_the_system_refuses_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception, said: str
) -> None:
    def fail(*given: object, **options: object) -> None:
        raise error

    monkeypatch.setattr(cli, "_run", fail)
    assert said in refused(capsys, "rig", "optics", alone=True)


def test_what_failed_leaves_no_trace(tmp_path: Path) -> None:
    for error in (MemoryError(), PermissionError(), InputError("no")):
        with pytest.raises(type(error)), storage.claimed_folder(tmp_path / "out", "test", {}, {}):
            raise error
        assert not (tmp_path / "out").exists()


WORKING = """
import sys, time
from pathlib import Path
from cuspid import storage
with storage.claimed_folder(Path(sys.argv[1]), "test", {"a": 1}, {}):
    print("works", flush=True)
    sys.stdin.read()
"""


def test_two_runs_in_one_folder_do_not_mix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if they are alike; when the first has ended the other may go on, and in one process stages follow."""
    monkeypatch.setattr("cuspid.storage.files._PATIENCE_S", 0.1)
    out = tmp_path / "out"
    first = subprocess.Popen([sys.executable, "-c", WORKING, str(out)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert first.stdin is not None
    assert first.stdout is not None
    assert first.stdout.readline() == b"works\n"
    for value in (1, 2):
        with (
            pytest.raises(OutputError, match="another run of cuspid works there"),
            storage.claimed_folder(out, "test", {"a": value}, {}),
        ):
            pass
    assert (out / "run.json").exists()
    first.stdin.close()
    assert first.wait(60) == 0
    with storage.claimed_folder(out, "test", {"a": 1}, {}), storage.claimed_folder(out, "other", {}, {}):
        pass
    assert [path.name for path in out.iterdir()] == ["run.json"]


def test_names_that_are_too_long_are_none(tmp_path: Path) -> None:
    path = tmp_path / f"{'x' * 240}.ply"
    assert not is_there(path.with_name(f"{path.stem}_facelabels.npy"))
    storage.write_mesh(path, box_mesh())
    assert len(storage.read_labelled_mesh(path)[0].faces) == 12
    assert not storage.is_jaw(path)


def test_kernels_work_where_nothing_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(function: object) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(kernels, "_KernelCache", nowhere)

    def twice(x):
        return 2 * x

    assert kernels.kernel(twice)(21.0) == 42.0


@pytest.mark.long
@pytest.mark.parametrize("encoding", ["latin-1", "cp437", "cp850", "ascii"])
def test_any_terminal_shows_tables(tmp_path: Path, encoding: str) -> None:
    said = subprocess.run(
        [sys.executable, "-m", "cuspid", "rig", "optics"],
        env={**os.environ, "PYTHONIOENCODING": encoding},
        capture_output=True,
        check=True,
    )
    assert b"Miniature cameras" in said.stdout
    assert b"Traceback" not in said.stderr


@pytest.mark.long
@pytest.mark.parametrize("how", [">&-", "> /dev/full", ">&- 2>&-"])
def test_output_may_go_nowhere(tmp_path: Path, how: str) -> None:
    command = f"{sys.executable} -m cuspid rig optics --out {tmp_path / 'table.csv'} {how}"
    said = subprocess.run(["/bin/sh", "-c", command], capture_output=True, check=False)
    assert (tmp_path / "table.csv").exists()
    assert b"Traceback" not in said.stderr
    assert said.returncode == (1 if "full" in how else 0)
    assert (b"what is printed cannot be written (No space left on device)" in said.stderr) == ("full" in how)


def test_addresses_are_tried_and_written_as_browsers_take_them() -> None:
    require_address("127.0.0.1")
    for host in ("203.0.113.1", "no.such.host.invalid", "a" * 300):
        with pytest.raises(InputError, match="cannot listen there"):
            require_address(host)
    assert address("::1", 8501) == "http://[::1]:8501"
    assert address("127.0.0.1", 80) == "http://127.0.0.1:80"
    assert socket.has_ipv6 in (True, False)


def test_what_a_writer_writes_a_reader_reads(tmp_path: Path) -> None:
    """Covariances of any rounding: not quite symmetric, and with eigenvalues that are not quite zero."""
    rng = np.random.default_rng(0)
    for seed in range(20):
        root = rng.normal(size=(8, 3)) * np.logspace(-6, 3, 8)[rng.permutation(8), None]
        lens = root @ root.T
        lens += 1e-5 * rng.normal(size=(8, 8)) * np.sqrt(np.outer(np.diag(lens), np.diag(lens)))
        place = 1e-7 * (np.eye(6) + 1e-4 * rng.normal(size=(6, 6)))
        device = handpiece("a", "b")
        cameras = {
            name: MountedCamera(replace(each.camera, covariance=lens), each.cam_from_rig, place)
            for name, each in device.rig.cameras.items()
        }
        storage.write_handpiece(tmp_path / f"{seed}.json", device.with_cameras(type(device.rig)(cameras)))
        again = storage.read_handpiece(tmp_path / f"{seed}.json").rig
        for mounted in again.cameras.values():
            spread = np.sqrt(np.outer(np.diag(lens), np.diag(lens)))
            assert np.abs(np.asarray(mounted.camera.covariance) - lens).max() < 1e-3 * spread.max()


def test_cameras_at_one_place_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there = replace(handpiece("a", "b"), rig=rig_of(a=shifted(1.0), b=shifted(1.0)))
    storage.write_handpiece(tmp_path / "handpiece.json", there)
    for verb in (["simulate"], ["rig", "visibility"]):
        said = refused(capsys, *verb, "--handpiece", tmp_path / "handpiece.json", "--out", tmp_path / "out")
        assert "all 2 cameras are at one place" in said
    assert not (tmp_path / "out").exists()


def test_a_camera_in_a_folder_is_read_where_it_is_written(tmp_path: Path) -> None:
    capture = make_capture(tmp_path)
    names = capture.handpiece.rig.names
    for name in names:
        (tmp_path / "images" / "rig").mkdir(exist_ok=True)
        (tmp_path / "images" / name).rename(tmp_path / "images" / "rig" / name)
    cameras = {f"rig/{name}": each for name, each in capture.handpiece.rig.cameras.items()}
    moved = capture.handpiece.with_cameras(type(capture.handpiece.rig)(cameras))
    frames = tuple(replace(each, cameras=tuple(f"rig/{name}" for name in each.cameras)) for each in capture.frames)
    storage.write_capture(tmp_path, replace(capture, handpiece=moved, frames=frames))
    assert storage.read_capture(tmp_path).frames == frames
    (tmp_path / "images" / "rig" / "other").mkdir()
    with pytest.raises(InputError, match="matches the folder rig/other"):
        storage.read_capture(tmp_path)


def test_files_of_another_kind_are_not_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = tmp_path / "mesh.ply"
    storage.write_mesh(mesh, box_mesh())
    before = mesh.read_bytes()
    assert "ends in .html or .htm" in refused(capsys, "report", tmp_path, "--out", mesh)
    assert "ends in .csv" in refused(capsys, "rig", "optics", "--out", mesh)
    assert "was not written by cuspid" in refused(capsys, "jaw", "phantom", "--edge-mm", 2, "--out", mesh)
    assert mesh.read_bytes() == before
    run("rig", "optics", "--out", tmp_path / "table.csv")
