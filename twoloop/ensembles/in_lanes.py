"""Runs of one system in lanes: blocks of runs, taken by threads; what is left to single runs, and why."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array
from twoloop.ensembles.lane_methods import LaneMethod
from twoloop.ensembles.short_looks import ShortLooks
from twoloop.ensembles.starts import Starts, generic_parameters, generic_system, kit_to_write, system_of
from twoloop.generate.choices import Choice
from twoloop.generate.parameter_expressions import ParameterTape
from twoloop.generate.time_dependence import may_be_narrow, may_be_sudden
from twoloop.kernels.lanes import lane_ends
from twoloop.problem.system import ConstrainedSystem

if TYPE_CHECKING:
    from twoloop.generate.generated_lanes import GeneratedLanes
    from twoloop.generate.lane_code import LaneCode

Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

PLACES = 100  # of a run, at least as many at which the equations are looked at ...
OF_SUDDEN = 20  # ... times as many where a force may act for a short time: lanes do not look ahead
SMALLEST, LARGEST = 128, 4096  # runs of a block; numbers of all of a block's runs are made at once
FOR_EACH = 3  # blocks for each of several threads, so that all end at about the same time
LOOKS = PLACES * OF_SUDDEN
SHORT = min(lane_ends.NO_START, lane_ends.UNLIKE) - 1  # beside what lane_ends.py says
AGREES = 1e-7  # of the terms of an equation: what rounding may leave of it at the end of a run

WHY = {  # a run is left to a run of its own, by what lane_ends.py says of it
    lane_ends.NO_START: "the code made for the first run does not hold at the start",
    lane_ends.NO_STATE: "a state at t_eval could not be put on the constraints",
    lane_ends.NO_VALUES: "the equations have no values in a step (constraints lose rank, a root of a negative number)",
    lane_ends.OFTEN_REFUSED: "steps are refused again and again (a sudden force, stiff motion, a singular position)",
    lane_ends.MANY_STEPS: "it takes more than 100,000 steps in lanes (stiff, or very fast motion)",
    lane_ends.UNLIKE: "the callbacks do not agree with the code at the end (they branch)",
    SHORT: "forces or drives change for so short a time that lanes may miss others",
}


class LaneRuns:
    """The code of a system for lanes, and what it makes of many runs.

    Parameters
    ----------
    system : ConstrainedSystem
    starts : Starts
    method : LaneMethod

    Raises
    ------
    Untraceable
        Saying why lanes cannot do it.
    """

    def __init__(self, system: ConstrainedSystem, starts: Starts, method: LaneMethod):
        self.system, self.starts, self.method, self.kit = system, starts, method, kit_to_write(system)
        generic, varying = generic_parameters(starts.parameters)
        of_all = generic_system(system, starts)
        sudden = may_be_sudden(of_all, ran_on_symbols=True)
        unseen = 1.0 if may_be_narrow(of_all, ran_on_symbols=True) else method.unseen
        self.places = LOOKS if any(sudden) else PLACES * unseen
        self.looks = ShortLooks(system, generic, varying) if sudden.by_time else None
        choice = Choice.at(system_of(system, starts, 0), starts.t0, starts.q[0])
        kind = ("lanes", method.series, method.tableau is None, choice, tuple(varying))  # of which the latest is kept

        def make() -> GeneratedLanes[LaneCode]:
            from twoloop.generate.generated_lanes import GeneratedLanes
            from twoloop.generate.lane_code import LaneCode  # compiled, or read from the cache, at the first ensemble

            record = ParameterTape(generic.tolist(), varying)
            return GeneratedLanes(record, LaneCode(system, choice, record.parameters, method.series, method.tableau))

        self.own = system.remembered_at(kind, generic.tobytes(), make)

    def make(
        self,
        which: Integers,
        t1: float,
        times: Array,
        rtol: float,
        atol: Array,
        threads: int,
        out_q: Array,
        out_v: Array,
    ) -> tuple[Integers, Integers, Integers, Array]:
        """Make these runs: what became of each, as lane_ends.py has it, steps, evaluations, a and lam at the end."""
        n_runs = len(which)
        status, n_steps, n_evaluations = np.zeros((3, n_runs), dtype=np.int64)
        n_evaluations += 1  # at the start
        ends = np.full((n_runs, self.system.n_q + self.system.n_c), np.nan)

        def block(rows: slice) -> None:
            out = out_q[rows], out_v[rows], ends[rows]
            told = status[rows], n_steps[rows], n_evaluations[rows]
            self._make(which[rows], t1, times, rtol, atol, out, told)

        in_blocks(block, n_runs, threads)
        return status, n_steps, n_evaluations, ends

    def _make(
        self,
        which: Integers,
        t1: float,
        times: Array,
        rtol: float,
        atol: Array,
        out: tuple[Array, Array, Array],
        told: tuple[Integers, Integers, Integers],
    ) -> None:
        from twoloop.kernels.lanes import lane_room, lane_runs

        starts, code, method = self.starts, self.own.code, self.method
        n, n_rows = code.n, code.n_rows
        numbers = self.own.numbers(starts.parameters[which])
        begin = lane_room.places(n, n_rows, code.n_numbers)[-1]
        room = aligned(begin + method.memory(code), lane_room.LANES)
        kit = lane_room.LaneKit(self.own.functions, method.step())
        redundant = bool(code.equations.redundant.conditions)
        settings = np.array([n, n_rows, method.order, redundant, code.n_numbers, method.evaluations], dtype=np.int64)
        control = np.concatenate([[starts.t0, t1, (t1 - starts.t0) / self.places, rtol], atol, code.numbers.values])
        given = np.ascontiguousarray(starts.q[which]), np.ascontiguousarray(starts.v[which])
        arrays = times, numbers, *given, *out, *told, room
        lane_runs.advance_lanes(kit, settings, control, method.options, *arrays)

    def agree(self, which: Integers, made: Flags, t1: float, atol: float, q: Array, v: Array, ends: Array) -> Flags:
        """Of which of these runs, of those that were made, callbacks say that the equations hold at their end.

        q, v : (n_runs, n, n_t), the last at the end; ends : a and lam there.
        """
        from twoloop.kernels.evaluation.residuals import disagreement

        n, n_c = self.system.n_q, self.system.n_c
        room, worst = np.zeros(n * (n + 3) + n_c * (n + 3)), np.full(len(which), np.inf)
        rows = np.where(made, which, -1)
        disagreement(*self.kit, t1, AGREES, atol, rows, self.starts.parameters, q, v, ends, room, worst)
        agreed: Flags = worst <= 1.0
        return agreed

    def judge(
        self,
        which: Integers,
        status: Integers,
        t1: float,
        rtol: float,
        atol: float,
        q: Array,
        v: Array,
        ends: Array,
    ) -> Flags:
        """Of which of these runs all states were found and agree; the status of others says why not."""
        made = status == lane_ends.ENDED
        found = np.isfinite(q).all(axis=(1, 2))
        fine = made & found
        status[made & ~found] = lane_ends.NO_STATE
        agreed = self.agree(which, fine, t1, atol, q, v, ends)
        status[fine & ~agreed] = lane_ends.UNLIKE
        fine &= agreed
        if self.looks is not None:
            times, runs = np.linspace(self.starts.t0, t1, LOOKS + 1), np.flatnonzero(fine)
            given = self.starts.parameters[which[runs]], q[runs, :, -1], v[runs, :, -1]
            short = runs[self.looks.meet(times, rtol, *given)]
            status[short], fine[short] = SHORT, False
        return fine


def in_blocks(make: Callable[[slice], None], n_runs: int, threads: int) -> None:
    """Have blocks of runs made, by so many threads."""
    n_blocks = 1 if threads == 1 else FOR_EACH * threads
    size = int(np.clip(-(-n_runs // n_blocks), SMALLEST, LARGEST))
    blocks = [slice(begin, min(begin + size, n_runs)) for begin in range(0, n_runs, size)]
    if threads == 1 or len(blocks) == 1:
        for rows in blocks:
            make(rows)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(make, blocks))


def aligned(vectors: int, lanes: int) -> Array:
    """Zeros whose address a vector of all lanes may have."""
    size = 8 * lanes
    room = np.zeros(vectors * lanes + lanes)
    first = -room.ctypes.data % size // 8
    return room[first : first + vectors * lanes]


def threads_of(wanted: int | None) -> int:
    """How many threads: those that are wanted, else one for each core that this process may use."""
    if wanted is not None:
        return wanted
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
