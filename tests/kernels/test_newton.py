"""The outer loop by Newton's method: the same steps as sweeps make, and stiff problems that sweeps cannot make."""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.compiled import SPRUNG_START, sprung_pair, unit_mass
from tests.problems import G, moving_pivot, moving_pivot_state, oblique_pendulum, oblique_start, violations, worst
from twoloop import ConstrainedSystem, RungeKutta, callback, solve_dae
from twoloop.bodies import PlanarModel
from twoloop.mechanisms import four_bar, moderately_stiff_beam
from twoloop.methods.presets import PRESETS
from twoloop.methods.tableaux import gauss, lobatto_iiie, radau_iia, sun_radau_iib

TABLEAUX = {
    tableau.name: tableau
    for tableau in (*map(gauss, (1, 3, 4, 8)), radau_iia(2), radau_iia(3), sun_radau_iib(3), lobatto_iiie(4))
}
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


@pytest.mark.parametrize("name", TABLEAUX)
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


@pytest.mark.parametrize("name", ["Radau IIA(3)", "Gauss(4)", "Sun Radau IIB(3)"])
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


def test_stiffness_does_not_hold_radau_back():
    # 1000 times the frequency, and not ten times the steps
    counts = {}
    for stiffness in (1e2, 1e8):
        result = solve_dae(sprung_pair(stiffness), (0.0, 1.0), *SPRUNG_START, "RadauIIA5", 1e-4, 1e-4)
        assert result.success
        counts[stiffness] = result.stats.n_accepted
    assert counts[1e8] < 20 * counts[1e2]


def test_damping_enters_the_derivatives():
    # overdamped: without J_v Newton's method could not converge at these steps
    system = sprung_pair(1e4, 1.0)
    result = solve_dae(system, (0.0, 1.0), *SPRUNG_START, RungeKutta(radau_iia(3), outer="newton"), step_size=0.005)
    fine = solve_dae(system, (0.0, 1.0), *SPRUNG_START, RungeKutta(radau_iia(3), outer="newton"), step_size=0.001)
    assert result.success and fine.success and worst(result.q[:, -1], fine.q[:, -1]) < 1e-4
    assert result.stats.n_outer < 10 * result.stats.n_accepted


def test_derivatives_are_reused_while_newton_converges(default_four_bar):
    problem = default_four_bar
    result = solve_dae(problem.system, (0.0, 2.0), problem.q0, problem.v0, RungeKutta(gauss(3), outer="newton"))
    assert result.success and 0 < result.stats.n_jacobians < 0.7 * result.stats.n_accepted


# --- outer="auto"
def test_auto_is_the_default_of_sunradau5_and_newton_that_of_radau():
    assert PRESETS["SunRadau5"].outer == "auto" and PRESETS["RadauIIA5"].outer == "newton"


@pytest.mark.parametrize("tol", [1e-4, 1e-6, 1e-8])
def test_auto_pays_for_no_derivatives_where_nothing_is_stiff(tol):
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


@pytest.mark.parametrize("speed", [1e-5, 1e-4])
def test_newton_goes_on_from_where_friction_is_stiff(speed):
    """In the middle of the first step, by the accelerations at its beginning, the block would slide."""
    model = PlanarModel(gravity=(0.0, 0.0))
    block = model.box("block", (0.1, 0.1), mass=1.0, position=(0.0, 0.0))
    model.friction(model.prismatic("ground", block, at=(0.0, 0.0), axis=(1.0, 0.0)), 10.0, speed=speed)
    model.force(block, (0.0, 0.0), np.array([3.0, 0.0]))
    problem = model.problem((0.0, 0.5))
    start = problem.q0, [0.3 * speed, 0.0, 0.0]
    result = solve_dae(problem.system, problem.t_span, *start, "RadauIIA5", 1e-5, 1e-5, first_step=1e-3)
    assert result.success and result.stats.n_rejected_convergence < 2  # 3 to 5 with derivatives in the middle alone


@callback("force")
def dragged_and_bouncing(t, q, v, p, Q):
    Q[0] = p[0] * (np.cos(3.0 * t) - v[0])
    Q[1] = -9.81 + 0.5 * p[1] * (abs(q[1]) - q[1])


@callback("constraint")
def third_at_zero(t, q, p, C):
    C[0] = q[2]


@callback("jacobian")
def third_at_zero_by_q(t, q, p, Cq):
    Cq[0, 2] = 1.0


def bounced(stiffness, t):
    """Height of a mass that begins at 1 with velocity 0.3, after one contact with a spring below 0."""
    speed, rate = np.sqrt(0.09 + 2.0 * G), np.sqrt(stiffness)
    contact = 2.0 * (np.pi - np.arctan(speed * rate / G)) / rate
    flight = t - (0.3 + speed) / G - contact
    return speed * flight - 0.5 * G * flight**2


@pytest.mark.parametrize(
    ("method", "tol"),
    [
        (RungeKutta(radau_iia(3), outer="newton", tested="positions"), 1e-10),
        ("TRBDF2", 1e-9),
        ("ESDIRK4", 1e-4),
        ("ESDIRK4", 1e-6),
    ],
)
def test_a_stiff_damper_does_not_hide_what_a_contact_leaves_in_the_velocities(method, tol):
    """Steps into and out of the contact are so short that the damper decides how long their error seems to last."""
    errors = []
    for stiffness in (1e4, 1e5, 1e6):
        for damping in (1e4, 1e5, 1e6):
            system = ConstrainedSystem(
                n_q=3,
                n_c=1,
                mass=unit_mass,
                force=dragged_and_bouncing,
                constraint=third_at_zero,
                jacobian=third_at_zero_by_q,
                parameters=[damping, stiffness],
            )
            result = solve_dae(system, (0.0, 0.8), [0.0, 1.0, 0.0], [1.0, 0.3, 0.0], method, tol, tol)
            errors.append(abs(result.q[1, -1] - bounced(stiffness, 0.8)) if result.success else np.inf)
    # 12 and 73; 990 and 303 where all of an error is taken to last as long as its fastest part.
    # ESDIRK4: 54 and 50; 1124 and 4700 without its second embedded formula
    assert max(errors) < 150.0 * tol
