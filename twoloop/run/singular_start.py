"""Start in a singular position, where C_q loses rank, if the velocities there belong to one branch of the motion only.

There, C_q a = gamma does not contain all conditions on the accelerations a. Let u be the vectors with u^T C_q = 0.
Along a motion, C_q v + C_t stays zero. Its second time derivative, multiplied by u^T, yields the missing equations

    3 u^T (dC_q/dt) a = -u^T d^2/dt^2 (C_q v + C_t), with constant velocities v on the right-hand side.

If C_q and the rows u^T dC_q/dt together have the rank that C_q has beside the start, only one branch of the motion has
the velocities v. Constraint forces may act along these rows, too: then multipliers tend to infinity at the start.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.scales import signs
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.fallbacks import state_after_jump
from twoloop.run.singular_positions import DISPLACEMENT, scaled_to_unit_masses

Array = NDArray[np.float64]

MAX_VIOLATION = 1e-3  # velocities v are rounding errors of rest if max|C_q v| is at least this times |C_q| max|v|
CHANGE_PER_SAMPLE = 3e-3  # finite differences in time use samples between which C_q changes by about this fraction
# weights of five equidistant samples in finite differences; row 0: first derivative, row 1: second derivative
WEIGHTS = np.array([[1.0, -8.0, 0.0, 8.0, -1.0], [-1.0, 16.0, -30.0, 16.0, -1.0]]) / 12.0
# assumed relative error of differences. dC_q/dt counts as 0 if moving by max|q| changes C_q by less than this fraction
MAX_DIFFERENCE_ERROR = 1e-8
# the rank of C_q rises along the motion if (ds/dt) / |dC_q/dt| exceeds this; s: a singular value, zero at the start
MIN_RANK_DERIVATIVE = 1e-6
# let s be a singular value of C_q that is zero at the start: ds/dt is certainly not zero if it exceeds this multiple of
# the norm that dC_q/dt would have if the velocities were as large as the tolerances
MIN_CLARITY = 10.0
# a run begins beside its singular start, at a state where C_q has changed by the fraction BESIDE_CHANGE or less. Its
# first step changes C_q by about the fraction STEP_CHANGE
BESIDE_CHANGE, STEP_CHANGE = 0.1, 0.6
# up to N_BESIDE states near the start are tried, each at half the distance of the previous one. A state is accepted if
# its projection onto the constraints moves it by at most MAX_CORRECTION times the state's distance from the start
N_BESIDE, MAX_CORRECTION = 6, 0.2
MAX_RESIDUAL = 1e-6  # largest residual allowed in the equations for the accelerations, relative to the right-hand side


class Branch(NamedTuple):
    """Branch of the motion through a singular position.

    `a`: accelerations (n_q,) at this position. `q`, `v`: a nearby state on the branch; `rank`: rank of C_q at `q`.
    `first_size`: first step size (s) to try.
    """

    a: Array
    q: Array
    v: Array
    rank: int
    first_size: float


def branch_at(system: ConstrainedSystem, t: float, state: Array, rank: int, allowed: Array) -> Branch | bool | None:
    """Return the Branch that leaves a singular start; False: none was found with certainty; None: start not singular.

    `state`: [q, v, a] at the start; `rank`: rank of C_q at the start. The start counts as not singular if the rank does
    not rise along the motion, if C depends on t, or if non-holonomic constraints exist. The branch is not certain if
    velocities of another branch may be closer to v than the tolerances `allowed` (n_q,), if the residual of a exceeds
    MAX_RESIDUAL, or if no state on the branch was found.
    """
    if system.n_a > 0 or "constraint_rate" in system.given or not 0 < rank < min(system.n_c, system.n_q):
        return None
    try:
        return _branch_at(system, t, state, rank, allowed)
    except Exception:  # callbacks may fail at states near the start: treat the start as not singular
        return None


def _branch_at(system: ConstrainedSystem, t: float, state: Array, rank: int, allowed: Array) -> Branch | bool | None:
    """Return what `branch_at` returns; do not catch exceptions of callbacks."""
    q, v, a = np.split(state[: 3 * system.n_q], 3)
    mass, rows, divisors, units = scaled_to_unit_masses(system, t, q)
    norm = float(np.linalg.norm(rows))

    def is_rounding_error(x: Array) -> bool:
        return bool(np.abs(rows @ (x / units)).max() >= MAX_VIOLATION * norm * np.abs(x / units).max())

    if is_rounding_error(v):  # the mechanism is at rest
        v = np.zeros(system.n_q)
    direction = v if v.any() else a
    if is_rounding_error(direction):
        return None
    left, _, right = np.linalg.svd(rows)
    lost, free = left[:, rank:].T, right[rank:].T  # lost: rows u^T with u^T C_q = 0; free: columns x with C_q x = 0

    def derivative_of_rows(direction: Array, step: float) -> Array:
        samples = [system.rows(t, q + s * direction) * units for s in step * np.array([-2.0, -1.0, 1.0, 2.0])]
        return np.tensordot(WEIGHTS[0, [0, 1, 3, 4]], samples, axes=1) / (step * divisors[:, None])  # type: ignore[no-any-return]

    def derivative_of_constraints(order: int) -> Array:
        samples = [system.velocity_constraint(t, q + s * v, v) for s in step * np.arange(-2.0, 3.0)]
        return WEIGHTS[order - 1] @ samples / (step**order * divisors)  # type: ignore[no-any-return]

    step = DISPLACEMENT * max(np.abs(q).max(), DISPLACEMENT) / np.abs(direction).max()
    speed = float(np.linalg.norm(derivative_of_rows(direction, step))) / norm  # |dC_q/dt| / |C_q|, 1/s
    if not step * speed > MAX_DIFFERENCE_ERROR * DISPLACEMENT:
        return None
    step = CHANGE_PER_SAMPLE / speed
    added_rows = lost @ derivative_of_rows(direction, step) / speed
    slopes = np.linalg.svd(added_rows @ free, compute_uv=False)  # time derivatives of the zero singular values
    if slopes.max() <= MIN_RANK_DERIVATIVE * norm:
        return None
    distance = step * float(np.abs(direction).max())  # largest change of a coordinate between two samples
    uncertainty = np.linalg.norm(derivative_of_rows(allowed * signs(len(q)), distance / float(allowed.max())))
    is_certain = slopes > max(MIN_CLARITY * float(uncertainty) / speed, MIN_RANK_DERIVATIVE * norm)
    if not v.any() or slopes[~is_certain].max(initial=0.0) > MIN_RANK_DERIVATIVE * norm:
        return False
    right_side = -np.append(derivative_of_constraints(1), lost @ derivative_of_constraints(2) / (3.0 * speed))
    equations, rank = np.vstack([rows, added_rows]), rank + int(is_certain.sum())
    a = np.asarray(np.linalg.lstsq(equations, right_side, rcond=MAX_DIFFERENCE_ERROR)[0])
    scale = max(np.abs(right_side).max(), speed * speed * norm)
    if not np.abs(equations @ a - right_side).max() <= MAX_RESIDUAL * scale:
        return False
    null_space = np.linalg.svd(equations)[2][rank:].T
    force = null_space.T @ (units * system.force(t, q, v) - mass @ a)
    a += null_space @ np.linalg.solve(null_space.T @ mass @ null_space, force)
    a *= units
    acceleration = 0.0  # |part of d^2 C_q/dt^2 due to a| / |C_q|, in 1/s^2
    if a.any():
        acceleration = float(np.linalg.norm(derivative_of_rows(a, distance / float(np.abs(a).max())))) / norm
    for change in BESIDE_CHANGE * 0.5 ** np.arange(N_BESIDE):
        dt = _time_of_change(change, speed, acceleration)
        displacement = dt * (v + 0.5 * dt * a)
        new_state = state_after_jump(system, t, q + displacement, v + dt * a)
        if new_state is None:
            continue
        if np.abs(new_state[: len(q)] - q - displacement).max() <= MAX_CORRECTION * np.abs(displacement).max():
            first_size = _time_of_change(STEP_CHANGE, speed, acceleration)
            return Branch(a, new_state[: len(q)], new_state[len(q) :], rank, first_size)
    return False


def _time_of_change(change: float, speed: float, acceleration: float) -> float:
    """Return the time (s) in which C_q changes by `change` with `speed` and `acceleration`, all relative to |C_q|."""
    return 2.0 * change / (speed + float(np.sqrt(speed * speed + 2.0 * acceleration * change)))
