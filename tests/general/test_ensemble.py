"""Ensembles: what lanes make of many runs is what single runs make of them, and what they cannot do is made singly."""

import signal

import numpy as np
import pytest

from tests.general.pendulums import drawn, far_from_single_runs, pendulums, system_of
from tests.problems import event, pendulum, pendulum_state
from twoloop import Status, ensemble, mechanisms, solve_dae

SPAN = (0.0, 2.0)


@pytest.fixture(autouse=True)
def builds(monkeypatch):
    """Lanes are compiled however few runs there are."""
    monkeypatch.setattr("twoloop.ensembles.in_turn.CALL", 1e9)


def test_one_start_serves_all_parameters_and_one_set_of_parameters_all_starts():
    problem = mechanisms.four_bar()
    system, start = problem.system, (problem.q0, problem.v0)
    runs = ensemble(system, (0.0, 0.5), np.tile(start[0], (9, 1)), start[1])
    known = solve_dae(system, (0.0, 0.5), *start, rtol=1e-11, atol=1e-11)
    assert runs.singly.sum() == 1 and np.abs(runs.q[:, :, -1] - known.q[:, -1]).max() < 1e-7
    assert len(ensemble(system, (0.0, 0.1), *start, parameters=np.tile(system.parameters, (3, 1)))) == 3
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


@pytest.mark.parametrize(
    ("case", "compiled"), [*((case, False) for case in BRANCHING), ("a branch", True), ("a parameter rounded", True)]
)
def test_what_lanes_cannot_see_is_found_and_made_singly(case, compiled):
    q, v, parameters = drawn(8)
    system = system_of(parameters, mass=np.eye(2), force=BRANCHING[case], compile=compiled)
    runs = ensemble(system, (0.0, 1.0), q, v, parameters=parameters)
    assert runs.success.all() and far_from_single_runs(runs, range(8), system, (0.0, 1.0), q, v, parameters) < 1e-6
    assert runs.reasons.keys() == set(np.flatnonzero(runs.singly)) and all(runs.reasons.values())


@pytest.mark.parametrize("compiled", [False, True])
def test_one_run_of_many_that_is_unlike_the_others_is_found(compiled):
    """A branch on a parameter, for which there are no formulas, and a parameter that only one run has otherwise."""
    n_runs, one = 20, 17
    q, v, parameters = drawn(n_runs)
    parameters[:, 0], parameters[:, 2] = 1.0, 9.0
    parameters[one] = 2.0, parameters[one, 1], 20.0

    def force(t, q, v, p):
        return np.array([p[0] - 3.0, -p[2] if p[2] < 15.0 else -3.0])

    # and no jacobian: it is derived
    system = system_of(parameters, mass=np.eye(2), force=force, jacobian=None, compile=compiled)
    runs = ensemble(system, (0.0, 0.5), q, v, parameters=parameters)
    assert runs.singly.all() and far_from_single_runs(runs, [5, one], system, (0.0, 0.5), q, v, parameters) < 1e-6


def test_what_cannot_go_in_lanes_says_why():
    system, q, v, parameters = pendulums(3)
    knife = mechanisms.knife_edge()
    runs = ensemble(knife.system, (0.0, 0.1), np.tile(knife.q0, (2, 1)), knife.v0)
    assert runs.singly.all() and "nonholonomic" in runs.message and "nonholonomic" in runs.reasons[1]
    runs = ensemble(system, (0.0, 0.1), q, v, parameters=parameters, method="Adams")
    assert runs.singly.all() and "Adams does not go in lanes" in runs.message
    runs = ensemble(system, SPAN, q, v, parameters=parameters, events=event(lambda t, q, v: q[1] + 0.2, terminal=True))
    assert runs.singly.all() and "events" in runs.message and (runs.status == Status.EVENT).any()
    assert np.isnan(runs.q[runs.status == Status.EVENT][:, :, -1]).all()


def test_lanes_that_do_not_end_where_the_first_run_does_are_not_believed(monkeypatch):
    system, q, v, parameters = pendulums(9)
    runs = ensemble(system, SPAN, q, v, parameters=parameters, rtol=1e-8, atol=1e-8)
    monkeypatch.setattr("twoloop.ensembles.in_turn.FAR", 1e-6)
    other = ensemble(system, SPAN, q, v, parameters=parameters)
    assert other.singly.all() and "the first run ends elsewhere by itself" in other.message
    assert np.abs(other.q - runs.q).max() < 1e-6


def test_a_few_runs_do_not_wait_for_a_compiler(monkeypatch):
    monkeypatch.setattr("twoloop.ensembles.in_turn.CALL", 0.0)
    monkeypatch.setattr("twoloop.generate.own_lanes.OwnLanes.seconds_to_build", 10.0)
    system, q, v, parameters = pendulums(3)
    runs = ensemble(system, (0.0, 0.1), q, v, parameters=parameters)
    assert runs.singly.all() and "to compile them does not pay" in runs.message


def test_forces_that_are_short_or_sudden_are_seen():
    def gust(t, q, v, p):
        return np.array([40.0 * np.exp(-(((t - p[2]) / 0.02) ** 2)) - 0.3 * v[0] * (v @ v + 1e-2) ** 0.5, -9.81])

    q, v, parameters = drawn(17)
    parameters[:, 2] = np.linspace(0.2, 1.8, 17)
    system = system_of(parameters, mass=np.eye(2), force=gust, compile=True)
    runs = ensemble(system, SPAN, q, v, parameters=parameters)
    assert (~runs.singly).sum() > 8
    assert far_from_single_runs(runs, range(17), system, SPAN, q, v, parameters, max_step=0.005) < 1e-5


@pytest.mark.parametrize("method", ["auto", "DOP853"])
@pytest.mark.parametrize("by_state", [False, True])
def test_what_is_narrow_and_acts_in_later_runs_alone_is_seen(method, by_state):
    """Of the first run, whose factor is zero, nothing tells that there is something."""

    def force(t, q, v, p):
        x = (q[0] - 0.1234) / 3e-3 if by_state else (t - 0.4321) / 3e-4
        return np.array([0.0, p[0] - 9.81 + p[2] * np.exp(-x * x)])

    q, v, parameters = drawn(9)
    parameters[:, 2] = np.linspace(0.0, 300.0 if by_state else 500.0, 9)
    system = system_of(parameters, mass=np.eye(2), force=force, compile=True)
    runs = ensemble(system, SPAN, q, v, parameters=parameters, method=method)
    assert far_from_single_runs(runs, range(9), system, SPAN, q, v, parameters, max_step=5e-4) < 1e-5


def test_velocities_off_the_constraints_are_named():
    system, q, v, parameters = pendulums(9)
    v[7] += 0.1 * q[7]
    with pytest.raises(ValueError, match="run 7: v0 is not consistent"):
        ensemble(system, SPAN, q, v, parameters=parameters)


def test_runs_nearly_at_rest_among_fast_ones_need_no_closer_look(monkeypatch):
    """What rounding leaves of velocities is a share of those of other runs, from which they were projected."""
    looked = []
    monkeypatch.setattr("twoloop.ensembles.in_turn._check_start", lambda *arguments: looked.append(arguments[-1]))
    system, q, _, parameters = pendulums(9)
    v = np.column_stack([-q[:, 1], q[:, 0]])
    v[4] = 1e-9 * v[4] + 5e-16 * q[4]
    runs = ensemble(system, (0.0, 0.1), q, v, parameters=parameters)
    assert looked == [] and runs.success.all()


def test_a_lane_that_fails_says_what_a_single_run_says():
    q, v, _ = pendulum_state(0.0)
    system = pendulum(force=lambda t, q, v: np.array([0.0, -9.81 - 1e3 * np.sqrt(0.5 - t)]), compile=True)
    runs = ensemble(system, (0.0, 1.0), np.tile(q, (3, 1)), v)
    assert (runs.status < 0).all() and not runs.success.any() and np.isnan(runs.q[:, :, -1]).all()
    assert set(runs.messages) == {0, 1, 2} and "0 of 3 runs" in runs.message


def test_ctrl_c_ends_all_runs_and_not_one(interruptible):
    q, v, parameters = drawn(6)
    begun = []

    def force(t, q, v, p):
        if t > 0.1:
            begun.append(p[2])
            if p[2] == parameters[2, 2]:
                signal.raise_signal(signal.SIGINT)
        return np.array([0.0, -9.81])

    with pytest.raises(KeyboardInterrupt):
        ensemble(system_of(parameters, force=force), SPAN, q, v, parameters=parameters)
    assert set(begun) == set(parameters[:3, 2])
