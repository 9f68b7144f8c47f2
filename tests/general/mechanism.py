"""What is known of a mechanism: its system, a consistent start, and its motion from another source."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from scipy.integrate import solve_ivp

from twoloop import ConstrainedSystem

G = 9.81
TIGHT = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14, "dense_output": True}


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A mechanism and its motion by a route that shares no equation of motion with it."""

    name: str
    system: Callable[..., ConstrainedSystem]  # of plain functions: it takes others in the place of some by their names
    end: float  # of the run, s; it starts at 0
    state: Callable[[float], tuple[np.ndarray, np.ndarray]]  # q, v (n_q,) at one time
    rank: int  # of all rows [C_q; A] at the start
    energy: Callable[[np.ndarray, np.ndarray], float] | None = None  # None where it is not conserved
    given: tuple[np.ndarray, np.ndarray] | None = None  # its start, where the system comes with one

    @property
    def start(self):
        return self.state(0.0) if self.given is None else self.given

    def states(self, times):
        """q, v (n_q, n_t) of the reference."""
        q, v = zip(*(self.state(t) for t in times), strict=True)
        return np.array(q).T, np.array(v).T


def of_functions(**functions):
    """What makes a system of plain functions, once, and others with other functions in the place of some."""
    make = ConstrainedSystem.from_python
    usual = cache(partial(make, **functions))
    return lambda **changed: make(**functions | changed) if changed else usual()


def of_problem(problem, state, end, rank=None):
    """A ready problem beside a motion that shares nothing with it; rank=None: all rows count."""
    system = problem.system
    energy = (lambda q, v: problem.energy(0.0, q, v)) if problem.conserved else None
    rank = system.n_c + system.n_a if rank is None else rank
    return Mechanism(problem.name, lambda: system, end, state, rank, energy, given=(problem.q0, problem.v0))


def known(motion, end):
    """The state by equations of `tests.mechanisms.motions`, as a function of t."""
    rate, start, to_state = motion
    solution = integrate(lambda t, y: np.array(rate(t, y), dtype=float), np.array(start, dtype=float), end)
    state = lambda t: tuple(np.array(each, dtype=float) for each in to_state(t, solution(t)))  # noqa: E731
    return state


def integrate(rate, start, end):
    """The solution of y' = rate(t, y) as a function of t, by scipy at a tolerance of 1e-13, once it is asked for."""

    @cache
    def solution():
        solved = solve_ivp(rate, (0.0, end), start, max_step=min(0.02, end / 100.0), **TIGHT)
        assert solved.success, solved.message
        return solved.sol

    return lambda t: solution()(t)
