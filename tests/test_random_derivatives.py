"""Random formulas with exact derivatives, by jets: all accepted, and nearly all planted errors found."""

import numpy as np
import pytest

from tests.mechanisms.motions.jets import Jet, sin, sqrt
from twoloop import ConstrainedSystem
from twoloop.checks.derivatives import check_derivatives, wrong_derivative

TIME = 0.3


def bell(x):
    b = np.exp(-(x.x**2))
    return x.through(b, -2.0 * x.x * b, (4.0 * x.x**2 - 2.0) * b)


def formula(rng, n, depth):
    """A random function of (t, q), with factors from 1e-3 to 1e3."""
    factor = 10.0 ** (rng.uniform(-3.0, 3.0) if rng.random() < 0.3 else rng.uniform(-1.0, 1.0))
    if depth == 0:
        j, offset = rng.integers(n), 10.0 ** rng.uniform(-2.0, 3.0) * (rng.random() < 0.2)
        return lambda t, q: factor * (q[j] + offset)
    a, b, kind = formula(rng, n, depth - 1), formula(rng, n, depth - 1), rng.integers(6)
    return (
        lambda t, q: a(t, q) + b(t, q),
        lambda t, q: a(t, q) * b(t, q),
        lambda t, q: sin(a(t, q) + factor * t),
        lambda t, q: sin(factor * a(t, q)) + b(t, q),
        lambda t, q: bell(a(t, q)) + b(t, q),
        lambda t, q: sqrt(a(t, q) * a(t, q) + 1e-3),
    )[kind]


def random_system(rng):
    """Functions of a system, and a position."""
    n = int(rng.integers(2, 5))
    rows = [formula(rng, n, 3) for _ in range(int(rng.integers(1, n + 1)))]
    q = 10.0 ** (rng.uniform(-3.0, 3.0, n) if rng.random() < 0.3 else rng.uniform(-1.5, 1.0, n))
    q = q * rng.choice((-1.0, 1.0), n) * (rng.random(n) > 0.1)

    def along(t, q, dt, dq):
        return [row(Jet(t, dt), [Jet(x, d) for x, d in zip(q, dq, strict=True)]) for row in rows]

    still = np.zeros(n)
    functions = {
        "constraint": lambda t, q: np.array([x.x for x in along(t, q, 0.0, still)]),
        "jacobian": lambda t, q: np.array([[x.u for x in along(t, q, 0.0, unit)] for unit in np.eye(n)]).T,
        "constraint_rate": lambda t, q: np.array([x.u for x in along(t, q, 1.0, still)]),
        "gamma": lambda t, q, v: -np.array([x.w for x in along(t, q, 1.0, v)]),
    }
    return functions, q


def make(functions, n):
    n_c = len(functions["constraint"](TIME, np.zeros(n)))
    force = lambda t, q, v: np.zeros(n)  # noqa: E731
    return ConstrainedSystem.from_python(n_q=n, n_c=n_c, mass=np.eye(n), force=force, **functions)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("trials", [20, pytest.param(200, marks=pytest.mark.slow)])
def test_random_systems_are_accepted_and_their_errors_found(trials):
    rng = np.random.default_rng(7)
    planted = found = 0
    for _ in range(trials):
        functions, q = random_system(rng)
        system = make(functions, len(q))
        check_derivatives(system, TIME, q)
        assert wrong_derivative(system, TIME, q, np.ones(len(q))) is None
        kind = rng.choice(["jacobian", "constraint_rate", "gamma"])
        right = functions[kind]
        value = right(TIME, q) if kind != "gamma" else right(TIME, q, np.linspace(1.0, 1.4, len(q)))
        entries = list(zip(*np.nonzero(np.abs(value) > 1e-6 * np.abs(value).max()), strict=True))
        if not entries:
            continue
        entry = entries[rng.integers(len(entries))]

        def wrong(*arguments, right=right, entry=entry):
            changed = right(*arguments)
            changed[entry] *= 1.001
            return changed

        planted += 1
        try:
            check_derivatives(make({**functions, kind: wrong}, len(q)), TIME, q)
        except ValueError as error:
            found += str(error).startswith(kind)
    assert planted > trials / 2
    assert found >= 0.9 * planted, f"{found} of {planted}"
