"""Lines of rivals in tables and figures: the file of each adapter lists its own, and studies find them by place."""

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
    """A solver with tolerances, by a function that `references.driver.adapter` has made."""

    name: str
    package: str  # what tells its version
    family: str  # whose it is
    solve: Callable[..., Result]
    options: Mapping[str, Any] = field(default_factory=dict)
    called_from: str = "compiled"  # what calls the mechanism's functions; "Python" costs microseconds a call
    # whether the positions stay on the constraints to the solver's tolerance
    keeps: bool = True
    rival: bool = True  # whether it stands beside ours in every table
    checked: bool = False  # whether `conformance` checks it; one setting of each solver
    # as of `studies.bench.collector.Solver`
    own_accelerations: bool = False
    traces: bool = False
    builds_each: bool = False
    builds_span: bool = False
    stores_steps: bool = False  # whether it is to store its steps, not states at instants
    compiled_callbacks: bool = False  # whether it refuses functions in Python
    one_tolerance: bool = False  # whether it takes `tol`, and not `rtol` and `atol`
    scatters: bool = False  # whether its error scatters with rounding: repeats get tolerances a little apart
    # as a row tells them
    fixed: Mapping[str, float | str] = field(default_factory=dict)


@cache
def lines() -> tuple[Line, ...]:
    """Those of every module of this folder that has `LINES`; called from compiled code first."""
    here = Path(__file__).parent
    names = sorted(each.name for each in walk_packages([str(here)], "references.") if not each.ispkg)
    found = [line for name in names for line in getattr(import_module(name), "LINES", ())]
    return tuple(sorted(found, key=lambda line: line.called_from == "Python"))
