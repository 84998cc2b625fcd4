"""Where the handpiece was, from the surfaces that it measured: for teeth without texture, which give no tracks.

The depth maps of each frame are metric, so that frames are placed by laying their surfaces onto each other: first each
onto an earlier one, by iterative closest points with point-to-plane distances (Y. Chen, G. Medioni, Image and Vision
Computing 10, 1992) and a motion model; then all at once, over the pairs of frames that show most of the same surface,
whether consecutive or not. A pair counts for as much as its surfaces overlap and as little as they scatter about each
other, and a point for as much as its depth is known: what is smooth because the images tell little there goes along
with the cameras, so that it would hold them back. Thus drift is spread where it is least certain, and a path that comes
back is closed.

How far the poses may be off follows from how the gradients of all pairs scatter from one block of space to the next
(covariance of an M-estimate with clusters, as for tracks): surfaces are smooth, so that their errors hang together
within a block, whichever frames show it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby, islice, product
from typing import Annotated, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial import cKDTree

from cuspid.capture import Capture, Dropped
from cuspid.errors import ReconstructionError
from cuspid.geometry import Rigid3, unit
from cuspid.motion.expectation import MOST_POINTS, expectation_of, steps_drawn
from cuspid.motion.held_calibration import depth_sigma_mm
from cuspid.options import SEED, SHARE, Options, Range
from cuspid.progress import Progress, silent
from cuspid.reconstruction import DepthMap, Expectation, Reconstruction
from cuspid.rig import Handpiece
from cuspid.workers import map_in_threads

_JUMP = 0.06
"""Neighbours in a depth map that lie farther apart, as a share of the working distance, are not on one surface."""
_LEAST_COSINE = 0.3
"""Of the angle between surface and line of sight: what is seen more obliquely is too noisy to lay anything on."""
_LEAST_MEMBERS = 3
"""Depths that make a point."""
_ALIKE = 0.7
"""Cosine of the largest angle between the normals of the same place in two frames."""
_REACHES = (0.2, 0.2, 0.14, 0.14, 0.1, 0.1, 0.06, 0.06, 0.04, 0.04, 0.03, 0.03)
"""Largest distance between the same place in two frames, step by step, as a share of the working distance."""
_FIRST_STEPS = (0.0, -0.2, 0.2, -0.4, 0.4)
"""How far the handpiece may have moved at first, along each axis across its view, as shares of the working distance."""
_LAST_STEPS = 4
"""Steps with all points, once a few have found the place."""
_FOUND_AGAIN = 0.5
"""Least overlap with a frame from long ago: smooth parts of two teeth are alike."""
_FEW = 600
"""Points of a frame by which most others are ruled out where a lost piece is looked for."""
_WITNESSES, _LEAST_WITNESSES, _AGREED = 20, 2, 0.8
"""Pairs of frames that are asked whether a piece was found in the right place, how many there must be at least, and how
many of them must agree."""
_NEAR = 0.25
"""Largest motion between frames that see about the same: working distances, and radians."""
_TUKEY = 3.0
"""Robust standard deviations beyond which a distance has no weight."""
_LEAST_SIGMA = 0.0006
"""Standard deviation of distances, as a share of the working distance, below which none is assumed."""
_LEAST_MATCHES = 100
_BRIEFLY, _BLOCKS = 3, 0.1
"""Frames back that are tried first, and side of the blocks by which overlap is told, as share of the working distance
(mm for 10 mm)."""
_LITTLE_GLARE = 0.1
"""Share of mirror reflections that does little harm."""
_CLUSTER = 0.2
"""Side of the blocks within which errors of surfaces hang together, as a share of the working distance."""
_DAMPING, _HELD_BY_NOTHING = 1e-9, 1e-13
"""Shares of the diagonal that are added to the normal equations of one pair, and of all: what bends a whole path stands
out so little from it that more would freeze the bend."""
_CONVERGED = 2e-6
"""Step of the joint adjustment, as a share of the working distance, that ends it."""
_LEAST_DEPTH = 1e-4
"""Errors of depth, as a share of the working distance, below which a calibration counts as exact."""
_LONG = 5.0
"""Length of a path, in working distances, from which on its drift is seen."""


@dataclass(frozen=True, kw_only=True)
class SurfaceTrackingOptions(Options):
    """How the trajectory of the handpiece is found from surfaces."""

    thinning: Annotated[float, Range(0.0001, 1)] = 0.02
    """Each frame is thinned to one point per cube of this side, as a share of the working distance (0.1 mm at 5 mm)."""
    border_px: Annotated[int, Range(0, 1000)] = 2
    """Depths within so many pixels of a depth map (in each direction) of one that is not known are not laid onto
    others: surfaces are smoothed from one side only there, and turn along with the cameras."""
    minimum_overlap: Annotated[float, SHARE] = 0.3
    """Share (0 to 1) of a frame's surface that must lie on an earlier one for the frame to be placed."""
    largest_scatter: Annotated[float, Range(0.0001, 1)] = 0.018
    """Standard deviation of the distances between the surfaces of two frames, as a share of the working distance (0.09
    mm at 5 mm), above which they do not fit each other; less where less of the surface lies on the other one, in
    proportion."""
    least_relief: Annotated[float, SHARE] = 0.003
    """How much a surface must turn to hold another in place: least mean squared cosine between its normals and any
    direction; 0 is a plane, 1/3 a ball."""
    minimum_located: Annotated[float, SHARE] = 0.5
    """Minimum share (0 to 1) of the frames that must be placed."""
    joint_overlap: Annotated[float, SHARE] = 0.15
    """Frames that share at least this part of the smaller surface are adjusted to each other, if neither shares more
    with one that lies between."""
    samples: Annotated[int, Range(100, 1_000_000)] = 6000
    """Points of each frame that are laid onto others in searches and in the joint adjustment."""
    rounds: Annotated[int, Range(1, 1000)] = 20
    """Maximum number of rounds of the joint adjustment."""
    seed: Annotated[int, SEED] = 0
    """Seed of the choice of these points."""


class Shown(NamedTuple):
    """Points of a surface that a frame shows, in its rig frame."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    trust: Float[np.ndarray, "n"]
    """Inverse variance, in any unit."""


class Surface:
    """What a frame shows, ready to be asked for the nearest point."""

    def __init__(self, shown: Shown) -> None:
        self.points, self.normals, self.trust = shown
        self._tree = cKDTree(self.points)

    def __len__(self) -> int:
        return len(self.points)

    def nearest(
        self, points: Float[np.ndarray, "n 3"], reach_mm: float
    ) -> tuple[Bool[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Whether a point lies within reach, and which."""
        distance, index = self._tree.query(points, distance_upper_bound=reach_mm)
        near = np.isfinite(distance)
        return near, np.where(near, index, 0)

    def some(self, count: int, rng: np.random.Generator) -> Shown:
        """A random choice of the points."""
        chosen = rng.permutation(len(self))[:count]
        return Shown(self.points[chosen], self.normals[chosen], self.trust[chosen])


class _Laid(NamedTuple):
    """How one surface lies on another."""

    points: np.ndarray
    """Of the first, in the frame of the second."""
    normals: np.ndarray
    """Mean of both."""
    distances: np.ndarray
    """Along them."""
    sigmas: np.ndarray
    """Standard deviation of each."""
    sigma: float
    """That of a typical one."""
    share: float
    """Of the first surface that lies on the second."""

    @property
    def _off(self) -> Float[np.ndarray, "n"]:
        return np.asarray(np.minimum((self.distances / (_TUKEY * self.sigmas)) ** 2, 1.0))

    @property
    def weights(self) -> Float[np.ndarray, "n"]:
        """Tukey's, over the variance."""
        return np.asarray((1 - self._off) ** 2 / self.sigmas**2)

    @property
    def slopes(self) -> Float[np.ndarray, "n"]:
        """How much weight times distance changes with the distance."""
        return np.asarray((1 - self._off) * (1 - 5 * self._off) / self.sigmas**2)

    @property
    def relief(self) -> float:
        """See :attr:`SurfaceTrackingOptions.least_relief`."""
        return float(np.linalg.eigvalsh(self.normals.T @ self.normals / len(self.normals))[0])


@dataclass(frozen=True, eq=False)
class _Step:
    """A frame laid onto another one."""

    this_from_other: Rigid3
    laid: _Laid | None

    @property
    def rank(self) -> float:
        """The more overlap and the less scatter, the better."""
        return 0.0 if self.laid is None else self.laid.share / self.laid.sigma


# --- surfaces of frames ------------------------------------------------------------------------------------------


def _shown(depth_map: DepthMap, jump_mm: float, border_px: int) -> Shown:
    """The points of a depth map that have neighbours on all sides, in the rig frame."""
    camera = depth_map.camera
    rays = camera.rays(camera.pixel_centres().reshape(-1, 2)).reshape(camera.height, camera.width, 3)
    points = rays * np.where(depth_map.known, depth_map.depth_mm, np.nan)[..., None]
    right, down = np.full((2, *points.shape), np.nan)
    right[:, 1:-1], down[1:-1] = points[:, 2:] - points[:, :-2], points[2:] - points[:-2]
    normals = unit(np.cross(down, right))
    facing = -(normals * points).sum(axis=-1) / np.linalg.norm(points, axis=-1)
    normals, facing = normals * np.sign(facing)[..., None], np.abs(facing)
    with np.errstate(invalid="ignore"):
        smooth = np.maximum(np.linalg.norm(right, axis=-1), np.linalg.norm(down, axis=-1)) < jump_mm
        good = smooth & (facing > _LEAST_COSINE) & _away_from_border(depth_map.known, border_px)
    rig_from_cam = depth_map.cam_from_rig.inverse()
    return Shown(
        rig_from_cam.apply(points[good]), rig_from_cam.rotate(normals[good]), depth_map.confidence[good].astype(float)
    )


def _away_from_border(known: Bool[np.ndarray, "h w"], border_px: int) -> Bool[np.ndarray, "h w"]:
    """Pixels with no unknown one so close; beyond the image nothing is unknown."""
    window = np.ones((2 * border_px + 1,) * 2, np.uint8)
    return cv2.erode(known.astype(np.uint8), window).astype(bool)


def surface_of(depth_maps: Iterable[DepthMap], working_distance_mm: float, options: SurfaceTrackingOptions) -> Surface:
    """What the depth maps of a frame show, thinned out: the mean of what lies in one cube and faces one way."""
    parts = [_shown(each, _JUMP * working_distance_mm, options.border_px) for each in depth_maps]
    nothing = Shown(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    points, normals, trust = (np.concatenate(each) for each in zip(nothing, *parts, strict=True))
    cubes = np.floor(points / (options.thinning * working_distance_mm)).astype(np.int64)
    sides = np.abs(normals).argmax(axis=1, keepdims=True) if len(normals) else np.zeros((0, 1), int)
    facing = sides + 3 * (np.take_along_axis(normals, sides, axis=1) > 0)
    _, cell, members = np.unique(
        np.concatenate([cubes, facing], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    cell, enough = cell.reshape(-1), members >= _LEAST_MEMBERS
    total = np.bincount(cell, trust, len(members))

    def mean(values: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        sums = [np.bincount(cell, trust * values[:, axis], len(members)) for axis in range(3)]
        return (np.stack(sums, axis=1) / total[:, None])[enough]

    return Surface(Shown(mean(points), unit(mean(normals)), (total / members)[enough]))


# --- one frame onto another --------------------------------------------------------------------------------------


def _lay(
    one: Surface | Shown, other: Surface, other_from_one: Rigid3, reach_mm: float, least_mm: float
) -> _Laid | None:
    """None where hardly anything is near."""
    points, normals = other_from_one.apply(one.points), other_from_one.rotate(one.normals)
    near, index = other.nearest(points, reach_mm)
    near &= (normals * other.normals[index]).sum(axis=1) > _ALIKE
    if near.sum() < _LEAST_MATCHES:
        return None
    points, index = points[near], index[near]
    normals = unit(normals[near] + other.normals[index])
    distances = ((points - other.points[index]) * normals).sum(axis=1)
    uncertain = np.sqrt(1 / one.trust[near] + 1 / other.trust[index])
    uncertain /= np.median(uncertain)
    sigma = max(1.4826 * float(np.median(np.abs(distances) / uncertain)), least_mm)
    return _Laid(points, normals, distances, sigma * uncertain, sigma, float(near.mean()))


def _rows(laid: _Laid) -> Float[np.ndarray, "n 6"]:
    """What a small motion (rotation vector, translation) of the points does to their distances."""
    return np.concatenate([np.cross(laid.points, laid.normals), laid.normals], axis=1)


def _equations(laid: _Laid) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6"]]:
    """Normal equations of that motion."""
    rows = _rows(laid)
    weighted = rows * laid.weights[:, None]
    return weighted.T @ rows, weighted.T @ laid.distances


def _moved(motion: Float[np.ndarray, "6"]) -> Rigid3:
    return Rigid3.from_rotation_vector(motion[:3], motion[3:])


def _solved(
    matrix: Float[np.ndarray, "n n"], right: Float[np.ndarray, "n *k"], damping: float = _DAMPING
) -> Float[np.ndarray, "n *k"]:
    """With a damping that only matters where nothing is known."""
    diagonal = np.diag(matrix)
    return np.asarray(np.linalg.solve(matrix + damping * np.diag(np.maximum(diagonal, diagonal.mean())), right))


def _onto(
    one: Surface | Shown,
    other: Surface,
    start: Rigid3,
    distance_mm: float,
    reaches: Sequence[float] = _REACHES,
) -> _Step:
    """Lay a surface onto another one, from a pose nearby."""
    pose, least_mm = start, _LEAST_SIGMA * distance_mm
    for reach in reaches:
        laid = _lay(one, other, pose, reach * distance_mm, least_mm)
        if laid is None:
            return _Step(pose, None)
        pose = _moved(-_solved(*_equations(laid))) @ pose
    # A start that was made of other poses is a rotation only up to rounding, which would double from frame to frame.
    pose = Rigid3.from_rotation_vector(pose.rotation_vector, pose.translation)
    return _Step(pose, _lay(one, other, pose, reaches[-1] * distance_mm, least_mm))


def _doubt(step: _Step, overlap: float, options: SurfaceTrackingOptions, distance_mm: float) -> str | None:
    """Why a frame must not be placed so; None if it may be."""
    laid = step.laid
    if laid is None or laid.share < overlap:
        share = 0.0 if laid is None else laid.share
        return f"only {share:.0%} of its surface lies on that of an earlier frame"
    if laid.sigma > laid.share * options.largest_scatter * distance_mm:
        return f"its surface scatters about that of earlier frames by {1000 * laid.sigma:.0f} um"
    if laid.relief < options.least_relief:
        return "its surface is too flat to be held in place by its shape"
    return None


# --- the whole path ----------------------------------------------------------------------------------------------


def _starts(motion: Rigid3 | None, distance_mm: float) -> Iterator[Rigid3]:
    """Where to look for the next frame: moved on as before, or as far as a hand may move at first."""
    if motion is not None:
        yield motion
        yield Rigid3.identity()
        return
    for along in _FIRST_STEPS:
        for across in _FIRST_STEPS:
            yield Rigid3(np.eye(3), distance_mm * np.array([along, across, 0.0]))


def _followed(
    surfaces: Sequence[Surface],
    placed: Mapping[int, Rigid3],
    frame: int,
    motion: Rigid3 | None,
    options: SurfaceTrackingOptions,
    distance_mm: float,
) -> tuple[Rigid3 | None, str]:
    """``rig_from_world`` of a frame, from the latest few placed before; else why there is none."""
    reason = "no earlier frame shows any surface"
    for number, earlier in enumerate(list(placed)[: -_BRIEFLY - 1 : -1]):
        starts = _starts(motion, distance_mm)
        step = _found(surfaces, earlier, frame, starts, options, distance_mm)
        doubt = _doubt(step, options.minimum_overlap, options, distance_mm)
        if doubt is None:
            return step.this_from_other @ placed[earlier], ""
        reason = doubt if number == 0 else reason
    return None, reason


def _found(
    surfaces: Sequence[Surface],
    earlier: int,
    frame: int,
    starts: Iterable[Rigid3],
    options: SurfaceTrackingOptions,
    distance_mm: float,
) -> _Step:
    """A frame laid onto an earlier one from the best of some starts."""
    one, other = surfaces[earlier], surfaces[frame]
    some = one.some(options.samples, np.random.default_rng([options.seed, frame]))
    tried = max((_onto(some, other, start, distance_mm) for start in starts), key=lambda step: step.rank)
    return _onto(one, other, tried.this_from_other, distance_mm, _REACHES[-_LAST_STEPS:])


def _chained(
    surfaces: Sequence[Surface],
    names: Sequence[str],
    options: SurfaceTrackingOptions,
    distance_mm: float,
    progress: Progress,
) -> tuple[dict[int, Rigid3], list[Dropped]]:
    """``rig_from_world`` of the frames, one after the other.

    A frame that lies neither on the end of the latest piece nor on that of the largest begins a piece of its own, for
    it is not known which of them is wrong. The largest is kept, with those that are found on it in the end.
    """
    pieces, reasons, motion = list[dict[int, Rigid3]](), dict[int, str](), None
    for frame, surface in enumerate(surfaces):
        progress("odometry", frame + 1, len(surfaces))
        if len(surface) < _LEAST_MATCHES:
            reasons[frame] = f"only {len(surface)} points of its surface"
            continue
        largest, pose = sorted(pieces, key=len)[-1:], None
        for piece in pieces[-1:] + [each for each in largest if each is not pieces[-1]]:
            moved_on = motion if frame - 1 in piece else None
            pose, reason = _followed(surfaces, piece, frame, moved_on, options, distance_mm)
            reasons.setdefault(frame, reason)
            if pose is not None:
                break
        if pose is None:
            piece, pose = {}, Rigid3.identity()
            pieces.append(piece)
        motion = pose @ piece[frame - 1].inverse() if frame - 1 in piece else None
        piece[frame] = pose
    placed = _joined(surfaces, sorted(pieces, key=len, reverse=True), options, distance_mm, progress)
    dropped = [
        Dropped(what=f"frame {name}", reason=reasons.get(frame) or "it lies only on frames that lie on no others")
        for frame, name in enumerate(names)
        if frame not in placed
    ]
    world_from_first = placed[min(placed)].inverse() if placed else Rigid3.identity()
    return {frame: placed[frame] @ world_from_first for frame in sorted(placed)}, dropped


def _joined(
    surfaces: Sequence[Surface],
    pieces: Sequence[Mapping[int, Rigid3]],
    options: SurfaceTrackingOptions,
    distance_mm: float,
    progress: Progress,
) -> dict[int, Rigid3]:
    """The first piece, with all others that are found on it or on what was found."""
    placed, left = dict(pieces[0]) if pieces else {}, list(pieces[1:])
    number = 0
    while number < len(left):
        progress("lost pieces", len(pieces) - len(left) + number, len(pieces))
        found = _found_on(surfaces, placed, left[number], options, distance_mm)
        if found:
            placed |= found
            del left[number]
            number = 0  # what was found may show those that were not
        else:
            number += 1
    return placed


def _found_on(
    surfaces: Sequence[Surface],
    placed: Mapping[int, Rigid3],
    piece: Mapping[int, Rigid3],
    options: SurfaceTrackingOptions,
    distance_mm: float,
) -> dict[int, Rigid3]:
    """The frames of a piece among those placed, if one of them is found there and the others bear it out."""
    overlap = max(options.minimum_overlap, _FOUND_AGAIN)
    few = {each: surfaces[each].some(_FEW, np.random.default_rng([options.seed, each])) for each in placed}
    for frame, pose in piece.items():
        for earlier in sorted(placed, key=lambda each: abs(each - frame)):
            tried = _onto(few[earlier], surfaces[frame], Rigid3.identity(), distance_mm)
            if _doubt(tried, options.minimum_overlap, options, distance_mm) is not None:
                continue
            step = _found(surfaces, earlier, frame, [tried.this_from_other], options, distance_mm)
            if _doubt(step, overlap, options, distance_mm) is not None:
                continue
            found = pose.inverse() @ step.this_from_other @ placed[earlier]
            there = {each: its @ found for each, its in piece.items()}
            if _is_borne_out(surfaces, placed, there, overlap, options, distance_mm):
                return there
    return {}


def _is_borne_out(
    surfaces: Sequence[Surface],
    placed: Mapping[int, Rigid3],
    there: Mapping[int, Rigid3],
    overlap: float,
    options: SurfaceTrackingOptions,
    distance_mm: float,
) -> bool:
    """Whether frames that would look at the same place, if they were there, see the same: one that lies on another by
    chance has neighbours that do not."""
    near = [
        pair for pair in product(placed, there) if _is_near(there[pair[1]] @ placed[pair[0]].inverse(), distance_mm)
    ]
    witnesses = near[:: max(len(near) // _WITNESSES, 1)]
    steps = (
        _onto(surfaces[a], surfaces[b], there[b] @ placed[a].inverse(), distance_mm, _REACHES[-_LAST_STEPS:])
        for a, b in witnesses
    )
    agree = [_doubt(step, overlap, options, distance_mm) is None for step in steps]
    return len(agree) >= _LEAST_WITNESSES and sum(agree) >= _AGREED * len(agree)


def _is_near(motion: Rigid3, distance_mm: float) -> bool:
    """Whether the handpiece sees about the same after a motion."""
    across = float(np.linalg.norm(motion.translation)) / distance_mm
    return max(across, float(np.linalg.norm(motion.rotation_vector))) < _NEAR


_Blocks = set[tuple[int, ...]]


def _blocks(surface: Surface, pose: Rigid3, distance_mm: float) -> _Blocks:
    """Those of space that a surface fills."""
    blocks = np.floor(pose.inverse().apply(surface.points) / (_BLOCKS * distance_mm)).astype(int)
    return set(map(tuple, blocks.tolist()))


def _shared(one: _Blocks, other: _Blocks) -> float:
    """The part of the smaller surface that both share."""
    return len(one & other) / max(min(len(one), len(other)), 1)


def _neighbours(
    surfaces: Sequence[Surface], poses: Sequence[Rigid3], options: SurfaceTrackingOptions, distance_mm: float
) -> list[tuple[int, int]]:
    """Pairs of frames that show the same surface, told by the blocks of space that it fills, in both orders.

    Only relative neighbours (G. Toussaint, Pattern Recognition 12, 1980): a pair is left out if both overlap more with
    a third frame. The farther apart two frames are, the less alike are the errors of their surfaces, and what these do
    to a pose adds up along a path; pairs of one pass and another stay where these come closest.
    """
    blocks = [_blocks(surface, pose, distance_mm) for surface, pose in zip(surfaces, poses, strict=True)]
    shared = np.array([[_shared(one, other) for other in blocks] for one in blocks])
    np.fill_diagonal(shared, 0.0)
    through_third = np.array([np.minimum(one, shared).max(axis=1) for one in shared])
    found = (shared > options.joint_overlap) & (shared >= through_third)
    return [(int(one), int(other)) for one, other in np.argwhere(found)]


def _together(
    surfaces: Sequence[Surface],
    poses: Sequence[Rigid3],
    options: SurfaceTrackingOptions,
    distance_mm: float,
    progress: Progress,
) -> tuple[list[Rigid3], float, Expectation | None]:
    """The poses with which all surfaces that overlap lie on each other best, their mean scatter, mm, and what follows
    for the surface."""
    rng, found = np.random.default_rng(options.seed), list(poses)
    some = [surface.some(options.samples, rng) for surface in surfaces]
    pairs = _neighbours(surfaces, poses, options, distance_mm)
    reach_mm, least_mm, laid = _REACHES[-3] * distance_mm, _LEAST_SIGMA * distance_mm, list[_Laid | None]()
    for number in range(options.rounds):
        laid = map_in_threads(partial(_compared, some, surfaces, found, reach_mm, least_mm), pairs)
        step = _joint_step(_in_world(pairs, laid, found), len(found))
        found = [pose @ _moved(motion).inverse() for pose, motion in zip(found, step, strict=True)]
        progress("adjustment", number + 1, options.rounds)
        if np.abs(step[:, 3:]).max() < _CONVERGED * distance_mm:
            break
    progress("adjustment", options.rounds, options.rounds)
    scatter = float(np.mean([each.sigma for each in laid if each is not None] or [0.0]))
    return found, scatter, _expected(some, _in_world(pairs, laid, found), found, distance_mm)


def _compared(
    some: Sequence[Shown],
    surfaces: Sequence[Surface],
    poses: Sequence[Rigid3],
    reach_mm: float,
    least_mm: float,
    pair: tuple[int, int],
) -> _Laid | None:
    """Some points of one frame on the surface of another."""
    one, other = pair
    return _lay(some[one], surfaces[other], poses[other] @ poses[one].inverse(), reach_mm, least_mm)


_Pair = tuple[int, int, _Laid]
"""Two frames, and how the surface of the first lies on that of the second, in the world."""


def _in_world(pairs: Sequence[tuple[int, int]], laid: Sequence[_Laid | None], poses: Sequence[Rigid3]) -> list[_Pair]:
    """The pairs that lie on each other."""
    world_from_rig = [pose.inverse() for pose in poses]
    return [
        (
            *(one, other),
            each._replace(
                points=world_from_rig[other].apply(each.points), normals=world_from_rig[other].rotate(each.normals)
            ),
        )
        for (one, other), each in zip(pairs, laid, strict=True)
        if each is not None
    ]


def _joint_equations(pairs: Sequence[_Pair], count: int) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n"]]:
    """Normal equations of small motions of all frames, in the world; the first frame stays."""
    matrix, right = np.zeros((count, 6, count, 6)), np.zeros((count, 6))
    for one, other, each in pairs:
        block, side = _equations(each)
        matrix[one, :, one] += block
        matrix[other, :, other] += block
        matrix[one, :, other] -= block
        matrix[other, :, one] -= block
        right[one] -= side
        right[other] += side
    free = 6 * (count - 1)
    return matrix[1:, :, 1:].reshape(free, free), right[1:].ravel()


def _joint_step(pairs: Sequence[_Pair], count: int) -> Float[np.ndarray, "f 6"]:
    """Small motions of all frames that bring surfaces together."""
    step = np.zeros((count, 6))
    if pairs:
        step[1:] = _solved(*_joint_equations(pairs, count), _HELD_BY_NOTHING).reshape(-1, 6)
    return step


def _covariance(pairs: Sequence[_Pair], count: int, block_mm: float) -> Float[np.ndarray, "n n"]:
    """Covariance of these motions, from how the gradients of all pairs scatter from block to block of space (Huber, 5th
    Berkeley Symposium, 1967), with the blocks that the motions have used up taken off their number."""
    gradients, blocks, frames = [], [], []
    for one, other, each in pairs:
        gradient = _rows(each) * (each.weights * each.distances)[:, None]
        gradients += [-gradient, gradient]
        blocks += [np.floor(each.points / block_mm).astype(np.int64)] * 2
        frames += [np.full(len(gradient), one), np.full(len(gradient), other)]
    block = np.unique(np.concatenate(blocks), axis=0, return_inverse=True)[1].reshape(-1)
    columns = 6 * np.concatenate(frames)[:, None] + np.arange(6)
    rows = np.broadcast_to(block[:, None], columns.shape)
    shape = block.max() + 1, 6 * count
    by_block = sparse.coo_array((np.concatenate(gradients).ravel(), (rows.ravel(), columns.ravel())), shape).tocsr()
    scatter = (by_block.T @ by_block).toarray()[6:, 6:]
    matrix, _ = _joint_equations(pairs, count)
    slope = sum(each.slopes.sum() for *_, each in pairs) / sum(each.weights.sum() for *_, each in pairs)
    left = max(1 - len(matrix) / shape[0], 1 / shape[0])
    solved = partial(_solved, matrix, damping=_HELD_BY_NOTHING)
    return solved(solved(scatter).T) / (slope**2 * left)


def _expected(
    some: Sequence[Shown], pairs: Sequence[_Pair], poses: Sequence[Rigid3], distance_mm: float
) -> Expectation | None:
    """How far the surface may be off by its poses; None for a single frame, and where none lies on another."""
    if not pairs:
        return None
    each = max(MOST_POINTS // len(poses), 1)
    parts = [pose.inverse().apply(shown.points[:each]) for shown, pose in zip(some, poses, strict=True)]
    points = np.concatenate(parts)
    owner = np.repeat(np.arange(len(poses)), [len(part) for part in parts])
    steps = steps_drawn(_covariance(pairs, len(poses), _CLUSTER * distance_mm)).T.reshape(-1, len(poses) - 1, 6)
    of_points = np.pad(steps, ((0, 0), (1, 0), (0, 0)))[:, owner]
    return expectation_of(points, np.cross(of_points[..., :3], points) + of_points[..., 3:])


def track_surfaces(
    capture: Capture,
    depths: Iterable[DepthMap],
    options: SurfaceTrackingOptions = SurfaceTrackingOptions(),
    *,
    progress: Progress = silent,
) -> Reconstruction:
    """Metric poses of the frames of a capture, from their depth maps, which come frame by frame in the order of
    capture. The calibration is held.

    Raises ReconstructionError where too few frames can be placed.
    """
    distance_mm = capture.handpiece.working_distance_mm
    names, surfaces = [], []
    for name, maps in groupby(depths, key=lambda depth_map: depth_map.frame):
        names.append(name)
        surfaces.append(surface_of(maps, distance_mm, options))
        progress("surfaces", len(names), max(len(capture.frames), len(names)))
    placed, dropped = _chained(surfaces, names, options, distance_mm, progress)
    _require_enough(len(placed), len(names), dropped, capture.handpiece, options)
    kept = [surfaces[frame] for frame in placed]
    poses, scatter_mm, expectation = _together(kept, list(placed.values()), options, distance_mm, progress)
    return Reconstruction(
        rig=capture.handpiece.rig,
        expectation=expectation,
        rig_from_world={names[frame]: pose for frame, pose in zip(placed, poses, strict=True)},
        dropped=(*capture.left_out, *dropped),
        log={"surface_scatter_um": 1000 * scatter_mm},
        notes=(
            _held(capture.handpiece),
            *_drift(poses, distance_mm),
            *glare_notes(capture.handpiece),
            *_lost(names, placed),
        ),
    )


def _held(handpiece: Handpiece) -> str:
    """What the calibration, which surfaces do not refine, does to them."""
    taken = "motion: the frames were located by their surfaces, which do not refine the calibration"
    sigma_mm = depth_sigma_mm(handpiece)
    if sigma_mm < _LEAST_DEPTH * handpiece.working_distance_mm:
        return f"{taken}: it is taken as exact; an error of it is in the result, but not in the sigmas of its vertices"
    return (
        f"{taken}, and with what is known of it depths are off by about {sigma_mm:.2g} mm; this is not in the sigmas "
        "of the vertices, nor in what is expected of the scale: calibrate the handpiece (cuspid calibrate) for less"
    )


def _drift(poses: Sequence[Rigid3], distance_mm: float) -> tuple[str, ...]:
    """Whether the path is so long that small errors from frame to frame matter."""
    centres = np.array([pose.inverse().translation for pose in poses])
    extent_mm = float(np.linalg.norm(np.ptp(centres, axis=0)))
    if extent_mm < _LONG * distance_mm:
        return ()
    return (
        f"motion: over {extent_mm:.0f} mm, small errors from surface to surface add up: in simulation the ends of a "
        "whole arch come out up to 0.05 mm off, or 0.2 with poor optics or without polarisers; do not rely on "
        "distances across it",
    )


def glare_notes(handpiece: Handpiece) -> tuple[str, ...]:
    """Whether mirror reflections may deceive the cameras."""
    if handpiece.lights and all(light.glare <= _LITTLE_GLARE for light in handpiece.lights.values()):
        return ()
    return (
        "depth: as far as the handpiece file tells (glare of each light), there are no crossed polarisers: in "
        "simulation, mirror reflections of wet teeth hide from a sixth (six coloured lights in turn) to half of the "
        "surface (white lights, and 0.03 mm of error); use polarisers or powder",
    )


def _lost(names: Sequence[str], placed: Mapping[int, Rigid3]) -> tuple[str, ...]:
    """Where tracking was lost."""
    gaps = [frame for frame in range(len(names)) if frame not in placed]
    if not gaps:
        return ()
    shown = ", ".join(names[frame] for frame in islice(gaps, 5))
    more = ", ..." if len(gaps) > 5 else ""
    return (f"motion: tracking was lost at {len(gaps)} of {len(names)} frames ({shown}{more}); scan there again",)


def _require_enough(
    placed: int, total: int, dropped: Sequence[Dropped], handpiece: Handpiece, options: SurfaceTrackingOptions
) -> None:
    """Raise ReconstructionError where too few frames are placed."""
    if placed >= options.minimum_located * total and (placed > 1 or total == 1):
        return
    shown = "; ".join(f"{each.what}: {each.reason}" for each in dropped[:3])
    polarisers = "cross polarisers (the handpiece file tells of none), " if glare_notes(handpiece) else ""
    raise ReconstructionError(
        f"motion: only {placed} of {total} frames could be placed by their surfaces ({shown}); {polarisers}take frames "
        "closer together, see that the lights are on and nothing else shines, or give the surface texture (powder)"
    )
