import numpy as np
import pytest
from hypothesis import given

from cuspid.geometry import Rigid3
from strategies import points, rigid3s


@given(rigid3s(), rigid3s(), rigid3s(), points())
def test_group_laws(a, b, c, x):
    np.testing.assert_allclose(((a @ b) @ c).apply(x), (a @ (b @ c)).apply(x), atol=1e-9)
    np.testing.assert_allclose((a @ b).apply(x), a.apply(b.apply(x)), atol=1e-9)
    np.testing.assert_allclose((a.inverse() @ a).matrix, np.eye(4), atol=1e-10)
    np.testing.assert_allclose((Rigid3.identity() @ a).matrix, a.matrix, atol=0)


@given(rigid3s(), points())
def test_lengths_and_handedness_are_kept(a, x):
    moved = a.apply(x)
    np.testing.assert_allclose(np.linalg.norm(moved - moved[0], axis=1), np.linalg.norm(x - x[0], axis=1), atol=1e-9)
    assert np.linalg.det(a.rotation) == pytest.approx(1, abs=1e-9)


@given(rigid3s())
def test_every_parametrisation_returns(a):
    np.testing.assert_allclose(Rigid3.from_matrix(a.matrix).matrix, a.matrix)
    np.testing.assert_allclose(Rigid3.from_quaternion(a.quaternion, a.translation).matrix, a.matrix, atol=1e-12)
    again = Rigid3.from_rotation_vector(a.rotation_vector, a.translation)
    np.testing.assert_allclose(again.matrix, a.matrix, atol=1e-12)
    assert np.deg2rad(a.angle_deg) == pytest.approx(np.linalg.norm(a.rotation_vector))
    assert a.quaternion[0] >= 0


def test_known_rotation():
    quarter_turn = Rigid3.from_rotation_vector(np.array([0, 0, np.pi / 2]), np.array([1.0, 0, 0]))
    np.testing.assert_allclose(quarter_turn.apply(np.array([[1.0, 0, 0]])), [[1, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(quarter_turn.rotate(np.array([1.0, 0, 0])), [0, 1, 0], atol=1e-12)


def test_values_are_frozen():
    value = Rigid3.identity()
    with pytest.raises(ValueError, match="read-only"):
        value.rotation[0, 0] = 2
