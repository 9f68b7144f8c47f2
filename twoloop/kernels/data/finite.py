"""Values that are not finite, and which callback gave them."""

import numpy as np

from twoloop.kernels.data.codes import NOT_FINITE
from twoloop.kernels.data.common import Functions, compiled
from twoloop.kernels.data.noted import FAULT_KIND, FAULT_TIME

MASS, FORCE, CONSTRAINT, JACOBIAN, RATE, GAMMA = (
    Functions._fields.index(kind) for kind in ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")
)
NONHOLONOMIC, NONHOLONOMIC_RATE, NONHOLONOMIC_GAMMA = (
    Functions._fields.index(f"nonholonomic{part}") for part in ("", "_rate", "_gamma")
)


@compiled
def finite_vector(x):
    """Whether all entries are finite."""
    all_finite = True
    for j in range(x.size):
        all_finite = all_finite and np.isfinite(x[j])
    return all_finite


@compiled
def finite(A):
    """Whether all entries of a matrix are finite."""
    all_finite = True
    for i in range(A.shape[0]):
        all_finite = all_finite and finite_vector(A[i])
    return all_finite


@compiled
def not_finite(notes, kind, t, q):
    """Note which callback gave a value that is not finite, for the message; none where q itself is not finite."""
    notes[FAULT_KIND] = kind if finite_vector(q) else -1.0
    notes[FAULT_TIME] = t
    return NOT_FINITE


@compiled
def source_of_acceleration(w):
    """Place in Functions of the callback that gave an acceleration that is not finite; -1: none of these."""
    n_c = w.C.size
    if not finite_vector(w.Rate[:n_c]):
        return RATE
    if not finite_vector(w.Gamma[:n_c]):
        return GAMMA
    if not finite(w.G[n_c:]):
        return NONHOLONOMIC
    if not finite_vector(w.Rate[n_c:]):
        return NONHOLONOMIC_RATE
    if not finite_vector(w.Gamma[n_c:]):
        return NONHOLONOMIC_GAMMA
    return FORCE if not finite_vector(w.Q) else -1
