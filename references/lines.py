"""Solvers compared in tables and figures: each adapter's module lists its own in `LINES`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import Any

from twoloop.result.result import Result


@dataclass(frozen=True)
class Line:
    """A solver, given by a function made by `references.driver.adapter`, or of a problem as `of_problem` says."""

    name: str
    package: str  # name of the package, which provides the version
    family: str  # project
    solve: Callable[..., Result]
    options: Mapping[str, Any] = field(default_factory=dict)
    called_from: str = "compiled"  # caller of the mechanism's functions; "Python" costs microseconds per call
    keeps: bool = True  # keeps the positions on the constraints to the solver's tolerance
    compared: bool = True  # runs in all comparisons of studies
    checked: bool = False  # checked by `conformance`; one setting per solver
    setting: str = "tol"  # the number that varies; "h": a fixed step, which `solve` takes as `step`
    of_problem: bool = False  # solve(problem, t_end, ...), with equations of its own; otherwise of a system
    # as of `studies.bench.collector.Solver`
    traces: bool = False
    builds_each: bool = False
    builds_span: bool = False
    stores_steps: bool = False  # stores its steps instead of output times
    compiled_callbacks: bool = False  # requires compiled functions
    one_tolerance: bool = False  # takes `tol` instead of `rtol` and `atol`
    scatters: bool = False  # error scatters with rounding: repetitions use slightly different tolerances
    fixed: Mapping[str, float | str] = field(default_factory=dict)  # as rows contain them


class CannotRun(Exception):
    """Raised by a solver that cannot run a mechanism; the message says why."""


@cache
def lines() -> tuple[Line, ...]:
    """Return the lines of all modules in this folder: solvers called from compiled code, from Python, of problems."""
    folder = Path(__file__).parent
    names = sorted(module.name for module in walk_packages([str(folder)], "references.") if not module.ispkg)
    solver_lines = [line for name in names for line in getattr(import_module(name), "LINES", ())]
    return tuple(
        sorted(solver_lines, key=lambda line: (line.of_problem, line.called_from == "Python", line.setting == "h"))
    )
