"""How far a panorama is from the arch that it shows (thesis 4.3, with more than one number).

A panorama that knows which frame each of its pixels came from is evaluated by geometry: the pixel's ray, from where the
frame truly was, meets the true jaw in a point, and the panorama places that point somewhere in the occlusal plane. The
best similarity (least squares, Umeyama 1991) of all tooth pixels is removed; what remains is the geometric error. It is
reported once more along the direction in which the panorama looks at the jaw, which may be another than that of the
jaw's occlusal frame. The same similarity lays the panorama over the reference render of the true jaw
(:class:`cuspid.model.trueness.ReferenceRender`), where the pictures are compared. A panorama without that knowledge is
aligned with it by image features, and only the pictures are compared.

Pictures are compared in grey (Rec. 601), where the panorama shows nothing as black: ZNCC over the pixels of the teeth,
SSIM (Wang et al. 2004, Gaussian window of 1.5 px) as the mean of its map over the teeth, and over the whole canvas as
in the thesis; as they are, and after one gain and offset for the whole picture, fitted by least squares on the teeth
that are shown. For the score of the canvas it is one gain alone: an offset would lift the black around the jaw.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.ndimage import distance_transform_edt
from skimage.metrics import structural_similarity

from cuspid.geometry import Rigid3, best_similarity
from cuspid.model.camera import OPENCV_PIXEL_OFFSET
from cuspid.model.panorama import Panorama
from cuspid.model.trueness import NOTHING, GroundTruth, ReferenceRender
from cuspid.runtime.errors import InputError
from cuspid.runtime.options import Options, Range
from cuspid.runtime.values import quote

FEWEST_TEETH_PX = 200
"""Minimum number of sampled pixels that show teeth, for an alignment by geometry."""
_LEAST_EXTENT_MM = 5.0
"""A panorama that covers less of the jaw than this counts as failed: its alignment would rest on one place."""
FEWEST_MATCHES = 25
"""Minimum number of consistent image features, for an alignment by pictures."""
_MATCH_MM = 0.5
"""Features are consistent if they lie within this distance of each other after the alignment."""
_WINDOW_PX = 1.5
"""Standard deviation of the window of SSIM."""
_TURNS = 20
"""Steps in which the direction of a panorama is found."""
_FEATURES = 6000
"""Maximum number of features in each picture."""


@dataclass(frozen=True, kw_only=True)
class PanoramaEvaluationOptions(Options):
    """How a panorama is evaluated, and when it counts as failed."""

    samples: Annotated[int, Range(1000, 20_000_000)] = 200_000
    """Maximum number of pixels of the panorama that are traced to the true jaw, evenly distributed."""
    complete_pct: Annotated[float, Range(0, 100)] = 90.0
    """The arch is complete if, of each tooth, this share of what the frames saw is shown."""
    min_frames_pct: Annotated[float, Range(0, 100)] = 10.0
    """A panorama of a smaller share of the frames counts as failed."""
    max_scale: Annotated[float, Range(1.01, 100)] = 2.0
    """A panorama whose scale is wrong by more than this factor counts as failed."""
    max_pixel_mm: Annotated[float, Range(0.001, 10)] = 0.5
    """A panorama whose pixels are larger than this counts as collapsed."""
    max_median_mm: Annotated[float, Range(0.01, 100)] = 5.0
    """A panorama whose median error is larger than this does not show an arch."""


@dataclass(frozen=True, kw_only=True)
class GeometricError:
    """Distances in the occlusal plane between where tooth pixels are and where they should be, in mm."""

    median_mm: float
    """Median."""
    rms_mm: float
    """Root mean square."""
    p95_mm: float
    """95th percentile."""
    max_mm: float
    """Largest."""
    pixels: int
    """Number of tooth pixels that were evaluated."""
    scale_error_pct: float | None
    """How much the panorama's millimetres are too small (positive) or too large; None if it has none."""
    tilt_deg: float
    """Angle between the direction along which it looks at the jaw and that of the occlusal frame."""
    own_median_mm: float
    """Median, seen along its own direction."""
    own_p95_mm: float
    """95th percentile, seen along its own direction."""


@dataclass(frozen=True, kw_only=True)
class ImageScores:
    """How similar a picture is to the reference render."""

    zncc: float
    """Zero-mean normalised cross-correlation over the teeth; independent of gain and offset."""
    ssim_teeth: float
    """Structural similarity over the teeth."""
    ssim_full: float
    """Structural similarity over the whole canvas."""
    ssim_teeth_fitted: float
    """As ``ssim_teeth``, after one gain and offset."""
    ssim_full_fitted: float
    """As ``ssim_full``, after one gain."""
    ssim_seen: float | None = None
    """As ``ssim_full``, over what the frames saw of the jaw alone; None where that is not known."""
    ssim_seen_fitted: float | None = None
    """As ``ssim_seen``, after one gain."""


@dataclass(frozen=True, kw_only=True)
class PanoramaScore:
    """All figures of one panorama."""

    method: str
    """How it was made."""
    failure: str | None
    """Why it counts as failed; such a panorama has no scores. None if it did not fail."""
    aligned_by: Literal["geometry", "pictures"] | None
    """How it was aligned with the reference render."""
    geometry: GeometricError | None
    """Error of the positions of tooth pixels; None if it cannot be known."""
    inter_molar_error_mm: float | None
    """Distance between the first molars (otherwise the second) in the panorama minus the true one; in the panorama's
    own millimetres if it has any, otherwise after the similarity. None if it does not show both."""
    coverage_pct: float | None
    """Share of the reference render's tooth pixels that it shows."""
    coverage_of_seen_pct: float | None
    """Share of those that any frame saw that it shows."""
    seen_pct: float
    """Share of them that any frame saw: the maximum that could be shown."""
    tooth_coverage_pct: Mapping[int, float]
    """Share of what the frames saw of each tooth that is shown, by FDI number."""
    complete: bool
    """Whether it shows every tooth, in one piece."""
    frames: int
    """Frames of the sequence."""
    frames_used: int
    """Frames that are placed in it."""
    parts: int
    """Number of pieces into which the sequence broke."""
    picture: ImageScores | None
    """Scores against the orthographic reference render."""
    shot: ImageScores | None
    """Scores against the reference render from a camera at a finite height, aligned separately."""
    trivial: Mapping[str, ImageScores]
    """Scores of trivial pictures: empty, constant grey on the whole canvas and in the outline of the jaw, and the truth
    shifted by 1 mm."""
    notes: tuple[str, ...] = ()
    """What a reader should know."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PanoramaComparison:
    """The figures, and what is needed to draw them."""

    score: PanoramaScore
    """The figures."""
    aligned: Float[np.ndarray, "h w 3"] | None
    """The panorama resampled to the pixels of the reference render, RGB 0 to 1; None if it failed."""
    points_mm: Float[np.ndarray, "n 2"]
    """True positions of the tooth pixels that were evaluated."""
    errors_mm: Float[np.ndarray, "n"]
    """Their errors."""


@dataclass(frozen=True, eq=False)
class Similarity2:
    """A rotation, scale and translation of the plane."""

    linear: Float[np.ndarray, "2 2"]
    """Scale times rotation."""
    shift: Float[np.ndarray, "2"]
    """Added afterwards."""

    @property
    def scale(self) -> float:
        """Factor by which lengths are multiplied."""
        return float(np.sqrt(abs(np.linalg.det(self.linear))))

    @staticmethod
    def best(source: Float[np.ndarray, "n 2"], target: Float[np.ndarray, "n 2"]) -> Similarity2:
        """The similarity that best maps points onto others (least squares)."""
        scale, rotation, shift = best_similarity(source, target)
        return Similarity2(scale * rotation, shift)

    def apply(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Transform points."""
        return points @ self.linear.T + self.shift

    def inverse(self) -> Similarity2:
        """The inverse transform."""
        back = np.linalg.inv(self.linear)
        return Similarity2(back, -back @ self.shift)


def own_direction(
    placed: Float[np.ndarray, "n 2"], true_mm: Float[np.ndarray, "n 3"]
) -> tuple[Rigid3, Float[np.ndarray, "n"]]:
    """A panorama may look at the jaw along another direction than the reference render, which moves what is high and
    what is low apart. The rotation of the jaw that brings its direction upright, and the errors that are left then, mm.

    Least squares over rotations, with the best similarity each time.
    """
    turn = Rigid3.identity()
    for _ in range(_TURNS):
        seen = turn.rotate(true_mm)
        off = seen[:, :2] - Similarity2.best(placed, seen[:, :2]).apply(placed)
        height = seen[:, 2] - seen[:, 2].mean()
        lean = off.T @ height / max(float(height @ height), 1e-12)
        turn = Rigid3.from_rotation_vector(np.array([lean[1], -lean[0], 0.0]), np.zeros(3)) @ turn
    seen = turn.rotate(true_mm)[:, :2]
    return turn, np.linalg.norm(Similarity2.best(placed, seen).apply(placed) - seen, axis=1)


# --- Where pixels truly are ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TracedPixels:
    """Pixels of a panorama and what they truly show."""

    placed: Float[np.ndarray, "n 2"]
    """Where the panorama places them, in its world: mm (px if it has no scale)."""
    true_mm: Float[np.ndarray, "n 3"]
    """The points of the jaw that they show."""
    labels: Int[np.ndarray, "n"]
    """FDI numbers, 0 for gum."""

    @property
    def teeth(self) -> TracedPixels:
        """Those on teeth, or all if the jaw has no labels."""
        keep = self.labels > 0 if (self.labels > 0).any() else np.ones(len(self.labels), dtype=bool)
        return TracedPixels(self.placed[keep], self.true_mm[keep], self.labels[keep])


def trace_pixels(panorama: Panorama, truth: GroundTruth, samples: int) -> TracedPixels:
    """Trace pixels of a panorama through the frames to the true jaw.

    Frames are identified by name, or by number if the names differ (a video). Raises InputError where the panorama's
    frames are not those of the truth.
    """
    poses = _poses_of(panorama, truth)
    mounted = next(iter(truth.handpiece.rig.cameras.values()))
    rows, columns = _spread_pixels(panorama.frame_index >= 0, samples)
    frame = panorama.frame_index[rows, columns]
    rays = mounted.camera.rays(panorama.frame_pixel[rows, columns].astype(np.float64))
    origins, directions = np.empty_like(rays), np.empty_like(rays)
    for index in np.unique(frame):
        world_from_cam = (mounted.cam_from_rig @ poses[index]).inverse()
        origins[frame == index] = world_from_cam.translation
        directions[frame == index] = world_from_cam.rotate(rays[frame == index])
    hits = truth.jaw.mesh.cast(origins, directions)
    hit = hits.faces >= 0
    labels = truth.jaw.face_labels
    return TracedPixels(
        panorama.world_from_pixels(np.column_stack([columns, rows])[hit] + 0.5),
        (origins[hit] + hits.distances[hit, None] * directions[hit]),
        np.zeros(hit.sum(), dtype=np.int64) if labels is None else labels[hits.faces[hit]],
    )


def _poses_of(panorama: Panorama, truth: GroundTruth) -> list[Rigid3]:
    names = [frame.name for frame in panorama.frames]
    known = truth.rig_from_world
    if all(name in known for name in names):
        return [known[name] for name in names]
    if len(names) == len(known):
        return list(known.values())
    unknown = next(name for name in names if name not in known)
    raise InputError(
        f"truth: it has no frame {quote(unknown)}, and {len(known)} frames where the panorama has {len(names)}; "
        "give the truth of the film that was stitched"
    )


def _spread_pixels(where: Bool[np.ndarray, "h w"], most: int) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Rows and columns of pixels on a regular grid, at most so many."""
    step = max(1, int(np.ceil(np.sqrt(where.sum() / most))))
    rows, columns = np.nonzero(where[step // 2 :: step, step // 2 :: step])
    return rows * step + step // 2, columns * step + step // 2


def seen_by_frames(view: ReferenceRender, truth: GroundTruth, samples: int = 20_000) -> Bool[np.ndarray, "h w"]:
    """The pixels of the reference render's jaw that some frame saw, sampled on a grid and assigned to the nearest
    sample."""
    jaw = view.labels != NOTHING
    rows, columns = _spread_pixels(jaw, samples)
    asked = np.zeros_like(jaw)
    asked[rows, columns] = True
    points, mesh = view.points_at(asked), truth.jaw.mesh
    mounted = next(iter(truth.handpiece.rig.cameras.values()))
    seen = np.zeros(len(points), dtype=bool)
    for pose in truth.rig_from_world.values():
        cam_from_world = mounted.cam_from_rig @ pose
        in_camera = cam_from_world.apply(points)
        inside = ~seen & (in_camera[:, 2] > 0)
        inside[inside] = mounted.camera.contains(mounted.camera.project(in_camera[inside]))
        eye = np.broadcast_to(cam_from_world.inverse().translation, (inside.sum(), 3))
        seen[inside] = ~mesh.occluded(points[inside], eye, tolerance_mm=0.02)
    _, nearest = distance_transform_edt(~asked, return_indices=True)
    answers = np.zeros_like(asked)
    answers[asked] = seen
    return np.asarray(answers[nearest[0], nearest[1]] & jaw)


# --- Pictures --------------------------------------------------------------------------------------------------------


def grey(image: Shaped[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Rec. 601 luma, 0 to 1, of an 8-bit or a float picture."""
    scale = 255 if image.dtype == np.uint8 else 1
    return np.asarray(image @ np.array([0.299, 0.587, 0.114]) / scale)


def image_scores(
    picture: Float[np.ndarray, "h w"],
    shown: Bool[np.ndarray, "h w"],
    truth: Float[np.ndarray, "h w"],
    teeth: Bool[np.ndarray, "h w"],
    seen: Bool[np.ndarray, "h w"] | None = None,
) -> ImageScores:
    """Compare a grey picture (0 to 1) with the truth; pixels that are not ``shown`` count as black. ``seen``: what the
    frames saw."""
    black = np.where(shown, picture, 0.0)
    raw = _ssim_map(black, truth)
    on_teeth = _ssim_map(np.where(shown, _fit_gain_offset(picture, truth, shown & teeth), 0.0), truth)
    gain = float(np.sum(black * truth)) / max(float(np.sum(black**2)), 1e-12)
    on_canvas = _ssim_map(np.clip(gain * black, 0, 1), truth)
    return ImageScores(
        zncc=_zncc(black[teeth], truth[teeth]),
        ssim_teeth=float(raw[teeth].mean()),
        ssim_full=_inner_mean(raw),
        ssim_teeth_fitted=float(on_teeth[teeth].mean()),
        ssim_full_fitted=_inner_mean(on_canvas),
        ssim_seen=None if seen is None else float(raw[seen].mean()),
        ssim_seen_fitted=None if seen is None else float(on_canvas[seen].mean()),
    )


def _zncc(a: Float[np.ndarray, "n"], b: Float[np.ndarray, "n"]) -> float:
    """0 where one of them is constant."""
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / spread if spread > 1e-9 * len(a) else 0.0


def _fit_gain_offset(
    picture: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """The picture with the gain and offset that bring it nearest to the truth, in least squares."""
    if not where.any():
        return picture
    a, b = picture[where], truth[where]
    variance = float(a.var())
    gain = float(np.mean((a - a.mean()) * (b - b.mean()))) / variance if variance > 1e-12 else 0.0
    return np.clip(gain * (picture - a.mean()) + b.mean(), 0, 1)


def _ssim_map(picture: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    options = {"gaussian_weights": True, "sigma": _WINDOW_PX, "use_sample_covariance": False, "full": True}
    return np.asarray(structural_similarity(truth, picture, data_range=1.0, **options)[1])


def _inner_mean(similarity: Float[np.ndarray, "h w"]) -> float:
    """Without the border, where the window reaches out of the picture, as scikit-image does."""
    border = int(3.5 * _WINDOW_PX + 0.5)
    return float(similarity[border:-border, border:-border].mean())


def trivial_scores(view: ReferenceRender, seen: Bool[np.ndarray, "h w"] | None = None) -> dict[str, ImageScores]:
    """Scores of trivial pictures; ``seen``: what the frames saw."""
    truth, everywhere, nowhere = grey(view.image), np.ones_like(view.teeth), np.zeros_like(view.teeth)
    jaw, level = view.labels != NOTHING, float(truth[view.teeth].mean())
    step = round(1.0 / view.mm_per_px)
    moved = np.zeros_like(truth)
    moved[:, step:] = truth[:, :-step]
    pictures = {
        "empty": (np.zeros_like(truth), nowhere),
        "grey canvas": (np.full_like(truth, level), everywhere),
        "grey jaw": (np.where(jaw, level, 0.0), jaw),
        "truth shifted by 1 mm": (moved, everywhere),
    }
    return {name: image_scores(picture, shown, truth, view.teeth, seen) for name, (picture, shown) in pictures.items()}


def lay_over(
    panorama: Panorama, view: ReferenceRender, plane_from_panorama: Similarity2
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """The panorama resampled to the pixels of the reference render (RGB, 0 to 1), and where it shows something.

    ``plane_from_panorama`` maps the panorama's world to the occlusal plane, mm. A finer panorama is first averaged over
    the pixels.
    """
    shrink = max(1.0, view.mm_per_px / (plane_from_panorama.scale * (panorama.mm_per_px or 1.0)))
    size = tuple(max(1, round(side / shrink)) for side in panorama.covered.shape[::-1])
    image = cv2.resize(panorama.image.astype(np.float32) / 255, size, interpolation=cv2.INTER_AREA)
    covered = cv2.resize(panorama.covered.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    u, v = np.meshgrid(np.arange(view.teeth.shape[1]) + 0.5, np.arange(view.teeth.shape[0]) + 0.5)
    plane = (np.stack([u, v], axis=-1) - view.origin_px) * [1, -1] * view.mm_per_px
    pixels = panorama.pixels_from_world(plane_from_panorama.inverse().apply(plane))
    # OpenCV's first pixel has its centre at 0.
    maps = (pixels * np.array(size) / panorama.covered.shape[::-1] - OPENCV_PIXEL_OFFSET).astype(np.float32)
    laid, shown = (cv2.remap(each, maps, None, cv2.INTER_LINEAR) for each in (image, covered))
    return np.asarray(laid, dtype=np.float64), np.asarray(shown > 0.5)


def align_by_pictures(panorama: Panorama, view: ReferenceRender) -> Similarity2 | None:
    """``plane_from_panorama`` by SIFT features and RANSAC; None if too few are consistent."""
    sift = cv2.SIFT.create(_FEATURES)
    masks = (panorama.covered, view.labels != NOTHING)
    found = [
        sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), mask.astype(np.uint8))
        for image, mask in zip((panorama.image, view.image), masks, strict=True)
    ]
    if any(features is None or len(features) < 2 for _, features in found):
        return None
    (ours, our_features), (theirs, their_features) = found
    pairs = [
        best
        for best, second in cv2.BFMatcher().knnMatch(our_features, their_features, k=2)
        if best.distance < 0.85 * second.distance
    ]
    if len(pairs) < FEWEST_MATCHES:
        return None
    offset = np.full(2, OPENCV_PIXEL_OFFSET)
    source = panorama.world_from_pixels(np.array([ours[pair.queryIdx].pt for pair in pairs]) + offset)
    pixels = np.array([theirs[pair.trainIdx].pt for pair in pairs]) + offset
    target = (pixels - view.origin_px) * [1, -1] * view.mm_per_px
    cv2.setRNGSeed(0)
    affine, inliers = cv2.estimateAffinePartial2D(
        source, target, ransacReprojThreshold=_MATCH_MM, maxIters=5000, confidence=0.999
    )
    if affine is None or inliers.sum() < FEWEST_MATCHES:
        return None
    return Similarity2(affine[:, :2], affine[:, 2])


# --- The whole -------------------------------------------------------------------------------------------------------


def evaluate_panorama(
    panorama: Panorama,
    truth: GroundTruth,
    view: ReferenceRender,
    shot: ReferenceRender | None = None,
    options: PanoramaEvaluationOptions = PanoramaEvaluationOptions(),
) -> PanoramaComparison:
    """All figures of a panorama against the ground truth of its film.

    ``view`` is the orthographic reference render and ``shot`` the one from a camera at a finite height. Raises
    InputError where the panorama's frames are not those of the truth.
    """
    if view.camera_height_mm is not None:
        raise InputError("evaluation: the first reference render must be orthographic")
    seen = seen_by_frames(view, truth)
    traced = trace_pixels(panorama, truth, options.samples) if (panorama.frame_index >= 0).any() else None
    base = _Comparison(panorama=panorama, view=view, shot=shot, seen=seen, options=options)
    return base.by_pictures() if traced is None else base.by_geometry(traced.teeth)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Comparison:
    panorama: Panorama
    view: ReferenceRender
    shot: ReferenceRender | None
    seen: Bool[np.ndarray, "h w"]
    options: PanoramaEvaluationOptions

    def by_geometry(self, traced: TracedPixels) -> PanoramaComparison:
        """The alignment from where the pixels truly are."""
        if len(traced.labels) < FEWEST_TEETH_PX:
            return self._failure(f"only {len(traced.labels)} of the sampled pixels show teeth")
        plane_from_panorama = Similarity2.best(traced.placed, traced.true_mm[:, :2])
        errors = np.linalg.norm(plane_from_panorama.apply(traced.placed) - traced.true_mm[:, :2], axis=1)
        failure = self._too_few_frames() or self._collapse_reason(plane_from_panorama.scale, float(np.median(errors)))
        if failure:
            return self._failure(failure)
        shot_from_panorama = None
        if self.shot is not None:
            on_plane = self.shot.on_plane(traced.true_mm)
            shot_from_panorama = Similarity2.best(traced.placed, on_plane)
        geometry = self._geometry(errors, plane_from_panorama.scale, *own_direction(traced.placed, traced.true_mm))
        molars = inter_molar_error(traced, 1.0 if self.panorama.mm_per_px else plane_from_panorama.scale)
        made = self._score(plane_from_panorama, shot_from_panorama, geometry=geometry, inter_molar_error_mm=molars)
        return replace(made, points_mm=traced.true_mm[:, :2], errors_mm=errors)

    def by_pictures(self) -> PanoramaComparison:
        """The alignment by features; the geometric error stays unknown."""
        plane_from_panorama = align_by_pictures(self.panorama, self.view)
        if plane_from_panorama is None:
            return self._failure(f"fewer than {FEWEST_MATCHES} image features agree with the true jaw")
        failure = self._too_few_frames() or self._collapse_reason(plane_from_panorama.scale, 0.0)
        if failure:
            return self._failure(failure)
        on_shot = None if self.shot is None else align_by_pictures(self.panorama, self.shot)
        if on_shot is not None and self._collapse_reason(on_shot.scale, 0.0):
            on_shot = None
        note = "aligned by image features: without the frames of its pixels, its geometric error is unknown"
        made = self._score(plane_from_panorama, on_shot)
        return replace(made, score=replace(made.score, aligned_by="pictures", notes=(*made.score.notes, note)))

    def _too_few_frames(self) -> str | None:
        used, frames = sum(frame.used for frame in self.panorama.frames), len(self.panorama.frames)
        if frames and 100 * used < self.options.min_frames_pct * frames:
            return f"only {used} of {frames} frames are placed"
        return None

    def _collapse_reason(self, scale: float, median_mm: float) -> str | None:
        if median_mm > self.options.max_median_mm:
            return f"no arch: half of its tooth pixels lie more than {median_mm:.1f} mm from where they should"
        most = self.options.max_scale
        if self.panorama.mm_per_px is not None and not 1 / most < scale < most:
            return f"its millimetres are {scale:.3g} true ones"
        coarse = scale * (self.panorama.mm_per_px or 1.0)
        if coarse > self.options.max_pixel_mm:
            return f"collapsed: one pixel for {coarse:.2g} mm of the teeth"
        extent = coarse * max(self.panorama.covered.shape)
        if extent < _LEAST_EXTENT_MM:
            return f"collapsed: the whole picture lies on {extent:.2g} mm of the jaw"
        return None

    def _geometry(
        self, errors: Float[np.ndarray, "n"], scale: float, turn: Rigid3, own_errors: Float[np.ndarray, "n"]
    ) -> GeometricError:
        return GeometricError(
            median_mm=float(np.median(errors)),
            rms_mm=float(np.sqrt(np.mean(errors**2))),
            p95_mm=float(np.percentile(errors, 95)),
            max_mm=float(errors.max()),
            pixels=len(errors),
            scale_error_pct=None if self.panorama.mm_per_px is None else 100 * (scale - 1),
            tilt_deg=float(np.rad2deg(np.arccos(min(turn.rotation[2, 2], 1.0)))),
            own_median_mm=float(np.median(own_errors)),
            own_p95_mm=float(np.percentile(own_errors, 95)),
        )

    def _score(
        self, plane_from_panorama: Similarity2, shot_from_panorama: Similarity2 | None, **figures: Any
    ) -> PanoramaComparison:
        laid, shown = lay_over(self.panorama, self.view, plane_from_panorama)
        teeth = self._tooth_coverage(shown)
        score = replace(
            self._blank(),
            aligned_by="geometry",
            coverage_pct=100 * float(shown[self.view.teeth].mean()),
            coverage_of_seen_pct=100 * float(shown[self.seen & self.view.teeth].mean()),
            tooth_coverage_pct=teeth,
            complete=self.panorama.parts == 1 and min(teeth.values()) >= self.options.complete_pct,
            picture=image_scores(grey(laid), shown, grey(self.view.image), self.view.teeth, self.seen),
            shot=self._compare_with_shot(shot_from_panorama),
            **figures,
        )
        nowhere = np.zeros((0, 2)), np.zeros(0)
        return PanoramaComparison(score=score, aligned=laid, points_mm=nowhere[0], errors_mm=nowhere[1])

    def _compare_with_shot(self, shot_from_panorama: Similarity2 | None) -> ImageScores | None:
        if self.shot is None or shot_from_panorama is None:
            return None
        laid, shown = lay_over(self.panorama, self.shot, shot_from_panorama)
        return image_scores(grey(laid), shown, grey(self.shot.image), self.shot.teeth)

    def _tooth_coverage(self, shown: Bool[np.ndarray, "h w"]) -> dict[int, float]:
        """Of what was seen of each tooth (FDI; 0 stands for the whole of a jaw without labels), in percent."""
        numbers = np.where(self.seen & self.view.teeth, self.view.labels, NOTHING)
        found = [int(number) for number in np.unique(numbers) if number != NOTHING]
        return {number: 100 * float(shown[numbers == number].mean()) for number in found}

    def _failure(self, reason: str) -> PanoramaComparison:
        score = replace(self._blank(), failure=reason)
        return PanoramaComparison(score=score, aligned=None, points_mm=np.zeros((0, 2)), errors_mm=np.zeros(0))

    def _blank(self) -> PanoramaScore:
        unlabelled = not (self.view.labels > 0).any()
        return PanoramaScore(
            method=self.panorama.method,
            failure=None,
            aligned_by=None,
            geometry=None,
            inter_molar_error_mm=None,
            coverage_pct=None,
            coverage_of_seen_pct=None,
            seen_pct=100 * float(self.seen[self.view.teeth].mean()),
            tooth_coverage_pct={},
            complete=False,
            frames=len(self.panorama.frames),
            frames_used=sum(frame.used for frame in self.panorama.frames),
            parts=self.panorama.parts,
            picture=None,
            shot=None,
            trivial=trivial_scores(self.view, self.seen),
            notes=("the jaw has no tooth labels: its whole surface counts as teeth",) if unlabelled else (),
        )


def inter_molar_error(traced: TracedPixels, scale: float) -> float | None:
    """Distance between the first molars (otherwise the second) as placed, times the scale, minus the true one, mm.

    A molar's position is the mean of its pixels' positions, and its true position the mean over the same pixels. None
    if no pair of molars has `FEWEST_TEETH_PX` pixels each.
    """
    for position in (6, 7):
        for left, right in ((30, 40), (10, 20)):
            sides = [traced.labels == quadrant + position for quadrant in (left, right)]
            if min(side.sum() for side in sides) >= FEWEST_TEETH_PX:
                placed = np.subtract(*(traced.placed[side].mean(axis=0) for side in sides))
                true = np.subtract(*(traced.true_mm[side, :2].mean(axis=0) for side in sides))
                return float(scale * np.linalg.norm(placed) - np.linalg.norm(true))
    return None
