"""The error of a step of DOP853, from both of its estimates, against the formula in NumPy."""

import numpy as np
import pytest

from twoloop.kernels.data.indices import ATOL, RTOL
from twoloop.kernels.steps.explicit_step import largest_error

N = 3


@pytest.mark.parametrize("larger", [0, N])  # whether positions or velocities decide
@pytest.mark.parametrize("strict", [False, True])
def test_errors_are_over_the_tolerances_of_each_component(larger, strict):
    g = np.random.default_rng(7)
    y, y1, one, other = g.uniform(-2.0, 2.0, (4, 2 * N))
    one[larger : larger + N] *= 1e4
    tolerances = np.zeros(ATOL + N)
    tolerances[RTOL], tolerances[ATOL:] = 1e-3, (1e-2, 1e-4, 1e-3)
    allowed = np.tile(tolerances[ATOL:], 2) + 1e-3 * np.maximum(abs(y), abs(y1))
    e, d = abs(one / allowed).max(), abs(other / allowed).max()
    fall = e / np.hypot(e, d)
    expected = e * (np.sqrt(fall) if strict else fall)
    assert largest_error.py_func(tolerances, y, y1, one, other, strict) == pytest.approx(expected, rel=1e-12)
    assert largest_error.py_func(tolerances, y, y1, 0.0 * one, other, strict) == 0.0
