"""The system of a model: compiled callbacks that read its tables, or Python ones where its forces cannot be traced."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.functions import Function, Law, with_arguments
from twoloop.bodies.loaded_friction import LoadedFriction
from twoloop.bodies.parts import COINCIDE
from twoloop.bodies.places import placed
from twoloop.bodies.row_function import RowFunction
from twoloop.bodies.tables import Tables
from twoloop.checks.arguments import Array, shown
from twoloop.generate.graph import Untraceable
from twoloop.generate.program import AGREES, BETWEEN, STATES
from twoloop.problem.callbacks import LARGE
from twoloop.problem.description import Joint
from twoloop.problem.system import ConstrainedSystem

KINDS = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")
OF_JOINTS = ("constraint", "jacobian", "gamma")
QUIET = np.errstate(divide="ignore", invalid="ignore")  # reported by name later


def joints_of(tables: Tables) -> list[Joint]:
    """Return the joints of the system, for `Result.reactions`."""
    made = []
    for joint in tables.joints:
        point = tables.of(joint.point_a if joint.body is joint.a else joint.point_b).tolist()
        translation, rotation = joint.body.coordinates[: len(point)], joint.body.coordinates[len(point) :]
        made.append(Joint(joint.name, tables.rows[joint.name], translation, rotation, tuple(point)))
    return made


def system_of(
    dimension: int, tables: Tables, joints: list[Joint], name: str, start: tuple[float, Array, Array]
) -> ConstrainedSystem:
    """Return the system, after a check of its traced programs against the functions near the start."""
    callbacks: Any = import_module(f"twoloop.bodies.{'planar' if dimension == 2 else 'spatial'}_callbacks")
    n_q = (3 if dimension == 2 else 7) * len(tables.bodies)
    kinds = [kind for kind in KINDS if kind in ("mass", "force") or (kind in OF_JOINTS and tables.n_rows)]
    kinds += ["nonholonomic", "nonholonomic_gamma"] if tables.n_rates else []
    if any(isinstance(motion, Function) for motion in tables.motions):
        kinds.append("constraint_rate")
    options: Any = {
        "n_q": n_q,
        "n_c": tables.n_rows,
        "n_a": tables.n_rates,
        "joints": joints,
        "name": name,
        "parameters": tables.p,
    }
    _check_functions(tables, *start)
    if not tables.untraced:
        tables.untraced = _disagreement(tables, *start)
    if tables.loaded and not tables.untraced:
        tables.untraced = "friction in proportion to loads needs the forces in the joints"
    if tables.untraced:
        made = InPython(callbacks, tables, n_q)
        if tables.loaded:
            made.loaded = LoadedFriction(callbacks, tables, made.redundant(*start))
        return ConstrainedSystem.from_python(**options, **{kind: getattr(made, kind) for kind in kinds})
    kinds += ["kinematics"] if tables.n_rows and dimension == 2 else []
    if n_q >= LARGE and tables.n_rows:
        kinds += ["mass_values", "jacobian_values"]
        options |= {f"{kind}_entries": found for kind, found in entries_of(dimension, tables).items()}
    given = {kind: _callback(dimension, kind, tables) for kind in kinds}
    return ConstrainedSystem(**options, constant_mass=dimension == 2, **given)


def _callback(dimension: int, kind: str, tables: Tables) -> Any:
    """Return the callback of a kind, from the module of those that evaluate programs if it needs one."""
    if kind == "force" and any(isinstance(each, Law) for each in tables.functions):
        return _laws(dimension).force_of_laws
    programmed = tables.functions if kind == "force" else tables.motions
    name = "programs" if programmed and kind not in ("mass", "mass_values") else "callbacks"
    return getattr(import_module(f"twoloop.bodies.{'planar' if dimension == 2 else 'spatial'}_{name}"), kind)


def _laws(dimension: int) -> Any:
    return import_module(f"twoloop.bodies.{'planar' if dimension == 2 else 'spatial'}_laws")


def _with_stretches(tables: Tables, q: Array, v: Array, p: Array) -> tuple[Array, Array]:
    """Return q and v, followed by the lengths and rates of springs if the forces of some are functions of these."""
    n_laws = sum(isinstance(each, Law) for each in tables.functions)
    if not n_laws:
        return q, v
    one, other = np.zeros((2, len(q) + n_laws))
    _laws(len(tables.gravity)).fill_stretches(q, v, p, one, other)
    return one, other


def entries_of(dimension: int, tables: Tables) -> dict[str, NDArray[np.int64]]:
    """Return rows and columns of the entries of the callbacks `mass_values` and `jacobian_values`, in order."""
    width, n = (3 if dimension == 2 else 7), len(tables.bodies)
    blocks = [[k] for k in range(3)] + ([[3, 4, 5, 6]] if dimension == 3 else [])
    places = [(width * k + i, width * k + j) for k in range(n) for block in blocks for i in block for j in block]
    named = [(k, 7 * k + j) for k in range(n) for j in range(3, 7)] if dimension == 3 else []
    turn_alone = (layout.ANGLE,) if dimension == 2 else (layout.PERPENDICULAR, layout.TURN)
    row = len(named) // 4
    for part in (part for joint in tables.joints for part in joint.rows if part.kind != layout.RATE):
        skipped = dimension if part.kind in turn_alone else 0
        columns: Any = (*part.first.coordinates[skipped:], *part.second.coordinates[skipped:])
        if isinstance(part.motion, RowFunction):
            columns = part.motion.columns
        named += [(row + k, j) for k in range(part.n_rows) for j in columns]
        row += part.n_rows
    return {"mass": np.array(places).T, "jacobian": np.array(named).T}


@QUIET
def _check_functions(tables: Tables, t: float, q: Array, v: Array) -> None:
    stretched = _with_stretches(tables, q, v, tables.p)
    for each, one, other in with_arguments([*tables.motions, *tables.functions], len(q), *stretched):
        value = each.at(t, one, other)  # raises if the result has a wrong shape or type
        if each in tables.motions or not np.isfinite(tables.p).all():
            _check_finite(each, value, t)


@QUIET
def check_forces(tables: Tables, t: float, q: Array, v: Array) -> None:
    """Raise if a force is undefined at the start."""
    for force in tables.forces:
        if force.kind != layout.SPRING:
            continue
        assert force.on_first is not None and force.on_second is not None
        one = placed(q, force.first, tables.of(force.on_first))
        two = placed(q, force.second, tables.of(force.on_second))
        length = () if force.more is None else tables.of(force.more)[2:]
        if np.abs(np.subtract(one, two)).max() <= COINCIDE * np.abs((*one, *two, *length)).max():
            raise ValueError(
                f"the points of the spring {force.name!r} coincide at the start, where it has no direction; give it "
                "other points, or length=0 for a pull in proportion to their distance"
            )
    for each, some, rates in with_arguments(tables.functions, len(q), *_with_stretches(tables, q, v, tables.p)):
        _check_finite(each, each.at(t, some, rates), t)


def check_loads(tables: Tables, redundant: tuple[tuple[str, ...], ...], Q: Array) -> None:
    """Raise if friction depends on an undetermined load, or is undefined at the start."""
    if tables.loaded and not np.isfinite(Q).all():
        raise ValueError(
            f"{', '.join(repr(each.name) for each in tables.loaded)} cannot be computed at the start: the coefficients "
            "are so large that a joint may jam; give smaller ones"
        )
    for force in tables.loaded:
        group = next((each for each in redundant if force.joint is not None and force.joint.name in each), ())
        if group:
            raise ValueError(
                f"{force.name!r} depends on the load of its joint, which is not determined: the rows of "
                f"{', '.join(map(repr, group))} are dependent. Use joints with more freedom, or no coefficient"
            )


def _check_finite(function: Function | RowFunction, value: Array, t: float) -> None:
    if not np.isfinite(value).all():
        raise ValueError(
            f"{function.name} must be finite at the start; at t = {t:g} it gives {shown(value)}. Look for divisions by "
            "zero, and for roots and logarithms of non-positive numbers; or start elsewhere"
        )


@QUIET
def _disagreement(tables: Tables, t: float, q: Array, v: Array) -> str:
    """Return a message that names the function whose program gives other values; "" if all agree."""
    from twoloop.bodies.program_results import results  # compiled on import

    head, p = tables.p[tables.p.size - layout.HEAD :], tables.p
    generic = np.random.default_rng(8)
    for functions, place in (
        (tables.motions, head[layout.MOTION_PROGRAM]),
        (tables.functions, head[layout.FORCE_PROGRAM]),
    ):
        for number in range(STATES if functions else 0):
            away = generic.uniform(-1.0, 1.0, (2, len(q))) * (number > 0)
            then = t + BETWEEN * number
            one, other = q + 0.3 * away[0], v + away[1]
            stretched = _with_stretches(tables, one, other, p) if functions is tables.functions else (one, other)
            made, first = results(int(place), then, *stretched, p), 0
            for each, some, rates in with_arguments(functions, len(q), *stretched):
                try:
                    known = each.at(then, some, rates)
                except (ArithmeticError, TypeError):  # outside the domain of the function
                    known = np.full(each.n_results, np.nan)
                size = each.n_results
                found, first = made[first : first + len(known)], first + size
                off = np.abs(known - found) > AGREES * (1.0 + np.abs(known))
                if (off & np.isfinite(known)).any():
                    return f"{each.name} does not give at t = {then:g} what it gave when it was traced"
    return ""


class InPython:
    """Callbacks of a model whose functions are called in Python; the compiled ones evaluate the tables.

    Parameters
    ----------
    callbacks : module
    tables : Tables
    n_q : int
    """

    def __init__(self, callbacks: Any, tables: Tables, n_q: int):
        self._callbacks, self.p = callbacks, tables.p
        self._motions, self._tables = tuple(tables.motions), tables
        self._n_q, self._n_rows, self._n_rates = n_q, tables.n_rows, tables.n_rates
        self._untraced = tables.untraced
        self.loaded: LoadedFriction | None = None

    def redundant(self, t: float, q: Array, v: Array) -> bool:
        """Return True if constraint rows are linearly dependent at a state."""
        rows = self._rows(t, q, self.p)
        return int(np.linalg.matrix_rank(rows)) < len(rows)

    def _rows(self, t: float, q: Array, p: Array) -> Array:
        rates = self.nonholonomic(t, q, p) if self._n_rates else np.zeros((0, self._n_q))
        return np.vstack([self.jacobian(t, q, p), rates])

    def mass(self, t: float, q: Array, p: Array) -> Array:
        """Evaluate M."""
        return self._filled("mass", (self._n_q, self._n_q), q, lambda: (t, q, p))

    def force(self, t: float, q: Array, v: Array, p: Array) -> Array:
        """Evaluate Q."""
        made = self._filled("fill_force", (self._n_q,), q, lambda: (q, v, p, self._forces(t, q, v, p)))
        if self.loaded is not None:
            rates = self.nonholonomic_gamma(t, q, v, p) if self._n_rates else np.zeros(0)
            gamma = np.append(self.gamma(t, q, v, p), rates)
            made += self.loaded.of(q, v, p, made, self.mass(t, q, p), self._rows(t, q, p), gamma)
        return made

    def constraint(self, t: float, q: Array, p: Array) -> Array:
        """Evaluate C."""
        return self._filled("fill_constraint", (self._n_rows,), q, lambda: (q, p, self._moved(t, q, q)))

    def jacobian(self, t: float, q: Array, p: Array) -> Array:
        """Evaluate C_q."""
        return self._filled("fill_jacobian", (self._n_rows, self._n_q), q, lambda: (q, p, self._moved(t, q, q)))

    def constraint_rate(self, t: float, q: Array, p: Array) -> Array:
        """Evaluate C_t."""
        return self._filled("fill_rate", (self._n_rows,), q, lambda: (q, p, self._moved(t, q, q)))

    def gamma(self, t: float, q: Array, v: Array, p: Array) -> Array:
        """Evaluate the right-hand side of C_q a = gamma."""
        return self._filled("fill_gamma", (self._n_rows,), q, lambda: (q, v, p, self._moved(t, q, v)))

    def nonholonomic(self, t: float, q: Array, p: Array) -> Array:
        """Evaluate A."""
        return self._filled("fill_nonholonomic", (self._n_rates, self._n_q), q, lambda: (p, self._moved(t, q, q)))

    def nonholonomic_gamma(self, t: float, q: Array, v: Array, p: Array) -> Array:
        """Evaluate the right-hand side of A a = Q_a."""
        return self._filled("fill_nonholonomic_gamma", (self._n_rates,), q, lambda: (p, self._moved(t, q, v)))

    def _filled(self, fill: str, shape: tuple[int, ...], q: Array, given: Callable[[], tuple[Any, ...]]) -> Array:
        if q.dtype == object:  # symbols: the compiled callbacks would raise a less helpful error
            raise Untraceable(self._untraced)
        made = np.zeros(shape)
        getattr(self._callbacks, fill)(*given(), made)
        return made

    def _moved(self, t: float, q: Array, v: Array) -> Array:
        return np.concatenate([np.zeros(0), *(each.at(t, q, v) for each in self._motions)])

    def _forces(self, t: float, q: Array, v: Array, p: Array) -> Array:
        functions = self._tables.functions
        called = with_arguments(functions, len(q), *_with_stretches(self._tables, q, v, p))
        return np.concatenate([np.zeros(0), *(each.at(t, one, other) for each, one, other in called)])
