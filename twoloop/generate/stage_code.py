"""The stages of an explicit Runge-Kutta method as code compiled for one mechanism: sums and accelerations in one.

A step by the general code stores each stage, reads it back to find accelerations, stores these and reads them back for
the next sum. What a processor has stored number by number it cannot read as a vector at once, so that this takes about
as long as the accelerations of a small mechanism. Here what a sum gives stays in registers. Long equations have more
numbers than there are registers: their code is called, not written and compiled again. So it is where few operations do
not serve. Where no code does, the general inner loop finds the accelerations of a stage.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from twoloop.generate import llvm_code
from twoloop.generate.llvm_code import SLACK, Emitter
from twoloop.generate.llvm_text import BIT, Module, Value, integer
from twoloop.generate.series_groups import WIDTH
from twoloop.generate.straight_code import OwnCode, SharedCode
from twoloop.generate.written import TRUE, conditions_hold, results_of
from twoloop.kernels.compile.dependencies import digest_of
from twoloop.kernels.compile.own_functions import CALLED, LaterFunctions, own_functions

AT_ONCE = 16  # vectors that are summed in one loop, in registers


class StageCode:
    """Writes the code of a method for one mechanism.

    `scratch` holds, from an aligned place on, [q, v] at the beginning of the step and [v, a] of each stage.
    """

    def __init__(self, own: SharedCode, n_stages: int):
        self.equations, self.numbers, self.n_stages = own.equations, own.numbers, n_stages
        self.n = own.equations.system.n_q
        self.blocks = -(-2 * self.n // WIDTH)
        self.slopes = self.blocks * WIDTH
        self.calls = own.parts is not None

    def scratch_size(self) -> int:
        """Length of `scratch`."""
        return SLACK + self.blocks * WIDTH * (1 + self.n_stages)

    def begin(self, emit: Emitter, scratch: Value, state: Value) -> None:
        """Take over the state."""
        base, n = emit.aligned(scratch), self.n
        values = [emit.load(state, i) for i in range(3 * n)]
        self._store(emit, values[: 2 * n], base, 0)
        self._store(emit, values[n:], base, self.slopes)

    def put(self, emit: Emitter, scratch: Value, which: Value, place: Value) -> None:
        """Take over [q, v, a] of a stage, of which the code has not found a."""
        row = emit.pointer(emit.aligned(scratch), self.slopes, emit.builder.mul(which, integer(self.slopes)))
        self._store(emit, [emit.load(place, self.n + i) for i in range(2 * self.n)], row, 0)

    def finish(
        self,
        emit: Emitter,
        scratch: Value,
        b: Value,
        fine: Value,
        coarse: Value,
        h: Value,
        end: Value,
        estimates: Value,
    ) -> None:
        """[q, v] at the end, and the estimates of its error."""
        base, count = emit.aligned(scratch), integer(self.n_stages)
        for i, value in enumerate(self._sum(emit, base, h, b, count)):
            emit.store(value, end, i)
        for k, weights in enumerate((fine, coarse)):
            for i, value in enumerate(self._sum(emit, base, h, weights, count, from_start=False)):
                emit.store(value, estimates, 2 * self.n * k + i)

    def stage(
        self,
        emit: Emitter,
        scratch: Value,
        which: Value,
        weights: Value,
        t: Value,
        h: Value,
        place: Value,
        numbers: Value,
    ) -> Value:
        """Whether [v, a] of a stage were found; else its [q, v] are put at `place`, which has room for its a."""
        builder, base, n, emit.numbers = emit.builder, emit.aligned(scratch), self.n, numbers
        stage = self._sum(emit, base, h, weights, which)
        if self.calls:
            return self._stage_by_call(emit, scratch, which, stage, t, place)
        outputs = self.equations.accelerations[0]
        written, (a,) = results_of(emit, self.equations.graph, outputs, [t, *stage[: 2 * n]], self.numbers)
        with builder.if_else(conditions_hold(emit, written, outputs, a)) as (then, otherwise):
            with then:
                row = emit.pointer(base, self.slopes, builder.mul(which, integer(self.slopes)))
                self._store(emit, [*stage[n : 2 * n], *a], row, 0)
                found = TRUE, builder.block
            with otherwise:
                elsewhere = self._stage_by_call(emit, scratch, which, stage, t, place), builder.block
        holds = builder.phi(BIT)
        for value, block in (found, elsewhere):
            holds.add_incoming(value, block)
        return holds

    def _stage_by_call(
        self, emit: Emitter, scratch: Value, which: Value, stage: list[Value], t: Value, place: Value
    ) -> Value:
        for i in range(2 * self.n):
            emit.store(stage[i], place, i)
        parts = [emit.pointer(place, k * self.n) for k in range(3)]
        holds = emit.builder.call(CALLED + "own_there", BIT, [t, *parts[:2], emit.numbers, parts[2]])
        with emit.builder.if_then(holds):
            self.put(emit, scratch, which, place)
        return holds

    def _sum(
        self, emit: Emitter, base: Value, h: Value, weights: Value, count: Value, from_start: bool = True
    ) -> list[Value]:
        """[q, v] from a sum of slopes, the newest last, which are not there yet when the first are summed."""
        scale, found = emit.vector([h] * WIDTH), []
        for first in range(0, self.blocks, AT_ONCE):
            blocks = range(first, min(first + AT_ONCE, self.blocks))
            zeros = [emit.vector([llvm_code.ZERO] * WIDTH)] * len(blocks)
            with emit.loop(integer(0), count, zeros) as (k, totals, new):
                weight = emit.vector([emit.load(emit.pointer(weights, k))] * WIDTH)
                row = emit.pointer(base, self.slopes, emit.builder.mul(k, integer(self.slopes)))
                for block, total in zip(blocks, totals, strict=True):
                    new.append(emit.add(total, emit.multiply(weight, emit.load_vector(row, block * WIDTH, WIDTH))))
            found += [emit.multiply(scale, total) for total in new]
        if from_start:
            found = [emit.add(emit.load_vector(base, k * WIDTH, WIDTH), total) for k, total in enumerate(found)]
        return [value for vector in found for value in emit.elements(vector)][: 2 * self.n]

    def _store(self, emit: Emitter, values: list[Value], base: Value, place: int) -> None:
        values = [*values, *[llvm_code.ZERO] * (self.slopes - len(values))]
        for k in range(0, self.slopes, WIDTH):
            emit.store_vector(emit.vector(values[k : k + WIDTH]), base, place + k)


class CompiledStages(NamedTuple):
    """Functions for the stages of a method."""

    functions: LaterFunctions
    code: StageCode

    @property
    def memory_size(self) -> int:
        """Length of `memory`."""
        return 4 * self.code.n + self.code.scratch_size()


def compiled_stages(of_one: OwnCode, n_stages: int) -> CompiledStages:
    """The code for a mechanism and a method of so many stages; its machine code is kept on disk.

    It is compiled when steps are to call it: most runs that begin with a series do not come to that.
    """
    own = of_one.shared
    what = "stages", own.equations.choice, n_stages
    made: CompiledStages = own.family.remembered(what, lambda: _compiled(own, n_stages))
    return made


def _compiled(own: SharedCode, n_stages: int) -> CompiledStages:
    from twoloop.kernels.data.common import KIT

    key, code = f"{own.digest} {n_stages}", StageCode(own, n_stages)
    parts: dict[str, Callable[..., Any]] = {
        "begin_stages": code.begin,
        "find_stage": code.stage,
        "put_stage": code.put,
        "sum_stages": code.finish,
    }

    def write() -> tuple[list[str], str]:
        module = Module()
        for name, emit in parts.items():
            llvm_code.write(module, name, KIT.own_type(name), emit)
        return list(parts), str(module)

    return CompiledStages(LaterFunctions(lambda: own_functions("stages", _stamp(), key, write, own.functions)), code)


@cache
def _stamp() -> str:
    """A digest of what writes the functions; what they share with those of the equations is in the key."""
    return digest_of("", __file__)
