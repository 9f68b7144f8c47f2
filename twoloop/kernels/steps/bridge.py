"""Steps across a position where C_q loses rank, such as a parallelogram with its bars in line.

Near such a position no partition determines the dependents well, and loops on independent coordinates do not converge,
though the motion is smooth. A step of the explicit method of explicit.py goes across: its stages are left where the
formula puts them, all coordinates alike, each with a partition of its own; only the end is put on the constraints.
Stages leave these by their truncation error, which the distance from the singular position magnifies once.
"""

import numpy as np

from twoloop.kernels.algebra.linalg import copy
from twoloop.kernels.control.controller import nothing_to_settle
from twoloop.kernels.control.predictor import keep_predicted
from twoloop.kernels.data.codes import DONE, SINGULAR
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, kernel
from twoloop.kernels.data.counters import N_OUTER
from twoloop.kernels.data.noted import ORIENTATION, ORIENTATION_NEW, PIVOT
from twoloop.kernels.data.tolerances import ESTIMATE, allowed
from twoloop.kernels.evaluation.calls import accelerations, evaluate_state, find_tangents, renew_partition
from twoloop.kernels.steps.explicit_step import (
    COARSE,
    FINE,
    INNER_TOL,
    STAGE,
    _error,
    _move,
    _slopes,
    _vector,
    tableau_of,
)

STRICT = True  # of the estimate
NEARER = 0.5  # of the smallest pivot at the start of a step, which there must be at its end


@kernel(ATTEMPT)
def bridging_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt; `options` and `memory` are those of explicit_step."""
    s, A, b, c, fine, coarse = tableau_of(options)
    n = w.Q.size
    q, y, y1 = state[:n], state[: 2 * n], new_state[: 2 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    stage, one, other = _vector(memory, n, STAGE), _vector(memory, n, FINE), _vector(memory, n, COARSE)
    slopes, q_stage = _slopes(memory, s, n), stage[:n]
    w.counters[N_OUTER] += 1
    code = renew_partition(f, w, t, q)
    pivot = w.notes[PIVOT] if code == DONE else 0.0
    copy(state[n : 3 * n], slopes[0])
    for j in range(1, s):
        _move(y, h, A[j, :j], slopes, stage, stage)
        copy(stage[n : 2 * n], slopes[j, :n])
        code = renew_partition(f, w, t + c[j] * h, q_stage)
        if code == DONE:
            code = find_tangents(f, w, t + c[j] * h, q_stage)
        if code == DONE:
            code = accelerations(f, w, t + c[j] * h, q_stage, slopes[j, :n], slopes[j, n : 2 * n], w.lam)
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
    _move(y, h, b, slopes, stage, y1)
    error = 0.0
    if tolerances[ESTIMATE] == 1.0:
        error = _error(tolerances, h, fine, coarse, y, y1, slopes, one, other, STRICT)
        if not error <= 1.0:
            return Attempt(DONE, error, 0.0)
    code = renew_partition(f, w, t + h, q1)
    if code == DONE and w.notes[PIVOT] < NEARER * pivot:
        code = SINGULAR  # from there it would be harder still
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    keep_predicted(w, q1)
    w.notes[ORIENTATION_NEW] = w.notes[ORIENTATION]
    code = evaluate_state(f, w, t + h, q1, v1, options[INNER_TOL], a1, lam1)
    for k in range(w.dependent.size):
        m = w.dependent[k]
        scale = allowed(tolerances, m, q[m], q1[m])
        error = max(error, abs(w.predicted[k] - q1[m]) / scale * tolerances[ESTIMATE])
    return Attempt(code, error, 0.0)


BRIDGING = Step(bridging_step, nothing_to_settle)
