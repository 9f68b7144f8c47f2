"""Test Newton's method of large systems, by sparse factors in the fixed-order form, against the dense forms."""

import numpy as np
import pytest

import twoloop.run.workspace as workspace_module
from studies.bench.large import PLANAR, closed_chain, grid, ladder, open_chain, tree
from tests.kernels.random_assemblies import PlanarAssembly
from tests.large_systems import spatial_chain
from tests.marks import slow
from tests.problems import worst
from twoloop import ConstrainedSystem, solve_dae
from twoloop.kernels.linalg.symbolic_factorization import N_UPDATES
from twoloop.mechanisms import planar
from twoloop.run.run import Run


@pytest.fixture
def form(monkeypatch):
    """Sets whether the fixed-order form is taken, and counts how often a run leaves the form that it has."""
    left = []
    change = Run.change_form

    def noted(run):
        left.append(float(run.clock[run.a.T]))
        change(run)

    monkeypatch.setattr(Run, "change_form", noted)
    monkeypatch.setattr(workspace_module, "MAX_SHARE", 1e9)
    monkeypatch.setattr(workspace_module, "MAX_NEWTON_SHARE", 1e9)

    def choose(fixed_order):
        monkeypatch.setattr(workspace_module, "LARGE", 0 if fixed_order else 10**9)
        left.clear()
        return left

    monkeypatch.setattr(planar, "LARGE", 0)
    return choose


def sprung(bodies, q, pairs, extra=None):
    """The same planar bodies with torsion springs, dampers and dry friction between pairs of them, and drag."""
    one, other = 3 * np.array(pairs).T + 2
    rest = q[one] - q[other]
    system = bodies.system("bodies with springs")

    def force(t, q, v):
        Q, rate = system.force(t, q, v), v[one] - v[other]
        moment = 5.0 * (q[one] - q[other] - rest) + 1e-3 * rate + 1e-4 * np.tanh(10.0 * rate)
        np.add.at(Q, one, -moment)
        np.add.at(Q, other, moment)
        return Q - 1e-3 * v * np.abs(v) + (0.0 if extra is None else extra(q))

    return ConstrainedSystem.from_python(
        n_q=system.n_q,
        n_c=system.n_c,
        mass_values=system.mass_values(0.0, q),
        mass_entries=system.entries["mass"],
        force=force,
        constraint=system.constraint,
        jacobian_values=system.jacobian_values,
        jacobian_entries=system.entries["jacobian"],
        gamma=system.gamma,
        joints=system.joints,
    )


def chained(made):
    return sprung(made.bodies, made.q, [(k, k - 1) for k in range(1, len(made.q) // 3)]), made.q


def laddered(n):
    made = ladder(n)
    return sprung(made.bodies, made.q, [(k, k - 2) for k in range(2, 2 * (n // 3))]), made.q


def redundant(n):
    made = PlanarAssembly(5, n, 2, 2)
    return sprung(made.bodies, made.q, made.pairs[1:n]), made.q


CASES = {
    "open chain": lambda: chained(open_chain(12)),
    "closed chain": lambda: chained(closed_chain(12)),
    "ladder": lambda: laddered(12),
    "redundant rows": lambda: redundant(12),
}


def alike(one, other, allowed):
    assert worst(one.q[:, -1], other.q[:, -1]) < allowed
    assert worst(one.lam[:, -1], other.lam[:, -1]) < 1e3 * allowed * max(1.0, np.abs(one.lam[:, -1]).max())
    assert other.stats.n_outer <= 2.1 * one.stats.n_outer  # derivatives that miss something converge slowly
    assert other.stats.n_jacobians <= 1.5 * one.stats.n_jacobians + 2


SLOW_RUNS = [("closed chain", "TRBDF2", 1e-5, 1e-5), ("ladder", "TRBDF2", 1e-5, 1e-5)]
SLOW_RUNS += [("redundant rows", "RadauIIA9", 1e-10, 1e-9), ("open chain", "RadauIIA9", 1e-10, 1e-9)]
SLOW_RUNS += [("closed chain", "RadauIIA13", 1e-10, 1e-9), ("closed chain", "BDF", 1e-7, 1e-6)]


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize(("case", "method", "tolerance", "allowed"), [slow(*case) for case in SLOW_RUNS])
def test_runs_are_those_of_the_dense_forms(form, case, method, tolerance, allowed):
    ends = []
    for fixed_order in (False, True):
        left = form(fixed_order)
        system, q = CASES[case]()
        ends.append(solve_dae(system, (0.0, 0.03), q, 0.0 * q, method, tolerance, tolerance))
        assert ends[-1].success and left == []
    alike(*ends, allowed)


@pytest.mark.slow
def test_a_force_that_comes_up_between_others_is_found_missing(form):
    """A spring that couples two distant bars as soon as they have moved: no position at the start shows it."""
    made, n = open_chain(12), 12

    def past(x):
        return np.sign(x) * max(0.0, abs(x) - 0.15)

    def stop(q):
        Q = np.zeros(3 * n)
        one, other = past(q[5] - made.q[5]), past(2.0 * (q[3 * n - 1] - made.q[3 * n - 1]))
        Q[5], Q[3 * n - 1] = -4e4 * one - 2e4 * other, -2e4 * one - 4e4 * other
        return Q

    ends = []
    for fixed_order in (False, True):
        left = form(fixed_order)
        system = sprung(made.bodies, made.q, [(k, k - 1) for k in range(1, n)], stop)
        result = solve_dae(system, (0.0, 0.11), made.q, 0.0 * made.q, "RadauIIA9", 1e-2, 1e-2)
        assert result.success
        ends.append(result)
    assert len(left) == 1 and worst(ends[0].q[:, -1], ends[1].q[:, -1]) < 1e-2


def test_bodies_whose_mass_matrix_is_singular(form):
    ends = []
    for fixed_order in (False, True):
        left = form(fixed_order)
        system, q, v = spatial_chain(5)
        result = solve_dae(system, (0.0, 0.1), q, v, "RadauIIA9", 1e-9, 1e-9, compiled=False)
        assert result.success and left == []
        ends.append(result)
    assert worst(ends[0].q[:, -1], ends[1].q[:, -1]) < 1e-9


@pytest.mark.slow
def test_programs_grow_with_the_bodies_and_no_faster():
    """Multiplications of a factorization."""
    for make in PLANAR:
        updates = []
        for n in (99, 297):
            made = make(n)
            pairs = [(k, k - 1) for k in range(1, n)] if make is not tree else [(k, (k - 1) // 2) for k in range(1, n)]
            system = sprung(made.bodies, made.q, pairs[: 1 if make.__name__ in ("ladder", "star") else None])
            form = workspace_module.fixed_order_form(system, 0.0, made.q)
            form = workspace_module.add_newton_program(system, 0.0, made.q, form)
            updates.append(int(form.newton_program[N_UPDATES]))
            assert form.matrix_cost() < 3.0 + system.n_q / 8.0  # what a dense one is taken to cost
        assert updates[1] <= (5.2 if make is grid else 3.6) * updates[0]  # of a grid like n^1.5, at best
