"""Code for starts of many runs: constraints and their derivatives in lanes."""

import hashlib
from typing import Any

from twoloop.generate.coefficients import Coefficients
from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.lane_steps import LaneSteps, keep_fine
from twoloop.generate.llvm_text import Value
from twoloop.generate.straight_line import Outputs
from twoloop.generate.traced_equations import Equations
from twoloop.generate.written import conditions_hold, results_of
from twoloop.kernels.lanes import lane_room as lanes
from twoloop.problem.system import ConstrainedSystem


class LaneStarts(LaneSteps):
    """Writes C, C_t and C_q of a system whose numbers depend on parameters as `record` has it.

    Parameters
    ----------
    system : ConstrainedSystem
        Without nonholonomic rows.
    parameters : array of Known

    Raises
    ------
    Untraceable
        Saying why the constraints cannot be had.
    """

    tasks = lanes.TASKS_OF_STARTS

    def __init__(self, system: ConstrainedSystem, parameters: Any):
        super().__init__(system.n_q, system.n_c)
        equations, self.numbers = Equations(system, parameters), Coefficients(apart=True)
        kinds = ("constraint", "constraint_rate", "jacobian")
        self._graph = equations.graph
        self._rows = Outputs({kind: list(equations.of(kind).flat) for kind in kinds}, [])
        told = self._rows.sizes, *self.numbers.structure(self._graph, self._rows.forms)
        self.structure = hashlib.sha256(repr(told).encode()).hexdigest()
        self.n_numbers, self.n_quantities = self.numbers.n_varying, len(self._rows.quantities(self._graph))

    def rows(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """C, C_t and C_q at NEW and AHEAD, one after the other in the memory of the method; FINE: they have values."""
        at = self.places(emit, order, control, room)
        inputs = [emit.load(room, lanes.AHEAD), *(emit.load(at.new, i) for i in range(2 * self.n))]
        written, arrays = results_of(emit, self._graph, self._rows, inputs, self.numbers)
        values = [value for array in arrays for value in array]
        for k, value in enumerate(values):
            emit.store(value, at.series, k)
        keep_fine(emit, room, conditions_hold(emit, written, self._rows, values))
