"""Stored results are used again under the key of what made them, and under no other."""

from __future__ import annotations

import logging
import os
import resource
from dataclasses import dataclass
from pathlib import Path

import pytest

from cuspid import storage
from cuspid.handpiece.designs import DesignOptions, twelve_cameras
from cuspid.model.arch_curve import arch_curve
from cuspid.model.jaw import Jaw
from cuspid.pipeline.scan import RenderOptions, take_images
from cuspid.runtime.errors import InputError, OutputError
from cuspid.storage.captures import hash_capture
from cuspid.storage.stages import RECORD, Stage, _installed_code, code_version


@dataclass(frozen=True)
class Options:
    """Of a stage."""

    size: float = 1.0


class Maker:
    """Writes a file, and counts how often."""

    def __init__(self, file: Path) -> None:
        self.file, self.calls = file, 0

    def __call__(self) -> None:
        self.calls += 1
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.file.write_text(f"result {self.calls}")


@pytest.fixture
def maker(tmp_path: Path) -> Maker:
    return Maker(tmp_path / "made" / "result.txt")


def made_again(maker: Maker, stage: Stage, **inputs: str) -> bool:
    """Whether the stage makes its result anew."""
    before = maker.calls
    stage.make(inputs, [maker.file], maker)
    return maker.calls > before


def test_a_result_is_made_once_and_again_only_when_something_changed(maker: Maker) -> None:
    folder = maker.file.parent
    assert made_again(maker, Stage("cut", folder, Options()), images="a")
    assert not made_again(maker, Stage("cut", folder, Options()), images="a")
    assert made_again(maker, Stage("cut", folder, Options(size=1.5)), images="a")
    assert made_again(maker, Stage("cut", folder, Options(size=1.5)), images="b")
    assert made_again(maker, Stage("cut", folder, Options(size=1.5)), images="b", more="c")
    assert made_again(maker, Stage("paste", folder, Options(size=1.5)), images="b", more="c")
    assert made_again(maker, Stage("paste", folder, Options(size=1.5), ("cuspid.model.mesh",)), images="b", more="c")
    assert not made_again(
        maker, Stage("paste", folder, Options(size=1.5), ("cuspid.model.mesh",)), images="b", more="c"
    )


@pytest.mark.parametrize("damage", [b"", b"result 2", b"resul"])
def test_a_damaged_result_is_made_again_and_told(maker: Maker, caplog: pytest.LogCaptureFixture, damage: bytes) -> None:
    stage = Stage("cut", maker.file.parent, Options())
    made_again(maker, stage)
    maker.file.write_bytes(damage)
    with caplog.at_level(logging.INFO, logger="cuspid"):
        assert made_again(maker, stage)
    assert "result.txt: damaged; making it again" in caplog.text
    assert not made_again(maker, stage)


def test_a_lost_result_is_made_again(maker: Maker) -> None:
    stage = Stage("cut", maker.file.parent, Options())
    made_again(maker, stage)
    maker.file.unlink()
    assert made_again(maker, stage)


def test_a_file_that_no_stage_has_made_is_not_taken_for_a_result(maker: Maker) -> None:
    """As one that was written by a run that was killed before it could record it."""
    maker()
    assert made_again(maker, Stage("cut", maker.file.parent, Options()))


def test_a_record_that_was_cut_short_costs_its_last_line_alone(tmp_path: Path) -> None:
    stage = Stage("cut", tmp_path, Options())
    makers = [Maker(tmp_path / f"{number}.txt") for number in range(3)]
    for each in makers:
        stage.make({}, [each.file], each)
    record = tmp_path / RECORD
    record.write_text(record.read_text()[:-40] + "\n[1, 2]\nnonsense\n{}\n")
    again = Stage("cut", tmp_path, Options())
    assert [made_again(each, again) for each in makers] == [False, False, True]


def test_a_record_that_is_no_file_is_told_and_nothing_waits_for_it_or_goes_elsewhere(tmp_path: Path) -> None:
    for number, replace in enumerate((Path.mkdir, os.mkfifo)):
        folder = tmp_path / str(number)
        folder.mkdir()
        begun = Stage("cut", folder, Options())
        replace(folder / RECORD)
        with pytest.raises(InputError, match=RECORD):
            Stage("cut", folder, Options())
        with pytest.raises(OutputError, match=f"{RECORD}: is a link, a folder, a pipe"):
            begun.record("key", [])
    elsewhere = tmp_path / "elsewhere"
    elsewhere.touch()
    for folder in (tmp_path / "link", tmp_path / "lost"):
        folder.mkdir()
        (folder / RECORD).symlink_to(elsewhere if folder.name == "link" else tmp_path / "nowhere")
        with pytest.raises(OutputError, match=f"{RECORD}: is a link"):
            Stage("cut", folder, Options()).record("key", [])
    assert elsewhere.read_bytes() == b""
    assert not (tmp_path / "nowhere").exists()


def test_a_record_that_cannot_be_written_leaves_no_empty_file(tmp_path: Path) -> None:
    file = tmp_path / "result.txt"
    file.touch()
    stage, (soft, hard) = Stage("cut", tmp_path, Options()), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        with pytest.raises(OutputError, match="cannot be written"):
            stage.record("key", [file])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path.name for path in tmp_path.iterdir()] == ["result.txt"]
    stage.record("key", [file])
    assert stage.has("key", [file])


def test_the_version_of_the_code_tells_its_parts_apart() -> None:
    parts = [(), ("cuspid.mvs.stage",), ("cuspid.motion.stage",), ("cuspid.mvs.stage", "cuspid.motion.stage")]
    assert len({code_version(*each) for each in parts}) == len(parts)
    with pytest.raises(LookupError, match="stereo"):
        code_version("stereo")


@pytest.mark.parametrize("stage", ["footage", "motion", "simulation", "mvs", "fusion"])
def test_a_stage_depends_on_what_it_uses_and_not_on_what_stands_above_it(stage: str) -> None:
    used = _installed_code().modules([f"cuspid.{stage}.stage"])
    assert f"cuspid.{stage}.stage" in used
    assert len(used) > 20
    above = ("cuspid.cli", "cuspid.pipeline", "cuspid.studies", "cuspid.report")
    assert not [each for each in used if each.startswith(above)]


def test_a_capture_is_the_same_in_memory_as_on_disk(tmp_path: Path, coarse_phantom: Jaw) -> None:
    """Whose rotations change in their last bit when they are written: a scan would be made anew by the next command."""
    handpiece = twelve_cameras(DesignOptions(width_px=64, height_px=64))
    poses = {"00000": arch_curve(coarse_phantom).rig_from_world(30.0)}
    capture, _ = take_images(coarse_phantom, handpiece, poses, tmp_path, RenderOptions(supersampling=1))
    assert hash_capture(capture) == hash_capture(storage.read_capture(tmp_path / "capture"))
