"""IDAS, CVODES and collocation of CasADi (J. Andersson et al.) on a ConstrainedSystem, by its expressions.

The equations are those that `equations.expressions` makes of the callbacks, as the ODE of index 1: on the four-bar,
IDAS takes a quarter to a half less time for an error with it than with the multipliers as algebraic unknowns, and the
stabilised form of index 2 fails at tolerances below 1e-6. Constraints are not kept. The package is optional: `make
peers`, or the extra `peers`.

All are given exact Jacobians, by CasADi's derivatives, and accelerations eliminated symbolically; where there is a C
compiler `cc`, expressions compiled by it with `FLAGS`, which halves the time (up to `LARGEST_COMPILED` coordinates).
Else CasADi interprets them. A failure gives no output, and the last line of CasADi's text. CasADi does not look at the
clock, but lets exceptions of signals through: a run that took longer than the time limit is a failed one.
"""

import shutil
import subprocess
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

METHODS: dict[str, dict[str, str]] = {  # of CVODES, and how it is set up for each
    "BDF": {},
    "Adams": {"linear_multistep_method": "adams", "nonlinear_solver_iteration": "functional"},
}
STEPS_A_RUN = 10**7  # at most, of IDAS and CVODES, as of SUNDIALS driven from C
FLAGS = ("-O3", "-march=native", "-ffast-math")  # for the compiler, where it takes all of them
PLAIN = FLAGS[:1]
LARGEST_COMPILED = 9  # coordinates; the compiler takes minutes for the exact Jacobian of large ones
OUTPUTS = 1000  # of collocation, at most: CasADi divides its elements at every output
DEGREE = 5  # of the Gauss collocation, so of order 10
ROOT = {"abstol": 1e-12, "max_iter": 60}  # of its root finder, which has no control of the step: less fails


@adapter(derivatives=False)
def solve_idas(task: Task, rtol: float = 1e-8, atol: float = 1e-8, *, most_steps: int = STEPS_A_RUN) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with IDAS of CasADi.

    Parameters, errors and result are those of `references.driver`; a run ends after `most_steps` steps. Of the
    statistics: n_accepted and n_evaluations (the residuals).
    """
    return _by_sundials("idas", "IDAS of CasADi", task, rtol, atol, most_steps)


@adapter(derivatives=False)
def solve_cvodes(
    task: Task, rtol: float = 1e-8, atol: float = 1e-8, *, method: str = "BDF", most_steps: int = STEPS_A_RUN
) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with CVODES of CasADi.

    Its method is "BDF" with Newton's iteration, as CasADi sets CVODES up, of orders up to 5, or "Adams" with
    fixed-point iteration, as SUNDIALS advises where nothing is stiff, of orders up to 12. All else as `solve_idas`;
    n_evaluations are those of the accelerations.
    """
    check_choice("method", method, tuple(METHODS))
    return _by_sundials("cvodes", "CVODES of CasADi", task, rtol, atol, most_steps, **METHODS[method])


@adapter(derivatives=False)
def solve_collocation(task: Task, n_steps: int = 500) -> Result:
    """Integrate a constrained mechanical system with CasADi's collocation in `n_steps` equal steps.

    What it was given: Gauss's points, with which the same steps have a fifth to a twelfth of the error of CasADi's
    default, Radau's; the degree that is cheapest on the four-bar from 1e-6 down.

    Parameters and errors are those of `references.driver`, but for t_eval: the result is at the ends of the steps, of
    no more than `OUTPUTS` of them. Of the statistics: n_accepted.
    """
    n_steps = check_size("n_steps", n_steps, 1)
    parts = np.unique(np.linspace(0, n_steps, min(OUTPUTS, n_steps) + 1).astype(int))
    ends = task.t0 + (task.t1 - task.t0) * parts / n_steps
    options = {"interpolation_order": DEGREE, "number_of_finite_elements": n_steps, "collocation_scheme": "legendre"}
    return _solved(task, "collocation", "CasADi's collocation", ends[1:], ends, options)


def _by_sundials(plugin: str, name: str, task: Task, rtol: float, atol: float, most_steps: int, **more: str) -> Result:
    most_steps = check_size("most_steps", most_steps, 1)
    options: dict[str, Any] = {"reltol": rtol, "abstol": atol, "max_num_steps": most_steps, **more}
    options["show_eval_warnings"] = False  # of each step that is too long, thousands of lines; a failure is told
    return _solved(task, plugin, name, np.array([task.t1]), task.instants, options)


def _solved(task: Task, plugin: str, name: str, timed: Array, times: Array, options: dict[str, Any]) -> Result:
    """The Result at `times`, with the clock of a run that stores at `timed`."""
    made = partial(_integrator, plugin, *task.key, tuple(options.items()))
    start, failure, states = task.y0, "", np.empty((2 * task.system.n_q, 0))
    counts = {"n_accepted": timed.size} if plugin == "collocation" else {}
    after = times[times > task.t0]
    try:
        integrator = made(timed.tobytes())
        limit = TimeLimit(task.time_limit)
        with user_call:
            states = np.array(integrator(x0=start)["xf"])
        if plugin != "collocation":
            told = integrator.stats()
            counts = {"n_accepted": told.get("nsteps"), "n_evaluations": told.get("nfevals")}
        if limit.passed():
            failure = limit.message(name, task.t1, "take looser tolerances, or fewer steps")
        elif not np.array_equal(after, timed):
            states = np.array(made(after.tobytes())(x0=start)["xf"])
    except RuntimeError as error:  # the only sign of a failure; the run may have ended anywhere
        said = [line for line in str(error).splitlines() if line.strip()]
        failure = f"{name} failed: {said[-1]}. {ADVICE}"
    if failure:
        times, states = times[:0], states[:, :0]
    elif after.size < times.size:
        states = np.column_stack([start, states])
    return task.result(name, times, states, failure, **counts)


@lru_cache(maxsize=256)
def _equations(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> dict[str, Any]:
    casadi, n = imported("casadi"), system.n_q
    made = expressions_at(system, t0, q0, v0)
    t, x = casadi.SX.sym("t"), casadi.SX.sym("x", 2 * n)
    q, v = ([x[first + i] for i in range(n)] for first in (0, n))
    return {"t": t, "x": x, "ode": casadi.vertcat(*v, *made.accelerations(functions_of(casadi), t, q, v))}


@lru_cache(maxsize=256)
def _integrator(
    plugin: str, system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes, options: tuple[Any, ...], times: bytes
) -> Any:
    """What integrates to these times; compiled, where there is a compiler and that helps."""
    casadi, compiler = imported("casadi"), shutil.which("cc")
    arguments = ("motion", plugin, _equations(system, t0, q0, v0), t0, np.frombuffer(times).tolist())
    given = dict(options) | ({"rootfinder_options": ROOT} if plugin == "collocation" else {})
    if compiler is None or system.n_q > LARGEST_COMPILED:
        return casadi.integrator(*arguments, given)
    # CasADi writes for the compiler into the working folder, whatever it is told; it has loaded all when it returns
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        jit: dict[str, Any] = {"jit": True, "compiler": "shell", "jit_cleanup": False}
        jit["jit_options"] = {"flags": list(_flags(compiler)), "cleanup": False}
        return casadi.integrator(*arguments, given | jit)


@lru_cache(maxsize=1)
def _flags(compiler: str) -> tuple[str, ...]:
    """FLAGS where the compiler takes them, else the plain ones."""
    command = [compiler, *FLAGS, "-x", "c", "-fsyntax-only", "-"]
    taken = subprocess.run(command, input=b"int x;\n", capture_output=True).returncode == 0
    return FLAGS if taken else PLAIN


HOW: dict[str, Any] = {"keeps": False, "traces": True, "builds_each": True, "builds_span": True}
LINES = (
    Line("IDAS, CasADi", "casadi", "CasADi", solve_idas, checked=True, **HOW),
    Line("CVODES, CasADi", "casadi", "CasADi", solve_cvodes, checked=True, **HOW),
    Line("CVODES, CasADi, Adams", "casadi", "CasADi", solve_cvodes, {"method": "Adams"}, **HOW),
)
