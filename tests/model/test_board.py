"""Where the corners of a chart of tags lie."""

from __future__ import annotations

import numpy as np

from cuspid.model.board.tags import TagGrid


def test_corners_of_tags_lie_a_tag_and_a_gap_apart() -> None:
    grid = TagGrid(columns=3, rows=2, tag_mm=10.0, gap_mm=3.0, border_bits=2, first_id=5)
    assert grid.size_mm == (42.0, 29.0)
    assert np.unique(grid.corners[:, 0]).tolist() == [3.0, 13.0, 16.0, 26.0, 29.0, 39.0]
    assert np.unique(grid.corners[:, 1]).tolist() == [3.0, 13.0, 16.0, 26.0]
    top_left = grid.corners[grid.corners_of(grid.ids[:1, :1].ravel())][0]
    assert top_left.tolist() == [[13.0, 13.0], [3.0, 13.0], [3.0, 3.0], [13.0, 3.0]]
