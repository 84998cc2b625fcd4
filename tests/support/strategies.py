"""Hypothesis strategies for geometric values."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cuspid.geometry import Rigid3
from cuspid.geometry.cameras import MODELS
from cuspid.model.camera import Camera


def vectors(limit: float = 10.0, size: int = 3) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float64, size, elements=st.floats(-limit, limit, allow_nan=False, width=64))


def points(limit: float = 10.0) -> st.SearchStrategy[np.ndarray]:
    shapes = st.integers(1, 8).map(lambda count: (count, 3))
    return hnp.arrays(np.float64, shapes, elements=st.floats(-limit, limit, allow_nan=False))


def rigid3s() -> st.SearchStrategy[Rigid3]:
    return st.builds(Rigid3.from_rotation_vector, vectors(3.0), vectors(100.0))


LENS_LIMITS = {
    "k1": 0.15,
    "k2": 0.05,
    "k3": 0.02,
    "k4": 0.02,
    "k5": 0.02,
    "k6": 0.01,
    "p1": 0.005,
    "p2": 0.005,
    "sx1": 0.005,
    "sy1": 0.005,
}
"""Of what the strategies draw."""


@st.composite
def lenses(draw: st.DrawFn, model: str) -> Camera:
    """Wide-angle cameras with an off-centre principal point and a lens of a model, distorted as small lenses are."""
    return Camera(
        width=draw(st.integers(64, 800)),
        height=draw(st.integers(64, 800)),
        focal_px=draw(hnp.arrays(np.float64, 2, elements=st.floats(300, 900))),
        principal_point_px=draw(hnp.arrays(np.float64, 2, elements=st.floats(100, 400))),
        distortion=draw(distortions(model)),
        model=model,
    )


@st.composite
def distortions(draw: st.DrawFn, model: str) -> np.ndarray:
    """Of a splined lens, with control points that shift places by a pixel or so."""
    lens = MODELS[model]
    known = [draw(st.floats(-LENS_LIMITS[name], LENS_LIMITS[name])) for name in lens.names if name in LENS_LIMITS]
    if not lens.splined:
        return np.array(known)
    shifts = np.random.default_rng(draw(st.integers(0, 99))).normal(0, 1 / 500, 2 * lens.splined**2)
    return np.array([*known, draw(st.floats(0.3, 1.5)), *shifts])


def cameras() -> st.SearchStrategy[Camera]:
    """Those of COLMAP's OPENCV model."""
    return lenses("OPENCV")
