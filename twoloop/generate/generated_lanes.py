"""Machine code of one mechanism for SIMD lanes, kept on disk by the structure of its equations, and its numbers."""

from functools import cache, cached_property
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from twoloop.generate import (
    coefficients,
    compile_equations,
    elimination,
    lane_code,
    lane_constraints,
    lane_emitter,
    lane_series,
    lane_stages,
    lane_steps,
    lane_turns,
    llvm_code,
    llvm_text,
    lowering,
    null_space,
    series,
    symbolic_factors,
)
from twoloop.generate.lane_code import LaneCode
from twoloop.generate.lane_constraints import LaneConstraints
from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.llvm_text import Module
from twoloop.generate.parameter_expressions import ParameterTape
from twoloop.kernels.compile.dependencies import digest_of
from twoloop.kernels.compile.generated_functions import GeneratedFunctions, are_cached, generated_functions
from twoloop.kernels.lanes.lane_room import CODE

Array = NDArray[np.float64]

BUILD_SECONDS = 3e-4  # for a quantity, about
LANE_WRITERS = (lane_code, lane_constraints, lane_steps, lane_series, lane_stages, lane_turns, lane_emitter)
ELIMINATION = (elimination, symbolic_factors, null_space, compile_equations)
WRITERS = (series, *ELIMINATION, coefficients, lowering, *LANE_WRITERS, llvm_code, llvm_text)

Code = TypeVar("Code", LaneCode, LaneConstraints)
KIND = "lanes"  # of files on the disk


class GeneratedLanes(Generic[Code]):
    """Machine code of a mechanism for lanes, and the numbers that it reads for any parameters.

    Parameters
    ----------
    record : ParameterTape
        Of the parameters that `code` was made for.
    code : LaneCode or LaneConstraints
    """

    def __init__(self, record: ParameterTape, code: Code):
        self.record = record
        self.code: Code = code

    @cached_property
    def functions(self) -> GeneratedFunctions:
        """The code, compiled when it is first asked for."""
        return generated_functions(KIND, _stamp(), self.code.structure, self._write)

    def _write(self) -> tuple[list[str], str]:
        module = Module()
        for name in self.code.tasks:
            llvm_code.write(module, name, CODE.llvm_type(name), getattr(self.code, name), LaneEmitter)
        return list(self.code.tasks), str(module)

    @property
    def seconds_to_build(self) -> float:
        """About what the code takes to compile, s; 0 where it is there or on the disk."""
        if are_cached(KIND, _stamp(), self.code.structure):
            return 0.0
        return BUILD_SECONDS * self.code.n_quantities

    def numbers(self, parameters: Array) -> Array:
        """What the code reads for parameters (n_runs, n_p)."""
        return self.code.numbers.for_parameters(self.record, parameters)


@cache
def _stamp() -> str:
    """A digest of what writes the code, and of the kernels that it goes with."""
    from twoloop.kernels.data import common

    kernels = ("lanes.lane_room", "lanes.lane_projection", "lanes.lane_taylor", "control.defect", "control.predictor")
    return digest_of("".join(map(common.stamp, kernels)), __file__, *WRITERS)
