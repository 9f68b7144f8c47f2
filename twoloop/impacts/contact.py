"""A system with some of its stops closed: additional constraints, valid while the contact forces push."""

from __future__ import annotations

from typing import Any

import numpy as np

from twoloop.checks.arguments import Array
from twoloop.generate.derived import standing_for
from twoloop.generate.traced_values import unchecked
from twoloop.impacts.gaps import Gaps
from twoloop.kernels.compile.linking import direct
from twoloop.kernels.data import codes, noted
from twoloop.methods.dop853 import DOP853
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.run import Run


class WithContacts:
    """Callbacks of a system extended by the gaps of closed stops as constraints.

    Parameters
    ----------
    system : ConstrainedSystem
    gaps : Gaps
    which : list of int
        Indices of the closed stops.
    """

    def __init__(self, system: ConstrainedSystem, gaps: Gaps, which: list[int]):
        self._system, self._gaps, self._which = system, gaps, which
        self._still = np.zeros(system.n_q)

    def _of(self, kind: str, t: float, *state: Array) -> Array:
        (out,) = self._system.arrays_of(kind)
        getattr(self._system.functions, kind)(t, *state, self._system.functions.p, out)
        return np.asarray(out)

    def constraint(self, t: float, q: Array) -> Array:
        """Evaluate C, followed by the gaps."""
        return np.append(self._of("constraint", t, q), self._gaps.at(t, q, self._still).g[self._which])

    def jacobian(self, t: float, q: Array) -> Array:
        """Evaluate C_q, followed by the gradients of the gaps."""
        rows = self._system.jacobian(t, q) if self._system.n_c else np.zeros((0, self._system.n_q))
        return np.vstack([rows, self._gaps.at(t, q, self._still).W[self._which]])

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Evaluate C_t, followed by the time derivatives of the gaps."""
        return np.append(self._system.constraint_rate(t, q), self._gaps.at(t, q, self._still).u[self._which])

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Evaluate the right-hand side of C_q a = gamma, followed by that of the gaps."""
        own = self._of("gamma", t, q, v) if self._system.n_c else np.zeros(0)
        return np.append(own, -self._gaps.at(t, q, v).bend[self._which])

    def made(self, names: str) -> ConstrainedSystem:
        """Return the system with these callbacks."""
        system = self._system
        functions: dict[str, Any] = {
            kind: getattr(self, kind) for kind in ("constraint", "jacobian", "constraint_rate")
        }
        functions["mass"] = lambda t, q: self._of("mass", t, q)
        functions["force"] = lambda t, q, v: self._of("force", t, q, v)
        if "gamma" in system.given or system.n_c == 0:
            functions["gamma"] = self.gamma
        for kind in system.given:
            if kind.startswith("nonholonomic"):
                functions[kind] = getattr(system, kind)
        sizes: dict[str, Any] = {"n_q": system.n_q, "n_c": system.n_c + len(self._which), "n_a": system.n_a}
        return ConstrainedSystem.from_python(**sizes, **functions, name=f"{system.name} on {names}")


class Accelerations:
    """Accelerations and multipliers of a system at any state, computed as in its runs."""

    def __init__(self, system: ConstrainedSystem, t: float, q: Array, v: Array, atol: Array):
        derived, _ = standing_for(system, unchecked)
        plan = DOP853().plan(system.n_q, 1e-8, 1e-8, False)
        self._run = Run(derived, plan, t, q, v, 1e-8, atol, None)
        self._run.work.notes[noted.GENERATION] = 1.0  # the ranks are known
        self._n = system.n_q

    def at(self, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        """Return a (n_q,) and [lam; mu]; NaN if they do not exist."""
        run, n = self._run, self._n
        state = np.concatenate([q, v, np.zeros(len(run.state) - 2 * n)])
        if direct(run.kernels.start)(run.kit, run.work, t, state) != codes.DONE:
            state[2 * n :] = np.nan
        return state[2 * n : 3 * n], state[3 * n :]
