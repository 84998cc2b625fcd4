"""Hold single frames of plain enamel, and single steps from one to the next, against the truth.

    python benchmarks/plain_frames.py FOLDER [--work build/plain_frames] [--only phantom-0-41] [--add]

FOLDER holds labelled meshes of real jaws. Sixteen frames pass over a tooth, 1 mm apart. Their depth is measured by
light and shade, and for comparison with OpenCV's StereoSGBM, of the widest pairs of each group, rectified at full
resolution and checked both ways. Then each frame is laid onto the next one as a scan does it, from its true place: what
the mean of these steps is off by goes along from frame to frame and bends an arch, while their scatter is what chance
does. A scan of an arch has one length, which chance moves by 0.2 mm; this tells a change for the better from one for
the worse with a tenth of the work.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from enamel import PHANTOMS, REAL, jaw_of, lit
from jaws import figures_of, parser_of
from jaxtyping import Float, UInt8
from run import conditions

from cuspid.geometry import Rigid3
from cuspid.model.capture import Capture
from cuspid.model.mesh import Mesh
from cuspid.model.pairing import rank_sources
from cuspid.model.rig import Handpiece
from cuspid.motion.icp.surface_tracking import SurfaceTrackingOptions, adjust_poses
from cuspid.motion.icp.surfaces import Surface, surface_of
from cuspid.mvs.initial_depth import initial_pairs, semi_global
from cuspid.mvs.matching import DepthEstimator
from cuspid.mvs.rectification import RectifiedPair, rectify
from cuspid.pipeline import scan as pipeline
from cuspid.pipeline.scan import SimulationOptions
from cuspid.runtime.progress import silent
from cuspid.simulation.optics import OpticsOptions
from cuspid.simulation.path.scan import ScanPathOptions
from cuspid.storage import read_poses, write_json
from cuspid.studies.grid import Case, Value
from cuspid_thesis.scan_cases import commit

HERE = Path(__file__).parent
FRAMES, LENGTH_MM = 16, 15.0
FRONT = 41
"""A tooth of the phantom, of which frames tell the least."""
FAR_UM, OBLIQUE = 200.0, 0.2
"""Errors beyond the first are of another surface; cosines below the second are not asked for their trend."""
TWIST = ("pitch_x", "pitch_y", "turn_z", "along_x", "across_y", "up_z")


class Compared(NamedTuple):
    """Pixels of a depth map that see the jaw in the range of depth."""

    error_um: Float[np.ndarray, "n"]
    """NaN where there is no depth."""
    cosine: Float[np.ndarray, "n"]
    """Of the angle between the line of sight and the true normal."""


def cases(folder: Path) -> Iterator[Case]:
    """Molars and front teeth, ideal and clinical."""
    teeth: dict[str, dict[str, Value]] = {}
    for seed, molar in PHANTOMS.items():
        for tooth in (molar, FRONT):
            teeth[f"phantom-{seed}-{tooth}"] = {"jaw": str(seed), "tooth": tooth}
    for name, tooth in REAL.items():
        file = next(map(str, folder.rglob(f"{name}.ply")), None)
        if file is not None:
            teeth[f"{name}-{tooth}"] = {"jaw": file, "tooth": tooth}
    for name, each in teeth.items():
        yield Case(name=name, parameters={**each, "optics": "ideal"})
        yield Case(name=f"{name}-clinical", parameters={**each, "optics": "clinical"})


def compared(
    truth: Mesh,
    rays: Float[np.ndarray, "n 3"],
    depth_mm: Float[np.ndarray, "n"],
    cam_from_world: Rigid3,
    depth_range_mm: tuple[float, float],
) -> Compared:
    """Depths along rays (z = 1) of a camera beside those of the true surface."""
    world_from_cam = cam_from_world.inverse()
    origin = np.broadcast_to(world_from_cam.translation, rays.shape)
    hits = truth.cast_on_all_cores(origin, world_from_cam.rotate(rays))
    there = (hits.distances > depth_range_mm[0]) & (hits.distances < depth_range_mm[1])
    normals = cam_from_world.rotate(truth.face_normals[hits.faces[there]])
    cosine = -(normals * rays[there]).sum(axis=1) / np.linalg.norm(rays[there], axis=1)
    return Compared(1000 * (depth_mm[there] - hits.distances[there]), cosine)


def widest_pairs(handpiece: Handpiece) -> tuple[RectifiedPair, ...]:
    """That each camera begins with, at full resolution."""
    rig, distance_mm = handpiece.rig, handpiece.working_distance_mm
    pairs = initial_pairs(rig, rank_sources(rig, distance_mm), distance_mm).values()
    found = {tuple(sorted(pair)) for pair in pairs}
    return tuple(rectify((one, other), rig[one], rig[other], 1.0) for one, other in sorted(found))


def by_semi_global(
    pairs: tuple[RectifiedPair, ...],
    grays: Mapping[str, UInt8[np.ndarray, "h w"]],
    truth: Mesh,
    rig_from_world: Rigid3,
    depth_range_mm: tuple[float, float],
) -> Iterator[Compared]:
    """Of each pair, as seen from its left camera."""
    near, far = depth_range_mm
    for pair in pairs:
        first, second = pair.resample(*(grays[name] for name in pair.names))
        disparity = semi_global(first, second, (pair.disparity(far), pair.disparity(near)))
        depth = pair.disparity(1.0) / np.where(disparity > 0, disparity, np.nan)
        rays = pair.camera.rays(pair.camera.pixel_centres().reshape(-1, 2))
        seen = first.ravel() > 0
        place = pair.first_from_rig @ rig_from_world
        yield compared(truth, rays[seen], depth.ravel()[seen], place, depth_range_mm)


def summary(parts: list[Compared], prefix: str = "") -> dict[str, Value]:
    """What is found, how far off, and how much farther oblique surfaces come out."""
    error, cosine = (np.concatenate(each) for each in zip(*parts, strict=True))
    known = np.isfinite(error)
    near = known & (np.abs(error) < FAR_UM)
    inclined = near & (cosine > OBLIQUE)
    trend = np.polyfit(cosine[inclined], error[inclined], 1)[0] if inclined.sum() > 2 else np.nan
    return {
        f"{prefix}known_pct": 100 * float(known.mean()),
        f"{prefix}within_50_um_pct": 100 * float((near & (np.abs(error) < 50)).mean()),
        f"{prefix}median_um": float(np.median(np.abs(error[known]))) if known.any() else None,
        f"{prefix}per_cosine_um": float(trend) if np.isfinite(trend) else None,
    }


def steps(surfaces: list[Surface], poses: list[Rigid3], distance_mm: float) -> dict[str, Value]:
    """Mean of what the steps from each frame to the next are off by, in the frame of the later one, and the standard
    error of this mean: rotations in mrad, translations in um."""
    options, twists = SurfaceTrackingOptions(), []
    for k in range(len(poses) - 1):
        true = poses[k + 1] @ poses[k].inverse()
        (first, second), *_ = adjust_poses(surfaces[k : k + 2], poses[k : k + 2], options, distance_mm, silent)
        off = second @ first.inverse() @ true.inverse()
        twists.append(1000 * np.concatenate([off.rotation_vector, off.translation]))
    mean, error = np.mean(twists, axis=0), np.std(twists, axis=0, ddof=1) / np.sqrt(len(twists))
    means = {f"step_{name}": float(value) for name, value in zip(TWIST, mean, strict=True)}
    return {**means, **{f"step_{name}_error": float(value) for name, value in zip(TWIST, error, strict=True)}}


def measured(capture: Capture, truth: Mesh, poses: Mapping[str, Rigid3]) -> dict[str, Value]:
    """The figures of a capture."""
    handpiece, options = capture.handpiece, SurfaceTrackingOptions()
    estimator = DepthEstimator(handpiece, signal="shading")
    rectified = widest_pairs(handpiece)
    surfaces, shaded, matched = [], list[Compared](), list[Compared]()
    for frame in capture.frames:
        images, pose = capture.images(frame), poses[frame.name]
        maps = estimator.measure(images, frame.name, frame.lighting, alone=True)
        for each in maps:
            rays = each.camera.rays(each.camera.pixel_centres().reshape(-1, 2))
            depth = np.where(each.known, each.depth_mm, np.nan).ravel().astype(float)
            shaded.append(compared(truth, rays, depth, each.cam_from_rig @ pose, handpiece.depth_range_mm))
        grays = {name: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for name, image in images.items()}
        matched += by_semi_global(rectified, grays, truth, pose, handpiece.depth_range_mm)
        distance_mm, border_px = handpiece.working_distance_mm, options.border_px
        surfaces.append(surface_of(maps, distance_mm, thinning=options.thinning, border_px=border_px))
    placed = [poses[frame.name] for frame in capture.frames]
    return {
        "frames": len(placed),
        **summary(shaded),
        **summary(matched, "sgbm_"),
        **steps(surfaces, placed, handpiece.working_distance_mm),
    }


def judge(*, jaw: str, tooth: int, optics: Literal["ideal", "clinical"], scans: Path) -> dict[str, Value]:
    """The figures of one tooth. The images are not kept."""
    folder = scans / f"{Path(jaw).stem}-{tooth}-{optics}"
    path = ScanPathOptions(tooth=tooth, frames=FRAMES, length_mm=LENGTH_MM)
    options = SimulationOptions(texture="enamel", optics=OpticsOptions(optics=optics), path=path)
    capture, _ = pipeline.simulate(jaw_of(jaw), lit("coded"), folder, options)
    truth = pipeline.load_reference(folder / "truth").jaw.mesh
    found = measured(capture, truth, read_poses(folder / "truth" / "poses.json"))
    shutil.rmtree(folder)
    return {"commit": commit(), **found}


def main() -> None:
    """Measure what is asked for and write the figures."""
    arguments = parser_of(__doc__, Path("build/plain_frames"), HERE / "results" / "plain_frames.json").parse_args()
    how = partial(judge, scans=arguments.work / "unfinished")
    scans = figures_of(list(cases(arguments.folder)), how, arguments.work, arguments.out, arguments)
    write_json(arguments.out, {"scans": scans, **conditions()})


if __name__ == "__main__":
    main()
