"""Which camera model the views of a board call for.

Each model is calibrated from a part of the views and looks at the others, whose poses alone are then found (k-fold
cross-validation). A model with more parameters, or another one with as many, is taken only where it explains the views
that it did not see better than chance: by the mean of the logarithms of how much smaller their residuals are, in its
standard errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from cuspid.calibration.bundle import Adjusted, adjust_board, select_instants, views_in_front
from cuspid.calibration.corners import BoardView
from cuspid.calibration.start import LEAST_VIEWS, calibrate_single_camera
from cuspid.geometry.cameras import GRID, MODELS
from cuspid.model.board import Target
from cuspid.model.camera import Camera
from cuspid.runtime.errors import InputError, ReconstructionError

LensName = Literal["auto", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "splined"]
"""A model, or the one that the images call for."""
_SPLINED, _ITS_BASE = "SPLINED_FISHEYE", "OPENCV_FISHEYE"
_LADDER = ("OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "THIN_PRISM_FISHEYE")
"""The models, simplest first. The last one is tried only where one of those before it is better than the first."""
_CELLS, _LEAST_IN_CELL = (8, 6), 3
"""Cells of an image in which residuals are compared from view to view, and the views that must show corners in one."""
_PATTERN = 1.5
"""Mean square of the residuals in cells that views have in common, in what chance makes of them, beyond which a splined
lens is tried."""
_MARGIN = 1.02
"""How much farther the grid of a splined lens reaches than what was seen."""
_FOLDS, _MOST_VIEWS = 4, 24
_ODD = 10.0
"""Residuals of a view, in usual ones, beyond which it shows something else."""
_CHANCE, _LEAST_GAIN = 2.0, 0.02
"""Standard errors beyond which one model is better than another, and the share by which its residuals must be smaller
to matter."""
_HALF_VIEWS_DEG = (20.0, 35.0, 50.0, 65.0, 80.0)
"""Half the angle of view across the image, from which the search begins where OpenCV's finds no camera."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LensChoice:
    """The model of a lens, and what others did."""

    model: str
    """The one that was taken."""
    held_out_px: Mapping[str, float]
    """RMS of the residuals in views that a calibration by a model was not made from; empty where there were too few
    views."""
    chosen: Camera | None = None
    """The camera by the one that was taken, and"""
    rival: Camera | None = None
    """by the best of those with more parameters or, if there is none, of the others; None where there was only one."""

    @property
    def summary(self) -> str:
        """One line with the errors that decided."""
        errors = ", ".join(f"{model} {px:.3f}" for model, px in self.held_out_px.items())
        return f"{self.model}" + (f" (px in views held out: {errors})" if errors else "")


def choose_lens(
    views: Sequence[BoardView], board: Target, size: tuple[int, int], requested: LensName = "auto"
) -> tuple[LensChoice, Adjusted]:
    """The model that is asked for or that the views call for, and the camera by it, calibrated alone.

    Raises ReconstructionError where no camera fits the views.
    """
    if requested != "auto":
        model = _SPLINED if requested == "splined" else requested
        alone = calibrate_model(model, views, board, size)
        sound = _sound(views, alone)
        if len(sound) < len(views):
            alone = calibrate_model(model, sound, board, size)
        return LensChoice(model=model, held_out_px={}), alone
    choice, simple = _first_that_fits(views, board, size)
    sound = _sound(views, simple)
    if len(sound) < 2 * LEAST_VIEWS:
        return choice, simple
    some = _sample_views(sound)
    found, squares = dict[str, Adjusted](), dict[str, Float[np.ndarray, "v"]]()
    for model in _LADDER:
        if model == _LADDER[-1] and not _improves_on_simplest(squares):
            break
        try:
            found[model] = calibrate_model(model, some, board, size, found.get(_LADDER[0]))
            squares[model] = _cross_validate(found[model], some, board)
        except ReconstructionError:  # not such a lens
            continue
    if not squares:
        return choice, simple
    chosen = next(iter(squares))
    for model in list(squares)[1:]:
        if _is_better(squares[model], squares[chosen]):
            chosen = model
    rms = {model: _rms(each) for model, each in squares.items()}
    others = [model for model in rms if model != chosen]
    richer = [model for model in others if _size(found[model]) > _size(found[chosen])]
    rival = min(richer or others, key=rms.__getitem__, default=None)
    taken = LensChoice(
        model=chosen,
        held_out_px=rms,
        chosen=found[chosen].scene.cameras[""],
        rival=None if rival is None else found[rival].scene.cameras[""],
    )
    if len(some) == len(sound):
        return taken, found[chosen]
    try:
        alone = calibrate_single_camera(sound, board, size, [found[chosen].scene.cameras[""]])
    except ReconstructionError:  # the others lie where such a lens shows nothing
        return choice, simple
    return taken, alone


def select_splined_lens(
    choice: LensChoice, camera: Camera, views: Sequence[BoardView], board: Target
) -> tuple[LensChoice, Camera] | None:
    """A splined lens instead of a camera's, where its views call for it; they are as if all rows were exposed at once,
    for a readout leaves a pattern, too. None where they do not.

    What is left out at a time are views that follow each other: in a film the next one is almost the same.
    """
    some, size = _sample_views(views), (camera.width, camera.height)
    if len(some) < 2 * LEAST_VIEWS:
        return None
    try:
        base = calibrate_single_camera(some, board, size, [camera])
        if _common_pattern(base, some) <= _PATTERN:
            return None
        splined = calibrate_model(_SPLINED, some, board, size)
        before, after = (_cross_validate(each, some, board, runs=True) for each in (base, splined))
    except ReconstructionError:  # not such a lens
        return None
    if not _is_better(after, before):
        return None
    found = splined.scene.cameras[""]
    held_out = {**choice.held_out_px, camera.model: _rms(before), _SPLINED: _rms(after)}
    rival = base.scene.cameras[""]
    return LensChoice(model=_SPLINED, held_out_px=held_out, chosen=found, rival=rival), found


def _sample_views(views: Sequence[BoardView]) -> list[BoardView]:
    """Not too many of some views, evenly."""
    return [views[k] for k in np.unique(np.linspace(0, len(views) - 1, _MOST_VIEWS).astype(int))]


def _rms(squares: Float[np.ndarray, "v"]) -> float:
    """Of those that are known."""
    return float(np.sqrt(np.mean(squares[np.isfinite(squares)])))


def _common_pattern(found: Adjusted, views: Sequence[BoardView]) -> float:
    """How far the residuals of all views together are off in the cells of the image, in how far those of single views
    are: a mean square, about 1 where views have nothing in common."""
    camera = found.scene.cameras[""]
    sums = np.zeros((len(found.residuals), *_CELLS, 2))
    for of_view, ((_, instant), residuals) in zip(sums, found.residuals.items(), strict=True):
        share = views[int(instant)].pixels / [camera.width, camera.height]
        column, row = np.clip((share * _CELLS).astype(int), 0, np.array(_CELLS) - 1).T
        np.add.at(of_view, (column, row), residuals)
    told = np.count_nonzero(sums.any(axis=-1), axis=0) >= _LEAST_IN_CELL
    if not told.any():
        return 0.0
    return float(np.mean(np.sum(sums, axis=0)[told] ** 2 / np.sum(sums**2, axis=0)[told]))


def _size(found: Adjusted) -> int:
    return len(found.scene.cameras[""].parameters)


def _sound(views: Sequence[BoardView], found: Adjusted) -> list[BoardView]:
    """The views without those that fit much worse than is usual, as views of something else do."""
    rms = {int(key[1]): float(np.sqrt(np.mean(each**2))) for key, each in found.residuals.items()}
    usual = float(np.median(list(rms.values())))
    return [view for k, view in enumerate(views) if rms.get(k, np.inf) <= _ODD * usual]


def _first_that_fits(views: Sequence[BoardView], board: Target, size: tuple[int, int]) -> tuple[LensChoice, Adjusted]:
    """One of the two simplest models: of few views more cannot be told."""
    try:
        return LensChoice(model="OPENCV", held_out_px={}), calibrate_model("OPENCV", views, board, size)
    except ReconstructionError as error:
        try:
            found = calibrate_model("OPENCV_FISHEYE", views, board, size)
        except ReconstructionError:
            raise error from None
        return LensChoice(model="OPENCV_FISHEYE", held_out_px={}), found


def _improves_on_simplest(squares: Mapping[str, Float[np.ndarray, "v"]]) -> bool:
    """Whether another model than the simplest one was better, or the only one that fits."""
    first = squares.get(_LADDER[0])
    return first is None or any(_is_better(each, first) for each in squares.values())


def calibrate_model(
    model: str, views: Sequence[BoardView], board: Target, size: tuple[int, int], simple: Adjusted | None = None
) -> Adjusted:
    """One camera of a model from its own views; ``simple``, if it is known, is the same by OPENCV.

    Raises ReconstructionError where the views fit no such camera.
    """
    if model == "OPENCV":
        return calibrate_single_camera(views, board, size)
    if model == _SPLINED:
        base = calibrate_model(_ITS_BASE, views, board, size, simple)
        seen = np.concatenate([view.pixels for view in views])
        return calibrate_single_camera(views, board, size, [with_spline(base.scene.cameras[""], seen)])
    try:
        simple = simple or calibrate_single_camera(views, board, size)
        pixels = np.concatenate([view.pixels for view in views])
        starts = [as_model(simple.scene.cameras[""], model, pixels)]
    except (InputError, ReconstructionError):  # too far from such a lens
        starts = [_ideal(model, size, half_deg) for half_deg in _HALF_VIEWS_DEG]
    return calibrate_single_camera(views, board, size, starts)


def as_model(camera: Camera, model: str, pixels: Float[np.ndarray, "n 2"]) -> Camera:
    """The camera of another model that is most like a perspective one at some pixels, with the first radial term
    alone where the ideal lens is another one."""
    lens = MODELS[model]
    if not lens.is_equidistant:
        more = np.pad(camera.distortion, (0, len(lens.names) - len(camera.distortion)))
        return replace(camera, model=model, distortion=more, covariance=None)
    rays = camera.rays(pixels)
    angle, out = np.arctan(np.linalg.norm(rays[:, :2], axis=1)), (pixels - camera.principal_point_px) / camera.focal_px
    known = np.isfinite(angle)
    # Least squares of |out| = share (angle + k1 angle^3).
    powers = np.stack([angle, angle**3], axis=1)[known]
    share, cubic = np.linalg.lstsq(powers, np.linalg.norm(out, axis=1)[known], rcond=None)[0]
    distortion = np.zeros(len(lens.names))
    distortion[lens.numerator[0]] = cubic / share
    return replace(camera, model=model, focal_px=share * camera.focal_px, distortion=distortion, covariance=None)


def with_spline(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Camera:
    """A camera of the base of splined lenses as one of these, whose grid covers some pixels and shifts nothing yet."""
    rays = camera.directions(pixels)
    side = np.linalg.norm(rays[:, :2], axis=1)
    ideal = rays[:, :2] * (np.arctan2(side, rays[:, 2]) / np.maximum(side, 1e-12))[:, None]
    reach = _MARGIN * float(np.nanmax(np.abs(ideal)))
    distortion = np.concatenate([camera.distortion, [reach], np.zeros(2 * GRID**2)])
    return replace(camera, model=_SPLINED, distortion=distortion, covariance=None)


def _ideal(model: str, size: tuple[int, int], half_deg: float) -> Camera:
    """A lens without distortion, with half the angle of view across the image."""
    (width, height), half = size, np.deg2rad(half_deg)
    reach = half if MODELS[model].is_equidistant else np.tan(half)
    return Camera(
        width=width,
        height=height,
        focal_px=np.full(2, width / 2 / reach),
        principal_point_px=np.array([width / 2, height / 2]),
        distortion=np.zeros(len(MODELS[model].names)),
        model=model,
    )


def _cross_validate(
    found: Adjusted, views: Sequence[BoardView], board: Target, *, runs: bool = False
) -> Float[np.ndarray, "v"]:
    """Mean square of the residuals of each view by cameras that were calibrated without it, and without every fourth
    one or, with ``runs``, the quarter that it lies in; NaN where the view fits no camera, infinite where such a camera
    does not show all of it. Raises ReconstructionError where too few views are left."""
    scene, count = found.scene, len(views)
    named = {("", instant): views[int(instant)] for instant in scene.rig_from_board}
    squares = np.full(count, np.nan)
    for fold in range(_FOLDS):
        number = {key: _FOLDS * int(key[1]) // count if runs else int(key[1]) % _FOLDS for key in named}
        out = {key: view for key, view in named.items() if number[key] == fold}
        rest = {key: view for key, view in named.items() if key not in out}
        if not out:
            continue
        seen = adjust_board(select_instants(scene, {instant for _, instant in rest}), rest, board)
        held = replace(seen.scene, rig_from_board=select_instants(scene, {key[1] for key in out}).rig_from_board)
        shown = views_in_front(held, out, board)
        squares[[int(instant) for _, instant in out if ("", instant) not in shown]] = np.inf
        if not shown:
            continue
        held = select_instants(held, {instant for _, instant in shown})
        for (_, instant), residuals in adjust_board(held, shown, board, only_boards=True).residuals.items():
            squares[int(instant)] = np.mean(residuals**2)
    return squares


def _is_better(one: Float[np.ndarray, "v"], other: Float[np.ndarray, "v"]) -> bool:
    """Whether the residuals of the same views are smaller, by more than chance and enough to matter."""
    both = np.isfinite(one + other)
    if both.sum() < LEAST_VIEWS or np.isinf(one).sum() > np.isinf(other).sum():
        return False
    gain = np.log(other[both] / one[both]) / 2  # of residuals, not of their squares
    least = max(_CHANCE * float(gain.std(ddof=1)) / float(np.sqrt(len(gain))), _LEAST_GAIN)
    return float(gain.mean()) > least
