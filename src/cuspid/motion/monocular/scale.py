"""How large things are, for a model of one camera, which does not know: from a board in the scene, or from distances
between places that were picked in two photographs.

Frames: as in :mod:`cuspid.model.sparse_model`; ``board`` as in :mod:`cuspid.model.board`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from cuspid.geometry import best_similarity
from cuspid.model.board import Board, BoardPattern
from cuspid.model.sparse_model import PhotoModel, Scale
from cuspid.runtime.errors import InputError, ReconstructionError
from cuspid.runtime.options import Range
from cuspid.runtime.values import LONGEST_MM

_LEAST_CORNERS = 6
_ROUNDS = 8
_OFF_PX, _LEAST_ANGLE_DEG = 3.0, 1.0
"""A place that is seen farther than this from where it should be is not used; nor is a point under a smaller angle."""
_OUTLIER_SIGMAS = 4.0
_BENT_SHARE, _BENT_SIGMAS = 0.002, 3.0
"""A board is bent where its corners lie off a plane by more than this share of its size, and this many times as far as
they are off within it."""
_NUMBERS = 9
"""Of a distance: two ends in each of two photographs, and the mm between them."""
_LEAST_MM, _READING_MM = 0.01, 0.1
"""The shortest distance, and an error in reading callipers."""


@dataclass(frozen=True, kw_only=True)
class PhotoScaleOptions(BoardPattern):
    """What sets the scale of the photographs of one camera: a board, or measured distances."""

    square_mm: Annotated[float | None, Range(0.001, 10_000)] = None
    """Side of a square of a board that some photographs show, as measured on the print: it sets the scale."""
    between: tuple[str, str] | None = None
    """Two photographs from different sides in which the ends of measured distances were picked."""
    distance: Annotated[tuple[float, ...], Range(-LONGEST_MM, LONGEST_MM)] = ()
    """A measured distance that sets the scale: x and y of its two ends in the first of these photographs (px, as
    viewers show it), x and y of the same ends in the second, and how many mm lie between them: nine numbers, and nine
    more for each further distance."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.distance and self.square_mm is not None:
            raise InputError("--distance and --square-mm both set the scale; give one of them")
        if bool(self.distance) != (self.between is not None):
            raise InputError("--distance needs --between, the two photographs in which its ends were picked, and back")
        if self.between is not None and self.between[0] == self.between[1]:
            raise InputError(f"--between: {self.between[0]} twice; give two photographs from different sides")
        if len(self.distance) % _NUMBERS:
            raise InputError(
                f"--distance: {len(self.distance)} numbers; it takes X Y X Y X Y X Y MM, {_NUMBERS} for each"
            )
        for mm in self.distance[_NUMBERS - 1 :: _NUMBERS]:
            if mm < _LEAST_MM:
                raise InputError(f"--distance: {mm:g} mm; it must be {_LEAST_MM} mm or more")
        _ = self.board  # which checks the pattern

    @property
    def distances(self) -> tuple[tuple[float, ...], ...]:
        """The nine numbers of each distance."""
        return tuple(self.distance[k : k + _NUMBERS] for k in range(0, len(self.distance), _NUMBERS))

    @property
    def board(self) -> Board | None:
        """The board, where one is given."""
        if self.square_mm is None:
            return None
        pattern = {each.name: getattr(self, each.name) for each in fields(BoardPattern)}
        return Board(**pattern, square_mm=self.square_mm)


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardSighting:
    """A board in a photograph."""

    frame: str
    """Name of the photograph."""
    corner: Int[np.ndarray, "n"]
    """Numbers of the corners on the board."""
    pixels: Float[np.ndarray, "n 2"]
    """Where they are, px."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PickedDistance:
    """A distance between two places, each picked in the same two photographs."""

    frames: tuple[str, str]
    """Names of the photographs."""
    pixels: Float[np.ndarray, "2 2 2"]
    """By photograph, then by place: px in the grid of the sensor."""
    mm: float
    """As measured."""


# --- points seen from several places -----------------------------------------------------------------------------


def triangulate_point(
    model: PhotoModel, frames: Sequence[str], pixels: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "n"]]:
    """The point whose images lie nearest to places in some photographs, and how far each is off, px (NaN behind a
    camera): intersection of rays, then Gauss-Newton on the pixels."""
    poses = [model.cam_from_world[frame] for frame in frames]
    cameras = [model.camera(frame) for frame in frames]
    rays = np.stack(
        [pose.rotation.T @ camera.rays(pixel) for pose, camera, pixel in zip(poses, cameras, pixels, strict=True)]
    )
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    centres = np.stack([pose.inverse().translation for pose in poses])
    point = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centres), rcond=None)[0]

    def residuals_px(place: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 2"]:
        return np.stack([c.project(p.apply(place)) for c, p in zip(cameras, poses, strict=True)]) - pixels

    for _ in range(_ROUNDS):
        residual = residuals_px(point)
        step = 1e-6 * float(np.linalg.norm(point - centres, axis=1).mean())
        jacobian = np.stack([(residuals_px(point + step * axis) - residual) / step for axis in np.eye(3)], axis=-1)
        usable = np.isfinite(residual).all(axis=1)
        if usable.sum() < 2:
            break
        point = point - np.linalg.lstsq(jacobian[usable].reshape(-1, 3), residual[usable].ravel(), rcond=None)[0]
    return point, np.linalg.norm(residuals_px(point), axis=1)


def _robust(
    model: PhotoModel, frames: Sequence[str], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "3"] | None:
    """As :func:`triangulate_point`, without outliers; None where fewer than two photographs are left, or they look from
    nearly one place."""
    frames = list(frames)
    while len(frames) >= 2:
        point, off = triangulate_point(model, frames, pixels)
        off = np.nan_to_num(off, nan=np.inf)
        if off.max() <= _OFF_PX:
            centres = np.stack([model.cam_from_world[frame].inverse().translation for frame in frames])
            rays = point - centres
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            angle = np.rad2deg(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))
            return point if angle >= _LEAST_ANGLE_DEG else None
        worst = int(off.argmax())
        frames, pixels = frames[:worst] + frames[worst + 1 :], np.delete(pixels, worst, axis=0)
    return None


# --- a board -----------------------------------------------------------------------------------------------------


def scale_by_board(model: PhotoModel, sightings: Sequence[BoardSighting], board: Board, photographs: int) -> Scale:
    """The scale from a board that some photographs show.

    ``photographs``: how many were searched. Raises ReconstructionError where fewer than two located photographs show
    it, or too few of its corners agree.
    """
    kind = "ChArUco board" if board.kind == "charuco" else "chessboard"
    what = f"the {kind} of {board.columns} x {board.rows} squares"
    if not sightings:
        raise ReconstructionError(
            f"{what} is seen in none of {photographs} photographs; check --columns, --rows, --dictionary and --legacy, "
            "or take photographs that show it sharply"
        )
    located = [each for each in sightings if each.frame in model.cam_from_world]
    if len(located) < 2:
        raise ReconstructionError(
            f"{what} is seen in {len(sightings)} of {photographs} photographs, but {len(located)} of these could be "
            "located; it takes two, from different places"
        )
    numbered = _unify_numbering(model, located, board)
    corner, points = _corners(model, numbered)
    if len(corner) < _LEAST_CORNERS:
        raise ReconstructionError(
            f"{what}: only {len(corner)} of its corners are seen alike in two photographs; it moved, or is not this "
            "board"
        )
    scale = _fit_board(board, board.corners[corner], points, what, len(located))
    return replace(scale, sigma_share=max(scale.sigma_share, _jackknife(model, numbered, board)))


def _jackknife(model: PhotoModel, sightings: Sequence[BoardSighting], board: Board) -> float:
    """Standard deviation of the scale, as a share of it, by leaving out one photograph at a time: all corners of one
    share the error of its pose, of which their scatter about the board tells little. 0 where too few are left."""
    scales = []
    for k in range(len(sightings)):
        corner, points = _corners(model, [*sightings[:k], *sightings[k + 1 :]])
        if len(corner) >= _LEAST_CORNERS:
            scales.append(_fit_board(board, board.corners[corner], points, "", 0).mm_per_unit)
    count = len(scales)
    return float(np.sqrt((count - 1) / count) * np.std(scales) * np.sqrt(count) / np.mean(scales)) if count > 2 else 0.0


def _corners(
    model: PhotoModel, sightings: Sequence[BoardSighting]
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """The corners that two photographs see alike, and where they are in the model."""
    seen: dict[int, list[tuple[str, np.ndarray]]] = {}
    for each in sightings:
        for number, pixel in zip(each.corner.tolist(), each.pixels, strict=True):
            seen.setdefault(number, []).append((each.frame, pixel))
    points = {
        number: _robust(model, [frame for frame, _ in places], np.stack([pixel for _, pixel in places]))
        for number, places in sorted(seen.items())
        if len(places) >= 2
    }
    found = {number: point for number, point in points.items() if point is not None}
    return np.array(list(found), dtype=np.int64), np.array(list(found.values())).reshape(-1, 3)


def _unify_numbering(model: PhotoModel, sightings: Sequence[BoardSighting], board: Board) -> list[BoardSighting]:
    """Sightings of a chessboard, whose corners are not told apart, numbered as in the first one."""
    orders = board.orders
    if len(orders) == 1:
        return list(sightings)
    first = sightings[0]
    return [first] + [min(_numberings(each, orders), key=lambda o: _misfit(model, first, o)) for each in sightings[1:]]


def _numberings(sighting: BoardSighting, orders: Int[np.ndarray, "k n"]) -> list[BoardSighting]:
    return [
        BoardSighting(frame=sighting.frame, corner=order[sighting.corner], pixels=sighting.pixels) for order in orders
    ]


def _misfit(model: PhotoModel, one: BoardSighting, other: BoardSighting) -> float:
    """How far corners of one number are from being one point, px."""
    both, at, there = np.intersect1d(one.corner, other.corner, return_indices=True)
    few = slice(None, None, max(1, len(both) // 12))
    off = [
        triangulate_point(model, (one.frame, other.frame), np.stack([one.pixels[i], other.pixels[j]]))[1]
        for i, j in zip(at[few], there[few], strict=True)
    ]
    return float(np.median(np.nan_to_num(np.concatenate(off), nan=np.inf))) if off else np.inf


def _fit_board(
    board: Board, in_board: Float[np.ndarray, "n 3"], in_model: Float[np.ndarray, "n 3"], what: str, photographs: int
) -> Scale:
    """The similarity from the board to the model, without the corners that do not agree."""
    used: Bool[np.ndarray, "n"] = np.ones(len(in_board), dtype=bool)
    for _ in range(_ROUNDS):
        units_per_mm, rotation, shift = best_similarity(in_board[used], in_model[used])
        in_mm = (in_model - shift) @ rotation / units_per_mm
        off = np.linalg.norm(in_mm - in_board, axis=1)
        middle = float(np.median(off))
        agree = off <= max(_OUTLIER_SIGMAS * middle, 1e-9)
        if (agree == used).all() or agree.sum() < _LEAST_CORNERS:
            break
        used = agree
    left = (in_mm - in_board)[used]
    rms_mm = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    spread_mm = float(np.sqrt(np.sum((in_board[used] - in_board[used].mean(axis=0)) ** 2)))
    notes = _board_notes(board, left, used)
    sigma = float(np.sqrt(np.sum(left**2) / max(3 * used.sum() - 7, 1))) / spread_mm
    return Scale(
        mm_per_unit=1 / units_per_mm,
        sigma_share=sigma,
        told_by=f"{what}: {used.sum()} corners in {photographs} photographs",
        residual_mm=rms_mm,
        notes=notes,
    )


def _board_notes(board: Board, left: Float[np.ndarray, "m 3"], used: Bool[np.ndarray, "n"]) -> tuple[str, ...]:
    notes = []
    within = float(np.sqrt(np.mean(left[:, :2] ** 2)))
    out = float(np.sqrt(np.mean(left[:, 2] ** 2)))
    if out > max(_BENT_SIGMAS * within, _BENT_SHARE * max(board.size_mm)):
        notes.append(f"the board is bent: its corners lie {out:.2f} mm (RMS) off a plane; put it on something flat")
    if used.mean() < 0.8:
        notes.append(
            f"{(~used).sum()} of {len(used)} corners of the board do not agree with the others: it moved between "
            "photographs, or they are blurred"
        )
    return tuple(notes)


# --- distances ---------------------------------------------------------------------------------------------------


def scale_by_distances(model: PhotoModel, distances: Sequence[PickedDistance]) -> Scale:
    """The scale that suits measured distances best (least squares of their errors in mm).

    Raises InputError where a photograph is not located, or the places picked in two of them are not the same.
    """
    lengths = np.array([_length(model, each) for each in distances])
    measured = np.array([each.mm for each in distances])
    factor = float(lengths @ measured / (lengths @ lengths))
    left = factor * lengths - measured
    rms_mm = float(np.sqrt(np.mean(left**2)))
    sigma_mm = max(_READING_MM, rms_mm)
    given = " and ".join(f"{each:g} mm" for each in measured)
    return Scale(
        mm_per_unit=factor,
        sigma_share=sigma_mm / float(np.linalg.norm(measured)),
        told_by=f"{given} between picked places",
        residual_mm=rms_mm,
    )


def _length(model: PhotoModel, distance: PickedDistance) -> float:
    for frame in distance.frames:
        if frame not in model.cam_from_world:
            raise InputError(f"--distance: photograph {frame} could not be located; pick the places in another one")
    ends = []
    for place in range(2):
        point, off = triangulate_point(model, distance.frames, distance.pixels[:, place])
        most = max(10.0, 0.01 * max(model.camera(distance.frames[0]).width, 1))
        if not np.nan_to_num(off, nan=np.inf).max() <= most:
            u, v = distance.pixels[0, place]
            raise InputError(
                f"--distance: ({u:g}, {v:g}) in {distance.frames[0]} and the place in {distance.frames[1]} are not the "
                "same; pick both places in the same order, in photographs from different sides"
            )
        ends.append(point)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    if not length > 0:
        raise InputError("--distance: the two places are the same; give two")
    return length
