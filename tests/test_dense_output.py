"""result.sol: between the steps as good as at them, and on the constraints."""

import copy
import pickle
import warnings

import numpy as np
import pytest

from tests.general.mechanisms import mechanism
from tests.problems import force_residual, pendulum_state, quick, run, swing, violations, worst
from twoloop import RungeKutta, Status, solve_dae
from twoloop.methods.presets import PRESETS
from twoloop.methods.tableaux import gauss, lobatto_iiie
from twoloop.run.dense_solution import Interpolator

END = 2.0
LOOSE = ("Newmark", "BDF", "TRBDF2", "ESDIRK4", "PaperIRK", "PaperNewmark")  # steps without number at tight tolerances
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-12)
INNER = (0.1, 0.3, 0.5, 0.7, 0.9)


@pytest.fixture(scope="module")
def exact(default_four_bar):
    """The motion from a run of far more steps than its tolerance asks for."""
    return run(default_four_bar, END, method="DOP853", rtol=1e-13, atol=1e-13, max_step=4e-3, dense_output=True).sol


def between(result, parts=INNER):
    """Times within every step."""
    return np.concatenate([result.t[:-1] + part * np.diff(result.t) for part in parts])


def errors(result, exact):
    """Errors of q and v at the steps, and between them."""
    t, inner = result.t[1:], between(result)
    at_steps, within = exact(t), result.sol(inner)
    known = exact(inner)
    return (
        (worst(result.q[:, 1:], at_steps.q), worst(within.q, known.q)),
        (worst(result.v[:, 1:], at_steps.v), worst(within.v, known.v)),
    )


@pytest.mark.parametrize(
    ("method", "tol"),
    quick([(name, tol) for tol in TOLERANCES for name in PRESETS if name not in LOOSE or tol > 1e-8], len(PRESETS)),
)
def test_between_the_steps_as_good_as_at_them(default_four_bar, exact, method, tol):
    result = run(default_four_bar, END, method=method, rtol=tol, atol=tol, dense_output=True)
    (at_q, between_q), (at_v, between_v) = errors(result, exact)
    # where extrapolation makes steps far better than their tolerance asks for, what lies between them may be less so
    assert between_q < max(4.0 * at_q, 0.01 * tol) + 1e-13
    # at loose tolerances velocities between long steps of DOP853 are seven times as far off, however these fall
    assert between_v < max(10.0 * at_v, 0.6 * tol * np.abs(result.v).max()) + 2e-10


ORDERS = [("DOP853", 8, 0.04), ("Gauss8", 8, 0.04), ("RadauIIA5", 5, 0.01), ("BDF", 5, 0.005), ("Newmark", 2, 0.01)]
ORDERS += [("SunRadau5", 5, 0.02), ("Gauss4", 4, 0.02), ("Gauss6", 6, 0.02), ("Gauss12", 12, 0.04)]
ORDERS += [("RadauIIA9", 9, 0.04), ("PaperIRK", 5, 0.02), ("PaperNewmark", 2, 0.01)]
ORDERS += [(RungeKutta(lobatto_iiie(3)), 4, 0.02)]
ORDERS += [(RungeKutta(gauss(3), partition="symmetric"), 6, 0.02)]


@pytest.mark.parametrize(("method", "order", "h"), quick(ORDERS, 5))
def test_order_between_the_steps(default_four_bar, exact, method, order, h):
    found = []
    for step in (h, 0.5 * h):
        result = run(default_four_bar, 0.8, method=method, step_size=step, dense_output=True)
        assert result.success
        (_, in_q), (_, in_v) = errors(result, exact)
        found.append((in_q, in_v))
    rates = np.log2(np.array(found[0]) / np.array(found[1]))
    rounded = np.array(found[1]) < 2e-11  # slopes of polynomials between steps: some hundred roundings of q over h
    assert ((rates > order - 0.5) | rounded).all(), rates


def test_on_the_constraints_at_ten_thousand_times(default_four_bar):
    result = run(default_four_bar, 10.0, rtol=1e-6, atol=1e-6, dense_output=True)
    position, velocity = violations(default_four_bar.system, result.sol(np.linspace(0.0, 10.0, 10_001)))
    assert position < 1e-14 and velocity < 1e-13


OTHERS = ("redundant slider-crank", "massless coordinate", "knife edge", "driven crank", "planet")
ACROSS = "A02, N = 1"  # a singular position
RUNS = [(ACROSS, "DOP853"), *((name, method) for method in ("Gauss12", "RadauIIA5", "SunRadau5") for name in OTHERS)]


@pytest.mark.parametrize(("name", "method"), quick(RUNS, 6))
def test_other_mechanisms(name, method):
    """Redundant rows, a singular mass, non-holonomic rows, a drive, no constraints at all; rank lost on the way."""
    m, end = mechanism(name), 2.0 if name == ACROSS else 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of redundant rows
        result = solve_dae(m.system(), (0.0, end), *m.start, method, dense_output=True, check_derivatives=False)
    t = np.linspace(0.0, end, 41)
    state = result.sol(t)
    assert worst(state.q, m.states(t)[0]) < 2.0 * worst(result.q, m.states(result.t)[0]) + 1e-12
    if name != ACROSS:
        assert force_residual(m.system(), state) < 4.0 * force_residual(m.system(), result) + 1e-11


@pytest.mark.parametrize("max_steps", quick([1, 2, 3, 4], 2))
@pytest.mark.parametrize("method", ["DOP853", "Gauss8"])
def test_a_run_of_few_steps_covers_what_was_computed(default_four_bar, method, max_steps):
    result = run(default_four_bar, 1.0, method=method, max_steps=max_steps, dense_output=True)
    assert result.status == Status.MAX_STEPS and (result.sol.t_min, result.sol.t_max) == (0.0, result.t[-1])
    assert worst(result.sol(0.5 * result.t[-1]).q[:, None], result.q) < 0.1
    with pytest.raises(ValueError, match="must lie within the run"):
        result.sol(1.0)


@pytest.mark.parametrize("method", quick(["SunRadau5", "Gauss8"]))
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda result: pickle.loads(pickle.dumps(result))])
def test_copies(default_four_bar, method, copied):
    result = run(default_four_bar, 0.5, method=method, dense_output=True)
    state, again = result.sol(0.3), copied(result).sol(0.3)
    assert (state.q == again.q).all() and (state.lam == again.lam).all()


# --- t_eval: interpolated where steps adapt, landed on where they are fixed or the paper's
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
    for result in (given, alone):  # interpolated chunk by chunk, and no step kept
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
