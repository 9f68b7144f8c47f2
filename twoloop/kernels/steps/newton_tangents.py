"""K = dQ/dq - d(Cq^T lam)/dq, lam held, and D = dQ/dv from the tangents that a system was given, for newton_step.py."""

import numpy as np

from twoloop.kernels.data.codes import DONE, NOT_FINITE
from twoloop.kernels.data.common import compiled, inlined
from twoloop.kernels.data.flags import FORCE_BY_V_GIVEN, REACTION_BY_Q_GIVEN
from twoloop.kernels.evaluation.constraints import constraint_rows
from twoloop.kernels.linalg.dense import copy

DIFFERENCE = 1e-7  # displacement for derivatives, relative to max(1, |value|)
STEP, KINDS = 0.37, 7  # by which displacements that are made at a time differ, and how many kinds of them there are


@inlined
def displaced_with_all(value, place):
    """A coordinate or velocity where all are displaced at a time, unlike its neighbours: so that nothing cancels."""
    return value + DIFFERENCE * max(1.0, abs(value)) * (1.0 + STEP * (place % KINDS))


@compiled
def _clear(A, b):
    for i in range(A.shape[0]):
        for j in range(max(0, i - b), min(A.shape[0], i + b + 1)):
            A[i, j] = 0.0


@compiled
def _finite(A, b):
    for i in range(A.shape[0]):
        for j in range(max(0, i - b), min(A.shape[0], i + b + 1)):
            if not np.isfinite(A[i, j]):
                return NOT_FINITE
    return DONE


@compiled
def _bent(f, w, t, q):
    """Whether C_q at q, left in w.Gx, differs from w.G."""
    w.Gx[:, :] = 0.0
    constraint_rows(f, w, t, q, w.Gx)
    for i in range(w.C.size):
        for j in range(q.size):
            if w.Gx[i, j] != w.G[i, j]:
                return True
    return False


@compiled
def _subtract_reaction_differences(f, w, t, q, moved, b, K):
    """K -= d(Cq^T lam)/dq, by displacing coordinates j, j + 2 b + 1, ... at a time."""
    n = q.size
    for j in range(n):
        moved[j] = displaced_with_all(q[j], j)
    if not _bent(f, w, t, moved):
        return
    width = min(n, 2 * b + 1)
    for group in range(width):
        copy(q, moved)
        for j in range(group, n, width):
            moved[j] += DIFFERENCE * max(1.0, abs(q[j]))
        if not _bent(f, w, t, moved):
            continue
        for j in range(group, n, width):
            size = moved[j] - q[j]
            for i in range(max(0, j - b), min(n, j + b + 1)):
                for k in range(w.C.size):
                    K[i, j] -= (w.Gx[k, i] - w.G[k, i]) * w.lam[k] / size


@compiled
def tangent_by_q(f, w, t, q, v, b, moved, K, R):
    """K (n_q, n_q), of which only the band |i - j| <= b counts, at a state that was evaluated just before."""
    _clear(K, b)
    f.force_by_q(t, q, v, f.p, K)
    if f.flags[REACTION_BY_Q_GIVEN] == 1:
        _clear(R, b)
        f.reaction_by_q(t, q, w.lam, f.p, R)
        for i in range(q.size):
            for j in range(max(0, i - b), min(q.size, i + b + 1)):
                K[i, j] -= R[i, j]
    else:
        _subtract_reaction_differences(f, w, t, q, moved, b, K)
    return _finite(K, b)


@compiled
def tangent_by_v(f, t, q, v, b, D):
    """D (n_q, n_q), of which only the band counts; left alone where the force does not depend on v."""
    if f.flags[FORCE_BY_V_GIVEN] == 0:
        return DONE
    _clear(D, b)
    f.force_by_v(t, q, v, f.p, D)
    return _finite(D, b)
