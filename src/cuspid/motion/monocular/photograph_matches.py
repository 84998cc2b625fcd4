"""What photographs have in common: keypoints, the pairs that are worth a match, and matches that one motion explains.

Photographs come in any order and turned in any way. Descriptors are therefore not upright, and each photograph is
matched with all others; of many, with those that look like it (Jégou et al., CVPR 2010, as in
:mod:`cuspid.motion.frontend.revisits`). Matching and its verification are COLMAP's, in a database that its mapper
reads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Int, UInt8

from cuspid.model.camera import Camera
from cuspid.model.capture import Dropped
from cuspid.model.photographs import PhotoCamera, Photograph, Photographs
from cuspid.motion.colmap import colmap_camera
from cuspid.motion.frontend.features import FeatureOptions, Features, detect
from cuspid.motion.frontend.revisits import WORDS, look, typical
from cuspid.runtime.errors import InputError
from cuspid.runtime.progress import Progress
from cuspid.runtime.workers import map_in_threads
from cuspid.storage.handpieces import camera_from_colmap

_GUESSED_FOCAL = 1.2
"""Of the longer side: COLMAP's guess, an angle of view of 45 degrees."""
_CLAHE_CLIP, _CLAHE_TILES = 2.0, 8
_NEXT = (1, 2, 3, 4, 6, 8)
"""A picture of a film is matched with those so many later."""
_STILL_PX, _STILL_SHARE = 0.002, 0.6
"""Matches that move by less than this share of the longer side are still; a pair is, where this share of its are."""
_BATCH = 150


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
    image, mask = np.ascontiguousarray(photograph.pixels()[..., :3]), photograph.counts()
    size = np.array(photograph.size)
    shrink = min(1.0, max_image_px / float(size.max()))
    searched = np.maximum(np.rint(size * shrink), 1).astype(int)
    if shrink < 1:
        image = _resize(image, searched, cv2.INTER_AREA)
        mask = None if mask is None else _resize(mask, searched, cv2.INTER_NEAREST)
    found = detect(_equalize_contrast(image) if even else image, options, mask)
    return replace(found, pixels=found.pixels * (size / searched))


def _resize(image: UInt8[np.ndarray, "h w *c"], size: Int[np.ndarray, "2"], how: int) -> UInt8[np.ndarray, "a b *c"]:
    return np.asarray(cv2.resize(image, size.tolist(), interpolation=how), dtype=np.uint8)


def _equalize_contrast(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Grey with even local contrast, for what is plain or badly lit."""
    clahe = cv2.createCLAHE(_CLAHE_CLIP, (_CLAHE_TILES, _CLAHE_TILES))
    return np.repeat(clahe.apply(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))[..., None], 3, axis=2)


# --- pairs -------------------------------------------------------------------------------------------------------


def candidate_pairs(
    features: Mapping[int, Features], *, is_film: bool, most_exhaustive: int, alike: int, seed: int
) -> list[tuple[int, int]]:
    """Pairs that are worth a match: all of a few photographs; otherwise each with the ``alike`` most alike, and in a
    film with the next ones."""
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
    words = typical([each.descriptors for each in features], seed)
    codes = np.stack(map_in_threads(lambda each: look([each.descriptors], words), features))
    likeness = codes @ codes.T
    np.fill_diagonal(likeness, -np.inf)
    nearest = np.argsort(-likeness, axis=1, kind="stable")[:, : min(count, len(features) - 1)]
    return {(min(k, j), max(k, j)) for k, row in enumerate(nearest.tolist()) for j in row}


# --- COLMAP's database -------------------------------------------------------------------------------------------


def first_guess(known: PhotoCamera, camera_id: int, focal_share: float | None = None) -> pycolmap.Camera:
    """The calibrated camera, or one of the focal length that EXIF tells, or is guessed as a share of the longer
    side."""
    if known.calibrated is not None:
        camera = colmap_camera(known.calibrated, camera_id)
        camera.has_prior_focal_length = True
        return camera
    width, height = known.size
    told = known.focal_px is not None
    focal = known.focal_px if known.focal_px is not None else (focal_share or _GUESSED_FOCAL) * max(known.size)
    return pycolmap.Camera(
        camera_id=camera_id,
        model="SIMPLE_RADIAL",
        width=width,
        height=height,
        params=[focal, width / 2, height / 2, 0.0],
        has_prior_focal_length=told,
    )


def fill_database(
    path: Path, photographs: Photographs, order: Sequence[Photograph], features: Mapping[int, Features]
) -> None:
    """A COLMAP database with cameras, keypoints and descriptors; photograph k of ``order`` is image k + 1."""
    names = list(photographs.cameras)
    with pycolmap.Database.open(path) as database:
        for number, known in enumerate(photographs.cameras.values(), start=1):
            camera = first_guess(known, number)
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for index, found in features.items():
            camera_id = names.index(order[index].camera) + 1
            image = pycolmap.Image(image_name(index), found.pixels, camera_id, index + 1)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=index + 1, rig_id=camera_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(index + 1, found.pixels.astype(np.float32))
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(index + 1, pycolmap.FeatureDescriptors(kind, found.descriptors))


def image_name(index: int) -> str:
    """Name of a photograph in the database."""
    return f"{index:06d}"


def match_pairs(
    database: Path,
    pairs: Sequence[tuple[int, int]],
    *,
    ratio: float,
    least: int,
    seed: int,
    progress: Progress,
) -> None:
    """Match pairs of photographs, and keep in the database what one motion explains."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.sift.max_ratio = ratio
    verification = pycolmap.TwoViewGeometryOptions(min_num_inliers=least)
    verification.ransac.random_seed = seed
    listed = database.with_name("pairs.txt")
    pairing = pycolmap.ImportedPairingOptions(match_list_path=str(listed))
    for first in range(0, len(pairs), _BATCH):
        batch = pairs[first : first + _BATCH]
        listed.write_text("".join(f"{image_name(one)} {image_name(other)}\n" for one, other in batch))
        pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu)
        progress("matching", first + len(batch), len(pairs))


def verified_pairs(database: Path, features: Mapping[int, Features], order: Sequence[Photograph]) -> list[Pair]:
    """The pairs that have consistent matches."""
    with pycolmap.Database.open(database) as opened:
        numbers, geometries = opened.read_two_view_geometries()
    found = []
    for number, geometry in zip(numbers, geometries, strict=True):
        if not len(geometry.inlier_matches):
            continue
        one, other = (index - 1 for index in pycolmap.pair_id_to_image_pair(number))
        matches = np.asarray(geometry.inlier_matches, dtype=np.int64)
        moved = np.linalg.norm(features[one].pixels[matches[:, 0]] - features[other].pixels[matches[:, 1]], axis=1)
        same = order[one].camera == order[other].camera
        still = same and float(np.mean(moved < _STILL_PX * max(order[one].size))) > _STILL_SHARE
        found.append(Pair(first=one, second=other, matches=len(matches), is_still=still))
    return found


def with_focal_lengths(database: Path, photographs: Photographs, shares: Mapping[int, float]) -> None:
    """Start from other guesses of the focal lengths that neither a calibration nor EXIF tells, by number of the camera,
    or by 0 for any, as shares of the longer side."""
    with pycolmap.Database.open(database) as opened:
        for number, known in enumerate(photographs.cameras.values(), start=1):
            opened.update_camera(first_guess(known, number, shares.get(number, shares.get(0))))


def camera_of(camera: pycolmap.Camera, what: str) -> Camera:
    """A camera of COLMAP's, of any model that OPENCV's contains. Raises InputError for others."""
    entry = {"camera_model_name": camera.model.name, "camera_params": list(camera.params)}
    return camera_from_colmap(entry, (camera.width, camera.height), what)
