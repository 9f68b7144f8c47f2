"""Functions of one mechanism in parts that call one another: long equations are written and compiled once.

Accelerations and both projections take the same factors and solve with them. What LLVM takes for machine code grows
faster than the length of a block, and the values of long equations pass through memory in any case, as there are more
of them than registers. So each part is a function of its own, and the functions that kernels know call them: the
factors of a position, the solution with them, which gives accelerations and the corrections that move q and v onto the
constraints, right-hand sides, and, with redundant rows, multipliers of least norm. All of them are for numbers, or for
states in lanes.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from twoloop.generate import llvm_code
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_code import Emitter
from twoloop.generate.llvm_text import BIT, DOUBLE, Module, Value, integer, width_of
from twoloop.generate.straight_line import Outputs, Solution, StraightLine
from twoloop.generate.tracing import Graph
from twoloop.generate.written import Place, Written, conditions_hold

# operations from which on equations are written in parts, which takes half as long to build: where these are for
# projections alone, and where accelerations, too, would take half as long again by them
LONG, LONG_OF_ALL = 200, 500


class PartsCode:
    """Writes the parts, and the functions of which they are parts.

    Parameters
    ----------
    equations : StraightLine
    numbers : Coefficients

    Attributes
    ----------
    solution : Solution
        Which keeps what parts have in common.
    at_position, with_factors : dict
        Outputs of parts by their names: from t, q, v and what is kept, and from r, c and what is kept.
    """

    def __init__(self, equations: StraightLine, numbers: Coefficients):
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

    def _written(self, emit: Emitter, graph: Graph, arguments: Sequence[Value], places: Mapping[int, Place]) -> Written:
        """For code of three inputs of a graph, which are given first, and then the numbers that it reads."""
        *given, emit.numbers = arguments[:4]
        if width_of(emit.double) > 1:
            emit.constants = emit.numbers  # type: ignore[attr-defined]
        written = Written(emit, self.numbers, places)
        written.take(graph, given)
        return written

    def _factors(self, emit: Emitter, *arguments: Value) -> Value:
        """Whether the conditions hold; what is kept is stored when it is found."""
        graph, solution, kept = self.equations.graph, self.solution, arguments[4]
        written = self._written(emit, graph, arguments, {})
        places = {i: (kept, place) for i, place in solution.known.items()}
        for i, place in places.items():
            if graph.operations[i] is None:  # an entry is t or a coordinate
                emit.store(written.value(i), *place)
        written.write(graph, graph.in_order_of_use(solution.kept.forms), places)
        return conditions_hold(emit, written, solution.kept, [])

    def _part(
        self, graph: Graph, outputs: Outputs, known: Mapping[int, int] | None, emit: Emitter, *arguments: Value
    ) -> Value:
        """Whether outputs hold; they are stored. `known`: what is kept, and where, which is then the fifth argument."""
        places = {} if known is None else {i: (arguments[4], place) for i, place in known.items()}
        written = self._written(emit, graph, arguments, places)
        results = written.results(graph, outputs)
        for array, values in zip(arguments[-len(results) :], results, strict=True):
            for j, value in enumerate(values):
                emit.store(value, array, j)
        return conditions_hold(emit, written, outputs, results[0])

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
