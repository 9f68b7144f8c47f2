"""Small problems with references that share nothing with the integrator."""

from dataclasses import fields
from functools import cache

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp
from scipy.special import ellipj

from tests.compiled import PENDULUM
from twoloop import ConstrainedSystem, Result, solve_dae
from twoloop.kernels.compile.caches import compile_cached, compiled_when_called
from twoloop.kernels.compile.linking import KernelCompiler
from twoloop.kernels.data.common import OPTIONS, source_digest
from twoloop.kernels.data.indices import FORCE_BY_Q_GIVEN
from twoloop.mechanisms import Problem, four_bar

G = 9.81
TIGHT = {"rtol": 1e-13, "atol": 1e-14, "max_step": 0.01, "dense_output": True}


def worst(a, b):
    return float(np.abs(np.asarray(a) - np.asarray(b)).max(initial=0.0))


def some_of(one, other, each=3):
    """Pair each of `one` with a few of `other`, evenly spread."""
    n = len(other)
    return [(a, other[(i + k * n // each) % n]) for i, a in enumerate(one) for k in range(each)]


def quick(cases, n=1):
    """Mark all cases but the first n as slow: `make test` leaves them out."""
    rest = [each if isinstance(each, tuple) else (each,) for each in list(cases)[n:]]
    return [*list(cases)[:n], *(pytest.param(*each, marks=pytest.mark.slow) for each in rest)]


def without_tangent(problem):
    """The problem, its system made to difference the force."""
    problem.system.functions.flags[FORCE_BY_Q_GIVEN] = 0
    return problem


def slope(f, e=1e-3):
    """df(s)/ds at s = 0, central differences of order 6."""
    return (45.0 * (f(e) - f(-e)) - 9.0 * (f(2 * e) - f(-2 * e)) + f(3 * e) - f(-3 * e)) / (60.0 * e)


def row_errors(system, t, q, v):
    """Largest errors of C_q v, of C_t, and of Q_d and Q_a, against differences along q + s v."""
    by_q = slope(lambda s: system.constraint(t, q + s * v))
    by_t = slope(lambda s: system.constraint(t + s, q))
    bend = slope(lambda s: system.velocity_constraint(t + s, q + s * v, v))
    kinds = [kind for kind, n in (("gamma", system.n_c), ("nonholonomic_gamma", system.n_a)) if n]
    right = np.concatenate([np.zeros(0), *(system.evaluate(kind, t, q, v) for kind in kinds)])
    return worst(system.jacobian(t, q) @ v, by_q), worst(system.constraint_rate(t, q), by_t), worst(right, -bend)


def functions_of(system):
    """The callbacks of a system as functions that return arrays."""
    return {kind: getattr(system, kind) for kind in system.given if kind != "kinematics"}


def unconstrained(force, n_q=1, **more):
    """q'' = force(t, q, v): no rows, and unit masses unless others are given."""
    return ConstrainedSystem.from_python(**{"n_q": n_q, "n_c": 0, "mass": np.eye(n_q), "force": force, **more})


# --- pendulum: unit mass on a unit rod, Cartesian coordinates, closed form by elliptic functions
PLAIN = {
    "n_q": 2,
    "n_c": 1,
    "mass": lambda t, q: np.eye(2),
    "force": lambda t, q, v: np.array([0.0, -9.81]),
    "constraint": lambda t, q: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)]),
    "jacobian": lambda t, q: q.reshape((1, 2)),
}


def pendulum(*, compile=False, gamma=True, constant_mass=False, **changed):
    """The pendulum, with other functions in place of its own; gamma=False: by differences."""
    right_side = lambda t, q, v: np.array([-(v[0] * v[0] + v[1] * v[1])])  # noqa: E731
    functions = PLAIN | ({"mass": np.eye(2)} if constant_mass else {})
    functions |= {"gamma": gamma if callable(gamma) else right_side if gamma else None, "name": "pendulum"}
    return ConstrainedSystem.from_python(compile=compile, **functions | changed)


def held_twice(factor=1.0, **more):
    """The pendulum with its row once more, multiplied by a factor."""
    scale = np.array([1.0, factor])
    functions = {
        "constraint": lambda t, q: scale * 0.5 * (q @ q - 1.0),
        "jacobian": lambda t, q: np.outer(scale, q),
        "gamma": lambda t, q, v: -scale * (v @ v),
    }
    return pendulum(**{"n_c": 2, "constant_mass": True, **functions, **more})


def driven_cart(place, speed, **more):
    """A cart that a drive puts at place(t), x, and a bob of 1 kg on a rod of 1 m below it, x and y."""
    functions = {
        "constraint": lambda t, q: np.array([q[0] - place(t), 0.5 * ((q[1] - q[0]) ** 2 + q[2] ** 2 - 1.0)]),
        "constraint_rate": lambda t, q: np.array([-speed(t), 0.0]),
        "force": lambda t, q, v: np.array([0.0, 0.0, -G]),
    }
    return ConstrainedSystem.from_python(**{"n_q": 3, "n_c": 2, "mass": np.eye(3), **functions, **more})


@cache
def entry(helper):
    """A helper of the kernels, which has no entry from Python, as a function of Python's; its machine code is kept."""

    @compiled_when_called(pipeline_class=KernelCompiler, **OPTIONS)
    def call(arguments):
        return helper(*arguments)

    return lambda *arguments: call(arguments)


def called(helper, *arguments):
    """Call a helper of the kernels once."""
    return entry(helper)(*arguments)


def kept(signature):
    """Compile a function that calls helpers of an evaluation, and keep it until a file changes that these need."""
    watched = (source_digest("evaluation.calls"), "")
    return lambda function: compile_cached(function, signature, watched, pipeline_class=KernelCompiler, **OPTIONS)


def pendulum_state(t, angle=-0.5 * np.pi):
    """q, v, lam at t of the pendulum released from rest at `angle` from the downward vertical."""
    k, w = np.sin(0.5 * angle), np.sqrt(G)
    sn, cn, dn, _ = ellipj(w * np.asarray(t, dtype=float), k * k)
    theta = 2.0 * np.arcsin(k * cn / dn)
    rate = -2.0 * k * w * np.sqrt(1.0 - k * k) * sn / dn
    q = np.array([np.sin(theta), -np.cos(theta)])
    return q, (rate * np.array([np.cos(theta), np.sin(theta)])), rate**2 - G * q[1]


def pendulum_energy(q, v):
    return 0.5 * (v * v).sum(axis=0) + G * q[1]


def pendulum_problem(t_end, **options):
    q, v, _ = pendulum_state(0.0)
    return Problem("pendulum", pendulum(**options), q, v, (0.0, t_end), lambda t, q, v: pendulum_energy(q, v))


# --- rheonomic: the same pendulum under a pivot that moves both ways, so that C_t and C_tt are not zero
def _pivot(t):
    p = np.array([0.3 * np.sin(3.0 * t), 0.1 * np.cos(5.0 * t)])
    rate = np.array([0.9 * np.cos(3.0 * t), -0.5 * np.sin(5.0 * t)])
    return p, rate, np.array([-2.7 * np.sin(3.0 * t), -2.5 * np.cos(5.0 * t)])


def moving_pivot(*, compile=False, gamma=True):
    pivot = njit(_pivot) if compile else _pivot

    def constraint(t, q):
        d = q - pivot(t)[0]
        return np.array([0.5 * (d[0] * d[0] + d[1] * d[1] - 1.0)])

    jacobian = lambda t, q: (q - pivot(t)[0]).reshape((1, 2))  # noqa: E731

    def constraint_rate(t, q):
        p, rate, _ = pivot(t)
        d = q - p
        return np.array([-(d[0] * rate[0] + d[1] * rate[1])])

    def right_side(t, q, v):
        p, rate, acceleration = pivot(t)
        d, u = q - p, v - rate
        return np.array([d[0] * acceleration[0] + d[1] * acceleration[1] - u[0] * u[0] - u[1] * u[1]])

    functions = {"constraint": constraint, "jacobian": jacobian, "constraint_rate": constraint_rate}
    return pendulum(compile=compile, gamma=right_side if gamma else False, **functions, name="moving pivot")


MOVING_PIVOT_START = (1.0, 0.5)  # angle from the downward vertical and its rate


@cache
def _moving_pivot_solution(start, end):
    def rate(t, y):
        _, _, a = _pivot(t)
        return [y[1], -(G + a[1]) * np.sin(y[0]) - a[0] * np.cos(y[0])]

    return solve_ivp(rate, (0.0, end), start, "DOP853", **TIGHT).sol


def moving_pivot_state(t, start=MOVING_PIVOT_START, end=10.0):
    """q, v at t, by Lagrange's equation for the angle."""
    t = np.asarray(t, dtype=float)
    theta, rate = _moving_pivot_solution(start, end)(t)
    p, u, _ = _pivot(t)
    return p + np.array([np.sin(theta), -np.cos(theta)]), u + rate * np.array([np.cos(theta), np.sin(theta)])


# --- double pendulum: two unit masses on two unit rods, Cartesian coordinates; two degrees of freedom
def double_pendulum():
    def right_side(t, q, v):
        d = v[2:] - v[:2]
        return np.array([-(v[0] * v[0] + v[1] * v[1]), -(d[0] * d[0] + d[1] * d[1])])

    def jacobian(t, q):
        d0, d1 = q[2] - q[0], q[3] - q[1]
        return np.array([[q[0], q[1], 0.0, 0.0], [-d0, -d1, d0, d1]])

    def constraint(t, q):
        d0, d1 = q[2] - q[0], q[3] - q[1]
        return 0.5 * np.array([q[0] * q[0] + q[1] * q[1] - 1.0, d0 * d0 + d1 * d1 - 1.0])

    functions = {"constraint": constraint, "jacobian": jacobian, "gamma": right_side}
    weights = lambda t, q, v: np.array([0.0, -9.81, 0.0, -9.81])  # noqa: E731
    return unconstrained(weights, 4, n_c=2, **functions, compile=True, name="double pendulum")


def double_pendulum_state(angles, rates):
    """q, v from the angles to the downward vertical and their rates (2,)."""
    x = np.array([np.sin(angles), -np.cos(angles)])
    u = np.array([np.cos(angles), np.sin(angles)]) * rates
    return np.concatenate([x[:, 0], x.sum(axis=1)]), np.concatenate([u[:, 0], u.sum(axis=1)])


# --- oblique polar coordinates: x = r(cos phi, sin phi), r = q0, phi = q1 + 0.3 q0; a damped pendulum whose pivot is
# not the origin. M(t, q) is full and varies, forces depend on velocities; a mass factor m(t) scales M, Q and lam alike

PIVOT, DAMPING = np.array([0.5, 0.0]), 0.2
OBLIQUE_START = (1.2, -0.5)


def _point(q):
    phi = q[1] + 0.3 * q[0]
    return q[0] * np.array([np.cos(phi), np.sin(phi)])


def _point_jacobian(q):
    phi = q[1] + 0.3 * q[0]
    radial = np.array([np.cos(phi), np.sin(phi)])
    across = q[0] * np.array([-np.sin(phi), np.cos(phi)])
    return np.array([radial + 0.3 * across, across]).T


def _point_bias(q, v):
    """What remains of the acceleration of the point when q'' = 0."""
    phi, rate = q[1] + 0.3 * q[0], v[1] + 0.3 * v[0]
    along, across = np.array([np.cos(phi), np.sin(phi)]), np.array([-np.sin(phi), np.cos(phi)])
    return 2.0 * v[0] * rate * across - q[0] * rate**2 * along


def mass_factor(t):
    return 2.0 + np.sin(t)


def oblique_pendulum():
    def force(t, q, v):
        J = _point_jacobian(q)
        return mass_factor(t) * J.T @ (np.array([0.0, -G]) - DAMPING * (J @ v) - _point_bias(q, v))

    def right_side(t, q, v):
        u = _point_jacobian(q) @ v
        return np.array([-(u @ u) - (_point(q) - PIVOT) @ _point_bias(q, v)])

    return pendulum(
        mass=lambda t, q: mass_factor(t) * _point_jacobian(q).T @ _point_jacobian(q),
        force=force,
        constraint=lambda t, q: np.array([0.5 * ((_point(q) - PIVOT) @ (_point(q) - PIVOT) - 1.0)]),
        jacobian=lambda t, q: ((_point(q) - PIVOT) @ _point_jacobian(q))[None, :],
        gamma=right_side,
        name="oblique pendulum",
    )


@cache
def _oblique_solution(end):
    def rate(t, y):
        return [y[1], -G * np.sin(y[0]) - DAMPING * y[1]]

    return solve_ivp(rate, (0.0, end), OBLIQUE_START, "DOP853", **TIGHT).sol


def oblique_point(t, end=5.0):
    """Cartesian position, velocity and multiplier at t, by the equation for the angle at the pivot."""
    t = np.asarray(t, dtype=float)
    theta, rate = _oblique_solution(end)(t)
    x = PIVOT.reshape(2, *(1,) * t.ndim) + np.array([np.sin(theta), -np.cos(theta)])
    lam = mass_factor(t) * (rate**2 + G * np.cos(theta))
    return x, rate * np.array([np.cos(theta), np.sin(theta)]), lam


def oblique_start():
    x, u, _ = oblique_point(0.0)
    r = np.hypot(*x)
    q = np.array([r, np.arctan2(x[1], x[0]) - 0.3 * r])
    return q, np.linalg.solve(_point_jacobian(q), u)


def oblique_to_point(result):
    """Cartesian positions and velocities of a result in oblique coordinates."""
    columns = range(result.t.size)
    x = np.array([_point(result.q[:, k]) for k in columns]).T
    u = np.array([_point_jacobian(result.q[:, k]) @ result.v[:, k] for k in columns]).T
    return x, u


# --- the four-bar linkage: the default one, and one whose bars 1 and 2 come into line, where theta_3 alone does not
# determine the rest

LINKAGES = {"default": four_bar(), "collinear": four_bar(lengths=(0.8, 1.2, 1.0), ground=2.0)}


def violations(system, result):
    """Largest violation of the position and of the velocity constraints over all stored states."""
    states = list(zip(result.t, result.q.T, result.v.T, strict=True))
    position = max(np.abs(system.constraint(t, q)).max() for t, q, _ in states)
    return float(position), float(max(np.abs(system.velocity_constraint(*state)).max() for state in states))


def force_residual(system, result):
    """Largest |M a + C_q^T lam + A^T mu - Q| over all stored states."""
    largest = 0.0
    for t, q, v, a, lam in zip(result.t, result.q.T, result.v.T, result.a.T, result.lam.T, strict=True):
        residual = system.mass(t, q) @ a + system.rows(t, q).T @ lam - system.force(t, q, v)
        largest = max(largest, np.abs(residual).max())
    return float(largest)


def assert_same(one, other):
    """All that two results hold is equal to the bit, but for the CPU time and the system."""
    for name in [each.name for each in fields(Result) if each.name not in ("stats", "system", "sol")]:
        a, b = getattr(one, name), getattr(other, name)
        assert np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b, name
        assert type(a) is type(b), name
    counted = [{k: v for k, v in vars(each.stats).items() if k != "cpu_time"} for each in (one, other)]
    assert counted[0] == counted[1] and one.stats.cpu_time > 0.0
    assert vars(one).keys() ^ vars(other).keys() <= {"later"} and (one.sol is None) == (other.sol is None)
    if one.sol is not None:
        times = np.random.default_rng(2).uniform(one.sol.t_min, one.sol.t_max, 9)
        assert (one.sol.t_min, one.sol.t_max) == (other.sol.t_min, other.sol.t_max)
        for kind in ("q", "v", "a", "lam"):
            assert np.array_equal(getattr(one.sol(times), kind), getattr(other.sol(times), kind)), kind


def event(function, terminal=None, direction=None):
    """An event function with attributes."""
    if terminal is not None:
        function.terminal = terminal
    if direction is not None:
        function.direction = direction
    return function


def at_one(terminal=None):
    """theta_3 = 1 of the four-bar linkage."""
    return event(lambda t, q, v: q[8] - 1.0, terminal)


# --- runs that end: one that crawls is to fail, not to hang
START = ([-1.0, 0.0], [0.0, 0.0])
SWING = ConstrainedSystem(**PENDULUM)


def swing(end=2.0, system=SWING, **options):
    """The pendulum from the horizontal, of compiled functions unless another is given."""
    options.setdefault("max_steps", 200_000)
    return solve_dae(system, (0.0, end), *START, **options)


def run(problem, end=10.0, **options):
    options.setdefault("max_steps", 200_000)
    return solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, **options)
