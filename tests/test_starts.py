"""Starts that are a little off: put right wherever there is one assembly, refused where there are two; what is said."""

import itertools
import re

import numpy as np
import pytest

from tests.problems import pendulum, unconstrained
from twoloop import consistent_state, solve_dae
from twoloop.mechanisms import andrews, bricard, four_bar, heavy_top, n_four_bar, spatial_four_bar, spatial_slider_crank

STRETCHED = np.arccos(0.25)  # theta_3 at which bars 1 and 2 of the linkage of 0.8, 1.2, 1 and 2 m are in line
CRANK = 8


def links(t, q, p):
    d = q[2:] - q[:2]
    return 0.5 * np.array([q[0] ** 2 + q[1] ** 2 - p[0] ** 2, d[0] ** 2 + d[1] ** 2 - p[1] ** 2])


POINTS = unconstrained(lambda t, q, v: np.zeros(4), 4, n_c=2, constraint=links, parameters=[1.0, 1.0])


def of_points(lengths, angles):
    """A double pendulum of two points at any angles."""
    steps = (lengths * [np.cos(angles), np.sin(angles)]).T
    return POINTS.with_parameters(lengths), np.concatenate([steps[0], steps[0] + steps[1]])


def off(found, q):
    return float(np.abs(found[0] - q).max())


@pytest.mark.parametrize("disturbed", [1e-8, 1e-6, 1e-4, 1e-3])
def test_double_pendulums_a_little_off(disturbed):
    rng = np.random.default_rng(1)
    for _ in range(15):
        system, q = of_points(rng.uniform(0.3, 2.0, 2), rng.uniform(-np.pi, np.pi, 2))
        found = consistent_state(system, 0.0, q + disturbed * rng.uniform(-1.0, 1.0, 4), np.zeros(4))
        assert off(found, q) < 2.0 * disturbed and np.abs(system.constraint(0.0, found[0])).max() < 1e-14


MECHANISMS = {
    "four-bar": four_bar,
    "andrews": andrews,
    "top": heavy_top,
    "spatial four-bar": spatial_four_bar,
    "spatial slider-crank": spatial_slider_crank,
}


@pytest.mark.parametrize("name", MECHANISMS)
def test_mechanisms_a_little_off(name):
    problem, rng = MECHANISMS[name](), np.random.default_rng(2)
    t = problem.t_span[0]
    for disturbed in (1e-8, 1e-6, 1e-5):
        for _ in range(5):
            size = disturbed * max(float(np.median(np.abs(problem.q0))), 1e-2)
            guess = problem.q0 + size * rng.uniform(-1.0, 1.0, problem.q0.size)
            assert off(consistent_state(problem.system, t, guess, problem.v0), problem.q0) < 1e3 * size


@pytest.mark.parametrize("mechanism", [bricard, lambda: n_four_bar(3)], ids=["bricard", "n_four_bar"])
def test_rounding_that_exceeds_what_counts_as_converged_is_no_failure(mechanism):
    problem = mechanism()
    rng, system = np.random.default_rng(2), problem.system
    for disturbed in (1e-8, 1e-7, 1e-6, 1e-5):
        guess = problem.q0 + disturbed * rng.uniform(-1.0, 1.0, system.n_q)
        assert off(consistent_state(system, 0.0, guess, problem.v0), problem.q0) < 10.0 * disturbed


@pytest.mark.parametrize("beside", [1e-3, 1e-4, 1e-6])
def test_two_assemblies_within_reach_are_refused_unless_one_says_otherwise(beside):
    problems = [four_bar((0.8, 1.2, 1.0), 2.0, theta3=STRETCHED - beside, branch=branch) for branch in (-1, 1)]
    rough = problems[0].q0 + 0.02 * np.array([1.0, -1.0, 0.5, 1.0, 0.3, -1.0, 0.2, 0.4, 0.0])
    rest, system = np.zeros(9), problems[0].system
    assert consistent_state(system, 0.0, problems[0].q0, rest, keep=[CRANK]).margin < 0.1  # known well enough
    words = "does not say on which assembly.*check_assembly=False takes the one" + ".*loses rank" * (beside < 1e-3)
    with pytest.raises(ValueError, match=words):
        consistent_state(system, 0.0, rough, rest, keep=[CRANK])
    found = consistent_state(system, 0.0, rough, rest, keep=[CRANK], check_assembly=False)
    assert min(off(found, problem.q0) for problem in problems) < 1e-6
    # a guess that is much nearer to one than that is to the other says which
    near = problems[0].q0 + 1e-3 * (rough - problems[0].q0) * np.sqrt(beside)
    assert off(consistent_state(system, 0.0, near, rest, keep=[CRANK]), problems[0].q0) < 1e-3


@pytest.mark.parametrize("beside", [1e-2, 1e-5])
def test_messages_have_the_digits_that_show_the_difference(beside):
    """A rod whose end is kept next to the height of the pivot: up or down."""
    height = beside * 0.3
    with pytest.raises(ValueError, match="does not say on which assembly") as caught:
        consistent_state(pendulum(), 0.0, [np.cos(beside), height * 1e-3], [0.0, 0.0], keep=[0])
    pairs = re.findall(r"from (\S+) to ([^\s.,]+(?:\.\d+)?(?:e[-+]\d+)?)", str(caught.value))
    assert len(pairs) == 2
    for one, other in pairs:
        assert float(one) != float(other)


@pytest.mark.parametrize("beside", [0.3, 1e-2, 1e-4, 1e-6])
def test_loss_of_rank_is_said_where_it_is_so(beside):
    problems = [four_bar((0.8, 1.2, 1.0), 2.0, theta3=STRETCHED - beside, branch=branch) for branch in (-1, 1)]
    between = 0.52 * problems[0].q0 + 0.48 * problems[1].q0
    with pytest.raises(ValueError, match="q ") as caught:
        consistent_state(problems[0].system, 0.0, between, np.zeros(9), keep=[CRANK])
    said = re.search(r"nearly loses rank.*smallest singular value is (\S+) of the largest", str(caught.value))
    values = [
        np.linalg.svd(problems[0].system.jacobian(0.0, q)[:, :CRANK], compute_uv=False)
        for q in (between, problems[0].q0, problems[1].q0)
    ]
    least = min(value[-1] / value[0] for value in values)
    assert said is None or (float(said[1]) < 0.01 and least < 0.01)
    if beside <= 1e-6:
        assert said is not None


def test_runs_say_what_was_measured_where_steps_went_across():
    said = []
    for n, method, tolerance in itertools.product((1, 2, 3), ("auto", "DOP853"), (1e-6, 1e-8)):
        problem = n_four_bar(n)  # which runs go across hangs on rounding
        message = solve_dae(problem.system, (0.0, 2.0), problem.q0, problem.v0, method, tolerance, tolerance).message
        for part in re.findall(r"Near t = [^(]*\([^)]*\)", message):
            said.append((float(re.search(r"comes down to (\S+) of the largest", part)[1]), "lose rank" in part))
    assert said
    assert all(ratio <= 0.01 if lost else ratio >= 0.01 for ratio, lost in said), said
