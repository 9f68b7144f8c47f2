"""Test what holds for every adapter: it is right; output; time limits; a failure is a row."""

import time
from dataclasses import replace

import numpy as np
import pytest

from references.exudyn.mechanisms import solve_exudyn
from references.exudyn.model import SOLVERS
from tests.marks import slow
from tests.problems import pendulum
from tests.references.adapters import ADAPTERS, ANY_CALLBACK, each, start
from twoloop.mechanisms import double_pendulum, four_bar, knife_edge, rolling_disc
from twoloop.run.record import Status
from twoloop.testing.mechanisms import MAKERS

PROBLEM, SMALL = four_bar(), double_pendulum()  # code for the second compiles in a fifth of the time
KNOWN = MAKERS["double_pendulum"]().reference  # its motion
LONG = 1e6  # s of motion: none of the solvers is there within the limits below
MOST = 20.0  # s: far above what a run with a limit needs, far below what the run would take
TIMES = np.linspace(0.0, 2.0, 201)


# --- right, and measured
# largest error of q with tolerances of 1e-9: of the four-bar at 10 s, two to four times what it was when written,
# and of the double pendulum at 3 s, three to six times; gear takes steps of 1e-3 s, collocation 300, heyoka 1e-6
RIGHT = {
    "heyoka": (5e-06, 2e-06),
    "CVODE from C, Adams": (5e-06, 5e-07),
    "CVODE from C, BDF": (1e-05, 4e-06),
    "CVODE, Adams": (2e-06, 2e-06),
    "Pr9, index 1": (1e-09, 2e-11),
    "CyRK, DOP853": (5e-08, 4e-09),
    "CyRK, Vern8": (1e-06, 2e-07),
    "CyRK, Radau": (1e-06, 1e-08),
    "IDAS, CasADi": (5e-06, 1.5e-06),
    "collocation, CasADi": (2e-07, 1e-09),
    "Dopri8, diffrax": (2e-08, 2e-08),
    "CVODES, CasADi": (1e-05, 4e-06),
    "GSTIFF": (0.05, 0.0004),
    "Radau9, solve_dae": (1e-07, 3e-12),
    "IDA, index1": (1.1e-05, 1e-06),
    "IDA, stabilised": (3e-06, 2e-07),
    "IDA from C, stabilised": (2.4e-05, 2e-07),
}


@pytest.mark.parametrize("problem", [SMALL, slow(PROBLEM)], ids=lambda each: each.name)
@pytest.mark.parametrize("name", each(of=RIGHT, quick=[]))
def test_another_solver_is_right_and_measured(name, problem):
    result = ADAPTERS[name](*start(problem), tol=1e-6 if name == "heyoka" else 1e-9)
    system, n, end = problem.system, problem.system.n_q, result.q[:, -1].copy()
    assert result.success, result.message
    assert result.t[0] == 0.0 and result.t[-1] == pytest.approx(problem.reference.t, abs=1e-12)
    assert 1e-14 < np.abs(end - problem.reference.q).max() < RIGHT[name][problem is SMALL]
    assert result.q.shape == result.v.shape == result.a.shape == (n, result.t.size)
    assert result.lam.shape == (system.n_c, result.t.size)
    residual = system.mass(0.0, end) @ result.a[:, -1] + system.jacobian(0.0, end).T @ result.lam[:, -1]
    off = 0.1 if name.startswith(("IDA, ", "IDA f")) or "solve_dae" in name else 1e-8  # derivatives of unknowns
    assert np.allclose(residual, system.force(0.0, end, result.v[:, -1].copy()), atol=off)
    assert 0.0 < result.stats.cpu_time < 60.0


# --- output
AT = [[1.0], [0.0, 0.26, 1.0], [0.5], [0.0, 1.0]]


@pytest.mark.parametrize("name", each("collocation, CasADi"))
def test_output_is_at_the_times_asked_for(name):
    at, far = start(SMALL, 1.0), 2e-2 if name == "RK45, index 1" else 1e-3
    for times in AT:
        result = ADAPTERS[name](*at, t_eval=times)
        assert result.success and result.t == pytest.approx(times, abs=1e-12)
        assert name == "GSTIFF" or result.t.tolist() == times
        known = np.searchsorted(KNOWN.t, np.array(times) - 1e-9)
        assert np.abs(result.q.T - KNOWN.q[known]).max() < far
        assert np.abs(result.v.T - KNOWN.v[known]).max() < 10.0 * far
        assert result.q.shape == result.v.shape == result.a.shape == (4, len(times)) and result.lam.shape[0] == 2
        assert times[0] > 0.0 or np.array_equal(result.q[:, 0], SMALL.q0)


OWN_OUTPUT = ("collocation, CasADi", "Dopri8, diffrax", "GSTIFF", "heyoka")
OWN_OUTPUT += ("IDAS, CasADi", "CVODES, CasADi", "CVODES, CasADi, Adams")


@pytest.mark.parametrize("name", each(*OWN_OUTPUT))
def test_output_takes_no_step_and_no_evaluation_of_the_run_that_is_timed(name):
    solve, at = ADAPTERS[name], start(SMALL, 2.0)
    end, many = (solve(*at, tol=1e-7, t_eval=times) for times in ([2.0], TIMES))
    assert end.success and many.success and np.array_equal(many.t, TIMES)
    counts = [(run.stats.n_accepted, run.stats.n_evaluations, run.stats.n_factorizations) for run in (end, many)]
    assert counts[0] == counts[1] and counts[0][1] > 10
    # the second run takes the steps of the first: what is shown is the run that is timed
    assert np.abs(end.q[:, -1] - many.q[:, -1]).max() < 1e-13
    assert np.abs(solve(*at, tol=1e-7, t_eval=[1.0]).q[:, 0] - many.q[:, 100]).max() < 1e-13
    late = solve(*at, t_eval=[0.0, 2.0], time_limit=1e-9)
    assert late.status is Status.SOLVER_FAILED and late.t.tolist() in ([], [0.0])


# --- time limits
OWN_MODEL = {**{f"Exudyn {s}": lambda s=s, **options: solve_exudyn(PROBLEM, 1e4, 10**7, s, **options) for s in SOLVERS}}
STOPPED = {
    **OWN_MODEL,
    **{
        name: lambda solve=ADAPTERS[name], **options: solve(*start(SMALL, LONG), **options)
        for name in (*ANY_CALLBACK, "IDA from C, stabilised")
        if name != "GSTIFF"  # asked for 1e9 steps, it would make a table of them
    },
    "GSTIFF": lambda **options: ADAPTERS["GSTIFF"](*start(SMALL, 1e4), t_eval=[0.0, 0.01, 1e4], **options),
}


@pytest.mark.parametrize("name", each(of=STOPPED))
def test_a_run_past_its_time_limit_is_a_row(name):
    STOPPED[name](time_limit=0.02)  # compiles, and imports what SciPy imports late
    for limit in (1e-9, 0.1):
        began = time.monotonic()
        result = STOPPED[name](time_limit=limit)
        assert time.monotonic() - began < MOST and result.status is Status.SOLVER_FAILED and not result.success
        assert f"was stopped at t = {'0 ' if limit == 1e-9 else ''}" in result.message
        assert f"time_limit = {limit:g} s. Raise time_limit, or " in result.message
        assert result.q.shape[1] == result.v.shape[1] == result.t.size
    if name == "CVODE, Adams":  # it has no output, and does not say when
        return
    assert 0.0 < float(result.message.split("t = ")[1].split()[0]) < LONG
    assert result.t.size > 1 or name == "IDA from C, stabilised"  # whose output times are 1000 s apart here
    known = np.isfinite(result.q).any(axis=1)
    assert known.sum() >= 4 and np.isfinite(result.q[known]).all() and (np.diff(result.t) > 0.0).all()


@pytest.mark.parametrize(
    "name",
    [
        *("heyoka", "CVODE from C, Adams", "collocation, CasADi"),
        *(slow("IDA from C, stabilised"), slow("DOP853, index 1")),
    ],
)
def test_a_run_past_its_limit_is_not_run_again_to_its_end(name):
    short = name == "collocation, CasADi"  # which is not stopped within
    more = {} if short else {"t_eval": [LONG]}
    result = ADAPTERS[name](*start(SMALL, 1.0 if short else LONG), time_limit=1e-9 if short else 0.01, **more)
    assert result.status is Status.SOLVER_FAILED and "time_limit" in result.message and result.t.size == 0


# --- the longest step
HAVE_LONGEST = [
    name for name in ADAPTERS if name.startswith(("IDA,", "IDA f", "CVODE f", "heyoka", "DOP853, i", "LSODA"))
]


@pytest.mark.parametrize("name", each(of=HAVE_LONGEST))
def test_no_step_is_longer(name):
    solve, at, t_end, max_step = ADAPTERS[name], start(SMALL, 0.2), 0.2, 1e-3
    free, bound = solve(*at, tol=1e-4), solve(*at, tol=1e-4, max_step=max_step)
    assert free.success and bound.success
    assert bound.stats.n_accepted >= 0.999 * t_end / max_step > 1.2 * free.stats.n_accepted
    with pytest.raises(ValueError, match="max_step"):
        solve(*at, max_step=0.0)


# --- what fails
LATE = 0.7  # s


def late(kind, becomes):
    """The pendulum, of whose functions one returns NaN, or raises, after `LATE`."""
    exact = pendulum()
    return pendulum(**{kind: lambda t, *state: getattr(exact, kind)(t, *state) * (1.0 if t <= LATE else becomes())})


def raising():
    raise ValueError("no force today")


# what reads which function; the index-1 forms do not read the constraint, the others not gamma; those from C, which
# take compiled functions alone, have theirs in test_ida.py
NANS = [(name, "force") for name in ANY_CALLBACK]
NANS += [
    (name, kind)
    for kind in ("mass", "jacobian")
    for name in ("DOP853, index 1", "LSODA, index 1", "IDA, index1", "GSTIFF")
]
NANS += [(name, "constraint") for name in ("DOP853, projected", "IDA, stabilised", "GSTIFF")]
NANS += [(name, "gamma") for name in ("DOP853, index 1", "IDA, index1")]


QUICK_NAN = ("IDA, stabilised", "force")


@pytest.mark.parametrize("every_step", [slow(True), False])
@pytest.mark.parametrize(("name", "kind"), [pair if pair == QUICK_NAN else slow(*pair) for pair in NANS])
def test_a_function_that_becomes_nan_is_a_row(name, kind, every_step, capfd):
    began, more = time.monotonic(), {} if every_step else {"t_eval": np.linspace(0.0, 2.0, 101)}
    result = ADAPTERS[name](late(kind, lambda: np.nan), (0.0, 2.0), [1.0, 0.0], [0.0, 0.0], **more)
    assert time.monotonic() - began < 2.0 * MOST
    assert result.status is Status.SOLVER_FAILED and not result.success and " failed " in result.message
    assert "Look for" in result.message or name == "GSTIFF"
    assert 0.5 < result.t[-1] <= LATE and np.isfinite(result.q).all() and np.isfinite(result.v).all()
    if result.h.size and every_step:
        assert result.stats.n_accepted == result.h.size == result.t.size - 1
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("name", each(of=ANY_CALLBACK, quick=["IDA, stabilised"]))
def test_an_exception_of_a_callback_comes_through(name):
    with pytest.raises(ValueError, match="no force today"):
        ADAPTERS[name](late("force", raising), (0.0, 2.0), [1.0, 0.0], [0.0, 0.0])


@pytest.mark.parametrize("solver", SOLVERS)
def test_exudyn_ends_where_its_model_is_not_finite(solver):
    # its models call no function of ours: a value of theirs is the way in
    broken = replace(PROBLEM, parameters={**PROBLEM.parameters, "gravity": np.nan})
    result = solve_exudyn(broken, 1.0, 100, solver=solver, time_limit=60.0)
    assert result.status is Status.SOLVER_FAILED and "Exudyn failed in the step to t = 0.01" in result.message


# --- rows A v + b = 0
# `Task` adds them for every adapter
ROLLING = (
    "DOP853, index 1",
    "heyoka",
    "IDA from C, stabilised",
    "DOP853, projected",
    "CVODE from C, Adams",
    "IDA, stabilised",
)
ON_AN_EDGE = ("IDAS, CasADi", "CVODE from C, BDF, projected", "IDA, index1", "Dopri8, diffrax")


@pytest.mark.parametrize("name", each(of=(*ROLLING, *ON_AN_EDGE), quick=[]))
def test_the_motion_is_right_and_the_rows_hold(name):
    problem = rolling_disc() if name in ROLLING else knife_edge()
    result = ADAPTERS[name](*start(problem), tol=1e-10 if name == "heyoka" else 1e-9)
    system = problem.system
    assert result.success and np.abs(result.q[:, -1] - problem.reference.q).max() < 1e-6
    assert result.lam.shape == (system.n_c + system.n_a, result.t.size)
    rows, rates = system.rows(result.t[-1], result.q[:, -1]), system.rates(result.t[-1], result.q[:, -1])
    assert np.abs(rows @ result.v[:, -1] + rates).max() < 1e-6
