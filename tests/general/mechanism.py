"""What is known of a mechanism: its functions, a consistent start, and its motion from another source."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from twoloop import ConstrainedSystem
from twoloop.kernels.compile.callbacks import KINDS

G = 9.81
TIGHT = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14, "dense_output": True}


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A mechanism in plain functions and its motion by a route that shares no equation of motion with them.

    Attributes
    ----------
    name : str
    sizes : dict
        n_q, n_c and, where there are non-holonomic rows, n_a.
    functions : dict
        The callbacks by kind, as `ConstrainedSystem.from_python` takes them.
    end : float
        End of the run, s; it starts at 0.
    state : callable
        state(t) -> q, v (n_q,) at one time.
    rank : int
        Rank of all rows [C_q; A] at the start.
    energy : callable, optional
        energy(q, v); None where it is not conserved.
    compile : bool
        Whether numba is to compile the functions.
    ready : ConstrainedSystem, optional
        The system, where it is a ready one whose callbacks are compiled.
    given : tuple of ndarray, optional
        Its start q, v (n_q,), where the system comes with one. None: that of `state`.
    """

    name: str
    sizes: dict[str, int]
    functions: dict[str, Any]
    end: float
    state: Callable[[float], tuple[np.ndarray, np.ndarray]]
    rank: int
    energy: Callable[[np.ndarray, np.ndarray], float] | None = None
    compile: bool = False
    ready: ConstrainedSystem | None = None
    given: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def n_rows(self):
        return self.sizes["n_c"] + self.sizes.get("n_a", 0)

    @property
    def start(self):
        return self.state(0.0) if self.given is None else self.given

    def system(self, **changed):
        if self.ready is not None and not changed:
            return self.ready
        options = {**self.sizes, **self.functions, "compile": self.compile, "name": self.name, **changed}
        return ConstrainedSystem.from_python(**options)

    def states(self, times):
        """q, v (n_q, n_t) of the reference."""
        q, v = zip(*(self.state(t) for t in times), strict=True)
        return np.array(q).T, np.array(v).T

    def call(self, kind, *arguments):
        """One of the functions, or the zeros that stand for it."""
        function = self.functions.get(kind)
        if function is not None:
            return function(*arguments) if callable(function) else function
        n_q, n_c, n_a = self.sizes["n_q"], self.sizes["n_c"], self.sizes.get("n_a", 0)
        shapes = {
            "constraint": (n_c,),
            "jacobian": (n_c, n_q),
            "constraint_rate": (n_c,),
            "gamma": (n_c,),
            "nonholonomic": (n_a, n_q),
            "nonholonomic_rate": (n_a,),
            "nonholonomic_gamma": (n_a,),
        }
        return np.zeros(shapes[kind])

    def rows(self, t, q):
        """All rows [C_q; A] (n_rows, n_q)."""
        return np.vstack([self.call("jacobian", t, q), self.call("nonholonomic", t, q)])

    def velocity_residual(self, t, q, v):
        """[C_q v + C_t; A v + b] (n_rows,)."""
        rates = np.concatenate([self.call("constraint_rate", t, q), self.call("nonholonomic_rate", t, q)])
        return self.rows(t, q) @ v + rates

    def solution(self, t, q, v):
        """Acceleration and multipliers of minimum norm, a (n_q,), lam (n_rows,), by eigenvalues of the whole matrix."""
        J, M = self.rows(t, q), self.call("mass", t, q)
        n_q = M.shape[0]
        gamma = np.concatenate([self.call("gamma", t, q, v), self.call("nonholonomic_gamma", t, q, v)])
        matrix = np.block([[M, J.T], [J, np.zeros((len(J), len(J)))]])
        both = np.linalg.pinv(matrix, rcond=1e-11, hermitian=True) @ np.concatenate(
            [self.call("force", t, q, v), gamma]
        )
        return both[:n_q], both[n_q:]


def plain(system):
    """The callbacks of a ready system as functions that return arrays."""

    def returning(kind):
        if len(KINDS[kind].state) == 1:
            return lambda t, q: system.evaluate(kind, t, q)
        return lambda t, q, v: system.evaluate(kind, t, q, v)

    return {kind: returning(kind) for kind in system.given if kind != "kinematics"}


def of_problem(problem, state, end, rank=None):
    """A ready problem beside a motion that shares nothing with it; rank=None: all rows count."""
    system = problem.system
    return Mechanism(
        name=problem.name,
        sizes={"n_q": system.n_q, "n_c": system.n_c, "n_a": system.n_a},
        functions=plain(system),
        end=end,
        state=state,
        rank=system.n_c + system.n_a if rank is None else rank,
        energy=(lambda q, v: problem.energy(0.0, q, v)) if problem.conserved else None,
        ready=system,
        given=(problem.q0, problem.v0),
    )


def known(motion, end):
    """The state by equations of `tests.mechanisms.motions`, as a function of t."""
    rate, start, to_state = motion
    solution = integrate(lambda t, y: np.array(rate(t, y), dtype=float), np.array(start, dtype=float), end)

    def state(t):
        return tuple(np.array(each, dtype=float) for each in to_state(t, solution(t)))

    return state


def integrate(rate, start, end):
    """The solution of y' = rate(t, y) as a function of t, by scipy at a tolerance of 1e-13, once it is asked for."""

    @cache
    def solution():
        solved = solve_ivp(rate, (0.0, end), start, max_step=min(0.02, end / 100.0), **TIGHT)
        assert solved.success, solved.message
        return solved.sol

    return lambda t: solution()(t)


def one_coordinate(kinematics, mass, force, start, end):
    """The motion of a mechanism with one degree of freedom, by d'Alembert's principle for one coordinate s.

    `kinematics(s)` gives q, u = dq/ds and w = d2q/ds2; `mass` (n_q,) is constant, `force` (n_q,) too or a
    function of q.
    """

    def rate(t, y):
        q, u, w = kinematics(y[0])
        Q = force(q) if callable(force) else force
        return [y[1], (u @ (Q - mass * w * y[1] ** 2)) / (u @ (mass * u))]

    solution = integrate(rate, start, end)

    def state(t):
        s, speed = solution(t)
        q, u, _ = kinematics(s)
        return q, u * speed

    return state
