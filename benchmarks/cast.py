"""Photograph a simulated plaster cast by one camera, reconstruct it from the photographs alone, and hold it against the
cast.

    python benchmarks/cast.py JAW.ply [--photographs 60] [--scale 1] [--work build/cast] [--out FILE] [--render]

JAW is a mesh of a jaw that is not part of the project. WORK/photos holds the photographs (JPEG, with the focal length
in their EXIF), WORK/truth the cast, the poses, the camera and the board, which no reconstruction is given; it is told
the size of the board's squares, as a user would measure it. ``--scale`` 0.25 renders 1000 x 750 px for quick trials.
``--render`` only renders. Photographs that are there are kept.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from cast_judging import judged
from cast_scene import CastScene, build_scene, hand_held, phone, photograph, radiance, rays_of
from PIL import Image
from real_runs import told
from run import conditions

from cuspid.anatomy.jaw_files import load_jaw
from cuspid.geometry import Rigid3
from cuspid.model.board import Board
from cuspid.model.camera import Camera
from cuspid.model.rig import Sensor
from cuspid.storage import write_jaw, write_json, write_poses
from cuspid.storage.files import whole_file
from cuspid.storage.handpieces import camera_to_json, rigid_to_json
from cuspid_thesis.scan_cases import run_program

HERE = Path(__file__).parent
BOARD = Board(square_mm=4.96)
"""As ``cuspid rig target`` draws it, with squares of 5 mm, printed a little small and measured on the print."""
SENSOR = Sensor(noise_dn=1.4, shot_noise_share=0.7)
BRIGHT, BRIGHT_PERCENTILE = 0.72, 99.0
"""The exposure, the same for all photographs, puts this percentile of some of them at this share of full scale."""
FULL_FRAME_MM = 36.0
_FOCAL_LENGTH, _FOCAL_LENGTH_35, _MAKE, _MODEL, _EXIF = 0x920A, 0xA405, 0x010F, 0x0110, 0x8769


def render(jaw: Path, folder: Path, count: int, scale: float, seed: int) -> None:
    """Photographs and truth; photographs that are there are kept."""
    cast, _ = load_jaw(jaw)
    scene = build_scene(cast.mesh, BOARD, np.random.default_rng([seed, 0]))
    camera = phone(scale)
    poses = hand_held(cast.mesh, scene, count, np.random.default_rng([seed, 1]))
    names = [f"IMG_{k + 1:04d}" for k in range(count)]
    truth, photos = folder / "truth", folder / "photos"
    photos.mkdir(parents=True, exist_ok=True)
    write_jaw(truth / "jaw.ply", cast)
    write_poses(truth / "poses.json", dict(zip(names, poses, strict=True)))
    write_json(truth / "camera.json", camera_to_json(camera))
    write_json(truth / "board.json", {**asdict(BOARD), "board_from_world": rigid_to_json(scene.board_from_world)})
    gain = _gain(scene, poses)
    rays = rays_of(camera, 1 if scale > 0.6 else 2)
    for k, (name, pose) in enumerate(zip(names, poses, strict=True)):
        file = photos / f"{name}.jpg"
        if not file.exists():
            image = photograph(scene, rays, pose, gain, SENSOR, np.random.default_rng([seed, 2, k]))
            _write_jpeg(file, image, camera)
        print(f"{k + 1} of {count}", end="\r", flush=True)


def _gain(scene: CastScene, poses: list[Rigid3]) -> float:
    rays = rays_of(phone(0.05), 1)
    levels = np.concatenate([radiance(scene, rays, pose).max(axis=2).ravel() for pose in poses[::7]])
    return float(BRIGHT / np.percentile(levels, BRIGHT_PERCENTILE))


def _write_jpeg(file: Path, image: np.ndarray, camera: Camera) -> None:
    """With what a camera tells of itself: its focal length, rounded."""
    exif = Image.Exif()
    exif[_MAKE], exif[_MODEL] = "simulated", "cast"
    equivalent = FULL_FRAME_MM * float(camera.focal_px.mean()) / camera.width
    exif.get_ifd(_EXIF).update({_FOCAL_LENGTH: round(equivalent / 5.6, 2), _FOCAL_LENGTH_35: round(equivalent)})
    with whole_file(file) as part:
        Image.fromarray(image).save(part, format="JPEG", quality=95, exif=exif)


def reconstruct(folder: Path, timeout_s: float) -> dict[str, Any]:
    """As a user would, by default options, with the board's measured squares."""
    board = ["--square-mm", f"{BOARD.square_mm:g}"]
    command = [sys.executable, "-m", "cuspid", "reconstruct", str(folder / "photos"), "--out", str(folder / "out")]
    log = folder / "log.txt"
    with log.open("wb") as stream:
        status, took = run_program("timeout", "-k", "20", str(timeout_s), *command, *board, log=stream)
    return {**told(status, log.read_bytes()), **took}


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("jaw", type=Path)
    parser.add_argument("--photographs", type=int, default=60)
    parser.add_argument("--scale", type=float, default=1.0, help="of 4000 x 3000 px")
    parser.add_argument("--work", type=Path, default=Path("build/cast"))
    parser.add_argument("--out", type=Path, default=HERE / "results" / "cast.json")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout", type=float, default=3600)
    parser.add_argument("--render", action="store_true", help="only render")
    parser.add_argument("--evaluate", action="store_true", help="only evaluate what was reconstructed before")
    return parser.parse_args()


def main() -> None:
    """Render, reconstruct, evaluate."""
    arguments = asked()
    render(arguments.jaw, arguments.work, arguments.photographs, arguments.scale, arguments.seed)
    if arguments.render:
        return
    ran = {} if arguments.evaluate else reconstruct(arguments.work, arguments.timeout)
    found = judged(arguments.work / "out", arguments.work / "truth")
    size = {"photographs": arguments.photographs, "scale": arguments.scale, "jaw": arguments.jaw.stem}
    write_json(arguments.out, {**size, "run": ran, "found": found, **conditions()})
    print(ran, found)


if __name__ == "__main__":
    main()
