"""Use one run for many systems that differ only in their parameters.

For each system, the arrays of numbers that depend on parameters are filled anew. Then choices that depend on these
numbers, such as pivots, are checked again. Callbacks are compared with their traces (recorded operations): near the
start, and after the run at states or parameters outside the region of earlier comparisons.
"""

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.derivatives import check_derivatives
from twoloop.checks.structure import has_definite_mass, is_definite
from twoloop.generate.compile_equations import GeneratedCode
from twoloop.generate.derived_callbacks import exact_derivatives, has_exact_derivatives
from twoloop.generate.trace import ParameterArrays, runs_on_symbols, share_checked_bounds, trace_cache_of
from twoloop.generate.traced_values import CheckedRegion, accept_traces, refuse_wrong_traces
from twoloop.kernels.data.common import Kit
from twoloop.kernels.data.indices import AUGMENTED, BANDWIDTH, DIAGONAL_MASS, FORM
from twoloop.methods.plan import Method, Plan
from twoloop.methods.presets import Compiled, code_for, plans_for
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.run import Run
from twoloop.run.workspace import is_diagonal, kit_for_plan

Array = NDArray[np.float64]

NUMBER_FIELDS = ("options", "numbers", "own_numbers")  # fields of a `Plan` whose arrays may depend on parameters
PLAN_FIELDS = ("interior", "substitute", "within_newton")  # fields of a `Plan` whose values are plans, too


class SharedSetup:
    """Setup shared by the runs of systems that differ only in their parameters.

    `run`: run of one of the systems, at its start; copies of this run are integrated. `code`: the generated code that
    the run calls; it was generated for `method`, `fixed` (whether the step size is constant) and `compiled`. Raise
    ValueError if setup cannot be shared: the system is large, a callback may branch on its parameters, or a number in
    the plan cannot be computed from the parameters by the expressions that traces contain.
    """

    def __init__(self, run: Run, code: GeneratedCode | None, method: Method, fixed: bool, compiled: Compiled):
        system, t, q = run.system, run.t0, run.state[: run.system.n_q]
        self.trace_cache, self._regions = trace_cache_of(system), dict[bool, CheckedRegion]()
        form, banded = run.kit.flags[FORM], run.kit.flags[BANDWIDTH] >= 0
        if run.fixed_order is not None or form == AUGMENTED or banded or system.entries:
            raise ValueError("for large systems, more choices depend on the numbers")
        symbolic = copy.copy(system)  # a system whose numbers are expressions in the parameters
        cache = self.trace_cache
        symbolic.derived = {("trace cache", trace_cache_of): cache, ("numbers", cache): lambda array: array}
        symbolic_code = code_for(symbolic, method, fixed, compiled, t, q, accept_traces)
        self.plan, self.interior_plans = plans_for(
            symbolic, method, run.rtol, run.least_atol, fixed, symbolic_code, accept_traces
        )
        self.exact_derivatives = exact_derivatives(symbolic)
        self.has_definite_mass = has_definite_mass(system, t, q)
        untraced_kinds = system.given.keys() - cache.traced_kinds
        cache.traced_kinds |= {kind for kind in untraced_kinds if runs_on_symbols(system, kind, cache.parameters)}
        share_checked_bounds(system)
        if not cache.within_bounds >= system.given.keys():
            raise ValueError("a callback may branch on its parameters")
        evaluated_run = ParametricRun(self, run.copy()).run
        if (code is None) is not (symbolic_code is None) or _values_of_plans(evaluated_run) != _values_of_plans(run):
            raise ValueError("its numbers differ from the values of the traced expressions")

    def region(self, with_derivatives: bool) -> CheckedRegion:
        """Return the region of states where callbacks (if `with_derivatives`, also derivatives) agreed with traces."""
        return self._regions.setdefault(with_derivatives, CheckedRegion())


class ParametricRun:
    """Run that integrates systems which differ only in parameters, one after another, see `use_parameters_of`.

    `run`: copy of the run in `shared`, at its start. `current_system`: system whose parameters the arrays of `run`
    contain now. `system`: a copy of `current_system` that uses these arrays, and has a cache of its own.
    """

    def __init__(self, shared: SharedSetup, run: Run):
        self.shared, self.run, self._expression_arrays = shared, run, ParameterArrays()
        functions, array, exact = run.system.functions, self._expression_arrays.array, shared.exact_derivatives
        self._functions = functions._replace(p=functions.p.copy(), flags=functions.flags.copy())
        run.plan = self._replace_arrays(shared.plan).fresh()
        run.interior_plans = {kind: self._replace_arrays(each) for kind, each in shared.interior_plans.items()}
        run.traced, run.varied_parameters = run.plan.traced, self._functions.p
        self._initial_cache: dict[Any, Any] = {
            ("trace cache", trace_cache_of): shared.trace_cache,
            ("derivatives", trace_cache_of): None if exact is None else exact.replace_coefficients(array),
            ("kit", id(self._functions)): Kit(self._functions),
            "kits": {},
        }
        self._fill_arrays(run.system)
        run.kit = kit_for_plan(self.system, run.kit.flags, run.plan)

    def use_parameters_of(self, system: ConstrainedSystem) -> bool:
        """Write the parameters of a system to the run's arrays; return False if these arrays contain them already."""
        if system is self.current_system:
            return False
        self._fill_arrays(system)
        return True

    def _fill_arrays(self, system: ConstrainedSystem) -> None:
        """Write a system's parameters, and the values of all expressions in these parameters, to the run's arrays."""
        self.current_system = system
        self._functions.p[:] = system.functions.p
        self._expression_arrays.write(self.shared.trace_cache.product_evaluator(self._functions.p))
        self.system = self.run.system = copy.copy(system)
        self.system.functions, self.system.derived = self._functions, self._initial_cache.copy()
        self.system.within_bounds.update(self.shared.trace_cache.within_bounds)
        self.system.checked, self._mass_agrees = False, not system.constant_mass
        self.system.bandwidth = None  # parametric runs do not use banded storage
        for traced in self.run.traced:
            traced.is_trusted = False

    def callbacks_agree(self, t0: float, q: Array, v: Array, t1: float, mass: Array, with_derivatives: bool) -> bool:
        """Return whether callbacks agree with traces near the start, and M has the structure that `shared` requires.

        The structure of M (`mass`: M at the start) is whether M is definite, and whether M is diagonal.
        """
        run, system = self.run, self.system
        if not self._mass_agrees:
            system.remember_at("definite mass", None, is_definite(mass))
            mass_structure = self.shared.has_definite_mass, bool(run.kit.flags[DIAGONAL_MASS])
            self._mass_agrees = mass_structure == (has_definite_mass(system, t0, q), is_diagonal(mass))
        try:
            if with_derivatives:
                check_derivatives(system, t0, q, lambda: has_exact_derivatives(system, t0, q, v))
            refuse_wrong_traces(run.traced, system, t0, t1, q, v)
        except Exception:  # for example an exception of a callback, which `set_up` will report
            return False
        return self._mass_agrees

    def _replace_arrays(self, plan: Plan) -> Plan:
        """Return a copy of a plan in which numbers, for the current parameters, replace expressions."""
        array, values = self._expression_arrays.array, vars(plan)
        changes: dict[str, Any] = {name: array(values[name]) for name in NUMBER_FIELDS if values[name] is not None}
        changes |= {name: self._replace_arrays(values[name]) for name in PLAN_FIELDS if values[name] is not None}
        return plan.changed(traced=tuple(each.replace_coefficients(array) for each in plan.traced), **changes)


def _values_of_plans(run: Run) -> list[Any]:
    """Return a list of all values in the plans of a run, with arrays as bytes, to compare plans exactly."""
    plans = [run.plan, *run.interior_plans.values()]
    return [run.kit.flags.tobytes(), *(each for plan in plans for each in _values_of_plan(plan))]


def _values_of_plan(plan: Plan) -> Iterator[Any]:
    """Yield the values of a plan and of the plans in it, for comparison with another plan."""
    for name, value in vars(plan).items():
        if isinstance(value, Plan):
            yield from _values_of_plan(value)
        elif name == "traced":
            yield [part.tobytes() for each in value for part in each.program[:-1]]
        elif name != "stable_to":  # `stable_to` is a lambda, which differs even between equal plans
            yield value.tobytes() if isinstance(value, np.ndarray) else value
