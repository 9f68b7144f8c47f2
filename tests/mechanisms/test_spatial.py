"""Rotation by Euler parameters, and angular momentum, against definitions and differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twoloop.bodies.rotation import G, euler_parameters, euler_rates, pulled, rotated, rotated_rate, rotation_matrix
from twoloop.mechanisms.momentum import Momentum

RNG = np.random.default_rng(3)
TURNS = Rotation.random(20, random_state=5)


@pytest.mark.parametrize("turn", [*TURNS, Rotation.from_rotvec([np.pi, 0.0, 0.0]), Rotation.from_rotvec([0, np.pi, 0])])
def test_matrix_and_parameters(turn):
    e = euler_parameters(turn.as_matrix())
    assert rotation_matrix(e) == pytest.approx(turn.as_matrix(), abs=1e-14) and e @ e == pytest.approx(1.0)
    spin = RNG.normal(size=3)
    u = euler_rates(e, spin)
    assert 2.0 * rotation_matrix(e) @ G(e) @ u == pytest.approx(spin, abs=1e-14)
    assert e @ u == pytest.approx(0.0, abs=1e-15)


def test_what_is_no_rotation_is_refused():
    for wrong in (2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.eye(2)):
        with pytest.raises(ValueError, match="R must be a rotation matrix"):
            euler_parameters(wrong)


def test_vectors_and_their_derivatives():
    """Off the unit sphere too, where steps and differences evaluate."""
    e, u, a, f = RNG.normal(size=4), RNG.normal(size=4), RNG.normal(size=3), RNG.normal(size=3)
    assert rotated(*e, *a) == pytest.approx(rotation_matrix(e) @ a)
    h = 1e-6
    ahead, behind = (np.array(rotated(*(e + s * u), *a)) for s in (h, -h))
    assert rotated_rate(*e, *u, *a) == pytest.approx((ahead - behind) / (2.0 * h), abs=1e-8)
    assert np.dot(pulled(*e, *a, *f), u) == pytest.approx(f @ np.array(rotated_rate(*e, *u, *a)))
    bend = (ahead + behind - 2.0 * rotation_matrix(e) @ a) / h**2
    assert 2.0 * np.array(rotated(*u, *a)) == pytest.approx(bend, abs=1e-2)


def test_momentum_of_a_free_body():
    spin, R = np.array([0.4, -0.3, 0.7]), TURNS[0].as_matrix()
    e, moments = euler_parameters(R), np.array([1.0, 2.0, 2.5])
    q, v = np.append([0.1, 0.2, 0.3], e), np.append([1.0, -2.0, 0.5], euler_rates(e, spin))
    point, axis = np.array([0.5, 0.0, -1.0]), np.array([0.0, 0.6, 0.8])
    moment = 2.0 * np.cross(q[:3] - point, v[:3]) + R @ (moments * (R.T @ spin))
    momentum = Momentum(np.array([[2.0, *moments]]), point, axis)
    assert momentum(0.0, q, v) == pytest.approx(axis @ moment)
    assert momentum(0.0, np.array([q, q]).T, np.array([v, v]).T) == pytest.approx([axis @ moment] * 2)
