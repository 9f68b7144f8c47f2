"""Verify a run by `result.certify()`: interval by interval, with another method."""

from __future__ import annotations  # help() shows ArrayLike by name

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import Array, check_positive, check_tolerance
from twoloop.kernels.data.indices import APART
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.record import Record
from twoloop.run.rerun import IndependentRerun, RerunPiece, explicit, implicit, tighter

PIECES = 200  # the run is divided into at least this many intervals, also the bound of the step size
LIMIT = 200.0  # tolerances: in tests correct steps had at most 140, wrong ones at least 590 (of TRBDF2: 107)
ROUNDING = 1e-14  # relative to the largest coordinate or velocity: deviation attributed to rounding
SPLIT = 100.0  # defect of an interval above which its steps are checked one by one
MAX_WRONG = 3  # wrong steps after which the rest of an interval is skipped
NEGLIGIBLE = 1e-10  # relative: smaller singular values of the rows count as zero
USUAL_GROWTH = 10.0  # error growth over an interval up to which the defect is not corrected for it
MAX_ATTEMPTS, MAX_ATTEMPTS_PER_STEP = 400, 32  # attempted steps per interval, plus those per step of the run in it
LOOSER = (10.0, 100.0)  # factors of the tolerances with which a failed reintegration is repeated


class CertificateWarning(UserWarning):
    """Warning that a run does not pass its certificate: its defect is larger than the tolerances allow.

    Examples
    --------
    >>> import warnings
    >>> from twoloop import CertificateWarning
    >>> warnings.simplefilter("error", CertificateWarning)  # a certificate that does not pass raises
    >>> warnings.resetwarnings()
    """


@dataclass(frozen=True)
class Certificate:
    """Outcome of the verification of a run.

    `print(certificate)` shows the message; the truth value is `passed`.

    Attributes
    ----------
    defect : float
        Largest distance between a stored state and the state obtained by integration from the previous stored state,
        divided by the tolerance of a step.
    t : float
        Start of the step with the largest defect, s.
    gap : float
        Longest time between two evaluations of the equations, s: shorter features may be missed.
    limit : float
        Largest `defect` of a run that passes.
    unseen : tuple of (float, float)
        Start and end, s, of intervals that could not be verified: reintegration failed, e.g. near a singular position,
        or errors grow more than 200-fold within a step.
    passed : bool
        True if `defect` is at most `limit` and `unseen` is empty.
    message : str
        The outcome in words.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> certificate = result.certify()
    >>> certificate.passed
    True
    """

    defect: float
    t: float
    gap: float
    limit: float
    unseen: tuple[tuple[float, float], ...]
    passed: bool
    message: str

    def __bool__(self) -> bool:
        return self.passed

    def __str__(self) -> str:
        return self.message


def certify(result: Record, rtol: float | None, atol: ArrayLike | None) -> Certificate:
    """Return the certificate of a result, see `Result.certify`."""
    if result.system is None:
        raise ValueError(
            "certify needs the system: read a file by twoloop.load(path, system), give a result of another solver "
            "dataclasses.replace(result, system=system)"
        )
    if result.changes:
        raise ValueError(
            f"certify verifies a single run of a single system; in this result {result.changes}"
            f"{': certify its parts, result.arcs' if result.arcs else ''}"
        )
    checker = _Checker(result, result.system, *_tolerances(result, result.system.n_q, rtol, atol))
    defect, t_worst = 0.0, float(checker.t[0])
    unseen: list[tuple[float, float]] = []
    for i, j, interval_defect in checker.pieces():
        if not np.isfinite(interval_defect):
            start = unseen.pop()[0] if unseen and unseen[-1][1] == checker.t[i] else float(checker.t[i])
            unseen.append((start, float(checker.t[j])))
        elif interval_defect > defect:
            defect, t_worst = interval_defect, float(checker.t[i])
    gap = max([checker.gap, *(end - start for start, end in unseen)])
    passed = defect <= LIMIT and not unseen
    message = _message(result, defect, t_worst, gap, unseen)
    if defect > LIMIT:
        warnings.warn(message, CertificateWarning, stacklevel=3)
    return Certificate(defect, t_worst, gap, LIMIT, tuple(unseen), passed, message)


def _tolerances(result: Record, n_q: int, rtol: float | None, atol: ArrayLike | None) -> tuple[float, Array]:
    """Return the tolerances given, or those of the run; raise ValueError if none are known."""
    if result.t.size < 2:
        raise ValueError(f"certify needs a result with two times or more; this one has {result.t.size}")
    rtol, atol = result.rtol if rtol is None else rtol, result.atol if atol is None else atol
    if rtol is None or atol is None:
        raise ValueError(
            "certify needs tolerances, and this result does not contain any (it comes from another solver or an older "
            "file): give rtol and atol"
        )
    check_positive("rtol", rtol)
    return float(rtol), check_tolerance("atol", atol, n_q)


class _Checker:
    """Verify the intervals between the states of a result by reintegration.

    Attributes
    ----------
    t, states : ndarray (n,), (n, 2 n_q)
        All states known, as rows [q, v].
    gap : float
        Longest time between evaluations so far, s.
    """

    def __init__(self, result: Record, system: ConstrainedSystem, rtol: float, atol: Array):
        self.result, self.sol, self.system, self.rtol, self.atol = result, result.sol, system, rtol, atol
        self.t, self.states = result.t, np.vstack([result.q, result.v]).T
        if result.sol is not None:  # add the states at the steps
            table = result.sol.table
            inside = table.t <= result.sol.t_max
            states = np.vstack([self.states, table.states[inside, : self.states.shape[1]]])
            self.t, first = np.unique(np.append(self.t, table.t[inside]), return_index=True)
            self.states = states[first]
        self.n_steps, self.untested = self._steps(result)
        self.longest = float(self.t[-1] - self.t[0]) / PIECES
        blocks = np.nan_to_num(np.abs(self.states), posinf=0.0).reshape(len(self.t), 2, len(atol))
        self.rounding = ROUNDING * np.repeat(blocks.max(axis=(0, 2)), len(atol))
        self.gap = 0.0
        self.remakers: dict[tuple[str, float], IndependentRerun] = {}

    def _steps(self, result: Record) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the number of steps of the run in each interval, and whether one of them did not test velocities."""
        n, m = len(self.t) - 1, len(result.h)
        untested = np.zeros(m, dtype=bool) if result.untested is None else result.untested
        start = self.t[0] if result.sol is None else result.sol.t_min
        ends = start + np.cumsum(result.h)
        near = 1e-9 * (self.t[-1] - self.t[0])
        if m == 0 or (result.success and abs(ends[-1] - self.t[-1]) > near):  # the positions of the steps are unknown
            return np.full(n, -(-m // n) + 1), np.full(n, untested.any())
        first = np.minimum(np.searchsorted(ends, self.t[:-1] + near), m - 1)
        last = np.minimum(np.searchsorted(ends, self.t[1:] - near), m - 1)
        before = np.append(0, np.cumsum(untested))
        return last - first + 1, before[last + 1] > before[first]

    def pieces(self) -> Iterator[tuple[int, int, float]]:
        """Yield first and last state of each interval and its defect; infinite if reintegration fails."""
        i, last = 0, len(self.t) - 1
        while i < last:
            j = i + 1
            while j < last and self.t[j + 1] - self.t[i] <= self.longest and self.untested[j] == self.untested[i]:
                j += 1
            defect = self._defect(i, j)
            if SPLIT < defect < np.inf and j > i + 1:
                yield from self._single_steps(i, j)
                if self.untested[i]:  # velocity errors show up in the positions of later steps only
                    yield i, j, defect / (j - i)
            else:
                yield i, j, defect
            i = j

    def _single_steps(self, i: int, j: int) -> Iterator[tuple[int, int, float]]:
        """Yield the same for the steps of an interval with a large defect: many small errors, or a few wrong steps."""
        n_wrong = 0
        for k in range(i, j):
            defect = self._defect(k, k + 1)
            n_wrong += defect > LIMIT
            if n_wrong == MAX_WRONG and not np.isfinite(defect):
                yield k, j, defect
            else:
                yield k, k + 1, defect
            if n_wrong == MAX_WRONG:
                return

    def _defect(self, i: int, j: int) -> float:
        """Return the defect from state i to state j: that of one method, or the smaller of two if it is too large."""
        newton = bool(self.result.stats.n_jacobians) and (self.result.untested is None or self.untested[i])
        stiff = "positions" if self.untested[i] else "all"
        order = (stiff, "explicit") if newton else ("explicit", stiff)
        defects = [(np.inf, "")]
        for method in order:
            defects.append((self._defect_by(method, 1.0, i, j), method))
            smallest, best = min(defects)
            if smallest <= LIMIT or (smallest < np.inf and j > i + 1):
                return smallest
        if smallest < np.inf:  # is the step wrong, or do errors grow this fast?
            growth = self._growth(best, i, j)
            return smallest / (growth if growth > USUAL_GROWTH else 1.0) if growth <= LIMIT else np.inf
        for looser in LOOSER:  # near a singular position rounding may prevent the full accuracy
            for method in order:
                smallest = self._defect_by(method, looser, i, j)
                if smallest < np.inf:
                    return smallest
        return np.inf

    def _defect_by(self, method: str, looser: float, i: int, j: int) -> float:
        """Return the defect from state i to state j by one method, with tolerances relaxed by a factor."""
        rerun = self._remake(method, looser, self.states[i], i, j)
        if rerun is None:
            return np.inf
        end_defect = self._distance(rerun.end, self.states[j], i, j)
        n_steps = 1 if j > i + 1 else int(self.n_steps[i])  # steps without stored states between them
        return max(end_defect, self._deviation_between(rerun.between, i, j)) / float(np.sqrt(n_steps))

    def _deviation_between(self, state: Array, i: int, j: int) -> float:
        """Return the deviation of the dense solution from a reintegrated state, divided by the tolerance."""
        t = self._check_time(i, j)
        if self.sol is None or not self.t[i] < t < self.t[j]:
            return 0.0
        table = self.sol.table
        if table.kinds[np.searchsorted(table.t, t) - 1] == APART:  # interpolation is less accurate than the states here
            return 0.0
        interpolated = self.sol(t)
        return self._distance(state, np.concatenate([interpolated.q, interpolated.v]), i, j)

    def _growth(self, method: str, i: int, j: int) -> float:
        """Return the factor by which an error of the size of the tolerance grows from state i to state j."""
        reference, perturbed = (
            self._remake(method, 1.0, start, i, j) for start in (self.states[i], self._perturbed(i))
        )
        return np.inf if reference is None or perturbed is None else self._distance(reference.end, perturbed.end, i, j)

    def _perturbed(self, i: int) -> Array:
        """Return a state on the constraints that differs from state i by about the tolerances."""
        t, system = float(self.t[i]), self.system
        change = self._allowed(self.states[i]) * np.where(np.arange(self.states.shape[1]) % 3 == 1, -1.0, 1.0)
        q, v = (self.states[i] + change).reshape(2, -1)
        if system.n_c + system.n_a > 0:
            rows = system.rows(t, q)
            q = q - np.linalg.pinv(rows, rcond=NEGLIGIBLE) @ (rows @ change[: system.n_q])
            v = v - np.linalg.pinv(system.rows(t, q), rcond=NEGLIGIBLE) @ system.velocity_constraint(t, q, v)
        return np.concatenate([q, v])

    def _allowed(self, state: Array) -> Array:
        return np.tile(self.atol, 2) + self.rtol * np.abs(state) + self.rounding

    def _distance(self, state: Array, reference: Array, i: int, j: int) -> float:
        """Return the largest difference of two states over the tolerance, in the components that the steps tested."""
        with np.errstate(invalid="ignore"):  # states that are not finite give NaN
            error = np.abs(state - reference) / self._allowed(reference)
        return float((error[: len(self.atol)] if self.untested[i:j].any() else error).max())

    def _remake(self, method: str, looser: float, start: Array, i: int, j: int) -> RerunPiece | None:
        """Integrate from `start` at the time of state i to state j; None if that fails."""
        key = (method, looser)
        if key not in self.remakers:
            chosen = explicit() if method == "explicit" else implicit(method == "all")
            q, v = self.states[0].reshape(2, -1).copy()
            rtol, atol = looser * float(tighter(self.rtol)), looser * tighter(self.atol)
            self.remakers[key] = IndependentRerun(self.system, float(self.t[0]), q, v, chosen, rtol, atol, self.longest)
        remaker = self.remakers[key]
        t0, t1 = float(self.t[i]), float(self.t[j])
        max_attempts = MAX_ATTEMPTS + MAX_ATTEMPTS_PER_STEP * (
            int(self.n_steps[i:j].sum()) + int((t1 - t0) / self.longest)
        )
        rerun = remaker.to(t0, start, self._check_time(i, j), t1, max_attempts if looser == 1.0 else MAX_ATTEMPTS)
        if rerun is not None:
            self.gap = max(self.gap, rerun.longest * remaker.spacing)
        return rerun

    def _check_time(self, i: int, j: int) -> float:
        """Return the midpoint of the longest interval between states i and j; without `sol` the time of state j."""
        if self.sol is None:
            return float(self.t[j])
        k = i + int(np.diff(self.t[i : j + 1]).argmax())
        return float(0.5 * (self.t[k] + self.t[k + 1]))


def _message(result: Record, defect: float, t_worst: float, gap: float, unseen: list[tuple[float, float]]) -> str:
    """Return the outcome in words."""
    method = result.method or "the run"
    parts = []
    if defect > LIMIT:
        parts.append(
            f"Not passed: the step of {method} that starts at t = {t_worst:.6g} ends {defect:.2g} times its tolerance "
            f"away from the solution of the equations (limit: {LIMIT:g}). It missed a feature, or the tolerance is not "
            "met: limit max_step, or use another method."
        )
    else:
        parts.append(
            f"{'Passed' if not unseen else 'Passed in part'}: reintegrated from the stored states, no part of the run "
            f"ends more than {defect:.2g} times the tolerance of a step away from the next stored state (limit: "
            f"{LIMIT:g})."
        )
    if unseen:
        spans = ", ".join(f"{start:.6g} to {end:.6g}" for start, end in unseen[:3]) + (", ..." if unseen[3:] else "")
        parts.append(
            f"Not verified: t = {spans}, where reintegration failed, or errors grow too fast to detect a wrong step."
        )
    parts.append(
        f"The equations were evaluated every {gap:.2g} s or closer: shorter features may be missed. Neither the growth "
        "of errors over the run nor the model is certified."
    )
    return " ".join(parts)
