"""Factor and solve banded matrices by LAPACK: the mass matrix, and Newton matrices with a border of constraints.

In LAPACK's band storage, entry (i, j) of a matrix is entry [j, top + i - j] of a C-ordered array. For the upper
triangle of the mass matrix M, top is the bandwidth b. For an LU, top is 2 b: row exchanges fill b more diagonals.

The LAPACK library comes with SciPy. Kernels are stored on disk, but addresses of LAPACK routines differ from process to
process, and must not be part of compiled code. So a run stores `lapack_addresses` in the workspace `w`, and passes an
address to `call_lapack`. (Numba calls LAPACK only for dense matrices, and allocates memory.) `f` is the kit.
"""

import numpy as np
import scipy.linalg.cython_lapack
from llvmlite import ir
from numba import types
from numba.extending import get_cython_function_address, intrinsic

from twoloop.kernels.compile.linking import cgutils
from twoloop.kernels.data.common import compiled, inlined, merged
from twoloop.kernels.data.indices import DONE, MASS_NOT_DEFINITE, SINGULAR
from twoloop.kernels.linalg.dense import lu_factor, lu_solve

# names of LAPACK routines for banded matrices, and their indices in `lapack_addresses`: Cholesky factorization (dpbtrf)
# and solution with its factor (dpbtrs); LU factorization (..trf) and solution (..trs), real (dgb) and complex (zgb)
ROUTINES = ("dpbtrf", "dpbtrs", "dgbtrf", "dgbtrs", "zgbtrf", "zgbtrs")
DPBTRF, DPBTRS, DGBTRF, DGBTRS, ZGBTRF, ZGBTRS, N_ROUTINES = range(7)

UPPER, NO_TRANSPOSE = ord("U"), ord("N")


def lapack_addresses() -> list[int]:
    """Return the addresses of the ROUTINES in this process; raise ImportError unless they take 32-bit integers."""
    for name in ROUTINES:
        signature = repr(scipy.linalg.cython_lapack.__pyx_capi__[name])
        if "(int *" not in signature and "(char *, int *" not in signature:
            raise ImportError(f"scipy.linalg.cython_lapack.{name} must take 32-bit integers; it is {signature}")
    return [get_cython_function_address("scipy.linalg.cython_lapack", name) for name in ROUTINES]


@intrinsic
def call_lapack(typing_context, address, arguments):
    """Call the LAPACK routine at `address` with `arguments` and Fortran's last argument `info`; return `info`.

    `arguments` is a tuple of arrays and integers. An array is passed as the address of its first element, an integer as
    the address of a 32-bit copy. The copy can also be read as a character, because numba's machines are little-endian.
    """

    def emit_call(context, builder, signature, values):
        routine, packed = values
        pointers = []
        for position, kind in enumerate(arguments.types):
            value = builder.extract_value(packed, position)
            if isinstance(kind, types.Array):
                pointer = context.make_array(kind)(context, builder, value).data
            else:
                pointer = cgutils.alloca_once_value(builder, builder.trunc(value, ir.IntType(32)))
            pointers.append(builder.bitcast(pointer, cgutils.voidptr_t))
        info = cgutils.alloca_once_value(builder, ir.Constant(ir.IntType(32), 0))
        pointers.append(builder.bitcast(info, cgutils.voidptr_t))
        function_type = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t] * len(pointers))
        builder.call(builder.inttoptr(routine, function_type.as_pointer()), pointers)
        return builder.sext(builder.load(info), ir.IntType(64))

    return types.int64(address, arguments), emit_call


# smallest number of coordinates for which Newton steps are assumed to be faster with banded than with dense algebra.
# The measured break-even is 36 to 75, for chains of bandwidth 1 to 11 and for beams. Single evaluations, as in a
# fixed-point iteration, are faster only above about 150 coordinates; with 56 coordinates they take a third longer
MIN_BANDED_SIZE = 56


def banded_pays(n_q: int, n_c: int, bandwidth: int) -> bool:
    """Return True if banded algebra is faster than dense algebra, and fits in the arrays for dense algebra."""
    return n_q >= max(MIN_BANDED_SIZE, 3 * bandwidth + 2 + 2 * n_c)


@merged
def has_banded_mass(f):
    """Return True if the mass matrix is factored as a banded matrix. A diagonal one is not: divisions are faster."""
    return f.bandwidth >= 0 and f.diagonal_mass == 0


@inlined
def _mass_band(w, b):
    """Return a view of w.L: band storage (bandwidth b) of the upper triangle of M, later of its Cholesky factor."""
    n = w.Q.size
    return w.L.reshape(n * n)[: n * (b + 1)].reshape((n, b + 1))


@inlined
def _mass_diagonals(w, b):
    """Return the part of w.L with the diagonals of M: M[i, i + k] is at [k, i], for k up to the bandwidth b."""
    n = w.Q.size
    return w.L.reshape(n * n)[n * (b + 1) : 2 * n * (b + 1)].reshape((b + 1, n))


@compiled
def factor_banded_mass(f, w):
    """Store in w.L the Cholesky factor of the mass matrix w.M, and a copy of the diagonals of w.M; return a code."""
    n = w.Q.size
    b = f.bandwidth
    band = _mass_band(w, b)
    for j in range(n):
        for i in range(max(0, j - b), j + 1):
            band[j, b + i - j] = w.M[j, i]
    diagonals = _mass_diagonals(w, b)
    for k in range(b + 1):
        for i in range(n - k):
            diagonals[k, i] = w.M[i, i + k]
    return DONE if call_lapack(w.lapack[DPBTRF], (UPPER, n, b, band, b + 1)) == 0 else MASS_NOT_DEFINITE


@merged
def solve_banded_mass(f, w, x):
    """Replace x (n_q) by M^-1 x, using the Cholesky factor that `factor_banded_mass` stored."""
    n = w.Q.size
    b = f.bandwidth
    call_lapack(w.lapack[DPBTRS], (UPPER, n, b, 1, _mass_band(w, b), b + 1, x, n))


@compiled
def add_banded_mass_times(f, w, x, y):
    """Add M x to y in place, diagonal by diagonal, because loops over the short rows of the band of M would be slow."""
    n = w.Q.size
    for i in range(n):
        y[i] += w.M[i, i] * x[i]
    if f.diagonal_mass == 1:
        return
    b = f.bandwidth
    diagonals = _mass_diagonals(w, b)
    for k in range(1, b + 1):
        for i in range(n - k):
            y[i] += diagonals[k, i] * x[i + k]
        for i in range(n - k):
            y[i + k] += diagonals[k, i] * x[i]


# The bordered system [[B, Cq^T], [Cq, 0]] [x; mu] = [r; 0] occurs in Newton's method: B is a matrix of bandwidth b, and
# Cq the constraint Jacobian. The solution is mu = (Cq B^-1 Cq^T)^-1 Cq B^-1 r, x = B^-1 (r - Cq^T mu). The array
# `numbers`, real or complex, contains the LU of B; the transpose of B^-1 Cq^T; the LU of Cq B^-1 Cq^T; scratch (n_c).


@inlined
def lu_band(numbers, n, b):
    """Return the part of `numbers` with a matrix of bandwidth b or its LU; entry (i, j) is at [j, 2 b + i - j]."""
    return numbers[: n * (3 * b + 1)].reshape((n, 3 * b + 1))


@inlined
def _border_view(numbers, n, n_c, b):
    begin = n * (3 * b + 1)
    return numbers[begin : begin + n_c * n].reshape((n_c, n))


@inlined
def _schur_complement_view(numbers, n, n_c, b):
    begin = n * (3 * b + 1) + n_c * n
    return numbers[begin : begin + n_c * n_c].reshape((n_c, n_c))


@inlined
def _scratch_view(numbers, n, n_c, b):
    begin = n * (3 * b + 1) + n_c * (n + n_c)
    return numbers[begin : begin + n_c]


@compiled
def factor_bordered(w, b, Cq, numbers, pivots, factorize, substitute):
    """Factor [[B, Cq^T], [Cq, 0]] with the constraint Jacobian Cq and the banded matrix B, stored in `numbers`.

    Return DONE or SINGULAR. `factorize`, `substitute`: indices DGBTRF and DGBTRS of LAPACK routines, or ZGBTRF, ZGBTRS.
    """
    n_c, n = Cq.shape
    band = lu_band(numbers, n, b)
    exchanges = pivots[: n - n_c].view(np.int32)
    if call_lapack(w.lapack[factorize], (n, n, b, b, band, 3 * b + 1, exchanges)) != 0:
        return SINGULAR
    border = _border_view(numbers, n, n_c, b)
    for i in range(n_c):
        for j in range(n):
            border[i, j] = Cq[i, j]
    call_lapack(w.lapack[substitute], (NO_TRANSPOSE, n, b, b, n_c, band, 3 * b + 1, exchanges, border, n))
    S = _schur_complement_view(numbers, n, n_c, b)
    for i in range(n_c):
        for k in range(n_c):
            S[i, k] = 0.0
            for j in range(n):
                S[i, k] += Cq[i, j] * border[k, j]
    return DONE if lu_factor(S, pivots[n - n_c :]) > 0.0 else SINGULAR


@compiled
def solve_bordered(w, b, Cq, numbers, pivots, substitute, x):
    """Solve [[B, Cq^T], [Cq, 0]] [x; mu] = [r; 0] by the factors of `factor_bordered`; `x`: r on entry, x on return."""
    n_c, n = Cq.shape
    band, exchanges = lu_band(numbers, n, b), pivots[: n - n_c].view(np.int32)
    call_lapack(w.lapack[substitute], (NO_TRANSPOSE, n, b, b, 1, band, 3 * b + 1, exchanges, x, n))
    mu = _scratch_view(numbers, n, n_c, b)
    for i in range(n_c):
        mu[i] = 0.0
        for j in range(n):
            mu[i] += Cq[i, j] * x[j]
    lu_solve(_schur_complement_view(numbers, n, n_c, b), pivots[n - n_c :], mu)
    border = _border_view(numbers, n, n_c, b)
    for i in range(n_c):
        for j in range(n):
            x[j] -= border[i, j] * mu[i]
