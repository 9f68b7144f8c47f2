"""Close the loops of a model from rough poses, or name the loop that does not close and its gap.

The unknowns are the coordinates of the joints of a spanning tree, so that these joints are closed. A least-squares
method closes the other joints, within the limits of the unknowns. Of several assemblies, the nearest to the given poses
is taken, measured by angles and displacements of the joints. Poses that may mean another assembly are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np

from twoloop.bodies.coordinates import JointCoordinate
from twoloop.bodies.parameter_layout import ANGLE, PERPENDICULAR
from twoloop.bodies.parts import ModelJoint
from twoloop.bodies.spanning_tree import SpanningTree, TreeState
from twoloop.checks.arguments import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.projection import consistent_state

ROUNDING = 8.0 * np.finfo(np.float64).eps  # rounding error of a constraint, relative to the sum of its |terms|
OPEN_TOLERANCE = 1e-7  # a joint does not close if its residual, relative to the size of the model, is larger
CLOSED = 1e-15  # the iteration stops at this residual, relative to the size of the model
ITERATIONS = 100  # largest number of steps of Levenberg and Marquardt's method; most closures take four to ten
SINGULAR = 1e-9  # singular values below this fraction of the largest count as zero
WEAK = 1e-4  # like SINGULAR, for rows that are dependent in closed states, but only nearly so beside them
STATIONARY = 1e-8  # gradients of the residual below this fraction of their bound count as zero
SUFFICIENT, SLOW = 1e-4, 1e-4  # smallest decrease of the squared residual, as a part of the expected one; slow decrease
MOST_DAMPING = 1e12  # the iteration ends if no step with less damping decreases the residual
LONGEST = 0.5  # longest step, rad or in sizes of the model: shorter than the distance of two branches
CERTAIN = 1e-3  # poses surely mean the closed state if the norm of the change of joint coordinates is below this
EQUALLY = 0.2  # another assembly is about as near if its distance is larger by at most this fraction
WAY_STEPS, WAY_STEP, ARRIVED = 40, 0.2, 1e-3  # way between two states: steps, step size (rad, sizes of the model), end
RESTARTS_OF_ONE, MOST_RESTARTS, LEAST_RESTARTS = 60, 12, 2  # RESTARTS_OF_ONE / (number of unknowns), within two limits
RESTART_SPREAD = 0.15  # standard deviation of restarts 1, 2, ... over 1, 2, ..., rad or in sizes of the model
TIE = 1e-3  # gaps count as equal if they differ by at most this fraction


class LoopClosure:
    """Close the loops of a model by the coordinates of the joints of a spanning tree, with small changes of these.

    Parameters
    ----------
    system : ConstrainedSystem
        Without drives.
    t : float
    guess : ndarray (n_q,)
        Rough poses.
    tree : SpanningTree
    rows : mapping of str to tuple of int
        Numbers of the rows of each joint.
    bounds : mapping of JointCoordinate to (float, float)
        Bounds of coordinates of joints. For joints outside the tree, which close loops, they become further residuals.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        t: float,
        guess: Array,
        tree: SpanningTree,
        rows: Mapping[str, tuple[int, ...]],
        bounds: Mapping[JointCoordinate, tuple[float, float]],
    ):
        self.system, self.t, self.guess, self.tree, self.rows = system, t, guess, tree, rows
        self.open = [k for joint in tree.closing for k in rows[joint.name] if k < system.n_c]
        arms = [np.abs(p).max() for edge in tree.edges for p in (edge.point_a * (edge.a >= 0), edge.point_b)]
        places = guess.reshape(-1, tree.width)[:, : tree.dimension]
        self.length = float(max(*arms, np.ptp(places, axis=0).max(), 0.0)) or float(np.abs(places).max()) or 1.0
        self.units = np.where(tree.turning, 1.0, self.length)
        number = {key: k for k, key in enumerate(tree.keys)}
        self.lower, self.upper = np.full(len(tree.keys), -np.inf), np.full(len(tree.keys), np.inf)
        self.beside = {}  # bounds of coordinates that are not in the tree
        for each, (low, high) in bounds.items():
            k = number.get((each.joint, each.which))
            if k is None:
                self.beside[each] = low, high
            else:
                self.lower[k], self.upper[k] = low, high
        one_body = [*[self.length] * tree.dimension, *[1.0] * (tree.width - tree.dimension)]
        self.of_bodies = np.tile(one_body, tree.n_bodies)
        self.sizes = np.abs(system.jacobian(t, guess)[self.open] * self.of_bodies).max(axis=1, initial=0.0)
        self.sizes = np.where(self.sizes > 0.0, self.sizes, 1.0)

    def start(self, given: Mapping[JointCoordinate, float]) -> TreeState:
        """Return the state of the joints nearest to the guess within the bounds, with the `given` coordinates."""
        state, number = self.tree.state(self.guess), {key: k for k, key in enumerate(self.tree.keys)}
        step = np.zeros(len(state.x))
        for each, value in given.items():
            if (each.joint, each.which) in number:
                k = number[each.joint, each.which]
                step[k] = value - state.x[k]
        return self.bounded(self.tree.moved(state, step))

    def bounded(self, state: TreeState) -> TreeState:
        """Return a state moved into the bounds."""
        return self.tree.moved(state, np.clip(state.x, self.lower, self.upper) - state.x)

    def loops(self, state: TreeState) -> tuple[Array, Array]:
        """Return the residuals of the loops and their derivatives, relative to the size of the model."""
        q = self.tree.place(state, self.guess)
        values = self.system.constraint(self.t, q)[self.open] / self.sizes
        tangent = self.tree.tangent(q) * self.units
        slopes = self.system.jacobian(self.t, q)[self.open] @ tangent / self.sizes[:, None]
        for each, (low, high) in self.beside.items():
            x, size = float(each.position(q)), self.length if each.unit == "m" else 1.0
            outside = x - min(max(x, low), high)
            values = np.append(values, outside / size)
            slopes = np.vstack([slopes, (outside != 0.0) * each.rate(q, tangent) / size])
        return values, slopes

    def off_guess(self, state: TreeState) -> tuple[Array, Array]:
        """Return the deviations of the bodies from the guess, and their derivatives by the coordinates of the tree."""
        q = self.tree.place(state, self.guess)
        return (q - self.guess) / self.of_bodies, self.tree.tangent(q) * self.units / self.of_bodies[:, None]

    def closed(self, state: TreeState) -> tuple[TreeState, float]:
        """Return the state with the loops closed as far as possible, and the largest residual."""
        return self.least(self.loops, state)

    def least(self, evaluate: Callable[[TreeState], tuple[Array, Array]], state: TreeState) -> tuple[TreeState, float]:
        """Return the state after Levenberg and Marquardt's method within the bounds, and the largest residual.

        Each step is the shortest of all equivalent steps, so that dependent rows and degrees of freedom do no harm. The
        damping is proportional to the squared residual (Kanzow, Yamashita, Fukushima, J. Comput. Appl. Math., 2004).
        """
        values, slopes = evaluate(state)
        square, factor = float(values @ values), 1.0
        for _ in range(ITERATIONS):
            if not values.size or np.abs(values).max() < CLOSED:
                break
            down = slopes.T @ values
            x = state.x
            free = ~((x <= self.lower) & (down > 0.0) | (x >= self.upper) & (down < 0.0))
            left, sizes, right = np.linalg.svd(slopes[:, free], full_matrices=False)
            largest = float(sizes.max(initial=0.0))
            if np.abs(down[free]).max(initial=0.0) <= STATIONARY * largest * np.sqrt(square):
                break
            along = left.T @ values
            while factor < MOST_DAMPING:
                step = np.zeros(len(x))
                gains = np.where(sizes > SINGULAR * largest, sizes / (sizes**2 + factor * square), 0.0)
                step[free] = -(right.T @ (gains * along))
                step *= min(1.0, LONGEST / max(float(np.abs(step).max()), LONGEST))
                to = np.clip(x + step * self.units, self.lower, self.upper)
                new = self.tree.moved(state, to - x)
                values_new, slopes_new = evaluate(new)
                square_new = float(values_new @ values_new)
                expected = -float(down @ ((to - x) / self.units))
                if square_new <= square - SUFFICIENT * max(expected, 0.0) and square_new < square:
                    break
                factor *= 4.0
            else:
                break
            slow = square_new > (1.0 - SLOW) * square
            state, values, slopes, square = new, values_new, slopes_new, square_new
            factor = max(0.25 * factor, 1e-3)
            if slow:
                break
        return state, float(np.abs(values).max(initial=0.0))

    def is_closed(self, state: TreeState, misfit: float) -> bool:
        """Return True if all loops are closed, and no axis is turned over."""
        if misfit > OPEN_TOLERANCE:
            return False
        q = self.tree.place(state, self.guess)
        return not any(self.tree.is_mirrored(joint, q) for joint in self.tree.closing)

    def distance(self, one: TreeState, other: TreeState) -> float:
        """Return the norm of the difference of the coordinates of the tree."""
        return float(np.linalg.norm((one.x - other.x) / self.units))

    def gap(self, joint: ModelJoint, q: Array) -> dict[str, float]:
        """Return how far a joint is open, m and rad."""
        C, lines = self.system.constraint(self.t, q), self.system.jacobian(self.t, q) * self.of_bodies
        gap, rows = {"m": 0.0, "rad": 0.0}, iter(self.rows[joint.name])
        for row in joint.rows:
            for k in (next(rows) for _ in range(row.n_rows)):
                slope = float(np.abs(lines[k]).max(initial=SINGULAR)) if k < len(C) else np.inf
                if row.kind in (PERPENDICULAR, ANGLE):
                    gap["rad"] = float(np.hypot(gap["rad"], C[k]))
                elif k < len(C):  # the displacement that closes the row
                    gap["m"] = float(np.hypot(gap["m"], C[k] * self.length / slope))
        return gap

    def are_one_assembly(self, one: TreeState, other: TreeState) -> bool:
        """Return True if the loops stay closed on a way from one state to another."""
        q, target = (self.tree.place(state, self.guess) for state in (one, other))
        left = np.inf
        for _ in range(WAY_STEPS):
            way = (target - q) / self.of_bodies
            far = float(np.abs(way).max())
            if far < ARRIVED:
                return True
            if far > 0.9 * left:
                return False
            left = far
            q = q + way * self.of_bodies * min(1.0, WAY_STEP / far)
            state, misfit = self.closed(self.tree.state(q))
            if misfit > OPEN_TOLERANCE:
                return False
            q = self.tree.place(state, self.guess)
        return False

    def other_starts(self, start: TreeState) -> Iterator[TreeState]:
        """Yield the middle of the bounds, then random states about the start."""
        both = np.isfinite(self.lower) & np.isfinite(self.upper) & (self.lower < self.upper)
        if both.any():
            middle = np.where(both, 0.5 * (np.where(both, self.lower, 0.0) + np.where(both, self.upper, 0.0)), start.x)
            yield self.bounded(self.tree.moved(start, middle - start.x))
        random = np.random.default_rng(5)
        for k in range(min(max(RESTARTS_OF_ONE // max(len(start.x), 1), LEAST_RESTARTS), MOST_RESTARTS)):
            off = random.normal(size=len(start.x)) * self.units * RESTART_SPREAD * (1.0 + k)
            yield self.bounded(self.tree.moved(start, off))


def positions(
    system: ConstrainedSystem,
    t: float,
    guess: Array,
    tree: SpanningTree,
    rows: Mapping[str, tuple[int, ...]],
    bounds: Mapping[JointCoordinate, tuple[float, float]],
    given: Mapping[JointCoordinate, float],
) -> Array:
    """Return positions that close all joints, nearest to rough poses in the coordinates of joints.

    The system has no drives. If the loops do not close from the poses, the iteration starts again from the values
    `given` for some coordinates of joints. Raises ValueError if a loop does not close (the message names its joints and
    the gap), or if it is not clear which of two assemblies the poses mean.
    """
    if system.n_c == 0 or _is_closed_to_rounding(system, t, guess, tree):
        return guess
    closure = LoopClosure(system, t, guess, tree, rows, bounds)
    start = closure.start({})
    try:
        state, misfit = _nearest_assembly(closure, start)
    except ValueError:
        if not given:
            raise
        state, misfit = start, np.inf
    if given and not closure.is_closed(state, misfit):
        state, misfit = _nearest_assembly(closure, closure.start(given))
    q = tree.place(state, guess)
    if not closure.is_closed(state, misfit):
        raise ValueError(_open_loop_message(closure, state))
    if _is_closed_to_rounding(system, t, q, tree):
        return q
    held = [body for body, edge in tree.parents.items() if edge is None and body >= 0]
    kept = [j for body in held for j in range(tree.width * body, tree.width * (body + 1))]
    try:  # all rows, in the coordinates of all bodies
        q = consistent_state(system, t, q, np.zeros(len(q)), keep=kept or None, check_assembly=False)[0]
    except ValueError:
        raise ValueError(_open_loop_message(closure, state)) from None
    return q


def _is_closed_to_rounding(system: ConstrainedSystem, t: float, q: Array, tree: SpanningTree) -> bool:
    turning = np.tile(np.arange(tree.width) >= tree.dimension, tree.n_bodies)
    terms = abs(system.sparse_rows(t, q)[: system.n_c]) @ np.where(turning, np.maximum(np.abs(q), 1.0), np.abs(q))
    return bool((np.abs(system.constraint(t, q)) <= ROUNDING * terms).all())


def _nearest_assembly(closure: LoopClosure, start: TreeState) -> tuple[TreeState, float]:
    """Return the closed state nearest to the start, and its misfit; without a closed state, the least misfit's state.

    Two more starts check which assembly is meant: the mirror image of the closed state about the start, and the best
    fit to the bodies' positions and angles. Raises ValueError if they lead to another assembly that is about as near.
    """
    best, misfit = closure.closed(start)
    found: list[tuple[TreeState, bool]] = []  # closed states, and whether each counts at any distance
    starts: Iterable[tuple[TreeState, bool]]
    if closure.is_closed(best, misfit):
        if closure.distance(best, start) <= CERTAIN:
            return best, misfit
        found = [(best, False)]
        mirrored = closure.bounded(closure.tree.moved(start, start.x - best.x))
        starts = (mirrored, False), (closure.least(closure.off_guess, start)[0], True)
    else:
        starts = ((state, False) for state in closure.other_starts(start))
    for other, counts in starts:
        state, left = closure.closed(other)
        if closure.is_closed(state, left):
            found.append((state, counts))
        elif not found and left < misfit:
            best, misfit = state, left
    if not found:
        return best, misfit
    found.sort(key=lambda each: closure.distance(each[0], start))
    nearest = found[0][0]
    far = (1.0 + EQUALLY) * closure.distance(nearest, start)
    for state, counts in found[1:]:
        if (counts or closure.distance(state, start) <= far) and not closure.are_one_assembly(nearest, state):
            raise ValueError(_two_assemblies_message(closure, nearest, state))
    return nearest, 0.0


def _two_assemblies_message(closure: LoopClosure, one: TreeState, other: TreeState) -> str:
    """Return the message that shows by the coordinate of a joint how two assemblies differ."""
    apart = np.abs(one.x - other.x) / closure.units * [bool(which) for _, which in closure.tree.keys]
    k = int(apart.argmax()) if apart.any() else -1
    differ, give = "", "poses"
    if k >= 0:
        (joint, which), unit = closure.tree.keys[k], "rad" if closure.tree.turning[k] else "m"
        values = " or ".join(f"{float(f'{state.x[k]:.3g}'):g}" for state in (one, other))
        differ = f", in which the {which} of {joint!r} is {values} {unit}"
        give = "positions of joints (positions=) or poses"
    return (
        f"the bodies of {closure.system.name!r} cannot be assembled from the poses given, which may mean two "
        f"assemblies{differ}: give {give} that are nearer to one of them"
    )


def _open_loop_message(closure: LoopClosure, state: TreeState) -> str:
    """Return the message that names the loop with the widest gap, the gap, and what to do."""
    tree, q = closure.tree, closure.tree.place(state, closure.guess)
    head = f"the bodies of {closure.system.name!r} cannot be assembled: "
    gaps = {joint.name: closure.gap(joint, q) for joint in tree.closing}
    sizes = {name: max(gap["m"] / closure.length, gap["rad"]) for name, gap in gaps.items()}
    if max(sizes.values(), default=0.0) <= OPEN_TOLERANCE:
        for joint in tree.closing:
            if tree.is_mirrored(joint, q):
                return (
                    f"{head}the joint {joint.name!r} does not close, but with its axis turned over. Give poses nearer "
                    "to the assembly"
                )
        for each, (low, high) in closure.beside.items():
            if not low - OPEN_TOLERANCE <= each.position(q) <= high + OPEN_TOLERANCE:
                return f"{head}the loops close, but not with the {each.name} from {low:.6g} to {high:.6g} {each.unit}"
    # name the first of equal gaps, so that the message does not depend on rounding
    worst = next(joint for joint in tree.closing if sizes[joint.name] >= (1.0 - TIE) * max(sizes.values()))
    gap = " and ".join(
        f"{size:.3g} {unit}" for unit, size in gaps[worst.name].items() if size > TIE * sizes[worst.name]
    )
    others = [repr(name) for name in sizes if name != worst.name and sizes[name] > 0.1 * sizes[worst.name]]
    also = f" (nor {'does' if len(others) == 1 else 'do'} {', '.join(others)})" if others else ""
    loop = f" in its loop of {', '.join(map(repr, tree.loop(worst)))}" if tree.loop(worst) else ""
    stuck = (state.x == closure.lower) | (state.x == closure.upper)
    held = [f"the {which} of {joint!r}" for (joint, which), at in zip(tree.keys, stuck, strict=True) if at]
    bounds = f", with {', '.join(held)} at a limit," if held else ""
    values, slopes = closure.loops(state)
    singular = np.linalg.svd(slopes, compute_uv=False)
    text = (
        f"{head}the joint {worst.name!r} does not close{also}: a gap of {gap} is left{loop}{bounds} by least squares. "
        "Check the lengths and points of these joints, or give poses nearer to the assembly"
    )
    if tree.dimension == 3 and (singular > WEAK * singular.max(initial=0.0)).sum() < len(values):
        text += (
            ". The loops have dependent rows, as a planar mechanism in space has: such a mechanism closes only with "
            "exact axes and points; a cylindrical or spherical joint in place of a revolute one takes up small errors"
        )
    return text
