"""Equations of motion from the objects of sympy.physics.mechanics."""

from collections.abc import Mapping
from typing import Any

import sympy
from sympy.physics.mechanics import KanesMethod, LagrangesMethod, System

from twoloop.symbolic.matrices import from_matrices
from twoloop.symbolic.mechanism import SymbolicMechanism
from twoloop.symbolic.reading import sequence


def from_method(
    method: LagrangesMethod | KanesMethod | System,
    *,
    constraints: Any = (),
    nonholonomic: Any = (),
    potential: Any = 0,
    parameters: Mapping[Any, Any] | None = None,
    tangents: bool = False,
    name: str = "mechanism",
) -> SymbolicMechanism:
    """Compile the system described by an object of sympy.physics.mechanics.

    The constraints are those of the `LagrangesMethod` or the `System`, followed by those given here. A `KanesMethod`
    must describe the tree without loops, with independent coordinates and speeds; its equations need not have been
    formed if it has its bodies. There must be as many speeds as coordinates, linear in the derivatives of these.

    Parameters
    ----------
    method : LagrangesMethod, KanesMethod or System
    constraints, nonholonomic, potential, parameters, tangents, name
        As for `from_matrices`.

    Returns
    -------
    SymbolicMechanism

    Raises
    ------
    TypeError, ValueError
        As for `from_matrices`; also if the method has dependent or auxiliary speeds, or kinematic equations that do not
        determine its speeds.

    Examples
    --------
    >>> import sympy as sp
    >>> from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols
    >>> from twoloop.symbolic import from_method
    >>> x, y = dynamicsymbols("x y")
    >>> lagrangian = (x.diff() ** 2 + y.diff() ** 2) / 2 - 9.81 * y
    >>> method = LagrangesMethod(lagrangian, [x, y], hol_coneqs=[x**2 + y**2 - 1])
    >>> _ = method.form_lagranges_equations()
    >>> from_method(method, name="pendulum").n_c
    1
    """
    if isinstance(method, System):
        own = method.holonomic_constraints, method.nonholonomic_constraints
        method = _tree(method)
    elif isinstance(method, LagrangesMethod):
        if method.eom is None:
            method.form_lagranges_equations()
        n_c = len(method._hol_coneqs)
        own = list(method._hol_coneqs), list(method.coneqs)[n_c:]
    elif isinstance(method, KanesMethod):
        own = (), ()
    else:
        raise TypeError(f"method must be a LagrangesMethod, a KanesMethod or a System; given {method!r}")
    n, speeds = len(method.q), _speeds(method) if isinstance(method, KanesMethod) else None
    return from_matrices(
        method.mass_matrix[:, :n],
        method.forcing,
        [*own[0], *sequence("constraints", constraints)],
        list(method.q),
        speeds=speeds,
        nonholonomic=[*own[1], *sequence("nonholonomic", nonholonomic)],
        potential=potential,
        parameters=parameters,
        tangents=tangents,
        name=name,
    )


def _tree(system: System) -> KanesMethod:
    """Return Kane's equations of a system without its constraints."""
    loads = [*system.loads, *(load for actuator in system.actuators for load in actuator.to_loads())]
    if len(system.u_aux):
        raise ValueError("method must have no auxiliary speeds: reactions come from the multipliers")
    kane = KanesMethod(system.frame, list(system.q), list(system.u), kd_eqs=list(system.kdes))
    kane.kanes_equations(system.bodies, loads or None)
    return kane


def _speeds(kane: KanesMethod) -> dict[Any, Any]:
    """Return the generalised speeds as functions of the velocities, from the kinematic equations."""
    if len(kane._udep) or len(kane._qdep):
        raise ValueError(
            "method must have independent coordinates and speeds only: leave u_dependent, q_dependent and the "
            "constraints out of the KanesMethod, and give these as constraints= and nonholonomic="
        )
    if len(kane._uaux):
        raise ValueError("method must have no auxiliary speeds: reactions come from the multipliers")
    if kane._fr is None:
        kane.kanes_equations()
    q, u = kane.q, kane.u
    if len(u) != len(q):
        raise ValueError(
            f"method must have as many speeds as coordinates; given {len(u)} and {len(q)}. Use from_matrices, whose "
            "speeds= takes expressions in the velocities, e.g. for Euler parameters"
        )
    by_u = kane.forcing_kin.jacobian(u)  # mass_matrix_kin q' = forcing_kin, linear in u
    rest = kane.forcing_kin.xreplace(dict.fromkeys(u, sympy.S.Zero))
    if by_u.free_symbols and by_u.has(*u):
        raise ValueError("method must have kinematic equations that are linear in the speeds")
    velocities = sympy.Matrix([each.diff(sympy.physics.mechanics.dynamicsymbols._t) for each in q])
    solved = by_u.LUsolve(kane.mass_matrix_kin * velocities - rest)
    return dict(zip(u, solved, strict=True))
