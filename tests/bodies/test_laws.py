"""Test accelerations of random mechanisms against Newton's and Euler's laws written apart, and large models."""

import numpy as np
import pytest

from tests.bodies.newton_euler import Bodies
from tests.bodies.random_models import Both
from tests.marks import slow
from twoloop import consistent_state
from twoloop.bodies.rotation import G, rotation_matrix


def accelerations(system, t, q, v):
    """q'' by least squares: redundant rows and the mass matrix of Euler parameters are singular."""
    M, J = system.mass(t, q), system.jacobian(t, q)
    m = len(J)
    K = np.block([[M, J.T], [J, np.zeros((m, m))]])
    return np.linalg.lstsq(K, np.append(system.force(t, q, v), system.gamma(t, q, v)), rcond=1e-12)[0][: len(q)]


def states(both, q, v, a):
    """Positions, rotations, velocities, accelerations of the bodies in space."""
    if both.planar:
        q, v, a = (each.reshape(-1, 3) for each in (q, v, a))
        c, s, zero = np.cos(q[:, 2]), np.sin(q[:, 2]), 0.0 * q[:, 2]
        R = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1.0]]).transpose(2, 0, 1)
        flat = [np.column_stack([each[:, :2], zero]) for each in (q, v, a)]
        spins = [np.column_stack([zero, zero, each[:, 2]]) for each in (v, a)]
        return flat[0], R, flat[1], spins[0], flat[2], spins[1]
    q, v, a = (each.reshape(-1, 7) for each in (q, v, a))
    R = np.array([rotation_matrix(each[3:]) for each in q])
    spins = [np.array([at @ (2.0 * G(e[3:]) @ u[3:]) for at, e, u in zip(R, q, each, strict=True)]) for each in (v, a)]
    return q[:, :3], R, v[:, :3], spins[0], a[:, :3], spins[1]


def in_motion(both, t=0.4):
    """The problem, and a consistent state of it far from the start."""
    problem = both.model.problem(t_span=(t, t + 1.0))
    system, random = problem.system, both.random
    away = problem.q0 + random.uniform(-0.2, 0.2, system.n_q)
    v = problem.v0 + random.uniform(-2.0, 2.0, system.n_q)
    return problem, *consistent_state(system, t, away, v, check_assembly=False)


def assert_follows_the_laws(both, t=0.4):
    if both.planar:
        for k in range(both.n):
            both.plane_bound(k)
    problem, q, v = in_motion(both, t)
    system = problem.system
    assert system.python_functions == {}
    x, R, u, w, a, alpha = states(both, q, v, accelerations(system, t, q, v))
    assert np.abs(both.laws.constraint(t, x, R)).max(initial=0.0) < 1e-9  # the position, asked of those
    known = both.laws.matrix(t, x, R) @ np.column_stack([u, w]).ravel() + both.laws.rate(t, x, R)
    assert np.abs(known).max(initial=0.0) < 1e-9
    there, turned = both.laws.accelerations(t, x, R, u, w)
    scale = 1.0 + np.abs(there).max()
    np.testing.assert_allclose(a, there, atol=3e-8 * scale)
    np.testing.assert_allclose(alpha, turned, atol=3e-8 * scale)
    return problem


PLANAR = ("revolute", "prismatic", "fixed", "distance")
SPATIAL = (*PLANAR, "spherical", "universal", "cylindrical", "table")


@pytest.mark.parametrize("seed", [*range(4), *(slow(k) for k in range(4, 14))])
@pytest.mark.parametrize("planar", [True, False])
def test_chains_with_everything(planar, seed):
    both = Both(seed, planar, n=5)
    random = both.random
    kinds = PLANAR if planar else SPATIAL
    for k in range(5):
        parent = None if k == 0 or random.random() < 0.1 else int(random.integers(k))
        i, j = (parent, k) if random.random() < 0.7 else (k, parent)
        kind = kinds[(k + seed) % len(kinds)]
        made = getattr(both, kind)(i, j)
        if kind in ("revolute", "prismatic"):
            joint, axis, point = made
            if random.random() < 0.7:
                both.motor(i, j, joint, axis, point, lambda t: 2.0 * np.sin(3.0 * t) + 0.5)
            if kind == "revolute" and random.random() < 0.8:
                both.torsion(i, j, joint, axis)
            if random.random() < 0.5:
                (both.brake if kind == "revolute" else both.rail)(i, j, *made[: 2 if kind == "revolute" else 3])
            if random.random() < 0.3:
                both.drive(i, j, joint, axis, point, lambda t: 0.3 * np.sin(2.0 * t) + 0.2 * t**2)
    both.spring(None, 3)
    both.spring(0, 4)
    both.force(1, lambda t: np.array([np.cos(t), 2.0 * t, 0.0 if planar else np.exp(-t)]))
    both.torque(2, 0.7)
    assert_follows_the_laws(both)


def test_a_loop_closed_by_every_joint():
    """Rows that follow from others: a plane in space, closed by a fifth row more than it needs."""
    both = Both(3, False, n=3)
    z = np.array([0.0, 0.0, 1.0])
    both.axis = lambda: z
    for i, j in ((None, 0), (0, 1), (1, 2), (2, None)):
        both.revolute(i, j)
    problem = assert_follows_the_laws(both)
    assert problem.freedom.degrees == 1
    assert problem.freedom.redundant == (tuple(joint.name for joint in both.model.joints),)


@pytest.mark.parametrize("seed", [1, 2, *(slow(k) for k in (0, 3, 4))])
@pytest.mark.parametrize("planar", [True, False])
def test_energy_changes_by_the_power_of_what_has_no_potential(planar, seed):
    both, t = Both(100 + seed, planar, n=4), 0.4
    joints = []
    for k, kind in enumerate(("revolute", "prismatic", "revolute", "fixed" if planar else "universal")):
        parent = None if k == 0 else k - 1
        joints.append(getattr(both, kind)(parent, k))
    both.torsion(None, 0, *joints[0][:2], damped=False)
    both.rail(0, 1, *joints[1], damped=False)
    both.spring(None, 3, damped=False)
    both.spring(0, 2, damped=False)
    assert both.model.problem().conserved
    if seed > 1:
        both.motor(0, 1, *joints[1], lambda t: 3.0 * np.cos(t))
        both.motor(1, 2, *joints[2], lambda t: 2.0)
        both.force(3, lambda t: np.array([1.0, np.sin(t), 0.5 * (not planar)]))
        both.torque(1, 2.0)
        both.spring(1, 3, stiff=False)
    problem, q, v = in_motion(both, t)
    assert problem.conserved == (seed <= 1)
    a = accelerations(problem.system, t, q, v)
    h = 1e-4 * np.array([-2.0, -1.0, 1.0, 2.0])
    energies = problem.energy(t, q[:, None] + np.outer(v, h) + np.outer(a, 0.5 * h**2), v[:, None] + np.outer(a, h))
    rate = (energies @ np.array([1.0, -8.0, 8.0, -1.0])) / 12e-4
    x, R, u, w, _, _ = states(both, q, v, a)
    loads = both.laws.applied(t, Bodies(x, R), u, w, springs=False)
    power = 0.0
    for body, at, force, torque in loads:
        power += force @ (u[body] + np.cross(w[body], at - x[body])) + torque @ w[body]
    assert rate == pytest.approx(power, abs=1e-6 * (1.0 + np.abs(energies).max()))


def with_everything(planar):
    """A chain of every joint, drives, and in a plane rows that are functions."""
    both, hinges, n = Both(5, planar, n=24 if planar else 11), [], 24 if planar else 11
    kinds = PLANAR if planar else SPATIAL
    for k in range(n):
        made = getattr(both, kinds[k % len(kinds)])(k - 1 if k else None, k)
        if kinds[k % len(kinds)] in ("revolute", "prismatic"):
            hinges += [made[0]] if kinds[k % len(kinds)] == "revolute" else []
            if k % 8 < 2:
                both.drive(k - 1 if k else None, k, *made, lambda t: 0.3 * np.sin(t))
    if planar:
        both.model.gear(hinges[1], hinges[2], ratio=-1.5)
        both.model.skate("b3", at=both.x[3, :2], axis=(1.0, 0.3))
    return both.model


@pytest.mark.parametrize("planar", [True, False])
def test_values_of_entries_are_those_of_the_dense_matrices(planar):
    system = with_everything(planar).problem().system
    assert set(system.entries) == {"mass", "jacobian"}
    for seed in range(3):
        q = np.random.default_rng(seed).normal(size=system.n_q)
        for dense, values, n in (("mass", "mass_values", system.n_q), ("jacobian", "jacobian_values", system.n_c)):
            made = np.zeros((n, system.n_q))
            np.add.at(made, system.entries[dense], getattr(system, values)(0.3, q))
            np.testing.assert_array_equal(made, getattr(system, dense)(0.3, q))
