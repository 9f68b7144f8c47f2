"""How bodies are put together: positions, then velocities, and what the joints leave free, told by names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, null_space
from scipy.optimize import least_squares

from twoloop.checks.arguments import Array
from twoloop.checks.scales import TURNS, column_scales, generic_factors, median, scales_of
from twoloop.checks.sparse_rows import SparseRows, norms
from twoloop.problem.description import name_and_unit
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.projection import consistent_state

SINGULAR = 1e-9  # singular values of scaled rows that count as zero, over the largest
NEARBY = 0.02  # of the largest coordinate, at least of 1: how far away the joints are looked at once more
ROUGH = 0.1  # of the largest velocity given: by how much joints may change it
ROUNDING = 8.0 * np.finfo(np.float64).eps  # of the terms of a constraint
CLEAR = 1e-12  # reciprocal condition of C_q C_q^T from which the rank is full without a doubt
TURN = 1e-4  # of the units of coordinates: a way over which it is seen how fast rows turn
SMALL = 0.05  # rad or m, of a step to where a drive begins ...
CORRECTIONS = 5  # ... and of Newton's in each
STAYS = 1e-7  # of the size of the model: what a joint that cannot close leaves open at least
ALIKE = 1e-3  # of a misfit by which two that are equal differ by rounding


@dataclass(frozen=True)
class Freedom:
    """What joints leave free.

    Attributes
    ----------
    degrees : int
        Degrees of freedom: how many velocities are independent.
    singular : int
        How many more there are at the start alone, where the joints lose rank.
    redundant : tuple of tuple of str
        Groups of joints among which a row follows from the others.
    """

    degrees: int
    singular: int
    redundant: tuple[tuple[str, ...], ...]


def positions(
    system: ConstrainedSystem,
    t: float,
    guess: Array,
    turning: NDArray[np.bool_],
    keep: Sequence[int],
    rows: Mapping[str, tuple[int, ...]],
    coordinates: Sequence[str],
) -> Array:
    """Bodies moved by the least change so that all joints close.

    Parameters
    ----------
    system : ConstrainedSystem
        Without drives.
    guess : ndarray (n_q,)
    turning : ndarray of bool (n_q,)
        Which coordinates are rotations.
    keep : sequence of int
        Which stay as they are.
    rows : mapping
        Of each joint, by its name.
    coordinates : sequence of str (n_q,)

    Raises
    ------
    ValueError
        Naming the joint that does not close; or if the poses are so far off that they may be put together in two ways.
    """
    if system.n_c == 0:
        return guess
    terms = abs(system.sparse_rows(t, guess)[: system.n_c]) @ np.where(
        turning, np.maximum(np.abs(guess), 1.0), np.abs(guess)
    )
    if (np.abs(system.constraint(t, guess)) <= ROUNDING * terms).all():
        return guess
    try:
        found = consistent_state(system, t, guess, np.zeros(system.n_q))[0]
        reason = ""
    except ValueError as error:
        reason = re.sub(r"coordinate (\d+)", lambda of: name_and_unit(coordinates[int(of[1])])[0], str(error))
    if len(keep) or reason:
        found = _nearest(system, t, guess, keep)
        left = np.abs(system.constraint(t, found))
        if (left > STAYS * np.maximum(terms, terms.max())).any():
            raise ValueError(_open(system, left, rows))
    if reason:
        raise ValueError(f"the bodies of {system.name!r} cannot be put together from the poses given: {reason}")
    return found


def driven_there(system: ConstrainedSystem, t: float, start: Array, keep: Sequence[int]) -> Array:
    """Where drives move bodies whose other joints are closed: in small steps, so that no assembly is left.

    Raises
    ------
    ValueError
        If the joints, or the bodies that are kept, do not let them.
    """
    free = np.setdiff1d(np.arange(system.n_q), keep)
    q, values = start.copy(), system.constraint(t, start)
    n = int(np.ceil(np.abs(values).max() / SMALL))
    for k in range(1, n + 1):
        for _ in range(CORRECTIONS):
            off = system.constraint(t, q) - (1.0 - k / n) * values
            q[free] -= np.linalg.lstsq(system.jacobian(t, q)[:, free], off, rcond=SINGULAR)[0]
        left = np.abs(system.constraint(t, q) - (1.0 - k / n) * values).max()
        if not left <= STAYS * max(1.0, float(np.abs(values).max())):
            raise ValueError(
                f"the drives of {system.name!r} ask at t = {t:g} for a position to which the joints do not let the "
                f"bodies come: they get {(k - 1) / n:.0%} of the way. Give poses nearer to where the motion begins, "
                "another motion, or keep fewer bodies"
            )
    return q


def _open(system: ConstrainedSystem, left: Array, rows: Mapping[str, tuple[int, ...]]) -> str:
    """Which joints stay open, by what is left of their rows."""
    misfit = {name: max((float(left[k]) for k in of if k < len(left)), default=0.0) for name, of in rows.items()}
    # of misfits that are equal but for rounding the first is named, on every machine
    worst = next(name for name in misfit if misfit[name] >= (1.0 - ALIKE) * max(misfit.values()))
    others = [name for name in misfit if name != worst and misfit[name] > 0.1 * misfit[worst]]
    also = f" (nor do {', '.join(map(repr, others))})" if others else ""
    return (
        f"the bodies of {system.name!r} cannot be put together: the joint {worst!r} does not close{also}; with the "
        f"least misfit of all joints {misfit[worst]:.3g} remain in it. Look at lengths, at the points of these joints, "
        "and at what else holds their bodies"
    )


def _nearest(system: ConstrainedSystem, t: float, guess: Array, keep: Sequence[int]) -> Array:
    """Where all joints together are off least, near the poses given."""
    free = np.setdiff1d(np.arange(system.n_q), keep)
    q = guess.copy()
    if len(free) == 0:
        return q

    def put(x: Array) -> Array:
        q[free] = x
        return q

    found = least_squares(
        lambda x: system.constraint(t, put(x)),
        guess[free],
        jac=lambda x: system.jacobian(t, put(x))[:, free],
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=300,
    )
    return put(found.x).copy()


def velocities(
    system: ConstrainedSystem, t: float, q: Array, given: Array, known: NDArray[np.bool_], coordinates: Sequence[str]
) -> Array:
    """Velocities that the joints allow: those given as they are, the others with the least kinetic energy.

    Parameters
    ----------
    given : ndarray (n_q,)
    known : ndarray of bool (n_q,)
        Which of them are given.
    coordinates : sequence of str (n_q,)

    Raises
    ------
    ValueError
        If the joints do not allow the velocities given, or a drive asks for what they do not allow.
    """
    if system.n_c + system.n_a == 0 or not (known.any() or system.rates(t, q).any()):
        return np.where(known, given, 0.0)
    rows = system.rows(t, q)
    scales = scales_of(system, t, q, rows)
    scaled = scales.scaled(rows)
    v = np.where(known, given, 0.0) / scales.columns
    for _ in range(2):  # the second time for rounding
        v = v - np.linalg.lstsq(scaled, scaled @ v + system.rates(t, q) / scales.rows, rcond=SINGULAR)[0]
    left = float(np.abs(scaled @ v + system.rates(t, q) / scales.rows).max(initial=0.0))
    speed = max(float(np.abs(v).max(initial=0.0)), float(np.abs(system.rates(t, q) / scales.rows).max(initial=0.0)))
    if left > SINGULAR * max(speed, 1e-3) * 100.0:
        raise ValueError(
            f"the drives of {system.name!r} ask at t = {t:g} for velocities that its joints do not allow: too many "
            "constraints for the motion asked. Leave a drive or a joint out"
        )
    free = null_space(scaled, rcond=SINGULAR)
    target = np.where(known, given, 0.0) / scales.columns
    mass = system.mass(t, q) * np.outer(scales.columns, scales.columns)
    size = float(np.abs(target).max(initial=0.0))
    if free.shape[1] and known.any():
        block = free[known]
        v = v + free @ np.linalg.lstsq(block, (target - v)[known], rcond=SINGULAR)[0]
        free = free @ null_space(block, rcond=SINGULAR)
    if free.shape[1]:
        inert = free.T @ mass @ free
        v = v - free @ np.linalg.lstsq(inert, free.T @ (mass @ v), rcond=SINGULAR)[0]
    off = np.where(known, np.abs(v - target), 0.0)
    if off.max(initial=0.0) > ROUGH * size:
        j = int(off.argmax())
        name, unit = name_and_unit(coordinates[j])
        raise ValueError(
            f"the joints and drives of {system.name!r} do not allow the velocities given: the rate of {name} was to be "
            f"{given[j]:.6g}, and the nearest that they allow is {v[j] * scales.columns[j]:.6g}"
            f"{f' ({unit}/s)' if unit else ''}. Give velocities of fewer bodies (the others follow), or fewer joints"
        )
    v = v - np.linalg.lstsq(scaled, scaled @ v + system.rates(t, q) / scales.rows, rcond=SINGULAR)[0]
    at_rest = np.where(~known & (np.abs(v) < ROUNDING * np.abs(v).max()), 0.0, v)  # without what rounding leaves
    rates = system.rates(t, q) / scales.rows
    terms = ROUNDING * (np.abs(scaled) @ np.abs(at_rest) + np.abs(rates))
    if (np.abs(scaled @ at_rest + rates) <= np.maximum(np.abs(scaled @ v + rates), terms)).all():
        v = at_rest
    return np.asarray(v * scales.columns)


def freedom(system: ConstrainedSystem, t: float, q: Array, rows: Mapping[str, tuple[int, ...]]) -> Freedom:
    """Degrees of freedom at a start and beside it, and which joints have rows that follow from others."""
    if system.n_c + system.n_a == 0:
        return Freedom(system.n_q, 0, ())
    if _full_by_entries(system, t, q):
        return Freedom(system.n_q - system.n_c - system.n_a, 0, ())
    scaled = _scaled(system, t, q)
    if _full_rank(scaled):
        return Freedom(system.n_q - len(scaled), 0, ())
    at_start = _rank(system, t, q)
    beside = at_start
    free = null_space(scaled, rcond=SINGULAR)
    if free.shape[1]:
        direction = free @ np.random.default_rng(3).uniform(0.5, 1.0, free.shape[1])
        away = q + NEARBY * max(1.0, float(np.abs(q).max())) * direction / np.abs(direction).max()
        try:
            there = consistent_state(system, t, away, np.zeros(system.n_q), check_assembly=False)[0]
            beside = max(beside, _rank(system, t, there))
        except ValueError:  # no way leads there: what is found at the start stands
            there = q
        q = there if beside > at_start else q
    degrees = system.n_q - beside
    return Freedom(degrees, beside - at_start, _redundant(system, t, q, rows))


def _scaled(system: ConstrainedSystem, t: float, q: Array) -> Array:
    rows = system.rows(t, q)
    return scales_of(system, t, q, rows).scaled(rows)


def _full_by_entries(system: ConstrainedSystem, t: float, q: Array) -> bool:
    """The same as `_full_rank` of large systems that give their entries; False: their full matrices have to say."""
    rows = system.sparse_rows(t, q)
    if not isinstance(rows, SparseRows) or len(rows) > rows.shape[1]:
        return False
    from scipy.sparse import csc_array  # which takes a while
    from scipy.sparse.linalg import LinearOperator, onenormest, splu

    size = np.abs(q)
    columns = column_scales(rows, np.maximum(size, median(size[size > 0.0]) if size.any() else 1.0))
    way, units = TURN * columns * generic_factors(len(q)), columns[rows.columns]
    try:
        sides = [rows.added(system.jacobian_values(t, q + part)) for part in (way, -way)]
    except Exception:  # outside what the callbacks are made for
        return False
    turned = norms(rows.with_values((sides[0] - sides[1]) * units)) / (2.0 * TURN)
    lengths = np.maximum(norms(rows.with_values(rows.values * units)), TURNS * turned)
    if not (lengths > 0.0).all():
        return False
    scaled = csc_array((rows.values * units / lengths[rows.rows], (rows.rows, rows.columns)), shape=rows.shape)
    square = (scaled @ scaled.T).tocsc()
    try:
        factors = splu(square, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:  # exactly singular
        return False
    inverse = LinearOperator(square.shape, matvec=factors.solve, rmatvec=factors.solve, dtype=float)
    return bool(abs(square).sum(axis=0).max() * onenormest(inverse) < 1.0 / CLEAR)


def _full_rank(scaled: Array) -> bool:
    """Whether all rows are independent without a doubt: far cheaper to say than the rank."""
    if len(scaled) > scaled.shape[1]:
        return False
    square = scaled @ scaled.T
    factor, info = lapack.dpotrf(square)
    return bool(info == 0 and lapack.dpocon(factor, np.abs(square).sum(axis=0).max())[0] > CLEAR)


def _rank(system: ConstrainedSystem, t: float, q: Array) -> int:
    scaled = _scaled(system, t, q)
    values = np.linalg.svd(scaled, compute_uv=False)
    return int((values > SINGULAR * values.max(initial=0.0)).sum())


def _redundant(
    system: ConstrainedSystem, t: float, q: Array, rows: Mapping[str, tuple[int, ...]]
) -> tuple[tuple[str, ...], ...]:
    """Joints whose rows depend on one another, in groups that have no joint in common."""
    idle = null_space(_scaled(system, t, q).T, rcond=SINGULAR)
    part = idle @ idle.T  # the projector onto what rows cancel each other
    groups: list[set[str]] = []
    involved = {name: list(of) for name, of in rows.items() if np.abs(part[list(of)]).max(initial=0.0) > 1e-6}
    for name, of in involved.items():
        linked = {other for other, there in involved.items() if np.abs(part[np.ix_(of, there)]).max() > 1e-6}
        joined = {name, *linked}.union(*(group for group in groups if group & {name, *linked}))
        groups = [group for group in groups if not group & joined] + [joined]
    return tuple(tuple(name for name in rows if name in group) for group in groups)
