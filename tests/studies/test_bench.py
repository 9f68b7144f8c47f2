"""The bench on a mechanism that is not the four-bar: rows, repetitions, failures, limits, resuming, references."""

import os
import signal
import time
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from references.driver import user_call
from studies.bench import collector as bench
from studies.bench.apart import TimeLimit
from studies.bench.collector import CALLS, SETTLING, Case, NotApplicable, Run, Solver, collect
from studies.bench.reference_motion import Quintic, ReferenceMotion, check_published
from studies.bench.solvers import CATALOGUE
from studies.bench.store import KeptRows
from tests.problems import pendulum_problem, pendulum_state, worst
from twoloop import Status, solve_dae
from twoloop.problem.problem import Reference

T_END = 1.0


def problem(**options):
    return pendulum_problem(T_END, **options)


def case(**changed):
    def known():
        return ReferenceMotion(lambda t: pendulum_state(t)[:2], 1e-13, "elliptic functions")

    return Case("pendulum", problem(), T_END, **{"known": known, "n_instants": 50, "timed": 0.0, **changed})


def solver(run, name="a solver", **changed):
    return Solver(name, "two-loop", "compiled", True, "tol", run, (1e-6,), **changed)


def ours(case, value, repeat):
    return solve_dae(case.problem.system, (0.0, case.t_end), case.problem.q0, case.problem.v0, rtol=value, atol=value)


@pytest.fixture
def kept(tmp_path):
    return KeptRows(tmp_path / "x.partial.jsonl", {})


def row(kept, run, case_=None, **changed):
    with kept:
        return collect([Run(case_ or case(), solver(run), 1e-6, repeats=1)], kept, **changed).iloc[0]


def test_every_repetition_is_a_row_and_repetitions_are_interleaved(kept):
    order = []

    def named(name):
        def run(case, value, repeat):
            if case.t_end == T_END:  # not the warm-up
                order.append((name, repeat))
            return ours(case, value, repeat)

        return solver(run, name)

    with kept:
        rows = collect([Run(case(), named(name), 1e-6, "group", repeats=2) for name in "ab"], kept)
    assert order == [("a", 0), ("b", 0), ("a", 1), ("b", 1)]
    assert rows["solver"].tolist() == ["a", "a", "b", "b"] and rows["repeat"].tolist() == [0, 1, 0, 1]
    assert (rows["error_q"] < 1e-5).all() and (rows["violation_q"] < 1e-13).all() and not rows["lost"].any()
    assert (rows["called_from"] == "Python").all()  # whatever the solver: the mechanism is plain Python
    assert (rows["tol"] == 1e-6).all() and (rows["group"] == "group").all()


@pytest.mark.parametrize(("timed", "calls"), [(0.0, 1), (1e9, CALLS)])
def test_a_short_run_is_called_several_times_more(kept, timed, calls):
    assert row(kept, ours, case(timed=timed))["calls"] == calls


@pytest.mark.slow
def test_runs_of_ours_are_timed_at_starts_that_no_call_has_had(kept):
    begun = []

    def run(case, value, repeat):
        _, (t0, t1), q0, v0 = case.start
        begun.append((t1 - t0 == pytest.approx(T_END), t0, *q0, *v0))
        return ours(case, value, repeat)

    with kept:
        collect([Run(case(timed=1e9), solver(run), 1e-6, repeats=2)], kept)
    timed = [start for whole, *start in begun if whole and start[0] > 0.0]
    assert len(timed) == len({tuple(start) for start in timed}) == 2 * (SETTLING + CALLS)
    for t0, *state in timed:
        q, v, _ = pendulum_state(t0)
        assert 0.0 < t0 < 1e-6 and worst(state, [*q, *v]) < 1e-12


@pytest.mark.slow
def test_the_first_call_of_a_setting_is_made_again_where_it_may_hold_a_build(kept):
    counted = []

    def building(case, value, repeat):
        if case.t_end == T_END:  # not the warm-up
            counted.append(repeat)
            spend(0.3 if len(counted) == 1 else 0.01)
        return ours(case, value, repeat)

    with kept:
        rows = collect([Run(case(timed=0.25), solver(building), 1e-6, repeats=2)], kept)
    # the build, the call that says how long one takes, and more that are settling or timed; ...
    assert counted == [0] * (2 + SETTLING + CALLS) + [1] * (1 + SETTLING + CALLS)
    assert (rows["call_s"] < 0.3).all() and (rows["calls"] == CALLS).all()


def not_installed():
    error = RuntimeError("foreign is not installed: pip install foreign")
    error.__context__ = ImportError("No module named 'foreign'")
    return error


@pytest.mark.parametrize(
    ("raised", "status", "says"),
    [
        (NotApplicable("needs a model of its own"), "NOT_APPLICABLE", "needs a model of its own"),
        (ImportError("No module named 'foreign'"), "NOT_AVAILABLE", "foreign"),
        (not_installed(), "NOT_AVAILABLE", "pip install foreign"),
        (RuntimeError("cannot start"), "RAISED", "cannot start"),
        (ZeroDivisionError("by zero"), "RAISED", "ZeroDivisionError: by zero"),
    ],
)
def test_what_cannot_be_run_is_a_row(kept, raised, status, says):
    def run(case, value, repeat):
        raise raised

    got = row(kept, run)
    assert got["status"] == status and says in got["message"]
    assert got["error_q"] is None and got["lost"] and got["astray"]


def spend(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


@pytest.mark.parametrize(("marked", "said"), [(True, "0.05 s of CPU time, the limit of a run"), (False, "0.5 s")])
@pytest.mark.slow
def test_a_run_past_its_limit_is_a_row(kept, marked, said):
    def run(case, value, repeat):
        with user_call if marked else nullcontext():
            while case.t_end == T_END:
                pass
        return ours(case, value, repeat)

    with kept:  # not repeated, unlike one that ends in time
        rows = collect([Run(case(time_limit=0.05), solver(run), 1e-6, repeats=3)], kept)
    assert rows["status"].tolist() == ["TIME_LIMIT"] and said in rows["message"][0]


@pytest.mark.parametrize("made", ["raised", "failed", "ended"])
def test_a_limit_is_one_whatever_a_foreign_library_makes_of_it(kept, made):
    def run(case, value, repeat):
        result = ours(case, value, repeat)
        if case.t_end < T_END:
            return result
        try:
            with user_call:
                spend(10.0)
        except TimeLimit:
            if made == "raised":
                raise RuntimeError("KeyboardInterrupt") from None
        failed = {"status": Status.SOLVER_FAILED, "message": "failed: KeyboardInterrupt"}
        return result if made == "ended" else replace(result, **failed)

    got = row(kept, run, case(time_limit=0.05))
    assert got["status"] == "TIME_LIMIT" and "0.05 s" in got["message"] and got["error_q"] is None


@pytest.mark.parametrize(("builds_span", "warm_up"), [(True, (T_END, 7.0)), (False, (1e-3 * T_END, bench.COMPILING))])
def test_the_warm_up_builds_the_time_span_or_may_take_longer_than_a_run(kept, builds_span, warm_up):
    calls = []

    def run(case, value, repeat):
        calls.append((case.t_end, case.time_limit))
        return ours(case, value, repeat)

    with kept:
        collect([Run(case(time_limit=7.0), solver(run, builds_span=builds_span), 1e-6, repeats=1)], kept)
    assert calls == [warm_up, (T_END, 7.0)]


def test_the_time_limit_sets_no_timer_of_cpu_time(kept):
    set_ = []

    def run(case, value, repeat):  # such a timer makes Linux's clocks of CPU time advance in ticks of 4 ms
        set_.append([signal.getitimer(kind)[0] > 0.0 for kind in (signal.ITIMER_PROF, signal.ITIMER_REAL)])
        return ours(case, value, repeat)

    assert row(kept, run, case(time_limit=60.0))["status"] == "REACHED_END"
    assert set_ == [[False, True]] * 2 and signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_a_failed_run_keeps_what_it_had(kept):
    def run(case, value, repeat):
        result = ours(case, value, repeat)
        t = result.t[:5]
        cut = {name: getattr(result, name)[:, :5] for name in ("q", "v", "a", "lam")}
        return replace(result, t=t, **cut, status=Status.STEP_TOO_SMALL, message="stuck")

    got = row(kept, run)
    assert got["status"] == "STEP_TOO_SMALL" and got["message"] == "stuck"
    assert got["violation_q"] < 1e-13 and got["error_q"] is None and got["lost"] is not None


def test_further_columns_come_from_the_study(kept):
    def measure(run, result):
        return {"largest_x": result.q[0].max(), "curve": result.t[:3]}

    got = row(kept, ours, measure=measure)
    assert got["largest_x"] == pytest.approx(1.0, abs=0.6) and len(got["curve"]) == 3


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_keeps_finished_rows_and_the_next_start_goes_on(kept):
    calls = []

    def run(case, value, repeat):
        if case.t_end == T_END:
            calls.append(value)
            if len(calls) == 2:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(1.0)
        return ours(case, value, repeat)

    runs = [Run(case(), solver(run), tolerance, repeats=1) for tolerance in (1e-5, 1e-6, 1e-7)]
    with pytest.raises(KeyboardInterrupt), kept:
        collect(runs, kept)
    again = KeptRows(kept.path, {})
    with again:
        rows = collect(runs, again)
    assert again.n_resumed == 1 and calls == [1e-5, 1e-6, 1e-6, 1e-7]
    assert rows["tol"].tolist() == [1e-5, 1e-6, 1e-7] and rows["error_q"].notna().all()


def test_an_interrupted_result_stops_the_collector(kept):
    def run(case, value, repeat):
        class Interrupted:
            name = "INTERRUPTED"

        return replace(ours(case, value, repeat), status=Interrupted())

    with pytest.raises(KeyboardInterrupt):
        row(kept, run)


def test_the_time_is_that_of_the_whole_call_or_of_what_an_adapter_marks(kept):
    def beside():  # what a call does beside the integration
        spend(0.02)

    def whole(case, value, repeat):
        beside()
        return ours(case, value, repeat)

    marks = []

    def marked(case, value, repeat):
        beside()
        with user_call:
            result = ours(case, value, repeat)
        marks.append(user_call.seconds)
        beside()
        return result

    with kept:
        both = collect([Run(case(), solver(run, run.__name__), 1e-6, repeats=1) for run in (marked, whole)], kept)
    call, inside = (both.set_index("solver")[name] for name in ("call_s", "inside_s"))
    assert call["marked"] == marks[-1] >= inside["marked"] and call["whole"] >= 0.02 + inside["whole"] > 0.02


def test_two_equal_runs_are_refused(kept):
    with kept, pytest.raises(ValueError, match="same group"):
        collect([Run(case(), solver(ours), 1e-6)] * 2, kept)


def test_a_published_state_checks_the_reference():
    q, v, _ = pendulum_state(0.5)
    right = replace(problem(), reference=Reference(0.5, q, v, "closed form"))
    wrong = replace(problem(), reference=Reference(0.5, q + 1e-3, v, "closed form"))
    motion = case().reference
    assert check_published(right, motion, T_END) < 1e-14
    assert check_published(wrong, motion, T_END) == pytest.approx(1e-3)
    assert check_published(right, motion, 0.4) is None and check_published(problem(), motion, T_END) is None


def test_the_quintic_is_exact_on_polynomials_of_degree_5():
    t = np.array([0.0, 0.3, 1.0])
    p = np.polynomial.Polynomial([1.0, -2.0, 0.5, 3.0, -1.0, 0.7])
    motion = Quintic(t, p(t)[None], p.deriv()(t)[None], p.deriv(2)(t)[None])
    times = np.linspace(0.0, 1.0, 11)
    q, v = motion(times)
    assert worst(q[0], p(times)) < 1e-14 and worst(v[0], p.deriv()(times)) < 1e-13


def test_foreign_solvers_run_any_mechanism_or_say_why_not(kept):
    names = ("Exudyn, GeneralizedAlpha", "IDA from C, stabilised", "DOP853 (twoloop)")
    with kept:
        rows = collect(
            [Run(case(), CATALOGUE[name], CATALOGUE[name].grid(case())[1], repeats=1) for name in names], kept
        )
    status = dict(zip(rows["solver"], rows["status"], strict=True))
    assert status[names[0]] == status[names[1]] == "NOT_APPLICABLE" and status[names[2]] == "REACHED_END"
    assert "model of its own" in rows["message"][0] and "compiled" in rows["message"][1]
