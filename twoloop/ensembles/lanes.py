"""Integrate runs in SIMD lanes: choose the methods, generate code, sample short forces, check each run."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from twoloop.checks.arguments import Array
from twoloop.ensembles.starts import Starts, generic_parameters, generic_system, system_of, writable_kit
from twoloop.generate.elimination import PivotChoice
from twoloop.generate.graph import Untraceable
from twoloop.generate.parameter_expressions import ParameterTape
from twoloop.generate.program import ArrayAlgebra, Program
from twoloop.generate.series import series_for
from twoloop.generate.time_dependence import TIME_CALLBACKS, TIME_MASK, find_short_forces, forces_may_be_steep
from twoloop.generate.trace import Equations
from twoloop.kernels.control.discontinuities import LEAST_RANGE, LEAST_VALUE, MIN_STEEPNESS_RATIO, SUDDEN_RATIO
from twoloop.kernels.control.discontinuities import N_SAMPLES as N_PLACES
from twoloop.kernels.lanes import layout
from twoloop.kernels.layout import cached_run
from twoloop.methods import dop853
from twoloop.methods.auto import TIGHTEST
from twoloop.methods.dop853 import COARSE_SHARE, LONGEST_GAP
from twoloop.methods.plan import Method, least_tolerance
from twoloop.methods.presets import PRESETS
from twoloop.methods.runge_kutta import RungeKutta
from twoloop.methods.tableaux import radau_iia
from twoloop.methods.taylor import order_in_lanes
from twoloop.problem.system import ConstrainedSystem

if TYPE_CHECKING:
    from twoloop.generate.lane_code import GeneratedLanes, LaneCode

BLOCK_VALUES = 30_000  # largest number of sampled values that are compared together


class ForceSampling:
    """Sampling of the forces and drives of many runs, to detect short forces.

    The callbacks of the system run on symbols. `values`, `varying`: see `ParameterTape`.
    """

    def __init__(self, system: ConstrainedSystem, values: Array, varying: Sequence[int]):
        self._tape = ParameterTape(values.tolist(), varying)
        equations = Equations(system, self._tape.parameters)
        graph = equations.graph
        expressions = np.concatenate(
            [equations.expressions(kind).ravel() for kind in TIME_CALLBACKS if kind in system.given]
        )
        self._program = Program(
            graph, {"": [x for x in expressions if any(graph.input_masks[i] & TIME_MASK for i in x.terms)]}
        )

    def has_short_forces(self, times: Array, rtol: float, parameters: Array, q: Array, v: Array) -> NDArray[np.bool_]:
        """Return a mask of runs, at states q, v (n_runs, n), whose forces jump twice in two samples or are infinite."""
        is_short = np.zeros(len(q), dtype=bool)
        size = max(1, BLOCK_VALUES // max(1, len(times) * len(self._program.expressions)))
        for begin in range(0, len(q), size):
            rows = slice(begin, begin + size)
            algebra = ArrayAlgebra(self._tape, parameters[rows])
            (forces,) = self._program.run(algebra, [times[:, None], *q[rows].T, *v[rows].T])
            values = np.empty((len(times), len(q[rows]), len(forces)))
            for k, force in enumerate(forces):
                values[..., k] = force
            is_short[rows] = _have_short_changes(values, rtol)
        return is_short


def _have_short_changes(values: Array, rtol: float) -> NDArray[np.bool_]:
    """Return a mask of the runs in `values` (n_times, n_runs, n) that jump twice in two samples, or are not finite."""
    if not values.size:
        return np.zeros(values.shape[1], dtype=bool)
    is_finite: NDArray[np.bool_] = np.asarray(np.isfinite(values).all(axis=(0, 2)))
    values = np.where(is_finite[:, None], values, 0.0)
    min_range = np.maximum(LEAST_VALUE, LEAST_RANGE * rtol * np.abs(values).max(axis=(0, 2)))
    size = N_PLACES + 1
    ranges = maximum_filter1d(values, size, axis=0) - minimum_filter1d(values, size, axis=0)
    change, local_range = np.diff(values, axis=0), np.maximum(ranges[:-1], ranges[1:])
    neighbour = np.zeros_like(change)
    direction = np.sign(change)
    neighbour[1:] = change[:-1] * direction[1:]
    neighbour[:-1] = np.maximum(neighbour[:-1], change[1:] * direction[:-1])
    is_flank = (
        (np.abs(change) > SUDDEN_RATIO * local_range)
        & (MIN_STEEPNESS_RATIO * neighbour < np.abs(change))
        & (local_range > min_range[:, None])
    )
    is_short = (is_flank[:-1] & is_flank[1:]).any(axis=(0, 2)) | (is_flank[:-2] & is_flank[2:]).any(axis=(0, 2))
    return np.asarray(is_short | ~is_finite)


# "auto" takes DOP853 first if a series takes more than this many operations per coordinate (measured at 2, 11 and 13),
# and the tolerance is at least the second number. No method is faster on all mechanisms: at an error of 1e-6, DOP853
# takes 1.7 times as long as series on four-bars, and series over twice as long as DOP853 on the spatial slider-crank
COSTLY_SERIES, SMALLEST_FOR_DOP853 = 6.0, 1e-9
N_STAGES = {"RadauIIA5": 3, "RadauIIA9": 5, "RadauIIA13": 7}  # number of stages of the implicit methods
IN_LANES = ("auto", "Taylor", "DOP853", *N_STAGES)  # presets that can run in lanes


@dataclass(frozen=True)
class LaneMethod:
    """Method prepared for runs in lanes."""

    name: str
    series: bool  # whether it needs code for Taylor series
    order: int  # argument `order` of the generated functions
    evaluations: int  # number of evaluations in an attempt that the kernel does not count, without the one at its end
    options: Array  # numbers that the step kernel reads
    step: Any  # the step kernel
    memory: Callable[[LaneCode], int]  # returns the size of the kernel's memory for given code, in vectors
    # for an explicit method with generated code: A, b, c and the weights of two error estimates
    tableau: tuple[Array, Array, Array, Array, Array] | None = None
    max_gap: float = 1.0  # largest time between evaluations in a step, relative to the step size


def is_series_costly(system: ConstrainedSystem) -> bool:
    """Return whether a Taylor series takes so many operations that the stages of DOP853 cost less.

    Return False if a force may be steep, because DOP853 would then need short steps, while series only check the defect
    more often.
    """
    if forces_may_be_steep(system, force_was_traced=True):
        return False
    try:
        return series_for(system).n_operations > COSTLY_SERIES * system.n_q
    except Untraceable:
        return False


def lane_methods(
    name: str, stiff: bool, n: int, rtol: float, atol: float, series_is_costly: bool = False
) -> list[LaneMethod]:
    """Return the methods of a preset for n coordinates, in the order in which they are tried.

    "auto" takes Taylor series, then DOP853; the other way round if `series_is_costly` and the tolerance is not below
    SMALLEST_FOR_DOP853. For stiff motion it takes the Radau method of single runs, with order 5 at loose tolerances.
    """
    if name == "DOP853":
        return [_dop853(n, rtol, atol)]
    if name == "Taylor":
        return [_taylor(rtol, atol)]
    if name != "auto":
        return [_newton(name, "all", n, rtol, atol)]
    tolerance = least_tolerance(rtol, atol)
    if not stiff:
        methods = [_taylor(rtol, atol), _dop853(n, rtol, atol)]
        return methods[::-1] if series_is_costly and tolerance >= SMALLEST_FOR_DOP853 else methods
    radau = "RadauIIA5" if tolerance >= TIGHTEST else "RadauIIA9"
    return [_newton(radau, "positions", n, rtol, atol)]


def _taylor(rtol: float, atol: float) -> LaneMethod:
    from twoloop.kernels.lanes.control import step_by_series

    order = order_in_lanes(rtol, atol) + 1
    return LaneMethod(
        "Taylor", True, order, order - 1, np.zeros(0), step_by_series, lambda code: code.series_size(order)
    )


def _dop853(n: int, rtol: float, atol: float) -> LaneMethod:
    from twoloop.kernels.lanes.control import memory_size, step_by_dop853

    memory = memory_size(len(dop853.B), n)
    weights = dop853.A, dop853.B, dop853.C, dop853.E5, COARSE_SHARE * dop853.E3
    stages, options = len(dop853.B), _options(PRESETS["DOP853"], n, rtol, atol)
    return LaneMethod("DOP853", False, 8, stages - 1, options, step_by_dop853, lambda _: memory, weights, LONGEST_GAP)


def _newton(name: str, tested: Literal["all", "positions"], n: int, rtol: float, atol: float) -> LaneMethod:
    from twoloop.kernels.lanes.newton import memory_size, step_by_newton

    radau = radau_iia(N_STAGES[name])
    memory = memory_size(radau.stages, n)
    method = RungeKutta(radau, outer="newton", tested=tested)
    n_for_derivatives = 2 * n + 1
    return LaneMethod(
        name, False, radau.order, n_for_derivatives, _options(method, n, rtol, atol), step_by_newton, lambda _: memory
    )


def _options(method: Method, n: int, rtol: float, atol: float) -> Array:
    """Return the numbers that a step kernel reads: step-size control, then the options of the plan."""
    plan = method.plan(n, rtol, atol, False)
    tolerance, first_step = least_tolerance(rtol, atol), cached_run().FIRST_STEP
    return np.concatenate([plan.rule, [plan.jump_ratio, first_step, tolerance], plan.options])


Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

# smallest number of evaluations of the equations in a run: N_SHORT if forces may be short, else N_SAMPLES
N_SAMPLES, N_SHORT = 100, 2000
# limits of the number of runs in a block, whose coefficients are computed together
MIN_BLOCK_RUNS, MAX_BLOCK_RUNS = 128, 4096
BLOCKS_PER_THREAD = 3  # number of blocks of runs per thread; with 3, all threads end at about the same time
# statuses of runs besides those in layout.py: SHORT_FORCE, a short force was found; OUT_OF_TIME, the time
# limit ended before the run
SHORT_FORCE = min(layout.NO_START, layout.CALLBACKS_DIFFER) - 1
OUT_OF_TIME = SHORT_FORCE - 1
STOP_INTERVAL = 0.01  # time, s, between calls of `stop`, which are repeated as more runs may have begun
MAX_RESIDUAL = 1e-7  # largest residual of the equations at the end of a valid run, relative to their terms

REASONS = {  # reasons for which a run is left to `solve_dae`, by its status in layout.py
    layout.NO_START: "the code made for the first run does not hold at the start",
    layout.NO_STATE: "a state at t_eval could not be put on the constraints",
    layout.NO_VALUES: "the equations have no values in a step (constraints lose rank, a root of a negative number)",
    layout.MANY_REJECTIONS: "steps are refused again and again (a sudden force, stiff motion, a singular position)",
    layout.MANY_STEPS: "it takes more than 100,000 steps in lanes (stiff, or very fast motion)",
    layout.CALLBACKS_DIFFER: "the callbacks do not agree with the code at the end (they branch)",
    OUT_OF_TIME: "the time limit ended before the run did, in lanes",
    SHORT_FORCE: "forces or drives change for so short a time that lanes may miss others",
}


class LaneRuns:
    """Generated code of a system for lanes, and the runs that it integrates.

    Raise Untraceable if lanes cannot integrate the system; the message says why.
    """

    def __init__(self, system: ConstrainedSystem, starts: Starts, method: LaneMethod):
        self.system, self.starts, self.method, self.kit = system, starts, method, writable_kit(system)
        generic, varying = generic_parameters(starts.parameters)
        generic_copy = generic_system(system, starts)
        short_forces = find_short_forces(generic_copy, force_was_traced=True)
        gap = 1.0 if forces_may_be_steep(generic_copy, force_was_traced=True) else method.max_gap
        self.n_gaps = N_SHORT if any(short_forces) else N_SAMPLES * gap  # smallest number of steps in a run
        self.sampling = ForceSampling(system, generic, varying) if short_forces.by_time else None
        choice = PivotChoice.choose(system_of(system, starts, 0), starts.t0, starts.q[0])
        kind = ("lanes", method.series, method.tableau is None, choice, tuple(varying))  # key of the cached code

        def generate() -> GeneratedLanes[LaneCode] | Untraceable:
            from twoloop.generate.lane_code import GeneratedLanes, LaneCode  # loads kernels: at the first ensemble

            tape = ParameterTape(generic.tolist(), varying)
            try:
                return GeneratedLanes(tape, LaneCode(system, choice, tape.parameters, method.series, method.tableau))
            except Untraceable as reason:  # cached, because long equations take seconds to trace
                return reason

        generated = system.remembered_at(kind, generic.tobytes(), generate)
        if isinstance(generated, Untraceable):
            raise generated
        self.generated = generated

    def integrate(
        self,
        numbers: Integers,
        t1: float,
        times: Array,
        rtol: float,
        atol: Array,
        threads: int,
        out_q: Array,
        out_v: Array,
        deadline: float = np.inf,
    ) -> tuple[Integers, Integers, Integers, Array]:
        """Integrate the runs with these numbers; return status, step counts, evaluation counts, final [a, lam].

        States at `times` are written to `out_q` and `out_v`. Runs stop at the deadline, a time of `time.monotonic`.
        """
        from twoloop.kernels.lanes.advance import advance_lanes
        from twoloop.kernels.lanes.control import MAX_STEPS

        starts, code, method = self.starts, self.generated.code, self.method
        n, n_rows = code.n, code.n_rows
        redundant = bool(code.equations.redundant_rows.conditions)
        settings = np.array([n, n_rows, method.order, redundant, code.n_numbers, method.evaluations], dtype=np.int64)
        control = np.concatenate([[starts.t0, t1, (t1 - starts.t0) / self.n_gaps, rtol], atol, code.numbers.values])
        n_vectors = layout.array_offsets(n, n_rows, code.n_numbers)[-1] + method.memory(code)
        n_runs = len(numbers)
        status, n_steps, n_evaluations = np.zeros((3, n_runs), dtype=np.int64)
        n_evaluations += 1  # the evaluation at the start
        ends = np.full((n_runs, self.system.n_q + self.system.n_c), np.nan)

        def integrate_block(rows: slice) -> None:
            kit = layout.LaneKit(self.generated.functions, method.step)
            run_parameters = self.generated.coefficients_for(starts.parameters[numbers[rows]])
            inputs = starts.q[numbers[rows]], starts.v[numbers[rows]]
            outputs = out_q[rows], out_v[rows], ends[rows], status[rows], n_steps[rows], n_evaluations[rows]
            arrays = times, run_parameters, *inputs, *outputs, aligned_zeros(n_vectors, layout.LANES)
            advance_lanes(kit, settings, control, method.options, *arrays)

        def stop() -> None:
            """End the runs in all threads, as if they had taken MAX_STEPS steps."""
            n_steps[status == layout.UNDECIDED] = MAX_STEPS

        if not run_in_blocks(integrate_block, n_runs, threads, deadline, stop):
            status[(status == layout.MANY_STEPS) | (status == layout.UNDECIDED)] = OUT_OF_TIME
        return status, n_steps, n_evaluations, ends

    def find_valid_runs(
        self, numbers: Integers, status: Integers, t1: float, rtol: float, atol: float, q: Array, v: Array, ends: Array
    ) -> Flags:
        """Return a mask of the runs that have all states and satisfy the callbacks; set the status of the others.

        q, v: (n_runs, n, n_t), up to the end. ends: rows [a, lam] at the end.
        """
        from twoloop.kernels.lanes.starts import motion_residuals

        has_ended = status == layout.ENDED
        is_finite = np.isfinite(q).all(axis=(1, 2))
        is_valid = has_ended & is_finite
        status[has_ended & ~is_finite] = layout.NO_STATE
        n, n_c = self.system.n_q, self.system.n_c
        workspace, residuals = np.zeros(n * (n + 3) + n_c * (n + 3)), np.full(len(numbers), np.inf)
        checked, states = np.where(is_valid, numbers, -1), (self.starts.parameters, q, v, ends)
        motion_residuals(*self.kit, t1, MAX_RESIDUAL, atol, checked, *states, workspace, residuals)
        is_satisfied = residuals <= 1.0
        status[is_valid & ~is_satisfied] = layout.CALLBACKS_DIFFER
        is_valid &= is_satisfied
        if self.sampling is not None:
            times, runs = np.linspace(self.starts.t0, t1, N_SHORT + 1), np.flatnonzero(is_valid)
            inputs = self.starts.parameters[numbers[runs]], q[runs, :, -1], v[runs, :, -1]
            short = runs[self.sampling.has_short_forces(times, rtol, *inputs)]
            status[short], is_valid[short] = SHORT_FORCE, False
        return is_valid


def run_in_blocks(
    task: Callable[[slice], None],
    n_runs: int,
    threads: int,
    deadline: float = np.inf,
    stop: Callable[[], None] = lambda: None,
) -> bool:
    """Call `task` for blocks of runs in threads; return whether all blocks ended before the deadline.

    `stop` is called at the deadline, or after an exception in this thread, and must make `task` end.
    """
    n_blocks = 1 if threads == 1 else BLOCKS_PER_THREAD * threads
    size = int(np.clip(-(-n_runs // n_blocks), MIN_BLOCK_RUNS, MAX_BLOCK_RUNS))
    blocks = [slice(begin, min(begin + size, n_runs)) for begin in range(0, n_runs, size)]
    stopped = False
    with ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(task, rows) for rows in blocks]
        try:
            while wait(
                futures, None if deadline == np.inf else max(STOP_INTERVAL, deadline - time.monotonic())
            ).not_done:
                stopped = True
                stop()
        finally:
            while wait(futures, 0.0).not_done:  # after an exception such as KeyboardInterrupt
                stop()
                wait(futures, STOP_INTERVAL)
        for future in futures:
            future.result()
    return not stopped


def aligned_zeros(vectors: int, lanes: int) -> Array:
    """Return vectors * lanes zeros, at an address that is a multiple of the size of a SIMD vector."""
    size = 8 * lanes
    workspace = np.zeros(vectors * lanes + lanes)
    first = -workspace.ctypes.data % size // 8
    return workspace[first : first + vectors * lanes]


def threads_of(requested: int | None) -> int:
    """Return the number of threads: `requested`, else one for each core that this process may use."""
    if requested is not None:
        return requested
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
