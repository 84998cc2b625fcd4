"""The body that a board is mounted on: a plate, with a terrace for each of the board's runs of columns.

Frame: ``body``: +X as for the board, +Y up its columns, +Z out of it, towards the cameras. The plate lies on Z = 0; the
origin is below the bottom left corner of the squares.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from manifold3d import CrossSection, Manifold

from cuspid.model.board import Board
from cuspid.model.mesh import Mesh

PLATE_MM = 2.0
"""Thickness of the body below the first terrace."""


def target_body(board: Board) -> Mesh:
    """One closed solid, as large as the squares, to be printed or milled."""
    solid = Manifold.extrude(CrossSection([_profile(board)]), board.size_mm[1])
    made = solid.rotate([90, 0, 0]).translate([0, board.size_mm[1], 0]).to_mesh64()
    return Mesh(np.asarray(made.vert_properties)[:, :3], np.asarray(made.tri_verts, dtype=np.int64))


def _profile(board: Board) -> Float[np.ndarray, "n 2"]:
    """Along X and up, counter-clockwise."""
    edges, heights = board.edges_mm, PLATE_MM + board.step_mm * np.arange(board.terraces)
    tops = np.stack([np.repeat(edges, 2)[1:-1], np.repeat(heights, 2)], axis=1)
    return np.concatenate([[[0, 0], [edges[-1], 0]], tops[::-1]])
