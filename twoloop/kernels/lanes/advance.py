"""Integration loop of runs in lanes: each lane has its own step size, and starts a new run when its run has ended.

If the generated code is not valid at a state, or if many successive steps are rejected, a run is removed from its lane,
and repeated outside the lanes later. The method's function `code.step` takes the steps. `work` is the memory of all
lanes, see layout.py; STATE is the state at the beginning of a step, and NEW the state at its end.
"""

import numpy as np
from numba import types

from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.data.common import INTEGERS, compiled, kernel
from twoloop.kernels.lanes import layout as at
from twoloop.kernels.lanes.layout import CODE, LANES, fill_field, offsets_in_work, project_lanes, remove_run

TABLE, STATES = types.float64[:, ::1], types.float64[:, :, ::1]


@compiled
def _refill_lanes(code, order, control, work, n, n_rows, numbers, q0, v0, next_run, status):
    """Start runs in idle lanes; return the index of the next run to be started, and the number of lanes with a run."""
    state, new, _, _, _, _, own, _ = offsets_in_work(n, n_rows, numbers.shape[1])
    n_fresh, n_running = 0, 0
    for k in range(LANES):
        previous_run = int(work[at.RUN * LANES + k])
        # the generated code of a Taylor method only sets RUNNING = 0 to end a run: store the reason in `status` here
        if work[at.RUNNING * LANES + k] == 0.0 and previous_run >= 0 and status[previous_run] == at.UNDECIDED:
            status[previous_run] = at.MANY_REJECTIONS if work[at.N_REJECTED * LANES + k] < np.inf else at.NO_VALUES
        work[at.ACTIVE * LANES + k] = work[at.IS_NEW * LANES + k] = 0.0
        if work[at.RUNNING * LANES + k] == 0.0 and next_run < numbers.shape[0]:
            work[at.ACTIVE * LANES + k] = work[at.IS_NEW * LANES + k] = work[at.RUNNING * LANES + k] = 1.0
            work[at.T * LANES + k] = work[at.T_NEW * LANES + k] = control[at.T0]
            work[at.N_REJECTED * LANES + k] = work[at.N_OUTPUTS * LANES + k] = 0.0
            work[at.RUN * LANES + k] = next_run
            for j in range(n):
                work[(new + j) * LANES + k], work[(new + n + j) * LANES + k] = q0[next_run, j], v0[next_run, j]
            for i in range(numbers.shape[1]):
                work[(own + i) * LANES + k] = numbers[next_run, i]
            next_run += 1
            n_fresh += 1
        n_running += int(work[at.RUNNING * LANES + k])
    if n_fresh > 0:
        for k in range(LANES):
            work[at.REQUESTED * LANES + k] = work[at.ACTIVE * LANES + k]
        project_lanes(code, order, control, work)
        for k in range(LANES):
            if work[at.REQUESTED * LANES + k] == 1.0:
                for j in range(2 * n):
                    work[(state + j) * LANES + k] = work[(new + j) * LANES + k]
                if work[at.ACTIVE * LANES + k] == 0.0:
                    remove_run(work, status, k, at.NO_START)
                    n_running -= 1
    return next_run, n_running


@compiled
def _write_states_in_steps(code, settings, control, options, work, n, new, times, out_q, out_v, status, n_steps):
    """In lanes with an accepted step, store the states at output times within the step: NaN if a projection fails."""
    while True:
        n_requested = 0
        for k in range(LANES):
            i_time = int(work[at.N_OUTPUTS * LANES + k])
            work[at.ACTIVE * LANES + k] = work[at.X * LANES + k] = 0.0
            if work[at.ACCEPTED * LANES + k] == 1.0 and i_time < times.size:
                step_end = work[at.T * LANES + k] + work[at.H * LANES + k]
                if times[i_time] < step_end and times[i_time] < control[at.T1]:
                    work[at.ACTIVE * LANES + k], n_requested = 1.0, n_requested + 1
                    work[at.X * LANES + k] = times[i_time] - work[at.T * LANES + k]
                    work[at.T_NEW * LANES + k] = times[i_time]
            work[at.REQUESTED * LANES + k] = work[at.ACTIVE * LANES + k]
        if n_requested == 0:
            return
        code.step(code, settings, control, options, work, status, n_steps, True)
        project_lanes(code, settings[at.ORDER], control, work)
        for k in range(LANES):
            if work[at.REQUESTED * LANES + k] == 1.0:
                run, i_time = int(work[at.RUN * LANES + k]), int(work[at.N_OUTPUTS * LANES + k])
                work[at.N_OUTPUTS * LANES + k] += 1.0
                for j in range(n):
                    is_valid = work[at.ACTIVE * LANES + k] == 1.0
                    out_q[run, j, i_time] = work[(new + j) * LANES + k] if is_valid else np.nan
                    out_v[run, j, i_time] = work[(new + n + j) * LANES + k] if is_valid else np.nan


@compiled
def _write_final_states(work, control, n, n_rows, new, a, last, out_q, out_v, out_a, status):
    """End the runs whose accepted step ends at t1, which is the output time number `last`; store their final states."""
    for k in range(LANES):
        if work[at.ACCEPTED * LANES + k] == 0.0 or work[at.H * LANES + k] != control[at.T1] - work[at.T * LANES + k]:
            continue
        run = int(work[at.RUN * LANES + k])
        work[at.RUNNING * LANES + k], status[run] = 0.0, at.ENDED
        for j in range(n):
            out_q[run, j, last], out_v[run, j, last] = work[(new + j) * LANES + k], work[(new + n + j) * LANES + k]
        for j in range(n + n_rows):  # accelerations and multipliers, which are adjacent in `work`
            out_a[run, j] = work[(a + j) * LANES + k]


@compiled
def _count_evaluations(settings, work, n_evaluations):
    """For each run in a lane, add the number of evaluations in its last step to its entry of n_evaluations (n_runs)."""
    for k in range(LANES):
        if work[at.RUNNING * LANES + k] == 1.0:
            n_within = settings[at.N_EVALUATIONS] + int(work[at.EVALUATED * LANES + k])
            n_evaluations[int(work[at.RUN * LANES + k])] += n_within + 1  # + 1: the evaluation at the end of the step


@compiled
def _advance_time(work, control, n_steps):
    """In lanes whose step was accepted, add its size to the time T; count the step in `n_steps` (n_runs)."""
    for k in range(LANES):
        if work[at.ACCEPTED * LANES + k] == 1.0:
            h, t = work[at.H * LANES + k], work[at.T * LANES + k]
            n_steps[int(work[at.RUN * LANES + k])] += 1
            work[at.T * LANES + k] = control[at.T1] if h == control[at.T1] - t else t + h
            work[at.N_REJECTED * LANES + k] = 0.0


_ADVANCE_SIGNATURE = types.void(
    CODE, INTEGERS, *[VECTOR] * 3, *[TABLE] * 3, *[STATES] * 2, TABLE, *[INTEGERS] * 3, VECTOR
)


@kernel(_ADVANCE_SIGNATURE)
def advance_lanes(
    code, settings, control, options, times, numbers, q0, v0, out_q, out_v, out_a, status, n_steps, n_evaluations, work
):
    """Integrate runs, one for each row of `numbers`, from t0 to t1; for `settings`, `control`, `work` see layout.py.

    options : options of the method, see control.py; times : (n_t,) output times, the last of which is t1; numbers :
    (n_runs, n_numbers) data of the generated code; q0, v0 : (n_runs, n) initial states. Results are stored in out_q and
    out_v : (n_runs, n, n_t) states at `times`; out_a : (n_runs, n + n_rows) accelerations and multipliers at t1;
    status : (n_runs,) codes, such as ENDED; n_steps, n_evaluations : (n_runs,) counts, which are increased.
    """
    n, n_rows, order = settings[at.N], settings[at.N_ROWS], settings[at.ORDER]
    _, new, _, _, a, _, _, _ = offsets_in_work(n, n_rows, numbers.shape[1])
    next_run, has_new_runs = 0, False
    for field in (at.T, at.T_NEW, at.H, at.X, at.RUNNING, at.ACCEPTED):
        fill_field(work, field, 0.0)
    fill_field(work, at.UNIT, 1.0)
    fill_field(work, at.RUN, -1.0)
    while True:
        n_running = 0.0
        for k in range(LANES):
            n_running += work[at.RUNNING * LANES + k]
        if n_running < LANES or has_new_runs:
            first_new_run = next_run
            next_run, n_used = _refill_lanes(code, order, control, work, n, n_rows, numbers, q0, v0, next_run, status)
            has_new_runs = next_run > first_new_run
            if n_used == 0:
                if next_run == numbers.shape[0]:
                    return
                continue
        fill_field(work, at.EVALUATED, 0.0)
        code.step(code, settings, control, options, work, status, n_steps, False)
        _count_evaluations(settings, work, n_evaluations)
        code.commit(order, control, work)
        _write_final_states(work, control, n, n_rows, new, a, times.size - 1, out_q, out_v, out_a, status)
        if times.size > 1:
            _write_states_in_steps(code, settings, control, options, work, n, new, times, out_q, out_v, status, n_steps)
        _advance_time(work, control, n_steps)
