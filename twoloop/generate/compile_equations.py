"""Compile the equations of one mechanism: accelerations and projections, which explicit methods call.

The operations of an elimination become LLVM instructions one by one, without numba, which would take seconds for a few
hundred operations. The code is cached on disk, like the code of the kernels.

**Accelerations** are computed by one of two programs. The program with the fewest operations (null_space.py) divides by
pivots that are chosen before the run. If one of these pivots is small, another function of the LLVM module computes the
accelerations, by an elimination that begins with the mass matrix M. In SIMD lanes, this function is called for all
lanes if one lane needs it; the other lanes keep their results, so that no run depends on the runs in other lanes.

**Long equations** are split into functions: the compile time of LLVM grows faster than the length of a function.
Accelerations and both projections call the same functions for the factors of the matrix and for the solution. These
functions exchange values in memory; in one long function, most values would be kept in memory, too.
"""

import ctypes
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.structure import mass_and_rows
from twoloop.generate import llvm_code
from twoloop.generate.elimination import Elimination, FactorAndSolvePrograms, PivotChoice
from twoloop.generate.graph import Graph, Untraceable
from twoloop.generate.llvm_code import Emitter, Location, Lowering
from twoloop.generate.llvm_text import BIT, DOUBLE, Module, Value, integer, width_of
from twoloop.generate.program import Coefficients, Program
from twoloop.generate.trace import Evaluator, TraceCache, derive_cached
from twoloop.generate.traced_values import CallbackTraces, Check, accept_traces
from twoloop.kernels.compile.dependencies import digest_of
from twoloop.kernels.compile.generated_functions import generated_functions
from twoloop.problem.system import ConstrainedSystem

DOUBLE_POINTER = f"{DOUBLE}*"
# generated code is not used if its accelerations near the start have a relative error above LARGEST_LOSS; in runs,
# errors were up to 200 times larger. Only code that refines solutions, or adds s g^T g to M (g: row of G), is tested
LARGEST_LOSS = 1e-8
MAX_POSITIONS, SPACING = 4, 0.02  # number of positions that `_relative_error` may try, and their spacing (m or rad)


def write_accelerations(
    emit: Emitter, equations: Elimination, inputs: Sequence[Value], numbers: Coefficients
) -> tuple[list[Value], Value]:
    """Write code for accelerations at `inputs`, [t, q, v]. Return the accelerations and a flag: 1 if they are valid.

    `numbers`: coefficients, each with its index in an array. `emit` must have pointers to this array.
    """
    lowering, n = Lowering(emit, numbers), equations.system.n_q
    for quantity, value in enumerate(inputs):
        lowering.define(quantity, value)

    def state() -> list[Value]:
        array = _stack_array(emit, 2 * n)
        for i, value in enumerate(inputs[1:]):
            emit.store(value, array, i)
        return [inputs[0], array, emit.pointer(array, n)]

    return _accelerations(emit, equations, lowering, state)


def write_acceleration_function(
    module: Module, name: str, kind: tuple[str, list[str]], equations: Elimination, numbers: Coefficients
) -> None:
    """Write the LLVM function `name`, which computes accelerations from t, q, v and the coefficients.

    If the accelerations are valid, the function stores them in its last argument and returns 1; otherwise, it returns
    0. `kind`: types of its result and of its arguments.
    """

    def emit_all(emit: Emitter, t: Value, q: Value, v: Value, coefficients: Value, out: Value) -> Value:
        lowering, emit.numbers = Lowering(emit, numbers), coefficients
        lowering.define_inputs(equations.graph, [t, q, v])
        a, is_valid = _accelerations(emit, equations, lowering, lambda: [t, q, v])
        _store_if_valid(emit, is_valid, [out], [a])
        return is_valid

    llvm_code.write(module, name, kind, emit_all)


def _store_if_valid(emit: Emitter, is_valid: Value, pointers: Sequence[Value], arrays: Sequence[list[Value]]) -> None:
    with emit.builder.if_then(is_valid):
        for pointer, array in zip(pointers, arrays, strict=True):
            for i, value in enumerate(array):
                emit.store(value, pointer, i)


def call_accelerations(
    emit: Emitter, equations: Elimination, index: int, inputs: Sequence[Value], numbers: Coefficients, out: Value
) -> Value:
    """Write a call of the function that computes accelerations; return a flag: 1 if the accelerations are valid.

    `inputs`: t, q, v. The function stores the accelerations in `out`. `index`: 0 for the program with the fewest
    operations, -1 for the elimination that begins with M. `numbers`: coefficients, each with its index in an array.
    """
    state = _stack_array(emit, 2 * equations.system.n_q)
    for i, value in enumerate(inputs[1:]):
        emit.store(value, state, i)
    arguments = [inputs[0], state, emit.pointer(state, equations.system.n_q), *_coefficient_pointers(emit), out]
    return emit.builder.call(_acceleration_function(emit, equations, index, numbers), emit.bit_type, arguments)


def _accelerations(
    emit: Emitter, equations: Elimination, lowering: Lowering, state: Callable[[], list[Value]]
) -> tuple[list[Value], Value]:
    """Write code for the accelerations; return the accelerations and a flag: 1 if they are valid.

    `lowering` writes operations; t, q and v are defined in it. If the accelerations are not valid, the code calls a
    function whose elimination begins with M; `state()` returns the first arguments of this call: t, pointers to q, v.
    """
    program, *alternatives = equations.accelerations
    (a,) = program.run(lowering)
    is_valid = lowering.is_valid(program, a)
    if not alternatives:
        return a, is_valid
    builder = emit.builder
    all_valid = is_valid
    if (width := width_of(is_valid.type)) > 1:
        all_valid = builder.call(f"llvm.vector.reduce.and.v{width}i1", BIT, [is_valid])
    first_block, fallback, after = builder.block, builder.append_block(), builder.append_block()
    builder.branch(all_valid, after, fallback)
    builder.position_at_end(fallback)
    name, array = _acceleration_function(emit, equations, -1, lowering.numbers), _stack_array(emit, len(a))
    fallback_valid = builder.call(name, emit.bit_type, [*state(), *_coefficient_pointers(emit), array])
    b = [builder.select(is_valid, value, emit.load(array, i)) for i, value in enumerate(a)]
    fallback_valid, fallback_end = is_valid | fallback_valid, builder.block
    builder.jump(after)
    builder.position_at_end(after)
    merged: list[Value] = []
    for value, alternative in zip([*a, is_valid], [*b, fallback_valid], strict=True):
        phi = builder.phi(value.type)
        phi.add_incoming(value, first_block)
        phi.add_incoming(alternative, fallback_end)
        merged.append(phi)
    *a, is_valid = merged
    return a, is_valid


def _acceleration_function(emit: Emitter, equations: Elimination, index: int, numbers: Coefficients) -> str:
    """Return the name of the LLVM function for `equations.accelerations[index]`; write the function if necessary."""
    program, is_mass_first = equations.accelerations[index], index in (-1, len(equations.accelerations) - 1)
    module, name = emit.builder.module, f"{'mass_first' if is_mass_first else 'quick'}_{emit.suffix}"
    if not module.defines(name):
        n, pointers = equations.system.n_q, _coefficient_pointers(emit)
        kinds = [emit.double_type, DOUBLE_POINTER, DOUBLE_POINTER, *[DOUBLE_POINTER] * len(pointers), DOUBLE_POINTER]
        builder = module.function(name, emit.bit_type, kinds, internal=True)
        inner_emit = emit.copy_for_builder(builder)
        t, q, v, *coefficients, out = builder.arguments
        for attribute, pointer in zip(("numbers", "constants"), coefficients, strict=False):
            setattr(inner_emit, attribute, pointer)
        if is_mass_first and equations.split_functions is not None:
            builder.ret(equations.split_functions.accelerations(inner_emit, t, q, v, coefficients[0], out))
            return name
        lowering = Lowering(inner_emit, numbers)
        (a,) = program.run(lowering, [t, *(inner_emit.load(array, i) for array in (q, v) for i in range(n))])
        is_valid = lowering.is_valid(program, a)
        for i, value in enumerate(a):
            inner_emit.store(value, out, i)
        builder.ret(is_valid)
    return name


def _coefficient_pointers(emit: Emitter) -> list[Value]:
    """Return a pointer to all coefficients; in SIMD lanes, one to those that vary between lanes, one to the others."""
    constants = getattr(emit, "constants", None)
    return [emit.numbers] if constants is None else [emit.numbers, constants]


def _stack_array(emit: Emitter, size: int) -> Value:
    return emit.builder.allocate(DOUBLE, size * width_of(emit.double_type))


# equations with more operations than a limit are split into functions. If accelerations have a `reduced_program` (see
# null_space.py), the limit is SPLIT_PROJECTIONS, and only projections are split, which halves the compile time.
# Otherwise, the limit is SPLIT_ALL, and accelerations are split, too, which makes them 50 % slower
SPLIT_PROJECTIONS, SPLIT_ALL = 200, 500


class SplitFunctions:
    """Code generator that splits long equations into parts: LLVM functions for accelerations and for projections.

    The part "factors" factorizes the matrix [M G^T; G 0] of M a + G^T lam = r, G a = c, and stores the factors.
    solution : programs that compute the factors and the solution.
    position_programs : programs of parts that compute right-hand sides r and c from t, q and v; keys: names of parts.
    solution_programs : programs of parts that solve for a and lam with the stored factors; keys: names of parts.
    """

    def __init__(self, equations: Elimination, numbers: Coefficients):
        self.equations, self.numbers = equations, numbers
        equations.split_functions = self
        self.n, self.n_rows = equations.system.n_q, len(equations.all_rows)
        self.has_redundant_rows = len(equations.choice.rows) < self.n_rows
        self.position_programs = {
            "right_sides": equations.right_sides,
            "position_errors": equations.position_errors,
            "velocity_errors": equations.velocity_errors,
        }
        self.solution = FactorAndSolvePrograms(equations, list(self.position_programs.values()))
        self.solution_programs = {"solution": self.solution.solution_program}
        if self.has_redundant_rows:
            self.solution_programs["least_norm"] = self.solution.least_norm_program
        self._part_writers: dict[str, Callable[..., Value]] = {"factors": self._write_factors}
        for name, program in self.position_programs.items():
            self._part_writers[name] = partial(self._write_part, program, self.solution.stored_indices)
        for name, program in self.solution_programs.items():
            self._part_writers[name] = partial(self._write_part, program, {})

    def structure(self) -> Iterable[Any]:
        """Yield all data that determine the code of the functions; their digest is the key of cached code."""
        solution, numbers = self.solution, self.numbers
        yield solution.factor_program.sizes, list(numbers.structure(solution.factor_program))
        for program in self.position_programs.values():
            yield program.sizes, list(numbers.structure(program, solution.stored_indices))
        for program in self.solution_programs.values():
            yield program.sizes, list(numbers.structure(program))

    def write(self, module: Module, kinds: Callable[[str], tuple[str, list[str]]]) -> list[str]:
        """Write the functions that kernels call; return their names. `kinds(name)`: types of result and arguments."""
        functions: dict[str, Callable[..., Any]]
        functions = {"own_correct_positions": self.project_position, "own_project": self.project}
        if self.equations.reduced_program is None:
            functions["own_accelerate"] = self.accelerations
        for name, emit in functions.items():
            llvm_code.write(module, name, kinds(name), emit)
        return list(functions)

    def _call(self, emit: Emitter, *calls: tuple[str, Sequence[Value]]) -> Value:
        """Write `calls` (part, arguments), and the parts not yet written; return a flag: 1 if all calls succeed."""
        module, all_valid = emit.builder.module, None
        for part, arguments in calls:
            name = f"{part}_{emit.suffix}"
            if not module.defines(name):
                builder = module.function(name, emit.bit_type, [value.type for value in arguments], internal=True)
                builder.ret(self._part_writers[part](emit.copy_for_builder(builder), *builder.arguments))
            valid = emit.builder.call(name, emit.bit_type, arguments)
            all_valid = valid if all_valid is None else all_valid & valid
        assert all_valid is not None
        return all_valid

    def _lowering(self, emit: Emitter, graph: Graph, args: Sequence[Value], stored: Mapping[int, Location]) -> Lowering:
        """Return a Lowering, which writes operations. args[:3]: inputs of `graph`; args[3]: pointer to coefficients."""
        *inputs, emit.numbers = args[:4]
        if width_of(emit.double_type) > 1:
            emit.constants = emit.numbers  # type: ignore[attr-defined]  # the coefficients are the same in all lanes
        lowering = Lowering(emit, self.numbers, stored)
        lowering.define_inputs(graph, inputs)
        return lowering

    def _write_factors(self, emit: Emitter, *arguments: Value) -> Value:
        """Write code that stores the factors of [M G^T; G 0] in `arguments[4]`; return a flag: 1 if they are valid."""
        graph, solution, stored = self.equations.graph, self.solution, arguments[4]
        lowering = self._lowering(emit, graph, arguments, {})
        locations = {i: (stored, index) for i, index in solution.stored_indices.items()}
        for i, location in locations.items():
            if graph.operations[i] is None:  # this quantity is an input: t or a coordinate
                emit.store(lowering.value(i), *location)
        lowering.run(graph, graph.quantities_by_use(solution.factor_program.expressions), locations)
        return lowering.is_valid(solution.factor_program, [])

    def _write_part(self, program: Program, stored: Mapping[int, int], emit: Emitter, *arguments: Value) -> Value:
        """Write code that stores the results of `program` in the last `arguments`; return a flag: 1 if all are valid.

        Keys of `stored`: quantities that the code loads from the array `arguments[4]`; values: indices in this array.
        """
        locations = {i: (arguments[4], index) for i, index in stored.items()}
        lowering = self._lowering(emit, program.graph, arguments, locations)
        results = program.run(lowering)
        for array, values in zip(arguments[-len(results) :], results, strict=True):
            for j, value in enumerate(values):
                emit.store(value, array, j)
        return lowering.is_valid(program, results[0])

    def accelerations(self, emit: Emitter, t: Value, q: Value, v: Value, numbers: Value, a: Value) -> Value:
        """Write code that stores the accelerations at (t, q, v) in `a`; return a flag: 1 if they are valid."""
        stored, r, c, lam = self._stack_arrays(emit)
        inputs = [t, q, v, numbers, stored]
        return self._call(
            emit, ("factors", inputs), ("right_sides", [*inputs, r, c]), ("solution", [r, c, stored, numbers, a, lam])
        )

    def project_position(
        self, emit: Emitter, t: Value, q: Value, v: Value, numbers: Value, moved: Value, out: Value
    ) -> Value:
        """Write code for a Newton step of q towards the constraints C = 0; return a flag: 1 if the result is valid.

        The code stores the corrected q in `out`, and the change of q in `moved`. `numbers`: pointer to coefficients.
        """
        stored, r, c, lam = self._stack_arrays(emit)
        inputs = [t, q, v, numbers, stored]
        _write_zeros(emit, self.n, r)
        is_valid = self._call(
            emit,
            ("factors", inputs),
            ("position_errors", [*inputs, c]),
            ("solution", [r, c, stored, numbers, moved, lam]),
        )
        _write_return_unless(emit, is_valid)
        _write_sum(emit, self.n, q, moved, out)
        return is_valid

    def project(
        self,
        emit: Emitter,
        t: Value,
        q: Value,
        v: Value,
        numbers: Value,
        a: Value,
        moved: Value,
        new_q: Value,
        new_v: Value,
        lam: Value,
    ) -> Value:
        """Write code that projects q and v onto the constraints in the metric of M; return a flag: 1 if it succeeds.

        The code stores the change of q in `moved`, the projected q and v in `new_q` and `new_v`, and the accelerations
        and multipliers at (q, new_v) in `a` and `lam`. `numbers`: pointer to the coefficients of the equations.
        """
        stored, r, c, change = self._stack_arrays(emit)
        projected_v, inputs = _stack_array(emit, self.n), [t, q, v, numbers, stored]
        _write_zeros(emit, self.n, r)
        corrections_valid = self._call(
            emit,
            ("factors", inputs),
            *(("position_errors", [*inputs, c]), ("solution", [r, c, stored, numbers, moved, lam])),
            *(("velocity_errors", [*inputs, c]), ("solution", [r, c, stored, numbers, change, lam])),
        )
        _write_sum(emit, self.n, v, change, projected_v)
        independent_lam = c if self.has_redundant_rows else lam
        is_valid = self._call(
            emit,
            ("right_sides", [t, q, projected_v, numbers, stored, r, c]),
            ("solution", [r, c, stored, numbers, a, independent_lam]),
            *([("least_norm", [c, c, stored, numbers, lam])] if self.has_redundant_rows else []),
        )
        is_valid = corrections_valid & is_valid
        _write_return_unless(emit, is_valid)
        _write_sum(emit, self.n, q, moved, new_q)
        _write_sum(emit, self.n, v, change, new_v)
        return is_valid

    def _stack_arrays(self, emit: Emitter) -> list[Value]:
        """Return four scratch arrays: factors of [M G^T; G 0], right sides r and c, multipliers (or a change of v)."""
        sizes = self.solution.n_stored, self.n, self.n_rows, max(self.n, self.n_rows)
        return [_stack_array(emit, size) for size in sizes]


def _write_return_unless(emit: Emitter, is_valid: Value) -> None:
    """Write code that returns false from the function if the bit `is_valid` is 0; in SIMD lanes, write nothing."""
    if is_valid.type == BIT:
        emit.builder.return_false_unless(is_valid)


def _write_zeros(emit: Emitter, n: int, out: Value) -> None:
    with emit.loop(integer(0), integer(n), []) as (j, _, _):
        emit.store(emit.constant(0.0), emit.pointer(out, j))


def _write_sum(emit: Emitter, n: int, a: Value, b: Value, out: Value) -> None:
    with emit.loop(integer(0), integer(n), []) as (j, _, _):
        total = emit.load(emit.pointer(a, j)) + emit.load(emit.pointer(b, j))
        emit.store(total, emit.pointer(out, j))


Array = NDArray[np.float64]


def write_function(
    module: Module, name: str, kind: tuple[str, list[str]], program: Program, numbers: Coefficients
) -> None:
    """Write the LLVM function `name`, which runs a program: it computes arrays of results from the program's inputs.

    If the program's conditions hold and its first array is finite, the function stores the arrays and returns true;
    else it stores nothing and returns false. `kind`: types of its result and arguments.
    """

    def emit_all(emit: Emitter, *arguments: Value) -> Value:
        n_inputs = len(program.graph.input_sizes)
        inputs, emit.numbers, pointers = arguments[:n_inputs], arguments[n_inputs], arguments[n_inputs + 1 :]
        lowering = Lowering(emit, numbers)
        lowering.define_inputs(program.graph, inputs)
        results = program.run(lowering)
        is_valid = lowering.is_valid(program, results[0])
        _store_if_valid(emit, is_valid, pointers, results)
        return is_valid

    llvm_code.write(module, name, kind, emit_all)


class SharedCode:
    """Compiled functions for the equations of systems that differ only in parameters, cached on disk.

    numbers : coefficients of the equations, with their indices in the array from which the functions read them.
    digest : key of cached functions: digest of all that determines the functions, except the values of `numbers`.
    """

    def __init__(self, equations: Elimination, cache: TraceCache):
        self.equations, self.cache, self.numbers, self.split_functions = equations, cache, Coefficients(), None
        if equations.n_operations > (SPLIT_ALL if equations.reduced_program is None else SPLIT_PROJECTIONS):
            self.split_functions = SplitFunctions(equations, self.numbers)
        # programs of the functions that are not split into parts; keys: names of the functions
        self.programs = {"own_redundant": equations.redundant_rows}
        if self.split_functions is None:
            self.programs["own_correct_positions"] = equations.position_projection
            self.programs["own_project"] = equations.projection
        structure = repr(list(self._structure()))
        self.digest = hashlib.sha256((structure + _stamp()).encode()).hexdigest()
        # optimization passes of LLVM do not make the code faster, and take up to a quarter of the time to compile
        self.functions = generated_functions("equations", _stamp(), self.digest, self._module_text, optimise=False)

    def specialize(self, system: ConstrainedSystem, evaluate: Evaluator) -> "GeneratedCode":
        """Return this code with the coefficients for `system`; `evaluate` computes coefficients from parameters."""
        return GeneratedCode(
            self, evaluate(self.numbers.formulas), self.equations.traced.specialize(system, evaluate), evaluate
        )

    def _structure(self) -> Iterable[Any]:
        equations, parts, numbers = self.equations, self.split_functions, self.numbers
        yield equations.system.n_q, equations.choice.rows, equations.choice.added_rows
        for program in (*self.programs.values(), *equations.accelerations[: None if parts is None else -1]):
            yield program.sizes, list(numbers.structure(program))
        if parts is not None:
            yield from parts.structure()

    def _module_text(self) -> tuple[list[str], str]:
        from twoloop.kernels.data.common import KIT

        equations = self.equations
        module = Module(splits_blocks=True)
        for name, program in self.programs.items():
            write_function(module, name, KIT.llvm_signature(name), program, self.numbers)
        parts = [] if self.split_functions is None else self.split_functions.write(module, KIT.llvm_signature)
        name = "own_accelerate"
        if name not in parts:
            write_acceleration_function(module, name, KIT.llvm_signature(name), equations, self.numbers)
            parts.append(name)
        return [*self.programs, *parts], str(module)


class GeneratedCode(NamedTuple):
    """Compiled functions together with the coefficients for one system, which the functions read."""

    shared: SharedCode
    numbers: Array  # values of the coefficients that the code reads
    traced: CallbackTraces
    evaluate: Evaluator  # evaluates expressions for the parameters of this system

    @property
    def kinds(self) -> frozenset[str]:
        """Return the names of the callbacks that were traced, such as "mass"."""
        return self.traced.kinds

    def is_valid_from(self, system: ConstrainedSystem, t0: float, q0: Array) -> bool:
        """Return True if a run may start at (t0, q0) with this code: the code has the rows and pivots chosen there."""
        try:
            return _choice_at(system, t0, q0) == self.shared.equations.choice
        except Untraceable:
            return False


def _choice_at(system: ConstrainedSystem, t: float, q: Array) -> PivotChoice:
    """Return the choice of rows and pivots for the elimination at time t and position q; cache the last choice."""
    choice: PivotChoice
    choice = system.remembered_at("choice", (t, q.tobytes()), lambda: PivotChoice.choose(system, t, q))
    return choice


def generated_code(system: ConstrainedSystem, t0: float, q0: Array, check: Check = accept_traces) -> GeneratedCode:
    """Return generated code for a run from (t0, q0), from the cache if possible; else generate the code.

    `check` raises Untraceable if traces are wrong. Raise ValueError if code cannot be generated.
    """
    try:
        choice = _choice_at(system, t0, q0)

        def generate(cache: TraceCache) -> SharedCode:
            return SharedCode(Elimination(system, choice, cache.equations(system)), cache)

        code: GeneratedCode = derive_cached(system, ("code", choice), generate, lambda code: check(code.traced))
        if (choice.added_rows or choice.is_refined) and not _relative_error(code, system, t0, q0) <= LARGEST_LOSS:
            raise Untraceable(f"elimination without pivots loses the digits of little inertia in {system.name!r}")
    except Untraceable as error:
        raise ValueError(f"compiled=True needs equations that can be written down; {error}. Leave it out") from error
    return code


def _relative_error(code: GeneratedCode, system: ConstrainedSystem, t0: float, q0: Array) -> float:
    """Return the relative error of accelerations by generated code, for velocities 0, at or near the start (t0, q0).

    If pivots are too small for the code, try the next position; return infinity after MAX_POSITIONS of them. Return the
    larger error of two generated functions, one with projection; 0 if exact accelerations cannot be computed.
    """
    rows, n = list(code.shared.equations.choice.rows), system.n_q
    v, a, reduced, lam = np.zeros(n), np.empty(n), np.empty(n), np.empty(system.n_c + system.n_a)
    scratch, new_v, addresses = np.empty((2, n)), np.zeros(n), code.shared.functions.addresses
    kinds = [kind for kind, size in (("gamma", system.n_c), ("nonholonomic_gamma", system.n_a)) if size]
    for k in range(MAX_POSITIONS):
        q = q0 + k * SPACING * np.cos(np.arange(n))
        if _call(addresses["own_project"], t0, q, v, code.numbers, a, *scratch, new_v, lam):
            break
    else:
        return np.inf
    if not _call(addresses["own_accelerate"], t0, q, new_v, code.numbers, reduced):
        reduced = a
    try:
        (mass, G), force = mass_and_rows(system, t0, q), system.force(t0, q, new_v)
        gamma = np.concatenate([system.evaluate(kind, t0, q, new_v) for kind in kinds])
        matrix = np.block([[mass, G[rows].T], [G[rows], np.zeros((len(rows), len(rows)))]])
        right, exact = np.concatenate([force, gamma[rows]]), np.zeros(n + len(rows))
        for _ in range(3):  # the first pass solves, the others refine the solution
            exact += np.linalg.solve(matrix, right - matrix @ exact)
    except ValueError:  # gamma is known only by differences, forces are undefined, or the matrix is singular
        return 0.0
    heavy = mass.diagonal() > 0.0
    size = max(np.abs(exact[:n]).max(), np.abs(force[heavy] / mass.diagonal()[heavy]).max(initial=0.0))
    return float(np.abs([a, reduced] - exact[:n]).max() / max(size, np.finfo(float).tiny))


def _call(address: int, t: float, *arrays: Array) -> bool:
    function = ctypes.CFUNCTYPE(ctypes.c_bool, ctypes.c_double, *[ctypes.c_void_p] * len(arrays))(address)
    return bool(function(t, *(x.ctypes.data for x in arrays)))


@cache
def _stamp() -> str:
    """Return a digest of the modules that generate the functions, and of the signatures of kernel functions."""
    from twoloop.generate import elimination, llvm_code, llvm_text, null_space, program
    from twoloop.kernels.data.common import KIT

    modules = (elimination, null_space, program, llvm_code, llvm_text)
    return digest_of(repr(KIT), __file__, *modules)
