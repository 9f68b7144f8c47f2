"""Between steps of very unequal lengths, beside singular positions and forces that jump: as good as at the steps."""

import warnings
from itertools import pairwise

import numpy as np
import pytest

from tests.problems import event, pendulum
from twoloop import ConstraintWarning, Status, solve_dae
from twoloop.mechanisms import four_bar, n_four_bar

PARTS = (0.13, 0.3, 0.5, 0.75)


def inside(t):
    return np.sort(np.concatenate([t[:-1] + part * np.diff(t) for part in PARTS]))


def worst(state, motion):
    """Largest error of positions, and of velocities."""
    pairs = [(state.q[:, k], state.v[:, k], *motion(t)) for k, t in enumerate(state.t)]
    return np.array([(np.abs(q - exact).max(), np.abs(v - rate).max()) for q, v, exact, rate in pairs]).max(axis=0)


def across(problem, end, tolerances, **options):
    """The first run that reaches its end: rounding decides whether there is a step across a singular position."""
    for tol in tolerances:
        result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, "Adams", tol, tol, **options)
        if result.status != Status.STEP_TOO_SMALL:
            break
    return result


@pytest.mark.parametrize(
    ("windows", "tolerances", "end", "compiled"),
    [(3, (3e-9, 2e-9, 1e-8, 2e-8, 5e-8), 10.0, False), (2, (1e-7, 5e-8, 2e-7), 3.0, True)],
)
def test_steps_across_singular_positions(windows, tolerances, end, compiled):
    problem = n_four_bar(windows)
    result = across(problem, end, tolerances, dense_output=True, compiled=compiled)
    assert result.success
    assert result.h.max() / result.h.min() > 100.0  # else there is nothing to see
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        state = result.sol(inside(result.t))
    assert (worst(state, problem.motion) < 20.0 * worst(result, problem.motion)).all()  # they were off by metres
    rows = [problem.system.velocity_constraint(t, q, v) for t, q, v in zip(state.t, state.q.T, state.v.T, strict=True)]
    off = int((np.abs(rows).max(axis=1) >= 1e-10).sum())  # beside such a position rounding decides whether one is
    assert off == 0 or (off <= 3 and [each.category for each in said] == [ConstraintWarning])


def test_no_event_that_is_none_ends_a_run():
    problem = n_four_bar(3)
    far_away = event(lambda t, q, v: 9.0 - np.abs(q).max(), terminal=True)  # the bars reach 4 m
    t = np.linspace(0.0, 10.0, 5000)
    result = across(problem, 10.0, (3e-9, 2e-9, 1e-8, 2e-8, 5e-8), events=far_away, t_eval=t)
    assert result.status == Status.REACHED_END and result.t_events[0].size == 0
    assert worst(result, problem.motion).max() < 1e-5


def swung_by(force):
    return pendulum(force=force, constant_mass=True)


GUST = swung_by(lambda t, q, v: np.array([20.0 * np.exp(-(((t - 1.5) / 0.03) ** 2)), -9.81])), [0.0, -1.0]
RUBBING = swung_by(lambda t, q, v: np.array([0.0, -9.81]) - 3.0 * np.tanh(v / 0.01)), [1.0, 0.0]
BRAKE = swung_by(lambda t, q, v: np.array([0.0, -9.81]) - (3.0 * v if t > 1.0 else 0.0 * v)), [1.0, 0.0]


@pytest.mark.parametrize(
    ("case", "method", "tol"),
    [
        (GUST, "DOP853", 1e-10),
        (RUBBING, "DOP853", 1e-7),
        (RUBBING, "BDF", 1e-8),
        (BRAKE, "DOP853", 1e-8),
        (BRAKE, "Adams", 1e-10),
        (BRAKE, "Gauss8", 1e-10),
        (BRAKE, "RadauIIA9", 1e-8),
    ],
)
def test_sharp_forces(case, method, tol):
    """Beside steps that the force made short, and within these."""
    system, q0 = case
    span = (system, (0.0, 2.0), q0, [0.0, 0.0])
    result = solve_dae(*span, method, tol, tol, dense_output=True)
    assert result.success
    t = inside(result.t)
    pieces = [0.0, 1.0, 2.0] if case is BRAKE else [0.0, 2.0]
    exact = np.hstack([np.vstack([each.q, each.v]) for each in _exact(span, pieces, t)])
    state = result.sol(t)
    allowed = 30.0 * tol + 5.0 * np.abs(np.vstack([result.q, result.v])[:, -1] - exact[:, -1]).max()
    assert np.abs(np.vstack([state.q, state.v]) - exact).max() < allowed


def _exact(span, pieces, t):
    """States at t, piece by piece: what a force does at its jump belongs to no step."""
    system, _, q, v = span
    for begin, end in pairwise(pieces):
        here = t[(t >= begin) & (t < end)] if end < pieces[-1] else t[t >= begin]
        stops = np.append(here, end) if end < pieces[-1] else here
        made = solve_dae(system, (begin, end), q, v, "DOP853", 1e-12, 1e-12, max_step=0.005, dense_output=True)
        q, v = made.q[:, -1], made.v[:, -1]
        yield made.sol(stops[: len(here)])


@pytest.mark.parametrize(("method", "share"), [("DOP853", 0.02), ("Adams", 0.02), ("BDF", 0.02), ("SunRadau5", 0.02)])
def test_on_a_smooth_mechanism_neighbouring_states_serve(method, share):
    problem = four_bar()
    result = solve_dae(problem.system, (0.0, 2.0), problem.q0, problem.v0, method, dense_output=True)
    result.sol(inside(result.t))
    assert len(result.sol.interpolator.filled) <= max(1, share * result.h.size)
