"""Runs whose steps stability limits say so; those whose steps accuracy limits do not."""

import re

import numpy as np
import pytest

from tests.problems import event, pendulum, quick
from twoloop import DOP853, mechanisms, solve_dae

STIFF = "The problem looks stiff"
METHODS = pytest.mark.parametrize("method", ["Adams", "DOP853"])


def run(problem, end, method, tol, **options):
    return solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, method, tol, tol, **options)


@pytest.mark.parametrize(
    ("make", "end", "tol", "method", "what"),
    [
        (mechanisms.moderately_stiff_beam, 0.1, 1e-2, "Adams", "vibrations of 3.*e.04 rad/s"),
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


SMOOTH = [(mechanisms.four_bar, 10.0), (mechanisms.double_pendulum, 10.0), (mechanisms.heavy_top, 2.0)]
SMOOTH += [(lambda: mechanisms.closed_chain(10), 2.0), (mechanisms.bricard, 10.0), (mechanisms.rolling_disc, 5.0)]
SMOOTH += [(mechanisms.spatial_four_bar, 5.0), (mechanisms.spatial_slider_crank, 5.0)]


@METHODS
@pytest.mark.parametrize("tol", quick([1e-4, 1e-8, 1e-12]))
@pytest.mark.parametrize(("make", "end"), quick(SMOOTH, 4))
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_smooth_motion_is_not_called_stiff(make, end, tol, method):
    never = event(lambda t, q, v: 1.0, terminal=True)  # has Python look at a run every 16 attempts
    result = run(make(), end, method, tol, events=never)
    assert result.success and STIFF not in result.message


def test_methods_for_stiff_motion_and_the_default_say_nothing():
    for method in ("auto", "TRBDF2", "RadauIIA5", "Gauss8"):
        assert STIFF not in run(mechanisms.moderately_stiff_beam(), 0.1, method, 1e-3).message


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
