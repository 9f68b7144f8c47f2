"""Test the outer loop by Newton's method: the steps of sweeps, stiff problems, tangents that a system gives."""

from functools import cache
from itertools import product

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag

from tests.compiled import SPRUNG_START, sprung_pair
from tests.marks import slow, slow_but
from tests.problems import (
    G,
    moving_pivot,
    moving_pivot_state,
    oblique_pendulum,
    oblique_start,
    unconstrained,
    violations,
    without_tangent,
    worst,
)
from twoloop import ConstrainedSystem, RungeKutta, solve_dae
from twoloop.mechanisms import four_bar, moderately_stiff_beam, very_flexible_beam
from twoloop.methods.tableaux import gauss, lobatto_iiie, radau_iia, sun_radau_iib
from twoloop.run import workspace as workspace_module

TABLEAUX = {
    tableau.name: tableau
    for tableau in (*map(gauss, (1, 3, 4, 8)), radau_iia(2), radau_iia(3), sun_radau_iib(3), lobatto_iiie(4))
}
QUICK = ("Gauss(3)", "Radau IIA(3)", "Sun Radau IIB(3)")
SPRING_TIMES = np.linspace(0.0, 1.0, 5)


@cache
def stiff_spring_truth(stiffness):
    """q at SPRING_TIMES by SciPy's Radau on the equations for (angle of the rod, x, y of the second mass)."""

    def rate(t, y):
        (angle, x, z), u = y[:3], y[3:]
        d = np.array([x - np.cos(angle), z - np.sin(angle)])
        pull = stiffness * (1.0 - 1.0 / np.hypot(*d)) * d
        return np.concatenate([u, [np.array([-np.sin(angle), np.cos(angle)]) @ (pull - [0.0, G])], -pull - [0.0, G]])

    start = [0.0, 2.0, 0.0, 0.0, 0.0, 0.0]
    y = solve_ivp(rate, (0.0, 1.0), start, "Radau", rtol=1e-10, atol=1e-12, t_eval=SPRING_TIMES).y
    return np.array([np.cos(y[0]), np.sin(y[0]), y[1], y[2]])


@pytest.mark.parametrize("name", slow_but(QUICK, TABLEAUX))
@pytest.mark.parametrize("system", ["constant mass", "mass and damping that vary"])
def test_newton_and_sweeps_make_the_same_steps(name, system):
    if system == "constant mass":
        problem = moving_pivot(), *moving_pivot_state(0.0)
    else:
        problem = oblique_pendulum(), *oblique_start()
    runs = [
        solve_dae(problem[0], (0.0, 1.0), *problem[1:], RungeKutta(TABLEAUX[name], outer=outer), step_size=0.025)
        for outer in ("fixed-point", "newton", "auto")
    ]
    assert all(run.success for run in runs)
    assert worst(runs[1].q, runs[0].q) < 1e-10 and worst(runs[1].v, runs[0].v) < 1e-9
    assert (runs[2].q == runs[0].q).all()  # nothing stiff here


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Radau IIA(3)", "Gauss(4)"])
def test_a_stiff_spring(name):
    truth = stiff_spring_truth(1e6)
    errors, evaluations = [], []
    for tol in (1e-4, 1e-6, 1e-8):
        method = RungeKutta(TABLEAUX[name], outer="newton")
        result = solve_dae(sprung_pair(1e6), (0.0, 1.0), *SPRUNG_START, method, tol, tol, t_eval=SPRING_TIMES)
        assert result.success, result.message
        assert max(violations(sprung_pair(1e6), result)) < 1e-12
        errors.append(worst(result.q, truth))
        evaluations.append(result.stats.n_evaluations)
    assert errors[0] < 1e-3 and errors[1] < 1e-5 and errors[2] < 1e-7
    assert evaluations[0] < 6_000  # sweeps: more than 30 000 at any tolerance


# --- outer="auto"


def test_auto_pays_for_no_derivatives_where_nothing_is_stiff(tol=1e-6):
    problem = four_bar()
    runs = [
        solve_dae(problem.system, (0.0, 10.0), problem.q0, problem.v0, RungeKutta(sun_radau_iib(3), outer=o), tol, tol)
        for o in ("fixed-point", "auto")
    ]
    assert runs[1].stats.n_evaluations < 1.1 * runs[0].stats.n_evaluations
    assert np.allclose(runs[1].h[:20], runs[0].h[:20], rtol=1e-5)  # until it may try


def test_auto_does_not_crawl_on_the_stiff_beam():
    problem = moderately_stiff_beam()
    spent = {}
    for outer in ("fixed-point", "auto", "newton"):
        method = RungeKutta(radau_iia(3), outer=outer)
        result = solve_dae(problem.system, (0.0, 0.05), problem.q0, problem.v0, method, 1e-2, 1e-2)
        assert result.success
        spent[outer] = result.stats.n_evaluations
    assert spent["auto"] < 0.4 * spent["fixed-point"] and spent["newton"] < 0.1 * spent["fixed-point"]


def test_auto_takes_newton_where_a_fixed_step_does_not_converge_by_sweeps():
    method = {outer: RungeKutta(radau_iia(3), outer=outer) for outer in ("fixed-point", "auto")}
    run = {o: solve_dae(sprung_pair(1e8), (0.0, 0.1), *SPRUNG_START, m, step_size=1e-3) for o, m in method.items()}
    assert not run["fixed-point"].success
    assert run["auto"].success, run["auto"].message


def dragged_and_bouncing(t, q, v, p):
    return np.array([p[0] * (np.cos(3.0 * t) - v[0]), -9.81 + 0.5 * p[1] * (abs(q[1]) - q[1]), 0.0])


def bounced(stiffness, t):
    """Height of a mass that begins at 1 with velocity 0.3, after one contact with a spring below 0."""
    speed, rate = np.sqrt(0.09 + 2.0 * G), np.sqrt(stiffness)
    contact = 2.0 * (np.pi - np.arctan(speed * rate / G)) / rate
    flight = t - (0.3 + speed) / G - contact
    return speed * flight - 0.5 * G * flight**2


@pytest.mark.parametrize(
    ("method", "tol"),
    [
        slow(RungeKutta(radau_iia(3), outer="newton", tested="positions"), 1e-10),
        slow("ESDIRK4", 1e-6),
        slow("TRBDF2", 1e-9),
        slow("ESDIRK4", 1e-4),
    ],
)
def test_a_stiff_damper_does_not_hide_what_a_contact_leaves_in_the_velocities(method, tol):
    """Steps into and out of the contact are so short that the damper decides how long their error seems to last."""
    third_at_zero = {"constraint": lambda t, q: q[2:], "jacobian": lambda t, q: np.array([[0.0, 0.0, 1.0]])}
    system = unconstrained(dragged_and_bouncing, 3, n_c=1, parameters=[1.0, 1.0], compile=True, **third_at_zero)
    errors = []
    for damping, stiffness in product((1e4, 1e5, 1e6), repeat=2):
        start = (0.0, 0.8), [0.0, 1.0, 0.0], [1.0, 0.3, 0.0]
        result = solve_dae(system.with_parameters([damping, stiffness]), *start, method, tol, tol)
        errors.append(abs(result.q[1, -1] - bounced(stiffness, 0.8)) if result.success else np.inf)
    # 12 and 73; 990 and 303 where all of an error is taken to last as long as its fastest part.
    # ESDIRK4: 54 and 50; 1124 and 4700 without its second embedded formula
    assert max(errors) < 150.0 * tol


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


def spring(**tangents):
    """COPIES of the mechanism, with the tangents given."""

    def copied(function):
        def call(t, *arrays):
            parts = [function(t, *each) for each in zip(*(np.split(array, COPIES) for array in arrays), strict=True)]
            return block_diag(*parts) if parts[0].ndim == 2 else np.concatenate(parts)

        return call

    functions = {
        "force": spring_force,
        "constraint": lambda t, q: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)]),
        "jacobian": lambda t, q: np.array([[q[0], q[1], 0.0, 0.0]]),
        "gamma": lambda t, q, v: np.array([-(v[0] * v[0] + v[1] * v[1])]),
    }
    functions = {kind: copied(function) for kind, function in (functions | tangents).items()}
    sizes = {"n_q": 4 * COPIES, "n_c": COPIES, "bandwidth": 3}
    return ConstrainedSystem.from_python(mass=np.kron(np.eye(COPIES), np.eye(4) + 0.1), **sizes, **functions)


@pytest.mark.parametrize(("banded", "reaction"), [slow(False, {}), slow(True, {"reaction_by_q": rod_by_q})])
def test_tangents_replace_differences(monkeypatch, banded, reaction):
    monkeypatch.setattr(workspace_module, "banded_pays", lambda *sizes: banded)
    systems = spring(), spring(force_by_q=spring_by_q, force_by_v=spring_by_v, **reaction)
    without, run = (solve_dae(system, (0.0, 0.15), *START, NEWTON, step_size=5e-3) for system in systems)
    assert without.success and run.success and worst(run.q, without.q) < 1e-10
    assert run.stats.n_jacobians > 1 and run.stats.n_outer < 1.2 * without.stats.n_outer
    # no evaluation goes into derivatives: 3 an iteration, 1 at the midpoint for every Jacobian, 1 a step
    spent = 3 * run.stats.n_outer + run.stats.n_jacobians + run.stats.n_accepted
    assert run.stats.n_evaluations <= spent + 1 and run.stats.n_evaluations < without.stats.n_evaluations


def test_beam_with_its_tangent_makes_the_steps_it_makes_without(n_elements=16):
    runs = [
        solve_dae(problem.system, (0.0, 0.02), problem.q0, problem.v0, NEWTON, step_size=1e-3)
        for problem in (very_flexible_beam(n_elements), without_tangent(very_flexible_beam(n_elements)))
    ]
    assert all(run.success for run in runs) and worst(runs[0].q, runs[1].q) < 1e-9
    assert runs[0].stats.n_outer <= 1.05 * runs[1].stats.n_outer
