"""Integrate between the sampling times of a digital controller, at which parameters of forces may change."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import check_finite, check_real, shown
from twoloop.checks.consistency import check_start
from twoloop.checks.structure import dependent_rows, parts_of
from twoloop.generate.derived_callbacks import derive_callbacks, has_exact_derivatives
from twoloop.generate.traced_values import CallbackTraces
from twoloop.kernels.compile.callbacks import KINDS
from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import indices
from twoloop.methods.auto import Auto
from twoloop.methods.lobatto import Lobatto16
from twoloop.methods.plan import Method
from twoloop.methods.taylor import Taylor
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.fallbacks import (
    MAX_REPETITIONS,
    gap_for_repetition,
    may_have_missed_changes,
    tighten_tolerances,
    warn_of_missed_changes,
)
from twoloop.run.loop import IntegrationLoop, Interrupts
from twoloop.run.messages import warn_of_singular_end, warn_user
from twoloop.run.record import DEFAULTS, OutputRequest, Status, state_fields, statistics
from twoloop.run.run import Run
from twoloop.run.signals import signals_of
from twoloop.run.singular_start import branch_at

Array = NDArray[np.float64]

MAX_ATTEMPTS = 1024  # after this many attempted steps from one sampling time to the next, `IntegrationLoop` takes over
FORCE_KINDS = {"force", "force_by_q", "force_by_v"}  # parameters that change may enter these callbacks only
CHANGED_PARAMETERS = "the parameters changed at samples"  # value of `Result.changes` of a SampledRun


class SampledState(NamedTuple):
    """State at a sampling time t (s): q, v, a (n_q,), and multipliers lam (n_c + n_a,); the arrays are read-only.

    Examples
    --------
    >>> from twoloop import Integrator
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> integrator = Integrator(problem.system)
    >>> _ = integrator.start(0.0, problem.q0, problem.v0)
    >>> state = integrator.step(0.01)
    >>> state.t, state.q.shape, state.lam.shape
    (0.01, (9,), (8,))
    """

    t: float
    q: Array
    v: Array
    a: Array
    lam: Array


class SampledRun:
    """Integrate step by step between sampling times; the parameters of forces may change at these times.

    `set_parameters` overwrites parameters of `system`, so `system` must not be used elsewhere. Raise TypeError or
    ValueError if the start is invalid, or for Taylor and Lobatto16, whose generated code has fixed parameters.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        method: Method,
        rtol: float,
        atol: Array,
        max_step: float,
        derivatives: bool,
        t0: float,
        q0: Array,
        v0: Array,
    ):
        if isinstance(method, Taylor | Lobatto16):
            name = type(method).__name__
            raise ValueError(f"method of start and step must not be {name!r}, whose code is made for given parameters")
        if isinstance(method, Auto):
            method = replace(method, series=None, n_rows=system.n_c + system.n_a)
        check_start(
            system, t0, q0, v0, derivatives=derivatives, exact=lambda: has_exact_derivatives(system, t0, q0, v0)
        )

        def check(traced: CallbackTraces) -> None:
            traced.refuse_if_wrong(system, t0, t0 + 1.0, q0, v0)

        self._derived_system, _ = derive_callbacks(system, check)
        self._plan = method.plan(system.n_q, rtol, float(atol.min()), False)
        self.system, self.method, self.max_step, self.t0 = system, method, max_step, t0
        self._tolerances = rtol, atol
        self.run = self._create_run(t0, q0, v0)
        if self.run.start_warning:
            warn_user(self.run.start_warning)
        self.p = system.functions.p[system.called_in_python :]
        self._force_parameters: set[int] = set()  # indices of parameters that, according to checks, enter forces only
        self._parameters_changed = self._step_failed = False
        self._outputs, self._filled = np.zeros(1), np.zeros(2, dtype=np.int64)
        self._buffers = (
            np.empty(1),
            np.empty((1, len(self.run.state))),
            np.empty((MAX_ATTEMPTS, self.run.a.N_STEP_COLUMNS)),
        )
        self.rows, self.times, self.steps = list[Array](), list[float](), list[Array]()
        self.cpu_time, self._max_gap = 0.0, np.inf  # CPU time (s); longest allowed time (s) between samples of forces
        self._store_sample(t0)

    def _create_run(self, t: float, q: Array, v: Array) -> Run:
        """Return a run that starts at time t from (q, v); raise ValueError if q is a singular position."""
        run = Run(self._derived_system, self._plan.fresh(), t, q, v, *self._tolerances, None)
        allowed = self._tolerances[1] + self._tolerances[0] * np.abs(v).max()
        if run.fixed_order is None and branch_at(self._derived_system, t, run.state, run.rank, allowed) is not None:
            raise ValueError(
                f"start of {self.system.name!r} must not be a singular position, as at t = {t:g}: the constraints "
                f"have lost rank there ({dependent_rows(self._derived_system, t, q)}), but not beside it. Start a "
                "little before that position, or beyond; run and solve_dae may start there"
            )
        run.work.notes[indices.GENERATION] = 1.0  # as if a partition existed: kernels then keep the ranks of C_q and G
        run.set_step_sizes(None, self.max_step, t + 1.0)
        run.control[run.a.STORE_ALL] = 0.0
        return run

    @property
    def t(self) -> float:
        """Time (s) of the last stored state."""
        return self.times[-1]

    def set_parameters(self, inputs: Any) -> None:
        """Set parameters of forces; `inputs`: a mapping from parameter indices to values, or an array of all values."""
        if not self.p.size:
            raise ValueError(f"inputs are parameters, of which {self.system.name!r} has none: make it with parameters=")
        if isinstance(inputs, Mapping):
            for index, value in inputs.items():
                if type(index) is not int or not 0 <= index < len(self.p):
                    raise ValueError(
                        f"inputs must map places in the parameters, whole numbers from 0 to {len(self.p) - 1}, to "
                        f"numbers; given the place {shown(index)} (a name has its place by problem.place(name))"
                    )
                number = value if type(value) is float and abs(value) < np.inf else check_finite("inputs", value)
                if number != self.p[index]:
                    self._write_parameter(index, number)
            return
        values = check_real("inputs", inputs)
        if values.shape != self.p.shape or not np.isfinite(values).all():
            raise ValueError(
                f"inputs must be all {len(self.p)} parameters, finite, or a mapping from places to numbers; given "
                f"{shown(inputs)}"
            )
        for index in np.flatnonzero(values != self.p).tolist():
            self._write_parameter(index, float(values[index]))

    def step(self, dt: float) -> SampledState:
        """Integrate for a time dt (s) from the last stored state; store the final state, and return it."""
        end, began = self.times[-1] + dt, time.process_time()
        with signals_of(self.system):
            if self._step_failed:
                self._return_to_sample()
            self._step_failed = True  # remains True if a callback raises an exception before the step is complete
            self._step_to(end)
        self.cpu_time += time.process_time() - began
        self._store_sample(end)
        return self.state

    def _step_to(self, end: float) -> None:
        """Integrate to `end`; if short changes of forces may have been missed, integrate again with more samples."""
        for _ in range(MAX_REPETITIONS):
            self._integrate_to(end)
            if not may_have_missed_changes(self.run):
                return
            if len(self.times) > 1:  # earlier calls of `step` may also have missed short changes, but are not repeated
                warn_of_missed_changes(self.run)
            self._max_gap = gap_for_repetition(self.run)
            self._return_to_sample()
        self._integrate_to(end)
        warn_of_missed_changes(self.run)

    def _integrate_to(self, end: float) -> None:
        """Integrate once from the last stored state to the time `end`."""
        run, a, clock = self.run, self.run.a, self.run.clock
        t = self.times[-1]
        # Python callbacks may use variables that have changed since the last call of `step`: evaluate callbacks anew
        if self._parameters_changed or self.system.called_in_python:
            self._restart(t)
        run.choose_first_step(self.t0, end, run.state, run.max_step)
        run.control[a.TIME_SPACING] = min(self._max_gap, run.control[a.TIME_SPACING])
        self._outputs[0], clock[a.NEXT_OUTPUT], clock[a.T_START], clock[a.N_FIXED] = end, 0.0, t, 0.0
        run.control[run.a.MAX_ATTEMPTS], clock[a.PIVOT_AT_OUTPUT] = MAX_ATTEMPTS, np.inf
        code = run.advance(self._outputs, self._buffers, self._filled)
        self.steps.append(self._buffers[2][: self._filled[1]].copy())
        if code == a.MET_SINGULAR:
            tighten_tolerances(run)
        if code != a.ALL_OUTPUT_DONE:
            self._finish_by_loop(end)
        else:
            warn_of_singular_end(run)

    @property
    def state(self) -> SampledState:
        """Last stored state."""
        row, n = self.rows[-1], self.run.system.n_q
        return SampledState(self.times[-1], row[:n], row[n : 2 * n], row[2 * n : 3 * n], row[3 * n :])

    def _store_sample(self, t: float) -> None:
        row = self.run.state.copy()
        row.setflags(write=False)
        self.rows.append(row)
        self.times.append(t)
        self._n_steps, self._step_failed = len(self.steps), False

    def fields(self) -> dict[str, Any]:
        """Return the fields of a `Result` with all stored states, one for each sampling time so far."""
        run, a = self.run, self.run.a
        steps = np.concatenate([np.empty((0, a.N_STEP_COLUMNS)), *self.steps[: self._n_steps]])
        fields: dict[str, Any] = {"h": steps[:, a.H], "untested": steps[:, a.JACOBIANS] > 0.0}
        fields |= state_fields(run.system.n_q, np.array(self.times), np.array(self.rows))
        fields |= {
            "rank": run.rank,
            "redundant": run.redundant.copy(),
            "stats": statistics(run.work.counters, self.cpu_time),
        }
        message = f"Stepped to t = {self.t:g} in {len(self.times) - 1} samples."
        fields |= {"status": Status.REACHED_END, "message": message, "changes": CHANGED_PARAMETERS}
        return DEFAULTS | fields | {"widest_gap": float(run.work.notes[indices.WIDEST_GAP])}

    def _restart(self, t: float) -> None:
        """Compute the accelerations at t with the new parameters; make the method forget all steps before t."""
        run, a = self.run, self.run.a
        code = entry_point(run.kernels.start)(run.kit, run.work, t, run.state)
        n_not_reset = 0
        if run.plan.first is not None:  # a pair of methods keeps the estimates and counts that decide when it switches
            from twoloop.kernels.control.stiffness import N_SCALARS

            n_not_reset = N_SCALARS + 2 * run.system.n_q
        run.plan.memory[n_not_reset:] = run.memory[n_not_reset:]
        run.clock[: a.N_PAST] = 0.0
        if code != indices.DONE:
            raise RuntimeError(
                f"the accelerations of {self.system.name!r} cannot be found at t = {t:.10g} with the inputs given: the "
                "forces are not finite, or the constraints have lost rank"
            )
        self._parameters_changed = False

    def _return_to_sample(self) -> None:
        """Discard the last integration, which failed or has to be repeated: make a new run at the last stored state."""
        old_run, n = self.run, self.system.n_q
        try:
            self.run = self._create_run(self.t, self.rows[-1][:n], self.rows[-1][n : 2 * n])
        except ValueError as error:
            raise RuntimeError(f"step goes on from the last sample, where it cannot begin: {error}") from None
        self.run.work.counters[:] = old_run.work.counters
        del self.steps[self._n_steps :]
        self._parameters_changed = False

    def _finish_by_loop(self, end: float) -> None:
        """Integrate to `end` by IntegrationLoop, because `advance` stopped earlier; raise RuntimeError on failure."""
        run = self.run
        run.t0, run.start_warning = float(run.clock[run.a.T]), ""
        interrupts = Interrupts().install_handlers()
        try:
            output = OutputRequest(np.array([end]), ends_at_outputs=True)
            record = IntegrationLoop(run, end, output, interrupts).integrate_to_end(False)
        finally:
            interrupts.restore_handlers()
        run.control[run.a.STORE_ALL], run.work.notes[indices.NEXT_JUMP] = 0.0, np.inf
        steps = np.zeros((len(record.h), run.a.N_STEP_COLUMNS))
        steps[:, run.a.H], steps[:, run.a.JACOBIANS] = record.h, record.untested
        self.steps.append(steps)
        if record.status != Status.REACHED_END:
            raise RuntimeError(f"step of {self.system.name!r}: {record.message}")

    def _write_parameter(self, index: int, value: float) -> None:
        if index not in self._force_parameters:
            self._check_enters_forces_only(index, value)
        self.p[index] = value
        self._parameters_changed = True

    def _check_enters_forces_only(self, index: int, value: float) -> None:
        """Raise ValueError if a new `value` of parameter `index` changes more than forces: states would jump."""
        old_value, n = float(self.p[index]), self.system.n_q
        t, row = self.times[-1], self.rows[-1]
        state = {"q": row[:n], "v": row[n : 2 * n]}
        for kind in sorted(self.system.given.keys() - self.system.scattered - FORCE_KINDS):
            if not set(KINDS[kind].state) <= set(state):
                continue
            values = []
            for trial_value in (old_value, value, 0.5 * old_value + 1.37):
                self.p[index] = trial_value
                values.append(np.concatenate([np.ravel(x) for x in parts_of(self._evaluate(kind, t, state))]))
            self.p[index] = old_value
            if any((output != values[0]).any() for output in values[1:]):
                raise ValueError(
                    f"inputs must enter forces alone; that at place {index} enters {kind} of {self.system.name!r}, "
                    "which cannot change between samples: positions or momenta would jump; start anew with others"
                )
        self._force_parameters.add(index)

    def _evaluate(self, kind: str, t: float, state: dict[str, Array]) -> Any:
        return self.system.evaluate(kind, t, *(state[name] for name in KINDS[kind].state))
