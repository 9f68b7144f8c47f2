"""Ours and rivals by our adapters as `simulate(problem, times, tolerance)` of `twoloop.testing`."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

import numpy as np

from references import as_shown
from references.lines import Line, lines
from references.plain_equations import NoModel
from twoloop import ConstrainedSystem, Result, mechanisms, solve_dae
from twoloop.mechanisms import Problem
from twoloop.methods.presets import PRESETS
from twoloop.testing.known_problem import Array, KnownProblem
from twoloop.testing.simulated import Simulate

LOW = {  # methods of order 2 and 3, and at what tolerances they are asked
    **dict.fromkeys(("TRBDF2", "Gauss4", "ESDIRK4"), (1e-4, 1e-5, 1e-6)),
    **dict.fromkeys(("Newmark", "PaperNewmark"), (1e-3, 1e-4, 1e-5)),
}
KINDS = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")
# problems whose mechanism is a ready one, with compiled functions
TWINS = ("pendulum", "driven_crank", "four_bar", "redundant_slider_crank", "heavy_top")
OURS, ADAPTERS, SHOWN = "ours", "by our adapters", "as their authors show"
SAME = ("Gauss8", "Gauss10", "Gauss14")  # one code with tableaux that lie between those that are asked
STEPS = (1000, 2000, 4000)  # of solvers of fixed steps


@dataclass(frozen=True)
class Simulator:
    """A solver to check."""

    # name, group, package: in rows; one of OURS, ADAPTERS, SHOWN; what tells its version
    name: str
    group: str
    package: str
    simulate: Simulate
    drifts: bool = False  # whether nothing in its equations keeps the positions on the constraints
    # steps, tolerances: where its steps are of fixed length; where tolerances are not those of the check
    steps: tuple[int, ...] | None = None
    tolerances: tuple[float, ...] | None = None


def system_of(problem: KnownProblem) -> ConstrainedSystem:
    """The equations of a problem, called in Python."""
    functions = {kind: getattr(problem, kind) for kind in KINDS}
    return ConstrainedSystem.from_python(n_q=problem.n_q, n_c=problem.n_c, name=problem.name, **functions)


def twin_of(problem: KnownProblem) -> Problem:
    """The ready mechanism that a problem is.

    Raises NoModel if there is none, or the problem is seen in another frame or in other units.
    """
    made: Problem | None = getattr(mechanisms, problem.name)() if problem.name in TWINS else None
    if made is None:
        raise NoModel("no compiled mechanism of this problem")
    t, q, v = problem.t_span[0], problem.q0, problem.v0
    pairs = ((q, made.q0), (v, made.v0), (problem.force(t, q, v), made.system.force(t, q, v)))
    if not all(np.allclose(*pair) for pair in pairs):
        raise NoModel("the compiled mechanism is in one frame, and in SI units")
    return made


def _returned(result: Result, problem: KnownProblem, times: Array, system: ConstrainedSystem) -> tuple[Array, ...]:
    """States at the times, with the multipliers of the rows that the problem has."""
    if not result.success:
        raise RuntimeError(result.message)
    q, v, lam = result.q.T, result.v.T, result.lam.T
    if not np.isfinite(lam).all():
        return q, v
    if system.called_in_python:
        return q, v, lam
    own = [
        np.linalg.lstsq(problem.jacobian(t, at).T, system.jacobian(t, at).T @ each)[0]
        for t, at, each in zip(times, q, lam, strict=True)
    ]
    return q, v, np.array(own)


def ours(method: str, compiled: bool, problem: KnownProblem, times: Array, tolerance: float) -> tuple[Array, ...]:
    """A method of ours, on compiled functions where there are any, as those of a problem cost ten times as much.

    `compiled`: with code made for the mechanism, which needs such.
    """
    try:
        system = twin_of(problem).system
    except NoModel:
        if compiled:
            raise
        system = system_of(problem)
    options: dict[str, Any] = {"compiled": True} if compiled else {}
    return _by(partial(solve_dae, method=method, **options), system, problem, times, tolerance)


def by_line(line: Line, problem: KnownProblem, times: Array, tolerance: float) -> tuple[Array, ...]:
    """A rival, which needs compiled functions, or runs them on symbols."""
    system, one = twin_of(problem).system, {"tol": tolerance} if line.one_tolerance else None
    return _by(partial(line.solve, **line.options), system, problem, times, tolerance, one)


def _by(
    solve: Callable[..., Result],
    system: ConstrainedSystem,
    problem: KnownProblem,
    times: Array,
    tol: float,
    told: dict[str, float] | None = None,
) -> tuple[Array, ...]:
    given: dict[str, Any] = {"t_eval": times, **(told or {"rtol": tol, "atol": tol})}
    try:
        result = solve(system, (times[0], times[-1]), problem.q0, problem.v0, **given)
    except ValueError as error:  # refused before any work
        raise NoModel(f"refused: {error}") from None
    return _returned(result, problem, times, system)


def exudyn(problem: KnownProblem, times: Array, step: float) -> tuple[Array, ...]:
    """GeneralizedAlpha of Exudyn on its own models."""
    from references.exudyn.mechanisms import has_model, solve_exudyn

    twin = twin_of(problem)
    if not has_model(twin):
        raise NoModel("Exudyn has no model of this problem")
    n = round((times[-1] - times[0]) / step)
    result = solve_exudyn(twin, float(times[-1]), n, "GeneralizedAlpha", store_every=n // (times.size - 1))
    if not result.success:
        raise RuntimeError(result.message)
    return result.q.T, result.v.T


def simulators() -> list[Simulator]:
    """All that are checked."""
    methods = [each for each in PRESETS if each not in SAME]
    found = [Simulator(each, OURS, "twoloop", partial(ours, each, False), tolerances=LOW.get(each)) for each in methods]
    found.append(Simulator("auto, compiled", OURS, "twoloop", partial(ours, "auto", True)))
    checked = [line for line in lines() if line.checked]
    found += [Simulator(each.name, ADAPTERS, each.package, partial(by_line, each), not each.keeps) for each in checked]
    found.append(Simulator("Exudyn, GeneralizedAlpha", ADAPTERS, "exudyn", exudyn, steps=STEPS))
    return found + [Simulator(each.NAME, SHOWN, each.PACKAGE, each.simulate, each.DRIFTS) for each in shown()]


def shown() -> list[Any]:
    """The modules in the folder of `references.as_shown`."""
    names = sorted(each.name for each in iter_modules(as_shown.__path__))
    return [import_module(f"{as_shown.__name__}.{name}") for name in names]
