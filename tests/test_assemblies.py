"""No run ends on another assembly of the mechanism with success."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.problems import pendulum_state, quick, run, unconstrained, worst
from twoloop import consistent_state, mechanisms, solve_dae
from twoloop.bodies import SpatialModel
from twoloop.mechanisms import driven_slider_crank, four_bar

METHODS = ["Adams", "RadauIIA5", "BDF", "SunRadau5", "Gauss12", "Newmark", "DOP853"]


@pytest.mark.parametrize("tolerance", quick([1e-1, 1e-4, 1e-8]))
@pytest.mark.parametrize("method", quick(METHODS, 3))
def test_a_mechanism_without_independent_coordinates(method, tolerance):
    if method == "Newmark":
        tolerance = max(tolerance, 1e-6)
    problem = driven_slider_crank()
    result = run(problem, 3.0, method=method, rtol=tolerance, atol=tolerance)
    assert result.success, result.message
    assert worst(result.q.T, [problem.motion(t)[0] for t in result.t]) < 1e-9
    assert result.h.max() < 1.0  # bounded by what the dependents do: a turn of the crank


def same_assembly(lengths, ground, result):
    """Whether a Grashof linkage stays on its assembly: the joints away from the shortest bar keep their sign."""
    bars = [*lengths, ground]
    theta = [*result.q[2::3], np.zeros_like(result.t)]
    shortest = int(np.argmin(bars))
    for i in range(4):
        j = (i + 1) % 4
        if shortest not in (i, j):
            side = np.sign(np.sin(theta[j] - theta[i]))
            if (side != side[0]).any():
                return False
    return True


def linkages(seed, n):
    """Random Grashof linkages, close to change points among them."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < n:
        lengths, ground = rng.uniform(0.3, 2.0, 3), float(rng.uniform(0.3, 2.0))
        bars = np.sort([*lengths, ground])
        if not bars[1] + bars[2] - bars[0] - bars[3] > 1e-3:
            continue
        try:
            problem = four_bar(tuple(lengths), ground, rng.uniform(-np.pi, np.pi), int(rng.choice([-1, 1])))
        except ValueError:  # it does not assemble
            continue
        found.append((tuple(lengths), ground, problem))
    return found


JUMPED = ((1.0912, 1.3596, 0.6330), 0.3511, 0.0332, -1)  # with success before dependents entered the error test


@pytest.mark.parametrize("method", quick(METHODS, 3))
@pytest.mark.parametrize("tolerance", quick([0.3, 0.03, 0.1], 2))
def test_loose_tolerances_on_a_linkage_that_jumped(method, tolerance):
    lengths, ground, theta3, branch = JUMPED
    result = run(four_bar(lengths, ground, theta3, branch), 10.0, method=method, rtol=tolerance, atol=tolerance)
    assert result.success, result.message
    assert same_assembly(lengths, ground, result)


@pytest.mark.parametrize("method", quick(METHODS, 3))
@pytest.mark.parametrize(("seed", "n"), quick([(5, 12), (11, 600)]))
def test_random_linkages_at_loose_tolerances(seed, n, method):
    for lengths, ground, problem in linkages(seed, n):
        for tolerance in (0.03, 0.1, 0.3) if n > 100 else (0.03, 0.3):
            result = run(problem, 5.0, method=method, rtol=tolerance, atol=tolerance)
            assert not result.success or same_assembly(lengths, ground, result), (lengths, ground, tolerance)


# --- implicit methods keep their tolerance over many steps and past vibrations, and do not end at rounding
def test_errors_of_many_short_steps_do_not_add_up():
    """TR-BDF2's own formula is off by the number of its steps, thousands here."""
    problem = mechanisms.pendulum()
    q0, v0, _ = pendulum_state(0.0)
    result = solve_dae(problem.system, (0.0, 3.0), q0, v0, "TRBDF2", 1e-10, 1e-10)
    assert result.stats.n_accepted > 3000 and worst(result.q[:, -1], pendulum_state(3.0)[0]) < 1e-8


def test_vibrations_that_steps_pass_over_do_not_grow():
    rates = np.array([1.0, 300.0, 1e4])
    system = unconstrained(lambda t, q, v: -(rates**2) * q, 3)
    start = np.array([1.0, 1e-6, 1e-9])
    result = solve_dae(system, (0.0, 10.0), start, np.zeros(3), "TRBDF2", 1e-4, 1e-4)
    assert result.stats.n_accepted < 300  # 5e5 periods of the fastest
    assert (np.hypot(result.q, result.v / rates[:, None]).max(axis=1) < 1.01 * start).all()


def turned_four_bar(seed):
    """The four-bar linkage in a plane turned in space: three hinges and a ball, which fixes one direction twice."""
    turn = Rotation.random(random_state=seed).as_matrix()
    x = (1.0 - 4.0 + 1.5**2) / 3.0  # where bars of 1 and 2 m meet, between the ends (0, 0) and (1.5, 0)
    points = np.array([[0.0, 0.0, 0.0], [x, -np.sqrt(1.0 - x * x), 0.0], [1.5, 0.0, 0.0], [3.0, 0.0, 0.0]]) @ turn.T
    z = turn[:, 2]
    model = SpatialModel(-9.81 * turn[:, 1], name="turned four-bar")
    last = model.ground
    for k, (a, b) in enumerate(pairwise(points)):
        length = np.linalg.norm(b - a)
        along = (b - a) / length
        inertia = (1e-3 * length, length**3 / 12.0, length**3 / 12.0)
        pose = {"position": 0.5 * (a + b), "rotation": np.column_stack([along, np.cross(z, along), z])}
        bar = model.body(f"bar {k + 1}", mass=length, inertia=inertia, **pose)
        model.revolute(bar, last, at=a, axis=z)
        last = bar
    model.spherical(last, model.ground, at=points[-1])
    problem = model.problem()
    return problem.system, problem.q0, problem.v0


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize("method", ["Gauss8", "Gauss12", "RadauIIA13"])
def test_rows_that_come_to_depend_on_each_other_give_way_to_a_redundant_one(method):
    system, q0, v0 = turned_four_bar(1)
    expected = solve_dae(system, (0.0, 4.0), q0, v0, "DOP853", 1e-12, 1e-12)
    result = solve_dae(system, (0.0, 4.0), q0, v0, method, 1e-12, 1e-12)
    assert result.success, result.message
    assert worst(result.q[:, -1], expected.q[:, -1]) < 1e-10


@pytest.mark.parametrize("noise", [1e-6, 1e-4])
def test_guesses_of_long_chains_with_redundant_hinges_are_projected(noise):
    """In a chain of 14 boxes, each hinged twice, needed rows are as nearly dependent as redundant ones off the rows."""
    model, before = SpatialModel(), "ground"
    for k in range(14):
        model.box(f"box {k}", (0.8, 0.3, 0.3), mass=1.0, position=(k + 0.5, 0.0, 0.0))
        for y in (-0.2, 0.2):
            model.revolute(before, f"box {k}", at=(k, y, 0.0), axis=(0.0, 1.0, 0.0), name=f"hinge {k} at {y}")
        before = f"box {k}"
    problem = model.problem()
    guess = problem.q0 + noise * np.random.default_rng(3).standard_normal(problem.system.n_q)
    q, _ = consistent_state(problem.system, 0.0, guess, problem.v0)
    assert np.abs(q - guess).max() < 100.0 * noise
    np.testing.assert_allclose(problem.system.constraint(0.0, q), 0.0, atol=1e-13)
