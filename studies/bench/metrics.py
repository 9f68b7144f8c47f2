"""What a run is measured by, for any mechanism: errors, violations at three levels, energy, multipliers.

No solver lands on the sampling instants; each takes its own steps. Of solvers that tell their steps (twoloop, SciPy,
solve_dae, Exudyn) the deviation from the reference is taken at the steps' ends, and the deviation, not the motion, is
interpolated to the common instants: by cubics in the deviations of q and v for positions, linearly for velocities.
heyoka, CVODE, IDA, CasADi and diffrax tell their states at the common instants, by their own interpolants of about the
order of their methods, because storing every step would cost them more than the integration, or cannot be asked for:
what these interpolants add to the error is counted as theirs.

Measured once (four-bar, 10 s; SunRadau5, Gauss12, DOP853 and BDF of twoloop at 1e-5 and 1e-9): this error is 0.999 to
1.015 of the largest at the steps' own ends. Landing on 1000 instants instead multiplies the evaluations by 1.06 to 5.6
and the error by anything from 2e-6 (DOP853 at 1e-5, whose steps it cuts short) to 44 (BDF at 1e-5).
"""

from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from references.equations.accelerations import compiled_gamma
from studies.bench.reference_motion import ReferenceMotion
from studies.bench.store import Array
from twoloop import ConstrainedSystem, Result
from twoloop.mechanisms import Problem

CHECKED = 500  # stored instants, evenly chosen, at which violations are taken
MULTIPLIERS = 100  # stored instants at which multipliers are compared
LOST = 0.25  # of the largest kinetic energy of the motion: a run with a greater energy error has lost the solution
KEPT = 1e-8  # of the largest kinetic energy: a reference that loses more, or ...
FLOORS = 1e3  # ... so many times its floor, as errors of velocities are larger, does not keep its energy
ASTRAY = 0.1  # of the range of a watched coordinate: a run that strays farther is out of phase

# at the common instants the largest deviations, m or rad, and m/s or rad/s; those at the end, and its correct digits
COLUMNS: dict[str, Any] = dict.fromkeys(("error_q", "error_v", "error_end", "error_v_end", "scd", "error_lam"))
# E - E(0) of greatest magnitude, J; violations over the run, of the positions also in its first and its last tenth
COLUMNS |= dict.fromkeys(("energy", "violation_q", "violation_v", "violation_a", "violation_early", "violation_late"))
COLUMNS |= {"lost": True, "astray": True}


def deviation(result: Result, motion: ReferenceMotion, instants: Array) -> tuple[Array, Array]:
    """Deviation of positions and velocities (n_q, n) from the reference at common instants."""
    t = result.t
    left = np.clip(np.searchsorted(t, instants, side="right") - 1, 0, t.size - 2)
    chosen = np.unique(np.concatenate([left, left + 1]))  # the instants beside a common one are enough
    nodes = t[chosen]
    q, v = motion.states(nodes)
    dq, dv = result.q[:, chosen] - q, result.v[:, chosen] - v
    inside = np.clip(instants, nodes[0], nodes[-1])
    at_q = CubicHermiteSpline(nodes, dq, dv, axis=1)(inside)
    return at_q, np.array([np.interp(inside, nodes, row) for row in dv])


def correct_digits(deviation: Array, truth: Array) -> float:
    """Return the significant correct digits: -log10 of the largest relative error of a component.

    This is scd of the Test Set for IVP Solvers (F. Mazzia and C. Magherini, release 2.4, 2008), without components
    whose true value is 0.
    """
    known = truth != 0.0
    relative = np.abs(deviation[known] / truth[known])
    return float(-np.log10(max(relative.max(initial=0.0), 1e-17)))


def violations(system: ConstrainedSystem, result: Result) -> tuple[Array, dict[str, Array]]:
    """Return at most CHECKED times, and the largest residuals of C, C_q v + C_t and C_q a - Q_d there."""
    chosen = np.unique(np.linspace(0, result.t.size - 1, CHECKED).astype(int))
    gamma, p = compiled_gamma(system), system.functions.p
    levels = {level: np.empty(chosen.size) for level in "qva"}
    for i, k in enumerate(chosen):
        t, q, v = float(result.t[k]), result.q[:, k].copy(), result.v[:, k].copy()
        jacobian, bias = system.jacobian(t, q), np.zeros(system.n_c)
        gamma(t, q, v, p, bias)
        levels["q"][i] = np.abs(system.constraint(t, q)).max(initial=0.0)
        levels["v"][i] = np.abs(jacobian @ v + system.constraint_rate(t, q)).max(initial=0.0)
        levels["a"][i] = np.abs(jacobian @ result.a[:, k] - bias).max(initial=0.0)
    return result.t[chosen], levels


def multipliers(system: ConstrainedSystem, t: float, q: Array, v: Array) -> Array | None:
    """Multipliers of eq. (6) at a state; None where they are not unique."""
    n, m = system.n_q, system.n_c
    jacobian, bias = system.jacobian(t, q), np.zeros(m)
    if np.linalg.matrix_rank(jacobian) < m:
        return None
    compiled_gamma(system)(t, q, v, system.functions.p, bias)
    matrix = np.block([[system.mass(t, q), jacobian.T], [jacobian, np.zeros((m, m))]])
    return np.asarray(np.linalg.solve(matrix, np.concatenate([system.force(t, q, v), bias]))[n:])


def _error_lam(system: ConstrainedSystem, result: Result, motion: ReferenceMotion) -> float | None:
    if not np.isfinite(result.lam).all():
        return None  # a solver with joints of its own
    largest = 0.0
    for k in np.unique(np.linspace(0, result.t.size - 1, MULTIPLIERS).astype(int)):
        t = float(result.t[k])
        q, v = motion.states(np.array([t]))
        truth = multipliers(system, t, q[:, 0], v[:, 0])
        if truth is None:
            return None
        largest = max(largest, float(np.abs(result.lam[:, k] - truth).max()))
    return largest


def keeps_energy(problem: Problem, motion: ReferenceMotion, instants: Array) -> bool:
    """Return whether a known motion with kinetic energy conserves the energy, by its power balance."""
    times = np.concatenate([[0.0], instants])
    q, v = motion.states(times)
    energy = np.asarray(problem.energy(times, q, v))
    kinetic = float((energy - problem.energy(times, q, 0.0 * v)).max())
    lost = float(np.abs(energy - energy[0]).max())
    return kinetic > 0.0 and lost <= max(KEPT, FLOORS * motion.floor) * kinetic


class Scale:
    """Size of a mechanism, from one motion, by which "lost" and "out of phase" are judged."""

    def __init__(self, problem: Problem, motion: ReferenceMotion, instants: Array, conserved: bool):
        times = np.concatenate([[0.0], instants])
        q, v = motion.states(times)
        self.ranges = np.ptp(q, axis=1)  # range of each coordinate
        self.kinetic = None  # largest kinetic energy, J, if an energy is conserved
        if conserved:
            self.kinetic = float((problem.energy(times, q, v) - problem.energy(times, q, 0.0 * v)).max())


def measure(case: Any, result: Result) -> dict[str, Any]:
    """The columns of a row that say how good a run of a `Case` was; some are None where it did not reach its end."""
    row, problem, motion, scale = dict(COLUMNS), case.problem, case.reference, case.scale
    if result.t.size < 2 or not np.isfinite(result.q).all():
        return row
    system, t, q, v = problem.system, result.t, result.q, result.v
    if scale.kinetic is not None:
        drift = problem.energy(t, q, v) - problem.energy(t[0], problem.q0, problem.v0)
        row["energy"] = float(drift[np.abs(drift).argmax()])
    times, levels = violations(system, result)
    row |= {f"violation_{level}": float(size.max()) for level, size in levels.items()}
    row["violation_early"] = float(levels["q"][times <= 0.1 * times[-1]].max())
    row["violation_late"] = float(levels["q"][times >= 0.9 * times[-1]].max())
    end = float(case.instants[-1])
    # Exudyn adds up its steps, so its last time is the end only to rounding
    if not (result.success and abs(t[-1] - end) < 1e-9 * end):
        return row
    dq, dv = deviation(result, motion, case.instants)
    q_end, v_end = (state[:, 0] for state in motion.states(np.array([end])))
    last_q, last_v = q[:, -1] - q_end, v[:, -1] - v_end
    last, truth = np.concatenate([last_q, last_v]), np.concatenate([q_end, v_end])
    row["error_q"], row["error_v"] = float(np.abs(dq).max()), float(np.abs(dv).max())
    row["error_end"], row["error_v_end"] = float(np.abs(last_q).max()), float(np.abs(last_v).max())
    row["scd"], row["error_lam"] = correct_digits(last, truth), _error_lam(system, result, motion)
    row["lost"] = scale.kinetic is not None and abs(row["energy"]) > LOST * scale.kinetic
    places = np.arange(system.n_q) if case.watched is None else np.array(case.watched)
    moving = places[scale.ranges[places] > 0.0]
    row["astray"] = bool((np.abs(dq[moving]).max(axis=1) > ASTRAY * scale.ranges[moving]).any())
    return row
