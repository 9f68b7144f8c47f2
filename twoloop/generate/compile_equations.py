"""Compile the equations of one mechanism: the tasks of the inner loop that explicit methods call.

The operations of an elimination become LLVM's instructions one by one, past numba, which would take seconds for some
hundred of them. The code is kept on disk as that of the kernels is.

**Accelerations** are computed by few operations where these serve, else by the elimination of M. Code of the fewest
operations (null_space.py) divides by fixed pivots. Where one is small, a function of the module that eliminates M first
finds the same numbers. In lanes it is called for all of them if one needs it, and the others keep what they have: no
run depends on those beside it.

**Long equations** are divided into functions that call one another, each written and compiled once. LLVM's time grows
faster than the length of a block, and the values of long equations pass through memory in any case. Accelerations and
both projections share the factors of a position and the solution with them.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.generate import llvm_code
from twoloop.generate.choices import Choice
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.elimination import Elimination, Outputs, Solution
from twoloop.generate.graph import Graph, Untraceable
from twoloop.generate.llvm_code import Emitter
from twoloop.generate.llvm_text import BIT, DOUBLE, Module, Value, integer, width_of
from twoloop.generate.lowering import Lowering, Place, conditions_hold
from twoloop.generate.trace_cache import Evaluator, TraceCache, derive_cached
from twoloop.generate.traced_values import Check, Traced, unchecked
from twoloop.kernels.compile.dependencies import digest_of
from twoloop.kernels.compile.generated_functions import own_functions
from twoloop.problem.system import ConstrainedSystem

ARRAY = f"{DOUBLE}*"


def write_accelerations(
    emit: Emitter, equations: Elimination, inputs: Sequence[Value], numbers: Coefficients
) -> tuple[list[Value], Value]:
    """Write the accelerations at [t, q, v], and whether they may be used.

    What follows goes on in the block in which the builder is then. `emit` says where numbers stand.
    """
    lowering, n = Lowering(emit, numbers), equations.system.n_q
    for quantity, value in enumerate(inputs):
        lowering.define(quantity, value)

    def state() -> list[Value]:
        place = _room(emit, 2 * n)
        for i, value in enumerate(inputs[1:]):
            emit.store(value, place, i)
        return [inputs[0], place, emit.pointer(place, n)]

    return _accelerations(emit, equations, lowering, state)


def write_acceleration_function(
    module: Module, name: str, kind: tuple[str, list[str]], equations: Elimination, numbers: Coefficients
) -> None:
    """Write a function of t, q, v and `numbers`, which fills a and returns whether it could."""

    def emit_all(emit: Emitter, t: Value, q: Value, v: Value, given: Value, filled: Value) -> Value:
        lowering, emit.numbers = Lowering(emit, numbers), given
        lowering.take(equations.graph, [t, q, v])
        a, holds = _accelerations(emit, equations, lowering, lambda: [t, q, v])
        with emit.builder.if_then(holds):
            for i, value in enumerate(a):
                emit.store(value, filled, i)
        return holds

    llvm_code.write(module, name, kind, emit_all)


def call_accelerations(
    emit: Emitter, equations: Elimination, way: int, inputs: Sequence[Value], numbers: Coefficients, filled: Value
) -> Value:
    """Fill an array with the accelerations at [t, q, v] by a function of the module; whether they may be used.

    `way` is a place in `equations.accelerations`: 0, that of the fewest operations; -1, the elimination of M.
    """
    place = _room(emit, 2 * equations.system.n_q)
    for i, value in enumerate(inputs[1:]):
        emit.store(value, place, i)
    given = [inputs[0], place, emit.pointer(place, equations.system.n_q), *_numbers(emit), filled]
    return emit.builder.call(_function(emit, equations, way, numbers), emit.bit, given)


def _accelerations(
    emit: Emitter, equations: Elimination, lowering: Lowering, state: Callable[[], list[Value]]
) -> tuple[list[Value], Value]:
    """The same of what is written; `state` puts t, q and v where a function finds them."""
    outputs, *others = equations.accelerations
    a, holds = _outputs(emit, equations, lowering, outputs)
    if not others:
        return a, holds
    builder = emit.builder
    everywhere = holds
    if (width := width_of(holds.type)) > 1:
        everywhere = builder.call(f"llvm.vector.reduce.and.v{width}i1", BIT, [holds])
    before, otherwise, after = builder.block, builder.append_block(), builder.append_block()
    builder.branch(everywhere, after, otherwise)
    builder.position_at_end(otherwise)
    name, place = _function(emit, equations, -1, lowering.numbers), _room(emit, len(a))
    found = builder.call(name, emit.bit, [*state(), *_numbers(emit), place])
    b = [builder.select(holds, value, emit.load(place, i)) for i, value in enumerate(a)]
    found, last = builder.operation("or", holds, found), builder.block
    builder.go_to(after)
    builder.position_at_end(after)
    joined: list[Value] = []
    for one, other in zip([*a, holds], [*b, found], strict=True):
        phi = builder.phi(one.type)
        phi.add_incoming(one, before)
        phi.add_incoming(other, last)
        joined.append(phi)
    *a, holds = joined
    return a, holds


def _outputs(emit: Emitter, equations: Elimination, lowering: Lowering, outputs: Outputs) -> tuple[list[Value], Value]:
    (a,) = lowering.results(equations.graph, outputs)
    return a, conditions_hold(emit, lowering, outputs, a)


def _function(emit: Emitter, equations: Elimination, way: int, numbers: Coefficients) -> str:
    """The name of the function of the module for a way to find accelerations; `numbers` are those that it reads."""
    outputs, mass_first = equations.accelerations[way], way in (-1, len(equations.accelerations) - 1)
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
            builder.ret(equations.parts.there(inner, t, q, v, places[0], filled))
            return name
        lowering = Lowering(inner, numbers)
        lowering.define(0, t)
        for first, array in ((1, q), (1 + n, v)):
            for i in range(n):
                lowering.define(first + i, inner.load(array, i))
        a, holds = _outputs(inner, equations, lowering, outputs)
        for i, value in enumerate(a):
            inner.store(value, filled, i)
        builder.ret(holds)
    return name


def _numbers(emit: Emitter) -> list[Value]:
    """Where the numbers that code reads stand; in lanes also those that all have in common."""
    constants = getattr(emit, "constants", None)
    return [emit.numbers] if constants is None else [emit.numbers, constants]


def _room(emit: Emitter, size: int) -> Value:
    return emit.builder.room(DOUBLE, size * width_of(emit.double))


# operations from which on equations are written in parts, which takes half as long to build: where these are for
# projections alone, and where accelerations, too, would take half as long again by them
LONG, LONG_OF_ALL = 200, 500


class SplitFunctions:
    """Writes the parts, and the functions of which they are parts.

    Parameters
    ----------
    equations : Elimination
    numbers : Coefficients

    Attributes
    ----------
    solution : Solution
        Which keeps what parts have in common.
    at_position, with_factors : dict
        Outputs of parts by their names: from t, q, v and what is kept, and from r, c and what is kept.
    """

    def __init__(self, equations: Elimination, numbers: Coefficients):
        self.equations, self.numbers = equations, numbers
        equations.parts = self
        self.n, self.n_rows = equations.system.n_q, len(equations.all_rows)
        self.redundant = len(equations.choice.rows) < self.n_rows
        self.at_position = {"right": equations.right, "off": equations.off, "faster": equations.faster}
        self.solution = Solution(equations, list(self.at_position.values()))
        self.with_factors = {"solution": self.solution.solved}
        if self.redundant:
            self.with_factors["least"] = self.solution.least
        self._parts: dict[str, Callable[..., Value]] = {"factors": self._factors}
        for name, outputs in self.at_position.items():
            self._parts[name] = partial(self._part, equations.graph, outputs, self.solution.known)
        for name, outputs in self.with_factors.items():
            self._parts[name] = partial(self._part, self.solution.graph, outputs, None)

    def described(self) -> Iterable[Any]:
        """What the functions depend on, the values of numbers apart."""
        equations, solution, numbers = self.equations, self.solution, self.numbers
        yield solution.kept.sizes, list(numbers.structure(equations.graph, solution.kept.forms))
        for outputs in self.at_position.values():
            yield outputs.sizes, list(numbers.structure(equations.graph, outputs.forms, solution.known))
        for outputs in self.with_factors.values():
            yield outputs.sizes, list(numbers.structure(solution.graph, outputs.forms))

    def write(self, module: Module, kinds: Callable[[str], tuple[str, list[str]]]) -> list[str]:
        """Put the functions that kernels know into a module; their names. `kinds` has their types."""
        known: dict[str, Callable[..., Any]] = {"own_closer": self.closer, "own_nearer": self.nearer}
        if self.equations.quick is None:
            known["own_there"] = self.there
        for name, emit in known.items():
            llvm_code.write(module, name, kinds(name), emit)
        return list(known)

    # the parts

    def _call(self, emit: Emitter, *calls: tuple[str, Sequence[Value]]) -> Value:
        """Whether what parts compute holds; they are written when they are first called."""
        module, holds = emit.builder.module, None
        for part, arguments in calls:
            name = f"{part}_{emit.suffix}"
            if not module.defines(name):
                builder = module.function(name, emit.bit, [value.type for value in arguments], internal=True)
                builder.ret(self._parts[part](emit.like(builder), *builder.arguments))
            found = emit.builder.call(name, emit.bit, arguments)
            holds = found if holds is None else emit.builder.both(holds, found)
        assert holds is not None
        return holds

    def _lowering(
        self, emit: Emitter, graph: Graph, arguments: Sequence[Value], places: Mapping[int, Place]
    ) -> Lowering:
        """For code of three inputs of a graph, which are given first, and then the numbers that it reads."""
        *given, emit.numbers = arguments[:4]
        if width_of(emit.double) > 1:
            emit.constants = emit.numbers  # type: ignore[attr-defined]
        lowering = Lowering(emit, self.numbers, places)
        lowering.take(graph, given)
        return lowering

    def _factors(self, emit: Emitter, *arguments: Value) -> Value:
        """Whether the conditions hold; what is kept is stored when it is found."""
        graph, solution, kept = self.equations.graph, self.solution, arguments[4]
        lowering = self._lowering(emit, graph, arguments, {})
        places = {i: (kept, place) for i, place in solution.known.items()}
        for i, place in places.items():
            if graph.operations[i] is None:  # an entry is t or a coordinate
                emit.store(lowering.value(i), *place)
        lowering.write(graph, graph.in_order_of_use(solution.kept.forms), places)
        return conditions_hold(emit, lowering, solution.kept, [])

    def _part(
        self, graph: Graph, outputs: Outputs, known: Mapping[int, int] | None, emit: Emitter, *arguments: Value
    ) -> Value:
        """Whether outputs hold; they are stored. `known`: what is kept, and where, which is then the fifth argument."""
        places = {} if known is None else {i: (arguments[4], place) for i, place in known.items()}
        lowering = self._lowering(emit, graph, arguments, places)
        results = lowering.results(graph, outputs)
        for array, values in zip(arguments[-len(results) :], results, strict=True):
            for j, value in enumerate(values):
                emit.store(value, array, j)
        return conditions_hold(emit, lowering, outputs, results[0])

    # what kernels call, and code in lanes

    def there(self, emit: Emitter, t: Value, q: Value, v: Value, numbers: Value, a: Value) -> Value:
        """Accelerations."""
        kept, r, c, lam = self._rooms(emit)
        at = [t, q, v, numbers, kept]
        return self._call(emit, ("factors", at), ("right", [*at, r, c]), ("solution", [r, c, kept, numbers, a, lam]))

    def closer(self, emit: Emitter, t: Value, q: Value, v: Value, numbers: Value, moved: Value, out: Value) -> Value:
        """Positions moved towards the constraints."""
        kept, r, c, lam = self._rooms(emit)
        at = [t, q, v, numbers, kept]
        _clear(emit, self.n, r)
        holds = self._call(emit, ("factors", at), ("off", [*at, c]), ("solution", [r, c, kept, numbers, moved, lam]))
        _leave_unless(emit, holds)
        _sum(emit, self.n, q, moved, out)
        return holds

    def nearer(
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
        """The same, and velocities, accelerations and multipliers; moves are in the metric of M."""
        kept, r, c, change = self._rooms(emit)
        u, at = self._room(emit, self.n), [t, q, v, numbers, kept]
        _clear(emit, self.n, r)
        moves = self._call(
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
        holds = emit.builder.both(moves, holds)
        _leave_unless(emit, holds)
        _sum(emit, self.n, q, moved, new_q)
        _sum(emit, self.n, v, change, new_v)
        return holds

    def _rooms(self, emit: Emitter) -> list[Value]:
        """For what is kept, r, c, and a solution."""
        sizes = self.solution.n_kept, self.n, self.n_rows, max(self.n, self.n_rows)
        return [self._room(emit, size) for size in sizes]

    def _room(self, emit: Emitter, size: int) -> Value:
        return emit.builder.room(DOUBLE, size * width_of(emit.double))


def _leave_unless(emit: Emitter, holds: Value) -> None:
    """Change nothing that is given where it does not hold; in lanes, others may hold."""
    if holds.type == BIT:
        emit.builder.leave_unless(holds)


def _clear(emit: Emitter, n: int, out: Value) -> None:
    with emit.loop(integer(0), integer(n), []) as (j, _, _):
        emit.store(emit.constant(0.0), emit.pointer(out, j))


def _sum(emit: Emitter, n: int, one: Value, other: Value, out: Value) -> None:
    with emit.loop(integer(0), integer(n), []) as (j, _, _):
        total = emit.add(emit.load(emit.pointer(one, j)), emit.load(emit.pointer(other, j)))
        emit.store(total, emit.pointer(out, j))


Array = NDArray[np.float64]


def write_function(
    module: Module,
    name: str,
    kind: tuple[str, list[str]],
    graph: Graph,
    outputs: Outputs,
    numbers: Coefficients,
) -> None:
    """Write a function of inputs, of the values of `numbers`, and of arrays to fill.

    It returns whether the conditions hold and what it computes is finite, and fills the arrays only then.
    """

    def emit_all(emit: Emitter, *arguments: Value) -> Value:
        n_given = len(graph.sizes)
        given, emit.numbers, filled = arguments[:n_given], arguments[n_given], arguments[n_given + 1 :]
        lowering = Lowering(emit, numbers)
        lowering.take(graph, given)
        results = lowering.results(graph, outputs)
        holds = conditions_hold(emit, lowering, outputs, results[0])
        with emit.builder.if_then(holds):
            for place, array in zip(filled, results, strict=True):
                for j, value in enumerate(array):
                    emit.store(value, place, j)
        return holds

    llvm_code.write(module, name, kind, emit_all)


class SharedCode:
    """Functions made for the equations of a family of systems, compiled, or read from the disk.

    Parameters
    ----------
    equations : Elimination
    family : TraceCache

    Attributes
    ----------
    solution : Solution
        Of them.
    numbers : Coefficients
        Of both.
    digest : str
        Of all that the functions depend on, the values of these apart.
    functions : OwnFunctions
    """

    def __init__(self, equations: Elimination, family: TraceCache):
        self.equations, self.family, self.numbers, self.parts = equations, family, Coefficients(), None
        if equations.n_operations > (LONG_OF_ALL if equations.quick is None else LONG):
            self.parts = SplitFunctions(equations, self.numbers)
        self.outputs = self._outputs()
        structure = repr(list(self._described()))
        self.digest = hashlib.sha256((structure + _stamp()).encode()).hexdigest()
        # LLVM finds nothing that makes equations faster, and takes up to a quarter of a build to look for it
        self.functions = own_functions("equations", _stamp(), self.digest, self._write, passes=False)

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "GeneratedCode":
        """The code, and what it reads for one of the systems."""
        return GeneratedCode(
            self, evaluate(self.numbers.formulas), self.equations.traced.of(system, evaluate), evaluate
        )

    def _outputs(self) -> dict[str, Outputs]:
        """What functions compute that are no parts of others."""
        equations = self.equations
        outputs = {"own_redundant": equations.redundant}
        if self.parts is None:
            outputs |= {"own_closer": equations.closer, "own_nearer": equations.nearer}
        return outputs

    def _described(self) -> Iterable[Any]:
        equations, parts, numbers = self.equations, self.parts, self.numbers
        yield equations.system.n_q, equations.choice.rows, equations.choice.added
        for outputs in (*self.outputs.values(), *equations.accelerations[: None if parts is None else -1]):
            yield outputs.sizes, list(numbers.structure(equations.graph, outputs.forms))
        if parts is not None:
            yield from parts.described()

    def _write(self) -> tuple[list[str], str]:
        from twoloop.kernels.data.common import KIT

        equations = self.equations
        module = Module(divided=True)
        for name, outputs in self.outputs.items():
            write_function(module, name, KIT.own_type(name), equations.graph, outputs, self.numbers)
        parts = [] if self.parts is None else self.parts.write(module, KIT.own_type)
        if "own_there" not in parts:
            write_acceleration_function(module, "own_there", KIT.own_type("own_there"), equations, self.numbers)
            parts.append("own_there")
        return [*self.outputs, *parts], str(module)


class GeneratedCode(NamedTuple):
    """The code of a family, for one system."""

    shared: SharedCode
    numbers: Array  # that it reads
    traced: Traced
    evaluate: Evaluator  # of other formulas of the family

    @property
    def kinds(self) -> frozenset[str]:
        """Of callbacks that ran on symbols."""
        return self.traced.kinds

    def serves(self, system: ConstrainedSystem, t0: float, q0: Array) -> bool:
        """Whether a run of the same system from this position gets the same code."""
        try:
            return Choice.at(system, t0, q0) == self.shared.equations.choice
        except Untraceable:
            return False


def generated_code(system: ConstrainedSystem, t0: float, q0: Array, check: Check = unchecked) -> GeneratedCode:
    """The code for a system, for a run that starts at a position; `check` raises where the callbacks are not in it.

    Raises
    ------
    ValueError
        If its equations cannot be had.
    """
    try:
        choice = system.remembered_at("choice", (t0, q0.tobytes()), lambda: Choice.at(system, t0, q0))

        def make(family: TraceCache) -> SharedCode:
            return SharedCode(Elimination(system, choice, family.equations(system)), family)

        made: GeneratedCode = derive_cached(system, ("code", choice), make, lambda code: check(code.traced))
    except Untraceable as error:
        raise ValueError(f"compiled=True needs equations that can be written down; {error}. Leave it out") from error
    return made


@cache
def _stamp() -> str:
    """A digest of what writes the functions, and of what they are called as."""
    from twoloop.generate import coefficients, elimination, llvm_code, llvm_text, lowering, null_space, symbolic_factors
    from twoloop.kernels.data.common import KIT

    writers = (elimination, symbolic_factors, null_space, coefficients, lowering, llvm_code, llvm_text)
    return digest_of(repr(KIT), __file__, *writers)
