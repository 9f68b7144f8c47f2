"""`result.certify()`: a run looked at again, piece by piece, by a method and at places of its own."""

from __future__ import annotations  # ArrayLike stays a word in help()

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import Array, check_positive, check_tolerance
from twoloop.kernels.data.intervals import APART
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.record import Record
from twoloop.run.remake import Remade, Remaker, explicit, implicit, tighter

PIECES = 200  # of a run: the longest piece, and the longest step with which one is made again, is this part of it
LIMIT = 200.0  # tolerances: right steps were at most 140 off, those that passed over something 270 and more
ROUNDING = 1e-14  # of the largest coordinate or velocity: what no step can be expected to hold
SEVERAL = 100.0  # the defect of several steps in one piece, from which on each is looked at
ENOUGH = 3  # wrong steps of a piece, after which the others are not looked at
NEGLIGIBLE = 1e-10  # singular values of the rows below this share of the largest are zero
USUAL = 10.0  # growth of an error between two states that says nothing of what is between them
MOST, MOST_A_STEP = 400, 32  # attempts at steps that a piece may take, and as many more for each step of the run in it
LOOSER = (10.0, 100.0)  # times the tolerances of a piece, where it cannot be made again with them


class CertificateWarning(UserWarning):
    """A run does not pass its certificate: some of it is further from the equations than its tolerances allow."""


@dataclass(frozen=True)
class Certificate:
    """What a second look at a run found.

    `print(certificate)` says it in words; as a truth value it is `passed`.

    Attributes
    ----------
    defect : float
        The largest distance between a stored state and that which the equations lead to from the one stored before it,
        over the tolerance of a step.
    t : float
        Where that was found: the start of the step, s.
    gap : float
        The widest gap between two places at which the equations were looked at, s: what lasts less may be missed.
    limit : float
        The largest `defect` of a run that passes.
    unseen : tuple of (float, float)
        Start and end, s, of parts of the run of which nothing can be said: they could not be made again, as near a
        singular position, or errors grow hundredfold within a step.
    passed : bool
        Whether `defect` is at most `limit`, and nothing is unseen.
    message : str
        The same in words.
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
    """The certificate of a result, see `Result.certify`."""
    if result.system is None:
        raise ValueError(
            "certify needs the system: read a file by twoloop.load(path, system), give a result of another solver "
            "dataclasses.replace(result, system=system)"
        )
    if result.changes:
        raise ValueError(
            f"certify looks at one run of one system; in this result {result.changes}"
            f"{': certify its parts, result.arcs' if result.arcs else ''}"
        )
    look = _Look(result, result.system, *_tolerances(result, result.system.n_q, rtol, atol))
    defect, where = 0.0, float(look.t[0])
    unseen: list[tuple[float, float]] = []
    for i, j, found in look.pieces():
        if not np.isfinite(found):
            start = unseen.pop()[0] if unseen and unseen[-1][1] == look.t[i] else float(look.t[i])
            unseen.append((start, float(look.t[j])))
        elif found > defect:
            defect, where = found, float(look.t[i])
    gap = max([look.gap, *(end - start for start, end in unseen)])
    passed = defect <= LIMIT and not unseen
    message = _in_words(result, defect, where, gap, unseen)
    if defect > LIMIT:
        warnings.warn(message, CertificateWarning, stacklevel=3)
    return Certificate(defect, where, gap, LIMIT, tuple(unseen), passed, message)


def _tolerances(result: Record, n_q: int, rtol: float | None, atol: ArrayLike | None) -> tuple[float, Array]:
    """Those given, else those of the run; and what is wrong with them or the result, if anything is."""
    if result.t.size < 2:
        raise ValueError(f"certify needs a result with two times or more; this one has {result.t.size}")
    rtol, atol = result.rtol if rtol is None else rtol, result.atol if atol is None else atol
    if rtol is None or atol is None:
        raise ValueError(
            "certify needs tolerances, and this result does not know any (another solver made it, or it is of an older "
            "file): give rtol and atol"
        )
    check_positive("rtol", rtol)
    return float(rtol), check_tolerance("atol", atol, n_q)


class _Look:
    """The states of a result, and what makes the pieces between them again.

    Attributes
    ----------
    t, states : ndarray (n,), (n, 2 n_q)
        All that are known, rows [q, v].
    gap : float
        The widest so far, s.
    """

    def __init__(self, result: Record, system: ConstrainedSystem, rtol: float, atol: Array):
        self.result, self.sol, self.system, self.rtol, self.atol = result, result.sol, system, rtol, atol
        self.t, self.states = result.t, np.vstack([result.q, result.v]).T
        if result.sol is not None:  # the states at all steps, and those stored at other times
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
        self.remakers: dict[tuple[str, float], Remaker] = {}

    def _steps(self, result: Record) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """How many steps of the run touch each interval, and whether one of them left velocities untested."""
        n, m = len(self.t) - 1, len(result.h)
        untested = np.zeros(m, dtype=bool) if result.untested is None else result.untested
        start = self.t[0] if result.sol is None else result.sol.t_min
        ends = start + np.cumsum(result.h)
        near = 1e-9 * (self.t[-1] - self.t[0])
        if m == 0 or (result.success and abs(ends[-1] - self.t[-1]) > near):  # it is not known where the steps were
            return np.full(n, -(-m // n) + 1), np.full(n, untested.any())
        first = np.minimum(np.searchsorted(ends, self.t[:-1] + near), m - 1)
        last = np.minimum(np.searchsorted(ends, self.t[1:] - near), m - 1)
        before = np.append(0, np.cumsum(untested))
        return last - first + 1, before[last + 1] > before[first]

    def pieces(self) -> Iterator[tuple[int, int, float]]:
        """First and last state of each piece, and its defect; infinite where it cannot be made again."""
        i, last = 0, len(self.t) - 1
        while i < last:
            j = i + 1
            while j < last and self.t[j + 1] - self.t[i] <= self.longest and self.untested[j] == self.untested[i]:
                j += 1
            found = self._defect(i, j)
            if SEVERAL < found < np.inf and j > i + 1:
                yield from self._steps_of(i, j)
                if self.untested[i]:  # what a velocity is off by shows in the positions of later steps only
                    yield i, j, found / (j - i)
            else:
                yield i, j, found
            i = j

    def _steps_of(self, i: int, j: int) -> Iterator[tuple[int, int, float]]:
        """The same for the steps of a piece that is off: by the errors of many, or by some that are wrong."""
        wrong = 0
        for k in range(i, j):
            found = self._defect(k, k + 1)
            wrong += found > LIMIT
            if wrong == ENOUGH and not np.isfinite(found):
                yield k, j, found
            else:
                yield k, k + 1, found
            if wrong == ENOUGH:
                return

    def _defect(self, i: int, j: int) -> float:
        """The defect from state i to state j, the smaller one of two unlike methods where the first finds too much."""
        newton = bool(self.result.stats.n_jacobians) and (self.result.untested is None or self.untested[i])
        stiff = "positions" if self.untested[i] else "all"
        order = (stiff, "explicit") if newton else ("explicit", stiff)
        found = [(np.inf, "")]
        for method in order:
            found.append((self._by(method, 1.0, i, j), method))
            least, by = min(found)
            if least <= LIMIT or (least < np.inf and j > i + 1):
                return least
        if least < np.inf:  # is it the step, or does whatever is there grow so?
            growth = self._growth(by, i, j)
            return least / (growth if growth > USUAL else 1.0) if growth <= LIMIT else np.inf
        for looser in LOOSER:  # near a singular position rounding may allow no better
            for method in order:
                least = self._by(method, looser, i, j)
                if least < np.inf:
                    return least
        return np.inf

    def _by(self, method: str, looser: float, i: int, j: int) -> float:
        """The defect from state i to state j by a method, at tolerances so much looser."""
        made = self._again(method, looser, self.states[i], i, j)
        if made is None:
            return np.inf
        at_end = self._distance(made.end, self.states[j], i, j)
        several = 1 if j > i + 1 else int(self.n_steps[i])  # of a run that kept no state between them
        return max(at_end, self._off_between(made.between, i, j)) / float(np.sqrt(several))

    def _off_between(self, state: Array, i: int, j: int) -> float:
        """How far the dense solution is from a state made again, over the tolerance."""
        t = self._between(i, j)
        if self.sol is None or not self.t[i] < t < self.t[j]:
            return 0.0
        table = self.sol.table
        if table.kinds[np.searchsorted(table.t, t) - 1] == APART:  # there the states themselves are not as good
            return 0.0
        found = self.sol(t)
        return self._distance(state, np.concatenate([found.q, found.v]), i, j)

    def _growth(self, method: str, i: int, j: int) -> float:
        """How many times the tolerance an error of about that size at state i is at state j."""
        one, other = (self._again(method, 1.0, start, i, j) for start in (self.states[i], self._beside(i)))
        return np.inf if one is None or other is None else self._distance(one.end, other.end, i, j)

    def _beside(self, i: int) -> Array:
        """A state beside state i, as far from it as the tolerances allow, on the constraints."""
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

    def _distance(self, state: Array, other: Array, i: int, j: int) -> float:
        """The largest difference of two states over the tolerance, in what the steps between i and j have tested."""
        with np.errstate(invalid="ignore"):  # of states that are not finite: what comes out is NaN, and not looked at
            error = np.abs(state - other) / self._allowed(other)
        return float((error[: len(self.atol)] if self.untested[i:j].any() else error).max())

    def _again(self, method: str, looser: float, start: Array, i: int, j: int) -> Remade | None:
        """The states up to state j, made again from `start` in the place of state i."""
        key = (method, looser)
        if key not in self.remakers:
            made = explicit() if method == "explicit" else implicit(method == "all")
            q, v = self.states[0].reshape(2, -1).copy()
            rtol, atol = looser * float(tighter(self.rtol)), looser * tighter(self.atol)
            self.remakers[key] = Remaker(self.system, float(self.t[0]), q, v, made, rtol, atol, self.longest)
        remaker = self.remakers[key]
        t0, t1 = float(self.t[i]), float(self.t[j])
        most = MOST + MOST_A_STEP * (int(self.n_steps[i:j].sum()) + int((t1 - t0) / self.longest))
        found = remaker.to(t0, start, self._between(i, j), t1, most if looser == 1.0 else MOST)
        if found is not None:
            self.gap = max(self.gap, found.longest * remaker.spacing)
        return found

    def _between(self, i: int, j: int) -> float:
        """A time between the states i and j, in the middle of the longest interval; that of state j without `sol`."""
        if self.sol is None:
            return float(self.t[j])
        k = i + int(np.diff(self.t[i : j + 1]).argmax())
        return float(0.5 * (self.t[k] + self.t[k + 1]))


def _in_words(result: Record, defect: float, where: float, gap: float, unseen: list[tuple[float, float]]) -> str:
    """What was found, what it proves and what not."""
    of = result.method or "the run"
    parts = []
    if defect > LIMIT:
        parts.append(
            f"Not passed: from t = {where:.6g} on a step of {of} ends {defect:.2g} times its tolerance away from where "
            f"the equations lead ({LIMIT:g} times would pass). Something within it was passed over, or the tolerance "
            "is not held: limit max_step, or take another method."
        )
    else:
        parts.append(
            f"{'Passed' if not unseen else 'Passed in part'}: made again from its own states, no part of the run ends "
            f"more than {defect:.2g} times the tolerance of a step away from what is stored ({LIMIT:g} times would "
            "pass)."
        )
    if unseen:
        spans = ", ".join(f"{start:.6g} to {end:.6g}" for start, end in unseen[:3]) + (", ..." if unseen[3:] else "")
        parts.append(
            f"Nothing can be said of t = {spans}, where no step could be made again, or errors "
            "grow too fast to tell a wrong one."
        )
    parts.append(
        f"The equations were looked at every {gap:.2g} s or closer: what lasts less may be missed. How errors of steps "
        "grow over the run is not certified, nor is the model."
    )
    return " ".join(parts)
