"""Rows of C_q and of A for other solvers: those of A v + b = 0 below those of C, and none that follow from others.

To eq. (6) rows A v + b = 0 are further rows of C_q a = Q_d. Rows that follow from others would make the matrices of
most solvers singular: a user of such a solver leaves them out of the mechanism. So do the adapters of IDA, CVODE, SciPy
and solve_dae; those of solvers that take expressions do it in `references.equations.expressions`. A row that depends on
others at the start may become independent later, so every row left out is checked at the end of the run.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher

from twoloop import ConstrainedSystem, callback
from twoloop.problem.problem import Array

RANK = 1e-9  # of a row, which follows from those before it where it differs from what they span by less
HOLDS = 1e-6  # of the largest coordinate, 1 at least: how far a position may be from a row that was left out ...
BEYOND = 1e3  # ... in addition to this many times its distance from the rows that were kept
ROWS = ("constraint", "jacobian", "constraint_rate", "gamma")
NOT_WITH_MORE_ROWS = (
    *("kinematics", "reaction_by_q", "force_by_q", "force_by_v"),
    *("nonholonomic", "nonholonomic_rate", "nonholonomic_gamma"),
)


@lru_cache(maxsize=64)
def with_all_rows(system: ConstrainedSystem) -> ConstrainedSystem:
    """The system for solvers that take its accelerations: A, b and Q_a stand below C_q, C_t and Q_d.

    C of these rows is zero: what projects positions leaves them alone, what projects velocities takes them. A system
    without such rows is returned as it is. Raises ValueError if Q_a, or Q_d of other rows, is not given.
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
    """The rows of C_q that do not follow from others at the start, for a solver that is to have no others.

    Attributes
    ----------
    system : ConstrainedSystem
        With these rows only; the one given, where they are all.

    Raises ValueError if the start violates a row left out.
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
        """What is wrong with the end of a run, at which rows that were left out do not hold; "" where they do."""
        broken = self._broken(t, np.ascontiguousarray(q)) if np.isfinite(q).all() else []  # the solver says so
        if not broken:
            return ""
        return (
            f"Row(s) {broken} of C_q follow from others at t = {self.t0:g}, were left out, and do not hold at the end, "
            f"t = {t:g}: start where they are independent. "
        )

    def _broken(self, t: float, q: Array) -> list[int]:
        """Rows that were left out and do not hold at (t, q)."""
        lengths = np.linalg.norm(self.all.jacobian(t, q), axis=1)
        distances = np.abs(self.all.constraint(t, q)) / np.where(lengths > 0.0, lengths, 1.0)
        limit = HOLDS * max(1.0, float(np.abs(q).max())) + BEYOND * float(distances[list(self.kept)].max(initial=0.0))
        return [int(k) for k in np.flatnonzero(distances > limit) if k not in self.kept]

    def multipliers(self, t: Array, q: Array, lam: Array) -> Array:
        """Those of all rows (n_c + n_a, n_t): with C_q = T C_r, of all with T^T lam = lam_r those of least norm."""
        forces, n_c = np.full((self.all.n_c, t.size), np.nan), len(self.kept)
        for k in np.flatnonzero(np.isfinite(q).all(axis=0)):
            at = float(t[k]), np.ascontiguousarray(q[:, k])
            T = np.linalg.lstsq(self.system.jacobian(*at).T, self.all.jacobian(*at).T, rcond=None)[0].T
            forces[:, k] = np.linalg.lstsq(T.T, lam[:n_c, k], rcond=None)[0]
        return np.concatenate([forces, lam[n_c:]])


def independent_rows(jacobian: Array) -> tuple[int, ...]:
    """Rows of C_q, the first ones, that do not follow from those before."""
    rows: list[int] = []
    basis = np.zeros((0, jacobian.shape[1]))
    for k, row in enumerate(jacobian):
        left = row - basis.T @ (basis @ row)
        left -= basis.T @ (basis @ left)
        if np.linalg.norm(left) > RANK * np.linalg.norm(row):
            rows.append(k)
            basis = np.vstack([basis, left / np.linalg.norm(left)])
    return tuple(rows)


@lru_cache(maxsize=64)
def _with_rows(system: ConstrainedSystem, kept: tuple[int, ...], n_a: int) -> ConstrainedSystem:
    """The system with these rows, of C and below them of A, as rows of C; and, as they are, n_a rows of A."""
    f, more = system.functions, n_a < system.n_a
    left_out = NOT_WITH_MORE_ROWS if more else ("kinematics", "reaction_by_q")
    given = {kind: function for kind, function in system.given.items() if kind not in left_out}
    below = (f.nonholonomic, f.nonholonomic_rate, f.nonholonomic_gamma) if more else ()
    made = _rows(kept, system.n_c, system.n_a - n_a, tuple(getattr(f, kind) for kind in ROWS), below)
    given |= {kind: made[kind] for kind in ROWS if kind in given or more}
    sizes: dict[str, Any] = {"n_q": system.n_q, "n_c": len(kept), "n_a": n_a, "constant_mass": system.constant_mass}
    return ConstrainedSystem(**sizes, parameters=f.p, name=system.name, **given)


@lru_cache(maxsize=64)
def _rows(
    kept: tuple[int, ...], m: int, n_a: int, of_c: tuple[Dispatcher, ...], of_a: tuple[Dispatcher, ...]
) -> dict[str, Dispatcher]:
    """The callbacks of the rows that are kept, of m of C and below them n_a of A."""
    constraint, jacobian, constraint_rate, gamma = of_c
    nonholonomic, nonholonomic_rate, nonholonomic_gamma = of_a or of_c[1:]

    @callback("constraint")
    def some_constraints(t, q, p, C):  # type: ignore[no-untyped-def]
        of_all = np.zeros(m + n_a)
        constraint(t, q, p, of_all[:m])
        for i in range(C.size):
            C[i] = of_all[kept[i]]

    @callback("jacobian")
    def some_rows(t, q, p, Cq):  # type: ignore[no-untyped-def]
        of_all = np.zeros((m + n_a, q.size))
        jacobian(t, q, p, of_all[:m])
        if n_a > 0:
            nonholonomic(t, q, p, of_all[m:])
        for i in range(Cq.shape[0]):
            Cq[i] = of_all[kept[i]]

    @callback("constraint_rate")
    def some_rates(t, q, p, Ct):  # type: ignore[no-untyped-def]
        of_all = np.zeros(m + n_a)
        constraint_rate(t, q, p, of_all[:m])
        if n_a > 0:
            nonholonomic_rate(t, q, p, of_all[m:])
        for i in range(Ct.size):
            Ct[i] = of_all[kept[i]]

    @callback("gamma")
    def some_gammas(t, q, v, p, Qd):  # type: ignore[no-untyped-def]
        of_all = np.zeros(m + n_a)
        gamma(t, q, v, p, of_all[:m])
        if n_a > 0:
            nonholonomic_gamma(t, q, v, p, of_all[m:])
        for i in range(Qd.size):
            Qd[i] = of_all[kept[i]]

    return dict(zip(ROWS, (some_constraints, some_rows, some_rates, some_gammas), strict=True))
