import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cuspid.geometry import Rigid3, axes_about, best_similarity, distinct_rows, freeze, lengths_along, unit
from cuspid.runtime.errors import InputError
from strategies import points, rigid3s, vectors


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


@given(rigid3s(), st.integers(0, 11), st.sampled_from([np.nan, np.inf, 1e-3, 1e9]))
def test_a_motion_is_rigid_and_finite(a, place, error):
    """Whatever one of its numbers is off by, unless it is a length that may be so."""
    matrix = a.matrix[:3].copy()
    matrix.flat[place] += error
    if place % 4 == 3 and np.isfinite(error):
        assert Rigid3.from_matrix(matrix).translation[place // 4] == matrix.flat[place]
    else:
        with pytest.raises(InputError, match="rigid motion: "):
            Rigid3.from_matrix(matrix)


@pytest.mark.parametrize(
    ("rotation", "translation"),
    [(np.diag([1.0, 1.0, -1.0]), np.zeros(3)), (2 * np.eye(3), np.zeros(3)), (np.eye(2), np.zeros(3)), (np.eye(3), 0)],
)
def test_a_motion_neither_mirrors_nor_scales(rotation, translation):
    with pytest.raises(InputError, match="rigid motion: "):
        Rigid3(rotation, translation)


def test_known_rotation():
    quarter_turn = Rigid3.from_rotation_vector(np.array([0, 0, np.pi / 2]), np.array([1.0, 0, 0]))
    np.testing.assert_allclose(quarter_turn.apply(np.array([[1.0, 0, 0]])), [[1, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(quarter_turn.rotate(np.array([1.0, 0, 0])), [0, 1, 0], atol=1e-12)


@given(vectors(), vectors())
def test_axes_about_directions_are_right_handed_frames(one, other):
    directions = unit(np.stack([one + [20, 0, 0], other - [0, 0, 20]]))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    for axes, direction in zip(axes_about(directions), directions, strict=True):
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1)
        np.testing.assert_array_equal(axes[2], direction)
        np.testing.assert_array_equal(axes, axes_about(direction))


def test_what_has_no_length_gets_none():
    np.testing.assert_array_equal(unit(np.zeros((2, 3))), np.zeros((2, 3)))


@given(rigid3s(), points())
def test_the_length_of_a_line_adds_up_and_no_motion_changes_it(motion, line):
    lengths = lengths_along(line)
    assert lengths[0] == 0
    np.testing.assert_allclose(np.diff(lengths), np.linalg.norm(line[1:] - line[:-1], axis=1), atol=1e-12)
    np.testing.assert_allclose(lengths_along(motion.apply(line)), lengths, atol=1e-9)


def rotated(rng: np.random.Generator, dimensions: int) -> np.ndarray:
    """A random proper rotation."""
    turn = np.linalg.qr(rng.normal(size=(dimensions, dimensions)))[0]
    turn[0] *= np.sign(np.linalg.det(turn))
    return turn


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_a_similarity_is_found_exactly_whatever_the_weights(seed, dimensions):
    rng = np.random.default_rng(seed)
    turn, scale, shift = rotated(rng, dimensions), float(rng.uniform(0.2, 5)), rng.normal(size=dimensions)
    points = rng.normal(size=(6, dimensions))
    for weights in (None, rng.uniform(0.1, 1, 6)):
        found = best_similarity(points, scale * points @ turn.T + shift, weights)
        assert found[0] == pytest.approx(scale)
        np.testing.assert_allclose(found[1], turn, atol=1e-8)
        np.testing.assert_allclose(found[2], shift, atol=1e-8)


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_a_weight_of_two_is_a_point_given_twice(seed, dimensions):
    source, target = np.random.default_rng(seed).normal(size=(2, 8, dimensions))
    twice = [*range(8), 0, 5]
    weighted = best_similarity(source, target, np.bincount(twice).astype(float))
    for one, other in zip(weighted, best_similarity(source[twice], target[twice]), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_no_similarity_nearby_is_nearer(seed, dimensions):
    rng = np.random.default_rng(seed)
    source, target, weights = *rng.normal(size=(2, 8, dimensions)), rng.uniform(0.1, 1, 8)
    scale, rotation, shift = best_similarity(source, target, weights)
    assert np.linalg.det(rotation) == pytest.approx(1)

    def misfit(scale, rotation, shift):
        return weights @ np.sum((scale * source @ rotation.T + shift - target) ** 2, axis=1)

    best = misfit(scale, rotation, shift)
    for _ in range(10):
        step = rng.normal(scale=0.01, size=(dimensions, dimensions))
        turn = np.linalg.qr(np.eye(dimensions) + step - step.T)[0]
        turn *= np.sign(np.diag(turn))
        assert (
            misfit(scale * rng.uniform(0.99, 1.01), turn @ rotation, shift + rng.normal(0, 0.01, dimensions))
            > best - 1e-12
        )


def test_a_mirror_image_is_not_laid_on_by_reflection():
    source = np.random.default_rng(0).normal(size=(9, 3))
    assert np.linalg.det(best_similarity(source, source * [-1, 1, 1])[1]) == pytest.approx(1)


def test_values_are_frozen():
    value = Rigid3.identity()
    with pytest.raises(ValueError, match="read-only"):
        value.rotation[0, 0] = 2


few_values = st.sampled_from([-1.0, -0.0, 0.0, 1e-300, 1.0, 2.0])


@given(arrays(np.float64, st.tuples(st.integers(0, 30), st.integers(1, 3)), elements=few_values))
def test_distinct_rows_are_those_that_numpy_finds(rows):
    first, number = distinct_rows(rows)
    _, expected, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    np.testing.assert_array_equal(first, expected)
    np.testing.assert_array_equal(number, inverse.reshape(-1))


def test_what_is_owned_is_not_copied_and_cannot_be_changed():
    array = np.zeros(3)
    assert freeze(array) is array
    with pytest.raises(ValueError, match="read-only"):
        array[0] = 1
