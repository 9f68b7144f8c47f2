"""The series of one mechanism compiled: its machine code is kept on disk as that of the kernels."""

import hashlib
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from twoloop.generate import llvm_code, loop_tables, series_code, series_groups, series_loops
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_text import Module
from twoloop.generate.series import series_program
from twoloop.generate.series_code import SeriesCode
from twoloop.generate.series_loops import SeriesLoops
from twoloop.generate.straight_code import OwnCode, SharedCode, write_own
from twoloop.kernels.compile.dependencies import digest_of
from twoloop.kernels.compile.own_functions import OwnFunctions, own_functions

LONG = 300  # operations of a series from which on they are loops over tables: of fewer the loops take a tenth more time


class CompiledSeries(NamedTuple):
    """Functions of a program and of the solution of an order."""

    functions: OwnFunctions
    code: SeriesCode | SeriesLoops
    n_factors: int  # numbers that are kept
    numbers: Any  # what they read, or formulas for it

    def memory_size(self, order: int) -> int:
        """Length of `memory` for series of this order."""
        from twoloop.kernels.steps.recurrences import N_MEMORY_SCALARS

        n, n_rows = self.code.n, self.code.n_rows
        series = 2 * (order + 1) * n
        return N_MEMORY_SCALARS + series + 2 * (n + n_rows) + self.n_factors + self.code.scratch_size(order) + n


def compiled_series(code: OwnCode) -> CompiledSeries:
    """The code of a system's program, and of the solution of an order, compiled; its machine code is kept on disk.

    Raises
    ------
    ValueError
        If it would take too long to compile.
    """
    own = code.shared
    made: CompiledSeries = own.family.remembered(("series", own.equations.choice), lambda: _compiled(own))
    return made._replace(numbers=code.evaluate(made.numbers))


def _compiled(own: SharedCode) -> CompiledSeries:
    from twoloop.kernels.data.common import KIT

    system, family = own.equations.system, own.family
    program = family.remembered("series", lambda: series_program(system, family.equations(system)))
    numbers = Coefficients()
    in_loops = program.n_operations > LONG
    code = (SeriesLoops if in_loops else SeriesCode)(program, numbers)
    structure = [own.digest, code.structure]
    key = hashlib.sha256(repr(structure).encode()).hexdigest()

    def write() -> tuple[list[str], str]:
        module, names = Module(divided=not in_loops), []
        if own.parts is None:
            names += ["own_solution", "own_factors"]
            write_own(module, "own_solution", own.solution.graph, own.solution.solved, own.numbers)
            write_own(module, "own_factors", own.equations.graph, own.solution.kept, own.numbers)
        recurrences: dict[str, Callable[..., Any]] = {
            "begin_series": code.begin,
            "find_order": code.find_order,
            "take_order": code.take_order,
        }
        code.write_parts(module)
        for name, emit in recurrences.items():
            llvm_code.write(module, name, KIT.own_type(name), emit)
        return [*names, *recurrences], str(module)

    functions = own_functions("series", _stamp(), key, write, passes=not in_loops)
    return CompiledSeries(functions, code, own.solution.n_kept, numbers.formulas)


@cache
def _stamp() -> str:
    """A digest of what writes the functions; what they share with those of the equations is in the key."""
    return digest_of("", __file__, loop_tables, series_code, series_groups, series_loops)
