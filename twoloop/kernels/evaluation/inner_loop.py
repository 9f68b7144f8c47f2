"""Compile the inner loop once, as one function that all steps call, so that no step compiles it again.

A step gets a `Kit`, the callbacks and this function; the helpers here name its tasks.
"""

import numpy as np

from twoloop.kernels.data.common import INNER, compiled, kernel, merged
from twoloop.kernels.data.indices import (
    BY_GENERAL,
    DONE,
    INNER_DIVERGED,
    N_EVALUATIONS,
    N_FACTORIZATIONS,
    N_INNER,
    REUSE,
    ROUNDED,
    SINGULAR,
)
from twoloop.kernels.evaluation import tasks
from twoloop.kernels.evaluation.accelerations import (
    MIN_CORRECTION,
    accelerate,
    accelerate_at,
    equilibrate,
    factor_mass_at,
    project_state,
)
from twoloop.kernels.evaluation.partition import (
    CONTRACTION,
    MAX_ITERATIONS,
    ROUNDING_OF_CORRECTIONS,
    choose_oriented_partition,
    factor_dependent,
    find_null_space,
    partition_of_midpoint,
    record_entries,
    redundant_rows_hold,
    restore_positions,
    restore_velocities,
    write_programs,
)
from twoloop.kernels.linalg.dense import has_new_entries, largest_of

ROUNDING_OF_Q = 2e-14  # about a hundred times the rounding of q, see rounding_floor


@merged
def _verify_pattern(w):
    """Write new programs if the Jacobian has a new entry: values computed without it are wrong."""
    if not record_entries(w):
        return DONE
    return INNER_DIVERGED if write_programs(w) else SINGULAR


@compiled
def _other_task(f, w, task, t, q, v):
    if task == tasks.FIND_NULL_SPACE:
        code = factor_dependent(f, w, t, q)
        if code == DONE:
            find_null_space(f, w, t, q)
        return code
    if task == tasks.PREPARE_MASS:
        return factor_mass_at(f, w, t, q)
    if task == tasks.RENEW_PARTITION:
        return choose_oriented_partition(f, w, t, q)
    if task == tasks.ADOPT_MIDPOINT:
        return partition_of_midpoint(f, w, t, q, v)
    if task == tasks.VERIFY_PATTERN:
        return _verify_pattern(w)
    return redundant_rows_hold(f, w, t, q, v)


@kernel(INNER)
def inner_loop(f, w, task, t, q, v, tolerance, a, lam):
    """Do a task, named in tasks.py, at (t, q, v); the functions below describe each."""
    if task >= tasks.FIND_NULL_SPACE:
        return _other_task(f, w, task, t, q, v)
    if task == tasks.EVALUATE_AS_GIVEN:  # this task and PROJECT serve methods that integrate all coordinates
        return accelerate_at(f, w, t, q, v, a)
    if task == tasks.PROJECT:
        return project_state(f, w, t, q, v, tolerance, a, lam)
    code = DONE
    if task <= tasks.RESTORE:
        reuse = w.notes[REUSE] if task == tasks.EVALUATE else w.notes[ROUNDED]
        code = restore_positions(f, w, t, q, v, tolerance, reuse)
        if code == DONE and task != tasks.EVALUATE:
            code = _verify_pattern(w)
        if code != DONE:
            return code
        restore_velocities(f, w, t, q, v, reuse)
    if task == tasks.RESTORE:
        return code
    if task != tasks.MULTIPLIERS:
        code = accelerate(f, w, t, q, v, a)
    if code == DONE and task != tasks.EVALUATE:
        equilibrate(f, w, a, lam)
    return code


@merged
def evaluate(f, w, t, q, v, tolerance, a):
    """Evaluate the right-hand side: dependent q and v from the independent ones, then a.

    Velocities and accelerations are those of a Jacobian whose position is off by w.notes[REUSE] at most.
    """
    return f.inner(f, w, tasks.EVALUATE, t, q, v, tolerance, a, w.lam)


@merged
def evaluate_state(f, w, t, q, v, tolerance, a, lam):
    """Evaluate a state that may be accepted: exact to rounding, with multipliers."""
    return f.inner(f, w, tasks.EVALUATE_STATE, t, q, v, tolerance, a, lam)


@merged
def evaluate_as_given(f, w, t, q, v, a):
    """Evaluate accelerations at (q, v) without a projection; the state need not be on the constraints."""
    return f.inner(f, w, tasks.EVALUATE_AS_GIVEN, t, q, v, 0.0, a, w.lam)


@merged
def project(f, w, t, q, v, theta, a, lam):
    """Project (q, v) onto the constraints, with a and lam; the last correction of a position is at most theta."""
    code = f.inner(f, w, tasks.PROJECT, t, q, v, theta, a, lam)
    if code == DONE and has_new_entries(w.G, w.pattern):
        code = f.inner(f, w, tasks.VERIFY_PATTERN, t, q, v, theta, a, lam)
    return code


@merged
def restore(f, w, t, q, v, tolerance):
    """Restore dependent q and v from the independent ones; leaves w ready for `accelerations` at this state."""
    return f.inner(f, w, tasks.RESTORE, t, q, v, tolerance, w.x, w.lam)


@merged
def accelerations(f, w, t, q, v, a, lam):
    """Solve eqs. (6)-(8) at a state that was restored just before: accelerations and multipliers."""
    return f.inner(f, w, tasks.ACCELERATIONS, t, q, v, 0.0, a, lam)


@merged
def multipliers(f, w, t, q, v, a, lam):
    """Compute the multipliers of the accelerations that were computed just before."""
    return f.inner(f, w, tasks.MULTIPLIERS, t, q, v, 0.0, a, lam)


@merged
def find_tangents(f, w, t, q):
    """Factor the rows at a position on the constraints, and find the velocities that they allow, in w.D."""
    return f.inner(f, w, tasks.FIND_NULL_SPACE, t, q, q, 0.0, w.x, w.lam)


@merged
def prepare_mass(f, w, t, q):
    """Evaluate M(t, q), and its factors if they are needed."""
    return f.inner(f, w, tasks.PREPARE_MASS, t, q, q, 0.0, w.x, w.lam)


@merged
def renew_partition(f, w, t, q):
    """Choose a partition at an accepted state, and record the sign of det C_qd that its motion has to keep."""
    return f.inner(f, w, tasks.RENEW_PARTITION, t, q, q, 0.0, w.x, w.lam)


@merged
def adopt_midpoint_partition(f, w, t_mid, state, new_state):
    """Adopt the partition of the middle of a step, see `partition_of_midpoint`."""
    return f.inner(f, w, tasks.ADOPT_MIDPOINT, t_mid, state, new_state, 0.0, w.x, w.lam)


@merged
def check_redundant(f, w, t, q, v):
    """Check whether the redundant rows hold at an accepted state."""
    return f.inner(f, w, tasks.CHECK_REDUNDANT, t, q, v, 0.0, w.x, w.lam)


@merged
def rounding_floor(q):
    """Return the relative change at which a fixed-point iteration that stops shrinking has converged: q is rounded."""
    return max(ROUNDING_OF_CORRECTIONS, ROUNDING_OF_Q * largest_of(q))


@kernel(INNER)
def generated_inner_loop(f, w, task, t, q, v, theta, a, lam):
    """Do a task by the mechanism's generated code; leave other tasks, and failures, to the general loop."""
    if task == tasks.EVALUATE_AS_GIVEN:
        w.counters[N_EVALUATIONS] += 1
        w.counters[N_FACTORIZATIONS] += 1
        if f.own_there(t, q, v, f.numbers, a):
            return DONE
    elif task == tasks.PROJECT:
        least, before = max(theta, MIN_CORRECTION * w.notes[ROUNDED]), np.inf
        for k in range(MAX_ITERATIONS):
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
    elif task == tasks.CHECK_REDUNDANT and w.notes[BY_GENERAL] == 0.0:
        if f.own_redundant(t, q, v, f.numbers, a):
            return DONE
        f.general(f, w, tasks.FIND_NULL_SPACE, t, q, v, theta, a, lam)  # leaves the rows there in w
    elif task <= tasks.MULTIPLIERS:  # tasks of methods that need a good partition at every step
        w.notes[BY_GENERAL] = 1.0
    return f.general(f, w, task, t, q, v, theta, a, lam)
