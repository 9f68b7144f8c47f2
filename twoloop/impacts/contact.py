"""Trace the gaps of stops, and extend a system by the gaps of closed stops as constraints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from twoloop.checks.arguments import Array, shown
from twoloop.generate.derived_callbacks import derive_callbacks
from twoloop.generate.graph import Affine, Derivative, Graph, Untraceable, symbol_array
from twoloop.generate.program import MAX_TRACE_DIFFERENCE, N_COMPARED, TIME_SPACING, OperationTable
from twoloop.generate.trace import convert_to_expressions, trace
from twoloop.generate.traced_values import accept_traces
from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import indices
from twoloop.methods.dop853 import DOP853
from twoloop.problem.description import Stop
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.fallbacks import equilibrating_units, independent_rows, solve_scaled
from twoloop.run.run import Run
from twoloop.run.singular_start import Branch, branch_at


class Undetermined(ValueError):
    """Error if the forces of stops and of sticking joints, or a motion with them, are not determined."""


class Gap(NamedTuple):
    """Gaps g of k stops, their rates u, second derivatives without the terms in v' (bias), and gradients W (k, n_q)."""

    g: Array
    u: Array
    bias: Array
    W: Array


class Gaps:
    """Evaluate the gap functions of stops, or the displacement functions of stops with friction ("slide").

    Parameters
    ----------
    function : "gap" or "slide"
    stops : sequence of Stop
    t0, q0 : float, ndarray (n_q,)
        State near which the traced programs are compared with the functions.

    Raises ValueError if a gap function cannot be traced, or disagrees with its trace.
    """

    def __init__(self, function: str, stops: Sequence[Stop], t0: float, q0: Array):
        self.n, self._n_q, self._function = len(stops), len(q0), function
        graph = Graph()
        (t,) = graph.inputs(1, False)
        q, v = graph.inputs(self._n_q, False), graph.inputs(self._n_q, True)
        outputs: list[Affine] = []
        for stop in stops:
            try:
                value = np.array(trace(getattr(stop, function), t, symbol_array(q)), dtype=object)
                (gap,) = convert_to_expressions(graph, value.reshape(1))
            except (Untraceable, ValueError) as error:
                raise ValueError(
                    f"{function} of {stop.name!r} must be a number computed from t and q by numpy functions, without "
                    f"branches: {error}"
                ) from None
            outputs += _gap_derivatives(graph, gap, t, q, v)
        program = OperationTable.from_results(graph, 1 + 2 * self._n_q, dict(enumerate(outputs)))
        self._p = np.array(program.as_floats())
        self._last: tuple[Any, Gap] | None = None
        self._compare(stops, t0, q0)

    def evaluate(self, t: float, q: Array, v: Array) -> Gap:
        """Evaluate the gaps at a state."""
        from twoloop.bodies.read_tables import results  # compiled on import

        state = t, q.tobytes(), v.tobytes()
        if self._last is not None and self._last[0] == state:  # the events of all stops evaluate the same state
            return self._last[1]
        values = results(0, t, q, v, self._p)[: self.n * (3 + self._n_q)].reshape(self.n, 3 + self._n_q)
        self._last = state, Gap(values[:, 0], values[:, 1], values[:, 2], values[:, 3:])
        return self._last[1]

    def _compare(self, stops: Sequence[Stop], t0: float, q0: Array) -> None:
        """Raise unless the traced programs return the values of the functions, at q0 and near it."""
        # a fixed seed, so that every call accepts or rejects the same model
        displacements = np.random.default_rng(4).uniform(-0.3, 0.3, (N_COMPARED, len(q0)))
        displacements[0] = 0.0
        for k, displacement in enumerate(displacements):
            t, q = t0 + TIME_SPACING * k, q0 + displacement
            traced = self.evaluate(t, q, np.zeros_like(q)).g
            for stop, traced_value in zip(stops, traced, strict=True):
                value: Any = getattr(stop, self._function)(t, q.copy())
                if k == 0 and not (np.ndim(value) == 0 and np.isfinite(value)):
                    raise ValueError(
                        f"{self._function} of {stop.name!r} must return a finite number; it returned {shown(value)}"
                    )
                if np.isfinite(value) and abs(value - traced_value) > MAX_TRACE_DIFFERENCE * (1.0 + abs(traced_value)):
                    raise ValueError(
                        f"{self._function} of {stop.name!r} has another value at t = {t:g} than when it was traced: it "
                        "must depend on t and q alone, without branches"
                    )


def _gap_derivatives(graph: Graph, gap: Affine, t: Affine, q: Sequence[Affine], v: Sequence[Affine]) -> list[Affine]:
    """Return a gap, its rate, its second derivative without the term in v', and its gradient."""
    unit = Affine(graph, 1.0, {})
    (t_input,), q_inputs = t.terms, [next(iter(coordinate.terms)) for coordinate in q]
    direction = {t_input: unit, **dict(zip(q_inputs, v, strict=True))}
    rate = Derivative(graph, direction).differentiate(gap)
    bias = Derivative(graph, direction).differentiate(rate)
    return [gap, rate, bias, *(Derivative(graph, {q_input: unit}).differentiate(gap) for q_input in q_inputs)]


class ContactSystem:
    """Extend the callbacks of a system by the gaps of closed stops as constraints, and by their friction.

    Parameters
    ----------
    system : ConstrainedSystem
    gaps, slides : Gaps
    closed : list of int
        Indices of the closed stops.
    sticking, places : ndarray (k, n_slides), ndarray (k,)
        Weights of the displacements of stops that stick together, and their constant sums, which are constraints, too.
    slipping : list of (int, int, float)
        For each stop that slides: its index in `closed`, the index of its slide, and its coefficient of friction times
        the direction of sliding (1 or -1).
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        gaps: Gaps,
        slides: Gaps,
        closed: list[int],
        sticking: Array,
        places: Array,
        slipping: list[tuple[int, int, float]],
    ):
        self._system, self._gaps, self._closed = system, gaps, closed
        self._slides, self._sticking, self._places, self._slipping = slides, sticking, places, slipping
        # of the equations with friction, found by the first call of `force`: units, whether rows are redundant
        self._scaling: tuple[Array, bool] | None = None
        self._zero_velocity = np.zeros(system.n_q)
        self._derived = derive_callbacks(system, accept_traces)[0] if slipping else system

    def _rows(self, part: str, t: float, q: Array, v: Array) -> Array:
        """Return one field of the `Gap` of the closed stops, followed by this field for the constant displacements."""
        rows = getattr(self._gaps.evaluate(t, q, v), part)[self._closed]
        if not len(self._sticking):
            return rows
        return np.concatenate([rows, self._sticking @ getattr(self._slides.evaluate(t, q, v), part)])

    def _call(self, kind: str, t: float, *state: Array) -> Array:
        (values,) = self._system.arrays_of(kind)
        getattr(self._system.functions, kind)(t, *state, self._system.functions.p, values)
        return np.asarray(values)

    def constraint(self, t: float, q: Array) -> Array:
        """Evaluate C, followed by the gaps."""
        gaps = self._rows("g", t, q, self._zero_velocity)
        gaps[len(self._closed) :] -= self._places
        return np.append(self._call("constraint", t, q), gaps)

    def jacobian(self, t: float, q: Array) -> Array:
        """Evaluate C_q, followed by the gradients of the gaps."""
        rows = self._system.jacobian(t, q) if self._system.n_c else np.zeros((0, self._system.n_q))
        return np.vstack([rows, self._rows("W", t, q, self._zero_velocity)])

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Evaluate C_t, followed by the time derivatives of the gaps."""
        return np.append(self._system.constraint_rate(t, q), self._rows("u", t, q, self._zero_velocity))

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Evaluate the right-hand side of C_q a = gamma, followed by the right-hand sides of the gaps."""
        right_sides = self._call("gamma", t, q, v) if self._system.n_c else np.zeros(0)
        return np.append(right_sides, -self._rows("bias", t, q, v))

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Evaluate Q plus the friction of the sliding stops, which is proportional to the forces of these stops."""
        Q = self._call("force", t, q, v)
        if not self._slipping:
            return Q
        system, slides = self._derived, self._slides.evaluate(t, q, v).W
        rows = np.vstack([system.rows(t, q), self._rows("W", t, q, v)])
        right_sides = [system.gamma(t, q, v)] if system.n_c else []
        right_sides += [system.nonholonomic_gamma(t, q, v)] if system.n_a else []
        n, first_stop = system.n_q, system.n_q + system.n_c + system.n_a
        # the friction of sliding stops is proportional to the unknown forces of the stops, so it changes the matrix
        K = np.block([[self._call("mass", t, q), rows.T], [rows, np.zeros((len(rows),) * 2)]])
        for place, k, coefficient in self._slipping:
            K[:n, first_stop + place] -= coefficient * slides[k]
        right = np.concatenate([Q, *right_sides, -self._rows("bias", t, q, v)])[:, None]
        if self._scaling is None:
            self._scaling = equilibrating_units(K, n), len(independent_rows(rows)) < len(rows)
        forces = solve_scaled(K, right, *self._scaling)[first_stop:, 0]
        return Q + sum(coefficient * forces[place] * slides[k] for place, k, coefficient in self._slipping)

    def build(self, names: str) -> ConstrainedSystem:
        """Return the extended system."""
        system = self._system
        functions: dict[str, Any] = {
            kind: getattr(self, kind) for kind in ("constraint", "jacobian", "constraint_rate")
        }
        functions["mass"] = lambda t, q: self._call("mass", t, q)
        functions["force"] = self.force
        if "gamma" in system.given or system.n_c == 0:
            functions["gamma"] = self.gamma
        for kind in system.given:
            if kind.startswith("nonholonomic"):
                functions[kind] = getattr(system, kind)
        sizes: dict[str, Any] = {
            "n_q": system.n_q,
            "n_c": system.n_c + len(self._closed) + len(self._sticking),
            "n_a": system.n_a,
        }
        return ConstrainedSystem.from_python(**sizes, **functions, name=f"{system.name} on {names}")


class Accelerations:
    """Compute accelerations and multipliers of a system at any state, as in its runs."""

    def __init__(self, system: ConstrainedSystem, t: float, q: Array, v: Array, atol: Array):
        derived, _ = derive_callbacks(system, accept_traces)
        # any explicit method will do: only the accelerations at the start of its steps are used
        plan = DOP853().plan(system.n_q, 1e-8, 1e-8, False)
        self._run = Run(derived, plan, t, q, v, 1e-8, atol, None)
        if isinstance(branch_at(derived, t, self._run.state, self._run.rank, atol), Branch):  # the rank rises beside
            raise Undetermined(
                f"contact or friction of {system.name!r} must not begin in a singular position, as at t = {t:g}: the "
                "constraints have lost rank there, but not beside it. Start a little before that position, or beyond"
            )
        self._run.work.notes[indices.GENERATION] = 1.0  # the run has determined the ranks
        self._n = system.n_q
        self._last: tuple[tuple[float, bytes, bytes], Array] | None = None

    def evaluate(self, t: float, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the accelerations a (n_q,) and the multipliers [lam; mu]; NaN if they do not exist."""
        run, n, key = self._run, self._n, (t, q.tobytes(), v.tobytes())
        if self._last is None or self._last[0] != key:  # the events of all rows evaluate the same state
            state = np.concatenate([q, v, np.zeros(len(run.state) - 2 * n)])
            if entry_point(run.kernels.start)(run.kit, run.work, t, state) != indices.DONE:
                state[2 * n :] = np.nan
            self._last = key, state
        state = self._last[1]
        return state[2 * n : 3 * n], state[3 * n :]
