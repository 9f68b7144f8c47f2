"""Verify a run by `result.certify()`: interval by interval, with another method."""

from __future__ import annotations  # help() shows ArrayLike by name

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import Array, check_positive, check_tolerance
from twoloop.kernels.data.indices import SEPARATE
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.field_faults import NEAR, all_states, end_of_run, field_faults
from twoloop.run.record import Record
from twoloop.run.rerun import IndependentRerun, RerunPiece
from twoloop.run.signals import SignalHandlers

PIECES = 200  # smallest number of intervals into which the run is divided; also limits the step size of reruns
LIMIT = 100.0  # a run passes if defects of steps and errors of states are at most this many tolerances
FASTEST = 10.0  # largest rate, 1/s, by which velocity errors are divided; errors of untested velocities: by this rate
TOLERANCE_FACTOR = 0.1  # ratio of the tolerances of a reintegration to those of the run
FINEST = 1e-13  # smallest tolerance of a reintegration, relative or absolute: rounding hides smaller errors
SECOND_RUN_FACTOR = 0.1  # factor on the tolerances of the second run, because its errors grow over the whole run
STIFF = 4  # a run did not resolve untested velocities if its steps take more than this number of explicit steps each
CHAOTIC = 10.0  # the growth of an initial error of one tolerance explains errors of up to this multiple of the growth
ROUNDING = 1e-14  # deviation attributed to rounding, relative to the largest coordinate or velocity
SPLIT = 100.0  # if the defect of an interval, in tolerances, is larger, the steps in it are checked one by one
MAX_WRONG = 3  # number of wrong steps after which the rest of an interval is skipped
NEGLIGIBLE = 1e-10  # a singular value of the constraint rows counts as zero below this fraction of the largest
USUAL_GROWTH = 10.0  # if errors grow over an interval by a larger factor, the defect is divided by this factor
MAX_ATTEMPTS, MAX_ATTEMPTS_PER_STEP = 400, 32  # largest number of attempts in an interval: first + second * steps
LOOSER = (10.0, 100.0)  # factors on the tolerances with which a failed reintegration is repeated


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
        Start of the step with the largest defect, s; if all steps pass, time of the largest error.
    error : float
        Largest distance between a stored state and the state obtained by integration from the first stored state,
        divided by the tolerance; of velocities also by the rate of the motion, max |a| / max |v|, if that is above
        1/s, up to 10/s.
    faults : tuple of str
        Fields of the result that contradict the equations or one another.
    gap : float
        Longest time between two evaluations of the equations, s: shorter features may be missed.
    limit : float
        Largest `defect` and largest `error` of a run that passes.
    unseen : tuple of (float, float)
        Start and end, s, of intervals that could not be verified: reintegration failed, e.g. near a singular position,
        errors of a tolerance grow beyond the limit, or the result ends before the run.
    passed : bool
        True if `defect` and `error` are at most `limit`, and `unseen` and `faults` are empty.
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
    error: float = 0.0
    faults: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return self.passed

    def __str__(self) -> str:
        return self.message


def certify(result: Record, rtol: float | None = None, atol: ArrayLike | None = None) -> Certificate:
    """Verify the run by reintegration with another method and other steps, and measure its errors.

    Every interval of the run is integrated again from its stored initial state, with the same callbacks, a tenth
    of the tolerance and steps of at most 1/200 of the run, by `DOP853` or, where the run was stiff, seven-stage
    Radau IIA. The final state is compared with the one stored. A step that missed a force, or an altered state,
    deviates by far more than the tolerance. A second run, with a hundredth of the tolerance, starts from the first
    state and lands on every stored time: it measures what small errors add up to. Accelerations, multipliers,
    events, times, steps and status are compared with the equations and with one another.

    The cost is about that of three runs with `DOP853` that land on all stored times, at least 5,000 evaluations.

    Parameters
    ----------
    rtol : float, optional
    atol : float or array_like (n_q,), optional
        Tolerances of a step, for positions and velocities. None: those of the run. Required for results of other
        solvers.

    Returns
    -------
    Certificate
        `.defect` of the steps and `.error` of the states relative to the tolerance, `.t`, `.gap`, `.limit`,
        `.unseen`, `.faults`, `.passed`, `.message`.

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid, or the result has no tolerances, fewer than two times, or no system.

    Warns
    -----
    CertificateWarning
        If the defect is above the limit; if the error is, and the growth of errors does not explain it; or if
        fields contradict the equations.

    Notes
    -----
    The certificate does not prove that the model is right, nor anything about features shorter than `gap`. Where
    an error of a tolerance at the start grows beyond the limit, as in chaotic motion, the steps are verified, but
    not the states: the run passes in part.
    """
    with SignalHandlers(ctrl_c=True) as handlers:
        return _certify(result, rtol, atol, handlers)


def _certify(result: Record, rtol: float | None, atol: ArrayLike | None, handlers: SignalHandlers) -> Certificate:
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
    checker = _Checker(result, result.system, *_tolerances(result, result.system.n_q, rtol, atol), handlers)
    faults = tuple(field_faults(result, result.system, checker.rtol, checker.atol, LIMIT))
    defect, t_worst, unseen = _local_errors(checker)
    error, t_error, t_grown = checker.errors() if defect <= LIMIT else (defect, t_worst, np.inf)
    if t_grown < np.inf:  # the growth of a small initial error explains the largest error: the steps may be right
        unseen = [*((start, end) for start, end in unseen if end <= t_grown), (t_grown, float(checker.t[-1]))]
    end = end_of_run(result)
    last_time = max(float(result.t[-1]), *(float(t[-1]) for t in result.t_events or () if len(t)), -np.inf)
    if result.success and end > last_time + NEAR * abs(end - checker.t[0]):
        unseen.append((last_time, end))
    gap = max([checker.gap, *(end - start for start, end in unseen)])
    is_wrong = defect > LIMIT or (error > LIMIT and t_grown == np.inf)
    t_worst = t_worst if defect > LIMIT else t_error
    passed = not is_wrong and error <= LIMIT and not unseen and not faults
    certificate = Certificate(defect, t_worst, gap, LIMIT, tuple(unseen), passed, "", error, faults)
    certificate = replace(certificate, message=_message(certificate, is_wrong, result))
    if is_wrong or faults:
        warnings.warn(certificate.message, CertificateWarning, stacklevel=3)
    return certificate


def _local_errors(checker: _Checker) -> tuple[float, float, list[tuple[float, float]]]:
    """Return the largest defect, the start of its step, and the intervals that could not be verified."""
    defect, t_worst = 0.0, float(checker.t[0])
    unseen: list[tuple[float, float]] = []
    for i, j, interval_defect in checker.pieces():
        if not np.isfinite(interval_defect):
            start = unseen.pop()[0] if unseen and unseen[-1][1] == checker.t[i] else float(checker.t[i])
            unseen.append((start, float(checker.t[j])))
        elif interval_defect > defect:
            defect, t_worst = interval_defect, float(checker.t[i])
    return defect, t_worst, unseen


def _tolerances(result: Record, n_q: int, rtol: float | None, atol: ArrayLike | None) -> tuple[float, Array]:
    """Return rtol and atol (n_q,), by default those of the run; raise ValueError if the run has no tolerances."""
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
    """Checker of the intervals between the states of a result, by reintegration."""

    def __init__(self, result: Record, system: ConstrainedSystem, rtol: float, atol: Array, handlers: SignalHandlers):
        self.handlers = handlers
        self.result, self.sol, self.system, self.rtol, self.atol = result, result.sol, system, rtol, atol
        every_t, self.every_state = all_states(result)  # all states [q, v], of which several may have equal times
        # all different times, the states at these times, and the index in `t` of every state
        self.t, first, self.place = np.unique(every_t, return_index=True, return_inverse=True)
        self.states = self.every_state[first]
        self.n_steps, self.untested = self._steps(result)
        self.longest = float(self.t[-1] - self.t[0]) / PIECES
        magnitudes = np.nan_to_num(np.abs(self.states), posinf=0.0).reshape(len(self.t), 2, len(atol))
        self.rounding = ROUNDING * np.repeat(magnitudes.max(axis=(0, 2)), len(atol))
        self.gap = 0.0  # longest time between evaluations so far, s
        self.reruns: dict[tuple[str, float], IndependentRerun] = {}

    def _steps(self, result: Record) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the number of steps of the run in each interval, and whether one of them did not test velocities."""
        n, m = len(self.t) - 1, len(result.h)
        untested = np.zeros(m, dtype=bool) if result.untested is None else result.untested
        start = self.t[0] if result.sol is None else result.sol.t_min
        ends = start + np.cumsum(result.h)
        tolerance = 1e-9 * (self.t[-1] - self.t[0])
        if m == 0 or (result.success and abs(ends[-1] - self.t[-1]) > tolerance):  # it is unknown where the steps end
            return np.full(n, -(-m // n) + 1), np.full(n, untested.any())
        first_step = np.minimum(np.searchsorted(ends, self.t[:-1] + tolerance), m - 1)
        last_step = np.minimum(np.searchsorted(ends, self.t[1:] - tolerance), m - 1)
        n_untested = np.append(0, np.cumsum(untested))
        return last_step - first_step + 1, n_untested[last_step + 1] > n_untested[first_step]

    def pieces(self) -> Iterator[tuple[int, int, float]]:
        """Yield, for each interval, the indices of its first and last state, and its defect (inf: rerun failed)."""
        for i, j in self._intervals():
            defect = self._defect(i, j)
            if SPLIT < defect < np.inf and j > i + 1:
                yield from self._single_steps(i, j)
                if self.untested[i]:  # velocity errors show up in the positions of later steps only
                    yield i, j, defect / (j - i)
            else:
                yield i, j, defect

    def _intervals(self) -> Iterator[tuple[int, int]]:
        """Yield indices of first and last states of intervals, which last one step or up to `self.longest` s."""
        i, last = 0, len(self.t) - 1
        while i < last:
            j = i + 1
            while j < last and self.t[j + 1] - self.t[i] <= self.longest and self.untested[j] == self.untested[i]:
                j += 1
            yield i, j
            i = j

    def errors(self) -> tuple[float, float, float]:
        """Return the largest error of a state, in tolerances; its time; and when growth begins to explain errors.

        Errors are distances from a second run, which starts from the first state and uses no other stored state. The
        last of these times is infinite if no error exceeds the limit, or if growth does not explain the errors.
        """
        reference, tested = self._second_run(self.states[0])
        with np.errstate(invalid="ignore"):  # states that are not finite give NaN
            errors = np.abs(self.every_state - reference[self.place]) / self._allowed(reference[self.place])
        n = len(self.atol)
        errors[:, n:] *= tested[self.place, None]
        errors[:, n:][tested[self.place] == 0.0] = 0.0
        largest = np.nan_to_num(errors.max(axis=1), nan=0.0)  # `pieces` reports states that are not finite
        if not largest.max() > LIMIT:
            return float(largest.max()), float(self.t[self.place[largest.argmax()]]), np.inf
        perturbed, _ = self._second_run(self._perturbed(0))
        growth = np.maximum.accumulate((np.abs(perturbed - reference) / self._allowed(reference)).max(axis=1))
        is_explained = largest <= CHAOTIC * growth[self.place]
        t = self.t[self.place]
        worst_index = largest.argmax()
        if (is_explained | (largest <= LIMIT)).all():
            return float(largest.max()), float(t[worst_index]), float(t[largest > LIMIT].min())
        return float(largest.max()), float(t[worst_index]), np.inf

    def _second_run(self, start: Array) -> tuple[Array, Array]:
        """Return the states (n, 2 n_q) of a second run from `start`, and the weights (n,) of its velocity errors.

        After a failure, e.g. near a singular position, the second run continues from the stored state (see `pieces`).
        """
        states, weights = np.empty_like(self.states), np.full(len(self.t), 1.0 / self._rate())
        states[0] = start
        uses_newton = bool(self.result.stats.n_jacobians)
        for i, j in self._intervals():
            stiff = "positions" if self.untested[i] else "all"
            pairs = [(method, factor) for factor in (SECOND_RUN_FACTOR, 1.0, *LOOSER) for method in ("explicit", stiff)]
            for method, factor in pairs:
                rerun = self._rerun(method, factor, states[i], i, j, self.t[i + 1 : j + 1])
                if rerun is not None:
                    break
            states[i + 1 : j + 1] = self.states[i + 1 : j + 1] if rerun is None else rerun.states
            if self.untested[i] and uses_newton:
                max_steps = STIFF * max(j - i, int(self.n_steps[i:j].sum()))
                resolved = rerun is not None and method == "explicit" and rerun.n_steps <= max_steps
                weights[i + 1 : j + 1] = 1.0 / FASTEST if resolved else 0.0
        return states, weights

    def _rate(self) -> float:
        """Return the rate of the motion, 1/s: an estimate of the ratio of velocity errors to position errors."""
        largest = [np.abs(np.nan_to_num(x, posinf=0.0, neginf=0.0)).max() for x in (self.result.a, self.result.v)]
        return float(np.clip(largest[0] / max(largest[1], np.finfo(float).tiny), 1.0, FASTEST))

    def _single_steps(self, i: int, j: int) -> Iterator[tuple[int, int, float]]:
        """Yield, for each step in a wrong interval i to j, the indices of its first and last state, and its defect."""
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
        """Return the defect from state i to j by one method or, if it is too large, the smaller of two methods'."""
        uses_newton = bool(self.result.stats.n_jacobians) and (self.result.untested is None or self.untested[i])
        stiff = "positions" if self.untested[i] else "all"
        order = (stiff, "explicit") if uses_newton else ("explicit", stiff)
        defects = [(np.inf, "")]
        for method in order:
            defects.append((self._defect_by(method, 1.0, i, j), method))
            smallest, best = min(defects)
            if smallest <= LIMIT or (smallest < np.inf and j > i + 1):
                return smallest
        if smallest < np.inf:  # a large defect may be the growth of small errors
            growth = self._growth(best, i, j)
            return smallest / (growth if growth > USUAL_GROWTH else 1.0) if growth <= LIMIT else np.inf
        for factor in LOOSER:  # near a singular position rounding may prevent the full accuracy
            for method in order:
                smallest = self._defect_by(method, factor, i, j)
                if smallest < np.inf:
                    return smallest
        return np.inf

    def _defect_by(self, method: str, factor: float, i: int, j: int) -> float:
        """Return the defect from state i to state j, measured by one method with `factor` times the tolerances."""
        between, end = self._check_time(i, j), float(self.t[j])
        times = np.array([between, end] if self.t[i] < between < end else [end])
        rerun = self._rerun(method, factor, self.states[i], i, j, times)
        if rerun is None:
            return np.inf
        end_defect = self._distance(rerun.states[-1], self.states[j], i, j)
        n_steps = 1 if j > i + 1 else max(1, int(self.n_steps[i]))  # steps without stored states between them
        return max(end_defect, self._deviation_between(rerun.states[0], i, j)) / float(np.sqrt(n_steps))

    def _deviation_between(self, state: Array, i: int, j: int) -> float:
        """Return the deviation of the dense solution from a reintegrated state, divided by the tolerance."""
        t = self._check_time(i, j)
        if self.sol is None or not (self.t[i] < t < self.t[j] and self.sol.t_min <= t <= self.sol.t_max):
            return 0.0
        table = self.sol.table
        # in intervals of this kind, interpolation is less accurate than the states
        if table.kinds[np.searchsorted(table.t, t) - 1] == SEPARATE:
            return 0.0
        interpolated = self.sol(t)
        return self._distance(state, np.concatenate([interpolated.q, interpolated.v]), i, j)

    def _growth(self, method: str, i: int, j: int) -> float:
        """Return the factor by which an error of the size of the tolerance grows from state i to state j."""
        starts = self.states[i], self._perturbed(i)
        reference, perturbed = (self._rerun(method, 1.0, start, i, j, self.t[j : j + 1]) for start in starts)
        if reference is None or perturbed is None:
            return np.inf
        return self._distance(reference.states[-1], perturbed.states[-1], i, j)

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
        """Return the largest difference of two states, in tolerances; velocities that no step tested do not count."""
        with np.errstate(invalid="ignore"):  # states that are not finite give NaN
            error = np.abs(state - reference) / self._allowed(reference)
        return float((error[: len(self.atol)] if self.untested[i:j].any() else error).max())

    def _rerun(self, method: str, factor: float, start: Array, i: int, j: int, times: Array) -> RerunPiece | None:
        """Integrate from `start`, at the time of state i, to the time of state j; land on `times`; None on failure."""
        key = (method, factor)
        if key not in self.reruns:
            # a start in a singular position, where lam is unknown, would show too small a rank of the rows
            lam = np.asarray(self.result.lam)
            first = int(lam.ndim == 2 and np.isnan(lam[:, :1]).any())
            q, v = self.states[first].reshape(2, -1).copy()
            rtol, atol = (
                np.maximum(factor * np.minimum(each, np.maximum(TOLERANCE_FACTOR * each, FINEST)), FINEST)
                for each in (self.rtol, self.atol)
            )
            run = self.system, float(self.t[first]), q, v, method, float(rtol), atol, self.longest
            self.reruns[key] = IndependentRerun(*run)
        rerun, t0, t1 = self.reruns[key], float(self.t[i]), float(self.t[j])
        n_steps = int(self.n_steps[i:j].sum()) + int((t1 - t0) / self.longest)
        max_attempts = MAX_ATTEMPTS + (MAX_ATTEMPTS_PER_STEP * n_steps if factor == 1.0 else 0)
        piece = rerun.integrate(t0, start, times, max_attempts)
        self.handlers.call_delayed()
        if piece is not None:
            self.gap = max(self.gap, piece.longest * rerun.spacing)
        return piece

    def _check_time(self, i: int, j: int) -> float:
        """Return the midpoint of the longest interval between states i and j; without `sol`, the time of state j."""
        if self.sol is None:
            return float(self.t[j])
        k = i + int(np.diff(self.t[i : j + 1]).argmax())
        return float(0.5 * (self.t[k] + self.t[k + 1]))


def _message(certificate: Certificate, is_wrong: bool, result: Record) -> str:
    """Return the outcome in words; `is_wrong`: the defect or the error shows that the run is wrong."""
    method, defect, error = result.method or "the run", certificate.defect, certificate.error
    sentences = []
    if defect > LIMIT:
        sentences.append(
            f"Not passed: the step of {method} that starts at t = {certificate.t:.6g} ends {defect:.2g} times its "
            f"tolerance away from the solution of the equations (limit: {LIMIT:g}). It missed a feature, or the "
            "tolerance is not met: limit max_step, or use another method."
        )
    elif is_wrong:
        sentences.append(
            f"Not passed: at t = {certificate.t:.6g} the state is {error:.2g} times the tolerance away from a second "
            f"run from the same start (limit: {LIMIT:g}), although no step deviates more than {defect:.2g} "
            "times: small errors add up. Use smaller tolerances or another method."
        )
    elif certificate.faults:
        sentences.append("Not passed.")
    else:
        sentences.append(
            f"{'Passed' if not certificate.unseen else 'Passed in part'}: reintegrated from the stored states, no part "
            f"of the run ends more than {defect:.2g} times the tolerance of a step away from the next stored "
            f"state, and a second run from the first state ends at most {min(error, LIMIT):.2g} tolerances "
            f"away (limit of both: {LIMIT:g})."
        )
    sentences.extend(f"{fault[0].upper()}{fault[1:]}." for fault in certificate.faults)
    if certificate.unseen:
        spans = [f"{start:.6g} to {end:.6g}" for start, end in certificate.unseen[:3]]
        spans += ["..."] * (len(certificate.unseen) > 3)
        sentences.append(
            f"Not verified: t = {', '.join(spans)}, where reintegration failed, errors of a tolerance grow beyond "
            "the limit, or the result has no states."
        )
    sentences.append(
        f"The equations were evaluated every {certificate.gap:.2g} s or closer: shorter features may be missed. The "
        "model is not certified."
    )
    return " ".join(sentences)
