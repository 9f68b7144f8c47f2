"""Test canonical variables: a symplectic tableau is symplectic in (q_i, p_i) and is not in (q_i, v_i)."""

from functools import cache

import numpy as np
import pytest

from tests import problems
from tests.marks import slow
from twoloop import RungeKutta, solve_dae
from twoloop.methods.tableaux import gauss, lobatto_iiie, sun_radau_iib

SYMPLECTIC = {"Sun": sun_radau_iib(3), "Gauss": gauss(3), "Lobatto": lobatto_iiie(4), "midpoint": gauss(1)}
START = np.array([0.7, -0.4, 1.1, -0.6])  # angles and momenta of the double pendulum
H = 0.1
DISPLACEMENT = 2e-3


def one_step(system, method, state, canonical, z, h=H):
    """The map of one step in canonical coordinates z = (angles, momenta)."""
    half = len(z) // 2
    q, v = state(z[:half], z[half:])
    result = solve_dae(system, (0.0, h), q, v, method=method, step_size=h)
    assert result.success and len(result.h) == 1
    return np.concatenate(canonical(result.q[:, -1], result.v[:, -1]))


def symplectic_defect(step, z):
    """max|J^T Omega J - Omega| of a map, J by central differences of order 4."""
    n = len(z)
    J = np.empty((n, n))
    for k in range(n):
        moved = [step(z + shift * DISPLACEMENT * np.eye(n)[k]) for shift in (-2, -1, 1, 2)]
        J[:, k] = (moved[0] - 8.0 * moved[1] + 8.0 * moved[2] - moved[3]) / (12.0 * DISPLACEMENT)
    half = n // 2
    omega = np.block([[np.zeros((half, half)), np.eye(half)], [-np.eye(half), np.zeros((half, half))]])
    return np.abs(J.T @ omega @ J - omega).max()


pendulums = cache(problems.double_pendulum)  # compiled once each


def defect(method, gamma=True):
    system = pendulums(gamma)
    return symplectic_defect(
        lambda z: one_step(system, method, problems.double_pendulum_state, problems.double_pendulum_canonical, z), START
    )


@pytest.mark.parametrize("name", ["Sun", *(slow(name) for name in SYMPLECTIC if name != "Sun")])
def test_a_symplectic_tableau_is_symplectic_in_momenta_and_not_in_velocities(name):
    assert defect(RungeKutta(SYMPLECTIC[name], variables="momenta")) < 1e-8
    assert defect(RungeKutta(SYMPLECTIC[name])) > 1e-6


def oblique_from_angle(angle, momentum):
    across = np.array([np.cos(angle[0]), np.sin(angle[0])])
    return problems.oblique_state(np.array([0.5 + np.sin(angle[0]), -np.cos(angle[0])]), momentum[0] * across)


def angle_of_oblique(q, v):
    phi = q[1] + 0.3 * q[0]
    radial, across = np.array([np.cos(phi), np.sin(phi)]), np.array([-np.sin(phi), np.cos(phi)])
    x = q[0] * radial - np.array([0.5, 0.0])
    u = v[0] * radial + q[0] * (v[1] + 0.3 * v[0]) * across
    return np.array([np.arctan2(x[0], -x[1])]), np.array([x[0] * u[1] - x[1] * u[0]])


@pytest.mark.parametrize("gamma", [False, slow(True)])
def test_symplectic_where_the_mass_matrix_depends_on_the_position(gamma):
    system = problems.oblique_pendulum(gamma, conservative=True)
    defects = {
        variables: symplectic_defect(
            lambda z, m=method: one_step(system, m, oblique_from_angle, angle_of_oblique, z, 0.2), np.array([1.2, -0.5])
        )
        for variables in ("velocities", "momenta")
        for method in [RungeKutta(sun_radau_iib(3), variables=variables)]
    }
    assert defects["momenta"] < 1e-8 and defects["velocities"] > 1e-7
