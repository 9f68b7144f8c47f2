"""Solvers from files: what they return, and everything that can go wrong with them, which is a row."""

from dataclasses import replace

import numpy as np
import pytest

from studies.bench.cli import StudyError
from studies.bench.collector import Case, Run, attempt
from studies.bench.outsider import Outsider, loaded
from twoloop.mechanisms import pendulum

SOLVERS = '''
import os
import signal
import sys
import time
import numpy as np

def motion(problem, times):
    """Runge-Kutta steps of 0.01 s of the pendulum, off the constraint by little."""
    q, v, rows = problem.q0, problem.v0, []
    for t in times:
        rows.append((q, v))
        for _ in range(10):
            h, one = 0.1 * (times[1] - times[0]), problem.acceleration(t, q, v)[0]
            two = problem.acceleration(t + h / 2, q + h / 2 * v, v + h / 2 * one)[0]
            q, v = q + h * (v + h / 2 * one), v + h * two
    return tuple(np.array(each) for each in zip(*rows))

def solve(problem, times, tolerance):
    print("loud", "x" * 100_000)
    what = round(-np.log10(tolerance))
    q, v = motion(problem, times)
    if what == 1:
        raise RuntimeError("no step is small enough")
    if what == 2:
        return q.T, v
    if what == 3:
        q[5:] = np.nan
    if what == 4:
        return q
    if what == 5:
        os.environ["OMP_NUM_THREADS"], times[:] = "99", 0.0
        problem.mass(0.0, problem.q0)[:] = 0.0
        problem.force(0.0, problem.q0, problem.v0)[:] = 0.0
    if what == 6:
        try:
            problem.q0[:] = 0.0
        finally:
            return q, v
    if what == 7:
        os.kill(os.getpid(), signal.SIGSEGV)
    if what == 9:
        if os.fork() == 0:
            time.sleep(60)
        time.sleep(60)
    return q, v
'''


@pytest.fixture(scope="module")
def case():
    return Case("pendulum", pendulum(), 1.0, time_limit=600.0)


@pytest.fixture(scope="module")
def ran(tmp_path_factory, case):
    """run(k): a run at the tolerance 10^-k of a solver that does everything wrong, in one process while it lives."""
    path = tmp_path_factory.mktemp("outsider") / "mine.py"
    path.write_text(SOLVERS)
    outsider = Outsider(f"{path}:solve", "pendulum")
    solver = outsider.solver()
    assert solver.name == "mine.py:solve" and len(outsider.digest) == 10
    yield lambda k, limit=600.0: attempt(Run(replace(case, time_limit=limit), solver, 10.0**-k, "compare"), 0)
    outsider.end()


@pytest.mark.slow
def test_what_a_solver_returns_is_measured_and_what_it_breaks_stays_with_it(ran, case):
    result, status, _, seconds = ran(12)
    times = np.linspace(0.0, 1.0, 101)
    q = result.q
    assert status == "REACHED_END" and np.array_equal(result.t, times) and q.shape == (case.problem.system.n_q, 101)
    assert 0.0 < seconds < 60.0 and result.stats.n_evaluations == 2020 and np.isnan(result.lam).all()
    for k, status, says in (
        (1, "SOLVER_FAILED", "RuntimeError: no step is small enough"),
        (2, "SOLVER_FAILED", "transpose it"),
        (3, "SOLVER_FAILED", "not finite"),
        (4, "RAISED", r"return (q, v)"),
    ):
        _, found, message, _ = ran(k)
        assert (found, says in message) == (status, True), message
    for k in (5, 6, 12):  # the equations and the start of the next run are as they were
        result, status, message, _ = ran(k)
        assert status == "REACHED_END" and np.array_equal(result.q, q), message
    _, status, message, _ = ran(7)
    assert status == "RAISED" and "ended by SIGSEGV" in message
    result, status, _, _ = ran(12)
    assert status == "REACHED_END" and np.array_equal(result.q, q)
    assert [ran(9, 0.5)[1], ran(12)[1]] == ["TIME_LIMIT", "TIME_LIMIT"]  # not asked again
    assert "time_limit = 0.5 s at the tolerance 1e-09" in ran(12)[2]


@pytest.mark.slow
def test_files_that_are_no_solver(tmp_path):
    path = tmp_path / "mine.py"
    # texts of unlike lengths: Python takes one of the same length, written in the same second, for the one before it
    for text, kind in (("def solve(:\n", SyntaxError), ("x = 3\n", AttributeError), ("1.0 / 0.0\n", ZeroDivisionError)):
        path.write_text(text)
        with pytest.raises(kind):
            loaded(path, "solve")
    path.write_text("raise SystemExit(0)\n")
    outsider = Outsider(f"{path}:solve", "pendulum")
    with pytest.raises(StudyError, match=r"mine\.py is no solver: SystemExit: 0"):
        outsider.start()


def test_files_that_are_not_there(tmp_path):
    for where in ("mine.py:solve", str(tmp_path), f"{tmp_path}:solve"):
        with pytest.raises(StudyError, match=r"--solver takes FILE\.py:FUNCTION"):
            Outsider(where, "pendulum")


@pytest.mark.slow
def test_a_solver_of_references_is_named_without_its_path(case):
    outsider = Outsider("extensisq_pr9", "pendulum")
    try:
        _, status, message, _ = attempt(Run(case, outsider.solver(), 1e-6, "compare"), 0)
    finally:
        outsider.end()
    assert status == "REACHED_END" or "extensisq" in message
    with pytest.raises(StudyError, match=r"or one of extensisq_pr9, .*sympy_lagrange; given no_such_solver"):
        Outsider("no_such_solver", "pendulum")
