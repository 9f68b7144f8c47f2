"""Is what a system says about itself true? C_q, C_t, Q_d and tangents against differences, constant M, bandwidth.

A wrong sign in one of them often runs to the end and looks like a motion. Each system is looked at once.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.common import FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN, GAMMA_GIVEN, REACTION_BY_Q_GIVEN
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

DISPLACEMENTS = (1e-4, 1e-6, 1e-8)  # of the largest coordinate, and s; one of them has to agree
AGREEMENT = 1e-3  # relative to the largest entry of the row
ROUNDING = 1e-12  # of a difference, relative to |C_q| times the largest coordinate over the displacement


def check_derivatives(system: ConstrainedSystem, t: float, q: Array) -> None:
    """Compare the callbacks of a system with one another near (t, q), at velocities that stand for any.

    Raises
    ------
    ValueError
        Naming the callback, the entry, the value given and the one differenced.
    """
    if system.checked:
        return
    size = float(np.abs(q).max()) or 1.0
    generic = np.random.default_rng(1)
    v = size * generic.uniform(0.5, 1.5, system.n_q) * generic.choice((-1.0, 1.0), system.n_q)
    jacobian = system.jacobian(t, q)
    level = ROUNDING * max(float(np.abs(jacobian).max()), 1e-300) * size

    def in_q(e: float) -> Array:
        return _by_columns(lambda shift: system.constraint(t, q + shift), system.n_q, e * size)

    # times only forward: nobody promised that the callbacks work before the start
    def in_t(e: float) -> Array:
        return _forward([system.constraint(t + k * e, q) for k in range(3)], e)

    def along(e: float) -> Array:
        return -_forward([system.velocity_constraint(t + k * e, q + k * e * v, v) for k in range(3)], e)

    _compare(system, "jacobian", t, jacobian, in_q, level / size)
    _compare(system, "constraint_rate", t, system.constraint_rate(t, q), in_t, level)
    if system.functions.flags[GAMMA_GIVEN] == 1:
        _compare(system, "gamma", t, system.gamma(t, q, v), along, level)
    _check_tangents(system, t, q, v, size)
    if system.constant_mass:
        there = system.mass(t + 1.0, q + 0.1 * v)
        if np.isfinite(there).all() and np.abs(there - system.mass(t, q)).max() > 1e-10 * np.abs(there).max():
            raise ValueError(f"mass of {system.name!r} is said to be constant (constant_mass=True) and is not")
    if system.bandwidth is not None:
        _check_bandwidth(system, system.bandwidth, t, q + 1e-3 * v, v, 1e-3 * size)
    system.checked = True


def _check_tangents(system: ConstrainedSystem, t: float, q: Array, v: Array, size: float) -> None:
    """Compare those that are given, a little off the start, where symmetry may hide a term."""
    n = system.n_q
    if system.functions.flags[FORCE_BY_Q_GIVEN] == 0:
        return
    try:
        force = system.force(t, q + 1e-3 * v, v)
        q = q + 1e-3 * v
    except (ArithmeticError, ValueError):  # as in _compare
        force = system.force(t, q, 0.0 * v)

    def force_in_q(e: float) -> Array:
        return _by_columns(lambda shift: system.force(t, q + shift, v), n, e * size)

    def force_in_v(e: float) -> Array:
        return _by_columns(lambda shift: system.force(t, q, v + shift), n, e * size)

    level = ROUNDING * max(float(np.abs(force).max()), 1e-300) / size
    _compare(system, "force_by_q", t, system.force_by_q(t, q, v), force_in_q, level)
    _compare(system, "force_by_v", t, system.force_by_v(t, q, v), force_in_v, level)
    if system.functions.flags[REACTION_BY_Q_GIVEN] == 0:
        return
    lam = np.linspace(1.0, 2.0, system.n_c)

    def reaction_in_q(e: float) -> Array:
        return _by_columns(lambda shift: lam @ system.jacobian(t, q + shift), n, e * size)

    level = ROUNDING * max(float(np.abs(lam @ system.jacobian(t, q)).max()), 1e-300) / size
    _compare(system, "reaction_by_q", t, system.reaction_by_q(t, q, lam), reaction_in_q, level)


def _by_columns(function: Callable[[Array], Array], n: int, shift: float) -> Array:
    """Central differences of a vector, a column for each displaced coordinate."""
    shifts = shift * np.eye(n)
    return np.column_stack([(function(each) - function(-each)) / (2.0 * shift) for each in shifts])


def _check_bandwidth(system: ConstrainedSystem, bandwidth: int, t: float, q: Array, v: Array, shift: float) -> None:
    """Displace one coordinate or velocity after another: what lies farther away than the bandwidth may not answer."""
    places = np.arange(system.n_q)
    farthest, where = bandwidth, ""

    def look(what: str, j: int, column: Array, level: float) -> None:
        nonlocal farthest, where
        distances = np.where(np.isfinite(column) & (np.abs(column) > level), np.abs(places - j), 0)
        if distances.max() > farthest:
            i = int(distances.argmax())
            farthest, where = int(distances[i]), f"{what} has the entry ({i}, {j}) = {column[i]:.6g}"

    for j, column in enumerate(system.mass(t, q).T):
        look("M", j, column, 0.0)
    for j in range(system.n_q):
        step = np.where(places == j, shift, 0.0)
        try:
            force, jacobian = system.force(t, q, v), system.jacobian(t, q)
            by_q, by_v = system.force(t, q + step, v) - force, system.force(t, q, v + step) - force
            bent = system.jacobian(t, q + step) - jacobian
        except (ArithmeticError, ValueError):  # math.sqrt and its like, outside what the callbacks are made for
            continue
        level = ROUNDING * float(np.abs(force).max()) / shift
        look("the derivative of force by q", j, by_q / shift, level)
        look("the derivative of force by v", j, by_v / shift, level)
        level = ROUNDING * float(np.abs(jacobian).max()) / shift
        for k in range(system.n_c):
            look(f"the second derivative of constraint {k} by q", j, bent[k] / shift, level)
    if where:
        raise ValueError(
            f"bandwidth of {system.name!r} must be at least {farthest}: {where}; given {bandwidth}. Or number the "
            "coordinates otherwise, or leave bandwidth out"
        )


def _forward(values: list[Array], e: float) -> Array:
    return (-3.0 * values[0] + 4.0 * values[1] - values[2]) / (2.0 * e)


def _compare(
    system: ConstrainedSystem, kind: str, t: float, given: Array, difference: Callable[[float], Array], level: float
) -> None:
    if not np.isfinite(given).all():  # outside what it is made for; at a state of the run consistency.py names it
        return
    least = np.inf
    for e in DISPLACEMENTS:
        try:
            differenced = difference(e)
        except (ArithmeticError, ValueError):  # math.sqrt and its like, outside what the callbacks are made for
            continue
        if not np.isfinite(differenced).all():
            continue
        both = np.maximum(np.abs(given), np.abs(differenced))
        row = both.max(axis=-1, keepdims=True) if given.ndim == 2 else both
        excess = np.abs(given - differenced) / (AGREEMENT * row + level / e)
        if excess.max() <= 1.0:
            return
        if excess.max() < least:
            least = float(excess.max())
            where = tuple(int(k) for k in np.unravel_index(int(excess.argmax()), excess.shape))
            values = float(given[where]), float(differenced[where])
    if np.isinf(least):
        return
    entry = where if len(where) > 1 else where[0]
    what = {
        "jacobian": "the derivative of constraint with respect to q",
        "constraint_rate": "the derivative of constraint with respect to t",
        "gamma": "-((C_q v)_q v + 2 C_qt v + C_tt), the right side of C_q a = gamma",
        "force_by_q": "the derivative of force with respect to q",
        "force_by_v": "the derivative of force with respect to v",
        "reaction_by_q": "the derivative of C_q^T lam with respect to q",
    }[kind]
    hint = {
        "constraint_rate": ", or give constraint_rate: the constraints depend on time",
        "gamma": ", or leave gamma out to have it differenced",
        "force_by_q": ", or leave all tangents out to have the force differenced",
        "reaction_by_q": ", or leave reaction_by_q out to have it differenced",
    }.get(kind, "")
    if kind == "force_by_v" and system.functions.flags[FORCE_BY_V_GIVEN] == 0:
        hint = ", that is, give force_by_v: beside force_by_q the force may depend on v only with it"
    raise ValueError(
        f"{kind} of {system.name!r} is not {what}: entry {entry} is {values[0]:.6g}, by differences it is "
        f"{values[1]:.6g} (t = {t:g}, near the start, velocities chosen at random). Mend its formula{hint}"
    )


def wrong_derivative(system, t, q, v):
    return None
