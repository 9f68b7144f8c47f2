"""The run of a call, made ready to go: checked, with its plan; kept for equal calls that follow."""

from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.at_position import has_definite_mass
from twoloop.checks.consistency import check_start
from twoloop.generate.compile_equations import GeneratedCode
from twoloop.generate.derived_callbacks import exact_near, with_derived_callbacks
from twoloop.generate.trace_cache import TraceCache, give_bounds, take_bounds, trace_cache_of
from twoloop.generate.traced_values import Traced, states_around
from twoloop.methods.code_for import code_for, may_have_code
from twoloop.methods.plans_for import plans_for
from twoloop.methods.presets import identity
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.again import MOST_WAITING, STEPS, Again, Output
from twoloop.run.asked import Asked
from twoloop.run.comparison import unlike_before
from twoloop.run.interrupts import Interrupts
from twoloop.run.movable import Kin
from twoloop.run.run import Run
from twoloop.run.workspace import sparse_factors_pay

Array = NDArray[np.float64]

MOST, LARGEST = 16, 150_000  # what is kept of with a system, for calls that ask for the same; numbers of each run
MOST_ALIKE = 3  # runs that are kept for such calls, as starts may ask for other code


class Kept(NamedTuple):
    """A run at its start, for calls that ask for the same, from there or from elsewhere."""

    run: Run
    start: tuple[float, bytes, bytes]
    t1: float
    code: GeneratedCode | None
    definite: bool  # whether M was
    moves: bool  # whether what it takes depends on the start by that alone
    waiting: list[Again] | None  # arrays for further runs, one a thread; None: they are not made in this way
    kin: Kin | None = None  # what it shares with systems of other parameters


# where the last run began, what is kept of runs, and the code of the last one, if it was not one of these
NO_RUNS: tuple[Any, dict[Any, tuple[Kept, ...]], int | None] = (None, {}, None)


def record_again(
    system: ConstrainedSystem,
    t0: float,
    t1: float,
    q0: Array,
    v0: Array,
    asked: Asked,
    output: Output,
    interrupts: Interrupts,
) -> tuple[dict[str, Any], str] | None:
    """The fields of the result of a run by the arrays of one before it, and what is said of its rows.

    None where there are none, or where something has to be looked at: then `run_from` begins it.
    """
    alike = system.made.get("runs", NO_RUNS)[1].get(asked.key, ())
    if not alike and (others := system.shared.get("runs")):
        known = others.get((asked.key, _family_of(system)))
        alike = (known,) if isinstance(known, Kept) else ()
    for kept in alike:
        if kept.waiting is None or not (output is STEPS or Again.gives(kept.run, output, kept.kin)):
            continue
        try:
            again = kept.waiting.pop()
        except IndexError:
            interrupts.listen()
            again = Again(kept.run.again(), system, kept.code, kept.definite, asked, kept.kin)
        fields = again.fields(system, t0, t1, q0, v0, asked, output, interrupts)
        said_of_rows = again.run.said_of_rows
        if len(kept.waiting) < MOST_WAITING:
            kept.waiting.append(again)
        if fields is not None:
            return fields, said_of_rows
    return None


def run_from(system: ConstrainedSystem, t0: float, t1: float, q0: Array, v0: Array, asked: Asked) -> Run:
    """The run of a call: a copy of one that is kept, where the same was asked for, from there or from another start.

    Kept are those of our own methods, compiled callbacks and trusted traces, from the second call of a system on.

    Raises
    ------
    TypeError, ValueError
        If the start is refused, the method cannot run the system, or asked-for code cannot be had.
    """
    if system.called_in_python:  # what such functions find in their surroundings may change
        return _made(system, t0, t1, q0, v0, asked)[0]
    start, call = (t0, q0.tobytes(), v0.tobytes()), asked.key
    came_from, runs, before = system.made.get("runs", NO_RUNS)
    alike = runs.get(call, ())
    run, kept = None, next((each for each in alike if each.start == start), None)
    if kept is not None:
        run, code = kept.run.again(), kept.code
        if kept.t1 != t1:
            asked.set_sizes(run, t1)
    for each in alike:
        if run is None and each.moves:
            run, kept, code = _moved(each, system, t0, t1, q0, v0, asked), each, each.code
    if run is None:
        (run, code), kept = _made(system, t0, t1, q0, v0, asked), None
        if run.system is system:
            _keep_for_kin(system, run, code, t1, asked)
    new = not alike or before == id(code) if kept is None else came_from == start != kept.start
    if new and came_from is not None:  # it may be one of many systems, each of which is taken once
        made = _kept_of(run, code, t1, asked)
        if made is not None:
            runs = {} if len(runs) == MOST else dict(runs)  # another thread may look at the old one
            runs[call] = made, *[each for each in alike if each is not kept][: MOST_ALIKE - 1]
    system.made["runs"] = start, runs, id(code) if kept is None else None
    return run


def _kept_of(run: Run, code: GeneratedCode | None, t1: float, asked: Asked) -> Kept | None:
    """What is kept of a run at its start, if it may be."""
    system, n = run.system, run.system.n_q
    trusted = identity(asked.method) is not None and all(traced.trusted for traced in run.traced)
    if not trusted or run.work.notes.base.size > LARGEST:
        return None
    t0, q0, v0 = run.t0, run.state[:n], run.state[n : 2 * n]
    settled = code is not None or not may_have_code(system, asked.method, asked.step_size is not None, asked.compiled)
    definite = has_definite_mass(system, t0, q0)
    moves = run.static is None and settled and (definite or not sparse_factors_pay(system, run.kit.flags))
    start = t0, q0.tobytes(), v0.tobytes()
    return Kept(run.again(), start, t1, code, definite, moves, [] if moves and Again.suits(run) else None)


def _family_of(system: ConstrainedSystem) -> TraceCache:
    made: TraceCache = system.remembered(("family", trace_cache_of), lambda: trace_cache_of(system))
    return made


def _keep_for_kin(system: ConstrainedSystem, run: Run, code: GeneratedCode | None, t1: float, asked: Asked) -> None:
    """Keep a run for systems of other parameters, from the second of these on."""
    call, seen, known = (asked.key, _family_of(system)), system.functions, system.shared.get("runs", {})
    if call not in known:
        system.shared["runs"] = (known if len(known) < MOST else {}) | {call: seen}
    elif type(known[call]) is type(seen) and known[call] is not seen:
        kept = _kept_of(run, code, t1, asked)
        if kept is not None and kept.waiting is not None:
            fixed = asked.step_size is not None
            with suppress(ValueError):
                known[call] = kept._replace(kin=Kin(kept.run, code, asked.method, fixed, asked.compiled))
                return
        known[call] = None


def _moved(
    kept: Kept, system: ConstrainedSystem, t0: float, t1: float, q0: Array, v0: Array, asked: Asked
) -> Run | None:
    """A run from another start; None where something else suits that."""
    _check_start(system, t0, q0, v0, asked.check_derivatives)
    if kept.code is not None and not kept.code.serves(system, t0, q0):
        return None
    run = kept.run.at(t0, q0, v0) if has_definite_mass(system, t0, q0) == kept.definite else None
    if run is not None:
        asked.set_sizes(run, t1)
    return run


def _made(
    system: ConstrainedSystem, t0: float, t1: float, q0: Array, v0: Array, asked: Asked
) -> tuple[Run, GeneratedCode | None]:
    fixed, given, new = asked.step_size is not None, system, not system.checked
    if new:
        take_bounds(system)
    _check_start(system, t0, q0, v0, asked.check_derivatives)

    def check(traced: Traced) -> None:
        traced.refuse(system, t0, t1, q0, v0)

    system, derived = with_derived_callbacks(system, check)
    code = code_for(system, asked.method, fixed, asked.compiled, t0, q0, check)
    plan, interiors = plans_for(system, asked.method, asked.rtol, float(asked.atol.min()), fixed, code, check)
    if derived:
        plan = plan.changed(traced=(*plan.traced, *derived))
    if new:
        give_bounds(given)
    if system.called_in_python and not fixed:
        unlike = unlike_before(system, states_around(t0, t1, q0, v0))
        if unlike is not None:
            raise ValueError(unlike)
    run = Run(system, plan, t0, q0, v0, asked.rtol, asked.atol, asked.step_size, interiors)
    asked.set_sizes(run, t1)
    if asked.max_steps is not None:
        run.control[run.a.MAX_STEPS] = asked.max_steps
    return run, code


def _check_start(system: ConstrainedSystem, t0: float, q0: Array, v0: Array, derivatives: bool) -> None:
    """Check a start, once as long as no other is asked for."""

    def check() -> None:
        check_start(system, t0, q0, v0, derivatives=derivatives, exact=lambda: exact_near(system, t0, q0, v0))

    system.remembered_at(("start", derivatives), (t0, q0.tobytes(), v0.tobytes()), check)
