"""Code made for the equations of one mechanism: against the general inner loop, dense linear algebra and references."""

import ctypes
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from tests.problems import pendulum, quick, unconstrained, worst
from twoloop import ConstraintWarning, mechanisms
from twoloop.generate.compile_equations import generated_code, write_function
from twoloop.generate.graph import Graph
from twoloop.generate.llvm_code import LARGEST_ANGLE
from twoloop.generate.llvm_text import Module
from twoloop.generate.null_space import Factors
from twoloop.generate.program import Coefficients, Program
from twoloop.kernels.compile.generated_functions import GeneratedFunctions, object_code
from twoloop.kernels.data.indices import DONE, USED_GENERAL
from twoloop.kernels.evaluation import tasks
from twoloop.kernels.evaluation.inner_loop import generated_inner_loop
from twoloop.methods.presets import PRESETS
from twoloop.run.run import Run
from twoloop.solve import solve_dae

MECHANISMS = [mechanisms.four_bar, mechanisms.andrews, mechanisms.driven_crank, mechanisms.redundant_slider_crank]
MECHANISMS += [mechanisms.heavy_top, mechanisms.governor, mechanisms.bricard, mechanisms.spatial_four_bar]
MECHANISMS += [mechanisms.knife_edge, mechanisms.rolling_disc]
ending_at_a_reference = pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")


@njit
def _inner(f, w, task, t, q, v, theta, a, lam):
    return f.inner(f, w, task, t, q, v, theta, a, lam)


def inner(run, task, t, q, v):
    """What an inner loop makes of a state: code, q, v, a and lam."""
    q, v, a, lam = q.copy(), v.copy(), np.zeros_like(q), np.zeros(run.work.Rate.size)
    return _inner(run.kit, run.work, task, t, q, v, 1e-14, a, lam), q, v, a, lam


def run_of(problem, compiled):
    return run_from(problem.system, problem.q0, problem.v0, compiled)


def run_from(system, q0, v0, compiled):
    plan = PRESETS["DOP853"].plan(system.n_q, 1e-8, 1e-8, False)
    if compiled:
        own = generated_code(system, 0.0, q0)
        plan = replace(plan, inner=generated_inner_loop, own=(own.shared.functions,), numbers=own.numbers)
    return Run(system, plan, 0.0, q0, v0, 1e-8, np.full(system.n_q, 1e-8), None)


@ending_at_a_reference
@pytest.mark.parametrize("make", quick(MECHANISMS, 4))
def test_accelerations_off_the_constraints_are_those_of_the_general_inner_loop(make):
    problem, rng = make(), np.random.default_rng(3)
    general, own = (run_of(problem, compiled) for compiled in (False, True))
    for _ in range(5):
        q = problem.q0 + 1e-4 * rng.standard_normal(problem.q0.size)
        v = problem.v0 + 1e-2 * rng.standard_normal(problem.q0.size)
        if general.rank < general.work.Rate.size:  # off the constraints it matters which of redundant rows are kept
            _, q, v, *_ = inner(general, tasks.PROJECT, 0.1, q, v)
        expected, known = (inner(run, tasks.EVALUATE_WITHOUT_PROJECTION, 0.1, q, v) for run in (general, own))
        assert known[0] == expected[0] == DONE
        assert worst(known[3], expected[3]) < 1e-9 * max(1.0, np.abs(expected[3]).max())


@ending_at_a_reference
@pytest.mark.parametrize("make", [mechanisms.four_bar, mechanisms.rolling_disc])
def test_the_general_inner_loop_moves_a_state_to_the_nearest_on_the_constraints(make):
    check_projection(make, False)


@ending_at_a_reference
@pytest.mark.parametrize("make", [*quick(MECHANISMS[:-2], 4), *MECHANISMS[-2:]])
def test_a_state_is_moved_to_the_nearest_on_the_constraints(make):
    check_projection(make, True)


def check_projection(make, compiled):
    problem, rng = make(), np.random.default_rng(4)
    system, run = problem.system, run_of(problem, compiled)
    q0 = problem.q0 + 1e-6 * rng.standard_normal(problem.q0.size)
    v0 = problem.v0 + 1e-3 * rng.standard_normal(problem.q0.size)
    code, q, v, a, lam = inner(run, tasks.PROJECT, 0.0, q0, v0)
    assert code == DONE and run.work.notes[USED_GENERAL] == 0.0  # not by the general inner loop
    M, G = system.mass(0.0, q), system.jacobian(0.0, q)
    rate = system.constraint_rate(0.0, q)
    if system.n_a:
        G, rate = np.vstack([G, system.nonholonomic(0.0, q)]), np.append(rate, np.zeros(system.n_a))
    assert np.abs(system.constraint(0.0, q)).max(initial=0.0) < 1e-13 * max(1.0, np.abs(q).max())
    assert np.abs(G @ v + rate).max() < 1e-11 * max(1.0, np.abs(G).max() * np.abs(v).max())
    # nearest in the metric of M that rows of A allow: what was taken away is M^-1 G^T times something
    tangents = np.linalg.svd(G)[2][run.rank :].T
    for move, scale in ((q - q0, 1e-4), (v - v0, 1e-9 if compiled else 1e-4)):  # once, or as often as positions
        assert np.abs(tangents.T @ M @ move).max() < scale * np.abs(M @ move).max() + 1e-15
    force = system.force(0.0, q, v)
    size = max(1.0, np.abs(force).max(), np.abs(G.T @ lam).max())
    assert np.abs(M @ a + G.T @ lam - force).max() < 1e-10 * size
    if run.rank < len(lam):  # of least norm
        assert np.abs(np.linalg.svd(G.T)[2][run.rank :] @ lam).max() < 1e-8 * np.abs(lam).max()


@ending_at_a_reference
@pytest.mark.parametrize("make", quick(MECHANISMS, 4))
def test_a_run_ends_at_its_reference_by_as_many_evaluations(make):
    # the governor, the sixth, is stiff: by DOP853 it takes as long as all others together
    problem, method = make(), ("DOP853", "Adams")[MECHANISMS.index(make) % 2]
    known = problem.reference
    span = (0.0, min(known.t, 10.0))
    with_code, without = (
        solve_dae(problem.system, span, problem.q0, problem.v0, method, 1e-9, 1e-9, compiled=compiled)
        for compiled in (True, False)
    )
    assert with_code.success, with_code.message
    error = np.nanmax(np.abs(with_code.q[:, -1] - known.q))
    assert error < max(1e-8, 3.0 * np.nanmax(np.abs(without.q[:, -1] - known.q)))
    assert with_code.stats.n_evaluations < 1.1 * without.stats.n_evaluations
    for t, q in zip(with_code.t, with_code.q.T, strict=True):
        assert np.abs(problem.system.constraint(t, q)).max(initial=0.0) < 1e-12


@pytest.mark.parametrize("method", ["DOP853", "Adams", "Taylor"])
def test_a_mass_that_is_not_definite_any_more_is_said_as_without(method):
    """A mass that falls to nothing at t = 1, without a force."""

    def run(compiled):
        system = unconstrained(lambda t, q, v: np.zeros(2), 2, mass=lambda t, q: np.array([[1.0, 0.1], [0.1, 1.0 - t]]))
        return solve_dae(system, (0.0, 2.0), [0.0, 0.0], [1.0, 1.0], method, 1e-6, 1e-6, compiled=compiled)

    general, own = run(False), run(True)
    assert not own.success and own.status is general.status and own.t[-1] == pytest.approx(general.t[-1], abs=1e-3)


def test_near_a_singular_position_the_general_inner_loop_takes_over():
    """A pin on two guides, y = 0 and y = a x: the rows become parallel as a goes to 0."""

    def system(slope):
        return unconstrained(
            lambda t, q, v: np.array([0.1, 0.2, -1.0]),
            3,
            n_c=2,
            constraint=lambda t, q: np.array([q[1], q[1] - slope * (1.0 - t) * q[0]]),
            jacobian=lambda t, q: np.array([[0.0, 1.0, 0.0], [-slope * (1.0 - t), 1.0, 0.0]]),
            constraint_rate=lambda t, q: np.array([0.0, slope * q[0]]),
            gamma=lambda t, q, v: np.array([0.0, -2.0 * slope * v[0]]),
        )

    q = v = np.zeros(3)
    run = run_from(system(1.0), q, v, True)
    assert inner(run, tasks.PROJECT, 0.5, q, v)[0] == DONE and run.work.notes[USED_GENERAL] == 0.0
    assert inner(run, tasks.PROJECT, 0.9999, q, v)[0] == DONE and run.work.notes[USED_GENERAL] == 1.0


def test_redundant_rows_that_stop_holding_end_the_run():
    def system(drift):
        return pendulum(
            n_c=2,
            constant_mass=True,
            force=lambda t, q, v: np.array([1.0, 0.0]),
            constraint=lambda t, q: np.array([q[1], 2.0 * q[1] - drift * t * t * t]),
            jacobian=lambda t, q: np.array([[0.0, 1.0], [0.0, 2.0]]),
            constraint_rate=lambda t, q: np.array([0.0, -3.0 * drift * t * t]),
            gamma=lambda t, q, v: np.array([0.0, 6.0 * drift * t]),
        )

    with pytest.warns(ConstraintWarning):
        held = solve_dae(system(0.0), (0.0, 1.0), [0.0, 0.0], [1.0, 0.0], "DOP853", compiled=True)
        broken = solve_dae(system(0.1), (0.0, 1.0), [0.0, 0.0], [1.0, 0.0], "DOP853", compiled=True)
    assert held.success and not broken.success and broken.status.name == "ROWS_CONTRADICT"


# --- forms of a graph as machine code: elimination, sines and cosines to rounding, derivatives of every operation
def read_by(program):
    """The coefficients that code for a program reads."""
    numbers = Coefficients()
    list(numbers.structure(program))
    return numbers


def compute(program, inputs, divided=False):
    """What code for a program gives: whether its conditions hold, and the arrays."""
    numbers = read_by(program)
    filled = tuple(np.full(len(forms), np.nan) for forms in program.arrays.values())
    return machine_code_of(program, numbers, divided)(*inputs, numbers.values, *filled), filled


def machine_code_of(program, numbers, divided=False):
    """What Python calls, on arrays, for a function of LLVM."""
    module, n = Module(divided), len(program.graph.input_sizes) + 1 + len(program.arrays)
    write_function(module, "function", ("i1", ["double*"] * n), program, numbers)
    assert ("blockaddress" in str(module)) is divided
    made = GeneratedFunctions(["function"], object_code(str(module)))
    function = ctypes.CFUNCTYPE(ctypes.c_bool, *[ctypes.c_void_p] * n)(made.addresses["function"])

    def call(*given, made=made):
        arrays = [np.atleast_1d(each) for each in given]
        return function(*(each.ctypes.data for each in arrays))

    return call


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
    assert all(evaluated(form, known) > 0.0 for form in factors.mass_pivots)


def evaluated(form, known):
    """The number that a form of sums, products and quotients is."""
    for i in Program(form.graph, {"": [form]}).quantities():
        kind, first, second = form.graph.operations[i]
        x = first.constant + sum(c * known[j] for j, c in first.terms.items())
        y = 1.0 if second is None else second.constant + sum(c * known[j] for j, c in second.terms.items())
        known[i] = 1.0 / x if kind == 1 else x * y
    return form.constant + sum(c * known[j] for j, c in form.terms.items())


@pytest.mark.parametrize("size", [1.0, 1e3, 0.9 * LARGEST_ANGLE])
def test_sine_and_cosine_are_right_to_rounding(size):
    graph = Graph()
    (angle,) = graph.inputs(1, False)
    program = Program(graph, {"of": [angle.sine(), angle.cosine()]})
    numbers = read_by(program)
    function, values = machine_code_of(program, numbers), numbers.values
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
    program = Program(graph, {"of": [x.sine() * y]})
    assert compute(program, (np.array([1.0, 2.0]),))[0]
    for each in ([2.0 * LARGEST_ANGLE, 1.0], [math.nan, 1.0], [1.0, math.inf], [1.0, math.nan]):
        holds, (filled,) = compute(program, (np.array(each),))
        assert not holds
        assert np.isnan(filled).all()  # nothing was written
