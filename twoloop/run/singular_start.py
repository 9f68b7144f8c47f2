"""Start in a singular position, where C_q loses rank, if the velocities there belong to one branch of the motion only.

Let u be the vectors with u^T C_q = 0 at the start. Along the motion, u^T (C_q v + C_t) has a zero first derivative if v
belongs to a branch; its second derivative determines the accelerations, in addition to C_q a = gamma:

    3 u^T (dC_q/dt) a = -u^T d^2/dt^2 (C_q v + C_t), with constant velocities on the right.

If the rows u^T dC_q/dt raise the rank to the rank beside the position, this branch is the only one with velocities v.
Constraint forces may act along these rows, too: then the multipliers grow without limit towards the position.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.scales import signs
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.fallbacks import state_after_jump
from twoloop.run.singular_positions import DISPLACEMENT, scaled_to_unit_masses

Array = NDArray[np.float64]

CHANGE_PER_SAMPLE = 3e-3  # relative change of the rows of C_q between two samples of a finite difference
# finite differences: weights of five samples, at a spacing of 1, in the first and the second derivative
WEIGHTS = np.array([[1.0, -8.0, 0.0, 8.0, -1.0], [-1.0, 16.0, -30.0, 16.0, -1.0]]) / 12.0
# assumed relative error of derivatives by finite differences; smaller derivatives, relative to the rows, count as 0
MAX_DIFFERENCE_ERROR = 1e-8
# the rank of C_q rises if the derivative of a zero singular value exceeds this, relative to the derivative of C_q
MIN_RANK_DERIVATIVE = 1e-6
# the derivative of a zero singular value counts as nonzero if it exceeds this multiple of its uncertainty, which is the
# norm of the derivative of the rows along a velocity as large as the tolerances
MIN_CLARITY = 10.0
# relative change of the rows of C_q from the start to a state beside it, and in the first step that is tried
BESIDE_CHANGE, STEP_CHANGE = 0.1, 0.6
# N_BESIDE states beside the start are tried; one is accepted if projecting it onto the constraints moves it by at most
# MAX_CORRECTION times its displacement from the start
N_BESIDE, MAX_CORRECTION = 6, 0.2
MAX_RESIDUAL = 1e-6  # largest residual of the equations for the accelerations, relative to the right-hand side


class Branch(NamedTuple):
    """Branch of the motion through a singular position: accelerations there, and a nearby state on the branch.

    `rank`: rank of C_q near the position, on the branch. `first_size`: first step size (s) to try.
    """

    a: Array
    q: Array
    v: Array
    rank: int
    first_size: float


def branch_at(system: ConstrainedSystem, t: float, state: Array, rank: int, allowed: Array) -> Branch | bool | None:
    """Find the branch of the motion through a state [q, v, a] at which C_q has the rank `rank`.

    Return None if the rank does not rise along the motion: then the position is not singular, or the motion stays in
    it. Return False if the rank rises, but another branch has velocities within the tolerances `allowed` (n_q,) of v.
    """
    if system.n_a > 0 or "constraint_rate" in system.given or not 0 < rank < min(system.n_c, system.n_q):
        return None
    try:
        return _branch_at(system, t, state, rank, allowed)
    except Exception:  # callbacks may fail beside the start
        return None


def _branch_at(system: ConstrainedSystem, t: float, state: Array, rank: int, allowed: Array) -> Branch | bool | None:
    """Return the result of `branch_at`, or raise the exception of a callback."""
    q, v, a = np.split(state[: 3 * system.n_q], 3)
    direction = v if v.any() else a
    if not direction.any():
        return None
    mass, rows, divisors, units = scaled_to_unit_masses(system, t, q)
    left, _, right = np.linalg.svd(rows)
    lost, free = left[:, rank:].T, right[rank:].T  # rows u^T with u^T C_q = 0; columns: null space of C_q

    def derivative_of_rows(direction: Array, step: float) -> Array:
        samples = [system.rows(t, q + s * direction) * units for s in step * np.array([-2.0, -1.0, 1.0, 2.0])]
        return np.tensordot(WEIGHTS[0, [0, 1, 3, 4]], samples, axes=1) / (step * divisors[:, None])  # type: ignore[no-any-return]

    def derivative_of_constraints(order: int) -> Array:
        samples = [system.velocity_constraint(t, q + s * v, v) for s in step * np.arange(-2.0, 3.0)]
        return WEIGHTS[order - 1] @ samples / (step**order * divisors)  # type: ignore[no-any-return]

    norm = float(np.linalg.norm(rows))
    step = DISPLACEMENT * max(np.abs(q).max(), DISPLACEMENT) / np.abs(direction).max()
    speed = float(np.linalg.norm(derivative_of_rows(direction, step))) / norm  # relative rate of change of C_q, 1/s
    if not step * speed > MAX_DIFFERENCE_ERROR * DISPLACEMENT:
        return None
    step = CHANGE_PER_SAMPLE / speed
    added_rows = lost @ derivative_of_rows(direction, step) / speed
    slopes = np.linalg.svd(added_rows @ free, compute_uv=False)  # derivatives of zero singular values
    if slopes.max() <= MIN_RANK_DERIVATIVE * norm:
        return None
    distance = step * float(np.abs(direction).max())  # largest displacement of a finite difference
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
    acceleration = 0.0  # second derivative of C_q along the motion, relative to its norm, 1/s^2
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
    """Return the time (s) in which rows change by `change`, given their relative rates `speed` and `acceleration`."""
    return 2.0 * change / (speed + float(np.sqrt(speed * speed + 2.0 * acceleration * change)))
