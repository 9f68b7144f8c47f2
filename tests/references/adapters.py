"""The adapters of other solvers, found by the places of their files, for the tests of what holds for each."""

from collections.abc import Collection
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import pytest

from references.casadi.integrators import solve_collocation
from references.lines import Line, lines
from references.paper.gear import solve_gear
from tests.marks import slow_but


class Adapter:
    """One solver with one setting: (system, t_span, q0, v0, tol=..., **options) -> Result."""

    def __init__(self, line: Line):
        self._line = line

    def __call__(self, *start: Any, tol: float = 1e-6, **options: Any) -> Any:
        try:
            version(self._line.package)
        except PackageNotFoundError:
            pytest.skip(f"{self._line.package} is not installed")
        tolerances = {"tol": tol} if self._line.one_tolerance else {"rtol": tol, "atol": tol}
        return self._line.solve(*start, **self._line.options, **tolerances, **options)


def _by_collocation(*start: Any, tol: float | None = None, **options: Any) -> Any:
    pytest.importorskip("casadi")
    return solve_collocation(*start, 300, **options)


# one setting of each solver: `fixed` tells those that differ in a number
FOUND = {line.name: line for line in lines() if line.setting == "tol" and not line.of_problem and not line.fixed}
del FOUND["IDA from C, order 2, banded"]  # only of systems that declare a bandwidth: test_ida.py
ADAPTERS: dict[str, Any] = {
    **{name: Adapter(line) for name, line in FOUND.items()},
    # which take steps, here of a fixed length or number
    "collocation, CasADi": _by_collocation,
    "GSTIFF": lambda *start, tol=None, **options: solve_gear(*start, 1e-3, 2, **options),
}
# one of each way to call a solver, of those that need no long compilation: the other tests are slow.
# DOP853 at index 1 has tests of its own, in test_index1.py
QUICK = ("IDA, stabilised",)
# callbacks in Python, too
ANY_CALLBACK = (*(name for name, line in FOUND.items() if not (line.traces or line.compiled_callbacks)), "GSTIFF")


def each(*left_out: str, of: Any = tuple(ADAPTERS), quick: Collection[str] = QUICK) -> list[Any]:
    """Names of adapters; those that are not quick are slow tests."""
    return slow_but(quick, [name for name in of if name not in left_out])


def start(problem, t_end=None):
    return problem.system, (0.0, problem.reference.t if t_end is None else t_end), problem.q0, problem.v0
