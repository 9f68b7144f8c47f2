"""Events: where functions of the motion are zero, by the rules of SciPy."""

import numba
import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from tests.problems import at_one, event, pendulum, quick, run, swing, unconstrained, violations, worst
from twoloop import Status, solve_dae


def clock(*times, terminal=None):
    """Zero at these times, whatever moves; the sign changes at each."""
    return event(lambda t, q, v: float(np.prod([t - each for each in times])), terminal)


@pytest.fixture(scope="module")
def oscillator():
    """x'' = -x, without constraints: what SciPy solves, too."""
    return unconstrained(lambda t, q, v: -q, compile=True)


@pytest.fixture(scope="module")
def exact(default_four_bar):
    """When theta_3 passes 1, from a run of far more steps than its tolerance asks for."""
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13, "max_step": 1e-2}
    return run(default_four_bar, 4.0, events=at_one(), **options).t_events[0]


@pytest.mark.parametrize("method", quick(["DOP853", "SunRadau5", "Gauss12", "RadauIIA5"], 2))
def test_theta_3_is_one(default_four_bar, exact, method):
    result = run(default_four_bar, 4.0, method=method, rtol=1e-11, atol=1e-11, events=at_one(), dense_output=True)
    (times,), (q,), (v,) = result.t_events, result.q_events, result.v_events
    assert times.size == exact.size == 8 and worst(times, exact) < 1e-11 and worst(q[:, 8], 1.0) < 1e-14
    state = result.sol(times)
    assert (state.q == q.T).all() and (state.v == v.T).all() and max(violations(default_four_bar.system, state)) < 1e-13


@pytest.mark.parametrize("method", quick(["BDF", "SunRadau5", "Gauss8"]))
def test_events_leave_a_run_as_it_is(default_four_bar, method):
    free = run(default_four_bar, 3.0, method=method, rtol=1e-6, atol=1e-6)
    never = clock(10.0, terminal=True)  # short chunks
    searched = run(default_four_bar, 3.0, method=method, rtol=1e-6, atol=1e-6, events=[at_one(), never])
    assert (free.t == searched.t).all() and (free.q == searched.q).all() and (free.lam == searched.lam).all()
    assert free.stats.n_evaluations == searched.stats.n_evaluations and free.t_events is None
    assert searched.t_events[0].size > 0 and searched.t_events[1].size == 0
    assert searched.q_events[1].shape == searched.v_events[1].shape == (0, 9)


@pytest.mark.parametrize("terminal", [True, 1, 3, np.int64(3)])
def test_a_terminal_event_ends_the_run_there(default_four_bar, exact, terminal):
    count = int(terminal)
    result = run(default_four_bar, 4.0, rtol=1e-9, atol=1e-9, events=[at_one(), at_one(terminal)], dense_output=True)
    assert result.status is Status.EVENT and result.success
    assert "events[1]" in result.message and f"t = {result.t[-1]:.10g}" in result.message
    assert result.t[-1] == result.t_events[1][-1] == result.sol.t_max
    assert result.t[-1] == pytest.approx(exact[count - 1], abs=1e-8)
    assert [times.size for times in result.t_events] == [count, count]  # those at the same time are recorded, too
    assert (result.q[:, -1] == result.q_events[1][-1]).all()
    assert result.h.sum() == pytest.approx(result.t[-1], abs=1e-13)
    assert len(result.h) == result.stats.n_accepted == result.t.size - 1 == len(result.rejected_error)
    assert max(violations(default_four_bar.system, result)) < 1e-13
    state = result.sol(result.t[-1])
    assert worst(state.a, result.a[:, -1]) < 1e-11 and worst(state.lam, result.lam[:, -1]) < 1e-11


@pytest.mark.parametrize("t_eval", [None, np.linspace(0.0, 2.0, 21)])
def test_events_of_fixed_steps(default_four_bar, exact, t_eval):
    result = run(default_four_bar, 2.0, method="Gauss6", step_size=0.01, events=[at_one(), at_one(2)], t_eval=t_eval)
    assert result.status is Status.EVENT and worst(result.t_events[0], exact[:2]) < 1e-8
    assert worst(result.h[:-1], 0.01) < 1e-15 and 0.0 < result.h[-1] <= 0.01
    assert result.t[-1] == (result.t_events[1][-1] if t_eval is None else 0.9)


@pytest.mark.parametrize("terminal", [None, 1, 2, 3])
@pytest.mark.parametrize("direction", [None, -1, 0, 1.0])
@pytest.mark.parametrize("start", [(1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
def test_the_rules_are_those_of_scipy(oscillator, start, direction, terminal):
    """x = 0 and v = 0 along x'' = -x, one of them zero at the start."""
    if (terminal or 0) > 1 and tuple(map(int, scipy.__version__.split(".")[:2])) < (1, 12):
        pytest.skip("SciPy counts terminal events from 1.12 on")
    q, v = start
    ours = [event(lambda t, q, v: q[0], terminal, direction), event(lambda t, q, v: v[0] - 0.5)]
    theirs = [event(lambda t, y: y[0], terminal, direction or 0), event(lambda t, y: y[1] - 0.5)]
    result = solve_dae(oscillator, (0.0, 12.0), [q], [v], "DOP853", 1e-10, 1e-10, events=ours)
    scipys = solve_ivp(lambda t, y: (y[1], -y[0]), (0.0, 12.0), start, "DOP853", rtol=1e-10, atol=1e-10, events=theirs)
    assert result.status == scipys.status and result.t[-1] == pytest.approx(scipys.t[-1], abs=1e-8)
    for mine, its in zip(result.t_events, scipys.t_events, strict=True):
        assert mine.size == its.size and mine == pytest.approx(its, abs=1e-8)


@given(st.lists(st.floats(0.05, 1.9), min_size=1, max_size=4, unique=True))
def test_every_crossing_that_is_sampled_is_found(times):
    """Zeros at any times further apart than a quarter of a step, some of them on samples."""
    times = sorted(times)
    if np.diff(times).min(initial=1.0) < 0.02:
        return
    result = swing(2.0, method="SunRadau5", max_step=0.05, events=clock(*times))
    assert result.t_events[0] == pytest.approx(times, abs=1e-14)


@pytest.mark.parametrize("compiled", quick([True, False]))
@pytest.mark.parametrize("method", quick(["auto", "Taylor", "DOP853"]))
@pytest.mark.parametrize("level", [0.97, 0.999])
def test_what_lasts_longer_than_the_widest_gap_is_found(oscillator, method, level, compiled):
    """x = -cos(t) above a level for 0.49 s or 0.09 s, of 20 s; a series takes steps of seconds."""
    end, half = 20.0, np.arccos(level)
    high = [np.pi * each + side for each in (1, 3, 5) for side in (-half, half)]
    events = [event(lambda t, q, v: q[0] - level), event(lambda t, q, v: q[0] - level, 2, 1)]
    result = solve_dae(oscillator, (0.0, end), [-1.0], [0.0], method, compiled=compiled, events=events[0])
    assert result.t_events[0] == pytest.approx(high, abs=1e-5)
    if level == 0.97:
        assert result.widest_gap < 2.0 * half and (method == "DOP853" or result.h.max() > 1.0)
    result = solve_dae(oscillator, (0.0, end), [-1.0], [0.0], method, compiled=compiled, events=events[1])
    assert result.status is Status.EVENT and result.t[-1] == pytest.approx(high[2], abs=1e-5)


@pytest.mark.parametrize("method", quick(["Taylor", "RadauIIA9", "BDF"]))
def test_samples_are_no_further_apart_than_a_400th_of_the_run(oscillator, method):
    seen = []
    watch = event(lambda t, q, v: seen.append(t) or 1.0)
    result = solve_dae(oscillator, (5.0, 25.0), [-1.0], [0.0], method, 1e-6, 1e-6, events=watch)
    assert np.diff(seen).max() <= 20.0 / 400.0 * (1.0 + 1e-8) and (np.isin(result.t, seen)).all()
    assert method == "Taylor" or len(seen) == 4 * len(result.h) + 1  # steps of a hundredth of the run at most


@pytest.mark.parametrize("at", [0.5, 1 / 512, 1.0, 255 / 512])
def test_a_zero_on_a_sample_counts_once(at):
    """Fixed steps of 1/128 with samples at 1/512: the zero is exactly on the end of a step, or within."""
    result = swing(1.0, method="Gauss8", step_size=1 / 128, events=[clock(at), clock(at, terminal=True)])
    assert [times.tolist() for times in result.t_events] == [[at], [at]] and result.t[-1] == at and result.h.sum() == at


def test_a_terminal_zero_at_the_start_ends_the_run_at_once():
    result = swing(1.0, events=clock(0.0, terminal=True), dense_output=True)
    assert result.status is Status.EVENT and (result.t == [0.0]).all() and result.h.size == 0
    assert (result.sol(0.0).q == result.q[:, 0]).all()


def test_what_fails_beyond_a_terminal_event_does_not_matter():
    def force(t, q, v):
        if t > 0.8:
            raise RuntimeError("no force there")
        return np.array([0.0, -9.81])

    system = pendulum(force=force)
    result = swing(2.0, system=system, events=clock(0.5, terminal=True))
    assert result.status is Status.EVENT and result.t[-1] == pytest.approx(0.5)
    with pytest.raises(RuntimeError, match="no force there"):
        swing(2.0, system=system, events=clock(0.5))


def raising(t, q, v):
    raise KeyError("tip")


def test_an_exception_of_an_event_comes_through_with_a_note():
    with pytest.raises(KeyError, match="tip") as caught:
        swing(1.0, events=[clock(0.5), raising])
    assert caught.value.__notes__ == ["raised by events[1] (raising) at t = 0.0"]


def test_a_value_that_is_wrong_later_is_named_with_its_time():
    with pytest.raises(ValueError, match=r"events\[0\] must return a finite number; at t = 0\.\d+ it returned nan"):
        swing(1.0, events=lambda t, q, v: np.nan if t > 0.3 else 1.0)


def test_compiled_events():
    @numba.njit
    def lowest(t, q, v):
        return q[0]

    result = swing(2.0, events=lowest)
    assert result.t_events[0].size > 0 and worst(result.q_events[0][:, 0], 0.0) < 1e-14
