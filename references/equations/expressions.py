"""The equations of a compiled mechanism as expressions of another package, for solvers that take nothing else.

The callbacks are Python functions that numba compiled. Here they run in Python on symbols instead of numbers:
arithmetic makes expressions, `math.sin` and its kin become those of the package. Eq. (6), M a + C_q^T lam = Q and
C_q a = Q_d, is then eliminated symbolically, without what is zero by its structure, in an order of little fill.
"""

import builtins
import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from types import CellType, FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from references.driver import check_system
from references.equations.duals import Dual, functions_on_duals
from references.equations.redundant_rows import independent_rows
from twoloop.generate.traced_equations import Equations
from twoloop.generate.traced_values import Traced
from twoloop.generate.tracing import Untraceable
from twoloop.kernels.data.common import GAMMA_GIVEN
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]
Functions = Mapping[str, Callable[[Any], Any]]  # those of FUNCTIONS that the package has, by name

FUNCTIONS = ("sin", "cos", "tan", "sqrt", "exp", "log", "sinh", "cosh", "tanh", "asin", "acos", "atan")

SAMPLES = 4  # states, displaced from the start, at which an entry that is zero is zero by its structure
DISPLACED = 0.3


class NotSymbolic(ValueError):
    """Raised for a system whose equations cannot be had as expressions; the text says why."""


class Expressions:
    """The equations of one system, as functions of symbols.

    Parameters
    ----------
    system : ConstrainedSystem
        Of compiled callbacks that do not branch on q or v.
    t0 : float
    q0, v0 : ndarray (n_q,)
        A consistent state, about which zeros are looked for and at which redundant rows are.

    Raises
    ------
    NotSymbolic
        If the callbacks are Python functions, Q_d is not given, they branch on t, q or v or give near the start what
        their operations do not give, or the mass stays singular with rows of C_q added.
    """

    def __init__(self, system: ConstrainedSystem, t0: float, q0: Array, v0: Array):
        check_system(system)
        if system.called_in_python:
            raise NotSymbolic(f"the callbacks of {system.name!r} are Python functions, not compiled ones")
        if system.n_c and not system.functions.flags[GAMMA_GIVEN]:
            raise NotSymbolic(f"{system.name!r} does not give Q_d (gamma)")
        self.system = system
        self._check(t0, q0, v0)
        samples = _samples(system, t0, q0)
        self.rows = list(independent_rows(samples[0][1]))
        self.mass_pattern = np.any([M != 0.0 for M, _ in samples], axis=0)
        self.jacobian_pattern = np.any([C[self.rows] != 0.0 for _, C in samples], axis=0)
        self.added = _rows_for_mass(samples[0][0], samples[0][1][self.rows])
        self.pattern = self._matrix_pattern()
        self.order = _order(self.pattern, system.n_q)

    def _check(self, t0: float, q0: Array, v0: Array) -> None:
        """See that what the callbacks do with symbols is what they do with numbers."""
        equations = Equations(self.system)
        try:
            for name, *_ in _kinds(self.system.n_q, self.system.n_c, equations.q, equations.v):
                equations.of(name)
            Traced(self.system, equations.graph).refuse(self.system, t0, t0 + 1.0, q0, v0)
        except Untraceable as error:
            raise NotSymbolic(str(error)) from error

    def _matrix_pattern(self) -> NDArray[np.bool_]:
        n, m = self.system.n_q, len(self.rows)
        pattern = np.zeros((n + m, n + m), dtype=bool)
        pattern[:n, :n] = self.mass_pattern | np.eye(n, dtype=bool)
        for k in self.added:
            pattern[:n, :n] |= np.outer(self.jacobian_pattern[k], self.jacobian_pattern[k])
        pattern[n:, :n] = self.jacobian_pattern
        pattern[:n, n:] = self.jacobian_pattern.T
        return pattern

    def equations(
        self, functions: Functions, t: Any, q: Sequence[Any], v: Sequence[Any], parameters: Sequence[Any] | None = None
    ) -> SimpleNamespace:
        """M, Q, C, C_q, C_t and Q_d as arrays of expressions; what is zero is the number 0.0.

        `parameters` may be expressions; None: the numbers of the system.
        """
        f, n, m = self.system.functions, self.system.n_q, self.system.n_c
        p = _objects(f.p.tolist() if parameters is None else parameters)
        positions, velocities = _objects(q), _objects(v)
        made = SimpleNamespace()
        for name, shape, state in _kinds(n, m, positions, velocities):
            out = np.full(shape, 0.0, dtype=object)
            if shape[0]:
                try:
                    _traced(getattr(f, name), functions, {})(t, *state, p, out)
                except Exception as error:  # each package has its own for what it cannot do
                    raise NotSymbolic(
                        f"{name} of {self.system.name!r} does not run on symbols; it must not branch on t, q or v, nor "
                        f"call but hypot and {', '.join(functions)} on them: {error}"
                    ) from error
            setattr(made, name, out)
        return made

    def accelerations(
        self, functions: Functions, t: Any, q: Sequence[Any], v: Sequence[Any], parameters: Sequence[Any] | None = None
    ) -> list[Any]:
        """The accelerations (n_q,) of eq. (6) as expressions."""
        made = self.equations(functions, t, q, v, parameters)
        right = self._right(made.jacobian, made.force, made.gamma)
        return _substituted(_factored(self._matrix(made), self.order), right)[: self.system.n_q]

    def derivatives(self, functions: Functions, t: Any, q: Sequence[Any], v: Sequence[Any]) -> list[list[Any]]:
        """The derivatives of the accelerations by each of [q, v], as 2 n_q lists (n_q,) of expressions.

        The matrix of eq. (6) is factorised once: its derivatives times the solution go to the right-hand side.
        """
        n = self.system.n_q
        moving = [Dual(x, {k: 1.0}) for k, x in enumerate([*q, *v])]
        made = self.equations(functions_on_duals(functions), t, moving[:n], moving[n:])
        values = SimpleNamespace(**{name: _parts(of, None) for name, of in vars(made).items()})
        factors = _factored(self._matrix(values), self.order)
        solution = _substituted(factors, self._right(values.jacobian, values.force, values.gamma))
        columns = []
        for k in range(2 * n):
            M, Cq, Q, gamma = (_parts(getattr(made, name), k) for name in ("mass", "jacobian", "force", "gamma"))
            for i, j in np.argwhere(M != 0.0):
                Q[i] = Q[i] - M[i, j] * solution[j]
            for row, multiplier in zip(self.rows, solution[n:], strict=True):
                for j in np.flatnonzero(Cq[row] != 0.0):
                    Q[j] = Q[j] - Cq[row, j] * multiplier
                    gamma[row] = gamma[row] - Cq[row, j] * solution[j]
            columns.append(_substituted(factors, self._right(values.jacobian, Q, gamma))[:n])
        return columns

    def _matrix(self, made: SimpleNamespace) -> dict[tuple[int, int], Any]:
        """The matrix of eq. (6) without what is zero."""
        Cq, n = made.jacobian[self.rows], self.system.n_q
        matrix: dict[tuple[int, int], Any] = {}
        for i, j in np.argwhere(self.mass_pattern):
            matrix[int(i), int(j)] = made.mass[i, j]
        for k in self.added:  # M + C_q^T C_q has the same accelerations
            places = np.flatnonzero(self.jacobian_pattern[k]).tolist()
            for i in places:
                for j in places:
                    term = Cq[k, i] * Cq[k, j]
                    matrix[i, j] = matrix[i, j] + term if (i, j) in matrix else term
        for k, i in np.argwhere(self.jacobian_pattern):
            matrix[n + int(k), int(i)] = matrix[int(i), n + int(k)] = Cq[k, i]
        return matrix

    def _right(self, jacobian: NDArray[Any], force: NDArray[Any], gamma: NDArray[Any]) -> list[Any]:
        """The right-hand side of eq. (6) for that matrix."""
        Cq, gamma = jacobian[self.rows], gamma[self.rows]
        right = [*force]
        for i in range(self.system.n_q):
            for k in self.added:
                if self.jacobian_pattern[k, i]:
                    right[i] = right[i] + Cq[k, i] * gamma[k]
        return [*right, *gamma]


def functions_of(package: Any) -> dict[str, Callable[[Any], Any]]:
    """Those of FUNCTIONS that a package has under these names."""
    return {name: getattr(package, name) for name in FUNCTIONS if hasattr(package, name)}


def _parts(made: NDArray[Any], k: int | None) -> NDArray[Any]:
    """The values of an array of duals and numbers, or their derivatives by the unknown k."""
    parts = np.full(made.shape, 0.0, dtype=object)
    for place, each in np.ndenumerate(made):
        if isinstance(each, Dual):
            parts[place] = each.value if k is None else each.by.get(k, 0.0)
        elif k is None:
            parts[place] = each
    return parts


def _kinds(n: int, m: int, q: Any, v: Any) -> list[tuple[str, tuple[int, ...], tuple[Any, ...]]]:
    """The callbacks that make the equations: name, shape, and what each depends on."""
    return [
        ("mass", (n, n), (q,)),
        ("force", (n,), (q, v)),
        ("constraint", (m,), (q,)),
        ("jacobian", (m, n), (q,)),
        ("constraint_rate", (m,), (q,)),
        ("gamma", (m,), (q, v)),
    ]


def _objects(values: Sequence[Any]) -> NDArray[Any]:
    made = np.empty(len(values), dtype=object)
    for i, value in enumerate(values):
        made[i] = value
    return made


def _samples(system: ConstrainedSystem, t0: float, q0: Array) -> list[tuple[Array, Array]]:
    """M and C_q at the start, and at states displaced at random."""
    rng = np.random.default_rng(0)
    states = [q0, *(q0 + DISPLACED * rng.standard_normal(q0.size) for _ in range(SAMPLES))]
    return [(system.mass(t0, q), system.jacobian(t0, q)) for q in states]


def _rows_for_mass(mass: Array, jacobian: Array) -> list[int]:
    """Rows k for which M + sum C_k^T C_k is positive definite; none where M is."""
    chosen: list[int] = []
    rank = np.linalg.matrix_rank(mass)
    order = np.argsort([np.count_nonzero(row) for row in jacobian], kind="stable")
    for k in order.tolist():
        if rank == mass.shape[0]:
            break
        more = mass + np.outer(jacobian[k], jacobian[k])
        if np.linalg.matrix_rank(more) > rank:
            mass, rank = more, rank + 1
            chosen.append(k)
    if rank < mass.shape[0]:
        raise NotSymbolic("the mass matrix stays singular with the constraints added")
    return chosen


def _order(pattern: NDArray[np.bool_], n: int) -> list[int]:
    """An order of elimination: least degree first, a row of C_q only after all its coordinates.

    The pivots are then those of definite matrices: M, and -C_q M^-1 C_q^T.
    """
    size = pattern.shape[0]
    neighbours = [set(np.flatnonzero(row).tolist()) - {i} for i, row in enumerate(pattern)]
    waits = [sum(j < n for j in neighbours[i]) if i >= n else 0 for i in range(size)]
    own = [[k for k in neighbours[i] if k >= n] if i < n else [] for i in range(size)]
    left, order = set(range(size)), []
    while left:
        i = min((j for j in left if waits[j] == 0), key=lambda j: (len(neighbours[j]), j))
        left.remove(i)
        order.append(i)
        for k in own[i]:
            waits[k] -= 1
        for j in neighbours[i]:
            neighbours[j] |= neighbours[i]
            neighbours[j] -= {i, j}
    return order


def _factored(matrix: dict[tuple[int, int], Any], order: list[int]) -> list[tuple[int, Any, list[tuple[int, Any]]]]:
    """Factors LDL^T, in this order, of a symmetric matrix; entries that are not in `matrix` are zero."""
    rows: list[dict[int, Any]] = [{} for _ in order]
    for (i, j), value in matrix.items():
        rows[i][j] = value
    factors: list[tuple[int, Any, list[tuple[int, Any]]]] = []
    for i in order:
        inverse = 1.0 / rows[i].pop(i)
        column = [(j, value * inverse) for j, value in rows[i].items()]
        for j, multiple in column:
            for k, value in rows[i].items():
                rows[j][k] = rows[j][k] - multiple * value if k in rows[j] else -(multiple * value)
            del rows[j][i]
        factors.append((i, inverse, column))
    return factors


def _substituted(factors: list[tuple[int, Any, list[tuple[int, Any]]]], right: list[Any]) -> list[Any]:
    """The solution of the factorised system."""
    solution: list[Any] = list(right)
    for i, _, column in factors:
        for j, multiple in column:
            solution[j] = solution[j] - multiple * solution[i]
    for i, inverse, column in reversed(factors):
        total = solution[i] * inverse
        for j, multiple in column:
            total = total - multiple * solution[j]
        solution[i] = total
    return solution


def _traced(function: Any, functions: Functions, done: dict[int, Any]) -> Callable[..., Any]:
    """The Python function behind a compiled one, with the mathematics of expressions in its globals."""
    if id(function) in done:
        return done[id(function)]  # type: ignore[no-any-return]
    plain = function.py_func
    names = inspect.getclosurevars(plain)
    scope: dict[str, Any] = {"__builtins__": builtins}

    def on_symbols(value: Any) -> Any:
        if isinstance(value, Dispatcher):
            return _traced(value, functions, done)
        return _Mathematics(value, functions) if isinstance(value, ModuleType) and value in (math, np) else value

    cells = tuple(CellType(on_symbols(names.nonlocals[name])) for name in plain.__code__.co_freevars)
    copy = FunctionType(plain.__code__, scope, plain.__name__, plain.__defaults__, cells)
    done[id(function)] = copy
    scope |= {name: on_symbols(value) for name, value in names.globals.items()}
    return copy


class _Mathematics:
    """Stand in for `math` or `numpy`: their functions on numbers, the package's on expressions."""

    def __init__(self, module: ModuleType, functions: Functions):
        self._module, self._functions = module, functions

    def __getattr__(self, name: str) -> Any:
        if name == "hypot":
            return lambda x, y: self.sqrt(x * x + y * y)
        plain = re.sub("^arc", "a", name)  # as numpy has arctan for atan
        if plain not in self._functions:
            return getattr(self._module, name)
        known, own = getattr(math, plain), self._functions[plain]
        return lambda x: known(x) if isinstance(x, float | int) else own(x)
