"""Machine code for the equations of one mechanism: the tasks of the inner loop that explicit methods call.

The operations of `straight_line` become LLVM's instructions one by one, past numba, which would take seconds for some
hundred of them. The code is kept on disk as that of the kernels.
"""

import hashlib
from collections.abc import Iterable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.generate import (
    accelerations,
    coefficients,
    llvm_code,
    llvm_text,
    llvm_trigonometry,
    null_space,
    parts_code,
    straight_line,
    symbolic_factors,
    written,
)
from twoloop.generate.accelerations import write_own_accelerations
from twoloop.generate.choices import Choice
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.families import Evaluator, Family, of_family
from twoloop.generate.llvm_code import Emitter
from twoloop.generate.llvm_text import Module, Value
from twoloop.generate.parts_code import LONG, LONG_OF_ALL, PartsCode
from twoloop.generate.straight_line import Outputs, StraightLine
from twoloop.generate.traced_values import Check, Traced, unchecked
from twoloop.generate.tracing import Graph, Untraceable
from twoloop.generate.written import Written, conditions_hold
from twoloop.kernels.compile.dependencies import digest_of
from twoloop.kernels.compile.generated_functions import own_functions
from twoloop.problem.system import ConstrainedSystem

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
        written = Written(emit, numbers)
        written.take(graph, given)
        results = written.results(graph, outputs)
        holds = conditions_hold(emit, written, outputs, results[0])
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
    equations : StraightLine
    family : Family

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

    def __init__(self, equations: StraightLine, family: Family):
        self.equations, self.family, self.numbers, self.parts = equations, family, Coefficients(), None
        if equations.n_operations > (LONG_OF_ALL if equations.quick is None else LONG):
            self.parts = PartsCode(equations, self.numbers)
        self.outputs = self._outputs()
        structure = repr(list(self._described()))
        self.digest = hashlib.sha256((structure + _stamp()).encode()).hexdigest()
        # LLVM finds nothing that makes equations faster, and takes up to a quarter of a build to look for it
        self.functions = own_functions("equations", _stamp(), self.digest, self._write, passes=False)

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "OwnCode":
        """The code, and what it reads for one of the systems."""
        return OwnCode(self, evaluate(self.numbers.formulas), self.equations.traced.of(system, evaluate), evaluate)

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
            write_own_accelerations(module, "own_there", KIT.own_type("own_there"), equations, self.numbers)
            parts.append("own_there")
        return [*self.outputs, *parts], str(module)


class OwnCode(NamedTuple):
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


def own_code(system: ConstrainedSystem, t0: float, q0: Array, check: Check = unchecked) -> OwnCode:
    """The code for a system, for a run that starts at a position; `check` raises where the callbacks are not in it.

    Raises
    ------
    ValueError
        If its equations cannot be had.
    """
    try:
        choice = system.remembered_at("choice", (t0, q0.tobytes()), lambda: Choice.at(system, t0, q0))

        def make(family: Family) -> SharedCode:
            return SharedCode(StraightLine(system, choice, family.equations(system)), family)

        made: OwnCode = of_family(system, ("code", choice), make, lambda code: check(code.traced))
    except Untraceable as error:
        raise ValueError(f"compiled=True needs equations that can be written down; {error}. Leave it out") from error
    return made


@cache
def _stamp() -> str:
    """A digest of what writes the functions, and of what they are called as."""
    from twoloop.kernels.data.common import KIT

    elimination = (straight_line, symbolic_factors, null_space, accelerations, parts_code)
    writers = (*elimination, coefficients, llvm_code, llvm_text, llvm_trigonometry, written)
    return digest_of(repr(KIT), __file__, *writers)
