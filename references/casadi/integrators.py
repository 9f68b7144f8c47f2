"""IDAS, CVODES and collocation of CasADi (J. Andersson et al.) on a ConstrainedSystem, by its expressions.

The equations are those that `equations.expressions` makes of the callbacks, as the ODE of index 1: on the four-bar,
IDAS takes a quarter to a half less time for an error with it than with the multipliers as algebraic unknowns, and the
stabilised form of index 2 fails at tolerances below 1e-6. Constraints are not kept. The package is optional: `make
peers`, or the extra `peers`.
"""

import shutil
import subprocess
import tempfile
from contextlib import chdir
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from references.driver import ADVICE, Task, TimeLimit, check_choice, check_task, imported, user_call
from references.equations.expressions import expressions_at, functions_of
from references.equations.ode import ode_result
from twoloop.checks.arguments import check_size
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics

Array = NDArray[np.float64]

PLUGINS = {"idas": "IDAS of CasADi", "cvodes": "CVODES of CasADi", "collocation": "CasADi's collocation"}
SUNDIALS = ("idas", "cvodes")
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


def solve_idas(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
    most_steps: int = STEPS_A_RUN,
) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with IDAS of CasADi.

    What it was given: exact Jacobians, by CasADi's derivatives; accelerations eliminated symbolically; where there is a
    C compiler `cc`, expressions compiled by it with `FLAGS`, which halves the time (up to `LARGEST_COMPILED`
    coordinates). Else CasADi interprets them.

    Parameters
    ----------
    system, t_span, q0, v0, rtol, atol, t_eval : see `references.driver`
    time_limit : float, optional
        See `references.driver`. CasADi does not look at the clock, but lets exceptions of signals through: a run ends
        after `most_steps` steps, and one that took longer is a failed one.
    most_steps : int
        Steps after which a run ends.

    Returns
    -------
    Result
        `a` and `lam` from eq. (6) at the stored states. Of the statistics: n_accepted and n_evaluations (the
        residuals). A failure gives no output, and the last line of CasADi's text.
    """
    task = check_task(system, t_span, q0, v0, t_eval, time_limit, (rtol, atol), derivatives=False)
    return _by_sundials("idas", task, (rtol, atol), most_steps, time_limit, {})


def solve_cvodes(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    method: str = "BDF",
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
    most_steps: int = STEPS_A_RUN,
) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with CVODES of CasADi.

    What it was given: as `solve_idas`; BDF with Newton's iteration, as CasADi sets CVODES up, or Adams with fixed-point
    iteration, as SUNDIALS advises where nothing is stiff.

    Parameters
    ----------
    system, t_span, q0, v0, rtol, atol, t_eval, time_limit, most_steps : see `solve_idas`
    method : {"BDF", "Adams"}
        Orders up to 5, or up to 12.

    Returns
    -------
    Result
        As `solve_idas`; n_evaluations are those of the accelerations.
    """
    check_choice("method", method, METHODS)
    task = check_task(system, t_span, q0, v0, t_eval, time_limit, (rtol, atol), derivatives=False)
    return _by_sundials("cvodes", task, (rtol, atol), most_steps, time_limit, METHODS[method])


def solve_collocation(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    n_steps: int = 500,
    *,
    time_limit: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system with CasADi's collocation: Gauss, `DEGREE` nodes, steps of one size.

    What it was given: exact Jacobians; Gauss's points, with which the same steps have a fifth to a twelfth of the error
    of CasADi's default, Radau's; the degree that is cheapest on the four-bar from 1e-6 down; the compiler, as
    `solve_idas`.

    Parameters
    ----------
    system, t_span, q0, v0, time_limit : see `solve_idas`
    n_steps : int
        Number of steps.

    Returns
    -------
    Result
        At the ends of the steps, of no more than `OUTPUTS` of them. Of the statistics: n_accepted.
    """
    n_steps = check_size("n_steps", n_steps, 1)
    task = check_task(system, t_span, q0, v0, None, time_limit, derivatives=False)
    parts = np.unique(np.linspace(0, n_steps, min(OUTPUTS, n_steps) + 1).astype(int))
    ends = task.t0 + (task.t1 - task.t0) * parts / n_steps
    options = {"interpolation_order": DEGREE, "number_of_finite_elements": n_steps, "collocation_scheme": "legendre"}
    return _solved(task, "collocation", ends[1:], ends, options, time_limit)


def _by_sundials(
    plugin: str,
    task: Task,
    tolerances: tuple[float, float],
    most_steps: int,
    time_limit: float | None,
    more: dict[str, str],
) -> Result:
    most_steps, (rtol, atol) = check_size("most_steps", most_steps, 1), tolerances
    options: dict[str, Any] = {"reltol": float(rtol), "abstol": float(atol), "max_num_steps": most_steps, **more}
    options["show_eval_warnings"] = False  # of each step that is too long, thousands of lines; a failure is told
    return _solved(task, plugin, np.array([task.t1]), task.instants, options, time_limit)


def _solved(
    task: Task, plugin: str, timed: Array, times: Array, options: dict[str, Any], time_limit: float | None
) -> Result:
    """The Result at `times`, with the clock of a run that stores at `timed`."""
    made = partial(_integrator, plugin, *task.key, tuple(options.items()))
    start, t0, t1, name = task.y0, task.t0, task.t1, PLUGINS[plugin]
    limit, failure, cpu, states = TimeLimit(time_limit), "", None, np.empty((start.size, 0))
    counts: dict[str, Any] = {}
    after = times[times > t0]
    try:
        integrator = made(timed.tobytes())
        limit = TimeLimit(time_limit)
        with user_call as clock:
            states = np.array(integrator(x0=start)["xf"])
        cpu = clock.seconds
        counts = integrator.stats() if plugin in SUNDIALS else {}
        if limit.passed():
            failure = limit.message(name, t1, "take looser tolerances, or fewer steps")
        elif not np.array_equal(after, timed):
            states = np.array(made(after.tobytes())(x0=start)["xf"])
    except RuntimeError as error:  # the only sign of a failure; the run may have ended anywhere
        said = [line for line in str(error).splitlines() if line.strip()]
        failure = f"{name} failed: {said[-1]}. {ADVICE}"
    if failure:
        times, states = times[:0], states[:, :0]
    elif after.size < times.size:
        states = np.column_stack([start, states])
    statistics = Statistics(
        n_accepted=counts.get("nsteps", timed.size if plugin == "collocation" else None),
        n_evaluations=counts.get("nfevals"),
        cpu_time=cpu or 0.0,
    )
    return ode_result(task.system, times, states, failure, f"{name} reached the end, t = {t1:g}.", statistics)


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
