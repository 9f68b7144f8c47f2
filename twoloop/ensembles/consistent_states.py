"""Project many guesses onto the constraints at once (`consistent_states`)."""

from __future__ import annotations  # so that help() shows the name ArrayLike

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import Array, check_finite, check_indices
from twoloop.ensembles.lanes import Integers, aligned_zeros, run_in_blocks, threads_of
from twoloop.ensembles.starts import Starts, all_starts, generic_parameters, is_inconsistent, system_of, writable_kit
from twoloop.generate.graph import Untraceable
from twoloop.generate.parameter_expressions import ParameterTape
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.run.projection import ConsistentState, consistent_state

if TYPE_CHECKING:
    from twoloop.generate.lane_code import GeneratedLanes, LaneConstraints

MAX_ROWS = 200  # largest number of constraints for SIMD lanes, which use dense factors
SECONDS_PER_CALL = 0.01  # estimated time of one call of `consistent_state`, s


def consistent_states(
    system: ConstrainedSystem,
    t: float,
    q: ArrayLike,
    v: ArrayLike,
    *,
    parameters: ArrayLike | None = None,
    keep: Sequence[int] | None = None,
) -> tuple[Array, Array]:
    """Project many guesses onto the constraints, each by the least change, as `consistent_state` does with one.

    Guesses near the constraints are projected together, by Gauss-Newton in SIMD lanes on all cores, with the equations
    that were traced from the callbacks. The callbacks themselves then check each result. `consistent_state` projects
    the others one at a time: guesses farther away, large systems, systems with nonholonomic rows or with callbacks that
    cannot be traced, and guesses that are too few for code to be compiled.

    Parameters
    ----------
    system : ConstrainedSystem
    t : float
        Time, s.
    q, v : array_like (n_q,) or (n_runs, n_q)
        Guesses: one for all, or one for each.
    parameters : array_like (n_runs, n_p), optional
        Parameters of each run, instead of `system.parameters`.
    keep : sequence of int, optional
        Coordinates whose position and velocity are not changed. None: all may change.

    Returns
    -------
    q, v : ndarray (n_runs, n_q)

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, or a guess cannot be projected: the message of `consistent_state` with its number.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop import consistent_states
    >>> from twoloop.mechanisms import pendulum
    >>> problem = pendulum()
    >>> q, v = consistent_states(problem.system, 0.0, [[0.6, -0.9], [0.9, -0.6]], np.zeros((2, 2)))
    >>> q.shape, bool(abs(np.hypot(*q.T) - 1.0).max() < 1e-12)
    ((2, 2), True)
    """
    check_system(system)
    t = check_finite("t", t)
    starts = all_starts(system, t, q, v, parameters, ("q", "v"))
    kept = [] if keep is None else check_indices("keep", keep, system.n_q)
    may_change = np.array([j not in kept for j in range(system.n_q)], dtype=np.int64)

    def project_one(run: int) -> ConsistentState:
        try:
            return consistent_state(system_of(system, starts, run), t, starts.q[run], starts.v[run], keep=keep)
        except ValueError as error:
            raise ValueError(f"guess {run}: {error}") from error

    is_valid = np.zeros(len(starts.q), dtype=bool)
    new_q, new_v = starts.q.copy(), starts.v.copy()
    with suppress(Untraceable):
        lanes = _LaneProjection(system, starts)
        new_q, new_v, is_valid = lanes.project(starts, may_change, 0)
        remaining = np.flatnonzero(~is_valid)
        for run in remaining[:1].tolist():  # redundant rows may be the reason: project one guess, to count them
            projected = project_one(run)
            n_redundant = system.n_c - len(projected.dependent)
            if n_redundant > 0:
                new_q[remaining], new_v[remaining], is_valid[remaining] = lanes.project(
                    starts.subset(remaining), may_change, n_redundant
                )
            if not is_valid[run]:
                new_q[run], new_v[run], is_valid[run] = *projected, True
    # callbacks that were not traced may write beyond their arrays, which only single calls detect: do not call them
    traced = np.flatnonzero(is_valid)
    projections = Starts(t, new_q[traced], new_v[traced], starts.parameters[traced])
    is_valid[traced] = ~is_inconsistent(writable_kit(system), projections)
    for run in np.flatnonzero(~is_valid).tolist():
        new_q[run], new_v[run] = project_one(run)
    return new_q, new_v


class _LaneProjection:
    """Generated code that projects guesses onto the constraints of a system, in SIMD lanes.

    Raise Untraceable if code cannot be generated, or is not worth its compilation; the message says why.
    """

    def __init__(self, system: ConstrainedSystem, starts: Starts):
        if system.n_a > 0:
            raise Untraceable("it has nonholonomic rows")
        if system.n_c > MAX_ROWS:
            raise Untraceable("single calls have sparse matrices")
        generic, varying = generic_parameters(starts.parameters)

        def generate() -> GeneratedLanes[LaneConstraints]:
            from twoloop.generate.lane_code import GeneratedLanes, LaneConstraints

            tape = ParameterTape(generic.tolist(), varying)
            return GeneratedLanes(tape, LaneConstraints(system, tape.parameters))

        self._generated = system.remembered_at(("starts", tuple(varying)), generic.tobytes(), generate)
        if self._generated.seconds_to_build > SECONDS_PER_CALL * len(starts.q):
            raise Untraceable("it is not worth the code for so few")

    def project(self, starts: Starts, may_change: Integers, n_redundant: int) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Project guesses; return positions, velocities, and which of them are valid.

        `may_change`: 1 for coordinates that may change. `n_redundant`: number of constraints that depend on the others.
        """
        from twoloop.kernels.lanes import layout
        from twoloop.kernels.lanes import starts as kernels

        generated, code, q, v = self._generated, self._generated.code, starts.q.copy(), starts.v.copy()
        is_valid = np.zeros(len(q), dtype=np.int64)
        n, n_rows = code.n, code.n_rows
        kit = layout.LaneKit(generated.functions)
        settings = np.array([n, n_rows, 0, 0, code.n_numbers, n_redundant], dtype=np.int64)
        control = np.concatenate([[starts.t0], np.zeros(layout.ATOL - 1 + n), code.numbers.values])
        n_vectors = (
            layout.array_offsets(n, n_rows, code.n_numbers)[-1]
            + kernels.offsets_in_memory(0, n, n_rows, len(code.pattern) - n_rows - 1, n_redundant)[-1]
        )

        def project_block(rows: slice) -> None:
            workspace, numbers = (
                aligned_zeros(n_vectors, layout.LANES),
                generated.coefficients_for(starts.parameters[rows]),
            )
            inputs = code.pattern, may_change, numbers, q[rows], v[rows]
            kernels.start_lanes(kit, settings, control, *inputs, is_valid[rows], workspace)

        run_in_blocks(project_block, len(q), threads_of(None))
        return q, v, is_valid == 1
