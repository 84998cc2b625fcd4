"""What the verbs share: what is scanned, with which handpiece, and how progress is shown."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from tyro.conf import arg

from cuspid import storage
from cuspid.anatomy.jaw_files import Labelling, read_jaw
from cuspid.anatomy.numbering import Numbering
from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.handpiece.designs import DesignName, DesignOptions, build_handpiece
from cuspid.model.jaw import Arch, Jaw
from cuspid.model.reconstruction import Reconstruction
from cuspid.model.rig import Handpiece
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SEED, Options, Range
from cuspid.runtime.progress import Progress
from cuspid.runtime.values import printable
from cuspid.simulation.appearance import Preset


class _Messages(Console):
    """For people, on stderr. What is printed may hold the name of a file: nothing in it steers the terminal."""

    def print(self, *objects: Any, **how: Any) -> None:
        """As rich does."""
        super().print(*(printable(each) if isinstance(each, str) else each for each in objects), **how)


console = _Messages(stderr=True, markup=False, emoji=False)

_ONE_PLACE_MM = 1e-6
_SMALLEST_PX = 16
Flat = arg(name="")
"""The fields of a nested options value appear without a prefix."""


@dataclass(frozen=True, kw_only=True)
class Source(Options):
    """What is scanned."""

    unit: storage.Unit = "mm"
    """Length unit of the mesh file."""
    arch: Arch | None = None
    """Which jaw the file contains, if its teeth are to be numbered; for the phantom, lower by default."""
    labels: Numbering = "auto"
    """Numbers of the tooth labels in the file; found out from where the teeth stand unless given."""
    label_map: Path | None = None
    """JSON file of each label in the mesh file and its FDI number, for other numbers: {"1": 47, "2": 46}."""
    jaw_seed: Annotated[int, SEED] = 0
    """Seed that selects the individual of the built-in phantom."""

    @property
    def labelling(self) -> Labelling:
        """How the tooth labels of the file are understood."""
        return Labelling(numbering=self.labels, label_map=self.label_map)


@dataclass(frozen=True, kw_only=True)
class Probe(Options):
    """The handpiece that scans."""

    design: DesignName = "twelve"
    """Built-in design: a stereo pair, the essential four cameras, six cameras (use with --turns 3), or all twelve."""
    lights: Literal["white", "colour-coded", "in-turn"] | None = None
    """LEDs of a built-in design: white ones, or red, green and blue ones behind crossed polarisers, which plain enamel
    needs, or two such triples that take turns, without polarisers (default: white, but colour-coded with --texture
    enamel and natural)."""
    handpiece: Path | None = None
    """Your own handpiece.json, or COLMAP's rig_config.json, instead of a built-in design."""
    working_distance_mm: Annotated[float | None, Range(0.1, 100_000)] = None
    """Distance from the cameras to the teeth, for a built-in design (5 unless given) or for a rig_config.json, which
    does not contain it (guessed unless given)."""
    scale: Annotated[float, Range(0.01, 10)] = 1.0
    """Width and height of the images as multiples of the cameras' own: 0.5 has a quarter of the pixels, each of twice
    the size, and takes about a quarter of the time."""


@contextmanager
def show_progress() -> Iterator[Progress]:
    """A bar for each stage of long work, with the time left."""
    columns = (TextColumn("{task.description:>12}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield report


def load_source(mesh: Path | None, source: Source) -> Jaw:
    """The jaw of a file in the occlusal frame, or the phantom; logs notes on what was found or is uncertain."""
    if mesh is None:
        return build_phantom(PhantomOptions(arch=source.arch or "lower", seed=source.jaw_seed))
    return read_jaw(mesh, unit=source.unit, arch=source.arch, labelling=source.labelling)


def load_probe(probe: Probe) -> Handpiece:
    """The handpiece of a file, or a built-in design; its images scaled."""
    if probe.handpiece is not None:
        device = storage.read_handpiece(probe.handpiece, probe.working_distance_mm)
        _require_places(probe.handpiece, device)
    else:
        distance_mm = probe.working_distance_mm or DesignOptions.working_distance_mm
        options = DesignOptions(working_distance_mm=distance_mm, lights=probe.lights or "white")
        device = build_handpiece(probe.design, options)
    return device if probe.scale == 1 else _scale_images(device, probe.scale)


def _scale_images(device: Handpiece, scale: float) -> Handpiece:
    scaled = device.scaled(scale)
    for name, mounted in scaled.rig.cameras.items():
        if min(mounted.camera.width, mounted.camera.height) < _SMALLEST_PX:
            size = f"{mounted.camera.width} x {mounted.camera.height} px"
            raise InputError(f"--scale {scale:g} leaves images of {size} of camera {name}; give a larger one")
    return scaled


def _require_places(path: Path, device: Handpiece) -> None:
    """Raise InputError where all cameras are at one place: they see the same, and no depth."""
    centres = np.stack([each.cam_from_rig.inverse().translation for each in device.rig.cameras.values()])
    if len(centres) > 1 and np.ptp(centres, axis=0).max() < _ONE_PLACE_MM:
        raise InputError(f"{path}: all {len(centres)} cameras are at one place, which shows no depth; give theirs")


def suit_lights(probe: Probe, texture: Preset) -> Probe:
    """A probe with the lights that suit the teeth, if it is a built-in design without explicit ones."""
    if probe.handpiece is not None or probe.lights is not None:
        return probe
    plain = texture in ("enamel", "natural")
    if plain:
        console.print("note: plain enamel takes coloured lights and crossed polarisers (--lights white for others)")
    return replace(probe, lights="colour-coded" if plain else "white")


def print_expected(found: Reconstruction, sigma_um: Float[np.ndarray, "v"]) -> None:
    """Tell how far a surface may be off; nothing where the poses do not determine it."""
    expected = found.expectation
    if expected is None:
        return
    middle, most = np.percentile(sigma_um, [50, 95])
    if expected.is_exact:
        assumptions = "the calibration, which states no uncertainty, and the poses are taken as exact"
    else:
        assumptions = (
            f"by {found.told_by}, scale within {expected.scale_sigma_ppm:.0f} ppm and the {expected.span_mm:.0f} mm "
            f"from end to end within {expected.span_sigma_um:.1f} µm"
        )
    console.print(
        f"expected (one sigma): surface within {middle:.1f} µm (median; {most:.1f} for 95 % of it); {assumptions}"
    )
