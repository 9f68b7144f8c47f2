"""The matrices of Newton's method behind one interface: I - z^2 J_q - z J_v for each eigenvalue, z = h l.

J_q and J_v are the derivatives of the two-loop right-hand side by the independent positions and velocities. Three
structures serve: newton_dense.py, newton_banded.py where the system has a bandwidth, and newton_static.py for large
systems, of which all coordinates count as independent.
"""

from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.flags import BANDWIDTH, FORM, STATIC
from twoloop.kernels.steps import newton_banded, newton_dense, newton_static
from twoloop.kernels.steps import newton_memory as at
from twoloop.kernels.steps.newton_memory import block, complex_vector, count_eigenvalues, eigen_place

MAX_ITERATIONS = 15
SAME_STEP = 1e-9  # relative: steps are differences of times, and the same step is rounded otherwise at another time
STAGNATION = 0.1  # of the step tolerance: corrections of this size that no longer shrink are rounding


@compiled
def derivatives_at(f, w, options, memory, s, t, q, v, a):
    """Derivatives at a state (q, v) that was evaluated just before, with a as its accelerations."""
    if f.flags[FORM] == STATIC:
        return newton_static.derivatives(f, w, memory, t, q, v)
    if f.flags[BANDWIDTH] >= 0:
        return newton_banded.derivatives(f, w, memory, s, t, q, v)
    return newton_dense.derivatives(f, w, options, memory, s, t, q, v, a)


@compiled
def factor_systems(f, w, options, memory, s, h):
    """Factors for steps of h, for every eigenvalue and for gamma0."""
    if f.flags[FORM] == STATIC:
        code = newton_static.factor(f, w, options, s, h)
    elif f.flags[BANDWIDTH] >= 0:
        code = newton_banded.factor(f, w, options, memory, s, h)
    else:
        code = newton_dense.factor(w, options, memory, s, h)
    memory[at.H_FACTORED] = h
    return code


@compiled
def factor_filter(f, w, options, memory, s, h):
    """Factors for h gamma0 alone, as for a step of h."""
    if f.flags[FORM] == STATIC:
        return newton_static.factor_filter(f, w, options, s, h)
    if f.flags[BANDWIDTH] >= 0:
        return newton_banded.factor_filter(f, w, options, memory, s, h)
    return newton_dense.factor_filter(w, options, memory, s, h)


@compiled
def solve_system(f, w, options, memory, s, k, x):
    """Solve the k-th eigenvalue's system; the first n_dof numbers of x (n_q) are overwritten."""
    if f.flags[FORM] == STATIC:
        newton_static.solve(f, w, options, s, k, x)
    elif f.flags[BANDWIDTH] >= 0:
        newton_banded.solve(f, w, options, memory, s, k, x)
    else:
        newton_dense.solve(w, options, memory, s, k, x[: w.independent.size])


@compiled
def filter_error(f, w, options, memory, s, h, e_q, e_v):
    """e_v becomes (I - z^2 J_q - z J_v)^-1 (e_v + z J_q e_q), z = h gamma0: the first n_dof numbers of each (n_q)."""
    m = w.independent.size
    if f.flags[FORM] == STATIC:
        newton_static.filter_error(f, w, options, s, h, e_q, e_v)
    elif f.flags[BANDWIDTH] >= 0:
        newton_banded.filter_error(f, w, options, memory, s, h, e_q, e_v)
    else:
        newton_dense.filter_error(w, options, memory, s, h, e_q[:m], e_v[:m])


@compiled
def correct(f, w, options, memory, s, residual, A_stage):
    """Solve for the corrections of the stage accelerations and add them; `residual` becomes the corrections."""
    n = w.Q.size
    m = w.independent.size
    place = eigen_place(s)
    n_real = int(options[place + at.N_REAL])
    n_eigen = count_eigenvalues(options, s)
    x = complex_vector(memory, s, n, n_eigen, 0)
    place += at.N_EIGEN_SCALARS + s
    d = block(memory, s, n, at.Q_STAGE)  # free between two evaluations
    d[:, :] = 0.0
    for k in range(n_eigen):
        row = place + 2
        column = row + 2 * s
        place += 2 + 4 * s
        for i in range(m):
            total = complex(0.0, 0.0)
            for j in range(s):
                total += complex(options[row + j], options[row + s + j]) * residual[j, w.independent[i]]
            x[i] = total
        solve_system(f, w, options, memory, s, k, x)
        twice = 1.0 if k < n_real else 2.0
        for j in range(s):
            re, im = options[column + j], options[column + s + j]
            for i in range(m):
                d[j, w.independent[i]] += twice * (re * x[i].real - im * x[i].imag)
    for j in range(s):
        for i in w.independent:
            residual[j, i] = d[j, i]
            A_stage[j, i] += d[j, i]
