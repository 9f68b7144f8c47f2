"""The beam on its moving base: frequencies, static deflection, published motions."""

import math

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh

from references.scipy.beam_reduced import reduced_motion
from tests.problems import run, violations, worst
from twoloop import solve_dae
from twoloop.mechanisms import ancf_beam, moderately_stiff_beam, very_flexible_beam
from twoloop.mechanisms.ancf_beam import elastic_tangent, midpoint_deflection, tip_height

LOCKING = 0.7 / (1.3 * 0.4)  # (lambda + 2 mu)/E = (1 - nu)/((1 + nu)(1 - 2 nu)) at nu = 0.3: 1.346
EULER_BERNOULLI = 1.4836  # rad/s, the lowest bending frequency of the pinned-free beam with E = 2e6
# tip heights, m, at 0.2, 0.4, ... 2 s: another implementation of these equations in NumPy, written before this one;
# SciPy's DOP853 with rtol 1e-8, the motion of the base put in exactly
TIMES = np.arange(1, 11) / 5.0
TIP_HEIGHTS = {
    "flexible, node": [-0.2108, -0.9913, -0.8950, -0.1744, 0.3007, -0.1108, -0.7132, -0.9351, -0.0299, 0.3070],
    "flexible, beam": [-0.2191, -0.9988, -0.8216, -0.0600, 0.3571, 0.1310, -0.7351, -0.8546, -0.2785, 0.1443],
    "stiff, node": [-0.2535, -0.9007, -0.7901, -0.1776, 0.0135, -0.3583, -0.9670, -0.7115, -0.1470, 0.0014],
}
PRINTED = 1e-4  # the last digit above, and what two solutions with rtol 1e-8 may differ by


@pytest.fixture(scope="module")
def flexible():
    return very_flexible_beam()


@pytest.fixture(scope="module")
def stiff():
    return moderately_stiff_beam()


def tangent(problem):
    K = np.zeros((problem.q0.size, problem.q0.size))
    elastic_tangent(0.0, problem.q0, problem.v0, problem.system.functions.p, K)
    return K


def test_weight_is_2_88_kg_times_gravity(flexible):
    M = flexible.system.mass(0.0, flexible.q0)
    up = np.tile([0.0, 1.0, 0.0, 0.0, 0.0, 0.0], 5)
    assert abs(up @ M @ up - 7200.0 * 0.02 * 0.02) < 1e-14
    # straight and unloaded there is no elastic force
    assert worst(flexible.system.force(0.0, flexible.q0, flexible.v0), -9.81 * M @ up) < 1e-12


@pytest.mark.parametrize(("start", "moving"), [("node", 1), ("beam", 5)])
@pytest.mark.parametrize("case", [very_flexible_beam, moderately_stiff_beam])
def test_start_is_consistent_and_said(case, start, moving):
    problem = case(start=start)
    system = problem.system
    assert (system.constraint(0.0, problem.q0) == 0.0).all()
    assert (system.velocity_constraint(0.0, problem.q0, problem.v0) == 0.0).all()
    assert np.count_nonzero(problem.v0) == moving
    assert problem.v0[0] == problem.parameters["amplitude"] * problem.parameters["angular_frequency"]
    assert f"start='{start}'" in problem.note and "assumed" in problem.note and problem.parameters["start"] == start


@pytest.mark.parametrize("case", ["flexible", "stiff"])
def test_energy_balance_includes_the_work_of_the_base(case, request):
    # -lam acts on the beam at the base, whose velocity is -C_t: the power is lam . C_t
    problem = request.getfixturevalue(case)
    end = 0.02 if case == "flexible" else 0.002
    result = run(problem, end, method="Gauss6", t_eval=np.linspace(0.0, end, 2001), rtol=1e-10)
    assert result.success
    rate = np.array([problem.system.constraint_rate(t, problem.q0) for t in result.t]).T
    work = CubicSpline(result.t, (result.lam * rate).sum(axis=0)).antiderivative()(result.t)
    energy = problem.energy(result.t, result.q, result.v)
    assert np.ptp(energy) > 1e-3 and worst(energy - energy[0], work) < 1e-6 * np.ptp(energy)


@pytest.mark.parametrize(("case", "factor"), [("flexible", 1.0), ("stiff", 10.0)])
def test_frequencies_of_the_straight_beam(case, factor, request):
    # values from the same implementation in NumPy as the tip heights
    problem = request.getfixturevalue(case)
    M = problem.system.mass(0.0, problem.q0)
    w = np.sqrt(np.abs(eigh(-tangent(problem)[2:, 2:], M[2:, 2:], eigvals_only=True)))
    assert w[0] < 1e-3 * factor and worst(w[1:4] / factor, [1.771, 6.220, 14.75]) < 5e-3
    assert abs(w[4] / factor - 23.7) < 0.05 and abs(w[-1] / factor - 3358.5) < 0.05
    assert abs(w[1] / factor / EULER_BERNOULLI - 1.194) < 5e-4


def test_refined_meshes_bend_with_the_frequency_of_the_locked_beam():
    frequencies = []
    for n in (4, 8, 16, 32):
        problem = very_flexible_beam(n)
        M = problem.system.mass(0.0, problem.q0)
        w = np.sqrt(np.abs(eigh(-tangent(problem)[2:, 2:], M[2:, 2:], eigvals_only=True, subset_by_index=[0, 1])))
        frequencies.append(w[1])
    ratio = np.array(frequencies) / (math.sqrt(LOCKING) * EULER_BERNOULLI)
    assert abs(ratio[0] ** 2 - 1.059) < 1e-3
    assert abs(ratio[-1] - 1.0) < 2e-3  # shear and the inertia of turning cross-sections take the rest
    changes = -np.diff(ratio)
    assert np.abs(changes[:-1] / changes[1:] - 4.0).max() < 0.15  # second order


@pytest.mark.parametrize("modulus", [2e6, 2e8])
@pytest.mark.parametrize("n", [1, 2, 4, 8, 16, 32, 64])
def test_static_tip_deflection_is_that_of_the_locked_beam(modulus, n):
    # Clamped at the base, with a small load F at the tip: F L^3/(3 EI), EI times the locking factor, and F L/(mu A) by
    # shear. The curvature k is constant over an element: it misses 1/(4 n^2) of the bending, where M is linear
    problem = ancf_beam(n, youngs_modulus=modulus, amplitude=0.0, angular_frequency=1.0, gravity=0.0)
    load = np.zeros(6 * n)
    load[-5] = 1e-9 * modulus * 0.02**4
    tip = np.linalg.solve(-tangent(problem)[6:, 6:], load)[-5]
    bending = load[-5] / (3.0 * LOCKING * modulus * 0.02**4 / 12.0)
    assert abs(tip - bending * (1.0 - 0.25 / n**2) - (load[-5] * 2.6 / (modulus * 0.02**2))) < 5e-5 * bending / n
    # and the deflection under that load balances the forces of the elements
    q = problem.q0.copy()
    q[6:] += np.linalg.solve(-tangent(problem)[6:, 6:], load)
    # ... to rounding of the stretch: E A eps is 6e-4 of the load
    assert worst(problem.system.force(0.0, q, q)[6:], -load) < 1e-3 * load[-5]


def check_tip_heights(name, problem, end=2.0):
    n = np.count_nonzero(end + 1e-9 > TIMES)
    q, _ = reduced_motion(problem, TIMES[:n], 1e-8)
    assert worst(tip_height(q), TIP_HEIGHTS[name][:n]) < PRINTED
    return q


@pytest.mark.parametrize("end", [1.0, pytest.param(2.0, marks=pytest.mark.slow)])
def test_tip_of_the_very_flexible_beam(flexible, end):
    deflection = midpoint_deflection(check_tip_heights("flexible, node", flexible, end))
    known = np.array([-0.123, -0.042, 0.247, -0.175, -0.155])
    n = np.count_nonzero(TIMES[[0, 2, 4, 6, 9]] < end + 1e-9)
    assert worst(deflection[[0, 2, 4, 6, 9][:n]], known[:n]) < 1e-3


def test_tip_of_the_moderately_stiff_beam_at_first(stiff):
    check_tip_heights("stiff, node", stiff, 0.2)


@pytest.mark.slow
def test_tip_of_the_moderately_stiff_beam(stiff):
    assert np.abs(midpoint_deflection(check_tip_heights("stiff, node", stiff))).max() < 0.05


@pytest.mark.slow
def test_tip_of_the_very_flexible_beam_that_starts_as_a_whole():
    check_tip_heights("flexible, beam", very_flexible_beam(start="beam"))


@pytest.mark.slow
@pytest.mark.parametrize(("n", "height"), [(8, 0.001), (16, -0.091)])
def test_four_elements_are_too_few_for_the_very_flexible_beam(n, height):
    q, _ = reduced_motion(very_flexible_beam(n), [1.0], 1e-8)
    assert abs(tip_height(q)[0] - height) < 1e-3 and abs(tip_height(q)[0] - TIP_HEIGHTS["flexible, node"][4]) > 0.29


@pytest.mark.parametrize("method", ["SunRadau5", "PaperIRK"])
@pytest.mark.parametrize(("case", "end"), [("flexible", 0.05), ("stiff", 0.005)])
def test_two_loop_procedures_agree_with_the_reduced_equations(case, end, method, request):
    problem = request.getfixturevalue(case)
    result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, method)
    assert result.success
    q, v = reduced_motion(problem, [end], 1e-12)
    assert worst(result.q[:, -1], q[:, 0]) < 1e-9 and worst(result.v[:, -1], v[:, 0]) < 1e-5
    assert violations(problem.system, result)[0] < 1e-14 and result.stats.n_partitions == 1


@pytest.mark.slow
@pytest.mark.parametrize("method", ["SunRadau5", "PaperIRK"])
def test_two_loop_procedures_reach_the_tip_heights(flexible, method):
    result = solve_dae(flexible.system, (0.0, 2.0), flexible.q0, flexible.v0, method, t_eval=TIMES)
    assert result.success and worst(tip_height(result.q), TIP_HEIGHTS["flexible, node"]) < PRINTED


def test_fine_meshes_start():
    problem = very_flexible_beam(32)
    result = solve_dae(problem.system, (0.0, 1e-5), problem.q0, problem.v0)
    assert result.success and abs(result.q[0, -1] - problem.v0[0] * 1e-5) < 1e-12
    assert violations(problem.system, result)[0] < 1e-14


def test_outputs_of_a_bent_beam():
    q = very_flexible_beam(2).q0.copy()
    q[:2], q[6:8], q[12:14] = (0.0, 1.0), (0.5, 1.75), (0.0, 3.0)  # the chord points up; the middle lies to its right
    assert tip_height(q) == 3.0 and midpoint_deflection(q) == -0.5
    assert midpoint_deflection(np.tile(q[:, None], 4)).shape == (4,)
