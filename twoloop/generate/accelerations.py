"""Accelerations as code, for numbers or in lanes: by few operations where these serve, else by the elimination of M.

Code of the fewest operations (null_space.py) divides by fixed pivots. Where one is small, a function of the module that
eliminates M first finds the same numbers. In lanes it is called for all of them if one needs it, and the others keep
what they have: no run depends on those beside it.
"""

from collections.abc import Callable, Sequence

from twoloop.generate import llvm_code
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_code import Emitter
from twoloop.generate.llvm_text import BIT, DOUBLE, Module, Value, width_of
from twoloop.generate.straight_line import Outputs, StraightLine
from twoloop.generate.written import Written, conditions_hold

ARRAY = f"{DOUBLE}*"


def write_accelerations(
    emit: Emitter, equations: StraightLine, inputs: Sequence[Value], numbers: Coefficients
) -> tuple[list[Value], Value]:
    """Write the accelerations at [t, q, v], and whether they may be used.

    What follows goes on in the block in which the builder is then. `emit` says where numbers stand.
    """
    written, n = Written(emit, numbers), equations.system.n_q
    for quantity, value in enumerate(inputs):
        written.define(quantity, value)

    def state() -> list[Value]:
        place = _room(emit, 2 * n)
        for i, value in enumerate(inputs[1:]):
            emit.store(value, place, i)
        return [inputs[0], place, emit.pointer(place, n)]

    return _accelerations(emit, equations, written, state)


def write_own_accelerations(
    module: Module, name: str, kind: tuple[str, list[str]], equations: StraightLine, numbers: Coefficients
) -> None:
    """Write a function of t, q, v and `numbers`, which fills a and returns whether it could."""

    def emit_all(emit: Emitter, t: Value, q: Value, v: Value, given: Value, filled: Value) -> Value:
        written, emit.numbers = Written(emit, numbers), given
        written.take(equations.graph, [t, q, v])
        a, holds = _accelerations(emit, equations, written, lambda: [t, q, v])
        with emit.builder.if_then(holds):
            for i, value in enumerate(a):
                emit.store(value, filled, i)
        return holds

    llvm_code.write(module, name, kind, emit_all)


def call_accelerations(
    emit: Emitter, equations: StraightLine, way: int, inputs: Sequence[Value], numbers: Coefficients, filled: Value
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
    emit: Emitter, equations: StraightLine, written: Written, state: Callable[[], list[Value]]
) -> tuple[list[Value], Value]:
    """The same of what is written; `state` puts t, q and v where a function finds them."""
    outputs, *others = equations.accelerations
    a, holds = _outputs(emit, equations, written, outputs)
    if not others:
        return a, holds
    builder = emit.builder
    everywhere = holds
    if (width := width_of(holds.type)) > 1:
        everywhere = builder.call(f"llvm.vector.reduce.and.v{width}i1", BIT, [holds])
    before, otherwise, after = builder.block, builder.append_block(), builder.append_block()
    builder.branch(everywhere, after, otherwise)
    builder.position_at_end(otherwise)
    name, place = _function(emit, equations, -1, written.numbers), _room(emit, len(a))
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


def _outputs(emit: Emitter, equations: StraightLine, written: Written, outputs: Outputs) -> tuple[list[Value], Value]:
    (a,) = written.results(equations.graph, outputs)
    return a, conditions_hold(emit, written, outputs, a)


def _function(emit: Emitter, equations: StraightLine, way: int, numbers: Coefficients) -> str:
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
        written = Written(inner, numbers)
        written.define(0, t)
        for first, array in ((1, q), (1 + n, v)):
            for i in range(n):
                written.define(first + i, inner.load(array, i))
        a, holds = _outputs(inner, equations, written, outputs)
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
