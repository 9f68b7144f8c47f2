"""consistent_states: many guesses put on the constraints at once."""

from __future__ import annotations  # ArrayLike stays a word in help()

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import Array, check_finite, check_indices
from twoloop.ensembles.in_lanes import threads_of
from twoloop.ensembles.starts import (
    AT_ROUNDING,
    Starts,
    all_starts,
    far_off,
    generic_parameters,
    kit_to_write,
    over_rounding,
    system_of,
)
from twoloop.generate.known_numbers import Record
from twoloop.generate.on_arrays import OnArrays
from twoloop.generate.traced_equations import Equations
from twoloop.generate.tracing import Untraceable
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.run.projection import consistent_state

MOST_ITERATIONS = 12
STRAIGHT = 0.25  # of a displacement: how far its projection may end from where C_q sends it
SINGULAR = 1e-12  # smallest eigenvalue of G G^T, rows of length 1, that counts ...
LEAST = 1e-15  # ... and what is added to it, so that it has an inverse
LEAST_AT_ONCE, AT_ONCE = 250, 2000  # guesses whose matrices are in memory together, in each thread


def consistent_states(
    system: ConstrainedSystem,
    t: float,
    q: ArrayLike,
    v: ArrayLike,
    *,
    parameters: ArrayLike | None = None,
    keep: Sequence[int] | None = None,
) -> tuple[Array, Array]:
    """Project many guesses onto the constraints, each by the least change, as `consistent_state` does with one.

    Guesses that are near the constraints are moved together, by Gauss-Newton on the equations that the callbacks were
    traced to, on all cores; each result is compared with what the callbacks themselves say. The others, and systems
    with nonholonomic rows or whose callbacks cannot be traced, go through `consistent_state` one by one.

    Parameters
    ----------
    system : ConstrainedSystem
    t : float
        Time, s.
    q, v : array_like (n_q,) or (n_runs, n_q)
        Guesses: one for all, or one for each.
    parameters : array_like (n_runs, n_p), optional
        Of each, instead of `system.parameters`.
    keep : sequence of int, optional
        Coordinates that stay as given, position and velocity. None: all may move.

    Returns
    -------
    q, v : ndarray (n_runs, n_q)

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, or a guess cannot be projected: as `consistent_state`, and which.
    """
    check_system(system)
    t = check_finite("t", t)
    starts = all_starts(system, t, q, v, parameters, ("q", "v"))
    kept = [] if keep is None else check_indices("keep", keep, system.n_q)
    fine = np.zeros(len(starts.q), dtype=bool)
    made_q, made_v = starts.q.copy(), starts.v.copy()
    try:
        rows = _Rows(system, starts, [j for j in range(system.n_q) if j not in kept])
    except Untraceable:
        rows = None

    def block(which: slice) -> None:
        assert rows is not None
        made_q[which], made_v[which], fine[which] = _together(rows.part(which))

    threads = threads_of(None)
    size = int(np.clip(-(-len(fine) // threads), LEAST_AT_ONCE, AT_ONCE))
    blocks = [] if rows is None else [slice(begin, begin + size) for begin in range(0, len(fine), size)]
    with ThreadPoolExecutor(threads) as pool:  # NumPy does not hold the GIL where it computes
        list(pool.map(block, blocks))
    # of others compiled callbacks may go out of the bounds of their arrays, which single calls look at
    traced = np.flatnonzero(fine)
    made = Starts(t, made_q[traced], made_v[traced], starts.parameters[traced])
    fine[traced] = ~far_off(kit_to_write(system), made)
    for run in np.flatnonzero(~fine).tolist():
        try:
            found = consistent_state(system_of(system, starts, run), t, starts.q[run], starts.v[run], keep=keep)
        except ValueError as error:
            raise ValueError(f"guess {run}: {error}") from error
        made_q[run], made_v[run] = found
    return made_q, made_v


def _together(equations: _Rows) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Positions and velocities, and which of them may be taken."""
    guesses = equations.starts
    q, fine = equations.gauss_newton(guesses.q)
    fine &= equations.on_one_assembly(q, q - guesses.q)
    v = guesses.v.copy()
    G, rate = equations.of("jacobian", q), equations.of("constraint_rate", q)
    for _ in range(2):  # once more for what rounding of a large change leaves
        v[:, equations.free] += _least_change(G[:, :, equations.free], -(np.einsum("rij,rj->ri", G, v) + rate))
    return q, v, fine & np.isfinite(v).all(axis=1)


class _Rows:
    """The constraints of guesses, and their derivatives by coordinates that may move."""

    def __init__(self, system: ConstrainedSystem, starts: Starts, free: list[int]):
        if system.n_a > 0:
            raise Untraceable("it has nonholonomic rows")
        generic, varying = generic_parameters(starts.parameters)
        record = Record(generic.tolist(), varying)
        equations = Equations(system, record.parameters)
        self._forms = {
            "constraint": equations.of("constraint"),
            "jacobian": equations.of("jacobian"),
            "constraint_rate": equations.of("constraint_rate"),
        }
        self._make = partial(OnArrays, equations.graph, record)
        self.free = free
        self._take(starts)

    def _take(self, starts: Starts) -> None:
        self.starts, self._arrays = starts, self._make(starts.parameters)

    def part(self, which: slice) -> _Rows:
        """The same of some of the guesses."""
        other, all_of = copy(self), self.starts
        other._take(Starts(all_of.t0, all_of.q[which], all_of.v[which], all_of.parameters[which]))
        return other

    def of(self, kind: str, q: Array) -> Array:
        """Values at positions (n_runs, n_q)."""
        return self._arrays.evaluate([self._forms[kind]], self.starts.t0, q, self.starts.v)[0]

    def gauss_newton(self, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Positions on the constraints, each by steps of least change, and which of them are there."""
        q, fine, there = q.copy(), np.ones(len(q), dtype=bool), np.zeros(len(q), dtype=bool)
        for _ in range(MOST_ITERATIONS):
            G, C = self.of("jacobian", q), self.of("constraint", q)
            change = _least_change(G[:, :, self.free], -C)
            fine &= np.isfinite(change).all(axis=1)
            move = fine & ~there
            q[:, self.free] += np.where(move[:, None], change, 0.0)
            if (there | ~fine).all():
                break
            there |= over_rounding(C, G, q) <= AT_ROUNDING  # after the change, which is applied to the last bit
        return q, fine & there

    def on_one_assembly(self, found: Array, moved: Array) -> NDArray[np.bool_]:
        """Whether other guesses that are as far off lead where C_q sends them, so that there is no other assembly."""
        G, free = self.of("jacobian", found)[:, :, self.free], self.free
        unit, _ = _unit_rows(G)
        fine: NDArray[np.bool_] = np.asarray(np.isfinite(unit).all(axis=(1, 2)))
        unit[~fine] = 0.0
        far, weakest = np.abs(moved).max(axis=1, keepdims=True), np.zeros_like(found)
        if G.shape[1] == 0:
            return fine
        values, vectors = np.linalg.eigh(unit @ unit.transpose(0, 2, 1))
        fine &= values[:, 0] > SINGULAR
        weakest[:, free] = np.einsum("rij,ri->rj", unit, vectors[:, :, 0])
        weakest *= far / np.maximum(np.abs(weakest).max(axis=1, keepdims=True), LEAST)
        for way in (-2.0 * moved, weakest, -weakest):
            again, there = self.gauss_newton(found + way)
            expected = found + way
            expected[:, free] += _least_change(G, -np.einsum("rij,rj->ri", G, way[:, free]))
            apart = np.abs(again - expected).max(axis=1)
            fine &= there & (apart <= STRAIGHT * np.abs(way).max(axis=1))
        return fine


def _least_change(G: Array, values: Array) -> Array:
    """The smallest x with G x = values of each run; not finite, or large, where rows depend on one another."""
    unit, norms = _unit_rows(G)
    gram = unit @ unit.transpose(0, 2, 1)
    gram[~np.isfinite(gram).all(axis=(1, 2))] = np.nan
    with np.errstate(all="ignore"):
        x = np.linalg.solve(gram + LEAST * np.eye(G.shape[1]), (values / norms)[:, :, None])
    return (unit.transpose(0, 2, 1) @ x)[:, :, 0]


def _unit_rows(G: Array) -> tuple[Array, Array]:
    """Rows of length 1, and how long they are."""
    norms = np.linalg.norm(G, axis=2)
    norms[norms == 0.0] = 1.0
    return G / norms[:, :, None], norms
