"""Cameras that do not expose together: the instants between which the board is followed.

Its path is the parabola through its poses at three neighbouring instants (:mod:`cuspid.calibration.bundle`). Which ones
these are follows from the times of the views; both are improved in turn.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

from cuspid.board import Target
from cuspid.calibration.bundle import Adjusted, BoardScene, Timing, adjust_board
from cuspid.calibration.corners import Views
from cuspid.geometry import Rigid3

_REACH = 2
"""How many frames away a neighbour may be."""
_STAY = 0.3
"""Share of a frame by which another instant must be nearer to a view to take the place of the one that was."""
_ROUNDS = 10
"""Maximum number of times that instants are chosen anew."""


def numbered(instants: Iterable[str]) -> dict[str, int] | None:
    """The number of the frame of each instant, from its name; None unless all have different ones."""
    names = list(instants)
    if not all(name.isascii() and name.isdigit() for name in names):
        return None
    frame = {name: int(name) for name in names}
    return frame if len(set(frame.values())) == len(frame) else None


def follow_each_other(frame: Mapping[str, int]) -> bool:
    """Whether most instants have one within reach, so that the path of the board can be followed."""
    numbers = sorted(frame.values())
    near = sum(after - before <= _REACH for before, after in pairwise(numbers))
    return 2 * near >= len(numbers)


def untied(scene: BoardScene, frame: Mapping[str, int], views: Views) -> BoardScene:
    """A scene whose cameras need not have exposed together; as yet, without delays."""
    timing = Timing(frame=frame, near={}, by_camera=dict.fromkeys(scene.cameras, 0.0), by_view={})
    return _followed(scene, timing, scene.rig_from_board, views)


def adjust_scene(
    start: BoardScene, views: Views, board: Target, *, only_boards: bool = False, keep_scales: bool = False
) -> Adjusted:
    """As ``adjust_board``, also where cameras need not have exposed together."""
    if start.timing is None:
        return adjust_board(start, views, board, only_boards=only_boards, keep_scales=keep_scales)
    scene, tried = _followed(start, start.timing, start.rig_from_board, views), []
    for _ in range(_ROUNDS):
        found = adjust_board(scene, views, board, only_boards=only_boards, keep_scales=keep_scales)
        timing = found.scene.timing or start.timing
        tried.append(timing.near)
        scene = _followed(found.scene, timing, {**start.rig_from_board, **found.scene.rig_from_board}, views)
        if scene.timing is None or scene.timing.near in tried:
            return found
    return replace(found, settled=False)


def _followed(scene: BoardScene, timing: Timing, poses: Mapping[str, Rigid3], views: Views) -> BoardScene:
    """The board at the instants nearest to the views, which suffice for its path, and a delay of each view."""
    by_view = {key: timing.by_view.get(key, 0.0) for key in views}
    timing = replace(timing, by_view=by_view)
    frame = timing.frame
    nearest = {key: _nearest(timing, key, poses) for key in views}
    order = sorted(set(nearest.values()), key=lambda instant: frame[instant])
    place = {instant: k for k, instant in enumerate(order)}
    near = {key: _within_reach(order, place[instant], frame) for key, instant in nearest.items()}
    board = {instant: poses[instant] for instant in order}
    return replace(scene, rig_from_board=board, timing=replace(timing, near=near))


def _nearest(timing: Timing, view: tuple[str, str], instants: Iterable[str]) -> str:
    """The instant nearest to the time of a view; the one that was, unless another is nearer by far."""
    time, was = timing.time(*view), timing.near.get(view, ("",))[0]
    return min(instants, key=lambda instant: abs(timing.frame[instant] - time) - _STAY * (instant == was))


def _within_reach(order: Sequence[str], k: int, frame: Mapping[str, int]) -> tuple[str, ...]:
    """An instant, then those before and after it unless they are too far."""
    beside = [*order[max(k - 1, 0) : k], *order[k + 1 : k + 2]]
    return order[k], *(each for each in beside if abs(frame[each] - frame[order[k]]) <= _REACH)
