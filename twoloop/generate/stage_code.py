"""The stages of an explicit Runge-Kutta method as code compiled for one mechanism: sums and accelerations in one.

A step by the general code stores each stage, reads it back to find accelerations, stores these and reads them back for
the next sum. What a processor has stored number by number it cannot read as a vector at once, so that this takes about
as long as the accelerations of a small mechanism. Here what a sum gives stays in registers. Where the code does not
serve, the general inner loop finds the accelerations of a stage.
"""

import hashlib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from twoloop.generate import llvm_code, straight_code
from twoloop.generate.llvm_code import INTEGER, SLACK, Emitter, Value, emitted
from twoloop.generate.series_groups import WIDTH
from twoloop.generate.straight_code import OwnCode, conditions_hold, results_of
from twoloop.kernels.compile.caches import Newest, compile_kept, sources_folder
from twoloop.kernels.compile.callbacks import VECTOR, f8
from twoloop.kernels.compile.private import Dispatcher

Array = NDArray[np.float64]

AT_ONCE = 16  # vectors that are summed in one loop, in registers

i8 = types.int64


class StageCode:
    """Writes the code of a method for one mechanism.

    `scratch` holds, from an aligned place on, [q, v] at the beginning of the step and [v, a] of each stage.
    """

    def __init__(self, own: OwnCode, n_stages: int):
        self.equations, self.numbers, self.n_stages = own.equations, own.numbers, n_stages
        self.n = own.equations.system.n_q
        self.blocks = -(-2 * self.n // WIDTH)
        self.slopes = self.blocks * WIDTH

    def scratch_size(self) -> int:
        """Length of `scratch`."""
        return SLACK + self.blocks * WIDTH * (1 + self.n_stages)

    def begin(self, emit: Emitter, scratch: Value, state: Value) -> None:
        """Take over the state."""
        base, n = emit.aligned(scratch), self.n
        state = [emit.load(state, i) for i in range(3 * n)]
        self._store(emit, state[: 2 * n], base, 0)
        self._store(emit, state[n:], base, self.slopes)

    def put(self, emit: Emitter, scratch: Value, which: Value, place: Value) -> None:
        """Take over [q, v, a] of a stage, of which the code has not found a."""
        row = emit.pointer(emit.aligned(scratch), self.slopes, emit.builder.mul(which, INTEGER(self.slopes)))
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
        base, count = emit.aligned(scratch), INTEGER(self.n_stages)
        for i, value in enumerate(self._sum(emit, base, h, b, count)):
            emit.store(value, end, i)
        for k, weights in enumerate((fine, coarse)):
            for i, value in enumerate(self._sum(emit, base, h, weights, count, from_start=False)):
                emit.store(value, estimates, 2 * self.n * k + i)

    def stage(
        self, emit: Emitter, scratch: Value, which: Value, weights: Value, t: Value, h: Value, place: Value
    ) -> Value:
        """Whether [v, a] of a stage were found; else its [q, v] are put at `place`."""
        builder, base, n = emit.builder, emit.aligned(scratch), self.n
        stage = self._sum(emit, base, h, weights, which)
        outputs = self.equations.there
        written, (a,) = results_of(emit, self.equations.graph, outputs, [t, *stage[: 2 * n]], self.numbers)
        holds = conditions_hold(emit, written, outputs, a)
        with builder.if_else(holds) as (then, otherwise):
            with then:
                row = emit.pointer(base, self.slopes, builder.mul(which, INTEGER(self.slopes)))
                self._store(emit, [*stage[n : 2 * n], *a], row, 0)
            with otherwise:
                for i in range(2 * n):
                    emit.store(stage[i], place, i)
        return holds

    def _sum(
        self, emit: Emitter, base: Value, h: Value, weights: Value, count: Value, from_start: bool = True
    ) -> list[Value]:
        """[q, v] from a sum of slopes, the newest last, which are not there yet when the first are summed."""
        scale, found = emit.vector([h] * WIDTH), []
        for first in range(0, self.blocks, AT_ONCE):
            blocks = range(first, min(first + AT_ONCE, self.blocks))
            zeros = [emit.vector([llvm_code.ZERO] * WIDTH)] * len(blocks)
            with emit.loop(INTEGER(0), count, zeros) as (k, totals, new):
                weight = emit.vector([emit.load(emit.pointer(weights, k))] * WIDTH)
                row = emit.pointer(base, self.slopes, emit.builder.mul(k, INTEGER(self.slopes)))
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
    """Machine code for the stages of a method, to be called as a step is, and what wrote it."""

    function: Dispatcher
    code: StageCode

    @property
    def memory_size(self) -> int:
        """Length of `memory`."""
        return 4 * self.code.n + self.code.scratch_size()


_COMPILED = Newest()


def compiled_stages(own: OwnCode, n_stages: int) -> CompiledStages:
    """The code for a mechanism and a method of so many stages, compiled; its machine code is kept on disk."""
    key = f"{own.digest} {n_stages}"
    made: CompiledStages | None = _COMPILED.get(key)
    if made is None:
        code = StageCode(own, n_stages)
        _COMPILED[key] = made = CompiledStages(_compile(code, key), code)
    return made


def _compile(code: StageCode, key: str) -> Dispatcher:
    from twoloop.kernels.compile.linking import KernelCompiler
    from twoloop.kernels.data import common
    from twoloop.kernels.evaluation import calls
    from twoloop.kernels.steps import explicit_step as explicit

    n, s = code.n, code.n_stages
    begin = emitted(code.begin, types.none, scratch=VECTOR, state=VECTOR)
    known = {"t": f8, "h": f8, "place": VECTOR, "numbers": VECTOR}
    stage = emitted(code.stage, types.boolean, scratch=VECTOR, which=i8, weights=VECTOR, **known)
    put = emitted(code.put, types.none, scratch=VECTOR, which=i8, place=VECTOR)
    finish = emitted(
        code.finish,
        types.none,
        scratch=VECTOR,
        b=VECTOR,
        fine=VECTOR,
        coarse=VECTOR,
        h=f8,
        end=VECTOR,
        estimates=VECTOR,
    )
    tableau_of, largest_error = explicit.tableau_of, explicit.largest_error
    N_EVALUATIONS, N_FACTORIZATIONS, DONE = common.N_EVALUATIONS, common.N_FACTORIZATIONS, common.DONE
    ESTIMATE, EVALUATE_THERE, Attempt = common.ESTIMATE, calls.EVALUATE_THERE, common.Attempt

    def stages(f, w, options, memory, t, h, tolerances, state, new_state):  # type: ignore[no-untyped-def]
        estimates, scratch = memory[: 4 * n], memory[4 * n :]
        q, v, a = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n]
        _, A, b, c, fine, coarse = tableau_of(options)
        begin(scratch, state)
        for j in range(1, s):
            if stage(scratch, j, A[j], t + c[j] * h, h, new_state, f.numbers):
                w.counters[N_EVALUATIONS] += 1
                w.counters[N_FACTORIZATIONS] += 1
            else:
                code = f.general(f, w, EVALUATE_THERE, t + c[j] * h, q, v, 0.0, a, w.lam)
                if code != DONE:
                    return Attempt(code, np.inf, 0.0)
                put(scratch, j, new_state)
        finish(scratch, b, fine, coarse, h, new_state, estimates)
        if tolerances[ESTIMATE] == 0.0:
            return Attempt(DONE, 0.0, 0.0)
        error = largest_error(tolerances, state, new_state, estimates[: 2 * n], estimates[2 * n :])
        return Attempt(DONE, error, 0.0)

    options = {"folder": sources_folder(), "pipeline_class": KernelCompiler, **common.OPTIONS}
    return compile_kept(stages, common.ATTEMPT, (_stamp(), key), **options)


@cache
def _stamp() -> str:
    """A digest of what writes the code, and of the kernels that it calls."""
    from twoloop.kernels.data import common

    digest = hashlib.sha256((common.stamp("steps.explicit_step") + common.stamp("evaluation.calls")).encode())
    for module in (__file__, straight_code.__file__, llvm_code.__file__):
        digest.update(Path(str(module)).read_bytes())
    return digest.hexdigest()
