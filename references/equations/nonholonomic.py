"""Rows A v + b = 0 for solvers of the accelerations: to eq. (6) they are further rows of C_q a = Q_d."""

from functools import lru_cache
from typing import Any

from numba.core.dispatcher import Dispatcher

from twoloop import ConstrainedSystem, callback


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
    f = system.functions
    return ConstrainedSystem(
        n_q=system.n_q,
        n_c=system.n_c + system.n_a,
        parameters=f.p,
        constant_mass=system.constant_mass,
        name=system.name,
        mass=f.mass,
        force=f.force,
        **_stacked(system.n_c, f.constraint, f.jacobian, f.constraint_rate, f.gamma, *_velocity_rows(f)),
    )


def _velocity_rows(f):  # type: ignore[no-untyped-def]
    return f.nonholonomic, f.nonholonomic_rate, f.nonholonomic_gamma


@lru_cache(maxsize=64)
def _stacked(
    m: int,
    constraint: Dispatcher,
    jacobian: Dispatcher,
    constraint_rate: Dispatcher,
    gamma: Dispatcher,
    nonholonomic: Dispatcher,
    nonholonomic_rate: Dispatcher,
    nonholonomic_gamma: Dispatcher,
) -> dict[str, Any]:
    """The callbacks of m rows of C and those of A below."""

    @callback("constraint")
    def all_constraints(t, q, p, C):  # type: ignore[no-untyped-def]
        constraint(t, q, p, C[:m])

    @callback("jacobian")
    def all_rows(t, q, p, Cq):  # type: ignore[no-untyped-def]
        jacobian(t, q, p, Cq[:m])
        nonholonomic(t, q, p, Cq[m:])

    @callback("constraint_rate")
    def all_rates(t, q, p, Ct):  # type: ignore[no-untyped-def]
        constraint_rate(t, q, p, Ct[:m])
        nonholonomic_rate(t, q, p, Ct[m:])

    @callback("gamma")
    def all_gammas(t, q, v, p, Qd):  # type: ignore[no-untyped-def]
        gamma(t, q, v, p, Qd[:m])
        nonholonomic_gamma(t, q, v, p, Qd[m:])

    made = (all_constraints, all_rows, all_rates, all_gammas)
    return dict(zip(("constraint", "jacobian", "constraint_rate", "gamma"), made, strict=True))
