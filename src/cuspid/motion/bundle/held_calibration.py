"""How the uncertainty of a fixed calibration propagates to depth.

Of a place p that cameras c see at u_c = f(p, x_c), an error dx_c of what is known of them moves it by
A^-1 sum J_c^T K_c dx_c, with the Jacobians J_c = df/dp and K_c = df/dx_c, and A = sum J_c^T J_c: least squares, to
first order.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from cuspid.geometry import Rigid3
from cuspid.model.pairing import PairingOptions, stereo_pairs
from cuspid.model.rig import Handpiece, MountedCamera
from cuspid.motion.bundle.expectation import covariance_factor

_MOTION = 6
_STEP = 1e-6
"""Of finite differences."""


def depth_sigma_mm(handpiece: Handpiece) -> float:
    """Standard deviation of the depth that each camera and its partners find at the working distance (RMS of all
    cameras), by the covariances of their lenses and places; 0 where none are stated or no two see the same."""
    rig, distance_mm = handpiece.rig, handpiece.working_distance_mm
    pairs = stereo_pairs(rig, distance_mm, PairingOptions())
    variances = []
    for name, mounted in rig.cameras.items():
        partners = {each for pair in pairs if name in pair for each in pair}
        if partners:
            place = mounted.centre_in_rig + distance_mm * mounted.axis_in_rig
            factor = _place_factor(place, [rig.cameras[each] for each in sorted(partners)])
            variances.append(float(np.sum((mounted.axis_in_rig @ factor) ** 2)))
    return float(np.sqrt(np.mean(variances))) if variances else 0.0


def _place_factor(place: Float[np.ndarray, "3"], cameras: list[MountedCamera]) -> Float[np.ndarray, "3 n"]:
    """L, with L L^T the covariance of a place that cameras see."""
    square, factors = np.zeros((3, 3)), []
    for mounted in cameras:

        def project_moved(step: Float[np.ndarray, "k"], mounted: MountedCamera = mounted) -> Float[np.ndarray, "2"]:
            return _project_perturbed(mounted, place + step[:3], step[3:])

        numbers = len(mounted.camera.parameters)
        by_all = _jacobian(project_moved, 3 + numbers + _MOTION)
        by_place, by_camera = by_all[:, :3], by_all[:, 3:]
        lens = covariance_factor(mounted.camera.covariance, numbers)
        motion = covariance_factor(mounted.covariance, _MOTION)
        square += by_place.T @ by_place
        factors.append(by_place.T @ np.hstack([by_camera[:, :numbers] @ lens, by_camera[:, numbers:] @ motion]))
    return np.asarray(np.linalg.pinv(square) @ np.hstack(factors))


def _project_perturbed(
    mounted: MountedCamera, place: Float[np.ndarray, "3"], step: Float[np.ndarray, "k"]
) -> Float[np.ndarray, "2"]:
    """The pixel at which a camera with other parameters, turned and shifted, sees a place of the rig frame."""
    lens, turn, shift = np.split(step, [-_MOTION, 3 - _MOTION])
    camera = mounted.camera.with_parameters(mounted.camera.parameters + lens)
    moved = Rigid3.from_rotation_vector(turn, shift)
    return np.asarray(camera.project((moved @ mounted.cam_from_rig).apply(place)))


def _jacobian(of: Callable[[np.ndarray], np.ndarray], count: int) -> Float[np.ndarray, "2 k"]:
    """Central differences at 0."""
    steps = _STEP * np.eye(count)
    return np.stack([(of(step) - of(-step)) / (2 * _STEP) for step in steps], axis=1)
