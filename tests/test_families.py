"""Code that is traced once for systems that share callbacks: with any parameters it is what they would get alone."""

import cProfile
import gc
import math
import pstats
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.compiled import centripetal, heavy, radius
from twoloop import ConstrainedSystem, callback, solve_dae
from twoloop.generate.compiled_series import compiled_series
from twoloop.generate.families import _alone, family_of
from twoloop.generate.known_numbers import Known
from twoloop.generate.straight_code import own_code
from twoloop.generate.straight_line import StraightLine
from twoloop.generate.traced_values import Traced
from twoloop.kernels.compile.caches import Newest
from twoloop.mechanisms import (
    andrews,
    bricard,
    driven_crank,
    four_bar,
    governor,
    redundant_slider_crank,
    spatial_four_bar,
)
from twoloop.methods.code_for import code_for, is_small
from twoloop.methods.presets import PRESETS

MECHANISMS = [four_bar, andrews, driven_crank, redundant_slider_crank, spatial_four_bar, bricard, governor]
SPAN = (0.0, 1.0)


@callback("force")
def spring(t, q, v, p, Q):
    Q[0] = -p[1] * q[0] - p[2] * v[0]
    Q[1] = -p[0] * 9.81


@callback("constraint")
def circle(t, q, p, C):
    C[0] = 0.5 * (q[0] ** 2 + q[1] ** 2 - p[3] ** 2)


@callback("force")
def by_what_is_left(t, q, v, p, Q):
    Q[0], Q[1] = -(p[1] % 1.0) * q[0], -p[0] * 9.81


@callback("force")
def by_whole_part(t, q, v, p, Q):
    Q[0], Q[1] = -math.floor(10.0 * p[1]) * q[0], -p[0] * 9.81


@callback("force")
def by_threshold(t, q, v, p, Q):
    Q[0], Q[1] = (-10.0 * q[0] if p[1] > 1.5001 else 0.0), -p[0] * 9.81


def pendulum(parameters, force=spring):
    return ConstrainedSystem(
        n_q=2, n_c=1, mass=heavy, force=force, constraint=circle, jacobian=radius, gamma=centripetal,
        parameters=parameters,
    )  # fmt: skip


def run(system, compiled="auto", method="auto"):
    return solve_dae(system, SPAN, [system.parameters[3], 0.0], [0.0, 0.5], method, 1e-10, 1e-10, compiled=compiled)


@callback("force")
def by_sum(t, q, v, p, Q):
    Q[0], Q[1] = -(p[0] + p[1]) * q[0] + p[0] * v[1], -p[0] * 9.81


@callback("force")
def by_loop(t, q, v, p, Q):
    """A root by Newton's method, which there is for p[1] < 1 only."""
    x = 1.0
    while abs(x * x + p[1] - 1.0) > 1e-10:
        x = x - 0.5 * (x * x + p[1] - 1.0) / x
    Q[0], Q[1] = -x * q[0], -p[0] * 9.81


@callback("force")
def by_quadrature(t, q, v, p, Q):
    total = 0.0
    for i in range(2000):
        total += math.sin(p[1] * (i + 0.5) / 2000.0) / 2000.0
    Q[0], Q[1] = -total * q[0], -p[0] * 9.81


@callback("force")
def by_iteration(t, q, v, p, Q):
    x = 1.0
    for _ in range(400):
        x = math.cos(p[1] * x)
    Q[0], Q[1] = -x * q[0], -p[0] * 9.81


@callback("force")
def by_root(t, q, v, p, Q):
    """Of what is negative for p[1] > 1, as the number may be with which it is traced."""
    Q[0], Q[1] = -math.sqrt(1.0 - p[1] * p[1]) * q[0], -p[0] * 9.81


@callback("force")
def by_knock(t, q, v, p, Q):
    """A blow late in the run, above a threshold."""
    Q[0], Q[1] = 0.0, -p[0] * 9.81
    if p[1] > 1.5:
        Q[0] = 50.0 * np.exp(-((t - 0.77) ** 2) * 1e5)


@callback("force")
def by_arrays(t, q, v, p, Q):
    Q[0], Q[1] = -np.sqrt(p)[1] * q[0], -p[0] * 9.81


PARAMETERS = [
    *([1.3, 2.7, 0.4, 1.9], [2.6, 1.4, 0.1, 1.7], [1.3, 1.3, 0.4, 1.9], [1.3, -1.3, 0.4, 1.9], [2.0, 2.7, 0.0, 1.9]),
    *([2.0, -1.0, 0.5, 1.0], [0.7, 0.7, 0.7, 0.7], [1e-3, 2.5e4, 0.3, 1.1]),
]


@pytest.mark.parametrize("method", ["auto", "DOP853", "Taylor"])
@pytest.mark.parametrize("parameters", PARAMETERS, ids=str)
def test_a_run_is_what_it_is_without_code(parameters, method):
    made, expected = (run(pendulum(parameters), compiled, method) for compiled in ("auto", False))
    assert made.success and expected.success and made.compiled and expected.compiled is False
    assert np.abs(made.q[:, -1] - expected.q[:, -1]).max() < 1e-7


@pytest.mark.parametrize("make", [*MECHANISMS[:-1], pytest.param(governor, marks=pytest.mark.slow)])
def test_numbers_of_other_parameters_are_those_that_are_traced_for_them(make):
    problem, random = make(), np.random.default_rng(2)
    system = problem.system
    own_code(system, 0.0, problem.q0)  # for which the family is traced
    p = system.parameters
    varies = p != np.round(p)
    other = system.with_parameters(np.where(varies, p * random.uniform(0.98, 1.02), p))
    code = own_code(other, 0.0, problem.q0)
    assert (code.shared.family is own_code(system, 0.0, problem.q0).shared.family) or not varies.any()
    expected = StraightLine(other, code.shared.equations.choice, _alone(other).equations(other))
    near = np.array([problem.q0, problem.v0]) + random.uniform(-0.1, 0.1, (5, 2, system.n_q))
    states = np.column_stack([np.linspace(0.0, 0.1, 5), near.reshape(5, -1)])
    assert code.traced.wrong(other, states) is None and expected.traced.wrong(other, states) is None


@pytest.mark.parametrize("first", [1e-14, 5e-324, 1e30, 1.3000000001, 0.4])
def test_what_ran_before_has_no_part_in_it(first):
    """Parameters that are alike, tiny or huge once are told apart all the same."""
    run(pendulum([1.3, first, 0.4, 1.9], by_sum))
    system = pendulum([1.3, 0.31, 0.4, 1.9], by_sum)
    made, expected = run(system, method="DOP853"), run(system, compiled=False, method="DOP853")
    assert np.abs(made.q[:, -1] - expected.q[:, -1]).max() < 1e-11


@pytest.mark.parametrize("force", [by_loop, by_quadrature, by_iteration, by_arrays, by_root, by_knock])
@pytest.mark.parametrize("parameter", [0.995, 0.7, 1.0 - 2.0**-30])
@pytest.mark.parametrize("whole", [2.0, 1.3])
def test_callbacks_that_make_no_formulas_run_all_the_same(force, parameter, whole):
    system = pendulum([whole, parameter + 0.5 * (force is by_knock), 0.4, 1.9], force)
    made, expected = run(system), run(system, compiled=False, method="DOP853")
    assert made.success and np.abs(made.q[:, -1] - expected.q[:, -1]).max() < 1e-7


@pytest.mark.parametrize("force", [by_what_is_left, by_whole_part, by_threshold])
@pytest.mark.parametrize("stiffness", [1.5, 1.52, 2.25])
def test_what_is_no_formula_of_the_parameters_is_traced_for_each(force, stiffness):
    for value in (1.37, stiffness):
        system = pendulum([1.3, value, 0.4, 1.9], force)
        made, expected = run(system), run(system, compiled=False)
        assert np.abs(made.q[:, -1] - expected.q[:, -1]).max() < 1e-7


def test_whole_equal_and_opposite_parameters_stay_so():
    families = [family_of(pendulum(each)) for each in PARAMETERS[:5]]
    assert families[0] is families[1] and len({*map(id, families)}) == 4
    assert families[3].parameters[0] == -families[3].parameters[1]
    assert type(families[4].parameters[0]) is float and families[4].parameters[2] == 0.0


def test_nothing_is_traced_for_the_next_parameters(monkeypatch):
    start = np.array([1.9, 0.0])
    own_code(pendulum(PARAMETERS[0]), 0.0, start)
    monkeypatch.setattr("twoloop.generate.straight_code.StraightLine", None)
    code = own_code(pendulum(PARAMETERS[0]).with_parameters([1.4, 2.9, 0.5, 1.9]), 0.0, start)
    compiled_series(code)


def test_what_else_was_made_of_a_family_costs_nothing():
    system = bricard().system
    family = family_of(system)
    formulas = [each for each in family.parameters if type(each) is Known][:9]

    def calls_for(array):
        evaluate, profile = family.evaluator(system.parameters), cProfile.Profile()
        profile.runcall(evaluate, array)
        return pstats.Stats(profile).total_calls

    few = np.array(formulas[:2], dtype=object)
    many = np.array([one * other for one in formulas for other in formulas], dtype=object)
    calls_for(few)
    alone = calls_for(few)
    assert calls_for(many) > alone and calls_for(few) == alone


def test_garbage_is_collected_again_when_something_was_made():
    family = family_of(four_bar().system)

    def fail():
        assert not gc.isenabled()
        raise ValueError

    for on in (True, False):
        (gc.enable if on else gc.disable)()
        try:
            with pytest.raises(ValueError):
                family.remembered(object(), fail)
            assert gc.isenabled() is on
        finally:
            gc.enable()


def test_threads_trace_one_family_one_after_another(monkeypatch):
    monkeypatch.setattr("twoloop.generate.families._FAMILIES", Newest())
    lengths = np.linspace(1.1, 1.9, 8) + 0.013

    def end(length, compiled="auto"):
        problem = four_bar(lengths=(1.0, 2.0, float(length)))
        result = solve_dae(
            problem.system, (0.0, 0.5), problem.q0, problem.v0, rtol=1e-10, atol=1e-10, compiled=compiled
        )
        return result.q[:, -1]

    with ThreadPoolExecutor(4) as pool:
        made = list(pool.map(end, lengths))
    expected = [end(length, compiled=False) for length in lengths]
    assert np.abs(np.array(made) - np.array(expected)).max() < 1e-7


def check(traced: Traced) -> None:
    """Accept what was traced."""


def test_code_that_is_left_open_goes_to_small_mechanisms_of_compiled_callbacks():
    plain = ConstrainedSystem.from_python(n_q=1, n_c=0, mass=np.eye(1), force=lambda t, q, v: -q)
    system, q0 = pendulum(PARAMETERS[0]), np.array([1.9, 0.0])
    assert is_small(system) and not is_small(plain)
    sizes = {make.__name__: is_small(make().system) for make in MECHANISMS}
    assert sizes["four_bar"] and sizes["andrews"] and not sizes["bricard"] and not sizes["governor"]

    def made(method="auto", fixed=False, compiled="auto"):
        return code_for(system, PRESETS[method], fixed, compiled, 0.0, q0, check)

    assert made() is not None and made("DOP853") is not None
    assert made("RadauIIA5") is made(fixed=True) is made(compiled=False) is None
