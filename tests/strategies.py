"""Hypothesis strategies for geometric values."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cuspid.camera import Camera
from cuspid.geometry import Rigid3


def vectors(limit: float = 10.0, size: int = 3) -> st.SearchStrategy[np.ndarray]:
    return hnp.arrays(np.float64, size, elements=st.floats(-limit, limit, allow_nan=False, width=64))


def points(limit: float = 10.0) -> st.SearchStrategy[np.ndarray]:
    shapes = st.integers(1, 8).map(lambda count: (count, 3))
    return hnp.arrays(np.float64, shapes, elements=st.floats(-limit, limit, allow_nan=False))


def rigid3s() -> st.SearchStrategy[Rigid3]:
    return st.builds(Rigid3.from_rotation_vector, vectors(3.0), vectors(100.0))


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Wide-angle cameras with an off-centre principal point and lens distortion as small lenses have it."""
    return Camera(
        width=draw(st.integers(64, 800)),
        height=draw(st.integers(64, 800)),
        focal_px=draw(hnp.arrays(np.float64, 2, elements=st.floats(300, 900))),
        principal_point_px=draw(hnp.arrays(np.float64, 2, elements=st.floats(100, 400))),
        distortion=np.array([draw(st.floats(-limit, limit)) for limit in (0.15, 0.05, 0.005, 0.005)]),
    )
