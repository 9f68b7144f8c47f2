"""The inner loop with functions made for a mechanism; what they do not do, or cannot, is left to the general one."""

import numpy as np

from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.common import INNER, kernel
from twoloop.kernels.data.counters import N_EVALUATIONS, N_FACTORIZATIONS, N_INNER
from twoloop.kernels.data.noted import BY_GENERAL, ROUNDED
from twoloop.kernels.evaluation.inner import CONTRACTION, MAX_INNER
from twoloop.kernels.evaluation.onto_constraints import ABOVE_ROUNDING
from twoloop.kernels.evaluation.tasks import EVALUATE_THERE, MULTIPLIERS, PROJECT, REDUNDANT, TANGENTS


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
