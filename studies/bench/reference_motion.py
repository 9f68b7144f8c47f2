"""The motion against which errors are measured: a known one, or one made of two unlike methods at tight tolerance."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from references.minimal.solvers import has_minimal, minimal_motion
from references.scipy.index1 import solve_index1
from references.sundials.ida import solve_ida
from studies.bench.cli import StudyError
from studies.bench.store import Array
from twoloop import Status, solve_dae
from twoloop.mechanisms import Problem

TIGHT = 1e-13  # tolerance of both runs of the smooth pair
STIFF = 1e-11  # of the pair for stiff problems, which IDA does not follow below
FOLDING = 1e-11  # of the pair for mechanisms that pass singular positions
REFINED = 4  # parts of a step of the second run, at whose ends the first one is stored

_explicit = partial(solve_index1, method="DOP853", stabilisation="projection")
_own_explicit = partial(solve_dae, method="DOP853")
_ida = partial(solve_ida, form="stabilised")


@dataclass(frozen=True)
class ReferenceMotion:
    """A motion known at all times."""

    states: Callable[[Array], tuple[Array, Array]]  # states(t (n_t,)) -> q, v (n_q, n_t)
    floor: float  # largest error of a position that it may have: smaller errors of a run cannot be told
    source: str  # where it comes from


def make_reference(
    problem: Problem, t_end: float, time_limit: float | None = None, report: Callable[[str], object] = len
) -> ReferenceMotion:
    """Integrate by two unlike methods; their largest difference over the run, positions, is the floor.

    Tried first is Gauss16 (twoloop) beside SciPy's DOP853 on the projected index-1 equations, at 1e-13, or, where the
    mass matrix is singular, as with Euler parameters, which these do not take, beside DOP853 of two-loop; where either
    fails, RadauIIA5 (two-loop, Newton's method) beside IDA on the stabilised index-1 form, at 1e-11. The first of a
    pair is stored at four instants in each step of the second, between which the quintic in q, v and a is used.

    Where SciPy's run fails before its time limit, as at redundant rows and singular positions, the ODE in minimal
    coordinates (`references.minimal`), or, where it is not known, DOP853 of two-loop takes its place. Where none of
    these passes a singular position, Taylor and DOP853, both of two-loop, are compared at 1e-11.

    `t_end`: s. `time_limit`: wall-clock time that each run may take, s. None: no limit. `report` takes lines that say
    which run begins, and which has failed.

    Raises StudyError if no pair reaches t_end.
    """
    run = problem.system, (0.0, t_end), problem.q0, problem.v0
    said: list[str] = []
    slow = False
    for name, second, method, tolerance in (
        ("Gauss16 (twoloop) and SciPy's DOP853, projected", _explicit, "Gauss16", TIGHT),
        ("Gauss16 and DOP853 (both two-loop)", _own_explicit, "Gauss16", TIGHT),
        ("RadauIIA5 (twoloop) and IDA, stabilised", _ida, "RadauIIA5", STIFF),
        ("Taylor and DOP853 (both two-loop)", _own_explicit, "Taylor", FOLDING),
    ):
        if method == "Gauss16" and said and has_minimal(problem):
            with suppress(ValueError):  # this four-bar has no angle that stays away from dead centres
                states, error = minimal_motion(problem, t_end)
                source = f"the ODE in minimal coordinates by SciPy's DOP853 and LSODA, which differ by {error:.1e}"
                return ReferenceMotion(states, max(error, 1e-15), source)
        if second is _own_explicit and slow:
            continue
        report(f"  {name}, tolerances {tolerance:.0e}")
        options: dict[str, Any] = {"rtol": tolerance, "atol": tolerance, "time_limit": time_limit}
        try:
            other = second(*run, **options)
        except (ValueError, RuntimeError) as error:  # it does not take this mechanism, or is not installed
            said.append(str(error))
            report(f"  ... failed: {error}")
            continue
        slow = other.status == Status.TIME_LIMIT  # another explicit method would take as long
        if not other.success:
            said.append(other.message)
            report(f"  ... failed: {other.message}")
            continue
        parts = [other.t[:-1] + k / REFINED * np.diff(other.t) for k in range(REFINED)]
        fine = np.append(np.sort(np.concatenate(parts)), t_end)
        first = solve_dae(*run, method, t_eval=fine, **options)
        if not first.success:
            said.append(first.message)
            report(f"  ... failed: {first.message}")
            continue
        motion = Quintic(first.t, first.q, first.v, first.a)
        differ = np.abs(motion(other.t)[0] - other.q).max()
        floor = max(float(differ), motion.uncertainty(), 1e-15)
        return ReferenceMotion(motion, floor, f"{name}, tolerances {tolerance:.0e}, which differ by {differ:.1e}")
    raise StudyError(f"no reference for {problem.name!r}: {' / '.join(said)}")


def check_published(problem: Problem, motion: ReferenceMotion, t_end: float) -> float | None:
    """Largest difference of the positions from the state that the problem gives; None where there is none by t_end."""
    known = problem.reference
    if known is None or known.t > t_end:
        return None
    return float(np.abs(motion.states(np.array([known.t]))[0][:, 0] - known.q).max())


class Quintic:
    """Piecewise polynomial of degree 5 through positions, velocities and accelerations at given instants."""

    def __init__(self, t: Array, q: Array, v: Array, a: Array):
        self._t, self._q, self._v, self._a = t, q, v, a

    def uncertainty(self) -> float:
        """Estimated largest error of q between the instants: from every second one, of which it falls with h^6."""
        coarse = Quintic(self._t[::2], self._q[:, ::2], self._v[:, ::2], self._a[:, ::2])
        skipped = self._t[1::2][: self._t[::2].size - 1]
        return float(np.abs(coarse(skipped)[0] - self(skipped)[0]).max()) / 2**6

    def __call__(self, times: Array) -> tuple[Array, Array]:
        """q, v (n_q, n_t) at times within the instants."""
        times = np.asarray(times, dtype=np.float64)
        k = np.clip(np.searchsorted(self._t, times, side="right") - 1, 0, self._t.size - 2)
        h = self._t[k + 1] - self._t[k]
        s = (times - self._t[k]) / h
        q0, v0, a0 = self._q[:, k], h * self._v[:, k], h * h * self._a[:, k]
        # the remainder over the Taylor polynomial of the left end, from the conditions at the right end
        dq = self._q[:, k + 1] - q0 - v0 - 0.5 * a0
        dv = h * self._v[:, k + 1] - v0 - a0
        da = h * h * self._a[:, k + 1] - a0
        c3 = 10.0 * dq - 4.0 * dv + 0.5 * da
        c4 = -15.0 * dq + 7.0 * dv - da
        c5 = 6.0 * dq - 3.0 * dv + 0.5 * da
        q = q0 + s * (v0 + s * (0.5 * a0 + s * (c3 + s * (c4 + s * c5))))
        v = (v0 + s * (a0 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))) / h
        return q, v
