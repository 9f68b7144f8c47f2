"""Define the arrays `options` and `memory` of implicit Runge-Kutta steps, and functions that these steps share.

Compiling a step takes a third of the time of the first run. So a run imports only the steps that it needs (`LazyStep`).
"""

from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.control.step_size import commit_nothing
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, allowed_error, compiled, inlined, kernel, merged
from twoloop.kernels.data.indices import NOT_LOADED

MAX_STEP_RATIO = 3.0  # stages are extrapolated from the last step if (new step size) / (last step size) is at most this
# Richardson's estimate, which compares a step with two half steps, misses a force that jumps near an end of the step.
# So the larger one of Richardson's estimate and END_ERROR_WEIGHT * (result of `estimate_end_error`) is used
END_ERROR_WEIGHT = 0.01

# indices of the scalars in `options` of a method with s stages and the Butcher tableau A, b, c. After the scalars,
# `options` contains A and A @ A (s, s each), b, b @ A and c (s each), and the weights (s each) with which values at the
# nodes c are extrapolated to the beginning and to the end of the step
(
    STAGES,  # number of stages s
    INNER_TOL,  # tolerance of the inner loop
    OUTER_TOL,  # tolerance of the outer loop
    EXTRAPOLATION,  # factor 1 / (2^order - 1) in Richardson's extrapolation of the new state; 0: no extrapolation
    OUTER_TEST,  # 1: the outer loop ends when all coordinates have converged; 0: when independent coordinates have
    POWER,  # order of the method minus 1, an exponent in `estimate_end_error`
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
    """Return the array `options` of a method; A, b, c: Butcher tableau; other arguments: see INNER_TOL to POWER."""
    A, b, c = np.asarray(A), np.asarray(b), np.asarray(c)
    scalars = np.array([float(len(b)), inner_tol, outer_tol, extrapolation, outer_test, power])
    vectors = (b, b @ A, c, lagrange_values(c, 0.0), lagrange_values(c, 1.0))
    return np.concatenate([scalars, A.ravel(), (A @ A).ravel(), *vectors])


def lagrange_values(nodes: NDArray[np.float64], x: ArrayLike) -> NDArray[np.float64]:
    """Return the values (..., s) at x (...) of the Lagrange polynomials of distinct `nodes` (s)."""
    same = np.eye(len(nodes))
    factors = (np.asarray(x)[..., None, None] - nodes) / (nodes[:, None] - nodes + same)
    return np.asarray(np.where(same, 1.0, factors).prod(axis=-1))


@inlined
def tableau_of(options):
    """Return s, the number of stages, and views of `options`: A, A @ A, b, b @ A and c of the Butcher tableau."""
    s = int(options[STAGES])
    o = N_SCALARS
    A = options[o : o + s * s].reshape((s, s))
    A2 = options[o + s * s : o + 2 * s * s].reshape((s, s))
    o += 2 * s * s
    return s, A, A2, options[o : o + s], options[o + s : o + 2 * s], options[o + 2 * s : o + 3 * s]


@merged
def middle_node(c):
    """Return the entry of c (s), the nodes of a Butcher tableau, that is nearest to 1/2."""
    nearest = 0
    for j in range(c.size):
        if abs(c[j] - 0.5) < abs(c[nearest] - 0.5):
            nearest = j
    return c[nearest]


@compiled
def interpolate(c, theta, A_stage, weights, a):
    """Interpolate stage accelerations A_stage (s, n) from the nodes c (s) to the time theta; store the result in a (n).

    Nodes and theta are times relative to the step size. `weights` (s) is scratch.
    """
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
    """Estimate the error of a step, in units of the tolerances (eq. 26), from the stage accelerations A_stage (s, n).

    The estimate detects forces that jump within a step, even between an end and the nearest stage. Let w be the range
    of the stage accelerations, and e the error of their interpolation polynomial at the ends of the step, where the
    accelerations are known. In smooth motion, successive terms of the polynomial have a constant ratio f: so
    e = w f^(s - 1) yields f, and the error of the method is about h w f^(order - 1), which is the estimate. If a force
    jumps, e is as large as w, and the estimate becomes h w: steps shrink until the jump no longer matters. Methods also
    need a second estimate: e may be zero by chance although errors are up to 100 tolerances.
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


# indices of the scalars in the part of `options` for Newton's method, counted from the beginning of this part. The
# weights (s) of the error estimate follow. Then, for each eigenvalue of the tableau's matrix A, the part contains its
# real and imaginary part, a row of X^-1 and a column of X, where the columns of X are the eigenvectors of A. A row or
# a column is stored as s real parts, then s imaginary parts
(
    N_REAL,  # number of real eigenvalues of the matrix A of the Butcher tableau
    N_PAIRS,  # number of pairs of conjugate complex eigenvalues of the matrix A of the Butcher tableau
    GAMMA0,  # constant of the error filter: first real eigenvalue of the tableau's A; if none is real, min |eigenvalue|
    TESTS_VELOCITIES,  # 1: limit estimated velocity errors; 0: limit their effects on coordinates, see `velocity_error`
    N_EIGEN_SCALARS,
) = range(5)

# indices of the scalars in `memory`, the array in which a method keeps data from step to step
(
    HAS_TRIAL,  # 1: a step was attempted, with stage accelerations in TRIAL (except in diagonal_step.py); 0: no step
    H_TRIAL,  # size of the last attempted step (s)
    HAS_PREVIOUS,  # 1: the block PREVIOUS contains the stage accelerations of the last accepted step; 0: it is empty
    H_PREVIOUS,  # size of the last accepted step (s)
    HAS_JACOBIAN,  # 1: Newton's method may use the stored derivatives of accelerations or forces; 0: compute new ones
    IS_FRESH,  # 1: the stored derivatives belong to the stages of this step; 0: to earlier stages, or to a step's end
    PARTITION_NUMBER,  # value of w.generation, which counts partitions, when the stored derivatives were computed
    H_FACTORED,  # step size (s) for which the linear systems of Newton's method are factored; 0: no factors are stored
    CONTRACTION,  # (last correction of Newton's method) / (the correction before it)
    HAS_DAMPING,  # 1: forces depend on velocities; 0: they do not, so that derivatives by velocities are zero
    IS_SYMMETRIC,  # 1: Newton's matrix in diagonal_step.py is symmetric, and factored as L D L^T; 0: factored as L U
    ERROR_DURATION,  # time (s) until a velocity error decays or changes its sign, see velocity_errors.py; 0: unknown
    DERIVATIVES_RENEWED,  # 1: diagonal_step.py has computed new derivatives at the end of the step; 0: it has not
    N_MEMORY_SCALARS,
) = range(14)
# indices of the blocks (s, n_q) in `memory`. PREVIOUS, TRIAL: stage accelerations of the last accepted and of the
# attempted step. RESIDUAL: residuals of Newton's method. Q_STAGE, V_STAGE: positions and velocities of the stages
PREVIOUS, TRIAL, RESIDUAL, Q_STAGE, V_STAGE, N_BLOCKS = range(6)
# indices of the vectors (n_q) after the blocks. A_NEW, Q_MOVED, V_MOVED: accelerations, positions and velocities of a
# displaced state, for finite differences. E_Q, E_V: estimated errors of positions and of velocities. Q_MID, V_MID,
# A_MID: positions, velocities and accelerations of the middle stage
A_NEW, Q_MOVED, V_MOVED, E_Q, E_V, Q_MID, V_MID, A_MID, N_VECTORS = range(9)
# indices of the parts of w.matrices, n_q^2 numbers each. The matrices are defined in newton_systems.py: J_q and J_v
# (derivatives of accelerations by q and v), K and D (derivatives of forces by q and v), T (velocities v = T v_i)
# - DERIVATIVE_Q: J_q. In banded storage: the band of K, rows of C_q and their null space. In diagonal_step.py: T^T K T
# - DERIVATIVE_V: J_v. In banded storage: the band of D. In diagonal_step.py: T^T D T
# - FILTER: factors of the real matrix with which error estimates are filtered
# - SYSTEMS: for each eigenvalue of the tableau's A, factors of a complex matrix (2 parts). In diagonal_step.py: T^T M T
DERIVATIVE_Q, DERIVATIVE_V, FILTER, SYSTEMS = range(4)


def newton_options(
    A: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], tests_velocities: bool
) -> NDArray[np.float64]:
    """Return the part of `options` for Newton's method (see N_REAL), with the eigenvalues of the tableau's matrix A.

    A, b, c: Butcher tableau; A must be diagonalizable. `tests_velocities`: value of TESTS_VELOCITIES.
    """
    values, vectors = np.linalg.eig(A)
    inverse = np.linalg.inv(vectors)
    reals = [k for k in range(len(b)) if values[k].imag == 0.0]
    pairs = [k for k in range(len(b)) if values[k].imag > 0.0]
    gamma0 = float(values[reals[0]].real) if reals else float(np.abs(values).min())
    parts: list[Any] = [[len(reals), len(pairs), gamma0, float(tests_velocities)], _error_weights(b, c, gamma0)]
    for k in reals + pairs:
        row, column = inverse[k], vectors[:, k]
        parts += [[values[k].real, values[k].imag], row.real, row.imag, column.real, column.imag]
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def _error_weights(b: NDArray[np.float64], c: NDArray[np.float64], gamma0: float) -> NDArray[np.float64]:
    """Return the s weights e of the embedded error estimate h (gamma0 f(y_n) + sum_j e_j f(Y_j)) of a step.

    f: right-hand side of y' = f(y). y_n: state at the beginning of the step. Y_j: stages. The estimate is the
    difference between an embedded quadrature of order s and the method with weights b and nodes c (Hairer & Wanner II,
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
    """Return the length of `memory` with s stages and `n_systems` linear systems (see `count_systems`)."""
    return N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + 5 + n_systems) * n_q + s


def n_matrices(n_systems: int) -> int:
    """Return the number of matrices (n_q, n_q) in w.matrices for `n_systems` linear systems, see SYSTEMS."""
    return SYSTEMS + 2 * n_systems


# `options` of a diagonally implicit method begins like `options` of an implicit method of one stage, with the matrix
# A = [[gamma]] and the part for Newton's method (see N_REAL) at the index NEWTON_OFFSET. At the index DIAGONAL_OFFSET,
# the number of stages follows, then the arguments A, c, `weights`, `jump_weights`, `embedded` of `diagonal_options`
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
    """Return the array `options` of a diagonally implicit method with the Butcher tableau A (s, s), c (s).

    The first row of A is zero, the other diagonal entries are gamma, and the last row is b, the weights of the method.
    `weights` (s): b minus the weights of the embedded formula. `jump_weights` (s): weights of the stage accelerations
    in the error estimate for accelerations that jump. `embedded`: True if, under step-size control, steps end at
    the result of the embedded formula, which has a higher order.
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
    """Return the index in `options` at which the part for Newton's method (see N_REAL) begins, for s stages."""
    return N_SCALARS + 2 * s * s + 5 * s


@merged
def count_systems(options, s):
    """Return the number of linear systems of Newton's method: N_REAL + N_PAIRS eigenvalues of the tableau's A."""
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
    """Return a complex view (n^2) of the two parts of w.matrices for eigenvalue k of the tableau's A, see SYSTEMS."""
    start = (SYSTEMS + 2 * k) * n * n
    return w.matrices[start : start + 2 * n * n].view(np.complex128)


@inlined
def _storage_after_vectors(memory, s, n, k):
    """Return a view of 2 n numbers of `memory`, from k * n numbers after the end of the vectors A_NEW to A_MID."""
    start = N_MEMORY_SCALARS + (N_BLOCKS * s + N_VECTORS + k) * n
    return memory[start : start + 2 * n]


@inlined
def pivots_of(memory, s, n, k):
    """Return the pivot indices (n) of the matrix in `filter_error` (k = 0), or of linear system k - 1 (k > 0)."""
    return _storage_after_vectors(memory, s, n, k)[:n].view(np.int64)


@inlined
def complex_vector(memory, s, n, n_systems, index):
    """Return a view (n) of complex scratch vector `index` (0 or 1) in `memory`, for `n_systems` linear systems."""
    return _storage_after_vectors(memory, s, n, 1 + n_systems + 2 * index).view(np.complex128)


@kernel(ATTEMPT)
def request_loading(f, w, options, memory, t, h, tolerances, state, new_state):
    """Take no step, and return NOT_LOADED; then the caller loads the machine code of the method, and tries again."""
    return Attempt(NOT_LOADED, np.inf, 0.0)


PLACEHOLDER_STEP = Step(request_loading, commit_nothing)


class LazyStep(NamedTuple):
    """Reference to a Step that is imported when needed: name of the Step and of its module ("steps.newton_step")."""

    module: str
    name: str


LOADED_STEPS: dict[LazyStep, Step] = {}  # steps whose modules have been imported so far


def load_step(step: Any) -> Any:
    """Return the Step to which a LazyStep refers, after importing the module of this Step; return a Step unchanged."""
    if isinstance(step, LazyStep) and step not in LOADED_STEPS:
        LOADED_STEPS[step] = getattr(import_module(f"twoloop.kernels.{step.module}"), step.name)
    return step_if_loaded(step)


def step_if_loaded(step: Any) -> Any:
    """Return the Step to which a LazyStep refers (PLACEHOLDER_STEP if not imported yet); return a Step unchanged."""
    return LOADED_STEPS.get(step, PLACEHOLDER_STEP) if isinstance(step, LazyStep) else step
