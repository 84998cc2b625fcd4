"""Before long work it is said how much is to come, how long it takes here, and what takes less."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cuspid import pipeline
from cuspid.handpiece.designs import DesignOptions, essential_four
from cuspid.jaw import Jaw
from cuspid.simulation import stage
from cuspid.simulation.path.scan import ScanPathOptions, plan_scan_path


def rendered(images: int, total: int, seconds: float, before: int = 0) -> Iterator[tuple[int, int]]:
    """As if each image took so long; some were there before."""
    for done in range(before + 1, before + images + 1):
        time.sleep(seconds)
        yield done, total


def test_the_time_is_that_of_the_first_images(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", logger="cuspid"):
        steps = list(stage._foretold(rendered(20, 40_020, 0.005, before=20), ["one", "two"]))
    assert steps == [(done, 40_020) for done in range(21, 41)]
    (told,) = caplog.messages
    minutes = float(told.split("about ")[1].split(" min")[0])
    assert 40_000 * 0.005 / 60 - 1 < minutes < 3 * 40_000 * 0.005 / 60
    assert "of 40,020 images are to come" in told
    assert told.endswith("; for less: one, two")


def test_short_work_offers_nothing_shorter(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", logger="cuspid"):
        list(stage._foretold(rendered(60, 60, 0.0), ["one"]))
        list(stage._foretold(rendered(1, 1, 0.0), ["one"]))
    (told,) = caplog.messages
    assert "of 60 images are to come, about 0 s here" in told
    assert "for less" not in told


def test_the_forecast_of_fewer_passes_is_about_right(coarse_phantom: Jaw) -> None:
    four, options = essential_four(), ScanPathOptions(tooth=31, passes="auto", length_mm=12.0)
    path, alone = (
        plan_scan_path(coarse_phantom, four, each, np.random.default_rng(0))
        for each in (options, ScanPathOptions(tooth=31, length_mm=12.0))
    )
    kept = len(path.rig_from_world) - path.further_frames
    assert path.further_frames > 0
    passes, _ = stage._less(path)
    assert f"about {kept / len(path.rig_from_world):.0%}" in passes
    assert kept == pytest.approx(len(alone.rig_from_world), abs=0.3 * len(alone.rig_from_world))
    assert alone.further_frames == 0


def test_a_simulation_tells_what_is_to_come(
    coarse_phantom: Jaw, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tiny = essential_four(DesignOptions(width_px=16, height_px=16))
    options = pipeline.SimulationOptions(supersampling=1, path=ScanPathOptions(tooth=46))
    with caplog.at_level("INFO", logger="cuspid"):
        pipeline.simulate(coarse_phantom, tiny, tmp_path, options)
    (told,) = [message for message in caplog.messages if message.startswith("simulation: ")]
    assert "of 40 images are to come, about " in told
