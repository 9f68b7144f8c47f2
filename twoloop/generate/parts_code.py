"""Functions of one mechanism in parts that call one another: long equations are written and compiled once.

Accelerations and both projections take the same factors and solve with them. What LLVM takes for machine code grows
faster than the length of a block, and the values of long equations pass through memory in any case, as there are more
of them than registers. So each part is a function of its own, and the functions that kernels know call them: the
factors of a position, the solution with them, which gives accelerations and the corrections that move q and v onto the
constraints, right-hand sides, and, with redundant rows, multipliers of least norm.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from twoloop.generate.accelerations import MASS_FIRST
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_code import ZERO, Emitter
from twoloop.generate.llvm_text import BIT, DOUBLE, Builder, Module, Value, integer
from twoloop.generate.straight_line import Outputs, Solution, StraightLine
from twoloop.generate.written import NOWHERE, TRUE, Place, Written, conditions_hold

ARRAY = f"{DOUBLE}*"
POSITION = [DOUBLE, ARRAY, ARRAY, ARRAY, ARRAY]  # t, q, v, numbers, kept
LONG = 500  # operations from which on equations are written in parts


def is_long(equations: StraightLine) -> bool:
    """Whether equations are worth their calls."""
    return equations.n_operations > LONG


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
        self.n, self.n_rows = equations.system.n_q, len(equations.all_rows)
        self.redundant = len(equations.choice.rows) < self.n_rows
        self.at_position = {"right": equations.right, "off": equations.off, "faster": equations.faster}
        self.solution = Solution(equations, list(self.at_position.values()))
        self.with_factors = {"solution": self.solution.solved}
        if self.redundant:
            self.with_factors["least"] = self.solution.least

    def write(self, module: Module, kinds: Callable[[str], tuple[str, list[str]]]) -> list[str]:
        """Put all of them into a module; the names of those that kernels know, whose types `kinds` has."""
        known: dict[str, Callable[..., Any]] = {"own_closer": self._closer, "own_nearer": self._nearer}
        if self.equations.quick is None:
            known["own_there"] = self._there
        else:  # which calls this one where it does not serve
            _write(module.function(MASS_FIRST, *kinds("own_there"), internal=True), self._there)
        _write(module.function("factors", BIT, POSITION, internal=True), self._factors)
        for name, outputs in self.at_position.items():
            kind = [*POSITION, *[ARRAY] * len(outputs.arrays)]
            _write(module.function(name, BIT, kind, internal=True), self._at_position(outputs))
        for name, outputs in self.with_factors.items():
            kind = [ARRAY] * (4 + len(outputs.arrays))
            _write(module.function(name, BIT, kind, internal=True), self._with_factors(outputs))
        for name, emit in known.items():
            _write(module.function(name, *kinds(name)), emit)
        return list(known)

    # the parts

    def _written(self, emit: Emitter, arguments: Sequence[Value], places: Mapping[int, Place] = NOWHERE) -> Written:
        """For code at t, q, v, of which numbers are the next argument."""
        written, emit.numbers = Written(emit, self.numbers, places), arguments[3]
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
            emit.numbers = numbers
            written = Written(emit, self.numbers)
            written.take(self.solution.graph, [r, c, kept])
            results = written.results(self.solution.graph, outputs)
            _store(emit, results, out)
            return conditions_hold(emit, written, outputs, results[0])

        return emit_part

    # what kernels call

    def _there(self, emit: Emitter, t: Value, q: Value, v: Value, numbers: Value, a: Value) -> Value:
        kept, r, c, lam = _rooms(emit, self.solution.n_kept, self.n, self.n_rows, self.n_rows)
        at = [t, q, v, numbers, kept]
        _leave_unless(emit, "factors", at)
        _leave_unless(emit, "right", [*at, r, c])
        return emit.builder.call("solution", BIT, [r, c, kept, numbers, a, lam])

    def _closer(self, emit: Emitter, t: Value, q: Value, v: Value, numbers: Value, moved: Value, out: Value) -> Value:
        kept, r, c, lam = _rooms(emit, self.solution.n_kept, self.n, self.n_rows, self.n_rows)
        _leave_unless(emit, "factors", [t, q, v, numbers, kept])
        _clear(emit, self.n, r)
        self._correct(emit, "off", [t, q, v, numbers, kept], r, c, moved, lam)
        _sum(emit, self.n, q, moved, out)
        return TRUE

    def _nearer(
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
        n, n_rows = self.n, self.n_rows
        kept, r, c, change, u = _rooms(emit, self.solution.n_kept, n, n_rows, n, n)
        at = [t, q, v, numbers, kept]
        _leave_unless(emit, "factors", at)
        _clear(emit, n, r)
        self._correct(emit, "off", at, r, c, moved, lam)
        self._correct(emit, "faster", at, r, c, change, lam)
        _sum(emit, n, v, change, u)
        _leave_unless(emit, "right", [t, q, u, numbers, kept, r, c])
        _leave_unless(emit, "solution", [r, c, kept, numbers, a, c if self.redundant else lam])
        if self.redundant:
            _leave_unless(emit, "least", [c, c, kept, numbers, lam])
        _sum(emit, n, q, moved, new_q)
        _sum(emit, n, v, change, new_v)
        return TRUE

    def _correct(self, emit: Emitter, what: str, at: list[Value], r: Value, c: Value, out: Value, lam: Value) -> None:
        """The solution where r is zero, in the metric of M; the multipliers do not matter."""
        _leave_unless(emit, what, [*at, c])
        _leave_unless(emit, "solution", [r, c, at[-1], at[-2], out, lam])


def _rooms(emit: Emitter, *sizes: int) -> list[Value]:
    return [emit.builder.room(DOUBLE, size) for size in sizes]


def _leave_unless(emit: Emitter, name: str, arguments: Sequence[Value]) -> None:
    emit.builder.leave_unless(emit.builder.call(name, BIT, arguments))


def _write(builder: Builder, emit: Callable[..., Any]) -> None:
    builder.ret(emit(Emitter(builder), *builder.arguments))


def _store(emit: Emitter, arrays: Sequence[Sequence[Value]], out: Sequence[Value]) -> None:
    for place, values in zip(out, arrays, strict=True):
        for j, value in enumerate(values):
            emit.store(value, place, j)


def _clear(emit: Emitter, n: int, out: Value) -> None:
    with emit.loop(integer(0), integer(n), []) as (j, _, _):
        emit.store(ZERO, emit.pointer(out, j))


def _sum(emit: Emitter, n: int, one: Value, other: Value, out: Value) -> None:
    with emit.loop(integer(0), integer(n), []) as (j, _, _):
        total = emit.add(emit.load(emit.pointer(one, j)), emit.load(emit.pointer(other, j)))
        emit.store(total, emit.pointer(out, j))
