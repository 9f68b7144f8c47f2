"""Repeat runs that may have missed short changes of forces, and compute velocities after a jump of C_t or b.

A run that met a short change is repeated with more evaluations, at most MOST times: changes that follow one another
without end, as noise does, would take evaluations without end. Then a warning says so.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from twoloop.problem.system import ConstrainedSystem
from twoloop.run.messages import warn_user

if TYPE_CHECKING:
    from twoloop.run.run import Run

WITHIN = 2.0  # gaps between evaluations: a run that met a shorter change is repeated, as others may be shorter still
SEEN = 1.25  # gaps between evaluations: longer changes cannot fall between two of them; of shorter ones the run warns
CLOSER = 4.0  # evaluations within the shortest change when the run is repeated ...
MOST_CLOSER = 8.0  # ... but at most so many times as many evaluations as before
MOST = 2  # largest number of repetitions of a run


def may_have_missed_changes(run: "Run", looks: float = WITHIN) -> bool:
    """Return whether something changed for so short a time that another such change may have been missed."""
    a, clock = run.a, run.clock
    return bool(clock[a.SHORTEST_CHANGE] < looks * clock[a.WIDEST_SAMPLING])


def closer(run: "Run") -> float:
    """Return the time between evaluations, s, for a repeated run to meet the changes that this one may have missed."""
    a, clock = run.a, run.clock
    return float(max(clock[a.SHORTEST_CHANGE] / CLOSER, clock[a.WIDEST_SAMPLING] / MOST_CLOSER))


def warn_of_missed_changes(run: "Run") -> str:
    """Warn that a run, which is not repeated, may have missed short changes, and return the sentence."""
    if not may_have_missed_changes(run, SEEN):
        return ""
    a, clock = run.a, run.clock
    said = (
        f"forces, constraint_rate or nonholonomic_rate change suddenly for {clock[a.SHORTEST_CHANGE]:.2g} s, and were "
        f"sampled every {clock[a.WIDEST_SAMPLING]:.2g} s only, where steps are long: other changes as short may have "
        f"been missed. Give max_step, at most {clock[a.SHORTEST_CHANGE]:.2g}"
    )
    return warn_user(said)


Array = NDArray[np.float64]

CORRECTIONS = 3  # Newton corrections of positions, which are off by less than the tolerances
NEGLIGIBLE = 1e-12  # relative to the largest: smaller singular values and eigenvalues count as zero (redundant rows)
HOLDS = 1e-8  # relative residual of the equations below which they count as solved


def state_behind_jump(system: ConstrainedSystem, t: float, q: Array, v: Array) -> Array | None:
    """Return the state [q, v] at t, right after a jump, from the one before; None: no velocities fit the constraints.

    Solve M (v+ - v) + G^T p = 0 and G v+ + (C_t, b) = 0: v+ is nearest to v, in the metric of M, of all velocities that
    the constraints allow.
    """
    q = corrected(system, t, q)
    equations, lengths, size = scaled_equations(system, t, q)
    right = np.concatenate([np.zeros(system.n_q), -system.velocity_constraint(t, q, v) / lengths * size])
    change = np.linalg.lstsq(equations, right, rcond=NEGLIGIBLE)[0]
    if not np.abs(equations @ change - right).max() <= HOLDS * np.abs(right).max():
        return None
    return np.concatenate([q, v + change[: system.n_q]])


def corrected(system: ConstrainedSystem, t: float, q: Array) -> Array:
    """Project positions onto the constraints by Newton's method."""
    for _ in range(CORRECTIONS if system.n_c > 0 else 0):
        q = q - np.linalg.lstsq(system.jacobian(t, q), system.constraint(t, q), rcond=NEGLIGIBLE)[0]
    return q


def scaled_equations(system: ConstrainedSystem, t: float, q: Array) -> tuple[Array, Array, float]:
    """Return the matrix [M G^T; G 0], the rows G scaled to the size of M, with their lengths and this size."""
    mass, rows = system.mass(t, q), system.rows(t, q)
    lengths, size = np.linalg.norm(rows, axis=1), float(np.abs(mass).max())
    lengths[lengths == 0.0] = 1.0
    scaled = rows / lengths[:, None] * size
    return np.block([[mass, scaled.T], [scaled, np.zeros((len(rows), len(rows)))]]), lengths, size
