"""Code made for the equations of one mechanism: against the general inner loop, dense linear algebra and references."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from numba import njit

from tests.problems import pendulum, unconstrained, worst
from tests.processes import run_python
from twoloop import ConstraintWarning, callback, mechanisms
from twoloop.generate import parts_code
from twoloop.generate.choices import Choice
from twoloop.generate.straight_code import SharedCode, own_code
from twoloop.generate.straight_line import StraightLine
from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.noted import BY_GENERAL
from twoloop.kernels.evaluation import tasks
from twoloop.methods.presets import PRESETS
from twoloop.run.run import Run
from twoloop.solve import solve_dae

MECHANISMS = [
    mechanisms.four_bar,
    mechanisms.andrews,
    mechanisms.driven_crank,
    mechanisms.heavy_top,
    mechanisms.spatial_four_bar,
    mechanisms.governor,
    mechanisms.redundant_slider_crank,
    mechanisms.bricard,
    mechanisms.knife_edge,
    mechanisms.rolling_disc,
]
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
        own = own_code(system, 0.0, q0)
        plan = replace(plan, inner=own.shared.inner, own=(own.shared.functions,), numbers=own.numbers)
    return Run(system, plan, 0.0, q0, v0, 1e-8, np.full(system.n_q, 1e-8), None)


@ending_at_a_reference
@pytest.mark.parametrize("make", MECHANISMS)
def test_accelerations_off_the_constraints_are_those_of_the_general_inner_loop(make):
    problem, rng = make(), np.random.default_rng(3)
    general, own = (run_of(problem, compiled) for compiled in (False, True))
    for _ in range(5):
        q = problem.q0 + 1e-4 * rng.standard_normal(problem.q0.size)
        v = problem.v0 + 1e-2 * rng.standard_normal(problem.q0.size)
        if general.rank < general.work.Rate.size:  # off the constraints it matters which of redundant rows are kept
            _, q, v, *_ = inner(general, tasks.PROJECT, 0.1, q, v)
        expected, known = (inner(run, tasks.EVALUATE_THERE, 0.1, q, v) for run in (general, own))
        assert known[0] == expected[0] == DONE
        assert worst(known[3], expected[3]) < 1e-9 * max(1.0, np.abs(expected[3]).max())


@ending_at_a_reference
@pytest.mark.parametrize(
    "make", [make for make in MECHANISMS if make not in (mechanisms.knife_edge, mechanisms.rolling_disc)]
)
def test_a_state_is_moved_to_the_nearest_on_the_constraints(make):
    problem, rng = make(), np.random.default_rng(4)
    system, run = problem.system, run_of(problem, True)
    q0 = problem.q0 + 1e-6 * rng.standard_normal(problem.q0.size)
    v0 = problem.v0 + 1e-3 * rng.standard_normal(problem.q0.size)
    code, q, v, a, lam = inner(run, tasks.PROJECT, 0.0, q0, v0)
    assert code == DONE and run.work.notes[BY_GENERAL] == 0.0  # not by the general inner loop
    M, G = system.mass(0.0, q), system.jacobian(0.0, q)
    assert np.abs(system.constraint(0.0, q)).max() < 1e-13 * max(1.0, np.abs(q).max())
    assert np.abs(system.velocity_constraint(0.0, q, v)).max() < 1e-11 * max(1.0, np.abs(G).max() * np.abs(v).max())
    # nearest in the metric of M: what was taken away is M^-1 G^T times something
    tangents = np.linalg.svd(G)[2][run.rank :].T
    for move, scale in ((q - q0, 1e-4), (v - v0, 1e-9)):
        assert np.abs(tangents.T @ M @ move).max() < scale * np.abs(M @ move).max() + 1e-15
    force = system.force(0.0, q, v)
    size = max(1.0, np.abs(force).max(), np.abs(G.T @ lam).max())
    assert np.abs(M @ a + G.T @ lam - force).max() < 1e-10 * size
    if run.rank < len(lam):  # of least norm
        assert np.abs(np.linalg.svd(G.T)[2][run.rank :] @ lam).max() < 1e-8 * np.abs(lam).max()


@pytest.mark.parametrize("make", [mechanisms.four_bar, mechanisms.redundant_slider_crank, mechanisms.rolling_disc])
def test_equations_in_parts_give_the_same(make, monkeypatch):
    problem, rng = make(), np.random.default_rng(5)
    n, choice = problem.system.n_q, Choice.at(problem.system, 0.0, problem.q0)
    q = problem.q0 + 1e-6 * rng.standard_normal(n)
    v = problem.v0 + 1e-3 * rng.standard_normal(n)
    made = []
    for long in (10**6, 0):
        monkeypatch.setattr(parts_code, "LONG", long)
        code = SharedCode(StraightLine(problem.system, choice), None)
        assert (code.parts is not None) == (long == 0)
        plan = PRESETS["DOP853"].plan(n, 1e-8, 1e-8, False)
        plan = replace(plan, inner=code.inner, own=(code.functions,), numbers=code.numbers.values)
        run = Run(problem.system, plan, 0.0, problem.q0, problem.v0, 1e-8, np.full(n, 1e-8), None)
        for task in (tasks.EVALUATE_THERE, *([tasks.PROJECT] if code.projects else [])):
            run.work.notes[BY_GENERAL] = 0.0
            found = inner(run, task, 0.0, q, v)
            assert found[0] == DONE and run.work.notes[BY_GENERAL] == 0.0  # not by the general inner loop
            made.append(np.concatenate(found[1:]))
    half = len(made) // 2
    for one, other in zip(made[:half], made[half:], strict=True):
        assert np.abs(one - other).max() < 1e-10 * np.abs(one).max()


@ending_at_a_reference
@pytest.mark.parametrize("make", MECHANISMS)
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
    assert inner(run, tasks.PROJECT, 0.5, q, v)[0] == DONE and run.work.notes[BY_GENERAL] == 0.0
    assert inner(run, tasks.PROJECT, 0.9999, q, v)[0] == DONE and run.work.notes[BY_GENERAL] == 1.0


def test_stages_that_the_code_leaves_to_the_general_one():
    """Angles that are too large for its sines, so that none of its values is taken; rounding there is 1e-7."""
    problem = mechanisms.four_bar()
    q0 = problem.q0.copy()
    q0[2::3] += 2e8 * np.pi
    runs = [
        solve_dae(problem.system, (0.0, 1.0), q0, problem.v0, "DOP853", 1e-4, 1e-4, compiled=compiled)
        for compiled in (False, True)
    ]
    assert worst(runs[0].q[:, -1], runs[1].q[:, -1]) < 1e-4
    general, own = (run.stats.n_factorizations for run in runs)
    assert own > 0.9 * general  # where the mechanism's own code is taken, half of them


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


@callback("force")
def spring(t, q, v, p, Q):
    Q[0] = -p[0] * q[0]


def on_a_circle(radius, stiffness):
    """A bead on a circle, held by a spring, by functions that enclose numbers."""
    return pendulum(
        mass=np.diag([1.5, 1.5]),
        force=lambda t, q, v: np.array([-stiffness * (q[0] - 0.3), -9.81 - 0.2 * v[1]]),
        constraint=lambda t, q: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - radius * radius)]),
        gamma=False,
    )


@pytest.mark.parametrize("method", ["Taylor", "DOP853"])
def test_one_code_serves_all_numbers(method, monkeypatch):
    monkeypatch.setattr("twoloop.kernels.compile.own_functions._MADE", made := defaultdict(dict))
    for radius, stiffness in ((1.3, 7.0), (0.7, 11.0), (2.1, 3.0)):
        start = ([radius, 0.0], [0.0, 0.0], method, 1e-9, 1e-9)
        ends = [
            solve_dae(on_a_circle(radius, stiffness), (0.0, 1.0), *start, compiled=own).q[:, -1]
            for own in (True, False)
        ]
        assert np.allclose(*ends, rtol=0.0, atol=1e-8)
    assert len(made["equations"]) == 1


@pytest.fixture
def own_disk(monkeypatch, tmp_path):
    """A folder for code of this test alone: from that of the user other processes remove the oldest."""
    monkeypatch.setattr("twoloop.kernels.compile.own_functions.sources_folder", lambda: tmp_path)
    monkeypatch.setattr("twoloop.kernels.compile.own_functions._MADE", defaultdict(dict))
    return tmp_path


def test_a_second_process_compiles_nothing(own_disk, monkeypatch):
    monkeypatch.setattr("twoloop.generate.families._FAMILIES", {})  # without what another test has made
    problem = mechanisms.four_bar()
    solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0, "DOP853", compiled=True)
    program = """
        import sys
        from pathlib import Path
        from twoloop import solve_dae
        from twoloop.generate import written
        from twoloop.kernels.compile import own_functions
        from twoloop.mechanisms import four_bar

        def refuse(*given):
            raise AssertionError("compiled again")

        written.Written.operation = own_functions.object_code = refuse
        own_functions.sources_folder = lambda: Path(sys.argv[1])
        p = four_bar()
        solve_dae(p.system, (0.0, 0.1), p.q0, p.v0, "DOP853", compiled=True)
    """
    run_python(program, own_disk)
