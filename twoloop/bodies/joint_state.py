"""Assemble a model at given joint coordinates and rates.

Given values become further rows. Of all states that satisfy these rows and the joints, the state is taken in which the
other joints move least: they do not move at all in an open chain, and in a loop as little as closing the loop takes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from twoloop.bodies.coordinates import TURN, JointCoordinate, velocity_apart
from twoloop.bodies.frames import angle_of, point_of
from twoloop.bodies.parts import ModelJoint
from twoloop.bodies.rotation import cross, spin_of
from twoloop.bodies.spanning_tree import SpanningTree
from twoloop.checks.arguments import Array
from twoloop.problem.system import ConstrainedSystem

STEP = 0.25  # first continuation step towards the given positions, rad or in sizes of the model
LEAST_STEP = 1e-3  # shortest continuation step, as a fraction of the whole way, or of the first step
ITERATIONS, LAST_ITERATIONS = 8, 60  # largest numbers of Newton iterations: in a continuation step, in the last one
LONGEST = 0.5  # longest Newton step, rad or in sizes of the model: shorter than the distance of two branches
CONVERGED = 1e-13  # shorter Newton steps, rad or in sizes of the model, are rounding errors
SINGULAR = 1e-9  # singular values below this fraction of the largest count as zero
OFF = 1e-6  # largest relative difference from a given value, which may be rounded to six digits
MOVES = 1e-6  # displacements below this value, rad or in sizes of the model, count as zero
STIFF = 1e3  # in a Newton step, weight of the other joints' displacements from the start, relative to their changes


@dataclass(frozen=True)
class Request:
    """Hold the values given for some coordinates of joints, and the coordinates that are not given."""

    name: str  # name of the model
    given: tuple[JointCoordinate, ...]
    values: Array
    others: tuple[JointCoordinate, ...]
    joints: tuple[ModelJoint, ...]  # all joints that are not drives
    turning: NDArray[np.bool_]  # which coordinates of bodies are rotations

    def scales(self, q: Array) -> tuple[Array, float]:
        """Return the units of the bodies' coordinates: 1 for rotations, a length otherwise; also return the length."""
        places = np.abs(q[~self.turning]).max(initial=0.0)
        points = [np.abs((*each.point_a.values, *each.point_b.values)).max() for each in self.joints]
        length = float(max(places, *points, 1e-6)) if points else float(max(places, 1.0))
        return np.where(self.turning, 1.0, length), length


def positions(
    system: ConstrainedSystem, t: float, start: Array, request: Request, tree: SpanningTree, keep: Sequence[int]
) -> Array:
    """Return coordinates of the bodies for which the joints have the given positions.

    `start` closes all joints; the coordinates in `keep` do not change. Raises ValueError, with the name of a joint, if
    the joints do not permit the positions, or do not determine where the bodies are.
    """
    units, length = request.scales(start)
    columns = np.where(np.isin(np.arange(system.n_q), keep), 0.0, units)
    sizes, other_sizes = (_sizes(each, length) for each in (request.given, request.others))
    begin, others_begin = _positions(request.given, start), _positions(request.others, start)

    def solved(q: Array, target: Array, iterations: int) -> tuple[Array, float]:
        """Return the coordinates after Newton's method, and the largest residual of joints and of target values."""
        last = np.inf
        for _ in range(iterations):
            rows = np.vstack([system.jacobian(t, q), _gradients(request.given, q) / sizes[:, None]]) * columns
            off = np.append(system.constraint(t, q), (_positions(request.given, q) - target) / sizes)
            back = (others_begin - _positions(request.others, q)) / other_sizes
            step = _least(rows, -off, _motions(request, q, length, STIFF) * columns, STIFF * back)[0]
            step *= min(1.0, LONGEST / max(float(np.abs(step).max()), LONGEST))
            q = q + columns * step
            size = float(np.abs(step).max())
            if size < CONVERGED or (size < OFF and size > 0.5 * last):  # second case: only rounding errors are left
                break
            last = size
        return q, max(_open(system, t, q) / max(1.0, length), _off(request, q, target, sizes))

    carried = _carried(start, request, tree)
    closes = _open(system, t, carried) <= OFF * max(1.0, length) and not (carried != start)[list(keep)].any()
    if closes and _off(request, carried, request.values, sizes) <= OFF:
        start = carried
    chosen = [] if start is carried else _independent(system, t, start, request, columns)
    if 0 < len(chosen) < len(request.given):  # intermediate values on a straight way would contradict each other
        given = tuple(request.given[k] for k in chosen)
        start = positions(system, t, start, replace(request, given=given, values=request.values[chosen]), tree, keep)
        carried = start
    if start is carried:
        begin = request.values
    q, done, part = start, 0.0, min(1.0, STEP / max(float(np.abs((request.values - begin) / sizes).max()), STEP))
    shortest = LEAST_STEP if part > LEAST_STEP else LEAST_STEP * part
    while done < 1.0 and part > shortest:
        to = 1.0 if done + part > 1.0 - shortest else done + part
        new, left = solved(q, begin + to * (request.values - begin), ITERATIONS)
        if left <= OFF and np.abs((new - q) / units).max() <= LONGEST:
            q, done = new, to
        else:  # the step is too long, and may lead to another branch
            part *= 0.5
    reached = [_positions(request.given, q)]
    if done == 1.0:
        q, _ = solved(q, request.values, LAST_ITERATIONS)
    for _ in range(ITERATIONS):  # close the joints exactly, even if given values have six digits only
        rows = system.jacobian(t, q) * columns
        q = q - columns * np.linalg.lstsq(rows, system.constraint(t, q), rcond=SINGULAR)[0]
    if not _off(request, q, request.values, sizes) <= OFF or not _open(system, t, q) <= OFF * max(1.0, length):
        reached.append(_positions(request.given, q))
        nearest = min(reached, key=lambda values: float(np.abs((values - request.values) / sizes).max()))
        raise ValueError(_not_reached(request, nearest, np.abs(nearest - request.values) / sizes, "positions"))
    moved = np.abs((_positions(request.others, q) - others_begin) / other_sizes)
    rows = np.vstack([system.jacobian(t, q), _gradients(request.given, q) / sizes[:, None]]) * columns
    _check_determined(request, q, rows, columns, other_sizes, moved, "positions")
    return q


def _carried(start: Array, request: Request, tree: SpanningTree) -> Array:
    """Return the coordinates after each joint of the tree has moved, together with all bodies that follow it."""
    number = {key: k for k, key in enumerate(tree.keys)}
    pitches = {joint.name: joint.pitch for joint in request.joints if joint.kind == "screw"}
    step = np.zeros(len(tree.keys))
    for each, value in zip(request.given, request.values, strict=True):
        by = value - float(each.position(start))
        if each.joint in pitches and each.which == "displacement":
            by *= TURN / pitches[each.joint]
        which = "angle" if each.joint in pitches else each.which
        if (each.joint, which) in number:
            step[number[each.joint, which]] = by
    return tree.place(tree.moved(tree.state(start), step), start)


def _independent(system: ConstrainedSystem, t: float, q: Array, request: Request, columns: Array) -> list[int]:
    """Return the indices of given coordinates that do not follow from the given coordinates before them."""
    free = null_space(system.jacobian(t, q) * columns, rcond=SINGULAR)
    rows = _gradients(request.given, q) * columns @ free
    chosen: list[int] = []
    for k in range(len(rows)):
        if np.linalg.matrix_rank(rows[[*chosen, k]], MOVES) > len(chosen):
            chosen.append(k)
    return chosen


def _open(system: ConstrainedSystem, t: float, q: Array) -> float:
    return float(np.abs(system.constraint(t, q)).max(initial=0.0))


def _off(request: Request, q: Array, target: Array, sizes: Array) -> float:
    off = np.abs(_positions(request.given, q) - target) / np.maximum(sizes, np.abs(target))
    return float(off.max()) if np.isfinite(off).all() else np.inf


def velocities(
    system: ConstrainedSystem,
    t: float,
    q: Array,
    request: Request,
    given: Array,
    is_given: NDArray[np.bool_],
    of_bodies: Callable[[int], str],
) -> Array:
    """Return velocities for which the joints have the given rates, and bodies their given velocities.

    Raises ValueError, with the name of a joint or body, if the joints do not permit these, or leave some undetermined.
    """
    units, length = request.scales(q)
    sizes, other_sizes = (_sizes(each, length) for each in (request.given, request.others))
    rows = np.vstack([system.rows(t, q), _gradients(request.given, q) / sizes[:, None]]) * units
    right = np.append(-system.rates(t, q), request.values / sizes)
    rows, right = np.vstack([rows, np.eye(system.n_q)[is_given]]), np.append(right, (given / units)[is_given])
    motions = _motions(request, q, length, 1.0) * units
    v, left = _least(rows, right, motions, np.zeros(len(request.others)))
    v = v * units
    speed = max(1.0, float(np.abs(v / units).max(initial=0.0)))
    if left > OFF * speed:
        reached = _gradients(request.given, q) @ v
        off = np.abs(reached - request.values) / sizes / speed
        of_body = np.where(is_given, np.abs(v - given) / units, 0.0)
        if of_body.max(initial=0.0) > max(OFF * speed, 1.0 * off.max(initial=0.0) * speed):
            j = int(of_body.argmax())
            raise ValueError(
                f"the rates given for joints of {request.name!r} do not agree with the velocities given with its "
                f"bodies: the rate of {of_bodies(j)} is given as {given[j]:.6g}, and the nearest admissible value is "
                f"{v[j]:.6g}. Give one of both"
            )
        raise ValueError(_not_reached(request, reached, off, "rates"))
    moved = np.abs(_gradients(request.others, q) @ v / other_sizes)
    _check_determined(request, q, rows, units, other_sizes, moved, "rates")
    return np.asarray(v)


def _not_reached(request: Request, reached: Array, off: Array, what: str) -> str:
    """Return the message that names the joint whose value is farthest from its given value."""
    worst = int(np.argmax(off))
    unit = request.given[worst].unit + ("/s" if what == "rates" else "")
    name = request.given[worst].name if what == "positions" else f"rate of the {request.given[worst].name}"
    several = f" together with those of {_names(request, worst)}" if len(request.given) > 1 else ""
    return (
        f"{what} of {request.name!r}: the joints do not permit {request.values[worst]:.6g} {unit} as the "
        f"{name}{several}; the nearest value found is {reached[worst]:.6g} {unit}. Give fewer "
        f"{what} (those of other joints in a loop follow), or others"
    )


def _names(request: Request, but: int) -> str:
    return ", ".join(repr(each.joint) for k, each in enumerate(request.given) if k != but)


def _check_determined(
    request: Request, q: Array, rows: Array, units: Array, sizes: Array, moved: Array, what: str
) -> None:
    """Raise if joints had to move, but could have moved differently."""
    free = null_space(rows, rcond=SINGULAR)
    free = free[:, np.abs(free * units[:, None]).max(axis=0) > 0.0] if free.size else free
    if not free.shape[1] or not (moved > MOVES).any():
        return
    could = np.abs(_gradients(request.others, q) * units / sizes[:, None] @ free).max(axis=1)
    could = np.where(moved > MOVES, could, 0.0)
    if could.max() > MOVES:
        name = request.others[int(could.argmax())].joint
        raise ValueError(
            f"{what} of {request.name!r} do not determine the joint {name!r}, which has to move with those given but "
            f"can move in several ways: give its {what[:-1]}, or that of another joint, too"
        )


def _least(rows: Array, right: Array, motions: Array, back: Array) -> tuple[Array, float]:
    """Solve rows x = right with the least |motions x - (back, 0)|, then the least |x|; also return the residual."""
    lengths = np.linalg.norm(rows, axis=1)
    weights = 1.0 / np.where(lengths > 0.0, lengths, 1.0)
    x = np.linalg.lstsq(rows * weights[:, None], right * weights, rcond=SINGULAR)[0]
    left = float(np.abs(rows @ x - right).max(initial=0.0))
    free = null_space(rows * weights[:, None], rcond=SINGULAR)
    if free.shape[1]:
        target = np.append(back, np.zeros(len(motions) - len(back)))
        moved = motions @ free  # nothing but rounding if the only free motion left is that of all bodies together
        size, smallest = float(np.linalg.norm(moved)), SINGULAR * float(np.linalg.norm(motions))
        if size > smallest:
            x = x + free @ np.linalg.lstsq(moved, target - motions @ x, rcond=max(SINGULAR, smallest / size))[0]
    return np.asarray(x), left


def _sizes(coordinates: Sequence[JointCoordinate], length: float) -> Array:
    return np.array([length if each.unit == "m" else 1.0 for each in coordinates])


def _positions(coordinates: Sequence[JointCoordinate], q: Array) -> Array:
    return np.array([float(each.position(q)) for each in coordinates])


def _gradients(coordinates: Sequence[JointCoordinate], q: Array) -> Array:
    """Return derivatives of joint coordinates by coordinates of bodies, (n, n_q): the rates for unit velocities."""
    unit = np.eye(len(q))
    return np.array([each.rate(q, unit) for each in coordinates]).reshape(len(coordinates), len(q))


def _motions(request: Request, q: Array, length: float, stiff: float) -> Array:
    """Return the rows whose sum of squares is minimised: rates of the other coordinates, and motions in all joints."""
    n_q, unit = len(q), np.eye(len(q))
    rows = [stiff * _gradients(request.others, q) / _sizes(request.others, length)[:, None]]
    for joint in request.joints:
        a, b = joint.a.number, joint.b.number
        ends = [np.array(each.values) for each in (joint.point_a, joint.point_b)]
        slip = velocity_apart(q, unit, a, ends[0], b, ends[1])
        apart = [y - x for x, y in zip(point_of(q, a, ends[0]), point_of(q, b, ends[1]), strict=True)]
        if len(apart) == 2:
            turn = angle_of(unit, a) * np.ones(n_q)
            carried, spins = [-turn * apart[1], turn * apart[0]], [angle_of(unit, b) - turn]
        else:
            turn_a = [x * np.ones(n_q) for x in spin_of(q, unit, a)]
            carried = cross(turn_a, apart)
            spins = [x - y for x, y in zip(spin_of(q, unit, b), turn_a, strict=True)]
        rows += [(np.array(slip) - np.array(carried)) / length, np.array(spins)]
    return np.vstack(rows)
