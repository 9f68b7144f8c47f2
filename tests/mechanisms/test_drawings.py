"""What is drawn of the ready mechanisms: bars keep their lengths, pins stay, and lines meet where joints are."""

import copy
import pickle

import numpy as np
import pytest

from tests.mechanisms.test_ready_mechanisms import EVERY, every
from twoloop import Drawing, mechanisms
from twoloop.kernels.compile.callbacks import KINDS

SPRINGS = {"Andrews' squeezing mechanism": 1, "SUNDIALS slider-crank": 1, "A05 governor": 2}


def lengths(problem, q):
    points = problem.drawing.at(q)
    return np.array([np.linalg.norm(points[i] - points[j]) for i, j in problem.drawing.bars])


def test_every_mechanism_has_a_drawing():
    made = {getattr(mechanisms, name) for name in mechanisms.__all__} - {mechanisms.ancf_beam}
    functions = [each for each in made if not isinstance(each, type)]
    assert len(functions) == 20 and all(function().drawing.bars for function in functions)


@pytest.mark.parametrize("name", [name for name in EVERY if name not in ("beam", "projection pendulum")])
def test_bars_are_rigid_but_for_springs(name):
    problem = EVERY[name]
    change = np.abs(lengths(problem, problem.reference.q) - lengths(problem, problem.q0))
    assert (change > 1e-9).sum() == SPRINGS.get(name, 0)
    assert np.abs(problem.reference.q - problem.q0).max() > 1e-3  # it did move


@every
def test_many_states_at_once_are_those_one_by_one(problem):
    q = np.column_stack([problem.q0, problem.q0 + 0.1])
    both = problem.drawing.at(q)
    assert both.shape[1] == (2 if "planar" in problem.tags else 3)
    for k in range(2):
        np.testing.assert_allclose(both[..., k], problem.drawing.at(q[:, k]), rtol=0.0, atol=1e-14)


@every
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda problem: pickle.loads(pickle.dumps(problem))])
def test_problems_can_be_copied_and_sent_to_other_processes(problem, copied):
    other, t, v = copied(problem), 0.3, problem.v0 + 0.1
    assert vars(other).keys() == vars(problem).keys() and other.parameters == problem.parameters
    assert repr(other.system.joints) == repr(problem.system.joints) == repr(other.joints)
    for kind in set(problem.system.given) - {"kinematics"}:
        state = {"q": problem.q0, "v": v, "lam": np.ones(problem.system.n_c)}
        given = [state[name] for name in KINDS[kind].state]
        np.testing.assert_array_equal(getattr(other.system, kind)(t, *given), getattr(problem.system, kind)(t, *given))
    np.testing.assert_array_equal(other.drawing.at(problem.q0), problem.drawing.at(problem.q0))
    assert other.energy(0.0, other.q0, other.v0) == problem.energy(0.0, problem.q0, problem.v0)
    assert other.system.description.coordinates == problem.coordinates == other.coordinates


def test_four_bar_from_pin_to_pin():
    problem = EVERY["four-bar"]
    points = problem.drawing.at(problem.reference.q)
    assert lengths(problem, problem.reference.q) == pytest.approx([1.0, 2.0, 1.5], abs=1e-13)
    assert points[[0, 3]].tolist() == [[0.0, 0.0], [3.0, 0.0]]


def test_the_disc_touches_the_plane_and_its_rim_lies_in_it():
    problem = mechanisms.rolling_disc()
    points = problem.drawing.at(problem.reference.q)
    assert abs(points[-1, 2]) < 1e-13
    arms = points - problem.reference.q[:3]
    assert np.linalg.norm(arms, axis=1) == pytest.approx(np.full(25, 0.4), abs=1e-13)
    assert np.linalg.matrix_rank(arms, tol=1e-12) == 2


def test_the_point_of_the_rim_that_touches_the_plane_is_at_rest():
    problem, e = mechanisms.rolling_disc(), 1e-5
    q = problem.q0.copy()
    q[5] = -0.5 * np.pi  # the first point of the rim is lowest
    before, after = (problem.drawing.at(q + s * e * problem.v0) for s in (-1.0, 1.0))
    speeds = np.linalg.norm(after - before, axis=1)[:-1] / (2.0 * e)
    assert speeds[0] < 1e-7 and speeds[1:].min() > 0.1


def test_the_beam_is_drawn_as_long_as_it_is():
    problem = EVERY["beam"]
    points = problem.drawing.at(problem.q0)
    assert points[:, 0] == pytest.approx(np.linspace(0.0, 1.0, 33), abs=1e-15) and not points[:, 1].any()


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ((np.zeros(3), [(0, 1)]), TypeError, "points must be a function of q"),
        ((np.zeros_like, [(0, 1)], ["tip"]), TypeError, "traces points, by their numbers"),
    ],
)
def test_wrong_drawings(arguments, error, words):
    with pytest.raises(error, match=words):
        Drawing(*arguments)


def test_names_and_units():
    problem = EVERY["beam"]
    assert problem.names[:3] == ("x of node 0", "y of node 0", "x slope of node 0")
    assert problem.units[:3] == ("m", "m", "")
    assert mechanisms.bricard().units[3] == ""  # "-"
