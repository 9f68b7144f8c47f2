"""Many guesses put on the constraints at once: each is what consistent_state makes of it."""

import numpy as np
import pytest

from tests.compiled import unit_mass, weight
from tests.problems import pendulum
from twoloop import ConstrainedSystem, callback, consistent_state, consistent_states, mechanisms


def guesses(problem, n):
    random = np.random.default_rng(2)
    q = problem.q0 + 0.02 * random.uniform(-1.0, 1.0, (n, problem.system.n_q))
    return q, random.uniform(-1.0, 1.0, q.shape)


NAMES = ("four_bar", "spatial_slider_crank", "driven_slider_crank", "redundant_slider_crank", "knife_edge", "heavy_top")


@pytest.mark.parametrize("name", NAMES)
def test_each_is_what_one_by_one_gives(name):
    problem = getattr(mechanisms, name)()
    q, v = guesses(problem, 19)
    made_q, made_v = consistent_states(problem.system, 0.1, q, v)
    for run in (0, 7, 8, 18):
        own_q, own_v = consistent_state(problem.system, 0.1, q[run], v[run])
        assert np.abs(made_q[run] - own_q).max() < 1e-12 and np.abs(made_v[run] - own_v).max() < 1e-11


def test_parameters_of_their_own_and_coordinates_that_are_kept():
    problem = mechanisms.four_bar()
    system, random = problem.system, np.random.default_rng(5)
    parameters = system.parameters * random.uniform(0.97, 1.03, (30, 4))
    speeds = np.zeros(9)
    speeds[8] = 2.0
    q, v = consistent_states(system, 0.0, problem.q0, speeds, parameters=parameters, keep=[8])
    assert (q[:, 8] == problem.q0[8]).all() and (v[:, 8] == 2.0).all()
    for run in (0, 11, 29):
        own = system.with_parameters(parameters[run])
        known = consistent_state(own, 0.0, problem.q0, speeds, keep=[8])
        assert np.abs(q[run] - known[0]).max() < 1e-12 and np.abs(v[run] - known[1]).max() < 1e-11
        assert np.abs(own.constraint(0.0, q[run])).max() < 1e-14


MODULE = "twoloop.ensembles.consistent_states"


@pytest.fixture
def singly(monkeypatch):
    """Calls for one guess."""
    calls = []

    def one(*arguments, **options):
        calls.append(arguments)
        return consistent_state(*arguments, **options)

    monkeypatch.setattr(f"{MODULE}.consistent_state", one)
    return calls


@pytest.mark.parametrize(("name", "n_singly"), [("spatial_four_bar", 0), ("redundant_slider_crank", 1), ("bricard", 1)])
def test_lanes_take_those_that_are_near_and_none_depends_on_others(monkeypatch, singly, name, n_singly):
    """Of redundant rows the first guess says how many they are."""
    problem = getattr(mechanisms, name)()
    q, v = problem.q0 + 0.5 * (guesses(problem, 300)[0] - problem.q0), guesses(problem, 300)[1]
    monkeypatch.setattr(f"{MODULE}.threads_of", lambda wanted: 2)
    all_q, all_v = consistent_states(problem.system, 0.1, q, v)
    assert len(singly) == n_singly
    consistent_states(problem.system, 0.1, all_q, all_v)  # which are on the constraints
    assert len(singly) == 2 * n_singly
    monkeypatch.setattr(f"{MODULE}.threads_of", lambda wanted: 1)
    for some in (slice(0, 13), slice(5, 300)):
        made_q, made_v = consistent_states(problem.system, 0.1, q[some], v[some])
        assert (made_q == all_q[some]).all() and (made_v == all_v[some]).all()


@pytest.mark.parametrize("n", [3, 2, 40])
def test_coordinates_without_constraints_have_code_of_their_own(singly, n):
    system = ConstrainedSystem.from_python(
        n_q=n,
        n_c=1,
        mass=np.eye(n),
        force=lambda t, q, v: -q,
        constraint=lambda t, q: np.array([q[0] ** 2 + 1.7 * q[1] ** 3 - 1.2345]),
        jacobian=lambda t, q: np.concatenate([[2.0 * q[0], 5.1 * q[1] ** 2], np.zeros(n - 2)])[None],
    )
    q = 0.7 + np.random.default_rng(1).uniform(0.0, 0.02, (20, n))
    q[:, 1] += 0.05
    made, _ = consistent_states(system, 0.0, q, q)
    assert np.abs(made[:, 0] ** 2 + 1.7 * made[:, 1] ** 3 - 1.2345).max() < 1e-14 and len(singly) == 0


def test_rows_that_are_redundant_for_some_parameters():
    def constraint(t, q, p):
        return np.array([q[0] ** 2 + q[1] ** 2 - 1.0, p[0] * (q[2] - q[0])])

    def jacobian(t, q, p):
        return np.array([[2.0 * q[0], 2.0 * q[1], 0.0], [-p[0], 0.0, p[0]]])

    system = ConstrainedSystem.from_python(
        n_q=3,
        n_c=2,
        mass=np.eye(3),
        force=lambda t, q, v: -q,
        constraint=constraint,
        jacobian=jacobian,
        parameters=[1.0],
    )
    q, parameters = np.tile([0.65, 0.78, 0.66], (30, 1)), np.ones((30, 1))
    for rank_lost in ([0], [7, 8], range(1, 30)):
        parameters[:], parameters[list(rank_lost)] = 1.0, 0.0
        made = consistent_states(system, 0.0, q, q, parameters=parameters)
        for run in (0, 1, 8, 29):
            known = consistent_state(system.with_parameters(parameters[run]), 0.0, q[run], q[run])
            assert all(np.abs(one[run] - other).max() < 1e-14 for one, other in zip(made, known, strict=True))


def test_few_guesses_are_not_worth_code(monkeypatch):
    problem = mechanisms.four_bar()
    q, v = guesses(problem, 2)
    made = consistent_states(problem.system, 0.1, q, v)
    monkeypatch.setattr(f"{MODULE}.SINGLY", 0.0)
    monkeypatch.setattr("twoloop.generate.own_lanes.are_kept", lambda *arguments: False)
    singly = consistent_states(problem.system, 0.1, q, v)
    for one, other in zip(made, singly, strict=True):
        assert np.abs(one - other).max() < 1e-12


def test_callbacks_that_cannot_be_traced_go_one_by_one():
    def circle(t, q, p):
        return np.array([q @ q - (p[0] if q[0] < 5.0 else 2.0) ** 2])

    system = pendulum(constraint=circle, jacobian=None, gamma=False, parameters=[1.0])
    parameters, q = np.random.default_rng(0).uniform(0.9, 1.1, (4, 1)), np.array([0.7, 0.8])
    made, _ = consistent_states(system, 0.0, q, np.zeros(2), parameters=parameters)
    assert np.abs(np.linalg.norm(made, axis=1) - parameters[:, 0]).max() < 1e-12


def test_velocities_that_the_callbacks_deny_are_found_again_one_by_one():
    system = pendulum(
        constraint=lambda t, q, p: np.array([q[0] - p[0] * t]),
        jacobian=lambda t, q: np.array([[1.0, 0.0]]),
        constraint_rate=lambda t, q, p: np.array([-float(p[0])]),  # which symbols do not see
        **{"gamma": False, "parameters": [1.0]},
    )
    parameters = np.array([[1.0], [2.0], [3.0]])
    q, v = consistent_states(system, 0.5, [0.4, 0.0], [0.0, 1.0], parameters=parameters)
    assert np.abs(q[:, 0] - 0.5 * parameters[:, 0]).max() < 1e-14 and np.abs(v[:, 0] - parameters[:, 0]).max() < 1e-14


def test_a_guess_that_is_too_far_is_named():
    problem = mechanisms.four_bar()
    q, v = guesses(problem, 3)
    q[1] = 0.0
    with pytest.raises(ValueError, match=r"guess 1: .*(diverges|does not say|iterations max)"):
        consistent_states(problem.system, 0.0, q, v)


def test_a_guess_that_does_not_say_on_which_assembly_it_is_is_refused():
    system = mechanisms.pendulum().system  # a circle: with x = 0.99995 two places, y = 0.01 and -0.01
    q = np.array([[0.6, 0.7], [0.99995, 1e-3]])
    with pytest.raises(ValueError, match="guess 1: q does not say on which assembly"):
        consistent_states(system, 0.0, q, np.zeros(2), keep=[0])
    found, _ = consistent_states(system, 0.0, q[:1], np.zeros(2), keep=[0])
    assert np.abs(found - [[0.6, 0.8]]).max() < 1e-15


@callback("constraint")
def at_a_place_that_is_a_parameter(t, q, p, C):
    C[0] = q[0] - q[int(p[0])]


@callback("jacobian")
def derivative_at_a_place(t, q, p, Cq):
    Cq[0, 0] = 1.0
    Cq[0, int(p[0])] -= 1.0


def test_places_among_parameters_do_not_lead_out_of_bounds():
    functions = {"constraint": at_a_place_that_is_a_parameter, "jacobian": derivative_at_a_place}
    system = ConstrainedSystem(n_q=2, n_c=1, mass=unit_mass, force=weight, parameters=[1.0], name="far", **functions)
    with pytest.raises(ValueError, match=r"guess 1: .* of 'far' goes out of bounds: index 10000000"):
        consistent_states(system, 0.0, [1.0, 1.0], np.zeros(2), parameters=[[1.0], [1e7]])
