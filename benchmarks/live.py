"""Whether a session keeps up with a handpiece over a whole arch, in steady memory, and with a blind stretch in between.

    python benchmarks/live.py ARCH ... [--pace 1.5] [--work build/live] [--out benchmarks/results/live.json]

Each ARCH is ``phantom`` (the built-in one), a mesh of a whole arch, or the folder of a simulated scan of one. An arch
is scanned in one pass of 100 frames or more, and replayed as a draft at so many frames a second: what is due is pushed
as soon as the frame before is done. Then once more as fast as it goes, with ten frames in the middle black. Nothing
else should run meanwhile.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from run import conditions, run_timed

from cuspid import storage
from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture, ImageSource
from cuspid.pipeline.session import Session
from cuspid.storage import write_json
from cuspid_thesis.scan_cases import ONE_PASS

HERE = Path(__file__).parent
BLIND = 10


@dataclass(frozen=True)
class Blinded:
    """Images of another source, and black ones of further frames. An :class:`cuspid.model.capture.ImageSource`."""

    whole: ImageSource
    black: Mapping[str, str]
    """By the names of the black frames: a frame whose images have the same size."""

    @property
    def suffix(self) -> str:
        """As that of the other."""
        return self.whole.suffix

    def read(self, frame: str, camera: str) -> UInt8[np.ndarray, "h w 3"]:
        """As the other, or black."""
        return self.whole.read(self.black.get(frame, frame), camera) * np.uint8(frame not in self.black)

    def size(self, frame: str, camera: str) -> tuple[int, int]:
        """As the other."""
        return self.whole.size(self.black.get(frame, frame), camera)

    def mask(self, frame: str, camera: str) -> UInt8[np.ndarray, "h w"] | None:
        """As the other."""
        return self.whole.mask(self.black.get(frame, frame), camera)

    def digest(self, frame: str, camera: str) -> str:
        """As the other, marked where it is black."""
        return self.whole.digest(self.black.get(frame, frame), camera) + ("-black" if frame in self.black else "")

    def where(self, frame: str, camera: str) -> str:
        """As the other."""
        return self.whole.where(self.black.get(frame, frame), camera)


def blinded(capture: Capture) -> tuple[Capture, frozenset[str]]:
    """With black frames in the middle, and their names: the handpiece waits there until it sees again."""
    middle = len(capture.frames) // 2
    here = capture.frames[middle]
    dark = tuple(replace(here, name=f"black-{k}") for k in range(BLIND))
    source = Blinded(capture.source, {frame.name: here.name for frame in dark})
    frames = (*capture.frames[:middle], *dark, *capture.frames[middle:])
    return replace(capture, frames=frames, source=source), frozenset(source.black)


def followed(capture: Capture, folder: Path, pace: float | None) -> tuple[Session, dict[str, Any]]:
    """A session over all frames, and how it went."""
    session = Session(capture.handpiece, capture.source, folder)
    late_s, took_s, memory_gib, faces = list[float](), list[float](), list[float](), dict[int, int]()
    first_s: float | None = None
    begin = time.perf_counter()
    for number, frame in enumerate(capture.frames):
        due = 0.0 if pace is None else number / pace
        time.sleep(max(0.0, begin + due - time.perf_counter()))
        step = session.push(frame)
        faces |= {key: len(mesh.faces) for key, mesh in step.changed.items()}
        if first_s is None and any(faces.values()):
            first_s = time.perf_counter() - begin
        late_s.append(time.perf_counter() - begin - due)
        took_s.append(step.seconds)
        memory_gib.append(resident_gib())
    tenth = max(1, len(memory_gib) // 10)
    return session, {
        "frames": len(capture.frames),
        "placed": len(session.rig_from_world),
        "first_surface_s": first_s,
        "frames_a_second": len(took_s) / sum(took_s),
        "median_late_s": None if pace is None else float(np.median(late_s)),
        "most_late_s": None if pace is None else max(late_s),
        "memory_gib": [memory_gib[k] for k in range(tenth - 1, len(memory_gib), tenth)],
        "faces": sum(faces.values()),
    }


def resident_gib() -> float:
    """Memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**30


def drift_um(found: Mapping[str, Rigid3], true: Mapping[str, Rigid3]) -> Float[np.ndarray, "f"]:
    """How far each frame is from where it was, if the first one is right."""
    first = next(iter(found))
    world = found[first].inverse() @ true[first]
    off = [(found[name] @ world).inverse().translation - true[name].inverse().translation for name in found]
    return 1000 * np.linalg.norm(off, axis=1)


def scanned(arch: str, work: Path) -> Path:
    """The folder of a simulated scan, made where it is not there."""
    if Path(arch).is_dir():
        return Path(arch)
    name, given = Path(arch).stem, [] if arch == "phantom" else [arch]
    run_timed("simulate", *given, *ONE_PASS, "--out", str(work / name), log=work / f"{name}.log")
    return work / name


def measured(scan: Path, pace: float) -> dict[str, Any]:
    """The figures of one arch."""
    capture, true = storage.read_capture(scan / "capture"), storage.read_poses(scan / "truth" / "poses.json")
    dark, black = blinded(capture)
    with tempfile.TemporaryDirectory(prefix="cuspid-live-") as folder:
        followed(replace(capture, frames=capture.frames[:3]), Path(folder) / "first", None)
        session, figures = followed(capture, Path(folder) / "paced", pace)
        off = drift_um(session.rig_from_world, true)
        begin = time.perf_counter()
        session.correct()
        corrected = drift_um(session.rig_from_world, true)
        took = time.perf_counter() - begin
        again, blind = followed(dark, Path(folder) / "blind", None)
    return {
        **figures,
        "drift_um": {"median": float(np.median(off)), "most": float(off.max())},
        "correction_s": took,
        "corrected_um": {"median": float(np.median(corrected)), "most": float(corrected.max())},
        "blind": {**blind, "black": len(black), "wrong": len(black & again.rig_from_world.keys())},
    }


def main() -> None:
    """Measure, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arches", nargs="+")
    parser.add_argument("--pace", type=float, default=1.5)
    parser.add_argument("--work", type=Path, default=Path("build/live"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "live.json")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    scans = {}
    for arch in arguments.arches:
        scan = scanned(arch, arguments.work)
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:  # for its memory
            scans[scan.name] = alone.submit(measured, scan, arguments.pace).result()
        print(scan.name, scans[scan.name], flush=True)
    write_json(arguments.out, {"pace": arguments.pace, "scans": scans, **conditions()})


if __name__ == "__main__":
    main()
