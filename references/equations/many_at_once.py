"""Many motions of one mechanism with different parameters and starts: diffrax by vmap, heyoka in batches, CyRK singly.

diffrax and heyoka are built once and take parameters as arguments. All packages are optional: `make peers`, or the
extra `peers`.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from references.cyrk.library import FINISHED
from references.cyrk.ode import Solver, rate_of
from references.diffrax.dopri8 import derivative_of, packages, solved
from references.driver import Task, imported, user_call
from references.equations.expressions import Expressions
from references.equations.rows import with_all_rows
from references.heyoka.taylor import rates_of
from twoloop.problem.problem import Array, Problem

Solve = Callable[[float], Array]  # tolerance -> final q (n_runs, n_q), NaN for failed runs

MOST_STEPS = 100_000  # of diffrax
CALLBACKS = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")


def by_diffrax(problems: Sequence[Problem], t_end: float) -> Solve:
    """Return diffrax's Dopri8 over all runs by `vmap`, compiled at the first call."""
    jax, diffrax = packages()
    equations, states, parameters = _gathered(problems)
    derivative, n = derivative_of(equations), equations.system.n_q

    def one(y0: Any, p: Any, tol: Any) -> Any:
        found = solved(derivative, 0.0, t_end, y0, (tol, tol), diffrax.SaveAt(t1=True), MOST_STEPS, p)
        return jax.numpy.where(found.result == diffrax.RESULTS.successful, found.ys[-1][:n], jax.numpy.nan)

    run = jax.jit(jax.vmap(one, in_axes=(0, 0, None)))
    return lambda tol: np.array(run(states, parameters, tol))


def by_heyoka(problems: Sequence[Problem], t_end: float) -> Solve:
    """Return heyoka's Taylor integrator in batches as wide as the vector registers, built once per tolerance."""
    package = imported("heyoka")
    equations, states, parameters = _gathered(problems)
    n, width, made = equations.system.n_q, package.recommended_simd_size(), {}
    motion = rates_of(equations, [package.par[i] for i in range(parameters.shape[1])])
    groups = np.minimum(np.arange(-(-len(states) // width) * width), len(states) - 1).reshape(-1, width)

    def solve(tol: float) -> Array:
        if tol not in made:
            start = states[groups[0]].T.copy()
            made[tol] = package.taylor_adaptive_batch(motion, start, tol=tol, fast_math=True)
        integrator, ends = made[tol], np.full((len(states), n), np.nan)
        for group in groups:
            integrator.set_time(0.0)
            integrator.state[:] = states[group].T
            integrator.pars[:] = parameters[group, : len(integrator.pars)].T  # only those that are used
            integrator.propagate_until(t_end)
            good = [result[0] == package.taylor_outcome.time_limit for result in integrator.propagate_res]
            ends[group[good]] = integrator.state[:n, good].T
        return ends

    return solve


def by_cyrk(problems: Sequence[Problem], t_end: float) -> Solve:
    """Return CyRK's DOP853, one run after another, with solvers that are made before the runs that are timed.

    The accelerations are those of the first problem, unless parameters differ, which are constants in its code.
    """
    tasks = [Task(with_all_rows(each.system), each.system.n_c, 0.0, t_end, each.q0, each.v0) for each in problems]
    alike = all((each.system.parameters == problems[0].system.parameters).all() for each in problems)
    rates = [rate_of(*tasks[0].key)] * len(tasks) if alike else [rate_of(*task.key) for task in tasks]
    made: dict[float, list[Solver]] = {}
    stack, n = ExitStack(), problems[0].system.n_q  # the solvers last as long as the process

    def solve(tol: float) -> Array:
        if tol not in made:
            made[tol] = [
                Solver(stack, task, task.y0, "DOP853", (rate, None), (tol, tol), t_end)
                for task, rate in zip(tasks, rates, strict=True)
            ]
        runs = [solver.prepared(0) for solver in made[tol]]
        with user_call:
            for run in runs:
                run()
        return np.array(
            [solver.end[:n] if solver.found.status == FINISHED else np.full(n, np.nan) for solver in made[tol]]
        )

    return solve


def _gathered(problems: Sequence[Problem]) -> tuple[Expressions, Array, Array]:
    """Return equations, states (n_runs, 2 n_q) and parameters (n_runs, n_p) of problems differing in numbers only.

    Raises ValueError, naming the problem, if its callbacks differ from those of the first.
    """
    first = problems[0]
    for problem in problems:
        f, own = first.system.functions, problem.system.functions
        if any(getattr(f, name) is not getattr(own, name) for name in CALLBACKS):
            raise ValueError(f"problems must have the callbacks of the first, {first.name!r}; given {problem.name!r}")
    states = np.array([np.concatenate([problem.q0, problem.v0]) for problem in problems])
    parameters = np.array([problem.system.functions.p for problem in problems])
    vary = bool((parameters != parameters[0]).any())  # otherwise constants in the expressions
    equations = Expressions(first.system, 0.0, first.q0, first.v0, of_parameters=vary)
    return equations, states, parameters if vary else parameters[:, :0]
