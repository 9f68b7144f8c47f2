"""Runs whose steps stability limits say so; those whose steps accuracy limits do not."""

import re
from math import comb

import numpy as np
import pytest

from tests.problems import event, pendulum
from twoloop import DOP853, Status, mechanisms, solve_dae
from twoloop.kernels.steps import adams_step as kernels
from twoloop.methods import adams

STIFF = "The problem looks stiff"
METHODS = pytest.mark.parametrize("method", ["Adams", "DOP853"])


def run(problem, end, method, tol, **options):
    return solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, method, tol, tol, **options)


@pytest.mark.parametrize(
    ("make", "end", "tol", "method", "what"),
    [
        (mechanisms.moderately_stiff_beam, 0.1, 1e-2, "Adams", "vibrations of 3.*e.04 rad/s"),
        (mechanisms.moderately_stiff_beam, 0.1, 1e-4, "Adams", "vibrations of 3.*e.04 rad/s"),
        (mechanisms.moderately_stiff_beam, 0.3, 1e-2, "DOP853", "vibrations of 3.*e.04 rad/s"),
        (mechanisms.moderately_stiff_beam, 0.3, 1e-2, DOP853("restored"), "vibrations of 3.*e.04 rad/s"),
        (mechanisms.governor, 2.0, 1e-4, "Adams", "a decay of .*e.03 1/s"),
        (mechanisms.governor, 2.0, 1e-4, "DOP853", "a decay of .*e.03 1/s"),
    ],
)
def test_steps_at_the_limit_of_stability_are_said_to_be(make, end, tol, method, what):
    result = run(make(), end, method, tol)
    assert result.success and result.message.count(STIFF) == 1
    assert re.search(what, result.message), result.message
    for name in ("'auto'", "'RadauIIA9'", "'TRBDF2'"):
        assert name in result.message


SMOOTH = [
    (mechanisms.four_bar, 10.0),
    (mechanisms.pendulum, 10.0),
    (mechanisms.double_pendulum, 10.0),
    (lambda: mechanisms.closed_chain(10), 2.0),
    (mechanisms.heavy_top, 2.0),
    (mechanisms.bricard, 10.0),
    (mechanisms.rolling_disc, 5.0),
    (mechanisms.spatial_four_bar, 5.0),
    (mechanisms.spatial_slider_crank, 5.0),
]


@METHODS
@pytest.mark.parametrize("tol", [1e-4, pytest.param(1e-8, marks=pytest.mark.slow), 1e-12])
@pytest.mark.parametrize(("make", "end"), SMOOTH)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_smooth_motion_is_not_called_stiff(make, end, tol, method):
    never = event(lambda t, q, v: 1.0, terminal=True)  # has Python look at a run every 16 attempts
    result = run(make(), end, method, tol, events=never)
    assert result.success and STIFF not in result.message


def test_methods_for_stiff_motion_and_the_default_say_nothing():
    for method in ("auto", "TRBDF2", "RadauIIA5", "Gauss8"):
        assert STIFF not in run(mechanisms.moderately_stiff_beam(), 0.1, method, 1e-3).message


def test_a_run_that_stops_for_its_steps_says_it_too():
    result = run(mechanisms.moderately_stiff_beam(), 1.0, "Adams", 1e-3, max_steps=3000)
    assert result.status is Status.MAX_STEPS
    assert STIFF in result.message and result.message.endswith("See docs/when_it_fails.md#max_steps.")


@METHODS
def test_a_stiff_spring_in_python_is_seen(method, monkeypatch):
    """A point on a circle, tied to its lowest position by a spring of 1e4 rad/s in which next to no motion is.

    What is said is the same on a machine that is too busy for long chunks of steps.
    """
    stiff = pendulum(
        n_q=3,
        mass=np.eye(3),
        force=lambda t, q, v: np.array([0.0, -9.81, -1e8 * (q[2] - np.sin(t)) - np.sin(t)]),
        jacobian=lambda t, q: np.array([[q[0], q[1], 0.0]]),
    )
    start = ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    messages = []
    for allowed in (0.0, np.inf):  # s of a chunk, from which on chunks do not grow
        monkeypatch.setattr("twoloop.run.course.CHUNK_TIME", allowed)
        result = solve_dae(stiff, (0.0, 0.3), *start, method=method, rtol=1e-4, atol=1e-4)
        messages.append(result.message)
    found = re.search(r"vibrations of (\S+) rad/s", result.message)
    assert result.success and found and float(found[1]) == pytest.approx(1e4, rel=0.05) and messages[0] == messages[1]


def test_counts_are_those_of_the_run_alone():
    stats = run(mechanisms.moderately_stiff_beam(), 0.1, "Adams", 1e-3).stats
    assert stats.n_evaluations <= 2 * (stats.n_accepted + stats.n_rejected_error) + stats.n_rejected_convergence + 1


def radius(order, squared, damping):
    """Largest amplification of a step of 1 of Adams' method for q'' = -squared q - damping v, constant steps."""
    nodes, weights = kernels.NODES, kernels.WEIGHTS
    c, g, G = np.ones_like(nodes), [], []
    for i in range(order + 1):
        g.append(weights @ c)
        G.append(kernels.REST @ c)
        c = c * (nodes + i) / (i + 1)
    speed, place = np.array(g), np.array(G)
    backward = np.array([[(-1) ** j * comb(i, j) for j in range(order)] for i in range(order)])
    matrix = []
    for q, v, *a in np.eye(order + 2):
        phi = backward @ a
        q1, v1 = q + v + place[:-1] @ phi, v + speed[:-1] @ phi
        d = -squared * q1 - damping * v1 - phi.sum()
        q1, v1 = q1 + place[-1] * d, v1 + speed[-1] * d
        matrix.append([q1, v1, -squared * q1 - damping * v1, *a[:-1]])
    return np.abs(np.linalg.eigvals(np.array(matrix))).max()


@pytest.mark.parametrize("order", range(1, 13))
def test_limits_of_adams(order):
    vibration, decay = adams.STABLE_TO[order - 1]
    below, above = vibration - 0.02, vibration + 0.02
    assert radius(order, below**2, 0.0) < 1.01 < radius(order, above**2, 0.0)
    if order <= 6:
        assert radius(order, 0.0, decay - 0.02) < 1.01 < radius(order, 0.0, decay + 0.02)
    else:
        assert decay == adams.STABLE_TO[5][1]
