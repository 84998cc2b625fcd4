"""The checks of shapes see the first calls of a function in each module of tests, and let the others pass."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError

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
