"""Rolling shutters and delays: in calibrations from simulated films and from real webcams, and in scans.

    python benchmarks/rolling.py [FOLDER] [--seeds 12] [--sets webcams] [--films CASE ...] [--add]
                                 [--work FOLDER] [--out benchmarks/results/rolling.json]

Cameras film a board that a hand moves, each with a readout of its own (``simulated``): the errors of the readouts,
delays and lenses in what is stated, and those of the lenses if the readouts are ignored. The same with webcams
(``FOLDER``, with ``caliscope/``): residuals in held-out images without and with readouts. The molar 46 of the phantom
is scanned by twelve cameras (``scans``) with global shutters, and with rolling ones that are known, ignored or unknown,
together and delayed. Finished scans are kept in the work folder, and what the same code has measured in the file of
results; neither is made again. ``--add`` keeps what older code has measured, too: the commit of the file stays that of
these, and films have one of their own.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from calibrations import BOARD, NOISE_PX, SETS, SIZE, lens_z, rig_before_board, rms, views_of
from run import conditions
from scipy.spatial.transform import Rotation

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.calibration.bundle import BoardScene
from cuspid.calibration.calibrate import CalibrationOptions, RigCalibration, calibrate_rig
from cuspid.calibration.corners import BoardView, Views
from cuspid.geometry import Rigid3
from cuspid.handpiece.designs import DesignOptions, twelve_cameras
from cuspid.model.rig import Handpiece
from cuspid.model.shutter import PLAIN, Shutter
from cuspid.model.tolerances import with_cameras
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import ReconstructionOptions, SimulationOptions
from cuspid.simulation.optics import OpticsOptions
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.storage import write_json
from cuspid.storage.files import read_json
from cuspid.studies.grid import Value
from cuspid_thesis.scan_cases import commit

HERE = Path(__file__).parent
INSTANTS = 28
READOUTS = (0.3, 0.8, -0.5)
"""The images of the third are turned by half a turn."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """Cameras that film a board."""

    cameras: int
    rolls: bool = True
    """Whether they have readouts, which take turns from seed to seed."""
    delays: tuple[float, ...] = ()
    """By how many frames each is late; none of them without."""
    share: float = 1.0
    """Of the seeds that are tried."""

    def readouts(self, seed: int) -> dict[str, float]:
        """Of each camera."""
        return {f"cam{k}": self.rolls * READOUTS[(k + seed) % len(READOUTS)] for k in range(self.cameras)}

    @property
    def late(self) -> dict[str, float]:
        """By how many frames each camera is late."""
        return {f"cam{k}": delay for k, delay in enumerate(self.delays)}


FILMS = {
    "one camera": Film(cameras=1),
    "one camera, global": Film(cameras=1, rolls=False),
    "three cameras": Film(cameras=3, share=0.25),
    "three cameras, one late": Film(cameras=3, delays=(0.0, 0.4, 0.0), share=0.25),
    "three cameras, all apart": Film(cameras=3, delays=(0.0, 0.4, -0.3), share=0.5),
}
UNKNOWN = 0.5
"""Standard deviation of a readout of which nothing is known."""
READOUT, DELAYS = 0.5, (0.0, 0.2, -0.2, 0.1, -0.1, 0.3, 0.0, -0.3, 0.15, -0.15, 0.25, -0.25)
"""Of the cameras that scan."""
SCANS: Mapping[str, tuple[OpticsOptions, Callable[[Shutter], Shutter]]] = {
    "global": (OpticsOptions(), lambda true: true),
    "rolling, known": (OpticsOptions(readout=READOUT), lambda true: true),
    "rolling, unknown": (OpticsOptions(readout=READOUT), lambda true: Shutter(readout_sigma=UNKNOWN)),
    "rolling, ignored": (OpticsOptions(readout=READOUT), lambda true: PLAIN),
    "delayed, known": (OpticsOptions(delays_frames=DELAYS), lambda true: true),
    "delayed, ignored": (OpticsOptions(delays_frames=DELAYS), lambda true: PLAIN),
}
"""What the images are taken with, and what the file says of a shutter."""


# --- calibrations ------------------------------------------------------------------------------------------------


def hand(rng: np.random.Generator) -> Callable[[float], Rigid3]:
    """The path of a board: ``rig_from_board`` so many frames after the first."""
    periods, phases = rng.uniform(35, 70, 6), rng.uniform(0, 2 * np.pi, 6)

    def pose(time: float) -> Rigid3:
        waves = np.sin(2 * np.pi * time / periods + phases)
        turn = Rotation.from_euler("xyz", [35, 35, 25] * waves[:3], degrees=True).as_matrix()
        middle = np.array([0, 0, 24.0]) + [2, 2, 3] * waves[3:]
        return Rigid3(turn, middle - turn @ np.array([*BOARD.size_mm, 0]) / 2)

    return pose


def filmed(
    truth: BoardScene,
    path: Callable[[float], Rigid3],
    readouts: Mapping[str, float],
    delays: Mapping[str, float],
    rng: np.random.Generator,
) -> Views:
    """What the cameras see of a board whose corners are each exposed when their row is."""
    views = {}
    for camera, lens in truth.cameras.items():
        for instant in range(INSTANTS):
            middle, shares = instant + delays.get(camera, 0.0), np.array([-0.5, -0.25, 0.0, 0.25, 0.5])
            poses = [truth.cam_from_rig[camera] @ path(middle + share * readouts[camera]) for share in shares]
            places = np.stack([lens.project(pose.apply(BOARD.corners)) for pose in poses])
            way = np.polynomial.Polynomial
            fits = [[way.fit(shares, places[:, k, axis], 4) for axis in range(2)] for k in range(places.shape[1])]
            pixels = np.array([_when_exposed(x, y, lens.height) for x, y in fits])
            shown = np.flatnonzero(lens.contains(pixels))
            if len(shown) >= 12:
                noise = rng.normal(0, NOISE_PX, (len(shown), 2))
                views[camera, f"{instant:05d}"] = BoardView(shown, pixels[shown] + noise)
    return views


def _when_exposed(x: Callable[[float], float], y: Callable[[float], float], height: int) -> tuple[float, float]:
    """Where a corner is when its row is exposed, given its place by the share of the readout."""
    share = 0.0
    for _ in range(8):
        share = float(y(share)) / height - 0.5
    return float(x(share)), float(y(share))


def film_figures(case: str, seed: int) -> dict[str, Value]:
    """Errors of the readouts and of the lenses in what is stated, and of the focal lengths; also if the readouts are
    ignored."""
    rng, film = np.random.default_rng(2000 + seed), FILMS[case]
    truth, readouts = rig_before_board(rng, film.cameras), film.readouts(seed)
    views = filmed(truth, hand(rng), readouts, film.late, rng)
    sizes = dict.fromkeys(truth.cameras, SIZE)
    found = calibrate_rig(views, sizes, BOARD, CalibrationOptions(lens="OPENCV"))
    ignored = calibrate_rig(views, sizes, BOARD, CalibrationOptions(lens="OPENCV", shutter="global"))
    shutters = {name: found.rig[name].shutter for name in readouts}
    kept = any(shutter.readout_sigma for shutter in shutters.values())
    errors = {name: shutter.readout - readouts[name] for name, shutter in shutters.items()}
    late = _delay_errors(found, film.late)
    return {
        "taken_as_rolling": kept,
        "readout_z": rms([errors[name] / shutters[name].readout_sigma for name in errors]) if kept else None,
        "readout_error": rms(list(errors.values())),
        "delay_error": rms([error for error, _ in late]) if late else None,
        "delay_z": rms([error / sigma for error, sigma in late]) if late else None,
        "readout_mean_error": float(np.mean(list(errors.values()))),
        "lens_z": rms([lens_z(found, truth, name) for name in readouts]),
        "focal_error_permille": _focal_error_permille(found, truth),
        "ignored_lens_z": rms([lens_z(ignored, truth, name) for name in readouts]),
        "ignored_focal_error_permille": _focal_error_permille(ignored, truth),
        "ignored_views": len(ignored.views),
        "views": len(found.views),
    }


def _delay_errors(found: RigCalibration, late: Mapping[str, float]) -> list[tuple[float, float]]:
    """Of each camera, by how many frames its delay is off, and the standard deviation of that: of the mean over its
    views, which scatter as is stated. None where no camera is late, or that is not found."""
    usual = float(np.mean([*late.values()] or [0.0]))
    checks = {name: found.cameras[name] for name in late}
    return [
        (check.delay_frames - (late[name] - usual), check.delay_spread_frames / np.sqrt(check.views))
        for name, check in checks.items()
        if check.delay_frames is not None and check.delay_spread_frames
    ]


def films_figures(case: str, seeds: int) -> list[dict[str, Value]]:
    """Of several seeds, with the commit that they were measured at."""
    return [{**film_figures(case, seed), "commit": commit()} for seed in range(seeds)]


def _focal_error_permille(found: RigCalibration, truth: BoardScene) -> float:
    return 1000 * rms([found.rig[name].camera.focal_px / lens.focal_px - 1 for name, lens in truth.cameras.items()])


def real_figures(name: str, folder: Path) -> dict[str, object]:
    """What is left in the images of real cameras, without readouts and with them."""
    which = SETS[name]
    views, sizes = views_of(which, folder)
    figures: dict[str, object] = {}
    for how, options in (("global", CalibrationOptions(shutter="global")), ("auto", CalibrationOptions())):
        found = calibrate_rig(views, sizes, which.board, options)
        figures[how] = {
            camera: {
                "views": check.views,
                "rms_px": check.rms_px,
                "held_out_px": check.held_out_px,
                "parameters_apart": check.parameters_apart,
                "alone_apart": check.alone_apart,
                "delay_frames": check.delay_frames,
                "readout": check.readout,
                "readout_sigma": check.readout_sigma,
                "focal_px": float(found.rig[camera].camera.focal_px.mean()),
            }
            for camera, check in found.cameras.items()
        }
    return figures


# --- scans -------------------------------------------------------------------------------------------------------


def scan_figures(name: str, work: Path) -> dict[str, Value]:
    """The trueness of a scan of a molar."""
    optics, says = SCANS[name]
    folder = work / name.split(",")[0]
    drawn = twelve_cameras(DesignOptions())
    path = ScanPathOptions(tooth=46, passes="turns")
    capture, _ = pipeline.simulate(
        build_phantom(PhantomOptions()), drawn, folder, SimulationOptions(path=path, optics=optics)
    )
    capture = replace(capture, handpiece=_told(capture.handpiece, says))
    found, mesh = pipeline.reconstruct(capture, work / name.replace(", ", "-"), ReconstructionOptions())
    reference = pipeline.load_reference(folder / "truth")
    trueness = pipeline.evaluate(mesh, reference)
    shutters = [each.shutter for each in found.rig.cameras.values()]
    return {
        "mean_um": trueness.accuracy.mean_abs_um,
        "p95_um": trueness.accuracy.p95_um,
        "complete_50_um_pct": trueness.completeness_pct["50"],
        "scale_ppm": trueness.scale_error_ppm,
        "reprojection_px": found.reprojection_rms_px,
        "readout_error": rms([each.readout - READOUT for each in shutters]) if name == "rolling, unknown" else None,
        "readout_z": rms([(each.readout - READOUT) / each.readout_sigma for each in shutters])
        if name == "rolling, unknown"
        else None,
    }


def _told(handpiece: Handpiece, says: Callable[[Shutter], Shutter]) -> Handpiece:
    return with_cameras(handpiece, lambda mounted: replace(mounted, shutter=says(mounted.shutter)))


# --- all ---------------------------------------------------------------------------------------------------------


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--sets", nargs="*", default=["webcams"])
    parser.add_argument("--films", nargs="*", default=list(FILMS))
    parser.add_argument("--add", action="store_true")
    parser.add_argument("--scans", nargs="*", default=list(SCANS))
    parser.add_argument("--work", type=Path, default=Path("build/rolling"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "rolling.json")
    return parser.parse_args()


PARTS = ("simulated", "real", "scans")


def kept(path: Path, *, add: bool) -> tuple[dict[str, dict[str, object]], dict[str, object]]:
    """What was measured by the same code before, or by any if more is added to it, and under which conditions."""
    before = read_json(path) if path.exists() else {}
    same = before.get("commit") == commit()
    figures = {part: before[part] if same or (add and before) else {} for part in PARTS}
    under = {key: each for key, each in before.items() if key not in (*PARTS, "noise_px", "readouts")}
    return figures, under if add and before else conditions()


def main() -> None:
    """Measure what is asked for and write the figures."""
    arguments = asked()
    figures, under = kept(arguments.out, add=arguments.add)

    def keep(part: str, name: str, measure: Callable[[], object]) -> None:
        if name in figures[part]:
            return
        figures[part][name] = measure()
        print(name, figures[part][name], flush=True)
        write_json(arguments.out, {"noise_px": NOISE_PX, "readouts": READOUTS, **figures, **under})

    for name in arguments.sets if arguments.folder else ():
        keep("real", name, partial(real_figures, name, arguments.folder))
    for name in arguments.scans:
        keep("scans", name, partial(scan_figures, name, arguments.work))
    for case in arguments.films if arguments.seeds else ():
        keep("simulated", case, partial(films_figures, case, round(FILMS[case].share * arguments.seeds)))


if __name__ == "__main__":
    main()
