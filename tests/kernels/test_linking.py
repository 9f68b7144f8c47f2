"""How helpers get into kernels."""

import numba
from numba import types

from twoloop.kernels.compile.linking import KernelCompiler
from twoloop.kernels.data.common import OPTIONS, compiled, merged


@compiled
def _long(x):
    return 2.0 * x + 1.0


@merged
def _short(x):
    return _long(x) + _long(x + 1.0)


def _code(helper):
    return helper.overloads[(types.float64,)].library.get_llvm_str()


def test_what_a_merged_helper_calls_is_not_merged():
    kernel = numba.njit("f8(f8)", pipeline_class=KernelCompiler, **OPTIONS)(lambda x: _short(x))
    assert kernel(1.0) == 8.0
    assert "alwaysinline" in _code(_short)
    assert "alwaysinline" not in _code(_long)
