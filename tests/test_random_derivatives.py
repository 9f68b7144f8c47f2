"""Random formulas with exact derivatives, by Taylor arithmetic: all accepted, and nearly all planted errors found."""

from dataclasses import dataclass

import numpy as np
import pytest

from twoloop import ConstrainedSystem
from twoloop.checks.derivatives import check_derivatives, wrong_derivative

TIME = 0.3
TRIALS = 40


@dataclass
class Taylor:
    """A value with its first and second derivative along a line."""

    value: float
    first: float = 0.0
    second: float = 0.0

    def of(self, f, f1, f2):
        return Taylor(f, f1 * self.first, f2 * self.first**2 + f1 * self.second)

    def __add__(self, other):
        return Taylor(self.value + other.value, self.first + other.first, self.second + other.second)

    def __mul__(self, other):
        second = self.value * other.second + 2.0 * self.first * other.first + self.second * other.value
        return Taylor(self.value * other.value, self.value * other.first + self.first * other.value, second)


def sine(x):
    return x.of(np.sin(x.value), np.cos(x.value), -np.sin(x.value))


def bell(x):
    return x.of(np.exp(-(x.value**2)), -2.0 * x.value * np.exp(-(x.value**2)),
                (4.0 * x.value**2 - 2.0) * np.exp(-(x.value**2)))  # fmt: skip


def root(x):
    r = np.sqrt(1e-3 + x.value**2)
    return x.of(r, x.value / r, 1e-3 / r**3)


def formula(rng, n, depth):
    """A random function of (t, q), with factors from 1e-3 to 1e3."""
    factor = Taylor(10.0 ** (rng.uniform(-3.0, 3.0) if rng.random() < 0.3 else rng.uniform(-1.0, 1.0)))
    if depth == 0:
        j, offset = rng.integers(n), Taylor(10.0 ** rng.uniform(-2.0, 3.0) * (rng.random() < 0.2))
        return lambda t, q: factor * (q[j] + offset)
    a, b, kind = formula(rng, n, depth - 1), formula(rng, n, depth - 1), rng.integers(6)
    return (
        lambda t, q: a(t, q) + b(t, q),
        lambda t, q: a(t, q) * b(t, q),
        lambda t, q: sine(a(t, q) + factor * t),
        lambda t, q: sine(factor * a(t, q)) + b(t, q),
        lambda t, q: bell(a(t, q)) + b(t, q),
        lambda t, q: root(a(t, q)),
    )[kind]


def random_system(rng):
    """Functions of a system, and a position."""
    n = int(rng.integers(2, 5))
    rows = [formula(rng, n, 3) for _ in range(int(rng.integers(1, n + 1)))]
    q = 10.0 ** (rng.uniform(-3.0, 3.0, n) if rng.random() < 0.3 else rng.uniform(-1.5, 1.0, n))
    q = q * rng.choice((-1.0, 1.0), n) * (rng.random(n) > 0.1)

    def along(t, q, dt, dq):
        return [row(Taylor(t, dt), [Taylor(x, d) for x, d in zip(q, dq, strict=True)]) for row in rows]

    still = np.zeros(n)
    functions = {
        "constraint": lambda t, q: np.array([x.value for x in along(t, q, 0.0, still)]),
        "jacobian": lambda t, q: np.array([[x.first for x in along(t, q, 0.0, unit)] for unit in np.eye(n)]).T,
        "constraint_rate": lambda t, q: np.array([x.first for x in along(t, q, 1.0, still)]),
        "gamma": lambda t, q, v: -np.array([x.second for x in along(t, q, 1.0, v)]),
    }
    return functions, q


def make(functions, n):
    n_c = len(functions["constraint"](TIME, np.zeros(n)))
    force = lambda t, q, v: np.zeros(n)  # noqa: E731
    return ConstrainedSystem.from_python(n_q=n, n_c=n_c, mass=np.eye(n), force=force, **functions)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_random_systems_are_accepted_and_their_errors_found():
    rng = np.random.default_rng(7)
    planted = found = 0
    for _ in range(TRIALS):
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
    assert planted > TRIALS / 2
    assert found >= 0.9 * planted, f"{found} of {planted}"
