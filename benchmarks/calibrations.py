"""What the standard deviations that a calibration states are worth: against the truth, and between real halves.

    python benchmarks/calibrations.py [FOLDER] [--seeds 20] [--models OPENCV ...] [--rigs 8]
                                      [--splits 6] [--sets endoscope ...] [--out benchmarks/results/calibrations.json]

In simulation (``simulated``), the errors of the parameters are compared with what is stated: for a lens of each model,
and for rigs whose corners err as they do in real images: independently (``white``), on a board that is printed and
mounted unevenly (``uneven``), together within each view (``common``), and where the cameras did not see the board at
the same place (``loose``). In real images (``FOLDER``, with ``endoscope/`` and so on), the views are divided at random
into halves, and each half is calibrated for itself: by how much do the two differ, in the standard deviations that both
state? Both figures are root mean squares over the parameters, and about 1 where what is stated is right.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from run import conditions
from scipy.spatial.transform import Rotation

from cuspid import storage
from cuspid.calibration.bundle import BoardScene, common_free
from cuspid.calibration.calibrate import CalibrationOptions, RigCalibration, calibrate_rig
from cuspid.calibration.corners import BoardView, Views, find_corners
from cuspid.calibration.lenses import choose_lens
from cuspid.calibration.uncertainty import lens_difference_px, projection_sigma_px
from cuspid.geometry import Rigid3
from cuspid.model.board import Board
from cuspid.model.camera import Camera
from cuspid.runtime.errors import ReconstructionError
from cuspid.runtime.image_files import read_image
from cuspid.storage import write_json
from cuspid.studies.grid import Value

HERE = Path(__file__).parent
BOARD, SIZE = Board(columns=9, rows=7, square_mm=2.0), (640, 480)
NOISE_PX = 0.1
LENSES = {
    "OPENCV": (520.0, (-0.1, 0.03, 1e-3, -1e-3)),
    "FULL_OPENCV": (340.0, (-0.3, 0.14, 1e-3, -1e-3, -0.05, 0.0, 0.0, 0.0)),
    "OPENCV_FISHEYE": (300.0, (-0.03, 0.01, -0.004, 5e-4)),
    "THIN_PRISM_FISHEYE": (300.0, (-0.03, 0.01, 2e-3, -2e-3, -0.004, 5e-4, 0.02, -0.015)),
}
"""Focal length in px and distortion; all but the first are of 88 to 120 degrees across the image."""
ERRORS = ("white", "uneven", "common", "loose")
UNEVEN_MM, COMMON_PX, LOOSE_MM = (0.01, 0.02), 0.15, 0.01
"""Offsets of the corners of an uneven board, in its plane and out of it; size of the errors that a view has in common;
and by how much the board moves between the exposures of the cameras."""


@dataclass(frozen=True, kw_only=True)
class RealSet:
    """Views of a board by others."""

    folder: str
    """Under the folder of all of them."""
    cameras: Mapping[str, str]
    """Pattern of the files of each camera."""
    board: Board
    development: bool = False
    """Whether the method was developed with it; the others were looked at in the end."""
    kept_out: str = ""
    """Files whose names begin so are of something else."""


_CAPSULES = "capsules/Camera"
SETS: Mapping[str, RealSet] = {
    "endoscope": RealSet(
        folder="endoscope",
        cameras={"left": "left*.png", "right": "right*.png"},
        board=Board(kind="chessboard", columns=8, rows=8, square_mm=8),
        development=True,
    ),
    "pose2sim 1": RealSet(
        folder="pose2sim/intrinsics",
        cameras={"cam": "int_cam01_img/*.jpg"},
        board=Board(kind="chessboard", columns=8, rows=5, square_mm=60),
        development=True,
    ),
    "webcams": RealSet(
        folder="caliscope",
        cameras={f"cam_{k}": f"cam_{k}.mp4" for k in range(4)},
        board=Board(columns=4, rows=5, square_mm=54, inverted=True),
        development=True,
    ),
    **{
        f"pose2sim {k}": RealSet(
            folder="pose2sim/intrinsics",
            cameras={"cam": f"int_cam0{k}_img/*.jpg"},
            board=Board(kind="chessboard", columns=8, rows=5, square_mm=60),
        )
        for k in (2, 3, 4)
    },
    "viking": RealSet(
        folder="viking",
        cameras={"left": "left/*.png", "right": "right/*.png"},
        development=True,
        board=Board(kind="chessboard", columns=15, rows=11, square_mm=3),
    ),
    "MiroCam": RealSet(
        folder=_CAPSULES,
        cameras={"cam": "MiroCam/*.jpg"},
        development=True,
        board=Board(kind="chessboard", columns=8, rows=7, square_mm=2),
    ),
    **{
        f"PillCam {k}": RealSet(
            folder=_CAPSULES,
            cameras={"cam": f"PillCam/Cam{k}/*.bmp"},
            board=Board(kind="chessboard", columns=9, rows=7, square_mm=2),
        )
        for k in (1, 2)
    },
}


# --- simulated ---------------------------------------------------------------------------------------------------


def lens_before_board(model: str, rng: np.random.Generator, instants: int = 16) -> BoardScene:
    """One camera with a lens of a model, and a board that is held all over its image."""
    focal, distortion = LENSES[model]
    camera = Camera(
        width=SIZE[0],
        height=SIZE[1],
        focal_px=np.array([focal, 1.003 * focal]),
        principal_point_px=np.array([325.0, 236.0]),
        distortion=np.array(distortion),
        model=model,
    )
    poses = {}
    for instant in range(instants):
        away = rng.uniform(9, 20)
        middle = away * np.array([*rng.uniform(-1, 1, 2) * [264, 192] / focal, 1.0])
        poses[f"{instant:02d}"] = _held(rng, middle)
    return _scene({"cam": camera}, {"cam": Rigid3.identity()}, poses)


def rig_before_board(rng: np.random.Generator, cameras: int = 3, instants: int = 20) -> BoardScene:
    """Cameras side by side, and a board before them."""
    lenses, places = {}, {}
    for k in range(cameras):
        lenses[f"cam{k}"] = Camera(
            width=SIZE[0],
            height=SIZE[1],
            focal_px=rng.uniform(480, 560) * np.array([1.0, rng.uniform(0.99, 1.01)]),
            principal_point_px=np.array(SIZE) / 2 + rng.normal(0, 8, 2),
            distortion=rng.normal(0, [0.1, 0.05, 0.002, 0.002]),
        )
        turn = Rotation.from_euler("y", -np.arctan2(4.0 * (k - 1), 24.0)).as_matrix()
        places[f"cam{k}"] = Rigid3(turn, -turn @ np.array([4.0 * (k - 1), *rng.normal(0, 1, 2)]))
    rig = places["cam0"].inverse()
    poses = {
        f"{i:02d}": places["cam0"] @ _held(rng, np.array([0, 0, 24.0]) + rng.normal(0, [2, 2, 3]))
        for i in range(instants)
    }
    return _scene(lenses, {name: place @ rig for name, place in places.items()}, poses)


def _held(rng: np.random.Generator, middle: np.ndarray) -> Rigid3:
    turn = Rotation.from_euler("xyz", rng.uniform(-40, 40, 3), degrees=True).as_matrix()
    return Rigid3(turn, middle - turn @ np.array([*BOARD.size_mm, 0]) / 2)


def _scene(cameras: Mapping[str, Camera], places: Mapping[str, Rigid3], poses: Mapping[str, Rigid3]) -> BoardScene:
    return BoardScene(cameras=cameras, cam_from_rig=places, rig_from_board=poses, bending_mm=np.zeros(3))


def seen(truth: BoardScene, errors: str, rng: np.random.Generator) -> dict[tuple[str, str], BoardView]:
    """What the cameras see of the board, with errors of a kind."""
    points, grid = BOARD.corners, (BOARD.corners[:, :2] / BOARD.size_mm - 0.5) * np.pi
    if errors == "uneven":
        points = points + rng.normal(0, [UNEVEN_MM[0], *UNEVEN_MM], points.shape)
    views = {}
    for camera, lens in truth.cameras.items():
        for instant, pose in truth.rig_from_board.items():
            moved = Rigid3(np.eye(3), rng.normal(0, LOOSE_MM if errors == "loose" else 0.0, 3))
            pixels = lens.project((moved @ truth.cam_from_rig[camera] @ pose).apply(points))
            shown = np.flatnonzero(lens.contains(pixels))
            if len(shown) < 12:
                continue
            waves = [np.cos(grid @ rng.normal(0, 1.0, 2) + rng.uniform(0, 6.28)) for _ in range(2)]
            common = np.sqrt(2) * COMMON_PX * rng.normal(0, 1, 2) * np.stack(waves, axis=1) * (errors == "common")
            off = common[shown] + rng.normal(0, NOISE_PX, (len(shown), 2))
            views[camera, instant] = BoardView(shown, pixels[shown] + off)
    return views


def lens_figures(model: str, seed: int) -> dict[str, Value]:
    """The error of one lens in what is stated, and the model that the views call for."""
    rng = np.random.default_rng(seed)
    truth = lens_before_board(model, rng)
    views = seen(truth, "white", rng)
    found = calibrate_rig(views, {"cam": SIZE}, BOARD, CalibrationOptions(lens=model))  # type: ignore[arg-type]
    choice, _ = choose_lens(list(views.values()), BOARD, SIZE)
    return {"chosen": choice.model, "lens_z": lens_z(found, truth, "cam"), "rms_px": found.cameras["cam"].rms_px}


def rig_figures(errors: str, seed: int) -> dict[str, Value]:
    """The errors of the lenses and of the places of a rig in what is stated, RMS over its cameras."""
    rng = np.random.default_rng(1000 + seed)
    truth = rig_before_board(rng)
    found = calibrate_rig(
        seen(truth, errors, rng), dict.fromkeys(truth.cameras, SIZE), BOARD, CalibrationOptions(lens="OPENCV")
    )
    checks = found.cameras.values()
    return {
        "lens_z": rms([lens_z(found, truth, name) for name in truth.cameras]),
        "place_z": rms(list(places_z(found, truth).values())),
        "focal_error_permille": 1000 * rms([_focal_error(found, truth, name) for name in truth.cameras]),
        "halves": rms([check.parameters_apart for check in checks if check.parameters_apart is not None]),
        "uneven": found.uneven_mm is not None,
        "rms_px": rms([check.rms_px for check in checks]),
    }


def _focal_error(found: RigCalibration, truth: BoardScene, name: str) -> float:
    return float(found.rig[name].camera.focal_px[0] / truth.cameras[name].focal_px[0] - 1)


def lens_z(found: RigCalibration, truth: BoardScene, name: str) -> float:
    """Error of the parameters of a lens, in standard deviations."""
    camera = found.rig[name].camera
    return in_sigmas(camera.parameters - truth.cameras[name].parameters, np.asarray(camera.covariance))


def places_z(found: RigCalibration, truth: BoardScene) -> dict[str, float]:
    """Errors of the places of the cameras, in standard deviations."""
    names = list(truth.cameras)
    between = [found.rig[name].cam_from_rig @ truth.cam_from_rig[name].inverse() for name in names]
    motions = common_free(truth, [np.array([*each.rotation_vector, *each.translation]) for each in between])
    return {
        name: in_sigmas(motion, np.asarray(found.rig[name].covariance))
        for name, motion in zip(names, motions, strict=True)
    }


def in_sigmas(difference: np.ndarray, covariance: np.ndarray) -> float:
    """RMS over the directions, each in its standard deviation."""
    return rms(whitened(difference, covariance)[0])


def whitened(difference: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A difference along the axes of a covariance (of numbers in their own standard deviations), and the axes."""
    scale = np.sqrt(np.diag(covariance))
    values, axes = np.linalg.eigh(covariance / scale / scale[:, None])
    return axes.T @ (difference / scale) / np.sqrt(np.maximum(values, 1e-12)), axes


def rms(values: object) -> float:
    """Root mean square of all numbers."""
    return float(np.sqrt(np.mean(np.square(np.asarray(values)))))


# --- real --------------------------------------------------------------------------------------------------------


def views_of(which: RealSet, folder: Path) -> tuple[Views, dict[str, tuple[int, int]]]:
    """The board in all images of a set, and their sizes."""
    views, sizes = dict[tuple[str, str], BoardView](), dict[str, tuple[int, int]]()
    for camera, pattern in which.cameras.items():
        for name, gray in _images(sorted((folder / which.folder).glob(pattern)), camera):
            sizes[camera] = gray.shape[1], gray.shape[0]
            view = find_corners(gray, which.board)
            if view is not None:
                views[camera, name] = view
    return views, sizes


def _images(paths: Sequence[Path], camera: str) -> Iterator[tuple[str, np.ndarray]]:
    for path in paths:
        if path.suffix == ".mp4":
            with TemporaryDirectory(prefix="cuspid-calibrations-") as frames:
                sequence = storage.read_sequence(path, Path(frames))
                for index, name in enumerate(sequence.names):
                    yield name, cv2.cvtColor(sequence.image(index), cv2.COLOR_RGB2GRAY)
        else:
            yield path.stem.removeprefix(camera), cv2.cvtColor(read_image(path), cv2.COLOR_RGB2GRAY)


def halves_figures(which: RealSet, folder: Path, splits: int) -> dict[str, object]:
    """A set as a whole, and how far calibrations from random halves of it are apart."""
    views, sizes = views_of(which, folder)
    whole = calibrate_rig(views, sizes, which.board)
    models = {name: choice.model for name, choice in whole.lenses.items()}
    rng, apart = np.random.default_rng(0), list[dict[str, dict[str, Value]]]()
    for _ in range(splits):
        halves = [calibrated_half(half, sizes, which.board, models) for half in halved(whole.views, rng)]
        one, other = halves
        if one is not None and other is not None:
            apart.append({name: difference(name, one, other) for name in sizes})
    return {
        "development": which.development,
        "cameras": {
            name: {
                "model": models[name],
                "views": check.views,
                "views_in_half": check.views // 2,
                "rms_px": check.rms_px,
                "held_out_px": check.held_out_px,
                "parameters": whole.rig[name].camera.parameters.tolist(),
                "sigmas": np.sqrt(np.diag(np.asarray(whole.rig[name].camera.covariance))).tolist(),
                "splits": [each[name] for each in apart],
            }
            for name, check in whole.cameras.items()
        },
        "uneven_mm": whole.uneven_mm,
        "loose_px": whole.loose_px,
    }


def halved(views: Views, rng: np.random.Generator) -> tuple[Views, Views]:
    """The views at every other one of the instants in random order; of those that follow each other, in runs of six."""
    instants = sorted({instant for _, instant in views})
    run = 6 if len(instants) > 40 else 1
    groups = [instants[k : k + run] for k in range(0, len(instants), run)]
    first = {instant for k in rng.permutation(len(groups))[::2] for instant in groups[k]}
    one = {key: view for key, view in views.items() if key[1] in first}
    return one, {key: view for key, view in views.items() if key not in one}


def calibrated_half(
    views: Views, sizes: Mapping[str, tuple[int, int]], board: Board, models: Mapping[str, str]
) -> RigCalibration | None:
    """A calibration from a part of the views by the models of the whole; None where there is none."""
    model = next(iter(models.values()))
    if len(set(models.values())) > 1:
        model = "auto"
    model = "splined" if model == "SPLINED_FISHEYE" else model
    try:
        found = calibrate_rig(views, sizes, board, CalibrationOptions(lens=model))  # type: ignore[arg-type]
    except ReconstructionError:
        return None
    return found if {name: each.model for name, each in found.lenses.items()} == dict(models) else None


def difference(name: str, one: RigCalibration, other: RigCalibration) -> dict[str, Value]:
    """Between the lenses of a camera, in what both state; and along which axis it is largest."""
    ours, theirs = one.rig[name].camera, other.rig[name].camera
    if ours.lens.splined:  # each half has a grid of its own
        off = np.linalg.norm(lens_difference_px(ours, theirs, one.pixels[name]), axis=2)
        along = off / np.hypot(projection_sigma_px(ours), projection_sigma_px(theirs)) / np.sqrt(2)
        known = along[np.isfinite(along)]
        return {
            "z": rms(known),
            "worst_z": float(known.max()),
            "worst_axis": "over the image",
            "widened": max(one.widened[name], other.widened[name]),
        }
    covariance = np.asarray(ours.covariance) + np.asarray(theirs.covariance)
    along, axes = whitened(ours.parameters - theirs.parameters, covariance)
    worst = int(np.argmax(np.abs(along)))
    names = ("fx", "fy", "cx", "cy", *ours.lens.names)
    parts = np.argsort(-np.abs(axes[:, worst]))[:2]
    return {
        "z": rms(along),
        "worst_z": float(np.abs(along[worst])),
        "worst_axis": ", ".join(names[k] for k in parts),
        "widened": max(one.widened[name], other.widened[name]),
    }


# --- all ---------------------------------------------------------------------------------------------------------


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--models", nargs="*", default=list(LENSES))
    parser.add_argument("--rigs", type=int, default=8)
    parser.add_argument("--splits", type=int, default=6)
    parser.add_argument("--sets", nargs="*", default=list(SETS))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "calibrations.json")
    return parser.parse_args()


def main() -> None:
    """Measure what is asked for and write the figures."""
    arguments = asked()
    simulated: dict[str, object] = {}
    for model in arguments.models if arguments.seeds else ():
        simulated[model] = [lens_figures(model, seed) for seed in range(arguments.seeds)]
        print(model, rms([each["lens_z"] for each in simulated[model]]), flush=True)  # type: ignore[attr-defined]
    for errors in ERRORS if arguments.rigs else ():
        simulated[errors] = [rig_figures(errors, seed) for seed in range(arguments.rigs)]
        print(errors, rms([each["lens_z"] for each in simulated[errors]]), flush=True)  # type: ignore[attr-defined]
    real: dict[str, object] = {}
    for name in arguments.sets if arguments.folder else ():
        real[name] = halves_figures(SETS[name], arguments.folder, arguments.splits)
        print(name, real[name], flush=True)
    write_json(arguments.out, {"simulated": simulated, "real": real, "noise_px": NOISE_PX, **conditions()})


if __name__ == "__main__":
    main()
