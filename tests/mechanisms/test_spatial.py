"""What spatial bodies share: rotation by Euler parameters, joints and springs, against definitions and differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.mechanisms.make_references import solution
from tests.problems import row_errors
from twoloop.bodies.rotation import G, euler_parameters, euler_rates, pulled, rotated, rotated_rate, rotation_matrix
from twoloop.mechanisms.spatial import GROUND
from twoloop.mechanisms.spatial_bodies import SpatialBodies

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


def free_body(spin, gravity=(0.0, 0.0, 0.0)):
    rows = SpatialBodies(gravity)
    rows.body("body", 2.0, (1.0, 2.0, 2.5), (0.1, 0.2, 0.3), TURNS[0].as_matrix(), (1.0, -2.0, 0.5), spin)
    return rows


def test_a_free_body_obeys_eulers_equations():
    """J w' + w x (J w) = 0 in body axes, with w' of the acceleration that mass, force and the norm give."""
    rows = free_body(np.array([0.4, -0.3, 0.7]), (0.0, -9.81, 0.0))
    system, (q, v) = rows.system("body"), rows.start
    a = solution(system, 0.0, q, v)[0]
    assert a[:3] == pytest.approx([0.0, -9.81, 0.0])
    w, rate = 2.0 * G(q[3:]) @ v[3:], 2.0 * G(q[3:]) @ a[3:]
    J = np.array([1.0, 2.0, 2.5])
    assert J * rate + np.cross(w, J * w) == pytest.approx(np.zeros(3), abs=1e-14)


def test_energy_and_momentum_of_a_free_body():
    spin = np.array([0.4, -0.3, 0.7])
    rows = free_body(spin)
    q, v = rows.start
    R = TURNS[0].as_matrix()
    inertia = R @ np.diag([1.0, 2.0, 2.5]) @ R.T
    assert rows.energy(0.0, q, v) == pytest.approx(0.5 * (2.0 * 5.25 + spin @ inertia @ spin))
    point, axis = np.array([0.5, 0.0, -1.0]), np.array([0.0, 0.6, 0.8])
    moment = 2.0 * np.cross(q[:3] - point, v[:3]) + inertia @ spin
    assert rows.momentum(point, axis)(0.0, q, v) == pytest.approx(axis @ moment)
    many = rows.momentum(point, axis)(0.0, np.array([q, q]).T, np.array([v, v]).T)
    assert many == pytest.approx([axis @ moment] * 2)


@pytest.mark.parametrize(
    ("joint", "freedoms"),
    [
        (lambda rows: rows.spherical(0, 1, (0.3, 0.1, 0.2)), 9),
        (lambda rows: rows.revolute(0, 1, (0.3, 0.1, 0.2), (0.0, 0.6, 0.8)), 7),
        (lambda rows: rows.universal(0, 1, (0.3, 0.1, 0.2), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), 8),
        (lambda rows: rows.prismatic(0, 1, (0.3, 0.1, 0.2), (0.0, 0.6, 0.8)), 7),
        (lambda rows: rows.revolute(0, GROUND, (0.3, 0.1, 0.2), (0.0, 0.6, 0.8)), 7),
    ],
)
def test_joints(joint, freedoms):
    """Rows hold at the start, leave as many freedoms as the joint has, and have the derivatives that they should."""
    rows = SpatialBodies((0.0, 0.0, 0.0))
    for k in range(2):
        rows.body(str(k), 1.0, (1.0, 1.0, 1.0), RNG.normal(size=3), TURNS[k + 1].as_matrix())
    joint(rows)
    system, (q, _) = rows.system("joint"), rows.start
    assert np.abs(system.constraint(0.0, q)).max() < 1e-14
    assert np.linalg.matrix_rank(system.jacobian(0.0, q)) == system.n_c == 14 - freedoms
    assert max(row_errors(system, 0.0, q + 0.1 * RNG.normal(size=14), RNG.normal(size=14))) < 1e-8


def test_a_spring_pulls_with_its_energy_and_the_damper_takes_power():
    rows = SpatialBodies((0.0, 0.0, 0.0))
    for k in range(2):
        rows.body(str(k), 1.0, (1.0, 1.0, 1.0), RNG.normal(size=3), TURNS[k + 1].as_matrix())
    rows.spring(0, (0.3, 0.1, 0.2), 1, (1.0, -0.5, 0.4), 7.0, 0.0, 0.3)
    system, (q, _) = rows.system("spring"), rows.start
    v, still, h = RNG.normal(size=14), np.zeros(14), 1e-6
    slope = (rows.energy(0.0, q + h * v, still) - rows.energy(0.0, q - h * v, still)) / (2.0 * h)
    assert system.force(0.0, q, still) @ v == pytest.approx(-slope, abs=1e-8)
    damped = SpatialBodies((0.0, 0.0, 0.0))
    for k, place in enumerate(((0.0, 0.0, 0.0), (2.0, 0.0, 0.0))):
        damped.body(str(k), 1.0, (1.0, 1.0, 1.0), place, np.eye(3))
    damped.spring(0, (0.0, 0.0, 0.0), 1, (2.0, 0.0, 0.0), 0.0, 3.0, 0.0)
    v = np.zeros(14)
    v[7] = 0.5
    assert damped.system("damper").force(0.0, damped.start[0], v) @ v == pytest.approx(-3.0 * 0.5**2)
