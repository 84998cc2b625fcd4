"""Frames that show a place again, long after the camera left it: found by the look of their keypoints.

Each frame is described by VLAD (Jégou et al., Aggregating local descriptors into a compact image representation, CVPR
2010): the sums of how its descriptors differ from the nearest of a few typical ones of the film.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from scipy.cluster import vq

from cuspid.motion.frontend.features import DESCRIPTOR_NORM, Features

WORDS = 32
"""Number of typical descriptors."""
_SAMPLE = 20_000
"""Number of descriptors of the film from which the typical ones are found."""
_ROUNDS = 10


def look_alike(features: Sequence[Features], apart: int, seed: int) -> list[tuple[int, int]]:
    """For each frame the other that looks most like it, of those at least so many frames before or after it.

    Indices, the earlier one first, without repetition. These are only candidates: every frame that has any frame so far
    away has one.
    """
    if sum(map(len, features)) < WORDS:
        return []
    codes = _vlad(features, seed)
    likeness = codes @ codes.T
    index = np.arange(len(features))
    likeness[np.abs(index[:, None] - index) < apart] = -np.inf
    best = likeness.argmax(axis=1)
    found = np.flatnonzero(np.isfinite(likeness[index, best])).tolist()
    return sorted({(min(i, int(best[i])), max(i, int(best[i]))) for i in found})


def _vlad(features: Sequence[Features], seed: int) -> Float[np.ndarray, "f d"]:
    """Unit vectors."""
    words = visual_words([each.descriptors for each in features], seed)
    return np.stack([look([each.descriptors], words) for each in features])


def visual_words(descriptors: Sequence[UInt8[np.ndarray, "_ 128"]], seed: int) -> Float[np.ndarray, "k 128"]:
    """A few typical descriptors of images. There must be as many as that."""
    rng = np.random.default_rng(seed)
    every = np.concatenate(list(descriptors))
    sample = every[rng.choice(len(every), min(_SAMPLE, len(every)), replace=False)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a word that is nearest to nothing stays where it is
        words, _ = vq.kmeans2(_normalize_descriptors(sample), WORDS, iter=_ROUNDS, minit="points", rng=rng)
    return np.asarray(words)


def look(
    descriptors: Sequence[UInt8[np.ndarray, "_ 128"]], words: Float[np.ndarray, "k 128"]
) -> Float[np.ndarray, "d"]:
    """Unit vector of how images look together, as measured by typical descriptors."""
    code = _sums(_normalize_descriptors(np.concatenate(list(descriptors))), words)
    return np.asarray(code / max(float(np.linalg.norm(code)), 1e-12))


def _normalize_descriptors(descriptors: UInt8[np.ndarray, "n 128"]) -> Float[np.ndarray, "n 128"]:
    return descriptors.astype(np.float64) / DESCRIPTOR_NORM


def _sums(descriptors: Float[np.ndarray, "n 128"], words: Float[np.ndarray, "k 128"]) -> Float[np.ndarray, "d"]:
    """Differences to the nearest words, summed; the sums of each word with unit length (Arandjelovic and Zisserman
    2013)."""
    sums = np.zeros_like(words)
    if len(descriptors):
        nearest, _ = vq.vq(descriptors, words)
        np.add.at(sums, nearest, descriptors - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    return sums.ravel()
