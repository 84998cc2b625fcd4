"""Where one hand-held camera was: features on contrast-normalised frames, COLMAP's incremental mapper, and broken
models joined again.

Frames: as in :mod:`cuspid.model.sparse_model`. One camera does not know the scale: lengths are in units of the model,
not millimetres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from cuspid.geometry import Rigid3, best_similarity
from cuspid.model.camera import Camera
from cuspid.model.image_sequence import ImageSequence
from cuspid.model.mesh import Mesh
from cuspid.model.panorama import FrameUse
from cuspid.model.reconstruction import Tracks, concatenate_tracks, select_tracks
from cuspid.model.sparse_model import SparseModel
from cuspid.motion.bundle.adjustment import adjust_model
from cuspid.motion.frontend.features import FeatureOptions, Features, detect
from cuspid.motion.frontend.pairs import MatchingOptions, match_unguided
from cuspid.motion.frontend.patches import PatchOptions, are_connected, follow_points, lengthen
from cuspid.motion.frontend.revisits import look_alike
from cuspid.motion.frontend.tracks import first_and_last
from cuspid.motion.monocular.guided import GuidedOptions, refine
from cuspid.motion.monocular.mapping import (
    FilmCamera,
    FilmModel,
    VerifiedPair,
    build_film_camera,
    map_film,
    verify_matches,
)
from cuspid.runtime.errors import ReconstructionError
from cuspid.runtime.image_files import Pixels, as_8_bits, visible_grey
from cuspid.runtime.options import SEED, SHARE, Options, Range
from cuspid.runtime.progress import Progress, silent
from cuspid.runtime.workers import map_in_threads

_DARK, _BURNT = 16, 245
"""Grey levels outside of which an image carries no information: noise below, burnt-out highlights above."""
_BLACK = 24
"""A frame is black where its 99th percentile lies below this level."""
_SAME = 0.8
"""Mean difference, in grey levels of images reduced eightfold, below which a frame repeats the previous one."""
_SMALLER = 8
_LIT, _PALE, _WARM = 40, 50, (35, 165)
"""Brighter pixels are lit; of these, the less saturated ones are pale like enamel and plaster, and those whose hue (0
to 180) lies below the first or above the second value are red to yellow, like gums and dentine."""
_WINDOW = 15
"""Number of frames with whose sharpness that of a frame is compared."""
_LOOSE, _NEAR, _MOST_TOLD = 0.5, 4, 3
"""A frame is held loosely by less than this share of the usual number of observations; those that lie no farther apart
are one stretch, and the first and last so many frames are the ends; and so many stretches are told."""


ENAMEL = FeatureOptions(count=2500, contrast=0.004, edge=30.0)
"""Many keypoints, the weak ones too: plain enamel has little more."""


@dataclass(frozen=True, kw_only=True)
class SingleOptions(Options):
    """How the trajectory of one camera is found."""

    features: FeatureOptions = field(default_factory=lambda: ENAMEL)
    """Keypoints of the contrast-normalised frames; plain enamel needs a low threshold."""
    clahe_clip: Annotated[float, Range(0.01, 1000)] = 1.5
    """Clip limit of the contrast normalisation (CLAHE)."""
    clahe_tiles: Annotated[int, Range(1, 100)] = 4
    """Tiles of the contrast normalisation along each side."""
    matching: MatchingOptions = field(default_factory=lambda: MatchingOptions(ratio=0.85))
    """First matching, when nothing is known about the motion."""
    steps: Annotated[tuple[int, ...], Range(1, 100_000)] = (1, 2, 3, 4, 6)
    """Each frame is matched with the frames that are this many frames later."""
    guided: GuidedOptions = field(default_factory=GuidedOptions)
    """How the mapper's poses are refined."""
    patches: PatchOptions = field(default_factory=PatchOptions)
    """How points are followed into more frames."""
    on_surface: bool = True
    """Whether they are followed once more on the dense surface, which is then found again."""
    focal_share: Annotated[float, Range(0.0001, 10)] = 0.03
    """Without a calibration: standard deviation of the mapper's focal length, as a share (0 to 1) of it."""
    bridge_steps: Annotated[tuple[int, ...], Range(1, 100_000)] = (1, 2, 3, 4, 5, 6, 8, 10)
    """Where the model broke, each frame is matched instead, with a looser ratio, with the frames that are this many
    frames later."""
    bridge_ratio: Annotated[float, Range(0.01, 1)] = 0.95
    """Ratio test of the matching where the model broke."""
    revisit_frames: Annotated[int, Range(2, 100_000)] = 20
    """Each frame is also matched with the one that looks most like it, of those at least so many frames away."""
    revisit_matches: Annotated[int, Range(4, 100_000)] = 40
    """Minimum number of consistent matches that show such a pair to be of the same place."""
    error_px: Annotated[float, Range(0.01, 1000)] = 2.0
    """Largest distance of a match from its epipolar line, px."""
    min_matches: Annotated[int, Range(4, 100_000)] = 15
    """Minimum number of consistent matches that verify a pair of frames, or locate a frame in the model."""
    min_share: Annotated[float, SHARE] = 0.3
    """Minimum share (0 to 1) of the matches of two frames that must be consistent."""
    blurred_share: Annotated[float, SHARE] = 0.4
    """A frame with less than this share (0 to 1) of the sharpness of its neighbours is left out."""
    field_of_view_deg: Annotated[float, Range(1, 170)] = 60.0
    """Initial guess of the horizontal angle of view if there is no calibration."""
    seed: Annotated[int, SEED] = 0
    """Seed of the random samples."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SingleMotion:
    """What is known about the camera's trajectory: one model, or several that no verified pair connects."""

    parts: tuple[SparseModel, ...]
    """Largest first; lengths in the model's units."""
    frames: tuple[FrameUse, ...]
    """Every frame of the sequence; used means that it belongs to one of the parts."""
    notes: tuple[str, ...] = ()
    """What a user must know about it, one line each."""

    def frames_of(self, part: int) -> tuple[FrameUse, ...]:
        """Every frame of the sequence from the point of view of one part: those of other parts are not used."""
        mine = set(self.parts[part].frames)
        elsewhere = {name: n + 1 for n, other in enumerate(self.parts) for name in other.frames if name not in mine}
        return tuple(
            replace(frame, used=False, reason=f"in part {elsewhere[frame.name]}") if frame.name in elsewhere else frame
            for frame in self.frames
        )


# --- frames ------------------------------------------------------------------------------------------------------


def normalise_contrast(image: Pixels, options: SingleOptions) -> UInt8[np.ndarray, "h w"]:
    """Grey image with even local contrast; dark noise and burnt-out highlights are levelled first."""
    gray = np.clip(visible_grey(image), _DARK, _BURNT)
    tiles = (options.clahe_tiles, options.clahe_tiles)
    return np.asarray(cv2.createCLAHE(options.clahe_clip, tiles).apply(gray), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class _Look:
    """One frame at a glance."""

    features: Features
    small: Float[np.ndarray, "a b"]
    brightness: float
    sharpness: float
    mouth_share: float


def mouth_share(image: UInt8[np.ndarray, "h w 3"]) -> float:
    """Share (0 to 1) of the lit pixels with a colour of teeth, gums or plaster; 1 if none are lit."""
    hue, saturation, value = np.moveaxis(cv2.cvtColor(image, cv2.COLOR_RGB2HSV), -1, 0)
    alike = (saturation < _PALE) | (hue <= _WARM[0]) | (hue >= _WARM[1])
    lit = value > _LIT
    return float(alike[lit].mean()) if lit.any() else 1.0


def _look(image: Pixels, options: SingleOptions) -> _Look:
    gray = visible_grey(image)
    small = cv2.resize(gray, None, fx=1 / _SMALLER, fy=1 / _SMALLER, interpolation=cv2.INTER_AREA).astype(np.float64)
    smooth = cv2.GaussianBlur(np.clip(gray, _DARK, _BURNT), (0, 0), 1.0).astype(np.float32)
    lit = gray > _DARK
    sharpness = float(np.abs(cv2.Laplacian(smooth, cv2.CV_32F))[lit].mean()) if lit.any() else 0.0
    normal = normalise_contrast(image, options)
    return _Look(
        features=detect(np.dstack([normal] * 3), options.features),
        small=small,
        brightness=float(np.percentile(gray, 99)),
        sharpness=sharpness,
        mouth_share=mouth_share(as_8_bits(image[::_SMALLER, ::_SMALLER])),
    )


def _look_at_all(sequence: ImageSequence, options: SingleOptions, progress: Progress) -> list[_Look]:
    return map_in_threads(
        lambda index: _look(sequence.fine_image(index), options),
        range(len(sequence)),
        stage="features",
        progress=progress,
    )


def _refusals(looks: Sequence[_Look], names: Sequence[str], options: SingleOptions) -> dict[int, str]:
    """Why frames are left out before anything is matched, by index: black, blurred, or the same as another."""
    reasons, last = {}, -1
    sharpness = np.array([look.sharpness for look in looks])
    for index, look in enumerate(looks):
        near = sharpness[max(0, index - _WINDOW // 2) : index + _WINDOW // 2 + 1]
        if look.brightness < _BLACK:
            reasons[index] = "black"
        elif look.sharpness < options.blurred_share * np.median(near):
            reasons[index] = f"blurred: {look.sharpness / np.median(near):.0%} of the sharpness of its neighbours"
        elif last >= 0 and np.abs(look.small - looks[last].small).mean() < _SAME:
            reasons[index] = f"the same picture as {names[last]}"
        else:
            last = index
    return reasons


# --- matches -----------------------------------------------------------------------------------------------------

Pairs = Mapping[tuple[int, int], Int[np.ndarray, "_ 2"]]
"""Consistent matches (keypoints) by indices of frames."""


def _verified_pairs(
    features: Mapping[int, Features],
    pairs: Sequence[tuple[int, int]],
    camera: FilmCamera,
    matching: MatchingOptions,
    options: SingleOptions,
    progress: Progress,
) -> dict[tuple[int, int], VerifiedPair]:
    """Verified matches of pairs of frames; pairs that have too few are not in it."""

    def verify(pair: tuple[int, int]) -> VerifiedPair | None:
        one, other = (features[index] for index in pair)
        return verify_matches(
            camera,
            one,
            other,
            match_unguided(one, other, matching),
            error_px=options.error_px,
            min_matches=options.min_matches,
            min_share=options.min_share,
            seed=options.seed,
        )

    found = map_in_threads(verify, pairs, stage="matching", progress=progress)
    return {pair: geometry for pair, geometry in zip(pairs, found, strict=True) if geometry is not None}


def _revisits(
    features: Mapping[int, Features],
    kept: Sequence[int],
    camera: FilmCamera,
    options: SingleOptions,
    progress: Progress,
) -> dict[tuple[int, int], VerifiedPair]:
    """Verified matches of frames that show a place again."""
    alike = look_alike([features[index] for index in kept], options.revisit_frames, options.seed)
    pairs = [(kept[one], kept[other]) for one, other in alike]
    found = _verified_pairs(features, pairs, camera, options.matching, options, progress)
    return {pair: each for pair, each in found.items() if len(each.inlier_matches) >= options.revisit_matches}


def _pairs_at(kept: Sequence[int], steps: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of kept frames so many frames apart."""
    return [(kept[i], kept[i + step]) for i in range(len(kept)) for step in steps if i + step < len(kept)]


def _map(
    camera: FilmCamera,
    features: Mapping[int, Features],
    verified: Mapping[tuple[int, int], VerifiedPair],
    sequence: ImageSequence,
    options: SingleOptions,
    progress: Progress,
) -> list[FilmModel]:
    if not verified:
        return []
    return map_film(
        camera,
        features,
        verified,
        calibrated=sequence.camera is not None,
        min_matches=options.min_matches,
        error_px=options.error_px,
        seed=options.seed,
        progress=progress,
    )


# --- models as values --------------------------------------------------------------------------------------------


def _same_points(one: FilmModel, other: FilmModel) -> Int[np.ndarray, "k 2"]:
    """Points of two models that were seen as the same keypoint."""
    where = {(frame, keypoint): point for point, frame, keypoint in one.seen.tolist()}
    pairs = {
        (where[frame, keypoint], point) for point, frame, keypoint in other.seen.tolist() if (frame, keypoint) in where
    }
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def _join_models(one: FilmModel, other: FilmModel, least: int) -> FilmModel | None:
    """Both models in the frame of the first, joined by the points that they share; None where those do not agree."""
    same = _same_points(one, other)
    for _ in range(3):
        if len(same) < least:
            return None
        scale, rotation, shift = best_similarity(other.points[same[:, 1]], one.points[same[:, 0]])
        errors = np.linalg.norm(scale * other.points[same[:, 1]] @ rotation.T + shift - one.points[same[:, 0]], axis=1)
        same = same[errors <= max(3 * float(np.median(errors)), 1e-9)]
    poses = {
        frame: Rigid3(pose.rotation @ rotation.T, scale * pose.translation - pose.rotation @ rotation.T @ shift)
        for frame, pose in other.poses.items()
    }
    moved = scale * other.points @ rotation.T + shift
    fresh = other.seen[~np.isin(other.seen[:, 1], list(one.poses))]
    seen = np.concatenate([one.seen, fresh + [len(one.points), 0, 0]])
    return FilmModel({**poses, **one.poses}, np.concatenate([one.points, moved]), seen, one.focal_px)


def _join_all(models: Sequence[FilmModel], least: int) -> list[FilmModel]:
    """Models joined as long as any two share enough points; frames of a smaller one that a larger one has are its."""
    parts: list[FilmModel] = []
    for model in models:
        for index, part in enumerate(parts):
            joined = _join_models(part, model, least)
            if joined is not None:
                parts[index] = joined
                break
        else:
            parts.append(model)
    return sorted(parts, key=lambda part: -len(part.poses))


def _to_sparse_model(
    model: FilmModel, camera: Camera, names: Sequence[str], features: Mapping[int, Features]
) -> SparseModel:
    """A model as the noun; points that fewer than two frames still see are left out."""
    order = sorted(model.poses)
    place = {frame: index for index, frame in enumerate(order)}
    counts = np.bincount(model.seen[:, 0], minlength=len(model.points))
    seen = model.seen[counts[model.seen[:, 0]] >= 2]
    kept, point_index = np.unique(seen[:, 0], return_inverse=True)
    colors = np.zeros((len(kept), 3), dtype=np.uint8)
    colors[point_index] = np.array([features[frame].colors[keypoint] for _, frame, keypoint in seen.tolist()])
    return SparseModel(
        camera=camera,
        cam_from_world={names[frame]: model.poses[frame] for frame in order},
        tracks=Tracks(
            points=model.points[kept],
            colors=colors,
            point_index=point_index.astype(np.int64),
            frame_index=np.array([place[frame] for frame in seen[:, 1].tolist()], dtype=np.int64),
            camera_index=np.zeros(len(seen), dtype=np.int64),
            pixels=np.array([features[frame].pixels[keypoint] for _, frame, keypoint in seen.tolist()]),
        ),
    )


def _start_camera(focal_px: float, sequence: ImageSequence, options: SingleOptions) -> Camera:
    """The given calibration, or the focal length that the mapper found, free to be refined."""
    if sequence.camera is not None:
        return sequence.camera
    width, height = sequence.size
    covariance = np.zeros((8, 8))
    covariance[:2, :2] = (options.focal_share * focal_px) ** 2
    return Camera(
        width=width,
        height=height,
        focal_px=np.array([focal_px, focal_px]),
        principal_point_px=np.array([width / 2, height / 2]),
        covariance=covariance,
    )


# --- all of it ---------------------------------------------------------------------------------------------------


def locate_single(
    sequence: ImageSequence, options: SingleOptions | None = None, *, progress: Progress = silent
) -> SingleMotion:
    """The trajectory of the one camera that took a sequence.

    Frames that are black, blurred or repeated are skipped; frames that show a place again are matched with those that
    showed it first; where the model breaks, the frames are matched again at more distances and with a looser ratio, and
    models that share frames are joined. Raises ReconstructionError, naming the frames, where nothing can be placed.
    """
    options = options or SingleOptions()
    names = sequence.names
    looks = _look_at_all(sequence, options, progress)
    refused = _refusals(looks, names, options)
    kept = [index for index in range(len(names)) if index not in refused]
    _check_enough(kept, refused, names)
    features = {index: looks[index].features for index in kept}
    camera = build_film_camera(sequence.camera, sequence.size, options.field_of_view_deg)
    verified = _verified_pairs(features, _pairs_at(kept, options.steps), camera, options.matching, options, progress)
    again = _revisits(features, kept, camera, options, progress)
    verified |= again
    models = _map(camera, features, verified, sequence, options, progress)
    if not models or len(models[0].poses) < len(kept):
        looser = replace(options.matching, ratio=options.bridge_ratio)
        bridges = _verified_pairs(features, _pairs_at(kept, options.bridge_steps), camera, looser, options, progress)
        verified = {**bridges, **verified}
        wider = _map(camera, features, verified, sequence, options, progress)
        models = max(models, wider, key=lambda each: len(each[0].poses) if each else 0)
    if not models:
        raise ReconstructionError(_explain_failure(sequence, kept, features, verified))
    parts = _join_all(models, options.min_matches)
    first = _start_camera(models[0].focal_px, sequence, options)
    refined = [_refine_part(part, first, sequence, features, list(again), options, progress) for part in parts]
    return SingleMotion(
        parts=tuple(refined),
        frames=_uses(names, refused, refined, verified),
        notes=(
            *_content_notes(looks, names),
            *_revisit_notes(list(again), names),
            *_notes(refined[0].camera, sequence.camera is not None, refined),
        ),
    )


def _refine_part(
    part: FilmModel,
    camera: Camera,
    sequence: ImageSequence,
    features: Mapping[int, Features],
    again: Sequence[tuple[int, int]],
    options: SingleOptions,
    progress: Progress,
) -> SparseModel:
    """A part with its poses made precise: by keypoints, then by patches too; ``again``: frames of the same place."""
    place = {frame: index for index, frame in enumerate(sorted(part.poses))}
    own = [features[index] for index in place]
    start = _to_sparse_model(part, camera, sequence.names, features)
    within = [(place[one], place[other]) for one, other in again if one in place and other in place]
    by_keypoints = refine(start, own, options.guided, again=within, progress=progress)
    number = {name: index for index, name in enumerate(sequence.names)}

    def read(name: str) -> UInt8[np.ndarray, "h w"]:
        return normalise_contrast(sequence.fine_image(number[name]), options)

    longer = lengthen(by_keypoints, read, options.patches, progress=progress)
    return adjust_model(longer, options.guided.adjustment)


def refine_on_surface(
    part: SparseModel,
    surface: Mesh,
    sequence: ImageSequence,
    options: SingleOptions,
    *,
    progress: Progress = silent,
) -> SparseModel | None:
    """A part of the motion with its points followed over the surface that its frames show, in the world of the part,
    and its poses adjusted to that; None where too few are found to hold a frame, or what lies before one and behind
    it, together."""
    number = {name: index for index, name in enumerate(sequence.names)}

    def read(name: str) -> UInt8[np.ndarray, "h w"]:
        return normalise_contrast(sequence.fine_image(number[name]), options)

    followed = follow_points(part, read, options.patches, surface=surface, progress=progress)
    if not are_connected(followed, len(part.frames), options.min_matches):
        return None
    tracks = concatenate_tracks(_long_tracks(part.tracks, options.patches.reach), followed)
    try:
        return adjust_model(replace(part, tracks=tracks), options.guided.adjustment)
    except ReconstructionError:
        return None


def _long_tracks(tracks: Tracks, reach: int) -> Tracks:
    """Those that hold frames together which are farther apart than patches reach: where the camera came back."""
    first, last = first_and_last(tracks.point_index, tracks.frame_index, len(tracks.points))
    return select_tracks(tracks, (last - first > 2 * reach)[tracks.point_index])


def count_observations(frames: Sequence[FrameUse], part: SparseModel) -> tuple[FrameUse, ...]:
    """Frames, each with the number of observations that hold it in a part."""
    counts = np.bincount(part.tracks.frame_index, minlength=len(part.frames)).tolist()
    observations = dict(zip(part.frames, counts, strict=True))
    return tuple(
        replace(frame, inliers=observations[frame.name]) if frame.name in observations else frame for frame in frames
    )


def weak_stretches(frames: Sequence[FrameUse]) -> tuple[tuple[FrameUse, ...], ...]:
    """Stretches of the trajectory with less than half of the median number of observations per frame, the weakest
    first; its ends do not count, for nothing hangs on them. None where observations are not known.

    There a path of one way bends two to four times as often as elsewhere; for one there and back it says little
    (docs/panorama-evaluation.md).
    """
    used = [frame for frame in frames if frame.used]
    counts = [frame.inliers for frame in used if frame.inliers is not None]
    if not used or len(counts) < len(used):
        return ()
    few = np.flatnonzero(np.array(counts) < _LOOSE * np.median(counts))
    few = few[(few >= _NEAR) & (few < len(used) - _NEAR)]
    stretches = np.split(few, np.flatnonzero(np.diff(few) > _NEAR) + 1) if len(few) else []
    found = sorted(stretches, key=lambda stretch: min(counts[index] for index in stretch))
    return tuple(tuple(used[stretch[0] : stretch[-1] + 1]) for stretch in found)


def weak_stretch_notes(frames: Sequence[FrameUse]) -> tuple[str, ...]:
    """A note where the trajectory is weakly constrained."""
    stretches = weak_stretches(frames)
    if not stretches:
        return ()
    usual = np.median([frame.inliers for frame in frames if frame.used and frame.inliers is not None])
    described = [_describe_stretch(stretch) for stretch in stretches[:_MOST_TOLD]]
    more = f", and at {len(stretches) - len(described)} other places" if len(stretches) > len(described) else ""
    return (
        f"the path is weakly constrained at {', '.join(described)}{more}, where {usual:.0f} are usual: it may bend "
        f"there "
        "(camera_path.png); film there again, more slowly",
    )


def _describe_stretch(frames: Sequence[FrameUse]) -> str:
    """``frames 034 to 041 (63 points)``."""
    fewest = min(frame.inliers for frame in frames if frame.inliers is not None)
    first, last = frames[0].name, frames[-1].name
    named = f"frame {first}" if first == last else f"frames {first} to {last}"
    return f"{named} ({fewest} points)"


def _content_notes(looks: Sequence[_Look], names: Sequence[str]) -> tuple[str, ...]:
    """A note where frames have little of the colours of a mouth."""
    strange = [name for name, look in zip(names, looks, strict=True) if look.mouth_share < 0.5]
    if not strange:
        return ()
    which = f"{len(strange)} of {len(names)} frames ({strange[0]} to {strange[-1]})"
    return (f"{which} have few pixels in the colours of teeth or gums: is this a film of teeth?",)


def _revisit_notes(pairs: Sequence[tuple[int, int]], names: Sequence[str]) -> tuple[str, ...]:
    """A note where the camera came back."""
    if not pairs:
        return ()
    one, other = max(pairs, key=lambda pair: pair[1] - pair[0])
    which = f"frame {names[other]} shows a place that frame {names[one]} showed"
    return (f"the camera came back: {which}, and {len(pairs)} such pairs of frames hold the trajectory together",)


def _notes(camera: Camera, calibrated: bool, parts: Sequence[SparseModel]) -> tuple[str, ...]:
    notes = []
    if not calibrated:
        notes.append(
            f"self-calibrated: focal length {camera.focal_px[0]:.0f} px found from the images, no lens distortion; "
            "give a calibration for true lengths"
        )
    if len(parts) > 1:
        sizes = ", ".join(str(len(part.frames)) for part in parts)
        notes.append(f"the sequence broke into {len(parts)} parts ({sizes} frames) that no verified pair connects")
    return tuple(notes)


def _check_enough(kept: Sequence[int], refused: Mapping[int, str], names: Sequence[str]) -> None:
    """Raises ReconstructionError where fewer than two frames are left."""
    if len(kept) >= 2:
        return
    reasons = sorted({reason.split(":")[0].split(" as ")[0] for reason in refused.values()})
    raise ReconstructionError(
        f"{len(refused)} of {len(names)} frames ({names[0]} to {names[-1]}) cannot be used: {', '.join(reasons)}; "
        "film slowly, with enough light, and with the teeth in focus"
    )


def _explain_failure(
    sequence: ImageSequence,
    kept: Sequence[int],
    features: Mapping[int, Features],
    verified: Mapping[tuple[int, int], object],
) -> str:
    """What to tell a user whose frames could not be placed."""
    names, counts = sequence.names, [len(features[index]) for index in kept]
    span = f"{sequence.source}: frames {names[kept[0]]} to {names[kept[-1]]}"
    if np.median(counts) < 50:
        return f"{span} show too little detail ({np.median(counts):.0f} keypoints a frame): out of focus, or no teeth"
    if not verified:
        return (
            f"{span} have nothing in common with each other; film the arch in one go, "
            "with each frame overlapping half of the one before"
        )
    return f"{span} overlap, but the camera did not move enough between them to determine depth; move it along the arch"


def _uses(
    names: Sequence[str],
    refused: Mapping[int, str],
    parts: Sequence[SparseModel],
    verified: Mapping[tuple[int, int], object],
) -> tuple[FrameUse, ...]:
    """What became of every frame."""
    placed = {name for part in parts for name in part.frames}

    def use(index: int, name: str) -> FrameUse:
        if index in refused:
            return FrameUse(name=name, used=False, reason=refused[index])
        if name in placed:
            return FrameUse(name=name, used=True)
        partners = sum(index in pair for pair in verified)
        reason = f"does not agree with the {partners} frames that it matches" if partners else "matches no other frame"
        return FrameUse(name=name, used=False, reason=reason)

    frames = tuple(use(index, name) for index, name in enumerate(names))
    for part in parts:
        frames = count_observations(frames, part)
    return frames
