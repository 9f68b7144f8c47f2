"""Test `consistent_states`: each of many guesses is what `consistent_state` makes of it."""

import numpy as np
import pytest

from tests.compiled import unit_mass, weight
from tests.marks import slow
from twoloop import ConstrainedSystem, callback, consistent_state, consistent_states, mechanisms


def guesses(problem, n):
    random = np.random.default_rng(2)
    q = problem.q0 + 0.02 * random.uniform(-1.0, 1.0, (n, problem.system.n_q))
    return q, random.uniform(-1.0, 1.0, q.shape)


MORE = [slow(name) for name in ("four_bar", "spatial_slider_crank", "heavy_top")]


@pytest.mark.parametrize("name", ["redundant_slider_crank", "knife_edge", *MORE])
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


@pytest.mark.parametrize("name", ["spatial_four_bar", slow("redundant_slider_crank"), slow("bricard")])
def test_none_depends_on_the_others_or_on_threads(monkeypatch, name):
    problem = getattr(mechanisms, name)()
    q, v = problem.q0 + 0.5 * (guesses(problem, 300)[0] - problem.q0), guesses(problem, 300)[1]
    monkeypatch.setattr("twoloop.ensembles.consistent_states.threads_of", lambda wanted: 2)
    all_q, all_v = consistent_states(problem.system, 0.1, q, v)
    monkeypatch.setattr("twoloop.ensembles.consistent_states.threads_of", lambda wanted: 1)
    for some in (slice(0, 13), slice(5, 300)):
        made_q, made_v = consistent_states(problem.system, 0.1, q[some], v[some])
        assert (made_q == all_q[some]).all() and (made_v == all_v[some]).all()


def test_guesses_that_are_too_far_or_do_not_say_on_which_assembly_they_are_are_named():
    problem = mechanisms.four_bar()
    q, v = guesses(problem, 3)
    q[1] = 0.0
    with pytest.raises(ValueError, match=r"guess 1: .*(diverges|does not say|iterations max)"):
        consistent_states(problem.system, 0.0, q, v)
    system = mechanisms.pendulum().system  # a circle: with x = 0.99995 two places, y = 0.01 and -0.01
    with pytest.raises(ValueError, match="guess 1: q does not say on which assembly"):
        consistent_states(system, 0.0, np.array([[0.6, 0.7], [0.99995, 1e-3]]), np.zeros(2), keep=[0])


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
