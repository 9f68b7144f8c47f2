"""Equations of motion from the kinetic and the potential energy."""

from collections.abc import Mapping, Sequence
from typing import Any

import sympy
from sympy import Expr

from twoloop.symbolic.differentiation import ZERO
from twoloop.symbolic.equations import Equations, along, linear
from twoloop.symbolic.mechanism import SymbolicMechanism, made
from twoloop.symbolic.reading import POSITIONS, VELOCITIES, Reader, column


def from_lagrangian(
    T: Any,
    V: Any,
    constraints: Any,
    coordinates: Any,
    *,
    forces: Any = None,
    dissipation: Any = 0,
    nonholonomic: Any = (),
    parameters: Mapping[Any, Any] | None = None,
    tangents: bool = False,
    name: str = "mechanism",
) -> SymbolicMechanism:
    """Derive M and Q from energies and all derivatives of the constraints, and compile the system.

    M = T_vv and Q = T_q - (T_v)_q v - (T_v)_t - V_q - D_v + F. M^-1 is never formed.

    Parameters
    ----------
    T : expression
        Kinetic energy, J, at most quadratic in the velocities `q.diff(t)`.
    V : expression
        Potential energy, J, depending on coordinates and time.
    constraints : list of expressions (n_c,)
        Expressions in coordinates and time that vanish. Empty if there are no position constraints.
    coordinates : list (n_q,)
        Functions of time, as created by `sympy.physics.mechanics.dynamicsymbols`.
    forces : mapping or list (n_q,), optional
        Generalised forces F; a mapping has coordinates as keys.
    dissipation : expression
        Rayleigh dissipation function D, W: its derivatives with respect to the velocities are subtracted from the
        forces.
    nonholonomic : list of expressions (n_a,)
        Expressions linear in the velocities that vanish.
    parameters : mapping
        Values of all other symbols. They can be changed later without recompilation.
    tangents : bool
        If True, derive the Jacobians of the forces and reactions for Newton's method. Useful for stiff forces: they
        replace finite differences, but double or triple the code. Fixed steps with large rotations converge better
        without.
    name : str
        Used in messages.

    Returns
    -------
    SymbolicMechanism
        With `system`, `energy` and `problem(q0, v0, t_span)`.

    Raises
    ------
    TypeError, ValueError
        If an expression has an unknown symbol or is not smooth; if a constraint depends on velocities or on no
        coordinate; if T is not quadratic or `nonholonomic` not linear in the velocities; or if `forces` have a wrong
        size or unknown coordinates.

    Examples
    --------
    >>> import sympy as sp
    >>> from twoloop.symbolic import from_lagrangian
    >>> t, m, g = sp.symbols("t m g")
    >>> x, y = (sp.Function(name)(t) for name in "xy")
    >>> T = m * (x.diff(t) ** 2 + y.diff(t) ** 2) / 2
    >>> rows, numbers = [x**2 + y**2 - 1], {m: 1.0, g: 9.81}
    >>> pendulum = from_lagrangian(T, m * g * y, rows, [x, y], parameters=numbers, name="pendulum")
    >>> problem = pendulum.problem([1.0, 0.0], [0.0, 0.0], (0.0, 1.0))
    >>> problem.system.n_q, problem.system.n_c
    (2, 1)
    """
    x = Reader(coordinates, parameters)
    kinetic, potential = x.read("T", T, VELOCITIES), x.read("V", V, POSITIONS)
    lost = x.read("dissipation", dissipation, VELOCITIES)
    F = _forces(x, forces, coordinates)
    C, W = read_rows(x, constraints, nonholonomic)

    def derive() -> Equations:
        d, n = x.differentiation, len(x.q)
        momenta = [d.by(kinetic, v) for v in x.v]
        M, rate = linear("dT/dv", momenta, x), along(momenta, x)
        Q = [d.by(kinetic - potential, x.q[i]) - rate[i] - d.by(lost, x.v[i]) + F[i] for i in range(n)]
        mass = sympy.ImmutableMatrix(n, n, lambda i, j: M.get((i, j), ZERO))
        still = dict.fromkeys(x.v, ZERO)
        steady = not any(each.has(x.t) for each in (kinetic, potential, *C, *W))
        homogeneous = all(each.xreplace(still) == 0 for each in (kinetic, *momenta, *W))
        conserved = steady and homogeneous and lost == 0 and not any(F)
        return Equations(x, mass, Q, C, W, kinetic + potential, conserved)

    return made(
        x, ["Lagrange", kinetic, potential, lost, F, C, W], derive, rows=(len(C), len(W)), tangents=tangents, name=name
    )


def read_rows(x: Reader, constraints: Any, nonholonomic: Any) -> tuple[list[Expr], list[Expr]]:
    """Return both kinds of constraints, each of which must depend on a coordinate or velocity."""
    C = x.read_all("constraints", constraints, POSITIONS)
    W = x.read_all("nonholonomic", nonholonomic, VELOCITIES)
    for argument, rows, symbols, names in (
        ("constraints", C, x.q, "coordinates"),
        ("nonholonomic", W, x.v, "velocities"),
    ):
        for i, row in enumerate(rows):
            if not row.free_symbols & set(symbols):
                raise ValueError(f"{argument}[{i}] must depend on the {names}; given {row}")
    linear("nonholonomic", W, x)
    return C, W


def _forces(x: Reader, forces: Any, coordinates: Sequence[Any]) -> list[Expr]:
    n = len(x.q)
    if isinstance(forces, Mapping):
        unknown = [each for each in forces if each not in list(coordinates)]
        if unknown:
            raise ValueError(f"forces must be for coordinates, {', '.join(x.names)}; given one for {unknown[0]}")
        return [x.read(f"forces[{each}]", forces.get(each, 0), VELOCITIES) for each in coordinates]
    given = [0] * n if forces is None else column("forces", forces, n, "coordinate")
    return x.read_all("forces", given, VELOCITIES)
