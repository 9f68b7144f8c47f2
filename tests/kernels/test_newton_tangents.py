"""Tangents that a system gives: Newton's method takes them in place of differences, for the same steps."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from tests.problems import functions_of, oblique_pendulum, oblique_start, unconstrained, without_tangent, worst
from twoloop import ConstrainedSystem, RungeKutta, solve_dae
from twoloop.mechanisms import moderately_stiff_beam, very_flexible_beam
from twoloop.methods.plan import LEAST_ERROR
from twoloop.methods.tableaux import gauss, radau_iia
from twoloop.run import workspace as workspace_module

NEWTON = RungeKutta(radau_iia(3), outer="newton")
STIFFNESS, DAMPING = 1e4, 30.0
COPIES = 5  # of the mechanism in one system: the least that banded algebra has room for
START = (np.tile([1.0, 0.0, 2.0, 0.0], COPIES), np.tile([0.0, 3.0, 0.0, -2.0], COPIES))


def _of_spring(q, v):
    d, u = q[2:] - q[:2], v[2:] - v[:2]
    length = np.sqrt(d @ d)
    return d / length, u, length, np.eye(2) - np.outer(d, d) / length**2


def spring_force(t, q, v):
    """A mass on a rigid rod, a second one on a damped spring from the first."""
    n, u, length, _ = _of_spring(q, v)
    pull = (STIFFNESS * (length - 1.0) + DAMPING * (n @ u)) * n
    return np.concatenate([pull - [0.0, 9.81], -pull - [0.0, 9.81]])


def spring_by_q(t, q, v):
    n, u, length, across = _of_spring(q, v)
    stretched = STIFFNESS * (np.outer(n, n) + (length - 1.0) / length * across)
    turned = DAMPING * (np.outer(n, across @ u) + (n @ u) * across) / length
    return np.kron(np.array([[-1.0, 1.0], [1.0, -1.0]]), stretched + turned)


def spring_by_v(t, q, v):
    n, _, _, _ = _of_spring(q, v)
    return np.kron(np.array([[-1.0, 1.0], [1.0, -1.0]]), DAMPING * np.outer(n, n))


def rod_by_q(t, q, lam):
    return np.diag([lam[0], lam[0], 0.0, 0.0])


TANGENTS = {"force_by_q": spring_by_q, "force_by_v": spring_by_v}


def spring(calls=None, **given):
    """COPIES of the mechanism with the tangents given, and in `calls` how often each of its functions was called."""
    calls = {} if calls is None else calls

    def counted(kind, function):
        def call(t, *arrays):
            calls[kind] = calls.get(kind, 0) + 1
            parts = [function(t, *each) for each in zip(*(np.split(array, COPIES) for array in arrays), strict=True)]
            return block_diag(*parts) if parts[0].ndim == 2 else np.concatenate(parts)

        return call

    functions = {
        "force": spring_force,
        "constraint": lambda t, q: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)]),
        "jacobian": lambda t, q: np.array([[q[0], q[1], 0.0, 0.0]]),
        "gamma": lambda t, q, v: np.array([-(v[0] * v[0] + v[1] * v[1])]),
        **given,
    }
    counting = {kind: counted(kind, function) for kind, function in functions.items()}
    sizes = {"n_q": 4 * COPIES, "n_c": COPIES, "bandwidth": 3}
    mass = np.kron(np.eye(COPIES), np.eye(4) + 0.1)
    return ConstrainedSystem.from_python(mass=mass, name="spring", **sizes, **counting)


def test_tangents_of_a_system_whose_mass_varies():
    given = oblique_pendulum()
    n = given.n_q

    def differenced(which):
        def tangent(t, q, v):
            moved = {"q": lambda e: given.force(t, q + e, v), "v": lambda e: given.force(t, q, v + e)}[which]
            return np.column_stack([(moved(e) - moved(-e)) / 2e-5 for e in 1e-5 * np.eye(n)])

        return tangent

    tangents = {"force_by_q": differenced("q"), "force_by_v": differenced("v")}
    system = ConstrainedSystem.from_python(n_q=n, n_c=given.n_c, **functions_of(given), **tangents)
    runs = [solve_dae(s, (0.0, 1.0), *oblique_start(), NEWTON, step_size=0.01) for s in (given, system)]
    assert all(run.success for run in runs) and worst(runs[0].q, runs[1].q) < 1e-9
    assert runs[1].stats.n_outer < 2 * runs[0].stats.n_outer


@pytest.mark.parametrize(
    ("banded", "reaction"), [(False, {}), (True, {"reaction_by_q": rod_by_q})], ids=["rod differenced", "rod given"]
)
def test_tangents_replace_differences(monkeypatch, banded, reaction):
    monkeypatch.setattr(workspace_module, "banded_pays", lambda *sizes: banded)
    calls = {"differences": {}, "tangents": {}}
    runs = {
        "differences": solve_dae(spring(calls["differences"]), (0.0, 0.15), *START, NEWTON, step_size=5e-3),
        "tangents": solve_dae(
            spring(calls["tangents"], **TANGENTS, **reaction), (0.0, 0.15), *START, NEWTON, step_size=5e-3
        ),
    }
    assert all(run.success for run in runs.values()), [run.message for run in runs.values()]
    assert worst(runs["tangents"].q, runs["differences"].q) < 1e-10
    counts = {name: run.stats for name, run in runs.items()}
    assert counts["tangents"].n_jacobians > 1 and calls["tangents"]["force_by_q"] >= counts["tangents"].n_jacobians
    assert calls["tangents"]["force_by_v"] >= counts["tangents"].n_jacobians
    assert counts["tangents"].n_outer < 1.2 * counts["differences"].n_outer
    # no evaluation goes into derivatives: 3 an iteration, 1 at the midpoint for every Jacobian, 1 a step
    spent = 3 * counts["tangents"].n_outer + counts["tangents"].n_jacobians + counts["tangents"].n_accepted
    assert counts["tangents"].n_evaluations <= spent + 1
    assert counts["tangents"].n_evaluations < counts["differences"].n_evaluations


def test_compiled_tangents_are_the_same():
    def force(t, q, v):
        return 1e6 * np.array([q[1] - q[0], q[0] - q[1]]) - math.sin(t)  # the sine of NumPy 1.24 rounds otherwise

    def by_q(t, q, v):
        return np.array([[-1.0, 1.0], [1.0, -1.0]]) * 1e6

    systems = [unconstrained(force, 2, force_by_q=by_q, compile=compile) for compile in (False, True)]
    runs = [solve_dae(system, (0.0, 1.0), [0.0, 0.0], [1.0, 1.0], NEWTON, 1e-6, 1e-6) for system in systems]
    assert worst(runs[0].q[:, -1], runs[1].q[:, -1]) < 1e-9
    assert runs[0].stats.n_evaluations == runs[1].stats.n_evaluations and runs[1].stats.n_jacobians > 0


@pytest.mark.parametrize("n_elements", [4, 16])
def test_beam_with_its_tangent_makes_the_steps_it_makes_without(n_elements):
    runs = [
        solve_dae(problem.system, (0.0, 0.02), problem.q0, problem.v0, NEWTON, step_size=1e-3)
        for problem in (very_flexible_beam(n_elements), without_tangent(very_flexible_beam(n_elements)))
    ]
    assert all(run.success for run in runs) and worst(runs[0].q, runs[1].q) < 1e-9
    assert runs[0].stats.n_outer <= 1.05 * runs[1].stats.n_outer


def test_tangent_saves_evaluations_on_the_stiff_beam():
    # with steps so long that every other one needs a new Jacobian
    spent = [
        solve_dae(p.system, (0.0, 0.5), p.q0, p.v0, NEWTON, 1e-1, 1e-1).stats
        for p in (moderately_stiff_beam(), without_tangent(moderately_stiff_beam()))
    ]
    assert spent[0].n_evaluations < 0.7 * spent[1].n_evaluations


def test_the_trend_saves_rejections(monkeypatch):
    rejected = {}
    plan = RungeKutta.plan
    for trend in (True, False):
        monkeypatch.setattr(
            RungeKutta,
            "plan",
            lambda self, *a, least=LEAST_ERROR if trend else 0.0: replace(plan(self, *a), least_error=least),
        )
        problem = very_flexible_beam()  # with a system plans are kept
        result = solve_dae(problem.system, (0.0, 0.5), problem.q0, problem.v0, NEWTON, 1e-3, 1e-3)
        rejected[trend] = result.stats.n_rejected_error
    assert rejected[True] < 0.8 * rejected[False]


def test_steps_stay_where_little_would_be_gained():
    problem = very_flexible_beam()
    method = RungeKutta(gauss(5), outer="newton")
    h = solve_dae(problem.system, (0.0, 0.2), problem.q0, problem.v0, method, 1e-3, 1e-3).h
    assert np.mean(np.isclose(h[1:], h[:-1], rtol=1e-9)) > 0.4
