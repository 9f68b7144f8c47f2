"""Test the ANCF element against its definition, and the beam on its moving base against published and other motions."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh

from references.scipy.beam_reduced import reduced_motion
from tests.marks import slow
from tests.problems import run, slope, violations, worst
from twoloop import solve_dae
from twoloop.mechanisms import ancf_beam, moderately_stiff_beam, very_flexible_beam
from twoloop.mechanisms.ancf_beam import elastic_tangent, midpoint_deflection, tip_height

N = 3  # elements
LENGTH, HEIGHT, WIDTH, DENSITY = 0.9, 0.12, 0.07, 500.0
YOUNG, POISSON = 3e4, 0.3
N_Q = 6 * (N + 1)
displacements = st.lists(st.floats(-0.4, 0.4), min_size=N_Q, max_size=N_Q).map(np.array)
anything = st.lists(st.floats(-2.0, 2.0), min_size=N_Q, max_size=N_Q).map(np.array)


@pytest.fixture(scope="module")
def beam():
    """Thick enough for all terms to count; without gravity the force is the elastic force."""
    section = {"length": LENGTH, "height": HEIGHT, "width": WIDTH, "density": DENSITY, "poisson_ratio": POISSON}
    return ancf_beam(N, youngs_modulus=YOUNG, amplitude=0.0, angular_frequency=1.0, gravity=0.0, **section)


def gauss(n, a, b):
    x, w = np.polynomial.legendre.leggauss(n)
    return 0.5 * (a + b) + 0.5 * (b - a) * x, 0.5 * (b - a) * w


def shape(xi, y, l):
    """S_1 to S_6, and their derivatives with respect to x and y."""
    first = [1 - 3 * xi**2 + 2 * xi**3, l * (xi - 2 * xi**2 + xi**3), (1 - xi) * y]
    S = [*first, 3 * xi**2 - 2 * xi**3, l * (xi**3 - xi**2), xi * y]
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


@settings(max_examples=8)
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


@given(anything)
def test_tangent_is_the_derivative_of_the_force(beam, q):
    # the force is a cubic polynomial: central differences of order 4 are exact but for rounding
    K = tangent(beam, q)
    for unit, column in zip(np.eye(N_Q), K.T, strict=True):
        difference = slope(lambda s, unit=unit: beam.system.force(0.0, q + s * unit, q), 0.1)
        assert worst(column, difference) < 1e-12 * np.abs(K).max()
    assert worst(K, K.T) < 1e-15 * np.abs(K).max()


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


LOCKING = 0.7 / (1.3 * 0.4)  # (lambda + 2 mu)/E = (1 - nu)/((1 + nu)(1 - 2 nu)) at nu = 0.3: 1.346
EULER_BERNOULLI = 1.4836  # rad/s, the lowest bending frequency of the pinned-free beam with E = 2e6
# tip heights, m, at 0.2, 0.4, ... 2 s: another implementation of these equations in NumPy, written before this one;
# SciPy's DOP853 with rtol 1e-8, the motion of the base put in exactly
TIMES = np.arange(1, 11) / 5.0
TIP_HEIGHTS = {
    "flexible": [-0.2108, -0.9913, -0.8950, -0.1744, 0.3007, -0.1108, -0.7132, -0.9351, -0.0299, 0.3070],
    "stiff": [-0.2535, -0.9007, -0.7901, -0.1776, 0.0135, -0.3583, -0.9670, -0.7115, -0.1470, 0.0014],
}
PRINTED = 1e-4  # the last digit above, and what two solutions with rtol 1e-8 may differ by


BEAMS = {"flexible": very_flexible_beam(), "stiff": moderately_stiff_beam()}


def test_energy_balance_includes_the_work_of_the_base():
    # -lam acts on the beam at the base, whose velocity is -C_t: the power is lam . C_t
    problem, end = BEAMS["flexible"], 0.02
    result = run(problem, end, method="Gauss6", t_eval=np.linspace(0.0, end, 2001), rtol=1e-10)
    assert result.success
    rate = np.array([problem.system.constraint_rate(t, problem.q0) for t in result.t]).T
    work = CubicSpline(result.t, (result.lam * rate).sum(axis=0)).antiderivative()(result.t)
    energy = problem.energy(result.t, result.q, result.v)
    assert np.ptp(energy) > 1e-3 and worst(energy - energy[0], work) < 1e-6 * np.ptp(energy)


@pytest.mark.parametrize(("case", "factor"), [("flexible", 1.0), ("stiff", 10.0)])
def test_frequencies_of_the_straight_beam(case, factor):
    # values from the same implementation in NumPy as the tip heights
    problem = BEAMS[case]
    M = problem.system.mass(0.0, problem.q0)
    w = np.sqrt(np.abs(eigh(-tangent(problem, problem.q0)[2:, 2:], M[2:, 2:], eigvals_only=True)))
    assert w[0] < 1e-3 * factor and worst(w[1:4] / factor, [1.771, 6.220, 14.75]) < 5e-3
    assert abs(w[4] / factor - 23.7) < 0.05 and abs(w[-1] / factor - 3358.5) < 0.05
    assert abs(w[1] / factor / EULER_BERNOULLI - 1.194) < 5e-4


@pytest.mark.parametrize(("n", "modulus"), [(1, 2e6), (4, 2e8), (32, 2e6)])
def test_static_tip_deflection_is_that_of_the_locked_beam(modulus, n):
    # Clamped at the base, with a small load F at the tip: F L^3/(3 EI), EI times the locking factor, and F L/(mu A) by
    # shear. The curvature k is constant over an element: it misses 1/(4 n^2) of the bending, where M is linear
    problem = ancf_beam(n, youngs_modulus=modulus, amplitude=0.0, angular_frequency=1.0, gravity=0.0)
    load = np.zeros(6 * n)
    load[-5] = 1e-9 * modulus * 0.02**4
    tip = np.linalg.solve(-tangent(problem, problem.q0)[6:, 6:], load)[-5]
    bending = load[-5] / (3.0 * LOCKING * modulus * 0.02**4 / 12.0)
    assert abs(tip - bending * (1.0 - 0.25 / n**2) - (load[-5] * 2.6 / (modulus * 0.02**2))) < 5e-5 * bending / n
    # and the deflection under that load balances the forces of the elements
    q = problem.q0.copy()
    q[6:] += np.linalg.solve(-tangent(problem, problem.q0)[6:, 6:], load)
    # ... to rounding of the stretch: E A eps is 6e-4 of the load
    assert worst(problem.system.force(0.0, q, q)[6:], -load) < 1e-3 * load[-5]


@pytest.mark.parametrize(("case", "end"), [slow("stiff", 0.2), slow("stiff", 2.0), slow("flexible", 2.0)])
def test_tip_heights(case, end):
    n = np.count_nonzero(end + 1e-9 > TIMES)
    q, _ = reduced_motion(BEAMS[case], TIMES[:n], 1e-8)
    assert worst(tip_height(q), TIP_HEIGHTS[case][:n]) < PRINTED
    deflection = midpoint_deflection(q)
    if case == "stiff":
        assert np.abs(deflection).max() < 0.05
    else:
        assert worst(deflection[[0, 2, 4, 6, 9]], [-0.123, -0.042, 0.247, -0.175, -0.155]) < 1e-3


@pytest.mark.parametrize(("case", "end", "method"), [slow("flexible", 0.05, "PaperIRK"), ("stiff", 0.002, "SunRadau5")])
def test_two_loop_procedures_agree_with_the_reduced_equations(case, end, method):
    problem = BEAMS[case]
    result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, method)
    assert result.success
    q, v = reduced_motion(problem, [end], 1e-12)
    assert worst(result.q[:, -1], q[:, 0]) < 1e-9 and worst(result.v[:, -1], v[:, 0]) < 1e-5
    assert violations(problem.system, result)[0] < 1e-14 and result.stats.n_partitions == 1


def test_outputs_of_a_bent_beam():
    q = very_flexible_beam(2).q0.copy()
    q[:2], q[6:8], q[12:14] = (0.0, 1.0), (0.5, 1.75), (0.0, 3.0)  # the chord points up; the middle lies to its right
    assert tip_height(q) == 3.0 and midpoint_deflection(q) == -0.5
    assert midpoint_deflection(np.tile(q[:, None], 4)).shape == (4,)
