"""CasADi's IDAS, CVODES and collocation (J. Andersson et al.) on the expressions of a ConstrainedSystem.

The equations are the index-1 ODE from `equations.expressions`, with exact Jacobians by CasADi's derivatives: on the
four-bar, IDAS needs a quarter to a half less time for a given error than with the multipliers as algebraic unknowns,
and the stabilised index-2 form fails at tolerances below 1e-6. Constraints drift. With a C compiler `cc`, the
expressions are compiled, which halves the time (up to `LARGEST_COMPILED` coordinates); otherwise CasADi interprets
them. A failed run has no output, and the last line of CasADi's message. CasADi does not check the clock: a run that
took longer than the time limit counts as failed.
"""

import shutil
import tempfile
from contextlib import chdir
from functools import lru_cache, partial
from typing import Any

import numpy as np

from references.driver import ADVICE, Task, TimeLimit, adapter, imported, user_call
from references.equations.expressions import expressions_at, functions_of
from references.lines import Line
from twoloop.checks.arguments import check_choice, check_size
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result

METHODS: dict[str, dict[str, str]] = {  # settings for each method
    "IDAS": {},
    "BDF": {},
    "Adams": {"linear_multistep_method": "adams", "nonlinear_solver_iteration": "functional"},
}
STEPS_A_RUN = 10**7  # limit for IDAS and CVODES, as for SUNDIALS driven from C
FLAGS = ("-O3", "-march=native", "-ffast-math")  # compiler flags
LARGEST_COMPILED = 9  # coordinates; the compiler takes minutes for larger exact Jacobians
OUTPUTS = 1000  # limit for collocation, because CasADi splits its elements at every output
DEGREE = 5  # degree of the Gauss collocation, i.e. order 10
ROOT = {"abstol": 1e-12, "max_iter": 60}  # root finder without step control: looser settings fail


@adapter(derivatives=False)
def solve_sundials(
    task: Task, method: str = "IDAS", rtol: float = 1e-8, atol: float = 1e-8, *, most_steps: int = STEPS_A_RUN
) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with IDAS or CVODES of CasADi.

    `method` is "IDAS", or for CVODES "BDF" with Newton's iteration, CasADi's default, or "Adams" with fixed-point
    iteration, which SUNDIALS recommends for non-stiff problems. Other parameters, errors and result as in
    `references.driver`; a run ends after `most_steps` steps. Statistics: n_accepted and n_evaluations, of residuals or
    accelerations.
    """
    check_choice("method", method, tuple(METHODS))
    plugin = "IDAS" if method == "IDAS" else "CVODES"
    most_steps = check_size("most_steps", most_steps, 1)
    options: dict[str, Any] = {"reltol": rtol, "abstol": atol, "max_num_steps": most_steps, **METHODS[method]}
    options["show_eval_warnings"] = False  # thousands of lines; failures are reported anyway
    name = f"{plugin} of CasADi"
    return _run(task, plugin.lower(), name, np.array([task.t1]), task.instants, options)


@adapter(derivatives=False)
def solve_collocation(task: Task, n_steps: int = 500) -> Result:
    """Integrate a constrained mechanical system with CasADi's collocation in `n_steps` equal steps.

    Settings: Gauss points, which have a fifth to a twelfth of the error of CasADi's default, Radau points, with the
    same steps; the degree that is cheapest on the four-bar for errors below 1e-6.

    Parameters and errors as in `references.driver`, without t_eval: the result is at the ends of steps, at most
    `OUTPUTS` of them. Statistics: n_accepted.
    """
    n_steps = check_size("n_steps", n_steps, 1)
    parts = np.unique(np.linspace(0, n_steps, min(OUTPUTS, n_steps) + 1).astype(int))
    ends = task.t0 + (task.t1 - task.t0) * parts / n_steps
    options = {"interpolation_order": DEGREE, "number_of_finite_elements": n_steps, "collocation_scheme": "legendre"}
    return _run(task, "collocation", "CasADi's collocation", ends[1:], ends, options)


def _run(task: Task, plugin: str, name: str, timed_times: Array, times: Array, options: dict[str, Any]) -> Result:
    """Return the Result at `times`, with the CPU time of a run that stores at `timed`."""
    integrator_at = partial(_integrator, plugin, *task.key, tuple(options.items()))
    start, failure, states = task.y0, "", np.empty((2 * task.system.n_q, 0))
    counts = {"n_accepted": timed_times.size} if plugin == "collocation" else {}
    output_times = times[times > task.t0]
    try:
        integrator = integrator_at(timed_times.tobytes())
        limit = TimeLimit(task.time_limit)
        with user_call:
            states = np.array(integrator(x0=start)["xf"])
        if plugin != "collocation":
            stats = integrator.stats()
            counts = {"n_accepted": stats.get("nsteps"), "n_evaluations": stats.get("nfevals")}
        if limit.passed():
            failure = limit.message(name, task.t1, "take looser tolerances, or fewer steps")
        elif not np.array_equal(output_times, timed_times):
            states = np.array(integrator_at(output_times.tobytes())(x0=start)["xf"])
    except RuntimeError as error:  # the only indication of a failure
        lines = [line for line in str(error).splitlines() if line.strip()]
        failure = f"{name} failed: {lines[-1]}. {ADVICE}"
    if failure:
        times, states = times[:0], states[:, :0]
    elif output_times.size < times.size:
        states = np.column_stack([start, states])
    return task.result(name, times, states, failure, **counts)


@lru_cache(maxsize=256)
def _equations(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> dict[str, Any]:
    casadi, n = imported("casadi"), system.n_q
    expressions = expressions_at(system, t0, q0, v0)
    t, x = casadi.SX.sym("t"), casadi.SX.sym("x", 2 * n)
    q, v = ([x[first + i] for i in range(n)] for first in (0, n))
    return {"t": t, "x": x, "ode": casadi.vertcat(*v, *expressions.accelerations(functions_of(casadi), t, q, v))}


@lru_cache(maxsize=256)
def _integrator(
    plugin: str, system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes, options: tuple[Any, ...], times: bytes
) -> Any:
    """Return an integrator for these output times; compiled, if there is a compiler and it helps."""
    casadi, compiler = imported("casadi"), shutil.which("cc")
    arguments = ("motion", plugin, _equations(system, t0, q0, v0), t0, np.frombuffer(times).tolist())
    given = dict(options) | ({"rootfinder_options": ROOT} if plugin == "collocation" else {})
    if compiler is None or system.n_q > LARGEST_COMPILED:
        return casadi.integrator(*arguments, given)
    # CasADi always writes the generated code to the working folder; it is loaded on return
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        jit: dict[str, Any] = {"jit": True, "compiler": "shell", "jit_cleanup": False}
        jit["jit_options"] = {"flags": list(FLAGS), "cleanup": False}
        return casadi.integrator(*arguments, given | jit)


def _by_step(
    system: ConstrainedSystem, t_span: tuple[float, float], *start: Array, step: float, **options: Any
) -> Result:
    return solve_collocation(system, t_span, *start, round((t_span[1] - t_span[0]) / step), **options)  # type: ignore[no-any-return]


HOW: dict[str, Any] = {"keeps": False, "traces": True, "builds_each": True, "builds_span": True}
LINES = (
    Line("IDAS, CasADi", "casadi", "CasADi", solve_sundials, checked=True, **HOW),
    Line("CVODES, CasADi", "casadi", "CasADi", solve_sundials, {"method": "BDF"}, checked=True, **HOW),
    Line("collocation, CasADi", "casadi", "CasADi", _by_step, setting="h", stores_steps=True, **HOW),
    Line("CVODES, CasADi, Adams", "casadi", "CasADi", solve_sundials, {"method": "Adams"}, **HOW),
)
