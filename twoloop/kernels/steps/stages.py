"""Common parts of implicit Runge-Kutta steps: parameters, prediction of stages, error at jumps, memory.

To compile implicit steps takes a third of the time of the first run, so they are loaded when needed (`LazyStep`).
"""

from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.control.step_size import commit_nothing
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, allowed, compiled, inlined, kernel, merged
from twoloop.kernels.data.indices import NOT_LOADED

FARTHEST = 3.0  # largest step ratio over which the old stage polynomial is extrapolated
# weight of `end_error` beside Richardson's estimate, because it is meant for jumps between ends and stages only
END_ERROR_WEIGHT = 0.01

# indices in `options`: scalars, then A (s, s), A A (s, s), b (s), b A (s), c (s) and two rows (s) for `end_error`.
# EXTRAPOLATION: 1 / (2^order - 1), or 0: no extrapolation; POWER: order - 1
STAGES, INNER_TOL, OUTER_TOL, EXTRAPOLATION, OUTER_TEST, POWER, N_SCALARS = range(7)


def options_array(
    A: ArrayLike,
    b: ArrayLike,
    c: ArrayLike,
    inner_tol: float,
    outer_tol: float,
    extrapolation: float,
    outer_test: float = 1.0,
    power: float = 0.0,
) -> NDArray[np.float64]:
    """Return the parameter block that `tableau_of` reads; `outer_test` = 1: test (32) covers dependents, too."""
    A, b, c = np.asarray(A), np.asarray(b), np.asarray(c)
    scalars = np.array([float(len(b)), inner_tol, outer_tol, extrapolation, outer_test, power])
    rows = (b, b @ A, c, _lagrange(c, 0.0), _lagrange(c, 1.0))
    return np.concatenate([scalars, A.ravel(), (A @ A).ravel(), *rows])


def _lagrange(nodes: NDArray[np.float64], x: float) -> NDArray[np.float64]:
    """Return the weights of values at distinct nodes in their interpolating polynomial at x."""
    factors = (x - nodes[None, :]) / (nodes[:, None] - nodes[None, :] + np.eye(len(nodes)))
    np.fill_diagonal(factors, 1.0)
    return np.asarray(factors.prod(axis=1))


@inlined
def tableau_of(options):
    """Return views of the parameter block: s, A, A A, b, b A, c."""
    s = int(options[STAGES])
    o = N_SCALARS
    A = options[o : o + s * s].reshape((s, s))
    A2 = options[o + s * s : o + 2 * s * s].reshape((s, s))
    o += 2 * s * s
    return s, A, A2, options[o : o + s], options[o + s : o + 2 * s], options[o + 2 * s : o + 3 * s]


@merged
def middle_node(c):
    """Return the node nearest to the middle."""
    nearest = 0
    for j in range(c.size):
        if abs(c[j] - 0.5) < abs(c[nearest] - 0.5):
            nearest = j
    return c[nearest]


@compiled
def interpolate(c, theta, A_stage, weights, a):
    """Evaluate the polynomial through (c_j, A_stage_j) at theta."""
    s = c.size
    for j in range(s):
        product = 1.0
        for k in range(s):
            if k != j:
                product *= (theta - c[k]) / (c[j] - c[k])
        weights[j] = product
    for m in range(a.size):
        total = 0.0
        for j in range(s):
            total += weights[j] * A_stage[j, m]
        a[m] = total


@compiled
def end_error(tolerances, options, h, state, new_state, A_stage):
    """Estimate the error of a step from the polynomial through the stage accelerations, over (26).

    The accelerations of the stages differ by w, a term of order h. At an end of the step the polynomial through them is
    off by a term of order h^s. If each order is smaller by the same factor f, the term of the method's own order is h w
    f^(order - 1). At a jump of the force terms do not become smaller, and the error is h w: steps shrink until the jump
    does not matter. This includes jumps between an end and its nearest stage. The estimate must not be used alone: the
    one term may pass through zero, and on pendulums errors of single steps then were 100 tolerances.
    """
    s, n = A_stage.shape
    place = N_SCALARS + 2 * s * s + 3 * s
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n]
    top = 0.0
    for m in range(n):
        low, high = A_stage[0, m], A_stage[0, m]
        start, end = -a[m], -a1[m]
        for j in range(s):
            value = A_stage[j, m]
            low, high = min(low, value), max(high, value)
            start += options[place + j] * value
            end += options[place + s + j] * value
        width, missed = high - low, max(abs(start), abs(end))
        error = h * max(width, missed)
        if missed < width:
            error *= (missed / width) ** (options[POWER] / (s - 1.0))
        scale = allowed(tolerances, m, v[m], v1[m])
        top = max(top, error / scale)
        scale = allowed(tolerances, m, q[m], q1[m])
        top = max(top, h * error / scale)
    return top


# `options` of Newton's method: the parameter block above, then these scalars, the weights e (s) of the estimate, and
# for each eigenvalue its real and imaginary part, its row of T^-1 and its column of T (s real, s imaginary parts each).
# VELOCITIES: 1 if the error of velocities is tested, too
N_REAL, N_PAIRS, GAMMA0, VELOCITIES, N_EIGEN_SCALARS = range(5)

# indices in `memory`
(
    HAS_TRIAL,
    H_TRIAL,
    HAS_PREVIOUS,
    H_PREVIOUS,
    HAS_JACOBIAN,
    FRESH,  # 1: the derivatives are those of the present state
    PARTITION_NUMBER,
    H_FACTORED,
    CONTRACTION,  # contraction of the last iteration
    DAMPED,  # 0: forces do not depend on v
    SYMMETRIC,  # 1: the matrix of diagonal_step.py was factored as a symmetric one
    DURATION,  # s: how long an error of velocity lasts, see velocity_errors.py; 0: not known
    CHANGED,  # 1: diagonal_step.py has computed new derivatives at the end of the step
    N_MEMORY_SCALARS,
) = range(14)
PREVIOUS, TRIAL, RESIDUAL, Q_STAGE, V_STAGE, N_BLOCKS = range(6)
A_NEW, Q_MOVED, V_MOVED, E_Q, E_V, Q_MID, V_MID, A_MID, N_VECTORS = range(9)
# parts of w.matrices, of n_q^2 numbers each; from SYSTEMS on a complex pair for each eigenvalue
BY_Q, BY_V, FILTER, SYSTEMS = range(4)


def newton_options(
    A: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], velocities: bool
) -> NDArray[np.float64]:
    """Return the part of `options` that follows that of stages.py; A has a basis of eigenvectors.

    velocities : whether the error of velocities is tested.
    """
    values, T = np.linalg.eig(A)
    inverse = np.linalg.inv(T)
    real = [k for k in range(len(b)) if values[k].imag == 0.0]
    pairs = [k for k in range(len(b)) if values[k].imag > 0.0]
    gamma0 = float(values[real[0]].real) if real else float(np.abs(values).min())
    parts: list[Any] = [[len(real), len(pairs), gamma0, float(velocities)], _estimate_weights(b, c, gamma0)]
    for k in real + pairs:
        row, column = inverse[k], T[:, k]
        parts += [[values[k].real, values[k].imag], row.real, row.imag, column.real, column.imag]
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def _estimate_weights(b: NDArray[np.float64], c: NDArray[np.float64], gamma0: float) -> NDArray[np.float64]:
    """Return weights e: gamma0 f(y_n) + sum_j e_j f(Y_j) is a quadrature of order s less that of the method.

    Hairer & Wanner II, (IV.8.16). With c_1 = 0 the stages already contain f(y_n): then the last stage is left out.
    """
    s = len(b)
    moments = 1.0 / np.arange(1.0, s + 1.0)
    if c[0] > 1e-10:
        moments[0] -= gamma0
        embedded = np.linalg.solve(np.vander(c, increasing=True).T, moments)
    else:
        embedded = np.zeros(s)
        embedded[:-1] = np.linalg.solve(np.vander(c[:-1], increasing=True).T, moments[:-1])
        embedded[0] -= gamma0
    return np.asarray(embedded - b)


def memory_size(n_eigenvalues: int, s: int, n_q: int) -> int:
    """Return the length of `memory`: scalars, blocks, vectors, pivots, two complex vectors, weights."""
    return N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + 5 + n_eigenvalues) * n_q + s


def n_matrices(n_eigenvalues: int) -> int:
    """Return the number of spaces of n_q^2 numbers that w.matrices needs."""
    return SYSTEMS + 2 * n_eigenvalues


# `options` are those of a Newton method of one stage, A = [[gamma]]; then the number of stages, A, c, b - b^ and
# `lower` of this method, and 1 if steps with an error estimate continue from the embedded formula
PLACE = N_SCALARS + 2 + 5
TAIL = PLACE + N_EIGEN_SCALARS + 1 + 2 + 4


def diagonal_options(
    A: ArrayLike,
    c: ArrayLike,
    weights: ArrayLike,
    lower: ArrayLike,
    inner_tol: float,
    outer_tol: float,
    velocities: bool,
    embedded: bool,
) -> NDArray[np.float64]:
    """Return the parameter block: A (s, s) has zeros in its first row, then gamma on the diagonal; b is its last row.

    `lower`: weights of the estimate for accelerations that jump. `embedded`: the embedded formula has the higher order,
    and steps continue from it.
    """
    A, c, weights, lower = (np.asarray(x, dtype=np.float64) for x in (A, c, weights, lower))
    gamma = A[-1, -1]
    one_stage = options_array([[gamma]], [1.0], [1.0], inner_tol, outer_tol, 0.0)
    newton = np.array([1.0, 0.0, gamma, float(velocities), 0.0, gamma, 0.0, 1.0, 0.0, 1.0, 0.0])
    return np.concatenate([one_stage, newton, [float(c.size)], A.ravel(), c, weights, lower, [float(embedded)]])


def diagonal_memory(s: int, n_q: int) -> NDArray[np.float64]:
    """Allocate `memory`: that of a Newton method of one stage, then velocities and accelerations (s, n_q).

    Last come the accelerations (n_q) of the last stage of the last accepted step.
    """
    return np.zeros(memory_size(1, 1, n_q) + (2 * s + 1) * n_q)


@merged
def eigen_place(s):
    """Return the first place of the eigenvalue scalars."""
    return N_SCALARS + 2 * s * s + 5 * s


@merged
def count_eigenvalues(options, s):
    """Return the number of systems: one for each real eigenvalue and one for each pair."""
    place = eigen_place(s)
    return int(options[place + N_REAL] + options[place + N_PAIRS])


@inlined
def block(memory, s, n, which):
    """Return a view of a stage block, (s, n)."""
    start = N_MEMORY_SCALARS + which * s * n
    return memory[start : start + s * n].reshape((s, n))


@inlined
def vector(memory, s, n, which):
    """Return a view of a vector, (n)."""
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + which) * n
    return memory[start : start + n]


@inlined
def space(w, n, which):
    """Return the space of one matrix, (n^2)."""
    return w.matrices[which * n * n : (which + 1) * n * n]


@inlined
def square(numbers, m):
    """Return the first m^2 numbers of a space as a matrix."""
    return numbers[: m * m].reshape((m, m))


@inlined
def system_space(w, n, k):
    """Return the space of the k-th eigenvalue's system, complex (n^2)."""
    start = (SYSTEMS + 2 * k) * n * n
    return w.matrices[start : start + 2 * n * n].view(np.complex128)


@inlined
def _tail(memory, s, n, k):
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + k) * n
    return memory[start : start + 2 * n]


@inlined
def pivots_of(memory, s, n, k):
    """Return the row exchanges (n integers) of the filter (k = 0), or of the system of eigenvalue k - 1."""
    return _tail(memory, s, n, k)[:n].view(np.int64)


@inlined
def complex_vector(memory, s, n, n_eigen, which):
    """Return a complex scratch vector (n); `which` is 0 or 1."""
    return _tail(memory, s, n, 1 + n_eigen + 2 * which).view(np.complex128)


@kernel(ATTEMPT)
def stop_to_load(f, w, options, memory, t, h, tolerances, state, new_state):
    """Return NOT_LOADED, which stops the run, so that its caller loads the step."""
    return Attempt(NOT_LOADED, np.inf, 0.0)


PLACEHOLDER = Step(stop_to_load, commit_nothing)


class LazyStep(NamedTuple):
    """Reference to a step that is not imported yet: its module, such as "steps.newton_step", and its name there."""

    module: str
    name: str


LOADED: dict[LazyStep, Step] = {}


def loaded(step: Any) -> Any:
    """Return a step; import its module first if it is a LazyStep."""
    if isinstance(step, LazyStep) and step not in LOADED:
        LOADED[step] = getattr(import_module(f"twoloop.kernels.{step.module}"), step.name)
    return without_loading(step)


def without_loading(step: Any) -> Any:
    """Return a step, or the placeholder if it is a LazyStep that nothing has loaded yet."""
    return LOADED.get(step, PLACEHOLDER) if isinstance(step, LazyStep) else step
