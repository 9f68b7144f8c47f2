"""Rows of C_q and A for other solvers, and accelerations and multipliers at stored states.

In eq. (6), rows A v + b = 0 are further rows of C_q a = Q_d. Dependent rows would make the matrices of most solvers
singular, so a user of such a solver removes them from the mechanism. So do the adapters of IDA, CVODE, SciPy and
solve_dae; those of solvers that take expressions do it in `references.equations.expressions`. A row that is dependent
at the start may become independent later, so every removed row is checked at the end of the run.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher

from references.equations.accelerations import compiled_gamma
from twoloop import callback
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem

SAMPLES = 5  # states at which the rank is determined, because it may be lower at singular positions
RANK = 1e-9  # relative: a row closer than this to the span of the previous rows counts as dependent
HOLDS = 1e-6  # relative to max(1, |q|): allowed violation of a removed row ...
BEYOND = 1e3  # ... plus this multiple of the violation of the rows kept
ROWS = ("constraint", "jacobian", "constraint_rate", "gamma")
NOT_WITH_MORE_ROWS = (
    *("kinematics", "reaction_by_q", "force_by_q", "force_by_v"),
    *("nonholonomic", "nonholonomic_rate", "nonholonomic_gamma"),
)


@lru_cache(maxsize=64)
def with_all_rows(system: ConstrainedSystem) -> ConstrainedSystem:
    """Return the system with A, b and Q_a appended to C_q, C_t and Q_d, for solvers of the acceleration equations.

    C of these rows is zero, so projections of positions ignore them, and projections of velocities include them. A
    system without such rows is returned unchanged. Raises ValueError if Q_a, or Q_d of other rows, is not given.
    """
    if system.n_a == 0:
        return system
    missing = {"nonholonomic_gamma", *(["gamma"] if system.n_c else [])} - system.given.keys()
    if missing:
        raise ValueError(
            f"system must give {' and '.join(sorted(missing))} for the adapters of other solvers, as it has rows "
            f"A v + b = 0; {system.name!r} does not"
        )
    return _with_rows(system, tuple(range(system.n_c + system.n_a)), 0)


class IndependentRows:
    """The rows of C_q that are independent at the start, for a solver that does not support others.

    `system` is the system with these rows only; the one given if all are independent. Raises ValueError if the start
    violates a removed row.
    """

    def __init__(self, system: ConstrainedSystem, t0: float, q0: Array):
        self.all, self.system, self.t0 = system, system, t0
        self.kept = independent_rows(system.jacobian(t0, q0)) if system.n_c else ()
        if len(self.kept) < system.n_c:
            self.system = _with_rows(system, self.kept, system.n_a)
            if broken := self._broken(t0, q0):
                raise ValueError(
                    f"q0 must satisfy all constraints of {system.name!r}: row(s) {broken} of C_q follow from others at "
                    f"t = {t0:g}, and contradict them. Correct these constraints, or leave them out"
                )

    def failure(self, t: float, q: Array) -> str:
        """Return an error message if a removed row is violated at the end of a run, or ""."""
        broken = self._broken(t, np.ascontiguousarray(q)) if np.isfinite(q).all() else []  # reported by the solver
        if not broken:
            return ""
        return (
            f"Row(s) {broken} of C_q follow from others at t = {self.t0:g}, were left out, and do not hold at the end, "
            f"t = {t:g}: start where they are independent. "
        )

    def _broken(self, t: float, q: Array) -> list[int]:
        """Return the removed rows that are violated at (t, q)."""
        lengths = np.linalg.norm(self.all.jacobian(t, q), axis=1)
        distances = np.abs(self.all.constraint(t, q)) / np.where(lengths > 0.0, lengths, 1.0)
        limit = HOLDS * max(1.0, float(np.abs(q).max())) + BEYOND * float(distances[list(self.kept)].max(initial=0.0))
        return [int(k) for k in np.flatnonzero(distances > limit) if k not in self.kept]

    def multipliers(self, t: Array, q: Array, lam: Array) -> Array:
        """Return the multipliers of all rows (n_c + n_a, n_t): minimum-norm lam with T^T lam = lam_r, C_q = T C_r."""
        forces, n_c = np.full((self.all.n_c, t.size), np.nan), len(self.kept)
        for k in np.flatnonzero(np.isfinite(q).all(axis=0)):
            position = float(t[k]), np.ascontiguousarray(q[:, k])
            T = np.linalg.lstsq(self.system.jacobian(*position).T, self.all.jacobian(*position).T, rcond=None)[0].T
            forces[:, k] = np.linalg.lstsq(T.T, lam[:n_c, k], rcond=None)[0]
        return np.concatenate([forces, lam[n_c:]])


def independent_rows(jacobian: Array) -> tuple[int, ...]:
    """Return the rows of C_q that are independent of those before."""
    rows: list[int] = []
    basis = np.zeros((0, jacobian.shape[1]))
    for k, row in enumerate(jacobian):
        remainder = row - basis.T @ (basis @ row)
        remainder -= basis.T @ (basis @ remainder)
        if np.linalg.norm(remainder) > RANK * np.linalg.norm(row):
            rows.append(k)
            basis = np.vstack([basis, remainder / np.linalg.norm(remainder)])
    return tuple(rows)


@lru_cache(maxsize=64)
def _with_rows(system: ConstrainedSystem, rows: tuple[int, ...], n_a: int) -> ConstrainedSystem:
    """Return the system with some rows of C, and of A below them, as rows of C; plus n_a unchanged rows of A."""
    f, with_a = system.functions, n_a < system.n_a
    omitted = NOT_WITH_MORE_ROWS if with_a else ("kinematics", "reaction_by_q")
    given = {kind: function for kind, function in system.given.items() if kind not in omitted}
    below = (f.nonholonomic, f.nonholonomic_rate, f.nonholonomic_gamma) if with_a else ()
    callbacks = _rows(rows, system.n_c, system.n_a - n_a, tuple(getattr(f, kind) for kind in ROWS), below)
    given |= {kind: callbacks[kind] for kind in ROWS if kind in given or with_a}
    sizes: dict[str, Any] = {"n_q": system.n_q, "n_c": len(rows), "n_a": n_a, "constant_mass": system.constant_mass}
    return ConstrainedSystem(**sizes, parameters=f.p, name=system.name, **given)


@lru_cache(maxsize=64)
def _rows(
    rows: tuple[int, ...], m: int, n_a: int, c_callbacks: tuple[Dispatcher, ...], a_callbacks: tuple[Dispatcher, ...]
) -> dict[str, Dispatcher]:
    """Return the callbacks of the rows kept, of m rows of C and n_a rows of A below them."""
    constraint, jacobian, constraint_rate, gamma = c_callbacks
    nonholonomic, nonholonomic_rate, nonholonomic_gamma = a_callbacks or c_callbacks[1:]

    @callback("constraint")
    def some_constraints(t, q, p, C):  # type: ignore[no-untyped-def]
        values = np.zeros(m + n_a)
        constraint(t, q, p, values[:m])
        for i in range(C.size):
            C[i] = values[rows[i]]

    @callback("jacobian")
    def some_rows(t, q, p, Cq):  # type: ignore[no-untyped-def]
        values = np.zeros((m + n_a, q.size))
        jacobian(t, q, p, values[:m])
        if n_a > 0:
            nonholonomic(t, q, p, values[m:])
        for i in range(Cq.shape[0]):
            for j in range(q.size):  # numba compiles `Cq[i] = ...` two seconds longer
                Cq[i, j] = values[rows[i], j]

    @callback("constraint_rate")
    def some_rates(t, q, p, Ct):  # type: ignore[no-untyped-def]
        values = np.zeros(m + n_a)
        constraint_rate(t, q, p, values[:m])
        if n_a > 0:
            nonholonomic_rate(t, q, p, values[m:])
        for i in range(Ct.size):
            Ct[i] = values[rows[i]]

    @callback("gamma")
    def some_gammas(t, q, v, p, Qd):  # type: ignore[no-untyped-def]
        values = np.zeros(m + n_a)
        gamma(t, q, v, p, values[:m])
        if n_a > 0:
            nonholonomic_gamma(t, q, v, p, values[m:])
        for i in range(Qd.size):
            Qd[i] = values[rows[i]]

    return dict(zip(ROWS, (some_constraints, some_rows, some_rates, some_gammas), strict=True))


def accelerations(system: ConstrainedSystem, t: Array, states: Array) -> tuple[Array, Array]:
    """Return accelerations and multipliers of eq. (6) at states (2 n_q, n_t); NaN if a state is not finite."""
    n, m, f, gamma = system.n_q, system.n_c, system.functions, compiled_gamma(system)
    rows, finite = np.ascontiguousarray(states.T), np.isfinite(states).all(axis=0)
    matrices, right_sides = np.zeros((t.size, n + m, n + m)), np.zeros((t.size, n + m))
    M, Cq = np.zeros((n, n)), np.zeros((m, n))
    for k in np.flatnonzero(finite):
        time, q, v = float(t[k]), rows[k, :n], rows[k, n:]
        M[:], Cq[:] = 0.0, 0.0
        f.mass(time, q, f.p, M)
        f.force(time, q, v, f.p, right_sides[k, :n])
        if m:
            f.jacobian(time, q, f.p, Cq)
            gamma(time, q, v, f.p, right_sides[k, n:])
        matrices[k, :n, :n], matrices[k, n:, :n], matrices[k, :n, n:] = M, Cq, Cq.T
    solution = np.full((t.size, n + m), np.nan)
    if finite.any():
        solution[finite] = _solved(matrices[finite], right_sides[finite], n)
    return solution[:, :n].T, solution[:, n:].T


def _solved(matrices: Array, right_sides: Array, n: int) -> Array:
    """Return minimum-norm solutions (n_t, n + n_c) of equations with the matrices [M C_q^T; C_q 0]."""
    Cq = matrices[:, n:, :n]
    samples = np.unique(np.linspace(0, len(Cq) - 1, SAMPLES).astype(int))
    rows = np.array(max((independent_rows(jacobian) for jacobian in Cq[samples]), key=len), dtype=int)
    unknowns = np.concatenate([np.arange(n), n + rows])
    try:
        solution = np.linalg.solve(matrices[:, unknowns[:, None], unknowns], right_sides[:, unknowns, None])
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(matrices, hermitian=True) @ right_sides[:, :, None])[:, :, 0]
    lam = solution[:, n:]
    if rows.size < Cq.shape[1]:  # C_q = T C_r: minimum-norm lam with T^T lam = lam_r
        Cr = Cq[:, rows]
        T = np.linalg.solve(Cr @ Cr.mT, Cr @ Cq.mT).mT
        lam = T @ np.linalg.solve(T.mT @ T, lam)
    return np.concatenate([solution[:, :n], lam], axis=1)[:, :, 0]
