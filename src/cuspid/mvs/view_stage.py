"""Depth of views of any frames, kept on disk view by view: matched first, then checked against each other.

What is matched is stored before it is checked, since the depth of one view is checked against those of its sources, of
which there may be hundreds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from cuspid.model.capture import Capture
from cuspid.model.reconstruction import DepthMap, Reconstruction
from cuspid.model.rig import Rig
from cuspid.mvs.across import LocatedView, locate_views, view_resolution
from cuspid.mvs.confidence import Measured
from cuspid.mvs.matching import (
    WIDENINGS,
    Match,
    StereoOptions,
    coarser,
    consistent_planes,
    filter_depth_map,
    gray,
    prepare_views,
)
from cuspid.mvs.rectification import IdealView
from cuspid.mvs.stage import StoredDepthMaps
from cuspid.runtime.image_files import stretch_fine
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads
from cuspid.storage.files import digest_of, read_arrays, write_arrays
from cuspid.storage.reconstructions import write_depth_maps
from cuspid.storage.stages import Stage

_CODE = (__name__,)
_KEPT_IMAGES = 32
"""Images that are kept in memory for the next views."""


def measure_view_depth(
    capture: Capture,
    found: Reconstruction,
    folder: Path,
    options: StereoOptions,
    *,
    progress: Progress = silent,
) -> StoredDepthMaps:
    """Depth maps of every image of the located frames, each from those images of any frame that suit it, kept in
    ``folder``. This needs no rig: one camera is enough."""
    views = _Views(capture, locate_views(capture.handpiece, capture.frames, found, options.pairing), options)
    stage = Stage("matching", folder / "matched", options, _CODE)
    matched = dict(map_in_threads(partial(views.match, stage), views.used, stage=stage.name, progress=progress))
    for widening in WIDENINGS:
        stage = Stage(f"wider windows ({widening})", folder / f"matched-{widening}", options, _CODE)
        again = partial(views.match_again, stage, matched, widening)
        matched = dict(map_in_threads(again, views.used, stage=stage.name, progress=progress))
    stage = Stage("depth", folder, options, _CODE)
    by_frame = dict[str, list[int]]()
    for number in views.used:
        by_frame.setdefault(views.located[number].frame.name, []).append(number)
    check = partial(views.check, stage, matched)
    return StoredDepthMaps(dict(map_in_threads(check, by_frame.items(), stage=stage.name, progress=progress)))


@dataclass(frozen=True)
class _Matched:
    """Depth of a view before the checks, on disk."""

    file: Path
    key: str


class _Views:
    """Located views by their numbers, and what can be done with them."""

    def __init__(self, capture: Capture, located: tuple[LocatedView, ...], options: StereoOptions) -> None:
        self.capture, self.located, self.options = capture, located, options
        self.used = [number for number, view in enumerate(located) if view.sources]
        rig = capture.handpiece.rig
        self._ideal = {name: IdealView.of(name, mounted) for name, mounted in rig.cameras.items()}
        self._gray = lru_cache(maxsize=_KEPT_IMAGES)(self._read_view)

    def _read_view(self, number: int) -> UInt8[np.ndarray, "h w"] | Float32[np.ndarray, "h w"]:
        """The grey image of a view, without distortion."""
        view = self.located[number]
        return self._ideal[view.camera].resample(stretch_fine(gray(self.capture.fine_image(view.frame, view.camera))))

    def _sources_of(self, number: int) -> tuple[int, ...]:
        return number, *self.located[number].sources

    def _prepare_match(self, number: int) -> Match:
        """A view and its sources, ready to be matched; the view is the first of them."""
        of, view = self._sources_of(number), self.located[number]
        cameras = {
            _name(k): replace(self.located[k].mounted, camera=self._ideal[self.located[k].camera].camera) for k in of
        }
        sources = {_name(of[0]): list(map(_name, of[1:]))}
        views = prepare_views(Rig(cameras), sources, view.distance_mm, view.depth_range_mm, self.options)
        images = {_name(k): self._gray(k) for k in of}
        return Match(views, images, view.depth_range_mm, self.options, shaded=True)

    def _measure_view(self, number: int, matched: Mapping[int, _Matched]) -> Measured:
        """What was matched of a view."""
        view = self.located[number]
        arrays = read_arrays(matched[number].file, remedy="run the same command again to recreate it")
        grid = coarser(self._ideal[view.camera].camera, self.options.grid_px)
        depth_mm, sigma_mm = (arrays[name].astype(np.float64) for name in ("depth_mm", "sigma_mm"))
        return Measured(grid, view.mounted.cam_from_rig, depth_mm, sigma_mm, arrays["begun"], arrays["planes"])

    def _others(self, number: int, matched: Mapping[int, _Matched]) -> list[int]:
        """Those sources of a view that were matched themselves."""
        return [source for source in self.located[number].sources if source in matched]

    def match(self, stage: Stage, number: int) -> tuple[int, _Matched]:
        """Depth of a view, before the checks."""
        of = [self.located[k] for k in self._sources_of(number)]
        images = [self.capture.source.digest(view.frame.name, view.camera) for view in of]
        inputs = {"images": digest_of(images), "views": digest_of([(each.mounted, each.depth_range_mm) for each in of])}
        file = stage.folder / f"{of[0].frame.name}.{of[0].camera}.npz"
        key = stage.make(inputs, [file], lambda: _write_measured(file, self._prepare_match(number).measure(0)))
        return number, _Matched(file, key)

    def match_again(
        self, stage: Stage, matched: Mapping[int, _Matched], widening: int, number: int
    ) -> tuple[int, _Matched]:
        """The same in wider windows, where its sources contradict much of it."""
        others = self._others(number, matched)
        one = self._measure_view(number, matched)
        beside = [self._measure_view(other, matched) for other in others]
        agreed = consistent_planes(one, beside, view_resolution(self.located, number), self.options.confidence)
        if agreed is None:
            return number, matched[number]
        known: Float[np.ndarray, "h w 6"] = agreed
        file = stage.folder / matched[number].file.name
        inputs = {"matched": digest_of([matched[k].key for k in (number, *others)])}
        key = stage.make(
            inputs, [file], lambda: _write_measured(file, self._prepare_match(number).widen(0, one, known, widening))
        )
        return number, _Matched(file, key)

    def check(self, stage: Stage, matched: Mapping[int, _Matched], frame: tuple[str, list[int]]) -> tuple[Path, str]:
        """The depth maps of the views of a frame, given by its name and their numbers."""
        name, numbers = frame
        file = stage.folder / f"{name}.npz"
        of = [k for number in numbers for k in (number, *self._others(number, matched))]
        inputs = {"matched": digest_of([matched[k].key for k in of])}
        maps = partial(map, partial(self._depth_map, matched), numbers)
        return file, stage.make(inputs, [file], lambda: write_depth_maps(file, list(maps())))

    def _depth_map(self, matched: Mapping[int, _Matched], number: int) -> DepthMap:
        view, ideal = self.located[number], self._ideal[self.located[number].camera]
        checked = filter_depth_map(
            self._measure_view(number, matched),
            [self._measure_view(other, matched) for other in self._others(number, matched)],
            self.capture.image(view.frame, view.camera),
            self.capture.source.mask(view.frame.name, view.camera),
            ideal,
            view.frame.name,
            view_resolution(self.located, number),
            self.options.confidence,
            self.options.grid_px,
        )
        return replace(checked, cam_from_rig=ideal.cam_from_rig)


def _name(number: int) -> str:
    """Name of a view in a rig."""
    return f"{number:06}"


def _write_measured(file: Path, measured: Measured) -> None:
    assert measured.planes is not None
    arrays = {name: getattr(measured, name).astype(np.float32) for name in ("depth_mm", "sigma_mm", "planes")}
    write_arrays(file, arrays | {"begun": np.asarray(measured.begun)})
