"""Generate code for many runs of one mechanism at once: every number is a vector, with one run in each of its lanes.

`series`, `elimination` and `compile_equations` write the operations. Coefficients are read as vectors, so that each run
may have its own parameters. The step-size control of Taylor series is generated, too. Code is cached on disk.
"""

import hashlib
import math
from collections.abc import Iterator
from functools import cache, cached_property
from itertools import chain
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from twoloop.generate import (
    compile_equations,
    elimination,
    lane_series,
    llvm_code,
    llvm_text,
    null_space,
    program,
    series,
)
from twoloop.generate.compile_equations import write_accelerations
from twoloop.generate.elimination import Elimination, FactorAndSolvePrograms, PivotChoice
from twoloop.generate.graph import Untraceable, is_zero
from twoloop.generate.lane_series import LaneEmitter, LaneSeries
from twoloop.generate.llvm_code import lower_program
from twoloop.generate.llvm_text import INTEGER, Module, Value, integer
from twoloop.generate.parameter_expressions import ParameterTape
from twoloop.generate.program import Coefficients, Program
from twoloop.generate.series import series_program
from twoloop.generate.trace import Equations
from twoloop.kernels.compile.dependencies import digest_of
from twoloop.kernels.compile.generated_functions import GeneratedFunctions, are_cached, generated_functions
from twoloop.kernels.control.step_size import (
    FIXED_FRACTION,
    FRACTION_AT_SIGN_CHANGE,
    FRACTION_OF_MOTION,
    LEAST,
    ROUNDING,
)
from twoloop.kernels.lanes import layout as lanes
from twoloop.kernels.lanes.layout import CODE
from twoloop.problem.system import ConstrainedSystem

# if a Taylor step is rejected because the projection changes q by more than a limit, the next step is so much shorter
# that its projection is expected to change q by this * the limit (the same as in kernels/steps/taylor_step.py)
TARGET_ERROR = 0.3
MIN_FACTOR, SAFETY, MAX_FACTOR = 0.1, 0.9, 5.0  # limits of (step size / last step size); SAFETY: factor on this ratio
MAX_REJECTIONS = 10  # a run with more successive rejected steps than this is repeated outside the lanes
FIRST_UNIT = 0.01  # unit of time of the first series of a run, relative to the duration t1 - t0 of the run
# a projection has converged if it changes q by at most ABSOLUTE_CORRECTION (unit of q) or RELATIVE_CORRECTION * max|q|
ABSOLUTE_CORRECTION, RELATIVE_CORRECTION = 1e-14, 1e-14
CONTRACTION = 0.5  # a projection fails if the ratio of a correction to the previous correction is above this
N_PARALLEL = 3  # number of coordinates whose series one loop evaluates: a coordinate needs 3 of 16 vector registers


class LaneMemory(NamedTuple):
    """Order of the Taylor series, pointer to `work`, and pointers to arrays in `work`, see kernels/lanes/layout.py."""

    order: Value
    work: Value
    state: Value
    new: Value
    predicted: Value
    series_a: Value  # accelerations by the second derivative of the Taylor series
    a: Value  # accelerations by the equations of motion
    lam: Value
    series: Value
    scratch: Value


class LaneSteps:
    """Code generator for steps in SIMD lanes, with n coordinates and n_rows multipliers.

    Arguments of methods: `emit` appends instructions to a function; `order`: order of the Taylor series; `control` and
    `work`: pointers to settings and to the memory of the lanes. Names in capitals are fields of this memory, such as
    STATE, the state before the step, and NEW, the state after it or within it: see kernels/lanes/layout.py.
    """

    n_numbers: int  # number of coefficients that depend on parameters

    def __init__(self, n: int, n_rows: int):
        self.n, self.n_rows = n, n_rows

    def update_unit(self, emit: LaneEmitter, control: Value, work: Value) -> Value:
        """Write code that stores UNIT, the time unit (s) of the next series: the step size the last series allows."""
        select, unit = emit.builder.select, emit.load(work, lanes.UNIT)
        is_fresh, is_accepted = (is_set(emit, work, field) for field in (lanes.IS_NEW, lanes.ACCEPTED))
        duration = broadcast_entry(emit, control, lanes.T1) - broadcast_entry(emit, control, lanes.T0)
        next_unit = emit.minimum(emit.load(work, lanes.LENGTH) * unit, MAX_FACTOR * emit.load(work, lanes.H))
        first_unit = FIRST_UNIT * duration
        unit = select(is_fresh, first_unit, select(is_accepted, next_unit, unit))
        emit.store(unit, work, lanes.UNIT)
        for field, value in ((lanes.LONGEST, math.inf), (lanes.SHIFT, 0.0)):
            emit.store(select(is_fresh, emit.constant(value), emit.load(work, field)), work, field)
        return unit

    def choose_sizes(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that stores the step size allowed by the last two terms of the series: H (s), and X = H / UNIT."""
        builder, n, memory = emit.builder, self.n, self.memory(emit, order, control, work)
        unit, (rtol, atol) = emit.load(work, lanes.UNIT), self.tolerances(emit, control)
        one, norms = emit.constant(1.0), []
        scales = []
        for j in range(n):
            q, v = (abs(emit.load(memory.series, i)) for i in (j, n + j))
            of_q, of_v = atol[j] + rtol * q, atol[j] * unit + rtol * v
            scales.append(one / emit.minimum(of_q, of_v / emit.to_double(order)))
        for back in (0, 1):
            power = order - back
            row, largest = emit.pointer(memory.series, power * n), emit.constant(0.0)
            for j, scale in enumerate(scales):
                largest = emit.maximum(abs(emit.load(row, j)) * scale, largest)
            norms.append(largest)
        log_roots = [
            emit.logarithm(value) / emit.to_double(power)
            for value, power in zip(norms, (order, order - 1), strict=True)
        ]
        h_in_units = emit.exponential(-emit.maximum(*log_roots))
        emit.store(h_in_units, work, lanes.LENGTH)
        t, t1 = emit.load(work, lanes.T), broadcast_entry(emit, control, lanes.T1)
        time_left, zero = t1 - t, emit.constant(0.0)
        h = emit.minimum_or_nan(h_in_units * unit, emit.load(work, lanes.LONGEST))
        h = builder.select(h >= time_left, time_left, h)
        largest = emit.maximum(abs(t), abs(t1))
        is_continued = h > lanes.SHORTEST * largest
        for field in (lanes.RUNNING, lanes.ACTIVE):
            is_continued = is_continued & is_set(emit, work, field)
        h = builder.select(is_continued, h, zero)
        emit.store(h, work, lanes.H)
        emit.store(h / unit, work, lanes.X)
        for field in (lanes.RUNNING, lanes.ACTIVE):
            store_mask(emit, work, field, is_continued)

    def evaluate_series(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that evaluates the series at the end of the step, and stores q, v in NEW and q in `predicted`."""
        memory = self.memory(emit, order, control, work)
        for j, q in enumerate(self.evaluate_positions(emit, memory, emit.load(work, lanes.X))):
            emit.store(q, memory.predicted, j)

    def evaluate_positions(self, emit: LaneEmitter, memory: LaneMemory, x: Value) -> list[Value]:
        """Write code that evaluates the series at x units of time, and stores NEW (q, v) and `series_a`; return q."""
        positions: list[Value] = []
        n, order = self.n, memory.order
        unit, zero = emit.load(memory.work, lanes.UNIT), emit.constant(0.0)
        per_unit = 1.0 / unit
        acceleration_unit = 2.0 * (per_unit * per_unit)
        last_row = emit.pointer(memory.series, order * n)
        for begin in range(0, n, N_PARALLEL):
            group = range(begin, min(begin + N_PARALLEL, n))
            initial = [each for j in group for each in (emit.load(last_row, j), zero, zero)]
            with emit.loop(integer(0), order, initial) as (m, carried, new):
                power = order - 1 - m
                row = emit.pointer(memory.series, power * n)
                for j, (q, v, a) in zip(group, _triples(carried), strict=True):
                    # in this order (a, v, q), each new number can take the register of the old one
                    a = a * x + v
                    v = v * x + q
                    new += [q * x + emit.load(row, j), v, a]
            for j, (q, v, a) in zip(group, _triples(new), strict=True):
                positions.append(q)
                emit.store(q, memory.new, j)
                emit.store(v * per_unit, memory.new, n + j)
                emit.store(a * acceleration_unit, memory.series_a, j)
        return positions

    def evaluate_defect(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that stores DEFECT, the defect of the series at the end of the step, see `compute_defect`."""
        memory = self.memory(emit, order, control, work)
        a = [emit.load(memory.a, j) for j in range(self.n)]
        emit.store(self.compute_defect(emit, control, memory, a), work, lanes.DEFECT)

    def compute_defect(self, emit: LaneEmitter, control: Value, memory: LaneMemory, a: list[Value]) -> Value:
        """Return the defect of the Taylor series at the state NEW, relative to the allowed defect.

        The defect is the difference between accelerations by the series and `a`, accelerations by the equations.
        """
        n, (rtol, atol) = self.n, self.tolerances(emit, control)
        order, h = emit.to_double(memory.order), emit.load(memory.work, lanes.H)
        # if the step size h is 0, per_duration is infinite: then only the tolerances of velocities limit the defect
        duration, per_duration = h / order, order / h
        largest = max_defect = emit.constant(0.0)
        for each in a:
            largest = emit.maximum(abs(each), largest)
        noise = ROUNDING * largest
        for j, each in enumerate(a):
            defect = abs(emit.load(memory.series_a, j) - each)
            of_q, of_v = (atol[j] + rtol * abs(emit.load(memory.new, index)) for index in (j, n + j))
            allowed = emit.minimum_or_nan(of_v, of_q * per_duration)
            max_defect = emit.maximum_or_nan((defect - noise) / allowed, max_defect)
        return duration * max_defect

    def compute_prediction_error(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that stores PREDICTION_ERROR, the change of q by the projection relative to the allowed change."""
        n, memory, (rtol, atol) = self.n, self.memory(emit, order, control, work), self.tolerances(emit, control)
        h = emit.load(work, lanes.H)

        def magnitude(base: Value, index: int) -> Value:
            return abs(emit.load(base, index))

        def difference(first: Value, second: Value, index: int) -> Value:
            return abs(emit.load(first, index) - emit.load(second, index))

        motion = error = emit.constant(0.0)
        for j in range(n):
            distance = emit.maximum(h * magnitude(memory.state, n + j), difference(memory.new, memory.state, j))
            motion = emit.maximum(distance, motion)
        is_passage, least = self.crossing_mask(emit, memory), FRACTION_AT_SIGN_CHANGE * motion
        motion = FRACTION_OF_MOTION * motion
        for j in range(n):
            scale = atol[j] + rtol * emit.maximum(magnitude(memory.new, j), magnitude(memory.state, j))
            allowed = motion + FIXED_FRACTION * scale
            allowed = emit.minimum(scale, allowed)
            if is_passage is not None:
                allowed = emit.builder.select(is_passage, emit.minimum(scale, least), allowed)
            allowed = emit.maximum(allowed, emit.constant(LEAST))
            error = emit.maximum_or_nan(difference(memory.predicted, memory.new, j) / allowed, error)
        emit.store(error, work, lanes.PREDICTION_ERROR)

    def crossing_mask(self, emit: LaneEmitter, memory: LaneMemory) -> Value | None:
        """Return a mask of the lanes whose step may have passed a singular position; None if this is not checked."""
        return None

    def accept_or_reject(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that accepts (ACCEPTED = 1) or rejects steps, and stores LONGEST, the limit of the next step size.

        A run leaves its lane (RUNNING = 0) after MAX_REJECTIONS + 1 successive rejections, or if a value is not finite.
        """
        builder, one = emit.builder, emit.constant(1.0)
        select, per_order = builder.select, one / emit.to_double(order)
        off, *defects = (emit.load(work, field) for field in (lanes.PREDICTION_ERROR, lanes.WORST_DEFECT, lanes.DEFECT))
        is_valid = is_set(emit, work, lanes.ACTIVE)
        for value in (off, *defects):
            magnitude = abs(value)
            is_valid = is_valid & (magnitude < math.inf)
        defect, shortest = emit.maximum(*defects), emit.constant(MIN_FACTOR)

        def root(x: Value) -> Value:
            return emit.exponential(emit.logarithm(x) * per_order)

        prediction_factor = root(TARGET_ERROR / off)
        factor = select(off > one, prediction_factor, one)
        defect_factor = SAFETY * root(one / defect)
        defect_factor = emit.minimum(factor, emit.maximum(shortest, defect_factor))
        factor = select(defect > one, defect_factor, factor)
        factor = select(is_valid, factor, shortest)
        is_running, is_refused = is_set(emit, work, lanes.RUNNING), factor < one
        is_accepted = is_running & (factor >= one)
        store_mask(emit, work, lanes.ACCEPTED, is_accepted)
        n_refused = emit.load(work, lanes.N_REJECTED)
        n_refused = select(is_running & is_refused, n_refused + one, n_refused)
        # if an error is not finite, end the run: shorter steps might jump over a point where equations are undefined
        n_refused = select(is_valid, n_refused, emit.constant(math.inf))
        emit.store(n_refused, work, lanes.N_REJECTED)
        h_longest = emit.load(work, lanes.H) * select(is_refused, factor, emit.constant(MAX_FACTOR))
        emit.store(select(is_running, h_longest, emit.load(work, lanes.LONGEST)), work, lanes.LONGEST)
        within_limit = n_refused <= float(MAX_REJECTIONS)
        store_mask(emit, work, lanes.RUNNING, is_running & within_limit)

    def commit(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that copies NEW to STATE in the lanes where the step was accepted."""
        memory = self.memory(emit, order, control, work)
        is_accepted = is_set(emit, work, lanes.ACCEPTED)
        for k in range(2 * self.n):
            emit.store(
                emit.builder.select(is_accepted, emit.load(memory.new, k), emit.load(memory.state, k)), memory.state, k
            )

    def tolerances(self, emit: LaneEmitter, control: Value) -> tuple[Value, list[Value]]:
        """Return rtol and a list of atol, one for each coordinate, all broadcast to the lanes."""
        atol = [broadcast_entry(emit, control, lanes.ATOL + j) for j in range(self.n)]
        return broadcast_entry(emit, control, lanes.RTOL), atol

    def memory(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> LaneMemory:
        """Return the LaneMemory for `work`; also set the pointers of `emit` to the coefficients."""
        *fixed, series = lanes.array_offsets(self.n, self.n_rows, self.n_numbers)
        emit.numbers = emit.pointer(work, fixed.pop())
        emit.constants = emit.builder.advance(control, integer(lanes.ATOL + self.n))
        series_memory = emit.pointer(work, series)
        n_coefficients = order + 1
        scratch = emit.pointer(series_memory, n_coefficients * self.n)
        state, new, predicted, series_a, a, lam = (emit.pointer(work, index) for index in fixed)
        return LaneMemory(order, work, state, new, predicted, series_a, a, lam, series_memory, scratch)


def _triples(values: list[Value]) -> Iterator[tuple[Value, Value, Value]]:
    return zip(values[::3], values[1::3], values[2::3], strict=True)


def broadcast_entry(emit: LaneEmitter, control: Value, index: int) -> Value:
    """Return entry `index` of the array `control`, broadcast to all lanes."""
    return emit.broadcast(emit.builder.load(emit.builder.advance(control, integer(index))))


def is_set(emit: LaneEmitter, work: Value, field: int) -> Value:
    """Return the mask of the lanes where a field is not 0."""
    return emit.builder.compare("fcmp one", emit.load(work, field), emit.constant(0.0))


def store_mask(emit: LaneEmitter, work: Value, field: int, mask: Value) -> None:
    """Write code that sets a field to 1 in the lanes of a mask, and to 0 in the other lanes."""
    emit.store(emit.builder.select(mask, emit.constant(1.0), emit.constant(0.0)), work, field)


def clear_active_unless(emit: LaneEmitter, work: Value, is_valid: Value) -> None:
    """Write code that sets ACTIVE = 0 in the lanes where `is_valid` is false."""
    store_mask(emit, work, lanes.ACTIVE, is_set(emit, work, lanes.ACTIVE) & is_valid)


SparseRows = list[dict[int, Value]]  # the nonzero entries of each row, by column


def orientation_change_mask(emit: LaneEmitter, before: SparseRows, after: SparseRows) -> Value:
    """Return a mask of the lanes whose step may have passed a singular position, by the rows of C_q at both ends.

    A lane is masked if det(G1 G0^T) <= 0, where G0 (`before`) and G1 (`after`) are the rows. By the Cauchy-Binet
    formula, the determinant is the inner product of the vectors of maximal minors of G0 and G1. If these vectors are
    similar, the determinant is positive. A step through a position at which the rows become dependent may lead to
    another assembly: then all minors change their signs. Lanes in which a pivot of G1 G0^T is zero are masked, too.
    """
    matrix: list[dict[int, Value]] = [{} for _ in before]
    for i, row in enumerate(after):
        for k, row_before in enumerate(before):
            total: Value | None = None
            for j in sorted(row.keys() & row_before.keys()):
                term = row[j] * row_before[j]
                total = term if total is None else total + term
            if total is not None:
                matrix[i][k] = total
    one, zero, select, compare = emit.constant(1.0), emit.constant(0.0), emit.builder.select, emit.builder.compare
    remaining, sign = set(range(len(matrix))), one
    while remaining:
        # choose the pivot whose row has the fewest entries (minimum degree; rows and columns have the same pattern)
        i = min(remaining, key=lambda each: (len(matrix[each]), each))
        remaining.remove(i)
        pivot = matrix[i].pop(i)
        sign_unless_positive = select(compare("fcmp olt", pivot, zero), -sign, zero)
        sign = select(compare("fcmp ogt", pivot, zero), sign, sign_unless_positive)
        inverse = one / pivot
        for k in sorted(remaining):
            if i in matrix[k]:
                multiple = matrix[k].pop(i) * inverse
                for j, value in matrix[i].items():
                    change = multiple * value
                    entry = matrix[k].get(j)
                    matrix[k][j] = -change if entry is None else entry - change
    return compare("fcmp ule", sign, zero)


Array = NDArray[np.float64]

WEIGHT_ROUNDING = 1e-13  # weights of stages up to this size count as zero: they are rounding errors

# explicit Runge-Kutta method: arrays A, b, c of its Butcher tableau, then weights of stages in two error estimates
Tableau = tuple[Array, Array, Array, Array, Array]


class LaneStages:
    """Code generator for the stages and error estimates of an explicit Runge-Kutta method, with n coordinates.

    With the matrix A of the Butcher tableau, velocities at stages are sums of accelerations weighted by A; positions
    use the weights A @ A. Weights are literals in the code; terms with a weight of zero are left out.
    """

    def __init__(self, tableau: Tableau, n: int):
        self.tableau, self.n = tableau, n

    @property
    def structure(self) -> list[bytes]:
        """Return the tableau as a list of bytes; the code depends only on the tableau and on n."""
        return [np.asarray(each).tobytes() for each in self.tableau]

    def write(self, emit: LaneEmitter, arguments: tuple[Value, Value, Value], memory: LaneMemory) -> None:
        """Write code that stores NEW, the state at the end of a step of X seconds, and ERROR, the estimated error."""
        A, b, c, fine_weights, coarse_weights = self.tableau
        _, control, work = arguments
        x, t = emit.load(work, lanes.X), emit.load(work, lanes.T)
        for i in range(1, len(b)):
            stage_time = t + c[i] * x
            emit.store(stage_time, work, lanes.T_NEW)
            with emit.loop(integer(0), integer(self.n), []) as (j, _, _):
                coordinate = _Coordinate(self, emit, memory, j, i)
                coordinate.store_state(A[i], A[i] @ A, x)
            emit.builder.call_void("compute_accelerations", arguments)
        rtol, zero = broadcast_entry(emit, control, lanes.RTOL), emit.constant(0.0)
        with emit.loop(integer(0), integer(self.n), [zero, zero, zero]) as (j, (e, d, total), new):
            coordinate = _Coordinate(self, emit, memory, j, len(b))
            new_state = coordinate.store_state(b, b @ A, x)
            atol_pointer = emit.builder.advance(control, j + lanes.ATOL)
            atol = emit.broadcast(emit.builder.load(atol_pointer))
            error_weights = [
                coordinate.error_weight(atol, rtol, *each) for each in zip(coordinate.old_state, new_state, strict=True)
            ]
            for largest, weights in ((e, fine_weights), (d, coarse_weights)):
                of_q, of_v = x * coordinate.sum(weights @ A), coordinate.sum(weights)
                for off, weight in zip((of_q, of_v), error_weights, strict=True):
                    largest = emit.maximum(abs(off) * weight, largest)
                    total = total + zero * off
                new.append(largest)
            for each in new_state:
                total = total + zero * each
            new.append(total)
        e, d, total = *(x * each for each in new[:2]), new[2]
        ratio = d / e
        error = e / emit.function("sqrt", 1.0 + ratio * ratio)
        select, compare = emit.builder.select, emit.builder.compare
        error = select(compare("fcmp ogt", e, zero), error, zero)
        # the maxima e and d ignore NaN; `total`, a sum of 0 * values, is NaN if a value is not finite
        error = select(compare("fcmp oeq", total, zero), error, emit.constant(math.inf))
        emit.store(error, work, lanes.ERROR)


class _Coordinate:
    """Coordinate j in a loop over j: its state before the step, and accelerations at the first `count` stages."""

    def __init__(self, stages: LaneStages, emit: LaneEmitter, memory: LaneMemory, j: Value, count: int):
        n, self.emit, self.new, self.n = stages.n, emit, emit.pointer(memory.new, j), stages.n
        series_pointer = emit.pointer(memory.series, j)
        self.old_state = tuple(emit.load(series_pointer, lanes.BEGIN * n + index) for index in (0, n))
        self._acceleration_locations = [(series_pointer, (lanes.SLOPES + k) * n) for k in range(count)]
        self._loaded: dict[int, Value] = {}
        if count > 1:  # the acceleration of the last stage is still in `a`: store it with those of earlier stages
            self._loaded[count - 1] = emit.load(emit.pointer(memory.a, j))
            emit.store(self._loaded[count - 1], *self._acceleration_locations[count - 1])

    def sum(self, weights: Array) -> Value:
        """Return the weighted sum of the accelerations of this coordinate at the stages."""
        total: Value | None = None
        for k, weight in enumerate(weights.tolist()):
            if abs(weight) > WEIGHT_ROUNDING:
                if k not in self._loaded:
                    self._loaded[k] = self.emit.load(*self._acceleration_locations[k])
                term = weight * self._loaded[k]
                total = term if total is None else total + term
        return self.emit.constant(0.0) if total is None else total

    def error_weight(self, atol: Value, rtol: Value, before: Value, after: Value) -> Value:
        """Return the reciprocal of the allowed error of a position or velocity that goes from `before` to `after`."""
        emit = self.emit
        magnitude = emit.maximum(abs(before), abs(after))
        return 1.0 / (atol + rtol * magnitude)

    def store_state(self, weights: Array, position_weights: Array, x: Value) -> tuple[Value, Value]:
        """Write code that stores q and v of a stage, computed with weighted accelerations, in NEW; return q and v."""
        emit, (q, v) = self.emit, self.old_state
        drift = float(weights.sum()) * v
        q = q + x * (drift + x * self.sum(position_weights))
        v = v + x * self.sum(weights)
        for value, index in ((q, 0), (v, self.n)):
            emit.store(value, self.new, index)
        return q, v


GOLDEN_SECTION = 0.6180339887498949  # the multiples of this number, modulo 1, are spread evenly on [0, 1]
MAX_PARTS = 1000.0  # a step is divided into at most this number of equal parts, between which defects are evaluated
MAX_SERIES_OPERATIONS = 1500  # no code is generated for series with more operations than this: compiling takes seconds


class LaneCode(LaneSteps):
    """Code generator for one mechanism in SIMD lanes, including the step-size control.

    series : whether to generate code for Taylor steps.
    tableau : Butcher tableau of an explicit Runge-Kutta method, for whose stages code is generated; None: no such code.
    Raise Untraceable if the equations, or their series, cannot be generated; the message says why.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        choice: PivotChoice,
        parameters: Any,
        series: bool,
        tableau: Tableau | None = None,
    ):
        if system.n_a > 0:
            raise Untraceable("it has nonholonomic rows")
        self.numbers = Coefficients(separate_varying=True)
        self.equations = equations = Elimination(system, choice, Equations(system, parameters))
        self.solution = FactorAndSolvePrograms(self.equations)
        super().__init__(system.n_q, system.n_c + system.n_a)
        self.recurrences: LaneSeries | None = None
        self.stage_generator = None if tableau is None else LaneStages(tableau, self.n)
        if series:
            program = series_program(system, Equations(system, parameters), {*choice.rows, *choice.added_rows})
            if program.n_operations > MAX_SERIES_OPERATIONS:
                raise Untraceable(f"its series takes more than {MAX_SERIES_OPERATIONS} operations")
            self.recurrences = LaneSeries(program, self.solution, self.numbers, self.n, self.n_rows)
        rows = self.equations.rows
        self._row_entries = [(k, j) for k, row in enumerate(rows) for j in range(self.n) if not is_zero(row[j])]
        self._row_program = Program(equations.graph, {"G": [rows[k, j] for k, j in self._row_entries]})
        programs = [*equations.accelerations, equations.position_projection, equations.basic_projection]
        programs += [equations.redundant_rows, *([self.solution.factor_program] if series else [])]
        # `_structure` also assigns array indices to coefficients: the kernels need these even if the code is cached
        self.structure = self._structure(programs if series else [*programs, self._row_program])
        self.n_numbers = self.numbers.n_varying
        programs += [self.solution.solution_program] if series else []
        self.n_quantities = sum(len(each.quantities()) for each in programs)

    @property
    def tasks(self) -> tuple[str, ...]:
        """Return the names of the functions to generate."""
        if self.recurrences is not None:
            return *lanes.TASKS, *lanes.TASKS_OF_SERIES
        explicit_tasks = () if self.stage_generator is None else lanes.TASKS_OF_EXPLICIT
        return *lanes.TASKS, *lanes.TASKS_OF_STAGES, *explicit_tasks

    def series_size(self, order: int) -> int:
        """Return the number of vectors that a series up to `order` needs in `work`: coefficients and scratch memory."""
        assert self.recurrences is not None
        return (order + 1) * self.n + self.recurrences.scratch_size(order)

    def _structure(self, programs: list[Program]) -> str:
        numbers, description = self.numbers, list[Any]()
        if self.stage_generator is not None:
            description += self.stage_generator.structure
        if self.recurrences is not None:
            description += self.recurrences.structure
        for outputs in programs:
            description += [outputs.sizes, *numbers.structure(outputs)]
        if self.recurrences is not None:
            description += list(numbers.structure(self.solution.solution_program))
        return hashlib.sha256(repr(description).encode()).hexdigest()

    def compute_series(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that stores the Taylor coefficients of q(t) about the state STATE, with UNIT as unit of time."""
        builder, n, memory = emit.builder, self.n, self.memory(emit, order, control, work)
        unit, out, scratch = self.update_unit(emit, control, work), memory.series, memory.scratch
        inputs = [emit.load(work, lanes.T), *(emit.load(memory.state, i) for i in range(2 * n))]
        lowering, (kept,) = lower_program(emit, self.solution.factor_program, inputs, self.numbers)
        is_valid = lowering.is_valid(self.solution.factor_program, kept)
        for i, value in enumerate(kept):
            emit.store(value, scratch, i)
        for j in range(n):
            emit.store(inputs[1 + j], out, j)
            emit.store(unit * inputs[1 + n + j], out, n + j)
        assert self.recurrences is not None
        self.recurrences.write_order_0(emit, inputs, scratch)
        with emit.loop(integer(1), order, []) as (k, _, _):
            self.recurrences.write_order(emit, k, unit, out, scratch)
        last_row, total = emit.pointer(out, order * n), emit.constant(0.0)
        for j in range(n):
            total = total + 0.0 * emit.load(last_row, j)
        is_valid = is_valid & builder.compare("fcmp oeq", total, emit.constant(0.0))
        store_mask(emit, work, lanes.ACTIVE, is_valid)

    def check_defect_within(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that stores WORST_DEFECT, the largest defect at several times within the step.

        The step is divided into equal parts of at most GAP (s). The times are the ends of these parts, all moved by
        (2 SHIFT - 1) * (GAP - size of a part); SHIFT varies from step to step. Finally, T_NEW is the end of the step.
        """
        builder, memory = emit.builder, self.memory(emit, order, control, work)
        h, gap = emit.load(work, lanes.H), broadcast_entry(emit, control, lanes.GAP)
        zero, one, two = (emit.constant(x) for x in (0.0, 1.0, 2.0))
        n_lane_parts = emit.function("ceil", h / gap)
        n_lane_parts = emit.maximum(emit.minimum(n_lane_parts, emit.constant(MAX_PARTS)), one)
        part_size = h / n_lane_parts
        shift = emit.load(work, lanes.SHIFT) + GOLDEN_SECTION
        shift = shift - builder.select(shift >= one, one, zero)
        emit.store(shift, work, lanes.SHIFT)
        offset = (two * shift - one) * emit.maximum(gap - part_size, zero)
        n_parts = builder.convert("fptosi", emit.max_over_lanes(n_lane_parts), INTEGER)
        with emit.loop(integer(1), n_parts, [zero]) as (index, (max_defect,), new):
            part = emit.to_double(index)
            is_inside = part < n_lane_parts
            x = builder.select(is_inside, part * part_size + offset, zero)
            emit.store(emit.load(work, lanes.T) + x, work, lanes.T_NEW)
            self.evaluate_positions(emit, memory, x / emit.load(work, lanes.UNIT))
            is_valid, a = self._accelerations(emit, work, memory)
            defect = builder.select(is_valid, self.compute_defect(emit, control, memory, a), emit.constant(math.inf))
            new.append(emit.maximum_or_nan(builder.select(is_inside, defect, zero), max_defect))
        emit.store(new[0], work, lanes.WORST_DEFECT)
        t, t1 = emit.load(work, lanes.T), broadcast_entry(emit, control, lanes.T1)
        is_last = builder.compare("fcmp oeq", h, t1 - t)
        emit.store(builder.select(is_last, t1, t + h), work, lanes.T_NEW)

    def correct_positions(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code for a Newton step to C = 0 in ACTIVE lanes; set ACTIVE, UNCONVERGED to 1 on success, else 0."""
        is_active, _ = self._project(
            emit, self.equations.position_projection, lanes.ACTIVE, self.memory(emit, order, control, work)
        )
        for field in (lanes.ACTIVE, lanes.UNCONVERGED):
            store_mask(emit, work, field, is_active)
        emit.store(emit.constant(math.inf), work, lanes.LAST_CORRECTION)

    def correct_state(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that projects NEW once in lanes with UNCONVERGED = 1, and stores accelerations and multipliers.

        Then ACTIVE is 1 in lanes that have converged, else 0; UNCONVERGED is 1 in lanes that need another call, else 0.
        """
        memory = self.memory(emit, order, control, work)
        was_active, is_unfinished = (is_set(emit, work, field) for field in (lanes.ACTIVE, lanes.UNCONVERGED))
        is_active, moved = self._project(emit, self.equations.basic_projection, lanes.UNCONVERGED, memory)
        largest = emit.constant(0.0)
        for j in range(self.n):
            largest = emit.maximum(abs(emit.load(memory.new, j)), largest)
        tolerance = RELATIVE_CORRECTION * largest
        tolerance = emit.maximum(tolerance, emit.constant(ABSOLUTE_CORRECTION))
        converged = is_active & (moved <= tolerance)
        limit = CONTRACTION * emit.load(work, lanes.LAST_CORRECTION)
        is_continued = is_active & (moved <= limit)
        is_continued = is_continued & (moved > tolerance)
        emit.store(emit.maximum(moved, tolerance), work, lanes.LAST_CORRECTION)
        store_mask(emit, work, lanes.UNCONVERGED, is_continued)
        has_finished = was_active ^ was_active & is_unfinished
        store_mask(emit, work, lanes.ACTIVE, has_finished | converged)

    def _project(self, emit: LaneEmitter, outputs: Program, field: int, memory: LaneMemory) -> tuple[Value, Value]:
        """Write code that corrects NEW by the projection program `outputs` in the lanes where `field` is 1.

        Return a mask of the lanes whose correction is valid, and the largest change of a position in each lane.
        """
        select, work = emit.builder.select, memory.work
        inputs = self._new_state(emit, work, memory)
        lowering, arrays = lower_program(emit, outputs, inputs, self.numbers)
        values = dict(zip(outputs.arrays, arrays, strict=True))
        is_active = is_set(emit, work, field) & lowering.is_valid(outputs, arrays[0])
        largest = emit.constant(0.0)
        for value in values["moved"]:
            largest = emit.maximum(abs(value), largest)
        for k, value in enumerate([*values["q"], *values.get("v", [])]):
            emit.store(select(is_active, value, inputs[1 + k]), memory.new, k)
        for base, name in ((memory.a, "a"), (memory.lam, "lam")):
            for k, value in enumerate(values.get(name, [])):
                emit.store(select(is_active, value, emit.load(base, k)), base, k)
        return is_active, largest

    def compute_accelerations(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that stores accelerations at (T_NEW, NEW), and sets ACTIVE = 0 in lanes where they are invalid."""
        memory = self.memory(emit, order, control, work)
        is_valid, a = self._accelerations(emit, work, memory)
        for k, value in enumerate(a):
            emit.store(value, memory.a, k)
        clear_active_unless(emit, work, is_valid)

    def _accelerations(self, emit: LaneEmitter, work: Value, memory: LaneMemory) -> tuple[Value, list[Value]]:
        a, is_valid = write_accelerations(emit, self.equations, self._new_state(emit, work, memory), self.numbers)
        return is_valid, a

    def crossing_mask(self, emit: LaneEmitter, memory: LaneMemory) -> Value | None:
        """Return the `orientation_change_mask` of a step; None for Taylor steps, and if there are no constraints."""
        if self.recurrences is not None or len(self.equations.rows) == 0:
            return None
        ends_of_step = (lanes.T, memory.state), (lanes.T_NEW, memory.new)
        return orientation_change_mask(emit, *(self._row_values(emit, memory, *end) for end in ends_of_step))

    def _row_values(self, emit: LaneEmitter, memory: LaneMemory, time: int, base: Value) -> list[dict[int, Value]]:
        """Write code for C_q; return {column: entry} for each row. `time`: T or T_NEW; `base`: pointer to [q, v]."""
        inputs = [emit.load(memory.work, time), *(emit.load(base, i) for i in range(2 * self.n))]
        _, (entries,) = lower_program(emit, self._row_program, inputs, self.numbers)
        rows: list[dict[int, Value]] = [{} for _ in self.equations.rows]
        for (k, j), value in zip(self._row_entries, entries, strict=True):
            rows[k][j] = value
        return rows

    def compute_stages(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that computes the stages of an explicit step, and stores NEW and ERROR."""
        assert self.stage_generator is not None
        self.stage_generator.write(emit, (order, control, work), self.memory(emit, order, control, work))

    def check_redundant_rows(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that sets ACTIVE = 0 in the lanes where NEW violates a redundant constraint."""
        memory, outputs = self.memory(emit, order, control, work), self.equations.redundant_rows
        lowering, (no_values,) = lower_program(emit, outputs, self._new_state(emit, work, memory), self.numbers)
        clear_active_unless(emit, work, lowering.is_valid(outputs, no_values))

    def _new_state(self, emit: LaneEmitter, work: Value, memory: LaneMemory) -> list[Value]:
        return [emit.load(work, lanes.T_NEW), *(emit.load(memory.new, i) for i in range(2 * self.n))]


class LaneConstraints(LaneSteps):
    """Code generator for C, C_t and the entries of C_q in SIMD lanes.

    system : a system without nonholonomic rows.
    Fields:
    pattern : sparsity pattern of C_q in one array. It contains, in this order, the index at which the column indices of
        each row begin in the array; the length of the array; and the column index of each entry, row by row.
    Raise Untraceable if the constraints cannot be generated; the message says why.
    """

    tasks = lanes.TASKS_OF_STARTS

    def __init__(self, system: ConstrainedSystem, parameters: Any):
        super().__init__(system.n_q, system.n_c)
        equations, self.numbers = Equations(system, parameters), Coefficients(separate_varying=True)
        G, self._graph = equations.expressions("jacobian"), equations.graph
        columns = [[j for j, entry in enumerate(row) if not is_zero(entry)] for row in G]
        begins = np.cumsum([len(columns) + 1, *map(len, columns)])
        self.pattern = np.array([*begins, *chain(*columns)], dtype=np.int64)
        entries = [G[i, j] for i, row in enumerate(columns) for j in row]
        values = {kind: list(equations.expressions(kind)) for kind in ("constraint", "constraint_rate")}
        self._program = Program(self._graph, {**values, "entries": entries})
        description = self.n, self.pattern.tolist(), *self.numbers.structure(self._program)
        self.structure = hashlib.sha256(repr(description).encode()).hexdigest()
        self.n_numbers, self.n_quantities = self.numbers.n_varying, len(self._program.quantities())

    def compute_rows(self, emit: LaneEmitter, order: Value, control: Value, work: Value) -> None:
        """Write code that stores C, C_t and the entries of C_q at (T_NEW, NEW) in the array `LaneMemory.series`."""
        memory = self.memory(emit, order, control, work)
        inputs = [emit.load(work, lanes.T_NEW), *(emit.load(memory.new, i) for i in range(2 * self.n))]
        lowering, arrays = lower_program(emit, self._program, inputs, self.numbers)
        values = [value for array in arrays for value in array]
        for k, value in enumerate(values):
            emit.store(value, memory.series, k)
        clear_active_unless(emit, work, lowering.is_valid(self._program, values))


SECONDS_PER_QUANTITY = 3e-4  # estimated time (s) to compile one operation
# modules that write code: after a change of such a module, code in the cache on the disk is not used any more
ELIMINATION_MODULES = (elimination, null_space, compile_equations)  # modules that write code for accelerations
CODE_MODULES = (series, *ELIMINATION_MODULES, program, lane_series, llvm_code, llvm_text)

Code = TypeVar("Code", LaneCode, LaneConstraints)
FILE_PREFIX = "lanes"  # first part of the names of cached files


class GeneratedLanes(Generic[Code]):
    """Compiled code of a mechanism for SIMD lanes; its coefficients are computed from parameters.

    tape : ParameterTape (parameter_expressions.py), which computes the coefficients of `code` from parameters.
    """

    def __init__(self, tape: ParameterTape, code: Code):
        self.tape = tape
        self.code: Code = code

    @cached_property
    def functions(self) -> GeneratedFunctions:
        """Return the compiled functions; the first use compiles them, or reads them from the disk."""
        return generated_functions(FILE_PREFIX, _stamp(), self.code.structure, self._module_text)

    def _module_text(self) -> tuple[list[str], str]:
        module = Module()
        for name in self.code.tasks:
            llvm_code.write(module, name, CODE.llvm_signature(name), getattr(self.code, name), LaneEmitter)
        return list(self.code.tasks), str(module)

    @property
    def seconds_to_build(self) -> float:
        """Return the estimated time (s) to compile the code; 0 if the code is in memory or on the disk."""
        if are_cached(FILE_PREFIX, _stamp(), self.code.structure):
            return 0.0
        return SECONDS_PER_QUANTITY * self.code.n_quantities

    def coefficients_for(self, parameters: Array) -> Array:
        """Return the coefficients (n_runs, n_numbers) that vary between runs, for parameters (n_runs, n_p)."""
        return self.code.numbers.values_for(self.tape, parameters)


@cache
def _stamp() -> str:
    """Return a digest of the modules that write the code, and of the kernels that call it."""
    from twoloop.kernels.data import common

    kernels = ("lanes.control", "control.step_size")
    return digest_of("".join(map(common.source_digest, kernels)), __file__, *CODE_MODULES)
