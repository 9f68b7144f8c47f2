"""IDA without Python: the same method as through scikit-sundae, accuracy, failures, memory, other wheels."""

import ctypes
import gc
import resource
from functools import cache

import numpy as np
import pytest
from numba import njit

from references.driver import Task
from references.paper.four_bar_minimal import trajectory
from references.sundials import library as sundials
from references.sundials import loop
from references.sundials.ida import solve_ida
from references.sundials.ida_c import solve_ida_c
from references.sundials.residual import FORMS, Implicit, iteration_matrix_at, residual_at
from tests.problems import PLAIN
from twoloop import ConstrainedSystem, callback, consistent_state, solve_dae
from twoloop.mechanisms import four_bar
from twoloop.problem.given import callbacks_in
from twoloop.run.record import Status

PROBLEM = four_bar()
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
@pytest.mark.parametrize(
    "tolerance", [1e-5, 1e-9, *(pytest.param(each, marks=pytest.mark.slow) for each in (1e-7, 1e-11))]
)
def test_is_what_ida_does_through_python(tolerance):
    times = np.linspace(0.0, 10.0, 101)
    arguments = PROBLEM.system, (0.0, 10.0), PROBLEM.q0, PROBLEM.v0, "stabilised", tolerance, tolerance
    python, result = solve_ida(*arguments, t_eval=times), run(10.0, tolerance, t_eval=times)
    for name, scale in SCALES.items():
        mine, theirs = getattr(result, name), getattr(python, name)
        assert mine.shape == theirs.shape and np.abs(mine - theirs).max() < scale * BOUNDS[tolerance], name
    assert result.stats.n_evaluations == pytest.approx(python.stats.n_evaluations, rel=0.2)
    assert result.stats.n_factorizations == pytest.approx(python.stats.n_factorizations, rel=0.3)


def test_moving_pivot_without_gamma_and_with_a_mass_that_varies():
    system, q0, v0 = pendulum()
    ours = solve_dae(system, (0.0, 3.0), q0, v0, rtol=1e-10, atol=1e-10)
    loose, tight = (solve_ida_c(system, (0.0, 3.0), q0, v0, tol, tol, t_eval=[1.0, 3.0]) for tol in (1e-6, 1e-10))
    errors = [np.abs(each.q[:, -1] - ours.q[:, -1]).max() for each in (loose, tight)]
    assert errors[1] < 1e-6 and errors[0] > 10.0 * errors[1], errors
    for mine, theirs in ((ours.v, tight.v), (ours.a, tight.a), (ours.lam, tight.lam)):
        assert np.abs(mine[:, -1] - theirs[:, -1]).max() < 1e-4


# the pendulum moves its pivot and has a mass that varies, of which the four-bar has neither
@pytest.mark.parametrize(
    ("of", "form"),
    [
        *[("moving pivot", form) for form in FORMS],
        ("exact tangent", "stabilised"),
        *[pytest.param("four-bar", form, marks=pytest.mark.slow) for form in FORMS],
        pytest.param("exact tangent", "index1", marks=pytest.mark.slow),
    ],
)
def test_jacobian_is_that_of_the_residual(of, form):
    system = PROBLEM.system if of == "four-bar" else pendulum(SPRING if of == "exact tangent" else GOOD)[0]
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


# --- output and statistics
def test_output_next_to_the_ends():
    times = [1e-13, 1.0 - 1e-13, 1.0]
    result = run(1.0, 1e-8, t_eval=times)
    assert result.t.tolist() == times and np.abs(result.q - trajectory(PROBLEM.parameters, times)[0]).max() < 1e-5


def test_counts_follow_the_tolerance_and_not_the_output():
    few, many, tight = run(2.0, 1e-7, t_eval=[2.0]).stats, run(2.0, 1e-7).stats, run(2.0, 1e-9).stats
    assert few.n_accepted == many.n_accepted and few.n_evaluations == many.n_evaluations
    assert few.n_accepted < few.n_evaluations < 2.5 * few.n_accepted  # without the Jacobian's differences
    assert 0 < few.n_factorizations < 0.2 * few.n_accepted and tight.n_accepted > 1.5 * few.n_accepted
    assert few.n_rejected_error > 0 and few.n_rejected_convergence == 0 and few.n_outer > 0 and few.cpu_time > 0.0


# --- failures
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


def test_too_many_steps_end_the_run(monkeypatch):
    monkeypatch.setattr(loop, "MOST_STEPS", 20)
    monkeypatch.setattr(loop, "STEPS_A_CALL", 10)
    result = run(10.0, 1e-8, t_eval=[1e-6, 10.0])
    assert result.status is Status.SOLVER_FAILED and "IDA_TOO_MUCH_WORK (-1)" in result.message
    assert result.t.tolist() == [1e-6]


def test_python_functions_are_refused():
    system = ConstrainedSystem.from_python(**PLAIN)
    with pytest.raises(ValueError, match=r"system must have compiled callbacks.*compile=True.*solve_ida"):
        solve_ida_c(system, (0.0, 1.0), [1.0, 0.0], [0.0, 0.0])


@pytest.mark.slow  # what is compiled is as in the tests above, but by from_python
def test_functions_that_from_python_compiles_are_taken():
    result = solve_ida_c(ConstrainedSystem.from_python(compile=True, **PLAIN), (0.0, 1.0), [1.0, 0.0], [0.0, 0.0])
    assert result.success and np.abs(0.5 * (result.v**2).sum(axis=0) + 9.81 * result.q[1]).max() < 1e-4


# --- the wheel
@pytest.fixture
def fresh():
    """The library is looked for again in the test, and after it."""
    sundials.library.cache_clear()
    yield
    sundials.library.cache_clear()


@pytest.mark.parametrize(
    ("name", "value", "found"),
    [
        ("files", lambda package: None, "there are 0 files"),
        ("_version", lambda sundials: (8, 1, 0), "SUNDIALS has the version 8.1.0"),
        ("FUNCTIONS", {"core": "SUNContext_Make:-"}, "undefined symbol: SUNContext_Make"),
    ],
)
@pytest.mark.usefixtures("fresh")
def test_another_wheel_is_named(monkeypatch, name, value, found):
    monkeypatch.setattr(sundials, name, value)
    with pytest.raises(RuntimeError, match=f"{found}.*written for scikit-sundae 1.2.0"):
        run(1.0, 1e-6)


@pytest.mark.usefixtures("fresh")
def test_another_size_of_integers_is_named(monkeypatch):
    from sksundae import _cy_common

    monkeypatch.setattr(_cy_common, "config", _cy_common.config | {"SUNDIALS_INT_TYPE": "int64_t"})
    with pytest.raises(RuntimeError, match=r"sunindextype and sunrealtype are int64_t and double.*written for"):
        run(1.0, 1e-6)


class _Mallinfo(ctypes.Structure):
    """struct mallinfo2 of glibc: ten sizes, of which 4 and 7 are bytes in use in mapped and in other blocks."""

    _fields_ = (("sizes", ctypes.c_size_t * 10),)


def allocated():
    """Bytes that malloc has given out."""
    mallinfo = ctypes.CDLL(None).mallinfo2
    mallinfo.restype = _Mallinfo
    gc.collect()
    sizes = mallinfo().sizes
    return sizes[4] + sizes[7]


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="needs glibc")
@pytest.mark.usefixtures("collected_alone")
def test_runs_leave_nothing_behind():
    failing, q0, v0 = pendulum(NAN)

    def runs(count):
        for _ in range(count):
            assert run(0.05, 1e-6, t_eval=[0.05]).success
            assert not solve_ida_c(failing, (0.0, 2.0), q0, v0, 1e-4, 1e-4, t_eval=[2.0]).success

    runs(50)
    before, highest = allocated(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    runs(50)
    assert allocated() - before < 50 * 20  # the name of a flag takes 32 bytes, a context 330
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - highest < 300  # kB
