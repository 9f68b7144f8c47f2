"""Functions of one mechanism in parts that call one another: long equations are written and compiled once.

Accelerations and both projections take the same factors and solve with them. What LLVM takes for machine code grows
faster than the length of a block, and the values of long equations pass through memory in any case, as there are more
of them than registers. So each part is a function of its own, and the functions that kernels know call them: the
factors of a position, the solution with them, which gives accelerations and the corrections that move q and v onto the
constraints, right-hand sides, and, with redundant rows, multipliers of least norm. All of them are for numbers, or for
states in lanes.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from twoloop.generate import llvm_code
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_code import Emitter
from twoloop.generate.llvm_text import BIT, DOUBLE, Module, Value, integer, width_of
from twoloop.generate.straight_line import Outputs, Solution, StraightLine
from twoloop.generate.written import NOWHERE, Place, Written, conditions_hold

# operations from which on equations are written in parts, which takes half as long to build: where these are for
# projections alone, and where accelerations, too, would take half as long again by them
LONG, LONG_OF_ALL = 200, 500


def is_long(equations: StraightLine) -> bool:
    """Whether equations are worth their calls."""
    return equations.n_operations > (LONG_OF_ALL if equations.quick is None else LONG)


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
        self._parts |= {name: self._at_position(outputs) for name, outputs in self.at_position.items()}
        self._parts |= {name: self._with_factors(outputs) for name, outputs in self.with_factors.items()}

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

    def _call(self, emit: Emitter, name: str, arguments: Sequence[Value]) -> Value:
        """Whether what a part computes holds; it is written when it is first called."""
        module, full_name = emit.builder.module, f"{name}_{emit.suffix}"
        if not module.defines(full_name):
            builder = module.function(full_name, emit.bit, [value.type for value in arguments], internal=True)
            builder.ret(self._parts[name](emit.like(builder), *builder.arguments))
        return emit.builder.call(full_name, emit.bit, arguments)

    def _written(self, emit: Emitter, arguments: Sequence[Value], places: Mapping[int, Place] = NOWHERE) -> Written:
        """For code at t, q, v, of which numbers are the next argument."""
        written = Written(emit, self.numbers, places)
        _read(emit, arguments[3])
        written.take(self.equations.graph, arguments[:3])
        return written

    def _factors(self, emit: Emitter, *arguments: Value) -> Value:
        """Whether the conditions hold; what is kept is stored when it is found."""
        graph, solution, kept = self.equations.graph, self.solution, arguments[4]
        written = self._written(emit, arguments)
        places = {i: (kept, place) for i, place in solution.known.items()}
        for i, place in places.items():
            if graph.operations[i] is None:  # an entry is t or a coordinate
                emit.store(written.value(i), *place)
        written.write(graph, graph.in_order_of_use(solution.kept.forms), places)
        return conditions_hold(emit, written, solution.kept, [])

    def _at_position(self, outputs: Outputs) -> Callable[..., Value]:
        def emit_part(emit: Emitter, *arguments: Value) -> Value:
            known, kept = self.solution.known, arguments[4]
            written = self._written(emit, arguments, {i: (kept, place) for i, place in known.items()})
            results = written.results(self.equations.graph, outputs)
            _store(emit, results, arguments[5:])
            return conditions_hold(emit, written, outputs, results[0])

        return emit_part

    def _with_factors(self, outputs: Outputs) -> Callable[..., Value]:
        def emit_part(emit: Emitter, r: Value, c: Value, kept: Value, numbers: Value, *out: Value) -> Value:
            _read(emit, numbers)
            written = Written(emit, self.numbers)
            written.take(self.solution.graph, [r, c, kept])
            results = written.results(self.solution.graph, outputs)
            _store(emit, results, out)
            return conditions_hold(emit, written, outputs, results[0])

        return emit_part

    # what kernels call, and code in lanes

    def there(self, emit: Emitter, t: Value, q: Value, v: Value, numbers: Value, a: Value) -> Value:
        """Accelerations."""
        kept, r, c, lam = self._rooms(emit)
        at = [t, q, v, numbers, kept]
        holds = self._call(emit, "factors", at)
        holds = _both(emit, holds, self._call(emit, "right", [*at, r, c]))
        return _both(emit, holds, self._call(emit, "solution", [r, c, kept, numbers, a, lam]))

    def closer(self, emit: Emitter, t: Value, q: Value, v: Value, numbers: Value, moved: Value, out: Value) -> Value:
        """Positions moved towards the constraints."""
        kept, r, c, lam = self._rooms(emit)
        at = [t, q, v, numbers, kept]
        _clear(emit, self.n, r)
        holds = self._correct(emit, self._call(emit, "factors", at), "off", at, r, c, moved, lam)
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
        """The same, and velocities, accelerations and multipliers."""
        kept, r, c, change = self._rooms(emit)
        (u,) = _rooms(emit, self.n)
        at = [t, q, v, numbers, kept]
        _clear(emit, self.n, r)
        holds = self._correct(emit, self._call(emit, "factors", at), "off", at, r, c, moved, lam)
        holds = self._correct(emit, holds, "faster", at, r, c, change, lam)
        _sum(emit, self.n, v, change, u)
        holds = _both(emit, holds, self._call(emit, "right", [t, q, u, numbers, kept, r, c]))
        solution = [r, c, kept, numbers, a, c if self.redundant else lam]
        holds = _both(emit, holds, self._call(emit, "solution", solution))
        if self.redundant:
            holds = _both(emit, holds, self._call(emit, "least", [c, c, kept, numbers, lam]))
        _leave_unless(emit, holds)
        _sum(emit, self.n, q, moved, new_q)
        _sum(emit, self.n, v, change, new_v)
        return holds

    def _rooms(self, emit: Emitter) -> list[Value]:
        """For what is kept, r, c, and a solution."""
        return _rooms(emit, self.solution.n_kept, self.n, self.n_rows, max(self.n, self.n_rows))

    def _correct(
        self, emit: Emitter, holds: Value, what: str, at: list[Value], r: Value, c: Value, out: Value, lam: Value
    ) -> Value:
        """The solution where r is zero, in the metric of M; the multipliers do not matter."""
        holds = _both(emit, holds, self._call(emit, what, [*at, c]))
        return _both(emit, holds, self._call(emit, "solution", [r, c, at[-1], at[-2], out, lam]))


def _read(emit: Emitter, numbers: Value) -> None:
    """Say where numbers stand, which lanes have in common."""
    emit.numbers = numbers
    if width_of(emit.double) > 1:
        emit.constants = numbers  # type: ignore[attr-defined]


def _rooms(emit: Emitter, *sizes: int) -> list[Value]:
    return [emit.builder.room(DOUBLE, size * width_of(emit.double)) for size in sizes]


def _both(emit: Emitter, one: Value, other: Value) -> Value:
    return emit.builder.both(one, other)


def _leave_unless(emit: Emitter, holds: Value) -> None:
    """Change nothing that is given where it does not hold; in lanes, others may hold."""
    if holds.type == BIT:
        emit.builder.leave_unless(holds)


def _store(emit: Emitter, arrays: Sequence[Sequence[Value]], out: Sequence[Value]) -> None:
    for place, values in zip(out, arrays, strict=True):
        for j, value in enumerate(values):
            emit.store(value, place, j)


def _clear(emit: Emitter, n: int, out: Value) -> None:
    with emit.loop(integer(0), integer(n), []) as (j, _, _):
        emit.store(emit.constant(0.0), emit.pointer(out, j))


def _sum(emit: Emitter, n: int, one: Value, other: Value, out: Value) -> None:
    with emit.loop(integer(0), integer(n), []) as (j, _, _):
        total = emit.add(emit.load(emit.pointer(one, j)), emit.load(emit.pointer(other, j)))
        emit.store(total, emit.pointer(out, j))
