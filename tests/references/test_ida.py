"""Test IDA without Python and on the beam: accuracy, the options that matter, failures, memory."""

from functools import cache

import numpy as np
import pytest
from numba import njit

from references.driver import Task
from references.sundials.ida import solve_ida, solve_ida_c
from references.sundials.residual import FORMS, Implicit, iteration_matrix_at, residual_at
from tests.marks import slow
from tests.problems import PLAIN, without_tangent
from twoloop import ConstrainedSystem, callback, consistent_state, solve_dae
from twoloop.mechanisms import double_pendulum, four_bar, moderately_stiff_beam, very_flexible_beam
from twoloop.mechanisms.ancf_beam import tip_height
from twoloop.problem.callbacks import callbacks_in
from twoloop.run.record import Status

PROBLEM, SMALL = four_bar(), double_pendulum()
# largest error of q at 1001 instants over 10 s: three times the largest of 15 runs that differ in rounding
BOUNDS = {1e-5: 5.4e-2, 1e-7: 1.3e-3, 1e-9: 2.4e-5, 1e-11: 3e-7}
SCALES = {"q": 1.0, "v": 10.0, "a": 250.0, "lam": 250.0}  # errors against those of q, about
# what the functions of the pendulum below do, most of it after t = 1: its parameter; the last three are NaN like NAN
GOOD, NAN, RAISES, SPRING, MASS, CONSTRAINT, JACOBIAN = range(7)


def run(t_end, tolerance, **options):
    return solve_ida_c(PROBLEM.system, (0.0, t_end), PROBLEM.q0, PROBLEM.v0, tolerance, tolerance, **options)


# --- a pendulum of 1 m whose pivot moves as 0.3 sin 4t along x: M is full and varies, Q depends on v, C on t
@callback("mass")
def mass(t, q, p, M):
    M[0, 0] = 1.0 + 0.1 * q[1] ** 2
    M[0, 1] = M[1, 0] = 0.2
    M[1, 1] = np.nan if t > 1.0 and p[0] == 4.0 else 1.0


@callback("force")
def force(t, q, v, p, Q):
    Q[0] = -0.1 * v[0] * abs(v[0])
    Q[1] = -9.81
    if p[0] == 3.0:
        Q[0] = -5.0 * q[0] * q[1] ** 2
    if t > 1.0 and p[0] == 1.0:
        Q[1] = np.nan
    if t > 1.0 and p[0] == 2.0:
        raise ValueError("the motor burnt out")


@njit
def spring_tangent(t, q, v, p, K):
    K[0, 0] += -5.0 * q[1] ** 2
    K[0, 1] += -10.0 * q[0] * q[1]


@callback("constraint")
def constraint(t, q, p, C):
    C[0] = 0.5 * ((q[0] - 0.3 * np.sin(4.0 * t)) ** 2 + q[1] ** 2 - 1.0)
    if t > 1.0 and p[0] == 5.0:
        C[0] = np.nan


@callback("jacobian")
def jacobian(t, q, p, Cq):
    Cq[0, 0] = q[0] - 0.3 * np.sin(4.0 * t)
    Cq[0, 1] = np.nan if t > 1.0 and p[0] == 6.0 else q[1]


@callback("constraint_rate")
def constraint_rate(t, q, p, Ct):
    Ct[0] = -1.2 * np.cos(4.0 * t) * (q[0] - 0.3 * np.sin(4.0 * t))


@cache
def pendulum(kind=GOOD):
    system = ConstrainedSystem(n_q=2, n_c=1, **callbacks_in(globals()), parameters=[kind], name="moving pivot")
    return system, *consistent_state(system, 0.0, [0.6, -0.8], [0.0, 0.0])


# --- accuracy
@pytest.mark.slow
@pytest.mark.parametrize("tolerance", BOUNDS)
def test_is_what_ida_does_through_python(tolerance):
    times = np.linspace(0.0, 10.0, 101)
    arguments = PROBLEM.system, (0.0, 10.0), PROBLEM.q0, PROBLEM.v0, "stabilised", tolerance, tolerance
    python, result = solve_ida(*arguments, t_eval=times), run(10.0, tolerance, t_eval=times)
    for name, scale in SCALES.items():
        mine, theirs = getattr(result, name), getattr(python, name)
        assert mine.shape == theirs.shape and np.abs(mine - theirs).max() < scale * BOUNDS[tolerance], name
    assert result.stats.n_evaluations == pytest.approx(python.stats.n_evaluations, rel=0.2)
    assert result.stats.n_factorizations == pytest.approx(python.stats.n_factorizations, rel=0.3)


@pytest.mark.slow
def test_moving_pivot_without_gamma_and_with_a_mass_that_varies():
    system, q0, v0 = pendulum()
    ours = solve_dae(system, (0.0, 3.0), q0, v0, rtol=1e-10, atol=1e-10)
    loose, tight = (solve_ida_c(system, (0.0, 3.0), q0, v0, tol, tol, t_eval=[1.0, 3.0]) for tol in (1e-6, 1e-10))
    errors = [np.abs(each.q[:, -1] - ours.q[:, -1]).max() for each in (loose, tight)]
    assert errors[1] < 1e-6 and errors[0] > 10.0 * errors[1], errors
    for mine, theirs in ((ours.v, tight.v), (ours.a, tight.a), (ours.lam, tight.lam)):
        assert np.abs(mine[:, -1] - theirs[:, -1]).max() < 1e-4


# the pendulum moves its pivot and has a mass that varies, of which the others have neither; the matrix of the double
# pendulum is compiled for the tests of adapters, too
@pytest.mark.parametrize(
    ("of", "form"),
    [
        ("double pendulum", "stabilised"),
        *[slow(of, form) for of in ("moving pivot", "four-bar", "exact tangent") for form in FORMS],
    ],
)
def test_jacobian_is_that_of_the_residual(of, form):
    ready = {"four-bar": PROBLEM, "double pendulum": SMALL}
    system = ready[of].system if of in ready else pendulum(SPRING if of == "exact tangent" else GOOD)[0]
    tangent = spring_tangent if of == "exact tangent" else None
    size = 2 * system.n_q + system.n_c * (1 if form == "index1" else 2)
    rng = np.random.default_rng(5)
    t, cj, y, yp = 0.3, 7.0, rng.normal(size=size), rng.normal(size=size)
    q, v, _ = np.split(y, [system.n_q, 2 * system.n_q])
    implicit = Implicit(Task(system, system.n_c, t, 1.0, q.copy(), v.copy()), form)
    parts, space = implicit.parts._replace(tangent=tangent), implicit.space
    residual, matrix = residual_at(parts), iteration_matrix_at(parts)

    def value(y, yp):
        residual(t, y, yp, *space[:3], res := np.zeros(y.size))
        return res

    computed = np.zeros((y.size, y.size))
    matrix(t, cj, y, yp, *space, computed)
    for j, e in enumerate(1e-5 * np.eye(y.size)):
        column = (value(y + e, yp + cj * e) - value(y - e, yp - cj * e)) / 2e-5
        assert np.abs(computed[j] - column).max() < 1e-5


# --- failures
@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "flag"),
    [(RAISES, "IDA_RES_FAIL (-8)"), *((kind, "IDA_CONV_FAIL (-4)") for kind in (NAN, MASS, CONSTRAINT, JACOBIAN))],
)
def test_a_function_that_fails_comes_back_as_a_row(kind, flag, capfd):
    system, q0, v0 = pendulum(kind)
    result = solve_ida_c(system, (0.0, 2.0), q0, v0, 1e-6, 1e-6, t_eval=[0.5, 0.9, 1.5, 2.0])
    good = solve_ida_c(*pendulum()[:1], (0.0, 2.0), q0, v0, 1e-6, 1e-6, t_eval=[0.5, 0.9])
    assert result.status is Status.SOLVER_FAILED and not result.success and f"with {flag}" in result.message
    assert 0.9 < float(result.message.split("t = ")[1].split()[0]) <= 1.0
    assert result.t.tolist() == [0.5, 0.9] and np.array_equal(result.q, good.q) and result.stats.n_accepted > 0
    assert capfd.readouterr() == ("", "")


def test_python_functions_are_refused():
    system = ConstrainedSystem.from_python(**PLAIN)
    with pytest.raises(ValueError, match=r"system must have compiled callbacks.*compile=True.*solve_ida"):
        solve_ida_c(system, (0.0, 1.0), [1.0, 0.0], [0.0, 0.0])


TIMES = np.arange(1, 21) / 10.0
CASES = {
    "flexible": very_flexible_beam(),
    "stiff": moderately_stiff_beam(),
    "stiff, no tangent": without_tangent(moderately_stiff_beam()),
}
ORDER_2 = {"max_order": 2, "error_test": "positions"}
# m, the tip's height at 0.1, 0.2 ... 2 s, by DOP853 on the index-1 equations (index1.py) with rtol = atol =
# 3e-14. From 1e-12 to 3e-14 they change by less than 1e-13 m up to 1 s and 5e-11 m up to 2 s ("flexible"), and by less
# than 1e-13 m ("stiff")
TIPS = {
    "flexible": [
        *(-0.04889632383, -0.21080305102, -0.43825960403, -0.99132942959, -0.94681974317),
        *(-0.89503493135, -0.43993582523, -0.17444842228, 0.18861913997, 0.30070508559),
        *(0.25224936204, -0.11080182336, -0.41807654371, -0.71319941564, -0.98755100567),
        *(-0.93507520597, -0.44640610438, -0.02988628371, 0.13777975652, 0.30702677469),
    ],
    "stiff": [
        *(-0.0453840999809, -0.2535008508492, -0.6143423902931, -0.9007424653775, -0.9960229139661),
        *(-0.7901000114947, -0.4823577177219, -0.1776108896546, 0.0222738879270, 0.0134651697215),
        *(-0.1288442907783, -0.3583401568151, -0.7126479442292, -0.9670104842231, -0.9700153147137),
        *(-0.7114682535221, -0.3792111187407, -0.1469810810625, 0.0103250928598, 0.0013569245972),
    ],
}


def run_beam(name, tolerance, driver=solve_ida_c, **options):
    problem = CASES[name]
    options = {"t_eval": TIMES} | options
    t_end = options["t_eval"][-1]
    return driver(problem.system, (0.0, t_end), problem.q0, problem.v0, rtol=tolerance, atol=tolerance, **options)


def errors(name, result):
    """Largest error of the tip's height up to 1 s, and up to 2 s."""
    assert result.success
    error = np.abs(tip_height(result.q) - TIPS[name][: result.t.size])
    return error[:10].max(), error.max()


@pytest.mark.slow
def test_six_digits_of_the_stiff_beam_at_2_s():
    assert errors("stiff", run_beam("stiff", 1e-5))[1] < 3e-7


@pytest.mark.slow
def test_order_2_and_positions_step_over_them():
    assert errors("stiff", result := run_beam("stiff", 1e-6, **ORDER_2))[1] < 4e-3 and result.stats.n_accepted < 8000
    assert errors("stiff", run_beam("stiff", 1e-8, **ORDER_2))[1] < 2e-4
    # they do not matter only where the beam is stiff
    assert errors("flexible", run_beam("flexible", 1e-6, **ORDER_2))[1] > 0.1
