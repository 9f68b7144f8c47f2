"""Machine code of one mechanism for lanes, kept on disk by the structure of its equations, and the numbers it reads."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from twoloop.generate import (
    coefficients,
    lane_code,
    lane_emitter,
    lane_series,
    llvm_code,
    llvm_trigonometry,
    series,
    straight_code,
    straight_line,
)
from twoloop.generate.known_numbers import Record
from twoloop.generate.lane_code import LaneCode
from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.llvm_code import emitted
from twoloop.generate.straight_line import Choice
from twoloop.generate.tracing import Untraceable
from twoloop.kernels.compile.caches import Newest, compile_kept, is_kept, sources_folder
from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.compile.private import Dispatcher
from twoloop.kernels.lanes import (
    CLOSER,
    EVALUATE,
    JUDGE,
    LENGTHS,
    NEARER,
    OWN_LANES,
    REDUNDANT,
    SERIES,
    TAKE,
    THERE,
)
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

BUILD_SECONDS = 1e-3  # for a quantity, about
LANE_WRITERS = (lane_code, lane_series, lane_emitter)
WRITERS = (series, straight_line, straight_code, coefficients, *LANE_WRITERS, llvm_code, llvm_trigonometry)

i8 = types.int64

_COMPILED = Newest()


class OwnLanes:
    """Machine code of a mechanism for lanes, and the numbers that it reads for any parameters.

    Parameters
    ----------
    system : ConstrainedSystem
    choice : Choice
    values, varying
        Of a `Record`: generic parameters, and which of them differ from run to run.

    Raises
    ------
    Untraceable
        Saying why the equations cannot be had.
    """

    def __init__(self, system: ConstrainedSystem, choice: Choice, values: Array, varying: Sequence[int]):
        if system.n_a > 0:
            raise Untraceable("it has nonholonomic rows")
        self.record = Record(values.tolist(), varying)
        self.code = LaneCode(system, choice, self.record.parameters)
        self._function: Dispatcher | None = _COMPILED.get(self.code.structure)

    @property
    def function(self) -> Dispatcher:
        """The code, compiled when it is first asked for."""
        if self._function is None:
            self._function = _COMPILED[self.code.structure] = compile_kept(*_source(self.code), **_options())
        return self._function

    @property
    def seconds_to_build(self) -> float:
        """About what the code takes to compile, s; 0 where it is there or on the disk."""
        if self._function is not None or is_kept(*_source(self.code), **_options()):
            return 0.0
        return BUILD_SECONDS * self.code.n_quantities

    def numbers(self, parameters: Array) -> Array:
        """What the code reads for parameters (n_runs, n_p)."""
        return self.code.numbers.for_parameters(self.record, parameters)


def _source(code: LaneCode) -> tuple[Any, ...]:
    """What `compile_kept` takes."""
    tasks = (
        code.series,
        code.lengths,
        code.evaluate,
        code.closer,
        code.nearer,
        code.there,
        code.redundant,
        code.judge,
        code.take,
    )
    given: dict[str, Any] = {"order": i8, "control": VECTOR, "room": VECTOR}
    series_, lengths, evaluate, closer, nearer, there, redundant, judge, take = (
        emitted(task, types.none, emitter=LaneEmitter, **given) for task in tasks
    )

    def own(task, order, control, room):  # type: ignore[no-untyped-def]
        if task == SERIES:
            series_(order, control, room)
        elif task == LENGTHS:
            lengths(order, control, room)
        elif task == EVALUATE:
            evaluate(order, control, room)
        elif task == CLOSER:
            closer(order, control, room)
        elif task == NEARER:
            nearer(order, control, room)
        elif task == THERE:
            there(order, control, room)
        elif task == REDUNDANT:
            redundant(order, control, room)
        elif task == JUDGE:
            judge(order, control, room)
        elif task == TAKE:
            take(order, control, room)

    return own, OWN_LANES, (_stamp(), code.structure)


def _options() -> dict[str, Any]:
    from twoloop.kernels.compile.linking import KernelCompiler
    from twoloop.kernels.data import common

    return {"folder": sources_folder(), "pipeline_class": KernelCompiler, **common.OPTIONS}


def _stamp() -> str:
    """A digest of what writes the code, and of the kernels that it goes with."""
    from twoloop.kernels.data import common

    kernels = ("lanes", "control.defect", "control.predictor")
    digest = hashlib.sha256("".join(map(common.stamp, kernels)).encode())
    for path in (__file__, *(str(module.__file__) for module in WRITERS)):
        digest.update(Path(path).read_bytes())
    return digest.hexdigest()
