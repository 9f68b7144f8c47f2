"""Common parts of implicit Runge-Kutta steps: `options`, prediction of stages, error at jumps, layout of `memory`.

Compiling the implicit steps takes a third of the time of the first run, so each is loaded when needed (`LazyStep`).
"""

from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.control.step_size import commit_nothing
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, allowed_error, compiled, inlined, kernel, merged
from twoloop.kernels.data.indices import NOT_LOADED

MAX_STEP_RATIO = 3.0  # the previous step's polynomial predicts the stages of a step at most this multiple as long
END_ERROR_WEIGHT = 0.01  # factor on `estimate_end_error` beside Richardson's estimate, which misses jumps at ends only

# indices of the scalars in `options`. After the scalars, `options` contains A and A @ A (s, s each), b, b @ A and c (s
# each), and the weights (s each) that extrapolate from the nodes to 0 and to 1
(
    STAGES,  # number of stages s
    INNER_TOL,  # tolerance of the inner loop
    OUTER_TOL,  # tolerance of the outer loop
    EXTRAPOLATION,  # 1 / (2^order - 1); 0: no extrapolation
    OUTER_TEST,  # 1: test (32) of the paper also covers dependent coordinates; 0: only independent ones
    POWER,  # order - 1
    N_SCALARS,
) = range(7)


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
    """Return the array `options` of an implicit Runge-Kutta method with the tableau A, b, c; see STAGES etc. above."""
    A, b, c = np.asarray(A), np.asarray(b), np.asarray(c)
    scalars = np.array([float(len(b)), inner_tol, outer_tol, extrapolation, outer_test, power])
    vectors = (b, b @ A, c, lagrange_values(c, 0.0), lagrange_values(c, 1.0))
    return np.concatenate([scalars, A.ravel(), (A @ A).ravel(), *vectors])


def lagrange_values(nodes: NDArray[np.float64], x: float) -> NDArray[np.float64]:
    """Return the values (s) at x of the Lagrange polynomials of distinct `nodes` (s)."""
    factors = (x - nodes[None, :]) / (nodes[:, None] - nodes[None, :] + np.eye(len(nodes)))
    np.fill_diagonal(factors, 1.0)
    return np.asarray(factors.prod(axis=1))


@inlined
def tableau_of(options):
    """Return the number of stages s, and views of `options`: A, A @ A, b, b @ A, c."""
    s = int(options[STAGES])
    o = N_SCALARS
    A = options[o : o + s * s].reshape((s, s))
    A2 = options[o + s * s : o + 2 * s * s].reshape((s, s))
    o += 2 * s * s
    return s, A, A2, options[o : o + s], options[o + s : o + 2 * s], options[o + 2 * s : o + 3 * s]


@merged
def middle_node(c):
    """Return the node of a tableau, an entry of c (s), that is nearest to 1/2."""
    nearest = 0
    for j in range(c.size):
        if abs(c[j] - 0.5) < abs(c[nearest] - 0.5):
            nearest = j
    return c[nearest]


@compiled
def interpolate(c, theta, A_stage, weights, a):
    """Store in a (n) the value at theta of the polynomial through the points (c_j, A_stage[j]); overwrite `weights`."""
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
def estimate_end_error(tolerances, options, h, state, new_state, A_stage):
    """Estimate the error of a step, in units of the tolerances (eq. 26), from the stage accelerations (s, n).

    The stage accelerations have a range w of order h. At the ends of the step, the polynomial through the stages
    differs from the accelerations by e, of order h^s. If terms of successive orders decrease by a constant factor f,
    then e = w f^(s - 1), and the error of the method is h w f^(order - 1). If the force jumps, even between an end of
    the step and the nearest stage, the terms do not decrease, and the estimate is h w: steps then shrink until the jump
    no longer matters. Methods need a second estimate, too: e may pass through zero, with errors up to 100 tolerances.
    """
    s, n = A_stage.shape
    offset = N_SCALARS + 2 * s * s + 3 * s
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n]
    largest = 0.0
    for m in range(n):
        low, high = A_stage[0, m], A_stage[0, m]
        start, end = -a[m], -a1[m]
        for j in range(s):
            value = A_stage[j, m]
            low, high = min(low, value), max(high, value)
            start += options[offset + j] * value
            end += options[offset + s + j] * value
        width, mismatch = high - low, max(abs(start), abs(end))
        error = h * max(width, mismatch)
        if mismatch < width:
            error *= (mismatch / width) ** (options[POWER] / (s - 1.0))
        scale = allowed_error(tolerances, m, v[m], v1[m])
        largest = max(largest, error / scale)
        scale = allowed_error(tolerances, m, q[m], q1[m])
        largest = max(largest, h * error / scale)
    return largest


# indices of the scalars that newton_options adds to `options`, counted from `newton_options_index`. After them,
# `options` contains the weights e (s) of the error estimate and then, for each eigenvalue of A = T diag(eigenvalues)
# T^-1: its real and imaginary part, its row of T^-1 and its column of T (of both, s real parts, then s imaginary parts)
(
    N_REAL,  # number of real eigenvalues of A
    N_PAIRS,  # number of pairs of complex eigenvalues
    GAMMA0,  # first real eigenvalue or, if there is none, smallest absolute value of an eigenvalue
    TESTS_VELOCITIES,  # 1: the error test includes velocities
    N_EIGEN_SCALARS,
) = range(5)

# indices of the scalars in `memory`
(
    HAS_TRIAL,  # 1: TRIAL contains the stage accelerations of the last attempt; diagonal_step.py: an attempt was made
    H_TRIAL,  # step size of the last attempt (s)
    HAS_PREVIOUS,  # 1: the block PREVIOUS contains the stage accelerations of the last accepted step
    H_PREVIOUS,  # size of the last accepted step (s)
    HAS_JACOBIAN,  # 1: the stored derivatives may be used
    IS_FRESH,  # 1: the stored derivatives were computed for this step; 0: for an earlier step, or at the step's end
    PARTITION_NUMBER,  # number (GENERATION in data/indices.py) of the partition that the stored derivatives belong to
    H_FACTORED,  # step size in the factored systems (s); 0: none are factored
    CONTRACTION,  # ratio of the last two corrections of Newton's method
    HAS_DAMPING,  # 1: forces depend on v; 0: J_v and D are zero
    IS_SYMMETRIC,  # kind of factors in diagonal_step.py. 1: L D L^T of a symmetric matrix; 0: L U
    ERROR_DURATION,  # duration (s) of an error of the velocities, see velocity_errors.py; 0: unknown
    DERIVATIVES_RENEWED,  # 1: diagonal_step.py has computed new derivatives at the end of the step
    N_MEMORY_SCALARS,
) = range(14)
# indices of the blocks (s, n_q) in `memory`: stage accelerations of the previous step and of the attempted step,
# residuals, positions and velocities of the stages
PREVIOUS, TRIAL, RESIDUAL, Q_STAGE, V_STAGE, N_BLOCKS = range(6)
# indices of the vectors (n_q) after the blocks: accelerations at a displaced state, displaced positions and velocities,
# estimated errors of positions and velocities, and positions, velocities and accelerations at the middle stage
A_NEW, Q_MOVED, V_MOVED, E_Q, E_V, Q_MID, V_MID, A_MID, N_VECTORS = range(9)
# indices of the parts of w.matrices, n_q^2 numbers each, in dense and banded storage (see newton_systems.py for J_q, K)
# - DERIVATIVE_Q: J_q, or T^T K T if diagonal_step.py factors its own matrices; banded: the band of K, rows of C_q, w.D
# - DERIVATIVE_V: J_v, or T^T D T; banded: the band of D
# - FILTER: factors of the real matrix that filters errors
# - SYSTEMS: two parts for each eigenvalue of A, the factors of its complex matrix; in diagonal_step.py, T^T M T
DERIVATIVE_Q, DERIVATIVE_V, FILTER, SYSTEMS = range(4)


def newton_options(
    A: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], tests_velocities: bool
) -> NDArray[np.float64]:
    """Return the part of `options` for Newton's method, which follows the result of `options_array`; see N_REAL.

    A must be diagonalizable. `tests_velocities`: whether the error test includes velocities.
    """
    values, T = np.linalg.eig(A)
    inverse = np.linalg.inv(T)
    reals = [k for k in range(len(b)) if values[k].imag == 0.0]
    pairs = [k for k in range(len(b)) if values[k].imag > 0.0]
    gamma0 = float(values[reals[0]].real) if reals else float(np.abs(values).min())
    parts: list[Any] = [[len(reals), len(pairs), gamma0, float(tests_velocities)], _error_weights(b, c, gamma0)]
    for k in reals + pairs:
        row, column = inverse[k], T[:, k]
        parts += [[values[k].real, values[k].imag], row.real, row.imag, column.real, column.imag]
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def _error_weights(b: NDArray[np.float64], c: NDArray[np.float64], gamma0: float) -> NDArray[np.float64]:
    """Return the weights e (s) of the error estimate h (gamma0 f(y_n) + sum_j e_j f(Y_j)) with stage values Y_j.

    The estimate is the difference between an embedded quadrature of order s and the method (Hairer & Wanner II,
    (IV.8.16)). If c_1 = 0, f(Y_1) is f(y_n), and the embedded quadrature omits the last stage.
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


def memory_size(n_systems: int, s: int, n_q: int) -> int:
    """Return the length of `memory`: scalars, blocks, vectors, pivots, two complex scratch vectors, s weights."""
    return N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + 5 + n_systems) * n_q + s


def n_matrices(n_systems: int) -> int:
    """Return the number of parts of w.matrices, each with n_q^2 entries, for `n_systems` linear systems."""
    return SYSTEMS + 2 * n_systems


# `options` of a diagonally implicit method begin with the options of Newton's method for one stage, A = [[gamma]]; the
# index of N_REAL is then NEWTON_OFFSET. At DIAGONAL_OFFSET follow: number of stages, A, c, b - b^, jump weights, and 1
# if steps with an error estimate end at the result of the embedded formula, else 0 (see `diagonal_options`)
NEWTON_OFFSET = N_SCALARS + 2 + 5
DIAGONAL_OFFSET = NEWTON_OFFSET + N_EIGEN_SCALARS + 1 + 2 + 4


def diagonal_options(
    A: ArrayLike,
    c: ArrayLike,
    weights: ArrayLike,
    jump_weights: ArrayLike,
    inner_tol: float,
    outer_tol: float,
    tests_velocities: bool,
    embedded: bool,
) -> NDArray[np.float64]:
    """Return the array `options` of a diagonally implicit method with the tableau A (s, s), c (s).

    The first row of A is zero, the other diagonal entries are gamma, and the last row is b. `weights` (s): b - b^,
    where b^ are the weights of the embedded formula. `jump_weights` (s): weights of the error estimate for
    accelerations that jump. `embedded`: whether steps end at the result of the embedded formula, of higher order.
    """
    A, c, weights, jump_weights = (np.asarray(x, dtype=np.float64) for x in (A, c, weights, jump_weights))
    gamma = A[-1, -1]
    one_stage = options_array([[gamma]], [1.0], [1.0], inner_tol, outer_tol, 0.0)
    newton = np.array([1.0, 0.0, gamma, float(tests_velocities), 0.0, gamma, 0.0, 1.0, 0.0, 1.0, 0.0])
    return np.concatenate([one_stage, newton, [float(c.size)], A.ravel(), c, weights, jump_weights, [float(embedded)]])


def diagonal_memory(s: int, n_q: int) -> NDArray[np.float64]:
    """Return a new array `memory`, filled with zeros, for a diagonally implicit method with s stages.

    `memory` begins with the memory of Newton's method for one stage. The velocities and the accelerations of the stages
    (s, n_q each) follow, then the accelerations (n_q) of the last stage of the last accepted step.
    """
    return np.zeros(memory_size(1, 1, n_q) + (2 * s + 1) * n_q)


@merged
def newton_options_index(s):
    """Return the index in `options` of N_REAL, where the part by `newton_options` begins, for s stages."""
    return N_SCALARS + 2 * s * s + 5 * s


@merged
def count_systems(options, s):
    """Return the number of linear systems of Newton's method: real eigenvalues of A plus pairs of complex ones."""
    offset = newton_options_index(s)
    return int(options[offset + N_REAL] + options[offset + N_PAIRS])


@inlined
def block(memory, s, n, index):
    """Return a view (s, n) of block `index`, such as PREVIOUS, of `memory`."""
    start = N_MEMORY_SCALARS + index * s * n
    return memory[start : start + s * n].reshape((s, n))


@inlined
def vector(memory, s, n, index):
    """Return a view (n) of vector `index`, such as A_NEW, of `memory`."""
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + index) * n
    return memory[start : start + n]


@inlined
def matrix_storage(w, n, index):
    """Return a view (n^2) of part `index`, such as DERIVATIVE_Q, of w.matrices."""
    return w.matrices[index * n * n : (index + 1) * n * n]


@inlined
def as_matrix(numbers, m):
    """Return a view (m, m) of the first m^2 entries of the vector `numbers`."""
    return numbers[: m * m].reshape((m, m))


@inlined
def system_storage(w, n, k):
    """Return a complex view (n^2) of the two parts of w.matrices that store the linear system for eigenvalue k of A."""
    start = (SYSTEMS + 2 * k) * n * n
    return w.matrices[start : start + 2 * n * n].view(np.complex128)


@inlined
def _storage_after_vectors(memory, s, n, k):
    """Return a view (2 n) of `memory` that begins k * n entries behind the vectors."""
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + k) * n
    return memory[start : start + 2 * n]


@inlined
def pivots_of(memory, s, n, k):
    """Return a view (n) of `memory`: pivot indices of the filter matrix (k = 0) or of eigenvalue k - 1 (k > 0)."""
    return _storage_after_vectors(memory, s, n, k)[:n].view(np.int64)


@inlined
def complex_vector(memory, s, n, n_systems, index):
    """Return a view (n) of complex scratch vector `index` (0 or 1) of `memory`."""
    return _storage_after_vectors(memory, s, n, 1 + n_systems + 2 * index).view(np.complex128)


@kernel(ATTEMPT)
def request_loading(f, w, options, memory, t, h, tolerances, state, new_state):
    """Return an `Attempt` with the code NOT_LOADED: the caller of the kernel then loads the step, and tries again."""
    return Attempt(NOT_LOADED, np.inf, 0.0)


PLACEHOLDER_STEP = Step(request_loading, commit_nothing)


class LazyStep(NamedTuple):
    """Name of a Step and of its module in twoloop.kernels, such as "steps.newton_step", to be imported when needed."""

    module: str
    name: str


LOADED_STEPS: dict[LazyStep, Step] = {}  # steps whose modules have been imported so far


def load_step(step: Any) -> Any:
    """Return `step`; for a LazyStep, return the Step in its module, which is imported if necessary."""
    if isinstance(step, LazyStep) and step not in LOADED_STEPS:
        LOADED_STEPS[step] = getattr(import_module(f"twoloop.kernels.{step.module}"), step.name)
    return step_if_loaded(step)


def step_if_loaded(step: Any) -> Any:
    """Return `step`; for a LazyStep, return the Step in its module, or PLACEHOLDER_STEP if it is not imported yet."""
    return LOADED_STEPS.get(step, PLACEHOLDER_STEP) if isinstance(step, LazyStep) else step
