"""Test how helpers get into kernels, and which kernels are compiled together."""

import re
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import types

from twoloop.kernels.compile import linking
from twoloop.kernels.compile.linking import KernelCompiler
from twoloop.kernels.data.common import OPTIONS, compiled, inlined, merged

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
    assert kernel(1.0) == 8.0 and "alwaysinline" in _code(_short) and "alwaysinline" not in _code(_long)


def test_make_compile_all_compiles_all_kernels():
    makefile = (ROOT / "Makefile").read_text()
    recipes = [makefile.split(f"\n{target}: ")[1].split("\n\n")[0] for target in ("compile", "compile-all")]
    kernels, (most, others) = {path.stem for path in WITH_KERNELS}, (set(re.findall(r"\w+", each)) for each in recipes)
    assert kernels <= most | others and not kernels & most & others


def test_a_step_compiles_no_other_step():
    """Where one is imported for what it has beside its kernel, a first call compiles both."""
    steps = {path.stem: text for path, text in WITH_KERNELS.items() if path.parent.name in ("steps", "lanes")}
    imported = r"from twoloop\.kernels\.(?:steps|lanes)\.(\w+) import"
    found = {(name, other) for name, text in steps.items() for other in re.findall(imported, text) if other in steps}
    # explicit steps, in lanes too, belong to the default methods; `stages` has the placeholder of steps not loaded yet
    assert {other for _, other in found} <= {"explicit_step", "control", "stages"}


@inlined
def _behind(x, k):
    return x[k:]


def _entries(x, n):
    total = 0.0
    for k in range(n):
        corner = _behind(x, k)[0, k] + x[k, 1] * _behind(x, 0)[1, 1]
        total += max(corner, 0.25) * x[k, k] ** 2
    return total


def test_what_makes_compiling_faster_changes_no_code(monkeypatch):
    """Numba's own functions and those in their place give the same machine code, up to names that count."""
    found = []
    for rules in (linking._RULES, [rule for rule in linking._RULES if rule[1] == "fix_integer_index"]):
        monkeypatch.setattr(linking, "_RULES", rules)
        kernel = numba.njit("f8(f8[:, ::1], i8)", pipeline_class=KernelCompiler, **OPTIONS)(_entries)
        (code,) = kernel.inspect_llvm().values()
        body = code.split("define ")[1].split("\n}")[0]
        assert body.count("load double") >= 4
        found.append(re.sub(r"[%@!.\w\"$<>]*\d+[\w.$<>\"]*", "", body))
        x = 1.0 + np.arange(12.0).reshape(4, 3)
        assert kernel(x, 2) == pytest.approx(sum(max(x[k, k] + x[k, 1] * x[1, 1], 0.25) * x[k, k] ** 2 for k in (0, 1)))
    assert found[0] == found[1]


def test_numba_has_its_own_functions_after_a_kernel_and_after_a_failure():
    before = [vars(owner).get(name) for owner, name, _ in linking._RULES]
    numba.njit("f8(f8)", pipeline_class=KernelCompiler, **OPTIONS)(lambda x: x)
    with pytest.raises(numba.TypingError):
        numba.njit("f8(f8)", pipeline_class=KernelCompiler, **OPTIONS)(lambda x: x + "one")
    assert [vars(owner).get(name) for owner, name, _ in linking._RULES] == before and linking._depth == [0]
