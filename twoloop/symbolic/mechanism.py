"""`SymbolicMechanism`, the return value of the constructors: generated code with its parameter values."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import sympy
from numpy.typing import ArrayLike
from sympy import Basic

from twoloop.checks.arguments import check_flag, check_text, check_vector, shown
from twoloop.problem.compiled_functions import GeneratedCode, GeneratedEnergy
from twoloop.problem.problem import Problem
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.projection import consistent_state
from twoloop.symbolic.equations import Equations
from twoloop.symbolic.reading import Reader, number


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
        values = {str(symbol): number(f"parameters[{symbol}]", value) for symbol, value in parameters.items()}
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
        places = [self._place("keep", each) for each in keep]
        q, v = self._state("q0", q0), self._state("v0", v0)
        q, v = consistent_state(self.system, start, q, v, keep=places or None)
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
            state[self._place(argument, coordinate)] = number(f"{argument}[{coordinate}]", value)
        return state

    def _place(self, argument: str, coordinate: Any) -> int:
        name = coordinate if isinstance(coordinate, str) else str(getattr(coordinate, "func", coordinate))
        if name not in self.coordinates:
            raise ValueError(f"{argument} must name coordinates, {', '.join(self.coordinates)}; given {coordinate}")
        return self.coordinates.index(name)


def made(
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
    known: dict[Basic, bytes] = {}

    def of(each: Any) -> bytes:
        """Return the digest of an expression from those of its subexpressions, each computed once."""
        if isinstance(each, (list, tuple)):
            return hashlib.sha256(b"list" + b"".join(map(of, each))).digest()
        if not isinstance(each, Basic):
            return hashlib.sha256(repr(each).encode()).digest()
        if each not in known:
            text = type(each).__name__ if each.args else sympy.srepr(each)
            known[each] = hashlib.sha256(text.encode() + b"".join(map(of, each.args))).digest()
        return known[each]

    return hashlib.sha256(_version() + of(given)).hexdigest()[:32]


@cache
def _version() -> bytes:
    """Return a digest of the versions of this package and SymPy."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(sympy.__version__.encode() + b"".join(file.read_bytes() for file in files)).digest()
