"""Accelerations by dependent coordinates: those of the callbacks, in fewer operations, also where a pivot vanishes."""

import ctypes
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import null_space

from tests.bodies.random_models import Both
from tests.marks import slow
from tests.problems import assert_same, quick, worst
from twoloop import mechanisms, solve_dae
from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.generate import compile_equations
from twoloop.generate.compile_equations import generated_code, write_accelerations, write_function
from twoloop.generate.elimination import Elimination, PivotChoice
from twoloop.generate.lane_series import LaneEmitter
from twoloop.generate.llvm_text import BIT, Module
from twoloop.generate.program import Coefficients
from twoloop.kernels.compile.generated_functions import GeneratedFunctions, object_code
from twoloop.kernels.lanes.layout import LANES
from twoloop.kernels.linalg.dependent_columns import NONE, NUMBER, VARIES, choose_dependent_columns, scratch_sizes

pytestmark = pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")

READY = ["four_bar", "andrews", "spatial_slider_crank", "redundant_slider_crank"]
READY += ["sundials_slider_crank", "driven_slider_crank", "driven_crank", "n_four_bar", "spatial_four_bar", "bricard"]
READY += ["governor", "heavy_top", "closed_chain", "double_pendulum", "pendulum", "knife_edge", "rolling_disc"]
KIND = BIT, ["double", *["double*"] * 4]


def function_of(module, name, *kinds):
    """A function of a module, on numbers and arrays."""
    made = GeneratedFunctions([name], object_code(str(module)))
    function = ctypes.CFUNCTYPE(ctypes.c_bool, *kinds)(made.addresses[name])
    return lambda *given, made=made: function(*(x if isinstance(x, float) else x.ctypes.data for x in given))


def on_arrays(address, n_arrays=4):
    return ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_double, *[ctypes.c_void_p] * n_arrays)(address)


class Code:
    """`own_accelerate` of a system, and a function of the few operations alone."""

    def __init__(self, system, q0):
        self.code, self.n = generated_code(system, 0.0, q0), system.n_q
        self.equations = self.code.shared.equations
        self.there = on_arrays(self.code.shared.functions.addresses["own_accelerate"])
        self.quick = None
        if self.equations.reduced_program is not None:
            module, numbers = Module(), self.code.shared.numbers
            kind = BIT, ["double*"] * 5
            write_function(module, "quick", kind, self.equations.reduced_program, numbers)
            self.quick = function_of(module, "quick", *[ctypes.c_void_p] * 5)

    def at(self, t, q, v):
        """Whether all code holds, and a; whether the few operations hold."""
        a, b = np.full((2, self.n), np.nan)
        arrays = np.ascontiguousarray(q), np.ascontiguousarray(v), self.code.numbers
        holds = self.there(t, *(x.ctypes.data for x in (*arrays, a)))
        fast = self.quick is not None and self.quick(np.array([t]), *arrays, b)
        if fast:
            assert worst(a, b) <= 1e-9 * np.abs(a).max()
        return holds, a, fast


def by_callbacks(system, rows, t, q, v):
    """a by dense linear algebra, for the rows that count."""
    n, m = system.n_q, len(rows)
    matrix = np.zeros((n + m, n + m))
    G = system.rows(t, q)[rows]
    kinds = [kind for kind, size in (("gamma", system.n_c), ("nonholonomic_gamma", system.n_a)) if size]
    gamma = np.concatenate([system.evaluate(kind, t, q, v) for kind in kinds])
    matrix[:n, :n], matrix[n:, :n], matrix[:n, n:] = system.mass(t, q), G, G.T
    return np.linalg.solve(matrix, [*system.force(t, q, v), *gamma[rows]])[:n]


def agrees(code, system, t, q, v, accuracy=1e-9):
    """Whether the few operations serve there; with or without them a is that of the callbacks."""
    expected = by_callbacks(system, list(code.equations.choice.rows), t, q, v)
    holds, a, fast = code.at(t, q, v)
    assert holds and np.abs(a - expected).max() < accuracy * max(1.0, np.abs(expected).max())
    return fast


@pytest.mark.parametrize("name", quick(READY, 4))
def test_accelerations_are_those_of_the_callbacks(name):
    """At a start and about it, with any velocities."""
    problem, rng = getattr(mechanisms, name)(), np.random.default_rng(1)
    system, code = problem.system, Code(problem.system, problem.q0)
    fast = []
    for _ in range(10):
        q = problem.q0 + 1e-2 * rng.standard_normal(system.n_q) * np.abs(problem.q0)
        v = problem.v0 + rng.standard_normal(system.n_q) * max(1e-3, np.abs(problem.v0).max())
        fast.append(agrees(code, system, 0.1, q, v))
    assert all(fast) == (code.quick is not None) == any(fast)


@pytest.mark.parametrize(
    ("planar", "kinds"),
    [
        slow(True, ["revolute"] * 4),
        (True, ["revolute"] * 3 + ["prismatic"]),
        slow(False, ["revolute", "spherical", "universal", "revolute"]),
        slow(False, ["revolute", "cylindrical", "spherical", "prismatic"]),
    ],
)
def test_so_are_those_of_random_loops_of_bodies(planar, kinds):
    """The code for all of them is made for one start."""
    for seed in range(3):
        both, n = Both(seed, planar, len(kinds) - 1), len(kinds) - 1
        for k, kind in enumerate(kinds):
            getattr(both, kind)(None if k == 0 else k - 1, None if k == n else k)
        problem = both.model.problem((0.0, 1.0))
        system, rng = problem.system, np.random.default_rng(seed)
        code, free = Code(system, problem.q0), null_space(system.jacobian(0.0, problem.q0))
        assert code.quick is not None
        for _ in range(3):
            assert agrees(code, system, 0.0, problem.q0, free @ rng.standard_normal(free.shape[1]))


@pytest.mark.parametrize(
    ("name", "span"), quick([("four_bar", 5.0), ("spatial_slider_crank", 2.0), ("spatial_four_bar", 2.0)], 2)
)
def test_where_a_pivot_vanishes_on_the_way_the_same_accelerations_are_found(name, span):
    """And on both sides of it by few operations, whatever the sign of the pivot is."""
    problem = getattr(mechanisms, name)()
    system, code = problem.system, Code(problem.system, problem.q0)
    known = solve_dae(system, (0.0, span), problem.q0, problem.v0, t_eval=np.linspace(0.0, span, 801))
    fast = [agrees(code, system, t, q, v, 1e-8) for t, q, v in zip(known.t, known.q.T, known.v.T, strict=True)]
    assert fast[0] and 0.85 < np.mean(fast) < 1.0
    assert True in fast[fast.index(False) :]


def test_a_run_goes_on_where_a_pivot_vanishes():
    """Two bars that depend on the third lie in one line on the way."""
    problem = mechanisms.four_bar()
    with_code, without = (
        solve_dae(problem.system, (0.0, 10.0), problem.q0, problem.v0, "DOP853", 1e-9, 1e-9, compiled=compiled)
        for compiled in (True, False)
    )
    error = np.abs(without.q[:, -1] - problem.reference.q).max()
    assert np.abs(with_code.q[:, -1] - problem.reference.q).max() < max(1e-8, 3.0 * error)
    assert abs(with_code.stats.n_evaluations - without.stats.n_evaluations) < 0.02 * without.stats.n_evaluations


COUNTS = {"four_bar": (90, 152), "andrews": (220, 318), "redundant_slider_crank": (55, 120)}
COUNTS |= {"spatial_slider_crank": (715, 1705), "spatial_four_bar": (850, 1622)}


COUNTS |= dict.fromkeys(["pendulum", "double_pendulum", "heavy_top", "closed_chain", "rolling_disc"], (None, None))


@pytest.mark.parametrize(("name", "most", "mass_first"), [(name, *counts) for name, counts in COUNTS.items()])
def test_they_take_fewer_operations_unless_few_coordinates_depend(name, most, mass_first):
    problem = getattr(mechanisms, name)()
    equations = generated_code(problem.system, 0.0, problem.q0).shared.equations
    if most is None:
        assert equations.reduced_program is None
        return
    quick_ones, all_of_them = (
        len(equations.graph.quantities_for(outputs.arrays["a"]))
        for outputs in (equations.reduced_program, equations.mass_first_program)
    )
    assert quick_ones <= most < all_of_them <= mass_first
    assert len(equations.reduced_program.quantities()) < 0.8 * len(equations.mass_first_program.quantities())


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 8), st.integers(0, 3), st.integers(0, 10**6))
def test_pivots_are_one_for_each_row_and_not_small(m, freedom, seed):
    """Of random rows, a third of whose entries are not zero, half of these numbers."""
    rng, n = np.random.default_rng(seed), m + freedom
    G = rng.standard_normal((m, n)) * (rng.random((m, n)) < 0.4)
    kinds = np.where(G == 0.0, NONE, np.where(rng.random((m, n)) < 0.5, NUMBER, VARIES))
    numbers, integers = scratch_sizes(m, n)
    out, work = np.zeros(4 * m, np.int64), np.zeros(integers, np.int64)
    count = choose_dependent_columns(G, kinds.ravel(), np.arange(m), m, np.zeros(numbers), work, out)
    if count == 0:
        assert np.linalg.svd(G)[1][-1] < 0.3
        return
    blocks = out[: 4 * count].reshape(count, 4).tolist()
    rows = [i for block in blocks for i in dict.fromkeys(block[:2])]
    columns = [j for block in blocks for j in dict.fromkeys(block[2:])]
    assert sorted(rows) == list(range(m)) and len(set(columns)) == m
    assert np.linalg.svd(G[:, columns])[1][-1] > 1e-6
    numbers_first = [kinds[i, j] == NUMBER for i, j in zip(rows, columns, strict=True)]
    assert not (kinds == NUMBER).all(axis=None) or all(numbers_first)


def test_neighbouring_starts_have_the_same_code_and_any_start_its_own():
    """A call gets the code of its start, whatever ran before it."""
    problem = mechanisms.four_bar()
    known = solve_dae(problem.system, (0.0, 5.0), problem.q0, problem.v0, t_eval=np.linspace(0.0, 5.0, 201))
    blocks = [PivotChoice.choose(problem.system, t, q).blocks for t, q in zip(known.t, known.q.T, strict=True)]
    assert 1 < len(set(blocks)) <= 3  # pairs of three bars
    assert sum(one != other for one, other in pairwise(blocks)) < 20
    crank = mechanisms.spatial_slider_crank()  # Euler parameters that are 0 are not after rounding
    assert len({PivotChoice.choose(crank.system, 0.0, crank.q0 + x) for x in (0.0, 1e-15)}) == 1
    first = next(k for k, each in enumerate(blocks) if each != blocks[0])
    starts = [0, 1, 0, first, first, 0, first, first + 1, 2]

    def runs(systems):
        return [
            solve_dae(system, (0.0, 0.2), known.q[:, k], known.v[:, k], "DOP853", compiled=True)
            for system, k in zip(systems, starts, strict=True)
        ]

    repeated = runs([problem.system] * len(starts))
    for one, other in zip(repeated, runs([mechanisms.four_bar().system for _ in starts]), strict=True):
        assert_same(one, other)


def test_in_lanes_no_run_depends_on_those_beside_it():
    """One lane has a pivot that vanishes, one has no values."""
    problem = mechanisms.four_bar()
    system, n = problem.system, problem.system.n_q
    known = solve_dae(system, (0.0, 5.0), problem.q0, problem.v0, t_eval=np.linspace(0.0, 5.0, 801))
    equations = Elimination(system, PivotChoice.choose(system, 0.0, problem.q0))
    module, numbers = Module(), Coefficients()
    for outputs in equations.accelerations:
        list(numbers.structure(outputs))
    builder = module.function("in_lanes", "void", ["double*"] * 3)
    emit = LaneEmitter(builder)
    states, emit.constants, out = builder.arguments
    emit.numbers = emit.constants
    for _ in range(2):  # the second goes on where the first ends
        inputs = [emit.load(states, i) for i in range(1 + 2 * n)]
        a, holds = write_accelerations(emit, equations, inputs, numbers)
        for i, value in enumerate([*a, builder.select(holds, emit.constant(1.0), emit.constant(0.0))]):
            emit.store(value, out, i)
    builder.ret(None)
    assert str(module).count("define internal") == 1
    in_lanes = function_of(module, "in_lanes", *[ctypes.c_void_p] * 3)

    def values(which):
        given = np.vstack([known.t[which], known.q[:, which], known.v[:, which]])
        filled = np.zeros((n + 1, LANES))
        given[:, np.array(which) < 0] = np.nan
        in_lanes(np.ascontiguousarray(given), numbers.values, filled)
        return filled

    code = Code(system, problem.q0)
    fast = [code.at(t, q, v)[2] for t, q, v in zip(known.t, known.q.T, known.v.T, strict=True)]
    fails = fast.index(False)
    among = [0, 10, fails, -1, 20, 30, 40, 50][:LANES]
    alone, together = values([0, 10, 10, 10, 20, 30, 40, 50][:LANES]), values(among)
    easy = [k for k in range(LANES) if k not in (2, 3)]
    np.testing.assert_array_equal(alone[:, easy], together[:, easy])
    assert together[-1].tolist() == [1.0, 1.0, 1.0, 0.0, *[1.0] * (LANES - 4)]
    rows = list(equations.choice.rows)
    for k, place in enumerate(among):
        if place >= 0:
            expected = by_callbacks(system, rows, known.t[place], known.q[:, place], known.v[:, place])
            assert np.abs(together[:n, k] - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("inertia", quick([2e-5, 1e-6]))
def test_little_inertia_on_long_bars(inertia):
    """A parallelogram of bars whose mass is in their middle: its coupler does not turn."""
    A, B, C, D = (0.0, 0.0), (40.0, -60.0), (170.0, -60.0), (130.0, 0.0)
    model = PlanarModel()
    for name, a, b in (("left", A, B), ("coupler", B, C), ("right", D, C)):
        model.body(name, mass=1.5, inertia=inertia, position=(0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])))
    for a, b, at in (("ground", "left", A), ("left", "coupler", B), ("coupler", "right", C), ("right", "ground", D)):
        model.revolute(a, b, at=at)
    problem = model.problem((0.0, 5.0))
    result = solve_dae(problem.system, (0.0, 5.0), problem.q0, problem.v0, compiled=True, rtol=1e-9, atol=1e-9)
    assert result.success and np.abs(result.a[5]).max() < 1e-9 and result.stats.n_rejected_error < 10


def rescale(problem, power, is_refined, monkeypatch):
    """Make code with other scales of the rows added to M, which cost digits that no pivot shows."""
    choice = PivotChoice.choose(problem.system, 0.0, problem.q0)
    changed = replace(choice, scales=tuple(2.0**power * scale for scale in choice.scales), is_refined=is_refined)
    monkeypatch.setattr(PivotChoice, "choose", lambda *position: changed)


def test_digits_that_a_projection_loses_are_found(monkeypatch):
    """Accelerations alone are right there: they take other pivots."""
    problem = mechanisms.spatial_slider_crank()
    rescale(problem, 45, False, monkeypatch)
    with pytest.raises(ValueError, match="loses the digits of little inertia"):
        generated_code(problem.system, 0.0, problem.q0)


@pytest.mark.parametrize("longest", [0, np.inf], ids=["in parts", "in one"])
@pytest.mark.parametrize(("power", "holds"), [(9, True), (24, False)])
def test_results_that_refinement_changes_much_are_invalid(power, holds, longest, monkeypatch):
    problem, n = mechanisms.spatial_four_bar(), 21
    rescale(problem, power, True, monkeypatch)
    for name, value in (("LARGEST_LOSS", np.inf), ("SPLIT_PROJECTIONS", longest), ("SPLIT_ALL", longest)):
        monkeypatch.setattr(compile_equations, name, value)
    code = generated_code(problem.system, 0.0, problem.q0)
    project = on_arrays(code.shared.functions.addresses["own_project"], 8)
    given, results = (problem.q0, np.linspace(0.5, 1.5, n), code.numbers), np.zeros((5, n))
    assert project(0.0, *(x.ctypes.data for x in (*given, *results))) == holds


@pytest.mark.parametrize(
    ("pin", "offset", "rounding"),
    [(0.0, (3.0, 1.5, -1.0), 1e-13), (0.0, (0.0, 0.0, 0.0), 1e-13), (100.0, (1e-4, 2e-4, -1e-4), 2e-12)],
)
def test_little_inertia_far_from_a_joint_or_about_it(pin, offset, rounding):
    """Without refinement, or with one scale for all rows added to M, the equations hold to 3e-8 of their terms only.

    Near a joint far from the origin, rounding of C turns the bob: the last correction has to be left out.
    """
    model, motion = SpatialModel(), {"position": np.add(pin, offset), "angular_velocity": (1.0, 2.0, 3.0)}
    bob = model.body("bob", mass=1e4, inertia=(1e-5, 2e-5, 1.5e-5), **motion)
    model.spherical("ground", bob, at=(pin, pin, pin))
    model.spring(bob, np.add(pin, (0.2, 0.1, 0.3)), "ground", np.add(pin, (1.0, 2.0, 0.5)), stiffness=20.0, damping=0.1)
    problem = model.problem((0.0, 0.01))
    for method in ("auto", "DOP853"):
        result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, method, compiled=pin == 0.0)
        assert result.success and result.stats.n_rejected_error < 100
        for t, q, v, a, lam in zip(result.t, *(x.T for x in (result.q, result.v, result.a, result.lam)), strict=True):
            M, GT, Q = problem.system.mass(t, q), problem.system.jacobian(t, q).T, problem.system.force(t, q, v)
            left, terms = M @ a + GT @ lam - Q, abs(M) @ abs(a) + abs(GT) @ abs(lam) + abs(Q)
            assert (np.abs(left) <= rounding * (terms + 1.0)).all()
