"""The inner loop as the steps call it: one compiled function, so that no step compiles it again.

A step gets a `Kit`, the callbacks and this function; the helpers here name its tasks.
"""

import numpy as np

from twoloop.kernels.data.codes import DONE, INNER_DIVERGED, SINGULAR
from twoloop.kernels.data.common import INNER, compiled, kernel, merged
from twoloop.kernels.data.counters import N_EVALUATIONS, N_FACTORIZATIONS, N_INNER
from twoloop.kernels.data.noted import BY_GENERAL, REUSE, ROUNDED
from twoloop.kernels.evaluation import tasks
from twoloop.kernels.evaluation.accelerations import (
    ABOVE_ROUNDING,
    accelerate,
    accelerate_there,
    equilibrate,
    mass_there,
    to_constraints,
)
from twoloop.kernels.evaluation.partition import (
    CONTRACTION,
    MAX_INNER,
    ROUNDING,
    factor_dependent,
    note_entries,
    partition_of_midpoint,
    positions,
    redundant_rows_hold,
    renew,
    tangents,
    velocities,
    write_programs,
)
from twoloop.kernels.evaluation.tasks import EVALUATE_THERE, MULTIPLIERS, PROJECT, REDUNDANT, TANGENTS
from twoloop.kernels.linalg.dense import has_new_entries

ROUNDING_OF_Q = 2e-14  # a hundred roundings, see rounding_floor


@merged
def _verify_pattern(w):
    """Where the Jacobian has an entry for the first time, what was evaluated on the way is wrong."""
    if not note_entries(w):
        return DONE
    return INNER_DIVERGED if write_programs(w) else SINGULAR


@compiled
def _other_task(f, w, task, t, q, v):
    if task == tasks.TANGENTS:
        code = factor_dependent(f, w, t, q)
        if code == DONE:
            tangents(f, w, t, q)
        return code
    if task == tasks.MASS_TASK:
        return mass_there(f, w, t, q)
    if task == tasks.RENEW:
        return renew(f, w, t, q)
    if task == tasks.MIDPOINT:
        return partition_of_midpoint(f, w, t, q, v)
    if task == tasks.PATTERN:
        return _verify_pattern(w)
    return redundant_rows_hold(f, w, t, q, v)


@merged
def _all_coordinates(f, w, task, t, q, v, tolerance, a, lam):
    """Tasks of methods that integrate all coordinates."""
    if task == tasks.EVALUATE_THERE:
        return accelerate_there(f, w, t, q, v, a)
    return to_constraints(f, w, t, q, v, tolerance, a, lam)


@kernel(INNER)
def inner_loop(f, w, task, t, q, v, tolerance, a, lam):
    """What the names of the tasks say, at (t, q, v); see the helpers below."""
    if task >= tasks.TANGENTS:
        return _other_task(f, w, task, t, q, v)
    if task >= tasks.EVALUATE_THERE:
        return _all_coordinates(f, w, task, t, q, v, tolerance, a, lam)
    code = DONE
    if task <= tasks.RESTORE:
        reuse = w.notes[REUSE] if task == tasks.EVALUATE else w.notes[ROUNDED]
        code = positions(f, w, t, q, v, tolerance, reuse)
        if code == DONE and task != tasks.EVALUATE:
            code = _verify_pattern(w)
        if code != DONE:
            return code
        velocities(f, w, t, q, v, reuse)
    if task == tasks.RESTORE:
        return code
    if task != tasks.MULTIPLIERS:
        code = accelerate(f, w, t, q, v, a)
    if code == DONE and task != tasks.EVALUATE:
        equilibrate(f, w, a, lam)
    return code


@merged
def evaluate(f, w, t, q, v, tolerance, a):
    """One evaluation of the right-hand side: dependents of q and v from their independents, then a.

    Velocities and accelerations are those of a Jacobian whose position is off by w.notes[REUSE] at most.
    """
    return f.inner(f, w, tasks.EVALUATE, t, q, v, tolerance, a, w.lam)


@merged
def evaluate_state(f, w, t, q, v, tolerance, a, lam):
    """The same for a state that may be accepted: exact to rounding, with multipliers."""
    return f.inner(f, w, tasks.EVALUATE_STATE, t, q, v, tolerance, a, lam)


@merged
def evaluate_there(f, w, t, q, v, a):
    """Accelerations at (q, v) as they stand, which need not be on the constraints."""
    return f.inner(f, w, tasks.EVALUATE_THERE, t, q, v, 0.0, a, w.lam)


@merged
def project(f, w, t, q, v, theta, a, lam):
    """(q, v) moved to the constraints, with a and lam; the last move of a position is at most theta."""
    code = f.inner(f, w, tasks.PROJECT, t, q, v, theta, a, lam)
    if code == DONE and has_new_entries(w.G, w.pattern):
        code = f.inner(f, w, tasks.PATTERN, t, q, v, theta, a, lam)
    return code


@merged
def restore(f, w, t, q, v, tolerance):
    """Dependents of q and v from their independents; leaves w ready for `accelerations` at this state."""
    return f.inner(f, w, tasks.RESTORE, t, q, v, tolerance, w.x, w.lam)


@merged
def accelerations(f, w, t, q, v, a, lam):
    """Eqs. (6)-(8) at a state that was restored just before: accelerations and multipliers."""
    return f.inner(f, w, tasks.ACCELERATIONS, t, q, v, 0.0, a, lam)


@merged
def multipliers(f, w, t, q, v, a, lam):
    """Those that belong to the accelerations found just before."""
    return f.inner(f, w, tasks.MULTIPLIERS, t, q, v, 0.0, a, lam)


@merged
def find_tangents(f, w, t, q):
    """Rows and factors at a position on the constraints, and the velocities that they allow, in w.D."""
    return f.inner(f, w, tasks.TANGENTS, t, q, q, 0.0, w.x, w.lam)


@merged
def prepare_mass(f, w, t, q):
    """M(t, q) and its factors, where they are needed."""
    return f.inner(f, w, tasks.MASS_TASK, t, q, q, 0.0, w.x, w.lam)


@merged
def renew_partition(f, w, t, q):
    """Choose a partition at an accepted state, and note the sign of det C_qd that its motion has to keep."""
    return f.inner(f, w, tasks.RENEW, t, q, q, 0.0, w.x, w.lam)


@merged
def take_midpoint(f, w, t_mid, state, new_state):
    """The partition of the middle of a step, see partition_of_midpoint."""
    return f.inner(f, w, tasks.MIDPOINT, t_mid, state, new_state, 0.0, w.x, w.lam)


@merged
def check_redundant(f, w, t, q, v):
    """Whether the rows that were left out hold at an accepted state."""
    return f.inner(f, w, tasks.REDUNDANT, t, q, v, 0.0, w.x, w.lam)


@merged
def rounding_floor(q):
    """Relative change below which a fixed-point iteration that stops shrinking has converged: q is rounded."""
    size = 0.0
    for j in range(q.size):
        size = max(size, abs(q[j]))
    return max(ROUNDING, ROUNDING_OF_Q * size)


@kernel(INNER)
def own_inner_loop(f, w, task, t, q, v, theta, a, lam):
    """See the tasks."""
    if task == EVALUATE_THERE:
        w.counters[N_EVALUATIONS] += 1
        w.counters[N_FACTORIZATIONS] += 1
        if f.own_there(t, q, v, f.numbers, a):
            return DONE
    elif task == PROJECT:
        least, before = max(theta, ABOVE_ROUNDING * w.notes[ROUNDED]), np.inf
        for k in range(MAX_INNER):
            w.counters[N_INNER] += 1
            w.counters[N_FACTORIZATIONS] += 1
            if k == 0:
                fine = f.own_closer(t, q, v, f.numbers, w.x, q)
            else:
                fine = f.own_nearer(t, q, v, f.numbers, a, w.x, q, v, lam)
            if not fine:
                break
            moved = 0.0
            for j in range(q.size):
                moved = max(moved, abs(w.x[j]))
            if moved <= least and k > 0:
                w.counters[N_EVALUATIONS] += 1
                w.notes[BY_GENERAL] = 0.0
                return DONE
            if moved > CONTRACTION * before:
                break
            before = max(moved, least)
        w.notes[BY_GENERAL] = 1.0
    elif task == REDUNDANT and w.notes[BY_GENERAL] == 0.0:
        if f.own_redundant(t, q, v, f.numbers, a):
            return DONE
        f.general(f, w, TANGENTS, t, q, v, theta, a, lam)  # the rows there, which this code has not left in w
    elif task <= MULTIPLIERS:  # of methods that need a good partition at every step
        w.notes[BY_GENERAL] = 1.0
    return f.general(f, w, task, t, q, v, theta, a, lam)
