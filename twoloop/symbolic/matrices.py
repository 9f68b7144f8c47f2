"""Equations of motion from a mass matrix and forces, in velocities or generalised speeds."""

from collections.abc import Mapping, Sequence
from typing import Any

import sympy
from sympy import Expr, Float

from twoloop.symbolic.differentiation import ZERO
from twoloop.symbolic.equations import Equations, along, linear
from twoloop.symbolic.lagrange import read_rows
from twoloop.symbolic.mechanism import SymbolicMechanism, made
from twoloop.symbolic.reading import POSITIONS, VELOCITIES, Reader, column, sequence, square

SAME = 1e-9  # relative tolerance of equality
PROBES = 3


def from_matrices(
    M: Any,
    Q: Any,
    constraints: Any,
    coordinates: Any,
    *,
    speeds: Mapping[Any, Any] | None = None,
    nonholonomic: Any = (),
    potential: Any = 0,
    parameters: Mapping[Any, Any] | None = None,
    tangents: bool = False,
    name: str = "mechanism",
) -> SymbolicMechanism:
    """Compile the system of M u' = Q, with all derivatives of the constraints.

    With speeds u = K(t, q) q' + k(t, q) the equations are transformed to the coordinates: the mass matrix is K^T M K,
    the force K^T (Q - M (K' q' + k')).

    Parameters
    ----------
    M : matrix (n_u, n_u)
        Symmetric mass matrix, depending on coordinates and time, without rows or columns for constraints.
    Q : list or matrix of one column (n_u,)
        Forces including velocity-dependent inertia terms, like `forcing` of SymPy's methods.
    constraints, coordinates, nonholonomic, parameters, tangents, name
        As for `from_lagrangian`; velocities may be expressed by speeds.
    speeds : mapping, optional
        Generalised speeds, in the order of M, as expressions linear in `q.diff(t)`. None: the speeds are the
        derivatives of the coordinates.
    potential : expression
        Potential energy V, J, of the energy 1/2 q'^T K^T M K q' + V. It does not change Q; conservation of the energy
        is checked numerically.

    Returns
    -------
    SymbolicMechanism
        With `system`, `energy` and `problem(q0, v0, t_span)`.

    Raises
    ------
    TypeError, ValueError
        As for `from_lagrangian`; also if M is not square, not symmetric or depends on velocities, if Q has a wrong
        size, or if a speed is not linear in the velocities.

    Examples
    --------
    >>> import sympy as sp
    >>> from twoloop.symbolic import from_matrices
    >>> t = sp.Symbol("t")
    >>> x, y = (sp.Function(name)(t) for name in "xy")
    >>> M, Q = sp.eye(2), sp.Matrix([0, sp.Float("-9.81")])
    >>> from_matrices(M, Q, [x**2 + y**2 - 1], [x, y], name="pendulum").coordinates
    ('x', 'y')
    """
    if speeds is not None and not isinstance(speeds, Mapping):
        raise TypeError(f"speeds must map generalised speeds to expressions in the velocities; given {speeds!r}")
    x = Reader(coordinates, parameters, speeds)
    n = len(x.q) if speeds is None else len(speeds)
    mass = square("M", M, n)
    mass = sympy.ImmutableMatrix(
        n, n, [x.read(f"M[{k // n}, {k % n}]", each, POSITIONS) for k, each in enumerate(mass)]
    )
    _check_symmetric(mass)
    force = x.read_all("Q", column("Q", sequence("Q", Q), n, "row of M"), VELOCITIES)
    C, W = read_rows(x, constraints, nonholonomic)
    u = x.v if speeds is None else list(x.speeds.values())
    K = linear("speeds", u, x)
    V = x.read("potential", potential, POSITIONS)

    def derive() -> Equations:
        transform = sympy.ImmutableMatrix(n, len(x.q), lambda i, j: K.get((i, j), ZERO))
        speed = transform * sympy.ImmutableMatrix(x.v)
        terms = (speed[i] * mass[i, j] * speed[j] for i in range(n) for j in range(n))
        energy = sympy.Rational(1, 2) * sympy.Add(*terms) + V
        if speeds is None:
            turned, Q_of_q = mass, force
        else:
            turned = transform.T * mass * transform
            Q_of_q = list(transform.T * (sympy.ImmutableMatrix(force) - mass * sympy.ImmutableMatrix(along(u, x))))
        return Equations(x, turned, Q_of_q, C, W, energy, _conserved(x, Q_of_q, [*C, *W], energy))

    given = ["matrices", list(mass), force, u, C, W, V]
    return made(x, given, derive, rows=(len(C), len(W)), tangents=tangents, name=name)


def _conserved(x: Reader, Q: Sequence[Expr], rows: Sequence[Expr], energy: Expr) -> bool:
    """Return True if the energy is conserved: the forces balance its change, and no constraint moves."""
    still = dict.fromkeys(x.v, ZERO)
    moving = any(row.has(x.t) or (row.xreplace(still) != 0 and row.free_symbols & set(x.v)) for row in rows)
    return not moving and _cancel([*(v * q for v, q in zip(x.v, Q, strict=True)), *along([energy], x)])


def _check_symmetric(M: sympy.MatrixBase) -> None:
    for i in range(M.rows):
        for j in range(i):
            a, b = M[i, j], M[j, i]
            if a != b and not _cancel([a, -b]):
                raise ValueError(f"M must be symmetric; given {a} in row {i}, column {j}, and {b} across the diagonal")


def _cancel(terms: Sequence[Expr]) -> bool:
    """Return True if terms sum to zero at a few points, since equal expressions may have different forms."""
    symbols = sorted(set().union(*(term.free_symbols for term in terms)), key=str)
    for probe in range(PROBES):
        values = {symbol: Float(0.3 + (0.618034 * (k + 1) * (probe + 1)) % 1.0) for k, symbol in enumerate(symbols)}
        found = [complex(term.xreplace(values)) for term in terms]
        if not abs(sum(found)) <= SAME * sum(map(abs, found)):
            return False
    return True
