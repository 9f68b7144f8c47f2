"""C_q by differences of C, for systems that give none."""

from functools import cache

import numpy as np

from twoloop.kernels.compile.caches import watch
from twoloop.kernels.compile.callbacks import compile_callback
from twoloop.kernels.compile.private import Dispatcher

FIRST = 2.0**-6  # first displacement, relative to max(1, |q|); a power of two, so that q + displacement is exact
SHORTER = 0.125  # what follows a displacement over which the constraints bend too much
DISPLACEMENTS = 9
AGREEMENT = 1e-11  # of the formulas of order 6 and 8, relative to the entry, at which no shorter one is tried
ROUNDING = 1e-14  # of a constraint, relative to its largest value at the displaced points

# d/dx at 0 from f(k h) - f(-k h), k = 1 ... 4, over h
ORDER_8 = (4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0)
ORDER_6 = (3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0, 0.0)


@cache
def differenced_jacobian(constraint: Dispatcher) -> Dispatcher:
    """The callback "jacobian" that differences a callback "constraint".

    Central differences of order 8 at four displacements to either side, multiples of 1/64 of max(1, |q_j|) for each
    coordinate: 8 n_q calls of the constraint. Where a formula of order 6 at the same points says otherwise by more
    than 1e-11 of an entry, the constraint bends on a shorter scale (a coordinate of 3e5 m on a bar of 1 m, a mechanism
    of micrometres): displacements shorter by 8, and so on, and for each entry the one at which the two formulas agree
    best. Each costs another 8 calls. For constraints that are smooth on the scale of a metre and a radian entries are
    good to about 1e-13 of the largest term in the constraint.
    """

    def jacobian(t, q, p, Cq):  # type: ignore[no-untyped-def]
        n_c, n_q = Cq.shape
        moved = q.copy()
        ahead, behind = np.zeros(n_c), np.zeros(n_c)
        high, low, size, best = np.zeros(n_c), np.zeros(n_c), np.zeros(n_c), np.zeros(n_c)
        for j in range(n_q):
            h = FIRST * 2.0 ** np.floor(np.log2(max(1.0, abs(q[j]))))
            best[:] = np.inf
            for _ in range(DISPLACEMENTS):
                high[:] = 0.0
                low[:] = 0.0
                size[:] = 0.0
                for k in range(4):
                    ahead[:] = 0.0
                    moved[j] = q[j] + (k + 1) * h
                    constraint(t, moved, p, ahead)
                    behind[:] = 0.0
                    moved[j] = q[j] - (k + 1) * h
                    constraint(t, moved, p, behind)
                    for i in range(n_c):
                        high[i] += ORDER_8[k] * (ahead[i] - behind[i])
                        low[i] += ORDER_6[k] * (ahead[i] - behind[i])
                        size[i] = max(size[i], abs(ahead[i]), abs(behind[i]))
                moved[j] = q[j]
                good = True
                for i in range(n_c):
                    entry, doubt = high[i] / h, abs(high[i] - low[i]) / h + ROUNDING * size[i] / h
                    if doubt < best[i]:
                        best[i] = doubt
                        Cq[i, j] = entry
                    elif not np.isfinite(doubt) and best[i] == np.inf:
                        Cq[i, j] = entry  # nothing finite so far
                    good &= abs(high[i] - low[i]) <= AGREEMENT * abs(high[i]) + ROUNDING * size[i]
                if good:
                    break
                h *= SHORTER

    return compile_callback("jacobian", jacobian, watch(jacobian))
