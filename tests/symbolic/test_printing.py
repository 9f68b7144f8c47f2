"""Test printed code and derivatives against what SymPy itself evaluates."""

import math

import numpy as np
import pytest
import sympy as sp

from twoloop.symbolic.expressions import FUNCTIONS, Differentiation, callback_source, energy_source

a, b = sp.symbols("q0 q1")
VALUES = {a: sp.Float(0.37), b: sp.Float(0.81)}
EXPRESSIONS = [
    *(function(a, b + a) if function is sp.atan2 else function(a * b) for function in FUNCTIONS),
    a / b - b / a**2 + 3 / (a * b),
    -a * b**3 - 2 * (a - b) ** 2 + (a + b) ** 7,
    sp.sqrt(a + b) / sp.sqrt(a * b) + (a + b) ** sp.Rational(-3, 2),
    a**b + b ** (-a) + 2 ** (a * b),
    sp.Rational(1, 3) * sp.pi * a - sp.E * b + sp.Float("0.1", 17),
    -(a + b) * (a - b) / (1 + a) - (-2) * a,
    sp.sin(a) ** 2 / (1 + sp.cos(a) ** 2),
    -sp.Rational(7, 2),
]


@pytest.mark.parametrize("expression", EXPRESSIONS, ids=str)
def test_code_gives_what_the_expression_is(expression):
    known, q = float(expression.xreplace(VALUES)), np.array([0.37, 0.81])
    names = {"math": math, "np": np}
    exec(callback_source("force", [{0: expression}]), names)
    exec(energy_source(expression), names)
    out = np.zeros(1)
    names["force"](0.0, q, q, q, out)
    assert out[0] == pytest.approx(known, rel=1e-14)
    assert names["energy"](0.0, np.column_stack([q, q]), None, None) == pytest.approx(known, rel=1e-14)


@pytest.mark.parametrize("expression", EXPRESSIONS, ids=str)
def test_derivatives_are_those_of_sympy(expression):
    d = Differentiation()
    for first in (a, b):
        once = d.derivative(expression, first)
        assert float(once.xreplace(VALUES)) == pytest.approx(float(expression.diff(first).xreplace(VALUES)), rel=1e-13)
        twice = expression.diff(first, b)
        assert float(d.derivative(once, b).xreplace(VALUES)) == pytest.approx(float(twice.xreplace(VALUES)), rel=1e-12)


def test_what_entries_share_is_evaluated_once():
    root = sp.sqrt(a**2 + b**2)
    source = callback_source("force", [{0: sp.sin(root) / root, 1: sp.cos(root), 2: sp.cos(root)}])
    assert source.count("sqrt") == 1 and source.count("cos") == 1 and source.count("q[0]") == 1
