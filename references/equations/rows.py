"""Rows of C_q and of A for other solvers: those of A v + b = 0 below those of C, and none that follow from others.

To eq. (6) rows A v + b = 0 are further rows of C_q a = Q_d. Rows that follow from others would make the matrices of
most solvers singular: a user of such a solver leaves them out of the mechanism. So do the adapters of IDA, CVODE, SciPy
and solve_dae; those of solvers that take expressions do it in `references.equations.expressions`. A row that depends on
others at the start may become independent later, so every row left out is checked at the end of the run.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, wraps
from typing import Any, Concatenate, ParamSpec

import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from twoloop import ConstrainedSystem, Result, Status, callback

Array = NDArray[np.float64]
Rest = ParamSpec("Rest")
Solve = Callable[Concatenate[ConstrainedSystem, tuple[float, float], Any, Rest], Result]

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
    without such rows is returned as it is.

    Raises
    ------
    ValueError
        If Q_a, or Q_d of other rows, is not given.
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


def on_independent_rows(solve: Solve[Rest]) -> Solve[Rest]:
    """Let a solver have the rows of C_q that do not follow from others at the start.

    The multipliers of all rows are then those of least norm which give the same forces. A start that violates a row
    left out raises ValueError; a run that violates one at its end has failed.
    """

    @wraps(solve)
    def solve_independent(
        system: ConstrainedSystem, t_span: tuple[float, float], q0: Any, *rest: Rest.args, **options: Rest.kwargs
    ) -> Result:
        kept = _independent(system, t_span, q0)
        if kept is None:
            return solve(system, t_span, q0, *rest, **options)
        start = float(t_span[0]), np.asarray(q0, dtype=np.float64)
        if broken := _broken(system, kept, *start):
            raise ValueError(
                f"q0 must satisfy all constraints of {system.name!r}: row(s) {broken} of C_q follow from others at t = "
                f"{start[0]:g}, and contradict them. Correct these constraints, or leave them out"
            )
        some = _with_rows(system, kept, system.n_a)
        result = solve(some, t_span, q0, *rest, **options)
        if result.t.size and (broken := _broken(system, kept, float(result.t[-1]), result.q[:, -1])):
            message = (
                f"Row(s) {broken} of C_q follow from others at t = {start[0]:g}, were left out, and do not hold at the "
                f"end, t = {result.t[-1]:g}: start where they are independent. {result.message}"
            )
            result = replace(result, status=Status.SOLVER_FAILED, message=message)
        return replace(result, lam=_of_all_rows(system, some, result))

    return solve_independent


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


def _independent(system: Any, t_span: Any, q0: Any) -> tuple[int, ...] | None:
    """Such rows; None where all are, or where the solver will refuse the arguments."""
    if not isinstance(system, ConstrainedSystem) or np.shape(q0) != (system.n_q,) or np.shape(t_span) != (2,):
        return None
    q = np.asarray(q0, dtype=np.float64)
    if system.n_c == 0 or not np.isfinite(q).all():
        return None
    kept = independent_rows(system.jacobian(float(t_span[0]), q))
    return None if len(kept) == system.n_c else kept


def _broken(system: ConstrainedSystem, kept: tuple[int, ...], t: float, q: Array) -> list[int]:
    """Rows that were left out and do not hold at (t, q)."""
    q = np.ascontiguousarray(q)
    if not np.isfinite(q).all():
        return []  # the solver says so
    lengths = np.linalg.norm(system.jacobian(t, q), axis=1)
    distances = np.abs(system.constraint(t, q)) / np.where(lengths > 0.0, lengths, 1.0)
    limit = HOLDS * max(1.0, float(np.abs(q).max())) + BEYOND * float(distances[list(kept)].max(initial=0.0))
    return [int(k) for k in np.flatnonzero(distances > limit) if k not in kept]


@lru_cache(maxsize=64)
def _with_rows(system: ConstrainedSystem, kept: tuple[int, ...], n_a: int) -> ConstrainedSystem:
    """The system with these rows, of C and below them of A, as rows of C; and, as they are, n_a rows of A."""
    f, left_out = system.functions, ("kinematics", "reaction_by_q") if n_a == system.n_a else NOT_WITH_MORE_ROWS
    given = {kind: function for kind, function in system.given.items() if kind not in left_out}
    below = None if n_a == system.n_a else (f.nonholonomic, f.nonholonomic_rate, f.nonholonomic_gamma)
    made = _rows(kept, system.n_c, system.n_a - n_a, *(getattr(f, kind) for kind in ROWS), below)
    given |= {kind: made[kind] for kind in ROWS if kind in given or below is not None}
    return ConstrainedSystem(
        n_q=system.n_q,
        n_c=len(kept),
        n_a=n_a,
        parameters=f.p,
        constant_mass=system.constant_mass,
        name=system.name,
        **given,
    )


@lru_cache(maxsize=64)
def _rows(
    kept: tuple[int, ...],
    m: int,
    n_a: int,
    constraint: Dispatcher,
    jacobian: Dispatcher,
    constraint_rate: Dispatcher,
    gamma: Dispatcher,
    below: tuple[Dispatcher, Dispatcher, Dispatcher] | None,
) -> dict[str, Dispatcher]:
    """The callbacks of the rows that are kept, of m of C and below them n_a of A."""
    nonholonomic, nonholonomic_rate, nonholonomic_gamma = below or (jacobian, constraint_rate, gamma)

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


def _of_all_rows(system: ConstrainedSystem, some: ConstrainedSystem, result: Result) -> Array:
    """Multipliers (n_c + n_a, n_t) of all rows: with C_q = T C_r, of all with T^T lam = lam_r those of least norm."""
    forces = np.full((system.n_c, result.t.size), np.nan)
    for k in np.flatnonzero(np.isfinite(result.q).all(axis=0)):
        t, q = float(result.t[k]), np.ascontiguousarray(result.q[:, k])
        T = np.linalg.lstsq(some.jacobian(t, q).T, system.jacobian(t, q).T, rcond=None)[0].T
        forces[:, k] = np.linalg.lstsq(T.T, result.lam[: some.n_c, k], rcond=None)[0]
    return np.concatenate([forces, result.lam[some.n_c :]])
