"""The check of a start: consistent, of full rank, finite; and what is wrong with a system at a point."""

from __future__ import annotations  # ArrayLike stays a word in help()

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import lapack, null_space

from twoloop.checks.arguments import Array
from twoloop.checks.bounds import check_bounds
from twoloop.checks.derivatives import check_derivatives
from twoloop.checks.rank import eigenvalues, in_words, least_solution, redundant_rows
from twoloop.checks.scales import EPS, Scales, rows_at, scales_of
from twoloop.checks.sparse_rows import Rows, SparseRows, largest_in_rows
from twoloop.checks.values import UNSYMMETRIC, unsymmetric_mass
from twoloop.kernels.compile.callbacks import KINDS
from twoloop.kernels.compile.linking import direct

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem


CONSISTENT = 1e-8  # correction that an initial state may need, relative to the size of the mechanism
SURELY = 0.1  # of that: where no more is needed, there is no doubt
NEARBY = (0.0, 1e-3, 1e-2, 3e-2)  # of the coordinates: where the pattern of C_q is looked at
TIED = 1e-6  # relative: corrections that exceed what is allowed by as much, of which the first is named
ROUNDING = 64.0  # times the spacing of floating-point numbers: what rounding of the state may add to it
SINGULAR_MASS = 1e-12  # smallest eigenvalue over largest entry, below which M may have no inverse
LEAST = np.array([ROUNDING * EPS, UNSYMMETRIC, SINGULAR_MASS])  # as the kernel takes them


class ConstraintWarning(UserWarning):
    """Constraints of a system depend on one another: those left out are checked, and multipliers are not unique."""


def check_start(
    system: ConstrainedSystem,
    t0: float,
    q0: Array,
    v0: Array,
    *,
    derivatives: bool = True,
    exact: Callable[[], bool] | None = None,
) -> None:
    """Call every callback once at the start and check shapes, finiteness, rank, consistency and, if asked, derivatives.

    `exact` says whether derivatives are those of what was traced: then they are not compared with differences.

    Raises
    ------
    TypeError, ValueError
        Naming the callback or the argument, what was found and what to do.
    """
    check_bounds(system, t0, q0, v0)
    system.check_returned(t0, q0, v0)
    if _in_order(system, t0, q0, v0):
        if derivatives:
            check_derivatives(system, t0, q0, exact)
        return
    rows = system.sparse_rows(t0, q0)
    jacobian = rows[: system.n_c]
    reason = not_finite(system, t0, q0, v0)
    if reason is not None:
        raise ValueError(f"at the start, t = {t0:g}, {reason}")
    unsymmetric = unsymmetric_mass(system, t0, q0)
    if unsymmetric is not None:
        raise ValueError(unsymmetric)
    if not is_at_rounding(system.constraint(t0, q0), jacobian, q0):
        full = system.jacobian(t0, q0)
        scales = scales_of(system, t0, q0, full)
        Violation.of_position(system, t0, q0, full, scales).refuse("q0")
    if derivatives:
        check_derivatives(system, t0, q0, exact)
    empty = np.flatnonzero(largest_in_rows(rows) == 0.0).tolist()
    if empty:
        raise ValueError(
            f"row(s) {empty} of the constraint Jacobian of {system.name!r} are zero at t = {t0:g}: they hold nothing "
            "there. Leave these constraints out, or start from another position"
        )
    rate = system.rates(t0, q0)
    if not is_at_rounding(rows @ v0 + rate, rows, v0, rate):
        full = system.rows(t0, q0)
        scales = scales_of(system, t0, q0, full)
        Violation.of_velocity(system, t0, q0, v0, full, scales).refuse("v0")


class Look:
    """Arrays for the look of compiled callbacks at one start after another, and what the last one found.

    Attributes
    ----------
    mass, rows, pattern : ndarray
        M, C_q with A, and 1 where rows have entries there or nearby.
    definite : bool or None
        Whether an M that varies has an inverse; None: that is in doubt, or M is constant.
    """

    def __init__(self, system: ConstrainedSystem):
        from twoloop.kernels.evaluation import first_look
        from twoloop.kernels.evaluation.first_look import look, room_size

        self.flags, self._look = first_look, direct(look)
        n, n_rows, size = system.n_q, system.n_c + system.n_a, room_size(system.n_q, system.n_c, system.n_a)
        self.system, looked = system, np.zeros(size + n * n + 2 * n_rows * n)
        self._room, mass, rows, pattern = np.split(looked, np.cumsum([size, n * n, n_rows * n]))
        self.mass, self.rows, self.pattern = mass.reshape(n, n), rows.reshape(n_rows, n), pattern.reshape(n_rows, n)
        self.arrays = {
            **{"looked": looked, "lam": _ones(system.n_c), "room": self._room, "mass": self.mass, "rows": self.rows},
            **{"ways": _ways(n), "pattern": self.pattern, "least": LEAST},
        }
        self._nothing = _zeros(n)
        self.definite: bool | None = None

    def at(self, t: float, q: Array, v: Array) -> int:
        """Flags of what `first_look` finds at a start."""
        definite, indefinite = self.flags.DEFINITE, self.flags.INDEFINITE
        looked, *arrays = self.arrays.values()
        looked.fill(0.0)
        try:
            found: int = self._look(self.system.kit, t, q, v, self.sizes(), *arrays)
        except Exception:  # of a callback, which is called by itself then
            return 0
        self.definite = bool(found & definite) if found & (definite | indefinite) else None
        return found

    def sizes(self) -> Array:
        """What no coordinate is less than in what counts as rounding: what a start before has shown, or nothing."""
        sizes: Array = self.system.made.get("sizes", self._nothing)
        return sizes

    def is_surely(self, found: int, t: float, q: Array, v: Array) -> bool:
        """Whether `Violation` would accept the state of the last look, which found this, beyond doubt."""
        if found & self.flags.CONSISTENT:
            return True
        n, n_c, n_rows = self.system.n_q, self.system.n_c, len(self.rows)
        force, C, rates = np.split(self._room[: n + n_c + n_rows], (n, n + n_c))
        return _surely_consistent(self.system, t, q, v, self.mass, force, self.rows, C, rates)


def _in_order(system: ConstrainedSystem, t: float, q: Array, v: Array) -> bool:
    """Whether compiled callbacks give nothing at a start that would have to be looked at more closely."""
    if system.called_in_python or system.entries:
        return False
    look = Look(system)
    found = look.at(t, np.ascontiguousarray(q, dtype=np.float64), np.ascontiguousarray(v, dtype=np.float64))
    if not found & look.flags.IN_ORDER:
        return False
    place = (t, q.tobytes())
    system.remember_at("pattern", place, look.pattern)
    system.remember_at("mass and rows", place, (look.mass, look.rows))
    if look.definite is not None:
        system.remember_at("definite mass", _place(system, t, q), look.definite)
    return look.is_surely(found, t, q, v)


def _surely_consistent(
    system: ConstrainedSystem,
    t: float,
    q: Array,
    v: Array,
    mass: Array,
    force: Array,
    rows: Array,
    C: Array,
    rates: Array,
) -> bool:
    """Whether `Violation` would accept a state beyond doubt, without singular values.

    Corrections are the same; they must be less than a share of what is accepted, without what rounding explains, and
    with the least that accelerations M^-1 Q can be.
    """
    scales = scales_of(system, t, q, rows)
    fastest = np.where(rows != 0.0, np.abs(v) / scales.columns, 0.0).max(axis=1)
    speeds = np.maximum(fastest, np.abs(rates) / scales.rows)
    if lapack.dpotrf(mass)[1] == 0:
        pull = float((np.abs(force) / (np.abs(mass) @ scales.columns)).max())
        speeds = np.maximum(speeds, np.sqrt(scales.reach * pull))
    if not _surely_small(rows, rows @ v + rates, scales, speeds):
        return False
    if system.n_a > 0:
        if system.n_c == 0:
            return True
        rows = rows[: system.n_c]
        scales = scales_of(system, t, q, rows)
    consistent = _surely_small(rows, C, scales, scales.reach)
    if consistent:  # how far coordinates move until they matter, at the next start as well, beside what rounding is
        system.made["sizes"] = scales.by_coordinate(scales.reach, rows)
    return consistent


def _surely_small(rows: Array, values: Array, scales: Scales, per_row: Array) -> bool:
    """Whether the correction that values ask for, and what it leaves, are far below what is accepted."""
    found = least_solution(scales.scaled(rows), values / scales.rows)
    if found is None:
        return False
    x, left = found
    allowed = SURELY * CONSISTENT * scales.by_coordinate(per_row, rows)
    small = np.abs(scales.columns * x) <= allowed
    return bool(small.all() and (np.abs(left) <= SURELY * CONSISTENT * per_row).all())


def is_at_rounding(values: Array, rows: Rows, state: Array, rate: Array | float = 0.0) -> bool:
    """Whether values are no more than rounding of their terms, which needs no scales to be accepted.

    For rows by their entries, whose scales take full matrices, of entries as well, as large as the largest of a row.
    """
    if isinstance(rows, SparseRows):
        terms = rows.largest() * (rows.pattern() @ np.abs(state)) + np.abs(rate)
        return bool((np.abs(values) <= ROUNDING * EPS * terms).all())
    return bool((np.abs(values) <= ROUNDING * EPS * (abs(rows) @ np.abs(state) + np.abs(rate))).all())


class Violation:
    """What a state violates, as the change of coordinates (or velocities) that would put it right.

    Attributes
    ----------
    correction : ndarray (n_q,)
        The Newton correction, by least squares with C_q, coordinates weighted by their scales.
    allowed : ndarray (n_q,)
        How much of it is accepted: 1e-8 of the mechanism's size, and rounding.
    left : ndarray (n_c,)
        What the correction leaves, where rows of C_q depend on one another or are zero; `allowed_left` with it.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        t: float,
        equation: str,
        values: Array,
        terms: Array,
        jacobian: Array,
        scales: Scales,
        per_row: Array,
        spacing: Array,
    ):
        self.system, self.t, self.equation, self.values = system, t, equation, values
        scaled = scales.scaled(jacobian)
        inverse = np.linalg.pinv(scaled, rcond=1e-10)
        self.correction = -scales.columns * (inverse @ (values / scales.rows))
        by_rounding = scales.columns * (np.abs(inverse) @ (terms / scales.rows)) + spacing
        self.allowed = CONSISTENT * scales.by_coordinate(per_row, jacobian) + ROUNDING * EPS * by_rounding
        self.left = np.abs(values + jacobian @ self.correction) / scales.rows
        self.allowed_left = CONSISTENT * per_row + ROUNDING * EPS * terms / scales.rows

    @classmethod
    def of_position(cls, system: ConstrainedSystem, t: float, q: Array, jacobian: Array, scales: Scales) -> Violation:
        """C(t, q) at a position."""
        terms = np.abs(jacobian) @ np.abs(q)
        values = system.constraint(t, q)
        return cls(system, t, "C(t, q)", values, terms, jacobian, scales, scales.reach, np.abs(q))

    @classmethod
    def of_velocity(
        cls, system: ConstrainedSystem, t: float, q: Array, v: Array, jacobian: Array, scales: Scales
    ) -> Violation:
        """C_q v + C_t and A v + b, beside what is fast there: velocities, drives, what forces can bring about."""
        rate = system.rates(t, q)
        fastest = np.where(jacobian != 0.0, np.abs(v) / scales.columns, 0.0).max(axis=1)
        mass, force = system.mass(t, q), system.force(t, q, v)
        try:
            np.linalg.cholesky(mass)
            pull = np.linalg.solve(mass, force)
        except np.linalg.LinAlgError:  # no inertia in some directions, which the constraints exclude
            pull = np.linalg.lstsq(mass, force, rcond=1e-12)[0]
        falling = np.sqrt(scales.reach * float(np.abs(pull / scales.columns).max()))
        speeds = np.maximum(np.maximum(fastest, np.abs(rate) / scales.rows), falling)
        terms = np.abs(jacobian) @ np.abs(v) + np.abs(rate)
        equation, values = "C_q v + C_t" if system.n_a == 0 else "(C_q v + C_t, A v + b)", jacobian @ v + rate
        return cls(system, t, equation, values, terms, jacobian, scales, speeds, np.abs(v))

    @property
    def excess(self) -> float:
        """The largest correction over what is accepted; at most 1 where the state is consistent."""
        parts = [(np.abs(self.correction), self.allowed), (self.left, self.allowed_left)]
        return max(float((part[part > 0.0] / allowed[part > 0.0]).max(initial=0.0)) for part, allowed in parts)

    def refuse(self, name: str) -> None:
        """Raise unless the state is consistent."""
        with np.errstate(divide="ignore"):
            excess = self.excess
        if excess <= 1.0:
            return
        row = int(np.abs(self.values).argmax())
        raise ValueError(
            f"{name} is not consistent with the constraints of {self.system.name!r}: max|{self.equation}| is "
            f"{abs(self.values[row]):.3g} (row {row}) at t = {self.t:g}; {self._remedy(name)}"
        )

    def _remedy(self, name: str) -> str:
        excesses = np.abs(self.correction) / np.maximum(self.allowed, 1e-300)
        if excesses.max(initial=0.0) <= 1.0:
            return (
                "no small change puts it right, as rows of C_q are zero there or depend on one another. Take another "
                "guess, and project it with twoloop.consistent_state(system, t, q, v)"
            )
        j = int(np.flatnonzero(excesses >= (1.0 - TIED) * excesses.max())[0])
        of = "coordinate" if name == "q0" else "the velocity of coordinate"
        return (
            f"to put it right {of} {j} has to change by {abs(self.correction[j]):.3g}, and at most "
            f"{self.allowed[j]:.1g} is accepted. Project it with twoloop.consistent_state(system, t, q, v)"
        )


def dependent_rows(system: ConstrainedSystem, t: float, q: Array) -> str:
    """Which rows of C_q(t, q) depend on the others, in words."""
    jacobian = system.rows(t, q)
    rows = redundant_rows(scales_of(system, t, q, jacobian).scaled(jacobian))
    if rows:
        return in_words(jacobian, rows)
    values = np.linalg.svd(jacobian, compute_uv=False)
    return (
        "or so nearly that Newton cannot tell: its smallest singular value at the last state is "
        f"{values[-1] / values[0]:.1g} of the largest"
    )


def least_inertia(system: ConstrainedSystem, t: float, q: Array) -> tuple[float, str]:
    """Smallest over largest eigenvalue of T^T M T, and which coordinates move in the motion that it belongs to."""
    mass, rows = system.mass(t, q), system.rows(t, q)
    free = null_space(rows) if len(rows) > 0 else np.eye(system.n_q)
    if free.shape[1] == 0:
        return 1.0, "the constraints allow no motion"
    energies, motions = np.linalg.eigh(free.T @ mass @ free)
    motion = np.abs(free @ motions[:, 0])
    coordinates = np.flatnonzero(motion > 0.1 * motion.max()).tolist()
    return float(energies[0] / max(energies[-1], np.finfo(np.float64).tiny)), (
        f"a motion of coordinate(s) {coordinates}, which the constraints allow, has next to no inertia, or a negative "
        f"one: the smallest eigenvalue of T^T M T is {energies[0]:.3g}, the largest {energies[-1]:.3g}"
    )


def pattern_of(system: ConstrainedSystem, t: float, q: Array) -> Array:
    """1 where C_q or A has an entry at a position or near it, (n_c + n_a, n_q); not to be written to."""
    return system.remembered_at("pattern", (t, q.tobytes()), lambda: _pattern_of(system, t, q))


def _pattern_of(system: ConstrainedSystem, t: float, q: Array) -> Array:
    size = np.maximum(np.abs(q), np.abs(q).max())
    rows, defined = rows_at(system, t, q + size * _ways(system.n_q))  # what is missed is found on the way
    return (rows[defined] != 0.0).any(axis=0).astype(float)


@cache
def _ones(n: int) -> Array:
    return np.ones(n)


@cache
def _zeros(n: int) -> Array:
    return np.zeros(n)


@cache
def _ways(n_q: int) -> Array:
    """How far positions near one are from it, (len(NEARBY), n_q), over its size: always the same."""
    return np.array(NEARBY)[:, None] * np.random.default_rng(4).uniform(-1.0, 1.0, (len(NEARBY), n_q))


def mass_and_rows(system: ConstrainedSystem, t: float, q: Array) -> tuple[Array, Array]:
    """M, and C_q with A, at a position; not to be written to."""
    return system.remembered_at("mass and rows", (t, q.tobytes()), lambda: (system.mass(t, q), system.rows(t, q)))


def has_definite_mass(system: ConstrainedSystem, t: float, q: Array) -> bool:
    """Whether M has an inverse at a position, and not only on velocities that the constraints allow."""
    return system.remembered_at("definite mass", _place(system, t, q), lambda: is_definite(system.mass(t, q)))


def is_definite(mass: Array) -> bool:
    """Whether M has an inverse."""
    return bool(eigenvalues(mass)[0] > SINGULAR_MASS * np.abs(mass).max())


def _place(system: ConstrainedSystem, t: float, q: Array) -> Any:
    """What a mass matrix depends on."""
    return None if system.constant_mass else (t, q.tobytes())


def _parts(value: Array | tuple[Array, ...]) -> tuple[Array, ...]:
    return value if isinstance(value, tuple) else (value,)


def not_finite(system: ConstrainedSystem, t: float, q: Array, v: Array) -> str | None:
    """Which callbacks give values that are not finite at (t, q, v); None: all are."""
    state = {"q": q, "v": v, "lam": np.ones(system.n_c)}
    looked = [kind for kind in system.given if kind not in system.entries]  # whose values are looked at
    values = {kind: system.evaluate(kind, t, *[state[name] for name in KINDS[kind].state]) for kind in looked}
    wrong = [kind for kind, value in values.items() if not all(np.isfinite(part).all() for part in _parts(value))]
    return f"{' and '.join(wrong)} of {system.name!r} returned values that are not finite" if wrong else None
