"""Large systems of a user's functions: matrices dense or by the values of their entries."""

import numpy as np
import pytest

from tests.large_systems import started_run
from tests.problems import worst
from twoloop import ConstrainedSystem, solve_dae


def masses_on_rods(n, dense, varying):
    """A chain of point masses in plain functions, its matrices dense or by values; masses that vary by a millionth."""
    rows = np.repeat(np.arange(n), [2] + [4] * (n - 1))
    columns = np.concatenate([[0, 1]] + [[2 * k - 2, 2 * k - 1, 2 * k, 2 * k + 1] for k in range(1, n)])

    def differences(q):
        return np.diff(np.vstack([np.zeros((1, 2)), q.reshape(n, 2)]), axis=0)

    def values(t, q):
        d = differences(q)
        return np.concatenate([d[0], np.hstack([-d[1:], d[1:]]).ravel()])

    def matrix(t, q):
        made = np.zeros((n, 2 * n))
        made[rows, columns] = values(t, q)
        return made

    def masses(t, q):
        return 1.0 + 1e-6 * np.sin(q)

    options = {"jacobian": matrix} if dense else {"jacobian_values": values, "jacobian_entries": (rows, columns)}
    both = np.arange(2 * n)
    if dense:
        options["mass"] = (lambda t, q: np.diag(masses(t, q))) if varying else np.eye(2 * n)
    else:
        options |= {"mass_values": masses if varying else np.ones(2 * n), "mass_entries": (both, both)}
    system = ConstrainedSystem.from_python(
        n_q=2 * n,
        n_c=n,
        force=lambda t, q, v: np.tile([0.0, -9.81], n),
        constraint=lambda t, q: 0.5 * ((differences(q) ** 2).sum(axis=1) - 1.0 / n**2),
        gamma=lambda t, q, v: -(differences(v) ** 2).sum(axis=1),
        name="masses on rods",
        **options,
    )
    angles = np.linspace(0.1, 1.3, n)
    return system, np.cumsum(np.column_stack([np.cos(angles), np.sin(angles)]) / n, axis=0).ravel()


@pytest.mark.parametrize("varying", [False, True])
def test_plain_functions_dense_or_by_values(large, varying):
    found = []
    for dense, least in ((True, 10**9), (True, 0), (False, 0)):
        large(least)
        system, q = masses_on_rods(30, dense, varying)
        assert (started_run(system, q).static is not None) == (least == 0)
        found.append(solve_dae(system, (0.0, 0.02), q, 0.0 * q, "DOP853", 1e-8, 1e-8))
    assert all(result.success for result in found) and worst(found[0].q[:, -1], found[1].q[:, -1]) < 1e-12
    assert worst(found[0].q[:, -1], found[2].q[:, -1]) < 1e-12


def test_an_entry_that_comes_up_on_the_way_ends_the_static_form(both):
    """Coordinates that are held, the first of which comes to lean on another where the second is beyond 0.5."""
    n = 12

    def beyond(x, order=0):
        return [1.0, 4.0, 12.0][order] * max(0.0, x - 0.5) ** (4 - order)

    def jacobian(t, q):
        made = np.eye(n, 2 * n)
        made[0, 1], made[0, n] = beyond(q[1], 1) * q[n], beyond(q[1])
        return made

    def gamma(t, q, v):
        return -np.eye(n)[0] * (beyond(q[1], 2) * q[n] * v[1] ** 2 + 2.0 * beyond(q[1], 1) * v[1] * v[n])

    system = ConstrainedSystem.from_python(
        n_q=2 * n,
        n_c=n,
        mass=np.eye(2 * n),
        force=lambda t, q, v: np.ones(2 * n),
        constraint=lambda t, q: q[:n] + np.eye(n)[0] * beyond(q[1]) * q[n] - np.eye(n)[1] * t,
        constraint_rate=lambda t, q: -np.eye(n)[1],
        jacobian=jacobian,
        gamma=gamma,
    )
    start = (0.0, 1.2), np.zeros(2 * n), np.eye(2 * n)[1]
    one, other = both(lambda: solve_dae(system, *start, "DOP853", time_limit=20.0))
    assert one.success and other.success and abs(one.q[0, -1]) > 0.05 and worst(one.q[:, -1], other.q[:, -1]) < 1e-9


def test_stiff_motion_goes_on_by_newton(both):
    """By sparse or dense matrices: both ways lead to the same end."""
    n = 12

    def run():
        system, q = masses_on_rods(n, True, False)
        functions = dict(system.python_functions)
        functions["force"] = lambda t, q, v: np.tile([0.0, -9.81], n) - 3e3 * v
        stiff = ConstrainedSystem.from_python(n_q=2 * n, n_c=n, **functions | {"mass": np.eye(2 * n)})
        return solve_dae(stiff, (0.0, 2.0), q, 0.0 * q, "auto", 1e-4, 1e-4)

    one, other = both(run)
    assert all(each.success and each.stats.n_jacobians > 0 for each in (one, other))
    assert worst(one.q[:, -1], other.q[:, -1]) < 1e-3
