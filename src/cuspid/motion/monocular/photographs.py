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
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float

from cuspid.model.capture import Dropped
from cuspid.model.photographs import Photograph, Photographs
from cuspid.model.sparse_model import PhotoModel
from cuspid.motion.colmap import ColmapModel, quiet
from cuspid.motion.frontend.features import FeatureOptions, Features
from cuspid.motion.monocular.mapping import (
    LEAST_PHOTOGRAPHS,
    calibrated_cameras,
    fill_database,
    focal_shares,
    guess_focal_lengths,
    located_images,
    map_photographs,
    match_pairs,
    model_size,
    photo_model,
    read_verified_pairs,
    refine_lens,
)
from cuspid.motion.monocular.photograph_matches import Pair, candidate_pairs, detect_in_all
from cuspid.runtime.errors import InputError, ReconstructionError
from cuspid.runtime.options import SEED, SHARE, Options, Range
from cuspid.runtime.progress import Progress, silent

_OTHER_FOCALS: tuple[dict[int, float], ...] = ({0: 1.2}, {0: 2.4}, {0: 0.75})
"""Of the longer side: where COLMAP's guess (1.2) leads nowhere, a tele and a wide-angle lens; 0 is any camera."""
_STILL_PAIRS = 0.5
"""Where more than this share of the pairs show the same at the same place, the camera stood still."""
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
    order = canonical_order(photographs)
    best: _Attempt | None = None
    with tempfile.TemporaryDirectory() as folder, quiet():
        for plain in (False, True):
            attempt = _attempt(photographs, order, Path(folder), options, plain=plain, progress=progress)
            if best is None or attempt.located_count > best.located_count:
                best = attempt
            if best.located_count >= options.enough_share * len(order):
                break
        assert best is not None
        if not best.models:
            raise ReconstructionError(_explain_failure(photographs, order, best))
        return _to_sparse_model(photographs, order, best)


def check_enough(photographs: Photographs) -> None:
    """Raises InputError where there are too few photographs."""
    count = len(photographs.names)
    if count < LEAST_PHOTOGRAPHS:
        raise InputError(
            f"{photographs.source}: {count} photographs are too few; take at least {LEAST_PHOTOGRAPHS}, better 20 to "
            "60, from places all around, each with half of what the one before it shows"
        )


def canonical_order(photographs: Photographs) -> tuple[Photograph, ...]:
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
    models: Sequence[ColmapModel]
    """Largest first."""
    seconds: Mapping[str, float]

    @property
    def located_count(self) -> int:
        """Number of photographs in the largest model."""
        return len(located_images(self.models[0])) if self.models else 0


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
    keypoints = options.plain_features if plain else options.features
    features, unread = detect_in_all(order, keypoints, max_image_px=options.max_image_px, even=plain, progress=progress)
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
    match_pairs(
        database, candidates, ratio=ratio, min_matches=options.min_matches, seed=options.seed, progress=progress
    )
    return read_verified_pairs(database, features, order)


def _models(
    photographs: Photographs,
    database: Path,
    pairs: Sequence[Pair],
    count: int,
    options: PhotographOptions,
    *,
    plain: bool,
    progress: Progress,
) -> list[ColmapModel]:
    """COLMAP's models, largest first. Where the first does not locate all, once more with fewer matches, from the focal
    length that it found, or from other guesses where it found none."""
    if not pairs or is_static(pairs):
        return []
    attempt = partial(
        map_photographs,
        photographs,
        database,
        count,
        min_matches=options.min_matches,
        seed=options.seed,
        progress=progress,
    )
    models = attempt(loose=plain)
    found = focal_shares(models)
    focal_known = all(each.calibrated is not None or each.focal_px is not None for each in photographs.cameras.values())
    for focal_share in (found,) if found or focal_known else _OTHER_FOCALS:
        if models and len(located_images(models[0])) == count:
            break
        guess_focal_lengths(database, photographs, focal_share)
        models = max(models, attempt(loose=True), key=lambda each: model_size(each[0]) if each else (0, 0))
    return models


def is_static(pairs: Sequence[Pair]) -> bool:
    """Whether most pairs show the same at the same place."""
    return bool(pairs) and sum(pair.is_still for pair in pairs) > _STILL_PAIRS * len(pairs)


# --- models as values --------------------------------------------------------------------------------------------


def _to_sparse_model(photographs: Photographs, order: Sequence[Photograph], found: _Attempt) -> PhotoModel:
    held = calibrated_cameras(photographs) & set(found.models[0].cameras)
    model, rms = refine_lens(found.models[0], held)
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


# --- what to tell ------------------------------------------------------------------------------------------------


def _unlocated_reasons(order: Sequence[Photograph], found: _Attempt) -> list[Dropped]:
    """The photographs that are not in the largest model, and why not."""
    placed, *others = (set(located_images(model)) for model in found.models)
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
    placed, *others = (set(located_images(each)) for each in found.models)
    apart = [len(other) for other in others if not other <= placed]
    if apart:
        notes.append(
            f"the largest of {1 + len(apart)} models is taken, with {found.located_count} photographs; the others have "
            f"{', '.join(map(str, apart))}: take photographs between them"
        )
    for name, camera in model.cameras.items():
        known = photographs.cameras[name]
        if known.calibrated is None:
            sources = "EXIF and the photographs" if known.focal_px is not None else "the photographs"
            lens = ", ".join(f"{value:.4f}" for value in camera.distortion)
            notes.append(
                f"{name}: focal length {camera.focal_px[0]:.0f} px and distortion ({lens}) found from {sources}"
            )
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


def _explain_failure(photographs: Photographs, order: Sequence[Photograph], found: _Attempt) -> str:
    """What to tell a user whose photographs could not be located."""
    source, counts = photographs.source, [len(each) for each in found.features.values()]
    if not counts:
        return f"{source}: none of {len(order)} photographs can be read; the first: {found.unread[0].reason}"
    if is_static(found.pairs):
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
    """The message for a user whose camera stood still before a background."""
    still = sum(pair.is_still for pair in pairs)
    return (
        f"{photographs.source}: in {still} of {len(pairs)} pairs of photographs nothing moves: it is the background "
        "that is located, as of a turntable before a fixed camera; mask it (masks/<photograph>.png, white is what "
        "counts), or move the camera instead"
    )
