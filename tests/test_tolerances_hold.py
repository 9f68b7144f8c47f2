"""Implicit methods keep their tolerance over many steps and past vibrations, and do not end at rounding."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.problems import pendulum_state, unconstrained, worst
from twoloop import mechanisms, solve_dae
from twoloop.bodies import SpatialModel


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
