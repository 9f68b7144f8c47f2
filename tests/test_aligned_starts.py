"""Starts next to where entries of C_q vanish by the position alone, as of bars beside upright: no error hides there."""

import math

import numpy as np
import pytest

from tests.problems import unconstrained
from tests.test_starts import accepted
from twoloop.bodies import SpatialModel
from twoloop.checks.consistency import check_start
from twoloop.mechanisms import n_four_bar


def test_velocities_are_judged_beside_what_rounding_of_the_positions_makes_of_them():
    """Forty parallel bars a little away from where an entry of C_q of each vanishes."""
    system, refused = n_four_bar(40).system, []
    along = np.arange(41.0)
    for angle in np.geomspace(1e-8, 1e-4, 80).tolist():
        q = np.column_stack([along + np.sin(angle), np.full(41, np.cos(angle))]).ravel()
        v = np.tile([np.cos(angle), -np.sin(angle)], 41)
        try:
            check_start(system, 0.0, q, v, derivatives=False)
        except ValueError as error:
            refused.append(str(error))
        v[1::2] += 1e-7 * np.cos(along)  # along the bars
        with pytest.raises(ValueError, match="v0 is not consistent"):
            check_start(system, 0.0, q, v, derivatives=False)
    assert not refused


def hanging(angle, wrong=1.0):
    """Three points one below the other on rods of 1 m, next to upright; gamma may be wrong in its vertical terms."""

    def parts(x):
        return np.diff(np.vstack([np.zeros(2), x.reshape(3, 2)]), axis=0)

    def jacobian(t, q):
        rows, d = np.zeros((3, 3, 2)), parts(q)
        for i in range(3):
            rows[i, i] = d[i]
            rows[i, i - 1] -= d[i] if i > 0 else 0.0
        return rows.reshape(3, 6)

    system = unconstrained(
        lambda t, q, v: np.tile([0.0, -9.81], 3),
        6,
        n_c=3,
        constraint=lambda t, q: 0.5 * (parts(q) ** 2).sum(axis=1) - 0.5,
        jacobian=jacobian,
        gamma=lambda t, q, v: -(parts(v) ** 2) @ np.array([1.0, wrong]),
    )
    down = np.array([math.sin(angle), -math.cos(angle)])
    below = np.arange(1.0, 4.0)[:, None]
    return system, (below * down).ravel(), (below * [-down[1], down[0]]).ravel()


@pytest.mark.parametrize("angle", [0.0, 1e-11, 1e-9, 1e-8, 1e-6, 1e-4, 1e-2, 0.3])
def test_what_vanishes_by_the_position_alone_hides_no_error(angle):
    system, q, v = hanging(angle)
    assert accepted(system, q, v)
    for off in (1e-6, 1e-3, 1.0):
        assert not accepted(system, q, v + off * q)  # along the rods
        assert not accepted(system, (1.0 + off) * q, v)
    for wrong in (1.01, 2.0):
        with pytest.raises(ValueError, match="gamma of"):
            check_start(hanging(angle, wrong)[0], 0.0, q, v)


@pytest.mark.parametrize("turned", [1e-9, 1e-7, 1e-5, 1e-3])
def test_an_inertia_that_is_rounding_of_zero_makes_no_velocity_consistent(turned):
    """Euler parameters have one in the direction of their norm, and rounding may leave M an inverse of 1e16."""
    random = np.random.default_rng(8)
    for _ in range(12):  # which M has an inverse then hangs on the processor
        model, end = SpatialModel(name="rod"), (0.5, 0.0, 0.0) + turned * random.standard_normal(3)
        model.rod("rod", (0.0, 0.0, 0.0), tuple(end), mass=1.0, radius=0.05)
        model.spherical("ground", "rod", at=(0.0, 0.0, 0.0))
        problem = model.problem(t_span=(0.0, 1.0))
        assert accepted(problem.system, problem.q0, problem.v0)
        for row in problem.system.jacobian(0.0, problem.q0):
            assert not accepted(problem.system, problem.q0, problem.v0 + 1e-3 * row)
