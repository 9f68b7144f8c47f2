"""One run: its arrays, the chunks that the compiled `advance` returns, and what to say of how it ended."""

import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.consistency import ConstraintWarning, dependent_rows, in_words, least_inertia, not_finite, pattern_of
from twoloop.dense import Interpolator
from twoloop.derivatives import wrong_derivative
from twoloop.kernels import common, intervals
from twoloop.linking import direct
from twoloop.plan import Plan, least_tolerance
from twoloop.recorder import Recorder, Wanted
from twoloop.result import Result, Statistics, Status, explained
from twoloop.stability import Looks, said_of_stiffness
from twoloop.system import ConstrainedSystem
from twoloop.workspace import kit_of, workspace

Array = NDArray[np.float64]

BUFFER_ROWS = 1024
BUFFER_STEPS = 4096
FIRST_CHUNK = 1024  # attempts of a small compiled system before Python looks at the run: a look costs 0.2 ms
FIRST_CHUNK_IN_PYTHON = 64  # ... of one whose callbacks are plain Python functions, which may be slow
SMALL = 32  # coordinates; chunks of larger systems are shorter in proportion
CHUNK_TO_EVENT = 16  # attempts where an event may end the run: what is computed beyond it is in vain
CHUNK_TIME = 0.05  # s of CPU; chunks that take longer do not grow, so that Ctrl-C is heard
FIRST_STEP = 0.01  # of the shortest time scale that the initial state shows
SHORTEST_STEP = 1e-16  # of the first step
STAGNATION_STEPS = 20_000  # accepted steps over which the pace is judged ...
STAGNATION_PACE = 1e-3  # ... against the longest step of the run, and ...
STAGNATION_LEFT = 1e7  # ... the steps that the rest of the run would take
CONTRADICTS = 1e-6  # relative: what the accelerations of redundant rows may differ by
# of the longest of the last steps: lengths tried for a step across a singular position, on which no stage should fall
BRIDGES = tuple(0.85**k for k in range(28))
CLEAR = 0.3  # of the largest pivot that C_q had: where the run's own steps go on
NEARLY_SINGULAR = 1e-3  # smallest over largest singular value of C_q, below which a message says so
# ends of which it may be said that stability limited the steps
EXPLAINED_BY_STIFFNESS = {Status.REACHED_END, Status.EVENT, Status.MAX_STEPS, Status.TIME_LIMIT, Status.STAGNATED}
NO_KINDS = np.zeros(0, dtype=np.int64)  # of intervals within which nothing is wanted
LATER_CHECKS = 3  # states of the run, beside the last, at which derivatives are checked again


class Run:
    """The arrays of one run, and the loop over its chunks.

    Raises
    ------
    ValueError
        If the accelerations at the start cannot be found.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        plan: Plan,
        t0: float,
        q0: Array,
        v0: Array,
        rtol: float,
        atol: Array,
        step_size: float | None,
        interiors: Mapping[int, Plan] = MappingProxyType({}),
    ):
        from twoloop.kernels import advance  # compiled, or read from the cache, at the first run of a process

        self.a = advance
        self.system, self.plan, self.t0 = system, plan, t0
        self.memory = plan.memory.copy()
        self.rtol, self.reuse, self.interiors = rtol, plan.reuse, interiors
        self.kit = kit_of(system, t0, q0, plan)
        self.functions = self.kit.functions
        n_rows = system.n_c + system.n_a
        self.state = np.concatenate([q0, v0, np.zeros(system.n_q + n_rows)])
        self.pattern = pattern_of(system, t0, q0)
        self.work = self._workspace()
        self.new_state = np.zeros_like(self.state)
        self.tolerances = np.zeros(common.ATOL + system.n_q)
        self.tolerances[common.RTOL] = rtol
        self.tolerances[common.ESTIMATE] = step_size is None
        self.tolerances[common.LEAST] = least_tolerance(rtol, float(atol.min()))
        self.tolerances[common.ATOL :] = atol
        self.control = np.zeros(advance.N_CONTROL)
        self.control[advance.SAFETY] = plan.safety
        self.control[advance.FACTOR_MIN] = plan.factor_min
        self.control[advance.FACTOR_MAX] = plan.factor_max
        self.control[advance.EXPONENT] = plan.exponent
        self.control[advance.MAX_STEP] = np.inf
        self.control[advance.FIXED_STEP] = 0.0 if step_size is None else step_size
        self.control[advance.LIMIT_START] = plan.limit_start
        self.control[advance.LIMIT_FACTOR] = plan.limit_factor
        self.control[advance.LIMIT_MEMORY] = plan.limit_memory
        self.control[advance.SYMMETRIC] = plan.symmetric
        self.control[advance.PREDICTIVE] = plan.predictive
        self.control[advance.LEAST_ERROR] = plan.least_error
        self.control[advance.MAX_STEPS] = np.inf
        self.control[advance.BRIDGE] = 1.0
        first_chunk = FIRST_CHUNK_IN_PYTHON if system.called_in_python else FIRST_CHUNK
        self.control[advance.MAX_ATTEMPTS] = max(1, first_chunk // max(1, system.n_q // SMALL))
        self.clock = np.zeros(advance.N_CLOCK)
        self.clock[advance.T] = self.clock[advance.T_START] = t0
        self.clock[advance.H_LIMIT] = plan.limit_start
        self.crossings: list[float] = []  # times near which steps went across a singular position
        self._begin()

    def _workspace(self, rank: int | None = None, rank_v: int | None = None) -> Any:
        """Arrays for ranks of C_q and of all rows; without them for full ones."""
        q0 = self.state[: self.system.n_q]
        work = workspace(self.system, self.kit, self.pattern, q0, self.rtol, self.reuse, (rank, rank_v))
        work.notes[common.NEARLY_SINGULAR] = 0.0 if self.plan.watchful else 1.0
        return work

    def _begin(self) -> None:
        code = self.a.start(self.kit, self.work, self.t0, self.state)
        if code == common.RANK_DIFFERS:
            ranks = [int(self.work.notes[place]) for place in (common.RANK, common.RANK_V)]
            self.work = self._workspace(*ranks)
            code = self.a.start(self.kit, self.work, self.t0, self.state)
        if code == common.GAMMA_INACCURATE:  # the first step says so, too, and that run has a result
            required = self.work.notes[common.GAMMA_REQUIRED]
            self.work.notes[common.GAMMA_REQUIRED] = np.inf
            code = self.a.start(self.kit, self.work, self.t0, self.state)
            self.work.notes[common.GAMMA_REQUIRED] = required
        n = self.system.n_q
        if code == common.DONE:
            self._warn_of_redundant_rows()
            return
        if code == common.MASS_NOT_DEFINITE:
            raise ValueError(
                f"mass of {self.system.name!r} must be positive definite on the velocities that the constraints allow; "
                f"at t = {self.t0!r} {least_inertia(self.system, self.t0, self.state[:n])[1]}"
            )
        if code == common.SINGULAR:
            raise ValueError(
                f"the accelerations of {self.system.name!r} cannot be found at t = {self.t0!r}: the constraint "
                f"Jacobian has lost rank there ({dependent_rows(self.system, self.t0, self.state[:n])}). Start from "
                "another position"
            )
        raise ValueError(
            f"the accelerations of {self.system.name!r} cannot be found at t = {self.t0!r}: {self._not_finite()}"
        )

    def _warn_of_redundant_rows(self) -> None:
        n_rows = self.system.n_c + self.system.n_a
        self.rank = len(self.work.rows_v)
        self.redundant = np.zeros(0, dtype=np.int64)
        if self.rank < n_rows:
            self.redundant = np.setdiff1d(np.arange(n_rows), self.work.rows_v)
            n = self.system.n_q
            rows, a = self.system.rows(self.t0, self.state[:n]), self.state[2 * n : 3 * n]
            off = np.abs(rows @ a - self.work.Gamma)
            allowed = CONTRADICTS * np.maximum(np.abs(rows) @ np.abs(a) + np.abs(self.work.Gamma), 1.0)
            wrong = np.flatnonzero(off > allowed).tolist()
            if wrong:
                raise ValueError(
                    f"the constraints of {self.system.name!r} contradict one another at t = {self.t0:g}: "
                    f"{in_words(rows, wrong)}, but not so their accelerations. Correct or leave out one of these rows"
                )
            warnings.warn(
                f"the constraints of {self.system.name!r} have rank {self.rank} of {n_rows} at t = {self.t0:g}: "
                f"{in_words(rows, self.redundant.tolist())}. They are left out of the solution and checked at every "
                "step; multipliers are those of least norm. See docs/constraints.md#redundant-rows",
                ConstraintWarning,
                stacklevel=4,
            )

    def set_sizes(self, first_step: float | None, max_step: float, t1: float) -> None:
        """Set the first and the largest step, s."""
        span = t1 - self.t0
        first = min(self._first_step(span) if first_step is None else first_step, span)
        self.clock[self.a.H_NEXT] = first
        self.control[self.a.SHORTEST] = SHORTEST_STEP * first
        self.control[self.a.MAX_STEP] = max_step

    def _first_step(self, span: float) -> float:
        """A share of the time in which the initial velocities and accelerations change the coordinates as a whole."""
        n = self.system.n_q
        q, v, a = (float(np.abs(self.state[k * n : (k + 1) * n]).max()) for k in range(3))
        q = max(q, float(self.tolerances[common.ATOL :].min()))  # all coordinates zero: there is no other length
        scales = [span]
        if v > 0.0:
            scales.append(q / v)
        if a > 0.0:
            scales.append(float(np.sqrt(q / a)))
        if v > 0.0 and a > 0.0 and v / a > FIRST_STEP * min(scales):  # not at what is next to rest
            scales.append(v / a)
        return FIRST_STEP * min(scales)

    def go(self, t1: float, wanted: Wanted, report: Any, time_limit: float | None, check_derivatives: bool) -> Result:
        """Advance to t1, chunk by chunk, and assemble the result; look at derivatives once more at the end."""
        deadline = np.inf if time_limit is None else time.monotonic() + time_limit
        a, system = self.a, self.system
        recorder = self._recorder(wanted)
        outputs = np.array([t1])
        if wanted.times is not None and wanted.lands:
            outputs = np.append(wanted.times[(wanted.times > self.t0) & (wanted.times < t1)], t1)
        self.control[a.STORE_ALL] = wanted.every_step
        largest_chunk = float(BUFFER_STEPS)
        if any(event.terminal < np.inf for event in wanted.events or []):
            largest_chunk = self.control[a.MAX_ATTEMPTS] = CHUNK_TO_EVENT
        step_parts = [np.array([[0.0, 0.0, 0.0, 1.0, 0.0]])]  # the first partition of a run is not a renewal
        filled = np.zeros(2, dtype=np.int64)
        advance, pace, looks = direct(a.advance), _Pace(self.t0), Looks(self.plan)
        cpu = 0.0
        code = a.PAUSED
        out_t, out_state, out_steps = self._buffers()
        plan, control, kit = self.plan, self.control, self.kit
        raised: Exception | None = None
        while code == a.PAUSED:
            across = plan is not self.plan
            began = time.process_time()
            try:
                code = advance(
                    kit,
                    self.work,
                    plan.options,
                    plan.memory,
                    self.tolerances,
                    control,
                    self.clock,
                    self.state,
                    self.new_state,
                    outputs,
                    out_t,
                    out_state,
                    out_steps,
                    filled,
                )
            except KeyboardInterrupt:
                code = INTERRUPTED
            except Exception as error:  # of a callback; beyond a terminal event it does not matter
                code, raised = INTERRUPTED, error
            n_rows, n_steps = filled.tolist()
            t, rows, steps = out_t[:n_rows], out_state[:n_rows], out_steps[:n_steps]
            sparse = 2 * n_rows < len(out_t)  # then copies take less room than the buffers
            if sparse:
                t, rows, steps = t.copy(), rows.copy(), steps.copy()
            step_parts.append(steps)
            kinds = self._kinds(steps, across) if wanted.between_steps else NO_KINDS
            recorder.add(t, rows, kinds)
            spent = time.process_time() - began
            cpu += spent
            filled[:] = 0  # for Ctrl-C before the next chunk begins
            if recorder.ended is not None:
                break
            if code == a.PAUSED and not across:
                looks.take(float(self.clock[a.T]), self.state, system.n_q, steps[:, a.H])
            if spent < CHUNK_TIME:
                self.control[a.MAX_ATTEMPTS] = min(2.0 * self.control[a.MAX_ATTEMPTS], largest_chunk)
            if not sparse or len(out_t) < min(self.control[a.MAX_ATTEMPTS], BUFFER_ROWS):
                out_t, out_state, out_steps = self._buffers()
            limited = self.control[a.MAX_STEPS] < np.inf
            if pace.stagnates(self.clock[a.T], steps[:, a.H], t1) and code == a.PAUSED and not limited:
                code = STAGNATED
            if code == a.PAUSED and time.monotonic() > deadline:
                code = OUT_OF_TIME
            if code == a.NEAR_SINGULAR:
                plan, control = self._bridge()
                kit = common.Kit(self.functions, self.kit.general, plan.step)
                code = a.PAUSED
            elif plan is not self.plan and code != a.ALL_OUTPUT_DONE:
                plan, control, code = self._beyond(plan, control, code, n_steps)
                kit = self.kit if plan is self.plan else kit
            report(self.clock[a.T])
        if wanted.between_steps:
            began = time.process_time()
            recorder.finish()
            cpu += time.process_time() - began
        if raised is not None and recorder.ended is None:
            raise raised
        t, table = recorder.output()
        steps, statistics = np.concatenate(step_parts), self._statistics(cpu)
        if recorder.ended is not None:
            event, end = recorder.ended
            steps = steps[: recorder.n_steps + 1]
            if recorder.n_steps > 0:
                steps[-1, a.H] = recorder.last_step
            status, message = Status.EVENT, f"{event.name} ended the run at t = {end:.10g}."
            statistics = replace(statistics, n_accepted=recorder.n_steps)
        else:
            status, message = self._outcome(code, t1, pace)
        n = system.n_q
        if check_derivatives and code != INTERRUPTED:
            last = (float(self.clock[a.T]), self.state) if recorder.ended is None else (float(t[-1]), table[-1])
            status, message = self._check_again(t, table, last, status, message)
        if status in EXPLAINED_BY_STIFFNESS:
            message += said_of_stiffness(looks, self.kit, self.work)
        errors, failures, partitions = np.diff(steps[:, a.ERRORS : a.JACOBIANS], axis=0).astype(np.int64).T
        t_events, q_events, v_events = recorder.events()
        return Result(
            t=t,
            q=table[:, :n].T,
            v=table[:, n : 2 * n].T,
            a=table[:, 2 * n : 3 * n].T,
            lam=table[:, 3 * n :].T,
            h=steps[1:, a.H],
            status=status,
            message=message + explained(status),
            stats=statistics,
            rank=self.rank,
            redundant=self.redundant,
            rejected_error=errors,
            rejected_convergence=failures,
            partitioned=partitions,
            untested=steps[1:, a.JACOBIANS] > 0.0,
            sol=recorder.solution(),
            t_events=t_events,
            q_events=q_events,
            v_events=v_events,
            system=system,
        )

    def _buffers(self) -> tuple[Array, Array, Array]:
        """Room for the states and steps of a chunk, each attempt of which fills one row at most."""
        most = int(self.control[self.a.MAX_ATTEMPTS])
        n_rows, n_steps = min(most, BUFFER_ROWS), min(most, BUFFER_STEPS)
        return np.empty(n_rows), np.empty((n_rows, len(self.state))), np.empty((n_steps, self.a.N_STEP_COLUMNS))

    def _recorder(self, wanted: Wanted) -> Recorder:
        """What takes the states; where some are to lie between steps, with what finds them."""
        n, interpolator = self.system.n_q, None
        if wanted.between_steps:
            ranks = (len(self.work.rows), len(self.work.rows_v))
            interpolator = Interpolator(self.system, self.t0, self.state[: 3 * n], self.rtol, ranks, self.interiors)
        return Recorder(wanted, interpolator, n, self.t0, self.state)

    def _kinds(self, steps: Array, across: bool) -> NDArray[np.int64]:
        """What kind of interval each of these accepted steps is, for the solution between them."""
        if across:
            return np.full(len(steps), intervals.ACROSS)
        if self.plan.apart:
            return np.full(len(steps), intervals.APART)
        return np.where(steps[:, self.a.JACOBIANS] > 0.0, intervals.VELOCITIES, intervals.ACCELERATIONS)

    def _bridge(self) -> tuple[Plan, Array]:
        """The plan and the controls for steps across a singular position, see kernels/bridge.py."""
        from twoloop.dop853 import DOP853
        from twoloop.kernels import bridge

        a, clock = self.a, self.clock
        self.crossings.append(float(clock[a.T]))
        plan = DOP853().plan(self.system.n_q, self.rtol, float(self.tolerances[common.ATOL :].min()), False)
        control = self.control.copy()
        control[a.SAFETY], control[a.EXPONENT], control[a.PREDICTIVE] = plan.safety, plan.exponent, 0.0
        control[a.FACTOR_MIN], control[a.FACTOR_MAX] = plan.factor_min, plan.factor_max
        control[a.SYMMETRIC], control[a.BRIDGE], control[a.MAX_ATTEMPTS] = 0.0, 0.0, 1.0
        clock[a.H_LIMIT], clock[a.LIMIT_AGE] = np.inf, 0.0
        self.lengths = [float(clock[a.H_LONG]) * part for part in BRIDGES]
        clock[a.H_NEXT] = self.lengths.pop(0)
        return replace(plan, step=bridge.bridging_step), control

    def _beyond(self, plan: Plan, control: Array, code: int, accepted: int) -> tuple[Plan, Array, int]:
        """What goes on after an attempt at a step across: the same, or the run's own steps again."""
        a = self.a
        if code == a.PAUSED and accepted == 0 and self.lengths:
            self.clock[a.H_NEXT], self.clock[a.H_LIMIT] = self.lengths.pop(0), np.inf
            return plan, control, code
        if code == a.PAUSED and accepted > 0 and (self.work.notes[common.PIVOT] < CLEAR * self.clock[a.LARGEST_PIVOT]):
            self.lengths = [float(self.clock[a.H_LONG]) * part for part in BRIDGES]
            return plan, control, code
        if code not in (a.PAUSED, a.STEP_TOO_SMALL, a.FIXED_STEP_FAILED, a.RANK_LOST):
            return plan, control, code
        if accepted == 0:  # there is no way across: the run's own steps go on as far as they can
            self.control[a.BRIDGE] = 0.0
        self.plan.memory[:] = self.memory
        self.clock[a.H_BEFORE] = self.clock[a.ERROR_BEFORE] = 0.0
        return self.plan, self.control, a.PAUSED

    def _crossed(self) -> str:
        """What a run that succeeded has to say of singular positions."""
        if not self.crossings:
            return ""
        times = ", ".join(f"{t:.4g}" for t in self.crossings[:3]) + (", ..." if len(self.crossings) > 3 else "")
        return (
            f" Near t = {times} steps went across positions where the constraints lose rank: beyond these, errors may "
            "exceed the tolerances."
        )

    def _statistics(self, cpu: float) -> Statistics:
        c = self.work.counters
        return Statistics(
            n_accepted=int(c[common.N_ACCEPTED]),
            n_rejected_error=int(c[common.N_REJECTED_ERROR]),
            n_rejected_convergence=int(c[common.N_REJECTED_CONVERGENCE]),
            n_outer=int(c[common.N_OUTER]),
            n_inner=int(c[common.N_INNER]),
            n_evaluations=int(c[common.N_EVALUATIONS]),
            n_partitions=int(c[common.N_PARTITIONS]),
            n_factorizations=int(c[common.N_FACTORIZATIONS]),
            n_jacobians=int(c[common.N_JACOBIANS]),
            cpu_time=cpu,
        )

    def _outcome(self, code: int, t1: float, pace: "_Pace") -> tuple[Status, str]:
        """Status and message for how the run ended."""
        a, t = self.a, float(self.clock[self.a.T])
        stopped = f"Stopped at t = {t:.10g}"
        failure = int(self.clock[a.FAILURE_CODE])
        if code == a.ALL_OUTPUT_DONE:
            fixed = ", with a constant step: no error was estimated" if self.control[a.FIXED_STEP] > 0.0 else ""
            return Status.REACHED_END, f"Reached the end, t = {t:g}{fixed}.{self._crossed()}"
        if code == INTERRUPTED:
            return (
                Status.INTERRUPTED,
                f"Interrupted from the keyboard at t = {t:.10g}. The result holds what was computed before.",
            )
        if code == a.MAX_STEPS_REACHED:
            return (
                Status.MAX_STEPS,
                f"{stopped} after max_steps = {int(self.control[a.MAX_STEPS])} accepted steps. Raise max_steps, loosen "
                "rtol and atol, or shorten t_span.",
            )
        if code == OUT_OF_TIME:
            return (
                Status.TIME_LIMIT,
                f"{stopped} by time_limit. Raise time_limit, loosen rtol and atol, or shorten t_span.",
            )
        if code == STAGNATED:
            return (
                Status.STAGNATED,
                f"{stopped}: the last {STAGNATION_STEPS} steps were {pace.mean:.2g} s long on average, after steps of "
                f"up to {pace.longest:.2g} s, and the rest needs {(t1 - t) / pace.mean:.1g} of them. Look for a "
                "singular position or a stiff force near this time, or take another method; with max_steps the run "
                "goes on up to that number of steps.",
            )
        if code == a.ROWS_VIOLATED:
            return Status.ROWS_CONTRADICT, self._contradiction()
        if failure == common.NOT_FINITE:
            return (
                Status.NOT_FINITE,
                f"{stopped}: {self._not_finite()}. The result holds what was computed before.",
            )
        if code == a.RANK_LOST or failure == common.SINGULAR:
            rows = dependent_rows(self.system, t, self.state[: self.system.n_q])
            return (
                Status.RANK_LOST,
                f"{stopped}: the constraint Jacobian has lost rank there ({rows}), so no choice of independent "
                "coordinates exists at this singular position, and no step led across: end t_span before, take another "
                "method, or change the geometry.",
            )
        if failure == common.GAMMA_INACCURATE:
            reached, required = self.work.notes[common.GAMMA_ACCURACY], self.work.notes[common.GAMMA_REQUIRED]
            return (
                Status.NOT_CONVERGED,
                f"{stopped}: gamma by differences of C_q and C_t is good to a relative error of {reached:.1g} there, "
                f"and rtol asks for {required:.1g}. Give gamma, or loosen rtol.",
            )
        reason = _REASONS[failure]
        if code == a.FIXED_STEP_FAILED:
            return (
                Status.NOT_CONVERGED,
                f"{stopped}: with the fixed step_size = {self.control[a.FIXED_STEP]:g} {reason}. Take a smaller "
                "step_size, or leave it out for step-size control.",
            )
        return (
            Status.STEP_TOO_SMALL,
            f"{stopped}: the step size fell below the spacing of floating-point numbers; at the last attempt {reason}. "
            f"{self._near_singular()}{self._near_massless()}Look for a discontinuity near this time, loosen rtol and "
            "atol, or use coordinates of similar scale.",
        )

    def _contradiction(self) -> str:
        """Which row that was left out is violated, and which rows it depended on."""
        t, n, row = float(self.clock[self.a.T]), self.system.n_q, int(self.work.notes[common.CONTRADICTION])
        words = in_words(self.system.rows(t, self.state[:n]), [row])
        return (
            f"Stopped at t = {t:.10g}: constraint row {row} depended on others at the start, was left out, and does "
            f"not hold along the motion that these allow ({words} at the last state). Either it contradicts them, or "
            "they are independent but for the start: start from another position, or correct the constraints."
        )

    def _near_singular(self) -> str:
        """A sentence where the constraint Jacobian is close to losing rank at the last state, else nothing."""
        rows = self.system.rows(float(self.clock[self.a.T]), self.state[: self.system.n_q])
        values = np.linalg.svd(rows, compute_uv=False)[: self.rank]
        if len(values) == 0 or values[-1] > NEARLY_SINGULAR * values[0]:
            return ""
        return (
            f"The constraint Jacobian is close to losing rank there: its smallest singular value is "
            f"{values[-1] / values[0]:.1g} of the largest. No step led across: end t_span before, take another "
            "method, or change the geometry. "
        )

    def _near_massless(self) -> str:
        """A sentence where some motion has next to no inertia at the last state, else nothing."""
        t, q = float(self.clock[self.a.T]), self.state[: self.system.n_q]
        ratio, words = least_inertia(self.system, t, q)
        return f"There {words}. " if ratio < NEARLY_SINGULAR else ""

    def _check_again(
        self, t: Array, table: Array, last: tuple[float, Array], status: Status, message: str
    ) -> tuple[Status, str]:
        """Status and message, unless a derivative is wrong where the run went."""
        n = self.system.n_q
        inner = np.arange(1, LATER_CHECKS + 1) * len(t) // (LATER_CHECKS + 1)
        states = [(float(t[k]), table[k, :n], table[k, n : 2 * n]) for k in np.unique(inner) if 0 < k < len(t)]
        states.append((last[0], last[1][:n], last[1][n : 2 * n]))
        for instant, q, v in states:
            wrong = wrong_derivative(self.system, instant, q, v)
            if wrong is not None:
                return Status.WRONG_DERIVATIVE, f"At t = {instant:.10g} of the run {wrong} {message}"
        return status, message

    def _not_finite(self) -> str:
        """Which callback returned a value that is not finite, and when, as far as it is known."""
        kind, at = int(self.work.notes[common.FAULT_KIND]), float(self.work.notes[common.FAULT_TIME])
        if kind >= 0:
            name = self.functions._fields[kind]
            return f"{name} of {self.system.name!r} returned a value that is not finite at t = {at:.10g}"
        n, t = self.system.n_q, float(self.clock[self.a.T])
        q, v = self.state[:n], self.state[n : 2 * n]
        end = t + float(self.clock[self.a.H_FAILED])
        for instant in (t, end):
            found = not_finite(self.system, instant, q, v)
            if found is not None:
                return f"{found} at t = {instant:.10g}"
        return (
            "the state became larger than floating-point numbers can be, or a callback returned a value that is not "
            "finite at a state within the step; none does at its start"
        )


INTERRUPTED, STAGNATED, OUT_OF_TIME = -1, -2, -3  # beside what advance() returns


class _Pace:
    """Lengths of the accepted steps, to see that a run does not get anywhere."""

    def __init__(self, t0: float):
        self.window_t, self.window_n = t0, 0
        self.longest = self.mean = 0.0

    def stagnates(self, t: float, h: Array, t1: float) -> bool:
        """Whether the run has come to a standstill, after accepted steps h that ended at t."""
        self.longest = max(self.longest, float(h.max(initial=0.0)))
        self.window_n += len(h)
        if self.window_n < STAGNATION_STEPS:
            return False
        self.mean = (t - self.window_t) / self.window_n
        self.window_t, self.window_n = t, 0
        return self.mean < STAGNATION_PACE * self.longest and t1 - t > STAGNATION_LEFT * self.mean


_REASONS = {
    common.DONE: "the error estimate stayed above the tolerances",
    common.OUTER_DIVERGED: "the outer loop (stages) did not converge",
    common.INNER_DIVERGED: "the inner loop (Newton on the positions) did not converge",
    common.SINGULAR: "the dependent columns of the constraint Jacobian became singular",
    common.MASS_NOT_DEFINITE: "the mass matrix was not positive definite",
    common.GAMMA_INACCURATE: "gamma by differences missed the tolerance",
}
