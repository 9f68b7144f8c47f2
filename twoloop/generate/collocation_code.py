"""Generate code for collocation steps whose stages are evaluated side by side, one in each SIMD lane.

A fixed-point iteration solves for the stages of an implicit Runge-Kutta step. Each sweep (one iteration) evaluates the
accelerations of all stages at once, one in each lane, and integrates them: a sweep takes little longer than one
evaluation. Usually the accelerations depend on some of the coordinates only. Only these are iterated; the others
follow from the final accelerations. The ends of eight steps are projected onto the constraints at once, too.
kernels/steps/lobatto_step.py calls the generated functions, which share an array `work` (kernels/data/collocation.py).

The method is Lobatto IIIA with nine nodes, the first of which is the end of the previous step; its order is 16. The
polynomial of degree 8 through the accelerations at the nodes is expanded in Legendre polynomials, whose integrals and
derivatives at the ends are known (Hairer & Wanner, Solving ODEs II, IV.5).
"""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from math import comb
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from twoloop.generate import lane_series, llvm_code
from twoloop.generate.compile_equations import GeneratedCode, SharedCode, call_accelerations
from twoloop.generate.lane_series import (
    LaneEmitter,
    gather_lane,
    load_lanes,
    loop_over_coordinates,
    store_lanes,
    two_sums,
)
from twoloop.generate.llvm_code import Emitter, Lowering, lower_program
from twoloop.generate.llvm_text import BIT, DOUBLE, INTEGER, VOID, Module, Value, constant, constants, integer
from twoloop.generate.program import Program
from twoloop.kernels.compile.dependencies import digest_of
from twoloop.kernels.compile.generated_functions import DeferredFunctions, generated_functions
from twoloop.kernels.data import collocation as mem
from twoloop.kernels.data.collocation import LANES
from twoloop.kernels.data.indices import ATOL, ESTIMATE, RTOL

Array = NDArray[np.float64]
Extended = NDArray[np.longdouble]
N = 9  # number of nodes of a step, with both ends


class Tables(NamedTuple):
    """Nodes c_0 = 0, ..., c_8 = 1, and matrices (9, 8) for the polynomial p through the nine `values` at the nodes.

    The time x runs from 0 to 1 in a step. If m is one of the matrices, `values @ m` are eight numbers, as follows.
    nodes, between : no matrices, but the nodes c_1 to c_8, and the eight midpoints between neighbouring nodes.
    velocities, positions : single and double integrals of p from 0 to each of c_1 to c_8.
    values_between, velocities_between, positions_between : p at the midpoints; its single and double integrals there.
    spectrum : coefficients of p in the Legendre polynomials of degree 1 to 8 on [0, 1]; these polynomials are 1 at 1.
    begin, end : coefficients of p in the powers 1 to 8 of x (`begin`), and in the powers 1 to 8 of x - 1 (`end`).
    """

    nodes: Array
    between: Array
    velocities: Array
    positions: Array
    values_between: Array
    velocities_between: Array
    positions_between: Array
    spectrum: Array
    begin: Array
    end: Array


@cache
def tables() -> Tables:
    """Return the nodes and matrices, computed in extended precision and then rounded to double precision."""
    x = _nodes()
    between: Extended = (x[1:] + x[:-1]) / np.longdouble(2)
    values = _legendre(x)
    weights = 2 / (N * (N - 1) * values[N - 1] ** 2)
    norms = np.array([np.longdouble(2) / (2 * k + 1) for k in range(N)])
    norms[N - 1] = np.longdouble(2) / (N - 1)  # the quadrature rule yields this for the integral of P_8^2, not 2 / 17
    coefficients = values[:N] * weights / norms[:, None]  # [k, j]: Legendre coefficient k of Lagrange polynomial j
    powers = [
        np.array([[sign ** (n + k) * comb(n, k) * comb(n + k, k) for n in range(N)] for k in range(1, N)]).T
        for sign in (-1, 1)
    ]
    extended = (
        *((each + 1) / 2 for each in (x[1:], between)),
        *_integrals(coefficients, x[1:])[1:],
        *_integrals(coefficients, between),
        coefficients[1:].T,
        *(coefficients.T @ each.astype(np.longdouble) for each in powers),
    )
    return Tables(*(each.astype(np.float64) for each in extended))


def _nodes() -> Extended:
    """Return the nodes, scaled to [-1, 1]: -1, 1, and the zeros of the derivative of the Legendre polynomial P_8."""
    zeros = legendre.legroots(legendre.legder([0] * (N - 1) + [1])).astype(np.longdouble)
    derivative = legendre.legder(np.array([0] * (N - 1) + [1], dtype=np.longdouble))
    for _ in range(3):
        zeros = zeros - legendre.legval(zeros, derivative) / legendre.legval(zeros, legendre.legder(derivative))
    return np.concatenate([[np.longdouble(-1)], np.sort(zeros), [np.longdouble(1)]])


def _legendre(z: Extended) -> Extended:
    """Return the values of the Legendre polynomials P_0 to P_10 at z, one row for each polynomial."""
    return np.array([legendre.legval(z, np.array([0] * k + [1], dtype=np.longdouble)) for k in range(N + 2)])


def _integrals(coefficients: Extended, z: Extended) -> tuple[Extended, Extended, Extended]:
    """Return the values, integrals and double integrals of the Lagrange polynomials (rows) at points z (columns).

    coefficients[k, j] is the coefficient of the Legendre polynomial P_k in the Lagrange polynomial of node j. The
    points z are on [-1, 1]. The variable of integration is the time (z + 1) / 2; integrals begin at time 0.
    """
    values = _legendre(z)
    # integral of the Legendre polynomial P_k from -1 to z: (P_k+1 - P_k-1) / (2 k + 1); if k = 0, it is P_1 + 1
    single = np.array([values[1] + 1, *((values[k + 1] - values[k - 1]) / (2 * k + 1) for k in range(1, N + 1))])
    double = np.array([single[1] + single[0], *((single[k + 1] - single[k - 1]) / (2 * k + 1) for k in range(1, N))])
    return coefficients.T @ values[:N], coefficients.T @ single[:N] / 2, coefficients.T @ double / 4


MAX_OPERATIONS = 5000  # equations with more operations than this get no collocation code: compiling would take over 2 s
MIN_DIVISOR = 1e-300  # this replaces smaller divisors and smaller allowed errors, so that no division by zero occurs
INVALID = -1.0  # returned by `find_defect` instead of a defect (at least 0), if accelerations cannot be computed
INFINITE = float("inf")
# the pivots of the elimination are chosen before the run. If a pivot is too small in a step, another elimination, which
# begins with the mass matrix M, computes the accelerations in this step and in this number of later steps
STEPS_BY_MASS_FIRST = 8.0
FIRST_DEGREE = 3.0  # degree of the polynomial that predicts the accelerations in the second step of a run

# contraction rho: change of velocities by a sweep (one iteration for all stages) / their change by the sweep before
KAPPA = 0.02  # sweeps end if the estimated error of the iteration, relative to the tolerances, is at most this
TARGET_SWEEPS = 6.0  # number of sweeps (iterations) in which a step should converge: the step size is chosen for this
EXTRA_SWEEPS = 7  # a step is rejected if it has not converged after the target number of sweeps and this number more
MAX_CONTRACTION = 0.8  # from sweep 4 on, reject the step if |change of v| / |previous sweep's change| is at least this
MIN_RHO, MAX_RHO = 1e-3, 0.9  # the ratio rho of changes of v by successive sweeps is clipped to these bounds
FAST_START, SLOW_START = 0.04, 0.3  # keep guessed step sizes if |change of v by sweep 2 / by sweep 1| is between these
STAGNATION_RATIO = 0.5  # sweeps also end if the change of v is of rounding size and at least this * the previous change
# with steps of fixed size, sweeps (iterations) end if the error of the iteration is at most KAPPA_OF_FIXED * tolerance,
# if changes of velocities v are below ROUNDING_OF_FIXED * |v| and do not decay, or after MAX_SWEEPS_OF_FIXED sweeps
KAPPA_OF_FIXED, ROUNDING_OF_FIXED, MAX_SWEEPS_OF_FIXED = 1e-16, 1e-9, 60.0
SMALLEST_RATIO = 1e-30  # added to (error of the iteration) / KAPPA before its logarithm is taken: the error may be 0
ERROR_WEIGHT = 0.5  # the estimated error of a step is multiplied by this factor, see `_estimate_error`
# a step is rejected if (step size) * defect is larger than this * the tolerance of a velocity. The defect is the
# deviation of the polynomial of the accelerations from the equations of motion, halfway between two nodes
ALLOWED_DEFECT = 16.0


def compiles_quickly(shared: SharedCode) -> bool:
    """Return True if collocation code for these equations compiles within a few seconds."""
    return shared.equations.n_operations <= MAX_OPERATIONS


class CollocationCode:
    """Generator of the functions for the collocation steps of one mechanism.

    Emitters write LLVM operations: `emit` on vectors of LANES numbers, `num` on single numbers, `vec2` on vectors of
    two numbers, and `wide` on vectors with one number for each of several successive coordinates.

    shared : code of the equations; the functions for collocation steps read the same array of coefficients.
    Fields:
    iterated_coordinates : coordinates on whose positions or velocities the accelerations depend.
    numbers : coefficients of the equations, with their indices in the array from which the functions read them.
    structure : key of cached functions, a digest of all that determines the functions except values of `numbers`.
    """

    def __init__(self, shared: SharedCode):
        self.equations, self.numbers, self.split_functions = shared.equations, shared.numbers, shared.split_functions
        self.n, self.n_rows = self.equations.system.n_q, len(self.equations.all_rows)
        self.iterated_coordinates = self._find_iterated()
        self.other_coordinates = [i for i in range(self.n) if i not in self.iterated_coordinates]
        self.has_reduced = len(self.equations.accelerations) > 1
        (
            self.a_offset,
            self.q_offset,
            self.v_offset,
            self.polynomial_offset,
            self.spectrum_offset,
            self.end_offset,
            self.end_a_offset,
            self.lam_offset,
            self.memory_size,
        ) = mem.array_offsets(self.n, len(self.iterated_coordinates), self.n_rows)

        if self.split_functions is None:
            programs = [*self.equations.accelerations, self.equations.position_projection, self.equations.projection]
        else:  # the equations are split into functions, on which `shared.digest` already depends
            programs = self.equations.accelerations[:1]
        numbers = self.numbers
        description = [[each.sizes, *numbers.structure(each)] for each in programs]
        self.structure = hashlib.sha256(repr([shared.digest, description]).encode()).hexdigest()

    def _find_iterated(self) -> list[int]:
        graph, exprs = self.equations.graph, []
        for program in self.equations.accelerations:
            exprs += program.expressions
            exprs += [expr for i in program.quantities() for expr in graph.arguments(i)]
        inputs = {i for expr in exprs for i in expr.terms if graph.operations[i] is None}
        return sorted({(i - 1) % self.n for i in inputs if i > 0})

    def iterate_step(self, emit: LaneEmitter, work: Value, state: Value, tolerances: Value, numbers: Value) -> Value:
        """Write code that solves for the stages of a step; return the status that it computes, such as CONVERGED.

        This code computes accelerations with the fewest operations, and divides by pivots that were chosen before the
        run. After the last sweep, it checks that these pivots are large enough. If not, it solves for the stages again,
        with the elimination that begins with M; the next STEPS_BY_MASS_FIRST steps use this elimination, too. Pointers:
        `work` to the memory of data/collocation.py, `state` to [q, v, a] before the step, `numbers` to coefficients.
        """
        builder, num = emit.builder, Emitter(emit.builder)
        emit.numbers = emit.constants = numbers

        def iterate_mass_first() -> Value:
            name = self._mass_first_function(emit, [each.type for each in (work, state, tolerances, numbers)])
            return builder.call(name, DOUBLE, [work, state, tolerances, numbers])

        def evaluate(inputs: list[Value]) -> Callable[[], Value]:
            if self.split_functions is not None and not self.has_reduced:
                return self._evaluator(emit, work, state, 0)(inputs)
            program, lowering = self.equations.accelerations[0], Lowering(emit, self.numbers)
            (exprs,), graph = program.arrays.values(), self.equations.graph
            for quantity, value in enumerate(inputs):
                lowering.define(quantity, value)
            needed = graph.quantities_by_use([exprs[i] for i in self.iterated_coordinates])
            lowering.expressions(graph, [graph.quantity(i) for i in needed if not graph.is_late[i]])

            def store_accelerations(coordinates: list[int]) -> None:
                for i, value in zip(
                    coordinates, lowering.expressions(graph, [exprs[i] for i in coordinates]), strict=True
                ):
                    store_lanes(emit, value, work, self.a_offset + LANES * i)

            def store_others() -> Value:
                store_accelerations(self.other_coordinates)
                lowering.expressions(graph, [expr for pair in program.conditions for expr in pair])
                return lowering.is_valid(program, self._accelerations(emit, work))

            with self._repeated(emit, work, state) as velocities:
                for i, value in enumerate(velocities):
                    lowering.define(1 + self.n + i, value)
                store_accelerations(self.iterated_coordinates)
            return store_others

        def fallback() -> Value:
            if not self.has_reduced:
                return constant(DOUBLE, float(mem.NOT_COMPUTED))
            num.store(constant(DOUBLE, STEPS_BY_MASS_FIRST), work, mem.N_MASS_FIRST)
            return iterate_mass_first()

        if self.has_reduced:
            n_careful = num.load(work, mem.N_MASS_FIRST)
            with self._return_if(emit, n_careful > 0.0):
                num.store(n_careful - 1.0, work, mem.N_MASS_FIRST)
                builder.ret(iterate_mass_first())
        self._call(emit, "begin_nodes", self._predict_nodes, [work, state, tolerances])
        return self._iterate(emit, work, state, tolerances, evaluate, fallback)

    def _mass_first_function(self, emit: LaneEmitter, kinds: list[str]) -> str:
        """Return the name of a function, written once, that solves for stages by the elimination beginning with M."""
        module, name = emit.builder.module, "careful_nodes"
        if not module.defines(name):
            builder = module.function(name, DOUBLE, kinds, internal=True)
            inner_emit, (work, state, tolerances, numbers) = emit.copy_for_builder(builder), builder.arguments
            inner_emit.numbers = inner_emit.constants = numbers
            self._call(inner_emit, "begin_nodes", self._predict_nodes, [work, state, tolerances])
            mass_first = self._evaluator(inner_emit, work, state, -1)
            not_computed = constant(DOUBLE, float(mem.NOT_COMPUTED))
            builder.ret(self._iterate(inner_emit, work, state, tolerances, mass_first, lambda: not_computed))
        return name

    def _evaluator(
        self, emit: LaneEmitter, work: Value, state: Value, index: int
    ) -> Callable[[list[Value]], Callable[[], Value]]:
        """Return a function `evaluate` for `_iterate`; it writes calls of the program `accelerations[index]`."""
        accelerations = Emitter(emit.builder).pointer(work, self.a_offset)

        def evaluate(inputs: list[Value]) -> Callable[[], Value]:
            with self._repeated(emit, work, state) as velocities:
                arguments = [*inputs, *velocities]
                is_valid = call_accelerations(emit, self.equations, index, arguments, self.numbers, accelerations)
            return lambda: is_valid

        return evaluate

    def _accelerations(self, emit: LaneEmitter, work: Value) -> list[Value]:
        return [load_lanes(emit, work, self.a_offset + LANES * i) for i in range(self.n)]

    @contextmanager
    def _return_if(self, emit: LaneEmitter, condition: Value) -> Iterator[None]:
        """Return a context manager for code that runs only if `condition` is true, and that ends with a return."""
        builder = emit.builder
        return_block, next_block = builder.append_block(), builder.append_block()
        builder.branch(condition, return_block, next_block)
        builder.position_at_end(return_block)
        yield
        builder.position_at_end(next_block)

    def _call(self, emit: LaneEmitter, name: str, write: Callable[..., None], arguments: Sequence[Value]) -> None:
        """Write a call of the LLVM function `name`; if the module does not contain it yet, `write` writes its body."""
        module = emit.builder.module
        if not module.defines(name):
            builder = module.function(name, VOID, [each.type for each in arguments], internal=True)
            write(emit.copy_for_builder(builder), *builder.arguments)
            builder.ret(None)
        emit.builder.call_void(name, arguments)

    def _predict_nodes(self, emit: LaneEmitter, work: Value, state: Value, tolerances: Value) -> None:
        """Write code that stores predicted positions and velocities at the nodes, with which the iteration begins.

        The code also stores the fields WEIGHTS, STRICTER, SIZE and POWERS of `work` (data/collocation.py). WEIGHTS are
        reciprocals of allowed errors atol + rtol * x. Here x is |position| (or |velocity|) where the step begins, or
        its change in half a step if this is larger. If the step size is fixed, 1 and min(1, atol / rtol) replace rtol
        and atol, because no error of a step is estimated.
        """
        builder, num, n = emit.builder, Emitter(emit.builder), self.n
        has_fixed_size = builder.compare("fcmp oeq", num.load(tolerances, ESTIMATE), llvm_code.ZERO)
        h, own_rtol = num.load(work, mem.H), num.load(tolerances, RTOL)
        rtol = builder.select(has_fixed_size, llvm_code.ONE, own_rtol)
        wide, begins = self._vector_emitter(emit)
        zero = wide.constant(0.0)
        length, half, relative, divisor = (wide.broadcast(each) for each in (h, h * 0.5, rtol, own_rtol))
        largest = [zero] * 3
        for begin in begins:
            q, v, a = (abs(wide.load(num.pointer(state, m * n + begin))) for m in range(3))
            sizes = wide.maximum(q, half * v), wide.maximum(v, half * a)
            atol = wide.load(num.pointer(tolerances, ATOL + begin))
            atol = builder.select(has_fixed_size, wide.minimum(atol / divisor, wide.constant(1.0)), atol)
            of_q, of_v = (wide.fma(relative, each, atol) for each in sizes)
            is_v_stricter = of_v * length < of_q
            allowed = wide.maximum(builder.select(is_v_stricter, of_v, of_q), wide.constant(MIN_DIVISOR))
            weight = builder.select(is_v_stricter, wide.constant(1.0), length) / allowed
            wide.store(weight, num.pointer(work, mem.WEIGHTS + begin))
            is_iterated = [float(begin + k in self.iterated_coordinates) for k in range(wide.lanes)]
            iterated_weight = weight * (constants(is_iterated) if wide.lanes > 1 else is_iterated[0])
            scaled_v = iterated_weight * wide.fma(length, a, v)
            largest = [wide.maximum(*pair) for pair in zip((weight, iterated_weight, scaled_v), largest, strict=True)]
        max_weight, max_iterated_weight, scaled_v = (wide.max_over_lanes(each) for each in largest)
        if self.iterated_coordinates:
            num.store(max_weight / max_iterated_weight, work, mem.STRICTER)
            num.store(scaled_v, work, mem.SIZE)
        powers = self._powers(emit, h / num.load(work, mem.H_BEFORE))
        store_lanes(emit, powers, work, mem.POWERS)
        degree = emit.broadcast(num.load(work, mem.DEGREE))
        exponents = constants([float(k) for k in range(LANES)])
        used_powers = builder.select(exponents < degree, powers, emit.constant(0.0))
        polynomial = self._polynomial_pointer(emit, work, is_next=False)
        nodes = np.array(tables().nodes)
        # row k contains the single (`velocities`) or double (`positions`) integrals of x^k from 0 to the nodes 1 to 8
        velocities = np.array([nodes ** (k + 1) / (k + 1) for k in range(LANES + 1)])
        positions = np.array([nodes ** (k + 2) / ((k + 1) * (k + 2)) for k in range(LANES + 1)])
        with loop_over_coordinates(emit, self.iterated_coordinates) as (k, i, _, _):
            scaled = load_lanes(emit, num.pointer(polynomial, k * LANES)) * used_powers
            store_lanes(emit, scaled, work, mem.SCALED)
            terms = [num.load(num.pointer(state, i), 2 * n), *(num.load(work, mem.SCALED + j) for j in range(LANES))]
            self._store_stages(
                emit, work, state, k, i, [self._weighted_sum(emit, each, terms) for each in (velocities, positions)]
            )

    def _powers(self, emit: LaneEmitter, x: Value) -> Value:
        """Return the powers 1 to 8 of x, one in each lane."""
        builder, power = emit.builder, emit.broadcast(x)
        factors = []
        for bit in (1, 2, 4, 8):
            has_bit = Value(emit.bit_type, f"<{', '.join(f'{BIT} {int(bool(k + 1 & bit))}' for k in range(LANES))}>")
            factors.append(builder.select(has_bit, power, emit.constant(1.0)))
            power = power * power
        return factors[0] * factors[1] * (factors[2] * factors[3])

    def _vector_emitter(self, emit: LaneEmitter) -> tuple[LaneEmitter, list[int]]:
        """Return an emitter for vectors of successive coordinates, and the first coordinate of each vector."""
        lanes = min(LANES, 1 << (self.n.bit_length() - 1))
        return LaneEmitter(emit.builder, lanes), [*range(0, self.n - lanes, lanes), self.n - lanes]

    def _iterate(
        self,
        emit: LaneEmitter,
        work: Value,
        state: Value,
        tolerances: Value,
        evaluate: Callable[[list[Value]], Callable[[], Value]],
        fallback: Callable[[], Value],
    ) -> Value:
        """Write code for sweeps until the stages converge or the step is rejected; return the status that it computes.

        evaluate([times, *positions at the nodes]) writes the part of a sweep that stores the accelerations of the
        coordinates on which accelerations depend. It returns a second function, whose code runs after the last sweep:
        this code stores the accelerations of the other coordinates, and computes a flag for each lane: 1 if
        accelerations are finite and pivots large enough. If a flag is 0, code written by `fallback` yields the status.
        """
        builder, num = emit.builder, Emitter(emit.builder)

        def literal(value: float) -> Value:
            return constant(DOUBLE, value)

        has_estimate = builder.compare("fcmp one", num.load(tolerances, ESTIMATE), llvm_code.ZERO)
        degree, stricter = num.load(work, mem.DEGREE), num.load(work, mem.STRICTER)
        target = builder.select(
            degree >= 6.0,
            builder.select(degree >= 7.0, literal(TARGET_SWEEPS + 2), literal(TARGET_SWEEPS + 1)),
            literal(TARGET_SWEEPS),
        )
        max_sweeps = builder.select(has_estimate, target + EXTRA_SWEEPS, literal(MAX_SWEEPS_OF_FIXED))
        kappa, noise = (
            builder.select(has_estimate, literal(usual), literal(fixed))
            for usual, fixed in ((KAPPA, KAPPA_OF_FIXED), (mem.MAX_ROUNDING, ROUNDING_OF_FIXED))
        )
        noise = noise * (num.load(work, mem.SIZE) * stricter)
        may_guess = num.load(work, mem.MAY_GUESS) > 0.0
        t, h = num.load(work, mem.T), num.load(work, mem.H)
        times = emit.fma(constants(tables().nodes), emit.broadcast(h), emit.broadcast(t))
        rho_before = num.load(work, mem.RHO)
        before, loop, after = builder.block, builder.append_block(), builder.append_block()
        builder.jump(loop)
        builder.position_at_end(loop)
        carried = [builder.phi(DOUBLE) for _ in range(3)]
        sweeps, change_before, rho = carried
        for phi, value in zip(carried, (llvm_code.ZERO, llvm_code.ONE, rho_before), strict=True):
            phi.add_incoming(value, before)
        store_others = evaluate([times, *self._load_iterated(emit, num.pointer(work, self.q_offset))])
        change = stricter * self._integrate(emit, work, state)
        sweep = sweeps + 1.0

        contraction = change / num.maximum(change_before, literal(MIN_DIVISOR))
        contraction = num.minimum(num.maximum(contraction, literal(MIN_RHO)), literal(MAX_RHO))
        rho_now = builder.select(sweep > 1.0, contraction, rho)
        is_out_of_range = (rho_now < FAST_START) | (rho_now > SLOW_START)
        was_guessed = may_guess & builder.compare("fcmp oeq", sweep, literal(2.0)) & (is_out_of_range & (change > 0.0))
        is_stagnant = (sweep > 2.0) & ((change >= STAGNATION_RATIO * change_before) & (change <= noise))
        has_converged = (rho_now * change <= kappa) | is_stagnant
        is_slow = (sweep > 3.0) & has_estimate & (rho_now >= MAX_CONTRACTION)
        is_refused = is_slow | (sweep >= max_sweeps) | builder.compare("fcmp uge", change, literal(INFINITE))
        stops = was_guessed | has_converged | is_refused
        for phi, value in zip(carried, (sweep, change, rho_now), strict=True):
            phi.add_incoming(value, builder.block)
        builder.branch(stops, after, loop)
        builder.position_at_end(after)
        all_valid = builder.call(f"llvm.vector.reduce.and.v{LANES}i1", BIT, [store_others()])
        with self._return_if(emit, all_valid ^ Value(BIT, "true")):
            builder.ret(fallback())
        for value, index in ((sweep, mem.SWEEPS), (change, mem.CHANGE), (target, mem.N_TARGET), (rho_now, mem.RHO)):
            num.store(value, work, index)
        code = builder.select(has_converged, literal(mem.CONVERGED), literal(mem.REJECTED))
        code = builder.select(was_guessed, literal(mem.GUESSED), code)
        with builder.if_then(builder.compare("fcmp oeq", code, literal(mem.CONVERGED)) & has_estimate):
            self._call(emit, "judge_nodes", self._estimate_error, [work, state])
        return code

    @contextmanager
    def _repeated(self, emit: LaneEmitter, work: Value, state: Value) -> Iterator[list[Value]]:
        """Return a context manager: the code of its block runs once in a sweep, or twice if the field REPEATS is 1.

        The code computes accelerations from velocities that the context manager yields. First, these are the
        velocities of the previous sweep. If the code runs again, they are integrals of the accelerations just computed.
        """
        builder, num, first_offset = emit.builder, Emitter(emit.builder), integer(self.v_offset)
        before, loop, repeat, after = builder.block, *(builder.append_block() for _ in range(3))
        builder.jump(loop)
        builder.position_at_end(loop)
        offset = builder.phi(INTEGER)
        offset.add_incoming(first_offset, before)
        yield self._load_iterated(emit, num.pointer(work, offset))
        is_first = builder.compare("icmp eq", offset, first_offset)
        builder.branch(is_first & (num.load(work, mem.REPEATS) > 0.0), repeat, after)
        builder.position_at_end(repeat)
        h = emit.broadcast(num.load(work, mem.H))
        with loop_over_coordinates(emit, self.iterated_coordinates) as (k, i, _, _):
            v0, a0 = (num.load(num.pointer(state, i), m * self.n) for m in (1, 2))
            of_v = self._weighted_accelerations(emit, tables().velocities, a0, work, i)
            store_lanes(emit, emit.fma(h, of_v, emit.broadcast(v0)), num.pointer(work, k * LANES), self.spectrum_offset)
        offset.add_incoming(integer(self.spectrum_offset), builder.block)  # offset of v when the loop's code runs again
        builder.jump(loop)
        builder.position_at_end(after)

    def _load_iterated(self, emit: LaneEmitter, pointer: Value) -> list[Value]:
        """Return values at the nodes, loaded from `pointer`; 0 for coordinates that accelerations do not depend on."""
        values = [emit.constant(0.0)] * self.n
        for k, i in enumerate(self.iterated_coordinates):
            values[i] = load_lanes(emit, pointer, LANES * k)
        return values

    def _estimate_error(self, emit: LaneEmitter, work: Value, state: Value) -> None:
        """Write code that estimates the error of a step whose stages have converged, and the size of the next step.

        The code stores ERROR, CURVATURE, FACTOR and FACTOR_OF_ERROR (data/collocation.py). ERROR extrapolates the decay
        of the Legendre coefficients of the accelerations. Let m_k be the largest magnitude of the coefficients of
        degrees k to 8. ERROR is proportional to the larger one of m_7 (m_7 / m_5)^1.5 and m_7^2 / m_3. In 99 % of the
        steps over corners and peaks of forces, the true error is at most 20 times ERROR. In smooth motion, ERROR is
        decades too large. This costs few steps, because the step size depends only on the 12th root of ERROR.
        """
        builder, num, n = emit.builder, Emitter(emit.builder), self.n
        n_sweeps, change, target, rho = (num.load(work, i) for i in (mem.SWEEPS, mem.CHANGE, mem.N_TARGET, mem.RHO))
        vec2 = LaneEmitter(builder, 2)
        error_to_kappa = rho * change / KAPPA
        error_to_kappa = error_to_kappa + SMALLEST_RATIO
        logs = vec2.logarithm(vec2.vector([error_to_kappa, rho]))
        exponent = num.fma(target - n_sweeps, builder.extract(logs, 1), builder.extract(logs, 0))
        log_convergence = (exponent + 1.0) / (target + 2.0)
        with num.loop(integer(0), integer(n), []) as (i, _, _):
            a0 = num.load(num.pointer(state, i), 2 * n)
            values = abs(self._weighted_accelerations(emit, tables().spectrum, a0, work, i))
            pairs = emit.maximum(values, builder.shuffle(values, values, [1, 0, 3, 2, 5, 4, 7, 6]))
            store_lanes(emit, pairs, num.pointer(work, i * LANES), self.spectrum_offset)
        wide, begins = self._vector_emitter(emit)
        error = curved = wide.constant(0.0)
        smallest = wide.constant(MIN_DIVISOR)
        for begin in begins:
            vectors = [load_lanes(emit, work, self.spectrum_offset + LANES * (begin + k)) for k in range(wide.lanes)]
            largest_34, largest_56, largest_78 = (gather_lane(emit, vectors, lane) for lane in (2, 4, 6))
            weight = wide.load(num.pointer(work, mem.WEIGHTS + begin))
            largest_58 = wide.maximum(wide.maximum(largest_56, largest_78), smallest)
            decay = largest_78 / largest_58
            total_decay = largest_78 / wide.maximum(largest_34, largest_58)
            decay = wide.maximum(decay * wide.function("sqrt", decay), total_decay)
            error = wide.maximum(largest_78 * weight * decay, error)
            curved = wide.maximum(largest_56 * weight, curved)
        h = num.load(work, mem.H)
        error = wide.max_over_lanes(error) * h * ERROR_WEIGHT
        num.store(error, work, mem.ERROR)
        num.store(wide.max_over_lanes(curved) * h, work, mem.CURVATURE)
        log_error = builder.extract(vec2.logarithm(vec2.broadcast(error)), 0) * (1.0 / mem.ORDER)
        factors = vec2.exponential(-vec2.vector([log_convergence, log_error]))
        num.store(builder.extract(factors, 0), work, mem.FACTOR)
        num.store(builder.extract(factors, 1), work, mem.FACTOR_OF_ERROR)

    def find_defect(self, emit: LaneEmitter, work: Value, state: Value, numbers: Value) -> Value:
        """Write code for the defect: the largest |deviation from the equations| / its limit, halfway between nodes.

        Return the defect, or INVALID if pivots are too small or accelerations are not finite. The limit (h: step size)
        is ALLOWED_DEFECT * (velocity tolerance) / h. The code stores FACTOR_OF_DEFECT: largest allowed (next h) / h.
        """
        builder, num, n = emit.builder, Emitter(emit.builder), self.n
        emit.numbers = emit.constants = numbers
        t, h = emit.broadcast(num.load(work, mem.T)), emit.broadcast(num.load(work, mem.H))
        elapsed = h * constants(tables().between)
        zero = emit.constant(0.0)
        q, v = [zero] * n, [zero] * n
        for i in self.iterated_coordinates:
            q0, v0, a0 = (num.load(state, m * n + i) for m in range(3))
            of_v = self._weighted_accelerations(emit, tables().velocities_between, a0, work, i)
            of_q = self._weighted_accelerations(emit, tables().positions_between, a0, work, i)
            v[i] = emit.fma(h, of_v, emit.broadcast(v0))
            q[i] = emit.fma(h * h, of_q, emit.fma(elapsed, emit.broadcast(v0), emit.broadcast(q0)))
        inputs, accelerations = [t + elapsed, *q, *v], builder.allocate(DOUBLE, LANES * n)
        is_valid = call_accelerations(emit, self.equations, -1, inputs, self.numbers, accelerations)
        a = [emit.load(accelerations, i) for i in range(n)]
        max_error = largest = zero
        for i, value in enumerate(a):
            a0 = num.load(state, 2 * n + i)
            difference = value - self._weighted_accelerations(emit, tables().values_between, a0, work, i)
            weight = emit.broadcast(num.load(work, mem.WEIGHTS + i))
            max_error = emit.maximum(abs(difference) * weight, max_error)
            largest = emit.maximum(abs(value) * weight, largest)
        beyond_noise = emit.fma(emit.constant(-mem.MAX_ROUNDING), largest, max_error)
        scaled = beyond_noise * (h * (1.0 / ALLOWED_DEFECT))
        defect = num.maximum(emit.max_over_lanes(scaled), llvm_code.ZERO)
        vec2 = LaneEmitter(builder, 2)
        log_factor = vec2.logarithm(vec2.broadcast(num.maximum(defect, constant(DOUBLE, 1e-09)))) * (-1.0 / 9)
        num.store(builder.extract(vec2.exponential(log_factor), 0), work, mem.FACTOR_OF_DEFECT)
        all_valid = builder.call(f"llvm.vector.reduce.and.v{LANES}i1", BIT, [is_valid])
        return builder.select(all_valid, defect, constant(DOUBLE, INVALID))

    def store_prediction(self, emit: LaneEmitter, work: Value, state: Value) -> None:
        """Write code that stores the polynomial of accelerations of a rejected step, to predict a shorter step."""
        num, old_polynomial = Emitter(emit.builder), self._polynomial_pointer(emit, work, is_next=False)
        with loop_over_coordinates(emit, self.iterated_coordinates) as (k, i, _, _):
            a0 = num.load(num.pointer(state, i), 2 * self.n)
            store_lanes(
                emit,
                self._weighted_accelerations(emit, tables().begin, a0, work, i),
                num.pointer(old_polynomial, k * LANES),
            )

    def end_step(self, emit: LaneEmitter, work: Value, state: Value, new_state: Value) -> None:
        """Write code that stores [q, v, a] at the end of the step in `new_state`.

        The code also stores the polynomial of the accelerations, for the next prediction, and its degree NEXT_DEGREE.
        """
        builder, num, n = emit.builder, Emitter(emit.builder), self.n
        last, h = LANES - 1, num.load(work, mem.H)
        powers, new = load_lanes(emit, work, mem.POWERS), self._polynomial_pointer(emit, work, is_next=True)
        old_polynomial, zero = self._polynomial_pointer(emit, work, is_next=False), emit.constant(0.0)
        with loop_over_coordinates(emit, self.iterated_coordinates, [zero]) as (k, i, (max_error,), carried):
            stage = num.pointer(work, k * LANES)
            target = num.pointer(new_state, i)
            a0, a1 = (
                num.load(num.pointer(state, i), 2 * n),
                num.load(num.pointer(work, i * LANES), self.a_offset + last),
            )
            for value, begin in (
                (num.load(stage, self.q_offset + last), 0),
                (num.load(stage, self.v_offset + last), n),
                (a1, 2 * n),
            ):
                num.store(value, target, begin)
            partial_sums = load_lanes(emit, num.pointer(old_polynomial, k * LANES)) * powers
            for distance in (1, 2, 4):  # after the three passes, element k is the sum of the elements 0 to k
                shifted = [LANES + k if k < distance else k - distance for k in range(LANES)]
                partial_sums = partial_sums + builder.shuffle(partial_sums, zero, shifted)
            errors = partial_sums + emit.broadcast(a0 - a1)
            weight = emit.broadcast(num.load(num.pointer(work, i), mem.WEIGHTS))
            carried.append(emit.maximum(abs(errors) * weight, max_error))
            store_lanes(
                emit, self._weighted_accelerations(emit, tables().end, a0, work, i), num.pointer(new, k * LANES)
            )
        self._choose_degree(emit, work, carried[0])
        if self.other_coordinates:
            last_weights = [constants(table[1:, last]) for table in (tables().velocities, tables().positions)]
            weights_0 = [constant(DOUBLE, table[0, last]) for table in (tables().velocities, tables().positions)]
            with loop_over_coordinates(emit, self.other_coordinates) as (_, i, _, _):
                first, target = num.pointer(state, i), num.pointer(new_state, i)
                a = load_lanes(emit, num.pointer(work, i * LANES), self.a_offset)
                q, v, a0 = (num.load(first, m * n) for m in range(3))
                of_v, of_q = two_sums(emit, *(a * end for end in last_weights))
                of_v, of_q = (num.fma(factor, a0, each) for factor, each in zip(weights_0, (of_v, of_q), strict=True))
                displacement = h * num.fma(h, of_q, v)
                num.store(q + displacement, target, 0)
                num.store(v + h * of_v, target, n)
                num.store(builder.extract(a, last), target, 2 * n)

    def _choose_degree(self, emit: LaneEmitter, work: Value, max_error: Value) -> None:
        """Write code that stores NEXT_DEGREE, the degree of the polynomial that predicts the next step.

        `max_error`: in lane k, the error that a prediction of degree k + 1 would have had at the end of this step.
        NEXT_DEGREE is the lowest degree whose error is at most 1.2 times the smallest error. NEXT_DEGREE is at least 2,
        and changes by at most 2 in a step. If no polynomial predicted this step, NEXT_DEGREE is FIRST_DEGREE.
        """
        builder, num = emit.builder, Emitter(emit.builder)
        least = -emit.max_over_lanes(-max_error)
        is_good = max_error <= emit.broadcast(least * 1.2)
        bits = builder.convert("zext", builder.convert("bitcast", is_good, f"i{LANES}"), INTEGER)
        bits = bits | 1 << LANES - 1
        first = builder.call("llvm.cttz.i64", INTEGER, [bits, Value(BIT, "true")])
        best, before = num.to_double(first) + 1.0, num.load(work, mem.DEGREE)
        lowest, highest = (before + each for each in (-2.0, 2.0))
        degree = num.minimum(num.maximum(best, num.maximum(lowest, constant(DOUBLE, 2.0))), highest)
        predicts = builder.compare("fcmp one", num.load(work, mem.PREDICTS), llvm_code.ZERO)
        num.store(builder.select(predicts, degree, constant(DOUBLE, FIRST_DEGREE)), work, mem.NEXT_DEGREE)

    def project_positions(self, emit: LaneEmitter, work: Value, numbers: Value) -> None:
        """Write code for one Newton step towards the constraints C = 0, at the ends of eight steps at once."""
        if self.split_functions is None:
            self._project(emit, work, numbers, self.equations.position_projection)
        else:
            self._project_in_parts(emit, work, numbers, self.split_functions.project_position, ("moved", "q"))

    def project_states(self, emit: LaneEmitter, work: Value, numbers: Value) -> None:
        """Write code that projects the ends of eight steps at once, and computes accelerations and multipliers."""
        if self.split_functions is None:
            self._project(emit, work, numbers, self.equations.projection)
        else:
            self._project_in_parts(emit, work, numbers, self.split_functions.project, ("a", "moved", "q", "v", "lam"))

    def _project(self, emit: LaneEmitter, work: Value, numbers: Value, program: Program) -> None:
        """Write code that projects the ends of eight steps by `program`, and stores the results in `work`."""
        emit.numbers = emit.constants = numbers
        inputs = [load_lanes(emit, work, self.end_offset + LANES * k) for k in range(1 + 2 * self.n)]
        lowering, arrays = lower_program(emit, program, inputs, self.numbers)
        values = dict(zip(program.arrays, arrays, strict=True))
        is_valid = lowering.is_valid(program, [value for array in arrays for value in array])
        for name, index in self._end_offsets().items():
            for k, value in enumerate(values.get(name, [])):
                store_lanes(emit, value, work, index + LANES * k)
        self._store_largest_move(emit, work, values["moved"], is_valid)

    def _project_in_parts(
        self, emit: LaneEmitter, work: Value, numbers: Value, write: Callable[..., Value], names: tuple[str, ...]
    ) -> None:
        """Write the code of `_project` for equations split into functions; `write` writes calls of these functions."""
        num, moved = Emitter(emit.builder), emit.builder.allocate(DOUBLE, LANES * self.n)
        indices = {name: num.pointer(work, index) for name, index in self._end_offsets().items()} | {"moved": moved}
        state = load_lanes(emit, work, self.end_offset), indices["q"], indices["v"]
        is_valid = write(emit, *state, numbers, *(indices[name] for name in names))
        self._store_largest_move(emit, work, [load_lanes(emit, moved, LANES * k) for k in range(self.n)], is_valid)

    def _end_offsets(self) -> dict[str, int]:
        """Return the offset in `work` of each array "q", "v", "a", "lam": the ends of eight steps, one in each lane."""
        return {
            "q": self.end_offset + LANES,
            "v": self.end_offset + LANES * (1 + self.n),
            "a": self.end_a_offset,
            "lam": self.lam_offset,
        }

    def _store_largest_move(self, emit: LaneEmitter, work: Value, values: Sequence[Value], is_valid: Value) -> None:
        largest = emit.constant(0.0)
        for value in values:
            largest = emit.maximum(abs(value), largest)
        store_lanes(emit, largest, work, mem.MOVED)
        before = load_lanes(emit, work, mem.VALID)
        store_lanes(emit, emit.builder.select(is_valid, before, emit.constant(0.0)), work, mem.VALID)

    def _integrate(self, emit: LaneEmitter, work: Value, state: Value) -> Value:
        """Write code that integrates accelerations to v and q at nodes; return max |new v - old v| / tolerance of v."""
        num = Emitter(emit.builder)
        with loop_over_coordinates(emit, self.iterated_coordinates, [emit.constant(0.0)]) as (k, i, (largest,), new):
            before = load_lanes(emit, num.pointer(work, k * LANES), self.v_offset)
            terms = self._node_accelerations(emit, num.load(num.pointer(state, i), 2 * self.n), work, i)
            sums = [self._weighted_sum(emit, table, terms) for table in (tables().velocities, tables().positions)]
            v = self._store_stages(emit, work, state, k, i, sums)
            weight = emit.broadcast(num.load(num.pointer(work, i), mem.WEIGHTS))
            change = abs(v - before)
            new.append(emit.maximum(change * weight, largest))
        return emit.max_over_lanes(new[0])

    def _store_stages(
        self, emit: LaneEmitter, work: Value, state: Value, k: Value, i: Value, sums: Sequence[Value]
    ) -> Value:
        """Write code that stores q and v of coordinate i, the k-th iterated one; return v. `sums`: integrals of a."""
        num = Emitter(emit.builder)
        h = emit.broadcast(num.load(work, mem.H))
        index, begin = num.pointer(work, k * LANES), num.pointer(state, i)
        q0, v0 = (emit.broadcast(num.load(begin, m * self.n)) for m in range(2))
        v = emit.fma(h, sums[0], v0)
        displacement_rate = emit.fma(h, sums[1], constants(tables().nodes) * v0)
        store_lanes(emit, v, index, self.v_offset)
        store_lanes(emit, emit.fma(h, displacement_rate, q0), index, self.q_offset)
        return v

    def _node_accelerations(self, emit: LaneEmitter, first: Value, work: Value, i: Value | int) -> list[Value]:
        """Return the accelerations of coordinate i at the nine nodes: `first`, and eight values loaded from `work`."""
        num = Emitter(emit.builder)
        memory = num.pointer(work, i * LANES)
        return [first, *(num.load(memory, self.a_offset + node) for node in range(LANES))]

    def _weighted_accelerations(
        self, emit: LaneEmitter, table: Array, first: Value, work: Value, i: Value | int
    ) -> Value:
        """Return (accelerations of coordinate i at the nodes) @ table; `first`: the acceleration at node 0."""
        return self._weighted_sum(emit, table, self._node_accelerations(emit, first, work, i))

    def _weighted_sum(self, emit: LaneEmitter, table: Array, terms: Sequence[Value]) -> Value:
        """Return `terms @ table`, computed as two sums of products that the processor computes in parallel."""
        sums = [emit.broadcast(x) * constants(row) for x, row in zip(terms[:2], table[:2], strict=True)]
        for k, (x, row) in enumerate(zip(terms[2:], table[2:], strict=True)):
            sums[(k + 1) % 2] = emit.fma(emit.broadcast(x), constants(row), sums[(k + 1) % 2])
        return emit.add_sums(*sums)

    def _polynomial_pointer(self, emit: LaneEmitter, work: Value, is_next: bool) -> Value:
        """Return a pointer to the polynomial that predicts the next step if `is_next`, otherwise this step."""
        builder, num = emit.builder, Emitter(emit.builder)
        second = builder.compare("fcmp one" if not is_next else "fcmp oeq", num.load(work, mem.CURRENT), llvm_code.ZERO)
        size = LANES * len(self.iterated_coordinates)
        offset = builder.select(second, integer(self.polynomial_offset + size), integer(self.polynomial_offset))
        return num.pointer(work, offset)


class Collocation(NamedTuple):
    """Compiled functions of a mechanism for collocation steps, and the coefficients that they read."""

    functions: DeferredFunctions
    code: CollocationCode
    numbers: Any  # values of the coefficients, or (in the object cached for all systems) expressions for the values


def compiled_collocation(generated: GeneratedCode) -> Collocation:
    """Return the functions for collocation steps and their coefficients; functions are compiled when first called."""
    code = generated.shared
    collocation: Collocation = code.cache.remembered(("collocation", code.equations.choice), lambda: _compile(code))
    return collocation._replace(numbers=generated.evaluate(collocation.numbers))


def _compile(shared: SharedCode) -> Collocation:
    from twoloop.kernels.data.common import KIT

    code = CollocationCode(shared)
    writers: dict[str, Callable[..., Any]] = {
        "attempt_nodes": code.iterate_step,
        "audit_nodes": code.find_defect,
        "retry_nodes": code.store_prediction,
        "end_nodes": code.end_step,
        "correct_ends": code.project_positions,
        "project_ends": code.project_states,
    }
    is_split, numbers = shared.split_functions is not None, code.numbers.formulas

    def write() -> tuple[list[str], str]:
        module = Module(splits_blocks=is_split)
        for name, emit in writers.items():
            llvm_code.write(module, name, KIT.llvm_signature(name), emit, partial(LaneEmitter, lanes=LANES))
        # writing must not add coefficients: the functions would read them beyond the end of their array
        assert len(code.numbers.values) == len(numbers)
        return list(writers), str(module)

    functions = DeferredFunctions(
        lambda: generated_functions("collocation", _stamp(), code.structure, write, optimise=not is_split)
    )
    return Collocation(functions, code, numbers)


@cache
def _stamp() -> str:
    """Return a digest of the modules that write only collocation code; `SharedCode.digest` covers the other modules."""
    return digest_of("", __file__, lane_series, mem)
