"""Test numbers that record how they depend on parameters: for other values they equal plain numbers."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twoloop.generate.parameter_expressions import Parameter, ParameterTape

EXPRESSIONS = (
    lambda p: p[0] * p[1] / p[0],
    lambda p: (p[0] + p[1]) * (p[0] - p[1]) / p[2],
    lambda p: 2.0 * p[0] - (p[0] + p[0]) + p[1],
    lambda p: np.sqrt(p[0] ** 2) + (p[1] ** 2) ** 0.5,
    lambda p: np.sin(p[0]) * math.pi - 3.0 / p[2],
    lambda p: -(p[2] ** -2) + 1.0 / (1.0 + p[0] ** 2),
    lambda p: np.hypot(p[0], p[1]) + abs(p[0]) + np.exp(p[1] * 0.1),
    lambda p: (np.array([1.0, 2.0, 3.0]) * p[0] + p[1]) @ np.array([1.0, p[2], -1.0], dtype=object),
    lambda p: p[0] ** p[2] if p[0] > 0 else p[0] * 2.0,
    lambda p: (p[0] * p[1] + p[1] * p[2]) - p[1] * p[2],
)
values = st.floats(0.3, 3.0) | st.floats(-3.0, -0.3)


@pytest.mark.parametrize("expression", EXPRESSIONS)
@given(st.tuples(values, values, st.floats(0.3, 3.0)))
def test_for_other_parameters_they_are_what_plain_numbers_are(expression, other):
    tape = ParameterTape([0.7, 1.9, 1.3], range(3))
    made = expression(tape.parameters)
    assert isinstance(made, Parameter) and made == pytest.approx(expression(np.array([0.7, 1.9, 1.3])))
    if expression is EXPRESSIONS[-2]:
        other = (abs(other[0]), *other[1:])  # the branch was taken for a positive one
    assert tape.evaluate([made], np.array([other]))[0, 0] == pytest.approx(expression(np.array(other)), abs=1e-12)


def test_what_cancels_is_gone():
    p = ParameterTape([0.7, 1.9, 1.3], range(3)).parameters
    assert type(p[0] * p[1] / p[1] / p[0]) is float and type(p[0] - p[0]) is float
    assert (p[0] * p[1] / p[1]).powers == p[0].powers


def test_parameters_that_do_not_vary_are_plain_numbers():
    tape = ParameterTape([0.7, 1.9], [1])
    assert type(tape.parameters[0]) is float and type(tape.parameters[1]) is Parameter
    assert tape.evaluate([tape.parameters[1]], np.array([[5.0, 6.0]])).tolist() == [[6.0]]
