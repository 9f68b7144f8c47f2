"""What holds for every adapter: a time limit ends a run as a row, so does a NaN, and wrong arguments are named."""

import time
from dataclasses import replace

import numpy as np
import pytest

from references.driver import TimeLimit
from references.exudyn.beam import solve_exudyn_beam
from references.exudyn.mechanisms import solve_exudyn
from references.exudyn.run import SOLVERS
from references.paper.four_bar_minimal import trajectory
from references.paper.gear import solve_gear
from references.scipy.beam_reduced import reduced_motion
from references.scipy.fully_implicit import solve_fully_implicit
from references.scipy.index1 import METHODS, solve_index1
from references.sundials.ida import FORMS, solve_ida
from references.sundials.ida_c import solve_ida_c
from tests.problems import pendulum, worst
from twoloop.mechanisms import four_bar, very_flexible_beam
from twoloop.run.record import Status

PROBLEM = four_bar()
LONG = 1e6  # s of motion: none of the solvers is there within the limits below
MOST = 20.0  # s: far above what a run with a limit needs, far below what the run would take


def solve_dae_package(method):
    def run(*args, **options):
        pytest.importorskip("solve_dae")
        return solve_fully_implicit(*args, method, 1e-6, 1e-6, **options)

    return run


# adapters that take any system, as f(system, t_span, q0, v0, **options)
ANY_SYSTEM = {
    **{f"index1 {m}": lambda *args, m=m, **options: solve_index1(*args, m, 1e-6, 1e-6, **options) for m in METHODS},
    "index1 projected": lambda *args, **options: solve_index1(*args, stabilisation="projection", **options),
    **{f"IDA {f}": lambda *args, f=f, **options: solve_ida(*args, f, 1e-6, 1e-6, **options) for f in FORMS},
    "IDA from C": lambda *args, **options: solve_ida_c(*args, 1e-6, 1e-6, **options),
    "gear": lambda *args, **options: solve_gear(*args, 1e-3, 2, **options),
    **{f"solve_dae {m}": solve_dae_package(m) for m in ("Radau", "Radau9", "BDF")},
}
# adapters with a model of their own, as f(**options)
OWN_MODEL = {
    **{f"Exudyn {s}": lambda s=s, **options: solve_exudyn(PROBLEM, 1e4, 10**7, s, **options) for s in SOLVERS},
    "Exudyn beam": lambda **options: solve_exudyn_beam(very_flexible_beam(), 1e4, 10**7, **options),
}
RUNS = {
    **OWN_MODEL,
    **{
        name: lambda f=f, **options: f(PROBLEM.system, (0.0, LONG), PROBLEM.q0, PROBLEM.v0, **options)
        for name, f in ANY_SYSTEM.items()
        if name != "gear"  # asked for 1e9 steps, it would make a table of them
    },
    "gear": lambda **options: solve_gear(
        PROBLEM.system, (0.0, 1e4), PROBLEM.q0, PROBLEM.v0, 1e-3, 2, t_eval=[0.0, 0.01, 1e4], **options
    ),
}


@pytest.mark.parametrize("name", RUNS)
def test_a_run_past_its_time_limit_is_a_row(name):
    RUNS[name](time_limit=0.02)  # compiles, and imports what SciPy imports late
    for limit in (1e-9, 0.1):
        began = time.monotonic()
        result = RUNS[name](time_limit=limit)
        assert time.monotonic() - began < MOST
        assert result.status is Status.SOLVER_FAILED and not result.success
        assert f"was stopped at t = {'0 ' if limit == 1e-9 else ''}" in result.message
        assert f"time_limit = {limit:g} s. Raise time_limit, or " in result.message
        assert result.q.shape[1] == result.v.shape[1] == result.t.size
    assert 0.0 < float(result.message.split("t = ")[1].split()[0]) < LONG
    assert result.t.size > 1 or name == "IDA from C"  # whose output times are 1000 s apart here
    known = np.isfinite(result.q).any(axis=1)
    assert known.sum() >= 9 and np.isfinite(result.q[known]).all() and (np.diff(result.t) > 0.0).all()


@pytest.mark.parametrize("name", ANY_SYSTEM)
def test_a_limit_that_is_not_reached_changes_nothing(name):
    # more steps than between two looks at the clock, where those are counted
    arguments = PROBLEM.system, (0.0, 1.0), PROBLEM.q0, PROBLEM.v0
    times = [0.0, 0.25, 1.0]
    free, limited = (ANY_SYSTEM[name](*arguments, t_eval=times, time_limit=limit) for limit in (None, 600.0))
    assert free.success and limited.success
    for field in ("t", "q", "v", "a", "lam", "h"):
        assert np.array_equal(getattr(free, field), getattr(limited, field)), field
    assert free.stats.n_evaluations == limited.stats.n_evaluations


def test_the_accurate_start_of_gear_is_within_the_limit():
    result = solve_gear(PROBLEM.system, (0.0, 1.0), PROBLEM.q0, PROBLEM.v0, 0.01, 3, start="accurate", time_limit=1e-9)
    assert result.status is Status.SOLVER_FAILED
    assert "The accurate start was stopped at t = 0 by time_limit = 1e-09 s" in result.message


def test_gear_goes_on_where_the_last_call_ended():
    arguments = PROBLEM.system, (0.0, 1.0), PROBLEM.q0, PROBLEM.v0, 1e-3
    for order in (1, 5, 6):
        free, limited = (solve_gear(*arguments, order, time_limit=limit) for limit in (None, 600.0))
        assert np.array_equal(free.q, limited.q) and np.array_equal(free.lam, limited.lam)


def test_a_reference_past_its_limit_is_an_error():
    beam = very_flexible_beam()
    with pytest.raises(RuntimeError, match=r"was stopped at t = 0 by time_limit = 1e-09 s"):
        reduced_motion(beam, [1.0], 1e-8, time_limit=1e-9)
    with pytest.raises(RuntimeError, match=r"was stopped at t = 0\.\d+ by time_limit = 0\.05 s"):
        reduced_motion(beam, [100.0], 1e-12, time_limit=0.05)


def test_the_clock_starts_when_a_limit_is_made():
    assert not TimeLimit(None).passed() and TimeLimit(None).left() is None
    limit = TimeLimit(100.0)
    assert not limit.passed() and 99.0 < limit.left() <= 100.0
    over = TimeLimit(1e-9)
    assert over.passed() and over.exceeded and 0.0 < over.left() <= 1e-9


# --- values that are not finite


AT = 0.7  # s


def late_nan(kind):
    """The pendulum, of whose functions one returns NaN after `AT`."""
    exact = pendulum()
    functions = {
        "mass": lambda t, q: exact.mass(t, q),
        "force": lambda t, q, v: exact.force(t, q, v),
        "constraint": lambda t, q: exact.constraint(t, q),
        "jacobian": lambda t, q: exact.jacobian(t, q),
        "gamma": lambda t, q, v: exact.gamma(t, q, v),
    }
    function = functions[kind]
    return pendulum(**{kind: lambda t, *state: function(t, *state) * (1.0 if t <= AT else np.nan)})


# what reads which function; the index-1 forms do not read the constraint, the others not gamma; IDA from C, which
# takes compiled functions alone, has its own in test_ida_c.py
NANS = [
    (name, kind)
    for kind in ("mass", "force", "jacobian")
    for name in ANY_SYSTEM
    if name != "IDA from C" and (kind == "force" or name in ("index1 DOP853", "index1 LSODA", "IDA index1", "gear"))
]
NANS += [(name, "constraint") for name in ("index1 projected", "IDA stabilised", "gear")]
NANS += [(name, "gamma") for name in ("index1 DOP853", "IDA index1")]


@pytest.mark.parametrize(("name", "kind"), NANS)
def test_a_function_that_becomes_nan_is_a_row(name, kind):
    began = time.monotonic()
    result = ANY_SYSTEM[name](late_nan(kind), (0.0, 2.0), [1.0, 0.0], [0.0, 0.0], t_eval=np.linspace(0.0, 2.0, 101))
    assert time.monotonic() - began < 2.0 * MOST
    assert result.status is Status.SOLVER_FAILED and " failed " in result.message
    assert 0.5 < result.t[-1] <= AT and np.isfinite(result.q).all() and np.isfinite(result.v).all()


@pytest.mark.parametrize("solver", SOLVERS)
def test_exudyn_ends_where_its_model_is_not_finite(solver):
    # its models call no function of ours: a value of theirs is the way in
    for solve, problem in ((solve_exudyn, PROBLEM), (solve_exudyn_beam, very_flexible_beam())):
        broken = replace(problem, parameters={**problem.parameters, "gravity": np.nan})
        result = solve(broken, 1.0, 100, solver=solver, time_limit=60.0)
        assert result.status is Status.SOLVER_FAILED and "Exudyn failed in the step to t = 0.01" in result.message


# --- wrong arguments


@pytest.mark.parametrize(
    ("changed", "error", "words"),
    [
        ({"system": PROBLEM}, TypeError, r"given the Problem 'four-bar .*': give problem\.system"),
        ({"system": "pendulum"}, TypeError, "system must be a ConstrainedSystem; given 'pendulum' of type str"),
        ({"t_span": (1.0, 0.0)}, ValueError, "t_span must be"),
        ({"q0": np.zeros(3)}, ValueError, "q0 must have shape"),
        ({"v0": np.full(9, np.nan)}, ValueError, "v0 must be finite"),
        ({"q0": PROBLEM.q0 + 0.01}, ValueError, "q0 is not consistent"),
        ({"t_eval": [0.5, 0.4]}, ValueError, "t_eval must be strictly increasing"),
        ({"t_eval": [2.0]}, ValueError, "t_eval must lie within"),
        ({"time_limit": 0.0}, ValueError, "time_limit must be positive"),
        ({"time_limit": np.inf}, ValueError, "time_limit must be positive and finite"),
        ({"time_limit": "1 s"}, TypeError, "time_limit must be a number"),
    ],
)
@pytest.mark.parametrize("solve", [solve_index1, solve_ida, solve_ida_c, solve_gear, solve_fully_implicit])
def test_wrong_arguments_are_named(solve, changed, error, words):
    given = {"system": PROBLEM.system, "t_span": (0.0, 1.0), "q0": PROBLEM.q0, "v0": PROBLEM.v0, **changed}
    if solve is solve_gear:
        given["step"] = 0.01
    with pytest.raises(error, match=words):
        solve(**given)


@pytest.mark.parametrize(
    ("solve", "changed", "words"),
    [
        (solve_index1, {"rtol": np.nan}, "rtol must be positive"),
        (solve_ida, {"atol": -1.0}, "atol must be positive"),
        (solve_ida_c, {"rtol": 0.0}, "rtol must be positive"),
        (solve_fully_implicit, {"atol": np.inf}, "atol must be positive and finite"),
        (solve_index1, {"method": ["DOP853"]}, r"method must be one of .*; given \['DOP853'\]"),
        (solve_ida, {"form": None}, "form must be one of index1, stabilised; given None"),
        (solve_fully_implicit, {"method": "Gauss"}, "method must be one of Radau, Radau9, BDF; given 'Gauss'"),
        (solve_ida_c, {"error_test": []}, r"error_test must be one of all, states, positions; given \[\]"),
    ],
)
def test_wrong_options_are_named(solve, changed, words):
    with pytest.raises(ValueError, match=words):
        solve(PROBLEM.system, (0.0, 1.0), PROBLEM.q0, PROBLEM.v0, **changed)


@pytest.mark.parametrize("solve", [solve_exudyn, solve_exudyn_beam])
def test_adapters_of_one_mechanism_name_wrong_arguments(solve):
    problem = PROBLEM if solve is solve_exudyn else very_flexible_beam()
    for changed, error, words in (
        ({"problem": problem.system}, TypeError, "problem must be a "),
        ({"t_end": np.nan}, ValueError, "t_end must be positive"),
        ({"t_end": "1"}, TypeError, "t_end must be a number"),
        ({"time_limit": -1.0}, ValueError, "time_limit must be positive"),
        ({"solver": None}, ValueError, "solver must be one of"),
    ):
        with pytest.raises(error, match=words):
            solve(**{"problem": problem, "t_end": 1.0, "n_steps": 10, **changed})


def test_references_name_wrong_arguments():
    with pytest.raises(TypeError, match=r"problem must be a beam of ancf_beam.*given ConstrainedSystem"):
        reduced_motion(PROBLEM.system, [1.0], 1e-8)
    with pytest.raises(ValueError, match="time_limit must be positive"):
        reduced_motion(very_flexible_beam(), [1.0], 1e-8, time_limit=0.0)
    with pytest.raises(ValueError, match="times must be a list of finite times"):
        trajectory(PROBLEM.parameters, [0.0, np.nan])


# --- the optional package


def test_a_missing_package_is_told(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "solve_dae.integrate", None)
    with pytest.raises(RuntimeError, match=r"solve_dae is not installed.*pip install 'twoloop\[peers\]'"):
        solve_fully_implicit(PROBLEM.system, (0.0, 1.0), PROBLEM.q0, PROBLEM.v0)


@pytest.mark.parametrize(("method", "bound"), [("Radau", 3e-5), ("Radau9", 1e-7), ("BDF", 1e-3)])
def test_the_package_agrees_with_the_truth(method, bound):
    times = [0.0, 5.0, 10.0]
    q, _ = trajectory(PROBLEM.parameters, times)
    arguments = PROBLEM.system, (0.0, 10.0), PROBLEM.q0, PROBLEM.v0
    run = solve_dae_package(method)
    result, every = run(*arguments, t_eval=times), run(*arguments)
    assert result.success and result.t.tolist() == times and worst(result.q, q) < bound
    assert np.array_equal(every.h, result.h) and every.t.size == every.h.size + 1
    for t, q, v, a, lam in zip(result.t, result.q.T, result.v.T, result.a.T, result.lam.T, strict=True):
        system = PROBLEM.system
        assert worst(system.mass(t, q) @ a + system.jacobian(t, q).T @ lam, system.force(t, q, v)) < 0.1
