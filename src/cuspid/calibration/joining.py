"""Initial places of cameras and boards where there are several boards: who saw one board together, where two boards
were seen together, and what moved alike.

Cameras that see the same board at the same instant are beside each other in a known way, and so are boards that one
camera sees at the same instant. Both grow into groups, in turn, for a group of cameras sees what any of its cameras
sees. Two groups that never share a board, but see one each while the rig moves, are joined by that motion: with A_i
the pose of one board in one camera, D_i that of another board in another camera, X from the second camera to the first
and Y from the second board to the first, A_i Y = X D_i (M. Shah, Journal of Mechanisms and Robotics 5, 2013; as a way
to calibrate cameras F. Rameau et al., MC-Calib, CVIU 217, 2022). That takes turns about two axes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from cuspid.calibration.agreement import consensus_motion, disagreement_between
from cuspid.calibration.bundle import BoardScene
from cuspid.calibration.corners import BoardView, Views, split_by_board
from cuspid.calibration.start import board_pose
from cuspid.geometry import Rigid3
from cuspid.model.board import BoardSet
from cuspid.model.camera import Camera
from cuspid.runtime.errors import InputError, ReconstructionError

_LEAST_INSTANTS, _LEAST_TURN_DEG = 4, 6.0
"""Instants, and turns about the second of two axes (RMS), that join cameras by motion."""

Group = Mapping[str, Rigid3]
"""Cameras, and where the first of them is from each: ``group_from_cam``."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """One board in one image."""

    camera: str
    instant: str
    board: int
    cam_from_board: Rigid3
    corners: int


@dataclass(frozen=True, eq=False)
class _Groups:
    """Cameras and boards, each in the frame of its group."""

    camera: Mapping[str, tuple[int, Rigid3]]
    """By camera, its group and ``group_from_cam``."""
    board: Mapping[int, tuple[int, Rigid3]]
    """By board, its group and ``group_from_board``."""
    notes: tuple[str, ...] = ()

    def poses(self, seen: Sequence[_Seen]) -> dict[tuple[int, int], dict[str, Rigid3]]:
        """By groups of cameras and boards, ``cameras_from_boards`` at each instant, by the view of most corners."""
        found: dict[tuple[int, int], dict[str, Rigid3]] = {}
        for each in sorted(seen, key=lambda view: view.corners):
            (cameras, place), (boards, mount) = self.camera[each.camera], self.board[each.board]
            found.setdefault((cameras, boards), {})[each.instant] = place @ each.cam_from_board @ mount.inverse()
        return found

    def cameras_of(self, group: int) -> list[str]:
        """Names of the cameras of a group."""
        return [name for name, (own, _) in self.camera.items() if own == group]

    def boards_of(self, group: int) -> list[int]:
        """Numbers of the boards of a group, from 0."""
        return [number for number, (own, _) in self.board.items() if own == group]

    def merge_cameras(self, first: int, second: int, first_from_second: Rigid3) -> _Groups:
        """With two groups of cameras as one."""
        moved = {
            name: (first, first_from_second @ place) if group == second else (group, place)
            for name, (group, place) in self.camera.items()
        }
        return replace(self, camera=moved)

    def merge_boards(self, first: int, second: int, first_from_second: Rigid3) -> _Groups:
        """With two groups of boards as one."""
        moved = {
            number: (first, first_from_second @ place) if group == second else (group, place)
            for number, (group, place) in self.board.items()
        }
        return replace(self, board=moved)


def join_boards(
    views: Views, target: BoardSet, cameras: Mapping[str, Camera]
) -> tuple[BoardScene, dict[tuple[str, str], BoardView], tuple[str, ...]]:
    """The cameras in the frame of the first one, the boards on their body, and that body at each instant; the views of
    which something could be made; and which cameras were joined by motion.

    Raises ReconstructionError where cameras cannot be joined, or boards or cameras moved against each other.
    """
    seen = list(_estimate_board_poses(views, target, cameras))
    boards = sorted({each.board for each in seen})
    groups = _Groups(
        camera={name: (k, Rigid3.identity()) for k, name in enumerate(cameras)},
        board={number: (number, Rigid3.identity()) for number in boards},
    )
    while (more := _join_two_groups(groups, seen)) is not None:
        groups = more
    _require_one_group(groups)
    rig_from_cameras = groups.camera[next(iter(cameras))][1].inverse()
    best = {each.instant: each for each in sorted(seen, key=lambda view: view.corners)}
    scene = BoardScene(
        cameras=cameras,
        cam_from_rig={name: (rig_from_cameras @ groups.camera[name][1]).inverse() for name in cameras},
        rig_from_board={
            instant: rig_from_cameras
            @ groups.camera[best[instant].camera][1]
            @ best[instant].cam_from_board
            @ groups.board[best[instant].board][1].inverse()
            for instant in sorted(best)
        },
        bending_mm=np.zeros(3 * len(target.boards)),
        body_from_board={
            number: place for number, (group, place) in groups.board.items() if number != groups.boards_of(group)[0]
        },
    )
    kept = {(each.camera, each.instant) for each in seen}
    return scene, {key: view for key, view in views.items() if key in kept}, groups.notes


def _estimate_board_poses(views: Views, target: BoardSet, cameras: Mapping[str, Camera]) -> Collection[_Seen]:
    found = []
    for (camera, instant), view in views.items():
        for part in split_by_board(view, target):
            try:
                pose = board_pose(part, target, cameras[camera])
            except InputError:  # the lens shows nothing there, or no pose explains it
                continue
            number = int(target.board_of(part.corner[:1])[0])
            found.append(_Seen(camera, instant, number, pose, len(part.corner)))
    return found


def _join_two_groups(groups: _Groups, seen: Sequence[_Seen]) -> _Groups | None:
    """With two groups joined: those that share most instants, or else by their motion; None where there are none."""
    poses = groups.poses(seen)
    shared: list[tuple[int, str, int, int]] = []
    for kind, side in (("cameras", 0), ("boards", 1)):
        for one, other in combinations(sorted({key[side] for key in poses}), 2):
            count = len(_estimate_hand_eye(poses, one, other, side))
            if count:
                shared.append((count, kind, one, other))
    if not shared:
        return _join_by_motion(groups, poses)
    _, kind, one, other = max(shared, key=lambda each: each[0])
    side = 0 if kind == "cameras" else 1
    candidates = _estimate_hand_eye(poses, one, other, side)
    away = [pose.translation for each in poses.values() for pose in each.values()]
    distance_mm = float(np.median(np.linalg.norm(away, axis=1)))
    best, agreeing, _ = consensus_motion([[each] for each in candidates], distance_mm)
    if 2 * agreeing < len(candidates):
        if kind == "boards":
            raise ReconstructionError(_disagreement(groups, one, other, agreeing, len(candidates)))
        named = ", ".join(groups.cameras_of(other)), ", ".join(groups.cameras_of(one))
        own = _poses_to_compare(poses, other, one)
        raise ReconstructionError(disagreement_between(named, own, agreeing, len(candidates), distance_mm))
    return groups.merge_cameras(one, other, best) if side == 0 else groups.merge_boards(one, other, best)


def _estimate_hand_eye(
    poses: Mapping[tuple[int, int], Mapping[str, Rigid3]], one: int, other: int, side: int
) -> list[Rigid3]:
    """``one_from_other`` of two groups of cameras (``side`` 0) or of boards (1), as each instant says at which both
    saw, or were seen by, the same group."""
    candidates = []
    for key, first in poses.items():
        second = poses.get((other, key[1]) if side == 0 else (key[0], other), {})
        if key[side] == one:
            both = sorted(set(first) & set(second))
            candidates += [
                first[i] @ second[i].inverse() if side == 0 else first[i].inverse() @ second[i] for i in both
            ]
    return candidates


def _poses_to_compare(
    poses: Mapping[tuple[int, int], Mapping[str, Rigid3]], one: int, other: int
) -> tuple[dict[str, list[Rigid3]], dict[str, list[Rigid3]]]:
    """The poses, by instant, of the boards that both of two groups of cameras saw most often."""
    boards = [board for group, board in poses if group == one and (other, board) in poses]
    most = max(boards, key=lambda board: min(len(poses[one, board]), len(poses[other, board])))
    first, second = ({instant: [pose] for instant, pose in poses[each, most].items()} for each in (one, other))
    return first, second


def _disagreement(groups: _Groups, one: int, other: int, agreeing: int, count: int) -> str:
    first, second = (_numbers(groups.boards_of(each)) for each in (one, other))
    return (
        f"calibration: only {agreeing} of {count} instants agree on where {second} is relative to {first}; the boards "
        "must be fixed to one another, and no two prints of the same ids may be seen"
    )


def _numbers(boards: Sequence[int]) -> str:
    return f"board {', '.join(str(number + 1) for number in boards)}"


# --- by motion ---------------------------------------------------------------------------------------------------


def _join_by_motion(groups: _Groups, poses: Mapping[tuple[int, int], Mapping[str, Rigid3]]) -> _Groups | None:
    """Two groups of cameras, and the boards that they saw, joined by how both moved; None where no two moved together.

    Raises ReconstructionError where they turned too little.
    """
    pairs = [
        (sorted(set(poses[one]) & set(poses[other])), one, other)
        for one, other in combinations(sorted(poses), 2)
        if one[0] != other[0] and one[1] != other[1]
    ]
    pairs = [each for each in pairs if len(each[0]) >= _LEAST_INSTANTS]
    if not pairs:
        return None
    instants, one, other = max(pairs, key=lambda each: second_turn_deg([poses[each[1]][i] for i in each[0]]))
    first, second = ([poses[each][i] for i in instants] for each in (one, other))
    turn_deg = second_turn_deg(first)
    names = [", ".join(groups.cameras_of(each[0])) for each in (one, other)]
    if turn_deg < _LEAST_TURN_DEG:
        raise ReconstructionError(
            f"calibration: {names[0]} and {names[1]} never saw a board together, and in the {len(instants)} instants "
            f"at which both saw one the rig turned by only {turn_deg:.1f} degrees about a second axis; turn it, or "
            "the boards, by 20 degrees or more about two axes"
        )
    cameras, boards = hand_eye(first, second)
    note = (
        f"{names[0]} and {names[1]} never saw a board together: joined by how both moved against the boards in "
        f"{len(instants)} instants ({turn_deg:.0f} degrees about the second axis, RMS); the boards must not have moved "
        "against each other"
    )
    grown = groups.merge_cameras(one[0], other[0], cameras).merge_boards(one[1], other[1], boards)
    return replace(grown, notes=(*groups.notes, note))


def second_turn_deg(poses: Sequence[Rigid3]) -> float:
    """RMS rotation of poses about the second of their principal axes of rotation."""
    vectors = np.stack([(pose @ poses[0].inverse()).rotation_vector for pose in poses])
    values = np.linalg.svd(vectors - vectors.mean(axis=0), compute_uv=False)
    return float(np.rad2deg(values[1] / np.sqrt(len(poses))))


def hand_eye(first: Sequence[Rigid3], second: Sequence[Rigid3]) -> tuple[Rigid3, Rigid3]:
    """X and Y of A_i Y = X D_i, by least squares: rotations first, then translations; once more without the instants
    that do not fit."""
    used = np.ones(len(first), dtype=bool)
    for _ in range(2):
        some = [(a, d) for a, d, use in zip(first, second, used, strict=True) if use]
        x, y = _hand_eye(*zip(*some, strict=True))
        off = np.array(
            [np.linalg.norm((a @ y).translation - (x @ d).translation) for a, d in zip(first, second, strict=True)]
        )
        used = off <= 4 * np.median(off) + 1e-9
    return x, y


def _hand_eye(first: Sequence[Rigid3], second: Sequence[Rigid3]) -> tuple[Rigid3, Rigid3]:
    size = len(first)
    # vec(R_A Y) = (I x R_A) vec(Y) is to be (R_D^T x I) vec(X): the singular vectors of the sum of R_D x R_A.
    total = np.sum([np.kron(d.rotation, a.rotation) for a, d in zip(first, second, strict=True)], axis=0)
    left, _, right = np.linalg.svd(total / size)
    turn_x = _nearest_rotation(left[:, 0].reshape(3, 3, order="F"))
    turn_y = _nearest_rotation(right[0].reshape(3, 3, order="F"))
    rows = np.concatenate([np.hstack([a.rotation, -np.eye(3)]) for a in first])
    values = np.concatenate([turn_x @ d.translation - a.translation for a, d in zip(first, second, strict=True)])
    shift = np.linalg.lstsq(rows, values, rcond=None)[0]
    return Rigid3(turn_x, shift[3:]), Rigid3(turn_y, shift[:3])


def _nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Of a matrix that is one but for a factor, which may be negative."""
    u, _, vt = np.linalg.svd(matrix * np.sign(np.linalg.det(matrix)))
    return np.asarray(u @ vt)


def _require_one_group(groups: _Groups) -> None:
    """Raise ReconstructionError where not all cameras could be joined."""
    apart = {group: groups.cameras_of(group) for group, _ in groups.camera.values()}
    if len(apart) > 1:
        raise ReconstructionError(
            f"calibration: {' and '.join(map(', '.join, apart.values()))} never saw a board at the same time, nor two "
            f"boards at {_LEAST_INSTANTS} instants or more; show the boards to cameras of all groups together"
        )
