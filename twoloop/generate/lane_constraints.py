"""Constraints and their derivatives in lanes, as code: for starts of many runs."""

import hashlib
from itertools import chain
from typing import Any

import numpy as np

from twoloop.generate.coefficients import Coefficients
from twoloop.generate.graph import is_zero
from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.lane_steps import LaneSteps, keep_fine
from twoloop.generate.llvm_text import Value
from twoloop.generate.lowering import lower
from twoloop.generate.program import Program
from twoloop.generate.trace import Equations
from twoloop.kernels.lanes import lane_room as lanes
from twoloop.problem.system import ConstrainedSystem


class LaneConstraints(LaneSteps):
    """Writes C, C_t and the entries of C_q of a system, whose numbers depend on parameters.

    Parameters
    ----------
    system : ConstrainedSystem
        Without nonholonomic rows.
    parameters : array of Parameter

    Attributes
    ----------
    pattern : ndarray of int
        Where in it the columns of the entries of each row begin, and end, and these columns.

    Raises
    ------
    Untraceable
        Saying why the constraints cannot be had.
    """

    tasks = lanes.TASKS_OF_STARTS

    def __init__(self, system: ConstrainedSystem, parameters: Any):
        super().__init__(system.n_q, system.n_c)
        equations, self.numbers = Equations(system, parameters), Coefficients(apart=True)
        G, self._graph = equations.of("jacobian"), equations.graph
        columns = [[j for j, entry in enumerate(row) if not is_zero(entry)] for row in G]
        begins = np.cumsum([len(columns) + 1, *map(len, columns)])
        self.pattern = np.array([*begins, *chain(*columns)], dtype=np.int64)
        entries = [G[i, j] for i, row in enumerate(columns) for j in row]
        values = {kind: list(equations.of(kind)) for kind in ("constraint", "constraint_rate")}
        self._rows = Program(self._graph, {**values, "entries": entries})
        told = self.n, self.pattern.tolist(), *self.numbers.structure(self._rows)
        self.structure = hashlib.sha256(repr(told).encode()).hexdigest()
        self.n_numbers, self.n_quantities = self.numbers.n_varying, len(self._rows.quantities())

    def rows(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """C, C_t and entries of C_q at NEW and AHEAD, in the memory of the method; FINE: they have values."""
        at = self.places(emit, order, control, room)
        inputs = [emit.load(room, lanes.AHEAD), *(emit.load(at.new, i) for i in range(2 * self.n))]
        written, arrays = lower(emit, self._rows, inputs, self.numbers)
        values = [value for array in arrays for value in array]
        for k, value in enumerate(values):
            emit.store(value, at.series, k)
        keep_fine(emit, room, written.holds(self._rows, values))
