"""Derive mechanisms from energies, from matrices or from the objects of sympy.physics.mechanics."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import sympy
from numpy.typing import ArrayLike
from sympy import Basic, Expr, Float
from sympy.physics.mechanics import KanesMethod, LagrangesMethod, System

from twoloop.checks.arguments import check_flag, check_text, check_vector, shown
from twoloop.problem.compiled_functions import GeneratedCode, GeneratedEnergy
from twoloop.problem.problem import Problem
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.projection import consistent_state
from twoloop.symbolic.expressions import (
    POSITIONS,
    VELOCITIES,
    ZERO,
    Equations,
    Reader,
    as_column,
    as_list,
    as_matrix,
    as_number,
    time_derivatives,
    velocity_coefficients,
)


@dataclass(frozen=True)
class SymbolicMechanism:
    """A mechanism generated from SymPy expressions.

    It contains no expressions, so it can be pickled.

    Attributes
    ----------
    name : str
    coordinates : tuple of str (n_q,)
        Names of the coordinates.
    n_c, n_a : int
        Numbers of position constraints and of non-holonomic constraints.
    parameters : mapping
        Values by name, in the order of `p`.
    code : GeneratedCode
        The callbacks and the energy; `code.source` is the generated source.

    Examples
    --------
    >>> import sympy as sp
    >>> from twoloop.symbolic import from_lagrangian
    >>> t, m, g = sp.symbols("t m g")
    >>> x, y = (sp.Function(name)(t) for name in "xy")
    >>> T = m * (x.diff(t) ** 2 + y.diff(t) ** 2) / 2
    >>> rows, numbers = [x**2 + y**2 - 1], {m: 1.0, g: 9.81}
    >>> pendulum = from_lagrangian(T, m * g * y, rows, [x, y], parameters=numbers, name="pendulum")
    >>> pendulum.coordinates, pendulum.n_c
    (('x', 'y'), 1)
    """

    name: str
    coordinates: tuple[str, ...]
    n_c: int
    n_a: int
    parameters: Mapping[str, float]
    code: GeneratedCode

    @cached_property
    def system(self) -> ConstrainedSystem:
        """The compiled system. Compilation takes seconds for new equations, see docs/your_mechanism.md."""
        callbacks: dict[str, Any] = {kind: self.code.callback(kind) for kind in self.code.kinds}
        return ConstrainedSystem(
            n_q=len(self.coordinates),
            n_c=self.n_c,
            n_a=self.n_a,
            parameters=self._vector,
            constant_mass=self.code.value("CONSTANT_MASS"),
            bandwidth=self.code.value("BANDWIDTH"),
            name=self.name,
            **callbacks,
        )

    @property
    def energy(self) -> GeneratedEnergy:
        """energy(t, q, v), J, for one state or for many given as columns."""
        return GeneratedEnergy(self.code, self._vector)

    @property
    def conserved(self) -> bool:
        """True if the energy is an invariant."""
        return bool(self.code.value("CONSERVED"))

    @property
    def _vector(self) -> tuple[float, ...]:
        return tuple(self.parameters.values())

    def with_parameters(self, parameters: Mapping[Any, Any]) -> "SymbolicMechanism":
        """Return the same equations with other values of some parameters, without recompilation.

        Parameters
        ----------
        parameters : mapping
            Values by symbol or name.

        Raises
        ------
        TypeError, ValueError
            If a parameter is unknown or its value is not a finite number.
        """
        if not isinstance(parameters, Mapping):
            raise TypeError(f"parameters must map symbols to numbers; given {shown(parameters)}")
        values = {str(symbol): as_number(f"parameters[{symbol}]", value) for symbol, value in parameters.items()}
        unknown = [name for name in values if name not in self.parameters]
        if unknown:
            raise ValueError(f"parameters must be of {', '.join(self.parameters) or 'none'}; given {unknown[0]}")
        return replace(self, parameters={**self.parameters, **values})

    def problem(
        self,
        q0: ArrayLike | Mapping[Any, float],
        v0: ArrayLike | Mapping[Any, float],
        t_span: tuple[float, float],
        *,
        keep: Sequence[Any] = (),
        note: str = "",
    ) -> Problem:
        """Return the mechanism with an initial state, which `consistent_state` projects onto the constraints.

        Parameters
        ----------
        q0, v0 : array_like (n_q,) or mapping
            Initial positions and velocities. A mapping has coordinates or their names as keys; the initial guess of
            missing ones is 0.
        t_span : (float, float)
            Start and end, s.
        keep : sequence
            Coordinates, or their names, whose values and velocities must not change.
        note : str
            Remarks on assumptions.

        Raises
        ------
        TypeError, ValueError
            If a coordinate is unknown, or no consistent state is found.
        """
        start, end = check_vector("t_span", t_span, 2).tolist()
        indices = [self._index("keep", coordinate) for coordinate in keep]
        q, v = self._state("q0", q0), self._state("v0", v0)
        q, v = consistent_state(self.system, start, q, v, keep=indices or None)
        return Problem(
            name=self.name,
            system=self.system,
            q0=q,
            v0=v,
            t_span=(start, end),
            energy=self.energy,
            parameters=dict(self.parameters),
            note=note,
            conserved=self.conserved,
            coordinates=self.coordinates,
        )

    def _state(self, argument: str, given: Any) -> Any:
        if not isinstance(given, Mapping):
            return given
        state = np.zeros(len(self.coordinates))
        for coordinate, value in given.items():
            state[self._index(argument, coordinate)] = as_number(f"{argument}[{coordinate}]", value)
        return state

    def _index(self, argument: str, coordinate: Any) -> int:
        name = coordinate if isinstance(coordinate, str) else str(getattr(coordinate, "func", coordinate))
        if name not in self.coordinates:
            raise ValueError(f"{argument} must name coordinates, {', '.join(self.coordinates)}; given {coordinate}")
        return self.coordinates.index(name)


def build_mechanism(
    reader: Reader,
    given: Sequence[Any],
    derive: Callable[[], Equations],
    *,
    rows: tuple[int, int],
    tangents: bool,
    name: str,
) -> SymbolicMechanism:
    """Return the mechanism of equations, which are derived unless their code is in the cache.

    `given` contains everything that determines the equations, in plain symbols; `rows` is (n_c, n_a).
    """
    check_text("name", name)
    key = _digest([*given, check_flag("tangents", tangents), len(reader.q), len(reader.p)])
    code = GeneratedCode.stored(key) or GeneratedCode(key, derive().source(tangents))
    return SymbolicMechanism(name, reader.names, *rows, reader.values, code)


def _digest(given: Any) -> str:
    digests: dict[Basic, bytes] = {}

    def digest(item: Any) -> bytes:
        """Return the digest of an expression from those of its subexpressions, each computed once."""
        if isinstance(item, (list, tuple)):
            return hashlib.sha256(b"list" + b"".join(map(digest, item))).digest()
        if not isinstance(item, Basic):
            return hashlib.sha256(repr(item).encode()).digest()
        if item not in digests:
            text = type(item).__name__ if item.args else sympy.srepr(item)
            digests[item] = hashlib.sha256(text.encode() + b"".join(map(digest, item.args))).digest()
        return digests[item]

    return hashlib.sha256(_version() + digest(given)).hexdigest()[:32]


@cache
def _version() -> bytes:
    """Return a digest of the versions of this package and SymPy."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(sympy.__version__.encode() + b"".join(file.read_bytes() for file in files)).digest()


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
        without. No effect with `nonholonomic`.
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
    dissipated = x.read("dissipation", dissipation, VELOCITIES)
    F = _forces(x, forces, coordinates)
    C, W = read_rows(x, constraints, nonholonomic)

    def derive() -> Equations:
        d, n = x.differentiation, len(x.q)
        momenta = [d.derivative(kinetic, v) for v in x.v]
        M, rate = velocity_coefficients("dT/dv", momenta, x), time_derivatives(momenta, x)
        inertia = [d.derivative(kinetic - potential, x.q[i]) - rate[i] for i in range(n)]
        Q = [inertia[i] - d.derivative(dissipated, x.v[i]) + F[i] for i in range(n)]
        mass = sympy.ImmutableMatrix(n, n, lambda i, j: M.get((i, j), ZERO))
        at_rest = dict.fromkeys(x.v, ZERO)
        steady = not any(expression.has(x.t) for expression in (kinetic, potential, *C, *W))
        homogeneous = all(expression.xreplace(at_rest) == 0 for expression in (kinetic, *momenta, *W))
        conserved = steady and homogeneous and dissipated == 0 and not any(F)
        return Equations(x, mass, Q, C, W, kinetic + potential, conserved)

    given = ["Lagrange", kinetic, potential, dissipated, F, C, W]
    return build_mechanism(x, given, derive, rows=(len(C), len(W)), tangents=tangents, name=name)


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
    velocity_coefficients("nonholonomic", W, x)
    return C, W


def _forces(x: Reader, forces: Any, coordinates: Sequence[Any]) -> list[Expr]:
    n = len(x.q)
    if isinstance(forces, Mapping):
        unknown = [coordinate for coordinate in forces if coordinate not in list(coordinates)]
        if unknown:
            raise ValueError(f"forces must be for coordinates, {', '.join(x.names)}; given one for {unknown[0]}")
        return [x.read(f"forces[{coordinate}]", forces.get(coordinate, 0), VELOCITIES) for coordinate in coordinates]
    entries = [0] * n if forces is None else as_column("forces", forces, n, "coordinate")
    return x.read_all("forces", entries, VELOCITIES)


TOLERANCE = 1e-9  # relative tolerance of equality
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
    mass = as_matrix("M", M, n)
    entries = [x.read(f"M[{k // n}, {k % n}]", entry, POSITIONS) for k, entry in enumerate(mass)]
    mass = sympy.ImmutableMatrix(n, n, entries)
    _check_symmetric(mass)
    force = x.read_all("Q", as_column("Q", as_list("Q", Q), n, "row of M"), VELOCITIES)
    C, W = read_rows(x, constraints, nonholonomic)
    u = x.v if speeds is None else list(x.speeds.values())
    K = velocity_coefficients("speeds", u, x)
    V = x.read("potential", potential, POSITIONS)

    def derive() -> Equations:
        transform = sympy.ImmutableMatrix(n, len(x.q), lambda i, j: K.get((i, j), ZERO))
        speed = transform * sympy.ImmutableMatrix(x.v)
        terms = (speed[i] * mass[i, j] * speed[j] for i in range(n) for j in range(n))
        energy = sympy.Rational(1, 2) * sympy.Add(*terms) + V
        if speeds is None:
            M_of_q, Q_of_q = mass, force
        else:
            M_of_q = transform.T * mass * transform
            bias = mass * sympy.ImmutableMatrix(time_derivatives(u, x))
            Q_of_q = list(transform.T * (sympy.ImmutableMatrix(force) - bias))
        return Equations(x, M_of_q, Q_of_q, C, W, energy, _conserved(x, Q_of_q, [*C, *W], energy))

    given = ["matrices", list(mass), force, u, C, W, V]
    return build_mechanism(x, given, derive, rows=(len(C), len(W)), tangents=tangents, name=name)


def _conserved(x: Reader, Q: Sequence[Expr], rows: Sequence[Expr], energy: Expr) -> bool:
    """Return True if the energy is conserved: the forces balance its change, and no constraint moves."""
    at_rest = dict.fromkeys(x.v, ZERO)
    moving = any(row.has(x.t) or (row.xreplace(at_rest) != 0 and row.free_symbols & set(x.v)) for row in rows)
    return not moving and _sum_is_zero([*(v * q for v, q in zip(x.v, Q, strict=True)), *time_derivatives([energy], x)])


def _check_symmetric(M: sympy.MatrixBase) -> None:
    for i in range(M.rows):
        for j in range(i):
            a, b = M[i, j], M[j, i]
            if a != b and not _sum_is_zero([a, -b]):
                raise ValueError(f"M must be symmetric; given {a} in row {i}, column {j}, and {b} across the diagonal")


def _sum_is_zero(terms: Sequence[Expr]) -> bool:
    """Return True if terms sum to zero at a few points, since equal expressions may have different forms."""
    symbols = sorted(set().union(*(term.free_symbols for term in terms)), key=str)
    for probe in range(PROBES):
        point = {symbol: Float(0.3 + (0.618034 * (k + 1) * (probe + 1)) % 1.0) for k, symbol in enumerate(symbols)}
        values = [complex(term.xreplace(point)) for term in terms]
        if not abs(sum(values)) <= TOLERANCE * sum(map(abs, values)):
            return False
    return True


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
        method_rows = method.holonomic_constraints, method.nonholonomic_constraints
        method = _tree(method)
    elif isinstance(method, LagrangesMethod):
        if method.eom is None:
            method.form_lagranges_equations()
        n_c = len(method._hol_coneqs)
        method_rows = list(method._hol_coneqs), list(method.coneqs)[n_c:]
    elif isinstance(method, KanesMethod):
        method_rows = (), ()
    else:
        raise TypeError(f"method must be a LagrangesMethod, a KanesMethod or a System; given {method!r}")
    n, speeds = len(method.q), _speeds(method) if isinstance(method, KanesMethod) else None
    return from_matrices(
        method.mass_matrix[:, :n],
        method.forcing,
        [*method_rows[0], *as_list("constraints", constraints)],
        list(method.q),
        speeds=speeds,
        nonholonomic=[*method_rows[1], *as_list("nonholonomic", nonholonomic)],
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
    velocities = sympy.Matrix([coordinate.diff(sympy.physics.mechanics.dynamicsymbols._t) for coordinate in q])
    solved = by_u.LUsolve(kane.mass_matrix_kin * velocities - rest)
    return dict(zip(u, solved, strict=True))
