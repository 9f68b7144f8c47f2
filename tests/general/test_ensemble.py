"""Ensembles: what lanes make of many runs is what single runs make of them, and what they cannot do is made singly."""

from contextlib import nullcontext

import numpy as np
import pytest

from tests.general.pendulums import drawn, far_from_single_runs, pendulums, system_of
from tests.problems import event, pendulum, pendulum_state
from twoloop import ConstraintWarning, Status, ensemble, mechanisms, solve_dae

SPAN, TOLERANCE = (0.0, 2.0), 1e-8


@pytest.fixture(scope="module")
def made():
    system, q, v, parameters = pendulums(40)
    times = np.linspace(*SPAN, 9)
    runs = ensemble(system, SPAN, q, v, parameters=parameters, rtol=TOLERANCE, atol=TOLERANCE, t_eval=times)
    return system, q, v, parameters, times, runs


def single(made, run, tolerance=1e-11):
    system, q, v, parameters, times, _ = made
    own = system.with_parameters(parameters[run])
    return solve_dae(own, SPAN, q[run], v[run], method="DOP853", rtol=tolerance, atol=tolerance, t_eval=times)


@pytest.fixture(autouse=True)
def builds(monkeypatch):
    """Lanes are compiled however few runs there are."""
    monkeypatch.setattr("twoloop.ensembles.ensemble.CALL", 1e9)


def test_runs_are_those_of_another_method_one_by_one(made):
    *_, times, runs = made
    assert runs.q.shape == runs.v.shape == (40, 2, 9) and (runs.t == times).all()
    assert runs.success.all() and (runs.status == Status.REACHED_END).all() and len(runs) == 40
    assert runs.singly.tolist() == [True] + 39 * [False] and (runs.n_steps > 3).all()
    for run in (0, 1, 7, 39):
        known = single(made, run)
        assert np.abs(runs.q[run] - known.q).max() < 1e-6 and np.abs(runs.v[run] - known.v).max() < 1e-6


def test_every_state_is_on_its_own_constraints(made):
    _, _, _, parameters, _, runs = made
    C = 0.5 * ((runs.q**2).sum(axis=1) - parameters[:, 1:2] ** 2)
    assert np.abs(C).max() < 1e-13 and np.abs((runs.q * runs.v).sum(axis=1)).max() < 1e-12


def test_runs_depend_neither_on_threads_nor_on_their_order_nor_on_one_another(made):
    system, q, v, parameters, times, runs = made
    order = np.random.default_rng(0).permutation(40)
    given = {"rtol": TOLERANCE, "atol": TOLERANCE, "t_eval": times}
    other = ensemble(system, SPAN, q[order], v[order], parameters=parameters[order], threads=1, **given)
    lanes = ~runs.singly[order] & ~other.singly
    assert lanes.sum() == 38 and np.abs(other.q[lanes] - runs.q[order][lanes]).max() < 1e-13
    few = ensemble(system, SPAN, q[:5], v[:5], parameters=parameters[:5], **given)
    assert np.abs(few.q[1:] - runs.q[1:5]).max() < 1e-12


def test_without_times_start_and_end_are_stored(made):
    system, q, v, parameters, _, runs = made
    ends = ensemble(system, SPAN, q, v, parameters=parameters, rtol=TOLERANCE, atol=TOLERANCE)
    assert ends.t.tolist() == [0.0, 2.0] and (ends.q[:, :, 0] == q).all()
    assert np.abs(ends.q[:, :, 1] - runs.q[:, :, -1]).max() < 1e-12


def test_one_start_serves_all_parameters_and_one_set_of_parameters_all_starts():
    problem = mechanisms.four_bar()
    system, start = problem.system, (problem.q0, problem.v0)
    runs = ensemble(system, (0.0, 0.5), np.tile(start[0], (9, 1)), start[1])
    known = solve_dae(system, (0.0, 0.5), *start, rtol=1e-11, atol=1e-11)
    assert runs.singly.sum() == 1 and np.abs(runs.q[:, :, -1] - known.q[:, -1]).max() < 1e-7
    parameters = np.tile(system.parameters, (3, 1))
    assert len(ensemble(system, (0.0, 0.1), *start, parameters=parameters)) == 3
    assert len(ensemble(system, (0.0, 0.1), *start)) == 1


def test_plain_python_functions_of_parameters_go_in_lanes():
    compiled, q, v, parameters = pendulums(9)
    compiled = ensemble(compiled, SPAN, q, v, parameters=parameters)
    runs = ensemble(system_of(parameters), SPAN, q, v, parameters=parameters)
    assert runs.singly.sum() == 1 and np.abs(runs.q - compiled.q)[1:].max() < 1e-12


BRANCHING = {
    "a branch": lambda t, q, v, p: np.array([0.0, -9.81 if q[0] > 0.5 else -p[2]]),
    "a number made of a parameter": lambda t, q, v, p: np.array([0.0, -float(p[2])]),
    "a branch on a parameter": lambda t, q, v, p: np.array([0.0, -p[2] if p[2] < 8.0 else -5.0]),
    "a parameter rounded": lambda t, q, v, p: np.array([0.0, -np.round(p[2])]),
}


@pytest.mark.parametrize("force", BRANCHING.values(), ids=BRANCHING)
@pytest.mark.parametrize("compiled", [False, True])
def test_what_lanes_cannot_see_is_found_and_made_singly(force, compiled):
    q, v, parameters = drawn(12)
    system = system_of(parameters, mass=np.eye(2), force=force, compile=compiled)
    runs = ensemble(system, (0.0, 1.0), q, v, parameters=parameters)
    assert runs.success.all()
    assert far_from_single_runs(runs, range(12), system, (0.0, 1.0), q, v, parameters) < 1e-6


@pytest.mark.parametrize("compiled", [False, True])
def test_one_run_of_many_that_is_unlike_the_others_is_found(compiled):
    """A branch on a parameter, for which there are no formulas, and a parameter that only one run has otherwise."""
    n_runs, one = 150, 77
    q, v, parameters = drawn(n_runs)
    parameters[:, 0], parameters[:, 2] = 1.0, 9.0
    parameters[one] = 2.0, parameters[one, 1], 20.0

    def force(t, q, v, p):
        return np.array([p[0] - 3.0, -p[2] if p[2] < 15.0 else -3.0])

    # and no jacobian: it is derived
    system = system_of(parameters, mass=np.eye(2), force=force, jacobian=None, compile=compiled)
    runs = ensemble(system, (0.0, 0.5), q, v, parameters=parameters)
    assert runs.singly.all()
    assert far_from_single_runs(runs, [5, one], system, (0.0, 0.5), q, v, parameters) < 1e-6


def test_what_cannot_go_in_lanes_says_why(made):
    system, q, v, parameters, *_ = made
    knife = mechanisms.knife_edge()
    runs = ensemble(knife.system, (0.0, 0.1), np.tile(knife.q0, (2, 1)), knife.v0)
    assert runs.singly.all() and "nonholonomic" in runs.message
    runs = ensemble(system, (0.0, 0.1), q[:3], v[:3], parameters=parameters[:3], method="Adams")
    assert runs.singly.all() and "Adams does not go in lanes" in runs.message

    low = event(lambda t, q, v: q[1] + 0.2, terminal=True)
    runs = ensemble(system, SPAN, q[:3], v[:3], parameters=parameters[:3], events=low)
    assert runs.singly.all() and "events" in runs.message and (runs.status == Status.EVENT).any()
    assert np.isnan(runs.q[runs.status == Status.EVENT][:, :, -1]).all()


def test_lanes_that_do_not_end_where_the_first_run_does_are_not_believed(made, monkeypatch):
    monkeypatch.setattr("twoloop.ensembles.ensemble.FAR", 1e-6)
    system, q, v, parameters, *_, runs = made
    other = ensemble(system, SPAN, q[:9], v[:9], parameters=parameters[:9], t_eval=runs.t)
    assert other.singly.all() and "the first run ends elsewhere by itself" in other.message
    assert np.abs(other.q - runs.q[:9]).max() < 1e-6


def test_a_few_runs_do_not_wait_for_a_compiler(made, monkeypatch):
    monkeypatch.setattr("twoloop.ensembles.ensemble.CALL", 0.0)
    monkeypatch.setattr("twoloop.generate.own_lanes.OwnLanes.seconds_to_build", 10.0)
    system, q, v, parameters, *_ = made
    runs = ensemble(system, (0.0, 0.1), q[:3], v[:3], parameters=parameters[:3])
    assert runs.singly.all() and "to compile them does not pay" in runs.message


def test_runs_through_a_singular_position_are_made_singly():
    problem = mechanisms.n_four_bar()
    runs = ensemble(problem.system, (0.0, 2.0), np.tile(problem.q0, (3, 1)), problem.v0)
    known = solve_dae(problem.system, (0.0, 2.0), problem.q0, problem.v0)
    assert np.abs(runs.q[:, :, -1] - known.q[:, -1]).max() < 1e-6


def test_forces_that_are_short_or_sudden_are_seen():
    def gust(t, q, v, p):
        return np.array([40.0 * np.exp(-(((t - p[2]) / 0.02) ** 2)) - 0.3 * v[0] * (v @ v + 1e-2) ** 0.5, -9.81])

    q, v, parameters = drawn(17)
    parameters[:, 2] = np.linspace(0.2, 1.8, 17)
    system = system_of(parameters, mass=np.eye(2), force=gust, compile=True)
    runs = ensemble(system, SPAN, q, v, parameters=parameters)
    assert (~runs.singly).sum() > 8
    assert far_from_single_runs(runs, range(17), system, SPAN, q, v, parameters, max_step=0.005) < 1e-5


@pytest.mark.parametrize(
    ("name", "far", "warned"),
    [
        ("driven_slider_crank", 1e-7, nullcontext()),
        ("redundant_slider_crank", 1e-6, pytest.warns(ConstraintWarning)),
    ],
)
def test_drives_and_redundant_rows_go_in_lanes(name, far, warned):
    problem, span = getattr(mechanisms, name)(), (0.0, 0.5)
    with warned:
        runs = ensemble(problem.system, span, np.tile(problem.q0, (9, 1)), problem.v0)
        known = solve_dae(problem.system, span, problem.q0, problem.v0, rtol=1e-11, atol=1e-11)
    assert runs.singly.sum() == 1 and np.abs(runs.q[:, :, -1] - known.q[:, -1]).max() < far


def test_velocities_off_the_constraints_are_named(made):
    system, q, v, parameters, *_ = made
    v = v.copy()
    v[7] += 0.1 * q[7]
    with pytest.raises(ValueError, match="run 7: v0 is not consistent"):
        ensemble(system, SPAN, q, v, parameters=parameters)


def test_a_lane_that_fails_says_what_a_single_run_says():
    q, v, _ = pendulum_state(0.0)
    system = pendulum(force=lambda t, q, v: np.array([0.0, -9.81 - 1e3 * np.sqrt(0.5 - t)]), compile=True)
    runs = ensemble(system, (0.0, 1.0), np.tile(q, (3, 1)), v)
    assert (runs.status < 0).all() and not runs.success.any() and np.isnan(runs.q[:, :, -1]).all()
    assert set(runs.messages) == {0, 1, 2} and "0 of 3 runs" in runs.message
