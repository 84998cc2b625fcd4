"""Cameras that do not expose together, or not all of their rows: the instants between which the board is followed.

Its path is the parabola through its poses at three neighbouring instants (:mod:`cuspid.calibration.bundle`); where
readouts are sought, for which its velocity matters, the polynomial through five. Which ones these are follows from the
times of the views; both are improved in turn.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

from cuspid.calibration.bundle import Adjusted, BoardScene, Timing, adjust_board
from cuspid.calibration.corners import Views
from cuspid.geometry import Rigid3
from cuspid.model.board import Target

_REACH = 2
"""How many frames away a neighbour may be."""
_STAY = 0.3
"""Share of a frame by which another instant must be nearer to a view to take the place of the one that was."""
_ROUNDS = 10
"""Maximum number of times that instants are chosen anew."""


def are_consecutive(frame: Mapping[str, int]) -> bool:
    """Whether most instants have one within reach, so that the path of the board can be followed."""
    numbers = sorted(frame.values())
    near = sum(after - before <= _REACH for before, after in pairwise(numbers))
    return 2 * near >= len(numbers)


def allow_delays(scene: BoardScene, frame: Mapping[str, int], views: Views) -> BoardScene:
    """A scene whose cameras need not have exposed together; as yet, without delays."""
    timing = Timing(frame=frame, near={}, by_camera=dict.fromkeys(scene.cameras, 0.0), by_view={})
    return _choose_instants(scene, timing, scene.rig_from_board, views)


def allow_rolling(scene: BoardScene, frame: Mapping[str, int], views: Views) -> BoardScene:
    """A scene whose cameras may expose their rows one after the other; as yet, all at once."""
    together = Timing(frame=frame, near={}, by_camera=dict.fromkeys(scene.cameras, 0.0), by_view={}, together=True)
    timing = replace(scene.timing or together, readout=dict.fromkeys(scene.cameras, 0.0))
    return _choose_instants(scene, timing, scene.rig_from_board, views)


def adjust_scene(
    start: BoardScene, views: Views, board: Target, *, only_boards: bool = False, keep_scales: bool = False
) -> Adjusted:
    """As ``adjust_board``, also where cameras need not have exposed together."""
    if start.timing is None:
        return adjust_board(start, views, board, only_boards=only_boards, keep_scales=keep_scales)
    scene, tried = _choose_instants(start, start.timing, start.rig_from_board, views), []
    for _ in range(_ROUNDS):
        found = adjust_board(scene, views, board, only_boards=only_boards, keep_scales=keep_scales)
        timing = found.scene.timing or start.timing
        tried.append(timing.near)
        scene = _choose_instants(found.scene, timing, {**start.rig_from_board, **found.scene.rig_from_board}, views)
        if scene.timing is None or scene.timing.near in tried:
            return found
    return replace(found, settled=False)


def _choose_instants(scene: BoardScene, timing: Timing, poses: Mapping[str, Rigid3], views: Views) -> BoardScene:
    """The board at the instants nearest to the views, which suffice for its path, and a delay of each view."""
    by_view = {key: timing.by_view.get(key, 0.0) for key in views}
    timing = replace(timing, by_view=by_view)
    frame = timing.frame
    nearest = {key: _nearest(timing, key, poses) for key in views}
    order = sorted(set(nearest.values()), key=lambda instant: frame[instant])
    place = {instant: k for k, instant in enumerate(order)}
    beside = 2 if timing.readout else 1
    near = {key: _within_reach(order, place[instant], frame, beside) for key, instant in nearest.items()}
    board = {instant: poses[instant] for instant in order}
    return replace(scene, rig_from_board=board, timing=replace(timing, near=near))


def _nearest(timing: Timing, view: tuple[str, str], instants: Iterable[str]) -> str:
    """The instant nearest to the time of a view; the one that was, unless another is nearer by far."""
    time, was = timing.time(*view), timing.near.get(view, ("",))[0]
    return min(instants, key=lambda instant: abs(timing.frame[instant] - time) - _STAY * (instant == was))


def _within_reach(order: Sequence[str], k: int, frame: Mapping[str, int], beside: int) -> tuple[str, ...]:
    """An instant, then so many before and after it, up to where one is too far from the next."""
    before, after = order[max(k - beside, 0) : k][::-1], order[k + 1 : k + 1 + beside]
    return order[k], *_contiguous(order[k], before, frame), *_contiguous(order[k], after, frame)


def _contiguous(first: str, others: Iterable[str], frame: Mapping[str, int]) -> Iterator[str]:
    """Those of instants in order that follow each other, from a first one."""
    for each in others:
        if abs(frame[each] - frame[first]) > _REACH:
            return
        yield (first := each)
