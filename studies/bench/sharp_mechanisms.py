"""Mechanisms under the forces of `sharp_forces`: compiled callbacks, and the motion in as few coordinates as it takes.

The equations of the motion share the function of the force with the callbacks, and nothing else.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench import sharp_callbacks as callbacks
from studies.bench.random_linkages import equations as linkage
from studies.bench.sharp_callbacks import GRAVITY
from studies.bench.sharp_forces import Sharp, drive, force_along
from studies.bench.store import Array
from twoloop import ConstrainedSystem
from twoloop.bodies import callbacks as model_callbacks
from twoloop.bodies.parameter_layout import HEAD
from twoloop.mechanisms import four_bar, spatial_slider_crank

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


@numba.njit(cache=True)
def chain_carried(p, n):  # type: ignore[no-untyped-def]
    """Masses that each link carries along, times its length, and those times the lengths of the others."""
    carried = np.zeros(n)
    for k in range(n):
        for i in range(k + 1):  # loops: numba compiles sums and products of slices for seconds
            carried[i] += p[n + k]
    shared = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            shared[i, j] = carried[max(i, j)] * p[i] * p[j]
    for i in range(n):
        carried[i] *= p[i]
    return carried, shared


@numba.njit(cache=True)
def chain_motion(t, y, p):  # type: ignore[no-untyped-def]
    """Rates of the angles of a chain and of their rates."""
    n = y.size // 2
    th, om = y[:n], y[n:]
    carried, shared = chain_carried(p, n)
    x, v, second = drive(t, p)
    for k in range(n):
        x += p[k] * math.sin(th[k])
        v += p[k] * math.cos(th[k]) * om[k]
    push = force_along(t, x, v, p)
    Q = np.empty(n)
    for i in range(n):
        Q[i] = (push * p[i] - second * carried[i]) * math.cos(th[i]) - GRAVITY * carried[i] * math.sin(th[i])
        for j in range(n):
            Q[i] -= shared[i, j] * math.sin(th[i] - th[j]) * om[j] ** 2
            shared[i, j] *= math.cos(th[i] - th[j])
    accelerations, made = np.linalg.solve(shared, Q), np.empty(2 * n)
    for i in range(n):
        made[i], made[n + i] = om[i], accelerations[i]
    return made


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
        carried, shared = chain_carried(p, n)
        inertia = shared * np.cos(y[:n, None] - y[:n])
        return np.append(y[:n], y[n:] - jump * np.linalg.solve(inertia, carried * np.cos(y[:n])))

    v0 = np.empty(2 * n)
    v0[::2] = np.cumsum(lengths * np.cos(angles) * rates) + drive(0.0, p)[1]
    v0[1::2] = np.cumsum(lengths * np.sin(angles) * rates)
    about: dict[str, Any] = {"parameters": p, "constant_mass": True, "name": f"chain of {n}"}
    system = ConstrainedSystem(n_q=2 * n, n_c=n, **callbacks.CHAIN, **about)
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
    system = ConstrainedSystem(n_q=2, n_c=1, **callbacks.ROW, parameters=p, constant_mass=True, name="driven row")
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
    """A mechanism with one freedom, the angle s, by Lagrange's equation, under a force given with its numbers here.

    energies(s) -> inertia, potential and the coordinate along which the force acts, for complex s, too.
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
    system = under_force(problem.system, callbacks.four_bar_force, parameters, constant_mass=True, **rows)
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
    system = under_force(problem.system, callbacks.slider_force, parameters, **rows)
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
