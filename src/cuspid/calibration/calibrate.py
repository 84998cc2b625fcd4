"""Calibrates a rig, with its uncertainty, from views of a board: initialise, adjust, reject outliers, and test the
result on views that were held out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from statistics import median_low
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from cuspid.calibration.board_shape import BoardShape, is_grid_of_corners
from cuspid.calibration.bundle import (
    Adjusted,
    BoardScene,
    Timing,
    adjust_board,
    common_free,
    mounted_cameras,
    readout_score,
    readout_sigmas,
    select_instants,
    unevenness_score,
    views_at_middle_rows,
    views_in_front,
)
from cuspid.calibration.circle_centres import centre_shifts
from cuspid.calibration.corners import LEAST_CORNERS, BoardView, Views, split_by_board
from cuspid.calibration.joining import join_boards
from cuspid.calibration.lenses import LensChoice, LensName, choose_lens, select_splined_lens
from cuspid.calibration.start import LEAST_VIEWS, board_pose, groups, join_cameras, renumber_instant, require_one_group
from cuspid.calibration.timing import adjust_scene, allow_delays, allow_rolling, are_consecutive
from cuspid.geometry import Rigid3
from cuspid.model.board import Board, BoardSet, Target
from cuspid.model.camera import Camera
from cuspid.model.rig import MountedCamera, Rig
from cuspid.model.shutter import Shutter, frame_numbers
from cuspid.runtime.errors import InputError, ReconstructionError
from cuspid.runtime.options import Options, Range

_DOUBTFUL = 2.0
"""Difference between two halves, in standard deviations, that chance hardly explains."""
_CHANCE, _LEAST_GAIN, _FOLDS = 2.0, 0.02, 5
"""Standard errors beyond which one model of the board is better than another; the share by which its residuals must be
smaller to matter; and into how many parts the instants are divided to tell."""
_EVEN = 1.3
"""Score of an even board below which no other is tried."""
_TURNS = 5
"""Maximum number of instants whose corners are numbered otherwise than they seemed."""
_TELLING = 6
"""Views from which on a calibration states how far it may be off well enough for others to be judged by it."""
_MUCH_MORE = 3.0
"""Ratio of the residuals together with other cameras to those alone, beyond which a note is given."""
_LESS = 0.9
"""Residuals in views that a calibration was not made from, as a share of those if all cameras exposed together, below
which they did not; and the share of the views that must then remain."""
_ROLLING = 3.0
"""How far readouts of 0 must be from the best ones, in standard deviations, for these to be tried."""
_RUN = 6
"""Number of successive instants that stay in the same half, where cameras do not expose together."""
_ODD_SIZE = 0.02
"""Cameras that are glued into a printed holder are nearer to where they were drawn, as a share of their distances."""
_OPEN_SHARE = 0.01
"""Standard deviation of a focal length, as a share of it, beyond which a note is given."""


@dataclass(frozen=True, kw_only=True)
class CalibrationOptions(Options):
    """The model of the lenses, and which views are left out."""

    lens: LensName = "auto"
    """COLMAP's name of the model of the lenses, or splined: a fisheye with a grid of shifts, for what no polynomial
    follows. auto: for each camera the simplest one that no richer one beats, by more than chance, in views that it was
    not made from."""
    shutter: Literal["auto", "global"] = "auto"
    """auto: where a filmed board moves, it is estimated how long after the first row of an image the last one is
    exposed, and kept if that explains images that it was not estimated from. global: all rows are exposed at once."""

    frames_per_s: Annotated[float | None, Range(0.001, 100_000)] = None
    """Rate at which the board was filmed, to report delays and readouts in ms, too; default: that which videos
    state."""
    outlier_sigmas: Annotated[float, Range(2, 1000)] = 4.0
    """A view is left out if the RMS of its residuals is beyond this, in standard deviations of all residuals or of its
    camera's."""
    rounds: Annotated[int, Range(1, 100)] = 5
    """Maximum number of times that views are left out."""


@dataclass(frozen=True, kw_only=True)
class CameraCheck:
    """Quality of the calibration of one camera."""

    views: int
    """Number of views of the board that were used."""
    corners: int
    """Number of corners in them."""
    rms_px: float
    """RMS of the residuals."""
    alone_px: float
    """Standard deviation of the residuals if the camera is calibrated from its own views alone."""
    held_out_px: float | None
    """RMS in views that the calibration was not made from; None if there were too few views for halves."""
    parameters_apart: float | None
    """Difference between the parameters from two halves of the instants, in the standard deviations that both state;
    about 1 if these are right."""
    place_apart: float | None
    """The same for the pose in the rig."""
    alone_apart: float | None
    """Difference between the parameters and those from its own views alone, in the standard deviations that the latter
    state; below 1 if these are right; None if there were too few views."""
    delay_frames: float | None
    """How many frames after the mean of all cameras it saw the board; None if all exposed together."""
    delay_spread_frames: float | None
    """Standard deviation of that over its views."""
    readout: float | None = None
    """Time from its first row to its last, as a share of that from one frame to the next; None if all are taken to be
    exposed at once."""
    readout_sigma: float | None = None
    """Standard deviation of that."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RigCalibration:
    """A rig, and how well the images of the board agree with it."""

    rig: Rig
    """The rig with covariances, in the frame of its first camera."""
    lenses: Mapping[str, LensChoice]
    """The model of the lens of each camera, and how well others did."""
    sigma_px: float
    """Standard deviation of one coordinate of a corner."""
    bending_mm: Float[np.ndarray, "k"]
    """Bending of the board, or of several one after the other, or the error of its steps; see
    :mod:`cuspid.calibration.bundle`."""
    body_from_board: Mapping[int, Rigid3]
    """Where each of several boards is on the body that carries them, by number from 0; a board that is not listed
    defines the frame of the body."""
    uneven_mm: tuple[float, float] | None
    """Standard deviations by which its corners lie elsewhere than given, in its plane and out of it; None if that
    explains no more."""
    loose_px: float | None
    """Standard deviation by which a view shows the board elsewhere than the others at that instant do; None for one
    camera."""
    widened: Mapping[str, float]
    """Factor by which the standard deviations of each lens were widened to cover unexplained differences; 1 if none."""
    cameras: Mapping[str, CameraCheck]
    """Checks by camera."""
    pixels: Mapping[str, Float[np.ndarray, "n 2"]]
    """Where each camera saw corners, px."""
    residuals: Mapping[str, Float[np.ndarray, "n 2"]]
    """Observed minus projected, px."""
    views: Views
    """The views that were used."""
    rig_from_view: Mapping[tuple[str, str], Rigid3]
    """Pose of the board when each view of it was taken, by camera and instant."""
    distance_mm: float
    """Median distance of the board from the cameras."""
    frames_per_s: float | None = None
    """Rate at which the board was filmed; None where nothing states it."""
    notes: tuple[str, ...]
    """What was left out and why, one line each."""


def calibrate_rig(
    views: Views,
    sizes: Mapping[str, tuple[int, int]],
    board: Target,
    options: CalibrationOptions = CalibrationOptions(),
) -> RigCalibration:
    """Calibrate the cameras named in ``sizes`` (width and height, px) from their views of a board.

    Raises ReconstructionError for cameras with too few views, whose views fit no camera, that never saw the board
    together, or that do not agree on how it was held.
    """
    found = _calibrate_once(views, sizes, board, options)
    if isinstance(board, BoardSet) or not board.has_circles:
        return found
    return _calibrate_once(_correct_circle_centres(views, found, board), sizes, board, options)


def _correct_circle_centres(views: Views, found: RigCalibration, board: Board) -> Views:
    """Views of circles, with the places of their centres instead of the middles of what is seen of them."""
    centred = {}
    for (name, instant), view in views.items():
        camera = found.rig[name].camera
        try:
            cam_from_board = board_pose(view, board, camera)
        except InputError:  # it is left out in any case
            continue
        centred[name, instant] = view.shifted(-centre_shifts(camera, cam_from_board, board, view.corner))
    return centred


def _calibrate_once(
    views: Views,
    sizes: Mapping[str, tuple[int, int]],
    board: Target,
    options: CalibrationOptions,
) -> RigCalibration:
    times = Counter(camera for camera, _ in views)
    few = [f"{name} {times[name]}" for name in sizes if times[name] < LEAST_VIEWS]
    if few:
        raise ReconstructionError(
            f"calibration: the board must be found at {LEAST_VIEWS} instants or more by each camera, but is at fewer "
            f"({', '.join(few)}); show it at more, or check that its columns, rows, dictionary and kind are right"
        )
    lenses = {name: _choose_camera_lens(name, views, board, size, options.lens) for name, size in sizes.items()}
    choices = {name: choice for name, (choice, _) in lenses.items()}
    alone = {name: each for name, (_, each) in lenses.items()}
    cameras = {name: each.scene.cameras[""] for name, each in alone.items()}
    notes_joining: tuple[str, ...] = ()
    if isinstance(board, BoardSet):
        start, common, notes_joining = join_boards(views, board, cameras)
    else:
        start, common = join_cameras(views, board, cameras, sorted({instant for _, instant in views}))

    def attempt(scene: BoardScene, lenses: Mapping[str, LensChoice] = choices) -> _Trial:
        found, chosen, notes = _fit_cameras(scene, common, board, options)
        return _Trial(found, _describe(found, chosen, board, lenses, (*notes_joining, *notes), options.frames_per_s))

    best = _with_timing(attempt(start), start, common, board, options, attempt)
    splined = _find_splines(best, choices, board) if options.lens == "auto" else {}
    if splined:
        scene = best.found.scene
        cameras = {**scene.cameras, **{name: camera for name, (_, camera) in splined.items()}}
        poses = {**start.rig_from_board, **scene.rig_from_board}
        scene = replace(scene, cameras=cameras, rig_from_board=poses, loose_px=0.0, shape=None)
        with suppress(ReconstructionError):  # together with the other cameras
            better = attempt(scene, {**choices, **{name: choice for name, (choice, _) in splined.items()}})
            best = better if _retains_most_views(better.described, best.described) else best
    return best.described


def _find_splines(
    best: _Trial, choices: Mapping[str, LensChoice], board: Target
) -> dict[str, tuple[LensChoice, Camera]]:
    """Cameras whose views call for a splined lens, once it is known when each row was exposed."""
    views, found = views_at_middle_rows(best.found.scene, best.described.views, board), {}
    for name, camera in best.found.scene.cameras.items():
        own = [part for (one, _), view in views.items() if one == name for part in split_by_board(view, board)]
        splined = select_splined_lens(choices[name], camera, own, board)
        if splined is not None:
            found[name] = splined
    return found


def _with_timing(
    best: _Trial,
    start: BoardScene,
    common: Views,
    board: Target,
    options: CalibrationOptions,
    attempt: Callable[[BoardScene], _Trial],
) -> _Trial:
    """With delays of the cameras and readouts, where these explain more."""
    frame = frame_numbers(start.rig_from_board)
    if frame is None or not are_consecutive(frame):
        return best

    def may_roll(scene: BoardScene, used: Views) -> bool:
        return options.shutter == "auto" and readout_score(allow_rolling(scene, frame, used), used, board) > _ROLLING

    doubtful = any(_is_doubtful_together(check) for check in best.described.cameras.values())
    if len(start.cameras) > 1 and (doubtful or may_roll(best.found.scene, best.described.views)):
        with suppress(ReconstructionError):  # the images do not tell delays as well
            apart = attempt(allow_delays(start, frame, common))
            best = apart if _is_better(apart.described, best.described) else best
    if not may_roll(best.found.scene, best.described.views):
        return best
    scene = replace(best.found.scene, rig_from_board={**start.rig_from_board, **best.found.scene.rig_from_board})
    with suppress(ReconstructionError):  # nor readouts
        rolled = attempt(allow_rolling(replace(scene, loose_px=0.0, shape=None), frame, common))
        best = rolled if _rolls(rolled, board) and _retains_most_views(rolled.described, best.described) else best
    return best


@dataclass(frozen=True, eq=False)
class _Trial:
    """A calibration under one assumption."""

    found: Adjusted
    described: RigCalibration


def _rolls(rolled: _Trial, board: Target) -> bool:
    """Whether a readout is certain, and explains images that it was not estimated from."""
    checks, timing = rolled.described.cameras.values(), rolled.found.scene.timing
    assert timing is not None
    if not any(abs(each.readout or 0.0) > _DOUBTFUL * (each.readout_sigma or np.inf) for each in checks):
        return False
    at_once = replace(rolled.found, scene=replace(rolled.found.scene, timing=replace(timing, readout={})))
    before, _ = _cross_validated(at_once, rolled.described.views, board)
    return bool(_held_out_px(rolled.described) < (1 - _LEAST_GAIN) * _rms(np.array([*before.values()] or [0.0])))


def _is_better(apart: RigCalibration, together: RigCalibration) -> bool:
    """Whether delays explain images that they were not estimated from, and not by leaving out views."""
    before, after = _held_out_px(together), _held_out_px(apart)
    return bool(np.isfinite(before) and after < _LESS * before and _retains_most_views(apart, together))


def _retains_most_views(one: RigCalibration, other: RigCalibration) -> bool:
    """Whether a calibration is made from about as many views as another."""
    return len(one.views) > _LESS * len(other.views)


def _is_worse_together(check: CameraCheck) -> bool:
    """Whether the views of a camera fit much worse together with those of the others than alone."""
    return check.rms_px > _MUCH_MORE * check.alone_px


def _is_doubtful_together(check: CameraCheck) -> bool:
    """Whether a camera may have exposed at other moments than the others."""
    return _is_worse_together(check) or (check.alone_apart or 0.0) > _DOUBTFUL


def _held_out_px(found: RigCalibration) -> float:
    """Residuals in views that a calibration was not made from, RMS over the cameras; infinite if there are none."""
    checks = found.cameras.values()
    return _rms(np.array([np.inf if check.held_out_px is None else check.held_out_px for check in checks]))


def _choose_camera_lens(
    name: str, views: Views, board: Target, size: tuple[int, int], lens: LensName
) -> tuple[LensChoice, Adjusted]:
    try:
        own = [part for (camera, _), view in views.items() if camera == name for part in split_by_board(view, board)]
        return choose_lens(own, board, size, lens)
    except ReconstructionError as error:
        raise ReconstructionError(
            f"calibration: camera {name}: {str(error).removeprefix('calibration: ')}; check the columns, rows, kind "
            "and dictionary of the board, and show it tilted by 20 to 50 degrees"
        ) from error


def _fit_cameras(
    start: BoardScene, views: Views, board: Target, options: CalibrationOptions
) -> tuple[Adjusted, Views, tuple[str, ...]]:
    """The cameras by the views that fit, and all views with the numbering of their corners that fits best.

    The cameras need not see the board at quite the same place. It is taken to be uneven where that explains instants
    better, by more than chance, that it was not estimated from.
    """
    found, notes = _adjust_robustly(start, views, board, options)
    if len(start.cameras) > 1:
        loose = replace(found.scene, loose_px=found.sigma_px)
        found = adjust_scene(loose, {key: views[key] for key in found.residuals}, board)
    used = {key: views[key] for key in found.residuals}
    if not is_grid_of_corners(board) or unevenness_score(found, used, board) < _EVEN:
        return found, views, notes
    uneven, turned = _estimate_unevenness(found, views, board)
    if uneven.scene.shape is None or uneven.scene.shape.is_even(board):
        return found, views, notes
    used = {key: turned[key] for key in found.residuals}
    before = replace(found, scene=replace(uneven.scene, shape=None)) if turned is not views else found
    if _explains_more(uneven, before, used, board):
        return uneven, turned, notes
    return found, views, notes


def _estimate_unevenness(found: Adjusted, views: Views, board: Board) -> tuple[Adjusted, Views]:
    """The cameras before a board that may be uneven, and the views with the numbering of their corners that it
    shows."""
    found = adjust_scene(
        replace(found.scene, shape=BoardShape.even(board)), {key: views[key] for key in found.residuals}, board
    )
    for _ in range(_TURNS if len(board.orders) > 1 else 0):
        turned = renumber_instant(found, {key: views[key] for key in found.residuals}, board)
        if turned is None:
            break
        scene, used = turned
        views, found = {**views, **used}, adjust_scene(scene, used, board)
    return found, views


def _explains_more(one: Adjusted, other: Adjusted, views: Views, board: Board) -> bool:
    """Whether one calibration has smaller residuals than another at instants that neither was made from, by more than
    chance and enough to matter."""
    instants = sorted({instant for _, instant in views})
    folds = min(_FOLDS, len(instants))
    gains = []
    for fold in range(folds):
        out = {key: view for key, view in views.items() if instants.index(key[1]) % folds == fold}
        rest = {key: view for key, view in views.items() if key not in out}
        counts = Counter(camera for camera, _ in rest)
        if min(counts[name] for name in one.scene.cameras) < LEAST_VIEWS or len(groups(rest, list(counts))) > 1:
            continue
        try:
            squares = [_squares_without(each.scene, rest, out, board) for each in (one, other)]
        except ReconstructionError:  # too little is left
            continue
        gains += [np.log(squares[1][instant] / squares[0][instant]) / 2 for instant in squares[0]]
    if len(gains) < LEAST_VIEWS:
        return False
    return bool(np.mean(gains) > max(_CHANCE * np.std(gains, ddof=1) / np.sqrt(len(gains)), _LEAST_GAIN))


def _squares_without(scene: BoardScene, rest: Views, out: Views, board: Board) -> dict[str, float]:
    """Mean squares of the residuals at some instants by a calibration from others."""
    found = adjust_scene(select_instants(scene, {key[1] for key in rest}), rest, board, keep_scales=True)
    held = replace(found.scene, rig_from_board=scene.rig_from_board, timing=scene.timing)
    held = select_instants(held, {key[1] for key in out})
    residuals = adjust_scene(held, out, board, only_boards=True).residuals
    instants = {key[1] for key in out}
    return {
        instant: float(np.mean(np.concatenate([each for key, each in residuals.items() if key[1] == instant]) ** 2))
        for instant in instants
    }


def _adjust_robustly(
    scene: BoardScene, views: Views, board: Target, options: CalibrationOptions
) -> tuple[Adjusted, tuple[str, ...]]:
    """Adjust, leave out the views that do not fit, and again."""
    sound = views_in_front(scene, views, board)
    notes = [
        f"camera {camera}, {instant}: left out, no pose of the board explains it"
        for camera, instant in views
        if (camera, instant) not in sound
    ]
    views, scene = sound, select_instants(scene, {instant for _, instant in sound})
    _require_views(views, scene)
    for _ in range(options.rounds):
        found = adjust_scene(scene, views, board)
        bad = _outlying_views(found, options)
        if not bad:
            return found, tuple(notes)
        notes += [
            f"camera {camera}, {instant}: left out, {rms:.2f} px RMS where {usual:.2f} px is usual; it is "
            "blurred, or was not taken at the same time as the others"
            for (camera, instant), (rms, usual) in bad.items()
        ]
        views = {key: view for key, view in views.items() if key not in bad}
        _require_views(views, scene)
        scene = select_instants(found.scene, {instant for _, instant in views})
    return adjust_scene(scene, views, board), tuple(notes)


def _outlying_views(found: Adjusted, options: CalibrationOptions) -> dict[tuple[str, str], tuple[float, float]]:
    """Views that do not fit: their RMS, and what is usual over all or for their camera, px."""
    rms = {key: _rms(residuals) for key, residuals in found.residuals.items()}
    usual = {
        name: max(found.sigma_px, float(np.median([each for (camera, _), each in rms.items() if camera == name])))
        for name in found.scene.cameras
    }
    return {key: (each, usual[key[0]]) for key, each in rms.items() if each > options.outlier_sigmas * usual[key[0]]}


def _require_views(views: Views, scene: BoardScene) -> None:
    counts = Counter(camera for camera, _ in views)
    few = [name for name in scene.cameras if counts[name] < LEAST_VIEWS]
    if few:
        raise ReconstructionError(
            f"calibration: what {', '.join(few)} saw does not fit what the others saw at the same instants; check that "
            "the cameras were triggered together, and that the file names match"
        )
    require_one_group(views, list(scene.cameras))


def _rms(residuals: Float[np.ndarray, "*n"]) -> float:
    """Of a coordinate."""
    return float(np.sqrt(np.mean(residuals**2)))


def in_frame_of(found: RigCalibration, drawn: Rig) -> RigCalibration:
    """A calibration in the frame of the drawn rig, fitted so that its cameras on the whole lie where the drawn ones
    are.

    Raises InputError if the two rigs do not have the same cameras.
    """
    if set(drawn.names) != set(found.rig.names):
        raise InputError(
            f"calibration: the drawn handpiece has the cameras {', '.join(drawn.names)}, but the images are of "
            f"{', '.join(found.rig.names)}; give them the same names"
        )
    drawn_from_rig = found.rig.motion_onto(drawn)
    seen = {key: drawn_from_rig @ pose for key, pose in found.rig_from_view.items()}
    return replace(found, rig=found.rig.in_frame(drawn_from_rig), rig_from_view=seen)


def size_notes(found: Rig, drawn: Rig, board: Target) -> tuple[str, ...]:
    """Where the cameras lie farther apart, or closer together, than they were drawn, as all do if the squares of the
    board are not as large as was said."""
    if set(found.names) != set(drawn.names) or len(found.names) < 2:
        return ()
    sizes = []
    for rig in (found, drawn):
        places = np.stack([rig[name].cam_from_rig.inverse().translation for name in found.names])
        sizes.append(float(np.linalg.norm(places - places.mean(axis=0))))
    growth = sizes[0] / max(sizes[1], 1e-9) - 1
    if abs(growth) < _ODD_SIZE:
        return ()
    direction = "farther apart" if growth > 0 else "closer together"
    return (
        f"the cameras lie {abs(growth):.1%} {direction} than drawn: was --square-mm {board.square_mm:g} measured on "
        f"the print? With {board.square_mm / (1 + growth):.3g} they lie as drawn",
    )


# --- what it is worth --------------------------------------------------------------------------------------------


def _describe(
    found: Adjusted,
    chosen: Views,
    board: Target,
    lenses: Mapping[str, LensChoice],
    notes: tuple[str, ...],
    frames_per_s: float | None,
) -> RigCalibration:
    names, views = list(found.scene.cameras), {key: chosen[key] for key in found.residuals}
    of = {name: [key for key in views if key[0] == name] for name in names}
    pixels = {name: np.concatenate([views[key].pixels for key in of[name]]) for name in names}
    residuals = {name: np.concatenate([found.residuals[key] for key in of[name]]) for name in names}
    held_out, apart = _cross_validated(found, views, board)
    alone = {name: _calibrate_from_own_views(name, found, views, board) for name in names}
    seen = {key: found.scene.rig_from_view(*key) for key in views}
    distances = [np.linalg.norm((found.scene.cam_from_rig[key[0]] @ pose).translation) for key, pose in seen.items()]
    delays, readouts = _delays(found.scene, views), readout_sigmas(found)
    checks = {
        name: CameraCheck(
            views=len(of[name]),
            corners=len(pixels[name]),
            rms_px=_rms(residuals[name]),
            alone_px=alone[name].sigma_px,
            held_out_px=held_out.get(name),
            parameters_apart=apart[name][0] if name in apart else None,
            place_apart=apart[name][1] if name in apart else None,
            alone_apart=_lens_difference_in_sigmas(found.scene.cameras[name], alone[name])
            if len(of[name]) >= _TELLING
            else None,
            delay_frames=delays[name][0],
            delay_spread_frames=delays[name][1],
            readout=found.scene.timing.readout[name] if found.scene.timing and readouts else None,
            readout_sigma=readouts.get(name),
        )
        for name in names
    }
    rig = Rig({name: _widen_covariance(mounted, checks[name]) for name, mounted in mounted_cameras(found).items()})
    return RigCalibration(
        rig=rig,
        lenses=lenses,
        sigma_px=found.sigma_px,
        bending_mm=found.scene.bending_mm,
        body_from_board=found.scene.body_from_board,
        uneven_mm=found.scene.shape.sigma_mm if found.scene.shape else None,
        loose_px=found.scene.loose_px if len(names) > 1 else None,
        widened={name: _lens_factor(check) for name, check in checks.items()},
        cameras=checks,
        pixels=pixels,
        residuals=residuals,
        views=views,
        rig_from_view=seen,
        distance_mm=float(np.median(distances)),
        frames_per_s=frames_per_s,
        notes=(
            *notes,
            *_board_notes(found.scene),
            *_timing_notes(checks, frames_per_s),
            *_doubt_notes(found.settled, checks, rig),
        ),
    )


def _delays(scene: BoardScene, views: Views) -> dict[str, tuple[float, float] | tuple[None, None]]:
    """Of each camera, how many frames after the mean of all it exposed, and the standard deviation of that over its
    views. Where cameras missed the board, by least squares: those that saw it may be the late ones."""
    if scene.timing is None or scene.timing.together:
        return dict.fromkeys(scene.cameras, (None, None))
    times, names = Counter(instant for _, instant in views), list(scene.cameras)
    shared = [key for key in views if times[key[1]] > 1]  # alone there is nothing to compare with
    instants = list(dict.fromkeys(instant for _, instant in shared))
    design = np.zeros((len(shared) + 1, len(names) + len(instants)))
    design[-1, : len(names)] = 1.0  # the delays have a mean of 0
    for row, (camera, instant) in enumerate(shared):
        design[row, [names.index(camera), len(names) + instants.index(instant)]] = 1.0
    delays = np.array([scene.timing.delay(*key) for key in shared] + [0.0])
    found = np.linalg.lstsq(design, delays, rcond=None)[0]
    left = (delays - design @ found)[:-1]
    own = {name: left[[camera == name for camera, _ in shared]] for name in names}
    return {
        name: (float(found[k]), float(np.std(own[name])) if len(own[name]) else 0.0) for k, name in enumerate(names)
    }


def _calibrate_from_own_views(name: str, found: Adjusted, views: Views, board: Target) -> Adjusted:
    """A camera from its own views alone, beginning from the one that was found; of several boards each for itself."""
    if len(found.scene.cameras) == 1:
        return found
    views = views_at_middle_rows(found.scene, {key: view for key, view in views.items() if key[0] == name}, board)
    own, poses = dict[tuple[str, str], BoardView](), dict[str, Rigid3]()
    for camera, instant in views:
        pose = found.scene.cam_from_rig[name] @ found.scene.rig_from_view(camera, instant)
        for part in split_by_board(views[camera, instant], board):
            if len(part.corner) < LEAST_CORNERS:
                continue
            number = int(board.board_of(part.corner[:1])[0])
            alone = f"{instant}/{number}"
            own[camera, alone] = part
            poses[alone] = pose @ found.scene.body_from_board.get(number, Rigid3.identity())
    scene = replace(
        found.scene,
        cameras={name: found.scene.cameras[name]},
        cam_from_rig={name: Rigid3.identity()},
        rig_from_board=poses,
        body_from_board={},
        timing=None,
        loose_px=0.0,
    )
    return adjust_board(scene, own, board, keep_scales=True)


def _lens_difference_in_sigmas(camera: Camera, alone: Adjusted) -> float:
    """Difference of the parameters from those of the camera alone, in the standard deviations of these."""
    (other,) = (each.camera for each in mounted_cameras(alone).values())
    return _rms_in_sigmas(camera.parameters - other.parameters, require_covariance(other.covariance))


def _widen_covariance(mounted: MountedCamera, check: CameraCheck) -> MountedCamera:
    """With covariances that account for how far two halves of the images are apart, and the lens from that of its own
    views alone, where chance hardly explains it; and with its shutter."""
    camera = replace(
        mounted.camera, covariance=_lens_factor(check) ** 2 * require_covariance(mounted.camera.covariance)
    )
    return replace(
        mounted,
        camera=camera,
        covariance=_inflation_factor(check.place_apart) ** 2 * require_covariance(mounted.covariance),
        shutter=Shutter(
            delay_frames=check.delay_frames or 0.0,
            delay_sigma_frames=check.delay_spread_frames or 0.0,
            readout=check.readout or 0.0,
            readout_sigma=check.readout_sigma or 0.0,
        ),
    )


def _lens_factor(check: CameraCheck) -> float:
    return max(_inflation_factor(check.parameters_apart), _inflation_factor(check.alone_apart))


def _inflation_factor(apart: float | None) -> float:
    """How many standard deviations something is apart, where chance hardly explains that; else 1."""
    return apart if apart is not None and apart > _DOUBTFUL else 1.0


def _board_notes(scene: BoardScene) -> Iterator[str]:
    """Where its corners do not lie as given."""
    if scene.shape is not None:
        across, out = (1000 * sigma for sigma in scene.shape.sigma_mm)
        yield (
            f"the corners of the board lie {across:.2g} um off in its plane and {out:.2g} um out of it (standard "
            "deviations); this is taken into account"
        )


def _timing_notes(checks: Mapping[str, CameraCheck], frames_per_s: float | None) -> Iterator[str]:
    """Where the cameras do not expose together, or not all of their rows."""

    def describe(name: str, frames: float, sigma: float | None, digits: int) -> str:
        in_ms = "" if frames_per_s is None else f" ({1000 * frames / frames_per_s:+.1f} ms)"
        return f"{name} {frames:+.{digits}f} ± {sigma:.{digits}f}{in_ms}"

    delays = [
        describe(name, check.delay_frames, check.delay_spread_frames, 2)
        for name, check in checks.items()
        if check.delay_frames is not None
    ]
    if delays:
        yield (
            "the cameras did not expose together; by the motion of the board, in frames from their mean: "
            f"{', '.join(delays)}; this is taken into account, but a board at rest gives more accurate results"
        )
        yield from _numbering_notes({name: each.delay_frames or 0.0 for name, each in checks.items()})
    readouts = [
        describe(name, check.readout, check.readout_sigma, 3)
        for name, check in checks.items()
        if check.readout is not None
    ]
    if readouts:
        yield (
            "the cameras do not expose all rows at once; by the motion of the board, from the first row to the last, "
            f"as a share of the time between frames: {', '.join(readouts)}; this is taken into account"
        )


def _numbering_notes(delays_frames: Mapping[str, float]) -> Iterator[str]:
    """Which cameras began whole frames later, or earlier, than most."""
    usual = median_low(delays_frames.values())
    for name, delay in delays_frames.items():
        if late := round(delay - usual):
            yield (
                f"camera {name} began {abs(late)} frame{'s' * (abs(late) > 1)} {'later' if late > 0 else 'earlier'} "
                f"than most: number its images {abs(late)} {'higher' if late > 0 else 'lower'}"
            )


def _doubt_notes(settled: bool, checks: Mapping[str, CameraCheck], rig: Rig) -> Iterator[str]:
    """Where the search did not end; where the lens or the board is not what the model says, or the cameras were not
    triggered together; where the views leave the focal length open."""
    if not settled:
        yield "the adjustment did not converge; its results may be wrong"
    for name, check in checks.items():
        worst = max(check.parameters_apart or 0.0, check.place_apart or 0.0)
        if worst > _DOUBTFUL:
            yield (
                f"camera {name}: calibrations from two halves of the images differ by {worst:.1f} of their standard "
                "deviations, which already allow for views that disagree; its covariance is widened accordingly; look "
                "for a pattern in residuals.png"
            )
        if check.alone_apart is not None and check.alone_apart > _DOUBTFUL:
            yield (
                f"camera {name}: its own views alone give a lens {check.alone_apart:.1f} of their standard deviations "
                "away; its covariance is widened accordingly; the board may be bent, or the cameras not triggered "
                "together"
            )
        if check.delay_frames is None and _is_worse_together(check):
            yield (
                f"camera {name}: {check.rms_px:.2f} px RMS together with the others, {check.alone_px:.2f} px alone; "
                "they may not have seen the board at the same moment, or have moved against each other"
            )
    for name, mounted in rig.cameras.items():
        share = float(np.sqrt(require_covariance(mounted.camera.covariance)[0, 0])) / mounted.camera.focal_px[0]
        if share > _OPEN_SHARE:
            yield f"camera {name}: its focal length is known only to {share:.0%}; show the board tilted, near and far"


def _cross_validated(
    found: Adjusted, views: Views, board: Target
) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Of two halves of the instants, each calibrated for itself: the residuals in the other one, and how far they are
    from each other, where each has views enough to tell. Nothing where a half is too small, or its cameras fall into
    groups."""
    halves = _halves(views, found.scene.timing)
    counts = [Counter(camera for camera, _ in half) for half in halves]
    cameras = list(found.scene.cameras)
    if any(count[name] < LEAST_VIEWS for count in counts for name in cameras):
        return {}, {}
    if any(len(groups(half, cameras)) > 1 for half in halves):
        return {}, {}
    try:
        parts = [
            adjust_scene(select_instants(found.scene, {key[1] for key in half}), half, board, keep_scales=True)
            for half in halves
        ]
    except ReconstructionError:  # half of the views leave open where a board, or a camera, is
        return {}, {}
    squares: dict[str, list[Float[np.ndarray, "n 2"]]] = {name: [] for name in found.scene.cameras}
    for part, other, other_views in zip(parts, parts[::-1], halves[::-1], strict=True):
        start = replace(part.scene, rig_from_board=other.scene.rig_from_board)
        shown = views_in_front(start, other_views, board) if start.timing is None else other_views
        if not shown:
            continue
        start = select_instants(start, {instant for _, instant in shown})
        for (camera, _), residuals in adjust_scene(start, shown, board, only_boards=True).residuals.items():
            squares[camera].append(residuals)
    tell = all(count[name] >= _TELLING for count in counts for name in cameras)
    return {name: _rms(np.concatenate(each)) for name, each in squares.items() if each}, _differences_in_sigmas(
        *parts
    ) if tell else {}


def _halves(views: Views, timing: Timing | None) -> list[Views]:
    """The views of every second instant, or where cameras do not expose together of every second run of instants, and
    the others."""
    instants = sorted({instant for _, instant in views}, key=None if timing is None else timing.frame.__getitem__)
    run = 1 if timing is None else _RUN
    half = {instant: index // run % 2 for index, instant in enumerate(instants)}
    return [{key: view for key, view in views.items() if half[key[1]] == k} for k in range(2)]


def _differences_in_sigmas(one: Adjusted, other: Adjusted) -> dict[str, tuple[float, float]]:
    """Differences of parameters and of places, in standard deviations of the difference, RMS over the numbers."""
    between = [one.scene.cam_from_rig[name] @ pose.inverse() for name, pose in other.scene.cam_from_rig.items()]
    motions = common_free(one.scene, [np.array([*m.rotation_vector, *m.translation]) for m in between])
    ours, theirs = mounted_cameras(one), mounted_cameras(other)
    found = {}
    for name, motion in zip(ours, motions, strict=True):
        a, b = ours[name], theirs[name]
        shift = a.camera.parameters - b.camera.parameters
        found[name] = (
            _rms_in_sigmas(shift, require_covariance(a.camera.covariance) + require_covariance(b.camera.covariance)),
            _rms_in_sigmas(motion, require_covariance(a.covariance) + require_covariance(b.covariance)),
        )
    return found


def require_covariance(covariance: Float[np.ndarray, "n n"] | None) -> Float[np.ndarray, "n n"]:
    """The covariance of a camera that was calibrated here, which always has one."""
    if covariance is None:
        raise ValueError("a calibration without covariance")
    return covariance


def _rms_in_sigmas(difference: Float[np.ndarray, "n"], covariance: Float[np.ndarray, "n n"]) -> float:
    """RMS of a difference, each direction in its standard deviations."""
    return float(np.sqrt(difference @ np.linalg.pinv(covariance, hermitian=True) @ difference / len(difference)))
