"""The ANCF element against its definition: shape functions, Green-Lagrange strains, Gauss points, complex steps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.problems import slope, worst
from twoloop.mechanisms import ancf_beam
from twoloop.mechanisms.ancf_beam import elastic_tangent

N = 3  # elements
LENGTH, HEIGHT, WIDTH, DENSITY = 0.9, 0.12, 0.07, 500.0
YOUNG, POISSON = 3e4, 0.3
N_Q = 6 * (N + 1)
displacements = st.lists(st.floats(-0.4, 0.4), min_size=N_Q, max_size=N_Q).map(np.array)
anything = st.lists(st.floats(-2.0, 2.0), min_size=N_Q, max_size=N_Q).map(np.array)


@pytest.fixture(scope="module")
def beam():
    """Thick enough for all terms to count; without gravity the force is the elastic force."""
    return ancf_beam(
        N,
        youngs_modulus=YOUNG,
        poisson_ratio=POISSON,
        density=DENSITY,
        length=LENGTH,
        height=HEIGHT,
        width=WIDTH,
        amplitude=0.0,
        angular_frequency=1.0,
        gravity=0.0,
    )


def gauss(n, a, b):
    x, w = np.polynomial.legendre.leggauss(n)
    return 0.5 * (a + b) + 0.5 * (b - a) * x, 0.5 * (b - a) * w


def shape(xi, y, l):
    """S_1 to S_6, and their derivatives with respect to x and y."""
    S = [
        1 - 3 * xi**2 + 2 * xi**3,
        l * (xi - 2 * xi**2 + xi**3),
        (1 - xi) * y,
        3 * xi**2 - 2 * xi**3,
        l * (xi**3 - xi**2),
        xi * y,
    ]
    S_xi = [-6 * xi + 6 * xi**2, l * (1 - 4 * xi + 3 * xi**2), -y, 6 * xi - 6 * xi**2, l * (3 * xi**2 - 2 * xi), y]
    return np.array(S), np.array(S_xi) / l, np.array([0, 0, 1 - xi, 0, 0, xi])


def strain_energy(q, n_x=5, n_y=3):
    """By the definition, for real or complex q, with n_x times n_y Gauss points an element."""
    l = LENGTH / N
    lame = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    mu = YOUNG / (2 * (1 + POISSON))
    law = np.array([[lame + 2 * mu, lame, 0], [lame, lame + 2 * mu, 0], [0, 0, mu]])
    total = 0.0
    for i in range(N):
        e = q[6 * i : 6 * i + 12].reshape(6, 2)
        for x, wx in zip(*gauss(n_x, 0.0, l), strict=True):
            for y, wy in zip(*gauss(n_y, -0.5 * HEIGHT, 0.5 * HEIGHT), strict=True):
                _, S_x, S_y = shape(x / l, y, l)
                r_x, r_y = S_x @ e, S_y @ e
                strain = np.array([0.5 * (r_x @ r_x - 1), 0.5 * (r_y @ r_y - 1), r_x @ r_y])
                total += 0.5 * WIDTH * wx * wy * (strain @ law @ strain)
    return total


def defined_force(q):
    e = 1e-30
    return np.array([-strain_energy(q + 1j * e * unit).imag / e for unit in np.eye(N_Q)])


def tangent(problem, q):
    K = np.zeros((q.size, q.size))
    elastic_tangent(0.0, q, np.zeros(q.size), problem.system.functions.p, K)
    return K


def turned(q, angle, x=0.0, y=0.0):
    """The beam after a rigid motion: positions turned and shifted, slopes turned."""
    rotation = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    vectors = q.reshape(-1, 2) @ rotation.T
    vectors[0::3] += x, y
    return vectors.ravel()


@given(displacements)
def test_force_is_minus_the_gradient_of_the_strain_energy(beam, u):
    q = beam.q0 + u
    expected = defined_force(q)
    assert worst(beam.system.force(0.0, q, u), expected) < 1e-13 * max(np.abs(expected).max(), YOUNG * HEIGHT * WIDTH)


@given(displacements)
def test_energy_is_that_of_the_definition_and_5_by_3_points_are_exact(beam, u):
    q = beam.q0 + u
    expected = strain_energy(q)
    assert abs(beam.energy(0.0, q, np.zeros(N_Q)) - expected) < 1e-12 * expected + 1e-15
    assert abs(strain_energy(q, 8, 5) - expected) < 1e-12 * expected + 1e-15


def test_4_by_3_points_are_not_exact(beam):
    q = beam.q0 + 0.4 * np.cos(7.0 * np.arange(N_Q))
    assert abs(strain_energy(q, 4, 3) / strain_energy(q) - 1.0) > 1e-6


@given(anything)
def test_tangent_is_the_derivative_of_the_force(beam, q):
    # the force is a cubic polynomial: central differences of order 4 are exact but for rounding
    K = tangent(beam, q)
    for unit, column in zip(np.eye(N_Q), K.T, strict=True):
        difference = slope(lambda s, unit=unit: beam.system.force(0.0, q + s * unit, q), 0.1)
        assert worst(column, difference) < 1e-12 * np.abs(K).max()
    assert worst(K, K.T) < 1e-15 * np.abs(K).max()


def test_tangent_couples_neighbouring_nodes_only(beam):
    K = tangent(beam, beam.q0 + 0.3 * np.cos(np.arange(N_Q)))
    node = np.arange(N_Q) // 6
    far = np.abs(node[:, None] - node[None, :]) > 1
    assert (K[far] == 0.0).all() and np.abs(K[~far]).max() > 0.0


@given(st.floats(-math.pi, math.pi), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_rigid_motions_give_no_force_and_no_energy(beam, angle, x, y):
    q = turned(beam.q0, angle, x, y)
    stiffness = YOUNG * HEIGHT * WIDTH
    assert np.abs(beam.system.force(0.0, q, q)).max() < 1e-13 * stiffness
    assert abs(beam.energy(0.0, q, np.zeros(N_Q))) < 1e-25 * stiffness
    # nor does the next infinitesimal one: shifts along x and y, a turn about the origin
    K = tangent(beam, q)
    shift = np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], N + 1)
    for direction in (shift, np.roll(shift, 1), turned(q, 0.5 * math.pi)):
        assert np.abs(K @ direction).max() < 1e-11 * np.abs(K).max()


@given(displacements, st.floats(-math.pi, math.pi))
def test_force_turns_with_the_beam(beam, u, angle):
    q = beam.q0 + u
    force = beam.system.force(0.0, q, u)
    there = beam.system.force(0.0, turned(q, angle, 1.0, -2.0), u)
    assert worst(there, turned(force, angle)) < 1e-12 * max(np.abs(force).max(), YOUNG * HEIGHT * WIDTH)


def test_mass_matrix_is_the_integral_of_the_shape_functions(beam):
    l = LENGTH / N
    expected = np.zeros((N_Q, N_Q))
    for i in range(N):
        here = slice(6 * i, 6 * i + 12)
        for x, wx in zip(*gauss(4, 0.0, l), strict=True):
            for y, wy in zip(*gauss(2, -0.5 * HEIGHT, 0.5 * HEIGHT), strict=True):
                S = np.kron(shape(x / l, y, l)[0], np.eye(2))
                expected[here, here] += DENSITY * WIDTH * wx * wy * S.T @ S
    M = beam.system.mass(0.0, beam.q0)
    assert worst(M, expected) < 1e-14 and np.linalg.eigvalsh(M).min() > 0.0
