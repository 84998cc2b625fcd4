"""Light that travels below the surface before it leaves it, so that shade is softer than the shape.

In a body that scatters much more than it absorbs, light spreads by diffusion (A. Ishimaru, Wave Propagation and
Scattering in Random Media, 1978; H. Jensen et al., SIGGRAPH 2001). Along the surface, and where each place loses what
it sends out, that is a screened Poisson equation: of the light E that enters,

    B - div(l^2 grad B) = E

leaves as B. From one place it spreads as K0(r / l), by pi / 2 times the length l on average; of a wave of light and
shade of length w the share 1 / (1 + (2 pi l / w)^2) is left; none is lost. It is solved on the mesh by linear finite
elements. l is the length after which the direction of light is forgotten: 0.5 mm in enamel for red light (scattered
6.6 times per mm, with g = 0.68, at 633 nm).
"""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import cg

from cuspid.model.mesh import Mesh

_STEPS, _TOLERANCE = 500, 1e-5
_FLATTEST = 1e3
"""Faces with a larger cotangent are taken for degenerate."""


class Scattering:
    """How light spreads below the surface of a mesh."""

    def __init__(self, mesh: Mesh, lengths_mm: Float[np.ndarray, "f c"]) -> None:
        """``lengths_mm``: how far light of each colour travels below each face; 0 for not at all."""
        self._spreads = [_Spread(mesh, lengths) for lengths in lengths_mm.T]

    def leaving(self, entering: Float[np.ndarray, "v c"]) -> Float[np.ndarray, "v c"]:
        """The light of each colour that leaves each vertex, from what enters there (both per area)."""
        spread = [each(light) for each, light in zip(self._spreads, entering.T, strict=True)]
        return np.maximum(np.stack(spread, axis=-1), 0.0)


def diffuse(mesh: Mesh, length_mm: float, values: Float[np.ndarray, "v k"]) -> Float[np.ndarray, "v k"]:
    """Values per vertex after they have spread along the surface by a length."""
    spread = _Spread(mesh, np.full(len(mesh.faces), length_mm))
    return np.stack([spread(column) for column in values.T], axis=-1)


class _Spread:
    """The screened Poisson equation on a mesh, with a length for each face."""

    def __init__(self, mesh: Mesh, lengths_mm: Float[np.ndarray, "f"]) -> None:
        self._mass = np.maximum(mesh.vertex_areas, np.finfo(np.float32).tiny)  # some may be in no face
        self._system = (sparse.diags_array(self._mass) + _stiffness(mesh, lengths_mm**2)).tocsr()

    def __call__(self, values: Float[np.ndarray, "v"]) -> Float[np.ndarray, "v"]:
        scaled = sparse.diags_array(1 / self._system.diagonal())
        found, _ = cg(self._system, self._mass * values, x0=values, rtol=_TOLERANCE, maxiter=_STEPS, M=scaled)
        return np.asarray(found)


def _stiffness(mesh: Mesh, squares: Float[np.ndarray, "f"]) -> sparse.csr_array:
    """Linear finite elements of the surface Laplacian, each face times its factor."""
    halves = igl.cotmatrix_entries(mesh.vertices, mesh.faces.astype(np.int64))
    sound = (np.abs(halves) < _FLATTEST).all(axis=1)  # False also where one is NaN
    weights = np.where(sound, squares, 0)[:, None] * np.where(sound[:, None], halves, 0)
    begin, end = mesh.faces[:, [1, 2, 0]].ravel(), mesh.faces[:, [2, 0, 1]].ravel()
    rows, columns = np.concatenate([begin, end, begin, end]), np.concatenate([end, begin, begin, end])
    values = np.concatenate([-weights.ravel()] * 2 + [weights.ravel()] * 2)
    return sparse.coo_array((values, (rows, columns)), shape=(len(mesh.vertices),) * 2).tocsr()
