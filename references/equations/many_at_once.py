"""Many motions of one mechanism, of different parameters and starts, in one call: diffrax by vmap, heyoka in batches.

Each is built once and takes parameters as arguments; both packages are optional: `make peers`, or the extra `peers`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from references.equations.expressions import Expressions, functions_of
from twoloop.problem.problem import Problem

Array = NDArray[np.float64]
Solve = Callable[[float], Array]  # tolerance -> q at the end (n_runs, n_q), NaN of what failed

MOST_STEPS = 100_000  # of diffrax
CALLBACKS = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")


def by_diffrax(problems: Sequence[Problem], t_end: float) -> Solve:
    """Dopri8 of diffrax over all runs by `vmap`, compiled once at the first call."""
    import diffrax
    import jax

    jax.config.update("jax_enable_x64", True)
    equations, states, parameters = _gathered(problems)
    n, functions = equations.system.n_q, functions_of(jax.numpy)

    def derivative(t: Any, y: Any, p: Any) -> Any:
        q, v, lengths = ([x[i] for i in range(x.shape[0])] for x in (y[:n], y[n:], p))
        a = equations.accelerations(functions, t, q, v, lengths)
        return jax.numpy.concatenate([y[n:], jax.numpy.stack([jax.numpy.asarray(each) for each in a])])

    def one(y0: Any, p: Any, tol: Any) -> Any:
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(derivative),
            diffrax.Dopri8(),
            t0=0.0,
            t1=t_end,
            dt0=None,
            y0=y0,
            args=p,
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.PIDController(rtol=tol, atol=tol),
            max_steps=MOST_STEPS,
            throw=False,
        )
        good = found.result == diffrax.RESULTS.successful
        return jax.numpy.where(good, found.ys[-1][:n], jax.numpy.nan)

    run = jax.jit(jax.vmap(one, in_axes=(0, 0, None)))
    return lambda tol: np.array(run(states, parameters, tol))


def by_heyoka(problems: Sequence[Problem], t_end: float) -> Solve:
    """heyoka's Taylor integrator in batches as wide as the processor's vectors, built once a tolerance."""
    import heyoka

    equations, states, parameters = _gathered(problems)
    n, width, made = equations.system.n_q, heyoka.recommended_simd_size(), {}
    symbols = heyoka.make_vars(*(f"{name}{i}" for name in "qv" for i in range(n)))
    p = [heyoka.par[i] for i in range(parameters.shape[1])]
    a = equations.accelerations(functions_of(heyoka), heyoka.time, symbols[:n], symbols[n:], p)
    rates = [heyoka.expression(rate) if isinstance(rate, float) else rate for rate in [*symbols[n:], *a]]
    motion = list(zip(symbols, rates, strict=True))
    groups = np.minimum(np.arange(-(-len(states) // width) * width), len(states) - 1).reshape(-1, width)

    def solve(tol: float) -> Array:
        if tol not in made:
            start = states[groups[0]].T.copy()
            made[tol] = heyoka.taylor_adaptive_batch(motion, start, tol=tol, fast_math=True)
        integrator, ends = made[tol], np.full((len(states), n), np.nan)
        for group in groups:
            integrator.set_time(0.0)
            integrator.state[:] = states[group].T
            integrator.pars[:] = parameters[group, : len(integrator.pars)].T  # those up to the last that is used
            integrator.propagate_until(t_end)
            good = [result[0] == heyoka.taylor_outcome.time_limit for result in integrator.propagate_res]
            ends[group[good]] = integrator.state[:n, good].T
        return ends

    return solve


def _gathered(problems: Sequence[Problem]) -> tuple[Expressions, Array, Array]:
    """The equations, states (n_runs, 2 n_q) and parameters (n_runs, n_p) of problems that differ in numbers only.

    Raises
    ------
    ValueError
        If a problem has other callbacks than the first, naming it.
    """
    first = problems[0]
    for problem in problems:
        f, own = first.system.functions, problem.system.functions
        if any(getattr(f, name) is not getattr(own, name) for name in CALLBACKS):
            raise ValueError(f"problems must have the callbacks of the first, {first.name!r}; given {problem.name!r}")
    states = np.array([np.concatenate([problem.q0, problem.v0]) for problem in problems])
    parameters = np.array([problem.system.functions.p for problem in problems])
    return Expressions(first.system, 0.0, first.q0, first.v0, of_parameters=True), states, parameters
