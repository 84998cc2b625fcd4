"""A lens in the model of another program: carried over exactly where that model contains it, else by the nearest lens
of that model over the image, with what is lost in px."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from cuspid.geometry.cameras import MODELS, project_points, projection_derivatives
from cuspid.model.camera import Camera
from cuspid.runtime.errors import InputError

_ACROSS, _DOWN = 41, 31
"""Pixels of an image at which lenses are compared."""
_ROUND, _OUT = 72, 90
"""Directions around the axis and away from it at which a lens without an inverse is compared."""
_FARTHEST_RAD = np.deg2rad(110.0)
_AHEAD = 0.02
"""Cosine of the angle from the axis up to which a perspective lens is fitted."""
_SMALL_RAD = 1e-4
_ROUGH_PX = 10.0
"""A lens that is farther off is not told more exactly."""
MOST_LOST_PX = 1.0
"""A lens that is carried over with more is not the same any more."""

Projection = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 2"]]
"""From points in the camera frame to px (COLMAP's origin); NaN where the lens shows nothing."""


@dataclass(frozen=True)
class Lens:
    """What a format can hold: a model of cuspid's with some of its parameters, the others being zero."""

    model: str
    names: tuple[str, ...]
    said: str
    """What the format calls it."""

    def holds(self, camera: Camera) -> bool:
        """Whether a camera's lens is one of these."""
        used = {name for name, value in zip(camera.lens.names, camera.distortion, strict=True) if value != 0}
        alike = camera.lens.is_equidistant == MODELS[self.model].is_equidistant
        return used <= set(self.names) and alike

    def as_model(self, camera: Camera) -> Camera:
        """The same camera in this model, whose covariance is lost unless the model is the same."""
        if camera.model == self.model:
            return camera
        known = dict(zip(camera.lens.names, camera.distortion, strict=True))
        return Camera(
            width=camera.width,
            height=camera.height,
            focal_px=camera.focal_px,
            principal_point_px=camera.principal_point_px,
            distortion=np.array([known.get(name, 0.0) for name in MODELS[self.model].names]),
            model=self.model,
        )


BROWN_4 = Lens("OPENCV", ("k1", "k2", "p1", "p2"), "k1 k2 p1 p2")
BROWN_5 = Lens("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3"), "k1 k2 p1 p2 k3")
RATIONAL = Lens("FULL_OPENCV", MODELS["FULL_OPENCV"].names, "k1 k2 p1 p2 k3 k4 k5 k6")
FISHEYE = Lens("OPENCV_FISHEYE", MODELS["OPENCV_FISHEYE"].names, "a fisheye with k1 k2 k3 k4")
FISHEYE_TANGENTIAL = Lens(
    "THIN_PRISM_FISHEYE", ("k1", "k2", "p1", "p2", "k3", "k4"), "a fisheye with k1 k2 k3 k4 p1 p2"
)
THIN_PRISM = Lens("THIN_PRISM_FISHEYE", MODELS["THIN_PRISM_FISHEYE"].names, "a fisheye with thin prisms")
SPLINED = Lens("SPLINED_FISHEYE", MODELS["SPLINED_FISHEYE"].names, "a splined fisheye")
ALL = (BROWN_4, RATIONAL, FISHEYE, THIN_PRISM)


@dataclass(frozen=True)
class Loss:
    """How far the nearest lens of a model is off over the image."""

    largest_px: float
    rms_px: float
    said: str
    """In what the lens was carried over, and from what."""

    def __str__(self) -> str:
        return f"{self.said}: at most {self.largest_px:.2g} px off over the image, RMS {self.rms_px:.2g} px"


def convert_lens(camera: Camera, lenses: Sequence[Lens]) -> tuple[Camera, Loss | None]:
    """A camera with a lens that one of the given ones holds: the same, or the nearest with what is lost."""
    for lens in lenses:
        if lens.holds(camera):
            return lens.as_model(camera), None
    pixels = _grid(camera)
    directions = camera.directions(pixels)
    seen = np.isfinite(directions).all(axis=1)
    return _nearest(directions[seen], pixels[seen], camera.parameters[:4], (camera.width, camera.height), lenses,
                    camera.model)  # fmt: skip


def _grid(camera: Camera) -> Float[np.ndarray, "n 2"]:
    """Pixels all over an image, up to its borders."""
    x, y = np.meshgrid(np.linspace(0, camera.width, _ACROSS), np.linspace(0, camera.height, _DOWN))
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def fit_projection(
    project: Projection, size_px: tuple[int, int], said: str, lenses: Sequence[Lens] = (RATIONAL, FISHEYE, THIN_PRISM)
) -> tuple[Camera, Loss]:
    """The camera nearest to one of another model, which is given by how it projects. Raises InputError where that shows
    hardly anything in the image."""
    size = np.array(size_px, dtype=np.float64)
    turn, angle = np.meshgrid(np.linspace(0, 2 * np.pi, _ROUND, endpoint=False), np.linspace(0, _FARTHEST_RAD, _OUT))
    rays = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=-1)
    pixels = project(rays.reshape(-1, 3)).reshape(_OUT, _ROUND, 2)
    radius = np.linalg.norm(pixels - pixels[:1], axis=-1)
    grows = np.ones(radius.shape, dtype=bool)
    grows[1:] = np.logical_and.accumulate(np.diff(radius, axis=0) > 0, axis=0)
    inside = np.all((pixels > 0) & (pixels < size), axis=-1) & grows
    around = np.array([[0, 0, 1.0], [_SMALL_RAD, 0, 1], [0, _SMALL_RAD, 1], [-_SMALL_RAD, 0, 1], [0, -_SMALL_RAD, 1]])
    middle, right, low, left, high = project(around)
    focal = np.array([right[0] - left[0], low[1] - high[1]]) / (2 * _SMALL_RAD)
    if np.count_nonzero(inside) < _ROUND or not np.all(focal >= 1):
        raise InputError(f"its lens ({said}) shows hardly anything in an image of {size_px[0]} x {size_px[1]} px")
    start = np.concatenate([focal, middle])
    first, loss = _nearest(rays[inside], pixels[inside], start, size_px, lenses, said)
    if loss.largest_px > _ROUGH_PX:
        return first, loss
    # Its rays cover the image evenly, and reach into the corners.
    rays = first.directions(_grid(first))
    rays = rays[np.isfinite(rays).all(axis=1)]
    pixels = project(rays)
    seen = np.isfinite(pixels).all(axis=1)
    return _nearest(rays[seen], pixels[seen], start, size_px, lenses, said)


def _nearest(
    directions: Float[np.ndarray, "n 3"],
    pixels: Float[np.ndarray, "n 2"],
    start: Float[np.ndarray, "4"],
    size_px: tuple[int, int],
    lenses: Sequence[Lens],
    said: str,
) -> tuple[Camera, Loss]:
    found = [_fit_lens(directions, pixels, start, size_px, lens, said) for lens in lenses]
    return min(found, key=lambda each: each[1].largest_px)


def _fit_lens(
    directions: Float[np.ndarray, "n 3"],
    pixels: Float[np.ndarray, "n 2"],
    start: Float[np.ndarray, "4"],
    size_px: tuple[int, int],
    lens: Lens,
    said: str,
) -> tuple[Camera, Loss]:
    """By least squares over the directions that such a lens can show; one that it does not show counts as far off as
    the image is wide across its corners."""
    model = MODELS[lens.model]
    ahead = directions if model.is_equidistant else directions[directions[:, 2] > _AHEAD]
    at = pixels if model.is_equidistant else pixels[directions[:, 2] > _AHEAD]
    free = [0, 1, 2, 3, *(4 + model.names.index(name) for name in lens.names)]
    whole = np.concatenate([start, np.zeros(len(model.names))])

    def with_free(values: Float[np.ndarray, "k"]) -> Float[np.ndarray, "p"]:
        changed = whole.copy()
        changed[free] = values
        return changed

    def misses(values: Float[np.ndarray, "k"]) -> Float[np.ndarray, "m"]:
        return np.clip(project_points(model.code, with_free(values), np.inf, ahead) - at, -1e6, 1e6).ravel()

    def slopes(values: Float[np.ndarray, "k"]) -> Float[np.ndarray, "m k"]:
        return projection_derivatives(model.code, with_free(values), ahead)[1][..., free].reshape(-1, len(free))

    solved = least_squares(misses, whole[free], slopes, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=200)
    parameters = with_free(solved.x)
    width, height = size_px
    camera = Camera(
        width=width,
        height=height,
        focal_px=np.maximum(parameters[:2], 1e-3),
        principal_point_px=parameters[2:4],
        distortion=parameters[4:],
        model=lens.model,
    )
    off = np.linalg.norm(camera.project(directions) - pixels, axis=1)
    off = np.where(np.isfinite(off), off, np.hypot(width, height))
    return camera, Loss(float(off.max()), float(np.sqrt(np.mean(off**2))), f"{said} as {lens.said}")
