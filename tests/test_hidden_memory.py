"""Forces in Python that depend on more than t, q and v: named at the start, or at the end of the run."""

import numpy as np
import pytest

from tests import problems
from twoloop import Status, solve_dae

START = np.array([0.6, -0.8]), np.array([0.4, 0.3])


def pendulum(along_x):
    return problems.pendulum(force=lambda t, q, v: np.array([along_x(t, q, v), -9.81]), gamma=False, constant_mass=True)


def noise():
    random = np.random.default_rng(1)
    return lambda t, q, v: 1e-3 * random.normal()


def sampled_controller():
    held = {"next": 0.0, "value": 0.0}

    def force(t, q, v):
        if t >= held["next"]:
            held["value"], held["next"] = -3.0 * v[0], held["next"] + 0.01
        return held["value"]

    return force


def relay():
    held = [0.0]

    def force(t, q, v):
        if abs(v[0]) > 0.5:
            held[0] = np.sign(v[0])
        return -3.0 * held[0]

    return force


def integral():
    held = {"t": 0.0, "sum": 0.0}

    def force(t, q, v):
        held["sum"] += q[0] * (t - held["t"])
        held["t"] = t
        return -2.0 * held["sum"]

    return force


def delayed():
    before = []

    def force(t, q, v):
        while before and before[-1][0] >= t:
            before.pop()
        before.append((t, v[0]))
        return -2.0 * np.interp(t - 0.2, *zip(*before, strict=True))

    return force


@pytest.mark.parametrize("method", ["auto", "RadauIIA9"])
@pytest.mark.parametrize("make", [noise, sampled_controller, relay, integral])
def test_memory_is_named_at_the_start(make, method):
    with pytest.raises(ValueError, match="force of 'pendulum' gives something else when it is called again"):
        solve_dae(pendulum(make()), (0.0, 1.0), *START, method)


def test_memory_that_shows_along_the_motion_is_named_at_its_end():
    result = solve_dae(pendulum(delayed()), (0.0, 1.0), *START, "DOP853")
    assert result.status is Status.WRONG_TRACE and "when it is called again" in result.message


def test_what_is_kept_for_speed_or_to_be_looked_at_is_no_memory():
    known, log, guess = {}, [], [0.0]

    def kept(t, q, v):
        log.append((t, q, v))
        return known.setdefault((t, *q, *v), -2.0 * v[0])

    def warm_start(t, q, v):
        x = guess[0]
        for _ in range(60):
            x -= (x + 0.5 * np.sin(x) - v[0]) / (1.0 + 0.5 * np.cos(x))
        guess[0] = x
        return -2.0 * x

    for force in (kept, warm_start):
        assert solve_dae(pendulum(force), (0.0, 1.0), *START).success


def test_noise_goes_with_steps_of_a_constant_size():
    assert solve_dae(pendulum(noise()), (0.0, 0.1), *START, "DOP853", step_size=0.01).success


def test_durations_are_no_forces():
    with pytest.raises(TypeError, match="must return a real array"):
        solve_dae(pendulum(lambda t, q, v: np.timedelta64(1, "s")), (0.0, 1.0), *START)
