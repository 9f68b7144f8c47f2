"""Forms of a graph as machine code: elimination, sines and cosines to rounding, derivatives of every operation."""

import ctypes
import gc
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.problems import worst
from twoloop.generate import llvm_text
from twoloop.generate.choices import Choice
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.derivative import Derivative
from twoloop.generate.llvm_text import Module
from twoloop.generate.llvm_trigonometry import LARGEST_ANGLE
from twoloop.generate.straight_code import write_function
from twoloop.generate.straight_line import Outputs, Solution, StraightLine
from twoloop.generate.symbolic_factors import Factors
from twoloop.generate.tracing import Form, Graph
from twoloop.kernels.compile.own_functions import CALLED, OwnFunctions, object_code
from twoloop.mechanisms import andrews, four_bar, heavy_top, spatial_four_bar


def read_by(graph, outputs):
    """The numbers that code for some outputs reads."""
    numbers = Coefficients()
    list(numbers.structure(graph, outputs.forms))
    return numbers


def compute(graph, outputs, inputs, divided=False):
    """What code for some outputs gives: whether its conditions hold, and the arrays."""
    numbers = read_by(graph, outputs)
    filled = tuple(np.full(len(forms), np.nan) for forms in outputs.arrays.values())
    return machine_code_of(graph, outputs, numbers, divided)(*inputs, numbers.values, *filled), filled


def machine_code_of(graph, outputs, numbers, divided=False):
    """What Python calls, on arrays, for a function of LLVM."""
    module, n = Module(divided), len(graph.sizes) + 1 + len(outputs.arrays)
    write_function(module, "function", ("i1", ["double*"] * n), graph, outputs, numbers)
    assert ("blockaddress" in str(module)) is divided
    made = OwnFunctions(["function"], object_code(str(module)))
    function = ctypes.CFUNCTYPE(ctypes.c_bool, *[ctypes.c_void_p] * n)(made.addresses["function"])

    def call(*given, made=made):
        arrays = [np.atleast_1d(each) for each in given]
        return function(*(each.ctypes.data for each in arrays))

    return call


@pytest.mark.parametrize("make", [four_bar, andrews, heavy_top, spatial_four_bar])
def test_code_in_divided_blocks_gives_the_same_numbers(make, monkeypatch):
    monkeypatch.setattr(llvm_text, "LONGEST", 50)
    problem = make()
    system = problem.system
    equations = StraightLine(system, Choice.at(system, 0.0, problem.q0))
    state = (0.0, problem.q0, problem.v0)
    for outputs in (equations.there, equations.nearer, Solution(equations).kept):
        (holds, whole), (holds_too, divided) = (
            compute(equations.graph, outputs, state, each) for each in (False, True)
        )
        assert holds and holds_too
        for one, other in zip(whole, divided, strict=True):
            np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9 * np.abs(one).max(initial=1.0))


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 7), st.integers(0, 4), st.integers(0, 10**6))
def test_elimination_solves_what_dense_linear_algebra_solves(n, m, seed):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.4)
    matrix = np.zeros((n + m, n + m))
    matrix[:n, :n] = root @ root.T + np.diag(1.0 + rng.random(n))
    G = np.eye(m, n)[:, rng.permutation(n)] * 2.0 + 0.3 * rng.standard_normal((m, n)) * (rng.random((m, n)) < 0.5)
    m = min(m, n)
    matrix, G = matrix[: n + m, : n + m], G[:m]
    matrix[n:, :n], matrix[:n, n:] = G, G.T
    graph = Graph()
    given = graph.inputs(matrix.size, False)
    right = graph.inputs(n + m, False)
    forms = {
        (i, j): given[i * (n + m) + j] for i in range(n + m) for j in range(n + m) if matrix[i, j] != 0.0 or i == j < n
    }
    factors = Factors(forms, n + m, n)
    b = rng.standard_normal(n + m)
    known = dict(enumerate(np.concatenate([matrix.ravel(), b]).tolist()))
    x = [evaluated(form, known) for form in factors.solve(right)]
    assert np.allclose(x, np.linalg.solve(matrix, b), rtol=1e-6, atol=1e-9) and len(factors.conditions) == m
    shares = [evaluated(one, known) / evaluated(other, known) for one, other in factors.conditions]
    assert all(0.0 < share < 1.0 + 1e-9 for share in shares)
    assert all(evaluated(form, known) > 0.0 for form in factors.positive)


def evaluated(form, known):
    """The number that a form of sums, products and quotients is."""
    for i in Outputs({"": [form]}, []).quantities(form.graph):
        kind, first, second = form.graph.operations[i]
        x = first.constant + sum(c * known[j] for j, c in first.terms.items())
        y = 1.0 if second is None else second.constant + sum(c * known[j] for j, c in second.terms.items())
        known[i] = 1.0 / x if kind == 1 else x * y
    return form.constant + sum(c * known[j] for j, c in form.terms.items())


@pytest.mark.parametrize("size", [1.0, 1e3, 0.9 * LARGEST_ANGLE])
def test_sine_and_cosine_are_right_to_rounding(size):
    graph = Graph()
    (angle,) = graph.inputs(1, False)
    outputs = Outputs({"of": [angle.sine(), angle.cosine()]}, [])
    numbers = read_by(graph, outputs)
    function, values = machine_code_of(graph, outputs, numbers), numbers.values
    rng = np.random.default_rng(6)
    angles = np.concatenate([size * rng.uniform(-1.0, 1.0, 20_000), np.arange(-50, 51) * np.pi / 4.0])
    found = np.zeros((angles.size, 2))
    for angle, pair in zip(angles, found, strict=True):
        function(np.array([angle]), values, pair)
    sines, cosines = found.T
    # of the C library: those of older NumPy are off by a rounding more
    assert worst(sines, np.array([math.sin(x) for x in angles])) < 2.3e-16
    assert worst(cosines, np.array([math.cos(x) for x in angles])) < 2.3e-16


def test_beyond_the_angles_that_it_takes_and_where_nothing_is_finite_it_says_so():
    graph = Graph()
    x, y = graph.inputs(2, False)
    outputs = Outputs({"of": [x.sine() * y]}, [])
    assert compute(graph, outputs, (np.array([1.0, 2.0]),))[0]
    for each in ([2.0 * LARGEST_ANGLE, 1.0], [math.nan, 1.0], [1.0, math.inf], [1.0, math.nan]):
        holds, (filled,) = compute(graph, outputs, (np.array(each),))
        assert not holds
        assert np.isnan(filled).all()  # nothing was written


@pytest.mark.parametrize("factor", [0.5, 1e-3, 1e3])
@pytest.mark.parametrize("in_one", [True, False])
def test_a_high_power_is_right_where_that_of_its_factor_is_beyond_what_numbers_hold(factor, in_one):
    graph = Graph()
    (x,) = graph.inputs(1, False)
    base = factor * (x + 1.0)
    power = base**2000 if in_one else math.prod([base] * 2000)
    values = (0.5, 1.0, 1.001)
    found = [evaluated(power, {0: value / factor - 1.0}) for value in values]
    np.testing.assert_allclose(found, [value**2000 for value in values], rtol=1e-9)


def test_the_derivative_of_every_operation():
    graph = Graph()
    (x,) = graph.inputs(1, False)
    laws = {
        "square root": (lambda x: (x + 2.0).square_root(), lambda x: math.sqrt(x + 2.0)),
        "exponential": (lambda x: (x * 0.5).exponential(), lambda x: math.exp(0.5 * x)),
        "sine": (lambda x: x.sine(), math.sin),
        "cosine": (lambda x: x.cosine(), math.cos),
        "logarithm": (lambda x: (x + 3.0).logarithm(), lambda x: math.log(x + 3.0)),
        "arctangent": (lambda x: x.arctangent(), math.atan),
        "quotient": (lambda x: x / (x * x + 1.0), lambda x: x / (x * x + 1.0)),
    }
    one = Form(graph, 1.0, {})
    for law, known in laws.values():
        slope = Derivative(graph, {0: one}).of(law(x))
        _, (value,) = compute(graph, Outputs({"slope": [slope]}, []), (np.array([0.7]),))
        e = 1e-5
        assert abs(value[0] - (known(0.7 + e) - known(0.7 - e)) / (2.0 * e)) < 1e-9


@pytest.mark.usefixtures("collected_alone")
def test_functions_that_others_call_are_those_they_were_linked_with_and_stay_in_memory():
    def constant(value):
        return OwnFunctions(["number"], object_code(f"define i64 @number() {{ ret i64 {value} }}"))

    text = f"""
        declare i64 @{CALLED}number()
        define i64 @twice() {{
            %x = call i64 @{CALLED}number()
            %y = add i64 %x, %x
            ret i64 %y
        }}
    """
    made = [OwnFunctions(["twice"], object_code(text), constant(value)) for value in (3, 4)]
    gc.collect()
    twice = [ctypes.CFUNCTYPE(ctypes.c_int64)(each.addresses["twice"]) for each in made]
    assert [each() for each in twice] == [6, 8]
