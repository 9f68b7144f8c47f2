"""Many motions of one mechanism with different parameters and starts, by other packages.

diffrax, by vmap, and heyoka, in batches, are built once and take parameters as arguments; CyRK and CVODE make one run
after another.
"""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from references.cyrk.ode import FINISHED, Solver, rate_of
from references.diffrax.dopri8 import derivative_of, packages, solve_by_dopri8
from references.driver import Task, TimeLimit, imported, user_call
from references.equations.expressions import Expressions
from references.equations.rows import with_all_rows
from references.heyoka.taylor import rates_of
from references.sundials.cvode_c import adams_memory
from references.sundials.library import Memory
from twoloop.problem.problem import Array, Problem

Solve = Callable[[float], Array]  # tolerance -> final q (n_runs, n_q), NaN for failed runs

MAX_STEPS = 100_000  # of diffrax
CALLBACKS = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")


def by_diffrax(problems: Sequence[Problem], t_end: float) -> Solve:
    """Return diffrax's Dopri8 over all runs by `vmap`, compiled at the first call."""
    jax, diffrax = packages()
    equations, states, parameters = _gathered(problems)
    derivative, n = derivative_of(equations), equations.system.n_q

    def run_one(y0: Any, p: Any, tol: Any) -> Any:
        solution = solve_by_dopri8(derivative, 0.0, t_end, y0, (tol, tol), diffrax.SaveAt(t1=True), MAX_STEPS, p)
        return jax.numpy.where(solution.result == diffrax.RESULTS.successful, solution.ys[-1][:n], jax.numpy.nan)

    run = jax.jit(jax.vmap(run_one, in_axes=(0, 0, None)))
    return lambda tol: np.array(run(states, parameters, tol))


class Batches:
    """heyoka's Taylor integrators in batches as wide as it recommends for the processor, built once per tolerance."""

    def __init__(self, problems: Sequence[Problem]):
        self.package = imported("heyoka")
        equations, self.states, self.parameters = _gathered(problems)
        self.n, self._integrators = equations.system.n_q, dict[float, Any]()
        self.motion = rates_of(equations, [self.package.par[i] for i in range(self.parameters.shape[1])])
        n_runs, width = len(self.states), self.package.recommended_simd_size()
        self.groups = np.minimum(np.arange(-(-n_runs // width) * width), n_runs - 1).reshape(-1, width)

    def integrator(self, tol: float) -> Any:
        """The integrator of a tolerance."""
        if tol not in self._integrators:
            start = self.states[self.groups[0]].T.copy()
            self._integrators[tol] = self.package.taylor_adaptive_batch(self.motion, start, tol=tol, fast_math=True)
        return self._integrators[tol]

    def put(self, integrator: Any, k: int) -> Any:
        """Put a batch at its start."""
        group = self.groups[k]
        integrator.set_time(0.0)
        integrator.state[:] = self.states[group].T
        integrator.pars[:] = self.parameters[group, : len(integrator.pars)].T  # only those that are used
        return integrator

    def take(self, integrator: Any, k: int, ends: Array) -> None:
        """Take the ends of the runs of a batch that got there."""
        good = [result[0] == self.package.taylor_outcome.time_limit for result in integrator.propagate_res]
        ends[self.groups[k][good]] = integrator.state[: self.n, good].T


def by_heyoka(problems: Sequence[Problem], t_end: float) -> Solve:
    """Return heyoka's batches, one after another in one integrator."""
    batches = Batches(problems)

    def solve(tol: float) -> Array:
        integrator, ends = batches.integrator(tol), np.full((len(problems), batches.n), np.nan)
        for k in range(len(batches.groups)):
            batches.put(integrator, k).propagate_until(t_end)
            batches.take(integrator, k, ends)
        return ends

    return solve


def by_heyoka_ensemble(problems: Sequence[Problem], t_end: float) -> Solve:
    """Return heyoka's ensemble_propagate_until_batch, which copies the integrator for each batch, on one thread."""
    batches = Batches(problems)

    def solve(tol: float) -> Array:
        ends, n = np.full((len(problems), batches.n), np.nan), len(batches.groups)
        propagate = batches.package.ensemble_propagate_until_batch
        for k, result in enumerate(propagate(batches.integrator(tol), t_end, n, batches.put, max_workers=1)):
            batches.take(result[0], k, ends)
        return ends

    return solve


def by_cyrk(problems: Sequence[Problem], t_end: float) -> Solve:
    """Return CyRK's DOP853, one run after another, with solvers that are made before the runs that are timed.

    The accelerations are those of the first problem, unless parameters differ, which are constants in its code.
    """
    tasks, keys = _tasks(problems, t_end)
    rates = [rate_of(*key) for key in keys]
    solvers: dict[float, list[Solver]] = {}
    stack, n = ExitStack(), problems[0].system.n_q  # the solvers last as long as the process

    def solve(tol: float) -> Array:
        if tol not in solvers:
            pairs = zip(tasks, rates, strict=True)
            solvers[tol] = [Solver(stack, (f, None), task.y0, task, "DOP853", tol, tol, t_end) for task, f in pairs]
        runs = [solver.prepared(0) for solver in solvers[tol]]
        with user_call:
            for run in runs:
                run()
        finished = [(solver, solver.solution.status == FINISHED) for solver in solvers[tol]]
        return np.array([solver.end[:n] if good else np.full(n, np.nan) for solver, good in finished])

    return solve


def by_cvode(problems: Sequence[Problem], t_end: float) -> Solve:
    """Return CVODE's Adams methods driven from C, one run after another, with equations as `by_cyrk` has them."""
    (tasks, keys), memories = _tasks(problems, t_end), dict[float, list[Memory]]()
    stack, n = ExitStack(), problems[0].system.n_q

    def solve(tol: float) -> Array:
        if tol not in memories:
            memories[tol] = [adams_memory(stack, task, key, tol) for task, key in zip(tasks, keys, strict=True)]
        flags, limit = [], TimeLimit(None)
        with user_call:
            for solver in memories[tol]:
                solver.restart()
                flags.append(solver.go_to_the_end(limit))
        ends = [solver.state[0, :n].copy() for solver in memories[tol]]
        return np.array([end if flag >= 0 else np.full(n, np.nan) for end, flag in zip(ends, flags, strict=True)])

    return solve


def _tasks(problems: Sequence[Problem], t_end: float) -> tuple[list[Task], list[tuple[Any, ...]]]:
    """Return the tasks of runs that are made singly, and the key of the equations of each: one, if parameters agree."""
    starts = [(problem.system, problem.q0, problem.v0) for problem in problems]
    tasks = [Task(with_all_rows(system), system.n_c, 0.0, t_end, q0, v0) for system, q0, v0 in starts]
    alike = all((system.parameters == problems[0].system.parameters).all() for system, _, _ in starts)
    return tasks, [tasks[0].key if alike else task.key for task in tasks]


def _gathered(problems: Sequence[Problem]) -> tuple[Expressions, Array, Array]:
    """Return equations, states (n_runs, 2 n_q) and parameters (n_runs, n_p) of problems differing in numbers only.

    Raises ValueError, naming the problem, if its callbacks differ from those of the first.
    """
    first = problems[0]
    for problem in problems:
        f, functions = first.system.functions, problem.system.functions
        if any(getattr(f, name) is not getattr(functions, name) for name in CALLBACKS):
            raise ValueError(f"problems must have the callbacks of the first, {first.name!r}; given {problem.name!r}")
    states = np.array([np.concatenate([problem.q0, problem.v0]) for problem in problems])
    parameters = np.array([problem.system.functions.p for problem in problems])
    vary = bool((parameters != parameters[0]).any())  # otherwise constants in the expressions
    equations = Expressions(first.system, 0.0, first.q0, first.v0, of_parameters=vary)
    return equations, states, parameters if vary else parameters[:, :0]
