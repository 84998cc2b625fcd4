"""Where the photographs of one camera were taken, and its lens: structure from motion in any order (J. Schönberger,
J.-M. Frahm, CVPR 2016), in units of the model.

Frames: as in :mod:`cuspid.model.sparse_model`; the world is the frame of the first located photograph. Photographs are
processed in the order of their contents, so that their names do not matter.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pycolmap
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.camera import Camera
from cuspid.model.capture import Dropped
from cuspid.model.photographs import Photograph, Photographs
from cuspid.model.reconstruction import Tracks
from cuspid.model.sparse_model import PhotoModel
from cuspid.motion.colmap import quiet, rigid_from_colmap
from cuspid.motion.frontend.features import FeatureOptions, Features
from cuspid.motion.monocular.photograph_matches import (
    Pair,
    camera_of,
    candidate_pairs,
    detect_in_all,
    fill_database,
    match_pairs,
    verified_pairs,
    with_focal_lengths,
)
from cuspid.runtime.errors import InputError, ReconstructionError
from cuspid.runtime.options import SEED, SHARE, Options, Range
from cuspid.runtime.progress import Progress, silent

LEAST_PHOTOGRAPHS = 3
"""Two tell no more than a direction from each other."""
_OTHER_FOCALS: tuple[dict[int, float], ...] = ({0: 1.2}, {0: 2.4}, {0: 0.75})
"""Of the longer side: where COLMAP's guess (1.2) leads nowhere, a tele and a wide-angle lens; 0 is any camera."""
_TELLING = 5
"""A model of so many photographs tells a focal length."""
_STILL_PAIRS = 0.5
"""Where more than this share of the pairs show the same at the same place, the camera stood still."""
_LENS_GAIN = 0.03
"""Share of the RMS error that a further lens parameter must take away, not to be left at zero."""
_MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""COLMAP's models of a lens, each with all parameters of the one before it."""
_MANY_PER_CAMERA = 8
_LOSS_PX, _WORST_SIGMAS, _LEAST_PX = 1.0, 4.0, 1.0
_NARROW_DEG = 2.0


@dataclass(frozen=True, kw_only=True)
class PhotographOptions(Options):
    """How photographs of one camera are located."""

    features: FeatureOptions = field(
        default_factory=lambda: FeatureOptions(count=6000, contrast=0.02, cell_px=32, upright=False)
    )
    """Keypoints; the camera may be turned in any way from one photograph to the next."""
    plain_features: FeatureOptions = field(
        default_factory=lambda: FeatureOptions(count=6000, contrast=0.01, edge=20.0, cell_px=32, upright=False)
    )
    """Keypoints of photographs with even local contrast, where too few were located by the others: plaster, enamel,
    varnish."""
    max_image_px: Annotated[int, Range(200, 100_000)] = 2400
    """The longer side of larger photographs is reduced to this many px before keypoints are searched."""
    exhaustive: Annotated[int, Range(2, 10_000)] = 100
    """Up to so many photographs each is matched with every other, unless they are a film."""
    alike: Annotated[int, Range(1, 10_000)] = 30
    """Otherwise each is matched with so many that look most like it; in a film also with the next ones."""
    ratio: Annotated[float, Range(0.01, 1)] = 0.8
    """Ratio test of the matching."""
    plain_ratio: Annotated[float, Range(0.01, 1)] = 0.85
    """The same where too few were located."""
    min_matches: Annotated[int, Range(8, 100_000)] = 15
    """Minimum number of consistent matches of two photographs."""
    enough_share: Annotated[float, SHARE] = 0.9
    """Share (0 to 1) of the photographs that is enough not to try again, with keypoints for plain surfaces."""
    seed: Annotated[int, SEED] = 0
    """Seed of the random samples."""


def locate_photographs(
    photographs: Photographs, options: PhotographOptions | None = None, *, progress: Progress = silent
) -> PhotoModel:
    """Poses of photographs in any order, their lens, and the points that they see.

    The largest model counts. Raises ReconstructionError where there is none, or the camera stood still.
    """
    options = options or PhotographOptions()
    check_enough(photographs)
    order = in_own_order(photographs)
    best: _Attempt | None = None
    with tempfile.TemporaryDirectory() as folder, quiet():
        for plain in (False, True):
            attempt = _attempt(photographs, order, Path(folder), options, plain=plain, progress=progress)
            if best is None or attempt.located > best.located:
                best = attempt
            if best.located >= options.enough_share * len(order):
                break
        assert best is not None
        if not best.models:
            raise ReconstructionError(_why_nothing(photographs, order, best))
        return _to_sparse_model(photographs, order, best)


def check_enough(photographs: Photographs) -> None:
    """Raises InputError where there are too few photographs."""
    count = len(photographs.names)
    if count < LEAST_PHOTOGRAPHS:
        raise InputError(
            f"{photographs.source}: {count} photographs are too few; take at least {LEAST_PHOTOGRAPHS}, better 20 to "
            "60, from places all around, each with half of what the one before it shows"
        )


def in_own_order(photographs: Photographs) -> tuple[Photograph, ...]:
    """A film as it was taken, other photographs by their contents, whatever their names."""
    if photographs.is_film:
        return photographs.photographs
    return tuple(sorted(photographs.photographs, key=lambda each: photographs.digest(each.name, each.camera)))


# --- an attempt --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Attempt:
    """What came of one kind of keypoints."""

    features: Mapping[int, Features]
    unread: Sequence[Dropped]
    pairs: Sequence[Pair]
    models: Sequence[pycolmap.Reconstruction]
    """Largest first."""
    seconds: Mapping[str, float]

    @property
    def located(self) -> int:
        """Number of photographs in the largest model."""
        return int(self.models[0].num_reg_images()) if self.models else 0


def _attempt(
    photographs: Photographs,
    order: Sequence[Photograph],
    folder: Path,
    options: PhotographOptions,
    *,
    plain: bool,
    progress: Progress,
) -> _Attempt:
    started = time.perf_counter()
    how = options.plain_features if plain else options.features
    features, unread = detect_in_all(order, how, max_image_px=options.max_image_px, even=plain, progress=progress)
    detected = time.perf_counter()
    database = folder / f"{'plain' if plain else 'first'}.db"
    pairs = match_all(photographs, order, features, database, options, plain=plain, progress=progress)
    matched = time.perf_counter()
    models = _models(photographs, database, pairs, len(features), options, plain=plain, progress=progress)
    mapped = time.perf_counter()
    seconds = {
        "features_s": detected - started,
        "matching_s": matched - detected,
        "mapping_s": mapped - matched,
    }
    return _Attempt(features, unread, pairs, models, seconds)


def match_all(
    photographs: Photographs,
    order: Sequence[Photograph],
    features: Mapping[int, Features],
    database: Path,
    options: PhotographOptions,
    *,
    plain: bool,
    progress: Progress,
) -> list[Pair]:
    """Make the database of the photographs and the pairs that have something in common."""
    fill_database(database, photographs, order, features)
    candidates = candidate_pairs(
        features,
        is_film=photographs.is_film,
        most_exhaustive=options.exhaustive,
        alike=options.alike,
        seed=options.seed,
    )
    ratio = options.plain_ratio if plain else options.ratio
    match_pairs(database, candidates, ratio=ratio, least=options.min_matches, seed=options.seed, progress=progress)
    return verified_pairs(database, features, order)


def _models(
    photographs: Photographs,
    database: Path,
    pairs: Sequence[Pair],
    count: int,
    options: PhotographOptions,
    *,
    plain: bool,
    progress: Progress,
) -> list[pycolmap.Reconstruction]:
    """COLMAP's models, largest first. Where the first does not locate all, once more with fewer matches, from the focal
    length that it found, or from other guesses where it found none."""
    if not pairs or stood_still(pairs):
        return []
    models = _map(photographs, database, count, options, loose=plain, progress=progress)
    found = _focal_shares(models)
    told = all(each.calibrated is not None or each.focal_px is not None for each in photographs.cameras.values())
    for focal_share in (found,) if found or told else _OTHER_FOCALS:
        if models and models[0].num_reg_images() == count:
            break
        with_focal_lengths(database, photographs, focal_share)
        others = _map(photographs, database, count, options, loose=True, progress=progress)
        models = max(models, others, key=lambda each: _size(each[0]) if each else (0, 0))
    return models


def _focal_shares(models: Sequence[pycolmap.Reconstruction]) -> dict[int, float]:
    """Focal lengths that a model of several photographs has found, by number of the camera, as shares of the longer
    side."""
    if not models or models[0].num_reg_images() < _TELLING:
        return {}
    cameras = models[0].cameras.items()
    return {number: float(camera.params[0]) / max(camera.width, camera.height) for number, camera in cameras}


def _size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return int(model.num_reg_images()), int(model.compute_num_observations())


def stood_still(pairs: Sequence[Pair]) -> bool:
    """Whether most pairs show the same at the same place."""
    return bool(pairs) and sum(pair.is_still for pair in pairs) > _STILL_PAIRS * len(pairs)


def _mapper_options(
    photographs: Photographs, options: PhotographOptions, loose: bool
) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's defaults, repeatable; calibrated cameras are held."""
    # Threads would add in another order in each run, and bundle adjustment makes much of that.
    how = pycolmap.IncrementalPipelineOptions(
        random_seed=options.seed, num_threads=1, extract_colors=False, min_model_size=LEAST_PHOTOGRAPHS
    )
    how.min_num_matches = options.min_matches
    numbered = enumerate(photographs.cameras.values(), start=1)
    how.constant_cameras = {number for number, known in numbered if known.calibrated is not None}
    how.mapper.constant_cameras = how.constant_cameras
    if loose or len(photographs.names) < 2 * LEAST_PHOTOGRAPHS:
        how.mapper.init_min_num_inliers, how.mapper.init_min_tri_angle = 40, 6.0
        how.mapper.abs_pose_min_num_inliers, how.mapper.abs_pose_min_inlier_ratio = 15, 0.15
    return how


def _map(
    photographs: Photographs,
    database: Path,
    count: int,
    options: PhotographOptions,
    *,
    loose: bool,
    progress: Progress,
) -> list[pycolmap.Reconstruction]:
    placed = 0

    def tell() -> None:
        nonlocal placed
        placed = min(placed + 1, count)
        progress("mapping", placed, count)

    with tempfile.TemporaryDirectory(dir=database.parent) as folder:
        how = _mapper_options(photographs, options, loose)
        models = pycolmap.incremental_mapping(database, folder, folder, how, next_image_callback=tell)
    progress("mapping", count, count)
    return sorted(models.values(), key=_size, reverse=True)


# --- the lens ----------------------------------------------------------------------------------------------------


def refined(model: pycolmap.Reconstruction, held: frozenset[int]) -> tuple[pycolmap.Reconstruction, float]:
    """A model adjusted with as many parameters of the lens as its photographs bear, without what does not fit, and its
    RMS reprojection error, px.

    A parameter more must pay: one that the images do not determine turns with the poses. The principal point stays in
    the middle: it can hardly be told from a turn of the camera, above all in a ring of photographs.
    """
    rms = _adjust_model(model, held)
    by_camera = dict.fromkeys(model.cameras, 0)
    for identifier in model.reg_image_ids():
        by_camera[model.images[identifier].camera_id] += 1
    free = {number for number, count in by_camera.items() if number not in held and count >= _MANY_PER_CAMERA}
    for kind in _MODELS[1:] if free else ():
        wider = pycolmap.Reconstruction(model)
        for number in free:
            _widen(wider.cameras[number], kind)
        better = _adjust_model(wider, held)
        if better < (1 - _LENS_GAIN) * rms:
            model, rms = wider, better
    return model, rms


def _widen(camera: pycolmap.Camera, kind: str) -> None:
    """The same lens with more parameters."""
    wide = camera_of(camera, "camera")
    chosen = {"RADIAL": [0, 2, 3, 4, 5], "OPENCV": list(range(8))}[kind]
    camera.model = getattr(pycolmap.CameraModelId, kind)
    camera.params = wide.parameters[chosen].tolist()


def _adjust_model(model: pycolmap.Reconstruction, held: frozenset[int]) -> float:
    """Adjust all, twice, without what does not fit after the first time; RMS, px."""
    for _ in range(2):
        config = pycolmap.BundleAdjustmentConfig()
        for identifier in model.reg_image_ids():
            config.add_image(identifier)
        for number in held:
            config.set_constant_cam_intrinsics(number)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        how = pycolmap.BundleAdjustmentOptions(print_summary=False)
        how.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
        how.ceres.loss_function_scale = _LOSS_PX
        how.ceres.solver_options.num_threads = 1
        pycolmap.create_default_bundle_adjuster(how, config, model).solve()
        model.update_point_3d_errors()
        errors = np.array([point.error for point in model.points3D.values()])
        most = max(_WORST_SIGMAS * float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0, _LEAST_PX)
        manager = pycolmap.ObservationManager(model)
        manager.filter_all_points3D(most, 1.5)
    return adjusted_rms(model)


def adjusted_rms(model: pycolmap.Reconstruction) -> float:
    """RMS reprojection error, px."""
    model.update_point_3d_errors()
    lengths = np.array([point.track.length() for point in model.points3D.values()], dtype=np.float64)
    errors = np.array([point.error for point in model.points3D.values()])
    return float(np.sqrt(np.sum(lengths * errors**2) / max(lengths.sum(), 1)))


# --- models as values --------------------------------------------------------------------------------------------


def _to_sparse_model(photographs: Photographs, order: Sequence[Photograph], found: _Attempt) -> PhotoModel:
    numbered = enumerate(photographs.cameras.values(), start=1)
    held = frozenset(number for number, known in numbered if known.calibrated is not None)
    model, rms = refined(found.models[0], held & set(found.models[0].cameras))
    noun = photo_model(photographs, order, model, found.features)
    dropped = (*photographs.left_out, *found.unread, *_unlocated_reasons(order, found))
    counts = {"models": len(found.models), "pairs": len(found.pairs), "points": len(noun.tracks.points)}
    return replace(
        noun,
        reprojection_rms_px=rms,
        dropped=dropped,
        log={**found.seconds, **counts},
        notes=(*photographs.notes, *_notes(photographs, noun, found)),
    )


def photo_model(
    photographs: Photographs,
    order: Sequence[Photograph],
    model: pycolmap.Reconstruction,
    features: Mapping[int, Features],
) -> PhotoModel:
    """A model of COLMAP's, whose image k + 1 is photograph k of ``order``, as the noun."""
    by_name = {order[identifier - 1].name: identifier for identifier in model.reg_image_ids()}
    names = [name for name in photographs.names if name in by_name]
    poses = {name: rigid_from_colmap(model.images[by_name[name]].cam_from_world()) for name in names}
    used = {number: name for number, name in enumerate(photographs.cameras, start=1) if number in model.cameras}
    cameras = {name: camera_of(model.cameras[number], name) for number, name in used.items()}
    camera_names = {name: photographs[name].camera for name in names}
    cameras = {name: camera for name, camera in cameras.items() if name in camera_names.values()}
    known = PhotoModel(
        cameras={name: _keep_calibration(photographs, name, camera) for name, camera in cameras.items()},
        camera_of=camera_names,
        cam_from_world=poses,
        tracks=_tracks(model, [by_name[name] for name in names], list(cameras), camera_names, names, features),
    )
    return from_first(known)


def _keep_calibration(photographs: Photographs, name: str, camera: Camera) -> Camera:
    """A given calibration as it was given, with its covariance."""
    return photographs.cameras[name].calibrated or camera


def _tracks(
    model: pycolmap.Reconstruction,
    identifiers: Sequence[int],
    cameras: Sequence[str],
    camera_names: Mapping[str, str],
    names: Sequence[str],
    features: Mapping[int, Features],
) -> Tracks:
    place = {identifier: frame for frame, identifier in enumerate(identifiers)}
    points: list[np.ndarray] = []
    colors, rows, pixels = [], [], []
    for _, point in sorted(model.points3D.items()):
        seen = [each for each in point.track.elements if each.image_id in place]
        rows += [(len(points), place[each.image_id]) for each in seen]
        pixels += [features[each.image_id - 1].pixels[each.point2D_idx] for each in seen]
        colors.append(np.mean([features[e.image_id - 1].colors[e.point2D_idx] for e in seen], axis=0))
        points.append(point.xyz)
    index = np.array(rows, dtype=np.int64).reshape(-1, 2)
    camera_index = np.array([cameras.index(camera_names[name]) for name in names], dtype=np.int64)
    return Tracks(
        points=np.array(points, dtype=np.float64).reshape(-1, 3),
        colors=np.rint(np.array(colors).reshape(-1, 3)).astype(np.uint8),
        point_index=index[:, 0],
        frame_index=index[:, 1],
        camera_index=camera_index[index[:, 1]],
        pixels=np.array(pixels, dtype=np.float64).reshape(-1, 2),
    )


def from_first(model: PhotoModel) -> PhotoModel:
    """The same in the frame of the first located photograph."""
    first = next(iter(model.cam_from_world.values()))
    world_from_first = first.inverse()
    poses = {name: pose @ world_from_first for name, pose in model.cam_from_world.items()}
    identity = {model.frames[0]: Rigid3.identity()}
    tracks = replace(model.tracks, points=first.apply(model.tracks.points))
    return replace(model, cam_from_world={**poses, **identity}, tracks=tracks)


# --- what to tell ------------------------------------------------------------------------------------------------


def _unlocated_reasons(order: Sequence[Photograph], found: _Attempt) -> list[Dropped]:
    """The photographs that are not in the largest model, and why not."""
    placed, *others = ({int(identifier) - 1 for identifier in model.reg_image_ids()} for model in found.models)
    dropped = []
    for index in sorted(set(found.features) - placed, key=lambda each: order[each].name):
        partners = sum(index in (pair.first, pair.second) for pair in found.pairs)
        elsewhere = next((len(other) for other in others if index in other), 0)
        if elsewhere:
            reason = f"in another model, of {elsewhere} photographs, that nothing joins to this one"
        elif partners:
            reason = f"does not agree with the {partners} photographs that it matches"
        else:
            reason = f"matches no other photograph ({len(found.features[index])} keypoints)"
        dropped.append(Dropped(what=f"photograph {order[index].name}", reason=reason))
    return dropped


def _notes(photographs: Photographs, model: PhotoModel, found: _Attempt) -> list[str]:
    notes = []
    placed, *others = (set(each.reg_image_ids()) for each in found.models)
    apart = [len(other) for other in others if not other <= placed]
    if apart:
        notes.append(
            f"the largest of {1 + len(apart)} models is taken, with {found.located} photographs; the others have "
            f"{', '.join(map(str, apart))}: take photographs between them"
        )
    for name, camera in model.cameras.items():
        known = photographs.cameras[name]
        if known.calibrated is None:
            told = "EXIF and the photographs" if known.focal_px is not None else "the photographs"
            lens = ", ".join(f"{value:.4f}" for value in camera.distortion)
            notes.append(f"{name}: focal length {camera.focal_px[0]:.0f} px and distortion ({lens}) found from {told}")
    angle = float(np.median(_widest_angles_deg(model)))
    if angle < _NARROW_DEG:
        notes.append(
            f"the points are seen under {angle:.1f} deg in the median: the photographs were taken from nearly one "
            "place, and depth is poor; go around the thing"
        )
    return notes


def _widest_angles_deg(model: PhotoModel) -> Float[np.ndarray, "p"]:
    """Angle at each point between the first and the last photograph that see it."""
    tracks = model.tracks
    centres = np.stack([pose.inverse().translation for pose in model.cam_from_world.values()])
    order = np.lexsort((tracks.frame_index, tracks.point_index))
    sorted_points = tracks.point_index[order]
    first = np.searchsorted(sorted_points, np.arange(len(tracks.points)))
    last = np.searchsorted(sorted_points, np.arange(len(tracks.points)), side="right") - 1
    rays = [centres[tracks.frame_index[order[at]]] - tracks.points for at in (first, last)]
    cosine = np.sum(rays[0] * rays[1], axis=1) / (np.linalg.norm(rays[0], axis=1) * np.linalg.norm(rays[1], axis=1))
    return np.asarray(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))


def _why_nothing(photographs: Photographs, order: Sequence[Photograph], found: _Attempt) -> str:
    """What to tell a user whose photographs could not be located."""
    source, counts = photographs.source, [len(each) for each in found.features.values()]
    if not counts:
        return f"{source}: none of {len(order)} photographs can be read; the first: {found.unread[0].reason}"
    if stood_still(found.pairs):
        return still_message(photographs, found.pairs)
    if np.median(counts) < 50:
        return (
            f"{source}: the photographs show too little detail ({np.median(counts):.0f} keypoints each): out of focus, "
            "or too plain; dust, pencil marks or projected speckle help"
        )
    if not found.pairs:
        return (
            f"{source}: {len(order)} photographs have nothing in common with each other; take them of one thing, each "
            "with half of what the one before it shows"
        )
    return (
        f"{source}: {len(found.pairs)} pairs of {len(order)} photographs overlap, but they cannot be joined; go around "
        f"the thing in steps of 10 to 15 deg, with at least {LEAST_PHOTOGRAPHS} photographs of each part"
    )


def still_message(photographs: Photographs, pairs: Sequence[Pair]) -> str:
    """What to tell a user whose camera stood still before a background."""
    still = sum(pair.is_still for pair in pairs)
    return (
        f"{photographs.source}: in {still} of {len(pairs)} pairs of photographs nothing moves: it is the background "
        "that is located, as of a turntable before a fixed camera; mask it (masks/<photograph>.png, white is what "
        "counts), or move the camera instead"
    )
