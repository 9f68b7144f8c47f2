"""Mechanisms under the forces of `sharp_forces`: compiled callbacks, and the motion in as few coordinates as it takes.

The equations of the motion share the function of the force with the callbacks, and nothing else. The parameters of a
mechanism come before those of its force. SciPy integrates from one instant at which the force is known to break to the
next, in steps that cannot pass over it. A second, unlike method says how good the motion is; disturbed starts say how
much errors grow.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench.linkages import equations as linkage
from studies.bench.sharp_forces import DRIVE_A, T_END, Sharp, drive, force_along
from studies.bench.store import Array
from twoloop import ConstrainedSystem
from twoloop.bodies import callbacks as model_callbacks
from twoloop.bodies.callbacks import force as model_force
from twoloop.bodies.parameter_layout import HEAD
from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms import four_bar, spatial_slider_crank

GRAVITY = 9.81  # m/s^2

# --- callbacks of a chain of points, p = [n lengths, n masses, ...], that hangs from a pivot driven along x


@callback("mass")
def chain_mass(t, q, p, M):  # type: ignore[no-untyped-def]
    n = q.size // 2
    for i in range(q.size):
        M[i, i] = p[n + i // 2]


@callback("force")
def chain_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    n = q.size // 2
    for k in range(n):
        Q[2 * k + 1] = -GRAVITY * p[n + k]
    Q[2 * n - 2] += force_along(t, q[2 * n - 2], v[2 * n - 2], p)


@callback("constraint")
def chain_constraint(t, q, p, C):  # type: ignore[no-untyped-def]
    for i in range(C.size):
        k, scale = i % (q.size // 2), 1.0 + i // (q.size // 2)  # a further row repeats one
        x = q[2 * k] - (drive(t, p)[0] if k == 0 else q[2 * k - 2])
        y = q[2 * k + 1] - (0.0 if k == 0 else q[2 * k - 1])
        C[i] = 0.5 * (x * x + y * y - p[k] * p[k]) * scale


@callback("jacobian")
def chain_jacobian(t, q, p, Cq):  # type: ignore[no-untyped-def]
    for i in range(Cq.shape[0]):
        k, scale = i % (q.size // 2), 1.0 + i // (q.size // 2)
        x = scale * (q[2 * k] - (drive(t, p)[0] if k == 0 else q[2 * k - 2]))
        y = scale * (q[2 * k + 1] - (0.0 if k == 0 else q[2 * k - 1]))
        Cq[i, 2 * k] = x
        Cq[i, 2 * k + 1] = y
        if k > 0:
            Cq[i, 2 * k - 2] = -x
            Cq[i, 2 * k - 1] = -y


@callback("constraint_rate")
def chain_rate(t, q, p, Ct):  # type: ignore[no-untyped-def]
    f, rate, _ = drive(t, p)
    for i in range(0, Ct.size, q.size // 2):
        Ct[i] = -(1.0 + i // (q.size // 2)) * (q[0] - f) * rate


@callback("gamma")
def chain_gamma(t, q, v, p, Qd):  # type: ignore[no-untyped-def]
    f, rate, second = drive(t, p)
    for i in range(Qd.size):
        k, scale = i % (q.size // 2), 1.0 + i // (q.size // 2)
        x = v[2 * k] - (rate if k == 0 else v[2 * k - 2])
        y = v[2 * k + 1] - (0.0 if k == 0 else v[2 * k - 1])
        Qd[i] = scale * ((q[0] - f) * second * (k == 0) - (x * x + y * y))


# --- of two masses on springs with x1 + x2 = the drive, p = [two stiffnesses, two masses, ...]


@callback("mass")
def row_mass(t, q, p, M):  # type: ignore[no-untyped-def]
    M[0, 0] = p[2]
    M[1, 1] = p[3]


@callback("force")
def row_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    Q[0] = -p[0] * q[0]
    Q[1] = -p[1] * q[1] + force_along(t, q[1], v[1], p)


@callback("constraint")
def row_constraint(t, q, p, C):  # type: ignore[no-untyped-def]
    C[0] = q[0] + q[1] - drive(t, p)[0]


@callback("jacobian")
def row_jacobian(t, q, p, Cq):  # type: ignore[no-untyped-def]
    Cq[0, 0] = 1.0
    Cq[0, 1] = 1.0


@callback("constraint_rate")
def row_rate(t, q, p, Ct):  # type: ignore[no-untyped-def]
    Ct[0] = -drive(t, p)[1]


@callback("gamma")
def row_gamma(t, q, v, p, Qd):  # type: ignore[no-untyped-def]
    Qd[0] = drive(t, p)[2]


# --- of ready mechanisms: a torque on the first bar of the four-bar linkage, a force along the slider in space


@callback("force")
def four_bar_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    for i in range(3):
        Q[3 * i + 1] = -p[i] * GRAVITY
    Q[2] += force_along(t, q[2], v[2], p)


@callback("force")
def slider_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    model_force(t, q, v, p, Q)
    Q[14] += force_along(t, q[14], v[14], p[: p.size - HEAD])


CHAIN: dict[str, Any] = {"mass": chain_mass, "force": chain_force, "constraint": chain_constraint}
CHAIN |= {"jacobian": chain_jacobian, "constraint_rate": chain_rate, "gamma": chain_gamma}
ROW: dict[str, Any] = {"mass": row_mass, "force": row_force, "constraint": row_constraint}
ROW |= {"jacobian": row_jacobian, "constraint_rate": row_rate, "gamma": row_gamma}
TINY = 1e-30  # imaginary step: derivatives without differences


@dataclass(frozen=True)
class Mechanism:
    """A mechanism under a force or a drive, and its equations of motion."""

    name: str
    system: ConstrainedSystem
    # q0, v0: (n_q,)
    q0: Array
    v0: Array
    sharp: Sharp
    y0: Array  # independent coordinates and their rates at the start
    rate: Callable[[float, Array], Array]  # rate(t, y) -> y'
    positions: Callable[[float, Array], Array]  # positions(t, y) -> q (n_q,), NaN where it is not told
    kicked: Callable[[Array, float], Array] = lambda y, jump: y  # kicked(y, jump) -> y after a jump of the drive's rate


def chain_inertia(p: Array, n: int) -> tuple[Array, Array]:
    """Return the masses that each link carries along, times its length, and those times the lengths of the others."""
    carried, places = np.cumsum(p[n : 2 * n][::-1])[::-1], np.arange(n)
    return carried * p[:n], carried[np.maximum(places[:, None], places)] * np.outer(p[:n], p[:n])


def chain_motion(t: float, y: Array, p: Array) -> Array:
    """Return the rates of the angles of a chain and of their rates."""
    (angles, rates), lengths = np.split(y, 2), p[: y.size // 2]
    carried, shared = chain_inertia(p, lengths.size)
    (x, v, second), (s, c), apart = drive(t, p), (np.sin(angles), np.cos(angles)), angles[:, None] - angles
    push = force_along(t, x + lengths @ s, v + lengths @ (c * rates), p)
    forces = (push * lengths - second * carried) * c - GRAVITY * carried * s - shared * np.sin(apart) @ rates**2
    return np.append(rates, np.linalg.solve(shared * np.cos(apart), forces))


def chain(sharp: Sharp, lengths: Array, masses: Array, angles: Array, rates: Array) -> Mechanism:
    """Points on links, by the angles of these from the vertical; the force acts on the last point, along x."""
    n = len(lengths)
    own = sharp.on(float(masses[-1]), 0.0, 1.0, 1.0)
    p = np.concatenate([lengths, masses, own])

    def places(t: float, y: Array) -> Array:
        q = np.empty(2 * n)
        q[::2] = np.cumsum(lengths * np.sin(y[:n])) + drive(t, p)[0]
        q[1::2] = -np.cumsum(lengths * np.cos(y[:n]))
        return q

    def kicked(y: Array, jump: float) -> Array:
        carried, shared = chain_inertia(p, n)
        inertia = shared * np.cos(y[:n, None] - y[:n])
        return np.append(y[:n], y[n:] - jump * np.linalg.solve(inertia, carried * np.cos(y[:n])))

    v0 = np.empty(2 * n)
    v0[::2] = np.cumsum(lengths * np.cos(angles) * rates) + drive(0.0, p)[1]
    v0[1::2] = np.cumsum(lengths * np.sin(angles) * rates)
    about: dict[str, Any] = {"parameters": p, "constant_mass": True, "name": f"chain of {n}"}
    system = ConstrainedSystem(n_q=2 * n, n_c=n, **CHAIN, **about)
    name = "pendulum" if n == 1 else system.name
    start = np.concatenate([angles, rates])
    return Mechanism(
        name, system, places(0.0, start), v0, sharp, start, lambda t, y: chain_motion(t, y, p), places, kicked
    )


def row(sharp: Sharp, stiffness: Array, masses: Array, apart: float, rate0: float) -> Mechanism:
    """Two masses with x1 + x2 given, by d = m1 x1 - m2 x2, which the row cannot move; the force acts on one."""
    own = sharp.on(float(masses[1]), 0.0, 1.0, 1.0)
    p = np.concatenate([stiffness, masses, own])

    def places(d: float, f: float) -> Array:
        return np.array([d + masses[1] * f, masses[0] * f - d]) / masses.sum()

    def rate(t: float, y: Array) -> Array:
        f, moves, _ = drive(t, p)
        x, v = places(y[0], f), places(y[1], moves)
        push = force_along(t, x[1], v[1], p)
        return np.array([y[1], -stiffness[0] * x[0] + stiffness[1] * x[1] - push])

    f, moves, _ = drive(0.0, p)
    system = ConstrainedSystem(n_q=2, n_c=1, **ROW, parameters=p, constant_mass=True, name="driven row")
    y0 = np.array([apart, rate0])
    start = places(apart, f), places(rate0, moves)
    return Mechanism(system.name, system, *start, sharp, y0, rate, lambda t, y: places(y[0], drive(t, p)[0]))


def turning(
    name: str,
    system: ConstrainedSystem,
    start: tuple[Array, Array],
    y0: tuple[float, float],
    sharp: tuple[Sharp, Array],
    energies: Callable[[Any], tuple[Any, Any, Any]],
    positions: Callable[[float, Array], Array],
) -> Mechanism:
    """Return a mechanism with one freedom, the angle s, by Lagrange's equation, under a force of given numbers.

    energies(s) returns inertia, potential and the coordinate along which the force acts, for complex s, too.
    """
    force, p = sharp

    def rate(t: float, y: Array) -> Array:
        inertia, potential, x = energies(complex(y[0], TINY))
        slope = x.imag / TINY
        push = force_along(t, x.real, slope * y[1], p)
        bend = 0.5 * inertia.imag / TINY * y[1] ** 2
        return np.array([y[1], (push * slope - potential.imag / TINY - bend) / inertia.real])

    return Mechanism(name, system, *start, force, np.array(y0), rate, positions)


def under_force(system: ConstrainedSystem, force: Any, parameters: Array, **more: Any) -> ConstrainedSystem:
    """A ready system with another force, and its parameters with those of this."""
    about: dict[str, Any] = {"n_q": system.n_q, "n_c": system.n_c, "name": system.name}
    return ConstrainedSystem(force=force, parameters=parameters, **about, **more)


def bars(sharp: Sharp) -> Mechanism:
    """The four-bar linkage, released, under a torque on its first bar."""
    problem = four_bar()
    q0, v0 = problem.q0, problem.v0
    own = sharp.on(5.0, float(q0[2]), 1.0, 1.0)
    rows = {name: getattr(linkage, name) for name in ("mass", "constraint", "jacobian", "gamma", "kinematics")}
    parameters = np.append(problem.system.parameters, own)
    system = under_force(problem.system, four_bar_force, parameters, constant_mass=True, **rows)
    motion = MinimalFourBar.from_parameters(problem.parameters)

    def rate(t: float, y: Array) -> Array:
        push = force_along(t, y[0], motion.tangent(y)[0] * y[3], system.parameters)
        return motion.rate(t, y, push)

    return Mechanism(
        "four-bar", system, q0, v0, sharp, np.append(q0[2::3], 0.0), rate, lambda t, y: motion.coordinates(y)
    )


def slider_in_space(sharp: Sharp) -> Mechanism:
    """The spatial slider-crank, whose slider moves over 0.1 m at about 0.5 m/s, under a force along the slider."""
    problem = spatial_slider_crank()
    q0, known = problem.q0, problem.parameters
    own = sharp.on(10.0, float(q0[14]), 0.1, 0.5)
    rows = {name: getattr(model_callbacks, name) for name in ("mass", "constraint", "jacobian", "gamma")}
    given = problem.system.parameters
    parameters = np.concatenate([given[:-HEAD], own, given[-HEAD:]])  # a model's parameters end with its head
    system = under_force(problem.system, slider_force, parameters, **rows)
    r, rod, (_, y_A, z_A) = known["crank"], known["rod"], known["A"]
    crank_mass, rod_mass, slider_mass = (known["masses"][name] for name in ("crank", "rod", "slider"))
    J = np.array(known["inertias"]["rod"])
    moments = 0.5 * J.sum() - J  # of mass along the axes of the rod

    def places(s: Any) -> tuple[Any, ...]:
        """The crank's end, x of the slider, the rod's axes, and their derivatives."""
        zero = 0.0 * s
        B = np.array([zero, y_A - r * np.sin(s), z_A + r * np.cos(s)])
        B_s = np.array([zero, -np.cos(s), -np.sin(s)]) * r
        across = np.sqrt(B @ B)
        across_s = (B @ B_s) / across
        x = np.sqrt(rod * rod - across * across)
        x_s = -across * across_s / x
        X, X_s = np.array([x, zero, zero]), np.array([x_s, zero, zero])
        first, first_s = (X - B) / rod, (X_s - B_s) / rod
        second = np.array([zero, -B[2], B[1]]) / across
        second_s = np.array([zero, -B_s[2], B_s[1]]) / across - second * across_s / across
        third_s = np.cross(first_s, second) + np.cross(first, second_s)
        return B, B_s, X, X_s, (first_s, second_s, third_s)

    def energies(s: Any) -> tuple[Any, Any, Any]:
        B, B_s, X, X_s, axes = places(s)
        middle_s = 0.5 * (B_s + X_s)
        inertia = crank_mass * 0.25 * r * r + known["inertias"]["crank"][0] + slider_mass * X_s[0] * X_s[0]
        inertia = inertia + rod_mass * (middle_s @ middle_s)
        inertia = inertia + sum(w * (axis @ axis) for w, axis in zip(moments, axes, strict=True))
        height = crank_mass * 0.5 * r * np.cos(s) + rod_mass * 0.5 * B[2]
        return inertia, GRAVITY * height, X[0]

    def positions(t: float, y: Array) -> Array:
        B, _, X, _, _ = places(y[0])
        q = np.full(system.n_q, np.nan)  # orientations follow from the centres
        q[:3] = 0.0, y_A - 0.5 * r * np.sin(y[0]), z_A + 0.5 * r * np.cos(y[0])
        q[7:10], q[14:17] = 0.5 * (B + X), X
        return q

    rate0 = 6.0  # rad/s, of the benchmark
    return turning("spatial slider-crank", system, (q0, problem.v0), (0.0, rate0), (sharp, own), energies, positions)


TIMES = np.linspace(0.0, T_END, 13)  # s, at which positions are compared
RTOL, CHECK, DISTURBED = 1e-13, 1e-12, 1e-9  # of the motion, of the one to compare it with, and of disturbed ones
LONGEST, LONGEST_IN_X = 0.02, 2e-3  # s, steps; where the force is sharp in x
PARTS = 40  # steps of a window, at least
NUDGE = 1e-6  # of a state, to see how errors grow
FROM = (0, 4, 8)  # places in TIMES at which it is disturbed


@dataclass(frozen=True)
class Motion:
    """Positions at TIMES, how far two methods are apart there, and how much errors grow."""

    q: Array  # (n_times, n_q)
    apart: float
    growth: float  # at least 1: of a disturbance of any independent coordinate or rate, until the end


def march(mechanism: Mechanism, method: str, tolerance: float, y: Array, begin: float = 0.0) -> dict[float, Array]:
    """States at those of TIMES from `begin` on. Raises RuntimeError, ValueError if SciPy's method fails."""
    sharp, at = mechanism.sharp, begin
    states: dict[float, Array] = {}
    edges = {*sharp.breaks, *(edge for window in sharp.windows for edge in window)}
    for end in [*sorted(edge for edge in edges if begin < edge < T_END), T_END]:
        longest = LONGEST_IN_X if sharp.follows_x else LONGEST
        for low, high in sharp.windows:
            if low <= at + 1e-12 and end <= high + 1e-12:
                longest = min(longest, (high - low) / PARTS)
        inside = (at + 1e-13, end - 1e-13)  # the side of a break that is meant

        def rate(t: float, y: Array, inside: tuple[float, float] = inside) -> Array:
            return mechanism.rate(min(max(t, inside[0]), inside[1]), y)

        times = sorted({end, *(t for t in TIMES.tolist() if at <= t <= end)})
        part = solve_ivp(rate, (at, end), y, method, times, rtol=tolerance, atol=tolerance, max_step=longest)
        if not part.success:
            raise RuntimeError(part.message)
        states |= dict(zip(part.t.tolist(), part.y.T, strict=True))
        y, at = part.y[:, -1].copy(), end
        if sharp.driven and end in sharp.breaks:
            y = mechanism.kicked(y, float(sharp.parameters[DRIVE_A]))
    return states


def positions(mechanism: Mechanism, states: dict[float, Array]) -> Array:
    """q at those of TIMES that are known."""
    return np.array([mechanism.positions(t, states[t]) for t in TIMES.tolist() if t in states])


def off(q: Array, known: Array) -> float:
    """The largest difference of coordinates, of those that are known."""
    return float(np.nanmax(np.abs(q - known)))


def motion(mechanism: Mechanism) -> Motion:
    """The motion, how well it is known, and how much errors grow."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        states = march(mechanism, "DOP853", RTOL, mechanism.y0)
        q, growth = positions(mechanism, states), 1.0
        try:
            other = march(mechanism, "LSODA", CHECK, mechanism.y0)
        except (ValueError, RuntimeError):  # it cannot start from rest without any force
            other = march(mechanism, "RK45", 10.0 * CHECK, mechanism.y0)
        apart = off(positions(mechanism, other), q)
        directions = np.random.default_rng(0).standard_normal((len(FROM), mechanism.y0.size))
        for k, direction in zip(FROM, directions, strict=True):
            step = NUDGE * direction / np.abs(direction).max()
            base = mechanism.y0 if k == 0 else states[TIMES[k]]
            moved = positions(mechanism, march(mechanism, "DOP853", DISTURBED, base + step, TIMES[k]))
            growth = max(growth, off(moved, q[k:]) / NUDGE)
    return Motion(q, apart, growth)
