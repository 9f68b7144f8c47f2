"""Lobatto16: implicit Runge-Kutta steps by fixed-point iteration, all stages at once."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from twoloop.generate.collocation_code import compiled_collocation, compiles_quickly, tables
from twoloop.generate.compile_equations import GeneratedCode
from twoloop.generate.time_dependence import forces_may_be_steep
from twoloop.generate.traced_values import Check, accept_traces
from twoloop.kernels.data.collocation import ORDER
from twoloop.methods.dop853 import DOP853
from twoloop.methods.plan import LARGEST_MOVE, Plan
from twoloop.problem.system import ConstrainedSystem

PARTS = 6  # for the solution between its ends, a step is computed again as this number of steps
# largest distance between neighbouring nodes, relative to the step
LONGEST_GAP = float(np.diff([0.0, *tables().nodes]).max())


@dataclass(frozen=True)
class Lobatto16:
    """Implicit steps of order 16 by collocation at nine Lobatto nodes, whose stages are found by fixed-point iteration.

    The method is the outer loop of the paper's procedure with another tableau, and for all coordinates. It needs no
    Jacobian; the polynomial of the previous step predicts the stages. Generated code evaluates the eight unknown stages
    at once, one in each SIMD lane; a step takes four to eight such sweeps. Accepted states are on the constraints.

    It is for smooth motion that is not stiff. If the iteration converges too slowly, as in stiff motion, the run
    continues with "DOP853". At tolerances below 1e-8, it also does so after a singular position; collocation with
    projected stages crosses the position itself.

    Raises
    ------
    ValueError
        Raised by `solve_dae` if no code can be generated: callbacks branch on t, q or v, or are too long.

    Notes
    -----
    Nodes: Lobatto IIIA (Hairer and Wanner, Solving ODEs II (1996), IV.5). The method is symmetric. Fixed-point
    iteration with all stages in the lanes of a vector, for ordinary differential equations at high precision: M.
    Antonana, J. Makazaga and A. Murua, arXiv 2511.03655.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method="Lobatto16")
    >>> result.success
    True
    """

    takes_code: ClassVar[bool] = True
    needs_code: ClassVar[bool] = True
    name: ClassVar[str] = "Lobatto16"
    code: GeneratedCode | None = None  # generated for one system; solve_dae sets it
    narrow: bool = True  # whether forces may change much over a distance shorter than a step

    def for_system(
        self, system: ConstrainedSystem, code: GeneratedCode | None = None, check: Check = accept_traces
    ) -> "Lobatto16":
        """Return the method with the generated code of this system; raise ValueError if code is missing or too long."""
        if code is None or not compiles_quickly(code.shared):
            raise ValueError(
                f"method='Lobatto16' needs code made for {system.name!r}, whose equations are too long. "
                "Take method='auto'"
            )
        return replace(self, code=code, narrow=forces_may_be_steep(system, force_was_traced=True))

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the Plan of a run of n_q coordinates: step, options, memory and step-size control."""
        from twoloop.kernels.steps import lobatto_step as kernels

        if self.code is None:
            raise ValueError("Lobatto16() knows no system yet: take for_system(system, code), as solve_dae does")
        collocation = compiled_collocation(self.code)
        options = np.zeros(kernels.N_OPTIONS)
        options[kernels.THETA] = LARGEST_MOVE
        options[kernels.N_ITERATED], options[kernels.N_ROWS] = (
            len(collocation.code.iterated_coordinates),
            collocation.code.n_rows,
        )
        options[kernels.MAY_REPEAT] = float(collocation.code.split_functions is None or collocation.code.has_reduced)
        options[kernels.FREE] = 1.0 if self.narrow else 1.0 / LONGEST_GAP
        sizes = n_q, len(collocation.code.iterated_coordinates), collocation.code.n_rows
        plan = Plan(
            kernels.LOBATTO,
            options,
            np.zeros(kernels.memory_size(*sizes)),
            exponent=1.0 / ORDER,
            checks_within=True,
            projects=True,
            evaluates_within=True,
            max_gap=LONGEST_GAP,
            parts=PARTS,
            separate=True,
            own=(collocation.functions,),
            own_numbers=collocation.numbers,
        )
        plan = plan.changed(interior=plan.changed(memory=plan.memory.copy()))
        if fixed:
            return plan
        return plan.changed(substitute=DOP853().plan(n_q, rtol, atol, False))
