"""How helpers get into kernels, and which kernels are compiled together."""

import gc
import re
from pathlib import Path

import numba
import pytest
from numba import types

from twoloop.kernels.compile.caches import compile_kept
from twoloop.kernels.compile.linking import KernelCompiler
from twoloop.kernels.data.common import OPTIONS, compiled, merged

ROOT = Path(__file__).parents[2]
WITH_KERNELS = {
    path: path.read_text() for path in (ROOT / "twoloop" / "kernels").rglob("*.py") if "\n@kernel(" in path.read_text()
}


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


def test_make_compile_compiles_all_kernels():
    recipe = (ROOT / "Makefile").read_text().split("\ncompile: ")[1].split("\n\n")[0]
    assert {path.stem for path in WITH_KERNELS} <= set(re.findall(r"\w+", recipe))


def test_a_step_compiles_no_other_step():
    """Where one is imported for what it has beside its kernel, a first call compiles both."""
    steps = {path.stem: text for path, text in WITH_KERNELS.items() if path.parent.name in ("steps", "lanes")}
    imported = r"from twoloop\.kernels\.(?:steps|lanes)\.(\w+) import"
    found = {(name, other) for name, text in steps.items() for other in re.findall(imported, text) if other in steps}
    # the explicit step belongs to the default method, and is compiled in any case
    assert {pair for pair in found if pair[1] != "explicit_step"} == set()


@pytest.mark.parametrize("collecting", [True, False])
def test_the_collection_of_cycles_goes_on_as_it_was(collecting):
    before = gc.isenabled()
    try:
        (gc.enable if collecting else gc.disable)()
        assert compile_kept(lambda x: 2.0 * x, types.float64(types.float64), None)(1.0) == 2.0
        assert gc.isenabled() is collecting
    finally:
        (gc.enable if before else gc.disable)()
