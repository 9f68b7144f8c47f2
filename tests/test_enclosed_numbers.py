"""Compiled functions keep the numbers that they enclose: a change of these is refused, not ignored."""

import math
import types

import numpy as np
import pytest
from numba import njit

from tests.compiled import unit_mass
from twoloop import ConstrainedSystem, Integrator, callback, consistent_state, consistent_states, ensemble, solve_dae

GRAVITY = 9.81
size = 4.0
START = [1.0, 0.0], [0.0, 0.0]
shop = types.ModuleType("shop")
shop.pull = 9.81


@njit
def of_global(t):
    return GRAVITY + 0.0 * t


def system(pull, compile=True, **more):
    """A pendulum with this force along -y."""
    return ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=np.eye(2),
        force=lambda t, q, v: np.array([0.0, -pull(t)]),
        constraint=lambda t, q: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)]),
        compile=compile,
        name="pendulum",
        **more,
    )


def enclosing(how):
    """A system, and what changes the pull of 9.81 that it encloses, and the name."""
    g, table = 9.81, np.array([9.81, 0.0])

    def rebind(value):
        nonlocal g
        g = value

    def rebind_table(value):
        nonlocal table
        table = np.array([value, 0.0])

    def refill(value):
        table[0] = value

    def rebind_global(value):
        globals()["GRAVITY"] = value

    def of_default(t, share=table):
        return share[0] + 0.0 * t

    pulls = {
        "cell": (lambda t: g + 0.0 * t, rebind, "g"),
        "array": (lambda t: table[0] + 0.0 * t, refill, "table"),
        "other array": (lambda t: table[0] + 0.0 * t, rebind_table, "table"),
        "global": (of_global, rebind_global, "GRAVITY"),
        "module": (lambda t: shop.pull + 0.0 * t, lambda value: setattr(shop, "pull", value), "pull"),
        "default": (of_default, refill, "share"),
    }
    pull, change, name = pulls[how]
    return njit(pull) if how != "global" else pull, change, name


@pytest.fixture(autouse=True)
def restored():
    yield
    globals()["GRAVITY"] = shop.pull = 9.81


@pytest.mark.parametrize("how", ["cell", "array", "other array", "global", "module", "default"])
def test_a_changed_number_is_refused_by_its_name_until_it_is_as_it_was(how):
    pull, change, name = enclosing(how)
    pendulum = system(pull)
    before = solve_dae(pendulum, (0.0, 1.0), *START)
    change(4.0)
    with pytest.raises(ValueError, match=rf"force of 'pendulum' was compiled with {name} = .*9\.81.*, which is .*4\."):
        solve_dae(pendulum, (0.0, 1.0), *START)
    change(9.81)
    assert (solve_dae(pendulum, (0.0, 1.0), *START).q == before.q).all()


def test_functions_in_python_see_the_change():
    g = 9.81
    pendulum = system(lambda t: g, compile=False)
    solve_dae(pendulum, (0.0, 1.0), *START)
    g = 4.0
    expected = solve_dae(system(lambda t: 4.0, compile=False), (0.0, 1.0), *START)
    assert (solve_dae(pendulum, (0.0, 1.0), *START).q == expected.q).all()


def test_every_call_that_starts_looks():
    pull, change, _ = enclosing("cell")
    pendulum = system(pull)
    integrator = Integrator(pendulum)
    integrator.start(0.0, *START)
    integrator.step(0.1)
    change(4.0)
    calls = [
        lambda: integrator.step(0.1),
        lambda: integrator.start(0.0, *START),
        lambda: integrator.run((0.0, 1.0), *START),
        lambda: ensemble(pendulum, (0.0, 1.0), *START, t_eval=[1.0]),
        lambda: consistent_state(pendulum, 0.0, *START),
        lambda: consistent_states(pendulum, 0.0, *START),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="was compiled with g"):
            call()


def test_callbacks_are_looked_at_too():
    @callback("force")
    def force(t, q, v, p, Q):
        Q[0] = -of_global(t)

    falling = ConstrainedSystem(n_q=1, n_c=0, mass=unit_mass, force=force)
    assert abs(solve_dae(falling, (0.0, 1.0), [0.0], [0.0]).q[0, -1] + 0.5 * 9.81) < 1e-8
    globals()["GRAVITY"] = 4.0
    with pytest.raises(ValueError, match=r"force of 'system' was compiled with GRAVITY = 9\.81, which is 4\.0 now"):
        solve_dae(falling, (0.0, 1.0), [0.0], [0.0])


def test_nothing_is_looked_at_where_nothing_is_enclosed():
    """Nor is a global that an attribute shares its name with."""
    plain = system(njit(lambda t: np.ones(4).size + 5.81 + 0.0 * t))
    assert plain.enclosed is None
    assert solve_dae(plain, (0.0, 1.0), *START).success


def test_an_equal_number_is_no_change():
    pull, change, _ = enclosing("cell")
    pendulum = system(pull)
    change(np.float64(9.81))
    assert solve_dae(pendulum, (0.0, 1.0), *START).success and not math.isnan(GRAVITY)
