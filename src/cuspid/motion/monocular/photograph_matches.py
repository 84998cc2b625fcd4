"""What photographs have in common: keypoints, the candidate pairs, and matches that one motion explains.

Photographs come in any order and turned in any way. Descriptors are therefore not upright, and each photograph is
matched with all others; of many, with those that look like it (Jégou et al., CVPR 2010, as in
:mod:`cuspid.motion.frontend.revisits`). Matching and its verification are COLMAP's, in a database that its mapper
reads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Int, Shaped, UInt8

from cuspid.model.capture import Dropped
from cuspid.model.photographs import Photograph
from cuspid.motion.frontend.features import FeatureOptions, Features, detect
from cuspid.motion.frontend.revisits import WORDS, look, visual_words
from cuspid.runtime.errors import InputError
from cuspid.runtime.image_files import Pixels, visible_grey
from cuspid.runtime.progress import Progress
from cuspid.runtime.workers import map_in_threads

_CLAHE_CLIP, _CLAHE_TILES = 2.0, 8
_NEXT = (1, 2, 3, 4, 6, 8)
"""A picture of a film is matched with those so many later."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Pair:
    """Two photographs with matches that one motion explains."""

    first: int
    """Index of a photograph."""
    second: int
    """Index of the other."""
    matches: int
    """Number of consistent matches."""
    is_still: bool
    """Whether most of them are at the same place in both: the camera did not move before what they show."""


# --- keypoints ---------------------------------------------------------------------------------------------------


def detect_in_all(
    photographs: Sequence[Photograph],
    options: FeatureOptions,
    *,
    max_image_px: int,
    even: bool,
    progress: Progress,
) -> tuple[dict[int, Features], list[Dropped]]:
    """Keypoints by index of the photograph, in its full size, and the photographs that cannot be read.

    ``max_image_px``: a longer side is reduced to it first. ``even``: with even local contrast.
    """

    def one(index: int) -> Features | Dropped:
        photograph = photographs[index]
        try:
            return _detect(photograph, options, max_image_px, even)
        except InputError as error:
            return Dropped(what=f"photograph {photograph.name}", reason=str(error))

    found = map_in_threads(one, range(len(photographs)), stage="features", progress=progress)
    features = {index: each for index, each in enumerate(found) if isinstance(each, Features)}
    return features, [each for each in found if isinstance(each, Dropped)]


def _detect(photograph: Photograph, options: FeatureOptions, max_image_px: int, even: bool) -> Features:
    image, mask = np.ascontiguousarray(photograph.pixels()), photograph.counts()
    size = np.array(photograph.size)
    shrink = min(1.0, max_image_px / float(size.max()))
    searched = np.maximum(np.rint(size * shrink), 1).astype(int)
    if shrink < 1:
        image = _resize(image, searched, cv2.INTER_AREA)
        mask = None if mask is None else _resize(mask, searched, cv2.INTER_NEAREST)
    found = detect(_equalize_contrast(image) if even else image, options, mask)
    return replace(found, pixels=found.pixels * (size / searched))


def _resize(
    image: Shaped[np.ndarray, "h w *c"], size: Int[np.ndarray, "2"], interpolation: int
) -> Shaped[np.ndarray, "a b *c"]:
    return np.asarray(cv2.resize(image, size.tolist(), interpolation=interpolation))


def _equalize_contrast(image: Pixels) -> UInt8[np.ndarray, "h w 3"]:
    """Grey with even local contrast, for what is plain or badly lit."""
    clahe = cv2.createCLAHE(_CLAHE_CLIP, (_CLAHE_TILES, _CLAHE_TILES))
    return np.repeat(clahe.apply(visible_grey(image))[..., None], 3, axis=2)


# --- pairs -------------------------------------------------------------------------------------------------------


def candidate_pairs(
    features: Mapping[int, Features], *, is_film: bool, most_exhaustive: int, alike: int, seed: int
) -> list[tuple[int, int]]:
    """Candidate pairs: all of a few photographs; otherwise each with the ``alike`` most alike, and in a film with the
    next ones."""
    order = sorted(features)
    if len(order) <= (0 if is_film else most_exhaustive):
        return list(combinations(order, 2))
    pairs = set(_look_alike([features[index] for index in order], alike, seed))
    if is_film:
        pairs |= {(k, k + step) for k in range(len(order)) for step in _NEXT if k + step < len(order)}
    return sorted((order[one], order[other]) for one, other in pairs)


def _look_alike(features: Sequence[Features], count: int, seed: int) -> set[tuple[int, int]]:
    """For each photograph the ``count`` others that look most like it."""
    if sum(map(len, features)) < WORDS:
        return set()
    words = visual_words([each.descriptors for each in features], seed)
    codes = np.stack(map_in_threads(lambda each: look([each.descriptors], words), features))
    likeness = codes @ codes.T
    np.fill_diagonal(likeness, -np.inf)
    nearest = np.argsort(-likeness, axis=1, kind="stable")[:, : min(count, len(features) - 1)]
    return {(min(k, j), max(k, j)) for k, row in enumerate(nearest.tolist()) for j in row}
