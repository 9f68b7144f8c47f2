"""Make the system of a model: compiled callbacks that read its tables, or Python callbacks if tracing fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.bodies import parameter_layout as layout
from twoloop.bodies.frames import point_of, vector_of
from twoloop.bodies.functions import Function, RowFunction, SpringFunction, with_arguments
from twoloop.bodies.parameter_layout import FORCE_WIDTH, FORCES, HEAD, N_FORCES
from twoloop.bodies.parts import COINCIDE, Force
from twoloop.bodies.tables import Tables
from twoloop.checks.arguments import Array, shown
from twoloop.generate.graph import Untraceable
from twoloop.generate.program import MAX_TRACE_DIFFERENCE, N_COMPARED, TIME_SPACING
from twoloop.problem.callbacks import LARGE
from twoloop.problem.description import Joint
from twoloop.problem.system import ConstrainedSystem

STEPS = 50  # largest number of iterations; Newton's method needs three or four
CONVERGED = 1e-14  # relative change of the friction in an iteration that counts as convergence
DEPENDENT = 1e-12  # singular values of the constraint rows below this fraction of the largest count as zero
# comparisons of a traced function with calls are repeated so often at the start: it may change after a number of calls
N_REPEATED = 120


class LoadedFriction:
    """Evaluate friction -c tanh(rate / speed) |F| in joints whose forces F in turn depend on the friction.

    M a + G^T lam = Q + W^T f and G a = gamma give lam = lam_0 + L f. With f = -c |P lam|, where c are the coefficients
    times tanh, the solution is unique if the matrix of the c_k |P_k L_l| has a spectral radius below one, because
    f -> -c |P lam(f)| is then a contraction. Otherwise a joint may jam or several solutions may exist (P. Painlevé,
    Leçons sur le frottement, 1895), and the friction is NaN.

    `redundant`: whether constraint rows that do not belong to these joints may be dependent.
    """

    def __init__(self, callbacks: Any, tables: Tables, redundant: bool):
        self._fill_force, self._loaded, self._redundant = callbacks.fill_force, tables.loaded, redundant
        self._dimension = len(tables.gravity)
        places = [(tables.place(force), len(force.more.values)) for force in tables.loaded if force.more is not None]
        self._numbers = [place + np.arange(size) for place, size in places]
        self._rows = [self._carrying(force, tables) for force in tables.loaded]
        first = int(tables.p[tables.p.size - HEAD + FORCES]) + FORCE_WIDTH * len(tables.forces)
        # rows of the unit motors in the table of forces, after the rows of the forces
        self._units = [first + FORCE_WIDTH * k for k in range(len(self._loaded))]

    def _carrying(self, force: Force, tables: Tables) -> list[int]:
        """Return the rows that carry the load of a joint: the rows of its point, or the rows across its guide."""
        joint = force.joint
        assert joint is not None
        return list(tables.rows[joint.name][: self._dimension - (joint.kind == "prismatic")])

    def of(self, q: Array, v: Array, p: Array, Q: Array, M: Array, G: Array, gamma: Array) -> Array:
        """Return the contribution to Q, (n_q,)."""
        W = np.array([self._along(k, q, p) for k in range(len(self._loaded))])
        # coefficient times radius of the hinge times tanh; the numbers begin with constant friction and speed
        pairs = zip((p[at] for at in self._numbers), W @ v, strict=True)
        c = np.array([own[2:].prod() * np.tanh(rate / own[1]) for own, rate in pairs])
        if not c.any():
            return np.zeros(len(q))
        n, m = len(q), len(G)
        K = np.block([[M, G.T], [G, np.zeros((m, m))]])
        right = np.zeros((n + m, 1 + len(W)))
        right[:n, 0], right[n:, 0], right[:n, 1:] = Q, gamma, W.T
        solution = np.linalg.lstsq(K, right, rcond=DEPENDENT)[0] if self._redundant else np.linalg.solve(K, right)
        loads = [
            self._across(force, q, solution[n + np.array(rows)])
            for force, rows in zip(self._loaded, self._rows, strict=True)
        ]
        return W.T @ _friction(c, loads)

    def _along(self, k: int, q: Array, p: Array) -> Array:
        """Return the generalised force of a unit motor in a joint, i.e. the gradient of its displacement."""
        alone, out = p.copy(), np.zeros(len(q))
        alone[: self._dimension] = 0.0  # gravity
        alone[p.size - HEAD + FORCES], alone[p.size - HEAD + N_FORCES] = self._units[k], 1.0
        self._fill_force(q, np.zeros(len(q)), alone, np.zeros(0), out)
        return out

    def _across(self, force: Force, q: Array, lam: Array) -> Array:
        """Return the components of the force in a spatial hinge across its axis; the thrust causes no friction."""
        joint = force.joint
        assert joint is not None
        if self._dimension == 2 or joint.kind == "prismatic":
            return lam
        axis = np.array(vector_of(q, joint.a.number, joint.axes[0]))
        return np.asarray(lam - np.outer(axis, axis @ lam))


def _friction(c: Array, loads: list[Array]) -> Array:
    """Solve f_k + c_k |x_k + L_k f| = 0, where loads[k] has the columns x_k and L_k; NaN if f may not be unique."""
    n = len(c)
    coupled = np.array([np.abs(c[k]) * np.linalg.norm(loads[k][:, 1:], axis=0) for k in range(n)])
    f = np.zeros(n)
    if not np.isfinite(coupled).all() or np.abs(np.linalg.eigvals(coupled)).max() >= 1.0:
        return np.full(n, np.nan)
    for step in range(STEPS):
        x = [load[:, 0] + load[:, 1:] @ f for load in loads]
        sizes = np.array([np.linalg.norm(each) for each in x])
        new = -c * sizes
        if step < STEPS // 2:  # Newton's method, then fixed-point iteration, which is a contraction
            slopes = np.array(
                [each @ load[:, 1:] / max(size, 1e-300) for each, load, size in zip(x, loads, sizes, strict=True)]
            )
            new = f - np.linalg.solve(np.eye(n) + c[:, None] * slopes, f - new)
        if np.abs(new - f).max() <= CONVERGED * np.abs(new).max():
            return new
        f = new
    return f


ROTORS = layout.HINGE_ROTOR, layout.SLIDE_ROTOR
KINDS = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")
OF_JOINTS = ("constraint", "jacobian", "gamma")
QUIET = np.errstate(divide="ignore", invalid="ignore")  # later errors name the function with such values


def joints_of(tables: Tables) -> list[Joint]:
    """Return the joints of the system, for `Result.reactions`."""
    joints = []
    for joint in tables.joints:
        point = tables.of(joint.point_a if joint.body is joint.a else joint.point_b).tolist()
        translation, rotation = joint.body.coordinates[: len(point)], joint.body.coordinates[len(point) :]
        joints.append(Joint(joint.name, tables.rows[joint.name], translation, rotation, tuple(point)))
    return joints


def system_of(
    dimension: int, tables: Tables, joints: list[Joint], name: str, start: tuple[float, Array, Array]
) -> ConstrainedSystem:
    """Return the system, after a check of its traced programs against the functions near the start."""
    from twoloop.bodies import callbacks  # compiled on import

    n_q = (3 if dimension == 2 else 7) * len(tables.bodies)
    kinds = [kind for kind in KINDS if kind in ("mass", "force") or (kind in OF_JOINTS and tables.n_rows)]
    kinds += ["nonholonomic", "nonholonomic_gamma"] if tables.n_rates else []
    if any(isinstance(motion, Function) for motion in tables.motions):
        kinds.append("constraint_rate")
    options: Any = {"n_q": n_q, "n_c": tables.n_rows, "n_a": tables.n_rates}
    options |= {"joints": joints, "name": name, "parameters": tables.p}
    _check_functions(tables, *start)
    if not tables.untraced:
        tables.untraced = _disagreement(tables, *start)
    if tables.loaded and not tables.untraced:
        tables.untraced = "friction in proportion to loads needs the forces in the joints"
    if tables.untraced:
        in_python = InPython(callbacks, tables, n_q)
        if tables.loaded:
            in_python.loaded = LoadedFriction(callbacks, tables, in_python.redundant(*start))
        options |= {kind: in_python.callback(kind) for kind in kinds}
        return ConstrainedSystem.from_python(**options)
    if n_q < LARGE and tables.n_rows:
        kinds.append("kinematics")  # fills a full matrix
    elif tables.n_rows:
        entries = entries_of(dimension, tables)
        if any(force.kind in ROTORS for force in tables.forces):
            del entries["mass"]  # rotors couple bodies
        kinds += [f"{kind}_values" for kind in entries]
        options |= {f"{kind}_entries": places for kind, places in entries.items()}
    callbacks_by_kind = {kind: _callback(kind, tables) for kind in kinds}
    return ConstrainedSystem(**options, constant_mass=dimension == 2, **callbacks_by_kind)


def _callback(kind: str, tables: Tables) -> Any:
    """Return the callback of a kind, from programs.py if it evaluates a program, else from callbacks.py."""
    from twoloop.bodies import callbacks, programs  # compiled on import

    has_program = kind not in ("mass", "mass_values") and (tables.functions if kind == "force" else tables.motions)
    return getattr(programs if has_program else callbacks, kind)


def _with_spring_lengths(tables: Tables, q: Array, v: Array, p: Array) -> tuple[Array, Array]:
    """Return q and v, followed by lengths and rates of those springs whose forces are functions of them, if any."""
    n_spring_functions = sum(isinstance(each, SpringFunction) for each in tables.functions)
    if not n_spring_functions:
        return q, v
    from twoloop.bodies.forces import fill_spring_lengths  # compiled on import

    extended_q, extended_v = np.zeros((2, len(q) + n_spring_functions))
    fill_spring_lengths(q, v, p, extended_q, extended_v)
    return extended_q, extended_v


def entries_of(dimension: int, tables: Tables) -> dict[str, NDArray[np.int64]]:
    """Return rows and columns of the entries of the callbacks `mass_values` and `jacobian_values`, in order."""
    width, n = (3 if dimension == 2 else 7), len(tables.bodies)
    blocks = [[k] for k in range(3)] + ([[3, 4, 5, 6]] if dimension == 3 else [])
    places = [(width * k + i, width * k + j) for k in range(n) for block in blocks for i in block for j in block]
    named = [(k, 7 * k + j) for k in range(n) for j in range(3, 7)] if dimension == 3 else []
    turn_alone = layout.ANGLE, layout.PERPENDICULAR, layout.ANGLE_DRIVE
    row = len(named) // 4
    for part in (part for joint in tables.joints for part in joint.rows if part.kind != layout.RATE_FUNCTION):
        skipped = dimension if part.kind in turn_alone else 0
        columns: Any = (*part.first.coordinates[skipped:], *part.second.coordinates[skipped:])
        if isinstance(part.motion, RowFunction):
            columns = part.motion.columns
        named += [(row + k, j) for k in range(part.n_rows) for j in columns]
        row += part.n_rows
    return {"mass": np.array(places).T, "jacobian": np.array(named).T}


@QUIET
def _check_functions(tables: Tables, t: float, q: Array, v: Array) -> None:
    extended = _with_spring_lengths(tables, q, v, tables.p)
    for each, q_part, v_part in with_arguments([*tables.motions, *tables.functions], len(q), *extended):
        value = each.at(t, q_part, v_part)  # raises if the result has a wrong shape or type
        if each in tables.motions or not np.isfinite(tables.p).all():
            _check_finite(each, value, t)


@QUIET
def check_forces(tables: Tables, t: float, q: Array, v: Array) -> None:
    """Raise if a force is undefined at the start."""
    for force in tables.forces:
        if force.kind != layout.SPRING:
            continue
        assert force.on_first is not None and force.on_second is not None
        end_a = point_of(q, force.first.number, tables.of(force.on_first))
        end_b = point_of(q, force.second.number, tables.of(force.on_second))
        length = () if force.more is None else tables.of(force.more)[2:]
        if np.abs(np.subtract(end_a, end_b)).max() <= COINCIDE * np.abs((*end_a, *end_b, *length)).max():
            raise ValueError(
                f"the points of the spring {force.name!r} coincide at the start, where it has no direction; give it "
                "other points, or length=0 for a pull in proportion to their distance"
            )
    for each, q_part, v_part in with_arguments(tables.functions, len(q), *_with_spring_lengths(tables, q, v, tables.p)):
        _check_finite(each, each.at(t, q_part, v_part), t)


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
    """Return a message that names a function whose program returns other values; "" if all programs agree."""
    from twoloop.bodies.read_tables import results as evaluate  # compiled on import

    head, p = tables.p[tables.p.size - layout.HEAD :], tables.p
    generic = np.random.default_rng(8)
    for functions, place in (
        (tables.motions, head[layout.MOTION_PROGRAM]),
        (tables.functions, head[layout.FORCE_PROGRAM]),
    ):
        for number in (*range(N_COMPARED), *[0] * N_REPEATED) if functions else ():
            offset = generic.uniform(-1.0, 1.0, (2, len(q))) * (number > 0)
            time = t + TIME_SPACING * number
            near_q, near_v = q + 0.3 * offset[0], v + offset[1]
            extended = (
                _with_spring_lengths(tables, near_q, near_v, p) if functions is tables.functions else (near_q, near_v)
            )
            computed, first = evaluate(int(place), time, *extended, p), 0
            for each, q_part, rates in with_arguments(functions, len(q), *extended):
                try:
                    called = each.at(time, q_part, rates)
                except (ArithmeticError, TypeError):  # outside the domain of the function
                    called = np.full(each.n_results, np.nan)
                size = each.n_results
                traced, first = computed[first : first + len(called)], first + size
                off = np.abs(called - traced) > MAX_TRACE_DIFFERENCE * (1.0 + np.abs(called))
                if (off & np.isfinite(called)).any():
                    return f"{each.name} does not give at t = {time:g} what it gave when it was traced"
    return ""


class InPython:
    """Evaluate the callbacks of a model whose functions are called in Python; compiled callbacks read the tables."""

    def __init__(self, callbacks: Any, tables: Tables, n_q: int):
        from twoloop.bodies.read_tables import fill_nonholonomic, fill_nonholonomic_gamma  # compiled on import

        self._tables = tables
        self.loaded: LoadedFriction | None = None
        n, m, rows = tables.n_rows, tables.n_rates, callbacks.fill_rows
        # per kind: the compiled function, the shape of its values, and how it is called with these
        self._fills: dict[str, tuple[tuple[int, ...], Callable[..., None]]] = {
            "mass": ((n_q, n_q), lambda t, q, v, p, M: callbacks.mass(t, q, p, M)),
            "force": ((n_q,), lambda t, q, v, p, Q: callbacks.fill_force(q, v, p, self._forces(t, q, v, p), Q)),
            "constraint": ((n,), lambda t, q, v, p, C: rows(q, q, p, self._moved(t, q, q), C, None, None, None)),
            "jacobian": ((n, n_q), lambda t, q, v, p, Cq: rows(q, q, p, self._moved(t, q, q), None, Cq, None, None)),
            "constraint_rate": ((n,), lambda t, q, v, p, Ct: rows(q, q, p, self._moved(t, q, q), None, None, Ct, None)),
            "gamma": ((n,), lambda t, q, v, p, Qd: rows(q, v, p, self._moved(t, q, v), None, None, None, Qd)),
            "nonholonomic": ((m, n_q), lambda t, q, v, p, A: fill_nonholonomic(p, self._moved(t, q, q), A)),
            "nonholonomic_gamma": ((m,), lambda t, q, v, p, Qa: fill_nonholonomic_gamma(p, self._moved(t, q, v), Qa)),
        }

    def callback(self, kind: str) -> Callable[..., Array]:
        """Return the callback of a kind."""
        if kind == "force":
            return self._force
        if kind in ("gamma", "nonholonomic_gamma"):
            return lambda t, q, v, p: self._evaluate(kind, t, q, v, p)
        return lambda t, q, p: self._evaluate(kind, t, q, q, p)

    def redundant(self, t: float, q: Array, v: Array) -> bool:
        """Return True if constraint rows are linearly dependent at a state."""
        rows = self._rows(t, q, self._tables.p)
        return int(np.linalg.matrix_rank(rows)) < len(rows)

    def _rows(self, t: float, q: Array, p: Array) -> Array:
        return np.vstack([self._evaluate(kind, t, q, q, p) for kind in ("jacobian", "nonholonomic")])

    def _force(self, t: float, q: Array, v: Array, p: Array) -> Array:
        Q = self._evaluate("force", t, q, v, p)
        if self.loaded is not None:
            gamma = np.concatenate([self._evaluate(kind, t, q, v, p) for kind in ("gamma", "nonholonomic_gamma")])
            Q += self.loaded.of(q, v, p, Q, self._evaluate("mass", t, q, v, p), self._rows(t, q, p), gamma)
        return Q

    def _evaluate(self, kind: str, t: float, q: Array, v: Array, p: Array) -> Array:
        if q.dtype == object:  # symbols: the compiled callbacks would raise a less helpful error
            raise Untraceable(self._tables.untraced)
        shape, fill = self._fills[kind]
        values = np.zeros(shape)
        fill(t, q, v, p, values)
        return values

    def _moved(self, t: float, q: Array, v: Array) -> Array:
        return np.concatenate([np.zeros(0), *(motion.at(t, q, v) for motion in self._tables.motions)])

    def _forces(self, t: float, q: Array, v: Array, p: Array) -> Array:
        functions = self._tables.functions
        called = with_arguments(functions, len(q), *_with_spring_lengths(self._tables, q, v, p))
        return np.concatenate([np.zeros(0), *(each.at(t, q_part, v_part) for each, q_part, v_part in called)])
