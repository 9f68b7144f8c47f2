"""Test `check_simulator`: it finds and names planted faults, passes sound integrators, and ends where a run hangs."""

from contextlib import suppress
from threading import Event
from threading import enumerate as enumerate_threads

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from references.as_shown import rate_of, start_of
from tests.marks import slow_but
from tests.testing.planted import ALPHA, FAULTS, ORDERS, OTHERS, RATTLE, RK, module_of
from tests.testing.systems import system_of
from twoloop import solve_dae
from twoloop.testing import check_simulator
from twoloop.testing.mechanisms import MAKERS
from twoloop.testing.problem import change_frame, change_units

LONG = ("andrews", "heavy_top")  # the dearest to evaluate
LONGEST = "a misprint in the tableau"  # takes ten seconds
NAMED = [fault.words for fault in FAULTS]
NEW = [fault for k, fault in enumerate(FAULTS) if fault.words not in NAMED[:k]]  # in what is said of them
QUICK = [fault for fault in NEW if fault.problem not in LONG and fault.name != LONGEST][::18]


def known(edit=lambda problem, q, v, lam: (q, v, lam)):
    """A simulator that knows the answer, and returns it after an edit."""

    def simulate(problem, times, setting):
        motion = MAKERS[problem.name]().reference
        if problem.reference is None:  # the same problem seen otherwise, or begun later
            raise NotImplementedError("begun elsewhere")
        return edit(problem, motion.q.copy(), motion.v.copy(), motion.lam.copy())

    return simulate


def properties_that_fail(report):
    return {failure.property for failure in report.failures}


# --- what is right passes
@pytest.mark.parametrize("fault", slow_but(QUICK, FAULTS), ids=[fault.name for fault in FAULTS])
def test_a_planted_fault_is_found_and_named(fault):
    module = module_of(fault.example, fault.edits)
    report = check_simulator(module.simulate, fault.problem, **fault.options)
    assert not report.passed
    assert any(fault.words in failure.hint for failure in report.failures), str(report)


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.slow
def test_sound_integrators_pass_on_every_problem(name):
    beyond = {
        RK: {"redundant_slider_crank"},
        RATTLE: {"redundant_slider_crank", "heavy_top", "andrews", "spatial_four_bar"},
    }
    steps = (800, 1600) if "stiff" in name else (200, 400, 800)  # longer ones do not converge, and say so
    for example in (RK, ALPHA, RATTLE):
        if name not in beyond.get(example, ()):
            report = check_simulator(module_of(example).simulate, name, steps=steps, order=ORDERS[example])
            assert report.passed, str(report)


@pytest.mark.parametrize("example", [path.stem for path in OTHERS.glob("*.py")])
@pytest.mark.slow
def test_integrators_that_faults_are_planted_into_pass_without_them(example):
    options = {"steps": (200, 400, 800), "order": ORDERS[example]} if example in ORDERS else {}
    report = check_simulator(module_of(example).simulate, "smoke", **options)
    assert report.passed, str(report)


def by_twoloop(problem, times, tolerance):
    span = (times[0], times[-1])
    run = solve_dae(system_of(problem), span, problem.q0, problem.v0, rtol=tolerance, atol=tolerance, t_eval=times)
    if not run.success:
        raise RuntimeError(run.message)
    return run.q.T, run.v.T, run.lam.T


def test_twoloop_passes_its_own_check():
    report = check_simulator(by_twoloop, ["driven_crank", "force_ends"], tolerances=[1e-5, 1e-8])
    assert report.passed, str(report)


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.slow
def test_twoloop_passes_on_every_problem(name):
    report = check_simulator(by_twoloop, name)
    assert report.passed, str(report)


def by_scipy(problem, times, tolerance):
    """The equations at index 1, which nothing puts back on the constraints."""
    options = {"t_eval": times, "rtol": tolerance, "atol": tolerance}
    y = solve_ivp(lambda t, y: rate_of(problem, t, y), (times[0], times[-1]), start_of(problem), **options).y
    return tuple(part.T for part in np.split(y, 2))


def test_a_tolerance_that_is_not_passed_on():
    report = check_simulator(lambda problem, times, tolerance: by_scipy(problem, times, 1e-4)[0], "driven_crank")
    assert any("it is not used" in failure.hint for failure in report.failures)


def test_index_1_without_projection_leaves_the_constraints():
    report = check_simulator(by_scipy, "pendulum")
    assert properties_that_fail(report) == {"constraints"} and "Project" in report.failures[0].hint


# --- what is returned wrongly, of the known motion itself
def singular_branch(problem, q, v, lam):
    """After the first singular position the second crank goes back where the first one goes on."""
    beyond = problem.reference.t > problem.singular_times[0]
    q[beyond, 3] *= -1.0
    return q, v, lam


WRONG = [
    ("pendulum", lambda problem, q, v, lam: (q, -v, lam), "velocities have the other sign"),
    ("pendulum", lambda problem, q, v, lam: (q, np.vstack([v[:1], v[:-1]]), lam), "the output time before"),
    ("pendulum", lambda problem, q, v, lam: (q, v, -lam), "multipliers have the other sign"),
    ("pendulum", lambda problem, q, v, lam: (q, v, 0.5 * lam), "0.5 times"),
    ("pendulum", lambda problem, q, v, lam: (np.roll(q, 1, axis=0), None, None), "late"),
    ("pendulum", lambda problem, q, v, lam: (np.roll(q, -1, axis=0), None, None), "early"),
    ("heavy_top", lambda problem, q, v, lam: (q * np.where(np.arange(7) < 3, 1, np.sign(q)), None, None), "e and -e"),
    ("crank_rocker", lambda problem, q, v, lam: (np.arctan2(np.sin(q), np.cos(q)), None, None), "whole turns"),
    ("parallelogram", singular_branch, "Right until the first singular position"),
]


@pytest.mark.parametrize(("name", "edit", "words"), WRONG, ids=[f"{name}: {words}" for name, _, words in WRONG])
def test_what_is_returned_wrongly_is_named(name, edit, words):
    report = check_simulator(known(edit), name)
    hints = [failure.hint for failure in report.failures if failure.property not in ("frame", "units")]
    assert any(words in hint for hint in hints), str(report)


@pytest.mark.parametrize("name", [name for name, maker in MAKERS.items() if maker().reference is not None])
def test_the_known_motion_itself_passes(name):
    report = check_simulator(known(), name, tolerances=[1e-8])
    assert properties_that_fail(report) == {"frame", "units"}  # for these it does not know


# --- frames and units are the same problem
@pytest.mark.parametrize("change", [change_frame, change_units])
@pytest.mark.parametrize("name", MAKERS)
def test_a_problem_seen_otherwise_has_the_same_accelerations(name, change):
    problem = MAKERS[name]()
    seen = change(problem)
    q, v, t = problem.q0 + 0.01, problem.v0 + 0.1, 0.2
    there_q, there_v = seen.T @ q + seen.d, seen.T @ v
    back_q, back_v, _ = seen.to_original(there_q, there_v, None)
    assert back_q == pytest.approx(q, abs=1e-12) and back_v == pytest.approx(v, abs=1e-12)
    for kind in ("constraint", "constraint_rate"):
        here, there = getattr(problem, kind)(t, q), getattr(seen.problem, kind)(t, there_q)
        assert there == pytest.approx(seen.rows * here, abs=1e-9 * max(1.0, np.abs(there).max()))
    state = problem.t_span[0], problem.q0, problem.v0
    other = problem.t_span[0], seen.problem.q0, seen.problem.v0
    (a, lam), (there_a, there_lam) = problem.acceleration(*state), seen.problem.acceleration(*other)
    _, back_a, back_lam = seen.to_original(there_q, there_a, there_lam)
    assert back_a == pytest.approx(a, abs=1e-8 * max(1.0, np.abs(a).max()))
    J = problem.jacobian(*state[:2])
    assert J.T @ back_lam == pytest.approx(J.T @ lam, abs=1e-7 * max(1.0, np.abs(lam).max()))
    if problem.energy is not None:
        assert seen.problem.energy(t, there_q, there_v) == pytest.approx(seen.work * problem.energy(t, q, v), rel=1e-9)


# --- failures that are told
def test_silence_is_found_and_a_word_is_not():
    def silent(problem, times, tolerance):
        return np.tile(problem.q0, (times.size, 1))

    def partly(problem, times, tolerance):
        return np.where(times[:, None] > 0.5, np.nan, silent(problem, times, tolerance))

    def raises(problem, times, tolerance):
        raise ArithmeticError("stuck at t = 1")

    assert "Success with a wrong answer" in check_simulator(silent, "out_of_reach").failures[0].hint
    assert check_simulator(partly, ["out_of_reach", "force_ends"]).passed
    assert check_simulator(raises, ["out_of_reach", "force_ends"]).passed
    report = check_simulator(raises, "pendulum")
    assert report.failures[0].property == "runs" and "ArithmeticError: stuck at t = 1" in str(report)
    assert report.skipped == (("pendulum", "everything else", "the run did not come to the end"),)
    assert "q is not finite from t = 0.52 s on" in str(check_simulator(partly, "pendulum"))


def hanging(where, how):
    """A simulator that does not end on some runs."""
    example = module_of(RK).simulate

    def simulate(problem, times, step):
        while where(problem, times, step):
            how()
        return example(problem, times, step)

    return simulate


def beaten():
    """Work whose exceptions are all caught."""
    with suppress(Exception):
        sum(range(100))


HANGS = [  # and the limit, s: runs before the one that hangs have to end, on a loaded machine too
    (lambda problem, times, step: True, "runs", 0.5),
    (lambda problem, times, step: step > 0.019, "runs", 0.5),  # the coarse run alone, which may fail but not hang
    (lambda problem, times, step: problem.reference is None and times.size == 101, "frame", 2),
]


@pytest.fixture
def waiting():
    """What waits in compiled code until the test is over.

    While an exception waits for a thread, Python 3.11 does not get through a function that is profiled.
    """
    over, before = Event(), {*enumerate_threads()}
    yield lambda: over.wait(3600.0)
    over.set()
    for thread in {*enumerate_threads()} - before:
        thread.join(10.0)
        assert not thread.is_alive()


@pytest.mark.parametrize("elsewhere", [False, True], ids=["in Python", "elsewhere"])
@pytest.mark.parametrize(("where", "which", "limit"), HANGS, ids=["always", "coarse", "frame"])
def test_a_run_that_hangs_is_a_failure_and_the_check_ends(where, which, limit, elsewhere, waiting):
    how = waiting if elsewhere else beaten
    report = check_simulator(hanging(where, how), "pendulum", steps=(100, 200), order=4, time_limit=limit)
    assert [failure.property for failure in report.failures] == [which]
    assert report.failures[0].measured.startswith(f"did not end within {limit} s")
    assert which != "frame" or ("pendulum", "units", "a run before it did not end") in report.skipped


def test_redundant_rows_are_named_where_a_run_ends():
    def simulate(problem, times, tolerance):
        J = problem.jacobian(times[0], problem.q0)
        np.linalg.inv(J @ J.T)
        raise ArithmeticError("rank")

    assert "A row of C depends" in check_simulator(simulate, "redundant_slider_crank").failures[0].hint
    assert check_simulator(simulate, "four_bar").failures[0].hint == ""


@pytest.mark.slow
def test_a_coarse_step_may_say_no_and_the_finest_may_not():
    example = module_of(RK).simulate

    def from_step(least):
        def simulate(problem, times, step):
            if step > least * (problem.t_span[1] - problem.t_span[0]):
                raise ValueError("too long a step")
            return example(problem, times, step)

        return simulate

    assert check_simulator(from_step(0.008), "pendulum", steps=(100, 200, 400), order=4).passed
    assert properties_that_fail(check_simulator(from_step(1e-3), "pendulum", steps=(100, 200, 400))) == {"runs"}


# --- the report
def test_the_report():
    report = check_simulator(known(lambda problem, q, v, lam: (q + 0.1, None, None)), ["pendulum", "driven_crank"])
    failure = report.failures[0]
    assert (failure.problem, failure.property) == ("pendulum", "error of q")
    assert failure.measured == pytest.approx(0.1) and 0.0 < failure.allowed < 0.1 and failure.hint
    assert "pendulum: error of q: 0.1, allowed" in str(failure) and "error of q: 0.1" in str(report)
    table = report.to_markdown()
    rows = [line for line in table.splitlines() if line.startswith("|")]
    assert {row.count("|") for row in rows} == {6}
    assert "| pendulum | frame | not measured |  | the motion itself is wrong |" in rows
    assert sum("**failed**" in row for row in rows) == len(report.failures)
