"""No run ends on another assembly of the mechanism with success."""

import numpy as np
import pytest

from twoloop import ConstrainedSystem, consistent_state, solve_dae
from twoloop.mechanisms import four_bar

METHODS = ["SunRadau5", "Gauss12", "RadauIIA5", "Newmark", "BDF", "DOP853", "Adams"]
CRANK, ROD, SPEED = 0.3, 1.0, 2.0 * np.pi


def driven_slider_crank():
    """Every coordinate is prescribed: crank angle 2 pi t, rod angle, position of the slider."""

    def constraint(t, q):
        closure = CRANK * np.exp(1j * q[0]) + ROD * np.exp(1j * q[1]) - q[2]
        return np.array([closure.real, closure.imag, q[0] - SPEED * t])

    def jacobian(t, q):
        crank, rod = 1j * CRANK * np.exp(1j * q[0]), 1j * ROD * np.exp(1j * q[1])
        return np.array([[crank.real, rod.real, -1.0], [crank.imag, rod.imag, 0.0], [1.0, 0.0, 0.0]])

    def gamma(t, q, v):
        sum_ = CRANK * np.exp(1j * q[0]) * v[0] ** 2 + ROD * np.exp(1j * q[1]) * v[1] ** 2
        return np.array([sum_.real, sum_.imag, 0.0])

    return ConstrainedSystem.from_python(
        n_q=3,
        n_c=3,
        mass=np.eye(3),
        force=lambda t, q, v: np.array([0.0, -3.0, 0.0]),
        constraint=constraint,
        jacobian=jacobian,
        constraint_rate=lambda t, q: np.array([0.0, 0.0, -SPEED]),
        gamma=gamma,
        name="driven slider-crank",
    )


@pytest.mark.parametrize("tolerance", [1e-1, 1e-4, 1e-8])
@pytest.mark.parametrize("method", METHODS)
def test_a_mechanism_without_independent_coordinates(method, tolerance):
    if method == "Newmark":
        tolerance = max(tolerance, 1e-6)
    system = driven_slider_crank()
    q0, v0 = consistent_state(system, 0.0, [0.0, 0.0, CRANK + ROD], [SPEED, -SPEED * CRANK / ROD, 0.0])
    result = solve_dae(system, (0.0, 3.0), q0, v0, method, tolerance, tolerance)
    assert result.success, result.message
    rod = np.arcsin(-CRANK / ROD * np.sin(SPEED * result.t))
    assert np.abs(result.q[1] - rod).max() < 1e-9
    assert np.abs(result.q[2] - CRANK * np.cos(SPEED * result.t) - ROD * np.cos(rod)).max() < 1e-9
    assert result.h.max() < 1.0  # bounded by what the dependents do: a turn of the crank


def same_assembly(lengths, ground, result):
    """Whether a Grashof linkage stays on its assembly: the joints away from the shortest bar keep their sign."""
    bars = [*lengths, ground]
    theta = [*result.q[2::3], np.zeros_like(result.t)]
    shortest = int(np.argmin(bars))
    for i in range(4):
        j = (i + 1) % 4
        if shortest not in (i, j):
            side = np.sign(np.sin(theta[j] - theta[i]))
            if (side != side[0]).any():
                return False
    return True


def linkages(seed, n):
    """Random Grashof linkages, close to change points among them."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < n:
        lengths, ground = rng.uniform(0.3, 2.0, 3), float(rng.uniform(0.3, 2.0))
        bars = np.sort([*lengths, ground])
        if not bars[1] + bars[2] - bars[0] - bars[3] > 1e-3:
            continue
        try:
            problem = four_bar(tuple(lengths), ground, rng.uniform(-np.pi, np.pi), int(rng.choice([-1, 1])))
        except ValueError:  # it does not assemble
            continue
        found.append((tuple(lengths), ground, problem))
    return found


KNOWN = [  # each jumped with success before dependents entered the error test
    ((1.0912, 1.3596, 0.6330), 0.3511, 0.0332, -1),
    ((1.7365, 1.8959, 0.3385), 0.5008, None, None),
    ((0.8906, 0.6238, 1.9312), 1.6662, None, None),
]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("tolerance", [0.03, 0.1, 0.3])
def test_loose_tolerances_on_a_linkage_that_jumped(method, tolerance):
    lengths, ground, theta3, branch = KNOWN[0]
    problem = four_bar(lengths, ground, theta3, branch)
    result = solve_dae(problem.system, (0.0, 10.0), problem.q0, problem.v0, method, tolerance, tolerance)
    assert result.success, result.message
    assert same_assembly(lengths, ground, result)


@pytest.mark.parametrize("start", np.linspace(-3.0, 3.0, 13))
@pytest.mark.parametrize("known", KNOWN[1:], ids=["near a change point", "nearer"])
def test_loose_tolerances_near_change_points(known, start):
    lengths, ground = known[:2]
    for branch in (-1, 1):
        try:
            problem = four_bar(lengths, ground, float(start), branch)
        except ValueError:
            continue
        for method in ("Newmark", "RadauIIA5", "BDF"):
            for tolerance in (0.03, 0.3):
                run = solve_dae(problem.system, (0.0, 5.0), problem.q0, problem.v0, method, tolerance, tolerance)
                assert not run.success or same_assembly(lengths, ground, run)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_random_linkages_at_loose_tolerances(method):
    for lengths, ground, problem in linkages(11, 600):
        for tolerance in (0.03, 0.1, 0.3):
            run = solve_dae(problem.system, (0.0, 5.0), problem.q0, problem.v0, method, tolerance, tolerance)
            assert not run.success or same_assembly(lengths, ground, run), (lengths, ground, tolerance)


@pytest.mark.parametrize("method", METHODS)
def test_a_few_random_linkages_at_loose_tolerances(method):
    for lengths, ground, problem in linkages(5, 25):
        for tolerance in (0.03, 0.3):
            run = solve_dae(problem.system, (0.0, 5.0), problem.q0, problem.v0, method, tolerance, tolerance)
            assert not run.success or same_assembly(lengths, ground, run), (lengths, ground, tolerance)
