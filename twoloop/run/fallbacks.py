"""Continue a run where its own steps cannot: with another method, across a singular position, or over a jump.

Also decide whether a run is repeated with more evaluations, because forces changed for so short a time that it may have
missed other changes. It is repeated at most MAX_REPETITIONS times: in noisy forces, every repetition would find shorter
changes. If the last repetition may have missed changes, too, the run warns.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.structure import redundant_rows
from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import indices
from twoloop.kernels.data.common import Kit
from twoloop.kernels.evaluation import tasks
from twoloop.methods.plan import Plan, crossing_plan, least_tolerance
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.messages import warn_user
from twoloop.run.run import Run
from twoloop.run.singular_positions import TimedState
from twoloop.run.workspace import kit_for_plan, make_kit

# let r be (duration of the shortest change of forces or drives seen in a run) / (longest time between evaluations). If
# r < REPEAT_BELOW, the run may have missed shorter changes, and is repeated. If r < WARN_BELOW, the run may even have
# missed changes of this duration: it warns, unless it is repeated
REPEAT_BELOW, WARN_BELOW = 2.0, 1.25
EVALUATIONS_PER_CHANGE = 4.0  # number of evaluations that a repetition makes within the shortest change seen so far
MAX_REFINEMENT = 8.0  # largest factor by which a repetition reduces the longest time between evaluations
MAX_REPETITIONS = 2  # largest number of repetitions of a run that may have missed short changes of forces


def may_have_missed_changes(run: Run, limit: float = REPEAT_BELOW) -> bool:
    """Return whether the shortest change of forces is shorter than `limit` * (longest time between evaluations)."""
    a, clock = run.a, run.clock
    return bool(clock[a.SHORTEST_CHANGE] < limit * clock[a.WIDEST_SAMPLING])


def gap_for_repetition(run: Run) -> float:
    """Return the longest allowed time (s) between evaluations when a run that may have missed changes is repeated."""
    a, clock = run.a, run.clock
    return float(max(clock[a.SHORTEST_CHANGE] / EVALUATIONS_PER_CHANGE, clock[a.WIDEST_SAMPLING] / MAX_REFINEMENT))


def warn_of_missed_changes(run: Run) -> str:
    """Warn if a run that is not repeated may have missed short changes of forces; return the warning, else ""."""
    if not may_have_missed_changes(run, WARN_BELOW):
        return ""
    a, clock = run.a, run.clock
    text = (
        f"forces, constraint_rate or nonholonomic_rate change suddenly for {clock[a.SHORTEST_CHANGE]:.2g} s, and were "
        f"sampled every {clock[a.WIDEST_SAMPLING]:.2g} s only, where steps are long: other changes as short may have "
        f"been missed. Give max_step, at most {clock[a.SHORTEST_CHANGE]:.2g}"
    )
    return warn_user(text)


Array = NDArray[np.float64]

N_CORRECTIONS = 3  # number of Newton steps that suffice to reduce errors of positions from the tolerances to rounding
# in least-squares solutions, singular values up to this fraction of the largest count as zero (redundant rows)
NEGLIGIBLE_RATIO = 1e-12
MAX_SCALINGS = 20  # largest number of iterations of `equilibrating_units`
N_REFINEMENTS = 2  # number of times that a solution is corrected by the solution for its residual
MAX_RESIDUAL = 1e-8  # limit of residual / (sum of |terms| + max|r|) in rows of G dv = r (dv, r: jumps of v, -[C_t, b])


def state_after_jump(system: ConstrainedSystem, t: float, q: Array, v: Array) -> Array | None:
    """Return [q, v] at t after a drive's velocity has jumped; None if no velocities satisfy the constraints.

    (q, v): state before the jump of C_t, or of b in A v + b = 0. The jump causes impulses p of the constraints, which
    change v to v+. The equations M (v+ - v) + G^T p = 0 and G v+ + (C_t, b) = 0 are solved for v+ and p.
    """
    q = corrected_positions(system, t, q)
    rows, rates = system.rows(t, q), -system.velocity_constraint(t, q, v)
    change = velocity_changes(system.mass(t, q), rows, np.zeros((system.n_q, 1)), rates[:, None])[:, 0]
    if not (
        np.abs(rows @ change - rates) <= MAX_RESIDUAL * (np.abs(rows) @ np.abs(change) + np.abs(rates).max())
    ).all():
        return None
    return np.concatenate([q, v + change])


def corrected_positions(system: ConstrainedSystem, t: float, q: Array) -> Array:
    """Return q with its small violation of the constraints removed by N_CORRECTIONS steps of Newton's method."""
    for _ in range(N_CORRECTIONS if system.n_c > 0 else 0):
        q = q - np.linalg.lstsq(system.jacobian(t, q), system.constraint(t, q), rcond=NEGLIGIBLE_RATIO)[0]
    return q


def velocity_changes(mass: Array, rows: Array, impulses: Array, rates: Array) -> Array:
    """Return X (n_q, k) with M X + G^T P = `impulses` (n_q, k) and G X = `rates` (n_rows, k); P is not computed.

    If inertia is missing in some direction, X is not unique: return the X of least norm in `equilibrating_units`.
    """
    independent = independent_rows(rows)
    G = rows[independent]
    matrix = np.block([[mass, G.T], [G, np.zeros((len(G),) * 2)]])
    units = equilibrating_units(matrix, len(mass))
    return solve_scaled(matrix, np.vstack([impulses, rates[independent]]), units)[: len(mass)]


def independent_rows(rows: Array) -> NDArray[np.int64]:
    """Return the indices, in ascending order, of rows that span all `rows`."""
    norms = np.linalg.norm(rows, axis=1)
    redundant = redundant_rows(rows / np.where(norms > 0.0, norms, 1.0)[:, None], NEGLIGIBLE_RATIO)
    return np.delete(np.arange(len(rows)), redundant)


def solve_scaled(matrix: Array, right_side: Array, units: Array, is_singular: bool = False) -> Array:
    """Solve K X = `right_side` (n, k) for X (K: `matrix`), after scaling by `units` (n,) of `equilibrating_units`.

    The scaled K is factorized by LU, as least squares lose digits of light bodies beside heavy ones. If `is_singular`,
    or if K is singular to rounding errors, the least-squares solution of least norm in these units is returned.
    """
    from scipy.linalg.lapack import dgecon, dgetrf, dgetrs

    matrix, right_side = matrix * units * units[:, None], right_side * units[:, None]
    factors, pivots, info = dgetrf(matrix)
    if is_singular or info > 0 or dgecon(factors, np.abs(matrix).sum(axis=0).max())[0] < np.finfo(float).eps:
        solution = np.asarray(np.linalg.lstsq(matrix, right_side, rcond=NEGLIGIBLE_RATIO)[0])
    else:
        solution = np.zeros_like(right_side)
        for _ in range(1 + N_REFINEMENTS):
            solution += dgetrs(factors, pivots, right_side - matrix @ solution)[0]
    return units[:, None] * solution


def equilibrating_units(matrix: Array, n_q: int) -> Array:
    """Return units u that scale `matrix` K: the largest entry of each row of u_i K_ij u_j becomes about 1.

    The algorithm is that of D. Ruiz, RAL-TR-2001-034. In K = [M G^T; G 0], larger units of velocities and smaller units
    of multipliers would leave the scaled G as it is. So, in each set of connected bodies, the units are chosen so that
    the largest scaled entry of M is about 1. Units are powers of 2, so that scaling causes no rounding errors.
    """
    from scipy.sparse.csgraph import connected_components

    units: Array = np.ones(len(matrix))
    for _ in range(MAX_SCALINGS):
        scaled = np.abs(matrix * units * units[:, None])
        factors = _root_of_inverse(np.maximum(scaled.max(axis=0), scaled.max(axis=1)))
        if (factors == 1.0).all():
            break
        units *= factors
    n_sets, sets = connected_components(matrix != 0.0, directed=False)
    largest = np.zeros(n_sets)
    np.maximum.at(largest, sets[:n_q], np.abs(matrix[:n_q, :n_q] * units[:n_q] * units[:n_q, None]).max(axis=1))
    factors = _root_of_inverse(largest)[sets]
    return units * np.append(factors[:n_q], 1.0 / factors[n_q:])


def _root_of_inverse(values: Array) -> Array:
    """Return the power of 2 that is nearest to values**-0.5; 1 for values of 0."""
    return np.exp2(-np.round(0.5 * np.log2(np.where(values > 0.0, values, 1.0))))


# the step sizes tried in turn across a singular position are these ratios times the size tried first. Larger sizes help
# if a step ends before the position or too near to it; smaller sizes help if the error of a step is too large
SIZE_RATIOS = (1.0, *(1.2**k for k in range(1, 12)), *(0.85**k for k in range(1, 28)))
LARGEST_RATIO = max(SIZE_RATIOS)
# if a run comes near a singular position before the time FIRST_STEPS * (longest recent step) has passed, its steps may
# still be as short as at the start. Then much larger sizes are also tried: LARGE_RATIOS times the size tried first
FIRST_STEPS = 30.0
LARGE_RATIOS = (*(1.2**k for k in range(12, 30)), *(1.44**k for k in range(15, 50)))
# "distance" of a state from a singular position: (smallest pivot of C_q there) / (largest value of this pivot in the
# run). The polynomial across the position should begin at a state with at least the distance FAR_BEFORE
FAR_BEFORE = 0.2
# in the first part of a run, this fraction of its time, no state may be far from a singular position: the polynomial
# then begins at the farthest state
BESIDE_START = 0.01
# if no step across a singular position succeeds, the tolerances are multiplied by TOLERANCE_FACTOR, and the longest
# allowed time between evaluations by GAP_FACTOR (if no forces are short, this time becomes unlimited)
TOLERANCE_FACTOR, GAP_FACTOR = 10.0, 4.0
# the polynomial's error should be at most GOAL_OF_ERROR tolerances, as errors grow beyond a singular position. If no
# shorter step, down to LEAST_RATIO times the size, reaches this goal, the best step with at most one tolerance is taken
GOAL_OF_ERROR, LEAST_RATIO = 0.1, 0.6
NO_ATTEMPT = np.inf, 0.0  # initial value of `Run.best_attempt`
MAX_ATTEMPTS_IN_PYTHON = 200  # largest number of failed steps across a singular position if callbacks run in Python
NODE_DISTANCES = 1.0, 0.5, 0.25  # values that are tried in turn for the field `node_distance` of Limits


class Limits(NamedTuple):
    """Limits of steps across a singular position and their polynomial; if no step succeeds, wider limits are tried."""

    has_wide_gaps: bool  # whether the longest allowed time between evaluations is multiplied by GAP_FACTOR
    may_approach: bool  # whether a step may end before the singular position, but nearer to it than the step began
    tolerance_factor: float  # factor by which the run's tolerances are multiplied in steps across the singular position
    # factor on the pivot of C_q below which nodes of the polynomial are left out because of large rounding errors. A
    # smaller factor leaves out fewer nodes, which helps if the motion is slow near the singular position
    node_distance: float


class Origin(NamedTuple):
    """Beginning and limits of a polynomial across a singular position; several step sizes are tried for each Origin."""

    earliest: float  # no node of the polynomial is before this time (s)
    base: TimedState | None  # earlier state at which the polynomial begins; None: it begins at the current state
    limits: Limits
    may_end_beyond: bool = False  # whether the polynomial may end beyond the end of the run


# the search for a state at which the polynomial begins goes back in time. It stops near another singular position: at
# a state whose distance (see FAR_BEFORE) is less than this fraction of the largest distance found before
MIN_DISTANCE_RATIO = 0.5


# errors of steps before and after a singular position may grow much: once a run comes near one, its tolerances are
# multiplied by STRICT. None falls below LEAST_STRICT times the number of coordinates, where rounding limits the steps
STRICT, LEAST_STRICT = 0.02, 1e-14
ROUNDING_OF_RATIO = 1e-6  # ratios of tolerances that differ by less are equal


def tighten_tolerances(run: Run) -> bool:
    """Tighten the tolerances of a run that is near its first singular position; return whether they have changed.

    Runs with steps of fixed size keep theirs, and so do methods that do not look for singular positions.
    """
    factor = min(max(LEAST_STRICT * run.system.n_q / run.tolerances[indices.LEAST], STRICT), 1.0)
    is_strict = factor == 1.0 or _looseness(run) > 1.0
    if is_strict or not run.plan.checks_within or run.control[run.a.FIXED_STEP] > 0.0:
        return False
    run.work.notes[indices.NEARLY_SINGULAR] = 1.0
    _scale_tolerances(run.tolerances, factor)
    return True


def _looseness(run: Run) -> float:
    """Return (user's tolerances) / (tolerances of the run): 1, or more after `tighten_tolerances`."""
    ratio = float(least_tolerance(run.rtol, run.least_atol) / run.tolerances[indices.LEAST])
    return ratio if ratio > 1.0 + ROUNDING_OF_RATIO else 1.0


def _scale_tolerances(tolerances: Array, factor: float) -> None:
    """Multiply the relative, absolute and least tolerance in the array `tolerances` by `factor`."""
    tolerances[[indices.RTOL, indices.LEAST]] *= factor
    tolerances[indices.ATOL :] *= factor


def requires_crossing(run: Run, code: int) -> bool:
    """Return whether steps across a singular position must follow after `advance` has returned `code`."""
    a, notes = run.a, run.work.notes
    if code == a.SWITCH_METHOD:
        from twoloop.kernels.steps.lobatto_step import TIGHT_TOLERANCE

        is_near = notes[indices.NEARLY_SINGULAR] == notes[indices.NEAR_NOW] == 1.0
        return bool(is_near and run.control[a.MAY_CROSS] == 1.0 and run.tolerances[indices.LEAST] >= TIGHT_TOLERANCE)
    return code == a.NEAR_SINGULAR


def switch_method(run: Run) -> None:
    """Continue a run with the substitute for its method, because this method fails or does not suit the motion."""
    substitute = run.plan.substitute
    assert substitute is not None
    run.plan, run.memory = substitute.fresh(), substitute.memory  # `run.memory`: the new method's initial memory
    renew_kit(run)
    run.substituted = True
    run.write_step_control(run.plan)
    run.limit_steps()
    run.clock[run.a.FAILURE_CODE] = indices.DONE
    run.clock[run.a.H_NEXT] = run.clock[run.a.H_FAILED]
    run.clock[: run.a.N_PAST] = 0.0


def renew_kit(run: Run) -> None:
    """Replace the kit of a run by one that calls the steps of the run's current plan."""
    if run.fixed_order is None:
        run.kit = kit_for_plan(run.system, run.kit.flags, run.plan)
    else:
        run.kit = make_kit(run.system, run.t0, run.state[: run.system.n_q], run.plan, run.fixed_order)


def cross_singularity(run: Run, past: list[TimedState]) -> tuple[Plan, Array]:
    """Prepare steps across a singular position, see kernels/steps/crossing_step.py; return their plan and settings.

    Set the first step size, and store in `run.origins` which polynomials to try. The settings are the array `control`
    that `advance` reads. `past`: states of the last accepted steps, oldest first; may be empty.
    """
    a, clock = run.a, run.clock
    from twoloop.kernels.steps.crossing_step import BACKWARD_FRACTION, NODE_GAP

    plan = crossing_plan(run.system.n_q)
    earliest, has_fixed_step = max(clock[a.T_START], clock[a.LAST_CHANGE], *run.jumps), run.control[a.FIXED_STEP] > 0.0
    base, run.mirrored_size = None, 0.0
    if not has_fixed_step:
        base, run.mirrored_size = _find_base_state(run, [(t, state) for t, state in past if t >= earliest])
    # try several beginnings of the polynomial, because one may fail: the polynomial may have nodes before a jump of a
    # force; it may have too few nodes near the start or end of the run; or it may be too long, if it begins early
    h_long, compiled = float(clock[a.H_LONG]), not run.system.called_in_python
    near_start = compiled and _is_near_start(run)
    near_end = compiled and clock[a.T] + LARGEST_RATIO * h_long > run.t1
    origins = [(earliest, base), *[(earliest, None)] * (base is not None), *[(-np.inf, None)] * bool(near_start)]
    origins.append((np.inf, None))
    ends = [False, True] if near_end and not has_fixed_step else [False]
    if run.mirrored_size > run.t1 - clock[a.T]:  # a singular position is near t1: first try steps that end beyond t1
        ends.reverse()
    run.origins = [Origin(*start, limits, beyond) for limits in _limits(run) for beyond in ends for start in origins]
    run.attempts_left = np.inf if compiled else MAX_ATTEMPTS_IN_PYTHON
    run.crossings.append([base or (float(clock[a.T]), run.state.copy())])
    control = run.control.copy()
    control[: a.N_RULE] = plan.rule
    control[a.SYMMETRIC], control[a.MAY_CROSS], control[a.MAX_ATTEMPTS] = 0.0, 0.0, 1.0
    control[a.MAY_SWITCH] = control[a.TAKES_MANY] = 0.0
    run.piece_ends = []  # remove the times of an earlier run, for which the same object `run` was used
    if control[a.FIXED_STEP] == 0.0:
        control[a.MAX_EVALUATION_GAP] = 1.0 if run.forces_may_be_steep else NODE_GAP / (1.0 - BACKWARD_FRACTION)
    clock[a.LIMIT_AGE] = 0.0
    _prepare_next_origin(run, plan, control)
    return plan, control


def _limits(run: Run) -> list[Limits]:
    """Return all `Limits` of steps across a singular position, in the order in which they are tried."""
    if run.control[run.a.FIXED_STEP] > 0.0:
        return [Limits(False, True, 1.0, 1.0)]
    loose = TOLERANCE_FACTOR
    choices = [(False, False, 1.0), (True, False, 1.0), (True, False, loose), (True, True, 1.0), (True, True, loose)]
    if not (any(run.short_forces) or run.forces_may_be_steep):
        choices.pop(0)
    return [Limits(*choice, distance) for choice in choices for distance in NODE_DISTANCES]


def is_beside_start(run: Run) -> bool:
    """Return True if less than the fraction BESIDE_START of the run's time has passed."""
    return bool(run.clock[run.a.T] - run.t0 < BESIDE_START * (run.t1 - run.t0))


def _is_near_start(run: Run) -> bool:
    """Return True if the time since the start is less than FIRST_STEPS times the longest recent step."""
    a, clock = run.a, run.clock
    return bool(clock[a.T] - clock[a.T_START] < FIRST_STEPS * clock[a.H_LONG])


def _prepare_next_origin(run: Run, plan: Plan, control: Array) -> None:
    """Take the next Origin of a polynomial from `run.origins`; store it for `crossing_step`, and set its step sizes."""
    from twoloop.kernels.steps.crossing_step import begin_polynomial

    a, clock = run.a, run.clock
    earliest, base, limits, beyond = run.origins.pop(0)
    conditions = earliest, limits.may_approach, limits.node_distance, base, GOAL_OF_ERROR
    begin_polynomial(plan.memory, clock[a.LARGEST_PIVOT], *conditions)
    run.best_attempt = NO_ATTEMPT
    run.crossing_tolerances = run.tolerances.copy()
    if limits.has_wide_gaps:
        run.crossing_tolerances[indices.GAP] *= GAP_FACTOR if any(run.short_forces) else np.inf
    # the user's tolerances count here: a singular position is crossed as well as before `tighten_tolerances`
    _scale_tolerances(run.crossing_tolerances, limits.tolerance_factor * _looseness(run))
    if control[a.FIXED_STEP] == 0.0:
        control[a.MAX_STEP] = min(run.max_step, run.crossing_tolerances[indices.GAP] / control[a.MAX_EVALUATION_GAP])
    h_long, max_size, time_left = float(clock[a.H_LONG]), float(control[a.MAX_STEP]), run.t1 - float(clock[a.T])
    min_size = time_left if beyond else 0.0
    if control[a.FIXED_STEP] == 0.0:
        max_size = min(max_size, LARGEST_RATIO * time_left if beyond else time_left)
    first_size = max(h_long, run.mirrored_size)
    sizes = sizes_across(first_size, max_size, limits.node_distance == 1.0 and _is_near_start(run))
    run.sizes_to_try = [size for size in sizes if size > min_size and control[a.FIXED_STEP] == 0.0] or sizes[:1]
    clock[a.H_NEXT], clock[a.H_LIMIT] = run.sizes_to_try.pop(0), np.inf
    run.crossing_size = float(clock[a.H_NEXT])


def distance_from_singular(run: Run, t: float, q: Array) -> float:
    """Choose the partition at q; return (smallest pivot of C_q there) / (its largest value in the run)."""
    arguments = (0.0, run.work.x, run.work.lam)
    code = entry_point(run.kit.inner)(run.kit, run.work, tasks.RENEW_PARTITION, t, q, q, *arguments)
    if code != indices.DONE:
        return 0.0
    clock, pivot = run.clock, float(run.work.notes[indices.PIVOT])
    clock[run.a.LARGEST_PIVOT] = max(clock[run.a.LARGEST_PIVOT], pivot)
    return pivot / float(clock[run.a.LARGEST_PIVOT])


def _find_base_state(run: Run, past: list[TimedState]) -> tuple[TimedState | None, float]:
    """Return where a polynomial across a singular position begins (None: at the current state), and a step size (s).

    Near the position, rounding changes velocities. So the polynomial begins at the latest state that is far from the
    position, or at the farthest state if none is far. `past`: earlier states. The step size is such that the step would
    end as far beyond the position as the polynomial begins before the position, if distances changed linearly.
    """
    a, clock, t, n = run.a, run.clock, float(run.clock[run.a.T]), run.system.n_q

    farthest = distance_now = distance_from_singular(run, t, run.state[:n])
    far = 1.0 if is_beside_start(run) else FAR_BEFORE
    base: TimedState | None = None
    size = 0.0
    for time, state in reversed(past):
        distance = distance_from_singular(run, time, state[:n])
        if (farthest >= far and size > 0.0) or distance < MIN_DISTANCE_RATIO * farthest:
            break
        if distance > farthest:
            size = 2.0 * distance_now * (t - time) / (distance - distance_now)
            if farthest < far:
                farthest, base, size = distance, (time, state.copy()), size + t - time
    longest = LARGEST_RATIO * max(float(clock[a.H_LONG]), 0.0 if base is None else t - base[0])
    return base, min(size, longest)


def sizes_across(first_size: float, allowed: float, near_start: bool = False) -> list[float]:
    """Return the step sizes (s), at most `allowed`, that are tried in turn across a singular position.

    These are `first_size` times SIZE_RATIOS; if `near_start`, also `first_size` times LARGE_RATIOS.
    """
    sizes = [first_size * ratio for ratio in (SIZE_RATIOS + LARGE_RATIOS if near_start else SIZE_RATIOS)]
    return [min(first_size, allowed), *(size for size in sizes[1:] if size < allowed)]


def crossing_kit(kit: Kit) -> Kit:
    """Return the kit of steps across a singular position; it is cached as an attribute of the run's own kit."""
    from twoloop.kernels.steps.crossing_step import CROSSING

    attributes = vars(kit)
    if "crossing" not in attributes:
        attributes["crossing"] = Kit(kit.functions, kit.general, CROSSING)
    return attributes["crossing"]  # type: ignore[no-any-return]


def handle_crossing(run: Run, plan: Plan, control: Array, code: int, n_accepted: int) -> tuple[Plan, Array, int]:
    """Decide how to go on after an attempt to cross a singular position; return a plan, its settings, and a code.

    Follow a computed polynomial piece by piece; if the attempt failed, try another step size or polynomial. After the
    crossing, or if all attempts failed, return to the run's own method. The returned code is PAUSED if the run goes on.
    """
    from twoloop.kernels.steps import crossing_step as kernels

    a, clock = run.a, run.clock
    stored = plan.memory[-kernels.N_STORED :]
    end = float(stored[kernels.END])  # time at which the polynomial ends; -inf: no polynomial
    clock[a.LARGEST_PIVOT] = max(clock[a.LARGEST_PIVOT], stored[kernels.LARGEST_PIVOT])
    # current time plus a margin for the rounding error of the end of a piece
    t_now = float(clock[a.T] + kernels.ROUNDING * run.crossing_size + 4.0 * np.spacing(abs(clock[a.T])))
    if code in (a.PAUSED, a.RANK_LOST) and end > t_now:
        if not run.piece_ends:
            run.piece_ends = kernels.piece_ends(plan.memory, plan.options[-kernels.S :], float(clock[a.T]))
            if end > run.t1 - (t_now - clock[a.T]):
                run.piece_ends = [*[piece for piece in run.piece_ends if piece < run.t1 - t_now + clock[a.T]], run.t1]
        elif n_accepted == 0:
            run.piece_ends.pop(0)
        run.piece_ends = [piece for piece in run.piece_ends if piece > t_now]
        if run.piece_ends:
            clock[a.H_NEXT], clock[a.H_LIMIT] = run.piece_ends[0] - clock[a.T], np.inf
            return plan, control, a.PAUSED
    run.piece_ends, stored[kernels.END] = [], -np.inf
    at_singular_start = run.starts_singular and clock[a.T] == run.t0  # then coordinates have no partition yet
    if at_singular_start and code == a.RANK_LOST:
        code = a.PAUSED
    if n_accepted > 0:  # for step-size control, all pieces of the polynomial count as one step
        clock[a.H_LONG] = max(clock[a.H_LONG], run.crossing_size)
        clock[a.H_NEXT] = max(clock[a.H_NEXT], run.crossing_size)
    if code == a.PAUSED and n_accepted == 0:
        run.attempts_left -= 1
        if run.attempts_left <= 0:
            run.sizes_to_try, run.origins = [], []
        if clock[a.FAILURE_CODE] not in (indices.SINGULAR, indices.OUTER_DIVERGED):
            # the error is too large: try no larger sizes. But at the start of a run, rounding may have caused this
            # error, since all nodes are near the position: then still try the much larger sizes of LARGE_RATIOS
            much_larger = LARGEST_RATIO * max(float(clock[a.H_LONG]), run.mirrored_size)
            sizes = run.sizes_to_try
            run.sizes_to_try = [size for size in sizes if size < run.crossing_size or size > much_larger]
        error = float(stored[kernels.ERROR])
        is_worse = run.best_attempt[0] <= error < np.inf
        if GOAL_OF_ERROR < error <= 1.0 and not is_worse and stored[kernels.MAX_ERROR] < 1.0:
            run.best_attempt = error, run.crossing_size
        best = run.best_attempt[1]
        if best > 0.0 and (is_worse or run.crossing_size < LEAST_RATIO * best or not run.sizes_to_try):
            run.sizes_to_try.insert(0, best)
            stored[kernels.MAX_ERROR], run.best_attempt = 1.0, NO_ATTEMPT
        if run.sizes_to_try:
            clock[a.H_NEXT], clock[a.H_LIMIT] = run.sizes_to_try.pop(0), np.inf
            run.crossing_size = float(clock[a.H_NEXT])
            return plan, control, code
        if run.origins:
            _prepare_next_origin(run, plan, control)
            return plan, control, code
    if code == a.PAUSED and n_accepted > 0 and run.work.notes[indices.PIVOT] < kernels.FAR_END * clock[a.LARGEST_PIVOT]:
        proposed_size = min(float(clock[a.H_NEXT]), run.t1 - float(clock[a.T]))
        run.origins = [Origin(float(clock[a.T]), None, limits) for limits in _limits(run)]
        _prepare_next_origin(run, plan, control)
        clock[a.H_NEXT] = run.crossing_size = proposed_size
        return plan, control, code
    if code not in (a.PAUSED, a.STEP_TOO_SMALL, a.FIXED_STEP_FAILED, a.RANK_LOST):
        return plan, control, code
    if at_singular_start:
        return run.plan, run.control, a.RANK_LOST
    if n_accepted == 0:  # all attempts failed: the run's own steps continue as far as they can
        run.control[a.MAY_CROSS] = a.SUSPENDED
    run.crossings[-1].append((float(run.clock[a.T]), run.state.copy()))
    run.work.notes[indices.NEAR_NOW] = 0.0
    run.plan.memory[:] = run.memory
    run.clock[: a.N_PAST] = 0.0
    return run.plan, run.control, a.PAUSED


def apply_jump(run: Run, t1: float) -> bool:
    """Change velocities because a drive's velocity (C_t or b) jumps, and restart the method; return False on failure.

    The state after the jump is stored in `run.new_state`, for the next call of `advance`.
    """
    a, clock, n = run.a, run.clock, run.system.n_q
    t_after = float(clock[a.JUMP_TO])
    state = state_after_jump(run.system, t_after, run.state[:n], run.state[n : 2 * n])
    if state is None:
        return False
    run.new_state[: 2 * n] = state
    run.work.notes[indices.NEXT_JUMP] = t1
    if entry_point(run.kernels.start)(run.kit, run.work, t_after, run.new_state) != indices.DONE:
        return False
    run.jumps.append(t_after)
    run.plan.memory[:] = run.memory
    clock[a.APPLIES_JUMP] = 1.0
    clock[a.H_LIMIT], clock[a.LIMIT_AGE] = run.plan.limit_start, 0.0
    if t_after < t1:
        clock[a.H_NEXT] = min(clock[a.H_NEXT], run.choose_first_step(t_after, t1, run.new_state))
    return True
