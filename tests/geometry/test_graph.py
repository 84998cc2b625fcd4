"""What hangs together."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cuspid.geometry.graph import graph_of, parts_of

COUNT = 9


@given(st.lists(st.tuples(st.integers(0, COUNT - 1), st.integers(0, COUNT - 1)), max_size=12))
def test_parts_are_what_steps_along_pairs_reach(pairs):
    """Whatever the order of the pairs and of the two in each."""
    joined = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    part = parts_of(joined, COUNT)
    reached = np.eye(COUNT) + graph_of(joined, COUNT).toarray()
    reached = np.linalg.matrix_power(np.minimum(reached + reached.T, 1), COUNT) > 0
    np.testing.assert_array_equal(part[:, None] == part, reached)
    np.testing.assert_array_equal(parts_of(joined[::-1, ::-1], COUNT), part)


def test_without_pairs_each_stands_alone():
    assert parts_of(np.zeros((0, 2), np.int64), 4).tolist() == [0, 1, 2, 3]
