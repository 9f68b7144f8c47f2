"""LAPACK's banded factorizations, of the library that SciPy brings, called from compiled code.

Addresses differ from process to process and kernels are kept on disk, so no address is compiled in: `addresses` are
put into the workspace once a run, and `call` takes one of them. (Numba has LAPACK only for dense matrices and with
allocation.)
"""

import scipy.linalg.cython_lapack
from llvmlite import ir
from numba import types
from numba.extending import get_cython_function_address, intrinsic

from twoloop.kernels.compile.private import cgutils

# places in `addresses`: Cholesky of a banded matrix and its solve, LU with row exchanges real and complex
ROUTINES = ("dpbtrf", "dpbtrs", "dgbtrf", "dgbtrs", "zgbtrf", "zgbtrs")
DPBTRF, DPBTRS, DGBTRF, DGBTRS, ZGBTRF, ZGBTRS, N_ROUTINES = range(7)

UPPER, NO_TRANSPOSE = ord("U"), ord("N")


def addresses() -> list[int]:
    """Where the ROUTINES are in this process.

    Raises
    ------
    ImportError
        If this SciPy's LAPACK has other than 32-bit integers.
    """
    for name in ROUTINES:
        signature = repr(scipy.linalg.cython_lapack.__pyx_capi__[name])
        if "(int *" not in signature and "(char *, int *" not in signature:
            raise ImportError(f"scipy.linalg.cython_lapack.{name} must take 32-bit integers; it is {signature}")
    return [get_cython_function_address("scipy.linalg.cython_lapack", name) for name in ROUTINES]


@intrinsic
def call(typing_context, address, arguments):
    """Call the routine at `address` with Fortran's conventions; its last argument, `info`, is added and returned.

    `arguments` is a tuple of arrays, given by their first element, and of integers, given by a 32-bit copy, which
    stands for a character too (the machines that numba knows have the low byte first).
    """

    def generate(context, builder, signature, values):
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
        function = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t] * len(pointers))
        builder.call(builder.inttoptr(routine, function.as_pointer()), pointers)
        return builder.sext(builder.load(info), ir.IntType(64))

    return types.int64(address, arguments), generate
