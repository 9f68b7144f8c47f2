"""A system with some of its stops closed, sliding or sticking: additional constraints and friction."""

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
from twoloop.run.impulse import NEGLIGIBLE
from twoloop.run.run import Run


class WithContacts:
    """Callbacks of a system extended by the gaps of closed stops as constraints, and by their friction.

    Parameters
    ----------
    system : ConstrainedSystem
    gaps, slides : Gaps
    which : list of int
        Indices of the closed stops.
    sticks : dict
        Displacements along the surface that do not change, by indices of slides: these are constraints as well.
    slips : list of (int, int, float)
        For each stop that slides: its place in `which`, the index of its slide, and its coefficient of friction, with
        the sign of the sliding.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        gaps: Gaps,
        slides: Gaps,
        which: list[int],
        sticks: dict[int, float],
        slips: list[tuple[int, int, float]],
    ):
        self._system, self._gaps, self._which = system, gaps, which
        self._slides, self._held, self._slips = slides, list(sticks), slips
        self._from = np.array(list(sticks.values()))
        self._still = np.zeros(system.n_q)
        self._derived = standing_for(system, unchecked)[0] if slips else system

    def _rows(self, part: str, t: float, q: Array, v: Array) -> Array:
        """Return a part of a `Gap` for closed stops, followed by that for the displacements that do not change."""
        closed = getattr(self._gaps.at(t, q, v), part)[self._which]
        return np.concatenate([closed, getattr(self._slides.at(t, q, v), part)[self._held]]) if self._held else closed

    def _of(self, kind: str, t: float, *state: Array) -> Array:
        (out,) = self._system.arrays_of(kind)
        getattr(self._system.functions, kind)(t, *state, self._system.functions.p, out)
        return np.asarray(out)

    def constraint(self, t: float, q: Array) -> Array:
        """Evaluate C, followed by the gaps."""
        gaps = self._rows("g", t, q, self._still)
        gaps[len(self._which) :] -= self._from
        return np.append(self._of("constraint", t, q), gaps)

    def jacobian(self, t: float, q: Array) -> Array:
        """Evaluate C_q, followed by the gradients of the gaps."""
        rows = self._system.jacobian(t, q) if self._system.n_c else np.zeros((0, self._system.n_q))
        return np.vstack([rows, self._rows("W", t, q, self._still)])

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Evaluate C_t, followed by the time derivatives of the gaps."""
        return np.append(self._system.constraint_rate(t, q), self._rows("u", t, q, self._still))

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Evaluate the right-hand side of C_q a = gamma, followed by that of the gaps."""
        own = self._of("gamma", t, q, v) if self._system.n_c else np.zeros(0)
        return np.append(own, -self._rows("bend", t, q, v))

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Evaluate Q, and the friction of the stops that slide, which follows from their forces."""
        Q = self._of("force", t, q, v)
        if not self._slips:
            return Q
        system, slides = self._derived, self._slides.at(t, q, v).W
        rows = np.vstack([system.rows(t, q), self._rows("W", t, q, v)])
        own = [system.gamma(t, q, v)] if system.n_c else []
        own += [system.nonholonomic_gamma(t, q, v)] if system.n_a else []
        n, first = system.n_q, system.n_q + system.n_c + system.n_a
        K = np.block([[self._of("mass", t, q), rows.T], [rows, np.zeros((len(rows),) * 2)]])
        for place, k, coefficient in self._slips:
            K[:n, first + place] -= coefficient * slides[k]
        found = np.linalg.lstsq(K, np.concatenate([Q, *own, -self._rows("bend", t, q, v)]), rcond=NEGLIGIBLE)[0]
        return Q + sum(coefficient * found[first + place] * slides[k] for place, k, coefficient in self._slips)

    def made(self, names: str) -> ConstrainedSystem:
        """Return the system with these callbacks."""
        system = self._system
        functions: dict[str, Any] = {
            kind: getattr(self, kind) for kind in ("constraint", "jacobian", "constraint_rate")
        }
        functions["mass"] = lambda t, q: self._of("mass", t, q)
        functions["force"] = self.force
        if "gamma" in system.given or system.n_c == 0:
            functions["gamma"] = self.gamma
        for kind in system.given:
            if kind.startswith("nonholonomic"):
                functions[kind] = getattr(system, kind)
        sizes: dict[str, Any] = {
            "n_q": system.n_q,
            "n_c": system.n_c + len(self._which) + len(self._held),
            "n_a": system.n_a,
        }
        return ConstrainedSystem.from_python(**sizes, **functions, name=f"{system.name} on {names}")


class Accelerations:
    """Accelerations and multipliers of a system at any state, computed as in its runs."""

    def __init__(self, system: ConstrainedSystem, t: float, q: Array, v: Array, atol: Array):
        derived, _ = standing_for(system, unchecked)
        plan = DOP853().plan(system.n_q, 1e-8, 1e-8, False)
        self._run = Run(derived, plan, t, q, v, 1e-8, atol, None)
        self._run.work.notes[noted.GENERATION] = 1.0  # the ranks are known
        self._n = system.n_q
        self._last: tuple[tuple[float, bytes, bytes], Array] | None = None

    def at(self, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        """Return a (n_q,) and [lam; mu]; NaN if they do not exist."""
        run, n, asked = self._run, self._n, (t, q.tobytes(), v.tobytes())
        if self._last is None or self._last[0] != asked:  # events of all rows ask for the same state
            state = np.concatenate([q, v, np.zeros(len(run.state) - 2 * n)])
            if direct(run.kernels.start)(run.kit, run.work, t, state) != codes.DONE:
                state[2 * n :] = np.nan
            self._last = asked, state
        state = self._last[1]
        return state[2 * n : 3 * n], state[3 * n :]
