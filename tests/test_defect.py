"""Steps that check themselves: forces that a series cannot foresee, and that a long step passes over."""

import numpy as np
import pytest

from tests.sharp_forces import AT_REST, START, T_END, brake, drag, gust, pendulum, reference, start_of, stop, switching
from twoloop import solve_dae
from twoloop.mechanisms import four_bar

# forces as they are given, so that references are made once
FORCES = {
    "gust of 30 ms on a pendulum at rest": (gust(0.03), AT_REST),
    "gust of 50 ms, going down": (gust(0.05, 1.1, -7.0), START),
    "drag through zero speed": (drag, START),
    "brake": (brake(0.01), START),
    "stop": (stop, START),
    "switching": (switching, AT_REST),
}
SYSTEMS = {name: pendulum(force) for name, (force, _) in FORCES.items()}
MISSED = 3e3  # tolerances that an end may be off after 3 s


def off(name, **options):
    force, state = FORCES[name]
    result = solve_dae(SYSTEMS[name], (0.0, T_END), *start_of(state), **options)
    assert result.success, result.message
    return result, np.abs(result.q[:, -1] - reference(force, state)).max()


@pytest.mark.parametrize("compiled", [False, True], ids=["general", "compiled"])
@pytest.mark.parametrize("name", FORCES)
def test_a_series_sees_what_it_cannot_foresee(name, compiled):
    for tolerance in (1e-5, 1e-8, 1e-11):
        result, error = off(name, method="Taylor", compiled=compiled, rtol=tolerance, atol=tolerance)
        assert error < MISSED * max(tolerance, 1e-12) and 0.0 <= result.defect < 10.0
        assert result.widest_gap <= 0.01 * T_END * (1.0 + 1e-9)


@pytest.mark.parametrize("method", ["auto", "DOP853", "Adams", "Gauss8", "RadauIIA9", "RadauIIA13", "SunRadau5"])
@pytest.mark.parametrize("name", ["gust of 30 ms on a pendulum at rest", "drag through zero speed"])
def test_no_method_passes_over_a_hundredth_of_the_run(name, method):
    for tolerance in (1e-4, 1e-9):
        result, error = off(name, method=method, rtol=tolerance, atol=tolerance)
        assert error < MISSED * tolerance and result.widest_gap <= 0.01 * T_END * (1.0 + 1e-9)


@pytest.mark.parametrize("name", ["brake", "switching"])
@pytest.mark.parametrize(("method", "tolerances"), [("TRBDF2", (1e-4, 1e-7)), ("ESDIRK4", (1e-6, 1e-8))])
def test_few_digits_and_many_are_what_was_asked_for(name, method, tolerances):
    for tolerance in tolerances:
        _, error = off(name, method=method, rtol=tolerance, atol=tolerance, max_step=0.01 * T_END)
        assert error < 300.0 * tolerance


def test_other_methods_do_not_say_a_defect():
    result, _ = off("brake", method="DOP853")
    assert result.defect is None and result.widest_gap == pytest.approx(result.h.max())


def test_constant_steps_say_how_wide_they_are():
    problem = four_bar()
    result = solve_dae(problem.system, (0.0, 0.5), problem.q0, problem.v0, method="Gauss8", step_size=0.02)
    assert result.defect is None and result.widest_gap == pytest.approx(0.02)


def test_smooth_motion_costs_a_look_at_each_hundredth_of_the_run():
    problem = four_bar()
    run = {}
    for t_end in (2.0, 20.0):
        start = problem.system, (0.0, t_end), problem.q0, problem.v0
        run[t_end] = solve_dae(*start, "Taylor", rtol=1e-8, atol=1e-8, compiled=False)
        assert run[t_end].stats.n_rejected_error <= 1
    # the looks within steps are a hundred, and one more a step, however long the run is
    evaluations = [each.stats.n_evaluations / each.stats.n_accepted for each in run.values()]
    assert evaluations[1] < evaluations[0] < evaluations[1] + 100.0 / run[2.0].stats.n_accepted + 2.0


SQUARE = {
    "drag from rest": drag,
    "root of the time": lambda t, q, v: np.array([np.sqrt(t), -9.81]),
    "tanh of large numbers": lambda t, q, v: np.array([2.0 * np.tanh((t - 1.0) / 0.001), -9.81]),
    "decay within a thousandth": lambda t, q, v: np.array([5.0 * np.exp(-t / 1e-3), -9.81]),
    "a high power of a negative number": lambda t, q, v: np.array([3.0 * ((q[0] - 0.9) / 1.6) ** 65, -9.81]),
}


@pytest.mark.parametrize("compiled", [False, True], ids=["general", "compiled"])
@pytest.mark.parametrize("name", SQUARE)
def test_auto_goes_on_where_a_series_is_not_finite(name, compiled):
    force, state = SQUARE[name], (0.7, 0.0)
    system = pendulum(force)
    expected = reference(force, state)
    for tolerance in (1e-7, 1e-10):
        result = solve_dae(
            system, (0.0, T_END), *start_of(state), rtol=tolerance, atol=tolerance, compiled=compiled, dense_output=True
        )
        assert result.success, result.message
        assert np.abs(result.q[:, -1] - expected).max() < MISSED * tolerance
        assert np.abs(np.sum(result.sol(0.5 * (result.t[1:] + result.t[:-1])).q ** 2, axis=0) - 1.0).max() < 1e-12


@pytest.mark.parametrize("compiled", [False, True])
def test_a_series_that_is_not_finite_says_so(compiled):
    start = pendulum(drag), (0.0, 1.0), *start_of((0.7, 0.0))
    result = solve_dae(*start, "Taylor", rtol=1e-8, atol=1e-8, compiled=compiled)
    assert result.status.name == "NOT_FINITE" and "no derivatives" in result.message and "DOP853" in result.message
