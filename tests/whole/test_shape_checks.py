"""The checks of shapes see the first calls of a function in each module of tests, and let the others pass."""

import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError, jaxtyped

import shape_checks
from cuspid.geometry import Rigid3


def test_a_wrong_shape_is_refused_until_enough_calls_were_right_and_then_again():
    pose, wrong = Rigid3.identity(), np.zeros((2, 4))
    shape_checks.check_again()
    for _ in range(2):
        with pytest.raises(TypeCheckError):
            pose.apply(wrong)
        for _ in range(2 * shape_checks.CALLS):
            pose.apply(np.zeros((2, 3)))
        with pytest.raises(ValueError, match="mismatch"):
            pose.apply(wrong)
        shape_checks.check_again()


def test_a_function_that_is_made_anew_is_checked_the_first_times():
    def make():
        @jaxtyped(typechecker=shape_checks.first_calls)
        def inner(point: Float[np.ndarray, "3"]) -> float:
            return float(point.sum())

        return inner

    for _ in range(2):
        shape_checks.check_again()
        for _ in range(shape_checks.INNER):
            with pytest.raises(TypeCheckError):
                make()(np.ones(4))
        assert make()(np.ones(4)) == 4
