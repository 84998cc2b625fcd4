"""Refinement of one camera's trajectory: frames are matched again near where the first poses predict, matches are
joined to tracks, and everything is adjusted, in rounds.

The first rounds search far around the prediction, so that errors of the poses do not select the matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from cuspid.model.reconstruction import Tracks
from cuspid.model.sparse_model import SparseModel
from cuspid.motion.bundle.adjustment import AdjustmentOptions, adjust_model
from cuspid.motion.frontend.features import Features
from cuspid.motion.frontend.pairs import IndexedFeatures, MatchingOptions, index_features, match_guided
from cuspid.motion.frontend.tracks import intersect_rays, join
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads

_DEPTH = 14.0
"""Depth to which a model is scaled here: guided matching assumes millimetres."""
_NEIGHBOURS = 5
"""Number of neighbouring points from whose depths that of a keypoint is predicted."""


@dataclass(frozen=True, kw_only=True)
class GuidedOptions(Options):
    """How the first poses are refined."""

    steps: Annotated[tuple[int, ...], Range(1, 100_000)] = (1, 2, 3, 4, 5, 6, 8)
    """Each frame is matched with the frames that are this many frames later."""
    tolerances_px: Annotated[tuple[float, ...], Range(0.01, 1000)] = (8.0, 4.0, 4.0)
    """Largest distance of a match from the epipolar line, for each round."""
    depth_shares: Annotated[tuple[float, ...], Range(0.001, 10)] = (0.28, 0.12, 0.06)
    """A point's depth is searched for within this share of the depth of its neighbours, for each round: along edges
    there are enough keypoints to match a wrong one farther away."""
    matching: MatchingOptions = field(default_factory=lambda: MatchingOptions(ratio=0.8, similarity=0.85))
    """Further criteria for a match."""
    min_views: Annotated[int, Range(2, 1000)] = 4
    """Tracks with fewer views are left out, except where a frame would lose all of its tracks."""
    start_px: Annotated[float, Range(0.01, 10_000)] = 12.0
    """Residual beyond which an observation is dropped before the first adjustment; half of it in later rounds."""
    adjustment: AdjustmentOptions = field(
        default_factory=lambda: AdjustmentOptions(sigma_px=0.5, outlier_sigmas=3.0, rounds=4, iterations=60)
    )
    """Final adjustment of each round."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.tolerances_px or len(self.tolerances_px) != len(self.depth_shares):
            raise InputError(
                f"guided matching: {len(self.tolerances_px)} tolerances and {len(self.depth_shares)} depth shares; "
                "give one of each for every round, at least one"
            )


def refine(
    model: SparseModel,
    features: Sequence[Features],
    options: GuidedOptions,
    *,
    again: Sequence[tuple[int, int]] = (),
    progress: Progress = silent,
) -> SparseModel:
    """The model of one camera with refined poses and new tracks; ``features`` are those of its frames, in their order.

    ``again`` are pairs of frames (indices) that show the same place, beside those of ``options.steps``. The scale is
    free and changes. Raises ReconstructionError where too little is consistent.
    """
    model = _normalize_scale(model)
    pairs = list(dict.fromkeys([*_pairs_by_step(len(features), options.steps), *again]))
    for number, (tolerance_px, share) in enumerate(zip(options.tolerances_px, options.depth_shares, strict=True)):
        views = [index_features(each, model.camera) for each in features]
        matching = replace(options.matching, tolerance_px=tolerance_px)
        track, image_of = _tracks(model, views, matching, share, pairs)
        limit_px = options.start_px / (1 if number == 0 else 2)
        found = _triangulate_tracks(model, features, views, track, image_of, limit_px, options)
        model = _normalize_scale(adjust_model(found, replace(options.adjustment, start_px=limit_px)))
        progress("refining", number + 1, len(options.tolerances_px))
    return model


def _pairs_by_step(count: int, steps: Sequence[int]) -> list[tuple[int, int]]:
    return [(i, i + step) for step in steps for i in range(count - step)]


def _normalize_scale(model: SparseModel) -> SparseModel:
    """With a median depth of `_DEPTH`."""
    return model.scaled(_DEPTH / float(np.median(model.depths)))


def _bounds(
    model: SparseModel, frame: int, features: Features, share: float
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Least and greatest depth of each keypoint, about those of the points seen near it."""
    tracks = model.tracks
    mine = tracks.frame_index == frame
    depths = model.depths[mine]
    if len(depths) < _NEIGHBOURS:
        return np.full(len(features), (1 - share) * _DEPTH), np.full(len(features), (1 + share) * _DEPTH)
    _, nearest = KDTree(tracks.pixels[mine]).query(features.pixels, k=_NEIGHBOURS)
    about = np.median(depths[nearest], axis=1)
    return (1 - share) * about, (1 + share) * about


def _tracks(
    model: SparseModel,
    views: Sequence[IndexedFeatures],
    matching: MatchingOptions,
    share: float,
    pairs: Sequence[tuple[int, int]],
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Track and frame of every keypoint of all frames, one after the other."""
    poses = list(model.cam_from_world.values())
    sizes = np.array([len(view.features) for view in views])
    starts = np.concatenate([[0], np.cumsum(sizes)])
    bounds = [_bounds(model, index, view.features, share) for index, view in enumerate(views)]

    def match(pair: tuple[int, int]) -> Int[np.ndarray, "k 2"]:
        one, other = pair
        motion = poses[other] @ poses[one].inverse()
        found = match_guided(views[one], views[other], motion, bounds[one], bounds[other], matching)
        return found + [starts[one], starts[other]]

    matches = np.concatenate([np.zeros((0, 2), np.int64), *map_in_threads(match, pairs)])
    image_of = np.repeat(np.arange(len(views)), sizes)
    return join(matches, image_of), image_of


def _triangulate_tracks(
    model: SparseModel,
    features: Sequence[Features],
    views: Sequence[IndexedFeatures],
    track: Int[np.ndarray, "n"],
    image_of: Int[np.ndarray, "n"],
    limit_px: float,
    options: GuidedOptions,
) -> SparseModel:
    """The model with the tracks whose rays about meet."""
    world_from_cam = [pose.inverse() for pose in model.cam_from_world.values()]
    centres = np.array([pose.translation for pose in world_from_cam])
    turns = np.stack([pose.rotation for pose in world_from_cam])
    rays = np.concatenate([np.column_stack([view.ideal, np.ones(len(view.ideal))]) for view in views])
    seen, count = np.flatnonzero(track >= 0), int(track.max(initial=-1)) + 1
    frame = image_of[seen]
    points = intersect_rays(centres[frame], np.einsum("oij,oj->oi", turns[frame], rays[seen]), track[seen], count)
    pixels = np.concatenate([each.pixels for each in features])[seen]
    colors = np.zeros((count, 3), np.uint8)
    colors[track[seen]] = np.concatenate([each.colors for each in features])[seen]
    good = _errors_px(model, points[track[seen]], frame, pixels) < limit_px
    views_of = np.bincount(track[seen][good], minlength=count)
    good &= views_of[track[seen]] >= options.min_views
    kept, point_index = np.unique(track[seen][good], return_inverse=True)
    tracks = Tracks(
        points=points[kept],
        colors=colors[kept],
        point_index=point_index.astype(np.int64),
        frame_index=frame[good],
        camera_index=np.zeros(int(good.sum()), np.int64),
        pixels=pixels[good],
    )
    return replace(model, tracks=tracks)


def _errors_px(
    model: SparseModel,
    points: Float[np.ndarray, "o 3"],
    frame: Int[np.ndarray, "o"],
    pixels: Float[np.ndarray, "o 2"],
) -> Float[np.ndarray, "o"]:
    """Distance of every observation from its point's projection; infinite behind the camera."""
    rotations = np.stack([pose.rotation for pose in model.cam_from_world.values()])
    shifts = np.array([pose.translation for pose in model.cam_from_world.values()])
    projected = model.camera.project(np.einsum("oij,oj->oi", rotations[frame], points) + shifts[frame])
    errors = np.linalg.norm(projected - pixels, axis=1)
    return np.where(np.isfinite(errors), errors, np.inf)
