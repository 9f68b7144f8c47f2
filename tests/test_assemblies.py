"""No run ends on another assembly of the mechanism with success."""

import numpy as np
import pytest

from tests.problems import quick, run, worst
from twoloop.mechanisms import driven_slider_crank, four_bar

METHODS = ["Adams", "RadauIIA5", "BDF", "SunRadau5", "Gauss12", "Newmark", "DOP853"]


@pytest.mark.parametrize("tolerance", quick([1e-1, 1e-4, 1e-8]))
@pytest.mark.parametrize("method", quick(METHODS, 3))
def test_a_mechanism_without_independent_coordinates(method, tolerance):
    """Every coordinate is prescribed."""
    if method == "Newmark":
        tolerance = max(tolerance, 1e-6)
    problem = driven_slider_crank()
    result = run(problem, 3.0, method=method, rtol=tolerance, atol=tolerance)
    assert result.success, result.message
    assert worst(result.q.T, [problem.motion(t)[0] for t in result.t]) < 1e-9
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


@pytest.mark.parametrize("method", quick(METHODS, 3))
@pytest.mark.parametrize("tolerance", quick([0.3, 0.03, 0.1], 2))
def test_loose_tolerances_on_a_linkage_that_jumped(method, tolerance):
    lengths, ground, theta3, branch = KNOWN[0]
    result = run(four_bar(lengths, ground, theta3, branch), 10.0, method=method, rtol=tolerance, atol=tolerance)
    assert result.success, result.message
    assert same_assembly(lengths, ground, result)


@pytest.mark.parametrize("start", quick(np.linspace(-3.0, 3.0, 13), 4))
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
                result = run(problem, 5.0, method=method, rtol=tolerance, atol=tolerance)
                assert not result.success or same_assembly(lengths, ground, result)


@pytest.mark.parametrize("method", quick(METHODS, 3))
@pytest.mark.parametrize(("seed", "n"), quick([(5, 12), (11, 600)]))
def test_random_linkages_at_loose_tolerances(seed, n, method):
    for lengths, ground, problem in linkages(seed, n):
        for tolerance in (0.03, 0.1, 0.3) if n > 100 else (0.03, 0.3):
            result = run(problem, 5.0, method=method, rtol=tolerance, atol=tolerance)
            assert not result.success or same_assembly(lengths, ground, result), (lengths, ground, tolerance)
