"""How noisy is matching, as two images show a surface more and more differently? Measured on rendered pairs.

A pair of cameras whose axes meet on a textured tooth is rendered at growing baselines. Each point that both see is
matched, started a pixel off its true place, by one of two matchers: *slanted*, the refinement of this program, whose
window turns with the surface; *upright*, a window that is only shifted (Lucas-Kanade), as plain correlation does. The
error is the distance along the epipolar line between where the point is found in the second image and where it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from cuspid.geometry import Rigid3
from cuspid.handpiece.precision import deformation
from cuspid.handpiece.presets import PRESETS
from cuspid.model.camera import OPENCV_PIXEL_OFFSET, Camera
from cuspid.model.capture import Frame
from cuspid.model.jaw import Jaw
from cuspid.model.rig import Handpiece, Light, Lighting, MountedCamera
from cuspid.mvs.matching import coarser, group_geometry
from cuspid.mvs.rectification import IdealView
from cuspid.mvs.refinement import SCORE, Q, RefinementOptions, image_noise, refine
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import SEED, TOOTH, Options, Range
from cuspid.simulation.appearance import APPEARANCES, Preset
from cuspid.simulation.raycast import Scene, auto_gain, render_image
from cuspid.studies.camera_pair import (
    MATCHING,
    Matcher,
    baseline_axis,
    camera_pair,
    convergence_deg,
    pose_facing,
    tooth_surfaces,
)

_DEPTHS_MM = (1.0, 20.0)
_MARGIN_PX = 8.0
"""Points nearer to the border of the second image are not asked for."""
_WINDOW_SIGMA_PX = 2.0
"""Of the weight over the slanted window."""
_LED_MM = 1.5
"""Two LEDs stand so far from the middle of the pair, square to the baseline."""


@dataclass(frozen=True, kw_only=True)
class MatchingNoiseOptions(Options):
    """The rendered camera pairs."""

    tooth: Annotated[int, TOOTH] = 47
    """FDI number of the tooth, seen from the occlusal side."""
    baselines_mm: Annotated[tuple[float, ...], Range(0.01, 1000)] = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
    """Distances between the projection centres; the axes meet on the tooth."""
    distance_mm: Annotated[float, Range(0.1, 1000)] = 5.0
    """Distance from the pair to the middle of the occlusal surface."""
    sensor: str = "thesis"
    """Name of the optics."""
    texture: Preset = "artificial"
    """Appearance of the tooth."""
    seed: Annotated[int, SEED] = 0
    """Seed of the texture and the noise."""
    spacing_px: Annotated[int, Range(1, 1000)] = 4
    """Spacing of the matched points in the image."""
    start_px: Annotated[float, Range(0, 1000)] = 1.0
    """Standard deviation of the starting position along the epipolar line."""
    window_px: Annotated[int, Range(3, 1001)] = 7
    """Side of the upright window; the slanted one has the same size."""
    max_error_px: Annotated[float, Range(0.01, 1000)] = 1.0
    """A match farther off than this counts as failed, not as noise."""
    max_incidence_deg: Annotated[float, Range(1, 90)] = 75.0
    """Points that a camera sees at a larger angle of incidence are left out."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MatchingSamples:
    """Points matched in pairs of images."""

    convergence_deg: Float[np.ndarray, "n"]
    """Angle between the axes of the pair, which meet on the tooth."""
    deformation: Float[np.ndarray, "n"]
    """See :mod:`cuspid.handpiece.precision`."""
    error_px: Float[np.ndarray, "n"]
    """Along the epipolar line; NaN where the match failed."""


@dataclass(frozen=True, eq=False)
class _Points:
    """True places of the points in the first image that both cameras see."""

    left_px: Float[np.ndarray, "n 2"]
    in_rig: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    known: Bool[np.ndarray, "h w"]
    """Which pixels of the grid they are."""


def sample_matching(
    jaw: Jaw, options: MatchingNoiseOptions, rng: np.random.Generator
) -> dict[Matcher, MatchingSamples]:
    """Errors of both matchers over all pairs."""
    runs = [_sample_pair(jaw, options, baseline, rng) for baseline in options.baselines_mm]
    return {
        matcher: MatchingSamples(
            convergence_deg=np.concatenate([run[matcher].convergence_deg for run in runs]),
            deformation=np.concatenate([run[matcher].deformation for run in runs]),
            error_px=np.concatenate([run[matcher].error_px for run in runs]),
        )
        for matcher in MATCHING
    }


def _sample_pair(
    jaw: Jaw, options: MatchingNoiseOptions, baseline_mm: float, rng: np.random.Generator
) -> dict[Matcher, MatchingSamples]:
    handpiece = _handpiece(options, baseline_mm)
    surface = tooth_surfaces(jaw, options.tooth)["occlusal"]
    along = baseline_axis(jaw, options.tooth, "occlusal", "across")
    pose = pose_facing(jaw.mesh, surface, along, options.distance_mm)
    images = _images(jaw, handpiece, pose, options)
    cameras = tuple(handpiece.rig.cameras.values())
    points = _true_points(jaw, cameras, pose, options)
    true_px = cameras[1].camera.project(cameras[1].cam_from_rig.apply(points.in_rig))
    epipolar = _epipolar(cameras[1], points.in_rig)
    starts_px = options.start_px * rng.standard_normal(len(true_px))
    found = {
        "slanted": _match_slanted(images, cameras, points, starts_px, options),
        "upright": _upright(images, points, true_px + starts_px[:, None] * epipolar, options),
    }
    seen = np.ones((2, len(true_px)), dtype=bool)
    deformations = deformation(cameras, points.in_rig, points.normals, seen)[0]
    angle = convergence_deg(baseline_mm, options.distance_mm)
    samples: dict[Matcher, MatchingSamples] = {}
    for matcher in MATCHING:
        errors = np.sum((found[matcher] - true_px) * epipolar, axis=1)
        errors[~(np.abs(errors) <= options.max_error_px)] = np.nan
        samples[matcher] = MatchingSamples(
            convergence_deg=np.full(len(errors), angle), deformation=deformations, error_px=errors
        )
    return samples


def _handpiece(options: MatchingNoiseOptions, baseline_mm: float) -> Handpiece:
    if options.sensor not in PRESETS:
        raise InputError(f"matching noise: unknown sensor {options.sensor!r}; choose one of {', '.join(PRESETS)}")
    angle = convergence_deg(baseline_mm, options.distance_mm)
    ahead = np.array([0.0, 0.0, 1.0])
    lights = {str(side): Light(position_mm=np.array([0.0, side * _LED_MM, 0.0]), direction=ahead) for side in (-1, 1)}
    return Handpiece(
        rig=camera_pair(baseline_mm, angle, PRESETS[options.sensor].camera),
        lights=lights,
        lightings=(Lighting(lights=tuple(lights)),),
        working_distance_mm=options.distance_mm,
        depth_range_mm=_DEPTHS_MM,
        name=f"pair-{baseline_mm:g}",
    )


def _images(
    jaw: Jaw, handpiece: Handpiece, pose: Rigid3, options: MatchingNoiseOptions
) -> tuple[UInt8[np.ndarray, "h w"], ...]:
    appearance = APPEARANCES[options.texture].at_footprint(handpiece.footprint_mm)
    scene = Scene(jaw=jaw, handpiece=handpiece, appearance=appearance, seed=options.seed)
    gain = auto_gain(scene, [pose])
    frame = Frame(name=handpiece.name, cameras=handpiece.rig.names)
    rendered = [render_image(scene, frame, name, pose, gain) for name in frame.cameras]
    return tuple(np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8) for image in rendered)


def _true_points(jaw: Jaw, cameras: Sequence[MountedCamera], pose: Rigid3, options: MatchingNoiseOptions) -> _Points:
    """The points of the tooth at the grid's pixels of the first camera that both cameras see well inside."""
    left, right = cameras
    world_from_left = (left.cam_from_rig @ pose).inverse()
    grid = coarser(left.camera, options.spacing_px)
    rays = world_from_left.rotate(grid.rays(grid.pixel_centres().reshape(-1, 2)))
    hits = jaw.mesh.cast(np.broadcast_to(world_from_left.translation, rays.shape), rays)
    pixels = np.flatnonzero((hits.faces >= 0) & jaw.tooth_faces(options.tooth)[hits.faces])
    in_world = world_from_left.translation + hits.distances[pixels, None] * rays[pixels]
    normals = jaw.mesh.face_normals[hits.faces[pixels]]
    good = right.camera.contains(right.camera.project((right.cam_from_rig @ pose).apply(in_world)), _MARGIN_PX)
    for mounted in cameras:
        eye = (mounted.cam_from_rig @ pose).inverse().translation
        sight = (eye - in_world) / np.linalg.norm(eye - in_world, axis=1, keepdims=True)
        good &= np.sum(sight * normals, axis=1) >= np.cos(np.deg2rad(options.max_incidence_deg))
        good &= ~jaw.mesh.occluded(in_world, np.broadcast_to(eye, in_world.shape))
    known = np.zeros((grid.height, grid.width), dtype=bool)
    known.ravel()[pixels[good]] = True
    in_rig = pose.apply(in_world[good])
    return _Points(
        left_px=left.camera.project(left.cam_from_rig.apply(in_rig)),
        in_rig=in_rig,
        normals=pose.rotate(normals[good]),
        known=known,
    )


def _epipolar(camera: MountedCamera, in_rig: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Unit directions in which the points move in the second image as they move away from the first camera."""
    in_cam = camera.cam_from_rig.apply(in_rig)
    eye = camera.cam_from_rig.apply(-camera.centre_in_rig)
    moved = camera.camera.project(in_cam + 1e-4 * (in_cam - eye)) - camera.camera.project(in_cam)
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


def _match_slanted(
    images: Sequence[UInt8[np.ndarray, "h w"]],
    cameras: Sequence[MountedCamera],
    points: _Points,
    starts_px: Float[np.ndarray, "n"],
    options: MatchingNoiseOptions,
) -> Float[np.ndarray, "n 2"]:
    """Places in the second image, by the refinement of depth; NaN where it accepts none."""
    views = tuple(IdealView.of(str(k), mounted) for k, mounted in enumerate(cameras))
    geometry = group_geometry(views, 0, (1,))
    grid: Camera = coarser(views[0].camera, options.spacing_px)
    seeds = np.full(points.known.shape, np.nan)
    true_mm = cameras[0].cam_from_rig.apply(points.in_rig)[:, 2]
    seeds[points.known] = geometry.scale / (geometry.scale / true_mm + starts_px)
    stack = np.stack(images).astype(np.float32)
    sizes = np.array([image.shape for image in images])
    refinement = RefinementOptions(radius_px=options.window_px // 2, window_sigma_px=_WINDOW_SIGMA_PX)
    noise_dn = image_noise(stack[0])
    planes = refine(stack, sizes, 0, geometry, seeds[None], _DEPTHS_MM, options.spacing_px, noise_dn, refinement)
    planes = planes[points.known]
    found = planes[:, SCORE] >= refinement.accept_zncc
    depth_mm = geometry.scale / np.where(found, planes[:, Q], np.nan)
    rays = grid.rays(grid.pixel_centres()[points.known])
    in_rig = cameras[0].cam_from_rig.inverse().apply(rays * depth_mm[:, None])
    return cameras[1].camera.project(cameras[1].cam_from_rig.apply(in_rig))


def _upright(
    images: Sequence[UInt8[np.ndarray, "h w"]],
    points: _Points,
    starts_px: Float[np.ndarray, "n 2"],
    options: MatchingNoiseOptions,
) -> Float[np.ndarray, "n 2"]:
    """Places in the second image, by a window that is shifted; NaN where it is lost."""
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        images[0],
        images[1],
        _opencv(points.left_px),
        _opencv(starts_px),
        winSize=(options.window_px, options.window_px),
        maxLevel=0,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.where(status == 1, found[:, 0].astype(np.float64) + OPENCV_PIXEL_OFFSET, np.nan)


def _opencv(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 1 2"]:
    return np.ascontiguousarray((pixels - OPENCV_PIXEL_OFFSET)[:, None], dtype=np.float32)


# --- What follows from the samples ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class NoiseFit:
    """The law sigma^2 (1 + (x / doubling)^power), x the deformation or the convergence, fitted to binned samples."""

    sigma_px: float
    """In each of the two images."""
    doubling: float
    """Where the variance has doubled; infinite where it does not grow."""


def bin_samples(
    samples: MatchingSamples, edges: Sequence[float], by: Literal["deformation", "convergence_deg"] = "deformation"
) -> list[dict[str, float]]:
    """Count, share matched, and noise in each bin: RMS error over root two, for both images share it."""
    values = getattr(samples, by)
    rows = []
    for low, high in pairwise(edges):
        errors = samples.error_px[(values >= low) & (values < high)]
        good = errors[np.isfinite(errors)]
        if len(good) >= 30:
            sigma = float(np.sqrt(np.mean(good**2) / 2))
            row = {"low": low, "high": high, "count": float(len(errors)), "matched_pct": 100 * len(good) / len(errors)}
            rows.append({**row, "sigma_px": sigma, "robust_px": float(1.4826 * np.median(np.abs(good)) / np.sqrt(2))})
    return rows


def fit_noise(rows: Sequence[dict[str, float]], power: float = 2.0) -> NoiseFit:
    """Least squares of the law over the middles of the bins, relative to their variance, weighted by their counts."""
    middles = np.array([(row["low"] + row["high"]) / 2 for row in rows])
    variances = np.array([row["sigma_px"] ** 2 for row in rows])
    weights = np.sqrt([row["count"] for row in rows]) / variances
    design = np.stack([np.ones_like(middles), middles**power], axis=1)
    constant, slope = np.linalg.lstsq(design * weights[:, None], variances * weights, rcond=None)[0]
    doubling = float((constant / slope) ** (1 / power)) if slope > 0 else float("inf")
    return NoiseFit(sigma_px=float(np.sqrt(constant)), doubling=doubling)
