"""The run of a call, made ready to go: checked, with its plan; kept for equal calls that follow."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.consistency import check_start
from twoloop.generate.derived import standing_for
from twoloop.generate.exact_derivatives import exact_near
from twoloop.generate.families import give_bounds, take_bounds
from twoloop.generate.traced_values import Traced
from twoloop.methods.code_for import Compiled, code_for
from twoloop.methods.plan import Method
from twoloop.methods.plans_for import plans_for
from twoloop.methods.presets import is_preset
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.run import Run

Array = NDArray[np.float64]

MOST, LARGEST = 16, 100_000  # runs that are kept with a system, and numbers of each


class Asked(NamedTuple):
    """What a call asks of a run, beside what it is to keep; `solve_dae` says what the names mean."""

    method: Method
    rtol: float
    atol: Array
    t1: float
    step_size: float | None
    first_step: float | None
    max_step: float
    max_steps: int | None
    compiled: Compiled
    check_derivatives: bool


def run_from(system: ConstrainedSystem, t0: float, q0: Array, v0: Array, asked: Asked) -> Run:
    """The run of a call: a copy of a kept one, if an equal call was made and none from another start came between.

    Kept are those of presets, compiled callbacks and trusted traces, if the call before was from the same start.

    Raises
    ------
    TypeError, ValueError
        If the start is refused, the method cannot run the system, or asked-for code cannot be had.
    """
    if system.called_in_python:  # what such functions find in their surroundings may change
        return _made(system, t0, q0, v0, asked)
    method, rtol, atol, *others = asked
    start, call = (t0, q0.tobytes(), v0.tobytes()), (id(method), rtol, atol.tobytes(), *others)
    came_from, kept = system.made.get("runs", (None, {}))
    if came_from == start and call in kept:
        again: Run = kept[call].again()
        return again
    run = _made(system, t0, q0, v0, asked)
    trusted = is_preset(method) and all(traced.trusted for traced in run.traced)
    if came_from != start:  # it may be one of many starts, or of many systems, each of which is taken once
        kept = {}
    elif trusted and run.work.notes.base.size <= LARGEST:
        kept = {} if len(kept) == MOST else dict(kept)  # another thread may look at the old one
        kept[call] = run.again()
    system.made["runs"] = start, kept
    return run


def _made(system: ConstrainedSystem, t0: float, q0: Array, v0: Array, asked: Asked) -> Run:
    start, fixed = (t0, q0.tobytes(), v0.tobytes()), asked.step_size is not None
    given, new = system, not system.checked
    if new:
        take_bounds(system)
    system.remembered_at(
        ("start", asked.check_derivatives),
        start,
        lambda: check_start(
            system, t0, q0, v0, derivatives=asked.check_derivatives, exact=lambda: exact_near(system, t0, q0, v0)
        ),
    )

    def check(traced: Traced) -> None:
        traced.refuse(system, t0, asked.t1, q0, v0)

    system, derived = standing_for(system, check)
    code = code_for(system, asked.method, fixed, asked.compiled, t0, q0, check)
    plan, interiors = plans_for(system, asked.method, asked.rtol, float(asked.atol.min()), fixed, code, check)
    if derived:
        plan = plan.changed(traced=(*plan.traced, *derived))
    if new:
        give_bounds(given)
    run = Run(system, plan, t0, q0, v0, asked.rtol, asked.atol, asked.step_size, interiors)
    if not fixed:
        run.set_sizes(asked.first_step, asked.max_step, asked.t1)
    if asked.max_steps is not None:
        run.control[run.a.MAX_STEPS] = asked.max_steps
    return run
