"""Project a guess onto the constraints (`consistent_state`); report how far the guess moved, and its assembly.

Large systems are projected by sparse factors. Dense factors are used in three cases: rows of C_q are dependent at
consistent positions, but only nearly dependent at the guess; a dead centre is near; the assembly is not certain.
"""

from __future__ import annotations  # so that help() shows the name ArrayLike

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from twoloop.checks.arguments import check_finite, check_flag, check_indices, check_vector
from twoloop.checks.callbacks import check_bounds
from twoloop.checks.consistency import CONSISTENT, Violation, is_at_rounding
from twoloop.checks.scales import Scales, scales_of, typical_sizes, units
from twoloop.checks.sparse_rows import SparseRows
from twoloop.checks.structure import not_finite
from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import indices
from twoloop.kernels.evaluation import tasks
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.run.signals import signals_of
from twoloop.run.workspace import fixed_order_form, make_kit, workspace

Array = NDArray[np.float64]

MIN_SINE = 1e-5  # a dead centre is near if sin(angle between a row of C_q and the span of other rows) is below this
# MAX_CORRECTIONS: largest number of Newton iterations. The iteration ends if a correction is at most ROUNDING * max|q|
MAX_CORRECTIONS, ROUNDING = 25, 1e-14
# C_q predicts, to first order, where a displaced guess is projected. If the prediction is wrong by more than this
# fraction of the displacement, the guess may lead to another assembly
MAX_NONLINEARITY = 0.5


class _SparseProjection:
    """Least-change projection of a large system onto constraints, by the fixed-order form with M = unit matrix."""

    def __init__(self, system: ConstrainedSystem, t: float, q: Array, form: Any, rank: int | None = None):
        self.system, self.t, self.rank = system, t, rank
        self.form = form._replace(sizes=form.sizes._replace(dense_mass=False), mass_pattern=np.zeros((0, 0)))
        self.kit = make_kit(system, t, q, None, self.form)
        self.kit.flags[indices.CONSTANT_MASS], self.kit.flags[indices.MASS_VALUES_GIVEN] = 1, 0
        self.work = workspace(system, self.kit, np.zeros((0, 0)), q, 1e-8, 0.0, (rank, rank), self.form)
        rows, columns = form.mass
        diagonal = np.where(rows == columns, 1.0, 0.0)
        self.work.mass_values[:] = diagonal / np.bincount(rows, diagonal, system.n_q)[rows]

    def run_task(self, task: int, q: Array, v: Array, a: Array | None = None, lam: Array | None = None) -> int:
        """Run a task of the inner loop (see evaluation/tasks.py), which may change q, v, a and lam; return a code."""
        a, lam = self.work.x if a is None else a, self.work.lam if lam is None else lam
        return int(entry_point(self.kit.inner)(self.kit, self.work, task, self.t, q, v, 0.0, a, lam))

    def allowed_part(self, displacement: Array) -> Array:
        """Return the projection of a displacement (n_q,) onto the displacements that C_q at `self.position` allows."""
        rows = self.system.sparse_rows(self.t, self.position)
        change = np.zeros(len(displacement))
        zero, residual = np.zeros(len(displacement)), np.ascontiguousarray(rows @ displacement)
        self.run_task(tasks.SOLVE, zero, residual, change)
        return displacement - change

    def project_nearby(self, q: Array) -> Array | None:
        """Return q projected onto the independent constraints; None on failure, or if other constraints are violated.

        The independent rows of C_q are those that the last task RENEW_PARTITION found at a consistent position: at
        other positions, redundant rows are not quite dependent.
        """
        zero, change = np.zeros(len(q)), np.zeros(len(q))
        for _ in range(MAX_CORRECTIONS):
            if self.run_task(tasks.FIND_NULL_SPACE, q, zero) != indices.DONE:
                return None
            self.run_task(tasks.SOLVE, zero, self.system.constraint(self.t, q), change)
            q = q - change
            if not np.abs(change).max() > ROUNDING * np.abs(q).max():  # also true for NaN
                break
        residual = self.system.constraint(self.t, q)
        return q if is_at_rounding(residual, self.system.sparse_rows(self.t, q), q) else None

    def project(self, q: Array, v: Array) -> tuple[Array, Array] | None:
        """Return q and v projected onto the constraints, or None on failure; store q in `self.position`."""
        q, discarded = q.copy(), v.copy()
        if self.run_task(tasks.RENEW_PARTITION, q, v) != indices.DONE:
            return None
        if self.run_task(tasks.RESTORE, q, discarded) != indices.DONE:
            return None
        v = v.copy()  # until the positions are final, only a copy of the velocities is projected
        for task in (tasks.RESTORE, tasks.RESTORE, tasks.FIND_NULL_SPACE):  # RESTORE runs twice, for higher accuracy
            if self.run_task(task, q, v) != indices.DONE:
                return None
        self.position = q
        return q, v


class Dependence(NamedTuple):
    """Rank of C_q of a large system at a position, and the rows that depend on others."""

    rank: int
    coefficients: dict[int, Array]  # for each dependent row: x (n_c,) with row = x @ C_q; x[k] = 0 for dependent rows k
    allowed_move: Array  # random displacement (n_q,) that C_q allows; max|entry / (unit of coordinate)| = 1
    project_nearby: Callable[[Array], Array | None]  # projects a position near q; returns None on failure


def dependence(system: ConstrainedSystem, t: float, q: Array) -> Dependence | None:
    """Find which rows of C_q of a large system depend on the others at q; None if sparse factors are not reliable."""
    form, all_rows = fixed_order_form(system, t, q), system.sparse_rows(t, q)
    if form is None or not isinstance(all_rows, SparseRows):
        return None
    projection, at_rest = _SparseProjection(system, t, q, form), np.zeros_like(q)
    code = projection.run_task(tasks.RENEW_PARTITION, q.copy(), at_rest)
    if code == indices.RANK_DIFFERS:
        projection = _SparseProjection(system, t, q, form, int(projection.work.notes[indices.RANK]))
        code = projection.run_task(tasks.RENEW_PARTITION, q.copy(), at_rest)
    if code != indices.DONE or projection.work.notes[indices.PIVOT] < MIN_SINE:
        return None
    independent, unused = set(projection.work.rows_v.tolist()), np.zeros_like(q)
    coefficients: dict[int, Array] = {}
    for row in range(system.n_c):
        if row not in independent:
            coefficients[row] = np.zeros(system.n_c)
            projection.run_task(tasks.SOLVE, all_rows.row(row), np.zeros(system.n_c), unused, coefficients[row])
    projection.position = q
    columns = units(system, t, q, all_rows, typical_sizes(q))
    allowed_move = projection.allowed_part(columns * np.random.default_rng(3).uniform(0.5, 1.0, len(q)))
    norm = float((np.abs(allowed_move) / columns).max())
    return Dependence(
        len(independent), coefficients, allowed_move / norm if norm > 0.0 else allowed_move, projection.project_nearby
    )


def project_sparsely(
    system: ConstrainedSystem, t: float, q: Array, v: Array, check_assembly: bool
) -> tuple[Array, Array] | None:
    """Return (q, v) projected by sparse factors; None on failure, or if nearby guesses may end on another assembly."""
    form = fixed_order_form(system, t, q)
    if form is None:
        return None
    with np.errstate(all="ignore"):
        projection = _SparseProjection(system, t, q, form)
    code = projection.run_task(tasks.RENEW_PARTITION, q.copy(), v.copy())
    if code == indices.RANK_DIFFERS:
        projection = _SparseProjection(system, t, q, form, int(projection.work.notes[indices.RANK]))
    elif code != indices.DONE:
        return None
    projected = projection.project(q, v)
    if projected is None or projection.work.notes[indices.PIVOT] < MIN_SINE:
        return None
    # give up if rows that are independent at the guess are not independent at the projected position
    projection_there = _SparseProjection(system, t, projected[0], form, projection.rank)
    if projection_there.run_task(tasks.RENEW_PARTITION, projected[0].copy(), v.copy()) != indices.DONE:
        return None
    rows, rate = system.sparse_rows(t, projected[0]), system.rates(t, projected[0])
    if not is_at_rounding(system.constraint(t, projected[0]), rows, projected[0]):
        return None
    if not is_at_rounding(rows @ projected[1] + rate, rows, projected[1], rate):
        return None
    change = projected[0] - q
    if check_assembly and np.abs(change).max() > 0.0 and not _nearby_guesses_match(projection, projected[0], change):
        return None
    return projected


def _nearby_guesses_match(projection: _SparseProjection, position: Array, change: Array) -> bool:
    """Return whether three guesses near a projected `position` lead to the same assembly as the user's guess.

    `change`: displacement of the user's guess by its projection. The three guesses are displaced from `position` by
    -2 * change, and by two random vectors of at most max|change|. A guess leads to the same assembly if the linearized
    constraints predict where it is projected.
    """
    distance = float(np.abs(change).max())
    directions = np.random.default_rng(8).uniform(-1.0, 1.0, (2, len(position)))
    at_rest = np.zeros(len(position))
    for displacement in (-2.0 * change, distance * directions[0], distance * directions[1]):
        if projection.project(position, at_rest) is None:
            return False
        expected = position + projection.allowed_part(displacement)
        projected = projection.project(position + displacement, at_rest)
        if projected is None or np.abs(projected[0] - expected).max() > MAX_NONLINEARITY * np.abs(displacement).max():
            return False
    return True


MAX_ITERATIONS = 50  # largest number of Gauss-Newton iterations
# the iteration ends if violation / allowed violation is at most this, and the last step has not halved the violation
CONVERGED_VIOLATION = 1e-2
# singular values of C_q count as zero below these fractions of the largest one. RANK_CUTOFF: for ranks. LSTSQ_CUTOFF:
# for least-squares solutions. REDUNDANT_CUTOFFS: for least-squares solutions with redundant rows, tried in this order:
# off the constraints, redundant rows are only nearly dependent; in long chains, so are rows that are needed
RANK_CUTOFF, LSTSQ_CUTOFF, REDUNDANT_CUTOFFS = 1e-10, 1e-13, (1e-2, 1e-3, 1e-4, 1e-5)
# a dead centre is near if the ratio of the smallest to the largest singular value of C_q is at most this
DEAD_CENTRE_RATIO = 0.01
MAX_EQUAL_DISTANCE = 0.1  # projected guesses are equal if their distance / (largest change by projection) is below this
MAX_CHANGE = 1e8  # the iteration has diverged if a coordinate changes by more than this, in its unit (`Scales.columns`)


class Move(NamedTuple):
    """Largest change that the projection made, and the coordinate that it changed."""

    change: float
    coordinate: int


class ConsistentState(tuple[Array, Array]):
    """Tuple (q, v) that `consistent_state` returns, with a report of the projection.

    Attributes
    ----------
    moved_q, moved_v : Move
        Largest change of a position and of a velocity: (change, coordinate).
    dependent : tuple of int (rank,)
        Dependent coordinates: the best conditioned columns of C_q, in ascending order, without coordinates in `keep`.
    determinant_sign : int
        Sign of the determinant of these columns of C_q; 0 if C_q lacks full rank. Two positions with the same values
        of the other coordinates and opposite signs are on different assemblies, with a dead centre between them.
    margin : float
        Smallest over largest singular value of these columns, after scaling of rows and columns: 0 at a dead centre.

    Examples
    --------
    >>> from twoloop import consistent_state
    >>> from twoloop.mechanisms import pendulum
    >>> q, v = consistent_state(pendulum().system, 0.0, [0.6, -0.9], [1.0, 1.0])
    >>> q.shape, v.shape
    ((2,), (2,))
    """

    moved_q: Move
    moved_v: Move
    dependent: tuple[int, ...]
    determinant_sign: int
    margin: float


def consistent_state(
    system: ConstrainedSystem,
    t: float,
    q: ArrayLike,
    v: ArrayLike,
    *,
    keep: Sequence[int] | None = None,
    check_assembly: bool = True,
) -> ConsistentState:
    """Project a guess onto the constraints: positions by Gauss-Newton, then velocities, each by the smallest change.

    Parameters
    ----------
    system : ConstrainedSystem
    t : float
        Time, s.
    q, v : array_like (n_q,)
        Guess. Its distance from the constraints should be small compared with the mechanism.
    keep : sequence of int, optional
        Coordinates whose position and velocity are not changed, such as a crank's. None: all may change.
    check_assembly : bool
        Whether three other guesses, up to twice as far from the constraints, must lead to the same assembly. False:
        accept the position that the projection finds.

    Returns
    -------
    q, v : ndarray (n_q,)
        State with C(t, q) = 0 and C_q v + C_t = 0 to rounding. The tuple has attributes for how far the guess moved
        (`moved_q`, `moved_v`) and for the assembly (`determinant_sign`, `margin`); see `ConsistentState`.

    Raises
    ------
    TypeError, ValueError
        If a shape is wrong, a value is not finite, `keep` leaves too little freedom, or no consistent position is found
        near the guess. Also if a guess up to twice as far away leads to another assembly, usually near a dead centre.

    Examples
    --------
    >>> from twoloop import consistent_state
    >>> from twoloop.mechanisms import pendulum
    >>> problem = pendulum()
    >>> q, v = consistent_state(problem.system, 0.0, [0.6, -0.9], [1.0, 1.0])
    >>> bool(abs(problem.system.constraint(0.0, q)[0]) < 1e-12), bool(abs(q @ v) < 1e-12)  # v along the circle
    (True, True)
    """
    check_system(system)
    check_flag("check_assembly", check_assembly)
    t = check_finite("t", t)
    guess = check_vector("q", q, system.n_q)
    speeds = check_vector("v", v, system.n_q)
    kept = [] if keep is None else check_indices("keep", keep, system.n_q)
    with signals_of(system):
        state = _project_state(system, t, guess, speeds, kept, check_assembly)
    state.moved_q, state.moved_v = _largest_move(state[0] - guess), _largest_move(state[1] - speeds)
    return state


def _project_state(
    system: ConstrainedSystem, t: float, guess: Array, speeds: Array, kept: list[int], check_assembly: bool
) -> ConsistentState:
    """Project positions `guess` and velocities `speeds`; return the state, still without `moved_q` and `moved_v`."""
    free = np.array([j for j in range(system.n_q) if j not in kept], dtype=int)
    check_bounds(system, t, guess, speeds)
    system.check_returned(t, guess, speeds)
    reason = not_finite(system, t, guess, speeds)
    if reason is not None:
        raise ValueError(f"q and v cannot be projected: {reason} at t = {t:g}")
    sparse_result = None if kept else project_sparsely(system, t, guess, speeds, check_assembly)
    if sparse_result is not None:
        large = _LargeState(sparse_result)
        large.system, large.t = system, t
        return large
    position = _projected_position(system, t, guess, free, kept, check_assembly) if system.n_c > 0 else guess
    jacobian = system.rows(t, position)
    change = _least_change(jacobian, free, -system.velocity_constraint(t, position, speeds))
    velocity = speeds + change
    scales = scales_of(system, t, position, jacobian)
    violation = Violation.measure_v(system, t, position, velocity, jacobian, scales) if len(jacobian) > 0 else None
    if violation is not None and violation.excess > 1.0:
        why = f"max|C_q v + C_t| stays at {_format_largest(violation.values)}"
        raise ValueError(_describe_no_freedom(system, t, scales.scaled(jacobian), free, kept, why))
    state = ConsistentState((position, velocity))
    state.dependent, state.determinant_sign, state.margin = _identify_assembly(scales.scaled(jacobian), free)
    return state


class _LargeState(ConsistentState):
    """Consistent state of a large system, whose assembly needs full matrices, and is computed only when it is read."""

    system: ConstrainedSystem
    t: float

    def __getattr__(self, name: str) -> Any:
        if name not in ("dependent", "determinant_sign", "margin"):
            raise AttributeError(name)
        q = self[0]
        jacobian = self.system.rows(self.t, q)
        scaled = scales_of(self.system, self.t, q, jacobian).scaled(jacobian)
        self.dependent, self.determinant_sign, self.margin = _identify_assembly(scaled, np.arange(len(q)))
        return vars(self)[name]


def _projected_position(
    system: ConstrainedSystem, t: float, guess: Array, free: NDArray[np.intp], kept: list[int], check_assembly: bool
) -> Array:
    """Return a guess projected by changes of its `free` coordinates; raise ValueError on failure.

    If `check_assembly`, also raise ValueError if another assembly may be as near to the guess as the result.
    """
    jacobian = system.jacobian(t, guess)
    scales = scales_of(system, t, guess, jacobian)
    scaled = scales.scaled(jacobian)
    violation = Violation.measure_q(system, t, guess, jacobian, scales)
    if violation.excess > CONVERGED_VIOLATION and _rank(scaled[:, free]) < _rank(scaled):
        why = f"max|C| stays at {_format_largest(violation.values)}"
        raise ValueError(_describe_no_freedom(system, t, scaled, free, kept, why))
    position, excess, iterations = _gauss_newton(system, t, guess, free)
    has_redundant_rows = position is None or _rank(scales.scaled(system.jacobian(t, position))) < system.n_c
    cutoff = LSTSQ_CUTOFF
    for cutoff in REDUNDANT_CUTOFFS if has_redundant_rows else ():
        position, excess, iterations = _gauss_newton(system, t, guess, free, cutoff)
        if position is not None and excess <= 1.0:
            break
    if position is None or not excess <= 1.0:
        has_diverged = position is None
        largest = _format_largest(system.constraint(t, guess if has_diverged else position))
        outcome = f"the iteration diverges; at q max|C| is {largest}"
        if not has_diverged:
            outcome = f"after {iterations} iterations max|C| is {largest}"
        raise ValueError(
            f"q cannot be projected onto the constraints of {system.name!r} at t = {t!r}: {outcome}. Give a guess that "
            f"is nearer to an assembled position{_describe_rank_loss(scales, jacobian, free, kept)}"
        )
    shift = float((np.abs(position - guess) / scales.columns).max())
    if check_assembly and (violation.excess > 1.0 or shift > CONSISTENT):  # q may move far although C is almost zero
        ending = _describe_other_assembly(system, t, position, guess, free, scales, cutoff)
        if ending is not None:
            jacobian_there = system.jacobian(t, position)
            raise ValueError(
                f"q does not say on which assembly of {system.name!r} it is at t = {t!r}: its projection moves "
                f"{_describe_change(guess, position, scales)}, and that of another guess as far away {ending}. Give a "
                "guess that is nearer to the assembly that is meant, or farther from a dead centre; "
                f"twoloop.consistent_state(..., check_assembly=False) takes the one found"
                f"{_describe_rank_loss(scales, jacobian_there, free, kept)}"
            )
    return position


def _describe_other_assembly(
    system: ConstrainedSystem, t: float, q1: Array, guess: Array, free: NDArray[np.intp], scales: Scales, cutoff: float
) -> str | None:
    """Project three guesses near q1; return a phrase about one that may end on another assembly; None if none may.

    q1 is the projection of `guess`. The three guesses are at most twice as far from q1 as `guess`. One of them
    leads to the same assembly if its projection is near the point that C_q predicts to first order, and the determinant
    of the dependent columns of C_q keeps its sign. Otherwise, Newton's method starts from q1 with the dependent
    coordinates of its projection. There is another assembly if Newton's method does not lead back to q1.
    """
    scaled_move = (q1 - guess) / scales.columns
    largest_move = float(np.abs(scaled_move).max())
    jacobian = system.jacobian(t, q1)
    dependent, sign, _ = _identify_assembly(scales.scaled(jacobian), free)
    dependent_columns = list(dependent)

    def distance(a: Array, b: Array) -> float:
        return float(np.abs((a - b) / scales.columns).max())

    def sign_at(q: Array) -> int:
        block = scales.scaled(system.jacobian(t, q))[:, dependent_columns]
        return int(np.linalg.slogdet(block)[0]) if sign != 0 else 0

    weakest_move = largest_move * _weakest_direction(scales.scaled(jacobian), free)
    for move in (-2.0 * scaled_move, weakest_move, -weakest_move):
        displacement = move * scales.columns
        projected, excess, _ = _gauss_newton(system, t, q1 + displacement, free, cutoff)
        if projected is None or not excess <= 1.0:
            return "does not converge"
        expected = q1 + displacement + _least_change(jacobian, free, -(jacobian @ displacement), cutoff)
        if distance(projected, expected) <= MAX_NONLINEARITY * float(np.abs(move).max()) and sign_at(projected) == sign:
            continue
        # `projected` is on another assembly, or only the curvature of constraints moves it away from `expected`. If it
        # is only the curvature, Newton's method leads from `mixed` (q1 with dependent entries of `projected`) to q1
        mixed = q1.copy()
        mixed[dependent_columns] = projected[dependent_columns]
        mixed_projected, excess, _ = _gauss_newton(system, t, mixed, np.array(dependent_columns, dtype=int), cutoff)
        if mixed_projected is None or not excess <= 1.0:
            return "ends elsewhere, from where no way leads back to it"
        if distance(mixed_projected, q1) > MAX_EQUAL_DISTANCE * largest_move or sign_at(mixed_projected) != sign:
            return f"ends on another one, which differs by {_describe_change(q1, mixed_projected, scales)}"
    return None


def _describe_change(before: Array, after: Array, scales: Scales) -> str:
    """Describe the largest change of a coordinate, with enough digits of both values to show that they differ."""
    j = int(np.abs((after - before) / scales.columns).argmax())
    magnitude, change = max(abs(float(before[j])), abs(float(after[j]))), abs(float(after[j] - before[j]))
    digits = min(17, 3 + max(0, math.ceil(math.log10(magnitude / change)))) if change > 0.0 else 3
    return f"coordinate {j} from {before[j]:.{digits}g} to {after[j]:.{digits}g}"


def _gauss_newton(
    system: ConstrainedSystem, t: float, q: Array, free: NDArray[np.intp], cutoff: float = LSTSQ_CUTOFF
) -> tuple[Array | None, float, int]:
    """Change the `free` entries of q until it is consistent, by the Gauss-Newton method.

    Return q (None if the iteration diverges), violation / allowed violation of q, and the number of iterations.
    """
    least_excess, best_q, guess = np.inf, q, q
    for iteration in range(1, MAX_ITERATIONS + 1):
        try:
            jacobian, values = system.jacobian(t, q), system.constraint(t, q)
        except (ArithmeticError, ValueError):  # the iteration has left the domain of the callbacks
            return None, np.inf, iteration
        if not (np.isfinite(jacobian).all() and np.isfinite(values).all()):
            return None, np.inf, iteration
        step = _least_change(jacobian, free, -values, cutoff)
        scales = scales_of(system, t, q, jacobian)
        excess = Violation.measure_q(system, t, q, jacobian, scales).excess
        if excess == 0.0 or (excess <= CONVERGED_VIOLATION and excess >= 0.5 * least_excess):
            return q, excess, iteration  # converged: rounding prevents a smaller violation
        if excess < least_excess:
            least_excess, best_q = excess, q
        q = q + step
        if not (np.abs(q - guess) <= MAX_CHANGE * scales.columns).all():  # also true for NaN
            return None, np.inf, iteration
    # no convergence, perhaps because of rounding: the best position may still satisfy the constraints (excess <= 1)
    return best_q if least_excess <= 1.0 else q, least_excess, MAX_ITERATIONS


def _least_change(jacobian: Array, free: NDArray[np.intp], values: Array, cutoff: float = LSTSQ_CUTOFF) -> Array:
    """Return the smallest dq (n_q,) with C_q dq = values that changes only the `free` coordinates."""
    norms = np.linalg.norm(jacobian, axis=1)
    norms = np.where(norms > 0.0, norms, 1.0)
    change = np.zeros(jacobian.shape[1])
    change[free] = np.linalg.lstsq(jacobian[:, free] / norms[:, None], values / norms, rcond=cutoff)[0]
    return change


def _rank(scaled: Array) -> int:
    """Return the number of singular values of the scaled C_q above RANK_CUTOFF times the largest one."""
    values = np.linalg.svd(scaled, compute_uv=False)
    return int((values > RANK_CUTOFF * max(float(values.max(initial=0.0)), 1e-300)).sum())


def _identify_assembly(scaled: Array, free: NDArray[np.intp]) -> tuple[tuple[int, ...], int, float]:
    """Return `dependent`, `determinant_sign` and `margin` of a ConsistentState, given the scaled C_q (n_c, n_q)."""
    rank = _rank(scaled[:, free])
    if rank == 0:
        return (), 0, 0.0
    order = qr(scaled[:, free], mode="r", pivoting=True)[1]
    dependent = tuple(sorted(int(j) for j in free[order[:rank]]))
    if rank < len(scaled):
        return dependent, 0, 0.0
    block = scaled[:, list(dependent)]
    values = np.linalg.svd(block, compute_uv=False)
    return dependent, int(np.linalg.slogdet(block)[0]), float(values.min() / values.max())


def _weakest_direction(scaled: Array, free: NDArray[np.intp]) -> Array:
    """Return the right singular vector x of the smallest nonzero singular value of the scaled C_q, with max|x| = 1."""
    values, rows = np.linalg.svd(scaled[:, free], full_matrices=False)[1:]
    nonzero = values > RANK_CUTOFF * values.max()
    direction = np.zeros(scaled.shape[1])
    direction[free] = rows[nonzero][-1] / np.abs(rows[nonzero][-1]).max()
    return direction


def _describe_rank_loss(scales: Scales, jacobian: Array, free: NDArray[np.intp], kept: list[int]) -> str:
    """Return a sentence if C_q nearly loses rank, both unscaled and with scaled rows and columns; else ""."""
    if jacobian[:, free].size == 0:
        return ""
    values = [np.linalg.svd(each[:, free], compute_uv=False) for each in (jacobian, scales.scaled(jacobian))]
    ratios = [float(each.min()) / max(float(each.max()), 1e-300) for each in values]
    if max(ratios) > DEAD_CENTRE_RATIO:
        return ""
    columns = f" without the columns of keep={kept}" if kept else ""
    return (
        f". There C_q{columns} nearly loses rank, as at a dead centre: its smallest singular value is {ratios[0]:.2g} "
        "of the largest"
    )


def _describe_no_freedom(
    system: ConstrainedSystem, t: float, scaled: Array, free: NDArray[np.intp], kept: list[int], why: str
) -> str:
    """Return the message for a failed projection if columns of C_q lack rank; `why`: phrase about the violation."""
    ranks = f"rank {_rank(scaled[:, free])} of {len(scaled)}"
    name = "C_q" if len(scaled) == system.n_c else "[C_q; A], whose rows contradict one another at these velocities,"
    if not kept:
        return f"{name} of {system.name!r} has {ranks} at t = {t!r}, and {why}: give a guess away from this position"
    return (
        f"keep leaves too little freedom: without the columns {kept} {name} of {system.name!r} has {ranks} at "
        f"t = {t!r}, and {why}. Keep fewer coordinates, or give a guess away from a dead centre"
    )


def _format_largest(values: Array) -> str:
    return f"{float(np.abs(values).max()):.3g}"


def _largest_move(change: Array) -> Move:
    j = int(np.abs(change).argmax())
    return Move(float(change[j]), j)
