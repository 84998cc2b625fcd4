"""Normal equations that are summed view by view are those of all rows at once."""

import numpy as np
import pytest

from cuspid.calibration.equations import (
    Layout,
    between_motions,
    gradient_of,
    matrix_of,
    motion_equations,
    without_motions,
)

COUNT, STARTS = 9, np.array([0, 4, 5, 11])


@pytest.fixture
def case() -> tuple[Layout, np.ndarray, np.ndarray]:
    """Corners that have to do with some of the unknowns, with one of them twice, and with some that are held."""
    rng = np.random.default_rng(0)
    columns = np.array([rng.permutation(COUNT)[:5] for _ in range(STARTS[-1])])
    columns[3, 2] = columns[3, 0]
    columns[rng.random(columns.shape) < 0.2] = -1
    return Layout.of(columns, STARTS, COUNT), rng.normal(size=(len(columns), 2, 5)), rng.normal(size=(len(columns), 2))


def rows(layout: Layout, values: np.ndarray) -> np.ndarray:
    out = np.zeros((2 * len(values), COUNT))
    for n, columns in enumerate(layout.columns):
        for a, column in enumerate(columns):
            if column >= 0:
                out[2 * n : 2 * n + 2, column] += values[n, :, a]
    return out


def test_sums_are_those_of_all_rows(case) -> None:
    layout, values, residuals = case
    jacobian = rows(layout, values)
    of_views = [layout.rows_of(view, values) for view in range(len(STARTS) - 1)]
    assert np.allclose(np.concatenate(of_views), jacobian)
    assert np.allclose(matrix_of(values, layout), jacobian.T @ jacobian)
    assert np.allclose(gradient_of(values, residuals, layout), jacobian.T @ residuals.ravel())


def test_the_motion_of_a_view_is_eliminated(case) -> None:
    """As by the Schur complement of all rows."""
    layout, values, residuals = case
    by_motion = np.random.default_rng(1).normal(size=(len(values), 2, 6))
    jacobian, motions = rows(layout, values), np.zeros((2 * len(values), 18))
    for view in range(3):
        part = slice(STARTS[view], STARTS[view + 1])
        motions[2 * part.start : 2 * part.stop, 6 * view : 6 * view + 6] = by_motion[part].reshape(-1, 6)
    own = motions.T @ motions
    matrix, right = motion_equations(residuals, by_motion, np.ones(len(values)), STARTS)
    assert np.allclose(matrix, [own[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] for v in range(3)])
    assert np.allclose(right.ravel(), motions.T @ residuals.ravel())
    spread = np.linalg.inv(matrix + np.eye(6))
    eliminated = matrix_of(values, layout, between_motions(values, by_motion, layout), spread)
    both = jacobian.T @ motions
    assert np.allclose(eliminated, jacobian.T @ jacobian - both @ np.linalg.inv(own + np.eye(18)) @ both.T)
    move = np.random.default_rng(2).normal(size=(3, 6))
    assert np.allclose(
        without_motions(residuals, by_motion, STARTS, move).ravel(), residuals.ravel() - motions @ move.ravel()
    )
