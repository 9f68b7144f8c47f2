"""Implicit methods keep their tolerance under friction and switching drives, and do not end at rounding."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from tests.problems import pendulum, pendulum_state, worst
from twoloop import ConstrainedSystem, mechanisms, solve_dae
from twoloop.mechanisms.spatial import GROUND
from twoloop.mechanisms.spatial_bodies import SpatialBodies

T = 3.0  # s
START = 0.9  # rad from the downward vertical
TORQUES = {  # of (t, angle, rate), N m
    "brake": lambda t, x, w: -3.0 * np.tanh(w / 0.01),
    "switching drive": lambda t, x, w: 5.0 * np.tanh(50.0 * np.sin(20.0 * t)) * np.cos(x),
}


@cache
def angle_at_the_end(name):
    """By SciPy, from the angle alone."""
    rates = lambda t, y: [y[1], -9.81 * np.sin(y[0]) + TORQUES[name](t, y[0], y[1])]  # noqa: E731
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14, "max_step": 2e-3}
    return solve_ivp(rates, (0.0, T), [START, 0.0], **options).y[0, -1]


def off(name, method, tol):
    """Error of the position at the end over the tolerance."""

    def force(t, q, v):
        torque = TORQUES[name](t, np.arctan2(q[0], -q[1]), q[0] * v[1] - q[1] * v[0])
        return np.array([-torque * q[1], -9.81 + torque * q[0]])

    q0 = np.array([np.sin(START), -np.cos(START)])
    system = pendulum(force=force, constant_mass=True)
    result = solve_dae(system, (0.0, T), q0, np.zeros(2), method, tol, tol, max_step=T / 100, check_derivatives=False)
    assert result.success, result.message
    angle = angle_at_the_end(name)
    return worst(result.q[:, -1], [np.sin(angle), -np.cos(angle)]) / tol


@pytest.mark.parametrize("name", TORQUES)
@pytest.mark.parametrize(("method", "tols"), [("TRBDF2", (1e-4, 1e-7)), ("ESDIRK4", (1e-6, 1e-8))])
def test_few_digits_and_many_are_what_was_asked_for(name, method, tols):
    for tol in tols:
        assert off(name, method, tol) < 300.0


def test_errors_of_many_short_steps_do_not_add_up():
    """TR-BDF2's own formula is off by the number of its steps, thousands here."""
    problem = mechanisms.pendulum()
    q0, v0, _ = pendulum_state(0.0)
    result = solve_dae(problem.system, (0.0, T), q0, v0, "TRBDF2", 1e-10, 1e-10)
    assert result.stats.n_accepted > 3000
    assert worst(result.q[:, -1], pendulum_state(T)[0]) < 1e-8


def test_vibrations_that_steps_pass_over_do_not_grow():
    rates = np.array([1.0, 300.0, 1e4])
    system = ConstrainedSystem.from_python(
        n_q=3, n_c=0, mass=np.eye(3), force=lambda t, q, v: -(rates**2) * q, constraint=None, jacobian=None
    )
    start = np.array([1.0, 1e-6, 1e-9])
    result = solve_dae(system, (0.0, 10.0), start, np.zeros(3), "TRBDF2", 1e-4, 1e-4)
    assert result.stats.n_accepted < 300  # 5e5 periods of the fastest
    amplitudes = np.hypot(result.q, result.v / rates[:, None])
    assert (amplitudes.max(axis=1) < 1.01 * start).all()


def turned_four_bar(seed):
    """The four-bar linkage in a plane turned in space: three hinges and a ball, which fixes one direction twice."""
    turn = Rotation.random(random_state=seed).as_matrix()
    x = (1.0 - 4.0 + 1.5**2) / 3.0  # where bars of 1 and 2 m meet, between the ends (0, 0) and (1.5, 0)
    points = np.array([[0.0, 0.0, 0.0], [x, -np.sqrt(1.0 - x * x), 0.0], [1.5, 0.0, 0.0], [3.0, 0.0, 0.0]]) @ turn.T
    z = turn[:, 2]
    rows = SpatialBodies(-9.81 * turn[:, 1])
    last = GROUND
    for k, (a, b) in enumerate(pairwise(points)):
        length = np.linalg.norm(b - a)
        along = (b - a) / length
        inertia = (1e-3 * length, length**3 / 12.0, length**3 / 12.0)
        axes = np.column_stack([along, np.cross(z, along), z])
        bar = rows.body(f"bar {k + 1}", length, inertia, 0.5 * (a + b), axes)
        rows.revolute(bar, last, a, z)
        last = bar
    rows.spherical(last, GROUND, points[-1])
    return rows.system("turned four-bar"), *rows.start


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize("method", ["Gauss8", "Gauss12", "RadauIIA13"])
def test_rows_that_come_to_depend_on_each_other_give_way_to_a_redundant_one(method):
    system, q0, v0 = turned_four_bar(1)
    expected = solve_dae(system, (0.0, 4.0), q0, v0, "DOP853", 1e-12, 1e-12)
    result = solve_dae(system, (0.0, 4.0), q0, v0, method, 1e-12, 1e-12)
    assert result.success, result.message
    assert worst(result.q[:, -1], expected.q[:, -1]) < 1e-10
