"""Accelerations as code, for numbers or in lanes."""

from collections.abc import Sequence

from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_code import Emitter
from twoloop.generate.llvm_text import Value
from twoloop.generate.straight_line import StraightLine
from twoloop.generate.written import conditions_hold, results_of


def write_accelerations(
    emit: Emitter, equations: StraightLine, inputs: Sequence[Value], numbers: Coefficients
) -> tuple[list[Value], Value]:
    """Write the accelerations at [t, q, v], and whether they may be used.

    What follows goes on in the block in which the builder is then.
    """
    outputs = equations.there
    written, (a,) = results_of(emit, equations.graph, outputs, inputs, numbers)
    return a, conditions_hold(emit, written, outputs, a)
