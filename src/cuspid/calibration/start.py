"""Initial values for the adjustment: each camera by itself, then the cameras joined by what they saw at once.

A plain chessboard looks the same from two sides, or four. Each camera numbers its corners arbitrarily; the numbering is
then chosen for which the relative poses of any two cameras agree from instant to instant.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float

from cuspid.calibration.agreement import consensus_motion, disagreement_between, motion_difference
from cuspid.calibration.bundle import Adjusted, BoardScene, adjust_board, select_instants, views_in_front
from cuspid.calibration.corners import LEAST_CORNERS, BoardView, Views, pieces
from cuspid.geometry import Rigid3, best_similarity
from cuspid.geometry.graph import parts_of
from cuspid.model.board import Target
from cuspid.model.camera import OPENCV_PIXEL_OFFSET, Camera
from cuspid.runtime.errors import InputError, ReconstructionError

LEAST_VIEWS = 3
"""A camera that saw the board at fewer instants cannot be calibrated."""
_MOST_VIEWS = 40
"""Maximum number of views for the initial calibration of a camera: more take long, and the adjustment uses all of
them."""
_MUCH_BETTER = 0.8
"""Residuals with another numbering of the corners, as a share of those with the first one, below which it is right."""
_NO_FIT_SHARE = 0.01
"""Residuals of a single camera, as a share of its image width, beyond which no camera model fits."""


def calibrate_single_camera(
    views: Sequence[BoardView], board: Target, size: tuple[int, int], starts: Sequence[Camera] = ()
) -> Adjusted:
    """One camera from its own views; the poses of the board relative to other cameras play no part.

    The search begins from each of some cameras (whose model the result has, the best of them), or from OpenCV's. Raises
    ReconstructionError where the views fit no camera, or do not determine its focal length.
    """
    found = [each for each in (_calibrate_from(start, views, board, size) for start in starts or (None,)) if each]
    if not found:
        raise ReconstructionError("no camera model fits its views of the board")
    best = min(found, key=lambda each: each.sigma_px)
    if best.sigma_px > _NO_FIT_SHARE * size[0]:
        raise ReconstructionError(f"no camera model fits its views of the board (error {best.sigma_px:.0f} px)")
    return best


def _calibrate_from(
    camera: Camera | None, views: Sequence[BoardView], board: Target, size: tuple[int, int]
) -> Adjusted | None:
    """None where the views do not fit."""
    try:
        camera = camera or first_camera(views, board, size)
        poses = [board_pose(view, board, camera) for view in views]
        named = {str(k): pose for k, pose in enumerate(poses)}
        start = BoardScene(
            cameras={"": camera},
            cam_from_rig={"": Rigid3.identity()},
            rig_from_board=named,
            bending_mm=np.zeros(3 * len(board.boards)),
        )
        sound = views_in_front(start, {("", str(k)): view for k, view in enumerate(views)}, board)
        if len(sound) < LEAST_VIEWS:
            return None
        return adjust_board(select_instants(start, {instant for _, instant in sound}), sound, board)
    except (cv2.error, InputError):  # such as a focal length that is no number
        return None


def first_camera(views: Sequence[BoardView], board: Target, size: tuple[int, int]) -> Camera:
    """A camera from its views of the board, with each terrace as a separate plane (Z. Zhang, IEEE PAMI 22, 2000), with
    only the first term of distortion."""
    planes = [piece for view in views for piece in pieces(view, board)]
    spread = np.unique(np.linspace(0, len(planes) - 1, _MOST_VIEWS).astype(int))
    chosen = [planes[k] for k in spread]
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_ASPECT_RATIO
    _, matrix, distortion, _, _ = cv2.calibrateCamera(
        [(board.corners[view.corner] * [1, 1, 0]).astype(np.float32) for view in chosen],
        [(view.pixels - OPENCV_PIXEL_OFFSET).astype(np.float32)[:, None] for view in chosen],
        size,
        np.diag([float(max(size)), float(max(size)), 1.0]),
        np.zeros(5),
        flags=flags,
    )
    return Camera(
        width=size[0],
        height=size[1],
        focal_px=np.diag(matrix)[:2],
        principal_point_px=matrix[:2, 2] + OPENCV_PIXEL_OFFSET,
        distortion=distortion.ravel()[:4],
    )


def board_pose(view: BoardView, board: Target, camera: Camera) -> Rigid3:
    """``cam_from_board`` of one view (T. Collins, A. Bartoli, IJCV 109, 2014; with terraces, and where that
    finds none, G. Terzakis, M. Lourakis, ECCV 2020).

    Raises InputError where there is none.
    """
    rays = camera.rays(view.pixels)
    shown = np.isfinite(rays).all(axis=1)
    if shown.sum() < LEAST_CORNERS:
        raise InputError("calibration: a view of the board lies where the lens shows nothing")
    points, ideal = board.corners[view.corner[shown]], np.ascontiguousarray(rays[shown, None, :2])
    for method in [cv2.SOLVEPNP_IPPE] * (board.terraces == 1) + [cv2.SOLVEPNP_SQPNP]:
        _, turns, shifts, _ = cv2.solvePnPGeneric(points, ideal, np.eye(3), None, flags=method)
        if turns:
            turn, shift = cv2.solvePnPRefineLM(points, ideal, np.eye(3), None, turns[0], shifts[0])
            return Rigid3.from_rotation_vector(turn.ravel(), shift.ravel())
    raise InputError("calibration: no pose explains a view of the board")


def join_cameras(
    views: Views, board: Target, cameras: Mapping[str, Camera], instants: Sequence[str]
) -> tuple[BoardScene, dict[tuple[str, str], BoardView]]:
    """The cameras in the frame of the first one, the board at each instant, and the views with a common numbering.

    Raises ReconstructionError where two groups of cameras never saw the board at the same instant, or the instants do
    not agree on where the cameras are.
    """
    numbered = {key: [view.renumbered(order) for order in board.orders] for key, view in views.items()}
    poses = {key: [board_pose(each, board, cameras[key[0]]) for each in numbered[key]] for key in views}
    cam_from_rig = _chain_pairs(poses, list(cameras))
    rig_from_board, chosen = {}, {}
    for instant in instants:
        seeing = [name for name in cameras if (name, instant) in views]
        first = seeing[0]
        rig_from_board[instant] = cam_from_rig[first].inverse() @ poses[first, instant][0]
        for name in seeing:
            expected = cam_from_rig[name] @ rig_from_board[instant]
            best = min(range(len(board.orders)), key=lambda k: motion_difference(poses[name, instant][k], expected)[0])
            chosen[name, instant] = numbered[name, instant][best]
    scene = BoardScene(
        cameras=cameras,
        cam_from_rig=cam_from_rig,
        rig_from_board=rig_from_board,
        bending_mm=np.zeros(3 * len(board.boards)),
    )
    return scene, {key: chosen[key] for key in views}


def renumber_instant(found: Adjusted, views: Views, board: Target) -> tuple[BoardScene, Views] | None:
    """The views with the corners at some instant numbered otherwise, where a board that is not quite even fits much
    better so, and the scene with the board turned likewise; None if there is no such instant."""
    # Where the board was at other moments tells nothing about the numbering at this one.
    scene = replace(found.scene, timing=None)
    shown = {key: view for key, view in views.items() if key[1] in scene.rig_from_board}
    usual = _rms_by_instant(found.residuals, shown)
    best: tuple[float, str, Rigid3, dict[tuple[str, str], BoardView]] | None = None
    for order in board.orders[1:]:
        _, turn, shift = best_similarity(board.corners, board.corners[order])
        back = Rigid3(turn, shift).inverse()
        start = replace(scene, rig_from_board={instant: pose @ back for instant, pose in scene.rig_from_board.items()})
        turned = {key: view.renumbered(order) for key, view in shown.items()}
        try:
            other = adjust_board(start, turned, board, only_boards=True)
        except ReconstructionError:
            continue
        for instant, rms in _rms_by_instant(other.residuals, shown).items():
            if rms < (best[0] if best else _MUCH_BETTER) * usual[instant]:
                own = {key: view for key, view in turned.items() if key[1] == instant}
                best = rms / usual[instant], instant, other.scene.rig_from_board[instant], own
    if best is None:
        return None
    _, instant, pose, own = best
    return replace(found.scene, rig_from_board={**found.scene.rig_from_board, instant: pose}), {**views, **own}


def _rms_by_instant(residuals: Mapping[tuple[str, str], Float[np.ndarray, "n 2"]], views: Views) -> dict[str, float]:
    """RMS of the residuals of some views, by instant."""
    instants = dict.fromkeys(instant for _, instant in views)
    return {instant: _rms_of([residuals[key] for key in views if key[1] == instant]) for instant in instants}


def _rms_of(residuals: Sequence[Float[np.ndarray, "n 2"]]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(residuals) ** 2)))


Poses = Mapping[tuple[str, str], Sequence[Rigid3]]
"""``cam_from_board`` under each numbering of the corners, by camera and instant."""


def groups(views: Collection[tuple[str, str]], cameras: Sequence[str]) -> list[list[str]]:
    """Groups of cameras, given who saw the board when: those of one group are connected by instants that they share."""
    instants = sorted({instant for _, instant in views})
    pairs = [(cameras.index(camera), len(cameras) + instants.index(instant)) for camera, instant in views]
    part = parts_of(np.array(pairs, dtype=np.int64).reshape(-1, 2), len(cameras) + len(instants))[: len(cameras)]
    return [[name for name, its in zip(cameras, part, strict=True) if its == each] for each in dict.fromkeys(part)]


def require_one_group(views: Collection[tuple[str, str]], cameras: Sequence[str]) -> None:
    """Raise ReconstructionError where two groups of cameras never saw the board at the same instant."""
    apart = groups(views, cameras)
    if len(apart) > 1:
        raise ReconstructionError(
            f"calibration: {' and '.join(', '.join(group) for group in apart)} never saw the board at the same time; "
            "show it to cameras of both groups together"
        )


def _chain_pairs(poses: Poses, cameras: Sequence[str]) -> dict[str, Rigid3]:
    """Each camera beside the first, along the pairs that saw the board together most often (a spanning tree)."""
    require_one_group(poses, cameras)
    seen = {name: {instant for camera, instant in poses if camera == name} for name in cameras}
    common = sorted(combinations(cameras, 2), key=lambda pair: -len(seen[pair[0]] & seen[pair[1]]))
    placed = {cameras[0]: Rigid3.identity()}
    while len(placed) < len(cameras):
        pair = next(each for each in common if len({*each} & set(placed)) == 1 and seen[each[0]] & seen[each[1]])
        known, new = pair if pair[0] in placed else pair[::-1]
        placed[new] = _average_relative_pose(poses, known, new, sorted(seen[known] & seen[new])) @ placed[known]
    return {name: placed[name] for name in cameras}


def _average_relative_pose(poses: Poses, known: str, new: str, instants: Sequence[str]) -> Rigid3:
    """``new_from_known``: of what each instant and numbering says, what the most instants agree with.

    Raises ReconstructionError where less than half of them do.
    """
    candidates = [[pose @ poses[known, instant][0].inverse() for pose in poses[new, instant]] for instant in instants]
    distance_mm = float(np.median([np.linalg.norm(poses[new, instant][0].translation) for instant in instants]))
    best, agreeing, _ = consensus_motion(candidates, distance_mm)
    if 2 * agreeing < len(instants):
        own = _poses_of(poses, new), _poses_of(poses, known)
        raise ReconstructionError(disagreement_between((new, known), own, agreeing, len(instants), distance_mm))
    return best


def _poses_of(poses: Poses, name: str) -> dict[str, Sequence[Rigid3]]:
    """By instant, of one camera."""
    return {instant: each for (camera, instant), each in poses.items() if camera == name}
