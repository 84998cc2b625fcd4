"""Before long work it is said how much is to come, how long it takes here, and what takes less."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cuspid.handpiece.designs import DesignOptions, essential_four
from cuspid.model.jaw import Jaw
from cuspid.pipeline import scan as pipeline
from cuspid.runtime.workers import usable_cores
from cuspid.simulation import stage
from cuspid.simulation.path.scan import ScanPathOptions, plan_scan_path


class Clock:
    """Goes on only while something is rendered."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seconds = 0.0
        monkeypatch.setattr(stage, "time", SimpleNamespace(perf_counter=lambda: self.seconds))

    def rendered(self, images: int, total: int, each_s: float, before: int = 0) -> Iterator[tuple[int, int]]:
        """Each image takes so long, the very first ones longer; some were there before."""
        for done in range(before + 1, before + images + 1):
            self.seconds += each_s if done > before + usable_cores() else 100.0
            yield done, total


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def test_the_time_is_that_of_the_first_images(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    timed = 4 * usable_cores()
    with caplog.at_level("INFO", logger="cuspid"):
        steps = list(stage._log_expected_time(clock.rendered(timed + 9, 1220, 0.5, before=20), ["one", "two"]))
    assert steps == [(done, 1220) for done in range(21, timed + 30)]
    left = 1200 - timed
    assert caplog.messages == [
        f"simulation: {left:,} of 1,220 images are to come, about {left / 120:.0f} min here; for less: one, two"
    ]


def test_short_work_offers_nothing_shorter(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    images = 40 * usable_cores()
    with caplog.at_level("INFO", logger="cuspid"):
        list(stage._log_expected_time(clock.rendered(images, images, 0.01), ["one"]))
        list(stage._log_expected_time(clock.rendered(1, 1, 0.01), ["one"]))
    (told,) = caplog.messages
    assert told.endswith(f"of {images} images are to come, about {0.01 * 36 * usable_cores():.0f} s here")


def test_the_forecast_of_fewer_passes_is_about_right(coarse_phantom: Jaw) -> None:
    four, options = essential_four(), ScanPathOptions(tooth=31, passes="auto", length_mm=12.0)
    path, alone = (
        plan_scan_path(coarse_phantom, four, each, np.random.default_rng(0))
        for each in (options, ScanPathOptions(tooth=31, length_mm=12.0))
    )
    kept = len(path.rig_from_world) - path.further_frames
    assert path.further_frames > 0
    passes, _ = stage._cheaper_settings(path)
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
