"""The second renderer: Blender Cycles with subsurface scattering, run as a separate program.

It takes the same scene as :mod:`cuspid.simulation.raycast` and gives images through the same sensor. Its texture has
the same statistics but another pattern, because Blender generates its own noise; interreflection is traced. bpy needs
its own environment (another licence and an old numpy), so nothing of it is imported here.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cuspid.geometry import Rigid3, axes_about
from cuspid.model.capture import Frame
from cuspid.model.rig import Handpiece, Light, MountedCamera
from cuspid.runtime.errors import InputError, MissingDependencyError
from cuspid.simulation.appearance import Appearance, face_materials
from cuspid.simulation.optics import IDEAL, Optics
from cuspid.simulation.raycast import Scene, Sink, image_rng, metered_gains
from cuspid.simulation.sensor import record

PYTHON_VARIABLE = "CUSPID_BLENDER_PYTHON"
"""Environment variable with the path of the Python interpreter that has bpy."""
SAMPLES = 64
"""Paths traced per pixel."""
LED_DIAMETER_MM = 0.2
"""Diameter of the discs that represent the lights."""

_SCRIPT = Path(__file__).with_name("blender_script.py")
_HOW_TO = (
    "make an environment with Python 3.11 (python3.11 -m venv bpy-env; bpy-env/bin/pip install 'bpy==4.5.*' 'numpy<2') "
    f"and set {PYTHON_VARIABLE}=bpy-env/bin/python"
)


def render_with_blender(
    scene: Scene,
    frames: Sequence[Frame],
    poses: Mapping[str, Rigid3],
    sink: Sink,
    *,
    skip: Callable[[str, str], bool] = lambda frame, camera: False,
    processes: int = 1,
) -> Iterator[tuple[str, str]]:
    """As :func:`cuspid.simulation.raycast.render_capture`, by Blender with ``processes`` threads.

    Raises what :func:`check_blender` does.
    """
    python = check_blender(scene.handpiece, scene.appearance, scene.optics)
    tasks = [(frame, camera) for frame in frames for camera in frame.cameras if not skip(frame.name, camera)]
    if not tasks:
        return
    gains = metered_gains(scene, frames, poses)
    gain_of = {frame.name: gains[frame.lighting] for frame in frames}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write_scene(folder, scene, poses, tasks, processes)
        for frame, camera in _run_script(python, folder):
            image = folder / f"{frame}-{camera}.npy"
            rng = image_rng(scene, frame, camera)
            sink(frame, camera, record(np.load(image), gain_of[frame], scene.handpiece, camera, rng))
            image.unlink()
            yield frame, camera


def check_blender(handpiece: Handpiece, appearance: Appearance, optics: Optics) -> Path:
    """The Python interpreter that has bpy, if Blender can render that.

    Raises MissingDependencyError where Blender is not installed, InputError where a camera has lens distortion, a
    light has a lobe other than Lambert's or a polariser, optics are not ideal, or teeth bear marks, none of which
    Blender offers.
    """
    if optics != IDEAL:
        raise InputError("optics: Blender renders ideal ones only; use the renderer embree")
    if appearance.marked:
        raise InputError("texture: Blender renders no stains, fillings, vessels and stippling; use the renderer embree")
    for name in handpiece.rig.names:
        if not handpiece.rig[name].camera.is_pinhole:
            raise InputError(f"camera {name}: Blender cannot render this lens distortion; use the renderer embree")
    for name, light in handpiece.lights.items():
        if light.lobe_exponent != 1:
            raise InputError(
                f"light {name}: Blender's have lobe exponent 1, not {light.lobe_exponent:g}; use the renderer embree"
            )
        if light.glare != 1:
            raise InputError(f"light {name}: Blender has no polarisers (glare is not 1); use the renderer embree")
    return _with_bpy(os.environ.get(PYTHON_VARIABLE))


@cache
def _with_bpy(given: str | None) -> Path:
    """This Python interpreter. Raises MissingDependencyError where it has no bpy, saying how to get one that has."""
    if not given:
        raise MissingDependencyError(f"Blender is not set up: {_HOW_TO}")
    try:
        found = subprocess.run([given, "-c", "import bpy"], capture_output=True, text=True, check=False)
    except OSError as error:
        raise MissingDependencyError(
            f"{PYTHON_VARIABLE}={given} cannot be run ({error.strerror}): {_HOW_TO}"
        ) from error
    if found.returncode:
        reason = (found.stderr.strip().splitlines() or ["no message"])[-1]
        raise MissingDependencyError(f"{PYTHON_VARIABLE}={given} cannot import bpy ({reason}): {_HOW_TO}")
    return Path(given)


def _run_script(python: Path, folder: Path) -> Iterator[tuple[str, str]]:
    """Run the script and yield frame and camera of each image as it is there."""
    with (
        (folder / "errors.txt").open("w+") as errors,
        subprocess.Popen([python, _SCRIPT, folder], stdout=subprocess.PIPE, stderr=errors, text=True) as process,
    ):
        try:
            for line in process.stdout or ():
                if line.startswith("rendered "):
                    _, frame, camera = line.split()
                    yield frame, camera
        except BaseException:
            process.terminate()
            raise
        if process.wait():
            errors.seek(0)
            reason = (errors.read().strip().splitlines() or ["no message"])[-1]
            raise MissingDependencyError(f"Blender stopped ({reason}); it was tested with bpy 4.5")


def _write_scene(
    folder: Path,
    scene: Scene,
    poses: Mapping[str, Rigid3],
    tasks: Sequence[tuple[Frame, str]],
    threads: int,
) -> None:
    mesh = scene.jaw.mesh
    np.savez(folder / "mesh.npz", vertices=mesh.vertices, faces=mesh.faces, materials=face_materials(scene.jaw))
    description = {
        "samples": SAMPLES,
        "threads": threads,
        "materials": [dataclasses.asdict(each) for each in (scene.appearance.enamel, scene.appearance.gum)],
        "images": [
            {
                "frame": frame.name,
                "name": name,
                "seed": zlib.crc32(f"{scene.seed}/{frame.name}/{name}".encode()) & 0x7FFFFFFF,
                "camera": _camera(scene.handpiece.rig[name], poses[frame.name]),
                "lights": [_light(light, poses[frame.name]) for light in scene.handpiece.lights_on(frame.lighting)],
            }
            for frame, name in tasks
        ],
    }
    (folder / "scene.json").write_text(json.dumps(description))


def _camera(mounted: MountedCamera, rig_from_world: Rigid3) -> dict[str, Any]:
    camera = mounted.camera
    return {
        "width": camera.width,
        "height": camera.height,
        "focal_px": camera.focal_px.tolist(),
        "principal_point_px": camera.principal_point_px.tolist(),
        "world_from_cam": (mounted.cam_from_rig @ rig_from_world).inverse().matrix.tolist(),
    }


def _light(light: Light, rig_from_world: Rigid3) -> dict[str, Any]:
    world_from_rig = rig_from_world.inverse()
    # Blender's area lights shine along -Z; about that axis any turn will do.
    axis = -world_from_rig.rotate(light.direction)
    rotation = axes_about(axis).T
    return {
        "world_from_light": Rigid3(rotation, world_from_rig.apply(light.position_mm)).matrix.tolist(),
        "power": light.power,
        "colour": light.colour.tolist(),
        "diameter_mm": LED_DIAMETER_MM,
    }
