"""Compile the equations of one mechanism: accelerations and projections, which explicit methods call.

The operations of an elimination become LLVM instructions one by one, without numba, which would take seconds for a few
hundred operations. The code is cached on disk like that of the kernels.

**Accelerations** are computed by one of two programs. The program with the fewest operations (null_space.py) divides by
fixed pivots. If one of these pivots is small, a function of the module computes the accelerations by the elimination of
M. In SIMD lanes this function is called for all lanes if one lane needs it; the other lanes keep their results, so that
no run depends on its neighbours.

**Long equations** are split into functions that call one another, each compiled once: the time that LLVM takes grows
faster than the length of a block. The values of long equations are stored in memory in any case. Accelerations and both
projections share the functions for the factors of the matrix at a position, and for the solution with these factors.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.generate import llvm_code
from twoloop.generate.elimination import Elimination, PivotChoice, Solution
from twoloop.generate.graph import Graph, Untraceable
from twoloop.generate.llvm_code import Emitter, Lowering, Place
from twoloop.generate.llvm_text import BIT, DOUBLE, Module, Value, integer, width_of
from twoloop.generate.program import Coefficients, Program
from twoloop.generate.trace import Evaluator, TraceCache, derive_cached
from twoloop.generate.traced_values import Check, Traced, unchecked
from twoloop.kernels.compile.dependencies import digest_of
from twoloop.kernels.compile.generated_functions import generated_functions
from twoloop.problem.system import ConstrainedSystem

ARRAY = f"{DOUBLE}*"


def write_accelerations(
    emit: Emitter, equations: Elimination, inputs: Sequence[Value], numbers: Coefficients
) -> tuple[list[Value], Value]:
    """Write code for the accelerations at `inputs`, [t, q, v]; return their values, and whether they are valid.

    The builder may be in another block afterwards. `emit` must have the pointers to the coefficients.
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
    """Write a function of t, q, v and the coefficients that fills an array a, and returns whether a is valid."""

    def emit_all(emit: Emitter, t: Value, q: Value, v: Value, given: Value, filled: Value) -> Value:
        lowering, emit.numbers = Lowering(emit, numbers), given
        lowering.define_inputs(equations.graph, [t, q, v])
        a, holds = _accelerations(emit, equations, lowering, lambda: [t, q, v])
        with emit.builder.if_then(holds):
            for i, value in enumerate(a):
                emit.store(value, filled, i)
        return holds

    llvm_code.write(module, name, kind, emit_all)


def call_accelerations(
    emit: Emitter, equations: Elimination, index: int, inputs: Sequence[Value], numbers: Coefficients, filled: Value
) -> Value:
    """Write a call that fills the array `filled` with the accelerations at `inputs`; return whether they are valid.

    `index`: of a program in `equations.accelerations`: 0 has the fewest operations, -1 eliminates M first.
    """
    array = _stack_array(emit, 2 * equations.system.n_q)
    for i, value in enumerate(inputs[1:]):
        emit.store(value, array, i)
    arguments = [inputs[0], array, emit.pointer(array, equations.system.n_q), *_numbers(emit), filled]
    return emit.builder.call(_acceleration_function(emit, equations, index, numbers), emit.bit, arguments)


def _accelerations(
    emit: Emitter, equations: Elimination, lowering: Lowering, state: Callable[[], list[Value]]
) -> tuple[list[Value], Value]:
    """Write code for the accelerations; return their values and whether they are valid.

    `state` returns t and pointers to q and v, the arguments of the function that eliminates M; it may write code.
    """
    outputs, *alternatives = equations.accelerations
    a, holds = _run_accelerations(emit, equations, lowering, outputs)
    if not alternatives:
        return a, holds
    builder = emit.builder
    all_hold = holds
    if (width := width_of(holds.type)) > 1:
        all_hold = builder.call(f"llvm.vector.reduce.and.v{width}i1", BIT, [holds])
    before, fallback, after = builder.block, builder.append_block(), builder.append_block()
    builder.branch(all_hold, after, fallback)
    builder.position_at_end(fallback)
    name, place = _acceleration_function(emit, equations, -1, lowering.numbers), _stack_array(emit, len(a))
    finite = builder.call(name, emit.bit, [*state(), *_numbers(emit), place])
    b = [builder.select(holds, value, emit.load(place, i)) for i, value in enumerate(a)]
    finite, last = builder.operation("or", holds, finite), builder.block
    builder.go_to(after)
    builder.position_at_end(after)
    merged: list[Value] = []
    for value, alternative in zip([*a, holds], [*b, finite], strict=True):
        phi = builder.phi(value.type)
        phi.add_incoming(value, before)
        phi.add_incoming(alternative, last)
        merged.append(phi)
    *a, holds = merged
    return a, holds


def _run_accelerations(
    emit: Emitter, equations: Elimination, lowering: Lowering, outputs: Program
) -> tuple[list[Value], Value]:
    (a,) = outputs.run(lowering)
    return a, lowering.holds(outputs, a)


def _acceleration_function(emit: Emitter, equations: Elimination, index: int, numbers: Coefficients) -> str:
    """Return the name of the function for a program of `equations.accelerations`; write it if the module has none."""
    outputs, mass_first = equations.accelerations[index], index in (-1, len(equations.accelerations) - 1)
    module, name = emit.builder.module, f"{'mass_first' if mass_first else 'quick'}_{emit.suffix}"
    if not module.defines(name):
        n, given = equations.system.n_q, _numbers(emit)
        kinds = [emit.double, ARRAY, ARRAY, *[ARRAY] * len(given), ARRAY]
        builder = module.function(name, emit.bit, kinds, internal=True)
        inner = emit.like(builder)
        t, q, v, *places, filled = builder.arguments
        for attribute, place in zip(("numbers", "constants"), places, strict=False):
            setattr(inner, attribute, place)
        if mass_first and equations.parts is not None:
            builder.ret(equations.parts.accelerations(inner, t, q, v, places[0], filled))
            return name
        lowering = Lowering(inner, numbers)
        lowering.define(0, t)
        for first, array in ((1, q), (1 + n, v)):
            for i in range(n):
                lowering.define(first + i, inner.load(array, i))
        a, holds = _run_accelerations(inner, equations, lowering, outputs)
        for i, value in enumerate(a):
            inner.store(value, filled, i)
        builder.ret(holds)
    return name


def _numbers(emit: Emitter) -> list[Value]:
    """Return the pointer to the coefficients; in SIMD lanes, those to the varying and to the shared coefficients."""
    constants = getattr(emit, "constants", None)
    return [emit.numbers] if constants is None else [emit.numbers, constants]


def _stack_array(emit: Emitter, size: int) -> Value:
    return emit.builder.room(DOUBLE, size * width_of(emit.double))


# numbers of operations above which equations are split into functions, which halves the time to compile. SPLIT_ALL: if
# there is no reduced program for the accelerations, which is never split; split accelerations take 50 % longer to run
SPLIT_PROJECTIONS, SPLIT_ALL = 200, 500


class SplitFunctions:
    """Generator that splits long equations into parts: functions of the module that other functions call.

    Parameters
    ----------
    equations : Elimination
    numbers : Coefficients

    Attributes
    ----------
    solution : Solution
        Solution of the linear equations; `solution.stored` lists the quantities that the parts share in memory.
    at_position, with_factors : dict
        Programs by names of parts, with inputs t, q, v (`at_position`), or r, c and stored factors (`with_factors`).
    """

    def __init__(self, equations: Elimination, numbers: Coefficients):
        self.equations, self.numbers = equations, numbers
        equations.parts = self
        self.n, self.n_rows = equations.system.n_q, len(equations.all_rows)
        self.redundant = len(equations.choice.rows) < self.n_rows
        self.at_position = {
            "right": equations.right_sides,
            "off": equations.position_errors,
            "faster": equations.velocity_errors,
        }
        self.solution = Solution(equations, list(self.at_position.values()))
        self.with_factors = {"solution": self.solution.solved}
        if self.redundant:
            self.with_factors["least"] = self.solution.least
        self._parts: dict[str, Callable[..., Value]] = {"factors": self._factors}
        for name, outputs in self.at_position.items():
            self._parts[name] = partial(self._part, outputs, self.solution.stored)
        for name, outputs in self.with_factors.items():
            self._parts[name] = partial(self._part, outputs, {})

    def structure(self) -> Iterable[Any]:
        """Yield everything that the functions depend on, except the values of coefficients."""
        solution, numbers = self.solution, self.numbers
        yield solution.kept.sizes, list(numbers.structure(solution.kept))
        for outputs in self.at_position.values():
            yield outputs.sizes, list(numbers.structure(outputs, solution.stored))
        for outputs in self.with_factors.values():
            yield outputs.sizes, list(numbers.structure(outputs))

    def write(self, module: Module, kinds: Callable[[str], tuple[str, list[str]]]) -> list[str]:
        """Write the functions that kernels call; return their names. `kinds` returns the types of a function."""
        functions: dict[str, Callable[..., Any]]
        functions = {"own_correct_positions": self.project_position, "own_project": self.project}
        if self.equations.reduced is None:
            functions["own_accelerate"] = self.accelerations
        for name, emit in functions.items():
            llvm_code.write(module, name, kinds(name), emit)
        return list(functions)

    # methods that write the functions of the parts

    def _call(self, emit: Emitter, *calls: tuple[str, Sequence[Value]]) -> Value:
        """Write calls (name, arguments) of parts, and parts that are missing; return whether all results are valid."""
        module, holds = emit.builder.module, None
        for part, arguments in calls:
            name = f"{part}_{emit.suffix}"
            if not module.defines(name):
                builder = module.function(name, emit.bit, [value.type for value in arguments], internal=True)
                builder.ret(self._parts[part](emit.like(builder), *builder.arguments))
            valid = emit.builder.call(name, emit.bit, arguments)
            holds = valid if holds is None else emit.builder.both(holds, valid)
        assert holds is not None
        return holds

    def _lowering(
        self, emit: Emitter, graph: Graph, arguments: Sequence[Value], places: Mapping[int, Place]
    ) -> Lowering:
        """Return the Lowering that writes a part, whose arguments begin with three inputs and the coefficients."""
        *given, emit.numbers = arguments[:4]
        if width_of(emit.double) > 1:
            emit.constants = emit.numbers  # type: ignore[attr-defined]
        lowering = Lowering(emit, self.numbers, places)
        lowering.define_inputs(graph, given)
        return lowering

    def _factors(self, emit: Emitter, *arguments: Value) -> Value:
        """Write the part that stores `solution.stored` in its fifth argument; return whether the conditions hold."""
        graph, solution, kept = self.equations.graph, self.solution, arguments[4]
        lowering = self._lowering(emit, graph, arguments, {})
        places = {i: (kept, place) for i, place in solution.stored.items()}
        for i, place in places.items():
            if graph.operations[i] is None:  # this entry is t or a coordinate
                emit.store(lowering.value(i), *place)
        lowering.run(graph, graph.in_order_of_use(solution.kept.forms), places)
        return lowering.holds(solution.kept, [])

    def _part(self, program: Program, kept: Mapping[int, int], emit: Emitter, *arguments: Value) -> Value:
        """Write the part that fills the arrays of a program; return whether they are valid. `kept`: see `Solution`."""
        places = {i: (arguments[4], place) for i, place in kept.items()}
        lowering = self._lowering(emit, program.graph, arguments, places)
        results = program.run(lowering)
        for array, values in zip(arguments[-len(results) :], results, strict=True):
            for j, value in enumerate(values):
                emit.store(value, array, j)
        return lowering.holds(program, results[0])

    # methods that write functions for kernels, or code in SIMD lanes

    def accelerations(self, emit: Emitter, t: Value, q: Value, v: Value, numbers: Value, a: Value) -> Value:
        """Write code that stores the accelerations at (t, q, v) in `a`; return whether they are valid."""
        kept, r, c, lam = self._stack_arrays(emit)
        at = [t, q, v, numbers, kept]
        return self._call(emit, ("factors", at), ("right", [*at, r, c]), ("solution", [r, c, kept, numbers, a, lam]))

    def project_position(
        self, emit: Emitter, t: Value, q: Value, v: Value, numbers: Value, moved: Value, out: Value
    ) -> Value:
        """Store q after a Newton step in `out`, and its change in `moved`; return whether these results are valid."""
        kept, r, c, lam = self._stack_arrays(emit)
        at = [t, q, v, numbers, kept]
        _clear(emit, self.n, r)
        holds = self._call(emit, ("factors", at), ("off", [*at, c]), ("solution", [r, c, kept, numbers, moved, lam]))
        _leave_unless(emit, holds)
        _sum(emit, self.n, q, moved, out)
        return holds

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
        """Project q and v in the metric of M, and store the results; return whether they are valid.

        The results are the change of q, the projected q and v, and the accelerations and multipliers for the new v.
        """
        kept, r, c, change = self._stack_arrays(emit)
        u, at = self._stack_array(emit, self.n), [t, q, v, numbers, kept]
        _clear(emit, self.n, r)
        corrections_valid = self._call(
            emit,
            ("factors", at),
            *(("off", [*at, c]), ("solution", [r, c, kept, numbers, moved, lam])),
            *(("faster", [*at, c]), ("solution", [r, c, kept, numbers, change, lam])),
        )
        _sum(emit, self.n, v, change, u)
        of_rows = c if self.redundant else lam
        holds = self._call(
            emit,
            ("right", [t, q, u, numbers, kept, r, c]),
            ("solution", [r, c, kept, numbers, a, of_rows]),
            *([("least", [c, c, kept, numbers, lam])] if self.redundant else []),
        )
        holds = emit.builder.both(corrections_valid, holds)
        _leave_unless(emit, holds)
        _sum(emit, self.n, q, moved, new_q)
        _sum(emit, self.n, v, change, new_v)
        return holds

    def _stack_arrays(self, emit: Emitter) -> list[Value]:
        """Return pointers to four arrays on the stack: for stored quantities, r, c, and one as long as a and lam."""
        sizes = self.solution.n_stored, self.n, self.n_rows, max(self.n, self.n_rows)
        return [self._stack_array(emit, size) for size in sizes]

    def _stack_array(self, emit: Emitter, size: int) -> Value:
        return emit.builder.room(DOUBLE, size * width_of(emit.double))


def _leave_unless(emit: Emitter, holds: Value) -> None:
    """Write a return from the function if results are invalid, before it changes an argument; nothing in SIMD lanes."""
    if holds.type == BIT:
        emit.builder.leave_unless(holds)


def _clear(emit: Emitter, n: int, out: Value) -> None:
    with emit.loop(integer(0), integer(n), []) as (j, _, _):
        emit.store(emit.constant(0.0), emit.pointer(out, j))


def _sum(emit: Emitter, n: int, a: Value, b: Value, out: Value) -> None:
    with emit.loop(integer(0), integer(n), []) as (j, _, _):
        total = emit.add(emit.load(emit.pointer(a, j)), emit.load(emit.pointer(b, j)))
        emit.store(total, emit.pointer(out, j))


Array = NDArray[np.float64]


def write_function(
    module: Module, name: str, kind: tuple[str, list[str]], program: Program, numbers: Coefficients
) -> None:
    """Write a function of the inputs of a program and of coefficients that fills the arrays of the program.

    The function returns whether the conditions hold and the first array is finite; if not, it changes no array.
    """

    def emit_all(emit: Emitter, *arguments: Value) -> Value:
        n_given = len(program.graph.sizes)
        given, emit.numbers, filled = arguments[:n_given], arguments[n_given], arguments[n_given + 1 :]
        lowering = Lowering(emit, numbers)
        lowering.define_inputs(program.graph, given)
        results = program.run(lowering)
        holds = lowering.holds(program, results[0])
        with emit.builder.if_then(holds):
            for place, array in zip(filled, results, strict=True):
                for j, value in enumerate(array):
                    emit.store(value, place, j)
        return holds

    llvm_code.write(module, name, kind, emit_all)


class SharedCode:
    """Compiled functions for the equations of one or more systems; they are read from the disk if they are cached.

    Parameters
    ----------
    equations : Elimination
    cache : TraceCache

    Attributes
    ----------
    numbers : Coefficients
        Coefficients that the functions read.
    digest : str
        Digest of everything that the functions depend on, except the values of coefficients.
    functions : GeneratedFunctions
    """

    def __init__(self, equations: Elimination, cache: TraceCache):
        self.equations, self.cache, self.numbers, self.parts = equations, cache, Coefficients(), None
        if equations.n_operations > (SPLIT_ALL if equations.reduced is None else SPLIT_PROJECTIONS):
            self.parts = SplitFunctions(equations, self.numbers)
        self.outputs = self._programs()
        structure = repr(list(self._structure()))
        self.digest = hashlib.sha256((structure + _stamp()).encode()).hexdigest()
        # optimization passes of LLVM do not make the code faster, and take up to a quarter of the time to compile
        self.functions = generated_functions("equations", _stamp(), self.digest, self._module_text, passes=False)

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "GeneratedCode":
        """Return the GeneratedCode with coefficients for the parameters of one of the systems."""
        return GeneratedCode(
            self, evaluate(self.numbers.formulas), self.equations.traced.of(system, evaluate), evaluate
        )

    def _programs(self) -> dict[str, Program]:
        """Return the programs, by names of functions, for functions that are not split."""
        equations = self.equations
        outputs = {"own_redundant": equations.redundant_rows}
        if self.parts is None:
            outputs |= {"own_correct_positions": equations.position_projection, "own_project": equations.projection}
        return outputs

    def _structure(self) -> Iterable[Any]:
        equations, parts, numbers = self.equations, self.parts, self.numbers
        yield equations.system.n_q, equations.choice.rows, equations.choice.added
        for outputs in (*self.outputs.values(), *equations.accelerations[: None if parts is None else -1]):
            yield outputs.sizes, list(numbers.structure(outputs))
        if parts is not None:
            yield from parts.structure()

    def _module_text(self) -> tuple[list[str], str]:
        from twoloop.kernels.data.common import KIT

        equations = self.equations
        module = Module(divided=True)
        for name, outputs in self.outputs.items():
            write_function(module, name, KIT.llvm_type(name), outputs, self.numbers)
        parts = [] if self.parts is None else self.parts.write(module, KIT.llvm_type)
        name = "own_accelerate"
        if name not in parts:
            write_acceleration_function(module, name, KIT.llvm_type(name), equations, self.numbers)
            parts.append(name)
        return [*self.outputs, *parts], str(module)


class GeneratedCode(NamedTuple):
    """Compiled functions together with the coefficients of one system."""

    shared: SharedCode
    numbers: Array  # values of the coefficients that the code reads
    traced: Traced
    evaluate: Evaluator  # evaluates arrays of expressions of the trace cache for this system

    @property
    def kinds(self) -> frozenset[str]:
        """Return the kinds of callbacks that were traced."""
        return self.traced.kinds

    def is_valid_from(self, system: ConstrainedSystem, t0: float, q0: Array) -> bool:
        """Return whether this code can be used for a run from (t0, q0): whether the choice of pivots there is equal."""
        try:
            return PivotChoice.at(system, t0, q0) == self.shared.equations.choice
        except Untraceable:
            return False


def generated_code(system: ConstrainedSystem, t0: float, q0: Array, check: Check = unchecked) -> GeneratedCode:
    """Return the cached code for a system and a start; `check` raises if calls of callbacks differ from their traces.

    Raises
    ------
    ValueError
        If code for the equations cannot be generated.
    """
    try:
        choice = system.remembered_at("choice", (t0, q0.tobytes()), lambda: PivotChoice.at(system, t0, q0))

        def make(cache: TraceCache) -> SharedCode:
            return SharedCode(Elimination(system, choice, cache.equations(system)), cache)

        code: GeneratedCode = derive_cached(system, ("code", choice), make, lambda code: check(code.traced))
    except Untraceable as error:
        raise ValueError(f"compiled=True needs equations that can be written down; {error}. Leave it out") from error
    return code


@cache
def _stamp() -> str:
    """Return a digest of the modules that generate the functions, and of the signatures of kernel functions."""
    from twoloop.generate import elimination, llvm_code, llvm_text, null_space, program
    from twoloop.kernels.data.common import KIT

    writers = (elimination, null_space, program, llvm_code, llvm_text)
    return digest_of(repr(KIT), __file__, *writers)
