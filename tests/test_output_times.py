"""t_eval: interpolated where steps adapt, landed on where they are fixed or the paper's."""

import numpy as np
import pytest

from tests.problems import pendulum_state, quick, run, swing, worst
from twoloop import Status
from twoloop.methods.presets import PRESETS
from twoloop.run.dense import Interpolator

PAPERS = ("PaperIRK", "PaperNewmark")
ADAPTIVE = [name for name in PRESETS if name not in PAPERS]
TIMES = np.linspace(0.0, 1.0, 1001)


@pytest.mark.parametrize("method", quick(ADAPTIVE, 4))
def test_output_times_change_neither_steps_nor_counts(default_four_bar, method):
    options = {"method": method, "rtol": 1e-6, "atol": 1e-6}
    free = run(default_four_bar, 1.0, **options)
    given = run(default_four_bar, 1.0, t_eval=TIMES, **options)
    assert (given.t == TIMES).all() and (given.h == free.h).all()
    for name in ("n_accepted", "n_rejected_error", "n_outer", "n_inner", "n_evaluations", "n_factorizations"):
        assert getattr(given.stats, name) == getattr(free.stats, name), name
    assert (given.q[:, -1] == free.q[:, -1]).all()


@pytest.mark.parametrize("method", quick(["BDF", "SunRadau5", "Gauss12", "RadauIIA5"]))
def test_they_are_those_of_the_dense_solution(default_four_bar, method):
    given = run(default_four_bar, 1.0, method=method, t_eval=TIMES, dense_output=True)
    alone = run(default_four_bar, 1.0, method=method, t_eval=TIMES)
    state = given.sol(TIMES)
    for result in (given, alone):  # steps looked at chunk by chunk, and none kept
        assert worst(result.q, state.q) < 1e-14 and worst(result.v, state.v) < 1e-13
        assert worst(result.a, state.a) < 1e-11 and worst(result.lam, state.lam) < 1e-11
    assert alone.sol is None


@pytest.mark.parametrize("times", [[0.3, 0.31, 0.7, 1.9], [2.0], [0.0], [0.3, 0.30000001]])
def test_a_run_goes_to_its_end_whatever_times_are_asked_for(times):
    result = swing(t_eval=times, rtol=1e-9, atol=1e-9)
    assert result.success and (result.t == times).all() and worst(result.q, pendulum_state(np.array(times))[0]) < 1e-8
    assert result.h.sum() == pytest.approx(2.0, abs=1e-13)


@pytest.mark.parametrize(
    ("method", "times"), quick([("auto", [0.0]), ("auto", [1.0]), *((name, [0.0, 1.0]) for name in ADAPTIVE)], 5)
)
def test_nothing_is_interpolated_at_the_ends_of_a_run(default_four_bar, method, times, monkeypatch):
    made = []
    states = Interpolator.states
    monkeypatch.setattr(Interpolator, "states", lambda self, *given: made.append(self) or states(self, *given))
    every = run(default_four_bar, 1.0, method=method)
    result = run(default_four_bar, 1.0, method=method, t_eval=times)
    at = np.flatnonzero(np.isin(every.t, times))
    assert (result.t == times).all() and (result.h == every.h).all()
    for name in ("q", "v", "a", "lam"):
        assert (getattr(result, name) == getattr(every, name)[:, at]).all(), name
    assert not made
    run(default_four_bar, 1.0, method=method, t_eval=[0.5, 1.0])
    assert made


@pytest.mark.parametrize("method", PAPERS)
def test_the_procedures_of_the_paper_land(default_four_bar, method):
    options = {"method": method, "rtol": 1e-5, "atol": 1e-5}
    free = run(default_four_bar, 0.5, **options)
    landed = run(default_four_bar, 0.5, t_eval=[0.123, 0.5], **options)
    assert (landed.t == [0.123, 0.5]).all() and (landed.h.size != free.h.size or worst(landed.h, free.h) > 0.0)
    assert np.abs(np.cumsum(landed.h) - 0.123).min() < 1e-12


@pytest.mark.parametrize("method", ["SunRadau5", "Gauss8"])
def test_a_failed_run_has_the_times_that_it_reached(default_four_bar, method):
    result = run(default_four_bar, 1.0, method=method, t_eval=TIMES, max_steps=10)
    assert result.status == Status.MAX_STEPS and 1 < result.t.size < TIMES.size
    assert (result.t == TIMES[: np.searchsorted(TIMES, result.h.sum(), side="right")]).all()
